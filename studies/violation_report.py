"""The text and the figures of the violation study, from its rows and curves."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from references import exudyn_four_bar, gear, ida, index1
from studies.report import Array, Call, markdown_table, number
from studies.runs import CHECKED, time_for
from studies.solvers import ALPHAS, CATALOGUE, ERR_IN, IRK, NEWMARK, baumgarte

LOOPS = (1e-3, 1e-5, 1e-7, 1e-9)  # err_in and err_out of Table 3
LEVELS = {"q": "max |C|", "v": "max |C_q v + C_t|", "a": "max |C_q a − Q_d|"}
COLUMNS = ("max abs C", "max abs C_q v + C_t", "max abs C_q a − Q_d")  # a bar would end the cell of a markdown table
SLOPE, TIMES = 0.25, 2.0  # a violation grows when it goes like t^p with p above SLOPE and ends above TIMES its start
TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)

LEVELS_DRAWN = {  # line of the figure: ours solid, others dashed
    IRK: ("tab:blue", "-"),
    NEWMARK: ("tab:orange", "-"),
    "Gauss12": ("tab:purple", "-"),
    "BDF": ("tab:brown", "-"),
    "IDA, index1": ("tab:olive", "--"),
    "IDA, stabilised": ("tab:green", "--"),
    "LSODA, index 1": ("tab:gray", "--"),
    "DOP853, index 1": ("black", "--"),
    baumgarte("DOP853", 10.0): ("black", ":"),
    "DOP853, projected": ("black", "-."),
    "Exudyn, GeneralizedAlpha": ("tab:cyan", "--"),
    "Exudyn, TrapezoidalIndex2": ("tab:pink", "--"),
    "GSTIFF stand-in, order 2": ("tab:red", "--"),
    "GSTIFF stand-in, order 5": ("tab:red", ":"),
}
ALONG = {  # line of the figure of costs
    "DOP853, index 1": ("black", "o--"),
    baumgarte("DOP853", 1.0): ("tab:cyan", "v:"),
    baumgarte("DOP853", 10.0): ("tab:olive", "s:"),
    baumgarte("DOP853", 100.0): ("tab:gray", "^:"),
    "DOP853, projected": ("tab:red", "D-."),
    "IDA, index1": ("tab:brown", "<--"),
    "IDA, stabilised": ("tab:green", ">-."),
    "SunRadau5": ("tab:orange", "P-"),
    "Gauss12": ("tab:purple", "*-"),
}


def key(row: pd.Series, kind: str) -> str:
    """Name of a curve of this row in the saved series."""
    settings = " ".join(
        f"{name}={row[name]:g}" for name in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(name))
    )
    return f"{row['group']} {row['solver']} {settings} {kind}"


def _setting(row: pd.Series) -> str:
    return next(f"{name} {row[name]:.0e}" for name in ("h", "err_out", "tol") if pd.notna(row.get(name)))


def grows(row: pd.Series, level: str) -> bool:
    """Whether the violation of a level grows, by the criterion of the report."""
    return bool(row[f"growth_{level}"] > SLOPE and row[f"late_{level}"] > TIMES * row[f"early_{level}"])


def _exponent(row: pd.Series, level: str) -> str:
    return f"{round(row[f'growth_{level}'], 2) + 0.0:.2f}"  # no minus zero


def _named(rows: pd.DataFrame, what: str) -> str:
    return ", ".join(f"{row['solver']} {number(row[what])}" for _, row in rows.iterrows()) or "none"


def summary(rows: pd.DataFrame) -> list[str]:
    """The findings, every number from the rows."""
    line_up = rows[rows["group"] == "line-up"]
    ours = line_up[[CATALOGUE[name].two_loop for name in line_up["solver"]]]
    others = line_up.drop(ours.index)
    irk = ours[ours["solver"] == IRK].iloc[0]
    t_end = rows["t_end"].iloc[0]
    growing = [row["solver"] for _, row in ours.iterrows() if any(grows(row, level) for level in LEVELS)]
    loops = rows[rows["group"] == "loops"]
    inner_loose, both_loose = (
        loops[(loops["err_in"] == LOOPS[0]) & (loops["err_out"] == err_out)].iloc[0]
        for err_out in (LOOPS[-1], LOOPS[0])
    )
    lines = [
        f"PaperIRK at the paper's settings violates (35) by at most {number(irk['violation_35'])} and (36) by at most "
        f"{number(irk['violation_36'])} m in {t_end:g} s, and "
        f"{'they grow' if grows(irk, 'q') else 'they do not grow'} (fit t^{_exponent(irk, 'q')}). The paper: very small, and the "
        "amplitude does not increase.",
        f"All {len(ours)} two-loop runs: positions by at most {number(ours['violation_q'].max())}, velocities "
        f"{number(ours['violation_v'].max())}, accelerations {number(ours['violation_a'].max())}; growing: "
        f"{', '.join(growing) or 'none'}.",
        f"With the inner loop alone loose, err_in = {LOOPS[0]:g} and err_out = {LOOPS[-1]:g}, PaperIRK violates positions by "
        f"{number(inner_loose['violation_q'])} m (every sweep of the outer loop goes on with Newton's method from the last); with both at "
        f"{LOOPS[0]:g} by {number(both_loose['violation_q'])} m.",
    ]
    for level, what in (("q", "Positions"), ("v", "Velocities")):
        kept = others[others[f"violation_{level}"] <= 1e-12]
        drifting = pd.DataFrame([row for _, row in others.drop(kept.index).iterrows() if grows(row, level)])
        rest = others.drop(kept.index).drop(drifting.index)
        lines.append(
            f"{what}, others: kept to 1e-12 by {_named(kept, f'violation_{level}')}; violated and growing: "
            f"{_named(drifting, f'violation_{level}')}; violated, not growing: {_named(rest, f'violation_{level}')}."
        )
    own = others[others["own_a"]]
    lines.append(
        f"Accelerations that are not those of eq. (6) violate C_q a = Q_d by: {_named(own, 'violation_a')}. All other "
        "accelerations are computed from q and v by eq. (6), and satisfy it to rounding by construction."
    )
    along = rows[rows["group"] == "tolerances"]
    bounded = along[along["solver"].str.contains("Baumgarte") & along["error_q"].notna()]
    never = "; ".join(
        f"{name} {number(part['violation_q'].min())} to {number(part['violation_q'].max())}"
        for name, part in bounded.groupby("solver", sort=False)
    )
    unbounded = [f"{row['solver']} at {row['tol']:.0e}" for _, row in bounded.iterrows() if grows(row, "q")]
    lines.append(
        f"Baumgarte's method, max |C| at tolerances {along['tol'].min():.0e} to {along['tol'].max():.0e}: {never}. The paper: "
        f"constraints are not satisfied exactly. The violation grows in {len(unbounded)} of these {len(bounded)} runs: "
        f"{', '.join(unbounded) or 'none'}."
    )
    lines += _projection_lines(rows)
    return lines


def _projection_lines(rows: pd.DataFrame) -> list[str]:
    lines = []
    for kept, drifting, what in PAIRS:
        ratios = []
        for target in TARGETS:
            pair = [_at(rows, kept, target, cost) / _at(rows, drifting, target, cost) for cost in _COSTS]
            if min(_worst(rows, kept), _worst(rows, drifting)) < target:
                continue  # all runs are better than that
            if not np.isnan(pair).any():
                ratios.append((target, *pair))
        if ratios:
            texts = ", ".join(f"{n:.2f} and {cpu:.2f} for {target:.0e}" for target, n, cpu in ratios)
            lines.append(
                f"{what}: at equal error over the run {kept} takes, of the evaluations and of the CPU time of {drifting}, {texts}."
            )
    if lines:
        lines[-1] += " The paper calls a projection method with extra multipliers inefficient."
    cheaper = []
    for target in TARGETS:
        n, cpu = (_at(rows, "Gauss12", target, cost) / _at(rows, "DOP853, projected", target, cost) for cost in _COSTS)
        if _worst(rows, "Gauss12") >= target and not np.isnan(n + cpu):
            cheaper.append(f"{n:.2f} and {cpu:.2f} for {target:.0e}")
    if cheaper:
        lines.append(
            "The two-loop procedure Gauss12 takes, of the evaluations and of the CPU time of DOP853, projected, "
            f"{', '.join(cheaper)} (SciPy's solver is Python, ours compiled)."
        )
    same = _same_tolerance(rows)
    if same:
        extra = [share for _, _, share, _ in same]
        better = [ratio for _, _, _, ratio in same]
        lines.append(
            f"At equal tolerance the projection of DOP853 and RK45 takes {100 * (min(extra) - 1):.0f} to "
            f"{100 * (max(extra) - 1):.0f} % more evaluations, and multiplies the error by {number(min(better))} to "
            f"{number(max(better))}."
        )
    return lines


PAIRS = (  # constraints kept, drifting, what is done
    ("DOP853, projected", "DOP853, index 1", "Projection after each step"),
    ("RK45, projected", "RK45, index 1", "The same with a method of order 5"),
    ("IDA, stabilised", "IDA, index1", "Extra multipliers in the integration (Gear, Gupta and Leimkuhler)"),
)
_COSTS = ("n_evaluations", "cpu_s")


def _at(rows: pd.DataFrame, solver: str, target: float, cost: str) -> float:
    part = rows[(rows["group"] == "tolerances") & (rows["solver"] == solver)]
    return time_for(part, target, cost)


def _worst(rows: pd.DataFrame, solver: str) -> float:
    """Largest error of the runs of a solver along its tolerances; NaN without runs."""
    return float(rows[(rows["group"] == "tolerances") & (rows["solver"] == solver)]["error_q"].max())


def _same_tolerance(rows: pd.DataFrame) -> list[tuple[str, float, float, float]]:
    """(method, tol, evaluations over those without projection, error over that without) where both reached the end."""
    along = rows[rows["group"] == "tolerances"]
    pairs = []
    for method in ("DOP853", "RK45"):
        plain = along[along["solver"] == f"{method}, index 1"].set_index("tol")
        projected = along[along["solver"] == f"{method}, projected"].set_index("tol")
        for tol in plain.index.intersection(projected.index):
            one, two = projected.loc[tol], plain.loc[tol]
            if pd.notna(one["error_q"]) and pd.notna(two["error_q"]):
                pairs.append(
                    (method, tol, one["n_evaluations"] / two["n_evaluations"], one["error_q"] / two["error_q"])
                )
    return pairs


TABLE = (
    "solver", "setting", "error q (m, rad)", *COLUMNS, "(35)", "(36)",
    "growth of C", "of C_q v", "of C_q a", "ended",
)  # fmt: skip


def table(rows: pd.DataFrame) -> list[list[str]]:
    """Violations, one line a run."""
    lines = []
    for _, row in rows.iterrows():
        sizes = [number(row[f"violation_{level}"]) for level in LEVELS]
        if not row["own_a"]:
            sizes[-1] += " ="
        closure = [number(row["violation_35"]), number(row["violation_36"])]
        exponents = [
            "–" if pd.isna(row[f"growth_{level}"]) else f"{_exponent(row, level)}{' ↑' if grows(row, level) else ''}"
            for level in LEVELS
        ]
        ended = row["status"].lower().replace("_", " ")
        lines.append([row["solver"], _setting(row), number(row["error_q"]), *sizes, *closure, *exponents, ended])
    return lines


def loops(rows: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """PaperIRK: max |C| / error by err_in (lines) and err_out (columns)."""
    part = rows[rows["group"] == "loops"].set_index(["err_in", "err_out"])
    columns = sorted({err_out for _, err_out in part.index}, reverse=True)
    lines = []
    for err_in in sorted({err_in for err_in, _ in part.index}, reverse=True):
        cells = [part.loc[(err_in, err_out)] for err_out in columns]
        lines.append([f"{err_in:.0e}", *(f"{number(c['violation_q'])} / {number(c['error_q'])}" for c in cells)])
    return ["max abs C / error q; err_in \\ err_out", *(f"{err_out:.0e}" for err_out in columns)], lines


def equal_error(rows: pd.DataFrame) -> tuple[list[str], list[list[str]]]:
    """What an accuracy costs with and without constraints kept: evaluations and CPU time."""
    solvers = ["DOP853, index 1", "DOP853, projected", baumgarte("DOP853", 10.0), "RK45, index 1", "RK45, projected"]
    solvers = [
        s
        for s in (*solvers, "LSODA, index 1", "IDA, index1", "IDA, stabilised", "SunRadau5", "Gauss12")
        if (rows["solver"] == s).any()
    ]
    lines = []
    for solver in solvers:
        texts = []
        for target in TARGETS:
            values = [_at(rows, solver, target, cost) for cost in _COSTS]
            texts.append("–" if np.isnan(values[0]) else f"{number(values[0], 3)} / {values[1]:.3f}")
        lines.append([solver, *texts])
    return ["evaluations / CPU (s) for an error of", *(f"{target:.0e}" for target in TARGETS)], lines


def by_alpha(rows: pd.DataFrame, method: str) -> tuple[list[str], list[list[str]]]:
    """max |C| / error / evaluations by tolerance (columns) and stabilisation (lines)."""
    along = rows[rows["group"] == "tolerances"]
    tolerances = sorted(along["tol"].dropna().unique(), reverse=True)
    names = [f"{method}, index 1", *(baumgarte(method, alpha) for alpha in ALPHAS), f"{method}, projected"]
    lines = []
    for name in names:
        part = along[along["solver"] == name].set_index("tol")
        if not part.empty:
            texts = [_trio(part.loc[tol]) if tol in part.index else "–" for tol in tolerances]
            lines.append([name, *texts])
    return ["max abs C / error q / evaluations, by tol", *(f"{tol:.0e}" for tol in tolerances)], lines


def _trio(row: pd.Series) -> str:
    if pd.isna(row["error_q"]):
        return "failed"
    return " / ".join([number(row["violation_q"]), number(row["error_q"]), number(row["n_evaluations"], 3)])


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write violation.md."""
    parts = [
        "# Violation of the constraints (Fig. 7 of the paper)",
        f"Generated by {line}. Do not edit; rows in `violation.csv`, curves in `violation_series.npz`.",
        "\n".join(f"- {text}" for text in summary(rows)),
        "## The two closure equations (Fig. 7)",
        "![Violation of (35) and (36)](violation_closure.png)",
        "Residuals of the last two position constraints, (35) and (36), after every step of PaperIRK: at the paper's tolerances of "
        "the loops, and at the loosest of its Table 3 (another unit). The spacing of floating-point numbers at 3 m is 4.4e-16.",
        "PaperIRK by the tolerances of its loops:",
        markdown_table(*loops(rows)),
        "## All solvers, one sensible setting each",
        "![Violations against time](violation.png)",
        f"Largest violation in each fiftieth of the run. Settings as in the table, where “=” marks accelerations computed by eq. "
        f"(6), whose small violation says nothing; ↑: grows (exponent above {SLOPE:g}, and the last tenth of the run more than "
        f"{TIMES:g} times as bad as the first).",
        markdown_table(list(TABLE), table(rows[rows["group"] == "line-up"])),
        "## What keeping the constraints costs",
        "![Violation against tolerance, and cost against error](violation_cost.png)",
        "Left: what the tolerance does to the violation. Right: evaluations for an accuracy, so at equal error, not at equal "
        "tolerance.",
        markdown_table(*equal_error(rows)),
        "## Baumgarte's method against α and tolerance",
        markdown_table(*by_alpha(rows, "DOP853")),
    ]
    if (rows["solver"] == baumgarte("LSODA", 1.0)).any():
        parts.append(markdown_table(*by_alpha(rows, "LSODA")))
    parts += ["## How to read this", _notes(rows)]
    (call.out / "violation.md").write_text("\n\n".join(parts) + "\n")


def _notes(rows: pd.DataFrame) -> str:
    repeats = rows["repeats"].max()
    notes = [
        f"**Assumed geometry.** Table 2 of the paper is lost: {rows['problem'].iloc[0]} is assumed. Lengths are metres, so position "
        "violations are metres, velocity m/s, acceleration m/s².",
        f"**Violations** are largest absolute components at up to {CHECKED} evenly chosen stored instants. Solvers that "
        "interpolate (IDA) are taken at their output times.",
        "**Growth** is p of t^p, by least squares through the largest violations of the ten tenths of the run at their ends, both "
        "logarithmic; "
        "rounding gives about 0, a constant error of the accelerations 2 in positions and 1 in velocities.",
        "**Accelerations**, “=”: IDA, Exudyn and the GSTIFF stand-in have them as unknowns or as differences of v; a two-loop procedure "
        "and an index-1 ODE compute them by eq. (6), Baumgarte's method with its own terms, so that there max |C_q a − Q_d| is "
        "2α |C_q v + C_t| and α² |C|.",
        "**Projection and Baumgarte**: "
        + "; ".join(f"{name}: {text}" for name, text in index1.STABILISATIONS.items())
        + ". `references/index1.py`; the projection is in the norm of the mass matrix, after every step, and asks for one more "
        "evaluation a step. The paper's projection method, with extra multipliers in the integration, is the form of IDA, stabilised: "
        + ida.FORMS["stabilised"]
        + ".",
        f"**CPU times** are medians of {repeats} where solvers are compared at equal error. IDA's rows are the runs of median "
        "error, which scatters with rounding. SciPy's solvers are Python with a compiled right side, twoloop is compiled "
        "throughout: evaluations compare the methods, CPU times the programs. An evaluation of a two-loop procedure solves the "
        "dependents, too.",
        "**Exudyn**: " + "; ".join(f"`{name}` is {label}" for name, label in exudyn_four_bar.SOLVERS.items()) + ".",
        "**GSTIFF stand-in**: " + gear.LABEL.format(order="as given") + ", accurate start; it asks for C = 0 alone.",
        f"**Settings**: `err_out` with err_in = {ERR_IN:g} (and Atol = Rtol = 1e-5 for PaperIRK); `tol` = rtol = atol; `h` is a "
        "fixed step.",
    ]
    return "\n".join(f"- {note}" for note in notes)


def figures(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    """Draw the three figures."""
    _closure(rows, series, call)
    _levels(rows, series, call)
    _cost(rows, call)


def _closure(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    part = rows[(rows["group"] == "loops") & (rows["err_in"] == rows["err_out"])].sort_values("err_in")
    plot, axes = plt.subplots(len(part), 1, figsize=(9.5, 4.6), sharex=True, layout="constrained")
    for panel, (_, row) in zip(axes, part.iterrows(), strict=True):
        t, *residuals = series[key(row, "closure")]
        unit = 10.0 ** np.floor(np.log10(np.abs(residuals).max()))
        for residual, label, color in zip(residuals, ("(35)", "(36)"), ("tab:blue", "tab:orange"), strict=True):
            panel.plot(t, residual / unit, ".", color=color, ms=3, label=label)
        panel.set_ylabel(f"violation ({unit:.0e} m)")
        panel.set_title(f"PaperIRK, err_in = err_out = {row['err_in']:.0e}", fontsize=9)
        panel.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    axes[-1].set_xlabel("t (s)")
    plot.savefig(call.out / "violation_closure.png")
    plt.close(plot)


def _levels(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    plot, axes = plt.subplots(1, 3, figsize=(13, 4.8), sharex=True, sharey=True, layout="constrained")
    line_up = rows[rows["group"] == "line-up"].set_index("solver", drop=False)
    for panel, (level, title) in zip(axes, LEVELS.items(), strict=True):
        for solver, (color, style) in LEVELS_DRAWN.items():
            if solver in line_up.index and (level != "a" or line_up.loc[solver, "own_a"] or solver == IRK):
                row = line_up.loc[solver]
                label = f"{solver}, {_setting(row)}"
                panel.semilogy(series["t"], series[key(row, level)], style, color=color, lw=1.3, label=label)
        panel.set_xlabel("t (s)")
        panel.set_title(title if level != "a" else f"{title}, accelerations not of eq. (6), and PaperIRK", fontsize=9)
    axes[0].set_ylabel("largest violation in a fiftieth of the run (SI units)")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[2].legend(handles, labels, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plot.suptitle("Violation of the constraints: two-loop procedures (solid) and others", fontsize=10)
    plot.savefig(call.out / "violation.png")
    plt.close(plot)


def _cost(rows: pd.DataFrame, call: Call) -> None:
    plot, (left, right) = plt.subplots(1, 2, figsize=(11.5, 4.6), layout="constrained")
    along = rows[rows["group"] == "tolerances"]
    for solver, (color, style) in ALONG.items():
        part = along[(along["solver"] == solver) & along["error_q"].notna()]
        if not part.empty:
            left.loglog(part["tol"], part["violation_q"], style, color=color, ms=5, lw=1.1)
            right.loglog(part["error_q"], part["n_evaluations"], style, color=color, ms=5, lw=1.1, label=solver)
    left.set(xlabel="tolerance", ylabel="max |C| over the run (m)", title="What is left of the constraints")
    right.set(xlabel="largest position error over the run (m, rad)", ylabel="evaluations", title="What accuracy costs")
    right.set_ylim(1e4, 1e6)
    right.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    plot.savefig(call.out / "violation_cost.png")
    plt.close(plot)

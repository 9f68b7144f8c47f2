"""The text and the figure of the Table 3 study, from its rows."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from references import exudyn_four_bar, ida, ida_c
from studies.report import Call, markdown_table, number
from studies.runs import ASTRAY, CHECKED, LOST, time_for
from studies.solvers import IDA_C, IRK, IRK_LINE, NEWMARK, OWN_EXPLICIT, QUARTER

TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9)

# Table 3 as printed: [err_in][err_out] in seconds; None is the star, "no reasonable result in long time simulation"
PAPER_IRK = ((1.95, 1.98, 2.00, 2.08), (2.12, 2.23, 2.31, 2.31), (2.64, 2.85, 2.85, 2.99), (3.37, 3.46, 3.55, 3.60))
PAPER_NEWMARK = (
    (None, 2.71, 12.62, 49.73),
    (None, 2.74, 12.36, 49.68),
    (None, 3.10, 12.68, 49.66),
    (None, 3.09, 13.40, 50.93),
)

FAMILIES = {"Table 3: IRK": IRK, "Table 3: Newmark": NEWMARK}
PRESETS_SHOWN = ("SunRadau5", "Gauss6", "Gauss12", "BDF", OWN_EXPLICIT)
EXUDYN = ("GeneralizedAlpha", "TrapezoidalIndex2")
EXPLICIT = ("LSODA, index 1", "DOP853, index 1", "DOP853, projected")
TWO_LOOP = (IRK, NEWMARK, QUARTER, IRK_LINE, *PRESETS_SHOWN)


def _cell(rows: pd.DataFrame, group: str, err_in: float, err_out: float) -> pd.Series | None:
    found = rows[(rows["group"] == group) & (rows["err_in"] == err_in) & (rows["err_out"] == err_out)]
    return None if found.empty else found.iloc[0]


def grid(rows: pd.DataFrame, group: str, show, paper=None) -> list[list[str]]:  # type: ignore[no-untyped-def]
    """Table rows err_in by err_out of what `show` makes of a cell, the paper's number in brackets."""
    table = []
    for i, err_in in enumerate(TOLERANCES):
        line = [f"{err_in:.0e}"]
        for j, err_out in enumerate(TOLERANCES):
            cell = _cell(rows, group, err_in, err_out)
            text = "–" if cell is None else show(cell)
            if paper is not None:
                text += " (★)" if paper[i][j] is None else f" ({paper[i][j]:.2f})"
            line.append(text)
        table.append(line)
    return table


def time_of(cell: pd.Series) -> str:
    return f"{cell['cpu_s']:.3f}{_mark(cell)}"


def _mark(row: pd.Series) -> str:
    return " ★" if row["lost"] else " †" if row["astray"] else ""


def ratios(rows: pd.DataFrame) -> list[list[str]]:
    """What the paper's table says, as ratios, beside ours."""
    irk, newmark = FAMILIES
    last = (1e-9, 1e-9)
    table = []
    for title, paper, (group_a, a), (group_b, b) in (
        ("Newmark / IRK at (1e-9, 1e-9)", 50.93 / 3.60, (newmark, last), (irk, last)),
        ("Newmark, err_out 1e-5 → 1e-7", 13.40 / 3.09, (newmark, (1e-9, 1e-7)), (newmark, (1e-9, 1e-5))),
        ("Newmark, err_out 1e-7 → 1e-9", 50.93 / 13.40, (newmark, last), (newmark, (1e-9, 1e-7))),
        ("Newmark, err_in 1e-3 → 1e-9 (err_out 1e-9)", 50.93 / 49.73, (newmark, last), (newmark, (1e-3, 1e-9))),
        ("IRK, err_in 1e-3 → 1e-9 (err_out 1e-9)", 3.60 / 2.08, (irk, last), (irk, (1e-3, 1e-9))),
        ("IRK, err_out 1e-3 → 1e-9 (err_in 1e-9)", 3.60 / 3.37, (irk, last), (irk, (1e-9, 1e-3))),
    ):
        one, two = _cell(rows, group_a, *a), _cell(rows, group_b, *b)
        ours = ["–"] * 3
        if one is not None and two is not None:
            ours = [f"{one[what] / two[what]:.2f}" for what in ("cpu_s", "n_evaluations", "n_inner")]
        table.append([title, f"{paper:.2f}", *ours])
    return table


def equal_error(rows: pd.DataFrame) -> list[list[str]]:
    """Newmark against IRK where both have the same error over the run."""
    fine = rows[(rows["err_in"].isna()) | (rows["err_in"] == TOLERANCES[-1])]
    table = []
    for target in (0.3, 0.1, 0.03, 0.01):
        times = [time_for(fine[fine["solver"] == solver], target) for solver in (NEWMARK, QUARTER, IRK_LINE)]
        texts = [number(value) for value in times]
        table.append([f"{target:g}", *texts, number(times[0] / times[2]), number(times[1] / times[2])])
    return table


COMPARISON = (
    "solver",
    "setting",
    "CPU (s)",
    "steps",
    "evaluations",
    "error q (m, rad)",
    "q at the end",
    "error v",
    "energy error (J)",
    "max abs C",
    "max abs C_q v + C_t",
    "ended",
)


def comparison(rows: pd.DataFrame) -> list[list[str]]:
    """One line a run: setting, cost, errors, violations, how it ended."""
    table = []
    for _, row in rows.iterrows():
        settings = [f"{key} {row[key]:.0e}" for key in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(key))]
        ended = row["status"].lower().replace("_", " ") + _mark(row)
        numbers = [f"{row['cpu_s']:.3f}", *(number(row[c], 3) for c in ("n_steps", "n_evaluations"))]
        keys = ("error_q", "error_end", "error_v", "energy", "violation_q", "violation_v")
        numbers += [number(row[key]) for key in keys]
        table.append([row["solver"], ", ".join(settings), *numbers, ended])
    return table


TARGETS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
WORK_PRECISION = ("solver", *(f"{target:.0e}" for target in TARGETS))


def work_precision(rows: pd.DataFrame) -> list[list[str]]:
    """CPU time of each solver for a target error over the run."""
    return [
        [solver, *(number(time_for(rows[rows["solver"] == solver], target), 3) for target in TARGETS)]
        for solver in dict.fromkeys(rows["solver"])
    ]


SHOWN = {  # the lines of the figure: ours solid, others dashed
    NEWMARK: ("tab:orange", "s-"),
    IRK_LINE: ("tab:red", "^-"),
    "SunRadau5": ("tab:purple", "v-"),
    "Gauss12": ("tab:blue", "o-"),
    "BDF": ("tab:pink", "X-"),
    OWN_EXPLICIT: ("tab:brown", "H-"),
    "IDA, stabilised": ("tab:olive", "<--"),
    IDA_C: ("tab:green", ">--"),
    "Exudyn, TrapezoidalIndex2": ("tab:cyan", "D--"),
    "LSODA, index 1": ("tab:gray", "p--"),  # a marker that can be white
    "DOP853, projected": ("black", "P--"),
}


def figure(rows: pd.DataFrame, call: Call) -> None:
    """CPU time against the largest error over the run, a panel for each geometry."""
    problems = list(dict.fromkeys(rows["problem"]))
    t_end = rows["t_end"].iloc[0]
    plot, axes = plt.subplots(1, len(problems), figsize=(11, 4.8), sharex=True, sharey=True, layout="constrained")
    for panel, problem, which in zip(axes, problems, ("default (assumed)", "second"), strict=True):
        for solver, (color, style) in SHOWN.items():
            part = rows[(rows["problem"] == problem) & (rows["solver"] == solver) & rows["error_q"].notna()]
            part = part[part["err_in"].isna() | (part["err_in"] == TOLERANCES[-1])].sort_values("error_q")
            if part.empty:  # rows of before a solver was there, or all of them failed
                continue
            panel.loglog(part["error_q"], part["cpu_s"], style, color=color, ms=4, lw=1.1, label=solver)
            bad = part[part["lost"] | part["astray"]]
            panel.loglog(bad["error_q"], bad["cpu_s"], style[0], color=color, ms=5, mfc="white", zorder=5)
        panel.set(xlabel="largest position error over the run (m, rad)", title=f"{which} geometry: {problem}")
    axes[0].set_ylabel("CPU time (s)")
    axes[-1].legend(fontsize=7.5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    title = f"Cost of accuracy, four-bar linkage over {t_end:g} s: lower left is better"
    plot.suptitle(f"{title} (white: solution lost or out of phase)", fontsize=10)
    plot.savefig(call.out / "table3.png")
    plt.close(plot)


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write table3.md."""
    problems = list(dict.fromkeys(rows["problem"]))
    first = rows[rows["problem"] == problems[0]]
    second = rows[rows["problem"] == problems[1]]
    t_end = rows["t_end"].iloc[0]
    header = ["err_in \\ err_out", *(f"{e:.0e}" for e in TOLERANCES)]
    irk, newmark = FAMILIES
    parts = [
        "# Table 3: what accuracy costs, two-loop procedures beside IDA, Exudyn and SciPy",
        f"Generated by {line}. Do not edit; rows in `table3.csv`.",
        _summary(rows, first),
        f"## Table 3: CPU time in seconds for {t_end:g} s of motion, the paper's for 100 s in brackets",
        "Two-loop procedure with Runge–Kutta (`PaperIRK`, Atol = Rtol = 1e-5):",
        markdown_table(header, grid(first, irk, time_of, PAPER_IRK)),
        "Two-loop procedure with Newmark (`PaperNewmark`, β = 1/2 as printed):",
        markdown_table(header, grid(first, newmark, time_of, PAPER_NEWMARK)),
        "★ solution lost, † out of phase: [criteria below](#how-to-read-this).",
        "## What the times hide",
        "Runge–Kutta: evaluations / steps / largest position error over the run / energy error (J):",
        markdown_table(header, grid(first, irk, _counts)),
        "Newmark: evaluations / steps / largest position error over the run / energy error (J):",
        markdown_table(header, grid(first, newmark, _counts)),
        "## The ratios that matter",
        markdown_table(["ratio", "paper, time", "ours, CPU time", "evaluations", "inner iterations"], ratios(first)),
        "At equal error (largest position error over the run, m or rad; runs with err_in = 1e-9; between two runs on the "
        "log–log line through them), CPU time in seconds:",
        markdown_table(
            ["error", "Newmark β = 1/2", "Newmark β = 1/4", IRK_LINE, "β = 1/2 over IRK", "β = 1/4 over IRK"],
            equal_error(first),
        ),
        "## Other solvers, and ours at other settings",
        "![CPU time against error](table3.png)",
        "CPU time (s) for a largest position error over the run of at most the target, between two settings on the "
        "log–log line through them; – : not reached with the settings of the study.",
        markdown_table(list(WORK_PRECISION), work_precision(first)),
        "The same for the second geometry:",
        markdown_table(list(WORK_PRECISION), work_precision(second)),
        "## All other runs, default geometry",
        markdown_table(list(COMPARISON), comparison(first[first["group"] == "comparison"])),
        f"## All runs, second geometry: {problems[1]}",
        _in_line(first, second),
        markdown_table(list(COMPARISON), comparison(second)),
        "## How to read this",
        _notes(rows),
    ]
    (call.out / "table3.md").write_text("\n\n".join(parts) + "\n")


def _in_line(first: pd.DataFrame, second: pd.DataFrame) -> str:
    """Which angles fail as the independent coordinate, and how often."""
    counts = [
        f"{name} {first[f'in_line_{name}'].iloc[0]} times in the default geometry and "
        f"{second[f'in_line_{name}'].iloc[0]} times in this one"
        for name in ("θ1", "θ2", "θ3")
    ]
    why = "In a period an angle fails as the independent coordinate, because the other two bars come into line"
    return f"{why}: {'; '.join(counts)}."


def headline(rows: pd.DataFrame, line: str) -> str:
    """The table of the README: CPU time for an accuracy, default geometry."""
    first = rows[rows["problem"] == rows["problem"].iloc[0]]
    first = first[first["solver"].isin(SHOWN)]
    return "\n\n".join(
        [
            f"CPU time in seconds for {rows['t_end'].iloc[0]:g} s of the linkage's motion (assumed geometry, see above) "
            "with a largest position error over the run of (two-loop procedures first, then other people's solvers)",
            markdown_table(list(WORK_PRECISION), work_precision(first)),
            f"– : not reached with the settings of the study. Written by {line}.",
        ]
    )


def _counts(cell: pd.Series) -> str:
    return " / ".join(number(cell[key], 2) for key in ("n_evaluations", "n_steps", "error_q", "energy"))


def _at(table: pd.DataFrame, key: str) -> str:
    values = sorted(table[table[key]]["err_out"].unique(), reverse=True)
    return "at err_out = " + ", ".join(f"{e:.0e}" for e in values) if values else "nowhere"


def _summary(rows: pd.DataFrame, first: pd.DataFrame) -> str:
    """The findings in a few lines, every number from the rows."""
    irk, newmark = FAMILIES
    lines = []
    one, two = _cell(first, irk, 1e-9, 1e-9), _cell(first, newmark, 1e-9, 1e-9)
    if one is not None and two is not None:
        lines.append(
            f"At (err_in, err_out) = (1e-9, 1e-9) Runge–Kutta takes {one['cpu_s']:.2f} s and Newmark "
            f"{two['cpu_s']:.2f} s, {two['cpu_s'] / one['cpu_s']:.1f} times as much "
            f"({two['n_evaluations'] / one['n_evaluations']:.1f} times the evaluations); the paper printed "
            f"{PAPER_IRK[3][3]:.2f} s, {PAPER_NEWMARK[3][3]:.2f} s and {PAPER_NEWMARK[3][3] / PAPER_IRK[3][3]:.1f} "
            f"times. Their errors over the run: {number(one['error_q'])} and {number(two['error_q'])}."
        )
    for group, name, printed in ((newmark, "Newmark", "at err_out = 1e-03"), (irk, "Runge–Kutta", "nowhere")):
        table = first[first["group"] == group]
        lines.append(
            f"{name} loses the solution (★) {_at(table, 'lost')}; the paper: {printed}. It is out of phase (†, or lost) "
            f"{_at(table, 'astray')}; the paper does not say."
        )
    for target in (1e-2, 1e-4, 1e-6):
        times = {
            solver: time_for(first[first["solver"] == solver], target) for solver in dict.fromkeys(first["solver"])
        }
        ranked = sorted((value, solver) for solver, value in times.items() if not np.isnan(value))
        text = ", ".join(f"{solver} {value:.2f} s" for value, solver in ranked)
        lines.append(f"For an error of {target:.0e} over the run, cheapest first: {text}.")
    best = first.dropna(subset="error_q").groupby("solver", sort=False)["error_q"].min()
    reached = ", ".join(f"{solver} {number(value)}" for solver, value in best.items())
    lines.append(f"Smallest error over the run that each reached with the settings here: {reached}.")
    two_loop = rows[rows["solver"].isin(TWO_LOOP)]
    tight = two_loop[two_loop["err_in"].isna() | (two_loop["err_in"] == 1e-9)]
    early, late = tight["violation_early"].max(), tight["violation_late"].max()
    lines.append(
        "Position constraints of the two-loop runs (err_in = 1e-9, presets 1e-8) are violated by at most "
        f"{number(tight['violation_q'].max())}; in the first tenth of the runs by {number(early)}, in the last by "
        f"{number(late)}: {'they do not grow' if late <= 2.0 * early else 'they grow'}."
    )
    cells = first[first["group"].isin(FAMILIES)]
    lines.append(
        f"All {len(cells)} cells, repeats included, took {(cells['cpu_s'] * cells['repeats']).sum():.0f} s of CPU time. A "
        f"fresh process with a warm cache has integrated its first millisecond {first['start_up_s'].iloc[0]:.2f} s after "
        "its start."
    )
    failed = rows[rows["status"] != "REACHED_END"]
    ours = int(failed["solver"].isin(TWO_LOOP).sum())
    lines.append(f"Runs that failed: {ours} of {len(two_loop)} two-loop runs, {len(failed) - ours} of the others.")
    return "\n".join(f"- {text}" for text in lines)


def _window(rows: pd.DataFrame) -> str:
    """Between which fractions of the kinetic energy the criterion could be set without moving a star."""
    cells = rows[rows["group"].isin(FAMILIES) & (rows["problem"] == rows["problem"].iloc[0])]
    share = (cells["energy"].abs() / cells["kinetic"]).where(cells["status"] == "REACHED_END", np.inf)
    kept, lost = share[~cells["lost"]], share[cells["lost"]]
    if lost.empty:
        return "no run is starred here"
    return f"any fraction between {kept.max():.1%} and {lost.min():.1%} stars the same cells"


def _notes(rows: pd.DataFrame) -> str:
    problems = list(dict.fromkeys(rows["problem"]))
    first = rows[rows["problem"] == problems[0]]
    loose = first[first["group"] == "Table 3: IRK"]
    loose = loose[loose["err_out"] == 1e-3]
    flattery = (first["error_q"] / first["error_end"]).median()
    repeats = ", ".join(f"{n} in {count} rows" for n, count in rows["repeats"].value_counts().items())
    notes = [
        f"**Assumed geometry.** Table 2 of the paper is lost. {problems[0]} (θ3 = 0 at rest, joint 1-2 below) is assumed; "
        f"{problems[1]} is this project's own. Uniform rods of 1 kg/m, g = 9.81 m/s². Times and ratios therefore compare "
        "the patterns of two mechanisms of one kind, not equal runs.",
        f"★: no reasonable long-time result: the energy error exceeds {LOST:.0%} of the largest kinetic energy of the "
        "motion, or the run does not reach its end. The paper names no number, only conservation of energy, seen in y of "
        f"bar 3's centre reaching and not passing 0. The fraction was chosen here after the rows were seen; {_window(rows)}. "
        f"The energy error of Runge–Kutta with err_out = 1e-3 is {number(loose['energy'].max())} J, and y3 reaches "
        f"{number(loose['y3_max'].max())} m (0 in the true motion).",
        f"†: out of phase: y of bar 3's centre strays by more than {ASTRAY:.0%} of its range from the reference. A run "
        "without this mark follows the true motion, one with it only looks like it.",
        f"**Errors** are the largest absolute components over the run, at up to {CHECKED} evenly chosen stored instants "
        f"(the end alone flatters: the median run of the default geometry has {number(flattery)} times as large an error "
        "somewhere before it), against a one-coordinate formulation integrated apart from everything here "
        "(`references/four_bar_minimal.py`, good to 1e-12), which the tests check against the published state at 10 s. "
        "The energy error is the E − E(0) of greatest magnitude over all stored steps. Violations are taken at the "
        "chosen instants.",
        "**CPU time** is process time of the integration alone, on one core; models, compilation and checks are not in it. "
        f"Medians of repeats ({repeats}), which were run in turn; neighbouring cells show how much noise is left. Compare "
        "rows at equal error, not at equal tolerance.",
        "**Evaluations** of two-loop runs are whole evaluations, dependents and accelerations; IDA's are residuals, "
        "without those for differenced Jacobians; Exudyn counts none. They compare runs of one solver only.",
        "**PaperIRK, PaperNewmark** follow the paper to the letter where it can be followed; each difference is named "
        "in the docstrings of `paper_irk` and `paper_newmark`. `PaperIRK, Atol = Rtol varied` has err_in = 1e-9 and "
        "err_out = 1e-4 Atol: Table 3 itself varies only the tolerances of the loops, so its Runge–Kutta cells have "
        "about the same step error. What err_in costs is in the inner iterations.",
        "**IDA** through scikit-sundae, with compiled residual and Jacobian called from Python, asked for 2001 instants: "
        + "; ".join(f"`{form}` is {label}" for form, label in ida.FORMS.items())
        + f". `{IDA_C}`: {ida_c.LABEL}. IDA's error at one tolerance scatters by factors with rounding alone, so its rows "
        "are the run of median error of three whose rtol differs by 1e-5.",
        "**Exudyn**: "
        + "; ".join(f"`{solver}` is {exudyn_four_bar.SOLVERS[solver]}" for solver in EXUDYN)
        + ". Its own bodies and joints; only lengths, masses, gravity and the initial angles are shared.",
        f"**{OWN_EXPLICIT}**: an explicit method in the two loops, without an outer one; every stage is an evaluation.",
        "**LSODA; DOP853, index 1; DOP853, projected**: SciPy's, on the index-1 equations with a compiled right side (`references/index1.py`); plain "
        "they drift off the constraints, projected they do not.",
    ]
    return "\n".join(f"- {note}" for note in notes)

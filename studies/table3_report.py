"""The text and the figure of the Table 3 study, from its rows."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from references import exudyn_four_bar, ida
from studies.report import Call, markdown_table, number
from studies.runs import ASTRAY, CHECKED, LOST, cheapest

TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9)

# Table 3 as printed: [err_in][err_out] in seconds; None is the star, "no reasonable result in long time simulation"
PAPER_IRK = ((1.95, 1.98, 2.00, 2.08), (2.12, 2.23, 2.31, 2.31), (2.64, 2.85, 2.85, 2.99), (3.37, 3.46, 3.55, 3.60))
PAPER_NEWMARK = (
    (None, 2.71, 12.62, 49.73),
    (None, 2.74, 12.36, 49.68),
    (None, 3.10, 12.68, 49.66),
    (None, 3.09, 13.40, 50.93),
)

IRK, NEWMARK, QUARTER = "PaperIRK", "PaperNewmark (beta = 1/2)", "PaperNewmark, beta = 1/4"
IRK_LINE = "PaperIRK, Atol = Rtol varied"
FAMILIES = {"Table 3: IRK": IRK, "Table 3: Newmark": NEWMARK}


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


def at_equal_error(rows: pd.DataFrame, solver: str, target: float) -> float:
    """CPU time at which a solver's line reaches a deviation of y3: a log-log line through its runs."""
    line = rows[(rows["solver"] == solver) & (rows["deviation_y3"] < 0.3)]  # beyond, phase errors saturate
    if line["err_in"].notna().any():
        line = line[line["err_in"] == TOLERANCES[-1]]
    if len(line) < 2:
        return float("nan")
    slope, offset = np.polyfit(np.log(line["deviation_y3"]), np.log(line["cpu_s"]), 1)
    return float(np.exp(offset + slope * np.log(target)))


def ratios(rows: pd.DataFrame) -> list[list[str]]:
    """What the paper's table says, as ratios, beside ours."""

    def ratio(group_a: str, a: tuple[float, float], group_b: str, b: tuple[float, float], what: str) -> str:
        one, two = _cell(rows, group_a, *a), _cell(rows, group_b, *b)
        return "–" if one is None or two is None else f"{one[what] / two[what]:.2f}"

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
        counts = ratio(group_a, a, group_b, b, "n_evaluations")
        table.append([title, f"{paper:.2f}", ratio(group_a, a, group_b, b, "cpu_s"), counts])
    return table


def equal_error(rows: pd.DataFrame) -> list[list[str]]:
    """Newmark against IRK where both have the same error at the end."""
    table = []
    for target in (1e-2, 1e-3, 1e-4):
        times = [at_equal_error(rows, solver, target) for solver in (NEWMARK, QUARTER, IRK_LINE)]
        texts = [number(value) for value in times]
        table.append([f"{target:.0e}", *texts, number(times[0] / times[2]), number(times[1] / times[2])])
    return table


def comparison(rows: pd.DataFrame) -> list[list[str]]:
    """One line a run: setting, cost, errors, violations, how it ended."""
    table = []
    for _, row in rows.iterrows():
        settings = [f"{key} {row[key]:.0e}" for key in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(key))]
        ended = row["status"].lower().replace("_", " ") + _mark(row)
        numbers = [f"{row['cpu_s']:.3f}", *(number(row[c], 3) for c in ("n_steps", "n_evaluations"))]
        keys = ("error_q", "error_v", "energy", "violation_q", "violation_v")
        numbers += [number(row[key]) for key in keys]
        table.append([row["solver"], ", ".join(settings), *numbers, ended])
    return table


COMPARISON = [
    "solver",
    "setting",
    "CPU (s)",
    "steps",
    "evaluations",
    "error q (m, rad)",
    "error v",
    "energy error (J)",
    "max abs C",
    "max abs C_q v",
    "ended",
]


TARGETS = (1e-1, 1e-2, 1e-4, 1e-6, 1e-8)
WORK_PRECISION = ["solver", *(f"{target:.0e}" for target in TARGETS)]


def work_precision(rows: pd.DataFrame) -> list[list[str]]:
    """CPU time of the cheapest run of each solver below a target error."""
    return [
        [solver, *(number(cheapest(rows[rows["solver"] == solver], target), 3) for target in TARGETS)]
        for solver in dict.fromkeys(rows["solver"])
    ]


def figure(rows: pd.DataFrame, call: Call) -> None:
    """CPU time against error at the end, a panel for each geometry."""
    problems = list(dict.fromkeys(rows["problem"]))
    t_end = rows["t_end"].iloc[0]
    plot, axes = plt.subplots(1, len(problems), figsize=(11, 5), sharex=True, sharey=True, layout="constrained")
    solvers = list(dict.fromkeys(rows["solver"]))
    styles = {solver: (f"C{i % 10}", "osD^vP*X<>"[i % 10]) for i, solver in enumerate(solvers)}
    for panel, problem in zip(np.atleast_1d(axes), problems, strict=True):
        for solver in solvers:
            of_solver = (rows["problem"] == problem) & (rows["solver"] == solver) & rows["error_q"].notna()
            part = rows[of_solver].sort_values(["err_in", "cpu_s"])
            color, marker = styles[solver]
            if solver in (IRK, NEWMARK):
                panel.loglog(part["error_q"], part["cpu_s"], marker, color=color, ms=4, alpha=0.7, label=solver)
            elif len(part):
                panel.loglog(part["error_q"], part["cpu_s"], marker + "-", color=color, ms=4, lw=1, label=solver)
        panel.set(xlabel=f"position error at t = {t_end:g} s (m, rad), largest component", title=problem)
        panel.invert_xaxis() if panel is np.atleast_1d(axes)[0] else None
    np.atleast_1d(axes)[0].set_ylabel("CPU time (s)")
    np.atleast_1d(axes)[-1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    plot.suptitle(f"Cost of accuracy, four-bar linkage over {t_end:g} s: lower right is better", fontsize=10)
    plot.savefig(call.out / "table3.png")
    plt.close(plot)


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write table3.md and table3.png."""
    problems = list(dict.fromkeys(rows["problem"]))
    first = rows[rows["problem"] == problems[0]]
    second = rows[rows["problem"] == problems[1]]
    t_end = rows["t_end"].iloc[0]
    header = ["err_in \\ err_out", *(f"{e:.0e}" for e in TOLERANCES)]
    irk, newmark = FAMILIES
    parts = [
        "# Table 3: what accuracy costs, two-loop procedures beside IDA and Exudyn",
        f"Generated by {line}. Do not edit; rows in `table3.csv`.",
        _summary(first, second),
        f"## Table 3, {t_end:g} s of motion: CPU time in seconds, the paper's in brackets",
        "Two-loop procedure with Runge–Kutta (`PaperIRK`, Atol = Rtol = 1e-5):",
        markdown_table(header, grid(first, irk, time_of, PAPER_IRK)),
        "Two-loop procedure with Newmark (`PaperNewmark`, β = 1/2 as printed):",
        markdown_table(header, grid(first, newmark, time_of, PAPER_NEWMARK)),
        "## What the times hide: evaluations, steps, error",
        "Runge–Kutta: evaluations / steps / position error at the end / energy error (J):",
        markdown_table(header, grid(first, irk, _counts)),
        "Newmark: evaluations / steps / position error at the end / energy error (J):",
        markdown_table(header, grid(first, newmark, _counts)),
        "## The ratios that matter",
        markdown_table(["ratio", "paper, time", "ours, CPU time", "ours, evaluations"], ratios(first)),
        "At equal error (largest deviation of y of bar 3's centre over the run, m; log–log line through each solver's "
        "runs with err_in = 1e-9 that deviate by less than 0.3 m; entries beyond those runs are extrapolated), CPU "
        "time in seconds:",
        markdown_table(
            [
                "deviation of y3 (m)",
                "Newmark β = 1/2",
                "Newmark β = 1/4",
                IRK_LINE,
                "β = 1/2 over IRK",
                "β = 1/4 over IRK",
            ],
            equal_error(first),
        ),
        "## Other solvers, and ours at other settings",
        "![CPU time against error](table3.png)",
        "CPU time (s) of the cheapest run whose position error at the end is at most the target; – : not reached with "
        "the settings below.",
        markdown_table(WORK_PRECISION, work_precision(first)),
        "All these runs:",
        markdown_table(COMPARISON, comparison(first[first["group"] == "comparison"])),
        f"## The second geometry: {problems[1]}",
        f"Bars 1 and 2 come into line {second['n_collinear'].iloc[0]} times a period (in the first geometry "
        f"{first['n_collinear'].iloc[0]} times), so that θ3 does not last as the independent coordinate.",
        markdown_table(COMPARISON, comparison(second)),
        "## How to read this",
        _notes(rows),
    ]
    (call.out / "table3.md").write_text("\n\n".join(parts) + "\n")


def headline(rows: pd.DataFrame, line: str) -> str:
    """The table of the README: CPU time for an accuracy, default geometry."""
    first = rows[rows["problem"] == rows["problem"].iloc[0]]
    t_end = rows["t_end"].iloc[0]
    return "\n\n".join(
        [
            f"CPU time in seconds for {t_end:g} s of the linkage's motion (assumed geometry, see above) with a "
            "position error at the end of at most",
            markdown_table(WORK_PRECISION, work_precision(first)),
            f"Written by {line}. – : not reached with the settings of the study.",
        ]
    )


def _counts(cell: pd.Series) -> str:
    return " / ".join(number(cell[key], 2) for key in ("n_evaluations", "n_steps", "error_q", "energy"))


def _summary(first: pd.DataFrame, second: pd.DataFrame) -> str:
    """The findings in a few lines, every number from the rows."""
    irk, newmark = FAMILIES
    lines = []
    one, two = _cell(first, irk, 1e-9, 1e-9), _cell(first, newmark, 1e-9, 1e-9)
    if one is not None and two is not None:
        lines.append(
            f"At (err_in, err_out) = (1e-9, 1e-9) Runge–Kutta takes {one['cpu_s']:.2f} s and Newmark "
            f"{two['cpu_s']:.2f} s, {two['cpu_s'] / one['cpu_s']:.1f} times as much "
            f"({two['n_evaluations'] / one['n_evaluations']:.1f} times the evaluations); the paper printed 3.60 s, "
            f"50.93 s and 14.1 times. Their errors are not equal: {number(one['error_q'])} against "
            f"{number(two['error_q'])}."
        )
    for group, name, printed in ((newmark, "Newmark", "at err_out = 1e-03"), (irk, "Runge–Kutta", "nowhere")):
        table = first[first["group"] == group]
        lost, astray = (
            ", ".join(f"{e:.0e}" for e in sorted(table[table[key]]["err_out"].unique(), reverse=True))
            for key in ("lost", "astray")
        )
        lines.append(
            f"{name} loses the solution (★) {'at err_out = ' + lost if lost else 'nowhere'}; the paper: {printed}. "
            f"It is out of phase (†, or lost) {'at err_out = ' + astray if astray else 'nowhere'}; "
            "the paper does not say."
        )
    cells_of_table = first[first["group"].isin(FAMILIES)]
    total = (cells_of_table["cpu_s"] * cells_of_table["repeats"]).sum()
    lines.append(f"All {len(cells_of_table)} cells, repeats included, took {total:.0f} s of CPU time.")
    for solver in ("SunRadau5", "Gauss12"):
        for target in (1e-4, 1e-6):
            mine = cheapest(first[first["solver"] == solver], target)
            peers = {
                peer: cheapest(first[first["solver"] == peer], target)
                for peer in dict.fromkeys(first["solver"])
                if peer.startswith(("IDA", "Exudyn"))
            }
            known = {peer: value for peer, value in peers.items() if not np.isnan(value)}
            if known and not np.isnan(mine):
                best = min(known, key=lambda peer: known[peer])
                lines.append(
                    f"For an error of at most {target:.0e}, `{solver}` needs {mine:.3f} s; the cheapest peer, {best}, "
                    f"{known[best]:.3f} s: {known[best] / mine:.1f} times as much."
                )
    best = first.loc[first.groupby("solver")["error_q"].idxmin().dropna()]
    agreement = "; ".join(
        f"{row['solver']} {number(row['error_q'])}"
        for _, row in best.iterrows()
        if row["solver"].startswith(("SunRadau5", "Gauss12", "IDA", "Exudyn"))
    )
    lines.append(f"All agree with the reference to their own accuracy; smallest position error reached: {agreement}.")
    ours = pd.concat([first, second])
    ours = ours[~ours["solver"].str.startswith(("IDA", "Exudyn")) & (ours["err_in"].fillna(1e-9) == 1e-9)]
    lines.append(
        "Position constraints of the two-loop runs with err_in = 1e-9 are violated by "
        f"{number(ours['violation_q'].max())} at the most, over all of them and both geometries. A fresh process with "
        f"a warm cache has integrated its first millisecond {first['start_up_s'].iloc[0]:.2f} s after its start."
    )
    failed = ours[ours["status"] != "REACHED_END"]
    lines.append(f"{len(failed)} two-loop runs failed." if len(failed) else "No two-loop run failed.")
    return "\n".join(f"- {text}" for text in lines)


def _notes(rows: pd.DataFrame) -> str:
    problems = list(dict.fromkeys(rows["problem"]))
    notes = [
        f"**Assumed geometry.** Table 2 of the paper is lost. {problems[0]} (θ3 = 0 at rest, joint 1-2 below) is "
        f"assumed; {problems[1]} is chosen to pass positions where a fixed partition fails. Uniform rods of 1 kg/m, "
        "g = 9.81 m/s². Times and ratios therefore compare the patterns of two mechanisms of one kind, not equal runs.",
        f"★: no reasonable long-time result: the energy error exceeds {LOST:.0%} of the largest kinetic energy of the "
        "motion, or the run does not reach its end. Energy is the criterion the paper names; the fraction is ours. †: "
        f"out of phase: y of bar 3's centre strays by more than {ASTRAY:.0%} of its range from the reference, at one "
        f"of up to {CHECKED} evenly chosen stored instants.",
        "**Errors** are largest absolute components at the end, against a one-coordinate formulation integrated apart "
        "from everything here (`references/four_bar_minimal.py`, good to about 1e-13, carried on by the period), which "
        "the tests check against the published state at 10 s. The energy error is the largest |E − E(0)| over all "
        "stored steps. Violations are the largest over the chosen instants.",
        "**CPU time** is process time of the integration alone, on one core; models, compilation and checks are not in "
        "it. Cells and comparison rows are medians of three runs (Exudyn with h = 1e-4, and the cells of the second "
        "geometry: one run). Compare rows at equal error, not at equal tolerance.",
        "**PaperIRK, PaperNewmark** follow the paper to the letter where it can be followed; each difference is named "
        "in the docstrings of `paper_irk` and `paper_newmark`. `PaperIRK, Atol = Rtol varied` has err_in = 1e-9 and "
        "err_out = 1e-4 Atol: Table 3 itself varies only the tolerances of the loops, so its Runge–Kutta cells have "
        "about the same step error.",
        "**IDA** (SUNDIALS through scikit-sundae, compiled residual and Jacobian called from Python): "
        + "; ".join(f"`{form}` is {label}" for form, label in ida.FORMS.items())
        + ". IDA's error at one tolerance scatters by factors with rounding alone, so its rows are the run of median "
        "error of three whose rtol differs by 1e-5. Its callbacks pass through Python, which costs "
        "a few microseconds a call; driven from C, IDA would be faster (not measured here).",
        "**Exudyn**: "
        + "; ".join(f"`{solver}` is {label}" for solver, label in exudyn_four_bar.SOLVERS.items())
        + ". Its own bodies and joints; only lengths, masses, gravity and the initial angles are shared. It counts no "
        "evaluations.",
        "**Not in this table**: explicit codes on the index-1 equations, such as SciPy's DOP853. They drift off the "
        "constraints, but on a smooth problem like this one they are cheap, and a claim of efficiency against them "
        "would need their rows.",
    ]
    return "\n".join(f"- {note}" for note in notes)

"""The text and the figures of the step-size study, from its rows and curves."""

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from studies.report import Array, Call, markdown_table, number
from studies.solvers import IRK, NEWMARK, QUARTER

LONG = 0.02  # s; the paper: Runge-Kutta steps are longer than this most of the time
IDA_STEPS = "IDA, stabilised"
ZOOMED = (IRK, NEWMARK, QUARTER, "SunRadau5", "Gauss12", "BDF", IDA_STEPS, "LSODA, index 1", "DOP853, projected")

MARKS = {  # curve: (marker, colour, label)
    "error": ("x", "black", "PaperIRK: error too large, shortened to this step"),
    "convergence": ("v", "tab:red", "PaperIRK: not converged, shortened to this step"),
}


def key(row: pd.Series, kind: str) -> str:
    """Name of a curve of this row in the saved series."""
    return f"{row['solver']} {_setting(row)} {kind}"


def _setting(row: pd.Series) -> str:
    return next(f"{name} {row[name]:.0e}" for name in ("err_out", "tol") if pd.notna(row.get(name)))


def _row(rows: pd.DataFrame, solver: str) -> pd.Series | None:
    """The row of a solver, of the loosest tolerance if there are several."""
    found = rows[rows["solver"] == solver]
    return None if found.empty else found.iloc[0]


def summary(rows: pd.DataFrame) -> list[str]:
    """The findings, every number from the rows."""
    irk, newmark, quarter = (_row(rows, solver) for solver in (IRK, NEWMARK, QUARTER))
    assert irk is not None and newmark is not None and quarter is not None
    verdict = "holds" if irk["share_time"] > 0.5 else "does not hold"
    lines = [
        f"PaperIRK at the paper's settings: {irk['share_steps']:.1%} of its steps are longer than {LONG:g} s, and they cover "
        f"{irk['share_time']:.2%} of the time; the median is {number(irk['h_median'])} s, 5 % are shorter than "
        f"{number(irk['h_low'])} s, 5 % longer than {number(irk['h_high'])} s. The paper: longer than 0.02 s most of the "
        f"time. That {verdict} here.",
        f"PaperNewmark at the paper's settings: the median is {number(newmark['h_median'])} s with β = 1/2 and "
        f"{number(quarter['h_median'])} s with β = 1/4, {number(irk['h_median'] / newmark['h_median'])} and "
        f"{number(irk['h_median'] / quarter['h_median'])} times shorter than PaperIRK's; {newmark['share_steps']:.0%} of its "
        f"steps are longer than {LONG:g} s.",
        f"PaperIRK repeats {irk['retried']:.0%} of its steps: {irk['n_rejected_error']:.0f} attempts fail the error test and "
        f"{irk['n_rejected_convergence']:.0f} do not converge, for {irk['n_steps']:.0f} steps accepted. PaperNewmark: "
        f"{newmark['n_rejected_error']:.0f} and {newmark['n_rejected_convergence']:.0f} for {newmark['n_steps']:.0f}.",
    ]
    known = rows[rows["retried"].notna()].sort_values("retried", ascending=False)
    texts = [f"{row['solver']} ({_setting(row)}) {row['retried']:.1%}" for _, row in known.iterrows()]
    lines.append(f"Steps that needed more than one attempt: {', '.join(texts)}.")
    switches = [
        f"{row['solver']} ({_setting(row)}) {row['retried_switch']:.0%} against {row['retried']:.0%}"
        for _, row in known.iterrows()
        if row["group"] != "paper"
    ]
    lines.append(
        f"PaperIRK changes its independent coordinates {irk['n_partitions'] - 1:.0f} times in {irk['t_end']:g} s, "
        f"{(irk['n_partitions'] - 1) / (irk['t_end'] / irk['period']):.1f} times a period. Of the steps before which they "
        f"changed, more than one attempt needed (a failed attempt may be the reason for the change): PaperIRK {irk['retried_switch']:.0%} against {irk['retried']:.0%} of all steps; "
        f"{'; '.join(switches)}."
    )
    return lines


TABLE = (
    "solver", "setting", "steps", "median h (s)", "5 % below (s)", "5 % above (s)", "longest (s)",
    f"steps > {LONG:g} s", f"time in steps > {LONG:g} s", "rejected, error", "rejected, convergence", "steps retried",
    "… at a switch", "switches", "evaluations", "error q (m, rad)", "ended",
)  # fmt: skip


def table(rows: pd.DataFrame) -> list[list[str]]:
    """One line a run."""
    lines = []
    for _, row in rows.iterrows():
        sizes = [number(row[name]) for name in ("h_median", "h_low", "h_high", "h_max")]
        shares = [f"{row[name]:.1%}" for name in ("share_steps", "share_time")]
        rejected = [number(row[name], 3) for name in ("n_rejected_error", "n_rejected_convergence")]
        retried = [f"{row[name]:.1%}" if pd.notna(row[name]) else "–" for name in ("retried", "retried_switch")]
        rest = [number(row["n_partitions"] - 1, 3), number(row["n_evaluations"], 3), number(row["error_q"])]
        ended = row["status"].lower().replace("_", " ")
        steps = [number(row["n_steps"], 3)]
        lines.append([row["solver"], _setting(row), *steps, *sizes, *shares, *rejected, *retried, *rest, ended])
    return lines


def report(rows: pd.DataFrame, line: str, call: Call) -> None:
    """Write step_size.md."""
    parts = [
        "# Step size against time (Fig. 6 of the paper)",
        f"Generated by {line}. Do not edit; rows in `step_size.csv`, curves in `step_size_series.npz`.",
        "\n".join(f"- {text}" for text in summary(rows)),
        "## The paper's procedures at the paper's settings",
        "![Step sizes of the paper's procedures](step_size.png)",
        f"Accepted steps over the whole run and, enlarged, over two periods ({2 * rows['period'].iloc[0]:.3f} s); of runs of many "
        f"steps the band from the shortest to the longest. The dotted line is the paper's {LONG:g} s. Marks stand at steps before "
        "which attempts were rejected; grey lines where other coordinates became independent. Below, the height of bar 3's centre.",
        "## Other solvers with adaptive steps",
        "![Step sizes of other solvers](step_size_others.png)",
        "The same for other methods and solvers at the loosest tolerance of the table; their errors differ, see the table.",
        "## All runs",
        markdown_table(list(TABLE), table(rows)),
        "## How to read this",
        _notes(rows),
    ]
    (call.out / "step_size.md").write_text("\n\n".join(parts) + "\n")


def _notes(rows: pd.DataFrame) -> str:
    notes = [
        f"**Assumed geometry.** Table 2 of the paper is lost: {rows['problem'].iloc[0]} is assumed.",
        "**Settings**: `err_out` with err_in = 1e-9, and Atol = Rtol = 1e-5 for PaperIRK; `tol` = rtol = atol. Steps at one "
        "tolerance are not steps at one error: see “error q”, the largest position error over the run.",
        "**A step of Runge–Kutta** here is the h of one large and two half steps (Richardson), as in the paper; each of the three "
        "has three stages (six with Gauss12). A step of DOP853 has twelve, none of Richardson's; of Newmark or IDA one. Cost is in the evaluations, not in the steps.",
        "**Rejected attempts and switches** are recorded by the run itself, before each accepted step "
        "(`Result.rejected_error`, `.rejected_convergence`, `.partitioned`). “Steps retried” is the share of accepted steps before "
        "which an attempt was rejected; “at a switch” the same among the steps before which other coordinates became "
        "independent, be it after the step before or because an attempt failed in the inner loop. Other people's solvers do not tell.",
        "**IDA** is asked here for every step, in the form stabilised; SciPy's steps are those of its solvers.",
    ]
    return "\n".join(f"- {note}" for note in notes)


def figures(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    """Draw both figures."""
    _paper(rows, series, call)
    _others(rows, series, call)


def _mark(panel: plt.Axes, row: pd.Series, series: dict[str, Array]) -> None:
    """Mark rejected attempts, and draw a line where the partition changed."""
    for name, (marker, color, label) in MARKS.items():
        if key(row, name) in series:
            panel.plot(*series[key(row, name)], marker, color=color, ms=4.5, label=label, zorder=4)
    for moment in series.get(key(row, "switch"), np.empty((2, 0)))[0]:
        panel.axvline(moment, color="black", alpha=0.2, lw=1)


def _paper(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    plot, (whole, zoom, motion) = plt.subplots(
        3, 1, figsize=(9.5, 8.5), layout="constrained", height_ratios=(3, 4, 1.2)
    )
    for solver, color in ((IRK, "tab:blue"), (QUARTER, "tab:olive"), (NEWMARK, "tab:orange")):
        row = _row(rows, solver)
        assert row is not None
        for panel, kind in ((whole, "whole"), (zoom, "zoom")):
            panel.semilogy(*series[key(row, kind)], color=color, lw=0.8, drawstyle="steps-post", label=solver)
        if solver == IRK:
            _mark(zoom, row, series)
    for panel in (whole, zoom):
        panel.axhline(LONG, color="black", lw=1, ls=":")
        panel.text(1.0, LONG, " 0.02 s", transform=panel.get_yaxis_transform(), va="center", fontsize=8)
        panel.set(ylabel="step size (s)", ylim=(3e-5, 0.3))
    whole.legend(fontsize=8, loc="lower right", ncols=3)
    handles, labels = zoom.get_legend_handles_labels()
    kept = [(handle, label) for handle, label in zip(handles, labels, strict=True) if "shortened" in label]
    zoom.legend(*zip(*kept, strict=True), fontsize=8, loc="lower left", ncols=2)
    motion.plot(*series["truth"], color="black", lw=1)
    motion.set(xlabel="t (s)", ylabel="y3 (m)", xlim=zoom.get_xlim())
    whole.set_title("Step sizes at the settings of the paper, whole run and first two periods", fontsize=10)
    plot.savefig(call.out / "step_size.png")
    plt.close(plot)


def _others(rows: pd.DataFrame, series: dict[str, Array], call: Call) -> None:
    shown = [row for row in (_row(rows, s) for s in ZOOMED if s not in (IRK, NEWMARK, QUARTER)) if row is not None]
    n_rows = -(-len(shown) // 3)
    plot, axes = plt.subplots(
        n_rows, 3, figsize=(11, 2.6 * n_rows + 0.6), sharex=True, sharey=True, layout="constrained", squeeze=False
    )
    for panel, row in zip(axes.flat, shown, strict=False):
        panel.semilogy(*series[key(row, "zoom")], color="tab:blue", lw=0.9, drawstyle="steps-post")
        _mark(panel, row, series)
        panel.set_title(f"{row['solver']}, {_setting(row)}: error {number(row['error_q'])}", fontsize=8.5)
    for panel in list(axes.flat)[len(shown) :]:
        panel.set_visible(False)
    for panel in list(axes.flat)[: len(shown)][-3:]:  # the lowest of each column
        panel.set_xlabel("t (s)")
        panel.tick_params(labelbottom=True)
    for panel in axes[:, 0]:
        panel.set_ylabel("step size (s)")
    axes[0, 0].set_ylim(1e-4, 0.4)
    plot.suptitle(
        "Step sizes over the first two periods (× error too large, ▼ not converged, grey lines: new independent coordinates)",
        fontsize=9.5,
    )
    plot.savefig(call.out / "step_size_others.png")
    plt.close(plot)

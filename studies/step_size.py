"""Fig. 6 of the paper: step size against time, with rejected attempts and changes of the independent coordinates."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from references.four_bar_minimal import MinimalFourBar
from references.ida import solve_ida
from studies import figures, study, tables
from studies.bench import Case, Run, Solver, collect
from studies.cases import four_bar
from studies.cases.four_bar import Y3
from studies.cli import StudyError
from studies.render import number, percent, power, render, table
from studies.solvers import CATALOGUE, IRK, NEWMARK, PRESETS, QUARTER
from studies.store import Output
from twoloop import Result

Array = NDArray[np.floating]

LONG = 0.02  # s; the paper: Runge-Kutta steps are longer than this most of the time
ERR_OUT = 1e-9
TOLERANCES = (1e-5, 1e-8)
OTHERS = ("LSODA, index 1", "DOP853, projected")
PAPER = (IRK, QUARTER, NEWMARK)
PERIODS = 2.0  # that the figure enlarges
CURVE = 1200  # steps that a figure draws one by one; of more, the shortest and the longest in each of half as many bins
MARKS = {"error": ("x", "error too large, shortened"), "convergence": ("v", "not converged, shortened")}


def _ida(case: Case, tolerance: float, repeat: int) -> Result:
    problem = case.problem
    span = (0.0, case.t_end)
    return solve_ida(problem.system, span, problem.q0, problem.v0, "stabilised", tolerance, tolerance)


def runs(case: Case, quick: bool) -> list[Run]:
    """The paper's procedures at its settings; the other adaptive solvers at Atol = Rtol of the paper and tighter."""
    made = [Run(case, CATALOGUE[name], ERR_OUT, "paper", 1) for name in (IRK, NEWMARK, QUARTER)]
    # the catalogue's IDA stores its states at common instants only, and not its steps
    ida = Solver("IDA, stabilised", "SUNDIALS", "Python", True, "tol", _ida, own_accelerations=True)
    for tolerance in TOLERANCES[:1] if quick else TOLERANCES:
        names = [name for name in PRESETS if name != "Newmark" or tolerance == TOLERANCES[0]]  # of order 2
        made += [Run(case, CATALOGUE[name], tolerance, "two-loop", 1) for name in names]
        others = [*([] if quick else [ida]), *(CATALOGUE[name] for name in OTHERS)]
        made += [Run(case, solver, tolerance, "others", 1) for solver in others]
    return made


def measure(period: float, run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study, and the curves of the figure in the entry "series"; the period of the motion is in s."""
    h, stats = result.h, result.stats
    row: dict[str, Any] = {"period": period, "series": {}}
    row |= {"n_rejected_error": stats.n_rejected_error, "n_rejected_convergence": stats.n_rejected_convergence}
    row |= {"retried": None, "retried_switch": None}
    if h.size == 0:
        return row
    starts = np.concatenate([[0.0], np.cumsum(h)[:-1]])
    row |= {"h_median": np.median(h), "h_low": np.quantile(h, 0.05), "h_high": np.quantile(h, 0.95), "h_max": h.max()}
    row |= {"share_steps": np.mean(h > LONG), "share_time": h[h > LONG].sum() / h.sum()}
    zoom = starts < PERIODS * period
    if run.group == "paper":
        row["series"] = {"whole": _curve(starts, h), "zoom": _curve(starts[zoom], h[zoom])}
    if result.rejected_error is not None and result.partitioned is not None:
        assert result.rejected_convergence is not None
        retried, switched = result.rejected_error + result.rejected_convergence > 0, result.partitioned > 0
        row["retried"] = retried.mean()
        row["retried_switch"] = retried[switched].mean() if switched.any() else None
        if run.group == "paper":
            counts = (("error", result.rejected_error), ("convergence", result.rejected_convergence))
            for name, count in (*counts, ("switch", result.partitioned)):
                marked = zoom & (count > 0)
                row["series"][name] = np.array([starts[marked], h[marked]])
    return row


def _curve(t: Array, h: Array) -> Array:
    """Steps to draw, (2, n): all, or of many the shortest and the longest in each of evenly spaced bins of time."""
    if t.size <= CURVE:
        return np.array([t, h])
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], CURVE // 2 + 1)[1:-1])
    parts = [np.sort(part) for part in np.split(h, edges)]
    bins = [(begin, part) for begin, part in zip(np.split(t, edges), parts, strict=True) if part.size]
    return np.array([(times[0], size) for times, part in bins for size in (part[0], part[-1])]).T


def make(output: Output) -> tuple[pd.DataFrame, dict[str, Array]]:
    """Make all rows, and the curves of the figure."""
    quick = output.call.quick
    told = four_bar.cases(quick)[0]
    case = four_bar.case(told.problem, told.name, told.t_end, timed=0.0)  # times are not compared here
    period = MinimalFourBar.from_parameters(case.problem.parameters).period
    with output.kept() as kept:
        rows = collect(runs(case, quick), kept, partial(measure, period))
    series: dict[str, Array] = {}
    for _, row in rows.iterrows():
        curves = row["series"] if isinstance(row["series"], dict) else {}
        series |= {f"{row['solver']} {name}": np.array(curve, dtype=float) for name, curve in curves.items()}
    grid = np.linspace(0.0, PERIODS * period, 400)
    series["truth"] = np.array([grid, case.reference.states(grid)[0][Y3]])
    return rows.drop(columns="series"), series


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """What the report says, from the medians."""
    paper = rows[rows["group"] == "paper"].set_index("solver")
    if not set(PAPER) <= set(paper.index[paper["h_median"].notna()]):
        raise StudyError("the rows lack the paper's procedures; make them again by python -m studies.step_size")
    irk, newmark, quarter = (paper.loc[name] for name in (IRK, NEWMARK, QUARTER))
    keys = ("share_steps", "share_time", "h_median", "h_low", "h_high", "retried", "error_q")
    counted = ("n_steps", "n_rejected_error", "n_rejected_convergence")
    known = rows[rows["retried_switch"].notna()]
    ratios = [irk["h_median"] / run["h_median"] for run in (newmark, quarter)]
    per_step = [run["n_evaluations"] / run["n_steps"] for run in (irk, newmark, quarter)]
    return {
        "t_end": float(rows["t_end"].iloc[0]),
        "problem": rows["problem"].iloc[0],
        "period": float(irk["period"]),
        "long": LONG,
        "irk": {key: float(irk[key]) for key in keys} | {key: int(irk[key]) for key in counted},
        "newmark": {key: float(newmark[key]) for key in keys} | {key: int(newmark[key]) for key in counted},
        "holds": bool(irk["share_time"] > 0.5),
        "ratios": [float(ratio) for ratio in ratios],
        "longer": min(ratios) > 1.0,
        "evaluations_per_step": [float(count) for count in per_step],
        # evaluations for a second of motion
        "evaluations_ratio": [float(run["n_evaluations"] / irk["n_evaluations"]) for run in (newmark, quarter)],
        "retries_more": bool(irk["retried"] > newmark["retried"]),
        "switches_per_period": float((irk["n_partitions"] - 1) / (irk["t_end"] / irk["period"])),
        "switches": int(irk["n_partitions"] - 1),
        "n_known": len(known),
        "n_worse_at_switch": int((known["retried_switch"] > known["retried"]).sum()),
        "n_failed": int((rows["status"] != "REACHED_END").sum()),
    }


def setting(row: pd.Series) -> str:
    """Name and value of the setting that varies."""
    return next(f"{name} {power(row[name])}" for name in ("err_out", "tol") if pd.notna(row.get(name)))


def all_runs(rows: pd.DataFrame) -> str:
    """One line a run."""
    header = ["solver", "setting", "error", "steps", "median h (s)", "5 % below (s)", "5 % above (s)"]
    header += [f"time in steps > {LONG:g} s", "rejected: error", "rejected: convergence", "steps retried"]
    header += ["retried at a switch", "switches", "evaluations"]
    lines = []
    for _, row in rows[rows["h_median"].notna()].iterrows():
        shares = [percent(row[key]) if pd.notna(row[key]) else "not told" for key in ("retried", "retried_switch")]
        counts = [
            "not told" if pd.isna(row[f"n_rejected_{why}"]) else number(int(row[f"n_rejected_{why}"])) for why in MARKS
        ]
        cells = [row["solver"], setting(row), number(row["error_q"]), number(int(row["n_steps"]))]
        cells += [number(row[key]) for key in ("h_median", "h_low", "h_high")]
        switches = "none" if pd.isna(row["n_partitions"]) else number(int(row["n_partitions"]) - 1)
        lines.append([*cells, percent(row["share_time"]), *counts, *shares, switches, number(row["n_evaluations"])])
    return table(header, lines)


def over_time(series: dict[str, Array]) -> Figure:
    """Steps of the paper's procedures: the whole run, two periods, and the motion below."""
    figure, (whole, zoom, motion) = plt.subplots(
        3, 1, figsize=(9.2, 7.2), layout="constrained", height_ratios=(3, 4, 1.4)
    )
    for panel, name in ((whole, "whole"), (zoom, "zoom")):
        for solver in PAPER:
            look: dict[str, Any] = {**figures.style(solver), "marker": "", "linewidth": 0.9}
            panel.plot(*series[f"{solver} {name}"], label=solver, drawstyle="steps-post", **look)
        panel.axhline(LONG, color=figures.RED, lw=1.0, ls=":", label=f"{LONG:g} s, of the paper")
        panel.set(ylabel="step size (s)", yscale="log")
    _mark(zoom, series)
    zoom.set_title(f"the first {PERIODS:g} periods, with rejected attempts of {IRK}", fontsize=9)
    whole.set(title="", xlabel="t (s)")
    motion.plot(*series["truth"], color="black", lw=1.0)
    motion.set(xlabel="t (s)", ylabel="y3 (m)", xlim=zoom.get_xlim())
    figure.legend(*zoom.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _mark(panel: Axes, series: dict[str, Array]) -> None:
    """Mark PaperIRK's steps before which attempts were rejected; lines where the coordinates changed."""
    for (name, (marker, what)), color in zip(MARKS.items(), (figures.RED, figures.BLUE), strict=True):
        if series[f"{IRK} {name}"].size:
            panel.plot(*series[f"{IRK} {name}"], marker, color=color, ms=4.5, label=what, zorder=4)
    for k, moment in enumerate(series[f"{IRK} switch"][0] if series[f"{IRK} switch"].size else ()):
        panel.axvline(moment, color="black", alpha=0.25, lw=1.0, label="" if k else "new independent coordinates")


def ranges(rows: pd.DataFrame) -> Figure:
    """Median and middle nine tenths of the steps of each solver at the looser tolerance, and its error."""
    shown = rows[(rows["tol"] == TOLERANCES[0]) & (rows["group"] != "paper") & rows["h_median"].notna()]
    shown = shown.sort_values("h_median", ignore_index=True)
    figure, panel = plt.subplots(figsize=(7.2, 0.32 * len(shown) + 1.1), layout="constrained")
    for k, row in shown.iterrows():
        look: dict[str, Any] = {**figures.style(row["solver"], row["family"], bool(row["keeps_constraints"]))}
        panel.plot([row["h_low"], row["h_high"]], [k, k], color=look["color"], lw=2.5, alpha=0.6)
        panel.plot(row["h_median"], k, **(look | {"linestyle": ""}))
    labels = [f"{row['solver']} (error {number(row['error_q'])})" for _, row in shown.iterrows()]
    panel.set_yticks(range(len(shown)), labels)
    panel.set(xscale="log", xlabel=f"step size (s) at tolerance {power(TOLERANCES[0])}: median, and 90 % of the steps")
    panel.grid(axis="y", visible=False)
    return figure


def report(output: Output, rows: pd.DataFrame, series: dict[str, Array], line: str) -> dict[str, Any]:
    """Write findings, figures and report; the findings."""
    rows = tables.medians(rows)
    found = findings_of(rows)
    output.save_findings(found)
    figures.save(over_time(series), output, "step_size")
    figures.save(ranges(rows), output, "step_size_others")
    ready = {
        "all": all_runs(rows),
        "failed": table(["solver", "setting", "status", "message"], tables.failures(rows)),
    }
    output.write("step_size.md", render("step_size", found, ready, stamp=line, quick=output.call.quick))
    return found


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    study.run("step_size", __doc__, words, make, report)


if __name__ == "__main__":
    main()

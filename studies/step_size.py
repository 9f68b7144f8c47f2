"""Fig. 6 of the paper: step size against time, with rejected attempts and changes of the independent coordinates."""

from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.sundials.ida import solve_ida
from studies.bench import figures
from studies.bench.cases import four_bar
from studies.bench.cases.four_bar import Y3
from studies.bench.cli import StudyError
from studies.bench.collector import Run, Solver
from studies.bench.solvers import CATALOGUE, GIVEN, IRK, NEWMARK, PRESETS, QUARTER
from studies.bench.store import Array
from studies.bench.study import Study, rows_of
from studies.bench.tables import setting
from twoloop import Result

LONG = 0.02  # s; the paper: Runge-Kutta steps are longer than this most of the time
ERR_OUT, TOL = 1e-9, 1e-5  # of the paper's procedures; Atol = Rtol of all others, as of the paper
OTHERS = ("LSODA, index 1", "DOP853, projected")
PAPER = (IRK, QUARTER, NEWMARK)
PERIODS = 2.0  # that the figure enlarges
CURVE = 1200  # steps that a figure draws one by one; of more, the shortest and the longest in each of half as many bins
MARKS = {"error": ("x", "error too large, shortened"), "convergence": ("v", "not converged, shortened")}


def runs(quick: bool) -> list[Run]:
    """The paper's procedures at its settings; the other adaptive solvers at its Atol = Rtol."""
    case = replace(four_bar.cases(quick)[0], timed=0.0)  # times are not compared here
    made = [Run(case, CATALOGUE[name], ERR_OUT, "paper", 1) for name in (IRK, NEWMARK, QUARTER)]
    made += [Run(case, CATALOGUE[name], TOL, "two-loop", 1) for name in (GIVEN, *PRESETS)]
    # the catalogue's IDA stores its states at common instants only, and not its steps
    run = lambda case, tol, _: solve_ida(*case.start, "stabilised", tol, tol)  # noqa: E731
    ida = Solver("IDA, stabilised", "SUNDIALS", "Python", True, "tol", run, own_accelerations=True)
    others = [*([] if quick else [ida]), *(CATALOGUE[name] for name in OTHERS)]
    return made + [Run(case, solver, TOL, "others", 1) for solver in others]


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study, and the curves of the figure in the entry "series"."""
    h, stats = result.h, result.stats
    row: dict[str, Any] = {"series": {}, "retried": None, "retried_switch": None}
    row |= {"n_rejected_error": stats.n_rejected_error, "n_rejected_convergence": stats.n_rejected_convergence}
    if h.size == 0:
        return row
    starts = np.concatenate([[0.0], np.cumsum(h)[:-1]])
    row |= {"h_median": np.median(h), "h_low": np.quantile(h, 0.05), "h_high": np.quantile(h, 0.95)}
    row["share_time"] = h[h > LONG].sum() / h.sum()
    zoom = starts < PERIODS * four_bar.period()
    curves = {"whole": _curve(starts, h), "zoom": _curve(starts[zoom], h[zoom])}
    if result.rejected_error is not None and result.partitioned is not None:
        assert result.rejected_convergence is not None
        retried, switched = result.rejected_error + result.rejected_convergence > 0, result.partitioned > 0
        row["retried"] = retried.mean()
        row["retried_switch"] = retried[switched].mean() if switched.any() else None
        counts = {"error": result.rejected_error, "convergence": result.rejected_convergence}
        for name, count in (counts | {"switch": result.partitioned}).items():
            marked = zoom & (count > 0)
            curves[name] = np.array([starts[marked], h[marked]])
    return row | {"series": curves if run.group == "paper" else {}}


def _curve(t: Array, h: Array) -> Array:
    """Steps to draw, (2, n): all, or of many the shortest and the longest in each of evenly spaced bins of time."""
    if t.size <= CURVE:
        return np.array([t, h])
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], CURVE // 2 + 1)[1:-1])
    parts = [np.sort(part) for part in np.split(h, edges)]
    bins = [(begin, part) for begin, part in zip(np.split(t, edges), parts, strict=True) if part.size]
    return np.array([(times[0], size) for times, part in bins for size in (part[0], part[-1])]).T


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    paper = rows[rows["group"] == "paper"].set_index("solver")
    if not set(PAPER) <= set(paper.index[paper["h_median"].notna()]):
        raise StudyError("the rows lack the paper's procedures; make them again by python -m studies.step_size")
    irk, newmark, quarter = (paper.loc[name] for name in (IRK, NEWMARK, QUARTER))
    names = ("share_time", "h_median", "retried")
    counts = ("n_steps", "n_rejected_error", "n_rejected_convergence")
    ratios = [float(irk["h_median"] / run["h_median"]) for run in (newmark, quarter)]
    known = rows[rows["retried_switch"].notna()]
    told = ("solver", "error_q", "n_steps", *names, "retried_switch", "n_evaluations")
    listed = rows[rows["h_median"].notna()]
    switches = int(irk["n_partitions"] - 1)
    found: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "problem": rows["problem"].iloc[0]}
    found |= {"period": four_bar.period(), "long": LONG}
    found |= {"irk": {name: float(irk[name]) for name in names} | {name: int(irk[name]) for name in counts}}
    found |= {"newmark": {"retried": float(newmark["retried"])}, "holds": bool(irk["share_time"] > 0.5)}
    found |= {"ratios": ratios, "longer": min(ratios) > 1.0}
    found |= {"evaluations_per_step": [float(run["n_evaluations"] / run["n_steps"]) for run in (irk, newmark, quarter)]}
    found |= {"evaluations_ratio": [float(run["n_evaluations"] / irk["n_evaluations"]) for run in (newmark, quarter)]}
    found |= {"switches": switches, "switches_per_period": switches / float(irk["t_end"] / four_bar.period())}
    found |= {"runs": [{name: row[name] for name in told} | {"setting": setting(row)} for _, row in listed.iterrows()]}
    return found | {"n_known": len(known), "n_worse_at_switch": int((known["retried_switch"] > known["retried"]).sum())}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Steps of the paper's procedures: the whole run, two periods with what was rejected, and the motion below."""
    figure, axes = plt.subplots(3, 1, figsize=(9.2, 7.2), layout="constrained", height_ratios=(3, 4, 1.4))
    whole, zoom, motion = axes
    paper = rows[rows["group"] == "paper"].set_index("solver", drop=False).loc[list(PAPER)]
    for panel, name in ((whole, "whole"), (zoom, "zoom")):
        for _, row in paper.iterrows():
            look = figures.look(row, coded=True) | {"marker": "", "linewidth": 0.9}
            panel.plot(*row["series"][name], drawstyle="steps-post", **look)
        panel.axhline(LONG, color=figures.RED, lw=1.0, ls=":", label=f"{LONG:g} s: mostly exceeded in the paper")
        panel.set(ylabel="step size (s)", yscale="log")
    places = paper.loc[IRK, "series"]
    for (name, (marker, what)), color in zip(MARKS.items(), (figures.RED, figures.BLUE), strict=True):
        if places[name].size:
            zoom.plot(*places[name], marker, color=color, ms=4.5, label=what, zorder=4)
    for moment in places["switch"][0] if places["switch"].size else ():
        zoom.axvline(moment, color="black", alpha=0.25, lw=1.0, label="new independent coordinates")
    zoom.set_title(f"the first {PERIODS:g} periods, with rejected attempts of {IRK}", fontsize=9)
    whole.set(title="", xlabel="t (s)")
    grid = np.linspace(0.0, PERIODS * four_bar.period(), 400)
    motion.plot(grid, four_bar.cases(False)[0].reference.states(grid)[0][Y3], color="black", lw=1.0)
    motion.set(xlabel="t (s)", ylabel="y3 (m)", xlim=zoom.get_xlim())
    figures.legend(figure, [zoom])
    return {"step_size": figure}


STUDY = Study("step_size", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)

if __name__ == "__main__":
    STUDY.main()

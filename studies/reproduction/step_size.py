"""Fig. 6 of the paper: step size over time."""

from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures, four_bar
from studies.bench.cli import StudyError
from studies.bench.collector import Run
from studies.bench.render import number
from studies.bench.solvers import CATALOGUE, GIVEN, IRK, NEWMARK, QUARTER
from studies.bench.store import Array
from twoloop import Result

LONG = 0.02  # s; the paper: Runge-Kutta steps are longer than this most of the time
ERR_OUT, TOL = 1e-9, 1e-5  # of the paper's procedures; Atol = Rtol of the default, as of the paper
PAPER = (IRK, NEWMARK, QUARTER)
PERIODS = 2.0  # of the motion, at the start, that the figure shows
CURVE = 1200  # most points of a curve: of more steps, the shortest and the longest in each of half as many bins
COLUMNS = ("h_median", "n_evaluations")


def runs(quick: bool) -> list[Run]:
    """List the paper's procedures at its settings, and the default at its Atol = Rtol."""
    case = replace(four_bar.cases(quick)[0], timed=0.0)  # times are not compared here
    paper = [Run(case, CATALOGUE[name], ERR_OUT, "paper", 1) for name in PAPER]
    return [*paper, Run(case, CATALOGUE[GIVEN], TOL, "two-loop", 1)]


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Measure the steps, and sample the curve of the figure ("series")."""
    h = result.h
    row: dict[str, Any] = {"series": {}, "retried": None}
    if h.size == 0:
        return row
    row |= {"h_median": np.median(h), "share_time": h[h > LONG].sum() / h.sum()}
    if result.rejected_error is not None and result.rejected_convergence is not None:
        row["retried"] = (result.rejected_error + result.rejected_convergence > 0).mean()
    starts = np.concatenate([[0.0], np.cumsum(h)[:-1]])
    zoom = starts < PERIODS * four_bar.period()
    return row | {"series": {"zoom": thinned(starts[zoom], h[zoom])}}


def thinned(t: Array, h: Array) -> Array:
    """Return the steps to draw, (2, n): all, or of many the shortest and the longest in even bins of time."""
    if t.size <= CURVE:
        return np.array([t, h])
    edges = np.searchsorted(t, np.linspace(t[0], t[-1], CURVE // 2 + 1)[1:-1])
    bins = [(x, y) for x, y in zip(np.split(t, edges), np.split(h, edges), strict=True) if x.size]
    return np.array([(x[0], size) for x, y in bins for size in (y.min(), y.max())]).T


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    runs = rows[(rows["group"] == "paper") | (rows["solver"] == GIVEN)].set_index("solver")
    if not set(PAPER) <= set(runs.index[runs["h_median"].notna()]):
        raise StudyError("the rows lack the paper's procedures; run python -m studies.reproduction step_size")
    share, irk = float(runs.loc[IRK, "share_time"]), runs.loc[IRK, "h_median"]
    ratios = sorted(float(irk / h) for h in runs.loc[[NEWMARK, QUARTER], "h_median"])
    found = {"long": LONG, "share_time": share, "holds": share > 0.5, "longer": ratios[0] > 1.0, "ratios": ratios}
    return found | {"runs": [{"solver": name, **run[list(COLUMNS)]} for name, run in runs.iterrows()]}


def figure_of(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw the steps of the paper's procedures over two periods of the motion."""
    figure, panel = plt.subplots(figsize=(7.6, 3.8), layout="constrained")
    for _, row in rows[rows["group"] == "paper"].iterrows():
        look = figures.look(row, coded=True) | {"marker": "", "linewidth": 0.9}
        panel.plot(*row["series"]["zoom"], drawstyle="steps-post", **look)
    panel.axhline(LONG, color=figures.RED, lw=1.0, ls=":", label=f"{LONG:g} s")
    panel.set(xlabel="t (s)", ylabel="step size (s)", yscale="log")
    least, most = found["ratios"]
    figures.message(
        figure, f"PaperIRK's steps are {number(least)} to {number(most)} times as long as PaperNewmark's", panel
    )
    return figure

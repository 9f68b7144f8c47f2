"""Figs. 2-5 of the paper: the height y3 of bar 3's centre over 2 s and over 100 s."""

from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import figures, four_bar
from studies.bench.cli import StudyError
from studies.bench.collector import Run
from studies.bench.four_bar import Y3
from studies.bench.metrics import deviation
from studies.bench.solvers import CATALOGUE, GEAR_ORDERS, IRK, NEWMARK, gear
from studies.bench.tables import where
from twoloop import Result

VISIBLE = 0.01  # m, about the width of a line in a figure of the motion
PASSES = 1e-3  # m above 0 from which y3 passes the line, and below it to which it reaches it
COARSE, MIDDLE = 0.02, 0.01  # s, steps of Gstiff in the paper
STEPS = (COARSE, MIDDLE, 0.005, 0.002, 0.001)
FINE = 0.002  # s, spacing at which y3 and its error are evaluated, between the steps as well
SHORT, LAST = 2.0, 5.0  # s: Fig. 2 of the paper, and the end of the run that the figure shows
GRIDS = {"short": np.linspace(0.0, SHORT, 201), "last": np.linspace(-LAST, 0.0, 501)}
DRAWN_ORDER = 2  # of the stand-in: its statements are true of it


def runs(quick: bool) -> list[Run]:
    """List the paper's procedures, then the stand-in for Gstiff at several steps."""
    case = replace(four_bar.cases(quick)[0], timed=0.0)  # times are not compared here
    listed = [Run(case, CATALOGUE[name], 1e-9, "line-up", 1) for name in (IRK, NEWMARK)]
    orders, steps = ((2, 5), STEPS[:3]) if quick else (GEAR_ORDERS, STEPS)
    return listed + [Run(case, CATALOGUE[gear(n)], h, "GSTIFF stand-in", 1) for n in orders for h in steps]


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Measure the errors and the heights of y3, and sample the curves of the figure ("series")."""
    row: dict[str, Any] = dict.fromkeys(("error_y3", "error_y3_short", "top", "top_late"))
    row |= {"range_y3": run.case.scale.ranges[Y3], "series": {}}
    if result.t.size < 2 or result.t[-1] < FINE:
        return row
    problem, motion, t_end = run.case.problem, run.case.reference, run.case.t_end
    t = np.arange(1, round(t_end / FINE) + 1) * FINE
    t = t[t <= result.t[-1] * (1.0 + 1e-9)]
    # the deviation is interpolated, not the motion: interpolation would invent heights
    off = deviation(result, motion, t)[0][Y3]
    y3 = motion.states(t)[0][Y3] + off
    worst = np.maximum.accumulate(np.abs(off))
    row["error_y3_short"] = worst[t <= SHORT * (1.0 + 1e-9)][-1]
    if result.success:
        row["error_y3"], row["top"] = worst[-1], max(y3.max(), problem.q0[Y3])
        row["top_late"] = y3[t >= t[-1] - 1.5 * four_bar.period()].max()
    for name, at in {"short": GRIDS["short"], "last": t_end + GRIDS["last"]}.items():
        row["series"][name] = np.where(at <= t[-1] * (1.0 + 1e-9), np.interp(at, t, y3), np.nan)
    return row


def find(rows: pd.DataFrame, solver: str, step: float | None = None) -> pd.Series | None:
    """Find the row of a solver of the line-up, or of the stand-in with a fixed step."""
    fixed = {"group": "line-up"} if step is None else {"group": "GSTIFF stand-in", "h": step}
    matching = where(rows, solver=solver, **fixed)
    return None if matching.empty else matching.iloc[0]


def _stand_in(rows: pd.DataFrame) -> dict[str, Any]:
    """List the orders of the stand-in that are visibly wrong: over 2 s with both steps, then over the run."""
    pairs = {n: [run for h in (COARSE, MIDDLE) if (run := find(rows, gear(n), h)) is not None] for n in GEAR_ORDERS}
    known = {n: pair for n, pair in pairs.items() if len(pair) == 2}

    def wrong(step: int, column: str) -> list[int]:
        return [n for n, pair in known.items() if not pair[step][column] <= VISIBLE]  # a failed run is wrong, too

    found: dict[str, Any] = {"n": len(known), "wrong_coarse": wrong(0, "error_y3_short")}
    found |= {"wrong_fine": wrong(1, "error_y3_short"), "wrong_long": wrong(1, "error_y3")}
    return found | {"as_printed": [n for n in found["wrong_coarse"] if n not in found["wrong_fine"]]}


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    procedures = []
    for run in (find(rows, IRK), find(rows, NEWMARK)):
        if run is None or pd.isna(run["error_y3"]):
            raise StudyError("the rows lack the paper's procedures; run python -m studies.reproduction motion")
        procedures.append({name: run[name] for name in ("solver", "error_y3_short", "error_y3", "top", "top_late")})
    found: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "visible": VISIBLE, "procedures": procedures}
    for name, column in (("agree", "error_y3_short"), ("agree_long", "error_y3")):
        found[name] = all(run[column] <= VISIBLE for run in procedures)
    reach = all(run["top"] < PASSES and run["top_late"] > -PASSES for run in procedures)
    return found | {"reach": reach, "gear": _stand_in(rows)}


def figure_of(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw the height of bar 3's centre over the first 2 s and over the last 5 s, with the true motion."""
    figure, panels = plt.subplots(1, 2, figsize=(9.2, 3.4), sharey=True, layout="constrained")
    truth = four_bar.cases(False)[0].reference
    for panel, curve, step, start in ((panels[0], "short", COARSE, 0.0), (panels[1], "last", MIDDLE, found["t_end"])):
        t = GRIDS[curve] + start
        panel.plot(t, truth.states(t)[0][Y3], color="black", lw=2.9, alpha=0.3, label="true motion")
        for name, fixed, line in ((IRK, None, "-"), (NEWMARK, None, ":"), (gear(DRAWN_ORDER), step, "--")):
            row = find(rows, name, fixed)
            if row is not None and curve in row["series"]:
                look = figures.look(row, coded=True) | {"marker": "", "linestyle": line}
                panel.plot(t, row["series"][curve], **look)
        panel.set(xlabel="t (s)")
        panel.set_title(f"Gstiff's stand-in with h = {step:g} s", fontsize=9)
    panels[0].set_ylabel("height of bar 3's centre, y3 (m)")
    follow = "follow" if found["agree"] and found["agree_long"] else "do not all follow"
    lost = "; fixed-step BDF of order 2 loses it" if DRAWN_ORDER in found["gear"]["wrong_long"] else ""
    figures.message(figure, f"The paper's procedures {follow} the true motion{lost}", panels)
    return figure

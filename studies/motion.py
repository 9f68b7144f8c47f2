"""Figs. 2-5 of the paper: the height of bar 3's centre by every solver, over 2 s and 100 s, with its error."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies.bench import figures
from studies.bench.cases import four_bar
from studies.bench.cases.four_bar import Y3
from studies.bench.cli import StudyError
from studies.bench.collector import Run
from studies.bench.metrics import deviation
from studies.bench.render import number
from studies.bench.solvers import (
    CANONICAL,
    CATALOGUE,
    CVODE_C,
    GEAR_ORDERS,
    GIVEN,
    HEYOKA,
    IDA_C,
    IRK,
    LINE_UP,
    NEWMARK,
    OWN_EXPLICIT,
    gear,
)
from studies.bench.store import Array
from studies.bench.study import Study, rows_of
from studies.bench.tables import setting, where
from twoloop import Result

VISIBLE = 0.01  # m, about the width of a line in a figure of the motion
PASSES = 1e-3  # m above 0 from which y3 passes the line, and below it to which it reaches it
COARSE, MIDDLE = 0.02, 0.01  # s, steps of Gstiff in the paper
STEPS = (COARSE, MIDDLE, 0.005, 0.002, 0.001)
FINE = 0.002  # s, at which y3 and its error are looked at, between the steps as well
SHORT, LAST = 2.0, 5.0  # s: Fig. 2 of the paper, and what is drawn of the end of the run
GRIDS = {"short": np.linspace(0.0, SHORT, 201), "last": np.linspace(-LAST, 0.0, 501), "log": np.geomspace(1e-3, 1, 80)}
EXUDYN = "Exudyn, GeneralizedAlpha"
SMALLEST = 1e-11  # m, of the reference
LISTED = (
    *(IRK, NEWMARK, GIVEN, "SunRadau5", OWN_EXPLICIT, CANONICAL, IDA_C, HEYOKA, CVODE_C, "DOP853, projected"),
    *("LSODA, index 1", EXUDYN),
)


def runs(quick: bool) -> list[Run]:
    """Every solver at one sensible setting; then the stand-in for Gstiff at several steps."""
    case = replace(four_bar.cases(quick)[0], timed=0.0)  # times are not compared here
    line_up = [CATALOGUE[name] for name in LINE_UP]
    if quick:
        line_up = [solver for solver in line_up if solver.family in ("two-loop", "Exudyn")]
    made = [Run(case, solver, LINE_UP[solver.name], "line-up", 1) for solver in line_up]
    for order in (2, 5) if quick else GEAR_ORDERS:
        for step in STEPS[:3] if quick else STEPS:
            made.append(Run(case, CATALOGUE[gear(order)], step, "GSTIFF stand-in", 1))
    return made


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Columns of this study, and the curves of the figures in the entry "series"."""
    row: dict[str, Any] = dict.fromkeys(("error_y3", "error_y3_short", "top", "top_late", "growth"))
    row |= {"kinetic": run.case.scale.kinetic, "range_y3": run.case.scale.ranges[Y3], "series": {}}
    if result.t.size < 2 or result.t[-1] < FINE:
        return row
    problem, motion, t_end = run.case.problem, run.case.reference, run.case.t_end
    t = np.arange(1, round(t_end / FINE) + 1) * FINE
    t = t[t <= result.t[-1] * (1.0 + 1e-9)]
    off = deviation(result, motion, t)[0][Y3]
    y3 = motion.states(t)[0][Y3] + off  # no height is invented by interpolating the motion itself
    worst = np.maximum.accumulate(np.abs(off))
    row["error_y3_short"] = worst[t <= SHORT * (1.0 + 1e-9)][-1]
    if result.success:
        row["error_y3"] = worst[-1]
        row["growth"] = np.log10(worst[-1] / worst[np.searchsorted(t, 0.1 * t[-1])])
        row["top"] = max(y3.max(), problem.q0[Y3])
        row["top_late"] = y3[t >= t[-1] - 1.5 * four_bar.period()].max()
    curves = {"short": (y3, GRIDS["short"]), "last": (y3, t_end + GRIDS["last"])}
    curves["log"] = (np.maximum(worst, SMALLEST), t_end * GRIDS["log"])  # to be drawn
    for name, (curve, at) in curves.items():
        row["series"][name] = np.where(at <= t[-1] * (1.0 + 1e-9), np.interp(at, t, curve), np.nan)
    return row


def find(rows: pd.DataFrame, solver: str, step: float | None = None) -> pd.Series | None:
    """The row of a solver of the line-up, or with a fixed step of the stand-in."""
    fixed = {"group": "line-up"} if step is None else {"group": "GSTIFF stand-in", "h": step}
    found = where(rows, solver=solver, **fixed)
    return None if found.empty else found.iloc[0]


def _stand_in(rows: pd.DataFrame) -> dict[str, Any]:
    """What is said of the stand-in for ADAMS GSTIFF, by order."""
    both: dict[int, Any] = {n: [find(rows, gear(n), step) for step in (COARSE, MIDDLE)] for n in GEAR_ORDERS}
    both = {n: found for n, found in both.items() if all(row is not None for row in found)}

    def off(k: int, what: str) -> list[int]:
        return [n for n, found in both.items() if not found[k][what] <= VISIBLE]  # a failed run is off, too

    limits = {n: [found[1]["error_y3_short"], found[0]["error_y3_short"]] for n, found in both.items()}
    told: dict[str, Any] = {"n": len(both), "off_coarse": off(0, "error_y3_short")}
    told |= {"off_fine": off(1, "error_y3_short"), "off_long": off(1, "error_y3")}
    return told | {"both": [{"order": n, "limits": each} for n, each in limits.items() if each[0] <= VISIBLE < each[1]]}


def _cells(rows: pd.DataFrame, order: int) -> list[str]:
    """Errors of the stand-in of an order by step, over 2 s and over the run; what is visible is bold."""
    cells = []
    for what, step in [("error_y3_short", step) for step in STEPS[:2]] + [("error_y3", step) for step in STEPS]:
        row = find(rows, gear(order), step)
        if row is None or pd.isna(row[what]):
            cells.append("not run" if row is None else str(row["status"]).lower().replace("_", " "))
        else:
            cells.append(f"**{number(row[what])}**" if row[what] > VISIBLE else number(row[what]))
    return cells


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    procedures = []
    for run in (find(rows, IRK), find(rows, NEWMARK)):
        if run is None or pd.isna(run["error_y3"]):
            raise StudyError("the rows lack the paper's procedures; make them again by python -m studies.motion")
        found = {name: run[name] for name in ("solver", "error_y3_short", "error_y3", "top", "top_late")}
        procedures.append(found | {"holds": bool(run["top"] < PASSES and run["top_late"] > -PASSES)})
    told = ("solver", "called_from", "error_y3_short", "error_y3", "growth", "energy", "n_evaluations")
    listed = [find(rows, name) for name in LISTED]
    lined = rows[(rows["group"] == "line-up") & rows["growth"].notna()].set_index("solver")
    grown, exudyn = (lined[lined["family"] == family]["growth"] for family in ("two-loop", "Exudyn"))
    others = lined[lined["tol"].notna() & (lined["family"] != "two-loop")].groupby("keeps_constraints")["growth"]
    made: dict[str, Any] = {"t_end": float(rows["t_end"].iloc[0]), "problem": rows["problem"].iloc[0]}
    made |= {"visible": VISIBLE, "passes": PASSES, "fine": FINE, "procedures": procedures, "drawn_from": SMALLEST}
    made |= {"procedures_hold": all(one["holds"] for one in procedures)}
    made |= {"agree": all(one["error_y3_short"] <= VISIBLE for one in procedures)}
    made |= {"agree_long": all(one["error_y3"] <= VISIBLE for one in procedures), "gear": _stand_in(rows)}
    made |= {"stand_in": [[str(n), *_cells(rows, n)] for n in GEAR_ORDERS if find(rows, gear(n), COARSE) is not None]}
    known = [row for row in listed if row is not None]
    made |= {"listed": [{name: row[name] for name in told} | {"setting": setting(row)} for row in known]}
    made |= {"canonical_growth": grown.get(CANONICAL)}
    made |= {"exudyn_growth": [exudyn.min(), exudyn.max()] if len(exudyn) else None}
    made |= {"others_growth": {str(bool(keeps)): [own.min(), own.max()] for keeps, own in others}}
    grown = grown.drop(CANONICAL, errors="ignore")
    return made | {"growth": [grown.min(), grown.max()]}


def _draw(panel: Axes, rows: Iterable[pd.Series | None], curve: str, t: Array, **more: Any) -> None:
    for k, row in enumerate(row for row in rows if row is not None and curve in row["series"]):
        panel.plot(t, row["series"][curve], **({"markevery": (3 * k % 10, 10)} | figures.look(row, coded=True) | more))


def _motion(panel: Axes, rows: pd.DataFrame, curve: str, step: float) -> None:
    """The true motion, both two-loop procedures, and of the stand-in the curves that are visibly off."""
    t = GRIDS[curve] + (rows["t_end"].iloc[0] if curve == "last" else 0.0)
    truth = four_bar.cases(False)[0].reference.states(t)[0][Y3]
    panel.plot(t, truth, color="black", lw=6.0, alpha=0.2, label="true motion")
    for row, width, first in ((find(rows, IRK), 3.0, 10), (find(rows, NEWMARK), 1.2, 30)):  # one lies upon the other
        _draw(panel, [row], curve, t, linewidth=width, markevery=(first, 40))
    entries = [find(rows, gear(order), step) for order in (1, 2, 3, 5)]
    error = "error_y3" if curve == "last" else "error_y3_short"
    off = [row for row in entries if row is not None and not row[error] <= VISIBLE]
    _draw(panel, off, curve, t, marker="")
    panel.set(xlabel="t (s)")
    panel.set_title(f"GSTIFF stand-in with h = {step:g} s", fontsize=9)


def motion_figure(rows: pd.DataFrame, curve: str, steps: tuple[float, ...]) -> Figure:
    """Height of bar 3's centre over time, a panel a step of the stand-in."""
    figure, panels = plt.subplots(1, len(steps), figsize=(9.2, 3.2), sharey=True, squeeze=False, layout="constrained")
    for panel, step in zip(panels[0], steps, strict=True):
        _motion(panel, rows, curve, step)
    panels[0, 0].set_ylabel("y3 (m)")
    figures.legend(figure, panels[0])
    return figure


def error_figure(rows: pd.DataFrame) -> Figure:
    """Largest error of y3 so far over time."""
    figure, panels = plt.subplots(1, 2, figsize=(9.2, 4.4), sharex=True, sharey=True, layout="constrained")
    sides = {
        "one setting each, see the table": [find(rows, name) for name in LISTED[:10]],
        f"GSTIFF stand-in, h = {MIDDLE:g} s": [find(rows, gear(order), MIDDLE) for order in GEAR_ORDERS],
    }
    for panel, (title, entries) in zip(panels, sides.items(), strict=True):
        _draw(panel, entries, "log", rows["t_end"].iloc[0] * GRIDS["log"])
        panel.axhline(VISIBLE, color="black", lw=0.8, ls=":")
        panel.set(xscale="log", yscale="log", xlabel="t (s)")
        panel.set_title(title, fontsize=9)
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.15), ncols=2)
    panels[1].text(1.01, VISIBLE, f"{VISIBLE:g} m", transform=panels[1].get_yaxis_transform(), va="center", fontsize=8)
    panels[0].set_ylabel("largest error of y3 so far (m)")
    return figure


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Over 2 s, at the end of the run, and the error over time."""
    return {
        "motion_short": motion_figure(rows, "short", (COARSE, MIDDLE)),
        "motion_long": motion_figure(rows, "last", (MIDDLE,)),
        "motion_error": error_figure(rows),
    }


STUDY = Study("motion", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)

if __name__ == "__main__":
    STUDY.main()

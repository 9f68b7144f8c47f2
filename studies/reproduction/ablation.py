"""Whether the paper's idea pays off: positions solved in every stage, against four other ways in the same code."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.paper.ablation import VARIANTS, solve_variant
from studies.bench import figures, four_bar, tables
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver
from studies.bench.render import number
from studies.bench.tables import where
from studies.reproduction import beam
from studies.reproduction.violation import KEPT
from twoloop import Result
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib

PAPER, FROZEN, PROJECTED, STABILISED, UNPROJECTED = VARIANTS
SUN, GAUSS, RADAU = sun_radau_iib(3), gauss(2), radau_iia(3)
TIME = "call_s"  # the column of times
COSTS = {"evaluations": "n_evaluations", "time": TIME}  # as findings call them
LINKAGE, FLEXIBLE = "four-bar", "very flexible beam"

T_END, T_END_QUICK = 10.0, 1.0  # s, of the linkage
BEAM_END, BEAM_END_QUICK = 0.2, 0.01  # s: a hundred of its fastest periods, and five
HALVES = 10.0 ** (-0.5 * np.arange(2, 19))  # 1e-1 to 1e-9
TOLERANCES = {LINKAGE: HALVES, FLEXIBLE: HALVES[:13]}
FROZEN_TOLERANCES = {LINKAGE: HALVES[:12], FLEXIBLE: HALVES[:9]}  # tighter ones take thousands of steps a second
ORDER_END, ORDER_STEPS = 1.0, (0.01, 0.005)  # s, of the runs that show the order: before phases dominate the error
TARGETS = {LINKAGE: (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6), FLEXIBLE: (1e-4, 1e-5, 1e-6, 1e-7)}  # m, rad
ONE = 1.5  # below this an order counts as 1; the claims read it
LOOKS = dict(zip(VARIANTS, zip(figures.shades(len(VARIANTS)), "ovsD^", strict=True), strict=True))


def _solve(variant: str, tableau: Tableau, setting: str, case: Case, value: float, repeat: int) -> Result:
    options: dict[str, Any] = {"step" if setting == "h" else "tol": value, "time_limit": case.time_limit}
    return solve_variant(*case.start, variant, tableau, **options)[0]


def solver(variant: str, tableau: Tableau, setting: str) -> Solver:
    """Make a solver of a variant, with fixed steps ("h") or under control ("tol")."""
    keeps, run = variant != UNPROJECTED, partial(_solve, variant, tableau, setting)
    return Solver(variant, "ablation", "compiled", keeps, setting, run, fixed={"tableau": tableau.name})


def runs(quick: bool) -> list[Run]:
    """List every variant along tolerances: three tableaux on the linkage, the paper's on the very flexible beam."""
    t_end, timed = (T_END_QUICK, 0.0) if quick else (T_END, 0.02)
    soft = beam.case_of(beam.SOFT, FLEXIBLE, quick, BEAM_END_QUICK if quick else BEAM_END)
    cases = {LINKAGE: replace(four_bar.cases(quick)[0], t_end=t_end, timed=timed), FLEXIBLE: replace(soft, timed=timed)}
    listed = []
    for name, case in cases.items():
        for tableau in (SUN, GAUSS, RADAU) if name == LINKAGE and not quick else (SUN,):
            repeats = REPEATS if tableau is SUN and not quick else 1  # times are those of the paper's tableau
            for variant in VARIANTS:
                along = (FROZEN_TOLERANCES if variant == FROZEN else TOLERANCES)[name]
                under_control = solver(variant, tableau, "tol")
                values = along[4:9:2] if quick else along
                listed += [Run(case, under_control, float(tol), "controlled", repeats) for tol in values]
            if name == LINKAGE:
                short, fixed = replace(case, t_end=ORDER_END), solver(FROZEN, tableau, "h")
                listed += [Run(short, fixed, h, "order", 1) for h in ORDER_STEPS]
    return listed


def ratios(rows: pd.DataFrame, variant: str, what: str) -> list[float]:
    """Divide a variant's costs by those of the paper's way, for all cases, tableaux and errors that both have."""
    found: list[float] = []
    for (case, _), both in where(rows, group="controlled").groupby(["case", "tableau"], sort=False):
        own, paper = (where(both, solver=name) for name in (variant, PAPER))
        found += [tables.time_for(own, e, what) / tables.time_for(paper, e, what) for e in TARGETS[case]]
    return [ratio for ratio in found if np.isfinite(ratio)]


def frozen_ratios(rows: pd.DataFrame) -> list[float]:
    """Divide evaluations of the best runs with frozen dependents by the least of the paper's runs that are as good."""
    found = []
    controlled = where(rows, group="controlled").dropna(subset="error_q")
    for _, both in controlled.groupby(["case", "tableau"], sort=False):
        frozen, paper = where(both, solver=FROZEN), where(both, solver=PAPER)
        if len(frozen) and (paper["error_q"] <= frozen["error_q"].min()).any():
            finest = frozen.loc[frozen["error_q"].astype(float).idxmin()]
            good = paper[paper["error_q"] <= finest["error_q"]]
            found.append(float(finest["n_evaluations"] / good["n_evaluations"].min()))
    return found


def order(rows: pd.DataFrame, tableau: str) -> float:
    """Return the order with dependents frozen: the slope of the position error over the steps of `ORDER_STEPS`."""
    along = where(rows, group="order", solver=FROZEN, tableau=tableau)
    long, short = (where(along, h=h)["error_q"].astype(float).mean() for h in ORDER_STEPS)
    return float(np.log(long / short) / np.log(ORDER_STEPS[0] / ORDER_STEPS[1]))


def span(values: Sequence[float]) -> list[float] | None:
    """Return the least, the median and the largest."""
    return [float(value) for value in np.quantile(values, (0.0, 0.5, 1.0))] if values else None


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    if not {*VARIANTS} <= set(rows["solver"]) or "tableau" not in rows:
        raise StudyError("the rows lack variants; run python -m studies.reproduction ablation")
    against = {
        variant: {name: span(ratios(rows, variant, what)) for name, what in COSTS.items()}
        for variant in (PROJECTED, STABILISED, UNPROJECTED)
    }
    found: dict[str, Any] = {"against": against}
    found |= {"frozen": span(frozen_ratios(rows)), "frozen_order": order(rows, SUN.name)}
    kept = where(rows, group="controlled").groupby("solver")["violation_q"].max()
    times = against[PROJECTED]["time"]
    found["kept_as_well"] = bool(kept[PROJECTED] <= max(KEPT, kept[PAPER]))
    return found | {"pays": None if times is None else times[1] > 1.0}


def figure_of(rows: pd.DataFrame, found: dict[str, Any]) -> Figure:
    """Draw CPU time over error on both mechanisms."""
    figure, panels = plt.subplots(1, 2, figsize=(9.2, 3.6), sharey=True, layout="constrained")
    for panel, case in zip(panels, (LINKAGE, FLEXIBLE), strict=True):
        for variant in VARIANTS:
            along = figures.line_of(where(rows, group="controlled", tableau=SUN.name, case=case, solver=variant))
            color, marker = LOOKS[variant]
            panel.plot(along["error_q"], along[TIME], color=color, marker=marker, markersize=3.5, label=variant)
        panel.set(xscale="log", yscale="log", xlabel="largest position error (m, rad)")
        panel.set_title(case, fontsize=9)
    panels[0].set_ylabel("CPU time (s)")
    times = found["against"][PROJECTED]["time"]
    ratio = number(times[1]) if times else "an unknown number of"
    figures.message(
        figure, f"Projecting once a step takes {ratio} times the time of the paper's method (median)", panels
    )
    return figure

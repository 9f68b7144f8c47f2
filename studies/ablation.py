"""Does the paper's idea pay off: positions solved in every stage, against four other ways in one Runge-Kutta code."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from references.paper.ablation import VARIANTS, solve_variant
from studies.bench import figures, tables
from studies.bench.cases import beam, four_bar
from studies.bench.cli import StudyError
from studies.bench.collector import REPEATS, Case, Run, Solver
from studies.bench.metrics import violations
from studies.bench.store import Array
from studies.bench.study import Study, rows_of
from studies.bench.tables import LEAST, where
from studies.violation import KEPT
from twoloop import Result
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib

PAPER, FROZEN, PROJECTED, STABILISED, UNPROJECTED = VARIANTS
RIVALS = (PROJECTED, STABILISED, UNPROJECTED)
SUN, GAUSS, RADAU = sun_radau_iib(3), gauss(2), radau_iia(3)
TIME = "call_s"  # the column of times
COSTS = {"evaluations": "n_evaluations", "factorisations": "n_factorizations", "time": TIME}  # as findings call them
LINKAGE, FLEXIBLE = "four-bar", "very flexible beam"

T_END, T_END_QUICK = 10.0, 1.0  # s, of the linkage
BEAM_END, BEAM_END_QUICK = 0.2, 0.01  # s: a hundred of its fastest periods, and five
HALVES = 10.0 ** (-0.5 * np.arange(2, 19))  # 1e-1 to 1e-9
TOLERANCES = {LINKAGE: HALVES, FLEXIBLE: HALVES[:13]}
FROZEN_TOLERANCES = {LINKAGE: HALVES[:12], FLEXIBLE: HALVES[:9]}  # tighter ones take thousands of steps a second
STEPS = {
    LINKAGE: (0.2, 0.16, 0.125, 0.1, 0.08, 0.0625, 0.05, 0.04, 0.02, 0.01, 0.005),  # s
    FLEXIBLE: (4e-3, 3.2e-3, 2.5e-3, 2e-3, 1.6e-3, 1.25e-3, 1e-3, 8e-4, 5e-4, 2.5e-4, 1.25e-4),
}
DRAWN_STEP, DRAWN_STEP_QUICK = 0.02, 0.01  # s, of the figure over time
ORDER_END, ORDER_STEPS = 1.0, (0.01, 0.005)  # s, of the runs that show the order: before phases dominate the error
TARGETS = {LINKAGE: (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6), FLEXIBLE: (1e-4, 1e-5, 1e-6, 1e-7)}  # m, rad
TOLD = {LINKAGE: (1e-3, 1e-6), FLEXIBLE: (1e-5, 1e-7)}  # those of the table
ONE = 1.5  # below this an order counts as 1
MARGIN = 1.2  # times the cost: dearer; less is no difference
GROWS = 2.0  # times the violation of the first tenth of a run in its last
SAME_TOLERANCE = HALVES[8]  # 1e-5, the paper's, at which step lengths are compared

TITLE = "how constraints are kept"
LOOKS = dict(zip(VARIANTS, zip(figures.shades(len(VARIANTS)), "ovsD^", strict=True), strict=True))


def _solve(variant: str, tableau: Tableau, setting: str, case: Case, value: float, repeat: int) -> Result:
    options: dict[str, Any] = {"step" if setting == "h" else "tol": value, "time_limit": case.time_limit}
    return solve_variant(*case.start, variant, tableau, **options)[0]


def solver(variant: str, tableau: Tableau, setting: str) -> Solver:
    """A variant with fixed steps ("h") or under control ("tol")."""
    keeps, run = variant != UNPROJECTED, partial(_solve, variant, tableau, setting)
    return Solver(variant, "ablation", "compiled", keeps, setting, run, fixed={"tableau": tableau.name})


def cases(quick: bool) -> dict[str, Case]:
    """The linkage and the very flexible beam, by name."""
    t_end, timed = (T_END_QUICK, 0.0) if quick else (T_END, 0.02)
    linkage = replace(four_bar.cases(quick)[0], t_end=t_end, timed=timed)
    soft = beam.case(beam.SOFT, FLEXIBLE, quick, BEAM_END_QUICK if quick else BEAM_END)
    return {LINKAGE: linkage, FLEXIBLE: replace(soft, timed=timed)}


def runs(quick: bool) -> list[Run]:
    """Every variant along tolerances and fixed steps: three tableaux on the linkage, the paper's on the beam."""
    made = []
    for name, case in cases(quick).items():
        for tableau in (SUN, GAUSS, RADAU) if name == LINKAGE and not quick else (SUN,):
            for variant in VARIANTS:
                along = (FROZEN_TOLERANCES if variant == FROZEN else TOLERANCES)[name]
                values = {"tol": along[4:9:2] if quick else along, "h": STEPS[name][7:10] if quick else STEPS[name]}
                for setting, group in (("tol", "controlled"), ("h", "fixed")):
                    one = solver(variant, tableau, setting)
                    drawn = setting == "tol" and tableau is SUN  # with their times
                    repeats = REPEATS if drawn and not quick else 1
                    made += [Run(case, one, float(value), group, repeats) for value in values[setting]]
                if name == LINKAGE:
                    short, one = replace(case, t_end=ORDER_END), solver(variant, tableau, "h")
                    made += [Run(short, one, h, "order", 1) for h in ORDER_STEPS]
    return made


def measure(run: Run, result: Result) -> dict[str, Any]:
    """Lengths of steps; of the runs that a figure shows, violation and energy over time."""
    row: dict[str, Any] = {"series": {}}
    if result.h.size:
        row |= {"h_median": float(np.median(result.h)), "h_max": float(result.h.max())}
    drawn = DRAWN_STEP_QUICK if run.case.t_end < T_END else DRAWN_STEP
    told = run.settings | {"group": run.group, "case": run.case.name}
    if told == {"h": drawn, "tableau": SUN.name, "group": "fixed", "case": LINKAGE}:
        problem = run.case.problem
        energy = problem.energy(result.t, result.q, result.v) - problem.energy(0.0, problem.q0, problem.v0)
        t, sizes = violations(problem.system, result)
        row["series"] = {"violation": np.array([t, sizes["q"]]), "energy": np.array([result.t, np.abs(energy)])}
    return row


def costs_at(along: pd.DataFrame, targets: Sequence[float], what: str) -> Array:
    """Costs of these errors, NaN where there are none."""
    return np.array([tables.time_for(along, target, what) for target in targets])


def ratios(rows: pd.DataFrame, rival: str, what: str) -> list[float]:
    """Costs of a rival over those of positions in every stage, for all cases, tableaux and errors that both have."""
    found: list[float] = []
    for (case, _), both in where(rows, group="controlled").groupby(["case", "tableau"], sort=False):
        one, other = (costs_at(where(both, solver=name), TARGETS[case], what) for name in (rival, PAPER))
        found += (one / other).tolist()
    return [ratio for ratio in found if np.isfinite(ratio)]


def frozen_ratios(rows: pd.DataFrame) -> list[float]:
    """Evaluations of the best runs with dependents frozen over the least of the paper's runs as good or better."""
    found = []
    controlled = where(rows, group="controlled").dropna(subset="error_q")
    for _, both in controlled.groupby(["case", "tableau"], sort=False):
        one, other = where(both, solver=FROZEN), where(both, solver=PAPER)
        if len(one) and (other["error_q"] <= one["error_q"].min()).any():
            finest = one.loc[one["error_q"].astype(float).idxmin()]
            good = other[other["error_q"] <= finest["error_q"]]
            found.append(float(finest["n_evaluations"] / good["n_evaluations"].min()))
    return found


def order(rows: pd.DataFrame, variant: str, tableau: str) -> float:
    """Slope of the position error over the steps of `ORDER_STEPS`."""
    along = where(rows, group="order", solver=variant, tableau=tableau)
    long, short = (where(along, h=h)["error_q"].astype(float).mean() for h in ORDER_STEPS)
    return float(np.log(long / short) / np.log(ORDER_STEPS[0] / ORDER_STEPS[1]))


def _span(values: Sequence[float]) -> list[float] | None:
    """Least, median and largest."""
    return [float(each) for each in np.quantile(values, (0.0, 0.5, 1.0))] if values else None


def verdict(span: list[float] | None) -> str:
    """What the least, median and largest ratio of a rival's cost to the paper's say of the paper's."""
    if span is None:
        return "unknown"
    if span[0] >= 1.0 / MARGIN and span[2] <= MARGIN:
        return "equal"
    if span[0] >= 1.0 / LEAST:
        return "cheaper"
    return "dearer" if span[2] <= LEAST else "mixed"


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    if not {*VARIANTS} <= set(rows["solver"]) or "tableau" not in rows:
        raise StudyError("the rows lack variants; make them again by python -m studies.ablation")
    controlled = where(rows, group="controlled")
    cases = {name: of_case(name, own) for name, own in rows.groupby("case", sort=False)}
    against = {}
    for rival in RIVALS:
        spans = {name: _span(ratios(rows, rival, what)) for name, what in COSTS.items()}
        against[rival] = {"spans": spans, "verdicts": {name: verdict(span) for name, span in spans.items()}}
    stabilised = where(controlled, solver=STABILISED).groupby("tableau", sort=False)["violation_q"].max()
    at_end = [tableau.name for tableau in (SUN, GAUSS, RADAU) if not np.allclose(tableau.A[-1], tableau.b)]
    kept = {name: float(where(controlled, solver=name)["violation_q"].max()) for name in VARIANTS}
    tableaux = list(dict.fromkeys(rows["tableau"]))
    orders = {variant: {tableau: order(rows, variant, tableau) for tableau in tableaux} for variant in VARIANTS}
    frozen = where(controlled, solver=FROZEN).groupby("case", sort=False)["error_q"].min()
    drawn = {variant: _at_drawn(rows, variant) for variant in VARIANTS}
    drift, nothing = drawn[UNPROJECTED], {"violation_q": np.nan, "energy": np.nan}
    costs = [costs[FROZEN]["evaluations"] for costs in (each["costs"] for each in cases.values())]
    t_end = rows.groupby("case", sort=False)["t_end"].first().astype(float)
    found: dict[str, Any] = {"cases": [{"name": name, "t_end": t_end[name]} for name in cases], "tableaux": tableaux}
    found |= {"against": against, "margin": MARGIN, "n_compared": len(ratios(rows, PROJECTED, "n_evaluations"))}
    found |= {"frozen": {"at_least": _span(frozen_ratios(rows)), "best": frozen.to_dict()}, "orders": orders}
    found |= {"frozen_order_one": all(value < ONE for value in orders[FROZEN].values())}
    # a step that does not end in a stage is projected in the stabilised form
    found["projected_at_end"] = [name for name in at_end if name in tableaux]
    found["stabilised_alone"] = {name: float(x) for name, x in stabilised.items() if name not in at_end}
    found["kept_as_well"] = kept[PROJECTED] <= max(KEPT, kept[PAPER])
    # in the first and in the last tenth of the run that the figure shows
    found["drift"] = None if drift is None else [float(drift[f"violation_{part}"]) for part in ("early", "late")]
    found["controlled_drift"] = _controlled_drift(controlled)
    found["grows"] = GROWS
    found |= {what: {name: each[what] for name, each in cases.items()} for what in ("longest", "median_h", "costs")}
    found |= {"tolerance": float(SAME_TOLERANCE), "told": {name: list(TOLD[name]) for name in cases}}
    found["drawn"] = {key: nothing if row is None else row[[*nothing]].abs().to_dict() for key, row in drawn.items()}
    found["drawn_step"] = _drawn(where(rows, group="fixed"))
    return found | {"frozen_reaches_none": not np.isfinite(np.concatenate(costs)).any()}


def of_case(name: str, rows: pd.DataFrame) -> dict[str, Any]:
    """Of each variant with the paper's tableau on one mechanism, by what is told of it.

    The longest fixed step of a run that reaches its end and is in phase there, the median step at the tolerance at
    which these are compared, and costs at the errors of the table.
    """
    rows = where(rows, tableau=SUN.name)
    good = where(rows, group="fixed", status="REACHED_END")
    longest = good[~good["astray"].astype(bool)].groupby("solver")["h"].max()
    controlled = where(rows, group="controlled")
    at_tolerance = controlled[np.isclose(controlled["tol"].astype(float), SAME_TOLERANCE)]
    median_h = at_tolerance.groupby("solver")["h_median"].first()

    def costs(variant: str) -> dict[str, list[float]]:
        along = where(controlled, solver=variant)
        return {cost: costs_at(along, TOLD[name], what).tolist() for cost, what in COSTS.items()}

    return {
        "longest": longest.astype(float).reindex(VARIANTS).replace(np.nan, None).to_dict(),
        "median_h": median_h.astype(float).reindex(VARIANTS).replace(np.nan, None).to_dict(),
        "costs": {variant: costs(variant) for variant in VARIANTS},
    }


def _controlled_drift(controlled: pd.DataFrame) -> list[float] | None:
    """The violation of the unprojected form in the first and last tenth of the run at the tolerance of the table."""
    own = where(controlled, case=LINKAGE, tableau=SUN.name, solver=UNPROJECTED)
    own = own[np.isclose(own["tol"].astype(float), SAME_TOLERANCE)]
    return None if own.empty else [float(own[f"violation_{part}"].iloc[0]) for part in ("early", "late")]


def _drawn(fixed: pd.DataFrame) -> float:
    return DRAWN_STEP if DRAWN_STEP in set(fixed["h"]) and fixed["t_end"].max() >= T_END else DRAWN_STEP_QUICK


def _at_drawn(rows: pd.DataFrame, variant: str) -> pd.Series | None:
    """The run of a variant that the figure over time shows."""
    fixed = where(rows, group="fixed")
    chosen = where(fixed, case=LINKAGE, tableau=SUN.name, solver=variant, h=_drawn(fixed))
    return None if chosen.empty else chosen.iloc[0]


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Cost over error by three measures on both mechanisms; violation and energy over time."""
    names = list(dict.fromkeys(rows["case"]))
    made, axes = plt.subplots(len(names), 3, figsize=(10.5, 3.0 * len(names)), sharex="row", layout="constrained")
    controlled = where(rows, group="controlled", tableau=SUN.name)
    for name, line in zip(names, np.atleast_2d(axes), strict=True):
        for (text, what), panel in zip(COSTS.items(), line, strict=True):
            for variant in VARIANTS:
                along = figures.with_gaps(where(controlled, case=name, solver=variant))
                panel.plot(along["error_q"].astype(float), along[what].astype(float), **_look(variant))
            label = "CPU time (s)" if what == TIME else text
            panel.set(xscale="log", yscale="log", ylabel=label, xlabel="largest position error (m, rad)")
        line[0].set_title(name, loc="left")
    figures.legend(made, np.ravel(axes), TITLE)
    drift, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.2), layout="constrained")
    for variant in VARIANTS:
        row = _at_drawn(rows, variant)
        if row is not None and "violation" in row["series"]:
            for panel, name in ((left, "violation"), (right, "energy")):
                t, size = row["series"][name]
                panel.plot(t, np.maximum.accumulate(size), **_look(variant) | {"marker": ""})
            drift.suptitle(f"{row['case']}, steps of {row['h']:g} s", fontsize=10)
    left.set(yscale="log", xlabel="t (s)", ylabel="largest |C| so far (m)", ylim=(1e-17, None))
    right.set(yscale="log", xlabel="t (s)", ylabel="largest |E − E(0)| so far (J)", ylim=(1e-10, None))
    figures.legend(drift, [left], TITLE)
    return {"ablation": made, "ablation_drift": drift}


def _look(variant: str) -> dict[str, Any]:
    color, marker = LOOKS[variant]
    return {"color": color, "marker": marker, "label": variant, "markersize": 3.5}


STUDY = Study("ablation", __doc__, rows_of(runs, measure), findings_of, figures_of, medians=True, curves=True)

if __name__ == "__main__":
    STUDY.main()

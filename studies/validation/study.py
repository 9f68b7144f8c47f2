"""Published and textbook mechanisms: which solver is right, to how many digits, on which of them."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from studies.bench import figures, solvers
from studies.bench.collector import Run, warm_up
from studies.bench.end_states import DECADES, EXACT, JUDGED, SAID, TIME_LIMIT, case_of, row_of
from studies.bench.names import label
from studies.bench.render import power
from studies.bench.solvers import CATALOGUE, GIVEN
from studies.bench.store import Output, Row
from studies.bench.study import Study
from twoloop import mechanisms
from twoloop.mechanisms import Problem

MAKE: tuple[Callable[[], Problem], ...] = (
    *(mechanisms.pendulum, mechanisms.projection_pendulum, mechanisms.double_pendulum, mechanisms.driven_crank),
    *(mechanisms.andrews, mechanisms.sundials_slider_crank, mechanisms.driven_slider_crank),
    *(mechanisms.redundant_slider_crank, partial(mechanisms.closed_chain, 4), partial(mechanisms.closed_chain, 20)),
    *(partial(mechanisms.n_four_bar, 1), partial(mechanisms.n_four_bar, 2)),
    *(partial(mechanisms.n_four_bar, 2, "bodies"), partial(mechanisms.n_four_bar, 40)),
    *(mechanisms.knife_edge, mechanisms.rolling_disc, mechanisms.heavy_top, mechanisms.spatial_slider_crank),
    *(mechanisms.spatial_four_bar, mechanisms.bricard, mechanisms.governor),
)
QUICK = (0, 2, 4, 10, 14)  # of MAKE
OWN = (GIVEN, solvers.TAYLOR, solvers.ADAMS, solvers.OWN_EXPLICIT, "Gauss12", "RadauIIA5", solvers.OWN_BDF)
OTHERS = (
    *(solvers.IDA_C, solvers.IDA_C_STATES, solvers.HEYOKA, solvers.CYRK, "CyRK, Radau", solvers.CVODE_C),
    *(solvers.CVODE_C_PROJECTED, solvers.CVODES, "Radau, solve_dae", "LSODA, index 1", "DOP853, index 1"),
    *("DOP853, projected", "Radau, index 1", "BDF, index 1"),
)
QUICK_OTHERS = ("DOP853, index 1",)
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
QUICK_TOLERANCES = (1e-6, 1e-10)
JUDGED_AT = (1e-6, 1e-10)  # tolerances of the runs that the benchmarks' authors judge
MODELLED = "Exudyn's own model"  # group of runs with fixed steps
MODELS = (
    *("redundant slider-crank", "A02, N = 1", "A02, N = 2", "A02, N = 2 (bodies)"),
    *("heavy top", "spatial slider-crank", "A04 Bricard", "A05 governor"),
)
STEPS, QUICK_STEPS = (2000, 8000), (500, 2000)  # their numbers
MODELLED_LIMIT = 30.0  # s of CPU of such a run
TIGHT = 1e-10  # tolerance at which digits are compared
USUAL = 1e-8  # the default tolerance of a careful user: what is wrong at this and tighter ones is counted apart
COMPILING = 120.0  # s of CPU of what a solver builds before it runs on a problem
REACH = {"q": 9, "v": 7, "lam": 5}  # digits at TIGHT that are the target ...
AIMED = (GIVEN, solvers.OWN_EXPLICIT, "Gauss12", "RadauIIA5")  # ... of these
CONSTRAINED = "IDA|solve_dae"  # in the names of other solvers that get the constraints; the rest gets accelerations
OUTCOMES = ("right", "inexact", "wrong", SAID)
PROJECTS = {  # of other solvers, by a part of their names; the rest is SciPy's
    **{"IDA": "IDA (SUNDIALS)", "CVODES": "CVODES (CasADi)", "CVODE": "CVODE (SUNDIALS)", "solve_dae": "solve_dae"},
    **{"heyoka": "heyoka", "CyRK": "CyRK"},
}
SHORT = {"RANK_LOST": "rank", "TIME_LIMIT": "L", "STEP_TOO_SMALL": "step", "SOLVER_FAILED": "fail"}
SHORT |= {"NOT_CONVERGED": "fail"} | dict.fromkeys(("NOT_APPLICABLE", "NOT_AVAILABLE", "RAISED"), "–")
NO_FAILURES = ("L", "–")  # of these


def runs(quick: bool) -> list[Run]:
    """List every problem, solver and tolerance."""
    made = [make for k, make in enumerate(MAKE) if not quick or k in QUICK]
    names = (*OWN, *(QUICK_OTHERS if quick else OTHERS))
    tolerances = QUICK_TOLERANCES if quick else TOLERANCES
    found = []
    for problem in (make() for make in made):
        case = case_of(problem)
        found += [Run(case, CATALOGUE[name], value, repeats=1) for name in names for value in tolerances]
        if problem.condition is not None and not quick:
            case = case_of(problem, judged=True)
            found += [Run(case, CATALOGUE[name], tol, JUDGED, repeats=1) for name in names for tol in JUDGED_AT]
    modelled = [CATALOGUE[f"Exudyn, {solver}"] for solver in solvers.EXUDYN[: 1 if quick else None]]
    for case in (replace(case_of(make()), time_limit=MODELLED_LIMIT) for make in made):
        steps = [case.t_end / n for n in (QUICK_STEPS if quick else STEPS)] if case.name in MODELS else []
        found += [Run(case, solver, step, MODELLED, repeats=1) for solver in modelled for step in steps]
    return found


def make(output: Output) -> pd.DataFrame:
    """Make the rows."""
    todo, warm = output.call.wanted(runs(output.call.quick)), set[tuple[Any, ...]]()

    def made(run: Run) -> Row:
        # what is built for a mechanism, or for each of its tolerances, is no part of the run and its time limit
        what = (run.case.name, run.solver.name, run.value if run.solver.builds_each else None)
        if what not in warm:
            warm.add(what)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                warm_up(run, 0, set(), COMPILING)
        return row_of(run)

    with output.kept() as kept:
        return pd.DataFrame([kept.made(run.key(0), partial(made, run)) for run in todo])


def outcomes_of(own: pd.DataFrame) -> dict[str, int]:
    """Count the outcomes of some runs; those that we stopped are none of the solver's failures."""
    counts = {what: int((own["outcome"] == what).sum()) for what in OUTCOMES}
    counts[SAID] -= int(((own["outcome"] == SAID) & (own["status"] == "TIME_LIMIT")).sum())
    return counts | {"ended": sum(counts[what] for what in OUTCOMES[:-1])}


def project_of(row: pd.Series) -> str:
    """Name whose a solver is, in the table of the report."""
    if row["family"] == "two-loop":
        return GIVEN if row["solver"] == GIVEN else "twoloop's other methods"
    return next((project for part, project in PROJECTS.items() if part in row["solver"]), "SciPy")


def models_of(models: pd.DataFrame) -> dict[str, Any] | None:
    """Compare Exudyn's own models with the references: errors with the shorter steps, and observed orders."""
    if models.empty:
        return None
    steps = (models["t_end"] / models["h"]).round()
    runs = models.assign(steps=steps).set_index(["case", "solver"])
    errors, before = (runs[runs["steps"] == n]["error_q"].astype(float) for n in (steps.max(), steps.min()))
    orders = (np.log(before / errors) / np.log(steps.max() / steps.min())).dropna()
    found: dict[str, Any] = {"n": models["case"].nunique(), "n_steps": int(steps.max())}
    found |= {"errors": [float(errors.min()), float(errors.max())], "failed": int(errors.isna().sum())}
    return found | {"orders": [float(orders.min()), float(orders.max())] if len(orders) else []}


def short_of_reach(rows: pd.DataFrame) -> list[str]:
    """List the problems on which a method of AIMED stops at TIGHT, or has fewer digits than REACH."""
    references = {problem.name: problem.reference for problem in (make() for make in MAKE)}
    short = []
    for _, row in rows[(rows["tol"] == TIGHT) & rows["solver"].isin(AIMED)].iterrows():
        known = references[row["case"]]
        assert known is not None
        digits = {level: row[f"digits_{level}"] for level in REACH}
        few = any(digits[level] < least < known.digits.get(level, 0.0) for level, least in REACH.items())
        short += [str(row["case"])] * (few or bool(pd.isna(digits["q"])))
    return list(dict.fromkeys(short))


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Count right and wrong runs, in all and at TIGHT by mechanism."""
    models, rows = rows[rows["group"] == MODELLED], rows[rows["group"].isna() | (rows["group"] == "")]
    own = rows["family"] == "two-loop"
    sides = {"own": rows[own], "others": rows[~own]}
    right = rows[(rows["tol"] == TIGHT) & (rows["outcome"] == "right")]
    cases = list(dict.fromkeys(rows["case"]))
    found: dict[str, Any] = {"n": len(cases), "n_solvers": rows["solver"].nunique(), "tight": TIGHT, "decades": DECADES}
    found |= {"exact": EXACT, "usual": USUAL, "time_limit": TIME_LIMIT, "tolerances": [*TOLERANCES], "reach": REACH}
    found["solvers"] = [{"solver": str(name), **outcomes_of(of)} for name, of in rows.groupby("solver", sort=False)]
    by_project = rows.groupby(rows.apply(project_of, axis=1), sort=False)
    found["projects"] = [{"project": str(name), "n": len(of), **outcomes_of(of)} for name, of in by_project]
    found["right_on"] = {str(name): int(n) for name, n in right["solver"].value_counts(sort=False).items()}
    found["default"] = found["right_on"].get(GIVEN, 0)
    best = right[right["family"] != "two-loop"]["solver"].value_counts()
    found["best_other"] = {"solver": str(best.index[0]), "n": int(best.iloc[0])} if len(best) else None
    by = {side: set(right[right["solver"].isin(of["solver"])]["case"]) for side, of in sides.items()}
    others = {"own": by["others"], "others": by["own"]}
    found["only"] = {side: [case for case in cases if case in by[side] - others[side]] for side in by}
    found["none"] = [case for case in cases if case not in by["own"] | by["others"]]
    found["counts"] = {side: outcomes_of(of) for side, of in sides.items()}
    wrong = sides["others"][sides["others"]["outcome"] == "wrong"]
    singular = wrong["case"].isin([problem.name for problem in (make() for make in MAKE) if "singular" in problem.tags])
    given = singular & ~wrong["solver"].astype(str).str.contains(CONSTRAINED)
    found["wrong_others"] = {"singular": int(singular.sum()), "given": int(given.sum())}
    found["wrong_others"] |= {"tight": int((~singular & (wrong["tol"] <= USUAL)).sum())}
    found |= {"models": models_of(models), "short": short_of_reach(rows), "aimed": list(AIMED)}
    return found | {"answer": answer_of(found)}


def answer_of(found: dict[str, Any]) -> str:
    """Say in one sentence on how many mechanisms the default and the best other solver are right."""
    where = f"At a tolerance of {power(TIGHT)}, the default is right on {found['default']} of {found['n']} mechanisms"
    best = found["best_other"]
    other = f", the best other solver ({label(best['solver'])}) on {best['n']}" if best else ""
    none = f"; on {len(found['none'])} no solver is" if found["none"] else ""
    return f"{where}{other}{none}."


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Draw the digits of q at TIGHT, problem by solver."""
    tight = rows[(rows["tol"] == TIGHT) & (rows["group"].isna() | (rows["group"] == ""))]
    cases, solvers = list(dict.fromkeys(tight["case"])), list(dict.fromkeys(tight["solver"]))
    shown = tight.pivot(index="case", columns="solver", values="digits_q").reindex(index=cases, columns=solvers)
    figure, axes = plt.subplots(figsize=(8.4, 0.3 * len(cases) + 1.6), layout="constrained")
    colours = plt.get_cmap("viridis").with_extremes(bad="#e6e6e6")
    image = axes.imshow(shown.astype(float), vmin=0.0, vmax=14.0, cmap=colours, aspect="auto")
    for _, row in tight.iterrows():
        place, digits = (solvers.index(row["solver"]), cases.index(row["case"])), row["digits_q"]
        text = _short(row) if pd.isna(digits) else f"{max(0.0, digits):.1f}"
        if text in NO_FAILURES:
            corner = place[0] - 0.5, place[1] - 0.5
            axes.add_patch(Rectangle(corner, 1.0, 1.0, facecolor="white", edgecolor="#b0b0b0", hatch="////"))
        size = 7 if len(text) < 5 else 6  # of a word, which is to stay within its cell
        axes.text(*place, text, ha="center", va="center", fontsize=size, color="white" if digits < 8.0 else "black")
    axes.set_xticks(range(len(solvers)), map(label, solvers), rotation=35, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(cases)), cases)
    axes.grid(False)
    n_own = sum(CATALOGUE[name].family == "two-loop" for name in solvers)
    axes.axvline(n_own - 0.5, color="white", linewidth=3.0)
    for end, words in ((n_own, "twoloop"), (len(solvers), "other solvers")):
        axes.text(end - 0.6, -0.7, words, ha="right", va="bottom", fontsize=9)
    figure.colorbar(image, ax=axes, label=f"correct decimals of the positions at the end, rtol = atol = {power(TIGHT)}")
    figures.message(figure, f"The default is right on {found['default']} of {found['n']} mechanisms")
    return {"validation": figure}


def _short(row: pd.Series) -> str:
    """Write what stands in the place of decimals; a refusal by twoloop is one, that of an adapter is no run."""
    refused = row["status"] == "RAISED" and row["outcome"] != "not run"
    return "refused" if refused else SHORT.get(row["status"], "fail")


STUDY = Study("validation", __doc__, make, findings_of, figures_of)

"""Mechanisms published by others: which solver is right, to how many digits, on which of them."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from studies.bench.collector import Run, warm_up
from studies.bench.end_states import DECADES, EXACT, JUDGED, TIME_LIMIT, case_of, row_of
from studies.bench.names import label
from studies.bench.render import number, power
from studies.bench.solvers import (
    ADAMS,
    CATALOGUE,
    CVODE_C,
    CVODE_C_PROJECTED,
    CVODES,
    CYRK,
    EXUDYN,
    GIVEN,
    HEYOKA,
    IDA_C,
    IDA_C_STATES,
    OWN_BDF,
    OWN_EXPLICIT,
    TAYLOR,
)
from studies.bench.store import Output, Row
from studies.bench.study import Study
from studies.validation import deceived
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
QUICK = (0, 2, 4, 10, 14)  # places in MAKE
OWN = (GIVEN, TAYLOR, ADAMS, OWN_EXPLICIT, "Gauss12", "RadauIIA5", OWN_BDF)
OTHERS = (
    *(IDA_C, IDA_C_STATES, HEYOKA, CYRK, "CyRK, Radau", CVODE_C, CVODE_C_PROJECTED, CVODES, "Radau, solve_dae"),
    *("LSODA, index 1", "DOP853, index 1", "DOP853, projected", "Radau, index 1", "BDF, index 1"),
)
QUICK_OTHERS = ("DOP853, index 1",)
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10)
QUICK_TOLERANCES = (1e-6, 1e-10)
JUDGED_AT = (1e-6, 1e-10)  # tolerances of these
DECEIVED_AT = (1e-4, 1e-6, 1e-8)  # tolerances of runs whose steps are looked at one by one
MODELLED = "Exudyn's own model"  # group of runs with fixed steps, ...
MODELS = (
    *("redundant slider-crank", "A02, N = 1", "A02, N = 2", "A02, N = 2 (bodies)"),
    *("heavy top", "spatial slider-crank", "A04 Bricard", "A05 governor"),
)
STEPS, QUICK_STEPS = (2000, 8000), (500, 2000)  # ... so many of them
MODELLED_LIMIT = 30.0  # s of CPU of such a run
TIGHT = 1e-10  # at which digits are compared
USUAL = 1e-8  # the tolerance of who asks for none: what is wrong at this and tighter ones is told apart
COMPILING = 120.0  # s of CPU of what a solver builds before it runs on a problem
REACH = {"q": 9, "v": 7, "lam": 5}  # digits aimed at with TIGHT ...
AIMED = (GIVEN, OWN_EXPLICIT, "Gauss12", "RadauIIA5")  # ... by these
# their adapters tell states at given instants, between steps by interpolants: not where a step ends
UNTOLD = (IDA_C, HEYOKA, CYRK, "CyRK, Radau", CVODE_C, CVODE_C_PROJECTED, CVODES)
CONSTRAINED = "IDA|solve_dae"  # in the names of others that get the constraints; the rest gets accelerations
APART = (JUDGED, deceived.DECEIVED, MODELLED)  # groups that the table of solvers leaves out
OUTCOMES = ("right", "inexact", "wrong", "said so", "not run")
SHORT = {"RANK_LOST": "rank", "TIME_LIMIT": "L", "STEP_TOO_SMALL": "step", "SOLVER_FAILED": "failed"}
SHORT |= {"NOT_CONVERGED": "failed"} | dict.fromkeys(("NOT_APPLICABLE", "NOT_AVAILABLE", "RAISED"), "–")
NO_FAILURES = ("L", "–")  # of these


def runs(quick: bool) -> list[Run]:
    """Every problem, solver and tolerance."""
    made = [make for k, make in enumerate(MAKE) if not quick or k in QUICK]
    solvers = (*OWN, *(QUICK_OTHERS if quick else OTHERS))
    tolerances = QUICK_TOLERANCES if quick else TOLERANCES
    found = []
    for problem in (make() for make in made):
        case = case_of(problem)
        found += [Run(case, CATALOGUE[name], value, repeats=1) for name in solvers for value in tolerances]
        if problem.condition is not None and not quick:
            case = case_of(problem, judged=True)
            found += [Run(case, CATALOGUE[name], tol, JUDGED, repeats=1) for name in solvers for tol in JUDGED_AT]
        if problem.system.n_a == 0 and not {"singular", "redundant"} & set(problem.tags):
            steps = [name for name in solvers if name not in UNTOLD]
            at = DECEIVED_AT[-1:] if quick else DECEIVED_AT
            group = deceived.DECEIVED
            found += [Run(case_of(problem), CATALOGUE[name], tol, group, repeats=1) for name in steps for tol in at]
    return found + list(modelled(made, quick))


def modelled(made: Sequence[Callable[[], Problem]], quick: bool) -> Iterator[Run]:
    """Exudyn on the mechanisms of which it has a model of its own."""
    for case in (replace(case_of(make()), time_limit=MODELLED_LIMIT) for make in made):
        if case.name in MODELS:
            for name in (f"Exudyn, {solver}" for solver in EXUDYN[: 1 if quick else None]):
                for n in QUICK_STEPS if quick else STEPS:
                    yield Run(case, CATALOGUE[name], case.t_end / n, MODELLED, repeats=1)


def make(output: Output) -> pd.DataFrame:
    todo, warm = runs(output.call.quick), set[tuple[Any, ...]]()

    def made(run: Run) -> Row:
        # what is built for a mechanism, or for each of its tolerances, is no part of the run and its time limit
        what = (run.case.name, run.solver.name, run.value if run.solver.builds_each else None)
        if what not in warm:
            warm.add(what)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                warm_up(run, 0, set(), COMPILING)
        return deceived.row_of(run) if run.group == deceived.DECEIVED else row_of(run)

    with output.kept() as kept:
        return pd.DataFrame([kept.made(run.key(0), partial(made, run)) for run in todo])


def of_solver(name: str, own: pd.DataFrame) -> dict[str, Any]:
    """What the table says of a solver over all problems."""
    outcomes = own["outcome"].value_counts()
    found: dict[str, Any] = {"solver": name, "family": str(own["family"].iloc[0])}
    found |= {what: int(outcomes.get(what, 0)) for what in OUTCOMES}
    found["said so"] -= int(((own["outcome"] == "said so") & (own["status"] == "TIME_LIMIT")).sum())
    return found | {"ratio": (own["error_q"] / own["tol"]).astype(float).median()}


def of_steps(name: str, own: pd.DataFrame) -> dict[str, Any]:
    """What the table says of the steps of a solver, over all problems whose steps could be judged."""
    seen = own[own["n_sampled"] > 0]
    n = int(seen["n_sampled"].sum())
    return {"solver": name, "n": n, "deceived": float(seen["n_deceived"].sum() / n) if n else None}


def of_models(models: pd.DataFrame) -> dict[str, Any] | None:
    """How far Exudyn's solvers end from our references with the shorter steps, and the orders seen; None: not run."""
    if models.empty:
        return None
    steps = (models["t_end"] / models["h"]).round()
    runs = models.assign(steps=steps).set_index(["case", "solver"])
    errors, before = (runs[runs["steps"] == n]["error_q"].astype(float) for n in (steps.max(), steps.min()))
    orders = (np.log(before / errors) / np.log(steps.max() / steps.min())).dropna()
    found: dict[str, Any] = {"n": models["case"].nunique(), "n_steps": int(steps.max())}
    found |= {"errors": [float(errors.min()), float(errors.max())], "failed": int(errors.isna().sum())}
    return found | {"orders": [float(orders.min()), float(orders.max())] if len(orders) else []}


def of_problem(name: str, rows: pd.DataFrame) -> dict[str, Any]:
    """The best of ours and of others on one problem with TIGHT, in digits of q, and who is right."""
    tight = rows[rows["tol"] == TIGHT]
    found: dict[str, Any] = {"case": name}
    for which, own in (("ours", tight["family"] == "two-loop"), ("others", tight["family"] != "two-loop")):
        some = tight[own & tight["digits_q"].notna()]
        best = some.loc[some["digits_q"].astype(float).idxmax()] if len(some) else None
        found[which] = None if best is None else {"solver": best["solver"], "digits": float(best["digits_q"])}
        found[f"{which}_right"] = tight[own & (tight["outcome"] == "right")]["solver"].tolist()
    return found


def misses_of(own: pd.DataFrame) -> dict[str, Any]:
    """What became of each run that is not right: the solvers by what happened, and errors of those that ended."""
    limit = own["status"] == "TIME_LIMIT"
    which = {what: (own["outcome"] == what) & ~limit for what in OUTCOMES if what != "right"} | {"limit": limit}
    ended = own[own["outcome"].isin(("inexact", "wrong"))]
    errors = {str(row["solver"]): float(row["error_q"]) for _, row in ended.iterrows()}
    return {what: own[some]["solver"].tolist() for what, some in which.items()} | {"errors": errors}


def short_of_reach(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """By problem, the methods aimed at that stop with TIGHT, that we stop, and that have fewer digits than wanted."""
    found: dict[str, dict[str, Any]] = {}
    references = {problem.name: problem.reference for problem in (make() for make in MAKE)}
    for _, row in rows[(rows["tol"] == TIGHT) & rows["solver"].isin(AIMED)].iterrows():
        got, known = {level: row[f"digits_{level}"] for level in REACH}, references[row["case"]]
        assert known is not None
        short = [level for level, wanted in REACH.items() if got[level] < wanted < known.digits.get(level, 0.0)]
        unfinished = bool(pd.isna(got["q"]))
        if short or unfinished:
            of = found.setdefault(row["case"], {"case": row["case"], "stopped": [], "limit": [], "short": []})
            of["limit" if row["status"] == "TIME_LIMIT" else "stopped"] += [row["solver"]] * unfinished
            about = {"case": row["case"], "solver": row["solver"]}
            of["short"] += [about | {"level": level, "digits": float(got[level])} for level in short]
    return list(found.values())


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    judged, steps = rows[rows["group"] == JUDGED], rows[rows["group"] == deceived.DECEIVED]
    models = rows[rows["group"] == MODELLED]
    rows = rows[~rows["group"].isin(APART)]
    ours = rows["family"] == "two-loop"
    problems = [of_problem(name, own) for name, own in rows.groupby("case", sort=False)]
    wrong = rows[rows["outcome"] == "wrong"][["case", "solver", "family", "tol", "error_q"]].to_dict("records")
    stepped = [of_steps(name, own) for name, own in steps.groupby("solver", sort=False)]
    found: dict[str, Any] = {"n": len(problems), "tight": TIGHT}
    found |= {"solvers": [of_solver(name, own) for name, own in rows.groupby("solver", sort=False)]}
    found |= {"problems": problems, "decades": DECADES, "models": of_models(models), "steps": stepped}
    found |= {"ours_short": short_of_reach(rows), "reach": REACH, "aimed": list(AIMED), "wrong": wrong}
    found |= {"only_others": [line["case"] for line in problems if line["others_right"] and not line["ours_right"]]}
    alone = {line["case"]: line["ours_right"] for line in problems if line["ours_right"] and not line["others_right"]}
    others = rows[~ours & (rows["tol"] == TIGHT)]
    found["only_ours"] = [
        {"case": case, "right": right} | misses_of(others[others["case"] == case]) for case, right in alone.items()
    ]
    found["refused"] = bool((rows["outcome"] == "not run").any())
    found["n_others"] = int(rows[~ours]["solver"].nunique())
    singular = [problem.name for problem in (make() for make in MAKE) if "singular" in problem.tags]
    none_right = [line["case"] for line in problems if not line["ours_right"] and not line["others_right"]]
    found |= {"none_right_singular": set(none_right) <= set(singular), "none_right": none_right}
    right = rows[(rows["outcome"] == "right") & rows["case"].isin(none_right)]
    found["at_looser"] = {
        str(name): {"tol": float(own["tol"].min()), "solvers": own[own["tol"] == own["tol"].min()]["solver"].tolist()}
        for name, own in right.groupby("case", sort=False)
    }
    found["ours_always"] = [name for name in OWN if all(name in line["ours_right"] for line in problems)]
    found["judged"] = [of_condition(str(name), own) for name, own in judged.groupby("case", sort=False)]
    decided = judged[judged["outcome"].isin(("right", "wrong"))]
    of_us = decided["family"] == "two-loop"
    found["judged_wrong"] = _wrong(decided, of_us)
    found["judged_wrong"]["by_tol"] = [
        {"tol": float(tol), **_wrong(own, of_us[own.index])} for tol, own in decided.groupby("tol", sort=False)
    ]
    found["judged_at"] = sorted(map(float, judged["tol"].unique()), reverse=True)
    found["ours_wrong_tight"] = [line for line in wrong if line["family"] == "two-loop" and line["tol"] == TIGHT]
    found["exact"] = EXACT
    for name, outcomes in (("inexact", ["inexact"]), ("wrong", ["wrong"]), ("ended", ["right", "inexact", "wrong"])):
        which = rows["outcome"].isin(outcomes)
        found[f"n_{name}"] = {"ours": int((which & ours).sum()), "others": int((which & ~ours).sum())}
    theirs = rows[(rows["outcome"] == "wrong") & ~ours]
    away, usual = ~theirs["case"].isin(singular), theirs["tol"] <= USUAL
    given = ~away & ~theirs["solver"].astype(str).str.contains(CONSTRAINED)
    found |= {"usual": USUAL, "wrong_others": {"singular": int((~away).sum()), "given": int(given.sum())}}
    for name, which in (("tight", usual), ("loose", ~usual)):
        found["wrong_others"][name] = {"n": int(which.sum()), "elsewhere": int((which & away).sum())}
    at_tight = (rows["tol"] == TIGHT) & (rows["outcome"] == "right")
    found["right_on"] = {
        which: dict(rows[at_tight & of]["solver"].value_counts()) for which, of in (("ours", ours), ("others", ~ours))
    }
    return found | {"time_limit": TIME_LIMIT}


def _wrong(decided: pd.DataFrame, of_us: pd.Series) -> dict[str, Any]:
    """How many of the runs that were judged are wrong, of ours and of others."""
    sides = (("ours", decided[of_us]), ("others", decided[~of_us]))
    return {which: {"n": len(own), "wrong": int((own["outcome"] == "wrong").sum())} for which, own in sides}


def of_condition(name: str, own: pd.DataFrame) -> dict[str, Any]:
    """The smallest error of one problem by the authors' own condition, and who passes."""
    best, passed = own.sort_values("condition").iloc[0], own[own["outcome"] == "right"]
    line = {"case": name, "error": float(best["condition"]) if pd.notna(best["condition"]) else None}
    by_default = passed[passed["solver"] == GIVEN]["tol"].tolist()
    return line | {"default": by_default, "passed": passed["solver"].drop_duplicates().tolist()}


def figures_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Figure]:
    """Problem x solver: digits of q with TIGHT."""
    tight = rows[(rows["tol"] == TIGHT) & ~rows["group"].isin(APART)]
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
    axes.set_title(
        f"Correct decimals of q at the end, rtol = atol = {power(TIGHT)}; left: ours, right: others\n"
        f"grey: stopped by the solver; hatched: no failure, L: stopped by us after {number(TIME_LIMIT)} s, –: not run\n"
        "rank: the constraints lose rank, step: no step is small enough, failed: stopped otherwise",
        fontsize=9,
    )
    figure.colorbar(image, ax=axes, label="decimals")
    return {"validation": figure}


def _short(row: pd.Series) -> str:
    """What stands in the place of the decimals; a refusal of ours is one, that of an adapter is no run."""
    refused = row["status"] == "RAISED" and row["outcome"] != "not run"
    return "refused" if refused else SHORT.get(row["status"], "failed")


STUDY = Study("validation", __doc__, make, findings_of, figures_of)

"""Run every mechanism whose end is verified with every solver, and find which is fastest at which error.

Errors are those at the end of the reference, which is known to more digits than any motion before it: the largest error
of a coordinate, over the largest coordinate if that exceeds 1. A part of `studies.work_precision`. heyoka, CyRK and
CVODE in minimal coordinates are rows of their own, which are not in the ranking of DAE solvers.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pandas as pd

from references.minimal.solvers import has_minimal
from references.paper.four_bar_minimal import MinimalFourBar
from studies.bench import adaptive, headline
from studies.bench.cli import StudyError
from studies.bench.collector import Run, Warm, warm_up
from studies.bench.end_states import case_of, row_of
from studies.bench.four_bar import SECOND
from studies.bench.solvers import CATALOGUE, HEYOKA, MINIMAL, OTHER_SOLVERS, OWN, TAYLOR
from studies.bench.store import KeptRows, Row
from studies.validation.study import MAKE
from twoloop import mechanisms, solve_dae
from twoloop.mechanisms import Problem, Reference
from twoloop.methods.presets import is_small

GROUP = "every mechanism"
DECADES = tuple(10.0**-k for k in range(3, 14))
RESOLVED = DECADES[:8]  # down to 1e-10; below, rounding errors are compared
TYPICAL = (1e-4, 1e-6, 1e-8, 1e-10)  # errors of the table of ratios
HEADLINE = "four-bar"
SINGULAR = "singular"  # tag of mechanisms that pass through singular positions
GEOMETRIES: dict[str, Callable[[], Problem]] = {
    HEADLINE: mechanisms.four_bar,
    "four-bar, second": lambda: mechanisms.four_bar(**SECOND),  # type: ignore[arg-type]
}
QUICK = ("four-bar", "knife edge")
QUICK_SOLVERS = (headline.DEFAULT, headline.OWN_CODE, TAYLOR, "DOP853 (twoloop)", HEYOKA, "CVODE from C, Adams")
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-14)
BELOW = (3e-15, 3e-16)  # of CVODE and IDA, whose errors may fall until there
BUILT = (1e-3, 1e-7, 1e-11, 1e-15)  # of solvers that are built for each tolerance
STEPS = (100, 300, 1000, 3000, 10_000)  # of those of fixed steps
QUICK_TOLERANCES = (1e-3, 1e-5)
TIMED = 0.01  # s; a shorter run is called several times more, because cold caches cost up to 20 us
REPEATS = 3  # the fewest of which a range can be told: each takes a quarter of an hour
TIME_LIMIT = 1.0  # s of CPU of a run
COMPILING = 30.0  # s of what is built before
TIGHT = 1e-12  # tolerance of the reference of the second geometry, well above rounding, which a third way holds ...
FAR = 1e-11  # ... to so much
MINIMAL_GROUP = "minimal coordinates"
MINIMAL_TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
HEYOKAS_OWN = float(np.finfo(float).eps)  # the tolerance that heyoka takes where none is given
WRONG, ASKED = 0.1, 1e-4  # a run that ends with this error, though it was asked for a thousandth of it, is wrong
MINIMAL_LIMIT = 10.0  # s of CPU; heyoka's loosest runs may be its slowest, and what passes it twice is not asked on
PENDULUMS = {"A01 pendulum", "projection pendulum", "double pendulum"}  # no loops; from rest in a horizontal position


@cache
def problems(quick: bool) -> dict[str, Problem]:
    """Make the mechanisms by name, each with a reference."""
    made = {name: replace(make(), name=name) for name, make in GEOMETRIES.items()}
    made["four-bar, second"] = replace(made["four-bar, second"], reference=_end_of_second(made["four-bar, second"]))
    for problem in (make() for make in MAKE):
        made[problem.name] = problem
    return {name: problem for name, problem in made.items() if not quick or name in QUICK}


@cache
def singular() -> frozenset[str]:
    """Name the mechanisms that pass through singular positions."""
    return frozenset(problem.name for problem in (make() for make in MAKE) if SINGULAR in problem.tags)


def _end_of_second(problem: Problem) -> Reference:
    """Return the state after 10 s by Gauss14; StudyError if DOP853 or the equation in one coordinate disagrees."""
    t_end, ends = 10.0, []
    for method in ("Gauss14", "DOP853"):
        span = (0.0, t_end)
        result = solve_dae(problem.system, span, problem.q0, problem.v0, method=method, rtol=TIGHT, atol=TIGHT)
        if not result.success:
            raise StudyError(f"{method} does not reach the end of {problem.name}: {result.message}")
        ends.append((result.q[:, -1], result.v[:, -1]))
    known = MinimalFourBar.from_parameters(problem.parameters).states(np.array([t_end]))[0]
    apart = float(np.abs(ends[0][0] - known[:, 0]).max())
    if apart > FAR:
        raise StudyError(f"the end of {problem.name} is {apart:.1e} from that of the equation in one coordinate")
    differ = max(float(np.abs(ends[0][0] - ends[1][0]).max()), 1e-15)
    said = f"DOP853, which differs by {differ:.1e}; the equation in one coordinate, by {apart:.1e}"
    return Reference(t_end, *ends[0], f"Gauss14 at {TIGHT:g}", digits={"q": float(-np.log10(differ))}, verified=said)


def runs(quick: bool) -> list[Run]:
    """List the runs of every mechanism, solver and setting."""
    found = []
    for name, problem in problems(quick).items():
        case = replace(case_of(problem), name=name, time_limit=TIME_LIMIT, timed=TIMED)
        case = replace(case, step_sizes=tuple(case.t_end / n for n in STEPS))
        for solver in (CATALOGUE[each] for each in (QUICK_SOLVERS if quick else (*OWN, *OTHER_SOLVERS))):
            grid = BUILT if solver.builds_each else TOLERANCES if solver.setting == "tol" else case.steps()
            grid = (*grid, *BELOW) if grid is TOLERANCES and solver.family == "SUNDIALS" else grid
            values = QUICK_TOLERANCES if quick else grid
            found += [Run(case, solver, value, GROUP, 1 if quick else REPEATS) for value in values]
    return found


def collect(todo: Sequence[Run], kept: KeptRows) -> pd.DataFrame:
    """Make the rows of all runs that are of use; on the four-bars however far behind a solver is."""
    quick = all(run.repeats == 1 for run in todo)
    errors, priced = () if quick else DECADES, lambda run: run.case.name == HEADLINE
    return adaptive.collect(todo, kept, row_at_end, lambda run: run.case.name in GEOMETRIES, errors, priced, priced)


def row_at_end(run: Run, repeat: int, built: Warm) -> Row:
    """Make a repetition of a run and measure it by the end of the reference."""
    warm_up(run, repeat, built, COMPILING)
    row = row_of(run) | {"repeat": repeat, "keeps_constraints": run.solver.keeps_constraints}
    return row | {"n_steps": row.pop("n_accepted")}


@cache
def given_on(case: str) -> str:
    """Tell which solver the default is on a mechanism: `auto`, with code for the mechanism if it is small."""
    problem = problems(False).get(case)
    return headline.OWN_CODE if problem is not None and is_small(problem.system) else headline.DEFAULT


def standings(rows: pd.DataFrame, errors: Sequence[float]) -> list[dict[str, dict[str, Any]]]:
    """Compare the default and other methods of twoloop on one mechanism at each error; `rows`: its medians."""
    return headline.of_errors(rows, errors, given_on(str(rows["case"].iloc[0])))


Standings = dict[str, list[dict[str, dict[str, Any]]]]  # by mechanism how each of `headline.WHOSE` stands, by decade


def standings_of(rows: pd.DataFrame) -> Standings:
    """Compare them on each mechanism at each decade, in the order of `problems`; `rows`: medians."""
    places = {name: k for k, name in enumerate(problems(False))}
    cases = sorted(rows.groupby("case"), key=lambda each: places.get(str(each[0]), len(places)))
    return {str(name): standings(own, DECADES) for name, own in cases}


def findings_of(made: Standings, rows: pd.DataFrame) -> dict[str, Any]:
    """Find what the report says of the mechanisms; `rows`: the medians of which `made` is."""
    smooth = {case: own for case, own in made.items() if case not in singular()}
    crossing = {case: own for case, own in made.items() if case in singular()}
    found: dict[str, Any] = {"mechanisms": len(smooth), "typical": [typical(smooth, error) for error in TYPICAL]}
    found["typical"] = [line for line in found["typical"] if line["n"]]
    within = [at for own in smooth.values() for at in own[: len(RESOLVED)]]
    for word, name in (("default", headline.GIVEN), ("best", headline.BEST)):
        found[word] = headline.counted(within, name)
    found["fastest"] = fastest(within)
    others = rows.loc[rows["family"] != "two-loop", "solver"].unique()
    found |= {"n_others": len(others), "n_ours": int(rows.loc[rows["family"] == "two-loop", "solver"].nunique())}
    found["with_code"] = [case for case in made if given_on(case) == headline.OWN_CODE]
    found["drift"] = drift(made, rows)
    pairs = [at for own in crossing.values() for at in own]
    found["keeping"] = [name for name in found["fastest"] if CATALOGUE[name].keeps_constraints]
    names = sorted({case.partition(",")[0] for case in crossing})
    found["singular"] = {"variants": len(crossing), "names": names} | headline.counted(pairs, headline.GIVEN)
    found["singular"] |= reached(rows)
    return found | {"cells": cells(made)}


def typical(made: Standings, error: float) -> dict[str, Any]:
    """Summarise at an error the time of the fastest other solver over the default's: median, range, counts."""
    at = [own[DECADES.index(error)][headline.GIVEN] for own in made.values()]
    ratios = [each["ratio"] for each in at if each["ratio"] is not None]
    verdicts = [each["verdict"] for each in at]
    told: dict[str, Any] = {"error": error, "n": len(ratios), "of": len(at)}
    told |= {"faster": verdicts.count("ahead"), "slower": verdicts.count("behind") + verdicts.count("missed")}
    if ratios:
        told |= {"median": float(np.median(ratios)), "least": min(ratios), "most": max(ratios)}
    return told


def fastest(pairs: Iterable[Mapping[str, Mapping[str, Any]]]) -> dict[str, int]:
    """Count the pairs of mechanism and error in which the default is slower, by the fastest other solver."""
    at = [each[headline.GIVEN] for each in pairs]
    return dict(Counter(each["other"]["solver"] for each in at if each["verdict"] == "behind").most_common())


def reached(rows: pd.DataFrame) -> dict[str, Any]:
    """Count the errors that a solver reaches at singular positions, of those that any reaches."""
    crossed = rows[rows["case"].isin(singular()) & rows["error_q"].notna()]
    least = crossed.groupby(["case", "solver"])["error_q"].min()
    errors = [(case, error) for case, own in least.groupby("case") for error in DECADES if own.min() <= error]
    count = {
        str(solver): sum(least.get((case, solver), np.inf) <= error for case, error in errors)
        for solver in crossed["solver"].unique()
    }
    ours = set(crossed.loc[crossed["family"] == "two-loop", "solver"])
    others = {name: n for name, n in count.items() if name not in ours}
    best = max(others, key=others.__getitem__, default=None)
    given = sum(least.get((case, given_on(str(case))), np.inf) <= error for case, error in errors)
    told = {"errors": len(errors), "reached": given, "without_code": count.get(headline.DEFAULT, 0)}
    return told | {"best_other": best, "best_other_reached": 0 if best is None else others[best]}


def drift(made: Standings, rows: pd.DataFrame) -> dict[str, float] | None:
    """Return the violations by the fastest other solvers that are faster than the default; None: there are none.

    A violation is |C| of the cheapest run that is accurate enough, over the error that is compared.
    """
    known = rows.reindex(columns=list(dict.fromkeys([*rows.columns, "violation_q", "keeps_constraints"])))
    leaves = known[known[["error_q", "violation_q"]].notna().all(axis=1) & known["keeps_constraints"].eq(False)]
    ratios = []
    pairs = [(case, at[headline.GIVEN], error) for case in made for at, error in zip(made[case], DECADES, strict=True)]
    for case, standing, error in pairs:
        own = leaves[(leaves["case"] == case) & (leaves["solver"] == standing["other"]["solver"])]
        own = own[own["error_q"].astype(float) <= error]
        if standing["verdict"] == "behind" and len(own):
            ratios.append(float(own.loc[own["call_s"].astype(float).idxmin(), "violation_q"]) / error)
    return {"median": float(np.median(ratios)), "most": max(ratios)} if ratios else None


def cells(made: Standings) -> list[dict[str, Any]]:
    """List ratios of times and verdicts on the default at RESOLVED, a line a mechanism; singular positions last."""
    found = []
    for case, own in sorted(made.items(), key=lambda each: each[0] in singular()):
        at = [each[headline.GIVEN] for each in own[: len(RESOLVED)]]
        told = {key: [each[key] for each in at] for key in ("ratio", "verdict")}
        found.append({"case": case, "singular": case in singular(), **told})
    return found


def minimal_runs(quick: bool) -> list[Run]:
    """List the runs of all solvers on the mechanisms whose loops close in closed form (`minimal.equations`)."""
    found = []
    for name, problem in problems(quick).items():
        if not has_minimal(problem):
            continue
        case = replace(case_of(problem), name=name, time_limit=MINIMAL_LIMIT, timed=TIMED)
        values = QUICK_TOLERANCES if quick else MINIMAL_TOLERANCES
        repeats = 1 if quick else REPEATS
        for solver in MINIMAL:
            own = (HEYOKAS_OWN,) if solver.startswith(HEYOKA) and not quick else ()
            found += [Run(case, CATALOGUE[solver], value, MINIMAL_GROUP, repeats) for value in (*values, *own)]
    return found


def minimal_findings(rows: pd.DataFrame, everywhere: pd.DataFrame) -> list[dict[str, Any]]:
    """Compare the ODE in minimal coordinates with the best of twoloop, by kind of mechanism, on medians."""
    if not len(rows):
        return []
    cases = rows["case"].astype(str)
    crossing, pendulums = cases.isin(singular()), cases.isin(PENDULUMS)
    kinds = {"loops": ~crossing & ~pendulums, "pendulums": pendulums, "singular positions": crossing}
    return [{"kind": kind, **_of_kind(rows[own], everywhere)} for kind, own in kinds.items() if own.any()]


def _of_kind(rows: pd.DataFrame, everywhere: pd.DataFrame) -> dict[str, Any]:
    at = []
    for case, own in rows.groupby("case", sort=False):
        ours = everywhere[(everywhere["case"] == case) & (everywhere["family"] == "two-loop")]
        at += [each[headline.BEST] for each in headline.of_errors(pd.concat([ours, own], ignore_index=True), RESOLVED)]
    verdicts, ratios = [each["verdict"] for each in at], [each["ratio"] for each in at if each["ratio"] is not None]
    found: dict[str, Any] = {"mechanisms": rows["case"].nunique(), "ours_faster": verdicts.count("ahead")}
    found["slower"] = verdicts.count("behind") + verdicts.count("missed")  # with errors that only the ODE reaches
    found["n"] = len(ratios) + verdicts.count("missed")
    found["median"] = float(np.median(ratios)) if ratios else None
    done = rows[rows["error_q"].notna() & (rows["tol"] <= ASKED)]
    wrong = done[done["error_q"].astype(float) > WRONG]
    by, of = wrong["solver"].value_counts(sort=False), done["solver"].value_counts()
    found["wrong_by"] = {str(name): {"wrong": int(n), "n": int(of[name])} for name, n in by.items()}
    return found

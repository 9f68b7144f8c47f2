"""Make rows of evaluations, and of chains at equal error."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from references.engines.trees import end_by_pinocchio
from references.exudyn.mechanisms import solve_pinned
from references.sundials.ida_sparse import solve_ida_sparse
from studies.bench.collector import Case, Run, Solver, called_from, timed
from studies.bench.large import PLANAR, SPATIAL, Assembly, open_chain
from studies.bench.solvers import CATALOGUE, CVODE_C, CYRK, DEFAULT, HEYOKA, at_instants
from studies.bench.store import Row
from twoloop import Result, solve_dae
from twoloop.mechanisms import Problem

EVALUATION, CHAIN = "evaluation", "chain"  # groups of rows
Keyed = Iterator[tuple[str, Callable[[], Row]]]  # what a row is kept by, and what makes it
SIZES, QUICK_SIZES = (3, 10, 30, 100, 300, 1000, 3000), (3, 10)
METHOD, TOLERANCE = "DOP853", 1e-6
SKIPPED, STEPS = 3, 6  # steps that set a run up, and steps timed: few, as motions differ later by size
MANY, AGAIN = 300, 5  # bodies, below which the steps are timed so many times
ROUNDS, REPEATS = 3, 3
CHAINS = {20: 1.0, 100: 0.3, 400: 0.15}  # bodies, and how long they move, s: later they are chaotic
ERRORS = (1e-3, 1e-4, 1e-5)  # at the end, over max(1, max |q|)
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
EXUDYN = {f"Exudyn, {name}": name for name in ("GeneralizedAlpha", "TrapezoidalIndex2")}
N_STEPS = (100, 300, 1000, 3000, 10_000, 30_000)  # of Exudyn; the last two once
ONCE = 2
SPARSE_IDA, IDA_TOLERANCES = "IDA, sparse", (1e-4, 1e-5, 1e-6, 1e-7, 1e-8)  # where entries are given by values: once
OTHERS = {20: (CVODE_C, CYRK, HEYOKA), 100: (CVODE_C, CYRK)}  # by size: their expressions grow faster than the chain
LIMIT, TIGHT = 60.0, 1e-10  # s of CPU of a run; tolerance of the reference
AGREE = 1e-7  # how far two unlike methods may end apart with it


def problem_of(made: Assembly, t_end: float) -> Problem:
    """Return an assembly released from rest."""
    q0 = made.q
    energy = made.bodies.energy
    return Problem(made.system.name, made.system, q0, np.zeros_like(q0), (0.0, t_end), energy, conserved=True)


def evaluations(quick: bool) -> Keyed:
    """Make rows of evaluations of twoloop."""
    for repeat in range(1 if quick else ROUNDS):
        for n in QUICK_SIZES if quick else SIZES:
            for build in (*PLANAR, *SPATIAL):
                yield f"{EVALUATION} | {build.__name__} | {n} | {repeat}", partial(evaluation, build, n, repeat)


def evaluation(build: Callable[[int], Assembly], n: int, repeat: int) -> Row:
    """Time an evaluation, with its share of projections and all else of a step, and a first call.

    `passes` of the projection in a step: many near a singular position, where stages are projected too.
    """
    case = build.__name__.replace("_", " ")
    row: Row = {"group": EVALUATION, "case": case, "solver": f"{METHOD} (twoloop)", "n": n, "repeat": repeat}
    row |= {"evaluation_us": None, "step_us": None, "passes": None, "start_s": None, "status": "", "message": ""}
    began = time.process_time()
    problem = problem_of(build(n), 1.0)
    times = []
    try:
        few = _steps(problem, SKIPPED)
        row["start_s"] = time.process_time() - began - few.stats.cpu_time
        for _ in range(1 if n >= MANY else AGAIN):
            few, many = _steps(problem, SKIPPED), _steps(problem, SKIPPED + STEPS)
            times.append(1e6 * (many.stats.cpu_time - few.stats.cpu_time))
    except (RuntimeError, ValueError) as error:  # a row that says so, and no point of the fit
        return row | {"status": "FAILED", "message": str(error)}
    spent = float(np.median(times))
    evaluations = (many.stats.n_evaluations or 0) - (few.stats.n_evaluations or 0)
    passes = ((many.stats.n_inner or 0) - (few.stats.n_inner or 0)) / STEPS
    row |= {"step_us": spent / STEPS, "evaluation_us": spent / evaluations, "passes": passes}
    return row | {"status": "REACHED_END"}


def _steps(problem: Problem, steps: int) -> Result:
    options: dict[str, Any] = {"method": METHOD, "rtol": TOLERANCE, "atol": TOLERANCE, "compiled": False}
    result = solve_dae(problem.system, (0.0, 100.0), problem.q0, problem.v0, max_steps=steps, **options)
    if result.stats.n_accepted != steps:
        raise RuntimeError(result.message)
    return result


def chains(quick: bool) -> Keyed:
    """Make rows of runs of chains."""
    sizes = list(CHAINS)[:1] if quick else list(CHAINS)
    for repeat in range(1 if quick else REPEATS):
        for n in sizes:
            for solver, values in solvers(n).items():
                for value in values[:2] if quick else values:
                    if repeat > 0 and (solver == SPARSE_IDA or (solver in EXUDYN and value in values[-ONCE:])):
                        continue
                    key = f"{CHAIN} | {n} | {solver} | {value!r} | {repeat}"
                    yield key, partial(chain_row, n, solver, value, repeat)


def solvers(n: int) -> dict[str, tuple[float, ...]]:
    """Return the solvers of a chain of n bodies, with tolerances, or steps in s."""
    steps = tuple(CHAINS[n] / n_steps for n_steps in N_STEPS)
    ours = dict.fromkeys((DEFAULT, "DOP853 (twoloop)"), TOLERANCES)
    others: dict[str, tuple[float, ...]] = dict.fromkeys(OTHERS.get(n, ()), TOLERANCES)
    if n != min(CHAINS):
        others[SPARSE_IDA] = IDA_TOLERANCES
    return {**ours, **dict.fromkeys(EXUDYN, steps), **others}


@cache
def case_of(n: int, t_end: float) -> tuple[Case, Assembly]:
    """Return a chain of n bars."""
    made = open_chain(n)
    problem = problem_of(made, t_end)
    return Case(f"open chain of {n}", problem, t_end, n_instants=1, time_limit=LIMIT), made


@cache
def ends(n: int, t_end: float) -> tuple[np.ndarray, str]:
    """Return where a chain ends, by two unlike routes, and the name of the second: without Pinocchio it is Adams.

    Raises RuntimeError if they end apart.
    """
    case, made = case_of(n, t_end)
    options: dict[str, Any] = {"rtol": TIGHT, "atol": TIGHT}
    one = solve_dae(*case.start, method=METHOD, **options).q[:, -1]
    try:
        other, second = end_by_pinocchio(made.bodies, made.q[2::3], t_end, TIGHT), "Pinocchio"
    except RuntimeError:  # it is not installed
        other, second = solve_dae(*case.start, method="Adams", **options).q[:, -1], "Adams"
    if np.abs(one - other).max() > AGREE:
        raise RuntimeError(f"{METHOD} and {second} end {np.abs(one - other).max():.1g} apart on a chain of {n}")
    return one, second


@cache
def solver_of(name: str) -> Solver:
    """Return a solver of the catalogue, IDA with sparse factors, or Exudyn with bodies and joints of its own."""
    if name == SPARSE_IDA:
        ida = lambda case, tol, _: at_instants(solve_ida_sparse, case, rtol=tol, atol=tol)  # noqa: E731
        return Solver(name, "SUNDIALS", "Python", True, "tol", ida)
    if name not in EXUDYN:
        return CATALOGUE[name]

    def run(case: Case, step: float, repeat: int) -> Result:
        bodies = case_of(case.problem.q0.size // 3, case.t_end)[1].bodies
        return solve_pinned(case.problem, bodies, round(case.t_end / step), EXUDYN[name], case.time_limit)

    return replace(CATALOGUE[name], run=run)


def error_of(n: int, t_end: float, result: Result) -> float:
    """Return how far a chain ends from where it should, over max(1, max |q|)."""
    expected = ends(n, t_end)[0]
    return float(np.abs(result.q[:, -1] - expected).max() / max(1.0, np.abs(expected).max()))


def chain_row(n: int, solver: str, value: float, repeat: int) -> Row:
    """Run a solver on a chain."""
    case, chosen = case_of(n, CHAINS[n])[0], solver_of(solver)
    run = Run(case, chosen, value)
    row: Row = {"group": CHAIN, "case": case.name, "solver": solver, "family": chosen.family, "n": n, "repeat": repeat}
    row |= {"called_from": called_from(run), "keeps_constraints": chosen.keeps_constraints, chosen.setting: value}
    built = {run.key(0)} if solver in EXUDYN or solver == SPARSE_IDA else None  # before the call that is timed
    result, status, message, times = timed(run, repeat, built)  # type: ignore[arg-type]
    row |= {**times, "status": status, "message": message, "error_q": None, "floor": AGREE}
    row["reference"] = ends(n, CHAINS[n])[1]
    if result is None or status != "REACHED_END":
        return row
    return row | {"error_q": error_of(n, CHAINS[n], result), "n_evaluations": result.stats.n_evaluations}

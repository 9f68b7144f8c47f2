"""Make rows of trees in physics engines, and of chains up to the size at which solvers stop that take expressions."""

import time
from collections.abc import Callable
from functools import cache, partial
from itertools import product

import numpy as np

from references.driver import cpu_time, user_call
from references.engines.trees import ENGINES, TreeDynamics
from studies.bench.collector import Run, attempt, timed
from studies.bench.large import Assembly, open_chain, tree
from studies.bench.solvers import CATALOGUE, CVODE_C, DEFAULT, HEYOKA, IDAS
from studies.bench.store import Row
from studies.scale.runs import QUICK_SIZES, ROUNDS, TOLERANCE, Keyed, case_of, error_of
from twoloop import solve_dae

TREE, UNTIL = "tree", "until"  # groups of rows
TREES, TREE_SIZES = (open_chain, tree), (10, 30, 100, 300)  # of 600, Pinocchio holds over 7 GB
SOON, APART = 0.01, 1e-6  # s, after which a tree moves; largest relative difference of accelerations
TIMED = 0.05  # s of CPU time, of evaluations one after another
UNTIL_SIZES, UNTIL_END = (5, 10, 20, 40, 80, 160, 320), 0.1
UNTIL_SOLVERS = (DEFAULT, HEYOKA, CVODE_C, IDAS)
BUDGET = 20.0  # s of CPU time, of building and of a call


def trees(quick: bool) -> Keyed:
    """Make rows of accelerations of trees in engines."""
    rounds, sizes = range(1 if quick else ROUNDS), QUICK_SIZES[1:] if quick else TREE_SIZES
    for repeat, n, build, engine in product(rounds, sizes, TREES, ENGINES):
        key = f"{TREE} | {build.__name__} | {n} | {engine} | {repeat}"
        yield key, partial(tree_row, build, n, engine, repeat)


@cache
def _moving(build: Callable[[int], Assembly], n: int) -> tuple[Assembly, np.ndarray, np.ndarray, np.ndarray]:
    """Return a tree soon after its release: angles, angular velocities and accelerations."""
    made = build(n)
    result = solve_dae(made.system, (0.0, SOON), made.q, np.zeros_like(made.q))
    q, v, a = (each[2::3, -1] for each in (result.q, result.v, result.a))
    return made, q, v, a


@cache
def _dynamics(build: Callable[[int], Assembly], n: int, engine: str) -> tuple[TreeDynamics, float]:
    """Return the tree in an engine, and the time that it takes to build, s."""
    made, angles, rates, _ = _moving(build, n)
    began = time.process_time()
    dynamics = ENGINES[engine](made.bodies, angles, rates)
    return dynamics, time.process_time() - began


def tree_row(build: Callable[[int], Assembly], n: int, engine: str, repeat: int) -> Row:
    """Time an evaluation of an engine whose accelerations agree with those of twoloop."""
    case, expected = build.__name__.replace("_", " "), _moving(build, n)[3]
    row: Row = {"group": TREE, "case": case, "solver": engine, "n": n, "repeat": repeat, "evaluation_us": None}
    try:
        dynamics, took = _dynamics(build, n, engine)
    except RuntimeError as error:
        return row | {"status": "NOT_AVAILABLE", "message": str(error)}
    began = time.process_time()
    dynamics.evaluate()
    times = max(1, int(TIMED / max(1e-9, time.process_time() - began)))
    apart = float(np.abs(dynamics.angular() - expected).max() / np.abs(expected).max())
    row |= {"start_s": took, "error_q": apart}
    if not apart < APART:
        return row | {
            "status": "FAILED",
            "message": f"accelerations are {apart:.1g} of the largest apart from those of twoloop",
        }
    began = time.process_time()
    for _ in range(times):
        dynamics.evaluate()
    return row | {"evaluation_us": 1e6 * (time.process_time() - began) / times, "status": "REACHED_END"}


def until(quick: bool) -> Keyed:
    """Make rows of chains of growing size, by solvers that take expressions, and by twoloop."""
    for solver in UNTIL_SOLVERS:
        before: list[float] = []  # bodies, and s of the largest chain that was built
        for n in UNTIL_SIZES[:1] if quick else UNTIL_SIZES:
            yield f"{UNTIL} | {solver} | {n}", partial(until_row, n, solver, before)


def until_row(n: int, solver: str, before: list[float]) -> Row:
    """Time building and a call; a solver that would exceed the budget is not run."""
    case, chosen = case_of(n, UNTIL_END)[0], CATALOGUE[solver]
    row: Row = {"group": UNTIL, "case": case.name, "solver": solver, "n": n, "repeat": 0, "tol": TOLERANCE}
    row |= {"family": chosen.family, "build_s": None, "call_s": None, "error_q": None}
    if before and before[1] * (n / before[0]) ** 2 > BUDGET:
        why = f"not run: {before[1]:.2g} s with {before[0]:g} bodies" if before[1] < np.inf else "not run"
        return row | {"status": "TIME_LIMIT", "message": why}
    run, began = Run(case, chosen, TOLERANCE), cpu_time()
    result, status, message, spent = attempt(run, 0, 3.0 * BUDGET)
    build = (user_call.ended or cpu_time()) - began - spent
    before[:] = [n, build + spent]
    row |= {"status": status, "message": message, "build_s": build}
    if result is None or status != "REACHED_END":
        before[1] = np.inf
        return row
    times = timed(run, 0, {run.key(0)})[3]
    return row | {"call_s": times["call_s"], "error_q": error_of(n, UNTIL_END, result)}

"""Make rows of the accelerations of trees in physics engines."""

import time
from collections.abc import Callable
from functools import cache, partial
from itertools import product

import numpy as np

from references.engines.trees import ENGINES, TreeDynamics
from studies.bench.large import Assembly, open_chain, tree
from studies.bench.store import Row
from studies.scale.runs import QUICK_SIZES, ROUNDS, Keyed
from twoloop import solve_dae

TREE = "tree"  # group of rows
TREES, TREE_SIZES = (open_chain, tree), (10, 30, 100, 300)  # of 600, Pinocchio holds over 7 GB
SOON, APART = 0.01, 1e-6  # s, after which a tree moves; largest relative difference of accelerations
TIMED = 0.05  # s of CPU time, of evaluations one after another


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

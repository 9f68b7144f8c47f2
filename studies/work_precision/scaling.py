"""Cost against size: a step and an evaluation of each method on chains of points or bars and the N-four-bar mechanism.

A part of `studies.work_precision`. What is timed are steps after the first `SKIPPED`, in which a run sets itself
up. The rival is SciPy's DOP853 on the accelerations, whose linear algebra is dense.
"""

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from references.scipy.index1 import solve_index1
from studies.bench.store import KeptRows, Row
from twoloop import solve_dae
from twoloop.mechanisms import Problem, n_four_bar
from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point

GROUP = "size"
RIGID = "chain of rigid bars"
BARS = (2, 5, 10, 20, 50, 100)
CHAINS, WINDOWS = (1, 2, 5, 10, 20, 50, 100, 200), (1, 2, 5, 10, 20, 40)
QUICK, QUICK_METHODS = (2, 10, 20), ("Adams",)
METHODS = ("Taylor", "Adams", "DOP853", "Gauss6")
RIVAL = "DOP853, index 1"
LARGEST = {"Adams": 200}  # of the others:
LARGEST_ELSE = 100
MANY, FEWEST, SKIPPED = 400, 8, 3  # steps timed: MANY over n, no fewer than FEWEST
TOLERANCE = 1e-8
ROUNDS = 3
ONCE = 50  # bodies, from which on a run is made once
FITTED = 10  # bodies, from which on the exponent is fitted
GRAVITY = 9.81
SPAN = (0.0, 100.0)  # s: longer than any run here
RIVAL_LIMIT = 1.0  # s of CPU, after which the rival's steps are counted


def chain(n: int, closed: bool) -> Problem:
    """Point masses of 1/n kg on n links of 1/n m from rest: an arc; `closed`: a link more pins the other end.

    The arc bends by 1 rad in all, so that nothing is symmetric or straight; the mechanism is the one of
    `twoloop.mechanisms.closed_chain` but for its shape and size.
    """
    links = n + 1 if closed else n
    angles = np.linspace(-0.2, -1.2, links)
    nodes = np.cumsum(np.column_stack([np.cos(angles), np.sin(angles)]) / links, axis=0)
    weight = np.zeros(2 * n)
    weight[1::2] = -GRAVITY / n
    rows = QuadraticSystem(np.eye(2 * n) / n, weight)
    for i in range(n):
        rows.link(f"link {i + 1}", 2 * i, point(2 * i - 2) if i > 0 else fixed(0.0, 0.0), 1.0 / links)
    if closed:
        rows.link(f"link {links}", 2 * n - 2, fixed(*nodes[-1]), 1.0 / links)
    name = f"{'closed' if closed else 'open'} chain"
    system, q0 = rows.system(name, bandwidth=2), nodes[:n].ravel()
    return Problem(name, system, q0, np.zeros(2 * n), (0.0, 1.0), rows.energy, conserved=True)


def rigid_chain(n: int) -> Problem:
    """Bars of 1/n kg and 1/n m with pins between them, in the arc of `chain` from rest: bodies and joints.

    Three coordinates a bar, and no bandwidth declared.
    """
    length, angles = 1.0 / n, np.linspace(-0.2, -1.2, n)
    along = length * np.column_stack([np.cos(angles), np.sin(angles)])
    centres = np.cumsum(along, axis=0) - 0.5 * along
    bars = PlanarBodies([f"bar {i + 1}" for i in range(n)], np.full(n, 1.0 / n), np.full(n, length**2 / 12.0 / n))
    for i in range(n):
        before = (GROUND, (0.0, 0.0)) if i == 0 else (i - 1, (0.5 * length, 0.0))
        bars.pin(i, (-0.5 * length, 0.0), *before)
    system, q0 = bars.system("chain of bars"), np.column_stack([centres, angles]).ravel()
    return Problem("chain of bars", system, q0, np.zeros(3 * n), (0.0, 1.0), bars.energy, conserved=True)


FAMILIES: dict[str, tuple[Callable[[int], Problem], tuple[int, ...]]] = {
    "open chain": (partial(chain, closed=False), CHAINS),
    "closed chain": (partial(chain, closed=True), CHAINS[1:]),
    RIGID: (rigid_chain, BARS),
    "N-four-bar": (n_four_bar, WINDOWS),
}


def collect(quick: bool, kept: KeptRows) -> pd.DataFrame:
    """One row a family, size, method and round; the rounds are interleaved."""
    rows, warm = [], set[tuple[str, str]]()

    def made(family: str, n: int, method: str, repeat: int) -> Row:
        make, sizes = FAMILIES[family]
        if (family, method) not in warm:  # compiles
            warm.add((family, method))
            _row(family, make(sizes[0]), sizes[0], method, repeat)
        return _row(family, make(n), n, method, repeat)

    for repeat, (family, (_, sizes)) in product(range(1 if quick else ROUNDS), FAMILIES.items()):
        for n, method in product(QUICK if quick else sizes, QUICK_METHODS if quick else (*METHODS, RIVAL)):
            if n <= LARGEST.get(method, LARGEST_ELSE) and (repeat == 0 or n < ONCE):
                key = f"{GROUP} | {family} | {n} | {method} | {repeat}"
                rows.append(kept.made(key, partial(made, family, n, method, repeat)))
    return pd.DataFrame(rows)


def _row(family: str, problem: Problem, n: int, method: str, repeat: int) -> Row:
    row: Row = {"group": GROUP, "case": family, "solver": method, "n": n, "n_q": problem.q0.size, "repeat": repeat}
    row |= {"step_us": None, "evaluation_us": None, "status": "", "message": ""}
    try:
        timed = max(FEWEST, MANY // n)
        cpu, steps, evaluations = _rival(problem, timed) if method == RIVAL else _own(problem, method, timed)
        row |= {"step_us": 1e6 * cpu / steps, "evaluation_us": 1e6 * cpu / evaluations if evaluations else None}
    except (RuntimeError, ValueError) as error:  # a row that says so, and no point of the fit
        row |= {"status": "FAILED", "message": str(error)}
    return row


def _own(problem: Problem, method: str, timed: int) -> tuple[float, int, int]:
    """CPU seconds and evaluations of so many steps after the first ones."""
    found = []
    for steps in (SKIPPED, SKIPPED + timed):
        options: dict[str, Any] = {"rtol": TOLERANCE, "atol": TOLERANCE, "max_steps": steps, "compiled": False}
        result = solve_dae(problem.system, SPAN, problem.q0, problem.v0, method=method, **options)
        if result.stats.n_accepted != steps:
            raise RuntimeError(result.message)
        found.append(result.stats)
    few, many = found
    return many.cpu_time - few.cpu_time, timed, (many.n_evaluations or 0) - (few.n_evaluations or 0)


def _rival(problem: Problem, timed: int) -> tuple[float, int, int]:
    """CPU seconds, steps and evaluations of a run as long as a third as many steps of our DOP853."""
    steps = SKIPPED + max(timed // 3, FEWEST)
    span = solve_dae(problem.system, SPAN, problem.q0, problem.v0, method="DOP853", max_steps=steps, compiled=False)
    span_of_steps = (0.0, float(span.t[-1]))
    options: dict[str, Any] = {"method": "DOP853", "rtol": TOLERANCE, "atol": TOLERANCE, "time_limit": RIVAL_LIMIT}
    result = solve_index1(problem.system, span_of_steps, problem.q0, problem.v0, **options)
    stats, limited = result.stats, "time_limit" in result.message  # the steps up to the limit are enough
    if not (result.success or limited) or not stats.n_accepted or not stats.n_evaluations:
        raise RuntimeError(result.message)
    return stats.cpu_time, stats.n_accepted, stats.n_evaluations


def exponent(n: Any, cost: Any) -> float | None:
    """p of cost ~ n^p over the larger sizes; None with fewer than two."""
    n, cost = np.asarray(n, dtype=float), np.asarray(cost, dtype=float)
    large = (n >= FITTED) & (cost > 0.0)
    if large.sum() < 2:
        return None
    return float(np.polyfit(np.log(n[large]), np.log(cost[large]), 1)[0])


def findings_of(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """By family and method: how the cost of a step grows with the size."""
    found = []
    for (family, method), own in rows.groupby(["case", "solver"], sort=False):
        middle = own.groupby("n")[["step_us"]].median().dropna()
        if middle.empty:
            found.append({"family": family, "method": method, "sizes": [], "failed": str(own["message"].iloc[0])})
            continue
        sizes = [int(n) for n in middle.index]
        line: dict[str, Any] = {"family": family, "method": method, "sizes": [sizes[0], sizes[-1]], "failed": ""}
        found.append(line | {"step_exponent": exponent(sizes, middle["step_us"])})
    return found

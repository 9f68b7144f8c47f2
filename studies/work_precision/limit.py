"""How far evaluations and steps are from what the machine can do, without and with code made for the mechanism.

A part of `studies.work_precision`, on the default four-bar. Operations are those of the accelerations as straight-line
code (`equations.straight_line`), every zero left out: what eq. (6) asks for at least. The peak is measured in the same
run, by a loop of multiply-adds and by a copy within the first cache. "alone": the accelerations that `compiled=True`
makes, called in a loop.
"""

import time
from collections.abc import Callable
from itertools import product
from typing import Any

import numba
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from references.equations.straight_line import program_of
from studies.bench.store import KeptRows, Row
from twoloop import solve_dae
from twoloop.generate.straight_code import function_of, own_code
from twoloop.mechanisms import four_bar

GROUP = "limit"
METHODS = ("Adams", "DOP853", "Taylor")
BY_EVALUATIONS = METHODS[:2]  # a step of Taylor computes series, not accelerations at points
TOLERANCE = 1e-10
ROUNDS = 5
LANES, LENGTH = 32, 256  # accumulators of the loop of multiply-adds; floats copied, which fit into the first cache
REPEATED = 20_000
FUNCTIONS = ("sin", "cos", "sqrt")

Array = NDArray[np.float64]


@numba.njit(fastmath=True)
def multiply_add(x: Array, n: int) -> None:
    """n multiply-adds on each of x."""
    for _ in range(n):
        for i in range(LANES):
            x[i] = x[i] * 0.999999 + 1e-9


@numba.njit
def copy(x: Array, y: Array, n: int) -> None:
    """Copy x to y n times, changing a value so that it is not left out."""
    for k in range(n):
        x[k % LENGTH] += 1.0
        for i in range(LENGTH):
            y[i] = x[i]


def _seconds(function: Callable[..., Any], *arguments: Any) -> float:
    began = time.process_time()
    function(*arguments)
    return time.process_time() - began


def collect(kept: KeptRows, quick: bool) -> pd.DataFrame:
    """One row a quantity and round; the rounds are interleaved."""
    problem = four_bar()
    q, v, p = problem.q0, problem.v0, problem.system.functions.p
    program, _ = program_of(problem.system, 0.0, q, v)
    own = own_code(problem.system, 0.0, q)
    numbers, equations = own.numbers.values, own.equations
    accelerations = function_of(equations.graph, equations.there, own.numbers)
    f = problem.system.functions
    kinematics, force = f.kinematics, f.force

    @numba.njit
    def evaluations(n: int, q: Array, v: Array, a: Array) -> None:
        for _ in range(n):
            q[0] += 1e-18 * a[0]  # so that no evaluation is left out
            accelerations((0.0, q, v), numbers, (a,))

    @numba.njit
    def callbacks(n: int, q: Array, v: Array, p: Array, C: Array, Cq: Array, Ct: Array, Qd: Array, Q: Array) -> None:
        for _ in range(n):
            q[0] += 1e-18 * Qd[0]
            Qd[:] = 0.0
            C[:] = 0.0
            kinematics(0.0, q, v, p, C, Cq, Ct, Qd)
            force(0.0, q, v, p, Q)

    spaces = [np.zeros(8), np.zeros((8, 9)), np.zeros(8), np.zeros(8), np.zeros(9)]
    lanes, source, target = np.ones(LANES), np.zeros(LENGTH), np.zeros(LENGTH)
    written = program.lines
    counts = {
        "operations": len(written),
        "divisions": sum(" / " in line for line in written),
        "functions": sum(line.split(" = ")[1].startswith(FUNCTIONS) for line in written),
        "moves": 4 * q.size,  # q and v in, their derivatives out
    }
    multiply_add(lanes, 1)
    copy(source, target, 1)
    evaluations(1, q.copy(), v, np.zeros_like(q))
    callbacks(1, q.copy(), v, p, *spaces)
    keys = []
    for repeat in range(1 if quick else ROUNDS):
        key = f"{GROUP} | {repeat}"
        keys.append(key)
        if key in kept:
            continue
        row: Row = {"group": GROUP, "case": problem.name, "solver": "", "repeat": repeat, **counts}
        row["gflops"] = 2e-9 * LANES * REPEATED / _seconds(multiply_add, lanes, REPEATED)
        row["gbytes"] = 16e-9 * LENGTH * REPEATED / _seconds(copy, source, target, REPEATED)
        row["alone_ns"] = 1e9 * _seconds(evaluations, REPEATED, q.copy(), v, np.zeros_like(q)) / REPEATED
        row["callbacks_ns"] = 1e9 * _seconds(callbacks, REPEATED, q.copy(), v, p, *spaces) / REPEATED
        for method, compiled in product(METHODS, (False, True)):
            options: dict[str, Any] = {"method": method, "rtol": TOLERANCE, "atol": TOLERANCE, "compiled": compiled}
            solved = [solve_dae(problem.system, (0.0, 10.0), q, v, **options).stats for _ in range(2 if quick else 5)]
            cpu, name = min(stats.cpu_time for stats in solved), f"{method}_compiled" if compiled else method
            row[f"{name}_step_ns"] = 1e9 * cpu / (solved[0].n_accepted or 1)
            if method in BY_EVALUATIONS:
                row[f"{name}_evaluation_ns"] = 1e9 * cpu / (solved[0].n_evaluations or 1)
        kept.add(key, row)
    return pd.DataFrame([kept[key] for key in keys])


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Best of all rounds, the share of the peak, and what code made for the mechanism adds.

    Where others use the machine, too, a round may have half of its speed: peaks are the largest, times the least.
    """
    numbers = rows.select_dtypes("number").drop(columns="repeat").dropna(axis=1, how="all")
    rates = ("gflops", "gbytes")
    best_of = {name: own.max() if name in rates else own.min() for name, own in numbers.items()}
    found: dict[str, Any] = {str(name): float(value) for name, value in best_of.items()}
    best = min(BY_EVALUATIONS, key=lambda method: found[f"{method}_evaluation_ns"])
    own, compiled = found[f"{best}_evaluation_ns"], found[f"{best}_compiled_evaluation_ns"]
    found |= {"best": best, "own_ns": own, "compiled_ns": compiled, "methods": list(METHODS)}
    for name, nanoseconds in (("share", own), ("compiled_share", compiled), ("alone_share", found["alone_ns"])):
        found[name] = found["operations"] / (nanoseconds * found["gflops"])
    found["memory_share"] = 8.0 * found["moves"] / (own * found["gbytes"])
    return found | {"callbacks_share": found["callbacks_ns"] / own}

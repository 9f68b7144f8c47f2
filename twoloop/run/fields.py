"""Fields of a record that come from the arrays of a run, whoever took it to its end."""

from dataclasses import fields
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import counters, intervals, noted
from twoloop.kernels.layout import short_loops
from twoloop.run.kept import OF_STEPS
from twoloop.run.record import Statistics
from twoloop.run.run import Run

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

COUNTED = [each.name for each in fields(Statistics) if each.name != "cpu_time"]
COUNTERS = itemgetter(*(getattr(counters, name.upper()) for name in COUNTED))
BEFORE = np.array([0, 0, 1])  # rejections and partitions before all steps: the first partition is not a renewal


def of_steps(steps: Array, counts: Integers) -> dict[str, NDArray[Any]]:
    """What is told of each step, by the names of OF_STEPS; `counts`, those before the steps, become those after."""
    n = len(steps)
    h, changes, untested = np.empty(n), np.empty((3, n), dtype=np.int64), np.empty(n, dtype=np.bool_)
    direct(short_loops().tell_steps)(steps, counts, h, changes, untested)
    return dict(zip(OF_STEPS, (h, *changes, untested), strict=True))


def statistics(counted: Integers, cpu: float) -> Statistics:
    """What was counted in a workspace, with the CPU time that it took, s."""
    return Statistics(**dict(zip(COUNTED, COUNTERS(counted.tolist()), strict=True)), cpu_time=cpu)


def of_run(run: Run, t: Array, table: Array) -> dict[str, Any]:
    """The trajectory, of rows [q, v, a, lam], and what is known of the run as a whole."""
    return {
        **of_states(run.system.n_q, t, table),
        "rank": run.rank,
        "redundant": run.redundant.copy(),  # runs of one start share it
        "defect": run.defect(),
        "widest_gap": float(run.work.notes[noted.WIDEST_GAP]),
    }


def of_states(n: int, t: Array, table: Array) -> dict[str, Array]:
    """The trajectory alone, of n coordinates."""
    columns = table.T
    return {
        "t": t,
        "q": columns[:n],
        "v": columns[n : 2 * n],
        "a": columns[2 * n : 3 * n],
        "lam": columns[3 * n :],
    }


def kinds_of(run: Run, steps: Array) -> Integers:
    """What kind of interval each of these steps is, made by the plan that the run has, for the solution within them."""
    if run.plan.apart:
        return np.full(len(steps), intervals.APART)
    explicit = intervals.ACROSS if run.substituted else intervals.ACCELERATIONS
    return np.where(steps[:, run.a.JACOBIANS] > 0.0, intervals.VELOCITIES, explicit)

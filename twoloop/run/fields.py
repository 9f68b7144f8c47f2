"""Fields of a record that come from the arrays of a run, whoever took it to its end."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data import intervals, noted
from twoloop.run.kept import OF_STEPS
from twoloop.run.run import Run

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

BEFORE = np.array([[0, 0, 1]])  # rejections and partitions before all steps: the first partition is not a renewal


def of_steps(run: Run, steps: Array, counts: Integers = BEFORE) -> tuple[dict[str, NDArray[Any]], Integers]:
    """What is told of each step, by the names of OF_STEPS, and the counts after them; `counts`: those before."""
    a = run.a
    counts = np.concatenate([counts, steps[:, a.ERRORS : a.JACOBIANS].astype(np.int64)])
    changes = counts[1:] - counts[:-1]
    told = (steps[:, a.H].copy(), *changes.T, steps[:, a.JACOBIANS] > 0.0)
    return dict(zip(OF_STEPS, told, strict=True)), counts[-1:]


def of_run(run: Run, t: Array, table: Array) -> dict[str, Any]:
    """The trajectory, of rows [q, v, a, lam], and what is known of the run as a whole."""
    n = run.system.n_q
    return {
        "t": t,
        "q": table[:, :n].T,
        "v": table[:, n : 2 * n].T,
        "a": table[:, 2 * n : 3 * n].T,
        "lam": table[:, 3 * n :].T,
        "rank": run.rank,
        "redundant": run.redundant.copy(),  # runs of one start share it
        "defect": run.defect(),
        "widest_gap": float(run.work.notes[noted.WIDEST_GAP]),
    }


def kinds_of(run: Run, steps: Array) -> Integers:
    """What kind of interval each of these steps is, made by the plan that the run has, for the solution within them."""
    if run.plan.apart:
        return np.full(len(steps), intervals.APART)
    explicit = intervals.ACROSS if run.substituted else intervals.ACCELERATIONS
    return np.where(steps[:, run.a.JACOBIANS] > 0.0, intervals.VELOCITIES, explicit)

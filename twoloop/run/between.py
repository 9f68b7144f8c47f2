"""States at times between the steps of runs that are made by the same arrays, by one interpolator after another's."""

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data import tolerances
from twoloop.run.dense import Interpolator, Table
from twoloop.run.run import Run

Array = NDArray[np.float64]


class Between:
    """What finds states at times of a run, again and again: as `Recorder` does for one.

    Parameters
    ----------
    run : Run
        At its start, or beyond.
    """

    def __init__(self, run: Run):
        self.run, self._found = run, np.zeros((0, 0))
        self._interpolator: Interpolator | None = None

    def find(self, times: Array, t: Array, rows: Array, kinds: NDArray[np.int64], pattern: Array) -> None:
        """Find [q, v] at times, by rows [q, v, a, lam] at the ends of the steps and the kinds of these.

        `pattern`: 1 where the rows of the constraints have entries at the start.
        """
        run = self.run
        table = Table(t, rows[:, : 3 * run.system.n_q].copy(), kinds)
        known = self._interpolator
        if known is None:
            known = interpolator_of(run, table.states[0])
            known.tells = False
        else:
            known.begin(run.system, run.t0, table.states[0], pattern)
        self._interpolator, self._found = known, known.states(table, times)

    def completed(self, times: Array) -> Array | None:
        """Rows [q, v, a, lam] at these times; None where some are off the constraints, or have no accelerations."""
        known, found = self._interpolator, self._found
        if known is None or known.failures > 0:
            return None
        added = np.full((len(times), len(self.run.state) - found.shape[1]), np.nan)
        known.complete(times, found, added)
        if known.static is not None or known.repairs:  # it is not what it was
            self._interpolator = None
        return np.concatenate([found, added], axis=1) if known.failures == 0 else None


def interpolator_of(run: Run, row: Array) -> Interpolator:
    """What finds states between the steps of a run, which starts with this row [q, v, a]."""
    ranks, atol = (len(run.work.rows), len(run.work.rows_v)), run.tolerances[tolerances.ATOL :]
    interiors = {kind: plan.fresh() for kind, plan in run.interiors.items()}
    return Interpolator(run.system, run.t0, row, run.rtol, atol, ranks, interiors)

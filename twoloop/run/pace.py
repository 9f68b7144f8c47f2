"""Lengths of steps by which a run is seen to stand still, and the codes of ends that Python decides."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

INTERRUPTED, STAGNATED, OUT_OF_TIME = -1, -2, -3  # beside what advance() returns
STAGNATION_STEPS = 20_000  # accepted steps over which the pace is judged ...
STAGNATION_PACE = 1e-3  # ... against the longest step of the run, and ...
STAGNATION_LEFT = 1e7  # ... the steps that the rest of the run would take
OUT_OF_REACH = 1e11  # such steps at which a run ends, however long the others were: they take days at the least


class Pace:
    """Lengths of the accepted steps, to see that a run does not get anywhere.

    Parameters
    ----------
    t0 : float
        Where the run begins, s.
    most : float
        Steps that the rest may take if they are as long as those before.
    """

    def __init__(self, t0: float, most: float = OUT_OF_REACH):
        self.most = most
        self.window_t, self.window_n = t0, 0
        self.longest = self.mean = 0.0

    def pass_by(self, h: Array) -> None:
        """Note the lengths of accepted steps."""
        self.longest = max(self.longest, float(h.max(initial=0.0)))
        self.window_n += len(h)

    def stagnates(self, t: float, t1: float) -> bool:
        """Whether the run has come to a standstill, at time t."""
        if self.window_n < STAGNATION_STEPS:
            return False
        self.mean = (t - self.window_t) / self.window_n
        self.window_t, self.window_n = t, 0
        return t1 - t > (STAGNATION_LEFT if self.slows else self.most) * self.mean

    @property
    def slows(self) -> bool:
        """Whether the steps were much longer before."""
        return self.mean < STAGNATION_PACE * self.longest

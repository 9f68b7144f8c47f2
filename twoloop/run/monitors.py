"""Monitor a run: a stall detector, and a monitor that says whether stability, not accuracy, limited the steps.

For the second, the largest rate of the motion is found by power iteration at a few states when the run is over: that of
dF/dq and of dF/dv, F being the accelerations. A rate times the step is compared with what the method is stable to, for
vibrations and for decay.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.control.loop_state import DISPLACEMENT, INNER_TOL, initial_direction
from twoloop.kernels.data import indices
from twoloop.methods.plan import Plan

Array = NDArray[np.float64]

INTERRUPTED, STAGNATED, OUT_OF_TIME = -1, -2, -3  # beside what advance() returns
STAGNATION_STEPS = 20_000  # accepted steps over which the pace is judged ...
STAGNATION_PACE = 1e-3  # ... against the longest step of the run, and ...
STAGNATION_LEFT = 1e7  # ... the steps that the rest of the run would take
OUT_OF_REACH = 1e11  # such steps at which a run ends, however long the others were: they take days at the least


class StallDetector:
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

    def add_steps(self, h: Array) -> None:
        """Note the lengths of accepted steps."""
        self.longest = max(self.longest, float(h.max(initial=0.0)))
        self.window_n += len(h)

    def stagnates(self, t: float, t1: float) -> bool:
        """Return whether the run has come to a standstill, at time t."""
        if self.window_n < STAGNATION_STEPS:
            return False
        self.mean = (t - self.window_t) / self.window_n
        self.window_t, self.window_n = t, 0
        return t1 - t > (STAGNATION_LEFT if self.slows else self.most) * self.mean

    @property
    def slows(self) -> bool:
        """Whether the steps were much longer before."""
        return self.mean < STAGNATION_PACE * self.longest


MOST = 8  # sampled states; they lie about as far from one another
LAST_STEPS = 8  # whose median is the step at a state
ITERATIONS = 6
START = 0.1  # share of all coordinates in the direction of each look
ALIGNED = 0.9  # cosine from which on two directions are one
MANY = 200  # accepted steps before the last look, from which on it is worth a sentence
NEXT_TO = 0.45  # of the limit of stability, which half of the states have to reach; smooth motion stays below 0.4


class StiffnessSample(NamedTuple):
    """Hold a state of a run, the step h there, and what h times a rate of vibration or decay may be for stability."""

    t: float
    q: Array
    v: Array
    a: Array
    h: float
    vibration: float
    decay: float


class StiffnessMonitor:
    """Sample states of a run as it goes on, to find out at its end whether stability limited its steps."""

    def __init__(self, plan: Plan):
        self.plan, self.every, self.n_seen, self.n_steps = plan, 1, 0, 0
        self.last = np.zeros(0)  # lengths of the last steps
        self.samples: list[StiffnessSample] = []

    def add_steps(self, steps: Array) -> None:
        """Note the lengths of accepted steps."""
        self.n_steps += steps.size
        last = steps[-LAST_STEPS:]
        self.last = last if last.size == LAST_STEPS else np.concatenate([self.last, last])[-LAST_STEPS:]

    def sample_state(self, t: float, state: Array, n_q: int) -> None:
        """Keep this state, that after the last steps; of many only every second, fourth, ..."""
        if self.plan.stable_to is None or self.last.size < LAST_STEPS:
            return
        self.n_seen += 1
        if self.n_seen % self.every != 0:
            return
        q, v, a = state[: 3 * n_q].reshape(3, n_q).copy()
        limits = self.plan.stable_to(self.plan.memory)
        self.samples.append(StiffnessSample(t, q, v, a, float(np.median(self.last)), *limits))
        if len(self.samples) > MOST:
            self.samples = self.samples[1::2]
            self.every *= 2


def describe_stiffness(looks: StiffnessMonitor, kit: Any, work: Any) -> str:
    """Return a sentence if stability limited the steps, else nothing. What stands in the workspace is lost."""
    if not looks.samples or looks.n_steps < MANY:
        return ""
    start = initial_direction(work.Q.size)
    directions = [np.zeros_like(start), np.zeros_like(start)]
    found = []
    for sample in looks.samples:
        for direction in directions:  # that of the look before, in which no coordinate may have been lost for good
            direction += START * start
        try:
            vibration, decay = _rates(kit, work, sample, directions)
        except Exception:  # of a callback at a displaced state, which is none of the run: there is nothing to say
            return ""
        h = sample.h
        found.append((h * vibration / sample.vibration, h * decay / sample.decay, vibration, decay, h))
    by_vibration, by_decay, vibration, decay, h = np.median(found, axis=0)
    if max(by_vibration, by_decay) < NEXT_TO:
        return ""
    what = f"vibrations of {vibration:.2g} rad/s" if by_vibration >= by_decay else f"a decay of {decay:.2g} 1/s"
    return (
        f" The problem looks stiff: steps of {h:.2g} s are about as long as they can be for {what} to remain stable. "
        "If these need not be resolved, take method='auto', 'RadauIIA9', or 'TRBDF2' for few digits."
    )


def _rates(kit: Any, work: Any, sample: StiffnessSample, directions: list[Array]) -> tuple[float, float]:
    """Angular frequency of the fastest vibration and the fastest rate of decay, 1/s, as far as they dominate."""
    from twoloop.kernels.evaluation import tasks

    if kit.inner(kit, work, tasks.RENEW_PARTITION, sample.t, sample.q, sample.v, 0.0, work.x, work.lam) != indices.DONE:
        return 0.0, 0.0
    squared, opposed_q = _largest(kit, work, sample, directions[0], work.independent, False)
    rate, opposed_v = _largest(kit, work, sample, directions[1], work.independent_v, True)
    vibration = np.sqrt(squared) if opposed_q else 0.0
    return (vibration, rate) if opposed_v else (max(vibration, rate), 0.0)


def _largest(
    kit: Any, work: Any, sample: StiffnessSample, direction: Array, places: NDArray[np.int64], by_v: bool
) -> tuple[float, bool]:
    """Find the largest growth of a direction under dF/dq or dF/dv by power iteration, and whether it is reversed."""
    from twoloop.kernels.evaluation import tasks

    size = DISPLACEMENT * max(1.0, float(np.abs(sample.v if by_v else sample.q).max()))
    factor, opposed = 0.0, False
    a = np.zeros_like(sample.a)
    for _ in range(ITERATIONS):
        Q, V = sample.q.copy(), sample.v.copy()
        (V if by_v else Q)[places] += size * direction[places]
        if kit.inner(kit, work, tasks.EVALUATE, sample.t, Q, V, INNER_TOL, a, work.lam) != indices.DONE:
            return 0.0, False
        image = (a - sample.a)[places]
        longest = float(np.abs(image).max(initial=0.0))
        if not 0.0 < longest < np.inf:
            return 0.0, False
        before = direction[places]
        cosine = float(image @ before) / float(np.linalg.norm(image) * np.linalg.norm(before))
        factor, opposed = longest / (size * float(np.abs(before).max())), cosine < -ALIGNED
        direction[places] = image / longest
    return factor, opposed

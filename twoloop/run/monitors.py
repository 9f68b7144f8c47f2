"""Monitors of a run: a stall detector, and a monitor that says whether stability, not accuracy, limited the steps.

The second estimates the largest rate of the motion at a few states after the run, by power iteration with dF/dq and
dF/dv, F being the accelerations. The rate times the step is compared with the stability limit of the method, for
vibrations and for decay.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.control.loop_state import DISPLACEMENT, INNER_TOL, initial_direction
from twoloop.kernels.data import indices
from twoloop.methods.plan import Plan

Array = NDArray[np.float64]

INTERRUPTED, STAGNATED, OUT_OF_TIME = -1, -2, -3  # codes of this module, besides those that advance() returns
STAGNATION_STEPS = 20_000  # accepted steps over which the mean step is measured; it is small if it is below ...
STAGNATION_PACE = 1e-3  # ... this share of the longest step of the run, and the run stalls if it is small and ...
STAGNATION_LEFT = 1e7  # ... the rest of the run would take more than this number of steps
OUT_OF_REACH = 1e11  # number of remaining steps at which a run ends whatever its longest step was: they would take days


class StallDetector:
    """Monitor of the lengths of accepted steps, to detect a run that makes no progress.

    Parameters
    ----------
    t0 : float
        Start of the run, s.
    most : float
        Number of steps that the rest may take if they are as long as the last ones.
    """

    def __init__(self, t0: float, most: float = OUT_OF_REACH):
        self.most = most
        self.window_t, self.window_n = t0, 0
        self.longest = self.mean = 0.0

    def add_steps(self, h: Array) -> None:
        """Add the lengths of accepted steps."""
        self.longest = max(self.longest, float(h.max(initial=0.0)))
        self.window_n += len(h)

    def stagnates(self, t: float, t1: float) -> bool:
        """Return whether the run stalls at time t."""
        if self.window_n < STAGNATION_STEPS:
            return False
        self.mean = (t - self.window_t) / self.window_n
        self.window_t, self.window_n = t, 0
        return t1 - t > (STAGNATION_LEFT if self.slows else self.most) * self.mean

    @property
    def slows(self) -> bool:
        """Whether the steps were much longer earlier in the run."""
        return self.mean < STAGNATION_PACE * self.longest


MOST = 8  # most states that are kept; they are spread about evenly over the run
LAST_STEPS = 8  # number of last steps whose median is the step at a state
ITERATIONS = 6  # power iterations at each state
START = 0.1  # share of a vector with all coordinates that is added to the direction before each estimate
ALIGNED = 0.9  # absolute cosine above which the image counts as parallel to the direction
MANY = 200  # accepted steps below which nothing is said about stiffness
NEXT_TO = 0.45  # share of the limit of stability that half of the states must reach; smooth motion stays below 0.4


class StiffnessSample(NamedTuple):
    """Sampled state of a run, the step h there, and limits of h times a rate of vibration or decay for stability."""

    t: float
    q: Array
    v: Array
    a: Array
    h: float
    vibration: float
    decay: float


class StiffnessMonitor:
    """Monitor that samples states of a run, to find out at its end whether stability limited its steps."""

    def __init__(self, plan: Plan):
        self.plan, self.every, self.n_seen, self.n_steps = plan, 1, 0, 0
        self.last = np.zeros(0)  # lengths of the last LAST_STEPS steps
        self.samples: list[StiffnessSample] = []

    def add_steps(self, steps: Array) -> None:
        """Add the lengths of accepted steps."""
        self.n_steps += steps.size
        last = steps[-LAST_STEPS:]
        self.last = last if last.size == LAST_STEPS else np.concatenate([self.last, last])[-LAST_STEPS:]

    def sample_state(self, t: float, state: Array, n_q: int) -> None:
        """Keep the state after the last steps; of many states, keep only every second, fourth, ..."""
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
    """Return a sentence if stability limited the steps, else nothing. Overwrites the workspace."""
    if not looks.samples or looks.n_steps < MANY:
        return ""
    start = initial_direction(work.Q.size)
    directions = [np.zeros_like(start), np.zeros_like(start)]
    samples = []
    for sample in looks.samples:
        for direction in directions:  # starts from the state before: no coordinate may have been lost from it for good
            direction += START * start
        try:
            vibration, decay = _rates(kit, work, sample, directions)
        except Exception:  # raised by a callback at a displaced state, which the run did not visit: say nothing
            return ""
        h = sample.h
        samples.append((h * vibration / sample.vibration, h * decay / sample.decay, vibration, decay, h))
    by_vibration, by_decay, vibration, decay, h = np.median(samples, axis=0)
    if max(by_vibration, by_decay) < NEXT_TO:
        return ""
    what = f"vibrations of {vibration:.2g} rad/s" if by_vibration >= by_decay else f"a decay of {decay:.2g} 1/s"
    return (
        f" The problem looks stiff: steps of {h:.2g} s are about as long as they can be for {what} to remain stable. "
        "If these need not be resolved, take method='auto', 'RadauIIA9', or 'TRBDF2' for few digits."
    )


def _rates(kit: Any, work: Any, sample: StiffnessSample, directions: list[Array]) -> tuple[float, float]:
    """Return the angular frequency of the fastest vibration and the fastest decay, 1/s, as far as they dominate."""
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
    """Return the largest growth of a direction under dF/dq or dF/dv by power iteration, and whether it is reversed."""
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

"""Independent rerun of pieces of a run: short runs from stored states, by an explicit or an implicit method."""

from __future__ import annotations  # ArrayLike stays a word in help()

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.data import indices
from twoloop.methods import dop853
from twoloop.methods.dop853 import DOP853
from twoloop.methods.plan import Method
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import radau_iia
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import apply_jump
from twoloop.run.run import Run

Array = NDArray[np.float64]

CHUNK = 256  # attempts at steps in one call of `advance`
FIRST_TRY = 0.1  # relative to a piece: its first step, if no step of a piece before is known
SHARE = 0.1  # relative to the tolerances of the run: those of the pieces ...
FINEST = 1e-13  # ... but not below this, because of rounding
MOST_NUMBERS = 100_000  # size of the buffer of states


def tighter(tolerance: ArrayLike) -> Array:
    """Return the tolerances of the pieces for those of the run."""
    return np.minimum(tolerance, np.maximum(SHARE * np.asarray(tolerance), FINEST))


def explicit() -> tuple[Method, Array]:
    """Return the method for motion that is not stiff, and its nodes."""
    return DOP853(), dop853.C


def implicit(velocities: bool) -> tuple[Method, Array]:
    """Return the method for stiff motion, and its nodes; `velocities`: whether errors of velocities are tested, too."""
    tableau = radau_iia(7)
    return RungeKutta(tableau, outer="newton", tested="all" if velocities else "positions"), tableau.c


class RerunPiece(NamedTuple):
    """Result of a piece: states [q, v] at the times asked for, the longest step, s, and the number of steps."""

    states: Array
    longest: float
    n_steps: int


class IndependentRerun:
    """Independent rerun of pieces of a run, each from a given state, in the same arrays.

    Parameters
    ----------
    system : ConstrainedSystem
    t, q, v : float, ndarray (n_q,)
        A state of the run.
    method : (method object, ndarray)
        The method of the pieces, and the nodes of its steps at which it evaluates the equations, from 0 to 1.
    rtol, atol : float, ndarray (n_q,)
        Tolerances.
    max_step : float
        Largest step, s.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        t: float,
        q: Array,
        v: Array,
        method: tuple[Method, Array],
        rtol: float,
        atol: Array,
        max_step: float,
    ):
        chosen, nodes = method
        self.spacing = float(np.diff(np.unique(np.concatenate([[0.0], nodes, [1.0]]))).max())
        plan = chosen.plan(system.n_q, rtol, float(atol.min()), False)
        self.run = Run(system, plan, t, q, v, rtol, atol, None)
        a, control = self.run.a, self.run.control
        control[a.MAX_STEP], control[a.BRIDGE], control[a.STORE_ALL] = max_step, 0.0, 0.0
        control[a.MAX_ATTEMPTS] = CHUNK
        self.run.work.notes[indices.GAMMA_REQUIRED] = np.inf  # the run has checked the accuracy of its differences
        n_rows = max(2, min(CHUNK, MOST_NUMBERS // len(self.run.state)))
        rows = (np.empty(n_rows), np.empty((n_rows, len(self.run.state))))
        self.buffers, self.filled = (*rows, np.empty((CHUNK, a.N_STEP_COLUMNS))), np.zeros(2, dtype=np.int64)
        self.next_step = np.inf

    def to(self, t0: float, state: Array, times: Array, most: int) -> RerunPiece | None:
        """Integrate from a state [q, v] at t0 and land on `times`; return None if that takes over `most` attempts."""
        run, a, n = self.run, self.run.a, len(state)
        first_step, self.next_step = self.next_step, np.inf
        if run.restart(t0, state[: n // 2], state[n // 2 :]) != indices.DONE:
            return None
        t1 = float(times[-1])
        run.clock[a.H_NEXT] = first_step if first_step < np.inf else FIRST_TRY * (t1 - t0)
        run.work.notes[indices.KINK_AFTER] = t1
        states: list[Array] = []
        longest, n_total = 0.0, 0
        buffers, filled = self.buffers, self.filled
        for _ in range(0, most + len(times), len(buffers[0])):
            code = run.advance(times, buffers, filled)
            n_rows, n_steps = filled.tolist()
            states.append(buffers[1][:n_rows, :n].copy())
            longest, n_total = max(longest, float(buffers[2][:n_steps, a.H].max(initial=0.0))), n_total + n_steps
            if code == a.ALL_OUTPUT_DONE:
                self.next_step = float(run.clock[a.H_NEXT])
                return RerunPiece(np.concatenate(states), longest, n_total)
            if code != a.PAUSED and not (code == a.AT_DISCONTINUITY and apply_jump(run, t1)):
                break
        return None

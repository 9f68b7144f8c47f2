"""Dense output for users: the state of a run at any time between its start and its end."""

from __future__ import annotations  # ArrayLike stays a word in help()

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.checks.arguments import check_real, shaped
from twoloop.run.dense import Array, Groups, Interpolator, Table


class DenseState:
    """Hold the state of a run at any times.

    Attributes
    ----------
    t : float or ndarray (n,)
        Times, s.
    q, v : ndarray (n_q,) or (n_q, n)
        Coordinates and velocities, on the constraints to rounding, except close to a singular position, where rounding
        would make the velocities: a warning says so.
    a : ndarray (n_q,) or (n_q, n)
        Accelerations at these times, evaluated when they are first read.
    lam : ndarray (n_c + n_a,) or (n_c + n_a, n)
        Multipliers at these times, likewise.
    """

    def __init__(self, interpolator: Interpolator, t: Array, order: Groups, rows: Array):
        self._interpolator, self._order, self._rows = interpolator, order, rows
        n = interpolator.system.n_q
        self.t: Any = t if t.ndim else float(t)
        self.q, self.v = self._unsorted(rows[:, :n]), self._unsorted(rows[:, n:])

    def _unsorted(self, rows: Array) -> Array:
        """Return columns in the order of `t`, given rows in the order of time."""
        columns = np.empty(rows.shape[::-1])
        columns[:, self._order] = rows.T
        return columns if np.ndim(self.t) else columns[:, 0]

    @cached_property
    def _completed(self) -> Array:
        system, times = self._interpolator.system, np.atleast_1d(self.t)[self._order]
        out = np.empty((len(times), system.n_q + system.n_c + system.n_a))
        self._interpolator.complete(times, self._rows, out)
        return out

    @property
    def a(self) -> Array:
        """Accelerations."""
        return self._unsorted(self._completed[:, : self._interpolator.system.n_q])

    @property
    def lam(self) -> Array:
        """Multipliers."""
        return self._unsorted(self._completed[:, self._interpolator.system.n_q :])


class DenseSolution:
    """Dense output, `result.sol`: the state of a run at any time between its start and its end.

    Between accepted steps q and v are Hermite polynomials; the inner loop then restores the dependent coordinates, so
    that the constraints hold to rounding. At an accepted step the state is the stored one. The polynomials go through
    q, v and a of four neighbouring states (order 12). Where Newton's method was at work in the outer loop, they go
    through q and v (order 8), because a has the noise of vibrations that are stepped over. For `BDF` and `Newmark`, v
    has a polynomial of its own, through v and a (order 8).

    The steps of `RungeKutta` of order 6 and more (by Newton's method of order 7 and more) and of `Taylor`, in `auto`
    too, are too long for this. Each is divided into 2 to 6 equal steps of the method when a time within it is first
    evaluated; this costs about as much as the run. If the last of its states changes a polynomial by more than the
    tolerances, the polynomial is compared with the constraints and the equations at two places of the interval. If it
    violates them, as beside a singular position or a force that jumps, the interval is divided into four steps of
    `DOP853` (of a Radau method where Newton's method was at work), or only its two ends are used, whichever fits best.
    Evaluations for this, and for restoring, are not counted.

    The solution takes 8 (2 + 3 n_q) bytes of memory per step.

    Attributes
    ----------
    t_min, t_max : float
        Times that the solution covers, s.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, dense_output=True)
    >>> state = result.sol([0.25, 0.5])
    >>> state.q.shape, state.lam.shape
    ((9, 2), (8, 2))
    >>> bool(abs(problem.system.constraint(0.25, state.q[:, 0])).max() < 1e-12)  # closed between steps
    True
    """

    def __init__(self, interpolator: Interpolator, table: Table, t_max: float):
        self.interpolator, self.table = interpolator, table
        self.t_min, self.t_max = float(table.t[0]), t_max

    def __call__(self, t: ArrayLike) -> DenseState:
        """Return the state at one time or at times (n,) in any order.

        Raises
        ------
        TypeError, ValueError
            If t is no number or vector, or not within the run.
        """
        times = check_real("t", t)
        if times.ndim > 1:
            raise ValueError(f"t must be a number or have shape (n,); given {shaped(times)}")
        outside = ~((times >= self.t_min) & (times <= self.t_max))  # also true for NaN
        if outside.any():
            raise ValueError(
                f"t must lie within the run, from {self.t_min!r} to {self.t_max!r}; given "
                f"{float(np.atleast_1d(times)[np.atleast_1d(outside)][0])!r}"
            )
        order = np.argsort(np.atleast_1d(times), kind="stable")
        rows = self.interpolator.states(self.table, np.atleast_1d(times)[order])
        return DenseState(self.interpolator, times, order, rows)

    def __repr__(self) -> str:
        return f"DenseSolution(from t = {self.t_min:g} to {self.t_max:g} s, {len(self.table.t) - 1} steps)"

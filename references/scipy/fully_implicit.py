"""Radau IIA and BDF for F(t, y, y') = 0 of the package solve_dae (J. Breuling), on any ConstrainedSystem.

The equations are those of `sundials.ida` in the form "stabilised", residual and Jacobian compiled by it; the methods
are Python. The package is optional: `pip install solve_dae`, or the extra `peers` of this project.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import OutOfTimeError, TimeLimit, check_choice, check_run, check_tolerances, user_call
from references.equations.redundant_rows import on_independent_rows
from references.sundials.ida import compiled_rates, compiled_residual, start_of
from twoloop.checks.consistency import check_start
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

Array = NDArray[np.float64]

METHODS: dict[str, dict[str, int]] = {
    "Radau": {"stages": 3},
    "Radau9": {"stages": 5},
    "BDF": {},
}


@on_independent_rows
def solve_fully_implicit(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    method: str = "Radau",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with a method of the package solve_dae.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem. Its callbacks are compiled into a residual and a Jacobian at the first run (a few seconds).
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    method : {"Radau", "Radau9", "BDF"}
        Radau IIA of 3 stages (order 5) or 5 stages (order 9), or BDF of orders 1 to 5 with NDF coefficients.
    rtol, atol : float
        Tolerances of all unknowns: q, v and the integrals Lam, Mu of the multipliers.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, by the method's interpolant. None: every step.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at in every evaluation of the residual. A run past it
        is a failed one. None: no limit.

    Returns
    -------
    Result
        `a` and `lam` are derivatives of unknowns, with the sign of M a + C_q^T lam = Q; between steps those of the
        interpolant. `h` holds all accepted steps. Of the statistics: n_accepted, n_evaluations (residuals, without
        those of the difference Jacobian) and n_factorizations. A failure gives what was computed before it,
        `Status.SOLVER_FAILED` and the package's text.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it. An exception of a Python callback comes through.
    RuntimeError
        If the package is not installed.
    """
    check_choice("method", method, METHODS)
    check_tolerances(rtol, atol)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit)
    check_start(system, t0, q0, v0)
    solver_type = _solver_type(method)

    y0, yp0 = start_of(system, "stabilised", t0, q0, v0)
    run = _Run(system, times, time_limit)
    options = {"rtol": float(rtol), "atol": float(atol), **METHODS[method]}
    with user_call as clock:
        run.go(solver_type, t0, t1, y0, yp0, options)
    return _result(method, run, t1, clock.seconds or 0.0)


def _solver_type(method: str) -> Callable[..., Any]:
    try:
        from solve_dae.integrate import BDFDAE, RadauDAE
    except ImportError as error:
        raise RuntimeError(
            "the package solve_dae is not installed. Install it, or this project with its extra: pip install "
            "'twoloop[peers]'"
        ) from error
    return BDFDAE if method == "BDF" else RadauDAE  # type: ignore[no-any-return]


class _Run:
    """The loop over a solver's steps, and what it stores."""

    def __init__(self, system: ConstrainedSystem, times: Array | None, time_limit: float | None):
        self.system, self.times = system, times
        self._residual, self._matrix = compiled_residual(system, "stabilised")
        self._rates = compiled_rates(system)
        self._sizes_and_p = (system.n_q, system.n_c, system.functions.p)
        self.rows: list[Array] = []  # [t y y']
        self.ends: list[float] = []  # of the accepted steps
        self.failure = ""
        self.counts: dict[str, int] = {}
        self.raised = False  # a callback raised an exception
        self.limit = TimeLimit(time_limit)

    def residual(self, t: float, y: Array, yp: Array) -> Array:
        """F(t, y, y')."""
        if time.monotonic() > self.limit.deadline:  # a call of `limit` would be 3 % of an evaluation
            self.limit.check()
        out = np.empty_like(y)
        try:
            self._residual(t, y, yp, out, *self._sizes_and_p)
        except BaseException:
            self.raised = True
            raise
        return out

    def jacobians(self, t: float, y: Array, yp: Array) -> tuple[Array, Array]:
        """dF/dy, which is differenced, and dF/dy', which is known."""
        by_y, by_yp = np.zeros((2, y.size, y.size))
        try:
            self._matrix(t, y, yp, 0.0, by_y, *self._sizes_and_p)
            self._rates(t, y, by_yp, *self._sizes_and_p)
        except BaseException:
            self.raised = True
            raise
        return by_y, by_yp

    def go(
        self, solver_type: Callable[..., Any], t0: float, t1: float, y0: Array, yp0: Array, options: dict[str, Any]
    ) -> None:
        """Integrate to t1 or to a failure, which leaves its text in `failure`."""
        self.ends.append(t0)
        if self.times is None or self.times[0] == t0:
            self.rows.append(np.concatenate([[t0], y0, yp0]))
        solver = None
        try:
            solver = solver_type(self.residual, t0, y0, yp0, t1, jac=self.jacobians, **options)
            while solver.status == "running" and not self.failure:
                self.failure = self._step(solver)
        except OutOfTimeError:
            self.failure = "out of time"
        except ValueError as error:
            # the package's linear algebra refuses NaN in this way; a callback's own exception comes through
            if self.raised:
                raise
            self.failure = str(error)
        if solver is not None:
            self.counts = {"n_evaluations": solver.nfev, "n_factorizations": solver.nlu}

    def _step(self, solver: Any) -> str:
        """Make a step and store it, or return why it failed."""
        message = solver.step()
        if solver.status == "failed":
            return str(message)
        if not (np.isfinite(solver.y).all() and np.isfinite(solver.yp).all()):
            return f"the state at t = {solver.t:.10g} is not finite"
        if self.times is None:
            self.rows.append(np.concatenate([[solver.t], solver.y, solver.yp]))
        else:
            first, last = np.searchsorted(self.times, [self.ends[-1], solver.t], side="right")
            for t in self.times[first:last]:
                state = (solver.y, solver.yp) if t == solver.t else solver.dense_output()(float(t))
                self.rows.append(np.concatenate([[t], *state]))
        self.ends.append(float(solver.t))
        return ""


def _result(method: str, run: _Run, t1: float, cpu: float) -> Result:
    n, m = run.system.n_q, run.system.n_c
    size = 2 * (n + m)
    columns = np.array(run.rows).reshape(-1, 1 + 2 * size).T
    y, yp = columns[1 : 1 + size], columns[1 + size :]
    name = f"{method} of solve_dae"
    message = f"{name} reached the end, t = {t1:g}."
    if run.limit.exceeded:
        message = run.limit.message(name, run.ends[-1], "take looser tolerances or another method")
    elif run.failure:
        message = (
            f"{name} failed after t = {run.ends[-1]:.10g}: {run.failure.rstrip('.')}. Look for a discontinuity, a "
            "singular position or a value that is not finite near this time, or try other tolerances."
        )
    return Result(
        t=columns[0],
        q=y[:n],
        v=y[n : 2 * n],
        a=yp[n : 2 * n],
        lam=yp[2 * n : 2 * n + m],
        h=np.diff(run.ends),
        status=Status.SOLVER_FAILED if run.failure else Status.REACHED_END,
        message=message,
        stats=Statistics(n_accepted=len(run.ends) - 1, cpu_time=cpu, **run.counts),
    )

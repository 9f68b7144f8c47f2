"""Radau IIA and BDF for F(t, y, y') = 0 of the package solve_dae (J. Breuling), on any ConstrainedSystem.

The equations are those of `sundials.residual` in the form "stabilised", residual and Jacobian compiled by it; the
methods are Python. The package is optional: `pip install solve_dae`, or the extra `peers` of this project.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import CAUSES, Task, TimeLimit, check_choice, check_task, imported, result_of, user_call
from references.equations.rows import on_independent_rows
from references.scipy.steps import Steps
from references.sundials.residual import (
    ALL,
    columns_of,
    iteration_matrix_at,
    parts_of,
    residual_at,
    space_of,
    start_of,
)
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics

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
    system, t_span, q0, v0, time_limit : see `references.driver`
    method : {"Radau", "Radau9", "BDF"}
        Radau IIA of 3 stages (order 5) or 5 stages (order 9), or BDF of orders 1 to 5 with NDF coefficients.
    rtol, atol : float
        Tolerances of all unknowns: q, v and the integrals Lam, Mu of the multipliers.
    t_eval : array_like, optional
        See `references.driver`. None: every step.

    Returns
    -------
    Result
        `a` and `lam` are derivatives of unknowns; between steps those of the interpolant. `h` holds all accepted steps.
        Of the statistics: n_accepted, n_evaluations (residuals, without those of the difference Jacobian) and
        n_factorizations.
    """
    check_choice("method", method, METHODS)
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, (rtol, atol), takes_velocity_rows=False)
    package, functions = imported("solve_dae.integrate"), Functions(task)
    solver_type = package.BDFDAE if method == "BDF" else package.RadauDAE
    y0, yp0 = start_of(system, "stabilised", task.t0, task.q0, task.v0)
    options = {"rtol": float(rtol), "atol": float(atol), "jac": functions.jacobians, **METHODS[method]}

    def made(limit: TimeLimit) -> Any:
        return solver_type(functions.residual(limit), task.t0, y0, yp0, task.t1, **options)

    limit, no_output = TimeLimit(time_limit), None if task.times is None else task.times[:0]
    run = Steps(made, task.t0, np.concatenate([y0, yp0]), functions, None, no_output, limit)
    with user_call as clock:
        run.go()
    shown, counts = run.again(task.times), {}
    if run.solver is not None:
        counts = {"n_evaluations": run.solver.nfev, "n_factorizations": run.solver.nlu}
    name = f"{method} of solve_dae"
    return result_of(
        system.n_q,
        shown.t,
        columns_of("stabilised", system.n_q, system.n_c, *np.split(shown.states, 2)),
        f"{name} reached the end, t = {task.t1:g}.",
        run.message(name, f"{CAUSES} other tolerances."),
        Statistics(n_accepted=len(run.ends) - 1, cpu_time=clock.seconds or 0.0, **counts),
        np.diff(run.ends),
    )


class Functions:
    """F(t, y, y') and its derivatives as the package calls them."""

    def __init__(self, task: Task):
        parts, n, m = parts_of(task.system, "stabilised", ALL), task.system.n_q, task.system.n_c
        self._residual, self.matrix = residual_at(parts), iteration_matrix_at(parts)
        self.space, self._sizes = space_of(task.system, "stabilised", task.t0, task.q0), (n, m)
        self.raised = False  # a callback raised an exception
        start = np.zeros((2, 2 * (n + m)))
        start[0, : 2 * n] = task.y0
        self.residual(TimeLimit(None))(task.t0, *start)  # compiles
        self.jacobians(task.t0, *start)

    def residual(self, limit: TimeLimit) -> Callable[[float, Array, Array], Array]:
        """F, which looks at the clock."""

        def residual(t: float, y: Array, yp: Array) -> Array:
            if time.monotonic() > limit.deadline:  # a call of `limit` would be 3 % of an evaluation
                limit.check()
            out = np.empty_like(y)
            try:
                self._residual(t, y, yp, *self.space[:3], out)
            except BaseException:
                self.raised = True
                raise
            return out

        return residual

    def jacobians(self, t: float, y: Array, yp: Array) -> tuple[Array, Array]:
        """dF/dy, which is differenced, and dF/dy', which is M, C_q^T and ones."""
        (n, m), (by_y, by_yp) = self._sizes, np.zeros((2, y.size, y.size))
        try:
            self.matrix(t, 0.0, y, yp, *self.space, by_y.T)
            self._residual(t, y, yp, *self.space[:3], np.empty_like(y))  # leaves M and C_q as they are at y
        except BaseException:
            self.raised = True
            raise
        _, M, Cq = self.space[:3]
        by_yp[:n, :n], by_yp[n : 2 * n, n : 2 * n] = np.eye(n), M
        by_yp[n : 2 * n, 2 * n : 2 * n + m] = by_yp[:n, 2 * n + m :] = Cq.T
        return by_y, by_yp

"""Radau IIA and BDF for F(t, y, y') = 0 of the package solve_dae (J. Breuling), on any ConstrainedSystem.

The equations are those of `sundials.residual` in the form "stabilised", with compiled residual and Jacobian; the
methods are in Python.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from references.driver import CAUSES, Task, TimeLimit, adapter, imported, user_call
from references.lines import Line
from references.scipy.index1 import Steps
from references.sundials.residual import Implicit
from twoloop.checks.arguments import check_choice
from twoloop.problem.problem import Array
from twoloop.result.result import Result

# relative to the span. From rest the package chooses 1e-6 of it, where rounding errors of C divided by the step exceed
# Newton's tolerance for the integrals of the multipliers; halving the step after a failure makes it worse
FIRST_STEP = 1e-3
METHODS: dict[str, dict[str, int]] = {"Radau": {"stages": 3}, "Radau9": {"stages": 5}, "BDF": {}}


@adapter(velocity_rows=False, independent_rows=True)
def solve_fully_implicit(task: Task, method: str = "Radau", rtol: float = 1e-8, atol: float = 1e-8) -> Result:
    """Integrate a constrained mechanical system by a method of the package solve_dae.

    "Radau" and "Radau9" are Radau IIA with 3 stages (order 5) and 5 stages (order 9); "BDF" has orders 1 to 5 with NDF
    coefficients. The tolerances are those of all unknowns: q, v and the integrals Lam, Mu of the multipliers. t_eval
    None: every step. `a` and `lam` are derivatives of unknowns, between steps those of the interpolant. Otherwise as in
    `references.driver`. Statistics: n_accepted, n_evaluations (residuals, without those of the difference Jacobian) and
    n_factorizations.
    """
    check_choice("method", method, tuple(METHODS))
    package, functions = imported("solve_dae.integrate"), Functions(task)
    solver_type = package.BDFDAE if method == "BDF" else package.RadauDAE
    first = FIRST_STEP * abs(task.t1 - task.t0)
    options = {"rtol": rtol, "atol": atol, "jac": functions.jacobians, "first_step": first, **METHODS[method]}

    def make_solver(limit: TimeLimit) -> Any:
        y0, yp0 = functions.form.start
        return solver_type(functions.residual(limit), task.t0, y0, yp0, task.t1, **options)

    run = Steps.timed(task, make_solver, functions.form.start.ravel())
    with user_call:
        run.go()
    (t, states), counts = run.output(task.times), {}
    if run.solver is not None:
        counts = {"n_evaluations": run.solver.nfev, "n_factorizations": run.solver.nlu}
    name, rows = f"{method} of solve_dae", functions.form.columns(*np.split(states, 2))
    failure = run.message(name, f"{CAUSES} other tolerances.")
    return task.result(name, t, rows, failure, h=np.diff(run.ends), n_accepted=len(run.ends) - 1, **counts)


class Functions:
    """F(t, y, y') and its derivatives in the signatures of the package."""

    def __init__(self, task: Task):
        self.form = form = Implicit(task, "stabilised")
        self.residual(TimeLimit(None))(task.t0, *form.start)  # compiles
        self.jacobians(task.t0, *form.start)

    def residual(self, limit: TimeLimit) -> Callable[[float, Array, Array], Array]:
        """Return F with a check of the time limit."""
        residual, space = self.form.residual, self.form.space[:3]

        def function(t: float, y: Array, yp: Array) -> Array:
            if time.monotonic() > limit.deadline:  # inlined: calling `limit` would cost 3 % of an evaluation
                limit.check()
            out = np.empty_like(y)
            residual(t, y, yp, *space, out)
            return out

        return function

    def jacobians(self, t: float, y: Array, yp: Array) -> tuple[Array, Array]:
        """Return dF/dy, by differences, and dF/dy', which consists of M, C_q^T and ones."""
        (n, m), (by_y, by_yp) = self.form.sizes, np.zeros((2, y.size, y.size))
        self.form.matrix(t, 0.0, y, yp, *self.form.space, by_y.T)
        self.form.residual(t, y, yp, *self.form.space[:3], np.empty_like(y))  # evaluates M and C_q at y
        _, M, Cq = self.form.space[:3]
        by_yp[:n, :n], by_yp[n : 2 * n, n : 2 * n] = np.eye(n), M
        by_yp[n : 2 * n, 2 * n : 2 * n + m] = by_yp[:n, 2 * n + m :] = Cq.T
        return by_y, by_yp


HOW: dict[str, Any] = {"called_from": "Python", "stores_steps": True}
LINES = tuple(
    Line(
        *(f"{method}, solve_dae", "solve-dae", "solve_dae", solve_fully_implicit, {"method": method}),
        **HOW | {"compared": method != "BDF", "checked": method == "Radau"},
    )
    for method in METHODS
)

"""SciPy's solvers on the index-1 ODE y = [q, v] of any ConstrainedSystem: plain, with Baumgarte's terms, or projected.

The accelerations are those of `equations.accelerations`; the right-hand side is compiled, and called from Python once
per evaluation. The integrator of twoloop is not used.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from scipy.integrate import BDF, DOP853, LSODA, RK45, OdeSolver, Radau

from references.driver import ADVICE, OutOfTimeError, Task, TimeLimit, adapter, imported, user_call
from references.equations.accelerations import OPTIONS, Equations, cached, matrix_of, solve_for
from references.equations.expressions import NotSymbolic
from references.equations.straight_line import exact_jacobian
from references.lines import Line
from twoloop.checks.arguments import check_choice, check_positive
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

NOT_FINITE = "infs or NaNs"  # in what SciPy's linear algebra says of them
SMALLEST_STEP = 10.0  # units in the last place of t: SciPy's own limit, which LSODA lacks


@dataclass
class Steps:
    """Steps of one run."""

    make: Callable[[TimeLimit], Any]  # limit -> the solver at its start; the limit is checked in every evaluation
    t0: float
    start: Array  # y, or [y, y']
    project: Callable[[float, Array], bool] | None  # (t, y) -> whether y, moved onto the constraints, is on them
    times: Array | None  # output times, by the solver's interpolant; None: the end of every step
    limit: TimeLimit
    ends: list[float] = field(default_factory=list)  # start and ends of the accepted steps, s
    stored: list[tuple[float, Array]] = field(default_factory=list)  # times and states: y, or [y, y']
    failure: str = ""  # error message; "": no failure
    solver: Any = None

    @classmethod
    def timed(cls, task: Task, make: Any, start: Array, project: Any = None) -> "Steps":
        """Return the timed run, which stores every step, or nothing if the task has output times."""
        times = None if task.times is None else task.times[:0]
        return cls(make, task.t0, start, project, times, TimeLimit(task.time_limit))

    def go(self) -> None:
        """Integrate to the end or to a failure."""
        self.ends.append(self.t0)
        if self.times is None or self.t0 in self.times[:1]:
            self.stored.append((self.t0, self.start))
        try:
            self.solver = self.make(self.limit)
            n_wanted = np.inf if self.times is None else self.times.size or np.inf  # number of output times
            while self.solver.status == "running" and not self.failure and len(self.stored) < n_wanted:
                self.failure = self._attempt()
                if not self.failure:
                    self._accept()
        except OutOfTimeError:
            self.failure = "out of time"
        except ValueError as error:  # raised by the implicit solvers' linear algebra for NaN, or else by a callback
            if NOT_FINITE not in str(error):
                raise
            self.failure = str(error)

    def output(self, times: Array | None) -> tuple[Array, Array]:
        """Return the given times that were reached, by the same steps, untimed, or those stored; states as columns."""
        stored = self.stored
        if times is not None:
            reached = times[times <= self.ends[-1]]
            steps = Steps(self.make, self.t0, self.start, self.project, reached, TimeLimit(None))
            if reached.size:
                steps.go()
            self.failure, stored = self.failure or steps.failure, steps.stored
        return np.array([t for t, _ in stored]), np.array([y for _, y in stored]).reshape(-1, self.start.size).T

    def message(self, name: str, advice: str) -> str:
        """Return the message of a failure; "" if there was none."""
        if self.limit.exceeded:
            return self.limit.message(name, self.ends[-1], "take looser tolerances or another method")
        failed = f"{name} failed after t = {self.ends[-1]:.10g}: {self.failure.rstrip('.')}. {advice}"
        return failed if self.failure else ""

    def _state(self) -> Array:
        solver = self.solver
        return np.concatenate([solver.y, solver.yp]) if hasattr(solver, "yp") else solver.y.copy()

    def _attempt(self) -> str:
        """Take a step; return an error message or ""."""
        solver, message = self.solver, self.solver.step()
        if solver.status == "failed":
            return str(message)
        # LSODA would continue in both cases, forever in the second
        if not np.isfinite(self._state()).all():
            return f"the state at t = {solver.t:.10g} is not finite"
        if solver.status == "running" and solver.t - self.ends[-1] < SMALLEST_STEP * np.spacing(abs(solver.t)):
            return f"the step has shrunk to {solver.t - self.ends[-1]:.3g} s"
        return ""

    def _accept(self) -> None:
        """Project and store the state after a step."""
        solver, t = self.solver, float(self.solver.t)
        due: list[float] = []
        if self.times is not None:
            first, last = np.searchsorted(self.times, [self.ends[-1], t], side="right")
            due = self.times[first:last].tolist()
        inside = [moment for moment in due if moment != t]
        if inside:
            # before the projection, because the interpolant depends on the solver's own y and f
            interpolant = solver.dense_output()
            for moment in inside:
                state = np.array(interpolant(moment)).ravel()
                if self._projected(moment, state):
                    self.stored.append((moment, state))
        y = self._state()
        if self.project is not None:
            if not self._projected(t, y):
                return
            solver.y = y.copy()
            if solver.status == "running":
                solver.f = solver.fun(t, solver.y)
        self.ends.append(t)
        if self.times is None or len(due) > len(inside):
            self.stored.append((t, y))

    def _projected(self, t: float, y: Array) -> bool:
        if self.project is None or self.project(t, y):
            return True
        self.failure = f"the projection onto the constraints at t = {t:.10g} did not converge"
        return False


METHODS: dict[str, type[OdeSolver]] = {"DOP853": DOP853, "RK45": RK45, "LSODA": LSODA, "Radau": Radau, "BDF": BDF}
ALPHAS = (1.0, 10.0, 100.0)  # 1/s: Baumgarte's parameter
PAIR = "Pr9"  # explicit Runge-Kutta pair of extensisq (P. J. Prince), of orders 9(8)
IMPLICIT = ("LSODA", "Radau", "BDF")  # always, or for stiff problems
ONE_STEP = ("DOP853", "RK45")  # explicit, with no state but y and f between steps, so projection is possible
STABILISATIONS = {
    "none": "C_q a = Q_d; drifts off the constraints",
    "baumgarte": "C_q a = Q_d - 2 alpha (C_q v + C_t) - alpha^2 C (Baumgarte 1972)",
    "projection": "C_q a = Q_d; q and v projected onto the constraints after every step (Eich 1993)",
}
ALPHA = 10.0  # 1/s, see solve_index1

INCREMENT = 1e-8  # m, rad, m/s or rad/s, of differences: about the root of the rounding
PROJECTED = 1e-10  # correction of q at convergence, relative to max(1, |q|); the remaining error is its square
MAX_PROJECTIONS = 10  # Newton iterations of a projection


@adapter(independent_rows=True)
def solve_index1(
    task: Task,
    method: str = "DOP853",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    stabilisation: str = "none",
    alpha: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system as the ODE q' = v, v' = a(t, q, v) by one of SciPy's solvers.

    Parameters
    ----------
    method : {"DOP853", "RK45", "LSODA", "Radau", "BDF", "Pr9"}
        The solver of `scipy.integrate`, or of extensisq (`PAIR`: on the four-bar the best of its pairs at tight
        tolerances). The implicit ones get the analytic Jacobian of `equations.straight_line`, if the equations can be
        had as expressions, without Baumgarte's terms; otherwise compiled forward differences with constant increments,
        because SciPy multiplies those of a coordinate without influence by ten at each Jacobian, without a bound.
    stabilisation : {"none", "baumgarte", "projection"}
        `STABILISATIONS` has a description of each for tables.

        "baumgarte": J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16, with beta = alpha, so that a
        violation decays as (1 + alpha t) exp(-alpha t). Every step adds to it: it is bounded and does not vanish.

        "projection": E. Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482. After every accepted step the positions are
        projected onto C = 0 by Newton's method, then the velocities onto C_q v + C_t = 0, both orthogonally in the norm
        of the mass matrix. So are states interpolated to `t_eval`. Only for "DOP853" and "RK45": the others keep a
        history that would have to be projected.
    alpha : float, optional
        Baumgarte's parameter, 1/s; only with stabilisation="baumgarte". None: 10. The right value depends on the
        problem. On the four-bar linkage 10 costs 13 to 21 % more evaluations than no stabilisation; above 20 the ODE
        becomes stiff.
    others : see `references.driver`
        t_eval None: every step.

    Returns
    -------
    Result
        `a` and `lam` are computed as in the right-hand side, with Baumgarte's terms if used. Statistics: n_accepted;
        n_evaluations of the right-hand side, excluding those for the interpolant; n_factorizations, SciPy's LU count.
    """
    check_choice("method", method, (*METHODS, PAIR))
    check_choice("stabilisation", stabilisation, tuple(STABILISATIONS))
    projected, damped = stabilisation == "projection", stabilisation == "baumgarte"
    if projected and method not in ONE_STEP:
        raise ValueError(
            f"stabilisation='projection' needs an explicit one-step method, {' or '.join(ONE_STEP)}: the others keep a "
            f"history that is not projected; given method={method!r}"
        )
    if alpha is not None:
        check_positive("alpha", alpha)
        if not damped:
            raise ValueError(
                f"alpha belongs to stabilisation='baumgarte'; given alpha={alpha!r} with {stabilisation!r}"
            )
    t0, y0 = task.t0, task.y0
    solver_type = METHODS[method] if method in METHODS else getattr(imported("extensisq"), method)
    equations = RightHandSide(task.system, t0, task.q0, float(alpha or ALPHA) if damped else 0.0)
    equations.warm(t0, y0, projected)
    options: dict[str, Any] = {"rtol": rtol, "atol": atol}
    options |= {} if max_step is None else {"max_step": task.longest(max_step)}
    if method in IMPLICIT:
        options["jac"] = equations.jacobian(t0, y0) or equations.differences(t0, y0)

    def make_solver(limit: TimeLimit) -> OdeSolver:
        return solver_type(equations.function(limit), t0, y0, task.t1, **options)

    run = Steps.timed(task, make_solver, y0, equations.project if projected else None)
    with user_call:
        run.go()
    counts = {"n_accepted": len(run.ends) - 1, "n_evaluations": int(equations.counters[0])}
    if isinstance(run.solver, Radau | BDF):
        counts["n_factorizations"] = run.solver.nlu
    t, states = run.output(task.times)
    rows = np.concatenate([states, *equations.at_points(t, states, equations.alpha)])
    return task.result(method, t, rows, run.message(method, ADVICE), h=np.diff(run.ends), **counts)


class RightHandSide(Equations):
    """The ODE of one system in SciPy's signature, and the projection onto its constraints."""

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array, alpha: float):
        super().__init__(system, t0, q0)
        f = system.functions
        self.alpha = alpha
        self.derivative = _derivative(self.accelerate)
        self.projection = _projection(f.mass, f.constraint, f.jacobian, f.constraint_rate)
        self.counters = np.zeros(1, dtype=np.int64)

    def function(self, limit: TimeLimit) -> Callable[[float, Array], Array]:
        """Return y' = f(t, y) in SciPy's signature."""
        derivative, n_c, alpha = self.derivative, self.system.n_c, self.alpha
        p, factors, mass_flags, counters = self.system.functions.p, self.factors, self.known, self.counters

        monotonic, deadline = time.monotonic, limit.deadline  # inlined: calling `limit` would cost 3 % of an evaluation

        def fun(t, y):  # type: ignore[no-untyped-def]
            if monotonic() > deadline:
                limit.check()
            return derivative(t, y, n_c, alpha, p, factors, mass_flags, counters)

        return fun  # type: ignore[no-any-return]

    def jacobian(self, t: float, y: Array) -> Callable[[float, Array], Array] | None:
        """Return df/dy in SciPy's signature, compiled; None if it is not available."""
        if self.alpha > 0.0:
            return None
        try:
            derivatives = exact_jacobian(self.system, t, *map(bytes, np.split(y, 2)))
        except NotSymbolic:
            return None

        def jac(t: float, y: Array) -> Array:
            columns = np.zeros((y.size, y.size))
            derivatives(t, y, columns)
            return columns.T

        jac(t, y)  # compiles
        return jac

    def differences(self, t: float, y: Array) -> Callable[[float, Array], Array]:
        """Return df/dy in SciPy's signature, by forward differences, compiled; their evaluations are counted."""
        columns, n_c, alpha = _differences(self.accelerate), self.system.n_c, self.alpha
        p, factors, mass_flags, counters = self.system.functions.p, self.factors, self.known, self.counters

        def jac(t: float, y: Array) -> Array:
            return columns(t, y, n_c, alpha, p, factors, mass_flags, counters).T  # type: ignore[no-any-return]

        jac(t, y)  # compiles
        self.counters[:] = 0
        return jac

    def project(self, t: float, y: Array) -> bool:
        """Project y onto the constraints; return False if that does not converge."""
        return bool(self.projection(t, y, self.system.n_c, self.system.functions.p, self.factors, self.known))

    def warm(self, t: float, y: Array, projection: bool) -> None:
        """Compile everything that the run calls, so that it is not timed."""
        self.function(TimeLimit(None))(t, y)
        if projection:
            self.project(t, y.copy())
        self.counters[:] = 0


@lru_cache(maxsize=64)
def _derivative(accelerate: Callable[..., Any]) -> Callable[..., Any]:
    """Return (t, y, n_c, alpha, p, factors, mass_flags, counters) -> y'."""

    @cached
    def derivative(t, y, m, alpha, p, factors, mass_flags, counters):  # type: ignore[no-untyped-def]
        n = y.size // 2
        rate = np.empty(2 * n)
        counters[0] += 1
        good = accelerate(t, y[:n].copy(), y[n:].copy(), alpha, p, factors, mass_flags, rate[n:], np.empty(m))
        for i in range(n):
            rate[i] = y[n + i]
            if not good:
                rate[n + i] = np.nan
        return rate

    return derivative  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _differences(accelerate: Callable[..., Any]) -> Callable[..., Any]:
    """Return (t, y, n_c, alpha, p, factors, mass_flags, counters) -> (dy'/dy)^T."""
    derivative = _derivative(accelerate)

    @cached
    def differences(t, y, m, alpha, p, factors, mass_flags, counters):  # type: ignore[no-untyped-def]
        columns = np.empty((y.size, y.size))
        rate, displaced = derivative(t, y, m, alpha, p, factors, mass_flags, counters), y.copy()
        for j in range(y.size):
            displaced[j] += INCREMENT * max(1.0, abs(y[j]))
            displaced_rate = derivative(t, displaced, m, alpha, p, factors, mass_flags, counters)
            columns[j] = (displaced_rate - rate) / (displaced[j] - y[j])
            displaced[j] = y[j]
        return columns

    return differences  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _projection(
    mass: Dispatcher, constraint: Dispatcher, jacobian: Dispatcher, constraint_rate: Dispatcher
) -> Callable[..., Any]:
    """Return (t, y, n_c, p, factors, mass_flags) -> success, which projects y in place: positions, then velocities."""
    mass_at = matrix_of(mass)

    @cached
    def project(t, y, m, p, factors, mass_flags):  # type: ignore[no-untyped-def]
        n = y.size // 2
        q, v = y[:n].copy(), y[n:].copy()
        Cq, C = np.zeros((m, n)), np.zeros(m)
        L, definite = mass_at(t, q, p, factors, mass_flags)
        size = 1.0
        for j in range(n):
            size = max(size, abs(q[j]))
        change, tries = np.inf, 0
        while not change <= PROJECTED * size:
            if tries == MAX_PROJECTIONS:
                return False
            tries += 1
            Cq[:, :] = 0.0
            C[:] = 0.0
            jacobian(t, q, p, Cq)
            constraint(t, q, p, C)
            change = _least_change(L, definite, mass_flags, Cq, C, q)
            if change == np.inf:
                return False
        Cq[:, :] = 0.0
        C[:] = 0.0
        jacobian(t, q, p, Cq)
        constraint_rate(t, q, p, C)
        for i in range(m):
            for j in range(n):
                C[i] += Cq[i, j] * v[j]
        if _least_change(L, definite, mass_flags, Cq, C, v) == np.inf:
            return False
        for j in range(n):
            y[j] = q[j]
            y[n + j] = v[j]
        return True

    return project  # type: ignore[no-any-return]


@njit(**OPTIONS)
def _least_change(L, definite, mass_flags, Cq, C, x):  # type: ignore[no-untyped-def]
    """Subtract d from x, with M d + C_q^T mu = 0, C_q d = C; return the largest change, inf if singular. Destroys C."""
    change, largest = np.zeros(x.size), 0.0
    if not solve_for(L, definite, mass_flags, Cq, change, C):
        return np.inf
    for j in range(x.size):
        x[j] -= change[j]
        largest = max(largest, abs(change[j]))
        if not np.isfinite(change[j]):
            return np.inf
    return largest


def baumgarte(method: str, alpha: float) -> str:
    """Return the name of one of SciPy's solvers with Baumgarte's stabilisation."""
    return f"{method}, Baumgarte {alpha:g}"


def _line(name: str, method: str, stabilisation: str = "none", **fields: Any) -> Line:
    package = "extensisq" if method == "Pr9" else "scipy"
    fields = {"called_from": "Python", "keeps": False, "stores_steps": True, **fields}
    options = {"method": method, "stabilisation": stabilisation, **fields.get("fixed", {})}
    return Line(name, package, "extensisq" if method == "Pr9" else "SciPy", solve_index1, options, **fields)


LINES = (
    _line("LSODA, index 1", "LSODA", checked=True),
    _line("DOP853, index 1", "DOP853"),
    _line("RK45, index 1", "RK45", compared=False),
    _line("DOP853, projected", "DOP853", "projection", keeps=True, checked=True),
    _line("RK45, projected", "RK45", "projection", keeps=True, compared=False),
    *(_line(f"{name}, index 1", name) for name in ("Pr9", "Radau", "BDF")),
    *(
        _line(baumgarte(name, alpha), name, "baumgarte", compared=False, fixed={"alpha": alpha})
        for name in ("LSODA", "DOP853")
        for alpha in ALPHAS
    ),
)

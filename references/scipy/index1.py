"""SciPy's solvers on the index-1 ODE y = [q, v] of any ConstrainedSystem: plain, Baumgarte's, or with projection.

The accelerations are those of `equations.accelerations`; the right-hand side is compiled, and called from Python once
an evaluation. Nothing here uses the integrator of twoloop, but its small dense factorisations are shared.
"""

import time
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import BDF, DOP853, LSODA, RK45, OdeSolver, Radau

from references.driver import (
    OutOfTimeError,
    TimeLimit,
    check_choice,
    check_run,
    check_tolerances,
    longest_step,
    user_call,
)
from references.equations.accelerations import OPTIONS, Equations, matrix_of, saddle_solve, schur_factors, times_inverse
from references.equations.expressions import NotSymbolic
from references.equations.nonholonomic import with_all_rows
from references.equations.redundant_rows import on_independent_rows
from references.equations.straight_line import straight_line_jacobian
from twoloop.checks.arguments import check_positive
from twoloop.checks.consistency import check_start
from twoloop.kernels.algebra.linalg import ldl_solve
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

Array = NDArray[np.float64]

METHODS: dict[str, type[OdeSolver]] = {"DOP853": DOP853, "RK45": RK45, "LSODA": LSODA, "Radau": Radau, "BDF": BDF}
PAIRS = ("Pr8", "Pr9")  # explicit Runge-Kutta pairs of extensisq (P. J. Prince), of orders 8(7) and 9(8)
IMPLICIT = ("LSODA", "Radau", "BDF")  # wholly, or where the problem is stiff
ONE_STEP = ("DOP853", "RK45")  # explicit, and nothing of them but y and f outlives a step: they can be projected
STABILISATIONS = {
    "none": "C_q a = Q_d; drifts off the constraints",
    "baumgarte": "C_q a = Q_d - 2 alpha (C_q v + C_t) - alpha^2 C (Baumgarte 1972)",
    "projection": "C_q a = Q_d; q and v projected onto the constraints after every step (Eich 1993)",
}
ALPHA = 10.0  # 1/s, see solve_index1

PROJECTED = 1e-10  # correction of q, relative to max(1, |q|), at which a projection ends: what is left is its square
MAX_PROJECTIONS = 10  # Newton iterations of a projection
SMALLEST_STEP = 10.0  # spacings of the numbers at t: SciPy's own limit, which LSODA alone does not have


@on_independent_rows
def solve_index1(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    method: str = "DOP853",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    stabilisation: str = "none",
    alpha: float | None = None,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system as the ODE q' = v, v' = a(t, q, v) with one of SciPy's solvers.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem. Its callbacks are compiled into a right-hand side at the first run (a few seconds).
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    method : {"DOP853", "RK45", "LSODA", "Radau", "BDF", "Pr8", "Pr9"}
        The solver of `scipy.integrate`, or of extensisq (`PAIRS`: on the four-bar the best of its pairs from 1e-5 down,
        Pr9 at tight tolerances). The implicit ones get the analytic Jacobian as straight-line code, where the equations
        can be had as expressions of up to `straight_line.MOST_OPERATIONS`, without Baumgarte's terms; else they
        difference the right-hand side.
    rtol, atol : float
        SciPy's tolerances for q and v.
    stabilisation : {"none", "baumgarte", "projection"}
        `STABILISATIONS` describes each in a line fit for a table.

        "baumgarte": J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16. Of his two parameters, in
        C'' + 2 alpha C' + beta^2 C = 0, beta = alpha, so that a violation decays as (1 + alpha t) exp(-alpha t),
        without oscillation. It is fed anew by every step, and so stays bounded but does not vanish.

        "projection": E. Eich, SIAM J. Numer. Anal. 30 (1993) 1467-1482. After every accepted step the positions are
        moved onto C = 0 by Newton's method, then the velocities onto C_q v + C_t = 0, both by the least change in the
        norm of the mass matrix; the next step begins with a right-hand side evaluated there (one more evaluation a
        step). States interpolated to `t_eval` are projected too. Only for "DOP853" and "RK45": the others go on from
        a history that a projection would have to change with y.
    alpha : float, optional
        Baumgarte's parameter, 1/s; only with stabilisation="baumgarte". None: 10. Nothing tells the right value, for
        it is a rate of the problem; 1 to 10 is called typical (MapleSim's manual of its exports). On the four-bar
        linkage (period 2.25 s, DOP853, tolerances 1e-6 and 1e-9, 100 s) 10 costs 21 and 13 % more evaluations than no
        stabilisation, and its error is 1/300 and 1/35; from 20 on the cost grows with alpha: the ODE becomes stiff.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, by the solver's interpolant, in a second run of the
        same steps that is not timed. None: every step.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at in every evaluation of the right-hand side. A run
        past it is a failed one. None: no limit.
    max_step : float, optional
        The longest step that it may take, s. None: the length of t_span.

    Returns
    -------
    Result
        `a` and `lam` (with the sign of M a + C_q^T lam = Q) computed from the stored q and v as in the right-hand
        side, so with Baumgarte's terms where they are used. `h` holds all accepted steps. Of the statistics:
        n_accepted; n_evaluations, all evaluations of the right-hand side, those for a difference Jacobian and after a
        projection included, those for the interpolant not; n_factorizations, SciPy's LU count, for "Radau" and "BDF".
        cpu_time is that of the integration, without the final `a` and `lam`. A failure gives what was computed before
        it, `Status.SOLVER_FAILED` and the solver's text.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it. An exception of a Python callback comes through.
    RuntimeError
        If extensisq is asked for and not installed.
    """
    _check_choices(method, stabilisation, alpha)
    check_tolerances(rtol, atol)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit, takes_velocity_rows=True)
    check_start(system, t0, q0, v0)
    system = with_all_rows(system)
    solver_type = METHODS[method] if method in METHODS else _pair(method)

    strength = (ALPHA if alpha is None else float(alpha)) if stabilisation == "baumgarte" else 0.0
    equations = RightHandSide(system, t0, q0, strength)
    y0 = np.concatenate([q0, v0])
    equations.warm(t0, y0, stabilisation == "projection")
    projected = stabilisation == "projection"
    options: dict[str, Any] = {"rtol": float(rtol), "atol": float(atol)}
    options |= {} if max_step is None else {"max_step": longest_step(max_step, t1 - t0)}
    if method in IMPLICIT and (jacobian := equations.jacobian(t0, y0)):
        options["jac"] = jacobian
    run = _Run(equations, None if times is None else times[:0], projected, time_limit)
    with user_call as clock:
        run.go(solver_type, t0, y0, t1, options)
    evaluations, shown = int(equations.counters[0]), run
    if times is not None:
        shown = _Run(equations, times[times <= run.ends[-1]], projected, None)
        if times[0] <= run.ends[-1]:
            shown.go(solver_type, t0, y0, t1, options)
        run.failure = run.failure or shown.failure
    return _result(method, equations, run, shown, evaluations, t1, clock.seconds or 0.0)


def _pair(method: str) -> type[OdeSolver]:
    try:
        import extensisq
    except ImportError as error:
        raise RuntimeError("extensisq is not installed: make peers, or pip install 'twoloop[peers]'") from error
    return getattr(extensisq, method)  # type: ignore[no-any-return]


def _check_choices(method: str, stabilisation: str, alpha: float | None) -> None:
    check_choice("method", method, (*METHODS, *PAIRS))
    check_choice("stabilisation", stabilisation, STABILISATIONS)
    if stabilisation == "projection" and method not in ONE_STEP:
        raise ValueError(
            f"stabilisation='projection' needs an explicit one-step method, {' or '.join(ONE_STEP)}: the others carry "
            f"what a projection does not change from step to step; given method={method!r}"
        )
    if alpha is not None:
        check_positive("alpha", alpha)
        if stabilisation != "baumgarte":
            raise ValueError(
                f"alpha belongs to stabilisation='baumgarte'; given alpha={alpha!r} with {stabilisation!r}"
            )


class RightHandSide(Equations):
    """The ODE of one system as SciPy calls it, and the projection onto its constraints."""

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array, alpha: float):
        super().__init__(system, t0, q0)
        f = system.functions
        self.alpha = alpha
        self.derivative = _derivative(self.accelerate)
        self.projection = _projection(f.mass, f.constraint, f.jacobian, f.constraint_rate)
        self.counters = np.zeros(1, dtype=np.int64)
        self.raised = False  # a callback raised an exception

    def function(self, limit: TimeLimit) -> Callable[[float, Array], Array]:
        """y' = f(t, y) as SciPy calls it."""
        derivative, n_c, alpha = self.derivative, self.system.n_c, self.alpha
        p, factors, known, counters = self.system.functions.p, self.factors, self.known, self.counters

        monotonic, deadline = time.monotonic, limit.deadline  # a call of `limit` would be 3 % of an evaluation

        def fun(t, y):  # type: ignore[no-untyped-def]
            if monotonic() > deadline:
                limit.check()
            try:
                return derivative(t, y, n_c, alpha, p, factors, known, counters)
            except BaseException:
                self.raised = True
                raise

        return fun  # type: ignore[no-any-return]

    def jacobian(self, t: float, y: Array) -> Callable[[float, Array], Array] | None:
        """df/dy as SciPy calls it, compiled; None where it cannot be had, or is too long to be compiled."""
        try:
            derivatives = None if self.alpha > 0.0 else straight_line_jacobian(self.system, t, *np.split(y, 2))
        except NotSymbolic:
            return None
        if derivatives is None:
            return None

        def jac(t: float, y: Array) -> Array:
            columns = np.zeros((y.size, y.size))
            derivatives(t, y, columns)
            return columns.T

        jac(t, y)  # compiles
        return jac

    def project(self, t: float, y: Array) -> bool:
        """Move y onto the constraints; False if that does not converge."""
        return bool(self.projection(t, y, self.system.n_c, self.system.functions.p, self.factors, self.known))

    def warm(self, t: float, y: Array, projection: bool) -> None:
        """Compile what the run calls, so that its time does not hold that."""
        self.function(TimeLimit(None))(t, y)
        if projection:
            self.project(t, y.copy())
        self.counters[:] = 0


class _Run:
    """The loop over a solver's steps, and what it stores."""

    def __init__(
        self, equations: RightHandSide, times: Array | None, projection: bool, time_limit: float | None
    ) -> None:
        self.equations, self.times, self.projection = equations, times, projection
        self.limit = TimeLimit(time_limit)
        self.ends: list[float] = []  # of the accepted steps
        self.t: list[float] = []
        self.y: list[Array] = []
        self.failure = ""
        self.n_factorizations: int | None = None

    def go(self, solver_type: type[OdeSolver], t0: float, y0: Array, t1: float, options: dict[str, Any]) -> None:
        """Integrate to t1 or to a failure, which leaves its text in `failure`."""
        self.ends.append(t0)
        if self.times is None or t0 in self.times[:1]:
            self._store(t0, y0)
        solver = None
        try:
            solver = solver_type(self.equations.function(self.limit), t0, y0, t1, **options)
            while solver.status == "running" and not self.failure and not self._has_all():
                self.failure = self._attempt(solver)
                if not self.failure:
                    self._accept(solver)
        except OutOfTimeError:
            self.failure = "out of time"
        self.n_factorizations = solver.nlu if isinstance(solver, Radau | BDF) else None

    def _has_all(self) -> bool:
        """Whether the output times of a run that is for them alone are stored."""
        return bool(self.times is not None and 0 < self.times.size == len(self.t))

    def _attempt(self, solver: OdeSolver) -> str:
        """Make a step, and return why it failed."""
        try:
            message = solver.step()
        except ValueError as error:
            # the implicit solvers' linear algebra refuses NaN in this way; a callback's own exception comes through
            if self.equations.raised:
                raise
            return str(error)
        if solver.status == "failed":
            return str(message)
        # LSODA would go on in both cases, without end in the second
        if not np.isfinite(solver.y).all():
            return f"the state at t = {solver.t:.10g} is not finite"
        if solver.status == "running" and solver.t - self.ends[-1] < SMALLEST_STEP * np.spacing(abs(solver.t)):
            return f"the step has shrunk to {solver.t - self.ends[-1]:.3g} s"
        return ""

    def _accept(self, solver: OdeSolver) -> None:
        """Project and store what a step gave."""
        t = float(solver.t)
        due = [] if self.times is None else self._due(t)
        inside = [moment for moment in due if moment != t]
        if inside:
            # before the projection: the interpolant belongs to the solver's own y and f
            interpolant = solver.dense_output()
            for moment in inside:
                self._project_and_store(moment, interpolant(moment))
        y = solver.y.copy()
        if self.projection:
            if not self._projected(t, y):
                return
            solver.y = y.copy()
            if solver.status == "running":
                solver.f = solver.fun(t, solver.y)
        self.ends.append(t)
        if self.times is None or len(due) > len(inside):
            self._store(t, y)

    def _due(self, t: float) -> list[float]:
        """Output times after the last step's end and up to t."""
        assert self.times is not None
        first, last = np.searchsorted(self.times, [self.ends[-1], t], side="right")
        return [float(moment) for moment in self.times[first:last]]

    def _project_and_store(self, t: float, y: Array) -> None:
        if not self.projection or self._projected(t, y):
            self._store(t, y)

    def _projected(self, t: float, y: Array) -> bool:
        if self.equations.project(t, y):
            return True
        self.failure = f"the projection onto the constraints at t = {t:.10g} did not converge"
        return False

    def _store(self, t: float, y: Array) -> None:
        self.t.append(t)
        self.y.append(y)


def _result(
    method: str, equations: RightHandSide, run: _Run, shown: _Run, evaluations: int, t1: float, cpu: float
) -> Result:
    """The Result of what `shown` has stored, of a run that took so many evaluations."""
    n = equations.system.n_q
    t = np.array(shown.t)
    states = np.array(shown.y).reshape(-1, 2 * n).T
    a, lam = equations.at_points(t, states, equations.alpha)
    message = f"{method} reached the end, t = {t1:g}."
    if run.limit.exceeded:
        message = run.limit.message(method, run.ends[-1], "take looser tolerances or another method")
    elif run.failure:
        message = (
            f"{method} failed after t = {run.ends[-1]:.10g}: {run.failure.rstrip('.')}. "
            "Look for a discontinuity, a singular position or a value that is not finite near this time, or try other "
            "tolerances or another method."
        )
    return Result(
        t=t,
        q=states[:n],
        v=states[n:],
        a=a,
        lam=lam,
        h=np.diff(run.ends),
        status=Status.SOLVER_FAILED if run.failure else Status.REACHED_END,
        message=message,
        stats=Statistics(
            n_accepted=len(run.ends) - 1,
            n_evaluations=evaluations,
            n_factorizations=run.n_factorizations,
            cpu_time=cpu,
        ),
    )


@lru_cache(maxsize=64)
def _derivative(accelerate: Callable[..., Any]) -> Callable[..., Any]:
    """(t, y, n_c, alpha, p, factors, known, counters) -> y'."""

    @njit(**OPTIONS)
    def derivative(t, y, m, alpha, p, factors, known, counters):  # type: ignore[no-untyped-def]
        n = y.size // 2
        rate = np.empty(2 * n)
        counters[0] += 1
        good = accelerate(t, y[:n].copy(), y[n:].copy(), alpha, p, factors, known, rate[n:], np.empty(m))
        for i in range(n):
            rate[i] = y[n + i]
            if not good:
                rate[n + i] = np.nan
        return rate

    return derivative  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _projection(
    mass: Dispatcher, constraint: Dispatcher, jacobian: Dispatcher, constraint_rate: Dispatcher
) -> Callable[..., Any]:
    """(t, y, n_c, p, factors, known) -> success; y is projected in place, positions by Newton, then velocities."""
    mass_at = matrix_of(mass)

    @njit(**OPTIONS)
    def project(t, y, m, p, factors, known):  # type: ignore[no-untyped-def]
        n = y.size // 2
        q, v = y[:n].copy(), y[n:].copy()
        Cq, C = np.zeros((m, n)), np.zeros(m)
        L, definite = mass_at(t, q, p, factors, known)
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
            change = _least_change(L, definite, known, Cq, C, q)
            if change == np.inf:
                return False
        Cq[:, :] = 0.0
        C[:] = 0.0
        jacobian(t, q, p, Cq)
        constraint_rate(t, q, p, C)
        for i in range(m):
            for j in range(n):
                C[i] += Cq[i, j] * v[j]
        if _least_change(L, definite, known, Cq, C, v) == np.inf:
            return False
        for j in range(n):
            y[j] = q[j]
            y[n + j] = v[j]
        return True

    return project  # type: ignore[no-any-return]


@njit(**OPTIONS)
def _least_change(L, definite, known, Cq, C, x):  # type: ignore[no-untyped-def]
    """x -= M^-1 C_q^T S^-1 C, and the largest change; infinite when S is singular. C is lost.

    Where M is not positive definite, x changes by the d of M d + C_q^T mu = 0 and C_q d = C, which is the same.
    """
    m, n = Cq.shape
    change = np.zeros(n)
    if definite:
        S, good = schur_factors(L, known, Cq)
        if not good:
            return np.inf
        ldl_solve(S, C)
        for i in range(m):
            for j in range(n):
                change[j] += Cq[i, j] * C[i]
        times_inverse(L, known, change)
    elif not saddle_solve(L, Cq, change, C):
        return np.inf
    largest = 0.0
    for j in range(n):
        x[j] -= change[j]
        largest = max(largest, abs(change[j]))
        if not np.isfinite(change[j]):
            return np.inf
    return largest

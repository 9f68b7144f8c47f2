"""SUNDIALS IDA, by scikit-sundae, on any ConstrainedSystem: residual and Jacobian compiled from its callbacks.

IDA solves F(t, y, y') = 0 by variable-order BDF (orders 1 to 5). The index-3 equations are brought to index 1 in one
of the two ways of `FORMS`; nothing here uses the integrator of twoloop.
"""

import io
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import lru_cache
from typing import Any

import numpy as np
import sksundae
from numba import njit, types
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray

from references.driver import TimeLimit, check_choice, check_run, check_tolerances, longest_step, user_call
from references.equations.accelerations import compiled_gamma
from references.equations.nonholonomic import with_all_rows
from references.equations.ode import states_at
from references.equations.redundant_rows import on_independent_rows
from references.sundials.ida_options import (
    ALL,
    HIGHEST_ORDER,
    NOT_TESTED,
    check_options,
    no_force,
    own_tangent,
    tolerances,
)
from twoloop.checks.consistency import check_start
from twoloop.kernels.compile.callbacks import stand_in
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

Array = NDArray[np.float64]

FORMS = {
    "index1": "index 1: C_q v' = Q_d; multipliers out of the error test (atol 1e12)",
    "stabilised": "GGL, integrated multipliers: C = 0 and C_q v + C_t = 0; multipliers' integrals in the error test",
}

SMALLEST_STEP = (
    1e-12  # of the length of t_span; without a smallest step IDA shrinks its steps towards a NaN without end
)
DIFFERENCE = 1e-7  # displacement for the derivatives of the residual, relative to max(1, |value|)

_READ = types.Array(types.float64, 1, "C", readonly=True)  # IDA hands y and y' over as read-only arrays
_VECTOR = types.float64[::1]
_MATRIX = types.float64[:, ::1]
_SIZES = (types.int64, types.int64)
_RESIDUAL = types.void(types.float64, _READ, _READ, _VECTOR, *_SIZES, _VECTOR)
_JACOBIAN = types.void(types.float64, _READ, _READ, types.float64, _MATRIX, *_SIZES, _VECTOR)


@on_independent_rows
def solve_ida(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    form: str = "index1",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    max_order: int = HIGHEST_ORDER,
    error_test: str = "all",
    time_limit: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with IDA.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem. Its callbacks are compiled into a residual and a Jacobian at the first run (a few seconds). The
        Jacobian is by differences; with `force_by_q` what is differenced is the residual without the force.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    form : {"index1", "stabilised"}
        How the index is reduced; `FORMS` describes each in a line fit for a table.

        "index1": unknowns q, v, lam; q' = v, M v' + C_q^T lam = Q, C_q v' = Q_d. Drifts off the constraints.

        "stabilised": Gear, Gupta and Leimkuhler (1985) with the multipliers as time derivatives of further unknowns
        Lam, Mu; q' = v - C_q^T Mu', M v' + C_q^T Lam' = Q, C = 0, C_q v + C_t = 0. Rows A v + b = 0 stand below
        C_q v + C_t = 0; their Mu is zero.
    rtol, atol : float
        IDA's tolerances for q, v (and Lam, Mu in the stabilised form). At a given tolerance the error at the end
        scatters by a factor of 2 to 24 (15 runs) with rounding alone, which changes IDA's choice of steps and orders.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, interpolated by IDA, in a second run of the same
        steps that is not timed. None: every step is stored, which scikit-sundae does by copying all before it.
    max_order : int
        The highest order of the BDF, 1 to 5. Those above 2 are unstable for undamped vibrations that the step does not
        resolve.
    error_test : {"all", "states", "positions"}
        What the error test, and that of Newton's iteration, sees: all unknowns but the algebraic lam of the form
        "index1", q and v, or q alone. IDA's norm is a mean over all unknowns: the fewer it sees, the looser the same
        tolerance.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at in every evaluation of the residual. A run past it
        is a failed one. None: no limit.
    max_step : float, optional
        The longest step that it may take, s. None: the length of t_span.

    Returns
    -------
    Result
        `a` and `lam` as IDA has them, with the sign of M a + C_q^T lam = Q. `h` holds the steps when every step is
        stored and is empty otherwise. Of the statistics IDA tells residual evaluations (n_evaluations), Jacobian
        evaluations, each with its factorisation (n_factorizations), and, when every step is stored, n_accepted.
        A failure of IDA gives what was computed before it, `Status.SOLVER_FAILED` and IDA's status and text.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it. An exception of a Python callback comes through.
    """
    check_choice("form", form, FORMS)
    check_tolerances(rtol, atol)
    max_order = check_options(max_order, error_test)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit, takes_velocity_rows=True)
    check_start(system, t0, q0, v0)
    positions, system = system.n_c if system.n_a else ALL, with_all_rows(system)

    size = 2 * system.n_q + _n_multipliers(system, form)
    absolute = tolerances(system, size, error_test, float(atol))
    if form == "index1":
        absolute[2 * system.n_q :] = NOT_TESTED
    y0, yp0 = start_of(system, form, t0, q0, v0)
    limit, said = TimeLimit(time_limit), io.StringIO()
    options = {
        "rtol": float(rtol),
        "atol": absolute,
        "max_order": max_order,
        "min_step": SMALLEST_STEP * (t1 - t0),
        "max_step": longest_step(max_step, t1 - t0),
        "max_num_steps": 10**9,  # per output time
    }
    compiled = compiled_residual(system, form, positions)
    solver = _solver(system, compiled, options, limit)
    with redirect_stdout(said), user_call as clock:
        if times is None:
            outcome = solver.solve(np.array([t0, t1]), y0, yp0)
        else:
            solver.init_step(t0, y0, yp0)
            outcome = solver.step(t1, tstop=t1)
    shown = outcome
    if times is not None:
        solver = _solver(system, compiled, options, TimeLimit(None))
        shown = states_at(solver, (t0, t1), times[times <= outcome.t], y0, yp0)
    return _result(system, form, outcome, shown, times is None, said.getvalue(), clock.seconds or 0.0, limit)


def _solver(
    system: ConstrainedSystem,
    compiled: tuple[Callable[..., None], Callable[..., None]],
    options: dict[str, Any],
    limit: TimeLimit,
) -> Any:
    residual, jacobian = _callbacks(system, compiled, limit)
    return sksundae.ida.IDA(residual, jacfn=jacobian, **options)


def compiled_residual(
    system: ConstrainedSystem, form: str, positions: int = ALL
) -> tuple[Callable[..., None], Callable[..., None]]:
    """Residual (t, y, y', res, n_q, n_c, p) and dF/dy + cj dF/dy' (t, y, y', cj, JJ, n_q, n_c, p) of a form.

    `positions`: how many rows are of C; those below are of A v + b = 0, and Mu of these is zero.
    """
    return _compiled(form, positions, *system.functions[:5], compiled_gamma(system), own_tangent(system))


def compiled_rates(system: ConstrainedSystem) -> Callable[..., None]:
    """(t, y, JJ, n_q, n_c, p) -> None: dF/dy' of the form "stabilised", which is M, C_q^T and ones, into zeros."""
    f = system.functions
    return _rates(f.mass, f.jacobian)


@lru_cache(maxsize=64)
def _rates(mass: Dispatcher, jacobian: Dispatcher) -> Callable[..., None]:
    @njit(types.void(types.float64, _READ, _MATRIX, *_SIZES, _VECTOR), error_model="numpy")
    def rates(t, y, JJ, n, m, p):  # type: ignore[no-untyped-def]
        q, M, Cq = y[:n].copy(), np.zeros((n, n)), np.zeros((m, n))
        mass(t, q, p, M)
        jacobian(t, q, p, Cq)
        for i in range(n):
            JJ[i, i] = 1.0
            for j in range(n):
                JJ[n + i, n + j] = M[i, j]
            for k in range(m):
                JJ[n + i, 2 * n + k] = JJ[i, 2 * n + m + k] = Cq[k, i]

    return rates  # type: ignore[no-any-return]


def _callbacks(
    system: ConstrainedSystem, compiled: tuple[Callable[..., None], Callable[..., None]], limit: TimeLimit
) -> tuple[Any, Any]:
    """Residual and Jacobian as scikit-sundae calls them.

    Past the time limit the residual is NaN: IDA then fails and returns what it has, which is lost with an exception.
    """
    residual, jacobian = compiled
    sizes_and_p = (system.n_q, system.n_c, system.functions.p)

    monotonic, deadline = time.monotonic, limit.deadline  # a call of `limit` would be 3 % of an evaluation

    def resfn(t, y, yp, res):  # type: ignore[no-untyped-def]
        if monotonic() > deadline and limit.passed():
            res[:] = np.nan
        else:
            residual(t, y, yp, res, *sizes_and_p)

    def jacfn(t, y, yp, res, cj, JJ):  # type: ignore[no-untyped-def]
        if not limit.exceeded:
            jacobian(t, y, yp, cj, JJ, *sizes_and_p)

    return resfn, jacfn


def _n_multipliers(system: ConstrainedSystem, form: str) -> int:
    return system.n_c if form == "index1" else 2 * system.n_c


def start_of(system: ConstrainedSystem, form: str, t0: float, q: Array, v: Array) -> tuple[Array, Array]:
    """Unknowns and their derivatives at the start; accelerations and multipliers from one linear system."""
    n, m = system.n_q, system.n_c
    jacobian, gamma = system.jacobian(t0, q), np.zeros(m)
    compiled_gamma(system)(t0, q, v, system.functions.p, gamma)
    kkt = np.block([[system.mass(t0, q), jacobian.T], [jacobian, np.zeros((m, m))]])
    solution = np.linalg.solve(kkt, np.concatenate([system.force(t0, q, v), gamma]))
    a, lam = solution[:n], solution[n:]
    zeros = np.zeros(m)
    if form == "index1":
        return np.concatenate([q, v, lam]), np.concatenate([v, a, zeros])
    return np.concatenate([q, v, zeros, zeros]), np.concatenate([v, a, lam, zeros])


def _result(
    system: ConstrainedSystem,
    form: str,
    outcome: Any,
    shown: Any,
    every_step: bool,
    said: str,
    cpu: float,
    limit: TimeLimit,
) -> Result:
    """The Result of the states `shown`, of a run that ended as `outcome` says."""
    n, m = system.n_q, system.n_c
    y, yp = shown.y.T, shown.yp.T
    lam = (y if form == "index1" else yp)[2 * n : 2 * n + m]
    keep = np.append(True, np.diff(shown.t) > 0.0)  # a failed run comes with its last state twice
    failed = outcome.status < 0
    end = float(np.max(outcome.t))
    message = f"IDA reached the end, t = {end:g}."
    if failed and limit.exceeded:
        message = limit.message("IDA", end, "take looser tolerances")
    elif failed:
        told = " ".join([outcome.message, *said.split()])
        message = (
            f"IDA failed after t = {end:.10g} with status {outcome.status}: {told} "
            "Look for a discontinuity, a singular position or a value that is not finite near this time, or try the "
            "other form or other tolerances."
        )
    return Result(
        t=shown.t[keep],
        q=y[:n, keep],
        v=y[n : 2 * n, keep],
        a=yp[n : 2 * n, keep],
        lam=lam[:, keep],
        h=np.diff(shown.t[keep]) if every_step else np.empty(0),
        status=Status.SOLVER_FAILED if failed else Status.REACHED_END,
        message=message,
        stats=Statistics(
            n_accepted=int(keep.sum()) - 1 if every_step else None,
            n_evaluations=int(outcome.nfev),
            n_factorizations=int(outcome.njev),
            cpu_time=cpu,
        ),
    )


@lru_cache(maxsize=64)
def _compiled(
    form: str,
    positions: int,
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    gamma: Callable[..., None],
    tangent: Dispatcher | None,
) -> tuple[Callable[..., None], Callable[..., None]]:
    """Residual (t, y, y', res, n, m, p) and Jacobian (t, y, y', cj, JJ, n, m, p) of a form.

    Closures, not the first-class functions that twoloop's kernels take: IDA calls from Python, where each
    first-class argument costs tens of microseconds a call.
    """

    def with_force(force: Dispatcher) -> Callable[..., None]:
        if form == "index1":
            return _index1_residual(mass, force, jacobian, gamma)
        return _stabilised_residual(positions, mass, force, constraint, jacobian, constraint_rate)

    residual = with_force(force)
    differenced = residual if tangent is None else with_force(no_force)
    return residual, _iteration_matrix(positions, differenced, mass, jacobian, tangent, form == "index1")


def _index1_residual(
    mass: Dispatcher, force: Dispatcher, jacobian: Dispatcher, gamma: Callable[..., None]
) -> Callable[..., None]:
    """Residual of the form "index1" at y = [q, v, lam]."""

    @njit(_RESIDUAL, error_model="numpy")
    def residual(t, y, yp, res, n, m, p):  # type: ignore[no-untyped-def]
        q, v, a = y[:n].copy(), y[n : 2 * n].copy(), yp[n : 2 * n]
        M, Cq, Q, Qd = np.zeros((n, n)), np.zeros((m, n)), np.zeros(n), np.zeros(m)
        mass(t, q, p, M)
        jacobian(t, q, p, Cq)
        force(t, q, v, p, Q)
        gamma(t, q, v, p, Qd)
        for i in range(n):
            res[i] = yp[i] - v[i]
            res[n + i] = -Q[i]
            for j in range(n):
                res[n + i] += M[i, j] * a[j]
        for k in range(m):
            res[2 * n + k] = -Qd[k]
            for i in range(n):
                res[n + i] += Cq[k, i] * y[2 * n + k]
                res[2 * n + k] += Cq[k, i] * a[i]

    return residual  # type: ignore[no-any-return]


def _stabilised_residual(
    positions: int,
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
) -> Callable[..., None]:
    """Residual of the form "stabilised" at y = [q, v, Lam, Mu]."""

    @njit(_RESIDUAL, error_model="numpy")
    def residual(t, y, yp, res, n, m, p):  # type: ignore[no-untyped-def]
        q, v, a = y[:n].copy(), y[n : 2 * n].copy(), yp[n : 2 * n]
        M, Cq, Q, C, Ct = np.zeros((n, n)), np.zeros((m, n)), np.zeros(n), np.zeros(m), np.zeros(m)
        mass(t, q, p, M)
        jacobian(t, q, p, Cq)
        force(t, q, v, p, Q)
        constraint(t, q, p, C)
        constraint_rate(t, q, p, Ct)
        for i in range(n):
            res[i] = yp[i] - v[i]
            res[n + i] = -Q[i]
            for j in range(n):
                res[n + i] += M[i, j] * a[j]
        for k in range(m):
            res[2 * n + k] = C[k] if k < positions else y[2 * n + m + k]
            res[2 * n + m + k] = Ct[k]
            for i in range(n):
                res[2 * n + m + k] += Cq[k, i] * v[i]
                res[i] += Cq[k, i] * yp[2 * n + m + k]
                res[n + i] += Cq[k, i] * yp[2 * n + k]

    return residual  # type: ignore[no-any-return]


def _iteration_matrix(
    positions: int,
    differenced: Callable[..., None],
    mass: Dispatcher,
    jacobian: Dispatcher,
    tangent: Dispatcher | None,
    index1: bool,
) -> Callable[..., None]:
    """dF/dy + cj dF/dy': columns of q and v by differences, -dQ/dq by the tangent, all others and dF/dy' exact.

    What is differenced is the residual, without the force where there is a tangent.
    """
    exact = tangent is not None
    add_tangent = stand_in("force_by_q") if tangent is None else tangent

    @njit(_JACOBIAN, error_model="numpy")
    def iteration_matrix(t, y, yp, cj, JJ, n, m, p):  # type: ignore[no-untyped-def]
        q, moved, here, there = y[:n].copy(), y.copy(), np.zeros(y.size), np.zeros(y.size)
        M, Cq = np.zeros((n, n)), np.zeros((m, n))
        mass(t, q, p, M)
        jacobian(t, q, p, Cq)
        JJ[:, :] = 0.0  # it arrives as the last call left it
        differenced(t, y, yp, here, n, m, p)
        for j in range(2 * n):
            step = DIFFERENCE * max(1.0, abs(y[j]))
            moved[j] = y[j] + step
            differenced(t, moved, yp, there, n, m, p)
            moved[j] = y[j]
            for i in range(y.size):
                JJ[i, j] = (there[i] - here[i]) / step
        if exact:
            K = np.zeros((n, n))
            add_tangent(t, q, y[n : 2 * n].copy(), p, K)
            for i in range(n):
                for j in range(n):
                    JJ[n + i, j] -= K[i, j]
        for i in range(n):
            JJ[i, i] += cj
            for j in range(n):
                JJ[n + i, n + j] += cj * M[i, j]
            for k in range(m):
                if index1:
                    JJ[n + i, 2 * n + k] = Cq[k, i]
                    JJ[2 * n + k, n + i] += cj * Cq[k, i]
                else:
                    JJ[n + i, 2 * n + k] = cj * Cq[k, i]
                    JJ[i, 2 * n + m + k] = cj * Cq[k, i]
        for k in range(positions, m if not index1 else 0):
            JJ[2 * n + k, 2 * n + m + k] = 1.0

    return iteration_matrix  # type: ignore[no-any-return]

"""SUNDIALS CVODE on y' = f(t, y), y = [q, v]: through scikit-sundae, as its users call it, and from compiled code.

Through Python the equations are those of `scipy.index1` without stabilisation. From C, by ctypes, the accelerations are
straight-line machine code. The constraints drift unless CVODE projects onto C = 0 and C_q v + C_t = 0. See
`references.sundials.library` for the library.
"""

import ctypes
import io
from collections.abc import Callable
from contextlib import ExitStack, redirect_stdout, suppress
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import carray, cfunc, njit, types
from numba.core.dispatcher import Dispatcher

from references.driver import ADVICE, OutOfTimeError, Task, TimeLimit, adapter, imported, user_call
from references.equations.accelerations import SINGULAR, cholesky, cholesky_solve
from references.equations.straight_line import exact_jacobian, straight_line
from references.lines import Line
from references.scipy.index1 import RightHandSide
from references.sundials.ida import states_at
from references.sundials.library import RAISED, REALS, SMALLEST_STEP, Memory, library, run
from twoloop.checks.arguments import check_choice
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

MAX_STEPS_PER_OUTPUT = 10**7  # between two output times; the default of 500 is too small


@adapter(derivatives=False, independent_rows=True)
def solve_cvode(task: Task, rtol: float = 1e-8, atol: float = 1e-8) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with Adams' methods in CVODE.

    The right-hand side is compiled, with its analytic Jacobian where `equations.straight_line` has it. scikit-sundae
    has Newton's iteration only. The integration to the end without output is timed. Parameters, errors and result as in
    `references.driver`; statistics: n_evaluations, all calls of the right-hand side.
    """
    CVODE = imported("sksundae.cvode", "scikit-sundae", "references").CVODE
    t0, t1, times, y0 = task.t0, task.t1, task.instants, task.y0
    equations = RightHandSide(task.system, t0, task.q0, 0.0)
    y0.setflags(write=False)  # read-only as in CVODE, so that the same signature is compiled
    equations.warm(t0, y0, False)
    options: dict[str, Any] = {"method": "Adams", "rtol": rtol, "atol": atol, "max_num_steps": MAX_STEPS_PER_OUTPUT}
    options |= {"min_step": SMALLEST_STEP * (t1 - t0), "max_step": t1 - t0}
    jacobian = equations.jacobian(t0, y0)

    def integrator(limit: TimeLimit) -> Any:
        derivative = equations.function(limit)

        def right_hand_side(t: float, y: Array, rate: Array) -> None:
            rate[:] = derivative(t, y)

        def jacfn(t: float, y: Array, rate: Array, JJ: Array) -> None:
            JJ[:] = jacobian(t, y)  # type: ignore[misc]

        return CVODE(right_hand_side, jacfn=None if jacobian is None else jacfn, **options)

    limit = TimeLimit(task.time_limit)
    timed, outcome = integrator(limit), None
    with redirect_stdout(io.StringIO()), user_call, suppress(OutOfTimeError):  # CVODE prints its failures
        timed.init_step(t0, y0)
        outcome = timed.step(t1, tstop=t1)
    name, counts = "CVODE, Adams,", {"n_evaluations": int(equations.counters[0])}
    if outcome is None:
        failure = limit.message("CVODE", t0, "take looser tolerances")
        return task.result(name, times[:0], np.empty((y0.size, 0)), failure, **counts)
    failure = "" if outcome.success else f"CVODE failed after t = {outcome.t:.10g}: {outcome.message}. {ADVICE}"
    states = states_at(integrator(TimeLimit(None)), (t0, t1), times[times <= outcome.t], y0)
    return task.result(name, states.t, states.y.T, failure, **counts)


POINTER = types.voidptr
MOST_ITERATIONS = 10  # Newton's method usually needs one or two
AGAIN = 1  # return value of a failed projection, which makes CVODE reduce the step


@lru_cache(maxsize=64)
def projection_for_cvode(
    constraint: Dispatcher, jacobian: Dispatcher, constraint_rate: Dispatcher, n: int, m: int, n_p: int
) -> tuple[Any, int]:
    """Return CVODE's projection function, and the number of floats in its user data.

    Positions are projected onto C = 0 by minimum-norm Newton corrections until one is below CVODE's bound in its norm,
    then velocities onto C_q v + C_t = 0; the error estimate is projected onto the tangent space, as in SUNDIALS'
    pendulum example. The user data are [p, rtol, atol, work]; the sizes are constants of the machine code.
    """
    after_p, after_tol, after_Cq, after_S, after_r, n_memory = np.cumsum([n_p, 2, m * n, m * m, m, n]).tolist()
    array_of, size = library().N_VGetArrayPointer, 2 * n
    # the same function of an integer, which can be compared with 0, the address of no vector
    array_at = ctypes.CFUNCTYPE(REALS, ctypes.c_ssize_t)(ctypes.cast(array_of, ctypes.c_void_p).value or 0)

    @njit(error_model="numpy")
    def factors(t, q, p, Cq, S):  # type: ignore[no-untyped-def]
        """Factorise C_q C_q^T at q in the lower half of S; zero in the columns of redundant rows."""
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        for i in range(m):
            for k in range(i + 1):
                S[i, k] = 0.0
                for j in range(n):
                    S[i, k] += Cq[i, j] * Cq[k, j]
        cholesky(S, SINGULAR)

    @njit(error_model="numpy")
    def shortest(Cq, S, r, x):  # type: ignore[no-untyped-def]
        """Compute the minimum-norm x (n,) with C_q x = r; destroys r."""
        cholesky_solve(S, r)
        x[:] = 0.0
        for i in range(m):
            for j in range(n):
                x[j] += Cq[i, j] * r[i]

    @njit(error_model="numpy")
    def remove(Cq, S, r, x, from_v):  # type: ignore[no-untyped-def]
        """Project a velocity onto the tangent space; r contains C_t, or zeros."""
        for i in range(m):
            for j in range(n):
                r[i] += Cq[i, j] * from_v[j]
        shortest(Cq, S, r, x)
        for j in range(n):
            from_v[j] -= x[j]

    @cfunc(types.int32(types.float64, POINTER, POINTER, types.float64, types.intp, POINTER), error_model="numpy")
    def projection(t, y, corr, bound, err, memory):  # type: ignore[no-untyped-def]
        given, state = carray(array_of(y), (size,)), carray(array_of(corr), (size,))
        data = carray(memory, (n_memory,), np.float64)
        p, rtol, atol = data[:after_p], data[after_p], data[after_p + 1]
        Cq, S = data[after_tol:after_Cq].reshape((m, n)), data[after_Cq:after_S].reshape((m, m))
        r, x = data[after_S:after_r], data[after_r:]
        for k in range(size):  # elementwise: slice assignment doubles the compile time
            state[k] = given[k]
        q, v = state[:n], state[n:]
        try:
            for iteration in range(MOST_ITERATIONS):
                factors(t, q, p, Cq, S)
                r[:] = 0.0
                constraint(t, q, p, r)
                shortest(Cq, S, r, x)
                total = 0.0
                for j in range(n):
                    q[j] -= x[j]
                    total += (x[j] / (rtol * abs(given[j]) + atol)) ** 2
                if total <= bound * bound * size:
                    break
                if iteration == MOST_ITERATIONS - 1 or not np.isfinite(total):
                    return AGAIN
            factors(t, q, p, Cq, S)
            r[:] = 0.0
            constraint_rate(t, q, p, r)
            remove(Cq, S, r, x, v)
        except Exception:
            return RAISED
        for k in range(size):
            state[k] -= given[k]
        if err != 0:
            estimate = carray(array_at(err), (size,))
            r[:] = 0.0
            remove(Cq, S, r, x, estimate[:n])
            r[:] = 0.0
            remove(Cq, S, r, x, estimate[n:])
        return 0

    return projection, n_memory


METHODS = {"Adams": 1, "BDF": 2}  # CV_ADAMS and CV_BDF
COUNTERS: dict[str, dict[str, tuple[str, ...]]] = {
    "Adams": {"n_evaluations": ("RhsEvals",), "n_factorizations": (), "n_jacobians": ()}
}
COUNTERS["BDF"] = {"n_evaluations": ("RhsEvals", "LinRhsEvals"), "n_factorizations": ("LinSolvSetups",)}
COUNTERS["BDF"] |= {"n_jacobians": ("JacEvals",)}


class Functions(NamedTuple):
    """Compiled functions for CVODE, or None, and their user data."""

    rate: Any
    jacobian: Any = None
    projection: Any = None
    data: Array = np.empty(0)


@adapter(derivatives=False)
def solve_cvode_c(
    task: Task,
    method: str = "Adams",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    projected: bool = False,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with CVODE driven from C.

    Accelerations are straight-line code (`equations.straight_line`). "Adams" (orders up to 12) has fixed-point
    iteration, as SUNDIALS recommends for non-stiff problems; "BDF" (up to 5) has Newton's iteration, dense with the
    analytic Jacobian from there, too. A second use of CVODE's memory is timed. The clock is checked every
    `STEPS_A_CALL` steps.

    With `projected`, for BDF only, CVODE projects each step, and its error estimate, onto C = 0 and C_q v + C_t = 0;
    states interpolated for t_eval are not projected. Otherwise as in `references.driver`. The statistics are CVODE's
    counters of the timed run, including evaluations for the Jacobian; a failure names CVODE's flag. Raises RuntimeError
    if the version of scikit-sundae is not supported.
    """
    check_choice("method", method, tuple(METHODS))
    if projected and method != "BDF":
        raise ValueError(f"projected needs method 'BDF', with which alone CVODE projects; given {method!r}")
    functions, f = Functions(_rate(*task.key), _jacobian(*task.key) if method == "BDF" else None), task.system.functions
    if projected and task.system.n_c > 0:
        projection, size = projection_for_cvode(*f[2:5], task.system.n_q, task.system.n_c, f.p.size)
        data = np.zeros(size)
        data[: f.p.size + 2] = [*f.p, rtol, atol]
        functions = functions._replace(projection=projection, data=data)
    limits = rtol, atol, task.longest(max_step)
    times, rows, failure, counts = integrate(functions, task.y0, task, method, *limits)
    return task.result(f"CVODE, {method},", times, rows.T, failure, **counts)


def right_hand_side(derivative: Callable[..., Any], size: int) -> Any:
    """Return CVODE's right-hand side function for a compiled (t, y, rate) -> None."""
    array_of = library().N_VGetArrayPointer

    @cfunc(types.int32(types.float64, POINTER, POINTER, POINTER), error_model="numpy")
    def right_hand_side(t, y, rate, memory):  # type: ignore[no-untyped-def]
        derivative(t, carray(array_of(y), (size,)), carray(array_of(rate), (size,)))
        return 0

    return right_hand_side


@lru_cache(maxsize=256)
def _rate(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Any:
    return right_hand_side(straight_line(system, t0, q0, v0), 2 * system.n_q)


@lru_cache(maxsize=256)
def _jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Any:
    """Return CVODE's Jacobian function."""
    derivatives = exact_jacobian(system, t0, q0, v0)
    array_of, matrix_of, size = library().N_VGetArrayPointer, library().SUNDenseMatrix_Data, 2 * system.n_q

    @cfunc(types.int32(types.float64, *[POINTER] * 7), error_model="numpy")
    def jacobian(t, y, rate, J, memory, work1, work2, work3):  # type: ignore[no-untyped-def]
        derivatives(t, carray(array_of(y), (size,)), carray(matrix_of(J), (size, size)))  # CVODE initialises J to zero
        return 0

    return jacobian


def integrate(
    functions: Functions, start: Array, task: Task, method: str, *limits: float
) -> tuple[Array, Array, str, dict[str, int]]:
    """Return the times reached, rows y there, error message or "", and CVODE's counters; arguments as of `_memory`."""
    return run(lambda stack: _memory(stack, functions, start, task, method, *limits), task, COUNTERS[method], ADVICE)


def adams_memory(stack: ExitStack, task: Task, key: tuple[Any, ...], tolerance: float) -> Memory:
    """Return the memory of a run by the Adams methods; it lasts as long as the stack. `key`: of the equations."""
    limits = tolerance, tolerance, task.longest(None)
    return _memory(stack, Functions(_rate(*key)), task.y0, task, "Adams", *limits)


def _memory(stack: ExitStack, functions: Functions, start: Array, task: Task, method: str, *limits: float) -> Memory:
    """Return the memory of a run; `limits`: rtol, atol and the longest step."""
    rtol, atol, longest = limits
    solver = Memory(stack, "CVode", start[None], task, METHODS[method])
    solver.call("Init", functions.rate.address, task.t0, *solver.vectors)
    solver.call("SStolerances", float(rtol), float(atol))
    if method == "Adams":
        free = solver.sundials.SUNNonlinSolFree_FixedPoint
        solver.call("SetNonlinearSolver", solver.create("SUNNonlinSol_FixedPoint", free, *solver.vectors, 0))
    else:
        solver.solve_directly(functions.jacobian)
    if functions.projection is not None:
        solver.call("SetUserData", functions.data.ctypes.data)
        solver.call("SetProjFn", functions.projection.address)
    solver.bound_steps(longest)
    return solver


PROJECTED = {"method": "BDF", "projected": True}
LINES = (
    Line("CVODE, Adams", "scikit-sundae", "SUNDIALS", solve_cvode, called_from="Python", keeps=False, checked=True),
    Line("CVODE from C, Adams", "scikit-sundae", "SUNDIALS", solve_cvode_c, keeps=False, checked=True, traces=True),
    Line("CVODE from C, BDF", "scikit-sundae", "SUNDIALS", solve_cvode_c, {"method": "BDF"}, keeps=False, traces=True),
    Line(
        "CVODE from C, BDF, projected", "scikit-sundae", "SUNDIALS", solve_cvode_c, PROJECTED, checked=True, traces=True
    ),
)

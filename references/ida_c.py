"""SUNDIALS IDA without Python in its way: the wheel's own library, driven by ctypes, with residual and Jacobian in C.

scikit-sundae calls back into Python for every residual and Jacobian, which costs several times what IDA itself does on
a small system. Here IDA gets the addresses of functions that numba compiled, as it would in a C program. The form is
"stabilised" of `references.ida`. The library comes with scikit-sundae, whose files carry a hash in their names and
promise nothing to others: this was written for `WRITTEN_FOR`, and says so when it meets another.
"""

import ctypes
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray

from references.accelerations import accelerations
from references.sundials import LONG, POINTER, REAL, library
from twoloop.callbacks import python_force
from twoloop.checks import check_positive, check_span, check_times, check_vector
from twoloop.consistency import check_start
from twoloop.result import Result, Statistics, Status
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

LABEL = "SUNDIALS IDA, stabilised (GGL): the library of scikit-sundae, driven without Python"

OUTPUTS = 1001  # instants of the default t_eval
SMALLEST_STEP = 1e-12  # of the length of t_span; without a smallest step IDA creeps up to a NaN for ever
MOST_STEPS = 10**7  # between two output times
DIFFERENCE = 1e-7  # displacement for the derivatives of the residual, relative to max(1, |value|)

IDA_NORMAL, IDA_TSTOP_RETURN = 1, 1
SUN_COMM_NULL = 0
RAISED = -1  # what a callback returns that IDA shall not call again

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


def solve_ida_c(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
) -> Result:
    """Integrate a constrained mechanical system with IDA, in the form "stabilised", without Python in the integration.

    Unknowns, residual and error test are those of `references.ida.solve_ida` with form "stabilised": q, v and the
    integrals Lam, Mu of the multipliers; q' = v - C_q^T Mu', M v' + C_q^T Lam' = Q, C = 0, C_q v + C_t = 0; all of the
    unknowns in the error test. The Jacobian is exact but for the columns of q and the derivatives of Q by v, which are
    compiled differences.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem, of compiled callbacks. They are compiled into a residual and a Jacobian at the first run (a few
        seconds). A constant mass matrix is evaluated once.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    rtol, atol : float
        IDA's tolerances, for all unknowns.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, interpolated by IDA. None: `OUTPUTS` times, evenly.

    Returns
    -------
    Result
        `a` and `lam` as IDA has them, with the sign of M a + C_q^T lam = Q; `h` is empty. The statistics are IDA's own
        counters: steps and failed steps, Newton iterations (n_outer), residual evaluations without those that the
        differences of the Jacobian take (n_evaluations), and Jacobians, each with its factorisation
        (n_factorizations). cpu_time is that of the loop over the output times that calls IDASolve. A failure of IDA
        gives the output before it, `Status.SOLVER_FAILED` and the name of IDA's flag.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it.
    RuntimeError
        If scikit-sundae is not the one that this was written for.
    """
    if not isinstance(system, ConstrainedSystem):
        raise TypeError(f"system must be a ConstrainedSystem (for a ready mechanism: problem.system); given {system!r}")
    if system.functions.force is python_force:
        raise ValueError(
            f"system must have compiled callbacks, as Python cannot run inside; those of {system.name!r} are Python "
            "functions. Make it with from_python(..., compile=True) or of functions made by @callback, or take "
            "references.ida.solve_ida"
        )
    t0, t1 = check_span(t_span)
    q0 = check_vector("q0", q0, system.n_q)
    v0 = check_vector("v0", v0, system.n_q)
    check_positive("rtol", rtol)
    check_positive("atol", atol)
    times = np.linspace(t0, t1, OUTPUTS) if t_eval is None else check_times(t_eval, t0, t1, None)
    check_start(system, t0, q0, v0)

    sundials, state = library(), _start(system, t0, q0, v0)
    with _integrator(sundials, system, t0, t1, state, float(rtol), float(atol)) as solver:
        began = time.process_time()
        rows, flag, reached = _integrate(sundials.IDASolve, solver, state, t0, t1, times)
        cpu = time.process_time() - began
        statistics = _statistics(sundials, solver[0], cpu)
    failure = f"{_flag_name(sundials, flag)} ({flag})" if flag < 0 else ""
    return _result(system, times[: len(rows)], rows, failure, reached, statistics)


def _start(system: ConstrainedSystem, t0: float, q: Array, v: Array) -> Array:
    """[y y'] at the start."""
    a, lam = (column[:, 0] for column in accelerations(system, [t0], q[:, None], v[:, None]))
    zeros = np.zeros(system.n_c)
    return np.concatenate([q, v, zeros, zeros, v, a, lam, zeros])


@contextmanager
def _integrator(
    sundials: SimpleNamespace, system: ConstrainedSystem, t0: float, t1: float, state: Array, rtol: float, atol: float
) -> Iterator[tuple[Any, Any, Any]]:
    """IDA's memory and its vectors y and y', which are the halves of `state`; all is freed at the end."""
    f, n = system.functions, state.size // 2
    residual, jacobian, size = _compiled(*f[:5], system.n_q, system.n_c, f.p.size, system.constant_mass)
    data = np.zeros(size)
    data[: f.p.size] = f.p
    data[f.p.size : f.p.size + system.n_q**2] = system.mass(t0, state[: system.n_q]).ravel()
    with ExitStack() as stack:
        context = _context(sundials, stack)

        def made(name: str, free: Callable[[Any], Any], *arguments: Any) -> Any:
            pointer = POINTER(getattr(sundials, name)(*arguments, context))
            if not pointer:
                raise MemoryError(f"{name} of SUNDIALS failed")
            stack.callback(free, pointer)
            return pointer

        y, yp = (made("N_VMake_Serial", sundials.N_VDestroy, n, half.ctypes.data) for half in (state[:n], state[n:]))
        matrix = made("SUNDenseMatrix", sundials.SUNMatDestroy, n, n)
        linear = made("SUNLinSol_Dense", sundials.SUNLinSolFree, y, matrix)
        memory = made("IDACreate", lambda pointer: sundials.IDAFree(ctypes.byref(pointer)))
        for name, *arguments in (
            ("IDAInit", residual.address, t0, y, yp),
            ("IDASStolerances", rtol, atol),
            ("IDASetUserData", data.ctypes.data),
            ("IDASetLinearSolver", linear, matrix),
            ("IDASetJacFn", jacobian.address),
            ("IDASetMaxNumSteps", MOST_STEPS),
            ("IDASetMaxStep", t1 - t0),
            ("IDASetMinStep", SMALLEST_STEP * (t1 - t0)),
            ("IDASetStopTime", t1),
        ):
            _check(name, getattr(sundials, name)(memory, *arguments))
        yield memory, y, yp


def _context(sundials: SimpleNamespace, stack: ExitStack) -> Any:
    """What all objects of SUNDIALS belong to; without the error handlers, which print."""
    context = POINTER()
    _check("SUNContext_Create", sundials.SUNContext_Create(SUN_COMM_NULL, ctypes.byref(context)))
    stack.callback(sundials.SUNContext_Free, ctypes.byref(context))
    _check("SUNContext_ClearErrHandlers", sundials.SUNContext_ClearErrHandlers(context))
    return context


def _check(name: str, flag: int) -> None:
    if flag != 0:
        raise RuntimeError(f"{name} of SUNDIALS failed with {flag}")


def _integrate(
    solve: Any, solver: tuple[Any, Any, Any], state: Array, t0: float, t1: float, times: Array
) -> tuple[Array, int, float]:
    """Rows [y y'] at the times before a failure, IDA's last flag, and the time that IDA reached."""
    memory, y, yp = solver
    reached, flag = REAL(t0), 0
    place = ctypes.byref(reached)
    rows, stored = np.empty((times.size, state.size)), 0
    for stop in [*times.tolist(), t1]:
        if stop > t0 and flag != IDA_TSTOP_RETURN:
            flag = solve(memory, stop, place, y, yp, IDA_NORMAL)
            if flag < 0:
                break
        if stored < times.size:
            rows[stored] = state
            stored += 1
    return rows[:stored], flag, reached.value


def _statistics(sundials: SimpleNamespace, memory: Any, cpu: float) -> Statistics:
    def counted(what: str) -> int:
        number = LONG()
        _check(f"IDAGet{what}", getattr(sundials, f"IDAGet{what}")(memory, ctypes.byref(number)))
        return number.value

    return Statistics(
        n_accepted=counted("NumSteps"),
        n_rejected_error=counted("NumErrTestFails"),
        n_rejected_convergence=counted("NumStepSolveFails"),
        n_outer=counted("NumNonlinSolvIters"),
        n_evaluations=counted("NumResEvals"),
        n_factorizations=counted("NumJacEvals"),
        cpu_time=cpu,
    )


def _flag_name(sundials: SimpleNamespace, flag: int) -> str:
    """IDA's name of a flag; the text is ours to free."""
    text = sundials.IDAGetReturnFlagName(flag)
    name = ctypes.string_at(text).decode()
    free = ctypes.CDLL(None).free
    free.argtypes, free.restype = [POINTER], None
    free(text)
    return name


def _result(
    system: ConstrainedSystem, times: Array, rows: Array, failure: str, reached: float, statistics: Statistics
) -> Result:
    n, m = system.n_q, system.n_c
    y, yp = np.split(rows.T, 2)
    message = f"IDA reached the end, t = {reached:g}."
    if failure:
        message = (
            f"IDA failed after t = {reached:.10g} with {failure}. Look for a discontinuity, a singular position, a "
            "value that is not finite or an exception in a callback near this time, or try other tolerances."
        )
    return Result(
        t=times,
        q=y[:n],
        v=y[n : 2 * n],
        a=yp[n : 2 * n],
        lam=yp[2 * n : 2 * n + m],
        h=np.empty(0),
        status=Status.SOLVER_FAILED if failure else Status.REACHED_END,
        message=message,
        stats=statistics,
    )


@lru_cache(maxsize=64)
def _compiled(
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    n: int,
    m: int,
    n_p: int,
    constant_mass: bool,
) -> tuple[Any, Any, int]:
    """IDA's residual and Jacobian functions, and the number of floats that their user data must hold.

    The user data are [p, M, C_q, y displaced, residual there]; a constant M is there from the start. The sizes are
    constants of the machine code.
    """
    size = 2 * (n + m)
    ends = np.cumsum([n_p, n * n, m * n, size, size]).tolist()
    after_p, after_M, after_Cq, after_y, n_memory = ends
    array_of = library().N_VGetArrayPointer
    matrix_of = library().SUNDenseMatrix_Data
    residual = _residual(mass, force, constraint, jacobian, constraint_rate, n, m, constant_mass)
    iteration_matrix = _iteration_matrix(residual, mass, force, jacobian, n, m, constant_mass)

    @njit(**_OPTIONS)
    def vector(pointer):  # type: ignore[no-untyped-def]
        return carray(array_of(pointer), (size,))

    @njit(**_OPTIONS)
    def space(pointer):  # type: ignore[no-untyped-def]
        memory = carray(pointer, (n_memory,), np.float64)
        M, Cq = memory[after_p:after_M].reshape((n, n)), memory[after_M:after_Cq].reshape((m, n))
        return memory[:n_p], M, Cq, memory[after_Cq:after_y], memory[after_y:]

    pointer = types.voidptr

    @cfunc(types.int32(types.float64, pointer, pointer, pointer, pointer), **_OPTIONS)
    def residual_of_ida(t, y, yp, res, memory):  # type: ignore[no-untyped-def]
        p, M, Cq, _, _ = space(memory)
        try:
            residual(t, vector(y), vector(yp), p, M, Cq, vector(res))
        except Exception:
            return RAISED
        return 0

    @cfunc(types.int32(types.float64, types.float64, *[pointer] * 8), **_OPTIONS)
    def jacobian_of_ida(t, cj, y, yp, res, J, memory, work1, work2, work3):  # type: ignore[no-untyped-def]
        p, M, Cq, moved, there = space(memory)
        columns = carray(matrix_of(J), (size, size))
        try:
            iteration_matrix(t, cj, vector(y), vector(yp), vector(res), p, M, Cq, moved, there, columns)
        except Exception:
            return RAISED
        return 0

    return residual_of_ida, jacobian_of_ida, n_memory


def _residual(
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    n: int,
    m: int,
    constant_mass: bool,
) -> Callable[..., None]:
    """(t, y, y', p, M, Cq, res) -> None: the residual at y = [q, v, Lam, Mu]; M and C_q are left as they are at q."""

    @njit(**_OPTIONS)
    def residual(t, y, yp, p, M, Cq, res):  # type: ignore[no-untyped-def]
        q, v = y[:n], y[n : 2 * n]
        if not constant_mass:
            M[:, :] = 0.0
            mass(t, q, p, M)
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        res[:] = 0.0
        force(t, q, v, p, res[n : 2 * n])
        constraint(t, q, p, res[2 * n : 2 * n + m])
        constraint_rate(t, q, p, res[2 * n + m :])
        for i in range(n):
            total = -res[n + i]
            for j in range(n):
                total += M[i, j] * yp[n + j]
            res[n + i] = total
            res[i] = yp[i] - v[i]
        for k in range(m):
            lam, mu, rate = yp[2 * n + k], yp[2 * n + m + k], res[2 * n + m + k]
            for i in range(n):
                res[i] += Cq[k, i] * mu
                res[n + i] += Cq[k, i] * lam
                rate += Cq[k, i] * v[i]
            res[2 * n + m + k] = rate

    return residual  # type: ignore[no-any-return]


def _iteration_matrix(
    residual: Callable[..., None],
    mass: Dispatcher,
    force: Dispatcher,
    jacobian: Dispatcher,
    n: int,
    m: int,
    constant_mass: bool,
) -> Callable[..., None]:
    """(t, cj, y, y', res, p, M, Cq, moved, there, J) -> None: dF/dy + cj dF/dy', J[j] its column j; IDA zeroes J."""

    @njit(**_OPTIONS)
    def iteration_matrix(t, cj, y, yp, res, p, M, Cq, moved, there, J):  # type: ignore[no-untyped-def]
        moved[:] = y
        q, v, here_Q, there_Q = moved[:n], moved[n : 2 * n], there[:n], there[n : 2 * n]
        if not constant_mass:
            M[:, :] = 0.0
            mass(t, q, p, M)
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        here_Q[:] = 0.0
        force(t, q, v, p, here_Q)
        for j in range(n):  # columns of v and of the multipliers
            step = DIFFERENCE * max(1.0, abs(y[n + j]))
            v[j] = y[n + j] + step
            there_Q[:] = 0.0
            force(t, q, v, p, there_Q)
            v[j] = y[n + j]
            J[n + j, j] = -1.0
            for i in range(n):
                J[n + j, n + i] = cj * M[i, j] - (there_Q[i] - here_Q[i]) / step
            for k in range(m):
                J[n + j, 2 * n + m + k] = Cq[k, j]
                J[2 * n + k, n + j] = cj * Cq[k, j]
                J[2 * n + m + k, j] = cj * Cq[k, j]
                J[j, 2 * n + k] = Cq[k, j]
        for j in range(n):  # columns of q
            step = DIFFERENCE * max(1.0, abs(y[j]))
            q[j] = y[j] + step
            residual(t, moved, yp, p, M, Cq, there)
            q[j] = y[j]
            for i in range(2 * n):
                J[j, i] = (there[i] - res[i]) / step
            for i in range(2 * n + m, 2 * n + 2 * m):
                J[j, i] = (there[i] - res[i]) / step
            J[j, j] += cj

    return iteration_matrix  # type: ignore[no-any-return]

"""SUNDIALS IDA without Python in its way: the wheel's own library, driven by ctypes, with residual and Jacobian in C.

scikit-sundae calls back into Python for every residual and Jacobian, which costs several times what IDA itself does on
a small system. Here IDA gets the addresses of functions that numba compiled, as it would in a C program. The form is
"stabilised" of `sundials.ida`. The library comes with scikit-sundae, whose files carry a hash in their names and
promise nothing to others: this was written for `WRITTEN_FOR`, and says so when it meets another.
"""

import ctypes
import itertools
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from references.driver import TimeLimit, check_run, check_system, check_tolerances, longest_step, user_call
from references.equations.accelerations import accelerations
from references.equations.nonholonomic import with_all_rows
from references.equations.redundant_rows import on_independent_rows
from references.sundials.ida_compiled import compiled_for_ida
from references.sundials.ida_options import ALL, HIGHEST_ORDER, check_options, own_tangent, tolerances
from references.sundials.library import REAL, check, context, counted, flag_name, library, made
from twoloop.checks.consistency import check_start
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status

Array = NDArray[np.float64]

LABEL = "SUNDIALS IDA, stabilised (GGL): the library of scikit-sundae, driven without Python"

OUTPUTS = 1001  # instants of the default t_eval
SMALLEST_STEP = (
    1e-12  # of the length of t_span; without a smallest step IDA shrinks its steps towards a NaN without end
)
MOST_STEPS = 10**9  # the clock is looked at before
STEPS_A_CALL = 100  # between two looks at the clock

IDA_NORMAL, IDA_ONE_STEP, IDA_TSTOP_RETURN, IDA_TOO_MUCH_WORK = 1, 2, 1, -1


@on_independent_rows
def solve_ida_c(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    max_order: int = HIGHEST_ORDER,
    error_test: str = "all",
    time_limit: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with IDA, in the form "stabilised", without Python in the integration.

    Unknowns, residual and error test are those of `ida.solve_ida` with form "stabilised": q, v and the
    integrals Lam, Mu of the multipliers; q' = v - C_q^T Mu', M v' + C_q^T Lam' = Q, C = 0, C_q v + C_t = 0. The
    Jacobian is exact but for the columns of q and the derivatives of Q by v, which are compiled differences.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem, of compiled callbacks. They are compiled into a residual and a Jacobian at the first run (a few
        seconds). A constant mass matrix is evaluated once. With `force_by_q` the Jacobian is exact but for the
        derivatives of C_q and of a varying mass by q.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    rtol, atol : float
        IDA's tolerances, for the unknowns in the error test.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, interpolated by IDA, in a second run of the same
        steps that is not timed. None: `OUTPUTS` times, evenly.
    max_order : int
        The highest order of the BDF, 1 to 5. Those above 2 are unstable for undamped vibrations that the step does not
        resolve.
    error_test : {"all", "states", "positions"}
        What the error test, and that of Newton's iteration, sees: all unknowns, q and v, or q alone. IDA's norm is a
        mean over all unknowns, so that without the others the same tolerances allow q an error
        sqrt((2 n_q + 2 n_c)/n_q) times as large, and q and v one sqrt(1 + n_c/n_q) times as large.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at every `STEPS_A_CALL` steps. A run past it is a
        failed one. None: no limit.
    max_step : float, optional
        The longest step that it may take, s. None: the length of t_span.

    Returns
    -------
    Result
        `a` and `lam` as IDA has them, with the sign of M a + C_q^T lam = Q; `h` is empty. The statistics are IDA's own
        counters: steps and failed steps, Newton iterations (n_outer), residual evaluations without those that the
        differences of the Jacobian take (n_evaluations), and Jacobians, each with its factorisation
        (n_factorizations). cpu_time is that of a second use of IDA's memory: IDAReInit, and IDASolve to the end,
        without output. A failure of IDA gives the output before it, `Status.SOLVER_FAILED` and the name of IDA's flag.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong: before any work, naming it.
    RuntimeError
        If scikit-sundae is not the one that this was written for.
    """
    check_system(system)
    if system.called_in_python:
        raise ValueError(
            f"system must have compiled callbacks, as Python cannot run inside; those of {system.name!r} are Python "
            "functions. Make it with from_python(..., compile=True) or of functions made by @callback, or take "
            "references.sundials.ida.solve_ida"
        )
    check_tolerances(rtol, atol)
    max_order = check_options(max_order, error_test)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit, takes_velocity_rows=True)
    times = np.linspace(t0, t1, OUTPUTS) if times is None else times
    check_start(system, t0, q0, v0)
    positions, system = system.n_c if system.n_a else ALL, with_all_rows(system)

    sundials, state = library(), _start(system, t0, q0, v0)
    absolute = tolerances(system, state.size // 2, error_test, float(atol))
    start, longest = state.copy(), longest_step(max_step, t1 - t0)
    span = t0, t1
    with _integrator(sundials, system, positions, span, state, float(rtol), absolute, max_order, longest) as solver:
        limit = TimeLimit(time_limit)
        with user_call as clock:  # of one who keeps the memory
            check("IDAReInit", sundials.IDAReInit(solver[0], t0, *solver[1:]))
            flag, reached = _to_the_end(sundials.IDASolve, solver, t0, t1, limit)
        statistics = _statistics(solver[0], clock.seconds or 0.0)
        state[:] = start
        check("IDAReInit", sundials.IDAReInit(solver[0], t0, *solver[1:]))
        rows = _states_at(sundials.IDASolve, solver, state, t0, t1, times[times <= reached])
    message = f"IDA reached the end, t = {reached:g}."
    if limit.exceeded:
        message = limit.message("IDA", reached, "take looser tolerances")
    elif flag < 0:
        name = flag_name("IDAGetReturnFlagName", flag)
        message = (
            f"IDA failed after t = {reached:.10g} with {name} ({flag}). Look for a "
            "discontinuity, a singular position, a value that is not finite or an exception in a callback near this "
            "time, or try other tolerances."
        )
    status = Status.SOLVER_FAILED if flag < 0 else Status.REACHED_END
    return _result(system, times[: len(rows)], rows, status, message, statistics)


def _start(system: ConstrainedSystem, t0: float, q: Array, v: Array) -> Array:
    """[y y'] at the start."""
    a, lam = (column[:, 0] for column in accelerations(system, [t0], q[:, None], v[:, None]))
    zeros = np.zeros(system.n_c)
    return np.concatenate([q, v, zeros, zeros, v, a, lam, zeros])


@contextmanager
def _integrator(
    sundials: SimpleNamespace,
    system: ConstrainedSystem,
    positions: int,
    span: tuple[float, float],
    state: Array,
    rtol: float,
    atol: Array,
    max_order: int,
    longest: float,
) -> Iterator[tuple[Any, Any, Any]]:
    """IDA's memory and its vectors y and y', which are the halves of `state`; all is freed at the end."""
    (t0, t1), f, n = span, system.functions, state.size // 2
    sizes, tangent = (system.n_q, system.n_c, f.p.size), own_tangent(system)
    residual, jacobian, size = compiled_for_ida(*f[:5], *sizes, system.constant_mass, tangent, positions)
    data = np.zeros(size)
    data[: f.p.size] = f.p
    data[f.p.size : f.p.size + system.n_q**2] = system.mass(t0, state[: system.n_q]).ravel()
    with ExitStack() as stack:
        own = context(stack)
        y, yp, absolute = (
            made(stack, "N_VMake_Serial", sundials.N_VDestroy, n, values.ctypes.data, own)
            for values in (state[:n], state[n:], atol)
        )
        # not banded: ordered by nodes, the beam of 4 elements has bandwidths 23 and 21 of 64, and nothing to gain
        matrix = made(stack, "SUNDenseMatrix", sundials.SUNMatDestroy, n, n, own)
        linear = made(stack, "SUNLinSol_Dense", sundials.SUNLinSolFree, y, matrix, own)
        memory = made(stack, "IDACreate", lambda pointer: sundials.IDAFree(ctypes.byref(pointer)), own)
        for name, *arguments in (
            ("IDAInit", residual.address, t0, y, yp),
            ("IDASVtolerances", rtol, absolute),
            ("IDASetMaxOrd", max_order),
            ("IDASetUserData", data.ctypes.data),
            ("IDASetLinearSolver", linear, matrix),
            ("IDASetJacFn", jacobian.address),
            ("IDASetMaxNumSteps", STEPS_A_CALL),
            ("IDASetMaxStep", longest),
            ("IDASetMinStep", SMALLEST_STEP * (t1 - t0)),
            ("IDASetStopTime", t1),
        ):
            check(name, getattr(sundials, name)(memory, *arguments))
        yield memory, y, yp


def _to_the_end(solve: Any, solver: tuple[Any, Any, Any], t0: float, t1: float, limit: TimeLimit) -> tuple[int, float]:
    """IDA's last flag, and the time that IDA reached.

    Past the time limit the flag is that of IDA when it is stopped at its greatest number of steps.
    """
    memory, y, yp = solver
    reached, flag = REAL(t0), 0
    for calls in itertools.count(1):
        flag = IDA_TOO_MUCH_WORK if limit.passed() else solve(memory, t1, ctypes.byref(reached), y, yp, IDA_NORMAL)
        if flag != IDA_TOO_MUCH_WORK or limit.exceeded or calls * STEPS_A_CALL >= MOST_STEPS:
            break
    return flag, reached.value


def _states_at(solve: Any, solver: tuple[Any, Any, Any], state: Array, t0: float, t1: float, times: Array) -> Array:
    """Rows [y y'] at times that the same steps have reached before."""
    memory, y, yp = solver
    place, flag, rows = ctypes.byref(REAL(t0)), 0, np.empty((times.size, state.size))
    for k, stop in enumerate(times.tolist()):
        if stop > t0:
            if k == 0 or times[k - 1] <= t0:  # the length of the first step depends on where it is to go
                solve(memory, t1, place, y, yp, IDA_ONE_STEP)
            while flag != IDA_TSTOP_RETURN:
                flag = solve(memory, stop, place, y, yp, IDA_NORMAL)
                if flag != IDA_TOO_MUCH_WORK:
                    break
            if flag < 0:
                return rows[:k]
        rows[k] = state
    return rows


def _statistics(memory: Any, cpu: float) -> Statistics:
    return Statistics(
        n_accepted=counted("IDAGetNumSteps", memory),
        n_rejected_error=counted("IDAGetNumErrTestFails", memory),
        n_rejected_convergence=counted("IDAGetNumStepSolveFails", memory),
        n_outer=counted("IDAGetNumNonlinSolvIters", memory),
        n_evaluations=counted("IDAGetNumResEvals", memory),
        n_factorizations=counted("IDAGetNumJacEvals", memory),
        cpu_time=cpu,
    )


def _result(
    system: ConstrainedSystem, times: Array, rows: Array, status: Status, message: str, statistics: Statistics
) -> Result:
    n, m = system.n_q, system.n_c
    y, yp = np.split(rows.T, 2)
    return Result(
        t=times,
        q=y[:n],
        v=y[n : 2 * n],
        a=yp[n : 2 * n],
        lam=yp[2 * n : 2 * n + m],
        h=np.empty(0),
        status=status,
        message=message,
        stats=statistics,
    )

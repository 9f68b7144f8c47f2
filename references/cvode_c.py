"""SUNDIALS CVODE without Python in its way: the library of scikit-sundae, driven by ctypes, its right-hand side in C.

The equations are y' = f(t, y), y = [q, v], with the accelerations as straight-line machine code. The constraints are
not kept, unless CVODE is given a projection. See `references.ida_c` for what the library promises.
"""

import ctypes
import itertools
from contextlib import ExitStack
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba import carray, cfunc, types
from numpy.typing import ArrayLike, NDArray

from references.cvode_projection import projection_for_cvode
from references.driver import TimeLimit, UserCall, check_choice, check_run, check_tolerances, longest_step, user_call
from references.nonholonomic import with_all_rows
from references.ode import ADVICE, ode_result, output_times
from references.straight_line import straight_line, straight_line_jacobian
from references.sundials import REAL, check, context, counted, flag_name, library, made
from twoloop.consistency import check_start
from twoloop.result import Result, Statistics
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

METHODS = {"Adams": 1, "BDF": 2}  # CV_ADAMS and CV_BDF
SMALLEST_STEP = 1e-12  # of the length of t_span
STEPS_A_CALL = 100  # between two looks at the clock
CV_NORMAL, CV_ONE_STEP, CV_TSTOP_RETURN, CV_TOO_MUCH_WORK = 1, 2, 1, -1


class Functions(NamedTuple):
    """What CVODE is given: compiled functions, or None of those that it shall do without, and their data."""

    rate: Any
    jacobian: Any
    projection: Any
    data: Array


def solve_cvode_c(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    method: str = "Adams",
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    projected: bool = False,
    t_eval: ArrayLike | None = None,
    time_limit: float | None = None,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with CVODE driven from C.

    What it was given: accelerations as straight-line code of the one mechanism (`references.straight_line`); Adams with
    fixed-point iteration, as SUNDIALS advises where nothing is stiff, BDF with Newton's, dense and with the analytic
    Jacobian as straight-line code, up to `straight_line.MOST_OPERATIONS` (which compile in a few seconds), else with
    differences; timed is a second use of CVODE's memory, as its guide has it: `CVodeReInit`, then `CVode` without
    output.

    Parameters
    ----------
    system : ConstrainedSystem
        The problem, of compiled callbacks, which give Q_d and do not branch on q or v.
    t_span : (float, float)
        Start and end, s; the end after the start.
    q0, v0 : array_like (n_q,)
        Consistent initial coordinates and velocities.
    method : {"Adams", "BDF"}
        Orders up to 12, or up to 5.
    rtol, atol : float
        CVODE's tolerances.
    projected : bool
        Whether CVODE projects each step, and its estimate of the error, onto C = 0 and C_q v + C_t = 0
        (`references.cvode_projection`), which it can with BDF alone. What it interpolates for t_eval is not projected.
    t_eval : array_like, optional
        Increasing times in t_span at which to store the solution, interpolated by CVODE, in a second run that is not
        timed. None: 1001 times, evenly.
    time_limit : float, optional
        Wall-clock time that the integration may take, s, looked at every `STEPS_A_CALL` steps. A run past it is a
        failed one. None: no limit.
    max_step : float, optional
        The longest step that it may take, s. None: the length of t_span.

    Returns
    -------
    Result
        `a` and `lam` from eq. (6) at the stored states; `h` is empty. The statistics are CVODE's counters, those of the
        evaluations for the Jacobian included, of the run that is timed. A failure gives what was computed before it,
        `Status.SOLVER_FAILED` and the name of CVODE's flag.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, or the equations cannot be had as expressions: before any work, naming it.
    RuntimeError
        If scikit-sundae is not the one that this was written for.
    """
    check_choice("method", method, METHODS)
    if projected and method != "BDF":
        raise ValueError(f"projected needs method 'BDF', with which alone CVODE projects; given {method!r}")
    check_tolerances(rtol, atol)
    t0, t1, q0, v0, times = check_run(system, t_span, q0, v0, t_eval, time_limit, takes_velocity_rows=True)
    times = output_times(times, t0, t1)
    check_start(system, t0, q0, v0, derivatives=False)
    system = with_all_rows(system)
    at, start = (system, t0, q0.tobytes(), v0.tobytes()), np.concatenate([q0, v0])
    jacobian = _jacobian(*at) if method == "BDF" else None
    functions = Functions(_right_hand_side(*at), jacobian, *_projection(system, projected, rtol, atol))
    arguments = (functions, start, t0, t1, METHODS[method], float(rtol), float(atol))

    limit = TimeLimit(time_limit)
    _, flag, reached, statistics = integrate(*arguments, np.empty(0), limit, max_step)
    failure = ""
    if limit.exceeded:
        failure = limit.message("CVODE", reached, "take looser tolerances")
    elif flag < 0:
        name = flag_name("CVodeGetReturnFlagName", flag)
        failure = f"CVODE failed after t = {reached:.10g} with {name} ({flag}). {ADVICE}"
    kept = times[times <= reached]
    rows = integrate(*arguments, kept, TimeLimit(None), max_step)[0] if kept.size else np.empty((0, start.size))
    end = f"CVODE, {method}, reached the end, t = {t1:g}."
    return ode_result(system, kept[: len(rows)], rows.T, failure, end, statistics)


@lru_cache(maxsize=256)
def _right_hand_side(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Any:
    """CVODE's right-hand side function."""
    derivative = straight_line(system, t0, np.frombuffer(q0), np.frombuffer(v0))
    array_of, size = library().N_VGetArrayPointer, 2 * system.n_q
    pointer = types.voidptr

    @cfunc(types.int32(types.float64, pointer, pointer, pointer), error_model="numpy")
    def right_hand_side(t, y, rate, memory):  # type: ignore[no-untyped-def]
        derivative(t, carray(array_of(y), (size,)), carray(array_of(rate), (size,)))
        return 0

    return right_hand_side


@lru_cache(maxsize=256)
def _jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Any:
    """CVODE's Jacobian function; None where it is too long to be compiled."""
    derivatives = straight_line_jacobian(system, t0, np.frombuffer(q0), np.frombuffer(v0))
    if derivatives is None:
        return None
    array_of, matrix_of, size = library().N_VGetArrayPointer, library().SUNDenseMatrix_Data, 2 * system.n_q
    pointer = types.voidptr

    @cfunc(types.int32(types.float64, *[pointer] * 7), error_model="numpy")
    def jacobian(t, y, rate, J, memory, work1, work2, work3):  # type: ignore[no-untyped-def]
        derivatives(t, carray(array_of(y), (size,)), carray(matrix_of(J), (size, size)))  # CVODE has set J to zero
        return 0

    return jacobian


def _projection(system: ConstrainedSystem, projected: bool, rtol: float, atol: float) -> tuple[Any, Array]:
    """CVODE's projection function, None without one, and the user data."""
    f = system.functions
    if not projected or system.n_c == 0:
        return None, np.empty(0)
    projection, size = projection_for_cvode(*f[2:5], system.n_q, system.n_c, f.p.size)
    data = np.zeros(size)
    data[: f.p.size + 2] = [*f.p, rtol, atol]
    return projection, data


def integrate(
    functions: Functions,
    start: Array,
    t0: float,
    t1: float,
    kind: int,
    rtol: float,
    atol: float,
    times: Array,
    limit: TimeLimit,
    max_step: float | None = None,
) -> tuple[Array, int, float, Statistics]:
    """Rows y at the times before a failure, CVODE's last flag, the time that it reached, its counters.

    Without times it goes to the end, and that is timed; with times, which the same steps reach, it goes to the last.
    """
    sundials, state, n = library(), start.copy(), start.size
    reached, flag = REAL(t0), 0
    rows: list[Array] = []
    with ExitStack() as stack:
        own = context(stack)
        y = made(stack, "N_VMake_Serial", sundials.N_VDestroy, n, state.ctypes.data, own)
        memory = made(stack, "CVodeCreate", lambda pointer: sundials.CVodeFree(ctypes.byref(pointer)), kind, own)
        check("CVodeInit", sundials.CVodeInit(memory, functions.rate.address, t0, y))
        check("CVodeSStolerances", sundials.CVodeSStolerances(memory, rtol, atol))
        if kind == METHODS["Adams"]:
            iteration = made(stack, "SUNNonlinSol_FixedPoint", sundials.SUNNonlinSolFree_FixedPoint, y, 0, own)
            check("CVodeSetNonlinearSolver", sundials.CVodeSetNonlinearSolver(memory, iteration))
        else:
            matrix = made(stack, "SUNDenseMatrix", sundials.SUNMatDestroy, n, n, own)
            linear = made(stack, "SUNLinSol_Dense", sundials.SUNLinSolFree, y, matrix, own)
            check("CVodeSetLinearSolver", sundials.CVodeSetLinearSolver(memory, linear, matrix))
            if functions.jacobian is not None:
                check("CVodeSetJacFn", sundials.CVodeSetJacFn(memory, functions.jacobian.address))
            if functions.projection is not None:
                check("CVodeSetUserData", sundials.CVodeSetUserData(memory, functions.data.ctypes.data))
                check("CVodeSetProjFn", sundials.CVodeSetProjFn(memory, functions.projection.address))
        for name, value in (
            ("MaxNumSteps", STEPS_A_CALL),
            ("MaxStep", longest_step(max_step, t1 - t0)),
            ("MinStep", SMALLEST_STEP * (t1 - t0)),
            ("StopTime", t1),
        ):
            check(name, getattr(sundials, f"CVodeSet{name}")(memory, value))
        place = ctypes.byref(reached)
        # of one who keeps the memory; the second run, for the output, is ours
        with UserCall() if times.size else user_call as clock:
            check("CVodeReInit", sundials.CVodeReInit(memory, t0, y))
            for k, stop in enumerate(times.tolist() if times.size else [t1]):
                if times.size and stop > t0 and (k == 0 or times[k - 1] <= t0):
                    sundials.CVode(memory, t1, y, place, CV_ONE_STEP)  # its length depends on where it is to go
                if stop > t0 and flag != CV_TSTOP_RETURN:
                    for _ in itertools.count():
                        flag = sundials.CVode(memory, stop, y, place, CV_NORMAL)
                        if flag != CV_TOO_MUCH_WORK or limit.passed():
                            break
                    if flag < 0:
                        break
                if len(rows) < times.size:
                    rows.append(state.copy())
        return np.array(rows).reshape(-1, n), flag, reached.value, _statistics(memory, kind, clock.seconds or 0.0)


def _statistics(memory: Any, kind: int, cpu: float) -> Statistics:
    def number(what: str) -> int:
        return counted(f"CVodeGetNum{what}", memory)

    newton = kind == METHODS["BDF"]
    return Statistics(
        n_accepted=number("Steps"),
        n_rejected_error=number("ErrTestFails"),
        n_rejected_convergence=number("StepSolveFails"),
        n_outer=number("NonlinSolvIters"),
        n_evaluations=number("RhsEvals") + (number("LinRhsEvals") if newton else 0),
        n_factorizations=number("LinSolvSetups") if newton else 0,
        n_jacobians=number("JacEvals") if newton else 0,
        cpu_time=cpu,
    )

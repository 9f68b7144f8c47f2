"""SUNDIALS IDA on any ConstrainedSystem: through scikit-sundae, and from compiled code.

IDA solves F(t, y, y') = 0 by variable-order BDF (orders 1 to 5), with F from `sundials.residual`. The integrator of
twoloop is not used. scikit-sundae calls Python for every residual and Jacobian, which costs several times the work of
IDA itself on a small system. From C, by ctypes, IDA gets the addresses of functions compiled by numba. The library is a
private part of scikit-sundae, with a hash in its file names: only `WRITTEN_FOR` is supported.
"""

import io
import time
from contextlib import ExitStack, redirect_stdout
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types

from references.driver import CAUSES, Task, TimeLimit, adapter, imported, user_call
from references.equations.accelerations import OPTIONS
from references.lines import Line
from references.sundials.library import RAISED, SMALLEST_STEP, Memory, library, run
from references.sundials.residual import FORMS, NOT_TESTED, Implicit, Parts, band_of, iteration_matrix_at, residual_at
from twoloop.checks.arguments import check_choice, check_size
from twoloop.problem.problem import Array
from twoloop.result.result import Result


@adapter(independent_rows=True)
def solve_ida(
    task: Task, form: str = "index1", rtol: float = 1e-8, atol: float = 1e-8, *, max_step: float | None = None
) -> Result:
    """Integrate a constrained mechanical system with IDA, called through scikit-sundae.

    `form`, "index1" or "stabilised", is the index reduction of `sundials.residual`. At a given tolerance, rounding
    alone changes IDA's choice of steps and orders, so that the final error scatters by a factor of 2 to 24 (15 runs).
    t_eval None: every step is stored, for which scikit-sundae copies all previous ones. The Jacobian is computed by
    differences; with `force_by_q`, of the residual without the force.

    Otherwise as in `references.driver`; `a` and `lam` are IDA's. Statistics: residual evaluations (n_evaluations),
    Jacobian evaluations, each with a factorisation (n_factorizations), and, if every step is stored, n_accepted.
    """
    check_choice("form", form, tuple(FORMS))
    equations, n, t0, t1 = Implicit(task, form), task.system.n_q, task.t0, task.t1
    absolute = np.full(equations.start.shape[1], atol)
    if form == "index1":
        absolute[2 * n :] = NOT_TESTED
    options = {"rtol": rtol, "atol": absolute, "max_num_steps": 10**9}  # steps per output time
    options |= {"min_step": SMALLEST_STEP * (t1 - t0), "max_step": task.longest(max_step)}
    limit, printed = TimeLimit(task.time_limit), io.StringIO()
    solver = _solver(equations, t0, options, limit)
    with redirect_stdout(printed), user_call:
        if task.times is None:
            outcome = solver.solve(np.array([t0, t1]), *equations.start)
        else:
            solver.init_step(t0, *equations.start)
            outcome = solver.step(t1, tstop=t1)
    output, end, failure = outcome, float(np.max(outcome.t)), ""
    if task.times is not None:
        solver = _solver(equations, t0, options, TimeLimit(None))
        output = states_at(solver, (t0, t1), task.times[task.times <= outcome.t], *equations.start)
    if outcome.status < 0 and limit.exceeded:
        failure = limit.message("IDA", end, "take looser tolerances")
    elif outcome.status < 0:
        message = " ".join([outcome.message, *printed.getvalue().split()])
        advice = f"{CAUSES} the other form or other tolerances."
        failure = f"IDA failed after t = {end:.10g} with status {outcome.status}: {message} {advice}"
    keep = np.diff(output.t, prepend=-np.inf) > 0.0  # a failed run contains its last state twice
    t, rows = output.t[keep], equations.columns(output.y.T, output.yp.T)[:, keep]
    counts = {"n_evaluations": int(outcome.nfev), "n_factorizations": int(outcome.njev)}
    every_step = {"h": np.diff(t), "n_accepted": t.size - 1} if task.times is None else {}
    return task.result("IDA", t, rows, failure, **counts, **every_step)


def states_at(solver: Any, span: tuple[float, float], times: Array, *start: Array) -> SimpleNamespace:
    """Return the states of a solver of scikit-sundae at times reached before, with the same steps."""
    t0, t1 = span
    outputs = [solver.init_step(t0, *start)]
    if times.size and times[-1] > t0:
        solver.step(t1, "onestep", t1)  # the first step size depends on the end time
        outputs += [solver.step(stop, tstop=t1) for stop in times[times > t0].tolist()]
    if not (times.size and times[0] == t0):
        outputs = outputs[1:]
    shape = -1, start[0].size
    y, yp = (np.array([getattr(each, name, each.y) for each in outputs]).reshape(shape) for name in ("y", "yp"))
    return SimpleNamespace(t=times, y=y, yp=yp)


def _solver(equations: Implicit, t0: float, options: dict[str, Any], limit: TimeLimit) -> Any:
    """Return scikit-sundae's IDA with compiled functions called through Python.

    After the time limit the residual is NaN, so that IDA fails and returns its states; with an exception they are lost.
    """
    residual, matrix, space, state = equations.residual, equations.matrix, equations.space, equations.start.copy()
    monotonic, deadline = time.monotonic, limit.deadline  # inlined: calling `limit` would cost 3 % of an evaluation

    def resfn(t, y, yp, res):  # type: ignore[no-untyped-def]
        if monotonic() > deadline and limit.passed():
            res[:] = np.nan
        else:
            state[0], state[1] = y, yp  # copies of read-only arrays
            residual(t, state[0], state[1], *space[:3], res)

    def jacfn(t, y, yp, res, cj, JJ):  # type: ignore[no-untyped-def]
        if not limit.exceeded:
            state[0], state[1] = y, yp
            JJ[:] = 0.0  # contains the values of the last call
            matrix(t, cj, state[0], state[1], *space, JJ.T)

    size = state.shape[1]
    residual(t0, state[0], state[1], *space[:3], np.empty(size))  # compiles
    matrix(t0, 1.0, state[0], state[1], *space, np.zeros((size, size)).T)
    return imported("sksundae.ida", "scikit-sundae", "references").IDA(resfn, jacfn=jacfn, **options)


HIGHEST_ORDER = 5  # IDA's limit
ERROR_TESTS = ("all", "states", "positions")
IDA_COUNTERS = {"n_evaluations": ("ResEvals",), "n_factorizations": ("JacEvals",)}
ADVICE_FROM_C = (
    "Look for a discontinuity, a singular position, a value that is not finite or an exception in a callback near this "
    "time, or try other tolerances."
)


@adapter(independent_rows=True)
def solve_ida_c(
    task: Task,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    *,
    max_order: int = HIGHEST_ORDER,
    error_test: str = "all",
    banded: bool = False,
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with IDA, in the form "stabilised", without Python in the integration.

    The Jacobian is exact except for the columns of q and the derivatives of Q with respect to v, which are compiled
    differences; with `force_by_q`, except for the derivatives of C_q and of a varying mass with respect to q. A
    constant mass matrix is evaluated once.

    `max_order` and `error_test` are for systems with fast vibrations of small amplitude. With velocities in the error
    test these must be resolved at any tolerance, and BDF of orders 3 to 5 is unstable for undamped vibrations that are
    not resolved. With orders up to 2, and only positions tested, IDA may step over them: on the moderately stiff beam
    that brings the tip's height to 1e-3 m in 3,500 steps, where the defaults take 115,000.

    Parameters
    ----------
    max_order : int
        Highest order of the BDF, 1 to 5.
    error_test : {"all", "states", "positions"}
        Unknowns in the error test and the convergence test: all, q and v, or q alone. IDA's norm is a mean over all
        unknowns, so the same tolerance is looser with fewer tested.
    banded : bool
        Whether IDA's matrix is banded, in the order of `band_of`; the system must declare its bandwidth.
    others : see `references.driver` and, for rtol and atol, `solve_ida`
        The system must have compiled callbacks. The clock is checked every `STEPS_A_CALL` steps.

    Returns
    -------
    Result
        `a` and `lam` are IDA's. The statistics are IDA's counters, residual evaluations without those for differences
        of the Jacobian. A failure names IDA's flag.

    Raises RuntimeError if the version of scikit-sundae is not supported.
    """
    system = task.system
    if system.called_in_python:
        raise ValueError(
            f"system must have compiled callbacks, as Python cannot run inside; those of {system.name!r} are Python "
            "functions. Make it with from_python(..., compile=True) or of functions made by @callback, or take "
            "references.sundials.ida.solve_ida"
        )
    if check_size("max_order", max_order, 1) > HIGHEST_ORDER:
        raise ValueError(f"max_order must be at most {HIGHEST_ORDER}, the highest of IDA; given {max_order}")
    check_choice("error_test", error_test, ERROR_TESTS)
    form = Implicit(task, "stabilised")
    absolute = np.full(form.start.shape[1], atol)
    if error_test != "all":
        absolute[system.n_q * (2 if error_test == "states" else 1) :] = NOT_TESTED
    if banded and system.bandwidth is None:
        raise ValueError(f"banded=True needs a system with a bandwidth; {system.name!r} declares none")
    size = absolute.size
    order, widths = band_of(form) if banded else (np.arange(size), None)
    residual, jacobian = _compiled(form.parts, system.n_q, system.n_c, system.functions.p.size, widths)
    room = () if widths is None else (order.astype(float), np.zeros(3 * size + size * size))
    data = np.concatenate([array.ravel() for array in (*form.space, *room)])

    def make(stack: ExitStack) -> Memory:
        solver = Memory(stack, "IDA", form.start[:, order], task)
        solver.call("Init", residual.address, task.t0, *solver.vectors)
        solver.call("SVtolerances", rtol, solver.vector(absolute[order]))
        solver.call("SetMaxOrd", max_order)
        solver.call("SetUserData", data.ctypes.data)
        solver.solve_directly(jacobian, widths)
        solver.bound_steps(task.longest(max_step))
        return solver

    times, rows, failure, counts = run(make, task, IDA_COUNTERS, ADVICE_FROM_C)
    y, yp = (array[np.argsort(order)] for array in np.split(rows.T, 2))
    return task.result("IDA", times, form.columns(y, yp), failure, **counts)


@lru_cache(maxsize=64)
def _compiled(parts: Parts, n: int, m: int, n_p: int, widths: tuple[int, int] | None) -> tuple[Any, Any]:
    """Return IDA's residual and Jacobian functions; their user data are the arrays of `Implicit.space` in sequence.

    With `widths`, the matrix is banded and the unknowns are in another order, which follows there as numbers, and then
    room for y, y', the residual and the matrix in the order of `Implicit`.
    """
    size = 2 * (n + m)  # constant of the machine code
    ends = np.cumsum([n_p, n * n, m * n, n * n, size, size, size]).tolist()
    after_p, after_M, after_Cq, after_K, after_y, after_here, n_memory = ends
    array_of, pointer = library().N_VGetArrayPointer, types.voidptr
    residual, iteration_matrix = residual_at(parts), iteration_matrix_at(parts)
    banded = widths is not None
    lower, upper = widths or (size - 1, size - 1)
    above = min(size - 1, lower + upper)  # rows of SUNDIALS' band above the diagonal, which pivoting fills
    depth = above + lower + 1 if banded else size
    matrix_of = library().SUNBandMatrix_Data if banded else library().SUNDenseMatrix_Data
    n_room = size * (4 + size) if banded else 0

    @njit(**OPTIONS)
    def vector(pointer):  # type: ignore[no-untyped-def]
        return carray(array_of(pointer), (size,))

    @njit(**OPTIONS)
    def space(pointer):  # type: ignore[no-untyped-def]
        memory = carray(pointer, (n_memory,), np.float64)
        M, Cq = memory[after_p:after_M].reshape((n, n)), memory[after_M:after_Cq].reshape((m, n))
        K = memory[after_Cq:after_K].reshape((n, n))
        return memory[:n_p], M, Cq, K, memory[after_K:after_y], memory[after_y:after_here], memory[after_here:]

    @njit(**OPTIONS)
    def in_order(pointer, y, yp):  # type: ignore[no-untyped-def]
        """y, y' and the places of their entries in IDA's vectors; room for the residual and the matrix."""
        room = carray(pointer, (n_memory + n_room,), np.float64)[n_memory:]
        column_in_order = room[size:].reshape((3 + size, size))
        for k in range(size):
            place = int(room[k])
            column_in_order[0, place] = y[k]
            column_in_order[1, place] = yp[k]
        return room[:size], column_in_order[0], column_in_order[1], column_in_order[2], column_in_order[3:]

    @cfunc(types.int32(types.float64, pointer, pointer, pointer, pointer), **OPTIONS)
    def residual_of_ida(t, y, yp, res, memory):  # type: ignore[no-untyped-def]
        p, M, Cq, _, _, _, _ = space(memory)
        try:
            if banded:
                order, own_y, own_yp, own_res, _ = in_order(memory, vector(y), vector(yp))
                residual(t, own_y, own_yp, p, M, Cq, own_res)
                out = vector(res)
                for k in range(size):
                    out[k] = own_res[int(order[k])]
            else:
                residual(t, vector(y), vector(yp), p, M, Cq, vector(res))
        except Exception:
            return RAISED
        return 0

    @cfunc(types.int32(types.float64, types.float64, *[pointer] * 8), **OPTIONS)
    def jacobian_of_ida(t, cj, y, yp, res, J, memory, work1, work2, work3):  # type: ignore[no-untyped-def]
        p, M, Cq, K, moved, here, there = space(memory)
        columns = carray(matrix_of(J), (size, depth))  # initialised to zero by IDA
        try:
            if banded:
                order, own_y, own_yp, _, dense = in_order(memory, vector(y), vector(yp))
                dense[:, :] = 0.0
                iteration_matrix(t, cj, own_y, own_yp, p, M, Cq, K, moved, here, there, dense)
                for j in range(size):  # an entry outside the band, were there one, would only slow Newton's method
                    column_in_order, column = dense[int(order[j])], columns[j]
                    for i in range(max(0, j - upper), min(size, j + lower + 1)):
                        column[above + i - j] = column_in_order[int(order[i])]
            else:
                iteration_matrix(t, cj, vector(y), vector(yp), p, M, Cq, K, moved, here, there, columns)
        except Exception:
            return RAISED
        return 0

    return residual_of_ida, jacobian_of_ida


def _line(name: str, solve: Any, options: dict[str, Any], **fields: Any) -> Line:
    return Line(name, "scikit-sundae", "SUNDIALS", solve, options, scatters=True, **fields)


PYTHON: dict[str, Any] = {"called_from": "Python"}
C: dict[str, Any] = {"compiled_callbacks": True}
ORDER_2 = {"max_order": 2, "error_test": "positions"}
LINES = (
    _line("IDA, index1", solve_ida, {"form": "index1"}, keeps=False, compared=False, **PYTHON),
    _line("IDA, stabilised", solve_ida, {"form": "stabilised"}, checked=True, **PYTHON),
    _line("IDA from C, stabilised", solve_ida_c, {}, checked=True, **C),
    _line("IDA from C, q and v tested", solve_ida_c, {"error_test": "states"}, **C),
    _line("IDA from C, order 2, positions tested", solve_ida_c, ORDER_2, **C),
    _line("IDA from C, order 2, banded", solve_ida_c, ORDER_2 | {"banded": True}, compared=False, **C),
)

"""SUNDIALS IDA without Python in its way: the wheel's own library, driven by ctypes, with residual and Jacobian in C.

scikit-sundae calls back into Python for every residual and Jacobian, which costs several times what IDA itself does on
a small system. Here IDA gets the addresses of functions that numba compiled, as it would in a C program. The form is
"stabilised" of `sundials.residual`. The library comes with scikit-sundae, whose files carry a hash in their names and
promise nothing to others: this was written for `WRITTEN_FOR`, and says so when it meets another.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types

from references.driver import Task, adapter
from references.equations.linear import OPTIONS
from references.lines import Line
from references.sundials.library import library
from references.sundials.loop import RAISED, Memory, run
from references.sundials.residual import NOT_TESTED, Implicit, Parts, iteration_matrix_at, residual_at
from twoloop.checks.arguments import check_choice, check_size
from twoloop.result.result import Result

HIGHEST_ORDER = 5  # of IDA
ERROR_TESTS = ("all", "states", "positions")
COUNTERS = {"n_evaluations": ("ResEvals",), "n_factorizations": ("JacEvals",)}
ADVICE = (
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
    max_step: float | None = None,
) -> Result:
    """Integrate a constrained mechanical system with IDA, in the form "stabilised", without Python in the integration.

    The Jacobian is exact but for the columns of q and the derivatives of Q by v, which are compiled differences; with
    `force_by_q` but for the derivatives of C_q and of a varying mass by q. A constant mass matrix is evaluated once.

    Highest order and error test are for systems with fast vibrations that hardly matter. Velocities keep these in the
    error test however loose it is, and the BDF of orders 3 to 5 are unstable for undamped ones that the step does not
    resolve. With orders up to 2, and only positions tested, IDA may step over them: on the moderately stiff beam
    (`twoloop.mechanisms`, 2 s) that brings the tip's height to 1e-3 m in 3,500 steps, where the defaults take 115,000
    even at tolerances of 1e-3, and reach 6e-6 m. On the very flexible beam, whose large motion the vibrations do
    change, nothing is gained.

    Parameters
    ----------
    max_order : int
        The highest order of the BDF, 1 to 5.
    error_test : {"all", "states", "positions"}
        What the error test, and that of Newton's iteration, sees: all unknowns, q and v, or q alone. IDA's norm is a
        mean over all unknowns: the fewer it sees, the looser the same tolerance. q may then have an error
        sqrt((2 n_q + 2 n_c)/n_q) times as large, and q and v one sqrt(1 + n_c/n_q) times as large.
    others : see `references.driver` and, for rtol and atol, `sundials.ida.solve_ida`
        The system is of compiled callbacks. The clock is looked at every `STEPS_A_CALL` steps.

    Returns
    -------
    Result
        `a` and `lam` as IDA has them. The statistics are IDA's own counters: steps and failed steps, Newton iterations
        (n_outer), residual evaluations without those that the differences of the Jacobian take (n_evaluations), and
        Jacobians, each with its factorisation (n_factorizations). The text of a failure has the name of IDA's flag.

    Raises RuntimeError if scikit-sundae is not the one that this was written for.
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
    residual, jacobian = _compiled(form.parts, system.n_q, system.n_c, system.functions.p.size)
    data = np.concatenate([each.ravel() for each in form.space])

    def set_up(solver: Memory) -> None:
        solver.call("Init", residual.address, task.t0, *solver.vectors)
        solver.call("SVtolerances", rtol, solver.vector(absolute))
        solver.call("SetMaxOrd", max_order)
        solver.call("SetUserData", data.ctypes.data)
        solver.solve_dense(jacobian)

    times, rows, failure, counts = run("IDA", form.start, task, (), set_up, max_step, COUNTERS, ADVICE)
    return task.result("IDA", times, form.columns(*np.split(rows.T, 2)), failure, **counts)


@lru_cache(maxsize=64)
def _compiled(parts: Parts, n: int, m: int, n_p: int) -> tuple[Any, Any]:
    """IDA's residual and Jacobian functions; their user data are the arrays of `Implicit.space`, one after another."""
    size = 2 * (n + m)  # a constant of the machine code, as the others
    ends = np.cumsum([n_p, n * n, m * n, n * n, size, size, size]).tolist()
    after_p, after_M, after_Cq, after_K, after_y, after_here, n_memory = ends
    array_of, matrix_of, pointer = library().N_VGetArrayPointer, library().SUNDenseMatrix_Data, types.voidptr
    residual, iteration_matrix = residual_at(parts), iteration_matrix_at(parts)

    @njit(**OPTIONS)
    def vector(pointer):  # type: ignore[no-untyped-def]
        return carray(array_of(pointer), (size,))

    @njit(**OPTIONS)
    def space(pointer):  # type: ignore[no-untyped-def]
        memory = carray(pointer, (n_memory,), np.float64)
        M, Cq = memory[after_p:after_M].reshape((n, n)), memory[after_M:after_Cq].reshape((m, n))
        K = memory[after_Cq:after_K].reshape((n, n))
        return memory[:n_p], M, Cq, K, memory[after_K:after_y], memory[after_y:after_here], memory[after_here:]

    @cfunc(types.int32(types.float64, pointer, pointer, pointer, pointer), **OPTIONS)
    def residual_of_ida(t, y, yp, res, memory):  # type: ignore[no-untyped-def]
        p, M, Cq, _, _, _, _ = space(memory)
        try:
            residual(t, vector(y), vector(yp), p, M, Cq, vector(res))
        except Exception:
            return RAISED
        return 0

    @cfunc(types.int32(types.float64, types.float64, *[pointer] * 8), **OPTIONS)
    def jacobian_of_ida(t, cj, y, yp, res, J, memory, work1, work2, work3):  # type: ignore[no-untyped-def]
        p, M, Cq, K, moved, here, there = space(memory)
        columns = carray(matrix_of(J), (size, size))  # which IDA has set to zero
        try:
            iteration_matrix(t, cj, vector(y), vector(yp), p, M, Cq, K, moved, here, there, columns)
        except Exception:
            return RAISED
        return 0

    return residual_of_ida, jacobian_of_ida


OF_ORDER_2 = {"max_order": 2, "error_test": "positions"}
HOW: dict[str, Any] = {"own_accelerations": True, "compiled_callbacks": True, "scatters": True}
LINES = (
    Line("IDA from C, stabilised", "scikit-sundae", "SUNDIALS", solve_ida_c, checked=True, **HOW),
    Line("IDA from C, q and v tested", "scikit-sundae", "SUNDIALS", solve_ida_c, {"error_test": "states"}, **HOW),
    Line("IDA from C, order 2, positions tested", "scikit-sundae", "SUNDIALS", solve_ida_c, OF_ORDER_2, **HOW),
)

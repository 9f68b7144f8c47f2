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
from numpy.typing import ArrayLike, NDArray

from references.driver import check_system, check_task, result_of
from references.equations.linear import OPTIONS
from references.equations.rows import on_independent_rows
from references.sundials.ida import HIGHEST_ORDER, check_options, positions_of, tolerances
from references.sundials.library import library
from references.sundials.loop import RAISED, Memory, run
from references.sundials.residual import (
    Parts,
    columns_of,
    iteration_matrix_at,
    parts_of,
    residual_at,
    space_of,
    start_of,
)
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

Array = NDArray[np.float64]

COUNTERS = {"n_evaluations": ("ResEvals",), "n_factorizations": ("JacEvals",)}
ADVICE = (
    "Look for a discontinuity, a singular position, a value that is not finite or an exception in a callback near this "
    "time, or try other tolerances."
)


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

    The Jacobian is exact but for the columns of q and the derivatives of Q by v, which are compiled differences; with
    `force_by_q` but for the derivatives of C_q and of a varying mass by q. A constant mass matrix is evaluated once.

    Parameters
    ----------
    system, t_span, q0, v0, t_eval, time_limit, max_step : see `references.driver`
        Of compiled callbacks. The clock is looked at every `STEPS_A_CALL` steps.
    rtol, atol, max_order, error_test : see `sundials.ida.solve_ida`

    Returns
    -------
    Result
        `a` and `lam` as IDA has them. The statistics are IDA's own counters: steps and failed steps, Newton iterations
        (n_outer), residual evaluations without those that the differences of the Jacobian take (n_evaluations), and
        Jacobians, each with its factorisation (n_factorizations). The text of a failure has the name of IDA's flag.

    Raises
    ------
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
    max_order = check_options(max_order, error_test)
    task = check_task(system, t_span, q0, v0, t_eval, time_limit, (rtol, atol))
    system, form = task.system, "stabilised"
    state = start_of(system, form, task.t0, task.q0, task.v0)
    absolute = tolerances(system, state.shape[1], error_test, float(atol))
    residual, jacobian = _compiled(
        parts_of(system, form, positions_of(task)), system.n_q, system.n_c, system.functions.p.size
    )
    data = np.concatenate([each.ravel() for each in space_of(system, form, task.t0, task.q0)])

    def set_up(solver: Memory) -> None:
        solver.call("Init", residual.address, task.t0, *solver.vectors)
        solver.call("SVtolerances", float(rtol), solver.vector(absolute))
        solver.call("SetMaxOrd", max_order)
        solver.call("SetUserData", data.ctypes.data)
        solver.solve_dense(jacobian)
        solver.bound_steps(max_step)

    given = "IDA", state, (task.t0, task.t1), (), set_up
    times, rows, failure, statistics = run(*given, task.instants, time_limit, COUNTERS, ADVICE)
    end = f"IDA reached the end, t = {task.t1:g}."
    columns = columns_of(form, system.n_q, system.n_c, *np.split(rows.T, 2))
    return result_of(system.n_q, times, columns, end, failure, statistics)


@lru_cache(maxsize=64)
def _compiled(parts: Parts, n: int, m: int, n_p: int) -> tuple[Any, Any]:
    """IDA's residual and Jacobian functions; their user data are the arrays of `space_of`, one after another."""
    size = 2 * (n + m)  # a constant of the machine code, as the others
    ends = np.cumsum([n_p, n * n, m * n, n * n, size, size, size]).tolist()
    after_p, after_M, after_Cq, after_K, after_y, after_here, n_memory = ends
    array_of, matrix_of = library().N_VGetArrayPointer, library().SUNDenseMatrix_Data
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

    pointer = types.voidptr

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

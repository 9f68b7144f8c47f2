"""SUNDIALS IDA without Python overhead: the wheel's library, by ctypes, with compiled residual and Jacobian.

scikit-sundae calls Python for every residual and Jacobian, which costs several times the work of IDA itself on a small
system. Here IDA gets the addresses of functions compiled by numba, as in a C program. The form is "stabilised" of
`sundials.residual`. The library is a private part of scikit-sundae, with a hash in its file names: only `WRITTEN_FOR`
is supported, and other versions are rejected.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types

from references.driver import Task, adapter
from references.equations.accelerations import OPTIONS
from references.lines import Line
from references.sundials.library import RAISED, Memory, library, run
from references.sundials.residual import NOT_TESTED, Implicit, Parts, band_of, iteration_matrix_at, residual_at
from twoloop.checks.arguments import check_choice, check_size
from twoloop.result.result import Result

HIGHEST_ORDER = 5  # IDA's limit
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
    (`twoloop.mechanisms`, 2 s) that brings the tip's height to 1e-3 m in 3,500 steps, where the defaults take 115,000
    even at tolerances of 1e-3, and reach 6e-6 m. On the very flexible beam, whose vibrations affect the large motion,
    nothing is gained.

    Parameters
    ----------
    max_order : int
        Highest order of the BDF, 1 to 5.
    error_test : {"all", "states", "positions"}
        Unknowns in the error test and the convergence test: all, q and v, or q alone. IDA's norm is a mean over all
        unknowns, so the same tolerance is looser with fewer tested: the error of q may be sqrt((2 n_q + 2 n_c)/n_q)
        times as large, that of q and v sqrt(1 + n_c/n_q) times.
    banded : bool
        Whether IDA's matrix is banded, in the order of `sundials.band`; the system must declare its bandwidth.
    others : see `references.driver` and, for rtol and atol, `sundials.ida.solve_ida`
        The system must have compiled callbacks. The clock is checked every `STEPS_A_CALL` steps.

    Returns
    -------
    Result
        `a` and `lam` are IDA's. The statistics are IDA's counters: steps and failed steps, Newton iterations (n_outer),
        residual evaluations without those for differences of the Jacobian (n_evaluations), and Jacobians, each with a
        factorisation (n_factorizations). The message of a failure contains the name of IDA's flag.

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
    band, size = band_of(form) if banded else None, absolute.size
    order = np.arange(size) if band is None else band.order
    widths = None if band is None else (band.lower, band.upper)
    residual, jacobian = _compiled(form.parts, system.n_q, system.n_c, system.functions.p.size, widths)
    room = () if band is None else (order.astype(float), np.zeros(3 * size + size * size))
    data = np.concatenate([each.ravel() for each in (*form.space, *room)])

    def set_up(solver: Memory) -> None:
        solver.call("Init", residual.address, task.t0, *solver.vectors)
        solver.call("SVtolerances", rtol, solver.vector(absolute[order]))
        solver.call("SetMaxOrd", max_order)
        solver.call("SetUserData", data.ctypes.data)
        solver.solve_directly(jacobian, widths)

    times, rows, failure, counts = run("IDA", form.start[:, order], task, (), set_up, max_step, COUNTERS, ADVICE)
    y, yp = (each[np.argsort(order)] for each in np.split(rows.T, 2))
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
        own = room[size:].reshape((3 + size, size))
        for k in range(size):
            place = int(room[k])
            own[0, place] = y[k]
            own[1, place] = yp[k]
        return room[:size], own[0], own[1], own[2], own[3:]

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
                    own, column = dense[int(order[j])], columns[j]
                    for i in range(max(0, j - upper), min(size, j + lower + 1)):
                        column[above + i - j] = own[int(order[i])]
            else:
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
    Line(
        *("IDA from C, order 2, banded", "scikit-sundae", "SUNDIALS", solve_ida_c),
        OF_ORDER_2 | {"banded": True},
        compared=False,
        **HOW,
    ),
)

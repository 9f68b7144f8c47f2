"""SUNDIALS CVODE without Python overhead: the library of scikit-sundae, by ctypes, with a compiled right-hand side.

The equations are y' = f(t, y), y = [q, v], with the accelerations as straight-line machine code. The constraints drift
unless CVODE projects. See `references.sundials.ida_c` for the library.
"""

from collections.abc import Callable
from contextlib import ExitStack
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numba import carray, cfunc, types

from references.driver import ADVICE, Task, adapter
from references.equations.straight_line import exact_jacobian, straight_line
from references.lines import Line
from references.sundials.cvode_projection import projection_for_cvode
from references.sundials.library import library, made
from references.sundials.loop import Memory, run
from twoloop.checks.arguments import check_choice
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

METHODS = {"Adams": 1, "BDF": 2}  # CV_ADAMS and CV_BDF
COUNTERS: dict[str, dict[str, tuple[str, ...]]] = {
    "Adams": {"n_evaluations": ("RhsEvals",), "n_factorizations": (), "n_jacobians": ()},
}
COUNTERS["BDF"] = {"n_evaluations": ("RhsEvals", "LinRhsEvals"), "n_factorizations": ("LinSolvSetups",)}
COUNTERS["BDF"] |= {"n_jacobians": ("JacEvals",)}
POINTER = types.voidptr


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

    Settings: accelerations as straight-line code of the mechanism (`equations.straight_line`); Adams with fixed-point
    iteration, as SUNDIALS recommends for non-stiff problems; BDF with Newton's iteration, dense with the analytic
    Jacobian from there, too. A second use of CVODE's memory is timed. The clock is checked every `STEPS_A_CALL` steps.

    Parameters
    ----------
    method : {"Adams", "BDF"}
        Orders up to 12 or 5, respectively.
    projected : bool
        True: CVODE projects each step, and its error estimate, onto C = 0 and C_q v + C_t = 0
        (`sundials.cvode_projection`); BDF only. States interpolated for t_eval are not projected.
    others : see `references.driver`

    Returns
    -------
    Result
        The statistics are CVODE's counters of the timed run, including evaluations for the Jacobian. The message of a
        failure contains the name of CVODE's flag.

    Raises RuntimeError if the version of scikit-sundae is not supported.
    """
    check_choice("method", method, tuple(METHODS))
    if projected and method != "BDF":
        raise ValueError(f"projected needs method 'BDF', with which alone CVODE projects; given {method!r}")
    jacobian = _jacobian(*task.key) if method == "BDF" else None
    functions = Functions(_rate(*task.key), jacobian, *_projection(task.system, projected, rtol, atol))
    times, rows, failure, counts = integrate(functions, task.y0, task, method, rtol, atol, max_step)
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


def _projection(system: ConstrainedSystem, projected: bool, rtol: float, atol: float) -> tuple[Any, Array]:
    """Return CVODE's projection function, or None, and the user data."""
    f = system.functions
    if not projected or system.n_c == 0:
        return None, np.empty(0)
    projection, size = projection_for_cvode(*f[2:5], system.n_q, system.n_c, f.p.size)
    data = np.zeros(size)
    data[: f.p.size + 2] = [*f.p, rtol, atol]
    return projection, data


def integrate(
    functions: Functions, start: Array, task: Task, method: str, rtol: float, atol: float, max_step: float | None = None
) -> tuple[Array, Array, str, dict[str, int]]:
    """Return the times reached, rows y there, error message or "", and CVODE's counters."""
    set_up = partial(_set_up, functions, task, method, rtol, atol)
    return run("CVode", start[None], task, (METHODS[method],), set_up, max_step, COUNTERS[method], ADVICE)


def adams_memory(stack: ExitStack, task: Task, key: tuple[Any, ...], tolerance: float) -> Memory:
    """Return the memory of a run by the Adams methods; it lasts as long as the stack. `key`: of the equations."""
    solver = Memory(stack, "CVode", task.y0[None], task, METHODS["Adams"])
    _set_up(Functions(_rate(*key)), task, "Adams", tolerance, tolerance, solver)
    solver.bound_steps(task.longest(None))
    return solver


def _set_up(functions: Functions, task: Task, method: str, rtol: float, atol: float, solver: Memory) -> None:
    solver.call("Init", functions.rate.address, task.t0, *solver.vectors)
    solver.call("SStolerances", float(rtol), float(atol))
    if method == "Adams":
        free = solver.sundials.SUNNonlinSolFree_FixedPoint
        iteration = made(solver.stack, "SUNNonlinSol_FixedPoint", free, *solver.vectors, 0, solver.own)
        solver.call("SetNonlinearSolver", iteration)
    else:
        solver.solve_directly(functions.jacobian)
    if functions.projection is not None:
        solver.call("SetUserData", functions.data.ctypes.data)
        solver.call("SetProjFn", functions.projection.address)


LINES = (
    Line("CVODE from C, Adams", "scikit-sundae", "SUNDIALS", solve_cvode_c, keeps=False, checked=True, traces=True),
    Line("CVODE from C, BDF", "scikit-sundae", "SUNDIALS", solve_cvode_c, {"method": "BDF"}, keeps=False, traces=True),
    Line(
        *("CVODE from C, BDF, projected", "scikit-sundae", "SUNDIALS", solve_cvode_c),
        {"method": "BDF", "projected": True},
        checked=True,
        traces=True,
    ),
)

"""CyRK's methods on the ODE y' = f(t, y), y = [q, v], from compiled code; the constraints drift.

CyRK documents `cysolve_ivp` for Cython, whose callers pass a compiled right-hand side. It calls a C++ function, which
is called here by ctypes from the library inside the wheel. Its arguments are C++ objects: vectors, which are three
pointers, and a result, whose fields are read at the places that they have in `CyRK/cy/cysolution.hpp`.
"""

import ctypes
import math
import re
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numba import carray, cfunc, types

from references.driver import ADVICE, Task, TimeLimit, adapter, imported, user_call
from references.equations.straight_line import exact_jacobian, straight_line
from references.lines import Line
from twoloop.checks.arguments import check_choice
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result

WRITTEN_FOR = "0.20.0"
CREATE_PATTERN, SOLVE_PATTERN = r"_Z\d+baseline_cysolve_ivpP\w+", r"_Z\d+baseline_cysolve_ivp_noreturnP\w+"
NUMBERS = {"DOP853": 5, "BDF": 6, "LSODA": 7, "Radau": 8, "Vern8": 11}  # ODEMethod
FINISHED, TOO_MANY_STEPS = 1, -52  # CyrkErrorCodes
MEMORY = 8192  # MB that stored steps may take, the only limit of their number
POINTER, REAL, SIZE = ctypes.c_void_p, ctypes.c_double, ctypes.c_size_t


class Vector(ctypes.Structure):
    """A std::vector: where its data begin and end, and where its memory ends."""

    _fields_ = (("begin", POINTER), ("end", POINTER), ("end_of_memory", POINTER))

    @classmethod
    def from_array(cls, values: Array) -> "Vector":
        """Return a vector of the data of a contiguous array, which must outlive it."""
        first = values.ctypes.data
        return cls(first, first + values.nbytes, first + values.nbytes)

    @property
    def values(self) -> Array:
        """Return a copy of its numbers."""
        if self.begin is None or self.end == self.begin:
            return np.empty(0)
        length = (self.end - self.begin) // ctypes.sizeof(REAL)
        return np.array(ctypes.cast(self.begin, ctypes.POINTER(REAL * length)).contents)


class Configuration(ctypes.Structure):
    """The fields of ProblemConfig up to what a right-hand side is given."""

    _fields_ = (
        ("methods", POINTER),
        ("rate", POINTER),
        ("t0", REAL),
        ("t1", REAL),
        ("start", Vector),
        ("given", Vector),
    )


class Solution(ctypes.Structure):
    """The fields of CySolverResult up to the numbers that are read."""

    _fields_ = (
        ("methods", POINTER),
        ("capacity", SIZE),
        *(("message", ctypes.c_char_p), ("message_size", SIZE), ("short_message", ctypes.c_char * 16)),
        ("configuration", ctypes.POINTER(Configuration)),
        *(("method", ctypes.c_int), ("status", ctypes.c_int)),
        *((name, SIZE) for name in ("size", "n_interpolated", "n_steps")),
        ("flags", ctypes.c_bool * 8),
        *((name, SIZE) for name in ("n_events", "ending_event", "n_y", "n_dy")),
        *((name, Vector) for name in ("event_times", "event_states", "times", "states")),
    )


@lru_cache(maxsize=1)
def library() -> tuple[Any, Any]:
    """Return the function that makes a solver and runs it, and the one that runs a solver again.

    Raises RuntimeError if CyRK is missing, or has another version than `WRITTEN_FOR`.
    """
    imported("CyRK")
    if (installed := version("CyRK")) != WRITTEN_FOR:
        raise RuntimeError(f"references/cyrk reads C++ objects of CyRK {WRITTEN_FOR}; installed is {installed}")
    path = imported("CyRK.cy.cysolver_api", "CyRK").__file__
    text, dll = Path(path).read_bytes().decode("latin-1"), ctypes.CDLL(path)
    functions = []
    for pattern in (CREATE_PATTERN, SOLVE_PATTERN):
        names = set(re.findall(pattern, text))
        if len(names) != 1:
            raise RuntimeError(f"{path} has {len(names)} functions {pattern}, not 1")
        functions.append(getattr(dll, names.pop()))
        functions[-1].restype = None
    vectors = POINTER
    options = (SIZE, SIZE, vectors, SIZE, SIZE, ctypes.c_bool, *(POINTER,) * 5, REAL, REAL, ctypes.c_bool, POINTER)
    create, solve = functions
    create.argtypes = (POINTER, POINTER, REAL, REAL, vectors, ctypes.c_int, *options)
    solve.argtypes = (POINTER, POINTER, REAL, REAL, vectors, *options)
    return create, solve


IMPLICIT = ("BDF", "LSODA", "Radau")
NO_TIMES = np.empty(0)
TRIAL_STEPS = 2000  # steps by which the time of a step is known, where there is a time limit
REALS, COUNTER = types.CPointer(types.float64), types.CPointer(types.int64)
FUNCTION = types.void(REALS, types.float64, REALS, COUNTER, types.voidptr)


@adapter(derivatives=False)
def solve_cyrk(
    task: Task, method: str = "DOP853", rtol: float = 1e-8, atol: float = 1e-8, *, max_step: float | None = None
) -> Result:
    """Integrate a constrained mechanical system, as the ODE q' = v, v' = a(t, q, v), with a method of CyRK.

    Accelerations are straight-line code (`equations.straight_line`); implicit methods get the analytic Jacobian from
    there, too. A second use of the solver is timed, with its steps stored, as CyRK does unless it is given output
    times. A time limit becomes a limit of the number of steps, by the time of the first `TRIAL_STEPS`.

    Parameters, errors and result as in `references.driver`; `method` is a key of `NUMBERS`. Statistics: CyRK's number
    of steps, and the evaluations counted by the right-hand side. Raises RuntimeError if the version of CyRK is not
    supported.
    """
    check_choice("method", method, tuple(NUMBERS))
    jacobian = _jacobian(*task.key) if method in IMPLICIT else None
    functions, limits = (rate_of(*task.key), jacobian), (rtol, atol, task.longest(max_step))
    times, rows, failure, counts = integrate(functions, task.y0, task, method, *limits)
    return task.result(f"CyRK, {method},", times, rows.T, failure, **counts)


def integrate(
    functions: tuple[Any, Any], start: Array, task: Task, method: str, *limits: float
) -> tuple[Array, Array, str, dict[str, int]]:
    """Return the times reached, rows y there, error message or "", and counters; arguments as of `Solver`."""
    with ExitStack() as stack:
        solver, limit = Solver(stack, functions, start, task, method, *limits), TimeLimit(task.time_limit)
        most = solver.most_steps(limit)
        run = solver.prepared(most)
        with user_call:
            run()
        failure, reached, end, counts = solver.failure(limit), solver.reached, solver.end, solver.counts
        times = task.instants[task.instants <= reached]
        solver.prepared(most, times)()
        rows = solver.solution.states.values.reshape(-1, end.size)
    if times.size and times[-1] == reached:
        rows[-1] = end  # without the error of the interpolation
    return times[: len(rows)], rows, failure, counts


class Solver:
    """CyRK's solver of one task, with the vectors that it reads.

    `functions`: right-hand side and Jacobian, or None, in machine code; `limits`: rtol, atol and the longest step.
    """

    def __init__(
        self, stack: ExitStack, functions: tuple[Any, Any], start: Array, task: Task, method: str, *limits: float
    ):
        self.task, self.start, (*tolerances, self.longest) = task, np.array(start, dtype=float), limits
        self.rate, self.jacobian = (None if function is None else function.address for function in functions)
        self.tolerances = [np.array([tolerance]) for tolerance in tolerances]
        self.arguments = np.zeros(1, dtype=np.int64)
        create, self._solve = library()
        self.pointer = POINTER()
        soon = task.t0 + 1e-9 * (task.t1 - task.t0)  # is made, and initialised, by a run
        create(ctypes.byref(self.pointer), *self._arguments(1, NO_TIMES, soon, NUMBERS[method]))
        stack.callback(self._delete)
        self.solution = ctypes.cast(self.pointer, ctypes.POINTER(Solution)).contents

    def _arguments(self, most_steps: int, times: Array, end: float, *method: int) -> tuple[Any, ...]:
        y0, args, t_eval, events, *tolerances = map(
            Vector.from_array, (self.start, self.arguments, times, NO_TIMES, *self.tolerances)
        )
        return (
            *(self.rate, self.task.t0, end, ctypes.byref(y0), *method),
            *(0, 0, ctypes.byref(args), most_steps, MEMORY, False),
            *(ctypes.byref(t_eval), None, ctypes.byref(events), *map(ctypes.byref, tolerances)),
            *(self.longest, 0.0, True, self.jacobian),
        )

    def prepared(self, most_steps: int, times: Array = NO_TIMES) -> Callable[[], None]:
        """Return a function that runs from the start to the end, or for some steps; 0: as many as it takes.

        The arguments are C++ objects, which a user of CyRK has: they are made before.
        """
        return partial(self._solve, self.pointer, *self._arguments(most_steps, times, self.task.t1))

    def most_steps(self, limit: TimeLimit) -> int:
        """Return the number of steps that the time limit allows, 0: no limit, by a run of at most `TRIED` steps."""
        if limit.seconds is None:
            return 0
        began = time.monotonic()
        self.prepared(TRIAL_STEPS)()
        if limit.passed():
            return 1
        if self.solution.status != TOO_MANY_STEPS:
            return 0
        return TRIAL_STEPS * math.ceil(limit.seconds / (time.monotonic() - began))

    @property
    def reached(self) -> float:
        """Return the time that the last run without output times reached."""
        times = self.solution.times.values
        return float(times[-1]) if times.size else self.task.t0

    @property
    def end(self) -> Array:
        """Return the state there."""
        states = self.solution.states.values
        return states[-self.start.size :] if states.size else self.start.copy()

    @property
    def counts(self) -> dict[str, int]:
        """Return the counters of the last run."""
        counted = ctypes.c_int64.from_address(self.solution.configuration.contents.given.begin).value
        return {"n_accepted": int(self.solution.n_steps), "n_evaluations": counted}

    def failure(self, limit: TimeLimit) -> str:
        """Return the message of a run that did not reach the end, or ""."""
        if self.solution.status == FINISHED:
            return ""
        if self.solution.status == TOO_MANY_STEPS:
            return limit.message("CyRK", self.reached, "take looser tolerances")
        return f"CyRK failed after t = {self.reached:.10g}: {self.solution.message.decode()} {ADVICE}"

    def _delete(self) -> None:
        """Call the destructor that frees the memory, the second of its virtual functions."""
        functions = ctypes.cast(self.solution.methods, ctypes.POINTER(POINTER))
        ctypes.CFUNCTYPE(None, POINTER)(functions[1])(self.pointer)


def right_hand_side(derivative: Callable[..., Any], size: int) -> Any:
    """Return CyRK's right-hand side function, which counts its calls, for a compiled (t, y, rate) -> None."""

    @cfunc(FUNCTION, error_model="numpy")
    def rate(derivatives, t, y, count, unused):  # type: ignore[no-untyped-def]
        carray(count, (1,))[0] += 1
        derivative(t, carray(y, (size,)), carray(derivatives, (size,)))

    return rate


@lru_cache(maxsize=256)
def rate_of(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Any:
    """Return the right-hand side of a system, whose equations are ordered by a start."""
    return right_hand_side(straight_line(system, t0, q0, v0), 2 * system.n_q)


@lru_cache(maxsize=256)
def _jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Any:
    """Return CyRK's Jacobian function, whose matrix is stored by columns."""
    derivatives, size = exact_jacobian(system, t0, q0, v0), 2 * system.n_q

    @cfunc(FUNCTION, error_model="numpy")
    def jacobian(J, t, y, count, unused):  # type: ignore[no-untyped-def]
        columns = carray(J, (size, size))
        columns[:] = 0.0
        derivatives(t, carray(y, (size,)), columns)

    return jacobian


def _line(method: str, **fields: Any) -> Line:
    options = {"method": method}
    return Line(f"CyRK, {method}", "cyrk", "CyRK", solve_cyrk, options, keeps=False, traces=True, **fields)


LINES = (_line("DOP853", checked=True), *map(_line, ("Vern8", "Radau", "BDF", "LSODA")))

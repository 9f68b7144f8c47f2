"""IDA and CVODE by ctypes, from the SUNDIALS library inside scikit-sundae: functions, memory and time-stepping loop."""

import ctypes
import itertools
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, files
from types import SimpleNamespace
from typing import Any

import numpy as np

from references.driver import Task, TimeLimit, user_call
from twoloop.problem.problem import Array

SMALLEST_STEP = 1e-12  # relative to the length of t_span; without a limit the step is reduced forever at a NaN
MOST_STEPS = 10**9  # the time limit takes effect earlier
STEPS_A_CALL = 1000  # between two checks of the clock: each costs as much as a step of a small system
NORMAL, ONE_STEP, TSTOP_RETURN, TOO_MUCH_WORK = 1, 2, 1, -1
RAISED = -1  # return value of a callback for an unrecoverable error
COUNTERS = {"n_accepted": ("Steps",), "n_rejected_error": ("ErrTestFails",)}
COUNTERS |= {"n_rejected_convergence": ("StepSolveFails",), "n_outer": ("NonlinSolvIters",)}
WRITTEN_FOR = "scikit-sundae 1.2.0 for Linux, with SUNDIALS 7.9.0 (any 7.x), sunindextype int and sunrealtype double"

POINTER, INT, LONG, REAL, INDEX = ctypes.c_void_p, ctypes.c_int, ctypes.c_long, ctypes.c_double, ctypes.c_int32
REALS = ctypes.POINTER(REAL)
SUN_COMM_NULL = 0

# prototypes, one letter per type, starting with the return type: "-" void, "p" any pointer, "R" pointer to reals,
# "i" int, "l" long int, "x" sunindextype, "r" sunrealtype
_TYPES = {"-": None, "p": POINTER, "R": REALS, "i": INT, "l": LONG, "x": INDEX, "r": REAL}
_OF_EACH = (  # functions with the prefix IDA or CVode
    "Free:-p SetUserData:ipp SetLinearSolver:ippp SetJacFn:ipp SetMaxNumSteps:ipl SetMinStep:ipr SetMaxStep:ipr "
    "SetStopTime:ipr GetReturnFlagName:pl GetNumSteps:ipp GetNumErrTestFails:ipp GetNumStepSolveFails:ipp "
    "GetNumNonlinSolvIters:ipp GetNumJacEvals:ipp"
)
FUNCTIONS = {  # by library
    "core": "SUNContext_Create:iip SUNContext_ClearErrHandlers:ip SUNContext_Free:ip N_VGetArrayPointer:Rp "
    "N_VDestroy:-p SUNMatDestroy:-p SUNLinSolFree:ip",
    "nvecserial": "N_VMake_Serial:pxpp",
    "sunmatrixdense": "SUNDenseMatrix:pxxp SUNDenseMatrix_Data:Rp",
    "sunlinsoldense": "SUNLinSol_Dense:pppp",
    "sunmatrixband": "SUNBandMatrix:pxxxp SUNBandMatrix_Data:Rp",
    "sunlinsolband": "SUNLinSol_Band:pppp",
    "ida": " ".join(f"IDA{each}" for each in _OF_EACH.split()) + " IDACreate:pp IDAInit:ipprpp IDAReInit:iprpp "
    "IDASVtolerances:iprp IDASetMaxOrd:ipi IDASolve:iprpppi IDAGetNumResEvals:ipp",
    "cvode": " ".join(f"CVode{each}" for each in _OF_EACH.split()) + " CVodeCreate:pip CVodeInit:ipprp "
    "CVodeReInit:iprp CVodeSStolerances:iprr CVodeSetProjFn:ipp SUNNonlinSol_FixedPoint:ppip "
    "SUNNonlinSolFree_FixedPoint:ip CVodeSetNonlinearSolver:ipp CVode:iprppi CVodeGetNumRhsEvals:ipp "
    "CVodeGetNumLinRhsEvals:ipp CVodeGetNumLinSolvSetups:ipp",
}


@lru_cache(maxsize=1)
def library() -> SimpleNamespace:
    """Return the functions of SUNDIALS used here, from the files of scikit-sundae.

    Raises RuntimeError if scikit-sundae is missing or incompatible with `WRITTEN_FOR`.
    """
    try:
        from sksundae._cy_common import config

        sizes, version = (config["SUNDIALS_INT_TYPE"], config["SUNDIALS_FLOAT_TYPE"]), config["SUNDIALS_VERSION"]
        paths = [str(path.locate()) for path in files("scikit-sundae") or ()]
    except (ImportError, KeyError, PackageNotFoundError) as error:
        raise _unsupported_wheel(f"{type(error).__name__}: {error}") from error
    if sizes != ("int", "double"):
        raise _unsupported_wheel(f"sunindextype and sunrealtype are {' and '.join(sizes)}")
    if not version.startswith("7."):
        raise _unsupported_wheel(f"SUNDIALS has the version {version}")
    functions: dict[str, Any] = {}
    for name, declarations in FUNCTIONS.items():
        matches = [path for path in paths if f"scikit_sundae.libs/libsundials_{name}-" in path]
        if len(matches) != 1:
            raise _unsupported_wheel(f"there are {len(matches)} files scikit_sundae.libs/libsundials_{name}-*, not 1")
        try:
            dll = ctypes.CDLL(matches[0])
            for function, types in (declaration.split(":") for declaration in declarations.split()):
                functions[function] = declared = getattr(dll, function)
                declared.restype, *declared.argtypes = (_TYPES[letter] for letter in types)
        except (OSError, AttributeError) as error:
            raise _unsupported_wheel(str(error)) from error
    return SimpleNamespace(**functions)


def check(name: str, flag: int) -> None:
    """Raise RuntimeError unless the function of this name returned 0."""
    if flag != 0:
        raise RuntimeError(f"{name} of SUNDIALS failed with {flag}")


def _unsupported_wheel(reason: str) -> RuntimeError:
    return RuntimeError(
        f"the SUNDIALS of the installed scikit-sundae cannot be driven: {reason}. references/sundials/library.py was "
        f"written for {WRITTEN_FOR}. references.sundials.ida.solve_ida does the same through Python"
    )


class Memory:
    """The memory of IDA (`kind` "IDA") or CVODE ("CVode"), whose vectors are the rows of `state`."""

    def __init__(self, stack: ExitStack, kind: str, start: Array, task: Task, *given: int):
        self.kind, self.state, self.start, self.task = kind, start.copy(), start, task
        self.stack, self.own, self.sundials = stack, POINTER(), library()
        check("SUNContext_Create", self.sundials.SUNContext_Create(SUN_COMM_NULL, ctypes.byref(self.own)))
        stack.callback(self.sundials.SUNContext_Free, ctypes.byref(self.own))
        check("SUNContext_ClearErrHandlers", self.sundials.SUNContext_ClearErrHandlers(self.own))  # they print
        self.wrapped: list[Array] = []  # arrays that vectors wrap, and that must live as long as the vectors
        self.vectors = [self.vector(values) for values in self.state]
        free = getattr(self.sundials, f"{kind}Free")
        self.memory = self.create(f"{kind}Create", lambda pointer: free(ctypes.byref(pointer)), *given)
        self.reached = REAL(task.t0)

    def create(self, name: str, free: Callable[[Any], Any], *arguments: Any) -> Any:
        """Return an object created by the function of this name; it is freed when the stack is closed."""
        pointer = POINTER(getattr(self.sundials, name)(*arguments, self.own))
        if not pointer:
            raise MemoryError(f"{name} of SUNDIALS failed")
        self.stack.callback(free, pointer)
        return pointer

    def vector(self, values: Array) -> Any:
        """Return a SUNDIALS vector that wraps an array."""
        self.wrapped.append(values)
        return self.create("N_VMake_Serial", self.sundials.N_VDestroy, values.size, values.ctypes.data)

    def call(self, name: str, *arguments: Any) -> None:
        """Call a function, which must return 0."""
        check(f"{self.kind}{name}", getattr(self.sundials, f"{self.kind}{name}")(self.memory, *arguments))

    def solve_directly(self, jacobian: Any, band: tuple[int, int] | None = None) -> None:
        """Use Newton's method with a dense matrix, or one of so many lower and upper diagonals.

        `jacobian` None: by differences.
        """
        kind, size, destroy = "Dense" if band is None else "Band", self.state.shape[1], self.sundials.SUNMatDestroy
        widths = (size,) if band is None else band[::-1]
        matrix = self.create(f"SUN{kind}Matrix", destroy, size, *widths)
        linear = self.create(f"SUNLinSol_{kind}", self.sundials.SUNLinSolFree, self.vectors[0], matrix)
        self.call("SetLinearSolver", linear, matrix)
        if jacobian is not None:
            self.call("SetJacFn", jacobian.address)

    def bound_steps(self, longest: float) -> None:
        """Set the limits of the step size, and the stop time."""
        self.call("SetMaxNumSteps", STEPS_A_CALL)
        self.call("SetMaxStep", longest)
        self.call("SetMinStep", SMALLEST_STEP * (self.task.t1 - self.task.t0))
        self.call("SetStopTime", self.task.t1)

    def restart(self) -> None:
        """Reinitialise at the start, like a user who keeps the memory."""
        self.state[:] = self.start
        self.call("ReInit", self.task.t0, *self.vectors)
        self.reached.value = self.task.t0

    def solve(self, stop: float, mode: int) -> int:
        """Return the flag after steps to `stop`, or after one step."""
        place = ctypes.byref(self.reached)
        if self.kind == "IDA":
            return int(self.sundials.IDASolve(self.memory, stop, place, *self.vectors, mode))
        return int(self.sundials.CVode(self.memory, stop, *self.vectors, place, mode))

    def go_to_the_end(self, limit: TimeLimit) -> int:
        """Return the last flag; after the time limit that of a run stopped by the number of steps."""
        flag = TOO_MUCH_WORK
        for calls in itertools.count(1):
            flag = TOO_MUCH_WORK if limit.passed() else self.solve(self.task.t1, NORMAL)
            if flag != TOO_MUCH_WORK or limit.exceeded or calls * STEPS_A_CALL >= MOST_STEPS:
                break
        return flag

    def rows_at(self, times: Array) -> Array:
        """Return the states (n_t, k n) at times reached before with the same steps, or those before a failure."""
        flag, rows = 0, np.empty((times.size, self.state.size))
        for k, stop in enumerate(times.tolist()):
            if stop > self.task.t0:
                if k == 0 or times[k - 1] <= self.task.t0:  # the first step size depends on the end time
                    self.solve(self.task.t1, ONE_STEP)
                while flag != TSTOP_RETURN:
                    flag = self.solve(stop, NORMAL)
                    if flag != TOO_MUCH_WORK:
                        break
                if flag < 0:
                    return rows[:k]
            rows[k] = self.state.ravel()
        return rows

    def counter(self, counter: str) -> int:
        """Return a counter."""
        number = LONG()
        self.call(f"GetNum{counter}", ctypes.byref(number))
        return number.value

    def failure(self, flag: int, limit: TimeLimit, advice: str) -> str:
        """Return the message of a run that ended with this flag."""
        name, t = self.kind.upper(), self.reached.value
        if limit.exceeded:
            return limit.message(name, t, "take looser tolerances")
        if flag >= 0:
            return ""
        text, free = getattr(self.sundials, f"{self.kind}GetReturnFlagName")(flag), ctypes.CDLL(None).free
        flag_name = ctypes.string_at(text).decode()
        free.argtypes, free.restype = [POINTER], None
        free(text)  # as the caller must
        return f"{name} failed after t = {t:.10g} with {flag_name} ({flag}). {advice}"


def run(
    make: Callable[[ExitStack], Memory], task: Task, counters: Mapping[str, tuple[str, ...]], advice: str
) -> tuple[Array, Array, str, dict[str, int]]:
    """Return the times reached, states there as rows, error message or "", and counters.

    A second use of the memory is timed, as in SUNDIALS' guides: ReInit, and steps to the end without output. The output
    run has a memory of its own, because CVODE's ReInit does not reset the time of the last projection.
    """
    with ExitStack() as stack:
        solver, limit = make(stack), TimeLimit(task.time_limit)
        with user_call:
            solver.restart()
            flag = solver.go_to_the_end(limit)
        counts = {name: sum(map(solver.counter, parts)) for name, parts in (COUNTERS | dict(counters)).items()}
        failure, times = solver.failure(flag, limit, advice), task.instants[task.instants <= solver.reached.value]
    with ExitStack() as stack:
        rows = make(stack).rows_at(times)
    return times[: len(rows)], rows, failure, counts

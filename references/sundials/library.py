"""SUNDIALS IDA's and CVODE's functions by ctypes, from the library inside scikit-sundae: private to that wheel."""

import ctypes
from collections.abc import Callable
from contextlib import ExitStack
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, files
from types import SimpleNamespace
from typing import Any

WRITTEN_FOR = "scikit-sundae 1.2.0 for Linux, with SUNDIALS 7.9.0 (any 7.x), sunindextype int and sunrealtype double"

POINTER, INT, LONG, REAL, INDEX = ctypes.c_void_p, ctypes.c_int, ctypes.c_long, ctypes.c_double, ctypes.c_int32
REALS = ctypes.POINTER(REAL)
COUNTER = (INT, POINTER, POINTER)
SUN_COMM_NULL = 0

_OF_EACH = {  # of IDA and of CVODE, after IDA or CVode
    "Free": (None, POINTER),
    "SetUserData": (INT, POINTER, POINTER),
    "SetLinearSolver": (INT, POINTER, POINTER, POINTER),
    "SetJacFn": (INT, POINTER, POINTER),
    "SetMaxNumSteps": (INT, POINTER, LONG),
    **{f"Set{name}": (INT, POINTER, REAL) for name in ("MinStep", "MaxStep", "StopTime")},
    "GetReturnFlagName": (POINTER, LONG),
    **{f"GetNum{name}": COUNTER for name in ("Steps", "ErrTestFails", "StepSolveFails", "NonlinSolvIters", "JacEvals")},
}

# library: function: (what it returns, what it takes ...)
FUNCTIONS: dict[str, dict[str, tuple[Any, ...]]] = {
    "core": {
        "SUNDIALSGetVersionNumber": (INT, *[POINTER] * 3, POINTER, INT),
        "SUNContext_Create": (INT, INT, POINTER),
        "SUNContext_ClearErrHandlers": (INT, POINTER),
        "SUNContext_Free": (INT, POINTER),
        "N_VGetArrayPointer": (REALS, POINTER),
        "N_VDestroy": (None, POINTER),
        "SUNMatDestroy": (None, POINTER),
        "SUNLinSolFree": (INT, POINTER),
    },
    "nvecserial": {"N_VMake_Serial": (POINTER, INDEX, POINTER, POINTER)},
    "sunmatrixdense": {
        "SUNDenseMatrix": (POINTER, INDEX, INDEX, POINTER),
        "SUNDenseMatrix_Data": (REALS, POINTER),
    },
    "sunlinsoldense": {"SUNLinSol_Dense": (POINTER, POINTER, POINTER, POINTER)},
    "ida": {
        **{f"IDA{name}": types for name, types in _OF_EACH.items()},
        "IDACreate": (POINTER, POINTER),
        "IDAInit": (INT, POINTER, POINTER, REAL, POINTER, POINTER),
        "IDAReInit": (INT, POINTER, REAL, POINTER, POINTER),
        "IDASVtolerances": (INT, POINTER, REAL, POINTER),
        "IDASetMaxOrd": (INT, POINTER, INT),
        "IDASolve": (INT, POINTER, REAL, POINTER, POINTER, POINTER, INT),
        "IDAGetNumResEvals": COUNTER,
    },
    "cvode": {
        **{f"CVode{name}": types for name, types in _OF_EACH.items()},
        "CVodeCreate": (POINTER, INT, POINTER),
        "CVodeInit": (INT, POINTER, POINTER, REAL, POINTER),
        "CVodeReInit": (INT, POINTER, REAL, POINTER),
        "CVodeSStolerances": (INT, POINTER, REAL, REAL),
        "CVodeSetProjFn": (INT, POINTER, POINTER),
        "SUNNonlinSol_FixedPoint": (POINTER, POINTER, INT, POINTER),
        "SUNNonlinSolFree_FixedPoint": (INT, POINTER),
        "CVodeSetNonlinearSolver": (INT, POINTER, POINTER),
        "CVode": (INT, POINTER, REAL, POINTER, POINTER, INT),
        **{f"CVodeGetNum{name}": COUNTER for name in ("RhsEvals", "LinRhsEvals", "LinSolvSetups")},
    },
}


@lru_cache(maxsize=1)
def library() -> SimpleNamespace:
    """The functions of SUNDIALS that are used here, from the files of scikit-sundae.

    Raises
    ------
    RuntimeError
        If scikit-sundae is missing or differs in a way that matters from `WRITTEN_FOR`.
    """
    try:
        from sksundae._cy_common import config

        sizes = config["SUNDIALS_INT_TYPE"], config["SUNDIALS_FLOAT_TYPE"]
        paths = [str(path.locate()) for path in files("scikit-sundae") or ()]
    except (ImportError, KeyError, PackageNotFoundError) as error:
        raise _another_wheel(f"{type(error).__name__}: {error}") from error
    if sizes != ("int", "double"):
        raise _another_wheel(f"sunindextype and sunrealtype are {' and '.join(sizes)}")
    functions: dict[str, Any] = {}
    for name, wanted in FUNCTIONS.items():
        found = [path for path in paths if f"scikit_sundae.libs/libsundials_{name}-" in path]
        if len(found) != 1:
            raise _another_wheel(f"there are {len(found)} files scikit_sundae.libs/libsundials_{name}-*, not 1")
        try:
            dll = ctypes.CDLL(found[0])
            for function, (returned, *taken) in wanted.items():
                functions[function] = declared = getattr(dll, function)
                declared.restype, declared.argtypes = returned, taken
        except (OSError, AttributeError) as error:
            raise _another_wheel(str(error)) from error
    sundials = SimpleNamespace(**functions)
    if (version := _version(sundials))[0] != 7:
        raise _another_wheel(f"SUNDIALS has the version {'.'.join(map(str, version))}")
    return sundials


def check(name: str, flag: int) -> None:
    """Raise unless the function of this name returned 0."""
    if flag != 0:
        raise RuntimeError(f"{name} of SUNDIALS failed with {flag}")


def made(stack: ExitStack, name: str, free: Callable[[Any], Any], *arguments: Any) -> Any:
    """What the function of this name makes; freed at the end of the stack."""
    pointer = POINTER(getattr(library(), name)(*arguments))
    if not pointer:
        raise MemoryError(f"{name} of SUNDIALS failed")
    stack.callback(free, pointer)
    return pointer


def context(stack: ExitStack) -> Any:
    """What all objects of SUNDIALS belong to; without the error handlers, which print."""
    sundials, pointer = library(), POINTER()
    check("SUNContext_Create", sundials.SUNContext_Create(SUN_COMM_NULL, ctypes.byref(pointer)))
    stack.callback(sundials.SUNContext_Free, ctypes.byref(pointer))
    check("SUNContext_ClearErrHandlers", sundials.SUNContext_ClearErrHandlers(pointer))
    return pointer


def _another_wheel(found: str) -> RuntimeError:
    return RuntimeError(
        f"the SUNDIALS of the installed scikit-sundae cannot be driven: {found}. references/sundials/library.py was "
        f"written for {WRITTEN_FOR}. references.sundials.ida.solve_ida does the same through Python"
    )


def _version(sundials: SimpleNamespace) -> tuple[int, int, int]:
    numbers, label = (INT * 3)(), ctypes.create_string_buffer(64)
    places = [ctypes.byref(numbers, i * ctypes.sizeof(INT)) for i in range(3)]
    sundials.SUNDIALSGetVersionNumber(*places, label, len(label))
    return numbers[0], numbers[1], numbers[2]

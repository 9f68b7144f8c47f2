"""IDA's and CVODE's functions by ctypes, from the SUNDIALS library inside scikit-sundae, private to the wheel."""

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
    "core": "SUNDIALSGetVersionNumber:ippppi SUNContext_Create:iip SUNContext_ClearErrHandlers:ip SUNContext_Free:ip "
    "N_VGetArrayPointer:Rp N_VDestroy:-p SUNMatDestroy:-p SUNLinSolFree:ip",
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
            for function, types in (each.split(":") for each in wanted.split()):
                functions[function] = declared = getattr(dll, function)
                declared.restype, *declared.argtypes = (_TYPES[letter] for letter in types)
        except (OSError, AttributeError) as error:
            raise _another_wheel(str(error)) from error
    sundials = SimpleNamespace(**functions)
    if (version := _version(sundials))[0] != 7:
        raise _another_wheel(f"SUNDIALS has the version {'.'.join(map(str, version))}")
    return sundials


def check(name: str, flag: int) -> None:
    """Raise RuntimeError unless the function of this name returned 0."""
    if flag != 0:
        raise RuntimeError(f"{name} of SUNDIALS failed with {flag}")


def made(stack: ExitStack, name: str, free: Callable[[Any], Any], *arguments: Any) -> Any:
    """Return an object created by the function of this name; it is freed when the stack is closed."""
    pointer = POINTER(getattr(library(), name)(*arguments))
    if not pointer:
        raise MemoryError(f"{name} of SUNDIALS failed")
    stack.callback(free, pointer)
    return pointer


def context(stack: ExitStack) -> Any:
    """Return a SUNDIALS context without the error handlers, which print."""
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

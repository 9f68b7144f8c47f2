"""CyRK's C++ functions by ctypes, from the library inside its wheel.

CyRK documents `cysolve_ivp` for Cython, whose callers pass a compiled right-hand side; the function below is the one
that it calls. Its arguments are C++ objects: vectors, which are three pointers, and a result, whose fields are read at
the places that they have in `CyRK/cy/cysolution.hpp`.
"""

import ctypes
import re
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from references.driver import imported
from twoloop.problem.problem import Array

WRITTEN_FOR = "0.20.0"
MADE_BY, SOLVED_BY = r"_Z\d+baseline_cysolve_ivpP\w+", r"_Z\d+baseline_cysolve_ivp_noreturnP\w+"
NUMBERS = {"DOP853": 5, "BDF": 6, "LSODA": 7, "Radau": 8, "Vern8": 11}  # ODEMethod
FINISHED, TOO_MANY_STEPS = 1, -52  # CyrkErrorCodes
MEMORY = 8192  # MB that stored steps may take, the only limit of their number
POINTER, REAL, SIZE = ctypes.c_void_p, ctypes.c_double, ctypes.c_size_t


class Vector(ctypes.Structure):
    """A std::vector: where its data begin and end, and where its memory ends."""

    _fields_ = (("begin", POINTER), ("end", POINTER), ("end_of_memory", POINTER))

    @classmethod
    def of(cls, values: Array) -> "Vector":
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
    if (found := version("CyRK")) != WRITTEN_FOR:
        raise RuntimeError(f"references/cyrk reads C++ objects of CyRK {WRITTEN_FOR}; installed is {found}")
    path = imported("CyRK.cy.cysolver_api", "CyRK").__file__
    text, dll = Path(path).read_bytes().decode("latin-1"), ctypes.CDLL(path)
    functions = []
    for pattern in (MADE_BY, SOLVED_BY):
        names = set(re.findall(pattern, text))
        if len(names) != 1:
            raise RuntimeError(f"{path} has {len(names)} functions {pattern}, not 1")
        functions.append(getattr(dll, names.pop()))
        functions[-1].restype = None
    vectors = POINTER
    options = (SIZE, SIZE, vectors, SIZE, SIZE, ctypes.c_bool, *(POINTER,) * 5, REAL, REAL, ctypes.c_bool, POINTER)
    made, solved = functions
    made.argtypes = (POINTER, POINTER, REAL, REAL, vectors, ctypes.c_int, *options)
    solved.argtypes = (POINTER, POINTER, REAL, REAL, vectors, *options)
    return made, solved

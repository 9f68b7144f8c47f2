"""What machine code depends on: digests of functions, with all that they name and enclose, and of files."""

import dis
import enum
import hashlib
import sys
import types
from functools import lru_cache
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numba.core.dispatcher import Dispatcher
from numba.core.types import Type

from twoloop.kernels.compile.private import options_of, registered

# libraries whose functions are told apart by name; the versions of numba and numpy are compared, too
LIBRARIES = {*sys.stdlib_module_names, "numpy", "numba", "scipy"}

MOST_CODES = 2000  # whose names are kept: to read the operations of helpers again takes most of the time of tracing
FORM = 2  # another one for machine code that files of earlier versions may have wrong


def digest_of(text: str, *sources: str | types.ModuleType) -> str:
    """A digest of a text and of the files of modules."""
    digest = hashlib.sha256(text.encode())
    for source in sources:
        digest.update(Path(source if isinstance(source, str) else str(source.__file__)).read_bytes())
    return digest.hexdigest()


_STANDS_FOR: WeakKeyDictionary[Dispatcher, str] = WeakKeyDictionary()


def stands_for(callback: Dispatcher, what: str) -> None:
    """Let a callback, which cannot be watched as it goes to Python, be known by this to functions that enclose it."""
    _STANDS_FOR[callback] = what


def enclosed_by(function: Any) -> list[Any]:
    """The values of the closure of a function."""
    return [cell.cell_contents for cell in function.__closure__ or ()]


class CannotBeWatched(Exception):
    """A value that may change unseen."""


class Digest:
    """A hash that takes values of many types, and follows functions to whatever they name."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256(f"{FORM} {np.__version__}".encode())
        self.names: set[str] = set()  # of attributes that the code being looked at, or its helpers, may take of modules
        self.seen: dict[tuple[int, str], int] = {}  # and in which order
        self.helpers: list[Any] = []  # that were followed, each after those that it names

    def add(self, value: Any) -> None:
        """Add a value."""
        self.hash.update(f"<{type(value).__qualname__}>".encode())
        if value is None or isinstance(value, (bool, int, float, complex, str, bytes, np.generic, Type)):
            self.hash.update(repr(value).encode())
        elif isinstance(value, np.ndarray) and not value.dtype.hasobject:
            self.hash.update(f"{value.dtype.descr}{value.shape}".encode() + value.tobytes())
        elif isinstance(value, (tuple, list)):
            self.hash.update(f"{len(value)}{getattr(value, '_fields', '')}".encode())
            for each in value:
                self.add(each)
        elif isinstance(value, (set, frozenset)):
            self.hash.update(repr(sorted(map(repr, value))).encode())
        elif isinstance(value, dict):
            self.add(list(value.items()))
        elif isinstance(value, enum.Enum):
            self.add((value.name, value.value))
        elif isinstance(value, types.CodeType):
            self.hash.update(value.co_code + value.co_exceptiontable)
            self.add([value.co_consts, value.co_names, value.co_freevars])
        elif isinstance(value, types.ModuleType):
            self._add_module(value)
        elif isinstance(value, Dispatcher) or registered(value):
            self._add_helper(value)
        else:
            self._add_name(value)

    def add_function(self, function: Any, enclosed: bool = True) -> None:
        """Add the code of a function, its defaults, and the values of the globals that it names."""
        outer, self.names = self.names, names_reached(function)
        self.add([function.__code__, function.__defaults__, function.__kwdefaults__])
        if enclosed:
            self.add(enclosed_by(function))
        for name, value in globals_of(function).items():
            self.add([name, value])
        self.names = outer

    def _add_helper(self, helper: Any) -> None:
        if helper in _STANDS_FOR:
            self.add(_STANDS_FOR[helper])
        elif self._is_new(helper):
            try:
                self.add(sorted(options_of(helper).items()))
                self.add_function(getattr(helper, "py_func", helper))
            finally:
                self.helpers.append(helper)

    def _add_module(self, module: types.ModuleType) -> None:
        self.hash.update(module.__name__.encode())
        if not of_library(module.__name__):
            for name in sorted(self.names & set(vars(module))):
                if self._is_new(module, name):
                    self.add([name, vars(module)[name]])

    def _add_name(self, value: Any) -> None:
        """Functions and types of the libraries stand for themselves by their names; nothing else does."""
        if isinstance(value, type) and hasattr(value, "_fields"):
            self.hash.update(f"{value.__qualname__}{value._fields}".encode())
            return
        module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
        if type(value) is np.ufunc:
            module, name = "numpy", value.__name__
        if module is None or name is None or not of_library(module):
            raise CannotBeWatched
        self.hash.update(f"{module}.{name}".encode())

    def _is_new(self, value: Any, name: str = "") -> bool:
        key = (id(value), name)
        if key in self.seen:  # one of several, and which one counts
            self.hash.update(f"<again {self.seen[key]}>".encode())
            return False
        self.seen[key] = len(self.seen)
        return True


def names_in(code: types.CodeType) -> set[str]:
    """Names of globals and attributes in a code and the functions within it."""
    inner = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*map(names_in, inner))


def globals_of(function: Any) -> dict[str, Any]:
    """The globals that a function, or one within it, loads; an attribute of that name, as in `math.log`, is none."""
    names = _loaded(function.__code__) & set(function.__globals__)
    return {name: function.__globals__[name] for name in sorted(names)}


@lru_cache(MOST_CODES)
def _loaded(code: types.CodeType) -> frozenset[str]:
    inner = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    own = {each.argval for each in dis.get_instructions(code) if each.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return frozenset(own).union(*map(_loaded, inner))


def names_reached(function: Any, seen: set[int] | None = None) -> set[str]:
    """Names in a function and in compiled helpers that it names, to which it may pass a module."""
    seen = set() if seen is None else seen
    seen.add(id(function))
    names = names_in(function.__code__)
    values = [*globals_of(function).values(), *enclosed_by(function)]
    modules = [value for value in values if isinstance(value, types.ModuleType) and not of_library(value.__name__)]
    values += [vars(module)[name] for module in modules for name in names & set(vars(module))]
    helpers = [value for value in values if isinstance(value, Dispatcher) or registered(value)]
    functions = [getattr(helper, "py_func", helper) for helper in helpers if helper not in _STANDS_FOR]
    return names.union(*(names_reached(each, seen) for each in functions if id(each) not in seen))


def of_library(module: str) -> bool:
    """Whether a module is of Python, or of a package that is told by its version."""
    return module.partition(".")[0] in LIBRARIES

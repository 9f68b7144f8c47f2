"""Systems in other processes: their functions travel by name, and never as a number that means another's there."""

import importlib
import pickle
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

from twoloop.kernels.compile.private import Dispatcher
from twoloop.problem.generated import GeneratedCode, code_of


@dataclass(frozen=True)
class ByName:
    """A compiled callback at the top level of a module."""

    module: str
    name: str

    def found(self) -> Dispatcher:
        """The callback, in this process.

        Raises
        ------
        AttributeError, ImportError
            If there is no such module here, or nothing of that name in it.
        """
        return attrgetter(self.name)(importlib.import_module(self.module))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class FromEquations:
    """A callback of generated code, which travels as source."""

    code: GeneratedCode
    kind: str

    def found(self) -> Dispatcher:
        """The callback, compiled in this process or read from the disk."""
        return self.code.callback(self.kind)


def packed(system_name: str, kind: str, function: Any) -> Any:
    """What to pickle in the place of a function.

    Raises
    ------
    TypeError
        If it is a plain function that pickle cannot find by its name.
    """
    if isinstance(function, Dispatcher):
        if (code := code_of(function)) is not None:
            return FromEquations(code, kind)
        named = ByName(function.py_func.__module__, function.py_func.__qualname__)
        try:
            return named if named.found() is function else function
        except (AttributeError, ImportError):  # made within a function: numba sends its source along
            return function
    try:
        pickle.dumps(function)
    except Exception as error:
        name = getattr(function, "__qualname__", repr(function))
        raise TypeError(
            f"{kind} of {system_name!r}, {name}, cannot be pickled, and so neither can the system: another process "
            "finds a function by its name in a module, which a lambda, or a function within a function, does not have. "
            f"Write {kind} at the top level of a module (what it encloses may become attributes of an object with "
            f"__call__), or make the system in that process. Pickle says: {error}"
        ) from None
    return function


def unpacked(function: Any) -> Any:
    """The function that `packed` replaced."""
    return function.found() if isinstance(function, (ByName, FromEquations)) else function

"""Digest of a function: its code, the values that it encloses, and everything these refer to."""

from __future__ import annotations

import enum
import functools
import hashlib
import sys
import types
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.kernels.compile.dependencies import LIBRARIES, CannotBeWatched, Digest
from twoloop.kernels.compile.private import Dispatcher
from twoloop.problem.system import ConstrainedSystem

INSTALLED = {"site-packages", "dist-packages"}  # folders
PLAIN = (bool, int, float, complex, str, bytes)
# attributes of a class that do not affect its behaviour
SKIPPED = {"__dict__", "__weakref__", "__doc__", "__module__", "__firstlineno__", "__static_attributes__"}
# attributes of a system that affect its runs
OF_SYSTEM = ("n_q", "n_c", "n_a", "parameters", "constant_mass", "bandwidth", "given", "python_functions", "_returning")


def digest_of(what: str, value: Any) -> str:
    """Return a digest of a value, including the code of all functions that it reaches and the values they refer to.

    Parameters
    ----------
    what : str
        Name of the value in messages.
    value : object

    Raises ValueError if it reaches something whose state cannot be read, such as an open file or a lock.
    """
    digest = _OfFunctions()
    try:
        digest.add(value)
    except CannotBeWatched as why:
        raise ValueError(
            f"{what} reaches {why}, whose state cannot be read, so that saved rows cannot be matched with "
            "the functions. Create it inside the function, or omit `out`"
        ) from None
    return digest.hash.hexdigest()


@cache
def digest_of_package() -> str:
    """Return a digest of the sources of this package."""
    digest, folder = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        digest.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return digest.hexdigest()


class _OfFunctions(Digest):
    """Follows plain functions, classes and objects as well; installed code is represented by its name and version."""

    def __init__(self) -> None:
        super().__init__()
        self.places: dict[int, int] = {}  # index of each object visited, by id ...
        self.met: list[Any] = []  # ... the objects, kept alive so that ids are not reused
        self.within_object = False
        self.open: list[int] = []  # containers being visited

    def add(self, value: Any) -> None:
        """Add a value of any type."""
        if isinstance(value, (tuple, list, dict, set, frozenset, types.MappingProxyType)):
            self._add_container(value)
        elif isinstance(value, np.ndarray) and value.dtype.hasobject:
            self.add([str(value.dtype), value.shape, value.ravel().tolist()])
        elif isinstance(value, PLAIN) and not isinstance(value, np.generic) and type(value) not in PLAIN:
            self._add_name(value)  # instance of a subclass, whose repr is not reliable
        else:
            super().add(value)

    def _add_container(self, value: Any) -> None:
        if id(value) in self.open:
            self.hash.update(f"<within itself {self.open.index(id(value))}>".encode())
            return
        self.open.append(id(value))
        try:
            if isinstance(value, (set, frozenset)):  # their order differs between processes
                self.hash.update(f"<{type(value).__qualname__}>{sorted(map(self._alone, value))}".encode())
            elif isinstance(value, types.MappingProxyType):
                self.add(dict(value))
            elif type(value) in (tuple, list, dict):
                super().add(value)
            else:  # instance of a subclass
                self._add_object(value)
        finally:
            self.open.pop()

    @staticmethod
    def _alone(value: Any) -> str:
        digest = _OfFunctions()
        digest.add(value)
        return digest.hash.hexdigest()

    def _add_helper(self, helper: Dispatcher) -> None:
        self.add([sorted(helper.targetoptions.items()), helper.py_func])

    def _add_module(self, module: types.ModuleType) -> None:
        if _installed(module.__name__):
            self.hash.update(f"{module.__name__} {_version(module.__name__)}".encode())
        elif self.within_object:  # methods may refer to anything in the module
            self.hash.update(Path(str(module.__file__)).read_bytes())
        else:
            super()._add_module(module)

    def add_function(self, function: Any, enclosed: bool = True) -> None:
        """Add the code of a function, its defaults, and the values of the globals that it names."""
        outer, self.within_object = self.within_object, False
        super().add_function(function, enclosed)
        self.within_object = outer

    def _add_name(self, value: Any) -> None:
        if id(value) in self.places:
            self.hash.update(f"<again {self.places[id(value)]}>".encode())
            return
        self.places[id(value)] = len(self.places)
        self.met.append(value)
        if isinstance(value, (types.FunctionType, type)) and _installed(value.__module__):
            self.hash.update(f"{value.__module__}.{value.__qualname__} {_version(value.__module__)}".encode())
        elif isinstance(value, types.FunctionType):
            self.add_function(value)
        elif isinstance(value, enum.EnumType):
            more = [each for _, each in sorted(vars(value).items()) if isinstance(each, (types.FunctionType, property))]
            self.add([[(name, value.__members__[name].value) for name in value.__members__], more])
        elif isinstance(value, type):
            own = {name: each for name, each in vars(value).items() if name not in SKIPPED and name[:5] != "_abc_"}
            self.add([value.__qualname__, list(value.__bases__), sorted(own.items(), key=lambda item: item[0])])
        elif isinstance(value, types.MethodType):
            self.add([value.__func__, value.__self__])
        elif isinstance(value, (staticmethod, classmethod, functools._lru_cache_wrapper)):
            self.add(value.__wrapped__)
        elif isinstance(value, functools.cached_property):
            self.add(value.func)
        elif isinstance(value, property):
            self.add([value.fget, value.fset])
        elif isinstance(value, ConstrainedSystem):
            self.add([getattr(value, name) for name in OF_SYSTEM])
            self.add(value.description)
        else:
            self._add_object(value)

    def _add_object(self, value: Any) -> None:
        """Add an object by its pickle representation."""
        try:
            parts = value.__reduce_ex__(4)
        except Exception:
            raise CannotBeWatched(f"an object of type {type(value).__qualname__}") from None
        self.add(type(value))
        if isinstance(parts, str):  # the name of a global of a module
            self.hash.update(f"{getattr(value, '__module__', '')}.{parts}".encode())
            return
        outer, self.within_object = self.within_object, True
        self.met.append(parts)
        for part in parts:  # the items of a container are an iterator
            self.add(list(part) if hasattr(part, "__next__") else part)
        self.within_object = outer


def _installed(module: str | None) -> bool:
    """Return True if a module belongs to Python or this package, or was installed: its version identifies it."""
    top = (module or "").partition(".")[0]
    if top in LIBRARIES or top == "twoloop":
        return True
    file = getattr(sys.modules.get(top), "__file__", None)
    return file is not None and not INSTALLED.isdisjoint(Path(file).parts)


def _version(module: str) -> str:
    return str(getattr(sys.modules.get(module.partition(".")[0]), "__version__", ""))


def described(value: Any) -> str:
    """Return a value in words, for messages; a function by its location, as addresses differ between processes."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(described, value))}]"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={described(value[name])}" for name in sorted(value))
    name = getattr(value, "__qualname__", None)
    return repr(value) if name is None else f"{value.__module__}.{name}"

"""Save the rows of a sweep to a Parquet file, from which an interrupted sweep resumes."""

from __future__ import annotations

import enum
import functools
import hashlib
import os
import sys
import types
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.checks.arguments import needed
from twoloop.kernels.compile.dependencies import LIBRARIES, Digest, NotDigestible
from twoloop.kernels.compile.linking import Dispatcher
from twoloop.problem.system import ConstrainedSystem

# metadata of the Parquet file
WORDS, FINGERPRINTS = "twoloop sweep", "twoloop sweep, digests"
INSTALLED = {"site-packages", "dist-packages"}  # folders
PLAIN = (bool, int, float, complex, str, bytes)
# attributes of a class that do not affect its behaviour
IGNORED = {"__dict__", "__weakref__", "__doc__", "__module__", "__firstlineno__", "__static_attributes__"}
# attributes of a system that affect its runs
OF_SYSTEM = ("n_q", "n_c", "n_a", "parameters", "constant_mass", "bandwidth", "given", "python_functions", "_returning")


@dataclass(frozen=True)
class Settings:
    """Everything the rows depend on other than their parameters.

    Attributes
    ----------
    words : str
        Description for messages.
    fingerprints : dict
        Fingerprints of code and values, by name.
    """

    words: str
    fingerprints: dict[str, str]


def settings(work: tuple[Any, Any, dict[str, Any]]) -> Settings:
    """Return everything on which the rows of a sweep depend.

    Raises ValueError if a value that a function refers to cannot be compared.
    """
    problem_of, measure, options = work
    words = [_in_words(problem_of), _in_words(measure)] + [_in_words(options)] * bool(options)
    values = {"problem_of": problem_of, "measure": measure, **options}
    fingerprints = {name: _fingerprint(name, value) for name, value in values.items()}
    return Settings(", ".join(words), fingerprints | {"twoloop itself": _fingerprint_of_package()})


def write(table: Any, path: Path, current: Settings) -> None:
    """Write the rows atomically."""
    needed("pyarrow", "pyarrow", "out=")
    table.attrs |= {WORDS: current.words, FINGERPRINTS: current.fingerprints}
    new = path.with_name(f".{path.name}.new")
    table.to_parquet(new, engine="pyarrow")
    os.replace(new, path)


def read(pandas: Any, path: Path, parameters: list[dict[str, Any]], current: Settings) -> dict[int, dict[str, Any]]:
    """Return the rows of a file by run number; empty if there is no file.

    Raises ValueError if the file belongs to a sweep with other functions, options or parameters.
    """
    needed("pyarrow", "pyarrow", "out=")
    if not path.parent.is_dir():
        raise ValueError(f"out must be a file in a folder that exists; given {str(path)!r}")
    if not path.exists():
        return {}
    advice = "Give another file, or remove this one to start over"
    try:
        table = pandas.read_parquet(path, engine="pyarrow")
    except Exception as error:
        raise ValueError(f"out must be a file that a sweep wrote; {str(path)!r} cannot be read: {error}") from None
    words = table.attrs.get(WORDS)
    if words is None:
        raise ValueError(f"out must be a file that a sweep wrote; {str(path)!r} holds something else. {advice}")
    if words != current.words:
        raise ValueError(f"out, {str(path)!r}, holds runs of {words}; this sweep is of {current.words}. {advice}")
    saved = table.attrs.get(FINGERPRINTS) or {}
    changed = [name for name, fingerprint in current.fingerprints.items() if saved.get(name) != fingerprint]
    if changed:
        raise ValueError(
            f"out, {str(path)!r}, holds runs of functions or values that have changed: "
            f"{', '.join(changed)} (its code, what it encloses, or a global that it uses). {advice}"
        )
    rows = {int(number): row for number, row in zip(table.index, table.to_dict("records"), strict=True)}
    for number, row in rows.items():
        run = parameters[number] if number < len(parameters) else None
        if run is None or any(not _same(row.get(name), value) for name, value in run.items()):
            in_file = {name: row.get(name) for name in parameters[0]}
            raise ValueError(
                f"out, {str(path)!r}, holds other runs: {number} has {in_file}, "
                f"{'not asked for' if run is None else run}. {advice}"
            )
    return rows


def _same(saved: Any, value: Any) -> bool:
    """Return True if a cell holds a value; NaN equals NaN here."""
    return bool(saved == value or (saved != saved and value != value))


def _in_words(value: Any) -> str:
    """Return a value in words, for messages; a function by its location, as addresses differ between processes."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_in_words, value))}]"
    if isinstance(value, Mapping):
        return ", ".join(f"{name}={_in_words(value[name])}" for name in sorted(value))
    name = getattr(value, "__qualname__", None)
    return repr(value) if name is None else f"{value.__module__}.{name}"


def _fingerprint(name: str, value: Any) -> str:
    """Return a hash of a value, of the code of all functions that it reaches, and of the values they refer to.

    Parameters
    ----------
    name : str
        Name of the value in messages.
    value : object

    Raises ValueError if it reaches something whose state cannot be read, such as an open file or a lock.
    """
    fingerprint = _Fingerprint()
    try:
        fingerprint.add(value)
    except NotDigestible as why:
        raise ValueError(
            f"{name} reaches {why}, whose state cannot be read, so that saved rows cannot be matched with "
            "the functions. Create it inside the function, or omit `out`"
        ) from None
    return fingerprint.hash.hexdigest()


@cache
def _fingerprint_of_package() -> str:
    """Return a hash of the sources of this package."""
    fingerprint, folder = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(folder.rglob("*.py")):
        fingerprint.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return fingerprint.hexdigest()


class _Fingerprint(Digest):
    """Follow plain functions, classes and objects as well; installed code is represented by its name and version."""

    def __init__(self) -> None:
        super().__init__()
        self.indices: dict[int, int] = {}  # index of each object visited, by id ...
        self.visited: list[Any] = []  # ... the objects, kept alive so that ids are not reused
        self.within_object = False
        self.containers: list[int] = []  # containers being visited

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
        if id(value) in self.containers:
            self.hash.update(f"<within itself {self.containers.index(id(value))}>".encode())
            return
        self.containers.append(id(value))
        try:
            if isinstance(value, (set, frozenset)):  # their order differs between processes
                self.hash.update(f"<{type(value).__qualname__}>{sorted(map(self._hash_of, value))}".encode())
            elif isinstance(value, types.MappingProxyType):
                self.add(dict(value))
            elif type(value) in (tuple, list, dict):
                super().add(value)
            else:  # instance of a subclass
                self._add_object(value)
        finally:
            self.containers.pop()

    @staticmethod
    def _hash_of(value: Any) -> str:
        fingerprint = _Fingerprint()
        fingerprint.add(value)
        return fingerprint.hash.hexdigest()

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
        if id(value) in self.indices:
            self.hash.update(f"<again {self.indices[id(value)]}>".encode())
            return
        self.indices[id(value)] = len(self.indices)
        self.visited.append(value)
        if isinstance(value, (types.FunctionType, type)) and _installed(value.__module__):
            self.hash.update(f"{value.__module__}.{value.__qualname__} {_version(value.__module__)}".encode())
        elif isinstance(value, types.FunctionType):
            self.add_function(value)
        elif isinstance(value, enum.EnumType):
            methods = [m for _, m in sorted(vars(value).items()) if isinstance(m, (types.FunctionType, property))]
            self.add([[(name, value.__members__[name].value) for name in value.__members__], methods])
        elif isinstance(value, type):
            attributes = {k: x for k, x in vars(value).items() if k not in IGNORED and k[:5] != "_abc_"}
            self.add([value.__qualname__, list(value.__bases__), sorted(attributes.items(), key=lambda item: item[0])])
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
            raise NotDigestible(f"an object of type {type(value).__qualname__}") from None
        self.add(type(value))
        if isinstance(parts, str):  # the name of a global of a module
            self.hash.update(f"{getattr(value, '__module__', '')}.{parts}".encode())
            return
        outer, self.within_object = self.within_object, True
        self.visited.append(parts)
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

"""Rows of a sweep: solve one run, check the cells of parameters and measures, and save rows to a Parquet file.

An interrupted sweep resumes from that file.
"""

from __future__ import annotations

import enum
import functools
import hashlib
import inspect
import math
import os
import sys
import time
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop.checks.arguments import needed, shown
from twoloop.kernels.compile.dependencies import LIBRARIES, Digest, NotDigestible
from twoloop.kernels.compile.linking import Dispatcher
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import solve_dae

if TYPE_CHECKING:
    from twoloop.problem.problem import Problem

Row = dict[str, Any]
Work = tuple[Callable[..., Any], Callable[..., Any], dict[str, Any]]  # problem_of, measure, options

STANDARD_COLUMNS = ("status", "message", "seconds")
INTEGER_LIMIT = 2**63  # integers must be smaller to fit into a column


def ends(problem: Problem, result: Result) -> dict[str, Any]:
    """Return the default measures of a sweep: last time, steps, evaluations and the largest energy error.

    The energy error is NaN unless the problem declares its energy an invariant.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> from twoloop.sweeps.one_run import ends
    >>> measures = ends(problem, result)
    >>> "energy_error" in measures
    True
    """
    energy = result.energy if problem.conserved and result.t.size else np.array([np.nan])
    return {
        "t": result.t[-1] if result.t.size else np.nan,
        "n_accepted": result.stats.n_accepted,
        "n_evaluations": result.stats.n_evaluations,
        "energy_error": float(np.abs(energy - energy[0]).max()),
    }


def one_run(work: Work, parameters: Row, first: bool = False) -> Row:
    """Solve a run and return its columns beside the parameters; errors are rows, but that of the `first` is raised."""
    problem_of, measure, options = work
    start = time.perf_counter()
    try:
        problem = problem_of(**parameters)
        if not hasattr(problem, "system"):
            raise TypeError(f"problem_of must return a Problem; it returned {shown(problem)}")
        call = {"t_span": problem.t_span, "q0": problem.q0, "v0": problem.v0, **options}
        result = solve_dae(problem.system, **call)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        row = {"status": result.status.name, "message": result.message, "seconds": time.perf_counter() - start}
        return row | _checked_measures(measure(problem, result), {*parameters, *STANDARD_COLUMNS, "run"})
    except (Exception, SystemExit) as error:
        if first and not isinstance(error, ValueError):
            raise
        return failure_row(f"{type(error).__name__}: {error}", time.perf_counter() - start)


def failure_row(message: str, seconds: float = math.nan) -> Row:
    """Return the row of a run that raised an exception."""
    return {"status": "ERROR", "message": message, "seconds": seconds}


def _checked_measures(measures: Any, columns: set[str]) -> Row:
    """Return the new columns of a measure; raise TypeError if one exists already or is not a cell of a table."""
    if not isinstance(measures, Mapping):
        raise TypeError(f"measure must return a mapping of columns; it returned {shown(measures)}")
    row = {}
    for name, value in measures.items():
        if not isinstance(name, str):
            raise TypeError(f"measure must name its columns by strings; it returned {shown(name)}")
        if name in columns:
            raise TypeError(f"measure must return columns that the row has not already; it returned {name!r}")
        cell = value.item() if isinstance(value, (np.generic, np.ndarray)) and np.ndim(value) == 0 else value
        if not (cell is None or kind_of(cell) or _is_nan(cell)):
            raise TypeError(
                f"measure must return numbers, strings, True and False or None, cells of a table; {name!r} is "
                f"{shown(value)} of type {type(value).__name__}"
            )
        row[name] = cell
    return row


def kind_of(value: Any) -> str | None:
    """Return the kind of column that a cell belongs to; None if it fits any (a missing number) or no column."""
    if isinstance(value, bool):
        return "True and False"
    if isinstance(value, float) or (isinstance(value, int) and -INTEGER_LIMIT <= value < INTEGER_LIMIT):
        return None if math.isnan(value) else "numbers"
    return "strings" if isinstance(value, str) else None


def _is_nan(value: Any) -> bool:
    return isinstance(value, float) and math.isnan(value)


def fit_columns(row: Row, kinds: dict[str, str]) -> Row:
    """Return the row, or that of a failure if it does not fit the kinds of the columns, which it may extend.

    A Parquet column has one kind and valid text.
    """
    row = {k: value.encode(errors="replace").decode() if isinstance(value, str) else value for k, value in row.items()}
    for name, value in row.items():
        kind = kind_of(value)
        if kind is not None and kinds.setdefault(name, kind) != kind:
            return failure_row(
                f"TypeError: measure must fill a column with one kind; {name!r} had {kinds[name]}, now {shown(value)}",
                row["seconds"],
            )
    return row


def check_parameters(problem_of: Any, parameters: Any) -> list[Row]:
    """Return the parameters of all runs as plain cells; raise TypeError or ValueError, naming the argument."""
    if not callable(problem_of):
        raise TypeError(f"problem_of must be a function that returns a Problem; given {shown(problem_of)}")
    if isinstance(parameters, (str, Mapping)) or not isinstance(parameters, Sequence):
        raise TypeError(
            f"parameters must be a list of mappings, one for each run, such as [{{'theta3': 0.1}}, {{'theta3': 0.2}}]; "
            f"given {shown(parameters)}"
        )
    if not parameters:
        raise ValueError("parameters must contain at least one run; given none")
    signature, runs = inspect.signature(problem_of), []
    kinds: dict[str, str] = {}
    for number, run in enumerate(parameters):
        if not isinstance(run, Mapping):
            raise TypeError(f"parameters[{number}] must be a mapping of names to values; given {shown(run)}")
        if set(run) != set(parameters[0]):
            raise ValueError(
                f"parameters must all have the same names; [0] has {sorted(parameters[0])}, [{number}] {sorted(run)}"
            )
        taken = sorted(set(run) & {*STANDARD_COLUMNS, "run"})
        if taken:
            raise ValueError(f"parameters must not have the name of a standard column; given {taken[0]!r}")
        cells = {name: value.item() if isinstance(value, np.generic) else value for name, value in run.items()}
        for name, value in cells.items():
            kind = kind_of(value)
            if kind is None and not _is_nan(value):
                raise TypeError(
                    f"parameters[{number}][{name!r}] must be a number, a string, True or False, a cell of a table; "
                    f"given {shown(value)}. Give the parts one by one, and let problem_of put them together"
                )
            if kind is not None and kinds.setdefault(name, kind) != kind:
                raise TypeError(
                    f"parameters must be of one kind under one name, as they fill a column of a table; {name!r} has "
                    f"{kinds[name]}, and {shown(value)} in [{number}]"
                )
        try:
            signature.bind(**run)
        except TypeError as error:
            raise TypeError(f"problem_of does not take parameters[{number}]: {error}") from None
        runs.append(cells)
    return runs


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
    """Everything the rows depend on other than their parameters."""

    words: str  # description for messages
    fingerprints: dict[str, str]  # fingerprints of code and values, by name


def sweep_settings(work: Work) -> Settings:
    """Return everything the rows of a sweep depend on; raise ValueError if a value cannot be compared."""
    problem_of, measure, options = work
    words = [_in_words(problem_of), _in_words(measure)] + [_in_words(options)] * bool(options)
    values = {"problem_of": problem_of, "measure": measure, **options}
    fingerprints = {name: _fingerprint(name, value) for name, value in values.items()}
    return Settings(", ".join(words), fingerprints | {"twoloop itself": _fingerprint_of_package()})


def write_rows(table: Any, path: Path, current: Settings) -> None:
    """Write the rows atomically."""
    needed("pyarrow", "pyarrow", "out=")
    table.attrs |= {WORDS: current.words, FINGERPRINTS: current.fingerprints}
    new = path.with_name(f".{path.name}.new")
    table.to_parquet(new, engine="pyarrow")
    os.replace(new, path)


def read_rows(
    pandas: Any, path: Path, parameters: list[dict[str, Any]], current: Settings
) -> dict[int, dict[str, Any]]:
    """Return the rows of a file, if there is one, by run number; raise ValueError if they are of another sweep."""
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
        pairs = [] if run is None else [(row.get(name), value) for name, value in run.items()]
        if run is None or any(a != b and not (_is_nan(a) and _is_nan(b)) for a, b in pairs):
            in_file = {name: row.get(name) for name in parameters[0]}
            raise ValueError(
                f"out, {str(path)!r}, holds other runs: {number} has {in_file}, "
                f"{'not asked for' if run is None else run}. {advice}"
            )
    return rows


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

    Raise ValueError if it reaches something whose state cannot be read, such as an open file or a lock.
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

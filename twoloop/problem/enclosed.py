"""Numbers that compiled functions enclose: numba keeps those that it found, whatever becomes of them later."""

from __future__ import annotations

import dis
from collections.abc import Iterator
from functools import lru_cache
from itertools import chain, pairwise
from types import CellType, CodeType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from twoloop.checks.arguments import shown
from twoloop.kernels.compile.dependencies import of_library
from twoloop.kernels.compile.indices import UNWATCHED
from twoloop.kernels.compile.private import Dispatcher

NUMBERS = (bool, int, float, complex, tuple, np.generic)


class Change(NamedTuple):
    """What is no longer as it was compiled: the callback, the name in it, and both values."""

    kind: str
    name: str
    compiled: Any
    now: Any

    def message(self, system: str) -> str:
        """What is wrong, and what to do."""
        return (
            f"{self.kind} of {system!r} was compiled with {self.name} = {shown(self.compiled)}, which is "
            f"{shown(self.now)} now; the compiled function keeps the first. Pass {self.name} through parameters, make "
            "the system again after the change, or leave compile=True out"
        )


class Enclosed:
    """The numbers and arrays that compiled callbacks name, as they were when these were compiled.

    Parameters
    ----------
    callbacks : dict of str to Dispatcher
        By kind. Compiled helpers are followed.
    """

    def __init__(self, callbacks: dict[str, Dispatcher]):
        cells, names, arrays = {}, {}, {}
        for kind, function in callbacks.items():
            for space, name, value in _enclosed(function, set()):
                if isinstance(value, np.ndarray):
                    arrays[id(value)] = value, value.tobytes(), kind, name
                if isinstance(space, CellType):
                    cells[id(space)] = space, value, kind, name
                elif space is not None:
                    names[id(space), name] = space, value, kind, name
        self._cells, self._names, self._arrays = tuple(cells.values()), tuple(names.values()), tuple(arrays.values())
        self.any = bool(cells or names or arrays)

    def change(self) -> Change | None:
        """The first change there is; without one hardly anything is called, as every `solve_dae` looks."""
        for cell, value, kind, name in self._cells:
            if cell.cell_contents is not value and _differ(cell.cell_contents, value):
                return Change(kind, name, value, cell.cell_contents)
        for space, value, kind, name in self._names:
            if name in space and space[name] is not value and _differ(space[name], value):
                return Change(kind, name, value, space[name])
        for array, content, kind, name in self._arrays:
            if array.tobytes() != content:
                return Change(kind, name, np.frombuffer(content, array.dtype).reshape(array.shape), array)
        return None


def _differ(one: Any, other: Any) -> bool:
    return not np.array_equal(one, other) and one is not other


def _enclosed(function: Any, seen: set[int]) -> Iterator[tuple[Any, str, Any]]:
    """Where a function finds a number or an array, a cell or a namespace (None: a default), its name, and its value."""
    function = function.py_func if isinstance(function, Dispatcher) else function
    function = getattr(function, UNWATCHED, function)  # of a copy whose surroundings stay as they were
    if id(function) in seen:
        return
    seen.add(id(function))
    code, space = function.__code__, function.__globals__
    ours = space.get("__name__", "").partition(".")[0] == "twoloop"
    closure = zip(function.__closure__ or (), code.co_freevars, strict=True)
    defaults = zip(code.co_varnames[: code.co_argcount][::-1], (function.__defaults__ or ())[::-1], strict=False)
    found = [(cell, name, cell.cell_contents) for cell, name in closure] + [(None, *each) for each in defaults]
    for name, attribute in _names_in(code):
        value = space.get(name)
        if isinstance(value, ModuleType) and not of_library(value.__name__):
            found.append((vars(value), attribute, vars(value).get(attribute)))
        found.append((space, name, value))
    for place, name, value in found:
        if isinstance(value, Dispatcher):
            yield from _enclosed(value, seen)
        elif ours:
            continue
        elif isinstance(value, NUMBERS) or (isinstance(value, np.ndarray) and not value.dtype.hasobject):
            yield place, name, value


@lru_cache(maxsize=1024)  # functions are made again and again from one code, and every `solve_dae` looks
def _names_in(code: CodeType) -> tuple[tuple[str, str], ...]:
    """The globals that a code and the functions within it load, each with the attribute that is taken of it, or ""."""
    found = [
        (one.argval, following.argval if following.opname in ("LOAD_ATTR", "LOAD_METHOD") else "")
        for one, following in pairwise(dis.get_instructions(code))
        if one.opname == "LOAD_GLOBAL"
    ]
    inner = [_names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType)]
    return tuple(chain(found, *inner))

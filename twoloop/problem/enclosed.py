"""What compiled functions enclose, numbers and helpers: numba keeps those that it found, whatever becomes of them."""

from __future__ import annotations

from types import CellType
from typing import Any, NamedTuple

import numpy as np

from twoloop.checks.arguments import shown
from twoloop.kernels.compile.dependencies import CannotBeWatched, Digest
from twoloop.kernels.compile.frozen import found_by, python_function
from twoloop.kernels.compile.private import Dispatcher


class Change(NamedTuple):
    """What is no longer as it was compiled: the callback, the name in it, and both values."""

    kind: str
    name: str
    compiled: Any
    now: Any

    def message(self, system: str) -> str:
        """What is wrong, and what to do."""
        number = "" if callable(self.compiled) else f"pass {self.name} through parameters, "
        return (
            f"{self.kind} of {system!r} was compiled with {self.name} = {shown(self.compiled)}, which is "
            f"{shown(self.now)} now; the compiled function keeps the first. To have the second, {number}make the "
            "function and the system again after the change, or leave compile=True out"
        )


class Enclosed:
    """What compiled callbacks name and numba freezes, as it was when these were compiled.

    Parameters
    ----------
    callbacks : dict of str to Dispatcher
        By kind. Compiled helpers are followed, and tuples, and modules of the user.
    """

    def __init__(self, callbacks: dict[str, Dispatcher]):
        cells, names, arrays = {}, {}, {}
        for kind, callback in callbacks.items():
            for (holder, key, name, value), content in found_by(callback):
                if content is not None:
                    arrays[id(value), content] = value, content, kind, name
                if isinstance(holder, CellType):
                    cells[id(holder), id(value)] = holder, value, kind, name
                elif holder is not None:
                    names[id(holder), key, id(value)] = holder, key, value, kind, name
        self._cells, self._names, self._arrays = tuple(cells.values()), tuple(names.values()), tuple(arrays.values())
        self.any = bool(cells or names or arrays)

    def change(self) -> Change | None:
        """The first change there is; without one hardly anything is called, as every `solve_dae` looks."""
        for cell, value, kind, name in self._cells:
            if cell.cell_contents is not value and _differ(cell.cell_contents, value):
                return Change(kind, name, value, cell.cell_contents)
        for space, key, value, kind, name in self._names:
            if key in space and space[key] is not value and _differ(space[key], value):
                return Change(kind, name, value, space[key])
        for array, content, kind, name in self._arrays:
            if array.tobytes() != content:
                return Change(kind, name, np.frombuffer(content, array.dtype).reshape(array.shape), array)
        return None


def _differ(one: Any, other: Any) -> bool:
    """Whether two values are not the same to a compiled function; helpers are if their codes and numbers are."""
    if one is other:
        return False
    if isinstance(one, tuple) and isinstance(other, tuple):
        fields = getattr(one, "_fields", None) != getattr(other, "_fields", None)
        return fields or len(one) != len(other) or any(map(_differ, one, other))
    if python_function(one) and python_function(other):
        return _code_of(one) != _code_of(other)
    return not np.array_equal(one, other)


def _code_of(helper: Any) -> str:
    """A digest of a helper, and of all that it names; of one with unknown parts, something that no other has."""
    digest = Digest()
    try:
        digest.add(helper)
    except CannotBeWatched:
        return f"{id(helper)}"
    return digest.hash.hexdigest()

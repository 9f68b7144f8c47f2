"""What numba freezes in the functions it compiles: globals, free variables, defaults, modules, tuples, helpers."""

from __future__ import annotations

import dis
from collections.abc import Iterator
from functools import lru_cache
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple

import numpy as np

from twoloop.kernels.compile.dependencies import names_reached, of_library
from twoloop.kernels.compile.private import Dispatcher, registered

OURS = ("twoloop.", "twoloop_equations_")  # our modules, and generated ones: what they name stays as it is
LOADS_ATTRIBUTE = ("LOAD_ATTR", "LOAD_METHOD")
AS_COMPILED = "__as_compiled__"  # the attribute of a compiled callback that holds what it named then
BETWEEN = ("EXTENDED_ARG", "CACHE", "NOP", "PUSH_NULL")  # these do nothing to what was loaded


class Place(NamedTuple):
    """Where a function finds a value.

    Attributes
    ----------
    holder : cell, dict or None
        What holds it, and may hold another later; None: a default, or an item of a tuple, which stays.
    key : str
        By which a dict has it.
    name : str
        In messages, such as "package.module.K" or "TABLES[0]".
    value : object
        What is there now.
    """

    holder: CellType | dict[str, Any] | None
    key: str
    name: str
    value: Any


class _Loaded(NamedTuple):
    """A global, or a free variable, that a code loads, and what attributes are taken of it, one of the other."""

    free: bool
    name: str
    attributes: tuple[str, ...]


def found_by(compiled: Any, function: Any = None) -> list[tuple[Place, bytes | None]]:
    """What `places` gave when this was first asked, each with the bytes of an array.

    `function` is the one that was compiled, or that of which it was a copy.
    """
    found: list[tuple[Place, bytes | None]] | None = getattr(compiled, AS_COMPILED, None)
    if found is None:
        found = [(each, _bytes(each.value)) for each in places(function or compiled.py_func)]
        setattr(compiled, AS_COMPILED, found)
    return found


def _bytes(value: Any) -> bytes | None:
    return value.tobytes() if isinstance(value, (np.ndarray, np.void)) else None


def places(function: Any, seen: set[int] | None = None) -> Iterator[Place]:
    """Where a function and its compiled helpers find what numba may freeze: numbers, arrays, text, functions, modules.

    What is ours names nothing that changes; of it, only helpers are followed.
    """
    seen = set() if seen is None else seen
    if id(function) in seen:
        return
    seen.add(id(function))
    ours = f"{function.__globals__.get('__name__', '')}.".startswith(OURS)
    for found in _named(function):
        for place in _with_items(found, seen):
            if not ours and _freezes(place.value):
                yield place
            helper = python_function(place.value)
            if helper is not None:
                yield from places(helper, seen)


def python_function(value: Any) -> FunctionType | None:
    """What numba compiles to a helper (by `njit`, `register_jitable`, `vectorize` or `cfunc`); else None."""
    if isinstance(value, Dispatcher):
        return value.py_func  # type: ignore[no-any-return]
    if isinstance(value, FunctionType):
        return value if registered(value) else None
    if type(value).__module__.startswith("numba."):
        inner = getattr(value, "__wrapped__", None)
        return inner if isinstance(inner, FunctionType) else None
    return None


def _freezes(value: Any) -> bool:
    if isinstance(value, ModuleType):
        return not of_library(value.__name__)
    if isinstance(value, (np.ndarray, np.void)):
        return not value.dtype.hasobject
    kinds = (type(None), bool, int, float, complex, str, bytes, tuple, np.generic)
    return isinstance(value, kinds) or callable(value)


def _with_items(place: Place, seen: set[int]) -> Iterator[Place]:
    """A place, and those within it if a tuple is there."""
    yield place
    if not isinstance(place.value, tuple) or id(place.value) in seen:
        return
    seen.add(id(place.value))
    fields = getattr(place.value, "_fields", None)
    for k, value in enumerate(place.value):
        if isinstance(value, (tuple, np.ndarray, np.void)) or callable(value):  # numbers stay
            name = f"{place.name}[{k}]" if fields is None else f"{place.name}.{fields[k]}"
            yield from _with_items(Place(None, "", name, value), seen)


def _named(function: FunctionType) -> Iterator[Place]:
    """Defaults, and the globals and free variables that are loaded, with the attributes that are taken of modules."""
    code, space = function.__code__, function.__globals__
    last = code.co_varnames[: code.co_argcount][::-1]
    for name, value in zip(last, (function.__defaults__ or ())[::-1], strict=False):
        yield Place(None, "", name, value)
    cells: dict[str, CellType] = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
    for free, name, attributes in _loaded(code):
        if not free and name not in space:  # built in
            continue
        holder, value = (cells[name], cells[name].cell_contents) if free else (space, space[name])
        place = Place(holder, name, name, value)
        yield place
        if isinstance(value, ModuleType) and not of_library(value.__name__):
            yield from _of_module(place, attributes, names_reached(function))


def _of_module(place: Place, attributes: tuple[str, ...], names: set[str]) -> Iterator[Place]:
    """Attributes that are taken of a module of the user, and of modules within it.

    Where the module itself goes elsewhere, as to a local variable or to a helper, these are all that bear `names`.
    """
    if not isinstance(place.value, ModuleType) or of_library(place.value.__name__):
        return
    space = vars(place.value)
    for attribute in attributes[:1] or sorted(names & set(space)):
        if attribute in space:
            inner = Place(space, attribute, f"{place.name}.{attribute}", space[attribute])
            yield inner
            yield from _of_module(inner, attributes[1:], names - {attribute})


@lru_cache(maxsize=1024)  # functions are made again and again from one code, and every `solve_dae` looks
def _loaded(code: CodeType) -> tuple[_Loaded, ...]:
    """The globals and free variables that a code and the functions within it load."""
    found: dict[_Loaded, None] = {}
    loaded = None
    for each in dis.get_instructions(code):
        if loaded is not None and each.opname in LOADS_ATTRIBUTE:
            loaded = loaded._replace(attributes=(*loaded.attributes, each.argval))
        elif each.opname not in BETWEEN:
            if loaded is not None:
                found[loaded] = None
            free = each.opname == "LOAD_DEREF" and each.argval in code.co_freevars
            loaded = _Loaded(free, each.argval, ()) if free or each.opname == "LOAD_GLOBAL" else None
    inner = [one for constant in code.co_consts if isinstance(constant, CodeType) for one in _loaded(constant)]
    found.update((one, None) for one in inner if not one.free or one.name in code.co_freevars)
    return tuple(found)

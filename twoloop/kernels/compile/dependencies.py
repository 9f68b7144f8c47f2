"""Find the values on which the machine code of a function depends, to hash, compare or replace them.

When numba compiles a function, it freezes values, that is, makes them part of the machine code: globals, closure
variables, defaults, attributes of modules, items of tuples, and compiled functions that it calls (helpers). `Digest`
hashes these values, as a key of the machine code on disk. `frozen_values` lists where they are stored, to detect later
changes. `FunctionCopier` copies a function with other helpers, for example helpers that check array indices.
"""

from __future__ import annotations

import dis
import enum
import hashlib
import sys
import types
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numba.core.types import Type

from twoloop.kernels.compile.linking import Dispatcher, jitable_templates, options_of

# functions of these libraries are hashed by name only: code cached with other versions of numba or numpy is not used
LIBRARIES = {*sys.stdlib_module_names, "numpy", "numba", "scipy"}

# capacity (number of code objects) of the cache of `_loaded_names`: runs create many functions from one code object,
# and without the cache most of the time of tracing callbacks would be spent on reading its bytecode
MAX_CODES = 2000
DIGEST_VERSION = 2  # part of all digests: increase it to make all machine code cached by earlier versions invalid


def digest_of(text: str, *sources: str | types.ModuleType) -> str:
    """Return one hash of a text and source files (paths or modules); if the hash changes, cached files are outdated."""
    digest = hashlib.sha256(text.encode())
    for source in sources:
        digest.update(Path(source if isinstance(source, str) else str(source.__file__)).read_bytes())
    return digest.hexdigest()


_DIGEST_TEXTS: WeakKeyDictionary[Dispatcher, str] = WeakKeyDictionary()  # texts hashed in place of callbacks


def register_digest(callback: Dispatcher, text: str) -> None:
    """Let digests hash `text` in place of a callback's code and the values that it uses."""
    _DIGEST_TEXTS[callback] = text


def closure_values(function: Any) -> list[Any]:
    """Return the values of the closure variables of a Python function."""
    return [cell.cell_contents for cell in function.__closure__ or ()]


class NotDigestible(Exception):
    """Error: a value may change in a way that no digest shows, so that code that uses it must not be cached."""


class Digest:
    """Hash values of many types; for a function, hash all values that it uses."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256(f"{DIGEST_VERSION} {np.__version__}".encode())
        self.names: set[str] = set()  # if a value is a module, only its attributes with these names are hashed
        # serial numbers of hashed values; key: (id of a module, name of an attribute), or (id of a helper, "")
        self.positions: dict[tuple[int, str], int] = {}
        self.helpers: list[Any] = []  # compiled helpers hashed so far; a helper comes after the helpers that it calls

    def add(self, value: Any) -> None:
        """Add a value to the hash; raise NotDigestible if the value may change later while its hash stays the same."""
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
        elif isinstance(value, Dispatcher) or jitable_templates(value):
            self._add_helper(value)
        else:
            self._add_name(value)

    def add_function(self, function: Any, enclosed: bool = True) -> None:
        """Hash the code, the defaults and the globals of a function; if `enclosed`, also its closure variables."""
        outer, self.names = self.names, reachable_names(function)
        self.add([function.__code__, function.__defaults__, function.__kwdefaults__])
        if enclosed:
            self.add(closure_values(function))
        for name, value in globals_of(function).items():
            self.add([name, value])
        self.names = outer

    def _add_helper(self, helper: Any) -> None:
        if helper in _DIGEST_TEXTS:
            self.add(_DIGEST_TEXTS[helper])
        elif self._is_new(helper):
            try:
                self.add(sorted(options_of(helper).items()))
                self.add_function(getattr(helper, "py_func", helper))
            finally:
                self.helpers.append(helper)

    def _add_module(self, module: types.ModuleType) -> None:
        """Hash the name of a module and, unless it is a library, its attributes that have names in `self.names`."""
        self.hash.update(module.__name__.encode())
        if not is_library(module.__name__):
            for name in sorted(self.names & set(vars(module))):
                if self._is_new(module, name):
                    self.add([name, vars(module)[name]])

    def _add_name(self, value: Any) -> None:
        """Hash a library's function or type by name, a named-tuple type by its fields; else raise NotDigestible."""
        if isinstance(value, type) and hasattr(value, "_fields"):
            self.hash.update(f"{value.__qualname__}{value._fields}".encode())
            return
        module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", None)
        if type(value) is np.ufunc:
            module, name = "numpy", value.__name__
        if module is None or name is None or not is_library(module):
            raise NotDigestible
        self.hash.update(f"{module}.{name}".encode())

    def _is_new(self, value: Any, name: str = "") -> bool:
        """If a value is new, give it a serial number and return True; else hash its serial number and return False."""
        key = (id(value), name)
        if key in self.positions:
            self.hash.update(f"<again {self.positions[key]}>".encode())
            return False
        self.positions[key] = len(self.positions)
        return True


def names_of_code(code: types.CodeType) -> set[str]:
    """Return the names of the globals and attributes that a code object and functions nested in it use."""
    inner_codes = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*map(names_of_code, inner_codes))


def globals_of(function: Any) -> dict[str, Any]:
    """Return the values, by name, of the globals that a function and functions nested in it use."""
    names = {each.name for each in _loaded_names(function.__code__) if not each.free} & set(function.__globals__)
    return {name: function.__globals__[name] for name in sorted(names)}


def reachable_names(function: Any, seen: set[int] | None = None) -> set[str]:
    """Return names of globals and attributes that a function and its helpers use; skip functions with ids in `seen`."""
    seen = set() if seen is None else seen
    seen.add(id(function))
    names = names_of_code(function.__code__)
    values = [*globals_of(function).values(), *closure_values(function)]
    modules = [value for value in values if isinstance(value, types.ModuleType) and not is_library(value.__name__)]
    values += [vars(module)[name] for module in modules for name in names & set(vars(module))]
    helpers = [value for value in values if isinstance(value, Dispatcher) or jitable_templates(value)]
    functions = [getattr(helper, "py_func", helper) for helper in helpers if helper not in _DIGEST_TEXTS]
    return names.union(*(reachable_names(each, seen) for each in functions if id(each) not in seen))


def is_library(module: str) -> bool:
    """Return True if a module, given by name, belongs to one of LIBRARIES."""
    return module.partition(".")[0] in LIBRARIES


def is_twoloop(module: str) -> bool:
    """Return True if a module (given by name) is part of twoloop or generated by twoloop: its globals never change."""
    return f"{module}.".startswith(("twoloop.", "twoloop_equations_"))


LOADS_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME")  # bytecode instructions that load a global (LOAD_NAME: in a class body)
LOADS_ATTRIBUTE = ("LOAD_ATTR", "LOAD_METHOD")  # bytecode instructions that load an attribute
FROZEN_VALUES = "__as_compiled__"  # attribute of a compiled callback that stores the result of `frozen_values`
# bytecode instructions that may stand between loading a variable and loading its attribute
NO_EFFECT = ("EXTENDED_ARG", "CACHE", "NOP", "PUSH_NULL")


class FrozenValue(NamedTuple):
    """Value that is part of a function's machine code, and the place where it is stored.

    holder : closure cell or dict that contains the value; the user may store another value there later. None: the value
        is a default or an item of a tuple, which cannot be replaced.
    key : key of the value if the holder is a dict.
    name : name of the value in messages, such as "package.module.K" or "TABLES[0]".
    """

    holder: CellType | dict[str, Any] | None
    key: str
    name: str
    value: Any


class _LoadedName(NamedTuple):
    """Variable that code loads: closure variable if `free`, else global; for `name.b.c`, `attributes` is ("b", "c")."""

    free: bool
    name: str
    attributes: tuple[str, ...]


def frozen_values(compiled: Any, function: Any = None) -> list[tuple[FrozenValue, bytes | None]]:
    """Return the values that are part of a function's machine code, as pairs: (value, bytes of an array or None).

    The first call, just after the compilation, stores the list in an attribute of `compiled`, so that later comparisons
    show whether a value has changed. `function`: the original function, if a copy of it was compiled.
    """
    values: list[tuple[FrozenValue, bytes | None]] | None = getattr(compiled, FROZEN_VALUES, None)
    if values is None:
        values = [(each, _array_bytes(each.value)) for each in frozen_locations(function or compiled.py_func)]
        setattr(compiled, FROZEN_VALUES, values)
    return values


def _array_bytes(value: Any) -> bytes | None:
    return value.tobytes() if isinstance(value, (np.ndarray, np.void)) else None


def frozen_locations(function: Any, seen: set[int] | None = None) -> Iterator[FrozenValue]:
    """Yield the values that a function and its helpers use and that become part of machine code, such as arrays.

    Omit values in twoloop's functions, which never change, but search their helpers. `seen`: ids of searched objects.
    """
    seen = set() if seen is None else seen
    if id(function) in seen:
        return
    seen.add(id(function))
    is_of_twoloop = is_twoloop(function.__globals__.get("__name__", ""))
    for used in _direct_locations(function):
        for location in _value_and_items(used, seen):
            if not is_of_twoloop and _is_frozen(location.value):
                yield location
            helper = python_function(location.value)
            if helper is not None:
                yield from frozen_locations(helper, seen)


def python_function(value: Any) -> FunctionType | None:
    """Return the Python function that `njit`, `vectorize` etc. have compiled to `value`, or None for other values."""
    if isinstance(value, Dispatcher):
        return value.py_func  # type: ignore[no-any-return]
    if isinstance(value, FunctionType):
        return value if jitable_templates(value) else None
    if type(value).__module__.startswith("numba."):
        inner = getattr(value, "__wrapped__", None)
        return inner if isinstance(inner, FunctionType) else None
    return None


def _is_frozen(value: Any) -> bool:
    """Return True if numba makes a value of this type part of machine code."""
    if isinstance(value, ModuleType):
        return not is_library(value.__name__)
    if isinstance(value, (np.ndarray, np.void)):
        return not value.dtype.hasobject
    kinds = (type(None), bool, int, float, complex, str, bytes, tuple, np.generic)
    return isinstance(value, kinds) or callable(value)


def _value_and_items(location: FrozenValue, seen: set[int]) -> Iterator[FrozenValue]:
    """Yield a value and, if it is a tuple, its items that are arrays, functions or tuples; skip ids in `seen`."""
    yield location
    if not isinstance(location.value, tuple) or id(location.value) in seen:
        return
    seen.add(id(location.value))
    fields = getattr(location.value, "_fields", None)
    for k, value in enumerate(location.value):
        if isinstance(value, (tuple, np.ndarray, np.void)) or callable(value):  # skip numbers etc., which cannot change
            name = f"{location.name}[{k}]" if fields is None else f"{location.name}.{fields[k]}"
            yield from _value_and_items(FrozenValue(None, "", name, value), seen)


def _direct_locations(function: FunctionType) -> Iterator[FrozenValue]:
    """Yield the defaults, globals, closure variables and attributes of modules that a function itself uses."""
    code, namespace = function.__code__, function.__globals__
    last_arguments = code.co_varnames[: code.co_argcount][::-1]
    for name, value in zip(last_arguments, (function.__defaults__ or ())[::-1], strict=False):
        yield FrozenValue(None, "", name, value)
    cells: dict[str, CellType] = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
    for free, name, attributes in _loaded_names(code):
        if not free and name not in namespace:  # a built-in function
            continue
        holder, value = (cells[name], cells[name].cell_contents) if free else (namespace, namespace[name])
        location = FrozenValue(holder, name, name, value)
        yield location
        if isinstance(value, ModuleType) and not is_library(value.__name__):
            yield from _locations_in_module(location, attributes, reachable_names(function))


def _locations_in_module(location: FrozenValue, attributes: tuple[str, ...], names: set[str]) -> Iterator[FrozenValue]:
    """Yield the attributes that a function uses of a user's module (`location`) and of modules within this module.

    `attributes`: names loaded one after another, such as ("inner", "K") for `module.inner.K`. If it is empty, the
    function assigns the module to a variable or passes it on: then yield all attributes whose names are in `names`.
    """
    if not isinstance(location.value, ModuleType) or is_library(location.value.__name__):
        return
    namespace = vars(location.value)
    for attribute in attributes[:1] or sorted(names & set(namespace)):
        if attribute in namespace:
            inner = FrozenValue(namespace, attribute, f"{location.name}.{attribute}", namespace[attribute])
            yield inner
            yield from _locations_in_module(inner, attributes[1:], names - {attribute})


@lru_cache(MAX_CODES)
def _loaded_names(code: CodeType) -> tuple[_LoadedName, ...]:
    """Return the globals and closure variables that a code object and functions nested in it load."""
    loaded_names: dict[_LoadedName, None] = {}
    current_name = None
    for each in dis.get_instructions(code):
        if current_name is not None and each.opname in LOADS_ATTRIBUTE:
            current_name = current_name._replace(attributes=(*current_name.attributes, each.argval))
        elif each.opname not in NO_EFFECT:
            if current_name is not None:
                loaded_names[current_name] = None
            free = each.opname == "LOAD_DEREF" and each.argval in code.co_freevars
            current_name = _LoadedName(free, each.argval, ()) if free or each.opname in LOADS_GLOBAL else None
    inner_names = [entry for c in code.co_consts if isinstance(c, CodeType) for entry in _loaded_names(c)]
    loaded_names.update((entry, None) for entry in inner_names if not entry.free or entry.name in code.co_freevars)
    return tuple(loaded_names)


class FunctionCopier:
    """Copy functions so that the copies call other helpers, for example helpers that check array indices.

    `wrap(copy, original)` returns the replacement of the helper `original`; `copy` is a copy of its Python function.
    The helpers that `copy` uses are replaced only after `wrap` has returned.
    """

    def __init__(self, wrap: Callable[[types.FunctionType, Any], Any]):
        self.wrap = wrap
        self.copies: dict[Any, Any] = {}  # replacements, by id of the original

    def replacement_of(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        """Replace a compiled helper, or helpers in a tuple or in a module's attributes `names`; return the result."""
        if self.is_copied(value):
            if id(value) not in self.copies:
                self._add_copy(value)
            return self.copies[id(value)]
        if type(value) is tuple:
            return tuple(self.replacement_of(each, names) for each in value)
        if isinstance(value, types.ModuleType) and not is_library(value.__name__):
            return self._copy_module(value, names)
        return value

    def is_copied(self, value: Any) -> bool:
        """Return whether `replacement_of` copies a value: a compiled helper or, in a derived class, any function."""
        return isinstance(value, Dispatcher) or bool(jitable_templates(value))

    def _copy_module(self, module: types.ModuleType, names: frozenset[str]) -> types.ModuleType:
        key = (id(module), names)
        if key not in self.copies:
            self.copies[key] = copy = types.ModuleType(module.__name__)
            vars(copy).update(vars(module))
            vars(copy).update(
                {name: self.replacement_of(vars(module)[name], names) for name in names & set(vars(module))}
            )
        return self.copies[key]  # type: ignore[no-any-return]

    def copy_of(self, function: Any) -> Any:
        """Copy a Python function, with replaced helpers, and return `wrap(copy, function)`."""
        self._add_copy(function)
        return self.copies[id(function)]

    def _add_copy(self, helper: Any) -> None:
        function = getattr(helper, "py_func", helper)
        used_names, names = names_of_code(function.__code__), frozenset(reachable_names(function))
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        own_globals = dict(function.__globals__)
        copy = types.FunctionType(function.__code__, own_globals, function.__name__, function.__defaults__, cells)
        copy.__kwdefaults__, copy.__qualname__ = function.__kwdefaults__, function.__qualname__
        self.copies[id(helper)] = self.wrap(copy, helper)  # stored first, as a helper that calls itself needs it
        for name in used_names & set(own_globals):
            own_globals[name] = self.replacement_of(own_globals[name], names)
        if function.__defaults__ is not None:
            copy.__defaults__ = self.replacement_of(function.__defaults__, names)
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.replacement_of(original.cell_contents, names)

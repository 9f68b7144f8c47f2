"""Find the values that machine code depends on, all that a function names, encloses and freezes; digest or copy them.

Numba freezes globals, free variables, defaults, attributes of modules, items of tuples and compiled helpers in the
functions that it compiles. `Digest` hashes these values, `frozen_places` lists where they are stored, and
`FunctionCopier` copies a function with other helpers.
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

# libraries whose functions are identified by name; versions of numba and numpy are compared as well
LIBRARIES = {*sys.stdlib_module_names, "numpy", "numba", "scipy"}

# number of code objects whose names are cached: each run creates new functions of the same code, and reading the
# instructions of helpers again would take most of the time of tracing
MAX_CODES = 2000
FORM = 2  # version of the digests: increase it if files of earlier versions may have wrong machine code


def digest_of(text: str, *sources: str | types.ModuleType) -> str:
    """Return a digest of a text and of the files of modules."""
    digest = hashlib.sha256(text.encode())
    for source in sources:
        digest.update(Path(source if isinstance(source, str) else str(source.__file__)).read_bytes())
    return digest.hexdigest()


_DIGEST_TEXTS: WeakKeyDictionary[Dispatcher, str] = WeakKeyDictionary()


def digest_as(callback: Dispatcher, what: str) -> None:
    """Register a text as the digest of a callback that calls Python: its code cannot be digested."""
    _DIGEST_TEXTS[callback] = what


def enclosed_by(function: Any) -> list[Any]:
    """Return the values of the closure of a function."""
    return [cell.cell_contents for cell in function.__closure__ or ()]


class NotDigestible(Exception):
    """Error for a value that may change unnoticed."""


class Digest:
    """Hash values of many types; follow functions to all values that they name."""

    def __init__(self) -> None:
        self.hash = hashlib.sha256(f"{FORM} {np.__version__}".encode())
        self.names: set[str] = set()  # attributes that the current code, or its helpers, may take from modules
        self.seen: dict[tuple[int, str], int] = {}  # values added so far, with their order
        self.helpers: list[Any] = []  # compiled helpers added so far, each after the helpers that it names

    def add(self, value: Any) -> None:
        """Add a value of any type to the hash; raise NotDigestible for one that may change unnoticed."""
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
        """Add the code of a function, its defaults, and the values of the globals that it names."""
        outer, self.names = self.names, names_reached(function)
        self.add([function.__code__, function.__defaults__, function.__kwdefaults__])
        if enclosed:
            self.add(enclosed_by(function))
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
        self.hash.update(module.__name__.encode())
        if not is_library(module.__name__):
            for name in sorted(self.names & set(vars(module))):
                if self._is_new(module, name):
                    self.add([name, vars(module)[name]])

    def _add_name(self, value: Any) -> None:
        """Add functions and types of libraries by their names; reject any other value."""
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
        key = (id(value), name)
        if key in self.seen:  # the value was added before: add its position
            self.hash.update(f"<again {self.seen[key]}>".encode())
            return False
        self.seen[key] = len(self.seen)
        return True


def names_in(code: types.CodeType) -> set[str]:
    """Return the names of globals and attributes in a code object and in the functions within it."""
    inner = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    return set(code.co_names).union(*map(names_in, inner))


def globals_of(function: Any) -> dict[str, Any]:
    """Return the globals that a function, or one within it, loads; attributes, as in `math.log`, are not included."""
    names = {each.name for each in _loads(function.__code__) if not each.free} & set(function.__globals__)
    return {name: function.__globals__[name] for name in sorted(names)}


def names_reached(function: Any, seen: set[int] | None = None) -> set[str]:
    """Return the names used in a function and in its compiled helpers, to which it may pass a module."""
    seen = set() if seen is None else seen
    seen.add(id(function))
    names = names_in(function.__code__)
    values = [*globals_of(function).values(), *enclosed_by(function)]
    modules = [value for value in values if isinstance(value, types.ModuleType) and not is_library(value.__name__)]
    values += [vars(module)[name] for module in modules for name in names & set(vars(module))]
    helpers = [value for value in values if isinstance(value, Dispatcher) or jitable_templates(value)]
    functions = [getattr(helper, "py_func", helper) for helper in helpers if helper not in _DIGEST_TEXTS]
    return names.union(*(names_reached(each, seen) for each in functions if id(each) not in seen))


def is_library(module: str) -> bool:
    """Return whether a module belongs to Python, or to a package that is identified by its version."""
    return module.partition(".")[0] in LIBRARIES


def is_twoloop(module: str) -> bool:
    """Return whether a module belongs to twoloop or is generated: its names are constant, its indices in bounds."""
    return f"{module}.".startswith(("twoloop.", "twoloop_equations_"))


LOADS_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME")  # LOAD_NAME occurs within a class
LOADS_ATTRIBUTE = ("LOAD_ATTR", "LOAD_METHOD")
FROZEN_VALUES = "__as_compiled__"  # attribute of a compiled callback with the values of its names at compilation
NO_EFFECT = ("EXTENDED_ARG", "CACHE", "NOP", "PUSH_NULL")  # instructions that do not change the loaded value


class Place(NamedTuple):
    """Describe where a function finds a value.

    Attributes
    ----------
    holder : cell, dict or None
        Container whose value may be replaced later; None: a default, or an item of a tuple, which cannot be replaced.
    key : str
        Key of the value in a dict.
    name : str
        Name in messages, such as "package.module.K" or "TABLES[0]".
    value : object
        Present value.
    """

    holder: CellType | dict[str, Any] | None
    key: str
    name: str
    value: Any


class _Loaded(NamedTuple):
    """Global or free variable that a code object loads, and the chain of attributes taken from it."""

    free: bool
    name: str
    attributes: tuple[str, ...]


def frozen_values(compiled: Any, function: Any = None) -> list[tuple[Place, bytes | None]]:
    """Return the `frozen_places` of a function at the first call, each with the bytes of its value if it is an array.

    `function` is the one that was compiled, or the original of its copy.
    """
    found: list[tuple[Place, bytes | None]] | None = getattr(compiled, FROZEN_VALUES, None)
    if found is None:
        found = [(each, _content(each.value)) for each in frozen_places(function or compiled.py_func)]
        setattr(compiled, FROZEN_VALUES, found)
    return found


def _content(value: Any) -> bytes | None:
    return value.tobytes() if isinstance(value, (np.ndarray, np.void)) else None


def frozen_places(function: Any, seen: set[int] | None = None) -> Iterator[Place]:
    """List where a function and its helpers find values that numba freezes: numbers, arrays, text, functions, modules.

    Names in modules of twoloop are constant; in these modules, only helpers are followed.
    """
    seen = set() if seen is None else seen
    if id(function) in seen:
        return
    seen.add(id(function))
    ours = is_twoloop(function.__globals__.get("__name__", ""))
    for found in _direct_places(function):
        for place in _with_items(found, seen):
            if not ours and _is_frozen(place.value):
                yield place
            helper = python_function(place.value)
            if helper is not None:
                yield from frozen_places(helper, seen)


def python_function(value: Any) -> FunctionType | None:
    """Return the function of a compiled helper (`njit`, `register_jitable`, `vectorize` or `cfunc`); else None."""
    if isinstance(value, Dispatcher):
        return value.py_func  # type: ignore[no-any-return]
    if isinstance(value, FunctionType):
        return value if jitable_templates(value) else None
    if type(value).__module__.startswith("numba."):
        inner = getattr(value, "__wrapped__", None)
        return inner if isinstance(inner, FunctionType) else None
    return None


def _is_frozen(value: Any) -> bool:
    if isinstance(value, ModuleType):
        return not is_library(value.__name__)
    if isinstance(value, (np.ndarray, np.void)):
        return not value.dtype.hasobject
    kinds = (type(None), bool, int, float, complex, str, bytes, tuple, np.generic)
    return isinstance(value, kinds) or callable(value)


def _with_items(place: Place, seen: set[int]) -> Iterator[Place]:
    """Yield a place, and those of its items if it holds a tuple."""
    yield place
    if not isinstance(place.value, tuple) or id(place.value) in seen:
        return
    seen.add(id(place.value))
    fields = getattr(place.value, "_fields", None)
    for k, value in enumerate(place.value):
        if isinstance(value, (tuple, np.ndarray, np.void)) or callable(value):  # numbers in a tuple do not change
            name = f"{place.name}[{k}]" if fields is None else f"{place.name}.{fields[k]}"
            yield from _with_items(Place(None, "", name, value), seen)


def _direct_places(function: FunctionType) -> Iterator[Place]:
    """Yield defaults, and the globals and free variables that are loaded, with the attributes taken from modules."""
    code, space = function.__code__, function.__globals__
    last = code.co_varnames[: code.co_argcount][::-1]
    for name, value in zip(last, (function.__defaults__ or ())[::-1], strict=False):
        yield Place(None, "", name, value)
    cells: dict[str, CellType] = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
    for free, name, attributes in _loads(code):
        if not free and name not in space:  # a built-in name
            continue
        holder, value = (cells[name], cells[name].cell_contents) if free else (space, space[name])
        place = Place(holder, name, name, value)
        yield place
        if isinstance(value, ModuleType) and not is_library(value.__name__):
            yield from _places_of_module(place, attributes, names_reached(function))


def _places_of_module(place: Place, attributes: tuple[str, ...], names: set[str]) -> Iterator[Place]:
    """Yield the attributes that are taken from a module of the user, and from modules within it.

    If the module itself is passed on, as to a local variable or a helper, all attributes with `names` are yielded.
    """
    if not isinstance(place.value, ModuleType) or is_library(place.value.__name__):
        return
    space = vars(place.value)
    for attribute in attributes[:1] or sorted(names & set(space)):
        if attribute in space:
            inner = Place(space, attribute, f"{place.name}.{attribute}", space[attribute])
            yield inner
            yield from _places_of_module(inner, attributes[1:], names - {attribute})


@lru_cache(MAX_CODES)
def _loads(code: CodeType) -> tuple[_Loaded, ...]:
    """Return the globals and free variables that a code object and the functions within it load."""
    found: dict[_Loaded, None] = {}
    loaded = None
    for each in dis.get_instructions(code):
        if loaded is not None and each.opname in LOADS_ATTRIBUTE:
            loaded = loaded._replace(attributes=(*loaded.attributes, each.argval))
        elif each.opname not in NO_EFFECT:
            if loaded is not None:
                found[loaded] = None
            free = each.opname == "LOAD_DEREF" and each.argval in code.co_freevars
            loaded = _Loaded(free, each.argval, ()) if free or each.opname in LOADS_GLOBAL else None
    inner = [one for constant in code.co_consts if isinstance(constant, CodeType) for one in _loads(constant)]
    found.update((one, None) for one in inner if not one.free or one.name in code.co_freevars)
    return tuple(found)


class FunctionCopier:
    """Copy functions with replacements for the compiled helpers that they name or enclose."""

    # wrap(copy, original) -> replacement of the original
    def __init__(self, wrap: Callable[[types.FunctionType, Any], Any]):
        self.wrap = wrap
        self.known: dict[Any, Any] = {}

    def value(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        """Return the replacement of a value; `names` are the attributes that may be taken from a module."""
        if self.is_copied(value):
            if id(value) not in self.known:
                self._rewrite(value)
            return self.known[id(value)]
        if type(value) is tuple:
            return tuple(self.value(each, names) for each in value)
        if isinstance(value, types.ModuleType) and not is_library(value.__name__):
            return self._module(value, names)
        return value

    def is_copied(self, value: Any) -> bool:
        """Return whether a value is a compiled helper, which has to be copied."""
        return isinstance(value, Dispatcher) or bool(jitable_templates(value))

    def _module(self, module: types.ModuleType, names: frozenset[str]) -> types.ModuleType:
        """Copy a module with replacements for the functions of these names."""
        key = (id(module), names)
        if key not in self.known:
            self.known[key] = copy = types.ModuleType(module.__name__)
            vars(copy).update(vars(module))
            vars(copy).update({name: self.value(vars(module)[name], names) for name in names & set(vars(module))})
        return self.known[key]  # type: ignore[no-any-return]

    def copy_of(self, function: Any) -> Any:
        """Copy a function that is not a compiled helper itself."""
        self._rewrite(function)
        return self.known[id(function)]

    def _rewrite(self, helper: Any) -> None:
        function = getattr(helper, "py_func", helper)
        own, names = names_in(function.__code__), frozenset(names_reached(function))
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        own_globals = dict(function.__globals__)
        copy = types.FunctionType(function.__code__, own_globals, function.__name__, function.__defaults__, cells)
        copy.__kwdefaults__, copy.__qualname__ = function.__kwdefaults__, function.__qualname__
        self.known[id(helper)] = self.wrap(copy, helper)  # set first, because the values that it names may include it
        for name in own & set(own_globals):
            own_globals[name] = self.value(own_globals[name], names)
        if function.__defaults__ is not None:
            copy.__defaults__ = self.value(function.__defaults__, names)
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.value(original.cell_contents, names)

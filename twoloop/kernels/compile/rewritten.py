"""Copies of functions in which other ones stand in the place of the helpers that they name or enclose."""

import types
from collections.abc import Callable
from typing import Any

from twoloop.kernels.compile.dependencies import names_in, names_reached, of_library
from twoloop.kernels.compile.private import Dispatcher, registered


class Rewritten:
    """Copies of functions with other ones in the place of the compiled helpers that they name or enclose."""

    # wrap(copy, original) -> what stands in the place of the original
    def __init__(self, wrap: Callable[[types.FunctionType, Any], Any]):
        self.wrap = wrap
        self.known: dict[Any, Any] = {}

    def value(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        """What stands in the place of a value; `names` are those that may be taken of a module."""
        if self.copies(value):
            if id(value) not in self.known:
                self._rewrite(value)
            return self.known[id(value)]
        if type(value) is tuple:
            return tuple(self.value(each, names) for each in value)
        if isinstance(value, types.ModuleType) and not of_library(value.__name__):
            return self._module(value, names)
        return value

    def copies(self, value: Any) -> bool:
        """Whether a value is a function that is copied."""
        return isinstance(value, Dispatcher) or bool(registered(value))

    def _module(self, module: types.ModuleType, names: frozenset[str]) -> types.ModuleType:
        """A copy of a module with other functions in the place of those of these names."""
        key = (id(module), names)
        if key not in self.known:
            self.known[key] = copy = types.ModuleType(module.__name__)
            vars(copy).update(vars(module))
            vars(copy).update({name: self.value(vars(module)[name], names) for name in names & set(vars(module))})
        return self.known[key]  # type: ignore[no-any-return]

    def copy_of(self, function: Any) -> Any:
        """What stands in the place of a function that is not one of those by itself."""
        self._rewrite(function)
        return self.known[id(function)]

    def _rewrite(self, helper: Any) -> None:
        function = getattr(helper, "py_func", helper)
        own, names = names_in(function.__code__), frozenset(names_reached(function))
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        own_globals = dict(function.__globals__)
        copy = types.FunctionType(function.__code__, own_globals, function.__name__, function.__defaults__, cells)
        copy.__kwdefaults__, copy.__qualname__ = function.__kwdefaults__, function.__qualname__
        self.known[id(helper)] = self.wrap(copy, helper)  # before what it names, which may be itself
        for name in own & set(own_globals):
            own_globals[name] = self.value(own_globals[name], names)
        if function.__defaults__ is not None:
            copy.__defaults__ = self.value(function.__defaults__, names)
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.value(original.cell_contents, names)

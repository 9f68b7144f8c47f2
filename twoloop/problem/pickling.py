"""Systems in other processes: their functions travel by name, and never as a number that means another's there."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from twoloop.checks.arguments import Array
from twoloop.kernels.compile.private import Dispatcher
from twoloop.problem.adapters import ConstantMatrix
from twoloop.problem.description import Description
from twoloop.problem.generated import GeneratedCode, code_of

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


class Packed:
    """What pickle replaces by what `find` finds in the other process."""

    def __init__(self, find: Callable[..., Any], *arguments: Any):
        self.found = find, arguments

    def __reduce__(self) -> tuple[Any, ...]:
        return self.found


def by_name(module: str, name: str) -> Any:
    """A compiled callback at the top level of a module; AttributeError or ImportError if it is not there."""
    return attrgetter(name)(importlib.import_module(module))


def packed(system_name: str, kind: str, function: Any) -> Any:
    """What to pickle in the place of a function.

    Raises
    ------
    TypeError
        If it is a plain function that pickle cannot find by its name.
    """
    if isinstance(function, Dispatcher):
        if (code := code_of(function)) is not None:
            return Packed(GeneratedCode.callback, code, kind)
        name = function.py_func.__module__, function.py_func.__qualname__
        try:
            return Packed(by_name, *name) if by_name(*name) is function else function
        except (AttributeError, ImportError):  # made within a function: numba sends its source along
            return function
    try:
        pickle.dumps(function)
    except Exception as error:
        named = getattr(function, "__qualname__", repr(function))
        raise TypeError(
            f"{kind} of {system_name!r}, {named}, cannot be pickled, and so neither can the system: another process "
            "finds a function by its name in a module, which a lambda, or a function within a function, does not have. "
            f"Write {kind} at the top level of a module (what it encloses may become attributes of an object with "
            f"__call__), or make the system in that process. Pickle says: {error}"
        ) from None
    return function


def reduced(system: ConstrainedSystem) -> tuple[Any, ...]:
    """What `made_again` needs to make a system in another process, beside its class."""
    plain = system._returning or system.python_functions
    options: dict[str, Any] = {"n_q": system.n_q, "n_c": system.n_c, "n_a": system.n_a}
    options |= {"bandwidth": system.bandwidth, "joints": system.joints, "name": system.name}
    options |= {f"{kind}_entries": entries for kind, entries in system.entries.items()}
    if plain:
        options["compile"] = not system.called_in_python
        options["parameters"] = system.parameters if system._taking else None
    else:
        options |= {"constant_mass": system.constant_mass, "parameters": system.parameters}
    own = {kind: function for kind, function in (plain or system.given).items() if kind not in system.scattered}
    functions = {kind: packed(system.name, kind, function) for kind, function in own.items()}
    known = system.description
    if known.energy is not None:
        packed(system.name, "energy", known.energy)
    if known.drawing is not None:
        packed(system.name, "points of the drawing", known.drawing.points)
    return bool(plain), options, functions, system.functions.flags, known


def made_again(
    cls: type[ConstrainedSystem],
    plain: bool,
    options: dict[str, Any],
    functions: dict[str, Any],
    flags: Array,
    known: Description,
) -> ConstrainedSystem:
    """The system that was pickled, of the functions that this process finds by the same names."""
    for kind in ("mass", "mass_values") if plain else ():
        if isinstance(functions.get(kind), ConstantMatrix):
            functions[kind] = functions[kind].matrix
    system = (cls.from_python if plain else cls)(**options, **functions)
    system.functions.flags[:] = flags
    system.description = known
    return system

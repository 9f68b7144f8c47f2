"""Callbacks run in Python on symbols: `math` and `numpy` take these, or say that they do not.

What a callback makes of symbols must be what it makes of numbers. So a function that is not known to do the same with
both is refused by name when it is given symbols, and what a callback catches of this counts all the same. What is left,
such as a global that is not what it was, `traced_values.py` finds by comparing numbers.
"""

import functools
import math
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from twoloop.checks.bounds import place_of
from twoloop.generate.known_numbers import OPERATORS, Known, Refusal, Untraceable, applied, elementwise, number
from twoloop.generate.tracing import FUNCTIONS, Form, Graph
from twoloop.kernels.compile.dependencies import Rewritten, of_library
from twoloop.kernels.compile.private import Dispatcher

# functions of NumPy that do with arrays of forms what they do with numbers
AS_WITH_NUMBERS = {
    *("add", "append", "atleast_1d", "atleast_2d", "block", "column_stack", "concatenate", "copy", "cross", "diag"),
    *("diagonal", "divide", "dot", "einsum", "expand_dims", "flip", "hstack", "inner", "kron", "matmul", "mean"),
    *("multiply", "ndim", "negative", "outer", "positive", "prod", "ravel", "repeat", "reshape", "roll", "shape"),
    *("size", "square", "squeeze", "stack", "subtract", "sum", "tile", "trace", "transpose", "true_divide", "vdot"),
    *("vstack", "zeros_like", "ones_like", "empty_like", "full_like"),
}
CONSTRUCTORS = ("zeros", "ones", "empty")
CONVERSIONS = ("array", "asarray", "ascontiguousarray")


def trace(function: Callable[..., Any], t: Form, *arguments: Any) -> Any:
    """Run a callback in Python on symbols: what it returns, None of a compiled one.

    Raises
    ------
    Untraceable
        If it does not run on them, or does with them what it would not do with numbers.
    """
    graph, value = t.graph, None
    with graph.watched():
        try:
            value = _Traced(lambda copy, _: copy).callback(function)(t, *arguments)
        except (Refusal, Untraceable) as refusal:
            raise Untraceable(f"{graph.refused or refusal}{place_of(refusal)}") from None
        except Exception as error:  # what a callback makes of symbols is its own
            if not graph.refused:
                said = str(error).partition("\n")[0].replace("twoloop.generate.tracing.", "").replace("Form", "symbol")
                said = f"it does not run on symbols in the place of t, q and v: {type(error).__name__}: {said}"
                raise Untraceable(f"{said}{place_of(error)}") from error
    return value


def as_forms(graph: Graph, made: Any) -> Any:
    """What a callback filled or returned, as an array of forms."""
    for place in np.ndindex(made.shape):
        entry = made[place]
        if type(entry) is not Form:
            try:
                made[place] = Form(graph, number(entry), {})
            except Exception as error:
                raise Untraceable(f"on symbols its entry {place} is {entry!r}, which is not a number") from error
        elif entry.graph is not graph:
            raise Untraceable("it returns t, q or v of another call, which it has kept")
    return made


class _Traced(Rewritten):
    """Copies of callbacks with the mathematics of forms in the place of `math` and `numpy`."""

    def copies(self, value: Any) -> bool:
        return isinstance(value, Dispatcher | types.FunctionType)

    def callback(self, function: Any) -> Any:
        """A callback that may be an object with a method to call it."""
        own = next((vars(each)["__call__"] for each in type(function).__mro__ if "__call__" in vars(each)), None)
        if isinstance(own, types.FunctionType) and not isinstance(function, Dispatcher):
            return types.MethodType(self.value(own), function)
        return self.value(function)

    def value(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        if isinstance(value, types.MethodType):
            return types.MethodType(self.value(value.__func__), value.__self__)
        if isinstance(value, functools.partial):
            return functools.partial(self.value(value.func), *value.args, **value.keywords)
        if isinstance(value, types.ModuleType) and value in (math, np):
            return _Mathematics(value)
        name = getattr(value, "__name__", "")
        if not isinstance(value, type) and callable(value):
            for module in (math, np):
                if name and getattr(module, name, None) is value:
                    return getattr(_Mathematics(module), name)
            if of_library(getattr(value, "__module__", None) or ""):
                return value
        return super().value(value, names)

    def _rewrite(self, helper: Any) -> None:
        super()._rewrite(helper)
        self.known[id(helper)].__globals__.setdefault("type", _type)


def _type(value: Any, *more: Any) -> Any:
    _refuse(value, "asks for the type of")
    return type(value, *more)


def _symbol_in(value: Any) -> Form | None:
    """A form in a number, an array, or a list of these."""
    if type(value) is Form:
        return value
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist() if value.dtype == object else ()
    if isinstance(value, list | tuple):
        return next((found for found in map(_symbol_in, value) if found is not None), None)
    return None


def _remembers(value: Any) -> bool:
    """Whether a number, an array or a list of these holds a number that knows its parameters."""
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist() if value.dtype == object else ()
    return any(map(_remembers, value)) if isinstance(value, list | tuple) else type(value) is Known


def _refuse(value: Any, does: str) -> None:
    symbol = _symbol_in(value)
    if symbol is not None:
        symbol.graph.refuse(f"it {does} what depends on t, q or v")


def _of_numbers(known: Any, name: str) -> Callable[..., Any]:
    """A function that is not known to take forms."""

    @functools.wraps(known)
    def function(*arguments: Any, **options: Any) -> Any:
        _refuse([*arguments, *options.values()], f"calls {name} on")
        return known(*arguments, **options)

    return function


def _either(known: Any, own: Callable[..., Any]) -> Callable[..., Any]:
    """A function of numbers, and of forms."""

    def function(*arguments: Any) -> Any:
        if _symbol_in(arguments) is None:
            remembers = any(type(x) is Known for x in arguments)
            return applied(known.__name__, *arguments) if remembers else known(*arguments)
        if any(isinstance(x, np.ndarray) for x in arguments if type(x) is not Form):
            return elementwise(function, arguments)
        return own(*arguments)

    return function


def _is_real(dtype: Any) -> bool:
    return dtype is None or np.dtype(dtype) == np.float64


def _constructor(known: Any) -> Callable[..., Any]:
    """`zeros` and its kin, which hold forms where they would hold real numbers."""

    def function(shape: Any, dtype: Any = None, **options: Any) -> Any:
        if not _is_real(dtype):
            return known(shape, dtype, **options)
        return np.full(shape, 1.0 if known is np.ones else 0.0, dtype=object)

    return function


def _conversion(known: Any) -> Callable[..., Any]:
    """`array` and its kin."""

    def function(value: Any, dtype: Any = None, **options: Any) -> Any:
        if _symbol_in(value) is None and not _remembers(value):
            return known(value, dtype, **options)
        if not _is_real(dtype):
            _refuse(value, f"makes {np.dtype(dtype).name} of")
        return known(value, object, **options)

    return function


def _full(shape: Any, value: Any, dtype: Any = None) -> Any:
    if (
        _symbol_in(value) is None
        and not _remembers(value)
        and not (_is_real(dtype) and np.asarray(value).dtype == np.float64)
    ):
        return np.full(shape, value, dtype)
    if not _is_real(dtype):
        _refuse(value, f"makes {np.dtype(dtype).name} of")
    return np.full(shape, value, object)


def _norm(x: Any, *more: Any, **options: Any) -> Any:
    if _symbol_in(x) is None:
        return np.linalg.norm(x, *more, **options)
    if more or options or np.ndim(x) != 1:
        _refuse(x, "calls numpy.linalg.norm, but of a vector, on")
    x = np.asarray(x, dtype=object)
    return (x @ x) ** 0.5


class _Mathematics:
    """`math`, `numpy` or a part of it, with functions that take forms too, and arrays that hold them."""

    def __init__(self, module: types.ModuleType):
        self._module = module

    def __getattr__(self, name: str) -> Any:
        known = getattr(self._module, name)
        if isinstance(known, types.ModuleType):
            return _Mathematics(known)
        if isinstance(known, type) or not callable(known):
            return known
        if name in FUNCTIONS or name == "hypot":
            return _either(known, FUNCTIONS.get(name) or OPERATORS[name])
        if name in ("pow", "power"):
            return lambda x, y: x**y
        if self._module is np and name in CONSTRUCTORS:
            return _constructor(known)
        if self._module is np and name in CONVERSIONS:
            return _conversion(known)
        if known is np.full:
            return _full
        if known is np.linalg.norm:
            return _norm
        if self._module is np and name in AS_WITH_NUMBERS:
            return known
        return _of_numbers(known, f"{self._module.__name__}.{name}")

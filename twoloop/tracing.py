"""The equations of compiled callbacks, as a graph of operations: the callbacks run once in Python on symbols.

A value is an affine form, c + sum_i c_i x_i, of quantities x_i: the time, coordinates, velocities, and the results of
products and functions of such forms. What is computed twice is one quantity.
"""

import math
import types
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher

from twoloop.bounds import Rewritten

# kinds of operation; the second form of LOGARITHM and ARCTANGENT is what the derivative of the first is divided by
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING, SUM = range(10)


class Untraceable(ValueError):
    """Raised for a callback that does not run on symbols; the text says why."""


class Graph:
    """Quantities, numbered from 0; `operations[i]` is None for an input, else (kind, first form, second form).

    `sizes`: how many inputs were made at a time.
    """

    def __init__(self) -> None:
        self.sizes: list[int] = []
        self.operations: list[tuple[int, Form, Form | None] | None] = []
        self.late: list[bool] = []  # whether a quantity depends on more than time and coordinates
        self._known: dict[Any, int] = {}

    def inputs(self, n: int, late: bool) -> list["Form"]:
        """New quantities that are given, as forms."""
        first = len(self.operations)
        self.sizes.append(n)
        self.operations += [None] * n
        self.late += [late] * n
        return [Form(self, 0.0, {first + i: 1.0}) for i in range(n)]

    def operation(self, kind: int, first: "Form", second: "Form | None" = None) -> "Form":
        """The result of an operation, the one known before if there is one."""
        key = (kind, first.key, None if second is None else second.key)
        if key not in self._known:
            self._known[key] = len(self.operations)
            self.operations.append((kind, first, second))
            self.late.append(first.late or (second is not None and second.late))
        return Form(self, 0.0, {self._known[key]: 1.0})

    def product(self, one: "Form", other: "Form") -> "Form":
        """One form times another, factors taken out so that multiples of a product are one quantity."""
        for a, b in ((one, other), (other, one)):
            if not a.terms:
                return b.times(a.constant)
        (scale, one), (scale_too, other) = one.normalised(), other.normalised()
        if other.key < one.key:
            one, other = other, one
        return self.operation(PRODUCT, one, other).times(scale * scale_too)


class Form:
    """An affine form; does what a number does, but has no size to be compared."""

    __slots__ = ("constant", "graph", "terms")
    __array_ufunc__ = None  # numpy's numbers leave arithmetic to it

    def __init__(self, graph: Graph, constant: float, terms: dict[int, float]):
        self.graph, self.constant, self.terms = graph, constant, terms

    @property
    def key(self) -> tuple[Any, ...]:
        """What equal forms have in common."""
        return (self.constant, *sorted(self.terms.items()))

    @property
    def late(self) -> bool:
        """Whether it depends on more than time and coordinates."""
        return any(self.graph.late[i] for i in self.terms)

    def times(self, factor: float) -> "Form":
        """A multiple."""
        if factor == 0.0:
            return Form(self.graph, 0.0, {})
        return Form(self.graph, self.constant * factor, {i: c * factor for i, c in self.terms.items()})

    def normalised(self) -> tuple[float, "Form"]:
        """A factor, and the form over it, whose first coefficient is 1."""
        factor = self.terms[min(self.terms)]
        return factor, self.times(1.0 / factor)

    def _other(self, other: Any) -> "Form":
        if isinstance(other, Form):
            return other
        return Form(self.graph, float(other), {})

    def __add__(self, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return _each(other, lambda x: x + self)
        other = self._other(other)
        terms = dict(self.terms)
        for i, c in other.terms.items():
            total = terms.get(i, 0.0) + c
            if total == 0.0:
                del terms[i]
            else:
                terms[i] = total
        return Form(self.graph, self.constant + other.constant, terms)

    __radd__ = __add__

    def __neg__(self) -> "Form":
        return self.times(-1.0)

    def __pos__(self) -> "Form":
        return self

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return -self + other

    def __mul__(self, other: Any) -> Any:
        if isinstance(other, np.ndarray):
            return _each(other, lambda x: x * self)
        return self.graph.product(self, self._other(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        if isinstance(other, Form):
            return self * other.reciprocal()
        return self * (1.0 / other)

    def __rtruediv__(self, other: Any) -> Any:
        return self.reciprocal() * other

    def __pow__(self, exponent: Any) -> "Form":
        exponent = float(exponent)
        if exponent != math.floor(exponent):
            if 2.0 * exponent == math.floor(2.0 * exponent):
                return self ** math.floor(exponent) * self.square_root()
            return (self.logarithm() * exponent).exponential()
        n = abs(int(exponent))
        result, square = Form(self.graph, 1.0, {}), self
        while n:
            if n % 2:
                result = result * square
            n //= 2
            square = square * square if n else square
        return result.reciprocal() if exponent < 0.0 else result

    def _function(self, kind: int, known: Callable[[float], float]) -> "Form":
        if not self.terms:
            return Form(self.graph, known(self.constant), {})
        return self.graph.operation(kind, self)

    def reciprocal(self) -> "Form":
        """1 / x."""
        if not self.terms:
            return Form(self.graph, 1.0 / self.constant, {})
        scale, form = self.normalised()
        return self.graph.operation(RECIPROCAL, form).times(1.0 / scale)

    def square_root(self) -> "Form":
        """The square root."""
        return self._function(SQUARE_ROOT, math.sqrt)

    def exponential(self) -> "Form":
        """exp x."""
        return self._function(EXPONENTIAL, math.exp)

    def sine(self) -> "Form":
        """sin x; sine and cosine are made together, as each needs the other."""
        self._function(COSINE, math.cos)
        return self._function(SINE, math.sin)

    def cosine(self) -> "Form":
        """cos x."""
        self._function(SINE, math.sin)
        return self._function(COSINE, math.cos)

    def value(self) -> "Form":
        """The same as a multiple of one quantity, or as a number."""
        if len(self.terms) + (self.constant != 0.0) < 2:
            return self
        scale, form = self.normalised()
        return self.graph.operation(SUM, form).times(scale)

    def logarithm(self) -> "Form":
        """log x, whose derivative is x' / x."""
        if not self.terms:
            return Form(self.graph, math.log(self.constant), {})
        return self.graph.operation(LOGARITHM, self, self)

    def arctangent(self) -> "Form":
        """atan x, whose derivative is x' / (1 + x^2)."""
        if not self.terms:
            return Form(self.graph, math.atan(self.constant), {})
        return self.graph.operation(ARCTANGENT, self, self * self + 1.0)

    def _branches(self, *_: Any) -> Any:
        raise Untraceable("it branches on, or converts to a number, what depends on t, q or v")

    __bool__ = __lt__ = __le__ = __gt__ = __ge__ = __float__ = __int__ = __abs__ = __index__ = _branches
    __floordiv__ = __mod__ = __rfloordiv__ = __rmod__ = __rpow__ = __round__ = _branches
    __hash__ = None  # type: ignore[assignment]

    def __eq__(self, other: object) -> Any:
        return self._branches()


def _each(array: Any, function: Callable[[Any], Any]) -> Any:
    made = np.empty(array.shape, dtype=object)
    for place in np.ndindex(array.shape):
        made[place] = function(array[place])
    return made


def symbols(forms: Iterable[Form]) -> Any:
    """Forms as an array that callbacks take."""
    forms = list(forms)
    made = np.empty(len(forms), dtype=object)
    made[:] = forms
    return made


def trace(function: Callable[..., Any], *arguments: Any) -> Any:
    """Run a callback in Python on symbols: what it returns, None of a compiled one.

    Raises
    ------
    Untraceable
        If it does not run on them.
    """
    try:
        return _Traced(lambda python_function: python_function).value(function)(*arguments)
    except Untraceable:
        raise
    except Exception as error:  # what a callback makes of symbols is its own
        raise Untraceable(f"it does not run on symbols: {type(error).__name__}: {error}") from error


class _Traced(Rewritten):
    """Copies of callbacks with the mathematics of forms in the place of `math` and `numpy`."""

    functions = (Dispatcher, types.FunctionType)

    def value(self, value: Any, names: frozenset[str] = frozenset()) -> Any:
        if isinstance(value, types.ModuleType) and value in (math, np):
            return _Mathematics(value)
        if isinstance(value, types.BuiltinFunctionType | np.ufunc) and value.__name__ in _FUNCTIONS:
            return _either(value)
        return super().value(value, names)


_FUNCTIONS: dict[str, Callable[[Form], Any]] = {
    "sin": Form.sine,
    "cos": Form.cosine,
    "tan": lambda x: x.sine() / x.cosine(),
    "sqrt": Form.square_root,
    "exp": Form.exponential,
    "log": Form.logarithm,
    "atan": Form.arctangent,
    "arctan": Form.arctangent,
    "sinh": lambda x: (x.exponential() - (-x).exponential()) * 0.5,
    "cosh": lambda x: (x.exponential() + (-x).exponential()) * 0.5,
    "tanh": lambda x: 1.0 - 2.0 / ((2.0 * x).exponential() + 1.0),
}


def _either(known: Any) -> Callable[..., Any]:
    """A function of numbers, and of forms."""
    own = _FUNCTIONS[known.__name__]

    def function(x: Any) -> Any:
        if isinstance(x, np.ndarray) and x.dtype == object:
            return _each(x, function)
        return own(x) if isinstance(x, Form) else known(x)

    return function


class _Mathematics:
    """`math` or `numpy`, with functions that take forms too, and arrays that hold them."""

    def __init__(self, module: types.ModuleType):
        self._module = module

    def __getattr__(self, name: str) -> Any:
        if name in _FUNCTIONS:
            return _either(getattr(self._module, name))
        if name == "hypot":
            return lambda x, y: (x * x + y * y) ** 0.5
        if name == "pow":
            return lambda x, y: x**y
        if name in ("zeros", "empty"):
            return lambda shape, *_, **__: np.full(shape, 0.0, dtype=object)
        return getattr(self._module, name)

"""Expressions: a graph of the operations of compiled callbacks, and derivatives as further operations of it.

A value is an affine expression c + sum_i c_i x_i of quantities x_i: the time, coordinates, velocities, and the results
of products and functions of such expressions. An operation that occurs twice is recorded once.
"""

import math
from collections.abc import Callable, Container, Iterable
from typing import Any

import numpy as np

from twoloop.generate.parameter_expressions import (
    CANCELLED,
    OPERATORS,
    Parameter,
    Symbolic,
    elementwise,
    function_of_number,
    number,
)
from twoloop.generate.parameter_expressions import (
    Untraceable as Untraceable,
)
from twoloop.kernels.evaluation import operations as op

# the second form of a logarithm or an arctangent is what the derivative of the first is divided by
MOST_OPERATIONS = 20_000  # of a program; with more it would take longer to make than a run
LEAST_FACTOR = 1e-100  # that is taken out of a product: factors of high powers would underflow, or overflow ...
HIGH_POWER = 8  # ... so from above this none are taken out, whatever values parameters have
BRANCHES = "it branches on, or converts to a number, what depends on t, q or v"

# of numbers
SIN, COS, EXP, LOG, ATAN, ROOT = map(function_of_number, ("sin", "cos", "exp", "log", "atan", "sqrt"))

_equal = float.__eq__  # of numbers, whether or not they know their parameters
_size = float.__abs__  # a plain number, also of one that knows its parameters

CONVERTS = "it converts what depends on t, q or v to a number, as functions of math do within methods (numpy's do not)"


class Graph(Symbolic):
    """Quantities, numbered from 0; `operations[i]` is None for an input, else (kind, first form, second form).

    `sizes`: how many inputs were made at a time; `traced`: what callbacks gave on symbols, arrays of forms by kind.
    """

    def __init__(self) -> None:
        self.sizes: list[int] = []
        self.operations: list[tuple[int, Affine, Affine | None] | None] = []
        self.late: list[bool] = []  # whether a quantity depends on more than time and coordinates
        self.inputs_of: list[int] = []  # the inputs that a quantity depends on, a bit each
        self.traced: dict[str, Any] = {}
        self._known: dict[tuple[int, int, int], int] = {}
        self._seen: dict[int, int] = {}  # factors, in the order in which they came: values have no part in it
        self._numbers: dict[Any, int] = {}  # of forms, by their keys, which take long to compare
        self._quantities: dict[int, Affine] = {}

    def copy(self) -> "Graph":
        """A graph of the same quantities, which may be continued otherwise; what callbacks gave is not in it."""
        other = Graph()
        other.sizes, other.late, other.inputs_of = self.sizes.copy(), self.late.copy(), self.inputs_of.copy()
        other._known, other._seen, other._numbers = self._known.copy(), self._seen.copy(), self._numbers.copy()
        other.operations = [
            None if each is None else (each[0], each[1].on(other), None if each[2] is None else each[2].on(other))
            for each in self.operations
        ]
        return other

    def inputs(self, n: int, late: bool) -> list["Affine"]:
        """New quantities that are given, as forms."""
        first = len(self.operations)
        self.sizes.append(n)
        self.operations += [None] * n
        self.late += [late] * n
        self.inputs_of += [1 << first + i for i in range(n)]
        return [self.quantity(first + i) for i in range(n)]

    def quantity(self, i: int) -> "Affine":
        """A quantity as a form."""
        known = self._quantities.get(i)
        if known is None:
            self._quantities[i] = known = Affine(self, 0.0, {i: 1.0})
        return known

    def number(self, form: "Affine") -> int:
        """The same of equal forms, rounding of their coefficients apart."""
        if form.kept_number is None:
            form.kept_number = self._numbers.setdefault(form.key, len(self._numbers))
        return form.kept_number

    def operation(self, kind: int, first: "Affine", second: "Affine | None" = None) -> "Affine":
        """The result of an operation, the one known before if there is one."""
        key = kind, self.number(first), -1 if second is None else self.number(second)
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = len(self.operations)
            self.operations.append((kind, first, second))
            self.late.append(first.late or (second is not None and second.late))
            bits = 0
            for i in (*first.terms, *(() if second is None else second.terms)):
                bits |= self.inputs_of[i]
            self.inputs_of.append(bits)
        return self.quantity(known)

    def needed_by(self, forms: Iterable["Affine"], known: Container[int] = ()) -> list[int]:
        """What forms are made of, inputs and what is known apart, in an order in which it can be computed."""
        found: set[int] = set()
        ahead = [i for form in forms for i in form.terms]
        while ahead:
            i = ahead.pop()
            operation = self.operations[i]
            if i not in found and operation is not None and i not in known:
                found.add(i)
                ahead += [j for form in operation[1:] if isinstance(form, Affine) for j in form.terms]
        return sorted(found)

    def arguments(self, i: int) -> list["Affine"]:
        """What a quantity is computed from; nothing of an input."""
        return [form for form in (self.operations[i] or ())[1:] if isinstance(form, Affine)]

    def in_order_of_use(self, forms: Iterable["Affine"], known: Container[int] = ()) -> list[int]:
        """The same, each as late as it can be: just before what is made of it first."""
        order: list[int] = []
        found: set[int] = set()
        ahead = [i for form in forms for i in form.terms][::-1]
        while ahead:
            i = ahead.pop()
            operation = None if i < 0 else self.operations[i]
            if i < 0:  # all that it is made of is in the list
                order.append(~i)
            elif i not in found and operation is not None and i not in known:
                found.add(i)
                ahead.append(~i)
                ahead += [j for form in operation[1:] if isinstance(form, Affine) for j in form.terms][::-1]
        return order

    def product(self, one: "Affine", other: "Affine") -> "Affine":
        """One form times another, factors taken out so that multiples of a product are one quantity."""
        if not one.terms:
            return other.times(one.constant)
        if not other.terms:
            return one.times(other.constant)
        (scale, first), (scale_too, second) = one.normalised(), other.normalised()
        factor = scale * scale_too
        if not LEAST_FACTOR < _size(factor) < 1.0 / LEAST_FACTOR:
            first, second, factor = one, other, 1.0
        return self._product(first, second).times(factor)

    def _product(self, one: "Affine", other: "Affine") -> "Affine":
        seen = self._seen
        first = seen.setdefault(self.number(one), len(seen))
        if seen.setdefault(self.number(other), len(seen)) < first:
            one, other = other, one
        return self.operation(op.PRODUCT, one, other)

    def square(self, form: "Affine", high: bool) -> "Affine":
        """A form times itself; `high`: on the way to a high power, of which no factors are taken out."""
        return self._product(form, form) if high and form.terms else self.product(form, form)


def rounded(value: float) -> Any:
    """To 41 bits, 12 digits; of a number that knows its parameters, what it is made of: other values may differ."""
    if type(value) is Parameter:
        return rounded(value.scale), value.powers
    value = float(value)
    split = 4097.0 * value
    return split - (split - value)


class Affine:
    """An affine form; does what a number does, but has no size to be compared.

    While a callback runs on it, whatever could tell it from a number is refused.
    """

    __slots__ = ("constant", "graph", "kept_key", "kept_number", "terms")

    def __init__(self, graph: Graph, constant: float, terms: dict[int, float]):
        self.graph, self.constant, self.terms = graph, constant, terms
        self.kept_key: tuple[Any, ...] | None = None
        self.kept_number: int | None = None  # see Graph.number

    def on(self, graph: Graph) -> "Affine":
        """The same of a graph that has these quantities, too."""
        made = Affine(graph, self.constant, self.terms)
        made.kept_key = self.kept_key
        return made

    @property
    def key(self) -> tuple[Any, ...]:
        """What equal forms have in common, rounding of their coefficients apart."""
        if self.kept_key is None:
            self.kept_key = rounded(self.constant), *[(i, rounded(self.terms[i])) for i in sorted(self.terms)]
        return self.kept_key

    @property
    def late(self) -> bool:
        """Whether it depends on more than time and coordinates."""
        return any(self.graph.late[i] for i in self.terms)

    def times(self, factor: float) -> "Affine":
        """A multiple."""
        if type(factor) is float and factor == 1.0:
            return self
        if _equal(factor, 0.0):
            return Affine(self.graph, 0.0, {})
        return Affine(self.graph, self.constant * factor, {i: c * factor for i, c in self.terms.items()})

    def normalised(self) -> tuple[float, "Affine"]:
        """A factor, and the form over it, whose first coefficient is 1."""
        first = min(self.terms)
        factor = self.terms[first]
        if type(factor) is float and factor == 1.0:
            return factor, self
        if len(self.terms) == 1 and _equal(self.constant, 0.0):
            return factor, self.graph.quantity(first)
        if type(factor) is Parameter:
            inverse = factor.to(-1.0)
            return factor, Affine(self.graph, self.constant * inverse, {i: c * inverse for i, c in self.terms.items()})
        return factor, Affine(self.graph, self.constant / factor, {i: c / factor for i, c in self.terms.items()})

    def _other(self, other: Any) -> "Affine":
        if type(other) is not Affine:
            return Affine(self.graph, number(other), {})
        if other.graph is not self.graph:
            graph = self.graph if self.graph.running else other.graph
            graph.refuse("it uses t, q or v of another call, which it has kept")
        return other

    def __add__(self, other: Any) -> Any:
        if type(other) is not Affine and isinstance(other, np.ndarray):
            return elementwise(lambda x: x + self, [other])
        other = self._other(other)
        terms = dict(self.terms)
        for i, c in other.terms.items():
            total = terms[i] + c if i in terms else c
            if _size(total) <= CANCELLED * _size(c):
                terms.pop(i, None)  # a coefficient that underflowed is not there
            else:
                terms[i] = total
        if _equal(other.constant, 0.0):
            return Affine(self.graph, self.constant, terms)
        constant = self.constant + other.constant
        return Affine(self.graph, 0.0 if _size(constant) <= CANCELLED * _size(other.constant) else constant, terms)

    __radd__ = __add__

    def __neg__(self) -> "Affine":
        return self.times(-1.0)

    def __pos__(self) -> "Affine":
        return self

    def __sub__(self, other: Any) -> Any:
        return self + (-other)

    def __rsub__(self, other: Any) -> Any:
        return -self + other

    def __mul__(self, other: Any) -> Any:
        if type(other) is not Affine and isinstance(other, np.ndarray):
            return elementwise(lambda x: x * self, [other])
        return self.graph.product(self, self._other(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Any) -> Any:
        if type(other) is Affine:
            return self * other.reciprocal()
        return self * (1.0 / other)

    def __rtruediv__(self, other: Any) -> Any:
        return self.reciprocal() * other

    def __rpow__(self, base: Any) -> Any:
        if isinstance(base, np.ndarray):
            return elementwise(lambda x: x**self, [base])
        if base <= 0.0:
            self.graph.refuse(f"it raises {base!r} to a power that depends on t, q or v")
        return (self * LOG(base)).exponential()

    def __pow__(self, exponent: Any) -> Any:
        if type(exponent) is not Affine and isinstance(exponent, np.ndarray):
            return elementwise(lambda x: self**x, [exponent])
        if type(exponent) is Affine or type(exponent) is Parameter:
            self.graph.refuse("it raises to a power that depends on t, q or v, or on parameters")
        exponent = float(exponent)
        if exponent != math.floor(exponent):
            if 2.0 * exponent == math.floor(2.0 * exponent):
                return self ** math.floor(exponent) * self.square_root()
            return (self.logarithm() * exponent).exponential()
        n = abs(int(exponent))
        result, square, high = Affine(self.graph, 1.0, {}), self, n > HIGH_POWER
        while n:
            if n % 2:
                result = result * square
            n //= 2
            square = self.graph.square(square, high) if n else square
        return result.reciprocal() if exponent < 0.0 else result

    def _function(self, kind: int, known: Callable[[float], float]) -> "Affine":
        if not self.terms:
            return Affine(self.graph, known(self.constant), {})
        return self.graph.operation(kind, self)

    def reciprocal(self) -> "Affine":
        """1 / x."""
        if not self.terms:
            return Affine(self.graph, 1.0 / self.constant, {})
        scale, form = self.normalised()
        return self.graph.operation(op.RECIPROCAL, form).times(1.0 / scale)

    def square_root(self) -> "Affine":
        """The square root."""
        return self._function(op.SQUARE_ROOT, ROOT)

    def exponential(self) -> "Affine":
        """exp x."""
        return self._function(op.EXPONENTIAL, EXP)

    def sine(self) -> "Affine":
        """sin x; sine and cosine are made together, as each needs the other."""
        self._function(op.COSINE, COS)
        return self._function(op.SINE, SIN)

    def cosine(self) -> "Affine":
        """cos x."""
        self._function(op.SINE, SIN)
        return self._function(op.COSINE, COS)

    def value(self) -> "Affine":
        """The same as a multiple of one quantity, or as a number."""
        if len(self.terms) + (not _equal(self.constant, 0.0)) < 2:
            return self
        scale, form = self.normalised()
        return self.graph.operation(op.SUM, form).times(scale)

    def logarithm(self) -> "Affine":
        """log x, whose derivative is x' / x."""
        if not self.terms:
            return Affine(self.graph, LOG(self.constant), {})
        return self.graph.operation(op.LOGARITHM, self, self)

    def arctangent(self) -> "Affine":
        """atan x, whose derivative is x' / (1 + x^2)."""
        if not self.terms:
            return Affine(self.graph, ATAN(self.constant), {})
        return self.graph.operation(op.ARCTANGENT, self, self * self + 1.0)

    def _branches(self, *_: Any) -> Any:
        self.graph.refuse(BRANCHES)

    def __float__(self) -> float:
        self.graph.refuse(CONVERTS)

    __bool__ = __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = __int__ = __abs__ = _branches
    __index__ = __complex__ = __floordiv__ = __mod__ = __divmod__ = __rfloordiv__ = __rmod__ = __rdivmod__ = _branches
    __round__ = __trunc__ = __floor__ = __ceil__ = __hash__ = __reduce_ex__ = _branches  # type: ignore[assignment]

    def __repr__(self) -> str:
        if self.graph.running:
            self.graph.refuse("it makes text of what depends on t, q or v")
        return "<a symbol of t, q or v, kept from where the callback ran on symbols>"

    def __format__(self, specification: str) -> str:
        return repr(self)

    def __copy__(self) -> "Affine":
        return self

    def __deepcopy__(self, memo: Any) -> "Affine":
        return self

    def item(self) -> "Affine":
        """As a number of NumPy has it."""
        return self

    real = property(item)

    @property  # type: ignore[misc]
    def __class__(self) -> Any:  # of which isinstance asks
        if self.graph.running:
            self.graph.refuse("it asks for the type of what depends on t, q or v")
        return Affine

    def __getattr__(self, name: str) -> Any:
        if self.graph.running and not name.startswith("__"):
            self.graph.refuse(f"it asks for .{name} of what depends on t, q or v")
        raise AttributeError(name)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        function = OPERATORS.get(ufunc.__name__) or FUNCTIONS.get(ufunc.__name__)
        if ufunc.__name__ in COMPARISONS:
            self._branches()
        if function is None or method != "__call__" or options or (out is not None and out[0].dtype != object):
            self.graph.refuse(f"it calls numpy.{ufunc.__name__} on what depends on t, q or v")
        return elementwise(function, inputs, out)


COMPARISONS = {"less", "less_equal", "greater", "greater_equal", "equal", "not_equal"}
FUNCTIONS: dict[str, Callable[[Affine], Any]] = {
    "sin": Affine.sine,
    "cos": Affine.cosine,
    "tan": lambda x: x.sine() / x.cosine(),
    "sqrt": Affine.square_root,
    "exp": Affine.exponential,
    "log": Affine.logarithm,
    "atan": Affine.arctangent,
    "arctan": Affine.arctangent,
    "sinh": lambda x: (x.exponential() - (-x).exponential()) * 0.5,
    "cosh": lambda x: (x.exponential() + (-x).exponential()) * 0.5,
    "tanh": lambda x: 1.0 - 2.0 / ((2.0 * x).exponential() + 1.0),
}
for _name, _function in FUNCTIONS.items():  # NumPy calls them on arrays of forms by these names
    setattr(Affine, _name, _function)


def symbols(forms: Iterable[Affine]) -> Any:
    """Forms as an array that callbacks take."""
    forms = list(forms)
    made = np.empty(len(forms), dtype=object)
    made[:] = forms
    return made


def is_zero(form: Affine) -> bool:
    """Whether a form is zero by its structure."""
    return not form.terms and form.constant == 0.0


class Derivative:
    """Derivatives of quantities along a direction in which the inputs change, by the rules of differentiation."""

    def __init__(self, graph: Graph, direction: dict[int, Affine]):
        self.graph = graph
        self._known = dict(direction)
        self._changing = sum(1 << i for i in direction)

    def of(self, form: Affine) -> Affine:
        """The derivative of a form."""
        total = Affine(self.graph, 0.0, {})
        for i, c in form.terms.items():
            if self.graph.inputs_of[i] & self._changing:
                total = total + self._of_quantity(i).times(c)
        return total

    def _of_quantity(self, i: int) -> Affine:
        ahead = [i]  # no recursion: products may be a thousand deep
        while i not in self._known:
            operation = self.graph.operations[ahead[-1]]
            forms = () if operation is None else [form for form in operation[1:] if isinstance(form, Affine)]
            unknown = [
                k
                for form in forms
                for k in form.terms
                if k not in self._known and self.graph.inputs_of[k] & self._changing
            ]
            if unknown:
                ahead += unknown
                continue
            k = ahead.pop()
            if k not in self._known:
                change = Affine(self.graph, 0.0, {}) if operation is None else self._of_operation(k, *operation)
                self._known[k] = change.value()
        return self._known[i]

    def _of_operation(self, i: int, kind: int, first: Affine, second: Affine | None) -> Affine:
        result, change = self.graph.quantity(i), self.of(first)
        if kind == op.PRODUCT:
            assert second is not None
            return change * second + first * self.of(second)
        if kind == op.SUM:
            return change
        if kind == op.RECIPROCAL:
            return -(change * result * result)
        if kind == op.SQUARE_ROOT:
            return change * result.reciprocal() * 0.5
        if kind == op.EXPONENTIAL:
            return change * result
        if kind == op.SINE:
            return change * first.cosine()
        if kind == op.COSINE:
            return -(change * first.sine())
        assert kind in (op.LOGARITHM, op.ARCTANGENT) and second is not None
        return change * second.reciprocal()

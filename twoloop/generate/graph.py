"""Record the operations of callbacks in a graph, and differentiate the recorded expressions.

A callback runs on affine expressions c + sum_i c_i x_i of quantities x_i instead of numbers. Quantities are the time,
coordinates, velocities, and results of operations: products and functions of affine expressions, each recorded once.
"""

import math
from collections.abc import Callable, Container, Iterable
from typing import Any

import numpy as np

from twoloop.generate.parameter_expressions import (
    CANCELLATION_LIMIT,
    OPERATORS,
    Parameter,
    SymbolicObject,
    as_number,
    elementwise,
    math_function,
)
from twoloop.generate.parameter_expressions import Untraceable as Untraceable
from twoloop.kernels.evaluation import operations as op

# derived callbacks and Taylor series with more operations than this are refused: tracing takes longer than most runs
MAX_TRACED_OPERATIONS = 20_000
# products that differ by a constant factor are recorded once, without this factor. To avoid underflow and overflow, a
# product is recorded with its factor if |factor| is not between MIN_FACTOR and 1 / MIN_FACTOR. Squares that yield a
# power with an exponent above HIGH_EXPONENT are also recorded with their factors
MIN_FACTOR, HIGH_EXPONENT = 1e-100, 8
# end of the message if a callback compares an expression, or converts an expression to a number
BRANCHING_REASON = "it branches on, or converts to a number, what depends on t, q or v"

# functions of `math`, replaced by functions that also accept Parameters
SIN, COS, EXP, LOG, ATAN, SQRT = map(math_function, ("sin", "cos", "exp", "log", "atan", "sqrt"))

_equal = float.__eq__  # compares two floats or Parameters; for Parameters, the operator == would raise an exception
_magnitude = float.__abs__  # absolute value as a plain float, also for a Parameter

CONVERSION_REASON = (
    "it converts what depends on t, q or v to a number, as functions of math do within methods (numpy's do not)"
)


class Graph(SymbolicObject):
    """Graph of quantities, numbered from 0: inputs (time, coordinates, velocities) and results of operations.

    operations : for each quantity, None if it is an input, else (kind of operation, first argument, second argument or
        None). The second argument of a logarithm or an arctangent is the divisor in its derivative.
    input_sizes : number of inputs that each call of `inputs` has added.
    traced : results of traced callbacks, as arrays of expressions; keys: names of callbacks, such as "mass".
    """

    def __init__(self) -> None:
        self.input_sizes: list[int] = []
        self.operations: list[tuple[int, Affine, Affine | None] | None] = []
        self.is_late: list[bool] = []  # for each quantity, whether it depends on inputs besides time and coordinates
        self.input_masks: list[int] = []  # for each quantity, a bit mask of the inputs that it depends on
        self.traced: dict[str, Any] = {}
        self._recorded_quantities: dict[tuple[int, int, int], int] = {}
        # factors of products, numbered in the order of their first use; keys: results of `identifier`. A product begins
        # with the factor of the lower number, so that the order of factors does not depend on values of parameters
        self._factor_order: dict[int, int] = {}
        self._identifiers: dict[Any, int] = {}  # results of `identifier`, by keys of expressions
        self._quantities: dict[int, Affine] = {}

    def copy(self) -> "Graph":
        """Return a copy, which can be extended independently; `traced` is empty in the copy."""
        graph = Graph()
        graph.input_sizes, graph.is_late, graph.input_masks = (
            self.input_sizes.copy(),
            self.is_late.copy(),
            self.input_masks.copy(),
        )
        graph._recorded_quantities, graph._factor_order, graph._identifiers = (
            self._recorded_quantities.copy(),
            self._factor_order.copy(),
            self._identifiers.copy(),
        )
        graph.operations = [
            None
            if operation is None
            else (
                operation[0],
                operation[1].copy_to_graph(graph),
                None if operation[2] is None else operation[2].copy_to_graph(graph),
            )
            for operation in self.operations
        ]
        return graph

    def inputs(self, n: int, is_late: bool) -> list["Affine"]:
        """Add n inputs and return them as expressions; `is_late`: False for time and coordinates, else True."""
        first = len(self.operations)
        self.input_sizes.append(n)
        self.operations += [None] * n
        self.is_late += [is_late] * n
        self.input_masks += [1 << first + i for i in range(n)]
        return [self.quantity(first + i) for i in range(n)]

    def quantity(self, i: int) -> "Affine":
        """Return quantity i as an expression."""
        expr = self._quantities.get(i)
        if expr is None:
            self._quantities[i] = expr = Affine(self, 0.0, {i: 1.0})
        return expr

    def identifier(self, expr: "Affine") -> int:
        """Return an integer that is the same for equal expressions; comparing it is faster than comparing keys."""
        if expr.cached_identifier is None:
            expr.cached_identifier = self._identifiers.setdefault(expr.key, len(self._identifiers))
        return expr.cached_identifier

    def operation(self, kind: int, first: "Affine", second: "Affine | None" = None) -> "Affine":
        """Return the result of an operation as a quantity; record the operation unless it is recorded already."""
        key = kind, self.identifier(first), -1 if second is None else self.identifier(second)
        quantity = self._recorded_quantities.get(key)
        if quantity is None:
            quantity = self._recorded_quantities[key] = len(self.operations)
            self.operations.append((kind, first, second))
            self.is_late.append(first.is_late or (second is not None and second.is_late))
            mask = 0
            for i in (*first.terms, *(() if second is None else second.terms)):
                mask |= self.input_masks[i]
            self.input_masks.append(mask)
        return self.quantity(quantity)

    def quantities_for(self, exprs: Iterable["Affine"], available: Container[int] = ()) -> list[int]:
        """Return the indices of all quantities to compute for `exprs`, except those in `available`; arguments first."""
        needed: set[int] = set()
        stack = [i for expr in exprs for i in expr.terms]
        while stack:
            i = stack.pop()
            operation = self.operations[i]
            if i not in needed and operation is not None and i not in available:
                needed.add(i)
                stack += [j for expr in operation[1:] if isinstance(expr, Affine) for j in expr.terms]
        return sorted(needed)

    def kind(self, i: int) -> int:
        """Return the kind of the operation, such as SINE, that computes quantity i, which must not be an input."""
        operation = self.operations[i]
        assert operation is not None
        return operation[0]

    def arguments(self, i: int) -> list["Affine"]:
        """Return the arguments of the operation that computes quantity i; an empty list if it is an input."""
        return [expr for expr in (self.operations[i] or ())[1:] if isinstance(expr, Affine)]

    def quantities_by_use(self, exprs: Iterable["Affine"], available: Container[int] = ()) -> list[int]:
        """Return the same indices as `quantities_for`, but each quantity comes shortly before its first use."""
        order: list[int] = []
        needed: set[int] = set()
        stack = [i for expr in exprs for i in expr.terms][::-1]
        while stack:
            i = stack.pop()
            operation = None if i < 0 else self.operations[i]
            if i < 0:  # the arguments of quantity ~i were above i on the stack, and are in `order` now
                order.append(~i)
            elif i not in needed and operation is not None and i not in available:
                needed.add(i)
                stack.append(~i)
                stack += [j for expr in operation[1:] if isinstance(expr, Affine) for j in expr.terms][::-1]
        return order

    def product(self, a: "Affine", b: "Affine") -> "Affine":
        """Return a * b as a number times a recorded product, the same one for all constant multiples of a and b."""
        if not a.terms:
            return b.times(a.constant)
        if not b.terms:
            return a.times(b.constant)
        (scale_a, first), (scale_b, second) = a.normalized(), b.normalized()
        factor = scale_a * scale_b
        if not MIN_FACTOR < _magnitude(factor) < 1.0 / MIN_FACTOR:
            first, second, factor = a, b, 1.0
        return self._product(first, second).times(factor)

    def _product(self, a: "Affine", b: "Affine") -> "Affine":
        order = self._factor_order
        first = order.setdefault(self.identifier(a), len(order))
        if order.setdefault(self.identifier(b), len(order)) < first:
            a, b = b, a
        return self.operation(op.PRODUCT, a, b)

    def square(self, expr: "Affine", is_high_power: bool) -> "Affine":
        """Return `expr` squared. If `is_high_power`, the recorded square includes the constant factor of `expr`."""
        return self._product(expr, expr) if is_high_power and expr.terms else self.product(expr, expr)


def rounded(value: float) -> Any:
    """Return a number rounded to 41 bits (12 digits); for a Parameter, return the pair (rounded `scale`, `powers`)."""
    if type(value) is Parameter:
        return rounded(value.scale), value.powers
    value = float(value)
    scaled = 4097.0 * value  # Dekker's splitting: as 4097 = 2**12 + 1, the returned difference has 41 of 53 bits
    return scaled - (scaled - value)


class Affine:
    """Affine expression of quantities; it has the operators of a number, so that callbacks can run on it.

    An expression has no value that could be compared. While a callback runs on expressions, an operation raises an
    exception if it could reveal to the callback that an expression is not a number.
    """

    __slots__ = ("cached_identifier", "cached_key", "constant", "graph", "terms")

    def __init__(self, graph: Graph, constant: float, terms: dict[int, float]):
        self.graph, self.constant, self.terms = graph, constant, terms
        self.cached_key: tuple[Any, ...] | None = None
        self.cached_identifier: int | None = None  # see Graph.identifier

    def copy_to_graph(self, graph: Graph) -> "Affine":
        """Return this expression in terms of the quantities of `graph`, which must be a copy of self.graph."""
        copy = Affine(graph, self.constant, self.terms)
        copy.cached_key = self.cached_key
        return copy

    @property
    def key(self) -> tuple[Any, ...]:
        """Return a hashable key, which is equal for expressions whose coefficients are equal up to rounding."""
        if self.cached_key is None:
            self.cached_key = rounded(self.constant), *[(i, rounded(self.terms[i])) for i in sorted(self.terms)]
        return self.cached_key

    @property
    def is_late(self) -> bool:
        """Return True if the expression depends on inputs other than time and coordinates."""
        return any(self.graph.is_late[i] for i in self.terms)

    def times(self, factor: float) -> "Affine":
        """Return the expression multiplied by a number."""
        if type(factor) is float and factor == 1.0:
            return self
        if _equal(factor, 0.0):
            return Affine(self.graph, 0.0, {})
        return Affine(self.graph, self.constant * factor, {i: c * factor for i, c in self.terms.items()})

    def normalized(self) -> tuple[float, "Affine"]:
        """Return the coefficient of the quantity with the lowest index, and the expression / this coefficient."""
        first = min(self.terms)
        factor = self.terms[first]
        if type(factor) is float and factor == 1.0:
            return factor, self
        if len(self.terms) == 1 and _equal(self.constant, 0.0):
            return factor, self.graph.quantity(first)
        if type(factor) is Parameter:
            inverse = factor.to_power(-1.0)
            return factor, Affine(self.graph, self.constant * inverse, {i: c * inverse for i, c in self.terms.items()})
        return factor, Affine(self.graph, self.constant / factor, {i: c / factor for i, c in self.terms.items()})

    def _convert_operand(self, other: Any) -> "Affine":
        """Convert an operand (a number or an expression) to an expression; refuse expressions of other graphs."""
        if type(other) is not Affine:
            return Affine(self.graph, as_number(other), {})
        if other.graph is not self.graph:
            graph = self.graph if self.graph.is_tracing else other.graph
            graph.refuse("it uses t, q or v of another call, which it has kept")
        return other

    def __add__(self, other: Any) -> Any:
        if type(other) is not Affine and isinstance(other, np.ndarray):
            return elementwise(lambda x: x + self, [other])
        other = self._convert_operand(other)
        terms = dict(self.terms)
        for i, c in other.terms.items():
            total = terms[i] + c if i in terms else c
            if _magnitude(total) <= CANCELLATION_LIMIT * _magnitude(c):
                terms.pop(i, None)  # i is missing in `terms` if its coefficient c is new, and has underflowed to 0
            else:
                terms[i] = total
        if _equal(other.constant, 0.0):
            return Affine(self.graph, self.constant, terms)
        constant = self.constant + other.constant
        return Affine(
            self.graph,
            0.0 if _magnitude(constant) <= CANCELLATION_LIMIT * _magnitude(other.constant) else constant,
            terms,
        )

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
        return self.graph.product(self, self._convert_operand(other))

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
        result, square, is_high_power = Affine(self.graph, 1.0, {}), self, n > HIGH_EXPONENT
        while n:
            if n % 2:
                result = result * square
            n //= 2
            square = self.graph.square(square, is_high_power) if n else square
        return result.reciprocal() if exponent < 0.0 else result

    def _apply(self, kind: int, numeric_function: Callable[[float], float]) -> "Affine":
        if not self.terms:
            return Affine(self.graph, numeric_function(self.constant), {})
        return self.graph.operation(kind, self)

    def reciprocal(self) -> "Affine":
        """Return the reciprocal of this expression."""
        if not self.terms:
            return Affine(self.graph, 1.0 / self.constant, {})
        scale, expr = self.normalized()
        return self.graph.operation(op.RECIPROCAL, expr).times(1.0 / scale)

    def square_root(self) -> "Affine":
        """Return the square root of this expression."""
        return self._apply(op.SQUARE_ROOT, SQRT)

    def exponential(self) -> "Affine":
        """Return the exponential of this expression."""
        return self._apply(op.EXPONENTIAL, EXP)

    def sine(self) -> "Affine":
        """Return the sine of this expression; record the cosine, too, because the derivative needs it."""
        self._apply(op.COSINE, COS)
        return self._apply(op.SINE, SIN)

    def cosine(self) -> "Affine":
        """Return the cosine of this expression; record the sine, too, because the derivative needs it."""
        self._apply(op.SINE, SIN)
        return self._apply(op.COSINE, COS)

    def as_term(self) -> "Affine":
        """Return the expression if it is a number or a multiple of one quantity; else record it as a new quantity."""
        if len(self.terms) + (not _equal(self.constant, 0.0)) < 2:
            return self
        scale, expr = self.normalized()
        return self.graph.operation(op.SUM, expr).times(scale)

    def logarithm(self) -> "Affine":
        """Return the logarithm of this expression x, whose derivative is x' / x."""
        if not self.terms:
            return Affine(self.graph, LOG(self.constant), {})
        return self.graph.operation(op.LOGARITHM, self, self)

    def arctangent(self) -> "Affine":
        """Return the arctangent of this expression x, whose derivative is x' / (1 + x^2)."""
        if not self.terms:
            return Affine(self.graph, ATAN(self.constant), {})
        return self.graph.operation(op.ARCTANGENT, self, self * self + 1.0)

    def _refuse_numeric_use(self, *_: Any) -> Any:
        """Refuse an operation that needs a number: comparison, conversion, rounding, hash or pickling."""
        self.graph.refuse(BRANCHING_REASON)

    def __float__(self) -> float:
        self.graph.refuse(CONVERSION_REASON)

    __bool__ = __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = __int__ = __abs__ = _refuse_numeric_use
    __index__ = __complex__ = __floordiv__ = __mod__ = __divmod__ = __rfloordiv__ = __rmod__ = __rdivmod__ = (
        _refuse_numeric_use
    )
    __round__ = __trunc__ = __floor__ = __ceil__ = __hash__ = __reduce_ex__ = _refuse_numeric_use  # type: ignore[assignment]

    def __repr__(self) -> str:
        if self.graph.is_tracing:
            self.graph.refuse("it makes text of what depends on t, q or v")
        return "<a symbol of t, q or v, kept from where the callback ran on symbols>"

    def __format__(self, specification: str) -> str:
        return repr(self)

    def __copy__(self) -> "Affine":
        return self

    def __deepcopy__(self, memo: Any) -> "Affine":
        return self

    def item(self) -> "Affine":
        """Return the expression itself, as `item` of a NumPy number does."""
        return self

    real = property(item)

    @property  # type: ignore[misc]  # the property `__class__`, which `isinstance` reads
    def __class__(self) -> Any:
        if self.graph.is_tracing:
            self.graph.refuse("it asks for the type of what depends on t, q or v")
        return Affine

    def __getattr__(self, name: str) -> Any:
        if self.graph.is_tracing and not name.startswith("__"):
            self.graph.refuse(f"it asks for .{name} of what depends on t, q or v")
        raise AttributeError(name)

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        function = OPERATORS.get(ufunc.__name__) or FUNCTIONS.get(ufunc.__name__)
        if ufunc.__name__ in COMPARISONS:
            self._refuse_numeric_use()
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
for _name, _function in FUNCTIONS.items():  # NumPy functions call methods of these names for arrays of objects
    setattr(Affine, _name, _function)


def symbol_array(exprs: Iterable[Affine]) -> Any:
    """Return a NumPy array of objects with these expressions, as an argument of callbacks."""
    exprs = list(exprs)
    array = np.empty(len(exprs), dtype=object)
    array[:] = exprs
    return array


def is_zero(expr: Affine) -> bool:
    """Return True if an expression has no terms and the constant 0."""
    return not expr.terms and expr.constant == 0.0


class Derivative:
    """Directional derivatives of expressions; `direction`: nonzero components of the direction, by index of input."""

    def __init__(self, graph: Graph, direction: dict[int, Affine]):
        self.graph = graph
        self._derivatives = dict(direction)
        self._input_mask = sum(1 << i for i in direction)  # bit mask of the inputs in `direction`

    def differentiate(self, expr: Affine) -> Affine:
        """Return the derivative of an expression in the direction that the constructor was given."""
        total = Affine(self.graph, 0.0, {})
        for i, c in expr.terms.items():
            if self.graph.input_masks[i] & self._input_mask:
                total = total + self._differentiate_quantity(i).times(c)
        return total

    def _differentiate_quantity(self, i: int) -> Affine:
        """Return the derivative of quantity i; first compute the derivatives of the quantities in its definition."""
        stack = [i]  # no recursion, because products may be nested more deeply than Python's limit
        while i not in self._derivatives:
            op = self.graph.operations[stack[-1]]
            exprs = () if op is None else [expr for expr in op[1:] if isinstance(expr, Affine)]
            missing = [
                k
                for expr in exprs
                for k in expr.terms
                if k not in self._derivatives and self.graph.input_masks[k] & self._input_mask
            ]
            if missing:
                stack += missing
                continue
            k = stack.pop()
            if k not in self._derivatives:
                change = Affine(self.graph, 0.0, {}) if op is None else self._differentiate_operation(k, *op)
                self._derivatives[k] = change.as_term()
        return self._derivatives[i]

    def _differentiate_operation(self, i: int, kind: int, first: Affine, second: Affine | None) -> Affine:
        """Return the directional derivative of quantity i, the result of operation `kind` on `first` and `second`."""
        result, change = self.graph.quantity(i), self.differentiate(first)
        if kind == op.PRODUCT:
            assert second is not None
            return change * second + first * self.differentiate(second)
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

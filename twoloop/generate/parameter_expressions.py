"""Numbers that record how they were computed from parameters, so that one trace serves other values of these.

A `Parameter` is a float with which callbacks compute as with any other; the result is a `Parameter` again. Tracing
decides by values (what cancels, which expressions are equal), so these must be generic.
"""

import math
import operator
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Powers = tuple[tuple[int, float], ...]  # atoms and their exponents: a product; empty for 1

MOST_TERMS = 200  # of a sum: each is told apart by all of its terms
_plain = float.__pos__  # a number as a float, which is not asked for as by a callback
CANCELLED = 8.0 * 2.0**-52  # of a term: what rounding leaves of two that cancel
NUMBERS = (int, float, np.number)
_OF_ONE = ("sin", "cos", "tan", "sqrt", "exp", "log", "arctan", "sinh", "cosh", "tanh", "absolute")
FUNCTIONS = {name: getattr(np, name) for name in (*_OF_ONE, "hypot", "power")}
OPERATORS: dict[str, Callable[..., Any]] = {  # of NumPy, as operators of Python
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "power": operator.pow,
    "float_power": operator.pow,
    "negative": operator.neg,
    "positive": operator.pos,
    "square": lambda x: x * x,
    "reciprocal": lambda x: 1.0 / x,
    "hypot": lambda x, y: (x * x + y * y) ** 0.5,
}
NAMES = {"atan": "arctan", "fabs": "absolute", "abs": "absolute", "pow": "power", "true_divide": "divide"}


class Untraceable(ValueError):
    """Raised for a callback that does not run on symbols; the text says why."""


class Refusal(BaseException):
    """Leaves a callback that does not run on symbols: no `except Exception` of its own holds it."""


class Symbolic:
    """What callbacks run on once, in the place of numbers.

    Attributes
    ----------
    running : bool
        Whether a callback runs on it now ...
    refused : str
        ... and why it cannot, which it may have caught.
    """

    running, refused = False, ""

    def refuse(self, reason: str) -> NoReturn:
        """Leave the callback that runs, and keep the reason."""
        if not self.running:
            raise Untraceable(reason)
        self.refused = self.refused or reason
        raise Refusal(reason)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """While a callback runs: raises Untraceable if it was refused something and has caught that."""
        self.running, self.refused = True, ""
        try:
            yield
        finally:
            self.running = False
        if self.refused:
            raise Untraceable(f"{self.refused}, and catches the exception that says so")


class ParameterTape(Symbolic):
    """What numbers were made of: atoms, which are parameters, sums of products of atoms, or functions of these.

    Parameters
    ----------
    values : sequence of float
        Of all parameters, generic ones where these vary.
    varying : sequence of int
        Which of them do.

    Notes
    -----
    A callback that runs on its numbers must not decide by what these are just now.
    """

    def __init__(self, values: Sequence[float], varying: Iterable[int]):
        self.atoms: list[Any] = [None] * len(values)
        self.merged: dict[tuple[Powers, Powers], Powers] = {}  # products of two
        self._places: dict[Any, int] = {}
        self.parameters = np.empty(len(values), dtype=object)
        self.parameters[:] = [float(value) for value in values]
        for place in varying:
            self.parameters[place] = Parameter(float(values[place]), self, 1.0, ((place, 1.0),))

    def atom(self, definition: Any) -> Powers:
        """The power of a sum or a function, the one known before if there is one."""
        if definition not in self._places:
            self._places[definition] = len(self.atoms)
            self.atoms.append(definition)
        return ((self._places[definition], 1.0),)

    def terms(self, number: float) -> dict[Powers, float]:
        """A number as a sum of products."""
        if type(number) is not Parameter:
            return {(): number} if number else {}
        (place, exponent), *others = number.powers
        definition = self.atoms[place]
        if others or exponent != 1.0 or definition is None or definition[0] != "sum":
            return {number.powers: number.scale}
        return {powers: number.scale * c for powers, c in definition[1]}

    def on(self, parameters: Array) -> Callable[[float], Any]:
        """A function that gives what a number is for other parameters, as `products` does for one of its factors."""
        product = self.products(parameters)
        return lambda number: number.scale * product(number.powers) if type(number) is Parameter else number

    def products(self, parameters: Array) -> Callable[[Powers], Any]:
        """A function that gives what a product of atoms is for other parameters.

        These are (n_p,), or (n_runs, n_p): then it gives (n_runs,), or one number for all.
        """
        atoms: dict[int, Any] = {}
        products: dict[Powers, Any] = {(): 1.0}

        def product(powers: Powers) -> Any:
            if powers not in products:
                *before, (place, exponent) = powers
                if before:
                    products[powers] = product(tuple(before)) * product(powers[-1:])
                else:
                    products[powers] = atom(place) if exponent == 1.0 else atom(place) ** exponent
            return products[powers]

        def atom(place: int) -> Any:
            if place not in atoms:
                definition = self.atoms[place]
                if definition is None:
                    atoms[place] = parameters.T[place]
                elif definition[0] == "sum":
                    atoms[place] = sum(c * product(powers) for powers, c in definition[1])
                else:
                    atoms[place] = FUNCTIONS[definition[0]](*(c * product(powers) for powers, c in definition[1]))
            return atoms[place]

        return product

    def evaluate(self, numbers: Sequence["Parameter"], parameters: Array) -> Array:
        """What numbers are for other parameters (n_runs, n_p): (n_runs, len(numbers))."""
        product = self.products(parameters)
        places = {powers: k for k, powers in enumerate(dict.fromkeys(each.powers for each in numbers))}
        products = np.empty((len(places), len(parameters)))
        with np.errstate(all="ignore"):
            for powers, k in places.items():
                products[k] = product(powers)
            scales = np.array([[each.scale] for each in numbers]).reshape(-1, 1)
            made = scales * products[[places[each.powers] for each in numbers]]
        return np.ascontiguousarray(made.T)


class Parameter(float):
    """A float, and the product of atoms that it is a multiple of."""

    __slots__ = ("powers", "record", "scale")
    record: ParameterTape
    scale: float
    powers: Powers

    def __new__(cls, value: float, record: ParameterTape, scale: float, powers: Powers) -> "Parameter":
        """A number of a record."""
        made = float.__new__(cls, value)
        made.record, made.scale, made.powers = record, scale, powers
        return made

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        name = NAMES.get(ufunc.__name__, ufunc.__name__)
        if method != "__call__" or name not in _OPERATIONS.keys() | FUNCTIONS.keys() or options:
            self._decides(f"it calls numpy.{ufunc.__name__} on its parameters")
            plain = (float(each) if type(each) is Parameter else each for each in inputs)
            return getattr(ufunc, method)(*plain, **options)
        return elementwise(lambda *given: applied(name, *given), inputs, out)

    def _decides(self, reason: str = "it branches on its parameters, or rounds them") -> None:
        """Refuse a callback what is true of this value alone; what traces it may ask."""
        caller = sys._getframe(2).f_globals.get("__name__", "")
        if self.record.running and not caller.startswith(__name__.rpartition(".")[0]):
            self.record.refuse(reason)

    def to(self, exponent: float) -> "Parameter":
        """The power with a whole exponent that is not 0."""
        powers = tuple([(place, exponent * own) for place, own in self.powers])
        return Parameter(_plain(self) ** exponent, self.record, self.scale**exponent, powers)

    def __neg__(self) -> "Parameter":
        return Parameter(-_plain(self), self.record, -self.scale, self.powers)

    def __pos__(self) -> "Parameter":
        return self

    def __abs__(self) -> Any:
        return applied("absolute", self)

    def __reduce_ex__(self, protocol: Any) -> Any:
        return float, (float(self),)

    def __copy__(self) -> "Parameter":
        return self

    def __deepcopy__(self, memo: Any) -> "Parameter":
        return self


def _sum(one: float, other: float) -> float:
    record = _record(one, other)
    terms, value = record.terms(one), _plain(one) + _plain(other)
    for powers, c in record.terms(other).items():
        total = terms.get(powers, 0.0) + c
        if abs(total) <= CANCELLED * abs(c):
            terms.pop(powers, None)
        else:
            terms[powers] = total
    if len(terms) > MOST_TERMS:
        record.refuse(f"it adds up more than {MOST_TERMS} terms of its parameters")
    if len(terms) < 2:
        ((powers, c),) = terms.items() or (((), 0.0),)
        return Parameter(value, record, c, powers) if powers else c
    (_, scale), *_ = items = sorted(terms.items())
    return Parameter(value, record, scale, record.atom(("sum", tuple((powers, c / scale) for powers, c in items))))


def _product(one: float, other: float) -> float:
    if type(one) is not Parameter:
        one, other = other, one
    assert isinstance(one, Parameter)
    record = one.record
    if type(other) is not Parameter:
        if other == 1.0:
            return one
        return Parameter(_plain(one) * other, record, one.scale * other, one.powers) if other else 0.0
    scale, both = one.scale * other.scale, (one.powers, other.powers)
    left = record.merged.get(both)
    if left is None:
        powers = dict(one.powers)
        for place, exponent in other.powers:
            powers[place] = powers.get(place, 0.0) + exponent
        left = record.merged[both] = tuple(sorted(each for each in powers.items() if each[1]))
    return Parameter(_plain(one) * _plain(other), record, scale, left) if left else scale


def _power(one: float, exponent: float) -> float:
    if type(exponent) is Parameter or not exponent.is_integer():  # the root of a square is no product: it has no sign
        return _function("power", one, exponent)
    assert isinstance(one, Parameter)
    return one.to(exponent) if exponent else 1.0


_OPERATIONS: dict[str, Callable[[float, float], float]] = {
    "add": _sum,
    "subtract": lambda one, other: _sum(one, -other),
    "multiply": _product,
    "divide": lambda one, other: _product(one, other.to(-1.0) if type(other) is Parameter else 1.0 / other),
    "power": _power,
}


def _record(*numbers: float) -> ParameterTape:
    return next(each.record for each in numbers if type(each) is Parameter)


def applied(name: str, *arguments: Any) -> Any:
    """A function, by its name in NumPy or `math`, of numbers: a Parameter one if one of these is."""
    name = NAMES.get(name, name)
    if any(not issubclass(type(each), NUMBERS) for each in arguments):  # a symbol, which goes by its own rules
        one, other = arguments
        return OPERATORS[name](one, other)
    numbers = [each if type(each) is Parameter else float(each) for each in arguments]
    if not any(type(each) is Parameter for each in numbers):
        return float(getattr(np, name)(*numbers))
    if name in _OPERATIONS:
        return _OPERATIONS[name](*numbers)
    return _function(name, *numbers)


def _function(name: str, *numbers: float) -> Parameter:
    record = _record(*numbers)
    made = tuple((each.powers, each.scale) if isinstance(each, Parameter) else ((), each) for each in numbers)
    with np.errstate(all="ignore"):  # a generic number may be where the function has no value
        value = float(FUNCTIONS[name](*map(float, numbers)))
    return Parameter(value, record, 1.0, record.atom((name, made)))


def _operator(name: str, swapped: bool) -> Callable[[Parameter, Any], Any]:
    known = _OPERATIONS[name]

    def operate(self: Parameter, other: Any) -> Any:
        if type(other) is float or type(other) is Parameter:
            return known(other, self) if swapped else known(self, other)
        pair = (other, self) if swapped else (self, other)
        if issubclass(type(other), np.ndarray):
            return self.__array_ufunc__(getattr(np, name), "__call__", *pair)
        if not issubclass(type(other), NUMBERS):  # by type(), as a symbol refuses isinstance
            return NotImplemented
        return known(*(each if type(each) is Parameter else float(each) for each in pair))

    return operate


def _deciding(name: str) -> Callable[..., Any]:
    plain = getattr(float, name)

    def decide(self: Parameter, *others: Any) -> Any:
        self._decides()
        return plain(self, *others)

    return decide


_DECIDING = ("bool", "int", "float", "trunc", "floor", "ceil", "round", "lt", "le", "gt", "ge", "eq", "ne")
for _name in (*_DECIDING, "mod", "rmod", "floordiv", "rfloordiv", "divmod", "rdivmod"):
    setattr(Parameter, f"__{_name}__", _deciding(f"__{_name}__"))
Parameter.__hash__ = float.__hash__  # type: ignore[method-assign]
for _symbol, _name in {"add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide", "pow": "power"}.items():
    setattr(Parameter, f"__{_symbol}__", _operator(_name, False))
    setattr(Parameter, f"__r{_symbol}__", _operator(_name, True))
for _name in _OF_ONE:
    setattr(Parameter, _name, lambda self, name=_name: applied(name, self))  # NumPy calls them on arrays of objects


def elementwise(function: Callable[..., Any], inputs: Iterable[Any], out: Any = None) -> Any:
    """A function of numbers and symbols, for arrays of them, by NumPy, which does not ask these again how to go on."""
    operands = list(map(_operand, inputs))
    made = np.frompyfunc(function, len(operands), 1)(*operands)
    if out is None:
        return made
    out[0][...] = made
    return out[0]


def _operand(value: Any) -> Any:
    """An array of objects, or of one that is a number of Python's or a symbol, which refuses isinstance."""
    if issubclass(type(value), np.ndarray):
        return value.astype(object)
    made = np.empty((), dtype=object)
    made[()] = float(value) if issubclass(type(value), np.generic) else value
    return made


def array_of(values: Iterable[float]) -> Any:
    """An array of floats, or of objects where some know their parameters."""
    values = list(values)
    return np.array(values, dtype=object if any(type(each) is Parameter for each in values) else float)


def number(value: Any) -> float:
    """A coefficient of a form: a Parameter one as it is, any other as a float."""
    return value if type(value) is Parameter else float(value)


def function_of_number(name: str) -> Callable[[float], float]:
    """A function of `math` that keeps what a number is made of."""
    plain = getattr(math, name)
    return lambda x: applied(name, x) if type(x) is Parameter else plain(x)

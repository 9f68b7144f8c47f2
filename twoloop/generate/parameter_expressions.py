"""Compute with numbers that record how they depend on parameters, so that one trace serves all parameter values.

A `Parameter` is a float: callbacks compute with it as with any other float, and results are Parameters, too. During the
trace, a Parameter has a random value, so that terms cancel only if they cancel for all values.
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

# product of powers as pairs (index of the base in ParameterTape.atoms, exponent); the empty tuple is the number 1
Powers = tuple[tuple[int, float], ...]

MAX_TERMS = 200  # largest number of terms with parameters in a sum of a traced callback: long sums are slow to compare
_as_float = float.__pos__  # converts a Parameter to a float; float(x) raises an exception while callbacks are traced
# the sum of two terms counts as zero if its magnitude is at most this fraction of the second term
CANCELLATION_LIMIT = 8.0 * 2.0**-52
NUMBER_TYPES = (int, float, np.number)  # types that count as numbers; Parameter is a subclass of float
_UNARY_FUNCTIONS = ("sin", "cos", "tan", "sqrt", "exp", "log", "arctan", "sinh", "cosh", "tanh", "absolute")
FUNCTIONS = {name: getattr(np, name) for name in (*_UNARY_FUNCTIONS, "hypot", "power")}
OPERATORS: dict[str, Callable[..., Any]] = {  # keys: names in NumPy; values: the same functions by Python's operators
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
# functions with several names. Keys: other names in `math` or NumPy; values: names in FUNCTIONS and OPERATORS
NUMPY_NAMES = {"atan": "arctan", "fabs": "absolute", "abs": "absolute", "pow": "power", "true_divide": "divide"}


class Untraceable(ValueError):
    """Exception for a callback that cannot be traced; the message says why."""


class Refusal(BaseException):
    """Exception that ends a callback that cannot be traced; `except Exception` in the callback does not catch it."""


class SymbolicObject:
    """Base class of Graph and ParameterTape, which record the operations of a callback while it is traced.

    is_tracing : whether a callback is being traced with symbols or Parameters of this record.
    refusal_reason : why the callback cannot be traced, stored because callbacks may catch exceptions; "": no reason.
    """

    is_tracing, refusal_reason = False, ""

    def refuse(self, reason: str) -> NoReturn:
        """Store the reason why a callback cannot be traced, and raise an exception that ends the callback."""
        if not self.is_tracing:
            raise Untraceable(reason)
        self.refusal_reason = self.refusal_reason or reason
        raise Refusal(reason)

    @contextmanager
    def running_callback(self) -> Iterator[None]:
        """Context manager for a call of a callback: afterwards, raise Untraceable if the callback caught a Refusal."""
        self.is_tracing, self.refusal_reason = True, ""
        try:
            yield
        finally:
            self.is_tracing = False
        if self.refusal_reason:
            raise Untraceable(f"{self.refusal_reason}, and catches the exception that says so")


class ParameterTape(SymbolicObject):
    """Record of how numbers were computed from parameters.

    Each number is a constant times a product of powers of atoms. Atoms are parameters, sums, and functions of numbers.

    values : values of all parameters during the trace; random for parameters that vary, see the module docstring.
    varying : indices of the parameters that vary; the others are constants.
    """

    def __init__(self, values: Sequence[float], varying: Iterable[int]):
        self.atoms: list[Any] = [None] * len(values)
        self._merged_products: dict[tuple[Powers, Powers], Powers] = {}  # keys: two factors; values: their product
        self._atom_indices: dict[Any, int] = {}
        self.parameters = np.empty(len(values), dtype=object)
        self.parameters[:] = [float(value) for value in values]
        for i in varying:
            self.parameters[i] = Parameter(float(values[i]), self, 1.0, ((i, 1.0),))

    def atom(self, definition: Any) -> Powers:
        """Return a sum or function as Powers; `definition`: ("sum", terms) or (function's name, arguments)."""
        if definition not in self._atom_indices:
            self._atom_indices[definition] = len(self.atoms)
            self.atoms.append(definition)
        return ((self._atom_indices[definition], 1.0),)

    def terms(self, number: float) -> dict[Powers, float]:
        """Return the terms whose sum is `number`; keys: products of powers; values: their coefficients."""
        if type(number) is not Parameter:
            return {(): number} if number else {}
        (i, exponent), *other_powers = number.powers
        definition = self.atoms[i]
        if other_powers or exponent != 1.0 or definition is None or definition[0] != "sum":
            return {number.powers: number.scale}
        return {powers: number.scale * c for powers, c in definition[1]}

    def number_evaluator(self, parameters: Array) -> Callable[[float], Any]:
        """Return a function that evaluates any float or Parameter for given `parameters`, see `product_evaluator`."""
        product = self.product_evaluator(parameters)
        return lambda number: number.scale * product(number.powers) if type(number) is Parameter else number

    def product_evaluator(self, parameters: Array) -> Callable[[Powers], Any]:
        """Return a function that evaluates Powers (products of powers of atoms: parameters, sums and functions).

        For `parameters` (n_p,) it returns a number, for (n_runs, n_p) an array (n_runs,). Empty Powers always give 1.0.
        """
        atoms: dict[int, Any] = {}
        products: dict[Powers, Any] = {(): 1.0}

        def product(powers: Powers) -> Any:
            if powers not in products:
                *first_powers, (index, exponent) = powers
                if first_powers:
                    products[powers] = product(tuple(first_powers)) * product(powers[-1:])
                else:
                    products[powers] = atom(index) if exponent == 1.0 else atom(index) ** exponent
            return products[powers]

        def atom(index: int) -> Any:
            if index not in atoms:
                definition = self.atoms[index]
                if definition is None:
                    atoms[index] = parameters.T[index]
                elif definition[0] == "sum":
                    atoms[index] = sum(c * product(powers) for powers, c in definition[1])
                else:
                    atoms[index] = FUNCTIONS[definition[0]](*(c * product(powers) for powers, c in definition[1]))
            return atoms[index]

        return product

    def evaluate(self, expressions: Sequence["Parameter"], parameters: Array) -> Array:
        """Return the values (n_runs, len(expressions)) of expressions, for `parameters` of shape (n_runs, n_p)."""
        product = self.product_evaluator(parameters)
        rows = {powers: k for k, powers in enumerate(dict.fromkeys(parameter.powers for parameter in expressions))}
        products = np.empty((len(rows), len(parameters)))
        with np.errstate(all="ignore"):
            for powers, k in rows.items():
                products[k] = product(powers)
            scales = np.array([[parameter.scale] for parameter in expressions]).reshape(-1, 1)
            values = scales * products[[rows[parameter.powers] for parameter in expressions]]
        return np.ascontiguousarray(values.T)


class Parameter(float):
    """Float that records its formula: a number (`scale`) times powers (`powers`) of parameters, sums and functions."""

    __slots__ = ("powers", "scale", "tape")
    tape: ParameterTape
    scale: float
    powers: Powers

    def __new__(cls, value: float, tape: ParameterTape, scale: float, powers: Powers) -> "Parameter":
        """Create a Parameter that belongs to a tape."""
        parameter = float.__new__(cls, value)
        parameter.tape, parameter.scale, parameter.powers = tape, scale, powers
        return parameter

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        name = NUMPY_NAMES.get(ufunc.__name__, ufunc.__name__)
        if method != "__call__" or name not in _OPERATIONS.keys() | FUNCTIONS.keys() or options:
            self._refuse_decision(f"it calls numpy.{ufunc.__name__} on its parameters")
            plain_inputs = (float(x) if type(x) is Parameter else x for x in inputs)
            return getattr(ufunc, method)(*plain_inputs, **options)
        return elementwise(lambda *arguments: apply_function(name, *arguments), inputs, out)

    def _refuse_decision(self, reason: str = "it branches on its parameters, or rounds them") -> None:
        """Refuse an operation that reveals a Parameter's value, unless a module of `twoloop.generate` calls it."""
        caller = sys._getframe(2).f_globals.get("__name__", "")
        if self.tape.is_tracing and not caller.startswith(__name__.rpartition(".")[0]):
            self.tape.refuse(reason)

    def to_power(self, exponent: float) -> "Parameter":
        """Return this number to the power `exponent`, a nonzero whole number."""
        powers = tuple([(atom, exponent * power) for atom, power in self.powers])
        return Parameter(_as_float(self) ** exponent, self.tape, self.scale**exponent, powers)

    def __neg__(self) -> "Parameter":
        return Parameter(-_as_float(self), self.tape, -self.scale, self.powers)

    def __pos__(self) -> "Parameter":
        return self

    def __abs__(self) -> Any:
        return apply_function("absolute", self)

    def __reduce_ex__(self, protocol: Any) -> Any:
        return float, (float(self),)

    def __copy__(self) -> "Parameter":
        return self

    def __deepcopy__(self, memo: Any) -> "Parameter":
        return self


def _sum(a: float, b: float) -> float:
    tape = _tape_of(a, b)
    terms, value = tape.terms(a), _as_float(a) + _as_float(b)
    for powers, c in tape.terms(b).items():
        total = terms.get(powers, 0.0) + c
        if abs(total) <= CANCELLATION_LIMIT * abs(c):
            terms.pop(powers, None)
        else:
            terms[powers] = total
    if len(terms) > MAX_TERMS:
        tape.refuse(f"it adds up more than {MAX_TERMS} terms of its parameters")
    if len(terms) < 2:
        ((powers, c),) = terms.items() or (((), 0.0),)
        return Parameter(value, tape, c, powers) if powers else c
    (_, scale), *_ = items = sorted(terms.items())
    return Parameter(value, tape, scale, tape.atom(("sum", tuple((powers, c / scale) for powers, c in items))))


def _product(a: float, b: float) -> float:
    if type(a) is not Parameter:
        a, b = b, a
    assert isinstance(a, Parameter)
    tape = a.tape
    if type(b) is not Parameter:
        if b == 1.0:
            return a
        return Parameter(_as_float(a) * b, tape, a.scale * b, a.powers) if b else 0.0
    scale, pair = a.scale * b.scale, (a.powers, b.powers)
    merged = tape._merged_products.get(pair)
    if merged is None:
        powers = dict(a.powers)
        for atom, exponent in b.powers:
            powers[atom] = powers.get(atom, 0.0) + exponent
        merged = tape._merged_products[pair] = tuple(sorted(factor for factor in powers.items() if factor[1]))
    return Parameter(_as_float(a) * _as_float(b), tape, scale, merged) if merged else scale


def _power(base: float, exponent: float) -> float:
    # a power with a fractional exponent becomes an atom: (x^2)^0.5 is |x|, but the product of exponents would yield x
    if type(exponent) is Parameter or not exponent.is_integer():
        return _record_function("power", base, exponent)
    assert isinstance(base, Parameter)
    return base.to_power(exponent) if exponent else 1.0


_OPERATIONS: dict[str, Callable[[float, float], float]] = {
    "add": _sum,
    "subtract": lambda a, b: _sum(a, -b),
    "multiply": _product,
    "divide": lambda a, b: _product(a, b.to_power(-1.0) if type(b) is Parameter else 1.0 / b),
    "power": _power,
}


def _tape_of(*numbers: float) -> ParameterTape:
    return next(number.tape for number in numbers if type(number) is Parameter)


def apply_function(name: str, *arguments: Any) -> Any:
    """Call a function of NumPy or `math` by its name; the result is a Parameter if an argument is a Parameter."""
    name = NUMPY_NAMES.get(name, name)
    if any(not issubclass(type(x), NUMBER_TYPES) for x in arguments):  # let symbols use their own operators
        return OPERATORS[name](*arguments)
    numbers = [x if type(x) is Parameter else float(x) for x in arguments]
    if not any(type(x) is Parameter for x in numbers):
        return float(getattr(np, name)(*numbers))
    if name in _OPERATIONS:
        return _OPERATIONS[name](*numbers)
    return _record_function(name, *numbers)


def _record_function(name: str, *numbers: float) -> Parameter:
    tape = _tape_of(*numbers)
    arguments = tuple((x.powers, x.scale) if isinstance(x, Parameter) else ((), x) for x in numbers)
    with np.errstate(all="ignore"):  # at the random values of the arguments, the function may be undefined
        value = float(FUNCTIONS[name](*map(float, numbers)))
    return Parameter(value, tape, 1.0, tape.atom((name, arguments)))


def _binary_operator(name: str, swapped: bool) -> Callable[[Parameter, Any], Any]:
    operation = _OPERATIONS[name]

    def apply_operator(self: Parameter, other: Any) -> Any:
        if type(other) is float or type(other) is Parameter:
            return operation(other, self) if swapped else operation(self, other)
        pair = (other, self) if swapped else (self, other)
        if issubclass(type(other), np.ndarray):
            return self.__array_ufunc__(getattr(np, name), "__call__", *pair)
        if not issubclass(type(other), NUMBER_TYPES):  # symbols refuse isinstance()
            return NotImplemented
        return operation(*(x if type(x) is Parameter else float(x) for x in pair))

    return apply_operator


def _refusing_method(name: str) -> Callable[..., Any]:
    float_method = getattr(float, name)

    def refuse_and_call(self: Parameter, *others: Any) -> Any:
        self._refuse_decision()
        return float_method(self, *others)

    return refuse_and_call


_REFUSED_METHODS = ("bool", "int", "float", "trunc", "floor", "ceil", "round", "lt", "le", "gt", "ge", "eq", "ne")
for _name in (*_REFUSED_METHODS, "mod", "rmod", "floordiv", "rfloordiv", "divmod", "rdivmod"):
    setattr(Parameter, f"__{_name}__", _refusing_method(f"__{_name}__"))
Parameter.__hash__ = float.__hash__  # type: ignore[method-assign]  # although `__eq__` was replaced above
for _symbol, _name in {"add": "add", "sub": "subtract", "mul": "multiply", "truediv": "divide", "pow": "power"}.items():
    setattr(Parameter, f"__{_symbol}__", _binary_operator(_name, False))
    setattr(Parameter, f"__r{_symbol}__", _binary_operator(_name, True))
for _name in _UNARY_FUNCTIONS:
    # np.sin of an array of objects calls the method `sin` of each object; np.cos calls `cos`, and so on
    setattr(Parameter, _name, lambda self, name=_name: apply_function(name, self))


def elementwise(function: Callable[..., Any], inputs: Iterable[Any], out: Any = None) -> Any:
    """Apply a function to the entries of arrays, as a ufunc does; return the results, in out[0] if `out` is given."""
    operands = list(map(_object_array, inputs))
    results = np.frompyfunc(function, len(operands), 1)(*operands)
    if out is None:
        return results
    out[0][...] = results
    return out[0]


def _object_array(value: Any) -> Any:
    # call type(), because symbols refuse isinstance()
    if issubclass(type(value), np.ndarray):
        return value.astype(object)
    array = np.empty((), dtype=object)
    array[()] = float(value) if issubclass(type(value), np.generic) else value
    return array


def number_array(values: Iterable[float]) -> Any:
    """Return an array of floats, or of objects if some values are Parameters."""
    values = list(values)
    return np.array(values, dtype=object if any(type(value) is Parameter for value in values) else float)


def as_number(value: Any) -> float:
    """Return a number as a float, or unchanged if it is a Parameter."""
    return value if type(value) is Parameter else float(value)


def math_function(name: str) -> Callable[[float], float]:
    """Return the function `name` of `math`, extended: if the argument is a Parameter, the result is a Parameter."""
    function = getattr(math, name)
    return lambda x: apply_function(name, x) if type(x) is Parameter else function(x)

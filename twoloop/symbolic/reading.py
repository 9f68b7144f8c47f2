"""Conversion of the user's expressions to plain symbols, with checks for unsupported terms."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import sympy
from sympy import Derivative, Expr, Symbol
from sympy.core.function import AppliedUndef
from sympy.core.relational import Equality

from twoloop.checks.arguments import check_finite, check_number
from twoloop.symbolic.differentiation import Differentiation
from twoloop.symbolic.printing import FUNCTIONS

SMOOTH = (sympy.Add, sympy.Mul, sympy.Pow, sympy.Number, sympy.NumberSymbol, *FUNCTIONS)
NOT_SMOOTH = (sympy.Abs, sympy.sign, sympy.Heaviside, sympy.DiracDelta, sympy.Piecewise, sympy.Max, sympy.Min)
POSITIONS, VELOCITIES = "positions", "velocities"  # permitted dependence, besides t and the parameters


class Reader:
    """Replaces coordinates, velocities, speeds, time and parameters by the symbols of the generated code.

    Parameters
    ----------
    coordinates : sequence
        Functions of time, as created by `dynamicsymbols`.
    parameters : mapping
        Values by symbol.
    speeds : mapping
        Generalised speeds (functions of time) as expressions in the coordinates and their derivatives.

    Attributes
    ----------
    names : tuple of str
        Names of the coordinates.
    values : dict
        Values of the parameters by name, in the order of `p`.
    t, q, v, p : symbols
        Symbols of the generated code.
    differentiation : Differentiation
        Derivatives of expressions in these symbols.
    """

    def __init__(self, coordinates: Any, parameters: Any, speeds: Mapping[Any, Any] | None = None):
        functions = sequence("coordinates", coordinates)
        self.time = _time_of(functions)
        self.names = tuple(str(each.func) for each in functions)
        self.values = _values_of(parameters, self.time)
        symbols = list(parameters or ())
        n = len(functions)
        self.t = Symbol("t")
        self.q = [Symbol(f"q{i}") for i in range(n)]
        self.v = [Symbol(f"v{i}") for i in range(n)]
        self.p = [Symbol(f"p{i}") for i in range(len(symbols))]
        self.differentiation = Differentiation()
        self._velocities = {Derivative(each, self.time): v for each, v in zip(functions, self.v, strict=True)}
        self._known = {self.time: self.t}
        self._known |= dict(zip(functions, self.q, strict=True)) | dict(zip(symbols, self.p, strict=True))
        self.speeds: dict[Any, Expr] = {}
        self.speeds = {u: self.read(f"speeds[{u}]", each, VELOCITIES) for u, each in (speeds or {}).items()}

    def read(self, argument: str, expression: Any, depends: str) -> Expr:
        """Return an expression in plain symbols.

        Raises
        ------
        TypeError, ValueError
            If it is not an expression, or contains an unknown symbol, a velocity that is not permitted, an
            acceleration, or a function that is not smooth.
        """
        expression = _sympified(argument, expression)
        self._check(argument, expression, depends)
        return expression.xreplace(self._known | self._velocities | self.speeds)

    def read_all(self, argument: str, expressions: Any, depends: str) -> list[Expr]:
        """Return a list of expressions in plain symbols."""
        given = sequence(argument, expressions)
        return [self.read(f"{argument}[{i}]", each, depends) for i, each in enumerate(given)]

    def _check(self, argument: str, expression: Expr, depends: str) -> None:
        waiting, seen = [expression], set()
        while waiting:
            node = waiting.pop()
            if node in seen or node in self._known:
                continue
            seen.add(node)
            if isinstance(node, (Derivative, AppliedUndef)):
                self._check_function(argument, node, depends)
            elif isinstance(node, Symbol):
                raise ValueError(self._unknown(argument, node))
            elif isinstance(node, NOT_SMOOTH):
                raise ValueError(
                    f"{argument} must be smooth; given {node}. Smooth it, such as sign(x) to tanh(x / small), or let "
                    "an event end the run where it switches"
                )
            elif not isinstance(node, SMOOTH) or (node.is_Number and not node.is_finite):
                known = ", ".join(sorted(each.__name__ for each in FUNCTIONS))
                raise ValueError(f"{argument} must be made of real numbers, powers and {known}; given {node}")
            else:
                waiting.extend(node.args)

    def _check_function(self, argument: str, node: Expr, depends: str) -> None:
        if node in self._velocities or node in self.speeds:
            if depends == POSITIONS:
                raise ValueError(
                    f"{argument} may depend on coordinates and time only; given the velocity {node}. Constraints on "
                    "velocities go into nonholonomic=, forces that depend on them into forces= or dissipation="
                )
            return
        if isinstance(node, Derivative):
            if node.expr in self._known or node.expr in self.speeds:
                raise ValueError(
                    f"{argument} may not depend on accelerations; given {node}. They are what is solved for"
                )
            node = node.expr
        raise ValueError(
            f"{argument} depends on {node}, which is not among the coordinates {', '.join(self.names)}; name it there, "
            "or put the formula of a given motion in its place"
        )

    def _unknown(self, argument: str, symbol: Symbol) -> str:
        twin = symbol.name in self.values
        return f"{argument} depends on {symbol}, which is neither a coordinate nor one of the parameters" + (
            ": the symbol of that name there has other assumptions (real, positive); use one and the same"
            if twin
            else f"; give parameters={{..., {symbol}: value}}"
        )


def sequence(argument: str, given: Any) -> list[Any]:
    """Return the entries of a list, a tuple or a matrix of one column."""
    if given is None:
        return []
    if isinstance(given, sympy.MatrixBase):
        return list(given)
    if isinstance(given, (str, Mapping, Expr)) or not isinstance(given, Iterable):
        raise TypeError(f"{argument} must be a list of SymPy expressions; given {given!r}")
    return list(given)


def square(argument: str, given: Any, n: int) -> sympy.MatrixBase:
    """Return a matrix (n, n) of expressions."""
    try:
        matrix = sympy.ImmutableMatrix(given)
    except Exception:  # SymPy raises TypeError, ValueError and others
        raise TypeError(f"{argument} must be a SymPy matrix of shape ({n}, {n}); given {given!r}") from None
    if matrix.shape != (n, n):
        raise ValueError(f"{argument} must have shape ({n}, {n}), a row and a column a speed; given {matrix.shape}")
    return matrix


def column(argument: str, given: Any, n: int, each: str) -> list[Any]:
    """Return a list of n expressions."""
    entries = sequence(argument, given)
    if len(entries) != n:
        raise ValueError(f"{argument} must have {n} entries, one for each {each}; given {len(entries)}")
    return entries


def _time_of(coordinates: Sequence[Any]) -> Symbol:
    if not coordinates:
        raise ValueError("coordinates must name at least one; given none")
    for each in coordinates:
        if not isinstance(each, AppliedUndef) or len(each.args) != 1 or not isinstance(each.args[0], Symbol):
            raise TypeError(
                "coordinates must be functions of time, as sympy.physics.mechanics.dynamicsymbols makes them; given "
                f"{each!r}"
            )
    times = {each.args[0] for each in coordinates}
    if len(times) > 1:
        raise ValueError(f"coordinates must be functions of one time; given {', '.join(sorted(map(repr, times)))}")
    if len({str(each) for each in coordinates}) < len(coordinates):
        raise ValueError(f"coordinates must differ in their names; given {', '.join(map(str, coordinates))}")
    return times.pop()


def _values_of(parameters: Any, time: Symbol) -> dict[str, float]:
    if parameters is not None and not isinstance(parameters, Mapping):
        raise TypeError(f"parameters must map symbols to numbers; given {parameters!r}")
    values: dict[str, float] = {}
    for symbol, value in (parameters or {}).items():
        if not isinstance(symbol, Symbol) or symbol == time:
            raise TypeError(f"parameters must have SymPy symbols other than the time as keys; given {symbol!r}")
        if symbol.name in values:
            raise ValueError(f"parameters must have different names; given two called {symbol.name}")
        values[symbol.name] = number(f"parameters[{symbol}]", value)
    return values


def number(argument: str, value: Any) -> float:
    """Return a finite number, also from SymPy numbers."""
    if isinstance(value, sympy.Number) and value.is_real:
        value = float(value)
    return check_finite(argument, check_number(argument, value))


def _sympified(argument: str, expression: Any) -> Expr:
    if isinstance(expression, Equality):
        raise TypeError(f"{argument} must be an expression that is zero; given {expression}: write lhs - rhs")
    if isinstance(expression, (str, bool)):
        raise TypeError(f"{argument} must be a SymPy expression; given {expression!r}")
    try:
        expression = sympy.sympify(expression, strict=True)
    except sympy.SympifyError:
        raise TypeError(f"{argument} must be a SymPy expression; given {expression!r}") from None
    if not isinstance(expression, Expr):
        raise TypeError(f"{argument} must be a SymPy expression; given {expression!r}")
    return expression.doit()  # evaluates unevaluated derivatives

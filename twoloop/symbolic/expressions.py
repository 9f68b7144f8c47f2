"""Convert the user's expressions to plain symbols, differentiate them, and write the code of the equations of motion.

`Expr.diff` traverses a sum of products again for every derivative, which takes ten times as long for a chain of ten
links.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sympy
from sympy import Derivative, Expr, Symbol
from sympy.core.function import AppliedUndef
from sympy.core.relational import Equality
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pycode import PythonCodePrinter

from twoloop.checks.arguments import check_finite, check_number
from twoloop.kernels.compile.callbacks import KINDS

# supported functions of SymPy; they have the same names in math
FUNCTIONS = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
    *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.exp, sympy.log),
)
SMOOTH = (sympy.Add, sympy.Mul, sympy.Pow, sympy.Number, sympy.NumberSymbol, *FUNCTIONS)
NOT_SMOOTH = (sympy.Abs, sympy.sign, sympy.Heaviside, sympy.DiracDelta, sympy.Piecewise, sympy.Max, sympy.Min)
POSITIONS, VELOCITIES = "positions", "velocities"  # permitted dependence, besides t and the parameters


class Reader:
    """Replace coordinates, velocities, speeds, time and parameters by t, q, v and p, symbols of the generated code.

    `coordinates`: functions of time, as created by `dynamicsymbols`. `parameters`: values by symbol. `speeds`:
    generalised speeds (functions of time) as expressions in the coordinates and their derivatives.
    """

    def __init__(self, coordinates: Any, parameters: Any, speeds: Mapping[Any, Any] | None = None):
        functions = as_list("coordinates", coordinates)
        self.time = _time_symbol(functions)
        self.names = tuple(str(function.func) for function in functions)
        self.values = _parameter_values(parameters, self.time)
        symbols = list(parameters or ())
        n = len(functions)
        self.t = Symbol("t")
        self.q = [Symbol(f"q{i}") for i in range(n)]
        self.v = [Symbol(f"v{i}") for i in range(n)]
        self.p = [Symbol(f"p{i}") for i in range(len(symbols))]
        self.differentiation = Differentiation()
        self._velocities = {Derivative(function, self.time): v for function, v in zip(functions, self.v, strict=True)}
        self._symbols = {self.time: self.t}
        self._symbols |= dict(zip(functions, self.q, strict=True)) | dict(zip(symbols, self.p, strict=True))
        self.speeds: dict[Any, Expr] = {}
        self.speeds = {u: self.read(f"speeds[{u}]", function, VELOCITIES) for u, function in (speeds or {}).items()}

    def read(self, argument: str, expression: Any, depends: str) -> Expr:
        """Return an expression in plain symbols.

        Raise TypeError or ValueError if it is not an expression, or contains an unknown symbol, a velocity that is not
        permitted, an acceleration, or a function that is not smooth.
        """
        expression = _sympified(argument, expression)
        self._check(argument, expression, depends)
        return expression.xreplace(self._symbols | self._velocities | self.speeds)

    def read_all(self, argument: str, expressions: Any, depends: str) -> list[Expr]:
        """Return a list of expressions in plain symbols."""
        entries = as_list(argument, expressions)
        return [self.read(f"{argument}[{i}]", entry, depends) for i, entry in enumerate(entries)]

    def _check(self, argument: str, expression: Expr, depends: str) -> None:
        pending, visited = [expression], set()
        while pending:
            node = pending.pop()
            if node in visited or node in self._symbols:
                continue
            visited.add(node)
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
                names = ", ".join(sorted(function.__name__ for function in FUNCTIONS))
                raise ValueError(f"{argument} must be made of real numbers, powers and {names}; given {node}")
            else:
                pending.extend(node.args)

    def _check_function(self, argument: str, node: Expr, depends: str) -> None:
        if node in self._velocities or node in self.speeds:
            if depends == POSITIONS:
                raise ValueError(
                    f"{argument} may depend on coordinates and time only; given the velocity {node}. Constraints on "
                    "velocities go into nonholonomic=, forces that depend on them into forces= or dissipation="
                )
            return
        if isinstance(node, Derivative):
            if node.expr in self._symbols or node.expr in self.speeds:
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


def as_list(argument: str, given: Any) -> list[Any]:
    """Return the entries of a list, a tuple or a matrix of one column."""
    if given is None:
        return []
    if isinstance(given, sympy.MatrixBase):
        return list(given)
    if isinstance(given, (str, Mapping, Expr)) or not isinstance(given, Iterable):
        raise TypeError(f"{argument} must be a list of SymPy expressions; given {given!r}")
    return list(given)


def as_matrix(argument: str, given: Any, n: int) -> sympy.MatrixBase:
    """Return a matrix (n, n) of expressions."""
    try:
        matrix = sympy.ImmutableMatrix(given)
    except Exception:  # SymPy raises TypeError, ValueError and others
        raise TypeError(f"{argument} must be a SymPy matrix of shape ({n}, {n}); given {given!r}") from None
    if matrix.shape != (n, n):
        raise ValueError(f"{argument} must have shape ({n}, {n}), a row and a column a speed; given {matrix.shape}")
    return matrix


def as_column(argument: str, given: Any, n: int, meaning: str) -> list[Any]:
    """Return a list of n expressions."""
    entries = as_list(argument, given)
    if len(entries) != n:
        raise ValueError(f"{argument} must have {n} entries, one for each {meaning}; given {len(entries)}")
    return entries


def _time_symbol(coordinates: Sequence[Any]) -> Symbol:
    if not coordinates:
        raise ValueError("coordinates must name at least one; given none")
    for coordinate in coordinates:
        if (
            not isinstance(coordinate, AppliedUndef)
            or len(coordinate.args) != 1
            or not isinstance(coordinate.args[0], Symbol)
        ):
            raise TypeError(
                "coordinates must be functions of time, as sympy.physics.mechanics.dynamicsymbols makes them; given "
                f"{coordinate!r}"
            )
    times = {coordinate.args[0] for coordinate in coordinates}
    if len(times) > 1:
        raise ValueError(f"coordinates must be functions of one time; given {', '.join(sorted(map(repr, times)))}")
    if len({str(coordinate) for coordinate in coordinates}) < len(coordinates):
        raise ValueError(f"coordinates must differ in their names; given {', '.join(map(str, coordinates))}")
    return times.pop()


def _parameter_values(parameters: Any, time: Symbol) -> dict[str, float]:
    if parameters is not None and not isinstance(parameters, Mapping):
        raise TypeError(f"parameters must map symbols to numbers; given {parameters!r}")
    values: dict[str, float] = {}
    for symbol, value in (parameters or {}).items():
        if not isinstance(symbol, Symbol) or symbol == time:
            raise TypeError(f"parameters must have SymPy symbols other than the time as keys; given {symbol!r}")
        if symbol.name in values:
            raise ValueError(f"parameters must have different names; given two called {symbol.name}")
        values[symbol.name] = as_number(f"parameters[{symbol}]", value)
    return values


def as_number(argument: str, value: Any) -> float:
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


ZERO, ONE = sympy.S.Zero, sympy.S.One

Entries = dict[Any, Expr]  # nonzero entries of an array by index


class Differentiation:
    """Differentiate expressions in plain symbols with memoisation."""

    def __init__(self) -> None:
        self._symbols: dict[Expr, frozenset[Symbol]] = {}
        self._derivatives: dict[tuple[Expr, Symbol], Expr] = {}

    def symbols_of(self, expression: Expr) -> frozenset[Symbol]:
        """Return the symbols on which an expression depends."""
        if expression.is_Symbol:
            return frozenset((expression,))
        symbols = self._symbols.get(expression)
        if symbols is None:
            symbols = frozenset().union(*map(self.symbols_of, expression.args))
            self._symbols[expression] = symbols
        return symbols

    def derivative(self, expression: Expr, symbol: Symbol) -> Expr:
        """Return the derivative of an expression with respect to a symbol."""
        if expression == symbol:
            return ONE
        if symbol not in self.symbols_of(expression):
            return ZERO
        result = self._derivatives.get((expression, symbol))
        if result is None:
            result = self._derivatives[expression, symbol] = self._derive(expression, symbol)
        return result

    def _derive(self, expression: Expr, symbol: Symbol) -> Expr:
        args = expression.args
        dependent = [(i, argument) for i, argument in enumerate(args) if symbol in self.symbols_of(argument)]
        if expression.is_Add:
            return sympy.Add(*(self.derivative(argument, symbol) for _, argument in dependent))
        if expression.is_Mul:
            return sympy.Add(
                *(sympy.Mul(*args[:i], self.derivative(argument, symbol), *args[i + 1 :]) for i, argument in dependent)
            )
        if expression.is_Pow:
            base, exponent = args
            base_term = exponent * base ** (exponent - 1) * self.derivative(base, symbol)
            return base_term + expression * sympy.log(base) * self.derivative(exponent, symbol)
        return sympy.Add(*(expression.fdiff(i + 1) * self.derivative(argument, symbol) for i, argument in dependent))

    def jacobian(self, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Entries:
        """Return the entries (i, j) of the Jacobian of expressions with respect to symbols."""
        columns = {symbol: j for j, symbol in enumerate(symbols)}
        return nonzero(
            ((i, j), self.derivative(expression, symbol))
            for i, expression in enumerate(expressions)
            for symbol, j in columns.items()
            if symbol in self.symbols_of(expression)
        )

    def hessian(self, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Entries:
        """Return the same for a gradient: the symmetric entries of the Hessian are computed once."""
        upper = nonzero(
            ((i, j), self.derivative(expression, symbols[j]))
            for i, expression in enumerate(expressions)
            for j in range(i, len(symbols))
        )
        return upper | {(j, i): entry for (i, j), entry in upper.items()}


def nonzero(entries: Iterable[tuple[Any, Expr]]) -> Entries:
    """Return the nonzero entries."""
    return {index: entry for index, entry in entries if entry != 0}


MAX_FACTORS = 4  # integer powers up to this are written as products


@dataclass(frozen=True)
class Equations:
    """M a + C_q^T lam + A^T mu = Q with C(t, q) = 0 and A v + b = 0."""

    symbols: Reader  # the symbols of the expressions
    M: sympy.MatrixBase  # mass matrix, independent of the velocities; the upper triangle is used
    Q: Sequence[Expr]  # generalised forces
    C: Sequence[Expr]  # position constraints
    W: Sequence[Expr]  # non-holonomic constraints A v + b, linear in v
    energy: Expr
    conserved: bool  # whether the energy is an invariant

    @property
    def constant_mass(self) -> bool:
        """Return True if M depends neither on t nor on q."""
        moving = {self.symbols.t, *self.symbols.q}
        return not any(entry.free_symbols & moving for entry in self.M)

    def source(self, tangents: bool) -> str:
        """Return the generated code: a function for each callback, and the energy."""
        tangents = tangents and not self.W  # not supported with non-holonomic rows
        arrays = self._callbacks() | (self._tangents() if tangents else {})
        constant = self.constant_mass
        bandwidth = self._bandwidth() if constant else None
        parts = [f"CONSTANT_MASS = {constant}\nBANDWIDTH = {bandwidth}\nCONSERVED = {self.conserved}\n"]
        parts += [callback_source(kind, entries) for kind, entries in arrays.items()]
        return "\n\n".join([*parts, energy_source(self.energy)])

    def _bandwidth(self) -> int:
        """Return the largest distance of two coordinates coupled by M, the force or a constraint."""
        x, d = self.symbols, self.symbols.differentiation
        columns = {symbol: j for symbols in (x.q, x.v) for j, symbol in enumerate(symbols)}
        entries = [*enumerate(self.Q), *((j, entry) for (_, j), entry in d.jacobian(self.C, x.q).items())]
        pairs = [(i, columns[symbol]) for i, entry in entries for symbol in d.symbols_of(entry) & set(columns)]
        pairs += [divmod(k, self.M.cols) for k, entry in enumerate(self.M) if entry != 0]
        return max((abs(i - j) for i, j in pairs), default=0)

    def _callbacks(self) -> dict[str, list[Entries]]:
        x, d, n = self.symbols, self.symbols.differentiation, range(len(self.symbols.q))
        arrays = {
            "mass": [nonzero(((i, j), self.M[min(i, j), max(i, j)]) for i in n for j in n)],
            "force": [nonzero(enumerate(self.Q))],
        }
        if self.C:
            jacobian, rate = d.jacobian(self.C, x.q), [d.derivative(entry, x.t) for entry in self.C]
            speeds = [rate[i] + sum(jacobian.get((i, j), ZERO) * x.v[j] for j in n) for i in range(len(self.C))]
            C, Ct, Qd = (nonzero(enumerate(entries)) for entries in (self.C, rate, gamma_terms(speeds, x)))
            arrays |= {"constraint": [C], "jacobian": [jacobian]} | ({"constraint_rate": [Ct]} if Ct else {})
            arrays |= {"gamma": [Qd], "kinematics": [C, jacobian, Ct, Qd]}
        if self.W:
            at_rest = dict.fromkeys(x.v, ZERO)
            b = nonzero((i, entry.xreplace(at_rest)) for i, entry in enumerate(self.W))
            arrays |= {"nonholonomic": [d.jacobian(self.W, x.v)]} | ({"nonholonomic_rate": [b]} if b else {})
            arrays["nonholonomic_gamma"] = [nonzero(enumerate(gamma_terms(self.W, x)))]
        return arrays

    def _tangents(self) -> dict[str, list[Entries]]:
        x, d, n = self.symbols, self.symbols.differentiation, range(len(self.symbols.q))
        arrays = {"force_by_q": [d.jacobian(self.Q, x.q)]}
        by_v = d.jacobian(self.Q, x.v)
        if by_v:
            arrays["force_by_v"] = [by_v]
        if self.C:
            lam, jacobian = [Symbol(f"lam{k}") for k in range(len(self.C))], d.jacobian(self.C, x.q)
            reaction = [sympy.Add(*(lam[k] * jacobian.get((k, i), ZERO) for k in range(len(lam)))) for i in n]
            arrays["reaction_by_q"] = [d.hessian(reaction, x.q)]
        return arrays


def time_derivatives(expressions: Sequence[Expr], x: Reader) -> list[Expr]:
    """Return the time derivatives of expressions without the terms in the accelerations."""
    rates: list[list[Expr]] = [[x.differentiation.derivative(expression, x.t)] for expression in expressions]
    for (i, j), entry in x.differentiation.jacobian(expressions, x.q).items():
        rates[i].append(entry * x.v[j])
    return [sympy.Add(*terms) for terms in rates]


def gamma_terms(expressions: Sequence[Expr], x: Reader) -> list[Expr]:
    """Return the right-hand side of the acceleration equations that keep expressions in q and v constant."""
    return [-rate for rate in time_derivatives(expressions, x)]


def velocity_coefficients(argument: str, expressions: Sequence[Expr], x: Reader) -> Entries:
    """Return the derivatives with respect to the velocities; raise ValueError unless these are constant in v."""
    rows, velocities = x.differentiation.jacobian(expressions, x.v), set(x.v)
    for (i, j), entry in rows.items():
        if x.differentiation.symbols_of(entry) & velocities:
            rows[i, j] = entry.expand()
            if rows[i, j].free_symbols & velocities:
                raise ValueError(
                    f"{argument}[{i}] must be linear in the velocities; its derivative by that of {x.names[j]} depends "
                    "on velocities"
                )
    return nonzero(rows.items())


class _Printer(PythonCodePrinter):
    """Print expressions with the functions of `math` or `np`; all numbers are floats, but for integer exponents."""

    def __init__(self, module: str):
        names = {function.__name__: function.__name__ for function in FUNCTIONS}
        if module == "np":  # numpy 1 has arccos, not acos
            names = {name: re.sub("^a", "arc", name) for name in names}
        self._module = module
        # to sort the terms of long sums would take seconds
        own = {name: f"{module}.{function}" for name, function in names.items()}
        super().__init__({"order": "none", "user_functions": own})

    def _print(self, expr: Expr, **options: Any) -> str:
        number = expr.is_Number or expr.is_NumberSymbol
        return repr(float(expr)) if number else str(super()._print(expr, **options))

    def parenthesize(self, item: Expr, level: float, strict: bool = False) -> str:
        """Print an operand; SymPy would put parentheses around positive fractions, too."""
        is_plain = item.is_Number and item >= 0
        return self._print(item) if is_plain else str(super().parenthesize(item, level, strict))

    def _print_Pow(self, expr: Expr, rational: bool = False) -> str:
        base, exponent = expr.args
        text, power = self.parenthesize(base, PRECEDENCE["Pow"]), exponent
        if exponent.is_Rational and exponent < 0:
            return f"1.0/{self.parenthesize(base**-exponent, PRECEDENCE['Pow'])}"
        if exponent == sympy.S.Half:
            return f"{self._module}.sqrt({self._print(base)})"
        if not exponent.is_Integer:
            power = self.parenthesize(exponent, PRECEDENCE["Pow"])
        elif base.is_Symbol and exponent <= MAX_FACTORS:
            return f"({'*'.join([text] * int(exponent))})"
        return f"{text}**{power}"


def callback_source(kind: str, arrays: Sequence[Entries]) -> str:
    """Return the source of a callback that fills the arrays of its kind, which are initially zero."""
    callback = KINDS[kind]
    targets = [
        (f"{name}[{', '.join(map(str, index)) if isinstance(index, tuple) else index}]", expression)
        for (name, _), entries in zip(callback.outputs, arrays, strict=True)
        for index, expression in entries.items()
    ]
    lines, values = _evaluate([expression for _, expression in targets], _Printer("math"))
    stores: dict[str, list[str]] = {}
    for (target, _), value in zip(targets, values, strict=True):
        stores.setdefault(value, []).append(target)
    lines += [f"{' = '.join(same)} = {value}" for value, same in stores.items()]
    return _function(kind, callback.arguments, lines)


def energy_source(energy: Expr) -> str:
    """Return the source of energy(t, q, v, p), for one state or for many given as columns."""
    lines, values = _evaluate([energy], _Printer("np"))
    return _function("energy", ("t", "q", "v", "p"), [*lines, f"return {values[0]}"])


def _function(name: str, arguments: Sequence[str], lines: Sequence[str]) -> str:
    return "\n    ".join([f"def {name}({', '.join(arguments)}):", *(lines or ["pass"])]) + "\n"


def _evaluate(expressions: list[Expr], printer: _Printer) -> tuple[list[str], list[str]]:
    """Return lines that evaluate common subexpressions, and the expressions in terms of these."""
    shared, reduced = sympy.cse(expressions, symbols=sympy.numbered_symbols("x", cls=Symbol), order="none", list=True)
    used = set().union(*(expression.free_symbols for expression in [*reduced, *(value for _, value in shared)]), set())
    loads = [
        f"{name}{number} = {name}[{number}]"
        for name, number in sorted(map(_name_and_number, used))
        if number >= 0 and name != "x"
    ]
    lines = [f"{symbol} = {printer.doprint(value)}" for symbol, value in shared]
    return loads + lines, [printer.doprint(expression) for expression in reduced]


def _name_and_number(symbol: Symbol) -> tuple[str, int]:
    """Split a symbol such as q3; -1 stands for no number."""
    name = symbol.name.rstrip("0123456789")
    return name, int(symbol.name[len(name) :] or -1)

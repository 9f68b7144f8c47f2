"""Equations of motion in plain symbols, with all derivatives that the callbacks need, and their code."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from twoloop.kernels.compile.callbacks import KINDS
from twoloop.symbolic.expressions import FUNCTIONS, ZERO, Entries, Reader, nonzero

MAX_FACTORS = 4  # integer powers up to this are written as products


@dataclass(frozen=True)
class Equations:
    """M a + C_q^T lam + A^T mu = Q with C(t, q) = 0 and A v + b = 0.

    Attributes
    ----------
    symbols : Reader
        The symbols of the expressions.
    M : matrix (n_q, n_q)
        Mass matrix, independent of the velocities; the upper triangle is used.
    Q : sequence (n_q,)
        Generalised forces.
    C : sequence (n_c,)
        Position constraints.
    W : sequence (n_a,)
        Non-holonomic constraints A v + b, linear in v.
    energy : expression
    conserved : bool
        True if the energy is an invariant.
    """

    symbols: Reader
    M: sympy.MatrixBase
    Q: Sequence[Expr]
    C: Sequence[Expr]
    W: Sequence[Expr]
    energy: Expr
    conserved: bool

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


class _Printer:
    """Print expressions with the functions of `math` or `np`; all numbers are floats."""

    def __init__(self, module: str):
        self.module = module
        names = {function: function.__name__ for function in FUNCTIONS}
        if module == "np":  # numpy 1 has arccos, not acos
            names = {function: re.sub("^a", "arc", name) for function, name in names.items()}
        self.functions = {function: f"{module}.{name}" for function, name in names.items()}

    def sum(self, expression: Expr) -> str:
        """Print an expression that stands alone or is an argument."""
        text = ""
        for term in sympy.Add.make_args(expression):
            negative = term.could_extract_minus_sign() and not term.is_Add
            part = self.product(-term if negative else term)
            text += (" - " if text else "-") + part if negative else (" + " if text else "") + part
        return text

    def product(self, expression: Expr) -> str:
        """Print an expression as a term of a sum."""
        above, below = [], []
        for factor in sympy.Mul.make_args(expression):
            if factor.is_Pow and factor.exp.is_Rational and factor.exp < 0:
                below.append(self.power(factor.base, -factor.exp))
            else:
                above.append(self.factor(factor))
        text = "*".join(above) or "1.0"
        if not below:
            return text
        return f"{text}/{below[0]}" if len(below) == 1 else f"{text}/({'*'.join(below)})"

    def factor(self, expression: Expr) -> str:
        """Print an expression as a factor of a product."""
        if expression.is_Symbol:
            return str(expression.name)
        if expression.is_Number or isinstance(expression, sympy.NumberSymbol):
            return repr(float(expression)) if expression >= 0 else f"({float(expression)!r})"
        if expression.is_Pow:
            negative = expression.exp.is_Rational and expression.exp < 0
            return f"({self.product(expression)})" if negative else self.power(expression.base, expression.exp)
        if expression.func in self.functions:
            return f"{self.functions[expression.func]}({', '.join(map(self.sum, expression.args))})"
        return f"({self.sum(expression)})"

    def power(self, base: Expr, exponent: Expr) -> str:
        """Print a power, parenthesised if necessary; small integer powers as products."""
        if exponent == sympy.S.Half:
            return f"{self.module}.sqrt({self.sum(base)})"
        text = self.factor(base)
        if not exponent.is_Integer:
            return f"({text}**{self.factor(exponent)})"
        if exponent == 1:
            return text
        if 1 < exponent <= MAX_FACTORS and base.is_Symbol:
            return f"({'*'.join([text] * int(exponent))})"
        return f"({text}**{int(exponent)})"


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
        f"{symbol} = {symbol.name[: -len(number)]}[{number}]"
        for symbol in sorted(used, key=_name_and_number)
        if (number := _number(symbol)) and symbol.name[0] != "x"
    ]
    lines = [f"{symbol} = {printer.sum(value)}" for symbol, value in shared]
    return loads + lines, [printer.sum(expression) for expression in reduced]


def _number(symbol: Symbol) -> str:
    return symbol.name.lstrip("abcdefghijklmnopqrstuvwxyz")


def _name_and_number(symbol: Symbol) -> tuple[str, int]:
    number = _number(symbol)
    return symbol.name[: len(symbol.name) - len(number)], int(number or 0)

"""Prints expressions as Python code; common subexpressions of the entries of a callback are evaluated once."""

import re
from collections.abc import Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

from twoloop.kernels.compile.callbacks import KINDS
from twoloop.symbolic.differentiation import Entries

# supported functions of SymPy; they have the same names in math
FUNCTIONS = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
    *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.exp, sympy.log),
)
MOST_FACTORS = 4  # integer powers up to this are written as products


class _Printer:
    """Prints expressions with the functions of `math` or `np`; all numbers are floats."""

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
        if 1 < exponent <= MOST_FACTORS and base.is_Symbol:
            return f"({'*'.join([text] * int(exponent))})"
        return f"({text}**{int(exponent)})"


def callback_source(kind: str, arrays: Sequence[Entries]) -> str:
    """Return the source of a callback that fills the arrays of its kind, which are initially zero."""
    entry = KINDS[kind]
    targets = [
        (f"{name}[{', '.join(map(str, place)) if isinstance(place, tuple) else place}]", expression)
        for (name, _), entries in zip(entry.outputs, arrays, strict=True)
        for place, expression in entries.items()
    ]
    lines, values = _evaluated([expression for _, expression in targets], _Printer("math"))
    stores: dict[str, list[str]] = {}
    for (target, _), value in zip(targets, values, strict=True):
        stores.setdefault(value, []).append(target)
    lines += [f"{' = '.join(same)} = {value}" for value, same in stores.items()]
    return _function(kind, entry.arguments, lines)


def energy_source(energy: Expr) -> str:
    """Return the source of energy(t, q, v, p), for one state or for many given as columns."""
    lines, values = _evaluated([energy], _Printer("np"))
    return _function("energy", ("t", "q", "v", "p"), [*lines, f"return {values[0]}"])


def _function(name: str, arguments: Sequence[str], lines: Sequence[str]) -> str:
    return "\n    ".join([f"def {name}({', '.join(arguments)}):", *(lines or ["pass"])]) + "\n"


def _evaluated(expressions: list[Expr], printer: _Printer) -> tuple[list[str], list[str]]:
    """Return lines that evaluate common subexpressions, and the expressions in terms of these."""
    shared, reduced = sympy.cse(expressions, symbols=_numbered(), order="none", list=True)
    used = set().union(*(each.free_symbols for each in [*reduced, *(value for _, value in shared)]), set())
    loads = [
        f"{symbol} = {symbol.name[: -len(number)]}[{number}]"
        for symbol in sorted(used, key=_place)
        if (number := _number(symbol)) and symbol.name[0] != "x"
    ]
    return loads + [f"{symbol} = {printer.sum(value)}" for symbol, value in shared], [
        printer.sum(each) for each in reduced
    ]


def _numbered() -> Any:
    return sympy.numbered_symbols("x", cls=Symbol)


def _number(symbol: Symbol) -> str:
    return symbol.name.lstrip("abcdefghijklmnopqrstuvwxyz")


def _place(symbol: Symbol) -> tuple[str, int]:
    number = _number(symbol)
    return symbol.name[: len(symbol.name) - len(number)], int(number or 0)

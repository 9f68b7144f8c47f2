"""Differentiation of expressions with common subexpressions: each subexpression is differentiated once.

`Expr.diff` traverses a sum of products again for every derivative, which takes ten times as long for a chain of ten
links.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

ZERO, ONE = sympy.S.Zero, sympy.S.One

Entries = dict[Any, Expr]  # nonzero entries of an array by index


class Differentiation:
    """Differentiates expressions in plain symbols with memoisation."""

    def __init__(self) -> None:
        self._symbols: dict[Expr, frozenset[Symbol]] = {}
        self._known: dict[tuple[Expr, Symbol], Expr] = {}

    def symbols_of(self, expression: Expr) -> frozenset[Symbol]:
        """Return the symbols on which an expression depends."""
        if expression.is_Symbol:
            return frozenset((expression,))
        found = self._symbols.get(expression)
        if found is None:
            found = frozenset().union(*map(self.symbols_of, expression.args))
            self._symbols[expression] = found
        return found

    def by(self, expression: Expr, symbol: Symbol) -> Expr:
        """Return the derivative of an expression with respect to a symbol."""
        if expression == symbol:
            return ONE
        if symbol not in self.symbols_of(expression):
            return ZERO
        found = self._known.get((expression, symbol))
        if found is None:
            found = self._known[expression, symbol] = self._new(expression, symbol)
        return found

    def _new(self, expression: Expr, symbol: Symbol) -> Expr:
        args = expression.args
        inner = [(i, each) for i, each in enumerate(args) if symbol in self.symbols_of(each)]
        if expression.is_Add:
            return sympy.Add(*(self.by(each, symbol) for _, each in inner))
        if expression.is_Mul:
            return sympy.Add(*(sympy.Mul(*args[:i], self.by(each, symbol), *args[i + 1 :]) for i, each in inner))
        if expression.is_Pow:
            base, exponent = args
            of_base = exponent * base ** (exponent - 1) * self.by(base, symbol)
            return of_base + expression * sympy.log(base) * self.by(exponent, symbol)
        return sympy.Add(*(expression.fdiff(i + 1) * self.by(each, symbol) for i, each in inner))

    def rows(self, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Entries:
        """Return the entries (i, j) of the Jacobian of expressions with respect to symbols."""
        places = {symbol: j for j, symbol in enumerate(symbols)}
        return filled(
            ((i, j), self.by(expression, symbol))
            for i, expression in enumerate(expressions)
            for symbol, j in places.items()
            if symbol in self.symbols_of(expression)
        )

    def symmetric(self, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Entries:
        """Return the same for a gradient: the symmetric entries of the Hessian are computed once."""
        upper = filled(
            ((i, j), self.by(expression, symbols[j]))
            for i, expression in enumerate(expressions)
            for j in range(i, len(symbols))
        )
        return upper | {(j, i): entry for (i, j), entry in upper.items()}


def filled(entries: Iterable[tuple[Any, Expr]]) -> Entries:
    """Return the nonzero entries."""
    return {place: entry for place, entry in entries if entry != 0}

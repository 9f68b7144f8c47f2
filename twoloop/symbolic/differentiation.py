"""Derivatives of expressions that share their parts: each part is differentiated once.

`Expr.diff` goes through a sum of products anew for every derivative; for a chain of ten links that takes ten times as
long.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

ZERO, ONE = sympy.S.Zero, sympy.S.One

Entries = dict[Any, Expr]  # place in an array to expression, zeros left out


class Differentiation:
    """Differentiates expressions in plain symbols, and remembers what it has seen."""

    def __init__(self) -> None:
        self._symbols: dict[Expr, frozenset[Symbol]] = {}
        self._known: dict[tuple[Expr, Symbol], Expr] = {}

    def symbols_of(self, expression: Expr) -> frozenset[Symbol]:
        """What an expression depends on."""
        if expression.is_Symbol:
            return frozenset((expression,))
        found = self._symbols.get(expression)
        if found is None:
            found = frozenset().union(*map(self.symbols_of, expression.args))
            self._symbols[expression] = found
        return found

    def by(self, expression: Expr, symbol: Symbol) -> Expr:
        """The derivative of an expression by a symbol."""
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
        """The entries (i, j) of the Jacobian of expressions by symbols."""
        places = {symbol: j for j, symbol in enumerate(symbols)}
        return filled(
            ((i, j), self.by(expression, symbol))
            for i, expression in enumerate(expressions)
            for symbol, j in places.items()
            if symbol in self.symbols_of(expression)
        )

    def symmetric(self, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Entries:
        """The same where the expressions are derivatives of one by the symbols: each pair of entries once."""
        upper = filled(
            ((i, j), self.by(expression, symbols[j]))
            for i, expression in enumerate(expressions)
            for j in range(i, len(symbols))
        )
        return upper | {(j, i): entry for (i, j), entry in upper.items()}


def filled(entries: Iterable[tuple[Any, Expr]]) -> Entries:
    """Entries that are not zero."""
    return {place: entry for place, entry in entries if entry != 0}

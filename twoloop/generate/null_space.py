"""Eliminate dependent coordinates from the equations of motion by the rows G a = gamma.

With G = [G_d G_i], a_d = g + B a_i for B = -G_d^-1 G_i and g = G_d^-1 gamma. The remaining system is small: (T^T M T)
a_i = T^T (Q - M g) with T = [B; 1]. It takes about half the operations of an elimination that begins with M, and M may
be singular in directions that the constraints exclude.

Pivots are fixed. If one becomes small during a run, the conditions fail, and other code has to compute a.
"""

from collections.abc import Iterator, Sequence
from typing import Any

from twoloop.generate.graph import Affine, is_zero
from twoloop.generate.symbolic_factors import Factors

Blocks = Sequence[tuple[tuple[int, ...], tuple[int, ...]]]  # rows and columns of the pivots, one or two each
Terms = dict[int, Affine]  # nonzero entries of a row, by their columns

# least square of: a pivot over the entries that it divides, or over its column; the sine between two columns. The
# accelerations lose up to three times as many digits. At a start the limits are stricter, see
# linalg/dependent_columns.py.
LEAST = 0.03**2


class NotReduced(Exception):
    """Exception: a pivot is zero by its structure, or the elimination takes too many operations."""


class DependentCoordinates:
    """Solution of G a = gamma for the dependent accelerations, a_d = g + B a_i.

    Parameters
    ----------
    rows : sequence of sequence of Affine
        G, of full rank.
    gamma : sequence of Affine
    blocks : sequence of (rows, columns)
        Rows and columns of the pivots, in the order of elimination.
    most : int
        Largest number of operations.

    Attributes
    ----------
    independent : list of int
        Independent coordinates.
    T : list of dict
        Nonzero entries of T in each row, by the coordinate that they multiply.
    g : list of Affine
        The vector g; 0 for independent coordinates.
    conditions : list of (Affine, Affine)
        Pairs of which the first is larger than the second if pivots are not too small.

    Raises
    ------
    NotReduced
        If a pivot is zero by its structure, or if it takes more operations.
    """

    def __init__(self, rows: Sequence[Sequence[Affine]], gamma: Sequence[Affine], blocks: Blocks, most: int):
        self._n, graph = len(rows[0]), rows[0][0].graph
        self._graph, self._most = graph, len(graph.operations) + most
        self._zero, self._one = Affine(graph, 0.0, {}), Affine(graph, 1.0, {})
        self._rows: list[Terms] = [
            {j: entry for j, entry in enumerate([*row, right]) if not is_zero(entry)}
            for row, right in zip(rows, gamma, strict=True)
        ]
        self._columns = list(zip(*rows, strict=True))
        self._left, self._free = set(range(len(rows))), set(range(self._n))
        self.conditions: list[tuple[Affine, Affine]] = []
        for block in blocks:
            self._eliminate(*block)
        self.independent = sorted(self._free)
        self.T: list[Terms] = [{j: self._one} if j in self._free else {} for j in range(self._n)]
        self.g = [self._zero] * self._n
        for places, columns in reversed(blocks):
            for i, j in zip(places, columns, strict=True):
                self._substitute(j, self._rows[i])

    def _eliminate(self, places: tuple[int, ...], columns: tuple[int, ...]) -> None:
        """Solve rows for columns, and eliminate these from the remaining rows."""
        self.check()
        block = [[self._rows[i].get(j, self._zero) for j in columns] for i in places]
        pivot, inverse = self._inverse(block)
        around = sorted({j for i in places for j in self._rows[i]} - set(columns))
        entries = {j: [self._rows[i].get(j, self._zero) for i in places] for j in around}
        solved = [
            _not_zero({j: _dot(self._zero, zip(row, known, strict=True)) for j, known in entries.items()})
            for row in inverse
        ]
        self._left -= set(places)
        self._free -= set(columns)
        for k in sorted(self._left):
            row = self._rows[k]
            factors = [row.pop(j, None) for j in columns]
            for factor, others in zip(factors, solved, strict=True):
                for j, entry in {} if factor is None else others.items():
                    row[j] = row.get(j, self._zero) - factor * entry
            self._rows[k] = _not_zero(row)
        for i, row in zip(places, solved, strict=True):
            self._rows[i] = row
        if pivot.terms:
            self._add_conditions(block, columns, pivot, solved)

    def check(self, more: int = 0) -> None:
        """Raise `NotReduced` if the elimination is too long, or would be with `more` operations."""
        if len(self._graph.operations) + more > self._most:
            raise NotReduced

    def _inverse(self, block: list[list[Affine]]) -> tuple[Affine, list[list[Affine]]]:
        """Return the determinant of a block and its inverse."""
        if len(block) == 1:
            ((determinant,),) = block
        else:
            (a, b), (c, d) = block
            determinant = (a * d - b * c).value()
        if is_zero(determinant):
            raise NotReduced
        share = determinant.reciprocal()
        if len(block) == 1:
            return determinant, [[share]]
        return determinant, [
            [(d * share).value(), (-(b * share)).value()],
            [(-(c * share)).value(), (a * share).value()],
        ]

    def _add_conditions(
        self, block: list[list[Affine]], columns: tuple[int, ...], pivot: Affine, solved: list[Terms]
    ) -> None:
        """Require that no pivot is too small for the entries that it divides, and that rows are not nearly dependent.

        A pivot that is too small means that the columns of a block are nearly parallel, or that one pivot is small in
        its column, where its row may be small, too.

        The sign of a pivot does not matter: on either side of zero the accelerations are the same function.
        """
        entries = [entry for row in solved for j, entry in row.items() if j < self._n]
        total = _dot(self._zero, [(entry, entry) for entry in entries])
        if total.terms:
            self.conditions.append((Affine(total.graph, 1.0 / LEAST, {}), total))
        if len(block) == 1:
            (column,) = (self._columns[j] for j in columns)
            squares = _dot(self._zero, [(entry, entry) for entry in column])
            self.conditions.append((pivot * pivot, squares.times(LEAST)))
        else:
            a, b = (_dot(self._zero, [(x, x) for x in column]).value() for column in zip(*block, strict=True))
            self.conditions.append((pivot * pivot, (a * b).times(LEAST)))

    def _substitute(self, j: int, row: Terms) -> None:
        """Express a dependent coordinate by independent ones; later dependent ones have been expressed already."""
        self.check()
        right, entries = row.get(self._n, self._zero), dict[int, Affine]()
        for k, entry in row.items():
            if k < self._n:
                right = right - entry * self.g[k]
                for independent, factor in self.T[k].items():
                    entries[independent] = entries.get(independent, self._zero) - entry * factor
        self.T[j], self.g[j] = _not_zero(entries), right.value()


def reduced_accelerations(
    mass: Any, force: Sequence[Affine], coordinates: DependentCoordinates
) -> tuple[list[Affine], list[tuple[Affine, Affine]]]:
    """Return the accelerations, and the conditions that all independent motions have inertia."""
    n, T, g, independent = len(mass), coordinates.T, coordinates.g, coordinates.independent
    zero = Affine(mass[0, 0].graph, 0.0, {})
    rows = [[(mass[i, j], j) for j in range(n) if not is_zero(mass[i, j])] for i in range(n)]
    forces = [(force[i] - _dot(zero, ((x, g[j]) for x, j in rows[i]))).value() for i in range(n)]
    matrix: dict[tuple[int, int], Affine] = {}
    coordinates.check(sum(len(row) ** 2 // 2 for row in T))  # operations of T^T M T, if M is diagonal
    for a, x in enumerate(independent):
        moved = [_dot(zero, ((entry, T[j][x]) for entry, j in row if x in T[j])).value() for row in rows]  # M T
        for b, y in enumerate(independent[: a + 1]):
            inertia = _dot(zero, ((T[i][y], moved[i]) for i in range(n) if y in T[i])).value()
            if a == b or not is_zero(inertia):
                matrix[a, b] = matrix[b, a] = inertia
    right = [_dot(zero, ((T[i][x], forces[i]) for i in range(n) if x in T[i])).value() for x in independent]
    factors = Factors(matrix, len(independent), len(independent))
    solution = dict(zip(independent, factors.solve(right), strict=True))
    found = [g[i] + _dot(zero, ((entry, solution[x]) for x, entry in T[i].items())) for i in range(n)]
    return found, list(_definite(matrix, factors))


def _definite(matrix: dict[tuple[int, int], Affine], factors: Factors) -> Iterator[tuple[Affine, Affine]]:
    """Yield the conditions on pivots of the reduced mass matrix, each relative to its value without earlier ones."""
    pivots = iter(factors.positive)
    for places, _, _ in factors.blocks:
        alone: Affine | None = None
        for place in places:
            pivot = next(pivots)
            scale = matrix[place, place] if alone is None else alone * matrix[place, place]
            alone = pivot
            if pivot.terms:
                yield pivot, scale.times(0.0 if pivot.key == scale.key else LEAST)


def _dot(total: Affine, pairs: Any) -> Affine:
    for x, y in pairs:
        if not is_zero(x) and not is_zero(y):
            total = total + x * y
    return total


def _not_zero(entries: Terms) -> Terms:
    return {j: entry.value() for j, entry in entries.items() if not is_zero(entry)}

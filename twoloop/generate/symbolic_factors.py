"""Factor a symmetric matrix of expressions whose zeros are known, and solve with its factors."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from twoloop.generate.graph import Affine


class Block(NamedTuple):
    """Block of one or two rows that are eliminated together, which takes one division."""

    places: tuple[int, ...]
    inverse: list[list[Affine]]  # inverse of the pivots
    below: list[tuple[int, list[Affine]]]  # rows of L below the pivots


class Factors:
    """Factors L D L^T of a symmetric matrix of expressions, in an order that suits a definite matrix of this pattern.

    Attributes
    ----------
    blocks : list of Block
        Blocks in the order of elimination.
    conditions : list of (Affine, Affine)
        For each row from `n` on its pivot, and its pivot without the other rows from `n` on.
    positive : list of Affine
        Pivots that are positive if the matrix of the first `n` rows is definite.
    """

    def __init__(self, matrix: dict[tuple[int, int], Affine], size: int, n: int):
        rows: list[dict[int, Affine]] = [{} for _ in range(size)]
        for (i, j), value in matrix.items():
            rows[i][j] = value
        self.blocks: list[Block] = []
        self.conditions: list[tuple[Affine, Affine]] = []
        self.positive: list[Affine] = []
        alone: dict[int, Any] = {}
        pairs = _pairs(rows, n)
        for places in [*pairs, *_order(rows, n, pairs)]:
            nothing = Affine(rows[places[0]][places[0]].graph, 0.0, {})
            pivots = [[rows[i].pop(j, nothing).value() for j in places] for i in places]
            inverse = self._inverse(pivots, [alone.get(i) for i in places])
            neighbours = dict.fromkeys(j for i in places for j in rows[i])
            entries = [(j, [rows[i].get(j, nothing).value() for i in places]) for j in neighbours]
            below = [(j, [_dot(row, values).value() for row in inverse]) for j, values in entries]
            for first, (j, multiples) in enumerate(below):
                for k, values in entries[first:]:
                    change = _dot(multiples, values)
                    if j == k >= n > places[0]:
                        alone[j] = alone.get(j, 0.0) - change
                    rows[j][k] = rows[k][j] = rows[j][k] - change if k in rows[j] else -change
                for i in places:
                    rows[j].pop(i, None)
            self.blocks.append(Block(places, inverse, below))

    def _inverse(self, pivots: list[list[Affine]], alone: list[Any]) -> list[list[Affine]]:
        """Return the inverse of one or two pivots, and record their conditions."""
        diagonal = [None if each is None else each.value() for each in alone]
        a = pivots[0][0]
        if diagonal[0] is None:
            self.positive.append(a)
        else:
            self.conditions.append((-a, -diagonal[0]))
        if len(pivots) == 1:
            return [[a.reciprocal()]]
        b, c = pivots[0][1], pivots[1][1]
        determinant = (a * c - b * b).value()
        if diagonal[1] is None:
            self.positive.append(determinant)
        else:
            self.conditions.append((determinant, (a * diagonal[1]).value()))
        inverse = determinant.reciprocal()
        return [[(c * inverse).value(), (-b * inverse).value()], [(-b * inverse).value(), (a * inverse).value()]]

    def solve(self, right: Sequence[Affine]) -> list[Affine]:
        """Solve for a right-hand side."""
        return solve(self.blocks, right)


def _dot(a: Sequence[Affine], b: Sequence[Affine]) -> Affine:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def solve(blocks: Sequence[Block], right: Sequence[Affine]) -> list[Affine]:
    """Solve for a right-hand side; multiples of one quantity are added before the multiplication."""
    solution = list(right)
    pending: list[list[tuple[Affine, Affine]]] = [[] for _ in right]
    for places, _, below in blocks:
        for i in places:
            solution[i] = (solution[i] - _gathered(pending[i])).value()
        for j, multiples in below:
            pending[j] += [(multiple, solution[i]) for multiple, i in zip(multiples, places, strict=True)]
    for places, inverse, below in reversed(blocks):
        pivots = [solution[i] for i in places]
        for place, (i, row) in enumerate(zip(places, inverse, strict=True)):
            products = [(multiples[place], solution[j]) for j, multiples in below]
            solution[i] = (_dot(row, pivots) - _gathered(products)).value()
    return solution


def _gathered(products: Sequence[tuple[Affine, Affine]]) -> Any:
    """Sum products, with one product for all multiples of a factor."""
    total: Any = 0.0
    groups: dict[Any, tuple[Affine, Affine]] = {}
    for factor_a, factor_b in products:
        if not factor_a.terms:
            total = total + factor_b.times(factor_a.constant)
            continue
        scale, factor = factor_a.normalised()
        before = groups.get(factor.key)
        factor_b = factor_b.times(scale)
        groups[factor.key] = (factor, factor_b if before is None else before[1] + factor_b)
    for factor, factor_b in groups.values():
        total = total + factor * factor_b.value()
    return total


def _pairs(rows: list[dict[int, Affine]], n: int) -> list[tuple[int, int]]:
    """Return pairs of a coordinate and a row of G whose entry is a number, in no other row, and whose mass is a number.

    The rank of G is that of the other rows plus the number of pairs, which take no condition and no division.
    """
    pairs: dict[int, int] = {}  # coordinates by rows of G
    for i, row in enumerate(rows[:n]):
        if len(row) == 2 and i in row and max(row) >= n and not any(entry.terms for entry in row.values()):
            pairs.setdefault(max(row), i)
    return [(i, k) for k, i in pairs.items()]


def _order(rows: list[dict[int, Affine]], n: int, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Order rows by least degree, each row from n on after its neighbours below n, in pairs where neighbours agree.

    Among equals, rows that wait for the fewest divisions come first, so that independent operations run side by side.
    """
    neighbours = [set(row) - {i} for i, row in enumerate(rows)]
    waits = [{j for j in neighbours[i] if j < n} if i >= n else set() for i in range(len(rows))]
    order: list[tuple[int, ...]] = []
    remaining, depth = set(range(len(rows))), [0] * len(rows)
    for pair in pairs:
        remaining -= set(pair)
        _eliminate(neighbours, pair)
        for j in remaining:
            waits[j] -= set(pair)
    while remaining:
        i = min((j for j in remaining if not waits[j]), key=lambda j: (len(neighbours[j]), depth[j], j))
        ready = [j for j in neighbours[i] if not waits[j] and (j < n) == (i < n)]
        alike = [j for j in ready if neighbours[j] | {j} == neighbours[i] | {i}]
        places = (i, *sorted(alike)[:1])
        order.append(places)
        remaining -= set(places)
        for j in _eliminate(neighbours, places):
            waits[j] -= set(places)
            depth[j] = max(depth[j], depth[i] + 1)
    return order


def _eliminate(neighbours: list[set[int]], places: Sequence[int]) -> set[int]:
    """Eliminate rows, connect their neighbours with one another, and return these."""
    around = set().union(*(neighbours[i] for i in places)) - set(places)
    for j in around:
        neighbours[j] = (neighbours[j] | around) - {*places, j}
    return around

"""Factor symmetric matrices of expressions, and eliminate dependent coordinates by the rows G a = gamma.

With G = [G_d G_i], a_d = g + B a_i for B = -G_d^-1 G_i and g = G_d^-1 gamma. The remaining system is small: (T^T M T)
a_i = T^T (Q - M g) with T = [B; 1]. This takes about half the operations of an elimination that begins with M, and M
may be singular in directions that the constraints exclude.

Pivots are chosen once. If a pivot becomes small during a run, a condition of the generated code fails, and the
elimination that begins with M computes the accelerations.

Bodies of small inertia beside heavy bodies cause pivots of very different size, whatever rows are added to M. In this
case, one step of refinement solves for the residual of the solution, and restores the digits that elimination loses.
The loss may grow during a run: if refinement changes a solution too much, a condition fails, as for small pivots.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from twoloop.generate.graph import Affine, is_zero

# accelerations are valid if a step of refinement changes them by at most this fraction. Usually their error is then the
# square of this change; it is as large as the change if a part of small inertia loses all digits
LARGEST_CHANGE = 1e-7


class Block(NamedTuple):
    """Block of one or two rows of the matrix that are eliminated together, with one division."""

    row_indices: tuple[int, ...]
    inverse: list[list[Affine]]  # inverse of the 1x1 or 2x2 matrix of pivots
    # for each row of L with nonzero entries below the block: its index, and these entries
    rows_below: list[tuple[int, list[Affine]]]


class Factors:
    """Factors L D L^T of a symmetric matrix [M G^T; G 0] of expressions; the pivots are the blocks of D.

    blocks : blocks in the order of elimination.
    conditions : pairs, for rows of G (index `n` and later): the pivot of the row, and the pivot that it would have
        without the other rows of G. The first expression must be larger than a fraction of the second.
    mass_pivots : pivots of M (index below `n`), which are positive if M is definite.
    """

    def __init__(self, matrix: dict[tuple[int, int], Affine], size: int, n: int):
        rows: list[dict[int, Affine]] = [{} for _ in range(size)]
        for (i, j), value in matrix.items():
            rows[i][j] = value
        self.blocks: list[Block] = []
        self.conditions: list[tuple[Affine, Affine]] = []
        self.mass_pivots: list[Affine] = []
        pivots_alone: dict[int, Any] = {}
        pairs = _pairs_without_conditions(rows, n)
        for row_indices in [*pairs, *_order_rows(rows, n, pairs)]:
            zero = Affine(rows[row_indices[0]][row_indices[0]].graph, 0.0, {})
            pivots = [[rows[i].pop(j, zero).as_term() for j in row_indices] for i in row_indices]
            inverse = self._inverse(pivots, [pivots_alone.get(i) for i in row_indices])
            neighbours = dict.fromkeys(j for i in row_indices for j in rows[i])
            entries = [(j, [rows[i].get(j, zero).as_term() for i in row_indices]) for j in neighbours]
            rows_below = [(j, [_dot(row, values).as_term() for row in inverse]) for j, values in entries]
            for first, (j, multiples) in enumerate(rows_below):
                for k, values in entries[first:]:
                    change = _dot(multiples, values)
                    if j == k >= n > row_indices[0]:
                        pivots_alone[j] = pivots_alone.get(j, 0.0) - change
                    rows[j][k] = rows[k][j] = rows[j][k] - change if k in rows[j] else -change
                for i in row_indices:
                    rows[j].pop(i, None)
            self.blocks.append(Block(row_indices, inverse, rows_below))

    def _inverse(self, pivots: list[list[Affine]], own_pivots: list[Any]) -> list[list[Affine]]:
        """Return the inverse of a block of pivots; add conditions. `own_pivots`: pivots without other rows of G."""
        diagonal = [None if pivot is None else pivot.as_term() for pivot in own_pivots]
        a = pivots[0][0]
        if diagonal[0] is None:
            self.mass_pivots.append(a)
        else:
            self.conditions.append((-a, -diagonal[0]))
        if len(pivots) == 1:
            return [[a.reciprocal()]]
        b, c = pivots[0][1], pivots[1][1]
        determinant = (a * c - b * b).as_term()
        if diagonal[1] is None:
            self.mass_pivots.append(determinant)
        else:
            self.conditions.append((determinant, (a * diagonal[1]).as_term()))
        factor = determinant.reciprocal()
        return [[(c * factor).as_term(), (-b * factor).as_term()], [(-b * factor).as_term(), (a * factor).as_term()]]

    def solve(self, rhs: Sequence[Affine]) -> list[Affine]:
        """Return the solution of the linear system for a right-hand side."""
        return solve(self.blocks, rhs)


def _dot(a: Sequence[Affine], b: Sequence[Affine]) -> Affine:
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def solve(blocks: Sequence[Block], rhs: Sequence[Affine]) -> list[Affine]:
    """Return the solution of a linear system, given the blocks of its `Factors` and the right-hand side."""
    solution = list(rhs)
    pending: list[list[tuple[Affine, Affine]]] = [[] for _ in rhs]
    for row_indices, _, rows_below in blocks:
        for i in row_indices:
            solution[i] = (solution[i] - _collected_sum(pending[i])).as_term()
        for j, multiples in rows_below:
            pending[j] += [(multiple, solution[i]) for multiple, i in zip(multiples, row_indices, strict=True)]
    for row_indices, inverse, rows_below in reversed(blocks):
        pivots = [solution[i] for i in row_indices]
        for position, (i, row) in enumerate(zip(row_indices, inverse, strict=True)):
            products = [(multiples[position], solution[j]) for j, multiples in rows_below]
            solution[i] = (_dot(row, pivots) - _collected_sum(products)).as_term()
    return solution


def _collected_sum(products: Sequence[tuple[Affine, Affine]]) -> Any:
    """Return the sum of products; if all first factors are multiples of one expression, multiply only once by it."""
    total: Any = 0.0
    groups: dict[Any, tuple[Affine, Affine]] = {}
    for factor_a, factor_b in products:
        if not factor_a.terms:
            total = total + factor_b.times(factor_a.constant)
            continue
        scale, factor = factor_a.normalized()
        previous = groups.get(factor.key)
        factor_b = factor_b.times(scale)
        groups[factor.key] = (factor, factor_b if previous is None else previous[1] + factor_b)
    for factor, factor_b in groups.values():
        total = total + factor * factor_b.as_term()
    return total


def _pairs_without_conditions(rows: list[dict[int, Affine]], n: int) -> list[tuple[int, int]]:
    """Return pairs (coordinate, row of G) that are eliminated first: their pivots need no condition and no division.

    The coordinate occurs in no other row of [M G^T; G 0], and its two entries, in M and in G, are constants. The rank
    of G is the rank of the remaining rows plus the number of pairs.
    """
    pairs: dict[int, int] = {}  # coordinates by rows of G
    for i, row in enumerate(rows[:n]):
        if len(row) == 2 and i in row and max(row) >= n and not any(entry.terms for entry in row.values()):
            pairs.setdefault(max(row), i)
    return [(i, k) for k, i in pairs.items()]


def _order_rows(rows: list[dict[int, Affine]], n: int, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Return the indices of all rows that are not in `pairs`, by minimum degree, in tuples of one or two rows.

    Two rows with the same neighbours are in one tuple. A row of G (index n and later) comes after its coordinates. Of
    rows with equal degree, the row that needs the shortest chain of divisions comes first, so that operations overlap.
    """
    neighbours = [set(row) - {i} for i, row in enumerate(rows)]
    waiting_for = [{j for j in neighbours[i] if j < n} if i >= n else set() for i in range(len(rows))]
    order: list[tuple[int, ...]] = []
    remaining, depth = set(range(len(rows))), [0] * len(rows)
    for pair in pairs:
        remaining -= set(pair)
        _eliminate(neighbours, pair)
        for j in remaining:
            waiting_for[j] -= set(pair)
    while remaining:
        i = min((j for j in remaining if not waiting_for[j]), key=lambda j: (len(neighbours[j]), depth[j], j))
        ready_rows = [j for j in neighbours[i] if not waiting_for[j] and (j < n) == (i < n)]
        same_neighbours = [j for j in ready_rows if neighbours[j] | {j} == neighbours[i] | {i}]
        block = (i, *sorted(same_neighbours)[:1])
        order.append(block)
        remaining -= set(block)
        for j in _eliminate(neighbours, block):
            waiting_for[j] -= set(block)
            depth[j] = max(depth[j], depth[i] + 1)
    return order


def _eliminate(neighbours: list[set[int]], rows: Sequence[int]) -> set[int]:
    """Eliminate rows from the graph of nonzero entries: connect their neighbours, and return these neighbours."""
    new_neighbours = set().union(*(neighbours[i] for i in rows)) - set(rows)
    for j in new_neighbours:
        neighbours[j] = (neighbours[j] | new_neighbours) - {*rows, j}
    return new_neighbours


PivotBlocks = Sequence[tuple[tuple[int, ...], tuple[int, ...]]]  # rows and columns of the pivots, one or two each
Terms = dict[int, Affine]  # nonzero entries of a row, by their columns

# limit below which the accelerations count as invalid, for the squares of three numbers: pivot / norm of the entries
# that it divides; pivot / norm of its column; sine of the angle between the two columns of a block. A number of 10^-k
# costs up to 3 k digits of accelerations. The choice at a start has stricter limits, see linalg/dependent_columns.py
MIN_PIVOT_SQUARE = 0.03**2


class ReductionFailed(Exception):
    """Exception: a pivot is always zero, or the elimination of dependent coordinates takes too many operations."""


class DependentCoordinates:
    """Solution of G a = gamma for the dependent accelerations, a_d = g + B a_i.

    rows : the matrix G, of full rank.
    blocks : rows and columns of the pivots, in the order of elimination.
    max_added : largest number of operations that may be added to the graph.

    Fields:
    independent : independent coordinates.
    T : for each row of T, its nonzero entries by column; a column is an independent coordinate.
    g : the vector g of length n_q; 0 for independent coordinates.
    conditions : pairs of expressions. Unless a pivot is too small, the first one is larger in each pair.

    Raise ReductionFailed if a pivot is always zero, or if the elimination takes more than `max_added` operations.
    """

    def __init__(self, rows: Sequence[Sequence[Affine]], gamma: Sequence[Affine], blocks: PivotBlocks, max_added: int):
        self._n, graph = len(rows[0]), rows[0][0].graph
        self._graph, self._max_operations = graph, len(graph.operations) + max_added
        self._zero, self._one = Affine(graph, 0.0, {}), Affine(graph, 1.0, {})
        self._rows: list[Terms] = [
            {j: entry for j, entry in enumerate([*row, rhs]) if not is_zero(entry)}
            for row, rhs in zip(rows, gamma, strict=True)
        ]
        self._columns = list(zip(*rows, strict=True))
        self._remaining_rows, self._remaining_columns = set(range(len(rows))), set(range(self._n))
        self.conditions: list[tuple[Affine, Affine]] = []
        for block in blocks:
            self._eliminate(*block)
        self.independent = sorted(self._remaining_columns)
        self.T: list[Terms] = [{j: self._one} if j in self._remaining_columns else {} for j in range(self._n)]
        self.g = [self._zero] * self._n
        for block_rows, columns in reversed(blocks):
            for i, j in zip(block_rows, columns, strict=True):
                self._substitute(j, self._rows[i])

    def _eliminate(self, rows: tuple[int, ...], columns: tuple[int, ...]) -> None:
        """Solve one or two rows of [G gamma] for as many coordinates, `columns`; eliminate these from other rows."""
        self.check_length()
        block = [[self._rows[i].get(j, self._zero) for j in columns] for i in rows]
        pivot, inverse = self._inverse(block)
        other_columns = sorted({j for i in rows for j in self._rows[i]} - set(columns))
        entries = {j: [self._rows[i].get(j, self._zero) for i in rows] for j in other_columns}
        solved = [
            _nonzero({j: _add_products(self._zero, zip(row, column, strict=True)) for j, column in entries.items()})
            for row in inverse
        ]
        self._remaining_rows -= set(rows)
        self._remaining_columns -= set(columns)
        for k in sorted(self._remaining_rows):
            row = self._rows[k]
            factors = [row.pop(j, None) for j in columns]
            for factor, solved_row in zip(factors, solved, strict=True):
                for j, entry in {} if factor is None else solved_row.items():
                    row[j] = row.get(j, self._zero) - factor * entry
            self._rows[k] = _nonzero(row)
        for i, row in zip(rows, solved, strict=True):
            self._rows[i] = row
        if pivot.terms:
            self._add_conditions(block, columns, pivot, solved)

    def check_length(self, n_following: int = 0) -> None:
        """Raise ReductionFailed if more than `max_added` operations are added, including `n_following` later ones."""
        if len(self._graph.operations) + n_following > self._max_operations:
            raise ReductionFailed

    def _inverse(self, block: list[list[Affine]]) -> tuple[Affine, list[list[Affine]]]:
        """Return determinant and inverse of a 1x1 or 2x2 block; raise ReductionFailed if it is always singular."""
        if len(block) == 1:
            ((determinant,),) = block
        else:
            (a, b), (c, d) = block
            determinant = (a * d - b * c).as_term()
        if is_zero(determinant):
            raise ReductionFailed
        factor = determinant.reciprocal()
        if len(block) == 1:
            return determinant, [[factor]]
        return determinant, [
            [(d * factor).as_term(), (-(b * factor)).as_term()],
            [(-(c * factor)).as_term(), (a * factor).as_term()],
        ]

    def _add_conditions(
        self, block: list[list[Affine]], columns: tuple[int, ...], pivot: Affine, solved: list[Terms]
    ) -> None:
        """Add two conditions: a pivot is not small relative to the entries that it divides, nor to its column.

        `pivot`: determinant of `block`. For two rows, the second condition is that the columns of the block are not
        nearly parallel. A pivot may change its sign, because the formula for the accelerations remains valid.
        """
        entries = [entry for row in solved for j, entry in row.items() if j < self._n]
        total = _add_products(self._zero, [(entry, entry) for entry in entries])
        if total.terms:
            self.conditions.append((Affine(total.graph, 1.0 / MIN_PIVOT_SQUARE, {}), total))
        if len(block) == 1:
            (column,) = (self._columns[j] for j in columns)
            squares = _add_products(self._zero, [(entry, entry) for entry in column])
            self.conditions.append((pivot * pivot, squares.times(MIN_PIVOT_SQUARE)))
        else:
            a, b = (_add_products(self._zero, [(x, x) for x in pair]).as_term() for pair in zip(*block, strict=True))
            self.conditions.append((pivot * pivot, (a * b).times(MIN_PIVOT_SQUARE)))

    def _substitute(self, j: int, row: Terms) -> None:
        """Store T[j] and g[j] of a dependent coordinate j, computed from T and g of the coordinates in `row`."""
        self.check_length()
        rhs, entries = row.get(self._n, self._zero), dict[int, Affine]()
        for k, entry in row.items():
            if k < self._n:
                rhs = rhs - entry * self.g[k]
                for independent, factor in self.T[k].items():
                    entries[independent] = entries.get(independent, self._zero) - entry * factor
        self.T[j], self.g[j] = _nonzero(entries), rhs.as_term()


def solve_reduced_system(
    mass: Any, force: Sequence[Affine], coordinates: DependentCoordinates
) -> tuple[list[Affine], list[tuple[Affine, Affine]]]:
    """Return the accelerations (n_q,) for M and Q, and conditions under which T^T M T is not nearly singular."""
    n, T, g, independent = len(mass), coordinates.T, coordinates.g, coordinates.independent
    zero = Affine(mass[0, 0].graph, 0.0, {})
    rows = [[(mass[i, j], j) for j in range(n) if not is_zero(mass[i, j])] for i in range(n)]
    forces = [(force[i] - _add_products(zero, ((x, g[j]) for x, j in rows[i]))).as_term() for i in range(n)]
    matrix: dict[tuple[int, int], Affine] = {}
    coordinates.check_length(sum(len(row) ** 2 // 2 for row in T))  # operations of T^T M T, if M is diagonal
    for a, x in enumerate(independent):
        mass_T = [_add_products(zero, ((m, T[j][x]) for m, j in row if x in T[j])).as_term() for row in rows]  # M T
        for b, y in enumerate(independent[: a + 1]):
            inertia = _add_products(zero, ((T[i][y], mass_T[i]) for i in range(n) if y in T[i])).as_term()
            if a == b or not is_zero(inertia):
                matrix[a, b] = matrix[b, a] = inertia
    rhs = [_add_products(zero, ((T[i][x], forces[i]) for i in range(n) if x in T[i])).as_term() for x in independent]
    factors = Factors(matrix, len(independent), len(independent))
    solution = dict(zip(independent, factors.solve(rhs), strict=True))
    accelerations = [g[i] + _add_products(zero, ((m, solution[x]) for x, m in T[i].items())) for i in range(n)]
    return accelerations, list(_pivot_conditions(matrix, factors))


def _pivot_conditions(matrix: dict[tuple[int, int], Affine], factors: Factors) -> Iterator[tuple[Affine, Affine]]:
    """Yield each pivot of the reduced mass matrix T^T M T with its lower bound, a fraction of the diagonal entry."""
    pivots = iter(factors.mass_pivots)
    for row_indices, _, _ in factors.blocks:
        first_pivot: Affine | None = None
        for i in row_indices:
            pivot = next(pivots)
            # the pivot of the second row of a block is the determinant: its bound is multiplied by the first pivot
            scale = matrix[i, i] if first_pivot is None else first_pivot * matrix[i, i]
            first_pivot = pivot
            if pivot.terms:
                yield pivot, scale.times(0.0 if pivot.key == scale.key else MIN_PIVOT_SQUARE)


def _add_products(total: Affine, pairs: Any) -> Affine:
    for x, y in pairs:
        if not is_zero(x) and not is_zero(y):
            total = total + x * y
    return total


def _nonzero(entries: Terms) -> Terms:
    return {j: entry.as_term() for j, entry in entries.items() if not is_zero(entry)}


def solve_refined(
    solve: Callable[[Sequence[Affine]], list[Affine]],
    choice: Any,
    mass: Any,
    rows: Any,
    r: Sequence[Affine],
    c: Sequence[Affine],
) -> tuple[list[Affine], list[tuple[Affine, Affine]]]:
    """Return a and lam (independent rows) with M a + G^T lam = r, G a = c; refine them if `choice.is_refined`.

    Also return conditions: pairs of expressions, the first of which is larger unless refinement changes the solution
    too much, relative to a or, near equilibrium, where a is small, to the acceleration of all masses by r alone.

    `solve`: function that solves a linear system by the factors of [M + s g^T g, G^T; G 0], where rows g were added to
    M as in PivotChoice. `mass`: M without added rows. `rows`, `c`: rows of G and their right-hand sides, by index.
    """

    def solve_once(r: Sequence[Affine], c: Mapping[int, Affine] | Sequence[Affine]) -> list[Affine]:
        rhs = list(r)
        for k, scale in zip(choice.added_rows, choice.scales, strict=True):
            for i, entry in enumerate(rows[k]):
                rhs[i] = rhs[i] + (entry * c[k]).times(scale)
        return solve([*rhs, *(c[k] for k in choice.rows)])

    def subtract_products(total: Affine, products: Iterable[tuple[Affine, Affine]]) -> Affine:
        for x, y in products:
            total = total if is_zero(x) else total - x * y
        return total.as_term()

    def sum_of_squares(exprs: Iterable[Affine]) -> Affine:
        return _add_products(Affine(r[0].graph, 0.0, {}), ((x, x) for x in exprs)).as_term()

    solution, n = solve_once(r, c), len(r)
    if not choice.is_refined:
        return solution, []
    a, lam = solution[:n], dict(zip(choice.rows, solution[n:], strict=True))
    residual_r = [
        subtract_products(force, [*zip(row, a, strict=True), *((rows[k][i], x) for k, x in lam.items())])
        for i, (force, row) in enumerate(zip(r, mass, strict=True))
    ]
    residual_c = {k: subtract_products(c[k], zip(rows[k], a, strict=True)) for k in {*choice.rows, *choice.added_rows}}
    changes = solve_once(residual_r, residual_c)
    masses = sum_of_squares(mass[i][i] for i in range(n))
    size = (sum_of_squares(a) * masses + sum_of_squares(r)).times(LARGEST_CHANGE**2) + float(np.finfo(float).tiny)
    conditions = [(size, sum_of_squares(changes[:n]) * masses)]
    return [x + change for x, change in zip(solution, changes, strict=True)], conditions

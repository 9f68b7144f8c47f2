"""Solve symbolically for accelerations: the entries of matrices are expressions, from which code is generated.

The accelerations a satisfy M a + G^T lam = Q and G a = gamma; G are the independent rows of all constraints, [C_q; A].
There are two methods:

- `Factors` eliminates from the whole matrix [M G^T; G 0], beginning with M: this yields the factors L D L^T.
- `DependentCoordinates` first solves G a = gamma for the dependent accelerations: a = g + T a_i, where a_i are the
  independent accelerations. The system (T^T M T) a_i = T^T (Q - M g) remains, which is small. This takes about half
  the operations of `Factors`, and M may be singular in directions that the constraints exclude.

Pivots are chosen once. If a pivot of `DependentCoordinates` becomes small in a run, generated code uses `Factors`.

Light bodies beside heavy bodies cause pivots of very different size, and elimination loses digits. Then one step of
refinement restores them: it solves the system again, with the residual of the solution as the right-hand side.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from twoloop.generate.graph import Affine, is_zero

# accelerations are invalid if a step of refinement changes them by more than this fraction. The relative error after
# refinement is usually (change)^2; it is as large as the change only if a light body's acceleration had no exact digit
LARGEST_CHANGE = 1e-7


class Block(NamedTuple):
    """Pivot block of the factorization L D L^T: one or two rows that are eliminated together, with one division."""

    row_indices: tuple[int, ...]
    inverse: list[list[Affine]]  # inverse of the pivot block, a 1x1 or 2x2 block of the matrix D
    rows_below: list[tuple[int, list[Affine]]]  # index and entries of each nonzero row of the factor L below this block


class Factors:
    """Factors L D L^T of a symmetric matrix [M G^T; G 0] of expressions; M has `n` rows.

    `check_length` is called after each block; it raises Untraceable if the expressions have become too many.

    blocks : blocks in the order of elimination.
    conditions : for each row of G, a pair of positive expressions: the magnitude of its pivot, and the magnitude that
        this pivot would have if G had no other rows. If the first is less than a small fraction of the second, the row
        nearly depends on other rows, and results are invalid.
    mass_pivots : all other pivots. If M is positive definite, each of them is positive or a constant number.
    """

    def __init__(
        self, matrix: dict[tuple[int, int], Affine], size: int, n: int, check_length: Callable[[], None] = lambda: None
    ):
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
            check_length()

    def _inverse(self, pivots: list[list[Affine]], own_pivots: list[Any]) -> list[list[Affine]]:
        """Return the inverse of a 1x1 or 2x2 pivot block, and append its pivots to `mass_pivots` or `conditions`.

        `own_pivots`: a row's pivot as it would be without other rows of G; None if the pivot goes to `mass_pivots`.
        """
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
    """Return the sum of products with few multiplications: for example, (2 x) a + x b becomes x (2 a + b)."""
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
    """Return pairs (coordinate, row of G) that are eliminated first, because their pivots are constant.

    The row of the coordinate in [M G^T; G 0] has only two entries, one in M and one in G^T, both constant. So the row
    of G in the pair is independent of the other rows of G.
    """
    pairs: dict[int, int] = {}  # keys: rows of G; values: coordinates
    for i, row in enumerate(rows[:n]):
        if len(row) == 2 and i in row and max(row) >= n and not any(entry.terms for entry in row.values()):
            pairs.setdefault(max(row), i)
    return [(i, k) for k, i in pairs.items()]


def _order_rows(rows: list[dict[int, Affine]], n: int, pairs: Sequence[tuple[int, int]]) -> list[tuple[int, ...]]:
    """Return the order of elimination of the rows that are not in `pairs`, as tuples of one or two row indices.

    The row with the fewest neighbours comes first (minimum degree); neighbours of a row are the columns of its nonzero
    entries. Two rows with the same neighbours form one tuple. A row of G (index `n` and later) follows the coordinates
    in which it has nonzero entries. In a tie, the row whose pivot depends on the fewest successive divisions is first.
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
    """Connect all neighbours of `rows` with each other, as the elimination of `rows` does; return the neighbours."""
    new_neighbours = set().union(*(neighbours[i] for i in rows)) - set(rows)
    for j in new_neighbours:
        neighbours[j] = (neighbours[j] | new_neighbours) - {*rows, j}
    return new_neighbours


PivotBlocks = Sequence[tuple[tuple[int, ...], tuple[int, ...]]]  # per block: indices of its one or two rows and columns
Terms = dict[int, Affine]  # nonzero entries of a row of a matrix; keys: column indices

# accelerations are invalid if the square of one of three ratios is below this limit: pivot / (norm of the entries that
# it divides), pivot / (norm of its column), or the sine of the angle between the columns of a 2x2 block. A ratio
# of 10^-k costs up to 3 k digits. The choice of pivots before a run (linalg/dependent_columns.py) is stricter
MIN_PIVOT_SQUARE = 0.03**2


class ReductionFailed(Exception):
    """Exception: a pivot is always zero, or the elimination of dependent coordinates takes too many operations."""


class DependentCoordinates:
    """Solution a = g + T a_i of G a = gamma: a vector g and a matrix T yield accelerations a from the independent a_i.

    rows : the matrix G; its rows are independent.
    blocks : rows and columns of the pivots, in the order of elimination. The columns are the dependent coordinates.
    max_added : largest number of operations that the elimination may record.
    Fields:
    independent : indices of the independent coordinates.
    T : rows of the matrix T, as dictionaries of nonzero entries; keys: indices of independent coordinates.
    g : the vector g (n_q,); 0 for independent coordinates.
    conditions : pairs of expressions. If the first is not larger than the second, a pivot is too small.

    Raise ReductionFailed if a pivot is always zero, or if more than `max_added` operations are necessary.
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
        """Solve the equations `rows` of G a = gamma for a[columns]; insert the solution in the remaining equations."""
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
        """Raise ReductionFailed if the operations recorded so far plus `n_following` exceed the limit `max_added`."""
        if len(self._graph.operations) + n_following > self._max_operations:
            raise ReductionFailed

    def _inverse(self, block: list[list[Affine]]) -> tuple[Affine, list[list[Affine]]]:
        """Return determinant, inverse of a 1x1 or 2x2 block; raise ReductionFailed if the determinant is always 0."""
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
        """Append conditions that fail if `pivot`, the determinant of `block`, is too small (see MIN_PIVOT_SQUARE)."""
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
        """Store T[j] and g[j] of a dependent coordinate, given its equation a[j] = row[n_q] - sum of row[k] a[k]."""
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
    """Return the accelerations a = g + T a_i, where a_i is the solution of T^T M T a_i = T^T (Q - M g) (Q: `force`).

    `coordinates`: T, g. Also return pairs of expressions: T^T M T is not singular if in each pair the first is larger.
    """
    n, T, g, independent = len(mass), coordinates.T, coordinates.g, coordinates.independent
    zero = Affine(mass[0, 0].graph, 0.0, {})
    rows = [[(mass[i, j], j) for j in range(n) if not is_zero(mass[i, j])] for i in range(n)]
    forces = [(force[i] - _add_products(zero, ((x, g[j]) for x, j in rows[i]))).as_term() for i in range(n)]
    matrix: dict[tuple[int, int], Affine] = {}
    coordinates.check_length(sum(len(row) ** 2 // 2 for row in T))  # estimated operations for T^T M T
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
    """Yield a pair (pivot, lower limit) for each pivot of `matrix`, T^T M T, that is not a constant number."""
    pivots = iter(factors.mass_pivots)
    for row_indices, _, _ in factors.blocks:
        first_pivot: Affine | None = None
        for i in row_indices:
            pivot = next(pivots)
            # the second pivot of a 2x2 block is its determinant: compare it with (first pivot) * (diagonal entry)
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
    """Solve M a + G^T lam = r, G a = c for (a, lam); return this solution, and conditions under which a is accurate.

    `choice`: PivotChoice, which lists the independent rows; only these have a multiplier in lam. `mass`: M; `rows`: G.
    `solve`: function that solves linear systems with the matrix [M + S, G^T; G 0], where S is 0, or terms that make
    M definite (see PivotChoice).

    If `choice.is_refined`, a step of refinement improves the solution, and there is one condition, otherwise none. The
    condition is a pair of expressions; the first must be larger than the second. Otherwise the change by refinement is
    too large, compared with a and (as a is small near equilibrium) with accelerations due to r without constraints.
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

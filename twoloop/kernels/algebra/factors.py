"""LU factors of the dependent columns of the constraint Jacobian, by a program for their pattern.

A mechanism's Jacobian has few entries, always in the same places. The order of elimination is chosen once for each
partition (Markowitz's rule with a threshold), and with it a list of what is to be multiplied and subtracted: to factor
again is to run down this list, without a search for pivots and without a look at zeros. Multipliers that have grown
show that the order suits the numbers no longer. Where the list would be as long as that of a full matrix, the factors
are dense with row exchanges.

The factors of one matrix are two arrays: `index`, the program, and `values`. Vectors to solve for are in the order of
elimination: entry k belongs to row rows_of(index)[k] of the Jacobian, that of the solution to columns_of(index)[k].
"""

from twoloop.kernels.algebra import elimination as at
from twoloop.kernels.algebra.elimination import (
    begin,
    begin_lower,
    begin_upper,
    columns_of,
    end_upper,
    lists_of,
    order,
    pivots_of,
    put,
    rows_of,
    slots,
)
from twoloop.kernels.algebra.linalg import copy, lu_factor, lu_sign, lu_solve
from twoloop.kernels.data.common import compiled, merged

GROWTH = 1e3  # largest multiplier before the order of elimination is chosen anew


@compiled
def make_program(G, pattern, rows, columns, index, values):
    """Choose the order of elimination of G[rows][:, columns], whose entries are where `pattern` is not zero.

    False: the matrix is singular.
    """
    r, width = rows.size, G.shape[1]
    begin(index, r)
    matrix = lists_of(index, values)
    index[at.WIDTH] = width
    code = at.ORDERED
    for i in range(r):
        for k in range(r):
            if pattern[rows[i], columns[k]] != 0.0:
                number, source = G[rows[i], columns[k]], rows[i] * width + columns[k]
                if code == at.ORDERED and not put(matrix, i, k, number, source):
                    code = at.TOO_MANY
    if code == at.ORDERED:
        code = order(index, matrix, pattern.size, at.ZERO)
    if code == at.ORDERED:
        for k in range(r):
            rows_of(index)[k], columns_of(index)[k] = rows[rows_of(index)[k]], columns[columns_of(index)[k]]
    elif code == at.TOO_MANY:
        index[at.DENSE] = 1
        index[at.SIGN] = 1
        copy(rows, rows_of(index))
        copy(columns, columns_of(index))
    return code != at.SINGULAR_MATRIX


@merged
def factor(entries, index, values):
    """Factor G[rows][:, columns]; 1/pivots on the diagonal. `entries` are those of G (n, n_q), whose last row is zero.

    Returns the ratio of the smallest to the largest pivot; negative where a pivot is zero or not finite, or multipliers
    have grown, and the order must be chosen anew.
    """
    r = index[at.SIZE]
    if index[at.DENSE] == 1:
        A = values[: r * r].reshape((r, r))
        rows, columns = rows_of(index), columns_of(index)
        for i in range(r):
            for k in range(r):
                A[i, k] = entries[rows[i] * index[at.WIDTH] + columns[k]]
        return lu_factor(A, pivots_of(index))
    source = slots(r) + 2 * index[at.N_SLOTS]
    for s in range(index[at.N_SLOTS]):
        values[s] = entries[index[source + s]]
    return run(index, values)


@merged
def run(index, values):
    """Run down the program with the entries in `values`; returns what `factor` does."""
    r, n_slots = index[at.SIZE], index[at.N_SLOTS]
    in_column = slots(r) + n_slots
    target = in_column + 2 * n_slots
    upper, end, lower = begin_upper(r), end_upper(r), begin_lower(r)
    smallest, largest, growth = 1e300, 0.0, 0.0
    for i in range(r):
        for s in range(index[lower + i], index[lower + i + 1]):
            k = index[in_column + s]
            multiplier = values[s] * values[k]
            values[s] = multiplier
            growth = max(growth, abs(multiplier))
            for u in range(index[upper + k], index[end + k]):
                values[index[target]] -= multiplier * values[u]
                target += 1
        size = abs(values[i])
        if not size > 0.0:  # also true for NaN
            return -1.0
        smallest = min(smallest, size)
        largest = max(largest, size)
        values[i] = 1.0 / values[i]
    if not growth <= GROWTH:
        return -1.0
    in_row = slots(r)
    for u in range(r, index[at.FIRST_LOWER]):  # rows of U with 1 on the diagonal are quicker to solve with
        values[u] *= values[index[in_row + u]]
    return smallest / largest if r > 0 else 1.0


@merged
def sign_of(index, values):
    """Sign of the determinant, rows and columns ascending, from the factors."""
    r = index[at.SIZE]
    if index[at.DENSE] == 1:
        return lu_sign(values[: r * r].reshape((r, r)), pivots_of(index))
    sign = 1.0 if index[at.SIGN] == 1 else -1.0
    for k in range(r):
        if values[k] < 0.0:
            sign = -sign
    return sign


@merged
def solve(index, values, x):
    """Solve for one right-hand side, overwritten."""
    r, n_slots, first_lower = index[at.SIZE], index[at.N_SLOTS], index[at.FIRST_LOWER]
    if index[at.DENSE] == 1:
        lu_solve(values[: r * r].reshape((r, r)), pivots_of(index), x)
        return
    in_row, in_column = slots(r), slots(r) + n_slots
    for s in range(first_lower, n_slots):
        x[index[in_row + s]] -= values[s] * x[index[in_column + s]]
    for i in range(r):
        x[i] *= values[i]
    for s in range(r, first_lower):
        x[index[in_row + s]] -= values[s] * x[index[in_column + s]]


@merged
def solve_rows(index, values, X, n):
    """Solve for each of the first n rows of X."""
    for j in range(n):
        solve(index, values, X[j])


@merged
def solve_transposed(index, values, x):
    """Solve with the transposed matrix: x is in the order of columns on entry, in that of rows on return."""
    r = index[at.SIZE]
    if index[at.DENSE] == 1:
        A, pivots = values[: r * r].reshape((r, r)), pivots_of(index)
        for k in range(r):
            x[k] *= A[k, k]
            for j in range(k + 1, r):
                x[j] -= A[k, j] * x[k]
        for i in range(r - 1, -1, -1):
            for k in range(i):
                x[k] -= A[i, k] * x[i]
        for k in range(r - 1, -1, -1):
            p = pivots[k]
            if p != k:
                x[k], x[p] = x[p], x[k]
        return
    n_slots, first_lower = index[at.N_SLOTS], index[at.FIRST_LOWER]
    in_row, in_column = slots(r), slots(r) + n_slots
    for s in range(first_lower - 1, r - 1, -1):
        x[index[in_column + s]] -= values[s] * x[index[in_row + s]]
    for i in range(r):
        x[i] *= values[i]
    for s in range(n_slots - 1, first_lower - 1, -1):
        x[index[in_column + s]] -= values[s] * x[index[in_row + s]]

"""LU factors of the dependent columns of the constraint Jacobian, by a program for their pattern.

A mechanism's Jacobian has few entries, always in the same places. The order of elimination is chosen once for each
partition (Markowitz's rule with a threshold), and with it a list of what is to be multiplied and subtracted: to factor
again is to run down this list, without a search for pivots and without a look at zeros. Multipliers that have grown
show that the order suits the numbers no longer. Where the list would be as long as that of a full matrix, the factors
are dense with row exchanges.

The factors of one matrix are two arrays: `index`, the program, and `values`. Vectors to solve for are in the order of
elimination: entry k belongs to row rows_of(index)[k] of the Jacobian, that of the solution to columns_of(index)[k].
"""

from twoloop.kernels.common import compiled, inlined, merged
from twoloop.kernels.linalg import copy, lu_factor, lu_sign, lu_solve

THRESHOLD = 0.1  # of the largest entry in its column, which a pivot must have
GROWTH = 1e3  # largest multiplier before the order of elimination is chosen anew
FULL = 0.5  # of the subtractions of a full matrix, from which on factors are dense
SMALL = 3  # rows up to which they never are
ZERO = 1e-11  # a pivot below this fraction of the largest one counts as zero
LONGEST, PER_ROW = 2000, 100  # a list has at most LONGEST + PER_ROW r subtractions: what memory there is

# places in `index`: the size r, whether the factors are dense, the sign of the permutations, how many entries the
# factors have, the first that is L's, and the columns of the Jacobian; then rows (r), columns (r), row exchanges of
# dense factors (r), where rows of U begin (r) and end (r) and where rows of L begin (r + 1); then of every entry its
# row, its column, and where it comes from; then the targets of the subtractions. Entries: the diagonal, U from its last
# row up, L from its first
SIZE, DENSE, SIGN, N_SLOTS, FIRST_LOWER, WIDTH, N_HEAD = range(7)


def index_size(r: int) -> int:
    """Length of `index` for r rows."""
    return N_HEAD + 6 * r + 1 + 3 * r * r + longest_list(r)


def longest_list(r: int) -> int:
    """How many subtractions a program may have."""
    return min(r * r * (r + 1) // 2, LONGEST + PER_ROW * r)


@inlined
def rows_of(index):
    """Rows of the Jacobian in the order of elimination."""
    return index[N_HEAD : N_HEAD + index[SIZE]]


@inlined
def columns_of(index):
    """Columns of the Jacobian in the order of elimination."""
    return index[N_HEAD + index[SIZE] : N_HEAD + 2 * index[SIZE]]


@inlined
def _pivots_of(index):
    return index[N_HEAD + 2 * index[SIZE] : N_HEAD + 3 * index[SIZE]]


@merged
def _begin_upper(r):
    return N_HEAD + 3 * r


@merged
def _end_upper(r):
    return N_HEAD + 4 * r


@merged
def _begin_lower(r):
    return N_HEAD + 5 * r


@merged
def _entries(r):
    return N_HEAD + 6 * r + 1


@merged
def _swap(A, axis_rows, k, p):
    for j in range(A.shape[0]):
        if axis_rows:
            A[k, j], A[p, j] = A[p, j], A[k, j]
        else:
            A[j, k], A[j, p] = A[j, p], A[j, k]


@compiled
def _choose_pivot(A, used, k, in_row, in_column, largest):
    """Row and column of the next pivot: that with the least fill among those large enough; (-1, -1): none."""
    r = A.shape[0]
    for i in range(k, r):
        in_row[i] = 0
        in_column[i] = 0
        largest[i] = 0.0
    for i in range(k, r):
        for j in range(k, r):
            if used[i, j] != 0.0:
                in_row[i] += 1
                in_column[j] += 1
                largest[j] = max(largest[j], abs(A[i, j]))
    best_cost, best_size, row, column = r * r + 1, 0.0, -1, -1
    for i in range(k, r):
        for j in range(k, r):
            size = abs(A[i, j])
            if used[i, j] != 0.0 and size > 0.0 and size >= THRESHOLD * largest[j]:
                cost = (in_row[i] - 1) * (in_column[j] - 1)
                if cost < best_cost or (cost == best_cost and size > best_size):
                    best_cost, best_size, row, column = cost, size, i, j
    return row, column


@compiled
def _eliminate(A, used, k):
    r = A.shape[0]
    for i in range(k + 1, r):
        if used[i, k] != 0.0:
            A[i, k] /= A[k, k]
            for j in range(k + 1, r):
                if used[k, j] != 0.0:
                    A[i, j] -= A[i, k] * A[k, j]
                    used[i, j] = 1.0


@compiled
def _order(A, used, index, values):
    """Eliminate with full freedom of choice, leaving the order in `index` and the pattern of the factors in `used`."""
    r = A.shape[0]
    rows, columns = rows_of(index), columns_of(index)
    in_row, in_column = index[_begin_upper(r) : _end_upper(r)], index[_end_upper(r) : _begin_lower(r)]
    first = 0.0
    for k in range(r):
        i, j = _choose_pivot(A, used, k, in_row, in_column, values)
        if i < 0:
            return False
        if i != k:
            _swap(A, True, k, i)
            _swap(used, True, k, i)
            rows[k], rows[i] = rows[i], rows[k]
            index[SIGN] = -index[SIGN]
        if j != k:
            _swap(A, False, k, j)
            _swap(used, False, k, j)
            columns[k], columns[j] = columns[j], columns[k]
            index[SIGN] = -index[SIGN]
        first = max(first, abs(A[k, k]))
        if not abs(A[k, k]) > ZERO * first:
            return False
        _eliminate(A, used, k)
    return True


@compiled
def _count(used, r):
    """Entries of L and U beside the diagonal, and subtractions that make them."""
    entries, subtractions = 0, 0
    for i in range(r):
        for j in range(r):
            if i != j and used[i, j] != 0.0:
                entries += 1
        for k in range(i):
            if used[i, k] != 0.0:
                for j in range(k + 1, r):
                    if used[k, j] != 0.0:
                        subtractions += 1
    return entries, subtractions


@compiled
def _write(index, used, slots, pattern):
    """Write the program for a pattern of entries; False: one for a full matrix would be quicker."""
    r, width = index[SIZE], pattern.shape[1]
    entries, subtractions = _count(used, r)
    full = (r * (r - 1) * (2 * r - 1)) / 6.0
    if subtractions > LONGEST + PER_ROW * r or (r > SMALL and subtractions > FULL * full):
        return False
    rows, columns = rows_of(index), columns_of(index)
    n_slots = r + entries
    in_row, in_column = _entries(r), _entries(r) + n_slots
    source, target = in_column + n_slots, in_column + 2 * n_slots
    slot = r
    for i in range(r - 1, -1, -1):
        slots[i, i] = i
        index[_begin_upper(r) + i] = slot
        for j in range(i + 1, r):
            if used[i, j] != 0.0:
                slots[i, j] = slot
                slot += 1
        index[_end_upper(r) + i] = slot
    index[N_SLOTS], index[FIRST_LOWER] = n_slots, slot
    for i in range(r):
        index[_begin_lower(r) + i] = slot
        for k in range(i):
            if used[i, k] != 0.0:
                slots[i, k] = slot
                slot += 1
    index[_begin_lower(r) + r] = slot
    for i in range(r):
        for j in range(r):
            if i == j or used[i, j] != 0.0:
                slot = int(slots[i, j])
                index[in_row + slot], index[in_column + slot] = i, j
                # what the factors have and the Jacobian has not is gathered from its last row, which is zero
                given = pattern[rows[i], columns[j]] != 0.0
                index[source + slot] = rows[i] * width + columns[j] if given else pattern.size
        for k in range(i):
            if used[i, k] != 0.0:
                for j in range(k + 1, r):
                    if used[k, j] != 0.0:
                        index[target] = int(slots[i, j])
                        target += 1
    return True


@compiled
def make_program(G, pattern, rows, columns, index, values, A, used):
    """Choose the order of elimination of G[rows][:, columns], whose entries are where `pattern` is not zero.

    A and used (r, r) are scratch. False: the matrix is singular.
    """
    r = rows.size
    index[SIZE] = r
    index[DENSE] = 0
    index[WIDTH] = G.shape[1]
    index[SIGN] = 1
    copy(rows, rows_of(index))
    copy(columns, columns_of(index))
    for i in range(r):
        for k in range(r):
            A[i, k] = G[rows[i], columns[k]]
            used[i, k] = pattern[rows[i], columns[k]]
    if not _order(A, used, index, values):
        return False
    if not _write(index, used, A, pattern):
        index[DENSE] = 1
        index[SIGN] = 1
        copy(rows, rows_of(index))
        copy(columns, columns_of(index))
    return True


@compiled
def factor(entries, index, values):
    """Factor G[rows][:, columns]; 1/pivots on the diagonal. `entries` are those of G (n, n_q), whose last row is zero.

    Returns the ratio of the smallest to the largest pivot; negative where a pivot is zero or not finite, or multipliers
    have grown, and the order must be chosen anew.
    """
    r = index[SIZE]
    if index[DENSE] == 1:
        A = values[: r * r].reshape((r, r))
        rows, columns = rows_of(index), columns_of(index)
        for i in range(r):
            for k in range(r):
                A[i, k] = entries[rows[i] * index[WIDTH] + columns[k]]
        return lu_factor(A, _pivots_of(index))
    n_slots = index[N_SLOTS]
    in_column = _entries(r) + n_slots
    source, target = in_column + n_slots, in_column + 2 * n_slots
    for s in range(n_slots):
        values[s] = entries[index[source + s]]
    begin, end, lower = _begin_upper(r), _end_upper(r), _begin_lower(r)
    smallest, largest, growth = 1e300, 0.0, 0.0
    for i in range(r):
        for s in range(index[lower + i], index[lower + i + 1]):
            k = index[in_column + s]
            multiplier = values[s] * values[k]
            values[s] = multiplier
            growth = max(growth, abs(multiplier))
            for u in range(index[begin + k], index[end + k]):
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
    in_row = _entries(r)
    for u in range(r, index[FIRST_LOWER]):  # rows of U with 1 on the diagonal are quicker to solve with
        values[u] *= values[index[in_row + u]]
    return smallest / largest if r > 0 else 1.0


@merged
def sign_of(index, values):
    """Sign of the determinant, rows and columns ascending, from the factors."""
    r = index[SIZE]
    if index[DENSE] == 1:
        return lu_sign(values[: r * r].reshape((r, r)), _pivots_of(index))
    sign = 1.0 if index[SIGN] == 1 else -1.0
    for k in range(r):
        if values[k] < 0.0:
            sign = -sign
    return sign


@compiled
def solve(index, values, x):
    """Solve for one right-hand side, overwritten."""
    r, n_slots, first_lower = index[SIZE], index[N_SLOTS], index[FIRST_LOWER]
    if index[DENSE] == 1:
        lu_solve(values[: r * r].reshape((r, r)), _pivots_of(index), x)
        return
    in_row, in_column = _entries(r), _entries(r) + n_slots
    for s in range(first_lower, n_slots):
        x[index[in_row + s]] -= values[s] * x[index[in_column + s]]
    for i in range(r):
        x[i] *= values[i]
    for s in range(r, first_lower):
        x[index[in_row + s]] -= values[s] * x[index[in_column + s]]


@compiled
def solve_rows(index, values, X, n):
    """Solve for each of the first n rows of X."""
    for j in range(n):
        solve(index, values, X[j])


@compiled
def solve_transposed(index, values, x):
    """Solve with the transposed matrix: x is in the order of columns on entry, in that of rows on return."""
    r = index[SIZE]
    if index[DENSE] == 1:
        A, pivots = values[: r * r].reshape((r, r)), _pivots_of(index)
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
    n_slots, first_lower = index[N_SLOTS], index[FIRST_LOWER]
    in_row, in_column = _entries(r), _entries(r) + n_slots
    for s in range(first_lower - 1, r - 1, -1):
        x[index[in_column + s]] -= values[s] * x[index[in_row + s]]
    for i in range(r):
        x[i] *= values[i]
    for s in range(n_slots - 1, first_lower - 1, -1):
        x[index[in_column + s]] -= values[s] * x[index[in_row + s]]

"""Factor the dependent columns of the constraint Jacobian by LU, with a program for their pattern of entries.

A mechanism's Jacobian has few nonzero entries, and their pattern does not change. So the order of elimination is chosen
once for each partition (Markowitz's rule with a threshold), and written as a program, a list of operations. Later
factorizations follow this program, without a search for pivots and without tests for zeros. If multipliers of the
elimination become large, another order is chosen. Factors are dense if the program is nearly as long as for a full
matrix.

To choose an order, entries are stored in lists by row and by column, and each step of the elimination uses only the
lists that it changes. So the work grows as the number of rows times the number of entries, not as the rows cubed.

The factors of a matrix are two arrays: `index`, the program, and `values`. Right-hand sides and solutions are in the
order of elimination: entry k of a right-hand side belongs to row rows_of(index)[k] of the Jacobian, and entry k of a
solution to column columns_of(index)[k].
"""

from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.linalg.dense import copy, lu_factor, lu_sign, lu_solve

MIN_PIVOT_RATIO = 0.1  # smallest entry that may be a pivot, relative to the largest entry in its column
MAX_SPARSE_RATIO = 0.5  # sparse factors are used if they need at most this share of the subtractions of dense factors
MAX_SPARSE_ROWS = 3  # up to this number of rows, factors are sparse whatever the number of subtractions
ZERO_PIVOT = 1e-11  # if a pivot is at most this fraction of the largest pivot before it, the matrix is singular
# if a program for r rows needs more than MIN_SUBTRACTIONS + SUBTRACTIONS_PER_ROW * r subtractions, factors are dense
MIN_SUBTRACTIONS, SUBTRACTIONS_PER_ROW = 2000, 100
MAX_ENTRIES_PER_LINE = 64  # largest number of entries in a row or column of sparse factors; with more, they are dense

ORDER_CHOSEN, SINGULAR_MATRIX, TOO_MANY_ENTRIES = range(3)  # codes of `choose_order`; the last means: use dense factors

# indices of the numbers at the beginning of `index`, the program of a factorization
(
    SIZE,  # number of rows r
    DENSE,  # 1: the factors are dense; 0: they are sparse
    SIGN,  # sign (1 or -1) of the permutation of rows times the sign of the permutation of columns
    N_SLOTS,  # number of entries of the sparse factors
    FIRST_LOWER,  # index in `values` of the first entry of L
    WIDTH,  # number of columns of the Jacobian
    N_HEAD,
) = range(7)
# After these numbers, `index` contains the arrays below (r: number of rows). The entries of the factors are numbered in
# this order: diagonal; U without diagonal, from its last row up; L row by row
# - rows (r) and columns (r) of the matrix in the order of elimination; row exchanges of dense factors (r)
# - for each row of U, the number of its first entry (r); for each row of U, 1 + the number of its last entry (r)
# - for each row of L, the number of its first entry (r); 1 + the number of the last entry of L
# - the row of each entry; the column of each entry; the source of each entry: the index of its initial value in
#   `entries`, an argument of `factor`, or of a zero for fill-in
# - for each subtraction, the number of the entry that it changes; then the lists of `views_of_lists`

# indices in `counts` of arrays with one number for each row or column, used while an order of elimination is chosen
(
    ROW_SIZE,  # number of entries in the list of a row
    COLUMN_SIZE,  # number of entries in the list of a column, without eliminated rows
    ACTIVE_ROW_SIZE,  # number of entries of a row in columns that are not eliminated yet
    ROW_POSITION,  # position of a row in the order of elimination that has been chosen so far
    COLUMN_POSITION,  # position of a column in the order of elimination that has been chosen so far
    LOOKUP,  # scratch
    N_COUNTS,
) = range(7)
# indices in `lists`: for each row, the columns and the sources of its entries; for each column, the rows of its entries
COLUMNS, SOURCES, ROWS, N_LISTS = range(4)


def index_size(r: int) -> int:
    """Return the length of `index`, the program that factors a matrix of r rows."""
    return N_HEAD + 6 * r + 1 + (3 + N_LISTS) * r * min(r, MAX_ENTRIES_PER_LINE) + max_subtractions(r) + N_COUNTS * r


def values_size(r: int, may_be_dense: bool = True) -> int:
    """Return the length of `values`, the factors of a matrix of r rows; dense factors fit if `may_be_dense`."""
    return r * (r if may_be_dense else min(r, MAX_ENTRIES_PER_LINE)) + r


def max_subtractions(r: int) -> int:
    """Return the largest number of subtractions in a program for r rows: its memory is allocated for this number."""
    return min(r * r * (r + 1) // 2, MIN_SUBTRACTIONS + SUBTRACTIONS_PER_ROW * r)


@inlined
def rows_of(index):
    """Return the indices of the rows of a factored matrix, in the order of elimination."""
    return index[N_HEAD : N_HEAD + index[SIZE]]


@inlined
def columns_of(index):
    """Return the indices of the columns of a factored matrix, in the order of elimination."""
    return index[N_HEAD + index[SIZE] : N_HEAD + 2 * index[SIZE]]


@inlined
def row_exchanges_of(index):
    """Return the view of `index` for the row exchanges of dense factors, which `lu_factor` stores."""
    return index[N_HEAD + 2 * index[SIZE] : N_HEAD + 3 * index[SIZE]]


@merged
def index_of_upper_begins(r):
    """Return the offset of a list in `index`: for each row of U, the index of its first entry in `values`."""
    return N_HEAD + 3 * r


@merged
def index_of_upper_ends(r):
    """Return the offset of a list in `index`: for each row of U, 1 + the index of its last entry in `values`."""
    return N_HEAD + 4 * r


@merged
def index_of_lower_begins(r):
    """Return the offset of a list in `index`: for each row of L, the index of its first entry in `values`."""
    return N_HEAD + 5 * r


@merged
def index_of_entries(r):
    """Return the offset of a list in `index`: for each entry, its row. The lists of columns and of sources follow."""
    return N_HEAD + 6 * r + 1


@inlined
def views_of_lists(index, values):
    """Return views of the scratch for choosing an order: counts (N_COUNTS, r), lists (N_LISTS, r, w), values (r, w).

    r: number of rows; w: largest number of entries in a row or column. For counts and lists see ROW_SIZE, COLUMNS.
    """
    r = index[SIZE]
    width = min(r, MAX_ENTRIES_PER_LINE)
    counts = index[index.size - N_COUNTS * r :].reshape((N_COUNTS, r))
    lists = index[index.size - (N_COUNTS + N_LISTS * width) * r : index.size - N_COUNTS * r]
    return counts, lists.reshape((N_LISTS, r, width)), values[r : r + r * width].reshape((r, width))


@compiled
def clear_lists(index, r):
    """Store r as the number of rows in `index`, and make the lists of the matrix empty."""
    index[SIZE] = r
    index[DENSE] = 0
    for k in range(index.size - N_COUNTS * r, index.size):
        index[k] = 0


@compiled
def put_entry(matrix, i, j, number, source):
    """Add entry (i, j) = `number` to the lists (source: index of its initial value); return False if one is full."""
    counts, lists, numbers = matrix
    n, m = counts[ROW_SIZE, i], counts[COLUMN_SIZE, j]
    if n == numbers.shape[1] or m == numbers.shape[1]:
        return False
    lists[COLUMNS, i, n], lists[SOURCES, i, n] = j, source
    lists[ROWS, j, m], numbers[j, m] = i, number
    counts[ROW_SIZE, i] += 1
    counts[COLUMN_SIZE, j] += 1
    counts[ACTIVE_ROW_SIZE, i] += 1
    return True


@compiled
def _choose_pivot(matrix, rows, columns, k):
    """Choose pivot number k; return its row and column, or (-1, -1) if no entry is large enough.

    Among the entries that are large enough (see MIN_PIVOT_RATIO), choose the one that causes the least fill-in. If
    several cause equal fill-in, choose the largest of them; among equally large ones, the first in the order so far.
    """
    counts, lists, numbers = matrix
    r = rows.size
    min_entries = r
    for p in range(k, r):
        min_entries = min(min_entries, counts[ACTIVE_ROW_SIZE, rows[p]])
    best_cost, best_size, best_position, row, column = r * r + 1, 0.0, r * r, -1, -1
    for p in range(k, r):
        j = columns[p]
        n_others = counts[COLUMN_SIZE, j] - 1
        if n_others * (min_entries - 1) > best_cost:
            continue
        largest = 0.0
        for m in range(n_others + 1):
            largest = max(largest, abs(numbers[j, m]))
        for m in range(n_others + 1):
            i, size = lists[ROWS, j, m], abs(numbers[j, m])
            if size > 0.0 and size >= MIN_PIVOT_RATIO * largest:
                cost = (counts[ACTIVE_ROW_SIZE, i] - 1) * n_others
                position = counts[ROW_POSITION, i] * r + p
                is_better = cost < best_cost or (cost == best_cost and size > best_size)
                if is_better or (cost == best_cost and size == best_size and position < best_position):
                    best_cost, best_size, best_position, row, column = cost, size, position, i, j
    return row, column


@merged
def _exchange(order, position, k, chosen):
    """Move `chosen` to position k of `order` by an exchange; return its sign, -1, or 1 if nothing was exchanged."""
    previous, exchanged = position[chosen], order[k]
    order[k], order[previous] = chosen, exchanged
    position[chosen], position[exchanged] = k, previous
    return 1 if previous == k else -1


@compiled
def _eliminate_entry(matrix, row, column, pivot, j, zero_source):
    """Subtract from column j the multiple of the pivot column that makes entry (row, j) zero.

    `row` and `column`: indices of the pivot's row and column; `pivot`: its value. Fill-in entries get the source
    `zero_source`, the index of a zero. Return False if there is no space for a fill-in entry.
    """
    counts, lists, numbers = matrix
    for m in range(counts[COLUMN_SIZE, j]):
        counts[LOOKUP, lists[ROWS, j, m]] = m + 1
    position = counts[LOOKUP, row] - 1
    number = numbers[j, position]
    has_space = True
    for m in range(counts[COLUMN_SIZE, column]):
        i = lists[ROWS, column, m]
        if i == row:
            continue
        change, entry = numbers[column, m] / pivot * number, counts[LOOKUP, i]
        if entry > 0:
            numbers[j, entry - 1] -= change
        else:
            has_space = has_space and put_entry(matrix, i, j, -change, zero_source)
    last = counts[COLUMN_SIZE, j] - 1
    for m in range(last + 1):
        counts[LOOKUP, lists[ROWS, j, m]] = 0
    lists[ROWS, j, position], numbers[j, position] = lists[ROWS, j, last], numbers[j, last]
    counts[COLUMN_SIZE, j] = last
    return has_space


@compiled
def choose_order(index, matrix, zero_source, zero_ratio):
    """Choose the pivots by eliminating `matrix` step by step, and store the program in `index`; return a code.

    Codes: ORDER_CHOSEN (`index` is complete); TOO_MANY_ENTRIES (use dense factors); SINGULAR_MATRIX (a pivot is at most
    `zero_ratio` times the largest so far). Fill-in entries get the source `zero_source`, the index of a zero.
    """
    counts, lists, numbers = matrix
    r = index[SIZE]
    rows, columns = rows_of(index), columns_of(index)
    for k in range(r):
        rows[k] = columns[k] = counts[ROW_POSITION, k] = counts[COLUMN_POSITION, k] = k
    index[SIGN] = 1
    largest = 0.0
    for k in range(r):
        i, j = _choose_pivot(matrix, rows, columns, k)
        if i < 0:
            return SINGULAR_MATRIX
        index[SIGN] *= _exchange(rows, counts[ROW_POSITION], k, i) * _exchange(columns, counts[COLUMN_POSITION], k, j)
        pivot = 0.0
        for m in range(counts[COLUMN_SIZE, j]):
            counts[ACTIVE_ROW_SIZE, lists[ROWS, j, m]] -= 1
            if lists[ROWS, j, m] == i:
                pivot = numbers[j, m]
        largest = max(largest, abs(pivot))
        if not abs(pivot) > zero_ratio * largest:
            return SINGULAR_MATRIX
        for n in range(counts[ROW_SIZE, i]):
            column = lists[COLUMNS, i, n]
            if counts[COLUMN_POSITION, column] > k and not _eliminate_entry(matrix, i, j, pivot, column, zero_source):
                return TOO_MANY_ENTRIES
    return ORDER_CHOSEN if _store_program(index, counts, lists) else TOO_MANY_ENTRIES


@compiled
def _sort_row(columns, sources, size, position):
    """Sort the first `size` entries of a row, in place, by the order of elimination of their columns."""
    for n in range(1, size):
        column, source, k = columns[n], sources[n], n
        while k > 0 and position[columns[k - 1]] > position[column]:
            columns[k], sources[k] = columns[k - 1], sources[k - 1]
            k -= 1
        columns[k], sources[k] = column, source


@compiled
def _sort_and_count(rows, counts, lists):
    """Sort the entries of each row by the order of elimination; return how many entries and subtractions there are.

    Store in counts[ACTIVE_ROW_SIZE] the number of entries of each row of U, in the order of elimination.
    """
    position = counts[COLUMN_POSITION]
    entries, subtractions = 0, 0
    for k in range(rows.size):
        i = rows[k]
        _sort_row(lists[COLUMNS, i], lists[SOURCES, i], counts[ROW_SIZE, i], position)
        entries += counts[ROW_SIZE, i]
        n_lower = 0
        while position[lists[COLUMNS, i, n_lower]] < k:
            subtractions += counts[ACTIVE_ROW_SIZE, position[lists[COLUMNS, i, n_lower]]]
            n_lower += 1
        counts[ACTIVE_ROW_SIZE, k] = counts[ROW_SIZE, i] - n_lower - 1
    return entries, subtractions


@compiled
def _store_program(index, counts, lists):
    """Store the program in `index` and return True; or, if dense factors are faster, store nothing and return False."""
    r = index[SIZE]
    rows = rows_of(index)
    n_slots, subtractions = _sort_and_count(rows, counts, lists)
    n_dense = (r * (r - 1) * (2 * r - 1)) / 6.0
    if subtractions > MIN_SUBTRACTIONS + SUBTRACTIONS_PER_ROW * r or (
        r > MAX_SPARSE_ROWS and subtractions > MAX_SPARSE_RATIO * n_dense
    ):
        return False
    row_list, column_list = index_of_entries(r), index_of_entries(r) + n_slots
    source, target = column_list + n_slots, column_list + 2 * n_slots
    slot = r
    for k in range(r - 1, -1, -1):
        index[index_of_upper_begins(r) + k] = slot
        slot += counts[ACTIVE_ROW_SIZE, k]
        index[index_of_upper_ends(r) + k] = slot
    index[N_SLOTS], index[FIRST_LOWER] = n_slots, slot
    for k in range(r):
        i = rows[k]
        index[index_of_lower_begins(r) + k] = slot
        next_upper = index[index_of_upper_begins(r) + k]
        for n in range(counts[ROW_SIZE, i]):
            j = counts[COLUMN_POSITION, lists[COLUMNS, i, n]]
            entry = k
            if j < k:
                entry = slot
                slot += 1
            elif j > k:
                entry = next_upper
                next_upper += 1
            counts[LOOKUP, j] = entry
            index[row_list + entry], index[column_list + entry], index[source + entry] = k, j, lists[SOURCES, i, n]
        for entry in range(index[index_of_lower_begins(r) + k], slot):
            j = index[column_list + entry]
            for u in range(index[index_of_upper_begins(r) + j], index[index_of_upper_ends(r) + j]):
                index[target] = counts[LOOKUP, index[column_list + u]]
                target += 1
    index[index_of_lower_begins(r) + r] = slot
    return True


MAX_MULTIPLIER = 1e3  # largest accepted |multiplier| in an elimination; above, another order of elimination is chosen


@compiled
def make_program(G, pattern, rows, columns, index, values):
    """Store in `index` the program that factors G[rows][:, columns]; return False if this matrix is singular.

    `rows`, `columns`: indices. G may have entries only where `pattern` is not zero; `values` is scratch.
    """
    r, width = rows.size, G.shape[1]
    clear_lists(index, r)
    matrix = views_of_lists(index, values)
    index[WIDTH] = width
    code = ORDER_CHOSEN
    for i in range(r):
        for k in range(r):
            if pattern[rows[i], columns[k]] != 0.0:
                number, source = G[rows[i], columns[k]], rows[i] * width + columns[k]
                if code == ORDER_CHOSEN and not put_entry(matrix, i, k, number, source):
                    code = TOO_MANY_ENTRIES
    if code == ORDER_CHOSEN:
        code = choose_order(index, matrix, pattern.size, ZERO_PIVOT)
    if code == ORDER_CHOSEN:
        for k in range(r):
            rows_of(index)[k], columns_of(index)[k] = rows[rows_of(index)[k]], columns[columns_of(index)[k]]
    elif code == TOO_MANY_ENTRIES:
        index[DENSE] = 1
        index[SIGN] = 1
        copy(rows, rows_of(index))
        copy(columns, columns_of(index))
    return code != SINGULAR_MATRIX


@merged
def factor(entries, index, values):
    """Store in `values` the factors of G[rows][:, columns], 1/pivot on the diagonal; return min|pivot| / max|pivot|.

    `entries` is G, with a last row of zeros, as a vector. If a pivot is zero or not finite, or if a multiplier exceeds
    MAX_MULTIPLIER, return -1 (dense factors: 0): another order of elimination must be chosen.
    """
    r = index[SIZE]
    if index[DENSE] == 1:
        A = values[: r * r].reshape((r, r))
        rows, columns = rows_of(index), columns_of(index)
        for i in range(r):
            for k in range(r):
                A[i, k] = entries[rows[i] * index[WIDTH] + columns[k]]
        return lu_factor(A, row_exchanges_of(index))
    source = index_of_entries(r) + 2 * index[N_SLOTS]
    for s in range(index[N_SLOTS]):
        values[s] = entries[index[source + s]]
    return run_program(index, values)


@merged
def run_program(index, values):
    """Factor the matrix in `values` in place, by the program in `index`; return min|pivot| / max|pivot|.

    Return -1 if a pivot is zero or not finite, or if a multiplier exceeds MAX_MULTIPLIER.
    """
    r, n_slots = index[SIZE], index[N_SLOTS]
    column_list = index_of_entries(r) + n_slots
    target = column_list + 2 * n_slots
    upper, end, lower = index_of_upper_begins(r), index_of_upper_ends(r), index_of_lower_begins(r)
    smallest, largest, largest_multiplier = 1e300, 0.0, 0.0
    for i in range(r):
        for s in range(index[lower + i], index[lower + i + 1]):
            k = index[column_list + s]
            multiplier = values[s] * values[k]
            values[s] = multiplier
            largest_multiplier = max(largest_multiplier, abs(multiplier))
            for u in range(index[upper + k], index[end + k]):
                values[index[target]] -= multiplier * values[u]
                target += 1
        pivot = abs(values[i])
        if not pivot > 0.0:  # also true for NaN
            return -1.0
        smallest = min(smallest, pivot)
        largest = max(largest, pivot)
        values[i] = 1.0 / values[i]
    if not largest_multiplier <= MAX_MULTIPLIER:
        return -1.0
    row_list = index_of_entries(r)
    for u in range(r, index[FIRST_LOWER]):  # divide the rows of U by the diagonal, which makes solutions faster
        values[u] *= values[index[row_list + u]]
    return smallest / largest if r > 0 else 1.0


@merged
def determinant_sign(index, values):
    """Return the sign of the determinant of the factored matrix, with rows and columns in ascending order."""
    r = index[SIZE]
    if index[DENSE] == 1:
        return lu_sign(values[: r * r].reshape((r, r)), row_exchanges_of(index))
    sign = 1.0 if index[SIGN] == 1 else -1.0
    for k in range(r):
        if values[k] < 0.0:
            sign = -sign
    return sign


@merged
def solve(index, values, x):
    """Replace the right-hand side x, in the order of `rows_of`, by the solution, in the order of `columns_of`."""
    r, n_slots, first_lower = index[SIZE], index[N_SLOTS], index[FIRST_LOWER]
    if index[DENSE] == 1:
        lu_solve(values[: r * r].reshape((r, r)), row_exchanges_of(index), x)
        return
    row_list, column_list = index_of_entries(r), index_of_entries(r) + n_slots
    for s in range(first_lower, n_slots):
        x[index[row_list + s]] -= values[s] * x[index[column_list + s]]
    for i in range(r):
        x[i] *= values[i]
    for s in range(r, first_lower):
        x[index[row_list + s]] -= values[s] * x[index[column_list + s]]


@merged
def solve_rows(index, values, X, n):
    """Replace the first n rows of X, each a right-hand side, by the solutions; for the order of entries see `solve`."""
    for j in range(n):
        solve(index, values, X[j])


@merged
def solve_transposed(index, values, x):
    """Replace x, in the order of `columns_of`, by the solution for the transposed matrix, in the order of `rows_of`."""
    r = index[SIZE]
    if index[DENSE] == 1:
        A, pivots = values[: r * r].reshape((r, r)), row_exchanges_of(index)
        for k in range(r):
            x[k] *= A[k, k]
            for j in range(k + 1, r):
                x[j] -= A[k, j] * x[k]
        for i in range(r - 1, -1, -1):
            for k in range(i):
                x[k] -= A[i, k] * x[i]
        for k in range(r - 1, -1, -1):
            pivot_row = pivots[k]
            if pivot_row != k:
                x[k], x[pivot_row] = x[pivot_row], x[k]
        return
    n_slots, first_lower = index[N_SLOTS], index[FIRST_LOWER]
    row_list, column_list = index_of_entries(r), index_of_entries(r) + n_slots
    for s in range(first_lower - 1, r - 1, -1):
        x[index[column_list + s]] -= values[s] * x[index[row_list + s]]
    for i in range(r):
        x[i] *= values[i]
    for s in range(n_slots - 1, first_lower - 1, -1):
        x[index[column_list + s]] -= values[s] * x[index[row_list + s]]

"""Factor the dependent columns of the constraint Jacobian by LU, with a program for their pattern of entries.

A mechanism's Jacobian has few nonzero entries, and their pattern does not change. So the order of elimination is chosen
once for each partition (Markowitz's rule with a threshold), and written as a program, a list of operations. Later
factorizations follow this program, without a search for pivots and without tests for zeros. If entries of L become
large, another order is chosen. Factors are dense if sparse factors would not save half of the operations.

The factors of a matrix are two arrays: `index`, the program, and `values`. Right-hand sides and solutions are in the
order of elimination: entry k of a right-hand side belongs to row rows_of(index)[k] of the Jacobian, and entry k of a
solution to column columns_of(index)[k].
"""

from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.linalg.dense import copy, lu_factor, lu_sign, lu_solve

MIN_PIVOT_RATIO = 0.1  # an entry may be a pivot if its magnitude is at least this fraction of the largest in its column
MAX_SPARSE_RATIO = 0.5  # sparse factors are used if they need at most this share of the subtractions of dense factors
MAX_SPARSE_ROWS = 3  # matrices of at most this number of rows have sparse factors, without regard to MAX_SPARSE_RATIO
ZERO_PIVOT = 1e-11  # if |pivot| is at most this fraction of the largest |pivot| before it, the matrix is singular
# if a program for r rows needs more than MIN_SUBTRACTIONS + SUBTRACTIONS_PER_ROW * r subtractions, factors are dense
MIN_SUBTRACTIONS, SUBTRACTIONS_PER_ROW = 2000, 100
MAX_ENTRIES_PER_LINE = 64  # if a row or column of sparse factors would have more entries than this, factors are dense

ORDER_CHOSEN, SINGULAR_MATRIX, TOO_MANY_ENTRIES = range(3)  # codes of `choose_order`; the last: use dense factors

# indices of the numbers at the beginning of `index`, the program of a factorization
(
    SIZE,  # number of rows of the factored matrix
    DENSE,  # 1: the factors are dense; 0: they are sparse
    SIGN,  # sign (1 or -1) of the permutation of rows times the sign of the permutation of columns
    N_SLOTS,  # number of entries of the sparse factors L and U, with fill-in
    FIRST_LOWER,  # index of the first entry of L in `values`, the array of the factors
    WIDTH,  # number of columns of the whole Jacobian
    N_HEAD,
) = range(7)
# The array `values` contains the diagonal, then the rows of U from the last to the first, then the rows of L from the
# first to the last. The array `index` contains the N_HEAD numbers SIZE to WIDTH, and then
# - row indices of the Jacobian, then its column indices, both in the order of elimination
# - row exchanges by `lu_factor`, if the factors are dense
# - indices in `values` where each row of U begins, where each row of U ends, where each row of L begins, where L ends
# - for each entry of `values`: its row and its column, as positions in the order of elimination; its source, which is
#   the index of its initial value in the argument `entries` of `factor` (for fill-in, `entries` is 0 at this index)
# - for each subtraction of an elimination: index of the entry in `values` that it changes
# - scratch in which `choose_order` works, see `views_of_lists`

# indices in `counts`, scratch for choosing an order: arrays with one number for each row, or for each column
(
    ROW_SIZE,  # for each row: number of its entries
    COLUMN_SIZE,  # for each column: number of its entries in rows that are not eliminated yet
    ACTIVE_ROW_SIZE,  # for each row: number of its entries in columns that are not eliminated yet
    ROW_POSITION,  # for each row: its position in the order of elimination that has been chosen so far
    COLUMN_POSITION,  # for each column: its position in the order of elimination that has been chosen so far
    LOOKUP,  # scratch, for each row (or column): where its entry in the current column (or row) is stored
    N_COUNTS,
) = range(7)
# indices in `lists`, scratch for choosing an order. COLUMNS: for each row, columns of its entries. SOURCES: where the
# initial values of these entries are in the argument `entries` of `factor`. ROWS: for each column, rows of its entries
COLUMNS, SOURCES, ROWS, N_LISTS = range(4)


def index_size(r: int) -> int:
    """Return the length of `index`, the program that factors a matrix of r rows."""
    return N_HEAD + 6 * r + 1 + (3 + N_LISTS) * r * min(r, MAX_ENTRIES_PER_LINE) + max_subtractions(r) + N_COUNTS * r


def values_size(r: int, may_be_dense: bool = True) -> int:
    """Return the length of `values` for r rows: enough for sparse factors, and for dense ones if `may_be_dense`."""
    return r * (r if may_be_dense else min(r, MAX_ENTRIES_PER_LINE)) + r


def max_subtractions(r: int) -> int:
    """Return how many subtractions a program for r rows may have; if more are needed, factors are dense."""
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
    """Return the view of `index` in which `lu_factor` stores the row exchanges of dense factors."""
    return index[N_HEAD + 2 * index[SIZE] : N_HEAD + 3 * index[SIZE]]


@merged
def index_of_upper_begins(r):
    """Return the offset, in a program for r rows, of a list: the indices at which rows of U begin in `values`."""
    return N_HEAD + 3 * r


@merged
def index_of_upper_ends(r):
    """Return the offset, in a program for r rows, of a list: the indices at which rows of U end in `values`."""
    return N_HEAD + 4 * r


@merged
def index_of_lower_begins(r):
    """Return the offset, in a program for r rows, of a list: the indices at which rows of L begin in `values`."""
    return N_HEAD + 5 * r


@merged
def index_of_entries(r):
    """Return where three lists begin in a program for r rows: rows, columns and SOURCES of factor entries."""
    return N_HEAD + 6 * r + 1


@inlined
def views_of_lists(index, values):
    """Return views of the scratch for choosing an order: counts (N_COUNTS, r), lists (N_LISTS, r, w), numbers (r, w).

    r is the number of rows, w the largest number of entries in a row or column. For counts see ROW_SIZE, for lists see
    COLUMNS. Row j of `numbers` contains the values of the entries in column j.
    """
    r = index[SIZE]
    width = min(r, MAX_ENTRIES_PER_LINE)
    counts = index[index.size - N_COUNTS * r :].reshape((N_COUNTS, r))
    lists = index[index.size - (N_COUNTS + N_LISTS * width) * r : index.size - N_COUNTS * r]
    return counts, lists.reshape((N_LISTS, r, width)), values[r : r + r * width].reshape((r, width))


@compiled
def clear_lists(index, r):
    """Empty the lists of entries in `index`, so that `put_entry` can fill them for a matrix of r rows."""
    index[SIZE] = r
    index[DENSE] = 0
    for k in range(index.size - N_COUNTS * r, index.size):
        index[k] = 0


@compiled
def put_entry(matrix, i, j, number, source):
    """Add an entry of value `number` in row i, column j to the lists of a matrix; return False if a list is full.

    `source`: index of the entry's initial value in the array from which later factorizations read the matrix.
    """
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
    """Choose pivot number k by Markowitz's rule; return its row and column, or (-1, -1) if all entries are too small.

    Among the entries that are large enough (see MIN_PIVOT_RATIO), choose the one that can cause the least fill-in. If
    there are several, choose the largest of them; among equally large ones, the first in the order so far.
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
    """Move `chosen` to entry k of `order` by an exchange; return the sign of this permutation (1: no change)."""
    previous, exchanged = position[chosen], order[k]
    order[k], order[previous] = chosen, exchanged
    position[chosen], position[exchanged] = k, previous
    return 1 if previous == k else -1


@compiled
def _eliminate_entry(matrix, row, column, pivot, j, zero_source):
    """Subtract from column j the multiple of the pivot column that makes entry (row, j) zero.

    `row` and `column`: indices of the pivot's row and column; `pivot`: its value. `zero_source`: source of
    fill-in entries, see `put_entry`. Return False if there is no space for a fill-in entry.
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
    """Choose the pivots of a matrix by eliminating it step by step, and store the program in `index`; return a code.

    `matrix`: the views of `views_of_lists`, filled by `put_entry`; the elimination changes them. Codes: ORDER_CHOSEN
    (`index` is complete); TOO_MANY_ENTRIES (use dense factors); SINGULAR_MATRIX (a pivot is at most `zero_ratio` times
    the largest so far). `zero_source`: source (see `put_entry`) of fill-in entries, whose initial value is 0.
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
    for n in range(1, size):
        column, source, k = columns[n], sources[n], n
        while k > 0 and position[columns[k - 1]] > position[column]:
            columns[k], sources[k] = columns[k - 1], sources[k - 1]
            k -= 1
        columns[k], sources[k] = column, source


@compiled
def _sort_and_count(rows, counts, lists):
    """Sort each row's entries by the order of elimination; return the numbers of all entries and all subtractions.

    counts[ACTIVE_ROW_SIZE, k] becomes the number of entries of row k of U, without the diagonal.
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
    """Store the program in `index`, and return True; if dense factors are faster, store nothing and return False."""
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


MAX_MULTIPLIER = 1e3  # if the magnitude of an entry of L exceeds this, another order of elimination is chosen


@compiled
def make_program(G, pattern, rows, columns, index, values):
    """Store in `index` the program that factors G[rows][:, columns]; return False if this matrix is singular.

    G: Jacobian; `rows`, `columns`: indices. Where `pattern` is 0, entries of G are always 0. `values` is scratch.
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
    """Factor the dependent columns of the Jacobian G by the program in `index`; return min|pivot| / max|pivot|.

    `entries` is a vector: the entries of G row by row, then a row of zeros (initial values of fill-in). The factors are
    stored in `values`, with 1/pivot on the diagonal. If a pivot is zero or NaN, or an entry of L exceeds MAX_MULTIPLIER
    (sparse factors only), return 0 (dense) or -1 (sparse): the caller must then choose another order of elimination.
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
    """Factor the matrix in `values` in place by the program in `index`; return min|pivot| / max|pivot|; -1 on failure.

    Failure: a pivot is zero or NaN, or the magnitude of an entry of L exceeds MAX_MULTIPLIER.
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
    """Return the sign of the determinant that a factored matrix has before the reordering of its rows and columns."""
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
    """Replace a right-hand side x, in the order of `rows_of`, by the solution, in the order of `columns_of`."""
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

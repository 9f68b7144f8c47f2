"""Choose dependent coordinates for generated code: pivots in the constraint Jacobian G, in blocks of one or two rows.

Constant pivots are chosen first: they need no division and do not change. Among varying entries that may be pivots (see
MAX_SQUARES), choose the one with the least fill-in, not the largest: so nearby positions mostly have the same pivots.
"""

from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, compiled, i8, kernel, merged

# kinds of entries of the constraint Jacobian G: NONE is always zero, NUMBER is constant, VARIES depends on positions.
# In this module, R contains the rows of G during the elimination, and K (same shape) the kinds of the entries of R.
# columns[i] lists the columns in which row i has an entry that is not NONE; row_sizes[i] is the number of these columns
NONE, NUMBER, VARIES = 0, 1, 2
ROWS_SEARCHED = 4  # to save time, pivot blocks are sought only in the ROWS_SEARCHED rows with the fewest entries
# limits for a pivot block: three pairs, from strict to loose, are tried until a block meets both limits of a pair
# - MAX_SQUARES: a block's equations express its coordinates by other coordinates. The squared coefficients in these
#   equations must have a sum below this limit
# - MIN_SINE_SQUARES: smallest squared sine of the angle between the columns of two pivots; for a single pivot, smallest
#   squared ratio of the pivot to the norm of its column of G
# With the first pair, pivots stay large for 98 % of a turn of a spatial four-bar, with the second for 34 %. Generated
# code fails if a squared sine falls below MIN_PIVOT_SQUARE (generate/null_space.py): even the loosest limit is above it
MAX_SQUARES, MIN_SINE_SQUARES = (4.0, 20.0, 200.0), (0.2**2, 0.1**2, 0.04**2)
MIN_CONSTANT_PIVOT = 1e-3  # smallest constant that may be a pivot, relative to the largest entry of its row
CANCELLATION = 1e-12  # in an elimination, the difference a - b of constants counts as zero up to this fraction of |b|


def scratch_sizes(n_rows: int, n: int) -> tuple[int, int]:
    """Return the lengths of `numbers` and `integers`, the scratch arrays of `choose_dependent_columns`."""
    return n_rows * n + n, 2 * n_rows * n + 3 * n_rows + 2 * n


@compiled
def _find_constant_pivot(R, K, columns, row_active, row_sizes, column_sizes):
    """Return row * n + column of the constant pivot with the least fill-in; -1: none is found. R has n columns."""
    best, best_fill, best_size, (m, n) = -1, 0, 0, R.shape
    for i in range(m):
        if not row_active[i]:
            continue
        largest, size = -1.0, row_sizes[i]
        for j in columns[i, :size]:
            if K[i, j] == NUMBER:
                fill = (size - 1) * (column_sizes[j] - 1)
                if best < 0 or fill < best_fill or (fill == best_fill and size < best_size):
                    if largest < 0.0:
                        largest = 0.0
                        for k in columns[i, :size]:
                            largest = max(largest, abs(R[i, k]))
                    if abs(R[i, j]) > MIN_CONSTANT_PIVOT * largest:
                        best, best_fill, best_size = i * n + j, fill, size
    return best


@compiled
def _is_pivot_block(R, block_columns, squared_norms, i, k, j, l, max_squares, min_sine_square):
    """Return True if rows i, k and columns j, l of R can be a pivot block; for a single pivot, i == k and j == l.

    See MAX_SQUARES: the sum of the squared coefficients of other coordinates must be below `max_squares`; the squared
    sine of the angle between columns j and l must be above `min_sine_square`. `block_columns`: columns in which row i
    or k has an entry; `squared_norms`: squared norm of each column of G.
    """
    total = 0.0
    if i == k:
        square = R[i, j] * R[i, j]
        for c in block_columns:
            if c != j:
                total += R[i, c] * R[i, c]
        return square > min_sine_square * squared_norms[j] and total < max_squares * square
    a, b, c, d = R[i, j], R[i, l], R[k, j], R[k, l]
    determinant = a * d - b * c
    if not determinant * determinant > min_sine_square * (a * a + c * c) * (b * b + d * d):
        return False
    for column in block_columns:
        if column != j and column != l:
            x, y = R[i, column], R[k, column]
            first, second = d * x - b * y, a * y - c * x
            total += first * first + second * second
    return total < max_squares * determinant * determinant


@compiled
def _merge_columns(columns, row_sizes, i, k, union):
    """Store in `union` the columns in which row i or row k has an entry, in ascending order; return their number."""
    n, x, y = 0, 0, 0
    while x < row_sizes[i] or y < row_sizes[k]:
        j = columns[i, x] if x < row_sizes[i] else union.size
        l = columns[k, y] if y < row_sizes[k] else union.size
        union[n] = min(j, l)
        n, x, y = n + 1, x + (j <= l), y + (l <= j)
    return n


@compiled
def _find_varying_pivots(R, K, columns, row_active, row_sizes, column_sizes, squared_norms, rows, union, block):
    """Store in `block` the two rows and two columns of a pivot block of varying entries; return False if none is found.

    For a single pivot, its row and its column are stored twice. `rows` and `union` are scratch.
    """
    n_rows = 0
    for i in range(len(R)):  # sort the rows without a pivot: those with the fewest entries first
        if row_active[i]:
            position = n_rows
            while position > 0 and row_sizes[rows[position - 1]] > row_sizes[i]:
                rows[position] = rows[position - 1]
                position -= 1
            rows[position] = i
            n_rows += 1
    n_searched = min(n_rows, ROWS_SEARCHED)
    for tier in range(len(MAX_SQUARES)):
        for block_size in (2, 1):
            best_fill = -1
            for x in range(n_searched):
                for y in range(x + 1 if block_size == 2 else x, n_searched if block_size == 2 else x + 1):
                    i, k = rows[x], rows[y]
                    n_columns = _merge_columns(columns, row_sizes, i, k, union)
                    for first in range(n_columns):
                        for second in range(*((first + 1, n_columns) if block_size == 2 else (first, first + 1))):
                            j, l = union[first], union[second]
                            fill = column_sizes[j] - (K[i, j] != NONE)
                            if block_size == 2:
                                fill += column_sizes[l] - (K[i, l] != NONE) - (K[k, j] != NONE) - (K[k, l] != NONE)
                            fill *= n_columns - block_size
                            if best_fill < 0 or fill < best_fill:
                                limits = MAX_SQUARES[tier], MIN_SINE_SQUARES[tier]
                                if _is_pivot_block(R, union[:n_columns], squared_norms, i, k, j, l, *limits):
                                    best_fill = fill
                                    block[0], block[1], block[2], block[3] = i, k, j, l
            if best_fill >= 0:
                return True
    return False


@merged
def _append_entry(K, columns, row_sizes, i, j):
    """Append column j to columns[i], the list for row i, unless entry (i, j) is always zero."""
    if K[i, j] != NONE:
        columns[i, row_sizes[i]] = j
        row_sizes[i] += 1


@compiled
def _subtract_multiple(R, K, columns, row_sizes, column_sizes, union, r, j, i):
    """Subtract from row r of R the multiple of row i that makes entry (r, j) zero; entry (i, j) must be 1."""
    factor, kind = R[r, j], K[r, j]
    R[r, j], K[r, j] = 0.0, NONE
    n = _merge_columns(columns, row_sizes, r, i, union)
    for c in columns[i, : row_sizes[i]]:
        change = factor * R[i, c]
        remainder, had_entry = R[r, c] - change, K[r, c] != NONE
        K[r, c] = max(K[r, c], kind, K[i, c])
        if K[r, c] == NUMBER and abs(remainder) <= CANCELLATION * abs(change):
            remainder, K[r, c] = 0.0, NONE
        R[r, c] = remainder
        column_sizes[c] += (K[r, c] != NONE) - had_entry
    row_sizes[r] = 0
    for c in union[:n]:
        _append_entry(K, columns, row_sizes, r, c)


@compiled
def _eliminate(R, K, columns, row_active, row_sizes, column_sizes, union, i, k, j, l):
    """Solve rows i, k of a pivot block for the coordinates j, l; eliminate these from all rows that lack a pivot."""
    row_active[i] = row_active[k] = 0
    n, is_single = _merge_columns(columns, row_sizes, i, k, union), i == k
    a, b, c, d = R[i, j], R[i, l], R[k, j], R[k, l]
    has_a, has_b, has_c, has_d = K[i, j] != NONE, K[i, l] != NONE, K[k, j] != NONE, K[k, l] != NONE
    kind, determinant = K[i, j], a * d - b * c
    row_sizes[i] = row_sizes[k] = 0
    for column in union[:n]:
        x, y = R[i, column], R[k, column]
        has_x, has_y = K[i, column] != NONE, K[k, column] != NONE
        column_sizes[column] -= 1 if is_single else has_x + has_y
        if column in (j, l):
            continue
        if is_single:
            R[i, column], K[i, column] = x / a, max(kind, K[i, column])
        else:
            R[i, column], R[k, column] = (d * x - b * y) / determinant, (a * y - c * x) / determinant
            K[i, column] = VARIES if (has_d and has_x) or (has_b and has_y) else NONE
            K[k, column] = VARIES if (has_a and has_y) or (has_c and has_x) else NONE
            _append_entry(K, columns, row_sizes, k, column)
        _append_entry(K, columns, row_sizes, i, column)
    for r in range(len(R)):
        if row_active[r] and K[r, j] != NONE:
            _subtract_multiple(R, K, columns, row_sizes, column_sizes, union, r, j, i)
        if row_active[r] and K[r, l] != NONE:
            _subtract_multiple(R, K, columns, row_sizes, column_sizes, union, r, l, k)


@kernel(i8(MATRIX, INTEGERS, INTEGERS, i8, VECTOR, INTEGERS, INTEGERS))
def choose_dependent_columns(G, kinds, rows, n_kept, numbers, integers, out):
    """Choose dependent columns of G for the rows rows[:n_kept]; return the number of pivot blocks, or 0 on failure.

    `kinds`: NONE, NUMBER or VARIES for each entry of G, row by row. For each block, `out` receives two rows (indices in
    `rows`) and two columns; for a single pivot, one row twice and one column twice. Scratch: see `scratch_sizes`.
    """
    n = G.shape[1]
    if n_kept > n:
        return 0
    end = n_kept * n
    R, squared_norms = numbers[:end].reshape((n_kept, n)), numbers[end : end + n]
    K, columns = integers[:end].reshape((n_kept, n)), integers[end : 2 * end].reshape((n_kept, n))
    end *= 2
    row_active, row_sizes = integers[end : end + n_kept], integers[end + n_kept : end + 2 * n_kept]
    row_scratch, end = integers[end + 2 * n_kept : end + 3 * n_kept], end + 3 * n_kept
    column_sizes, union = integers[end : end + n], integers[end + n : end + 2 * n]
    squared_norms[:] = 0.0
    column_sizes[:] = 0
    for i in range(n_kept):
        row_active[i], row_sizes[i] = 1, 0
        for j in range(n):
            R[i, j], K[i, j] = G[rows[i], j], kinds[rows[i] * n + j]
            squared_norms[j] += R[i, j] * R[i, j]
            column_sizes[j] += K[i, j] != NONE
            _append_entry(K, columns, row_sizes, i, j)
    n_active, n_blocks, index = n_kept, 0, 0
    while n_active > 0:
        block = out[4 * n_blocks : 4 * n_blocks + 4]
        index = -1 if index < 0 else _find_constant_pivot(R, K, columns, row_active, row_sizes, column_sizes)
        if index >= 0:
            block[0] = block[1] = index // n
            block[2] = block[3] = index % n
        elif not _find_varying_pivots(
            R, K, columns, row_active, row_sizes, column_sizes, squared_norms, row_scratch, union, block
        ):
            return 0
        _eliminate(R, K, columns, row_active, row_sizes, column_sizes, union, block[0], block[1], block[2], block[3])
        n_active, n_blocks = n_active - (1 if block[0] == block[1] else 2), n_blocks + 1
    return n_blocks

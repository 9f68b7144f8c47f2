"""Choose dependent coordinates for generated code, as pivots in rows of G, in blocks of one or two rows.

Constant pivots are chosen first: they need no division and do not change. Among varying entries that are large enough,
those that cause the least fill-in are chosen, not the largest ones, so that nearby positions mostly have equal pivots.
"""

from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, compiled, i8, kernel

NONE, NUMBER, VARIES = 0, 1, 2  # kinds of entries of G: always zero, constant, varying
ROWS_SEARCHED = 4  # pivot blocks are sought only in this number of rows, those with the fewest entries, to save time
# limits of a pivot block, in three tiers, which are tried in this order
# - MAX_SQUARES: largest sum of squares of the changes of the block's coordinates if each other coordinate moves by 1
# - MIN_SINE_SQUARES: smallest squared sine of the angle between the columns of two pivots; for a single pivot, smallest
#   squared ratio of the pivot to the norm of its column of G
# Pivots of the first tier stay large for 98 % of a turn of a spatial four-bar, pivots of the second tier for 34 %. The
# last tier is well above MIN_PIVOT_SQUARE of generate/null_space.py, so that a choice stays valid for some motion
MAX_SQUARES, MIN_SINE_SQUARES = (4.0, 20.0, 200.0), (0.2**2, 0.1**2, 0.04**2)
MIN_CONSTANT_PIVOT = 1e-3  # smallest constant that may be a pivot, relative to the largest entry of its row
CANCELLATION = 1e-12  # largest |a - b| of two constants that counts as zero, relative to |b|


def scratch_sizes(n_rows: int, n: int) -> tuple[int, int]:
    """Return the lengths of `numbers` and `integers`, the scratch arrays of `choose_dependent_columns`."""
    return n_rows * n + n, n_rows * n + 3 * n_rows + 2 * n


@compiled
def _find_constant_pivot(R, K, row_active, row_sizes, column_sizes):
    """Return n * row + column of the constant entry that causes the least fill-in as a pivot; -1 if there is none."""
    best, best_fill, best_size, (m, n) = -1, 0, 0, R.shape
    for i in range(m):
        if not row_active[i]:
            continue
        largest, size = -1.0, row_sizes[i]
        for j in range(n):
            if K[i, j] == NUMBER:
                fill = (size - 1) * (column_sizes[j] - 1)
                if best < 0 or fill < best_fill or (fill == best_fill and size < best_size):
                    if largest < 0.0:
                        largest = 0.0
                        for k in range(n):
                            largest = max(largest, abs(R[i, k]))
                    if abs(R[i, j]) > MIN_CONSTANT_PIVOT * largest:
                        best, best_fill, best_size = i * n + j, fill, size
    return best


@compiled
def _is_pivot_block(R, column_active, squared_norms, i, k, j, l, max_squares, min_sine_square):
    """Return whether rows i, k and columns j, l may be a pivot block; a single pivot has i == k and j == l."""
    n, total = R.shape[1], 0.0
    if i == k:
        square = R[i, j] * R[i, j]
        for c in range(n):
            if column_active[c] and c != j:
                total += R[i, c] * R[i, c]
        return square > min_sine_square * squared_norms[j] and total < max_squares * square
    a, b, c, d = R[i, j], R[i, l], R[k, j], R[k, l]
    determinant = a * d - b * c
    if not determinant * determinant > min_sine_square * (a * a + c * c) * (b * b + d * d):
        return False
    for column in range(n):
        if column_active[column] and column != j and column != l:
            x, y = R[i, column], R[k, column]
            first, second = d * x - b * y, a * y - c * x
            total += first * first + second * second
    return total < max_squares * determinant * determinant


@compiled
def _find_varying_pivots(R, K, row_active, column_active, squared_norms, rows, column_sizes, block):
    """Store the two rows and two columns of a pivot block of varying entries in `block`; return False if none is found.

    A single pivot has its row and its column twice. `rows` and `column_sizes` are scratch.
    """
    m, n = R.shape
    n_rows = 0
    column_sizes[:] = 0
    for i in range(m):  # sort the rows by their numbers of entries
        if row_active[i]:
            row_size = 0
            for j in range(n):
                if column_active[j] and K[i, j] != NONE:
                    row_size += 1
                    column_sizes[j] += 1
            position = n_rows
            while position > 0 and rows[m + position - 1] > row_size:
                rows[position], rows[m + position] = rows[position - 1], rows[m + position - 1]
                position -= 1
            rows[position], rows[m + position] = i, row_size
            n_rows += 1
    n_searched = min(n_rows, ROWS_SEARCHED)
    for tier in range(len(MAX_SQUARES)):
        for block_size in (2, 1):
            best_fill = -1
            for x in range(n_searched):
                for y in range(x + 1 if block_size == 2 else x, n_searched if block_size == 2 else x + 1):
                    i, k = rows[x], rows[y]
                    n_columns = 0
                    for j in range(n):
                        if column_active[j] and (K[i, j] != NONE or K[k, j] != NONE):
                            n_columns += 1
                    for j in range(n):
                        if not column_active[j] or (K[i, j] == NONE and K[k, j] == NONE):
                            continue
                        for l in range(j + 1 if block_size == 2 else j, n if block_size == 2 else j + 1):
                            if not column_active[l] or (K[i, l] == NONE and K[k, l] == NONE):
                                continue
                            fill = column_sizes[j] - (K[i, j] != NONE)
                            if block_size == 2:
                                fill += column_sizes[l] - (K[i, l] != NONE) - (K[k, j] != NONE) - (K[k, l] != NONE)
                            fill *= n_columns - block_size
                            if best_fill >= 0 and fill >= best_fill:
                                continue
                            if _is_pivot_block(
                                R, column_active, squared_norms, i, k, j, l, MAX_SQUARES[tier], MIN_SINE_SQUARES[tier]
                            ):
                                best_fill = fill
                                block[0], block[1], block[2], block[3] = i, k, j, l
            if best_fill >= 0:
                return True
    return False


@compiled
def _subtract_multiple(R, K, column_active, row_sizes, column_sizes, r, j, i):
    """Subtract from row r the multiple of row i that removes entry (r, j); entry (i, j) is 1."""
    factor, kind = R[r, j], K[r, j]
    R[r, j], K[r, j] = 0.0, NONE
    if kind == NONE:
        return
    row_sizes[r] -= 1
    for c in range(R.shape[1]):
        if column_active[c] and K[i, c] != NONE:
            change = factor * R[i, c]
            remainder, had_entry = R[r, c] - change, K[r, c] != NONE
            K[r, c] = max(K[r, c], kind, K[i, c])
            if K[r, c] == NUMBER and abs(remainder) <= CANCELLATION * abs(change):
                remainder, K[r, c] = 0.0, NONE
            R[r, c] = remainder
            n_new = (K[r, c] != NONE) - had_entry
            row_sizes[r], column_sizes[c] = row_sizes[r] + n_new, column_sizes[c] + n_new


@compiled
def _eliminate(R, K, row_active, column_active, row_sizes, column_sizes, i, k, j, l):
    """Solve row i for column j if i == k, else rows i and k for columns j and l; then eliminate these columns.

    `row_sizes` and `column_sizes`, the numbers of entries left in each row and column, are updated correctly only if
    i == k.
    """
    m, n = R.shape
    row_active[i] = row_active[k] = column_active[j] = column_active[l] = 0
    if i == k:
        pivot, kind = R[i, j], K[i, j]
        for c in range(n):
            if column_active[c] and K[i, c] != NONE:
                R[i, c] /= pivot
                K[i, c] = max(kind, K[i, c])
                column_sizes[c] -= 1
    else:
        a, b, c, d = R[i, j], R[i, l], R[k, j], R[k, l]
        has_a, has_b, has_c, has_d = K[i, j] != NONE, K[i, l] != NONE, K[k, j] != NONE, K[k, l] != NONE
        determinant = a * d - b * c
        for column in range(n):
            if column_active[column]:
                x, y = R[i, column], R[k, column]
                has_x, has_y = K[i, column] != NONE, K[k, column] != NONE
                R[i, column], R[k, column] = (d * x - b * y) / determinant, (a * y - c * x) / determinant
                K[i, column] = VARIES if (has_d and has_x) or (has_b and has_y) else NONE
                K[k, column] = VARIES if (has_a and has_y) or (has_c and has_x) else NONE
    for r in range(m):
        if row_active[r]:
            _subtract_multiple(R, K, column_active, row_sizes, column_sizes, r, j, i)
            if i != k:
                _subtract_multiple(R, K, column_active, row_sizes, column_sizes, r, l, k)


@kernel(i8(MATRIX, INTEGERS, INTEGERS, i8, VECTOR, INTEGERS, INTEGERS))
def choose_dependent_columns(G, kinds, rows, n_kept, numbers, integers, out):
    """Choose dependent columns of G for the rows rows[:n_kept]; return the number of pivot blocks, or 0 on failure.

    `kinds` has the kind of each entry of G, row by row. `out` receives two rows (as indices in `rows`) and two columns
    of each block; a single pivot has its row and its column twice. `numbers` and `integers` are scratch, see
    `scratch_sizes`.
    """
    n = G.shape[1]
    if n_kept > n:
        return 0
    R, K = numbers[: n_kept * n].reshape((n_kept, n)), integers[: n_kept * n].reshape((n_kept, n))
    end = n_kept * n
    squared_norms = numbers[end : end + n]
    squared_norms[:] = 0.0
    row_active, row_scratch = integers[end : end + n_kept], integers[end + n_kept : end + 3 * n_kept]
    row_sizes, end = row_scratch[:n_kept], end + 3 * n_kept
    column_active, column_sizes = integers[end : end + n], integers[end + n : end + 2 * n]
    column_active[:] = 1
    column_sizes[:] = 0
    for i in range(n_kept):
        row_active[i], row_sizes[i] = 1, 0
        for j in range(n):
            R[i, j], K[i, j] = G[rows[i], j], kinds[rows[i] * n + j]
            squared_norms[j] += R[i, j] * R[i, j]
            is_entry = K[i, j] != NONE
            row_sizes[i], column_sizes[j] = row_sizes[i] + is_entry, column_sizes[j] + is_entry
    n_active, n_blocks = n_kept, 0
    while n_active > 0:
        block = out[4 * n_blocks : 4 * n_blocks + 4]
        index = _find_constant_pivot(R, K, row_active, row_sizes, column_sizes)
        if index < 0:
            break
        block[0] = block[1] = index // n
        block[2] = block[3] = index % n
        _eliminate(R, K, row_active, column_active, row_sizes, column_sizes, block[0], block[1], block[2], block[3])
        n_active, n_blocks = n_active - 1, n_blocks + 1
    while n_active > 0:
        block = out[4 * n_blocks : 4 * n_blocks + 4]
        if not _find_varying_pivots(R, K, row_active, column_active, squared_norms, row_scratch, column_sizes, block):
            return 0
        _eliminate(R, K, row_active, column_active, row_sizes, column_sizes, block[0], block[1], block[2], block[3])
        n_active, n_blocks = n_active - (1 if block[0] == block[1] else 2), n_blocks + 1
    return n_blocks

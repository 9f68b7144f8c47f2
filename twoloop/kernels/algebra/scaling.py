"""Units in which entries of a matrix are of like size, and how far its rows stay what they are (checks/scales.py)."""

import math

from numba import types

from twoloop.kernels.data.common import MATRIX, VECTOR, exact, f8, kernel

NO_ENTRY = 1e-12  # of the largest in a row: what rounding has left
TURNS = 20  # of the least squares by turns, at most
NEGLIGIBLE = 1e-6  # of the largest coordinate: smaller ones are zero by chance and are no size


@exact
def _sort(values):
    for k in range(1, values.size):
        value, i = values[k], k
        while i > 0 and values[i - 1] > value:
            values[i] = values[i - 1]
            i -= 1
        values[i] = value


@exact
def _columns_from(rows, columns, counts, logs):
    """The units that fit best to norms of the rows; whether they are those from before."""
    same = True
    for j in range(columns.size):
        total, n = 0.0, 0
        for i in range(rows.size):
            if counts[i, j] != 0.0:
                total += rows[i] - logs[i, j]
                n += 1
        new = total / n if n > 0 else 0.0
        same = same and new == columns[j]
        columns[j] = new
    return same


@exact
def _rows_from(columns, rows, counts, logs):
    for i in range(rows.size):
        total, n = 0.0, 0
        for j in range(columns.size):
            if counts[i, j] != 0.0:
                total += logs[i, j] + columns[j]
                n += 1
        rows[i] = total / n if n > 0 else 0.0


@kernel(types.void(MATRIX, VECTOR, VECTOR, MATRIX, MATRIX, VECTOR, VECTOR))
def like_sizes(matrix, typical, columns, counts, logs, rows, room):
    """Units of the columns, by least squares of log|entry| + column - row; of zero columns, the typical ones.

    The unit of the whole, which is free, is the median of the typical ones. The other arrays are scratch.
    """
    n_used, shift = 0, 0.0
    for i in range(rows.size):
        largest = 0.0
        for j in range(columns.size):
            largest = max(largest, abs(matrix[i, j]))
        for j in range(columns.size):
            counts[i, j] = 1.0 if abs(matrix[i, j]) > NO_ENTRY * largest else 0.0
            logs[i, j] = math.log(abs(matrix[i, j])) if counts[i, j] != 0.0 else 0.0
    for j in range(columns.size):
        columns[j] = 0.0
    for _ in range(TURNS):
        _rows_from(columns, rows, counts, logs)
        if _columns_from(rows, columns, counts, logs):
            break
    for j in range(columns.size):
        used = False
        for i in range(rows.size):
            used = used or counts[i, j] != 0.0
        if used:
            room[n_used] = math.log(typical[j]) - columns[j]
            n_used += 1
        else:
            columns[j] = math.nan
    if n_used > 0:
        _sort(room[:n_used])
        shift = 0.5 * (room[(n_used - 1) // 2] + room[n_used // 2])
    for j in range(columns.size):
        columns[j] = typical[j] if math.isnan(columns[j]) else math.exp(columns[j] + shift)


@kernel(types.void(MATRIX, VECTOR, f8, VECTOR, VECTOR))
def reaches(in_units, radius, negligible, room, reach):
    """How far each row stays what it is: its radius, or the values of its coordinates where it is straight beside them.

    Of these it is the smaller half that counts, so that an offset does not; values that are negligible do not.
    """
    for i in range(reach.size):
        largest, n = 0.0, 0
        for j in range(in_units.shape[1]):
            largest = max(largest, in_units[i, j])
        reach[i] = 1.0
        if radius[i] <= max(largest, 1.0):
            reach[i] = radius[i]
        elif largest > negligible:
            for j in range(in_units.shape[1]):
                if in_units[i, j] > NEGLIGIBLE * largest:
                    room[n] = in_units[i, j]
                    n += 1
            _sort(room[:n])
            reach[i] = room[(n - 1) // 2]

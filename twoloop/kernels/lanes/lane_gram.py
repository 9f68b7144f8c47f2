"""Rows G of constraints in lanes: the least change that they ask for, by Cholesky's factors of G G^T.

Rows have length 1. Redundant rows depend on one another on the constraints, and beside them only nearly: combinations
of rows that vanish there, the vectors Z, are left out, as the sum of z z^T is added to G G^T.

`pattern` says where in it the columns of the entries of each row begin, and end, and these columns.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.lanes.lane_algebra import copy_vectors
from twoloop.kernels.lanes.lane_room import LANES, fill_field

LEAST = 1e-15  # is added to G G^T, so that it has an inverse ...
MORE = 1e-8  # ... where some of its eigenvalues vanish
WEAK = 1e-4  # eigenvalue, of the largest, from which on redundant rows count
ITERATIONS = 5  # of inverse iteration for eigenvectors of eigenvalues that do not count, which are far smaller
GOLDEN = 0.6180339887498949


@merged
def _subtract_four(room, target, x, dx, y, dy, count):
    t0, t1, t2, t3 = room[target], room[target + 1], room[target + 2], room[target + 3]
    for _ in range(count):
        t0 -= room[x] * room[y]
        t1 -= room[x + 1] * room[y + 1]
        t2 -= room[x + 2] * room[y + 2]
        t3 -= room[x + 3] * room[y + 3]
        x += dx
        y += dy
    room[target], room[target + 1], room[target + 2], room[target + 3] = t0, t1, t2, t3


@compiled
def subtract_products(room, target, x, dx, y, dy, count):
    """target -= the sum of products of vectors that are dx and dy apart, in each lane."""
    for k in range(0, LANES, 4):
        _subtract_four(room, target * LANES + k, x * LANES + k, dx * LANES, y * LANES + k, dy * LANES, count)


@merged
def subtract_row(room, target, entries, pattern, i, y):
    """target -= row i of G y, whose entries stand behind one another."""
    for e in range(pattern[i], pattern[i + 1]):
        subtract_products(room, target, entries + e - pattern[0], 1, y + pattern[e], 1, 1)


@compiled
def _scale(room, target, factor):
    for k in range(LANES):
        room[target * LANES + k] *= room[factor * LANES + k]


@compiled
def _invert_gram(room, pattern, n_rows, n_redundant, row, factors, shift):
    """Cholesky's factors of the sum of G G^T, shift and z z^T of each z, with 1 over their diagonal."""
    n_entries = pattern[n_rows] - pattern[0]
    gram = factors + n_entries + n_rows
    Z = gram + n_rows * n_rows
    for i in range(n_rows):
        for e in range(pattern[i], pattern[i + 1]):
            copy_vectors(room, factors + e - pattern[0], row + pattern[e], 1)
        for j in range(i + 1):
            entry = gram + i * n_rows + j
            fill_field(room, entry, -shift if i == j else 0.0)
            subtract_row(room, entry, factors, pattern, j, row)
            subtract_products(room, entry, Z + i, n_rows, Z + j, n_rows, n_redundant)
            for k in range(LANES):
                room[entry * LANES + k] *= -1.0
            subtract_products(room, entry, gram + i * n_rows, 1, gram + j * n_rows, 1, j)
            if i > j:
                _scale(room, entry, gram + j * n_rows + j)
        for k in range(LANES):
            pivot = room[(gram + i * n_rows + i) * LANES + k]
            room[(gram + i * n_rows + i) * LANES + k] = 1.0 / np.sqrt(pivot) if pivot > 0.0 else np.nan
        for e in range(pattern[i], pattern[i + 1]):
            fill_field(room, row + pattern[e], 0.0)


@compiled
def factor_gram(room, pattern, moves, n_rows, n_redundant, G, row, factors):
    """Rows of length 1 of what may move, 1 over their lengths, factors of `_invert_gram`, Z, and a spare vector."""
    n_entries = pattern[n_rows] - pattern[0]
    for i in range(n_rows):
        length = factors + n_entries + i
        fill_field(room, length, 0.0)
        for e in range(pattern[i], pattern[i + 1]):
            entry = e - pattern[0]
            if moves[pattern[e]] == 1:
                copy_vectors(room, G + entry, factors + entry, 1)
                subtract_products(room, length, G + entry, 1, G + entry, 1, 1)
            else:
                fill_field(room, factors + entry, 0.0)
        for k in range(LANES):
            square = -room[length * LANES + k]
            room[length * LANES + k] = 1.0 / np.sqrt(square) if square != 0.0 else 1.0
        for e in range(pattern[i], pattern[i + 1]):
            _scale(room, factors + e - pattern[0], length)
    if n_redundant > 0:
        _find_redundant(room, pattern, n_rows, n_redundant, row, factors)
    _invert_gram(room, pattern, n_rows, n_redundant, row, factors, LEAST)


@compiled
def _find_redundant(room, pattern, n_rows, n_redundant, row, factors):
    """Z, eigenvectors of the smallest eigenvalues of G G^T; NaN where these are not small."""
    gram = factors + pattern[n_rows] - pattern[0] + n_rows
    Z = gram + n_rows * n_rows
    spare = Z + n_redundant * n_rows
    _invert_gram(room, pattern, n_rows, 0, row, factors, MORE)
    for w in range(n_redundant):
        z = Z + w * n_rows
        for i in range(n_rows):
            fill_field(room, z + i, 0.5 + (GOLDEN * (i + 1) * (w + 1)) % 1.0)
        for _ in range(ITERATIONS):
            normalise(room, z, n_rows, spare)
            _solve(room, n_rows, gram, z)
            _leave_out(room, n_rows, w, Z, z, spare)
        normalise(room, z, n_rows, spare)
        for k in range(LANES):
            if not room[spare * LANES + k] < WEAK:  # the eigenvalue and MORE
                room[z * LANES + k] = np.nan


@compiled
def normalise(room, x, n_rows, spare):
    """x becomes of length 1, and `spare` 1 over what it was."""
    fill_field(room, spare, 0.0)
    subtract_products(room, spare, x, 1, x, 1, n_rows)
    for k in range(LANES):
        room[spare * LANES + k] = 1.0 / np.sqrt(abs(room[spare * LANES + k]))
    for i in range(n_rows):
        _scale(room, x + i, spare)


@compiled
def _leave_out(room, n_rows, n_redundant, Z, x, spare):
    """x less its parts in Z."""
    for w in range(n_redundant):
        z = Z + w * n_rows
        fill_field(room, spare, 0.0)
        subtract_products(room, spare, z, 1, x, 1, n_rows)
        for k in range(LANES):
            room[spare * LANES + k] *= -1.0
        for i in range(n_rows):
            subtract_products(room, x + i, z + i, 1, spare, 1, 1)


@compiled
def _solve(room, n_rows, gram, x):
    """x becomes the solution y of the factors' matrix y = x."""
    for i in range(n_rows):
        subtract_products(room, x + i, gram + i * n_rows, 1, x, 1, i)
        _scale(room, x + i, gram + i * n_rows + i)
    for i in range(n_rows - 1, -1, -1):
        subtract_products(room, x + i, gram + (i + 1) * n_rows + i, n_rows, x + i + 1, 1, n_rows - 1 - i)
        _scale(room, x + i, gram + i * n_rows + i)


@compiled
def along_rows(room, pattern, n, n_rows, n_redundant, factors, x, out):
    """x becomes the solution y of G G^T y = x, of rows of length 1, without what is redundant, and out = -G^T y."""
    gram = factors + pattern[n_rows] - pattern[0] + n_rows
    Z = gram + n_rows * n_rows
    _leave_out(room, n_rows, n_redundant, Z, x, Z + n_redundant * n_rows)
    _solve(room, n_rows, gram, x)
    for j in range(n):
        fill_field(room, out + j, 0.0)
    for i in range(n_rows):
        for e in range(pattern[i], pattern[i + 1]):
            subtract_products(room, out + pattern[e], x + i, 1, factors + e - pattern[0], 1, 1)


@compiled
def least_change(room, pattern, n, n_rows, n_redundant, factors, x, change):
    """The smallest change with G change = -x; not finite where rows depend on one another. x is lost."""
    for i in range(n_rows):
        _scale(room, x + i, factors + pattern[n_rows] - pattern[0] + i)
    along_rows(room, pattern, n, n_rows, n_redundant, factors, x, change)

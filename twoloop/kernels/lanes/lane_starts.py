"""Guesses in lanes put on the constraints by the least change, and whether there is another assembly about as near.

Gauss-Newton with rows of length 1, and Cholesky's factors of G G^T. Lanes are independent of one another.
"""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.data.common import INTEGERS, compiled, kernel, merged
from twoloop.kernels.lanes.lane_algebra import copy_vectors
from twoloop.kernels.lanes.lane_room import (
    AHEAD,
    CODE,
    FINE,
    LANES,
    LEFT_TO_MOVE,
    N_NUMBERS,
    N_ROWS,
    RUNNING,
    T0,
    N,
    fill_field,
    places_of,
)

MOST_ITERATIONS = 12
AT_ROUNDING = 64.0  # times rounding of its terms: an equation of a start that holds
STRAIGHT = 0.25  # of a displacement: how far its projection may end from where C_q sends it
SINGULAR = 1e-12  # smallest eigenvalue of G G^T, rows of length 1, that counts ...
LEAST = 1e-15  # ... and what is added to it, so that it has an inverse
INVERSE_ITERATIONS = 10  # for the eigenvector of the smallest eigenvalue
GOLDEN = 0.6180339887498949
WAYS = ((-2.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # off a state that was found: parts of the guess's way, of the weakest


def places_of_starts(n, n_rows, n_free):
    """Where in `room` stand, from the memory of the method on, and how long all of it is.

    C, C_t and G, as the code writes them; numbers of rows; changes of the coordinates that may move; positions found
    (n); the way there; the direction in which rows say least; a way off; factors, see `_factor`, there and at NEW.
    """
    G = 2 * n_rows
    x = G + n_rows * n
    change = x + n_rows
    found = change + n_free
    moved = found + n
    weakest = moved + n_free
    way = weakest + n_free
    there = way + n_free
    here = there + n_rows * (n_free + 1 + n_rows)
    return G, x, change, found, moved, weakest, way, there, here, here + n_rows * (n_free + 1 + n_rows)


_places = merged(places_of_starts)


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
def _subtract_products(room, target, x, dx, y, dy, count):
    """target -= the sum of products of vectors that are dx and dy apart, in each lane."""
    for k in range(0, LANES, 4):
        _subtract_four(room, target * LANES + k, x * LANES + k, dx * LANES, y * LANES + k, dy * LANES, count)


@compiled
def _scale(room, target, factor):
    for k in range(LANES):
        room[target * LANES + k] *= room[factor * LANES + k]


@compiled
def _factor(room, free, n, n_rows, G, factors):
    """Rows of length 1 of what may move, 1 over their lengths, and Cholesky's factors, whose diagonal is inverted."""
    n_free = free.size
    lengths, gram = factors + n_rows * n_free, factors + n_rows * (n_free + 1)
    for i in range(n_rows):
        fill_field(room, lengths + i, 0.0)
        for j in range(n_free):
            entry = G + i * n + free[j]
            copy_vectors(room, entry, factors + i * n_free + j, 1)
            _subtract_products(room, lengths + i, entry, 1, entry, 1, 1)
        for k in range(LANES):
            square = -room[(lengths + i) * LANES + k]
            room[(lengths + i) * LANES + k] = 1.0 / np.sqrt(square) if square != 0.0 else 1.0
        for j in range(n_free):
            _scale(room, factors + i * n_free + j, lengths + i)
    for i in range(n_rows):
        for j in range(i + 1):
            entry = gram + i * n_rows + j
            fill_field(room, entry, -LEAST if i == j else 0.0)
            _subtract_products(room, entry, factors + i * n_free, 1, factors + j * n_free, 1, n_free)
            for k in range(LANES):
                room[entry * LANES + k] *= -1.0
            _subtract_products(room, entry, gram + i * n_rows, 1, gram + j * n_rows, 1, j)
            if i > j:
                _scale(room, entry, gram + j * n_rows + j)
        for k in range(LANES):
            pivot = room[(gram + i * n_rows + i) * LANES + k]
            room[(gram + i * n_rows + i) * LANES + k] = 1.0 / np.sqrt(pivot) if pivot > 0.0 else np.nan


@compiled
def _solve(room, n_rows, gram, x):
    """x becomes the solution of G G^T y = x, of rows of length 1."""
    for i in range(n_rows):
        _subtract_products(room, x + i, gram + i * n_rows, 1, x, 1, i)
        _scale(room, x + i, gram + i * n_rows + i)
    for i in range(n_rows - 1, -1, -1):
        _subtract_products(room, x + i, gram + (i + 1) * n_rows + i, n_rows, x + i + 1, 1, n_rows - 1 - i)
        _scale(room, x + i, gram + i * n_rows + i)


@compiled
def _along_rows(room, n_rows, n_free, factors, x, out):
    """out = -G^T x, of rows of length 1."""
    for j in range(n_free):
        fill_field(room, out + j, 0.0)
        _subtract_products(room, out + j, x, 1, factors + j, n_free, n_rows)


@compiled
def _least_change(room, n_rows, n_free, factors, x, change):
    """The smallest change with G change = -x; not finite where rows depend on one another. x is lost."""
    for i in range(n_rows):
        _scale(room, x + i, factors + n_rows * n_free + i)
    _solve(room, n_rows, factors + n_rows * (n_free + 1), x)
    _along_rows(room, n_rows, n_free, factors, x, change)


@merged
def _largest(room, place, count, k):
    largest = 0.0
    for j in range(count):
        size = abs(room[(place + j) * LANES + k])
        largest = largest if size <= largest else size  # NaN stays
    return largest


@merged
def _length(room, place, count, k):
    total = 0.0
    for j in range(count):
        total += room[(place + j) * LANES + k] ** 2
    return np.sqrt(total)


@merged
def _holds(room, n, n_rows, C, G, new, k):
    """Whether each constraint is what rounding of its terms may leave."""
    allowed = AT_ROUNDING * np.finfo(np.float64).eps * _largest(room, new, n, k)
    for i in range(n_rows):
        off, terms = abs(room[(C + i) * LANES + k]), 0.0
        for j in range(n):
            terms += abs(room[(G + i * n + j) * LANES + k])
        if off != 0.0 and not off <= allowed * terms:
            return False
    return True


@compiled
def _gauss_newton(code, settings, control, free, room):
    """NEW onto the constraints by steps of least change; RUNNING stays where that could be done."""
    n, n_rows, n_free = settings[N], settings[N_ROWS], free.size
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    G, x, change, _, _, _, _, _, here, _ = _places(n, n_rows, n_free)
    G, x, change, factors = memory + G, memory + x, memory + change, memory + here
    for k in range(LANES):
        room[LEFT_TO_MOVE * LANES + k] = room[RUNNING * LANES + k]
    for _ in range(MOST_ITERATIONS):
        fill_field(room, FINE, 1.0)
        code.rows(0, control, room)
        _factor(room, free, n, n_rows, G, factors)
        copy_vectors(room, memory, x, n_rows)
        _least_change(room, n_rows, n_free, factors, x, change)
        left = 0.0
        for k in range(LANES):
            if room[LEFT_TO_MOVE * LANES + k] == 0.0:
                continue
            if room[FINE * LANES + k] == 0.0 or not _largest(room, change, n_free, k) < np.inf:
                room[LEFT_TO_MOVE * LANES + k] = room[RUNNING * LANES + k] = 0.0
                continue
            for j in range(n_free):
                room[(new + free[j]) * LANES + k] += room[(change + j) * LANES + k]
            # after the change, which is applied to the last bit
            if _holds(room, n, n_rows, memory, G, new, k):
                room[LEFT_TO_MOVE * LANES + k] = 0.0
            else:
                left += 1.0
        if left == 0.0:
            return
    for k in range(LANES):
        if room[LEFT_TO_MOVE * LANES + k] == 1.0:
            room[RUNNING * LANES + k] = 0.0


@compiled
def _change_velocities(code, settings, control, free, room):
    """Velocities of NEW onto the rows at its positions, whose factors are then there."""
    n, n_rows, n_free = settings[N], settings[N_ROWS], free.size
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    G, x, change, _, _, _, _, there, _, _ = _places(n, n_rows, n_free)
    G, x, change, factors = memory + G, memory + x, memory + change, memory + there
    fill_field(room, FINE, 1.0)
    code.rows(0, control, room)
    _factor(room, free, n, n_rows, G, factors)
    for _ in range(2):  # once more for what rounding of a large change leaves
        for i in range(n_rows):
            fill_field(room, x + i, 0.0)
            _subtract_products(room, x + i, G + i * n, 1, new + n, 1, n)
            for k in range(LANES):
                room[(x + i) * LANES + k] = room[(memory + n_rows + i) * LANES + k] - room[(x + i) * LANES + k]
        _least_change(room, n_rows, n_free, factors, x, change)
        for j in range(n_free):
            for k in range(LANES):
                room[(new + n + free[j]) * LANES + k] += room[(change + j) * LANES + k]
    for k in range(LANES):
        if room[FINE * LANES + k] == 0.0 or not _largest(room, new, 2 * n, k) < np.inf:
            room[RUNNING * LANES + k] = 0.0


@compiled
def _look_for_weakest(room, n_rows, n_free, factors, x, moved, weakest):
    """The direction in which rows say least, as far as the guess was moved; RUNNING stays where there is none."""
    for i in range(n_rows):
        fill_field(room, x + i, 0.5 + (GOLDEN * (i + 1)) % 1.0)
    for _ in range(INVERSE_ITERATIONS):
        for k in range(LANES):
            length = _length(room, x, n_rows, k)
            for i in range(n_rows):
                room[(x + i) * LANES + k] /= length
        _solve(room, n_rows, factors + n_rows * (n_free + 1), x)
    _along_rows(room, n_rows, n_free, factors, x, weakest)
    for k in range(LANES):
        if not SINGULAR * _length(room, x, n_rows, k) < 1.0:  # it is as long as 1 over the smallest eigenvalue
            room[RUNNING * LANES + k] = 0.0
        share = _largest(room, moved, n_free, k) / max(_largest(room, weakest, n_free, k), LEAST)
        for j in range(n_free):
            room[(weakest + j) * LANES + k] *= share


@compiled
def _look_for_others(code, settings, control, free, room):
    """RUNNING stays where guesses as far off as this one lead where C_q at FOUND sends them."""
    n, n_rows, n_free = settings[N], settings[N_ROWS], free.size
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    _, x, change, found, moved, weakest, way, there, _, _ = _places(n, n_rows, n_free)
    x, change, found, moved = memory + x, memory + change, memory + found, memory + moved
    weakest, way, factors = memory + weakest, memory + way, memory + there
    _look_for_weakest(room, n_rows, n_free, factors, x, moved, weakest)
    for own, other in WAYS:
        copy_vectors(room, found, new, n)
        for j in range(n_free):
            for k in range(LANES):
                off = own * room[(moved + j) * LANES + k] + other * room[(weakest + j) * LANES + k]
                room[(way + j) * LANES + k] = off
                room[(new + free[j]) * LANES + k] += off
        _gauss_newton(code, settings, control, free, room)
        for i in range(n_rows):
            fill_field(room, x + i, 0.0)
            _subtract_products(room, x + i, factors + i * n_free, 1, way, 1, n_free)
        _solve(room, n_rows, factors + n_rows * (n_free + 1), x)
        _along_rows(room, n_rows, n_free, factors, x, change)  # which is what the rows leave nothing of
        for k in range(LANES):
            apart = 0.0
            for j in range(n_free):
                m = free[j] * LANES + k
                expected = room[found * LANES + m] + room[(way + j) * LANES + k] - room[(change + j) * LANES + k]
                apart = max(apart, abs(room[new * LANES + m] - expected))
            if not apart <= STRAIGHT * _largest(room, way, n_free, k):
                room[RUNNING * LANES + k] = 0.0


_START = types.void(CODE, INTEGERS, VECTOR, INTEGERS, *[types.float64[:, ::1]] * 3, INTEGERS, VECTOR)


@kernel(_START, vectorized=True)
def start_lanes(code, settings, control, free, numbers, q, v, fine, room):
    """Put states, one for each row of `numbers`, on the constraints at t0, in place; `fine`: 1 where that was done.

    free : coordinates that may move.
    """
    n, n_rows, n_runs, n_free = settings[N], settings[N_ROWS], numbers.shape[0], free.size
    _, new, _, _, _, _, own, memory = places_of(n, n_rows, numbers.shape[1])
    _, _, _, found, moved, _, _, _, _, _ = _places(n, n_rows, n_free)
    fill_field(room, AHEAD, control[T0])
    for first in range(0, n_runs, LANES):
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            room[RUNNING * LANES + k] = 1.0
            for j in range(n):
                room[(new + j) * LANES + k], room[(new + n + j) * LANES + k] = q[run, j], v[run, j]
            for i in range(numbers.shape[1]):
                room[(own + i) * LANES + k] = numbers[run, i]
        _gauss_newton(code, settings, control, free, room)
        _change_velocities(code, settings, control, free, room)
        copy_vectors(room, new, memory + found, n)
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            for j in range(n_free):
                room[(memory + moved + j) * LANES + k] = room[(new + free[j]) * LANES + k] - q[run, free[j]]
        _look_for_others(code, settings, control, free, room)
        for k in range(min(LANES, n_runs - first)):
            fine[first + k] = int(room[RUNNING * LANES + k])
            for j in range(n):
                q[first + k, j] = room[(memory + found + j) * LANES + k]
                v[first + k, j] = room[(new + n + j) * LANES + k]

"""Guesses in lanes put on the constraints by the least change, and whether there is another assembly about as near.

Lanes are independent of one another.
"""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.data.common import INTEGERS, compiled, kernel, merged
from twoloop.kernels.lanes.lane_algebra import copy_vectors
from twoloop.kernels.lanes.lane_gram import (
    GOLDEN,
    LEAST,
    WEAK,
    along_rows,
    factor_gram,
    least_change,
    normalise,
    subtract_row,
)
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
SINGULAR = 1e-12  # smallest eigenvalue of G G^T, rows of length 1, that counts
ITERATIONS = 10  # of inverse iteration for the eigenvector of the smallest eigenvalue that counts
N_REDUNDANT = 5  # in `settings`, behind those of lane_room.py: rows that depend on others
WAYS = ((-2.0, 0.0), (0.0, 1.0), (0.0, -1.0))  # off a state that was found: parts of the guess's way, of the weakest


def places_of_starts(n, n_rows, n_entries, n_redundant):
    """Where in `room` stand, from the memory of the method on, and how long all of it is.

    C, C_t and the entries of G, as the code writes them; numbers of rows; changes of positions or velocities; positions
    found; the way there; the direction in which rows say least; a way off; a row; what `factor_gram` makes, there and
    at NEW.
    """
    G = 2 * n_rows
    x = G + n_entries
    change = x + n_rows
    found = change + n
    moved = found + n
    weakest = moved + n
    way = weakest + n
    row = way + n
    there = row + n
    size = n_entries + n_rows * (1 + n_rows + n_redundant) + 1
    return G, x, change, found, moved, weakest, way, row, there, there + size, there + 2 * size


_places = merged(places_of_starts)


@merged
def _largest(room, place, count, k):
    largest = 0.0
    for j in range(count):
        size = abs(room[(place + j) * LANES + k])
        largest = largest if size <= largest else size  # NaN stays
    return largest


@merged
def _holds(room, pattern, n, n_rows, C, G, new, k):
    """Whether each constraint is what rounding of its terms may leave."""
    allowed = AT_ROUNDING * np.finfo(np.float64).eps * _largest(room, new, n, k)
    for i in range(n_rows):
        off, terms = abs(room[(C + i) * LANES + k]), 0.0
        for e in range(pattern[i], pattern[i + 1]):
            terms += abs(room[(G + e - pattern[0]) * LANES + k])
        if off != 0.0 and not off <= allowed * terms:
            return False
    return True


@compiled
def _gauss_newton(code, settings, control, pattern, moves, room):
    """NEW onto the constraints by steps of least change; RUNNING stays where that could be done."""
    n, n_rows, n_redundant = settings[N], settings[N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    G, x, change, _, _, _, _, row, _, here, _ = _places(n, n_rows, pattern[n_rows] - pattern[0], n_redundant)
    G, x, change, row, factors = memory + G, memory + x, memory + change, memory + row, memory + here
    for k in range(LANES):
        room[LEFT_TO_MOVE * LANES + k] = room[RUNNING * LANES + k]
    for _ in range(MOST_ITERATIONS):
        fill_field(room, FINE, 1.0)
        code.rows(0, control, room)
        factor_gram(room, pattern, moves, n_rows, n_redundant, G, row, factors)
        copy_vectors(room, memory, x, n_rows)
        least_change(room, pattern, n, n_rows, n_redundant, factors, x, change)
        left = 0.0
        for k in range(LANES):
            if room[LEFT_TO_MOVE * LANES + k] == 0.0:
                continue
            if room[FINE * LANES + k] == 0.0 or not _largest(room, change, n, k) < np.inf:
                room[LEFT_TO_MOVE * LANES + k] = room[RUNNING * LANES + k] = 0.0
                continue
            for j in range(n):
                room[(new + j) * LANES + k] += room[(change + j) * LANES + k]
            # after the change, which is applied to the last bit
            if _holds(room, pattern, n, n_rows, memory, G, new, k):
                room[LEFT_TO_MOVE * LANES + k] = 0.0
            else:
                left += 1.0
        if left == 0.0:
            return
    for k in range(LANES):
        if room[LEFT_TO_MOVE * LANES + k] == 1.0:
            room[RUNNING * LANES + k] = 0.0


@compiled
def _change_velocities(code, settings, control, pattern, moves, room):
    """Velocities of NEW onto the rows at its positions, whose factors are then there."""
    n, n_rows, n_redundant = settings[N], settings[N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    G, x, change, _, _, _, _, row, there, _, _ = _places(n, n_rows, pattern[n_rows] - pattern[0], n_redundant)
    G, x, change, row, factors = memory + G, memory + x, memory + change, memory + row, memory + there
    fill_field(room, FINE, 1.0)
    code.rows(0, control, room)
    factor_gram(room, pattern, moves, n_rows, n_redundant, G, row, factors)
    for _ in range(2):  # once more for what rounding of a large change leaves
        for i in range(n_rows):
            fill_field(room, x + i, 0.0)
            subtract_row(room, x + i, G, pattern, i, new + n)
            for k in range(LANES):
                room[(x + i) * LANES + k] = room[(memory + n_rows + i) * LANES + k] - room[(x + i) * LANES + k]
        least_change(room, pattern, n, n_rows, n_redundant, factors, x, change)
        for j in range(n * LANES):
            room[(new + n) * LANES + j] += room[change * LANES + j]
    for k in range(LANES):
        if room[FINE * LANES + k] == 0.0 or not _largest(room, new, 2 * n, k) < np.inf:
            room[RUNNING * LANES + k] = 0.0


@compiled
def _look_for_weakest(room, pattern, n, n_rows, n_redundant, factors, x, moved, weakest):
    """The direction in which rows say least, as far as the guess was moved; RUNNING stays where there is none."""
    spare = factors + pattern[n_rows] - pattern[0] + n_rows * (1 + n_rows + n_redundant)
    for i in range(n_rows):
        fill_field(room, x + i, 0.5 + (GOLDEN * (i + 1)) % 1.0)
    for _ in range(ITERATIONS):
        normalise(room, x, n_rows, spare)
        along_rows(room, pattern, n, n_rows, n_redundant, factors, x, weakest)
    normalise(room, x, n_rows, spare)
    least = SINGULAR if n_redundant == 0 else WEAK * n_rows
    for k in range(LANES):
        if not room[spare * LANES + k] > least:  # the smallest eigenvalue
            room[RUNNING * LANES + k] = 0.0
        share = _largest(room, moved, n, k) / max(_largest(room, weakest, n, k), LEAST)
        for j in range(n):
            room[(weakest + j) * LANES + k] *= share


@compiled
def _look_for_others(code, settings, control, pattern, moves, room):
    """RUNNING stays where guesses as far off as this one lead where C_q at FOUND sends them."""
    n, n_rows, n_redundant = settings[N], settings[N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    _, x, change, found, moved, weakest, way, _, there, _, _ = _places(
        n, n_rows, pattern[n_rows] - pattern[0], n_redundant
    )
    x, change, found, moved = memory + x, memory + change, memory + found, memory + moved
    weakest, way, factors = memory + weakest, memory + way, memory + there
    _look_for_weakest(room, pattern, n, n_rows, n_redundant, factors, x, moved, weakest)
    for own, other in WAYS:
        for j in range(n * LANES):
            off = own * room[moved * LANES + j] + other * room[weakest * LANES + j]
            room[way * LANES + j], room[new * LANES + j] = off, room[found * LANES + j] + off
        _gauss_newton(code, settings, control, pattern, moves, room)
        for i in range(n_rows):
            fill_field(room, x + i, 0.0)
            subtract_row(room, x + i, factors, pattern, i, way)
        # the part of the way that rows leave nothing of
        along_rows(room, pattern, n, n_rows, n_redundant, factors, x, change)
        for k in range(LANES):
            apart, rounding = 0.0, AT_ROUNDING * np.finfo(np.float64).eps * _largest(room, found, n, k)
            for j in range(n):
                m = j * LANES + k
                expected = room[found * LANES + m] + room[way * LANES + m] - room[change * LANES + m]
                apart = max(apart, abs(room[new * LANES + m] - expected))
            if not apart <= STRAIGHT * _largest(room, way, n, k) + rounding:
                room[RUNNING * LANES + k] = 0.0


_START = types.void(CODE, INTEGERS, VECTOR, *[INTEGERS] * 2, *[types.float64[:, ::1]] * 3, INTEGERS, VECTOR)


@kernel(_START, vectorized=True)
def start_lanes(code, settings, control, pattern, moves, numbers, q, v, fine, room):
    """Put states, one for each row of `numbers`, on the constraints at t0, in place; `fine`: 1 where that was done.

    pattern : where in it the columns of the entries of each row of G begin, and end, and these columns. moves : (n,)
    1 for coordinates that may.
    """
    n, n_rows, n_redundant, n_runs = settings[N], settings[N_ROWS], settings[N_REDUNDANT], numbers.shape[0]
    _, new, _, _, _, _, own, memory = places_of(n, n_rows, numbers.shape[1])
    _, _, _, found, moved, _, _, row, _, _, _ = _places(n, n_rows, pattern[n_rows] - pattern[0], n_redundant)
    fill_field(room, AHEAD, control[T0])
    for j in range(n):
        fill_field(room, memory + row + j, 0.0)
    for first in range(0, n_runs, LANES):
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            room[RUNNING * LANES + k] = 1.0
            for j in range(n):
                room[(new + j) * LANES + k], room[(new + n + j) * LANES + k] = q[run, j], v[run, j]
            for i in range(numbers.shape[1]):
                room[(own + i) * LANES + k] = numbers[run, i]
        _gauss_newton(code, settings, control, pattern, moves, room)
        _change_velocities(code, settings, control, pattern, moves, room)
        copy_vectors(room, new, memory + found, n)
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            for j in range(n):
                room[(memory + moved + j) * LANES + k] = room[(new + j) * LANES + k] - q[run, j]
        _look_for_others(code, settings, control, pattern, moves, room)
        for k in range(min(LANES, n_runs - first)):
            fine[first + k] = int(room[RUNNING * LANES + k])
            for j in range(n):
                q[first + k, j] = room[(memory + found + j) * LANES + k]
                v[first + k, j] = room[(new + n + j) * LANES + k]

"""Steps of DOP853 in lanes, as `explicit_step` has them with free stages: the end alone is put on the constraints."""

import numpy as np

from twoloop.kernels.data.common import compiled, inlined, kernel
from twoloop.kernels.lanes.lane_algebra import copy_vectors, enlarge, sum_rows, table, vectors
from twoloop.kernels.lanes.lane_control import N_HEAD, begin_control, choose_steps, end_steps, judge_steps, set_end
from twoloop.kernels.lanes.lane_room import (
    AHEAD,
    ATOL,
    ERROR,
    LANES,
    N_NUMBERS,
    N_ROWS,
    ORDER,
    RTOL,
    STEP,
    WORST,
    H,
    N,
    T,
    X,
    fill_field,
    places_of,
)
from twoloop.kernels.steps.explicit_step import tableau_of

# of the method's memory, in vectors: accelerations at STATE (n), then the state at which the step begins (2n), two
# estimates (2n each) and velocities and accelerations of the stages (s, 2n)
N_BEFORE_SLOPES = 7


def memory_size(s: int, n: int) -> int:
    """Length of the method's memory, in vectors, for s stages."""
    return (N_BEFORE_SLOPES + 2 * s) * n


@inlined
def _slopes(room, memory, n, s):
    return table(room, memory + N_BEFORE_SLOPES * n, s, 2 * n)


@compiled
def _move(room, begin, total, new, n):
    """NEW = the beginning of the step + X times the sum of slopes."""
    for j in range(2 * n):
        for k in range(LANES):
            change = room[X * LANES + k] * room[(total + j) * LANES + k]
            room[(new + j) * LANES + k] = room[(begin + j) * LANES + k] + change


@compiled
def _stages(code, settings, control, options, room):
    """NEW, X after the beginning of the step, where the slopes are those of the first stage."""
    n, order = settings[N], settings[ORDER]
    _, new, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    begin, total = memory + n, memory + 3 * n
    s, A, b, c, _, _ = tableau_of(options[N_HEAD:])
    slopes, sums = _slopes(room, memory, n, s), vectors(room, total, 2 * n)
    for i in range(1, s):
        sum_rows(A[i, :i], slopes, sums)
        _move(room, begin, total, new, n)
        for k in range(LANES):
            room[AHEAD * LANES + k] = room[T * LANES + k] + c[i] * room[X * LANES + k]
        code.there(order, control, room)
        place = memory + (N_BEFORE_SLOPES + 2 * i) * n
        copy_vectors(room, new + n, place, n)
        copy_vectors(room, a, place + n, n)
    sum_rows(b, slopes, sums)
    _move(room, begin, total, new, n)


@compiled
def _estimate(control, options, room, n, state, new, memory):
    """ERROR of the steps, as largest_error of explicit_step.py has it."""
    s, _, _, _, fine, coarse = tableau_of(options[N_HEAD:])
    slopes, one, other = _slopes(room, memory, n, s), memory + 3 * n, memory + 5 * n
    sum_rows(fine, slopes, vectors(room, one, 2 * n))
    sum_rows(coarse, slopes, vectors(room, other, 2 * n))
    fill_field(room, ERROR, 0.0)
    fill_field(room, WORST, 0.0)
    for j in range(2 * n):
        atol, rtol = control[ATOL + j % n], control[RTOL]
        enlarge(room, ERROR, one + j, H, state + j, new + j, atol, rtol)
        enlarge(room, WORST, other + j, H, state + j, new + j, atol, rtol)
    for k in range(LANES):
        e, d = room[ERROR * LANES + k], room[WORST * LANES + k]
        room[ERROR * LANES + k] = e * e / np.hypot(e, d) if e > 0.0 else 0.0


@kernel(STEP, vectorized=True)
def step_by_dop853(code, settings, control, options, room, status, n_steps, within):
    """A step, no longer than the gap within which the equations are looked at, or states within one, by others."""
    n = settings[N]
    state, new, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    slopes = memory + N_BEFORE_SLOPES * n
    if not within:
        begin_control(options, control, room, n, state, a, memory)
        choose_steps(room, control, status, n_steps)
        copy_vectors(room, state, memory + n, 2 * n)
        copy_vectors(room, state + n, slopes, n)
        copy_vectors(room, memory, slopes + n, n)
    _stages(code, settings, control, options, room)
    set_end(room, control)
    if not within:
        _estimate(control, options, room, n, state, new, memory)
        end_steps(code, settings, control, room, memory + 3 * n)
        judge_steps(options, room, n, a, memory, status)

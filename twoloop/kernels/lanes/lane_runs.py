"""The course of runs in lanes: each lane has steps of its own, and takes the next run when its own has ended.

What lanes cannot do is left to a run of its own: a condition of the code that does not hold, a step that is refused
again and again. How a step is made is the kit's.
"""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.data.common import INTEGERS, compiled, kernel
from twoloop.kernels.lanes.lane_ends import ENDED, NO_START, NO_VALUES, OFTEN_REFUSED, UNDECIDED
from twoloop.kernels.lanes.lane_projection import project_lanes
from twoloop.kernels.lanes.lane_room import (
    ACCEPTED,
    AHEAD,
    ASKED,
    CODE,
    EVALUATED,
    FINE,
    FRESH,
    LANES,
    N_EVALUATIONS,
    N_ROWS,
    ORDER,
    REACHED,
    REFUSED,
    RUNNING,
    T0,
    T1,
    UNIT,
    WHICH,
    H,
    N,
    T,
    X,
    fill_field,
    leave,
    places_of,
)

TABLE, STATES = types.float64[:, ::1], types.float64[:, :, ::1]


@compiled
def _refill(code, order, control, room, n, n_rows, numbers, q0, v0, next_run, status):
    """Runs for the lanes that have none; the number of the next run, and how many run."""
    state, new, _, _, _, _, own, _ = places_of(n, n_rows, numbers.shape[1])
    n_fresh, n_running = 0, 0
    for k in range(LANES):
        last = int(room[WHICH * LANES + k])
        if room[RUNNING * LANES + k] == 0.0 and last >= 0 and status[last] == UNDECIDED:  # as a series leaves it
            status[last] = OFTEN_REFUSED if room[REFUSED * LANES + k] < np.inf else NO_VALUES
        room[FINE * LANES + k] = room[FRESH * LANES + k] = 0.0
        if room[RUNNING * LANES + k] == 0.0 and next_run < numbers.shape[0]:
            room[FINE * LANES + k] = room[FRESH * LANES + k] = room[RUNNING * LANES + k] = 1.0
            room[T * LANES + k] = room[AHEAD * LANES + k] = control[T0]
            room[REFUSED * LANES + k] = room[REACHED * LANES + k] = 0.0
            room[WHICH * LANES + k] = next_run
            for j in range(n):
                room[(new + j) * LANES + k], room[(new + n + j) * LANES + k] = q0[next_run, j], v0[next_run, j]
            for i in range(numbers.shape[1]):
                room[(own + i) * LANES + k] = numbers[next_run, i]
            next_run += 1
            n_fresh += 1
        n_running += int(room[RUNNING * LANES + k])
    if n_fresh > 0:
        for k in range(LANES):
            room[ASKED * LANES + k] = room[FINE * LANES + k]
        project_lanes(code, order, control, room)
        for k in range(LANES):
            if room[ASKED * LANES + k] == 1.0:
                for j in range(2 * n):
                    room[(state + j) * LANES + k] = room[(new + j) * LANES + k]
                if room[FINE * LANES + k] == 0.0:
                    leave(room, status, k, NO_START)
                    n_running -= 1
    return next_run, n_running


@compiled
def _between(code, settings, control, options, room, n, new, times, out_q, out_v, status, n_steps):
    """States that are wanted within the accepted steps."""
    while True:
        n_wanted = 0
        for k in range(LANES):
            wanted = int(room[REACHED * LANES + k])
            room[FINE * LANES + k] = room[X * LANES + k] = 0.0
            if room[ACCEPTED * LANES + k] == 1.0 and wanted < times.size:
                end = room[T * LANES + k] + room[H * LANES + k]
                if times[wanted] < end and times[wanted] < control[T1]:
                    room[FINE * LANES + k], n_wanted = 1.0, n_wanted + 1
                    room[X * LANES + k] = times[wanted] - room[T * LANES + k]
                    room[AHEAD * LANES + k] = times[wanted]
            room[ASKED * LANES + k] = room[FINE * LANES + k]
        if n_wanted == 0:
            return
        code.step(code, settings, control, options, room, status, n_steps, True)
        project_lanes(code, settings[ORDER], control, room)
        for k in range(LANES):
            if room[ASKED * LANES + k] == 1.0:
                run, wanted = int(room[WHICH * LANES + k]), int(room[REACHED * LANES + k])
                room[REACHED * LANES + k] += 1.0
                for j in range(n):
                    fine = room[FINE * LANES + k] == 1.0
                    out_q[run, j, wanted] = room[(new + j) * LANES + k] if fine else np.nan
                    out_v[run, j, wanted] = room[(new + n + j) * LANES + k] if fine else np.nan


@compiled
def _write_ends(room, control, n, n_rows, new, a, last, out_q, out_v, out_a, status):
    """What is at the ends of runs whose last steps were accepted."""
    for k in range(LANES):
        if room[ACCEPTED * LANES + k] == 0.0 or room[H * LANES + k] != control[T1] - room[T * LANES + k]:
            continue
        run = int(room[WHICH * LANES + k])
        room[RUNNING * LANES + k], status[run] = 0.0, ENDED
        for j in range(n):
            out_q[run, j, last], out_v[run, j, last] = room[(new + j) * LANES + k], room[(new + n + j) * LANES + k]
        for j in range(n + n_rows):  # LAM is behind A
            out_a[run, j] = room[(a + j) * LANES + k]


@compiled
def _count(settings, room, n_evaluations):
    """What steps evaluated, accepted or not, and once more at their ends; of runs that are left nothing counts."""
    for k in range(LANES):
        if room[RUNNING * LANES + k] == 1.0:
            made = settings[N_EVALUATIONS] + int(room[EVALUATED * LANES + k])
            n_evaluations[int(room[WHICH * LANES + k])] += made + 1


@compiled
def _go_on(room, control, n_steps):
    """Time goes on in the lanes whose steps were accepted."""
    for k in range(LANES):
        if room[ACCEPTED * LANES + k] == 1.0:
            h, t = room[H * LANES + k], room[T * LANES + k]
            n_steps[int(room[WHICH * LANES + k])] += 1
            room[T * LANES + k] = control[T1] if h == control[T1] - t else t + h
            room[REFUSED * LANES + k] = 0.0


_ADVANCE = types.void(CODE, INTEGERS, *[VECTOR] * 3, *[TABLE] * 3, *[STATES] * 2, TABLE, *[INTEGERS] * 3, VECTOR)


@kernel(_ADVANCE)
def advance_lanes(
    code, settings, control, options, times, numbers, q0, v0, out_q, out_v, out_a, status, n_steps, n_evaluations, room
):
    """Make runs, one for each row of `numbers`, from t0 to t1.

    times : (n_t,) at which states are wanted, the last of them t1; out_q, out_v : (n_runs, n, n_t); out_a : (n_runs,
    n + n_rows), accelerations and multipliers at t1. n_evaluations : counts go on from what is there. options : of the
    method.
    """
    n, n_rows, order = settings[N], settings[N_ROWS], settings[ORDER]
    _, new, _, _, a, _, _, _ = places_of(n, n_rows, numbers.shape[1])
    next_run, are_fresh = 0, False
    for field in (T, AHEAD, H, X, RUNNING, ACCEPTED):
        fill_field(room, field, 0.0)
    fill_field(room, UNIT, 1.0)
    fill_field(room, WHICH, -1.0)
    while True:
        n_running = 0.0
        for k in range(LANES):
            n_running += room[RUNNING * LANES + k]
        if n_running < LANES or are_fresh:
            before = next_run
            next_run, left = _refill(code, order, control, room, n, n_rows, numbers, q0, v0, next_run, status)
            are_fresh = next_run > before
            if left == 0:
                if next_run == numbers.shape[0]:
                    return
                continue
        fill_field(room, EVALUATED, 0.0)
        code.step(code, settings, control, options, room, status, n_steps, False)
        _count(settings, room, n_evaluations)
        code.take(order, control, room)
        _write_ends(room, control, n, n_rows, new, a, times.size - 1, out_q, out_v, out_a, status)
        if times.size > 1:
            _between(code, settings, control, options, room, n, new, times, out_q, out_v, status, n_steps)
        _go_on(room, control, n_steps)

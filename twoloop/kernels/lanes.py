"""Runs of one mechanism side by side by Taylor series, one in each lane of the vectors of code made for it.

Each lane has its own step, as `taylor_step` has it, and takes the next run when its own has ended. What lanes cannot do
is left to a run of its own: a condition of the code that does not hold, a step that is refused again and again.
"""

from typing import Any

import numpy as np
from numba import types
from numba.extending import typeof_impl

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.own_functions import OwnFunctions
from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.data.common import INTEGERS, compiled, kernel, merged

LANES = 8  # doubles of a vector: those of AVX-512, or of two narrower ones

# vectors in `room`, one number for each lane; behind them STATE, NEW, PREDICTED, ... as `places` has it
(
    T,
    AHEAD,
    UNIT,
    H,
    X,
    FINE,  # 1: of the lanes that a task is for; what it leaves 1 could be done
    MOVED,
    DEFECT,
    OFF,
    LENGTH,
    LONGEST,  # that the step may be, s
    ASKED,  # 1: the lanes that begin a run, or in which a state is wanted
    WORST,  # defect within the step
    REFUSED,  # steps, one after another
    RUNNING,
    WHICH,  # run
    REACHED,  # of the times at which states are wanted
    LEFT_TO_MOVE,
    MOVED_BEFORE,
    ON_CONSTRAINTS,
    ACCEPTED,
    N_FIELDS,
) = range(22)
# functions made for a mechanism, (order, control, room), on what lies in `room`
TASKS = (
    "series",  # coefficients about STATE at T, in units of time UNIT
    "lengths",  # LENGTH of the step at which the last two terms are within the tolerances, in units
    "evaluate",  # NEW and FOUND: the state and its accelerations by the series, X units of time on
    "closer",  # positions of NEW, at AHEAD, moved towards the constraints, by MOVED
    "nearer",  # the same and velocities, and A and LAM there
    "there",  # A at NEW as it stands
    "redundant",  # whether rows that do not count hold at NEW
    "judge",  # DEFECT and OFF: of a step H from STATE by PREDICTED to NEW
    "take",  # NEW becomes STATE where ACCEPTED
)
CODE = Reference("LaneKit", {})
CODE.add_own_functions(dict.fromkeys(TASKS, types.none(types.int64, VECTOR, VECTOR)))
TABLE, STATES = types.float64[:, ::1], types.float64[:, :, ::1]

LEFT, ENDED = 0, 1  # what becomes of a run: left to a run of its own, or made
N, N_ROWS, ORDER, CHECKS_REDUNDANT = range(4)  # in `settings`
T0, T1, GAP, RTOL, ATOL = range(5)  # in `control`; from ATOL on a tolerance for each coordinate

MOST_PASSES = 10  # of the projection
CONTRACTION = 0.5  # of a correction by the next, or the projection does not converge
MOST_REFUSED = 10
ALLOWED = 0.3  # as in taylor_step.py
MOST_SHORTENED, GROWTH = 0.1, 5.0
LARGEST_MOVE, OF_POSITIONS = 1e-14, 1e-14  # correction after which a projection ends: absolute, of the largest position
FIRST_UNIT = 0.01  # of the span
SHORTEST = 1e-13  # step, of the time
MOST_PLACES = 1000  # within a step
GOLDEN = 0.6180339887498949


class LaneKit:
    """The functions made for a mechanism, as kernels get them."""

    def __init__(self, own: OwnFunctions):
        self.__dict__.update(own.addresses)
        self.own, self.table = own, CODE.table(self)
        self.address = self.table.ctypes.data


@typeof_impl.register(LaneKit)
def _type_of_kit(value: Any, context: Any) -> Any:
    return CODE


def places(n, n_rows, n_numbers, order):
    """Where in `room` stand STATE, NEW, PREDICTED, FOUND, A, LAM, the numbers of the code, the series and its scratch.

    Counted in vectors.
    """
    state = N_FIELDS
    new = state + 2 * n
    predicted = new + 2 * n
    found = predicted + n
    a = found + n
    lam = a + n
    numbers = lam + n_rows
    series = numbers + n_numbers
    return state, new, predicted, found, a, lam, numbers, series, series + (order + 1) * n


_places = merged(places)


@merged
def _set(room, field, value):
    for k in range(LANES):
        room[field * LANES + k] = value


@compiled
def _project(code, order, control, room, n, new):
    """Put NEW of the lanes that FINE names on the constraints; FINE then says where it could be done."""
    for k in range(LANES):
        room[LEFT_TO_MOVE * LANES + k] = room[FINE * LANES + k]
        room[MOVED_BEFORE * LANES + k] = np.inf
        room[ON_CONSTRAINTS * LANES + k] = 0.0
    code.closer(order, control, room)
    for k in range(LANES):
        room[LEFT_TO_MOVE * LANES + k] = room[FINE * LANES + k]
    for _ in range(MOST_PASSES):
        left = 0.0
        for k in range(LANES):
            room[FINE * LANES + k] = room[LEFT_TO_MOVE * LANES + k]
            left += room[LEFT_TO_MOVE * LANES + k]
        if left == 0.0:
            break
        code.nearer(order, control, room)
        for k in range(LANES):
            if room[LEFT_TO_MOVE * LANES + k] == 0.0:
                continue
            moved, least = room[MOVED * LANES + k], LARGEST_MOVE
            if moved > least:
                for j in range(n):
                    least = max(least, OF_POSITIONS * abs(room[(new + j) * LANES + k]))
            if room[FINE * LANES + k] == 1.0 and moved <= least:
                room[LEFT_TO_MOVE * LANES + k], room[ON_CONSTRAINTS * LANES + k] = 0.0, 1.0
            elif room[FINE * LANES + k] == 0.0 or not moved <= CONTRACTION * room[MOVED_BEFORE * LANES + k]:
                room[LEFT_TO_MOVE * LANES + k] = 0.0
            room[MOVED_BEFORE * LANES + k] = max(moved, least)
    for k in range(LANES):
        room[FINE * LANES + k] = room[ON_CONSTRAINTS * LANES + k]


@merged
def _leave(room, status, k):
    """Leave the run of a lane to a run of its own."""
    room[RUNNING * LANES + k] = 0.0
    status[int(room[WHICH * LANES + k])] = LEFT


@compiled
def _refill(code, order, control, room, n, n_rows, numbers, q0, v0, next_run, status):
    """Runs for the lanes that have none; the number of the next run, and how many run."""
    state, new, _, _, _, _, own, _, _ = _places(n, n_rows, numbers.shape[1], order)
    n_fresh, n_running = 0, 0
    for k in range(LANES):
        room[FINE * LANES + k] = 0.0
        if room[RUNNING * LANES + k] == 0.0 and next_run < numbers.shape[0]:
            room[FINE * LANES + k] = room[RUNNING * LANES + k] = 1.0
            room[T * LANES + k] = room[AHEAD * LANES + k] = control[T0]
            room[UNIT * LANES + k] = FIRST_UNIT * (control[T1] - control[T0])
            room[LONGEST * LANES + k] = np.inf
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
        _project(code, order, control, room, n, new)
        for k in range(LANES):
            if room[ASKED * LANES + k] == 1.0:
                for j in range(2 * n):
                    room[(state + j) * LANES + k] = room[(new + j) * LANES + k]
                if room[FINE * LANES + k] == 0.0:
                    _leave(room, status, k)
                    n_running -= 1
    return next_run, n_running


@compiled
def _choose_steps(room, control, status):
    """The step of each lane; how many places are to be looked at within the longest."""
    n_places, t1 = 0, control[T1]
    for k in range(LANES):
        room[H * LANES + k] = room[WORST * LANES + k] = 0.0
        if room[RUNNING * LANES + k] == 1.0:
            unit, t = room[UNIT * LANES + k], room[T * LANES + k]
            h = min(room[LENGTH * LANES + k] * unit, room[LONGEST * LANES + k])
            if h >= t1 - t:
                h = t1 - t
            room[H * LANES + k] = h
            if not (room[FINE * LANES + k] == 1.0 and h > SHORTEST * max(abs(t), abs(t1))):
                _leave(room, status, k)
                room[H * LANES + k] = 0.0
            elif h > control[GAP]:
                n_places = max(n_places, int(min(np.ceil(h / control[GAP]), MOST_PLACES)))
    return n_places


@compiled
def _look_within(code, order, control, room, n_places, n_steps):
    """WORST: the largest defect of each lane at places that lie no further apart than the gap."""
    for place in range(n_places):
        for k in range(LANES):
            h, share = room[H * LANES + k], 0.0
            if h > control[GAP]:
                own = int(min(np.ceil(h / control[GAP]), MOST_PLACES))
                shift = (n_steps[int(room[WHICH * LANES + k])] + room[REFUSED * LANES + k]) * GOLDEN % 1.0
                share = (place + shift) / own if place < own else 0.0
            room[X * LANES + k] = share * h / room[UNIT * LANES + k]
            room[AHEAD * LANES + k] = room[T * LANES + k] + share * h
            room[FINE * LANES + k] = 1.0
        code.evaluate(order, control, room)
        code.there(order, control, room)
        code.judge(order, control, room)
        for k in range(LANES):
            if room[X * LANES + k] > 0.0:
                defect = room[DEFECT * LANES + k] if room[FINE * LANES + k] == 1.0 else np.inf
                room[WORST * LANES + k] = max(room[WORST * LANES + k], defect)


@compiled
def _make_steps(code, order, control, room, n, n_rows, n_numbers, checks_redundant, status):
    """The ends of the steps, and which of them are accepted; the others are made again, shorter."""
    _, new, predicted, _, _, _, _, _, _ = _places(n, n_rows, n_numbers, order)
    for k in range(LANES):
        h, t = room[H * LANES + k], room[T * LANES + k]
        room[X * LANES + k] = h / room[UNIT * LANES + k]
        room[AHEAD * LANES + k] = control[T1] if h == control[T1] - t else t + h
        room[FINE * LANES + k] = room[RUNNING * LANES + k]
    code.evaluate(order, control, room)
    for i in range(n * LANES):
        room[predicted * LANES + i] = room[new * LANES + i]
    _project(code, order, control, room, n, new)
    if checks_redundant == 1:
        code.redundant(order, control, room)
    code.judge(order, control, room)
    for k in range(LANES):
        room[ACCEPTED * LANES + k] = 0.0
        if room[RUNNING * LANES + k] == 0.0:
            continue
        factor, off = 1.0, room[OFF * LANES + k]
        defect = max(room[WORST * LANES + k], room[DEFECT * LANES + k])
        if room[FINE * LANES + k] == 0.0 or not (np.isfinite(off) and np.isfinite(defect)):
            factor = MOST_SHORTENED
        else:
            if off > 1.0:
                factor = (ALLOWED / off) ** (1.0 / order)
            if defect > 1.0:
                factor = min(factor, max(MOST_SHORTENED, 0.9 * defect ** (-1.0 / order)))
        h = room[H * LANES + k]
        if factor < 1.0:
            room[REFUSED * LANES + k] += 1.0
            room[LONGEST * LANES + k] = factor * h
            if room[REFUSED * LANES + k] > MOST_REFUSED:
                _leave(room, status, k)
        else:
            room[ACCEPTED * LANES + k] = 1.0
            room[LONGEST * LANES + k] = GROWTH * h


@compiled
def _between(code, order, control, room, n, new, times, out_q, out_v):
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
                    room[X * LANES + k] = (times[wanted] - room[T * LANES + k]) / room[UNIT * LANES + k]
                    room[AHEAD * LANES + k] = times[wanted]
            room[ASKED * LANES + k] = room[FINE * LANES + k]
        if n_wanted == 0:
            return
        code.evaluate(order, control, room)
        _project(code, order, control, room, n, new)
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
def _go_on(room, control, n_steps):
    """Time goes on in the lanes whose steps were accepted."""
    for k in range(LANES):
        if room[ACCEPTED * LANES + k] == 1.0:
            h, t = room[H * LANES + k], room[T * LANES + k]
            n_steps[int(room[WHICH * LANES + k])] += 1
            room[T * LANES + k] = control[T1] if h == control[T1] - t else t + h
            room[UNIT * LANES + k] = min(room[LENGTH * LANES + k] * room[UNIT * LANES + k], GROWTH * h)
            room[REFUSED * LANES + k] = 0.0


@kernel(types.void(CODE, INTEGERS, VECTOR, VECTOR, *[TABLE] * 3, *[STATES] * 2, TABLE, *[INTEGERS] * 2, VECTOR))
def advance_lanes(code, settings, control, times, numbers, q0, v0, out_q, out_v, out_a, status, n_steps, room):
    """Make runs, one for each row of `numbers`, from t0 to t1.

    times : (n_t,) at which states are wanted, the last of them t1; out_q, out_v : (n_runs, n, n_t); out_a : (n_runs,
    n + n_rows), accelerations and multipliers at t1.
    """
    n, n_rows, order, n_numbers = settings[N], settings[N_ROWS], settings[ORDER], numbers.shape[1]
    _, new, _, _, a, _, _, _, _ = _places(n, n_rows, n_numbers, order)
    next_run = 0
    for field in (T, AHEAD, H, X, RUNNING, WHICH):
        _set(room, field, 0.0)
    _set(room, UNIT, 1.0)
    while True:
        next_run, n_running = _refill(code, order, control, room, n, n_rows, numbers, q0, v0, next_run, status)
        if n_running == 0:
            if next_run == numbers.shape[0]:
                return
            continue
        _set(room, FINE, 1.0)
        code.series(order, control, room)
        code.lengths(order, control, room)
        n_places = _choose_steps(room, control, status)
        if n_places > 0:
            _look_within(code, order, control, room, n_places, n_steps)
        _make_steps(code, order, control, room, n, n_rows, n_numbers, settings[CHECKS_REDUNDANT], status)
        code.take(order, control, room)
        _write_ends(room, control, n, n_rows, new, a, times.size - 1, out_q, out_v, out_a, status)
        if times.size > 1:
            _between(code, order, control, room, n, new, times, out_q, out_v)
        _go_on(room, control, n_steps)

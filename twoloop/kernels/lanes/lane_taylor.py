"""Steps by Taylor series in lanes, as `taylor_step` has them."""

import numpy as np

from twoloop.kernels.data.common import compiled, kernel
from twoloop.kernels.lanes.lane_projection import project_lanes
from twoloop.kernels.lanes.lane_room import (
    ACCEPTED,
    AHEAD,
    CHECKS_REDUNDANT,
    DEFECT,
    FINE,
    FRESH,
    LANES,
    LENGTH,
    LONGEST,
    N_NUMBERS,
    N_ROWS,
    OFF,
    ORDER,
    REFUSED,
    RUNNING,
    SHIFT,
    SHORTEST,
    STEP,
    T0,
    T1,
    UNIT,
    WORST,
    H,
    N,
    T,
    X,
    fill_field,
    leave,
    places_of,
)

ALLOWED = 0.3  # as in taylor_step.py
MOST_SHORTENED, GROWTH = 0.1, 5.0
MOST_REFUSED = 10  # one after another
FIRST_UNIT = 0.01  # of the span


@compiled
def _begin(room, control):
    """Units of time of new runs, and those after accepted steps."""
    for k in range(LANES):
        if room[FRESH * LANES + k] == 1.0:
            room[UNIT * LANES + k] = FIRST_UNIT * (control[T1] - control[T0])
            room[LONGEST * LANES + k], room[SHIFT * LANES + k] = np.inf, 0.0
        elif room[ACCEPTED * LANES + k] == 1.0:
            h = room[H * LANES + k]
            room[UNIT * LANES + k] = min(room[LENGTH * LANES + k] * room[UNIT * LANES + k], GROWTH * h)


@compiled
def _choose_steps(room, control, status):
    """The step of each lane."""
    t1 = control[T1]
    for k in range(LANES):
        room[H * LANES + k] = 0.0
        if room[RUNNING * LANES + k] == 1.0:
            unit, t = room[UNIT * LANES + k], room[T * LANES + k]
            h = min(room[LENGTH * LANES + k] * unit, room[LONGEST * LANES + k])
            if h >= t1 - t:
                h = t1 - t
            room[H * LANES + k] = h
            if not (room[FINE * LANES + k] == 1.0 and h > SHORTEST * max(abs(t), abs(t1))):
                leave(room, status, k)
                room[H * LANES + k] = 0.0


@compiled
def _make_steps(code, order, control, room, n, n_rows, n_numbers, checks_redundant, status):
    """The ends of the steps, and which of them are accepted; the others are made again, shorter."""
    _, new, predicted, _, _, _, _, _ = places_of(n, n_rows, n_numbers)
    for k in range(LANES):
        h, t = room[H * LANES + k], room[T * LANES + k]
        room[X * LANES + k] = h / room[UNIT * LANES + k]
        room[AHEAD * LANES + k] = control[T1] if h == control[T1] - t else t + h
        room[FINE * LANES + k] = room[RUNNING * LANES + k]
    code.evaluate(order, control, room)
    for i in range(n * LANES):
        room[predicted * LANES + i] = room[new * LANES + i]
    project_lanes(code, order, control, room, n, new)
    if checks_redundant == 1:
        code.redundant(order, control, room)
    code.departure(order, control, room)
    code.defect(order, control, room)
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
                leave(room, status, k)
        else:
            room[ACCEPTED * LANES + k] = 1.0
            room[LONGEST * LANES + k] = GROWTH * h


@kernel(STEP)
def step_by_series(code, settings, control, options, room, status, n_steps, within):
    """A step by the series about its beginning, or states within one."""
    n, n_rows, order, n_numbers = settings[N], settings[N_ROWS], settings[ORDER], settings[N_NUMBERS]
    if within:
        for k in range(LANES):
            room[X * LANES + k] = room[X * LANES + k] / room[UNIT * LANES + k]
        code.evaluate(order, control, room)
        return
    _begin(room, control)
    fill_field(room, FINE, 1.0)
    code.series(order, control, room)
    code.lengths(order, control, room)
    _choose_steps(room, control, status)
    code.look(order, control, room)
    _make_steps(code, order, control, room, n, n_rows, n_numbers, settings[CHECKS_REDUNDANT], status)

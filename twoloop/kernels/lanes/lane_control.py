"""Step-size control in lanes, by an estimate of the error: that of `advance`, for each lane of its own."""

import numpy as np

from twoloop.kernels.control.controller import N_PAST, N_RULE, factor_of, remember
from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.lanes.lane_algebra import enlarge
from twoloop.kernels.lanes.lane_ends import MANY_STEPS, NO_VALUES, OFTEN_REFUSED
from twoloop.kernels.lanes.lane_projection import project_lanes
from twoloop.kernels.lanes.lane_room import (
    ACCEPTED,
    AHEAD,
    ATOL,
    CHECKS_REDUNDANT,
    ERROR,
    FINE,
    FRESH,
    GAP,
    H_LIMIT,
    H_NEXT,
    LANES,
    LIMIT_AGE,
    N_NUMBERS,
    N_ROWS,
    OFF,
    ORDER,
    PAST,
    REFUSED,
    ROUGH_TO,
    RTOL,
    RUNNING,
    SHORTEST,
    T0,
    T1,
    WANTED,
    WHICH,
    H,
    N,
    T,
    X,
    leave,
    places_of,
)

# what `options` begin with, before those of the single step: the rule of controller.py, then
# ROUGH: how many times less than its error the estimate of a step may be where a force jumps
# FIRST: step, of the shortest time scale of the start; LEAST: tolerance
ROUGH, FIRST, LEAST, N_HEAD = range(N_RULE, N_RULE + 4)

SUDDEN, SHORTENED, WHOLE = 10.0, 0.95, 1e-10  # as in advance.py
LIMIT_FACTOR, LIMIT_MEMORY = 0.7, 10.0  # as of a Plan
RESOLVED = 20.0 * SHORTEST  # of the time at the start: the first step is no shorter
MOST_REFUSED = 30  # one after another, by estimates that may say little of how much shorter a stiff step has to be
MOST_STEPS = 100_000  # of a run in lanes, which nothing interrupts


@inlined
def _past(room, k):
    return room[PAST * LANES + N_PAST * k : PAST * LANES + N_PAST * (k + 1)]


@compiled
def _first_step(options, control, room, n, state, a, k):
    """A share of the time in which velocities and accelerations change the coordinates as a whole, as of a run."""
    far, fast, sharp, least = 0.0, 0.0, 0.0, np.inf
    for j in range(n):
        far = max(far, abs(room[(state + j) * LANES + k]))
        fast = max(fast, abs(room[(state + n + j) * LANES + k]))
        sharp = max(sharp, abs(room[(a + j) * LANES + k]))
        least = min(least, control[ATOL + j])
    far, scale = max(far, least), control[T1] - control[T0]
    if fast > 0.0:
        scale = min(scale, far / fast)
    if sharp > 0.0:
        scale = min(scale, np.sqrt(far / sharp))
    if fast > 0.0 and sharp > 0.0 and fast / sharp > options[FIRST] * scale:
        scale = min(scale, fast / sharp)
    return max(options[FIRST] * scale, RESOLVED * abs(control[T0]))


@compiled
def begin_control(options, control, room, n, state, a, start):
    """First steps of new runs, and their accelerations, which are A, to `start`."""
    for k in range(LANES):
        if room[FRESH * LANES + k] == 1.0:
            for j in range(n):
                room[(start + j) * LANES + k] = room[(a + j) * LANES + k]
            room[H_NEXT * LANES + k] = _first_step(options, control, room, n, state, a, k)
            room[H_LIMIT * LANES + k], room[LIMIT_AGE * LANES + k] = np.inf, 0.0
            room[ROUGH_TO * LANES + k] = -np.inf
            for i in range(N_PAST):
                room[PAST * LANES + N_PAST * k + i] = 0.0


@compiled
def choose_steps(room, control, status, n_steps):
    """H and X of each lane, no longer than the gap, 0 where none runs; FINE are those that run."""
    t1 = control[T1]
    for k in range(LANES):
        room[H * LANES + k], t = 0.0, room[T * LANES + k]
        if room[RUNNING * LANES + k] == 1.0:
            wanted = min(room[H_NEXT * LANES + k], room[H_LIMIT * LANES + k], control[GAP])
            h, left = wanted, t1 - t
            if h >= left * (1.0 - WHOLE):
                h = left
            elif h > 0.5 * left:
                h = 0.5 * left  # two equal steps rather than a long and a tiny one
            if n_steps[int(room[WHICH * LANES + k])] >= MOST_STEPS:
                leave(room, status, k, MANY_STEPS)
            elif h > SHORTEST * max(abs(t), abs(t1)):
                room[H * LANES + k], room[WANTED * LANES + k] = h, wanted
            else:
                failed = room[H_LIMIT * LANES + k] < np.inf and room[LIMIT_AGE * LANES + k] == 0.0
                leave(room, status, k, NO_VALUES if failed else OFTEN_REFUSED)
        room[X * LANES + k] = room[H * LANES + k]
        room[FINE * LANES + k] = room[RUNNING * LANES + k]


@compiled
def set_end(room, control):
    """AHEAD, X after the beginning of the step."""
    for k in range(LANES):
        t, x = room[T * LANES + k], room[X * LANES + k]
        room[AHEAD * LANES + k] = control[T1] if x == control[T1] - t else t + x


@compiled
def end_steps(code, settings, control, room, predicted_v):
    """NEW goes onto the constraints; ERROR is also how far it was predicted from there, positions and velocities.

    Velocities that the constraints change by more than the tolerances show a drive that jumps, or turns, between the
    stages. `predicted_v`: room for velocities.
    """
    n, order = settings[N], settings[ORDER]
    state, new, predicted, _, _, _, _, _ = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    for i in range(n * LANES):
        room[predicted * LANES + i] = room[new * LANES + i]
        room[predicted_v * LANES + i] = room[(new + n) * LANES + i]
    project_lanes(code, order, control, room)
    if settings[CHECKS_REDUNDANT] == 1:
        code.redundant(order, control, room)
    code.departure(order, control, room)
    for i in range(n * LANES):
        room[predicted_v * LANES + i] -= room[(new + n) * LANES + i]
    for j in range(n):
        atol = control[ATOL + j]
        enlarge(room, ERROR, predicted_v + j, RUNNING, state + n + j, new + n + j, atol, control[RTOL])
    for k in range(LANES):
        room[ERROR * LANES + k] = max(room[ERROR * LANES + k], room[OFF * LANES + k])


@merged
def _accepted(options, room, k):
    """Whether the step of a lane is accepted, and how long the next one is to be."""
    h, t, error = room[H * LANES + k], room[T * LANES + k], room[ERROR * LANES + k]
    if room[FINE * LANES + k] == 0.0 or not np.isfinite(error):
        room[H_NEXT * LANES + k], room[H_LIMIT * LANES + k] = 0.5 * h, LIMIT_FACTOR * h
        room[LIMIT_AGE * LANES + k] = 0.0
        return False
    # at a jump the embedded formula may agree by chance: until the place is passed, the estimate has to be smaller
    strict = options[ROUGH] if t < room[ROUGH_TO * LANES + k] else 1.0
    accepted = error * strict <= 1.0
    if error > SUDDEN and not accepted:
        room[ROUGH_TO * LANES + k] = t + h
    error *= strict
    past = _past(room, k)
    proposal = min(h * factor_of(options, past, h, error), room[H_LIMIT * LANES + k])
    if not accepted:
        room[H_NEXT * LANES + k] = min(proposal, SHORTENED * h)
        return False
    remember(options, past, h, error)
    room[H_NEXT * LANES + k] = max(proposal, room[WANTED * LANES + k]) if h < room[WANTED * LANES + k] else proposal
    room[LIMIT_AGE * LANES + k] += 1.0
    if room[LIMIT_AGE * LANES + k] > LIMIT_MEMORY:
        room[H_LIMIT * LANES + k] = np.inf
    return True


@compiled
def judge_steps(options, room, n, a, start, status):
    """ACCEPTED, by ERROR and FINE; the accelerations A at the ends of these steps go to `start`."""
    for k in range(LANES):
        room[ACCEPTED * LANES + k] = 0.0
        if room[RUNNING * LANES + k] == 0.0:
            continue
        if _accepted(options, room, k):
            room[ACCEPTED * LANES + k] = 1.0
            for j in range(n):
                room[(start + j) * LANES + k] = room[(a + j) * LANES + k]
        else:
            room[REFUSED * LANES + k] += 1.0
            if room[REFUSED * LANES + k] > MOST_REFUSED:
                leave(room, status, k, OFTEN_REFUSED if room[FINE * LANES + k] == 1.0 else NO_VALUES)

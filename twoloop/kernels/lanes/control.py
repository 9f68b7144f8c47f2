"""Steps of explicit methods in lanes, and step-size control of Runge-Kutta methods for each lane.

As in steps/explicit_step.py, only the end of a step of DOP853 is projected onto the constraints; its stages are not.
The step-size control of Taylor series is part of the code generated for the mechanism, see generate/lane_code.py. Names
in capitals, such as NEW and ERROR, are vectors in `work` with one number for each lane, see layout.py.
"""

import numpy as np

from twoloop.kernels.control.loop_state import N_PAST, N_RULE
from twoloop.kernels.control.step_size import record_accepted_step, step_size_ratio
from twoloop.kernels.data.common import compiled, inlined, kernel, merged
from twoloop.kernels.evaluation.constraints import representable_step
from twoloop.kernels.lanes import layout as at
from twoloop.kernels.lanes.layout import (
    LANES,
    STEP,
    copy_vectors,
    offsets_in_work,
    project_lanes,
    raise_to_ratio,
    remove_run,
)

# indices in `options`, after the N_RULE numbers of the step-size rule; the method's options begin at index N_HEAD
# - JUMP_RATIO: (true error) / (error estimate) is assumed to be at most this in steps in which a force jumps
# - FIRST: first step size, relative to the shortest time scale of the motion at the start
# - LEAST: the smaller one of the tolerances rtol and atol
JUMP_RATIO, FIRST, LEAST, N_HEAD = range(N_RULE, N_RULE + 4)

SUDDEN_ERROR = 10.0  # a rejected step with an error above this (in tolerances) is assumed to contain a jump of a force
MAX_RATIO_AFTER_REJECTION = 0.95  # largest ratio of the next step size to a rejected step size
# if a step would end before t1 by at most this fraction of the time left, the step is lengthened to end at t1
END_ROUNDING = 1e-10
# if a step of size h fails because its stages or its end cannot be computed, step sizes are limited to LIMIT_FACTOR * h
# until more than LIMIT_MEMORY steps have been accepted. The values equal those of the class `Plan`
LIMIT_FACTOR = 0.7
LIMIT_MEMORY = 10.0
LEAST_FIRST_STEP = 20.0 * at.SHORTEST  # lower bound of the first step size, relative to |t0|
MAX_REJECTED = 30  # a run with more than this number of rejected steps in a row leaves its lane, as it may be stiff
MAX_STEPS = 100_000  # largest number of steps of a run in a lane: the user cannot interrupt runs in lanes


@inlined
def _history_view(work, k):
    """Return a view (N_PAST numbers) of lane k's history of step-size control: size and error of the last step."""
    return work[at.PAST * LANES + N_PAST * k : at.PAST * LANES + N_PAST * (k + 1)]


@compiled
def _first_step_size(options, control, work, n, state, a, k):
    """Return the first step size (s) in lane k: options[FIRST] times the shortest time scale of the motion."""
    largest_q, largest_v, largest_a, least = 0.0, 0.0, 0.0, np.inf
    for j in range(n):
        largest_q = max(largest_q, abs(work[(state + j) * LANES + k]))
        largest_v = max(largest_v, abs(work[(state + n + j) * LANES + k]))
        largest_a = max(largest_a, abs(work[(a + j) * LANES + k]))
        least = min(least, control[at.ATOL + j])
    largest_q, scale = max(largest_q, least), control[at.T1] - control[at.T0]
    if largest_v > 0.0:
        scale = min(scale, largest_q / largest_v)
    if largest_a > 0.0:
        scale = min(scale, np.sqrt(largest_q / largest_a))
    if largest_v > 0.0 and largest_a > 0.0 and largest_v / largest_a > options[FIRST] * scale:
        scale = min(scale, largest_v / largest_a)
    return max(options[FIRST] * scale, LEAST_FIRST_STEP * abs(control[at.T0]))


@compiled
def begin_control(options, control, work, n, state, a, start):
    """In lanes that begin a run, initialize step-size control; copy accelerations from offset `a` to offset `start`."""
    for k in range(LANES):
        if work[at.IS_NEW * LANES + k] == 1.0:
            for j in range(n):
                work[(start + j) * LANES + k] = work[(a + j) * LANES + k]
            work[at.H_NEXT * LANES + k] = _first_step_size(options, control, work, n, state, a, k)
            work[at.H_LIMIT * LANES + k], work[at.LIMIT_AGE * LANES + k] = np.inf, 0.0
            work[at.JUMP_END * LANES + k] = -np.inf
            for i in range(N_PAST):
                work[at.PAST * LANES + N_PAST * k + i] = 0.0


@merged
def _round_steps(work, control):
    """Round the step sizes H so that T + H has no rounding error: else times and states of long runs drift apart."""
    for k in range(LANES):
        h, t = work[at.H * LANES + k], work[at.T * LANES + k]
        if h != control[at.T1] - t:
            work[at.H * LANES + k] = representable_step(t, h)


@compiled
def choose_steps(work, control, status, n_steps):
    """Store the size of the next step, at most control[GAP] (s), in H; set ACTIVE to 1 in lanes with a run.

    X, the time from the beginning to the end of the step, becomes H. Remove a run if it has taken MAX_STEPS steps, or
    if H is at most SHORTEST * max(|t|, |t1|). In lanes without a run, H, X and ACTIVE become 0.
    """
    t1 = control[at.T1]
    for k in range(LANES):
        work[at.H * LANES + k], t = 0.0, work[at.T * LANES + k]
        if work[at.RUNNING * LANES + k] == 1.0:
            h_wanted = min(work[at.H_NEXT * LANES + k], work[at.H_LIMIT * LANES + k], control[at.GAP])
            h, time_left = h_wanted, t1 - t
            if h >= time_left * (1.0 - END_ROUNDING):
                h = time_left
            elif h > 0.5 * time_left:
                h = 0.5 * time_left  # take two equal steps instead of a long step and a tiny one
            if n_steps[int(work[at.RUN * LANES + k])] >= MAX_STEPS:
                remove_run(work, status, k, at.MANY_STEPS)
            elif h > at.SHORTEST * max(abs(t), abs(t1)):
                work[at.H * LANES + k], work[at.H_FULL * LANES + k] = h, h_wanted
            else:
                last_step_failed = work[at.H_LIMIT * LANES + k] < np.inf and work[at.LIMIT_AGE * LANES + k] == 0.0
                remove_run(work, status, k, at.NO_VALUES if last_step_failed else at.MANY_REJECTIONS)
        work[at.ACTIVE * LANES + k] = work[at.RUNNING * LANES + k]
    _round_steps(work, control)
    for k in range(LANES):
        work[at.X * LANES + k] = work[at.H * LANES + k]


@compiled
def set_end(work, control):
    """Set T_NEW, the time X seconds after the step began at T, to T + X, or exactly to t1 if the run ends then."""
    for k in range(LANES):
        t, x = work[at.T * LANES + k], work[at.X * LANES + k]
        work[at.T_NEW * LANES + k] = control[at.T1] if x == control[at.T1] - t else t + x


@compiled
def end_steps(code, settings, control, work, predicted_v):
    """Project NEW, the state at the end of the step, onto the constraints; the change of NEW may increase ERROR.

    Changes by the projection show two errors: the largest change of a velocity, in tolerances, and PREDICTION_ERROR,
    which measures the change of positions. ERROR becomes the largest of these and the method's error estimate. So a
    step is rejected if a drive has a jump or kink that the stages miss. `predicted_v`: offset of scratch.
    """
    n, order = settings[at.N], settings[at.ORDER]
    state, new, predicted, _, _, _, _, _ = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    for i in range(n * LANES):
        work[predicted * LANES + i] = work[new * LANES + i]
        work[predicted_v * LANES + i] = work[(new + n) * LANES + i]
    project_lanes(code, order, control, work)
    if settings[at.CHECKS_REDUNDANT] == 1:
        code.check_redundant_rows(order, control, work)
    code.compute_prediction_error(order, control, work)
    for i in range(n * LANES):
        work[predicted_v * LANES + i] -= work[(new + n) * LANES + i]
    for j in range(n):
        atol = control[at.ATOL + j]
        raise_to_ratio(work, at.ERROR, predicted_v + j, at.RUNNING, state + n + j, new + n + j, atol, control[at.RTOL])
    for k in range(LANES):
        work[at.ERROR * LANES + k] = max(work[at.ERROR * LANES + k], work[at.PREDICTION_ERROR * LANES + k])


@merged
def _accept_or_shorten(options, work, k):
    """Return True if the step just taken in lane k is accepted; store the size of the next step in H_NEXT."""
    h, t, error = work[at.H * LANES + k], work[at.T * LANES + k], work[at.ERROR * LANES + k]
    if work[at.ACTIVE * LANES + k] == 0.0 or not np.isfinite(error):
        work[at.H_NEXT * LANES + k], work[at.H_LIMIT * LANES + k] = 0.5 * h, LIMIT_FACTOR * h
        work[at.LIMIT_AGE * LANES + k] = 0.0
        return False
    # near a jump of a force, the error estimate may be small by chance: multiply it by JUMP_RATIO until time JUMP_END
    error_factor = options[JUMP_RATIO] if t < work[at.JUMP_END * LANES + k] else 1.0
    is_accepted = error * error_factor <= 1.0
    if error > SUDDEN_ERROR and not is_accepted:
        work[at.JUMP_END * LANES + k] = t + h
    error *= error_factor
    past = _history_view(work, k)
    h_proposed = min(h * step_size_ratio(options, past, h, error), work[at.H_LIMIT * LANES + k])
    if not is_accepted:
        work[at.H_NEXT * LANES + k] = min(h_proposed, MAX_RATIO_AFTER_REJECTION * h)
        return False
    record_accepted_step(options, past, h, error)
    h_free = work[at.H_FULL * LANES + k]
    work[at.H_NEXT * LANES + k] = max(h_proposed, h_free) if h < h_free else h_proposed
    work[at.LIMIT_AGE * LANES + k] += 1.0
    if work[at.LIMIT_AGE * LANES + k] > LIMIT_MEMORY:
        work[at.H_LIMIT * LANES + k] = np.inf
    return True


@compiled
def judge_steps(options, work, n, a, start, status):
    """Set ACCEPTED to 1 in lanes whose step is accepted, else to 0; remove runs with too many rejected steps in a row.

    Too many: more than MAX_REJECTED. In lanes with ACCEPTED = 1, copy accelerations from offset `a` to `start`.
    """
    for k in range(LANES):
        work[at.ACCEPTED * LANES + k] = 0.0
        if work[at.RUNNING * LANES + k] == 0.0:
            continue
        if _accept_or_shorten(options, work, k):
            work[at.ACCEPTED * LANES + k] = 1.0
            for j in range(n):
                work[(start + j) * LANES + k] = work[(a + j) * LANES + k]
        else:
            work[at.N_REJECTED * LANES + k] += 1.0
            if work[at.N_REJECTED * LANES + k] > MAX_REJECTED:
                remove_run(work, status, k, at.MANY_REJECTIONS if work[at.ACTIVE * LANES + k] == 1.0 else at.NO_VALUES)


def memory_size(s: int, n: int) -> int:
    """Return the number of vectors of LANES numbers in the memory of an explicit method: s stages, n coordinates."""
    return (at.SLOPES + s) * n


@kernel(STEP)
def step_by_dop853(code, settings, control, options, work, status, n_steps, within):
    """Take a step of DOP853 in each lane, at most as long as control[GAP] (s).

    If `within`, take no step: compute the states X seconds after the beginning of the last accepted step.
    """
    n = settings[at.N]
    state, _, _, _, a, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    start = memory + at.START * n
    if not within:
        begin_control(options, control, work, n, state, a, start)
        choose_steps(work, control, status, n_steps)
        copy_vectors(work, state, memory + at.BEGIN * n, 2 * n)
        copy_vectors(work, start, memory + at.SLOPES * n, n)
    code.compute_stages(settings[at.ORDER], control, work)
    set_end(work, control)
    if not within:
        end_steps(code, settings, control, work, memory + at.PREDICTED_V * n)
        judge_steps(options, work, n, a, start, status)


@kernel(STEP)
def step_by_series(code, settings, control, options, work, status, n_steps, within):
    """Take a step in each lane, by the Taylor series about the beginning of the step.

    If `within`, take no step: compute the states X seconds after the beginning of the last accepted step.
    """
    order = settings[at.ORDER]
    if within:
        for k in range(LANES):
            work[at.X * LANES + k] = work[at.X * LANES + k] / work[at.UNIT * LANES + k]
        code.evaluate_series(order, control, work)
        return
    for k in range(LANES):  # remove runs after MAX_STEPS steps: stiff motion may need so many at any tolerance
        if work[at.RUNNING * LANES + k] == 1.0 and n_steps[int(work[at.RUN * LANES + k])] >= MAX_STEPS:
            remove_run(work, status, k, at.MANY_STEPS)
    code.compute_series(order, control, work)
    code.choose_sizes(order, control, work)
    _round_steps(work, control)
    for k in range(LANES):  # X: step size / UNIT. EVALUATED: number of evaluations of the equations within the step
        work[at.X * LANES + k] = work[at.H * LANES + k] / work[at.UNIT * LANES + k]
        if work[at.ACTIVE * LANES + k] == 1.0 and work[at.H * LANES + k] > control[at.GAP]:
            work[at.EVALUATED * LANES + k] = np.ceil(work[at.H * LANES + k] / control[at.GAP]) - 1.0
    code.check_defect_within(order, control, work)
    code.evaluate_series(order, control, work)
    project_lanes(code, order, control, work)
    if settings[at.CHECKS_REDUNDANT] == 1:
        code.check_redundant_rows(order, control, work)
    code.compute_prediction_error(order, control, work)
    code.evaluate_defect(order, control, work)
    code.accept_or_reject(order, control, work)

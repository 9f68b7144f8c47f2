"""Detect sudden changes of forces, C_t and b ahead of a step, such as gusts, blows and switches.

C_t is the time derivative of the constraints C; b belongs to non-holonomic constraints A v + b = 0. A step evaluates
the equations at its stages only, and may miss a force that acts between two stages. So forces, C_t and b are sampled
ahead of the step (`f`: kit, `w`: workspace), which costs less than evaluations of the equations.

- The straight line from the first to the last sample is subtracted. A change is sudden if a second difference of the
  samples exceeds a tenth of their range. The step must end at such a change, or where a value is not finite.
- If forces may change suddenly with position or velocity, and steps are longer than the time between samples, samples
  are taken along the motion, extrapolated by a parabola from the present position, velocity and acceleration.
- All other samples are taken with q and v fixed, as they are where the step begins. The time between these samples is
  also limited to a fraction of the step size.
- The shortest time between two changes, and the shortest duration of a pulse within a short step, are recorded. If the
  time between samples is not much shorter, other changes as short may have been missed: a message says so.

A jump of C_t or b, for example at the end of a ramp in a drive, changes velocities as an impulse does. Methods that
correct only dependent velocities after the jump would violate the balance of momentum. So, if velocities change in a
step by more than accelerations explain, C_t and b are sampled at thirteen times in the step. If C_t and b are smooth,
the twelfth difference of these samples is almost zero, and falls by 2^12 if the time span is halved. If C_t or b jumps,
the difference is as large as the jump, also in that half of the time span that contains the jump.
"""

import numpy as np

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.control.step_size import project_and_evaluate
from twoloop.kernels.data.common import allowed_error, compiled, finite_vector
from twoloop.kernels.data.indices import ATOL, DONE, FIXED_ORDER, GAP, RTOL
from twoloop.kernels.evaluation.constraints import constraint_rates, representable_step
from twoloop.kernels.linalg.dense import largest_of
from twoloop.kernels.linalg.symbolic_factorization import jacobian_entries_of

N_PARTS = 12  # number of equal parts of a time span; C_t and b are sampled at the 13 ends of these parts
# factors of 13 samples in the twelfth difference, which is almost zero for samples of a smooth function
BINOMIAL = (1.0, -12.0, 66.0, -220.0, 495.0, -792.0, 924.0, -792.0, 495.0, -220.0, 66.0, -12.0, 1.0)
MAX_BISECTIONS = 60  # largest number of bisections that locate a jump or a ramp of C_t or b
RATE_ROUNDING = 1e-11  # error of the twelfth difference due to rounding of samples, relative to the largest sample
TIME_ROUNDING = 5e3  # error of the twelfth difference due to rounding of t, relative to np.spacing(t) * (mean slope)
STEEPNESS = 4.0  # a part of a step is a ramp if C_t or b is this many times steeper in the part than in the whole step
MAX_RAMP_SHARE = 0.125  # only a ramp of C_t or b that takes at most this fraction of a step is located within the step
MIN_SPACINGS = 8.0  # bisection for a jump ends if the time span is at most this many spacings of floating-point times
SMOOTH, RAMP, JUMP = range(3)  # in a time span, C_t and b are SMOOTH, have a JUMP, or have a steep ramp or kink (RAMP)


@compiled
def _sample_rates(f, w, t, q, velocity, begin, end):
    """Store C_t and b at 13 times from `begin` to `end` in w.rates, at the positions q + velocity * (time - t)."""
    for k in range(N_PARTS + 1):
        time = end if k == N_PARTS else begin + (end - begin) * (k / N_PARTS)
        for m in range(q.size):
            w.x[m] = q[m] + (time - t) * velocity[m]
        constraint_rates(f, w, time, w.x, w.rates[k])
        if not finite_vector(w.rates[k]):  # for example d|t|/dt at t = 0: sample at the next floating-point time
            constraint_rates(f, w, time + np.spacing(abs(time)), w.x, w.rates[k])


@compiled
def _twelfth_difference(w, row):
    """Return |twelfth difference| of the samples w.rates[:, row] of one component of (C_t, b)."""
    total = 0.0
    for k in range(N_PARTS + 1):
        total += BINOMIAL[k] * w.rates[k, row]
    return abs(total)


@compiled
def _slope_and_size(w, row, length):
    """Return the mean |slope| (per s) and the largest |value| of samples w.rates[:, row] over a time `length` (s)."""
    change = 0.0
    largest = abs(w.rates[0, row])
    for k in range(N_PARTS):
        change += abs(w.rates[k + 1, row] - w.rates[k, row])
        largest = max(largest, abs(w.rates[k + 1, row]))
    return change / length, largest


@compiled
def _allowed_error(f, w, tolerances, v, row):
    """Return how much entry `row` of G v (G: Jacobian) changes at most if one velocity changes by its tolerance."""
    largest = 0.0
    if f.form == FIXED_ORDER:
        rows, columns, _ = jacobian_entries_of(f.ldl_program)
        for k in range(rows.size):
            if rows[k] == row:
                tolerance = tolerances[ATOL + columns[k]] + tolerances[RTOL] * abs(v[columns[k]])
                largest = max(largest, abs(w.jacobian_values[k]) * tolerance)
        return largest
    for m in range(v.size):
        tolerance = tolerances[ATOL + m] + tolerances[RTOL] * abs(v[m])
        largest = max(largest, abs(w.G[row, m]) * tolerance)
    return largest


@compiled
def unexplained_velocity_change(tolerances, h, state, new_state, n):
    """Return the largest |(change of a velocity in a step) - h * (mean acceleration)|, in tolerances."""
    largest = 0.0
    for m in range(n):
        v, v1, a, a1 = state[n + m], new_state[n + m], state[2 * n + m], new_state[2 * n + m]
        scale = allowed_error(tolerances, m, v, v1)
        largest = max(largest, abs(v1 - v - 0.5 * h * (a + a1)) / scale)
    return largest


@compiled
def locate_discontinuity(f, w, t, end, q, v, velocity, tolerances):
    """Find where C_t or b has a jump or a ramp between t and `end`; return SMOOTH, RAMP or JUMP, and two times (s).

    The times are the ends of the jump or ramp of the least smooth component, or t and `end` if all are smooth. If a
    ramp fills the time span, return the ends of its first half: a method that evaluates accelerations only at the ends
    of a ramp, where they may be zero, would miss it. (q, v): state at t. Samples are at q + velocity * (time - t).
    """
    begin = t
    h = end - t
    _sample_rates(f, w, t, q, velocity, begin, end)
    row, limit, mean, largest = -1, 0.0, 0.0, 1.0
    for i in range(w.Rate.size):
        difference = _twelfth_difference(w, i)
        if difference == 0.0:  # this component is constant
            continue
        slope, size = _slope_and_size(w, i, h)
        error_limit = max(
            _allowed_error(f, w, tolerances, v, i), RATE_ROUNDING * size, TIME_ROUNDING * slope * np.spacing(abs(end))
        )
        if difference > largest * error_limit:
            row, limit, mean, largest = i, error_limit, slope, difference / error_limit
    if row < 0:
        return SMOOTH, t, end
    steepest, low, high = 0.0, begin, end
    for _ in range(MAX_BISECTIONS):
        if end - begin <= MIN_SPACINGS * np.spacing(abs(end)):
            break
        middle = begin + 0.5 * (end - begin)
        _sample_rates(f, w, t, q, velocity, middle, end)
        above = _twelfth_difference(w, row)
        _sample_rates(f, w, t, q, velocity, begin, middle)
        below = _twelfth_difference(w, row)
        if not max(above, below) > limit:
            break
        if above > below:
            begin = middle
            _sample_rates(f, w, t, q, velocity, begin, end)
        else:
            end = middle
        slope, _ = _slope_and_size(w, row, end - begin)
        if slope > steepest and end - begin <= MAX_RAMP_SHARE * h and slope * (end - begin) > limit:
            steepest, low, high = slope, begin, end
    if end - begin <= MIN_SPACINGS * np.spacing(abs(end)):
        _sample_rates(f, w, t, q, velocity, begin, end)
        if abs(w.rates[N_PARTS, row] - w.rates[0, row]) > limit:
            return JUMP, begin, end
    if steepest > STEEPNESS * mean:
        return RAMP, low, high
    if end - begin < h:  # C_t or b is not smooth in one half of the step: it has a kink, or a ramp fills the step
        return RAMP, t, t + 0.5 * h
    return SMOOTH, t, t + h


N_SAMPLES = 20  # number of time intervals between the 21 samples of one set
MIN_TIME_AHEAD = 12.0  # samples along the motion extend at least over this number times control[SPACING] (s)
SUDDEN_RATIO = 0.1  # a change is sudden if the second difference exceeds this fraction of the range of the samples
# a force, C_t or b counts as constant if its samples differ by at most LEAST_RANGE * rtol times the largest value so
# far, or by at most LEAST_VALUE, as squares of smaller numbers underflow
LEAST_RANGE, LEAST_VALUE = 0.1, 1e-150
MIN_SAMPLES_IN_STEP = 8.0  # least number of samples per step, as stages may miss a force that lasts a quarter of a step
RESAMPLE_BELOW = 0.25  # sample again if samples must be closer than this fraction of the spacing of earlier samples
MIN_SPACING = 16.0  # shortest time between samples, in spacings of floating-point numbers at t
N_BISECTIONS = 20  # number of bisections that locate the time of a change between two samples
EQUAL_CHANGES = 1e-5  # two changes are the same if their times differ by at most this part of clock[WIDEST_SAMPLING]
# changes are not recorded until this time after the start, in units of tolerances[GAP]: just after the start, rounding
# errors make a force that begins at zero, such as 1 - cos(t), seem to change suddenly
MIN_RECORDED_TIME = 5e-5
MIN_STEEPNESS_RATIO = 2.0  # a sudden change between two samples exceeds the changes before and after it by this factor
SHORT_STEP = 0.5  # steps below this fraction of the longest recent step are searched for pulses of forces, C_t and b
N_SAMPLES_IN_SHORT_STEP = 4  # number of samples within a short step that is searched for pulses of forces, C_t and b
# if a change of velocities by at most their tolerances changes an acceleration by more than this fraction of the
# largest one, motion is not extrapolated with the present accelerations, see `_acceleration_lasts`
MAX_LASTING_CHANGE = 0.5
CHANGE_MARGIN = 0.01  # a step ignores changes just after its start: within this fraction of the time between samples
# w.changes has a column for each force, C_t and b; rows 0 to N_SAMPLES contain samples at successive times
LARGEST_ROW = N_SAMPLES + 1  # row of w.changes: largest |value| of each force, C_t and b so far
MIDDLE_ROW = N_SAMPLES + 2  # row of w.changes: a sample at a time between two of the 21 samples, or before them
N_CHANGES = N_SAMPLES + 3  # number of rows of w.changes


@compiled
def _sample_forces(f, w, time, elapsed, q, v, a, values):
    """Store forces, C_t, b at `time` in `values`, after (q, v) moved for `elapsed` s with constant accelerations a."""
    for m in range(q.size):
        w.x[m] = q[m] + elapsed * (v[m] + 0.5 * elapsed * a[m])
        w.y[m] = v[m] + elapsed * a[m]
    values[: q.size] = 0.0
    f.force(time, w.x, w.y, f.p, values[: q.size])
    constraint_rates(f, w, time, w.x, values[q.size :])


@compiled
def _least_ranges(tolerances, largest, n):
    """Return two limits, for forces and for C_t and b: samples that differ less count as constant, see LEAST_RANGE."""
    least = LEAST_RANGE * tolerances[RTOL]
    return max(LEAST_VALUE, least * largest_of(largest[:n])), max(LEAST_VALUE, least * largest_of(largest[n:]))


@compiled
def _is_smooth_bend(values, k, n):
    """Return True if samples 0 to n bend at k like a smooth curve: second differences at k and beside k are similar."""
    second_value = k + 1 if k + 2 <= n else k - 1
    if second_value < 1:
        return False
    difference = values[k + 1] - 2.0 * values[k] + values[k - 1]
    neighbour = values[second_value + 1] - 2.0 * values[second_value] + values[second_value - 1]
    return difference * neighbour > 0.0 and abs(neighbour) > 0.5 * abs(difference)


@compiled
def _find_sudden_bend(values, n, slope, min_range, strict):
    """Return the index of the first sudden bend of n + 1 samples (0: none), and the limit that its size exceeds.

    Size: |second difference|. Limit: SUDDEN_RATIO times the range of the samples after a line with `slope` (per sample)
    is subtracted. If this range is at most `min_range`, no bend is sudden. `strict`: skip bends of smooth curves.
    """
    low = high = 0.0
    for k in range(1, n + 1):
        deviation = values[k] - values[0] - k * slope
        low, high = min(low, deviation), max(high, deviation)
    limit = SUDDEN_RATIO * (high - low)
    if high - low > min_range:
        for k in range(1, n):
            second_difference = values[k + 1] - 2.0 * values[k] + values[k - 1]
            if abs(second_difference) > limit and not (strict and _is_smooth_bend(values, k, n)):
                return k, limit
    return 0, limit


@compiled
def _first_sudden_bend(values, n, detrends, min_range):
    """Find the first sudden bend of n + 1 samples; return its index (0: none), and the limit that its size exceeds.

    `_find_sudden_bend` searches all samples, then those before the bend found, until it finds no earlier bend. It
    subtracts the straight line from the first to the last searched sample if `detrends` is 1, nothing if it is 0.
    """
    index, limit = _find_sudden_bend(values, n, detrends * (values[n] - values[0]) / max(n, 1), min_range, False)
    while index > 1:  # find earlier bends; skip smooth curves (`strict`), which may exceed the limit if samples are few
        slope = detrends * (values[index] - values[0]) / index
        earlier, bound = _find_sudden_bend(values, index, slope, min_range, True)
        if earlier == 0:
            break
        index, limit = earlier, bound
    return index, limit


@compiled
def _is_sudden_change(previous, first_value, second_value, following, limit):
    """Return True if |second_value - first_value| exceeds `limit` and is much larger than both neighbouring changes.

    Only neighbouring changes of the same sign count: each must be more than MIN_STEEPNESS_RATIO times smaller.
    """
    change = second_value - first_value
    sign = 1.0 if change > 0.0 else -1.0
    neighbouring_change = max(sign * (first_value - previous), sign * (following - second_value))
    return abs(change) > limit and MIN_STEEPNESS_RATIO * neighbouring_change < abs(change)


@compiled
def _locate_change(f, w, low, high, k, j, q, v, a):
    """Locate a jump by bisection between the times `low` and `high`; return the time just after it.

    The value that jumps is in column j of w.changes, which contains its samples at these times in rows k and k + 1.
    """
    changes = w.changes
    before, after = changes[k, j], changes[k + 1, j]
    for _ in range(N_BISECTIONS):
        time = 0.5 * (low + high)
        _sample_forces(f, w, time, 0.0, q, v, a, changes[MIDDLE_ROW])
        value = changes[MIDDLE_ROW, j]
        if abs(value - before) >= abs(after - value):
            high, after = time, value
        else:
            low, before = time, value
    return high


@compiled
def _record_changes(f, w, tolerances, clock, t, begin, spacing, n, index, column, limit, q, v, a):
    """Record sudden changes just before and after sample `index`, where a force, C_t or b has a sudden bend.

    Store the last change's time in clock[LAST_CHANGE], the shortest time between changes in clock[SHORTEST_CHANGE].
    Samples k = 0 to n, at begin + k * spacing, are in this `column` of w.changes. Changes up to `limit` are not sudden.
    """
    values, margin = w.changes[:, column], max(CHANGE_MARGIN * spacing, EQUAL_CHANGES * clock[at.WIDEST_SAMPLING])
    first_recorded_time = clock[at.T_START] + MIN_RECORDED_TIME * tolerances[GAP]
    for k in range(index - 1, index + 1):
        low, high = begin + k * spacing, begin + (k + 1) * spacing
        is_recorded = low - margin <= clock[at.LAST_CHANGE] <= high + margin
        # skip a change that is already recorded, one without a later sample to compare, and one just after the start
        if is_recorded or k + 2 > n or low - spacing < first_recorded_time:
            continue
        if k == 0:
            _sample_forces(f, w, low - spacing, 0.0, q, v, a, w.changes[MIDDLE_ROW])
        if _is_sudden_change(values[MIDDLE_ROW if k == 0 else k - 1], values[k], values[k + 1], values[k + 2], limit):
            time = _locate_change(f, w, low, high, k, column, q, v, a)
            if clock[at.LAST_CHANGE] > -np.inf:
                clock[at.SHORTEST_CHANGE] = min(clock[at.SHORTEST_CHANGE], abs(time - clock[at.LAST_CHANGE]))
            clock[at.LAST_CHANGE] = time


@compiled
def first_discontinuity(f, w, tolerances, clock, t, begin, spacing, last, follows_motion, q, v, a):
    """Take a set of samples of forces, C_t and b; return the times (s) of the first sudden change and the last sample.

    If there is no sudden change, its time is infinite. (q, v, a): state at t. The first sample is at `begin`, the
    last one not after `last`. `follows_motion`: 1 for samples along the extrapolated motion, 0 at fixed (q, v).
    """
    changes, n, t_first = w.changes, 0, np.inf
    for k in range(N_SAMPLES + 1):
        time = begin + k * spacing
        if time > last:
            break
        _sample_forces(f, w, time, follows_motion * (time - t), q, v, a, changes[k])
        for j in range(changes.shape[1]):
            if np.isfinite(changes[k, j]):
                changes[LARGEST_ROW, j] = max(changes[LARGEST_ROW, j], abs(changes[k, j]))
            elif k > 0:
                t_first = time
        if t_first < np.inf:
            break
        n = k
    min_force_range, min_rate_range = _least_ranges(tolerances, changes[LARGEST_ROW], q.size)
    bend, column, limit = n, -1, 0.0
    for j in range(changes.shape[1]):
        values = changes[:, j]
        min_range = min_force_range if j < q.size else min_rate_range
        index, bound = _first_sudden_bend(values, n, follows_motion, min_range)
        if 0 < index < bend:
            bend, column, limit = index, j, bound
    if column >= 0:
        t_first = min(t_first, begin + bend * spacing)
        if follows_motion == 0.0:
            _record_changes(f, w, tolerances, clock, t, begin, spacing, n, bend, column, limit, q, v, a)
    return t_first, min(t_first, begin + N_SAMPLES * spacing if n == N_SAMPLES else last)


@compiled
def _record_short_change(f, w, tolerances, control, clock, t, size, last, q, v, a):
    """Search a short step for pulses: values of a force, C_t or b far outside those before and after the step.

    Store the shortest duration (s) of a pulse so far in clock[SHORTEST_CHANGE]. No sample is after the time `last`.
    """
    changes, spacing, begin, end = w.changes, control[at.TIME_SPACING], clock[at.T_START], t + size
    clock[at.COMPARED] = t
    if end + spacing > last or (t - 2.0 * spacing < begin and end + 2.0 * spacing > last):
        return
    for k, time in enumerate((t - 2.0 * spacing, t - spacing, end + spacing, end + 2.0 * spacing)):
        _sample_forces(f, w, min(max(time, begin), last), 0.0, q, v, a, changes[k + (k > 1)])
    min_force_range, min_rate_range = _least_ranges(tolerances, changes[LARGEST_ROW], q.size)
    for k in range(N_SAMPLES_IN_SHORT_STEP):
        time = t + k * size / N_SAMPLES_IN_SHORT_STEP
        _sample_forces(f, w, time, 0.0, q, v, a, changes[2])
        for j in range(changes.shape[1]):
            values = changes[:, j]
            low = min(min(values[0], values[1]), min(values[3], values[4]))
            high = max(max(values[0], values[1]), max(values[3], values[4]))
            excess = max(values[2] - high, low - values[2])
            if excess > max(MIN_STEEPNESS_RATIO * (high - low), min_force_range if j < q.size else min_rate_range):
                t_first = _locate_change(f, w, max(t - spacing, begin), time, 1, j, q, v, a)
                t_second = _locate_change(f, w, time, end + spacing, 2, j, q, v, a)
                clock[at.SHORTEST_CHANGE] = min(clock[at.SHORTEST_CHANGE], t_second - t_first)


@compiled
def _acceleration_lasts(f, w, tolerances, t, duration, q, v, a, Q, V, A):
    """Return True if the motion may be extrapolated over `duration` (s) with constant accelerations, the argument `a`.

    Accelerations must hardly change if velocities change by `a` * `duration`, reduced until no change exceeds its
    tolerance. If stiff friction holds a body, `a` is a rounding error of its forces: return False. Q, V, A: scratch.
    """
    n, time, largest, change = w.Q.size, duration, 0.0, 0.0
    for m in range(n):
        largest = max(largest, abs(a[m]))
        if a[m] != 0.0:
            time = min(time, allowed_error(tolerances, m, v[m], v[m]) / abs(a[m]))
    if largest == 0.0:
        return True
    for m in range(n):
        Q[m], V[m] = q[m], v[m] + time * a[m]
    if project_and_evaluate(f, w, t, Q, V, A) != DONE:
        return True
    for m in range(n):
        change = max(change, abs(A[m] - a[m]))
    return not change > MAX_LASTING_CHANGE * largest


@compiled
def _sample_motion(f, w, tolerances, control, clock, spacing, t, size, last, q, v, a, Q, V, A):
    """Find the next sudden change of forces, C_t or b along the motion, unless the whole step has been sampled before.

    Store its time in `clock`. Samples extend over max(`size`, MIN_TIME_AHEAD * `spacing`), but not beyond `last`.
    """
    if clock[at.MOTION_SAMPLED_TO] >= t + (1.0 - CHANGE_MARGIN) * size:
        return
    duration = min(max(size, MIN_TIME_AHEAD * spacing), last - t)
    clock[at.SAMPLES_MOTION] = 1.0
    t_first, clock[at.MOTION_SAMPLED_TO] = first_discontinuity(
        f, w, tolerances, clock, t, t, duration / N_SAMPLES, last, 1.0, q, v, a
    )
    if t_first < np.inf and not _acceleration_lasts(f, w, tolerances, t, duration, q, v, a, Q, V, A):
        A[:] = 0.0
        t_first, clock[at.MOTION_SAMPLED_TO] = first_discontinuity(
            f, w, tolerances, clock, t, t, duration / N_SAMPLES, last, 1.0, q, v, A
        )
    clock[at.SAMPLES_MOTION] = 0.0
    # if samples at a fixed state have found no change, samples along the motion replace them, unless the time between
    # samples along the motion is longer than the longest allowed time between samples at a fixed state
    change_found = clock[at.SAMPLED_TO] == clock[at.DISCONTINUITY] > t
    if not change_found and duration <= N_SAMPLES * min(control[at.TIME_SPACING], size / MIN_SAMPLES_IN_STEP):
        clock[at.WIDEST_SAMPLING] = max(clock[at.WIDEST_SAMPLING], duration / N_SAMPLES)
        if clock[at.MOTION_SAMPLED_TO] > clock[at.SAMPLED_TO]:
            clock[at.SAMPLED_TO], clock[at.SAMPLED_EVERY] = clock[at.MOTION_SAMPLED_TO], duration / N_SAMPLES
            clock[at.DISCONTINUITY] = t_first
    if t_first < clock[at.DISCONTINUITY_OF_MOTION] or clock[at.DISCONTINUITY_OF_MOTION] <= t + CHANGE_MARGIN * spacing:
        clock[at.DISCONTINUITY_OF_MOTION] = t_first


@compiled
def _sample_ahead(f, w, tolerances, control, clock, next_change, t, size, last, q, v, a):
    """Sample forces, C_t and b ahead of t, with q and v fixed; return the time of the next sudden change.

    This is `next_change`, which was known before (infinite: none), or an earlier change. No sample is after `last`.
    """
    max_spacing = max(min(control[at.TIME_SPACING], size / MIN_SAMPLES_IN_STEP), MIN_SPACING * np.spacing(abs(t)))
    # if samples must be much closer than before, sample again. Multistep methods (JUMP_RATIO = 1) do not need this,
    # because their error estimates show a jump, nor do runs in which each step is checked for jumps (MAY_JUMP = 1)
    may_resample = control[at.JUMP_RATIO] > 1.0 and control[at.MAY_JUMP] == 0.0
    if may_resample and max_spacing < RESAMPLE_BELOW * clock[at.SAMPLED_EVERY]:
        clock[at.SAMPLED_TO] = t
    begin = max(t, clock[at.SAMPLED_TO])
    # if the last samples ended at a sudden change, the next ones must not have a wider spacing than the last ones
    is_at_change = clock[at.DISCONTINUITY] == clock[at.SAMPLED_TO]
    while begin < min(t + size, last, next_change):
        spacing, is_at_change = min(max_spacing, clock[at.SAMPLED_EVERY]) if is_at_change else max_spacing, False
        clock[at.WIDEST_SAMPLING] = max(clock[at.WIDEST_SAMPLING], spacing)
        t_first, begin = first_discontinuity(f, w, tolerances, clock, t, begin, spacing, last, 0.0, q, v, a)
        next_change = min(next_change, t_first)
        clock[at.SAMPLED_TO], clock[at.SAMPLED_EVERY] = begin, spacing
    return next_change


@compiled
def limit_to_discontinuity(f, w, tolerances, control, clock, t, size, last, state, new_state):
    """Return the size (s) of the step from t: `size`, or less if the step must end at a sudden change.

    To find sudden changes of forces, C_t and b, sample these ahead of t, but not after `last`. `new_state` is scratch.
    """
    n, spacing = w.Q.size, control[at.SPACING]
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    Q, V, A = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
    min_size = (1.0 if control[at.BY_STATE] == 1.0 else MIN_TIME_AHEAD) * spacing
    if control[at.SAMPLE_MOTION] == 1.0 and min_size < size < (N_SAMPLES + CHANGE_MARGIN) * spacing:
        _sample_motion(f, w, tolerances, control, clock, spacing, t, size, last, q, v, a, Q, V, A)
    t_near = t + CHANGE_MARGIN * min(spacing, size / MIN_SAMPLES_IN_STEP)
    next_change = clock[at.DISCONTINUITY] if clock[at.DISCONTINUITY] > t_near else np.inf
    next_change_of_motion = clock[at.DISCONTINUITY_OF_MOTION] if clock[at.DISCONTINUITY_OF_MOTION] > t_near else np.inf
    is_at_change = next_change == np.inf and clock[at.DISCONTINUITY] == clock[at.SAMPLED_TO] > -np.inf
    # if the step begins at a change and is no longer than the time between samples, do not sample again: closer and
    # closer samples would show this change again and again
    if control[at.BY_TIME] == 1.0 and not (is_at_change and size <= (1.0 + CHANGE_MARGIN) * clock[at.SAMPLED_EVERY]):
        next_change = _sample_ahead(f, w, tolerances, control, clock, next_change, t, size, last, q, v, a)
        clock[at.DISCONTINUITY] = next_change
    size = min(size, representable_step(t, min(next_change, next_change_of_motion) - t))
    is_short = size < SHORT_STEP * clock[at.H_LONG] or t < clock[at.T_START] + 2.0 * control[at.TIME_SPACING]
    if control[at.BY_TIME] == 1.0 and is_short and size < control[at.TIME_SPACING] and clock[at.COMPARED] < t:
        _record_short_change(f, w, tolerances, control, clock, t, size, last, q, v, a)
    return size

"""Interpolate states within steps by polynomials through neighbouring states, and project the results.

Row i of `states` is [q, v, a] at the time t[i]; interval i is between rows i and i + 1. If a method takes long steps,
`fill_intervals` first computes states within an interval, which its polynomial interpolates. `f`: kit, `w`: workspace.
"""

import numpy as np
from numba import types

from twoloop.kernels.data import indices as kinds
from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, WORK, compiled, f8, i8, inlined, kernel, merged
from twoloop.kernels.data.indices import ATOL, DONE, GAMMA_INACCURATE, NULL_SPACE, REPORTED_ERROR, RTOL, SINGULAR
from twoloop.kernels.evaluation.inner_loop import accelerations, find_tangents, renew_partition, restore_constraints
from twoloop.kernels.evaluation.partition import min_pivot_ratio, partition_is_poor
from twoloop.kernels.linalg.dense import copy, largest_of

TABLE = types.int64[:, ::1]
CHECKED_FRACTIONS = (0.3, 0.7)  # times at which polynomials are checked, as fractions of an interval
N_CHECKED_TIMES = len(CHECKED_FRACTIONS)
EPS = 2.0**-52  # spacing of floating-point numbers at 1
MAX_GAP_RATIO = 8.0  # neighbouring steps count as equally long if the longest is at most this multiple of the shortest
# v has polynomials of its own if (rounding error of q) / (interval's duration) exceeds this number of v's tolerances
MAX_VELOCITY_ROUNDING = 10.0
# pivot ratio: smallest / largest pivot of the constraint Jacobian (partition.py). A position is singular if its ratio
# is below SINGULAR_PIVOT, or below SINGULAR_PIVOT_RATIO times the larger ratio at the ends of its interval
SINGULAR_PIVOT_RATIO = 0.01
SINGULAR_PIVOT = 1e-5
# a position also counts as singular if its pivot ratio r is below WEAK_PIVOT, and r * (change of v by the projection,
# in tolerances) is below MAX_VIOLATION. This product estimates the violation of the constraints by v before the
# projection. So small a violation may consist of rounding errors, which the projection amplifies by 1 / r
MAX_VIOLATION, WEAK_PIVOT = 10.0, 0.05


@merged
def _node_range(low, high, i, last):
    """Return the indices of the first and last state that the polynomial of the interval from i to `last` interpolates.

    The interval is in the middle of these states, unless an index would be below `low` or above `high`.
    """
    if last > i + 1:  # `fill_intervals` has added states within the interval: interpolate only states i to `last`
        return i, last
    n_states = min(kinds.WINDOW, high - low + 1)
    lo = max(low, min(i + 1 - n_states // 2, high + 1 - n_states))
    return lo, lo + n_states - 1


@compiled
def _divided_differences(t, states, lo, hi, i, h, column, order, z, c):
    """Compute the Hermite polynomials through rows lo to hi of `states`; return the number of coefficients of each.

    There are n polynomials, for the n columns of `states` from index `column` on, minus their values in row i. The next
    n columns contain the first derivatives, and the next n columns the second derivatives. `order`: 2 to interpolate
    values and first derivatives, 3 to interpolate second derivatives, too. Store the coefficients of Newton's form in
    c, and the time of each coefficient, as (time - t[i]) / h, in z; h: duration of the interval.
    """
    n = c.shape[1]
    n_coefficients = (hi - lo + 1) * order
    for r in range(n_coefficients):
        row = lo + r // order
        z[r] = (t[row] - t[i]) / h
        for m in range(n):
            c[r, m] = states[row, column + m] - states[i, column + m]
    for j in range(1, n_coefficients):
        for r in range(n_coefficients - 1, j - 1, -1):
            row, gap = lo + r // order, z[r] - z[r - j]
            if (r - j) // order == r // order:
                scale = h if j == 1 else 0.5 * h * h
                for m in range(n):
                    c[r, m] = scale * states[row, column + j * n + m]
            else:
                for m in range(n):
                    c[r, m] = (c[r, m] - c[r - 1, m]) / gap
    return n_coefficients


@merged
def _evaluate_polynomials(states, i, kind, h, s, z, c, size, z_v, c_v, size_v, q, v):
    """Store in q and v the values of the polynomials of an interval at the fraction s of its duration h.

    (z, c, size): times, coefficients and number of coefficients of the polynomials of q, see `_divided_differences`. If
    `kind` is SEPARATE, (z_v, c_v, size_v) belong to polynomials of v; otherwise v is the derivative of those of q.
    """
    n = q.size
    for m in range(n):
        value, slope = c[size - 1, m], 0.0
        for r in range(size - 2, -1, -1):
            slope = slope * (s - z[r]) + value
            value = value * (s - z[r]) + c[r, m]
        q[m], v[m] = value + states[i, m], slope / h
    if kind == kinds.SEPARATE:
        for m in range(n):
            value = c_v[size_v - 1, m]
            for r in range(size_v - 2, -1, -1):
                value = value * (s - z_v[r]) + c_v[r, m]
            v[m] = value + states[i, n + m]


@merged
def _kind_by_duration(kind, tolerances, h, states, i):
    """Return `kind`, or SEPARATE if the duration h is so short that rounding of q would spoil the derivative v of q."""
    n = tolerances.size - ATOL
    for m in range(n):
        atol, rtol = tolerances[ATOL + m], tolerances[RTOL]
        if EPS * abs(states[i, m]) > MAX_VELOCITY_ROUNDING * h * (atol + rtol * abs(states[i, n + m])):
            return kinds.SEPARATE
    return kind


@inlined
def _fit_polynomials(tolerances, t, states, group, z_q, c_q, z_v, c_v):
    """Compute the polynomials of an interval; `group` is its row in the table of intervals (data/indices.py).

    Store times z_q and coefficients c_q of the polynomials of q. Store z_v and c_v for v if the kind is SEPARATE.
    Return
    - the kind and the duration (s) of the interval
    - the indices of the first and last interpolated state
    - what the polynomials of q interpolate at each time: 2 if q and v, 3 if q, v and a
    - the number of coefficients of each polynomial of q, and of v (0 if v has none)
    """
    i, last, kind = group[kinds.FIRST_OWN], group[kinds.LAST_OWN], group[kinds.KIND]
    h = t[last] - t[i]
    kind = kind if kind == kinds.JUMP else _kind_by_duration(kind, tolerances, h, states, i)
    lo, hi = _node_range(group[kinds.LOW], group[kinds.HIGH], i, last)
    order = 3 if kind >= kinds.ACCELERATIONS else 2
    size = _divided_differences(t, states, lo, hi, i, h, 0, order, z_q, c_q)
    size_v = _divided_differences(t, states, lo, hi, i, h, c_v.shape[1], 2, z_v, c_v) if kind == kinds.SEPARATE else 0
    return kind, h, lo, hi, order, size, size_v


@merged
def _velocity_change(tolerances, v_before, v):
    """Return the largest change of a velocity from v_before to v, in units of its tolerance."""
    speed, largest = largest_of(v_before), 0.0
    for m in range(v.size):
        change = abs(v[m] - v_before[m]) / (tolerances[ATOL + m] + tolerances[RTOL] * speed)
        if not change <= largest:  # also true for NaN
            largest = change
    return largest


@compiled
def _is_singular(f, w, t, states, i, last, time, q, change):
    """Return True if q at `time` is so near a singular position that rounding explains how the projection changed v.

    `change`: change of velocities by the projection, in tolerances; i, `last`: indices of the states at the ends of the
    interval. For the limits of pivot ratios see SINGULAR_PIVOT_RATIO and WEAK_PIVOT.
    """
    n, largest = w.Q.size, 0.0
    for r in (i, last):
        if renew_partition(f, w, t[r], states[r, :n]) == DONE:
            largest = max(largest, min_pivot_ratio(f, w, t[r], states[r, :n]))
    code = renew_partition(f, w, time, q)
    pivot = min_pivot_ratio(f, w, time, q) if code == DONE else 0.0
    return pivot < max(SINGULAR_PIVOT_RATIO * largest, SINGULAR_PIVOT, min(MAX_VIOLATION / change, WEAK_PIVOT))


@kernel(i8(KIT, WORK, f8, VECTOR, VECTOR, MATRIX, TABLE, VECTOR, VECTOR, MATRIX, MATRIX))
def interpolate_states(f, w, tolerance, tolerances, t, states, groups, times, z, coefficients, out):
    """Store [q, v] at times[p] in row p of `out`; return the number of failed projections.

    The values of polynomials are projected onto the constraints. A projection fails if dependent coordinates cannot be
    determined, or if rounding dominates the projected velocities near a singular position. In both cases, the values of
    polynomials are stored. `groups`: the table of intervals of data/indices.py; `tolerance`: tolerance of the
    projection; `z`, `coefficients`: scratch.
    """
    n = w.Q.size
    half = z.size // 2
    z_q, z_v, c_q, c_v = z[:half], z[half:], coefficients[:half], coefficients[half:]
    q_0, v_0 = coefficients[2 * half - 2], coefficients[2 * half - 1]  # scratch rows, which no polynomial uses
    has_D = f.form == NULL_SPACE  # only this form computes w.D, which shows whether a partition is poor
    failures = 0
    for g in range(groups.shape[0]):
        i, last = groups[g, kinds.FIRST_OWN], groups[g, kinds.LAST_OWN]
        fit = _fit_polynomials(tolerances, t, states, groups[g], z_q, c_q, z_v, c_v)
        kind, h, _, _, _, size, size_v = fit
        # choose independent coordinates anew in each interval, so that results do not depend on earlier output times
        has_partition = False
        for p in range(groups[g, kinds.FIRST_TIME], groups[g, kinds.END_TIME]):
            q, v = out[p, :n], out[p, n : 2 * n]
            if times[p] == t[i] or times[p] == t[last]:
                copy(states[i if times[p] == t[i] else last, : 2 * n], out[p])
                continue
            if kind == kinds.JUMP:
                copy(states[i, : 2 * n], out[p])
                continue
            s = (times[p] - t[i]) / h
            _evaluate_polynomials(states, i, kind, h, s, z_q, c_q, size, z_v, c_v, size_v, q, v)
            copy(q, q_0)
            copy(v, v_0)
            code = DONE if has_partition else renew_partition(f, w, t[i], states[i, :n])
            if code == DONE:
                code = restore_constraints(f, w, times[p], q, v, tolerance)
            has_partition = (
                code == DONE
                and not (has_D and partition_is_poor(w))
                and _velocity_change(tolerances, v_0, v) <= REPORTED_ERROR
            )
            if not has_partition:
                copy(q_0, q)
                copy(v_0, v)
                code = renew_partition(f, w, times[p], q)
                if code == DONE:
                    code = restore_constraints(f, w, times[p], q, v, tolerance)
                change = _velocity_change(tolerances, v_0, v) if code == DONE else 0.0
                if not change <= REPORTED_ERROR and _is_singular(f, w, t, states, i, last, times[p], q, change):
                    code = SINGULAR
            if code != DONE:
                failures += 1
                copy(q_0, q)
                copy(v_0, v)
    return failures


@merged
def _state_difference(tolerances, scale_q, scale_v, states, i, q, v, q_other, v_other):
    """Return the largest of scale_q |q_other - q| and scale_v |v_other - v|, relative to tolerances at states[i]."""
    n = q.size
    rtol, largest, total = tolerances[RTOL], 0.0, 0.0
    for m in range(n):
        atol = tolerances[ATOL + m]
        change_q = scale_q * abs(q_other[m] - q[m]) / (atol + rtol * abs(states[i, m]))
        change_v = scale_v * abs(v_other[m] - v[m]) / (atol + rtol * abs(states[i, n + m]))
        largest, total = max(largest, change_q, change_v), total + change_q + change_v
    # if two interpolated states have equal times (a step may be as short as rounding of t), `total` is not finite
    return largest if np.isfinite(total) else np.inf


@merged
def _evaluate_accelerations(kind, h, s, z, c, size, z_v, c_v, size_v, a):
    """Store in `a` the accelerations by the polynomials of an interval; arguments as for `_evaluate_polynomials`."""
    for m in range(a.size):
        value, slope, curvature = c[size - 1, m], 0.0, 0.0
        for r in range(size - 2, -1, -1):
            curvature = curvature * (s - z[r]) + 2.0 * slope
            slope = slope * (s - z[r]) + value
            value = value * (s - z[r]) + c[r, m]
        a[m] = curvature / (h * h)
    if kind == kinds.SEPARATE:
        for m in range(a.size):
            value, slope = c_v[size_v - 1, m], 0.0
            for r in range(size_v - 2, -1, -1):
                slope = slope * (s - z_v[r]) + value
                value = value * (s - z_v[r]) + c_v[r, m]
            a[m] = slope / h


@merged
def _has_similar_gaps(t, lo, hi):
    """Return True if the longest step from t[lo] to t[hi] is at most MAX_GAP_RATIO times the shortest."""
    shortest, longest = np.inf, 0.0
    for r in range(lo, hi):
        shortest, longest = min(shortest, t[r + 1] - t[r]), max(longest, t[r + 1] - t[r])
    return longest <= MAX_GAP_RATIO * shortest


@kernel(i8(KIT, WORK, f8, VECTOR, VECTOR, MATRIX, TABLE, VECTOR, MATRIX, MATRIX, VECTOR))
def estimate_errors(f, w, tolerance, tolerances, t, states, groups, z, coefficients, rows, out):
    """For each interval g of `groups`, store in out[g] the estimated error of its polynomials, in tolerances.

    `tolerance`: tolerance of the projection; z, coefficients, rows: scratch. The first estimate that applies is used:
    - 0 for the kinds SEPARATE and VELOCITIES, if polynomials interpolate more than two states, all of them outside the
      interval or at its ends, and if the steps between these states are about equally long (MAX_GAP_RATIO)
    - the difference from polynomials that leave out the last state, if there are more than two states. If it exceeds 1,
      use the next estimate, except for VELOCITIES, where accelerations contain noise of stiff modes
    - the larger of two differences at CHECKED_FRACTIONS: between the state before and after projection, and between
      accelerations by polynomials and by the equations of motion. Let dt be h / (number of coefficients): a difference
      of accelerations times dt counts as an error of v, and times dt^2 as an error of q
    """
    n = w.Q.size
    half = z.size // 2
    z_q, z_v, c_q, c_v = z[:half], z[half:], coefficients[:half], coefficients[half:]
    q, v, q_1, v_1 = rows[0, :n], rows[0, n:], rows[1, :n], rows[1, n:]
    for g in range(groups.shape[0]):
        i, last = groups[g, kinds.FIRST_OWN], groups[g, kinds.LAST_OWN]
        fit = _fit_polynomials(tolerances, t, states, groups[g], z_q, c_q, z_v, c_v)
        kind, h, lo, hi, order, size, size_v = fit
        out[g] = 0.0
        if kind < kinds.ACCELERATIONS and last == i + 1 and hi - lo > 1 and _has_similar_gaps(t, lo, hi):
            continue
        if hi - lo > 1:
            for k in range(N_CHECKED_TIMES):
                s = CHECKED_FRACTIONS[k]
                _evaluate_polynomials(states, i, kind, h, s, z_q, c_q, size, z_v, c_v, size_v, q, v)
                shorter_size = size_v - 2 if kind == kinds.SEPARATE else 0
                _evaluate_polynomials(states, i, kind, h, s, z_q, c_q, size - order, z_v, c_v, shorter_size, q_1, v_1)
                out[g] = max(out[g], _state_difference(tolerances, 1.0, 1.0, states, i, q, v, q_1, v_1))
            if out[g] <= 1.0 or kind == kinds.VELOCITIES:
                continue
        out[g] = 0.0
        for k in range(N_CHECKED_TIMES):
            s = CHECKED_FRACTIONS[k]
            time = t[i] + s * h
            _evaluate_polynomials(states, i, kind, h, s, z_q, c_q, size, z_v, c_v, size_v, q, v)
            _evaluate_accelerations(kind, h, s, z_q, c_q, size, z_v, c_v, size_v, v_1)
            copy(rows[0], rows[2])
            code = DONE if k > 0 else renew_partition(f, w, t[i], states[i, :n])
            if code == DONE:
                code = restore_constraints(f, w, time, rows[2, :n], rows[2, n:], tolerance)
            if code != DONE:
                copy(rows[0], rows[2])
                code = renew_partition(f, w, time, q)
                if code == DONE:
                    code = restore_constraints(f, w, time, rows[2, :n], rows[2, n:], tolerance)
            if code == DONE:
                out[g] = max(out[g], _state_difference(tolerances, 1.0, 1.0, states, i, q, v, rows[2, :n], rows[2, n:]))
                code = accelerations(f, w, time, rows[2, :n], rows[2, n:], q_1, w.lam)
            if code != DONE:
                out[g] = np.inf
                break
            dt = h / size
            out[g] = max(out[g], _state_difference(tolerances, dt * dt, dt, states, i, v_1, v_1, q_1, q_1))
        if not np.isfinite(out[g]):
            out[g] = np.inf
    return DONE


@kernel(i8(KIT, WORK, VECTOR, MATRIX, MATRIX))
def fill_accelerations(f, w, times, states, out):
    """For each consistent state [q, v], store [a, lam] in a row of `out`, or NaN; return the number of failures."""
    n = w.Q.size
    code = SINGULAR
    failures = 0
    for p in range(times.size):
        q, v = states[p, :n], states[p, n : 2 * n]
        if code == DONE:
            code = find_tangents(f, w, times[p], q)
        if code != DONE or partition_is_poor(w):
            code = renew_partition(f, w, times[p], q)
            if code == DONE:
                code = find_tangents(f, w, times[p], q)
        if code == DONE:
            code = accelerations(f, w, times[p], q, v, out[p, :n], out[p, n:])
        if code == GAMMA_INACCURATE:  # accept these accelerations: no step depends on them
            required = w.gamma_required
            w.gamma_required = np.inf
            code = accelerations(f, w, times[p], q, v, out[p, :n], out[p, n:])
            w.gamma_required = required
        if code != DONE:
            out[p] = np.nan
            failures += 1
    return failures


@kernel(i8(KIT, WORK, *(VECTOR,) * 7, MATRIX, INTEGERS, VECTOR, MATRIX))
def fill_intervals(f, w, options, memory, memory_0, tolerances, state, new_state, t, states, intervals, out_t, out):
    """Divide intervals into equal steps of the method, and store the states; return the number of failed intervals.

    `intervals`: indices of the intervals. Each interval gets the same number of rows of `out_t` (times) and `out`
    (states): one for its first state, one for each state between two steps, and one for its last state. If a step
    fails, the interval's first row of `out_t` becomes NaN. `memory_0`: the method's memory at the start of a run.
    """
    n = w.Q.size
    n_rows = out_t.size // intervals.size
    failures = 0
    for g in range(intervals.size):
        i, first = intervals[g], g * n_rows
        last = first + n_rows - 1
        copy(memory_0, memory)
        state[:] = 0.0
        copy(states[i], state[: 3 * n])
        out_t[first], out_t[last] = t[i], t[i + 1]
        copy(states[i], out[first])
        copy(states[i + 1], out[last])
        code = renew_partition(f, w, t[i], state[:n])
        for r in range(first + 1, last):
            t_before = out_t[r - 1]
            out_t[r] = t[i] + (t[i + 1] - t[i]) * (r - first) / (n_rows - 1)
            if code == DONE:
                h = out_t[r] - t_before
                code, _, _ = f.attempt(f, w, options, memory, t_before, h, tolerances, state, new_state)
                if code != DONE and renew_partition(f, w, t_before, state[:n]) == DONE:
                    copy(memory_0, memory)
                    code, _, _ = f.attempt(f, w, options, memory, t_before, h, tolerances, state, new_state)
                f.commit(f, w, options, memory, tolerances, True)
            copy(new_state, state)
            copy(new_state[: 3 * n], out[r])
        if code != DONE:
            out_t[first] = np.nan
            failures += 1
    return failures

"""Interpolate states within steps by polynomials through neighbouring states, projected onto the constraints.

States are rows [q, v, a] at the times `t`; interval i lies between rows i and i + 1. With PARTS > 1 interior states are
computed first, by steps of the method, and a polynomial goes through those of one interval.
"""

import numpy as np
from numba import types

from twoloop.kernels.data import indices as kinds
from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, WORK, compiled, f8, i8, kernel, merged
from twoloop.kernels.data.indices import (
    ATOL,
    DONE,
    FORM,
    GAMMA_INACCURATE,
    GAMMA_REQUIRED,
    NULL_SPACE,
    RTOL,
    SINGULAR,
    UNTRUE,
)
from twoloop.kernels.evaluation.inner_loop import accelerations, find_tangents, renew_partition, restore
from twoloop.kernels.evaluation.partition import least_pivot, partition_is_poor
from twoloop.kernels.linalg.dense import copy, largest_of

TABLE = types.int64[:, ::1]
PLACES = (0.3, 0.7)  # positions within an interval, relative to its length, at which polynomials are checked
LOOKS = len(PLACES)
EPS = 2.0**-52
EVEN = 8.0  # largest ratio of two gaps at which steps count as equally long
NOISY = 10.0  # relative to the tolerance of velocities: rounding above this counts as noise
SINGULAR_SHARE = 0.01  # relative to the smallest pivots at the ends of an interval: a smaller pivot is singular
SINGULAR_PIVOT = 1e-5  # a smaller pivot (rows scaled to 1) counts as singular, too ...
RESIDUAL, WEAK_PIVOT = 10.0, 0.05  # ... and one below WEAK_PIVOT if velocities violate rows by fewer tolerances


@merged
def _window(low, high, i, last):
    """Return the first and last row of the polynomial of the interval from row i: centred, except at ends."""
    if last > i + 1:  # interior states of the interval are given
        return i, last
    size = min(kinds.WINDOW, high - low + 1)
    lo = max(low, min(i + 1 - size // 2, high + 1 - size))
    return lo, lo + size - 1


@compiled
def _divided_differences(t, states, lo, hi, i, h, place, order, z, c):
    """Compute Newton's form of the Hermite polynomial through rows lo to hi, in (time - t[i]) / h; return its size.

    For the block of columns from `place` on, less row i of them, with `order` values at each node: the blocks behind it
    are its derivatives.
    """
    n = c.shape[1]
    size = (hi - lo + 1) * order
    for r in range(size):
        row = lo + r // order
        z[r] = (t[row] - t[i]) / h
        for m in range(n):
            c[r, m] = states[row, place + m] - states[i, place + m]
    for j in range(1, size):
        for r in range(size - 1, j - 1, -1):
            row, gap = lo + r // order, z[r] - z[r - j]
            if (r - j) // order == r // order:
                scale = h if j == 1 else 0.5 * h * h
                for m in range(n):
                    c[r, m] = scale * states[row, place + j * n + m]
            else:
                for m in range(n):
                    c[r, m] = (c[r, m] - c[r - 1, m]) / gap
    return size


@merged
def _interpolate(states, i, kind, h, s, z, c, size, z_v, c_v, size_v, q, v):
    """Evaluate q and v of the polynomials by Horner's scheme."""
    n = q.size
    for m in range(n):
        value, slope = c[size - 1, m], 0.0
        for r in range(size - 2, -1, -1):
            slope = slope * (s - z[r]) + value
            value = value * (s - z[r]) + c[r, m]
        q[m], v[m] = value + states[i, m], slope / h
    if kind == kinds.APART:
        for m in range(n):
            value = c_v[size_v - 1, m]
            for r in range(size_v - 2, -1, -1):
                value = value * (s - z_v[r]) + c_v[r, m]
            v[m] = value + states[i, n + m]


@merged
def _kind(kind, tolerances, h, states, i):
    """Return `kind`, but APART if an interval is so short that rounding of q exceeds the tolerances of its slope."""
    n = tolerances.size - ATOL
    for m in range(n):
        atol, rtol = tolerances[ATOL + m], tolerances[RTOL]
        if EPS * abs(states[i, m]) > NOISY * h * (atol + rtol * abs(states[i, n + m])):
            return kinds.APART
    return kind


@merged
def _turn(tolerances, v_0, v):
    """Return the change of restored velocities over the tolerances; errors of polynomials explain up to UNTRUE."""
    speed, largest = largest_of(v_0), 0.0
    for m in range(v.size):
        change = abs(v[m] - v_0[m]) / (tolerances[ATOL + m] + tolerances[RTOL] * speed)
        if not change <= largest:  # NaN, too
            largest = change
    return largest


@compiled
def _is_singular(f, w, t, states, i, last, time, q, turn):
    """Return whether the rows are so close to losing rank within an interval that rounding explains `turn`.

    They are if they are much closer than at its ends, or the velocities of the polynomials satisfy the constraints.
    """
    n, largest = w.Q.size, 0.0
    for r in (i, last):
        if renew_partition(f, w, t[r], states[r, :n]) == DONE:
            largest = max(largest, least_pivot(f, w, t[r], states[r, :n]))
    code = renew_partition(f, w, time, q)
    pivot = least_pivot(f, w, time, q) if code == DONE else 0.0
    return pivot < max(SINGULAR_SHARE * largest, SINGULAR_PIVOT, min(RESIDUAL / turn, WEAK_PIVOT))


@kernel(i8(KIT, WORK, f8, VECTOR, VECTOR, MATRIX, TABLE, VECTOR, VECTOR, MATRIX, MATRIX))
def between(f, w, tolerance, tolerances, t, states, groups, times, z, room, out):
    """Write rows [q, v] of `out` at `times`; return the number of failed projections.

    A projection fails if no dependent coordinates are found, or if rounding determines its velocities beside a singular
    position: q and v are then those of the polynomials. `z` and `room` hold the nodes and coefficients of two
    polynomials.
    """
    n = w.Q.size
    half = z.size // 2
    z_q, z_v, c_q, c_v = z[:half], z[half:], room[:half], room[half:]
    q_0, v_0 = room[2 * half - 2], room[2 * half - 1]  # the last two rows, which c_v does not use
    reduced = f.flags[FORM] == NULL_SPACE  # then w.D is known
    failures = 0
    for g in range(groups.shape[0]):
        i, last, kind = groups[g, kinds.FIRST_OWN], groups[g, kinds.LAST_OWN], groups[g, kinds.KIND]
        h = t[last] - t[i]
        kind = kind if kind == kinds.JUMP else _kind(kind, tolerances, h, states, i)
        lo, hi = _window(groups[g, kinds.LOW], groups[g, kinds.HIGH], i, last)
        order = 3 if kind >= kinds.ACCELERATIONS else 2
        size = _divided_differences(t, states, lo, hi, i, h, 0, order, z_q, c_q)
        size_v = _divided_differences(t, states, lo, hi, i, h, n, 2, z_v, c_v) if kind == kinds.APART else 0
        # the choice of independent coordinates must not depend on other output times
        chosen = False
        for p in range(groups[g, kinds.FIRST_TIME], groups[g, kinds.END_TIME]):
            q, v = out[p, :n], out[p, n : 2 * n]
            if times[p] == t[i] or times[p] == t[last]:
                copy(states[i if times[p] == t[i] else last, : 2 * n], out[p])
                continue
            if kind == kinds.JUMP:
                copy(states[i, : 2 * n], out[p])
                continue
            s = (times[p] - t[i]) / h
            _interpolate(states, i, kind, h, s, z_q, c_q, size, z_v, c_v, size_v, q, v)
            copy(q, q_0)
            copy(v, v_0)
            code = DONE if chosen else renew_partition(f, w, t[i], states[i, :n])
            if code == DONE:
                code = restore(f, w, times[p], q, v, tolerance)
            chosen = code == DONE and not (reduced and partition_is_poor(w)) and _turn(tolerances, v_0, v) <= UNTRUE
            if not chosen:
                copy(q_0, q)
                copy(v_0, v)
                code = renew_partition(f, w, times[p], q)
                if code == DONE:
                    code = restore(f, w, times[p], q, v, tolerance)
                turn = _turn(tolerances, v_0, v) if code == DONE else 0.0
                if not turn <= UNTRUE and _is_singular(f, w, t, states, i, last, times[p], q, turn):
                    code = SINGULAR
            if code != DONE:
                failures += 1
                copy(q_0, q)
                copy(v_0, v)
    return failures


@merged
def _off(tolerances, scale_q, scale_v, states, i, q, v, q_other, v_other):
    """Return the largest difference of two states, in positions and velocities, over the tolerances."""
    n = q.size
    rtol, largest = tolerances[RTOL], 0.0
    for m in range(n):
        atol = tolerances[ATOL + m]
        largest = max(largest, scale_q * abs(q_other[m] - q[m]) / (atol + rtol * abs(states[i, m])))
        largest = max(largest, scale_v * abs(v_other[m] - v[m]) / (atol + rtol * abs(states[i, n + m])))
    return largest


@merged
def _slope_of_velocity(kind, h, s, z, c, size, z_v, c_v, size_v, a):
    """Write the accelerations of the polynomials to `a`."""
    for m in range(a.size):
        value, slope, bend = c[size - 1, m], 0.0, 0.0
        for r in range(size - 2, -1, -1):
            bend = bend * (s - z[r]) + 2.0 * slope
            slope = slope * (s - z[r]) + value
            value = value * (s - z[r]) + c[r, m]
        a[m] = bend / (h * h)
    if kind == kinds.APART:
        for m in range(a.size):
            value, slope = c_v[size_v - 1, m], 0.0
            for r in range(size_v - 2, -1, -1):
                slope = slope * (s - z_v[r]) + value
                value = value * (s - z_v[r]) + c_v[r, m]
            a[m] = slope / h


@merged
def _even(t, lo, hi):
    """Return whether the gaps between these times are of similar length."""
    shortest, longest = np.inf, 0.0
    for r in range(lo, hi):
        shortest, longest = min(shortest, t[r + 1] - t[r]), max(longest, t[r + 1] - t[r])
    return longest <= EVEN * shortest


@kernel(i8(KIT, WORK, f8, VECTOR, VECTOR, MATRIX, TABLE, VECTOR, MATRIX, MATRIX, VECTOR))
def judge(f, w, tolerance, tolerances, t, states, groups, z, room, rows, out):
    """Estimate the error of the polynomials of these intervals over the tolerances, into `out`.

    The error is 0 if the last node changes a polynomial by less than the tolerances. Otherwise the polynomial is
    compared with the constraints and the equations at positions within the interval: the error of its accelerations,
    times the time in which a polynomial of its degree can turn, is an error of velocity. If accelerations hold the
    noise of stiff modes, only the change by the last node counts. Methods of low order take steps that are short for
    their polynomials: these are checked only between steps of unequal length. Divided intervals are always checked.
    """
    n = w.Q.size
    half = z.size // 2
    z_q, z_v, c_q, c_v = z[:half], z[half:], room[:half], room[half:]
    q, v, q_1, v_1 = rows[0, :n], rows[0, n:], rows[1, :n], rows[1, n:]
    for g in range(groups.shape[0]):
        i, last, kind = groups[g, kinds.FIRST_OWN], groups[g, kinds.LAST_OWN], groups[g, kinds.KIND]
        h = t[last] - t[i]
        kind = kind if kind == kinds.JUMP else _kind(kind, tolerances, h, states, i)
        lo, hi = _window(groups[g, kinds.LOW], groups[g, kinds.HIGH], i, last)
        order = 3 if kind >= kinds.ACCELERATIONS else 2
        size = _divided_differences(t, states, lo, hi, i, h, 0, order, z_q, c_q)
        size_v = _divided_differences(t, states, lo, hi, i, h, n, 2, z_v, c_v) if kind == kinds.APART else 0
        out[g] = 0.0
        if kind < kinds.ACCELERATIONS and last == i + 1 and hi - lo > 1 and _even(t, lo, hi):
            continue
        if hi - lo > 1:
            for k in range(LOOKS):
                s = PLACES[k]
                _interpolate(states, i, kind, h, s, z_q, c_q, size, z_v, c_v, size_v, q, v)
                shorter = size_v - 2 if kind == kinds.APART else 0
                _interpolate(states, i, kind, h, s, z_q, c_q, size - order, z_v, c_v, shorter, q_1, v_1)
                out[g] = max(out[g], _off(tolerances, 1.0, 1.0, states, i, q, v, q_1, v_1))
            if out[g] <= 1.0 or kind == kinds.VELOCITIES:
                continue
        out[g] = 0.0
        for k in range(LOOKS):
            s = PLACES[k]
            time = t[i] + s * h
            _interpolate(states, i, kind, h, s, z_q, c_q, size, z_v, c_v, size_v, q, v)
            _slope_of_velocity(kind, h, s, z_q, c_q, size, z_v, c_v, size_v, v_1)
            copy(rows[0], rows[2])
            code = DONE if k > 0 else renew_partition(f, w, t[i], states[i, :n])
            if code == DONE:
                code = restore(f, w, time, rows[2, :n], rows[2, n:], tolerance)
            if code != DONE:
                copy(rows[0], rows[2])
                code = renew_partition(f, w, time, q)
                if code == DONE:
                    code = restore(f, w, time, rows[2, :n], rows[2, n:], tolerance)
            if code == DONE:
                out[g] = max(out[g], _off(tolerances, 1.0, 1.0, states, i, q, v, rows[2, :n], rows[2, n:]))
                code = accelerations(f, w, time, rows[2, :n], rows[2, n:], q_1, w.lam)
            if code != DONE:
                out[g] = np.inf
                break
            turn = h / size
            out[g] = max(out[g], _off(tolerances, turn * turn, turn, states, i, v_1, v_1, q_1, q_1))
        if not np.isfinite(out[g]):
            out[g] = np.inf
    return DONE


@kernel(i8(KIT, WORK, VECTOR, MATRIX, MATRIX))
def complete(f, w, times, states, out):
    """Write rows [a, lam] of `out` at consistent states [q, v]; return the number of failures (rows of NaN)."""
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
        if code == GAMMA_INACCURATE:  # take the best available values: no step depends on them
            required = w.notes[GAMMA_REQUIRED]
            w.notes[GAMMA_REQUIRED] = np.inf
            code = accelerations(f, w, times[p], q, v, out[p, :n], out[p, n:])
            w.notes[GAMMA_REQUIRED] = required
        if code != DONE:
            out[p] = np.nan
            failures += 1
    return failures


@kernel(i8(KIT, WORK, *(VECTOR,) * 7, MATRIX, INTEGERS, VECTOR, MATRIX))
def fill(f, w, options, memory, at_rest, tolerances, state, new_state, t, states, intervals, out_t, out):
    """Compute states within intervals by equal steps of the method; return the number of failures, whose t is NaN.

    `out_t` and `out` have the same number of rows for each; the first and the last are the ends of the interval.
    """
    n = w.Q.size
    rows = out_t.size // intervals.size
    failures = 0
    for g in range(intervals.size):
        i, first = intervals[g], g * rows
        last = first + rows - 1
        copy(at_rest, memory)
        state[:] = 0.0
        copy(states[i], state[: 3 * n])
        out_t[first], out_t[last] = t[i], t[i + 1]
        copy(states[i], out[first])
        copy(states[i + 1], out[last])
        code = renew_partition(f, w, t[i], state[:n])
        for r in range(first + 1, last):
            before = out_t[r - 1]
            out_t[r] = t[i] + (t[i + 1] - t[i]) * (r - first) / (rows - 1)
            if code == DONE:
                size = out_t[r] - before
                code, _, _ = f.attempt(f, w, options, memory, before, size, tolerances, state, new_state)
                if code != DONE and renew_partition(f, w, before, state[:n]) == DONE:
                    copy(at_rest, memory)
                    code, _, _ = f.attempt(f, w, options, memory, before, size, tolerances, state, new_state)
                f.settle(f, w, options, memory, tolerances, True)
            copy(new_state, state)
            copy(new_state[: 3 * n], out[r])
        if code != DONE:
            out_t[first] = np.nan
            failures += 1
    return failures

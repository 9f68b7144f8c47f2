"""Step by the Taylor series of the motion, computed from the index-3 equations themselves.

With G = [C_q; A] the motion obeys G v + G_t = 0 and M a + G^T lam = Q. Written for the coefficients of the series, of
order k in a and lam and of order k + 1 in v, all but the last coefficients of a, lam and v are known, and these solve

    M_0 a_k + G_0^T lam_k = r_k,    G_0 a_k = c_k,

with the matrix of the accelerations at the beginning of the step, whose factors are there: one solution with them an
order, and no derivative of the constraints beyond G (J. D. Pryce's structural analysis, BIT 41 (2001), 364-394, finds
these offsets for any equations). What r and c need of G, M and Q follows from a program of products and functions, see
`twoloop.generate.series`, and the recurrences for their coefficients (R. E. Moore, Interval Analysis (1966), ch. 11).

The series has the order that the tolerance asks for, and the step the length at which its last terms are as large as
the tolerance (A. Jorba and M. Zou, Experimental Mathematics 14 (2005), 99-117). Time is counted in units of the step
before, so that no power of a short time underflows. The end of the step is moved to the constraints.
"""

import numpy as np

from twoloop.kernels.control.step_size import departure, excess, store_prediction
from twoloop.kernels.data.common import ATTEMPT, SETTLE, SLACK, Attempt, Step, compiled, kernel, merged, times_gap
from twoloop.kernels.data.indices import (
    ATOL,
    BY_GENERAL,
    DEFECT,
    DONE,
    ESTIMATE,
    LOOK,
    N_OUTER,
    NEAR_NOW,
    NEARLY_SINGULAR,
    RTOL,
    STRAIGHT,
)
from twoloop.kernels.evaluation.inner_loop import evaluate_as_given, project
from twoloop.kernels.evaluation.tasks import EVALUATE_AS_GIVEN
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.steps import recurrences as at
from twoloop.kernels.steps.recurrences import accelerations_found, expand, series_of

# relative to the tolerances: distance of the unprojected end of a step from the constraints that is aimed at
ALLOWED = 0.3
# a defect up to LOUDEST is rounding if the one near the beginning is at least a LOUDER-th of it
LOUDEST, LOUDER = 1e4, 10.0
NEAR_BEGIN = 1e-5  # relative to the step: distance from its start within which no force is taken to change
GOLDEN = 0.6180339887498949  # fractional parts of its multiples are evenly distributed between 0 and 1
BEYOND = 1e300  # replaces an infinite defect, if a function has no value within the step
MOST_SHORTENED = 0.1  # smallest factor of a step that is rejected for its defect
GROWTH = 5.0  # largest ratio of two steps in a row: coefficients belong to the unit of the step before
FARTHEST = 1e6  # relative to the guess of the first step: largest factor, so that no power of it overflows
TOO_SHORT = 2.0  # error of a first step that is not made, because the series allows a longer one


@merged
def _find_series(f, w, options, memory, t, state, unit, which):
    """Compute the series about a state that was projected just before, into one of the two places."""
    n = w.Q.size
    memory[at.TARGET] = which
    if f.flags[STRAIGHT] == 1 and w.notes[BY_GENERAL] == 0.0:  # generated code leaves no factors in w
        q, v, a = state[:n], state[n : 2 * n], accelerations_found(memory, n)
        code = f.general(f, w, EVALUATE_AS_GIVEN, t, q, v, 0.0, a, w.lam)
        if code != DONE:
            return code
    return expand(f, w, options, memory, t, state, unit)


@merged
def _length(tolerances, series, unit, order, n):
    """Return the step, in units, at which the last two terms of positions and velocities are within the tolerances."""
    rtol, last, before = tolerances[RTOL], 0.0, 0.0
    row, row_before = order * n, (order - 1) * n
    for j in range(n):
        atol = tolerances[ATOL + j]
        of_q = 1.0 / (atol + rtol * abs(series[j]))
        of_v = 1.0 / (atol * unit + rtol * abs(series[n + j]))
        last = max(last, abs(series[row + j]) * max(of_q, order * of_v))
        before = max(before, abs(series[row_before + j]) * max(of_q, (order - 1) * of_v))
    least = -np.inf  # logarithm of 1 / length
    if last > 0.0:
        least = np.log(last) / order
    if before > 0.0:
        least = max(least, np.log(before) / (order - 1))
    return np.exp(-least)


@merged
def _evaluate(series, unit, order, x, q, v, a):
    """Evaluate q, v and a at x units of time by Horner's scheme, four or two coordinates at a time.

    The recurrence of the second derivative gives half of it.
    """
    n, per_unit = q.size, 1.0 / unit
    twice = 2.0 * per_unit * per_unit
    for first in range(0, n if n > 3 else 0, 4):
        j = min(first, n - 4)
        m = order * n + j
        q0, q1, q2, q3 = series[m], series[m + 1], series[m + 2], series[m + 3]
        v0 = v1 = v2 = v3 = 0.0
        a0 = a1 = a2 = a3 = 0.0
        for m in range((order - 1) * n + j, -1, -n):
            a0, a1, a2, a3 = a0 * x + v0, a1 * x + v1, a2 * x + v2, a3 * x + v3
            v0, v1, v2, v3 = v0 * x + q0, v1 * x + q1, v2 * x + q2, v3 * x + q3
            q0, q1 = q0 * x + series[m], q1 * x + series[m + 1]
            q2, q3 = q2 * x + series[m + 2], q3 * x + series[m + 3]
        q[j], q[j + 1], q[j + 2], q[j + 3] = q0, q1, q2, q3
        v[j], v[j + 1], v[j + 2], v[j + 3] = v0 * per_unit, v1 * per_unit, v2 * per_unit, v3 * per_unit
        a[j], a[j + 1], a[j + 2], a[j + 3] = a0 * twice, a1 * twice, a2 * twice, a3 * twice
    for first in range(0, n if n < 4 else 0, 2):
        j = max(min(first, n - 2), 0)
        k = min(j + 1, n - 1)
        q0, q1 = series[order * n + j], series[order * n + k]
        v0 = v1 = a0 = a1 = 0.0
        for m in range((order - 1) * n, -1, -n):
            a0, a1 = a0 * x + v0, a1 * x + v1
            v0, v1 = v0 * x + q0, v1 * x + q1
            q0, q1 = q0 * x + series[m + j], q1 * x + series[m + k]
        q[j], q[k], v[j], v[k] = q0, q1, v0 * per_unit, v1 * per_unit
        a[j], a[k] = a0 * twice, a1 * twice


@compiled
def _defect_at(f, w, memory, t, h, s, tolerances, series, order, q, v, a):
    """Return the defect at the share s of the step over the allowed one; infinite if it cannot be evaluated."""
    found = accelerations_found(memory, q.size)
    _evaluate(series, memory[at.UNIT], order, s * h / memory[at.UNIT], q, v, found)
    if evaluate_as_given(f, w, t + s * h, q, v, a) != DONE:
        return np.inf
    return excess(tolerances, h, order, found, a, q, v)


@compiled
def _is_noise(f, w, memory, t, h, tolerances, series, order, q, v, a, defect):
    """Return whether a defect is rounding, i.e. as large near the beginning, where the series is exact."""
    if defect > LOUDEST:
        return False
    noise = 0.0
    for k in range(1, 4):
        noise = max(noise, _defect_at(f, w, memory, t, h, k * NEAR_BEGIN, tolerances, series, order, q, v, a))
    return defect <= LOUDER * noise


@compiled
def _refused_within(f, w, memory, t, h, tolerances, series, order, q, v, a):
    """Return the defect for which the step is rejected before its end is evaluated, or 0; record the largest one.

    Each attempt checks other places, except for the last place at which a step was rejected.
    """
    look, shift = tolerances[LOOK], memory[at.ATTEMPTS] * GOLDEN % 1.0
    n_places = 0
    if h > look:
        n_places = int(np.ceil(h / look))
    for k in range(-1, n_places):
        s = (k + shift) / n_places if k >= 0 else (memory[at.SUSPECT] - t) / h
        if k < 0 and not (memory[at.SUSPECTED] == 1.0 and 0.0 < s < 1.0):
            continue
        defect = _defect_at(f, w, memory, t, h, s, tolerances, series, order, q, v, a)
        if defect > 1.0 and not _is_noise(f, w, memory, t, h, tolerances, series, order, q, v, a, defect):
            if memory[at.SUSPECTED] == 0.0 or t + s * h < memory[at.SUSPECT]:
                memory[at.SUSPECT] = t + s * h
            memory[at.SUSPECTED] = 1.0
            return defect
        w.notes[DEFECT] = max(w.notes[DEFECT], defect)
    return 0.0


@merged
def _shortened(defect, order):
    """Return the factor for a step that was rejected for its defect."""
    return max(MOST_SHORTENED, 0.9 * defect ** (-1.0 / order))


@kernel(SETTLE)
def settle_taylor(f, w, options, memory, tolerances, accepted):
    """Store the series about the end of an accepted step for the next one."""
    if accepted and memory[at.TRIED] == 1.0:
        memory[at.WHICH] = 1.0 - memory[at.WHICH]
        memory[at.UNIT], memory[at.LENGTH] = memory[at.NEXT_UNIT], memory[at.NEXT_LENGTH]
    memory[at.TRIED] = 0.0


@kernel(ATTEMPT)
def taylor_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step by the series about its beginning; the series about its end then sets the next step."""
    n, order, estimated = w.Q.size, int(options[at.ORDER]), tolerances[ESTIMATE] == 1.0
    q, v = state[:n], state[n : 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    w.counters[N_OUTER] += 1
    if memory[at.KNOWN] == 0.0:
        copy(state, new_state)
        code = project(f, w, t, q1, v1, options[at.THETA], a1, lam1)
        if code == DONE:
            code = _find_series(f, w, options, memory, t, new_state, h, memory[at.WHICH])
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        memory[at.KNOWN], memory[at.UNIT] = 1.0, h
        if estimated:
            memory[at.LENGTH] = _length(tolerances, series_of(memory, order, n, memory[at.WHICH]), h, order, n)
            if memory[at.LENGTH] > GROWTH:
                return Attempt(DONE, TOO_SHORT, min(memory[at.LENGTH], FARTHEST))
    series, unit = series_of(memory, order, n, memory[at.WHICH]), memory[at.UNIT]
    x = (memory[at.PASSED] + h) / unit
    error, checked, found = 0.0, False, accelerations_found(memory, n)
    if estimated:
        error = x / memory[at.LENGTH]  # larger than the estimated error, which is a power of it
        if error > 1.0 + SLACK:
            return Attempt(DONE, error, 1.0 / error)
        error = min(error, 1.0)
        singular = w.notes[NEARLY_SINGULAR] != 0.0  # it stays so until the end of the run
        checked = w.notes[NEAR_NOW] == 0.0  # near such a position accelerations off the constraints are meaningless
        w.notes[NEAR_NOW] = 0.0 if checked else 2.0
        longer = times_gap(tolerances, h)
        if longer > 0.0 and singular:
            return Attempt(DONE, longer, 1.0 / longer)
        if checked:
            memory[at.ATTEMPTS] += 1.0
            if memory[at.SUSPECTED] == 1.0 and memory[at.SUSPECT] <= t:
                memory[at.SUSPECTED] = 0.0
            w.notes[DEFECT] = 0.0
            defect = _refused_within(f, w, memory, t, h, tolerances, series, order, q1, v1, a1)
            if defect > 0.0:
                return Attempt(DONE, min(defect, BEYOND), _shortened(defect, order))
    _evaluate(series, unit, order, x, q1, v1, found)
    store_prediction(w, q1)
    code = project(f, w, t + h, q1, v1, options[at.THETA], a1, lam1)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    if options[at.KEEP] == 1.0:
        memory[at.PASSED] += h
        return Attempt(DONE, 0.0, 0.0)
    off = departure(w, tolerances, h, q, v, q1)
    memory[at.SHORTER], allowed = 1.0, np.inf
    if off > 0.0:  # if growth, or a force ahead, made the step shorter than LENGTH, its length says nothing
        allowed = (ALLOWED / off) ** (1.0 / order)
        memory[at.SHORTER] = min(1.0, max(x / memory[at.LENGTH], 1.0 / GROWTH) * allowed)
    if off > 1.0:
        return Attempt(DONE, off, allowed)
    if checked:
        defect = excess(tolerances, h, order, found, a1, q1, v1)
        if defect > 1.0:
            noise = _is_noise(f, w, memory, t, h, tolerances, series, order, q1, v1, a1, defect)
            if not noise:
                return Attempt(DONE, min(defect, BEYOND), _shortened(defect, order))
            _evaluate(series, unit, order, x, q1, v1, found)
            code = project(f, w, t + h, q1, v1, options[at.THETA], a1, lam1)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
        w.notes[DEFECT] = max(w.notes[DEFECT], defect)
    series = series_of(memory, order, n, 1.0 - memory[at.WHICH])
    unit = min(memory[at.LENGTH] * unit, GROWTH * h) if estimated else h
    code = _find_series(f, w, options, memory, t + h, new_state, unit, 1.0 - memory[at.WHICH])
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    memory[at.TRIED], memory[at.NEXT_UNIT] = 1.0, unit
    factor = 0.0
    if estimated:
        memory[at.NEXT_LENGTH] = _length(tolerances, series, unit, order, n)
        shorter = memory[at.SHORTER] if memory[at.SHORTER] > 0.0 else 1.0
        factor = min(shorter * memory[at.NEXT_LENGTH] * unit / h, GROWTH)
    return Attempt(DONE, max(error, off), factor)


TAYLOR = Step(taylor_step, settle_taylor)

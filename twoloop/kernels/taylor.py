"""A step by the Taylor series of the motion, found from the index-3 equations themselves.

With G = [C_q; A] the motion obeys G v + G_t = 0 and M a + G^T lam = Q. Written for the coefficients of the series, of
order k in a and lam and of order k + 1 in v, all but the last coefficients of a, lam and v are known, and these solve

    M_0 a_k + G_0^T lam_k = r_k,    G_0 a_k = c_k,

with the matrix of the accelerations at the beginning of the step, whose factors are there: one solution with them an
order, and no derivative of the constraints beyond G (J. D. Pryce's structural analysis, BIT 41 (2001), 364-394, finds
these offsets for any equations). What r and c need of G, M and Q follows from a program of products and functions, see
`twoloop.series`, and the recurrences for their coefficients (R. E. Moore, Interval Analysis (1966), ch. 11).

The series has the order that the tolerance asks for, and the step the length at which its last terms are as large as
the tolerance (A. Jorba and M. Zou, Experimental Mathematics 14 (2005), 99-117). Time is counted in units of the step
before, so that no power of a short time underflows. The end of the step is moved to the constraints.
"""

import numpy as np

from twoloop.kernels.accelerations import solve_for_order
from twoloop.kernels.calls import project
from twoloop.kernels.common import (
    ATOL,
    DEPARTURE,
    DONE,
    ESTIMATE,
    N_OUTER,
    RTOL,
    STEP,
    STEP_FACTOR,
    kernel,
    merged,
)
from twoloop.kernels.linalg import copy
from twoloop.kernels.predictor import departure, keep_predicted
from twoloop.kernels.series import (
    KEEP,
    KNOWN,
    LAST_ACCEPTED,
    LENGTH,
    NEXT_LENGTH,
    NEXT_UNIT,
    ORDER,
    PASSED,
    SHORTER,
    TARGET,
    THETA,
    TRIED,
    UNIT,
    WHICH,
    expand,
    series_of,
)

ROUNDING = 1e-9  # relative, by which a step may be longer than the series allows
ALLOWED = 0.3  # of the tolerances: how far from the constraints the end of a step is to be before it is moved there
GROWTH = 5.0  # of the step from one to the next, at most: coefficients belong to the unit of the step before


@kernel(STEP)
def solve_order(f, w, r, c, _t, _unit, _tolerances, a, lam):
    """The linear solution of one order, for code made for a mechanism where its own factors do not serve."""
    solve_for_order(f, w, r, c, a, lam)
    return DONE, 0.0


@merged
def _find_series(f, w, options, memory, t, state, unit, which, by_code):
    """The series about a state, into one of the two places; by f.own, code made for the mechanism, if there is."""
    memory[TARGET] = which
    if by_code:
        code, _ = f.own(f, w, options, memory, t, unit, state, state, state)
        return code
    return expand(f, w, options, memory, t, state, unit)


@merged
def _length(tolerances, series, unit, order, n):
    """The step, in units, at which the last two terms, of positions and velocities, are within the tolerances."""
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
def _evaluate(series, unit, order, x, q, v):
    """q and v at x units of time, by Horner's scheme; four coordinates at once, or two, some of the last ones twice."""
    n, per_unit = q.size, 1.0 / unit
    for first in range(0, n if n > 3 else 0, 4):
        j = min(first, n - 4)
        m = order * n + j
        q0, q1, q2, q3 = series[m], series[m + 1], series[m + 2], series[m + 3]
        v0 = v1 = v2 = v3 = 0.0
        for m in range((order - 1) * n + j, -1, -n):
            v0, v1, v2, v3 = v0 * x + q0, v1 * x + q1, v2 * x + q2, v3 * x + q3
            q0, q1 = q0 * x + series[m], q1 * x + series[m + 1]
            q2, q3 = q2 * x + series[m + 2], q3 * x + series[m + 3]
        q[j], q[j + 1], q[j + 2], q[j + 3] = q0, q1, q2, q3
        v[j], v[j + 1], v[j + 2], v[j + 3] = v0 * per_unit, v1 * per_unit, v2 * per_unit, v3 * per_unit
    for first in range(0, n if n < 4 else 0, 2):
        j = max(min(first, n - 2), 0)
        k = min(j + 1, n - 1)
        q0, q1, v0, v1 = series[order * n + j], series[order * n + k], 0.0, 0.0
        for m in range((order - 1) * n, -1, -n):
            v0, v1 = v0 * x + q0, v1 * x + q1
            q0, q1 = q0 * x + series[m + j], q1 * x + series[m + k]
        q[j], q[k], v[j], v[k] = q0, q1, v0 * per_unit, v1 * per_unit


@merged
def _step(f, w, options, memory, t, h, tolerances, state, new_state, by_code):
    """One attempt, by the series about its beginning; then the series about its end, which sets the next step."""
    n, order, estimated = w.Q.size, int(options[ORDER]), tolerances[ESTIMATE] == 1.0
    q, v = state[:n], state[n : 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    w.counters[N_OUTER] += 1
    if memory[TRIED] == 1.0 and memory[LAST_ACCEPTED] == 1.0:
        memory[WHICH] = 1.0 - memory[WHICH]
        memory[UNIT], memory[LENGTH] = memory[NEXT_UNIT], memory[NEXT_LENGTH]
    memory[TRIED] = 0.0
    if memory[KNOWN] == 0.0:
        copy(state, new_state)
        code = project(f, w, t, q1, v1, options[THETA], a1, lam1)
        if code == DONE:
            code = _find_series(f, w, options, memory, t, new_state, h, memory[WHICH], by_code)
        if code != DONE:
            return code, np.inf
        memory[KNOWN], memory[UNIT] = 1.0, h
        if estimated:
            memory[LENGTH] = _length(tolerances, series_of(memory, order, n, memory[WHICH]), h, order, n)
    series, unit = series_of(memory, order, n, memory[WHICH]), memory[UNIT]
    x = (memory[PASSED] + h) / unit
    error = 0.0
    if estimated:
        error = x / memory[LENGTH]  # larger than the estimate of the error, which is a power of it
        if x > memory[LENGTH] * (1.0 + ROUNDING):
            w.notes[STEP_FACTOR] = memory[LENGTH] / x
            return DONE, max(error, 1.0 + ROUNDING)
        error = min(error, 1.0)
    _evaluate(series, unit, order, x, q1, v1)
    keep_predicted(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code != DONE:
        return code, np.inf
    if options[KEEP] == 1.0:
        memory[PASSED] += h
        return DONE, 0.0
    w.notes[DEPARTURE] = departure(w, tolerances, h, q, v, q1)
    if w.notes[DEPARTURE] > 0.0:
        memory[SHORTER] = min(1.0, x / memory[LENGTH] * (ALLOWED / w.notes[DEPARTURE]) ** (1.0 / order))
    if w.notes[DEPARTURE] > 1.0:
        w.notes[STEP_FACTOR] = memory[SHORTER] * memory[LENGTH] / x
        return DONE, w.notes[DEPARTURE]
    series = series_of(memory, order, n, 1.0 - memory[WHICH])
    unit = min(memory[LENGTH] * unit, GROWTH * h) if estimated else h
    code = _find_series(f, w, options, memory, t + h, new_state, unit, 1.0 - memory[WHICH], by_code)
    if code != DONE:
        return code, np.inf
    memory[TRIED], memory[NEXT_UNIT] = 1.0, unit
    if estimated:
        memory[NEXT_LENGTH] = _length(tolerances, series, unit, order, n)
        shorter = memory[SHORTER] if memory[SHORTER] > 0.0 else 1.0
        w.notes[STEP_FACTOR] = min(shorter * memory[NEXT_LENGTH] * unit / h, GROWTH)
    return DONE, max(error, w.notes[DEPARTURE])


@kernel(STEP)
def taylor_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """The step with series found by their program."""
    return _step(f, w, options, memory, t, h, tolerances, state, new_state, False)


@kernel(STEP, vectorized=True)
def compiled_taylor_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """The step with series found by f.own, code made for the mechanism; f.instead solves where its factors cannot."""
    return _step(f, w, options, memory, t, h, tolerances, state, new_state, True)

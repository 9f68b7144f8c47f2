"""Locate times at which C_t or b jumps: the end of a ramp in a drive, say, where velocities change as by an impulse.

Steps see forces, and a jump causes an impulse instead: methods that restore the dependent coordinates leave the
independent ones unchanged, which no momentum balance allows. So a step is checked if its velocities change by more than
its accelerations explain: C_t and b are sampled at thirteen times along a line. What a polynomial of degree 11 leaves
of them is almost zero if they are smooth on the scale of the step, and falls by 2^12 where an interval is halved. At a
jump it is the size of the jump, in one of the halves, however short they are.
"""

import numpy as np

from twoloop.kernels.data.common import allowed, compiled, finite_vector
from twoloop.kernels.data.indices import ATOL, FORM, RTOL, STATIC
from twoloop.kernels.evaluation.constraints import constraint_rates
from twoloop.kernels.linalg.symbolic_factorization import jacobian_of

N_PARTS = 12
# coefficients of the twelfth difference
BINOMIAL = (1.0, -12.0, 66.0, -220.0, 495.0, -792.0, 924.0, -792.0, 495.0, -220.0, 66.0, -12.0, 1.0)
HALVINGS = 60
RATE_ROUNDING = 1e-11  # relative to C_t: rounding errors of the twelfth difference
TIME_ROUNDING = 5e3  # times the slope and the rounding of t: rounding errors as well
# times the mean slope over the step: a steeper part is a ramp for which the step is too long, if it is at most ...
STEEPNESS = 4.0
MAX_RAMP_SHARE = 0.125  # ... this share of the step
MIN_SPACINGS = 8.0  # shortest interval that is halved, in spacings of floating-point numbers
SMOOTH, RAMP, JUMP = range(3)


@compiled
def _sample(f, w, t, q, way, begin, end):
    """Evaluate C_t and b at thirteen times from begin to end, on the line q + way (time - t), into w.rates."""
    for k in range(N_PARTS + 1):
        time = end if k == N_PARTS else begin + (end - begin) * (k / N_PARTS)
        for m in range(q.size):
            w.x[m] = q[m] + (time - t) * way[m]
        constraint_rates(f, w, time, w.x, w.rates[k])
        if not finite_vector(w.rates[k]):  # such as the derivative of |t| at 0: take the value next to it
            constraint_rates(f, w, time + np.spacing(abs(time)), w.x, w.rates[k])


@compiled
def _twelfth_difference(w, row):
    total = 0.0
    for k in range(N_PARTS + 1):
        total += BINOMIAL[k] * w.rates[k, row]
    return abs(total)


@compiled
def _slope_and_size(w, row, length):
    """Return the mean absolute slope of a row over the samples, and its largest value."""
    change = 0.0
    largest = abs(w.rates[0, row])
    for k in range(N_PARTS):
        change += abs(w.rates[k + 1, row] - w.rates[k, row])
        largest = max(largest, abs(w.rates[k + 1, row]))
    return change / length, largest


@compiled
def _allowed(f, w, tolerances, x, row):
    """Return the error in a row that the tolerances of coordinates, or velocities, x allow."""
    largest = 0.0
    if f.flags[FORM] == STATIC:
        rows, columns, _ = jacobian_of(f.static_program)
        for k in range(rows.size):
            if rows[k] == row:
                tolerance = tolerances[ATOL + columns[k]] + tolerances[RTOL] * abs(x[columns[k]])
                largest = max(largest, abs(w.jacobian_values[k]) * tolerance)
        return largest
    for m in range(x.size):
        tolerance = tolerances[ATOL + m] + tolerances[RTOL] * abs(x[m])
        largest = max(largest, abs(w.G[row, m]) * tolerance)
    return largest


@compiled
def unexplained_velocity_change(tolerances, h, state, new_state, n):
    """Return the largest change of a velocity that accelerations at both ends do not explain, over the tolerances."""
    largest = 0.0
    for m in range(n):
        v, v1, a, a1 = state[n + m], new_state[n + m], state[2 * n + m], new_state[2 * n + m]
        scale = allowed(tolerances, m, v, v1)
        largest = max(largest, abs(v1 - v - 0.5 * h * (a + a1)) / scale)
    return largest


@compiled
def locate_discontinuity(f, w, t, end, q, v, way, tolerances):
    """Return SMOOTH, RAMP or JUMP, and the interval from t to `end` in which the least smooth row rises.

    After RAMP, the next step is at most as long as the interval. Methods whose accelerations at both ends are zero see
    nothing of a ramp that fills their step.
    """
    begin = t
    h = end - t
    _sample(f, w, t, q, way, begin, end)
    row, limit, mean, most = -1, 0.0, 0.0, 1.0
    for i in range(w.Rate.size):
        bend = _twelfth_difference(w, i)
        if bend == 0.0:  # a row that does not depend on time
            continue
        slope, size = _slope_and_size(w, i, h)
        least = max(
            _allowed(f, w, tolerances, v, i), RATE_ROUNDING * size, TIME_ROUNDING * slope * np.spacing(abs(end))
        )
        if bend > most * least:
            row, limit, mean, most = i, least, slope, bend / least
    if row < 0:
        return SMOOTH, t, end
    steepest, low, high = 0.0, begin, end
    for _ in range(HALVINGS):
        if end - begin <= MIN_SPACINGS * np.spacing(abs(end)):
            break
        middle = begin + 0.5 * (end - begin)
        _sample(f, w, t, q, way, middle, end)
        above = _twelfth_difference(w, row)
        _sample(f, w, t, q, way, begin, middle)
        below = _twelfth_difference(w, row)
        if not max(above, below) > limit:
            break
        if above > below:
            begin = middle
            _sample(f, w, t, q, way, begin, end)
        else:
            end = middle
        slope, _ = _slope_and_size(w, row, end - begin)
        if slope > steepest and end - begin <= MAX_RAMP_SHARE * h and slope * (end - begin) > limit:
            steepest, low, high = slope, begin, end
    if end - begin <= MIN_SPACINGS * np.spacing(abs(end)):
        _sample(f, w, t, q, way, begin, end)
        if abs(w.rates[N_PARTS, row] - w.rates[0, row]) > limit:
            return JUMP, begin, end
    if steepest > STEEPNESS * mean:
        return RAMP, low, high
    if end - begin < h:  # half the step is not smooth either: a ramp as long as the step, or a kink
        return RAMP, t, t + 0.5 * h
    return SMOOTH, t, t + h

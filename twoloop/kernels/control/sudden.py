"""Forces, C_t and b that change suddenly: a gust, a blow, a switch, a magnet, between two places where steps look.

They are called at times ahead: a call of one callback where a look at the equations is an evaluation. Of what is smooth
over some of these times second differences are small against the range of the values, less the line from the first to
the last; of what happens within one or two of them they are as large. A step is to end there, and where a value is
not finite, so that the run meets it. Where something may be sharp by place or speed, steps longer than the spacing of
these times are looked at along the parabola on which the motion sets out: each long one, and at once all short ones
that end within LONG spacings. Ahead of others the state stays that where the step begins.
"""

import numpy as np

from twoloop.kernels.control import clock as at
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.tolerances import RTOL
from twoloop.kernels.evaluation.constraints import constraint_rates
from twoloop.kernels.evaluation.gamma import representable

PLACES = 20  # times ahead that are compared
LONG = 12.0  # spacings of these times: the shortest way along which it is looked
SHARE = 0.1  # of the range: a second difference that is sudden; that of a bell as wide as four of these times
LEAST = 0.1  # of rtol, times the largest value so far: a range that may matter
NEARLY = 0.01  # of the spacing of these times: before a sudden change by that is at it
LARGEST = PLACES + 1  # row of w.changes behind those of the values
N_CHANGES = PLACES + 2


@compiled
def _call(f, w, time, since, q, v, a, now):
    """Forces, C_t and b at a time, and at the state `since` seconds after (q, v, a)."""
    for m in range(q.size):
        w.x[m] = q[m] + since * (v[m] + 0.5 * since * a[m])
        w.y[m] = v[m] + since * a[m]
    now[: q.size] = 0.0
    f.force(time, w.x, w.y, f.p, now[: q.size])
    constraint_rates(f, w, time, w.x, now[q.size :])


@compiled
def _largest(values):
    """The largest of the values so far, of all kinds: a coordinate without a force has no scale of its own."""
    largest = 0.0
    for x in values:
        largest = max(largest, x)
    return largest


@compiled
def _first_bend(values, n, slope, least):
    """The first place where the second difference of n + 1 values, less a line, is sudden; else 0."""
    low = high = 0.0
    for k in range(1, n + 1):
        off = values[k] - values[0] - k * slope
        low, high = min(low, off), max(high, off)
    if high - low > least:
        for k in range(1, n):
            if abs(values[k + 1] - 2.0 * values[k] + values[k - 1]) > SHARE * (high - low):
                return k
    return 0


@compiled
def sudden_time(f, w, tolerances, t, begin, spacing, last, along, q, v, a):
    """The first of the times ahead at which something changes suddenly, or infinity; and up to where it was looked.

    The state is that at t, the times go from `begin`, none is after `last`; `along` tells whether the state goes with
    them.
    """
    changes, n, first = w.changes, 0, np.inf
    for k in range(PLACES + 1):
        time = begin + k * spacing
        if time > last:
            break
        _call(f, w, time, along * (time - t), q, v, a, changes[k])
        for j in range(changes.shape[1]):
            if np.isfinite(changes[k, j]):
                changes[LARGEST, j] = max(changes[LARGEST, j], abs(changes[k, j]))
            elif k > 0:
                first = time
        if first < np.inf:
            break
        n = k
    least = LEAST * tolerances[RTOL]
    of_forces, of_rates = least * _largest(changes[LARGEST, : q.size]), least * _largest(changes[LARGEST, q.size :])
    for j in range(changes.shape[1]):
        values = changes[:, j]
        slope = along * (values[n] - values[0]) / max(n, 1)
        place = _first_bend(values, n, slope, of_forces if j < q.size else of_rates)
        if place > 0:
            first = min(first, begin + place * spacing)
    return first, min(first, begin + PLACES * spacing if n == PLACES else last)


@compiled
def _look_along(f, w, tolerances, clock, spacing, t, size, last, q, v, a):
    """Look along the way of a step, and of those behind it that end within LONG spacings, once."""
    if clock[at.ALONG_TO] >= t + (1.0 - NEARLY) * size:
        return
    way = min(max(size, LONG * spacing), last - t)
    clock[at.LOOKING] = 1.0
    first, clock[at.ALONG_TO] = sudden_time(f, w, tolerances, t, t, way / PLACES, last, 1.0, q, v, a)
    clock[at.LOOKING] = 0.0
    if first == np.inf:
        clock[at.LOOKED_TO] = max(clock[at.LOOKED_TO], t + way)
    elif first < clock[at.SUDDEN] or clock[at.SUDDEN] <= t + NEARLY * spacing:
        clock[at.SUDDEN] = clock[at.LOOKED_TO] = first


@compiled
def up_to_sudden(f, w, tolerances, control, clock, t, size, last, state):
    """The size of a step that does not pass over a sudden change."""
    n, spacing = w.Q.size, control[at.SPACING]
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    shortest = (1.0 if control[at.BY_STATE] == 1.0 else LONG) * spacing
    if control[at.AHEAD] == 1.0 and shortest < size < (PLACES + NEARLY) * spacing:
        _look_along(f, w, tolerances, clock, spacing, t, size, last, q, v, a)
    while clock[at.SUDDEN] <= t + NEARLY * spacing or clock[at.SUDDEN] == np.inf:
        begin = max(t, clock[at.LOOKED_TO])
        if control[at.BY_TIME] == 0.0 or begin >= min(t + size, last):
            return size
        clock[at.SUDDEN], clock[at.LOOKED_TO] = sudden_time(f, w, tolerances, t, begin, spacing, last, 0.0, q, v, a)
    return min(size, representable(t, clock[at.SUDDEN] - t))

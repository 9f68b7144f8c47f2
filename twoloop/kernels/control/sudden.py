"""Forces, C_t and b that change suddenly with time: a gust, a blow, a switch, between two places at which steps look.

They are called at times ahead, at the state where the step begins: a call of one callback where a look at the
equations is an evaluation. Of what is smooth over some of these times second differences are small against the range
of the values; of what happens within one or two of them they are as large. A step is to end there.
"""

import numpy as np

from twoloop.kernels.control.clock import LOOKED_TO, SUDDEN
from twoloop.kernels.data.common import RTOL, compiled
from twoloop.kernels.evaluation.constraints import constraint_rates
from twoloop.kernels.evaluation.gamma import representable

PLACES = 20  # times ahead that are compared
SHARE = 0.1  # of the range: a second difference that is sudden; that of a bell as wide as four of these times
LEAST = 0.1  # of rtol, times the largest value so far: a range that may matter
NEARLY = 0.01  # of the spacing of these times: before a sudden change by that is at it
NOW, BEFORE, EARLIER, LOW, HIGH, BEND, PLACE, LARGEST, N_CHANGES = range(9)  # rows of w.changes


@compiled
def _call(f, w, time, q, v):
    """Forces, C_t and b at a time."""
    now = w.changes[NOW]
    now[: q.size] = 0.0
    f.force(time, q, v, f.p, now[: q.size])
    constraint_rates(f, w, time, q, now[q.size :])


@compiled
def _largest(values):
    """The largest of the values so far, of all kinds: a coordinate without a force has no scale of its own."""
    largest = 0.0
    for x in values:
        largest = max(largest, x)
    return largest


@compiled
def sudden_time(f, w, tolerances, t, spacing, last, q, v):
    """The first of the times ahead at which something changes suddenly, or infinity; and up to where it was looked.

    None is after `last`. A value that is not finite is left to the step.
    """
    changes, end, n = w.changes, last, q.size
    for k in range(PLACES + 1):
        time = t + k * spacing
        if time > last:
            break
        if k == PLACES:
            end = time
        _call(f, w, time, q, v)
        for j in range(changes.shape[1]):
            x = changes[NOW, j]
            changes[LARGEST, j] = max(changes[LARGEST, j], abs(x))
            if k == 0:
                changes[LOW, j] = changes[HIGH, j] = x
                changes[BEND, j] = changes[PLACE, j] = 0.0
            else:
                changes[LOW, j], changes[HIGH, j] = min(changes[LOW, j], x), max(changes[HIGH, j], x)
            if k > 1:
                bend = abs(x - 2.0 * changes[BEFORE, j] + changes[EARLIER, j])
                if bend > changes[BEND, j]:
                    changes[BEND, j], changes[PLACE, j] = bend, k - 1.0
            changes[EARLIER, j], changes[BEFORE, j] = changes[BEFORE, j], x
    of_forces, of_rates = _largest(changes[LARGEST, :n]), _largest(changes[LARGEST, n:])
    first = np.inf
    for j in range(changes.shape[1]):
        span, least = changes[HIGH, j] - changes[LOW, j], LEAST * tolerances[RTOL]
        least *= of_forces if j < n else of_rates
        if span > least and changes[BEND, j] > SHARE * span:
            first = min(first, t + changes[PLACE, j] * spacing)
    return first, min(first, end)


@compiled
def up_to_sudden(f, w, tolerances, clock, spacing, t, size, last, q, v):
    """The size of a step that does not pass over a sudden change with time."""
    while clock[SUDDEN] <= t + NEARLY * spacing or clock[SUDDEN] == np.inf:
        begin = max(t, clock[LOOKED_TO])
        if begin >= min(t + size, last):
            return size
        clock[SUDDEN], clock[LOOKED_TO] = sudden_time(f, w, tolerances, begin, spacing, last, q, v)
    return min(size, representable(t, clock[SUDDEN] - t))

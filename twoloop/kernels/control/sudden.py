"""Forces, C_t and b that change suddenly: a gust, a blow, a switch, a magnet, between two places where steps look.

They are called at times ahead: a call of one callback where a look at the equations is an evaluation. Of what is smooth
over some of these times second differences are small against the range of the values, less the line from the first to
the last; of what happens within one or two of them they are as large. A step is to end there, and where a value is
not finite, so that the run meets it. Where something may be sharp by place or speed, steps longer than the spacing of
these times are looked at along the parabola on which the motion sets out: each long one, and at once all short ones
that end within LONG spacings. Ahead of others the state stays that where the step begins.

Of what may change suddenly with time, these times are also no further apart than a share of the step. The shortest time
between two changes is kept, and the shortest for which a value differs from those before and behind: what is as short
may have been missed where these times were further apart.
"""

import numpy as np

from twoloop.kernels.control import clock as at
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.tolerances import GAP, RTOL
from twoloop.kernels.evaluation.constraints import constraint_rates, representable_step

PLACES = 20  # times ahead that are compared
LONG = 12.0  # spacings of these times: the shortest way along which it is looked
SHARE = 0.1  # of the range: a second difference that is sudden; that of a bell as wide as four of these times
LEAST = 0.1  # of rtol, times the largest value so far: a range that may matter
FLOOR = 1e-150  # ... in any units: squares of less underflow, and the least numbers of all change by steps
IN_A_STEP = 8.0  # looks within a step: stages lie up to a quarter of it apart, and may all miss what is shorter
SHRUNK = 0.25  # of the distance of the last looks: looks that are to be closer than that are taken again
LEAST_APART = 16.0  # spacings of floating-point numbers between two looks
HALVINGS = 20  # to find when a value changes between two looks ...
SAME = 1e-5  # ... of the widest ones: changes that are closer are one
SOON = 5e-5  # of a hundredth of the run: before, a force that begins at zero, as 1 - cos(t), changes by rounding
STEEPER = 2.0  # times the changes before and after: the flank of a pulse, and not a slope
SHORT = 0.5  # of the longest of the last steps: below, something has happened that made steps shorter
IN_SHORT = 4  # looks within such a step
NEARLY = 0.01  # of the spacing of these times: before a sudden change by that is at it
LARGEST = PLACES + 1  # row of w.changes behind those of the values
MIDDLE = PLACES + 2  # row of w.changes for values between two looks
N_CHANGES = PLACES + 3


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
def _is_smooth(values, k, n):
    """Whether the second difference at place k of n + 1 values is about that at the next place, or the one before."""
    other = k + 1 if k + 2 <= n else k - 1
    if other < 1:
        return False
    here = values[k + 1] - 2.0 * values[k] + values[k - 1]
    there = values[other + 1] - 2.0 * values[other] + values[other - 1]
    return here * there > 0.0 and abs(there) > 0.5 * abs(here)


@compiled
def _bend(values, n, slope, least, within):
    """The first place where the second difference of n + 1 values, less a line, is sudden, else 0; and what is so."""
    low = high = 0.0
    for k in range(1, n + 1):
        off = values[k] - values[0] - k * slope
        low, high = min(low, off), max(high, off)
    sudden = SHARE * (high - low)
    if high - low > least:
        for k in range(1, n):
            second = values[k + 1] - 2.0 * values[k] + values[k - 1]
            if abs(second) > sudden and not (within and _is_smooth(values, k, n)):
                return k, sudden
    return 0, sudden


@compiled
def _first_bend(values, n, along, least):
    """The same of the whole, less the line to its end if `along`, and then of what is before: that may be smaller."""
    place, sudden = _bend(values, n, along * (values[n] - values[0]) / max(n, 1), least, False)
    while place > 1:  # few values may bend as much as that, and smoothly
        before, share = _bend(values, place, along * (values[place] - values[0]) / place, least, True)
        if before == 0:
            break
        place, sudden = before, share
    return place, sudden


@compiled
def _is_flank(previous, one, other, following, sudden):
    """Whether values change suddenly between one and other, and neither before nor after as if on a slope."""
    change = other - one
    sign = 1.0 if change > 0.0 else -1.0
    beside = max(sign * (one - previous), sign * (following - other))
    return abs(change) > sudden and STEEPER * beside < abs(change)


@compiled
def _flank(f, w, t, low, high, k, j, q, v, a):
    """When value j changes, between times low and high at places k and k + 1: just behind it."""
    changes = w.changes
    before, after = changes[k, j], changes[k + 1, j]
    for _ in range(HALVINGS):
        time = 0.5 * (low + high)
        _call(f, w, time, 0.0, q, v, a, changes[MIDDLE])
        now = changes[MIDDLE, j]
        if abs(now - before) >= abs(after - now):
            high, after = time, now
        else:
            low, before = time, now
    return high


@compiled
def _keep_flanks(f, w, tolerances, clock, t, begin, spacing, n, place, column, sudden, q, v, a):
    """Keep when a value changes next to a place where it bends, and the time since the change before."""
    values, apart = w.changes[:, column], max(NEARLY * spacing, SAME * clock[at.WIDEST_LOOK])
    soonest = clock[at.T_START] + SOON * tolerances[GAP]
    for k in range(place - 1, place + 1):
        low, high = begin + k * spacing, begin + (k + 1) * spacing
        known = low - apart <= clock[at.FLANK] <= high + apart
        if known or k + 2 > n or low - spacing < soonest:  # what is on both sides is to be seen, too
            continue
        if k == 0:
            _call(f, w, low - spacing, 0.0, q, v, a, w.changes[MIDDLE])
        if _is_flank(values[MIDDLE if k == 0 else k - 1], values[k], values[k + 1], values[k + 2], sudden):
            time = _flank(f, w, t, low, high, k, column, q, v, a)
            if clock[at.FLANK] > -np.inf:
                clock[at.BRIEFEST] = min(clock[at.BRIEFEST], abs(time - clock[at.FLANK]))
            clock[at.FLANK] = time


@compiled
def sudden_time(f, w, tolerances, clock, t, begin, spacing, last, along, q, v, a):
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
    of_forces = max(FLOOR, least * _largest(changes[LARGEST, : q.size]))
    of_rates = max(FLOOR, least * _largest(changes[LARGEST, q.size :]))
    bend, column, sudden = n, -1, 0.0
    for j in range(changes.shape[1]):
        values = changes[:, j]
        place, least = _first_bend(values, n, along, of_forces if j < q.size else of_rates)
        if 0 < place < bend:
            bend, column, sudden = place, j, least
    if column >= 0:
        first = min(first, begin + bend * spacing)
        if along == 0.0:
            _keep_flanks(f, w, tolerances, clock, t, begin, spacing, n, bend, column, sudden, q, v, a)
    return first, min(first, begin + PLACES * spacing if n == PLACES else last)


@compiled
def _keep_brief(f, w, tolerances, control, clock, t, size, last, q, v, a):
    """Keep how long a value in a step differs from those before and behind: short steps have met it, and not looks."""
    changes, wide, begin, end = w.changes, control[at.APART], clock[at.T_START], t + size
    clock[at.COMPARED] = t
    if end + wide > last or (t - 2.0 * wide < begin and end + 2.0 * wide > last):
        return
    for k, time in enumerate((t - 2.0 * wide, t - wide, end + wide, end + 2.0 * wide)):
        _call(f, w, min(max(time, begin), last), 0.0, q, v, a, changes[k + (k > 1)])
    least = LEAST * tolerances[RTOL]
    of_forces = max(FLOOR, least * _largest(changes[LARGEST, : q.size]))
    of_rates = max(FLOOR, least * _largest(changes[LARGEST, q.size :]))
    for k in range(IN_SHORT):
        time = t + k * size / IN_SHORT
        _call(f, w, time, 0.0, q, v, a, changes[2])
        for j in range(changes.shape[1]):
            values = changes[:, j]
            low = min(min(values[0], values[1]), min(values[3], values[4]))
            high = max(max(values[0], values[1]), max(values[3], values[4]))
            beyond = max(values[2] - high, low - values[2])
            if beyond > max(STEEPER * (high - low), of_forces if j < q.size else of_rates):
                first = _flank(f, w, t, max(t - wide, begin), time, 1, j, q, v, a)
                second = _flank(f, w, t, time, end + wide, 2, j, q, v, a)
                clock[at.BRIEFEST] = min(clock[at.BRIEFEST], second - first)


@compiled
def _look_along(f, w, tolerances, control, clock, spacing, t, size, last, q, v, a):
    """Look along the way of a step, and of those behind it that end within LONG spacings, once."""
    if clock[at.ALONG_TO] >= t + (1.0 - NEARLY) * size:
        return
    way = min(max(size, LONG * spacing), last - t)
    clock[at.LOOKING] = 1.0
    first, clock[at.ALONG_TO] = sudden_time(f, w, tolerances, clock, t, t, way / PLACES, last, 1.0, q, v, a)
    clock[at.LOOKING] = 0.0
    known = clock[at.LOOKED_TO] == clock[at.SUDDEN] > t  # by closer looks, which are to go on there
    if not known and way <= PLACES * min(control[at.APART], size / IN_A_STEP):  # as close as looks in time alone
        clock[at.WIDEST_LOOK] = max(clock[at.WIDEST_LOOK], way / PLACES)
        if clock[at.ALONG_TO] > clock[at.LOOKED_TO]:
            clock[at.LOOKED_TO], clock[at.LOOKED_EVERY] = clock[at.ALONG_TO], way / PLACES
            clock[at.SUDDEN] = first
    if first < clock[at.ALONG] or clock[at.ALONG] <= t + NEARLY * spacing:
        clock[at.ALONG] = first


@compiled
def _ahead(f, w, tolerances, control, clock, known, t, size, last, q, v, a):
    """The next sudden change with time ahead of a step, or infinity, where no other is known before that."""
    every = max(min(control[at.APART], size / IN_A_STEP), LEAST_APART * np.spacing(abs(t)))
    # a multistep method, whose formula no jump fools, drops its past only where it is refused; and steps find jumps of
    # C_t and b, if they do not end next to them
    closer = control[at.ROUGH] > 1.0 and control[at.DRIVEN] == 0.0
    if closer and every < SHRUNK * clock[at.LOOKED_EVERY]:
        clock[at.LOOKED_TO] = t
    begin = max(t, clock[at.LOOKED_TO])
    at_change = clock[at.SUDDEN] == clock[at.LOOKED_TO]  # which is to be found again
    while begin < min(t + size, last, known):
        apart, at_change = min(every, clock[at.LOOKED_EVERY]) if at_change else every, False
        clock[at.WIDEST_LOOK] = max(clock[at.WIDEST_LOOK], apart)
        first, begin = sudden_time(f, w, tolerances, clock, t, begin, apart, last, 0.0, q, v, a)
        known = min(known, first)
        clock[at.LOOKED_TO], clock[at.LOOKED_EVERY] = begin, apart
    return known


@compiled
def up_to_sudden(f, w, tolerances, control, clock, t, size, last, state):
    """The size of a step that does not pass over a sudden change."""
    n, spacing = w.Q.size, control[at.SPACING]
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    shortest = (1.0 if control[at.BY_STATE] == 1.0 else LONG) * spacing
    if control[at.AHEAD] == 1.0 and shortest < size < (PLACES + NEARLY) * spacing:
        _look_along(f, w, tolerances, control, clock, spacing, t, size, last, q, v, a)
    near = t + NEARLY * min(spacing, size / IN_A_STEP)
    known = clock[at.SUDDEN] if clock[at.SUDDEN] > near else np.inf
    along = clock[at.ALONG] if clock[at.ALONG] > near else np.inf
    at_change = known == np.inf and clock[at.SUDDEN] == clock[at.LOOKED_TO] > -np.inf
    # not up to the end of a run, where looks within shorter and shorter rests would find the change anew
    if control[at.BY_TIME] == 1.0 and not (at_change and size <= (1.0 + NEARLY) * clock[at.LOOKED_EVERY]):
        known = _ahead(f, w, tolerances, control, clock, known, t, size, last, q, v, a)
        clock[at.SUDDEN] = known
    size = min(size, representable_step(t, min(known, along) - t))
    is_short = size < SHORT * clock[at.H_LONG] or t < clock[at.T_START] + 2.0 * control[at.APART]
    if control[at.BY_TIME] == 1.0 and is_short and size < control[at.APART] and clock[at.COMPARED] < t:
        _keep_brief(f, w, tolerances, control, clock, t, size, last, q, v, a)
    return size

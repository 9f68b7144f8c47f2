"""Q_d by differences of C_q v + C_t along the motion, with a length that is checked and shortened where it must be.

Two central differences, over a length e and over 2 e, give the derivative to order 4, and their disagreement its error.
"""

import numpy as np

from twoloop.kernels.common import (
    DONE,
    GAMMA_ACCURACY,
    GAMMA_INACCURATE,
    GAMMA_REQUIRED,
    GAMMA_SCALE,
    GAMMA_SHARE,
    compiled,
    exact,
    inlined,
)
from twoloop.kernels.linalg import copy

LENGTH, SHORTEST = 2e-4, 1e-4  # see longest_difference
LEVELS = 12  # lengths tried by _choose_length, each a quarter of the one before
TRIGGER = 0.01  # of the required accuracy: a larger estimated error has another length chosen
LENGTHEN = 1e-9  # relative disagreement below which a longer length loses nothing and has less rounding


@exact
def representable(t, h):
    """The difference of t + h and t as floating-point numbers: times near 1e9 s have spacings of 2e-7 s."""
    return (t + h) - t


@inlined
def longest_difference(q, v):
    """Seconds over which to difference along the motion: LENGTH, or until q moves by LENGTH max|q|.

    But at least LENGTH SHORTEST.
    """
    size = 0.0
    speed = 0.0
    for j in range(v.size):
        size = max(size, abs(q[j]))
        speed = max(speed, abs(v[j]))
    size = max(size, SHORTEST * speed)  # where all coordinates pass through zero
    return LENGTH * size / speed if speed > size else LENGTH


@compiled
def _differences(f, w, t, q, v, e):
    """Q_d into w.Qd, by differences over e and 2 e; its largest entry and the largest disagreement of the two."""
    n_c = w.g.size
    w.Qd[:] = 0.0
    w.Qd_tried[0][:] = 0.0
    for k in range(4):
        shift = (-2.0, -1.0, 1.0, 2.0)[k] * e
        for j in range(q.size):
            w.x[j] = q[j] + shift * v[j]
        w.Cqx[:, :] = 0.0
        f.jacobian(t + shift, w.x, f.p, w.Cqx)
        w.g[:] = 0.0
        f.constraint_rate(t + shift, w.x, f.p, w.g)
        for i in range(n_c):
            for j in range(v.size):
                w.g[i] += w.Cqx[i, j] * v[j]
            if k == 0 or k == 3:
                w.Qd_tried[0][i] -= w.g[i] / (2.0 * shift)
            else:
                w.Qd[i] -= w.g[i] / (2.0 * shift)
    largest = 0.0
    disagreement = 0.0
    for i in range(n_c):
        disagreement = max(disagreement, abs(w.Qd[i] - w.Qd_tried[0][i]))
        w.Qd[i] = (4.0 * w.Qd[i] - w.Qd_tried[0][i]) / 3.0
        largest = max(largest, abs(w.Qd[i]))
        if not np.isfinite(w.Qd[i]):
            return np.nan, np.nan
    return largest, disagreement


@compiled
def _choose_length(f, w, t, q, v, longest):
    """Difference over ever shorter lengths until the result no longer changes, else keep the one that changed it least.

    DONE, or GAMMA_INACCURATE where it changed by more than is allowed.
    """
    best = np.inf
    share = 1.0
    for level in range(LEVELS):
        e = representable(t, share * longest)
        if e <= 0.0:
            break
        copy(w.Qd, w.Qd_tried[1])
        largest, _ = _differences(f, w, t, q, v, e)
        if np.isnan(largest):
            return DONE
        w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], largest)
        change = 0.0
        for i in range(w.Qd.size):
            change = max(change, abs(w.Qd[i] - w.Qd_tried[1, i]))
        if level > 0 and change < best:
            best = change
            w.notes[GAMMA_SHARE] = share
            if change <= TRIGGER * w.notes[GAMMA_REQUIRED] * w.notes[GAMMA_SCALE]:
                break
        share *= 0.25
    w.notes[GAMMA_ACCURACY] = best / w.notes[GAMMA_SCALE] if w.notes[GAMMA_SCALE] > 0.0 else 0.0
    _differences(f, w, t, q, v, representable(t, w.notes[GAMMA_SHARE] * longest))
    return DONE if w.notes[GAMMA_ACCURACY] <= w.notes[GAMMA_REQUIRED] else GAMMA_INACCURATE


@compiled
def gamma_by_differences(f, w, t, q, v):
    """Q_d = -d/de [C_q v + C_t](t + e, q + e v) at e = 0, into w.Qd, or GAMMA_INACCURATE where no length will do.

    Errors are judged relative to the largest entry that Q_d has had in this run. The length is a share of
    longest_difference, found by trial where the estimate asks for it: a drive of kilohertz needs a short one.
    """
    longest = longest_difference(q, v)
    e = representable(t, w.notes[GAMMA_SHARE] * longest)
    if e > 0.0:
        largest, disagreement = _differences(f, w, t, q, v, e)
        scale = w.notes[GAMMA_SCALE]
        if np.isnan(largest) or disagreement == 0.0 or scale == 0.0:
            return DONE  # what is not finite is found where it is used; without a scale nothing can be judged
        w.notes[GAMMA_SCALE] = max(scale, largest)
        if disagreement < LENGTHEN * scale:
            w.notes[GAMMA_SHARE] = min(1.0, 2.0 * w.notes[GAMMA_SHARE])
        # of sin(x), say, the error is x^4 / 30 where the disagreement is x^2 / 2
        if disagreement * disagreement <= 7.0 * TRIGGER * w.notes[GAMMA_REQUIRED] * w.notes[GAMMA_SCALE] ** 2:
            return DONE
    return _choose_length(f, w, t, q, v, longest)

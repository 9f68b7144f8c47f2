"""Dependent positions as the integration formula predicts them, beside those that the constraints then give.

The difference is of the order of the step's error on one and the same assembly of the mechanism. On another assembly it
is not, however smooth the independent coordinates are, and a mechanism without any (every coordinate prescribed) has no
other error estimate. Equation numbers are those of Zhang & Zhang (2016), doi 10.1007/s11071-016-2682-8.
"""

from twoloop.kernels.common import ATOL, DEPARTURE, DONE, ESTIMATE, RTOL, compiled, inlined
from twoloop.kernels.inner import restore

SHARE_OF_MOTION = 0.1  # of the way that the coordinates go in the step: what a prediction may be off at any tolerance
FLOOR = 0.01  # of the tolerances, below which that does not matter


@inlined
def keep_predicted(w, q1):
    """Keep the dependent positions of q1 before the constraints change them."""
    for k in range(w.dependent.size):
        w.predicted[k] = q1[w.dependent[k]]


@compiled
def departure(w, tolerances, h, q, v, q1):
    """Largest distance of the kept prediction from q1, over the tolerances, or over SHARE_OF_MOTION of the motion."""
    if tolerances[ESTIMATE] == 0.0:
        return 0.0
    motion = 0.0
    for m in range(q.size):
        motion = max(motion, h * abs(v[m]), abs(q1[m] - q[m]))
    largest = 0.0
    for k in range(w.dependent.size):
        m = w.dependent[k]
        distance = abs(w.predicted[k] - q1[m])
        scale = tolerances[ATOL + m] + tolerances[RTOL] * max(abs(q[m]), abs(q1[m]))
        largest = max(largest, distance / scale, distance / (SHARE_OF_MOTION * motion + FLOOR * scale))
    return largest


@compiled
def restore_predicted(f, w, tolerances, t, h, q, v, q1, v1, inner_tol):
    """Put the prediction (q1, v1) of a step of h from (q, v) on the constraints, as `restore` does.

    w.notes[DEPARTURE] becomes the departure where that is larger.
    """
    keep_predicted(w, q1)
    code = restore(f, w, t, q1, v1, inner_tol)
    if code == DONE:
        w.notes[DEPARTURE] = max(w.notes[DEPARTURE], departure(w, tolerances, h, q, v, q1))
    return code

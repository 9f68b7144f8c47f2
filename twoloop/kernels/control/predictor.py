"""Dependent positions as the integration formula predicts them, beside those that the constraints then give.

The difference is of the order of the step's error on one and the same assembly of the mechanism. On another assembly it
is not, however smooth the independent coordinates are, and a mechanism without any (every coordinate prescribed) has no
other error estimate. Where two assemblies come close to one another, a large step may end on the wrong one with a small
difference; it has then passed a zero of det C_qd, which a motion does only through a singular position. So a change of
this sign needs a prediction that is nearly exact, as short steps through a singular position have it.
"""

from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import merged
from twoloop.kernels.data.noted import ORIENTATION, ORIENTATION_NEW
from twoloop.kernels.data.tolerances import ESTIMATE, allowed
from twoloop.kernels.evaluation.inner_loop import restore
from twoloop.kernels.linalg.markowitz_lu import sign_of

SHARE_OF_MOTION = 0.1  # of the way that the coordinates go in the step: what a prediction may be off at any tolerance
SHARE_THROUGH_ZERO = 1e-6  # ... and where the sign of det C_qd changes
LEAST = 1e-300  # in place of a scale of zero, so that a distance of zero needs no branch
FLOOR = 0.01  # of the tolerances, below which SHARE_OF_MOTION does not matter


@merged
def keep_predicted(w, q1):
    """Keep the dependent positions of q1 before the constraints change them."""
    for k in range(w.dependent.size):
        w.predicted[k] = q1[w.dependent[k]]


@merged
def departure(w, tolerances, h, q, v, q1):
    """Largest distance of the kept prediction from q1, over the tolerances or over a share of the motion.

    Needs the factors of C_qd at q1, as they stand after the inner loop. Fixed steps test nothing.
    """
    if tolerances[ESTIMATE] == 0.0:
        return 0.0
    w.notes[ORIENTATION_NEW] = sign_of(w.index, w.values)
    motion = 0.0
    for m in range(q.size):
        motion = max(motion, h * abs(v[m]), abs(q1[m] - q[m]))
    share, floor = SHARE_OF_MOTION, FLOOR
    if w.notes[ORIENTATION] * w.notes[ORIENTATION_NEW] < 0.0:
        share, floor = SHARE_THROUGH_ZERO, 0.0
    largest = 0.0
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed(tolerances, m, q[m], q1[m])
        largest = max(largest, abs(w.predicted[k] - q1[m]) / max(min(scale, share * motion + floor * scale), LEAST))
    return largest


@merged
def restore_predicted(f, w, tolerances, t, h, q, v, q1, v1, inner_tol):
    """Put the prediction (q1, v1) of a step of h from (q, v) on the constraints, as `restore` does; code, departure."""
    keep_predicted(w, q1)
    code = restore(f, w, t, q1, v1, inner_tol)
    return code, departure(w, tolerances, h, q, v, q1) if code == DONE else 0.0

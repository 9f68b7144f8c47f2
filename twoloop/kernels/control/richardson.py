"""Richardson's estimate: the difference of one step and two half steps is the error, and may improve the result."""

import numpy as np

from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.tolerances import ATOL, RTOL
from twoloop.kernels.evaluation.inner_loop import restore


@compiled
def _richardson_error(tolerances, largest, q, v, q_full, v_full, q1, v1):
    """Difference of one step and two half steps over (26), for positions and velocities, dependents too.

    Its largest component, or the root mean square (27).
    """
    rtol = tolerances[RTOL]
    total = 0.0
    top = 0.0
    for m in range(q.size):
        atol = tolerances[ATOL + m]
        in_q = (q_full[m] - q1[m]) / (atol + rtol * max(abs(q[m]), abs(q_full[m])))
        in_v = (v_full[m] - v1[m]) / (atol + rtol * max(abs(v[m]), abs(v_full[m])))
        total += in_q * in_q + in_v * in_v
        top = max(top, abs(in_q), abs(in_v))
    return top if largest else np.sqrt(total / (2 * q.size))


@compiled
def conclude(f, w, share, inner_tol, t, tolerances, q, v, q_full, v_full, q1, v1):
    """The error of the two half steps and, where a share is given, their extrapolation with the whole step."""
    error = _richardson_error(tolerances, share > 0.0, q, v, q_full, v_full, q1, v1)
    if not (share > 0.0 and error <= 1.0):
        return DONE, error
    for m in range(q.size):
        q1[m] += share * (q1[m] - q_full[m])
        v1[m] += share * (v1[m] - v_full[m])
    return restore(f, w, t, q1, v1, inner_tol), error

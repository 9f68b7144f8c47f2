"""The defect of a step: how far its own accelerations are from those that the equations give at the same states.

A step by a Taylor series knows of the forces what they are at its beginning, to all orders, and nothing of what comes
later: its length follows from the last terms alone. So the equations are evaluated where the step ends, and within it
at places that lie no further apart than tolerances[LOOK].
"""

import numpy as np

from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.tolerances import ATOL, RTOL

ROUNDING = 1e-13  # of the largest acceleration: a defect that is rounding


@compiled
def excess(tolerances, h, order, found, a, q, v):
    """The defect |found - a| of a step h over what the tolerances allow; infinite where it is not finite.

    The defect of a series of this order grows with the last power of the time: its integral is h / order times what it
    is at the end.
    """
    rtol, share, largest, worst = tolerances[RTOL], h / order, 0.0, 0.0
    for j in range(a.size):
        largest = max(largest, abs(a[j]))
    for j in range(a.size):
        defect = abs(found[j] - a[j])
        if not np.isfinite(defect):
            return np.inf
        defect = (defect - ROUNDING * largest) * share
        atol = tolerances[ATOL + j]
        worst = max(worst, defect / (atol + rtol * abs(v[j])), defect * share / (atol + rtol * abs(q[j])))
    return worst

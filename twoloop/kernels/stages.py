"""What implicit Runge-Kutta steps share, whatever their outer loop: the parameter block, the prediction of stages."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.common import ATOL, RTOL, compiled, inlined

FARTHEST = 3.0  # largest step ratio over which the old stage polynomial is extrapolated

# places in `options`: scalars, then A (s, s), A A (s, s), b (s), b A (s), c (s)
# EXTRAPOLATION: 1 / (2^order - 1), 0 without, EMBEDDED for an estimate without half steps; DECAY: see end_error
STAGES, INNER_TOL, OUTER_TOL, EXTRAPOLATION, OUTER_TEST, DECAY, N_SCALARS = range(7)
EMBEDDED = -1.0


def options_array(
    A: ArrayLike,
    b: ArrayLike,
    c: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    extrapolation: float,
    outer_test: float = 1.0,
    decay: float = 0.0,
) -> NDArray[np.float64]:
    """The parameter block that `tableau_of` reads; `outer_test` 1: (32) over dependent coordinates too."""
    A, b, c = np.asarray(A), np.asarray(b), np.asarray(c)
    scalars = np.array([float(len(b)), inner_tol, outer_tol, extrapolation, outer_test, decay])
    return np.concatenate([scalars, A.ravel(), (A @ A).ravel(), b, b @ A, c])


@inlined
def tableau_of(options):
    """Views of the parameter block: s, A, A A, b, b A, c."""
    s = int(options[STAGES])
    o = N_SCALARS
    A = options[o : o + s * s].reshape((s, s))
    A2 = options[o + s * s : o + 2 * s * s].reshape((s, s))
    o += 2 * s * s
    return s, A, A2, options[o : o + s], options[o + s : o + 2 * s], options[o + 2 * s : o + 3 * s]


@compiled
def interpolate(c, theta, A_stage, weights, a):
    """The polynomial through (c_j, A_stage_j) at theta."""
    s = c.size
    for j in range(s):
        product = 1.0
        for k in range(s):
            if k != j:
                product *= (theta - c[k]) / (c[j] - c[k])
        weights[j] = product
    for m in range(a.size):
        total = 0.0
        for j in range(s):
            total += weights[j] * A_stage[j, m]
        a[m] = total


@compiled
def end_error(tolerances, decay, c, h, state, new_state, A_stage, weights, scratch):
    """Error of a step as the stage polynomial of the accelerations shows it at the ends of the step, over (26).

    It misses the accelerations there by d, a term of order h^s, where those of the stages differ by w: the terms fall
    by (d / w)^(1 / (s - 1)) from order to order if they fall evenly, and that of the method's own order makes the error
    h d (d / w)^decay, decay = (order - s) / (s - 1). Where they do not fall, as at a jump of the force, even one
    between the end and the stage beside it, d is not less than w, and the error h d: steps shrink until it does not
    matter.
    """
    s, n = A_stage.shape
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
    rtol = tolerances[RTOL]
    top = 0.0
    for end in range(2):
        interpolate(c, float(end), A_stage, weights, scratch)
        for m in range(n):
            d = abs(scratch[m] - (a1[m] if end == 1 else a[m]))
            low, high = A_stage[0, m], A_stage[0, m]
            for j in range(1, s):
                low, high = min(low, A_stage[j, m]), max(high, A_stage[j, m])
            if d < high - low:
                d *= (d / (high - low)) ** decay
            in_v = h * d / (tolerances[ATOL + m] + rtol * max(abs(v[m]), abs(v1[m])))
            in_q = h * h * d / (tolerances[ATOL + m] + rtol * max(abs(q[m]), abs(q1[m])))
            top = max(top, in_v, in_q)
    return top

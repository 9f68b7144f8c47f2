"""What implicit Runge-Kutta steps share, whatever their outer loop: the parameter block, the prediction of stages."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.common import compiled, inlined

FARTHEST = 3.0  # largest step ratio over which the old stage polynomial is extrapolated

# places in `options`: scalars, then A (s, s), A A (s, s), b (s), b A (s), c (s)
STAGES, INNER_TOL, OUTER_TOL, EXTRAPOLATION, OUTER_TEST, N_SCALARS = range(6)


def options_array(
    A: ArrayLike,
    b: ArrayLike,
    c: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    extrapolation: float,
    outer_test: float = 1.0,
) -> NDArray[np.float64]:
    """The parameter block that `tableau_of` reads; `outer_test` 1: (32) over dependent coordinates too."""
    A, b, c = np.asarray(A), np.asarray(b), np.asarray(c)
    scalars = np.array([float(len(b)), inner_tol, outer_tol, extrapolation, outer_test])
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

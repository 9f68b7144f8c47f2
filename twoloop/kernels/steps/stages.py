"""Common parts of all implicit Runge-Kutta steps: parameter block, prediction of stages, and error at jumps."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.data.common import allowed, compiled, inlined, merged

FARTHEST = 3.0  # largest step ratio over which the old stage polynomial is extrapolated
# weight of `end_error` beside Richardson's estimate, because it serves jumps between ends and stages
END_ERROR_WEIGHT = 0.01

# places in `options`: scalars, then A (s, s), A A (s, s), b (s), b A (s), c (s) and two rows (s) for `end_error`
# EXTRAPOLATION: 1 / (2^order - 1), or 0 without; POWER: order - 1
STAGES, INNER_TOL, OUTER_TOL, EXTRAPOLATION, OUTER_TEST, POWER, N_SCALARS = range(7)


def options_array(
    A: ArrayLike,
    b: ArrayLike,
    c: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    extrapolation: float,
    outer_test: float = 1.0,
    power: float = 0.0,
) -> NDArray[np.float64]:
    """Return the parameter block that `tableau_of` reads; `outer_test` 1: (32) over dependent coordinates too."""
    A, b, c = np.asarray(A), np.asarray(b), np.asarray(c)
    scalars = np.array([float(len(b)), inner_tol, outer_tol, extrapolation, outer_test, power])
    rows = (b, b @ A, c, _lagrange(c, 0.0), _lagrange(c, 1.0))
    return np.concatenate([scalars, A.ravel(), (A @ A).ravel(), *rows])


def _lagrange(nodes: NDArray[np.float64], x: float) -> NDArray[np.float64]:
    """Return the weights of values at distinct nodes in their interpolating polynomial at x."""
    factors = (x - nodes[None, :]) / (nodes[:, None] - nodes[None, :] + np.eye(len(nodes)))
    np.fill_diagonal(factors, 1.0)
    return np.asarray(factors.prod(axis=1))


@inlined
def tableau_of(options):
    """Return views of the parameter block: s, A, A A, b, b A, c."""
    s = int(options[STAGES])
    o = N_SCALARS
    A = options[o : o + s * s].reshape((s, s))
    A2 = options[o + s * s : o + 2 * s * s].reshape((s, s))
    o += 2 * s * s
    return s, A, A2, options[o : o + s], options[o + s : o + 2 * s], options[o + 2 * s : o + 3 * s]


@merged
def middle_node(c):
    """Return the node nearest to the middle."""
    nearest = 0
    for j in range(c.size):
        if abs(c[j] - 0.5) < abs(c[nearest] - 0.5):
            nearest = j
    return c[nearest]


@compiled
def interpolate(c, theta, A_stage, weights, a):
    """Evaluate the polynomial through (c_j, A_stage_j) at theta."""
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
def end_error(tolerances, options, h, state, new_state, A_stage):
    """Estimate the error of a step from the polynomial through the stage accelerations, over (26).

    The accelerations of the stages differ by w, a term of order h. The polynomial through them misses that at an end of
    the step by a term of order h^s. If terms fall evenly, by a factor f an order, that of the method's own order makes
    the error h w f^(order - 1). Where terms do not fall, as at a jump of the force, even one between an end and the
    stage beside it, the error is h w: steps shrink until it does not matter. It is no estimate to rely on alone: the
    one term may pass through zero, and on pendulums errors of single steps then were 100 tolerances.
    """
    s, n = A_stage.shape
    place = N_SCALARS + 2 * s * s + 3 * s
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n]
    top = 0.0
    for m in range(n):
        low, high = A_stage[0, m], A_stage[0, m]
        start, end = -a[m], -a1[m]
        for j in range(s):
            value = A_stage[j, m]
            low, high = min(low, value), max(high, value)
            start += options[place + j] * value
            end += options[place + s + j] * value
        width, missed = high - low, max(abs(start), abs(end))
        error = h * max(width, missed)
        if missed < width:
            error *= (missed / width) ** (options[POWER] / (s - 1.0))
        scale = allowed(tolerances, m, v[m], v1[m])
        top = max(top, error / scale)
        scale = allowed(tolerances, m, q[m], q1[m])
        top = max(top, h * error / scale)
    return top

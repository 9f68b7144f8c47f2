"""Steps across a position where C_q loses rank, such as a parallelogram with its bars in line.

Near such a position no partition determines the dependents well, and loops on independent coordinates do not converge,
nor do those that leave stages off the constraints, though the motion is smooth. A step by collocation at Gauss nodes
goes across. Its stages are moved to the nearest positions that the constraints allow: there accelerations are those of
the motion, and iteration converges as it does elsewhere. The state at its beginning, which may be near the position,
enters by q and v alone. Its end is put on the constraints with a partition of its own.
"""

import numpy as np

from twoloop.kernels.control.controller import nothing_to_settle
from twoloop.kernels.control.predictor import keep_predicted
from twoloop.kernels.data.codes import DONE, OUTER_DIVERGED, SINGULAR
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, compiled, kernel
from twoloop.kernels.data.counters import N_OUTER
from twoloop.kernels.data.noted import ORIENTATION, ORIENTATION_NEW, PIVOT
from twoloop.kernels.data.tolerances import ATOL, ESTIMATE, RTOL, allowed
from twoloop.kernels.evaluation.inner_loop import evaluate_state, project, renew_partition
from twoloop.kernels.linalg.dense import copy

# places in `options`, then A, A A, Legendre coefficients and interpolation from the other nodes (S, S each); b, b A, c
INNER_TOL, THETA, N_SCALARS = range(3)
S = 8  # nodes
LEFT = 0.01  # of the tolerances: what iteration may leave ...
STAGNANT, NOISE = 0.5, 0.3  # ... or NOISE of them, where changes fall no further
MOST, FEW = 40, 8  # sweeps; and those after which a node is left out
ORDER, SHARE = 12.0, 0.5  # of the estimate; and what it counts
ROUNDING = 1e-13  # relative: what a step without an estimate is iterated to
NEARER = 0.5  # of the smallest pivot at the start of a step, which there must be at its end
LEAST = 1e-300  # in place of a coefficient of zero


def options_array(A, b, c, inner_tol, theta):
    """The parameter block, for a tableau of Gauss."""
    degrees = np.arange(S)
    legendre = np.polynomial.legendre.legvander(2.0 * c - 1.0, S - 1).T * b * (2 * degrees + 1)[:, None]
    gaps = c[:, None] - c + np.eye(S)
    barycentric = 1.0 / gaps.prod(axis=1)
    without = -barycentric / barycentric[:, None] * (1.0 - np.eye(S))
    tables = [A, A @ A, legendre, without, b, b @ A, c]
    return np.concatenate([[inner_tol, theta], *map(np.ravel, tables)])


def memory_size(n):
    """Length of `memory`."""
    return (S + 3) * n


@compiled
def _combined(weights, a, total):
    total[:] = 0.0
    for k in range(S):
        for m in range(total.size):
            total[m] += weights[k] * a[k, m]


@compiled
def _weight(tolerances, m, n, h, state):
    """1 / what an error of velocity m may be."""
    q, v = abs(state[m]), abs(state[n + m])
    if tolerances[ESTIMATE] == 0.0:
        return 1.0 / (ROUNDING * (1.0 + v))
    atol, rtol = tolerances[ATOL + m], tolerances[RTOL]
    of_v = atol + rtol * max(v, 0.5 * h * abs(state[2 * n + m]))
    return 1.0 / max(min(of_v, (atol + rtol * max(q, 0.5 * h * v)) / h), LEAST)


@compiled
def _error(tolerances, h, state, legendre, a, every_node):
    """As that of collocation_code.py: from how fast the coefficients of a in Legendre polynomials fall."""
    n, largest = a.shape[1], 0.0
    for m in range(n):
        first = before = top = 0.0
        for k in range(2, S):
            value = 0.0
            for j in range(S):
                value += legendre[k, j] * a[j, m]
            if k < 4:
                first = max(first, abs(value))
            elif k < 6:
                before = max(before, abs(value))
            else:
                top = max(top, abs(value))
        before = max(before, top, LEAST)
        falls, far = top / before, top / max(first, before)
        if every_node:
            falls *= np.sqrt(falls)
        largest = max(largest, top * max(falls, far) * h * _weight(tolerances, m, n, h, state))
    return SHARE * largest


@kernel(ATTEMPT)
def bridging_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt."""
    n = w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    a1, lam1 = new_state[2 * n : 3 * n], new_state[3 * n :]
    A, AA, legendre, without = options[N_SCALARS : N_SCALARS + 4 * S * S].reshape((4, S, S))
    b, bA, c = options[N_SCALARS + 4 * S * S :].reshape((3, S))
    a, rest = memory[: S * n].reshape((S, n)), memory[S * n :].reshape((3, n))
    q_stage, v_stage, a_stage = rest[0], rest[1], rest[2]
    estimated = tolerances[ESTIMATE] == 1.0
    w.counters[N_OUTER] += 1
    code = renew_partition(f, w, t, q)
    pivot = w.notes[PIVOT] if code == DONE else 0.0
    for j in range(S):
        copy(state[2 * n : 3 * n], a[j])
    before, ended, left_out = np.inf, False, -1
    for sweep in range(MOST):
        change, nearest, least = 0.0, -1, np.inf
        for j in range(S):
            if j == left_out:
                _combined(without[j], a, a_stage)
                copy(a_stage, a[j])
                continue
            time = t + c[j] * h
            _combined(A[j], a, v_stage)
            _combined(AA[j], a, q_stage)
            for m in range(n):
                q_stage[m] = q[m] + h * (c[j] * v[m] + h * q_stage[m])
                v_stage[m] = v[m] + h * v_stage[m]
            code = renew_partition(f, w, time, q_stage)
            if w.notes[PIVOT] < least:
                nearest, least = j, w.notes[PIVOT]
            if code == DONE:
                code = project(f, w, time, q_stage, v_stage, options[THETA], a_stage, w.lam)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
            for m in range(n):
                change = max(change, h * abs(a_stage[m] - a[j, m]) * _weight(tolerances, m, n, h, state))
            copy(a_stage, a[j])
            if sweep == 0:  # those that follow are extrapolated
                for k in range(j + 1, S):
                    for m in range(n):
                        a[k, m] = a[j, m]
                        if j > 0:
                            a[k, m] += (a[j, m] - a[j - 1, m]) * (c[k] - c[j]) / (c[j] - c[j - 1])
        if not np.isfinite(change):
            return Attempt(OUTER_DIVERGED, np.inf, 0.0)
        if change <= LEFT or (sweep > 2 and STAGNANT * before <= change <= NOISE):
            ended = True
            break
        if sweep == FEW:  # accelerations nearest to the singular position are rounding: they follow from the others
            left_out = nearest
        before = change
    if not ended and estimated:
        return Attempt(OUTER_DIVERGED, np.inf, 0.0)
    error = 0.0
    if estimated:
        error = _error(tolerances, h, state, legendre, a, left_out < 0)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
    _combined(b, a, v1)
    _combined(bA, a, q1)
    for m in range(n):
        q1[m] = q[m] + h * (v[m] + h * q1[m])
        v1[m] = v[m] + h * v1[m]
    code = renew_partition(f, w, t + h, q1)
    if code == DONE and w.notes[PIVOT] < NEARER * pivot:
        code = SINGULAR  # from there it would be harder still
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    keep_predicted(w, q1)
    w.notes[ORIENTATION_NEW] = w.notes[ORIENTATION]
    code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed(tolerances, m, q[m], q1[m])
        error = max(error, abs(w.predicted[k] - q1[m]) / scale * tolerances[ESTIMATE])
    return Attempt(code, error, 0.0)


BRIDGING = Step(bridging_step, nothing_to_settle)

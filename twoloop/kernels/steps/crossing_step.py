"""Step across a singular position, where C_q loses rank, such as a parallelogram with its bars in line.

Near such a position no partition determines the dependent coordinates well. Loops on independent coordinates do not
converge there, nor does iteration with stages off the constraints, though the motion is smooth. This step is a
collocation at Gauss nodes whose stages are projected onto the constraints: there the accelerations are those of the
motion, and the fixed-point iteration converges as it does elsewhere.

- Of the state at the beginning only q and v enter the result: its accelerations may be rounding.
- The end is put on the constraints with a partition of its own.
- Stages are projected by the generated code of the mechanism. A partition is chosen at a stage only where there is no
  such code, or where its pivots are too small.
"""

import numpy as np

from twoloop.kernels.control.step_size import commit_nothing, store_prediction
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, allowed, compiled, kernel, merged
from twoloop.kernels.data.indices import (
    ATOL,
    BY_GENERAL,
    DONE,
    ESTIMATE,
    GAP,
    N_OUTER,
    ORIENTATION,
    ORIENTATION_NEW,
    OUTER_DIVERGED,
    PIVOT,
    RTOL,
    SINGULAR,
    STRAIGHT,
)
from twoloop.kernels.evaluation.inner_loop import evaluate_state, project, renew_partition
from twoloop.kernels.linalg.dense import copy

# places in `options`, then A, A A, Legendre coefficients and interpolation from the other nodes (S, S each); b, b A, c
INNER_TOL, THETA, N_SCALARS = range(3)
S = 8  # number of nodes
LEFT = 0.01  # relative to the tolerances: change at which the iteration ends ...
STAGNANT, NOISE = 0.5, 0.3  # ... or NOISE of them, if a change is at least STAGNANT times the one before
MOST, FEW = 40, 8  # largest number of sweeps; and number of sweeps after which a node is left out
# longest part of a step without a node, relative to the step: with all nodes, and with one left out
UNSEEN, UNSEEN_WITHOUT = 0.1834, 0.3545
ORDER, SHARE = 12.0, 0.5  # order of the estimated error; and factor on it
ROUNDING = 1e-13  # relative: accuracy of the iteration in steps without an estimate
NEARER = 0.5  # smallest ratio of the pivots at the end and at the start of a step
LEAST = 1e-300  # replaces a coefficient of zero


def options_array(A, b, c, inner_tol, theta):
    """Return the parameter block for a Gauss tableau."""
    degrees = np.arange(S)
    legendre = np.polynomial.legendre.legvander(2.0 * c - 1.0, S - 1).T * b * (2 * degrees + 1)[:, None]
    gaps = c[:, None] - c + np.eye(S)
    barycentric = 1.0 / gaps.prod(axis=1)
    without = -barycentric / barycentric[:, None] * (1.0 - np.eye(S))
    tables = [A, A @ A, legendre, without, b, b @ A, c]
    return np.concatenate([[inner_tol, theta], *map(np.ravel, tables)])


def memory_size(n):
    """Return the length of `memory`."""
    return (S + 3) * n


@compiled
def _combined(weights, a, total):
    """Sum the accelerations at the nodes with these weights."""
    total[:] = 0.0
    for k in range(S):
        for m in range(total.size):
            total[m] += weights[k] * a[k, m]


@compiled
def _weight(tolerances, m, n, h, state):
    """Return the reciprocal of the allowed error of velocity m."""
    q, v = abs(state[m]), abs(state[n + m])
    if tolerances[ESTIMATE] == 0.0:
        return 1.0 / (ROUNDING * (1.0 + v))
    atol, rtol = tolerances[ATOL + m], tolerances[RTOL]
    of_v = atol + rtol * max(v, 0.5 * h * abs(state[2 * n + m]))
    return 1.0 / max(min(of_v, (atol + rtol * max(q, 0.5 * h * v)) / h), LEAST)


@compiled
def _error(tolerances, h, state, legendre, a, every_node):
    """Estimate the error as collocation_code.py does, from the decay of the Legendre coefficients of a."""
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
        decay, far = top / before, top / max(first, before)
        if every_node:
            decay *= np.sqrt(decay)
        largest = max(largest, top * max(decay, far) * h * _weight(tolerances, m, n, h, state))
    return SHARE * largest


@merged
def _integrate(h, c, A, AA, a, q, v, q_end, v_end):
    """Set q_end and v_end to positions and velocities a time c h later, from integrals of the accelerations."""
    _combined(A, a, v_end)
    _combined(AA, a, q_end)
    for m in range(q.size):
        q_end[m] = q[m] + h * (c * v[m] + h * q_end[m])
        v_end[m] = v[m] + h * v_end[m]


@merged
def _choose_partition_at_end(f, w, t, q, pivot):
    """Choose the partition at the end of a step; return SINGULAR if the next step would begin nearer to the position.

    `pivot` is the smallest pivot at the beginning.
    """
    code = renew_partition(f, w, t, q)
    if code == DONE and w.notes[PIVOT] < NEARER * pivot:
        return SINGULAR
    return code


@kernel(ATTEMPT)
def crossing_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt one step."""
    n = w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    a1, lam1 = new_state[2 * n : 3 * n], new_state[3 * n :]
    A, AA, legendre, without = options[N_SCALARS : N_SCALARS + 4 * S * S].reshape((4, S, S))
    b, bA, c = options[N_SCALARS + 4 * S * S :].reshape((3, S))
    a, stage = memory[: S * n].reshape((S, n)), memory[S * n :].reshape((3, n))
    q_stage, v_stage, a_stage = stage[0], stage[1], stage[2]
    estimated, generated = tolerances[ESTIMATE] == 1.0, f.flags[STRAIGHT] == 1
    w.counters[N_OUTER] += 1
    code = renew_partition(f, w, t, q)
    pivot = w.notes[PIVOT] if code == DONE else 0.0
    for j in range(S):
        copy(state[2 * n : 3 * n], a[j])
    change_before, converged, left_out = np.inf, False, -1
    for sweep in range(MOST):
        change, nearest, least = 0.0, -1, np.inf
        for j in range(S):
            if j == left_out:
                _combined(without[j], a, a_stage)
                copy(a_stage, a[j])
                continue
            time = t + c[j] * h
            renews = not generated or sweep == FEW
            while True:
                _integrate(h, c[j], A[j], AA[j], a, q, v, q_stage, v_stage)
                code = DONE
                if renews:
                    code = renew_partition(f, w, time, q_stage)
                    if w.notes[PIVOT] < least:
                        nearest, least = j, w.notes[PIVOT]
                if code == DONE:
                    code = project(f, w, time, q_stage, v_stage, options[THETA], a_stage, w.lam)
                if renews or w.notes[BY_GENERAL] == 0.0:
                    break
                # pivots of the generated code are too small: the general code took over, with the partition of another
                # stage
                renews, generated = True, False
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
            for m in range(n):
                change = max(change, h * abs(a_stage[m] - a[j, m]) * _weight(tolerances, m, n, h, state))
            copy(a_stage, a[j])
            if sweep == 0:  # extrapolate the accelerations at the following nodes
                for k in range(j + 1, S):
                    for m in range(n):
                        a[k, m] = a[j, m]
                        if j > 0:
                            a[k, m] += (a[j, m] - a[j - 1, m]) * (c[k] - c[j]) / (c[j] - c[j - 1])
        if not np.isfinite(change):
            return Attempt(OUTER_DIVERGED, np.inf, 0.0)
        if change <= LEFT or (sweep > 2 and STAGNANT * change_before <= change <= NOISE):
            converged = True
            break
        # most rejected steps are rejected for their end, which is known well enough by now
        if sweep == 0 and estimated:
            _integrate(h, 1.0, b, bA, a, q, v, q1, v1)
            code = _choose_partition_at_end(f, w, t + h, q1, pivot)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
        # accelerations nearest to the singular position are rounding: interpolate them from the others
        if sweep == FEW:
            if estimated and UNSEEN_WITHOUT * h > tolerances[GAP] * (1.0 + ROUNDING):
                return Attempt(OUTER_DIVERGED, np.inf, 0.0)
            left_out = nearest
        change_before = change
    if not converged and estimated:
        return Attempt(OUTER_DIVERGED, np.inf, 0.0)
    error = 0.0
    if estimated:
        error = _error(tolerances, h, state, legendre, a, left_out < 0)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
    _integrate(h, 1.0, b, bA, a, q, v, q1, v1)
    code = _choose_partition_at_end(f, w, t + h, q1, pivot)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    store_prediction(w, q1)
    w.notes[ORIENTATION_NEW] = w.notes[ORIENTATION]
    code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed(tolerances, m, q[m], q1[m])
        error = max(error, abs(w.predicted[k] - q1[m]) / scale * tolerances[ESTIMATE])
    return Attempt(code, error, 0.0)


CROSSING = Step(crossing_step, commit_nothing)

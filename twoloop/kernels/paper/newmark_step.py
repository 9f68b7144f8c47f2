"""Attempt the paper's Newmark steps, by fixed-point iteration on accelerations (`f`: the kit, `w`: the workspace)."""

import numpy as np

from twoloop.kernels.control.step_size import commit_nothing, prediction_error
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, compiled, kernel, merged, typical_size
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, GAP, OUTER_DIVERGED, RTOL
from twoloop.kernels.evaluation.inner_loop import evaluate_state, rounding_floor
from twoloop.kernels.linalg.dense import copy

MAX_ITERATIONS = 60  # number of fixed-point iterations after which a step has failed
GROWTH_AFTER_REST = 2.0  # motion begins if a step increases the largest |coordinate| so far by more than this factor
TINY = 1e-300  # added to the allowed error of a step, which may be 0 for a mechanism at rest at the origin

# indices in `memory`: largest |coordinate|, |velocity| and |acceleration| so far. Scratch (n_q) follows
SIZE, SPEED, ACCELERATION, N_MEMORY_SCALARS = range(4)

# indices in `options`. BETA, GAMMA: parameters of Newmark's method. INNER_TOL, OUTER_TOL: tolerances of the loops.
# ERROR_TOL: tolerance for the norm by which the paper measures the error estimate; 0: atol and rtol apply instead
BETA, GAMMA, INNER_TOL, OUTER_TOL, ERROR_TOL, N_OPTIONS = range(6)


@merged
def _largest_abs(x, lower_bound):
    for m in range(x.size):
        lower_bound = max(lower_bound, abs(x[m]))
    return lower_bound


@compiled
def _motion_rate(memory, gap, q, v, a, q1, v1, a1):
    """Return the rate (1/s) of the motion: the reciprocal of the time in which the largest |coordinate| can double.

    The time follows from the largest |coordinate|, |velocity| and |acceleration| so far: at a single time, all
    coordinates may be near zero, depending on the origin. If the largest |coordinate| arises mainly in this step, as it
    does after rest at the origin, the time is at least `gap` (s), the longest allowed time between two evaluations.
    """
    memory[SIZE] = _largest_abs(q, memory[SIZE])
    memory[SPEED] = _largest_abs(v, memory[SPEED])
    memory[ACCELERATION] = _largest_abs(a, memory[ACCELERATION])
    size = _largest_abs(q1, memory[SIZE])
    if size == 0.0:
        return 0.0
    rate = max(_largest_abs(v1, memory[SPEED]) / size, np.sqrt(_largest_abs(a1, memory[ACCELERATION]) / size))
    return min(rate, 1.0 / gap) if size > GROWTH_AFTER_REST * memory[SIZE] else rate


@compiled
def _estimated_error(options, tolerances, rate, h, q, v, a, a1):
    """Return the estimated error of a step, in units of the tolerances; `rate` (1/s) is the result of `_motion_rate`.

    The leading local error of q for the parameter gamma = 1/2 is e = |beta - 1/6| h^2 |a1 - a|, with the accelerations
    a and a1 at both ends. The result is the largest component of (e / h) / (rate atol + rtol |v|). The error per unit
    time, e / h, is of order h^2, as is the run's error. If ERROR_TOL > 0, return |e|_2 / ERROR_TOL (paper: err_out).
    """
    factor = abs(options[BETA] - 1.0 / 6.0) * h
    total = 0.0
    largest = 0.0
    for m in range(q.size):
        e = factor * abs(a1[m] - a[m])
        total += (h * e) ** 2
        largest = max(largest, e / (rate * tolerances[ATOL + m] + tolerances[RTOL] * abs(v[m]) + TINY))
    return np.sqrt(total) / options[ERROR_TOL] if options[ERROR_TOL] > 0.0 else largest


@kernel(ATTEMPT)
def newmark_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step of size h: iterate Newmark's formulas, eq. (12) of the paper, until the accelerations converge."""
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    beta, gamma = options[BETA], options[GAMMA]
    a_new = memory[N_MEMORY_SCALARS : N_MEMORY_SCALARS + n]
    for m in range(n):
        a1[m] = a[m]
        q1[m] = q[m] + h * v[m] + 0.5 * h * h * a[m]  # for dependent coordinates, this is a first guess
    size_q, size_v = typical_size(tolerances, q), typical_size(tolerances, v)
    last_change = np.inf
    for _ in range(MAX_ITERATIONS):
        w.n_outer += 1
        for m in w.independent:
            q1[m] = q[m] + h * v[m] + h * h * ((0.5 - beta) * a[m] + beta * a1[m])
            v1[m] = v[m] + h * ((1.0 - gamma) * a[m] + gamma * a1[m])
        code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a_new, lam1)
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        change, rounded = 0.0, 0.0
        for m in w.independent:
            difference = h * abs(a_new[m] - a1[m])
            change_q, change_v = beta * h * difference, gamma * difference
            change = max(change, change_v / max(abs(v1[m]), size_v), change_q / max(abs(q1[m]), size_q))
            rounded = max(rounded, change_v / max(abs(v1[m]), 1.0), change_q / max(abs(q1[m]), 1.0))
        copy(a_new, a1)
        if change <= options[OUTER_TOL] or (change >= last_change and rounded <= rounding_floor(q)):
            error = 0.0
            if tolerances[ESTIMATE] == 1.0:
                rate = _motion_rate(memory, tolerances[GAP], q, v, a, q1, v1, a1)
                error = _estimated_error(options, tolerances, rate, h, q, v, a, a1)
                if options[ERROR_TOL] == 0.0:  # if it is > 0, the paper's estimate is used, without `prediction_error`
                    for k in range(w.dependent.size):
                        m = w.dependent[k]
                        w.predicted[k] = q[m] + h * v[m] + h * h * ((0.5 - beta) * a[m] + beta * a1[m])
                    error = max(error, prediction_error(w, tolerances, h, q, v, q1))
            return Attempt(DONE, error, 0.0)
        if not change <= last_change:
            break
        last_change = change
    return Attempt(OUTER_DIVERGED, np.inf, 0.0)


NEWMARK = Step(newmark_step, commit_nothing)

"""Attempt steps by backward differentiation formulas of orders 1 to 5, with a fixed-point outer loop.

The formulas apply to the independent positions and velocities (q_i, v_i). The history is a table of modified divided
differences (Krogh) of all coordinates and velocities, so that a new partition needs no conversion. It is scaled to the
size of each step, as in DASSL and IDA (fixed leading coefficient). `f` is the kit, `w` the workspace.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.control.step_size import prediction_error
from twoloop.kernels.data.common import ATTEMPT, COMMIT, Attempt, Step, compiled, inlined, kernel, merged
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, OUTER_DIVERGED, RTOL
from twoloop.kernels.evaluation.inner_loop import accelerations, evaluate_state, rounding_floor
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.paper.iterations import iterate_accelerations
from twoloop.kernels.steps.stages import options_array as gauss_options

MAX_ORDER = 5
N_DIFFERENCES = MAX_ORDER + 2  # differences of orders 0 to MAX_ORDER + 1
STARTER_STAGES = 3  # number of stages of the Gauss steps at the beginning of a run with fixed step size
MAX_ITERATIONS = 60  # number of fixed-point iterations after which a step has failed
SAFETY = 0.9  # safety factor on sizes of repeated steps; after an accepted step, (next size) / (size) is at least this
MIN_STEP_FACTOR = 0.2  # smallest (next size) / (size) after rejected steps, or if predicted positions are inaccurate
ERROR_FACTOR = 10.0  # factor on the error estimate, because the errors of many short steps add up
STEP_SIZE_FACTOR = 6.0  # factor on error estimates for the next step size, so that few steps are rejected (as in VODE)
ORDER_FACTOR = 1.4  # factor on the error estimates of the next lower and higher order, so that the order changes rarely
MIN_INCREASE = 1.2  # the step size is kept if it could grow by less than this factor
MAX_INCREASE = 2.0  # largest ratio of successive step sizes

# indices in `options`: largest order, tolerances of inner and outer loop. Numbers for `_gauss_step` follow
HIGHEST, INNER_TOL, OUTER_TOL, N_OPTION_SCALARS = range(4)
# indices of the scalars in `memory`; the arrays of _coefficient_row and _history_views follow
(
    HAS_TRIAL,  # 1: the attempt has given a step, which is not accepted or rejected yet; else 0
    ORDER,  # order of the next attempt
    DEPTH,  # order of the highest difference in the history
    AGE,  # number of accepted steps since the last change of order or the last rejected step
    NEXT_ORDER,  # value of ORDER after the attempted step
    NEXT_DEPTH,  # value of DEPTH after the attempted step, if it is accepted
    N_MEMORY_SCALARS,
) = range(7)
# indices of rows in `memory`. SPANS: times (s) from earlier states of the history to the last one. NEW_SPANS: times (s)
# from these states to the end of the step. ERROR_CONSTANTS: for each order k, error / (difference of order k + 1)
SPANS, NEW_SPANS, ERROR_CONSTANTS, N_ROWS = range(4)


def options_array(max_order: int, inner_tol: float, outer_tol: float, starter: Any) -> NDArray[np.float64]:
    """Return the array `options` of bdf_step; `starter` is the Gauss tableau of STARTER_STAGES stages."""
    gauss = gauss_options(starter.A, starter.b, starter.c, inner_tol, outer_tol, 0.0)
    return np.concatenate([[float(max_order), inner_tol, outer_tol], gauss])


def memory_size(n_q: int) -> int:
    """Return the length of `memory` for n_q coordinates."""
    return N_MEMORY_SCALARS + N_ROWS * N_DIFFERENCES + (4 * N_DIFFERENCES + 4 + 3 * STARTER_STAGES) * n_q


@inlined
def _coefficient_row(memory, row):
    """Return a view (N_DIFFERENCES) of a row of coefficients in `memory`; `row` is its index, such as SPANS."""
    start = N_MEMORY_SCALARS + row * N_DIFFERENCES
    return memory[start : start + N_DIFFERENCES]


@inlined
def _history_views(memory, n):
    """Return views of `memory`: differences of the history, those of the attempt, a prediction, its rate, and scratch.

    The first two are tables (N_DIFFERENCES, 2 n): row k contains the differences of order k of (q, v). `prediction` is
    the predicted (q, v) at the end of the step, and `rate` its time derivative (2 n each).
    """
    begin = N_MEMORY_SCALARS + N_ROWS * N_DIFFERENCES
    size = N_DIFFERENCES * 2 * n
    differences = memory[begin : begin + size].reshape((N_DIFFERENCES, 2 * n))
    trial = memory[begin + size : begin + 2 * size].reshape((N_DIFFERENCES, 2 * n))
    begin += 2 * size
    prediction, rate = memory[begin : begin + 2 * n], memory[begin + 2 * n : begin + 4 * n]
    return differences, trial, prediction, rate, memory[begin + 4 * n :]


@kernel(COMMIT)
def commit_bdf(f, w, options, memory, tolerances, accepted):
    """Set the order of the next step; if the last step was accepted, the differences at its end become the history."""
    differences, trial, _, _, _ = _history_views(memory, w.Q.size)
    has_trial = memory[HAS_TRIAL]
    memory[HAS_TRIAL] = 0.0
    if has_trial == 0.0:
        return
    if not accepted:
        memory[ORDER] = memory[NEXT_ORDER]
        memory[AGE] = 0.0
        return
    for j in range(int(memory[NEXT_DEPTH]) + 1):
        copy(trial[j], differences[j])
    copy(_coefficient_row(memory, NEW_SPANS), _coefficient_row(memory, SPANS))
    memory[AGE] = memory[AGE] + 1.0 if memory[ORDER] == memory[NEXT_ORDER] else 0.0
    memory[ORDER] = memory[NEXT_ORDER]
    memory[DEPTH] = memory[NEXT_DEPTH]


@compiled
def _begin_history(memory, differences, state, h, order):
    """Start a history from `state` = [q, v, a, ...] for steps of size h (s), the first of which has `order` 0 or 1."""
    size = differences.shape[1]
    for m in range(size):
        differences[0, m] = state[m]
        differences[1, m] = h * state[size // 2 + m]
    _coefficient_row(memory, SPANS)[0] = h
    memory[ORDER] = order
    memory[DEPTH] = order


@compiled
def _predict_state(memory, differences, trial, h, prediction, rate):
    """Extrapolate the history to the end of a step of size h (s): store the `prediction` of (q, v), and its `rate`.

    These are the value and the time derivative of the polynomial of degree ORDER through the history. Also store the
    differences, scaled to the step size, in `trial`, and NEW_SPANS and ERROR_CONSTANTS in `memory`.
    """
    k, depth = int(memory[ORDER]), int(memory[DEPTH])
    spans, new_spans = _coefficient_row(memory, SPANS), _coefficient_row(memory, NEW_SPANS)
    constants = _coefficient_row(memory, ERROR_CONSTANTS)
    new_spans[0] = h
    for j in range(depth):
        new_spans[j + 1] = spans[j] + h
    constants[0] = 1.0
    copy(differences[0], trial[0])
    copy(differences[0], prediction)
    for m in range(rate.size):
        rate[m] = 0.0
    scale = 1.0
    rate_factor = 0.0
    for j in range(1, depth + 1):
        scale *= new_spans[j - 1] / spans[j - 1]
        rate_factor += 1.0 / new_spans[j - 1]
        constants[j] = constants[j - 1] * j * h / new_spans[j]
        for m in range(rate.size):
            trial[j, m] = scale * differences[j, m]
        if j <= k:
            for m in range(rate.size):
                prediction[m] += trial[j, m]
                rate[m] += rate_factor * trial[j, m]


@merged
def _corrector_coefficient(h, k):
    """Return the coefficient c = h / (1 + 1/2 + ... + 1/k) (in s) of the corrector of order k, see `_correct_state`."""
    harmonic_sum = 0.0
    for j in range(k):
        harmonic_sum += 1.0 / (j + 1.0)
    return h / harmonic_sum


@compiled
def _correct_state(f, w, options, t, c, prediction, rate, new_state, a_new):
    """Solve the corrector's equation y = prediction + c (y' - rate) at time t for y = (q_i, v_i); return a code.

    The outer loop iterates on the independent accelerations. On return, `new_state` is [q, v, a, lam], and satisfies
    the equations of motion and the constraints. c: `_corrector_coefficient`; rate: predicted y'; a_new: scratch.
    """
    n = w.Q.size
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    copy(prediction, new_state[: 2 * n])  # for dependent coordinates, this is a first guess
    copy(rate[n:], a1)
    last_change = np.inf
    for iteration in range(MAX_ITERATIONS):
        w.n_outer += 1
        for m in w.independent:
            v1[m] = prediction[n + m] + c * (a1[m] - rate[n + m])
            q1[m] = prediction[m] + c * (v1[m] - rate[m])
        code = evaluate_state(f, w, t, q1, v1, options[INNER_TOL], a_new, lam1)
        if code != DONE:
            return code
        change = 0.0
        for m in w.independent:
            difference = c * abs(a_new[m] - a1[m])
            change = max(change, difference / max(abs(v1[m]), 1.0))
            change = max(change, c * difference / max(abs(q1[m]), 1.0))
        copy(a_new, a1)
        # the first iteration only evaluates the prediction, which must not be accepted: extrapolation alone is unstable
        if iteration > 0 and (change <= options[OUTER_TOL] or (change >= last_change and change <= rounding_floor(q1))):
            for k in range(w.dependent.size):
                m = w.dependent[k]
                w.predicted[k] = prediction[m] + c * (prediction[n + m] + c * (a1[m] - rate[n + m]) - rate[m])
            return DONE
        if not change <= last_change:
            return OUTER_DIVERGED
        last_change = change
    return OUTER_DIVERGED


@compiled
def _difference_norm(tolerances, y, y1, d, sign, difference):
    """Return the largest |entry| of d + sign * difference in units of the tolerances; y, y1, d: see `_choose_order`."""
    n_q = d.size // 2
    largest = 0.0
    for m in range(d.size):
        scale = tolerances[ATOL + m % n_q] + tolerances[RTOL] * max(abs(y[m]), abs(y1[m]))
        largest = max(largest, abs(d[m] + sign * difference[m]) / scale)
    return largest


@compiled
def _choose_order(options, memory, tolerances, trial, y, y1, d):
    """Store the next order in NEXT_ORDER; return the step's error, in tolerances, and (next step size) / (step size).

    y, y1: (q, v) at both ends of the step. d: y1 minus its prediction. `trial`: its row k contains the differences of
    order k of (q, v) at past steps, scaled to this step size by `_predict_state`.
    """
    k, depth = int(memory[ORDER]), int(memory[DEPTH])
    spans, constants = _coefficient_row(memory, NEW_SPANS), _coefficient_row(memory, ERROR_CONSTANTS)
    norm = ERROR_FACTOR * _difference_norm(tolerances, y, y1, d, 0.0, d)
    # if steps are unequal, interpolation of the history causes a second error; as in DASSL, the larger error counts
    interpolation_error = spans[0] / spans[k]
    for j in range(k):
        interpolation_error += spans[0] / spans[j] - 1.0 / (j + 1.0)
    error = norm * max(spans[0] / spans[k], abs(interpolation_error))
    here = norm * constants[k]
    below, error_above = np.inf, np.inf
    if k > 1:
        below = ERROR_FACTOR * ORDER_FACTOR * constants[k - 1] * _difference_norm(tolerances, y, y1, d, 1.0, trial[k])
    if k < options[HIGHEST] and depth > k:
        error_above = (
            ERROR_FACTOR * ORDER_FACTOR * constants[k + 1] * _difference_norm(tolerances, y, y1, d, -1.0, trial[k + 1])
        )
    memory[NEXT_ORDER] = k
    if not error <= 1.0:
        if below < here:
            memory[NEXT_ORDER] = k - 1
        return error, max(SAFETY * error ** (-1.0 / (k + 1)), MIN_STEP_FACTOR)
    factor = (STEP_SIZE_FACTOR * here) ** (-1.0 / (k + 1))
    if memory[AGE] >= k:  # errors of other orders can be estimated after k + 1 steps of order k, this step included
        lower, higher = (STEP_SIZE_FACTOR * below) ** (-1.0 / k), (STEP_SIZE_FACTOR * error_above) ** (-1.0 / (k + 2))
        if lower > max(factor, higher):
            memory[NEXT_ORDER] = k - 1
        elif higher > factor:
            memory[NEXT_ORDER] = k + 1
        factor = max(factor, lower, higher)
        if 1.0 < factor < MIN_INCREASE:
            factor = 1.0
    else:
        factor = min(factor, 1.0)
    return error, min(max(factor, SAFETY), MAX_INCREASE)


@compiled
def _update_differences(memory, trial, y1, d):
    """Update the differences in `trial` from the beginning to the end y1 of a step; d: y1 minus its prediction."""
    k = int(memory[ORDER])
    memory[NEXT_DEPTH] = k + 1
    if memory[DEPTH] > k and k < MAX_ORDER:
        for m in range(d.size):
            trial[k + 2, m] = d[m] - trial[k + 1, m]
        memory[NEXT_DEPTH] = k + 2
    copy(d, trial[k + 1])
    for j in range(k, 0, -1):
        for m in range(d.size):
            trial[j, m] += trial[j + 1, m]
    copy(y1, trial[0])


@compiled
def _gauss_step(f, w, options, tolerances, t, h, state, new_state, scratch):
    """Compute one of the first steps, if the step size is fixed, by the Gauss method of order 6; return a code."""
    s, n = STARTER_STAGES, w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    own_options, no_rounding = options[N_OPTION_SCALARS:], scratch[:0].reshape((0, n))
    A_stage = scratch[: s * n].reshape((s, n))
    Q_stage = scratch[s * n : 2 * s * n].reshape((s, n))
    V_stage = scratch[2 * s * n : 3 * s * n].reshape((s, n))
    for j in range(s):
        copy(state[2 * n : 3 * n], A_stage[j])
    code, _ = iterate_accelerations(
        f, w, own_options, tolerances, t, h, q, v, A_stage, Q_stage, V_stage, q1, v1, no_rounding
    )
    if code == DONE:
        code = accelerations(f, w, t + h, q1, v1, new_state[2 * n : 3 * n], new_state[3 * n :])
    return code


@kernel(ATTEMPT)
def bdf_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step: predict from the history, correct, and choose the order and the size of the next step.

    If the step size is fixed, the first options[HIGHEST] steps are Gauss steps; then the order is options[HIGHEST].
    """
    n = w.Q.size
    differences, trial, prediction, rate, scratch = _history_views(memory, n)
    has_fixed_step = tolerances[ESTIMATE] == 0.0
    if memory[DEPTH] == 0.0:
        _begin_history(memory, differences, state, h, 0.0 if has_fixed_step else 1.0)
    _predict_state(memory, differences, trial, h, prediction, rate)
    k = int(memory[ORDER])
    if has_fixed_step and k < options[HIGHEST]:
        code = _gauss_step(f, w, options, tolerances, t, h, state, new_state, scratch)
    else:
        code = _correct_state(
            f, w, options, t + h, _corrector_coefficient(h, k), prediction, rate, new_state, scratch[:n]
        )
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    y, y1, d = state[: 2 * n], new_state[: 2 * n], prediction
    for m in range(2 * n):
        d[m] = y1[m] - d[m]
    error, factor = 0.0, 0.0
    if has_fixed_step:
        memory[NEXT_ORDER] = min(memory[ORDER] + 1.0, options[HIGHEST])
    else:
        error, factor = _choose_order(options, memory, tolerances, trial, y, y1, d)
        position_error = prediction_error(w, tolerances, h, y[:n], y[n:], y1[:n])
        if position_error > 0.0:
            factor = min(factor, max(SAFETY / position_error, MIN_STEP_FACTOR))
        error = max(error, position_error)
    memory[HAS_TRIAL] = 1.0
    _update_differences(memory, trial, y1, d)
    return Attempt(DONE, error, factor)


BDF = Step(bdf_step, commit_bdf)

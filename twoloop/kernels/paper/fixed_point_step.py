"""Attempt implicit Runge-Kutta steps, by the fixed-point outer loops of iterations.py (`f`: kit, `w`: workspace)."""

import numpy as np

from twoloop.kernels.control.step_size import commit_nothing
from twoloop.kernels.data.common import ATTEMPT, COMMIT, Attempt, Step, kernel
from twoloop.kernels.data.indices import DONE, ESTIMATE
from twoloop.kernels.evaluation.inner_loop import accelerations
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.paper import iterations as at
from twoloop.kernels.paper.iterations import (
    estimate_and_extrapolate,
    iterate_accelerations,
    iterate_first_order,
    memory_block,
    memory_vector,
    rounding_errors_of,
    step_views,
)
from twoloop.kernels.steps.stages import (
    END_ERROR_WEIGHT,
    EXTRAPOLATION,
    INNER_TOL,
    MAX_STEP_RATIO,
    STAGES,
    estimate_end_error,
    interpolate,
    tableau_of,
)


@kernel(COMMIT)
def commit_runge_kutta(f, w, options, memory, tolerances, accepted):
    """If the attempted step was accepted, keep its stage accelerations and the rounding errors of q and v."""
    s, n = int(options[STAGES]), w.Q.size
    if accepted and memory[at.HAS_TRIAL] == 1.0:
        previous, trial = memory_block(memory, s, n, at.A_PREVIOUS), memory_block(memory, s, n, at.A_TRIAL)
        for j in range(s):
            copy(trial[j], previous[j])
        memory[at.H_PREVIOUS] = memory[at.H_TRIAL]
        memory[at.HAS_PREVIOUS] = 1.0
        rounding = rounding_errors_of(memory, s, n, tolerances)
        for i in range(rounding.shape[0] // 2):
            copy(rounding[rounding.shape[0] // 2 + i], rounding[i])
    memory[at.HAS_TRIAL] = 0.0


@kernel(ATTEMPT)
def runge_kutta_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step by fixed-point iteration; estimate its error from a step of size h and two steps of size h/2.

    The new state is the end of the second half step. If options[EXTRAPOLATION] is not 0, the state is extrapolated
    from the ends of the whole step and of the half steps, and projected onto the constraints. The polynomial through
    the stages of the last accepted step predicts the stages of the whole step; the polynomial through these predicts
    the stages of half steps. If the step size is fixed, only the whole step is computed.
    """
    s, _, _, _, _, c = tableau_of(options)
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    previous = memory_block(memory, s, n, at.A_PREVIOUS)
    trial, half, Q_stage, V_stage, q_full, v_full, q_mid, v_mid = step_views(memory, s, n)
    weights = memory[memory.size - s :]
    rounding = rounding_errors_of(memory, s, n, tolerances)
    ratio = h / memory[at.H_PREVIOUS] if memory[at.HAS_PREVIOUS] == 1.0 else np.inf
    for j in range(s):
        if ratio <= MAX_STEP_RATIO:
            interpolate(c, 1.0 + ratio * c[j], previous, weights, trial[j])
        else:
            copy(a, trial[j])
    code, prediction_error = iterate_accelerations(
        f, w, options, tolerances, t, h, q, v, trial, Q_stage, V_stage, q1, v1, rounding
    )
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        copy(q1, q_full)
        copy(v1, v_full)
        for j in range(s):
            interpolate(c, 0.5 * c[j], trial, weights, half[j])
        h_half = 0.5 * h
        code, prediction_error_mid = iterate_accelerations(
            f, w, options, tolerances, t, h_half, q, v, half, Q_stage, V_stage, q_mid, v_mid, rounding
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        for j in range(s):
            interpolate(c, 0.5 + 0.5 * c[j], trial, weights, half[j])
        code, prediction_error = iterate_accelerations(
            f, w, options, tolerances, t + h_half, h_half, q_mid, v_mid, half, Q_stage, V_stage, q1, v1, rounding
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        # use the prediction errors of both half steps; that of the whole step does not count: its end is discarded
        prediction_error = max(prediction_error, prediction_error_mid)
        code, error = estimate_and_extrapolate(
            f, w, options[EXTRAPOLATION], options[INNER_TOL], t + h, tolerances, q, v, q_full, v_full, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    memory[at.HAS_TRIAL] = 1.0
    memory[at.H_TRIAL] = h
    if code == DONE and tolerances[ESTIMATE] == 1.0:
        error = max(error, END_ERROR_WEIGHT * estimate_end_error(tolerances, options, h, state, new_state, trial))
    return Attempt(code, max(error, prediction_error), 0.0)


RUNGE_KUTTA = Step(runge_kutta_step, commit_runge_kutta)


SUDDEN_ERROR = 10.0  # a step is rejected if jumps of forces cause a larger error (in tolerances); not in the paper


@kernel(ATTEMPT)
def paper_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step as in Sects. 3.1-3.3 of the paper; estimate its error by comparison with two half steps."""
    s, _, _, _, _, _ = tableau_of(options)
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    A_stage, A_full, Q_stage, V_stage, q_full, v_full, q_mid, v_mid = step_views(memory, s, n)
    a_mid = memory_vector(memory, s, n, at.A_MID)
    q_old, v_old = memory_vector(memory, s, n, at.Q_OLD), memory_vector(memory, s, n, at.V_OLD)
    code = iterate_first_order(f, w, options, t, h, q, v, a, A_stage, Q_stage, V_stage, q_old, v_old, q1, v1)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        copy(q1, q_full)
        copy(v1, v_full)
        for j in range(s):
            copy(A_stage[j], A_full[j])
        h_half = 0.5 * h
        code = iterate_first_order(
            f, w, options, t, h_half, q, v, a, A_stage, Q_stage, V_stage, q_old, v_old, q_mid, v_mid
        )
        if code == DONE:
            code = accelerations(f, w, t + h_half, q_mid, v_mid, a_mid, w.lam)
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        code = iterate_first_order(
            f, w, options, t + h_half, h_half, q_mid, v_mid, a_mid, A_stage, Q_stage, V_stage, q_old, v_old, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        code, error = estimate_and_extrapolate(
            f, w, options[EXTRAPOLATION], options[INNER_TOL], t + h, tolerances, q, v, q_full, v_full, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    if code == DONE and tolerances[ESTIMATE] == 1.0:
        jump_error = END_ERROR_WEIGHT * estimate_end_error(tolerances, options, h, state, new_state, A_full)
        if error <= 1.0 and jump_error > SUDDEN_ERROR:
            error = jump_error
    return Attempt(code, error, 0.0)


PAPER = Step(paper_step, commit_nothing)

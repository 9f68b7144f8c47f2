"""Diagonally implicit Runge-Kutta steps with an explicit first stage (ESDIRK), for stiff problems and few digits.

One stage after another is found as in diagonal_stage.py, with v_j = v + h sum_k a_jk a_k and q_j = q + h sum_k a_jk V_k
over the stages before.

With step-size control TR-BDF2 goes on from its embedded formula of order 3, the difference to it filtered three times,
which leaves the method L-stable: so the errors of many short steps add up to the tolerance, and not to their number
times it.
"""

import numpy as np

from twoloop.kernels.control.predictor import departure, keep_predicted
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import ATTEMPT, SETTLE, Attempt, Step, compiled, kernel
from twoloop.kernels.data.flags import FORCE_BY_Q_GIVEN
from twoloop.kernels.data.noted import GENERATION
from twoloop.kernels.data.tolerances import ESTIMATE, allowed
from twoloop.kernels.evaluation.inner_loop import evaluate, evaluate_state, multipliers
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.diagonal_stage import (
    KEPT_WHILE,
    PLACE,
    TAIL,
    gamma_of,
    has_dense_tangents,
    one_stage_of,
    solve_stage,
    stages_of,
)
from twoloop.kernels.steps.iteration_matrix import factor_again, filter_by_iteration
from twoloop.kernels.steps.lasting import STEPS, derivatives_fit, lasting_error, over_velocities, own_time
from twoloop.kernels.steps.newton_memory import block, vector
from twoloop.kernels.steps.newton_operator import derivatives_at, factor_filter, factor_systems, filter_error
from twoloop.kernels.steps.stages import INNER_TOL

FILTERED = 3  # times: with fewer the extrapolated method is unstable for vibrations, see tests/kernels/test_diagonal.py

AT_JUMP = 0.174  # of the width of accelerations that jump: when `lower` misses as much, its difference counts in full


@compiled
def _filter(f, w, options, memory, h, e_q, e_v):
    """(I - z J)^-1 (e_q, e_v) by the last factors, J being the Jacobian of (v, F); all n_dof numbers in (n_q)."""
    z = h * gamma_of(options)
    count = w.independent.size
    if has_dense_tangents(f, w):
        filter_by_iteration(w, memory, z, e_q[:count], e_v[:count])
    else:
        filter_error(f, w, options, memory, one_stage_of(options), h, e_q, e_v)
    for i in range(count):
        e_q[i] += z * e_v[i]


@compiled
def _factor_filter(f, w, options, memory, h):
    """Factors with which `_filter` is that of steps of h."""
    if has_dense_tangents(f, w):
        return factor_again(w, memory, h * gamma_of(options))
    return factor_filter(f, w, options, memory, one_stage_of(options), h)


@compiled
def _difference(w, h, V_stage, A_stage, weights, share, e_q, e_v):
    """The stages' difference by such weights, times `share`, of the independents; all n_dof numbers in (n_q)."""
    for i in range(w.independent.size):
        j = w.independent[i]
        in_q, in_v = 0.0, 0.0
        for k in range(weights.size):
            in_q += weights[k] * V_stage[k, j]
            in_v += weights[k] * A_stage[k, j]
        e_q[i] = share * h * in_q
        e_v[i] = share * h * in_v


@compiled
def _renew(f, w, options, memory, t, h, new_state):
    """Derivatives at the end of the step, and their factors."""
    n = w.Q.size
    Q, V, F = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID), vector(memory, 1, n, at.A_MID)
    copy(new_state[:n], Q)
    copy(new_state[n : 2 * n], V)
    memory[at.HAS_JACOBIAN] = 0.0
    code = evaluate(f, w, t, Q, V, options[INNER_TOL], F)
    if code != DONE:
        return code
    multipliers(f, w, t, Q, V, F, w.lam)
    code = derivatives_at(f, w, options, memory, one_stage_of(options), t, Q, V, F)
    if code == DONE:
        code = factor_systems(f, w, options, memory, one_stage_of(options), h)
    if code == DONE:
        memory[at.HAS_JACOBIAN] = 1.0
        memory[at.FRESH] = 0.0
    return code


@compiled
def _error(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, weights, share):
    """Largest component, over atol + rtol |value|, of the stages' difference by such weights, times `share`.

    It is filtered by the last factors (Hosea and Shampine 1996): what is stiff has no part in it.
    """
    n = w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    e_q, e_v = vector(memory, 1, n, at.E_Q), vector(memory, 1, n, at.E_V)
    raw, once = vector(memory, 1, n, at.A_NEW), vector(memory, 1, n, at.A_MID)
    count = w.independent.size
    z = h * gamma_of(options)
    _difference(w, h, V_stage, A_stage, weights, share, e_q, e_v)
    copy(e_v, raw)
    _filter(f, w, options, memory, h, e_q, e_v)
    if f.flags[FORCE_BY_Q_GIVEN] == 0 and not derivatives_fit(
        f, w, options, memory, 1, t + h, z, tolerances, raw, e_q, e_v, state, new_state, A_stage[-1]
    ):
        memory[at.CHANGED] = 1.0
        if _renew(f, w, options, memory, t + h, h, new_state) != DONE:
            return np.inf
        _difference(w, h, V_stage, A_stage, weights, share, e_q, e_v)
        copy(e_v, raw)
        _filter(f, w, options, memory, h, e_q, e_v)
    error = 0.0
    for i in range(count):
        j = w.independent[i]
        scale = allowed(tolerances, j, q[j], q1[j])
        error = max(error, abs(e_q[i]) / scale)
        if options[PLACE + at.VELOCITIES] == 1.0:
            scale = allowed(tolerances, j, v[j], v1[j])
            error = max(error, abs(e_v[i]) / scale)
    copy(e_v, once)
    _filter(f, w, options, memory, h, e_q, e_v)
    return max(error, lasting_error(w, memory, tolerances, z, raw, once, e_v, state, new_state, A_stage[-1]))


@compiled
def _extrapolate(f, w, options, memory, h, q1, v1):
    """From the end of the step by the formula to that of the embedded one; its difference was filtered twice."""
    e_q, e_v = vector(memory, 1, w.Q.size, at.E_Q), vector(memory, 1, w.Q.size, at.E_V)
    for _ in range(2, FILTERED):
        _filter(f, w, options, memory, h, e_q, e_v)
    for i in range(w.independent.size):
        q1[w.independent[i]] -= e_q[i]
        v1[w.independent[i]] -= e_v[i]


@compiled
def _slow_error(f, w, options, memory, h, tolerances, state, new_state, A_stage):
    """What an error of the velocities, in E_V, leaves in directions that are slow beside the step, as newton_step."""
    n = w.Q.size
    e_q, e_v = vector(memory, 1, n, at.E_Q), vector(memory, 1, n, at.E_V)
    longest = own_time(w, tolerances, state, state[2 * n :])
    if memory[at.CHANGED] == 1.0:
        longest = max(longest, own_time(w, tolerances, state, A_stage[-1]))
    error = over_velocities(w, tolerances, e_v, longest, state, new_state)
    if error <= 1.0:
        return 0.0
    for i in range(w.independent.size):
        e_q[i] = 0.0
    longer = STEPS * h / gamma_of(options)
    if _factor_filter(f, w, options, memory, longer) == DONE:
        _filter(f, w, options, memory, longer, e_q, e_v)
        # where the motion is unstable the system may be nearly singular, and the solution large
        error = min(error, over_velocities(w, tolerances, e_v, longest, state, new_state))
    memory[at.H_FACTORED] = 0.0
    return error


@compiled
def _error_at_jumps(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, lower):
    """The error by `lower`, the weights of another embedded formula, for accelerations that jump within the step.

    Those of the first one are so small at the stages of the first half that a jump there hardly shows. `lower` is exact
    for accelerations quadratic in time; where these are smooth, what it misses of their width is small, and its
    difference counts less by that factor, so that it is of a higher order than the first estimate.
    """
    n = w.Q.size
    missed, widest = 0.0, 0.0
    for j in w.independent:
        low, high, total = A_stage[0, j], A_stage[0, j], 0.0
        for k in range(lower.size):
            low, high = min(low, A_stage[k, j]), max(high, A_stage[k, j])
            total += lower[k] * A_stage[k, j]
        scale = allowed(tolerances, j, state[n + j], new_state[n + j])
        missed, widest = max(missed, abs(total) / scale), max(widest, (high - low) / scale)
    if missed == 0.0:
        return 0.0
    if memory[at.H_FACTORED] == 0.0 and _factor_filter(f, w, options, memory, h) != DONE:
        return np.inf
    share = min(1.0, missed / (AT_JUMP * widest))
    error = _error(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, lower, share)
    if error <= 1.0:
        error = max(error, _slow_error(f, w, options, memory, h, tolerances, state, new_state, A_stage))
    return error


@kernel(SETTLE)
def settle_diagonal(f, w, options, memory, tolerances, accepted):
    """The last stage of an accepted step is the first of the next one."""
    if accepted:
        s = int(options[TAIL])
        _, A_stage, a_end = stages_of(memory, s, w.Q.size)
        copy(A_stage[s - 1], a_end)  # F at the state would magnify what Newton's method left by stiffness
        memory[at.FRESH] = 0.0


@kernel(ATTEMPT, vectorized=True)
def diagonal_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt: the stages one after another, the last of which is the end of the step."""
    s = int(options[TAIL])
    o = TAIL + 1
    A = options[o : o + s * s].reshape((s, s))
    c, weights = options[o + s * s : o + s * s + s], options[o + s * s + s : o + s * s + 2 * s]
    lower = options[o + s * s + 2 * s : o + s * s + 3 * s]
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    V_stage, A_stage, a_end = stages_of(memory, s, n)
    if memory[at.HAS_TRIAL] == 0.0 or memory[at.PARTITION_NUMBER] != w.notes[GENERATION]:
        memory[at.HAS_TRIAL] = 1.0
        memory[at.PARTITION_NUMBER] = w.notes[GENERATION]
        memory[at.HAS_JACOBIAN] = 0.0
        copy(a, a_end)
    if memory[at.FRESH] == 0.0 and memory[at.CONTRACTION] > KEPT_WHILE:
        memory[at.HAS_JACOBIAN] = 0.0
    copy(v, V_stage[0])
    copy(a_end, A_stage[0])
    q_bar, v_bar = block(memory, 1, n, at.PREVIOUS)[0], block(memory, 1, n, at.TRIAL)[0]
    Q, V = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID)
    for j in range(1, s):
        for m in range(n):
            in_q, in_v = 0.0, 0.0
            for k in range(j):
                in_q += A[j, k] * V_stage[k, m]
                in_v += A[j, k] * A_stage[k, m]
            q_bar[m] = q[m] + h * in_q
            v_bar[m] = v[m] + h * in_v
        copy(A_stage[j - 1], A_stage[j])
        code = solve_stage(f, w, options, memory, t + c[j] * h, h, A_stage[j : j + 1])
        if code != DONE and memory[at.FRESH] == 0.0:
            memory[at.HAS_JACOBIAN] = 0.0
            copy(A_stage[j - 1], A_stage[j])
            code = solve_stage(f, w, options, memory, t + c[j] * h, h, A_stage[j : j + 1])
        if code != DONE:
            memory[at.HAS_JACOBIAN] = 0.0
            return Attempt(code, np.inf, 0.0)
        copy(V, V_stage[j])
    copy(V, v1)
    for m in w.dependent:  # as the formula has them, beside those that the constraints give
        q1[m] = q_bar[m] + h * A[s - 1, s - 1] * V[m]
    for m in w.independent:
        q1[m] = Q[m]
    error = 0.0
    memory[at.CHANGED] = 0.0
    if tolerances[ESTIMATE] == 1.0:
        error = _error(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, weights, 1.0)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
        if options[options.size - 1] == 1.0:
            _extrapolate(f, w, options, memory, h, q1, v1)
        error = max(error, _slow_error(f, w, options, memory, h, tolerances, state, new_state, A_stage))
        if error <= 1.0 and options[options.size - 1] == 0.0:
            jumps = _error_at_jumps(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, lower)
            error = max(error, jumps)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
    keep_predicted(w, q1)
    code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    if code == DONE:
        error = max(error, departure(w, tolerances, h, q, v, q1))
    return Attempt(code, error, 0.0)


DIAGONAL = Step(diagonal_step, settle_diagonal)

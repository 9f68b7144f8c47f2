"""Implicit Runge-Kutta steps whose outer loop is Newton's method, for stiff problems.

The stage accelerations a_j of the independent coordinates must make the residuals r_j zero (`f`: kit, `w`: workspace):

    r_j = F(t_j, Q_j, V_j) - a_j = 0,  Q_j = q + c_j h v + h^2 sum_k (A A)_jk a_k,  V_j = v + h sum_k A_jk a_k,

where F are the accelerations that the inner loop returns, and A, c are the Butcher tableau. J_q and J_v are the
derivatives of F by the independent positions and velocities at a single state (simplified Newton's method). The Newton
corrections d of all a_j solve (I - h^2 A A x J_q - h A x J_v) d = r, where x is the Kronecker product. In the basis of
eigenvectors of A, this splits into systems with the matrices I - (h l)^2 J_q - h l J_v (n_dof, n_dof): a real system
for each real eigenvalue l of A, and a complex one for each conjugate pair. They have half the size of systems for
(q, v) (Hairer & Wanner, Solving ODEs II, IV.8, for Radau IIA). Fixed-point iteration would need tiny steps.
"""

import numpy as np

from twoloop.kernels.control.step_size import project_prediction
from twoloop.kernels.data.common import (
    ATTEMPT,
    COMMIT,
    Attempt,
    Step,
    allowed_error,
    compiled,
    kernel,
    max_change_by_rounding,
    smallest_size,
)
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, FIXED_ORDER, LEAST, OUTER_DIVERGED, RTOL
from twoloop.kernels.evaluation.inner_loop import accelerations, evaluate, multipliers
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.steps import stages as at
from twoloop.kernels.steps.newton_systems import (
    EQUAL_STEP_TOLERANCE,
    MAX_ITERATIONS,
    MAX_ROUNDING_CORRECTION,
    correct_stages,
    factor_filter,
    factor_systems,
    fill_derivatives,
    filter_error,
)
from twoloop.kernels.steps.stages import (
    INNER_TOL,
    MAX_STEP_RATIO,
    OUTER_TOL,
    STAGES,
    block,
    interpolate,
    middle_node,
    newton_options_index,
    tableau_of,
    vector,
)
from twoloop.kernels.steps.velocity_errors import STEPS_TO_DECAY, filtered_velocity_error, motion_time, velocity_error

# the next step computes new derivatives if the last Newton correction exceeds this fraction of the previous one
SLOW_CONTRACTION = 0.05
# in steps of fixed size, rounding may keep corrections from decreasing to the tolerance. So Newton's method has also
# converged if the last correction is at most MAX_ROUNDING_CORRECTION_FIXED * max(1, |corrected value|)
MAX_ROUNDING_CORRECTION_FIXED = 1e-9


@compiled
def _solve_stages(f, w, options, memory, t, h, tolerances, q, v, A_stage):
    """Solve for the stage accelerations A_stage (s, n) by Newton's method; return DONE or a failure code.

    A_stage must contain first guesses. memory[CONTRACTION] becomes the ratio of the last two Newton corrections.
    """
    s, A, A2, _, _, c = tableau_of(options)
    n = q.size
    residual = block(memory, s, n, at.RESIDUAL)
    Q_stage, V_stage = block(memory, s, n, at.Q_STAGE), block(memory, s, n, at.V_STAGE)
    a_new = vector(memory, s, n, at.A_NEW)
    previous_change = 0.0
    max_rounding, least_size = MAX_ROUNDING_CORRECTION_FIXED, smallest_size(tolerances[RTOL], tolerances[ATOL:])
    if tolerances[ESTIMATE] == 1.0:
        max_rounding = MAX_ROUNDING_CORRECTION * tolerances[LEAST]
    rounding_limit = 0.0
    for iteration in range(MAX_ITERATIONS):
        w.n_outer += 1
        for j in range(s):
            for m in range(n):
                Q_stage[j, m] = q[m] + c[j] * h * v[m]
                V_stage[j, m] = v[m]
            for k in range(s):
                weight_q, weight_v = h * h * A2[j, k], h * A[j, k]
                for m in range(n):
                    Q_stage[j, m] += weight_q * A_stage[k, m]
                    V_stage[j, m] += weight_v * A_stage[k, m]
        for j in range(s):
            code = evaluate(f, w, t + c[j] * h, Q_stage[j], V_stage[j], options[INNER_TOL], a_new)
            if code != DONE:
                return code
            for m in range(n):
                residual[j, m] = a_new[m] - A_stage[j, m]
            if f.form != FIXED_ORDER:  # the fixed-order form treats all coordinates as independent
                for m in w.dependent:
                    A_stage[j, m] = a_new[m]
        scale_q, scale_v = least_size, least_size
        for j in range(s):
            for m in w.independent:
                scale_q = max(scale_q, abs(Q_stage[j, m]))
                scale_v = max(scale_v, abs(V_stage[j, m]))
        correct_stages(f, w, options, memory, s, residual, A_stage)
        largest_q, largest_v = 0.0, 0.0
        for j in range(s):
            change_q, change_v = Q_stage[j], V_stage[j]  # overwrite the stages, which the next iteration computes anew
            for m in range(n):
                change_q[m] = 0.0
                change_v[m] = 0.0
            for k in range(s):
                for m in range(n):
                    change_q[m] += A2[j, k] * residual[k, m]
                    change_v[m] += A[j, k] * residual[k, m]
            for m in w.independent:
                largest_q = max(largest_q, abs(change_q[m]))
                largest_v = max(largest_v, abs(change_v[m]))
        change = max(h * largest_v / scale_v, h * h * largest_q / scale_q)
        if not np.isfinite(change):
            return OUTER_DIVERGED
        rounding_limit = max_rounding
        if tolerances[ESTIMATE] == 1.0:
            rounding_limit = max_change_by_rounding(
                max_rounding, change, h * h * largest_q, h * largest_v, scale_q, scale_v
            )
        if iteration > 0:
            contraction = change / previous_change if previous_change > 0.0 else 0.0
            memory[at.CONTRACTION] = contraction
            if contraction >= 0.9:
                return DONE if change <= rounding_limit else OUTER_DIVERGED
            if contraction / (1.0 - contraction) * change <= options[OUTER_TOL]:
                return DONE
            # stop early if the corrections cannot fall to the tolerance in the remaining iterations
            n_left = MAX_ITERATIONS - 1 - iteration
            if change * contraction**n_left / (1.0 - contraction) > max(options[OUTER_TOL], rounding_limit):
                return OUTER_DIVERGED
        elif change <= 1e-3 * options[OUTER_TOL]:
            return DONE
        previous_change = change
    return DONE if previous_change <= rounding_limit else OUTER_DIVERGED


@compiled
def _filter_errors(f, w, options, memory, h, e_q, e_v):
    """Multiply the error estimates (e_q, e_v) by (I - z J)^-1, with a Jacobian J, to remove their stiff components.

    J: derivative of (v_i, a_i) by (q_i, v_i). z: step size h times the constant GAMMA0 of the method. The estimates are
    the first n_dof entries of the vectors e_q and e_v (n_q each); the other entries are scratch.
    """
    s = int(options[STAGES])
    m = w.independent.size
    filter_error(f, w, options, memory, s, h, e_q, e_v)
    for i in range(m):
        e_q[i] += h * options[newton_options_index(s) + at.GAMMA0] * e_v[i]


@compiled
def _estimate_error(f, w, options, memory, h, tolerances, state, new_state, A_stage):
    """Return the embedded error estimate of a step (largest component, in tolerances), without stiff components."""
    s, A, _, _, _, _ = tableau_of(options)
    n = w.Q.size
    q, v, a, q1, v1 = state[:n], state[n : 2 * n], state[2 * n : 3 * n], new_state[:n], new_state[n : 2 * n]
    offset = newton_options_index(s)
    gamma0 = options[offset + at.GAMMA0]
    e = options[offset + at.N_EIGEN_SCALARS : offset + at.N_EIGEN_SCALARS + s]
    e_q, e_v = vector(memory, s, n, at.E_Q), vector(memory, s, n, at.E_V)
    unfiltered, filtered_once = vector(memory, s, n, at.A_NEW), vector(memory, s, n, at.A_MID)
    for i in range(w.independent.size):
        j = w.independent[i]
        sum_q = gamma0 * v[j]
        sum_v = gamma0 * a[j]
        for k in range(s):
            velocity = v[j]
            for l in range(s):
                velocity += h * A[k, l] * A_stage[l, j]
            sum_q += e[k] * velocity
            sum_v += e[k] * A_stage[k, j]
        e_q[i] = h * sum_q
        e_v[i] = h * sum_v
    copy(e_v, unfiltered)
    _filter_errors(f, w, options, memory, h, e_q, e_v)
    error = 0.0
    for i in range(w.independent.size):
        j = w.independent[i]
        error = max(error, abs(e_q[i]) / allowed_error(tolerances, j, q[j], q1[j]))
        if options[offset + at.TESTS_VELOCITIES] == 1.0:
            error = max(error, abs(e_v[i]) / allowed_error(tolerances, j, v[j], v1[j]))
    if options[offset + at.TESTS_VELOCITIES] == 1.0:
        return error
    copy(e_v, filtered_once)
    _filter_errors(f, w, options, memory, h, e_q, e_v)
    error = max(
        error,
        filtered_velocity_error(w, memory, tolerances, h * gamma0, unfiltered, filtered_once, e_v, state, new_state, a),
    )
    if error <= 1.0:
        error = max(error, _error_in_slow_directions(f, w, options, memory, h, tolerances, state, new_state))
    return error


@compiled
def _error_in_slow_directions(f, w, options, memory, h, tolerances, state, new_state):
    """Return the error, in tolerances, that the slowly decaying part of a step's velocity error causes in q or v.

    E_V in `memory` is the velocity error. `filtered_velocity_error` assumes that all components of it last only as long
    as the fastest one. Here, a filter keeps the part that remains after STEPS_TO_DECAY steps; this part is assumed to
    last for `motion_time`. If unfiltered E_V would cause an error of at most 1, return 0. E_Q, E_V are overwritten.
    """
    s, n = int(options[STAGES]), w.Q.size
    z = STEPS_TO_DECAY * h / options[newton_options_index(s) + at.GAMMA0]
    e_q, e_v = vector(memory, s, n, at.E_Q), vector(memory, s, n, at.E_V)
    max_duration = motion_time(w, tolerances, state, state[2 * n :])
    error = velocity_error(w, tolerances, e_v, max_duration, state, new_state)
    if error <= 1.0:
        return 0.0
    for i in range(w.independent.size):
        e_q[i] = 0.0
    if factor_filter(f, w, options, memory, s, z) == DONE:
        filter_error(f, w, options, memory, s, z, e_q, e_v)
        # in unstable motion, the filter's matrix may be nearly singular: then the filter would enlarge the error
        error = min(error, velocity_error(w, tolerances, e_v, max_duration, state, new_state))
    if factor_filter(f, w, options, memory, s, h) != DONE:
        memory[at.H_FACTORED] = 0.0
    return error


@kernel(COMMIT)
def commit_newton(f, w, options, memory, tolerances, accepted):
    """Store the stage accelerations of an accepted step; the next step predicts its stage accelerations from them."""
    s, n = int(options[STAGES]), w.Q.size
    if accepted:
        memory[at.IS_FRESH] = 0.0
        if memory[at.HAS_TRIAL] == 1.0:
            for j in range(s):
                copy(block(memory, s, n, at.TRIAL)[j], block(memory, s, n, at.PREVIOUS)[j])
            memory[at.H_PREVIOUS] = memory[at.H_TRIAL]
            memory[at.HAS_PREVIOUS] = 1.0
    memory[at.HAS_TRIAL] = 0.0


@kernel(ATTEMPT)
def newton_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt an implicit Runge-Kutta step of size h by Newton's method; estimate its error by an embedded formula."""
    s, _, _, b, bA, c = tableau_of(options)
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    previous, trial = block(memory, s, n, at.PREVIOUS), block(memory, s, n, at.TRIAL)
    weights = memory[memory.size - s :]
    q_mid, v_mid, a_mid = vector(memory, s, n, at.Q_MID), vector(memory, s, n, at.V_MID), vector(memory, s, n, at.A_MID)
    if memory[at.PARTITION_NUMBER] != w.generation:
        memory[at.HAS_JACOBIAN] = 0.0
        memory[at.PARTITION_NUMBER] = w.generation
    if memory[at.IS_FRESH] == 0.0 and memory[at.CONTRACTION] > SLOW_CONTRACTION:
        memory[at.HAS_JACOBIAN] = 0.0
    node = middle_node(c)
    while True:
        if memory[at.HAS_JACOBIAN] == 0.0:
            # compute derivatives at the middle stage, whose stiff directions differ least from those at other stages.
            # At a time between stages, a short force that acts at no stage might change these derivatives
            dt = node * h
            for m in range(n):
                q_mid[m] = q[m] + dt * (v[m] + 0.5 * dt * a[m])
                v_mid[m] = v[m] + dt * a[m]
            code = evaluate(f, w, t + dt, q_mid, v_mid, options[INNER_TOL], a_mid)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
            multipliers(f, w, t + dt, q_mid, v_mid, a_mid, w.lam)
            code = fill_derivatives(f, w, options, tolerances, memory, s, t + dt, q_mid, v_mid, a_mid)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
            memory[at.HAS_JACOBIAN] = 1.0
            memory[at.IS_FRESH] = 1.0
            memory[at.H_FACTORED] = 0.0
        if abs(memory[at.H_FACTORED] - h) > EQUAL_STEP_TOLERANCE * h:
            code = factor_systems(f, w, options, memory, s, h)
            if code != DONE:
                memory[at.HAS_JACOBIAN] = 0.0
                return Attempt(code, np.inf, 0.0)
        ratio = h / memory[at.H_PREVIOUS] if memory[at.HAS_PREVIOUS] == 1.0 else np.inf
        for j in range(s):
            if ratio <= MAX_STEP_RATIO:
                interpolate(c, 1.0 + ratio * c[j], previous, weights, trial[j])
            else:
                copy(a, trial[j])
        code = _solve_stages(f, w, options, memory, t, h, tolerances, q, v, trial)
        if code == DONE:
            break
        if memory[at.IS_FRESH] == 1.0 and (node == 0.0 or code != OUTER_DIVERGED):
            return Attempt(code, np.inf, 0.0)
        # Newton's method failed: try again with new derivatives. If they were new already, compute them at the start of
        # the step: derivatives at the middle stage, an extrapolated state, may be wrong, for example with friction
        if memory[at.IS_FRESH] == 1.0:
            node = 0.0
        memory[at.HAS_JACOBIAN] = 0.0
    for m in range(n):
        sum_q = 0.0
        sum_v = 0.0
        for k in range(s):
            sum_q += bA[k] * trial[k, m]
            sum_v += b[k] * trial[k, m]
        q1[m] = q[m] + h * v[m] + h * h * sum_q
        v1[m] = v[m] + h * sum_v
    code, distance = project_prediction(f, w, tolerances, t + h, h, q, v, q1, v1, options[INNER_TOL])
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        error = _estimate_error(f, w, options, memory, h, tolerances, state, new_state, trial)
        error = max(error, distance)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    memory[at.HAS_TRIAL] = 1.0
    memory[at.H_TRIAL] = h
    return Attempt(code, error, 0.0)


NEWTON = Step(newton_step, commit_newton)

"""Attempt diagonally implicit Runge-Kutta steps with an explicit first stage (ESDIRK), for stiffness and low accuracy.

The stages are solved one after another. For stage j of the tableau a_jk, with the diagonal entry gamma, Newton's method
finds the accelerations a of the independent coordinates. F are the accelerations that the inner loop returns,
z = gamma h, and sums are over the stages k < j:

    F(t_j, Q, V) - a = 0,  V = v_j + z a,  Q = q_j + z V,
    v_j = v + h sum_k a_jk a_k,  q_j = q + h sum_k a_jk V_k.

The corrections d solve (I - z^2 J_q - z J_v) d = F - a, where J_q and J_v are the derivatives of F. If the system
provides the tangents K and D (derivatives of the forces by q and v), derivatives are computed in every iteration: stiff
directions turn with the bodies, and if they turn much in a step, the iteration with older derivatives does not
converge. Then the dense matrix T^T (M - z^2 K - z D) T is factored, where the columns of T are the allowed velocities.

newton_step.py, which solves all stages together, uses one set of derivatives for all stages. So newton_systems.py first
multiplies derivatives by the inverse of T^T M T. For a matrix that is used in one iteration, this is twice the work.

Under step-size control, a step of TR-BDF2 (order 2) ends close to the result of its embedded formula of order 3: the
difference of the results is multiplied by filters (I - z J)^-1 with the Jacobian J, and subtracted from the result of
order 2. The filter keeps the method L-stable. The tolerance limits the difference, but the error of a step is smaller:
errors of many short steps add up to about the tolerance, not to a multiple of it. `f`: kit, `w`: workspace.
"""

import numpy as np

from twoloop.kernels.control.step_size import prediction_error, store_prediction
from twoloop.kernels.data.common import (
    ATTEMPT,
    COMMIT,
    Attempt,
    Step,
    allowed_error,
    compiled,
    inlined,
    kernel,
    merged,
    smallest_size,
)
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, FIXED_ORDER, OUTER_DIVERGED, RTOL, SINGULAR
from twoloop.kernels.evaluation.inner_loop import evaluate, evaluate_state, find_tangents, multipliers
from twoloop.kernels.linalg.dense import copy, ldl_factor, ldl_solve, lu_factor, lu_solve
from twoloop.kernels.steps import stages as at
from twoloop.kernels.steps.newton_systems import (
    EQUAL_STEP_TOLERANCE,
    correct_stages,
    factor_filter,
    factor_systems,
    fill_derivatives,
    fill_tangent_by_q,
    fill_tangent_by_v,
    filter_error,
    reduce_to_independents,
)
from twoloop.kernels.steps.stages import as_matrix, block, matrix_storage, pivots_of, vector
from twoloop.kernels.steps.velocity_errors import (
    STEPS_TO_DECAY,
    derivatives_agree,
    filtered_velocity_error,
    motion_time,
    velocity_error,
)

MAX_ASYMMETRY = 1e-12  # a matrix A counts as symmetric if |A_ij - A_ji| is at most this fraction of its largest |A_ii|


@compiled
def _is_symmetric(A):
    largest, asymmetry = 0.0, 0.0
    for i in range(A.shape[0]):
        largest = max(largest, abs(A[i, i]))
        for j in range(i):
            asymmetry = max(asymmetry, abs(A[i, j] - A[j, i]))
    return asymmetry <= MAX_ASYMMETRY * largest


@compiled
def _fill_newton_matrix(w, memory, n, m, z, H):
    """Store T^T (M - z^2 K - z D) T in H: Newton's matrix, reduced to the m degrees of freedom by the columns of T.

    These columns are the allowed velocities; z = gamma h; K and D are the derivatives of forces by q and v.
    """
    N, Kr, Dr = (
        matrix_storage(w, n, at.SYSTEMS),
        matrix_storage(w, n, at.DERIVATIVE_Q),
        matrix_storage(w, n, at.DERIVATIVE_V),
    )
    z2 = z * z
    if memory[at.HAS_DAMPING] == 1.0:
        for i in range(m * m):
            H[i] = N[i] - z2 * Kr[i] - z * Dr[i]
    else:
        for i in range(m * m):
            H[i] = N[i] - z2 * Kr[i]


@compiled
def factor_newton_matrix(w, memory, z):
    """Factor Newton's matrix (`_fill_newton_matrix`) with the last computed derivatives of forces; return a code."""
    n, m = w.Q.size, w.independent.size
    storage = matrix_storage(w, n, at.FILTER)
    H = as_matrix(storage, m)
    w.n_factorizations += 1
    _fill_newton_matrix(w, memory, n, m, z, storage)
    memory[at.IS_SYMMETRIC] = 0.0
    if _is_symmetric(H):
        if ldl_factor(H):
            memory[at.IS_SYMMETRIC] = 1.0
            return DONE
        # L D L^T fails if the matrix is indefinite, for example with a compressed beam: fill the matrix again, use L U
        _fill_newton_matrix(w, memory, n, m, z, storage)
    return DONE if lu_factor(H, pivots_of(memory, 1, n, 0)) > 0.0 else SINGULAR


@compiled
def compute_and_factor_matrix(f, w, tolerances, memory, t, q, v, z):
    """Compute the derivatives of forces at (t, q, v), and factor Newton's matrix with them; return a code.

    The last evaluation must have been at (t, q, v), and w.lam must be its multipliers. z: step size times gamma.
    """
    n = q.size
    m = w.independent.size
    w.n_jacobians += 1
    storage = matrix_storage(w, n, at.FILTER)
    K, R = storage.reshape((n, n)), matrix_storage(w, n, at.SYSTEMS).reshape((n, n))
    AT = matrix_storage(w, n, at.SYSTEMS + 1)[: n * m].reshape((n, m))
    code = fill_tangent_by_q(f, w, tolerances, t, q, v, n - 1, vector(memory, 1, n, at.Q_MOVED), K, R)
    if code == DONE:
        code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    reduce_to_independents(w, K, AT, as_matrix(matrix_storage(w, n, at.DERIVATIVE_Q), m))
    memory[at.HAS_DAMPING] = f.force_by_v_given
    code = fill_tangent_by_v(f, t, q, v, n - 1, K)
    if code != DONE:
        return code
    if memory[at.HAS_DAMPING] == 1.0:
        reduce_to_independents(w, K, AT, as_matrix(matrix_storage(w, n, at.DERIVATIVE_V), m))
    reduce_to_independents(w, w.M, AT, as_matrix(matrix_storage(w, n, at.SYSTEMS), m))
    return factor_newton_matrix(w, memory, z)


@compiled
def _solve_newton_system(w, memory, x):
    """Replace x (n_dof), a right-hand side, by the solution, using the factors from `factor_newton_matrix`."""
    m = x.size
    H = as_matrix(matrix_storage(w, w.Q.size, at.FILTER), m)
    if memory[at.IS_SYMMETRIC] == 1.0:
        ldl_solve(H, x)
    else:
        lu_solve(H, pivots_of(memory, 1, w.Q.size, 0), x)


@compiled
def correct_stage(w, memory, residual, a):
    """Replace independent entries of `residual` by Newton's corrections, and add these to the accelerations a."""
    n = w.Q.size
    m = w.independent.size
    N, x = as_matrix(matrix_storage(w, n, at.SYSTEMS), m), vector(memory, 1, n, at.V_MOVED)[:m]
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += N[i, j] * residual[w.independent[j]]
        x[i] = total
    _solve_newton_system(w, memory, x)
    for i in range(m):
        residual[w.independent[i]] = x[i]
        a[w.independent[i]] += x[i]


@compiled
def filter_dense_error(w, memory, z, e_q, e_v):
    """Remove stiff components from e_v as `filter_error` does; e_q, e_v: estimated errors of independent q and v."""
    n = w.Q.size
    m = e_q.size
    N, Kr = as_matrix(matrix_storage(w, n, at.SYSTEMS), m), as_matrix(matrix_storage(w, n, at.DERIVATIVE_Q), m)
    x = vector(memory, 1, n, at.V_MOVED)[:m]
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += N[i, j] * e_v[j] + z * Kr[i, j] * e_q[j]
        x[i] = total
    _solve_newton_system(w, memory, x)
    copy(x, e_v)


MAX_ITERATIONS = 8  # largest number of Newton iterations of a stage: if they do not converge, the step fails
DIVERGENCE_RATIO = 2.0  # Newton's method has diverged if a correction exceeds this multiple of the previous one
LINEAR_FACTOR = 0.01  # factor on Newton's tolerance if derivatives are finite differences: convergence is then linear
MAX_CONTRACTION = 0.1  # finite differences are renewed if a Newton correction exceeds this fraction of the previous one
VELOCITY_WEIGHT = 0.1  # weight, in Newton's convergence test, of the effect that a correction of v has on q later


@inlined
def stage_views(memory, s, n):
    """Return stage velocities (s, n), stage accelerations (s, n), start accelerations of the step (n), in `memory`."""
    last = memory.size - n
    return (
        memory[last - 2 * s * n : last - s * n].reshape((s, n)),
        memory[last - s * n : last].reshape((s, n)),
        memory[last:],
    )


@merged
def gamma_of(options):
    """Return gamma, the value of all diagonal entries of the tableau A (s, s) except the first, which is 0."""
    s = int(options[at.DIAGONAL_OFFSET])
    return options[at.DIAGONAL_OFFSET + s * s]


@merged
def has_dense_tangents(f, w):
    """Return True if each Newton iteration computes derivatives of the forces anew, and factors a dense matrix."""
    return f.force_by_q_given == 1 and f.bandwidth < 0 and w.Rate.size == w.C.size and f.form != FIXED_ORDER


@merged
def stages_at_once(options):
    """Return 1, the number of stages solved at once; a literal 1 would make numba compile newton_systems.py again."""
    return int(options[at.STAGES])


@compiled
def _update_derivatives(f, w, options, tolerances, memory, t, h, Q, V, F):
    """If Newton's Jacobian or its factors are outdated, renew them at (t, Q, V), accelerations F; return a code."""
    if f.force_by_q_given == 1 or memory[at.HAS_JACOBIAN] == 0.0:
        multipliers(f, w, t, Q, V, F, w.lam)
        memory[at.HAS_JACOBIAN] = 1.0
        memory[at.IS_FRESH] = 1.0
        memory[at.H_FACTORED] = 0.0
        if has_dense_tangents(f, w):
            return compute_and_factor_matrix(f, w, tolerances, memory, t, Q, V, h * gamma_of(options))
        code = fill_derivatives(f, w, options, tolerances, memory, stages_at_once(options), t, Q, V, F)
        if code != DONE:
            return code
    if abs(memory[at.H_FACTORED] - h) > EQUAL_STEP_TOLERANCE * h:
        return factor_systems(f, w, options, memory, stages_at_once(options), h)
    return DONE


@compiled
def solve_stage(f, w, options, tolerances, memory, t, h, A_stage):
    """Solve for the accelerations A_stage (1, n_q) of a stage at the time t by Newton's method; return a code.

    On entry, A_stage contains predicted accelerations. Q_MID and V_MID in `memory` become the state of the stage.
    """
    n = w.Q.size
    z = h * gamma_of(options)
    q_bar, v_bar = block(memory, 1, n, at.PREVIOUS)[0], block(memory, 1, n, at.TRIAL)[0]
    Q, V, F = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID), vector(memory, 1, n, at.A_MID)
    residual = block(memory, 1, n, at.RESIDUAL)
    a = A_stage[0]
    has_tangents = f.force_by_q_given == 1
    last_change, least_size = 0.0, smallest_size(tolerances[RTOL], tolerances[ATOL:])
    for iteration in range(MAX_ITERATIONS):
        w.n_outer += 1
        for m in range(n):
            V[m] = v_bar[m] + z * a[m]
            Q[m] = q_bar[m] + z * V[m]
        code = evaluate(f, w, t, Q, V, options[at.INNER_TOL], F)
        if code != DONE:
            return code
        scale_q, scale_v = least_size, least_size
        for m in range(n):
            residual[0, m] = F[m] - a[m]
        for m in w.independent:
            scale_q = max(scale_q, abs(Q[m]))
            scale_v = max(scale_v, abs(V[m]))
        if f.form != FIXED_ORDER:  # in the fixed-order form, no coordinate is dependent
            for m in w.dependent:
                a[m] = F[m]
        code = _update_derivatives(f, w, options, tolerances, memory, t, h, Q, V, F)
        if code != DONE:
            memory[at.HAS_JACOBIAN] = 0.0
            return code
        if has_dense_tangents(f, w):
            correct_stage(w, memory, residual[0], a)
        else:
            correct_stages(f, w, options, memory, stages_at_once(options), residual, A_stage)
        change = 0.0
        weight = max(z / scale_q, VELOCITY_WEIGHT * min(memory[at.ERROR_DURATION] / scale_q, 1.0 / scale_v))
        for m in w.independent:
            change = max(change, z * abs(residual[0, m]) * weight)
        if not np.isfinite(change):
            return OUTER_DIVERGED
        contraction = 0.0
        if iteration > 0 and last_change > 0.0:
            contraction = change / last_change
            memory[at.CONTRACTION] = contraction
        if has_tangents and change <= options[at.OUTER_TOL]:
            break
        if iteration > 0:
            if contraction > DIVERGENCE_RATIO:
                return OUTER_DIVERGED
            factor = 1.0 if has_tangents else LINEAR_FACTOR
            if contraction < 1.0 and contraction / (1.0 - contraction) * change <= factor * options[at.OUTER_TOL]:
                break
            if contraction > MAX_CONTRACTION and memory[at.IS_FRESH] == 0.0:
                memory[at.HAS_JACOBIAN] = 0.0
        if iteration == MAX_ITERATIONS - 1:
            return OUTER_DIVERGED
        last_change = change
    for m in w.independent:
        V[m] = v_bar[m] + z * a[m]
        Q[m] = q_bar[m] + z * V[m]
    return DONE


N_FILTERS = 3  # how often a difference from the embedded result is filtered; with fewer filters, vibrations may grow

# if the accelerations a_k of the stages jump once, |sum_k jump_weights[k] a_k| is at most this fraction of their range.
# If the fraction is smaller, `_error_at_jumps` reduces its estimate in proportion
MAX_RATIO_BY_ONE_JUMP = 0.174


@compiled
def _filter_errors(f, w, options, memory, h, e_q, e_v):
    """Remove stiff components of the errors (e_q, e_v): multiply by (I - z J)^-1 (J: Jacobian), using stored factors.

    z = h gamma; J is the Jacobian of velocities and accelerations by (q_i, v_i), the independent entries. The estimated
    errors of q and v are the first n_dof entries of e_q and e_v (n_q); the other entries are scratch.
    """
    z = h * gamma_of(options)
    n_dof = w.independent.size
    if has_dense_tangents(f, w):
        filter_dense_error(w, memory, z, e_q[:n_dof], e_v[:n_dof])
    else:
        filter_error(f, w, options, memory, stages_at_once(options), h, e_q, e_v)
    for i in range(n_dof):
        e_q[i] += z * e_v[i]


@compiled
def _factor_filter(f, w, options, memory, h):
    """Factor the matrix that `_filter_errors` needs for steps of size h; return a code."""
    if has_dense_tangents(f, w):
        return factor_newton_matrix(w, memory, h * gamma_of(options))
    return factor_filter(f, w, options, memory, stages_at_once(options), h)


@compiled
def _store_weighted_sums(w, h, V_stage, A_stage, weights, factor, e_q, e_v):
    """Estimate errors of independent q and v: e_q, e_v = h factor sum_k weights[k] (V_stage[k], A_stage[k])."""
    for i in range(w.independent.size):
        j = w.independent[i]
        sum_q, sum_v = 0.0, 0.0
        for k in range(weights.size):
            sum_q += weights[k] * V_stage[k, j]
            sum_v += weights[k] * A_stage[k, j]
        e_q[i] = factor * h * sum_q
        e_v[i] = factor * h * sum_v


@compiled
def _renew_derivatives(f, w, options, tolerances, memory, t, h, new_state):
    """Renew Newton's Jacobian, and its factors for step size h, at a step's end (t, `new_state`); return a code."""
    n = w.Q.size
    Q, V, F = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID), vector(memory, 1, n, at.A_MID)
    copy(new_state[:n], Q)
    copy(new_state[n : 2 * n], V)
    memory[at.HAS_JACOBIAN] = 0.0
    code = evaluate(f, w, t, Q, V, options[at.INNER_TOL], F)
    if code != DONE:
        return code
    multipliers(f, w, t, Q, V, F, w.lam)
    code = fill_derivatives(f, w, options, tolerances, memory, stages_at_once(options), t, Q, V, F)
    if code == DONE:
        code = factor_systems(f, w, options, memory, stages_at_once(options), h)
    if code == DONE:
        memory[at.HAS_JACOBIAN] = 1.0
        memory[at.IS_FRESH] = 0.0
    return code


@compiled
def _estimate(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, weights, factor):
    """Estimate the error of a step by sums of stages times `weights`; return the largest component in tolerances.

    Stiff components do not count, because the estimate is filtered (Hosea and Shampine 1996). If derivatives are so old
    that the filter is wrong, they are computed anew. At the end, E_Q and E_V contain the estimate filtered twice.
    """
    n = w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    e_q, e_v = vector(memory, 1, n, at.E_Q), vector(memory, 1, n, at.E_V)
    unfiltered, filtered_once = vector(memory, 1, n, at.A_NEW), vector(memory, 1, n, at.A_MID)
    n_dof = w.independent.size
    z = h * gamma_of(options)
    _store_weighted_sums(w, h, V_stage, A_stage, weights, factor, e_q, e_v)
    copy(e_v, unfiltered)
    _filter_errors(f, w, options, memory, h, e_q, e_v)
    if f.force_by_q_given == 0 and not derivatives_agree(
        f, w, options, memory, 1, t + h, z, tolerances, unfiltered, e_q, e_v, state, new_state, A_stage[-1]
    ):
        memory[at.DERIVATIVES_RENEWED] = 1.0
        if _renew_derivatives(f, w, options, tolerances, memory, t + h, h, new_state) != DONE:
            return np.inf
        _store_weighted_sums(w, h, V_stage, A_stage, weights, factor, e_q, e_v)
        copy(e_v, unfiltered)
        _filter_errors(f, w, options, memory, h, e_q, e_v)
    error = 0.0
    for i in range(n_dof):
        j = w.independent[i]
        scale = allowed_error(tolerances, j, q[j], q1[j])
        error = max(error, abs(e_q[i]) / scale)
        if options[at.NEWTON_OFFSET + at.TESTS_VELOCITIES] == 1.0:
            scale = allowed_error(tolerances, j, v[j], v1[j])
            error = max(error, abs(e_v[i]) / scale)
    copy(e_v, filtered_once)
    _filter_errors(f, w, options, memory, h, e_q, e_v)
    return max(
        error,
        filtered_velocity_error(
            w, memory, tolerances, z, unfiltered, filtered_once, e_v, state, new_state, A_stage[-1]
        ),
    )


@compiled
def _apply_embedded_formula(f, w, options, memory, h, q1, v1):
    """Replace (q1, v1), the state at the end of the step, by the result of the embedded formula.

    On entry, E_Q and E_V in `memory` must contain the difference of (q1, v1) from this result, filtered twice.
    """
    e_q, e_v = vector(memory, 1, w.Q.size, at.E_Q), vector(memory, 1, w.Q.size, at.E_V)
    for _ in range(2, N_FILTERS):
        _filter_errors(f, w, options, memory, h, e_q, e_v)
    for i in range(w.independent.size):
        q1[w.independent[i]] -= e_q[i]
        v1[w.independent[i]] -= e_v[i]


@compiled
def _error_in_slow_directions(f, w, options, memory, h, tolerances, state, new_state, A_stage):
    """Return the effect on coordinates, in tolerances, of the slowly decaying part of the estimated velocity error E_V.

    If all of E_V has an effect of at most 1, return 0. E_Q, E_V and Newton's factors, in `memory`, are overwritten.
    """
    n = w.Q.size
    e_q, e_v = vector(memory, 1, n, at.E_Q), vector(memory, 1, n, at.E_V)
    max_duration = motion_time(w, tolerances, state, state[2 * n :])
    if memory[at.DERIVATIVES_RENEWED] == 1.0:
        max_duration = max(max_duration, motion_time(w, tolerances, state, A_stage[-1]))
    error = velocity_error(w, tolerances, e_v, max_duration, state, new_state)
    if error <= 1.0:
        return 0.0
    for i in range(w.independent.size):
        e_q[i] = 0.0
    h_longer = STEPS_TO_DECAY * h / gamma_of(options)
    if _factor_filter(f, w, options, memory, h_longer) == DONE:
        _filter_errors(f, w, options, memory, h_longer, e_q, e_v)
        # in unstable motion, the filter's matrix may be nearly singular; then the filtered error is too large
        error = min(error, velocity_error(w, tolerances, e_v, max_duration, state, new_state))
    memory[at.H_FACTORED] = 0.0
    return error


@compiled
def _error_at_jumps(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, jump_weights):
    """Return a second error estimate, in units of the tolerances, for accelerations that jump within the step.

    The first estimate has small weights in the first half of the step, and hardly shows a jump there. `jump_weights`
    (s) belong to another embedded formula. The sum of jump_weights[k] A_stage[k] is zero if the accelerations are
    quadratic in time, small relative to their range if they are smooth, and large if they jump. The second estimate
    is multiplied by the ratio of this sum to the range, so that it is of higher order in smooth motion.
    """
    n = w.Q.size
    deviation, widest = 0.0, 0.0
    for j in w.independent:
        low, high, total = A_stage[0, j], A_stage[0, j], 0.0
        for k in range(jump_weights.size):
            low, high = min(low, A_stage[k, j]), max(high, A_stage[k, j])
            total += jump_weights[k] * A_stage[k, j]
        scale = allowed_error(tolerances, j, state[n + j], new_state[n + j])
        deviation, widest = max(deviation, abs(total) / scale), max(widest, (high - low) / scale)
    if deviation == 0.0:
        return 0.0
    if memory[at.H_FACTORED] == 0.0 and _factor_filter(f, w, options, memory, h) != DONE:
        return np.inf
    factor = min(1.0, deviation / (MAX_RATIO_BY_ONE_JUMP * widest))
    error = _estimate(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, jump_weights, factor)
    if error <= 1.0:
        error = max(error, _error_in_slow_directions(f, w, options, memory, h, tolerances, state, new_state, A_stage))
    return error


@kernel(COMMIT)
def commit_diagonal(f, w, options, memory, tolerances, accepted):
    """Store the accelerations of the last stage of an accepted step, which is the first stage of the next step."""
    if accepted:
        s = int(options[at.DIAGONAL_OFFSET])
        _, A_stage, a_end = stage_views(memory, s, w.Q.size)
        copy(A_stage[s - 1], a_end)  # not accelerations at the new state, where stiffness amplifies Newton's error
        memory[at.IS_FRESH] = 0.0


@kernel(ATTEMPT, vectorized=True)
def diagonal_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step: solve for its stages in turn; if options[-1] is 1, end at the result of the embedded formula."""
    s = int(options[at.DIAGONAL_OFFSET])
    begin = at.DIAGONAL_OFFSET + 1
    A = options[begin : begin + s * s].reshape((s, s))
    c, weights = options[begin + s * s : begin + s * s + s], options[begin + s * s + s : begin + s * s + 2 * s]
    jump_weights = options[begin + s * s + 2 * s : begin + s * s + 3 * s]
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    V_stage, A_stage, a_end = stage_views(memory, s, n)
    if memory[at.HAS_TRIAL] == 0.0 or memory[at.PARTITION_NUMBER] != w.generation:
        memory[at.HAS_TRIAL] = 1.0
        memory[at.PARTITION_NUMBER] = w.generation
        memory[at.HAS_JACOBIAN] = 0.0
        copy(a, a_end)
    if memory[at.IS_FRESH] == 0.0 and memory[at.CONTRACTION] > MAX_CONTRACTION:
        memory[at.HAS_JACOBIAN] = 0.0
    copy(v, V_stage[0])
    copy(a_end, A_stage[0])
    q_bar, v_bar = block(memory, 1, n, at.PREVIOUS)[0], block(memory, 1, n, at.TRIAL)[0]
    Q, V = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID)
    for j in range(1, s):
        for m in range(n):
            sum_q, sum_v = 0.0, 0.0
            for k in range(j):
                sum_q += A[j, k] * V_stage[k, m]
                sum_v += A[j, k] * A_stage[k, m]
            q_bar[m] = q[m] + h * sum_q
            v_bar[m] = v[m] + h * sum_v
        copy(A_stage[j - 1], A_stage[j])
        code = solve_stage(f, w, options, tolerances, memory, t + c[j] * h, h, A_stage[j : j + 1])
        if code != DONE and memory[at.IS_FRESH] == 0.0:
            memory[at.HAS_JACOBIAN] = 0.0
            copy(A_stage[j - 1], A_stage[j])
            code = solve_stage(f, w, options, tolerances, memory, t + c[j] * h, h, A_stage[j : j + 1])
        if code != DONE:
            memory[at.HAS_JACOBIAN] = 0.0
            return Attempt(code, np.inf, 0.0)
        copy(V, V_stage[j])
    copy(V, v1)
    # `prediction_error` compares these positions, predicted by the formula, with positions on the constraints
    for m in w.dependent:
        q1[m] = q_bar[m] + h * A[s - 1, s - 1] * V[m]
    for m in w.independent:
        q1[m] = Q[m]
    error = 0.0
    memory[at.DERIVATIVES_RENEWED] = 0.0
    if tolerances[ESTIMATE] == 1.0:
        error = _estimate(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, weights, 1.0)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
        if options[options.size - 1] == 1.0:
            _apply_embedded_formula(f, w, options, memory, h, q1, v1)
        error = max(error, _error_in_slow_directions(f, w, options, memory, h, tolerances, state, new_state, A_stage))
        if error <= 1.0 and options[options.size - 1] == 0.0:
            error_at_jumps = _error_at_jumps(
                f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, jump_weights
            )
            error = max(error, error_at_jumps)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
    store_prediction(w, q1)
    code = evaluate_state(f, w, t + h, q1, v1, options[at.INNER_TOL], a1, lam1)
    if code == DONE:
        error = max(error, prediction_error(w, tolerances, h, q, v, q1))
    return Attempt(code, error, 0.0)


DIAGONAL = Step(diagonal_step, commit_diagonal)

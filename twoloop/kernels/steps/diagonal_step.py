"""Diagonally implicit Runge-Kutta steps with an explicit first stage (ESDIRK), for stiff problems and few digits.

The stages are found one after another. Newton's method finds the accelerations a of the independent coordinates at
stage j, z = gamma h:

    F(t_j, Q, V) - a = 0,  V = v_j + z a,  Q = q_j + z V,
    v_j = v + h sum_k a_jk a_k,  q_j = q + h sum_k a_jk V_k over the stages before.

The corrections d solve (I - z^2 J_q - z J_v) d = F - a with the derivatives of the right-hand side F. If the system
gives tangents, each iterate has its own derivatives: stiff directions turn as the body moves, and after the turn of a
large step an older matrix no longer contracts. Methods whose stages are solved together, as in newton_step.py, share
one matrix.

The dense matrix of one iteration from tangents is factored as it stands, T^T (M - z^2 K - z D) T, whereas
newton_systems.py first applies the inverse of T^T M T to the derivatives, for many systems. This is half the work
where a matrix serves one iteration only.

With step-size control TR-BDF2 continues from the embedded formula of order 3, with the difference filtered three times,
which keeps the method L-stable: then the errors of many short steps add up to the tolerance, and not to the tolerance
times their number.
"""

import numpy as np

from twoloop.kernels.control.step_size import departure, store_prediction
from twoloop.kernels.data.common import ATTEMPT, SETTLE, Attempt, Step, allowed, compiled, inlined, kernel, merged
from twoloop.kernels.data.indices import (
    BANDWIDTH,
    DONE,
    ESTIMATE,
    FORCE_BY_Q_GIVEN,
    FORCE_BY_V_GIVEN,
    FORM,
    GENERATION,
    N_FACTORIZATIONS,
    N_JACOBIANS,
    N_OUTER,
    OUTER_DIVERGED,
    SINGULAR,
    STATIC,
)
from twoloop.kernels.evaluation.inner_loop import evaluate, evaluate_state, find_tangents, multipliers
from twoloop.kernels.linalg.dense import copy, ldl_factor, ldl_solve, lu_factor, lu_solve
from twoloop.kernels.steps import stages as at
from twoloop.kernels.steps.newton_systems import (
    SAME_STEP,
    correct,
    derivatives_at,
    factor_filter,
    factor_systems,
    filter_error,
    reduce,
    tangent_by_q,
    tangent_by_v,
)
from twoloop.kernels.steps.stages import (
    INNER_TOL,
    OUTER_TOL,
    PLACE,
    STAGES,
    TAIL,
    block,
    pivots_of,
    space,
    square,
    vector,
)
from twoloop.kernels.steps.velocity_errors import (
    STEPS_TO_DECAY,
    derivatives_agree,
    filtered_velocity_error,
    motion_time,
    velocity_error,
)

ASYMMETRY = 1e-12  # relative to the largest entry: a smaller asymmetry is rounding


@compiled
def _symmetric(A):
    largest, off = 0.0, 0.0
    for i in range(A.shape[0]):
        largest = max(largest, abs(A[i, i]))
        for j in range(i):
            off = max(off, abs(A[i, j] - A[j, i]))
    return off <= ASYMMETRY * largest


@compiled
def _fill(w, memory, n, m, z, H):
    """Compute the matrix T^T M T - z^2 T^T K T - z T^T D T into H."""
    N, Kr, Dr = space(w, n, at.SYSTEMS), space(w, n, at.BY_Q), space(w, n, at.BY_V)
    square = z * z
    if memory[at.DAMPED] == 1.0:
        for i in range(m * m):
            H[i] = N[i] - square * Kr[i] - z * Dr[i]
    else:
        for i in range(m * m):
            H[i] = N[i] - square * Kr[i]


@compiled
def refactor(w, memory, z):
    """Factor the matrix for another z, with the tangents of the last state."""
    n, m = w.Q.size, w.independent.size
    numbers = space(w, n, at.FILTER)
    H = square(numbers, m)
    w.counters[N_FACTORIZATIONS] += 1
    _fill(w, memory, n, m, z, numbers)
    memory[at.SYMMETRIC] = 0.0
    if _symmetric(H):
        if ldl_factor(H):
            memory[at.SYMMETRIC] = 1.0
            return DONE
        _fill(w, memory, n, m, z, numbers)  # not definite, such as for a compressed beam
    return DONE if lu_factor(H, pivots_of(memory, 1, n, 0)) > 0.0 else SINGULAR


@compiled
def factor_iteration(f, w, memory, t, q, v, z):
    """Factor the matrix at a state that was just evaluated, with its multipliers in w.lam."""
    n = q.size
    m = w.independent.size
    w.counters[N_JACOBIANS] += 1
    numbers = space(w, n, at.FILTER)
    K, R = numbers.reshape((n, n)), space(w, n, at.SYSTEMS).reshape((n, n))
    AT = space(w, n, at.SYSTEMS + 1)[: n * m].reshape((n, m))
    code = tangent_by_q(f, w, t, q, v, n - 1, vector(memory, 1, n, at.Q_MOVED), K, R)
    if code == DONE:
        code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    reduce(w, K, AT, square(space(w, n, at.BY_Q), m))
    memory[at.DAMPED] = f.flags[FORCE_BY_V_GIVEN]
    code = tangent_by_v(f, t, q, v, n - 1, K)
    if code != DONE:
        return code
    if memory[at.DAMPED] == 1.0:
        reduce(w, K, AT, square(space(w, n, at.BY_V), m))
    reduce(w, w.M, AT, square(space(w, n, at.SYSTEMS), m))
    return refactor(w, memory, z)


@compiled
def _solve_iteration(w, memory, x):
    m = x.size
    H = square(space(w, w.Q.size, at.FILTER), m)
    if memory[at.SYMMETRIC] == 1.0:
        ldl_solve(H, x)
    else:
        lu_solve(H, pivots_of(memory, 1, w.Q.size, 0), x)


@compiled
def solve_iteration(w, memory, residual, a):
    """Add the correction to the independent coordinates of a; the residual (n_q) becomes the correction."""
    n = w.Q.size
    m = w.independent.size
    N, x = square(space(w, n, at.SYSTEMS), m), vector(memory, 1, n, at.V_MOVED)[:m]
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += N[i, j] * residual[w.independent[j]]
        x[i] = total
    _solve_iteration(w, memory, x)
    for i in range(m):
        residual[w.independent[i]] = x[i]
        a[w.independent[i]] += x[i]


@compiled
def filter_by_iteration(w, memory, z, e_q, e_v):
    """Replace e_v (n_dof) by (I - z^2 J_q - z J_v)^-1 (e_v + z J_q e_q)."""
    n = w.Q.size
    m = e_q.size
    N, Kr = square(space(w, n, at.SYSTEMS), m), square(space(w, n, at.BY_Q), m)
    x = vector(memory, 1, n, at.V_MOVED)[:m]
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += N[i, j] * e_v[j] + z * Kr[i, j] * e_q[j]
        x[i] = total
    _solve_iteration(w, memory, x)
    copy(x, e_v)


MAX_ITERATIONS = 8
GROWTH = 2.0  # growth of a correction above which the iteration fails
SHARE_IF_LINEAR = 0.01  # relative to the tolerance of the outer loop, if the iteration does not converge quadratically
KEEP_CONTRACTION = 0.1  # contraction up to which differenced derivatives are reused
SHARE_OF_VELOCITY = 0.1  # weight of a correction measured by the position error that its velocity causes


@inlined
def stages_of(memory, s, n):
    """Return views: velocities and accelerations of the stages, accelerations at the end of the last step."""
    last = memory.size - n
    return (
        memory[last - 2 * s * n : last - s * n].reshape((s, n)),
        memory[last - s * n : last].reshape((s, n)),
        memory[last:],
    )


@merged
def gamma_of(options):
    """Return gamma, the diagonal entry of A."""
    s = int(options[TAIL])
    return options[TAIL + s * s]


@merged
def _set_stage_state(z, q_bar, v_bar, a, Q, V):
    """Set the independent Q and V from the acceleration a of the stage, and start values of the dependent ones."""
    for m in range(Q.size):
        V[m] = v_bar[m] + z * a[m]
        Q[m] = q_bar[m] + z * V[m]


@merged
def has_dense_tangents(f, w):
    """Return whether each iteration factors a matrix of its own, T^T (M - z^2 K - z D) T."""
    return (
        f.flags[FORCE_BY_Q_GIVEN] == 1
        and f.flags[BANDWIDTH] < 0
        and w.Rate.size == w.C.size
        and f.flags[FORM] != STATIC
    )


@merged
def one_stage_of(options):
    """Return the number of stages, 1; a literal 1 would make the compiler specialize newton_systems.py for it."""
    return int(options[STAGES])


@compiled
def _prepare(f, w, options, memory, t, h, Q, V, F):
    """Prepare factors for an iteration at (Q, V), just evaluated, with accelerations F; return the code."""
    if f.flags[FORCE_BY_Q_GIVEN] == 1 or memory[at.HAS_JACOBIAN] == 0.0:
        multipliers(f, w, t, Q, V, F, w.lam)
        memory[at.HAS_JACOBIAN] = 1.0
        memory[at.FRESH] = 1.0
        memory[at.H_FACTORED] = 0.0
        if has_dense_tangents(f, w):
            return factor_iteration(f, w, memory, t, Q, V, h * gamma_of(options))
        code = derivatives_at(f, w, options, memory, one_stage_of(options), t, Q, V, F)
        if code != DONE:
            return code
    if abs(memory[at.H_FACTORED] - h) > SAME_STEP * h:
        return factor_systems(f, w, options, memory, one_stage_of(options), h)
    return DONE


@compiled
def solve_stage(f, w, options, memory, t, h, A_stage):
    """Solve one stage by Newton's method from A_stage (1, n_q), with (Q, V) in Q_MID, V_MID; return the code."""
    n = w.Q.size
    z = h * gamma_of(options)
    q_bar, v_bar = block(memory, 1, n, at.PREVIOUS)[0], block(memory, 1, n, at.TRIAL)[0]
    Q, V, F = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID), vector(memory, 1, n, at.A_MID)
    residual = block(memory, 1, n, at.RESIDUAL)
    a = A_stage[0]
    tangents_given = f.flags[FORCE_BY_Q_GIVEN] == 1
    before = 0.0
    for iteration in range(MAX_ITERATIONS):
        w.counters[N_OUTER] += 1
        _set_stage_state(z, q_bar, v_bar, a, Q, V)
        code = evaluate(f, w, t, Q, V, options[INNER_TOL], F)
        if code != DONE:
            return code
        scale_q, scale_v = 1.0, 1.0
        for m in range(n):
            residual[0, m] = F[m] - a[m]
        for m in w.independent:
            scale_q = max(scale_q, abs(Q[m]))
            scale_v = max(scale_v, abs(V[m]))
        if f.flags[FORM] != STATIC:  # with the static form no coordinate is dependent
            for m in w.dependent:
                a[m] = F[m]
        code = _prepare(f, w, options, memory, t, h, Q, V, F)
        if code != DONE:
            memory[at.HAS_JACOBIAN] = 0.0
            return code
        if has_dense_tangents(f, w):
            solve_iteration(w, memory, residual[0], a)
        else:
            correct(f, w, options, memory, one_stage_of(options), residual, A_stage)
        change = 0.0
        share = max(z / scale_q, SHARE_OF_VELOCITY * min(memory[at.DURATION] / scale_q, 1.0 / scale_v))
        for m in w.independent:
            change = max(change, z * abs(residual[0, m]) * share)
        if not np.isfinite(change):
            return OUTER_DIVERGED
        contraction = 0.0
        if iteration > 0 and before > 0.0:
            contraction = change / before
            memory[at.CONTRACTION] = contraction
        if tangents_given and change <= options[OUTER_TOL]:
            break
        if iteration > 0:
            if contraction > GROWTH:
                return OUTER_DIVERGED
            share = 1.0 if tangents_given else SHARE_IF_LINEAR
            if contraction < 1.0 and contraction / (1.0 - contraction) * change <= share * options[OUTER_TOL]:
                break
            if contraction > KEEP_CONTRACTION and memory[at.FRESH] == 0.0:
                memory[at.HAS_JACOBIAN] = 0.0
        if iteration == MAX_ITERATIONS - 1:
            return OUTER_DIVERGED
        before = change
    for m in w.independent:
        V[m] = v_bar[m] + z * a[m]
        Q[m] = q_bar[m] + z * V[m]
    return DONE


# number of filters: with fewer, extrapolation is unstable for vibrations, see tests/kernels/test_diagonal.py
N_FILTERS = 3

# largest error of `lower` at a jump, relative to the width of the accelerations: its difference then counts in full
JUMP_SHARE = 0.174


@compiled
def _filter(f, w, options, memory, h, e_q, e_v):
    """Apply (I - z J)^-1 to (e_q, e_v) by the last factors, J being the Jacobian of (v, F); n_dof numbers each."""
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
    """Compute the factors that `_filter` uses for steps of h; return the code."""
    if has_dense_tangents(f, w):
        return refactor(w, memory, h * gamma_of(options))
    return factor_filter(f, w, options, memory, one_stage_of(options), h)


@compiled
def _difference(w, h, V_stage, A_stage, weights, share, e_q, e_v):
    """Compute `share` times h times the weighted sum of the stages, for the independent coordinates (n_dof)."""
    for i in range(w.independent.size):
        j = w.independent[i]
        in_q, in_v = 0.0, 0.0
        for k in range(weights.size):
            in_q += weights[k] * V_stage[k, j]
            in_v += weights[k] * A_stage[k, j]
        e_q[i] = share * h * in_q
        e_v[i] = share * h * in_v


@compiled
def _renew_derivatives(f, w, options, memory, t, h, new_state):
    """Compute derivatives at the end of the step, and their factors; return the code."""
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
    """Return the largest component of `share` times the weighted sum of stages, over atol + rtol |value|.

    The sum is filtered by the last factors (Hosea and Shampine 1996), so that stiff components do not count.
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
    if f.flags[FORCE_BY_Q_GIVEN] == 0 and not derivatives_agree(
        f, w, options, memory, 1, t + h, z, tolerances, raw, e_q, e_v, state, new_state, A_stage[-1]
    ):
        memory[at.CHANGED] = 1.0
        if _renew_derivatives(f, w, options, memory, t + h, h, new_state) != DONE:
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
    return max(error, filtered_velocity_error(w, memory, tolerances, z, raw, once, e_v, state, new_state, A_stage[-1]))


@compiled
def _extrapolate(f, w, options, memory, h, q1, v1):
    """Replace the end of the step by that of the embedded formula; the difference has been filtered twice before."""
    e_q, e_v = vector(memory, 1, w.Q.size, at.E_Q), vector(memory, 1, w.Q.size, at.E_V)
    for _ in range(2, N_FILTERS):
        _filter(f, w, options, memory, h, e_q, e_v)
    for i in range(w.independent.size):
        q1[w.independent[i]] -= e_q[i]
        v1[w.independent[i]] -= e_v[i]


@compiled
def _slow_error(f, w, options, memory, h, tolerances, state, new_state, A_stage):
    """Return the error that velocity errors (E_V) leave in slow directions, as in newton_step.py."""
    n = w.Q.size
    e_q, e_v = vector(memory, 1, n, at.E_Q), vector(memory, 1, n, at.E_V)
    longest = motion_time(w, tolerances, state, state[2 * n :])
    if memory[at.CHANGED] == 1.0:
        longest = max(longest, motion_time(w, tolerances, state, A_stage[-1]))
    error = velocity_error(w, tolerances, e_v, longest, state, new_state)
    if error <= 1.0:
        return 0.0
    for i in range(w.independent.size):
        e_q[i] = 0.0
    longer = STEPS_TO_DECAY * h / gamma_of(options)
    if _factor_filter(f, w, options, memory, longer) == DONE:
        _filter(f, w, options, memory, longer, e_q, e_v)
        # where the motion is unstable the system may be nearly singular, and the solution too large
        error = min(error, velocity_error(w, tolerances, e_v, longest, state, new_state))
    memory[at.H_FACTORED] = 0.0
    return error


@compiled
def _error_at_jumps(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, lower):
    """Return the error that `lower`, the weights of another embedded formula, shows where accelerations jump.

    The weights of the first formula are so small at the stages of the first half that a jump there hardly shows.
    `lower` is exact for accelerations quadratic in time. The error of smooth ones is a small share of their width: its
    difference is multiplied by this share, which makes it of a higher order than the first estimate.
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
    share = min(1.0, missed / (JUMP_SHARE * widest))
    error = _error(f, w, options, memory, t, h, tolerances, state, new_state, V_stage, A_stage, lower, share)
    if error <= 1.0:
        error = max(error, _slow_error(f, w, options, memory, h, tolerances, state, new_state, A_stage))
    return error


@kernel(SETTLE)
def settle_diagonal(f, w, options, memory, tolerances, accepted):
    """Store the last stage of an accepted step, which is the first of the next one."""
    if accepted:
        s = int(options[TAIL])
        _, A_stage, a_end = stages_of(memory, s, w.Q.size)
        copy(A_stage[s - 1], a_end)  # F at the state would be the residual of Newton's method times the stiffness
        memory[at.FRESH] = 0.0


@kernel(ATTEMPT, vectorized=True)
def diagonal_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step: solve the stages one after another; the last one is the end of the step."""
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
    if memory[at.FRESH] == 0.0 and memory[at.CONTRACTION] > KEEP_CONTRACTION:
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
    for m in w.dependent:  # prediction by the formula, to be compared with the values that the constraints give
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
    store_prediction(w, q1)
    code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    if code == DONE:
        error = max(error, departure(w, tolerances, h, q, v, q1))
    return Attempt(code, error, 0.0)


DIAGONAL = Step(diagonal_step, settle_diagonal)

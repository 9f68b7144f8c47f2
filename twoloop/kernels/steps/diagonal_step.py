"""Diagonally implicit Runge-Kutta steps with an explicit first stage (ESDIRK), for stiff problems and few digits.

One stage after another, Newton's method finds the accelerations a of the independent coordinates, z = gamma h:

    F(t_j, Q, V) - a = 0,  V = v_j + z a,  Q = q_j + z V,

where v_j = v + h sum_k a_jk a_k and q_j = q + h sum_k a_jk V_k over the stages before. The corrections d solve
(I - z^2 J_q - z J_v) d = F - a with the derivatives of the two-loop right-hand side F, see newton_step.py. Where the
system gives tangents, they are those of each iterate: stiff directions turn as the body moves, and after the turn of a
large step an older matrix no longer contracts. The stages of a method with eigenvalues of its own per stage cannot do
so.

With step-size control TR-BDF2 goes on from its embedded formula of order 3, the difference to it filtered three times,
which leaves the method L-stable: so the errors of many short steps add up to the tolerance, and not to their number
times it.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control.predictor import departure, keep_predicted
from twoloop.kernels.data.codes import DONE, OUTER_DIVERGED
from twoloop.kernels.data.common import ATTEMPT, SETTLE, Attempt, Step, compiled, inlined, kernel, merged
from twoloop.kernels.data.counters import N_OUTER
from twoloop.kernels.data.flags import BANDWIDTH, FORCE_BY_Q_GIVEN, FORM, STATIC
from twoloop.kernels.data.noted import GENERATION
from twoloop.kernels.data.tolerances import ESTIMATE, allowed
from twoloop.kernels.evaluation.calls import evaluate, evaluate_state, multipliers
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.iteration_matrix import factor_iteration, filter_by_iteration, solve_iteration
from twoloop.kernels.steps.lasting import lasting_error
from twoloop.kernels.steps.newton_memory import block, memory_size, vector
from twoloop.kernels.steps.newton_operator import SAME_STEP, correct, derivatives_at, factor_systems, filter_error
from twoloop.kernels.steps.stages import INNER_TOL, N_SCALARS, OUTER_TOL, STAGES, options_array

MAX_ITERATIONS = 8
GROWTH = 2.0  # of a correction, from which the iteration is given up
SHARE_IF_LINEAR = 0.01  # of the tolerance of the outer loop, where it does not converge quadratically
KEPT_WHILE = 0.1  # contraction up to which derivatives that were differenced serve on
SHARE_OF_VELOCITY = 0.1  # what a correction counts as by the position that its velocity leads to
FILTERED = 3  # times: with fewer the extrapolated method is unstable for vibrations, see tests/kernels/test_diagonal.py

# `options` are those of a Newton method of one stage, A = [[gamma]]; then this method's stages, A, c and b - b^, and 1
# if steps with an error estimate go on from the embedded formula
PLACE = N_SCALARS + 2 + 5
TAIL = PLACE + at.N_EIGEN_SCALARS + 1 + 2 + 4


def diagonal_options(
    A: ArrayLike, c: ArrayLike, weights: ArrayLike, inner_tol: float, outer_tol: float, velocities: bool, embedded: bool
) -> NDArray[np.float64]:
    """The parameter block: A (s, s) with zeros in its first row and gamma on the diagonal below, b its last row.

    `embedded`: the embedded formula is the one of higher order, from which steps go on.
    """
    A, c, weights = (np.asarray(x, dtype=np.float64) for x in (A, c, weights))
    gamma = A[-1, -1]
    one_stage = options_array([[gamma]], [1.0], [1.0], inner_tol, outer_tol, 0.0)
    newton = np.array([1.0, 0.0, gamma, float(velocities), 0.0, gamma, 0.0, 1.0, 0.0, 1.0, 0.0])
    return np.concatenate([one_stage, newton, [float(c.size)], A.ravel(), c, weights, [float(embedded)]])


def diagonal_memory(s: int, n_q: int) -> NDArray[np.float64]:
    """`memory`: that of a Newton method of one stage, then velocities and accelerations of the stages, (s, n_q) each.

    Last come the accelerations (n_q) that the last stage of the last accepted step ended with.
    """
    return np.zeros(memory_size(1, 1, n_q) + (2 * s + 1) * n_q)


@inlined
def _stages(memory, s, n):
    """Velocities and accelerations of the stages, and the accelerations at the end of the last accepted step."""
    last = memory.size - n
    return (
        memory[last - 2 * s * n : last - s * n].reshape((s, n)),
        memory[last - s * n : last].reshape((s, n)),
        memory[last:],
    )


@merged
def _gamma(options):
    s = int(options[TAIL])
    return options[TAIL + s * s]


@merged
def _place(w, z, q_bar, v_bar, a, Q, V):
    """Independents of Q and V as the stage's acceleration a puts them; dependents, where Newton starts."""
    for m in range(Q.size):
        V[m] = v_bar[m] + z * a[m]
        Q[m] = q_bar[m] + z * V[m]


@merged
def _dense_tangents(f, w):
    """Whether each iteration has a matrix of its own that is factored as it stands."""
    return (
        f.flags[FORCE_BY_Q_GIVEN] == 1
        and f.flags[BANDWIDTH] < 0
        and w.Rate.size == w.C.size
        and f.flags[FORM] != STATIC
    )


@merged
def _one(options):
    """The one stage, as a number that numba does not know: so it has what newton_step.py calls compiled already."""
    return int(options[STAGES])


@compiled
def _prepare(f, w, options, memory, t, h, Q, V, F):
    """The factors for an iteration at (Q, V), evaluated just before with accelerations F: DONE, or why not."""
    if f.flags[FORCE_BY_Q_GIVEN] == 1 or memory[at.HAS_JACOBIAN] == 0.0:
        multipliers(f, w, t, Q, V, F, w.lam)
        memory[at.HAS_JACOBIAN] = 1.0
        memory[at.FRESH] = 1.0
        memory[at.H_FACTORED] = 0.0
        if _dense_tangents(f, w):
            return factor_iteration(f, w, memory, t, Q, V, h * _gamma(options))
        code = derivatives_at(f, w, options, memory, _one(options), t, Q, V, F)
        if code != DONE:
            return code
    if abs(memory[at.H_FACTORED] - h) > SAME_STEP * h:
        return factor_systems(f, w, options, memory, _one(options), h)
    return DONE


@compiled
def solve_stage(f, w, options, memory, t, h, tolerances, A_stage):
    """Newton's method for one stage, predicted in A_stage (1, n_q): DONE, or why not; (Q, V) in Q_MID, V_MID."""
    n = w.Q.size
    z = h * _gamma(options)
    q_bar, v_bar = block(memory, 1, n, at.PREVIOUS)[0], block(memory, 1, n, at.TRIAL)[0]
    Q, V, F = vector(memory, 1, n, at.Q_MID), vector(memory, 1, n, at.V_MID), vector(memory, 1, n, at.A_MID)
    residual = block(memory, 1, n, at.RESIDUAL)
    a = A_stage[0]
    tangents_given = f.flags[FORCE_BY_Q_GIVEN] == 1
    before = 0.0
    for iteration in range(MAX_ITERATIONS):
        w.counters[N_OUTER] += 1
        _place(w, z, q_bar, v_bar, a, Q, V)
        code = evaluate(f, w, t, Q, V, options[INNER_TOL], F)
        if code != DONE:
            return code
        scale_q, scale_v = 1.0, 1.0
        for m in range(n):
            residual[0, m] = F[m] - a[m]
        for m in w.independent:
            scale_q = max(scale_q, abs(Q[m]))
            scale_v = max(scale_v, abs(V[m]))
        if f.flags[FORM] != STATIC:  # where none is dependent
            for m in w.dependent:
                a[m] = F[m]
        code = _prepare(f, w, options, memory, t, h, Q, V, F)
        if code != DONE:
            memory[at.HAS_JACOBIAN] = 0.0
            return code
        if _dense_tangents(f, w):
            solve_iteration(w, memory, residual[0], a)
        else:
            correct(f, w, options, memory, _one(options), residual, A_stage)
        change = 0.0
        share = max(z / scale_q, SHARE_OF_VELOCITY * min(memory[at.LASTING] / scale_q, 1.0 / scale_v))
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
            if contraction > KEPT_WHILE and memory[at.FRESH] == 0.0:
                memory[at.HAS_JACOBIAN] = 0.0
        if iteration == MAX_ITERATIONS - 1:
            return OUTER_DIVERGED
        before = change
    for m in w.independent:
        V[m] = v_bar[m] + z * a[m]
        Q[m] = q_bar[m] + z * V[m]
    return DONE


@compiled
def _filter(f, w, options, memory, h, e_q, e_v):
    """(I - z J)^-1 (e_q, e_v) by the last factors, J being the Jacobian of (v, F); all n_dof numbers in (n_q)."""
    z = h * _gamma(options)
    count = w.independent.size
    if _dense_tangents(f, w):
        filter_by_iteration(w, memory, z, e_q[:count], e_v[:count])
    else:
        filter_error(f, w, options, memory, _one(options), h, e_q, e_v)
    for i in range(count):
        e_q[i] += z * e_v[i]


@compiled
def _error(f, w, options, memory, h, tolerances, state, new_state, V_stage, A_stage, weights):
    """Largest component, over atol + rtol |value|, of the difference to the embedded formula.

    It is filtered by the last factors (Hosea and Shampine 1996): what is stiff has no part in it.
    """
    n = w.Q.size
    q, v, q1, v1 = state[:n], state[n : 2 * n], new_state[:n], new_state[n : 2 * n]
    e_q, e_v = vector(memory, 1, n, at.E_Q), vector(memory, 1, n, at.E_V)
    raw, once = vector(memory, 1, n, at.A_NEW), vector(memory, 1, n, at.A_MID)
    count = w.independent.size
    for i in range(count):
        j = w.independent[i]
        in_q, in_v = 0.0, 0.0
        for k in range(weights.size):
            in_q += weights[k] * V_stage[k, j]
            in_v += weights[k] * A_stage[k, j]
        e_q[i] = h * in_q
        e_v[i] = h * in_v
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
    z = h * _gamma(options)
    return max(error, lasting_error(w, memory, tolerances, z, raw, once, e_v, state, new_state))


@compiled
def _extrapolate(f, w, options, memory, h, q1, v1):
    """From the end of the step by the formula to that of the embedded one; its difference was filtered twice."""
    e_q, e_v = vector(memory, 1, w.Q.size, at.E_Q), vector(memory, 1, w.Q.size, at.E_V)
    for _ in range(2, FILTERED):
        _filter(f, w, options, memory, h, e_q, e_v)
    for i in range(w.independent.size):
        q1[w.independent[i]] -= e_q[i]
        v1[w.independent[i]] -= e_v[i]


@kernel(SETTLE)
def settle_diagonal(f, w, options, memory, tolerances, accepted):
    """The last stage of an accepted step is the first of the next one."""
    if accepted:
        s = int(options[TAIL])
        _, A_stage, a_end = _stages(memory, s, w.Q.size)
        copy(A_stage[s - 1], a_end)  # F at the state would magnify what Newton's method left by stiffness
        memory[at.FRESH] = 0.0


@kernel(ATTEMPT, vectorized=True)
def diagonal_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt: the stages one after another, the last of which is the end of the step."""
    s = int(options[TAIL])
    o = TAIL + 1
    A = options[o : o + s * s].reshape((s, s))
    c, weights = options[o + s * s : o + s * s + s], options[o + s * s + s : o + s * s + 2 * s]
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    V_stage, A_stage, a_end = _stages(memory, s, n)
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
        code = solve_stage(f, w, options, memory, t + c[j] * h, h, tolerances, A_stage[j : j + 1])
        if code != DONE and memory[at.FRESH] == 0.0:
            memory[at.HAS_JACOBIAN] = 0.0
            copy(A_stage[j - 1], A_stage[j])
            code = solve_stage(f, w, options, memory, t + c[j] * h, h, tolerances, A_stage[j : j + 1])
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
    if tolerances[ESTIMATE] == 1.0:
        error = _error(f, w, options, memory, h, tolerances, state, new_state, V_stage, A_stage, weights)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
        if options[options.size - 1] == 1.0:
            _extrapolate(f, w, options, memory, h, q1, v1)
    keep_predicted(w, q1)
    code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    if code == DONE:
        error = max(error, departure(w, tolerances, h, q, v, q1))
    return Attempt(code, error, 0.0)


DIAGONAL = Step(diagonal_step, settle_diagonal)

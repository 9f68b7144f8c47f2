"""Implicit Runge-Kutta steps: the outer loop by fixed point, and Richardson's error estimate around it.

Two outer loops are available: `iterate_accelerations` iterates on the stage accelerations alone (the tableau applied
twice to q'' = a), `iterate_first_order` is the paper's loop on y_i = [v_i, q_i]. Equation numbers are the paper's.
"""

import numpy as np

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control.compensated_sums import N_RESTS, compensated, forget, keep_rest, rests
from twoloop.kernels.control.controller import nothing_to_settle
from twoloop.kernels.control.convergence import CONVERGED, MAX_ITERATIONS, UNDECIDED, judged
from twoloop.kernels.control.predictor import restore_predicted
from twoloop.kernels.control.richardson import conclude
from twoloop.kernels.data.common import (
    ATTEMPT,
    DONE,
    ESTIMATE,
    N_OUTER,
    OUTER_DIVERGED,
    SETTLE,
    Attempt,
    Step,
    compiled,
    inlined,
    kernel,
    merged,
)
from twoloop.kernels.evaluation.calls import accelerations, evaluate, restore
from twoloop.kernels.steps.stages import (
    EXTRAPOLATION,
    FARTHEST,
    INNER_TOL,
    OUTER_TEST,
    OUTER_TOL,
    STAGES,
    end_error,
    interpolate,
    tableau_of,
)

MAX_ITERATIONS_PAPER = 200  # the paper names no limit; (33) ends a divergent loop long before
SHARE_BESIDE = 0.01  # of end_error, beside Richardson's estimate: it is there for jumps between ends and stages
SUDDEN = 10.0  # what that has to be in the paper's procedure, which has no such estimate, before it counts

# places in `memory`: scalars, then stage blocks (s, n_q) and vectors (n_q)
HAS_TRIAL, H_TRIAL, HAS_PREVIOUS, H_PREVIOUS, N_MEMORY_SCALARS = range(5)
PREVIOUS, TRIAL, HALF, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
Q_FULL, V_FULL, Q_MID, V_MID, A_MID, Q_OLD, V_OLD, REST, N_VECTORS = (*range(8), 7 + N_RESTS)


def memory_size(s: int, n_q: int) -> int:
    """Length of `memory` for s stages and n_q coordinates."""
    return N_MEMORY_SCALARS + N_BLOCKS * s * n_q + N_VECTORS * n_q + s


@inlined
def _block(memory, s, n, which):
    start = N_MEMORY_SCALARS + which * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def _vector(memory, s, n, which):
    start = N_MEMORY_SCALARS + N_BLOCKS * s * n + which * n
    return memory[start : start + n]


@compiled
def iterate_accelerations(f, w, options, tolerances, t, h, q, v, A_stage, Q_stage, V_stage, q1, v1, rest):
    """One step of size h from (q, v), a fixed-point iteration on the stage accelerations.

    A_stage holds their prediction on entry.
    Q_j = q + c_j h v + h^2 sum_k (A A)_jk a_k and V_j = v + h sum_k A_jk a_k have the same solution as (17); for
    undamped systems the iteration's rate is the square of the first-order one. On return A_stage has converged and
    (q1, v1) is the end of the step, on the constraints. The sums are compensated where `rest` has rows. Returns the
    code, and how far the prediction of the dependents was off.
    """
    s, A, A2, b, bA, c = tableau_of(options)
    n = q.size
    tolerance = options[INNER_TOL]
    for j in range(s):
        for m in range(n):
            total = 0.0
            for k in range(s):
                total += A2[j, k] * A_stage[k, m]
            Q_stage[j, m] = q[m] + c[j] * h * v[m] + h * h * total
    first = 0.0
    before = np.inf
    verdict = UNDECIDED
    for iteration in range(MAX_ITERATIONS):
        w.counters[N_OUTER] += 1
        # all stages are set before any is evaluated: Gauss-Seidel would converge for smaller h only
        for j in range(s):
            for m in w.independent:
                in_q = 0.0
                in_v = 0.0
                for k in range(s):
                    in_q += A2[j, k] * A_stage[k, m]
                    in_v += A[j, k] * A_stage[k, m]
                Q_stage[j, m] = q[m] + c[j] * h * v[m] + h * h * in_q
                V_stage[j, m] = v[m] + h * in_v
        change = 0.0
        for j in range(s):
            code = evaluate(f, w, t + c[j] * h, Q_stage[j], V_stage[j], tolerance, q1)
            if code != DONE:
                return code, 0.0
            for m in w.independent:
                difference = h * abs(q1[m] - A_stage[j, m])
                change = max(change, difference / max(abs(V_stage[j, m]), 1.0))
                change = max(change, h * difference / max(abs(Q_stage[j, m]), 1.0))
            copy(q1, A_stage[j])
        if iteration == 0:
            first = change
        verdict = judged(change, before, first, iteration, options[OUTER_TOL], q)
        if verdict != UNDECIDED:
            break
        before = change
    if verdict != CONVERGED:
        return OUTER_DIVERGED, 0.0
    for m in range(n):
        in_q = 0.0
        in_v = 0.0
        for k in range(s):
            in_q += bA[k] * A_stage[k, m]
            in_v += b[k] * A_stage[k, m]
        if rest.shape[0] == 0:
            q1[m] = q[m] + h * v[m] + h * h * in_q
            v1[m] = v[m] + h * in_v
        else:
            q1[m], rest[2, m] = compensated(q[m], rest[0, m], h * v[m] + h * h * in_q)
            v1[m], rest[3, m] = compensated(v[m], rest[1, m], h * in_v)
    forget(w.dependent, rest)
    return restore_predicted(f, w, tolerances, t + h, h, q, v, q1, v1, tolerance)


@merged
def _largest_change(coordinates, q, v, q_old, v_old):
    change = 0.0
    for m in coordinates:
        change = max(change, abs(q[m] - q_old[m]) / max(abs(q[m]), 1.0))
        change = max(change, abs(v[m] - v_old[m]) / max(abs(v[m]), 1.0))
    return change


@compiled
def iterate_first_order(f, w, options, t, h, q, v, a, A_stage, Q_stage, V_stage, q_old, v_old, q1, v1):
    """One step of size h by the paper's outer loop on y_i = [v_i, q_i]: explicit Euler start, tests (32) and (33).

    `a` is the acceleration at (t, q, v); K_j = [a_j; v_j] are the rows of A_stage and V_stage. An iteration goes from
    stage to stage with the latest K, in the manner of Gauss and Seidel. On return (q1, v1) is the end of the step, on
    the constraints.
    """
    s, A, _, b, _, c = tableau_of(options)
    n = q.size
    tolerance = options[INNER_TOL]
    for m in range(n):
        q1[m] = q[m] + h * v[m]
        v1[m] = v[m] + h * a[m]
    code = evaluate(f, w, t + h, q1, v1, tolerance, A_stage[0])
    if code != DONE:
        return code
    for j in range(s):
        copy(A_stage[0], A_stage[j])
        copy(v1, V_stage[j])
        copy(q1, Q_stage[j])
    norm_before = np.inf
    for _ in range(MAX_ITERATIONS_PAPER):
        w.counters[N_OUTER] += 1
        for j in range(s):
            for m in w.independent:
                in_q = 0.0
                in_v = 0.0
                for k in range(s):
                    in_q += A[j, k] * V_stage[k, m]
                    in_v += A[j, k] * A_stage[k, m]
                Q_stage[j, m] = q[m] + h * in_q
                V_stage[j, m] = v[m] + h * in_v
            code = evaluate(f, w, t + c[j] * h, Q_stage[j], V_stage[j], tolerance, A_stage[j])
            if code != DONE:
                return code
        copy(q1, q_old)
        copy(v1, v_old)
        for m in w.independent:
            in_q = 0.0
            in_v = 0.0
            for k in range(s):
                in_q += b[k] * V_stage[k, m]
                in_v += b[k] * A_stage[k, m]
            q1[m] = q[m] + h * in_q
            v1[m] = v[m] + h * in_v
        code = restore(f, w, t + h, q1, v1, tolerance)
        if code != DONE:
            return code
        change = _largest_change(w.independent, q1, v1, q_old, v_old)
        if options[OUTER_TEST] == 1.0:
            change = max(change, _largest_change(w.dependent, q1, v1, q_old, v_old))
        if change <= options[OUTER_TOL]:  # (32)
            return DONE
        norm = 0.0
        for m in range(n):
            norm += (q1[m] - q_old[m]) ** 2 + (v1[m] - v_old[m]) ** 2
        norm = np.sqrt(norm)
        if not norm <= norm_before:  # (33)
            return OUTER_DIVERGED
        norm_before = norm
    return OUTER_DIVERGED


@inlined
def _rests_of(memory, s, n, tolerances):
    return rests(memory[N_MEMORY_SCALARS + (N_BLOCKS * s + REST) * n :], n, tolerances)


@kernel(SETTLE)
def settle_runge_kutta(f, w, options, memory, tolerances, accepted):
    """The stages of an accepted step are what the next one is predicted from."""
    s, n = int(options[STAGES]), w.Q.size
    if accepted and memory[HAS_TRIAL] == 1.0:
        previous, trial = _block(memory, s, n, PREVIOUS), _block(memory, s, n, TRIAL)
        for j in range(s):
            copy(trial[j], previous[j])
        memory[H_PREVIOUS] = memory[H_TRIAL]
        memory[HAS_PREVIOUS] = 1.0
        keep_rest(_rests_of(memory, s, n, tolerances))
    memory[HAS_TRIAL] = 0.0


@kernel(ATTEMPT)
def runge_kutta_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt, a fixed-point iteration on the accelerations; to estimate the error, a step of h and two of h/2.

    The result is that of the half steps, or with EXTRAPOLATION = 1 / (2^order - 1) their extrapolation with the whole
    step, put back on the constraints. Stages are predicted from the polynomial through the stage accelerations of the
    last accepted step, those of the half steps from the whole step's.
    """
    s, _, _, _, _, c = tableau_of(options)
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    previous = _block(memory, s, n, PREVIOUS)
    trial = _block(memory, s, n, TRIAL)
    half = _block(memory, s, n, HALF)
    Q_stage = _block(memory, s, n, Q_STAGE)
    V_stage = _block(memory, s, n, V_STAGE)
    q_full, v_full = _vector(memory, s, n, Q_FULL), _vector(memory, s, n, V_FULL)
    q_mid, v_mid = _vector(memory, s, n, Q_MID), _vector(memory, s, n, V_MID)
    weights = memory[memory.size - s :]
    rest = _rests_of(memory, s, n, tolerances)
    ratio = h / memory[H_PREVIOUS] if memory[HAS_PREVIOUS] == 1.0 else np.inf
    for j in range(s):
        if ratio <= FARTHEST:
            interpolate(c, 1.0 + ratio * c[j], previous, weights, trial[j])
        else:
            copy(a, trial[j])
    code, off = iterate_accelerations(f, w, options, tolerances, t, h, q, v, trial, Q_stage, V_stage, q1, v1, rest)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        copy(q1, q_full)
        copy(v1, v_full)
        for j in range(s):
            interpolate(c, 0.5 * c[j], trial, weights, half[j])
        g = 0.5 * h
        code, off_mid = iterate_accelerations(
            f, w, options, tolerances, t, g, q, v, half, Q_stage, V_stage, q_mid, v_mid, rest
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        for j in range(s):
            interpolate(c, 0.5 + 0.5 * c[j], trial, weights, half[j])
        code, off = iterate_accelerations(
            f, w, options, tolerances, t + g, g, q_mid, v_mid, half, Q_stage, V_stage, q1, v1, rest
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        off = max(off, off_mid)  # of the two half steps, from which the run goes on
        code, error = conclude(
            f, w, options[EXTRAPOLATION], options[INNER_TOL], t + h, tolerances, q, v, q_full, v_full, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    memory[HAS_TRIAL] = 1.0
    memory[H_TRIAL] = h
    if code == DONE and tolerances[ESTIMATE] == 1.0:
        error = max(error, SHARE_BESIDE * end_error(tolerances, options, h, state, new_state, trial))
    return Attempt(code, max(error, off), 0.0)


@kernel(ATTEMPT)
def paper_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt in the manner of the paper (Sects. 3.1-3.3): a step of h, two of h/2, their difference the error."""
    s, _, _, _, _, _ = tableau_of(options)
    n = w.Q.size
    q, v, a = state[:n], state[n : 2 * n], state[2 * n : 3 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    A_stage = _block(memory, s, n, TRIAL)
    A_full = _block(memory, s, n, HALF)
    Q_stage = _block(memory, s, n, Q_STAGE)
    V_stage = _block(memory, s, n, V_STAGE)
    q_full, v_full = _vector(memory, s, n, Q_FULL), _vector(memory, s, n, V_FULL)
    q_mid, v_mid, a_mid = _vector(memory, s, n, Q_MID), _vector(memory, s, n, V_MID), _vector(memory, s, n, A_MID)
    q_old, v_old = _vector(memory, s, n, Q_OLD), _vector(memory, s, n, V_OLD)
    code = iterate_first_order(f, w, options, t, h, q, v, a, A_stage, Q_stage, V_stage, q_old, v_old, q1, v1)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        copy(q1, q_full)
        copy(v1, v_full)
        for j in range(s):
            copy(A_stage[j], A_full[j])
        g = 0.5 * h
        code = iterate_first_order(f, w, options, t, g, q, v, a, A_stage, Q_stage, V_stage, q_old, v_old, q_mid, v_mid)
        if code == DONE:
            code = accelerations(f, w, t + g, q_mid, v_mid, a_mid, w.lam)
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        code = iterate_first_order(
            f, w, options, t + g, g, q_mid, v_mid, a_mid, A_stage, Q_stage, V_stage, q_old, v_old, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        code, error = conclude(
            f, w, options[EXTRAPOLATION], options[INNER_TOL], t + h, tolerances, q, v, q_full, v_full, q1, v1
        )
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    code = accelerations(f, w, t + h, q1, v1, a1, lam1)
    if code == DONE and tolerances[ESTIMATE] == 1.0:
        beside = SHARE_BESIDE * end_error(tolerances, options, h, state, new_state, A_full)
        if error <= 1.0 and beside > SUDDEN:
            error = beside
    return Attempt(code, error, 0.0)


RUNGE_KUTTA = Step(runge_kutta_step, settle_runge_kutta)
PAPER = Step(paper_step, nothing_to_settle)

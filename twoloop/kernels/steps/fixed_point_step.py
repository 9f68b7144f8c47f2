"""Implicit Runge-Kutta steps whose outer loop is a fixed point, with Richardson's error estimate around it."""

import numpy as np

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control.compensated_sums import N_RESTS, keep_rest, rests
from twoloop.kernels.control.controller import nothing_to_settle
from twoloop.kernels.control.richardson import conclude
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import ATTEMPT, SETTLE, Attempt, Step, inlined, kernel
from twoloop.kernels.data.tolerances import ESTIMATE
from twoloop.kernels.evaluation.calls import accelerations
from twoloop.kernels.steps.fixed_point_loops import iterate_accelerations, iterate_first_order
from twoloop.kernels.steps.stages import EXTRAPOLATION, FARTHEST, INNER_TOL, STAGES, end_error, interpolate, tableau_of

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

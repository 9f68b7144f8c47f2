"""Steps of the backward differentiation formulas whose outer loop is Newton's method, for stiff problems.

The formula y = p + c (y' - p') is a stage of diagonal_stage.py with z = c: V = v_bar + c a and Q = q_bar + c V, where
v_bar and q_bar are p - c p'. History, estimates and orders are those of bdf_step.py.
"""

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control.predictor import keep_predicted
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import ATTEMPT, SETTLE, Attempt, Step, compiled, kernel
from twoloop.kernels.data.noted import GENERATION
from twoloop.kernels.evaluation.calls import evaluate_state
from twoloop.kernels.steps import bdf_step as bdf
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.diagonal_stage import KEPT_WHILE, diagonal_options, solve_stage
from twoloop.kernels.steps.newton_memory import block, vector

# of gamma = 1: its step is c
ONE_STAGE = ([[0.0, 0.0], [0.0, 1.0]], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0])


def newton_options(max_order: int, inner_tol: float, outer_tol: float) -> NDArray[np.float64]:
    """The parameter block: scalars as in bdf_step.py, then that of the stage."""
    stage = diagonal_options(*ONE_STAGE, inner_tol, outer_tol, True, False)
    return np.concatenate([[float(max_order), inner_tol, outer_tol], stage])


def newton_memory(n_q: int) -> NDArray[np.float64]:
    """`memory`: that of bdf_step.py, with that of a Newton method of one stage in the place of scratch."""
    return np.zeros(bdf.memory_size(n_q) + at.memory_size(1, 1, n_q))


@compiled
def _correct(f, w, options, memory, tolerances, t, c, prediction, rate, new_state):
    """Solve y = prediction + c (y' - rate) at t by Newton's method; on return the whole new state is consistent."""
    n = w.Q.size
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    q_bar, v_bar = block(memory, 1, n, at.PREVIOUS)[0], block(memory, 1, n, at.TRIAL)[0]
    for m in range(n):
        q_bar[m] = prediction[m] - c * rate[m]
        v_bar[m] = prediction[n + m] - c * rate[n + m]
    memory[at.LASTING] = np.inf  # errors of velocities are tested
    if memory[at.PARTITION_NUMBER] != w.notes[GENERATION]:
        memory[at.PARTITION_NUMBER] = w.notes[GENERATION]
        memory[at.HAS_JACOBIAN] = 0.0
    if memory[at.FRESH] == 0.0 and memory[at.CONTRACTION] > KEPT_WHILE:
        memory[at.HAS_JACOBIAN] = 0.0
    while True:
        copy(rate[n:], a1)
        code = solve_stage(f, w, options[bdf.N_SCALARS :], memory, t, c, a1.reshape((1, n)))
        if code == DONE:
            break
        stale = memory[at.FRESH] == 0.0
        memory[at.HAS_JACOBIAN] = 0.0
        if not stale:
            return code
    copy(vector(memory, 1, n, at.V_MID), v1)
    for m in range(n):  # dependents as the formula has them, beside those that the constraints give
        q1[m] = q_bar[m] + c * v1[m]
    keep_predicted(w, q1)
    return evaluate_state(f, w, t, q1, v1, options[bdf.INNER_TOL], a1, lam1)


@kernel(SETTLE)
def settle_bdf_newton(f, w, options, memory, tolerances, accepted):
    """Make the trial differences the history, if the attempt was accepted; its state is another than the last."""
    bdf.settle(memory, w.Q.size, accepted)
    if accepted:
        _, _, _, _, newton = bdf.blocks_of(memory, w.Q.size)
        newton[at.FRESH] = 0.0


@kernel(ATTEMPT)
def bdf_newton_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt, as in bdf_step.py; also with fixed steps the order rises from 1."""
    blocks = bdf.blocks_of(memory, w.Q.size)
    _, _, prediction, rate, newton = blocks
    c = bdf.spread(h, bdf.begin_step(memory, blocks, state, h, 1.0))
    code = _correct(f, w, options, newton, tolerances, t + h, c, prediction, rate, new_state)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    return bdf.end_step(w, options, memory, blocks, h, tolerances, state, new_state)


BDF_NEWTON = Step(bdf_newton_step, settle_bdf_newton)

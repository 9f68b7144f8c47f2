"""One stage of a diagonally implicit method: Newton's method for its accelerations.

Newton's method finds the accelerations a of the independent coordinates, z = gamma h:

    F(t_j, Q, V) - a = 0,  V = v_j + z a,  Q = q_j + z V,

where v_j and q_j are what the stages before leave. The corrections d solve (I - z^2 J_q - z J_v) d = F - a with the
derivatives of the two-loop right-hand side F, see newton_step.py. Where the system gives tangents, they are those of
each iterate: stiff directions turn as the body moves, and after the turn of a large step an older matrix no longer
contracts. The stages of a method with eigenvalues of its own per stage cannot do so.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.data.codes import DONE, OUTER_DIVERGED
from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.data.counters import N_OUTER
from twoloop.kernels.data.flags import BANDWIDTH, FORCE_BY_Q_GIVEN, FORM, STATIC
from twoloop.kernels.evaluation.inner_loop import evaluate, multipliers
from twoloop.kernels.steps import newton_memory as at
from twoloop.kernels.steps.iteration_matrix import factor_iteration, solve_iteration
from twoloop.kernels.steps.newton_memory import block, memory_size, vector
from twoloop.kernels.steps.newton_operator import SAME_STEP, correct, derivatives_at, factor_systems
from twoloop.kernels.steps.stages import INNER_TOL, N_SCALARS, OUTER_TOL, STAGES, options_array

MAX_ITERATIONS = 8
GROWTH = 2.0  # of a correction, from which the iteration is given up
SHARE_IF_LINEAR = 0.01  # of the tolerance of the outer loop, where it does not converge quadratically
KEPT_WHILE = 0.1  # contraction up to which derivatives that were differenced serve on
SHARE_OF_VELOCITY = 0.1  # what a correction counts as by the position that its velocity leads to

# `options` are those of a Newton method of one stage, A = [[gamma]]; then this method's stages, A, c and b - b^, and 1
# if steps with an error estimate go on from the embedded formula
PLACE = N_SCALARS + 2 + 5
TAIL = PLACE + at.N_EIGEN_SCALARS + 1 + 2 + 4


def diagonal_options(
    A: ArrayLike,
    c: ArrayLike,
    weights: ArrayLike,
    lower: ArrayLike,
    inner_tol: float,
    outer_tol: float,
    velocities: bool,
    embedded: bool,
) -> NDArray[np.float64]:
    """The parameter block: A (s, s) with zeros in its first row and gamma on the diagonal below, b its last row.

    `lower`: weights of the estimate where accelerations jump.
    `embedded`: the embedded formula is the one of higher order, from which steps go on.
    """
    A, c, weights, lower = (np.asarray(x, dtype=np.float64) for x in (A, c, weights, lower))
    gamma = A[-1, -1]
    one_stage = options_array([[gamma]], [1.0], [1.0], inner_tol, outer_tol, 0.0)
    newton = np.array([1.0, 0.0, gamma, float(velocities), 0.0, gamma, 0.0, 1.0, 0.0, 1.0, 0.0])
    return np.concatenate([one_stage, newton, [float(c.size)], A.ravel(), c, weights, lower, [float(embedded)]])


def diagonal_memory(s: int, n_q: int) -> NDArray[np.float64]:
    """`memory`: that of a Newton method of one stage, then velocities and accelerations of the stages, (s, n_q) each.

    Last come the accelerations (n_q) that the last stage of the last accepted step ended with.
    """
    return np.zeros(memory_size(1, 1, n_q) + (2 * s + 1) * n_q)


@inlined
def stages_of(memory, s, n):
    """Velocities and accelerations of the stages, and the accelerations at the end of the last accepted step."""
    last = memory.size - n
    return (
        memory[last - 2 * s * n : last - s * n].reshape((s, n)),
        memory[last - s * n : last].reshape((s, n)),
        memory[last:],
    )


@merged
def gamma_of(options):
    """The diagonal entry of A."""
    s = int(options[TAIL])
    return options[TAIL + s * s]


@merged
def _place(z, q_bar, v_bar, a, Q, V):
    """Independents of Q and V as the stage's acceleration a puts them; dependents, where Newton starts."""
    for m in range(Q.size):
        V[m] = v_bar[m] + z * a[m]
        Q[m] = q_bar[m] + z * V[m]


@merged
def has_dense_tangents(f, w):
    """Whether each iteration has a matrix of its own that is factored as it stands."""
    return (
        f.flags[FORCE_BY_Q_GIVEN] == 1
        and f.flags[BANDWIDTH] < 0
        and w.Rate.size == w.C.size
        and f.flags[FORM] != STATIC
    )


@merged
def one_stage_of(options):
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
    """Newton's method for one stage, predicted in A_stage (1, n_q): DONE, or why not; (Q, V) in Q_MID, V_MID."""
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
        _place(z, q_bar, v_bar, a, Q, V)
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
        if has_dense_tangents(f, w):
            solve_iteration(w, memory, residual[0], a)
        else:
            correct(f, w, options, memory, one_stage_of(options), residual, A_stage)
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

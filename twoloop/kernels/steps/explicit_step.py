"""Step of an explicit Runge-Kutta method: each stage is one evaluation, and there is no outer loop.

The method integrates the independent positions and velocities (q_i, v_i). The first stage is the state at the beginning
of the step, and two embedded formulas estimate the error. By default, the inner loop computes the dependent coordinates
of every stage, so that all stages satisfy the constraints. With options[FREE] = 1, unlike in the paper, the method
integrates dependent coordinates, too: stages violate the constraints slightly, and only the end of the step is
projected. `f` is the kit (functions of the system), and `w` the workspace (arrays that kernels write).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.kernels.control.step_size import commit_nothing, prediction_error, store_prediction
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, compiled, gap_ratio, inlined, kernel
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, RTOL
from twoloop.kernels.evaluation.inner_loop import evaluate, evaluate_state, evaluate_without_projection, project
from twoloop.kernels.linalg.dense import copy, sum_rows

# indices of the scalars in the array `options`. STAGES: number of stages s. INNER_TOL: tolerance of the inner loop.
# FREE: 1 if stages are not projected, else 0. THETA: a projection has converged if its last correction is at most this.
# After the scalars: Butcher tableau A (s, s), b (s), c (s), and the weights of the two error estimates (s each)
STAGES, INNER_TOL, FREE, THETA, N_SCALARS = range(5)
# indices of vectors in the array `memory`. STAGE_STATE: state [q, v] of a stage. FINE_ERROR, COARSE_ERROR: estimates
# of the error of [q, v]. The derivatives [v, a] of the s stages follow. Vectors have 2 n_q numbers and padding
STAGE_STATE, FINE_ERROR, COARSE_ERROR, N_VECTORS = range(4)
BLOCK_SIZE = 8  # vectors are padded to a multiple of this size, so that loops over them have no remainder


def options_array(
    A: ArrayLike,
    b: ArrayLike,
    c: ArrayLike,
    fine: ArrayLike,
    coarse: ArrayLike,
    inner_tol: float,
    free: bool = False,
    theta: float = 0.0,
) -> NDArray[np.float64]:
    """Return the array `options` of `explicit_step` for the Butcher tableau A (s, s), b (s), c (s) of s stages.

    `fine`, `coarse`: weights (s) of the two error estimates. `inner_tol`: tolerance of the inner loop. `free`: whether
    stages are not projected. `theta`: a projection has converged if its last correction is at most this.
    """
    A, b, c, fine, coarse = (np.asarray(x, dtype=float) for x in (A, b, c, fine, coarse))
    s = b.size
    if A.shape != (s, s) or not c.size == fine.size == coarse.size == s:
        shapes = ", ".join(str(x.shape) for x in (A, b, c, fine, coarse))
        raise ValueError(f"A, b, c, fine and coarse must be (s, s), (s,), (s,), (s,), (s,); given {shapes}")
    if np.triu(A).any() or c[0] != 0.0:
        raise ValueError("A must be strictly lower triangular and c[0] = 0: the first stage is the state itself")
    return np.concatenate([[float(s), inner_tol, float(free), theta], A.ravel(), b, c, fine, coarse])


def memory_size(s: int, n_q: int) -> int:
    """Return the length of `memory`, the work array of `explicit_step`, for s stages and n_q coordinates."""
    return (N_VECTORS + s) * (-(-2 * n_q // BLOCK_SIZE) * BLOCK_SIZE)


@inlined
def _padded_width(n):
    return (2 * n + BLOCK_SIZE - 1) // BLOCK_SIZE * BLOCK_SIZE


@inlined
def tableau_of(options):
    """Return the number of stages s and views of `options`: A, b, c and the weights (s) of both error estimates."""
    s = int(options[STAGES])
    o = N_SCALARS
    A = options[o : o + s * s].reshape((s, s))
    o += s * s
    return s, A, options[o : o + s], options[o + s : o + 2 * s], options[o + 2 * s : o + 3 * s], options[o + 3 * s :]


@inlined
def _vector_view(memory, n, index):
    """Return a view (2 n, padded) of the vector with this `index`, such as STAGE_STATE, in `memory`."""
    return memory[index * _padded_width(n) : (index + 1) * _padded_width(n)]


@compiled
def _add_weighted_slopes(y, h, weights, slopes, total, y1):
    """Store the sum of weights[k] * slopes[k] in `total`, then y + h * total in y1; adding y last reduces rounding."""
    sum_rows(weights, slopes, total)
    for m in range(y.size):
        y1[m] = y[m] + h * total[m]


@compiled
def largest_error(tolerances, y, y1, fine_error, coarse_error, strict):
    """Return the estimated error of a step from state y = (q, v) to y1 (2 n each), in units of the tolerances.

    Let e and d be the largest components of `fine_error` and `coarse_error` (2 n each), relative to atol + rtol |y|.
    The result is e^2 / sqrt(e^2 + d^2); if `strict` (near a singular position, where terms of high order are not
    small), e^(3/2) / (e^2 + d^2)^(1/4). The formula is not applied to single components: where a coarse estimate is
    zero by chance, the result would be e, which is of low order, and steps would need up to 30 % more evaluations.
    """
    n = fine_error.size // 2
    rtol = tolerances[RTOL]
    e = e_v = d = d_v = 0.0
    for m in range(n):
        k, atol = n + m, tolerances[ATOL + m]
        weight = 1.0 / (atol + rtol * max(abs(y[m]), abs(y1[m])))
        weight_v = 1.0 / (atol + rtol * max(abs(y[k]), abs(y1[k])))
        e, e_v = max(e, abs(fine_error[m] * weight)), max(e_v, abs(fine_error[k] * weight_v))
        d, d_v = max(d, abs(coarse_error[m] * weight)), max(d_v, abs(coarse_error[k] * weight_v))
    e, d = max(e, e_v), max(d, d_v)
    if e == 0.0:
        return 0.0
    ratio = e / np.hypot(e, d)
    return e * (np.sqrt(ratio) if strict else ratio)


@compiled
def _estimate_error(tolerances, h, fine, coarse, y, y1, slopes, fine_error, coarse_error, strict):
    """Store both error estimates of a step, h * fine @ slopes and h * coarse @ slopes; return their `largest_error`."""
    sum_rows(fine, slopes, fine_error)
    sum_rows(coarse, slopes, coarse_error)
    for m in range(y.size):
        fine_error[m] *= h
        coarse_error[m] *= h
    return largest_error(tolerances, y, y1, fine_error[: y.size], coarse_error[: y.size], strict)


@kernel(ATTEMPT, vectorized=True)
def explicit_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step of size h; reject it before its end is projected if the estimated error exceeds the tolerance."""
    s, A, b, c, fine, coarse = tableau_of(options)
    n = w.Q.size
    q, v, y, y1 = state[:n], state[n : 2 * n], state[: 2 * n], new_state[: 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    stage, fine_error, coarse_error = (
        _vector_view(memory, n, STAGE_STATE),
        _vector_view(memory, n, FINE_ERROR),
        _vector_view(memory, n, COARSE_ERROR),
    )
    begin, width = N_VECTORS * _padded_width(n), _padded_width(n)
    slopes = memory[begin : begin + s * width].reshape((s, width))  # velocities and accelerations of each stage
    # near a singular position, all stages are projected: unprojected ones could be beyond it or have wrong velocities
    is_near = options[FREE] == 1.0 and w.nearly_singular != 0.0
    is_free = options[FREE] == 1.0 and not is_near
    ratio_to_gap = gap_ratio(tolerances, h)
    if ratio_to_gap > 0.0 and not is_free:
        return Attempt(DONE, ratio_to_gap, 1.0 / ratio_to_gap)
    w.n_outer += 1
    copy(state[n : 3 * n], slopes[0])
    for j in range(1, s):
        _add_weighted_slopes(y, h, A[j, :j], slopes, stage, stage)  # dependent coordinates in `stage` are first guesses
        v_stage, a_stage = slopes[j, :n], slopes[j, n : 2 * n]
        copy(stage[n : 2 * n], v_stage)
        if is_free:
            code = evaluate_without_projection(f, w, t + c[j] * h, stage[:n], v_stage, a_stage)
        else:
            code = evaluate(f, w, t + c[j] * h, stage[:n], v_stage, options[INNER_TOL], a_stage)
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
    _add_weighted_slopes(y, h, b, slopes, stage, y1)
    error = 0.0
    if tolerances[ESTIMATE] == 1.0:
        error = _estimate_error(tolerances, h, fine, coarse, y, y1, slopes, fine_error, coarse_error, is_near)
        if not error <= 1.0:
            return Attempt(DONE, error, 0.0)
    store_prediction(w, q1)
    if is_free:
        code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    else:
        code = evaluate_state(f, w, t + h, q1, v1, options[INNER_TOL], a1, lam1)
    if code == DONE:
        error = max(error, prediction_error(w, tolerances, h, q, v, q1))
    return Attempt(code, error, 0.0)


EXPLICIT = Step(explicit_step, commit_nothing)

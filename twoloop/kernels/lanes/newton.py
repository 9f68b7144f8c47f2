"""Steps of implicit Runge-Kutta methods in lanes by Newton's method, as in steps/newton_step.py, for stiff motion.

The unknowns are the accelerations a_j of all coordinates at the stages,

    F(t_j, Q_j, V_j) - a_j = 0,  Q_j = q + c_j h v + h^2 sum_k (A A)_jk a_k,  V_j = v + h sum_k A_jk a_k,

with the matrix A and the nodes c of the tableau. F are accelerations at a state that is not projected: stages violate
the constraints by the error of the formula, and only the end of the step is projected. In each step, derivatives of F
are computed anew, by finite differences. Offsets and names in capitals belong to arrays in `work`, see layout.py.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, kernel, limited_size, max_change_by_rounding, merged, smallest_size
from twoloop.kernels.lanes import layout as at
from twoloop.kernels.lanes.control import LEAST, N_HEAD, begin_control, choose_steps, end_steps, judge_steps, set_end
from twoloop.kernels.lanes.layout import (
    LANES,
    STEP,
    add_product,
    copy_vectors,
    factor_matrices,
    fill_field,
    matrix_view,
    offsets_in_work,
    raise_to_ratio,
    solve_systems,
    vector_range,
)
from twoloop.kernels.linalg.dense import sum_rows
from twoloop.kernels.steps.newton_systems import MAX_ITERATIONS, MAX_ROUNDING_CORRECTION, displaced
from twoloop.kernels.steps.stages import (
    GAMMA0,
    MAX_STEP_RATIO,
    N_EIGEN_SCALARS,
    N_REAL,
    OUTER_TOL,
    TESTS_VELOCITIES,
    count_systems,
    middle_node,
    newton_options_index,
    tableau_of,
)
from twoloop.kernels.steps.velocity_errors import LONGEST_GAPS, SLOW_FACTOR, STEPS_TO_DECAY

# offsets of single vectors in the method's memory, before the blocks of vectors
(
    ITERATING,  # 1 in lanes where Newton's iteration has not ended
    DONE,  # 1 in lanes where Newton's iteration has converged (not the status code of this name)
    CHANGE_BEFORE,  # largest correction by the previous iteration, relative to SCALE_Q and SCALE_V
    SCALE_Q,  # largest absolute position at the stages, at least the result of `_smallest_size`
    SCALE_V,  # largest absolute velocity at the stages, at least the result of `_smallest_size`
    LARGEST_Q,  # largest correction of a stage's position by this iteration, divided by the square of the step size
    LARGEST_V,  # largest correction of a stage's velocity by this iteration, divided by the step size
    H_PREVIOUS,  # size (s) of the step whose accelerations are in PREVIOUS; 0: there is no such step
    CONSTANT,  # 1: the predicted accelerations of all stages equal those at the beginning of the step; else 0
    DURATION,  # time (s) until a velocity error changes its sign or decays, see velocity_errors.py; 0: not known
    N_SINGLE_VECTORS,
) = range(11)
# indices of blocks of n vectors in the method's memory (n: number of coordinates)
(
    START,  # accelerations at the beginning of the next step
    BEGIN_Q,  # q at the beginning of this step; the next two blocks contain v and a there
    BEGIN_V,
    BEGIN_A,
    SUMS,  # scratch, mostly for sums over stages, such as sum_k A_jk a_k
    MIDDLE_Q,  # q in the middle of the step; the next two blocks contain v and a there
    MIDDLE_V,
    MIDDLE_A,
    E_Q,  # estimated error of q at the end of the step; the next block contains the estimated error of v
    E_V,
    UNFILTERED,  # estimated error of v before `_filter_errors` is called
    FILTERED_ONCE,  # estimated error of v after the first call of `_filter_errors`
    COMPLEX,  # scratch: real part of the right-hand side and solution of a linear system
    _IMAGINARY,  # scratch: imaginary part of the right-hand side and solution of a linear system
    N_VECTORS,
) = range(15)
# indices of blocks of s n vectors (s stages, n coordinates) in the method's memory
# - STAGES: accelerations at the stages of this step; PREVIOUS: accelerations at the stages of the previous step
# - RESIDUAL: residuals of Newton's method; CHANGES: corrections of the accelerations by Newton's method
STAGES, PREVIOUS, RESIDUAL, CHANGES, N_BLOCKS = range(5)
# indices of matrices (n, n) in the method's memory. DERIVATIVE_Q, DERIVATIVE_V: derivatives of the accelerations by q
# and by v. From SYSTEMS on, the real and imaginary parts of the matrix follow for each linear system of the method
DERIVATIVE_Q, DERIVATIVE_V, SYSTEMS = range(3)


def memory_size(s: int, n: int) -> int:
    """Return the length of the method's memory for s stages and n coordinates, in vectors with one number per lane."""
    n_systems = (s + 1) // 2  # one linear system for each real eigenvalue and each complex pair of the tableau's matrix
    return N_SINGLE_VECTORS + (N_VECTORS + N_BLOCKS * s + n_systems) * n + s * s + (SYSTEMS + 2 * n_systems) * n * n


@merged
def vector_offset(memory, n, block):
    """Return the offset of `block`, such as START: n vectors (one number per lane) in memory at offset `memory`."""
    return memory + N_SINGLE_VECTORS + block * n


@merged
def block_offset(memory, n, s, block):
    """Return the offset of `block`, such as STAGES: s * n vectors (a number per lane) in memory at offset `memory`."""
    return memory + N_SINGLE_VECTORS + (N_VECTORS + block * s) * n


@merged
def _weights_offset(memory, n, s):
    """Return the offset of the weights (s, s): `predict_stages` multiplies the block PREVIOUS by these."""
    return memory + N_SINGLE_VECTORS + (N_VECTORS + N_BLOCKS * s) * n


@merged
def matrix_offset(memory, n, s, index):
    """Return the offset of a matrix (n, n); `index`: DERIVATIVE_Q, DERIVATIVE_V, or SYSTEMS + 2 k (linear system k)."""
    return _weights_offset(memory, n, s) + s * s + index * n * n


@merged
def pivots_offset(memory, n, s, n_systems, k):
    """Return the offset of the pivots (n) of linear system number k."""
    return matrix_offset(memory, n, s, SYSTEMS + 2 * n_systems) + k * n


@compiled
def _evaluate_middle_state(code, settings, control, c, work, new, a, memory):
    """Store in MIDDLE_Q, MIDDLE_V and MIDDLE_A a state in the middle of the step, and its accelerations.

    The state is extrapolated from the beginning of the step. One correction moves the positions to the constraints.
    """
    n, order = settings[at.N], settings[at.ORDER]
    node, begin = middle_node(c), vector_offset(memory, n, BEGIN_Q)
    for k in range(LANES):
        x = node * work[at.X * LANES + k]
        work[at.T_NEW * LANES + k] = work[at.T * LANES + k] + x
        for j in range(n):
            index = (begin + j) * LANES + k
            q, v, a0 = work[index], work[index + n * LANES], work[index + 2 * n * LANES]
            work[(new + j) * LANES + k] = q + x * (v + 0.5 * x * a0)
            work[(new + n + j) * LANES + k] = v + x * a0
    code.correct_positions(order, control, work)
    code.compute_accelerations(order, control, work)
    copy_vectors(work, new, vector_offset(memory, n, MIDDLE_Q), 2 * n)
    copy_vectors(work, a, vector_offset(memory, n, MIDDLE_A), n)


@merged
def _smallest_size(control, n):
    return smallest_size(control[at.RTOL], control[at.ATOL : at.ATOL + n])


@merged
def _store_typical_size(control, work, n, vector):
    """Store in DISPLACED the typical size of q or v (at offset `vector`), for displacements in finite differences."""
    least = _smallest_size(control, n)
    for k in range(LANES):
        largest = 0.0
        for j in range(n):
            largest = max(largest, abs(work[(vector + j) * LANES + k]))
        work[at.DISPLACED * LANES + k] = limited_size(largest, least)
        work[at.LARGEST * LANES + k] = largest


@compiled
def compute_derivatives(code, settings, control, c, work):
    """Store DERIVATIVE_Q and DERIVATIVE_V, derivatives of accelerations by q and v, in the middle of the step.

    The middle is the node nearest to 1/2, because forces that act only between two nodes must not affect the step.
    """
    n, order = settings[at.N], settings[at.ORDER]
    _, new, _, _, a, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    s = c.size
    _evaluate_middle_state(code, settings, control, c, work, new, a, memory)
    middle, middle_a = vector_offset(memory, n, MIDDLE_Q), vector_offset(memory, n, MIDDLE_A)
    for column in range(2 * n):
        if column % n == 0:
            _store_typical_size(control, work, n, middle + column)
        copy_vectors(work, middle, new, 2 * n)
        for k in range(LANES):
            index = (new + column) * LANES + k
            sizes = work[at.DISPLACED * LANES + k], work[at.LARGEST * LANES + k]
            work[index] = displaced(work[index], *sizes, control[at.RTOL], control[at.ATOL + column % n])
        code.compute_accelerations(order, control, work)
        matrix = matrix_offset(memory, n, s, DERIVATIVE_Q if column < n else DERIVATIVE_V) + column % n
        for k in range(LANES):
            per_displacement = 1.0 / (work[(new + column) * LANES + k] - work[(middle + column) * LANES + k])
            for i in range(n):
                change = work[(a + i) * LANES + k] - work[(middle_a + i) * LANES + k]
                work[(matrix + i * n) * LANES + k] = change * per_displacement


@compiled
def factor_systems_of_lanes(settings, method_options, s, work):
    """Factor the matrices I - z^2 J_q - z J_v of Newton's method; J_q, J_v: derivatives of accelerations by q, v.

    In each lane, z is the step size X (s) times an eigenvalue of the tableau's A (one eigenvalue of a complex pair).
    """
    n = settings[at.N]
    memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])[7]
    n_systems, offset = count_systems(method_options, s), newton_options_index(s)
    n_real = int(method_options[offset + N_REAL])
    offset += N_EIGEN_SCALARS + s
    by_q, by_v = matrix_offset(memory, n, s, DERIVATIVE_Q), matrix_offset(memory, n, s, DERIVATIVE_V)
    for system in range(n_systems):
        re, im = method_options[offset], method_options[offset + 1]
        offset += 2 + 4 * s
        matrix, apart = matrix_offset(memory, n, s, SYSTEMS + 2 * system), n * n * LANES
        for i in range(n * n):
            diagonal = 1.0 if i % (n + 1) == 0 else 0.0
            for k in range(LANES):
                x = work[at.X * LANES + k]
                q, v = x * x * work[(by_q + i) * LANES + k], x * work[(by_v + i) * LANES + k]
                work[(matrix + i) * LANES + k] = diagonal - (re * re - im * im) * q - re * v
                work[(matrix + i) * LANES + k + apart] = -2.0 * re * im * q - im * v
        pivots = pivots_offset(memory, n, s, n_systems, system)
        factor_matrices(work, matrix, pivots, n, 0 if system < n_real else n * n)


@compiled
def predict_stages(settings, c, work, begins):
    """Predict the accelerations at the stages, STAGES: evaluate the polynomial through the accelerations in PREVIOUS.

    PREVIOUS belongs to the last accepted step. If the new step size X exceeds MAX_STEP_RATIO times the size of that
    step, the polynomial would be extrapolated too far: then all predictions are the accelerations where the new step
    begins. `begins`: 1 if the new step begins at the end of the accepted step, 0 if at the beginning of that step.
    """
    n = settings[at.N]
    memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])[7]
    s = c.size
    weights, stages = _weights_offset(memory, n, s), block_offset(memory, n, s, STAGES)
    previous, a = block_offset(memory, n, s, PREVIOUS), vector_offset(memory, n, BEGIN_A)
    for k in range(LANES):
        h_previous = work[(memory + H_PREVIOUS) * LANES + k]
        ratio = work[at.X * LANES + k] / h_previous if h_previous > 0.0 else np.inf
        has_previous = 1.0 if ratio <= MAX_STEP_RATIO else 0.0
        work[(memory + CONSTANT) * LANES + k] = 1.0 - has_previous
        for j in range(s):
            theta = begins + ratio * c[j] if has_previous == 1.0 else 0.0
            for i in range(s):
                weight = has_previous
                for l in range(s):
                    if l != i:
                        weight *= (theta - c[l]) / (c[i] - c[l])
                work[(weights + j * s + i) * LANES + k] = weight
    for j in range(s):
        for m in range(n):
            offset = stages + j * n + m
            for k in range(LANES):
                work[offset * LANES + k] = 0.0
            add_product(work, offset, memory + CONSTANT, a + m, 1.0)
            for i in range(s):
                add_product(work, offset, weights + j * s + i, previous + i * n + m, 1.0)


@compiled
def _compute_residuals(code, settings, control, A, A2, c, work):
    """Store RESIDUAL (accelerations by the equations, minus STAGES), SCALE_Q, SCALE_V; set ACTIVE to 0 on failure."""
    n, order = settings[at.N], settings[at.ORDER]
    _, new, _, _, a, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    s = c.size
    stages, sums = block_offset(memory, n, s, STAGES), vector_offset(memory, n, SUMS)
    begin, residual = vector_offset(memory, n, BEGIN_Q), block_offset(memory, n, s, RESIDUAL)
    stage_rows, total = matrix_view(work, stages, s, n), vector_range(work, sums, n)
    fill_field(work, memory + SCALE_Q, _smallest_size(control, n))
    fill_field(work, memory + SCALE_V, _smallest_size(control, n))
    for j in range(s):
        sum_rows(A2[j], stage_rows, total)
        for m in range(n):
            for k in range(LANES):
                x, index = work[at.X * LANES + k], (begin + m) * LANES + k
                displacement = x * c[j] * work[index + n * LANES] + x * x * work[(sums + m) * LANES + k]
                work[(new + m) * LANES + k] = work[index] + displacement
        sum_rows(A[j], stage_rows, total)
        for m in range(n):
            for k in range(LANES):
                v = work[(begin + n + m) * LANES + k] + work[at.X * LANES + k] * work[(sums + m) * LANES + k]
                work[(new + n + m) * LANES + k] = v
                index_of_scale_q, index_of_scale_v = (memory + SCALE_Q) * LANES + k, (memory + SCALE_V) * LANES + k
                work[index_of_scale_q] = max(work[index_of_scale_q], abs(work[(new + m) * LANES + k]))
                work[index_of_scale_v] = max(work[index_of_scale_v], abs(v))
        for k in range(LANES):
            work[at.T_NEW * LANES + k] = work[at.T * LANES + k] + c[j] * work[at.X * LANES + k]
        code.compute_accelerations(order, control, work)
        for i in range(n * LANES):
            work[(residual + j * n) * LANES + i] = work[a * LANES + i] - work[(stages + j * n) * LANES + i]


@compiled
def _correct_stages(settings, method_options, s, work):
    """Store Newton's corrections of stage accelerations in CHANGES; add them to STAGES in lanes with ITERATING = 1."""
    n = settings[at.N]
    memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])[7]
    n_systems, offset = count_systems(method_options, s), newton_options_index(s)
    n_real = int(method_options[offset + N_REAL])
    offset += N_EIGEN_SCALARS + s
    scratch, changes = vector_offset(memory, n, COMPLEX), block_offset(memory, n, s, CHANGES)
    residual, stages = block_offset(memory, n, s, RESIDUAL), block_offset(memory, n, s, STAGES)
    residual_rows, width = matrix_view(work, residual, s, n), n * LANES
    for i in range(s * width):
        work[changes * LANES + i] = 0.0
    for index in range(n_systems):
        row, column = offset + 2, offset + 2 + 2 * s
        offset += 2 + 4 * s
        sum_rows(method_options[row : row + s], residual_rows, vector_range(work, scratch, n))
        sum_rows(method_options[row + s : row + 2 * s], residual_rows, vector_range(work, scratch + n, n))
        matrix, pivots = matrix_offset(memory, n, s, SYSTEMS + 2 * index), pivots_offset(memory, n, s, n_systems, index)
        imaginary = 0 if index < n_real else n * n
        solve_systems(work, matrix, pivots, n, imaginary, scratch)
        multiplicity = 1.0 if index < n_real else 2.0
        for j in range(s):
            re, im = multiplicity * method_options[column + j], multiplicity * method_options[column + s + j]
            for i in range(width):
                change = re * work[scratch * LANES + i] - im * work[scratch * LANES + width + i]
                work[(changes + j * n) * LANES + i] += change
    for i in range(s * width):
        if work[(memory + ITERATING) * LANES + i % LANES] == 1.0:
            work[stages * LANES + i] += work[changes * LANES + i]


@merged
def _raise_to_largest_value(work, target, begin, n):
    """In each lane, raise the number at `target` to max|value| of the n vectors at `begin`; NaN if a value is NaN."""
    for i in range(n * LANES):
        magnitude, index = abs(work[begin * LANES + i]), target * LANES + i % LANES
        if magnitude > work[index] or magnitude != magnitude:
            work[index] = magnitude


@compiled
def _store_largest_corrections(settings, A, A2, work):
    """From CHANGES, store max|change of q| / X^2 in LARGEST_Q, max|change of v| / X in LARGEST_V (X: step size)."""
    n = settings[at.N]
    memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])[7]
    s = A.shape[0]
    sums, stage_rows = vector_offset(memory, n, SUMS), matrix_view(work, block_offset(memory, n, s, CHANGES), s, n)
    fill_field(work, memory + LARGEST_Q, 0.0)
    fill_field(work, memory + LARGEST_V, 0.0)
    for j in range(s):
        sum_rows(A2[j], stage_rows, vector_range(work, sums, n))
        _raise_to_largest_value(work, memory + LARGEST_Q, sums, n)
        sum_rows(A[j], stage_rows, vector_range(work, sums, n))
        _raise_to_largest_value(work, memory + LARGEST_V, sums, n)


@merged
def _has_iteration_ended(options, work, memory, iteration, k):
    """Set DONE to 1 if Newton's iteration in lane k has converged, else to 0; return True if it converged or failed."""
    x, tolerance = work[at.X * LANES + k], options[N_HEAD + OUTER_TOL]
    scale_q, scale_v = work[(memory + SCALE_Q) * LANES + k], work[(memory + SCALE_V) * LANES + k]
    change_v, change_q = x * work[(memory + LARGEST_V) * LANES + k], x * x * work[(memory + LARGEST_Q) * LANES + k]
    change, before = max(change_v / scale_v, change_q / scale_q), work[(memory + CHANGE_BEFORE) * LANES + k]
    work[(memory + CHANGE_BEFORE) * LANES + k] = change
    if not np.isfinite(change_v + change_q) or work[at.ACTIVE * LANES + k] == 0.0:
        return True
    limit = MAX_ROUNDING_CORRECTION * options[LEAST]
    rounding_limit = max_change_by_rounding(limit, change, change_q, change_v, scale_q, scale_v)
    n_left = MAX_ITERATIONS - 1 - iteration
    contraction = change / before if iteration > 0 and before > 0.0 else 0.0
    if iteration == 0:
        converged = change <= 1e-3 * tolerance
        ended = converged
    elif contraction >= 0.9:
        converged, ended = change <= rounding_limit, True
    elif contraction / (1.0 - contraction) * change <= tolerance:
        converged, ended = True, True
    else:
        is_too_slow = change * contraction**n_left / (1.0 - contraction) > max(tolerance, rounding_limit)
        converged, ended = n_left == 0 and not is_too_slow and change <= rounding_limit, is_too_slow or n_left == 0
    work[(memory + DONE) * LANES + k] = 1.0 if converged else 0.0
    return ended


@compiled
def solve_stages(code, settings, control, options, method_options, A, A2, c, work):
    """Compute stage accelerations by Newton's method from the prediction in STAGES; set ACTIVE to 0 on divergence."""
    n = settings[at.N]
    memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])[7]
    iterating, done = memory + ITERATING, memory + DONE
    for k in range(LANES):
        work[iterating * LANES + k] = work[at.ACTIVE * LANES + k]
        work[done * LANES + k] = 0.0
    for iteration in range(MAX_ITERATIONS):
        n_left = 0.0
        for k in range(LANES):
            work[at.ACTIVE * LANES + k] = work[iterating * LANES + k]
            n_left += work[iterating * LANES + k]
            work[at.EVALUATED * LANES + k] += c.size * work[iterating * LANES + k]
        if n_left == 0.0:
            break
        _compute_residuals(code, settings, control, A, A2, c, work)
        _correct_stages(settings, method_options, c.size, work)
        _store_largest_corrections(settings, A, A2, work)
        for k in range(LANES):
            if work[iterating * LANES + k] == 1.0 and _has_iteration_ended(options, work, memory, iteration, k):
                work[iterating * LANES + k] = 0.0
    for k in range(LANES):
        work[at.ACTIVE * LANES + k] = work[done * LANES + k]


@compiled
def store_state_from_stages(settings, b, bA, work):
    """Store in NEW the state X seconds after the step's start: sum STAGES with the weights b for v, bA = b A for q."""
    n = settings[at.N]
    _, new, _, _, _, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    s = b.size
    begin, sums = vector_offset(memory, n, BEGIN_Q), vector_offset(memory, n, SUMS)
    stage_rows, total = matrix_view(work, block_offset(memory, n, s, STAGES), s, n), vector_range(work, sums, n)
    sum_rows(bA, stage_rows, total)
    for i in range(n * LANES):
        x, index = work[at.X * LANES + i % LANES], begin * LANES + i
        work[new * LANES + i] = work[index] + (x * work[index + n * LANES] + x * x * work[sums * LANES + i])
    sum_rows(b, stage_rows, total)
    for i in range(n * LANES):
        x, index = work[at.X * LANES + i % LANES], (begin + n) * LANES + i
        work[(new + n) * LANES + i] = work[index] + x * work[sums * LANES + i]


@merged
def _allowed_error(control, work, state, new, j, entry, k):
    """Return atol + rtol * max(|value before the step|, |value after it|) for a state entry: q or v of coordinate j."""
    magnitude = max(abs(work[(state + entry) * LANES + k]), abs(work[(new + entry) * LANES + k]))
    return control[at.ATOL + j] + control[at.RTOL] * magnitude


@compiled
def _store_embedded_estimate(settings, method_options, A, work, memory):
    """Store in E_Q and E_V the errors of q and v that the embedded formula estimates, without filters."""
    n, s = settings[at.N], A.shape[0]
    offset = newton_options_index(s)
    gamma0, e = method_options[offset + GAMMA0], method_options[offset + N_EIGEN_SCALARS : offset + N_EIGEN_SCALARS + s]
    stage_rows, begin = matrix_view(work, block_offset(memory, n, s, STAGES), s, n), vector_offset(memory, n, BEGIN_V)
    e_q, e_v, sums = vector_offset(memory, n, E_Q), vector_offset(memory, n, E_V), vector_offset(memory, n, SUMS)
    total = 0.0
    for i in range(s):
        total += e[i]
    for i in range(n * LANES):
        work[e_q * LANES + i] = (gamma0 + total) * work[begin * LANES + i]
    for j in range(s):  # add to E_Q the change of v until stage j, H sum_k A_jk a_k, with the weight e_j
        sum_rows(A[j], stage_rows, vector_range(work, sums, n))
        for i in range(n * LANES):
            work[e_q * LANES + i] += e[j] * work[at.H * LANES + i % LANES] * work[sums * LANES + i]
    sum_rows(e, stage_rows, vector_range(work, sums, n))
    for i in range(n * LANES):
        h = work[at.H * LANES + i % LANES]
        work[e_q * LANES + i] *= h
        work[e_v * LANES + i] = h * (gamma0 * work[(begin + n) * LANES + i] + work[sums * LANES + i])


@compiled
def _filter_errors(settings, method_options, s, work, memory):
    """Reduce stiff components of the errors e = (E_Q, E_V) of q and v: replace e by (I - z J)^-1 e (J: Jacobian).

    z = gamma0 H: step size H (s) times an eigenvalue of the tableau; J: derivative of (v, accelerations) by (q, v).
    """
    n = settings[at.N]
    gamma0 = method_options[newton_options_index(s) + GAMMA0]
    e_q, e_v, scratch = vector_offset(memory, n, E_Q), vector_offset(memory, n, E_V), vector_offset(memory, n, COMPLEX)
    by_q = matrix_offset(memory, n, s, DERIVATIVE_Q)
    for i in range(n):
        for k in range(LANES):
            total = 0.0
            for j in range(n):
                total += work[(by_q + i * n + j) * LANES + k] * work[(e_q + j) * LANES + k]
            work[(scratch + i) * LANES + k] = work[(e_v + i) * LANES + k] + gamma0 * work[at.H * LANES + k] * total
    pivots = pivots_offset(memory, n, s, count_systems(method_options, s), 0)
    solve_systems(work, matrix_offset(memory, n, s, SYSTEMS), pivots, n, 0, scratch)
    copy_vectors(work, scratch, e_v, n)
    for i in range(n * LANES):
        work[e_q * LANES + i] += gamma0 * work[at.H * LANES + i % LANES] * work[e_v * LANES + i]


@compiled
def _filtered_velocity_error(control, work, n, memory, z, state, new, k):
    """Return the largest error of q or v, in tolerances, that the velocity error E_V of the step causes in lane k.

    Store DURATION, the estimated time until the velocity error decays or changes its sign. The error of a position is
    about the velocity error times this time, see velocity_errors.py. z: time (s), see `_filter_errors`.
    """
    raw, once, twice = (
        vector_offset(memory, n, UNFILTERED),
        vector_offset(memory, n, FILTERED_ONCE),
        vector_offset(memory, n, E_V),
    )
    begin = vector_offset(memory, n, BEGIN_V)
    largest_error = largest_difference = largest_v = largest_a = 0.0
    for j in range(n):
        largest_v = max(largest_v, abs(work[(begin + j) * LANES + k]))
        largest_a = max(largest_a, abs(work[(begin + n + j) * LANES + k]))
        largest_error = max(largest_error, abs(work[(twice + j) * LANES + k]))
        difference = work[(twice + j) * LANES + k] - 2.0 * work[(once + j) * LANES + k] + work[(raw + j) * LANES + k]
        largest_difference = max(largest_difference, abs(difference))  # max|(z J)^2 E_V| (z, J: see `_filter_errors`)
    if largest_error > 0.0:
        work[(memory + DURATION) * LANES + k] = z * np.sqrt(largest_error / largest_difference)
    duration = work[(memory + DURATION) * LANES + k]
    if duration * largest_a * SLOW_FACTOR > largest_v:
        duration *= min(SLOW_FACTOR, duration * largest_a * SLOW_FACTOR / largest_v) if largest_v > 0.0 else SLOW_FACTOR
    return _velocity_error(control, work, n, twice, duration, state, new, k)


@compiled
def _velocity_error(control, work, n, velocity_error, duration, state, new, k):
    """Return the largest error, in tolerances, that a velocity error in lane k causes within `duration` (s)."""
    error = 0.0
    for j in range(n):
        weight_q = duration / _allowed_error(control, work, state, new, j, j, k)
        weight_v = 1.0 / _allowed_error(control, work, state, new, j, n + j, k)
        error = max(error, abs(work[(velocity_error + j) * LANES + k]) * min(weight_q, weight_v))
    return error


@merged
def _motion_time(control, work, n, memory, k):
    """Return max|v| / max|a| (s) at the beginning of the step in lane k, at most LONGEST_GAPS * control[GAP]."""
    begin = vector_offset(memory, n, BEGIN_V)
    largest_v = largest_a = 0.0
    for j in range(n):
        largest_v = max(largest_v, abs(work[(begin + j) * LANES + k]))
        largest_a = max(largest_a, abs(work[(begin + n + j) * LANES + k]))
    max_time = LONGEST_GAPS * control[at.GAP]
    return largest_v / largest_a if largest_v < max_time * largest_a else max_time


@compiled
def _add_error_in_slow_directions(settings, control, method_options, s, work):
    """If the slowly changing part of the velocity error E_V causes an error larger than ERROR, set ERROR to it."""
    n = settings[at.N]
    state, new, _, _, _, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    e_v, error_field, fine_copy = vector_offset(memory, n, E_V), memory + LARGEST_V, memory + ITERATING
    has_large_error = False
    for k in range(LANES):
        error = 0.0
        if work[at.ERROR * LANES + k] <= 1.0:
            motion_time = _motion_time(control, work, n, memory, k)
            error = _velocity_error(control, work, n, e_v, motion_time, state, new, k)
        work[error_field * LANES + k], work[fine_copy * LANES + k] = error, work[at.ACTIVE * LANES + k]
        has_large_error = has_large_error or error > 1.0
    if not has_large_error:
        return
    by_q, by_v = matrix_offset(memory, n, s, DERIVATIVE_Q), matrix_offset(memory, n, s, DERIVATIVE_V)
    matrix = matrix_offset(memory, n, s, SYSTEMS)
    for i in range(n * n):
        for k in range(LANES):
            z = STEPS_TO_DECAY * work[at.H * LANES + k]
            entry = -z * z * work[(by_q + i) * LANES + k] - z * work[(by_v + i) * LANES + k]
            work[(matrix + i) * LANES + k] = entry + (1.0 if i % (n + 1) == 0 else 0.0)
    pivots = pivots_offset(memory, n, s, count_systems(method_options, s), 0)
    factor_matrices(work, matrix, pivots, n, 0)
    solve_systems(work, matrix, pivots, n, 0, e_v)
    for k in range(LANES):
        error = work[error_field * LANES + k]
        # in unstable motion, the filter may enlarge the error: use the smaller one of the old and the new error
        if work[at.ACTIVE * LANES + k] == 1.0:
            motion_time = _motion_time(control, work, n, memory, k)
            error = min(error, _velocity_error(control, work, n, e_v, motion_time, state, new, k))
        work[at.ACTIVE * LANES + k] = work[fine_copy * LANES + k]
        if work[error_field * LANES + k] > 1.0:
            work[at.ERROR * LANES + k] = max(work[at.ERROR * LANES + k], error)


@compiled
def _estimate_error(settings, control, method_options, A, work):
    """Store the error estimate of the step, in tolerances, in ERROR; filters reduce components of stiff vibrations."""
    n, s = settings[at.N], A.shape[0]
    state, new, _, _, _, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    offset = newton_options_index(s)
    e_q, e_v = vector_offset(memory, n, E_Q), vector_offset(memory, n, E_V)
    _store_embedded_estimate(settings, method_options, A, work, memory)
    copy_vectors(work, e_v, vector_offset(memory, n, UNFILTERED), n)
    _filter_errors(settings, method_options, s, work, memory)
    tests_velocities = method_options[offset + TESTS_VELOCITIES] == 1.0
    fill_field(work, at.ERROR, 0.0)
    for j in range(n):
        atol, rtol = control[at.ATOL + j], control[at.RTOL]
        raise_to_ratio(work, at.ERROR, e_q + j, at.RUNNING, state + j, new + j, atol, rtol)
        if tests_velocities:
            raise_to_ratio(work, at.ERROR, e_v + j, at.RUNNING, state + n + j, new + n + j, atol, rtol)
    if tests_velocities:
        return
    copy_vectors(work, e_v, vector_offset(memory, n, FILTERED_ONCE), n)
    _filter_errors(settings, method_options, s, work, memory)
    for k in range(LANES):
        z = method_options[offset + GAMMA0] * work[at.H * LANES + k]
        error = _filtered_velocity_error(control, work, n, memory, z, state, new, k)
        work[at.ERROR * LANES + k] = max(work[at.ERROR * LANES + k], error)
    _add_error_in_slow_directions(settings, control, method_options, s, work)


@compiled
def _store_stages(work, memory, n, s):
    """In lanes with an accepted step, copy STAGES to PREVIOUS, for predictions in the next step and within this one."""
    stages, previous = block_offset(memory, n, s, STAGES), block_offset(memory, n, s, PREVIOUS)
    for k in range(LANES):
        if work[at.ACCEPTED * LANES + k] == 1.0:
            work[(memory + H_PREVIOUS) * LANES + k] = work[at.H * LANES + k]
            for i in range(s * n):
                work[(previous + i) * LANES + k] = work[(stages + i) * LANES + k]


@kernel(STEP, vectorized=True)
def step_by_newton(code, settings, control, options, work, status, n_steps, within):
    """Take a step of an implicit Runge-Kutta method in each lane, at most as long as control[GAP] (s).

    If `within`, take no step: compute the states X seconds after the beginning of the last accepted step.
    """
    n = settings[at.N]
    state, _, _, _, a, _, _, memory = offsets_in_work(n, settings[at.N_ROWS], settings[at.N_NUMBERS])
    method_options = options[N_HEAD:]
    s, A, A2, b, bA, c = tableau_of(method_options)
    start, begin = vector_offset(memory, n, START), vector_offset(memory, n, BEGIN_Q)
    if not within:
        begin_control(options, control, work, n, state, a, start)
        for k in range(LANES):
            if work[at.IS_NEW * LANES + k] == 1.0:
                work[(memory + H_PREVIOUS) * LANES + k] = work[(memory + DURATION) * LANES + k] = 0.0
        choose_steps(work, control, status, n_steps)
        copy_vectors(work, state, begin, 2 * n)
        copy_vectors(work, start, begin + 2 * n, n)
        compute_derivatives(code, settings, control, c, work)
    factor_systems_of_lanes(settings, method_options, s, work)
    predict_stages(settings, c, work, 0.0 if within else 1.0)
    solve_stages(code, settings, control, options, method_options, A, A2, c, work)
    store_state_from_stages(settings, b, bA, work)
    set_end(work, control)
    if not within:
        _estimate_error(settings, control, method_options, A, work)
        end_steps(code, settings, control, work, vector_offset(memory, n, SUMS))
        judge_steps(options, work, n, a, start, status)
        _store_stages(work, memory, n, s)

"""Newton's method in lanes, for the stage accelerations of an implicit Runge-Kutta method, as `newton_step` has it.

The unknowns are the accelerations a_j of all coordinates at the stages,

    F(t_j, Q_j, V_j) - a_j = 0,  Q_j = q + c_j h v + h^2 sum_k (A A)_jk a_k,  V_j = v + h sum_k A_jk a_k,

F being the accelerations at a state as it stands: stages are off the constraints by the error of the formula, and the
end of the step alone is put on them. Derivatives are differences, made for all lanes at once and anew for each step.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.lanes.lane_algebra import (
    add_product,
    copy_vectors,
    factor_lanes,
    solve_lanes,
    sum_rows,
    table,
    vectors,
)
from twoloop.kernels.lanes.lane_control import LEAST, N_HEAD
from twoloop.kernels.lanes.lane_room import (
    AHEAD,
    EVALUATED,
    FINE,
    LANES,
    N_NUMBERS,
    N_ROWS,
    ORDER,
    N,
    T,
    X,
    fill_field,
    places_of,
)
from twoloop.kernels.steps.newton_memory import N_EIGEN_SCALARS, N_REAL, count_eigenvalues, eigen_place
from twoloop.kernels.steps.newton_operator import MAX_ITERATIONS, STAGNATION
from twoloop.kernels.steps.newton_tangents import DIFFERENCE
from twoloop.kernels.steps.stages import FARTHEST, OUTER_TOL, middle_node

# of the method's memory, in vectors: one number for each lane, ...
(
    TO_GO,  # 1: lanes in which the iteration has not ended
    DONE,  # 1: it has converged
    BEFORE,  # the correction before
    SCALE_Q,
    SCALE_V,
    LARGEST_Q,  # of the corrections
    LARGEST_V,
    H_PREVIOUS,  # step that PREVIOUS belongs to; 0: none
    CONSTANT,  # 1: the stages are predicted as the accelerations at the beginning
    LASTING,  # s: how long an error of velocity lasts; 0: not known
    N_OF_LANES,
) = range(11)
# ... then n for each of these: accelerations at STATE; q, v and a at the beginning of the step; sums; a state in the
# middle of the step, and its accelerations; the estimate of the error, and that of velocities as it was and filtered
# once; and a vector whose imaginary part follows
(
    START,
    BEGIN_Q,
    BEGIN_V,
    BEGIN_A,
    SUMS,
    MIDDLE_Q,
    MIDDLE_V,
    MIDDLE_A,
    E_Q,
    E_V,
    RAW,
    ONCE,
    ONE,
    _IMAGINARY,
    N_VECTORS,
) = range(15)
STAGES, PREVIOUS, RESIDUAL, CHANGES, N_BLOCKS = range(5)  # (s, n) each; then weights (s, s)
BY_Q, BY_V, SYSTEMS = range(3)  # (n, n) each; of a system the real and the imaginary parts, then all pivots


def memory_size(s: int, n: int) -> int:
    """Length of the method's memory, in vectors, for s stages, and one system for each eigenvalue or pair of them."""
    n_systems = (s + 1) // 2
    return N_OF_LANES + (N_VECTORS + N_BLOCKS * s + n_systems) * n + s * s + (SYSTEMS + 2 * n_systems) * n * n


@merged
def vector_at(memory, n, which):
    """Place of one of the vectors (n)."""
    return memory + N_OF_LANES + which * n


@merged
def block_at(memory, n, s, which):
    """Place of one of the blocks (s, n)."""
    return memory + N_OF_LANES + (N_VECTORS + which * s) * n


@merged
def _weights_at(memory, n, s):
    return memory + N_OF_LANES + (N_VECTORS + N_BLOCKS * s) * n


@merged
def matrix_at(memory, n, s, which):
    """Place of one of the matrices (n, n); that of system k is SYSTEMS + 2 k."""
    return _weights_at(memory, n, s) + s * s + which * n * n


@merged
def pivots_at(memory, n, s, n_systems, k):
    """Place of the pivots of system k."""
    return matrix_at(memory, n, s, SYSTEMS + 2 * n_systems) + k * n


@compiled
def _middle(code, settings, control, c, room, new, a, memory):
    """The state in the middle of the step, near the constraints, and its accelerations."""
    n, order = settings[N], settings[ORDER]
    share, begin = middle_node(c), vector_at(memory, n, BEGIN_Q)
    for k in range(LANES):
        x = share * room[X * LANES + k]
        room[AHEAD * LANES + k] = room[T * LANES + k] + x
        for j in range(n):
            at = (begin + j) * LANES + k
            q, v, a0 = room[at], room[at + n * LANES], room[at + 2 * n * LANES]
            room[(new + j) * LANES + k] = q + x * (v + 0.5 * x * a0)
            room[(new + n + j) * LANES + k] = v + x * a0
    code.closer(order, control, room)
    code.there(order, control, room)
    copy_vectors(room, new, vector_at(memory, n, MIDDLE_Q), 2 * n)
    copy_vectors(room, a, vector_at(memory, n, MIDDLE_A), n)


@compiled
def find_derivatives(code, settings, control, c, room):
    """Derivatives of the accelerations by positions and velocities, in the middle of the step, of lanes that are FINE.

    At the time of a stage, so that they see nothing of a force that the stages do not see.
    """
    n, order = settings[N], settings[ORDER]
    _, new, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    s = c.size
    _middle(code, settings, control, c, room, new, a, memory)
    middle, middle_a = vector_at(memory, n, MIDDLE_Q), vector_at(memory, n, MIDDLE_A)
    for column in range(2 * n):
        copy_vectors(room, middle, new, 2 * n)
        for k in range(LANES):
            at = (new + column) * LANES + k
            room[at] += DIFFERENCE * max(1.0, abs(room[at]))
        code.there(order, control, room)
        matrix = matrix_at(memory, n, s, BY_Q if column < n else BY_V) + column % n
        for k in range(LANES):
            inverse = 1.0 / (room[(new + column) * LANES + k] - room[(middle + column) * LANES + k])
            for i in range(n):
                change = room[(a + i) * LANES + k] - room[(middle_a + i) * LANES + k]
                room[(matrix + i * n) * LANES + k] = change * inverse


@compiled
def factor_systems_of_lanes(settings, own, s, room):
    """Factors of I - (X l)^2 J_q - X l J_v for each eigenvalue l."""
    n = settings[N]
    memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])[7]
    n_systems, place = count_eigenvalues(own, s), eigen_place(s)
    n_real = int(own[place + N_REAL])
    place += N_EIGEN_SCALARS + s
    by_q, by_v = matrix_at(memory, n, s, BY_Q), matrix_at(memory, n, s, BY_V)
    for system in range(n_systems):
        re, im = own[place], own[place + 1]
        place += 2 + 4 * s
        matrix, apart = matrix_at(memory, n, s, SYSTEMS + 2 * system), n * n * LANES
        for i in range(n * n):
            diagonal = 1.0 if i % (n + 1) == 0 else 0.0
            for k in range(LANES):
                x = room[X * LANES + k]
                q, v = x * x * room[(by_q + i) * LANES + k], x * room[(by_v + i) * LANES + k]
                room[(matrix + i) * LANES + k] = diagonal - (re * re - im * im) * q - re * v
                room[(matrix + i) * LANES + k + apart] = -2.0 * re * im * q - im * v
        pivots = pivots_at(memory, n, s, n_systems, system)
        factor_lanes(room, matrix, pivots, n, 0 if system < n_real else n * n)


@compiled
def predict_stages(settings, c, room, begins):
    """Stages by the polynomial of the step before, or constant; `begins` 0: by that of the step itself."""
    n = settings[N]
    memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])[7]
    s = c.size
    weights, stages = _weights_at(memory, n, s), block_at(memory, n, s, STAGES)
    previous, a = block_at(memory, n, s, PREVIOUS), vector_at(memory, n, BEGIN_A)
    for k in range(LANES):
        before = room[(memory + H_PREVIOUS) * LANES + k]
        ratio = room[X * LANES + k] / before if before > 0.0 else np.inf
        known = 1.0 if ratio <= FARTHEST else 0.0
        room[(memory + CONSTANT) * LANES + k] = 1.0 - known
        for j in range(s):
            theta = begins + ratio * c[j] if known == 1.0 else 0.0
            for i in range(s):
                product = known
                for l in range(s):
                    if l != i:
                        product *= (theta - c[l]) / (c[i] - c[l])
                room[(weights + j * s + i) * LANES + k] = product
    for j in range(s):
        for m in range(n):
            place = stages + j * n + m
            for k in range(LANES):
                room[place * LANES + k] = 0.0
            add_product(room, place, memory + CONSTANT, a + m, 1.0)
            for i in range(s):
                add_product(room, place, weights + j * s + i, previous + i * n + m, 1.0)


@compiled
def _residuals(code, settings, control, A, A2, c, room):
    """What the equations leave at the stages; FINE where there are values, and the largest entries."""
    n, order = settings[N], settings[ORDER]
    _, new, _, _, a, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    s = c.size
    stages, sums = block_at(memory, n, s, STAGES), vector_at(memory, n, SUMS)
    begin, residual = vector_at(memory, n, BEGIN_Q), block_at(memory, n, s, RESIDUAL)
    known, total = table(room, stages, s, n), vectors(room, sums, n)
    fill_field(room, memory + SCALE_Q, 1.0)
    fill_field(room, memory + SCALE_V, 1.0)
    for j in range(s):
        sum_rows(A2[j], known, total)
        for m in range(n):
            for k in range(LANES):
                x, at = room[X * LANES + k], (begin + m) * LANES + k
                way = x * c[j] * room[at + n * LANES] + x * x * room[(sums + m) * LANES + k]
                room[(new + m) * LANES + k] = room[at] + way
        sum_rows(A[j], known, total)
        for m in range(n):
            for k in range(LANES):
                v = room[(begin + n + m) * LANES + k] + room[X * LANES + k] * room[(sums + m) * LANES + k]
                room[(new + n + m) * LANES + k] = v
                q_most, v_most = (memory + SCALE_Q) * LANES + k, (memory + SCALE_V) * LANES + k
                room[q_most] = max(room[q_most], abs(room[(new + m) * LANES + k]))
                room[v_most] = max(room[v_most], abs(v))
        for k in range(LANES):
            room[AHEAD * LANES + k] = room[T * LANES + k] + c[j] * room[X * LANES + k]
        code.there(order, control, room)
        for i in range(n * LANES):
            room[(residual + j * n) * LANES + i] = room[a * LANES + i] - room[(stages + j * n) * LANES + i]


@compiled
def _correct(settings, own, s, room):
    """The corrections of the stages, into CHANGES, and to the stages of lanes in which the iteration goes on."""
    n = settings[N]
    memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])[7]
    n_systems, place = count_eigenvalues(own, s), eigen_place(s)
    n_real = int(own[place + N_REAL])
    place += N_EIGEN_SCALARS + s
    one, changes = vector_at(memory, n, ONE), block_at(memory, n, s, CHANGES)
    residual, stages = block_at(memory, n, s, RESIDUAL), block_at(memory, n, s, STAGES)
    left, width = table(room, residual, s, n), n * LANES
    for i in range(s * width):
        room[changes * LANES + i] = 0.0
    for system in range(n_systems):
        row, column = place + 2, place + 2 + 2 * s
        place += 2 + 4 * s
        sum_rows(own[row : row + s], left, vectors(room, one, n))
        sum_rows(own[row + s : row + 2 * s], left, vectors(room, one + n, n))
        matrix, pivots = matrix_at(memory, n, s, SYSTEMS + 2 * system), pivots_at(memory, n, s, n_systems, system)
        imaginary = 0 if system < n_real else n * n
        solve_lanes(room, matrix, pivots, n, imaginary, one)
        twice = 1.0 if system < n_real else 2.0
        for j in range(s):
            re, im = twice * own[column + j], twice * own[column + s + j]
            for i in range(width):
                change = re * room[one * LANES + i] - im * room[one * LANES + width + i]
                room[(changes + j * n) * LANES + i] += change
    for i in range(s * width):
        if room[(memory + TO_GO) * LANES + i % LANES] == 1.0:
            room[stages * LANES + i] += room[changes * LANES + i]


@merged
def _enlarge(room, most, sums, n):
    """The largest entries of n vectors, NaN too."""
    for i in range(n * LANES):
        size, at = abs(room[sums * LANES + i]), most * LANES + i % LANES
        if size > room[at] or size != size:
            room[at] = size


@compiled
def _sizes(settings, A, A2, room):
    """The largest corrections of the positions and velocities of the stages, for a step of 1."""
    n = settings[N]
    memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])[7]
    s = A.shape[0]
    sums, known = vector_at(memory, n, SUMS), table(room, block_at(memory, n, s, CHANGES), s, n)
    fill_field(room, memory + LARGEST_Q, 0.0)
    fill_field(room, memory + LARGEST_V, 0.0)
    for j in range(s):
        sum_rows(A2[j], known, vectors(room, sums, n))
        _enlarge(room, memory + LARGEST_Q, sums, n)
        sum_rows(A[j], known, vectors(room, sums, n))
        _enlarge(room, memory + LARGEST_V, sums, n)


@merged
def _ended(options, room, memory, iteration, k):
    """Whether the iteration of a lane ends, and DONE, whether it has converged."""
    x, tolerance = room[X * LANES + k], options[N_HEAD + OUTER_TOL]
    floor = STAGNATION * options[LEAST]
    fast = x * room[(memory + LARGEST_V) * LANES + k] / room[(memory + SCALE_V) * LANES + k]
    far = x * x * room[(memory + LARGEST_Q) * LANES + k] / room[(memory + SCALE_Q) * LANES + k]
    change, before = max(fast, far), room[(memory + BEFORE) * LANES + k]
    room[(memory + BEFORE) * LANES + k] = change
    if not np.isfinite(fast + far) or room[FINE * LANES + k] == 0.0:
        return True
    left = MAX_ITERATIONS - 1 - iteration
    contraction = change / before if iteration > 0 and before > 0.0 else 0.0
    if iteration == 0:
        converged = change <= 1e-3 * tolerance
        ended = converged
    elif contraction >= 0.9:
        converged, ended = change <= floor, True
    elif contraction / (1.0 - contraction) * change <= tolerance:
        converged, ended = True, True
    else:
        late = change * contraction**left / (1.0 - contraction) > max(tolerance, floor)
        converged, ended = left == 0 and not late and change <= floor, late or left == 0
    room[(memory + DONE) * LANES + k] = 1.0 if converged else 0.0
    return ended


@compiled
def solve_stages(code, settings, control, options, own, A, A2, c, room):
    """The stages of a step X, predicted, of lanes that are FINE; FINE where they were found."""
    n = settings[N]
    memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])[7]
    to_go, done = memory + TO_GO, memory + DONE
    for k in range(LANES):
        room[to_go * LANES + k] = room[FINE * LANES + k]
        room[done * LANES + k] = 0.0
    for iteration in range(MAX_ITERATIONS):
        left = 0.0
        for k in range(LANES):
            room[FINE * LANES + k] = room[to_go * LANES + k]
            left += room[to_go * LANES + k]
            room[EVALUATED * LANES + k] += c.size * room[to_go * LANES + k]
        if left == 0.0:
            break
        _residuals(code, settings, control, A, A2, c, room)
        _correct(settings, own, c.size, room)
        _sizes(settings, A, A2, room)
        for k in range(LANES):
            if room[to_go * LANES + k] == 1.0 and _ended(options, room, memory, iteration, k):
                room[to_go * LANES + k] = 0.0
    for k in range(LANES):
        room[FINE * LANES + k] = room[done * LANES + k]


@compiled
def end_of_stages(settings, b, bA, room):
    """NEW, X after the beginning of the step, by its stages."""
    n = settings[N]
    _, new, _, _, _, _, _, memory = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    s = b.size
    begin, sums = vector_at(memory, n, BEGIN_Q), vector_at(memory, n, SUMS)
    known, total = table(room, block_at(memory, n, s, STAGES), s, n), vectors(room, sums, n)
    sum_rows(bA, known, total)
    for i in range(n * LANES):
        x, at = room[X * LANES + i % LANES], begin * LANES + i
        room[new * LANES + i] = room[at] + (x * room[at + n * LANES] + x * x * room[sums * LANES + i])
    sum_rows(b, known, total)
    for i in range(n * LANES):
        x, at = room[X * LANES + i % LANES], (begin + n) * LANES + i
        room[(new + n) * LANES + i] = room[at] + x * room[sums * LANES + i]

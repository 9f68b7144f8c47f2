"""Project initial states in lanes onto the constraints by the least change; check whether another assembly is as near.

G is the constraint Jacobian C_q with rows scaled to norm 1; the least change follows from the Cholesky factor of G G^T.
If constraints are redundant, rows of G are dependent where the constraints hold, and nearly dependent elsewhere. A row
of Z, an eigenvector of G G^T, contains the coefficients of a combination of rows of G that vanishes. Components of
right-hand sides along the rows of Z are removed, and Z^T Z is added to G G^T, so that the sum is not singular.

`pattern` is the sparsity pattern of G. Its first n_rows + 1 entries are indices in `pattern`: the columns of row i are
pattern[pattern[i]:pattern[i + 1]]. An array in `work` is given by its offset, counted in vectors (one number per lane).

Two further kernels check the results of runs in lanes: they evaluate the callbacks, and store residuals.
"""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR, f8
from twoloop.kernels.data.common import INTEGERS, KIT, compiled, kernel, merged
from twoloop.kernels.lanes import layout as at
from twoloop.kernels.lanes.layout import CODE, LANES, copy_vectors, fill_field, offsets_in_work

DIAGONAL_SHIFT = 1e-15  # added to the diagonal of G G^T, which may be singular (G: Jacobian with rows of norm 1)
ITERATION_SHIFT = 1e-8  # added to the diagonal of a singular G G^T, to find redundant constraints by inverse iterations
MAX_REDUNDANT_EIGENVALUE = 1e-4  # up to this eigenvalue, an eigenvector of G G^T counts as a redundant constraint
N_REDUNDANT_ITERATIONS = 5  # number of inverse iterations per redundant constraint; few suffice for tiny eigenvalues
GOLDEN_SECTION = 0.6180339887498949  # inverse iterations begin with irregular numbers: multiples of this, modulo 1


@merged
def _subtract_in_four_lanes(work, target, x, x_stride, y, y_stride, count):
    """In four lanes, subtract `count` products work[x] * work[y] from work[target]; x and y grow by their strides."""
    t0, t1, t2, t3 = work[target], work[target + 1], work[target + 2], work[target + 3]
    for _ in range(count):
        t0 -= work[x] * work[y]
        t1 -= work[x + 1] * work[y + 1]
        t2 -= work[x + 2] * work[y + 2]
        t3 -= work[x + 3] * work[y + 3]
        x += x_stride
        y += y_stride
    work[target], work[target + 1], work[target + 2], work[target + 3] = t0, t1, t2, t3


@compiled
def subtract_products(work, target, x, x_stride, y, y_stride, count):
    """In each lane, subtract `count` products of two numbers from the number at offset `target` in `work`.

    Product i multiplies the number at offset x + i * x_stride by the number at offset y + i * y_stride.
    """
    for k in range(0, LANES, 4):
        x_0, y_0 = x * LANES + k, y * LANES + k
        _subtract_in_four_lanes(work, target * LANES + k, x_0, x_stride * LANES, y_0, y_stride * LANES, count)


@merged
def subtract_row_product(work, target, entries, pattern, i, y):
    """In each lane, subtract from the number `target` the product of row i of a sparse matrix and a vector y.

    Offsets: `target`, `y`, `entries` (nonzero, row by row). Row i has the columns pattern[pattern[i]:pattern[i + 1]].
    """
    for e in range(pattern[i], pattern[i + 1]):
        subtract_products(work, target, entries + e - pattern[0], 1, y + pattern[e], 1, 1)


@compiled
def _multiply_vector(work, target, factor):
    """In each lane, multiply the number at offset `target` by the number at offset `factor`."""
    for k in range(LANES):
        work[target * LANES + k] *= work[factor * LANES + k]


@compiled
def _cholesky(work, pattern, n_rows, n_redundant, row, factors, shift):
    """Store the Cholesky factor of G G^T + shift I + Z^T Z in each lane (Z: vanishing combinations of rows of G).

    `factors` contains G (Jacobian, rows of norm 1), Z and the result, with inverted diagonal entries. `row`: n zeros.
    """
    n_entries = pattern[n_rows] - pattern[0]
    gram = factors + n_entries + n_rows
    Z = gram + n_rows * n_rows
    for i in range(n_rows):
        for e in range(pattern[i], pattern[i + 1]):
            copy_vectors(work, factors + e - pattern[0], row + pattern[e], 1)
        for j in range(i + 1):
            entry = gram + i * n_rows + j
            fill_field(work, entry, -shift if i == j else 0.0)
            subtract_row_product(work, entry, factors, pattern, j, row)
            subtract_products(work, entry, Z + i, n_rows, Z + j, n_rows, n_redundant)
            for k in range(LANES):
                work[entry * LANES + k] *= -1.0
            subtract_products(work, entry, gram + i * n_rows, 1, gram + j * n_rows, 1, j)
            if i > j:
                _multiply_vector(work, entry, gram + j * n_rows + j)
        for k in range(LANES):
            pivot = work[(gram + i * n_rows + i) * LANES + k]
            work[(gram + i * n_rows + i) * LANES + k] = 1.0 / np.sqrt(pivot) if pivot > 0.0 else np.nan
        for e in range(pattern[i], pattern[i + 1]):
            fill_field(work, row + pattern[e], 0.0)


@compiled
def factor_gram(work, pattern, moves, n_rows, n_redundant, G, row, factors):
    """In each lane, factor the matrices for solving G x = c with the least |x|, where G is the constraint Jacobian.

    Store in `factors`: G with columns of fixed coordinates (`moves` = 0) set to zero and rows scaled to norm 1; the
    reciprocals of the norms; the Cholesky factor of G G^T + DIAGONAL_SHIFT I + Z^T Z; and Z, the combinations of rows
    of G that vanish, see module docstring. `row` (n): scratch, zero on entry.
    """
    n_entries = pattern[n_rows] - pattern[0]
    for i in range(n_rows):
        reciprocal_norm = factors + n_entries + i
        fill_field(work, reciprocal_norm, 0.0)
        for e in range(pattern[i], pattern[i + 1]):
            entry = e - pattern[0]
            if moves[pattern[e]] == 1:
                copy_vectors(work, G + entry, factors + entry, 1)
                subtract_products(work, reciprocal_norm, G + entry, 1, G + entry, 1, 1)
            else:
                fill_field(work, factors + entry, 0.0)
        for k in range(LANES):
            squared_norm = -work[reciprocal_norm * LANES + k]
            work[reciprocal_norm * LANES + k] = 1.0 / np.sqrt(squared_norm) if squared_norm != 0.0 else 1.0
        for e in range(pattern[i], pattern[i + 1]):
            _multiply_vector(work, factors + e - pattern[0], reciprocal_norm)
    if n_redundant > 0:
        _find_redundant_combinations(work, pattern, n_rows, n_redundant, row, factors)
    _cholesky(work, pattern, n_rows, n_redundant, row, factors, DIAGONAL_SHIFT)


@compiled
def _find_redundant_combinations(work, pattern, n_rows, n_redundant, row, factors):
    """Store Z, eigenvectors of the least eigenvalues of G G^T; NaN for eigenvalues above MAX_REDUNDANT_EIGENVALUE."""
    gram = factors + pattern[n_rows] - pattern[0] + n_rows
    Z = gram + n_rows * n_rows
    scratch = Z + n_redundant * n_rows
    _cholesky(work, pattern, n_rows, 0, row, factors, ITERATION_SHIFT)
    for w in range(n_redundant):
        z = Z + w * n_rows
        for i in range(n_rows):
            fill_field(work, z + i, 0.5 + (GOLDEN_SECTION * (i + 1) * (w + 1)) % 1.0)
        for _ in range(N_REDUNDANT_ITERATIONS):
            normalise_vector(work, z, n_rows, scratch)
            _solve_with_gram(work, n_rows, gram, z)
            _remove_redundant_components(work, n_rows, w, Z, z, scratch)
        normalise_vector(work, z, n_rows, scratch)
        for k in range(LANES):
            # the vector `scratch` now contains the eigenvalue of G G^T that belongs to z, plus ITERATION_SHIFT
            if not work[scratch * LANES + k] < MAX_REDUNDANT_EIGENVALUE:
                work[z * LANES + k] = np.nan


@compiled
def normalise_vector(work, x, n_rows, scratch):
    """Scale x (n_rows) to norm 1; store 1 / (norm before scaling) in the vector `scratch`."""
    fill_field(work, scratch, 0.0)
    subtract_products(work, scratch, x, 1, x, 1, n_rows)
    for k in range(LANES):
        work[scratch * LANES + k] = 1.0 / np.sqrt(abs(work[scratch * LANES + k]))
    for i in range(n_rows):
        _multiply_vector(work, x + i, scratch)


@compiled
def _remove_redundant_components(work, n_rows, n_redundant, Z, x, scratch):
    """Subtract from x (n_rows) its components along the n_redundant rows of Z, which have norm 1."""
    for w in range(n_redundant):
        z = Z + w * n_rows
        fill_field(work, scratch, 0.0)
        subtract_products(work, scratch, z, 1, x, 1, n_rows)
        for k in range(LANES):
            work[scratch * LANES + k] *= -1.0
        for i in range(n_rows):
            subtract_products(work, x + i, z + i, 1, scratch, 1, 1)


@compiled
def _solve_with_gram(work, n_rows, factor, x):
    """Replace x (n_rows) by y, the solution of G G^T y = x; `factor`: offset of the Cholesky factor of G G^T."""
    for i in range(n_rows):
        subtract_products(work, x + i, factor + i * n_rows, 1, x, 1, i)
        _multiply_vector(work, x + i, factor + i * n_rows + i)
    for i in range(n_rows - 1, -1, -1):
        subtract_products(work, x + i, factor + (i + 1) * n_rows + i, n_rows, x + i + 1, 1, n_rows - 1 - i)
        _multiply_vector(work, x + i, factor + i * n_rows + i)


@compiled
def solve_along_rows(work, pattern, n, n_rows, n_redundant, factors, x, out):
    """Solve G G^T y = x; store -G^T y, the shortest d with G d = -x, in `out` (n); then replace x (n_rows) by y.

    G: Jacobian, rows of norm 1. Components of x along vanishing combinations of rows are removed before solving.
    """
    gram = factors + pattern[n_rows] - pattern[0] + n_rows
    Z = gram + n_rows * n_rows
    _remove_redundant_components(work, n_rows, n_redundant, Z, x, Z + n_redundant * n_rows)
    _solve_with_gram(work, n_rows, gram, x)
    for j in range(n):
        fill_field(work, out + j, 0.0)
    for i in range(n_rows):
        for e in range(pattern[i], pattern[i + 1]):
            subtract_products(work, out + pattern[e], x + i, 1, factors + e - pattern[0], 1, 1)


@compiled
def solve_least_change(work, pattern, n, n_rows, n_redundant, factors, x, change):
    """Store in `change` (n) the shortest d with C_q d = -x (NaN in lanes with dependent constraints); overwrite x."""
    for i in range(n_rows):
        _multiply_vector(work, x + i, factors + pattern[n_rows] - pattern[0] + i)
    solve_along_rows(work, pattern, n, n_rows, n_redundant, factors, x, change)


MAX_ITERATIONS = 12  # largest number of steps of the Gauss-Newton iteration
ROUNDING_FACTOR = 64.0  # a constraint holds if its residual is at most this number of rounding errors of its terms
# displaced positions are projected. Another assembly counts as near if a projection differs from the linear prediction
# (the displacement without its component normal to the constraints) by more than this fraction of the displacement
MAX_CURVATURE = 0.25
MIN_EIGENVALUE = 1e-12  # constraints are independent if all eigenvalues of G G^T exceed this (rows of G have norm 1)
N_WEAKEST_ITERATIONS = 10  # number of inverse iterations for the direction that the constraints determine least
N_REDUNDANT = 5  # settings[N_REDUNDANT]: number of redundant rows; in kernels for steps, settings[5] is N_EVALUATIONS
# factors (x, y) of three other guesses, p + x (p - p_0) + y d. p_0 is the first guess; p is p_0 projected onto the
# constraints; d is the direction that the constraints determine least
OTHER_GUESSES = ((-2.0, 0.0), (0.0, 1.0), (0.0, -1.0))


def offsets_in_memory(memory, n, n_rows, n_entries, n_redundant):
    """Return the offsets (in vectors) of the arrays in the method's memory, which begins at `memory`, and of its end.

    The memory begins with C and C_t (n_rows each) and the entries of G = C_q, which generated code writes. Then follow

    - x (n_rows), a right-hand side
    - change (n), of positions or velocities
    - nearest_positions (n), the guess projected onto the constraints; change_from_guess (n), nearest_positions - guess
    - weakest_direction (n), the direction that the rows of G determine least
    - displacement (n), of another guess from `nearest_positions`
    - row (n), a row of G
    - results of `factor_gram` at `nearest_positions`, and at NEW, the state after the last iteration
    """
    G = memory + 2 * n_rows
    x = G + n_entries
    change = x + n_rows
    nearest_positions = change + n
    change_from_guess = nearest_positions + n
    weakest_direction = change_from_guess + n
    displacement = weakest_direction + n
    row = displacement + n
    factors_at_nearest = row + n
    n_factors = n_entries + n_rows * (1 + n_rows + n_redundant) + 1
    factors_at_new = factors_at_nearest + n_factors
    return (
        G,
        x,
        change,
        nearest_positions,
        change_from_guess,
        weakest_direction,
        displacement,
        row,
        factors_at_nearest,
        factors_at_new,
        factors_at_new + n_factors,
    )


_memory_offsets = merged(offsets_in_memory)


@merged
def _largest_value(work, offset, count, k):
    """Return the largest |value| in lane k of `count` vectors from `offset` on, or NaN if a value is NaN."""
    largest = 0.0
    for j in range(count):
        magnitude = abs(work[(offset + j) * LANES + k])
        if magnitude > largest or np.isnan(magnitude):
            largest = magnitude
    return largest


@merged
def _constraints_hold(work, pattern, n, n_rows, C, G, new, k):
    """Return True if every constraint holds in lane k, up to the rounding errors of its terms."""
    tolerance = ROUNDING_FACTOR * np.finfo(np.float64).eps * _largest_value(work, new, n, k)
    for i in range(n_rows):
        off, terms = abs(work[(C + i) * LANES + k]), 0.0
        for e in range(pattern[i], pattern[i + 1]):
            terms += abs(work[(G + e - pattern[0]) * LANES + k])
        if off != 0.0 and not off <= tolerance * terms:
            return False
    return True


@compiled
def _gauss_newton(code, settings, control, pattern, moves, work):
    """Project the positions NEW onto the constraints by Gauss-Newton steps; set RUNNING to 0 where this fails."""
    n, n_rows, n_redundant = settings[at.N], settings[at.N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = offsets_in_work(n, n_rows, settings[at.N_NUMBERS])
    n_entries = pattern[n_rows] - pattern[0]
    G, x, change, _, _, _, _, row, _, factors, _ = _memory_offsets(memory, n, n_rows, n_entries, n_redundant)
    for k in range(LANES):
        work[at.UNCONVERGED * LANES + k] = work[at.RUNNING * LANES + k]
    for _ in range(MAX_ITERATIONS):
        fill_field(work, at.ACTIVE, 1.0)
        code.compute_rows(0, control, work)
        factor_gram(work, pattern, moves, n_rows, n_redundant, G, row, factors)
        copy_vectors(work, memory, x, n_rows)
        solve_least_change(work, pattern, n, n_rows, n_redundant, factors, x, change)
        n_left = 0.0
        for k in range(LANES):
            if work[at.UNCONVERGED * LANES + k] == 0.0:
                continue
            if work[at.ACTIVE * LANES + k] == 0.0 or not _largest_value(work, change, n, k) < np.inf:
                work[at.UNCONVERGED * LANES + k] = work[at.RUNNING * LANES + k] = 0.0
                continue
            for j in range(n):
                work[(new + j) * LANES + k] += work[(change + j) * LANES + k]
            # C was computed before `change` was added. If C was only a rounding error, the lane has converged
            if _constraints_hold(work, pattern, n, n_rows, memory, G, new, k):
                work[at.UNCONVERGED * LANES + k] = 0.0
            else:
                n_left += 1.0
        if n_left == 0.0:
            return
    for k in range(LANES):
        if work[at.UNCONVERGED * LANES + k] == 1.0:
            work[at.RUNNING * LANES + k] = 0.0


@compiled
def _project_velocities(code, settings, control, pattern, moves, work):
    """Project the velocities v of the state NEW so that C_q v + C_t = 0; set RUNNING to 0 in lanes where this fails."""
    n, n_rows, n_redundant = settings[at.N], settings[at.N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = offsets_in_work(n, n_rows, settings[at.N_NUMBERS])
    n_entries = pattern[n_rows] - pattern[0]
    G, x, change, _, _, _, _, row, factors, _, _ = _memory_offsets(memory, n, n_rows, n_entries, n_redundant)
    fill_field(work, at.ACTIVE, 1.0)
    code.compute_rows(0, control, work)
    factor_gram(work, pattern, moves, n_rows, n_redundant, G, row, factors)
    for _ in range(2):  # the second correction of v removes rounding errors that a large first correction left
        for i in range(n_rows):
            fill_field(work, x + i, 0.0)
            subtract_row_product(work, x + i, G, pattern, i, new + n)
            for k in range(LANES):
                work[(x + i) * LANES + k] = work[(memory + n_rows + i) * LANES + k] - work[(x + i) * LANES + k]
        solve_least_change(work, pattern, n, n_rows, n_redundant, factors, x, change)
        for j in range(n * LANES):
            work[(new + n) * LANES + j] += work[change * LANES + j]
    for k in range(LANES):
        if work[at.ACTIVE * LANES + k] == 0.0 or not _largest_value(work, new, 2 * n, k) < np.inf:
            work[at.RUNNING * LANES + k] = 0.0


@compiled
def _find_weakest_direction(work, pattern, n, n_rows, n_redundant, factors, x, correction, weakest):
    """Store in `weakest` the direction that constraints determine least, scaled to max|entry| of `correction`.

    Set RUNNING to 0 in lanes where more constraints are dependent than the known redundant ones.
    """
    scratch = factors + pattern[n_rows] - pattern[0] + n_rows * (1 + n_rows + n_redundant)
    for i in range(n_rows):
        fill_field(work, x + i, 0.5 + (GOLDEN_SECTION * (i + 1)) % 1.0)
    for _ in range(N_WEAKEST_ITERATIONS):
        normalise_vector(work, x, n_rows, scratch)
        solve_along_rows(work, pattern, n, n_rows, n_redundant, factors, x, weakest)
    normalise_vector(work, x, n_rows, scratch)
    min_eigenvalue = MIN_EIGENVALUE if n_redundant == 0 else MAX_REDUNDANT_EIGENVALUE * n_rows
    for k in range(LANES):
        if not work[scratch * LANES + k] > min_eigenvalue:  # `scratch` contains the smallest eigenvalue of G G^T
            work[at.RUNNING * LANES + k] = 0.0
        factor = _largest_value(work, correction, n, k) / max(_largest_value(work, weakest, n, k), DIAGONAL_SHIFT)
        for j in range(n):
            work[(weakest + j) * LANES + k] *= factor


@compiled
def _check_nearby_guesses(code, settings, control, pattern, moves, work):
    """Set RUNNING to 0 where the projection of one of OTHER_GUESSES fails, or is far from its linear prediction."""
    n, n_rows, n_redundant = settings[at.N], settings[at.N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = offsets_in_work(n, n_rows, settings[at.N_NUMBERS])
    _, x, change, nearest, correction, weakest, displacement, _, factors, _, _ = _memory_offsets(
        memory, n, n_rows, pattern[n_rows] - pattern[0], n_redundant
    )
    _find_weakest_direction(work, pattern, n, n_rows, n_redundant, factors, x, correction, weakest)
    for by_correction, by_weakest in OTHER_GUESSES:
        for j in range(n * LANES):
            shift = by_correction * work[correction * LANES + j] + by_weakest * work[weakest * LANES + j]
            work[displacement * LANES + j], work[new * LANES + j] = shift, work[nearest * LANES + j] + shift
        _gauss_newton(code, settings, control, pattern, moves, work)
        for i in range(n_rows):
            fill_field(work, x + i, 0.0)
            subtract_row_product(work, x + i, factors, pattern, i, displacement)
        # `change` becomes the component of the displacement that is normal to the constraints
        solve_along_rows(work, pattern, n, n_rows, n_redundant, factors, x, change)
        for k in range(LANES):
            distance, rounding = 0.0, ROUNDING_FACTOR * np.finfo(np.float64).eps * _largest_value(work, nearest, n, k)
            for j in range(n):
                m = j * LANES + k
                expected = work[nearest * LANES + m] + work[displacement * LANES + m] - work[change * LANES + m]
                distance = max(distance, abs(work[new * LANES + m] - expected))
            if not distance <= MAX_CURVATURE * _largest_value(work, displacement, n, k) + rounding:
                work[at.RUNNING * LANES + k] = 0.0


_START_SIGNATURE = types.void(CODE, INTEGERS, VECTOR, *[INTEGERS] * 2, *[types.float64[:, ::1]] * 3, INTEGERS, VECTOR)


@kernel(_START_SIGNATURE, vectorized=True)
def start_lanes(code, settings, control, pattern, moves, numbers, q, v, valid, work):
    """Replace the states q and v (n_runs, n) by their projections onto the constraints at t0.

    `valid` (n_runs,) becomes 1 for runs whose projection succeeds without another assembly nearby, otherwise 0.
    pattern : sparsity pattern of C_q, see module docstring; moves : (n,) 1 for coordinates that may change, else 0;
    numbers : (n_runs, n_numbers) data of the generated code.
    """
    n, n_rows, n_redundant, n_runs = settings[at.N], settings[at.N_ROWS], settings[N_REDUNDANT], numbers.shape[0]
    _, new, _, _, _, _, own, memory = offsets_in_work(n, n_rows, numbers.shape[1])
    _, _, _, nearest_positions, change_from_guess, _, _, row, _, _, _ = _memory_offsets(
        memory, n, n_rows, pattern[n_rows] - pattern[0], n_redundant
    )
    fill_field(work, at.T_NEW, control[at.T0])
    for j in range(n):
        fill_field(work, row + j, 0.0)
    for first in range(0, n_runs, LANES):
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            work[at.RUNNING * LANES + k] = 1.0
            for j in range(n):
                work[(new + j) * LANES + k], work[(new + n + j) * LANES + k] = q[run, j], v[run, j]
            for i in range(numbers.shape[1]):
                work[(own + i) * LANES + k] = numbers[run, i]
        _gauss_newton(code, settings, control, pattern, moves, work)
        _project_velocities(code, settings, control, pattern, moves, work)
        copy_vectors(work, new, nearest_positions, n)
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            for j in range(n):
                work[(change_from_guess + j) * LANES + k] = work[(new + j) * LANES + k] - q[run, j]
        _check_nearby_guesses(code, settings, control, pattern, moves, work)
        for k in range(min(LANES, n_runs - first)):
            valid[first + k] = int(work[at.RUNNING * LANES + k])
            for j in range(n):
                q[first + k, j] = work[(nearest_positions + j) * LANES + k]
                v[first + k, j] = work[(new + n + j) * LANES + k]


TABLE, STATES = types.float64[:, ::1], types.float64[:, :, ::1]


@compiled
def _relative_residual(value, allowed):
    """Return |value| / allowed: 0 if `value` is zero; infinity if only `allowed` is zero, or `value` is not finite."""
    if not np.isfinite(value):
        return np.inf
    if value == 0.0:
        return 0.0
    return abs(value) / allowed if allowed > 0.0 else np.inf


@kernel(types.void(KIT, INTEGERS, f8, f8, f8, INTEGERS, TABLE, STATES, STATES, TABLE, VECTOR, VECTOR))
def motion_residuals(f, sizes, t, rtol, atol, runs, parameters, states_q, states_v, ends, scratch, worst):
    """Store in worst[k] the largest residual of the equations, relative to its limit, at the end of run runs[k].

    The equations are C = 0, C_q v + C_t = 0, C_q a = gamma (if given) and M a + C_q^T lam = Q. The limit is `rtol`
    times the magnitude of an equation's terms; for constraints, the effect of errors `atol` of q, v or a is added.
    sizes : n, n_c and the index in f.p of the first parameter; runs : (m,) indices of runs, or -1 to skip an entry;
    parameters : (n_runs, n_p); states_q, states_v : (m, n, n_t), with the end as the last time; ends : (m, n + n_c)
    a and lam at the end; scratch : (n (n + 3) + n_c (n + 3),) overwritten; worst : (m,).
    """
    n, n_c, first = sizes[0], sizes[1], sizes[2]
    M, Q = scratch[: n * n].reshape((n, n)), scratch[n * n : n * n + n]
    offset = n * n + n
    G = scratch[offset : offset + n_c * n].reshape((n_c, n))
    offset += n_c * n
    C, rate = scratch[offset : offset + n_c], scratch[offset + n_c : offset + 2 * n_c]
    gamma = scratch[offset + 2 * n_c : offset + 3 * n_c]
    offset += 3 * n_c
    q, v, last = scratch[offset : offset + n], scratch[offset + n : offset + 2 * n], states_q.shape[2] - 1
    has_gamma = f.gamma_given == 1
    for k in range(runs.size):
        if runs[k] < 0:
            continue
        scratch[:] = 0.0
        for j in range(parameters.shape[1]):
            f.p[first + j] = parameters[runs[k], j]
        largest_q, largest_v, largest = 0.0, 0.0, 0.0
        for j in range(n):
            q[j], v[j] = states_q[k, j, last], states_v[k, j, last]
            largest_q, largest_v = max(largest_q, abs(q[j])), max(largest_v, abs(v[j]))
        a, lam = ends[k, :n], ends[k, n:]
        f.mass(t, q, f.p, M)
        f.force(t, q, v, f.p, Q)
        f.constraint(t, q, f.p, C)
        f.jacobian(t, q, f.p, G)
        f.constraint_rate(t, q, f.p, rate)
        if has_gamma:
            f.gamma(t, q, v, f.p, gamma)
        for i in range(n_c):
            row, sum_v, off, terms = 0.0, rate[i], -gamma[i], abs(gamma[i])
            for j in range(n):
                row += abs(G[i, j])
                sum_v += G[i, j] * v[j]
                off += G[i, j] * a[j]
                terms += abs(G[i, j] * a[j])
            largest = max(largest, _relative_residual(C[i], row * (rtol * largest_q + atol)))
            largest = max(largest, _relative_residual(sum_v, row * (rtol * largest_v + atol) + rtol * abs(rate[i])))
            if has_gamma:
                largest = max(largest, _relative_residual(off, rtol * terms + row * atol))
        largest_force, residual = 0.0, 0.0
        for j in range(n):
            total, largest_term = -Q[j], abs(Q[j])
            for m in range(n):
                term = M[j, m] * a[m]
                total, largest_term = total + term, max(largest_term, abs(term))
            for i in range(n_c):
                term = G[i, j] * lam[i]
                total, largest_term = total + term, max(largest_term, abs(term))
            largest_force = max(largest_force, largest_term)
            residual = max(residual, abs(total)) if np.isfinite(total) else np.inf
        largest = max(largest, _relative_residual(residual, rtol * largest_force))
        worst[k] = largest


@kernel(types.void(KIT, INTEGERS, f8, f8, TABLE, TABLE, TABLE, VECTOR, VECTOR))
def constraint_residuals(f, sizes, t, min_speed, parameters, q, v, scratch, worst):
    """Store in worst[k] the largest relative residual of C = 0 and C_q v + C_t = 0 at the state (q[k], v[k]).

    C_i is divided by s_i max|q_j|, where s_i is the sum of |entries| in row i of C_q. The residual of velocities is
    divided by s_i max(max|v_j|, min_speed) + |C_t|; min_speed is for states at rest. parameters : (n_states, n_p);
    sizes : n, n_c and the index in f.p of the first parameter; scratch : (n_c (n + 2),) overwritten.
    """
    n, n_c, first = sizes[0], sizes[1], sizes[2]
    C, rate, G = scratch[:n_c], scratch[n_c : 2 * n_c], scratch[2 * n_c :].reshape((n_c, n))
    for k in range(q.shape[0]):
        scratch[:] = 0.0
        for j in range(parameters.shape[1]):
            f.p[first + j] = parameters[k, j]
        f.constraint(t, q[k], f.p, C)
        f.jacobian(t, q[k], f.p, G)
        f.constraint_rate(t, q[k], f.p, rate)
        largest_q, largest_v, worst[k] = 0.0, min_speed, 0.0
        for j in range(n):
            largest_q, largest_v = max(largest_q, abs(q[k, j])), max(largest_v, abs(v[k, j]))
        for i in range(n_c):
            row, sum_v = 0.0, rate[i]
            for j in range(n):
                row += abs(G[i, j])
                sum_v += G[i, j] * v[k, j]
            worst[k] = max(
                worst[k],
                _relative_residual(C[i], row * largest_q),
                _relative_residual(sum_v, row * largest_v + abs(rate[i])),
            )

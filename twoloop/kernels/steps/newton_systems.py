"""Solve the linear systems of Newton's method in implicit steps: one for each eigenvalue l of the tableau's matrix A.

Let z be h l, where h is the step size. J_q and J_v are the derivatives of the accelerations by the independent
positions and velocities. The corrections x of the independent accelerations a_i solve
(I - z^2 J_q - z J_v) x = r, where r is the residual of the equations for a_i. The velocities that the constraints allow
are v = T v_i, T = [I; -Cqd^-1 Cqi], where Cqd and Cqi are the dependent and independent columns of C_q. Multiplied by
T^T M T, the system becomes (`f`: kit, `w`: workspace)

    T^T (M - z^2 K - z D) T x = T^T M T r.

K and D, called tangents, are the derivatives of Q - Cq^T lam by q and v, at constant lam. This omits the dependence
of T and M on q, and of gamma on v. The omitted terms are not stiff, and are zero for linear constraints, so that a
simplified Newton's method does not need them. Under step-size control, steps are as long as with these terms. Without
them, fixed steps in which a body turns by some 0.4 rad may fail; with differences of the accelerations, they converge.

X = T x also solves a system with a bordered matrix, with Cq^T and Cq as the border,

    [[M - z^2 K - z D, Cq^T], [Cq, 0]] [X; mu] = [M T r; 0].

There are three kinds of storage:

- dense: J_q and J_v (n_dof, n_dof), from the tangents K and D if the system provides them, otherwise by differences of
  the accelerations;
- banded, if the system has a bandwidth b: K, D and the border, at a cost proportional to n_q. Without tangents, K and D
  are computed by differences, in 2 b + 1 groups of columns without common rows (doi 10.1093/imamat/13.1.117);
- sparse, for large systems: all coordinates are treated as independent, and the bordered matrix, with the right-hand
  side [M r; G r], has a fixed sparsity pattern. K and D are computed by differences in groups of columns. Then all
  coordinates are displaced at once; if the residual does not change as K and D predict, the pattern lacks entries that
  were zero when it was recorded, and other storage is needed.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, finite_vector, inlined, merged, typical_size
from twoloop.kernels.data.indices import ATOL, DONE, FIXED_ORDER, NEEDS_DENSE, NOT_FINITE, RTOL, SINGULAR
from twoloop.kernels.evaluation.constraints import constraint_rows
from twoloop.kernels.evaluation.inner_loop import evaluate, find_tangents
from twoloop.kernels.evaluation.sparse_inner_loop import fill_jacobian_values
from twoloop.kernels.linalg.band import (
    DGBTRF,
    DGBTRS,
    ZGBTRF,
    ZGBTRS,
    add_banded_mass_times,
    factor_bordered,
    lu_band,
    solve_bordered,
)
from twoloop.kernels.linalg.dense import copy, copy_matrix, largest_of, ldl_factor, ldl_solve_rows, lu_factor, lu_solve
from twoloop.kernels.linalg.markowitz_lu import columns_of
from twoloop.kernels.linalg.sparse_ldl import add_terms_of_redundant_rows
from twoloop.kernels.linalg.sparse_lu import factor as factor_lu
from twoloop.kernels.linalg.sparse_lu import fill_newton_matrix, tangent_entries_of
from twoloop.kernels.linalg.sparse_lu import solve as solve_lu
from twoloop.kernels.linalg.symbolic_factorization import (
    N_OF_MASS,
    N_OFF_DIAGONAL,
    N_PIVOTS,
    jacobian_entries_of,
    mass_entries_of,
)
from twoloop.kernels.steps import stages as at
from twoloop.kernels.steps.stages import (
    as_matrix,
    block,
    complex_vector,
    count_systems,
    matrix_storage,
    newton_options_index,
    pivots_of,
    system_storage,
    vector,
)

MAX_ITERATIONS = 15  # largest number of Newton iterations: if they do not converge, the step fails
EQUAL_STEP_TOLERANCE = 1e-9  # step sizes count as equal up to this relative difference, which rounding of times causes
# because of rounding, corrections may stay above the tolerance of Newton's method. So the method has also converged
# if the last correction is at most this fraction of the smallest tolerance of the run
MAX_ROUNDING_CORRECTION = 0.1

RELATIVE_DISPLACEMENT = 1e-7  # (displacement of a coordinate or velocity in finite differences) / (typical size)
# if all coordinates are displaced at once, the displacement of coordinate i is multiplied by
# 1 + DISPLACEMENT_INCREMENT * (i % N_INCREMENTS): the effects of equal displacements might cancel each other
DISPLACEMENT_INCREMENT, N_INCREMENTS = 0.37, 7

# --- tangents K and D (derivatives of the forces by q and v): only the band |i - j| <= b is computed and read


@inlined
def _displacement_sizes(tolerances, x):
    """Return two sizes of x (q or v) for finite differences: the typical one, and the largest |component|."""
    return typical_size(tolerances, x), largest_of(x)


@merged
def displaced(x, typical_size, largest, rtol, atol):
    """Return x, a coordinate or velocity, plus a displacement for finite differences.

    It is RELATIVE_DISPLACEMENT * max(|x|, typical_size, min(largest, atol / rtol)); `largest` is the largest coordinate
    or velocity. Without the last of these sizes, the displacement would be a rounding error where x is zero, but
    others are large.
    """
    size = max(typical_size, abs(x))
    if rtol > 0.0:
        size = max(size, min(largest, atol / rtol))
    return x + RELATIVE_DISPLACEMENT * size


@inlined
def _displaced(tolerances, x, sizes, j):
    return displaced(x[j], sizes[0], sizes[1], tolerances[RTOL], tolerances[ATOL + j])


@inlined
def _displaced_unequally(tolerances, x, sizes, j, index):
    """Return x_j plus a displacement that depends on the coordinate's `index`, see DISPLACEMENT_INCREMENT."""
    displacement = _displaced(tolerances, x, sizes, j) - x[j]
    return x[j] + displacement * (1.0 + DISPLACEMENT_INCREMENT * (index % N_INCREMENTS))


@compiled
def _clear_band(A, b):
    """Set the entries of the matrix A with |i - j| <= b (bandwidth) to zero."""
    for i in range(A.shape[0]):
        for j in range(max(0, i - b), min(A.shape[0], i + b + 1)):
            A[i, j] = 0.0


@compiled
def _check_band_finite(A, b):
    """Return DONE, or NOT_FINITE if an entry of the matrix A with |i - j| <= b (bandwidth) is not finite."""
    for i in range(A.shape[0]):
        for j in range(max(0, i - b), min(A.shape[0], i + b + 1)):
            if not np.isfinite(A[i, j]):
                return NOT_FINITE
    return DONE


@compiled
def _has_jacobian_changed(f, w, t, q):
    """Store C_q at (t, q) in w.Gx; return True if w.Gx differs from the C_q in w.G."""
    w.Gx[:, :] = 0.0
    constraint_rows(f, w, t, q, w.Gx)
    for i in range(w.C.size):
        for j in range(q.size):
            if w.Gx[i, j] != w.G[i, j]:
                return True
    return False


@compiled
def _subtract_reaction_tangent(f, w, tolerances, t, q, moved, b, K):
    """Subtract d(C_q^T lam)/dq, computed by differences, from the entries of K (n_q, n_q) with |i - j| <= b.

    w.G must be C_q at (t, q). Coordinates j, j + 2 b + 1, ... affect different rows, and are displaced together.
    """
    n = q.size
    sizes = _displacement_sizes(tolerances, q)
    for j in range(n):
        moved[j] = _displaced_unequally(tolerances, q, sizes, j, j)
    if not _has_jacobian_changed(f, w, t, moved):
        return
    width = min(n, 2 * b + 1)
    for group in range(width):
        copy(q, moved)
        for j in range(group, n, width):
            moved[j] = _displaced(tolerances, q, sizes, j)
        if not _has_jacobian_changed(f, w, t, moved):
            continue
        for j in range(group, n, width):
            displacement = moved[j] - q[j]
            for i in range(max(0, j - b), min(n, j + b + 1)):
                for k in range(w.C.size):
                    K[i, j] -= (w.Gx[k, i] - w.G[k, i]) * w.lam[k] / displacement


@compiled
def fill_tangent_by_q(f, w, tolerances, t, q, v, b, moved, K, R):
    """Store K (n_q, n_q), derivative of the forces with reactions, Q - C_q^T lam, by q: the entries with |i - j| <= b.

    Return a code. The last evaluation must have been at (t, q, v). b: bandwidth. `moved` (n_q), R (n_q, n_q): scratch.
    """
    _clear_band(K, b)
    f.force_by_q(t, q, v, f.p, K)
    if f.reaction_by_q_given == 1:
        _clear_band(R, b)
        f.reaction_by_q(t, q, w.lam, f.p, R)
        for i in range(q.size):
            for j in range(max(0, i - b), min(q.size, i + b + 1)):
                K[i, j] -= R[i, j]
    else:
        _subtract_reaction_tangent(f, w, tolerances, t, q, moved, b, K)
    return _check_band_finite(K, b)


@compiled
def fill_tangent_by_v(f, t, q, v, b, D):
    """Store the band |i - j| <= b of dQ/dv (Q: forces) in D, if a callback gives it; return DONE or NOT_FINITE."""
    if f.force_by_v_given == 0:
        return DONE
    _clear_band(D, b)
    f.force_by_v(t, q, v, f.p, D)
    return _check_band_finite(D, b)


# --- dense storage


@compiled
def reduce_to_independents(w, matrix, matrix_T, reduced):
    """Project a matrix (n_q, n_q), such as M, onto the velocities v = T v_i that C_q allows.

    Store matrix T in matrix_T (n_q, n_dof), and T^T matrix T in `reduced` (n_dof, n_dof).
    """
    n, m = matrix_T.shape
    columns = columns_of(w.index)
    for i in range(n):
        for k in range(m):
            matrix_T[i, k] = matrix[i, w.independent[k]]
        for c in range(columns.size):
            factor = matrix[i, columns[c]]
            if factor != 0.0:
                for k in range(m):
                    matrix_T[i, k] += factor * w.D[k, c]
    for l in range(m):
        copy(matrix_T[w.independent[l]], reduced[l])
        for c in range(columns.size):
            factor = w.D[l, c]
            if factor != 0.0:
                row = matrix_T[columns[c]]
                for k in range(m):
                    reduced[l, k] += factor * row[k]


@compiled
def _fill_jacobians_from_tangents(f, w, tolerances, memory, s, t, q, v):
    """Compute J_q, J_v (derivatives of accelerations by q_i, v_i) from those of forces, K and D; return a code."""
    n = q.size
    m = w.independent.size
    w.n_jacobians += 1
    # the storage of old factors is free now: use it for K (later D), T^T M T, and products such as K T
    K, R = as_matrix(matrix_storage(w, n, at.FILTER), n), as_matrix(matrix_storage(w, n, at.SYSTEMS), n)
    code = fill_tangent_by_q(f, w, tolerances, t, q, v, n - 1, vector(memory, s, n, at.Q_MOVED), K, R)
    if code != DONE:
        return code
    AT = matrix_storage(w, n, at.SYSTEMS + 1)[: n * m].reshape((n, m))
    code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    Jq, Jv = as_matrix(matrix_storage(w, n, at.DERIVATIVE_Q), m), as_matrix(matrix_storage(w, n, at.DERIVATIVE_V), m)
    N = as_matrix(matrix_storage(w, n, at.SYSTEMS), m)
    reduce_to_independents(w, w.M, AT, N)
    if not ldl_factor(N):
        return SINGULAR
    reduce_to_independents(w, K, AT, Jq)
    ldl_solve_rows(N, Jq)
    memory[at.HAS_DAMPING] = f.force_by_v_given
    code = fill_tangent_by_v(f, t, q, v, n - 1, K)
    if code == DONE and memory[at.HAS_DAMPING] == 1.0:
        reduce_to_independents(w, K, AT, Jv)
        ldl_solve_rows(N, Jv)
    return code


@compiled
def _fill_by_differences(f, w, options, tolerances, t, q, v, a, by_v, q_moved, v_moved, a_new, J):
    """Store in J the derivative of accelerations by q_i (if `by_v`, by v_i); `a`: accelerations at (t, q, v)."""
    base, moved = (v, v_moved) if by_v else (q, q_moved)
    sizes = _displacement_sizes(tolerances, base)
    for column in range(w.independent.size):
        j = w.independent[column]
        copy(q, q_moved)
        copy(v, v_moved)
        moved[j] = _displaced(tolerances, base, sizes, j)
        displacement = moved[j] - base[j]
        code = evaluate(f, w, t, q_moved, v_moved, options[at.INNER_TOL], a_new)
        if code != DONE:
            return code
        for row in range(w.independent.size):
            i = w.independent[row]
            J[row, column] = (a_new[i] - a[i]) / displacement
    return DONE


@compiled
def _fill_dense_jacobians(f, w, options, tolerances, memory, s, t, q, v, a):
    """Store J_q and J_v, the derivatives of the accelerations by q_i and v_i; `a`: accelerations at (t, q, v)."""
    if f.force_by_q_given == 1 and w.Rate.size == w.C.size:
        return _fill_jacobians_from_tangents(f, w, tolerances, memory, s, t, q, v)
    n = q.size
    m = w.independent.size
    Jq, Jv = as_matrix(matrix_storage(w, n, at.DERIVATIVE_Q), m), as_matrix(matrix_storage(w, n, at.DERIVATIVE_V), m)
    q_moved, v_moved = vector(memory, s, n, at.Q_MOVED), vector(memory, s, n, at.V_MOVED)
    a_new = vector(memory, s, n, at.A_NEW)
    w.n_jacobians += 1
    code = _fill_by_differences(f, w, options, tolerances, t, q, v, a, False, q_moved, v_moved, a_new, Jq)
    if code != DONE:
        return code
    # displace all velocities at once: if this changes no acceleration, J_v, the derivative by velocities, is zero
    copy(q, q_moved)
    sizes = _displacement_sizes(tolerances, v)
    for column in range(m):
        j = w.independent[column]
        v_moved[j] = _displaced_unequally(tolerances, v, sizes, j, column)
    code = evaluate(f, w, t, q_moved, v_moved, options[at.INNER_TOL], a_new)
    if code != DONE:
        return code
    memory[at.HAS_DAMPING] = 0.0
    for i in w.independent:
        if a_new[i] != a[i]:
            memory[at.HAS_DAMPING] = 1.0
    if memory[at.HAS_DAMPING] == 0.0:
        return DONE
    return _fill_by_differences(f, w, options, tolerances, t, q, v, a, True, q_moved, v_moved, a_new, Jv)


@compiled
def _factor_dense_matrix(w, memory, s, index, z, matrix):
    """Compute and factorize Newton's matrix I - z^2 J_q - z J_v (J_q, J_v: derivatives of accelerations) in `matrix`.

    Return DONE or SINGULAR. `index`: where pivots are stored, see `pivots_of`.
    """
    n, m = w.Q.size, w.independent.size
    Jq, Jv = as_matrix(matrix_storage(w, n, at.DERIVATIVE_Q), m), as_matrix(matrix_storage(w, n, at.DERIVATIVE_V), m)
    damped = memory[at.HAS_DAMPING] == 1.0
    for i in range(m):
        for j in range(m):
            matrix[i, j] = -z * z * Jq[i, j]
            if damped:
                matrix[i, j] -= z * Jv[i, j]
        matrix[i, i] += 1.0
    return DONE if lu_factor(matrix, pivots_of(memory, s, n, index)) > 0.0 else SINGULAR


@compiled
def _filter_error_dense(w, options, memory, s, h, e_q, e_v):
    """Filter e_v (error estimate of v_i) as `filter_error` does, with dense factors; e_q: error estimate of q_i."""
    n = w.Q.size
    m = e_q.size
    gamma0 = options[newton_options_index(s) + at.GAMMA0]
    Jq = as_matrix(matrix_storage(w, n, at.DERIVATIVE_Q), m)
    for i in range(m):
        total = 0.0
        for j in range(m):
            total += Jq[i, j] * e_q[j]
        e_v[i] += h * gamma0 * total
    lu_solve(as_matrix(matrix_storage(w, n, at.FILTER), m), pivots_of(memory, s, n, 0), e_v)


# --- banded storage


@inlined
def _band_view(numbers, n, b):
    """Return a view (n, 2 b + 1) of the band of a matrix K in `numbers`; element [i, b + j - i] of the view is K_ij."""
    return numbers[: n * (2 * b + 1)].reshape((n, 2 * b + 1))


@inlined
def _border_views(w, n, r, b):
    """Return three arrays that were stored together with K: independent rows of C_q, w.D, and dependent coordinates.

    Sizes: (r, n), (n - r + 1, r), (r); r: number of rows. w.D contains, transposed, the derivative of the dependent
    velocities by the independent ones, then the dependent velocities due to C_t. The arrays follow the band of K.
    """
    numbers = matrix_storage(w, n, at.DERIVATIVE_Q)
    start = n * (2 * b + 1)
    Cq = numbers[start : start + r * n].reshape((r, n))
    start += r * n
    D = numbers[start : start + r * (n - r + 1)].reshape((n - r + 1, r))
    start += r * (n - r + 1)
    return Cq, D, numbers[start : start + r].view(np.int64)


@compiled
def _update_banded_residual(f, w, t, q, v):
    """Store the forces with reactions, Q - C_q^T w.lam, at (t, q, v) in w.Q, and C_q in w.Gx."""
    w.n_evaluations += 1
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    w.Gx[:, :] = 0.0
    constraint_rows(f, w, t, q, w.Gx)
    for i in range(w.lam.size):
        for j in range(q.size):
            w.Q[j] -= w.Gx[i, j] * w.lam[i]


@compiled
def _fill_band(f, w, tolerances, t, q, v, by_v, base, moved, b, band):
    """Store in `band` the tangent K, or D if `by_v`, by finite differences at (t, q, v); return DONE or NOT_FINITE.

    K and D: derivatives of Q - C_q^T lam by q and v. Columns j, j + 2 b + 1, ... have no rows in common: one difference
    yields them all. `base`: Q - C_q^T lam at (t, q, v); `moved` (n_q): scratch.
    """
    n = q.size
    base_point = v if by_v else q
    sizes = _displacement_sizes(tolerances, base_point)
    for group in range(2 * b + 1):
        copy(base_point, moved)
        for j in range(group, n, 2 * b + 1):
            moved[j] = _displaced(tolerances, base_point, sizes, j)
        if by_v:
            _update_banded_residual(f, w, t, q, moved)
        else:
            _update_banded_residual(f, w, t, moved, v)
        for j in range(group, n, 2 * b + 1):
            displacement = moved[j] - base_point[j]
            for i in range(max(0, j - b), min(n, j + b + 1)):
                band[i, b + j - i] = (w.Q[i] - base[i]) / displacement
                if not np.isfinite(band[i, b + j - i]):
                    return NOT_FINITE
    return DONE


@compiled
def _copy_band(A, b, band):
    """Copy the entries of A (n, n) with |i - j| <= b to `band` (n, 2 b + 1), see `_band_view`."""
    n = A.shape[0]
    for i in range(n):
        for j in range(max(0, i - b), min(n, i + b + 1)):
            band[i, b + j - i] = A[i, j]


@compiled
def _fill_bands_from_callbacks(f, w, tolerances, memory, s, t, q, v, b):
    """Store the bands of K and D (derivatives of Q - C_q^T lam by q, v), which callbacks provide; return a code."""
    n = q.size
    K, R = matrix_storage(w, n, at.FILTER).reshape((n, n)), matrix_storage(w, n, at.SYSTEMS).reshape((n, n))
    code = fill_tangent_by_q(f, w, tolerances, t, q, v, b, vector(memory, s, n, at.Q_MOVED), K, R)
    if code != DONE:
        return code
    _copy_band(K, b, _band_view(matrix_storage(w, n, at.DERIVATIVE_Q), n, b))
    memory[at.HAS_DAMPING] = f.force_by_v_given
    code = fill_tangent_by_v(f, t, q, v, b, K)
    if memory[at.HAS_DAMPING] == 1.0:
        _copy_band(K, b, _band_view(matrix_storage(w, n, at.DERIVATIVE_V), n, b))
    return code


@compiled
def _fill_banded_tangents(f, w, tolerances, memory, s, t, q, v):
    """Store bands of K and D (derivatives of Q - C_q^T lam by q, v) and arrays for `_border_views`; return a code."""
    n = q.size
    b = f.bandwidth
    w.n_jacobians += 1
    Cq, D, columns = _border_views(w, n, w.rows.size, b)
    for i in range(w.rows.size):
        copy(w.G[w.rows[i]], Cq[i])
    code = find_tangents(f, w, t, q)
    if code != DONE:
        return code
    copy_matrix(w.D, D)
    copy(columns_of(w.index), columns)
    if f.force_by_q_given == 1:
        return _fill_bands_from_callbacks(f, w, tolerances, memory, s, t, q, v, b)
    base, moved = vector(memory, s, n, at.A_NEW), vector(memory, s, n, at.Q_MOVED)
    _update_banded_residual(f, w, t, q, v)
    copy(w.Q, base)
    code = _fill_band(
        f, w, tolerances, t, q, v, False, base, moved, b, _band_view(matrix_storage(w, n, at.DERIVATIVE_Q), n, b)
    )
    if code != DONE:
        return code
    # displace all velocities at once: if this does not change the residual, the derivative D by velocities is zero
    sizes = _displacement_sizes(tolerances, v)
    for j in range(n):
        moved[j] = _displaced_unequally(tolerances, v, sizes, j, j)
    _update_banded_residual(f, w, t, q, moved)
    memory[at.HAS_DAMPING] = 0.0
    for i in range(n):
        if w.Q[i] != base[i]:
            memory[at.HAS_DAMPING] = 1.0
    if memory[at.HAS_DAMPING] == 0.0:
        return DONE
    return _fill_band(
        f, w, tolerances, t, q, v, True, base, moved, b, _band_view(matrix_storage(w, n, at.DERIVATIVE_V), n, b)
    )


@compiled
def _factor_banded(w, memory, s, b, index, z, numbers, factorize, substitute):
    """Store factors of Newton's bordered matrix [[M - z^2 K - z D, Cq^T], [Cq, 0]] in `numbers`; return a code.

    `index`: where pivots are stored, see `pivots_of`. `factorize`, `substitute`: LAPACK routines, complex if z is.
    """
    n = w.Q.size
    K = _band_view(matrix_storage(w, n, at.DERIVATIVE_Q), n, b)
    D = _band_view(matrix_storage(w, n, at.DERIVATIVE_V), n, b)
    damped = memory[at.HAS_DAMPING] == 1.0
    band = lu_band(numbers, n, b)
    for i in range(n):
        for j in range(max(0, i - b), min(n, i + b + 1)):
            value = w.M[i, j] - z * z * K[i, b + j - i]
            if damped:
                value -= z * D[i, b + j - i]
            band[j, 2 * b + i - j] = value
    Cq, _, _ = _border_views(w, n, w.rows.size, b)
    return factor_bordered(w, b, Cq, numbers, pivots_of(memory, s, n, index), factorize, substitute)


@compiled
def _multiply_by_T(w, b, x, X):
    """Store in X = T x (n_q) the independent velocities x[:n_dof], and the dependent velocities that they determine."""
    n_dof = w.independent.size
    _, D, columns = _border_views(w, w.Q.size, w.rows.size, b)
    for i in columns:
        X[i] = 0.0
    for k in range(n_dof):
        X[w.independent[k]] = x[k]
        for i in range(columns.size):
            X[columns[i]] += D[k, i] * x[k]


@compiled
def _solve_and_keep_independents(w, b, numbers, pivots, substitute, x):
    """Solve the bordered system with right-hand side x (n_q); store the result's independent entries in x[:n_dof]."""
    Cq, _, _ = _border_views(w, x.size, w.rows.size, b)
    solve_bordered(w, b, Cq, numbers, pivots, substitute, x)
    for k in range(w.independent.size):  # in ascending order, no entry is overwritten before it is read
        x[k] = x[w.independent[k]]


@compiled
def _filter_error_banded(f, w, options, memory, s, h, e_q, e_v):
    """Filter e_v (error estimate of v_i) as `filter_error` does, with banded factors; e_q: error estimate of q_i."""
    n = w.Q.size
    b = f.bandwidth
    z = h * options[newton_options_index(s) + at.GAMMA0]
    K, X = _band_view(matrix_storage(w, n, at.DERIVATIVE_Q), n, b), vector(memory, s, n, at.Q_MOVED)
    _multiply_by_T(w, b, e_v, X)
    e_v[:] = 0.0
    add_banded_mass_times(f, w, X, e_v)
    _multiply_by_T(w, b, e_q, X)
    for i in range(n):
        for j in range(max(0, i - b), min(n, i + b + 1)):
            e_v[i] += z * K[i, b + j - i] * X[j]
    pivots = pivots_of(memory, s, n, 0)
    _solve_and_keep_independents(w, b, matrix_storage(w, n, at.FILTER), pivots, DGBTRS, e_v)


# --- sparse storage, for all coordinates

# the change of component i of the residual by a displacement d of q is compared with sum_j K_ij d_j. If they differ by
# more than this fraction of sum_j |K_ij d_j|, then K lacks entries. D, the derivative by v, is tested like K
MAX_DEVIATION = 0.2
RESIDUAL_ROUNDING = 1e-13  # rounding error of a difference of residuals, relative to the largest term of a residual
N_SPARSE_VECTORS = 3  # number of real scratch vectors, which _sparse_scratch returns first


def matrices_size(program: np.ndarray, n_mass: int, n_jacobian: int, n_systems: int) -> int:
    """Return the length of w.matrices in sparse storage, for n_systems complex systems of Newton's method.

    n_mass, n_jacobian: numbers of stored entries of M and G. `program`: factorizes Newton's matrix.
    """
    n = int(program[N_PIVOTS])
    n_tangents = int(program[N_OF_MASS]) - n_mass
    n_factors = n + 2 * int(program[N_OFF_DIAGONAL])
    return n_mass + n_jacobian + 2 * n_tangents + (N_SPARSE_VECTORS + 7) * n + (1 + 2 * n_systems) * n_factors


@inlined
def _sparse_derivative_views(f, w):
    """Return six views of w.matrices: the entries of M, G, K and D, then `is_independent` and `stiffness`.

    For each row g of G, `is_independent` is 1 or 0. If s g^T g is added to a singular M, `stiffness` is the factor s.
    """
    n_mass, n_jacobian, n_rows = w.mass_values.size, w.jacobian_values.size, w.is_independent.size
    begin_K = n_mass + n_jacobian
    begin_D = begin_K + mass_entries_of(f.newton_program)[0].size - n_mass
    begin_counts = begin_D + begin_D - begin_K
    numbers = w.matrices
    return (
        numbers[:n_mass],
        numbers[n_mass:begin_K],
        numbers[begin_K:begin_D],
        numbers[begin_D:begin_counts],
        numbers[begin_counts : begin_counts + n_rows],
        numbers[begin_counts + n_rows : begin_counts + 2 * n_rows],
    )


@inlined
def _sparse_scratch(f, w):
    """Return scratch views of w.matrices: three vectors (n_q), one (N, the number of pivots), two complex ones (N)."""
    n, begin = f.newton_program[N_PIVOTS], w.mass_values.size + w.jacobian_values.size
    begin += 2 * (mass_entries_of(f.newton_program)[0].size - w.mass_values.size) + 2 * n
    n_q, numbers = w.Q.size, w.matrices
    begin_sizes = begin + N_SPARSE_VECTORS * n
    return (
        numbers[begin : begin + n_q],
        numbers[begin + n : begin + n + n_q],
        numbers[begin + 2 * n : begin + 2 * n + n_q],
        numbers[begin_sizes : begin_sizes + n],
        numbers[begin_sizes + n : begin_sizes + 3 * n].view(np.complex128),
        numbers[begin_sizes + 3 * n : begin_sizes + 5 * n].view(np.complex128),
    )


@inlined
def _sparse_factor_view(f, w, k):
    """Return a real view of the factors of the matrix in `filter_error` (k = 0), or of linear system k - 1 (k > 0)."""
    n = f.newton_program[N_PIVOTS]
    n_factors = n + 2 * f.newton_program[N_OFF_DIAGONAL]
    begin = w.mass_values.size + w.jacobian_values.size + (N_SPARSE_VECTORS + 7) * n
    begin += 2 * (mass_entries_of(f.newton_program)[0].size - w.mass_values.size)
    if k == 0:
        return w.matrices[begin : begin + n_factors]
    return w.matrices[begin + (2 * k - 1) * n_factors : begin + (2 * k + 1) * n_factors]


@compiled
def _fill_sparse_residual(f, w, t, q, v, renews_G, out):
    """Store the forces with reactions, Q - G^T w.lam, at (t, q, v) in `out` (n_q); return its largest |term|.

    The entries of G are in w.jacobian_values; if `renews_G`, evaluate them at (t, q) first.
    """
    w.n_evaluations += 1
    out[:] = 0.0
    f.force(t, q, v, f.p, out)
    if renews_G:
        fill_jacobian_values(f, w, t, q)
    largest = 0.0
    for j in range(out.size):
        largest = max(largest, abs(out[j]))
    rows, columns, _ = jacobian_entries_of(f.newton_program)
    for k in range(rows.size):
        term = w.jacobian_values[k] * w.lam[rows[k]]
        largest = max(largest, abs(term))
        out[columns[k]] -= term
    return largest


@compiled
def _fill_tangent_entries_by_differences(f, w, tolerances, t, q, v, by_v, base, residual, moved, entries):
    """Store the `entries` of K (of D if `by_v`), differences of the forces with reactions; return DONE or NOT_FINITE.

    Columns of a group have no rows in common: one difference yields them all. `base`: forces with reactions at
    (t, q, v); `residual` and `moved` (n_q): scratch.
    """
    rows, columns, begins = tangent_entries_of(f.newton_program)
    base_point = v if by_v else q
    sizes = _displacement_sizes(tolerances, base_point)
    for group in range(begins.size - 1):
        copy(base_point, moved)
        first, last = begins[group], begins[group + 1]
        for k in range(first, last):
            j = columns[k]
            moved[j] = _displaced(tolerances, base_point, sizes, j)
        if by_v:
            _fill_sparse_residual(f, w, t, q, moved, False, residual)
        else:
            _fill_sparse_residual(f, w, t, moved, v, True, residual)
        for k in range(first, last):
            i, j = rows[k], columns[k]
            entries[k] = (residual[i] - base[i]) / (moved[j] - base_point[j])
    return DONE if finite_vector(entries) else NOT_FINITE


@compiled
def _has_complete_pattern(f, base, residual, base_point, moved, largest, entries, predicted):
    """Return True if K or D, given by its `entries`, predicts how the residual changes with a displacement.

    If not, its pattern lacks entries. `base`, `residual`: residuals at `base_point` (q or v) and at the displaced point
    `moved`. `largest`: largest term of a residual, see RESIDUAL_ROUNDING. `residual` and `predicted` are overwritten.
    """
    rows, columns, _ = tangent_entries_of(f.newton_program)
    predicted[:] = 0.0
    for k in range(rows.size):
        i, j = rows[k], columns[k]
        term = entries[k] * (moved[j] - base_point[j])
        residual[i] -= term
        predicted[i] += abs(term)
    largest_excess = 0.0
    for i in range(base.size):
        largest_excess = max(largest_excess, abs(residual[i] - base[i]) - MAX_DEVIATION * predicted[i])
    return largest_excess <= RESIDUAL_ROUNDING * largest


@compiled
def _fill_sparse_tangents(f, w, tolerances, memory, t, q, v):
    """Store the sparse K and D (derivatives of Q - G^T lam by q, v) at the last evaluated state; return a code.

    The code is NEEDS_DENSE if there is no program for sparse storage, or if the pattern of K or D lacks entries.
    """
    if f.newton_program.size == 0:
        return NEEDS_DENSE
    w.n_jacobians += 1
    mass, jacobian, K, D, is_independent, stiffness = _sparse_derivative_views(f, w)
    base, residual, moved, pivot_sizes, _, _ = _sparse_scratch(f, w)
    copy(w.mass_values, mass)
    copy(w.jacobian_values, jacobian)
    copy(w.is_independent, is_independent)
    copy(w.solutions[w.solutions.size - is_independent.size :], stiffness)
    largest = _fill_sparse_residual(f, w, t, q, v, False, base)
    code = _fill_tangent_entries_by_differences(f, w, tolerances, t, q, v, False, base, residual, moved, K)
    if code != DONE:
        return code
    sizes = _displacement_sizes(tolerances, q)
    for j in range(q.size):
        moved[j] = _displaced_unequally(tolerances, q, sizes, j, j)
    _fill_sparse_residual(f, w, t, moved, v, True, residual)
    is_complete = _has_complete_pattern(f, base, residual, q, moved, largest, K, pivot_sizes[: q.size])
    copy(jacobian, w.jacobian_values)
    sizes = _displacement_sizes(tolerances, v)
    for j in range(q.size):
        moved[j] = _displaced_unequally(tolerances, v, sizes, j, j)
    _fill_sparse_residual(f, w, t, q, moved, False, residual)
    memory[at.HAS_DAMPING] = 0.0
    for i in range(q.size):
        if residual[i] != base[i]:
            memory[at.HAS_DAMPING] = 1.0
    if memory[at.HAS_DAMPING] == 0.0:
        D[:] = 0.0
        return DONE if is_complete else NEEDS_DENSE
    code = _fill_tangent_entries_by_differences(f, w, tolerances, t, q, v, True, base, residual, moved, D)
    if code != DONE:
        return code
    for j in range(q.size):
        moved[j] = _displaced_unequally(tolerances, v, sizes, j, j)
    _fill_sparse_residual(f, w, t, q, moved, False, residual)
    is_complete = _has_complete_pattern(f, base, residual, v, moved, largest, D, pivot_sizes[: q.size]) and is_complete
    return DONE if is_complete else NEEDS_DENSE


@compiled
def _factor_sparse_matrix(f, w, z, factors):
    """Factorize Newton's sparse matrix [M - z^2 K - z D, G^T; G, 0] for a real or complex z; return DONE or SINGULAR.

    z: step size times a coefficient of the method. K, D: derivatives of the forces with reactions by q and by v.
    """
    mass, jacobian, K, D, is_independent, stiffness = _sparse_derivative_views(f, w)
    _, _, _, pivot_sizes, _, _ = _sparse_scratch(f, w)
    w.n_factorizations += 1
    fill_newton_matrix(f.newton_program, mass, jacobian, K, D, z, stiffness, factors)
    return DONE if factor_lu(f.newton_program, is_independent, factors, pivot_sizes) else SINGULAR


@compiled
def _fill_sparse_right_side(f, w, r, right):
    """Store [M r; G r] in `right` (r: residual); for each redundant row g, add s g^T g r if M contains s g^T g."""
    mass, jacobian, _, _, is_independent, stiffness = _sparse_derivative_views(f, w)
    right[:] = 0.0
    rows, columns, _ = mass_entries_of(f.newton_program)
    for k in range(mass.size):
        right[rows[k]] += mass[k] * r[columns[k]]
    rows, columns, _ = jacobian_entries_of(f.newton_program)
    for k in range(rows.size):
        right[w.Q.size + rows[k]] += jacobian[k] * r[columns[k]]
    add_terms_of_redundant_rows(f.newton_program, jacobian, is_independent, stiffness, right, right)


@compiled
def _filter_error_sparse(f, w, options, s, h, e_q, e_v):
    """Filter e_v (error estimate of v) as `filter_error` does, with sparse factors; e_q: error estimate of q (n_q)."""
    _, _, K, _, _, _ = _sparse_derivative_views(f, w)
    _, _, _, _, right, y = _sparse_scratch(f, w)
    z, n = h * options[newton_options_index(s) + at.GAMMA0], y.size
    x = right.view(np.float64)[:n]
    _fill_sparse_right_side(f, w, e_v, x)
    rows, columns, _ = tangent_entries_of(f.newton_program)
    for k in range(rows.size):
        x[rows[k]] += z * K[k] * e_q[columns[k]]
    solve_lu(f.newton_program, _sparse_factor_view(f, w, 0), x, y.view(np.float64)[:n])
    copy(x[: e_v.size], e_v)


# --- functions for all kinds of storage, which the steps call


@compiled
def fill_derivatives(f, w, options, tolerances, memory, s, t, q, v, a):
    """Store the derivatives for Newton's matrix at the last evaluated state (t, q, v); return DONE or an error code.

    In dense storage, these are derivatives of accelerations, otherwise of forces. `a`: accelerations at this state.
    """
    if f.form == FIXED_ORDER:
        return _fill_sparse_tangents(f, w, tolerances, memory, t, q, v)
    if f.bandwidth >= 0:
        return _fill_banded_tangents(f, w, tolerances, memory, s, t, q, v)
    return _fill_dense_jacobians(f, w, options, tolerances, memory, s, t, q, v, a)


@compiled
def _factor_system(f, w, memory, s, index, z, numbers, factorize, substitute):
    """Compute and factorize Newton's matrix for z (real or complex) in `numbers`; arguments: see `_factor_banded`."""
    w.n_factorizations += 1
    if f.bandwidth >= 0:
        return _factor_banded(w, memory, s, f.bandwidth, index, z, numbers, factorize, substitute)
    return _factor_dense_matrix(w, memory, s, index, z, as_matrix(numbers, w.independent.size))


@compiled
def factor_filter(f, w, options, memory, s, h):
    """Factorize the matrix I - z^2 J_q - z J_v of `filter_error`, where z is step size h * GAMMA0; return a code."""
    z = h * options[newton_options_index(s) + at.GAMMA0]
    if f.form == FIXED_ORDER:
        return _factor_sparse_matrix(f, w, z, _sparse_factor_view(f, w, 0))
    return _factor_system(f, w, memory, s, 0, z, matrix_storage(w, w.Q.size, at.FILTER), DGBTRF, DGBTRS)


@compiled
def factor_systems(f, w, options, memory, s, h):
    """For steps of size h, factorize the matrix of `filter_error` and those of Newton's method; return a code."""
    offset = newton_options_index(s)
    n_systems, n_real = count_systems(options, s), int(options[offset + at.N_REAL])
    code = factor_filter(f, w, options, memory, s, h)
    offset += at.N_EIGEN_SCALARS + s
    for k in range(n_systems):
        # if the tableau's first eigenvalue is real, it is GAMMA0: `factor_filter` has already factorized its matrix
        if code == DONE and (k > 0 or n_real == 0):
            z = h * complex(options[offset], options[offset + 1])
            if f.form == FIXED_ORDER:
                code = _factor_sparse_matrix(f, w, z, _sparse_factor_view(f, w, 1 + k).view(np.complex128))
            else:
                code = _factor_system(f, w, memory, s, 1 + k, z, system_storage(w, w.Q.size, k), ZGBTRF, ZGBTRS)
        offset += 2 + 4 * s
    memory[at.H_FACTORED] = h
    return code


@compiled
def _solve_system(f, w, memory, s, index, numbers, substitute, X, x):
    """Replace the right-hand side x[:n_dof] by the solution of Newton's system; `numbers`: factors of its matrix."""
    m, pivots = w.independent.size, pivots_of(memory, s, w.Q.size, index)
    if f.bandwidth >= 0:
        _multiply_by_T(w, f.bandwidth, x, X)
        x[:] = 0.0
        add_banded_mass_times(f, w, X, x)
        _solve_and_keep_independents(w, f.bandwidth, numbers, pivots, substitute, x)
    else:
        lu_solve(as_matrix(numbers, m), pivots, x[:m])


@compiled
def _solve_sparse_system(f, w, numbers, right, y, x):
    """Replace the residual x (n_q) by the solution of Newton's system; `numbers`: factors. `right`, `y`: scratch."""
    _fill_sparse_right_side(f, w, x, right)
    solve_lu(f.newton_program, numbers, right, y)
    copy(right[: x.size], x)


@compiled
def solve_system(f, w, options, memory, s, k, x):
    """Replace the complex right-hand side x[:n_dof] by the solution of Newton's system for eigenvalue k of the tableau.

    If this eigenvalue is real, only the real part of x is used, and the solution is real.
    """
    n = w.Q.size
    if k == 0 and options[newton_options_index(s) + at.N_REAL] > 0.0:  # eigenvalue k is real: use the filter's factors
        real_part, X = vector(memory, s, n, at.V_MOVED), vector(memory, s, n, at.Q_MOVED)
        for i in range(x.size):
            real_part[i] = x[i].real
        if f.form == FIXED_ORDER:
            _, _, _, _, right, y = _sparse_scratch(f, w)
            size, real_right, real_y = y.size, right.view(np.float64), y.view(np.float64)
            _solve_sparse_system(f, w, _sparse_factor_view(f, w, 0), real_right[:size], real_y[:size], real_part)
        else:
            _solve_system(f, w, memory, s, 0, matrix_storage(w, n, at.FILTER), DGBTRS, X, real_part)
        for i in range(x.size):
            x[i] = real_part[i]
    elif f.form == FIXED_ORDER:
        _, _, _, _, right, y = _sparse_scratch(f, w)
        _solve_sparse_system(f, w, _sparse_factor_view(f, w, 1 + k).view(np.complex128), right, y, x)
    else:
        X = complex_vector(memory, s, n, count_systems(options, s), 1)
        _solve_system(f, w, memory, s, 1 + k, system_storage(w, n, k), ZGBTRS, X, x)


@compiled
def filter_error(f, w, options, memory, s, h, e_q, e_v):
    """Remove stiff components from the velocity error e_v, with Newton's matrix and the position error e_q.

    Replace e_v by (I - z^2 J_q - z J_v)^-1 (e_v + z J_q e_q). z: h * GAMMA0. J_q, J_v: derivatives of accelerations by
    q_i and v_i. Only the first n_dof entries of e_q and e_v (n_q each) are errors; the other ones are scratch.
    """
    m = w.independent.size
    if f.form == FIXED_ORDER:
        _filter_error_sparse(f, w, options, s, h, e_q, e_v)
    elif f.bandwidth >= 0:
        _filter_error_banded(f, w, options, memory, s, h, e_q, e_v)
    else:
        _filter_error_dense(w, options, memory, s, h, e_q[:m], e_v[:m])


@compiled
def correct_stages(f, w, options, memory, s, residual, A_stage):
    """Replace residuals (s, n_q) by Newton corrections of the stage accelerations; add these to A_stage (s, n_q).

    Only the entries of independent coordinates in `residual` and A_stage are read and changed.
    """
    n = w.Q.size
    m = w.independent.size
    offset = newton_options_index(s)
    n_real = int(options[offset + at.N_REAL])
    n_systems = count_systems(options, s)
    x = complex_vector(memory, s, n, n_systems, 0)
    offset += at.N_EIGEN_SCALARS + s
    corrections = block(memory, s, n, at.Q_STAGE)  # overwrites stage positions, which are computed anew later
    corrections[:, :] = 0.0
    for k in range(n_systems):
        begin_row = offset + 2
        begin_column = begin_row + 2 * s
        offset += 2 + 4 * s
        for i in range(m):
            total = complex(0.0, 0.0)
            for j in range(s):
                total += complex(options[begin_row + j], options[begin_row + s + j]) * residual[j, w.independent[i]]
            x[i] = total
        solve_system(f, w, options, memory, s, k, x)
        multiplicity = 1.0 if k < n_real else 2.0
        for j in range(s):
            re, im = options[begin_column + j], options[begin_column + s + j]
            for i in range(m):
                corrections[j, w.independent[i]] += multiplicity * (re * x[i].real - im * x[i].imag)
    for j in range(s):
        for i in w.independent:
            residual[j, i] = corrections[j, i]
            A_stage[j, i] += corrections[j, i]

"""Solve M a + G^T lam = r, G a = c for the accelerations a and the multipliers lam (`f`: kit, `w`: workspace).

M: mass matrix; G: independent rows of the constraint Jacobian; r: forces; c: given values of G a. Three forms exist:

- NULL_SPACE, for few degrees of freedom. Let G_d and G_i be the columns of G for dependent and for independent
  coordinates. The columns of T = [I; D^T], with D^T = -G_d^-1 G_i, are the velocities that the constraints allow. The
  result is a = a_0 + T x: a_0 is the solution of G a_0 = c whose independent entries are 0, and x solves
  (T^T M T) x = T^T (r - M a_0). M need only be positive definite on the allowed velocities.
- MULTIPLIERS: first solve (G M^-1 G^T) lam = G M^-1 r - c, with the Schur complement G M^-1 G^T.
- AUGMENTED: use sparse factors of the augmented matrix [M G^T; G 0], in which M is multiplied by w.mass_scale.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, finite, merged
from twoloop.kernels.data.indices import (
    AUGMENTED,
    DONE,
    MASS_NOT_DEFINITE,
    MULTIPLIERS,
    NOT_FINITE,
    NULL_SPACE,
    SINGULAR,
)
from twoloop.kernels.linalg import markowitz_lu as at
from twoloop.kernels.linalg.band import factor_banded_mass, has_banded_mass, solve_banded_mass
from twoloop.kernels.linalg.dense import (
    contains,
    copy,
    copy_matrix,
    invert_definite,
    ldl_factor,
    ldl_solve,
    sum_rows,
    update_pattern,
)
from twoloop.kernels.linalg.markowitz_lu import (
    choose_order,
    clear_lists,
    columns_of,
    determinant_sign,
    index_of_entries,
    put_entry,
    rows_of,
    run_program,
    solve_rows,
    solve_transposed,
    views_of_lists,
)
from twoloop.kernels.linalg.markowitz_lu import solve as solve_dependent


@compiled
def find_null_space(w):
    """Store D in w.D: velocities satisfy G v = 0 if the dependent ones are D^T times the independent ones."""
    rows, independent = rows_of(w.index_v), w.independent_v
    for j in range(independent.size):
        for k in range(rows.size):
            w.D[j, k] = -w.G[rows[k], independent[j]]
    solve_rows(w.index_v, w.values_v, w.D, independent.size)


@merged
def _reduce_diagonal_mass(columns, independent, M, D, A, m):
    """Store in A the upper triangle of T^T M T, for a diagonal mass matrix M; T = [I; D^T]: null space of Jacobian."""
    for k in range(columns.size):
        m[k] = M[columns[k], columns[k]]
    for i in range(independent.size):
        for j in range(i, independent.size):
            total = 0.0
            for k in range(columns.size):
                total += D[i, k] * m[k] * D[j, k]
            A[i, j] = total
        A[i, i] += M[independent[i], independent[i]]


@merged
def _reduce_dense_mass(columns, independent, M, D, A, MT):
    """Store in A the upper triangle of T^T M T, for any mass matrix M; T = [I; D^T]: null space of the Jacobian."""
    n, n_dof = M.shape[0], independent.size
    for i in range(n):
        for j in range(n_dof):
            MT[i, j] = M[i, independent[j]]
        for k in range(columns.size):
            mass_entry = M[i, columns[k]]
            if mass_entry != 0.0:
                for j in range(n_dof):
                    MT[i, j] += mass_entry * D[j, k]
    for i in range(n_dof):
        for j in range(i, n_dof):
            A[i, j] = MT[independent[i], j]
        for k in range(columns.size):
            factor = D[i, k]
            if factor != 0.0:
                for j in range(i, n_dof):
                    A[i, j] += factor * MT[columns[k], j]


@merged
def factor_reduced_mass(f, w):
    """Store in w.A the L D L^T factors of T^T M T (columns of T: null space of the Jacobian); return a code."""
    columns = columns_of(w.index_v)
    if f.diagonal_mass == 1:
        _reduce_diagonal_mass(columns, w.independent_v, w.M, w.D, w.A, w.x)
    else:
        _reduce_dense_mass(columns, w.independent_v, w.M, w.D, w.A, w.MT)
    w.n_factorizations += 1
    if ldl_factor(w.A):
        return DONE
    return MASS_NOT_DEFINITE if finite(w.M) and finite(w.D) else NOT_FINITE


@merged
def solve_by_reduced_mass(f, w, r, c, a):
    """Store in `a` the accelerations with M a + G^T lam = r and G a = c, by the factors from `factor_reduced_mass`."""
    rows, columns, independent = rows_of(w.index_v), columns_of(w.index_v), w.independent_v
    n_dof, z, x, D, M = independent.size, w.z, w.x, w.D, w.M
    for k in range(rows.size):
        z[k] = c[rows[k]]
    solve_dependent(w.index_v, w.values_v, z)
    copy(r, a)
    # `a` becomes r - M a_0, where G a_0 = c: the dependent entries of a_0 are z, and the independent ones are 0
    for k in range(columns.size):
        column = columns[k]
        if f.diagonal_mass == 1:
            a[column] -= M[column, column] * z[k]
        else:
            for j in range(a.size):
                a[j] -= M[column, j] * z[k]
    for j in range(n_dof):
        total = a[independent[j]]
        for k in range(columns.size):
            total += D[j, k] * a[columns[k]]
        x[j] = total
    ldl_solve(w.A, x)
    for j in range(n_dof):
        a[independent[j]] = x[j]
    for k in range(columns.size):
        total = z[k]
        for j in range(n_dof):
            total += D[j, k] * x[j]
        a[columns[k]] = total


@merged
def multipliers_by_elimination(f, w, r, a, lam):
    """Store the multipliers in lam: solve the rows of G^T lam = r - M a that belong to dependent coordinates."""
    rows, columns, z = rows_of(w.index_v), columns_of(w.index_v), w.z
    for k in range(columns.size):
        column = columns[k]
        total = r[column]
        if f.diagonal_mass == 1:
            total -= w.M[column, column] * a[column]
        else:
            for j in range(a.size):
                total -= w.M[column, j] * a[j]
        z[k] = total
    solve_transposed(w.index_v, w.values_v, z)
    for k in range(rows.size):
        lam[rows[k]] = z[k]


@merged
def factor_mass(f, w):
    """Store in w.L factors of the mass matrix M, or M^-1 if M is constant and not banded; return a status code."""
    if has_banded_mass(f):
        is_definite = factor_banded_mass(f, w) == DONE
    else:
        copy_matrix(w.M, w.L)
        is_definite = invert_definite(w.L) if f.constant_mass == 1 else ldl_factor(w.L)
    if is_definite:
        return DONE
    return MASS_NOT_DEFINITE if finite(w.M) else NOT_FINITE


@merged
def _apply_inverse_mass(f, w, x, y):
    """Store M^-1 x in y, using w.L from `factor_mass`; x and y must be different arrays."""
    n = x.size
    if f.diagonal_mass == 1:
        for i in range(n):
            y[i] = x[i] * w.L[i, i]
    elif f.constant_mass == 1 and not has_banded_mass(f):
        sum_rows(x, w.L, y)  # the inverse is symmetric, and a sum of its rows, weighted by x, can be vectorised
    else:
        copy(x, y)
        if has_banded_mass(f):
            solve_banded_mass(f, w, y)
        else:
            ldl_solve(w.L, y)


@merged
def _is_equal(A, B):
    for i in range(B.shape[0]):
        for j in range(B.shape[1]):
            if A[i, j] != B[i, j]:  # also true for NaN
                return False
    return True


@merged
def factor_schur_complement(f, w):
    """Factor G M^-1 G^T in w.S, unless M is constant and w.S already has the factors for this G; return a code."""
    is_constant = f.constant_mass == 1
    if is_constant and _is_equal(w.G, w.G_of_S):
        return DONE
    rows = w.rows_v
    S, M_inverse_G = w.S, w.W
    for i in range(rows.size):
        _apply_inverse_mass(f, w, w.G[rows[i]], M_inverse_G[i])
    for i in range(rows.size):
        for k in range(i, rows.size):
            total = 0.0
            for j in range(w.Q.size):
                total += w.G[rows[i], j] * M_inverse_G[k, j]
            S[i, k] = total
    w.n_factorizations += 1
    if rows.size > 0:
        w.G_of_S[0, 0] = np.nan
    if not ldl_factor(S):
        return SINGULAR if finite(S) else NOT_FINITE
    if is_constant:
        copy_matrix(w.G, w.G_of_S)
    return DONE


@merged
def solve_by_schur_complement(f, w, r, c, a):
    """Solve M a + G^T lam = r, G a = c by the factors in w.S of G M^-1 G^T: store accelerations in `a`, lam in w.z."""
    rows, M_inverse_G = w.rows_v, w.W
    _apply_inverse_mass(f, w, r, a)
    for i in range(rows.size):
        total = -c[rows[i]]
        for j in range(a.size):
            total += w.G[rows[i], j] * a[j]
        w.z[i] = total
    ldl_solve(w.S, w.z)
    for i in range(rows.size):
        for j in range(a.size):
            a[j] -= M_inverse_G[i, j] * w.z[i]


# the augmented form is used with at least MIN_ROWS constraints (measured: fastest from 7 on) and at least MIN_ROWS
# degrees of freedom. If M is not diagonal, these may be fewer from MIN_COORDINATES coordinates on (measured: about 30)
MIN_ROWS = 8
MIN_COORDINATES = 32


def sparse_pays(n_q: int, n_rows: int, diagonal: bool) -> bool:
    """Return True if sparse factors (augmented form) are faster than dense ones; `diagonal`: whether M is diagonal."""
    return n_rows >= MIN_ROWS and (n_q - n_rows >= MIN_ROWS or (n_q >= MIN_COORDINATES and not diagonal))


@compiled
def _largest_entry(A):
    largest = 0.0
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            largest = max(largest, abs(A[i, j]))
    return largest


@compiled
def _write_augmented_program(w):
    """Store in w.index_a the program that factors the augmented matrix [M G^T; G 0]; return `choose_order`'s code."""
    n, rows, index, values = w.Q.size, w.rows_v, w.index_a, w.values_a
    update_pattern(w.M, w.mass_pattern)
    clear_lists(index, n + rows.size)
    matrix = views_of_lists(index, values)
    scale = 2.0 ** np.round(np.log2(_largest_entry(w.G) / _largest_entry(w.M))) if rows.size > 0 else 1.0
    w.mass_scale = scale
    for i in range(n):
        for j in range(n):
            source = w.entries.size + i * n + j
            if w.mass_pattern[i, j] != 0.0 and not put_entry(matrix, i, j, scale * w.M[i, j], source):
                return at.TOO_MANY_ENTRIES
    for k in range(rows.size):
        for j in range(n):
            if w.pattern[rows[k], j] != 0.0:
                number, source = w.G[rows[k], j], rows[k] * n + j
                if not (put_entry(matrix, n + k, j, number, source) and put_entry(matrix, j, n + k, number, source)):
                    return at.TOO_MANY_ENTRIES
    return choose_order(index, matrix, w.pattern.size, 0.0)


@compiled
def _run_augmented_program(w):
    """Factor the augmented matrix; return False if a pivot is 0 or NaN, or |entry of L| exceeds MAX_MULTIPLIER."""
    index, values, scale, first_of_mass = w.index_a, w.values_a, w.mass_scale, w.entries.size
    source = index_of_entries(index[at.SIZE]) + 2 * index[at.N_SLOTS]
    for s in range(index[at.N_SLOTS]):
        entry = index[source + s]
        values[s] = w.augmented[entry] * (scale if entry >= first_of_mass else 1.0)
    return run_program(index, values) > 0.0


@compiled
def factor_augmented(f, w):
    """Factor the augmented matrix [M G^T; G 0], or set f.form = f.dense_form if factors are dense; return a code."""
    w.n_factorizations += 1
    has_new_entry = f.constant_mass == 0 and update_pattern(w.M, w.mass_pattern)
    if w.index_a[at.SIZE] == 0 or has_new_entry or not _run_augmented_program(w):
        if not finite(w.M):
            return NOT_FINITE
        ordering_code = _write_augmented_program(w)
        if ordering_code == at.TOO_MANY_ENTRIES:
            f.form = f.dense_form
            return DONE
        if ordering_code != at.ORDER_CHOSEN or not _run_augmented_program(w):
            w.index_a[at.SIZE] = 0
            return MASS_NOT_DEFINITE
    if determinant_sign(w.index_a, w.values_a) != (1.0 if w.rows_v.size % 2 == 0 else -1.0):
        return MASS_NOT_DEFINITE
    return DONE


@compiled
def solve_augmented(w, r, c, a):
    """Solve M a + G^T lam = r, G a = c by the factors from `factor_augmented`; store lam of independent rows in w.z."""
    n, size, scale = r.size, w.index_a[at.SIZE], w.mass_scale
    x, y = w.right[:size], w.right[size:]
    for j in range(n):
        x[j] = scale * r[j]
    for k in range(w.rows_v.size):
        x[n + k] = c[w.rows_v[k]]
    rows, columns = rows_of(w.index_a), columns_of(w.index_a)
    for k in range(size):
        y[k] = x[rows[k]]
    solve_dependent(w.index_a, w.values_a, y)
    for k in range(size):
        x[columns[k]] = y[k]
    for j in range(n):
        a[j] = x[j]
    for k in range(w.rows_v.size):
        w.z[k] = x[n + k] / scale


@compiled
def _factor_augmented_or_dense(f, w):
    """Factor the augmented matrix; if the factors are not sparse, prepare the form f.dense_form; return a code."""
    code = factor_augmented(f, w)
    if code == DONE and f.form == NULL_SPACE:
        find_null_space(w)
    elif code == DONE and f.form == MULTIPLIERS and f.constant_mass == 1:
        code = factor_mass(f, w)
    return code


@merged
def factor(f, w):
    """Factor the equations of the accelerations in the form f.form, unless w.factored is 1 (done); return a code."""
    if w.factored == 1.0:
        return DONE
    code = _factor_augmented_or_dense(f, w) if f.form == AUGMENTED else DONE
    if code == DONE and f.form == NULL_SPACE:
        code = factor_reduced_mass(f, w)
    elif code == DONE and f.form == MULTIPLIERS:
        if f.constant_mass == 0:
            w.n_factorizations += 1
            code = factor_mass(f, w)
        if code == DONE:
            code = factor_schur_complement(f, w)
    if code == DONE:
        w.factored = 1.0
    return code


@merged
def solve(f, w, r, c, a):
    """Store in `a` the accelerations with M a + G^T lam = r and G a = c; r, c and `a` must be different arrays."""
    if f.form == NULL_SPACE:
        solve_by_reduced_mass(f, w, r, c, a)
    elif f.form == MULTIPLIERS:
        solve_by_schur_complement(f, w, r, c, a)
    else:
        solve_augmented(w, r, c, a)


@merged
def multipliers(f, w, r, a, lam):
    """Store in lam the multipliers of independent rows, after `solve` has computed `a`; other entries of lam stay."""
    if f.form == NULL_SPACE:
        multipliers_by_elimination(f, w, r, a, lam)
    else:
        for i in range(w.rows_v.size):
            lam[w.rows_v[i]] = w.z[i]


@merged
def solve_with_multipliers(f, w, r, c, a, lam):
    """Store in `a` and lam the accelerations and multipliers with M a + G^T lam = r and G a = c."""
    solve(f, w, r, c, a)
    multipliers(f, w, r, a, lam)


@compiled
def least_norm(w, lam):
    """Replace lam by the multipliers of least norm that give the same reactions G^T lam.

    Redundant row i of G is the sum, over independent rows k, of Z[i, k] times row k. So G^T maps the vectors e_i -
    sum_k Z[i, k] e_k (e: unit vectors) to zero. These are the columns of a matrix N; the part N (N^T N)^-1 N^T lam of
    lam, which causes no reactions, is subtracted.
    """
    rows, columns = rows_of(w.index_v), columns_of(w.index_v)
    r, n_red = rows.size, lam.size - rows.size
    Z = w.minimum[: n_red * r].reshape((n_red, r))
    gram = w.minimum[n_red * r : n_red * (r + n_red)].reshape((n_red, n_red))
    components = w.minimum[n_red * (r + n_red) :]
    i = 0
    for row in range(lam.size):
        if contains(w.rows_v, row):
            continue
        for k in range(r):
            Z[i, k] = w.G[row, columns[k]]
        solve_transposed(w.index_v, w.values_v, Z[i])
        components[i] = lam[row]
        for k in range(r):
            components[i] -= Z[i, k] * lam[rows[k]]
        i += 1
    for i in range(n_red):
        for j in range(i, n_red):
            total = 1.0 if i == j else 0.0
            for k in range(r):
                total += Z[i, k] * Z[j, k]
            gram[i, j] = total
    ldl_factor(gram)
    ldl_solve(gram, components)
    i = 0
    for row in range(lam.size):
        if not contains(w.rows_v, row):
            lam[row] -= components[i]
            for k in range(r):
                lam[rows[k]] += components[i] * Z[i, k]
            i += 1

"""Accelerations and multipliers, eqs. (6)-(8) of the paper, at a state on the constraints.

Three forms. With T = [I; D^T], D^T = -G_d^-1 G_i, whose columns are the velocities that the constraints allow,
a = g + T x, where g, with G g = Gamma, has no independent entries, and (T^T M T) x = T^T (Q - M g): M need only be
positive definite on these velocities. Or, where degrees of freedom outnumber constraints and M is positive definite, by
the multipliers: (G M^-1 G^T) lam = G M^-1 Q - Gamma. Or, where there are many of both, by the sparse matrix of
augmented.py.
"""

import numpy as np

from twoloop.kernels.algebra.banded import banded_mass, factor_banded_mass, solve_banded_mass
from twoloop.kernels.algebra.factors import columns_of, rows_of, solve, solve_transposed
from twoloop.kernels.algebra.linalg import copy, copy_matrix, invert_definite, ldl_factor, ldl_solve
from twoloop.kernels.data.common import (
    AUGMENTED,
    CONSTANT_MASS,
    DIAGONAL_MASS,
    DONE,
    FACTORED,
    FORM,
    GAMMA_GIVEN,
    GAMMA_SCALE,
    KNOWN,
    MASS_NOT_DEFINITE,
    MULTIPLIERS,
    N_EVALUATIONS,
    N_FACTORIZATIONS,
    NONHOLONOMIC_GAMMA_GIVEN,
    NOT_FINITE,
    NULL_SPACE,
    SINGULAR,
    compiled,
    merged,
)
from twoloop.kernels.evaluation.augmented import factor_augmented, solve_augmented, solve_augmented_for
from twoloop.kernels.evaluation.finite import MASS, finite, not_finite, source_of_acceleration
from twoloop.kernels.evaluation.gamma import gamma_by_differences
from twoloop.kernels.evaluation.inner import tangents


@merged
def acceleration_constraint(f, w, t, q, v):
    """The right-hand side Gamma of G a = Gamma, into w.Gamma; DONE, or why it cannot be had."""
    n_c, n_rows = w.C.size, w.Rate.size
    if w.notes[KNOWN] == 1.0 and n_rows == n_c:
        return DONE
    given, given_a = f.flags[GAMMA_GIVEN] == 1, f.flags[NONHOLONOMIC_GAMMA_GIVEN] == 1
    first, last = 0, n_rows  # rows to be differenced
    w.Gamma[:] = 0.0
    if given:
        f.gamma(t, q, v, f.p, w.Gamma[:n_c])
        first = n_c
    if n_rows == n_c or given_a:
        last = n_c
    if last > n_c or not given:
        code = gamma_by_differences(f, w, t, q, v, first, last)
        if code != DONE:
            return code
    if n_rows > n_c and given_a:
        f.nonholonomic_gamma(t, q, v, f.p, w.Gamma[n_c:])
    return DONE


@merged
def mass_matrix(f, w, t, q):
    """M(t, q) into w.M."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)


@merged
def factor_mass(f, w, t, q):
    """M(t, q), and what is needed of it: of a constant M its inverse, quicker to apply, else its factors."""
    mass_matrix(f, w, t, q)
    code = DONE
    if banded_mass(f):
        code = factor_banded_mass(f, w)
    elif f.flags[FORM] != MULTIPLIERS:
        if not finite(w.M):
            code = MASS_NOT_DEFINITE
    else:
        copy_matrix(w.M, w.L)
        definite = invert_definite(w.L) if f.flags[CONSTANT_MASS] == 1 else ldl_factor(w.L)
        code = DONE if definite else MASS_NOT_DEFINITE
    if code == DONE:
        return DONE
    return MASS_NOT_DEFINITE if finite(w.M) else not_finite(w.notes, MASS, t, q)


@merged
def _times_inverse_mass(f, w, x, y):
    """y = M^-1 x; they may be one array unless M is constant, dense and not diagonal."""
    n = x.size
    if f.flags[DIAGONAL_MASS] == 1:
        for i in range(n):
            y[i] = x[i] * w.L[i, i]
    elif f.flags[CONSTANT_MASS] == 1 and not banded_mass(f):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += w.L[i, j] * x[j]
            y[i] = total
    else:
        copy(x, y)
        if banded_mass(f):
            solve_banded_mass(f, w, y)
        else:
            ldl_solve(w.L, y)


@merged
def _equal(A, B):
    for i in range(B.shape[0]):
        for j in range(B.shape[1]):
            if A[i, j] != B[i, j]:  # also true for NaN
                return False
    return True


@merged
def _schur_complement(f, w):
    """S = G M^-1 G^T of the rows that count, and its factors; with a constant M only if G has changed."""
    keep = f.flags[CONSTANT_MASS] == 1
    if keep and _equal(w.G, w.G_of_S):
        return DONE
    rows = w.rows_v
    S, solved = w.S, w.W
    for i in range(rows.size):
        _times_inverse_mass(f, w, w.G[rows[i]], solved[i])
    for i in range(rows.size):
        for k in range(i, rows.size):
            total = 0.0
            for j in range(w.Q.size):
                total += w.G[rows[i], j] * solved[k, j]
            S[i, k] = total
    w.counters[N_FACTORIZATIONS] += 1
    if rows.size > 0:
        w.G_of_S[0, 0] = np.nan
    if not ldl_factor(S):
        return SINGULAR if finite(S) else NOT_FINITE
    if keep:
        copy_matrix(w.G, w.G_of_S)
    return DONE


@merged
def _by_multipliers(f, w, a):
    """(7), then (8), with M^-1 Q and M^-1 G^T as they stand; the multipliers stay in w.z."""
    code = _schur_complement(f, w)
    if code != DONE:
        return code
    rows, solved = w.rows_v, w.W
    _times_inverse_mass(f, w, w.Q, a)
    for i in range(rows.size):
        total = -w.Gamma[rows[i]]
        for j in range(a.size):
            total += w.G[rows[i], j] * a[j]
        w.z[i] = total
    ldl_solve(w.S, w.z)
    for i in range(rows.size):
        for j in range(a.size):
            a[j] -= solved[i, j] * w.z[i]
    return DONE


@merged
def _reduce_diagonal(columns, independent, M, D, g, Q, y, A, m):
    """T^T M T of a diagonal M, upper triangle into A, and y = Q - M g; m is scratch."""
    copy(Q, y)
    for k in range(columns.size):
        c = columns[k]
        m[k] = M[c, c]
        y[c] -= m[k] * g[k]
    for i in range(independent.size):
        for j in range(i, independent.size):
            total = 0.0
            for k in range(columns.size):
                total += D[i, k] * m[k] * D[j, k]
            A[i, j] = total
        A[i, i] += M[independent[i], independent[i]]


@merged
def _reduce_dense(columns, independent, M, D, g, Q, y, A, MT):
    """T^T M T of any M, upper triangle into A, and y = Q - M g; MT is scratch."""
    n, n_dof = Q.size, independent.size
    for i in range(n):
        total = Q[i]
        for j in range(n_dof):
            MT[i, j] = M[i, independent[j]]
        for k in range(columns.size):
            m = M[i, columns[k]]
            if m != 0.0:
                total -= m * g[k]
                for j in range(n_dof):
                    MT[i, j] += m * D[j, k]
        y[i] = total
    for i in range(n_dof):
        for j in range(i, n_dof):
            A[i, j] = MT[independent[i], j]
        for k in range(columns.size):
            factor = D[i, k]
            if factor != 0.0:
                for j in range(i, n_dof):
                    A[i, j] += factor * MT[columns[k], j]


@merged
def _solve_reduced(columns, independent, D, g, y, A, x, a):
    """a = g + T x with A x = T^T y; A becomes its factors. False: it is not positive definite."""
    n_dof = independent.size
    if not ldl_factor(A):
        return False
    for j in range(n_dof):
        total = y[independent[j]]
        for k in range(columns.size):
            total += D[j, k] * y[columns[k]]
        x[j] = total
    ldl_solve(A, x)
    for j in range(n_dof):
        a[independent[j]] = x[j]
        for k in range(columns.size):
            g[k] += D[j, k] * x[j]
    for k in range(columns.size):
        a[columns[k]] = g[k]
    return True


@merged
def _on_null_space(f, w, a):
    """a = g + T x, see the head of this file; needs w.D."""
    rows, columns, independent = rows_of(w.index_v), columns_of(w.index_v), w.independent_v
    for k in range(rows.size):
        w.z[k] = w.Gamma[rows[k]]
    solve(w.index_v, w.values_v, w.z)
    A = w.A
    if f.flags[DIAGONAL_MASS] == 1:
        _reduce_diagonal(columns, independent, w.M, w.D, w.z, w.Q, w.y, A, w.x)
    else:
        _reduce_dense(columns, independent, w.M, w.D, w.z, w.Q, w.y, A, w.MT)
    w.counters[N_FACTORIZATIONS] += 1
    if _solve_reduced(columns, independent, w.D, w.z, w.y, A, w.x, a):
        return DONE
    return MASS_NOT_DEFINITE if finite(w.M) and finite(w.D) else NOT_FINITE


@merged
def _mass_there(f, w, t, q):
    """A mass matrix that varies, and its factors where they are needed."""
    w.notes[FACTORED] = 0.0
    if f.flags[FORM] != MULTIPLIERS:
        mass_matrix(f, w, t, q)
        return DONE
    w.counters[N_FACTORIZATIONS] += 1
    return factor_mass(f, w, t, q)


@compiled
def _factor_augmented(f, w, t, q):
    """The factors of augmented.py, or what the dense form needs where they are not sparse."""
    code = factor_augmented(f, w, t, q)
    if code == DONE and f.flags[FORM] != AUGMENTED:
        if f.flags[FORM] == NULL_SPACE:
            tangents(f, w, t, q)
        code = factor_mass(f, w, t, q)
    return code


@merged
def _by_form(f, w, a):
    """Accelerations from w.Q and w.Gamma."""
    if f.flags[FORM] == NULL_SPACE:
        return _on_null_space(f, w, a)
    if f.flags[FORM] == MULTIPLIERS:
        return _by_multipliers(f, w, a)
    solve_augmented(w, a)
    return DONE


@merged
def factor_for_projection(f, w, t, q):
    """M, and the factors of T^T M T or G M^-1 G^T, at a state whose rows, factors and w.D stand in w."""
    code = DONE
    if f.flags[CONSTANT_MASS] == 0:
        code = _mass_there(f, w, t, q)
    if code == DONE and f.flags[FORM] == AUGMENTED:
        code = _factor_augmented(f, w, t, q)
        if f.flags[FORM] == AUGMENTED:
            return code
    if code != DONE:
        return code
    if f.flags[FORM] == MULTIPLIERS:
        return _schur_complement(f, w)
    columns = columns_of(w.index_v)
    if f.flags[DIAGONAL_MASS] == 1:
        _reduce_diagonal(columns, w.independent_v, w.M, w.D, w.z, w.Q, w.y, w.A, w.x)
    else:
        _reduce_dense(columns, w.independent_v, w.M, w.D, w.z, w.Q, w.y, w.A, w.MT)
    w.counters[N_FACTORIZATIONS] += 1
    return DONE if ldl_factor(w.A) else MASS_NOT_DEFINITE


@merged
def accelerate(f, w, t, q, v, a):
    """The accelerations at a state whose rows, factors and w.D stand in w."""
    w.counters[N_EVALUATIONS] += 1
    code = DONE
    if f.flags[CONSTANT_MASS] == 0:
        code = _mass_there(f, w, t, q)
    if code == DONE:
        code = acceleration_constraint(f, w, t, q, v)
    if code != DONE:
        return code
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    if f.flags[FORM] == AUGMENTED:
        code = _factor_augmented(f, w, t, q)
    if code == DONE:
        code = _by_form(f, w, a)
    if code != DONE and code != NOT_FINITE:
        return code
    for j in range(a.size):
        if code == NOT_FINITE or not np.isfinite(a[j]):
            source = source_of_acceleration(w)
            return not_finite(w.notes, source if source >= 0 or finite(w.M) else MASS, t, q)
    if f.flags[GAMMA_GIVEN] == 0 or w.Rate.size > w.C.size:
        _note_scale(w, a)
    return DONE


@compiled
def _note_scale(w, a):
    """The largest sum of terms in G a, by which Gamma by differences is judged."""
    for i in range(w.Rate.size):
        total = 0.0
        for p in range(w.places[i], w.places[i + 1]):
            total += abs(w.G[i, w.places[p]] * a[w.places[p]])
        w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], total)


@merged
def equilibrate(f, w, a, lam):
    """Multipliers of all rows: G^T lam = Q - M a, of least norm where rows are redundant."""
    lam[:] = 0.0
    if f.flags[FORM] != NULL_SPACE:
        for i in range(w.rows_v.size):
            lam[w.rows_v[i]] = w.z[i]
    else:
        rows, columns = rows_of(w.index_v), columns_of(w.index_v)
        for k in range(columns.size):
            total = w.Q[columns[k]]
            if f.flags[DIAGONAL_MASS] == 1:
                total -= w.M[columns[k], columns[k]] * a[columns[k]]
            else:
                for j in range(a.size):
                    total -= w.M[columns[k], j] * a[j]
            w.z[k] = total
        solve_transposed(w.index_v, w.values_v, w.z)
        for k in range(rows.size):
            lam[rows[k]] = w.z[k]
    if w.rows_v.size < lam.size:
        _least_norm(w, lam)


@compiled
def _least_norm(w, lam):
    """Take away from lam what the null space of G^T has of it: redundant row i is sum_k Z[i, k] of the rows that count.

    The null space is spanned by n_i = e_i - sum_k Z[i, k] e_k, and lam -= N (N^T N)^-1 N^T lam.
    """
    rows, columns = rows_of(w.index_v), columns_of(w.index_v)
    r, n_red = rows.size, lam.size - rows.size
    Z = w.minimum[: n_red * r].reshape((n_red, r))
    gram = w.minimum[n_red * r : n_red * (r + n_red)].reshape((n_red, n_red))
    part = w.minimum[n_red * (r + n_red) :]
    i = 0
    for row in range(lam.size):
        counts = False
        for k in w.rows_v:
            counts = counts or k == row
        if counts:
            continue
        for k in range(r):
            Z[i, k] = w.G[row, columns[k]]
        solve_transposed(w.index_v, w.values_v, Z[i])
        part[i] = lam[row]
        for k in range(r):
            part[i] -= Z[i, k] * lam[rows[k]]
        i += 1
    for i in range(n_red):
        for j in range(i, n_red):
            total = 1.0 if i == j else 0.0
            for k in range(r):
                total += Z[i, k] * Z[j, k]
            gram[i, j] = total
    ldl_factor(gram)
    ldl_solve(gram, part)
    i = 0
    for row in range(lam.size):
        counts = False
        for k in w.rows_v:
            counts = counts or k == row
        if not counts:
            lam[row] -= part[i]
            for k in range(r):
                lam[rows[k]] += part[i] * Z[i, k]
            i += 1


@merged
def solve_for_order(f, w, r, c, a, lam):
    """M a + G^T lam = r and G a = c, by the factors of the accelerations found just before.

    Entries of lam that belong to rows that do not count are left as they are.
    """
    n = r.size
    if f.flags[FORM] == AUGMENTED:
        solve_augmented_for(w, r, c, a, lam)
        return
    if f.flags[FORM] == MULTIPLIERS:
        rows_v = w.rows_v
        _times_inverse_mass(f, w, r, a)
        for i in range(rows_v.size):
            total = -c[rows_v[i]]
            for j in range(n):
                total += w.G[rows_v[i], j] * a[j]
            w.z[i] = total
        ldl_solve(w.S, w.z)
        for i in range(rows_v.size):
            lam[rows_v[i]] = w.z[i]
            for j in range(n):
                a[j] -= w.W[i, j] * w.z[i]
        return
    rows, columns, independent = rows_of(w.index_v), columns_of(w.index_v), w.independent_v
    n_dof, z, x, y, D, M = independent.size, w.z, w.x, w.y, w.D, w.M
    diagonal = f.flags[DIAGONAL_MASS] == 1
    for k in range(rows.size):
        z[k] = c[rows[k]]
    solve(w.index_v, w.values_v, z)
    if diagonal:
        for k in range(columns.size):
            m = columns[k]
            y[k] = r[m] - M[m, m] * z[k]
        for j in range(n_dof):
            total = r[independent[j]]
            for k in range(columns.size):
                total += D[j, k] * y[k]
            x[j] = total
    else:
        copy(r, a)  # for a while: r - M g
        for k in range(columns.size):
            m = columns[k]
            for j in range(n):
                a[j] -= M[m, j] * z[k]
        for j in range(n_dof):
            total = a[independent[j]]
            for k in range(columns.size):
                total += D[j, k] * a[columns[k]]
            x[j] = total
    ldl_solve(w.A, x)
    for j in range(n_dof):
        a[independent[j]] = x[j]
    for k in range(columns.size):
        m, change = columns[k], 0.0
        for j in range(n_dof):
            change += D[j, k] * x[j]
        a[m] = z[k] + change
        if diagonal:
            z[k] = y[k] - M[m, m] * change
    if not diagonal:
        for k in range(columns.size):
            m = columns[k]
            total = r[m]
            for j in range(n):
                total -= M[m, j] * a[j]
            z[k] = total
    solve_transposed(w.index_v, w.values_v, z)
    for k in range(rows.size):
        lam[rows[k]] = z[k]

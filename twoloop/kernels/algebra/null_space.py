"""The linear problem on the velocities that the constraints allow: for few degrees of freedom.

With T = [I; D^T], D^T = -G_d^-1 G_i, whose columns are these velocities, a = g + T x, where g, with G g = c, has no
independent entries, and (T^T M T) x = T^T (r - M g): M need only be positive definite on these velocities.
"""

from twoloop.kernels.algebra.factors import columns_of, rows_of, solve, solve_rows, solve_transposed
from twoloop.kernels.algebra.linalg import copy, ldl_factor, ldl_solve
from twoloop.kernels.data.codes import DONE, MASS_NOT_DEFINITE, NOT_FINITE
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.counters import N_FACTORIZATIONS
from twoloop.kernels.data.finite import finite
from twoloop.kernels.data.flags import DIAGONAL_MASS


@compiled
def directions(w):
    """D from the rows and factors in w."""
    rows, independent = rows_of(w.index_v), w.independent_v
    for j in range(independent.size):
        for k in range(rows.size):
            w.D[j, k] = -w.G[rows[k], independent[j]]
    solve_rows(w.index_v, w.values_v, w.D, independent.size)


@merged
def _reduce_diagonal(columns, independent, M, D, A, m):
    """T^T M T of a diagonal M, upper triangle into A; m is scratch."""
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
def _reduce_dense(columns, independent, M, D, A, MT):
    """T^T M T of any M, upper triangle into A; MT is scratch."""
    n, n_dof = M.shape[0], independent.size
    for i in range(n):
        for j in range(n_dof):
            MT[i, j] = M[i, independent[j]]
        for k in range(columns.size):
            m = M[i, columns[k]]
            if m != 0.0:
                for j in range(n_dof):
                    MT[i, j] += m * D[j, k]
    for i in range(n_dof):
        for j in range(i, n_dof):
            A[i, j] = MT[independent[i], j]
        for k in range(columns.size):
            factor = D[i, k]
            if factor != 0.0:
                for j in range(i, n_dof):
                    A[i, j] += factor * MT[columns[k], j]


@merged
def factor_reduced(f, w):
    """The factors of T^T M T, into w.A; needs w.D."""
    columns = columns_of(w.index_v)
    if f.flags[DIAGONAL_MASS] == 1:
        _reduce_diagonal(columns, w.independent_v, w.M, w.D, w.A, w.x)
    else:
        _reduce_dense(columns, w.independent_v, w.M, w.D, w.A, w.MT)
    w.counters[N_FACTORIZATIONS] += 1
    if ldl_factor(w.A):
        return DONE
    return MASS_NOT_DEFINITE if finite(w.M) and finite(w.D) else NOT_FINITE


@merged
def solve_reduced(f, w, r, c, a):
    """a of M a + G^T lam = r and G a = c."""
    rows, columns, independent = rows_of(w.index_v), columns_of(w.index_v), w.independent_v
    n_dof, z, x, D, M = independent.size, w.z, w.x, w.D, w.M
    for k in range(rows.size):
        z[k] = c[rows[k]]
    solve(w.index_v, w.values_v, z)
    copy(r, a)  # for a while: r - M g
    for k in range(columns.size):
        m = columns[k]
        if f.flags[DIAGONAL_MASS] == 1:
            a[m] -= M[m, m] * z[k]
        else:
            for j in range(a.size):
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
        total = z[k]
        for j in range(n_dof):
            total += D[j, k] * x[j]
        a[columns[k]] = total


@merged
def reduced_multipliers(f, w, r, a, lam):
    """The multipliers of the rows that count: G^T lam = r - M a in the dependent columns."""
    rows, columns, z = rows_of(w.index_v), columns_of(w.index_v), w.z
    for k in range(columns.size):
        m = columns[k]
        total = r[m]
        if f.flags[DIAGONAL_MASS] == 1:
            total -= w.M[m, m] * a[m]
        else:
            for j in range(a.size):
                total -= w.M[m, j] * a[j]
        z[k] = total
    solve_transposed(w.index_v, w.values_v, z)
    for k in range(rows.size):
        lam[rows[k]] = z[k]

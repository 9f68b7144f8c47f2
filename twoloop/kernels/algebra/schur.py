"""The linear problem by its multipliers: (G M^-1 G^T) lam = G M^-1 r - c, then a = M^-1 (r - G^T lam), eqs. (7), (8).

For a positive definite M, where degrees of freedom outnumber constraints.
"""

import numpy as np

from twoloop.kernels.algebra.banded import banded_mass, factor_banded_mass, solve_banded_mass
from twoloop.kernels.algebra.linalg import copy, copy_matrix, invert_definite, ldl_factor, ldl_solve
from twoloop.kernels.data.codes import DONE, MASS_NOT_DEFINITE, NOT_FINITE, SINGULAR
from twoloop.kernels.data.common import merged
from twoloop.kernels.data.counters import N_FACTORIZATIONS
from twoloop.kernels.data.finite import finite
from twoloop.kernels.data.flags import CONSTANT_MASS, DIAGONAL_MASS


@merged
def factor_mass(f, w):
    """What is needed of w.M: of a constant M its inverse, quicker to apply, else its factors."""
    if banded_mass(f):
        definite = factor_banded_mass(f, w) == DONE
    else:
        copy_matrix(w.M, w.L)
        definite = invert_definite(w.L) if f.flags[CONSTANT_MASS] == 1 else ldl_factor(w.L)
    if definite:
        return DONE
    return MASS_NOT_DEFINITE if finite(w.M) else NOT_FINITE


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
def factor_schur(f, w):
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
def solve_schur(f, w, r, c, a):
    """a of M a + G^T lam = r and G a = c; the multipliers of the rows that count go into w.z."""
    rows, solved = w.rows_v, w.W
    _times_inverse_mass(f, w, r, a)
    for i in range(rows.size):
        total = -c[rows[i]]
        for j in range(a.size):
            total += w.G[rows[i], j] * a[j]
        w.z[i] = total
    ldl_solve(w.S, w.z)
    for i in range(rows.size):
        for j in range(a.size):
            a[j] -= solved[i, j] * w.z[i]

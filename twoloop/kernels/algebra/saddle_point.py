"""The linear problem of a constrained system: M a + G^T lam = r, G a = c, whose G has the rows that count.

It gives accelerations, the way back to the constraints, the orders of a Taylor series and reactions: factored once at a
state, it is solved for any right-hand side. Three structures serve, by f.flags[FORM]: null_space.py, schur.py and
sparse.py. A method reads none of them.
"""

from twoloop.kernels.algebra.factors import columns_of, rows_of, solve_transposed
from twoloop.kernels.algebra.linalg import ldl_factor, ldl_solve
from twoloop.kernels.algebra.null_space import directions, factor_reduced, reduced_multipliers, solve_reduced
from twoloop.kernels.algebra.schur import factor_mass, factor_schur, solve_schur
from twoloop.kernels.algebra.sparse import factor_sparse, solve_sparse
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.counters import N_FACTORIZATIONS
from twoloop.kernels.data.flags import AUGMENTED, CONSTANT_MASS, FORM, MULTIPLIERS, NULL_SPACE
from twoloop.kernels.data.noted import FACTORED


@compiled
def _factor_sparse(f, w):
    """The factors of the sparse matrix, or what the dense form needs where they are not sparse."""
    code = factor_sparse(f, w)
    if code == DONE and f.flags[FORM] == NULL_SPACE:
        directions(w)
    elif code == DONE and f.flags[FORM] == MULTIPLIERS and f.flags[CONSTANT_MASS] == 1:
        code = factor_mass(f, w)
    return code


@merged
def factor(f, w):
    """Factor for the w.M that there is, and the rows, factors and tangents of G; DONE, or why it cannot be done."""
    if w.notes[FACTORED] == 1.0:
        return DONE
    code = _factor_sparse(f, w) if f.flags[FORM] == AUGMENTED else DONE
    if code == DONE and f.flags[FORM] == NULL_SPACE:
        code = factor_reduced(f, w)
    elif code == DONE and f.flags[FORM] == MULTIPLIERS:
        if f.flags[CONSTANT_MASS] == 0:
            w.counters[N_FACTORIZATIONS] += 1
            code = factor_mass(f, w)
        if code == DONE:
            code = factor_schur(f, w)
    if code == DONE:
        w.notes[FACTORED] = 1.0
    return code


@merged
def solve(f, w, r, c, a):
    """a for any right-hand side, by the factors; r, c and a are three arrays."""
    if f.flags[FORM] == NULL_SPACE:
        solve_reduced(f, w, r, c, a)
    elif f.flags[FORM] == MULTIPLIERS:
        solve_schur(f, w, r, c, a)
    else:
        solve_sparse(w, r, c, a)


@merged
def multipliers(f, w, r, a, lam):
    """Those that belong to the a found just before; entries of rows that do not count are left as they are."""
    if f.flags[FORM] == NULL_SPACE:
        reduced_multipliers(f, w, r, a, lam)
    else:
        for i in range(w.rows_v.size):
            lam[w.rows_v[i]] = w.z[i]


@merged
def solve_both(f, w, r, c, a, lam):
    """Solution and multipliers for any right-hand side."""
    solve(f, w, r, c, a)
    multipliers(f, w, r, a, lam)


@compiled
def least_norm(w, lam):
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

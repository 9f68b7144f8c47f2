"""The linear problem by one sparse matrix, where degrees of freedom and constraints are many.

T^T M T and G M^-1 G^T are full there. The matrix of

    [s M  G^T] [a    ]   [s r]
    [G    0  ] [s lam] = [c  ]

is not; G has the rows that count, and the number s brings M to the size of G. Its factors are those of factors.py, by a
program for its pattern.

M need only be positive definite on the velocities that the constraints allow. At the start its eigenvalues tell, later
the sign of the determinant, which then is (-1)^r. What is not sparse enough is left to the dense forms.
"""

import numpy as np

from twoloop.kernels.algebra import elimination as at
from twoloop.kernels.algebra.elimination import begin, lists_of, order, put, slots
from twoloop.kernels.algebra.factors import columns_of, rows_of, run, sign_of, solve
from twoloop.kernels.algebra.patterns import note_pattern
from twoloop.kernels.data.codes import DONE, MASS_NOT_DEFINITE, NOT_FINITE
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.counters import N_FACTORIZATIONS
from twoloop.kernels.data.finite import finite
from twoloop.kernels.data.flags import CONSTANT_MASS, DENSE_FORM, FORM
from twoloop.kernels.data.noted import MASS_SCALE

MANY = 8  # rows, and degrees of freedom, from which on this is the fastest form of a chain: measured, about 7
LARGE = 32  # coordinates, from which on it is with few degrees of freedom, too, unless M is diagonal: about 30


def sparse_pays(n_q: int, n_rows: int, diagonal: bool) -> bool:
    """Whether this form is faster than the dense ones, for a sparse pattern; `diagonal`: M is constant and diagonal."""
    return n_rows >= MANY and (n_q - n_rows >= MANY or (n_q >= LARGE and not diagonal))


@compiled
def _largest(A):
    largest = 0.0
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            largest = max(largest, abs(A[i, j]))
    return largest


@compiled
def _make_program(w):
    """Choose the order of elimination for the numbers in w.M and w.G."""
    n, rows, index, values = w.Q.size, w.rows_v, w.index_a, w.values_a
    note_pattern(w.M, w.mass_pattern)
    begin(index, n + rows.size)
    matrix = lists_of(index, values)
    scale = 2.0 ** np.round(np.log2(_largest(w.G) / _largest(w.M))) if rows.size > 0 else 1.0
    w.notes[MASS_SCALE] = scale
    for i in range(n):
        for j in range(n):
            source = w.entries.size + i * n + j
            if w.mass_pattern[i, j] != 0.0 and not put(matrix, i, j, scale * w.M[i, j], source):
                return at.TOO_MANY
    for k in range(rows.size):
        for j in range(n):
            if w.pattern[rows[k], j] != 0.0:
                number, source = w.G[rows[k], j], rows[k] * n + j
                if not (put(matrix, n + k, j, number, source) and put(matrix, j, n + k, number, source)):
                    return at.TOO_MANY
    return order(index, matrix, w.pattern.size, 0.0)


@compiled
def _factor(w):
    """Factors by the program that there is; False: it does not suit these numbers."""
    index, values, scale, first_of_mass = w.index_a, w.values_a, w.notes[MASS_SCALE], w.entries.size
    source = slots(index[at.SIZE]) + 2 * index[at.N_SLOTS]
    for s in range(index[at.N_SLOTS]):
        place = index[source + s]
        values[s] = w.augmented[place] * (scale if place >= first_of_mass else 1.0)
    return run(index, values) > 0.0


@compiled
def factor_sparse(f, w):
    """Factors for the w.M and w.G that there are; f.flags[FORM] is another one on return where they are not sparse."""
    w.counters[N_FACTORIZATIONS] += 1
    new = f.flags[CONSTANT_MASS] == 0 and note_pattern(w.M, w.mass_pattern)
    if w.index_a[at.SIZE] == 0 or new or not _factor(w):
        if not finite(w.M):
            return NOT_FINITE
        code = _make_program(w)
        if code == at.TOO_MANY:
            f.flags[FORM] = f.flags[DENSE_FORM]
            return DONE
        if code != at.ORDERED or not _factor(w):
            w.index_a[at.SIZE] = 0
            return MASS_NOT_DEFINITE
    if sign_of(w.index_a, w.values_a) != (1.0 if w.rows_v.size % 2 == 0 else -1.0):
        return MASS_NOT_DEFINITE
    return DONE


@compiled
def solve_sparse(w, r, c, a):
    """a of M a + G^T lam = r and G a = c; the multipliers of the rows that count go into w.z."""
    n, size, scale = r.size, w.index_a[at.SIZE], w.notes[MASS_SCALE]
    x, y = w.right[:size], w.right[size:]
    for j in range(n):
        x[j] = scale * r[j]
    for k in range(w.rows_v.size):
        x[n + k] = c[w.rows_v[k]]
    rows, columns = rows_of(w.index_a), columns_of(w.index_a)
    for k in range(size):
        y[k] = x[rows[k]]
    solve(w.index_a, w.values_a, y)
    for k in range(size):
        x[columns[k]] = y[k]
    for j in range(n):
        a[j] = x[j]
    for k in range(w.rows_v.size):
        w.z[k] = x[n + k] / scale

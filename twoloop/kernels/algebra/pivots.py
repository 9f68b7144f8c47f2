"""How small the pivots of G M^-1 G^T can become, whatever the order of elimination."""

import math

from twoloop.kernels.algebra.linalg import copy_matrix, ldl_factor, ldl_solve_rows
from twoloop.kernels.data.common import MATRIX, VECTOR, i8, kernel

ROUNDING = 1e-12  # relative: what a bound may be missed by


@kernel(i8(MATRIX, MATRIX, VECTOR, MATRIX, MATRIX, MATRIX, VECTOR), vectorized=True)
def first_bound_kept(mass, G, bounds, factors, solved, S, sizes):
    """Place of the first bound that no pivot is below, each over what it is without the other rows; how many, if none.

    No pivot is below the least eigenvalue of S = G M^-1 G^T with a diagonal of 1, and that is above a bound where S
    less the bound is definite. -1: M is not. `factors` is (n_q, n_q), `solved` (n_q, n_rows), `S` (2 n_rows, n_rows)
    and `sizes` (n_rows,), for scratch.
    """
    n_rows = len(G)
    copy_matrix(mass, factors)
    if not ldl_factor(factors):
        return -1
    for i in range(len(mass)):
        for k in range(n_rows):
            solved[i, k] = G[k, i]
    ldl_solve_rows(factors, solved)
    for i in range(n_rows):
        for k in range(n_rows):
            S[i, k] = 0.0
        for j in range(len(mass)):
            if G[i, j] != 0.0:
                for k in range(n_rows):
                    S[i, k] += G[i, j] * solved[j, k]
        sizes[i] = math.sqrt(S[i, i])
    less = S[n_rows:]
    for place in range(bounds.size):
        for i in range(n_rows):
            for k in range(n_rows):
                less[i, k] = S[i, k] / (sizes[i] * sizes[k])
            less[i, i] -= bounds[place] * (1.0 - ROUNDING)
        if ldl_factor(less):
            return place
    return bounds.size

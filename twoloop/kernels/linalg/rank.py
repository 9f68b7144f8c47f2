"""Choose independent rows of the Jacobian G, and rows g that make M + sum s g g^T invertible; find bounds of pivots."""

import math

from numba import types

from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, compiled, f8, i8, kernel, merged
from twoloop.kernels.linalg.dense import copy_matrix, largest_of, ldl_factor, ldl_solve, ldl_solve_rows

# assumed rounding error of the dot product of two rows, relative to (sum of squares of all entries) * (number of rows)
ROUNDING_OF_SQUARES = 4.0 * 2.0**-52
# a row is orthogonalised again if the squared norm of its orthogonal part is below this fraction of its squared norm
REORTHOGONALISE_BELOW = 0.5


@compiled
def _dot(x, y):
    whole = x.size - x.size % 4
    a = b = c = d = 0.0  # four sums, so that an addition need not wait for the previous one
    for j in range(0, whole, 4):
        a += x[j] * y[j]
        b += x[j + 1] * y[j + 1]
        c += x[j + 2] * y[j + 2]
        d += x[j + 3] * y[j + 3]
    for j in range(whole, x.size):
        a += x[j] * y[j]
    return (a + b) + (c + d)


@compiled
def _orthogonalise(basis, n, remainder, components):
    """Subtract from `remainder` its components along the first n rows of `basis`, which are orthonormal.

    Add these components to `components`. Return the square of the norm of `remainder`.
    """
    for i in range(n):
        component = _dot(basis[i], remainder)
        if component != 0.0:
            components[i] += component
            for j in range(remainder.size):
                remainder[j] -= component * basis[i, j]
    return _dot(remainder, remainder)


@merged
def select_rows(G, min_sine, basis, factors, kept):
    """Store in `kept` the indices of rows of G, each independent of the rows selected before; return their number.

    A row is independent if the sine of its angle to their span exceeds `min_sine`. Its part orthogonal to these
    is computed by Gram-Schmidt orthogonalisation, which is repeated if this part is small. On return, the rows of
    `basis` are orthonormal, and the matrix of selected rows is the lower triangle `factors` times `basis`. Both arrays
    have one row for each row that may be independent, and one more for scratch.
    """
    n_kept = 0
    for k in range(len(G)):
        if n_kept == len(basis) - 1:
            break
        remainder, components = basis[n_kept], factors[n_kept]
        for j in range(remainder.size):
            remainder[j] = G[k, j]
        for i in range(n_kept):
            components[i] = 0.0
        row_square = _dot(G[k], G[k])
        remainder_square = _orthogonalise(basis, n_kept, remainder, components)
        if remainder_square < REORTHOGONALISE_BELOW * row_square:
            remainder_square = _orthogonalise(basis, n_kept, remainder, components)
        if remainder_square > min_sine**2 * row_square:
            components[n_kept] = math.sqrt(remainder_square)
            for j in range(remainder.size):
                remainder[j] /= components[n_kept]
            kept[n_kept] = k
            n_kept += 1
    return n_kept


@kernel(i8(MATRIX, f8, MATRIX, MATRIX, INTEGERS), vectorized=True)
def independent_rows(G, min_sine, basis, factors, kept):
    """Return the result of `select_rows`; this kernel exists because Python cannot call `select_rows` itself."""
    return select_rows(G, min_sine, basis, factors, kept)


@merged
def _fill_coefficients(n, basis, factors, row, coefficients):
    """Store the `coefficients` (n) of the combination of the n rows from `select_rows` that is nearest to `row`."""
    for k in range(n):
        coefficients[k] = _dot(basis[k], row)
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            coefficients[k] -= factors[j, k] * coefficients[j]
        coefficients[k] /= factors[k, k]


@kernel(types.float64(MATRIX, i8, VECTOR))
def norm_of_inverse(factors, n, column):
    """Return the Frobenius norm of the inverse of the lower triangle `factors`, of n rows; `column` is scratch.

    If `factors` belong to independent rows G, this norm times |c| bounds the shortest solution x of G x = c.
    """
    total = 0.0
    for j in range(n):
        for i in range(j, n):
            value = 1.0 if i == j else 0.0
            for k in range(j, i):
                value -= factors[i, k] * column[k]
            column[i] = value / factors[i, i]
            total += column[i] * column[i]
    return math.sqrt(total)


@kernel(types.boolean(MATRIX, INTEGERS, f8, MATRIX, MATRIX, MATRIX, INTEGERS, MATRIX, VECTOR), vectorized=True)
def express_other_rows(rows, order, min_sine, chosen_rows, basis, factors, kept, coefficients, norms):
    """Return False if the rows order[:n] are dependent; else express other rows as combinations of these.

    `order`: indices in `rows`; n: number of rows of `chosen_rows`, which receives the rows order[:n]. Row i of
    `coefficients` receives the combination that is nearest to row order[n + i]; `norms` receives the norms of `rows`.
    For the other arguments see `select_rows`.
    """
    n = len(chosen_rows)
    for i in range(len(rows)):
        norms[i] = math.sqrt(_dot(rows[i], rows[i]))
    for k in range(n):
        for j in range(rows.shape[1]):
            chosen_rows[k, j] = rows[order[k], j]
    if select_rows(chosen_rows, min_sine, basis, factors, kept) < n:
        return False
    for i in range(len(coefficients)):
        _fill_coefficients(n, basis, factors, rows[order[n + i]], coefficients[i])
    return True


@kernel(types.boolean(MATRIX, f8, MATRIX), vectorized=True)
def singular_values_exceed(rows, ratio, gram):
    """Return True if all singular values of a matrix A = `rows` certainly exceed `ratio` times the largest one, s.

    This is so if A A^T - (ratio s)^2 I is positive definite; the Frobenius norm (>= s) replaces s. `gram` is scratch.
    """
    n, total = len(rows), 0.0
    for i in range(n):
        for j in range(i + 1):
            gram[j, i] = _dot(rows[i], rows[j])  # only the upper triangle of `gram` is used
        total += gram[i, i]
    for i in range(n):
        gram[i, i] -= (ratio * ratio + ROUNDING_OF_SQUARES * n) * total
    return math.isfinite(total) and ldl_factor(gram)


BOUND_ROUNDING = 1e-12  # largest rounding error of a pivot, relative to the bound that the pivot is compared with
NOT_DEFINITE, STAYS_SINGULAR = -1, -2  # codes: M is not positive definite; no added rows make M invertible
TINY = 1e-300  # replaces zero as a divisor
# If the ratio of the smallest to the largest eigenvalue of M exceeds SIMILAR_EIGENVALUES, no term s g g^T is added to
# M, and pivots of S = G M^-1 G^T, scaled to a diagonal of 1, decide whether a row of G is independent of previous rows:
# it is if its pivot exceeds INDEPENDENT. Then its part orthogonal to them is at least 3e-9 of its norm, the square root
# of INDEPENDENT * SIMILAR_EIGENVALUES. If this part is at most DEPENDENT times its norm, the row is dependent. If
# neither holds for some row, `select_rows` decides
SIMILAR_EIGENVALUES, INDEPENDENT, DEPENDENT = 1e-7, 1e-10, 1e-10
# A redundant row is a combination of independent rows. If the coefficient of an independent row in it (rows scaled to
# norm 1) exceeds this limit, the two rows are exchanged. This multiplies the volume that the independent rows span by
# the coefficient: the rows are farther from becoming dependent, as at each dead centre of the slider-crank with two
# rods. The limit exceeds 1, because equal coefficients of magnitude 1 are common, and must not lead to exchanges
MAX_COEFFICIENT = 1.5
# if the ratio of two coefficients is at most this, they count as equal, and the first one is chosen: in symmetrical
# mechanisms, rounding would otherwise choose among many equal coefficients, differently at each start
TIE_RATIO = 1.01
ZERO_ENTRY = 1e-12  # an entry counts as zero up to this fraction of the largest in its row: the start may be rounded


def workspace_size(n_rows: int, n: int) -> int:
    """Return the number of floats that the argument `workspace` of `choose_rows` must have."""
    n_max = min(n_rows, n) + 1
    return n_max * (n + n_max) + 2 * n * n + n_rows * (n + 3 * n_rows + 1) + n


@merged
def _factor_and_count_negative(A):
    """Replace a symmetric A by its factors, as `ldl_factor` does; return the number of negative eigenvalues of A."""
    n, count = len(A), 0
    for k in range(n):
        if not A[k, k] > 0.0:
            count += 1
            if A[k, k] == 0.0:
                A[k, k] = -TINY
        A[k, k] = 1.0 / A[k, k]
        for i in range(k + 1, n):
            if A[k, i] != 0.0:
                factor = A[k, i] * A[k, k]
                for j in range(i, n):
                    A[i, j] -= factor * A[k, j]
    return count


@compiled
def _eigenvalue_bounds(mass):
    """Return a lower and an upper bound of the eigenvalues of the mass matrix, by Gershgorin's circles."""
    smallest, largest = math.inf, 0.0
    for i in range(len(mass)):
        row_sum = 0.0
        for j in range(len(mass)):
            row_sum += abs(mass[i, j])
        smallest, largest = min(smallest, 2.0 * mass[i, i] - row_sum), max(largest, row_sum)
    return smallest, largest


@compiled
def _count_weak_eigenvalues(mass, weak_ratio, A):
    """Return the number of eigenvalues of the mass matrix M below a limit z, and store the factors of M - z I in A.

    z is `weak_ratio` times an upper bound on the largest eigenvalue.
    """
    _, largest = _eigenvalue_bounds(mass)
    copy_matrix(mass, A)
    for i in range(len(mass)):
        A[i, i] -= weak_ratio * largest
    return _factor_and_count_negative(A)


@merged
def _sort_rows_by_entries(G, order, counts):
    """Sort the rows of G by their numbers of nonzero entries: store indices in `order`, and the numbers in `counts`."""
    for k in range(len(G)):
        count, i, zero = 0.0, k, ZERO_ENTRY * largest_of(G[k])
        for j in range(G.shape[1]):
            count += abs(G[k, j]) > zero
        while i > 0 and counts[i - 1] > count:
            counts[i], order[i] = counts[i - 1], order[i - 1]
            i -= 1
        counts[i], order[i] = count, k


@merged
def _removes_weak_eigenvalue(A, g, scale, x):
    """Return True if adding scale * g g^T to the mass matrix M removes one of its eigenvalues below the limit z.

    Then det(M - z I) changes its sign. A contains the factors of M - z I, see `_count_weak_eigenvalues`; x is scratch.
    """
    for j in range(x.size):
        x[j] = g[j]
    ldl_solve(A, x)
    total = 0.0
    for j in range(x.size):
        total += g[j] * x[j]
    return 1.0 + scale * total < 0.0


@merged
def _add_rows_to_mass(mass, G, weak_ratio, scale, A, x, order, added):
    """Add scale * g g^T to the mass matrix M, for some rows g of G, until all its eigenvalues are large enough.

    An eigenvalue is too small if it is less than `weak_ratio` times the largest one. Rows are tried in the sequence of
    `order`, where -1 replaces the index of an added row. Store added indices in `added`; return their number, or
    STAYS_SINGULAR if no row removes a small eigenvalue.
    """
    n_added = 0
    while _count_weak_eigenvalues(mass, weak_ratio, A) > 0:
        position = -1
        for k in range(len(G)):
            if order[k] >= 0 and _removes_weak_eigenvalue(A, G[order[k]], scale, x):
                position = k
                break
        if position < 0:
            return STAYS_SINGULAR
        row = order[position]
        added[n_added], order[position] = row, -1
        n_added += 1
        for i in range(len(mass)):
            if G[row, i] != 0.0:
                for j in range(len(mass)):
                    mass[i, j] += scale * G[row, i] * G[row, j]
    return n_added


@merged
def _list_rows(is_kept, kept):
    n_kept = 0
    for k in range(len(is_kept)):
        if is_kept[k] == 1:
            kept[n_kept] = k
            n_kept += 1
    return n_kept


@compiled
def _exchange_rows(C, is_kept, kept):
    """Exchange independent rows with redundant rows until no coefficient exceeds MAX_COEFFICIENT.

    Redundant row i is the sum over k of C[i, k] times independent row k, if all rows are scaled to norm 1; `is_kept` is
    1 for independent rows, else 0. Each exchange multiplies the volume that independent rows span by the coefficient.
    Store the indices of the independent rows in `kept`, and return their number.
    """
    n = len(C)
    n_kept = _list_rows(is_kept, kept)
    for _ in range(2 * (n - n_kept)):
        largest, leaving, entering = MAX_COEFFICIENT, -1, -1
        for i in range(n):
            if is_kept[i] == 1:
                continue
            for k in range(n):
                coefficient = abs(C[i, k]) if is_kept[k] == 1 else 0.0
                if coefficient > largest and (leaving < 0 or coefficient > TIE_RATIO * largest):
                    largest, leaving, entering = coefficient, k, i
        if leaving < 0:
            break
        # solve the equation of the entering (redundant) row for the leaving (independent) row; substitute it elsewhere
        inverse = 1.0 / C[entering, leaving]
        is_kept[leaving], is_kept[entering] = 0, 1
        for k in range(n):
            C[leaving, k] = -inverse * C[entering, k]
        C[leaving, entering] = inverse
        for i in range(n):
            if is_kept[i] == 0 and i != leaving:
                factor = C[i, leaving]
                C[i, entering] = 0.0
                for k in range(n):
                    C[i, k] += factor * C[leaving, k]
    return _list_rows(is_kept, kept)


@compiled
def _fill_scaled_products(mass, G, factors, solved, S, sizes):
    """Store in S the upper triangle of G M^-1 G^T, scaled to a diagonal of 1; M not positive definite: return False.

    `sizes` receives the factors that scale the rows of G, or 0 for rows of zeros. `factors` and `solved` are scratch.
    """
    n_rows, n = G.shape
    copy_matrix(mass, factors)
    if not ldl_factor(factors):
        return False
    for i in range(n):
        for k in range(n_rows):
            solved[i, k] = G[k, i]
    ldl_solve_rows(factors, solved)
    for i in range(n_rows):
        for k in range(i, n_rows):
            S[i, k] = 0.0
        for j in range(n):
            if G[i, j] != 0.0:
                for k in range(i, n_rows):
                    S[i, k] += G[i, j] * solved[j, k]
        sizes[i] = 1.0 / math.sqrt(S[i, i]) if S[i, i] > 0.0 else 0.0
    for i in range(n_rows):
        for k in range(i, n_rows):
            S[i, k] *= sizes[i] * sizes[k]
    return True


@compiled
def _find_dependent_rows(S, G, sizes, U, C, remainder, is_kept):
    """Set `is_kept` to 0 for each row of G that depends on previous rows, else to 1; return max(1 / pivot) of S.

    If it is uncertain whether a row is dependent, return 0. For S and `sizes` see `_fill_scaled_products`. C[i, k]
    receives the coefficient of row k in a dependent row i, both scaled to norm 1. U and `remainder` are scratch.
    """
    n_rows, largest_inverse = len(S), 1.0
    copy_matrix(S, U)
    for k in range(n_rows):
        is_kept[k] = 1 if U[k, k] > INDEPENDENT else 0
        if is_kept[k] == 1:
            U[k, k] = 1.0 / U[k, k]
            largest_inverse = max(largest_inverse, U[k, k])
            for i in range(k + 1, n_rows):
                if U[k, i] != 0.0:
                    factor = U[k, i] * U[k, k]
                    for j in range(i, n_rows):
                        U[i, j] -= factor * U[k, j]
            continue
        for j in range(remainder.size):
            remainder[j] = G[k, j] * sizes[k]
        norm = math.sqrt(_dot(remainder, remainder))
        for i in range(n_rows):
            C[k, i] = 0.0
        for i in range(k - 1, -1, -1):
            if is_kept[i] == 1:
                coefficient = U[i, k]
                for j in range(i + 1, k):
                    coefficient -= U[i, j] * C[k, j]
                C[k, i] = coefficient = coefficient * U[i, i]
                if coefficient != 0.0:
                    for j in range(remainder.size):
                        remainder[j] -= coefficient * sizes[i] * G[i, j]
        if not math.sqrt(_dot(remainder, remainder)) <= DEPENDENT * norm:
            return 0.0
        for i in range(k):
            if C[k, i] != 0.0:
                C[k, i] *= sizes[i] * math.sqrt(_dot(G[i], G[i])) / norm
    return largest_inverse


@merged
def _fill_shifted(S, kept, shift, shifted):
    for i in range(len(shifted)):
        for k in range(i, len(shifted)):  # `ldl_factor` uses only the upper triangle
            shifted[i, k] = S[kept[i], kept[k]]
        shifted[i, i] -= shift


@compiled
def _first_bound_below_pivots(S, kept, n_kept, largest_inverse, bounds, scratch):
    """Return the index of the first of `bounds` that is below all pivots of S; bounds.size if none is.

    S is the matrix G M^-1 G^T of the rows `kept` of G, scaled to a diagonal of 1. No pivot is below the smallest
    eigenvalue of S, and this eigenvalue exceeds a bound z if S - z I is positive definite. It is at most the smallest
    pivot, 1 / `largest_inverse` (0: unknown), so that larger bounds need no test.
    """
    shifted = scratch[: n_kept * n_kept].reshape((n_kept, n_kept))
    if largest_inverse == 0.0:
        _fill_shifted(S, kept, 0.0, shifted)
        if not ldl_factor(shifted):
            return bounds.size
        for k in range(n_kept):
            largest_inverse = max(largest_inverse, shifted[k, k])
    for index in range(bounds.size):
        shift = bounds[index] * (1.0 - BOUND_ROUNDING)
        if shift * largest_inverse < 1.0:
            _fill_shifted(S, kept, shift, shifted)
            if ldl_factor(shifted):
                return index
    return bounds.size


@merged
def _select_dependent_rows(G, min_sine, basis, factors, coefficients, C, kept, is_kept):
    """Set `is_kept` to 1 for the rows of G that `select_rows` selects with `min_sine`, else to 0.

    C[i, k] receives the coefficient of row k in a redundant row i, both scaled to norm 1. Other arguments: scratch.
    """
    n_kept = select_rows(G, min_sine, basis, factors, kept)
    for k in range(len(G)):
        is_kept[k] = 0
    for k in range(n_kept):
        is_kept[kept[k]] = 1
    for i in range(len(G)):
        if is_kept[i] == 0:
            _fill_coefficients(n_kept, basis, factors, G[i], coefficients)
            row_square = max(_dot(G[i], G[i]), TINY)
            for k in range(n_kept):
                C[i, kept[k]] = coefficients[k] * math.sqrt(_dot(G[kept[k]], G[kept[k]]) / row_square)


@kernel(i8(MATRIX, MATRIX, f8, f8, VECTOR, VECTOR, INTEGERS), vectorized=True)
def choose_rows(original_mass, G, min_sine, weak_ratio, bounds, workspace, chosen):
    """Choose the independent rows of G, and rows g for which M + sum s g g^T is invertible (M: `original_mass`).

    Rows of G are selected as in `select_rows` with `min_sine`, then exchanged as in `_exchange_rows`. Terms s g g^T are
    added to M if it has eigenvalues below `weak_ratio` times the largest; weak_ratio = 0: none are added. `chosen`, of
    2 + 3 n_rows numbers, receives the number of independent rows, the number of added rows, and the indices of both in
    two lists of length n_rows. `workspace` is scratch, but workspace[0] receives s. Return the result of
    `_first_bound_below_pivots`, or a code: STAYS_SINGULAR or NOT_DEFINITE. See generate/elimination.py.
    """
    n_rows, n = G.shape
    n_max = min(n_rows, n) + 1
    kept, added, order = chosen[2 : 2 + n_rows], chosen[2 + n_rows : 2 + 2 * n_rows], chosen[2 + 2 * n_rows :]
    end = n_max * n
    basis, factors = workspace[:end].reshape((n_max, n)), workspace[end : end + n_max * n_max].reshape((n_max, n_max))
    end += n_max * n_max
    mass, A = workspace[end : end + n * n].reshape((n, n)), workspace[end + n * n : end + 2 * n * n].reshape((n, n))
    end += 2 * n * n
    x, sizes, end = workspace[end : end + n], workspace[end + n : end + n + n_rows], end + n + n_rows
    solved, end = workspace[end : end + n * n_rows].reshape((n, n_rows)), end + n * n_rows
    scratch = workspace[end : end + n_rows * n_rows]
    matrices = workspace[end : end + 3 * n_rows * n_rows].reshape((3 * n_rows, n_rows))
    U, S, C = matrices[:n_rows], matrices[n_rows : 2 * n_rows], matrices[2 * n_rows :]
    chosen[1], workspace[0] = 0, 1.0
    smallest, largest = _eigenvalue_bounds(original_mass)
    is_definite, largest_inverse = smallest > SIMILAR_EIGENVALUES * largest, 0.0
    if is_definite and _fill_scaled_products(original_mass, G, A, solved, S, sizes):
        largest_inverse = _find_dependent_rows(S, G, sizes, U, C, x, order)
    if largest_inverse > 0.0:
        chosen[0] = n_kept = _exchange_rows(C, order, kept)
        largest_inverse = largest_inverse if n_kept == n_rows else 0.0  # 0: unknown, rows may have been exchanged
        first_bound = _first_bound_below_pivots(S, kept, n_kept, largest_inverse, bounds, scratch)
        if first_bound < bounds.size:  # the chosen rows are certainly independent
            return first_bound
    _select_dependent_rows(G, min_sine, basis, factors, sizes, C, kept, order)
    chosen[0] = n_kept = _exchange_rows(C, order, kept)
    copy_matrix(original_mass, mass)
    n_added, scale = 0, 1.0
    if n_kept > 0 and weak_ratio > 0.0 and _count_weak_eigenvalues(mass, weak_ratio, A) > 0:
        # the power of two for which the largest entries of scale * g g^T (g: a row of G) and M are about equal
        largest, largest_of_rows = largest_of(mass.reshape(mass.size)), largest_of(G.reshape(G.size))
        scale = 2.0 ** math.floor(math.log2(largest / (largest_of_rows * largest_of_rows)) + 0.5)
        _sort_rows_by_entries(G, order, sizes)
        n_added = _add_rows_to_mass(mass, G, weak_ratio, scale, A, x, order, added)
    chosen[1], workspace[0] = max(n_added, 0), scale
    if n_added < 0:
        return n_added
    if not _fill_scaled_products(mass, G, A, solved, S, sizes):
        return NOT_DEFINITE
    return _first_bound_below_pivots(S, kept, n_kept, 0.0, bounds, scratch)

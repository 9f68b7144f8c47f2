"""Choose independent rows of the Jacobian G of all constraints, so that the multipliers are unique.

If the mass matrix M is singular, also choose rows g of G for which M + sum s g^T g is invertible (s: positive number).
Find a lower bound of the pivots of G M^-1 G^T (G: independent rows), the divisors in the elimination of multipliers.
"""

import math

from numba import types

from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, compiled, f8, i8, kernel, merged
from twoloop.kernels.linalg.dense import copy_matrix, largest_of, ldl_factor, ldl_solve, ldl_solve_rows

ROUNDING_OF_SQUARES = 4.0 * 2.0**-52  # rounding error of A A^T / (number of rows of A * sum of squared entries of A)
REORTHOGONALISE_BELOW = 0.5  # a row is orthogonalised again if |orthogonal part|^2 is below this fraction of |row|^2


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
    """Make `remainder` orthogonal to the first n rows of `basis`, which are orthonormal; return its new squared norm.

    Add the subtracted components along these rows to `components`.
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
    """Select independent rows of G, from the first row on; store their indices in `kept`, and return their number.

    A row is selected if the sine of its angle to the span of the rows selected before exceeds `min_sine`. This angle is
    found by Gram-Schmidt orthogonalisation, which is repeated if the orthogonal part of the row is small. On return,
    the rows of `basis` are orthonormal, and the matrix of selected rows is the lower triangle `factors` times `basis`.
    If G can have n independent rows, both arrays need n + 1 rows; the last one is scratch.
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
    """Select independent rows of G as `select_rows` does: this kernel is for callers in Python."""
    return select_rows(G, min_sine, basis, factors, kept)


@merged
def _fill_coefficients(n, basis, factors, row, coefficients):
    """Approximate `row` by a linear combination of the n rows that `select_rows` selected; store its `coefficients`."""
    for k in range(n):
        coefficients[k] = _dot(basis[k], row)
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            coefficients[k] -= factors[j, k] * coefficients[j]
        coefficients[k] /= factors[k, k]


@kernel(types.float64(MATRIX, i8, VECTOR))
def norm_of_inverse(factors, n, column):
    """Return the Frobenius norm of the inverse of the lower triangle `factors`, of n rows; `column` is scratch.

    If `factors` are those from `select_rows`, all singular values of the selected rows are at least 1 / this norm.
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
    """Express rows as linear combinations of chosen rows; return False if the chosen rows are not independent.

    `chosen_rows`, of n rows, receives the rows with the indices order[:n] in `rows`. Row i of `coefficients` receives
    the coefficients of the linear combination of these rows that is nearest to row order[n + i]. `norms` receives the
    norms of all rows. For the other arguments see `select_rows`.
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
    """Return True if all singular values of the matrix A = `rows` certainly exceed `ratio` times the largest one.

    This is so if A A^T - (ratio |A|)^2 I is positive definite, where |A| is the Frobenius norm. `gram` is scratch.
    """
    n, total = len(rows), 0.0
    for i in range(n):
        for j in range(i + 1):
            gram[j, i] = _dot(rows[i], rows[j])  # only the upper triangle of `gram` is used
        total += gram[i, i]
    for i in range(n):
        gram[i, i] -= (ratio * ratio + ROUNDING_OF_SQUARES * n) * total
    return math.isfinite(total) and ldl_factor(gram)


BOUND_ROUNDING = 1e-12  # a bound of pivots is reduced by this fraction: a pivot equal to the bound counts as above it
NOT_DEFINITE, STAYS_SINGULAR = -1, -2  # codes: M + sum s g^T g is not positive definite; it is singular for any rows g
TINY = 1e-300  # replaces zero as a divisor
# Limits that decide whether a row of G is independent of previous rows. S = G M^-1 G^T, scaled to a diagonal of 1, is
# factored. A row is independent if its pivot in S exceeds INDEPENDENT: then its part orthogonal to previous rows is at
# least 3e-9 of its norm, the square root of INDEPENDENT * SIMILAR_EIGENVALUES. A row is dependent if this part is at
# most DEPENDENT times its norm. If a row is neither independent nor dependent by these limits, or if the smallest
# eigenvalue of the mass matrix M may be below SIMILAR_EIGENVALUES times the largest, `select_rows` decides for all rows
SIMILAR_EIGENVALUES, INDEPENDENT, DEPENDENT = 1e-7, 1e-10, 1e-10
# A redundant row is a linear combination of independent rows, all scaled to norm 1. If the coefficient of an
# independent row exceeds MAX_COEFFICIENT, the redundant row replaces this row. So independent rows are less likely to
# become dependent, for example at dead centres. Coefficients of 1, which are common, must not cause exchanges
MAX_COEFFICIENT = 1.5
TIE_RATIO = 1.01  # coefficients count as equal up to this ratio, so that rounding errors do not choose among them
ZERO_ENTRY = 1e-12  # an entry up to this fraction of its row's largest entry counts as zero: it may be a rounding error


def workspace_size(n_rows: int, n: int) -> int:
    """Return the number of floats that the argument `workspace` of `choose_rows` must have."""
    n_max = min(n_rows, n) + 1
    return n_max * (n + n_max) + 2 * n * n + n_rows * (n + 3 * n_rows + 1) + n


@merged
def _factor_and_count_negative(A):
    """Replace a symmetric matrix A by its L D L^T factors; return how many of its eigenvalues are not positive."""
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
    """Count eigenvalues of M = `mass` up to limit = weak_ratio * (bound of the largest); factor M - limit I in A."""
    _, largest = _eigenvalue_bounds(mass)
    copy_matrix(mass, A)
    for i in range(len(mass)):
        A[i, i] -= weak_ratio * largest
    return _factor_and_count_negative(A)


@merged
def _sort_rows_by_entries(G, order, counts):
    """Sort the rows of G by their numbers of nonzero entries: store row indices in `order`, the numbers in `counts`."""
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
    """Return True if adding scale * g^T g to the mass matrix M raises a weak eigenvalue above the limit for weak ones.

    Then det(M - limit I) changes its sign. A: factors of M - limit I; g: a row of the Jacobian; x: scratch.
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
    """Add scale * g^T g to the mass matrix M, for some rows g of G, until all eigenvalues of M exceed a limit.

    The limit is `weak_ratio` times an upper bound of the largest eigenvalue. Rows are tried in the sequence of
    `order`; on return, -1 replaces added rows in `order`. Store the indices of added rows in `added`; return their
    number, or STAYS_SINGULAR if eigenvalues are still too small and no further row helps.
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
    """Exchange independent rows with redundant rows, so that the independent ones are farther from dependence.

    C[i, k] is the coefficient of independent row k in redundant row i, both scaled to norm 1. Two rows are exchanged if
    |C[i, k]| exceeds MAX_COEFFICIENT. This multiplies the volume spanned by independent rows by |C[i, k]|. Update C
    and `is_kept` (1: independent, 0: redundant). Store the indices of independent rows in `kept`; return their number.
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
        # solve the equation of the redundant row `entering` for the independent row `leaving`, and substitute the
        # result in the equations of the other redundant rows
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
    """Store in S the upper triangle of G M^-1 G^T, with a diagonal of 1; return False if M is not positive definite.

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
    """Find the rows of G that depend on previous rows, by the pivots of S, which is G M^-1 G^T with a diagonal of 1.

    Set `is_kept` to 0 for these rows, else to 1. Return the largest 1 / pivot of the other rows, or 0 if it is unclear
    whether some row is dependent. C[i, k] becomes the coefficient of row k in a dependent row i, both scaled to norm 1.
    S, `sizes`: results of `_fill_scaled_products`. U and `remainder` are scratch.
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
    """Return the index of the first of `bounds` that is below all pivots of S; if there is none, return bounds.size.

    S is G M^-1 G^T, scaled to a diagonal of 1, for the rows `kept` of G. A bound z is below all pivots, whatever the
    order of elimination, if S - z I is positive definite. This matrix is not positive definite if z
    exceeds the smallest pivot, 1 / `largest_inverse`. If `largest_inverse` is 0, compute it first.
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
def _mark_independent_rows(G, min_sine, basis, factors, coefficients, C, kept, is_kept):
    """Set `is_kept` to 1 for the rows of G that `select_rows` selects, and to 0 for the others, the redundant rows.

    C[i, k] becomes the coefficient of independent row k in redundant row i, both scaled to norm 1. The arrays
    `basis`, `factors`, `coefficients` and `kept` are scratch.
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
    """Choose independent rows of G, and rows g that make M = `original_mass` invertible if s g^T g is added (s > 0).

    Rows of G are selected by their pivots (see INDEPENDENT) or by `select_rows`, then exchanged by `_exchange_rows`.
    Rows g are chosen if weak_ratio > 0 and M has eigenvalues below `weak_ratio` times the largest. Return the index of
    the first of `bounds` that is below all pivots of G M^-1 G^T, scaled to a diagonal of 1; bounds.size if there is
    none; on failure, STAYS_SINGULAR or NOT_DEFINITE. Other results (n_rows: number of rows of G):

    - chosen[0], chosen[1]: number of independent rows, number of rows g. Two lists of length n_rows follow: the indices
      of independent rows, and of rows g. The remaining n_rows numbers are scratch
    - workspace[0]: the number s. The rest of `workspace` is scratch
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
        # if there are redundant rows, rows may have been exchanged: then 0 says that the largest 1 / pivot is unknown
        largest_inverse = largest_inverse if n_kept == n_rows else 0.0
        first_bound = _first_bound_below_pivots(S, kept, n_kept, largest_inverse, bounds, scratch)
        if first_bound < bounds.size:  # all pivots exceed a bound: the chosen rows are certainly independent
            return first_bound
    _mark_independent_rows(G, min_sine, basis, factors, sizes, C, kept, order)
    chosen[0] = n_kept = _exchange_rows(C, order, kept)
    copy_matrix(original_mass, mass)
    n_added, scale = 0, 1.0
    if n_kept > 0 and weak_ratio > 0.0 and _count_weak_eigenvalues(mass, weak_ratio, A) > 0:
        # the power of two for which the largest entries of scale * g^T g (g: a row of G) and M are about equal
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

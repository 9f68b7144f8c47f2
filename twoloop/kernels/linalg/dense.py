"""Factor small dense matrices in place, without allocation, and record where matrices have nonzero entries.

Innermost loops run along rows, and rows with the factor zero are skipped: even small constraint Jacobians are sparse.
"""

from twoloop.kernels.data.common import compiled, merged


@merged
def copy(source, target):
    """Copy `source` to `target` element by element, because numba's slice assignment allocates."""
    for i in range(source.size):
        target[i] = source[i]


@merged
def copy_matrix(source, target):
    """Copy rows of `source` to `target`: as many as the matrix with fewer rows has."""
    for i in range(min(source.shape[0], target.shape[0])):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@merged
def largest_of(x):
    """Return max|x_i| of a vector; 0 for an empty vector."""
    largest = 0.0
    for j in range(x.size):
        largest = max(largest, abs(x[j]))
    return largest


@compiled
def sum_rows(weights, rows, total):
    """Store in `total` the sum over k of weights[k] * rows[k]; four rows are added at once, so that LLVM vectorises."""
    remainder = weights.size % 4
    for m in range(total.size):
        total[m] = 0.0
    for k in range(remainder):
        weight, row = weights[k], rows[k]
        for m in range(total.size):
            total[m] += weight * row[m]
    for k in range(remainder, weights.size, 4):
        a, b, c, d = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
        for m in range(total.size):
            total[m] += (a * rows[k, m] + b * rows[k + 1, m]) + (c * rows[k + 2, m] + d * rows[k + 3, m])


@merged
def contains(numbers, number):
    """Return True if `number` is one of `numbers`."""
    is_contained = False
    for element in numbers:
        is_contained = is_contained or element == number
    return is_contained


@merged
def _magnitude(x):
    """Return |x| of a real number, or |Re x| + |Im x| of a complex number: LAPACK, too, avoids the square root."""
    return abs(x.real) + abs(x.imag)


@merged
def lu_factor(A, pivots):
    """Replace A, real or complex, by its factors L and U, with 1/u_kk on the diagonal; store row exchanges in `pivots`.

    Return min|u_kk| / max|u_kk| of the pivots u_kk, or 0 if A is singular or a pivot is not finite.
    """
    n = A.shape[0]
    smallest = 1e300
    largest = 0.0
    for k in range(n):
        pivot_row = k
        pivot_size = _magnitude(A[k, k])
        for i in range(k + 1, n):
            magnitude = _magnitude(A[i, k])
            if magnitude > pivot_size:
                pivot_size = magnitude
                pivot_row = i
        pivots[k] = pivot_row
        if not pivot_size > 0.0:  # also true for NaN
            return 0.0
        smallest = min(smallest, pivot_size)
        largest = max(largest, pivot_size)
        if pivot_row != k:
            for j in range(n):
                A[k, j], A[pivot_row, j] = A[pivot_row, j], A[k, j]
        inverse = 1.0 / A[k, k]
        A[k, k] = inverse
        for i in range(k + 1, n):
            if A[i, k] != 0.0:
                factor = A[i, k] * inverse
                A[i, k] = factor
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
    return smallest / largest if n > 0 else 1.0


@merged
def lu_sign(A, pivots):
    """Return the sign of the determinant of a real matrix, from its factors A and `pivots` from `lu_factor`."""
    sign = 1.0
    for k in range(A.shape[0]):
        if (A[k, k] < 0.0) != (pivots[k] != k):
            sign = -sign
    return sign


@merged
def lu_solve(A, pivots, x):
    """Replace the right-hand side x by the solution, using the factors A and `pivots` from `lu_factor`."""
    n = A.shape[0]
    for k in range(n):
        pivot_row = pivots[k]
        if pivot_row != k:
            x[k], x[pivot_row] = x[pivot_row], x[k]
    for i in range(1, n):
        total = x[i]
        for j in range(i):
            total -= A[i, j] * x[j]
        x[i] = total
    for i in range(n - 1, -1, -1):
        total = x[i]
        for j in range(i + 1, n):
            total -= A[i, j] * x[j]
        x[i] = total * A[i, i]


@merged
def ldl_factor(A):
    """Factor a symmetric matrix A = U^T D^-1 U in place; return False if A is not positive definite or not finite.

    U is upper triangular; D, the diagonal of U, contains the pivots d_k. Store 1/d_k on the diagonal of A, and the
    other entries of U above the diagonal. Entries below the diagonal are neither read nor changed.
    """
    n = A.shape[0]
    for k in range(n):
        if not A[k, k] > 0.0:
            return False
        inverse = 1.0 / A[k, k]
        A[k, k] = inverse
        for i in range(k + 1, n):
            if A[k, i] != 0.0:
                factor = A[k, i] * inverse
                for j in range(i, n):
                    A[i, j] -= factor * A[k, j]
    return True


@merged
def invert_definite(A):
    """Replace a symmetric A by its inverse, by Gauss-Jordan elimination; return False if A is not positive definite."""
    n = A.shape[0]
    for k in range(n):
        if not A[k, k] > 0.0:
            return False
        inverse = 1.0 / A[k, k]
        A[k, k] = 1.0
        for j in range(n):
            A[k, j] *= inverse
        for i in range(n):
            if i != k and A[i, k] != 0.0:
                factor = A[i, k]
                A[i, k] = 0.0
                for j in range(n):
                    A[i, j] -= factor * A[k, j]
    return True


@merged
def ldl_solve(A, x):
    """Replace the right-hand side x of a linear system by the solution, using the factors A from `ldl_factor`."""
    n = A.shape[0]
    for k in range(n):
        if x[k] != 0.0:
            factor = x[k] * A[k, k]
            for j in range(k + 1, n):
                x[j] -= factor * A[k, j]
    for k in range(n - 1, -1, -1):
        total = x[k]
        for j in range(k + 1, n):
            total -= A[k, j] * x[j]
        x[k] = total * A[k, k]


@merged
def ldl_solve_rows(A, B):
    """Replace right-hand sides, the columns of B, by the solutions, using the factors A from `ldl_factor`."""
    n, m = B.shape
    for k in range(n):
        for i in range(k + 1, n):
            if A[k, i] != 0.0:
                factor = A[k, i] * A[k, k]
                for j in range(m):
                    B[i, j] -= factor * B[k, j]
    for k in range(n - 1, -1, -1):
        for i in range(k + 1, n):
            if A[k, i] != 0.0:
                for j in range(m):
                    B[k, j] -= A[k, i] * B[i, j]
        for j in range(m):
            B[k, j] *= A[k, k]


@merged
def has_new_entries(G, pattern):
    """Return True if G has a nonzero entry where `pattern` is 0."""
    entries, recorded = G.reshape(G.size), pattern.reshape(pattern.size)
    sum_of_new_entries = 0.0  # add up |entries| where `pattern` is 0: this is faster than to test each entry
    for i in range(recorded.size):
        sum_of_new_entries += abs(entries[i]) * (1.0 - recorded[i])
    return sum_of_new_entries != 0.0  # also true for NaN


@compiled
def update_pattern(G, pattern):
    """Set `pattern` to 1 where G is not zero; return True if an entry of `pattern` changes."""
    if not has_new_entries(G, pattern):
        return False
    has_new = False
    for i in range(pattern.shape[0]):
        for j in range(pattern.shape[1]):
            if G[i, j] != 0.0 and pattern[i, j] == 0.0:
                pattern[i, j] = 1.0
                has_new = True
    return has_new

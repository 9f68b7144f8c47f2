"""Which rows of a matrix count, in the order in which they stand, and how large solutions for these can be."""

import math

from numba import types

from twoloop.kernels.algebra.linalg import ldl_factor, ldl_solve
from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, compiled, f8, i8, kernel, merged

ROUNDED = 4.0 * 2.0**-52  # of the sum of squares of all entries, a row: what rounding may add to a product of rows
MOST_OF_IT = 0.5  # of the square of a row's length: with more left, what is left is orthogonal to rounding


@compiled
def _dot(x, y):
    total = 0.0
    for j in range(x.size):
        total += x[j] * y[j]
    return total


@compiled
def _without_parts(basis, n, rest, parts):
    """Take the parts that n orthonormal rows have in a row out of it; the square of the length that is left."""
    for i in range(n):
        part = _dot(basis[i], rest)
        if part != 0.0:
            parts[i] += part
            for j in range(rest.size):
                rest[j] -= part * basis[i, j]
    return _dot(rest, rest)


@merged
def first_rows(G, least, basis, factors, kept):
    """Put down the first rows that no rows before add up to, and return how many they are.

    Such a row keeps more than the share `least` of its length without its part in those before, by Gram and Schmidt's
    orthogonalisation, repeated where most of the row is lost. It is the combination of the rows of `basis`, of length
    1, that a row of the lower triangle `factors` says; these two have as many rows as can be independent, and one more
    for scratch.
    """
    n_kept = 0
    for k in range(len(G)):
        if n_kept == len(basis) - 1:
            break
        rest, parts = basis[n_kept], factors[n_kept]
        for j in range(rest.size):
            rest[j] = G[k, j]
        for i in range(n_kept):
            parts[i] = 0.0
        length = _dot(G[k], G[k])
        square = _without_parts(basis, n_kept, rest, parts)
        if square < MOST_OF_IT * length:
            square = _without_parts(basis, n_kept, rest, parts)
        if square > least**2 * length:
            parts[n_kept] = math.sqrt(square)
            for j in range(rest.size):
                rest[j] /= parts[n_kept]
            kept[n_kept] = k
            n_kept += 1
    return n_kept


@kernel(i8(MATRIX, f8, MATRIX, MATRIX, INTEGERS), vectorized=True)
def independent_rows(G, least, basis, factors, kept):
    """The same, for Python."""
    return first_rows(G, least, basis, factors, kept)


@merged
def _find_shares(n, basis, factors, row, shares):
    """Which combination of n rows that count another row is, by least squares where it is none."""
    for k in range(n):
        shares[k] = _dot(basis[k], row)
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            shares[k] -= factors[j, k] * shares[j]
        shares[k] /= factors[k, k]


@kernel(types.float64(MATRIX, i8, VECTOR))
def size_of_inverse(factors, n, column):
    """The root of the sum of squares of the entries of the inverse of a lower triangle of n rows; `column` is scratch.

    Solutions of least norm with independent rows, or with these and others that depend on them, are at most so many
    times as large as the right-hand side.
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
def shares_of_others(rows, order, least, others, basis, factors, kept, shares, lengths):
    """Whether `others` are independent; then which combination of these each of some rows is, by least squares.

    `order` has the places among all `rows` of those to put into `others`, then of those to find the shares of;
    `lengths` become those of all rows, and the rest is as in `first_rows`.
    """
    n = len(others)
    for i in range(len(rows)):
        lengths[i] = math.sqrt(_dot(rows[i], rows[i]))
    for k in range(n):
        for j in range(rows.shape[1]):
            others[k, j] = rows[order[k], j]
    if first_rows(others, least, basis, factors, kept) < n:
        return False
    for i in range(len(shares)):
        _find_shares(n, basis, factors, rows[order[n + i]], shares[i])
    return True


@kernel(i8(MATRIX, VECTOR, f8, MATRIX, MATRIX, INTEGERS, MATRIX, MATRIX, MATRIX, VECTOR), vectorized=True)
def least_solution(rows, values, least, basis, factors, kept, shares, gram, parts, x):
    """The x of least norm that gives rows these values, by least squares; how many rows count, as in `first_rows`.

    Where S are the shares that the rows y that count have in the others, of values b, these are least squares for
    y + S^T z with (1 + S S^T) z = b - S y. `values` become what x leaves of them; `parts` has room for y and z.
    """
    n, m = first_rows(rows, least, basis, factors, kept), 0
    y, z = parts[0], parts[1]
    for i in range(len(rows)):
        if i - m < n and kept[i - m] == i:
            y[i - m] = values[i]
            continue
        _find_shares(n, basis, factors, rows[i], shares[m])
        z[m] = values[i]
        m += 1
    for i in range(m):
        for k in range(n):
            z[i] -= shares[i, k] * y[k]
        for j in range(m):
            gram[i, j] = _dot(shares[i], shares[j]) + (1.0 if i == j else 0.0)
    ldl_factor(gram[:m, :m])
    ldl_solve(gram[:m, :m], z[:m])
    for k in range(n):
        for i in range(m):
            y[k] += shares[i, k] * z[i]
        for j in range(k):
            y[k] -= factors[k, j] * y[j]
        y[k] /= factors[k, k]
        for j in range(x.size):
            x[j] += y[k] * basis[k, j]
    for i in range(len(rows)):
        values[i] -= _dot(rows[i], x)
    return n


@kernel(types.boolean(MATRIX, f8, MATRIX), vectorized=True)
def above(rows, ratio, gram):
    """Whether all singular values are above this share of the largest, by G G^T less its square.

    The root of the sum of squares of the entries stands for the largest; `gram` is scratch.
    """
    n, total = len(rows), 0.0
    for i in range(n):
        for j in range(i + 1):
            gram[j, i] = _dot(rows[i], rows[j])  # its upper triangle is what counts
        total += gram[i, i]
    for i in range(n):
        gram[i, i] -= (ratio * ratio + ROUNDED * n) * total
    return math.isfinite(total) and ldl_factor(gram)

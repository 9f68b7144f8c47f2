"""Which rows of a matrix count, in the order in which they stand, and how large solutions for these can be."""

import math

from numba import types

from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, compiled, f8, i8, kernel, merged


@compiled
def _dot(x, y):
    total = 0.0
    for j in range(x.size):
        total += x[j] * y[j]
    return total


@merged
def first_rows(G, least, basis, factors, kept):
    """Put down the first rows that no rows before add up to, and return how many they are.

    Such a row keeps more than the share `least` of its length without its part in those before, by Gram and Schmidt's
    orthogonalisation, made twice. It is the combination of the rows of `basis`, of length 1, that a row of the lower
    triangle `factors` says; these two have as many rows as can be independent, and one more for scratch.
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
        for _ in range(2):
            for i in range(n_kept):
                part = _dot(basis[i], rest)
                if part != 0.0:
                    parts[i] += part
                    for j in range(rest.size):
                        rest[j] -= part * basis[i, j]
        square = _dot(rest, rest)
        if square > least**2 * _dot(G[k], G[k]):
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
        for k in range(n):
            shares[i, k] = _dot(basis[k], rows[order[n + i]])
        for k in range(n - 1, -1, -1):
            for j in range(k + 1, n):
                shares[i, k] -= factors[j, k] * shares[i, j]
            shares[i, k] /= factors[k, k]
    return True

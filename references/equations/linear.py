"""Compiled linear algebra of the references, independent of twoloop's."""

from typing import Any

import numpy as np
from numba import njit

from twoloop.kernels.compile.caches import kept_when_called

SINGULAR = 1e-13  # relative to the original entry, or to its row: smaller pivots count as zero

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


# a closure over callbacks: compiled when it is called, for its argument types, and read from the disk in later
# processes if callbacks and code are the same
kept = kept_when_called(**OPTIONS)


@kept  # called from Python, too
def cholesky(A, lost=0.0):  # type: ignore[no-untyped-def]
    """Overwrite the lower half of A with its Cholesky factor, with reciprocal pivots; return whether A is definite.

    A pivot of at most `lost` times its original value is set to zero with its column, so that `cholesky_solve` omits
    that unknown.
    """
    n, definite = A.shape[0], True
    for k in range(n):
        before = A[k, k]
        for j in range(k):
            A[k, k] -= A[k, j] * A[k, j]
        definite = definite and A[k, k] > lost * abs(before)
        if A[k, k] <= lost * abs(before):  # False for NaN, which is kept
            for i in range(k, n):
                A[i, k] = 0.0
            continue
        A[k, k] = 1.0 / np.sqrt(A[k, k])
        for i in range(k + 1, n):
            for j in range(k):
                A[i, k] -= A[i, j] * A[k, j]
            A[i, k] *= A[k, k]
    return definite


@njit(**OPTIONS)
def cholesky_solve(L, x):  # type: ignore[no-untyped-def]
    """Overwrite x with A^-1 x, for the factors of A."""
    n = x.size
    for i in range(n):
        for j in range(i):
            x[i] -= L[i, j] * x[j]
        x[i] *= L[i, i]
    for i in range(n - 1, -1, -1):
        x[i] *= L[i, i]
        for j in range(i):
            x[j] -= L[i, j] * x[i]


@njit(**OPTIONS)
def lu_factor(A, pivots):  # type: ignore[no-untyped-def]
    """Overwrite A with its LU factors, with scaled row exchanges of row k and row pivots[k].

    Return False if A is singular or has values that are not finite.
    """
    n, scale = A.shape[0], np.zeros(A.shape[0])
    for i in range(n):
        for j in range(n):
            scale[i] = max(scale[i], abs(A[i, j]))
    for k in range(n):
        pivot, largest = k, 0.0
        for i in range(k, n):
            if abs(A[i, k]) > largest * scale[i]:
                pivot, largest = i, abs(A[i, k]) / scale[i]
        if not SINGULAR < largest < np.inf:
            return False
        pivots[k], scale[pivot] = pivot, scale[k]
        if pivot != k:
            for j in range(n):
                moved = A[k, j]
                A[k, j] = A[pivot, j]
                A[pivot, j] = moved
        for i in range(k + 1, n):
            if A[i, k] != 0.0:
                A[i, k] /= A[k, k]
                for j in range(k + 1, n):
                    A[i, j] -= A[i, k] * A[k, j]
    return True


@njit(**OPTIONS)
def lu_solve(A, pivots, x):  # type: ignore[no-untyped-def]
    """Overwrite x with A^-1 x, for the factors of A."""
    n = x.size
    for k in range(n):
        x[k], x[pivots[k]] = x[pivots[k]], x[k]
    for k in range(n):
        for j in range(k):
            x[k] -= A[k, j] * x[j]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            x[k] -= A[k, j] * x[j]
        x[k] /= A[k, k]

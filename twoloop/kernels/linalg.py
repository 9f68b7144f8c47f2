"""Small dense factorisations, in place and without allocation."""

from twoloop.kernels.common import inlined


@inlined
def lu_factor(A, pivots):
    """LU factors of A with row exchanges, in place; returns min|u_kk| / max|u_kk| (0: singular)."""
    n = A.shape[0]
    smallest = 1e300
    largest = 0.0
    for k in range(n):
        p = k
        top = abs(A[k, k])
        for i in range(k + 1, n):
            if abs(A[i, k]) > top:
                top = abs(A[i, k])
                p = i
        pivots[k] = p
        if not top > 0.0:  # also true for NaN
            return 0.0
        smallest = min(smallest, top)
        largest = max(largest, top)
        if p != k:
            for j in range(n):
                A[k, j], A[p, j] = A[p, j], A[k, j]
        inverse = 1.0 / A[k, k]
        for i in range(k + 1, n):
            factor = A[i, k]
            if factor != 0.0:
                factor *= inverse
                A[i, k] = factor
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
    return smallest / largest if n > 0 else 1.0


@inlined
def lu_solve(A, pivots, x):
    """Solve with the factors of `lu_factor`; x is overwritten."""
    n = A.shape[0]
    for k in range(n):
        p = pivots[k]
        if p != k:
            x[k], x[p] = x[p], x[k]
    for i in range(1, n):
        total = x[i]
        for j in range(i):
            total -= A[i, j] * x[j]
        x[i] = total
    for i in range(n - 1, -1, -1):
        total = x[i]
        for j in range(i + 1, n):
            total -= A[i, j] * x[j]
        x[i] = total / A[i, i]


@inlined
def cholesky(A):
    """Lower Cholesky factor of A, in place (the upper part is left alone); False if A is not positive definite."""
    n = A.shape[0]
    for i in range(n):
        for j in range(i):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / A[j, j]
        total = A[i, i]
        for k in range(i):
            total -= A[i, k] * A[i, k]
        if not total > 0.0:
            return False
        A[i, i] = total**0.5
    return True


@inlined
def forward_substitute(L, x):
    """x becomes L^-1 x."""
    for i in range(x.size):
        total = x[i]
        for j in range(i):
            total -= L[i, j] * x[j]
        x[i] = total / L[i, i]


@inlined
def back_substitute(L, x):
    """x becomes L^-T x."""
    for i in range(x.size - 1, -1, -1):
        x[i] /= L[i, i]
        for j in range(i):
            x[j] -= L[i, j] * x[i]

"""Two integrators for the independent equations: SciPy's, and one in the extended precision of the processor."""

import numpy as np
from scipy.integrate import solve_ivp

COLUMNS = 9
DIVISIONS = 2 * np.arange(1, COLUMNS + 1)


def by_scipy(rate, y, end, times=None):
    """y at the end (or at times) by DOP853 at 1e-13."""
    times, one = ([end], True) if times is None else (times, False)
    options = {"t_eval": times, "rtol": 1e-13, "atol": 1e-14}
    start = np.array(y, dtype=float)
    solution = solve_ivp(lambda t, y: np.array(rate(t, y), dtype=float), (0.0, end), start, "DOP853", **options)
    assert solution.success, solution.message
    return solution.y[:, -1] if one else solution.y


def by_extrapolation(rate, y, end, n):
    """y at the end in extended precision: n steps of Gragg's extrapolation of the explicit midpoint rule, order 18."""
    y, H = np.array(y, dtype=np.longdouble), np.longdouble(end) / n
    for k in range(n):
        y = _step(rate, k * H, y, H)
    return y


def _step(rate, t, y, H):
    table, first = [], np.array(rate(t, y))
    for k, parts in enumerate(DIVISIONS):
        h = H / parts
        last, now = y, y + h * first
        for i in range(1, parts):
            last, now = now, last + 2 * h * np.array(rate(t + i * h, now))
        row = [(last + now + h * np.array(rate(t + H, now))) / 2]
        for j in range(k):
            row.append(row[j] + (row[j] - table[-1][j]) / ((np.longdouble(parts) / DIVISIONS[k - 1 - j]) ** 2 - 1))
        table.append(row)
    return table[-1][-1]


def solve(A, b):
    """Solution of a small linear system in the type of its entries, which numpy's solver would round."""
    A, b = np.array(A), np.array(b)
    if A.dtype == np.float64:
        return np.linalg.solve(A, b)
    n = len(b)
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(A[k:, k])))
        A[[k, pivot]], b[[k, pivot]] = A[[pivot, k]], b[[pivot, k]]
        factors = A[k + 1 :, k] / A[k, k]
        A[k + 1 :, k:] -= np.outer(factors, A[k, k:])
        b[k + 1 :] -= factors * b[k]
    for k in reversed(range(n)):
        b[k] = (b[k] - A[k, k + 1 :] @ b[k + 1 :]) / A[k, k]
    return b

"""Accelerations and multipliers of any ConstrainedSystem, compiled from its callbacks, for solvers in Python.

Eq. (6), M a + C_q^T lam = Q and C_q a = Q_d, is solved by the Schur complement S = C_q M^-1 C_q^T if M is positive
definite, and otherwise, as with Euler parameters, as a whole by Gaussian elimination with row exchanges. The compiled
functions are closures over the callbacks: solvers call from Python, where passing first-class functions as arguments,
as in twoloop's kernels, costs tens of microseconds per call. The linear algebra is independent of twoloop's.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher

from twoloop.kernels.compile.caches import compiled_when_called
from twoloop.kernels.data.indices import GIVEN
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

GAMMA_DIFFERENCE = 1e-3  # displacement over which C_q v + C_t is differenced, divided by max(1, |v|)
CONSTANT, DIAGONAL, SADDLE = 1, 2, 4  # flags of the mass matrix; SADDLE: not definite
SINGULAR = 1e-13  # relative to the original entry, or to its row: smaller pivots count as zero

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


# a closure over callbacks: compiled when it is called, for its argument types, and read from the disk in later
# processes if callbacks and code are the same
cached = compiled_when_called(**OPTIONS)


@cached  # called from Python, too
def cholesky(A, threshold=0.0):  # type: ignore[no-untyped-def]
    """Overwrite the lower half of A with its Cholesky factor, with reciprocal pivots; return whether A is definite.

    A pivot of at most `threshold` times its original value is set to zero with its column, so that `cholesky_solve`
    omits that unknown.
    """
    n, definite = A.shape[0], True
    for k in range(n):
        original = A[k, k]
        for j in range(k):
            A[k, k] -= A[k, j] * A[k, j]
        definite = definite and A[k, k] > threshold * abs(original)
        if A[k, k] <= threshold * abs(original):  # False for NaN, which is kept
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
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
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


class Equations:
    """The compiled eq. (6) of one system, with its workspaces and constants."""

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array):
        f = system.functions
        self.system = system
        self.accelerate = _accelerations(*f[:5], compiled_gamma(system))
        mass = system.mass(t0, q0)
        self.known = CONSTANT if system.constant_mass else 0
        if self.known and np.count_nonzero(mass - np.diag(np.diagonal(mass))) == 0:
            self.known |= DIAGONAL
        self.factors = np.ascontiguousarray(mass)
        if not cholesky(self.factors, SINGULAR):
            self.factors, self.known = np.ascontiguousarray(mass.copy()), self.known & CONSTANT | SADDLE
            if not saddle_solve(self.factors, system.jacobian(t0, q0), np.zeros(system.n_q), np.zeros(system.n_c)):
                raise ValueError(
                    f"mass of {system.name!r} must be positive definite on the velocities that the constraints allow, "
                    f"and the constraints independent, where it is not positive definite itself; at t = {t0!r} the "
                    "matrix of eq. (6) is singular. Give the coordinates mass or constraints, or leave them out"
                )

    def at_points(self, t: Array, states: Array, alpha: float = 0.0) -> tuple[Array, Array]:
        """Return accelerations and multipliers at states (2 n_q, n_t), with Baumgarte's terms if alpha > 0.

        NaN where the matrix is singular.
        """
        rows, n, p = np.ascontiguousarray(states.T), self.system.n_q, self.system.functions.p
        a, lam = np.empty((t.size, n)), np.empty((t.size, self.system.n_c))
        for k in range(t.size):
            q, v = rows[k, :n], rows[k, n:]
            if not self.accelerate(t[k], q, v, alpha, p, self.factors, self.known, a[k], lam[k]):
                a[k], lam[k] = np.nan, np.nan
        return a.T, lam.T


def compiled_gamma(system: ConstrainedSystem) -> Callable[..., None]:
    """Return (t, q, v, p, Qd) -> None: the callback if there is one, otherwise differences; Qd is initially zero."""
    f = system.functions
    return f.gamma if f.flags[GIVEN["gamma"]] else _gamma_by_differences(f.jacobian, f.constraint_rate)


@lru_cache(maxsize=64)
def _gamma_by_differences(jacobian: Dispatcher, constraint_rate: Dispatcher) -> Callable[..., None]:
    """Q_d = -d/de [C_q v + C_t](t + e, q + e v), by central differences of order 4."""

    @cached
    def gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
        speed = 1.0
        for i in range(v.size):
            speed = max(speed, abs(v[i]))
        e = GAMMA_DIFFERENCE / speed
        Cq, Ct, displaced = np.zeros((Qd.size, q.size)), np.zeros(Qd.size), np.zeros(q.size)
        for j in range(4):
            shift = (-2.0, -1.0, 1.0, 2.0)[j] * e
            weight = (-1.0, 8.0, -8.0, 1.0)[j] / (12.0 * e)
            for i in range(q.size):
                displaced[i] = q[i] + shift * v[i]
            Cq[:, :] = 0.0
            Ct[:] = 0.0
            jacobian(t + shift, displaced, p, Cq)
            constraint_rate(t + shift, displaced, p, Ct)
            for k in range(Qd.size):
                Qd[k] += weight * Ct[k]
                for i in range(v.size):
                    Qd[k] += weight * Cq[k, i] * v[i]

    return gamma  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _accelerations(*callbacks: Callable[..., Any]) -> Callable[..., Any]:
    """Return (t, q, v, alpha, p, factors, mass_flags, a, lam) -> success: eq. (6), Baumgarte's terms if alpha > 0."""
    mass, force, constraint, jacobian, constraint_rate, gamma = callbacks
    mass_at = matrix_of(mass)

    @cached
    def accelerate(t, q, v, alpha, p, factors, mass_flags, a, lam):  # type: ignore[no-untyped-def]
        n, m = q.size, lam.size
        Cq = np.zeros((m, n))
        L, definite = mass_at(t, q, p, factors, mass_flags)
        jacobian(t, q, p, Cq)
        lam[:] = 0.0
        gamma(t, q, v, p, lam)
        if alpha > 0.0:
            C, Ct = np.zeros(m), np.zeros(m)
            constraint(t, q, p, C)
            constraint_rate(t, q, p, Ct)
            for i in range(m):
                for j in range(n):
                    Ct[i] += Cq[i, j] * v[j]
                lam[i] -= 2.0 * alpha * Ct[i] + alpha * alpha * C[i]
        a[:] = 0.0
        force(t, q, v, p, a)
        return solve_for(L, definite, mass_flags, Cq, a, lam)

    return accelerate  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def matrix_of(mass: Dispatcher) -> Callable[..., Any]:
    """Return (t, q, p, factors, mass_flags) -> the factors of M and True; M and False if it is not definite."""

    @cached
    def mass_at(t, q, p, factors, mass_flags):  # type: ignore[no-untyped-def]
        definite = not mass_flags & SADDLE
        if mass_flags & CONSTANT:
            return factors, definite
        M = np.zeros((q.size, q.size))
        mass(t, q, p, M)
        if definite and not cholesky(M, SINGULAR):
            definite = False
            M[:, :] = 0.0
            mass(t, q, p, M)
        return M, definite

    return mass_at  # type: ignore[no-any-return]


@cached  # called from Python, too
def saddle_solve(M, Cq, a, lam):  # type: ignore[no-untyped-def]
    """Solve eq. (6) as a whole; Q in a is overwritten by the accelerations, Q_d in lam by the multipliers.

    Returns False where the matrix is singular or has values that are not finite.
    """
    m, n = Cq.shape
    K, x, pivots = np.zeros((n + m, n + m)), np.empty(n + m), np.zeros(n + m, dtype=np.int64)
    for i in range(n):  # elementwise: slice assignment doubles the compile time
        x[i] = a[i]
        for j in range(n):
            K[i, j] = M[i, j]
        for k in range(m):
            K[n + k, i] = K[i, n + k] = Cq[k, i]
    for k in range(m):
        x[n + k] = lam[k]
    if not lu_factor(K, pivots):
        return False
    lu_solve(K, pivots, x)
    for i in range(n):
        a[i] = x[i]
    for k in range(m):
        lam[k] = x[n + k]
    return True


@njit(**OPTIONS)
def times_inverse(L, mass_flags, x):  # type: ignore[no-untyped-def]
    """Overwrite x with M^-1 x."""
    if mass_flags & DIAGONAL:
        for j in range(x.size):
            x[j] *= L[j, j] * L[j, j]
    else:
        cholesky_solve(L, x)


@njit(**OPTIONS)
def solve_for(L, definite, mass_flags, Cq, a, lam):  # type: ignore[no-untyped-def]
    """Solve eq. (6) by eqs. (7) and (8); Q in a is overwritten by the accelerations, Q_d in lam by the multipliers.

    `L`: the factors of M, or M itself if it is not definite. Return False if the matrix is singular.
    """
    if not definite:
        return saddle_solve(L, Cq, a, lam)
    m, n = Cq.shape
    S, W, x = np.zeros((m, m)), np.empty((n, m)), np.empty(n)
    for j in range(n):
        for i in range(m):
            W[j, i] = Cq[i, j]
    for i in range(m):
        for j in range(n):
            x[j] = Cq[i, j]
        times_inverse(L, mass_flags, x)
        for j in range(n):
            if x[j] != 0.0:
                for k in range(i, m):
                    S[k, i] += x[j] * W[j, k]
    if not cholesky(S):
        return False
    for j in range(n):
        x[j] = a[j]
    times_inverse(L, mass_flags, x)
    for i in range(m):
        lam[i] = -lam[i]
        for j in range(n):
            lam[i] += Cq[i, j] * x[j]
    cholesky_solve(S, lam)
    for i in range(m):
        for j in range(n):
            a[j] -= Cq[i, j] * lam[i]
    times_inverse(L, mass_flags, a)
    return True

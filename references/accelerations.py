"""Accelerations and multipliers of any ConstrainedSystem, compiled from its callbacks: what several references need.

Eq. (6), M a + C_q^T lam = Q and C_q a = Q_d, is solved by the Schur complement S = C_q M^-1 C_q^T. What is compiled are
closures over the callbacks, one for each set of them: solvers call from Python, where each first-class function that
is an argument, as in twoloop's kernels, costs tens of microseconds a call.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import ArrayLike, NDArray

from references.driver import check_system
from twoloop.bounds import check_bounds
from twoloop.checks import check_real
from twoloop.kernels.common import GAMMA_GIVEN
from twoloop.kernels.linalg import ldl_factor, ldl_solve
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

GAMMA_DIFFERENCE = 1e-3  # displacement over which C_q v + C_t is differenced, divided by max(1, |v|)

CONSTANT, DIAGONAL = 1, 2  # bits of what is known of the mass matrix

OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


def accelerations(system: ConstrainedSystem, t: ArrayLike, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
    """Accelerations and multipliers of eq. (6) at given states.

    Parameters
    ----------
    system : ConstrainedSystem
    t : array_like (n_t,)
        Times, s.
    q, v : array_like (n_q, n_t)
        Coordinates and velocities, one column an instant.

    Returns
    -------
    a : ndarray (n_q, n_t)
    lam : ndarray (n_c, n_t)
        Of M a + C_q^T lam = Q and C_q a = Q_d; NaN where the matrix is singular.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong.
    """
    check_system(system)
    t = check_real("t", t)
    states = np.concatenate([check_real("q", q), check_real("v", v)])
    if t.ndim != 1 or states.shape != (2 * system.n_q, t.size):
        raise ValueError(
            f"q and v must have a column of {system.n_q} for each of the {t.size} times; together they have shape "
            f"{states.shape}"
        )
    check_bounds(system, float(t[0]), *np.split(states[:, 0], 2))
    return Equations(system, float(t[0]), states[: system.n_q, 0]).at_points(t, states)


class Equations:
    """The compiled eq. (6) of one system, with what it takes besides t, q and v."""

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array):
        f = system.functions
        self.system = system
        self.accelerate = _accelerations(*f[:5], compiled_gamma(system))
        mass = system.mass(t0, q0)
        self.known = CONSTANT if system.constant_mass else 0
        if self.known and np.count_nonzero(mass - np.diag(np.diagonal(mass))) == 0:
            self.known |= DIAGONAL
        self.factors = np.ascontiguousarray(mass)
        if not factor(self.factors):
            raise ValueError(f"mass of {system.name!r} must be positive definite; at t = {t0!r} it is not")

    def at_points(self, t: Array, states: Array, alpha: float = 0.0) -> tuple[Array, Array]:
        """Accelerations and multipliers at states (2 n_q, n_t), with Baumgarte's terms when alpha > 0."""
        rows = np.ascontiguousarray(states.T)
        n_c, p = self.system.n_c, self.system.functions.p
        a, lam = _at_points(self.accelerate)(t, rows, n_c, alpha, p, self.factors, self.known)
        return a.T, lam.T


def compiled_gamma(system: ConstrainedSystem) -> Callable[..., None]:
    """(t, q, v, p, Qd) -> None: the callback where the system has one, else differences; Qd arrives full of zeros."""
    f = system.functions
    return f.gamma if f.flags[GAMMA_GIVEN] else _gamma_by_differences(f.jacobian, f.constraint_rate)


@lru_cache(maxsize=64)
def _gamma_by_differences(jacobian: Dispatcher, constraint_rate: Dispatcher) -> Callable[..., None]:
    """Q_d = -d/de [C_q v + C_t](t + e, q + e v), by central differences of order 4."""

    @njit(**OPTIONS)
    def gamma(t, q, v, p, Qd):  # type: ignore[no-untyped-def]
        speed = 1.0
        for i in range(v.size):
            speed = max(speed, abs(v[i]))
        e = GAMMA_DIFFERENCE / speed
        Cq, Ct, moved = np.zeros((Qd.size, q.size)), np.zeros(Qd.size), np.zeros(q.size)
        for j in range(4):
            shift = (-2.0, -1.0, 1.0, 2.0)[j] * e
            weight = (-1.0, 8.0, -8.0, 1.0)[j] / (12.0 * e)
            for i in range(q.size):
                moved[i] = q[i] + shift * v[i]
            Cq[:, :] = 0.0
            Ct[:] = 0.0
            jacobian(t + shift, moved, p, Cq)
            constraint_rate(t + shift, moved, p, Ct)
            for k in range(Qd.size):
                Qd[k] += weight * Ct[k]
                for i in range(v.size):
                    Qd[k] += weight * Cq[k, i] * v[i]

    return gamma  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _accelerations(
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    gamma: Callable[..., None],
) -> Callable[..., Any]:
    """(t, q, v, alpha, p, factors, known, a, lam) -> success: eqs. (6)-(8), with Baumgarte's terms when alpha > 0."""

    @njit(**OPTIONS)
    def accelerate(t, q, v, alpha, p, factors, known, a, lam):  # type: ignore[no-untyped-def]
        n, m = q.size, lam.size
        L, Cq = factors, np.zeros((m, n))
        if not known & CONSTANT:
            L = np.zeros((n, n))
            mass(t, q, p, L)
            if not factor(L):
                return False
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
        return _eliminate(L, known, Cq, a, lam)

    return accelerate  # type: ignore[no-any-return]


@lru_cache(maxsize=64)
def _at_points(accelerate: Callable[..., Any]) -> Callable[..., Any]:
    """(t, states as rows, n_c, alpha, p, factors, known) -> a, lam as rows."""

    @njit(**OPTIONS)
    def at_points(t, states, m, alpha, p, factors, known):  # type: ignore[no-untyped-def]
        n = states.shape[1] // 2
        a, lam = np.empty((t.size, n)), np.empty((t.size, m))
        for k in range(t.size):
            q, v = states[k, :n].copy(), states[k, n:].copy()
            if not accelerate(t[k], q, v, alpha, p, factors, known, a[k], lam[k]):
                a[k, :] = np.nan
                lam[k, :] = np.nan
        return a, lam

    return at_points  # type: ignore[no-any-return]


@njit(**OPTIONS)
def factor(A):  # type: ignore[no-untyped-def]
    """`ldl_factor` as a function that Python and closures can call."""
    return ldl_factor(A)


@njit(**OPTIONS)
def times_inverse(L, known, x):  # type: ignore[no-untyped-def]
    """x becomes M^-1 x."""
    if known & DIAGONAL:
        for j in range(x.size):
            x[j] *= L[j, j]
    else:
        ldl_solve(L, x)


@njit(**OPTIONS)
def schur_factors(L, known, Cq):  # type: ignore[no-untyped-def]
    """Factors of S = C_q M^-1 C_q^T, and whether S is positive definite."""
    m, n = Cq.shape
    S, W, x = np.zeros((m, m)), np.empty((n, m)), np.empty(n)
    for j in range(n):
        for i in range(m):
            W[j, i] = Cq[i, j]
    for i in range(m):
        for j in range(n):
            x[j] = Cq[i, j]
        times_inverse(L, known, x)
        for j in range(n):
            if x[j] != 0.0:
                for k in range(i, m):
                    S[i, k] += x[j] * W[j, k]
    return S, ldl_factor(S)


@njit(**OPTIONS)
def _eliminate(L, known, Cq, a, lam):  # type: ignore[no-untyped-def]
    """Eqs. (7) and (8): a holds Q and becomes the accelerations, lam holds Q_d and becomes the multipliers."""
    m, n = Cq.shape
    S, definite = schur_factors(L, known, Cq)
    if not definite:
        return False
    x = a.copy()
    times_inverse(L, known, x)
    for i in range(m):
        total = -lam[i]
        for j in range(n):
            total += Cq[i, j] * x[j]
        lam[i] = total
    ldl_solve(S, lam)
    for i in range(m):
        for j in range(n):
            a[j] -= Cq[i, j] * lam[i]
    times_inverse(L, known, a)
    return True

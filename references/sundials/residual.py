"""IDA's residual and its derivatives as machine code, from the callbacks of a ConstrainedSystem.

IDA solves F(t, y, y') = 0. The index-3 equations are reduced to index 1 in one of two ways (`FORMS`). "index1" has the
unknowns q, v, lam with q' = v, M v' + C_q^T lam = Q, C_q v' = Q_d, and drifts off the constraints. "stabilised", by
Gear, Gupta and Leimkuhler (1985), has the multipliers as time derivatives of further unknowns Lam, Mu: q' = v - C_q^T
Mu', M v' + C_q^T Lam' = Q, C = 0, C_q v + C_t = 0. Rows A v + b = 0 follow C_q v + C_t = 0; their Mu is zero.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from references.driver import Task
from references.equations.accelerations import cached, compiled_gamma
from references.equations.rows import accelerations
from twoloop.kernels.compile.callbacks import zero_callback
from twoloop.kernels.data.indices import FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN
from twoloop.problem.problem import Array

FORMS = {
    "index1": "index 1: C_q v' = Q_d; multipliers out of the error test (atol 1e12)",
    "stabilised": "GGL, integrated multipliers: C = 0 and C_q v + C_t = 0; multipliers' integrals in the error test",
}
NOT_TESTED = 1e12  # absolute tolerance that excludes an unknown from IDA's error and convergence tests
ALL = 10**9  # all rows belong to C: there are no rows A v + b = 0
DIFFERENCE = 1e-7  # step of finite differences of the residual, relative to max(1, |value|)


class Parts(NamedTuple):
    """Functions of a system from which the residual is compiled; sizes follow from M and C_q.

    `positions`: number of rows of C. `tangent`: dQ/dq, if the force need not be differenced.
    """

    index1: bool
    mass: Dispatcher
    force: Dispatcher
    constraint: Dispatcher
    jacobian: Dispatcher
    constraint_rate: Dispatcher
    gamma: Callable[..., None]
    tangent: Dispatcher | None
    positions: int
    constant_mass: bool


class Implicit:
    """F(t, y, y') = 0 of a task in one of the `FORMS`.

    `start` (2, size) are the initial unknowns and derivatives, with accelerations and multipliers from eq. (6).
    `residual` and `matrix` are compiled from `parts`, see `residual_at` and `iteration_matrix_at`; their arguments
    `space` are p, M, which is kept if it is constant, C_q, dQ/dq, and workspace.
    """

    def __init__(self, task: Task, form: str):
        system, self.index1 = task.system, form == "index1"
        f, n, m = system.functions, system.n_q, system.n_c
        exact = f.flags[FORCE_BY_Q_GIVEN] == 1 and f.flags[FORCE_BY_V_GIVEN] == 0
        gamma = compiled_gamma(system) if self.index1 else f.gamma
        functions = f.mass, f.force, f.constraint, f.jacobian, f.constraint_rate, gamma, f.force_by_q if exact else None
        self.parts = Parts(self.index1, *functions, task.n_c if m > task.n_c else ALL, system.constant_mass)
        self.residual, self.matrix = residual_at(self.parts), iteration_matrix_at(self.parts)
        self.sizes = n, m
        a, lam = (array[:, 0] for array in accelerations(system, np.array([task.t0]), task.y0[:, None]))
        zeros = np.zeros(m)
        y, yp = ([lam], [zeros]) if self.index1 else ([zeros, zeros], [lam, zeros])
        self.start = np.array([np.concatenate([task.y0, *y]), np.concatenate([task.v0, a, *yp])])
        mass = np.array(system.mass(task.t0, task.q0))
        self.space = f.p, mass, np.zeros((m, n)), np.zeros((n, n)), *np.zeros((3, self.start.shape[1]))

    def columns(self, y: Array, yp: Array) -> Array:
        """Return rows [q v a lam] (3 n_q + n_c, n_t) for unknowns and derivatives (size, n_t)."""
        n, m = self.sizes
        return np.concatenate([y[: 2 * n], yp[n : 2 * n], (y if self.index1 else yp)[2 * n : 2 * n + m]])


@lru_cache(maxsize=64)
def residual_at(parts: Parts) -> Callable[..., None]:
    """Return (t, y, y', p, M, Cq, res) -> None: the residual; M and C_q are evaluated at q on return."""
    index1, mass, force, constraint, jacobian, constraint_rate, gamma, _, positions, constant_mass = parts

    @cached
    def residual(t, y, yp, p, M, Cq, res):  # type: ignore[no-untyped-def]
        m, n = Cq.shape
        q, v, a = y[:n], y[n : 2 * n], yp[n : 2 * n]
        if not constant_mass:
            M[:, :] = 0.0
            mass(t, q, p, M)
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        res[:] = 0.0
        force(t, q, v, p, res[n : 2 * n])
        if index1:
            gamma(t, q, v, p, res[2 * n :])
        else:
            constraint(t, q, p, res[2 * n : 2 * n + m])
            constraint_rate(t, q, p, res[2 * n + m :])
        for i in range(n):
            total = -res[n + i]
            for j in range(n):
                total += M[i, j] * a[j]
            res[n + i] = total
            res[i] = yp[i] - v[i]
        for k in range(m):
            if index1:
                lam, mu, row = y[2 * n + k], 0.0, 2 * n + k
                rate = -res[row]
            else:
                lam, mu, row = yp[2 * n + k], yp[2 * n + m + k], 2 * n + m + k
                rate = res[row]
            for i in range(n):
                res[i] += Cq[k, i] * mu
                res[n + i] += Cq[k, i] * lam
                rate += Cq[k, i] * (a[i] if index1 else v[i])
            res[row] = rate
        if not index1:
            for k in range(positions, m):
                res[2 * n + k] = y[2 * n + m + k]

    return residual  # type: ignore[no-any-return]


@njit
def _no_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    """Replace the force in differences where its exact tangent is used."""


@lru_cache(maxsize=64)
def iteration_matrix_at(parts: Parts) -> Callable[..., None]:
    """Return (t, cj, y, y', p, M, Cq, K, moved, here, there, J) -> None: dF/dy + cj dF/dy', J[j] its column j.

    J is initially zero. With a tangent, the residual without the force is differenced.
    """
    index1, mass, force, _, jacobian, _, gamma, tangent, positions, constant_mass = parts
    exact = tangent is not None
    add_tangent = zero_callback("force_by_q") if tangent is None else tangent
    differenced = residual_at(parts._replace(force=_no_force if exact else force, tangent=None))
    by_velocities = index1 or not exact

    @cached
    def of_velocities(t, q, v, p, m, out):  # type: ignore[no-untyped-def]
        n = q.size
        out[: n + m] = 0.0
        if not exact:
            force(t, q, v, p, out[:n])
        if index1:
            gamma(t, q, v, p, out[n : n + m])

    @cached
    def iteration_matrix(t, cj, y, yp, p, M, Cq, K, displaced, residual_here, residual_displaced, J):  # type: ignore[no-untyped-def]
        m, n = Cq.shape
        for k in range(y.size):  # numba compiles `moved[:] = y` for two seconds
            displaced[k] = y[k]
        q, v = displaced[:n], displaced[n : 2 * n]
        if not constant_mass:
            M[:, :] = 0.0
            mass(t, q, p, M)
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        for j in range(n):  # columns of v and of the multipliers
            J[n + j, j] = -1.0
            for i in range(n):
                J[n + j, n + i] = cj * M[i, j]
            for k in range(m):
                if index1:
                    J[n + j, 2 * n + k] = cj * Cq[k, j]
                    J[2 * n + k, n + j] = Cq[k, j]
                else:
                    J[n + j, 2 * n + m + k] = Cq[k, j]
                    J[2 * n + k, n + j] = J[2 * n + m + k, j] = cj * Cq[k, j]
                    J[j, 2 * n + k] = Cq[k, j] if k < positions else 0.0
        if not index1:
            for k in range(positions, m):
                J[2 * n + m + k, 2 * n + k] = 1.0
        if by_velocities:
            of_velocities(t, q, v, p, m, residual_here)
            for j in range(n):
                step = DIFFERENCE * max(1.0, abs(y[n + j]))
                v[j] = y[n + j] + step
                of_velocities(t, q, v, p, m, residual_displaced)
                v[j] = y[n + j]
                for i in range(n + m if index1 else n):
                    J[n + j, n + i] -= (residual_displaced[i] - residual_here[i]) / step
        differenced(t, displaced, yp, p, M, Cq, residual_here)
        for j in range(n):  # columns of q
            step = DIFFERENCE * max(1.0, abs(y[j]))
            q[j] = y[j] + step
            differenced(t, displaced, yp, p, M, Cq, residual_displaced)
            q[j] = y[j]
            for i in range(2 * n):
                J[j, i] = (residual_displaced[i] - residual_here[i]) / step
            for i in range(2 * n if index1 else 2 * n + m, y.size):  # C_q is above
                J[j, i] = (residual_displaced[i] - residual_here[i]) / step
            J[j, j] += cj
        if exact:
            K[:, :] = 0.0
            add_tangent(t, q, v, p, K)
            for j in range(n):
                for i in range(n):
                    J[j, n + i] -= K[i, j]

    return iteration_matrix  # type: ignore[no-any-return]


SHIFT = 1e-3  # of a state beside the start, where no entry is zero by chance


def band_of(form: Implicit) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Return an order of the unknowns, and how many diagonals the matrix then has below and above the main one.

    Positions and velocities are by coordinate, each multiplier ahead of the first coordinate of its row. Where dF/dy +
    cj dF/dy' has entries is seen beside the start.
    """
    y, yp = form.start + SHIFT * np.random.default_rng(0).uniform(0.5, 1.0, form.start.shape)
    columns = np.zeros((y.size, y.size))
    form.matrix(0.0, 1.0, y, yp, form.space[0], *(array.copy() for array in form.space[1:]), columns)
    n, m = form.sizes
    forces = columns[2 * n : 2 * n + m, n : 2 * n]  # C_q^T Lam in the rows of the forces
    first = [min(np.flatnonzero(column), default=n) for column in forces]
    place = np.concatenate([first, first, np.arange(n), np.arange(n)])
    order = np.roll(np.arange(place.size), 2 * m)[np.argsort(place, kind="stable")]
    column, row = np.nonzero(columns[np.ix_(order, order)])
    return order, (int((row - column).max()), int((column - row).max()))

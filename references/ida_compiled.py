"""IDA's residual and Jacobian as machine code, from the callbacks of a ConstrainedSystem, for `references.ida_c`."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types
from numba.core.dispatcher import Dispatcher

from references.ida_options import ALL, no_force
from references.sundials import library
from twoloop.callbacks import stand_in

DIFFERENCE = 1e-7  # displacement for the derivatives of the residual, relative to max(1, |value|)

RAISED = -1  # what a callback returns that IDA shall not call again

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}


@lru_cache(maxsize=64)
def compiled_for_ida(
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    n: int,
    m: int,
    n_p: int,
    constant_mass: bool,
    tangent: Dispatcher | None,
    positions: int,
) -> tuple[Any, Any, int]:
    """IDA's residual and Jacobian functions, and the number of floats that their user data must hold.

    The user data are [p, M, C_q, dQ/dq, y displaced, residual, residual at y displaced]; a constant M is there from the
    start. The sizes are constants of the machine code.
    """
    size = 2 * (n + m)
    ends = np.cumsum([n_p, n * n, m * n, n * n, size, size, size]).tolist()
    after_p, after_M, after_Cq, after_K, after_y, after_here, n_memory = ends
    array_of = library().N_VGetArrayPointer
    matrix_of = library().SUNDenseMatrix_Data
    functions = mass, force, constraint, jacobian, constraint_rate
    residual = residual_at(*functions, n, m, constant_mass, positions)
    iteration_matrix = iteration_matrix_at(*functions, n, m, constant_mass, tangent, positions)

    @njit(**_OPTIONS)
    def vector(pointer):  # type: ignore[no-untyped-def]
        return carray(array_of(pointer), (size,))

    @njit(**_OPTIONS)
    def space(pointer):  # type: ignore[no-untyped-def]
        memory = carray(pointer, (n_memory,), np.float64)
        M, Cq = memory[after_p:after_M].reshape((n, n)), memory[after_M:after_Cq].reshape((m, n))
        K = memory[after_Cq:after_K].reshape((n, n))
        return memory[:n_p], M, Cq, K, memory[after_K:after_y], memory[after_y:after_here], memory[after_here:]

    pointer = types.voidptr

    @cfunc(types.int32(types.float64, pointer, pointer, pointer, pointer), **_OPTIONS)
    def residual_of_ida(t, y, yp, res, memory):  # type: ignore[no-untyped-def]
        p, M, Cq, _, _, _, _ = space(memory)
        try:
            residual(t, vector(y), vector(yp), p, M, Cq, vector(res))
        except Exception:
            return RAISED
        return 0

    @cfunc(types.int32(types.float64, types.float64, *[pointer] * 8), **_OPTIONS)
    def jacobian_of_ida(t, cj, y, yp, res, J, memory, work1, work2, work3):  # type: ignore[no-untyped-def]
        p, M, Cq, K, moved, here, there = space(memory)
        columns = carray(matrix_of(J), (size, size))
        try:
            iteration_matrix(t, cj, vector(y), vector(yp), p, M, Cq, K, moved, here, there, columns)
        except Exception:
            return RAISED
        return 0

    return residual_of_ida, jacobian_of_ida, n_memory


def residual_at(
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    n: int,
    m: int,
    constant_mass: bool,
    positions: int = ALL,
) -> Callable[..., None]:
    """(t, y, y', p, M, Cq, res) -> None: the residual at y = [q, v, Lam, Mu]; M and C_q are left as they are at q.

    `positions`: how many rows are of C; those below are of A v + b = 0, and Mu of these is zero.
    """

    @njit(**_OPTIONS)
    def residual(t, y, yp, p, M, Cq, res):  # type: ignore[no-untyped-def]
        q, v = y[:n], y[n : 2 * n]
        if not constant_mass:
            M[:, :] = 0.0
            mass(t, q, p, M)
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        res[:] = 0.0
        force(t, q, v, p, res[n : 2 * n])
        constraint(t, q, p, res[2 * n : 2 * n + m])
        constraint_rate(t, q, p, res[2 * n + m :])
        for i in range(n):
            total = -res[n + i]
            for j in range(n):
                total += M[i, j] * yp[n + j]
            res[n + i] = total
            res[i] = yp[i] - v[i]
        for k in range(m):
            lam, mu, rate = yp[2 * n + k], yp[2 * n + m + k], res[2 * n + m + k]
            for i in range(n):
                res[i] += Cq[k, i] * mu
                res[n + i] += Cq[k, i] * lam
                rate += Cq[k, i] * v[i]
            res[2 * n + m + k] = rate
        for k in range(positions, m):
            res[2 * n + k] = y[2 * n + m + k]

    return residual  # type: ignore[no-any-return]


def iteration_matrix_at(
    mass: Dispatcher,
    force: Dispatcher,
    constraint: Dispatcher,
    jacobian: Dispatcher,
    constraint_rate: Dispatcher,
    n: int,
    m: int,
    constant_mass: bool,
    tangent: Dispatcher | None,
    positions: int = ALL,
) -> Callable[..., None]:
    """(t, cj, y, y', p, M, Cq, K, moved, here, there, J) -> None: dF/dy + cj dF/dy', J[j] its column j.

    IDA zeroes J. With a tangent, what is differenced is the residual without the force.
    """
    exact = tangent is not None
    add_tangent = stand_in("force_by_q") if tangent is None else tangent
    differenced = residual_at(
        mass, no_force if exact else force, constraint, jacobian, constraint_rate, n, m, constant_mass, positions
    )

    @njit(**_OPTIONS)
    def iteration_matrix(t, cj, y, yp, p, M, Cq, K, moved, here, there, J):  # type: ignore[no-untyped-def]
        moved[:] = y
        q, v, here_Q, there_Q = moved[:n], moved[n : 2 * n], here[:n], there[:n]
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
                J[n + j, 2 * n + m + k] = Cq[k, j]
                J[2 * n + k, n + j] = cj * Cq[k, j]
                J[2 * n + m + k, j] = cj * Cq[k, j]
                J[j, 2 * n + k] = Cq[k, j] if k < positions else 0.0
        for k in range(positions, m):
            J[2 * n + m + k, 2 * n + k] = 1.0
        if not exact:
            here_Q[:] = 0.0
            force(t, q, v, p, here_Q)
            for j in range(n):
                step = DIFFERENCE * max(1.0, abs(y[n + j]))
                v[j] = y[n + j] + step
                there_Q[:] = 0.0
                force(t, q, v, p, there_Q)
                v[j] = y[n + j]
                for i in range(n):
                    J[n + j, n + i] -= (there_Q[i] - here_Q[i]) / step
        differenced(t, moved, yp, p, M, Cq, here)
        for j in range(n):  # columns of q
            step = DIFFERENCE * max(1.0, abs(y[j]))
            q[j] = y[j] + step
            differenced(t, moved, yp, p, M, Cq, there)
            q[j] = y[j]
            for i in range(2 * n):
                J[j, i] = (there[i] - here[i]) / step
            for i in range(2 * n + m, 2 * n + 2 * m):
                J[j, i] = (there[i] - here[i]) / step
            J[j, j] += cj
        if exact:
            K[:, :] = 0.0
            add_tangent(t, q, v, p, K)
            for j in range(n):
                for i in range(n):
                    J[j, n + i] -= K[i, j]

    return iteration_matrix  # type: ignore[no-any-return]

"""CVODE's projection onto C = 0 and C_q v + C_t = 0 as machine code, for `references.sundials.cvode_c`."""

import ctypes
from functools import lru_cache
from typing import Any

import numpy as np
from numba import carray, cfunc, njit, types
from numba.core.dispatcher import Dispatcher

from references.equations.linear import SINGULAR, cholesky, cholesky_solve
from references.sundials.library import REALS, library
from references.sundials.loop import RAISED

MOST_ITERATIONS = 10  # Newton's method usually needs one or two
AGAIN = 1  # return value of a failed projection, which makes CVODE reduce the step


@lru_cache(maxsize=64)
def projection_for_cvode(
    constraint: Dispatcher, jacobian: Dispatcher, constraint_rate: Dispatcher, n: int, m: int, n_p: int
) -> tuple[Any, int]:
    """Return CVODE's projection function, and the number of floats in its user data.

    Positions are projected onto C = 0 by minimum-norm Newton corrections until one is below CVODE's bound in its norm,
    then velocities onto C_q v + C_t = 0; the error estimate is projected onto the tangent space, as in SUNDIALS'
    pendulum example. The user data are [p, rtol, atol, work]; the sizes are constants of the machine code.
    """
    after_p, after_tol, after_Cq, after_S, after_r, n_memory = np.cumsum([n_p, 2, m * n, m * m, m, n]).tolist()
    array_of, size = library().N_VGetArrayPointer, 2 * n
    # the same function of an integer, which can be compared with 0, the address of no vector
    array_at = ctypes.CFUNCTYPE(REALS, ctypes.c_ssize_t)(ctypes.cast(array_of, ctypes.c_void_p).value or 0)

    @njit(error_model="numpy")
    def factors(t, q, p, Cq, S):  # type: ignore[no-untyped-def]
        """Factorise C_q C_q^T at q in the lower half of S; zero in the columns of redundant rows."""
        Cq[:, :] = 0.0
        jacobian(t, q, p, Cq)
        for i in range(m):
            for k in range(i + 1):
                S[i, k] = 0.0
                for j in range(n):
                    S[i, k] += Cq[i, j] * Cq[k, j]
        cholesky(S, SINGULAR)

    @njit(error_model="numpy")
    def shortest(Cq, S, r, x):  # type: ignore[no-untyped-def]
        """Compute the minimum-norm x (n,) with C_q x = r; destroys r."""
        cholesky_solve(S, r)
        x[:] = 0.0
        for i in range(m):
            for j in range(n):
                x[j] += Cq[i, j] * r[i]

    @njit(error_model="numpy")
    def remove(Cq, S, r, x, from_v):  # type: ignore[no-untyped-def]
        """Project a velocity onto the tangent space; r contains C_t, or zeros."""
        for i in range(m):
            for j in range(n):
                r[i] += Cq[i, j] * from_v[j]
        shortest(Cq, S, r, x)
        for j in range(n):
            from_v[j] -= x[j]

    pointer = types.voidptr

    @cfunc(types.int32(types.float64, pointer, pointer, types.float64, types.intp, pointer), error_model="numpy")
    def projection(t, y, corr, bound, err, memory):  # type: ignore[no-untyped-def]
        given, state = carray(array_of(y), (size,)), carray(array_of(corr), (size,))
        data = carray(memory, (n_memory,), np.float64)
        p, rtol, atol = data[:after_p], data[after_p], data[after_p + 1]
        Cq, S = data[after_tol:after_Cq].reshape((m, n)), data[after_Cq:after_S].reshape((m, m))
        r, x = data[after_S:after_r], data[after_r:]
        for k in range(size):  # elementwise: slice assignment doubles the compile time
            state[k] = given[k]
        q, v = state[:n], state[n:]
        try:
            for iteration in range(MOST_ITERATIONS):
                factors(t, q, p, Cq, S)
                r[:] = 0.0
                constraint(t, q, p, r)
                shortest(Cq, S, r, x)
                total = 0.0
                for j in range(n):
                    q[j] -= x[j]
                    total += (x[j] / (rtol * abs(given[j]) + atol)) ** 2
                if total <= bound * bound * size:
                    break
                if iteration == MOST_ITERATIONS - 1 or not np.isfinite(total):
                    return AGAIN
            factors(t, q, p, Cq, S)
            r[:] = 0.0
            constraint_rate(t, q, p, r)
            remove(Cq, S, r, x, v)
        except Exception:
            return RAISED
        for k in range(size):
            state[k] -= given[k]
        if err != 0:
            estimate = carray(array_at(err), (size,))
            r[:] = 0.0
            remove(Cq, S, r, x, estimate[:n])
            r[:] = 0.0
            remove(Cq, S, r, x, estimate[n:])
        return 0

    return projection, n_memory

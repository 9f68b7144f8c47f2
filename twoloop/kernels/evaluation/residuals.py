"""Compute the residuals of the equations of motion at given states, by the callbacks."""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR, f8
from twoloop.kernels.data.common import INTEGERS, KIT, compiled, kernel
from twoloop.kernels.data.indices import GAMMA_GIVEN

TABLE, STATES = types.float64[:, ::1], types.float64[:, :, ::1]


@compiled
def _relative_residual(value, allowed):
    """Divide a residual by its allowed size."""
    if not np.isfinite(value):
        return np.inf
    if value == 0.0:
        return 0.0
    return abs(value) / allowed if allowed > 0.0 else np.inf


@kernel(types.void(KIT, INTEGERS, f8, f8, f8, INTEGERS, TABLE, STATES, STATES, TABLE, VECTOR, VECTOR))
def motion_residuals(f, sizes, t, share, atol, runs, parameters, states_q, states_v, ends, room, worst):
    """Compute each run's largest residual of C = 0, C_q v + C_t = 0, C_q a = gamma, M a + C_q^T lam = Q over `share`.

    That is a share of the terms of a row, beside which positions and velocities may be off by `atol`.
    runs : of each row its run, -1: it is left out; parameters : of all runs, (., n_p), from sizes[2] on in p; states_q,
    states_v : (n_rows, n, n_t), of which the last count; ends : (n_rows, n + n_c), a and lam;
    room : (n (n + 3) + n_c (n + 3),).
    """
    n, n_c, first = sizes[0], sizes[1], sizes[2]
    M, Q = room[: n * n].reshape((n, n)), room[n * n : n * n + n]
    place = n * n + n
    G = room[place : place + n_c * n].reshape((n_c, n))
    place += n_c * n
    C, rate, gamma = room[place : place + n_c], room[place + n_c : place + 2 * n_c], room[place + 2 * n_c :][:n_c]
    place += 3 * n_c
    q, v, last = room[place : place + n], room[place + n : place + 2 * n], states_q.shape[2] - 1
    gamma_given = f.flags[GAMMA_GIVEN] == 1
    for k in range(runs.size):
        if runs[k] < 0:
            continue
        room[:] = 0.0
        for j in range(parameters.shape[1]):
            f.p[first + j] = parameters[runs[k], j]
        far, fast, largest = 0.0, 0.0, 0.0
        for j in range(n):
            q[j], v[j] = states_q[k, j, last], states_v[k, j, last]
            far, fast = max(far, abs(q[j])), max(fast, abs(v[j]))
        a, lam = ends[k, :n], ends[k, n:]
        f.mass(t, q, f.p, M)
        f.force(t, q, v, f.p, Q)
        f.constraint(t, q, f.p, C)
        f.jacobian(t, q, f.p, G)
        f.constraint_rate(t, q, f.p, rate)
        if gamma_given:
            f.gamma(t, q, v, f.p, gamma)
        for i in range(n_c):
            row, faster, off, terms = 0.0, rate[i], -gamma[i], abs(gamma[i])
            for j in range(n):
                row += abs(G[i, j])
                faster += G[i, j] * v[j]
                off += G[i, j] * a[j]
                terms += abs(G[i, j] * a[j])
            largest = max(largest, _relative_residual(C[i], row * (share * far + atol)))
            largest = max(largest, _relative_residual(faster, row * (share * fast + atol) + share * abs(rate[i])))
            if gamma_given:
                largest = max(largest, _relative_residual(off, share * terms + row * atol))
        size, apart = 0.0, 0.0
        for j in range(n):
            total, largest_term = -Q[j], abs(Q[j])
            for m in range(n):
                term = M[j, m] * a[m]
                total, largest_term = total + term, max(largest_term, abs(term))
            for i in range(n_c):
                term = G[i, j] * lam[i]
                total, largest_term = total + term, max(largest_term, abs(term))
            size = max(size, largest_term)
            apart = max(apart, abs(total)) if np.isfinite(total) else np.inf
        largest = max(largest, _relative_residual(apart, share * size))
        worst[k] = largest


@kernel(types.void(KIT, INTEGERS, f8, f8, TABLE, TABLE, TABLE, VECTOR, VECTOR))
def constraint_residuals(f, sizes, t, slow, parameters, q, v, room, worst):
    """Compute each state's largest |C| and |C_q v + C_t|, relative to the row of |C_q| and the largest entry of q or v.

    slow : speed below which velocities count as if one of them were as large; room : (n_c (n + 2),).
    """
    n, n_c, first = sizes[0], sizes[1], sizes[2]
    C, rate, G = room[:n_c], room[n_c : 2 * n_c], room[2 * n_c :].reshape((n_c, n))
    for k in range(q.shape[0]):
        room[:] = 0.0
        for j in range(parameters.shape[1]):
            f.p[first + j] = parameters[k, j]
        f.constraint(t, q[k], f.p, C)
        f.jacobian(t, q[k], f.p, G)
        f.constraint_rate(t, q[k], f.p, rate)
        far, fast, worst[k] = 0.0, slow, 0.0
        for j in range(n):
            far, fast = max(far, abs(q[k, j])), max(fast, abs(v[k, j]))
        for i in range(n_c):
            row, faster = 0.0, rate[i]
            for j in range(n):
                row += abs(G[i, j])
                faster += G[i, j] * v[k, j]
            worst[k] = max(
                worst[k], _relative_residual(C[i], row * far), _relative_residual(faster, row * fast + abs(rate[i]))
            )

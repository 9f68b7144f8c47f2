"""The HHT method at index 3 (Negrut et al., J. Comput. Nonlinear Dyn. 2, 2007), with weighted accelerations."""

from itertools import pairwise

import numpy as np

ALPHA = -0.1
GAMMA = 0.5 * (1.0 - 2.0 * ALPHA)
BETA = 0.25 * (1.0 - ALPHA) ** 2


def equations(problem, t, q, v, a, lam, before):
    """Residual of a = (1 + alpha) M^-1 (Q - C_q^T lam) - alpha `before`, that of the step before."""
    return problem.mass(t, q) @ (a + ALPHA * before) + (1.0 + ALPHA) * (
        problem.jacobian(t, q).T @ lam - problem.force(t, q, v)
    )


def solved(M, J, right, below):
    """x and lam of M x + J^T lam = right, J x = below."""
    n, m = len(M), len(J)
    heavy, long = np.abs(M).max(), np.linalg.norm(J, axis=1)
    matrix = np.block([[M / heavy, (J / long[:, None]).T], [J / long[:, None], np.zeros((m, m))]])
    whole = np.concatenate([right / heavy, below / long])
    if not np.isfinite(whole).all():
        raise RuntimeError("not finite")
    x = np.linalg.lstsq(matrix, whole, rcond=1e-8)[0]
    return x[:n], x[n:] * heavy / long


def step_on(problem, t, h, state):
    """The state at t + h: q, v, a, lam, and the acceleration of the equations."""
    q, v, a, lam, before = state
    new_t, new_a = t + h, a
    for k in range(40):
        new_q = q + h * v + 0.5 * h**2 * ((1.0 - 2.0 * BETA) * a + 2.0 * BETA * new_a)
        new_v = v + h * ((1.0 - GAMMA) * a + GAMMA * new_a)
        rest = equations(problem, new_t, new_q, new_v, new_a, lam, before)
        M, J = problem.mass(new_t, new_q), problem.jacobian(new_t, new_q)
        change, more = solved(M, J, -rest, -problem.constraint(new_t, new_q) / (BETA * h**2))
        new_a, lam = new_a + change, lam + more / (1.0 + ALPHA)
        if BETA * h**2 * np.abs(change).max() < 1e-13 * max(1.0, np.abs(new_q).max()) and k > 0:
            return new_q, new_v, new_a, lam, (new_a + ALPHA * before) / (1.0 + ALPHA)
    raise RuntimeError("Newton's method does not converge")


def told(problem, t, q, v, lam):
    """The state that is returned, with velocities on the constraints."""
    M, J = problem.mass(t, q), problem.jacobian(t, q)
    change, _ = solved(M, J, 0.0 * v, -(J @ v + problem.constraint_rate(t, q)))
    return q, v + change, lam


def simulate(problem, times, step):
    """Rows of q, v and lam at the times, with steps of equal length between them."""
    q, v = problem.q0, problem.v0
    M, J = problem.mass(times[0], q), problem.jacobian(times[0], q)
    a, lam = solved(M, J, problem.force(times[0], q, v), problem.gamma(times[0], q, v))
    state, rows = (q, v, a, lam, a), [(q, v, lam)]
    for begin, end in pairwise(times):
        n = round((end - begin) / step)
        h = (end - begin) / n
        for k in range(n):
            state = step_on(problem, begin + k * h, h, state)
        rows.append(told(problem, end, *state[:2], state[3]))
    return tuple(np.array(each) for each in zip(*rows, strict=True))

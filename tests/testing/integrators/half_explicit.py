"""Half-explicit midpoint method at index 2 (Hairer, Lubich, Roche), positions projected at the end of each step."""

from itertools import pairwise

import numpy as np


def solved(M, to, rows, right, below):
    """x and lam of M x + to^T lam = right, rows x = below."""
    n, m = len(M), len(rows)
    heavy, left, long = np.abs(M).max(), np.linalg.norm(to, axis=1), np.linalg.norm(rows, axis=1)
    matrix = np.block([[M / heavy, (to / left[:, None]).T], [rows / long[:, None], np.zeros((m, m))]])
    whole = np.concatenate([right / heavy, below / long])
    if not np.isfinite(whole).all():
        raise FloatingPointError("not finite")
    x = np.linalg.lstsq(matrix, whole, rcond=1e-8)[0]
    return x[:n], x[n:] * heavy / left


def substep(problem, v, at, end, h):
    """v + h a with M and Q of at = (t, q, v), such that C_q v + C_t = 0 at end = (t, q)."""
    J = problem.jacobian(*end)
    M, to, Q = problem.mass(*at[:2]), problem.jacobian(*at[:2]), problem.force(*at)
    wanted = -(J @ v + problem.constraint_rate(*end)) / h
    return v + h * solved(M, to, J, Q, wanted)[0]


def onto(problem, t, q):
    """The nearest position on the constraints."""
    for _ in range(15):
        J = problem.jacobian(t, q)
        size = np.linalg.norm(J, axis=1)
        change = np.linalg.lstsq(J / size[:, None], -problem.constraint(t, q) / size, rcond=1e-8)[0]
        q = q + change
        if np.abs(change).max() < 1e-13 * max(1.0, np.abs(q).max()):
            return q
    raise FloatingPointError("no position on the constraints")


def step_on(problem, t, h, q, v):
    """The state at t + h."""
    half_q = q + 0.5 * h * v
    half_v = substep(problem, v, (t, q, v), (t + 0.5 * h, half_q), 0.5 * h)
    new_q = onto(problem, t + h, q + h * half_v)
    return new_q, substep(problem, v, (t + 0.5 * h, half_q, half_v), (t + h, new_q), h)


def multipliers(problem, t, q, v):
    """lam of M a + C_q^T lam = Q at index 1."""
    M, J = problem.mass(t, q), problem.jacobian(t, q)
    return solved(M, J, J, problem.force(t, q, v), problem.gamma(t, q, v))[1]


def simulate(problem, times, step):
    """Rows of q, v and lam at the times, with steps of equal length between them."""
    q, v = problem.q0, problem.v0
    rows = [(q, v, multipliers(problem, times[0], q, v))]
    for begin, end in pairwise(times):
        n = round((end - begin) / step)
        h = (end - begin) / n
        for k in range(n):
            q, v = step_on(problem, begin + k * h, h, q, v)
        rows.append((q, v, multipliers(problem, end, q, v)))
    return tuple(np.array(each) for each in zip(*rows, strict=True))

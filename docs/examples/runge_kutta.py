"""The classical Runge-Kutta method on the equations at index 1, put on the constraints after each step."""

import numpy as np


def acceleration(problem, t, q, v):
    """a of M a + C_q^T lam = Q, C_q a = gamma, and lam; by least squares, for rows may be redundant."""
    M, J = problem.mass(t, q), problem.jacobian(t, q)
    n, m = len(q), len(J)
    heavy, length = np.abs(M).max(), np.linalg.norm(J, axis=1)  # in any units the matrix has entries of size 1
    rows = J / length[:, None]
    matrix = np.block([[M / heavy, rows.T], [rows, np.zeros((m, m))]])
    right = np.concatenate([problem.force(t, q, v) / heavy, problem.gamma(t, q, v) / length])
    if not np.isfinite(right).all():
        raise RuntimeError(f"forces are not finite at t = {t:.6g}")
    both = np.linalg.lstsq(matrix, right, rcond=1e-11)[0]
    return both[:n], both[n:] * heavy / length


def projected(problem, t, q, v):
    """The nearest state on the constraints."""
    for _ in range(20):
        step = np.linalg.lstsq(problem.jacobian(t, q), -problem.constraint(t, q), rcond=1e-10)[0]
        q = q + step
        if np.abs(step).max() < 1e-13 * max(1.0, np.abs(q).max()):
            break
    else:
        raise RuntimeError(f"positions do not get on the constraints at t = {t:.6g}")
    J = problem.jacobian(t, q)
    return q, v - np.linalg.lstsq(J, J @ v + problem.constraint_rate(t, q), rcond=1e-10)[0]


def simulate(problem, times, step):
    """Rows of q, v and lam at the times, with steps of equal length between them."""
    t, q, v = times[0], problem.q0, problem.v0
    rows = [(q, v, acceleration(problem, t, q, v)[1])]
    for end in times[1:]:
        n = round((end - t) / step)
        h = (end - t) / n
        for _ in range(n):
            a1 = acceleration(problem, t, q, v)[0]
            v2 = v + 0.5 * h * a1
            a2 = acceleration(problem, t + 0.5 * h, q + 0.5 * h * v, v2)[0]
            v3 = v + 0.5 * h * a2
            a3 = acceleration(problem, t + 0.5 * h, q + 0.5 * h * v2, v3)[0]
            v4 = v + h * a3
            a4 = acceleration(problem, t + h, q + h * v3, v4)[0]
            q, v = q + h / 6.0 * (v + 2.0 * v2 + 2.0 * v3 + v4), v + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
            t = t + h
            q, v = projected(problem, t, q, v)
        t = end
        rows.append((q, v, acceleration(problem, t, q, v)[1]))
    return tuple(np.array(each) for each in zip(*rows, strict=True))

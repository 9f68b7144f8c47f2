"""The generalised-alpha method on the equations at index 3 (Arnold & Brüls, Multibody Syst. Dyn. 18, 2007)."""

import numpy as np

RADIUS = 0.8  # spectral radius at infinity
ALPHA_M, ALPHA_F = (2.0 * RADIUS - 1.0) / (RADIUS + 1.0), RADIUS / (RADIUS + 1.0)
GAMMA = 0.5 + ALPHA_F - ALPHA_M
BETA = 0.25 * (GAMMA + 0.5) ** 2


def solved(M, J, right, rows):
    """x and lam of M x + J^T lam = right, J x = rows; by least squares, for rows may be redundant."""
    n, m = len(M), len(J)
    heavy, length = np.abs(M).max(), np.linalg.norm(J, axis=1)  # in any units the matrix has entries of size 1
    unit = J / length[:, None]
    matrix = np.block([[M / heavy, unit.T], [unit, np.zeros((m, m))]])
    whole = np.concatenate([right / heavy, rows / length])
    if not np.isfinite(whole).all():
        raise RuntimeError("forces or constraints are not finite")
    both = np.linalg.lstsq(matrix, whole, rcond=1e-7)[0]
    return both[:n], both[n:] * heavy / length


def step_on(problem, t, h, q, v, a, between, lam):
    """The state at t + h; `between` is the acceleration of the method, which belongs to another instant."""
    started = ALPHA_F * a - ALPHA_M * between
    new_a = a
    for _ in range(50):
        new_between = (started + (1.0 - ALPHA_F) * new_a) / (1.0 - ALPHA_M)
        new_q = q + h * v + h**2 * ((0.5 - BETA) * between + BETA * new_between)
        new_v = v + h * ((1.0 - GAMMA) * between + GAMMA * new_between)
        M, J = problem.mass(t + h, new_q), problem.jacobian(t + h, new_q)
        rest = problem.force(t + h, new_q, new_v) - M @ new_a - J.T @ lam
        by_a = h**2 * BETA * (1.0 - ALPHA_F) / (1.0 - ALPHA_M)  # dq / da
        change, more = solved(M, J, rest, -problem.constraint(t + h, new_q) / by_a)
        new_a, lam = new_a + change, lam + more
        if by_a * np.abs(change).max() < 1e-13 * max(1.0, np.abs(new_q).max()):
            return new_q, new_v, new_a, new_between, lam
    raise RuntimeError(f"Newton's method does not converge at t = {t + h:.6g}")


def simulate(problem, times, step):
    """Rows of q, v and lam at the times, with steps of equal length between them."""
    t, q, v = times[0], problem.q0, problem.v0
    M, J = problem.mass(t, q), problem.jacobian(t, q)
    a, lam = solved(M, J, problem.force(t, q, v), problem.gamma(t, q, v))
    between, rows = a, [(q, v, lam)]
    for end in times[1:]:
        n = round((end - t) / step)
        for k in range(n):
            h = (end - t) / (n - k)
            q, v, a, between, lam = step_on(problem, t, h, q, v, a, between, lam)
            t = end if k == n - 1 else t + h
        rows.append((q, v, lam))
    return tuple(np.array(each) for each in zip(*rows, strict=True))

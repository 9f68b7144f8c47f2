"""RATTLE (Andersen, J. Comput. Phys. 52, 1983), for constant masses and forces without velocities."""

import numpy as np


def solved(M, to, J, right, rows):
    """x and lam of M x + to^T lam = right, J x = rows; by least squares, for rows may be redundant."""
    n, m = len(M), len(J)
    heavy, length = np.abs(M).max(), np.linalg.norm(J, axis=1)  # in any units the matrix has entries of size 1
    matrix = np.block([[M / heavy, (to / length[:, None]).T], [J / length[:, None], np.zeros((m, m))]])
    both = np.linalg.lstsq(matrix, np.concatenate([right / heavy, rows / length]), rcond=1e-11)[0]
    return both[:n], both[n:] * heavy / length


def step_on(problem, t, h, q, v):
    """The state at t + h."""
    M, to, force = problem.mass(t, q), problem.jacobian(t, q), problem.force(t, q, v)
    middle, none = v, np.zeros(len(to))
    middle = v + 0.5 * h * solved(M, to[:0], to[:0], force, none[:0])[0]
    for _ in range(50):  # impulses along the rows of the start put the end on the constraints
        J = problem.jacobian(t + h, q + h * middle)
        change, _ = solved(M, to, J, 0.0 * v, -problem.constraint(t + h, q + h * middle) / h)
        middle = middle + change
        if h * np.abs(change).max() < 1e-13 * max(1.0, np.abs(q).max()):
            break
    else:
        raise RuntimeError(f"positions do not get on the constraints at t = {t + h:.6g}")
    q, t = q + h * middle, t + h
    J, force = problem.jacobian(t, q), problem.force(t, q, middle)
    free = middle + 0.5 * h * solved(M, J[:0], J[:0], force, none[:0])[0]
    change, _ = solved(M, J, J, 0.0 * v, -(J @ free + problem.constraint_rate(t, q)))
    return q, free + change


def simulate(problem, times, step):
    """Rows of q and v at the times, with steps of equal length between them."""
    t, q, v = times[0], problem.q0, problem.v0
    rows = [(q, v)]
    for end in times[1:]:
        n = round((end - t) / step)
        for k in range(n):
            h = (end - t) / (n - k)
            q, v = step_on(problem, t, h, q, v)
            t = end if k == n - 1 else t + h
        rows.append((q, v))
    return tuple(np.array(each) for each in zip(*rows, strict=True))

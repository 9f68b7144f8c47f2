"""Check an integrator of your own: the midpoint rule, put back onto the constraints after each step."""

from functools import partial
from itertools import pairwise

import numpy as np

from twoloop.testing import check_simulator


def acceleration(problem, t, q, v):
    """Solve M a + C_q^T lam = Q and C_q a = gamma for a."""
    M, J = problem.mass(t, q), problem.jacobian(t, q)
    matrix = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
    right = np.concatenate([problem.force(t, q, v), problem.gamma(t, q, v)])
    return np.linalg.solve(matrix, right)[: len(q)]


def projected(problem, t, q, v):
    """Move a state onto the constraints. The velocities are wrong where the constraints move with time."""
    for _ in range(5):
        q = q - np.linalg.pinv(problem.jacobian(t, q)) @ problem.constraint(t, q)
    J = problem.jacobian(t, q)
    return q, v - np.linalg.pinv(J) @ J @ v


def simulate(problem, times, step, project=projected):
    """Return q and v at the times, a row each, with steps of equal length between them."""
    q, v = problem.q0, problem.v0
    rows = [(q, v)]
    for t, end in pairwise(times):
        n = round((end - t) / step)
        h = (end - t) / n
        for t_n in t + h * np.arange(n):
            middle = v + h / 2 * acceleration(problem, t_n, q, v)
            a = acceleration(problem, t_n + h / 2, q + h / 2 * v, middle)
            q, v = q + h * middle, v + h * a
            q, v = project(problem, t_n + h, q, v)
        rows.append((q, v))
    return tuple(np.array(column) for column in zip(*rows, strict=True))


report = check_simulator(simulate, ["pendulum", "driven_crank"], steps=(100, 200), order=2)
print(report)


def repaired(problem, t, q, v):
    """Move a state onto the constraints, which may move themselves."""
    for _ in range(5):
        q = q - np.linalg.pinv(problem.jacobian(t, q)) @ problem.constraint(t, q)
    J = problem.jacobian(t, q)
    return q, v - np.linalg.pinv(J) @ (J @ v + problem.constraint_rate(t, q))


repeated = check_simulator(partial(simulate, project=repaired), "driven_crank", steps=(100, 200), order=2)
assert repeated.passed, str(repeated)

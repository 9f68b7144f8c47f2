"""IDA of scikit-sundae at index 1, with the multipliers as its algebraic variables."""

import numpy as np
from numpy.typing import NDArray

from references.as_shown import start_of
from references.driver import imported
from twoloop.testing.problem import Array, KnownProblem

NAME, PACKAGE, DRIFTS = "IDA, scikit-sundae", "scikit-sundae", True


def simulate(problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """IDA of scikit-sundae at index 1, with the multipliers as its algebraic variables."""
    n, m = problem.n_q, problem.n_c
    a, lam = problem.acceleration(times[0], problem.q0, problem.v0)
    y0, yp0 = np.concatenate([start_of(problem), lam]), np.concatenate([problem.v0, a, np.zeros(m)])

    def residual(t: float, y: Array, yp: Array, solution: NDArray[np.float64]) -> None:
        q, v, J = y[:n], y[n : 2 * n], problem.jacobian(t, y[:n])
        solution[:n] = yp[:n] - v
        solution[n : 2 * n] = problem.mass(t, q) @ yp[n : 2 * n] + J.T @ y[2 * n :] - problem.force(t, q, v)
        solution[2 * n :] = J @ yp[n : 2 * n] - problem.gamma(t, q, v)

    options = {"algebraic_idx": list(range(2 * n, 2 * n + m)), "max_num_steps": 100_000}
    solution = imported("sksundae.ida").IDA(residual, rtol=tolerance, atol=tolerance, **options).solve(times, y0, yp0)
    if not solution.success:
        raise RuntimeError(solution.message)
    return tuple(np.split(solution.y, [n, 2 * n], axis=1))

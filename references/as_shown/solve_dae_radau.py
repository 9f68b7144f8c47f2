"""Radau of solve_dae on the stabilised equations."""

import numpy as np

from references.driver import imported
from twoloop.testing.problem import Array, KnownProblem

NAME, PACKAGE, DRIFTS = "Radau, solve_dae, stabilised", "solve-dae", False


def simulate(problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """Radau of solve_dae on the stabilised equations."""
    solve, zeros = imported("solve_dae.integrate").solve_dae, np.zeros(problem.n_c)
    a, lam = problem.acceleration(problem.t_span[0], problem.q0, problem.v0)
    y0, yp0 = np.concatenate([problem.q0, problem.v0, zeros, zeros]), np.concatenate([problem.v0, a, zeros, lam])
    options = {"method": "Radau", "t_eval": times, "rtol": tolerance, "atol": tolerance}
    solution = solve(lambda t, y, yp: _residual(problem, t, y, yp), (times[0], times[-1]), y0, yp0, **options)
    if not solution.success:
        raise RuntimeError(solution.message)
    n, m = problem.n_q, problem.n_c
    return solution.y[:n].T, solution.y[n : 2 * n].T, solution.yp[2 * n + m :].T


def _residual(problem: KnownProblem, t: float, y: Array, yp: Array) -> Array:
    """Return F(t, y, y') of the stabilised index-2 equations, y = [q, v, integrals of mu and of lam].

    C. W. Gear, B. Leimkuhler, G. K. Gupta, J. Comput. Appl. Math. 12-13 (1985) 77-90.
    """
    n, m = problem.n_q, problem.n_c
    q, v, J = y[:n], y[n : 2 * n], problem.jacobian(t, y[:n])
    qp, vp, mu, lam = np.split(yp, [n, 2 * n, 2 * n + m])
    momentum_balance = problem.mass(t, q) @ vp - problem.force(t, q, v) + J.T @ lam
    return np.concatenate(
        [qp - v + J.T @ mu, momentum_balance, problem.constraint(t, q), J @ v + problem.constraint_rate(t, q)]
    )

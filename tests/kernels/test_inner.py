"""The inner loop: positions, velocities, accelerations and multipliers at every accepted step."""

import numpy as np
import pytest

from tests.problems import violations, worst
from twoloop import Newmark, RungeKutta, solve_dae
from twoloop.methods.tableaux import gauss, sun_radau_iib

METHODS = {
    "irk": RungeKutta(sun_radau_iib(3), inner_tol=1e-9),
    "gauss": RungeKutta(gauss(5), inner_tol=1e-9),
    "paper": RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", inner_tol=1e-9, outer_tol=1e-9),
    "newmark": Newmark(inner_tol=1e-9),
}


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("geometry", ["default_four_bar", "collinear_four_bar"])
def test_constraints_hold_at_every_accepted_step_of_a_long_run(request, name, geometry):
    problem = request.getfixturevalue(geometry)
    tolerance = 1e-5 if name == "newmark" else 1e-7
    result = solve_dae(
        problem.system, (0.0, 12.0), problem.q0, problem.v0, METHODS[name], tolerance, tolerance, max_steps=30_000
    )
    assert result.success
    position, velocity = violations(problem.system, result)
    assert position < 1e-9 and velocity < 1e-9
    half = result.t.size // 2  # no growth: the second half is as good as the first
    late = max(
        np.abs(problem.system.constraint(t, q)).max() for t, q in zip(result.t[half:], result.q.T[half:], strict=True)
    )
    assert late < 1e-9


def test_update_first_then_test(default_four_bar):
    # a Newton test before the update would leave violations of the order of the tolerance
    problem = default_four_bar
    method = RungeKutta(sun_radau_iib(3), inner_tol=1e-3)
    result = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0, method=method, rtol=1e-7, atol=1e-7)
    assert violations(problem.system, result)[0] < 2e-6  # about the square of the tolerance
    assert worst(result.q[:, -1], problem.reference.q) < 1e-4


def test_newton_takes_few_iterations(default_four_bar):
    problem = default_four_bar
    stats = solve_dae(problem.system, (0.0, 10.0), problem.q0, problem.v0).stats
    assert stats.n_inner < 2.0 * stats.n_evaluations

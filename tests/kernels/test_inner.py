"""The inner loop: positions, velocities, accelerations and multipliers at every accepted step."""

import numpy as np
import pytest

from tests.problems import (
    force_residual,
    moving_pivot,
    moving_pivot_state,
    oblique_pendulum,
    oblique_point,
    oblique_start,
    oblique_to_point,
    violations,
    worst,
)
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
    assert position < 1e-9
    assert velocity < 1e-9
    half = result.t.size // 2  # no growth: the second half is as good as the first
    late = max(
        np.abs(problem.system.constraint(t, q)).max() for t, q in zip(result.t[half:], result.q.T[half:], strict=True)
    )
    assert late < 1e-9


def test_multipliers_and_accelerations_with_a_mass_that_varies_in_time_and_place():
    system = oblique_pendulum()
    times = np.linspace(0.0, 5.0, 21)
    result = solve_dae(system, (0.0, 5.0), *oblique_start(), rtol=1e-10, atol=1e-10, t_eval=times)
    x, u, lam = oblique_point(times)
    points, speeds = oblique_to_point(result)
    assert worst(points, x) < 1e-9
    assert worst(speeds, u) < 1e-9
    assert worst(result.lam[0], lam) < 1e-8
    assert force_residual(system, result) < 1e-10


@pytest.mark.parametrize("gamma", [True, False])
def test_rheonomic_constraints(gamma):
    times = np.linspace(0.0, 3.0, 13)
    system = moving_pivot(gamma=gamma)
    result = solve_dae(system, (0.0, 3.0), *moving_pivot_state(0.0), rtol=1e-10, atol=1e-10, t_eval=times)
    q, v = moving_pivot_state(times)
    assert worst(result.q, q) < 1e-9
    assert worst(result.v, v) < 5e-9
    assert max(violations(system, result)) < 1e-11


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

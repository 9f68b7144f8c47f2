"""Adams: order, prices, error control, constraints, what it starts from, what it says."""

import numpy as np
import pytest

from references.paper.four_bar_minimal import trajectory
from tests.problems import (
    force_residual,
    moving_pivot,
    moving_pivot_state,
    oblique_pendulum,
    oblique_point,
    oblique_start,
    oblique_to_point,
    pendulum,
    pendulum_state,
    run,
    swing,
    violations,
    worst,
)
from twoloop import solve_dae
from twoloop.kernels.steps import adams_step as adams

TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
LINKAGES = ["default_four_bar", "collinear_four_bar"]
linkages = pytest.mark.parametrize("linkage", LINKAGES)


def four_bar_run(problem, tol, end=10.0, method="Adams", **options):
    """The run and its largest error in q over all stored states."""
    result = run(problem, end, method=method, rtol=tol, atol=tol, **options)
    assert result.success, result.message
    return result, worst(result.q, trajectory(problem.parameters, result.t)[0])


def test_the_nodes_integrate_what_they_must():
    s, w = adams.NODES, adams.WEIGHTS
    for power in range(2 * len(s)):
        assert abs(w @ s**power - 1.0 / (power + 1)) < 1e-15
    np.testing.assert_allclose(adams.REST, w * (1.0 - s), rtol=1e-15)


@linkages
def test_errors_follow_the_tolerance(linkage, request):
    runs = [four_bar_run(request.getfixturevalue(linkage), tol) for tol in TOLERANCES]
    assert all(result.stats.n_partitions > 1 for result, _ in runs)
    errors = np.array([error for _, error in runs])
    assert (errors < 3e2 * np.array(TOLERANCES)).all()
    assert (errors[1:] < 0.2 * errors[:-1]).all()


def test_a_step_is_two_evaluations_and_few_are_refused(default_four_bar):
    for tol in (1e-6, 1e-10):
        stats = four_bar_run(default_four_bar, tol)[0].stats
        attempts = stats.n_accepted + stats.n_rejected_error
        assert stats.n_rejected_error < 0.03 * stats.n_accepted
        # one more where the projection takes a second pass
        assert 2 * stats.n_accepted <= stats.n_evaluations <= 3 * attempts + 1
        assert stats.n_rejected_convergence == 0


# bounds are about 1.3 times what was counted when they were written
@pytest.mark.parametrize(("tol", "steps"), [(1e-4, 560), (1e-8, 1480), (1e-12, 2990)])
def test_price_of_ten_seconds(default_four_bar, tol, steps):
    assert four_bar_run(default_four_bar, tol)[0].stats.n_accepted < steps


def test_it_takes_fewer_evaluations_than_others_at_equal_error(default_four_bar):
    own, error = four_bar_run(default_four_bar, 1e-12)
    other, other_error = four_bar_run(default_four_bar, 1e-10, method="Gauss12")
    assert max(error, other_error) < 3e-11  # rounding has its share in both
    assert own.stats.n_evaluations < 0.5 * other.stats.n_evaluations


@linkages
@pytest.mark.parametrize("tol", [1e-2, 1e-8])
def test_it_does_not_drift_off_the_constraints(linkage, tol, request):
    problem = request.getfixturevalue(linkage)
    result = run(problem, 50.0, method="Adams", rtol=tol, atol=tol)
    assert result.success
    position, velocity = violations(problem.system, result)
    assert position < 1e-14
    assert velocity < 3e-12
    assert force_residual(problem.system, result) < 1e-8


@pytest.mark.parametrize("tol", TOLERANCES)
def test_a_first_step_that_is_too_large_is_refused(tol):
    usual, result = (swing(method="Adams", rtol=tol, atol=tol, first_step=h) for h in (None, 1.0))
    assert result.success, result.message
    assert result.stats.n_rejected_error + result.stats.n_rejected_convergence > 0
    assert result.stats.n_accepted < 1.3 * usual.stats.n_accepted
    assert worst(result.q, pendulum_state(result.t)[0]) < 3e2 * tol


def test_a_force_that_jumps_is_passed():
    pushed = np.array([20.0, -9.81])
    result = swing(2.0, pendulum(force=lambda t, q, v: pushed if t > 1.0 else pushed * [0, 1]), method="Adams")
    before = swing(1.0, method="Gauss8", rtol=1e-12, atol=1e-12)
    start = before.q[:, -1], before.v[:, -1]
    after = solve_dae(pendulum(force=lambda t, q, v: pushed), (1.0, 2.0), *start, "Gauss8", 1e-12, 1e-12)
    assert result.success, result.message
    assert worst(result.q[:, -1], after.q[:, -1]) < 1e-4


def test_a_moving_pivot():
    system, times = moving_pivot(compile=True), np.linspace(0.1, 10.0, 100)
    q, v = moving_pivot_state(times)
    for tol in (1e-6, 1e-9, 1e-12):
        result = solve_dae(system, (0.0, 10.0), *moving_pivot_state(0.0), "Adams", tol, tol, t_eval=times)
        assert result.success and result.stats.n_partitions > 5
        assert max(violations(system, result)) < 1e-11
        assert worst(result.q, q) < 1e3 * tol
        assert worst(result.v, v) < 1e4 * tol


def test_a_full_mass_matrix_that_varies_and_forces_that_depend_on_velocities():
    result = solve_dae(oblique_pendulum(), (0.0, 5.0), *oblique_start(), "Adams", 1e-10, 1e-10)
    x, u = oblique_to_point(result)
    exact_x, exact_u, exact_lam = oblique_point(result.t)
    assert worst(x, exact_x) < 1e-8
    assert worst(u, exact_u) < 1e-7
    assert worst(result.lam, exact_lam) < 1e-6


def test_plain_python_gives_the_run_of_compiled_functions():
    plain, compiled = (swing(method="Adams", system=pendulum(compile=how)) for how in (False, True))
    assert plain.stats.n_evaluations == compiled.stats.n_evaluations
    assert worst(plain.q, compiled.q) < 1e-12


def test_it_says_that_it_cannot_keep_a_constant_step():
    with pytest.raises(ValueError, match=r"method='Adams' .* leave step_size out"):
        swing(method="Adams", step_size=0.01)

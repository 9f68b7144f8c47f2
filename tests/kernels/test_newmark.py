"""Test Newmark: cost of its adaptive steps, by which a wrong prediction or estimate shows; what its tolerance means."""

import numpy as np
import pytest

from tests.problems import run, swing, worst
from twoloop import ConstrainedSystem, Newmark, solve_dae
from twoloop.mechanisms import four_bar, knife_edge
from twoloop.mechanisms.knife_edge import motion

# bounds are about 1.1 times what was counted when they were written
PRICES = {("default_four_bar", 1e-4): (800, 2400), ("collinear_four_bar", 1e-6): (8700, 21_000)}


@pytest.mark.parametrize(("linkage", "tol"), PRICES)
def test_price_of_five_seconds(linkage, tol, request):
    stats = run(request.getfixturevalue(linkage), 5.0, method="Newmark", rtol=tol, atol=tol).stats
    steps, iterations = PRICES[linkage, tol]
    assert 0.7 * steps < stats.n_accepted < steps and stats.n_outer < iterations
    assert stats.n_rejected_error < 0.05 * stats.n_accepted and stats.n_rejected_convergence == 0


def test_price_with_the_error_tolerance_of_the_paper(default_four_bar):
    stats = run(default_four_bar, 5.0, method=Newmark(error_tol=1e-5)).stats
    assert 500 < stats.n_accepted < 660 and stats.n_outer < 2800
    assert stats.n_inner < 1.85 * stats.n_outer  # Newton starts from where the accelerations lead


def test_a_start_at_the_origin(tolerance=1e-5):
    """Where coordinates are zero, the contraction rate was measured over atol alone, and was huge."""
    result = run(knife_edge(), 1.0, method="Newmark", rtol=tolerance, atol=tolerance)
    q, v = motion(1.0)
    assert result.success and np.abs(result.q[:, -1] - q).max() < 40.0 * tolerance
    assert np.abs(result.v[:, -1] - v).max() < 100.0 * tolerance


def test_a_body_at_rest_at_the_origin_that_is_pushed_later(tolerance=1e-6):
    """The first step under the force set the scale of its own error, so that any error passed."""
    system = ConstrainedSystem.from_python(
        **{"n_q": 1, "n_c": 0, "mass": np.array([[2.0]]), "compile": True},
        force=lambda t, q, v: np.array([5.0 if t >= 0.3 else 0.0]),
    )
    result = solve_dae(system, (0.0, 3.0), [0.0], [0.0], "Newmark", tolerance, tolerance)
    assert result.success and abs(result.v[0, -1] - 2.5 * 2.7) < 400.0 * tolerance


def test_the_same_steps_from_a_start_far_away():
    """Of the knife edge no force depends on where it is."""
    problem = knife_edge()
    shift = np.array([1.0, 1.0, 0.0])
    near, far = (
        solve_dae(problem.system, (0.0, 1.0), problem.q0 + k * shift, problem.v0, "Newmark", 1e-6, 1e-6) for k in (0, 1)
    )
    assert 0.5 < near.stats.n_accepted / far.stats.n_accepted < 2.0
    assert np.abs(near.q[:, -1] - far.q[:, -1] + shift).max() < 4e-5


def test_the_error_of_newmark_is_proportional_to_its_tolerance():
    problem = four_bar()
    reference = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, "Gauss12", 1e-11, 1e-11)
    errors = []
    for tolerance in (1e-4, 1e-5, 1e-6):
        run = solve_dae(problem.system, (0.0, 5.0), problem.q0, problem.v0, "Newmark", tolerance, tolerance)
        errors.append(worst(run.q[:, -1], reference.q[:, -1]))
    assert (np.abs((np.diff(np.log10(errors)) / -1.0) - 1.0) < 0.3).all(), errors
    assert errors[-1] < 300.0 * 1e-6


def test_newmark_error_tolerance_is_its_own():
    loose, tight = (swing(method=Newmark(error_tol=tol), rtol=1.0, atol=1.0) for tol in (1e-4, 1e-7))
    assert tight.stats.n_accepted > 5 * loose.stats.n_accepted
    assert swing(method=Newmark(error_tol=1e-7), rtol=1e-9, atol=1e-9).stats.n_accepted == tight.stats.n_accepted

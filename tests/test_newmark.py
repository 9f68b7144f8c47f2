"""The tolerance of Newmark holds wherever the origin of the coordinates is."""

import numpy as np
import pytest

from tests.problems import run
from twoloop import solve_dae
from twoloop.mechanisms import knife_edge, rolling_disc
from twoloop.mechanisms.knife_edge import motion


@pytest.mark.parametrize("tolerance", [1e-5, 1e-7])
def test_a_start_at_the_origin(tolerance):
    """As small as coordinates are there, the rate at which velocities change them was huge, and went with atol."""
    result = run(knife_edge(), 1.0, method="Newmark", rtol=tolerance, atol=tolerance)
    q, v = motion(1.0)
    assert result.success
    assert np.abs(result.q[:, -1] - q).max() < 40.0 * tolerance
    assert np.abs(result.v[:, -1] - v).max() < 100.0 * tolerance


def test_the_same_steps_from_a_start_far_away():
    """Of the knife edge no force depends on where it is."""
    problem = knife_edge()
    shift = np.array([1.0, 1.0, 0.0])
    near, far = (
        solve_dae(problem.system, (0.0, 1.0), problem.q0 + k * shift, problem.v0, "Newmark", 1e-6, 1e-6) for k in (0, 1)
    )
    assert 0.5 < near.stats.n_accepted / far.stats.n_accepted < 2.0
    assert np.abs(near.q[:, -1] - far.q[:, -1] + shift).max() < 4e-5


def test_a_rolling_disc():
    errors = []
    exact = run(rolling_disc(), 1.0, method="DOP853", rtol=1e-11, atol=1e-11)
    for tolerance in (1e-4, 1e-6):
        result = run(rolling_disc(), 1.0, method="Newmark", rtol=tolerance, atol=tolerance)
        errors.append(np.abs(np.append(result.q[:, -1] - exact.q[:, -1], result.v[:, -1] - exact.v[:, -1])).max())
    assert errors[0] < 2e-2
    assert errors[1] < 2e-4

"""Wrong input with non-holonomic and redundant rows and singular masses: each mistake has its own error."""

import re

import numpy as np
import pytest
from scipy.integrate import quad

from tests.general import knife_edge
from tests.general.faulty import without_inertia
from tests.general.mechanism import G
from tests.general.wrong_rows import edge, slide
from twoloop import solve_dae
from twoloop.methods.presets import PRESETS


@pytest.mark.parametrize("method", PRESETS)
def test_every_preset_takes_non_holonomic_rows(method):
    """Only the canonical variables refuse them."""
    result = slide(method=method, rtol=1e-5, atol=1e-5)
    assert result.success, result.message
    q, _ = knife_edge.state(result.t[-1])
    assert result.q[:, -1] == pytest.approx(q, abs=1e-3)


def test_gamma_left_out_is_differenced():
    result = slide(edge(nonholonomic_gamma=None), rtol=1e-8, atol=1e-8)
    assert result.success, result.message
    assert result.q[:, -1] == pytest.approx(knife_edge.state(result.t[-1])[0], abs=1e-7)


def test_a_rate_that_is_zero_changes_nothing():
    plain, zero = (slide(edge(nonholonomic_rate=rate)) for rate in (None, lambda t, q: np.zeros(1)))
    assert (plain.q[:, -1] == zero.q[:, -1]).all()


@pytest.mark.parametrize("method", ["SunRadau5", "Gauss12", "DOP853"])
def test_inertia_that_is_lost_on_the_way_ends_the_run(method):
    """A pendulum whose mass moves sideways only: where the rod lies flat, nothing with mass can move.

    On the way x'^2 / 2 - G sqrt(1 - x^2) is conserved, so that the time at which x = 1 is a quadrature.
    """
    speed = 5.0
    end, _ = quad(lambda angle: np.cos(angle) / np.sqrt(speed**2 - 2.0 * G * (1.0 - np.cos(angle))), 0.0, 0.5 * np.pi)
    system = without_inertia((1.0, 0.0, 1.0))
    result = solve_dae(system, (0.0, 1.0), [0.0, -1.0, 0.0], [speed, 0.0, 0.0], method=method, max_steps=50_000)
    assert not result.success and end - 0.02 < result.t[-1] <= end + 1e-6
    x, u = result.q[0, result.t < 0.8 * end], result.v[0, result.t < 0.8 * end]
    assert 0.5 * u**2 - G * np.sqrt(1.0 - x**2) == pytest.approx(0.5 * speed**2 - G, abs=1e-5)
    assert "inertia" in result.message and re.search(r"coordinate\(?s?\)? .*1", result.message)

"""Test redundant and non-holonomic rows and singular masses: named once, left out, with multipliers of least norm."""

import re
import warnings

import numpy as np
import pytest
from scipy.integrate import quad

from tests.bad_input.rows import edge, slide
from tests.general.mechanism import G
from tests.general.mechanisms import mechanism
from tests.general.systems import KNIFE_EDGE, parted_drives, without_inertia
from tests.marks import slow, slow_but
from tests.problems import START, held_twice, pendulum_state
from twoloop import ConstraintWarning, consistent_state, solve_dae
from twoloop.methods.presets import PRESETS

FACTORS = [("DOP853", -0.5), ("RadauIIA5", 3.0), ("Newmark", 1.0)]
FACTORS += [slow(method, 3.0) for method in ("SunRadau5", "Gauss12", "BDF", "PaperIRK")]


@pytest.mark.parametrize(("method", "factor"), FACTORS)
def test_a_row_given_twice_shares_the_force(method, factor):
    """Minimum norm: lam (1, factor) / (1 + factor^2) of the one multiplier, which is known in closed form."""
    with pytest.warns(ConstraintWarning, match=r"row\(?s?\)? .*[01]") as caught:
        result = solve_dae(held_twice(factor), (0.0, 1.0), *START, method=method, rtol=1e-7, atol=1e-7)
    assert len(caught) == 1
    assert result.success, result.message
    assert result.rank == 1 and list(result.redundant) in ([0], [1])
    q, _, lam = pendulum_state(result.t)
    loose = 1e-2 if method in ("Newmark", "PaperIRK") else 1e-4
    assert result.q == pytest.approx(q, abs=loose)
    assert result.lam == pytest.approx(np.outer([1.0, factor], lam) / (1.0 + factor**2), abs=20.0 * loose)
    assert result.lam[1] == pytest.approx(factor * result.lam[0], abs=1e-9)


@pytest.mark.parametrize("method", ["DOP853", slow("Gauss12")])
def test_rows_that_part_later_end_the_run(method):
    """Both drives agree at the start, and only there: to go on with one of them would be wrong in silence."""
    with pytest.warns(ConstraintWarning):
        result = solve_dae(parted_drives(3), (0.0, 1.0), [0.0, 0.0], [1.0, 1.0], method=method)
    assert not result.success and result.t[-1] < 0.1 and "contradict" in result.message and "1" in result.message
    assert "2" in result.message


@pytest.mark.parametrize(("name", "off_q", "off_v"), [("redundant slider-crank", 1e-3, 0), ("wobbling disc", 0, 0.01)])
def test_a_guess_is_projected_on_all_rows(name, off_q, off_v):
    m = mechanism(name)
    system, (q, v), shape = m.system(), m.start, np.cos(np.arange(m.start[0].size))
    with warnings.catch_warnings(action="ignore", category=ConstraintWarning):
        found_q, found_v = consistent_state(system, 0.0, q + off_q * shape, v + off_v * shape)
    assert np.abs(system.constraint(0.0, found_q)).max() < 1e-12
    assert np.abs(system.velocity_constraint(0.0, found_q, found_v)).max() < 1e-11
    if off_v:
        assert found_q == pytest.approx(q, abs=1e-12) and found_v != pytest.approx(v, abs=1e-4)


@pytest.mark.parametrize("method", slow_but(["auto", "Newmark", "BDF"], PRESETS))
def test_every_preset_takes_non_holonomic_rows(method):
    result = slide(method=method, rtol=1e-5, atol=1e-5)
    assert result.success, result.message
    q, _ = KNIFE_EDGE.motion(result.t[-1])
    assert result.q[:, -1] == pytest.approx(q, abs=1e-3)


def test_gamma_left_out_is_differenced():
    result = slide(edge(nonholonomic_gamma=None), rtol=1e-8, atol=1e-8)
    assert result.success, result.message
    assert result.q[:, -1] == pytest.approx(KNIFE_EDGE.motion(result.t[-1])[0], abs=1e-7)


@pytest.mark.parametrize("method", ["DOP853", slow("SunRadau5")])
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

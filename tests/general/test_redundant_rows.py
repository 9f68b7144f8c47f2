"""Rows that follow from others: named once, left out, checked, with multipliers of minimum norm."""

import warnings

import numpy as np
import pytest

from tests.general.faulty import parted_drives
from tests.general.mechanisms import mechanism
from tests.problems import START, pendulum, pendulum_state
from twoloop import ConstraintWarning, consistent_state, solve_dae


def repeated(factor):
    """The pendulum with its row once more, multiplied by a factor."""
    scale = np.array([1.0, factor])
    return pendulum(
        n_c=2,
        constraint=lambda t, q: scale * 0.5 * (q @ q - 1.0),
        jacobian=lambda t, q: np.outer(scale, q),
        gamma=lambda t, q, v: -scale * (v @ v),
    )


@pytest.mark.parametrize("factor", [1.0, 3.0, -0.5])
@pytest.mark.parametrize("method", ["SunRadau5", "Gauss12", "RadauIIA5", "DOP853", "BDF", "Newmark", "PaperIRK"])
def test_a_row_given_twice_shares_the_force(method, factor):
    """Minimum norm: lam (1, factor) / (1 + factor^2) of the one multiplier, which is known in closed form."""
    with pytest.warns(ConstraintWarning, match=r"row\(?s?\)? .*[01]") as caught:
        result = solve_dae(repeated(factor), (0.0, 1.0), *START, method=method, rtol=1e-7, atol=1e-7)
    assert len(caught) == 1
    assert result.success, result.message
    assert result.rank == 1
    assert list(result.redundant) in ([0], [1])
    q, _, lam = pendulum_state(result.t)
    loose = 1e-2 if method in ("Newmark", "PaperIRK") else 1e-4
    assert result.q == pytest.approx(q, abs=loose)
    assert result.lam == pytest.approx(np.outer([1.0, factor], lam) / (1.0 + factor**2), abs=20.0 * loose)
    assert result.lam[1] == pytest.approx(factor * result.lam[0], abs=1e-9)


@pytest.mark.parametrize("method", ["Gauss12", "DOP853"])
def test_rows_that_part_later_end_the_run(method):
    """Both drives agree at the start, and only there: to go on with one of them would be wrong in silence."""
    with pytest.warns(ConstraintWarning):
        result = solve_dae(parted_drives(3), (0.0, 1.0), [0.0, 0.0], [1.0, 1.0], method=method)
    assert not result.success
    assert result.t[-1] < 0.1
    assert "contradict" in result.message
    assert "1" in result.message
    assert "2" in result.message


def test_a_guess_is_projected_on_all_rows():
    m = mechanism("redundant slider-crank")
    q, v = m.start
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        found_q, found_v = consistent_state(m.system(), 0.0, q + 1e-3 * np.cos(np.arange(9)), v)
    assert np.abs(m.system().constraint(0.0, found_q)).max() < 1e-12
    assert np.abs(m.system().velocity_constraint(0.0, found_q, found_v)).max() < 1e-11


def test_velocities_are_projected_on_non_holonomic_rows():
    m = mechanism("wobbling disc")
    q, v = m.start
    found_q, found_v = consistent_state(m.system(), 0.0, q, v + 0.01 * np.cos(np.arange(6)))
    assert found_q == pytest.approx(q, abs=1e-12)
    assert np.abs(m.system().velocity_constraint(0.0, found_q, found_v)).max() < 1e-11
    assert found_v != pytest.approx(v, abs=1e-4)

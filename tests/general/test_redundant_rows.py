"""Rows that follow from others: named once, left out, checked, with multipliers of minimum norm."""

import warnings

import numpy as np
import pytest

from tests.general.faulty import parted_drives
from tests.general.mechanisms import mechanism
from tests.problems import START, held_twice, pendulum_state, some_of
from twoloop import ConstraintWarning, consistent_state, solve_dae


@pytest.mark.parametrize(
    ("method", "factor"),
    some_of(["SunRadau5", "Gauss12", "RadauIIA5", "DOP853", "BDF", "Newmark", "PaperIRK"], [1.0, 3.0, -0.5], 2),
)
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


@pytest.mark.parametrize("method", ["Gauss12", "DOP853"])
def test_rows_that_part_later_end_the_run(method):
    """Both drives agree at the start, and only there: to go on with one of them would be wrong in silence."""
    with pytest.warns(ConstraintWarning):
        result = solve_dae(parted_drives(3), (0.0, 1.0), [0.0, 0.0], [1.0, 1.0], method=method)
    assert not result.success and result.t[-1] < 0.1 and "contradict" in result.message and "1" in result.message
    assert "2" in result.message


@pytest.mark.parametrize(
    ("name", "off_q", "off_v"), [("redundant slider-crank", 1e-3, 0.0), ("wobbling disc", 0.0, 0.01)]
)
def test_a_guess_is_projected_on_all_rows(name, off_q, off_v):
    """Velocities on the non-holonomic ones of the disc, too, whose positions stay."""
    m = mechanism(name)
    system, (q, v), shape = m.system(), m.start, np.cos(np.arange(m.start[0].size))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        found_q, found_v = consistent_state(system, 0.0, q + off_q * shape, v + off_v * shape)
    assert np.abs(system.constraint(0.0, found_q)).max() < 1e-12
    assert np.abs(system.velocity_constraint(0.0, found_q, found_v)).max() < 1e-11
    if off_v:
        assert found_q == pytest.approx(q, abs=1e-12) and found_v != pytest.approx(v, abs=1e-4)

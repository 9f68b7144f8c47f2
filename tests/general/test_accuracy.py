"""Every mechanism to nine digits at a tolerance of 5e-11, against motions that share nothing with the integrator."""

import numpy as np
import pytest

from tests.general.mechanisms import REDUNDANT, REGULAR, mechanism, relative_error, run
from tests.mechanisms.make_references import solution

METHODS = ("Gauss12", "DOP853", "Adams")
DIGITS = {"Adams": 1e-8}  # its errors are up to a hundred times the tolerance
CONSERVATIVE = [name for name in REGULAR if mechanism(name).energy is not None]
# these take seconds each, and Adams' method runs them all; others in space, with redundant rows or with rows of
# velocities do not
LONG = {
    "Gauss12": ("spatial slider-crank", "A05 governor", "A04 Bricard", "wobbling disc, redundant"),
    "DOP853": ("spatial slider-crank", "A05 governor"),
}


def of_each(names):
    """Every method with every mechanism."""
    pairs = [
        pytest.param(name, method, marks=[pytest.mark.slow] * (name in LONG.get(method, ())))
        for name in names
        for method in METHODS
    ]
    return pytest.mark.parametrize(("name", "method"), pairs)


@of_each(REGULAR)
def test_nine_digits(name, method):
    m, (result, _) = mechanism(name), run(name, method)
    assert result.success, result.message
    assert result.t[-1] == m.end
    q, v = m.states(result.t)
    assert relative_error(result.q, q) < DIGITS.get(method, 1e-9)
    assert relative_error(result.v, v) < 2.0 * DIGITS.get(method, 1e-9)


@of_each(REGULAR)
def test_every_state_is_on_all_rows(name, method):
    """Redundant rows too, though they are left out of the solution."""
    system, (result, _) = mechanism(name).system(), run(name, method)
    for t, q, v in zip(result.t, result.q.T, result.v.T, strict=True):
        assert np.abs(system.constraint(t, q)).max(initial=0.0) < 1e-10
        assert np.abs(system.velocity_constraint(t, q, v)).max(initial=0.0) < 1e-9 * max(1.0, np.abs(v).max())


@of_each(CONSERVATIVE)
def test_energy(name, method):
    m, (result, _) = mechanism(name), run(name, method)
    energies = np.array([m.energy(q, v) for q, v in zip(result.q.T, result.v.T, strict=True)])
    kinetic = 0.5 * max(v @ m.system().mass(t, q) @ v for t, q, v in zip(result.t, result.q.T, result.v.T, strict=True))
    assert np.ptp(energies) < 4e-9 * max(1.0, kinetic)


@of_each(REGULAR)
def test_accelerations_and_multipliers_of_minimum_norm(name, method):
    """Against the pseudoinverse of the whole matrix at the known state; lam is [lam; mu]."""
    m, (result, _) = mechanism(name), run(name, method)
    assert result.lam.shape == (m.system().n_c + m.system().n_a, result.t.size)
    known = [solution(m.system(), t, *m.state(t)) for t in result.t]
    assert relative_error(result.a, np.array([a for a, _ in known]).T) < 1e-7
    if result.lam.size:
        assert relative_error(result.lam, np.array([lam for _, lam in known]).T) < 1e-7


@of_each(REGULAR)
def test_rank_and_redundant_rows(name, method):
    """What remains without the rows named must be independent, and as many as the rank."""
    m, (result, warned) = mechanism(name), run(name, method)
    assert result.rank == m.rank and len(result.redundant) == len(result.lam) - m.rank
    kept = np.delete(m.system().rows(0.0, m.start[0]), result.redundant, axis=0)
    assert np.linalg.matrix_rank(kept, tol=1e-9) == m.rank == len(kept)
    assert len(warned) == (1 if name in REDUNDANT else 0)
    for row in result.redundant:
        assert str(row) in warned[0]


def test_a_row_of_velocities_does_not_replace_one_of_positions():
    """The last non-holonomic row of the disc is the derivative of its holonomic one, which must be kept."""
    result, _ = run("wobbling disc, redundant", "DOP853")
    assert list(result.redundant) == [3]

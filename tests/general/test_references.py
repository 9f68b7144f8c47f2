"""Mechanism and reference agree without an integrator: the known motion keeps all rows and the equations of motion."""

import numpy as np
import pytest

from tests.general import dead_points, heavy_top, windows
from tests.general.mechanisms import ALL, mechanism
from tests.mechanisms.make_references import solution
from tests.problems import row_errors, slope

STEP = 1e-3


def step(m):
    """For differences along a motion, which some mechanisms cover in hundredths of a second."""
    return min(STEP, STEP * m.end)


def times(m):
    return np.linspace(0.03, 0.97, 6) * m.end


@pytest.mark.parametrize("name", ALL)
def test_the_known_motion_keeps_all_rows(name):
    m = mechanism(name)
    for t in times(m):
        q, v = m.state(t)
        assert np.abs(m.system().constraint(t, q)).max(initial=0.0) < 1e-11
        assert np.abs(m.system().velocity_constraint(t, q, v)).max(initial=0.0) < 1e-11
        assert np.abs(slope(lambda s, t=t: m.state(t + s)[0], step(m)) - v).max() < 1e-6 * max(1.0, np.abs(v).max())


@pytest.mark.parametrize("name", ALL)
def test_the_known_motion_obeys_the_equations(name):
    """What is left of M a - Q must lie in the rows; a is that of the reference, by differences."""
    m = mechanism(name)
    system = m.system()
    for t in times(m):
        q, v = m.state(t)
        a = slope(lambda s, t=t: m.state(t + s)[1], step(m))
        known, lam = solution(system, t, q, v)
        residual = system.mass(t, q) @ known + system.rows(t, q).T @ lam - system.force(t, q, v)
        assert np.abs(residual).max() < 1e-8 * max(1.0, np.abs(lam).max(initial=0.0))
        assert np.abs(known - a).max() < 1e-7 * max(1.0, np.abs(a).max())


@pytest.mark.parametrize("name", ALL)
def test_derivatives(name):
    """C_q, C_t and Q_d (and those of the non-holonomic rows) against differences, off the motion."""
    m, rng = mechanism(name), np.random.default_rng(7)
    for t in times(m)[::3]:
        q, v = (each + size * rng.normal(size=each.size) for each, size in zip(m.state(t), (0.05, 1.0), strict=True))
        fast = max(1.0, np.abs(v).max())
        by_q, by_t, gamma = row_errors(m.system(), t, q, v, STEP * min(1.0, 10.0 / fast))
        assert by_q < 1e-9 * fast and by_t < 1e-9 and gamma < 1e-7 * fast**2


@pytest.mark.parametrize("name", [name for name in ALL if mechanism(name).energy is not None])
def test_energy_of_the_known_motion(name):
    m = mechanism(name)
    energies = [m.energy(*m.state(t)) for t in times(m)]
    assert np.ptp(energies) < 1e-11 * max(1.0, np.abs(energies).max())


@pytest.mark.parametrize("name", ALL)
def test_rank_at_the_start(name):
    m = mechanism(name)
    assert np.linalg.matrix_rank(m.system().rows(0.0, m.start[0]), tol=1e-9) == m.rank


# --- what is published
def test_the_top_is_the_published_one():
    e, _ = mechanism("top of Euler parameters").state(0.2)
    assert e == pytest.approx(heavy_top.PRINTED, abs=5e-6)


def test_height_of_the_top_by_elliptic_functions():
    m = mechanism("top with its centre")
    t = np.linspace(0.0, heavy_top.KNOWN, 31)
    assert m.states(t)[0][2] == pytest.approx(heavy_top.height(t), abs=1e-11)


def test_two_windows_are_the_published_ones():
    """Exudyn's values at two step sizes, extrapolated: its method is of order 2."""
    tip = mechanism("A02, N = 2").state(10.0)[0][:2]
    coarse, fine = windows.PRINTED_TIP
    assert tip == pytest.approx(fine + (fine - coarse) / 3.0, abs=5e-8)


@pytest.mark.parametrize("n", [1, 2, 40])
def test_windows_lose_a_rank_each(n):
    t = windows.first_singular_time(n)
    m = mechanism(f"A02, N = {n}")
    singular = np.linalg.svd(m.system().rows(t, m.state(t)[0]), compute_uv=False)
    assert (singular < 1e-12).sum() == n and 0.6 < t < 0.8


def test_the_cusp_is_reached_at_unit_speed():
    m = dead_points.cusp()
    assert m.state(0.0)[0] == pytest.approx([1.0, 1.0])
    assert m.state(dead_points.CUSP_TIME)[0] == pytest.approx([0.0, 0.0], abs=1e-12)
    for t in (0.3, 1.2):
        _, v = m.state(t)
        assert np.hypot(*v) == pytest.approx(1.0)
        assert slope(lambda s, t=t: m.state(t + s)[0]) == pytest.approx(v, abs=1e-9)

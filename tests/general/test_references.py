"""Known motions against numbers that others published, and at their singular positions.

That they are motions of the mechanisms: tests/general/test_accuracy.py and test_singular_positions.py.
"""

import numpy as np
import pytest

from tests.general import dead_points, heavy_top
from tests.general.mechanisms import PRINTED_TIP, first_singular_time, mechanism
from tests.problems import slope


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
    coarse, fine = PRINTED_TIP
    assert tip == pytest.approx(fine + (fine - coarse) / 3.0, abs=5e-8)


@pytest.mark.parametrize("n", [1, 2, 40])
def test_windows_lose_a_rank_each(n):
    t = first_singular_time(n)
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

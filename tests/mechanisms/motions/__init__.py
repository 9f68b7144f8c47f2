"""Motions of the ready mechanisms by equations that share nothing with their callbacks, in any floating-point type."""

from functools import cache

from tests.mechanisms.motions import planar, spatial
from twoloop import mechanisms

CLOSED_CHAINS = (2, 4, 5, 10, 20)


@cache
def known_motions():
    """Name to problem, motion and the end of the motion, for all without a closed form."""
    cases = [
        (mechanisms.double_pendulum(), planar.double_pendulum(), 3.0),
        *((mechanisms.closed_chain(n), planar.closed_chain(n), 1.0) for n in CLOSED_CHAINS),
        (mechanisms.redundant_slider_crank(), planar.slider_crank(), 2.0),
        (mechanisms.driven_crank(), planar.driven_crank(), 3.0),
        (mechanisms.sundials_slider_crank(), planar.sundials_slider_crank(), 10.0),
        (mechanisms.andrews(), planar.andrews(), 0.03),
        (mechanisms.heavy_top(), spatial.heavy_top(), 0.2),
        (mechanisms.rolling_disc(), spatial.rolling_disc(), 2.0),
        (mechanisms.bricard(), spatial.bricard(), 2.0),
        (mechanisms.spatial_slider_crank(), spatial.spatial_slider_crank(), 2.0),
        (mechanisms.spatial_four_bar(), spatial.spatial_four_bar(), 2.0),
        (mechanisms.governor(), spatial.governor(), 1.0),
    ]
    return {problem.name: (problem, motion, end) for problem, motion, end in cases}


@cache
def closed_forms():
    """Name to problem and motion, for those with a closed form and an equation to integrate."""
    cases = [
        (mechanisms.pendulum(), planar.a01()),
        (mechanisms.projection_pendulum(), planar.projection_pendulum()),
        (mechanisms.n_four_bar(1), planar.a02(1)),
        (mechanisms.n_four_bar(2), planar.a02(2)),
        (mechanisms.n_four_bar(2, "bodies"), planar.a02(2, bodies=True)),
        (mechanisms.n_four_bar(40), planar.a02(40)),
        (mechanisms.knife_edge(), spatial.knife_edge()),
    ]
    return {problem.name: (problem, motion) for problem, motion in cases}

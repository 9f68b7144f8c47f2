"""All mechanisms with a known motion, by name, each made once."""

from functools import cache, partial

from tests.general import dead_points, disc, faulty, heavy_top, knife_edge, planet, slider_crank, windows
from tests.general.mechanism import known, of_problem
from tests.mechanisms.motions import known_motions

WINDOWS = (1, 2, 40)
# name -> how it is made; motion that never comes near a point where C_q loses rank
REGULAR = {
    "redundant slider-crank": slider_crank.redundant_slider_crank,
    "top of Euler parameters": heavy_top.top_of_euler_parameters,
    "top with its centre": heavy_top.top_with_centre,
    "knife edge": knife_edge.knife_edge,
    "knife edge in space": knife_edge.knife_edge_in_space,
    "pushed knife edge": knife_edge.pushed_knife_edge,
    "steady disc": disc.steady_disc,
    "wobbling disc": disc.wobbling_disc,
    "wobbling disc, redundant": partial(disc.wobbling_disc, True),
    "driven slider-crank": partial(slider_crank.driven_slider_crank, False),
    "driven slider-crank, redundant": partial(slider_crank.driven_slider_crank, True),
    "massless coordinate": faulty.massless_coordinate,
    "planet": planet.planet,
}
# the ready mechanisms that have no other place above; of Bricard's 60 rows, one is redundant
ELSEWHERE = ("redundant slider-crank", "heavy top", "rolling disc", "closed chain of 10", "closed chain of 20")
RANKS = {"A04 Bricard": 59}


def _ready(name):
    problem, motion, end = known_motions()[name]
    return of_problem(problem, known(motion, end), end, RANKS.get(name))


REGULAR |= {name: partial(_ready, name) for name in known_motions() if name not in ELSEWHERE}
# rank is lost on the way, and the motion goes on
SINGULAR = {
    **{f"A02, N = {n}": partial(windows.windows, n) for n in WINDOWS},
    **{f"A02 of bodies, N = {n}": partial(windows.windows_of_bodies, n) for n in (1, 2)},
    "isosceles slider-crank": dead_points.isosceles_slider_crank,
    "crossing lines": dead_points.crossing_lines,
}
ALL = {**REGULAR, **SINGULAR}
REDUNDANT = [name for name in REGULAR if "redundant" in name or name in RANKS]


@cache
def mechanism(name):
    return ALL[name]()

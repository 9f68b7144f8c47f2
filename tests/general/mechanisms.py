"""All mechanisms with a known motion, by name, each built once; runs of them, and their errors."""

import warnings
from functools import cache, partial

import numpy as np
from scipy.optimize import brentq

from tests.general import systems
from tests.general.mechanism import Mechanism, known, of_functions, of_problem
from tests.mechanisms.motions import known_motions, planar, spatial
from tests.problems import functions_of, unconstrained
from twoloop import ConstraintWarning, mechanisms, solve_dae
from twoloop.mechanisms import n_four_bar


def planet(eccentricity=0.2):
    """No row at all, so that the motion is an ordinary second-order equation. Closed form."""

    def state(t):
        E = t
        for _ in range(50):  # Kepler's equation, by Newton
            E -= (E - eccentricity * np.sin(E) - t) / (1.0 - eccentricity * np.cos(E))
        b, rate = np.sqrt(1.0 - eccentricity**2), 1.0 / (1.0 - eccentricity * np.cos(E))
        return np.array([np.cos(E) - eccentricity, b * np.sin(E)]), rate * np.array([-np.sin(E), b * np.cos(E)])

    system = unconstrained(lambda t, q, v: -q / (q[0] * q[0] + q[1] * q[1]) ** 1.5, 2, name="planet")
    energy = lambda q, v: 0.5 * v @ v - 1.0 / np.hypot(q[0], q[1])  # noqa: E731
    return Mechanism("planet", lambda: system, 3.0, state, rank=0, energy=energy)


# --- the slider-crank with a redundant row, which says once more, and not linearly, how far pin and slider are apart
DRIVEN = mechanisms.driven_slider_crank()


def redundant_slider_crank():
    """The ready mechanism."""
    return of_problem(mechanisms.redundant_slider_crank(), known(planar.slider_crank(), 2.0), 2.0, rank=8)


def driven_slider_crank(redundant):
    """No freedom is left: the motion is the drive's. With redundant=True there are ten rows for nine coordinates."""
    if not redundant:
        return of_problem(DRIVEN, DRIVEN.motion, 2.0)
    free, driven = mechanisms.redundant_slider_crank().system, DRIVEN.system

    def joined(kind):  # the last row of the other is the drive
        of_free, of_driven = getattr(free, kind), getattr(driven, kind)
        return lambda *state: np.concatenate([of_free(*state), of_driven(*state)[-1:]])

    rows = {kind: joined(kind) for kind in ("constraint", "jacobian", "constraint_rate", "gamma")}
    system = of_functions(n_q=9, n_c=10, **functions_of(free) | rows)
    return Mechanism("driven slider-crank, redundant", system, 2.0, DRIVEN.motion, rank=9)


def windows(n, coordinates="tips"):
    return of_problem(n_four_bar(n, coordinates), known(planar.a02(n, bodies=coordinates == "bodies"), 10.0), 10.0)


def first_singular_time(n):
    """When the cranks first lie on the ground line, to rounding."""
    return float(brentq(lambda t: n_four_bar(n).motion.crank(t)[0], 0.5, 1.0, xtol=1e-15))


WINDOWS = (1, 2, 40)
# name -> how it is made; motion that never comes near a point where C_q loses rank
REGULAR = {
    "redundant slider-crank": redundant_slider_crank,
    "top with its centre": lambda: of_problem(mechanisms.heavy_top(), known(spatial.heavy_top(), 0.1), 0.1),
    "knife edge": lambda: of_problem(systems.KNIFE_EDGE, known(spatial.knife_edge(), 2.0), 2.0),
    "pushed knife edge": systems.pushed_knife_edge,
    "wobbling disc": systems.wobbling_disc,
    "wobbling disc, redundant": partial(systems.wobbling_disc, True),
    "driven slider-crank": partial(driven_slider_crank, False),
    "driven slider-crank, redundant": partial(driven_slider_crank, True),
    "massless coordinate": systems.massless_coordinate,
    "planet": planet,
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
    **{f"A02, N = {n}": partial(windows, n) for n in WINDOWS},
    **{f"A02 of bodies, N = {n}": partial(windows, n, "bodies") for n in (1, 2)},
    "crossing lines": systems.crossing_lines,
}
ALL = {**REGULAR, **SINGULAR, "A02 of bodies, N = 40": partial(windows, 40, "bodies")}
REDUNDANT = [name for name in REGULAR if "redundant" in name or name in RANKS]


@cache
def mechanism(name):
    return ALL[name]()


TOLERANCE = 5e-11


@cache
def run(name, method, tolerance=TOLERANCE, times=41):
    """A run, and the warnings about its rows."""
    m = mechanism(name)
    with warnings.catch_warnings(record=True, action="always") as caught:
        times = np.linspace(0.0, m.end, times)
        options = {"rtol": tolerance, "atol": tolerance, "t_eval": times, "max_steps": 100_000}
        result = solve_dae(m.system(), (0.0, m.end), *m.start, method, **options)
    return result, [str(each.message) for each in caught if issubclass(each.category, ConstraintWarning)]


def relative_error(values, reference):
    """Largest difference over the largest value, or over 1 where that is less."""
    return np.abs(values - reference).max() / max(1.0, np.abs(reference).max())


def error(m, result):
    """The larger of the relative errors of positions and velocities over the run."""
    q, v = m.states(result.t)
    return max(relative_error(result.q, q), relative_error(result.v, v))

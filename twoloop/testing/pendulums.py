"""Problems of point masses on links: pendulums, chains, a parallelogram, and two whose motion ends."""

import math

import numpy as np

from twoloop.testing.known_motions import posed
from twoloop.testing.known_problem import KnownProblem
from twoloop.testing.point_equations import DrivenPoint, EndingForce, Place, PointEquations, ShakenPoints

GRAVITY = 9.81  # m/s^2


def pendulum() -> KnownProblem:
    """A point of 1 kg on a link of 1 m, released from the horizontal; period known in closed form."""
    equations = PointEquations([1.0], [[0.0, -GRAVITY]], [(0, (0.0, 0.0), 1.0)])
    note = "the simplest constrained motion: what is wrong here is the method"
    # 4 sqrt(l / g) K(sin(45 degrees)), Landau & Lifshitz, Mechanics, Sect. 11
    period, start = 4.0 * math.sqrt(1.0 / GRAVITY) * 1.8540746773013719, ([-1.0, 0.0], [0.0, 0.0])
    return posed("pendulum", equations, start, 4.0, "smoke, open chain, planar", note=note, period=period)


def _double_pendulum(name: str, masses: list[float], end: float, tags: str, note: str) -> KnownProblem:
    weight = [[0.0, -GRAVITY * mass] for mass in masses]
    equations = PointEquations(masses, weight, [(0, (0.0, 0.0), 1.0), (1, 0, 1.0)])
    return posed(name, equations, ([1.0, 0.0, 2.0, 0.0], np.zeros(4)), end, tags, note=note)


def double_pendulum() -> KnownProblem:
    """Two equal masses on links of 1 m, released level."""
    note = "two degrees of freedom; errors grow with the motion, which is chaotic"
    return _double_pendulum("double_pendulum", [0.5, 0.5], 2.0, "open chain, planar", note)


def heavy_end() -> KnownProblem:
    """A double pendulum, the lower mass 1000 times the upper one."""
    note = "a light body that carries a heavy one: what divides by small masses loses digits here"
    return _double_pendulum("heavy_end", [0.001, 1.0], 0.8, "mass ratio, open chain, planar", note)


def spherical_pendulum() -> KnownProblem:
    """A point of 1 kg on a link of 1 m in space, with an initial horizontal velocity."""
    equations = PointEquations([1.0], [[0.0, 0.0, -GRAVITY]], [(0, (0.0, 0.0, 0.0), 1.0)])
    start = [0.6, 0.0, -0.8], [0.4, 1.5, 0.3]
    kept = {"vertical angular momentum": lambda t, q, v: float(q[0] * v[1] - q[1] * v[0])}
    note = "energy and the angular momentum about the vertical are kept"
    return posed("spherical_pendulum", equations, start, 4.0, "open chain, spatial", invariants=kept, note=note)


def closed_chain() -> KnownProblem:
    """Four masses on five links of 0.2 m between pins 0.8 m apart, released from an asymmetric polygon."""
    links: list[tuple[int, Place, float]] = [(0, (0.0, 0.0), 0.2), (3, (0.8, 0.0), 0.2)]
    links[1:1] = [(i, i - 1, 0.2) for i in (1, 2, 3)]
    equations = PointEquations(np.full(4, 0.25), [[0.0, -GRAVITY / 4.0]] * 4, links)
    low, high = 1e-6, math.pi / 5.0
    while high - low > 1e-16 and low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if math.sin(5.0 * middle) > 4.0 * math.sin(middle) else (low, middle)
    angles = (2.0 * np.arange(5) - 4.0) * low
    angles[:2] = angles[1::-1]
    places = np.cumsum(0.2 * np.column_stack([np.cos(angles), np.sin(angles)]), axis=0)[:4]
    note = "a loop with three degrees of freedom"
    return posed("closed_chain", equations, (places.ravel(), np.zeros(8)), 1.0, "closed chain, planar", note=note)


def stiff_spring_pendulum() -> KnownProblem:
    """A pendulum with a small mass on a spring with an eigenfrequency of about 1000 rad/s."""
    equations = PointEquations(
        [1.0, 0.1], [[0.0, -GRAVITY], [0.0, -0.1 * GRAVITY]], [(0, (0.0, 0.0), 1.0)], [(1, 0, 1e5, 0.5)]
    )
    note = "a vibration of 1 mm and less, 150 times as fast as the motion"
    start = [1.0, 0.0, 1.5, 0.0], np.zeros(4)
    return posed("stiff_spring_pendulum", equations, start, 1.0, "stiff, open chain, planar", note=note)


def shaken_spring() -> KnownProblem:
    """A pendulum with a mass of 0.5 kg on a spring, excited by 3 sin(4 t) N from t = 0.5 s."""
    equations = ShakenPoints(
        3.0, 4.0, [1.0, 0.5], [[0.0, -GRAVITY], [0.0, -0.5 * GRAVITY]], [(0, (0.0, 0.0), 1.0)], [(1, 0, 40.0, 0.6)]
    )
    note = "forces that depend on positions and on time; and the motion does not begin at t = 0"
    start, tags = ([0.6, -0.8, 0.6, -1.5], np.zeros(4)), "smoke, open chain, planar"
    return posed("shaken_spring", equations, start, 2.5, tags, begin=0.5, energy=None, note=note)


def parallelogram() -> KnownProblem:
    """Two upright cranks of 1 m with a coupler of 1 m, which are collinear twice per turn."""
    mass = np.array([[2.0, 0.5], [0.5, 2.0]]) / 3.0  # uniform bars of 1 kg, in the velocities of their ends
    links: list[tuple[int, Place, float]] = [(0, (0.0, 0.0), 1.0), (1, (1.0, 0.0), 1.0), (1, 0, 1.0)]
    equations = PointEquations(mass, [[0.0, -GRAVITY]] * 2, links)
    start, tags = ([0.0, 1.0, 1.0, 1.0], [1.0, 0.0, 1.0, 0.0]), "singular, closed chain, planar"
    note = "passes its change points, where C_q loses rank and another branch of motion begins"
    return posed("parallelogram", equations, start, 2.0, tags, note=note, singular_times=(0.70845001, 1.21526181))


def out_of_reach() -> KnownProblem:
    """A point on a link of 1 m whose height is driven to 1 m and beyond."""
    equations, note = DrivenPoint(1.0, 0.2, 0.5, GRAVITY), "the drive asks for what the link cannot reach"
    x0, tags = math.sqrt(1.0 - 0.2**2), "smoke, no motion to the end, driven, planar"
    start = [x0, 0.2], [-0.1 / x0, 0.5]
    return posed("out_of_reach", equations, start, 2.0, tags, energy=None, ends=1.6, note=note)


def force_ends() -> KnownProblem:
    """A pendulum with a drag that is NaN after 1 s."""
    equations = EndingForce(1.0, [1.0], [[0.0, -GRAVITY]], [(0, (0.0, 0.0), 1.0)])
    note = "a force that is not a number from some time on"
    start, tags = ([1.0, 0.0], [0.0, 0.0]), "no motion to the end, open chain, planar"
    return posed("force_ends", equations, start, 2.0, tags, energy=None, ends=1.0, note=note)

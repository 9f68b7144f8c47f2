"""The mechanisms with known motions, by name and by tag.

The motions are in `known_motions.npz`, which tests/testing/make_motions.py writes.
"""

import cmath
import math
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.testing.equations import (
    GROUND,
    DrivenPoint,
    EndingForce,
    Place,
    PlanarEquations,
    PointEquations,
    ShakenPoints,
    SpatialEquations,
    planar_state,
    rod_inertias,
)
from twoloop.testing.problem import Array, KnownProblem, Motion

FILE = Path(__file__).with_name("known_motions.npz")
N_TIMES = 101  # equidistant times of a motion
GRAVITY = 9.81  # m/s^2


@cache
def load_motion(name: str) -> Motion | None:
    """Return the motion of a problem, read-only; None if no motion is stored."""
    with np.load(FILE, allow_pickle=False) as file:
        if f"{name}/t" not in file:
            return None
        arrays = {key: file[f"{name}/{key}"] for key in ("t", "q", "v", "lam", "digits", "growth")}
    for array in arrays.values():
        array.flags.writeable = False
    digits = dict(zip(("q", "v", "lam"), arrays.pop("digits").astype(float), strict=True))
    return Motion(**arrays, digits=digits)


def make_problem(
    name: str, equations: Any, start: tuple[Any, Any], end: float, tags: str, begin: float = 0.0, **fields: Any
) -> KnownProblem:
    """Return a problem with its known motion; `tags` are separated by commas."""
    names = ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma", "energy", "coordinates")
    terms: dict[str, Any] = {term: getattr(equations, term) for term in names}
    terms["row_powers"] = np.array(equations.row_powers)
    terms["parameters"] = {key: np.array(value, dtype=float) for key, value in equations.parameters.items()}
    terms |= {"reference": load_motion(name), "tags": tuple(tags.split(", ")), "t_span": (begin, end)}
    return KnownProblem(name=name, q0=start[0], v0=start[1], **terms | equations.parts | fields)


def pendulum() -> KnownProblem:
    """A point of 1 kg on a link of 1 m, released from the horizontal; period known in closed form."""
    equations = PointEquations([1.0], [[0.0, -GRAVITY]], [(0, (0.0, 0.0), 1.0)])
    note = "the simplest constrained motion: what is wrong here is the method"
    # 4 sqrt(l / g) K(sin(45 degrees)), Landau & Lifshitz, Mechanics, Sect. 11
    period, start = 4.0 * math.sqrt(1.0 / GRAVITY) * 1.8540746773013719, ([-1.0, 0.0], [0.0, 0.0])
    return make_problem("pendulum", equations, start, 4.0, "smoke, open chain, planar", note=note, period=period)


def _double_pendulum(name: str, masses: list[float], end: float, tags: str, note: str) -> KnownProblem:
    weight = [[0.0, -GRAVITY * mass] for mass in masses]
    equations = PointEquations(masses, weight, [(0, (0.0, 0.0), 1.0), (1, 0, 1.0)])
    return make_problem(name, equations, ([1.0, 0.0, 2.0, 0.0], np.zeros(4)), end, tags, note=note)


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
    invariants = {"vertical angular momentum": lambda t, q, v: float(q[0] * v[1] - q[1] * v[0])}
    note = "energy and the angular momentum about the vertical are kept"
    tags = "open chain, spatial"
    return make_problem("spherical_pendulum", equations, start, 4.0, tags, invariants=invariants, note=note)


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
    start, note = (places.ravel(), np.zeros(8)), "a loop with three degrees of freedom"
    return make_problem("closed_chain", equations, start, 1.0, "closed chain, planar", note=note)


def stiff_spring_pendulum() -> KnownProblem:
    """A pendulum with a small mass on a spring with an eigenfrequency of about 1000 rad/s."""
    equations = PointEquations(
        [1.0, 0.1], [[0.0, -GRAVITY], [0.0, -0.1 * GRAVITY]], [(0, (0.0, 0.0), 1.0)], [(1, 0, 1e5, 0.5)]
    )
    note = "a vibration of 1 mm and less, 150 times as fast as the motion"
    start = [1.0, 0.0, 1.5, 0.0], np.zeros(4)
    return make_problem("stiff_spring_pendulum", equations, start, 1.0, "stiff, open chain, planar", note=note)


def shaken_spring() -> KnownProblem:
    """A pendulum with a mass of 0.5 kg on a spring, excited by 3 sin(4 t) N from t = 0.5 s."""
    equations = ShakenPoints(
        3.0, 4.0, [1.0, 0.5], [[0.0, -GRAVITY], [0.0, -0.5 * GRAVITY]], [(0, (0.0, 0.0), 1.0)], [(1, 0, 40.0, 0.6)]
    )
    note = "forces that depend on positions and on time; and the motion does not begin at t = 0"
    start, tags = ([0.6, -0.8, 0.6, -1.5], np.zeros(4)), "smoke, open chain, planar"
    return make_problem("shaken_spring", equations, start, 2.5, tags, begin=0.5, energy=None, note=note)


def parallelogram() -> KnownProblem:
    """Two upright cranks of 1 m with a coupler of 1 m, which are collinear twice per turn."""
    mass = np.array([[2.0, 0.5], [0.5, 2.0]]) / 3.0  # uniform bars of 1 kg, in the velocities of their ends
    links: list[tuple[int, Place, float]] = [(0, (0.0, 0.0), 1.0), (1, (1.0, 0.0), 1.0), (1, 0, 1.0)]
    equations = PointEquations(mass, [[0.0, -GRAVITY]] * 2, links)
    start, tags = ([0.0, 1.0, 1.0, 1.0], [1.0, 0.0, 1.0, 0.0]), "singular, closed chain, planar"
    note = "passes its change points, where C_q loses rank and another branch of motion begins"
    times = 0.70845001, 1.21526181
    return make_problem("parallelogram", equations, start, 2.0, tags, note=note, singular_times=times)


def out_of_reach() -> KnownProblem:
    """A point on a link of 1 m whose height is driven to 1 m and beyond."""
    equations, note = DrivenPoint(1.0, 0.2, 0.5, GRAVITY), "the drive asks for what the link cannot reach"
    x0, tags = math.sqrt(1.0 - 0.2**2), "smoke, no motion to the end, driven, planar"
    start = [x0, 0.2], [-0.1 / x0, 0.5]
    return make_problem("out_of_reach", equations, start, 2.0, tags, energy=None, ends=1.6, note=note)


def force_ends() -> KnownProblem:
    """A pendulum with a drag that is NaN after 1 s."""
    equations = EndingForce(1.0, [1.0], [[0.0, -GRAVITY]], [(0, (0.0, 0.0), 1.0)])
    note = "a force that is not a number from some time on"
    start, tags = ([1.0, 0.0], [0.0, 0.0]), "no motion to the end, open chain, planar"
    return make_problem("force_ends", equations, start, 2.0, tags, energy=None, ends=1.0, note=note)


# Andrews' squeezing mechanism: seven bodies and three loops that share a joint, driven by a constant torque. Angles
# beta, Theta, gamma, Phi, delta, Omega, epsilon and constants as in Hairer & Wanner, Solving Ordinary Differential
# Equations II, Sect. VII.7, and the Test Set for IVP Solvers, "andrews"
MASSES = np.array([0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498])  # kg
INERTIAS = np.array([2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5])  # kg m^2
A, B, C = np.array([-0.06934, -0.00227]), np.array([-0.03635, 0.03273]), np.array([0.014, 0.072])  # m
STIFFNESS, UNSTRESSED, TORQUE = 4530.0, 0.07785, 0.033  # N/m, m, N m
START = np.array(
    [
        *(-0.0617138900142764496358948458001, 0.0, 0.455279819163070380255912382449),
        *(0.222668390165885884674473185609, 0.487364979543842550225598953530),
        *(-0.222668390165885884674473185609, 1.23054744454982119249735015568),
    ]
)
ANGLE_SUMS = np.eye(7)  # rows: the angles whose sum is the angle of a body
ANGLE_SUMS[[1, 3, 5], [0, 4, 6]] = 1.0

# each point is a sum of vectors (body, x, y) in body axes, starting at the ground points (0, 0), B, A, A
SHARED = [(0, 0.007, 0.0), (1, -0.028, 0.0)]  # the joint shared by the loops
LOOPS = [(B, [(2, 0.0, -0.035)]), (A, [(3, 0.0, -0.02), (4, 0.04, 0.0)]), (A, [(5, 0.02, 0.0), (6, 0.0, -0.04)])]
CENTRES = [  # centres of mass, as sums of vectors
    [(0, 0.00092, 0.0)],
    [(0, 0.007, 0.0), (1, -0.0115, 0.0)],
    [(2, 0.01874, 0.01043)],
    [(4, 0.04, 0.0), (3, 0.0, -(0.02 - 0.01421))],
    [(4, 0.02308, 0.00916)],
    [(6, 0.0, -0.04), (5, 0.02 - 0.01421, 0.0)],
    [(6, 0.01228, -0.00449)],
]
SPRING = [(2, 0.02, -0.018)]  # attachment point on body 3


def rotated_parts(angles: Array, parts: list[tuple[int, float, float]]) -> Array:
    """Return the parts (n_parts, 2) of a point, each rotated with its body."""
    s, c = np.sin(angles), np.cos(angles)
    return np.array([[c[i] * x - s[i] * y, s[i] * x + c[i] * y] for i, x, y in parts])


def point_jacobian(angles: Array, parts: list[tuple[int, float, float]]) -> Array:
    """Return the derivative (2, 7) of the sum of the parts with respect to the seven angles."""
    perpendicular = rotated_parts(angles, parts) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    return perpendicular.T @ ANGLE_SUMS[[part[0] for part in parts]]


def centripetal_acceleration(angles: Array, rates: Array, parts: list[tuple[int, float, float]]) -> Array:
    """Return the second time derivative (2,) of the sum of the parts at constant angular velocities."""
    return -(rates[[part[0] for part in parts]] ** 2) @ rotated_parts(angles, parts)


class AndrewsEquations:
    """Andrews' mechanism as published; terms follow from centres of mass, sums of vectors rotated by sums of angles."""

    coordinates = ("angle", *("relative", "angle") * 3)
    row_powers = (1.0,) * 6
    parts: Mapping[str, Any] = {}  # bodies and joints are not given
    parameters: Mapping[str, Any] = {
        **{"masses": MASSES, "inertias": INERTIAS, "torque": TORQUE},
        **{"spring_stiffnesses": [STIFFNESS], "spring_lengths": [UNSTRESSED]},
    }

    def mass(self, t: float, q: Array) -> Array:
        """Return M (7, 7)."""
        angles = ANGLE_SUMS @ q
        M = ANGLE_SUMS.T @ (INERTIAS[:, None] * ANGLE_SUMS)
        for m, parts in zip(MASSES, CENTRES, strict=True):
            J = point_jacobian(angles, parts)
            M += m * J.T @ J
        return M

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (7,): torque, spring, and velocity terms."""
        angles, rates = ANGLE_SUMS @ q, ANGLE_SUMS @ v
        Q = TORQUE * np.eye(7)[0]
        for m, parts in zip(MASSES, CENTRES, strict=True):
            Q -= m * point_jacobian(angles, parts).T @ centripetal_acceleration(angles, rates, parts)
        arm = self._spring(angles)
        length = np.linalg.norm(arm)
        return Q - STIFFNESS * (length - UNSTRESSED) / length * point_jacobian(angles, SPRING).T @ arm

    def _spring(self, angles: Array) -> Array:
        return B + rotated_parts(angles, SPRING).sum(axis=0) - C

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (6,)."""
        angles = ANGLE_SUMS @ q
        shared = rotated_parts(angles, SHARED).sum(axis=0)
        return np.concatenate([shared - ground - rotated_parts(angles, parts).sum(axis=0) for ground, parts in LOOPS])

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (6, 7)."""
        angles = ANGLE_SUMS @ q
        shared = point_jacobian(angles, SHARED)
        return np.vstack([shared - point_jacobian(angles, parts) for _, parts in LOOPS])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (6,), zero."""
        return np.zeros(6)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (6,) of C_q a = gamma."""
        angles, rates = ANGLE_SUMS @ q, ANGLE_SUMS @ v
        shared = centripetal_acceleration(angles, rates, SHARED)
        return np.concatenate([centripetal_acceleration(angles, rates, parts) - shared for _, parts in LOOPS])

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic energy plus the potentials of the spring and the constant torque, J."""
        stretch = np.linalg.norm(self._spring(ANGLE_SUMS @ q)) - UNSTRESSED
        return float(0.5 * v @ self.mass(t, q) @ v + 0.5 * STIFFNESS * stretch**2 - TORQUE * q[0])


def _pinned_rods(lengths: list[float], masses: list[float], ground: float) -> PlanarEquations:
    """Return rods in a chain from the origin to a ground joint on the x axis."""
    equations = PlanarEquations(masses, rod_inertias(lengths, masses), GRAVITY)
    equations.pin(0, (-0.5 * lengths[0], 0.0), GROUND, (0.0, 0.0))
    for i in range(1, len(lengths)):
        equations.pin(i, (-0.5 * lengths[i], 0.0), i - 1, (0.5 * lengths[i - 1], 0.0))
    equations.pin(len(lengths) - 1, (0.5 * lengths[-1], 0.0), GROUND, (ground, 0.0))
    return equations


def _chain_state(lengths: list[float], angles: list[float]) -> Array:
    """Return the coordinates of rods in a chain starting at the origin."""
    states, end = [], 0j
    for length, angle in zip(lengths, angles, strict=True):
        states.append((end + cmath.rect(0.5 * length, angle), angle))
        end += cmath.rect(length, angle)
    return planar_state(*states)


def _dyad_angles(tip: complex, ground: float, second: float, third: float) -> list[float]:
    """Return the angles of two rods from a tip to a ground joint, with their joint above the connecting line."""
    gap = ground - tip
    corner = math.acos((second**2 + abs(gap) ** 2 - third**2) / (2.0 * second * abs(gap)))
    angle = cmath.phase(gap) + corner
    return [angle, cmath.phase(gap - cmath.rect(second, angle))]


def _state_at_rate(equations: PlanarEquations, q0: Array, coordinate: int, rate: float) -> tuple[Array, Array]:
    """Return an initial state of a mechanism with one degree of freedom, with a given rate of one coordinate."""
    direction = np.linalg.svd(equations.jacobian(0.0, q0))[2][-1]
    return q0, direction * (rate / direction[coordinate])


def four_bar() -> KnownProblem:
    """Uniform rods of 1, 2 and 1.5 m and 1 kg/m on 3 m of ground, released with the third one level."""
    lengths = [1.0, 2.0, 1.5]
    equations = _pinned_rods(lengths, lengths, 3.0)
    # joint 2-3 is at (1.5, 0), joint 1-2 below it
    first = -math.acos((1.0 + 2.25 - 4.0) / 3.0)
    second = cmath.phase(1.5 - cmath.rect(1.0, first))
    q0 = _chain_state(lengths, [first, second, 0.0])
    note = "one loop that swings; which coordinates are independent must change"
    start, period = (q0, np.zeros(9)), 2.24898591982587  # by Gauss12 and DOP853 at 1e-13
    return make_problem("four_bar", equations, start, 4.0, "smoke, closed chain, planar", note=note, period=period)


def crank_rocker() -> KnownProblem:
    """Uniform rods of 0.5, 1.5 and 1.2 m and 1 kg/m on 1.6 m of ground, the crank turning at 12 rad/s at the start."""
    lengths = [0.5, 1.5, 1.2]
    equations = _pinned_rods(lengths, lengths, 1.6)
    q0 = _chain_state(lengths, [1.0, *_dyad_angles(cmath.rect(0.5, 1.0), 1.6, 1.5, 1.2)])
    start, note = _state_at_rate(equations, q0, 2, 12.0), "the crank turns around, its angle grows beyond a turn"
    return make_problem("crank_rocker", equations, start, 2.0, "closed chain, planar", note=note)


def _slider_equations() -> PlanarEquations:
    masses = [1.0, 1.5, 0.8]
    equations = PlanarEquations(masses, [*rod_inertias([0.5, 1.2], masses[:2]), 0.02], GRAVITY)
    equations.pin(0, (-0.25, 0.0), GROUND, (0.0, 0.0))
    equations.pin(1, (-0.6, 0.0), 0, (0.25, 0.0))
    equations.pin(2, (0.0, 0.0), 1, (0.6, 0.0))
    equations.slide(2)
    return equations


def _slider_start(angle: float, rate: float) -> tuple[Array, Array]:
    tilt = -math.asin(0.5 * math.sin(angle) / 1.2)
    q0 = _chain_state([0.5, 1.2, 0.0], [angle, tilt, 0.0])
    q0[7] = 0.0  # exactly on the line
    return _state_at_rate(_slider_equations(), q0, 2, rate)


def slider_crank() -> KnownProblem:
    """A crank of 0.5 m and a rod of 1.2 m, the crank turning at 8 rad/s at the start."""
    equations, start = _slider_equations(), _slider_start(0.5, 8.0)
    note = "eight rows for nine coordinates"
    return make_problem("slider_crank", equations, start, 2.0, "closed chain, planar", note=note)


def redundant_slider_crank() -> KnownProblem:
    """The slider-crank with a dependent ninth row, the distance of its pins."""
    equations, start = _slider_equations(), _slider_start(0.5, 8.0)
    equations.distance(2, (0.0, 0.0), 0, (0.25, 0.0), 1.2)
    tags = "smoke, redundant, closed chain, planar"
    note = "multipliers are not unique; the forces of the constraints, C_q^T lam, are"
    return make_problem("redundant_slider_crank", equations, start, 2.0, tags, note=note)


def _crank_drive(start: float, rate: float, amplitude: float, frequency: float) -> Any:
    return (
        lambda t: start + rate * t + amplitude * math.sin(frequency * t),
        lambda t: rate + amplitude * frequency * math.cos(frequency * t),
        lambda t: -amplitude * frequency**2 * math.sin(frequency * t),
    )


def driven_slider_crank() -> KnownProblem:
    """The slider-crank with prescribed crank angle 0.5 + 4 t + 0.3 sin(3 t) from t = 0.5 s: no degree of freedom."""
    equations, drive = _slider_equations(), _crank_drive(0.5, 4.0, 0.3, 3.0)
    equations.drive(0, drive)
    note = "as many rows as coordinates: everything is C_t and gamma; and the motion does not begin at t = 0"
    start, tags = _slider_start(drive[0](0.5), drive[1](0.5)), "driven, closed chain, planar"
    return make_problem("driven_slider_crank", equations, start, 2.0, tags, begin=0.5, energy=None, note=note)


def driven_crank() -> KnownProblem:
    """A rod of 1 m hanging from the pin of a crank of 0.3 m, which is driven at the angle 2.5 t + 0.2 sin(t)."""
    masses = [0.4, 1.0]
    equations = PlanarEquations(masses, rod_inertias([0.3, 1.0], masses), GRAVITY)
    equations.pin(0, (-0.15, 0.0), GROUND, (0.0, 0.0))
    equations.pin(1, (-0.5, 0.0), 0, (0.15, 0.0))
    equations.drive(0, _crank_drive(0.0, 2.5, 0.2, 1.0))
    angle, tip_rate = 0.4 - 0.5 * math.pi, 2.7j * 0.3
    q0 = _chain_state([0.3, 1.0], [0.0, angle])
    v0 = planar_state((0.5 * tip_rate, 2.7), (tip_rate - 1j * cmath.rect(0.5, angle), -1.0))
    note = "C_t and its derivative act on the free part; the drive does work"
    tags = "smoke, driven, open chain, planar"
    return make_problem("driven_crank", equations, (q0, v0), 3.0, tags, energy=None, note=note)


def andrews() -> KnownProblem:
    """Andrews' squeezing mechanism from rest."""
    note = "three loops, a mass matrix that varies, angular velocities of 1000 rad/s"
    return make_problem("andrews", AndrewsEquations(), (START, np.zeros(7)), 0.03, "closed chain, planar", note=note)


def heavy_top() -> KnownProblem:
    """A top of 15 kg with a fixed point, its axis initially level, spinning at 150 rad/s about it."""
    equations = SpatialEquations((0.0, 0.0, -GRAVITY))
    spin, centre = np.array([0.0, 150.0, -4.61538]), np.array([0.0, 1.0, 0.0])
    body = equations.body(15.0, (0.234375, 0.46875, 0.234375), centre, np.eye(3), np.cross(spin, centre), spin)
    equations.spherical(body, GROUND, (0.0, 0.0, 0.0))
    invariants = {"vertical angular momentum": equations.vertical_momentum}
    tags, note = "smoke, open chain, spatial", "a mass matrix of rank 6 of 7; a fast spin beside a slow precession"
    return make_problem("heavy_top", equations, equations.start, 0.2, tags, invariants=invariants, note=note)


def spatial_four_bar() -> KnownProblem:
    """A spatial four-bar: crank and rocker on hinges about z and y, coupler on two ball joints; crank at 5 rad/s."""
    up, y, D = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.9, 0.0, 0.3])
    P, P_v = np.array([0.3, 0.0, 0.0]), np.array([0.0, 1.5, 0.0])
    S, tip_per_rate = D + np.array([0.0, 0.0, 0.7]), np.array([-0.7, 0.0, 0.0])
    bar = S - P
    rate = (bar @ P_v) / (bar @ tip_per_rate)  # rate of the rocker, from x towards z
    S_v, length = rate * tip_per_rate, float(np.linalg.norm(bar))
    spin = np.cross(bar, S_v - P_v) / length**2  # no rotation about its own axis
    equations = SpatialEquations((0.0, 0.0, -GRAVITY))
    crank = equations.body(0.6, _bar_inertia(0.6, 0.3), 0.5 * P, _frame(P, up), 0.5 * P_v, 5.0 * up)
    coupler = equations.body(1.0, _bar_inertia(1.0, length), 0.5 * (P + S), _frame(bar, y), 0.5 * (P_v + S_v), spin)
    rocker = equations.body(0.8, _bar_inertia(0.8, 0.7), 0.5 * (D + S), _frame(S - D, y), 0.5 * S_v, -rate * y)
    equations.revolute(crank, GROUND, np.zeros(3), up)
    equations.spherical(coupler, crank, P)
    equations.spherical(rocker, coupler, S)
    equations.revolute(rocker, GROUND, D, y)
    note = "21 coordinates and 19 rows; the coupler may turn about its axis, which nothing else feels"
    return make_problem("spatial_four_bar", equations, equations.start, 1.0, "closed chain, spatial", note=note)


def _bar_inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Return the principal moments of a bar of 0.02 m radius along its first axis, kg m^2."""
    transverse = mass * (length**2 / 12.0 + 0.02**2 / 4.0)
    return 0.5 * mass * 0.02**2, transverse, transverse


def _frame(bar: Array, up: Array) -> Array:
    """Return a rotation matrix whose first column is along a bar, and the second perpendicular to `up` and it."""
    x = bar / np.linalg.norm(bar)
    y = np.cross(up, x)
    y = y / np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


TAGS = {
    "smoke": "a few that together take little time",
    "open chain": "no loop of bodies",
    "closed chain": "loops of bodies",
    "planar": "in a plane",
    "spatial": "in space",
    "driven": "constraints that depend on time",
    "redundant": "a row of C follows from the others",
    "singular": "C_q loses rank on the way",
    "stiff": "a vibration far faster than the motion",
    "mass ratio": "masses that differ by a factor of 1000",
    "no motion to the end": "the motion ends before the end of the span, which a simulator must report",
}

MAKERS = {
    maker.__name__: maker
    for maker in (
        *(pendulum, shaken_spring, driven_crank, four_bar, redundant_slider_crank, heavy_top, out_of_reach),
        *(double_pendulum, heavy_end, spherical_pendulum, stiff_spring_pendulum, closed_chain, parallelogram),
        *(crank_rocker, slider_crank, driven_slider_crank, andrews, spatial_four_bar, force_ends),
    )
}


def problems(tags: str | Iterable[str] | None = None) -> list[KnownProblem]:
    """Return problems with known motions in plain numpy, to test a simulator.

    Parameters
    ----------
    tags : str or sequence of str, optional
        Tags of `KnownProblem.tags` that the problems must have. None: all problems.

    Returns
    -------
    list of KnownProblem
        Problems with equations, initial state, and the known motion `reference`.

    Raises
    ------
    ValueError
        If a tag is unknown.

    Notes
    -----
    The motions in the wheel were computed by two different methods, whose agreement is stored in `Motion.digits`:
    twoloop's Gauss method, and SciPy's DOP853 on equations in minimal coordinates, or on the index-1 equations with
    projection.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> [problem.name for problem in problems("driven")]
    ['driven_crank', 'out_of_reach', 'driven_slider_crank']
    """
    selected_tags = as_list("tags", () if tags is None else tags)
    for tag in selected_tags:
        if tag not in TAGS:
            raise ValueError(f"tags must be of {', '.join(TAGS)}; given {tag!r}")
    return [problem for maker in MAKERS.values() if set(selected_tags) <= set((problem := maker()).tags)]


def select_problems(choice: str | KnownProblem | Iterable[str | KnownProblem]) -> list[KnownProblem]:
    """Return the problems selected by "smoke", "all", a name, or names and problems."""
    if isinstance(choice, str) and choice in ("smoke", "all"):
        return problems("smoke" if choice == "smoke" else None)
    selection: list[KnownProblem] = []
    for item in [choice] if isinstance(choice, KnownProblem) else as_list("problems", choice):
        if isinstance(item, KnownProblem):
            selection.append(item)
        elif isinstance(item, str) and item in MAKERS:
            selection.append(MAKERS[item]())
        else:
            raise ValueError(f"problems must be 'smoke', 'all' or of {', '.join(MAKERS)}; given {item!r}")
    if not selection:
        raise ValueError("problems must name at least one; given an empty list, on which everything would pass")
    return selection


def as_list(name: str, given: Any) -> list[Any]:
    """Return the elements of a list, or a single text as a list."""
    if not isinstance(given, Iterable):
        raise TypeError(f"{name} must be a list; given {given!r}")
    return [given] if isinstance(given, str) else list(given)

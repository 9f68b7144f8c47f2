"""Planar rigid-body problems: four-bars, slider-cranks, a driven crank, Andrews' mechanism."""

import cmath
import math
from typing import Any

import numpy as np

from twoloop.testing.andrews_equations import START, AndrewsEquations
from twoloop.testing.known_motions import posed
from twoloop.testing.known_problem import Array, KnownProblem
from twoloop.testing.planar_equations import GROUND, PlanarEquations, bodies, rods

GRAVITY = 9.81  # m/s^2


def _pinned(rods_: list[float], masses: list[float], ground: float) -> PlanarEquations:
    """Return rods in a chain from the origin to a ground joint on the x axis."""
    equations = PlanarEquations(masses, rods(rods_, masses), GRAVITY)
    equations.pin(0, (-0.5 * rods_[0], 0.0), GROUND, (0.0, 0.0))
    for i in range(1, len(rods_)):
        equations.pin(i, (-0.5 * rods_[i], 0.0), i - 1, (0.5 * rods_[i - 1], 0.0))
    equations.pin(len(rods_) - 1, (0.5 * rods_[-1], 0.0), GROUND, (ground, 0.0))
    return equations


def _chained(lengths: list[float], angles: list[float]) -> Array:
    """Return the coordinates of rods in a chain starting at the origin."""
    states, end = [], 0j
    for length, angle in zip(lengths, angles, strict=True):
        states.append((end + cmath.rect(0.5 * length, angle), angle))
        end += cmath.rect(length, angle)
    return bodies(*states)


def _two_rods(tip: complex, ground: float, second: float, third: float) -> list[float]:
    """Return the angles of two rods from a tip to a ground joint, with their joint above the connecting line."""
    gap = ground - tip
    corner = math.acos((second**2 + abs(gap) ** 2 - third**2) / (2.0 * second * abs(gap)))
    angle = cmath.phase(gap) + corner
    return [angle, cmath.phase(gap - cmath.rect(second, angle))]


def _moving(equations: PlanarEquations, q0: Array, coordinate: int, rate: float) -> tuple[Array, Array]:
    """Return an initial state of a mechanism with one degree of freedom, with a given rate of one coordinate."""
    along = np.linalg.svd(equations.jacobian(0.0, q0))[2][-1]
    return q0, along * (rate / along[coordinate])


def four_bar() -> KnownProblem:
    """Uniform rods of 1, 2 and 1.5 m and 1 kg/m on 3 m of ground, released with the third one level."""
    lengths = [1.0, 2.0, 1.5]
    equations = _pinned(lengths, lengths, 3.0)
    # joint 2-3 is at (1.5, 0), joint 1-2 below it
    first = -math.acos((1.0 + 2.25 - 4.0) / 3.0)
    second = cmath.phase(1.5 - cmath.rect(1.0, first))
    q0 = _chained(lengths, [first, second, 0.0])
    note = "one loop that swings; which coordinates are independent must change"
    start, period = (q0, np.zeros(9)), 2.24898591982587  # by Gauss12 and DOP853 at 1e-13
    return posed("four_bar", equations, start, 4.0, "smoke, closed chain, planar", note=note, period=period)


def crank_rocker() -> KnownProblem:
    """Uniform rods of 0.5, 1.5 and 1.2 m and 1 kg/m on 1.6 m of ground, the crank turning at 12 rad/s at the start."""
    lengths = [0.5, 1.5, 1.2]
    equations = _pinned(lengths, lengths, 1.6)
    q0 = _chained(lengths, [1.0, *_two_rods(cmath.rect(0.5, 1.0), 1.6, 1.5, 1.2)])
    note = "the crank turns around, its angle grows beyond a turn"
    return posed("crank_rocker", equations, _moving(equations, q0, 2, 12.0), 2.0, "closed chain, planar", note=note)


def _slider_rows() -> PlanarEquations:
    masses = [1.0, 1.5, 0.8]
    equations = PlanarEquations(masses, [*rods([0.5, 1.2], masses[:2]), 0.02], GRAVITY)
    equations.pin(0, (-0.25, 0.0), GROUND, (0.0, 0.0))
    equations.pin(1, (-0.6, 0.0), 0, (0.25, 0.0))
    equations.pin(2, (0.0, 0.0), 1, (0.6, 0.0))
    equations.slide(2)
    return equations


def _slider_start(angle: float, rate: float) -> tuple[Array, Array]:
    tilt = -math.asin(0.5 * math.sin(angle) / 1.2)
    q0 = _chained([0.5, 1.2, 0.0], [angle, tilt, 0.0])
    q0[7] = 0.0  # exactly on the line
    return _moving(_slider_rows(), q0, 2, rate)


def slider_crank() -> KnownProblem:
    """A crank of 0.5 m and a rod of 1.2 m, the crank turning at 8 rad/s at the start."""
    equations, start = _slider_rows(), _slider_start(0.5, 8.0)
    note = "eight rows for nine coordinates"
    return posed("slider_crank", equations, start, 2.0, "closed chain, planar", note=note)


def redundant_slider_crank() -> KnownProblem:
    """The slider-crank with a dependent ninth row, the distance of its pins."""
    equations, start = _slider_rows(), _slider_start(0.5, 8.0)
    equations.distance(2, (0.0, 0.0), 0, (0.25, 0.0), 1.2)
    tags = "smoke, redundant, closed chain, planar"
    note = "multipliers are not unique; the forces of the constraints, C_q^T lam, are"
    return posed("redundant_slider_crank", equations, start, 2.0, tags, note=note)


def _turning(start: float, rate: float, amplitude: float, frequency: float) -> Any:
    return (
        lambda t: start + rate * t + amplitude * math.sin(frequency * t),
        lambda t: rate + amplitude * frequency * math.cos(frequency * t),
        lambda t: -amplitude * frequency**2 * math.sin(frequency * t),
    )


def driven_slider_crank() -> KnownProblem:
    """The slider-crank with prescribed crank angle 0.5 + 4 t + 0.3 sin(3 t) from t = 0.5 s: no degree of freedom."""
    equations, drive = _slider_rows(), _turning(0.5, 4.0, 0.3, 3.0)
    equations.drive(0, drive)
    note = "as many rows as coordinates: everything is C_t and gamma; and the motion does not begin at t = 0"
    start, tags = _slider_start(drive[0](0.5), drive[1](0.5)), "driven, closed chain, planar"
    return posed("driven_slider_crank", equations, start, 2.0, tags, begin=0.5, energy=None, note=note)


def driven_crank() -> KnownProblem:
    """A rod of 1 m hanging from the pin of a crank of 0.3 m, which is driven at the angle 2.5 t + 0.2 sin(t)."""
    masses = [0.4, 1.0]
    equations = PlanarEquations(masses, rods([0.3, 1.0], masses), GRAVITY)
    equations.pin(0, (-0.15, 0.0), GROUND, (0.0, 0.0))
    equations.pin(1, (-0.5, 0.0), 0, (0.15, 0.0))
    equations.drive(0, _turning(0.0, 2.5, 0.2, 1.0))
    angle, tip_rate = 0.4 - 0.5 * math.pi, 2.7j * 0.3
    q0 = _chained([0.3, 1.0], [0.0, angle])
    v0 = bodies((0.5 * tip_rate, 2.7), (tip_rate - 1j * cmath.rect(0.5, angle), -1.0))
    note = "C_t and its derivative act on the free part; the drive does work"
    return posed("driven_crank", equations, (q0, v0), 3.0, "smoke, driven, open chain, planar", energy=None, note=note)


def andrews() -> KnownProblem:
    """Andrews' squeezing mechanism from rest."""
    note = "three loops, a mass matrix that varies, angular velocities of 1000 rad/s"
    return posed("andrews", AndrewsEquations(), (START, np.zeros(7)), 0.03, "closed chain, planar", note=note)

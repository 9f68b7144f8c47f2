"""Define slider-cranks of three planar bodies, with a redundant row or driven, and a pendulum on a driven crank.

Coordinates are x, y and angle of each body. The redundant row is the distance of the crank pin from the slider, which
equals the length of the rod.
"""

import cmath
import math

import numpy as np

from twoloop.mechanisms.planar import GROUND, PlanarBodies, states
from twoloop.mechanisms.registry import ready
from twoloop.problem.description import body_names
from twoloop.problem.problem import Array, Problem, Reference

GRAVITY = 9.81
CRANK, ROD = 0.5, 1.2  # m
MASSES = (1.0, 1.5, 0.8)  # kg
INERTIAS = (MASSES[0] * CRANK**2 / 12.0, MASSES[1] * ROD**2 / 12.0, 0.02)  # kg m^2
PARAMETERS = {"crank": CRANK, "rod": ROD, "masses": MASSES, "inertias": INERTIAS, "gravity": GRAVITY}
BODIES = ("crank", "rod", "slider")
NAMES = body_names(*BODIES)
ANGLE, RATE = 0.5, 8.0  # of the free crank at the start, rad and rad/s
DRIVE = {"start": 0.5, "rate": 4.0, "amplitude": 0.3, "frequency": 3.0}
SOURCE = "textbook mechanism; dimensions and start were chosen for this project"


def _rows(redundant: bool) -> PlanarBodies:
    rows = PlanarBodies(BODIES, MASSES, INERTIAS, GRAVITY)
    rows.pin(0, (-0.5 * CRANK, 0.0), GROUND, (0.0, 0.0))
    rows.pin(1, (-0.5 * ROD, 0.0), 0, (0.5 * CRANK, 0.0))
    rows.pin(2, (0.0, 0.0), 1, (0.5 * ROD, 0.0))
    rows.drive(7, 0.0)
    rows.drive(8, 0.0)
    if redundant:
        rows.distance(2, (0.0, 0.0), 0, (0.5 * CRANK, 0.0), ROD)
    return rows


def _states(angle: float, rate: float, acceleration: float = 0.0) -> tuple[Array, Array, Array]:
    """Return coordinates, velocities and accelerations (9,) for an angle of the crank, from the triangle."""
    pin = cmath.rect(CRANK, angle)
    pin_v, pin_a = 1j * rate * pin, (1j * acceleration - rate**2) * pin
    tilt = -math.asin(pin.imag / ROD)
    turn = -pin_v.imag / (ROD * math.cos(tilt))
    turn_a = (turn**2 * math.sin(tilt) - pin_a.imag / ROD) / math.cos(tilt)
    half = cmath.rect(0.5 * ROD, tilt)
    half_v, half_a = 1j * turn * half, (1j * turn_a - turn**2) * half
    return (
        states((0.5 * pin, angle), (pin + half, tilt), (pin + 2.0 * half, 0.0)),
        states((0.5 * pin_v, rate), (pin_v + half_v, turn), (pin_v + 2.0 * half_v, 0.0)),
        states((0.5 * pin_a, acceleration), (pin_a + half_a, turn_a), (pin_a + 2.0 * half_a, 0.0)),
    )


def redundant_slider_crank() -> Problem:
    """Return the slider-crank with nine rows of rank eight, moving freely under gravity; the crank starts at 8 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import redundant_slider_crank
    >>> problem = redundant_slider_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (9, 9, 2.0)
    """
    rows = _rows(True)
    q0, v0, _ = _states(ANGLE, RATE)
    return ready(
        *(rows, "redundant slider-crank", q0, v0, 2.0),
        conserved=True,
        parameters=PARAMETERS,
        source=SOURCE,
        tags=("closed chain", "rigid", "planar", "redundant"),
        purpose=(
            "Whether a row that follows from the others is found and left out; the rows are too many for an LU of the "
            "whole matrix, and the multipliers are those of least norm."
        ),
        coordinates=NAMES,
    )


def _driven_states(t: float) -> tuple[Array, Array, Array]:
    """Return coordinates, velocities and accelerations (9,) of the driven slider-crank, which the drive determines."""
    start, rate, amplitude, frequency = DRIVE.values()
    s, c = math.sin(frequency * t), math.cos(frequency * t)
    return _states(start + rate * t + amplitude * s, rate + amplitude * frequency * c, -amplitude * frequency**2 * s)


def driven_motion(t: float) -> tuple[Array, Array]:
    """Return the states q, v (9,) of the driven slider-crank at t."""
    return _driven_states(t)[:2]


def driven_slider_crank() -> Problem:
    """Return the slider-crank with the crank angle 0.5 + 4 t + 0.3 sin(3 t): nine rows for nine coordinates.

    Examples
    --------
    >>> from twoloop.mechanisms import driven_slider_crank
    >>> problem = driven_slider_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (9, 9, 2.0)
    """
    rows = _rows(False)
    rows.drive(2, **DRIVE)
    q0, v0 = driven_motion(0.0)
    q, v, a = _driven_states(2.0)
    system = rows.system("driven slider-crank")
    force = np.tile([0.0, -GRAVITY, 0.0], 3) * np.repeat(MASSES, 3)
    inertia = np.column_stack([MASSES, MASSES, INERTIAS]).ravel()
    lam = np.linalg.solve(system.jacobian(2.0, q).T, force - inertia * a)
    return ready(
        *(rows, "driven slider-crank", q0, v0, 2.0),
        system=system,
        parameters={**PARAMETERS, "drive": DRIVE},
        reference=Reference(
            t=2.0,
            q=q,
            v=v,
            lam=lam,
            source="closed form, from the triangle; multipliers by a linear solve with it",
            digits={"q": 14.0, "v": 14.0, "lam": 13.0},
            verified="positions by the law of cosines, velocities by differences, the drive's torque by its power",
        ),
        motion=driven_motion,
        source=SOURCE,
        tags=("closed chain", "rigid", "planar", "driven"),
        purpose=(
            "Constraints that depend on time and leave no freedom: everything is C_t and Q_d, and the last multiplier "
            "is the torque of the drive."
        ),
        conserved=False,
        coordinates=NAMES,
    )


def driven_crank() -> Problem:
    """Return a pendulum on a crank at 2.5 t + 0.2 sin(t) rad; it starts 0.4 rad off the vertical at -1 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import driven_crank
    >>> problem = driven_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (6, 5, 3.0)
    """
    crank, rod = 0.3, 1.0  # m
    masses = (0.4, 1.0)  # kg
    inertias = (masses[0] * crank**2 / 12.0, masses[1] * rod**2 / 12.0)  # kg m^2
    drive = {"start": 0.0, "rate": 2.5, "amplitude": 0.2, "frequency": 1.0}
    angle, rate = 0.4 - 0.5 * np.pi, -1.0  # of the pendulum at the start, from the x axis, rad and rad/s
    rows = PlanarBodies(("crank", "rod"), masses, inertias, GRAVITY)
    rows.pin(0, (-0.5 * crank, 0.0), GROUND, (0.0, 0.0))
    rows.pin(1, (-0.5 * rod, 0.0), 0, (0.5 * crank, 0.0))
    rows.drive(2, **drive)
    crank_rate = drive["rate"] + drive["amplitude"] * drive["frequency"]
    pin, half = complex(crank), cmath.rect(0.5 * rod, angle)
    pin_v = 1j * crank_rate * pin
    q0 = states((0.5 * pin, 0.0), (pin + half, angle))
    v0 = states((0.5 * pin_v, crank_rate), (pin_v + 1j * rate * half, rate))
    return ready(
        *(rows, "driven crank", q0, v0, 3.0),
        parameters={
            "crank": crank,
            "rod": rod,
            "masses": masses,
            "inertias": inertias,
            "gravity": GRAVITY,
            "drive": drive,
        },
        source=SOURCE,
        tags=("open chain", "rigid", "planar", "driven"),
        purpose=(
            "A constraint that depends on time beside a motion that is free: C_t and C_tt act on the free part, and "
            "the energy is not conserved."
        ),
        conserved=False,
        coordinates=body_names("crank", "rod"),
    )

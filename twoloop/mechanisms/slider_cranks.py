"""Define slider-cranks: with a redundant row, driven, and the example of SUNDIALS; and a pendulum on a driven crank.

Coordinates are x, y and angle of each body, but for the example of SUNDIALS. The redundant row is the distance of the
crank pin from the slider, which equals the length of the rod.
"""

import cmath
import math
from typing import Any

import numpy as np

from twoloop.kernels.compile.callbacks import callback
from twoloop.mechanisms.planar import GROUND, PlanarBodies, states
from twoloop.mechanisms.registry import ready, stored_reference
from twoloop.problem.callbacks import callbacks_in
from twoloop.problem.description import Drawing, body_names
from twoloop.problem.problem import Array, Problem, Reference
from twoloop.problem.system import ConstrainedSystem

GRAVITY = 9.81
CRANK, ROD = 0.5, 1.2  # m
MASSES = (1.0, 1.5, 0.8)  # kg
INERTIAS = (MASSES[0] * CRANK**2 / 12.0, MASSES[1] * ROD**2 / 12.0, 0.02)  # kg m^2
DIMENSIONS = {"crank": CRANK, "rod": ROD, "masses": MASSES, "inertias": INERTIAS, "gravity": GRAVITY}
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
        parameters=DIMENSIONS,
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
        parameters={**DIMENSIONS, "drive": DRIVE},
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


# p = [a, J1, m2, J2, k, c, l0, F]: half of the crank's length over the rod's, and so on; all in units of the example
PARAMETERS = {"a": 0.5, "J1": 1.0, "m2": 1.0, "J2": 2.0, "k": 1.0, "c": 1.0, "l0": 1.0, "F": 1.0}


@callback("mass")
def mass(t, q, p, M):
    M[0, 0], M[1, 1], M[2, 2] = p[1], p[2], p[3]


@callback("force")
def force(t, q, v, p, Q):
    a, s1, c1, s2, c2 = p[0], math.sin(q[0]), math.cos(q[0]), math.sin(q[2]), math.cos(q[2])
    # the spring connects the midpoints of crank and rod
    x, y = q[1] - 0.5 * (c2 + a * c1), -0.5 * (s2 + a * s1)
    xv, yv = v[1] + 0.5 * (s2 * v[2] + a * s1 * v[0]), -0.5 * (c2 * v[2] + a * c1 * v[0])
    length = math.hypot(x, y)
    pull = (p[4] * (length - p[6]) + p[5] * (x * xv + y * yv) / length) / length
    Q[0] = -0.5 * pull * a * (x * s1 - y * c1)
    Q[1] = -pull * x + p[7]
    Q[2] = -0.5 * pull * (x * s2 - y * c2) - p[7] * s2


@callback("constraint")
def constraint(t, q, p, C):
    C[0] = q[1] - math.cos(q[2]) - p[0] * math.cos(q[0])
    C[1] = -math.sin(q[2]) - p[0] * math.sin(q[0])


@callback("jacobian")
def jacobian(t, q, p, Cq):
    Cq[0, 0], Cq[0, 1], Cq[0, 2] = p[0] * math.sin(q[0]), 1.0, math.sin(q[2])
    Cq[1, 0], Cq[1, 2] = -p[0] * math.cos(q[0]), -math.cos(q[2])


@callback("gamma")
def gamma(t, q, v, p, Qd):
    crank, rod = p[0] * v[0] ** 2, v[2] ** 2
    Qd[0] = -crank * math.cos(q[0]) - rod * math.cos(q[2])
    Qd[1] = -crank * math.sin(q[0]) - rod * math.sin(q[2])


def energy(t: Any, q: Array, v: Array) -> Any:
    """Return kinetic energy, spring energy and the potential of F, which a damper dissipates, for one state or many."""
    q, v = np.asarray(q), np.asarray(v)
    a, J1, m2, J2, k, _, l0, F = PARAMETERS.values()
    x = q[1] - 0.5 * (np.cos(q[2]) + a * np.cos(q[0]))
    length = np.hypot(x, 0.5 * (np.sin(q[2]) + a * np.sin(q[0])))
    kinetic = 0.5 * (J1 * v[0] ** 2 + m2 * v[1] ** 2 + J2 * v[2] ** 2)
    return kinetic + 0.5 * k * (length - l0) ** 2 - F * (q[1] + np.cos(q[2]))


def joints(q: Array) -> Array:
    """Return crank centre, crank pin, slider, and both ends of the spring: (5, 2) or (5, 2, n_t)."""
    zero = np.zeros_like(q[0])
    pin = PARAMETERS["a"] * np.stack([np.cos(q[0]), np.sin(q[0])])
    slider = np.stack([q[1], zero])
    return np.stack([np.stack([zero, zero]), pin, slider, 0.5 * pin, 0.5 * (pin + slider)])


def sundials_slider_crank() -> Problem:
    """Return the slider-crank of SUNDIALS' example released from rest with its crank upright, over 10 s.

    Examples
    --------
    >>> from twoloop.mechanisms import sundials_slider_crank
    >>> problem = sundials_slider_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (3, 2, 10.0)
    """
    tilt = math.asin(-PARAMETERS["a"])
    system = ConstrainedSystem(
        n_q=3,
        n_c=2,
        **callbacks_in(globals()),
        parameters=list(PARAMETERS.values()),
        constant_mass=True,
        name="SUNDIALS slider-crank",
    )
    return Problem(
        name="SUNDIALS slider-crank",
        system=system,
        q0=np.array([0.5 * math.pi, math.cos(tilt), tilt]),
        v0=np.zeros(3),
        t_span=(0.0, 10.0),
        energy=energy,
        drawing=Drawing(joints, ((0, 1), (1, 2), (3, 4)), (1, 4)),
        parameters=PARAMETERS,
        reference=stored_reference("SUNDIALS slider-crank"),
        published=Reference(
            t=10.0,
            q=np.array([1.2757, 1.0236, -0.49881]),
            v=np.full(3, np.nan),
            source="LLNL/sundials, idaSlCrank_dns.out (rtol = atol = 1e-6), five printed digits",
            digits={"q": 4.4},
            verified="one degree of freedom, in extended precision: off by 4.3e-5 at most over the printed times",
        ),
        source="LLNL/sundials, examples/ida/serial/idaSlCrank_dns.c, there in a stabilised form of index 2",
        tags=("closed chain", "rigid", "planar", "dissipative"),
        purpose="A closed loop with a spring-damper and a constant force: forces that depend on velocities.",
        conserved=False,
        coordinates=("crank angle (rad)", "slider position (m)", "rod angle (rad)"),
    )

"""A pendulum on the pin of a crank with prescribed angle; one degree of freedom.

Coordinates x, y, angle of the crank, a rod of 0.3 m pinned at its end, and of the pendulum, a uniform rod of 1 m.
"""

import cmath

import numpy as np

from twoloop.mechanisms.planar import GROUND, PlanarBodies, states
from twoloop.mechanisms.ready import ready
from twoloop.problem.description import body_names
from twoloop.problem.problem import Problem

GRAVITY = 9.81
CRANK, ROD = 0.3, 1.0  # m
MASSES = (0.4, 1.0)  # kg
INERTIAS = (MASSES[0] * CRANK**2 / 12.0, MASSES[1] * ROD**2 / 12.0)  # kg m^2
DRIVE = {"start": 0.0, "rate": 2.5, "amplitude": 0.2, "frequency": 1.0}
ANGLE, RATE = 0.4 - 0.5 * np.pi, -1.0  # initial angle of the pendulum from the x axis, rad, and its rate, rad/s


def driven_crank() -> Problem:
    """The crank at the angle 2.5 t + 0.2 sin(t); the pendulum starts 0.4 rad off the vertical at -1 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import driven_crank
    >>> problem = driven_crank()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (6, 5, 3.0)
    """
    rows = PlanarBodies(("crank", "rod"), MASSES, INERTIAS, GRAVITY)
    rows.pin(0, (-0.5 * CRANK, 0.0), GROUND, (0.0, 0.0))
    rows.pin(1, (-0.5 * ROD, 0.0), 0, (0.5 * CRANK, 0.0))
    rows.drive(2, **DRIVE)
    turn = DRIVE["rate"] + DRIVE["amplitude"] * DRIVE["frequency"]
    pin, half = complex(CRANK), cmath.rect(0.5 * ROD, ANGLE)
    pin_v = 1j * turn * pin
    q0 = states((0.5 * pin, 0.0), (pin + half, ANGLE))
    v0 = states((0.5 * pin_v, turn), (pin_v + 1j * RATE * half, RATE))
    return ready(
        *(rows, "driven crank", q0, v0, 3.0),
        parameters={
            "crank": CRANK,
            "rod": ROD,
            "masses": MASSES,
            "inertias": INERTIAS,
            "gravity": GRAVITY,
            "drive": DRIVE,
        },
        source="textbook mechanism; dimensions and start were chosen for this project",
        tags=("open chain", "rigid", "planar", "driven"),
        purpose=(
            "A constraint that depends on time beside a motion that is free: C_t and C_tt act on the free part, and "
            "the energy is not conserved."
        ),
        conserved=False,
        coordinates=body_names("crank", "rod"),
    )

"""IFToMM's A05, Watt's flyball governor whose coupler rods are stiff spring-dampers."""

import math
from typing import Any

import numpy as np

from twoloop.bodies.spatial_model import SpatialModel
from twoloop.mechanisms.momentum import Momentum
from twoloop.mechanisms.ready import ready_model
from twoloop.problem.problem import Problem

GRAVITY = 9.81  # m/s^2, along -z
DENSITY = 3000.0  # kg/m^3
LENGTH, WIDTH, CUBE = 1.0, 0.01, 0.1  # m: shaft and rods; slider
BALL = 5.0  # kg, at the end of each rod
ANGLE = math.radians(30.0)  # initial angle of the rods below the horizontal
HEIGHT = 0.5  # m, initial height of the slider
STIFFNESS, DAMPING, SLACK = 8e5, 4e4, 0.5  # N/m, N s/m, m
RATE = 2.0 * math.pi  # initial angular velocity, rad/s


def box(mass: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Principal moments of a box, kg m^2."""
    return mass * (y * y + z * z) / 12.0, mass * (x * x + z * z) / 12.0, mass * (x * x + y * y) / 12.0


def governor() -> Problem:
    """The stiff version: springs of 8e5 N/m, dampers of 4e4 N s/m, initial angular velocity 2 pi rad/s.

    Two models of Exudyn are a different problem, with springs of 4000 N/m and 0.16 of that angular velocity.

    Examples
    --------
    >>> from twoloop.mechanisms import governor
    >>> problem = governor()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (28, 24, 10.0)
    """
    z, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    spin = RATE * z
    model, turning = SpatialModel(-GRAVITY * z, name="A05 governor"), {"angular_velocity": spin}
    bar, cube = DENSITY * LENGTH * WIDTH**2, DENSITY * CUBE**3
    moments = box(bar, WIDTH, WIDTH, LENGTH), box(cube, CUBE, CUBE, CUBE)
    still: dict[str, Any] = {"velocity": (0.0, 0.0, 0.0), **turning}
    model.body("shaft", mass=bar, inertia=moments[0], position=0.5 * LENGTH * z, **still)
    model.body("slider", mass=cube, inertia=moments[1], position=HEIGHT * z, **still)
    model.revolute("shaft", "ground", at=(0.0, 0.0, 0.0), axis=z)
    model.prismatic("shaft", "slider", at=HEIGHT * z, axis=z)
    centre = (0.5 * bar + BALL) * LENGTH / (bar + BALL)  # centre of mass of rod and ball, from the hinge
    axial, across, _ = box(bar, LENGTH, WIDTH, WIDTH)
    across += bar * (centre - 0.5 * LENGTH) ** 2 + BALL * (LENGTH - centre) ** 2
    for name, side in (("rod A", 1.0), ("rod B", -1.0)):
        along = np.array([side * math.cos(ANGLE), 0.0, -math.sin(ANGLE)])
        hinge = np.array([side * 0.5 * CUBE, 0.0, LENGTH])
        position = hinge + centre * along
        R = np.column_stack([along, side * y, np.cross(along, side * y)])
        pose = {"position": position, "rotation": R, "velocity": np.cross(spin, position), **turning}
        model.body(name, mass=bar + BALL, inertia=(axial, across, across), **pose)
        model.revolute(name, "shaft", at=hinge, axis=y)
        ends = np.array([side * 0.5 * CUBE, 0.0, HEIGHT]), name, hinge + 0.5 * LENGTH * along
        model.spring("slider", *ends, stiffness=STIFFNESS, damping=DAMPING, length=SLACK)
    bodies = np.array([[bar, *moments[0]], [cube, *moments[1]], *2 * [[bar + BALL, axial, across, across]]])
    return ready_model(
        *(model, 10.0),
        parameters={"stiffness": STIFFNESS, "damping": DAMPING, "rate": RATE, "gravity": GRAVITY},
        source=(
            "IFToMM library of benchmarks, A05; RehabEngGroup/MBSbenchmarksInOpenSim, A05_FlyballGovernor.rst; "
            "jgerstmayr/EXUDYN, Examples/stiffFlyballGovernorKT.py"
        ),
        tags=("closed chain", "rigid", "spatial", "stiff", "dissipative"),
        purpose=(
            "Stiffness by force elements: dampers of time constants of 0.1 ms beside an oscillation of about a second. "
            "The angular momentum about the shaft is kept, and the energy never grows."
        ),
        conserved=False,
        invariants={"angular momentum about the shaft (kg m^2/s)": Momentum(bodies, np.zeros(3), z)},
    )

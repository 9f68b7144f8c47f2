"""A spatial four-bar linkage, RSSR: crank and rocker on non-parallel hinges, coupler on two ball joints.

The crank rotates about z through the origin, the rocker about y through D. The rotation of the coupler about its own
axis is a second, decoupled degree of freedom.
"""

import math

import numpy as np

from twoloop.bodies.spatial_model import SpatialModel
from twoloop.mechanisms.ready import ready_model
from twoloop.problem.problem import Array, Problem

GRAVITY = 9.81  # m/s^2, along -z
CRANK, ROCKER = 0.3, 0.7  # m
D = np.array([0.9, 0.0, 0.3])  # m
START = (0.0, 0.5 * math.pi)  # initial angles of crank (from x) and rocker (from x, towards z)
RATE = 5.0  # initial rate of the crank, rad/s
MASSES = {"crank": 0.6, "coupler": 1.0, "rocker": 0.8}  # kg
RADIUS = 0.02  # m, of all three round bars


def inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Return the principal moments of a round bar along its first axis, kg m^2."""
    across = mass * (length**2 / 12.0 + RADIUS**2 / 4.0)
    return 0.5 * mass * RADIUS**2, across, across


def frame(along: Array, up: Array) -> Array:
    """Return a rotation matrix whose first column is along a bar, and the second perpendicular to `up` and it."""
    x = along / np.linalg.norm(along)
    y = np.cross(up, x)
    y = y / np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])


def spatial_four_bar() -> Problem:
    """The RSSR linkage under gravity, its crank initially level and rotating at 5 rad/s.

    Examples
    --------
    >>> from twoloop.mechanisms import spatial_four_bar
    >>> problem = spatial_four_bar()
    >>> problem.system.n_q, problem.system.n_c, problem.t_span[1]
    (21, 19, 2.0)
    """
    theta, phi = START
    P = CRANK * np.array([math.cos(theta), math.sin(theta), 0.0])
    P_v = CRANK * RATE * np.array([-math.sin(theta), math.cos(theta), 0.0])
    arm = ROCKER * np.array([math.cos(phi), 0.0, math.sin(phi)])
    turned = ROCKER * np.array([-math.sin(phi), 0.0, math.cos(phi)])
    bar = D + arm - P
    phi_rate = (bar @ P_v) / (bar @ turned)
    S, S_v = D + arm, phi_rate * turned
    length = float(np.linalg.norm(bar))
    spin = np.cross(bar, S_v - P_v) / length**2  # no rotation about its own axis
    up, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    model = SpatialModel((0.0, 0.0, -GRAVITY), name="spatial four-bar")
    for name, long, place, turned, velocity, rate in (
        ("crank", CRANK, 0.5 * P, frame(P, up), 0.5 * P_v, RATE * up),
        ("coupler", length, 0.5 * (P + S), frame(bar, y), 0.5 * (P_v + S_v), spin),
        ("rocker", ROCKER, D + 0.5 * arm, frame(arm, y), 0.5 * S_v, -phi_rate * y),  # from x to z is negative about y
    ):
        pose = {"position": place, "rotation": turned, "velocity": velocity, "angular_velocity": rate}
        model.body(name, mass=MASSES[name], inertia=inertia(MASSES[name], long), **pose)
    model.revolute("crank", "ground", at=(0.0, 0.0, 0.0), axis=up)
    model.spherical("coupler", "crank", at=P)
    model.spherical("rocker", "coupler", at=S)
    model.revolute("rocker", "ground", at=D, axis=y)
    return ready_model(
        *(model, 2.0),
        conserved=True,
        parameters={"crank": CRANK, "coupler": length, "rocker": ROCKER, "D": tuple(D), "masses": MASSES},
        note="Dimensions and start were chosen for this project.",
        source="textbook mechanism (RSSR)",
        tags=("closed chain", "rigid", "spatial"),
        purpose=(
            "A spatial loop by Euler parameters, 21 coordinates and 19 constraints, with a singular mass matrix and a "
            "freedom, the coupler's turn about its axis, that nothing else feels."
        ),
    )

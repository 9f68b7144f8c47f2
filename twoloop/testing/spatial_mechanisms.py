"""Problems of spatial rigid bodies, by Euler parameters."""

import numpy as np

from twoloop.testing.known_motions import posed
from twoloop.testing.known_problem import Array, KnownProblem
from twoloop.testing.spatial_equations import GROUND, SpatialEquations

GRAVITY = 9.81  # m/s^2


def heavy_top() -> KnownProblem:
    """A top of 15 kg with a fixed point, its axis initially level, spinning at 150 rad/s about it."""
    equations = SpatialEquations((0.0, 0.0, -GRAVITY))
    spin, centre = np.array([0.0, 150.0, -4.61538]), np.array([0.0, 1.0, 0.0])
    body = equations.body(15.0, (0.234375, 0.46875, 0.234375), centre, np.eye(3), np.cross(spin, centre), spin)
    equations.spherical(body, GROUND, (0.0, 0.0, 0.0))
    kept = {"vertical angular momentum": equations.vertical_momentum}
    tags, note = "smoke, open chain, spatial", "a mass matrix of rank 6 of 7; a fast spin beside a slow precession"
    return posed("heavy_top", equations, equations.start, 0.2, tags, invariants=kept, note=note)


def spatial_four_bar() -> KnownProblem:
    """A spatial four-bar: crank and rocker on hinges about z and y, coupler on two ball joints; crank at 5 rad/s."""
    up, y, D = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([0.9, 0.0, 0.3])
    P, P_v = np.array([0.3, 0.0, 0.0]), np.array([0.0, 1.5, 0.0])
    S, turned = D + np.array([0.0, 0.0, 0.7]), np.array([-0.7, 0.0, 0.0])
    bar = S - P
    rate = (bar @ P_v) / (bar @ turned)  # rate of the rocker, from x towards z
    S_v, length = rate * turned, float(np.linalg.norm(bar))
    spin = np.cross(bar, S_v - P_v) / length**2  # no rotation about its own axis
    equations = SpatialEquations((0.0, 0.0, -GRAVITY))
    crank = equations.body(0.6, _round_bar(0.6, 0.3), 0.5 * P, _frame(P, up), 0.5 * P_v, 5.0 * up)
    coupler = equations.body(1.0, _round_bar(1.0, length), 0.5 * (P + S), _frame(bar, y), 0.5 * (P_v + S_v), spin)
    rocker = equations.body(0.8, _round_bar(0.8, 0.7), 0.5 * (D + S), _frame(S - D, y), 0.5 * S_v, -rate * y)
    equations.revolute(crank, GROUND, np.zeros(3), up)
    equations.spherical(coupler, crank, P)
    equations.spherical(rocker, coupler, S)
    equations.revolute(rocker, GROUND, D, y)
    note = "21 coordinates and 19 rows; the coupler may turn about its axis, which nothing else feels"
    return posed("spatial_four_bar", equations, equations.start, 1.0, "closed chain, spatial", note=note)


def _round_bar(mass: float, length: float) -> tuple[float, float, float]:
    """Return the principal moments of a bar of 0.02 m radius along its first axis, kg m^2."""
    across = mass * (length**2 / 12.0 + 0.02**2 / 4.0)
    return 0.5 * mass * 0.02**2, across, across


def _frame(along: Array, up: Array) -> Array:
    """Return a rotation matrix whose first column is along a bar, and the second perpendicular to `up` and it."""
    x = along / np.linalg.norm(along)
    y = np.cross(up, x)
    y = y / np.linalg.norm(y)
    return np.column_stack([x, y, np.cross(x, y)])

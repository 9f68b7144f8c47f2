"""Mechanisms whose C_q loses rank at points of the motion: where it goes on smoothly, and where it cannot."""

import numpy as np

from tests.general.mechanism import G, Mechanism, of_functions, one_coordinate
from twoloop.mechanisms.quadratic import QuadraticSystem, fixed, point


def isosceles_slider_crank():
    """Crank and rod of 1 m: when both are upright, the slider is at the pivot, and could stay there.

    q = x, y of the pin, x of the slider; masses of 1 kg at both.
    """
    rows = QuadraticSystem(np.eye(3), np.array([0.0, -G, 0.0]))
    rows.distance(point(0), fixed(0.0, 0.0), 1.0)
    rows.distance(point(0), [{2: 1.0}, {}], 1.0)
    system = rows.system("isosceles slider-crank")

    def kinematics(angle):
        s, c = np.sin(angle), np.cos(angle)
        return np.array([c, s, 2.0 * c]), np.array([-s, c, -2.0 * s]), np.array([-c, -s, -2.0 * c])

    weight = np.array([0.0, -G, 0.0])
    return Mechanism(
        name="isosceles slider-crank",
        system=lambda: system,
        end=2.0,
        state=one_coordinate(kinematics, np.ones(3), weight, (0.3, 5.0), 2.0),
        rank=2,
        energy=lambda q, v: 0.5 * v @ v + G * q[1],
    )


def crossing_lines():
    """A bead on x^2 = y^2, thrown up along x = y through the crossing, where C_q = 0. Closed form."""
    rows = QuadraticSystem(np.eye(2), np.array([0.0, -G]))
    rows.row((0.5, {0: 1.0}, {0: 1.0}), (-0.5, {1: 1.0}, {1: 1.0}))
    system = rows.system("crossing lines")

    def state(t):
        s, speed = -1.0 + 4.0 * t - 0.25 * G * t * t, 4.0 - 0.5 * G * t
        return np.array([s, s]), np.array([speed, speed])

    return Mechanism(
        name="crossing lines",
        system=lambda: system,
        end=1.0,
        state=state,
        rank=1,
        energy=lambda q, v: 0.5 * v @ v + G * q[1],
    )


CUSP_TIME = (13.0**1.5 - 8.0) / 27.0  # length of y^2 = x^3 from (1, 1) to the origin, at unit speed


def cusp():
    """A free bead of unit speed on y^2 = x^3, from (1, 1) towards the cusp, which it cannot pass: the curve turns back.

    `state` holds up to `CUSP_TIME`.
    """

    def state(t):
        # at u = x^(1/2) the length still to go is ((4 + 9 u^2)^1.5 - 8) / 27
        u = np.sqrt(max(0.0, (27.0 * (CUSP_TIME - t) + 8.0) ** (2.0 / 3.0) - 4.0)) / 3.0
        return np.array([u**2, u**3]), -np.array([2.0, 3.0 * u]) / np.hypot(2.0, 3.0 * u)

    return Mechanism(
        name="cusp",
        system=of_functions(
            name="cusp",
            n_q=2,
            n_c=1,
            mass=np.eye(2),
            force=lambda t, q, v: np.zeros(2),
            constraint=lambda t, q: np.array([0.5 * (q[1] ** 2 - q[0] ** 3)]),
            jacobian=lambda t, q: np.array([[-1.5 * q[0] ** 2, q[1]]]),
            gamma=lambda t, q, v: np.array([3.0 * q[0] * v[0] ** 2 - v[1] ** 2]),
        ),
        end=2.0,
        state=state,
        rank=1,
    )

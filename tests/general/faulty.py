"""Systems that contradict themselves or lack inertia, and one that lacks it only where rows make up for it."""

import numpy as np

from tests.general.mechanism import G, Mechanism, of_functions, one_coordinate
from tests.problems import pendulum, unconstrained

SPRING = 20.0


def massless_coordinate():
    """A pendulum, q = x, y, s: the massless s follows x by a row, and a spring pulls at s."""

    def kinematics(angle):
        s, c = np.sin(angle), np.cos(angle)
        return np.array([s, -c, s]), np.array([c, s, c]), np.array([-s, c, -s])

    def rate_force(q):
        return np.array([0.0, -G, -SPRING * q[2]])

    return Mechanism(
        name="massless coordinate",
        system=of_functions(
            name="massless coordinate",
            n_q=3,
            n_c=2,
            mass=np.diag([1.0, 1.0, 0.0]),
            force=lambda t, q, v: np.array([0.0, -G, -SPRING * q[2]]),
            constraint=lambda t, q: np.array([0.5 * (q[0] * q[0] + q[1] * q[1] - 1.0), q[2] - q[0]]),
            jacobian=lambda t, q: np.array([[q[0], q[1], 0.0], [-1.0, 0.0, 1.0]]),
            gamma=lambda t, q, v: np.array([-v[0] * v[0] - v[1] * v[1], 0.0]),
        ),
        end=2.0,
        state=one_coordinate(kinematics, np.array([1.0, 1.0, 0.0]), rate_force, (1.2, 0.5), 2.0),
        rank=2,
        energy=lambda q, v: 0.5 * (v[0] ** 2 + v[1] ** 2) + G * q[1] + 0.5 * SPRING * q[2] ** 2,
    )


def without_inertia(mass=(1.0, 1.0, 0.0)):
    """A pendulum x, y and a third coordinate that no row holds; by default it has no mass."""
    return pendulum(
        n_q=3,
        mass=np.diag(mass),
        force=lambda t, q, v: np.array([0.0, -G, 0.0]),
        jacobian=lambda t, q: np.array([[q[0], q[1], 0.0]]),
        name="drifter",
    )


def parted_drives(power):
    """Two coordinates; row 1 drives q0 by sin(t), and row 2 by sin(t) + t^power: they part after the start.

    At t = 0 both agree in position and in velocity; with power = 3 in acceleration, too.
    """
    zero = power == 2
    return pendulum(
        n_c=3,
        constant_mass=True,
        constraint=lambda t, q: np.array([q[1] - q[0], q[0] - np.sin(t), q[0] - np.sin(t) - t**power]),
        jacobian=lambda t, q: np.array([[-1.0, 1.0], [1.0, 0.0], [1.0, 0.0]]),
        constraint_rate=lambda t, q: np.array([0.0, -np.cos(t), -np.cos(t) - power * t ** (power - 1)]),
        gamma=lambda t, q, v: np.array([0.0, -np.sin(t), -np.sin(t) + (2.0 if zero else 6.0 * t)]),
        name="two drives",
    )


def parted_velocities():
    """Two non-holonomic rows of the same direction at t = 0 that ask for different speeds: none satisfies both."""
    return unconstrained(
        lambda t, q, v: np.zeros(2),
        2,
        n_a=2,
        nonholonomic=lambda t, q: np.array([[1.0, 0.0], [2.0, 0.0]]),
        nonholonomic_rate=lambda t, q: np.array([-1.0, -3.0]),
        name="two speeds",
    )

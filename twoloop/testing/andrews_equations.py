"""Andrews' squeezing mechanism: seven bodies, three loops that share a joint, driven by a constant torque.

Angles beta, Theta, gamma, Phi, delta, Omega, epsilon and constants as in Hairer & Wanner, Solving Ordinary Differential
Equations II, Sect. VII.7, and the Test Set for IVP Solvers, "andrews". The mass matrix, the velocity terms and gamma
are computed from the centres of mass, which are sums of vectors rotated by sums of angles.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from twoloop.testing.known_problem import Array

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
# rows: the angles whose sum is the angle of a body
TURNS = np.zeros((7, 7))
TURNS[0, 0] = TURNS[1, 0] = TURNS[1, 1] = TURNS[2, 2] = TURNS[3, 3] = TURNS[3, 4] = TURNS[4, 4] = 1.0
TURNS[5, 5] = TURNS[5, 6] = TURNS[6, 6] = 1.0

# each point is a sum of vectors (body, x, y) in body axes, starting at the ground points (0, 0), B, A, A
SHARED = [(0, 0.007, 0.0), (1, -0.028, 0.0)]  # the joint shared by the loops
LOOPS = [(B, [(2, 0.0, -0.035)]), (A, [(3, 0.0, -0.02), (4, 0.04, 0.0)]), (A, [(5, 0.02, 0.0), (6, 0.0, -0.04)])]
CENTRES = [  # of mass, as sums of vectors
    [(0, 0.00092, 0.0)],
    [(0, 0.007, 0.0), (1, -0.0115, 0.0)],
    [(2, 0.01874, 0.01043)],
    [(4, 0.04, 0.0), (3, 0.0, -(0.02 - 0.01421))],
    [(4, 0.02308, 0.00916)],
    [(6, 0.0, -0.04), (5, 0.02 - 0.01421, 0.0)],
    [(6, 0.01228, -0.00449)],
]
SPRING = [(2, 0.02, -0.018)]  # attachment point on body 3


def vector(turns: Array, parts: list[tuple[int, float, float]]) -> Array:
    """Return the parts (n_parts, 2) of a point, each rotated with its body."""
    s, c = np.sin(turns), np.cos(turns)
    return np.array([[c[i] * x - s[i] * y, s[i] * x + c[i] * y] for i, x, y in parts])


def vector_by_q(turns: Array, parts: list[tuple[int, float, float]]) -> Array:
    """Return the derivative (2, 7) of the sum of the parts with respect to the seven angles."""
    around = vector(turns, parts) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    return around.T @ TURNS[[part[0] for part in parts]]


def bend(turns: Array, rates: Array, parts: list[tuple[int, float, float]]) -> Array:
    """Return the second time derivative (2,) of the sum of the parts at constant angular velocities."""
    return -(rates[[part[0] for part in parts]] ** 2) @ vector(turns, parts)


class AndrewsEquations:
    """The mechanism as published."""

    coordinates = ("angle", *("relative", "angle") * 3)
    row_powers = (1.0,) * 6
    parts: Mapping[str, Any] = {}  # bodies and joints are not given
    parameters: Mapping[str, Any] = {
        **{"masses": MASSES, "inertias": INERTIAS, "torque": TORQUE},
        **{"spring_stiffnesses": [STIFFNESS], "spring_lengths": [UNSTRESSED]},
    }

    def mass(self, t: float, q: Array) -> Array:
        """Return M (7, 7)."""
        turns = TURNS @ q
        M = TURNS.T @ (INERTIAS[:, None] * TURNS)
        for m, parts in zip(MASSES, CENTRES, strict=True):
            J = vector_by_q(turns, parts)
            M += m * J.T @ J
        return M

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (7,): torque, spring, and velocity terms."""
        turns, rates = TURNS @ q, TURNS @ v
        Q = TORQUE * np.eye(7)[0]
        for m, parts in zip(MASSES, CENTRES, strict=True):
            Q -= m * vector_by_q(turns, parts).T @ bend(turns, rates, parts)
        arm = self._spring(turns)
        length = np.linalg.norm(arm)
        return Q - STIFFNESS * (length - UNSTRESSED) / length * vector_by_q(turns, SPRING).T @ arm

    def _spring(self, turns: Array) -> Array:
        return B + vector(turns, SPRING).sum(axis=0) - C

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (6,)."""
        turns = TURNS @ q
        shared = vector(turns, SHARED).sum(axis=0)
        return np.concatenate([shared - ground - vector(turns, parts).sum(axis=0) for ground, parts in LOOPS])

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (6, 7)."""
        turns = TURNS @ q
        shared = vector_by_q(turns, SHARED)
        return np.vstack([shared - vector_by_q(turns, parts) for _, parts in LOOPS])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (6,), zero."""
        return np.zeros(6)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (6,) of C_q a = gamma."""
        turns, rates = TURNS @ q, TURNS @ v
        shared = bend(turns, rates, SHARED)
        return np.concatenate([bend(turns, rates, parts) - shared for _, parts in LOOPS])

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic energy plus the potentials of the spring and the constant torque, J."""
        stretch = np.linalg.norm(self._spring(TURNS @ q)) - UNSTRESSED
        return float(0.5 * v @ self.mass(t, q) @ v + 0.5 * STIFFNESS * stretch**2 - TORQUE * q[0])

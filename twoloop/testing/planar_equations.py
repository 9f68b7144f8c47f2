"""Equations of planar rigid bodies: coordinates x, y of the centre of mass and angle."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.testing.known_parts import GROUND, Array, Drive, KnownBody, KnownJoint

Point = tuple[float, float]


class PlanarEquations:
    """Bodies under gravity; add joints with `pin`, `distance` and `drive`, in the order of their rows.

    Parameters
    ----------
    masses, inertias : array_like (n_bodies,)
        kg, and kg m^2 about the centres of mass.
    gravity : float
        m/s^2, along -y.
    """

    def __init__(self, masses: ArrayLike, inertias: ArrayLike, gravity: float):
        m, J = np.asarray(masses, dtype=float), np.asarray(inertias, dtype=float)
        self.n_q, self.coordinates = 3 * m.size, m.size * ("x", "y", "angle")
        self.row_powers: list[float] = []
        self._diagonal = np.column_stack([m, m, J]).ravel()
        self._force = np.column_stack([0.0 * m, -gravity * m, 0.0 * J]).ravel()
        self._pins: list[tuple[tuple[int, Point, int, Point], float | None]] = []
        self._rows: list[list[int]] = []
        self._drives: list[tuple[int, int, Drive]] = []
        self._masses, self._inertias, self._gravity = m, J, np.array([0.0, -gravity])
        self._joints: list[KnownJoint] = []

    def pin(self, i: int, a: Point, j: int, b: Point) -> None:
        """Add two rows: point a of body i coincides with point b of body j, or of the ground."""
        self._pins.append(((i, a, j, b), None))
        self._rows.append([self.n_c, self.n_c + 1])
        self._add("revolute", (i, j), (a, b), 1.0, 1.0)

    def distance(self, i: int, a: Point, j: int, b: Point, length: float) -> None:
        """Add one row: half the squared distance of the points equals half the squared length."""
        self._pins.append(((i, a, j, b), length))
        self._rows.append([self.n_c])
        self._add("distance", (i, j), (a, b), 2.0, length=length)

    def drive(self, body: int, drive: Drive) -> None:
        """Add one row: the angle of a body is a function of time, given with its first two derivatives."""
        self._drives.append((self.n_c, 3 * body + 2, drive))
        self._add("drive", (body, GROUND), ((0.0, 0.0), (0.0, 0.0)), 0.0, motion=drive)

    def slide(self, body: int) -> None:
        """Add two rows: the centre of a body stays on the x axis, and its angle is zero."""
        for row, coordinate in enumerate((3 * body + 1, 3 * body + 2), self.n_c):
            self._drives.append((row, coordinate, (lambda t: 0.0, lambda t: 0.0, lambda t: 0.0)))
        self._add("prismatic", (body, GROUND), ((0.0, 0.0), (0.0, 0.0)), 1.0, 0.0, axis=np.array([1.0, 0.0]))

    def _add(self, kind: str, pair: tuple[int, int], points: tuple[Point, Point], *powers: float, **more: Any) -> None:
        """Record a joint, and the power of the unit of length in each of its rows."""
        rows, places = slice(self.n_c, self.n_c + len(powers)), (np.array(points[0]), np.array(points[1]))
        self._joints.append(KnownJoint(kind, pair, places, rows, **more))
        self.row_powers += powers

    @property
    def n_c(self) -> int:
        """Number of rows."""
        return len(self.row_powers)

    @property
    def parameters(self) -> dict[str, Array]:
        """Return the constants as `KnownProblem.parameters`."""
        return {"masses": self._masses, "inertias": self._inertias, "gravity": self._gravity}

    @property
    def parts(self) -> dict[str, Any]:
        """Return bodies, joints and gravity as arguments of `KnownProblem`."""
        each = enumerate(zip(self._masses, self._inertias, strict=True))
        bodies = tuple(KnownBody(float(m), np.array([J]), slice(3 * k, 3 * k + 3)) for k, (m, J) in each)
        return {"bodies": bodies, "joints": tuple(self._joints), "gravity": self._gravity}

    def _arm(self, q: Array, body: int, point: Point) -> Array:
        """Return the vector from the centre of a body to a point on it, in space; for the ground, the point."""
        if body == GROUND:
            return np.array(point)
        s, c = np.sin(q[3 * body + 2]), np.cos(q[3 * body + 2])
        return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])

    def _between(self, q: Array, i: int, a: Point, j: int, b: Point) -> Array:
        """Return the vector from point b of body j to point a of body i."""
        total = self._arm(q, i, a) - self._arm(q, j, b)
        for body, sign in ((i, 1.0), (j, -1.0)):
            if body != GROUND:
                total = total + sign * q[3 * body : 3 * body + 2]
        return total

    def _between_by_q(self, q: Array, i: int, a: Point, j: int, b: Point) -> Array:
        """Return its derivative (2, n_q)."""
        J = np.zeros((2, self.n_q))
        for body, point, sign in ((i, a, 1.0), (j, b, -1.0)):
            if body != GROUND:
                x, y = self._arm(q, body, point)
                k = 3 * body
                J[0, k] += sign
                J[1, k + 1] += sign
                J[0, k + 2] -= sign * y
                J[1, k + 2] += sign * x
        return J

    def mass(self, t: float, q: Array) -> Array:
        """Return M (n_q, n_q)."""
        return np.diag(self._diagonal)

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,): the weights."""
        return self._force.copy()

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (n_c,)."""
        C = np.zeros(self.n_c)
        for rows, (ends, length) in zip(self._rows, self._pins, strict=True):
            arm = self._between(q, *ends)
            C[rows] = arm if length is None else 0.5 * (arm @ arm - length**2)
        for row, k, (motion, _, _) in self._drives:
            C[row] = q[k] - motion(t)
        return C

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (n_c, n_q)."""
        J = np.zeros((self.n_c, self.n_q))
        for rows, (ends, length) in zip(self._rows, self._pins, strict=True):
            by_q = self._between_by_q(q, *ends)
            J[rows] = by_q if length is None else self._between(q, *ends) @ by_q
        for row, k, _ in self._drives:
            J[row, k] = 1.0
        return J

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (n_c,)."""
        rates = np.zeros(self.n_c)
        for row, _, (_, rate, _) in self._drives:
            rates[row] = -rate(t)
        return rates

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (n_c,) of C_q a = gamma."""
        right = np.zeros(self.n_c)
        for rows, ((i, a, j, b), length) in zip(self._rows, self._pins, strict=True):
            towards = np.zeros(2)  # minus the centripetal accelerations
            for body, point, sign in ((i, a, 1.0), (j, b, -1.0)):
                if body != GROUND:
                    towards += sign * v[3 * body + 2] ** 2 * self._arm(q, body, point)
            if length is None:
                right[rows] = towards
            else:
                rate = self._between_by_q(q, i, a, j, b) @ v
                right[rows] = self._between(q, i, a, j, b) @ towards - rate @ rate
        for row, _, (_, _, acceleration) in self._drives:
            right[row] = acceleration(t)
        return right

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic and potential energy, J."""
        return float(0.5 * self._diagonal @ v**2 - self._force @ q)


def bodies(*states: tuple[complex, float]) -> Array:
    """Return the coordinates (3 n,) of bodies, or their velocities, each given as x + i y and an angle."""
    return np.array([[place.real, place.imag, angle] for place, angle in states]).ravel()


def rods(lengths: Sequence[float], masses: Sequence[float]) -> Array:
    """Return the moments of inertia (n,) of uniform rods about their centres, kg m^2."""
    return np.asarray(masses) * np.asarray(lengths) ** 2 / 12.0

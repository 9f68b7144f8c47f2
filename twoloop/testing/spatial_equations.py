"""Equations of spatial rigid bodies: centre of mass and four Euler parameters of each.

The first rows normalise the Euler parameters, e.e / 2 = 1/2; the rows of the joints follow.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.testing.known_parts import GROUND, Array, KnownBody, KnownJoint


def skew(a: Array) -> Array:
    """Return the matrix of the cross product with a vector (3,)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def turned(e: Array, a: Array) -> Array:
    """Return R(e) a, a quadratic form in the Euler parameters (4,)."""
    u = e[1:]
    return (e[0] ** 2 - u @ u) * a + 2.0 * u * (u @ a) + 2.0 * e[0] * np.cross(u, a)


def turned_by_e(e: Array, a: Array) -> Array:
    """Return the derivative (3, 4) of R(e) a with respect to the Euler parameters, which is linear in these."""
    u = e[1:]
    by_u = (u @ a) * np.eye(3) + np.outer(u, a) - np.outer(a, u) - e[0] * skew(a)
    return 2.0 * np.column_stack([e[0] * a + np.cross(u, a), by_u])


def half_spin(e: Array) -> Array:
    """Return G (3, 4): the angular velocity in body axes is 2 G e'."""
    return np.column_stack([-e[1:], e[0] * np.eye(3) - skew(e[1:])])


def parameters_of(R: Array) -> Array:
    """Return the Euler parameters (4,) of a rotation matrix, computed from the largest one, with e0 >= 0."""
    products = np.empty((4, 4))
    products[0, 0], products[1:, 1:] = 1.0 + np.trace(R), R + R.T + (1.0 - np.trace(R)) * np.eye(3)
    products[0, 1:] = products[1:, 0] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    best = products[int(np.argmax(np.diag(products)))]
    return best / np.linalg.norm(best) * (1.0 if best[0] >= 0.0 else -1.0)


class SpatialEquations:
    """Bodies under gravity; add them with `body`, then joints in the order of their rows.

    Parameters
    ----------
    gravity : array_like (3,)
        m/s^2.
    """

    def __init__(self, gravity: ArrayLike):
        self._gravity = np.asarray(gravity, dtype=float)
        self._bodies: list[tuple[float, Array]] = []  # mass and inertia
        self._start: list[Array] = []
        self._rates: list[Array] = []
        self._points: list[tuple[int, int, Array, int, Array]] = []
        self._directions: list[tuple[int, int, Array, int, Array]] = []
        self._joint_powers: list[float] = []
        self._axes: dict[int, Array] = {}

    @property
    def n_q(self) -> int:
        """Number of coordinates."""
        return 7 * len(self._bodies)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Kinds of the coordinates."""
        return len(self._bodies) * ("x", "y", "z", "e0", "e1", "e2", "e3")

    @property
    def row_powers(self) -> list[float]:
        """Power of the unit of length in each row."""
        return [0.0] * len(self._bodies) + self._joint_powers

    @property
    def n_c(self) -> int:
        """Number of rows."""
        return len(self.row_powers)

    @property
    def start(self) -> tuple[Array, Array]:
        """Return the initial state q, v (n_q,) of the bodies as added."""
        return np.concatenate(self._start), np.concatenate(self._rates)

    def body(
        self, mass: float, inertia: ArrayLike, place: ArrayLike, R: ArrayLike, velocity: ArrayLike, spin: ArrayLike
    ) -> int:
        """Add a body by its principal moments, initial state, and angular velocity in space."""
        e = parameters_of(np.asarray(R, dtype=float))
        along = np.asarray(R, dtype=float).T @ np.asarray(spin, dtype=float)
        self._bodies.append((mass, np.diag(np.asarray(inertia, dtype=float))))
        self._start.append(np.concatenate([np.asarray(place, dtype=float), e]))
        self._rates.append(np.concatenate([np.asarray(velocity, dtype=float), 0.5 * half_spin(e).T @ along]))
        return len(self._bodies) - 1

    def _fixed_to(self, body: int, vector: ArrayLike, from_centre: bool) -> Array:
        """Transform an initial vector or point from space to body axes, the point relative to the centre."""
        given = np.asarray(vector, dtype=float)
        if body == GROUND:
            return given
        r, e = self._start[body][:3], self._start[body][3:]
        return turned(e * np.array([1.0, -1.0, -1.0, -1.0]), given - r if from_centre else given)

    def spherical(self, i: int, j: int, point: ArrayLike) -> None:
        """Add three rows: both bodies share a point."""
        a, b = (self._fixed_to(body, point, True) for body in (i, j))
        self._points.append((len(self._joint_powers), i, a, j, b))
        self._joint_powers += [1.0] * 3

    def revolute(self, i: int, j: int, point: ArrayLike, axis: ArrayLike) -> None:
        """Add five rows: both bodies share a point and an axis."""
        self.spherical(i, j, point)
        axis = np.asarray(axis, dtype=float)
        first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        for across in (first, np.cross(axis, first)):
            unit = self._fixed_to(i, across / np.linalg.norm(across), False)
            self._directions.append((len(self._joint_powers), i, unit, j, self._fixed_to(j, axis, False)))
            self._joint_powers.append(0.0)
        self._axes[len(self._points) - 1] = self._fixed_to(j, axis / np.linalg.norm(axis), False)

    def _vector(self, q: Array, body: int, a: Array) -> Array:
        return a if body == GROUND else turned(q[7 * body + 3 : 7 * body + 7], a)

    def _vector_by_e(self, q: Array, body: int, a: Array) -> Array:
        return np.zeros((3, 4)) if body == GROUND else turned_by_e(q[7 * body + 3 : 7 * body + 7], a)

    def _rate(self, q: Array, v: Array, body: int, a: Array) -> Array:
        return self._vector_by_e(q, body, a) @ (np.zeros(4) if body == GROUND else v[7 * body + 3 : 7 * body + 7])

    @property
    def parameters(self) -> dict[str, Any]:
        """Return the constants as `KnownProblem.parameters`; the moments (n_bodies, 3) are principal ones."""
        masses, inertias = zip(*self._bodies, strict=True)
        return {"masses": masses, "inertias": [np.diag(J) for J in inertias], "gravity": self._gravity}

    @property
    def parts(self) -> dict[str, Any]:
        """Return bodies, joints and gravity as arguments of `KnownProblem`."""
        joints: list[KnownJoint] = []
        bodies = [KnownBody(m, np.diag(J), slice(7 * k, 7 * k + 7)) for k, (m, J) in enumerate(self._bodies)]
        for k, (row, i, a, j, b) in enumerate(self._points):
            first, axis = len(bodies) + row, self._axes.get(k)
            kind, n_rows = ("spherical", 3) if axis is None else ("revolute", 5)
            joints.append(KnownJoint(kind, (i, j), (a, b), slice(first, first + n_rows), axis))
        return {"bodies": tuple(bodies), "joints": tuple(joints), "gravity": self._gravity}

    def mass(self, t: float, q: Array) -> Array:
        """Return M (n_q, n_q), of rank 6 for each body."""
        M = np.zeros((self.n_q, self.n_q))
        for body, (m, J) in enumerate(self._bodies):
            k, G = 7 * body, half_spin(q[7 * body + 3 : 7 * body + 7])
            M[k : k + 3, k : k + 3] = m * np.eye(3)
            M[k + 3 : k + 7, k + 3 : k + 7] = 4.0 * G.T @ J @ G
        return M

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,): weights and velocity terms."""
        parts: list[Array] = []
        for m, J, x, u in self._each(q, v):
            parts += [m * self._gravity, -8.0 * half_spin(u[3:]).T @ (J @ (half_spin(x[3:]) @ u[3:]))]
        return np.concatenate(parts)

    def _each(self, q: Array, v: Array) -> Iterator[tuple[float, Array, Array, Array]]:
        """Yield mass, inertia and state (7,), (7,) of each body."""
        for (m, J), x, u in zip(self._bodies, q.reshape(-1, 7), v.reshape(-1, 7), strict=True):
            yield m, J, x, u

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (n_c,)."""
        n = len(self._bodies)
        C = np.zeros(self.n_c)
        C[:n] = 0.5 * ((q.reshape(n, 7)[:, 3:] ** 2).sum(axis=1) - 1.0)
        for row, i, a, j, b in self._points:
            gap = self._vector(q, i, a) - self._vector(q, j, b)
            for body, sign in ((i, 1.0), (j, -1.0)):
                if body != GROUND:
                    gap = gap + sign * q[7 * body : 7 * body + 3]
            C[n + row : n + row + 3] = gap
        for row, i, a, j, b in self._directions:
            C[n + row] = self._vector(q, i, a) @ self._vector(q, j, b)
        return C

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (n_c, n_q)."""
        n = len(self._bodies)
        J = np.zeros((self.n_c, self.n_q))
        for body in range(n):
            J[body, 7 * body + 3 : 7 * body + 7] = q[7 * body + 3 : 7 * body + 7]
        for row, i, a, j, b in self._points:
            for body, point, sign in ((i, a, 1.0), (j, b, -1.0)):
                if body != GROUND:
                    rows = slice(n + row, n + row + 3)
                    J[rows, 7 * body : 7 * body + 3] += sign * np.eye(3)
                    J[rows, 7 * body + 3 : 7 * body + 7] += sign * self._vector_by_e(q, body, point)
        for row, i, a, j, b in self._directions:
            for body, own, other in ((i, a, self._vector(q, j, b)), (j, b, self._vector(q, i, a))):
                if body != GROUND:
                    J[n + row, 7 * body + 3 : 7 * body + 7] += other @ self._vector_by_e(q, body, own)
        return J

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (n_c,), zero."""
        return np.zeros(self.n_c)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (n_c,) of C_q a = gamma."""
        n = len(self._bodies)
        right = np.zeros(self.n_c)
        right[:n] = -(v.reshape(n, 7)[:, 3:] ** 2).sum(axis=1)
        still = np.zeros(3)

        def bend(body: int, a: Array) -> Array:
            """Return the second derivative of a body-fixed vector for e'' = 0."""
            return still if body == GROUND else 2.0 * turned(v[7 * body + 3 : 7 * body + 7], a)

        for row, i, a, j, b in self._points:
            right[n + row : n + row + 3] = bend(j, b) - bend(i, a)
        for row, i, a, j, b in self._directions:
            total = bend(i, a) @ self._vector(q, j, b) + self._vector(q, i, a) @ bend(j, b)
            right[n + row] = -total - 2.0 * self._rate(q, v, i, a) @ self._rate(q, v, j, b)
        return right

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic and potential energy, J."""
        total = 0.0
        for m, J, x, u in self._each(q, v):
            spin = 2.0 * half_spin(x[3:]) @ u[3:]
            total += float(0.5 * m * u[:3] @ u[:3] + 0.5 * spin @ J @ spin)
            total -= float(m * self._gravity @ x[:3])
        return total

    def vertical_momentum(self, t: float, q: Array, v: Array) -> float:
        """Return the angular momentum about the z axis of space, kg m^2/s."""
        total = 0.0
        for m, J, x, u in self._each(q, v):
            own = turned(x[3:], J @ (2.0 * half_spin(x[3:]) @ u[3:]))
            total += float(own[2] + m * (x[0] * u[1] - x[1] * u[0]))
        return total

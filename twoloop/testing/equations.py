"""Equations of motion of point masses, planar bodies and spatial bodies, in plain numpy.

The coordinates of a body are its centre of mass and, in the plane, an angle, or in space four Euler parameters. Rows
e.e / 2 = 1/2, which normalise Euler parameters, come before the rows of the joints.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.testing.problem import (
    GROUND,
    Array,
    Drive,
    KnownBody,
    KnownJoint,
    euler_parameters,
    rate_matrix,
    rotate,
    rotate_jacobian,
)

Place = int | tuple[float, ...]  # index of a point, or a ground point
Point = tuple[float, float]


class PointEquations:
    """Point masses in the plane or in space with links of fixed length and springs.

    Parameters
    ----------
    mass : array_like (n_points,) or (n_points, n_points)
        Masses of the points, kg; a matrix for the consistent mass of bars between them.
    weight : array_like (n_points, n_axes)
        Constant force on each point, N.
    links : sequence of (place, place, float)
        Ends, each the index of a point or a ground point, and the length, m.
    springs : sequence of (place, place, float, float)
        Ends, stiffness in N/m and unstressed length in m.
    """

    def __init__(
        self,
        mass: ArrayLike,
        weight: ArrayLike,
        links: Sequence[tuple[Place, Place, float]],
        springs: Sequence[tuple[Place, Place, float, float]] = (),
    ):
        self.weight = np.asarray(weight, dtype=float)
        n_points, n_axes = self.weight.shape
        masses = np.asarray(mass, dtype=float)
        self._points_alone = masses.ndim == 1 and not springs
        self._mass = np.kron(np.diag(masses) if masses.ndim == 1 else masses, np.eye(n_axes))
        self.n_q, self.coordinates = n_points * n_axes, n_points * ("x", "y", "z")[:n_axes]
        self.n_c, self.row_powers = len(links), [2.0] * len(links)
        self._link_D, self._link_d = self._differences([link[:2] for link in links])
        self._links, self._lengths = links, np.array([link[2] for link in links])
        self._spring_D, self._spring_d = self._differences([spring[:2] for spring in springs])
        self._stiffness = np.array([spring[2] for spring in springs])
        self._unstressed = np.array([spring[3] for spring in springs])

    @property
    def parameters(self) -> dict[str, ArrayLike]:
        """Return the constants as `KnownProblem.parameters`; lengths and masses of bars are contained in M."""
        n_axes = self.weight.shape[1]
        constants: dict[str, ArrayLike] = {"masses": self._mass[::n_axes, ::n_axes], "lengths": self._lengths}
        if np.count_nonzero(constants["masses"]) == len(self.weight):
            constants["masses"] = np.diag(self._mass)[::n_axes]
        if self._stiffness.size:
            constants |= {"spring_stiffnesses": self._stiffness, "spring_lengths": self._unstressed}
        return constants | {"gravity": self.weight[0] / self._mass.sum(axis=0)[0]}

    @property
    def parts(self) -> dict[str, Any]:
        """Return points, links and gravity as arguments of `KnownProblem`, if these make up the whole problem."""
        if not self._points_alone or type(self) is not PointEquations:
            return {}
        n_axes = self.weight.shape[1]
        masses, centre = np.diag(self._mass)[::n_axes].tolist(), np.zeros(n_axes)
        joints = []
        for k, (i, j, length) in enumerate(self._links):
            ends = [(end, centre) if isinstance(end, int) else (GROUND, np.array(end)) for end in (i, j)]
            pair, points = zip(*ends, strict=True)
            joints.append(KnownJoint("distance", pair, points, slice(k, k + 1), length=length))
        bodies = tuple(KnownBody(m, np.zeros(0), slice(k * n_axes, (k + 1) * n_axes)) for k, m in enumerate(masses))
        return {"bodies": bodies, "joints": tuple(joints), "gravity": self.weight[0] / masses[0]}

    def _differences(self, pairs: Sequence[tuple[Place, Place]]) -> tuple[Array, Array]:
        """Return D (n, n_axes, n_q) and d (n, n_axes) such that D q + d are the vectors between the ends."""
        n_points, n_axes = self.weight.shape
        D, d = np.zeros((len(pairs), n_axes, n_points, n_axes)), np.zeros((len(pairs), n_axes))
        for k, ends in enumerate(pairs):
            for end, sign in zip(ends, (1.0, -1.0), strict=True):
                if isinstance(end, tuple):
                    d[k] += sign * np.array(end)
                else:
                    D[k, :, end, :] += sign * np.eye(n_axes)
        return D.reshape(len(pairs), n_axes, n_points * n_axes), d

    def mass(self, t: float, q: Array) -> Array:
        """Return M (n_q, n_q)."""
        return self._mass.copy()

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,): weights and springs."""
        total = self.weight.ravel().copy()
        if self._stiffness.size:
            arms = self._spring_D @ q + self._spring_d
            lengths = np.linalg.norm(arms, axis=1)
            pulls = -self._stiffness * (lengths - self._unstressed) / lengths
            total += np.einsum("k,ka,kaq->q", pulls, arms, self._spring_D)
        return total

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (n_c,)."""
        arms = self._link_D @ q + self._link_d
        return 0.5 * ((arms**2).sum(axis=1) - self._lengths**2)

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (n_c, n_q)."""
        arms = self._link_D @ q + self._link_d
        return (arms[:, None, :] @ self._link_D)[:, 0, :]

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (n_c,), zero."""
        return np.zeros(self.n_c)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (n_c,) of C_q a = gamma."""
        return -((self._link_D @ v) ** 2).sum(axis=1)

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic and potential energy, J."""
        total = 0.5 * v @ self._mass @ v - self.weight.ravel() @ q
        if self._stiffness.size:
            lengths = np.linalg.norm(self._spring_D @ q + self._spring_d, axis=1)
            total += 0.5 * self._stiffness @ (lengths - self._unstressed) ** 2
        return float(total)


class ShakenPoints(PointEquations):
    """Points, the last of which is excited along x by amplitude sin(frequency t)."""

    def __init__(self, amplitude: float, frequency: float, *arguments: Any):
        super().__init__(*arguments)
        self._amplitude, self._frequency = amplitude, frequency

    @property
    def parameters(self) -> dict[str, ArrayLike]:
        """Return the constants, including the constants of the excitation."""
        return super().parameters | {"force_amplitude": self._amplitude, "force_frequency": self._frequency}

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,)."""
        total = super().force(t, q, v)
        total[-self.weight.shape[1]] += self._amplitude * np.sin(self._frequency * t)
        return total


class DrivenPoint(PointEquations):
    """A point on a link with prescribed height y = y0 + rate t; no solution beyond the length of the link."""

    def __init__(self, length: float, height: float, rate: float, gravity: float):
        super().__init__([1.0], [[0.0, -gravity]], [(0, (0.0, 0.0), length)])
        self.n_c, self.row_powers, self._height, self._rate = 2, [2.0, 1.0], height, rate

    @property
    def parameters(self) -> dict[str, ArrayLike]:
        """Return the constants, including the constants of the drive."""
        return super().parameters | {"drive_height": self._height, "drive_rate": self._rate}

    def constraint(self, t: float, q: Array) -> Array:
        """Return C (2,)."""
        return np.append(super().constraint(t, q), q[1] - self._height - self._rate * t)

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (2, 2)."""
        return np.vstack([super().jacobian(t, q), [0.0, 1.0]])

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (2,)."""
        return np.array([0.0, -self._rate])

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (2,) of C_q a = gamma."""
        return np.append(super().gamma(t, q, v), 0.0)


class EndingForce(PointEquations):
    """Points with a drag proportional to the square root of the time that remains until `ends`; later it is NaN."""

    def __init__(self, ends: float, *arguments: Any):
        super().__init__(*arguments)
        self._ends = ends

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,)."""
        with np.errstate(invalid="ignore"):
            return super().force(t, q, v) - np.sqrt(self._ends - t) * v


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

    def _add(
        self, kind: str, pair: tuple[int, int], points: tuple[Point, Point], *powers: float, **fields: Any
    ) -> None:
        """Record a joint, and the power of the unit of length in each of its rows."""
        rows, arms = slice(self.n_c, self.n_c + len(powers)), (np.array(points[0]), np.array(points[1]))
        self._joints.append(KnownJoint(kind, pair, arms, rows, **fields))
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
        inertias = enumerate(zip(self._masses.tolist(), self._inertias, strict=True))
        bodies = tuple(KnownBody(m, np.array([J]), slice(3 * k, 3 * k + 3)) for k, (m, J) in inertias)
        return {"bodies": bodies, "joints": tuple(self._joints), "gravity": self._gravity}

    def _arm(self, q: Array, body: int, point: Point) -> Array:
        """Return the vector from the centre of a body to a point on it, in space; for the ground, the point."""
        if body == GROUND:
            return np.array(point)
        s, c = np.sin(q[3 * body + 2]), np.cos(q[3 * body + 2])
        return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])

    def _gap(self, q: Array, i: int, a: Point, j: int, b: Point) -> Array:
        """Return the vector from point b of body j to point a of body i."""
        total = self._arm(q, i, a) - self._arm(q, j, b)
        for body, sign in ((i, 1.0), (j, -1.0)):
            if body != GROUND:
                total = total + sign * q[3 * body : 3 * body + 2]
        return total

    def _gap_jacobian(self, q: Array, i: int, a: Point, j: int, b: Point) -> Array:
        """Return the derivative (2, n_q) of `_gap` by q."""
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
            arm = self._gap(q, *ends)
            C[rows] = arm if length is None else 0.5 * (arm @ arm - length**2)
        for row, k, (motion, _, _) in self._drives:
            C[row] = q[k] - motion(t)
        return C

    def jacobian(self, t: float, q: Array) -> Array:
        """Return C_q (n_c, n_q)."""
        J = np.zeros((self.n_c, self.n_q))
        for rows, (ends, length) in zip(self._rows, self._pins, strict=True):
            gap_jacobian = self._gap_jacobian(q, *ends)
            J[rows] = gap_jacobian if length is None else self._gap(q, *ends) @ gap_jacobian
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
        gamma = np.zeros(self.n_c)
        for rows, ((i, a, j, b), length) in zip(self._rows, self._pins, strict=True):
            centripetal = np.zeros(2)  # minus the centripetal accelerations
            for body, point, sign in ((i, a, 1.0), (j, b, -1.0)):
                if body != GROUND:
                    centripetal += sign * v[3 * body + 2] ** 2 * self._arm(q, body, point)
            if length is None:
                gamma[rows] = centripetal
            else:
                rate = self._gap_jacobian(q, i, a, j, b) @ v
                gamma[rows] = self._gap(q, i, a, j, b) @ centripetal - rate @ rate
        for row, _, (_, _, acceleration) in self._drives:
            gamma[row] = acceleration(t)
        return gamma

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic and potential energy, J."""
        return float(0.5 * self._diagonal @ v**2 - self._force @ q)


def planar_state(*states: tuple[complex, float]) -> Array:
    """Return the coordinates (3 n,) of bodies, or their velocities, each given as x + i y and an angle."""
    return np.array([[place.real, place.imag, angle] for place, angle in states]).ravel()


def rod_inertias(lengths: Sequence[float], masses: Sequence[float]) -> Array:
    """Return the moments of inertia (n,) of uniform rods about their centres, kg m^2."""
    return np.asarray(masses) * np.asarray(lengths) ** 2 / 12.0


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
        e = euler_parameters(np.asarray(R, dtype=float))
        body_spin = np.asarray(R, dtype=float).T @ np.asarray(spin, dtype=float)
        self._bodies.append((mass, np.diag(np.asarray(inertia, dtype=float))))
        self._start.append(np.concatenate([np.asarray(place, dtype=float), e]))
        self._rates.append(np.concatenate([np.asarray(velocity, dtype=float), 0.5 * rate_matrix(e).T @ body_spin]))
        return len(self._bodies) - 1

    def _to_body_axes(self, body: int, vector: ArrayLike, from_centre: bool) -> Array:
        """Transform an initial vector or point from space to body axes, the point relative to the centre."""
        components = np.asarray(vector, dtype=float)
        if body == GROUND:
            return components
        r, e = self._start[body][:3], self._start[body][3:]
        return rotate(e * np.array([1.0, -1.0, -1.0, -1.0]), components - r if from_centre else components)

    def spherical(self, i: int, j: int, point: ArrayLike) -> None:
        """Add three rows: both bodies share a point."""
        a, b = (self._to_body_axes(body, point, True) for body in (i, j))
        self._points.append((len(self._joint_powers), i, a, j, b))
        self._joint_powers += [1.0] * 3

    def revolute(self, i: int, j: int, point: ArrayLike, axis: ArrayLike) -> None:
        """Add five rows: both bodies share a point and an axis."""
        self.spherical(i, j, point)
        axis = np.asarray(axis, dtype=float)
        first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
        for normal in (first, np.cross(axis, first)):
            direction = self._to_body_axes(i, normal / np.linalg.norm(normal), False)
            self._directions.append((len(self._joint_powers), i, direction, j, self._to_body_axes(j, axis, False)))
            self._joint_powers.append(0.0)
        self._axes[len(self._points) - 1] = self._to_body_axes(j, axis / np.linalg.norm(axis), False)

    def _vector(self, q: Array, body: int, a: Array) -> Array:
        return a if body == GROUND else rotate(q[7 * body + 3 : 7 * body + 7], a)

    def _vector_by_e(self, q: Array, body: int, a: Array) -> Array:
        return np.zeros((3, 4)) if body == GROUND else rotate_jacobian(q[7 * body + 3 : 7 * body + 7], a)

    def _rate(self, q: Array, v: Array, body: int, a: Array) -> Array:
        return self._vector_by_e(q, body, a) @ (np.zeros(4) if body == GROUND else v[7 * body + 3 : 7 * body + 7])

    @property
    def parameters(self) -> dict[str, Any]:
        """Return the constants as `KnownProblem.parameters`; inertias: the principal moments (n_bodies, 3)."""
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
            k, G = 7 * body, rate_matrix(q[7 * body + 3 : 7 * body + 7])
            M[k : k + 3, k : k + 3] = m * np.eye(3)
            M[k + 3 : k + 7, k + 3 : k + 7] = 4.0 * G.T @ J @ G
        return M

    def force(self, t: float, q: Array, v: Array) -> Array:
        """Return Q (n_q,): weights and velocity terms."""
        parts: list[Array] = []
        for m, J, x, u in self._body_states(q, v):
            parts += [m * self._gravity, -8.0 * rate_matrix(u[3:]).T @ (J @ (rate_matrix(x[3:]) @ u[3:]))]
        return np.concatenate(parts)

    def _body_states(self, q: Array, v: Array) -> list[tuple[float, Array, Array, Array]]:
        """Return mass, inertia and state (7,), (7,) of each body."""
        states = zip(self._bodies, q.reshape(-1, 7), v.reshape(-1, 7), strict=True)
        return [(m, J, x, u) for (m, J), x, u in states]

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
            for body, vector, partner in ((i, a, self._vector(q, j, b)), (j, b, self._vector(q, i, a))):
                if body != GROUND:
                    J[n + row, 7 * body + 3 : 7 * body + 7] += partner @ self._vector_by_e(q, body, vector)
        return J

    def constraint_rate(self, t: float, q: Array) -> Array:
        """Return C_t (n_c,), zero."""
        return np.zeros(self.n_c)

    def gamma(self, t: float, q: Array, v: Array) -> Array:
        """Return the right-hand side (n_c,) of C_q a = gamma."""
        n = len(self._bodies)
        gamma = np.zeros(self.n_c)
        gamma[:n] = -(v.reshape(n, 7)[:, 3:] ** 2).sum(axis=1)
        zero = np.zeros(3)

        def second_derivative(body: int, a: Array) -> Array:
            """Return the second derivative of a body-fixed vector for e'' = 0."""
            return zero if body == GROUND else 2.0 * rotate(v[7 * body + 3 : 7 * body + 7], a)

        for row, i, a, j, b in self._points:
            gamma[n + row : n + row + 3] = second_derivative(j, b) - second_derivative(i, a)
        for row, i, a, j, b in self._directions:
            total = second_derivative(i, a) @ self._vector(q, j, b) + self._vector(q, i, a) @ second_derivative(j, b)
            gamma[n + row] = -total - 2.0 * self._rate(q, v, i, a) @ self._rate(q, v, j, b)
        return gamma

    def energy(self, t: float, q: Array, v: Array) -> float:
        """Return the kinetic and potential energy, J."""
        total = 0.0
        for m, J, x, u in self._body_states(q, v):
            spin = 2.0 * rate_matrix(x[3:]) @ u[3:]
            total += float(0.5 * m * u[:3] @ u[:3] + 0.5 * spin @ J @ spin)
            total -= float(m * self._gravity @ x[:3])
        return total

    def vertical_momentum(self, t: float, q: Array, v: Array) -> float:
        """Return the angular momentum about the z axis of space, kg m^2/s."""
        total = 0.0
        for m, J, x, u in self._body_states(q, v):
            angular_momentum = rotate(x[3:], J @ (2.0 * rate_matrix(x[3:]) @ u[3:]))
            total += float(angular_momentum[2] + m * (x[0] * u[1] - x[1] * u[0]))
        return total

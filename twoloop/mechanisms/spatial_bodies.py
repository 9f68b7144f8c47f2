"""Assembles mechanisms of spatial bodies from their initial poses, joints and springs."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.points import Sketch, place_of
from twoloop.bodies.rotation import (
    euler_parameters,
    euler_rates,
    half_spin,
    perpendiculars,
    rotated,
    rotation_matrix,
)
from twoloop.mechanisms import spatial
from twoloop.mechanisms.spatial import DIRECTION, GROUND, PLANE, POINT
from twoloop.problem.drawing import Drawing
from twoloop.problem.entries import LARGE
from twoloop.problem.given import callbacks_in
from twoloop.problem.joints import Joint, unused
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

Row = tuple[float, int, Array, int, Array, Array]  # kind, body i, its numbers, body j, its numbers, point s
NAMES = ("x (m)", "y (m)", "z (m)", "e0", "e1", "e2", "e3")


class SpatialBodies:
    """Collects bodies, joints and springs. Points and directions are given in space, at the start.

    Joints are named by kind and bodies: "revolute crank-ground" is the reaction of the ground on the crank.

    Parameters
    ----------
    gravity : array_like (3,)
        m/s^2.
    """

    def __init__(self, gravity: ArrayLike):
        self.gravity = np.asarray(gravity, dtype=float)
        self.n_joint_rows = 0
        self._bodies: list[tuple[float, ...]] = []
        self._names: list[str] = []
        self._q: list[Array] = [np.zeros(0)]
        self._v: list[Array] = [np.zeros(0)]
        self._R: list[Array] = []
        self._joints: list[list[float]] = []
        self._named: dict[str, Joint] = {}  # row numbers without the normalisations
        self._springs: list[list[float]] = []
        self._drawn: list[tuple[int, int, Array]] = []  # bodies of a joint, and its initial position

    def body(
        self,
        name: str,
        mass: float,
        inertia: tuple[float, float, float],
        position: ArrayLike,
        R: ArrayLike,
        velocity: ArrayLike = (0.0, 0.0, 0.0),
        spin: ArrayLike = (0.0, 0.0, 0.0),
    ) -> int:
        """Add a body and return its index.

        Parameters
        ----------
        name : str
        mass : float
            kg.
        inertia : (float, float, float)
            Principal moments about the centre of mass, kg m^2.
        position, velocity : array_like (3,)
            Position and velocity of the centre of mass, m and m/s.
        R : array_like (3, 3)
            Rotation matrix, whose columns are the principal axes.
        spin : array_like (3,)
            Angular velocity along the axes of space, rad/s.
        """
        e = euler_parameters(R)
        self._bodies.append((mass, *inertia))
        self._names.append(name)
        self._R.append(rotation_matrix(e))
        self._q.append(np.concatenate([np.asarray(position, dtype=float), e]))
        self._v.append(np.concatenate([np.asarray(velocity, dtype=float), euler_rates(e, spin)]))
        return len(self._bodies) - 1

    def _along(self, body: int, direction: ArrayLike) -> Array:
        """Transform a direction from space to body axes, at the start."""
        given = np.asarray(direction, dtype=float)
        return given if body == GROUND else self._R[body].T @ given

    def _from_centre(self, body: int, point: ArrayLike) -> Array:
        """Transform a point from space to body axes, relative to the centre, at the start."""
        given = np.asarray(point, dtype=float)
        return given if body == GROUND else self._along(body, given - self._q[body + 1][:3])

    def _coincide(self, i: int, j: int, point: ArrayLike) -> Row:
        return POINT, i, self._from_centre(i, point), j, self._from_centre(j, point), np.zeros(3)

    def _perpendicular(self, i: int, a: ArrayLike, j: int, b: ArrayLike) -> Row:
        return DIRECTION, i, self._along(i, a), j, self._along(j, b), np.zeros(3)

    def _parallel(self, i: int, j: int, axis: ArrayLike) -> list[Row]:
        return [self._perpendicular(i, across, j, axis) for across in perpendiculars(_unit(axis))]

    def _add(self, kind: str, i: int, j: int, point: ArrayLike, *rows: Row) -> None:
        """Add a joint with these rows, acting on body i, or on body j if i is the ground."""
        first = self.n_joint_rows
        for row_kind, one, a, two, b, s in rows:
            self._joints.append([row_kind, float(self.n_joint_rows), float(one), *a, float(two), *b, *s])
            self.n_joint_rows += 3 if row_kind == POINT else 1
        if kind != "prismatic":  # its point is fixed to neither body
            self._drawn.append((i, j, np.asarray(point, dtype=float)))
        body, other = (j, i) if i == GROUND else (i, j)
        name = f"{kind} {self._names[body]}-{'ground' if other == GROUND else self._names[other]}"
        numbered, place = tuple(range(first, self.n_joint_rows)), 7 * body
        position, parameters = tuple(range(place, place + 3)), tuple(range(place + 3, place + 7))
        there = tuple(self._from_centre(body, point))
        name = unused(name, self._named)
        self._named[name] = Joint(name, numbered, position, parameters, there)

    def spherical(self, i: int, j: int, point: ArrayLike) -> None:
        """Add three rows: both bodies share a point."""
        self._add("spherical", i, j, point, self._coincide(i, j, point))

    def revolute(self, i: int, j: int, point: ArrayLike, axis: ArrayLike) -> None:
        """Add five rows: a hinge at a point."""
        self._add("revolute", i, j, point, self._coincide(i, j, point), *self._parallel(i, j, axis))

    def universal(self, i: int, j: int, point: ArrayLike, a: ArrayLike, b: ArrayLike) -> None:
        """Add four rows: a cross at a point, one axis fixed in body i, the other, perpendicular, in body j."""
        self._add("universal", i, j, point, self._coincide(i, j, point), self._perpendicular(i, a, j, b))

    def prismatic(self, i: int, j: int, point: ArrayLike, axis: ArrayLike) -> None:
        """Add five rows: body j slides along an axis of body i through a point, without rotating on it."""
        first, second = perpendiculars(_unit(axis))
        here, there = self._from_centre(i, point), self._from_centre(j, point)
        planes = [(PLANE, i, self._along(i, across), j, there, here) for across in (first, second)]
        turns = *self._parallel(i, j, axis), self._perpendicular(i, first, j, second)
        self._add("prismatic", i, j, point, *planes, *turns)

    def spring(
        self, i: int, a: ArrayLike, j: int, b: ArrayLike, stiffness: float, damping: float, length: float
    ) -> None:
        """Add a spring-damper between the point a of body i and b of body j: N/m, N s/m, m."""
        here, there = self._from_centre(i, a), self._from_centre(j, b)
        self._springs.append([float(i), *here, float(j), *there, stiffness, damping, length])

    def system(self, name: str) -> ConstrainedSystem:
        """Return the system of all parts added."""
        n = len(self._bodies)
        joints = [[joint[0], joint[1] + n, *joint[2:]] for joint in self._joints]  # after the normalisations
        tables = [np.ravel(table) for table in (self._bodies, joints, self._springs)]
        given: dict[str, Any] = callbacks_in(vars(spatial))
        if 7 * n >= LARGE:
            given["mass_entries"], given["jacobian_entries"] = (
                spatial.mass_entries(n),
                spatial.jacobian_entries(n, joints),
            )
        else:
            del given["mass_values"], given["jacobian_values"]
        parameters = np.concatenate([[n, len(self._joints), len(self._springs)], self.gravity, *tables])
        named = [replace(joint, rows=tuple(n + row for row in joint.rows)) for joint in self._named.values()]
        sizes: dict[str, Any] = {"n_q": 7 * n, "n_c": n + self.n_joint_rows}
        return ConstrainedSystem(**sizes, **given, parameters=parameters, joints=named, name=name)

    @property
    def start(self) -> tuple[Array, Array]:
        """Return the initial state q, v (n_q,)."""
        return np.concatenate(self._q), np.concatenate(self._v)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the coordinates."""
        return tuple(f"{coordinate} of {name}" for name in self._names for coordinate in NAMES)

    @property
    def energy(self) -> "Energy":
        """Return the energy as a function of t, q and v."""
        return Energy(np.array(self._bodies), self.gravity, np.array(self._springs).reshape(-1, spatial.SPRING))

    @property
    def drawing(self) -> Drawing:
        """Each body as the box of its mass and moments, with lines from the centre to its joints; springs as lines.

        Paths are drawn for joints between two bodies, and for the centres of bodies with a single joint.
        """
        sketch = Sketch()
        for body, (mass, *moments) in enumerate(self._bodies):
            squares = 6.0 * (sum(moments) - 2.0 * np.array(moments)) / mass
            sketch.add_box(body, np.sqrt(np.maximum(squares, 0.0)))
            if sum(body in (i, j) for i, j, _ in self._drawn) == 1:
                sketch.trace(body, np.zeros(3))
        for i, j, point in self._drawn:
            for body in (i, j):
                if body == GROUND:
                    sketch.point(body, point)
                else:
                    sketch.line((body, np.zeros(3)), (body, self._from_centre(body, point)))
            if GROUND not in (i, j):
                sketch.trace(i, self._from_centre(i, point))
        for spring in self._springs:
            sketch.line((int(spring[0]), spring[1:4]), (int(spring[4]), spring[5:8]))
        return sketch.drawing

    def momentum(self, point: ArrayLike, axis: ArrayLike) -> "Momentum":
        """Return the angular momentum about an axis of space through a point, as a function of t, q and v."""
        return Momentum(np.array(self._bodies), np.asarray(point, dtype=float), np.asarray(axis, dtype=float))


def _unit(axis: ArrayLike) -> Array:
    given = np.asarray(axis, dtype=float)
    return given / np.linalg.norm(given)


def _states(q: Array, v: Array) -> tuple[Array, Array]:
    """Return the states of the bodies, (n, 7) or (n, 7, n_t)."""
    q, v = np.asarray(q), np.asarray(v)
    shape = (-1, 7, *q.shape[1:])
    return q.reshape(shape), v.reshape(shape)


def _spins(q: Array, v: Array) -> Array:
    """Return angular velocities in body axes, (n, 3) or (n, 3, n_t)."""
    e, u = np.moveaxis(q[:, 3:], 1, 0), np.moveaxis(v[:, 3:], 1, 0)
    return 2.0 * np.stack(half_spin.py_func(*e, *u), axis=1)


@dataclass(frozen=True, eq=False)
class Energy:
    """Kinetic energy, potentials of gravity and springs, J, for one state or many."""

    bodies: Array
    gravity: Array
    springs: Array

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate for one state, or for many given as columns."""
        flat = np.asarray(q)
        q, v = _states(q, v)
        masses, inertias = self.bodies[:, 0], self.bodies[:, 1:]
        kinetic = np.einsum("i,ij...->...", masses, v[:, :3] ** 2)
        kinetic += np.einsum("ij,ij...->...", inertias, _spins(q, v) ** 2)
        total = 0.5 * kinetic - np.einsum("i,j,ij...->...", masses, self.gravity, q[:, :3])
        for spring in self.springs:
            gap = place_of(flat, int(spring[4]), spring[5:8]) - place_of(flat, int(spring[0]), spring[1:4])
            total = total + 0.5 * spring[8] * (np.sqrt((gap**2).sum(axis=0)) - spring[10]) ** 2
        return total


@dataclass(frozen=True, eq=False)
class Momentum:
    """Angular momentum about an axis of space through a point, kg m^2/s, for one state or many."""

    bodies: Array
    point: Array
    axis: Array

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate for one state, or for many given as columns."""
        q, v = _states(q, v)
        spins = _spins(q, v)
        total: Any = 0.0
        for (mass, *inertia), state, rate, spin in zip(self.bodies, q, v, spins, strict=True):
            arm = state[:3] - self.point.reshape(3, *(1,) * (state.ndim - 1))
            own = rotated.py_func(*state[3:], *(np.array(inertia) * spin.T).T)
            moment = np.cross(arm, rate[:3], axis=0) * mass + np.array(own)
            total = total + np.tensordot(self.axis, moment, axes=1)
        return total

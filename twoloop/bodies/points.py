"""Points of bodies as functions of the coordinates of the ready mechanisms, for drawings and energies."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from twoloop.bodies.rotation import rotated
from twoloop.checks.arguments import Array, check_columns
from twoloop.problem.description import Drawing

GROUND = -1


@dataclass(frozen=True, eq=False)
class LinearPoints:
    """Points that are linear in the coordinates.

    Attributes
    ----------
    matrix : ndarray (n_points, 2 or 3, n_q)
    constant : ndarray (n_points, 2 or 3)
    """

    matrix: Array
    constant: Array

    def __call__(self, q: Array) -> Any:
        """Return the points at q (n_q,) or (n_q, n_t)."""
        return np.tensordot(self.matrix, q, 1) + self.constant.reshape(*self.constant.shape, *(1,) * (q.ndim - 1))


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """Points of bodies whose coordinates are x, y and an angle (2-D), or x, y, z and four Euler parameters (3-D).

    Attributes
    ----------
    bodies : sequence of int
        The body of each point; -1 is the ground.
    points : ndarray (n_points, 2 or 3)
        In body axes, relative to the centre of mass.
    """

    bodies: Sequence[int]
    points: Array

    def __call__(self, q: Array) -> Any:
        """Return the points at q (n_q,) or (n_q, n_t)."""
        return np.stack([place_of(q, *each) for each in zip(self.bodies, self.points, strict=True)])


def direction_of(q: Array, body: int, vector: Array) -> Array:
    """Transform a vector from body axes to space, (2 or 3,) or (2 or 3, n_t), at q (n_q,) or (n_q, n_t)."""
    if body == GROUND:
        return vector.reshape(-1, *(1,) * (q.ndim - 1)) + np.zeros(q.shape[1:])
    if len(vector) == 2:
        s, c = np.sin(q[3 * body + 2]), np.cos(q[3 * body + 2])
        return np.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])
    return np.stack(rotated.py_func(*q[7 * body + 3 : 7 * body + 7], *vector))


def place_of(q: Array, body: int, point: Array) -> Array:
    """Transform a point from body axes, relative to the centre of mass, to space; shapes as for `direction_of`."""
    turned, first = direction_of(q, body, point), (3 if len(point) == 2 else 7) * body
    return turned if body == GROUND else q[first : first + len(point)] + turned


@dataclass(frozen=True, eq=False)
class PlanarEnergy:
    """Kinetic energy and potential of gravity of planar bodies, J, for one state or many."""

    masses: Array
    inertias: Array
    gravity: float

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate for one state, or for many given as columns."""
        q, v = np.asarray(q), np.asarray(v)
        check_columns("q", q, 3 * len(self.masses))
        check_columns("v", v, 3 * len(self.masses))
        kinetic = 0.5 * (self.masses @ (v[0::3] ** 2 + v[1::3] ** 2) + self.inertias @ v[2::3] ** 2)
        return kinetic + self.gravity * (self.masses @ q[1::3])


def box(size: Any) -> tuple[Array, list[tuple[int, int]]]:
    """Return the corners (8, 3) of a box with edges (3,) about its centre, or (4, 2) of a rectangle, and its edges."""
    dimension = len(size)
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * dimension, indexing="ij")).reshape(dimension, -1).T
    edges = [(i, j) for i in range(len(corners)) for j in range(i) if np.count_nonzero(corners[i] != corners[j]) == 1]
    return corners * np.asarray(size), edges


class Sketch:
    """Collects points of bodies and lines between them."""

    def __init__(self) -> None:
        self.bodies: list[int] = []
        self.points: list[Array] = []
        self._on: dict[int, list[int]] = {}  # indices of the points of a body
        self.bars: list[tuple[int, int]] = []
        self.traces: list[int] = []

    def point(self, body: int, point: Any) -> int:
        """Return the index of a point, which is added if it is new."""
        place = np.asarray(point, dtype=float)
        there = self._on.setdefault(body, [])
        for number in there:
            if np.abs(self.points[number] - place).max() < 1e-12:
                return number
        there.append(len(self.bodies))
        self.bodies.append(body)
        self.points.append(place)
        return len(self.bodies) - 1

    def line(self, first: tuple[int, Any], second: tuple[int, Any]) -> None:
        """Add a line between two points, each given as a body and a point on it."""
        bar = (self.point(*first), self.point(*second))
        if bar[0] != bar[1] and bar not in self.bars:
            self.bars.append(bar)

    def add_box(self, body: int, size: Any) -> None:
        """Add a box, or a rectangle, about the centre of a body; edges of length zero are left out."""
        corners, edges = box(size)
        for i, j in edges:
            self.line((body, corners[i]), (body, corners[j]))

    def add_body(self, body: int, points: Sequence[Any], far: float, size: Any) -> None:
        """Add lines between the points of a body; a single off-centre point is extended to `far` times; none: a box."""
        places = [np.asarray(point, dtype=float) for point in points]
        if len(places) == 1 and places[0].any():
            places.append(far * places[0])
            self.trace(body, places[1])
        if len(places) < 2:
            self.add_box(body, size)
        for first, second in pairwise(places):
            self.line((body, first), (body, second))

    def trace(self, body: int, point: Any) -> None:
        """Add the path of a point."""
        number = self.point(body, point)
        if number not in self.traces:
            self.traces.append(number)

    @property
    def drawing(self) -> Drawing:
        """Return the drawing."""
        return Drawing(BodyPoints(tuple(self.bodies), np.array(self.points)), tuple(self.bars), tuple(self.traces))

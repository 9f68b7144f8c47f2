"""Draw mechanisms: bodies as lines between their joints or as boxes, springs as lines, paths of points."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from twoloop.bodies.frames import body_points
from twoloop.bodies.parameter_layout import SPRING, ZERO_LENGTH_SPRING
from twoloop.checks.arguments import Array
from twoloop.problem.description import Drawing

if TYPE_CHECKING:
    from twoloop.bodies.parts import Body
    from twoloop.bodies.tables import Tables


def box(size: Any) -> tuple[Array, list[tuple[int, int]]]:
    """Return the corners (8, 3) of a box with edges (3,) about its centre, or (4, 2) of a rectangle, and its edges."""
    dimension = len(size)
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * dimension, indexing="ij")).reshape(dimension, -1).T
    edges = [(i, j) for i in range(len(corners)) for j in range(i) if np.count_nonzero(corners[i] != corners[j]) == 1]
    return corners * np.asarray(size), edges


class Sketch:
    """Collect points of bodies and lines between them."""

    def __init__(self) -> None:
        self.bodies: list[int] = []
        self.points: list[Array] = []
        self._on: dict[int, list[int]] = {}  # indices of the points of a body
        self.bars: list[tuple[int, int]] = []
        self.traces: list[int] = []

    def point(self, body: int, point: Any) -> int:
        """Return the index of a point, which is added if it is new."""
        place = np.asarray(point, dtype=float)
        on_body = self._on.setdefault(body, [])
        for number in on_body:
            if np.abs(self.points[number] - place).max() < 1e-12:
                return number
        on_body.append(len(self.bodies))
        self.bodies.append(body)
        self.points.append(place)
        return len(self.bodies) - 1

    def line(self, first: tuple[int, Any], second: tuple[int, Any]) -> None:
        """Add a line between two points, each given as a body and a point on it."""
        bar = (self.point(*first), self.point(*second))
        if bar[0] != bar[1] and bar not in self.bars:
            self.bars.append(bar)

    def add_body(self, body: int, points: Sequence[Any], far: float, size: Any) -> None:
        """Add lines between the points of a body; a single off-centre point is extended to `far` times; none: a box."""
        places = [np.asarray(point, dtype=float) for point in points]
        if len(places) == 1 and places[0].any():
            places.append(far * places[0])
            self.trace(body, places[1])
        if len(places) < 2:
            corners, edges = box(size)
            for i, j in edges:  # `line` leaves out edges of length zero
                self.line((body, corners[i]), (body, corners[j]))
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
        points = partial(body_points, tuple(self.bodies), np.array(self.points))
        return Drawing(points, tuple(self.bars), tuple(self.traces))


def drawing_of(tables: Tables) -> Drawing:
    """Return bodies as lines between joints; with one joint from the centre of mass to it, without joints as a box."""
    sketch = Sketch()
    ends: dict[str, list[Array]] = {body.name: [] for body in tables.bodies}
    for joint in tables.joints:
        for body, numbers in ((joint.a, joint.point_a), (joint.b, joint.point_b)):
            place = tables.of(numbers).copy()
            if body.name not in ends:
                sketch.point(body.number, place)
            elif not any(np.abs(place - end_b).max() < 1e-12 for end_b in ends[body.name]):
                ends[body.name].append(place)
    for body in tables.bodies:
        sketch.add_body(body.number, ends[body.name], 0.0, _size(body))
    for joint in tables.joints:
        if joint.kind == "revolute" and joint.a.number >= 0 and joint.b.number >= 0:
            sketch.trace(joint.a.number, tables.of(joint.point_a).copy())
    for joint in tables.joints:
        for (one, at_one), (other, at_other) in pairwise(joint.path):
            sketch.line((one.number, at_one.values), (other.number, at_other.values))
    for force in tables.forces:
        if force.kind in (SPRING, ZERO_LENGTH_SPRING):
            assert force.on_first is not None and force.on_second is not None
            end_a, end_b = tables.of(force.on_first), tables.of(force.on_second)
            sketch.line((force.first.number, end_a.copy()), (force.second.number, end_b.copy()))
    return sketch.drawing


def _size(body: Body) -> Array:
    """Return the edges of the box or square with the mass and moments of inertia of a body."""
    mass, moments = body.inertia[0], body.inertia[1:4]
    if mass == 0.0:
        return np.zeros(len(body.position))
    if len(moments) == 1:
        return np.full(2, np.sqrt(6.0 * moments[0] / mass))
    return np.asarray(np.sqrt(np.maximum(6.0 * (moments.sum() - 2.0 * moments) / mass, 0.0)))

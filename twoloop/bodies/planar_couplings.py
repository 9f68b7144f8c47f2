"""Planar joints that couple motions: rolling wheels, blades, points on curves, and the rows of gears and racks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from twoloop.bodies.documented import documented
from twoloop.bodies.gears import Gears, Row
from twoloop.bodies.parameter_layout import RATE
from twoloop.bodies.parts import Body, JointRow, ModelJoint, Numbers
from twoloop.bodies.places import placed, turned
from twoloop.bodies.row_function import RateFunction
from twoloop.checks.arguments import check_positive


@documented
class Couplings(Gears):
    """Adds couplings to a planar model. Their constants are not parameters of the model."""

    def _gear_row(self, one: ModelJoint, other: ModelJoint, ratio: float) -> Row:
        return lambda q: _turned(q, other) - ratio * _turned(q, one)

    def _rack_row(self, pinion: ModelJoint, slide: ModelJoint, radius: float) -> Row:
        angle = float(np.arctan2(*self._axis(slide)[::-1]))
        ends = [np.array(point.values) for point in (slide.point_a, slide.point_b)]

        def slid(q: Any) -> Any:
            return _along(q, slide.a, angle, ends[0], slide.b, ends[1])

        start = slid(self._start())
        return lambda q: slid(q) - start - radius * _turned(q, pinion)

    def rolling(
        self, a: Body | str, wheel: Body | str, *, radius: float, axis: Any, name: str | None = None
    ) -> ModelJoint:
        """Let a wheel, whose centre of mass is its centre, roll without slipping on a line of a.

        The reaction is that on a, or on the wheel if a is the ground.

        Parameters
        ----------
        a, wheel : Body or str
            In the position given, the line is `radius` to the right of the centre of the wheel, looking along the axis.
        radius : float
            m.
        axis : array_like (2,) or BodyDirection
            Direction of the line.
        """
        first, second, name, named = self._pair("rolling", a, wheel, name, None)
        points = Numbers(named[0].values), Numbers(named[1].values)
        if second is self.ground:
            raise ValueError("wheel must be a body that moves; given the ground")
        check_positive("radius", radius)
        direction = self._direction("axis", axis, first)
        angle, foot = float(np.arctan2(*direction[::-1])), np.array(points[0].values)
        zero, joint = np.zeros(2), ModelJoint(name, "rolling", first, second, (), *points)
        rows = [
            lambda q: _along(q, first, angle + 0.5 * np.pi, foot, second, zero),
            lambda q: _along(q, first, angle, foot, second, zero) + radius * _turned(q, joint),
        ]
        return self._coupled(name, "rolling", joint, rows, joint)

    def skate(self, body: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a blade, or a thin wheel seen from above: its point moves only along an axis of the body (non-holonomic).

        The reaction is the force on the body across the blade.

        Parameters
        ----------
        body : Body or str
        at : array_like (2,) or BodyPoint
            The point, in space in the position given, m.
        axis : array_like (2,) or BodyDirection
            Direction of the blade, in space in the position given.
        """
        on = self._moving_body("body", body)
        name = self._new_name("skate", name, on)
        place, (x, y) = self._point("at", at, on), self._direction("axis", axis, on)

        def across(q: Any, v: Any) -> Any:
            (rx, ry), (nx, ny) = turned(q, on, place), turned(q, on, np.array([-y, x]))
            u, w, spin = (v[j] for j in on.coordinates)
            return nx * (u - spin * ry) + ny * (w + spin * rx)

        columns = on.coordinates
        places = Numbers((float(len(columns)), *map(float, columns)))
        points = Numbers(tuple(on.in_space(place))), Numbers(tuple(place))
        function = RateFunction(f"skate {name!r}", across, columns)
        row = JointRow(RATE, 1, self.ground, on, *points, places, function)
        return self._add_joint(ModelJoint(name, "skate", self.ground, on, (row,), *points))

    def point_on_curve(
        self, a: Body | str, b: Body | str, *, at: Any, curve: Callable[[Any, Any], Any], name: str | None = None
    ) -> ModelJoint:
        """Keep a point of b on a curve of a, like a pin in a slot or the tip of a follower on its cam.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (2,) or BodyPoint
            The point of b, in space in the position given, m.
        curve : callable
            curve(x, y), zero on the curve, e.g. `lambda x, y: y - 0.1 * np.cos(5.0 * x)`, from numpy functions without
            branches; x and y in the axes of a relative to its centre of mass (ground: in space), m. Its gradient must
            not vanish on the curve.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid, or the curve cannot be traced.
        """
        first, second = self._body("a", a), self._body("b", b)
        self._different("point_on_curve", first, second)
        name = self._new_name("point on curve", name, first, second)
        if not callable(curve):
            raise TypeError(f"curve of {name!r} must be a function of x and y; given {curve!r}")
        there = self._point("at", at, second)
        here = first.local_point(second.in_space(there))
        points = Numbers(tuple(here)), Numbers(tuple(there))

        def off(q: Any) -> Any:
            return curve(*_in_body_axes(q, first, placed(q, second, there)))

        joint = ModelJoint(name, "point on curve", first, second, (), *points)
        return self._coupled(name, "point on curve", joint, [off], joint)


def _angle(q: Any, body: Body) -> Any:
    return 0.0 if body.number < 0 else q[body.coordinates[2]]


def _turned(q: Any, joint: ModelJoint) -> Any:
    """Return the rotation of b relative to a since the position given."""
    return _angle(q, joint.b) - _angle(q, joint.a) - (joint.b.rotation - joint.a.rotation)


def _along(q: Any, a: Body, angle: float, here: Any, b: Body, there: Any) -> Any:
    """Return the displacement of a point of b from a point of a along a direction of a."""
    (x, y), (u, w) = placed(q, a, here), placed(q, b, there)
    total = _angle(q, a) + angle
    return np.cos(total) * (u - x) + np.sin(total) * (w - y)


def _in_body_axes(q: Any, body: Body, point: list[Any]) -> list[Any]:
    """Transform a point from space to the axes of a body."""
    if body.number < 0:
        return point
    x, y = (each - q[j] for each, j in zip(point, body.coordinates, strict=False))
    s, c = np.sin(_angle(q, body)), np.cos(_angle(q, body))
    return [c * x + s * y, c * y - s * x]

"""Stops of a model: planes that points of bodies cannot cross, and limits of joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.bodies.documented import documented
from twoloop.bodies.loads import Loads
from twoloop.bodies.parts import Body, ModelJoint
from twoloop.bodies.places import placed, turned
from twoloop.checks.arguments import Array, check_finite, check_not_negative
from twoloop.problem.description import Stop


@dataclass(frozen=True, eq=False)
class PlaneGap:
    """Distance of a point of one body from a plane of another, m."""

    body: Body
    place: Array
    other: Body
    foot: Array
    normal: Array

    def __call__(self, t: Any, q: Any) -> Any:
        """Return the distance, for numbers or symbols."""
        one, two = placed(q, self.body, self.place), placed(q, self.other, self.foot)
        return sum(n * (x - y) for n, x, y in zip(turned(q, self.other, self.normal), one, two, strict=True))


@dataclass(frozen=True, eq=False)
class PlaneSlide(PlaneGap):
    """Displacement of a point of one body along a line of another, m."""

    def __call__(self, t: Any, q: Any) -> Any:
        """Return the displacement, for numbers or symbols."""
        x, y = self.normal
        return PlaneGap(self.body, self.place, self.other, self.foot, np.array([y, -x]))(t, q)


@dataclass(frozen=True, eq=False)
class TurnGap:
    """Angle between a planar hinge and its limit, rad."""

    joint: ModelJoint
    limit: float
    sign: float

    def __call__(self, t: Any, q: Any) -> Any:
        """Return the remaining angle, for numbers or symbols."""
        ends = (self.joint.b, self.joint.a)
        one, two = (0.0 if body.number < 0 else q[body.coordinates[2]] - body.rotation for body in ends)
        return self.sign * (one - two - self.limit)


@documented
class Stops(Loads):
    """Adds stops to a model, for `twoloop.solve_with_stops`."""

    def stop(
        self,
        body: Body | str,
        at: Any,
        other: Body | str,
        foot: Any,
        *,
        normal: Any,
        restitution: float = 0.0,
        friction: float = 0.0,
        name: str | None = None,
    ) -> Stop:
        """Add a plane on one body that a point of another body cannot cross.

        Parameters
        ----------
        body : Body or str
        at : array_like (2 or 3,) or BodyPoint
            The point, in space in the position given, m.
        other : Body or str
            The body with the plane; the ground for a floor or a wall.
        foot : array_like (2 or 3,) or BodyPoint
            A point of the plane, m.
        normal : array_like (2 or 3,) or BodyDirection
            Normal of the plane, on the side of the point.
        restitution : float
            Coefficient of restitution, from 0 to 1.
        friction : float
            Coefficient of Coulomb friction; in space it must be zero.
        """
        one, two = self._body("body", body), self._body("other", other)
        self._different("stop", one, two)
        name = self._new_name("stop", name, one, two)
        places = self._point("at", at, one), two, self._point("foot", foot, two), self._direction("normal", normal, two)
        if check_not_negative("friction", friction) and self.dimension == 3:
            raise ValueError(f"friction of {name!r} must be zero, as stops rub in the plane only; given {friction!r}")
        slide = PlaneSlide(one, *places) if friction else None
        return self._add_stop(Stop(PlaneGap(one, *places), restitution, name, friction, slide))

    def limit(
        self,
        joint: ModelJoint | str,
        *,
        lower: float | None = None,
        upper: float | None = None,
        restitution: float = 0.0,
        name: str | None = None,
    ) -> tuple[Stop, ...]:
        """Add limits to a revolute joint in the plane or to a prismatic joint.

        Parameters
        ----------
        joint : ModelJoint or str
        lower, upper : float, optional
            Bounds of the displacement of b on a from the position given, rad or m. None: unbounded.
        restitution : float
            Coefficient of restitution, from 0 to 1.
        name : str, optional
            Prefix of the names "lower limit" and "upper limit". None: the name of the joint.

        Returns
        -------
        tuple of Stop

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid, or no limit is given.
        """
        kinds = ("revolute", "prismatic") if self.dimension == 2 else ("prismatic",)
        limited = self._joint(joint, kinds, "limit")
        given = {"lower": (lower, 1.0), "upper": (upper, -1.0)}
        if lower is None and upper is None:
            raise ValueError(f"limit of {limited.name!r} needs lower, upper, or both")
        if lower is not None and upper is not None and not lower < upper:
            raise ValueError(f"lower of the limit of {limited.name!r} must be below upper; given {lower!r}, {upper!r}")
        made = []
        for which, (value, sign) in given.items():
            if value is not None:
                new = self._new_name(f"{which} limit of {limited.name if name is None else name}", None)
                gap = self._gap(limited, check_finite(which, value), sign)
                made.append(self._add_stop(Stop(gap, restitution, new)))
        return tuple(made)

    def _gap(self, joint: ModelJoint, limit: float, sign: float) -> Any:
        if joint.kind == "revolute":
            return TurnGap(joint, limit, sign)
        axis = self._axis(joint)
        there = (
            joint.b.in_space(np.array(joint.point_b.values)) if joint.b.number >= 0 else np.array(joint.point_b.values)
        )
        foot = joint.a.local_point(there) + limit * axis
        return PlaneGap(joint.b, np.array(joint.point_b.values), joint.a, foot, sign * axis)

    def _axis(self, joint: ModelJoint) -> Array:
        """Return the axis of a prismatic joint in the axes of a."""
        raise NotImplementedError

    def _add_stop(self, stop: Stop) -> Stop:
        self.stops.append(stop)
        return stop

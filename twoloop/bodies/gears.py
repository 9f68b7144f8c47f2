"""Gears and racks: joints that couple the motions of two joints, in the plane and in space."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twoloop.bodies.documented import documented
from twoloop.bodies.model import Model
from twoloop.bodies.parameter_layout import WRITTEN
from twoloop.bodies.parts import JointRow, ModelJoint, Numbers
from twoloop.bodies.row_function import RowFunction
from twoloop.checks.arguments import check_finite

Row = Callable[[Any], Any]


@documented
class Gears(Model):
    """Adds gears and racks to a model. Their constants are not parameters of the model."""

    def gear(
        self, one: ModelJoint | str, other: ModelJoint | str, *, ratio: float, name: str | None = None
    ) -> ModelJoint:
        """Couple two hinges: `other` turns by `ratio` times the rotation of `one`, from the position given.

        The reaction is a torque on the bodies of `other`.

        Parameters
        ----------
        one, other : ModelJoint or str
            Revolute joints; the rotation is that of b relative to a. For two wheels on one carrier, a is the carrier.
        ratio : float
            Negative for external gears: minus the radius of `one` over that of `other`. In space a ratio of whole
            numbers up to 1000, as of teeth, because coordinates there do not count turns.
        """
        first, second = self._two(one, "revolute", other, "revolute", "gear")
        factor = check_finite("ratio", ratio)
        if factor == 0.0:
            raise ValueError("ratio must not be zero: the other hinge would be held; use fixed(...) for that")
        row = self._gear_row(first, second, factor)
        name = self._new_name(f"gear of {first.name} and {second.name}", name)
        return self._coupled(name, "gear", second, [row], first)

    def rack(
        self, pinion: ModelJoint | str, slide: ModelJoint | str, *, radius: float, name: str | None = None
    ) -> ModelJoint:
        """Couple a pinion to a rack: the slide moves by `radius` times the pinion's rotation since the position given.

        Parameters
        ----------
        pinion, slide : ModelJoint or str
            A revolute and a prismatic joint.
        radius : float
            m; negative if a positive rotation moves the slide against its axis.
        """
        first, second = self._two(pinion, "revolute", slide, "prismatic", "rack")
        factor = check_finite("radius", radius)
        if factor == 0.0:
            raise ValueError("radius must not be zero: the slide would be held; use fixed(...) for that")
        name = self._new_name(f"rack of {first.name} and {second.name}", name)
        return self._coupled(name, "rack", second, [self._rack_row(first, second, factor)], first)

    def _gear_row(self, one: ModelJoint, other: ModelJoint, ratio: float) -> Row:
        raise NotImplementedError

    def _rack_row(self, pinion: ModelJoint, slide: ModelJoint, radius: float) -> Row:
        raise NotImplementedError

    def _two(self, one: Any, kind: str, other: Any, other_kind: str, what: str) -> tuple[ModelJoint, ModelJoint]:
        first, second = self._joint(one, (kind,), what), self._joint(other, (other_kind,), what)
        if first is second:
            raise ValueError(f"a {what} needs two joints; given {first.name!r} twice")
        return first, second

    def _coupled(self, name: str, kind: str, acts: ModelJoint, rows: list[Row], also: ModelJoint) -> ModelJoint:
        """Add the joint whose rows are functions of the coordinates of the bodies of two joints."""
        columns = tuple(sorted({j for joint in (acts, also) for body in (joint.a, joint.b) for j in body.coordinates}))
        places = Numbers((float(len(columns)), *map(float, columns)))
        ends = acts.a, acts.b, acts.point_a, acts.point_b
        functions = (RowFunction(f"{kind} {name!r}", row, columns) for row in rows)
        made = tuple(JointRow(WRITTEN, 1, *ends, places, each) for each in functions)
        return self._add_joint(ModelJoint(name, kind, acts.a, acts.b, made, acts.point_a, acts.point_b))

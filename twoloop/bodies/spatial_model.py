"""Models in space."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.collection import Points
from twoloop.bodies.documented import documented
from twoloop.bodies.functions import Function
from twoloop.bodies.parameter_layout import AXIAL, LENGTH, PLANE, POINT, SLIDE, TORSION, TURN
from twoloop.bodies.parts import Body, Force, JointRow, ModelJoint, Numbers
from twoloop.bodies.rotation import euler_parameters, euler_rates, perpendiculars, rotation_matrix
from twoloop.bodies.spatial_rows import across, on_line, parallel, relative
from twoloop.bodies.wheels import Wheels
from twoloop.checks.arguments import Array, shown

PERPENDICULAR_TO = 1e-6  # largest cosine of the angle between the axes of a universal joint


@documented
class SpatialModel(Wheels):
    """A spatial mechanism made of bodies, joints and forces.

    The coordinates are x, y, z of the centre of mass of each body and its four Euler parameters. Points and axes are
    given in space, in the position in which the bodies are given, or on a body by `body.point(...)` and
    `body.direction(...)`.

    Parameters
    ----------
    gravity : array_like (3,)
        m/s^2.
    name : str

    Attributes
    ----------
    ground : Body
    bodies, joints, forces : list
        The parts added so far.
    ignored : tuple of str
        Parts of a file that were ignored, see `from_mjcf`.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid.

    Examples
    --------
    >>> from twoloop.bodies import SpatialModel
    >>> model = SpatialModel(name="pendulum")
    >>> rod = model.rod("rod", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0.02, mass=1.0)
    >>> pin = model.revolute("ground", rod, at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    >>> model.problem((0.0, 1.0)).freedom.degrees
    1
    """

    ignored: tuple[str, ...] = ()  # parts of a file without a counterpart
    coordinate_names = ("x (m)", "y (m)", "z (m)", "e0 (-)", "e1 (-)", "e2 (-)", "e3 (-)")
    distance_kind = LENGTH

    def __init__(self, gravity: ArrayLike = (0.0, 0.0, -9.81), *, name: str = "spatial model"):
        super().__init__(gravity, name)

    def spherical(self, a: Body | str, b: Body | str, *, at: Any, name: str | None = None) -> ModelJoint:
        """Add a spherical joint: both bodies share a point.

        Parameters
        ----------
        a, b : Body or str
            The bodies, or their names.
        at : array_like (3,) or (BodyPoint, BodyPoint)
            The point, in space in the position given, m; or a point of a and a point of b, which the joint brings
            together.
        """
        first, second, name, points = self._pair("spherical", a, b, name, at)
        rows = (JointRow(POINT, 3, first, second, *points),)
        return self._add_joint(ModelJoint(name, "spherical", first, second, rows, *points))

    def revolute(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a revolute joint: b rotates on a about an axis.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (3,) or (BodyPoint, BodyPoint)
            A point on the axis, m.
        axis : array_like (3,) or (BodyDirection, BodyDirection)
            Direction, of any length.
        """
        first, second, name, points = self._pair("revolute", a, b, name, at)
        one, other = self._directions(axis, first, second)
        rows = JointRow(POINT, 3, first, second, *points), *parallel(first, one, second, other)
        return self._add_joint(ModelJoint(name, "revolute", first, second, rows, *points, (one, other)))

    def universal(self, a: Body | str, b: Body | str, *, at: Any, axes: Any, name: str | None = None) -> ModelJoint:
        """Add a universal joint: one axis of the cross is fixed in a, the other, perpendicular to it, in b.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (3,) or (BodyPoint, BodyPoint)
            Its centre, m.
        axes : (array_like (3,), array_like (3,)) or (BodyDirection, BodyDirection)
            The axis in a and the axis in b.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid, or the axes are not perpendicular.
        """
        if not isinstance(axes, (tuple, list, np.ndarray)) or len(axes) != 2:
            raise ValueError(f"axes must be two directions, the axis in a and the axis in b; given {shown(axes)}")
        first, second, name, points = self._pair("universal", a, b, name, at)
        one, other = self._direction("axes[0]", axes[0], first), self._direction("axes[1]", axes[1], second)
        cosine = float((first.rotation @ one) @ (second.rotation @ other))
        if not any(hasattr(each, "body") for each in axes) and abs(cosine) > PERPENDICULAR_TO:
            raise ValueError(
                f"axes of {name!r} must be perpendicular; given {shown(axes)}, whose cosine is {cosine:.6g}"
            )
        rows = JointRow(POINT, 3, first, second, *points), across(first, one, second, other)
        return self._add_joint(ModelJoint(name, "universal", first, second, rows, *points, (one, other)))

    def cylindrical(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a cylindrical joint: b slides along an axis of a and rotates about it.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (3,) or (BodyPoint, BodyPoint)
            A point on the axis, m.
        axis : array_like (3,) or (BodyDirection, BodyDirection)
            Direction, of any length.
        """
        first, second, name, points = self._pair("cylindrical", a, b, name, at)
        one, other = self._directions(axis, first, second)
        rows = *on_line(first, one, second, *points), *parallel(first, one, second, other)
        return self._add_joint(ModelJoint(name, "cylindrical", first, second, rows, *points, (one, other)))

    def prismatic(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a prismatic joint: b slides along an axis of a without rotating on it.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (3,) or (BodyPoint, BodyPoint)
            A point on the axis, m.
        axis : array_like (3,) or (BodyDirection, BodyDirection)
            Direction, of any length.
        """
        first, second, name, points = self._pair("prismatic", a, b, name, at)
        one, other = self._directions(axis, first, second)
        first_across, third = perpendiculars(one)
        held = across(first, first_across, second, relative(first, one, second, other).T @ third)
        rows = *on_line(first, one, second, *points), *parallel(first, one, second, other), held
        return self._add_joint(ModelJoint(name, "prismatic", first, second, rows, *points, (one, other)))

    def planar(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a planar joint: b slides in a plane of a and rotates about its normal.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (3,) or (BodyPoint, BodyPoint)
            A point in the plane, m.
        axis : array_like (3,) or (BodyDirection, BodyDirection)
            Normal of the plane, of any length.
        """
        first, second, name, points = self._pair("planar", a, b, name, at)
        one, other = self._directions(axis, first, second)
        plane = JointRow(PLANE, 1, first, second, Numbers(tuple(one)), points[1], points[0])
        rows = plane, *parallel(first, one, second, other)
        return self._add_joint(ModelJoint(name, "planar", first, second, rows, *points, (one, other)))

    def to_mjcf(self, path: str | os.PathLike[str]) -> None:
        """Write the model to a file that MuJoCo reads, see `twoloop.bodies.from_mjcf`.

        Joints become hinges, slides and balls of a tree of bodies; joints that close loops become connect and weld
        equalities. Springs become stiffness and damping of joints, or tendons.

        Parameters
        ----------
        path : path-like

        Warns
        -----
        IgnoredWarning
            If the model has velocities, forces, motors, drives, friction or stops, which the file does not contain.

        Raises
        ------
        ValueError
            If MJCF has no counterpart of a joint, or cannot close a loop with it.
        """
        from twoloop.bodies.mjcf_writer import write

        write(self, path)

    def _weld(self, name: str, a: Body, b: Body, points: Points) -> tuple[JointRow, ...]:
        there = b.rotation.T @ a.rotation
        pairs = ((0, 1), (0, 2), (1, 2))
        return JointRow(POINT, 3, a, b, *points), *(across(a, np.eye(3)[i], b, there[:, j]) for i, j in pairs)

    def _no_rotation(self) -> Array:
        return np.eye(3)

    def _axis(self, joint: ModelJoint) -> Array:
        return joint.axes[0]

    def _drive_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        one, other = joint.axes
        if joint.kind == "prismatic":
            along = Numbers(tuple(one))
            return JointRow(PLANE, 1, joint.a, joint.b, along, joint.point_b, joint.point_a, motion)
        first, second = perpendiculars(one)
        zero = relative(joint.a, one, joint.b, other).T @ first
        return JointRow(TURN, 1, joint.a, joint.b, Numbers((*first, *second)), Numbers(tuple(zero)), None, motion)

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        one, other = joint.axes
        zero = euler_parameters(relative(joint.a, one, joint.b, other))
        here, there = (euler_parameters(body.rotation) for body in (joint.a, joint.b))
        w = here[0] * there[0] + here[1:] @ there[1:]
        x = here[0] * there[1:] - there[0] * here[1:] - np.cross(here[1:], there[1:])
        zero = zero if zero @ np.append(w, x) > 0.0 else -zero  # the sign of the initial Euler parameters
        axis, start = Numbers(tuple(one)), Numbers(tuple(zero))
        return Force(name, TORSION, joint.a, joint.b, axis, start, numbers, joint=joint)

    def _motor(self, name: str, joint: ModelJoint, unit: str, f: Any) -> Force:
        function, more = self._function(name, f, 1, unit)
        axis = Numbers(tuple(joint.axes[0]))
        if joint.kind == "revolute":
            return Force(name, AXIAL, joint.a, joint.b, axis, None, more, function, joint=joint)
        return Force(name, SLIDE, joint.a, joint.b, axis, joint.point_b, more, function, joint=joint)

    def _along(self, name: str, kind: int, joint: ModelJoint, numbers: Numbers | None) -> Force:
        axis = Numbers(tuple(joint.axes[0]))
        places = axis, joint.point_b, numbers
        return Force(name, kind, joint.a, joint.b, *places, point_on_first=joint.point_a, joint=joint)

    def _first_row(self) -> int:
        return len(self.bodies)

    def _start(self) -> Array:
        return np.concatenate([[*body.position, *euler_parameters(body.rotation)] for body in self.bodies])

    def _turning_rates(self, state: Array, spin: Array) -> Array:
        return euler_rates(state[3:], spin)

    def _check_branches(self, t: float, q: Array) -> None:
        super()._check_branches(t, q)
        for joint in self.joints:
            row = joint.rows[0]
            if row.kind != TURN or row.motion is None:
                continue
            assert row.on_first is not None and row.on_second is not None
            one, other = (
                np.eye(3) if body is self.ground else rotation_matrix(q[7 * body.number + 3 : 7 * body.number + 7])
                for body in (joint.a, joint.b)
            )
            there = one.T @ (other @ np.array(row.on_second.values))
            angle = float(row.motion.at(t, q, q)[0])
            first, second = np.array(row.on_first.values).reshape(2, 3)
            if np.cos(angle) * (first @ there) + np.sin(angle) * (second @ there) < 0.0:
                raise ValueError(
                    f"{joint.name!r} starts {angle:.6g} rad from the position given, so far away that the bodies are "
                    "assembled half a turn from it: give poses nearer to the start of the motion"
                )

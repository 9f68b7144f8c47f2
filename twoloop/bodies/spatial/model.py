"""Build models in space: bodies, joints, drives."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.collection import Points, add, documented
from twoloop.bodies.functions import Function
from twoloop.bodies.loads import function_rows
from twoloop.bodies.parameter_layout import ALONG, ANGLE_DRIVE, PERPENDICULAR, POINT, TORSION_SPRING
from twoloop.bodies.parts import Body, Force, JointRow, ModelJoint, Numbers
from twoloop.bodies.rotation import euler_parameters, perpendiculars, rotation_matrix
from twoloop.bodies.spatial.couplings import SpatialCouplings, relative
from twoloop.bodies.tables import TENSOR
from twoloop.checks.arguments import Array, check_finite, check_positive, check_real, check_vector, shown


def across(a: Body, axis_a: Array, b: Body, axis_b: Array) -> JointRow:
    """Keep a direction of a perpendicular to a direction of b."""
    return JointRow(PERPENDICULAR, 1, a, b, Numbers(tuple(axis_a)), Numbers(tuple(axis_b)))


def parallel(a: Body, axis_a: Array, b: Body, axis_b: Array) -> tuple[JointRow, ...]:
    """Keep a direction of a parallel to a direction of b."""
    return tuple(across(a, normal, b, axis_b) for normal in perpendiculars(axis_a))


def on_line(a: Body, axis_a: Array, b: Body, on_a: Numbers, on_b: Numbers) -> tuple[JointRow, ...]:
    """Keep a point of b on a line of a."""
    return tuple(JointRow(ALONG, 1, a, b, on_a, on_b, Numbers(tuple(normal))) for normal in perpendiculars(axis_a))


SYMMETRIC = 1e-9  # relative tolerance of the symmetry of an inertia tensor


def _rotation(name: str, given: ArrayLike) -> Array:
    """Return a rotation matrix, orthonormal to rounding."""
    R = check_real(name, given)
    try:
        return rotation_matrix(euler_parameters(R))
    except ValueError:
        raise ValueError(
            f"{name} must be a rotation matrix (3, 3), orthonormal to 1e-9 and right-handed; given {shown(given)}"
        ) from None


def _moments(name: str, given: ArrayLike) -> Array:
    """Return J_xx, J_yy, J_zz, J_xy, J_xz, J_yz from three moments or a tensor."""
    J = check_real(name, given)
    if J.shape not in ((3,), (3, 3)) or not np.isfinite(J).all():
        raise ValueError(
            f"{name} must be three finite moments, shape (3,), or a tensor, shape (3, 3); given {shown(given)}"
        )
    J = np.diag(J) if J.ndim == 1 else J
    if np.abs(J - J.T).max() > SYMMETRIC * np.abs(J).max() or np.linalg.eigvalsh(J).min() <= 0.0:
        raise ValueError(
            f"{name} must be symmetric and positive definite, as a body that turns about an axis without a moment has "
            f"no inertia (give a thin rod a small one); given {shown(given)}"
        )
    J = 0.5 * (J + J.T)
    return np.array([J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2]])


PERPENDICULAR_TO = 1e-6  # largest cosine of the angle between the axes of a universal joint


@documented
class SpatialModel(SpatialCouplings):
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
    actuators : tuple of Force
        Motors and springs that were read from the actuators of a file.

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

    dimension = 3
    ignored: tuple[str, ...] = ()  # parts of a file without a counterpart
    actuators: tuple[Force, ...] = ()  # forces of the actuators of a file
    coordinate_names = ("x (m)", "y (m)", "z (m)", "e0 (-)", "e1 (-)", "e2 (-)", "e3 (-)")

    def __init__(self, gravity: ArrayLike = (0.0, 0.0, -9.81), *, name: str = "spatial model"):
        super().__init__(gravity, name)

    def body(
        self,
        name: str,
        *,
        mass: float,
        inertia: ArrayLike,
        position: ArrayLike,
        rotation: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        angular_velocity: ArrayLike | None = None,
    ) -> Body:
        """Add a body.

        Parameters
        ----------
        name : str
        mass : float
            kg.
        inertia : array_like (3,) or (3, 3)
            Principal moments or inertia tensor about the centre of mass in body axes, kg m^2.
        position : array_like (3,)
            Of the centre of mass, m.
        rotation : array_like (3, 3), optional
            Rotation matrix whose columns are the body axes in space. None: the identity.
        velocity : array_like (3,), optional
            Initial velocity of the centre of mass, m/s. None: determined by the other velocities.
        angular_velocity : array_like (3,), optional
            Initial angular velocity in space, rad/s, or None as for `velocity`.
        """
        name, place, weight, speed = self._new_body(name, mass, position, velocity)
        moments = _moments(f"inertia of {name!r}", inertia)
        R = _rotation(f"rotation of {name!r}", np.eye(3) if rotation is None else rotation)
        spin = None
        if angular_velocity is not None:
            spin = check_vector(f"angular_velocity of {name!r}", angular_velocity, 3)
        return add(self.bodies, Body(name, len(self.bodies), place, R, np.append(weight, moments), speed, spin))

    def rod(self, name: str, start: ArrayLike, end: ArrayLike, *, radius: float, mass: float, **motion: Any) -> Body:
        """Add a uniform cylinder between two points of space; the first axis of the body points from start to end.

        Parameters
        ----------
        start, end : array_like (3,)
            m.
        **motion
            `velocity` and `angular_velocity`, as for `body`.
        """
        first, last = check_vector(f"start of {name!r}", start, 3), check_vector(f"end of {name!r}", end, 3)
        length = float(np.linalg.norm(last - first))
        check_positive(f"mass of {name!r}", mass)
        check_positive(f"radius of {name!r}", radius)
        check_positive(f"the length of {name!r}, from start to end,", length)
        along, across = (last - first) / length, mass * (length**2 / 12.0 + radius**2 / 4.0)
        moments = (0.5 * mass * radius**2, across, across)
        R = np.column_stack([along, *perpendiculars(along)])
        return self.body(name, mass=mass, inertia=moments, position=0.5 * (first + last), rotation=R, **motion)

    def box(self, name: str, size: ArrayLike, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform box.

        Parameters
        ----------
        size : array_like (3,)
            Its edges along the axes of the body, m.
        """
        squares = check_vector(f"size of {name!r}", size, 3) ** 2
        check_positive(f"mass of {name!r}", mass)
        for edge in np.asarray(size, dtype=float):
            check_positive(f"each edge of {name!r}", float(edge))
        return self.body(name, mass=mass, inertia=mass * (squares.sum() - squares) / 12.0, position=position, **pose)

    def sphere(self, name: str, radius: float, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform ball."""
        check_positive(f"radius of {name!r}", radius)
        check_positive(f"mass of {name!r}", mass)
        return self.body(name, mass=mass, inertia=np.full(3, 0.4 * mass * radius**2), position=position, **pose)

    def spherical(self, a: Body | str, b: Body | str, *, at: Any, name: str | None = None) -> ModelJoint:
        """Add a spherical joint: both bodies share a point."""
        body_a, body_b, name, points = self._pair("spherical", a, b, name, at)
        rows = (JointRow(POINT, 3, body_a, body_b, *points),)
        return add(self.joints, ModelJoint(name, "spherical", body_a, body_b, rows, *points))

    def revolute(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a revolute joint: b rotates on a about an axis."""
        body_a, body_b, name, points = self._pair("revolute", a, b, name, at)
        axis_a, axis_b = self._directions(axis, body_a, body_b)
        rows = JointRow(POINT, 3, body_a, body_b, *points), *parallel(body_a, axis_a, body_b, axis_b)
        return add(self.joints, ModelJoint(name, "revolute", body_a, body_b, rows, *points, (axis_a, axis_b)))

    def universal(self, a: Body | str, b: Body | str, *, at: Any, axes: Any, name: str | None = None) -> ModelJoint:
        """Add a universal joint: one axis of the cross is fixed in a, the other, perpendicular to it, in b.

        Parameters
        ----------
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
        body_a, body_b, name, points = self._pair("universal", a, b, name, at)
        axis_a, axis_b = self._direction("axes[0]", axes[0], body_a), self._direction("axes[1]", axes[1], body_b)
        cosine = float((body_a.rotation @ axis_a) @ (body_b.rotation @ axis_b))
        if not any(hasattr(each, "body") for each in axes) and abs(cosine) > PERPENDICULAR_TO:
            raise ValueError(
                f"axes of {name!r} must be perpendicular; given {shown(axes)}, whose cosine is {cosine:.6g}"
            )
        rows = JointRow(POINT, 3, body_a, body_b, *points), across(body_a, axis_a, body_b, axis_b)
        return add(self.joints, ModelJoint(name, "universal", body_a, body_b, rows, *points, (axis_a, axis_b)))

    def cylindrical(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a cylindrical joint: b slides along an axis of a and rotates about it."""
        body_a, body_b, name, points = self._pair("cylindrical", a, b, name, at)
        axis_a, axis_b = self._directions(axis, body_a, body_b)
        rows = *on_line(body_a, axis_a, body_b, *points), *parallel(body_a, axis_a, body_b, axis_b)
        return add(self.joints, ModelJoint(name, "cylindrical", body_a, body_b, rows, *points, (axis_a, axis_b)))

    def screw(
        self, a: Body | str, b: Body | str, *, at: Any, axis: Any, pitch: float, name: str | None = None
    ) -> ModelJoint:
        """Add a screw: b slides along an axis of a in proportion to its rotation about it.

        Parameters
        ----------
        pitch : float
            Displacement of b along the axis per turn, m; negative for a left-handed thread.

        Examples
        --------
        >>> from twoloop.bodies import SpatialModel
        >>> model = SpatialModel(name="jack")
        >>> nut = model.body("nut", mass=2.0, inertia=(0.01, 0.01, 0.02), position=(0.0, 0.0, 0.0))
        >>> thread = model.screw("ground", nut, at=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), pitch=0.01, name="thread")
        >>> problem = model.problem(rates={thread: 2.0})  # rad/s
        >>> round(float(problem.joint_coordinate(thread, "displacement").rate(problem.q0, problem.v0)), 6)
        0.003183
        """
        body_a, body_b, name, points = self._pair("screw", a, b, name, at)
        axis_a, axis_b = self._directions(axis, body_a, body_b)
        if check_finite("pitch", pitch) == 0.0:
            raise ValueError("pitch must not be zero: b would not slide; use revolute(...) for that")
        rows = *on_line(body_a, axis_a, body_b, *points), *parallel(body_a, axis_a, body_b, axis_b)
        sleeve = ModelJoint(name, "screw", body_a, body_b, rows, *points, (axis_a, axis_b), float(pitch))
        slid = self.coordinate_of(sleeve, "displacement", lambda numbers: np.array(numbers.values))
        start = slid.position(self._start())
        thread = self._wound_row(sleeve, lambda q: slid.position(q) - start, float(pitch) / (2.0 * np.pi))
        rows += function_rows(f"screw {name!r}", [thread], (body_a, body_b), (body_a, body_b, *points))
        return add(self.joints, replace(sleeve, rows=rows))

    def point_on_line(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Keep a point of b on a line of a, like a pin in a straight slot.

        Parameters
        ----------
        axis : array_like (3,) or BodyDirection
            Direction of the line in a, of any length.

        Examples
        --------
        >>> from twoloop.bodies import SpatialModel
        >>> model = SpatialModel(name="bead on a wire")
        >>> bead = model.particle("bead", mass=0.1, position=(0.0, 0.0, 0.0))
        >>> wire = model.point_on_line("ground", bead, at=(0.0, 0.0, 0.0), axis=(1.0, 0.0, -1.0))
        >>> model.problem().freedom.degrees
        1
        """
        body_a, body_b, name, points = self._pair("point on line", a, b, name, at)
        rows = on_line(body_a, self._direction("axis", axis, body_a), body_b, *points)
        return add(self.joints, ModelJoint(name, "point on line", body_a, body_b, rows, *points))

    def prismatic(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a prismatic joint: b slides along an axis of a without rotating on it."""
        body_a, body_b, name, points = self._pair("prismatic", a, b, name, at)
        axis_a, axis_b = self._directions(axis, body_a, body_b)
        first_across, third = perpendiculars(axis_a)
        held = across(body_a, first_across, body_b, relative(body_a, axis_a, body_b, axis_b).T @ third)
        rows = *on_line(body_a, axis_a, body_b, *points), *parallel(body_a, axis_a, body_b, axis_b), held
        return add(self.joints, ModelJoint(name, "prismatic", body_a, body_b, rows, *points, (axis_a, axis_b)))

    def planar(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a planar joint: b slides in a plane of a and rotates about its normal.

        Parameters
        ----------
        at : array_like (3,) or (BodyPoint, BodyPoint)
            A point in the plane, m.
        axis : array_like (3,) or (BodyDirection, BodyDirection)
            Normal of the plane, of any length.
        """
        body_a, body_b, name, points = self._pair("planar", a, b, name, at)
        axis_a, axis_b = self._directions(axis, body_a, body_b)
        plane = JointRow(ALONG, 1, body_a, body_b, *points, Numbers(tuple(axis_a)))
        rows = plane, *parallel(body_a, axis_a, body_b, axis_b)
        return add(self.joints, ModelJoint(name, "planar", body_a, body_b, rows, *points, (axis_a, axis_b)))

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
        axes_of_a = b.rotation.T @ a.rotation
        pairs = ((0, 1), (0, 2), (1, 2))
        return JointRow(POINT, 3, a, b, *points), *(across(a, np.eye(3)[i], b, axes_of_a[:, j]) for i, j in pairs)

    def _turn_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        axis_a, axis_b = joint.axes
        first, second = perpendiculars(axis_a)
        zero = Numbers(tuple(relative(joint.a, axis_a, joint.b, axis_b).T @ first))
        return JointRow(ANGLE_DRIVE, 1, joint.a, joint.b, Numbers((*first, *second)), zero, None, motion)

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        axis, start = Numbers(tuple(joint.axes[0])), Numbers(tuple(self._zero(joint)))
        return Force(name, TORSION_SPRING, joint.a, joint.b, axis, start, numbers, joint=joint)

    def _check_moments(self, name: str, moments: Array) -> None:
        _moments(f"inertia of {name}", moments[TENSOR].reshape(3, 3))

    def _check_branches(self, t: float, q: Array) -> None:
        super()._check_branches(t, q)
        for joint in self.joints:
            row = joint.rows[0]
            if row.kind != ANGLE_DRIVE or row.motion is None:
                continue
            assert row.on_first is not None and row.on_second is not None
            rotation_a, rotation_b = (
                np.eye(3) if body is self.ground else rotation_matrix(q[7 * body.number + 3 : 7 * body.number + 7])
                for body in (joint.a, joint.b)
            )
            direction_b = rotation_a.T @ (rotation_b @ np.array(row.on_second.values))
            angle = float(row.motion.at(t, q, q)[0])
            first, second = np.array(row.on_first.values).reshape(2, 3)
            if np.cos(angle) * (first @ direction_b) + np.sin(angle) * (second @ direction_b) < 0.0:
                raise ValueError(
                    f"{joint.name!r} starts {angle:.6g} rad from the position given, so far away that the bodies are "
                    "assembled half a turn from it: give poses nearer to the start of the motion"
                )

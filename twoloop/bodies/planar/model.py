"""Build models in the plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.collection import Points, add, documented
from twoloop.bodies.coordinates import Displacement, PlanarAngle
from twoloop.bodies.frames import vector_of
from twoloop.bodies.functions import Function, RateFunction
from twoloop.bodies.loads import Row, listed
from twoloop.bodies.model_problem import Model
from twoloop.bodies.parameter_layout import ACROSS, ANGLE, POINT, RATE_FUNCTION, TORSION_SPRING
from twoloop.bodies.parts import Body, Force, JointRow, ModelJoint, Numbers
from twoloop.checks.arguments import Array, check_finite, check_positive, check_vector


@documented
class PlanarModel(Model):
    """A planar mechanism made of bodies, joints and forces.

    The coordinates are x, y of the centre of mass of each body and its angle, positive from x to y. Points and axes are
    given in space, in the position in which the bodies are given, or on a body by `body.point(...)` and
    `body.direction(...)`.

    Parameters
    ----------
    gravity : array_like (2,)
        m/s^2.
    name : str

    Attributes
    ----------
    ground : Body
    bodies, joints, forces : list
        The parts added so far.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid.

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> pin = model.revolute("ground", bob, at=(0.0, 0.0), name="pin")
    >>> problem = model.problem((0.0, 1.0))
    >>> problem.system.n_q, problem.system.n_c, problem.freedom.degrees
    (3, 2, 1)
    """

    dimension = 2
    coordinate_names = ("x (m)", "y (m)", "angle (rad)")

    def __init__(self, gravity: ArrayLike = (0.0, -9.81), *, name: str = "planar model"):
        super().__init__(gravity, name)

    def body(
        self,
        name: str,
        *,
        mass: float,
        inertia: float,
        position: ArrayLike,
        angle: float = 0.0,
        velocity: ArrayLike | None = None,
        angular_velocity: float | None = None,
    ) -> Body:
        """Add a body.

        Parameters
        ----------
        name : str
        mass, inertia : float
            Mass, kg, and moment of inertia about the centre of mass, kg m^2.
        position : array_like (2,)
            Of the centre of mass, m.
        angle : float
            rad.
        velocity : array_like (2,), optional
            Initial velocity of the centre of mass, m/s. None: determined by the other velocities.
        angular_velocity : float, optional
            Initial angular velocity, rad/s, or None as for `velocity`.
        """
        name, place, weight, speed = self._new_body(name, mass, position, velocity)
        check_positive(f"inertia of {name!r}", inertia)
        rate = None if angular_velocity is None else check_finite(f"angular_velocity of {name!r}", angular_velocity)
        spin = None if rate is None else np.array([rate])
        pose = place, check_finite(f"angle of {name!r}", angle)
        return add(self.bodies, Body(name, len(self.bodies), *pose, np.array([weight, inertia]), speed, spin))

    def rod(self, name: str, start: ArrayLike, end: ArrayLike, *, mass: float, **motion: Any) -> Body:
        """Add a uniform thin rod between two points of space; its angle is that of the line from `start` to `end`.

        Parameters
        ----------
        start, end : array_like (2,)
            m.
        **motion
            `velocity` and `angular_velocity`, as for `body`.
        """
        first, last = check_vector(f"start of {name!r}", start, 2), check_vector(f"end of {name!r}", end, 2)
        length = float(np.hypot(*(last - first)))
        check_positive(f"mass of {name!r}", mass)
        check_positive(f"the length of {name!r}, from start to end,", length)
        position, angle = 0.5 * (first + last), float(np.arctan2(*(last - first)[::-1]))
        return self.body(name, mass=mass, inertia=mass * length**2 / 12.0, position=position, angle=angle, **motion)

    def box(self, name: str, size: ArrayLike, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform rectangle.

        Parameters
        ----------
        size : array_like (2,)
            Its edges along the axes of the body, m.
        """
        edges = check_vector(f"size of {name!r}", size, 2)
        check_positive(f"mass of {name!r}", mass)
        for edge in edges:
            check_positive(f"each edge of {name!r}", float(edge))
        return self.body(name, mass=mass, inertia=mass * float(edges @ edges) / 12.0, position=position, **pose)

    def disc(self, name: str, radius: float, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform disc."""
        check_positive(f"radius of {name!r}", radius)
        check_positive(f"mass of {name!r}", mass)
        return self.body(name, mass=mass, inertia=0.5 * mass * radius**2, position=position, **pose)

    def revolute(self, a: Body | str, b: Body | str, *, at: Any, name: str | None = None) -> ModelJoint:
        """Add a revolute joint: b rotates on a about a pin."""
        body_a, body_b, name, points = self._pair("revolute", a, b, name, at)
        return add(self.joints, ModelJoint(name, "revolute", body_a, body_b, (_pin(body_a, body_b, *points),), *points))

    def prismatic(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a prismatic joint: b slides along an axis of a without rotating on it.

        Parameters
        ----------
        axis : array_like (2,) or BodyDirection
            Direction, of any length; a pair of directions of a and b prescribes the rotation of b relative to a.
        """
        body_a, body_b, name, points = self._pair("prismatic", a, b, name, at)
        axis_a, axis_b = self._directions(axis, body_a, body_b)
        angle = float(np.arctan2(axis_a[1], axis_a[0]))
        pair = isinstance(axis, (tuple, list)) and not isinstance(axis[0], (int, float, np.number))
        offset = angle - float(np.arctan2(axis_b[1], axis_b[0])) if pair else body_b.rotation - body_a.rotation
        along = Numbers((angle,), (f"angle of {name} on {body_a.name} (rad)",))
        rows = (
            JointRow(ACROSS, 1, body_a, body_b, *points, along),
            JointRow(ANGLE, 1, body_a, body_b, more=_turn(name, body_a, body_b, offset)),
        )
        return add(self.joints, ModelJoint(name, "prismatic", body_a, body_b, rows, *points))

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
        body_a, body_b, name, named = self._pair("rolling", a, wheel, name, None)
        points = Numbers(named[0].values), Numbers(named[1].values)
        if body_b is self.ground:
            raise ValueError("wheel must be a body that moves; given the ground")
        check_positive("radius", radius)
        direction = self._direction("axis", axis, body_a)
        head = name, "displacement", body_a.number, body_b.number
        x, y = direction.tolist()
        across, along = (Displacement(*head, axis, points[0].values, (0.0, 0.0)) for axis in ((-y, x), (x, y)))
        turned = PlanarAngle(name, "angle", *head[2:], float(body_b.rotation - body_a.rotation))
        rows = [across.position, lambda q: along.position(q) + radius * turned.position(q)]
        joint = ModelJoint(name, "rolling", body_a, body_b, (), *points)
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
            (rx, ry), (nx, ny) = vector_of(q, on.number, place), vector_of(q, on.number, np.array([-y, x]))
            u, w, spin = (v[j] for j in on.coordinates)
            return nx * (u - spin * ry) + ny * (w + spin * rx)

        columns = on.coordinates
        places = listed(columns)
        points = Numbers(tuple(on.in_space(place))), Numbers(tuple(place))
        function = RateFunction(f"skate {name!r}", across, columns)
        row = JointRow(RATE_FUNCTION, 1, self.ground, on, *points, places, function)
        return add(self.joints, ModelJoint(name, "skate", self.ground, on, (row,), *points))

    def _gear_row(self, one: ModelJoint, other: ModelJoint, ratio: float) -> Row:
        angles = self.joint_coordinate(other), self.joint_coordinate(one)
        return lambda q: angles[0].position(q) - ratio * angles[1].position(q)

    def _wound_row(self, pinion: ModelJoint, moved: Row, radius: float) -> Row:
        angle = self.joint_coordinate(pinion)
        return lambda q: moved(q) - radius * angle.position(q)

    def _weld(self, name: str, a: Body, b: Body, points: Points) -> tuple[JointRow, ...]:
        return _pin(a, b, *points), JointRow(ANGLE, 1, a, b, more=_turn(name, a, b, b.rotation - a.rotation))

    def _turn_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        zero = Numbers((joint.b.rotation - joint.a.rotation,))
        return JointRow(ANGLE, 1, joint.a, joint.b, more=zero, motion=motion)

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        *law, angle = numbers.values
        total = angle + joint.b.rotation - joint.a.rotation
        zero = "without torque" if law else "at the zero"
        names = (*numbers.names[:-1], f"angle of {joint.b.name} against {joint.a.name} {zero} of {name} (rad)")
        values = Numbers((*law, total), names)
        return Force(name, TORSION_SPRING, joint.a, joint.b, None, None, values, joint=joint)

    def _check_moments(self, name: str, moments: Array) -> None:
        check_positive(f"moment of inertia of {name}", float(moments[0]))


def _pin(a: Body, b: Body, on_a: Numbers, on_b: Numbers) -> JointRow:
    return JointRow(POINT, 2, a, b, on_a, on_b)


def _turn(name: str, a: Body, b: Body, angle: float) -> Numbers:
    return Numbers((angle,), (f"angle of {b.name} against {a.name} in {name} (rad)",))

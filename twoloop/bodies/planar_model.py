"""Models in the plane."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.collection import Points
from twoloop.bodies.documented import documented
from twoloop.bodies.functions import Function
from twoloop.bodies.parameter_layout import ACROSS, ALONG, ANGLE, DISTANCE, PIN, SLIDE, TORQUE, TORSION
from twoloop.bodies.parts import Body, Force, JointRow, ModelJoint, Numbers
from twoloop.bodies.planar_couplings import Couplings
from twoloop.checks.arguments import Array, check_finite, check_positive, check_vector


@documented
class PlanarModel(Couplings):
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
    distance_kind = DISTANCE
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
        turned = check_finite(f"angle of {name!r}", angle)
        spin = None if rate is None else np.array([rate])
        return self._add_body(Body(name, len(self.bodies), place, turned, np.array([weight, inertia]), speed, spin))

    def rod(self, name: str, start: ArrayLike, end: ArrayLike, *, mass: float, **motion: Any) -> Body:
        """Add a uniform thin rod between two points of space; its angle is that of the line from `start` to `end`.

        Parameters
        ----------
        name : str
        start, end : array_like (2,)
            m.
        mass : float
            kg.
        **motion
            `velocity` and `angular_velocity`, as for `body`.
        """
        one, other = check_vector(f"start of {name!r}", start, 2), check_vector(f"end of {name!r}", end, 2)
        length = float(np.hypot(*(other - one)))
        check_positive(f"mass of {name!r}", mass)
        check_positive(f"the length of {name!r}, from start to end,", length)
        position, angle = 0.5 * (one + other), float(np.arctan2(*(other - one)[::-1]))
        return self.body(name, mass=mass, inertia=mass * length**2 / 12.0, position=position, angle=angle, **motion)

    def box(self, name: str, size: ArrayLike, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform rectangle.

        Parameters
        ----------
        name : str
        size : array_like (2,)
            Its edges along the axes of the body, m.
        mass : float
            kg.
        position : array_like (2,)
            Of the centre, m.
        **pose
            `angle`, `velocity` and `angular_velocity`, as for `body`.
        """
        edges = check_vector(f"size of {name!r}", size, 2)
        check_positive(f"mass of {name!r}", mass)
        for edge in edges:
            check_positive(f"each edge of {name!r}", float(edge))
        return self.body(name, mass=mass, inertia=mass * float(edges @ edges) / 12.0, position=position, **pose)

    def disc(self, name: str, radius: float, *, mass: float, position: ArrayLike, **pose: Any) -> Body:
        """Add a uniform disc.

        Parameters
        ----------
        name : str
        radius : float
            m.
        mass : float
            kg.
        position : array_like (2,)
            Of the centre, m.
        **pose
            `angle`, `velocity` and `angular_velocity`, as for `body`.
        """
        check_positive(f"radius of {name!r}", radius)
        check_positive(f"mass of {name!r}", mass)
        return self.body(name, mass=mass, inertia=0.5 * mass * radius**2, position=position, **pose)

    def revolute(self, a: Body | str, b: Body | str, *, at: Any, name: str | None = None) -> ModelJoint:
        """Add a revolute joint: b rotates on a about a pin.

        Parameters
        ----------
        a, b : Body or str
            The bodies, or their names.
        at : array_like (2,) or (BodyPoint, BodyPoint)
            The pin, in space in the position given, m; or a point of a and a point of b, which the joint brings
            together.
        """
        first, second, name, points = self._pair("revolute", a, b, name, at)
        return self._add_joint(ModelJoint(name, "revolute", first, second, (_pin(first, second, *points),), *points))

    def prismatic(self, a: Body | str, b: Body | str, *, at: Any, axis: Any, name: str | None = None) -> ModelJoint:
        """Add a prismatic joint: b slides along an axis of a without rotating on it.

        Parameters
        ----------
        a, b : Body or str
        at : array_like (2,) or (BodyPoint, BodyPoint)
            A point on the axis, m.
        axis : array_like (2,) or BodyDirection
            Direction, of any length; a pair of directions of a and b prescribes the rotation of b relative to a.
        """
        first, second, name, points = self._pair("prismatic", a, b, name, at)
        one, other = self._directions(axis, first, second)
        turned = float(np.arctan2(one[1], one[0]))
        pair = isinstance(axis, (tuple, list)) and not isinstance(axis[0], (int, float, np.number))
        offset = turned - float(np.arctan2(other[1], other[0])) if pair else second.rotation - first.rotation
        along = Numbers((turned,), (f"angle of {name} on {first.name} (rad)",))
        rows = (
            JointRow(ACROSS, 1, first, second, *points, along),
            JointRow(ANGLE, 1, first, second, more=_turn(name, first, second, offset)),
        )
        return self._add_joint(ModelJoint(name, "prismatic", first, second, rows, *points))

    def _weld(self, name: str, a: Body, b: Body, points: Points) -> tuple[JointRow, ...]:
        return _pin(a, b, *points), JointRow(ANGLE, 1, a, b, more=_turn(name, a, b, b.rotation - a.rotation))

    def _no_rotation(self) -> float:
        return 0.0

    def _axis(self, joint: ModelJoint) -> Array:
        assert joint.rows[0].more is not None
        self.taken.append(joint.rows[0].more)
        (angle,) = joint.rows[0].more.values
        return np.array([np.cos(angle), np.sin(angle)])

    def _drive_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        if joint.kind == "revolute":
            zero = Numbers((joint.b.rotation - joint.a.rotation,))
            return JointRow(ANGLE, 1, joint.a, joint.b, more=zero, motion=motion)
        across = joint.rows[0]
        return JointRow(ALONG, 1, joint.a, joint.b, across.on_first, across.on_second, across.more, motion)

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        *law, angle = numbers.values
        total = angle + joint.b.rotation - joint.a.rotation
        zero = "without torque" if law else "at the zero"
        names = (*numbers.names[:-1], f"angle of {joint.b.name} against {joint.a.name} {zero} of {name} (rad)")
        values = Numbers((*law, total), names)
        return Force(name, TORSION, joint.a, joint.b, None, None, values, joint=joint)

    def _motor(self, name: str, joint: ModelJoint, unit: str, f: Any) -> Force:
        function, more = self._function(name, f, 1, unit)
        if joint.kind == "revolute":
            return Force(name, TORQUE, joint.a, joint.b, None, None, more, function, joint=joint)
        return Force(name, SLIDE, joint.a, joint.b, joint.rows[0].more, joint.point_b, more, function, joint=joint)

    def _along(self, name: str, kind: int, joint: ModelJoint, numbers: Numbers | None) -> Force:
        axis = joint.rows[0].more  # None for a revolute joint
        return Force(name, kind, joint.a, joint.b, axis, joint.point_b, numbers, point_on_first=joint.point_a)

    def _check_moments(self, name: str, moments: Array) -> None:
        check_positive(f"moment of inertia of {name}", float(moments[0]))

    def _start(self) -> Array:
        return np.concatenate([np.append(body.position, body.rotation) for body in self.bodies])


def _pin(a: Body, b: Body, on_a: Numbers, on_b: Numbers) -> JointRow:
    return JointRow(PIN, 2, a, b, on_a, on_b)


def _turn(name: str, a: Body, b: Body, angle: float) -> Numbers:
    return Numbers((angle,), (f"angle of {b.name} against {a.name} in {name} (rad)",))

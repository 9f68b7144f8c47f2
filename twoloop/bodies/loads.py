"""Add forces, prescribed motions, stops, gears and racks to a model."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from twoloop.bodies.collection import add, documented
from twoloop.bodies.coordinates import Coordinates, JointCoordinate
from twoloop.bodies.frames import point_of, vector_of
from twoloop.bodies.functions import Function, RowFunction, SpringFunction, motion_function, spring_function
from twoloop.bodies.parameter_layout import (
    ALONG,
    AXIAL_FORCE,
    AXIAL_FRICTION,
    AXIAL_SPRING,
    AXIAL_TORQUE,
    FORCE,
    HINGE_FRICTION,
    HINGE_ROTOR,
    ROW_FUNCTION,
    SLIDE_ROTOR,
    SPRING,
    TORQUE,
    ZERO_LENGTH_SPRING,
)
from twoloop.bodies.parts import Body, DryFriction, Force, JointRow, ModelJoint, Numbers
from twoloop.checks.arguments import Array, check_finite, check_not_negative, check_positive, shown
from twoloop.problem.description import Stop

Row = Callable[[Any], Any]  # of the coordinates; zero where the constraint holds


def _spring_function(name: str, f: Any, stiffness: Any, more: Any) -> SpringFunction | None:
    """Return the force or torque of a spring as a function, or None if the spring has a stiffness."""
    if (f is None) == (stiffness is None) or (f is not None and more):
        raise TypeError(
            f"give either stiffness, with damping and what is unstressed, or a function in the place of all of them: "
            f"given {name} = {shown(f)}, stiffness={shown(stiffness)}"
        )
    return None if f is None else spring_function(name, f)


def _spring_numbers(name: str, given: dict[str, tuple[Any, str]]) -> Numbers:
    """Return stiffness, damping and unstressed length or angle of a spring in a joint, with their units."""
    checks = check_not_negative, check_not_negative, check_finite
    values = tuple(check(what, value) for check, (what, (value, _)) in zip(checks, given.items(), strict=True))
    return Numbers(values, tuple(f"{what} of {name} ({unit})" for what, (_, unit) in given.items()))


def _plane_gap(body: Body, place: Array, plane: Body, foot: Array, normal: Array, t: Any, q: Any) -> Any:
    """Return the distance of a point of one body from a plane of another, or its displacement along it, m."""
    ends = zip(point_of(q, body.number, place), point_of(q, plane.number, foot), strict=True)
    return sum(n * (x - y) for n, (x, y) in zip(vector_of(q, plane.number, normal), ends, strict=True))


@dataclass(frozen=True, eq=False)
class CoordinateGap:
    """Measure the angle or displacement between a joint and its limit, rad or m."""

    coordinate: JointCoordinate
    limit: float
    sign: float

    def __call__(self, t: Any, q: Any) -> Any:
        """Return what remains, for numbers or symbols."""
        return self.sign * (self.coordinate.position(q) - self.limit)


@documented
class Loads(Coordinates):
    """Adds springs, forces, motors, drives, stops, gears and racks to a model.

    Constants of gears and racks are not parameters of the model.
    """

    def _turn_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        """Return the row by which the angle of a hinge is a motion."""
        raise NotImplementedError

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        raise NotImplementedError

    def _drive_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        """Return the row by which the angle of a hinge or the displacement of a slide is a motion."""
        if joint.kind == "revolute":
            return self._turn_row(joint, motion)
        return JointRow(ALONG, 1, joint.a, joint.b, joint.point_a, joint.point_b, self._axis(joint), motion)

    def _motor(self, name: str, joint: ModelJoint, unit: str, f: Any) -> Force:
        """Return a torque about the axis of a revolute joint, or a force along that of a prismatic joint."""
        function, more = self._function(name, f, 1, unit)
        turning = TORQUE if self.dimension == 2 else AXIAL_TORQUE
        kind, point_b = (turning, None) if joint.kind == "revolute" else (AXIAL_FORCE, joint.point_b)
        return Force(name, kind, joint.a, joint.b, self._axis(joint), point_b, more, function, joint=joint)

    def _along(self, name: str, kind: int, joint: ModelJoint, numbers: Numbers | None) -> Force:
        """Return a force along the axis of a prismatic joint; for friction also the torque of a revolute joint."""
        ends = joint.a, joint.b, self._axis(joint), joint.point_b
        return Force(name, kind, *ends, numbers, point_on_first=joint.point_a, joint=joint)

    def spring(
        self,
        a: Body | str,
        at_a: Any,
        b: Body | str,
        at_b: Any,
        *,
        stiffness: float | None = None,
        damping: float = 0.0,
        length: float | None = None,
        force: Any = None,
        name: str | None = None,
    ) -> Force:
        """Add a spring and damper between a point of one body and a point of another.

        Parameters
        ----------
        a, b : Body or str
            The bodies, or their names.
        at_a, at_b : array_like (2 or 3,) or BodyPoint
            The points, in space in the position given, m; or `body.point(...)`.
        stiffness, damping : float
            N/m and N s/m.
        length : float, optional
            Unstressed length, m. None: the distance of the points in the position given.
        force : callable, optional
            In the place of stiffness, damping and length: force(length, rate), N, positive where it pulls the points
            together. A linear spring has stiffness * (length - unstressed length) + damping * rate.
        """
        body_a, body_b, name, points, distance = self._apart("spring", a, at_a, b, at_b, name)
        function = _spring_function(f"force of {name!r}", force, stiffness, damping or length is not None)
        if function is not None:
            return add(self.forces, Force(name, SPRING, body_a, body_b, *points, None, function))
        stiffness, damping = check_not_negative("stiffness", stiffness), check_not_negative("damping", damping)
        length = distance if length is None else check_not_negative("length", length)
        if length == 0.0:
            if damping:
                raise ValueError(
                    f"the spring {name!r} without a length has no direction where its points meet, so that it takes no "
                    "damping; give it a length, or take a force of t, q, v for the damper"
                )
            more, kind = Numbers((stiffness,), (f"stiffness of {name} (N/m)",)), ZERO_LENGTH_SPRING
        else:
            names = f"stiffness of {name} (N/m)", f"damping of {name} (N s/m)", f"length of {name} (m)"
            more, kind = Numbers((stiffness, damping, length), names), SPRING
        return add(self.forces, Force(name, kind, body_a, body_b, *points, more))

    def torsion_spring(
        self,
        joint: ModelJoint | str,
        *,
        stiffness: float | None = None,
        damping: float = 0.0,
        angle: float = 0.0,
        torque: Any = None,
        name: str | None = None,
    ) -> Force:
        """Add a torsional spring and damper in a revolute joint.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute, cylindrical or screw joint, or its name.
        stiffness, damping : float
            N m/rad and N m s/rad.
        angle : float
            Rotation of b relative to a, from the position given, at which the spring has no torque, rad. In space the
            torque is defined up to 0.95 of a turn to either side of that position.
        torque : callable, optional
            In the place of stiffness, damping and angle: torque(angle, rate), N m, which acts on a, and against the
            angle on b. A linear spring has stiffness * angle + damping * rate.
        """
        hinge = self._as_single(joint, "angle", "torsion_spring")
        name = self._new_name(f"torsion spring of {hinge.name}", name)
        function_of_length = _spring_function(f"torque of {name!r}", torque, stiffness, damping or angle)
        if function_of_length is not None:
            zero = Numbers((0.0,), (f"angle of {name} (rad)",))
            return add(self.forces, replace(self._torsion(name, hinge, zero), function=function_of_length))
        numbers = {"stiffness": (stiffness, "N m/rad"), "damping": (damping, "N m s/rad"), "angle": (angle, "rad")}
        return add(self.forces, self._torsion(name, hinge, _spring_numbers(name, numbers)))

    def axial_spring(
        self,
        joint: ModelJoint | str,
        *,
        stiffness: float | None = None,
        damping: float = 0.0,
        length: float = 0.0,
        force: Any = None,
        name: str | None = None,
    ) -> Force:
        """Add a spring and damper along a prismatic joint.

        Parameters
        ----------
        joint : ModelJoint or str
            A prismatic, cylindrical or screw joint, or its name.
        stiffness, damping : float
            N/m and N s/m.
        length : float
            Displacement of b along the axis of a, from the point on a, at which the spring has no force, m.
        force : callable, optional
            In the place of stiffness, damping and length: force(displacement, rate), N, which acts on a, and against
            the displacement on b. A linear spring has stiffness * displacement + damping * rate.
        """
        slide = self._as_single(joint, "displacement", "axial_spring")
        name = self._new_name(f"spring of {slide.name}", name)
        function_of_length = _spring_function(f"force of {name!r}", force, stiffness, damping or length)
        if function_of_length is not None:
            return add(self.forces, replace(self._along(name, AXIAL_SPRING, slide, None), function=function_of_length))
        numbers = {"stiffness": (stiffness, "N/m"), "damping": (damping, "N s/m"), "length": (length, "m")}
        return add(self.forces, self._along(name, AXIAL_SPRING, slide, _spring_numbers(name, numbers)))

    def friction(
        self,
        joint: ModelJoint | str,
        f: float = 0.0,
        *,
        speed: float,
        coefficient: float | None = None,
        radius: float | None = None,
        name: str | None = None,
    ) -> Force:
        """Add friction in a revolute or prismatic joint with a smooth law: -(f + coefficient load) tanh(rate / speed).

        Unlike dry friction, this law has no jump at reversal and no sticking: a joint slips under any small force. A
        small `speed` makes the equations stiff. With a coefficient, the friction also grows with the load of the joint:
        its force across the axis, times the radius for a hinge; torques and thrust carried by the joint do not count.
        The joint forces are then computed at every evaluation, in Python, and the friction is NaN where the
        coefficient is so large that the joint may jam.

        Parameters
        ----------
        joint : ModelJoint or str
        f : float
            Load-independent torque or force at high speed, N m or N.
        speed : float
            Rate at which three quarters of the limit are reached, rad/s or m/s.
        coefficient : float, optional
            Friction per load. None: the friction does not depend on the load.
        radius : float, optional
            Radius of the pin of a revolute joint with a coefficient, m.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid; raised by `problem()` if a load is not determined.
        """
        rubbed = self._joint(joint, ("revolute", "prismatic"), "friction")
        name = self._new_name(f"friction of {rubbed.name}", name)
        check_positive("speed", speed)
        turns = rubbed.kind == "revolute"
        if (radius is not None) != (turns and coefficient is not None):
            raise ValueError(
                "radius is that of the pin of a revolute joint whose friction has a coefficient; given "
                f"radius={radius!r}, coefficient={coefficient!r} for {rubbed.name!r}, which is {rubbed.kind}"
            )
        units = ("N m", "rad/s") if turns else ("N", "m/s")
        names = [f"value of {name} ({units[0]})", f"speed of {name} ({units[1]})"]
        values = [check_not_negative("f", f), float(speed)]
        if coefficient is not None:
            names += [f"coefficient of {name} (-)"]
            values += [check_not_negative("coefficient", coefficient)]
        if radius is not None:
            check_positive("radius", radius)
            names, values = [*names, f"radius of {name} (m)"], [*values, float(radius)]
        numbers = Numbers(tuple(values), tuple(names))
        return add(self.forces, self._along(name, HINGE_FRICTION if turns else AXIAL_FRICTION, rubbed, numbers))

    def dry_friction(
        self, joint: ModelJoint | str, f: float, *, static: float | None = None, name: str | None = None
    ) -> DryFriction:
        """Add Coulomb friction in a revolute or prismatic joint, which may stick; for `solve_with_friction`.

        The friction does not depend on the load of the joint. `solve_dae` ignores it.

        Parameters
        ----------
        joint : ModelJoint or str
        f : float
            Kinetic friction torque or force, N m or N.
        static : float, optional
            Largest static friction, at least `f`. None: equal to `f`.
        """
        rubbed = self._joint(joint, ("revolute", "prismatic"), "dry_friction")
        name = self._new_name(f"dry friction of {rubbed.name}", name)
        kinetic = check_not_negative("f", f)
        most = kinetic if static is None else check_not_negative("static", static)
        if most < kinetic:
            raise ValueError(f"static must be at least f = {kinetic:g}; given {static!r}")
        force = replace(self._motor(name, rubbed, "", 0.0), more=Numbers((0.0,)), joint=None)
        self.dry.append(DryFriction(name, rubbed, kinetic, most, add(self.forces, force)))
        return self.dry[-1]

    def force(self, body: Body | str, at: Any, f: Any, *, name: str | None = None) -> Force:
        """Add a force on a body, with components along the axes of space, at a point fixed to the body.

        Parameters
        ----------
        body : Body or str
        at : array_like (2 or 3,) or BodyPoint
            The point, in space in the position given, m; or `body.point(...)`.
        f : array_like (2 or 3,) or callable
            N: a constant force, or f(t) or f(t, q, v) that returns one. The coordinates of a body in `q` and `v` are
            `body.coordinates`.
        """
        on = self._moving_body("body", body)
        name = self._new_name(f"force on {on.name}", name)
        point = self._numbers(name, on, self._point("at", at, on))
        function, more = self._function(name, f, self.dimension, "N")
        return add(self.forces, Force(name, FORCE, self.ground, on, None, point, more, function))

    def torque(self, body: Body | str, f: Any, *, name: str | None = None) -> Force:
        """Add a torque on a body: in the plane a number, positive from x to y; in space (3,) along the axes of space.

        Parameters
        ----------
        body : Body or str
        f : float, array_like (3,) or callable
            N m: a constant torque, or f(t) or f(t, q, v) that returns one.
        """
        on = self._moving_body("body", body)
        if on.is_particle:
            raise ValueError(f"a torque on {on.name!r} has no effect, as a particle does not turn; make it a body(...)")
        name = self._new_name(f"torque on {on.name}", name)
        function, more = self._function(name, f, 1 if self.dimension == 2 else 3, "N m")
        return add(self.forces, Force(name, TORQUE, self.ground, on, None, None, more, function))

    def motor(
        self, joint: ModelJoint | str, f: Any, *, coordinate: str | None = None, name: str | None = None
    ) -> Force:
        """Add a torque about the axis of a joint, or a force along it, on b, with its reaction on a.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute, prismatic, cylindrical or screw joint, or its name.
        f : float or callable
            N m or N: a number, or f(t) or f(t, q, v) that returns one.
        coordinate : str, optional
            "angle" or "displacement" of a cylindrical or screw joint. None: the only one, or the angle of a screw.
        """
        moved = self._as_single(joint, coordinate, "motor")
        name = self._new_name(f"motor of {moved.name}", name)
        return add(self.forces, self._motor(name, moved, "N m" if moved.kind == "revolute" else "N", f))

    def rotor(self, joint: ModelJoint | str, inertia: float, *, name: str | None = None) -> Force:
        """Add the inertia of a motor's rotor to a revolute joint, or in space to a prismatic joint.

        The kinetic energy grows by inertia / 2 times the square of the rate of the joint. This is the armature of
        MuJoCo.

        Parameters
        ----------
        joint : ModelJoint or str
        inertia : float
            kg m^2, or kg for a prismatic joint: the moment of inertia of the rotor times the square of the gear ratio.
        """
        kinds = ("revolute",) if self.dimension == 2 else ("revolute", "prismatic")
        moved = self._joint(joint, kinds, "rotor")
        name = self._new_name(f"rotor of {moved.name}", name)
        turns = moved.kind == "revolute"
        unit = "kg m^2" if turns else "kg"
        numbers = Numbers((check_not_negative("inertia", inertia),), (f"inertia of {name} ({unit})",))
        ends = self._motor(name, moved, "", 0.0)
        return add(self.forces, replace(ends, kind=HINGE_ROTOR if turns else SLIDE_ROTOR, more=numbers))

    def drive(
        self,
        joint: ModelJoint | str,
        motion: Any,
        *,
        rate: Any = None,
        acceleration: Any = None,
        coordinate: str | None = None,
        name: str | None = None,
    ) -> ModelJoint:
        """Prescribe the motion of a joint: the angle or displacement of b on a from the position given.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute, prismatic, cylindrical or screw joint, or its name.
        motion : callable
            motion(t), rad or m. The bodies are assembled at its initial value.
        rate, acceleration : callable, optional
            First and second derivative as functions of t. None: they are derived exactly from the motion, which must
            then consist of numpy functions without branches.
        coordinate : str, optional
            "angle" or "displacement" of a cylindrical or screw joint. None: the only one, or the angle of a screw.
        name : str, optional

        Returns
        -------
        ModelJoint
            Its reaction is the torque or force of the drive.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid, or the derivatives are neither given nor can be derived.
        """
        moved = self._as_single(joint, coordinate, "drive")
        name = self._new_name(f"drive of {moved.name}", name)
        row = self._drive_row(moved, motion_function(f"motion of {name!r}", motion, rate, acceleration))
        return add(self.joints, ModelJoint(name, "drive", moved.a, moved.b, (row,), moved.point_a, moved.point_b))

    def drive_point(
        self,
        body: Body | str,
        at: Any,
        *,
        axis: Any,
        motion: Any,
        rate: Any = None,
        acceleration: Any = None,
        name: str | None = None,
    ) -> ModelJoint:
        """Prescribe the motion of a point of a body along an axis of space, from the position given.

        Parameters
        ----------
        body : Body or str
        at : array_like (2,) or (3,)
            The point, in space in the position given, m.
        motion : callable
            motion(t), m; for `rate` and `acceleration` see `drive`.

        Examples
        --------
        >>> import numpy as np
        >>> from twoloop.bodies import PlanarModel
        >>> model = PlanarModel(name="arm")
        >>> arm = model.rod("arm", (0.0, 0.0), (1.0, 0.0), mass=1.0)
        >>> pin = model.revolute("ground", arm, at=(0.0, 0.0))
        >>> lift = model.drive_point(arm, (1.0, 0.0), axis=(0.0, 1.0), motion=lambda t: 0.1 * np.sin(t))
        >>> model.problem().freedom.degrees
        0
        """
        on = self._moving_body("body", body)
        name = self._new_name(f"drive of {on.name}", name)
        model: Any = copy.copy(self)
        model.joints, model.taken = [], []
        slide = model.prismatic(self.ground, on, at=at, axis=axis, name=name)
        row = self._drive_row(slide, motion_function(f"motion of {name!r}", motion, rate, acceleration))
        return add(self.joints, ModelJoint(name, "drive", self.ground, on, (row,), slide.point_a, slide.point_b))

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
        body_a, body_b = self._body("body", body), self._body("other", other)
        self._different("stop", body_a, body_b)
        name = self._new_name("stop", name, body_a, body_b)
        point, foot = self._point("at", at, body_a), self._point("foot", foot, body_b)
        places, across = (body_a, point, body_b, foot), self._direction("normal", normal, body_b)
        if check_not_negative("friction", friction) and self.dimension == 3:
            raise ValueError(f"friction of {name!r} must be zero, as stops rub in the plane only; given {friction!r}")
        slide = partial(_plane_gap, *places, across[::-1] * (1.0, -1.0)) if friction else None  # along the plane
        return add(self.stops, Stop(partial(_plane_gap, *places, across), restitution, name, friction, slide))

    def limit(
        self,
        joint: ModelJoint | str,
        *,
        lower: float | None = None,
        upper: float | None = None,
        restitution: float = 0.0,
        coordinate: str | None = None,
        name: str | None = None,
    ) -> tuple[Stop, ...]:
        """Add limits to a joint, between which its angle or displacement stays.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute, prismatic, cylindrical or screw joint, or its name. In space, an angle is limited to 0.95 of a
            turn to either side of the position given; a run that goes farther raises an error.
        lower, upper : float, optional
            Bounds of the displacement of b on a from the position given, rad or m. None: unbounded.
        restitution : float
            Coefficient of restitution, from 0 to 1.
        coordinate : str, optional
            "angle" or "displacement" of a cylindrical or screw joint. None: the only one, or the angle of a screw.
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
        limited, which = self._which(joint, coordinate, "limit")
        bounds = {"lower": (lower, 1.0), "upper": (upper, -1.0)}
        if lower is None and upper is None:
            raise ValueError(f"limit of {limited.name!r} needs lower, upper, or both")
        if lower is not None and upper is not None and not lower < upper:
            raise ValueError(f"lower of the limit of {limited.name!r} must be below upper; given {lower!r}, {upper!r}")
        stops = []
        for bound, (value, sign) in bounds.items():
            if value is not None:
                new = self._new_name(f"{bound} limit of {limited.name if name is None else name}", None)
                gap = self._gap(limited, which, check_finite(bound, value), sign)
                stops.append(add(self.stops, Stop(gap, restitution, new)))
                self.limits.append(((limited.name, which), sign, stops[-1]))
        return tuple(stops)

    def _gap(self, joint: ModelJoint, which: str, limit: float, sign: float) -> CoordinateGap:
        coordinate = self.joint_coordinate(joint, which)
        if joint.kind == "prismatic":
            self._keep_axis(joint)
            limit += float(coordinate.position(self._start()))
        return CoordinateGap(coordinate, limit, sign)

    def _keep_axis(self, joint: ModelJoint) -> None:
        """Record that the axis of a slide cannot change, where it is a parameter of the model."""
        axis = self._axis(joint)
        if axis is not None and axis.names:
            self.taken.append(axis)

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
        joint_1, joint_2 = self._two(one, "revolute", other, "revolute", "gear")
        factor = check_finite("ratio", ratio)
        if factor == 0.0:
            raise ValueError("ratio must not be zero: the other hinge would be held; use fixed(...) for that")
        row = self._gear_row(joint_1, joint_2, factor)
        name = self._new_name(f"gear of {joint_1.name} and {joint_2.name}", name)
        return self._coupled(name, "gear", joint_2, [row], joint_1)

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
        joint_1, joint_2 = self._two(pinion, "revolute", slide, "prismatic", "rack")
        factor = check_finite("radius", radius)
        if factor == 0.0:
            raise ValueError("radius must not be zero: the slide would be held; use fixed(...) for that")
        name = self._new_name(f"rack of {joint_1.name} and {joint_2.name}", name)
        slid = self.joint_coordinate(joint_2)
        start = slid.position(self._start())
        self._keep_axis(joint_2)
        row = self._wound_row(joint_1, lambda q: slid.position(q) - start, factor)
        return self._coupled(name, "rack", joint_2, [row], joint_1)

    def _gear_row(self, one: ModelJoint, other: ModelJoint, ratio: float) -> Row:
        raise NotImplementedError

    def _wound_row(self, pinion: ModelJoint, moved: Row, radius: float) -> Row:
        """Return the row by which a displacement is a radius times the rotation of a hinge since the position given."""
        raise NotImplementedError

    def _two(self, one: Any, kind: str, other: Any, other_kind: str, what: str) -> tuple[ModelJoint, ModelJoint]:
        first, second = self._joint(one, (kind,), what), self._joint(other, (other_kind,), what)
        if first is second:
            raise ValueError(f"a {what} needs two joints; given {first.name!r} twice")
        return first, second

    def _coupled(self, name: str, kind: str, reacting: ModelJoint, rows: list[Row], other: ModelJoint) -> ModelJoint:
        """Add the joint whose rows are functions of the coordinates of the bodies of two joints."""
        ends = reacting.a, reacting.b, reacting.point_a, reacting.point_b
        joint_rows = function_rows(f"{kind} {name!r}", rows, {reacting.a, reacting.b, other.a, other.b}, ends)
        return add(self.joints, ModelJoint(name, kind, *ends[:2], joint_rows, *ends[2:]))


Ends = tuple[Body, Body, Numbers, Numbers]


def function_rows(name: str, rows: Iterable[Row], bodies: Iterable[Body], ends: Ends) -> tuple[JointRow, ...]:
    """Return rows that are functions of the coordinates of some bodies."""
    columns = tuple(sorted(j for body in set(bodies) for j in body.coordinates))
    functions = (RowFunction(name, row, columns) for row in rows)
    return tuple(JointRow(ROW_FUNCTION, 1, *ends, listed(columns), function) for function in functions)


def listed(columns: tuple[int, ...]) -> Numbers:
    """Return the number of columns and the columns, as tables store them."""
    return Numbers((float(len(columns)), *map(float, columns)))

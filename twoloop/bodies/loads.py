"""Forces and prescribed motions of a model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twoloop.bodies.collection import Collection
from twoloop.bodies.documented import documented
from twoloop.bodies.functions import Function, Law, law_function, motion_function
from twoloop.bodies.parameter_layout import BRAKE, FORCE, PULL, RAIL, RUB, SPRING, TORQUE
from twoloop.bodies.parts import Body, DryFriction, Force, JointRow, ModelJoint, Numbers
from twoloop.checks.arguments import check_finite, check_not_negative, check_positive, shown


@documented
class Loads(Collection):
    """Adds springs, forces, motors and drives to a model."""

    def _drive_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        raise NotImplementedError

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        raise NotImplementedError

    def _motor(self, name: str, joint: ModelJoint, unit: str, f: Any) -> Force:
        raise NotImplementedError

    def _along(self, name: str, kind: int, joint: ModelJoint, numbers: Numbers | None) -> Force:
        """Return a force along the axis of a prismatic joint; for friction also the torque of a revolute joint."""
        raise NotImplementedError

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
        first, second, name, points, distance = self._apart("spring", a, at_a, b, at_b, name)
        law = _law(f"force of {name!r}", force, stiffness, damping or length is not None)
        if law is not None:
            return self._add_force(Force(name, SPRING, first, second, *points, None, law))
        stiffness, damping = check_not_negative("stiffness", stiffness), check_not_negative("damping", damping)
        length = distance if length is None else check_not_negative("length", length)
        if length == 0.0:
            if damping:
                raise ValueError(
                    f"the spring {name!r} without a length has no direction where its points meet, so that it takes no "
                    "damping; give it a length, or take a force of t, q, v for the damper"
                )
            more, kind = Numbers((stiffness,), (f"stiffness of {name} (N/m)",)), PULL
        else:
            names = f"stiffness of {name} (N/m)", f"damping of {name} (N s/m)", f"length of {name} (m)"
            more, kind = Numbers((stiffness, damping, length), names), SPRING
        return self._add_force(Force(name, kind, first, second, *points, more))

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
            A revolute joint, or its name.
        stiffness, damping : float
            N m/rad and N m s/rad.
        angle : float
            Rotation of b relative to a, from the position given, at which the spring has no torque, rad. In space the
            torque is defined up to 0.95 of a turn to either side of that position.
        torque : callable, optional
            In the place of stiffness, damping and angle: torque(angle, rate), N m, which acts on a, and against the
            angle on b. A linear spring has stiffness * angle + damping * rate.
        """
        hinge = self._joint(joint, ("revolute",), "torsion_spring")
        name = self._new_name(f"torsion spring of {hinge.name}", name)
        law = _law(f"torque of {name!r}", torque, stiffness, damping or angle)
        if law is not None:
            zero = Numbers((0.0,), (f"angle of {name} (rad)",))
            return self._add_force(replace(self._torsion(name, hinge, zero), function=law))
        given = {"stiffness": (stiffness, "N m/rad"), "damping": (damping, "N m s/rad"), "angle": (angle, "rad")}
        return self._add_force(self._torsion(name, hinge, _spring_numbers(name, given)))

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
            A prismatic joint, or its name.
        stiffness, damping : float
            N/m and N s/m.
        length : float
            Displacement of b along the axis of a, from the point on a, at which the spring has no force, m.
        force : callable, optional
            In the place of stiffness, damping and length: force(displacement, rate), N, which acts on a, and against
            the displacement on b. A linear spring has stiffness * displacement + damping * rate.
        """
        slide = self._joint(joint, ("prismatic",), "axial_spring")
        name = self._new_name(f"spring of {slide.name}", name)
        law = _law(f"force of {name!r}", force, stiffness, damping or length)
        if law is not None:
            return self._add_force(replace(self._along(name, RAIL, slide, None), function=law))
        given = {"stiffness": (stiffness, "N/m"), "damping": (damping, "N s/m"), "length": (length, "m")}
        return self._add_force(self._along(name, RAIL, slide, _spring_numbers(name, given)))

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
        return self._add_force(replace(self._along(name, BRAKE if turns else RUB, rubbed, numbers), joint=rubbed))

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
        self.dry.append(DryFriction(name, rubbed, kinetic, most, self._add_force(force)))
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
        there = self._numbers(name, on, self._point("at", at, on))
        function, more = self._function(name, f, self.dimension, "N")
        return self._add_force(Force(name, FORCE, self.ground, on, None, there, more, function))

    def torque(self, body: Body | str, f: Any, *, name: str | None = None) -> Force:
        """Add a torque on a body: in the plane a number, positive from x to y; in space (3,) along the axes of space.

        Parameters
        ----------
        body : Body or str
        f : float, array_like (3,) or callable
            N m: a constant torque, or f(t) or f(t, q, v) that returns one.
        """
        on = self._moving_body("body", body)
        name = self._new_name(f"torque on {on.name}", name)
        function, more = self._function(name, f, 1 if self.dimension == 2 else 3, "N m")
        return self._add_force(Force(name, TORQUE, self.ground, on, None, None, more, function))

    def motor(self, joint: ModelJoint | str, f: Any, *, name: str | None = None) -> Force:
        """Add a torque in a revolute joint, or a force along a prismatic joint, on b, with its reaction on a.

        Parameters
        ----------
        joint : ModelJoint or str
        f : float or callable
            N m or N: a number, or f(t) or f(t, q, v) that returns one.
        """
        moved = self._joint(joint, ("revolute", "prismatic"), "motor")
        name = self._new_name(f"motor of {moved.name}", name)
        return self._add_force(self._motor(name, moved, "N m" if moved.kind == "revolute" else "N", f))

    def drive(
        self,
        joint: ModelJoint | str,
        motion: Any,
        *,
        rate: Any = None,
        acceleration: Any = None,
        name: str | None = None,
    ) -> ModelJoint:
        """Prescribe the motion of a revolute or prismatic joint: the displacement of b on a from the position given.

        Parameters
        ----------
        joint : ModelJoint or str
        motion : callable
            motion(t), rad or m. The bodies are assembled at its initial value.
        rate, acceleration : callable, optional
            First and second derivative as functions of t. None: they are derived exactly from the motion, which must
            then consist of numpy functions without branches.
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
        moved = self._joint(joint, ("revolute", "prismatic"), "drive")
        name = self._new_name(f"drive of {moved.name}", name)
        row = self._drive_row(moved, motion_function(f"motion of {name!r}", motion, rate, acceleration))
        return self._add_joint(ModelJoint(name, "drive", moved.a, moved.b, (row,), moved.point_a, moved.point_b))


def _law(name: str, f: Any, stiffness: Any, more: Any) -> Law | None:
    """Return the force or torque of a spring as a function, or None if the spring has a stiffness."""
    if (f is None) == (stiffness is None) or (f is not None and more):
        raise TypeError(
            f"give either stiffness, with damping and what is unstressed, or a function in the place of all of them: "
            f"given {name} = {shown(f)}, stiffness={shown(stiffness)}"
        )
    return None if f is None else law_function(name, f)


def _spring_numbers(name: str, given: dict[str, tuple[Any, str]]) -> Numbers:
    """Return stiffness, damping and unstressed length or angle of a spring in a joint, with their units."""
    checks = check_not_negative, check_not_negative, check_finite
    values = tuple(check(what, value) for check, (what, (value, _)) in zip(checks, given.items(), strict=True))
    return Numbers(values, tuple(f"{what} of {name} ({unit})" for what, (_, unit) in given.items()))

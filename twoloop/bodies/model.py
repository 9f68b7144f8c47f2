"""What models in a plane and in space share: names, springs, forces, drives, and how they are put together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.bodies import assembly
from twoloop.bodies.functions import Function, force_function, is_constant, motion_function
from twoloop.bodies.model_energy import ModelEnergy
from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.model_system import joints_of, system_of
from twoloop.bodies.parameter_layout import FORCE, NONE, PULL, SPRING, TORQUE
from twoloop.bodies.parts import Body, BodyDirection, BodyPoint, Force, JointRow, ModelJoint, Numbers
from twoloop.bodies.sketches import drawing_of
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import check_finite, check_positive, check_span, check_text, check_vector, shown

Array = NDArray[np.float64]

AXES = ("x", "y", "z")


class Model:
    """Bodies, joints and forces; `PlanarModel` and `SpatialModel` say what these are in two and three dimensions."""

    dimension: int
    coordinate_names: tuple[str, ...]

    def __init__(self, gravity: ArrayLike, name: str):
        self.gravity = check_vector("gravity", gravity, self.dimension)
        self.name = check_text("name", name)
        zero = np.zeros(self.dimension)
        self.ground = Body("ground", NONE, zero, self._no_rotation(), np.zeros(0))
        self.bodies: list[Body] = []
        self.joints: list[ModelJoint] = []
        self.forces: list[Force] = []

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.name!r}: {len(self.bodies)} bodies, {len(self.joints)} joints and drives, "
            f"{len(self.forces)} forces)"
        )

    # in two and three dimensions: the angle or the matrix of the ground; rows of a drive; a spring or a torque in a
    # joint; numbers of an angle, as a vector
    def _no_rotation(self) -> Any:
        raise NotImplementedError

    def _drive_row(self, joint: ModelJoint, motion: Function) -> JointRow:
        raise NotImplementedError

    def _torsion(self, name: str, joint: ModelJoint, numbers: Numbers) -> Force:
        raise NotImplementedError

    def _motor(self, name: str, joint: ModelJoint, unit: str, f: Any) -> Force:
        raise NotImplementedError

    def spring(
        self,
        a: Body | str,
        at_a: Any,
        b: Body | str,
        at_b: Any,
        *,
        stiffness: float,
        damping: float = 0.0,
        length: float | None = None,
        name: str | None = None,
    ) -> Force:
        """A spring with a damper between a point of one body and a point of another.

        Parameters
        ----------
        a, b : Body or str
            The bodies, or their names.
        at_a, at_b : array_like (2 or 3,) or BodyPoint
            The points, in space in the position given, m; or `body.point(...)`.
        stiffness, damping : float
            N/m and N s/m.
        length : float, optional
            At which the spring is without force, m. None: the distance of the points in the position given.
        name : str, optional

        Returns
        -------
        Force

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong.
        """
        first, second = self._body("a", a), self._body("b", b)
        name = self._new_name("spring", name, first, second)
        self._different(name, first, second)
        here, there = self._point("at_a", at_a, first), self._point("at_b", at_b, second)
        distance = float(np.linalg.norm(first.in_space(here) - second.in_space(there)))
        stiffness, damping = _not_negative("stiffness", stiffness), _not_negative("damping", damping)
        length = distance if length is None else _not_negative("length", length)
        points = self._numbers(name, first, here), self._numbers(name, second, there)
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
        return self._add_force(Force(name, kind, first, second, *points, more, conserves=damping == 0.0))

    def torsion_spring(
        self,
        joint: ModelJoint | str,
        *,
        stiffness: float,
        damping: float = 0.0,
        angle: float = 0.0,
        name: str | None = None,
    ) -> Force:
        """A torsional spring with a damper in a revolute joint.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute joint, or its name.
        stiffness, damping : float
            N m/rad and N m s/rad.
        angle : float
            By how much b must have turned against a, from the position given, for the spring to be without torque, rad.
        name : str, optional

        Returns
        -------
        Force

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong.
        """
        hinge = self._joint(joint, ("revolute",), "torsion_spring")
        name = self._new_name(f"torsion spring of {hinge.name}", name)
        values = _not_negative("stiffness", stiffness), _not_negative("damping", damping), check_finite("angle", angle)
        names = f"stiffness of {name} (N m/rad)", f"damping of {name} (N m s/rad)", f"angle of {name} (rad)"
        return self._add_force(self._torsion(name, hinge, Numbers(values, names)))

    def force(self, body: Body | str, at: Any, f: Any, *, name: str | None = None) -> Force:
        """A force on a body, along the axes of space, at a point that the body carries along.

        Parameters
        ----------
        body : Body or str
        at : array_like (2 or 3,) or BodyPoint
            The point, in space in the position given, m; or `body.point(...)`.
        f : array_like (2 or 3,) or callable
            N: a constant force, or f(t) or f(t, q, v) that returns one. The coordinates of a body in `q` and `v` are
            `body.coordinates`.
        name : str, optional

        Returns
        -------
        Force

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong.
        """
        on = self._moving_body("body", body)
        name = self._new_name(f"force on {on.name}", name)
        there = self._numbers(name, on, self._point("at", at, on))
        function, more = self._function(name, f, self.dimension, "N")
        return self._add_force(Force(name, FORCE, self.ground, on, None, there, more, function))

    def torque(self, body: Body | str, f: Any, *, name: str | None = None) -> Force:
        """A torque on a body: in a plane a number, positive from x to y; in space (3,) along the axes of space.

        Parameters
        ----------
        body : Body or str
        f : float, array_like (3,) or callable
            N m: a constant torque, or f(t) or f(t, q, v) that returns one.
        name : str, optional

        Returns
        -------
        Force

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong.
        """
        on = self._moving_body("body", body)
        name = self._new_name(f"torque on {on.name}", name)
        function, more = self._function(name, f, 1 if self.dimension == 2 else 3, "N m")
        return self._add_force(Force(name, TORQUE, self.ground, on, None, None, more, function))

    def motor(self, joint: ModelJoint | str, f: Any, *, name: str | None = None) -> Force:
        """A torque in a revolute joint, or a force along a prismatic one: on b, and the opposite on a.

        Parameters
        ----------
        joint : ModelJoint or str
        f : float or callable
            N m or N: a number, or f(t) or f(t, q, v) that returns one.
        name : str, optional

        Returns
        -------
        Force

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong.
        """
        moved = self._joint(joint, ("revolute", "prismatic"), "motor")
        name = self._new_name(f"motor of {moved.name}", name)
        return self._add_force(self._motor(name, moved, "N m" if moved.kind == "revolute" else "N", f))

    def drive(
        self, joint: ModelJoint | str, motion: Any, *, rate: Any = None, acceleration: Any = None, name: str | None = None
    ) -> ModelJoint:
        """A given motion of a revolute or prismatic joint: how far b has turned or slid on a from the position given.

        Parameters
        ----------
        joint : ModelJoint or str
        motion : callable
            motion(t), rad or m. At the start of the run the bodies are put where it says.
        rate, acceleration : callable, optional
            Its first and second derivative, of t. None: they are derived from the motion, exactly, which must then be
            made of numpy's functions, without branches.
        name : str, optional

        Returns
        -------
        ModelJoint
            Whose reaction is the torque or force of the drive.

        Raises
        ------
        TypeError, ValueError
            If an argument is wrong, or the derivatives are neither given nor found.
        """
        moved = self._joint(joint, ("revolute", "prismatic"), "drive")
        name = self._new_name(f"drive of {moved.name}", name)
        row = self._drive_row(moved, motion_function(f"motion of {name!r}", motion, rate, acceleration))
        return self._add_joint(ModelJoint(name, "drive", moved.a, moved.b, (row,), moved.point_a, moved.point_b))

    def problem(
        self, t_span: tuple[float, float] = (0.0, 10.0), *, name: str | None = None, keep: Sequence[Body | str] = ()
    ) -> ModelProblem:
        """The model put together, ready to run.

        Bodies whose poses do not quite fit are moved by the least change until all joints close. Velocities that were
        given with bodies are kept, the others are those of least kinetic energy that the joints and drives allow.

        Parameters
        ----------
        t_span : (float, float)
            Start and end, s.
        name : str, optional
            None: that of the model.
        keep : sequence of Body or str
            Bodies that must stay where they are while the others are put together.

        Returns
        -------
        ModelProblem
            With the system, a consistent start, energy, joints, drawing, names, and `freedom`.

        Raises
        ------
        TypeError, ValueError
            If the model has no bodies, a joint cannot close (says which), or the joints do not allow the velocities.
        """
        span = check_span(t_span)
        name = self.name if name is None else check_text("name", name)
        if isinstance(keep, (str, Body)):
            keep = (keep,)
        kept = tuple(j for each in keep for j in self._moving_body("keep", each).coordinates)
        return self.put_together(span, name, kept, None, None)

    def put_together(
        self,
        t_span: tuple[float, float],
        name: str,
        keep: tuple[int, ...],
        values: Mapping[str, float] | None,
        guess: Array | None,
    ) -> ModelProblem:
        """What `problem` makes, with parameters and a guess of the positions."""
        if not self.bodies:
            raise ValueError(f"{self.name!r} has no bodies: add some with body(...) before problem()")
        tables = Tables(self.gravity, self.bodies, self.joints, self.forces, self._first_row())
        if values is not None:
            tables.replaced(dict(values))
            self._check_inertias(tables)
        joints = joints_of(tables)
        start = self._start() if guess is None else guess
        system = system_of(self.dimension, tables, joints, name, (t_span[0], start, np.zeros_like(start)))
        q = assembly.positions(system, t_span[0], start, keep, tables.rows)
        self._check_branches(t_span[0], q)
        given, known = self._velocities(q)
        coordinates = tuple(f"{each} of {body.name}" for body in self.bodies for each in self.coordinate_names)
        v = assembly.velocities(system, t_span[0], q, given, known, coordinates)
        freedom = assembly.freedom(system, t_span[0], q, tables.rows)
        moves = any(not is_constant(motion) for motion in tables.motions)
        return ModelProblem(
            name=name,
            system=system,
            q0=q,
            v0=v,
            t_span=t_span,
            energy=ModelEnergy(tables.p.copy(), self.dimension),
            parameters=tables.values,
            note=_note(freedom, tables.untraced),
            conserved=not moves and all(force.conserves for force in self.forces),
            tags=self._tags(freedom),
            coordinates=coordinates,
            drawing=drawing_of(tables),
            model=self,
            keep=keep,
            freedom=freedom,
        )

    def _first_row(self) -> int:
        """How many rows stand before those of the joints."""
        return 0

    def _check_inertias(self, tables: Tables) -> None:
        for body in self.bodies:
            place = tables.places[f"mass of {body.name} (kg)"]
            check_positive(f"mass of {body.name}", float(tables.p[place]))
            self._check_moments(body.name, tables.p[place + 1 : place + len(body.inertia)])

    def _check_moments(self, name: str, moments: Array) -> None:
        raise NotImplementedError

    def _check_branches(self, t: float, q: Array) -> None:
        """Whether every drive is where it should be, and not half a turn away."""

    def _start(self) -> Array:
        """The coordinates in the position given, (n_q,)."""
        raise NotImplementedError

    def _velocities(self, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """The velocities given, (n_q,), and which of them are."""
        raise NotImplementedError

    def _tags(self, freedom: assembly.Freedom) -> tuple[str, ...]:
        closed = sum(joint.kind != "drive" for joint in self.joints) >= len(self.bodies) + (
            not any(self.ground in (joint.a, joint.b) for joint in self.joints)
        )
        known = {
            "closed chain" if closed else "open chain": True,
            "rigid": True,
            "planar" if self.dimension == 2 else "spatial": True,
            "driven": any(joint.kind == "drive" for joint in self.joints),
            "redundant": bool(freedom.redundant),
            "singular": freedom.singular > 0,
        }
        return tuple(tag for tag, holds in known.items() if holds)

    def _add_body(self, body: Body) -> Body:
        self.bodies.append(body)
        return body

    def _add_joint(self, joint: ModelJoint) -> ModelJoint:
        self.joints.append(joint)
        return joint

    def _add_force(self, force: Force) -> Force:
        self.forces.append(force)
        return force

    def _new_name(self, what: str, name: str | None, *bodies: Body) -> str:
        """A name that nothing else has: the one given, or one of the kind and the bodies."""
        known = {each.name for part in (self.bodies, self.joints, self.forces) for each in part} | {"ground"}
        if name is not None:
            if not check_text("name", name).strip():
                raise ValueError(f"name must not be empty; given {name!r}")
            if name in known:
                raise ValueError(f"name must be new in the model: something is called {name!r} already")
            return name
        ordered = bodies[::-1] if bodies and bodies[0].number == NONE else bodies
        made = f"{what} {'-'.join(body.name for body in ordered)}" if bodies else what
        number = 2
        while (new := made if number == 2 and made not in known else f"{made} {number}") in known:
            number += 1
        return new

    def _body(self, argument: str, given: Any) -> Body:
        """A body of this model, by itself or by its name."""
        if isinstance(given, Body):
            if given is self.ground or any(given is body for body in self.bodies):
                return given
            raise ValueError(f"{argument} must be a body of this model; {given.name!r} belongs to another")
        if not isinstance(given, str):
            raise TypeError(f"{argument} must be a body, what body(...) returned, or its name; given {shown(given)}")
        for body in (self.ground, *self.bodies):
            if body.name == given:
                return body
        known = ", ".join(repr(body.name) for body in (self.ground, *self.bodies))
        raise ValueError(f"{argument} must be a body of this model, {known}; given {given!r}")

    def _moving_body(self, argument: str, given: Any) -> Body:
        body = self._body(argument, given)
        if body is self.ground:
            raise ValueError(f"{argument} must be a body that moves; given the ground")
        return body

    def _different(self, name: str, a: Body, b: Body) -> None:
        if a is b:
            raise ValueError(f"{name!r} must be between two bodies; given {a.name!r} twice")

    def _joint(self, given: Any, kinds: tuple[str, ...], what: str) -> ModelJoint:
        """A joint of this model of one of some kinds, by itself or by its name."""
        found = next((joint for joint in self.joints if given is joint or joint.name == given), None)
        if found is None:
            if not isinstance(given, (ModelJoint, str)):
                raise TypeError(f"joint must be what revolute(...) and its kin returned, or its name; given {shown(given)}")
            name = given if isinstance(given, str) else given.name
            known = ", ".join(repr(joint.name) for joint in self.joints) or "none so far"
            raise ValueError(f"joint must be one of this model, {known}; given {name!r}")
        if found.kind not in kinds:
            raise ValueError(f"{what} needs a {' or '.join(kinds)} joint; given {found.name!r}, which is {found.kind}")
        return found

    def _point(self, argument: str, given: Any, body: Body) -> Array:
        """A point in the axes of a body, given there or in space."""
        if isinstance(given, BodyPoint):
            if given.body is not body:
                raise ValueError(f"{argument} must be a point on {body.name!r}; given one on {given.body.name!r}")
            return given.place
        return body.local_point(check_vector(argument, given, self.dimension))

    def _points(self, at: Any, a: Body, b: Body) -> tuple[Array, Array]:
        """The point of a joint in the axes of both bodies: one in space, or a pair of theirs."""
        if isinstance(at, (tuple, list)) and any(isinstance(each, BodyPoint) for each in at):
            if len(at) != 2:
                raise ValueError(f"at must be a point in space, or a pair of points of a and b; given {shown(at)}")
            return self._point("at[0]", at[0], a), self._point("at[1]", at[1], b)
        if isinstance(at, BodyPoint):
            raise TypeError(
                "at must be a point in space, or a pair of points, one of each body: at=(a.point(...), b.point(...)); "
                f"given a point on {at.body.name!r} alone"
            )
        place = check_vector("at", at, self.dimension)
        return a.local_point(place), b.local_point(place)

    def _direction(self, argument: str, given: Any, body: Body) -> Array:
        """A unit direction in the axes of a body, given there or in space."""
        if isinstance(given, BodyDirection):
            if given.body is not body:
                raise ValueError(f"{argument} must be a direction on {body.name!r}; given one on {given.body.name!r}")
            direction = given.components
        else:
            direction = body.local_direction(check_vector(argument, given, self.dimension))
        length = float(np.linalg.norm(direction))
        if not length > 0.0:
            raise ValueError(f"{argument} must have a direction; given {shown(given)}, of length zero")
        return direction / length

    def _directions(self, axis: Any, a: Body, b: Body) -> tuple[Array, Array]:
        """The axis of a joint in the axes of both bodies."""
        if isinstance(axis, (tuple, list)) and any(isinstance(each, BodyDirection) for each in axis):
            if len(axis) != 2:
                raise ValueError(f"axis must be a direction, or a pair of directions of a and b; given {shown(axis)}")
            return self._direction("axis[0]", axis[0], a), self._direction("axis[1]", axis[1], b)
        return self._direction("axis", axis, a), self._direction("axis", axis, b)

    def _numbers(self, name: str, body: Body, place: Array) -> Numbers:
        """The place of a point on a body, named by what is there."""
        names = (f"{axis} of {name} on {body.name} (m)" for axis in AXES[: self.dimension])
        return Numbers(tuple(place.tolist()), tuple(names))

    def _function(self, name: str, given: Any, size: int, unit: str) -> tuple[Function | None, Numbers | None]:
        """The f of a force, a torque or a motor: a function, or constant numbers with names."""
        found = force_function(f"f of {name!r}", given, size)
        if isinstance(found, Function):
            return found, None
        parts = ("value",) if size == 1 else AXES[:size]
        return None, Numbers(tuple(found.tolist()), tuple(f"{part} of {name} ({unit})" for part in parts))

    def _pair(self, kind: str, a: Any, b: Any, name: str | None, at: Any) -> tuple[Body, Body, str, Numbers, Numbers]:
        """Bodies and name of a joint, and its point on both; None: the centre of mass of b, or of a on the ground."""
        first, second = self._body("a", a), self._body("b", b)
        self._different(f"{kind} joint", first, second)
        name = self._new_name(kind, name, first, second)
        if at is None:
            at = first.position if second is self.ground else second.position
        here, there = self._points(at, first, second)
        return first, second, name, self._numbers(name, first, here), self._numbers(name, second, there)

    def _distance(
        self, kind: int, a: Any, at_a: Any, b: Any, at_b: Any, length: float | None, name: str | None
    ) -> ModelJoint:
        first, second = self._body("a", a), self._body("b", b)
        self._different("distance joint", first, second)
        name = self._new_name("distance", name, first, second)
        here, there = self._point("at_a", at_a, first), self._point("at_b", at_b, second)
        if length is None:
            length = float(np.linalg.norm(first.in_space(here) - second.in_space(there)))
            if length == 0.0:
                raise ValueError(f"the points of {name!r} coincide in the position given; give a length, or take a pin")
        check_positive(f"length of {name!r}", length)
        points = self._numbers(name, first, here), self._numbers(name, second, there)
        long = Numbers((float(length),), (f"length of {name} (m)",))
        row = JointRow(kind, 1, first, second, *points, long)
        return self._add_joint(ModelJoint(name, "distance", first, second, (row,), *points))

    def _new_body(self, name: str, mass: float, position: ArrayLike, velocity: ArrayLike | None) -> tuple[Any, ...]:
        """What bodies have in two and three dimensions, checked: name, position, mass, velocity."""
        name = self._new_name("body", check_text("name", name))
        check_positive(f"mass of {name!r}", mass)
        place = check_vector(f"position of {name!r}", position, self.dimension)
        speed = None if velocity is None else check_vector(f"velocity of {name!r}", velocity, self.dimension)
        return name, place, float(mass), speed


def _not_negative(argument: str, value: Any) -> float:
    number = check_finite(argument, value)
    if number < 0.0:
        raise ValueError(f"{argument} must not be negative; given {value!r}")
    return number


def _note(freedom: assembly.Freedom, untraced: str) -> str:
    """What there is to know of a model that was put together."""
    noun = "degree" if freedom.degrees == 1 else "degrees"
    parts = [f"{freedom.degrees} {noun} of freedom."]
    if freedom.singular:
        parts.append(f"The start is singular: {freedom.singular} more there.")
    parts += [f"Rows follow from others among {', '.join(map(repr, group))}." for group in freedom.redundant]
    if untraced:
        parts.append(f"Its functions are called in Python, which is slower: {untraced}.")
    return " ".join(parts)

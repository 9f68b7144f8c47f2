"""Collect bodies, joints and forces under unique names, and interpret arguments that refer to them."""

from __future__ import annotations

import inspect
import re
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.functions import Function, force_function
from twoloop.bodies.parameter_layout import LENGTH, NONE
from twoloop.bodies.parts import (
    COINCIDE,
    Body,
    BodyDirection,
    BodyPoint,
    DryFriction,
    Force,
    JointRow,
    ModelJoint,
    Numbers,
)
from twoloop.checks.arguments import Array, check_positive, check_text, check_vector, shown
from twoloop.problem.description import Stop

# sections that many methods share, by the parameter that they describe
SHARED = {
    "name": "name : str\n",
    "mass": "mass : float\n    kg.\n",
    "radius": "radius : float\n    m.\n",
    "position": "position : array_like (2 or 3,)\n    Of the centre, m.\n",
    "a": "a, b : Body or str\n    The bodies, or their names.\n",
    "at": (
        "at : array_like (2 or 3,) or (BodyPoint, BodyPoint)\n    A point of the joint, in space in the position "
        "given, m; or a point of a and a point of b, which the\n    joint brings together.\n"
    ),
    "axis": (
        "axis : array_like (2 or 3,) or (BodyDirection, BodyDirection)\n    Direction, of any length, in space in the "
        "position given; or a direction of a and one of b.\n"
    ),
}
POSE = "**pose\n    `angle` (in space `rotation`), `velocity` and `angular_velocity`, as for `body`.\n"
NAME = "name : str, optional\n    Used in messages and results. None: made of the kind and the bodies.\n"
PARAMETERS, RETURNS, RAISED = (f"{title}\n{'-' * len(title)}\n" for title in ("Parameters", "Returns", "Raises"))
RAISES = f"{RAISED}TypeError, ValueError\n    If an argument is invalid, or the name is taken."


def documented(cls: Any) -> Any:
    """Complete the docstrings of methods that add to a model by the sections that they share."""
    for method in vars(cls).values():
        text = inspect.cleandoc(getattr(method, "__doc__", None) or "")  # python -OO removes docstrings
        if not text or not inspect.isfunction(method) or method.__name__.startswith("_") or RETURNS in text:
            continue
        given, returned = inspect.signature(method).parameters, method.__annotations__["return"]
        names = [each.name for each in given.values() if each.default is not None]
        shared = "".join(
            part for name, part in SHARED.items() if name in names and not re.search(rf"(?m)^{name}\b", text)
        )
        if returned == "None" or not (shared or PARAMETERS in text):
            continue
        text, raised, cause = text.partition(RAISED)
        head, _, own = text.partition(PARAMETERS)
        named = NAME if "name" in given and given["name"].default is None else ""
        named += POSE if "pose" in given else ""
        parameters = f"{PARAMETERS}{shared}{f'{own.rstrip()}{chr(10)}' if own else ''}{named}"
        method.__doc__ = (
            f"{head.rstrip()}\n\n{parameters}\n{RETURNS}{returned}\n\n{raised + cause if raised else RAISES}"
        )
    return cls


Points = tuple[Numbers, Numbers]
Part = TypeVar("Part")

AXES = ("x", "y", "z")
WITHOUT_POINT = ("fixed", "rolling")  # joints whose point may be left out

POINTS = {2: ("revolute",), 3: ("spherical", "point on line")}  # joints that do not hold rotations
PARTICLE_RADIUS = 0.01  # m, of gyration; in no equation of motion, as particles do not turn, but drawn


def add(parts: list[Part], part: Part) -> Part:
    """Append a part of a model to a list, and return it."""
    parts.append(part)
    return part


@documented
class Collection:
    """Collect bodies, joints and forces, in the plane or in space."""

    dimension: int

    def __init__(self, gravity: ArrayLike, name: str):
        self.gravity = check_vector("gravity", gravity, self.dimension)
        self.name = check_text("name", name)
        zero = np.zeros(self.dimension)
        self.ground = Body("ground", NONE, zero, 0.0 if self.dimension == 2 else np.eye(3), np.zeros(0))
        self.bodies: list[Body] = []
        self.joints: list[ModelJoint] = []
        self.forces: list[Force] = []
        self.stops: list[Stop] = []
        self.limits: list[tuple[tuple[str, str], float, Stop]] = []  # joint and coordinate, sign, stop
        self.dry: list[DryFriction] = []
        self.taken: list[Numbers] = []  # fixed values: racks and limits were made with them

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.name!r}: {len(self.bodies)} bodies, {len(self.joints)} joints and drives, "
            f"{len(self.forces)} forces)"
        )

    def _new_name(self, what: str, name: str | None, *bodies: Body) -> str:
        """Return a unique name: the one given, or one made of the kind and the bodies."""
        parts: list[Any] = [self.ground, *self.bodies, *self.joints, *self.forces, *self.stops]
        taken = {part.name for part in parts}
        if name is not None:
            if not check_text("name", name).strip():
                raise ValueError(f"name must not be empty; given {name!r}")
            if name in taken:
                owner = "a body" if any(body.name == name for body in self.bodies) else "another part"
                raise ValueError(f"name must be unique in the model: {name!r} is already taken by {owner}")
            return name
        ordered = bodies[::-1] if bodies and bodies[0].number == NONE else bodies
        base = f"{what} {'-'.join(body.name for body in ordered)}" if bodies else what
        number = 2
        while (new := base if number == 2 and base not in taken else f"{base} {number}") in taken:
            number += 1
        return new

    def _body(self, argument: str, given: Any) -> Body:
        """Return a body of this model, given as an object or by its name."""
        if isinstance(given, Body):
            if given is self.ground or any(given is body for body in self.bodies):
                return given
            raise ValueError(f"{argument} must be a body of this model; {given.name!r} belongs to another")
        if not isinstance(given, str):
            raise TypeError(f"{argument} must be a body, as returned by body(...), or its name; given {shown(given)}")
        for body in (self.ground, *self.bodies):
            if body.name == given:
                return body
        names = ", ".join(repr(body.name) for body in (self.ground, *self.bodies))
        raise ValueError(f"{argument} must be a body of this model, {names}; given {given!r}")

    def _moving_body(self, argument: str, given: Any) -> Body:
        body = self._body(argument, given)
        if body is self.ground:
            raise ValueError(f"{argument} must be a body that moves; given the ground")
        return body

    def _different(self, kind: str, a: Body, b: Body) -> None:
        if a is b:
            raise ValueError(f"a and b of a {kind} must be two bodies; given {a.name!r} twice")

    def _joint(self, given: Any, kinds: tuple[str, ...], what: str) -> ModelJoint:
        """Return a joint of this model that is of one of the given kinds, given as an object or by its name."""
        chosen = next((joint for joint in self.joints if given is joint or joint.name == given), None)
        if chosen is None:
            if not isinstance(given, (ModelJoint, str)):
                raise TypeError(
                    f"joint must be a joint, as returned by revolute(...) etc., or its name; given {shown(given)}"
                )
            if isinstance(given, ModelJoint):
                raise ValueError(f"joint must be one of this model; {given.name!r} belongs to another")
            names = ", ".join(repr(joint.name) for joint in self.joints) or "none so far"
            raise ValueError(f"joint must be one of this model, {names}; given {given!r}")
        if chosen.kind not in kinds:
            raise ValueError(
                f"{what} needs a {' or '.join(kinds)} joint; given {chosen.name!r}, which is {chosen.kind}"
            )
        return chosen

    def _point(self, argument: str, given: Any, body: Body) -> Array:
        """Return a point in the axes of a body, given in these axes or in space."""
        if isinstance(given, BodyPoint):
            if given.body is not body:
                raise ValueError(f"{argument} must be a point on {body.name!r}; given one on {given.body.name!r}")
            return given.place
        return body.local_point(check_vector(argument, given, self.dimension))

    def _points(self, at: Any, a: Body, b: Body) -> tuple[Array, Array]:
        """Return the point of a joint in the axes of both bodies, given as one point in space or as a pair."""
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
        """Return a unit vector in the axes of a body, given in these axes or in space."""
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
        """Return the axis of a joint in the axes of both bodies."""
        if isinstance(axis, (tuple, list)) and any(isinstance(each, BodyDirection) for each in axis):
            if len(axis) != 2:
                raise ValueError(f"axis must be a direction, or a pair of directions of a and b; given {shown(axis)}")
            return self._direction("axis[0]", axis[0], a), self._direction("axis[1]", axis[1], b)
        return self._direction("axis", axis, a), self._direction("axis", axis, b)

    def _numbers(self, name: str, body: Body, place: Array) -> Numbers:
        """Return the named coordinates of a point on a body."""
        names = (f"{axis} of {name} on {body.name} (m)" for axis in AXES[: self.dimension])
        return Numbers(tuple(place.tolist()), tuple(names))

    def _function(self, name: str, given: Any, size: int, unit: str) -> tuple[Function | None, Numbers | None]:
        """Return the f of a force, torque or motor: a function, or named constants."""
        value = force_function(f"f of {name!r}", given, size)
        if isinstance(value, Function):
            return value, None
        parts = ("value",) if size == 1 else AXES[:size]
        return None, Numbers(tuple(value.tolist()), tuple(f"{part} of {name} ({unit})" for part in parts))

    def _pair(self, kind: str, a: Any, b: Any, name: str | None, at: Any) -> tuple[Body, Body, str, Points]:
        """Return bodies, name and points of a joint; default point: the centre of mass of b, or of a on the ground."""
        body_a, body_b = self._body("a", a), self._body("b", b)
        self._different(f"{kind} joint", body_a, body_b)
        for particle, other in ((body_a, body_b), (body_b, body_a)):
            if particle.is_particle and other is not self.ground and kind not in POINTS[self.dimension]:
                raise ValueError(
                    f"{particle.name!r} is a particle, which does not turn: a {kind} joint would keep {other.name!r} "
                    f"from turning. Use {POINTS[self.dimension][0]}(...) or distance(...); for a mass fixed to "
                    f"{other.name!r}, add it to the mass and inertia of that body"
                )
        name = self._new_name(kind, name, body_a, body_b)
        if at is None and kind in WITHOUT_POINT:
            at = body_a.position if body_b is self.ground else body_b.position
        point_a, point_b = self._points(at, body_a, body_b)
        return body_a, body_b, name, (self._numbers(name, body_a, point_a), self._numbers(name, body_b, point_b))

    def _weld(self, name: str, a: Body, b: Body, points: Points) -> tuple[JointRow, ...]:
        """Return the rows that fix two bodies to each other."""
        raise NotImplementedError

    def fixed(self, a: Body | str, b: Body | str, *, at: Any = None, name: str | None = None) -> ModelJoint:
        """Fix two bodies to each other.

        Parameters
        ----------
        at : array_like (2,) or (3,) or (BodyPoint, BodyPoint), optional
            Point of reference of the reaction, m. None: the centre of mass of b, or of a if b is the ground.
        """
        body_a, body_b, name, points = self._pair("fixed", a, b, name, at)
        rows = self._weld(name, body_a, body_b, points)
        return add(self.joints, ModelJoint(name, "fixed", body_a, body_b, rows, *points))

    def _apart(
        self, kind: str, a: Any, at_a: Any, b: Any, at_b: Any, name: str | None
    ) -> tuple[Body, Body, str, Points, float]:
        """Return the bodies and name of a part between two points, the points, and their initial distance."""
        body_a, body_b = self._body("a", a), self._body("b", b)
        self._different(kind, body_a, body_b)
        name = self._new_name(kind.removesuffix(" joint"), name, body_a, body_b)
        point_a, point_b = self._point("at_a", at_a, body_a), self._point("at_b", at_b, body_b)
        end_a, end_b = body_a.in_space(point_a), body_b.in_space(point_b)
        distance = float(np.linalg.norm(end_a - end_b))
        if distance <= COINCIDE * np.abs((end_a, end_b)).max():  # but for rounding
            distance = 0.0
        points = self._numbers(name, body_a, point_a), self._numbers(name, body_b, point_b)
        return body_a, body_b, name, points, distance

    def distance(
        self,
        a: Body | str,
        at_a: Any,
        b: Body | str,
        at_b: Any,
        *,
        length: float | None = None,
        name: str | None = None,
    ) -> ModelJoint:
        """Add a massless rod between a point of a and a point of b.

        Parameters
        ----------
        at_a, at_b : array_like (2,) or (3,), or BodyPoint
            The points, in space in the position given, m.
        length : float, optional
            m. None: their distance in the position given.
        """
        body_a, body_b, name, points, apart = self._apart("distance joint", a, at_a, b, at_b, name)
        if length is None:
            length = apart
            if length == 0.0:
                raise ValueError(f"the points of {name!r} coincide in the position given; give a length or use a joint")
        check_positive(f"length of {name!r}", length)
        long = Numbers((float(length),), (f"length of {name} (m)",))
        row = JointRow(LENGTH, 1, body_a, body_b, *points, long)
        return add(self.joints, ModelJoint(name, "distance", body_a, body_b, (row,), *points))

    def particle(self, name: str, *, mass: float, position: ArrayLike, velocity: ArrayLike | None = None) -> Body:
        """Add a point mass: a body that does not turn, so that it needs no inertia.

        Parameters
        ----------
        velocity : array_like (2,) or (3,), optional
            Initial velocity, m/s. None: determined by the other velocities.

        Examples
        --------
        >>> from twoloop.bodies import PlanarModel
        >>> model = PlanarModel(name="pendulum")
        >>> bob = model.particle("bob", mass=2.0, position=(1.0, 0.0))
        >>> string = model.distance("ground", (0.0, 0.0), bob, (1.0, 0.0))
        >>> model.problem().freedom.degrees
        1
        """
        check_positive(f"mass of {name!r}", mass)
        inertia = PARTICLE_RADIUS**2 * mass * np.ones(1 if self.dimension == 2 else 3)
        model: Any = self
        model.body(
            name,
            mass=mass,
            inertia=inertia if self.dimension == 3 else inertia[0],
            position=position,
            velocity=velocity,
        )
        self.bodies[-1] = body = replace(self.bodies[-1], is_particle=True)
        points = Numbers(tuple(body.position)), Numbers((0.0,) * self.dimension)
        held = self._new_name(f"rotation of {name}", None)
        rows = self._weld(held, self.ground, body, points)[1:]
        self.joints.append(ModelJoint(held, "no rotation", self.ground, body, rows, *points))
        return body

    def _new_body(self, name: str, mass: float, position: ArrayLike, velocity: ArrayLike | None) -> tuple[Any, ...]:
        """Check what bodies in the plane and in space have in common; return name, position, mass and velocity."""
        name = self._new_name("body", check_text("name", name))
        check_positive(f"mass of {name!r}", mass)
        place = check_vector(f"position of {name!r}", position, self.dimension)
        speed = None if velocity is None else check_vector(f"velocity of {name!r}", velocity, self.dimension)
        return name, place, float(mass), speed

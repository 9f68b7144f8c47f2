"""What models in a plane and in space share: names, springs, forces, drives, and how they are put together."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.bodies import assembly
from twoloop.bodies.collection import Collection
from twoloop.bodies.functions import Function, motion_function
from twoloop.bodies.model_energy import ModelEnergy
from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.model_system import joints_of, system_of
from twoloop.bodies.parameter_layout import FORCE, PULL, SPRING, TORQUE
from twoloop.bodies.parts import Body, Force, JointRow, ModelJoint, Numbers
from twoloop.bodies.sketches import drawing_of
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import check_finite, check_positive, check_span, check_text

Array = NDArray[np.float64]


class Model(Collection):
    """What `PlanarModel` and `SpatialModel` share beside their bodies and joints."""

    coordinate_names: tuple[str, ...]

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
        self._different("spring", first, second)
        name = self._new_name("spring", name, first, second)
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
        return self._add_force(Force(name, kind, first, second, *points, more))

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
        self,
        joint: ModelJoint | str,
        motion: Any,
        *,
        rate: Any = None,
        acceleration: Any = None,
        name: str | None = None,
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
        about = t_span[0], start, np.zeros_like(start)
        system = system_of(self.dimension, tables, joints, name, about)
        still = system_of(self.dimension, tables, joints, name, about, moves=False) if tables.motions else system
        q = assembly.positions(still, t_span[0], start, self._turning(), keep, tables.rows)
        self._check_branches(t_span[0], q)
        given, known = self._velocities(q)
        coordinates = tuple(f"{each} of {body.name}" for body in self.bodies for each in self.coordinate_names)
        v = assembly.velocities(system, t_span[0], q, given, known, coordinates)
        freedom = assembly.freedom(system, t_span[0], q, tables.rows)
        return ModelProblem(
            name=name,
            system=system,
            q0=q,
            v0=v,
            t_span=t_span,
            energy=ModelEnergy(tables.p.copy(), self.dimension),
            parameters=tables.values,
            note=_note(freedom, tables.untraced),
            conserved=tables.conserve,
            tags=self._tags(freedom),
            coordinates=coordinates,
            drawing=drawing_of(tables),
            model=self._as_it_is(),
            keep=keep,
            freedom=freedom,
        )

    def _as_it_is(self) -> Model:
        """A copy to which nothing is added."""
        other = copy.copy(self)
        other.bodies, other.joints, other.forces = list(self.bodies), list(self.joints), list(self.forces)
        return other

    def _turning(self) -> NDArray[np.bool_]:
        """Which coordinates are rotations."""
        return np.tile(np.arange(len(self.coordinate_names)) >= self.dimension, len(self.bodies))

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
        closed = False
        linked = {body.number: {body.number} for body in (self.ground, *self.bodies)}
        for joint in self.joints:
            if joint.kind != "drive":
                one, other = linked[joint.a.number], linked[joint.b.number]
                closed |= one is other
                one |= other
                linked |= dict.fromkeys(other, one)
        known = {
            "closed chain" if closed else "open chain": True,
            "rigid": True,
            "planar" if self.dimension == 2 else "spatial": True,
            "driven": any(joint.kind == "drive" for joint in self.joints),
            "redundant": bool(freedom.redundant),
            "singular": freedom.singular > 0,
        }
        return tuple(tag for tag, holds in known.items() if holds)


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

"""How models in a plane and in space are put together."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twoloop.bodies import assembly
from twoloop.bodies.functions import motion_function
from twoloop.bodies.model_energy import ModelEnergy
from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.model_stops import Stops
from twoloop.bodies.model_system import check_forces, check_loads, joints_of, system_of
from twoloop.bodies.notes import note_of
from twoloop.bodies.parts import Body, DryFriction, ModelJoint, Numbers
from twoloop.bodies.sketches import drawing_of
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import Array, check_positive, check_span, check_text, shown
from twoloop.problem.system import ConstrainedSystem


class Model(Stops):
    """What `PlanarModel` and `SpatialModel` share beside their bodies and joints."""

    coordinate_names: tuple[str, ...]

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
        if not isinstance(keep, (tuple, list)):
            raise TypeError(f"keep must be a list of bodies, or of their names; given {shown(keep)}")
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
        tables = self._tables(self.joints, values)
        tables.check()
        for numbers in self.taken:
            if tables.of(numbers).tolist() != list(numbers.values):
                raise ValueError(f"{numbers.names[0]} cannot change, as a rack or a limit has it: make the model anew")
        self._check_inertias(tables)
        start = self._start() if guess is None else guess
        about = t_span[0], start, np.zeros_like(start)
        system = system_of(self.dimension, tables, joints_of(tables), name, about)
        coordinates = tuple(f"{each} of {body.name}" for body in self.bodies for each in self.coordinate_names)
        bare, joints = tables, [joint for joint in self.joints if joint.kind != "drive"]
        if len(joints) < len(self.joints):
            bare = self._tables(joints, values)
        still = system if bare is tables else system_of(self.dimension, bare, joints_of(bare), name, about)
        closed = q = assembly.positions(still, t_span[0], start, self._turning(), keep, bare.rows, coordinates)
        if bare is not tables:
            q = assembly.driven_there(system, t_span[0], q, keep)
        self._check_branches(t_span[0], q)
        given, known = self._velocities(q)
        v = assembly.velocities(system, t_span[0], q, given, known, coordinates)
        check_forces(tables, t_span[0], q, v)
        freedom = assembly.freedom(system, t_span[0], q, tables.rows)
        check_loads(tables, freedom.redundant, system.force(t_span[0], q, v))
        return ModelProblem(
            name=name,
            system=system,
            q0=q,
            v0=v,
            t_span=t_span,
            energy=ModelEnergy(tables.p.copy(), self.dimension),
            parameters=tables.values,
            note=note_of(self, tables, freedom, closed if guess is not None else start, closed, q, coordinates),
            conserved=tables.conserve and not self.dry,
            tags=self._tags(freedom),
            coordinates=coordinates,
            drawing=drawing_of(tables),
            model=self._as_it_is(),
            keep=keep,
            freedom=freedom,
            stops=tuple(self.stops),
        )

    def mode(
        self,
        name: str,
        values: Mapping[str, float],
        friction: Mapping[str, float],
        held: Mapping[str, float],
        t: float,
        q: Array,
    ) -> tuple[ConstrainedSystem, dict[str, tuple[int, ...]]]:
        """The system while dry friction has given values, and some of its joints are held.

        Parameters
        ----------
        name : str
        values : mapping
            Parameters by their names.
        friction, held : mapping
            By the names of what rubs: the forces, and how far b has turned or slid on a where it sticks. NaN: it has
            slid by the time, as that of a gauge.
        t, q : float, ndarray (n_q,)
            A state of it.

        Returns
        -------
        ConstrainedSystem
        dict
            Rows of the joints that are held, by the names of what rubs.
        """
        other = self._as_it_is()
        for rub in self.dry:
            if rub.name in friction:
                number = Numbers((friction[rub.name],))
                other.forces[self.forces.index(rub.force)] = replace(rub.force, more=number)
            if rub.name in held:
                at, joint = held[rub.name], rub.joint
                motion = motion_function(rub.name, (lambda t: t) if np.isnan(at) else lambda t, at=at: at, None, None)
                points = joint.point_a, joint.point_b
                row = self._drive_row(joint, motion)
                other.joints.append(ModelJoint(f"{rub.name} sticks", "drive", joint.a, joint.b, (row,), *points))
        tables = other._tables(other.joints, values)
        system = system_of(self.dimension, tables, joints_of(tables), name, (t, q, np.zeros_like(q)))
        return system, {name: tables.rows[f"{name} sticks"] for name in held}

    def pull(self, rub: DryFriction, values: Mapping[str, float]) -> ConstrainedSystem:
        """A system whose force is that of unit friction alone: by how much a joint slides with the coordinates."""
        other = self._as_it_is()
        other.gravity, other.forces = np.zeros(self.dimension), [replace(rub.force, more=Numbers((1.0,)))]
        places = {name: value for name, value in values.items() if not name.startswith("gravity")}
        tables, still = other._tables([], places), np.zeros_like(self._start())
        return system_of(self.dimension, tables, [], rub.name, (0.0, self._start(), still))

    def _tables(self, joints: Sequence[ModelJoint], values: Mapping[str, float] | None) -> Tables:
        """The tables of the model with some of its joints, and with other values of its parameters."""
        tables = Tables(self.gravity, self.bodies, joints, self.forces, self._first_row())
        tables.replaced(values or {})
        return tables

    def _as_it_is(self) -> Model:
        """A copy to which nothing is added."""
        other = copy.copy(self)
        other.bodies, other.joints, other.forces = list(self.bodies), list(self.joints), list(self.forces)
        other.stops, other.dry, other.taken = list(self.stops), list(self.dry), list(self.taken)
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
        given = np.full((len(self.bodies), len(self.coordinate_names)), np.nan)
        for row, body, state in zip(given, self.bodies, q.reshape(given.shape), strict=True):
            if body.velocity is not None:
                row[: self.dimension] = body.velocity
            if body.angular_velocity is not None:
                row[self.dimension :] = self._turning_rates(state, body.angular_velocity)
        known = np.isfinite(given.ravel())
        return np.where(known, given.ravel(), 0.0), known

    def _turning_rates(self, state: Array, spin: Array) -> Array:
        """The rates of the coordinates of a body that are rotations, at an angular velocity."""
        return spin

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

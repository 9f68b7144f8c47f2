"""Assembly of models in the plane and in space."""

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
    """Methods shared by `PlanarModel` and `SpatialModel`."""

    coordinate_names: tuple[str, ...]

    def problem(
        self, t_span: tuple[float, float] = (0.0, 10.0), *, name: str | None = None, keep: Sequence[Body | str] = ()
    ) -> ModelProblem:
        """Assemble the model.

        Bodies whose poses do not quite fit are moved as little as possible until all joints close. Velocities given
        with the bodies are kept; the others minimise the kinetic energy subject to the joints and drives.

        Parameters
        ----------
        t_span : (float, float)
            Start and end, s.
        name : str, optional
            None: the name of the model.
        keep : sequence of Body or str
            Bodies that must not move during the assembly.

        Returns
        -------
        ModelProblem
            The system, a consistent initial state, energy, joints, drawing, names of coordinates and `freedom`.

        Raises
        ------
        TypeError, ValueError
            If the model has no bodies, a joint cannot close (the message names it), or the velocities given violate the
            constraints.
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
        """Assemble the model with other parameter values and a guess of the positions; see `problem`."""
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
            q = assembly.follow_drives(system, t_span[0], q, keep)
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
            model=self._copy(),
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
        """Return the system with given dry friction forces and with the sticking joints held.

        Parameters
        ----------
        name : str
        values : mapping
            Parameter values by name.
        friction, held : mapping
            By the names of the dry frictions: the friction forces, and the displacement of b on a where the joint
            sticks. NaN: the displacement equals t, as for a gauge.
        t, q : float, ndarray (n_q,)
            Time and positions.

        Returns
        -------
        ConstrainedSystem
        dict
            Rows of the joints held, by the names of the dry frictions.
        """
        other = self._copy()
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
        """Return a system whose only force is unit friction in the joint: its slip as a function of the coordinates."""
        other = self._copy()
        other.gravity, other.forces = np.zeros(self.dimension), [replace(rub.force, more=Numbers((1.0,)))]
        places = {name: value for name, value in values.items() if not name.startswith("gravity")}
        tables, still = other._tables([], places), np.zeros_like(self._start())
        return system_of(self.dimension, tables, [], rub.name, (0.0, self._start(), still))

    def _tables(self, joints: Sequence[ModelJoint], values: Mapping[str, float] | None) -> Tables:
        """Return the tables of the model restricted to some joints, with other parameter values."""
        tables = Tables(self.gravity, self.bodies, joints, self.forces, self._first_row())
        tables.replaced(values or {})
        return tables

    def _copy(self) -> Model:
        """Return a copy that later additions to the model do not change."""
        other = copy.copy(self)
        other.bodies, other.joints, other.forces = list(self.bodies), list(self.joints), list(self.forces)
        other.stops, other.dry, other.taken = list(self.stops), list(self.dry), list(self.taken)
        return other

    def _turning(self) -> NDArray[np.bool_]:
        """Return which coordinates are rotations, (n_q,)."""
        return np.tile(np.arange(len(self.coordinate_names)) >= self.dimension, len(self.bodies))

    def _first_row(self) -> int:
        """Return the number of rows before those of the joints."""
        return 0

    def _check_inertias(self, tables: Tables) -> None:
        for body in self.bodies:
            place = tables.places[f"mass of {body.name} (kg)"]
            check_positive(f"mass of {body.name}", float(tables.p[place]))
            self._check_moments(body.name, tables.p[place + 1 : place + len(body.inertia)])

    def _check_moments(self, name: str, moments: Array) -> None:
        raise NotImplementedError

    def _check_branches(self, t: float, q: Array) -> None:
        """Raise if a drive starts half a turn away from its value, or a gear at another tooth."""

    def _start(self) -> Array:
        """Return the coordinates in the position given, (n_q,)."""
        raise NotImplementedError

    def _velocities(self, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the velocities given, (n_q,), and a mask of those that are given."""
        given = np.full((len(self.bodies), len(self.coordinate_names)), np.nan)
        for row, body, state in zip(given, self.bodies, q.reshape(given.shape), strict=True):
            if body.velocity is not None:
                row[: self.dimension] = body.velocity
            if body.angular_velocity is not None:
                row[self.dimension :] = self._turning_rates(state, body.angular_velocity)
        known = np.isfinite(given.ravel())
        return np.where(known, given.ravel(), 0.0), known

    def _turning_rates(self, state: Array, spin: Array) -> Array:
        """Return the rates of the rotational coordinates of a body with a given angular velocity."""
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

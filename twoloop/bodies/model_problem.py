"""Assemble a model to a problem with named parameters, which can be reassembled with other values."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.bodies import assembly, inverse_dynamics, joint_state, loop_closure
from twoloop.bodies.assembly import Freedom, note_of
from twoloop.bodies.coordinates import KINDS, JointCoordinate, SpatialAngle
from twoloop.bodies.drawings import drawing_of
from twoloop.bodies.energy import ModelEnergy
from twoloop.bodies.functions import motion_function
from twoloop.bodies.joint_state import Request
from twoloop.bodies.parameter_layout import ALONG
from twoloop.bodies.parts import Body, DryFriction, ModelJoint, Numbers
from twoloop.bodies.ropes import Ropes
from twoloop.bodies.rotation import euler_rates
from twoloop.bodies.spanning_tree import SpanningTree
from twoloop.bodies.system import check_forces, check_loads, joints_of, system_of
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import Array, check_finite, check_positive, check_span, check_text, shown
from twoloop.problem.description import Stop
from twoloop.problem.problem import Problem
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.signals import SignalHandlers

Given = tuple[tuple[str, str, float], ...]  # joint, "angle" or "displacement", value
UNCOUNTED = (
    ("revolute", "angle"),
    ("cylindrical", "angle"),
)  # joints and their angles in space, whose whole turns a state does not contain
MOST_TURNED = 0.95 * 2.0 * np.pi  # rad


@dataclass(frozen=True)
class ModelProblem(Problem):
    """A `Problem` made of bodies and joints.

    `parameters` maps the names of all masses, positions, lengths, stiffnesses, ... to values, in the order in which
    they begin `system.parameters`. The rest of that vector encodes the topology and must not be changed.

    Attributes
    ----------
    freedom : Freedom
        Degrees of freedom, and the joints with redundant rows.
    stops : tuple of Stop
        For `solve_with_stops`.

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> pin = model.revolute("ground", bob, at=(0.0, 0.0), name="pin")
    >>> problem = model.problem((0.0, 1.0))
    >>> heavier = problem.with_parameters({"mass of bob": 3.0})
    >>> float(heavier.system.mass(0.0, heavier.q0)[0, 0])
    3.0
    """

    model: Model | None = field(default=None, repr=False)
    keep: tuple[int, ...] = field(default=(), repr=False)
    given: tuple[Given, Given] = field(default=((), ()), repr=False)  # positions and rates of joints
    freedom: Freedom = field(default_factory=lambda: Freedom(0, 0, ()))
    stops: tuple[Stop, ...] = ()
    joint_coordinates: tuple[JointCoordinate, ...] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.system.description = replace(self.system.description, joint_coordinates=self.joint_coordinates)

    def joint_coordinate(self, joint: ModelJoint | str, which: str | None = None) -> JointCoordinate:
        """Return the angle or displacement of a joint, which gives its position and rate in states of this problem.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute, prismatic, cylindrical or screw joint, or its name.
        which : str, optional
            "angle" or "displacement" of a cylindrical or screw joint. None: the only one, or the angle of a screw.

        Returns
        -------
        JointCoordinate

        Raises
        ------
        ValueError
            If there is no such coordinate.
        """
        name = joint.name if isinstance(joint, ModelJoint) else joint
        own = [each for each in self.joint_coordinates if each.joint == name and which in (None, each.which)]
        if not own:
            names = list(dict.fromkeys(repr(each.joint) for each in self.joint_coordinates))
            raise ValueError(
                f"joint must be one of {self.name!r} that has {'a coordinate' if which is None else shown(which)}, "
                f"{', '.join(names) or 'but there is none'}; given {shown(name)}"
            )
        if len(own) > 1 and isinstance(own[0], SpatialAngle):
            raise ValueError(
                f'{name!r} has an angle and a displacement: say which, as joint_coordinate({name!r}, "angle")'
            )
        return own[0]  # for a screw, this is the angle

    def actuator_forces(self, result: Any, actuators: Sequence[Any]) -> Array:
        """Return the forces with which motors elsewhere make the motion that the drives prescribe (inverse dynamics).

        Parameters
        ----------
        result : Result
            A run of this problem.
        actuators : sequence of ModelJoint, str or (ModelJoint or str, str)
            Joints with the motors, in the place of the drives; pairs as for `positions`.

        Returns
        -------
        ndarray (n_actuators, n_t)
            Torques and forces as of `motor`, N m or N. NaN at singular positions, where they do not determine
            the motion.

        Raises
        ------
        ValueError
            If the model has no drive, or the actuators cannot make this motion: with fewer actuators than degrees of
            freedom, a motion is in general only possible that the model would have to find itself.

        Examples
        --------
        >>> import numpy as np
        >>> from twoloop import solve_dae
        >>> from twoloop.bodies import PlanarModel
        >>> O, A, B, D = (0.0, 0.0), (0.0, 1.0), (2.0, 1.5), (2.5, 0.0)
        >>> model = PlanarModel(name="linkage")
        >>> for name, start, end in (("crank", O, A), ("coupler", A, B), ("rocker", B, D)):
        ...     rod = model.rod(name, start, end, mass=1.0)
        >>> for a, b, pin in (("ground", "crank", O), ("crank", "coupler", A), ("coupler", "rocker", B)):
        ...     joint = model.revolute(a, b, at=pin, name=f"{a}-{b}")
        >>> output = model.revolute("ground", "rocker", at=D, name="output")
        >>> drive = model.drive(output, lambda t: 0.2 * np.sin(t) ** 2)
        >>> problem = model.problem((0.0, 3.0))
        >>> run = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0)
        >>> problem.actuator_forces(run, ["ground-crank"]).shape == (1, run.t.size)
        True
        """
        if self.model is None or not any(joint.kind == "drive" for joint in self.model.joints):
            raise ValueError(f"{self.name!r} has no drive: prescribe the motion with drive(...) or drive_point(...)")
        pairs = [each if isinstance(each, tuple) and len(each) == 2 else (each, None) for each in actuators]
        coordinates = [self.joint_coordinate(*each) for each in pairs]
        drives = {joint.name for joint in self.model.joints if joint.kind == "drive"}
        rows = [row for joint in self.system.joints if joint.name in drives for row in joint.rows]
        return inverse_dynamics.actuator_forces(self.system, result, rows, coordinates)

    def place(self, name: str) -> int:
        """Return the index of a parameter in `system.parameters`, by its name with or without the unit.

        Raises
        ------
        ValueError
            If there is no parameter of that name.
        """
        return self._known(name)[1]

    def with_parameters(self, parameters: Mapping[str, float]) -> ModelProblem:
        """Return the same model with other values of some parameters, reassembled from this start.

        Parameters
        ----------
        parameters : mapping
            Values by name, with or without the unit.

        Returns
        -------
        ModelProblem
            Its start is near this one and has the velocities given with the bodies. Nothing is recompiled.

        Raises
        ------
        TypeError, ValueError
            If a name is unknown, a value is not finite, or the model cannot be assembled.
        """
        if not isinstance(parameters, Mapping):
            raise TypeError(f"parameters must be a mapping from names to numbers; given {parameters!r}")
        values = dict(self.parameters)
        for name, value in parameters.items():
            values[self._known(name)[0]] = check_finite(f"parameters[{name!r}]", value)
        if self.model is None:
            raise ValueError(
                f"{self.name!r} came from another process without its model, whose functions cannot travel: make it "
                "again, or give them names at the top level of a module"
            )
        return self.model.assemble(self.t_span, self.name, self.keep, values, self.q0, *self.given)

    def __getstate__(self) -> dict[str, Any]:
        state = dict(vars(self))
        try:
            pickle.dumps(self.model)
        except Exception:  # e.g. a lambda
            state["model"] = None
        return state

    def _known(self, name: Any) -> tuple[str, int]:
        for place, full_name in enumerate(self.parameters):
            if name in (full_name, full_name.rpartition(" (")[0]):
                return full_name, place
        words = str(name).split()
        near = [full_name for full_name in self.parameters if words and words[-1] in full_name.split()]
        raise ValueError(f"{self.name!r} has no parameter {name!r}; it has {_listed(near or list(self.parameters))}")


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(map(repr, names[:6]))
    return shown if len(names) <= 6 else f"{shown} and {len(names) - 6} more: see problem.parameters"


class Model(Ropes):
    """Assemble models, in the plane and in space."""

    coordinate_names: tuple[str, ...]

    def problem(
        self,
        t_span: tuple[float, float] = (0.0, 10.0),
        *,
        name: str | None = None,
        keep: Sequence[Body | str] = (),
        positions: Mapping[Any, float] | None = None,
        rates: Mapping[Any, float] | None = None,
    ) -> ModelProblem:
        """Assemble the model.

        Where the poses of the bodies are rough, all joints are closed within their limits. Of several assemblies, the
        one is taken whose joints are nearest to the angles and displacements that they have in these poses; poses that
        may mean two are refused. Velocities given with the bodies are kept; the others minimise the kinetic energy
        subject to the joints and drives. With `rates`, the others minimise the rates in the other joints instead.

        Parameters
        ----------
        t_span : (float, float)
            Start and end, s.
        name : str, optional
            None: the name of the model.
        keep : sequence of Body or str
            Bodies that must not move during the assembly.
        positions, rates : mapping, optional
            Initial angles and displacements of joints from the position given, and their rates, by the joint or its
            name: rad, m, rad/s and m/s. The key of a coordinate of a cylindrical or screw joint is a pair, such as
            ("sleeve", "displacement"). Joints that are not given do not move in an open chain, and move as little as
            possible in a loop. Where the poses alone do not close the loops, these positions are where they start.

        Returns
        -------
        ModelProblem
            The system, a consistent initial state, energy, joints, drawing, names of coordinates and `freedom`.

        Raises
        ------
        TypeError, ValueError
            If the model has no bodies, a joint cannot close (the message names it, its loop and the gap), the
            velocities given violate the constraints, or positions or rates of joints cannot be reached or do not
            determine the others in their loop.
        """
        span = check_span(t_span)
        name = self.name if name is None else check_text("name", name)
        if isinstance(keep, (str, Body)):
            keep = (keep,)
        if not isinstance(keep, (tuple, list)):
            raise TypeError(f"keep must be a list of bodies, or of their names; given {shown(keep)}")
        kept = tuple(j for each in keep for j in self._moving_body("keep", each).coordinates)
        given = tuple(self._given(*each) for each in (("positions", positions), ("rates", rates)))
        with SignalHandlers():  # functions are traced, which catches exceptions, also those of signal handlers
            return self.assemble(span, name, kept, None, None, *given)

    def _given(self, what: str, given: Any) -> Given:
        """Check the given positions or rates of joints; return them as tuples."""
        if given is None:
            return ()
        if not isinstance(given, Mapping):
            raise TypeError(f"{what} must be a mapping from joints, or their names, to numbers; given {shown(given)}")
        values: dict[tuple[str, str], float] = {}
        for key, value in given.items():
            pair = key if isinstance(key, tuple) and len(key) == 2 else (key, None)
            joint, which = self._which(pair[0], pair[1], what)
            if (joint.name, which) in values:
                raise ValueError(f"{what} must have each joint once; given {joint.name!r} twice")
            values[joint.name, which] = number = check_finite(f"{what}[{joint.name!r}]", value)
            uncounted = self.dimension == 3 and what == "positions" and (joint.kind, which) in UNCOUNTED
            if uncounted and abs(number) > MOST_TURNED:
                raise ValueError(
                    f"positions[{joint.name!r}] must be within 0.95 of a turn, {MOST_TURNED:.6g} rad, as coordinates "
                    f"in space do not count turns; given {number!r}"
                )
        return tuple((*key, value) for key, value in values.items())

    def _request(self, given: Given, coordinates: Sequence[JointCoordinate]) -> Request:
        """Return the Request with the given coordinates and their values, and the coordinates that are not given."""
        values = {key[:2]: key[2] for key in given}
        chosen = [each for each in coordinates if (each.joint, each.which) in values]
        held = {(each.joint, each.which) for each in chosen}
        for joint in self.joints:
            if joint.kind == "screw":  # the angle or the displacement is enough
                held |= {(joint.name, "displacement")}
                held |= {(joint.name, "angle")} if (joint.name, "displacement") in values else set()
        others = [each for each in coordinates if (each.joint, each.which) not in held]
        joints = tuple(each for each in self.joints if each.kind != "drive")
        targets = np.array([values[each.joint, each.which] for each in chosen])
        turning = np.tile(np.arange(len(self.coordinate_names)) >= self.dimension, len(self.bodies))
        return Request(self.name, tuple(chosen), targets, tuple(others), joints, turning)

    def _driven(self, t: float, q: Array, placed: Given) -> Iterator[tuple[str, str, float]]:
        """Yield the coordinates of joints with a drive, and the drive's value at t, unless they are in `placed`."""
        joints = {id(joint.point_b): joint for joint in self.joints if joint.kind in KINDS}
        for drive in self.joints:
            joint, row = joints.get(id(drive.point_b)), drive.rows[0]
            if drive.kind != "drive" or joint is None or row.motion is None:
                continue
            which = "displacement" if row.kind == ALONG else "angle"
            value = float(row.motion.at(t, q, q)[0])
            if self.dimension == 3 and (joint.kind, which) in UNCOUNTED:
                value = float(np.remainder(value + np.pi, 2.0 * np.pi) - np.pi)
            if (joint.name, which) not in {each[:2] for each in placed}:
                yield joint.name, which, value

    def assemble(
        self,
        t_span: tuple[float, float],
        name: str,
        keep: tuple[int, ...],
        values: Mapping[str, float] | None,
        guess: Array | None,
        placed: Given = (),
        moving: Given = (),
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
        start_state = t_span[0], start, np.zeros_like(start)
        system = system_of(self.dimension, tables, joints_of(tables), name, start_state)
        coordinates = tuple(f"{each} of {body.name}" for body in self.bodies for each in self.coordinate_names)
        driveless, joints = tables, [joint for joint in self.joints if joint.kind != "drive"]
        if len(joints) < len(self.joints):
            driveless = self._tables(joints, values)
        still = system
        if driveless is not tables:
            still = system_of(self.dimension, driveless, joints_of(driveless), name, start_state)
        measured = tuple(
            self.coordinate_of(joint, which, tables.of) for joint in self.joints for which in KINDS.get(joint.kind, ())
        )
        at = {(each.joint, each.which): each for each in measured}
        wanted = {at[joint, which]: value for joint, which, value in placed}
        bounds = self._bounds(at, start)
        tree = SpanningTree(
            joints,
            len(self.bodies),
            self.dimension,
            driveless.of,
            self._zero,
            {j // len(self.coordinate_names) for j in keep},
            {each.joint for each in (*bounds, *wanted)},
        )
        closed = q = loop_closure.positions(still, t_span[0], start, tree, driveless.rows, bounds, wanted)
        if driveless is not tables:
            with suppress(ValueError):  # e.g. a drive beyond the reach of a loop: said by `follow_drives`
                driven = self._request((*placed, *self._driven(t_span[0], q, placed)), measured)
                q = joint_state.positions(still, t_span[0], q, driven, tree, keep) if driven.given else q
            q = assembly.follow_drives(system, t_span[0], q, keep)
        if placed:
            q = joint_state.positions(system, t_span[0], q, self._request(placed, measured), tree, keep)
        self._check_branches(t_span[0], q)
        given, is_given = self._velocities(q)
        if moving:
            request = self._request(moving, measured)
            v = joint_state.velocities(system, t_span[0], q, request, given, is_given, lambda j: coordinates[j])
        else:
            v = assembly.velocities(system, t_span[0], q, given, is_given, coordinates)
        check_forces(tables, t_span[0], q, v)
        freedom = assembly.freedom(system, t_span[0], q, tables.rows)
        check_loads(tables, freedom.redundant, system.force(t_span[0], q, v))
        return ModelProblem(
            name=name,
            system=system,
            q0=q,
            v0=v,
            t_span=t_span,
            energy=ModelEnergy(tables.p.copy(), self.dimension, tables.potentials),
            parameters=tables.values,
            note=note_of(self, tables, freedom, closed if guess is not None else start, closed, q, coordinates),
            conserved=tables.conserve and not self.dry,
            tags=self._tags(freedom),
            coordinates=coordinates,
            drawing=drawing_of(tables),
            model=self._copy(),
            keep=keep,
            given=(placed, moving),
            freedom=freedom,
            stops=tuple(self.stops),
            joint_coordinates=measured,
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
        """Return the system with given dry friction forces and sticking joints, and the rows of the sticking joints.

        Keys of `friction` and `held`: names of dry frictions. Values: their forces, and the displacements of b on a at
        which joints stick. NaN: the displacement equals t, so that the row's residual at t = 0 is the displacement.
        """
        copied = self._copy()
        for rub in self.dry:
            if rub.name in friction:
                number = Numbers((friction[rub.name],))
                copied.forces[self.forces.index(rub.force)] = replace(rub.force, more=number)
            if rub.name in held:
                at, joint = held[rub.name], rub.joint
                motion = motion_function(rub.name, (lambda t: t) if np.isnan(at) else lambda t, at=at: at, None, None)
                points = joint.point_a, joint.point_b
                row = self._drive_row(joint, motion)
                copied.joints.append(ModelJoint(f"{rub.name} sticks", "drive", joint.a, joint.b, (row,), *points))
        tables = copied._tables(copied.joints, values)
        system = system_of(self.dimension, tables, joints_of(tables), name, (t, q, np.zeros_like(q)))
        return system, {name: tables.rows[f"{name} sticks"] for name in held}

    def pull(self, rub: DryFriction, values: Mapping[str, float]) -> ConstrainedSystem:
        """Return a system whose only force is unit friction in the joint: the gradient of the joint's displacement."""
        copied = self._copy()
        copied.gravity, copied.forces = np.zeros(self.dimension), [replace(rub.force, more=Numbers((1.0,)))]
        places = {name: value for name, value in values.items() if not name.startswith("gravity")}
        tables, rest = copied._tables([], places), np.zeros_like(self._start())
        return system_of(self.dimension, tables, [], rub.name, (0.0, self._start(), rest))

    def _tables(self, joints: Sequence[ModelJoint], values: Mapping[str, float] | None) -> Tables:
        """Return the tables of the model restricted to some joints, with other parameter values."""
        first_row = len(self.bodies) if self.dimension == 3 else 0  # in space, rows e.e = 1 of the bodies come first
        tables = Tables(self.gravity, self.bodies, joints, self.forces, first_row)
        tables.replaced(values or {})
        return tables

    def _bounds(
        self, at: Mapping[tuple[str, str], JointCoordinate], q: Array
    ) -> dict[JointCoordinate, tuple[float, float]]:
        """Return the limits of the coordinates of joints."""
        bounds: dict[JointCoordinate, tuple[float, float]] = {}
        for key, sign, stop in self.limits:
            coordinate = at[key]
            low, high = bounds.get(coordinate, (-np.inf, np.inf))
            limit = float(coordinate.position(q)) - sign * float(stop.gap(0.0, q))
            bounds[coordinate] = (max(low, limit), high) if sign > 0.0 else (low, min(high, limit))
        return bounds

    def _copy(self) -> Model:
        """Return a copy that later additions to the model do not change."""
        copied = copy.copy(self)
        copied.bodies, copied.joints, copied.forces = list(self.bodies), list(self.joints), list(self.forces)
        copied.stops, copied.dry, copied.taken = list(self.stops), list(self.dry), list(self.taken)
        copied.limits = list(self.limits)
        return copied

    def _check_inertias(self, tables: Tables) -> None:
        for body in self.bodies:
            place = tables.places[f"mass of {body.name} (kg)"]
            if not body.inertia.any() and not tables.p[place : place + len(body.inertia)].any():
                continue  # a massless body of a file, whose joints determine its motion
            check_positive(f"mass of {body.name}", float(tables.p[place]))
            self._check_moments(body.name, tables.p[place + 1 : place + len(body.inertia)])

    def _check_moments(self, name: str, moments: Array) -> None:
        raise NotImplementedError

    def _check_branches(self, t: float, q: Array) -> None:
        """Raise if a drive starts half a turn away from its value, or a gear at another tooth."""

    def _velocities(self, q: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return velocities (n_q,), and a mask of the velocities that are given."""
        given = np.full((len(self.bodies), len(self.coordinate_names)), np.nan)
        for row, body, state in zip(given, self.bodies, q.reshape(given.shape), strict=True):
            if body.velocity is not None:
                row[: self.dimension] = body.velocity
            if body.angular_velocity is not None:
                spin = body.angular_velocity
                row[self.dimension :] = spin if self.dimension == 2 else euler_rates(state[3:], spin)
        is_given = np.isfinite(given.ravel())
        return np.where(is_given, given.ravel(), 0.0), is_given

    def _tags(self, freedom: assembly.Freedom) -> tuple[str, ...]:
        closed = False
        linked = {body.number: {body.number} for body in (self.ground, *self.bodies)}
        for joint in self.joints:
            if joint.kind != "drive":
                group_a, group_b = linked[joint.a.number], linked[joint.b.number]
                closed |= group_a is group_b
                group_a |= group_b
                linked |= dict.fromkeys(group_b, group_a)
        tags = {
            "closed chain" if closed else "open chain": True,
            "rigid": True,
            "planar" if self.dimension == 2 else "spatial": True,
            "driven": any(joint.kind == "drive" for joint in self.joints),
            "redundant": bool(freedom.redundant),
            "singular": freedom.singular > 0,
        }
        return tuple(tag for tag, holds in tags.items() if holds)

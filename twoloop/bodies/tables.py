"""Write the parameter vector of a model, see `parameter_layout`: numbers, tables of joints and forces, programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from twoloop.bodies.functions import is_constant, program_for
from twoloop.bodies.parameter_layout import (
    AXIAL_FORCE,
    AXIAL_FRICTION,
    AXIAL_SPRING,
    AXIAL_TORQUE,
    HINGE_FRICTION,
    HINGE_ROTOR,
    NONE,
    RATE_FUNCTION,
    SLIDE_ROTOR,
    SPRING,
    TORQUE,
    TORSION_SPRING,
    ZERO_LENGTH_SPRING,
)
from twoloop.bodies.parts import Body, Force, JointRow, ModelJoint, Numbers
from twoloop.checks.arguments import Array, check_not_negative, check_positive
from twoloop.generate.graph import Untraceable

GRAVITY = ("x", "y", "z")
MOMENTS = {2: ("moment of inertia",), 3: tuple(f"J_{which}" for which in ("xx", "yy", "zz", "xy", "xz", "yz"))}

TENSOR = [0, 3, 4, 3, 1, 5, 4, 5, 2]  # indices of the entries of the inertia tensor in MOMENTS


class Tables:
    """Collect all numbers of a model in one vector.

    Attributes
    ----------
    p : ndarray
    places : dict
        Indices of the named numbers in p, from 0 on.
    rows : dict
        Row numbers of C of each joint, by its name.
    motions, functions : list of Function
        Drives and forces given as functions, in the order of their results.
    loaded : list of Force
        Frictions proportional to the load of a joint. Unit motors in these joints follow the forces.
    untraced : str
        Why the functions are not stored in p as programs; "" if they are stored, or if there are no functions.
    """

    def __init__(
        self,
        gravity: Array,
        bodies: Sequence[Body],
        joints: Sequence[ModelJoint],
        forces: Sequence[Force],
        first_row: int,
    ):
        self.gravity, self.bodies, self.joints, self.forces = gravity, bodies, joints, forces
        self.loaded = [
            each
            for each in forces
            if each.kind in (HINGE_FRICTION, AXIAL_FRICTION) and each.more and len(each.more.values) > 2
        ]
        self.places: dict[str, int] = {}
        self._values: list[float] = []
        self._constants: list[float] = []
        self._known: dict[int, int] = {}
        self._keep: list[Numbers] = []  # keeps the objects alive, so that the ids in `_known` stay valid
        dimension = len(gravity)
        self._place(Numbers(tuple(gravity), tuple(f"gravity along {axis} (m/s^2)" for axis in GRAVITY[:dimension])))
        for body in bodies:
            names = ("mass (kg)", *(f"{moment} (kg m^2)" for moment in MOMENTS[dimension]))
            self._place(Numbers(tuple(body.inertia), tuple(_of(name, body.name) for name in names)))
        rows = [row for joint in joints for row in joint.rows]
        for row in rows:
            self._place_all(row.on_first, row.on_second, row.more)
        for joint in joints:
            self._place_all(joint.point_a, joint.point_b)
        for force in forces:
            self._place_all(force.on_first, force.on_second, force.more)
        self._unit = Numbers((1.0,))
        self._place_all(self._unit if self.loaded else None)
        self._n_named = len(self._values)
        self.motions = [row.motion for row in rows if row.motion is not None]
        self.functions = [force.function for force in forces if force.function is not None]
        self.rows: dict[str, tuple[int, ...]] = {}
        self._write(dimension, first_row)

    @property
    def values(self) -> dict[str, float]:
        """Return the named numbers."""
        return {name: float(self.p[place]) for name, place in self.places.items()}

    def of(self, numbers: Numbers) -> Array:
        """Return the present values of `numbers` from p."""
        place = self._at(numbers)
        return self.p[place : place + len(numbers.values)]

    @property
    def conserve(self) -> bool:
        """Return True if the model conserves energy: no damper, force, torque, motor, or moving drive."""
        for force in self.forces:
            numbers = np.zeros(0) if force.more is None else self.of(force.more)
            if force.kind in (SPRING, TORSION_SPRING, AXIAL_SPRING):
                numbers = numbers[1:2]  # only the damping counts
            elif force.kind in (HINGE_FRICTION, AXIAL_FRICTION):
                numbers = numbers[[0, *range(2, len(numbers))]]
            if force.kind in (ZERO_LENGTH_SPRING, HINGE_ROTOR, SLIDE_ROTOR):
                continue
            if force.function is not None or numbers.any():
                return False
        return all(is_constant(motion) for motion in self.motions)

    @property
    def potentials(self) -> tuple[Callable[[Any], Any], ...]:
        """Return the potential energies of forces that are functions with a method `potential`."""
        known = (getattr(each.function, "potential", None) for each in self.functions)
        return tuple(each for each in known if each is not None)

    def check(self) -> None:
        """Raise if a number has a wrong sign."""
        parts: list[Force | JointRow] = [*self.forces, *(row for joint in self.joints for row in joint.rows)]
        for part in parts:
            rubs = isinstance(part, Force) and part.kind in (HINGE_FRICTION, AXIAL_FRICTION)
            rail = isinstance(part, Force) and part.kind == AXIAL_SPRING
            numbers = part.more or Numbers(())
            for name, value in zip(numbers.names, self.of(numbers).tolist() if numbers.names else (), strict=True):
                what = name.split(" of ")[0]
                if what == "speed" or (what == "length" and not rail):
                    check_positive(name, value)
                elif what in ("stiffness", "damping", "inertia") or rubs:
                    check_not_negative(name, value)

    def replaced(self, values: Mapping[str, float]) -> None:
        """Replace values of named numbers."""
        for name, value in values.items():
            if name in self.places:
                self.p[self.places[name]] = value

    def place(self, force: Force) -> int:
        """Return the index in p of the numbers of a force."""
        return self._at(force.more)

    def _place_all(self, *parts: Numbers | None) -> None:
        for numbers in parts:
            if numbers is not None and id(numbers) not in self._known:
                self._place(numbers)

    def _place(self, numbers: Numbers) -> None:
        self._keep.append(numbers)
        if not numbers.names:
            self._known[id(numbers)] = NONE - 1 - len(self._constants)  # provisional index, counted down from NONE
            self._constants += numbers.values
            return
        self._known[id(numbers)] = len(self._values)
        for name, value in zip(numbers.names, numbers.values, strict=True):
            while name in self.places:  # combinations of names of bodies and joints may coincide
                name = f"other {name}"
            self.places[name] = len(self._values)
            self._values.append(value)

    def _at(self, numbers: Numbers | None) -> int:
        if numbers is None:
            return NONE
        place = self._known[id(numbers)]
        return place if place >= 0 else self._n_named + NONE - 1 - place

    def _write(self, dimension: int, first_row: int) -> None:
        n_q = (3 if dimension == 2 else 7) * len(self.bodies)
        table: list[float] = []
        row, motion, result, self.n_rates = first_row, 0, 0, 0
        for joint in self.joints:
            numbered: list[int] = []
            for part in joint.rows:
                of_rates = part.kind == RATE_FUNCTION
                number = self.n_rates if of_rates else row
                table += self._joint_row(part, number, NONE if part.motion is None else motion)
                motion += 0 if part.motion is None else part.motion.n_results
                numbered += [NONE - number] if of_rates else range(row, row + part.n_rows)
                self.n_rates += of_rates
                row += 0 if of_rates else part.n_rows
            self.rows[joint.name] = tuple(numbered)
        for name, rows in self.rows.items():  # rows of A come after all rows of C
            self.rows[name] = tuple(row + NONE - each if each < 0 else each for each in rows)
        n_before = len(self._values) + len(self._constants)
        forces = n_before + len(table)
        for force in self.forces:
            first, second, function = force.first.number, force.second.number, force.function
            table += (force.kind, first, self._at(force.on_first), second, self._at(force.on_second))
            table += (self._at(force.more), NONE if function is None else result, self._at(force.point_on_first))
            result += 0 if function is None else function.size
        for force in self.loaded:
            turns = TORQUE if len(self.gravity) == 2 else AXIAL_TORQUE
            table += (
                turns if force.kind == HINGE_FRICTION else AXIAL_FORCE,
                force.first.number,
                self._at(force.on_first),
            )
            table += (force.second.number, self._at(force.on_second), self._at(self._unit), NONE, NONE)
        self.n_rows, self.untraced = row, ""
        programs: list[list[float]] = []
        for functions, motions in ((self.motions, True), (self.functions, False)):
            try:
                programs.append(program_for(functions, n_q, motions).as_floats() if functions else [])
            except Untraceable as error:
                self.untraced = str(error)
                programs.append([])
        begin = n_before + len(table)
        places = [begin if programs[0] else NONE, begin + len(programs[0]) if programs[1] else NONE]
        n_joint_rows = sum(len(joint.rows) for joint in self.joints)
        head = [len(self.bodies), n_before, n_joint_rows, forces, len(self.forces), *places, 3 if dimension == 2 else 7]
        parts = (self._values, self._constants, table, *programs, head)
        self.p = np.concatenate([np.asarray(part, dtype=float) for part in parts])

    def _joint_row(self, row: JointRow, number: int, motion: int) -> tuple[float, ...]:
        first, second = row.first.number, row.second.number
        return (
            *(row.kind, number, first, self._at(row.on_first), second, self._at(row.on_second)),
            *(self._at(row.more), motion),
        )


def _of(quantity: str, name: str) -> str:
    """Return e.g. "mass of crank (kg)" for "mass (kg)" and "crank"."""
    head, unit = quantity.split(" (")
    return f"{head} of {name} ({unit}"

"""Describe the parts of a model: bodies, points on them, joints, forces, and their numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twoloop.bodies.functions import Function, RowFunction
from twoloop.bodies.parameter_layout import NONE
from twoloop.checks.arguments import Array, check_vector

ROUNDING = 4.0 * np.finfo(np.float64).eps  # largest relative value that counts as a rounding error
COINCIDE = 1e-12  # relative distance at which two points count as coincident


@dataclass(frozen=True, eq=False)
class BodyPoint:
    """A point in the axes of a body, relative to its centre of mass, m; made by `body.point(...)`."""

    body: Body
    place: Array


@dataclass(frozen=True, eq=False)
class BodyDirection:
    """A direction in the axes of a body; made by `body.direction(...)`."""

    body: Body
    components: Array


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body of a model, or its ground; made by `model.body(...)`.

    Attributes
    ----------
    name : str
    number : int
        Index in the order of addition, from 0; -1 for the ground.
    coordinates : tuple of int
        Indices of the body in `q` and `v`: x, y and the angle, or x, y, z and four Euler parameters.

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> bob.name, bob.coordinates
    ('bob', (0, 1, 2))
    """

    name: str
    number: int
    position: Array = field(repr=False)
    rotation: Any = field(repr=False)  # an angle, or a matrix (3, 3)
    inertia: Array = field(repr=False)  # mass and moments, in the order of the parameters
    velocity: Array | None = field(default=None, repr=False)
    angular_velocity: Array | None = field(default=None, repr=False)
    is_particle: bool = field(default=False, repr=False)  # a point mass, which does not turn

    @property
    def coordinates(self) -> tuple[int, ...]:
        """Return the indices of the body in q and v."""
        width = 3 if len(self.position) == 2 else 7
        return () if self.number == NONE else tuple(range(width * self.number, width * (self.number + 1)))

    def point(self, *place: float) -> BodyPoint:
        """Return a point on the body, by its coordinates in body axes from the centre of mass (ground: in space)."""
        return BodyPoint(self, check_vector(f"point on {self.name!r}", place, len(self.position)))

    def direction(self, *components: float) -> BodyDirection:
        """Return a direction by its components in the axes of the body."""
        return BodyDirection(self, check_vector(f"direction on {self.name!r}", components, len(self.position)))

    def local_direction(self, given: Array) -> Array:
        """Transform a direction from space to the axes of the body, in the position given."""
        if len(given) == 2:
            s, c = np.sin(self.rotation), np.cos(self.rotation)
            return np.array([c * given[0] + s * given[1], c * given[1] - s * given[0]])
        return _without_rounding(self.rotation.T @ given, float(np.abs(given).max()))

    def local_point(self, given: Array) -> Array:
        """Transform a point from space to the axes of the body, relative to its centre, in the position given."""
        place = self.local_direction(given - self.position)
        return place if len(given) == 2 else _without_rounding(place, np.abs((*given, *self.position)).max())

    def in_space(self, place: Array) -> Array:
        """Transform a point of the body to space, in the position given."""
        if len(place) == 2:
            s, c = np.sin(self.rotation), np.cos(self.rotation)
            return self.position + np.array([c * place[0] - s * place[1], s * place[0] + c * place[1]])
        return np.asarray(self.position + self.rotation @ place)


def _without_rounding(components: Array, size: float) -> Array:
    """Set components to zero if they are rounding errors of numbers of this size: equations become shorter."""
    return np.where(np.abs(components) > ROUNDING * size, components, 0.0)


@dataclass(frozen=True, eq=False)
class Numbers:
    """Consecutive entries of the parameter vector; without names, they are not parameters of the model."""

    values: tuple[float, ...]
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class JointRow:
    """Constraint rows: one row of the table of joints, see `parameter_layout`."""

    kind: int
    n_rows: int
    first: Body
    second: Body
    on_first: Numbers | None = None
    on_second: Numbers | None = None
    more: Numbers | None = None
    motion: Function | RowFunction | None = None


@dataclass(frozen=True, eq=False)
class ModelJoint:
    """A joint or drive of a model; made by the methods of the model.

    Attributes
    ----------
    name : str
        Name in `Result.reactions`.
    kind : str
    a, b : Body

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> pin = model.revolute("ground", bob, at=(0.0, 0.0), name="pin")
    >>> pin.kind, pin.b.name
    ('revolute', 'bob')
    """

    name: str
    kind: str
    a: Body
    b: Body
    rows: tuple[JointRow, ...] = field(repr=False)
    point_a: Numbers = field(repr=False)  # in body axes
    point_b: Numbers = field(repr=False)
    axes: tuple[Array, ...] = field(default=(), repr=False)  # spatial joints: the axis in the axes of a and of b
    pitch: float = field(default=0.0, repr=False)  # for a screw: displacement per turn, m
    path: tuple[tuple[Body, Numbers], ...] = field(default=(), repr=False)  # for a rope: its points, in order

    @property
    def body(self) -> Body:
        """Return the body on which the reaction is reported: `a`, or `b` if `a` is the ground."""
        return self.b if self.a.number == NONE else self.a


@dataclass(frozen=True, eq=False)
class Force:
    """A force, torque or spring of a model: one row of the table of forces, see `parameter_layout`.

    Attributes
    ----------
    name : str

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> spring = model.spring("ground", (1.0, 1.0), bob, (0.0, 0.0), stiffness=100.0, length=1.0, name="spring")
    >>> spring.name
    'spring'
    """

    name: str
    kind: int
    first: Body = field(repr=False)
    second: Body = field(repr=False)
    on_first: Numbers | None = field(default=None, repr=False)
    on_second: Numbers | None = field(default=None, repr=False)
    more: Numbers | None = field(default=None, repr=False)
    function: Function | None = field(default=None, repr=False)
    point_on_first: Numbers | None = field(default=None, repr=False)
    joint: ModelJoint | None = field(default=None, repr=False)  # the joint on which it acts


@dataclass(frozen=True, eq=False)
class DryFriction:
    """Coulomb friction in a joint; made by `model.dry_friction(...)`.

    Attributes
    ----------
    name : str
    joint : ModelJoint
    kinetic, static : float
        Kinetic friction and largest static friction, N m or N.

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> pin = model.revolute("ground", bob, at=(0.0, 0.0), name="pin")
    >>> friction = model.dry_friction(pin, 0.2, static=0.3)
    >>> friction.kinetic, friction.static
    (0.2, 0.3)
    """

    name: str
    joint: ModelJoint = field(repr=False)
    kinetic: float
    static: float
    force: Force = field(repr=False)  # on b in the direction of the joint; nonzero only within a mode

"""What a model is made of: bodies, points on them, joints, forces, and the numbers that these have."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twoloop.bodies.functions import Function
from twoloop.bodies.parameter_layout import NONE
from twoloop.bodies.row_function import RowFunction
from twoloop.checks.arguments import Array, check_vector


@dataclass(frozen=True, eq=False)
class BodyPoint:
    """A point in the axes of a body, from its centre of mass, m; `body.point(...)` makes it."""

    body: Body
    place: Array


@dataclass(frozen=True, eq=False)
class BodyDirection:
    """A direction in the axes of a body; `body.direction(...)` makes it."""

    body: Body
    components: Array


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body of a model, or its ground; `model.body(...)` makes it.

    Attributes
    ----------
    name : str
    number : int
        From 0 in the order in which bodies were added; -1 is the ground.
    coordinates : tuple of int
        Which of `q` and `v` are the body's: x, y and the angle, or x, y, z and four Euler parameters.
    """

    name: str
    number: int
    position: Array = field(repr=False)
    rotation: Any = field(repr=False)  # an angle, or a matrix (3, 3)
    inertia: Array = field(repr=False)  # mass and moments, as they stand in the parameters
    velocity: Array | None = field(default=None, repr=False)
    angular_velocity: Array | None = field(default=None, repr=False)

    @property
    def coordinates(self) -> tuple[int, ...]:
        """Which of q and v are the body's."""
        width = 3 if len(self.position) == 2 else 7
        return () if self.number == NONE else tuple(range(width * self.number, width * (self.number + 1)))

    def point(self, *place: float) -> BodyPoint:
        """A point by its coordinates in the axes of the body, from the centre of mass; on the ground, in space."""
        return BodyPoint(self, check_vector(f"point on {self.name!r}", place, len(self.position)))

    def direction(self, *components: float) -> BodyDirection:
        """A direction by its components in the axes of the body."""
        return BodyDirection(self, check_vector(f"direction on {self.name!r}", components, len(self.position)))

    def local_direction(self, given: Array) -> Array:
        """A direction of space, in the axes that the body has in the position given."""
        if len(given) == 2:
            s, c = np.sin(self.rotation), np.cos(self.rotation)
            return np.array([c * given[0] + s * given[1], c * given[1] - s * given[0]])
        return np.asarray(self.rotation.T @ given)

    def local_point(self, given: Array) -> Array:
        """A point of space in the axes of the body, from its centre, in the position given."""
        return self.local_direction(given - self.position)

    def in_space(self, place: Array) -> Array:
        """A point of the body in space, in the position given."""
        if len(place) == 2:
            s, c = np.sin(self.rotation), np.cos(self.rotation)
            return self.position + np.array([c * place[0] - s * place[1], s * place[0] + c * place[1]])
        return np.asarray(self.position + self.rotation @ place)


@dataclass(frozen=True, eq=False)
class Numbers:
    """Numbers that stand together in the parameters; those without names are no parameters of the model."""

    values: tuple[float, ...]
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class JointRow:
    """Rows of the constraints: a row of the table of joints, see `parameter_layout`."""

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
    """A joint of a model, or a drive of one; its methods make it.

    Attributes
    ----------
    name : str
        By which `Result.reactions` knows it.
    kind : str
    a, b : Body
    """

    name: str
    kind: str
    a: Body
    b: Body
    rows: tuple[JointRow, ...] = field(repr=False)
    point_a: Numbers = field(repr=False)  # in the axes of the body
    point_b: Numbers = field(repr=False)
    axes: tuple[Array, ...] = field(default=(), repr=False)  # in space: the axis in those of a and in those of b

    @property
    def body(self) -> Body:
        """The body on which the joint is said to act: `a`, or `b` where that is the ground."""
        return self.b if self.a.number == NONE else self.a


@dataclass(frozen=True, eq=False)
class Force:
    """A force, a torque or a spring of a model: a row of the table of forces, see `parameter_layout`.

    Attributes
    ----------
    name : str
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
    joint: ModelJoint | None = field(default=None, repr=False)  # in which it is


@dataclass(frozen=True, eq=False)
class DryFriction:
    """Coulomb's friction in a joint; `model.dry_friction(...)` makes it.

    Attributes
    ----------
    name : str
    joint : ModelJoint
    kinetic, static : float
        N m or N: while b slides on a, and the most that holds it.
    """

    name: str
    joint: ModelJoint = field(repr=False)
    kinetic: float
    static: float
    force: Force = field(repr=False)  # on b in the direction of the joint; zero but in a mode

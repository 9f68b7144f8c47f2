"""Measure joints: the angle or displacement of a joint since the position given, and its rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from twoloop.bodies.collection import Collection
from twoloop.bodies.frames import angle_of, point_of, vector_of
from twoloop.bodies.parts import ModelJoint, Numbers
from twoloop.bodies.rotation import Components, euler_parameters, euler_product, parameters_of, rate_of_vector, spin_of
from twoloop.checks.arguments import Array, shown

TURN = 2.0 * np.pi
# cosine of half the largest angle in space that a single state gives, 0.95 of a turn, as of a torsion spring: Euler
# parameters repeat after two turns, so that an angle jumps by two turns at one turn to either side
FARTHEST = -float(np.cos(0.95 * np.pi))
AMBIGUOUS = 0.5 * np.pi  # rad: farther from its prediction, an angle between two stored times is not counted
KINDS = {
    "revolute": ("angle",),
    "prismatic": ("displacement",),
    "cylindrical": ("angle", "displacement"),
    "screw": ("angle", "displacement"),
}  # the coordinates of each kind of joint
UNITS = {"angle": "rad", "displacement": "m"}


@dataclass(frozen=True)
class JointCoordinate:
    """Measure the angle or displacement of b on a in a joint since the position given, and its rate.

    Made by `problem.joint_coordinate(...)`, and before there is a problem by `model.joint_coordinate(...)`.

    Attributes
    ----------
    joint : str
        Name of the joint.
    which : str
        "angle" or "displacement".

    Notes
    -----
    The coordinates of a planar body count turns. Those of a body in space do not: there, the angle of a single state is
    right within 0.95 of a turn from the position given, NaN about a whole turn, and repeats after two turns. Along many
    states, turns are counted from one state to the next. A screw takes its angle from its displacement, without limits.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.bodies import SpatialModel
    >>> model = SpatialModel(name="pendulum")
    >>> rod = model.rod("rod", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0.02, mass=1.0)
    >>> pin = model.revolute("ground", rod, at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0), name="pin")
    >>> problem = model.problem((0.0, 2.0), positions={pin: 0.5}, rates={pin: 9.0})
    >>> angle = problem.joint_coordinate("pin")
    >>> round(angle.position(problem.q0), 12), round(angle.rate(problem.q0, problem.v0), 12)
    (0.5, 9.0)
    >>> run = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0)
    >>> bool(angle.position(run.q)[-1] > 12.0)  # two turns
    True
    """

    joint: str
    which: str
    a: int
    b: int

    @property
    def name(self) -> str:
        """Return the name, such as "angle of hinge"."""
        return f"{self.which} of {self.joint}"

    @property
    def unit(self) -> str:
        """Return "rad" or "m"."""
        return UNITS[self.which]

    def position(self, q: Any) -> Any:
        """Return the angle, rad, or the displacement, m.

        Parameters
        ----------
        q : array_like (n_q,) or (n_q, n_t)
            Coordinates of one state, or of many in the order of time, between which a hinge in space moves by less
            than a turn (`history` has no such limit). Also symbols: call it in forces that are functions.

        Returns
        -------
        float or ndarray (n_t,)
        """
        raise NotImplementedError

    def rate(self, q: Any, v: Any) -> Any:
        """Return the rate of the position, rad/s or m/s; see `position`."""
        raise NotImplementedError

    def history(self, result: Any) -> Array:
        """Return the positions along a run, (n_t,), with turns counted by the rates.

        Parameters
        ----------
        result : Result

        Returns
        -------
        ndarray (n_t,)
            NaN from where the stored times are too far apart to count turns.
        """
        return np.asarray(self.position(result.q))


@dataclass(frozen=True)
class PlanarAngle(JointCoordinate):
    """Measure the angle of a hinge in the plane."""

    zero: float

    def position(self, q: Any) -> Any:
        """Return the angle."""
        return angle_of(q, self.b) - angle_of(q, self.a) - self.zero

    def rate(self, q: Any, v: Any) -> Any:
        """Return its rate."""
        return angle_of(v, self.b) - angle_of(v, self.a)


@dataclass(frozen=True)
class SpatialAngle(JointCoordinate):
    """Measure the angle of a hinge in space about its axis in a, from the relative Euler parameters at the zero."""

    axis: tuple[float, ...]
    zero: tuple[float, ...]

    def half(self, q: Any) -> tuple[Any, Any]:
        """Return multiples of cosine and sine of half the angle."""
        conjugate = (self.zero[0], *(-x for x in self.zero[1:]))
        relative = euler_product(parameters_of(q, self.a, -1.0), parameters_of(q, self.b))
        c, *e = euler_product(relative, conjugate)
        return c, sum(n * x for n, x in zip(self.axis, e, strict=True))

    def position(self, q: Any) -> Any:
        """Return the angle."""
        c, s = self.half(q)
        if getattr(q, "ndim", 1) == 2:
            return np.unwrap(2.0 * np.arctan2(s, c), period=2.0 * TURN)
        size = np.sqrt(c * c + s * s)
        left = c + FARTHEST * size
        with np.errstate(invalid="ignore"):
            root = np.sqrt(left)  # not a number where it is too far: the equations have no branches
            return root * root / left * (4.0 * np.arctan(s / (c + size)))

    def rate(self, q: Any, v: Any) -> Any:
        """Return its rate."""
        spins = zip(vector_of(q, self.a, self.axis), spin_of(q, v, self.b), spin_of(q, v, self.a), strict=True)
        return sum(n * (turn_b - turn_a) for n, turn_b, turn_a in spins)

    def history(self, result: Any) -> Array:
        """Return the angles along a run."""
        c, s = self.half(result.q)
        angle, rate, h = 2.0 * np.arctan2(s, c), self.rate(result.q, result.v), np.diff(result.t)
        bend = np.nan_to_num(
            self.rate(result.q, result.a)
        )  # the rate is linear in the velocities, with no further term along an axis
        moved = np.diff(angle)
        expected = 0.5 * h * (rate[1:] + rate[:-1]) + h * h / 12.0 * (bend[:-1] - bend[1:])
        moved += 2.0 * TURN * np.round((expected - moved) / (2.0 * TURN))
        moved[np.abs(moved - expected) > AMBIGUOUS] = np.nan
        return np.asarray(np.concatenate([angle[:1], angle[:1] + np.cumsum(moved)]))


@dataclass(frozen=True)
class Displacement(JointCoordinate):
    """Measure the displacement of a point of b from a point of a along an axis of a, or a multiple of it."""

    axis: tuple[float, ...]
    point_a: tuple[float, ...]
    point_b: tuple[float, ...]
    factor: float = 1.0  # of a screw: rad/m
    start: float = 0.0

    def _apart(self, q: Any) -> Components:
        ends = zip(point_of(q, self.a, self.point_a), point_of(q, self.b, self.point_b), strict=True)
        return [y - x for x, y in ends]

    def position(self, q: Any) -> Any:
        """Return the displacement, or the angle of a screw."""
        pairs = zip(vector_of(q, self.a, self.axis), self._apart(q), strict=True)
        return self.factor * (sum(n * x for n, x in pairs) - self.start)

    def rate(self, q: Any, v: Any) -> Any:
        """Return its rate."""
        apart, axis = self._apart(q), vector_of(q, self.a, self.axis)
        turning = rate_of_vector(q, v, self.a, self.axis)
        u = velocity_apart(q, v, self.a, self.point_a, self.b, self.point_b)
        parts = zip(axis, u, turning, apart, strict=True)
        return self.factor * sum(n * x + w * d for n, x, w, d in parts)


def velocity_apart(q: Any, v: Any, a: int, point_a: Any, b: int, point_b: Any) -> Components:
    """Return the velocity of a point of b minus that of a point of a."""
    ends = []
    for body, point in ((a, point_a), (b, point_b)):
        arm, first = rate_of_vector(q, v, body, point), (3 if len(point) == 2 else 7) * body
        ends.append([(0.0 if body < 0 else v[first + i]) + x for i, x in enumerate(arm)])
    return [y - x for x, y in zip(*ends, strict=True)]


class Coordinates(Collection):
    """Gives the coordinates of the joints of a model."""

    def joint_coordinate(self, joint: ModelJoint | str, which: str | None = None) -> JointCoordinate:
        """Return the angle or displacement of a joint, e.g. for forces that are functions.

        Parameters
        ----------
        joint : ModelJoint or str
            A revolute, prismatic, cylindrical or screw joint, or its name.
        which : str, optional
            "angle" or "displacement" of a cylindrical or screw joint. None: the only one, or the angle of a screw.

        Returns
        -------
        JointCoordinate
            With the points and axes that the model has now; for other parameters, see `ModelProblem.joint_coordinate`.

        Raises
        ------
        TypeError, ValueError
            If an argument is invalid.
        """
        measured, which = self._which(joint, which, "joint_coordinate")
        return self.coordinate_of(measured, which, lambda numbers: np.array(numbers.values))

    def _which(self, joint: Any, which: Any, what: str) -> tuple[ModelJoint, str]:
        """Return a joint of the model that has coordinates, and which of its coordinates is meant."""
        kinds = tuple(KINDS)[: 2 if self.dimension == 2 else None]
        measured = self._joint(joint, kinds, what)
        return measured, which_of(measured, which)

    def _as_single(self, joint: Any, which: Any, what: str) -> ModelJoint:
        """Return a joint as the revolute or prismatic joint of one of its coordinates."""
        moved, which = self._which(joint, which, what)
        kind = "revolute" if which == "angle" else "prismatic"
        return moved if moved.kind == kind else replace(moved, kind=kind)

    def coordinate_of(self, joint: ModelJoint, which: str, values: Callable[[Numbers], Array]) -> JointCoordinate:
        """Return a coordinate of a joint; `values` gives the parameters of the joint."""
        head = joint.name, which, joint.a.number, joint.b.number
        if which == "displacement" or joint.kind == "screw":
            point_a, point_b = (tuple(values(each).tolist()) for each in (joint.point_a, joint.point_b))
            moved = Displacement(*head, tuple(self._axis_of(joint, values).tolist()), point_a, point_b)
            if which == "displacement":
                return moved
            start = float(moved.position(self._start()))
            return Displacement(*head, moved.axis, point_a, point_b, TURN / joint.pitch, start)
        if self.dimension == 2:
            return PlanarAngle(*head, float(joint.b.rotation - joint.a.rotation))
        return self._hinge(joint)

    def _axis(self, joint: ModelJoint) -> Numbers | None:
        """Return the numbers of the axis of a joint in the axes of a; None for a hinge in the plane."""
        return joint.rows[0].more if self.dimension == 2 else Numbers(tuple(joint.axes[0]))

    def _axis_of(self, joint: ModelJoint, values: Callable[[Numbers], Array]) -> Array:
        """Return the axis of a joint that slides, in the axes of a."""
        if self.dimension == 3:
            return joint.axes[0]
        assert joint.rows[0].more is not None
        (angle,) = values(joint.rows[0].more)
        return np.array([np.cos(angle), np.sin(angle)])

    def _hinge(self, joint: ModelJoint) -> SpatialAngle:
        """Return the angle of a joint that turns in space."""
        head = joint.name, "angle", joint.a.number, joint.b.number
        return SpatialAngle(*head, tuple(joint.axes[0].tolist()), tuple(self._zero(joint).tolist()))

    def _zero(self, joint: ModelJoint) -> Array:
        """Return the relative Euler parameters of a hinge in space in the position given."""
        raise NotImplementedError

    def _start(self) -> Array:
        """Return the coordinates in the position given, (n_q,)."""
        turned = np.atleast_1d if self.dimension == 2 else euler_parameters
        return np.concatenate([[*body.position, *turned(body.rotation)] for body in self.bodies])


def which_of(joint: ModelJoint, which: Any) -> str:
    """Return which coordinate of a joint is meant: the one named, the only one, or the angle of a screw."""
    of_kind = KINDS[joint.kind]
    if which is None and (len(of_kind) == 1 or joint.kind == "screw"):
        return of_kind[0]
    if which is None:
        raise ValueError(
            f"{joint.name!r}, which is {joint.kind}, has an angle and a displacement: say which, in mappings and lists "
            f'as ({joint.name!r}, "angle")'
        )
    if which not in of_kind:
        expected = " or ".join(f'"{each}"' for each in of_kind)
        raise ValueError(
            f"{joint.name!r}, which is {joint.kind}, has the coordinate {expected}; given {shown(which)}: say which"
        )
    return str(which)

"""Data of a system besides its equations, for results: names of coordinates, energy, drawing, joints, stops."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import (
    Array,
    check_call,
    check_finite,
    check_flag,
    check_not_negative,
    check_real,
    check_size,
    check_text,
    check_vector,
    shaped,
)
from twoloop.problem.compiled_functions import GeneratedEnergy


@dataclass(frozen=True, eq=False)
class Drawing:
    """Draw a mechanism as a wireframe, which `Result.animate` moves.

    Parameters
    ----------
    points : callable
        points(q) gives the points, m: of shape (n_points, 2) in a plane or (n_points, 3) in space for q (n_q,), and
        with a further axis (n_points, 2 or 3, n_t) for q (n_q, n_t).
    bars : sequence of (int, int)
        Pairs of points that a line joins.
    traces : sequence of int
        Points whose paths are drawn.

    Raises
    ------
    TypeError, ValueError
        If `points` is not callable, or `bars` and `traces` are not made of indices. Whether the points exist is
        checked with a `Problem`, at its start.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop import Drawing
    >>> rod = Drawing(lambda q: [(0.0, 0.0), (q[0], q[1])], bars=((0, 1),), traces=(1,))
    >>> rod.at(np.array([0.6, -0.8])).shape
    (2, 2)
    """

    points: Callable[[Array], Any]
    bars: tuple[tuple[int, int], ...]
    traces: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not callable(self.points):
            raise TypeError(f"points must be a function of q that gives (n_points, 2 or 3); given {self.points!r}")
        check_call("points", "points", self.points, ("q",))
        try:
            bars = tuple((int(first), int(second)) for first, second in self.bars)
            traces = tuple(map(int, self.traces))
        except (TypeError, ValueError):
            raise TypeError(
                f"bars must be pairs of points and traces points, by their numbers: bars=[(0, 1)], traces=[1]; given "
                f"{self.bars!r} and {self.traces!r}"
            ) from None
        object.__setattr__(self, "bars", bars)
        object.__setattr__(self, "traces", traces)

    def at(self, q: Array) -> Array:
        """Return the points at q (n_q,) or (n_q, n_t).

        Raises
        ------
        ValueError
            If `points` gives another shape, or has not the points that `bars` and `traces` name.
        """
        points = np.asarray(self.points(q), dtype=float)
        if points.ndim != 1 + q.ndim or points.shape[1] not in (2, 3) or points.shape[2:] != q.shape[1:]:
            expected = "(n_points, 2 or 3)" if q.ndim == 1 else f"(n_points, 2 or 3, {q.shape[1]})"
            raise ValueError(
                f"points of a drawing must give an array of shape {expected} for q of shape {q.shape}; it gave one of "
                f"shape {points.shape}"
            )
        indices = [*self.traces, *(end for bar in self.bars for end in bar)]
        missing = [number for number in indices if not 0 <= number < len(points)]
        if missing:
            raise ValueError(
                f"bars and traces of a drawing must name points from 0 to {len(points) - 1}; they name {missing[0]}"
            )
        return points


@dataclass(frozen=True)
class Description:
    """Names, energy and drawing of a system, for its results; a `Problem` gives them to its system."""

    coordinates: tuple[str, ...] = ()  # names with units, such as "x of crank (m)"; empty: q0, q1, ...
    energy: Callable[[Any, Any, Any], Any] | None = None  # energy(t, q, v), J, of one state or of the columns of many
    conserved: bool | None = None  # whether the energy is an invariant; None: not known
    drawing: Drawing | None = None
    joint_coordinates: tuple[Any, ...] = ()  # angles and displacements of the joints of a model

    def with_parameters(self, p: NDArray[Any]) -> Description:
        """Return the description for other parameters; drop energy and drawing if they may enclose the old values."""
        if not isinstance(self.energy, GeneratedEnergy):
            return Description(self.coordinates)
        return Description(self.coordinates, replace(self.energy, parameters=tuple(p.tolist())), self.conserved)


_UNIT = re.compile(r"\s*\(([^()]*)\)")


def name_and_unit(coordinate: str) -> tuple[str, str]:
    """Split "x (m) of crank" into "x of crank" and "m"; the unit is "" where there is none, or "-"."""
    match = _UNIT.search(coordinate)
    if match is None:
        return coordinate, ""
    unit = match[1].strip()
    return _UNIT.sub("", coordinate, count=1), "" if unit == "-" else unit


def body_names(*bodies: str) -> tuple[str, ...]:
    """Return the names of the coordinates of planar bodies."""
    return tuple(f"{part} of {body}" for body in bodies for part in ("x (m)", "y (m)", "angle (rad)"))


# for two or three coordinates of a body's translation, the possible numbers of coordinates of its rotation
ROTATIONS = {2: (0, 1), 3: (0, 4, 9)}


@dataclass(frozen=True, eq=False)
class Joint:
    """Name the rows of the constraints that act on a body, so that `Result.reactions` finds them.

    The coordinates of the body must be absolute: the position of its reference point (such as the centre of mass) in
    space, and its rotation. Relative angles have no such joints.

    Parameters
    ----------
    name : str
    rows : tuple of int
        Rows of the joint, counted as in `Result.lam`.
    translation : tuple of int
        Coordinates x, y or x, y, z of the body's reference point.
    rotation : tuple of int
        Coordinates of the body's rotation: one angle, positive from x to y (planar); four Euler parameters of norm 1,
        or the nine entries of the rotation matrix, column by column (spatial). Empty for a point mass.
    point : tuple of float, optional
        The point that reactions refer to, m: from the reference point, along the axes of the body. None: the
        reference point.
    in_space : bool
        Whether `point` is fixed in space instead, given by its coordinates there.
    equations : array_like (n_c + n_a, n_c + n_a), optional
        For constraints of which a row holds several joints at once, such as those of a chain that is written out from
        the ground: an invertible matrix E such that each row of E C belongs to one joint. `rows` then counts the rows
        of E C, whose multipliers are E^-T lam. None: the rows of C themselves.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong. The system checks that its sizes fit.

    Examples
    --------
    >>> from twoloop.mechanisms import four_bar
    >>> joint = four_bar().joints[1]
    >>> joint.name, joint.rows
    ('1-2', (2, 3))
    """

    name: str
    rows: tuple[int, ...]
    translation: tuple[int, ...]
    rotation: tuple[int, ...] = ()
    point: tuple[float, ...] | None = None
    in_space: bool = False
    equations: Array | None = None

    def __post_init__(self) -> None:
        check_text("name", self.name)
        check_flag("in_space", self.in_space)
        for name in ("rows", "translation", "rotation"):
            numbers = getattr(self, name)
            if not isinstance(numbers, (tuple, list)):
                raise TypeError(f"{name} of the joint {self.name!r} must be a tuple of int; given {numbers!r}")
            object.__setattr__(
                self, name, tuple(check_size(f"{name} of {self.name!r}", number, 0) for number in numbers)
            )
        if not self.rows or len(set(self.rows)) < len(self.rows):
            raise ValueError(f"rows of the joint {self.name!r} must be at least one, none twice; given {self.rows!r}")
        dimension = len(self.translation)
        if dimension not in ROTATIONS:
            raise ValueError(
                f"translation of the joint {self.name!r} must be two coordinates (planar) or three (spatial); given "
                f"{self.translation!r}"
            )
        if len(self.rotation) not in ROTATIONS[dimension]:
            expected = "none or one angle" if dimension == 2 else "none, four Euler parameters or the nine of a matrix"
            raise ValueError(
                f"rotation of the joint {self.name!r} must be {expected}, as translation has {dimension} coordinates; "
                f"given {self.rotation!r}"
            )
        if self.point is not None:
            object.__setattr__(
                self, "point", tuple(check_vector(f"point of {self.name!r}", self.point, dimension).tolist())
            )
        elif self.in_space:
            raise ValueError(f"in_space of the joint {self.name!r} needs a point, in the coordinates of space")
        if self.equations is not None:
            object.__setattr__(self, "equations", check_real(f"equations of {self.name!r}", self.equations))


def check_joints(joints: object, n_q: int, n_rows: int) -> tuple[Joint, ...]:
    """Return the joints of a system as a tuple; raise TypeError or ValueError if one does not fit n_q or n_rows."""
    if not isinstance(joints, (tuple, list)) or not all(isinstance(joint, Joint) for joint in joints):
        raise TypeError(f"joints must be a list of twoloop.Joint; given {joints!r}")
    names = [joint.name for joint in joints]
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"joints must have names of their own; given {duplicate!r} twice")
    previous: Array | None = None  # equations that were checked last: most joints have the same ones
    for joint in joints:
        if max(joint.rows) >= n_rows:
            raise ValueError(
                f"rows of the joint {joint.name!r} must be below n_c + n_a = {n_rows}; given {joint.rows!r}"
            )
        if max(joint.translation + joint.rotation) >= n_q:
            raise ValueError(
                f"coordinates of the joint {joint.name!r} must be below n_q = {n_q}; given translation "
                f"{joint.translation!r} and rotation {joint.rotation!r}"
            )
        matrix = joint.equations
        if matrix is None or (previous is not None and np.array_equal(matrix, previous)):
            continue
        if matrix.shape != (n_rows, n_rows) or np.linalg.matrix_rank(matrix) < n_rows:
            raise ValueError(
                f"equations of the joint {joint.name!r} must be an invertible matrix of shape {(n_rows, n_rows)}; "
                f"given {shaped(matrix)}"
            )
        previous = matrix
    return tuple(joints)


@dataclass(frozen=True)
class Stop:
    """One-sided constraint: its gap stays at zero or above, by impacts or by a contact force, maybe with friction.

    Attributes
    ----------
    gap : callable
        gap(t, q), m or rad: positive where the stop is not touched. It is run once on symbols, so that its derivatives
        are exact: numpy's functions, without branches.
    restitution : float
        Speed at which the gap opens after an impact, over the speed at which it closed before; from 0 to 1.
    name : str
    friction : float
        Coefficient of Coulomb friction, zero or more.
    slide : callable, optional
        slide(t, q), m: position of the contact point along the surface, for friction in a plane.

    Raises
    ------
    TypeError, ValueError
        If an attribute is wrong.

    Examples
    --------
    >>> from twoloop import Stop
    >>> floor = Stop(lambda t, q: q[1], restitution=0.5, name="floor")  # the second coordinate stays above zero
    >>> floor.name, floor.restitution
    ('floor', 0.5)
    """

    gap: Callable[[Any, Any], Any]
    restitution: float = 0.0
    name: str = "stop"
    friction: float = 0.0
    slide: Callable[[Any, Any], Any] | None = None

    def __post_init__(self) -> None:
        check_text("name", self.name)
        if not callable(self.gap):
            raise TypeError(f"gap of {self.name!r} must be a function of t and q; given {self.gap!r}")
        check_call(f"gap of {self.name!r}", "gap", self.gap, ("t", "q"))
        value = check_finite(f"restitution of {self.name!r}", self.restitution)
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"restitution of {self.name!r} must be from 0 to 1; given {value!r}")
        rubs = check_not_negative(f"friction of {self.name!r}", self.friction) > 0.0
        if rubs or self.slide is not None:
            if not callable(self.slide):
                why = ", as it rubs" if rubs else ""
                raise TypeError(f"slide of {self.name!r} must be a function of t and q{why}; given {self.slide!r}")
            check_call(f"slide of {self.name!r}", "slide", self.slide, ("t", "q"))

"""Joints: which rows of the constraints hold which body, and where; what `Result.reactions` needs to know."""

from collections.abc import Container
from dataclasses import dataclass
from itertools import count

import numpy as np

from twoloop.checks.arguments import Array, check_flag, check_real, check_size, check_text, check_vector, shaped

# numbers of coordinates of a rotation, by those of the translation
ROTATIONS = {2: (0, 1), 3: (0, 4, 9)}


@dataclass(frozen=True, eq=False)
class Joint:
    """Rows of the constraints that act on a body, named so that `Result.reactions` finds them.

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
            object.__setattr__(self, name, tuple(check_size(f"{name} of {self.name!r}", each, 0) for each in numbers))
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


def unused(name: str, names: Container[str]) -> str:
    """`name`, or with a number where joints between the same bodies have it already: "pin a-b 2"."""
    return name if name not in names else next(new for k in count(2) if (new := f"{name} {k}") not in names)


def check_joints(joints: object, n_q: int, n_rows: int) -> tuple[Joint, ...]:
    """Return the joints of a system, or say which does not fit its numbers of coordinates and rows."""
    if not isinstance(joints, (tuple, list)) or not all(isinstance(joint, Joint) for joint in joints):
        raise TypeError(f"joints must be a list of twoloop.Joint; given {joints!r}")
    names = [joint.name for joint in joints]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"joints must have names of their own; given {twice!r} twice")
    known: Array | None = None  # equations of the joint before, which most joints share
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
        if matrix is None or (known is not None and np.array_equal(matrix, known)):
            continue
        if matrix.shape != (n_rows, n_rows) or np.linalg.matrix_rank(matrix) < n_rows:
            raise ValueError(
                f"equations of the joint {joint.name!r} must be an invertible matrix of shape {(n_rows, n_rows)}; "
                f"given {shaped(matrix)}"
            )
        known = matrix
    return tuple(joints)

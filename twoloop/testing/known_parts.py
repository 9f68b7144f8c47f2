"""Bodies and joints of a known problem, for simulators that are based on these."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Drive = tuple[Callable[[float], float], Callable[[float], float], Callable[[float], float]]
GROUND = -1


@dataclass(frozen=True, eq=False)
class KnownBody:
    """A point mass, or a rigid body with its centre of mass as reference.

    Attributes
    ----------
    mass : float
        kg.
    inertia : ndarray (0,), (1,) or (3,)
        kg m^2: empty for a point, the moment in the plane, or the principal moments in body axes.
    columns : slice
        Its coordinates in q: centre of mass, then an angle or four Euler parameters.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> problem = next(each for each in problems() if each.bodies)
    >>> problem.bodies[0].mass > 0.0
    True
    """

    mass: float
    inertia: Array
    columns: slice


@dataclass(frozen=True, eq=False)
class KnownJoint:
    """A joint between two bodies, or a body and the ground.

    Attributes
    ----------
    kind : str
        "revolute", "spherical" (both bodies share a point), "distance" (of two points), "prismatic" (in the plane: a
        point of the body stays on a line of the ground, and its angle is constant) or "drive" (the angle of the first
        body is a function of time).
    bodies : (int, int)
        Indices in `KnownProblem.bodies`; -1 is the ground.
    points : (ndarray, ndarray)
        Point on each body in body axes, relative to its centre; on the ground in space, m.
    rows : slice
        Its rows of C.
    axis : ndarray or None
        Direction in the axes of the second body: of a spatial hinge, (3,), or of the line of a slider, (2,).
    length : float or None
        Length of a distance, m.
    motion : tuple of callable or None
        The angle of a drive as a function of time, rad, and its first two derivatives.

    Examples
    --------
    >>> from twoloop.testing import problems
    >>> problem = next(each for each in problems() if each.joints)
    >>> len(problem.joints[0].bodies)
    2
    """

    kind: str
    bodies: tuple[int, int]
    points: tuple[Array, Array]
    rows: slice
    axis: Array | None = None
    length: float | None = None
    motion: Drive | None = None

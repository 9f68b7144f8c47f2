"""Bodies and joints of a known problem, for simulators that are given these."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Drive = tuple[Callable[[float], float], Callable[[float], float], Callable[[float], float]]
GROUND = -1


@dataclass(frozen=True, eq=False)
class KnownBody:
    """A point, or a rigid body about its centre of mass.

    Attributes
    ----------
    mass : float
        kg.
    inertia : ndarray (0,), (1,) or (3,)
        kg m^2: none of a point, the moment in the plane, the principal moments along the axes of the body.
    columns : slice
        Its coordinates in q: of the centre of mass, then an angle or four Euler parameters.
    """

    mass: float
    inertia: Array
    columns: slice


@dataclass(frozen=True, eq=False)
class KnownJoint:
    """A joint of two bodies, or of a body and the ground.

    Attributes
    ----------
    kind : str
        "revolute", "spherical" (both bodies share a point), "distance" (of two points), "prismatic" (in the plane: the
        body's point stays on a line of the ground, and its angle as it is) or "drive" (the angle of the first body is
        a function of time).
    bodies : (int, int)
        Numbers in `KnownProblem.bodies`; -1 is the ground.
    points : (ndarray, ndarray)
        On each body from its centre along its axes, of the ground in space, m.
    rows : slice
        Its rows of C.
    axis : ndarray or None
        Direction along the axes of the second body: of a hinge in space, (3,), or of the line of a slider, (2,).
    length : float or None
        m, of a distance.
    motion : tuple of callable or None
        Of a drive: the angle as a function of time, rad, and its two derivatives.
    """

    kind: str
    bodies: tuple[int, int]
    points: tuple[Array, Array]
    rows: slice
    axis: Array | None = None
    length: float | None = None
    motion: Drive | None = None

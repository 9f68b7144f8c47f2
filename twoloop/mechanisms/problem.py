"""What every ready problem offers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reference:
    """A state that is known from elsewhere.

    Attributes
    ----------
    t : float
        Time, s.
    q, v : ndarray (n_q,)
        Coordinates and velocities.
    source : str
        Where the numbers come from, and how far they were checked.
    period : float or None
        Period of the motion, s, where it is periodic.
    """

    t: float
    q: Array
    v: Array
    source: str
    period: float | None = None


@dataclass(frozen=True)
class Problem:
    """A mechanism ready to run.

    Attributes
    ----------
    name : str
    system : ConstrainedSystem
    q0, v0 : ndarray (n_q,)
        Consistent start.
    t_span : (float, float)
        Usual start and end, s.
    energy : callable
        energy(t, q, v) in J, for one state or, with q and v (n_q, n_t), for many.
    parameters : dict
        Geometry, masses and what else defines the case, with names.
    note : str
        What is assumed; shown wherever the problem is.
    reference : Reference or None
    """

    name: str
    system: ConstrainedSystem
    q0: Array
    v0: Array
    t_span: tuple[float, float]
    energy: Callable[[Any, Array, Array], Any]
    parameters: dict[str, Any] = field(default_factory=dict)
    note: str = ""
    reference: Reference | None = None

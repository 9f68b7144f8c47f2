"""Angular momentum of spatial bodies, which some ready mechanisms keep."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.bodies.rotation import half_spin, rotated
from twoloop.problem.problem import Array


@dataclass(frozen=True, eq=False)
class Momentum:
    """Angular momentum about an axis of space through a point, kg m^2/s, for one state or many.

    Attributes
    ----------
    bodies : ndarray (n, 4)
        Mass, kg, and principal moments of inertia, kg m^2, of each body.
    point, axis : ndarray (3,)
        m, and a unit vector.
    """

    bodies: Array
    point: Array
    axis: Array

    def __call__(self, t: Any, q: Array, v: Array) -> Any:
        """Evaluate for one state, or for many given as columns."""
        q, v = (np.asarray(x).reshape(-1, 7, *np.shape(x)[1:]) for x in (q, v))
        total: Any = 0.0
        for (mass, *inertia), state, rate in zip(self.bodies, q, v, strict=True):
            spin = 2.0 * np.stack(half_spin.py_func(*state[3:], *rate[3:]))
            arm = state[:3] - self.point.reshape(3, *(1,) * (state.ndim - 1))
            own = rotated.py_func(*state[3:], *(np.array(inertia) * spin.T).T)
            moment = np.cross(arm, rate[:3], axis=0) * mass + np.array(own)
            total = total + np.tensordot(self.axis, moment, axes=1)
        return total

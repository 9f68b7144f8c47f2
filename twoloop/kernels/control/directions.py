"""What power iterations for the largest rate begin with: in a run (switching.py), and after it (run/stability.py)."""

import numpy as np
from numpy.typing import NDArray

DISPLACEMENT = 1e-6  # of the largest coordinate or velocity, for derivatives along a direction
INNER_TOL = 1e-8  # of the positions; their error is squared


def first_direction(n_q: int) -> NDArray[np.float64]:
    """A direction in which all coordinates move, and neighbours unlike one another: no vibration is across it."""
    return np.asarray(0.3 + 0.1 * (np.arange(n_q) % 7))

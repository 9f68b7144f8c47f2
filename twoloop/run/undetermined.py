"""How far rounding may turn the velocities at a position where the constraints have nearly lost rank.

There the constraints hold positions only to rounding over the smallest singular value s, along the direction d that
they hold least. Over such a way they change, and with them the velocities, which are divided by s again.
"""

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data.tolerances import UNTRUE
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.crossings import DIFFERENCE

Array = NDArray[np.float64]

ROUNDING = 0.5 * float(np.finfo(np.float64).eps)
WEAK = 1e-2  # of the largest singular value: directions that are looked at
LEAST, MARGIN = 1e-5, 30.0  # of pivots that are looked at more closely, and how many times the singular values they are


def nearness(rtol: float) -> float:
    """The smallest pivot over the largest, below which rounding may turn velocities by more than rtol allows."""
    return min(WEAK, max(LEAST, MARGIN * float(np.sqrt(ROUNDING / (UNTRUE * max(rtol, ROUNDING))))))


def turned_by_rounding(system: ConstrainedSystem, t: float, q: Array, v: Array, rank: int) -> Array:
    """The errors of the velocities that rounding of positions makes, about, (n_q,); NaN where callbacks fail near q."""
    rows = system.rows(t, q)
    left, values, right = np.linalg.svd(rows, full_matrices=False)
    errors = np.zeros(len(q))
    for u, value, way in zip(left.T[:rank], values[:rank], right[:rank], strict=True):
        if value > WEAK * values[0]:
            continue
        if value == 0.0:
            return np.full(len(q), np.inf)
        step = DIFFERENCE * max(np.abs(q).max(), DIFFERENCE) / np.abs(way).max()
        beside = [q + side * step * way for side in (1.0, -1.0)]
        try:
            turn = np.subtract(*(system.velocity_constraint(t, each, v) for each in beside)) / (2.0 * step)
            bend = np.abs(np.subtract(*(system.rows(t, each) for each in beside)))
        except (ArithmeticError, ValueError):  # as a root does beyond a dead centre
            return np.full(len(q), np.nan)
        # rows that are short here are so by their position: a constraint is rounded as it would be some way off
        away = np.abs(rows) + (bend * (np.abs(rows).max() / bend.max()) if bend.any() else 0.0)
        rounding = ROUNDING * np.sqrt((away * away) @ (q * q))
        errors = np.maximum(errors, np.abs(way * (u @ turn)) * np.sqrt((u * u) @ (rounding * rounding)) / value**2)
    return errors

"""Positions where the constraints have nearly lost rank: what rounding, and the tolerances, leave open there.

There the constraints hold positions only to rounding over the smallest singular value s, along the direction d that
they hold least. Over such a way they change, and with them the velocities, which are divided by s again.
"""

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.rank import surely_above
from twoloop.kernels.data.tolerances import UNTRUE
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.crossings import DIFFERENCE, ratio_in_any_units, singular_ratio

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


def said_of_start(system: ConstrainedSystem, t: float, q: Array, rank: int, rtol: float, atol: Array) -> str:
    """What is said of a start from which the tolerances reach to where the constraints lose rank; nothing elsewhere."""
    if rank == 0 or surely_above(WEAK, system.rows(t, q), rank):
        return ""
    ratio = singular_ratio(system, t, q, rank)
    if max(ratio, ratio_in_any_units(system, t, q, rank)) > WEAK:
        return ""
    allowed = atol + rtol * np.abs(q).max()
    if not (np.abs(_way_to_singular(system, t, q, rank)) <= allowed).all():
        return ""
    return (
        f"the run begins where the constraints nearly lose rank (the smallest singular value of the constraint "
        f"Jacobian is {ratio:.1g} of the largest), which rtol and atol do not distinguish from a position where they "
        "do: another branch of the motion may begin there, onto which the steps may have come. Tighten rtol and atol, "
        "or start elsewhere"
    )


def _way_to_singular(system: ConstrainedSystem, t: float, q: Array, rank: int) -> Array:
    """To where the smallest singular value is zero, (n_q,), to first order; not finite where nothing leads there.

    Along what the constraints allow, with what they hold least.
    """
    left, values, right = np.linalg.svd(system.rows(t, q))
    u, w, held = left[:, rank - 1], right[rank - 1], right[: rank - 1]
    step, gradient = DIFFERENCE * max(np.abs(q).max(), DIFFERENCE), np.zeros(len(q))
    for j, way in enumerate(np.eye(len(q)) * step):
        try:
            gradient[j] = u @ (system.rows(t, q + way) - system.rows(t, q - way)) @ w / (2.0 * step)
        except (ArithmeticError, ValueError):  # as a root does beyond a dead centre
            return np.full(len(q), np.nan)
    gradient -= held.T @ (held @ gradient)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-values[rank - 1] * gradient / (gradient @ gradient))

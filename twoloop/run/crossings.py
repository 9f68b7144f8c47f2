"""What a run says of places where explicit steps went across in the place of its own, which became short there."""

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
Place = tuple[float, Array]  # time and state [q, v, ...]

LOST = 1e-2  # smallest over largest singular value, below which constraints are said to lose rank
SAMPLES = 33  # of the motion across
SHOWN = 3  # places of which a message speaks


def said_of_crossings(system: ConstrainedSystem, crossings: list[list[Place]], now: Place, rank: int) -> str:
    """Where steps went across, from the states before and, if the run came so far, behind; with what was measured."""
    found = {ends[0][0]: _least_ratio(system, ends[0], [*ends, now][1], rank) for ends in crossings[:SHOWN]}
    lost = {t: ratio for t, ratio in found.items() if ratio < LOST}
    others = {t: ratio for t, ratio in found.items() if ratio >= LOST}
    words = ""
    if lost:
        words += (
            f" Near t = {_times(lost)} steps went across positions where the constraints lose rank, or nearly so "
            f"({_measured(lost)}): beyond these, errors may exceed the tolerances."
        )
    if others:
        words += f" Near t = {_times(others)} explicit steps took the place of shorter ones ({_measured(others)})."
    more = len(crossings) - len(found)
    return words + (f" There were {more} more such places." if more > 0 else "")


def singular_ratio(system: ConstrainedSystem, t: float, q: Array, rank: int) -> float:
    """Smallest over largest singular value of as many rows as count; 1 where there are none."""
    values = np.linalg.svd(system.rows(t, q), compute_uv=False)[:rank]
    return float(values[-1] / values[0]) if len(values) and values[0] > 0.0 else float(len(values) == 0)


def _least_ratio(system: ConstrainedSystem, before: Place, behind: Place, rank: int) -> float:
    """The least ratio on the way between two states."""
    n, (t0, first), (t1, last) = system.n_q, before, behind
    if t1 == t0:
        return singular_ratio(system, t0, first[:n], rank)
    from scipy.interpolate import CubicHermiteSpline  # takes a tenth of a second to import, and few runs need it

    way = CubicHermiteSpline([t0, t1], [first[:n], last[:n]], [first[n : 2 * n], last[n : 2 * n]])
    return min(singular_ratio(system, float(t), way(t), rank) for t in np.linspace(t0, t1, SAMPLES))


def _times(found: dict[float, float]) -> str:
    return ", ".join(f"{t:.4g}" for t in found)


def _measured(found: dict[float, float]) -> str:
    return (
        f"the smallest singular value of the constraint Jacobian comes down to {min(found.values()):.1g} of the largest"
    )

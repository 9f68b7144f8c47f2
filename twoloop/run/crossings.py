"""What a run says of places where explicit steps went across in the place of its own, which became short there."""

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
Place = tuple[float, Array]  # time and state [q, v, ...]

LOST = 1e-2  # smallest over largest singular value, below which constraints are said to lose rank
SAMPLES = 33  # of the motion across
SHOWN = 3  # places of which a message speaks
TURNED = 3.0  # of what the accelerations before and behind give: velocities that changed by more turned in between ...
APPARENT = 10.0  # ... which counts where it exceeds the tolerances so many times


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


def said_of_turn(
    system: ConstrainedSystem, crossings: list[list[Place]], now: Place, rank: int, rtol: float, atol: Array
) -> str:
    """Where velocities turned on the way across by more than accelerations explain; nothing if they did so nowhere.

    Positions within the tolerance are near other branches of the motion there, onto which steps may have come.
    """
    n = system.n_q
    for before, *behind in crossings:
        across = len(behind) == 1 and behind[0][0] > before[0]
        (t0, first), (t1, last) = before, behind[0] if across else now
        if not _turned(n, before, (t1, last), rtol, atol):
            continue
        near = min(LOST, np.sqrt(rtol + float((atol / max(np.abs(first[:n]).max(), np.abs(last[:n]).max())).max())))
        # where no step led across, the run's own steps may have gone on to anywhere
        ratio = _least_ratio(system, before, (t1, last), rank) if across else singular_ratio(system, t1, last[:n], rank)
        if ratio < near:
            jump = float(np.abs(last[n : 2 * n] - first[n : 2 * n]).max())
            return (
                f"Not to be trusted beyond t = {t0:.10g}: near it the constraints lose rank "
                f"({_measured({t0: ratio})}), and velocities changed there by up to {jump:.1g} within {t1 - t0:.1g} s, "
                "more than the accelerations before and behind explain: within the tolerances lies another branch of "
                "the motion, onto which the steps may have come. Tighten rtol and atol, take another method, or end "
                "t_span before."
            )
    return ""


def _turned(n: int, before: Place, behind: Place, rtol: float, atol: Array) -> bool:
    """Whether the velocities of two states differ by more than the accelerations there explain."""
    (t0, first), (t1, last) = before, behind
    v0, v1 = first[n : 2 * n], last[n : 2 * n]
    most = max(np.abs(first[2 * n : 3 * n]).max(), np.abs(last[2 * n : 3 * n]).max())
    seen = APPARENT * (atol + rtol * max(np.abs(v0).max(), np.abs(v1).max()))
    return bool((np.abs(v1 - v0) > np.maximum(seen, TURNED * (t1 - t0) * most)).any())


def _times(found: dict[float, float]) -> str:
    return ", ".join(f"{t:.4g}" for t in found)


def _measured(found: dict[float, float]) -> str:
    return (
        f"the smallest singular value of the constraint Jacobian comes down to {min(found.values()):.1g} of the largest"
    )

"""Calls a simulator and validates its output."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from twoloop.testing.changes import Transformed
from twoloop.testing.known_problem import Array, KnownProblem
from twoloop.testing.limited import DidNotEnd

Simulate = Callable[[KnownProblem, Array, float], Any]


@dataclass(frozen=True, eq=False)
class Simulated:
    """Output of a simulator: states (n_t, n_q), multipliers (n_t, n_c), or the error message."""

    t: Array
    q: Array
    v: Array | None
    lam: Array | None
    error: str = ""
    hung: bool = False  # passed the time limit

    @property
    def complete(self) -> bool:
        """True if all numbers are finite."""
        given = [each for each in (self.q, self.v, self.lam) if each is not None]
        return not self.error and all(np.isfinite(each).all() for each in given)


def simulated(simulate: Simulate, problem: KnownProblem, times: Array, setting: float) -> Simulated:
    """Run a simulator on a problem. An exception of the simulator is a failed run; a wrong shape raises."""
    try:
        returned = simulate(problem, times.copy(), setting)
    except Exception as error:
        hung, nothing = isinstance(error, DidNotEnd), np.full((times.size, problem.n_q), np.nan)
        said = f"{'' if hung else f'{type(error).__name__}: '}{error}".strip().rstrip(":")
        return Simulated(times, nothing, None, None, said, hung)
    parts = returned if isinstance(returned, tuple) else (returned,)
    if not 1 <= len(parts) <= 3:
        raise TypeError(
            f"simulate must return q, (q, v) or (q, v, lam); on {problem.name!r} it returned a tuple of {len(parts)}"
        )
    widths = (problem.n_q, problem.n_q, problem.n_c)
    arrays = [
        _checked(problem, name, part, (times.size, width))
        for name, part, width in zip(("q", "v", "lam"), parts, widths, strict=False)
    ]
    q, v, lam = [*arrays, None, None][:3]
    if q is None:
        raise TypeError(f"simulate must return at least q; on {problem.name!r} it returned None")
    return Simulated(times, q, v, lam)


def transformed_back(run: Simulated, seen: Transformed) -> Simulated:
    """Return a run of a transformed problem in the coordinates of the original."""
    return Simulated(run.t, *seen.back(run.q, run.v, run.lam), run.error)


def _checked(problem: KnownProblem, name: str, part: Any, shape: tuple[int, int]) -> Array | None:
    """Return an array of the expected shape; None for None."""
    if part is None:
        return None
    try:
        if np.iscomplexobj(part):
            raise TypeError("complex numbers")
        array = np.asarray(part, dtype=float)
    except (TypeError, ValueError) as error:
        raise TypeError(
            f"simulate must return arrays of numbers; on {problem.name!r} {name} is {type(part).__name__}: {error}"
        ) from None
    if array.shape != shape:
        advice = " (transpose it)" if array.shape == shape[::-1] else ""
        raise ValueError(
            f"simulate must return {name} with a row for each time, of shape {shape} on {problem.name!r}; "
            f"it returned shape {array.shape}{advice}"
        )
    return array

"""CVODE, Adams, of scikit-sundae at index 1."""

import numpy as np
from numpy.typing import NDArray

from references.as_shown import rate_of, start_of
from references.driver import imported
from twoloop.testing.problem import Array, KnownProblem

NAME, PACKAGE, DRIFTS = "CVODE, scikit-sundae", "scikit-sundae", True


def simulate(problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """CVODE, Adams, of scikit-sundae at index 1."""

    def rate(t: float, y: Array, yp: NDArray[np.float64]) -> None:
        yp[:] = rate_of(problem, t, y)

    options = {"method": "Adams", "rtol": tolerance, "atol": tolerance, "max_num_steps": 100_000}
    solution = imported("sksundae.cvode").CVODE(rate, **options).solve(times, start_of(problem))
    if not solution.success:
        raise RuntimeError(solution.message)
    return tuple(np.split(solution.y, 2, axis=1))

"""Pr9 of extensisq in SciPy's solve_ivp, at index 1."""

import numpy as np

from references.as_shown import rate_of, start_of
from references.driver import imported
from twoloop.testing.problem import Array, KnownProblem

NAME, PACKAGE, DRIFTS = "Pr9, extensisq", "extensisq", True


def simulate(problem: KnownProblem, times: Array, tolerance: float) -> tuple[Array, ...]:
    """Pr9 of extensisq in SciPy's solve_ivp, at index 1."""
    from scipy.integrate import solve_ivp

    options = {"method": imported("extensisq").Pr9, "t_eval": times, "rtol": tolerance, "atol": tolerance}
    solution = solve_ivp(lambda t, y: rate_of(problem, t, y), (times[0], times[-1]), start_of(problem), **options)
    if not solution.success:
        raise RuntimeError(solution.message)
    return tuple(part.T for part in np.split(solution.y, 2))

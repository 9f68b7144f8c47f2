"""Runs of the mechanisms with a known motion, each made once, and their errors."""

import warnings
from functools import cache

import numpy as np

from tests.general.mechanisms import mechanism
from twoloop import ConstraintWarning, solve_dae

TOLERANCE = 5e-11


@cache
def run(name, method, tolerance=TOLERANCE, times=41):
    """A run, and the warnings about its rows."""
    m = mechanism(name)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = solve_dae(
            m.system(),
            (0.0, m.end),
            *m.start,
            method=method,
            rtol=tolerance,
            atol=tolerance,
            t_eval=np.linspace(0.0, m.end, times),
            max_steps=100_000,
        )
    return result, [str(each.message) for each in caught if issubclass(each.category, ConstraintWarning)]


def relative_error(values, reference):
    """Largest difference over the largest value, or over 1 where that is less."""
    return np.abs(values - reference).max() / max(1.0, np.abs(reference).max())


def error(m, result):
    """The larger of the relative errors of positions and velocities over the run."""
    q, v = m.states(result.t)
    return max(relative_error(result.q, q), relative_error(result.v, v))

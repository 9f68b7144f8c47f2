"""Runs of models that must reach their ends, and motions by hand in least coordinates."""

import numpy as np
from scipy.integrate import solve_ivp

from twoloop import solve_dae


def moved(problem, method="DOP853", tolerance=1e-11, **options):
    """A run over the span of a problem."""
    run = problem.system, problem.t_span, problem.q0, problem.v0, method
    result = solve_dae(*run, rtol=tolerance, atol=tolerance, **options)
    assert result.success, result.message
    return result


def by_hand(acceleration, start, times):
    """Coordinates and rates of x'' = acceleration(t, x, x') at times from 0 on, by SciPy."""
    n = len(start) // 2

    def rate(t, y):
        return np.concatenate([y[n:], np.atleast_1d(acceleration(t, y[:n], y[n:]))])

    return solve_ivp(rate, (0.0, times[-1]), start, "DOP853", times, rtol=1e-12, atol=1e-13).y

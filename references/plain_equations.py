"""The equations of a problem in plain numpy, for solvers that are called with nothing else."""

import numpy as np

from twoloop.testing.known_problem import Array, KnownProblem


class NoModel(Exception):
    """Raised where a solver has no model of a problem: nothing is said of it."""


def rate_of(problem: KnownProblem, t: float, y: Array) -> Array:
    """y' (2 n_q,) of the equations at index 1, y = [q, v]."""
    q, v = np.split(y, 2)
    return np.concatenate([v, problem.acceleration(t, q, v)[0]])


def start_of(problem: KnownProblem) -> Array:
    """y at the start (2 n_q,)."""
    return np.concatenate([problem.q0, problem.v0])

"""Solvers of other projects as shown in their documentation, one file each.

A file defines `NAME` for tables, `PACKAGE` for pip, `DRIFTS`, True if positions are not kept on the constraints, and
`simulate(problem, times, tolerance)` for `twoloop.testing.check_simulator` and `python -m studies.compare --solver`.
Packages are imported when it is called.
"""

import numpy as np

from twoloop.testing.problem import Array, KnownProblem


class NoModel(Exception):
    """A solver has no model of the problem, so that nothing can be concluded."""


def rate_of(problem: KnownProblem, t: float, y: Array) -> Array:
    """Return y' (2 n_q,) of the index-1 equations, y = [q, v]."""
    q, v = np.split(y, 2)
    return np.concatenate([v, problem.acceleration(t, q, v)[0]])


def start_of(problem: KnownProblem) -> Array:
    """Return the initial y (2 n_q,)."""
    return np.concatenate([problem.q0, problem.v0])

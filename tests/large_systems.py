"""Runs of large systems at their start, and chains in space."""

import numpy as np

from twoloop.bodies import SpatialModel
from twoloop.methods.dop853 import DOP853
from twoloop.run.run import Run


def started_run(system, q):
    """A run of an explicit method from rest, at its start."""
    n = system.n_q
    return Run(system, DOP853().plan(n, 1e-8, 1e-8, False), 0.0, q, 0.0 * q, 1e-8, np.full(n, 1e-8), None)


def spatial_chain(n, hinges=False):
    """Bars in space, one hung on another by hinges, or by balls and hinges in turn."""
    model, at = SpatialModel(name="spatial chain"), np.zeros(3)
    before = model.ground
    for k in range(n):
        along = np.array([0.3, 0.1 * np.sin(k), -0.15])
        body = model.body(f"body {k}", mass=1.0, inertia=(0.01, 0.02, 0.025), position=at + along / 2)
        if k % 2 and not hinges:
            model.spherical(before, body, at=at)
        else:
            model.revolute(before, body, at=at, axis=(0.1 * np.cos(k), 1.0, 0.2 * np.sin(k) + 0.1))
        before, at = body, at + along
    problem = model.problem()
    return problem.system, problem.q0, problem.v0

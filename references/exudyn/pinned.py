"""Exudyn models of any number of planar bodies with pins, solved by sparse factorisation."""

import numpy as np

from references.exudyn.model import Model
from references.exudyn.run import check_steps, run
from twoloop.mechanisms.planar import PlanarBodies
from twoloop.problem.problem import Problem
from twoloop.result.result import Result


def solve_pinned(
    problem: Problem,
    bodies: PlanarBodies,
    n_steps: int,
    solver: str = "GeneralizedAlpha",
    time_limit: float | None = None,
) -> Result:
    """Run planar bodies with pins by one of Exudyn's implicit solvers with a fixed step, and store the final state.

    The initial state and time span of the problem are used, not its system; and masses, inertias, gravity and pins of
    the bodies. Otherwise as in `references.exudyn.mechanisms.solve_exudyn`.
    """
    steps = check_steps(problem, problem.t_span[1], n_steps, solver, n_steps, time_limit)
    model = Model((0.0, -bodies.gravity, 0.0))
    model.planar_bodies(bodies.masses, bodies.inertias, problem)
    for pin in bodies.pins:
        model.pin(*pin)
    model.mbs.Assemble()
    return run(model.mbs, model.sensors, np.concatenate(model.reference), steps, None)

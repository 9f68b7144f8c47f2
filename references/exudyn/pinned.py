"""Exudyn models of planar bodies with pins, of any number: bodies and joints of its own, by sparse factors."""

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
    """Run planar bodies with pins with one of Exudyn's implicit solvers, with a fixed step, and store the end.

    Of the problem start and end are read, not its system; of the bodies masses, inertias, gravity and pins. All else is
    as of `references.exudyn.mechanisms.solve_exudyn`.
    """
    steps = check_steps(problem, problem.t_span[1], n_steps, solver, n_steps, time_limit)
    model = Model((0.0, -bodies.gravity, 0.0))
    model.planar_bodies(bodies.masses, bodies.inertias, problem)
    for pin in bodies.pins:
        model.pin(*pin)
    model.mbs.Assemble()
    return run(model.mbs, model.sensors, np.concatenate(model.reference), steps, None)

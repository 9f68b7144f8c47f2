"""The four-bar linkage as an Exudyn model: rigid bodies, revolute joints and gravity loads of its own.

Nothing comes from twoloop's equations but the lengths, the mass per length, gravity and the initial angles.
"""

from typing import Any

import exudyn as exu
import numpy as np
from exudyn.itemInterface import (
    LoadMassProportional,
    MarkerBodyMass,
    MarkerBodyPosition,
    NodeRigidBody2D,
    ObjectGround,
    ObjectJointRevolute2D,
    ObjectRigidBody2D,
)
from numpy.typing import NDArray

from references.driver import check_problem
from references.exudyn.run import ALPHA, SOLVERS, add_sensors, check_option, check_radius, check_steps, run
from twoloop.problem.problem import Problem
from twoloop.result.result import Result

__all__ = ["SOLVERS", "solve_exudyn"]

Array = NDArray[np.float64]


def solve_exudyn(
    problem: Problem,
    t_end: float,
    n_steps: int,
    solver: str = "GeneralizedAlpha",
    *,
    spectral_radius: float | None = None,
    alpha: float | None = None,
    store_every: int = 1,
    time_limit: float | None = None,
) -> Result:
    """Run the four-bar linkage from rest with one of Exudyn's implicit solvers, with a fixed step.

    Parameters
    ----------
    problem : Problem
        From `twoloop.mechanisms.four_bar`; only `parameters` and the initial angles are read.
    t_end : float
        End, s; the run starts at 0.
    n_steps : int
        Number of steps.
    solver : {"GeneralizedAlpha", "TrapezoidalIndex2", "HHT"}
        `SOLVERS` describes each in a line fit for a table.

        "GeneralizedAlpha": J. Chung and G. M. Hulbert, J. Appl. Mech. 60 (1993) 371-375, on index 3 by M. Arnold and
        O. Bruels, Multibody Syst. Dyn. 18 (2007) 185-202. From the spectral radius r at infinite frequency
        alpha_m = (2 r - 1)/(r + 1), alpha_f = r/(r + 1), gamma = 1/2 - alpha_m + alpha_f, beta = (gamma + 1/2)^2/4.

        "HHT": alpha_m = 0, alpha_f = -alpha, gamma = (1 - 2 alpha)/2, beta = (1 - alpha)^2/4 (Hilber, Hughes and
        Taylor, Earthq. Eng. Struct. Dyn. 5 (1977) 283-292). Exudyn has no setting for it: its settings know alpha_m
        and alpha_f through r only, and r = 1/2, where alpha_m vanishes, is HHT with alpha = -1/3. For the others its
        solver is started and its four coefficients are overwritten before the first step. This is the
        formula of HHT-I3, not its step-size control.
    spectral_radius : float, optional
        Of "GeneralizedAlpha" alone, 0 (most damping) to 1 (none). None: 0.9, Exudyn's default. With 1 the index-3
        form is weakly unstable: on the four-bar linkage the run fails within seconds, whatever the step.
    alpha : float, optional
        Of "HHT" alone, -1/3 (most damping) to 0 (the trapezoidal rule, as unstable as a spectral radius of 1). None:
        -0.3, the default of MSC Adams.
    store_every : int
        Store the start and every so many steps; `n_steps` must be a multiple of it.
    time_limit : float, optional
        Wall-clock time that the run may take, s, looked at after every step. A run past it is a failed one. None: no
        limit.

    Returns
    -------
    Result
        q, v, a (9, n_t) in the order [x1 y1 th1 x2 y2 th2 x3 y3 th3]; `a` as Exudyn's solver has it; `lam` NaN, for
        Exudyn's joint forces are not our multipliers. Times are Exudyn's own, which carry the rounding of an
        accumulated sum. `h` is empty unless every step is stored. A step that does not converge gives what was stored
        before it, `Status.SOLVER_FAILED` and Exudyn's text. Of the statistics Exudyn tells steps (n_accepted), Newton
        iterations (n_outer) and Jacobians, each with its factorisation (n_factorizations); cpu_time is that of
        the solver, its initialisation included.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, naming it.
    """
    check_problem(problem, "L3", "a linkage of twoloop.mechanisms.four_bar")
    t_end, n_steps, store_every = check_steps(t_end, n_steps, solver, store_every, time_limit)
    radius = check_radius(spectral_radius, solver)
    strength = check_option("alpha", alpha, ALPHA, (-1.0 / 3.0, 0.0), "HHT", solver)
    q0 = _positions(problem)
    _container, mbs, sensors = _model(problem, q0)
    return run(mbs, sensors, q0, 8, t_end, n_steps, solver, store_every, time_limit, radius, strength)


def _positions(problem: Problem) -> Array:
    """Centres and angles (9,) of three bars in a chain, from their lengths and initial angles."""
    p = problem.parameters
    q, joint = np.empty(9), np.zeros(2)
    for i, angle in enumerate(problem.q0[2::3]):
        half = 0.5 * p[f"L{i + 1}"] * np.array([np.cos(angle), np.sin(angle)])
        q[3 * i : 3 * i + 3] = *(joint + half), angle
        joint = joint + 2.0 * half
    return q


def _model(problem: Problem, q0: Array) -> tuple[Any, Any, list[list[int]]]:
    """Exudyn's container, the system in it, and the sensors [bar][output]."""
    p = problem.parameters
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    ground = mbs.AddObject(ObjectGround(referencePosition=[0.0, 0.0, 0.0]))
    before = mbs.AddMarker(MarkerBodyPosition(bodyNumber=ground, localPosition=[0.0, 0.0, 0.0]))
    sensors = []
    for i in range(3):
        length, mass = p[f"L{i + 1}"], p["density"] * p[f"L{i + 1}"]
        node = mbs.AddNode(NodeRigidBody2D(referenceCoordinates=q0[3 * i : 3 * i + 3].tolist()))
        bar = mbs.AddObject(ObjectRigidBody2D(mass=mass, inertia=mass * length**2 / 12.0, nodeNumber=node))
        whole = mbs.AddMarker(MarkerBodyMass(bodyNumber=bar))
        mbs.AddLoad(LoadMassProportional(markerNumber=whole, loadVector=[0.0, -p["gravity"], 0.0]))
        near, far = (
            mbs.AddMarker(MarkerBodyPosition(bodyNumber=bar, localPosition=[side * length / 2.0, 0.0, 0.0]))
            for side in (-1.0, 1.0)
        )
        mbs.AddObject(ObjectJointRevolute2D(markerNumbers=[before, near]))
        before = far
        sensors.append(add_sensors(mbs, node))
    end = mbs.AddMarker(MarkerBodyPosition(bodyNumber=ground, localPosition=[p["L"], 0.0, 0.0]))
    mbs.AddObject(ObjectJointRevolute2D(markerNumbers=[before, end]))
    mbs.Assemble()
    return container, mbs, sensors

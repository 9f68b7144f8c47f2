"""The four-bar linkage as an Exudyn model: rigid bodies, revolute joints and gravity loads of its own.

Nothing comes from twoloop's equations but the lengths, the mass per length, gravity and the initial angles.
"""

import contextlib
import time
from collections.abc import Iterator
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
    SensorNode,
)
from numpy.typing import NDArray

from twoloop.checks import check_number, check_size, check_vector
from twoloop.mechanisms.problem import Problem
from twoloop.result import Result, Statistics, Status

Array = NDArray[np.float64]

SPECTRAL_RADIUS = 0.9  # Exudyn's default
ALPHA = -0.3  # of HHT; the default of MSC Adams, whose HHT integrator is the usual one on index 3
SOLVERS = {
    "GeneralizedAlpha": "Exudyn generalized-alpha, spectral radius 0.9, index 3, fixed step",
    "TrapezoidalIndex2": "Exudyn trapezoidal rule, index 2, fixed step",
    "HHT": "Exudyn's generalized-alpha solver with the coefficients of Hilber, Hughes and Taylor, index 3, fixed step",
}

_OUTPUTS = (
    exu.OutputVariableType.Coordinates,  # displacements from the initial position
    exu.OutputVariableType.Coordinates_t,
    exu.OutputVariableType.Coordinates_tt,
)


def solve_exudyn(
    problem: Problem,
    t_end: float,
    n_steps: int,
    solver: str = "GeneralizedAlpha",
    *,
    spectral_radius: float | None = None,
    alpha: float | None = None,
    store_every: int = 1,
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
    t_end = float(check_vector("t_end", [t_end], 1)[0])
    if not t_end > 0.0:
        raise ValueError(f"t_end must be positive; given {t_end!r}")
    n_steps, store_every = check_size("n_steps", n_steps, 1), check_size("store_every", store_every, 1)
    if n_steps % store_every != 0:
        raise ValueError(f"n_steps must be a multiple of store_every = {store_every}; given {n_steps}")
    if solver not in SOLVERS:
        raise ValueError(f"solver must be one of {', '.join(SOLVERS)}; given {solver!r}")
    radius = _option("spectral_radius", spectral_radius, SPECTRAL_RADIUS, (0.0, 1.0), "GeneralizedAlpha", solver)
    strength = _option("alpha", alpha, ALPHA, (-1.0 / 3.0, 0.0), "HHT", solver)

    q0 = _positions(problem)
    _container, mbs, sensors = _model(problem, q0)
    settings = _settings(t_end, n_steps, store_every)
    settings.timeIntegration.generalizedAlpha.spectralRadius = radius
    with _silence():
        began = time.process_time()
        failure = _solve_hht(mbs, settings, strength) if solver == "HHT" else _solve(mbs, settings, solver)
        cpu = time.process_time() - began
    return _result(mbs, sensors, q0, store_every == 1, failure, cpu)


def _option(
    name: str, value: float | None, default: float, span: tuple[float, float], owner: str, solver: str
) -> float:
    """The value of an option that belongs to one solver, checked."""
    if value is None:
        return default
    if solver != owner:
        raise ValueError(f"{name} belongs to solver={owner!r}; given {name}={value!r} with solver={solver!r}")
    if not span[0] <= check_number(name, value) <= span[1]:
        raise ValueError(f"{name} must be between {span[0]:g} and {span[1]:g}; given {value!r}")
    return float(value)


def _solve(mbs: Any, settings: Any, solver: str) -> str:
    """Run one of Exudyn's own solvers; the text of a failure, or nothing."""
    try:
        mbs.SolveDynamic(settings, solverType=getattr(exu.DynamicSolverType, solver))
    except exu.SolverError as error:
        return f"{error}: {mbs.sys['dynamicSolver'].GetErrorString()}"
    return ""


def _solve_hht(mbs: Any, settings: Any, alpha: float) -> str:
    """Run the generalized-alpha solver with HHT's coefficients; the text of a failure, or nothing."""
    solver: Any = exu.MainSolverImplicitSecondOrder()
    mbs.sys["dynamicSolver"] = solver  # where SolveDynamic leaves it, too
    solver.InitializeSolver(mbs, settings)
    solver.alphaM, solver.alphaF = 0.0, -alpha
    solver.newmarkBeta, solver.newmarkGamma = 0.25 * (1.0 - alpha) ** 2, 0.5 - alpha
    solver.factJacAlgorithmic = 1.0 - solver.alphaF  # (1 - alpha_f) / (1 - alpha_m)
    reached = solver.SolveSteps(mbs, settings)
    solver.FinalizeSolver(mbs, settings)
    return "" if reached else f"SolveSteps terminated: {solver.GetErrorString()}"


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep Exudyn, whose console switch is global, from printing."""
    before = exu.config.printToConsole
    exu.config.printToConsole = False
    try:
        yield
    finally:
        exu.config.printToConsole = before


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
        sensors.append(
            [
                mbs.AddSensor(
                    SensorNode(nodeNumber=node, storeInternal=True, writeToFile=False, outputVariableType=output)
                )
                for output in _OUTPUTS
            ]
        )
    end = mbs.AddMarker(MarkerBodyPosition(bodyNumber=ground, localPosition=[p["L"], 0.0, 0.0]))
    mbs.AddObject(ObjectJointRevolute2D(markerNumbers=[before, end]))
    mbs.Assemble()
    return container, mbs, sensors


def _settings(t_end: float, n_steps: int, store_every: int) -> Any:
    settings = exu.SimulationSettings()
    settings.timeIntegration.endTime = t_end
    settings.timeIntegration.numberOfSteps = n_steps
    # on a Newton failure it would halve the step for good and end "successfully" with a wrong answer
    settings.timeIntegration.adaptiveStep = False
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.newton.modifiedNewtonJacUpdatePerStep = True
    settings.solution.file.write = False
    # a little less than the period, for Exudyn's times are sums that carry rounding
    settings.solution.sensors.writePeriod = (1.0 - 1e-9) * store_every * t_end / n_steps
    return settings


def _result(mbs: Any, sensors: list[list[int]], q0: Array, every_step: bool, failure: str, cpu: float) -> Result:
    tables = [[mbs.GetSensorStoredData(sensor) for sensor in bar] for bar in sensors]  # (n_t, 1 + 3), time first
    t = tables[0][0][:, 0]
    q, v, a = (np.concatenate([bar[k][:, 1:] for bar in tables], axis=1).T for k in range(len(_OUTPUTS)))
    did = mbs.sys["dynamicSolver"].it
    message = f"Exudyn reached the end, t = {t[-1]:g}."
    if failure:
        message = f"Exudyn failed in the step to t = {did.currentTime:.10g}: {failure}. Take more steps."
    return Result(
        t=t,
        q=q + q0[:, None],
        v=v,
        a=a,
        lam=np.full((8, t.size), np.nan),
        h=np.full(t.size - 1, did.currentStepSize) if every_step else np.empty(0),
        status=Status.SOLVER_FAILED if failure else Status.REACHED_END,
        message=message,
        stats=Statistics(
            n_accepted=did.currentStepIndex - (2 if failure else 1),  # the index counts from 1, and the failed step
            n_outer=did.newtonStepsCount,
            n_factorizations=did.newtonJacobiCount,
            cpu_time=cpu,
        ),
    )

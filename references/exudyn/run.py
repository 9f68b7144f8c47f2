"""Common parts of Exudyn models: sensors, fixed-step runs, suppressed output, statistics.

There is no variant with error control. For `adaptiveStep` of the implicit solvers Exudyn's documentation states "the
step size may be reduced if step fails; no automatic stepsize control"; the solvers with error control
(`automaticStepSize`: DOPRI5, ODE23) are explicit and reject joints: "explicit integrator detected object 2 which
contains constraints that cannot be solved" (1.13.6).
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from references.driver import Deferred, Task, TimeLimit, check_time_limit, user_call
from twoloop.checks.arguments import check_choice, check_number, check_positive, check_size
from twoloop.problem.problem import Array, Problem
from twoloop.result.result import Result

exu, items = Deferred("exudyn"), Deferred("exudyn.itemInterface", "exudyn")

Ours = Callable[[Array, Array, Array], tuple[Array, Array, Array]]

SPECTRAL_RADIUS = 0.9  # Exudyn's default
SPARSE = 90  # coordinates above which its sparse solver is faster
ALPHA = -0.3  # HHT's alpha, the default of MSC Adams, whose HHT integrator is the usual one for index 3
SOLVERS = {
    "GeneralizedAlpha": "Exudyn generalized-alpha, spectral radius 0.9, index 3, fixed step",
    "TrapezoidalIndex2": "Exudyn trapezoidal rule, index 2, fixed step",
    "HHT": "Exudyn's generalized-alpha solver with the coefficients of Hilber, Hughes and Taylor, index 3, fixed step",
}

# displacements from the reference position, and their derivatives
_OUTPUTS = ("Coordinates", "Coordinates_t", "Coordinates_tt")


class Steps(NamedTuple):
    """The checked arguments common to all models."""

    task: Task
    n_steps: int
    solver: str
    store_every: int
    radius: float


def check_steps(
    problem: Problem,
    t_end: float,
    n_steps: int,
    solver: str,
    store_every: int,
    time_limit: float | None,
    spectral_radius: float | None = None,
) -> Steps:
    """Return the checked arguments, with Exudyn's default radius; raise an error if one is invalid."""
    check_positive("t_end", t_end)
    check_time_limit(time_limit)
    n_steps, store_every = check_size("n_steps", n_steps, 1), check_size("store_every", store_every, 1)
    if n_steps % store_every != 0:
        raise ValueError(f"n_steps must be a multiple of store_every = {store_every}; given {n_steps}")
    check_choice("solver", solver, tuple(SOLVERS))
    radius = SPECTRAL_RADIUS if spectral_radius is None else check_number("spectral_radius", spectral_radius)
    if spectral_radius is not None and solver != "GeneralizedAlpha":
        raise ValueError(f"spectral_radius belongs to solver='GeneralizedAlpha'; given {radius!r} with {solver!r}")
    if not 0.0 <= radius <= 1.0:
        raise ValueError(f"spectral_radius must be between 0 and 1; given {radius!r}")
    system = problem.system
    task = Task(system, system.n_c, 0.0, float(t_end), problem.q0, problem.v0, None, time_limit)
    return Steps(task, n_steps, solver, store_every, radius)


def add_sensors(mbs: Any, node: int) -> list[int]:
    """Add sensors of a node's coordinates, velocities and accelerations."""
    options = {"nodeNumber": node, "storeInternal": True, "writeToFile": False}
    outputs = [getattr(exu.OutputVariableType, output) for output in _OUTPUTS]
    return [mbs.AddSensor(items.SensorNode(**options, outputVariableType=output)) for output in outputs]


def run(
    mbs: Any,
    sensors: Sequence[list[int]],
    reference: Array,
    steps: Steps,
    ours: Ours | None,
    dependent_rows: bool = False,
) -> Result:
    """Solve an assembled system whose nodes have these sensors and reference coordinates.

    `ours` converts Exudyn's coordinates, velocities and accelerations to those of the problem; None: they are the same.
    With dependent rows, which Exudyn's default linear solver does not support, a dense one ignores singular rows.
    """
    task, n_steps, solver, store_every, radius = steps
    settings = _settings(task.t1, n_steps, store_every)
    if dependent_rows:
        settings.linearSolver.solverType = exu.LinearSolverType.EigenDense
        settings.linearSolver.ignoreSingularJacobian = True
    elif reference.size > SPARSE:
        settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    settings.timeIntegration.generalizedAlpha.spectralRadius = radius
    limit = TimeLimit(task.time_limit)
    with _silence(), user_call:
        failure = _solve_hht(mbs, settings, limit) if solver == "HHT" else _solve(mbs, settings, solver, limit)
    tables = [[mbs.GetSensorStoredData(sensor) for sensor in node] for node in sensors]  # (n_t, 1 + n), time first
    t = tables[0][0][:, 0]
    q, v, a = (np.concatenate([node[k][:, 1:] for node in tables], axis=1).T for k in range(len(_OUTPUTS)))
    did = mbs.sys["dynamicSolver"].it
    made = did.currentStepIndex - (2 if failure else 1)  # the index starts at 1 and includes the failed step
    message = ""
    if not failure and made < n_steps:
        message = limit.message("Exudyn", did.currentTime, "take fewer steps")
    elif failure:
        message = f"Exudyn failed in the step to t = {did.currentTime:.10g}: {failure}. Take more steps."
    counts = {"n_accepted": made, "n_outer": did.newtonStepsCount, "n_factorizations": did.newtonJacobiCount}
    q += reference[:, None]
    rows = np.concatenate([*((q, v, a) if ours is None else ours(q, v, a)), np.full((task.n_c, t.size), np.nan)])
    h = np.full(t.size - 1, did.currentStepSize) if store_every == 1 else None
    return task.result("Exudyn", t, rows, message, h=h, **counts)


def _solve(mbs: Any, settings: Any, solver: str, limit: TimeLimit) -> str:
    """Run one of Exudyn's own solvers; return an error message, or "" for success or at the time limit."""
    before = exu.special.solver.timeout
    exu.special.solver.timeout = -1 if limit.seconds is None else limit.seconds
    try:
        mbs.SolveDynamic(settings, solverType=getattr(exu.DynamicSolverType, solver))
    except exu.SolverError as error:
        return f"{error}: {mbs.sys['dynamicSolver'].GetErrorString()}"
    finally:
        exu.special.solver.timeout = before
    return ""


def _solve_hht(mbs: Any, settings: Any, limit: TimeLimit) -> str:
    """Run the generalized-alpha solver with HHT's coefficients; return an error message or ""."""
    if limit.seconds is not None:
        # Exudyn's own timeout does not work for a solver started manually; this call costs 0.4 us per step
        mbs.SetPostStepUserFunction(lambda mbs, t: not limit.passed())
    solver: Any = exu.MainSolverImplicitSecondOrder()
    mbs.sys["dynamicSolver"] = solver  # as SolveDynamic does
    solver.InitializeSolver(mbs, settings)
    solver.alphaM, solver.alphaF = 0.0, -ALPHA
    solver.newmarkBeta, solver.newmarkGamma = 0.25 * (1.0 - ALPHA) ** 2, 0.5 - ALPHA
    solver.factJacAlgorithmic = 1.0 - solver.alphaF  # (1 - alpha_f) / (1 - alpha_m)
    reached = solver.SolveSteps(mbs, settings)
    solver.FinalizeSolver(mbs, settings)
    return "" if reached else f"SolveSteps terminated: {solver.GetErrorString()}"


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


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Suppress the output of Exudyn, whose console switch is global."""
    before = exu.config.printToConsole
    exu.config.printToConsole = False
    try:
        yield
    finally:
        exu.config.printToConsole = before

"""Building blocks of Exudyn models, and their runs: bodies, joints, springs, fixed steps, statistics.

There is no variant with error control. `adaptiveStep` of the implicit solvers only reduces steps that fail. The solvers
with error control (`automaticStepSize`: DOPRI5, ODE23) are explicit and reject joints (1.13.6).
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from references.driver import Deferred, Task, TimeLimit, user_call
from twoloop.bodies.rotation import rotation_matrix
from twoloop.checks.arguments import check_choice, check_number, check_positive, check_size
from twoloop.problem.problem import Array, Problem
from twoloop.result.result import Result

exu, items = Deferred("exudyn"), Deferred("exudyn.itemInterface", "exudyn")

Convert = Callable[[Array, Array, Array], tuple[Array, Array, Array]]

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
    if time_limit is not None:
        check_positive("time_limit", time_limit)
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


def run(model: Any, steps: Steps, convert: Convert | None = None, dependent_rows: bool = False) -> Result:
    """Solve an assembled system `mbs` of a model whose nodes have `sensors` and reference coordinates.

    `convert` makes those of the problem of Exudyn's coordinates, velocities and accelerations; None: they are the same.
    With dependent rows, which Exudyn's default linear solver does not support, a dense one ignores singular rows.
    """
    task, n_steps, solver, store_every, radius = steps
    mbs, reference = model.mbs, np.concatenate(model.reference)
    settings = _settings(task.t1, n_steps, store_every)
    if dependent_rows:
        settings.linearSolver.solverType = exu.LinearSolverType.EigenDense
        settings.linearSolver.ignoreSingularJacobian = True
    elif reference.size > SPARSE:
        settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    settings.timeIntegration.generalizedAlpha.spectralRadius = radius
    limit = TimeLimit(task.time_limit)
    with _changed(exu.config, "printToConsole", False), user_call:
        failure = _solve_hht(mbs, settings, limit) if solver == "HHT" else _solve(mbs, settings, solver, limit)
    # (n_t, 1 + n) each, time first
    tables = [[mbs.GetSensorStoredData(sensor) for sensor in node] for node in model.sensors]
    t = tables[0][0][:, 0]
    q, v, a = (np.concatenate([node[k][:, 1:] for node in tables], axis=1).T for k in range(len(_OUTPUTS)))
    iteration = mbs.sys["dynamicSolver"].it
    n_done = iteration.currentStepIndex - (2 if failure else 1)  # the index starts at 1 and includes the failed step
    message = ""
    if not failure and n_done < n_steps:
        message = limit.message("Exudyn", iteration.currentTime, "take fewer steps")
    elif failure:
        message = f"Exudyn failed in the step to t = {iteration.currentTime:.10g}: {failure}. Take more steps."
    newton = {"n_outer": iteration.newtonStepsCount, "n_factorizations": iteration.newtonJacobiCount}
    q += reference[:, None]
    rows = np.concatenate([*((q, v, a) if convert is None else convert(q, v, a)), np.full((task.n_c, t.size), np.nan)])
    h = np.full(t.size - 1, iteration.currentStepSize) if store_every == 1 else None
    return task.result("Exudyn", t, rows, message, h=h, n_accepted=n_done, **newton)


def _solve(mbs: Any, settings: Any, solver: str, limit: TimeLimit) -> str:
    """Run one of Exudyn's own solvers; return an error message, or "" for success or at the time limit."""
    seconds = -1 if limit.seconds is None else limit.seconds
    try:
        with _changed(exu.special.solver, "timeout", seconds):
            mbs.SolveDynamic(settings, solverType=getattr(exu.DynamicSolverType, solver))
    except exu.SolverError as error:
        return f"{error}: {mbs.sys['dynamicSolver'].GetErrorString()}"
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
def _changed(options: Any, name: str, value: float) -> Iterator[None]:
    """Change one of Exudyn's options, which are global."""
    previous = getattr(options, name)
    setattr(options, name, value)
    try:
        yield
    finally:
        setattr(options, name, previous)


GROUND = -1
# locked translations and rotations of the second body in the frame of a joint
SPHERICAL, UNIVERSAL = [1, 1, 1, 0, 0, 0], [1, 1, 1, 0, 0, 1]  # x of the first and y of the second stay perpendicular
REVOLUTE, PRISMATIC = [1, 1, 1, 1, 1, 0], [0, 1, 1, 1, 1, 1]  # about z, along x


class Model:
    """Exudyn's container and system, with methods that add bodies and connections."""

    def __init__(self, gravity: ArrayLike):
        self.container = exu.SystemContainer()
        self.mbs: Any = self.container.AddSystem()
        self.gravity = np.asarray(gravity, dtype=float).tolist()
        self.bodies: list[int] = []
        self.nodes: list[int] = []
        self.sensors: list[list[int]] = []
        self.places: list[tuple[Array, Array]] = []  # initial centre and rotation matrix of each body
        self.reference: list[Array] = []
        self.ground = self.mbs.AddObject(items.ObjectGround(referencePosition=[0.0, 0.0, 0.0]))

    def _added(self, body: int, node: int, q: Array, place: tuple[Array, Array]) -> int:
        whole = self.mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        self.mbs.AddLoad(items.LoadMassProportional(markerNumber=whole, loadVector=self.gravity))
        self.bodies.append(body)
        self.nodes.append(node)
        self.reference.append(np.asarray(q, dtype=float))
        self.places.append(place)
        self.sensors.append(add_sensors(self.mbs, node))
        return len(self.bodies) - 1

    def body(self, mass: float, inertia: ArrayLike, q: Array, v: Array) -> int:
        """Add a body in space: moments xx, yy, zz, yz, xz, xy or the first three; centre, Euler parameters, rates."""
        node = self.mbs.AddNode(items.NodeRigidBodyEP(referenceCoordinates=q.tolist(), initialVelocities=v.tolist()))
        moments = [*np.asarray(inertia, dtype=float).tolist(), 0.0, 0.0, 0.0][:6]
        body = self.mbs.AddObject(items.ObjectRigidBody(mass=mass, inertia=moments, nodeNumber=node))
        return self._added(body, node, q, (q[:3], rotation_matrix(q[3:])))

    def planar_body(self, mass: float, inertia: float, q: Array, v: Array) -> int:
        """Add a body in the plane: centre and angle (3,), and their rates."""
        node = self.mbs.AddNode(items.NodeRigidBody2D(referenceCoordinates=q.tolist(), initialVelocities=v.tolist()))
        inertias = {"mass": float(mass), "inertia": float(inertia)}
        body = self.mbs.AddObject(items.ObjectRigidBody2D(**inertias, nodeNumber=node))
        return self._added(body, node, q, (np.zeros(3), np.eye(3)))

    def add_bodies(self, masses: Any, inertias: Any, problem: Problem) -> None:
        """Add bodies with the initial states of those of a problem, in the plane or in space by their coordinates."""
        states = (x.reshape(len(masses), -1) for x in (problem.q0, problem.v0))
        for mass, inertia, q, v in zip(masses, inertias, *states, strict=True):
            (self.planar_body if q.size == 3 else self.body)(mass, inertia, q, v)

    def _local(self, body: int, point: ArrayLike) -> tuple[int, list[float], Array]:
        """Return Exudyn's number of a body, a point of space in body axes, and its rotation matrix."""
        point = np.asarray(point, dtype=float)
        if body == GROUND:
            return self.ground, point.tolist(), np.eye(3)
        centre, R = self.places[body]
        return self.bodies[body], (R.T @ (point - centre)).tolist(), R

    def joint(self, i: int, j: int, point: ArrayLike, frame: Array, locked: list[int]) -> int:
        """Lock motions of body j relative to i in the axes of a frame at a point, both given in space at the start."""
        markers = []
        for body in (i, j):
            number, local, R = self._local(body, point)
            place = exu.HT(rotation=R.T @ frame, translation=local)  # type: ignore[call-arg]  # its stub lags behind
            markers.append(self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=number, localHT=place)))
        return int(self.mbs.AddObject(items.GenericJoint(markerNumbers=markers, constrainedAxes=locked)))

    def spring(self, i: int, a: ArrayLike, j: int, b: ArrayLike, *data: float) -> None:
        """Add a spring-damper between two points given in space at the start: stiffness, damping, length."""
        stiffness, damping, length = data
        markers = [self._marker(*self._local(body, point)[:2]) for body, point in ((i, a), (j, b))]
        properties: dict[str, Any] = {"stiffness": stiffness, "damping": damping, "referenceLength": length}
        self.mbs.AddObject(items.ObjectConnectorSpringDamper(markerNumbers=markers, **properties))

    def pin(self, i: int, a: tuple[float, float], j: int, b: tuple[float, float]) -> int:
        """Add a pin between points of two planar bodies, each in body axes."""
        numbers = (self.ground if body == GROUND else self.bodies[body] for body in (i, j))
        markers = [self._marker(number, [*point, 0.0]) for number, point in zip(numbers, (a, b), strict=True)]
        return int(self.mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=markers)))

    def _marker(self, number: int, local: list[float]) -> int:
        return int(self.mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=number, localPosition=local)))

    def torque(self, body: int, torque: ArrayLike) -> None:
        """Add a constant torque on a body, along the axes of space."""
        marker = self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=self.bodies[body]))
        load = np.asarray(torque, dtype=float).tolist()
        self.mbs.AddLoad(items.LoadTorqueVector(markerNumber=marker, loadVector=load))

    def force_sensor(self, joint: int, local: bool) -> int:
        """Add a sensor of the force of a joint; `local`: in the axes of its first marker."""
        kind = exu.OutputVariableType.ForceLocal if local else exu.OutputVariableType.Force
        options: dict[str, Any] = {"storeInternal": True, "writeToFile": False, "outputVariableType": kind}
        return int(self.mbs.AddSensor(items.SensorObject(objectNumber=joint, **options)))

    def hold(self, body: int, coordinate: int) -> None:
        """Keep a coordinate of a body constant."""
        places = (self.mbs.AddNode(items.NodePointGround()), 0), (self.nodes[body], coordinate)
        kinds = [items.MarkerNodeCoordinate(nodeNumber=node, coordinate=k) for node, k in places]
        self.mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[self.mbs.AddMarker(each) for each in kinds]))


def frame(z: ArrayLike) -> Array:
    """Return a rotation matrix with a given last column."""
    z = np.asarray(z, dtype=float)
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])

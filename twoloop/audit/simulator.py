"""Compare a fixed-step simulator with the motion of rigid joints: error, order, floor, gap and cost per step size."""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from twoloop.bodies.model_problem import ModelProblem
from twoloop.bodies.rotation import euler_parameters, rotation_matrix
from twoloop.checks.arguments import Array, check_positive, shown
from twoloop.checks.consistency import ConstraintWarning
from twoloop.solve import solve_dae

Simulate = Callable[[ModelProblem, Array, float], Any]

POINT_JOINTS = ("revolute", "spherical", "universal", "fixed")  # kinds of joints that keep two points coincident
INSTANTS = 50  # comparison times after the start
REFERENCE_TOLERANCE = 1e-12  # tolerance of both references
LOST = 0.1  # larger errors (m, or components of axes) mean that the motion is a different one
FLAT = 1.5  # errors that decrease by less than this factor count as a floor
COARSEST, SETTLED, FINEST = 8.0, 0.25, 2.0**-12  # steps, relative to the given step; a floor needs a step <= SETTLED
TARGET_SHARE = 0.1  # steps are halved until the error, relative to the requested error, is at most this
START_TOLERANCE = 1e-6  # tolerance of the initial poses, m and components of axes
CPU_LIMIT = 4.0  # the next run is attempted if its estimated CPU time, s, is at most this
MAX_FIRST_STEPS = 100_000  # limit for the first run, when the cost of a step is unknown
REFERENCE_TIME_LIMIT = 60.0  # s: time limit of each reference
RESOLVED = 0.1  # largest difference of the references, relative to the requested error


def poses(model: Any, q: Array) -> tuple[Array, Array]:
    """Return centres of mass (n_t, n, d) and axes as columns (n_t, n, d, d), for d-dimensional q (n_t, n_q)."""
    d = model.dimension
    parts = q.reshape(len(q), len(model.bodies), 3 if d == 2 else 7)
    R = np.empty((*parts.shape[:2], d, d))
    if d == 2:
        s, c = np.sin(parts[..., 2]), np.cos(parts[..., 2])
        R[..., 0, 0], R[..., 0, 1], R[..., 1, 0], R[..., 1, 1] = c, -s, s, c
    else:
        for place in np.ndindex(parts.shape[:2]):
            e = parts[place][3:]
            R[place] = rotation_matrix(e / np.linalg.norm(e))
    return parts[..., :d], R


def coordinates(x: ArrayLike, R: ArrayLike) -> Array:
    """Return the coordinates of the problem of a `SpatialModel` for poses computed by another program.

    Parameters
    ----------
    x : array_like (n_t, n_bodies, 3)
        Centres of mass in the order of `model.bodies`, m.
    R : array_like (n_t, n_bodies, 3, 3)
        Rotation matrices; their columns are the axes of the bodies.

    Returns
    -------
    ndarray (n_t, 7 n_bodies)

    Raises
    ------
    ValueError
        If the shapes are inconsistent, or an R is not a rotation matrix.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.audit import coordinates
    >>> x, R = np.array([[[0.0, 0.0, 1.0]]]), np.eye(3)[None, None]  # one time, one body
    >>> coordinates(x, R)
    array([[0., 0., 1., 1., 0., 0., 0.]])
    """
    x, R = np.asarray(x, dtype=float), np.asarray(R, dtype=float)
    if x.ndim != 3 or x.shape[2] != 3 or R.shape != (*x.shape, 3):
        raise ValueError(f"x must be (n_t, n_bodies, 3) and R (n_t, n_bodies, 3, 3); given {x.shape} and {R.shape}")
    e = [[euler_parameters(rotation) for rotation in row] for row in R]
    return np.concatenate([x, np.array(e)], axis=2).reshape(len(x), -1)


def gaps(model: Any, x: Array, R: Array) -> Array:
    """Return the largest distance (n_t,) of points that joints keep coincident, m; for slides, across the axis."""
    largest = np.zeros(len(x))
    for joint in model.joints:
        slides = joint.kind in ("prismatic", "cylindrical") and len(joint.axes) > 0
        if joint.kind not in POINT_JOINTS and not slides:
            continue
        distances = _joint_point(joint.b, joint.point_b, x, R) - _joint_point(joint.a, joint.point_a, x, R)
        if slides:
            axis = joint.axes[0] if joint.a.number < 0 else R[:, joint.a.number] @ joint.axes[0]
            distances = distances - np.sum(distances * axis, axis=1)[:, None] * axis
        largest = np.maximum(largest, np.linalg.norm(distances, axis=1))
    return largest


def _joint_point(body: Any, point: Any, x: Array, R: Array) -> Array:
    local = np.array(point.values)
    return np.broadcast_to(local, x[:, 0].shape) if body.number < 0 else x[:, body.number] + R[:, body.number] @ local


class AuditedRun(NamedTuple):
    """A run with one step size; `error` and `gap` are NaN if it failed, and `message` says why.

    Attributes
    ----------
    step : float
        s.
    n_steps : int
    error : float
        Largest error over all times of any body's centre (m) or axes.
    gap : float
        Largest distance between points that joints keep coincident, m.
    cpu_s : float
        CPU time of the call, s.

    Examples
    --------
    >>> from twoloop.audit import AuditedRun
    >>> run = AuditedRun(step=0.004, n_steps=50, error=2e-3, gap=1e-4, cpu_s=0.01)
    >>> run.step, run.n_steps
    (0.004, 50)
    """

    step: float
    n_steps: int
    error: float
    gap: float
    cpu_s: float
    message: str = ""


@dataclass(frozen=True)
class Audit:
    """Errors of a simulator for steps from long to short; `print(audit)` shows them.

    Attributes
    ----------
    label : str
    t_end : float
        s.
    error : float
        Requested error.
    apart : float
        Difference of the two references.
    runs : tuple of AuditedRun
    order, floor : float or None
        Observed order, the median over steps where the error decreases; the error that shorter steps do not reduce.

    Examples
    --------
    >>> from twoloop.audit import Audit, AuditedRun
    >>> runs = tuple(AuditedRun(step, round(1.0 / step), 10.0 * step**2, 1e-4, 0.01) for step in (0.02, 0.01, 0.005))
    >>> audit = Audit("simulator", t_end=1.0, error=2e-3, apart=1e-9, runs=runs, order=2.0, floor=None)
    >>> audit.reaching.step
    0.01
    """

    label: str
    t_end: float
    error: float
    apart: float
    runs: tuple[AuditedRun, ...]
    order: float | None
    floor: float | None

    @property
    def reaching(self) -> AuditedRun | None:
        """Return the run with the longest step such that it and all shorter steps, at least one, reach the error."""
        reaching: AuditedRun | None = None
        for k, run in enumerate(reversed(self.runs)):
            if not run.error <= self.error:
                break
            reaching = run if k else reaching
        return reaching

    def __str__(self) -> str:
        lines = [f"{self.label}", f"  {'step (ms)':>10}  {'error':>8}  {'gap (m)':>8}  CPU (ms) for 1 s"]
        for run in self.runs:
            cost = f"{1e3 * run.cpu_s / self.t_end:.3g}"
            outcome = run.message or f"{run.error:8.2g}  {run.gap:8.1g}  {cost:>8}"
            lines.append(f"  {1e3 * run.step:10.4g}  {outcome}")
        order = "not seen" if self.order is None else f"{self.order:.1f}"
        floor = "none in sight" if self.floor is None else f"{self.floor:.2g}: shorter steps do not lower the error"
        longest = self.reaching
        steps = f"from a step of {1e3 * longest.step:.4g} ms" if longest else "not reached"
        return "\n".join([*lines, f"  order {order}; floor {floor}; error {self.error:g}: {steps}"])


def audit_simulator(
    simulate: Simulate, problem: ModelProblem, *, step: float, error: float = 1e-3, label: str = "simulator"
) -> Audit:
    """Run a fixed-step simulator on a model of bodies and joints, and compare it with the motion of rigid joints.

    The reference is `solve_dae` with two different methods, DOP853 and RadauIIA9, at tolerances of 1e-12.

    Parameters
    ----------
    simulate : callable
        simulate(problem, times, step) -> q (n_t, n_q), or a tuple that begins with q: the coordinates of `problem`, one
        row for each of the times (n_t,), s. The first time is the start; the times are multiples of the step. If the
        simulator fails, it raises an exception or returns NaN.
    problem : ModelProblem
        Result of `model.problem(t_span)`: mechanism, initial state and time span.
    step : float
        Step in use, s, rounded so that a 50th of the span is a multiple of it. The steps start at up to 8 times this,
        with at most 100,000 steps, and are halved until the error stops decreasing or is well below the requested one,
        or a run would take more than a few seconds.
    error : float, optional
        Requested error: the largest over all times of any body's centre (m) or axes.
    label : str, optional

    Returns
    -------
    Audit

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, nothing moves, or `simulate` has another start or returns an array of wrong shape.
    RuntimeError
        If a reference fails or takes more than a minute, or the two differ by more than a tenth of `error`.

    Examples
    --------
    >>> import numpy as np
    >>> from twoloop.audit import audit_simulator
    >>> from twoloop.bodies import SpatialModel
    >>> model = SpatialModel(name="pendulum")
    >>> rod = model.rod("rod", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0.02, mass=1.0)
    >>> pin = model.revolute("ground", rod, at=(0.0, 0.0, 0.0), axis=(0.0, 1.0, 0.0))
    >>> problem = model.problem((0.0, 0.2))
    >>> def simulate(problem, times, step):
    ...     return np.tile(problem.q0, (len(times), 1))  # a simulator that does not move
    >>> audit = audit_simulator(simulate, problem, step=0.01, error=1e-3)
    >>> audit.order is None, audit.runs[-1].error > 0.1
    (True, True)
    """
    if not isinstance(problem, ModelProblem) or problem.model is None:
        raise TypeError(f"problem must be made by model.problem(...) of twoloop.bodies; given {shown(problem)}")
    check_positive("step", step)
    check_positive("error", error)
    reference_poses, difference = reference(problem, error)
    t0, t1 = problem.t_span
    runs: list[AuditedRun] = []
    multiple = max(1, round((t1 - t0) / (step * INSTANTS)))  # so that the comparison times are multiples of the step
    while multiple % 2 == 0 and (t1 - t0) / (INSTANTS * multiple) < 0.7 * COARSEST * step:
        multiple //= 2
    n = INSTANTS * min(multiple, MAX_FIRST_STEPS // INSTANTS)
    # the first run may include imports and compilation
    while (t1 - t0) / n >= FINEST * step and not (len(runs) > 1 and 2.0 * runs[-1].cpu_s > CPU_LIMIT):
        runs.append(_run(simulate, problem, reference_poses, n))
        completed = [run for run in runs if not run.message]
        order, floor = order_and_floor([run.step for run in completed], [run.error for run in completed], difference)
        converged = floor is not None and (t1 - t0) / n <= SETTLED * step  # long steps may just lose the motion
        if converged or (len(completed) > 3 and completed[-1].error < max(TARGET_SHARE * error, 10.0 * difference)):
            break
        n *= 2
    return Audit(label, t1 - t0, error, difference, tuple(runs), order, floor)


def reference(problem: ModelProblem, error: float) -> tuple[tuple[Array, Array], float]:
    """Return the poses at the comparison times, and their largest difference from those of another method."""
    times = np.linspace(*problem.t_span, INSTANTS + 1)
    solutions = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        for method in ("DOP853", "RadauIIA9"):
            tolerances: dict[str, Any] = {"rtol": REFERENCE_TOLERANCE, "atol": REFERENCE_TOLERANCE}
            options = tolerances | {"method": method, "t_eval": times, "time_limit": REFERENCE_TIME_LIMIT}
            run = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, compiled=False, **options)
            if not run.success:
                raise RuntimeError(
                    f"the reference motion ends at {run.t[-1]:.3g} s: use a shorter time span, "
                    f"or another start. {method}: {run.message}"
                )
            solutions.append(poses(problem.model, run.q.T))
    difference = _distance(*solutions)
    if difference > RESOLVED * error:
        raise RuntimeError(
            f"the motion is not known to {error:g}: two references differ by {difference:.2g} within "
            f"{problem.t_span[1]:g} s. Neighbouring motions diverge too fast, e.g. near singular positions; "
            "use a shorter time span"
        )
    if sum(np.abs(values - values[0]).max() for values in solutions[0]) < 1e-9:
        raise ValueError("nothing moves: the start is at rest in equilibrium; start elsewhere, or with a velocity")
    return solutions[0], difference


def _run(simulate: Simulate, problem: ModelProblem, reference_poses: tuple[Array, Array], n: int) -> AuditedRun:
    times = np.linspace(*problem.t_span, INSTANTS + 1)
    h = (times[-1] - times[0]) / n
    start = time.process_time()
    try:
        returned = simulate(problem, times.copy(), h)
    except Exception as failure:
        message = f"failed: {failure}".strip() or type(failure).__name__
        return AuditedRun(h, n, np.nan, np.nan, time.process_time() - start, message)
    cpu_s = time.process_time() - start
    q = np.asarray(returned[0] if isinstance(returned, tuple) else returned, dtype=float)
    if q.shape != (shape := (times.size, problem.q0.size)):
        raise ValueError(f"simulate must return q with a row for each time, of shape {shape}; it returned {q.shape}")
    if not np.isfinite(q).all():
        return AuditedRun(h, n, np.nan, np.nan, cpu_s, "failed: the state is not finite")
    x, R = poses(problem.model, q)
    distance = _distance((x[0], R[0]), (reference_poses[0][0], reference_poses[1][0]))
    if distance > START_TOLERANCE:
        raise ValueError(
            f"simulate must start where the problem does; its first row is off by {distance:.2g} (m, axes)"
        )
    return AuditedRun(h, n, _distance((x, R), reference_poses), float(gaps(problem.model, x, R).max()), cpu_s)


def _distance(a: tuple[Array, Array], b: tuple[Array, Array]) -> float:
    return float(max(np.abs(x - y).max() for x, y in zip(a, b, strict=True)))


def order_and_floor(h: Any, error: Any, least: float) -> tuple[float | None, float | None]:
    """Return the observed order, the median over decreasing errors, and the error that shorter steps do not reduce.

    `least` is the accuracy of the reference. None: not enough runs, or no floor reached.
    """
    order = np.argsort(-np.asarray(h, dtype=float))
    h, error = np.asarray(h, dtype=float)[order], np.asarray(error, dtype=float)[order]
    floor = None
    if error.size >= 3 and FLAT * error[-1] > error[-3:].max() and 1.0 > error[-1] > 10.0 * least:
        floor = float(error[-1])
    usable = (error < LOST) & (error > max(4.0 * (floor or 0.0), 10.0 * least))
    pairs = usable[:-1] & usable[1:]
    slopes = (np.diff(np.log(error)) / np.diff(np.log(h)))[pairs] if error.size > 1 else np.zeros(0)
    return (float(np.median(slopes)) if slopes.size else None), floor

"""Compares a fixed-step simulator with the motion of rigid joints: error, order, floor, gap and cost per step size."""

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from twoloop.audit.poses import gaps, poses
from twoloop.bodies.model_problem import ModelProblem
from twoloop.checks.arguments import Array, check_positive, shown
from twoloop.checks.consistency import ConstraintWarning
from twoloop.solve import solve_dae

Simulate = Callable[[ModelProblem, Array, float], Any]

INSTANTS = 50  # comparison times after the start
TIGHT = 1e-12  # tolerance of both references
LOST = 0.1  # larger errors mean that the motion is a different one
FLAT = 1.5  # errors that decrease by less than this factor count as a floor
COARSEST, SETTLED, FINEST = 8.0, 0.25, 2.0**-12  # relative to the step given; a floor needs a step <= SETTLED
WELL_BELOW = 0.1  # relative to the requested error
SAME_START = 1e-6  # tolerance of the initial poses, m and components of axes
LIMIT = 4.0  # CPU time, s, up to which the next run is attempted
MOST_STEPS = 100_000  # limit for the first run, when the cost of a step is unknown
KNOWN_WITHIN = 60.0  # s: time limit of each reference
RESOLVED = 0.1  # largest difference of the references, relative to the requested error


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
    >>> run = audit.runs[0]
    >>> float(run.step), run.n_steps
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
    >>> audit.label, audit.error
    ('simulator', 0.001)
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
        found: AuditedRun | None = None
        for k, each in enumerate(reversed(self.runs)):
            if not each.error <= self.error:
                break
            found = each if k else found
        return found

    def __str__(self) -> str:
        lines = [f"{self.label}", f"  {'step (ms)':>10}  {'error':>8}  {'gap (m)':>8}  CPU (ms) for 1 s"]
        for run in self.runs:
            cost = f"{1e3 * run.cpu_s / self.t_end:.3g}"
            what = run.message or f"{run.error:8.2g}  {run.gap:8.1g}  {cost:>8}"
            lines.append(f"  {1e3 * run.step:10.4g}  {what}")
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
    known, apart = reference(problem, error)
    t0, t1 = problem.t_span
    runs: list[AuditedRun] = []
    parts = max(1, round((t1 - t0) / (step * INSTANTS)))  # so that the comparison times are multiples of the step
    while parts % 2 == 0 and (t1 - t0) / (INSTANTS * parts) < 0.7 * COARSEST * step:
        parts //= 2
    n = INSTANTS * min(parts, MOST_STEPS // INSTANTS)
    # the first run may include imports and compilation
    while (t1 - t0) / n >= FINEST * step and not (len(runs) > 1 and 2.0 * runs[-1].cpu_s > LIMIT):
        runs.append(_run(simulate, problem, known, n))
        own = [run for run in runs if not run.message]
        order, floor = order_and_floor([run.step for run in own], [run.error for run in own], apart)
        at_rest = floor is not None and (t1 - t0) / n <= SETTLED * step  # long steps may just lose the motion
        if at_rest or (len(own) > 3 and own[-1].error < max(WELL_BELOW * error, 10.0 * apart)):
            break
        n *= 2
    return Audit(label, t1 - t0, error, apart, tuple(runs), order, floor)


def reference(problem: ModelProblem, error: float) -> tuple[tuple[Array, Array], float]:
    """Return the poses at the comparison times, and their largest difference from those of another method."""
    times = np.linspace(*problem.t_span, INSTANTS + 1)
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConstraintWarning)
        for method in ("DOP853", "RadauIIA9"):
            options: dict[str, Any] = {"method": method, "rtol": TIGHT, "atol": TIGHT, "t_eval": times}
            options["time_limit"] = KNOWN_WITHIN
            run = solve_dae(problem.system, problem.t_span, problem.q0, problem.v0, compiled=False, **options)
            if not run.success:
                raise RuntimeError(
                    f"the reference motion ends at {run.t[-1]:.3g} s: use a shorter time span, "
                    f"or another start. {method}: {run.message}"
                )
            found.append(poses(problem.model, run.q.T))
    apart = _off(*found)
    if apart > RESOLVED * error:
        raise RuntimeError(
            f"the motion is not known to {error:g}: two references differ by {apart:.2g} within {problem.t_span[1]:g} "
            "s. Neighbouring motions diverge too fast, e.g. near singular positions; use a shorter time span"
        )
    if np.abs(found[0][0] - found[0][0][0]).max() + np.abs(found[0][1] - found[0][1][0]).max() < 1e-9:
        raise ValueError("nothing moves: the start is at rest in equilibrium; start elsewhere, or with a velocity")
    return found[0], apart


def _run(simulate: Simulate, problem: ModelProblem, known: tuple[Array, Array], n: int) -> AuditedRun:
    times = np.linspace(*problem.t_span, INSTANTS + 1)
    h = (times[-1] - times[0]) / n
    began = time.process_time()
    try:
        returned = simulate(problem, times.copy(), h)
    except Exception as failure:
        message = f"failed: {failure}".strip() or type(failure).__name__
        return AuditedRun(h, n, np.nan, np.nan, time.process_time() - began, message)
    spent = time.process_time() - began
    q = np.asarray(returned[0] if isinstance(returned, tuple) else returned, dtype=float)
    if q.shape != (shape := (times.size, problem.q0.size)):
        raise ValueError(f"simulate must return q with a row for each time, of shape {shape}; it returned {q.shape}")
    if not np.isfinite(q).all():
        return AuditedRun(h, n, np.nan, np.nan, spent, "failed: the state is not finite")
    x, R = poses(problem.model, q)
    if (off := max(np.abs(x[0] - known[0][0]).max(), np.abs(R[0] - known[1][0]).max())) > SAME_START:
        raise ValueError(f"simulate must start where the problem does; its first row is off by {off:.2g} (m, axes)")
    return AuditedRun(h, n, _off((x, R), known), float(gaps(problem.model, x, R).max()), spent)


def _off(one: tuple[Array, Array], other: tuple[Array, Array]) -> float:
    return float(max(np.abs(a - b).max() for a, b in zip(one, other, strict=True)))


def order_and_floor(h: Any, error: Any, least: float) -> tuple[float | None, float | None]:
    """Return the observed order, the median over decreasing errors, and the error that shorter steps do not reduce.

    `least` is the accuracy of the reference. None: not enough runs, or no floor reached.
    """
    order = np.argsort(-np.asarray(h, dtype=float))
    h, error = np.asarray(h, dtype=float)[order], np.asarray(error, dtype=float)[order]
    floor = None
    if error.size >= 3 and FLAT * error[-1] > error[-3:].max() and 1.0 > error[-1] > 10.0 * least:
        floor = float(error[-1])
    kept = (error < LOST) & (error > max(4.0 * (floor or 0.0), 10.0 * least))
    pairs = kept[:-1] & kept[1:]
    slopes = (np.diff(np.log(error)) / np.diff(np.log(h)))[pairs] if error.size > 1 else np.zeros(0)
    return (float(np.median(slopes)) if slopes.size else None), floor

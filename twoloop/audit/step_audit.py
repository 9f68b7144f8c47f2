"""A simulator with fixed steps against the motion of rigid joints: error, order, floor, gap and cost, step by step."""

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

INSTANTS = 50  # beside the start, at which motions are compared
TIGHT = 1e-12  # tolerance of both routes to the reference
LOST = 0.1  # an error from which on a motion is another one
FLAT = 1.5  # factor by which errors of two steps differ at most where they no longer fall
COARSEST, SETTLED, FINEST = 8.0, 0.25, 2.0**-12  # steps, over the one given; from the second on a floor is one
WELL_BELOW = 0.1  # of the error asked for
SAME_START = 1e-6  # m, and of axes
LIMIT = 4.0  # s of CPU that the next run may be expected to take
MOST_STEPS = 100_000  # of the first run, before which none tells what a step costs
KNOWN_WITHIN = 60.0  # s that each route to the reference may take
RESOLVED = 0.1  # how far the routes to the reference may differ, over the error that is asked for


class AuditedRun(NamedTuple):
    """A run with steps of one length; `error` and `gap` are NaN where it failed, and `message` says why.

    Attributes
    ----------
    step : float
        s.
    n_steps : int
    error : float
        Largest over the instants, of any body's centre (m) or axes.
    gap : float
        Largest distance between points that joints put together, m.
    cpu_s : float
        CPU time of the call, s.
    """

    step: float
    n_steps: int
    error: float
    gap: float
    cpu_s: float
    message: str = ""


@dataclass(frozen=True)
class Audit:
    """What a simulator is off by, at steps from long to short; `print(audit)`.

    Attributes
    ----------
    label : str
    t_end : float
        s.
    error : float
        Asked for.
    apart : float
        How far the two routes to the reference differ.
    runs : tuple of AuditedRun
    order, floor : float or None
        Observed order, the median between steps where the error falls; the error that shorter steps no longer lower.
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
        """The run with the longest step that has the error asked for, as all with shorter ones have, one at least."""
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
    """Run a simulator with fixed steps on a model of bodies and joints, and compare it with the motion of rigid joints.

    The reference is `solve_dae` by two unlike methods, DOP853 and RadauIIA9, at 1e-12.

    Parameters
    ----------
    simulate : callable
        simulate(problem, times, step) -> q (n_t, n_q), or a tuple that begins with q: the coordinates of `problem` at
        the times (n_t,), s, the first of which is the start, a row for each; the times are whole steps apart. Where it
        cannot go on it raises an exception, or returns NaN.
    problem : ModelProblem
        Of `model.problem(t_span)`: the mechanism, its start, and how long it is followed.
    step : float
        The one in use, s, rounded to a part of a 50th of the span. Tried are up to 8 times this, in not more than
        100,000 steps, and each half the one before, until the error falls no more, is well below the one asked for, or
        a run would take more than seconds.
    error : float, optional
        Asked for: the largest of any body's centre (m) or axes over the motion.
    label : str, optional

    Returns
    -------
    Audit

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, nothing moves, or `simulate` starts elsewhere, or returns an array of another shape.
    RuntimeError
        If the two routes to the reference fail, differ by more than a tenth of `error`, or take more than a minute.
    """
    if not isinstance(problem, ModelProblem) or problem.model is None:
        raise TypeError(f"problem must be made by model.problem(...) of twoloop.bodies; given {shown(problem)}")
    check_positive("step", step)
    check_positive("error", error)
    known, apart = reference(problem, error)
    t0, t1 = problem.t_span
    runs: list[AuditedRun] = []
    parts = max(1, round((t1 - t0) / (step * INSTANTS)))  # so that instants are whole steps apart
    while parts % 2 == 0 and (t1 - t0) / (INSTANTS * parts) < 0.7 * COARSEST * step:
        parts //= 2
    n = INSTANTS * min(parts, MOST_STEPS // INSTANTS)
    # the first run may hold imports and compiling
    while (t1 - t0) / n >= FINEST * step and not (len(runs) > 1 and 2.0 * runs[-1].cpu_s > LIMIT):
        runs.append(_run(simulate, problem, known, n))
        own = [run for run in runs if not run.message]
        order, floor = order_and_floor([run.step for run in own], [run.error for run in own], apart)
        at_rest = floor is not None and (t1 - t0) / n <= SETTLED * step  # long steps may lose the motion alike
        if at_rest or (len(own) > 3 and own[-1].error < max(WELL_BELOW * error, 10.0 * apart)):
            break
        n *= 2
    return Audit(label, t1 - t0, error, apart, tuple(runs), order, floor)


def reference(problem: ModelProblem, error: float) -> tuple[tuple[Array, Array], float]:
    """Poses at the instants, and how far those of another method are from them at most."""
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
                    f"the motion of rigid joints is not known beyond {run.t[-1]:.3g} s: follow it for a shorter time, "
                    f"or from another start. {method}: {run.message}"
                )
            found.append(poses(problem.model, run.q.T))
    apart = _off(*found)
    if apart > RESOLVED * error:
        raise RuntimeError(
            f"the motion is not known to {error:g}: two references differ by {apart:.2g} within {problem.t_span[1]:g} "
            "s. Neighbouring motions part too fast, as they do past singular positions; follow it for a shorter time"
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
    """Observed order, the median between steps where the error falls, and the error that shorter steps do not lower.

    `least` is what the reference resolves. None: not enough runs to tell, or no floor in sight.
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

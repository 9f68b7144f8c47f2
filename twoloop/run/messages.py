"""Messages about the end of a run: status, description and advice."""

import sys
import warnings
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import ConstraintWarning
from twoloop.checks.structure import dependent_rows, in_words, least_inertia, not_finite, surely_above
from twoloop.kernels.data import indices
from twoloop.run.monitors import INTERRUPTED, OUT_OF_TIME, STAGNATED, STAGNATION_STEPS, StallDetector
from twoloop.run.record import Later, Status
from twoloop.run.singular_positions import (
    WEAK,
    Place,
    describe_crossings,
    describe_turn,
    ratio_in_any_units,
    singular_ratio,
    velocity_rounding_errors,
)

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem
    from twoloop.run.run import Run

Array = NDArray[np.float64]

NEARLY_SINGULAR = 1e-3  # smallest over largest singular value of C_q, below which a message says so
LASTING = 100.0  # times the tolerances: larger errors of velocities along the way make a run untrustworthy
LOST_AT_END = 1e-6  # ratio of singular values, in any units, below which the state at the end counts as not determined
# what may help where no step leads across a singular position: rounding is larger there than tight tolerances
_REMEDIES = (
    "loosen rtol and atol, take another method or compiled=False, end t_span before, or change the geometry slightly"
)
CROSSINGS = "\0"  # placeholder for the description of singular positions that were crossed
NEXT_TO_END = 1e-3  # relative to the run: if it stops so close to its end, the message says so

_REASONS = {
    indices.DONE: "the error estimate stayed above the tolerances",
    indices.OUTER_DIVERGED: "the outer loop (stages) did not converge",
    indices.INNER_DIVERGED: "the inner loop (Newton on the positions) did not converge",
    indices.SINGULAR: "the dependent columns of the constraint Jacobian became singular",
    indices.MASS_NOT_DEFINITE: "the mass matrix was not positive definite",
    indices.GAMMA_INACCURATE: "gamma by differences missed the tolerance",
}


def _describe_passages(run: "Run") -> str:
    """Describe jumps and singular positions in a run that succeeded."""
    if not run.jumps and not run.crossings:
        return ""
    said = ""
    if run.jumps:
        said = f" At t = {_times(run.jumps)} C_t or b jumps: velocities changed there as by an impulse."
    return said + (CROSSINGS if run.crossings else "")


def message_of(run: "Run", words: str, system: "ConstrainedSystem", later: Later | None = None) -> dict[str, Any]:
    """Return the message, or a `later` that computes it: measuring crossings takes longer than many runs.

    `system`: must not change later, as the arrays of the run may; `later`: computes other fields.
    """
    if CROSSINGS not in words:
        return {"message": words}
    crossings, now, rank = run.crossings, (float(run.clock[run.a.T]), run.state.copy()), run.rank

    def fields_of(name: str) -> dict[str, Any]:
        if name != "message" and later is not None:
            return later(name)
        return {"message": words.replace(CROSSINGS, describe_crossings(system, crossings, now, rank))}

    # functions in Python may depend on variables that change: compute the message now
    return fields_of("message") if system.called_in_python else {"later": fields_of}


def reject_turned_velocities(
    run: "Run", last_step: list[Place], landed: list[Place], end: float, status: Status, message: str
) -> tuple[Status, str]:
    """Return status and message, changed if velocities turned at a crossed singular position, or in the last step.

    `landed`: states before the end on which steps had to end.
    """
    now, crossings = (float(run.clock[run.a.T]), run.state), [each for each in run.crossings if each[0][0] < end]
    turned = describe_rounding(run, [*(place for each in crossings for place in each), *landed], end)
    if last_step:
        crossings.append(last_step)
    if crossings and not turned:
        rtol, atol = float(run.tolerances[indices.RTOL]), run.tolerances[indices.ATOL :]
        turned = describe_turn(run.system, crossings, now, run.rank, rtol, atol)
    return (Status.RANK_LOST, turned) if turned else (status, message)


def describe_rounding(run: "Run", places: list[Place], end: float) -> str:
    """Describe where steps continued from velocities that rounding had changed; return nothing otherwise."""
    system, n = run.system, run.system.n_q
    for t, state in sorted({place[0]: place for place in places}.values(), key=itemgetter(0)):
        q, v = state[:n], state[n : 2 * n]
        if t >= end or surely_above(run.near, system.rows(t, q), run.rank):
            continue
        over = _over_allowed(run, t, q, v)
        if over > LASTING:
            return (
                f"Not to be trusted beyond t = {t:.10g}: steps went on from there, where the constraints nearly lose "
                f"rank ({_measured(run, t, q)}), and rounding of positions had changed velocities by about {over:.1g} "
                "times what rtol and atol allow. Take another method, or end t_span before."
            )
    return ""


def describe_arrival(t: float, fixed: bool) -> str:
    """Return the first sentence of the message of a run that reached its end."""
    return f"Reached the end, t = {t:g}{', with a constant step: no error was estimated' if fixed else ''}."


def outcome(run: "Run", code: int, t1: float, pace: StallDetector) -> tuple[Status, str]:
    """Return status and message of a run, from the code with which it ended."""
    a, t = run.a, float(run.clock[run.a.T])
    if code == a.ALL_OUTPUT_DONE:
        reached = describe_arrival(t, run.control[a.FIXED_STEP] > 0.0)
        return Status.REACHED_END, reached + _describe_passages(run) + warn_of_singular_end(run)
    stopped = f"Stopped at t = {t:.10g}"
    failure = int(run.clock[a.FAILURE_CODE])
    if code == INTERRUPTED:
        return Status.INTERRUPTED, ""
    if code == a.MAX_STEPS_REACHED:
        return (
            Status.MAX_STEPS,
            f"{stopped} after max_steps = {int(run.control[a.MAX_STEPS])} accepted steps. Raise max_steps, loosen "
            "rtol and atol, or shorten t_span.",
        )
    if code == OUT_OF_TIME:
        return (
            Status.TIME_LIMIT,
            f"{stopped} by time_limit. Raise time_limit, loosen rtol and atol, or shorten t_span.",
        )
    if code == STAGNATED:
        return Status.STAGNATED, f"{stopped}: {_standstill(run, t1, pace)}"
    if code == a.AT_DISCONTINUITY:
        return (
            Status.RATE_JUMPS,
            f"{stopped}: constraint_rate or nonholonomic_rate jumps there, and no impulse gives velocities that "
            "the constraints allow beyond it. Correct the drives, or end t_span before.",
        )
    if code == a.ROWS_VIOLATED:
        return Status.ROWS_CONTRADICT, _contradiction(run)
    if failure == indices.NOT_FINITE:
        return (Status.NOT_FINITE, f"{stopped}: {describe_not_finite(run)}. The result holds what was computed before.")
    if code == a.RANK_LOST or failure == indices.SINGULAR:
        rows = dependent_rows(run.system, t, run.state[: run.system.n_q])
        return (
            Status.RANK_LOST,
            f"{stopped}: the constraint Jacobian has lost rank there ({rows}), so no choice of independent "
            f"coordinates exists at this singular position, and no step led across: {_REMEDIES}."
            f"{_end_is_near(run, t1)}",
        )
    if failure == indices.GAMMA_INACCURATE:
        reached, required = run.work.notes[indices.GAMMA_ACCURACY], run.work.notes[indices.GAMMA_REQUIRED]
        return (
            Status.NOT_CONVERGED,
            f"{stopped}: gamma by differences of C_q and C_t is good to a relative error of {reached:.1g} there, "
            f"and rtol asks for {required:.1g}. Give gamma, or loosen rtol.",
        )
    reason = _REASONS[failure]
    if code == a.FIXED_STEP_FAILED:
        return (
            Status.NOT_CONVERGED,
            f"{stopped}: with the fixed step_size = {run.control[a.FIXED_STEP]:g} {reason}. Take a smaller "
            "step_size, or leave it out for step-size control.",
        )
    return (
        Status.STEP_TOO_SMALL,
        f"{stopped}: the step size fell below the spacing of floating-point numbers; at the last attempt {reason}. "
        f"{_near_singular(run, t1)}{_near_massless(run)}Look for a discontinuity near this time, loosen rtol and "
        "atol, or use coordinates of similar scale.",
    )


def _standstill(run: "Run", t1: float, pace: StallDetector) -> str:
    """Describe how short the steps are, how many more the run would take, and what may be the reason."""
    left = (t1 - float(run.clock[run.a.T])) / pace.mean
    before, advice = "", "Shorten t_span, or look at the units of velocities, masses and forces. "
    if pace.slows:
        before = f", after steps of up to {pace.longest:.2g} s"
        advice = "Look for a singular position or a stiff force near this time, or take another method. "
        advice = _near_singular(run, t1) or advice
    elif run.control[run.a.FIXED_STEP] > 0.0:
        advice = "Take a larger step_size, or shorten t_span. "
    return (
        f"the last {STAGNATION_STEPS} steps were {pace.mean:.2g} s long on average{before}, and the rest needs "
        f"{left:.1g} of them. {advice}With max_steps the run goes on up to that number of steps."
    )


def _contradiction(run: "Run") -> str:
    """Describe which row that was left out is violated, and which rows it depended on."""
    t, n, row = float(run.clock[run.a.T]), run.system.n_q, int(run.work.notes[indices.CONTRADICTION])
    words = in_words(run.system.rows(t, run.state[:n]), [row])
    return (
        f"Stopped at t = {t:.10g}: constraint row {row} depended on others at the start, was left out, and does "
        f"not hold along the motion that these allow ({words} at the last state). Either it contradicts them, or "
        "they are independent but for the start: start from another position, or correct the constraints."
    )


def warn_of_singular_end(run: "Run") -> str:
    """Warn if the run ends with constraints that have lost rank, or nearly so, and return the sentence."""
    if not run.passed_near_singular():
        return ""
    system, n, t = run.system, run.system.n_q, float(run.clock[run.a.T])
    q, v = run.state[:n], run.state[n : 2 * n]
    if surely_above(WEAK, system.rows(t, q), run.rank):
        return ""
    ratios = [ratio(system, t, q, run.rank) for ratio in (singular_ratio, ratio_in_any_units)]
    if max(ratios) <= LOST_AT_END:
        said = (
            f"the run ends where the constraints lose rank ({_measured(run, t, q)}): they do not determine velocities "
            "and accelerations there. End t_span a little before, or beyond"
        )
    else:
        over = _over_allowed(run, t, q, v)
        if over <= indices.UNTRUE:
            return ""
        said = (
            f"the run ends where the constraints nearly lose rank ({_measured(run, t, q)}): rounding of positions "
            f"changes velocities there {_times_allowed(over)}, and accelerations by more. "
            "End t_span a little before, or beyond, or loosen rtol and atol"
        )
    return warn_user(said)


def warn_user(text: str) -> str:
    """Warn where twoloop was called, and return the warning as a sentence of the message."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("twoloop."):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, ConstraintWarning, stacklevel=level)
    return f" {text[0].upper()}{text[1:]}."


def _over_allowed(run: "Run", t: float, q: Array, v: Array) -> float:
    """Estimate the errors of velocities caused by rounding of positions, over the tolerances."""
    allowed = run.tolerances[indices.ATOL :] + run.rtol * np.abs(v).max()
    return float((velocity_rounding_errors(run.system, t, q, v, run.rank) / allowed).max())


def _times_allowed(over: float) -> str:
    return f"by about {over:.1g} times what rtol and atol allow" if np.isfinite(over) else "by more than can be told"


def _measured(run: "Run", t: float, q: Array) -> str:
    ratio = singular_ratio(run.system, t, q, run.rank)
    return f"the smallest singular value of the constraint Jacobian is {ratio:.1g} of the largest"


def _end_is_near(run: "Run", t1: float) -> str:
    """Return a sentence if the run stopped just before its end, else nothing."""
    left = t1 - float(run.clock[run.a.T])
    if left > NEXT_TO_END * (t1 - run.t0):
        return ""
    return f" The end of t_span is {left:.1g} s ahead: end a little before that position, or beyond."


def _near_singular(run: "Run", t1: float) -> str:
    """Return a sentence if the constraint Jacobian is close to losing rank at the last state, else nothing."""
    ratio = singular_ratio(run.system, float(run.clock[run.a.T]), run.state[: run.system.n_q], run.rank)
    if ratio > NEARLY_SINGULAR:
        return ""
    return (
        f"The constraint Jacobian is close to losing rank there: its smallest singular value is "
        f"{ratio:.1g} of the largest. No step led across: {_REMEDIES}.{_end_is_near(run, t1)} "
    )


def _near_massless(run: "Run") -> str:
    """Return a sentence if some motion has next to no inertia at the last state, else nothing."""
    t, q = float(run.clock[run.a.T]), run.state[: run.system.n_q]
    ratio, words = least_inertia(run.system, t, q)
    return f"There {words}. " if ratio < NEARLY_SINGULAR else ""


def describe_not_finite(run: "Run") -> str:
    """Describe which callback returned a value that is not finite, and when, as far as it is known."""
    kind, at = int(run.work.notes[indices.FAULT_KIND]), float(run.work.notes[indices.FAULT_TIME])
    if kind >= 0:
        name = run.functions._fields[kind]
        return f"{name} of {run.system.name!r} returned a value that is not finite at t = {at:.10g}"
    n, t = run.system.n_q, float(run.clock[run.a.T])
    q, v = run.state[:n], run.state[n : 2 * n]
    end = t + float(run.clock[run.a.H_FAILED])
    for instant in (t, end):
        undefined = not_finite(run.system, instant, q, v)
        if undefined is not None:
            return f"{undefined} at t = {instant:.10g}"
    if run.plan.looks_within:
        return (
            "the callbacks are finite there, but not the Taylor series of the motion: one of their functions has "
            "no derivatives at this state (a root of zero, a norm of zero velocity), or its argument is too large "
            "(exp, tanh). Take 'auto' or 'DOP853', which evaluate the functions only"
        )
    return "the callbacks are finite at the start of the step, but not at a state within it"


def _times(times: list[float]) -> str:
    return ", ".join(f"{t:.4g}" for t in times[:3]) + (", ..." if len(times) > 3 else "")

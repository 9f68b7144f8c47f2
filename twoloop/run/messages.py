"""Monitor a run, and describe its end: status, message and advice.

`StallDetector` detects a run that makes no progress. `StiffnessMonitor` stores some states of the run. After the run,
`describe_stiffness` decides from them whether stability, not accuracy, limited the steps: at each of these states, it
estimates the rates of the fastest vibration and decay, by power iteration with dF/dq and dF/dv (F: accelerations), and
compares each rate times the step size with the stability limit of the method.
"""

import sys
import warnings
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import ConstraintWarning
from twoloop.checks.structure import certainly_exceed, dependent_rows, describe_dependence, least_inertia, not_finite
from twoloop.kernels.control.loop_state import DISPLACEMENT, INNER_TOL, initial_direction
from twoloop.kernels.control.singular_positions import EPS
from twoloop.kernels.control.step_size import EQUAL_SPACINGS
from twoloop.kernels.data import indices
from twoloop.methods.plan import Plan
from twoloop.run.record import Status
from twoloop.run.singular_positions import (
    WEAK_RATIO,
    TimedState,
    describe_crossings,
    describe_velocity_jump,
    singular_ratio,
    unit_free_ratio,
    velocity_rounding_errors,
)

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem
    from twoloop.run.run import Run

Array = NDArray[np.float64]

INTERRUPTED, STAGNATED, OUT_OF_TIME = -1, -2, -3  # end codes of a run, in addition to those that `advance` returns
STAGNATION_STEPS = 20_000  # a run is checked for a stall whenever about this number of further steps is accepted
# a run stalls if the rest of the run would take more than MAX_STEPS_LEFT steps (days of computing). It also stalls if
# the rest would take more than STAGNATION_LEFT steps, and (mean step size) / (largest step size) < STAGNATION_PACE
STAGNATION_PACE, STAGNATION_LEFT, MAX_STEPS_LEFT = 1e-3, 1e7, 1e11


class StallDetector:
    """Monitor of the sizes of accepted steps, to detect a run that makes no progress.

    The mean size of the last steps yields the number of steps that the rest of the run takes. The run is stalled if
    this number exceeds `max_steps_left`, or STAGNATION_LEFT if steps were much longer earlier in the run.
    """

    def __init__(self, t0: float, max_steps_left: float):
        self.max_steps_left = max_steps_left
        self.window_t, self.window_n = t0, 0
        self.longest_step = self.mean_step = 0.0

    def add_steps(self, h: Array) -> None:
        """Count accepted steps, and keep the size (s) of the longest step so far; `h`: sizes of the new steps."""
        self.longest_step = max(self.longest_step, float(h.max(initial=0.0)))
        self.window_n += len(h)

    def is_stalled(self, t: float, t1: float) -> bool:
        """Return whether a run to t1 is stalled at time t; False for STAGNATION_STEPS steps after the last check."""
        if self.window_n < STAGNATION_STEPS:
            return False
        self.mean_step = (t - self.window_t) / self.window_n
        self.window_t, self.window_n = t, 0
        return t1 - t > (STAGNATION_LEFT if self.has_slowed else self.max_steps_left) * self.mean_step

    @property
    def has_slowed(self) -> bool:
        """Whether steps were much longer earlier in the run, see STAGNATION_PACE."""
        return self.mean_step < STAGNATION_PACE * self.longest_step


MAX_SAMPLES = 8  # largest number of sampled states, spread about evenly over the run
N_LAST_STEPS = 8  # number of steps before a sampled state; the median of their sizes is the step size of the sample
N_ITERATIONS = 6  # number of power iterations at each sampled state
# a power iteration starts with the eigenvector at the previous sample, to which INITIAL_FACTOR times a vector without
# zeros (`initial_direction`) is added, because a component that is zero at the start might stay zero
INITIAL_FACTOR = 0.1
# in a power iteration x -> J x, the dominant eigenvalue of J is negative if cos(x, J x) is below minus this number
MIN_ALIGNMENT = 0.9
MIN_STEPS = 200  # after fewer accepted steps, a message does not mention stiffness
# a method is stable if (step size) * (rate of the fastest vibration or decay) is at most a limit. Stability limits
# the steps if the median over all samples of (product / limit) is at least this; in other runs, the median is about 0.4
MIN_STABILITY_RATIO = 0.45


class StiffnessSample(NamedTuple):
    """Sampled state of a run, the step size at this state, and the stability limits of the method."""

    t: float
    q: Array
    v: Array
    a: Array
    h: float  # median size (s) of the last steps before the state
    vibration: float  # the method is stable if (step size) * (angular frequency of a vibration) is at most this
    decay: float  # the method is stable if (step size) * (rate of a decay) is at most this


class StiffnessMonitor:
    """Monitor that stores some states of a run, so that `describe_stiffness` can decide if stability limited steps."""

    def __init__(self, plan: Plan):
        self.plan, self.sampling_interval, self.n_calls, self.n_steps = plan, 1, 0, 0
        self.last_sizes = np.zeros(0)  # sizes of the last N_LAST_STEPS steps (s)
        self.samples: list[StiffnessSample] = []

    def add_steps(self, steps: Array) -> None:
        """Count accepted steps, and keep the sizes (s) of the last N_LAST_STEPS; `steps`: sizes of the new steps."""
        self.n_steps += steps.size
        last = steps[-N_LAST_STEPS:]
        self.last_sizes = last if last.size == N_LAST_STEPS else np.concatenate([self.last_sizes, last])[-N_LAST_STEPS:]

    def sample_state(self, t: float, state: Array, n_q: int) -> None:
        """Store the current state as a sample; in long runs, most calls do nothing, as MAX_SAMPLES samples suffice."""
        if self.plan.stable_to is None or self.last_sizes.size < N_LAST_STEPS:
            return
        self.n_calls += 1
        if self.n_calls % self.sampling_interval != 0:
            return
        q, v, a = state[: 3 * n_q].reshape(3, n_q).copy()
        limits = self.plan.stable_to(self.plan.memory)
        self.samples.append(StiffnessSample(t, q, v, a, float(np.median(self.last_sizes)), *limits))
        if len(self.samples) > MAX_SAMPLES:
            self.samples = self.samples[1::2]
            self.sampling_interval *= 2


def describe_stiffness(monitor: StiffnessMonitor, kit: Any, work: Any) -> str:
    """Return a sentence for the message if stability limited the steps, else ""; arrays in `work` are overwritten."""
    if not monitor.samples or monitor.n_steps < MIN_STEPS:
        return ""
    initial = initial_direction(work.Q.size)
    directions = [np.zeros_like(initial), np.zeros_like(initial)]
    samples = []
    for sample in monitor.samples:
        for direction in directions:  # eigenvectors at the previous sample
            direction += INITIAL_FACTOR * initial
        try:
            vibration, decay = _fastest_rates(kit, work, sample, directions)
        except Exception:  # from a callback, at a displaced state that the run did not reach
            return ""
        h = sample.h
        samples.append((h * vibration / sample.vibration, h * decay / sample.decay, vibration, decay, h))
    by_vibration, by_decay, vibration, decay, h = np.median(samples, axis=0)
    if max(by_vibration, by_decay) < MIN_STABILITY_RATIO:
        return ""
    motion_text = f"vibrations of {vibration:.2g} rad/s" if by_vibration >= by_decay else f"a decay of {decay:.2g} 1/s"
    return (
        f" The problem looks stiff: steps of {h:.2g} s are about as long as they can be for {motion_text} to remain "
        "stable. If these need not be resolved, take method='auto', 'RadauIIA9', or 'TRBDF2' for few digits."
    )


def _fastest_rates(kit: Any, work: Any, sample: StiffnessSample, directions: list[Array]) -> tuple[float, float]:
    """Return the frequency (rad/s) of the fastest vibration and the rate (1/s) of the fastest decay; 0: unknown."""
    from twoloop.kernels.evaluation import tasks

    if kit.inner(kit, work, tasks.RENEW_PARTITION, sample.t, sample.q, sample.v, 0.0, work.x, work.lam) != indices.DONE:
        return 0.0, 0.0
    squared, is_negative_q = _dominant_eigenvalue(kit, work, sample, directions[0], work.independent, False)
    rate, is_negative_v = _dominant_eigenvalue(kit, work, sample, directions[1], work.independent_v, True)
    vibration = np.sqrt(squared) if is_negative_q else 0.0
    return (vibration, rate) if is_negative_v else (max(vibration, rate), 0.0)


def _dominant_eigenvalue(
    kit: Any, work: Any, sample: StiffnessSample, direction: Array, independent: NDArray[np.int64], by_v: bool
) -> tuple[float, bool]:
    """Return |x| and whether x < 0; x: dominant eigenvalue of dF/dq, or of dF/dv if `by_v` (F: accelerations).

    Only the coordinates `independent` (indices) vary. `direction`: first vector of the iteration, then the eigenvector.
    """
    from twoloop.kernels.evaluation import tasks

    displacement = DISPLACEMENT * max(1.0, float(np.abs(sample.v if by_v else sample.q).max()))
    eigenvalue, is_negative = 0.0, False
    a = np.zeros_like(sample.a)
    for _ in range(N_ITERATIONS):
        Q, V = sample.q.copy(), sample.v.copy()
        (V if by_v else Q)[independent] += displacement * direction[independent]
        if kit.inner(kit, work, tasks.EVALUATE, sample.t, Q, V, INNER_TOL, a, work.lam) != indices.DONE:
            return 0.0, False
        image = (a - sample.a)[independent]
        largest = float(np.abs(image).max(initial=0.0))
        if not 0.0 < largest < np.inf:
            return 0.0, False
        old_direction = direction[independent]
        cosine = float(image @ old_direction) / float(np.linalg.norm(image) * np.linalg.norm(old_direction))
        eigenvalue, is_negative = largest / (displacement * float(np.abs(old_direction).max())), cosine < -MIN_ALIGNMENT
        direction[independent] = image / largest
    return eigenvalue, is_negative


# messages call C_q nearly singular if (smallest / largest singular value) is at most this. They say that inertia is
# missing if (smallest / largest eigenvalue) of M on the velocities that the constraints allow is at most this
MAX_SINGULAR_RATIO = 1e-3
# a result is not trusted if rounding errors of velocities (or accelerations) exceed this multiple of the tolerances
MAX_LASTING_ERROR = 100.0
# the run warns if the smallest singular value of the constraint Jacobian at its end is at most this fraction of the
# largest: then the constraints do not determine the velocities at the end
MAX_RATIO_AT_END = 1e-6
# advice if no step leads across a singular position; loose tolerances help, because rounding errors are large near it
_REMEDIES = (
    "loosen rtol and atol, take another method or compiled=False, end t_span before, or change the geometry slightly"
)
CROSSINGS_MARK = "\0"  # stands in a message for the description of the singular positions that were crossed
NEAR_END = 1e-3  # a message mentions that the end is near if at most this fraction of the run is left

_FAILURE_REASONS = {
    indices.DONE: "the error estimate stayed above the tolerances",
    indices.OUTER_DIVERGED: "the outer loop (stages) or the Taylor series did not converge",
    indices.INNER_DIVERGED: "the inner loop (Newton on the positions) did not converge",
    indices.SINGULAR: "the dependent columns of the constraint Jacobian became singular",
    indices.MASS_NOT_DEFINITE: "the mass matrix was not positive definite",
    indices.GAMMA_INACCURATE: "gamma by differences missed the tolerance",
}


def message_of(run: "Run", text: str, system: "ConstrainedSystem") -> dict[str, Any]:
    """Return {"message": text}, or {"later": function} with a function that completes the text when it is first read.

    To describe the singular positions that a run crossed takes longer than many runs: so a text that contains such a
    description is completed later. Until then `system` must not change, but the arrays of the run may.
    """
    if CROSSINGS_MARK not in text:
        return {"message": text}
    crossings, end_state, rank = run.crossings, (float(run.clock[run.a.T]), run.state.copy()), run.rank

    def fields_of(name: str) -> dict[str, Any]:
        return {"message": text.replace(CROSSINGS_MARK, describe_crossings(system, crossings, end_state, rank))}

    # functions called in Python may depend on variables that change: compute the message now
    return fields_of("message") if system.called_in_python else {"later": fields_of}


def reject_velocity_jumps(
    run: "Run", last_step: list[TimedState], output_states: list[TimedState], end: float, status: Status, message: str
) -> tuple[Status, str]:
    """Return (RANK_LOST, reason) if rounding or a change of branch made velocities jump near a singular position.

    Else return `status` and `message`. Check states before the time `end`: the states before and after crossings,
    `output_states`, and `last_step` ([state before the last step] if velocities jumped in this step, else []).
    """
    end_state, crossings = (float(run.clock[run.a.T]), run.state), [each for each in run.crossings if each[0][0] < end]
    reason = describe_rounding(run, [*(state for ends in crossings for state in ends), *output_states], end)
    if last_step:
        crossings.append(last_step)
    if crossings and not reason:
        rtol, atol = float(run.tolerances[indices.RTOL]), run.tolerances[indices.ATOL :]
        reason = describe_velocity_jump(run.system, crossings, end_state, run.rank, rtol, atol)
    return (Status.RANK_LOST, reason) if reason else (status, message)


def describe_rounding(run: "Run", states: list[TimedState], end: float) -> str:
    """Return a sentence on the earliest of `states` where rounding changes v by over MAX_LASTING_ERROR tolerances.

    Return "" if there is no such state. Do not check states at or after the time `end`.
    """
    system, n = run.system, run.system.n_q
    for t, state in sorted({each[0]: each for each in states}.values(), key=itemgetter(0)):
        q, v = state[:n], state[n : 2 * n]
        # at a start from which a polynomial leads across the position, v is given by the user, not changed by rounding
        is_given = t == run.t0 and (run.starts_singular or (run.crossings and run.crossings[0][0][0] == t))
        if t >= end or is_given or certainly_exceed(run.near_threshold, system.rows(t, q), run.rank):
            continue
        error_ratio = _velocity_error_ratio(run, t, q, v)
        if error_ratio > MAX_LASTING_ERROR:
            return (
                f"Not to be trusted beyond t = {t:.10g}: steps went on from there, where the constraints nearly lose "
                f"rank ({_ratio_text(run, t, q)}), and rounding of positions had changed velocities by about "
                f"{error_ratio:.1g} times what rtol and atol allow. Take another method, or end t_span before."
            )
    return ""


def describe_arrival(t: float, fixed: bool) -> str:
    """Return the first sentence of the message of a run that reached its end; `fixed`: whether all steps were equal."""
    return f"Reached the end, t = {t:g}{', with a constant step: no error was estimated' if fixed else ''}."


def status_and_message(run: "Run", code: int, t1: float, stall: StallDetector) -> tuple[Status, str]:
    """Return the status and the message of a run that ended with `code`.

    `code`: an end code of `advance` (see loop_state.py), or INTERRUPTED, STAGNATED or OUT_OF_TIME.
    """
    a, t = run.a, float(run.clock[run.a.T])
    if code == a.ALL_OUTPUT_DONE:
        text = describe_arrival(t, run.control[a.FIXED_STEP] > 0.0)
        if run.jumps:
            times = ", ".join(f"{jump:.4g}" for jump in run.jumps[:3]) + (", ..." if len(run.jumps) > 3 else "")
            text += f" At t = {times} C_t or b jumps: velocities changed there as by an impulse."
        return Status.REACHED_END, text + (CROSSINGS_MARK if run.crossings else "") + warn_of_singular_end(run)
    stopped = f"Stopped at t = {t:.10g}"
    failure_code = int(run.clock[a.FAILURE_CODE])
    if code == INTERRUPTED:
        return Status.INTERRUPTED, ""
    if code == a.MAX_STEPS_REACHED:
        return (
            Status.MAX_STEPS,
            f"{stopped} after max_steps = {int(run.control[a.MAX_STEPS])} accepted steps. Raise max_steps, loosen "
            "rtol and atol, or shorten t_span.",
        )
    if code == OUT_OF_TIME:
        return Status.TIME_LIMIT, f"{stopped} by time_limit. Raise time_limit, loosen rtol and atol, or shorten t_span."
    if code == STAGNATED:
        return Status.STAGNATED, f"{stopped}: {_describe_stall(run, t1, stall)}"
    if code == a.AT_DISCONTINUITY:
        return (
            Status.RATE_JUMPS,
            f"{stopped}: constraint_rate or nonholonomic_rate jumps there, and no impulse gives velocities that "
            "the constraints allow beyond it. Correct the drives, or end t_span before.",
        )
    if code == a.ROWS_VIOLATED:
        return Status.ROWS_CONTRADICT, _describe_contradiction(run)
    if failure_code == indices.NOT_FINITE:
        return Status.NOT_FINITE, f"{stopped}: {describe_not_finite(run)}. The result holds what was computed before."
    if code == a.RANK_LOST or failure_code == indices.SINGULAR:
        rows = dependent_rows(run.system, t, run.state[: run.system.n_q])
        return (
            Status.RANK_LOST,
            f"{stopped}: the constraint Jacobian has lost rank there ({rows}), so no choice of independent "
            f"coordinates exists at this singular position, and no step led across: {_REMEDIES}."
            f"{_describe_near_end(run, t1)}",
        )
    if failure_code == indices.GAMMA_INACCURATE:
        reached, required = run.work.notes[indices.GAMMA_ACCURACY], run.work.notes[indices.GAMMA_REQUIRED]
        return (
            Status.NOT_CONVERGED,
            f"{stopped}: gamma by differences of C_q and C_t is good to a relative error of {reached:.1g} there, "
            f"and rtol asks for {required:.1g}. Give gamma, or loosen rtol.",
        )
    reason = _FAILURE_REASONS[failure_code]
    if code == a.FIXED_STEP_FAILED:
        return (
            Status.NOT_CONVERGED,
            f"{stopped}: with the fixed step_size = {run.control[a.FIXED_STEP]:g} {reason}. Take a smaller "
            "step_size, or leave it out for step-size control.",
        )
    if run.max_step <= EQUAL_SPACINGS * np.spacing(abs(t)):
        limit = f"{EQUAL_SPACINGS:g} spacings of floating-point numbers, {np.spacing(abs(t)):.2g}"
        reason = f"max_step = {run.max_step:g} is at most {limit}"
        return Status.STEP_TOO_SMALL, f"{stopped}: {reason}. Raise max_step, or let t_span begin at 0."
    least_ratio, words = least_inertia(run.system, t, run.state[: run.system.n_q])
    massless = f"There {words}. " if least_ratio < MAX_SINGULAR_RATIO else ""
    return (
        Status.STEP_TOO_SMALL,
        f"{stopped}: the step size fell below the spacing of floating-point numbers; at the last attempt {reason}. "
        f"{_describe_near_singular(run, t1)}{massless}Look for a discontinuity near this time, "
        "loosen rtol and atol, or use coordinates of similar scale.",
    )


def _describe_stall(run: "Run", t1: float, stall: StallDetector) -> str:
    """Describe a stalled run: how short its steps are, how many more it would need, and the likely reason."""
    n_left = (t1 - float(run.clock[run.a.T])) / stall.mean_step
    earlier_steps, advice = "", "Shorten t_span, or look at the units of velocities, masses and forces. "
    if stall.has_slowed:
        earlier_steps = f", after steps of up to {stall.longest_step:.2g} s"
        advice = "Look for a singular position or a stiff force near this time, or take another method. "
        advice = _describe_near_singular(run, t1) or advice
    elif run.control[run.a.FIXED_STEP] > 0.0:
        advice = "Take a larger step_size, or shorten t_span. "
    return (
        f"the last {STAGNATION_STEPS} steps were {stall.mean_step:.2g} s long on average{earlier_steps}, and the rest "
        f"needs {n_left:.1g} of them. {advice}With max_steps the run goes on up to that number of steps."
    )


def _describe_contradiction(run: "Run") -> str:
    """Return the message of a run that violates a redundant row, or whose branch at a singular start is unknown."""
    t, q = float(run.clock[run.a.T]), run.state[: run.system.n_q]
    if run.starts_singular:
        return (
            f"Stopped at its start, t = {t:.10g}, a singular position: the constraints have lost rank there "
            f"({dependent_rows(run.system, t, q)}), but not beside it, and no single branch of the motion has "
            "velocities within the tolerances of v0, or the steps are constant. Start a little before that position, "
            "or beyond."
        )
    row = int(run.work.notes[indices.CONTRADICTION])
    words = describe_dependence(run.system.rows(t, q), [row])
    return (
        f"Stopped at t = {t:.10g}: constraint row {row} depended on others at the start, was left out, and does "
        f"not hold along the motion that these allow ({words} at the last state). Either it contradicts them, or "
        "they are independent but for the start: start from another position, or correct the constraints."
    )


def warn_of_singular_end(run: "Run") -> str:
    """Warn if the constraints lose or nearly lose rank at the end of a run; return the warning, else ""."""
    if not run.passed_near_singular():
        return ""
    system, n, t = run.system, run.system.n_q, float(run.clock[run.a.T])
    q, v = run.state[:n], run.state[n : 2 * n]
    if certainly_exceed(WEAK_RATIO, system.rows(t, q), run.rank):
        return ""
    ratios = [ratio(system, t, q, run.rank) for ratio in (singular_ratio, unit_free_ratio)]
    if max(ratios) <= MAX_RATIO_AT_END:
        text = (
            f"the run ends where the constraints lose rank ({_ratio_text(run, t, q)}): they do not determine "
            "velocities and accelerations there. End t_span a little before, or beyond"
        )
    else:
        error_ratio = _velocity_error_ratio(run, t, q, v)
        if error_ratio <= indices.REPORTED_ERROR:
            return ""
        excess = f"about {error_ratio:.1g} times what rtol and atol allow"
        if not np.isfinite(error_ratio):
            excess = "more than can be told"
        text = (
            f"the run ends where the constraints nearly lose rank ({_ratio_text(run, t, q)}): rounding of positions "
            f"changes velocities there by {excess}, and accelerations by more. "
            "End t_span a little before, or beyond, or loosen rtol and atol"
        )
    return warn_user(text)


def warn_of_inaccurate_crossing(run: "Run") -> str:
    """Warn if steps other than crossings may have passed a singular position inaccurately; return the warning or ""."""
    ratio = float(run.clock[run.a.PIVOT_PASSED])
    if ratio == 0.0:
        return ""
    error_ratio = EPS / ratio**3 / float(run.tolerances[indices.LEAST])
    if error_ratio <= MAX_LASTING_ERROR:
        return ""
    return warn_user(
        f"no step led across a singular position, and the run went on with steps within which the smallest pivot of "
        f"the constraint Jacobian came down to {ratio:.1g} of its largest: rounding of accelerations there may be "
        f"about {error_ratio:.1g} times what rtol and atol allow. Loosen rtol and atol, take another method, or change "
        "the geometry slightly"
    )


def warn_user(text: str) -> str:
    """Issue a ConstraintWarning at the line of user code that called twoloop; return its text as a sentence."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("twoloop."):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, ConstraintWarning, stacklevel=level)
    return f" {text[0].upper()}{text[1:]}."


def _velocity_error_ratio(run: "Run", t: float, q: Array, v: Array) -> float:
    """Return the largest estimated error of v due to rounding of positions, divided by the tolerance of v."""
    allowed = run.tolerances[indices.ATOL :] + run.rtol * np.abs(v).max()
    return float((velocity_rounding_errors(run.system, t, q, v, run.rank) / allowed).max())


def _ratio_text(run: "Run", t: float, q: Array) -> str:
    ratio = singular_ratio(run.system, t, q, run.rank)
    return f"the smallest singular value of the constraint Jacobian is {ratio:.1g} of the largest"


def _describe_near_end(run: "Run", t1: float) -> str:
    """Return a sentence if a run stopped so near its end t1 that no step across a singular position fits; else ""."""
    time_left = t1 - float(run.clock[run.a.T])
    if time_left > max(NEAR_END * (t1 - run.t0), float(run.clock[run.a.H_LONG])):
        return ""
    return f" The end of t_span is {time_left:.1g} s ahead: end a little before that position, or beyond."


def _describe_near_singular(run: "Run", t1: float) -> str:
    """If the last state is near a singular position, return sentences that describe this position, else ""."""
    ratio = singular_ratio(run.system, float(run.clock[run.a.T]), run.state[: run.system.n_q], run.rank)
    if ratio > MAX_SINGULAR_RATIO:
        return ""
    return (
        f"The constraint Jacobian is close to losing rank there: its smallest singular value is "
        f"{ratio:.1g} of the largest. No step led across: {_REMEDIES}.{_describe_near_end(run, t1)} "
    )


def describe_not_finite(run: "Run") -> str:
    """Return a phrase that names the callback whose value is not finite, or, if none is found, the possible cause."""
    kind, fault_time = int(run.work.notes[indices.FAULT_KIND]), float(run.work.notes[indices.FAULT_TIME])
    if kind >= 0:
        name = run.kit.functions._fields[kind]
        return f"{name} of {run.system.name!r} returned a value that is not finite at t = {fault_time:.10g}"
    n, t = run.system.n_q, float(run.clock[run.a.T])
    q, v = run.state[:n], run.state[n : 2 * n]
    end = t + float(run.clock[run.a.H_FAILED])
    for instant in (t, end):
        reason = not_finite(run.system, instant, q, v)
        if reason is not None:
            return f"{reason} at t = {instant:.10g}"
    if run.plan.evaluates_within:
        return (
            "the callbacks are finite there, but not the Taylor series of the motion: one of their functions has "
            "no derivatives at this state (a root of zero, a norm of zero velocity), or its argument is too large "
            "(exp, tanh). Take 'auto' or 'DOP853', which evaluate the functions only"
        )
    return "the callbacks are finite at the start of the step, but not at a state within it"

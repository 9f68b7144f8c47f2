"""Hints at the likely cause of the errors of a simulator."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from twoloop.testing.mistakes import find_mistake
from twoloop.testing.problem import Array, Motion, Simulate, change_frame, run_simulator, to_original
from twoloop.testing.properties import (
    ORDER_SLACK,
    STEP_VIOLATION,
    Finding,
    Observation,
    Settings,
    constraint_forces,
    constraint_violations,
    convergence_order,
    error_limit,
    ignores_last_setting,
    multiplier_errors,
    observed_order,
    refinement_changes,
    remaining_error,
)

EXPLAINED = 0.1  # an explanation counts if it reduces the error to this fraction
POINTS_PER_INTERVAL = 20  # interpolation points per interval of a known motion


@dataclass(frozen=True, eq=False)
class Evidence:
    """Runs of a problem, the properties that failed, and the simulator for further runs."""

    observed: Observation
    settings: Settings
    failed: dict[str, Finding]
    simulate: Simulate

    @cached_property
    def position(self) -> Array:
        """Return the errors (n_t,) of the coordinates of the finest run."""
        return self.observed.errors("q")[-1]

    def is_wrong(self, kind: str) -> bool:
        """Return True if q or v (`kind`) failed: its limit with fixed steps, or its error with tolerances."""
        return bool({f"error of {kind}", f"limit of {kind}"} & set(self.failed))

    def explains(self, q: Array) -> bool:
        """Return True if coordinates q (n_t, n_q), in place of those of the finest run, have a much smaller error."""
        motion = self.observed.motion
        remaining = np.abs(q - motion.q).max(axis=1) / motion.scales[0]
        return bool(remaining.max() < EXPLAINED * self.position.max())

    @cached_property
    def early_order(self) -> float | None:
        """Return the order of q over the last refinement, while the errors are small."""
        return self.order_of("q", 1) if len(self.observed.runs) > 1 else None

    def order_of(self, kind: str, refinement: int) -> float | None:
        """Return the observed order of q or v over a refinement; refinement 1 is the last one."""
        coarse, fine = self.observed.errors(kind)[-refinement - 1 :][:2]
        coarse_step, fine_step = self.observed.settings[-refinement - 1 :][:2]
        floor = self.observed.rounding + self.observed.floor(kind)
        return convergence_order(coarse, fine, coarse_step / fine_step, floor)


def _output_hint(e: Evidence) -> str:
    """Return a hint for states that are right but returned wrongly."""
    if not e.is_wrong("q"):
        return ""
    q, motion, kinds = e.observed.runs[-1].q, e.observed.motion, e.observed.problem.coordinates
    if np.ptp(q, axis=0).max() == 0.0:
        return "Nothing moves: every row is the same."
    for shift, word in ((1, "late"), (-1, "early")):
        rows = np.arange(1, len(q) - 1) + shift  # rows without the two ends, which lack a neighbour
        shifted_error = np.abs(q[rows] - motion.q[1:-1]).max() / motion.scales[0]
        if shifted_error < EXPLAINED * e.position[rows].max():
            return (
                f"The rows are one output time {word}: row k has to be the state at times[k], the first one the start."
            )
    angles = np.array([kind in ("angle", "relative") for kind in kinds])
    whole_turns = np.where(angles, 2.0 * np.pi * np.round((q - motion.q) / (2.0 * np.pi)), 0.0)
    if whole_turns.any() and e.explains(q - whole_turns):
        return "Angles differ by whole turns: they have to go on beyond pi, not jump back."
    euler = np.array([kind[0] == "e" for kind in kinds])
    same_sign = np.where(euler & (np.abs(q + motion.q) < np.abs(q - motion.q)), -q, q)
    if euler.any() and e.explains(same_sign):
        return "Euler parameters have the other sign: e and -e are one rotation, but q has to be continuous."
    return ""


def _time_shift_hint(e: Evidence) -> str:
    """Return a hint for states that are shifted in time, or belong to a clock that runs too fast or too slow."""
    run, motion = e.observed.runs[-1], e.observed.motion
    if run.v is None or not (e.is_wrong("q") or "order of q" in e.failed):
        return ""
    t0, late = motion.t[0], run.t - motion.t[0] > 0.05 * (motion.t[-1] - motion.t[0])
    state_times = _nearest_times(motion, run.q, run.v)
    ratio = float(np.median((state_times - t0)[late] / (run.t - t0)[late]))
    shift = float(np.median((run.t - state_times)[late]))
    step = e.observed.settings[-1] if e.settings.steps is not None else np.inf
    step_text = ", a step" if abs(abs(shift) / step - 1.0) < EXPLAINED else ""
    word = "earlier" if shift > 0.0 else "later"
    wrong_clock = (
        f"The motion is right and its clock is not: it goes {ratio:.3g} times as fast. The steps do not add up to the "
        "time between the times (one is cut short, made longer, or left out)."
    )
    explanations = {
        wrong_clock: t0 + ratio * (run.t - t0),
        f"The states are those of {abs(shift):.2g} s{step_text}, {word}.": run.t - shift,
    }
    errors = [run_errors[late].max() for run_errors in (e.position, e.observed.errors("v")[-1])]
    rates = np.gradient(run.q, run.t, axis=0)
    for text, times in explanations.items():
        states = _interpolate(motion, np.clip(times, t0, motion.t[-1]))
        comparison = zip((run.q, run.v), states, motion.scales, errors, strict=True)
        if all(np.abs(a - b)[late].max() / scale < EXPLAINED * error for a, b, scale, error in comparison):
            # with a wrong clock, velocities are not the rates of the positions; with wrong forces, they are
            defect, scaled_defect = (np.linalg.norm((rates - factor * run.v)[late]) for factor in (1.0, ratio))
            if text is not wrong_clock or scaled_defect < 0.5 * defect:
                return text
    return ""


def _interpolation_hint(e: Evidence) -> str:
    """Return a hint for states that are right at the end of a run, and wrong at times within the run."""
    if e.settings.tolerances is None:
        return ""
    run, motion = e.observed.runs[-1], e.observed.motion
    for k in np.argsort(-e.position)[:3]:  # repeat the run, with its end at each of the three worst times
        try:
            short = run_simulator(e.simulate, e.observed.problem, motion.t[: k + 1], e.observed.settings[-1])
        except (TypeError, ValueError):  # the simulator accepts no other times than those of the motion
            return ""
        short_error, long_error = (np.abs(states - motion.q[k]).max() for states in (short.q[-1], run.q[k]))
        if k < 2 or not short_error < EXPLAINED * long_error:  # also if it is not finite
            return ""
    return (
        "Right where a run ends, and wrong at the same times within a longer one: the states between the steps are "
        "interpolated too coarsely (linearly?). End a step at each of the times, or interpolate by values and rates."
    )


def _interpolate(motion: Motion, times: Array) -> tuple[Array, Array]:
    """Interpolate the states of a motion by cubic Hermite polynomials and their derivatives."""
    k = np.clip(np.searchsorted(motion.t, times) - 1, 0, motion.t.size - 2)
    h = (motion.t[k + 1] - motion.t[k])[:, None]
    x = (times - motion.t[k])[:, None] / h
    q, end, v, end_v = motion.q[k], motion.q[k + 1], h * motion.v[k], h * motion.v[k + 1]
    square, cube = 3.0 * (end - q) - 2.0 * v - end_v, 2.0 * (q - end) + v + end_v
    return q + x * (v + x * (square + x * cube)), (v + x * (2.0 * square + 3.0 * x * cube)) / h


def _nearest_times(motion: Motion, q: Array, v: Array) -> Array:
    """Return the times (n,) at which a motion is nearest to states (n, n_q)."""
    times = np.linspace(motion.t[0], motion.t[-1], POINTS_PER_INTERVAL * (motion.t.size - 1) + 1)
    path = np.hstack([part / scale for part, scale in zip(_interpolate(motion, times), motion.scales, strict=True)])
    path_rates, targets = np.gradient(path, times, axis=0), np.hstack([q / motion.scales[0], v / motion.scales[1]])
    nearest = np.array([np.argmin(np.abs(path - target).max(axis=1)) for target in targets])
    offsets = ((targets - path[nearest]) * path_rates[nearest]).sum(axis=1) / (path_rates[nearest] ** 2).sum(axis=1)
    half = 0.5 * (times[1] - times[0])
    return np.asarray(times[nearest] + np.clip(offsets, -half, half), dtype=float)


def _constraint_rate_hint(e: Evidence) -> str:
    """Return a hint for velocities that satisfy C_q v + C_t = 0 without C_t, or with terms of the previous step."""
    problem, run = e.observed.problem, e.observed.runs[-1]
    if run.v is None or not {"velocity constraints", "order of v", "limit of v"} & set(e.failed):
        return ""
    states = list(zip(run.t, run.q, run.v, strict=True))[1:]
    rates = np.array([problem.constraint_rate(t, q) for t, q, _ in states])
    normal_velocities = np.array([problem.jacobian(t, q) @ v for t, q, v in states])
    violation = np.abs(normal_velocities + rates).max()
    if rates.any() and np.abs(normal_velocities).max() < EXPLAINED * violation:
        return "The velocities obey C_q v = 0 where the constraints move: C_t is left out of C_q v + C_t = 0."
    if e.settings.steps is None or violation < STEP_VIOLATION:
        return ""
    h = e.observed.settings[-1]
    old_rates = np.array([problem.constraint_rate(t - h, q - h * v) for t, q, v in states])
    old_velocities = np.array([problem.jacobian(t - h, q - h * v) @ v for t, q, v in states])
    alternatives = {
        "C_t": normal_velocities + old_rates,
        "C_q": old_velocities + rates,
        "C_q and C_t": old_velocities + old_rates,
    }
    name = min(alternatives, key=lambda term: float(np.abs(alternatives[term]).max()))
    if np.abs(alternatives[name]).max() > 2.0 * EXPLAINED * violation:
        return ""
    return f"The velocities obey C_q v + C_t = 0 with {name} of one step before: take them at (t + h, q) of its end."


def _clock_hint(e: Evidence) -> str:
    """Return a hint for constraints that hold at a time other than the time of the state."""
    problem, run = e.observed.problem, e.observed.runs[-1]
    if "constraints" not in e.failed:
        return ""
    t0, steps = problem.t_span[0], list[float]()
    if e.settings.steps is not None:
        h = e.observed.settings[-1]
        half_steps = round(2.0 * (run.t[1] - run.t[0]) / h)
        steps = [0.5 * h * k for k in range(-half_steps, half_steps + 1)]
    states = list(zip(run.t[1:], run.q[1:], strict=True))

    def violation(shift: float) -> float:
        return float(max(np.abs(problem.constraint(t - shift, q)).max() for t, q in states))

    shift = min([t0, *steps], key=violation)
    if not violation(shift) < EXPLAINED * violation(0.0):
        return ""
    if shift == t0:
        return f"The constraints hold at t - {t0:g} s: time does not begin at 0 here, but at t_span[0] = times[0]."
    n_steps, word = abs(shift) / e.observed.settings[-1], "earlier" if shift > 0.0 else "later"
    return (
        f"C = 0 holds at another instant than that of the state, {n_steps:g} step{'s' * (n_steps != 1.0)} {word}: "
        "t is not advanced with the state, or twice."
    )


def _singular_hint(e: Evidence) -> str:
    problem, motion = e.observed.problem, e.observed.motion
    if not problem.singular_times or not e.is_wrong("q"):
        return ""
    first = problem.singular_times[0]
    early_error = e.position[motion.t < first - 0.02 * (motion.t[-1] - motion.t[0])].max()
    if early_error < EXPLAINED * min(e.position.max(), 1.0):
        return (
            f"Right until the first singular position (t = {first:.3g} s), where C_q loses rank: the run takes another "
            "branch there, or solves a singular matrix. Follow positions and velocities through, or stop."
        )
    return ""


def _acceleration_hint(e: Evidence) -> str:
    if not e.is_wrong("q") and not e.is_wrong("v"):
        return ""
    options = {"by_steps": e.settings.steps is not None, "fit": not _error_decreases(e)}
    mistake = find_mistake(e.simulate, e.observed.problem, e.observed.settings[-1], **options)
    return f"The accelerations are wrong: {mistake}." if mistake else ""


def _velocity_order_is_lower(e: Evidence) -> bool:
    """Return True if velocities converge with one order less than positions."""
    orders = [observed_order(e.observed, kind) for kind in "qv"] if "order of v" in e.failed else []
    return len(orders) == 2 and None not in orders and float(orders[1] or 0.0) < float(orders[0] or 0.0) - 0.5


def _velocity_hint(e: Evidence) -> str:
    run, motion, problem = e.observed.runs[-1], e.observed.motion, e.observed.problem
    if run.v is None or e.is_wrong("q") or "order of q" in e.failed:
        return ""
    if not (e.is_wrong("v") or _velocity_order_is_lower(e)):
        return ""
    a = np.array([problem.acceleration(*state)[0] for state in zip(motion.t, motion.q, motion.v, strict=True)])
    alternatives = {
        "The velocities have the other sign.": -motion.v,
        "The velocities are those of the output time before.": np.vstack([motion.v[:1], motion.v[:-1]]),
    }
    if e.settings.steps is not None:
        h = e.observed.settings[-1]
        middle = "The velocities are those of the middle of the step {}: bring them to its end with half a step of a."
        alternatives |= {
            middle.format("before"): motion.v - 0.5 * h * a,
            middle.format("after"): motion.v + 0.5 * h * a,
            "The velocities are those of one step before.": motion.v - h * a,
            "The velocities are those of one step later.": motion.v + h * a,
        }
    start = max(1, motion.t.size // 20)
    error = np.linalg.norm((run.v - motion.v)[start:])
    for text, velocities in alternatives.items():
        if np.linalg.norm((run.v - velocities)[start:]) < 2.0 * EXPLAINED * error:
            return f"Positions are right and velocities are not. {text}"
    if e.settings.tolerances and e.observed.errors("v")[-1].max() < EXPLAINED * e.observed.errors("v")[0].max():
        return ""  # the velocities converge
    violated = "velocity constraints" in e.failed
    advice = " They do not obey C_q v + C_t = 0 either: project them." if violated else ""
    return (
        "Positions are right and velocities are not: they belong to another time, or not to the final "
        f"iteration, or were not corrected with the positions.{advice}"
    )


GROWING_ERROR = (
    "as the steps become shorter: each step adds the same, however short (a factor on the velocities, a sign in a "
    "projection, an iteration with a tolerance of its own, single precision)."
)


def _drift_hint(e: Evidence) -> str:
    if "constraints" not in e.failed:
        return ""
    problem, scales = e.observed.problem, e.observed.motion.scales
    violations = [constraint_violations(problem, run, scales)[0] for run in e.observed.runs]
    significant = [violation for violation in violations if violation.max() > STEP_VIOLATION]
    if all(violation[-30:].max() > 4.0 * violation[1:11].max() for violation in significant):
        return (
            "The violation of C grows along the run: only accelerations (or velocities) obey the constraints. Project "
            "positions and velocities after each step, or stabilise (GGL; Baumgarte leaves a rest)."
        )
    if e.settings.steps is not None and violations[-2].max() > 1.5 * violations[-1].max():
        return (
            "The violation of C falls with the steps and does not grow along the run: C = 0 is asked for at another "
            "instant than that of the state (t instead of t + h?), of a state that is changed afterwards, by too few "
            "iterations, or only for its derivatives (Baumgarte)."
        )
    return (
        "The violation of C is there from the first steps and does not grow: an iteration for the positions stops too "
        "early, with a tolerance of its own or in single precision, or a penalty or regularisation stands in for C = 0."
    )


def _unused_hint(e: Evidence) -> str:
    runs, settings = e.observed.runs, e.observed.settings
    if not ignores_last_setting(e.observed):
        return ""
    if np.array_equal(runs[0].q, runs[-1].q):
        return (
            "The same numbers whatever the tolerance, or the step: it is not used; or every interval between two times "
            "is one step at all of them, and the equations or the projection at its end are wrong."
        )
    return (
        f"The same numbers at {settings[-2]:.3g} and at {settings[-1]:.3g}: a bound of its own keeps the steps longer."
    )


def _error_decreases(e: Evidence) -> bool:
    """Return True if the error of q keeps decreasing."""
    errors = e.observed.errors("q")
    if e.settings.tolerances is not None:
        return len(errors) < 2 or errors[-1].max() <= 0.3 * errors[0].max()
    if "error of q" in e.failed:  # while the error is small
        return e.early_order is not None and e.early_order > 0.5
    value, limit = remaining_error(errors, refinement_changes(e.observed, "q"), e.observed.floor("q"))
    return value <= limit and errors[-1].max() < 0.8 * errors[-2].max()


def _floor_hint(e: Evidence) -> str:
    if not {"limit of q", "limit of v"} & set(e.failed) and (not e.is_wrong("q") or _error_decreases(e)):
        return ""
    errors = [run_errors.max() for run_errors in e.observed.errors("q")]
    if e.settings.steps is not None and errors[-1] > 1.5 * errors[-2]:
        return f"The error grows from {errors[-2]:.1g} to {errors[-1]:.1g} {GROWING_ERROR}"
    return (
        f"The error stays at {e.position.max():.1g}, however fine: not the method but the model is wrong "
        "(a mass, a force, a sign), or an iteration, a difference quotient or a penalty ends it."
    )


def _coarse_hint(e: Evidence) -> str:
    if e.settings.steps is None or not {"error of q", "error of v"} & set(e.failed):
        return ""
    errors, order, expected = e.observed.errors("q"), e.early_order, e.settings.order
    if order is not None and expected is not None and order < expected - ORDER_SLACK:
        return f"While it is small, {_order_hint(e, 'q', order)}"
    return (
        f"The error falls, from {errors[-2].max():.1g} to {errors[-1].max():.1g} by the last refinement, and is "
        "still too large: take more steps."
    )


def _low_order_hint(e: Evidence) -> str:
    failures = [e.failed[name] for name in ("order of q", "order of v") if name in e.failed]
    if not failures:
        return ""
    text = _order_hint(e, failures[0].property.removeprefix("order of "), float(failures[0].measured))
    return text[0].upper() + text[1:]


def _order_hint(e: Evidence, kind: str, order: float) -> str:
    """Return the likely cause of an observed order that is too small."""
    error_name, expected = f"the error of {kind}", e.settings.order
    previous = e.order_of(kind, 2) if len(e.observed.runs) > 2 else None
    if order < -0.5:
        return f"{error_name} grows with the order {order:.1f} {GROWING_ERROR}"
    if order < 0.5 or (previous is not None and order < previous - 0.4):
        sinks = "no longer falls" if order < 0.5 else "falls more and more slowly"
        return (
            f"{error_name} {sinks} (order {order:.1f}): beside the method's error there is one that no step removes "
            "(a small error of the model, a damping, an iteration that stops early)."
        )
    one_lower = expected is not None and abs(expected - 1.0 - order) < 0.4
    text = f"{error_name} falls with the order {order:.1f}{'' if expected is None else f' instead of {expected:g}'}"
    text += ", one less: a coefficient is wrong, or a term is taken at another time." if one_lower else "."
    if order < 1.4:
        text += " First order: something is that of the start of the step (time, velocity, matrix, force)."
    return text


def _tolerance_hint(e: Evidence) -> str:
    if e.settings.tolerances is None or not (e.is_wrong("q") or e.is_wrong("v")):
        return ""
    failures = [finding for finding in e.failed.values() if finding.property.startswith("error of")]
    excess = max(float(finding.measured) / float(finding.allowed) for finding in failures)
    return (
        f"The error falls with the tolerance, and is {excess:.1g} times what is allowed: the estimate of the "
        "error is too small, or leaves out some coordinates, or the tolerance is not passed on."
    )


WRONG_INSTANT = (
    "The multipliers belong to another instant (the middle of the step?) or to other positions and velocities than "
    "those returned, or some rows of C are numbered otherwise."
)


def _multiplier_hint(e: Evidence) -> str:
    problem, motion = e.observed.problem, e.observed.motion
    worst = int(np.argmax([errors.max() for errors in multiplier_errors(e.observed)]))
    run = e.observed.runs[worst]
    if run.lam is None:
        return ""
    reference = constraint_forces(problem, motion, motion.lam)[1:]
    computed = constraint_forces(problem, motion, run.lam)[1:]
    factor = float((computed * reference).sum() / (reference**2).sum())
    if np.abs(computed - factor * reference).max() > 2.0 * EXPLAINED * np.abs(computed - reference).max():
        return WRONG_INSTANT
    if abs(factor + 1.0) < EXPLAINED:
        return "The multipliers have the other sign: M a + C_q^T lam = Q."
    if e.settings.steps is not None:
        h = e.observed.settings[worst]
        for exponent, name in ((1, "h"), (2, "h^2")):
            for share, word in ((1.0, ""), (0.5, " / 2")):
                for sign, minus in ((1.0, ""), (-1.0, "-")):
                    if abs(factor / (sign * share * h**exponent) - 1.0) < EXPLAINED:
                        return f"The multipliers are impulses: {minus}{name}{word} times the forces. Divide by it."
    return f"The multipliers are {factor:.3g} times those of M a + C_q^T lam = Q."


def _frame_hint(e: Evidence) -> str:
    n, motion = len(e.observed.settings) // 2, e.observed.motion
    middle, limit = e.observed.settings[n], 30.0 * e.observed.errors("q")[n].max() + 1e-6
    if e.settings.tolerances:
        limit = max(limit, float(error_limit(motion, middle).max()))
    failed = []
    for name, angle, distance in (("turned", 0.7, 0.0), ("moved", 0.0, 1.0)):
        transformed = change_frame(e.observed.problem, angle, distance)
        run = to_original(run_simulator(e.simulate, transformed.problem, motion.t, middle), transformed)
        error = np.abs(run.q - motion.q).max() / motion.scales[0] if run.complete else np.inf
        if error > limit:
            failed.append(name)
    if failed == ["turned"]:
        return (
            "Wrong in a turned frame, right in a moved one: a direction is fixed in the code (gravity, an axis of a "
            "joint or of inertia, an angle from the x axis)."
        )
    if failed == ["moved"]:
        return (
            "Wrong in a moved frame, right in a turned one: something depends on the distance from the origin (a "
            "tolerance relative to q, a moment about the origin, a place that is fixed in the code)."
        )
    return "Wrong in another frame: a direction, a place or a tolerance is fixed in the code."


def _units_hint(e: Evidence) -> str:
    outcome = "fails" if isinstance(e.failed["units"].measured, str) else "is wrong"
    return (
        f"The simulator is right in m and kg and {outcome} in mm and g: a constant in the code has a unit (an absolute "
        "tolerance, a penalty, a regularisation, the acceleration of gravity, a step of differences), or a matrix of "
        "mixed units is solved without scaling."
    )


def _precision_hint(e: Evidence) -> str:
    return (
        "All states are numbers of single precision, which has 7 digits and cannot hold such a tolerance: look for "
        "float32 among the arrays, or in the settings of the simulator."
    )


def _velocity_projection_hint(e: Evidence) -> str:
    if "velocity constraints" not in e.failed:
        return ""
    return (
        "The velocities do not obey C_q v + C_t = 0, and shorter steps do not reduce the violation: project "
        "them after each step; where that is done, it ends too early, is in single precision, or takes C_q or C_t of "
        "another instant."
    )


def _departure_hint(e: Evidence) -> str:
    """Return, as a last resort, the time from which the motion is wrong."""
    motion = e.observed.motion
    wrong_times = np.flatnonzero(e.position > 0.01)
    if not wrong_times.size:
        return ""
    return (
        f"Off by 1 % from t = {motion.t[wrong_times[0]]:.3g} s on, of {motion.t[-1]:.3g} s. "
        "Compare accelerations there with problem.acceleration(t, q, v)."
    )


# the first rule that applies is the hint; the order is from certain causes to causes that fit any error
MOTION_HINTS: tuple[Callable[[Evidence], str], ...] = (
    *(_output_hint, _time_shift_hint, _singular_hint, _constraint_rate_hint, _acceleration_hint, _velocity_hint),
    *(_clock_hint, _unused_hint, _interpolation_hint, _drift_hint, _floor_hint, _low_order_hint, _coarse_hint),
    *(_tolerance_hint, _velocity_projection_hint, _departure_hint),
)
PROPERTY_HINTS: dict[str, Callable[[Evidence], str]] = {
    **{"multipliers": _multiplier_hint, "frame": _frame_hint, "units": _units_hint, "precision": _precision_hint}
}
MOTION_PROPERTIES = ("error of", "limit of", "order of")  # prefixes of properties of the motion itself


def add_hints(findings: list[Finding], evidence: Evidence) -> list[Finding]:
    """Return the findings with hints added to the failures."""
    general = ""
    if any(name not in PROPERTY_HINTS for name in evidence.failed):
        general = next((text for rule in MOTION_HINTS if (text := rule(evidence))), "")
    motion_fails = any(name.startswith(MOTION_PROPERTIES) for name in evidence.failed)
    hinted = []
    for finding in findings:
        if not finding.passed and finding.property not in ("runs", "says that it ends"):
            rule = PROPERTY_HINTS.get(finding.property)
            text = rule(evidence) if rule else general
            finding = replace(finding, hint=general if motion_fails and text == WRONG_INSTANT else text)
        hinted.append(finding)
    return hinted

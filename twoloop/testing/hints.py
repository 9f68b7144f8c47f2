"""Hints at the likely cause of the errors of a simulator."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from twoloop.testing.changes import in_a_frame
from twoloop.testing.evidence import CLEAR, Evidence
from twoloop.testing.findings import Finding
from twoloop.testing.instants import between_steps, clock, rates_of_time, returned, shifted_in_time
from twoloop.testing.measuring import HELD_BY_STEPS, allowed, forces_of_constraints, lam_errors, still_there, violations
from twoloop.testing.mistakes import mistaken_acceleration
from twoloop.testing.properties import SHORT, changes_of, observed_order, same_at_last
from twoloop.testing.simulated import simulated, transformed_back


def _singular(e: Evidence) -> str:
    problem, motion = e.observed.problem, e.observed.motion
    if not problem.singular_times or not e.wrong("q"):
        return ""
    first = problem.singular_times[0]
    before = e.position[motion.t < first - 0.02 * (motion.t[-1] - motion.t[0])].max()
    if before < CLEAR * min(e.position.max(), 1.0):
        return (
            f"Right until the first singular position (t = {first:.3g} s), where C_q loses rank: the run takes another "
            "branch there, or solves a singular matrix. Follow positions and velocities through, or stop."
        )
    return ""


def _acceleration(e: Evidence) -> str:
    if not e.wrong("q") and not e.wrong("v"):
        return ""
    by_steps, fit = e.settings.steps is not None, not _falls(e)
    asked = (e.simulate, e.observed.problem, e.observed.settings[-1])
    mistake = mistaken_acceleration(*asked, by_steps=by_steps, fit=fit)
    return f"The accelerations are wrong: {mistake}." if mistake else ""


def _one_order_less(e: Evidence) -> bool:
    """Return True if velocities converge with one order less than positions."""
    orders = [observed_order(e.observed, kind) for kind in "qv"] if "order of v" in e.failed else []
    return len(orders) == 2 and None not in orders and float(orders[1] or 0.0) < float(orders[0] or 0.0) - 0.5


def _velocities(e: Evidence) -> str:
    run, motion, problem = e.observed.runs[-1], e.observed.motion, e.observed.problem
    if run.v is None or e.wrong("q") or "order of q" in e.failed or not (e.wrong("v") or _one_order_less(e)):
        return ""
    a = np.array([problem.acceleration(*state)[0] for state in zip(motion.t, motion.q, motion.v, strict=True)])
    others = {
        "The velocities have the other sign.": -motion.v,
        "The velocities are those of the output time before.": np.vstack([motion.v[:1], motion.v[:-1]]),
    }
    if e.settings.steps is not None:
        h = e.observed.settings[-1]
        middle = "The velocities are those of the middle of the step {}: bring them to its end with half a step of a."
        others |= {
            middle.format("before"): motion.v - 0.5 * h * a,
            middle.format("after"): motion.v + 0.5 * h * a,
            "The velocities are those of one step before.": motion.v - h * a,
            "The velocities are those of one step later.": motion.v + h * a,
        }
    start = max(1, motion.t.size // 20)
    error = np.linalg.norm((run.v - motion.v)[start:])
    for text, other in others.items():
        if np.linalg.norm((run.v - other)[start:]) < 2.0 * CLEAR * error:
            return f"Positions are right and velocities are not. {text}"
    if e.settings.tolerances and e.observed.errors("v")[-1].max() < CLEAR * e.observed.errors("v")[0].max():
        return ""  # they converge
    held = "" if "velocity constraints" not in e.failed else " They do not obey C_q v + C_t = 0 either: project them."
    return (
        "Positions are right and velocities are not: they belong to another time, or not to the final "
        f"iteration, or were not corrected with the positions.{held}"
    )


GROWS = (
    "as the steps become shorter: each step adds the same, however short (a factor on the velocities, a sign in a "
    "projection, an iteration with a tolerance of its own, single precision)."
)


def _drift(e: Evidence) -> str:
    if "constraints" not in e.failed:
        return ""
    found = [violations(e.observed.problem, run, e.observed.motion.scales)[0] for run in e.observed.runs]
    off = found[-1]
    if all(each[-30:].max() > 4.0 * each[1:11].max() for each in found if each.max() > HELD_BY_STEPS):
        return (
            "The violation of C grows along the run: only accelerations (or velocities) obey the constraints. Project "
            "positions and velocities after each step, or stabilise (GGL; Baumgarte leaves a rest)."
        )
    if e.settings.steps is not None and found[-2].max() > 1.5 * off.max():
        return (
            "The violation of C falls with the steps and does not grow along the run: C = 0 is asked for at another "
            "instant than that of the state (t instead of t + h?), of a state that is changed afterwards, by too few "
            "iterations, or only for its derivatives (Baumgarte)."
        )
    return (
        "The violation of C is there from the first steps and does not grow: an iteration for the positions stops too "
        "early, with a tolerance of its own or in single precision, or a penalty or regularisation stands in for C = 0."
    )


def _unused(e: Evidence) -> str:
    runs, settings = e.observed.runs, e.observed.settings
    if not same_at_last(e.observed):
        return ""
    if np.array_equal(runs[0].q, runs[-1].q):
        return (
            "The same numbers whatever the tolerance, or the step: it is not used; or every interval between two times "
            "is one step at all of them, and the equations or the projection at its end are wrong."
        )
    return (
        f"The same numbers at {settings[-2]:.3g} and at {settings[-1]:.3g}: a bound of its own keeps the steps longer."
    )


def _falls(e: Evidence) -> bool:
    """Return True if the error of q keeps decreasing."""
    errors = e.observed.errors("q")
    if e.settings.tolerances is not None:
        return len(errors) < 2 or errors[-1].max() <= 0.3 * errors[0].max()
    if "error of q" in e.failed:  # while the error is small
        return e.early_order is not None and e.early_order > 0.5
    value, rest = still_there(errors, changes_of(e.observed, "q"), e.observed.floor("q"))
    return value <= rest and errors[-1].max() < 0.8 * errors[-2].max()


def _floor(e: Evidence) -> str:
    if not {"limit of q", "limit of v"} & set(e.failed) and (not e.wrong("q") or _falls(e)):
        return ""
    errors = [each.max() for each in e.observed.errors("q")]
    if e.settings.steps is not None and errors[-1] > 1.5 * errors[-2]:
        return f"The error grows from {errors[-2]:.1g} to {errors[-1]:.1g} {GROWS}"
    return (
        f"The error stays at {e.position.max():.1g}, however fine: not the method but the model is wrong "
        "(a mass, a force, a sign), or an iteration, a difference quotient or a penalty ends it."
    )


def _coarse(e: Evidence) -> str:
    if e.settings.steps is None or not {"error of q", "error of v"} & set(e.failed):
        return ""
    errors, seen, said = e.observed.errors("q"), e.early_order, e.settings.order
    if seen is not None and said is not None and seen < said - SHORT:
        return f"While it is small, {_order_seen(e, 'q', seen)}"
    return (
        f"The error falls, from {errors[-2].max():.1g} to {errors[-1].max():.1g} by the last refinement, and is "
        "still too large: take more steps."
    )


def _orders(e: Evidence) -> str:
    lost = [e.failed[name] for name in ("order of q", "order of v") if name in e.failed]
    if not lost:
        return ""
    text = _order_seen(e, lost[0].property.removeprefix("order of "), float(lost[0].measured))
    return text[0].upper() + text[1:]


def _order_seen(e: Evidence, kind: str, seen: float) -> str:
    """Return the likely cause of an observed order that is too small."""
    what, said = f"the error of {kind}", e.settings.order
    before = e.order_of(kind, 2) if len(e.observed.runs) > 2 else None
    if seen < -0.5:
        return f"{what} grows with the order {seen:.1f} {GROWS}"
    if seen < 0.5 or (before is not None and seen < before - 0.4):
        sinks = "no longer falls" if seen < 0.5 else "falls more and more slowly"
        return (
            f"{what} {sinks} (order {seen:.1f}): beside the method's error there is one that no step removes "
            "(a small error of the model, a damping, an iteration that stops early)."
        )
    lost = said is not None and abs(said - 1.0 - seen) < 0.4
    text = f"{what} falls with the order {seen:.1f}{'' if said is None else f' instead of {said:g}'}"
    text += ", one less: a coefficient is wrong, or a term is taken at another time." if lost else "."
    if seen < 1.4:
        text += " First order: something is that of the start of the step (time, velocity, matrix, force)."
    return text


def _slack(e: Evidence) -> str:
    if e.settings.tolerances is None or not (e.wrong("q") or e.wrong("v")):
        return ""
    worst = [each for each in e.failed.values() if each.property.startswith("error of")]
    over = max(float(each.measured) / float(each.allowed) for each in worst)
    return (
        f"The error falls with the tolerance, and is {over:.1g} times what is allowed: the estimate of the "
        "error is too small, or leaves out some coordinates, or the tolerance is not passed on."
    )


OTHER_MULTIPLIERS = (
    "The multipliers belong to another instant (the middle of the step?) or to other positions and velocities than "
    "those returned, or some rows of C are numbered otherwise."
)


def _multipliers(e: Evidence) -> str:
    problem, motion = e.observed.problem, e.observed.motion
    worst = int(np.argmax([errors.max() for errors in lam_errors(e.observed)]))
    run = e.observed.runs[worst]
    if run.lam is None:
        return ""
    known = forces_of_constraints(problem, motion, motion.lam)[1:]
    found = forces_of_constraints(problem, motion, run.lam)[1:]
    factor = float((found * known).sum() / (known**2).sum())
    if np.abs(found - factor * known).max() > 2.0 * CLEAR * np.abs(found - known).max():
        return OTHER_MULTIPLIERS
    if abs(factor + 1.0) < CLEAR:
        return "The multipliers have the other sign: M a + C_q^T lam = Q."
    if e.settings.steps is not None:
        h = e.observed.settings[worst]
        for power, name in ((1, "h"), (2, "h^2")):
            for part, word in ((1.0, ""), (0.5, " / 2")):
                for sign, minus in ((1.0, ""), (-1.0, "-")):
                    if abs(factor / (sign * part * h**power) - 1.0) < CLEAR:
                        return f"The multipliers are impulses: {minus}{name}{word} times the forces. Divide by it."
    return f"The multipliers are {factor:.3g} times those of M a + C_q^T lam = Q."


def _frame(e: Evidence) -> str:
    n, motion = len(e.observed.settings) // 2, e.observed.motion
    middle, least = e.observed.settings[n], 30.0 * e.observed.errors("q")[n].max() + 1e-6
    if e.settings.tolerances:
        least = max(least, float(allowed(motion, middle).max()))
    wrong = []
    for name, turn, move in (("turned", 0.7, 0.0), ("moved", 0.0, 1.0)):
        seen = in_a_frame(e.observed.problem, turn, move)
        run = transformed_back(simulated(e.simulate, seen.problem, motion.t, middle), seen)
        error = np.abs(run.q - motion.q).max() / motion.scales[0] if run.complete else np.inf
        if error > least:
            wrong.append(name)
    if wrong == ["turned"]:
        return (
            "Wrong in a turned frame, right in a moved one: a direction is fixed in the code (gravity, an axis of a "
            "joint or of inertia, an angle from the x axis)."
        )
    if wrong == ["moved"]:
        return (
            "Wrong in a moved frame, right in a turned one: something depends on the distance from the origin (a "
            "tolerance relative to q, a moment about the origin, a place that is fixed in the code)."
        )
    return "Wrong in another frame: a direction, a place or a tolerance is fixed in the code."


def _units(e: Evidence) -> str:
    how = "fails" if isinstance(e.failed["units"].measured, str) else "is wrong"
    return (
        f"The simulator is right in m and kg and {how} in mm and g: a constant in the code has a unit (an absolute "
        "tolerance, a penalty, a regularisation, the acceleration of gravity, a step of differences), or a matrix of "
        "mixed units is solved without scaling."
    )


def _precision(e: Evidence) -> str:
    return (
        "All states are numbers of single precision, which has 7 digits and cannot hold such a tolerance: look for "
        "float32 among the arrays, or in the settings of the simulator."
    )


def _rates(e: Evidence) -> str:
    if "velocity constraints" not in e.failed:
        return ""
    return (
        "The velocities do not obey C_q v + C_t = 0, and shorter steps do not reduce the violation: project "
        "them after each step; where that is done, it ends too early, is in single precision, or takes C_q or C_t of "
        "another instant."
    )


def _where(e: Evidence) -> str:
    """Return, as a last resort, the time from which the motion is wrong."""
    motion = e.observed.motion
    off = np.flatnonzero(e.position > 0.01)
    if not off.size:
        return ""
    return (
        f"Off by 1 % from t = {motion.t[off[0]]:.3g} s on, of {motion.t[-1]:.3g} s. Compare accelerations there with "
        "problem.acceleration(t, q, v)."
    )


MOTION: tuple[Callable[[Evidence], str], ...] = (
    *(returned, shifted_in_time, _singular, rates_of_time, _acceleration, _velocities, clock, _unused, between_steps),
    *(_drift, _floor, _orders, _coarse, _slack, _rates, _where),
)
OWN: dict[str, Callable[[Evidence], str]] = {
    **{"multipliers": _multipliers, "frame": _frame, "units": _units, "precision": _precision}
}
MOVING = ("error of", "limit of", "order of")  # prefixes of properties of the motion itself


def with_hints(findings: list[Finding], evidence: Evidence) -> list[Finding]:
    """Return the findings with hints added to the failures."""
    general = ""
    if any(name not in OWN for name in evidence.failed):
        general = next((text for rule in MOTION if (text := rule(evidence))), "")
    moved = any(name.startswith(MOVING) for name in evidence.failed)
    hinted = []
    for finding in findings:
        if not finding.passed and finding.property not in ("runs", "says that it ends"):
            own = OWN.get(finding.property)
            text = own(evidence) if own else general
            finding = replace(finding, hint=general if moved and text == OTHER_MULTIPLIERS else text)
        hinted.append(finding)
    return hinted

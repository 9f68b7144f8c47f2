"""Hints for states, rates or drives that belong to another time."""

import numpy as np

from twoloop.testing.evidence import CLEAR, Evidence
from twoloop.testing.known_problem import Array, Motion
from twoloop.testing.measuring import HELD_BY_STEPS
from twoloop.testing.simulated import simulated

DENSE = 20  # interpolation points per interval of a known motion


def returned(e: Evidence) -> str:
    """Return a hint for states that are right but returned wrongly."""
    if not e.wrong("q"):
        return ""
    q, motion, kinds = e.observed.runs[-1].q, e.observed.motion, e.observed.problem.coordinates
    if np.ptp(q, axis=0).max() == 0.0:
        return "Nothing moves: every row is the same."
    for shift, word in ((1, "late"), (-1, "early")):
        rows = np.arange(1, len(q) - 1) + shift  # an end has no row beside it
        moved = np.abs(q[rows] - motion.q[1:-1]).max() / motion.scales[0]
        if moved < CLEAR * e.position[rows].max():
            return (
                f"The rows are one output time {word}: row k has to be the state at times[k], the first one the start."
            )
    angles = np.array([kind in ("angle", "relative") for kind in kinds])
    turns = np.where(angles, 2.0 * np.pi * np.round((q - motion.q) / (2.0 * np.pi)), 0.0)
    if turns.any() and e.clears(q - turns):
        return "Angles differ by whole turns: they have to go on beyond pi, not jump back."
    euler = np.array([kind[0] == "e" for kind in kinds])
    nearer = np.where(euler & (np.abs(q + motion.q) < np.abs(q - motion.q)), -q, q)
    if euler.any() and e.clears(nearer):
        return "Euler parameters have the other sign: e and -e are one rotation, but q has to be continuous."
    return ""


def shifted_in_time(e: Evidence) -> str:
    """Return a hint for states shifted in time, or on a clock that runs fast or slow."""
    run, motion = e.observed.runs[-1], e.observed.motion
    if run.v is None or not (e.wrong("q") or "order of q" in e.failed):
        return ""
    begin, later = motion.t[0], run.t - motion.t[0] > 0.05 * (motion.t[-1] - motion.t[0])
    own = _nearest(motion, run.q, run.v)
    ratio = float(np.median((own - begin)[later] / (run.t - begin)[later]))
    shift = float(np.median((run.t - own)[later]))
    step = e.observed.settings[-1] if e.settings.steps is not None else np.inf
    of = ", a step" if abs(abs(shift) / step - 1.0) < CLEAR else ""
    word = "earlier" if shift > 0.0 else "later"
    slow = (
        f"The motion is right and its clock is not: it goes {ratio:.3g} times as fast. The steps do not add up to the "
        "time between the times (one is cut short, made longer, or left out)."
    )
    clocks = {
        slow: begin + ratio * (run.t - begin),
        f"The states are those of {abs(shift):.2g} s{of}, {word}.": run.t - shift,
    }
    errors = [each[later].max() for each in (e.position, e.observed.errors("v")[-1])]
    rates = np.gradient(run.q, run.t, axis=0)
    for text, at in clocks.items():
        known = _between(motion, np.clip(at, begin, motion.t[-1]))
        found = zip((run.q, run.v), known, motion.scales, errors, strict=True)
        if all(np.abs(mine - own)[later].max() / scale < CLEAR * error for mine, own, scale, error in found):
            # with a wrong clock the positions do not change at the rate of the velocities; with wrong forces they do
            off, left = (np.linalg.norm((rates - factor * run.v)[later]) for factor in (1.0, ratio))
            if text is not slow or left < 0.5 * off:
                return text
    return ""


def between_steps(e: Evidence) -> str:
    """Return a hint for states that are right at the end of a run and wrong at times within."""
    if e.settings.tolerances is None:
        return ""
    run, motion = e.observed.runs[-1], e.observed.motion
    for k in np.argsort(-e.position)[:3]:  # the worst times, at which runs are now ended
        try:
            short = simulated(e.simulate, e.observed.problem, motion.t[: k + 1], e.observed.settings[-1])
        except (TypeError, ValueError):  # the simulator accepts no other times than those of the motion
            return ""
        off, before = (np.abs(each - motion.q[k]).max() for each in (short.q[-1], run.q[k]))
        if k < 2 or not off < CLEAR * before:  # also if it is not finite
            return ""
    return (
        "Right where a run ends, and wrong at the same times within a longer one: the states between the steps are "
        "interpolated too coarsely (linearly?). End a step at each of the times, or interpolate by values and rates."
    )


def _between(motion: Motion, times: Array) -> tuple[Array, Array]:
    """Interpolate the states of a motion by cubic Hermite polynomials and their derivatives."""
    k = np.clip(np.searchsorted(motion.t, times) - 1, 0, motion.t.size - 2)
    h = (motion.t[k + 1] - motion.t[k])[:, None]
    x = (times - motion.t[k])[:, None] / h
    q, end, v, end_v = motion.q[k], motion.q[k + 1], h * motion.v[k], h * motion.v[k + 1]
    square, cube = 3.0 * (end - q) - 2.0 * v - end_v, 2.0 * (q - end) + v + end_v
    return q + x * (v + x * (square + x * cube)), (v + x * (2.0 * square + 3.0 * x * cube)) / h


def _nearest(motion: Motion, q: Array, v: Array) -> Array:
    """Return the times (n,) at which a motion is nearest to states (n, n_q)."""
    times = np.linspace(motion.t[0], motion.t[-1], DENSE * (motion.t.size - 1) + 1)
    known = np.hstack([part / scale for part, scale in zip(_between(motion, times), motion.scales, strict=True)])
    rates, found = np.gradient(known, times, axis=0), np.hstack([q / motion.scales[0], v / motion.scales[1]])
    nearest = np.array([np.argmin(np.abs(known - each).max(axis=1)) for each in found])
    along = ((found - known[nearest]) * rates[nearest]).sum(axis=1) / (rates[nearest] ** 2).sum(axis=1)
    half = 0.5 * (times[1] - times[0])
    return np.asarray(times[nearest] + np.clip(along, -half, half), dtype=float)


def rates_of_time(e: Evidence) -> str:
    """Return a hint for velocities that satisfy C_q v + C_t = 0 without C_t, or with terms of the previous step."""
    problem, run = e.observed.problem, e.observed.runs[-1]
    if run.v is None or not {"velocity constraints", "order of v", "limit of v"} & set(e.failed):
        return ""
    states = list(zip(run.t, run.q, run.v, strict=True))[1:]
    rates = np.array([problem.constraint_rate(t, q) for t, q, _ in states])
    left = np.array([problem.jacobian(t, q) @ v for t, q, v in states])
    off = np.abs(left + rates).max()
    if rates.any() and np.abs(left).max() < CLEAR * off:
        return "The velocities obey C_q v = 0 where the constraints move: C_t is left out of C_q v + C_t = 0."
    if e.settings.steps is None or off < HELD_BY_STEPS:
        return ""
    h = e.observed.settings[-1]
    old_rates = np.array([problem.constraint_rate(t - h, q - h * v) for t, q, v in states])
    old_left = np.array([problem.jacobian(t - h, q - h * v) @ v for t, q, v in states])
    others = {"C_t": left + old_rates, "C_q": old_left + rates, "C_q and C_t": old_left + old_rates}
    name = min(others, key=lambda each: float(np.abs(others[each]).max()))
    if np.abs(others[name]).max() > 2.0 * CLEAR * off:
        return ""
    return f"The velocities obey C_q v + C_t = 0 with {name} of one step before: take them at (t + h, q) of its end."


def clock(e: Evidence) -> str:
    """Return a hint for constraints that hold at another time than that of the state."""
    problem, run = e.observed.problem, e.observed.runs[-1]
    if "constraints" not in e.failed:
        return ""
    begin, steps = problem.t_span[0], list[float]()
    if e.settings.steps is not None:
        h = e.observed.settings[-1]
        half_steps = round(2.0 * (run.t[1] - run.t[0]) / h)
        steps = [0.5 * h * k for k in range(-half_steps, half_steps + 1)]
    states = list(zip(run.t[1:], run.q[1:], strict=True))

    def left(shift: float) -> float:
        return float(max(np.abs(problem.constraint(t - shift, q)).max() for t, q in states))

    shift = min([begin, *steps], key=left)
    if not left(shift) < CLEAR * left(0.0):
        return ""
    if shift == begin:
        return f"The constraints hold at t - {begin:g} s: time does not begin at 0 here, but at t_span[0] = times[0]."
    of, word = abs(shift) / e.observed.settings[-1], "earlier" if shift > 0.0 else "later"
    return (
        f"C = 0 holds at another instant than that of the state, {of:g} step{'s' * (of != 1.0)} {word}: t is not "
        "advanced with the state, or twice."
    )

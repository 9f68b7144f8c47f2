"""The properties of a simulator on one problem, measured on its runs."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from twoloop.testing.changes import Transformed
from twoloop.testing.findings import Finding
from twoloop.testing.known_problem import Array, Quantity
from twoloop.testing.measuring import (
    HELD,
    HELD_BY_STEPS,
    HELD_RATES,
    MOST,
    ROUNDING,
    Observed,
    Settings,
    allowed,
    drifts,
    lam_errors,
    order,
    still_there,
    violations,
)
from twoloop.testing.simulated import Simulated, transformed_back

LEAST_ORDER = 0.7  # required order if none is given
UNUSED = 0.01  # part of the allowed error that is allowed at the last tolerance if it changes nothing
SHORT = 0.6  # tolerance of the observed order


def measured(observed: Observed, settings: Settings) -> Iterator[Finding]:
    """Yield all properties that can be measured on these runs."""
    finest = observed.runs[-1]
    kinds = ["q"] if finest.v is None else ["q", "v"]
    for kind in kinds:
        yield from (errors_at_tolerances if settings.tolerances else errors_by_steps)(observed, settings, kind)
    if settings.tolerances and settings.tolerances[-1] < float(np.finfo(np.float32).eps):
        single = is_single(finest)
        yield Finding(observed.problem.name, "precision", "single" if single else "double", "double", not single)
    yield from constraints(observed, settings)
    if finest.v is not None:
        problem = observed.problem
        kept = dict(problem.invariants) | ({} if problem.energy is None else {"energy": problem.energy})
        for name, quantity in kept.items():
            yield invariant(observed, settings, name, quantity)
    if finest.lam is not None:
        yield multipliers(observed, settings)


def _worst(name: str, observed: Observed, found: list[Array], limits: list[Array]) -> Finding:
    """Return the finding at the worst place over all runs."""
    ratios = [np.max(errors / limit) for errors, limit in zip(found, limits, strict=True)]
    k = int(np.argmax(ratios))
    worst = int(np.argmax(found[k] / limits[k]))
    value, limit = float(found[k][worst]), float(limits[k][worst])
    return Finding(observed.problem.name, name, value, limit, value <= limit)


def errors_at_tolerances(observed: Observed, settings: Settings, kind: str) -> Iterator[Finding]:
    """Yield the error at the tolerance where it is largest relative to its limit."""
    limits = [allowed(observed.motion, setting) for setting in observed.settings]
    if same_at_last(observed):  # a tolerance that changes nothing must be met with room to spare
        limits[-1] = limits[-1] * UNUSED
    limits = [limit + observed.floor(kind) for limit in limits]
    yield _worst(f"error of {kind}", observed, observed.errors(kind), limits)


def same_at_last(observed: Observed) -> bool:
    """Return True if the last two settings give the same numbers."""
    return len(observed.runs) > 1 and np.array_equal(observed.runs[-2].q, observed.runs[-1].q)


def is_single(run: Simulated) -> bool:
    """Return True if all states after the start are numbers of single precision."""
    given = [each[1:] for each in (run.q, run.v) if each is not None]
    return all(np.array_equal(each, each.astype(np.float32)) for each in given)


def errors_by_steps(observed: Observed, settings: Settings, kind: str) -> Iterator[Finding]:
    """Yield the error with the finest steps, its limit as the steps tend to zero, and the order."""
    name, errors = observed.problem.name, observed.errors(kind)
    worst, floor = float(errors[-1].max()), observed.rounding + observed.floor(kind)
    yield Finding(name, f"error of {kind}", worst, MOST, worst <= MOST)
    if worst > MOST:
        return
    changes = changes_of(observed, kind)
    value, rest = still_there(errors, changes, floor)
    yield Finding(name, f"limit of {kind}", value, rest, value <= rest)
    seen = observed_order(observed, kind)
    if seen is not None:
        least = LEAST_ORDER if settings.order is None else settings.order - SHORT
        yield Finding(name, f"order of {kind}", seen, least, seen >= least)


def changes_of(observed: Observed, kind: str) -> list[Array]:
    """Return the changes (n_t,) from each setting to the next, relative to the largest value of the motion."""
    scale = dict(zip("qv", observed.motion.scales, strict=True))[kind]
    values = [getattr(run, kind) for run in observed.runs]
    return [np.abs(fine - coarse).max(axis=1) / scale for coarse, fine in pairwise(values)]


def observed_order(observed: Observed, kind: str) -> float | None:
    """Return the order of the errors over the last refinement; that of the changes if the limit is wrong."""
    floor = observed.rounding + observed.floor(kind)
    errors, changes, steps = observed.errors(kind), changes_of(observed, kind), observed.settings
    value, rest = still_there(errors, changes, floor)
    if value <= rest:
        return order(errors[-2], errors[-1], steps[-2] / steps[-1], floor)
    return order(changes[-2], changes[-1], steps[-2] / steps[-1], floor) if len(changes) > 1 else None


def constraints(observed: Observed, settings: Settings) -> Iterator[Finding]:
    """Yield the distances of positions and velocities from the constraints.

    With fixed steps those of the velocities may also vanish with the step size, as for methods that only enforce C = 0.
    """
    found = [violations(observed.problem, run, observed.motion.scales) for run in observed.runs]
    floor = 10.0 * 10.0 ** -observed.motion.digits["q"] + 1e-12
    if settings.tolerances:
        limits = [HELD * setting + floor for setting in observed.settings]
        yield _worst("constraints", observed, [each[0] for each in found], limits)
    else:
        yield _worst("constraints", observed, [found[-1][0]], [HELD_BY_STEPS + floor])
    rates = [each[1] for each in found if each[1] is not None]
    if rates and settings.tolerances:
        limits = [HELD_RATES * setting + 10.0 * floor for setting in observed.settings]
        yield _worst("velocity constraints", observed, rates, limits)
    elif rates:
        vanish = rates[-2].max() > 2.0**LEAST_ORDER * rates[-1].max()
        limit = np.full(floor.shape, MOST) if vanish else HELD_BY_STEPS + observed.rounding
        yield _worst("velocity constraints", observed, [rates[-1]], [limit])


def invariant(observed: Observed, settings: Settings, name: str, quantity: Quantity) -> Finding:
    """Return the drift of the energy, or of another invariant."""
    motion = observed.motion
    found = [drifts(observed.problem, quantity, run, motion) for run in observed.runs]
    floor = 10.0 * (observed.floor("q") + observed.floor("v"))
    if settings.tolerances:
        limits = [3.0 * allowed(motion, setting) + floor for setting in observed.settings]
        return _worst(name, observed, found, limits)
    return _vanishing(observed, name, found, floor + observed.rounding)


def multipliers(observed: Observed, settings: Settings) -> Finding:
    """Return the errors of C_q^T lam."""
    found, motion = lam_errors(observed), observed.motion
    floor = observed.floor("v") + 10.0 * 10.0 ** -motion.digits["lam"]
    if settings.tolerances:
        limits = [
            np.minimum(MOST, 10.0 * allowed(motion, setting) + np.sqrt(setting)) + floor
            for setting in observed.settings
        ]
        return _worst("multipliers", observed, found, limits)
    return _vanishing(
        observed, "multipliers", found, np.minimum(MOST, floor + 1e3 * ROUNDING * motion.growth + observed.rounding)
    )


def _vanishing(observed: Observed, name: str, found: list[Array], floor: Array) -> Finding:
    """Pass if the error of the finest run is at most three times its change by the last refinement."""
    worst = float(found[-1].max())
    limit = min(MOST, max(float(np.max(floor)), 3.0 * float(np.abs(found[-1] - found[-2]).max())))
    return Finding(observed.problem.name, name, worst, limit, worst <= limit)


def in_transformed(
    observed: Observed, settings: Settings, name: str, seen: Transformed, run: Simulated, setting: float
) -> Finding:
    """Return the error of a run in another frame or other units, compared with that of the original."""
    problem, motion = observed.problem, observed.motion
    if not run.complete:
        what = run.error or "numbers that are not finite"
        return Finding(problem.name, name, what, "a run, as of the original", False)
    base = observed.errors("q")[observed.settings.index(setting)]
    there = Observed(problem, motion, [setting], [transformed_back(run, seen)])
    if settings.tolerances:
        limit = np.maximum(allowed(motion, setting), 10.0 * base.max()) + observed.floor("q")
    else:
        limit = 30.0 * np.maximum.accumulate(base) + 1e-6 + observed.rounding
    return _worst(name, there, there.errors("q"), [limit])

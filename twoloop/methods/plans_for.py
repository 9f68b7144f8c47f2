"""The plans by which a method runs a system; those of our own methods are made once for a system and a tolerance."""

from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.traced_values import Check
from twoloop.kernels.data.intervals import ACCELERATIONS, APART, VELOCITIES
from twoloop.methods.plan import Method, Plan
from twoloop.methods.presets import identity
from twoloop.problem.system import ConstrainedSystem

MOST = 16  # that are kept with a system

# of steps, and of parts of steps, by kind, between which the solution is wanted: these other runs may have, too
Plans = tuple[Plan, dict[int, Plan]]


def plans_for(
    system: ConstrainedSystem,
    method: Method,
    rtol: float,
    atol: float,
    fixed: bool,
    code: GeneratedCode | None,
    check: Check,
) -> Plans:
    """The plans of a run.

    Raises ValueError if the method cannot run the system.
    """
    known, choice = identity(method), None if code is None else code.shared.equations.choice
    key, methods = (known, rtol, atol, fixed, choice), system.remembered("methods", dict)
    kept: dict[tuple[object, ...], Plans] = system.remembered("plans", dict)
    made = None if known is None else kept.get(key)
    if made is None:
        ready = None if known is None else methods.get((known, choice))  # it does not depend on tolerances
        if ready is None:
            ready = method.for_system(system, code, check) if hasattr(method, "for_system") else method
        made = _made(system, ready, rtol, atol, fixed, code)
        settled = code is not None or _series(ready) == _series(method)
        if known is not None and settled and all(each.trusted for each in made[0].traced):
            while len(kept) >= MOST:  # other threads may add to them
                kept.pop(next(iter(kept.copy())), None)
            kept[key] = made
            if len(methods) < MOST:
                methods[known, choice] = ready
    plan, interiors = made
    return plan.fresh(), interiors


def _series(method: Method) -> bool:
    """Whether a method has a series: it may lose it for one start, where `check` finds other values."""
    return getattr(method, "series", None) is not None


def _made(
    system: ConstrainedSystem, method: Method, rtol: float, atol: float, fixed: bool, code: GeneratedCode | None
) -> Plans:
    plan = method.plan(system.n_q, rtol, atol, fixed)
    interiors = {} if plan.within_newton is None else {VELOCITIES: plan.within_newton}
    if plan.parts > 1:
        interiors[APART if plan.apart else ACCELERATIONS] = (
            method.plan(system.n_q, rtol, atol, True) if plan.interior is None else plan.interior
        )
    if code is None:
        return plan, interiors
    return _with_code(plan, code).changed(traced=(*plan.traced, code.traced)), interiors


def _with_code(plan: Plan, code: GeneratedCode) -> Plan:
    from twoloop.kernels.evaluation.inner_loop import generated_inner_loop

    substitute = None if plan.substitute is None else _with_code(plan.substitute, code)
    own = code.shared.functions, *plan.own
    return plan.changed(inner=generated_inner_loop, own=own, numbers=code.numbers, substitute=substitute)

"""Presets: names of methods with their usual settings; generated code and plans of a method, cached with the system."""

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import shown
from twoloop.generate.compile_equations import GeneratedCode, generated_code
from twoloop.generate.graph import Untraceable
from twoloop.generate.series import is_quick, series_for
from twoloop.generate.traced_values import Check
from twoloop.kernels.data.indices import ACCELERATIONS, APART, VELOCITIES
from twoloop.methods.adams import Adams
from twoloop.methods.auto import Auto
from twoloop.methods.dop853 import DOP853
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.paper import BDF, Newmark, paper_irk, paper_newmark
from twoloop.methods.plan import Method, Plan, needs_code, takes_code
from twoloop.methods.runge_kutta import ESDIRK, RungeKutta
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib
from twoloop.methods.taylor import Taylor
from twoloop.problem.system import ConstrainedSystem

PRESETS: dict[str, Method] = {
    "auto": Auto(
        few=DOP853(),
        many=Adams(),
        series=Taylor(),
        loose=ESDIRK("TRBDF2"),
        tight=RungeKutta(radau_iia(3), outer="newton", tested="positions"),
        tightest=RungeKutta(radau_iia(5), outer="newton", tested="positions"),
        fixed=RungeKutta(sun_radau_iib(3), outer="auto"),
        lanes=Lobatto16(),
    ),
    "SunRadau5": RungeKutta(sun_radau_iib(3), outer="auto"),
    **{f"Gauss{2 * s}": RungeKutta(gauss(s)) for s in range(2, 9)},
    **{f"RadauIIA{2 * s - 1}": RungeKutta(radau_iia(s), outer="newton") for s in (3, 5, 7)},
    "TRBDF2": ESDIRK("TRBDF2"),
    "ESDIRK4": ESDIRK("ESDIRK4"),
    "Newmark": Newmark(),
    "BDF": BDF(),
    "Lobatto16": Lobatto16(),
    "DOP853": DOP853(),
    "Adams": Adams(),
    "Taylor": Taylor(),
    "PaperIRK": paper_irk(),
    "PaperNewmark": paper_newmark(),
}


OPTION_CLASSES = (
    Adams,
    BDF,
    DOP853,
    ESDIRK,
    Lobatto16,
    Newmark,
    RungeKutta,
    Taylor,
)  # methods that are determined by the values of their options
OPTION_TYPES = (str, int, float, np.generic, type(None))  # types of option values, in addition to tableaux
_OF_PRESETS = frozenset(map(id, PRESETS.values()))


def is_preset(method: Any) -> bool:
    """Return whether a method is a preset or the name of a preset; presets never change."""
    return isinstance(method, str) or id(method) in _OF_PRESETS


def identity(method: Method) -> Any:
    """Return a key shared by methods with the same options, for caches of runs; None: the method has no key."""
    if is_preset(method):
        return id(method)
    if type(method) not in OPTION_CLASSES:
        return None
    values = [value.content if type(value) is Tableau else value for value in vars(method).values()]
    return (type(method), *values) if all(isinstance(value, (*OPTION_TYPES, tuple)) for value in values) else None


Array = NDArray[np.float64]
Compiled = bool | Literal["auto"]

# largest number of operations in the series of a small mechanism, which does not depend on the position. Generated code
# with 230 to 280 operations takes 0.6 s to build, two thirds of it in LLVM; with 370 to 690 it takes 0.7 to 1.9 s
# (Bricard 1.6, governor 1.9, whose stiff motion takes a tenth longer with code)
SMALL = 300


def check_compiled(value: Compiled) -> Compiled:
    """Return `value`, or raise if it is not one of the choices."""
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, str) and value == "auto":
        return value
    raise (ValueError if isinstance(value, str) else TypeError)(
        f"compiled must be True, False or 'auto'; given {shown(value)} of type {type(value).__name__}"
    )


def code_for(
    system: ConstrainedSystem, method: Method, fixed: bool, compiled: Compiled, t0: float, q0: Array, check: Check
) -> GeneratedCode | None:
    """Return the generated code for a run, or None if the run uses none.

    "auto" depends only on the arguments of the call, so that the same call always gives the same numbers.

    Raises ValueError if code is requested but does not suit the method, or cannot be generated.
    """
    if compiled is True:
        _check_takes_code(method, fixed)
        return generated_code(system, t0, q0, check)
    if needs_code(method):
        return _required_code(system, method, compiled, t0, q0, check)
    if not may_have_code(system, method, fixed, compiled):
        return None
    try:
        return generated_code(system, t0, q0, check)
    except ValueError:
        return None


def may_have_code(system: ConstrainedSystem, method: Method, fixed: bool, compiled: Compiled) -> bool:
    """Return whether a run uses generated code if it can be generated."""
    if needs_code(method):
        return True
    if compiled == "auto":
        return not fixed and takes_code(method, False) and is_small(system)
    return compiled


def _required_code(
    system: ConstrainedSystem, method: Method, compiled: Compiled, t0: float, q0: Array, check: Check
) -> GeneratedCode:
    """Return the code for a method that needs it, or raise ValueError."""
    what = f"method={method.name!r} needs code made for {system.name!r}"
    if not compiled:
        raise ValueError(f"{what}; given compiled=False. Leave it out, or take method='auto'")
    try:
        return generated_code(system, t0, q0, check)
    except ValueError as error:
        raise ValueError(f"{what}, which cannot be had; {error.__cause__}. Take method='auto'") from error


def _check_takes_code(method: Method, fixed: bool) -> None:
    """Raise ValueError if the method cannot use generated code; called before code is generated."""
    if not takes_code(method, fixed):
        implicit = " with step_size, by which it is implicit" if takes_code(method, False) else ""
        raise ValueError(
            "compiled=True goes with 'auto', 'Lobatto16', 'Taylor', 'DOP853', 'Adams'; "
            f"given method {method.name}{implicit}"
        )


def is_small(system: ConstrainedSystem) -> bool:
    """Return whether the callbacks of a system are compiled, can be traced, and take few operations."""

    def takes_few_operations() -> bool:
        try:
            return is_quick(system) and series_for(system).n_operations <= SMALL
        except Untraceable:
            return False

    return not system.called_in_python and bool(system.remembered("small", takes_few_operations))


MAX_PLANS = 16  # largest number of plans cached with a system

# the plan of the steps, and by kind of interval the plans for the solution within steps; runs may share the latter
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
    """Return the plans of a run.

    Raises ValueError if the method cannot run the system.
    """
    known, choice = identity(method), None if code is None else code.shared.equations.choice
    key, methods = (known, rtol, atol, fixed, choice), system.remembered("methods", dict)
    cached: dict[tuple[object, ...], Plans] = system.remembered("plans", dict)
    plans = None if known is None else cached.get(key)
    if plans is None:
        # the prepared method does not depend on tolerances
        ready = None if known is None else methods.get((known, choice))
        if ready is None:
            ready = method.for_system(system, code, check) if hasattr(method, "for_system") else method
        plans = _make_plans(system, ready, rtol, atol, fixed, code)
        is_final = code is not None or _has_series(ready) == _has_series(method)
        if known is not None and is_final and all(each.trusted for each in plans[0].traced):
            while len(cached) >= MAX_PLANS:  # a loop, because other threads may add plans
                cached.pop(next(iter(cached.copy())), None)
            cached[key] = plans
            if len(methods) < MAX_PLANS:
                methods[known, choice] = ready
    plan, interiors = plans
    return plan.fresh(), interiors


def _has_series(method: Method) -> bool:
    """Return whether a method has a series, which it loses for one start if `check` finds other values."""
    return getattr(method, "series", None) is not None


def _make_plans(
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

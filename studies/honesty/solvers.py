"""The solvers of `studies.honesty`, as their users call them: twoloop's, and others without `max_step` and with it."""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

from references.cyrk.ode import solve_cyrk
from references.heyoka.taylor import solve_heyoka
from references.scipy.index1 import solve_index1
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.ida import solve_ida, solve_ida_c
from studies.bench.solvers import GIVEN
from studies.honesty.traps import FORCE, INPUT, LINKAGE, MISTAKE, SHORT, SINGULAR, Trap
from twoloop import Result, solve_dae
from twoloop.kernels.control.discontinuities import N_SAMPLES
from twoloop.kernels.data.indices import LONGEST_UNSEEN

OWN = (GIVEN, "Taylor", "Adams", "DOP853", "Gauss12", "RadauIIA5", "BDF")
IDA, IDA_C, CVODE_C, HEYOKA = "IDA, stabilised", "IDA from C", "CVODE from C, Adams", "heyoka, Taylor"
PROJECTED = "CVODE from C, BDF, projected"
CYRK, CYRK_RADAU = "CyRK, DOP853", "CyRK, Radau"
OTHERS: dict[str, Callable[..., Result]] = {  # but for SciPy's
    **{IDA: partial(solve_ida, form="stabilised"), IDA_C: solve_ida_c, CVODE_C: partial(solve_cvode_c, method="Adams")},
    **{HEYOKA: solve_heyoka, PROJECTED: partial(solve_cvode_c, method="BDF", projected=True)},
    **{CYRK: solve_cyrk, CYRK_RADAU: partial(solve_cyrk, method="Radau")},
}
SUNDIALS = (IDA, IDA_C, CVODE_C, PROJECTED)
COMPILED_ONLY = (IDA_C, CVODE_C, PROJECTED, HEYOKA, CYRK, CYRK_RADAU)
SCIPY = ("LSODA", "DOP853", "Radau", "BDF")
OF_FORCES = (  # run under sharp forces, too: all presets but the paper's, which follow it to the letter
    *("auto, compiled", "auto, not compiled", "Taylor, compiled", "Gauss4", "Gauss6", "Gauss8", "Gauss10", "Gauss14"),
    *("Gauss16", "SunRadau5", "RadauIIA9", "RadauIIA13", "TRBDF2", "ESDIRK4", "Newmark"),
)
OWN_SUFFIX = " (twoloop)"
DEFAULT = f"{GIVEN}{OWN_SUFFIX}"
WITH_CODE: dict[str, dict[str, Any]] = {"": {}, "compiled": {"compiled": True}, "not compiled": {"compiled": False}}
QUICK_OWN, QUICK_SCIPY = (GIVEN, "DOP853", "BDF"), ("DOP853",)
OWN_OF = {  # groups of many runs, which fewer methods make
    SHORT: (GIVEN, "DOP853", "RadauIIA5"),
    SINGULAR: (GIVEN, "auto, not compiled", "DOP853"),
    LINKAGE: (GIVEN, "DOP853"),
    FORCE: (*OWN, *OF_FORCES),
}
LOOK = LONGEST_UNSEEN / N_SAMPLES  # of a run: longest time between two evaluations of a force that changes with time
LIMITED = ", max_step"  # of other solvers whose largest step is that time

KINDS = {  # kinds of solvers, in words
    "default": "the default",
    "own": "twoloop's other methods",
    "heyoka": "heyoka",
    "cyrk": "CyRK",
    "sundials": "SUNDIALS (IDA, CVODE)",
    "scipy": "SciPy",
    "limited": "other solvers with `max_step`",
}

Call = Callable[[Trap], Result]


def kind_of(name: str) -> str:
    """Which of KINDS a solver is; other solvers with a largest step are "limited", whosever they are."""
    if name.endswith(OWN_SUFFIX):
        return "default" if name == DEFAULT else "own"
    if name.endswith(LIMITED):
        return "limited"
    named = {HEYOKA: "heyoka", CYRK: "cyrk", CYRK_RADAU: "cyrk"} | dict.fromkeys(SUNDIALS, "sundials")
    return named.get(name, "scipy")


def own(method: str, trap: Trap) -> Result:
    """Run a method of twoloop, as a user calls it."""
    name, _, code = method.partition(", ")
    options: dict[str, Any] = {"rtol": trap.tolerance, "atol": trap.tolerance, "time_limit": trap.time_limit}
    options |= WITH_CODE[code] | ({} if name == GIVEN else {"method": name}) | dict(trap.steps)
    return solve_dae(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, **options)


def largest_step(limited: bool, trap: Trap) -> float | None:
    """Return `max_step` of another solver (s): the trap's own, else LOOK if it is `limited`, else none."""
    return trap.steps.get("max_step", LOOK * trap.t_end if limited else None)


def other(solve: Callable[..., Result], limited: bool, trap: Trap) -> Result:
    """Run another solver, without a largest step, or with one."""
    options = {"time_limit": trap.time_limit, "max_step": largest_step(limited, trap)}
    tolerances = {"tol": trap.tolerance} if solve is solve_heyoka else {"rtol": trap.tolerance, "atol": trap.tolerance}
    return solve(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, **tolerances, **options)


def solvers(quick: bool, group: str = MISTAKE) -> dict[str, Call]:
    """Return the solvers of a group of traps by name: twoloop's, then others without `max_step` and with it."""
    left_out = OTHERS if quick else (IDA, PROJECTED, CYRK_RADAU) if group in (SHORT, LINKAGE) else ()
    others = {name: solve for name, solve in OTHERS.items() if name not in left_out}
    scipy = QUICK_SCIPY if quick or group in (SHORT, LINKAGE) else SCIPY
    others |= {f"{name}, index 1": partial(solve_index1, method=name) for name in scipy}
    if group == SINGULAR:  # where accelerations are undefined
        others = {name: solve for name, solve in others.items() if name in (IDA, IDA_C)}
    methods = QUICK_OWN if quick else OWN_OF.get(group, OWN)
    made: dict[str, Call] = {f"{name}{OWN_SUFFIX}": partial(own, name) for name in methods}
    made |= {name: partial(other, solve, False) for name, solve in others.items()}
    if group not in (INPUT, LINKAGE, SINGULAR):  # which a largest step does not help
        made |= {name + LIMITED: partial(other, solve, True) for name, solve in others.items()}
    return made


def why_not(name: str, trap: Trap) -> str:
    """Say why a solver is not run on a trap; "" where it is run."""
    solver, theirs = name.removesuffix(LIMITED), not name.endswith(OWN_SUFFIX)
    if theirs and set(trap.steps) - {"max_step"}:
        return "its adapter takes neither first nor constant steps"
    if name.endswith(LIMITED) and trap.steps:
        return "the trap sets max_step itself"
    if theirs and not solver.startswith("IDA"):  # it is given accelerations, which twoloop derives
        if trap.group == INPUT:
            return "it is given accelerations: it has no constraints to check"
        if trap.impulse or trap.singular:
            return "the accelerations are not defined throughout: of an impulse, or where C_q loses rank"
    package = {HEYOKA: "heyoka", CYRK: "CyRK", CYRK_RADAU: "CyRK"}.get(solver)
    if package is not None and find_spec(package) is None:
        return f"{package} is not installed"
    return "it takes compiled functions only" if solver in COMPILED_ONLY and trap.system.called_in_python else ""

"""The solvers of `studies.honesty`, as their users call them: ours, and others without `max_step` and with."""

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Any

from references.cyrk.ode import solve_cyrk
from references.heyoka.taylor import solve_heyoka
from references.scipy.index1 import solve_index1
from references.sundials.cvode_c import solve_cvode_c
from references.sundials.ida import solve_ida
from references.sundials.ida_c import solve_ida_c
from studies.bench.solvers import GIVEN
from studies.honesty.traps import FORCE, HELD_OUT, INPUT, MISTAKE, SHORT, Trap
from twoloop import Result, solve_dae
from twoloop.kernels.control.sudden import PLACES
from twoloop.kernels.data.tolerances import LONGEST_UNSEEN

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
OF_FORCES = (  # further ones of ours under sharp forces: all presets but the paper's, which follow it to the letter
    *("auto, compiled", "auto, not compiled", "Taylor, compiled", "Gauss4", "Gauss6", "Gauss8", "Gauss10", "Gauss14"),
    *("Gauss16", "SunRadau5", "RadauIIA9", "RadauIIA13", "TRBDF2", "ESDIRK4", "Newmark"),
)
OURS = " (twoloop)"
DEFAULT = f"{GIVEN}{OURS}"
WITH_CODE: dict[str, dict[str, Any]] = {"": {}, "compiled": {"compiled": True}, "not compiled": {"compiled": False}}
QUICK_OWN, QUICK_SCIPY = (GIVEN, "DOP853", "BDF"), ("DOP853",)
OF_SHORT = (GIVEN, "DOP853", "RadauIIA5")  # under gusts that a solver may step over, with IDA_C, CVODE_C, HEYOKA, CYRK
SCIPY_OF_SHORT = ("DOP853",)
LOOK = LONGEST_UNSEEN / PLACES  # of a run: so often ours look at least at forces that change with time
LIMITED = ", max_step"  # of others that take no step longer than the time between two looks of ours

# whose a solver is, in the words of the findings
KINDS = ("default", "ours", "set", "heyoka", "cyrk", "sundials", "scipy", "limited")

Call = Callable[[Trap], Result]


def kind_of(name: str) -> str:
    """Which of KINDS a solver is; others with a largest step are limited, whosever they are.

    Each method of ours is one of "default" and "ours"; what is "set" is such a method with another `compiled`.
    """
    if name.endswith(OURS):
        code = name.removesuffix(OURS).partition(", ")[2]
        return "default" if name == DEFAULT else "set" if code else "ours"
    if name.endswith(LIMITED):
        return "limited"
    named = {HEYOKA: "heyoka", CYRK: "cyrk", CYRK_RADAU: "cyrk"} | dict.fromkeys(SUNDIALS, "sundials")
    return named.get(name, "scipy")


def own(method: str, trap: Trap) -> Result:
    """One of ours, as a user calls it."""
    name, _, code = method.partition(", ")
    options: dict[str, Any] = {"rtol": trap.tolerance, "atol": trap.tolerance, "time_limit": trap.time_limit}
    options |= WITH_CODE[code] | ({} if name == GIVEN else {"method": name}) | dict(trap.steps)
    return solve_dae(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, **options)


def largest_step(limited: bool, trap: Trap) -> float | None:
    """`max_step` of another project's solver (s): the trap's own, else the time between two looks of ours, or none."""
    return trap.steps.get("max_step", LOOK * trap.t_end if limited else None)


def other(solve: Callable[..., Result], limited: bool, trap: Trap) -> Result:
    """Another project's, without a largest step, or with one."""
    options = {"time_limit": trap.time_limit, "max_step": largest_step(limited, trap)}
    tolerances = {"tol": trap.tolerance} if solve is solve_heyoka else {"rtol": trap.tolerance, "atol": trap.tolerance}
    return solve(trap.system, (0.0, trap.t_end), trap.q0, trap.v0, **tolerances, **options)


def solvers(quick: bool, group: str = MISTAKE) -> dict[str, Call]:
    """Name to call, of those that are run on a group of traps; ours first, then others without `max_step` and with."""
    ours = OF_SHORT if group == SHORT else (*OWN, *(OF_FORCES if group in (FORCE, HELD_OUT) else ()))
    theirs = QUICK_SCIPY if quick else SCIPY_OF_SHORT if group == SHORT else SCIPY
    left_out = OTHERS if quick else (IDA, PROJECTED, CYRK_RADAU) if group == SHORT else ()
    made: dict[str, Call] = {f"{name}{OURS}": partial(own, name) for name in (QUICK_OWN if quick else ours)}
    others = {name: solve for name, solve in OTHERS.items() if name not in left_out}
    others |= {f"{name}, index 1": partial(solve_index1, method=name) for name in theirs}
    made |= {name: partial(other, solve, False) for name, solve in others.items()}
    if group != INPUT:  # to whose checks steps do not matter
        made |= {name + LIMITED: partial(other, solve, True) for name, solve in others.items()}
    return made


def why_not(name: str, trap: Trap) -> str:
    """Why a solver is not run on a trap; "" where it is."""
    solver, theirs = name.removesuffix(LIMITED), not name.endswith(OURS)
    if theirs and set(trap.steps) - {"max_step"}:
        return "its adapter takes neither first nor constant steps"
    if name.endswith(LIMITED) and trap.steps:
        return "the trap sets max_step itself"
    if theirs and not solver.startswith("IDA"):  # its equations are the accelerations, which we derive for it
        if trap.group == INPUT:
            return "it is given accelerations: it has no constraints to check"
        if trap.impulse or trap.singular:
            return "the accelerations are not defined throughout: of an impulse, or where C_q loses rank"
    package = {HEYOKA: "heyoka", CYRK: "CyRK", CYRK_RADAU: "CyRK"}.get(solver)
    if package is not None and find_spec(package) is None:
        return f"{package} is not installed"
    return "it takes compiled functions only" if solver in COMPILED_ONLY and trap.system.called_in_python else ""

"""Decides whether a run gets machine code of its mechanism: if it is asked for, or by default for small mechanisms."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import shown
from twoloop.generate.compile_equations import GeneratedCode, generated_code
from twoloop.generate.graph import Untraceable
from twoloop.generate.series import is_quick, series_for
from twoloop.generate.traced_values import Check
from twoloop.methods.plan import Method, needs_code, takes_code
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
Compiled = bool | Literal["auto"]

# operations of the series of its motion, which no position decides: code of mechanisms with 230 to 280 takes 0.6 s to
# build, two thirds of it by LLVM; with 370 to 690 it takes 0.7 to 1.9 s (Bricard 1.6, governor 1.9, by whose stiff
# motion code loses a tenth)
SMALL = 300


def check_compiled(value: Compiled) -> Compiled:
    """Return `value`, or say what it must be."""
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
    """The code for a run, if it gets any.

    What is left open depends on the arguments of the call alone, so that the same call gives the same numbers whatever
    ran before it.

    Raises ValueError if code is asked for and does not go with the method, or cannot be had.
    """
    if compiled is True:
        _refuse(method, fixed)
        return generated_code(system, t0, q0, check)
    if needs_code(method):
        return _needed(system, method, compiled, t0, q0, check)
    if not may_have_code(system, method, fixed, compiled):
        return None
    try:
        return generated_code(system, t0, q0, check)
    except ValueError:
        return None


def may_have_code(system: ConstrainedSystem, method: Method, fixed: bool, compiled: Compiled) -> bool:
    """Whether a run gets code where it can be had."""
    if needs_code(method):
        return True
    if compiled == "auto":
        return not fixed and takes_code(method, False) and is_small(system)
    return compiled


def _needed(
    system: ConstrainedSystem, method: Method, compiled: Compiled, t0: float, q0: Array, check: Check
) -> GeneratedCode:
    """The code for a method that cannot do without."""
    what = f"method={method.name!r} needs code made for {system.name!r}"
    if not compiled:
        raise ValueError(f"{what}; given compiled=False. Leave it out, or take method='auto'")
    try:
        return generated_code(system, t0, q0, check)
    except ValueError as error:
        raise ValueError(f"{what}, which cannot be had; {error.__cause__}. Take method='auto'") from error


def _refuse(method: Method, fixed: bool) -> None:
    """Raise where code does not go with the method, before it is made."""
    if not takes_code(method, fixed):
        implicit = " with step_size, by which it is implicit" if takes_code(method, False) else ""
        raise ValueError(
            "compiled=True goes with 'auto', 'Lobatto16', 'Taylor', 'DOP853', 'Adams'; "
            f"given method {method.name}{implicit}"
        )


def is_small(system: ConstrainedSystem) -> bool:
    """Whether its callbacks are compiled, can be traced, and make few operations."""

    def look() -> bool:
        try:
            return is_quick(system) and series_for(system).n_operations <= SMALL
        except Untraceable:
            return False

    return not system.called_in_python and bool(system.remembered("small", look))

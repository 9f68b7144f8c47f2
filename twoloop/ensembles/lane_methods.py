"""Methods that go in lanes: the step of each, its parameters and its memory."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.generate.graph import Untraceable
from twoloop.generate.series import series_for
from twoloop.generate.time_dependence import may_be_narrow
from twoloop.kernels.layout import short_loops
from twoloop.methods import dop853_tableau as tableau
from twoloop.methods.auto import TIGHTEST
from twoloop.methods.dop853 import COARSE_SHARE, UNSEEN
from twoloop.methods.plan import Method, least_tolerance
from twoloop.methods.presets import PRESETS
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import radau_iia
from twoloop.methods.taylor import order_in_lanes
from twoloop.problem.system import ConstrainedSystem

if TYPE_CHECKING:  # it loads kernels
    from twoloop.generate.lane_code import LaneCode


INVOLVED = 6.0  # operations of a series a coordinate, from which on "auto" takes DOP853 (measured at 2, 11 and 13) ...
STAGES_TO = 1e-9  # ... down to this tolerance
STAGES = {"RadauIIA5": 3, "RadauIIA9": 5, "RadauIIA13": 7}  # of the implicit methods
IN_LANES = ("auto", "Taylor", "DOP853", *STAGES)  # presets that go in lanes


@dataclass(frozen=True)
class LaneMethod:
    """A method made ready for runs in lanes.

    Attributes
    ----------
    name : str
    series : bool
        Whether it needs code for Taylor series.
    order : int
        What code made for a mechanism gets as the order.
    evaluations : int
        Of an attempt, besides those that its kernel counts and the one at its end.
    options : ndarray
        What its step reads.
    tableau : tuple of ndarray or None
        Of an explicit method, for which code is made: A, b, c and the weights of two estimates of its error.
    unseen : float
        Of a step, the longest part within which the equations are not looked at.
    step, memory : callable
        Its kernel, compiled when it is first asked for, and the length of its memory, in vectors, for such code.
    """

    name: str
    series: bool
    order: int
    evaluations: int
    options: Array
    step: Callable[[], Any]
    memory: Callable[["LaneCode"], int]
    tableau: tuple[Array, Array, Array, Array, Array] | None = None
    unseen: float = 1.0


def is_involved(system: ConstrainedSystem) -> bool:
    """Whether a Taylor series takes so many operations that a dozen evaluations cost less.

    Not where something is narrow: there steps of DOP853 have to be short, and a series is only looked at within them.
    """
    if may_be_narrow(system, ran_on_symbols=True):
        return False
    try:
        return series_for(system).n_operations > INVOLVED * system.n_q
    except Untraceable:
        return False


def lane_methods(name: str, stiff: bool, n: int, rtol: float, atol: float, involved: bool = False) -> list[LaneMethod]:
    """Methods for runs of n coordinates by a preset; the next one where no code can be had for one.

    "auto" takes Taylor series, or DOP853 where there are none or, down to STAGES_TO, these are `involved`; for stiff
    motion the Radau method that it takes singly, at loose tolerances that of order 5.
    """
    if name == "DOP853":
        return [_dop853(n, rtol, atol)]
    if name == "Taylor":
        return [_taylor(rtol, atol)]
    if name != "auto":
        return [_newton(name, "all", n, rtol, atol)]
    tolerance = least_tolerance(rtol, atol)
    if not stiff:
        made = [_taylor(rtol, atol), _dop853(n, rtol, atol)]
        return made[::-1] if involved and tolerance >= STAGES_TO else made
    radau = "RadauIIA5" if tolerance >= TIGHTEST else "RadauIIA9"
    return [_newton(radau, "positions", n, rtol, atol)]


def _taylor(rtol: float, atol: float) -> LaneMethod:
    def step() -> Any:
        from twoloop.kernels.lanes.lane_taylor import step_by_series

        return step_by_series

    order = order_in_lanes(rtol, atol) + 1
    return LaneMethod("Taylor", True, order, order - 1, np.zeros(0), step, lambda code: code.series_size(order))


def _dop853(n: int, rtol: float, atol: float) -> LaneMethod:
    def step() -> Any:
        from twoloop.kernels.lanes.lane_dop853 import step_by_dop853

        return step_by_dop853

    def memory(code: "LaneCode") -> int:
        from twoloop.kernels.lanes.lane_dop853 import memory_size

        return memory_size(len(tableau.B), n)

    weights = tableau.A, tableau.B, tableau.C, tableau.E5, COARSE_SHARE * tableau.E3
    stages, options = len(tableau.B), _options(PRESETS["DOP853"], n, rtol, atol)
    return LaneMethod("DOP853", False, 8, stages - 1, options, step, memory, weights, UNSEEN)


def _newton(name: str, tested: Literal["all", "positions"], n: int, rtol: float, atol: float) -> LaneMethod:
    def step() -> Any:
        from twoloop.kernels.lanes.lane_implicit import step_by_newton

        return step_by_newton

    def memory(code: "LaneCode") -> int:
        from twoloop.kernels.lanes.lane_newton import memory_size

        return memory_size(radau.stages, n)

    radau = radau_iia(STAGES[name])
    method = RungeKutta(radau, outer="newton", tested=tested)
    for_derivatives = 2 * n + 1
    return LaneMethod(name, False, radau.order, for_derivatives, _options(method, n, rtol, atol), step, memory)


def _options(method: Method, n: int, rtol: float, atol: float) -> Array:
    """What a step reads, behind what lane_control.py reads."""
    plan = method.plan(n, rtol, atol, False)
    return np.concatenate(
        [plan.rule, [plan.rough, short_loops().FIRST_STEP, least_tolerance(rtol, atol)], plan.options]
    )

"""Plan: what a method hands to a run; and rules that the methods share."""

from dataclasses import dataclass, fields
from typing import Any, Literal, Protocol, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_choice, check_positive
from twoloop.kernels.compile.caches import BoundedCache

Array = NDArray[np.float64]

# Newton in the inner loop converges quadratically and is tested on its last correction: about the square is left
INNER_TOL = 1e-8
LEAST_ERROR = 0.01  # `least_error` of a Plan, of most methods
ROUGH = 10.0  # `rough` of a Plan, as measured for most methods
LARGEST_MOVE = 1e-14  # of a position, after which a projection is not repeated: velocities are then off by as much
OUTER_SHARE = 0.01  # of the step tolerance, for the outer loop
OUTER_TOL_FIXED = 1e-14  # a fixed step has no tolerance to derive it from: iterate to rounding
LEAST_TOLERANCE = 1e-14  # what smaller tolerances count as where a loop has to reach them


@dataclass(frozen=True)
class Plan:
    """Hold a method prepared for one run: the compiled step, its parameter block, its memory, its controller."""

    step: Any  # a Step of kernels/data/common.py, or the name of one
    options: Array
    memory: Array
    exponent: float
    first: Any = None  # the two steps between which `step` chooses
    second: Any = None
    safety: float = 0.9
    factor_min: float = 0.2
    factor_max: float = 5.0
    limit_start: float = np.inf
    limit_factor: float = 0.7
    limit_memory: int = 10
    symmetric: bool = False
    least_error: float = 0.0  # what a smaller error counts as in the trend that the step size follows; 0: follows none
    rough: float = 1.0  # how many times less than its error the estimate of a step may be where a force jumps
    reuse: float = 0.0  # correction of a position up to which the Jacobian before it serves, within a step
    watchful: bool = False  # whether short steps are a reason to look how near a singular position is
    projects: bool = False  # whether its steps ask for accelerations as a state stands and for the way back alone
    lands: bool = False  # whether steps are shortened to end at output times
    apart: bool = False  # whether errors of q and v are independent, so that the slope of q between steps is not v
    stable_to: Any = None  # memory -> h rho up to which vibration and decay are stable, for Looks of stability.py
    inner: Any = None  # the inner loop that calls code made for the mechanism; None: the general one
    own: tuple[Any, ...] = ()  # functions made for the mechanism, see kernels/data/common.py
    numbers: Any = None  # what those of the inner loop read ...
    own_numbers: Any = None  # ... and those of collocation
    matrices: int = 0  # of Newton's method: how many of (n_q, n_q) the workspace is to have room for
    parts: int = 1  # equal steps that a step is divided into for the solution between its ends ...
    interior: "Plan | None" = None  # ... and how they are made; None: by the method itself
    looks_within: bool = False  # whether its steps look at the equations between their ends; if not, they are limited
    unseen: float = 1.0  # of such a step, the longest part within which nothing is evaluated
    substitute: "Plan | None" = None  # what goes on where this one's values are not finite
    provisional: bool = False  # whether that takes over, too, where steps turn out to be no longer than its own may be
    traced: tuple[Any, ...] = ()  # what the callbacks were traced to, where a step goes by that: see traced_values.py
    within_newton: "Plan | None" = None  # the same, parts included, of steps by Newton's method; None: not divided

    @property
    def rule(self) -> list[float]:
        """Return the numbers of step-size control, see kernels/control/loop_state.py."""
        return [self.safety, self.exponent, self.factor_min, self.factor_max, self.least_error]

    @property
    def substitutes(self) -> list["Plan"]:
        """Return the substitute, its own substitute, and so on."""
        return [] if self.substitute is None else [self.substitute, *self.substitute.substitutes]

    def fresh(self) -> "Plan":
        """Return the plan for another run, with a memory of its own; plans that it holds are shared."""
        return self.changed(memory=self.memory.copy())

    def changed(self, **changes: Any) -> "Plan":
        """Return the plan with other values of some fields."""
        other = object.__new__(Plan)  # `replace` takes ten times as long
        vars(other).update(vars(self), **changes)
        return other


def takes_code(method: Any, fixed: bool) -> bool:
    """Return whether steps of a method call the inner loop only for what generated code can do."""
    said = getattr(method, "takes_code", None)
    return said is not None and bool(said(fixed))


def needs_code(method: Any) -> bool:
    """Return whether a method needs generated code."""
    return bool(getattr(method, "needs_code", False))


def least_tolerance(rtol: float, atol: float) -> float:
    """Return the smaller of the two, but not below rounding."""
    return max(min(rtol, atol), LEAST_TOLERANCE)


def outer_tolerance(rtol: float, atol: float, fixed: bool) -> float:
    """Return where the outer loop stops unless a method has its own rule."""
    return OUTER_TOL_FIXED if fixed else OUTER_SHARE * least_tolerance(rtol, atol)


class Method(Protocol):
    """Define what solve_dae needs of a method."""

    @property
    def name(self) -> str:
        """Return the name for messages and tables."""
        ...

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        ...


def check_tolerances(method: Method, *names: str) -> None:
    """Raise unless each tolerance of these names is None or a positive number."""
    for name in names:
        if getattr(method, name) is not None:
            check_positive(name, getattr(method, name))


def check_choices(method: Any) -> None:
    """Raise unless each option that is one of some words is one of these."""
    for option in fields(method):
        if get_origin(option.type) is Literal:
            check_choice(option.name, getattr(method, option.name), get_args(option.type))


_PLANS = BoundedCache()  # of methods that do not look at the system


def kept_plan(method: Method, n_q: int, rtol: float, atol: float) -> Plan:
    """Return the cached plan of a method that does not depend on the system: a part of others with own memories."""
    key = (id(method), n_q, rtol, atol)
    known: tuple[Method, Plan] | None = _PLANS.get(key)
    if known is None:
        _PLANS[key] = known = method, method.plan(n_q, rtol, atol, False)  # what is named by its id is held
    return known[1]

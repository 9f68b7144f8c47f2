"""Plan of a run, as a method sets it up, and rules that methods share."""

from dataclasses import dataclass, fields
from functools import cache
from typing import Any, Literal, Protocol, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_choice, check_positive
from twoloop.kernels.compile.caches import BoundedCache

Array = NDArray[np.float64]

# the inner loop ends after a correction of at most this, unit of q: as Newton's method converges quadratically, the
# error that remains is about the square of this correction
INNER_TOL = 1e-8
LEAST_ERROR = 0.01  # lower limit of the error, relative to the tolerance, in the trend that the step size follows
JUMP_RATIO = 10.0  # if a force jumps in a step, largest measured ratio of error to error estimate, for most methods
# a projection ends after a correction of positions by at most this, unit of q; velocities are then as accurate
LARGEST_MOVE = 1e-14
OUTER_TOL_RATIO = 0.01  # tolerance of the outer loop, relative to the tolerance of the step
OUTER_TOL_FIXED = 1e-14  # tolerance of the outer loop in fixed steps, which are iterated to rounding
LEAST_TOLERANCE = 1e-14  # lower limit of rtol and atol in rules that derive other values from them


@dataclass(frozen=True)
class Plan:
    """Method prepared for one run: the compiled step, its parameters, its memory and its step-size control."""

    step: Any  # a Step of kernels/data/common.py, or its name
    options: Array  # parameters of the step
    memory: Array  # data that the step keeps from attempt to attempt
    exponent: float  # the next step size is the present one times safety * error**-exponent
    first: Any = None  # for a pair of methods: `step` switches between the steps `first` and `second`
    second: Any = None
    safety: float = 0.9  # safety factor of the step size
    factor_min: float = 0.2  # smallest ratio of the next step size to the present one
    factor_max: float = 5.0  # largest ratio of the next step size to the present one
    limit_start: float = np.inf  # largest step size, s, unless a step has failed recently
    limit_factor: float = 0.7  # largest step size after a failed step, relative to the failed step
    limit_memory: int = 10  # number of accepted steps after a failed step for which `limit_factor` applies
    symmetric: bool = False  # whether each step uses the partition chosen at its midpoint
    least_error: float = 0.0  # lower limit of the error in the trend that the step size follows; 0: no trend
    jump_ratio: float = 1.0  # if a force jumps in a step, largest ratio of error to error estimate
    reuse: float = 0.0  # within a step, the previous Jacobian is used if positions are corrected by at most this
    checks_within: bool = False  # whether short steps trigger a check for a singular position nearby
    # whether steps evaluate accelerations without a projection, and call the projection separately
    projects: bool = False
    ends_at_outputs: bool = False  # whether steps are shortened to end at output times
    separate: bool = False  # whether errors of q and v are independent: then v is not the slope of q between steps
    # function of `memory` that returns the largest stable h rho for vibration and for decay, see control/stiffness.py
    stable_to: Any = None
    inner: Any = None  # inner loop that calls generated code; None: the general inner loop
    own: tuple[Any, ...] = ()  # generated functions, see kernels/data/common.py
    numbers: Any = None  # coefficients of the generated functions of the inner loop
    own_numbers: Any = None  # data of the generated functions of collocation
    matrices: int = 0  # number of (n_q, n_q) matrices of Newton's method in the workspace
    parts: int = 1  # number of equal steps into which a step is divided for the solution between its ends
    interior: "Plan | None" = None  # plan by which these `parts` are computed; None: the method's plan for fixed steps
    # whether steps evaluate the equations between their ends; if not, the step size is limited
    evaluates_within: bool = False
    max_gap: float = 1.0  # longest part of a step without an evaluation of the equations, relative to the step
    substitute: "Plan | None" = None  # plan that continues the run if values by this plan are not finite
    on_trial: bool = False  # whether the substitute also takes over if its own steps would be as long
    traced: tuple[Any, ...] = ()  # traces of the callbacks on which steps rely, see traced_values.py
    # plan for the parts of Newton steps, for the solution between their ends; None: Newton steps are not divided
    within_newton: "Plan | None" = None

    @property
    def rule(self) -> list[float]:
        """Return the parameters of step-size control, see kernels/control/loop_state.py."""
        return [self.safety, self.exponent, self.factor_min, self.factor_max, self.least_error]

    @property
    def substitutes(self) -> list["Plan"]:
        """Return the substitute, the substitute of the substitute, and so on."""
        return [] if self.substitute is None else [self.substitute, *self.substitute.substitutes]

    def fresh(self) -> "Plan":
        """Return a plan for another run, with its own memory; the plans in its fields are shared."""
        return self.changed(memory=self.memory.copy())

    def changed(self, **changes: Any) -> "Plan":
        """Return a copy of the plan with other values of some fields."""
        plan = object.__new__(Plan)  # `dataclasses.replace` takes ten times as long
        vars(plan).update(vars(self), **changes)
        return plan


def takes_code(method: Any, fixed: bool) -> bool:
    """Return whether steps of a method (if `fixed`: of its method for fixed steps) can run with generated code."""
    return bool(getattr(getattr(method, "fixed", method) if fixed else method, "takes_code", False))


def needs_code(method: Any) -> bool:
    """Return whether a method needs generated code."""
    return bool(getattr(method, "needs_code", False))


def least_tolerance(rtol: float, atol: float) -> float:
    """Return the smaller one of rtol and atol, but not less than LEAST_TOLERANCE."""
    return max(min(rtol, atol), LEAST_TOLERANCE)


def outer_tolerance(rtol: float, atol: float, fixed: bool) -> float:
    """Return the tolerance of the outer loop, relative to max(|value|, 1), for methods without a rule of their own."""
    return OUTER_TOL_FIXED if fixed else OUTER_TOL_RATIO * least_tolerance(rtol, atol)


class Method(Protocol):
    """Interface of a method that solve_dae uses."""

    @property
    def name(self) -> str:
        """Return the name of the method for messages and tables."""
        ...

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        ...


def check_tolerances(method: Method, *names: str) -> None:
    """Raise unless each of the named tolerances is None or a positive number."""
    for name in names:
        if getattr(method, name) is not None:
            check_positive(name, getattr(method, name))


def check_choices(method: Any) -> None:
    """Raise unless each option with a Literal type has one of its values."""
    for option in fields(method):
        if get_origin(option.type) is Literal:
            check_choice(option.name, getattr(method, option.name), get_args(option.type))


_PLANS = BoundedCache()  # plans of methods that do not depend on the system


def cached_plan(method: Method, n_q: int, rtol: float, atol: float) -> Plan:
    """Return the cached plan, for step-size control, of a method that does not depend on the system."""
    key = (id(method), n_q, rtol, atol)
    entry: tuple[Method, Plan] | None = _PLANS.get(key)
    if entry is None:
        # store the method, too, so that no other object gets the same id
        _PLANS[key] = entry = method, method.plan(n_q, rtol, atol, False)
    return entry[1]


def crossing_plan(n_q: int) -> Plan:
    """Return the plan of steps across a singular position."""
    from twoloop.kernels.steps import crossing_step as kernels

    return Plan(kernels.CROSSING, _crossing_options(), np.zeros(kernels.memory_size(n_q)), exponent=1.0 / kernels.ORDER)


@cache
def _crossing_options() -> Array:
    """Return the options of steps across a singular position; cached, because the tableau costs more than a step."""
    from twoloop.kernels.steps import crossing_step as kernels
    from twoloop.methods.tableaux import gauss

    tableau = gauss(kernels.S)
    return kernels.options_array(tableau.A, tableau.b, tableau.c, INNER_TOL, LARGEST_MOVE)

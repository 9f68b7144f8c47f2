"""Auto(...): the default method, which chooses a method for the system and switches during a run."""

from dataclasses import dataclass, replace

from twoloop.generate.collocation_code import compiles_quickly
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.graph import Untraceable
from twoloop.generate.series import is_quick, series_for
from twoloop.generate.time_dependence import may_be_steep
from twoloop.generate.traced_values import Check, unchecked
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.plan import Method, Plan, cached_plan, least_tolerance
from twoloop.methods.taylor import Taylor
from twoloop.problem.system import ConstrainedSystem

MANY = 16  # number of coordinates from which on evaluations cost more than the algebra of Adams' method ...
# ... if the constraints are at most this share of the coordinates (otherwise projections cost more) ...
CONSTRAINED = 0.25
TIGHT_MANY = 1e-10  # ... or if the tolerance is below this ...
VERY_MANY = 64  # ... or from this number of coordinates on, in any case
HUGE = 1000  # number of coordinates above which Newton's method, whose matrices are full, is not tried
LONG_STEPS = 1e-9  # the rule for this tolerance also applies to looser ones, if runs have few steps
SERIES = 1e-6  # tolerance below which a Taylor series costs less than DOP853 ...
SOME_OPERATIONS = 12  # ... with up to this number of operations per coordinate ...
# ... or up to this number with fewer than FEW coordinates, and with MANY coordinates at any looser tolerance
FEW_OPERATIONS = 8
FEW = 5
SERIES_OF_MANY = 1e-8  # as SERIES, for MANY coordinates with generated code
LOOSE = 3e-5  # tolerance from which on stiff motion is integrated by the method for few digits
TIGHTEST = 9e-7  # tolerance below which stiff motion is integrated by the method for many digits
LIMIT_FEW, LIMIT_MANY = 4.0, 0.25  # h rho from which on stiffness may limit DOP853 (stable to 5.9) and Adams
LIMIT_FEW_OF_MANY = 2.0  # h rho from which on stiffness may limit DOP853 with MANY coordinates
# number of successive estimates above the limit, because accuracy may allow long steps for a while (not with Adams)
ESTIMATES_FEW = 2
# times the order: h rho from which on stiffness may limit a series, stable to 0.42 (decay) or 0.6 times its order
LIMIT_SERIES = 0.3
COST_RATIO = 4.0  # cost of an evaluation without generated code, in evaluations with it, estimated ...
# ... and from MANY_OPERATIONS of callbacks per coordinate on, because these cost the same with and without code
COST_RATIO_HEAVY, MANY_OPERATIONS = 2.0, 17
MATRIX_COST = 3.0  # cost of a Newton matrix for few coordinates, in evaluations; plus one for every eight coordinates


def switching(first: Plan, second: Plan, limit: float, n_q: int, estimates: int = 1, cost_ratio: float = 1.0) -> Plan:
    """Return the plan that switches from `first`, explicit or by fixed point, to `second`, Newton's method, and back.

    `limit`: value of h rho (rho: largest rate of the motion) from which on `second` is tried, if this number of
    `estimates` in a row exceeds it. `cost_ratio`: cost of an evaluation of `second`, in evaluations of `first`.
    """
    from twoloop.kernels.control import stiffness as kernels

    plans = (first, second)
    each = [[*plan.rule, plan.reuse] for plan in plans]
    return first.changed(
        step=kernels.SWITCHING,
        options=kernels.switching_options(
            limit, estimates, MATRIX_COST + n_q / 8.0, cost_ratio, each, first.options, second.options
        ),
        memory=kernels.switching_memory(n_q, first.memory, second.memory),
        first=first.step,
        second=second.step,
        stable_to=None,
        matrices=max(first.matrices, second.matrices),
        within_newton=second.within_newton,
    )


def with_matrix_cost(plan: Plan, cost: float) -> Plan:
    """Return a copy of a plan of `switching` with another cost of a Newton matrix, in evaluations."""
    from twoloop.kernels.control import stiffness as kernels

    options = plan.options.copy()
    options[kernels.MATRIX_COST] = cost
    return plan.changed(options=options)


@dataclass(frozen=True)
class Auto:
    """Default method: explicit steps, and Newton's method where stiffness is measured; a run may switch both ways.

    A run begins with `series` if the operations of the callbacks can be traced and are few: at most 12 for each
    coordinate (8 with fewer than five coordinates) at tolerances below 1e-6; at looser ones at most 8, with 16
    coordinates or more. Otherwise it begins with `few`, or with `many`: from 64 coordinates on, and from 16 on if there
    are at most a quarter as many constraints or the tolerance is below 1e-10. With generated code (`compiled=True` of
    `solve_dae`, or its default for small mechanisms) it begins with `lanes`. If this cannot continue, or the equations
    are too long for it, the run continues with a series at tolerances below 1e-6 (from 16 coordinates on: below 1e-8),
    else with `few`, or from 64 coordinates on with `many`.

    Systems that give the values of entries begin with `few` from 64 coordinates on, too, unless tolerances are below
    1e-10 or there are at most a quarter as many constraints: their projections, one a step, cost as much as
    evaluations.

    At looser tolerances than these a run also begins with `series` if the other methods may take no steps longer than a
    hundredth of the run. Within 10 steps it continues without the series if the next step would be no longer than that.
    Steps of `few` may be longer if forces and constraints have no quotients, roots or fast vibrations. A run also
    continues without the series if the series is not finite and the functions are.

    The largest rate of the motion is estimated from the derivatives of the accelerations, after 100 evaluations and
    then after every 600 (two to four times as many with generated code). The implicit method is tried for 15 steps if
    the steps have come near the limit of stability that this rate sets (at two estimates in a row; at one with `many`,
    and with `few` from 16 coordinates on), or are above 5 % of it and the rate is more than thirty times that of the
    motion itself, or all that could move at this rate is within ten tolerances of velocities. Unless the steps are far
    beyond that limit, the trial waits until the run has cost three trials, and 64 evaluations for each independent
    coordinate if tangents have to be differenced, or until three tenths of the cost of the whole run, extrapolated from
    its present cost, are as much. If the run is to cost a thousand trials, one is made whatever the rates. The implicit
    method is kept if a second of motion costs it less, counted in evaluations and Newton matrices: `loose` at
    tolerances from 3e-5 on, `tightest` below 9e-7, else `tight`. The run returns to the explicit method if the steps
    come below that limit, or if a second of motion costs more than with the explicit method. Counts decide, not times:
    a run can be repeated.

    Above 1000 coordinates no implicit method is tried, as its matrices are full. No series is tried if M and C_q have
    more than 200,000 entries together, zeros among them, as it takes seconds to find (method="Taylor" does it).

    While the implicit method runs, errors of positions are within the tolerances; velocities are tested for the errors
    that they will cause in the positions before they turn back or decay. With fixed steps, `fixed` makes the whole run.

    Parameters
    ----------
    few, many : method object
        Explicit methods, for few and for many coordinates.
    series : Taylor or None
        None: only `few` and `many`; `for_system` sets None if callbacks are not made of operations that it knows.
    loose, tight, tightest : method object
        Implicit methods, for loose, tight and the tightest tolerances.
    fixed : method object
        Method for fixed steps.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method="auto")
    >>> result.success
    True
    """

    few: Method
    many: Method
    series: Taylor | None
    loose: Method
    tight: Method
    tightest: Method
    fixed: Method
    lanes: Lobatto16 | None = None
    n_rows: int = 0  # number of constraints; solve_dae sets it
    # cost of an evaluation without generated code, in evaluations with it; None: there is no code
    cost_ratio: float | None = None
    # whether the system gives its matrices by entries: an evaluation then costs no more than a projection
    sparse: bool = False
    # whether forces may change much over a short distance, so that every method must limit its steps
    narrow: bool = True

    @property
    def name(self) -> str:
        """Return the name for messages and tables."""
        return "auto"

    @property
    def tested(self) -> str:
        """Return the quantities that the error estimate of implicit steps counts."""
        return "positions"

    def for_system(
        self, system: ConstrainedSystem, code: GeneratedCode | None = None, check: Check = unchecked
    ) -> "Auto":
        """Return the method for a system; without `series` if its operations are unknown or unreliable."""
        sparse = len(system.entries) == 2 and system.n_a == 0
        chosen = replace(self, n_rows=system.n_c + system.n_a, series=None, lanes=None, sparse=sparse)
        if code is not None:
            lanes = self.lanes if compiles_quickly(code.shared) else None
            lanes = None if lanes is None else lanes.for_system(system, code)
            chosen = replace(chosen, lanes=lanes, cost_ratio=_cost_ratio(system))
        plain = code is None and (system.called_in_python or not is_quick(system))
        if self.series is None or plain:
            return chosen
        try:
            series = self.series.for_system(system, code, check)
        except ValueError:
            return chosen
        return replace(chosen, series=series, narrow=may_be_steep(system, force_was_traced=True))

    def _series_pays(self, n_q: int, tolerance: float) -> bool:
        """Return whether a step of the series costs less than the steps that it replaces."""
        assert self.series is not None and self.series.program is not None
        operations = self.series.program.n_operations / n_q
        if self.cost_ratio is not None:  # the series takes over only near singular positions: it is more exact
            return tolerance < (SERIES if n_q < MANY else SERIES_OF_MANY)
        if tolerance < SERIES:
            return operations <= (SOME_OPERATIONS if n_q >= FEW else FEW_OPERATIONS)
        return operations <= FEW_OPERATIONS and n_q >= MANY

    def takes_code(self, fixed: bool) -> bool:
        """Return whether its steps may run with generated code."""
        return not fixed  # fixed steps are implicit

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the plan of the method for a run of n_q coordinates."""
        if fixed:
            return self.fixed.plan(n_q, rtol, atol, True)
        fallback = self._without_lanes(n_q, rtol, atol)
        if self.lanes is None or self.lanes.code is None:
            return fallback
        plan = self.lanes.plan(n_q, rtol, atol, False)
        traced = (*plan.traced, *fallback.traced)
        return plan.changed(substitute=fallback, traced=traced, within_newton=fallback.within_newton)

    def _without_lanes(self, n_q: int, rtol: float, atol: float) -> Plan:
        """Return the plan without collocation in lanes: one evaluation at a time."""
        tolerance = least_tolerance(rtol, atol)
        implicit = self.loose if tolerance >= LOOSE else self.tight if tolerance >= TIGHTEST else self.tightest
        second = cached_plan(implicit, n_q, rtol, atol)
        cost_ratio = 1.0 if self.cost_ratio is None else self.cost_ratio
        if self.series is None or self.series.program is None:
            return self._explicit(n_q, rtol, atol, second, cost_ratio)
        pays = self._series_pays(n_q, tolerance)
        explicit = self._explicit(n_q, rtol, atol, second, cost_ratio)
        # at looser tolerances the series also pays if the other methods are limited to a hundredth of the run
        stages_suffice = explicit.unseen < 1.0 and not self.narrow
        if not pays and (stages_suffice or not self._series_pays(n_q, LONG_STEPS)):
            return explicit
        series = self.series.plan(n_q, rtol, atol, False)
        chosen = switching(series, second, LIMIT_SERIES / series.exponent, n_q, ESTIMATES_FEW, cost_ratio)
        return chosen.changed(substitute=explicit, provisional=not pays)

    def _explicit(self, n_q: int, rtol: float, atol: float, second: Plan, cost_ratio: float) -> Plan:
        """Return the plan of the explicit method and its switch to Newton's method, without a series."""
        many = n_q >= VERY_MANY and not self.sparse
        if n_q >= MANY and self.cost_ratio is None:
            many = many or self.n_rows <= CONSTRAINED * n_q or least_tolerance(rtol, atol) < TIGHT_MANY
        explicit, limit, estimates = (self.many, LIMIT_MANY, 1) if many else (self.few, LIMIT_FEW, ESTIMATES_FEW)
        if explicit is self.few and n_q >= MANY:  # here evaluations cost more than a trial
            limit, estimates = LIMIT_FEW_OF_MANY, 1
        if n_q > HUGE:
            return explicit.plan(n_q, rtol, atol, False)
        return switching(explicit.plan(n_q, rtol, atol, False), second, limit, n_q, estimates, cost_ratio)


def _cost_ratio(system: ConstrainedSystem) -> float:
    """Return the cost of an evaluation of the implicit method, in evaluations of generated code."""
    try:
        return COST_RATIO_HEAVY if series_for(system).n_operations >= MANY_OPERATIONS * system.n_q else COST_RATIO
    except Untraceable:
        return COST_RATIO

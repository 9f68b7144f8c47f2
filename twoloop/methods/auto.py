"""Auto(...): the default method, which chooses a method for the system and switches during a run."""

from dataclasses import dataclass, replace
from typing import ClassVar

from twoloop.generate.collocation_code import compiles_quickly
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.graph import Untraceable
from twoloop.generate.series import is_quick_to_trace, series_for
from twoloop.generate.time_dependence import forces_may_be_steep
from twoloop.generate.traced_values import Check, accept_traces
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.plan import Method, Plan, cached_plan, least_tolerance
from twoloop.methods.taylor import Taylor
from twoloop.problem.system import ConstrainedSystem

# Adams may replace DOP853 if there are at least MANY_COORDINATES coordinates: evaluations may then cost more than the
# algebra of Adams' method. It does if there are at most MAX_CONSTRAINT_RATIO constraints per coordinate (with more,
# projections cost more than evaluations); or if the tolerance is below ADAMS_TOLERANCE; or if there are at least
# VERY_MANY_COORDINATES coordinates, except with sparse matrices
MANY_COORDINATES, VERY_MANY_COORDINATES, MAX_CONSTRAINT_RATIO, ADAMS_TOLERANCE = 16, 64, 0.25, 1e-10
MAX_NEWTON_COORDINATES = 1000  # Newton's method, with full matrices, is tried up to this number of coordinates
# if the other methods need short steps, a series is chosen at any looser tolerance by the rule for this tolerance
SHORT_STEP_TOLERANCE = 1e-9
SERIES_TOLERANCE = 1e-6  # a Taylor series may cost less than DOP853 if the tolerance is below this
MAX_OPERATIONS = 12  # up to this number of operations per coordinate, a Taylor series costs less than DOP853
# MAX_OPERATIONS_FEW replaces MAX_OPERATIONS with fewer than FEW_COORDINATES coordinates and, at looser tolerances than
# SERIES_TOLERANCE, with at least MANY_COORDINATES
MAX_OPERATIONS_FEW, FEW_COORDINATES = 8, 5
# replaces SERIES_TOLERANCE if there is generated code, and there are at least MANY_COORDINATES coordinates
SERIES_TOLERANCE_MANY = 1e-8
LOOSE = 3e-5  # at this tolerance and looser ones, the method for few digits integrates stiff motion
TIGHTEST = 9e-7  # below this tolerance, the method for many digits integrates stiff motion
# if h rho is at least this (rho: largest rate of motion), stiffness may limit steps of DOP853 (stable to 5.9), of Adams
LIMIT_FEW, LIMIT_MANY = 4.0, 0.25
LIMIT_FEW_OF_MANY = 2.0  # replaces LIMIT_FEW with at least MANY_COORDINATES: evaluations then cost more than a trial
# number of successive estimates of h rho above the limit before a trial: more than one, because accuracy may allow a
# few long steps; for Adams, and with LIMIT_FEW_OF_MANY, one estimate is enough
ESTIMATES_FEW = 2
# if h rho / order is at least this, stiffness may limit a series, which is stable to 0.42 (decay) or 0.6 (vibration)
LIMIT_SERIES = 0.3
COST_RATIO = 4.0  # estimated cost of an evaluation without generated code, in evaluations with generated code
# COST_RATIO_HEAVY replaces COST_RATIO if callbacks take at least MANY_OPERATIONS per coordinate: these operations cost
# the same with and without generated code
COST_RATIO_HEAVY, MANY_OPERATIONS = 2.0, 17
MATRIX_COST = 3.0  # cost of a Newton matrix, in evaluations: this number plus an eighth of the number of coordinates


def switching(first: Plan, second: Plan, limit: float, n_q: int, estimates: int = 1, cost_ratio: float = 1.0) -> Plan:
    """Return the plan that switches from `first`, explicit or by fixed point, to `second`, Newton's method, and back.

    `second` is tried if `estimates` successive estimates of h rho (rho: largest rate of the motion) exceed `limit`.
    `cost_ratio`: cost of an evaluation of `second`, in evaluations of `first`.
    """
    from twoloop.kernels.control import stiffness as kernels

    plans = (first, second)
    rules = [[*plan.rule, plan.reuse] for plan in plans]
    return first.changed(
        step=kernels.SWITCHING,
        options=kernels.switching_options(
            limit, estimates, MATRIX_COST + n_q / 8.0, cost_ratio, rules, first.options, second.options
        ),
        memory=kernels.switching_memory(n_q, first.memory, second.memory),
        first=first.step,
        second=second.step,
        stable_to=None,
        matrices=max(first.matrices, second.matrices),
        within_newton=second.within_newton,
    )


def with_matrix_cost(plan: Plan, cost: float) -> Plan:
    """Return a copy of a plan of `switching` with the cost of a Newton matrix set to `cost`, in evaluations."""
    from twoloop.kernels.control import stiffness as kernels

    options = plan.options.copy()
    options[kernels.MATRIX_COST] = cost
    return plan.changed(options=options)


@dataclass(frozen=True)
class Auto:
    """Default method: "Lobatto16" or explicit steps, and Newton's method while the motion is stiff.

    A run begins with one of these methods:

    - `lanes` with generated code (`compiled=True` of `solve_dae`, or its default for small mechanisms). If this method
      cannot continue, or the equations are too long for it, the run uses `series` at tolerances below 1e-6 (with 16
      coordinates or more: below 1e-8), else `few`, or `many` with 64 coordinates or more.
    - `series` if the operations of the callbacks can be traced and are few: at most 12 per coordinate (8 with fewer
      than five coordinates) at tolerances below 1e-6; at looser tolerances at most 8, with 16 coordinates or more.
    - `many` with 64 coordinates or more; with 16 or more, if there are at most a quarter as many constraints or the
      tolerance is below 1e-10. Systems that give the entries of sparse matrices need one of the last two conditions,
      because their projections, one per step, cost as much as evaluations.
    - `few` otherwise.

    At looser tolerances a run also begins with `series` if the other methods may take no steps longer than a hundredth
    of the run. It continues without the series if, after one of its first 10 steps, the next step would be no longer
    than this either. Steps of `few` may be longer if forces and constraints have no quotients, roots or fast
    vibrations. A run also continues without the series if the series is not finite although the callbacks are.

    The largest rate of the motion is estimated from the derivatives of the accelerations, after 100 evaluations and
    then after every 600 (two to four times as many with generated code). This rate sets the limit of stability of the
    explicit steps. The implicit method is tried for 15 steps if

    - steps have come near the limit, at two successive estimates (at one with `many`, and with `few` if there are 16
      coordinates or more);
    - steps are above 5 % of the limit, and the rate is more than thirty times the rate of the motion itself, or all
      velocities that could vibrate or decay at this rate are within ten tolerances;
    - the whole run is expected to cost a thousand trials.

    Unless steps are far above the limit, the trial waits until the run has cost three trials, and 64 evaluations for
    each independent coordinate if tangents have to be computed by differences. Three tenths of the expected cost of the
    whole run count as spent. The implicit method (`loose` at tolerances of 3e-5 or looser, `tightest` below 9e-7, else
    `tight`) is kept if a second of motion costs less with it, counted in evaluations and Newton matrices. The run
    returns to the explicit method if the steps come below the limit, or if the explicit method costs less. Counts
    decide, not times, so that a run can be repeated.

    Above 1000 coordinates no implicit method is tried, because its matrices are full. No series is tried if M and C_q
    have more than 200,000 entries, zeros included, because tracing would take seconds (method="Taylor" traces them).

    While the implicit method runs, errors of positions are within the tolerances; velocities are tested for the errors
    that they will cause in the positions before they turn back or decay. Fixed steps are taken by `fixed`.

    Parameters
    ----------
    few, many : method object
        Explicit methods, for few and for many coordinates.
    series : Taylor or None
        None: only `few` and `many`. `for_system` sets None if callbacks cannot be traced.
    loose, tight, tightest : method object
        Implicit methods, for loose, tight and the tightest tolerances.
    fixed : method object
        Method for fixed steps.
    lanes : Lobatto16 or None
        Method with generated code.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method="auto")
    >>> result.success
    True
    """

    name: ClassVar[str] = "auto"
    takes_code: ClassVar[bool] = True
    tested: ClassVar[str] = "positions"  # quantities that the error estimate of implicit steps counts
    few: Method
    many: Method
    series: Taylor | None
    loose: Method
    tight: Method
    tightest: Method
    fixed: Method
    lanes: Lobatto16 | None = None
    n_rows: int = 0  # number of constraints; solve_dae sets it
    # cost of an evaluation without generated code, in evaluations with generated code; None: there is no code
    cost_ratio: float | None = None
    # whether the system gives the entries of sparse matrices: an evaluation then costs no more than a projection
    sparse: bool = False
    # whether forces may change much over a distance shorter than a step: then every method must limit its steps
    narrow: bool = True

    def for_system(
        self, system: ConstrainedSystem, code: GeneratedCode | None = None, check: Check = accept_traces
    ) -> "Auto":
        """Return the method for a system; without `series` if callbacks cannot be traced or `check` refuses traces."""
        sparse = len(system.entries) == 2 and system.n_a == 0
        method = replace(self, n_rows=system.n_c + system.n_a, series=None, lanes=None, sparse=sparse)
        if code is not None:
            lanes = self.lanes if compiles_quickly(code.shared) else None
            lanes = None if lanes is None else lanes.for_system(system, code)
            method = replace(method, lanes=lanes, cost_ratio=_cost_ratio(system))
        untraced = code is None and (system.called_in_python or not is_quick_to_trace(system))
        if self.series is None or untraced:
            return method
        try:
            series = self.series.for_system(system, code, check)
        except ValueError:
            return method
        return replace(method, series=series, narrow=forces_may_be_steep(system, force_was_traced=True))

    def _series_pays(self, n_q: int, tolerance: float) -> bool:
        """Return whether a step of the series costs less than the steps of the explicit method that it replaces."""
        assert self.series is not None and self.series.program is not None
        operations = self.series.program.n_operations / n_q
        if self.cost_ratio is not None:  # generated code: near singular positions, a series is more exact
            return tolerance < (SERIES_TOLERANCE if n_q < MANY_COORDINATES else SERIES_TOLERANCE_MANY)
        if tolerance < SERIES_TOLERANCE:
            return operations <= (MAX_OPERATIONS if n_q >= FEW_COORDINATES else MAX_OPERATIONS_FEW)
        return operations <= MAX_OPERATIONS_FEW and n_q >= MANY_COORDINATES

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        if fixed:
            return self.fixed.plan(n_q, rtol, atol, True)
        fallback = self._without_lanes(n_q, rtol, atol)
        if self.lanes is None or self.lanes.code is None:
            return fallback
        plan = self.lanes.plan(n_q, rtol, atol, False)
        traced = (*plan.traced, *fallback.traced)
        return plan.changed(substitute=fallback, traced=traced, within_newton=fallback.within_newton)

    def _without_lanes(self, n_q: int, rtol: float, atol: float) -> Plan:
        """Return the plan without `lanes`, the method with collocation in SIMD lanes."""
        tolerance = least_tolerance(rtol, atol)
        implicit = self.loose if tolerance >= LOOSE else self.tight if tolerance >= TIGHTEST else self.tightest
        second = cached_plan(implicit, n_q, rtol, atol)
        cost_ratio = 1.0 if self.cost_ratio is None else self.cost_ratio
        if self.series is None or self.series.program is None:
            return self._explicit(n_q, rtol, atol, second, cost_ratio)
        pays = self._series_pays(n_q, tolerance)
        explicit = self._explicit(n_q, rtol, atol, second, cost_ratio)
        # at looser tolerances, the series also pays if steps of the other methods are limited to a hundredth of the run
        stages_suffice = explicit.max_gap < 1.0 and not self.narrow
        if not pays and (stages_suffice or not self._series_pays(n_q, SHORT_STEP_TOLERANCE)):
            return explicit
        series = self.series.plan(n_q, rtol, atol, False)
        chosen = switching(series, second, LIMIT_SERIES / series.exponent, n_q, ESTIMATES_FEW, cost_ratio)
        return chosen.changed(substitute=explicit, on_trial=not pays)

    def _explicit(self, n_q: int, rtol: float, atol: float, second: Plan, cost_ratio: float) -> Plan:
        """Return the plan of the explicit method, `few` or `many`, with its switch to Newton's method, `second`."""
        many = n_q >= VERY_MANY_COORDINATES and not self.sparse
        if n_q >= MANY_COORDINATES and self.cost_ratio is None:
            many = many or self.n_rows <= MAX_CONSTRAINT_RATIO * n_q or least_tolerance(rtol, atol) < ADAMS_TOLERANCE
        explicit, limit, estimates = (self.many, LIMIT_MANY, 1) if many else (self.few, LIMIT_FEW, ESTIMATES_FEW)
        if explicit is self.few and n_q >= MANY_COORDINATES:  # here evaluations cost more than a trial
            limit, estimates = LIMIT_FEW_OF_MANY, 1
        if n_q > MAX_NEWTON_COORDINATES:
            return explicit.plan(n_q, rtol, atol, False)
        return switching(explicit.plan(n_q, rtol, atol, False), second, limit, n_q, estimates, cost_ratio)


def _cost_ratio(system: ConstrainedSystem) -> float:
    """Return the estimated cost of an evaluation without generated code, in evaluations with generated code."""
    try:
        return COST_RATIO_HEAVY if series_for(system).n_operations >= MANY_OPERATIONS * system.n_q else COST_RATIO
    except Untraceable:
        return COST_RATIO

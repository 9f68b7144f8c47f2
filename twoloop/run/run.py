"""Set up a run: its plan, kit, workspace and state, and the accelerations at its start."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.sparse_rows import Rows, SparseRows, norms
from twoloop.checks.structure import (
    SHOWN,
    dependent_rows,
    describe_dependence,
    describe_equations,
    least_inertia,
    mass_and_rows,
    pattern_of,
)
from twoloop.generate.time_dependence import ShortForces, find_short_forces, forces_may_be_steep
from twoloop.generate.traced_values import CheckedRegion
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.data.common import Kit
from twoloop.kernels.evaluation.tasks import SOLVE
from twoloop.kernels.layout import cached_run, copy_workspace
from twoloop.methods.auto import with_matrix_cost
from twoloop.methods.plan import Plan, least_tolerance
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.messages import describe_not_finite
from twoloop.run.singular_positions import (
    PIVOT_FACTOR,
    SMALL_PIVOT,
    WEAK_RATIO,
    describe_singular_start,
    singular_threshold,
)
from twoloop.run.workspace import add_newton_program, fixed_order_form, kit_for_plan, make_kit, workspace

Array = NDArray[np.float64]
Buffers = tuple[Array, Array, Array]  # arrays of times, states and records of steps

# largest number of attempted steps in the first chunk (call of compiled code) of a small system. Each chunk is followed
# by checks in Python, which take 0.2 ms: much compared with the time of a shorter chunk
FIRST_CHUNK = 1024
FIRST_CHUNK_IN_PYTHON = 64  # largest number of steps in the first chunk if callbacks are (slow) Python functions
SMALL_SYSTEM = 32  # largest number of coordinates of a small system; chunks of larger ones are proportionally smaller
TRIAL_STEPS = 10  # number of first steps in which a method on trial must propose step sizes above tolerances[GAP]
NO_PATTERN = np.zeros((0, 0))  # empty argument `pattern` of `workspace`: a FixedOrderForm has its own pattern
# constraints contradict one another if a row of G a = Gamma is violated by more than this * max(sum of |terms|, 1)
CONTRADICTION = 1e-6


class Run:
    """Data of an integration: plan, kit, workspace, state and settings. A new Run is at its start.

    Raise ValueError if accelerations at the start cannot be computed, or if constraints contradict one another.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        plan: Plan,
        t0: float,
        q0: Array,
        v0: Array,
        rtol: float,
        atol: Array,
        step_size: float | None,
        interiors: Mapping[int, Plan] = MappingProxyType({}),
    ):
        from twoloop.kernels import advance  # compiled, or read from the cache, at the first run of a process
        from twoloop.kernels.control import loop_state

        self.kernels, self.a = advance, loop_state
        self.system, self.plan, self.t0 = system, plan, t0
        self.memory = plan.memory.copy()
        self.rtol, self.reuse, self.interior_plans, self.traced = rtol, plan.reuse, interiors, plan.traced
        self.least_atol = float(atol.min())
        plans = plan, *plan.substitutes
        self.fixed_order = fixed_order_form(system, t0, q0, *plans)
        self.matrices = max(each.matrices for each in plans)
        self.kit = make_kit(system, t0, q0, plan, self.fixed_order)
        n_rows = system.n_c + system.n_a
        self.state = np.concatenate([q0, v0, np.zeros(system.n_q + n_rows)])
        # the ranks of constraint rows at this start are not known yet: first try those at the last start
        self.work = self._make_workspace(*(system.derived.get("ranks", ()) if self.fixed_order is None else ()))
        self.new_state = np.zeros_like(self.state)
        self.tolerances = np.zeros(indices.ATOL + system.n_q)
        self.tolerances[indices.RTOL] = rtol
        self.tolerances[indices.ESTIMATE] = step_size is None
        self.tolerances[indices.LEAST] = least_tolerance(rtol, self.least_atol)
        self.tolerances[indices.ATOL :] = atol
        self.control = np.zeros(loop_state.N_CONTROL)
        self.control[loop_state.MAX_STEP], self.control[loop_state.MAX_EVALUATION_GAP] = np.inf, 1.0
        self.control[loop_state.FIXED_STEP] = 0.0 if step_size is None else step_size
        self.control[loop_state.MAX_STEPS] = np.inf
        self.control[loop_state.MAY_CROSS], self.control[loop_state.SAMPLE_MOTION] = self.fixed_order is None, 1.0
        rate_kinds = system.given.keys() & {"constraint_rate", "nonholonomic_rate"}  # callbacks for the rates C_t and b
        self.control[loop_state.MAY_JUMP] = bool(rate_kinds)
        first_chunk = FIRST_CHUNK_IN_PYTHON if system.called_in_python else FIRST_CHUNK
        self.chunk = max(1, first_chunk // max(1, system.n_q // SMALL_SYSTEM))  # largest number of attempts in a chunk
        self.clock = np.zeros(loop_state.N_CLOCK)
        self._reset_clock(t0)
        self.write_step_control(plan)
        self.substituted = False  # whether `plan.substitute` has replaced the first plan
        self.near_threshold = singular_threshold(rtol)  # near a singular position, min pivot / max pivot is below this
        force_traced = any("force" in each.kinds for each in plan.traced)
        short_and_steep = system.remembered(
            ("changes", force_traced),
            lambda: (find_short_forces(system, force_traced), forces_may_be_steep(system, force_traced)),
        )
        short_forces, steep = (ShortForces(False, False), True) if step_size is not None else short_and_steep
        self.short_forces: ShortForces = short_forces
        self.control[[loop_state.BY_TIME, loop_state.BY_STATE]] = self.short_forces
        self.forces_may_be_steep = steep or plan.max_gap == 1.0
        self.crossings: list[list[tuple[float, Array]]] = []  # for each crossing, (t, state) before it and after it
        # the next seven attributes belong to steps across a singular position, see fallbacks.py
        self.mirrored_size = 0.0  # size (s) of a step that begins as far before a singular position as it ends beyond
        self.crossing_tolerances = self.tolerances  # tolerances of steps across singular positions
        self.sizes_to_try: list[float] = []  # step sizes (s) still to be tried across a singular position
        self.attempts_left = np.inf  # the search for a step across a singular position ends after so many failures
        self.crossing_size = 0.0  # size (s) of the last attempted step across a singular position
        # error (in tolerances, at most 1; inf: none) and size (s) of the most accurate of these steps so far
        self.best_attempt = np.inf, 0.0
        self.piece_ends: list[float] = []  # end times (s) of steps still to be taken along a crossing's polynomial
        self.origins: list[Any] = []  # the `Origin` of each polynomial that is still to be tried for a crossing
        self.t1 = np.inf  # end of the run (s)
        self.starts_singular = False  # whether the start is a singular position: nearby, C_q has a higher rank
        self.branch_known = False  # whether it is known on which branch the motion leaves a singular start
        self.jumps: list[float] = []  # times (s) at which velocities jumped because C_t, or b in A v + b = 0, jumped
        self.compared_until = [-np.inf]  # callbacks and traces agree up to this time (s); a run's copies share the list
        self.region: CheckedRegion | None = None  # where callbacks agreed with traces; None: the system's region
        self.varied_parameters: Array | None = None  # current parameters in a ParametricRun; None in other runs
        self._compute_start_accelerations()
        self.rank = len(self.work.rows_v)
        self.descriptions: dict[tuple[int, ...], str] = {}  # cached warnings; the keys are indices of redundant rows
        self.redundant, self.rows_warning = self.find_redundant_rows()
        self.start_warning = self._start_warning()

    def copy(self) -> "Run":
        """Return a copy of this run, which must be at its start."""
        new_run = self._copy_without_workspace()
        new_run.work = copy_workspace(self.work)
        return new_run

    def copy_to_start(self, t0: float, q0: Array, v0: Array) -> "Run | None":
        """Return a copy of this run at another start; None if constraints have other ranks there, or `restart` fails.

        The run must not use the fixed-order form (sparse factors in a fixed order of elimination).
        """
        new_run = self._copy_without_workspace()
        new_run.t0, new_run.compared_until, new_run.state[: len(q0)] = t0, [-np.inf], q0
        new_run.work = new_run._make_workspace(len(self.work.rows), len(self.work.rows_v))
        if new_run.restart(t0, q0, v0) != indices.DONE:
            return None
        new_run.redundant, new_run.rows_warning = new_run.find_redundant_rows()
        new_run.start_warning = new_run._start_warning()
        return new_run

    def restart(self, t: float, q: Array, v: Array) -> int:
        """Begin anew at the state (q, v) at t, without the past steps; return DONE or a failure code."""
        n, state = self.system.n_q, self.state
        state[:n], state[n : 2 * n], state[2 * n :] = q, v, 0.0
        self.plan.memory[:] = self.memory
        self._reset_clock(t)
        code: int = entry_point(self.kernels.start)(self.kit, self.work, t, state)
        return code

    def move_to_singular_start(self, t: float, q: Array, v: Array, a: Array, first_size: float) -> None:
        """Begin the run in the singular position beside its start; `first_size`: size (s) of the first step."""
        n, clock = self.system.n_q, self.clock
        self.t0, self.starts_singular, self.branch_known = t, True, True
        self.state[:n], self.state[n : 2 * n], self.state[2 * n : 3 * n], self.state[3 * n :] = q, v, a, np.nan
        self._reset_clock(t)
        clock[self.a.H_LONG], clock[self.a.LARGEST_PIVOT] = first_size, self.work.notes[indices.PIVOT]
        self.start_warning = (
            "the run begins in a singular position, where the constraints lose rank: it follows the branch of the "
            "motion to which v0 belongs; multipliers are not determined there, and are NaN at the start"
        )

    def _reset_clock(self, t: float) -> None:
        """Reset `clock`, the array of times, step sizes and similar numbers, for a run that begins at t."""
        a, clock = self.a, self.clock
        clock[:] = 0.0
        clock[a.T] = clock[a.T_START] = t
        clock[[a.JUMP_FROM, a.JUMP_TO, a.PIVOT_AT_OUTPUT, a.SHORTEST_CHANGE]] = np.inf
        sample_times = a.JUMP_END, a.SAMPLED_TO, a.MOTION_SAMPLED_TO, a.COMPARED
        clock[[*sample_times, a.DISCONTINUITY, a.DISCONTINUITY_OF_MOTION, a.LAST_CHANGE]] = -np.inf
        clock[a.H_LIMIT] = self.plan.limit_start

    def advance(
        self, outputs: Array, buffers: Buffers, filled: NDArray[np.int64], active: tuple[Plan, Array, Kit] | None = None
    ) -> int:
        """Take compiled steps to the last of `outputs`, or until Python must act; return the end code (loop_state.py).

        A step ends at each time in `outputs`. States and steps are stored in `buffers`; `filled` counts them.
        `active`: plan, `control` and kit for this call; None: those of the run.
        """
        plan, control, kit = active or (self.plan, self.control, self.kit)
        tolerances = self.tolerances if plan is self.plan else self.crossing_tolerances
        arrays = plan.options, plan.memory, tolerances, control, self.clock, self.state, self.new_state
        code: int = entry_point(self.kernels.advance)(kit, self.work, *arrays, outputs, *buffers, filled)
        return code

    def _copy_without_workspace(self) -> "Run":
        """Return a copy of this run, still without a workspace; the run must be at its start."""
        new_run = object.__new__(Run)
        vars(new_run).update(
            vars(self),
            plan=self.plan.fresh(),
            state=self.state.copy(),
            new_state=self.new_state.copy(),
            tolerances=self.tolerances.copy(),
            control=self.control.copy(),
            clock=self.clock.copy(),
            crossings=[],
            jumps=[],
        )
        new_run.crossing_tolerances = new_run.tolerances
        # in the augmented form, kernels may change the flags of the kit: so the copy needs a kit of its own
        if self.fixed_order is None and self.kit.flags[indices.FORM] == indices.AUGMENTED:
            new_run.kit = kit_for_plan(self.system, self.kit.flags, new_run.plan)
        return new_run

    @property
    def ends_at_outputs(self) -> bool:
        """Whether steps end at all output times."""
        return self.plan.ends_at_outputs or self.control[self.a.FIXED_STEP] > 0.0

    def write_step_control(self, plan: Plan) -> None:
        """Copy a plan's constants for step-size control to the arrays `control` and `clock`, which kernels read."""
        a, control = self.a, self.control
        control[: a.N_RULE] = plan.rule
        control[a.LIMIT_START], control[a.LIMIT_FACTOR] = plan.limit_start, plan.limit_factor
        control[a.LIMIT_MEMORY], control[a.SYMMETRIC] = plan.limit_memory, plan.symmetric
        control[a.JUMP_RATIO], control[a.CHECKS_WITHIN] = plan.jump_ratio, plan.checks_within
        control[a.MAY_SWITCH] = plan.substitute is not None
        control[a.TAKES_MANY] = getattr(plan.step, "many", None) is not None
        control[a.TRIAL_STEPS] = TRIAL_STEPS if plan.on_trial else -1.0
        self.clock[a.H_LIMIT] = plan.limit_start

    def _make_workspace(self, rank: int | None = None, rank_v: int | None = None) -> Any:
        """Return a new workspace for the ranks of C_q (`rank`) and all constraint rows (`rank_v`); None: full rank."""
        q0 = self.state[: self.system.n_q]
        pattern = pattern_of(self.system, self.t0, q0) if self.fixed_order is None else NO_PATTERN
        ranks = rank, rank_v
        work = workspace(
            self.system, self.kit, pattern, q0, self.rtol, self.reuse, ranks, self.fixed_order, self.matrices
        )
        work.notes[indices.NEARLY_SINGULAR] = 0.0 if self.plan.checks_within else 1.0
        return work

    def may_succeed_in_other_form(self, code: int) -> bool:
        """Return whether another form of linear algebra may succeed where sparse factors failed with `code`."""
        failure_codes = (indices.INNER_DIVERGED, indices.SINGULAR, indices.MASS_NOT_DEFINITE)
        return (
            self.fixed_order is not None
            and code in (self.a.STEP_TOO_SMALL, self.a.FIXED_STEP_FAILED, self.a.RANK_LOST)
            and int(self.clock[self.a.FAILURE_CODE]) in failure_codes
        )

    def change_form(self) -> None:
        """Continue a run with another form of linear algebra; the kit and workspace are replaced for this.

        If the fixed-order form lacks the program for Newton's matrix, add it; else take a dense form (saddle_point.py).
        """
        n = self.system.n_q
        old_work, largest_pivot = self.work, float(self.clock[self.a.LARGEST_PIVOT])
        rank = len(old_work.rows_v)
        t, q = float(self.clock[self.a.T]), self.state[:n].copy()
        form, self.fixed_order = self.fixed_order, None
        if form is not None and form.newton_program is None and self.matrices > 0:
            self.fixed_order = add_newton_program(self.system, t, q, form)
        if self.fixed_order is not None and self.plan.first is not None:
            self.plan = with_matrix_cost(self.plan, self.fixed_order.matrix_cost())
        self.kit = make_kit(self.system, t, q, self.plan, self.fixed_order)
        self.work = self._make_workspace(rank, rank)
        self.work.counters[:] = old_work.counters
        notes = [indices.LARGEST_DEFECT, indices.UNCHECKED, indices.WIDEST_GAP, indices.LAST_JUMP, indices.NEXT_JUMP]
        self.work.notes[notes] = old_work.notes[notes]
        self.control[self.a.MAY_CROSS] = self.fixed_order is None
        clock, a = self.clock, self.a
        if clock[a.FAILURE_CODE] != indices.DONE:
            clock[a.H_NEXT], clock[a.H_LIMIT] = clock[a.H_LONG] or clock[a.H_NEXT], self.plan.limit_start
            clock[a.FAILURE_CODE] = indices.DONE
        state = self.state.copy()
        code = entry_point(self.kernels.start)(self.kit, self.work, t, state)
        if code == indices.RANK_DIFFERS:  # keep the rank at the start of the run, even if the rank is higher now
            self.work.notes[indices.GENERATION] = 1.0
            code = entry_point(self.kernels.start)(self.kit, self.work, t, state)
        if old_work.notes[indices.PIVOT] > 0.0 and largest_pivot > 0.0:  # rescale the largest pivot for the new form
            pivot = self.work.notes[indices.PIVOT]
            self.clock[self.a.LARGEST_PIVOT] = pivot * max(1.0, largest_pivot / old_work.notes[indices.PIVOT])

    def _compute_start_accelerations(self) -> None:
        """Compute the accelerations at the start; if that fails, try other ranks or another form of linear algebra."""
        start = entry_point(self.kernels.start)
        code = start(self.kit, self.work, self.t0, self.state)
        if self.fixed_order is not None and code == indices.RANK_DIFFERS:
            rank = int(self.work.notes[indices.RANK])
            self.work = self._make_workspace(rank, rank)
            code = start(self.kit, self.work, self.t0, self.state)
        if self.fixed_order is not None and code not in (indices.DONE, indices.NOT_FINITE):
            if self.work.notes[indices.SMALLEST] < 0.0:  # M is not definite: later runs must not use this form
                self.system.derived["fixed-order form"] = None
            self.fixed_order = None
            self.kit = make_kit(self.system, self.t0, self.state[: self.system.n_q], self.plan)
            self.control[self.a.MAY_CROSS] = 1.0
            self.work = self._make_workspace()
            code = start(self.kit, self.work, self.t0, self.state)
        if code == indices.RANK_DIFFERS:
            ranks = int(self.work.notes[indices.RANK]), int(self.work.notes[indices.RANK_V])
            self.system.derived["ranks"] = ranks
            self.work = self._make_workspace(*ranks)
            code = start(self.kit, self.work, self.t0, self.state)
        if code == indices.GAMMA_INACCURATE:  # ignored here: the first step reports this error in a result
            required_accuracy = self.work.notes[indices.GAMMA_REQUIRED]
            self.work.notes[indices.GAMMA_REQUIRED] = np.inf
            code = start(self.kit, self.work, self.t0, self.state)
            self.work.notes[indices.GAMMA_REQUIRED] = required_accuracy
        if code == indices.DONE:
            return
        n = self.system.n_q
        if code == indices.MASS_NOT_DEFINITE:
            raise ValueError(
                f"mass of {self.system.name!r} must be positive definite on the velocities that the constraints allow; "
                f"at t = {self.t0!r} {least_inertia(self.system, self.t0, self.state[:n])[1]}"
            )
        if code == indices.SINGULAR:
            raise ValueError(
                f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: the constraint "
                f"Jacobian has lost rank there ({dependent_rows(self.system, self.t0, self.state[:n])}). Start from "
                "another position"
            )
        raise ValueError(
            f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: {describe_not_finite(self)}"
        )

    def find_redundant_rows(self) -> tuple[NDArray[np.int64], str]:
        """Return indices of redundant rows at the start, and a warning or ""; ValueError if rows are contradictory."""
        n_rows = self.system.n_c + self.system.n_a
        if self.rank == n_rows:
            return np.zeros(0, dtype=np.int64), ""
        independent_rows = set(self.work.rows_v.tolist())
        redundant = [i for i in range(n_rows) if i not in independent_rows]
        system, q = self.system, self.state[: self.system.n_q]
        if system.called_in_python or system.entries:
            rows = system.sparse_rows(self.t0, q)
        else:
            rows = mass_and_rows(system, self.t0, q)[1]
        violated = self.violated_rows(rows).tolist()
        if violated:
            raise ValueError(
                f"the constraints of {self.system.name!r} contradict one another at t = {self.t0:g}: "
                f"{self._describe_rows(rows, violated)}, but not so their accelerations. Correct or leave out one of "
                "these rows"
            )
        if (redundant_rows := tuple(redundant)) not in self.descriptions:
            self.descriptions[redundant_rows] = (
                f"the constraints of {self.system.name!r} have rank {self.rank} of {n_rows}, first at t = {self.t0:g}: "
                f"{self._describe_rows(rows, redundant)}. They are left out of the solution and checked at every "
                "step; multipliers are those of least norm. See docs/constraints.md#redundant-rows"
            )
        return np.array(redundant), self.descriptions[redundant_rows]

    def _start_warning(self) -> str:
        if self.work.notes[indices.PIVOT] > (PIVOT_FACTOR * WEAK_RATIO if self.fixed_order is None else SMALL_PIVOT):
            return ""
        atol, q = self.tolerances[indices.ATOL :], self.state[: self.system.n_q]
        return describe_singular_start(self.system, self.t0, q, self.rank, self.rtol, atol)

    def violated_rows(self, rows: Rows) -> NDArray[np.int64]:
        """Return the indices of the rows of G a = Gamma that the accelerations at the start violate; `rows`: G."""
        n = self.system.n_q
        a, gamma = self.state[2 * n : 3 * n], self.work.Gamma
        residual = np.abs(rows @ a - gamma)
        if residual.max() <= CONTRADICTION:  # no row is violated: the limit of each row is at least CONTRADICTION
            return np.zeros(0, dtype=np.int64)
        return np.flatnonzero(residual > CONTRADICTION * np.maximum(abs(rows) @ np.abs(a) + np.abs(gamma), 1.0))

    def _describe_rows(self, all_rows: Rows, rows: list[int]) -> str:
        """Describe how the rows with the indices `rows` depend on the other rows of `all_rows`."""
        if not isinstance(all_rows, SparseRows):
            return describe_dependence(all_rows, rows)
        q, independent_rows = self.state[: self.system.n_q], self.work.rows_v.tolist()
        if self.fixed_order is None or set(rows) & set(independent_rows):
            return describe_dependence(self.system.rows(self.t0, q), rows)
        factors, zero, x = np.zeros((min(SHOWN, len(rows)), len(all_rows))), np.zeros(len(all_rows)), np.zeros_like(q)
        for row, factor in zip(rows, factors, strict=False):  # write this row as factor @ (independent rows)
            entry_point(self.kit.inner)(self.kit, self.work, SOLVE, self.t0, all_rows.row(row), zero, 0.0, x, factor)
        return describe_equations(rows, independent_rows, factors[:, independent_rows], norms(all_rows))

    def set_step_sizes(self, first_step: float | None, max_step: float, t1: float) -> None:
        """Set the first step size and the limits of step sizes (s); `first_step` None: estimate the first size."""
        self.max_step = max_step
        self.limit_steps()
        proposed_size = self.choose_first_step(self.t0, t1, self.state, max_step)
        first_size = min(first_step or proposed_size, t1 - self.t0)
        self.clock[self.a.H_NEXT], self.control[self.a.FIRST_GIVEN] = first_size, float(first_step is not None)
        self.control[self.a.SHORTEST] = cached_run().SHORTEST_STEP * first_size

    def limit_steps(self) -> None:
        """Limit steps so that successive force evaluations are at most 1 % of the run apart, to detect short forces.

        If forces may vary much within a step, one evaluation at a stage may not detect a short force: then the step
        size itself is at most 1 % of the run. Methods that add evaluations within long steps need no limit.
        """
        gap = 1.0 if self.forces_may_be_steep else self.plan.max_gap
        max_size = np.inf if self.plan.evaluates_within else self.tolerances[indices.GAP] / gap
        self.control[self.a.MAX_STEP], self.control[self.a.MAX_EVALUATION_GAP] = min(self.max_step, max_size), gap

    def choose_first_step(self, t: float, t1: float, state: Array, longest: float = 0.0) -> float:
        """Return the size (s) of the first step from a state; if `longest` (max_step) > 0, also store step limits."""
        numbers = self.system.n_q, t, t1, self.least_atol, longest, self.plan.evaluates_within
        size: float = entry_point(cached_run().first_step_and_limits)(self.control, self.tolerances, state, *numbers)
        return size

    def defect(self) -> float | None:
        """Return the largest defect of the steps, or None if there is a step whose defect was not evaluated."""
        notes = self.work.notes
        is_checked = self.work.counters[indices.N_ACCEPTED] > 0 and notes[indices.UNCHECKED] == 0.0
        return float(notes[indices.LARGEST_DEFECT]) if is_checked else None

    def passed_near_singular(self) -> bool:
        """Return whether rounding may have changed output velocities, because a singular position was near.

        This is checked at output times, and at the ends of steps of fixed size.
        """
        # pivots of the fixed-order form differ more than those of other forms: min / max pivot has a smaller limit
        threshold = self.near_threshold if self.fixed_order is None else SMALL_PIVOT
        return bool(self.clock[self.a.PIVOT_AT_OUTPUT] < threshold)

    def n_attempts(self) -> int:
        """Return the number of attempted steps so far."""
        c = self.work.counters
        return int(c[indices.N_ACCEPTED] + c[indices.N_REJECTED_ERROR] + c[indices.N_REJECTED_CONVERGENCE])

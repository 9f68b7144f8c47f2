"""Dense output: interpolate the stored states of a run by polynomials, and project the result onto the constraints.

An interval is the time between two accepted states. Interior states are states within an interval, which are computed
when needed: an interval too long for one accurate polynomial is divided into shorter steps that end at such states.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import check_real, shaped
from twoloop.checks.consistency import ConstraintWarning
from twoloop.checks.structure import pattern_of
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.data.indices import ATOL, RTOL
from twoloop.kernels.steps.stages import load_step
from twoloop.methods.plan import INNER_TOL, Plan, crossing_plan
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.signals import signals_of
from twoloop.run.workspace import fixed_order_form, make_kit, prepare_workspace, workspace

if TYPE_CHECKING:
    from twoloop.run.run import Run

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

MAX_DIVIDED_INTERVALS = 512  # when states within more intervals than this are cached, the cache is emptied
MAX_ACCURATE_INTERVALS = 65536  # the set of intervals with accurate polynomials is emptied when it is larger than this
# a polynomial is accurate if it violates constraints and equations of motion by at most MAX_ERROR tolerances. Across a
# singular position, velocity errors are ten times the violation: there the limit is MAX_ERROR_ACROSS tolerances
MAX_ERROR, MAX_ERROR_ACROSS = 10.0, 1.0
N_REPAIR_STEPS = 4  # number of steps into which an interval is divided if its polynomial is not accurate


class StateTable(NamedTuple):
    """States at the ends of steps: n times, n rows [q, v, a], and the kinds of the n - 1 intervals between them."""

    t: Array
    states: Array
    kinds: NDArray[np.int64]  # kinds of the intervals: codes such as SEPARATE, see kernels/data/indices.py


def ranks_at(system: ConstrainedSystem, t: float, q: Array, v: Array, rtol: float) -> tuple[int, int]:
    """Return the rank of C_q and the rank of [C_q; A] (A: rows of non-holonomic constraints) at a state."""
    from twoloop.kernels import advance

    kit = make_kit(system, t, q)
    work = workspace(system, kit, pattern_of(system, t, q), q, rtol, 0.0)
    state = np.concatenate([q, v, np.zeros(system.n_q + system.n_c + system.n_a)])
    if advance.start(kit, work, t, state) != indices.RANK_DIFFERS:
        return min(system.n_c, system.n_q), min(system.n_c + system.n_a, system.n_q)
    return int(work.notes[indices.RANK]), int(work.notes[indices.RANK_V])


class Interpolator:
    """Interpolator between the states of a `StateTable`, with a workspace of its own.

    `t0`, `row`: time and [q, v, a] of a state of the run. `ranks`: rank of C_q, and rank of all constraint rows.
    `plans`: a plan for each kind of intervals that are too long for one polynomial. The method of the plan divides such
    an interval into `plan.parts` equal steps.
    """

    def __init__(
        self,
        system: ConstrainedSystem,
        t0: float,
        row: Array,
        rtol: float,
        atol: Array,
        ranks: tuple[int, int],
        plans: Mapping[int, Plan] = MappingProxyType({}),
    ):
        from twoloop.kernels import interpolation as dense

        self.kernels = dense
        self.plans = dict(plans)
        self.arguments = (system, t0, row.copy(), rtol, atol, ranks, self.plans)
        self.system, self.rtol, self.ranks = system, rtol, ranks
        self.tolerances = np.concatenate([np.zeros(ATOL), atol])
        self.tolerances[RTOL] = rtol
        self.parts = max([N_REPAIR_STEPS, *(plan.parts for plan in self.plans.values())])
        self.fixed_order = fixed_order_form(system, t0, row[: system.n_q], *self.plans.values())
        self.matrices = max((plan.matrices for plan in self.plans.values()), default=0)
        self._create_workspace()
        self.failures, self.warns = 0, True  # number of failed projections in the last call; whether to warn of these
        # key: time at which a divided interval begins; value: times and states within the interval and at its ends
        self.interior_states: dict[float, tuple[Array, Array]] = {}
        # key: time at which a step across a singular position begins; value: the step's `memory`, with a polynomial
        self.crossing_memories: dict[float, Array] = {}
        self.accurate_intervals: set[float] = set()  # start times of intervals with an accurate polynomial
        self.may_divide = True  # whether to compute states within intervals; False: such states were read from a file
        self._allocate_scratch()

    def _create_workspace(self) -> None:
        """Create the workspace and the kits for the current form of linear algebra, `self.fixed_order`."""
        system, t0, row = self.arguments[:3]
        q0, form = row[: system.n_q], self.fixed_order
        for plan in self.plans.values():
            load_step(plan.second)  # import the step of the second method of a pair, to which a kernel may switch
        self.kits = {kind: make_kit(system, t0, q0, plan, form) for kind, plan in self.plans.items()}
        self.kit = make_kit(system, t0, q0, None, form)
        pattern = pattern_of(system, t0, q0) if form is None else np.zeros((0, 0))
        self.work = workspace(system, self.kit, pattern, q0, self.rtol, 0.0, self.ranks, form, self.matrices)
        self._initialize_workspace()

    def _initialize_workspace(self) -> None:
        """Compute the accelerations at the start, and thereby fill the arrays of the workspace."""
        from twoloop.kernels import advance

        system, t0, row = self.arguments[:3]
        self.work.notes[indices.GENERATION] = 1.0  # number of partitions: unless it is 0, kernels keep `self.ranks`
        state = np.concatenate([row, np.zeros(system.n_c + system.n_a)])
        entry_point(advance.start)(self.kit, self.work, t0, state)
        self.repair_plans: dict[bool, tuple[Plan, Any]] = {}

    def reset(self, system: ConstrainedSystem, t0: float, row: Array, pattern: Array) -> None:
        """Reset the interpolator for another run with the same compiled functions (kits).

        `row`: [q, v, a] at the start of that run, t0. `pattern`: 1 for entries of [C_q; A] that may be nonzero, else 0.
        """
        self.arguments = (system, t0, row.copy(), *self.arguments[3:])
        self.system, self.may_divide = system, True
        self.interior_states, self.crossing_memories, self.accurate_intervals = {}, {}, set()
        prepare_workspace(self.work, system, self.kit.flags, pattern, row[: system.n_q], self.rtol, 0.0)
        self._initialize_workspace()
        self.nodes[:], self.scratch[:], self.rows[:] = 0.0, 0.0, 0.0

    def _switch_to_dense_form(self) -> None:
        """Use dense linear algebra from now on, because sparse factors in a fixed order of elimination have failed."""
        self.fixed_order = None
        self._create_workspace()

    def _allocate_scratch(self) -> None:
        """Allocate scratch arrays for the interpolated times and the coefficients of two polynomials."""
        n_nodes = 3 * max(indices.WINDOW, self.parts + 1)
        n = self.system.n_q
        self.nodes, self.scratch, self.rows = np.zeros(2 * n_nodes), np.zeros((2 * n_nodes, n)), np.zeros((3, 2 * n))

    def __reduce__(self) -> tuple[Any, ...]:  # for copies and pickles
        *arguments, plans = self.arguments
        # copies do not call generated code, because its addresses are valid in this process only
        plans = {kind: plan.changed(own=()) if plan.own else plan for kind, plan in plans.items()}
        state = {name: getattr(self, name) for name in ("parts", "interior_states", "crossing_memories", "may_divide")}
        return type(self), (*arguments, plans), state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._allocate_scratch()

    def states(self, table: StateTable, times: Array) -> Array:
        """Return rows [q, v] at `times`, which must be sorted and within the table."""
        if len(times) == 0 or len(table.t) == 1:
            return np.repeat(table.states[:1, : 2 * self.system.n_q], len(times), axis=0)
        numbers = np.searchsorted(table.t[1:-1], times, side="right")
        (first,) = np.concatenate([[True], numbers[1:] != numbers[:-1]]).nonzero()
        intervals = _interval_rows(table, numbers[first])
        intervals[:, indices.FIRST_TIME], intervals[:-1, indices.END_TIME] = first, first[1:]
        intervals[-1, indices.END_TIME] = len(times)
        out = np.empty((len(times), 2 * self.system.n_q))
        failures = 0
        undivided = []
        for block in _blocks_of_intervals(intervals):
            self._divide_inaccurate_intervals(table, block)
            divided, divided_intervals, other_intervals = self._split_intervals(table, block)
            failures += self._interpolate_intervals(divided, divided_intervals, times, out)
            undivided.append(other_intervals)
        failures += self._interpolate_intervals(table, np.concatenate(undivided), times, out)
        self._record_failures(failures, len(times))
        return out

    def row_function(self, table: StateTable, t: float) -> Callable[[float], Array]:
        """Return a function that computes the row [q, v] at any time in the interval of `table` that contains t."""
        intervals = _interval_rows(table, np.searchsorted(table.t[1:-1], [t], side="right"))
        intervals[:, indices.END_TIME] = 1
        self._divide_inaccurate_intervals(table, intervals)
        divided, divided_intervals, other_intervals = self._split_intervals(table, intervals)
        source, row = (divided, divided_intervals) if len(divided_intervals) else (table, other_intervals)
        time, out = np.empty(1), np.empty((1, 2 * self.system.n_q))

        def row_at(t: float) -> Array:
            time[0] = t
            self._record_failures(self._interpolate_intervals(source, row, time, out), 1)
            return out[0].copy()

        return row_at

    def _record_failures(self, failures: int, n_times: int) -> None:
        """Store the number of failed projections, and warn of them if `self.warns`."""
        self.failures = failures
        if failures > 0 and self.warns:
            _warn_of_lost_rank(f"at {failures} of {n_times} times the state is interpolated and off the constraints", 5)

    def _interpolate_intervals(self, table: StateTable, intervals: Integers, times: Array, out: Array) -> int:
        """Store rows [q, v] at `times`, all within `intervals`, in `out`; return how many projections failed."""
        inputs = (self.tolerances, table.t, table.states, np.ascontiguousarray(intervals))
        rest = (times, self.nodes, self.scratch, out)
        failures = int(entry_point(self.kernels.interpolate_states)(self.kit, self.work, INNER_TOL, *inputs, *rest))
        if failures > 0 and self.fixed_order is not None:
            self._switch_to_dense_form()
            failures = int(entry_point(self.kernels.interpolate_states)(self.kit, self.work, INNER_TOL, *inputs, *rest))
        return failures

    def _divide_inaccurate_intervals(self, table: StateTable, intervals: Integers) -> None:
        """Compute and cache states within each of `intervals` that one polynomial does not interpolate accurately."""
        start_times = table.t[intervals[:, indices.FIRST_OWN]].tolist()
        is_new = np.array([t not in self.accurate_intervals and t not in self.interior_states for t in start_times])
        if not self.may_divide or not is_new.any():
            return
        if len(self.interior_states) > MAX_DIVIDED_INTERVALS:
            self.interior_states.clear()
            is_new = np.array([t not in self.accurate_intervals for t in start_times])
        if len(self.accurate_intervals) > MAX_ACCURATE_INTERVALS:
            self.accurate_intervals.clear()
        intervals = intervals[is_new & (intervals[:, indices.KIND] != indices.JUMP)]
        for kind, plan in self.plans.items():
            has_kind = intervals[:, indices.KIND] == kind
            self.interior_states.update(
                self._divide_intervals(table, plan, self.kits[kind], intervals[has_kind, indices.FIRST_OWN])
            )
        for i in intervals[:, indices.FIRST_OWN].tolist():
            if (memory := self.crossing_memories.get(float(table.t[i]))) is not None:
                self.interior_states[float(table.t[i])] = self._states_in_crossing_step(table, i, memory)
        is_divided = np.array(
            [t in self.interior_states for t in table.t[intervals[:, indices.FIRST_OWN]].tolist()], dtype=bool
        )
        divided, own_intervals, undivided = self._split_intervals(table, intervals)
        errors = np.zeros(len(intervals))
        errors[is_divided] = self._estimate_residuals(divided, own_intervals)
        errors[~is_divided] = self._estimate_residuals(table, undivided)
        # intervals of the kinds in `plans` are too long for one polynomial: if division failed, the error is infinite
        errors[~is_divided & np.isin(intervals[:, indices.KIND], list(self.plans))] = np.inf
        is_accurate = errors <= np.where(intervals[:, indices.KIND] == indices.ACROSS, MAX_ERROR_ACROSS, MAX_ERROR)
        self.accurate_intervals.update(table.t[intervals[~is_divided & is_accurate, indices.FIRST_OWN]].tolist())
        for k in (~is_accurate).nonzero()[0]:
            self._repair_interval(table, intervals[k], float(errors[k]))

    def _estimate_residuals(self, table: StateTable, intervals: Integers) -> Array:
        """Estimate by how many tolerances each interval's polynomial violates constraints and equations of motion."""
        out, intervals = np.zeros(len(intervals)), np.ascontiguousarray(intervals)
        arrays = self.tolerances, table.t, table.states, intervals, self.nodes, self.scratch, self.rows, out
        entry_point(self.kernels.estimate_errors)(self.kit, self.work, INNER_TOL, *arrays)
        return out

    def _repair_interval(self, table: StateTable, interval: Integers, smallest: float) -> None:
        """Try three other polynomials for an interval whose polynomial is inaccurate; keep the most accurate of all.

        They go through states of a step across a singular position, the ends of N_REPAIR_STEPS steps, or only the ends
        of the interval. `smallest`: violation by the present polynomial, see `_estimate_residuals`.
        """
        i, kind = int(interval[indices.FIRST_OWN]), int(interval[indices.KIND])
        begin = float(table.t[i])
        candidates = (
            lambda: self._cross_interval(table, i),
            lambda: self._divide_intervals(table, *self._plan_for_repair(kind), np.array([i])).get(begin),
            lambda: (table.t[i : i + 2], table.states[i : i + 2]),
        )
        for candidate in candidates:
            if smallest <= MAX_ERROR_ACROSS or (interior := candidate()) is None:
                continue
            new_table = StateTable(np.ascontiguousarray(interior[0]), np.ascontiguousarray(interior[1]), table.kinds)
            new_interval, last = interval[None, :].copy(), len(new_table.t) - 1
            new_interval[0, [indices.FIRST_OWN, indices.LAST_OWN, indices.LOW, indices.HIGH]] = 0, last, 0, last
            error = float(self._estimate_residuals(new_table, new_interval)[0])
            if error < smallest or not np.isfinite(smallest):
                smallest = error
                self.interior_states[begin] = new_table.t, new_table.states
        if begin not in self.interior_states:
            self.accurate_intervals.add(begin)

    def _cross_interval(self, table: StateTable, i: int) -> tuple[Array, Array] | None:
        """Step through interval i as if across a singular position; return times and states, or None on failure."""
        from twoloop.kernels.steps import crossing_step as kernels

        if self.fixed_order is not None:
            return None
        plan, (begin, end), n = crossing_plan(self.system.n_q), table.t[i : i + 2].tolist(), self.system.n_q
        kernels.begin_polynomial(plan.memory, 0.0, begin, True)
        tolerances = self.tolerances.copy()
        tolerances[[indices.ESTIMATE, indices.GAP]] = 1.0, np.inf
        tolerances[indices.LEAST] = tolerances[[RTOL, *range(ATOL, ATOL + n)]].min()
        state = np.concatenate([table.states[i], np.zeros(self.system.n_c + self.system.n_a)])
        take_step = entry_point(kernels.crossing_step)
        take_step(self.kit, self.work, plan.options, plan.memory, begin, end - begin, tolerances, state, state.copy())
        succeeded = plan.memory[-kernels.N_STORED :][kernels.END] > begin
        return self._states_in_crossing_step(table, i, plan.memory) if succeeded else None

    def _states_in_crossing_step(self, table: StateTable, i: int, memory: Array) -> tuple[Array, Array]:
        """Return times and states within interval i, given the `memory` where a crossing step stored a polynomial."""
        from twoloop.kernels.steps.crossing_step import state_at

        n, options = self.system.n_q, crossing_plan(self.system.n_q).options
        times = np.linspace(table.t[i], table.t[i + 1], self.parts + 1)
        states = np.array([state_at(memory, options, t) for t in times])
        # at both ends of the interval, use q and v of the table, but not a, which may have large rounding errors
        states[[0, -1], : 2 * n] = table.states[i : i + 2, : 2 * n]
        return times, states

    def _plan_for_repair(self, kind: int) -> tuple[Plan, Any]:
        """Return the plan and the kit for dividing an interval of this kind into N_REPAIR_STEPS steps."""
        is_stiff = kind == indices.VELOCITIES
        if is_stiff not in self.repair_plans:
            from twoloop.methods.dop853 import DOP853
            from twoloop.methods.runge_kutta import RungeKutta
            from twoloop.methods.tableaux import radau_iia

            method = RungeKutta(radau_iia(3), outer="newton") if is_stiff else DOP853()
            atol = float(self.tolerances[ATOL:].min())
            plan = method.plan(self.system.n_q, self.rtol, atol, True).changed(parts=N_REPAIR_STEPS)
            q0 = self.arguments[2][: self.system.n_q]
            if plan.matrices > self.matrices:
                self.matrices = plan.matrices
                if self.fixed_order is not None:
                    self.fixed_order = fixed_order_form(self.system, self.arguments[1], q0, *self.plans.values(), plan)
                self._create_workspace()
            self.repair_plans[is_stiff] = plan, make_kit(self.system, self.arguments[1], q0, plan, self.fixed_order)
        return self.repair_plans[is_stiff]

    def _split_intervals(self, table: StateTable, intervals: Integers) -> tuple[StateTable, Integers, Integers]:
        """Return a table of cached states within `intervals`, the intervals with such states, and those without."""
        start_times = table.t[intervals[:, indices.FIRST_OWN]].tolist()
        is_divided = np.array([t in self.interior_states for t in start_times], dtype=bool)
        pairs = [self.interior_states[t] for t in start_times if t in self.interior_states]
        divided = intervals[is_divided]
        if not pairs:
            return StateTable(table.t[:0], table.states[:0], table.kinds), divided, intervals
        t, states = zip(*pairs, strict=True)
        sizes = np.array(list(map(len, t)), dtype=np.int64)
        divided[:, indices.LAST_OWN] = divided[:, indices.HIGH] = np.cumsum(sizes) - 1
        divided[:, indices.FIRST_OWN] = divided[:, indices.LOW] = divided[:, indices.LAST_OWN] - sizes + 1
        return StateTable(np.concatenate(t), np.concatenate(states), table.kinds), divided, intervals[~is_divided]

    def _divide_intervals(
        self, table: StateTable, plan: Plan, kit: Any, numbers: Integers
    ) -> dict[float, tuple[Array, Array]]:
        """Divide each interval in `numbers` (indices) into `plan.parts` steps; if one of them fails, into fewer.

        Return a dict: the key is the time at which an interval begins, the value is its (times, states). Intervals that
        cannot even be divided into two steps are left out.
        """
        n = self.system.n_q
        state = np.zeros(3 * n + self.system.n_c + self.system.n_a)
        step_arrays = (plan.options, plan.memory.copy(), plan.memory, self.tolerances, state, state.copy())
        interior_states = {}
        for parts in range(plan.parts, 1, -1):
            if len(numbers) == 0:
                break
            n_states = parts + 1
            out_t, out = np.empty(n_states * len(numbers)), np.empty((n_states * len(numbers), 3 * n))
            entry_point(self.kernels.fill_intervals)(
                kit, self.work, *step_arrays, table.t, table.states, numbers, out_t, out
            )
            times, states = out_t.reshape(-1, n_states), out.reshape(-1, n_states, 3 * n)
            succeeded = np.isfinite(times[:, 0])
            start_times = times[:, 0].tolist()
            interior_states.update({start_times[k]: (times[k], states[k]) for k in succeeded.nonzero()[0].tolist()})
            numbers = numbers[~succeeded]
        return interior_states

    def interior_blocks(self, table: StateTable) -> Iterator[tuple[Array, Array]]:
        """Yield the states within all divided intervals, in blocks, so that the caller can store them in a file.

        A block has times (m, parts + 1) and rows [q, v, a] (m, parts + 1, 3 n_q) of m intervals, padded with NaN.
        """
        intervals = _interval_rows(table, np.arange(len(table.t) - 1))
        for block in _blocks_of_intervals(intervals):
            self._divide_inaccurate_intervals(table, block)
            start_times = table.t[block[:, indices.FIRST_OWN]].tolist()
            pairs = [self.interior_states[t] for t in start_times if t in self.interior_states]
            shape = (len(pairs), self.parts + 1)
            t, states = np.full(shape, np.nan), np.full((*shape, table.states.shape[1]), np.nan)
            for row, (own_t, own) in enumerate(pairs):
                t[row, : len(own_t)], states[row, : len(own)] = own_t, own
            yield t, states

    def restore_interior_states(self, t: Array, states: Array) -> None:
        """Use `states` read from a file as states within intervals (see `interior_blocks`); compute no further ones."""
        self.parts, self.may_divide = t.shape[1] - 1, False
        self._allocate_scratch()
        sizes = np.isfinite(t).sum(axis=1).tolist()
        self.interior_states = {
            float(own_t[0]): (own_t[:n], own[:n]) for own_t, own, n in zip(t, states, sizes, strict=True) if n
        }

    def fill_accelerations(self, times: Array, states: Array, out: Array) -> None:
        """Store rows [a, lam] in `out`, given times and rows [q, v] that satisfy the constraints; NaN on failure."""
        fill, times, states = entry_point(self.kernels.fill_accelerations), *map(np.ascontiguousarray, (times, states))
        failures = fill(self.kit, self.work, times, states, out)
        if failures > 0 and self.fixed_order is not None:
            self._switch_to_dense_form()
            failures = fill(self.kit, self.work, times, states, out)
        self.failures, n = failures, self.system.n_q
        if failures > 0:
            # at a start in a singular position, store the known accelerations; multipliers stay NaN (the run warned)
            is_missing = np.isnan(out[:, :n]).any(axis=1)
            out[is_missing & (times == self.arguments[1]), :n] = self.arguments[2][2 * n :]
            n_missing = int(np.isnan(out[:, :n]).any(axis=1).sum())
            if n_missing > 0 and self.warns:
                text = f"at {n_missing} of {len(times)} times there are no accelerations and multipliers; they are NaN"
                _warn_of_lost_rank(text)


def _blocks_of_intervals(rows: Integers) -> list[Integers]:
    """Divide a table of intervals into blocks; the cache can hold all states within the intervals of one block."""
    return [rows[begin : begin + MAX_DIVIDED_INTERVALS] for begin in range(0, len(rows), MAX_DIVIDED_INTERVALS)]


def _interval_rows(table: StateTable, numbers: Integers) -> Integers:
    """Return the table of intervals that kernels read: a row for each index in `numbers`; columns: see indices.py."""
    rows = np.zeros((len(numbers), indices.N_COLUMNS), dtype=np.int64)
    rows[:, indices.FIRST_OWN], rows[:, indices.LAST_OWN] = numbers, numbers + 1
    rows[:, indices.KIND] = table.kinds[numbers]
    rows[:, indices.HIGH] = len(table.t) - 1
    # polynomials across a singular position use no states before the crossing: these may have large rounding errors
    is_crossing = np.append(False, table.kinds == indices.ACROSS)
    (crossing_starts,) = (is_crossing[1:] & ~is_crossing[:-1]).nonzero()
    if crossing_starts.size:
        is_across = is_crossing[numbers + 1]
        last_start = np.searchsorted(crossing_starts, numbers[is_across], side="right") - 1
        rows[is_across, indices.LOW] = crossing_starts[last_start]
    (jumps,) = (table.kinds == indices.JUMP).nonzero()
    if not jumps.size:
        return rows
    next_jump = np.searchsorted(jumps, numbers)
    rows[:, indices.LOW] = np.maximum(rows[:, indices.LOW], np.append(0, jumps + 1)[next_jump])
    rows[:, indices.HIGH] = np.append(jumps, len(table.t) - 1)[next_jump]
    return rows


def _warn_of_lost_rank(consequence: str, stacklevel: int = 4) -> None:
    warnings.warn(f"the constraint Jacobian has lost rank: {consequence}", ConstraintWarning, stacklevel)


class OutputInterpolation:
    """Interpolates states at output times. A cached integrator uses this object for one run after another."""

    def __init__(self, run: Run):
        self.run, self._rows = run, np.zeros((0, 0))
        self._interpolator: Interpolator | None = None

    def interpolate(self, times: Array, t: Array, rows: Array, kinds: NDArray[np.int64], pattern: Array) -> None:
        """Interpolate rows [q, v] at output `times`, and store them for `complete_rows`.

        `t`, `rows`: times and rows [q, v, a, lam] of accepted steps. `kinds`: kinds of the intervals between steps.
        `pattern`: 1 at the nonzero entries of the constraint rows at the start, 0 elsewhere.
        """
        run = self.run
        table = StateTable(t, rows[:, : 3 * run.system.n_q].copy(), kinds)
        interpolator = self._interpolator
        if interpolator is None:
            interpolator = interpolator_of(run, table.states[0])
            interpolator.warns = False
        else:
            interpolator.reset(run.system, run.t0, table.states[0], pattern)
        self._interpolator, self._rows = interpolator, interpolator.states(table, times)

    def complete_rows(self, times: Array) -> Array | None:
        """Return rows [q, v, a, lam] at `times`, for which `interpolate` has stored [q, v]; return None on failure."""
        interpolator, rows = self._interpolator, self._rows
        if interpolator is None or interpolator.failures > 0:
            return None
        a_and_lam = np.full((len(times), len(self.run.state) - rows.shape[1]), np.nan)
        interpolator.fill_accelerations(times, rows, a_and_lam)
        if interpolator.fixed_order is not None or interpolator.repair_plans:  # other runs cannot use this interpolator
            self._interpolator = None
        return np.concatenate([rows, a_and_lam], axis=1) if interpolator.failures == 0 else None


def interpolator_of(run: Run, row: Array) -> Interpolator:
    """Return a new interpolator for the states of a run; `row` is [q, v, a] at the start of the run."""
    ranks, atol = (len(run.work.rows), len(run.work.rows_v)), run.tolerances[indices.ATOL :]
    interiors = {kind: plan.fresh() for kind, plan in run.interior_plans.items()}
    return Interpolator(run.system, run.t0, row, run.rtol, atol, ranks, interiors)


class DenseState:
    """State of a run at one or more times, as `result.sol(t)` returns it.

    Attributes
    ----------
    t : float or ndarray (n,)
        Times, s.
    q, v : ndarray (n_q,) or (n_q, n)
        Coordinates and velocities, satisfying the constraints to rounding error. Exception: close to a singular
        position, rounding would dominate projected velocities: q and v are not projected, and a warning says so.
    a : ndarray (n_q,) or (n_q, n)
        Accelerations at these times, evaluated when they are first read.
    lam : ndarray (n_c + n_a,) or (n_c + n_a, n)
        Multipliers at these times, evaluated when they are first read.
    """

    def __init__(self, interpolator: Interpolator, t: Array, order: Integers, rows: Array):
        self._interpolator, self._order, self._rows = interpolator, order, rows
        n = interpolator.system.n_q
        self.t: Any = t if t.ndim else float(t)
        self.q, self.v = self._columns_by_time(rows[:, :n]), self._columns_by_time(rows[:, n:])

    def _columns_by_time(self, rows: Array) -> Array:
        """Return `rows` (in ascending time) as columns in the order of `self.t`; a vector if `self.t` is a number."""
        columns = np.empty(rows.shape[::-1])
        columns[:, self._order] = rows.T
        return columns if np.ndim(self.t) else columns[:, 0]

    @cached_property
    def _a_and_lam(self) -> Array:
        """Return accelerations and multipliers in one array, a row for each time in ascending order."""
        system, times = self._interpolator.system, np.atleast_1d(self.t)[self._order]
        out = np.empty((len(times), system.n_q + system.n_c + system.n_a))
        with signals_of(system):
            self._interpolator.fill_accelerations(times, self._rows, out)
        return out

    @property
    def a(self) -> Array:
        """Accelerations."""
        return self._columns_by_time(self._a_and_lam[:, : self._interpolator.system.n_q])

    @property
    def lam(self) -> Array:
        """Multipliers."""
        return self._columns_by_time(self._a_and_lam[:, self._interpolator.system.n_q :])


class DenseSolution:
    """Dense output, `result.sol`: the state of a run at any time between its start and its end.

    Between accepted steps q and v are Hermite polynomials; the inner loop then restores the dependent coordinates, so
    that the constraints hold to rounding. At an accepted step the state is the stored one. The polynomials go through
    q, v and a of four neighbouring states (order 12). Where Newton's method solved the outer loop, they go through q
    and v (order 8), because accelerations contain the noise of vibrations that are faster than the steps. For
    `Lobatto16`, `BDF` and `Newmark`, v has a polynomial of its own, through v and a (order 8).

    Some steps are too long for such polynomials: steps of `RungeKutta` of order 6 and more (with Newton's method, of
    order 7 and more), of `Taylor` and of `Lobatto16`, also within `auto`. Each such step is divided into 2 to 6 equal
    steps of the method when a time within it is first evaluated; to divide all steps costs about as much as the run.
    If a polynomial changes by more than the tolerances when the last of its states is omitted, it is checked at two
    times in the interval: it may violate the constraints or equations of motion beside a singular position or a jump of
    a force. Then three other polynomials are tried: through states of a step across the position; through the
    ends of four steps of `DOP853`, or of a Radau method if Newton's method solved the outer loop; and through the ends
    of the interval only. The statistics of the run do not count these evaluations.

    The solution takes 8 (2 + 3 n_q) bytes of memory per step.

    Attributes
    ----------
    t_min, t_max : float
        Times that the solution covers, s.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, dense_output=True)
    >>> state = result.sol([0.25, 0.5])
    >>> state.q.shape, state.lam.shape
    ((9, 2), (8, 2))
    >>> bool(abs(problem.system.constraint(0.25, state.q[:, 0])).max() < 1e-12)  # the loop stays closed
    True
    """

    def __init__(self, interpolator: Interpolator, table: StateTable, t_max: float):
        self.interpolator, self.table = interpolator, table
        self.t_min, self.t_max = float(table.t[0]), t_max

    def __call__(self, t: ArrayLike) -> DenseState:
        """Return the state at one time, or at times (n,) in any order; ValueError if a time is not in the run."""
        times = check_real("t", t)
        if times.ndim > 1:
            raise ValueError(f"t must be a number or have shape (n,); given {shaped(times)}")
        is_outside = ~((times >= self.t_min) & (times <= self.t_max))  # also True for NaN
        if is_outside.any():
            raise ValueError(
                f"t must lie within the run, from {self.t_min!r} to {self.t_max!r}; given "
                f"{float(np.atleast_1d(times)[np.atleast_1d(is_outside)][0])!r}"
            )
        order = np.argsort(np.atleast_1d(times), kind="stable")
        with signals_of(self.interpolator.system):
            rows = self.interpolator.states(self.table, np.atleast_1d(times)[order])
        return DenseState(self.interpolator, times, order, rows)

    def __repr__(self) -> str:
        return f"DenseSolution(from t = {self.t_min:g} to {self.t_max:g} s, {len(self.table.t) - 1} steps)"

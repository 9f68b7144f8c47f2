"""Cache integrators: a call with the same options as an earlier call reuses the plan, code, arrays and checks.

`CachedIntegrator` calls `start_and_advance` of kernels/cached_run.py, which checks the start and takes the first chunk
of steps (the steps of one call of compiled code). If a run ends in this chunk, the fields of its result are computed
when they are read. If the run is longer, or Python has to check something, `IntegrationLoop` takes over.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_vector
from twoloop.checks.consistency import StartEvaluation, check_start, is_consistent
from twoloop.checks.structure import has_definite_mass
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.derived_callbacks import derive_callbacks, has_exact_derivatives
from twoloop.generate.elimination import (
    MIN_PIVOTS,
    RANK_TOL,
    SINGULAR_MASS,
    START_LIMITS,
    DependentColumns,
    PivotChoice,
)
from twoloop.generate.trace import TraceCache, load_checked_bounds, share_checked_bounds, trace_cache_of
from twoloop.generate.traced_values import CallbackTraces, Sample, extreme_states, states_near_start
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.control.loop_state import N_STEP_COLUMNS
from twoloop.kernels.data import indices
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.indices import BANDWIDTH, FORM
from twoloop.kernels.layout import cached_run, lasting_arrays
from twoloop.kernels.linalg.band import lapack_addresses
from twoloop.methods.presets import code_for, identity, may_have_code, plans_for
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import DenseSolution, OutputInterpolation, StateTable, interpolator_of
from twoloop.run.fallbacks import REPEAT_BELOW, gap_for_repetition, may_have_missed_changes
from twoloop.run.loop import NO_KINDS, IntegrationLoop, Interrupts
from twoloop.run.messages import describe_arrival
from twoloop.run.options import Options
from twoloop.run.parametric import ParametricRun, SharedSetup
from twoloop.run.record import (
    DEFAULTS,
    INITIAL_COUNTS,
    STEP_ARRAYS,
    OutputRequest,
    Record,
    Status,
    interval_kinds,
    state_fields,
    statistics,
    step_fields,
)
from twoloop.run.rerun import (
    FIRST_FORCE,
    check_callbacks_along_run,
    checked_region_of,
    find_nondeterminism,
    first_force,
)
from twoloop.run.run import CONTRADICTION, Run
from twoloop.run.signals import raised_by_handler
from twoloop.run.singular_positions import JUMP_RATIO
from twoloop.run.singular_start import Branch, branch_at
from twoloop.run.workspace import GAMMA_ACCURACY, sparse_factors_pay

Array = NDArray[np.float64]

MAX_IDLE = 4  # largest number of unused integrators kept for equal options; each thread that integrates takes one
# largest number of chunks, of `Run.chunk` attempted steps each, in the first call of compiled code: with more steps, a
# run might ignore Ctrl-C for more than 0.1 s. If `StiffnessMonitor` must sample a state after each chunk, use 1 chunk
N_FIRST_CHUNKS = 4
N_SKIPPED_CALLS = 16  # after an exception in a callback, this number of calls do not use the cached integrator
STEP_FIELDS = (*STEP_ARRAYS, "stats")  # fields of a result that are computed from the array of steps
NON_STEP_DEFAULTS = {name: value for name, value in DEFAULTS.items() if name not in STEP_FIELDS}
SHORT_RUN = 1e-3  # if the last run took less CPU time (s) than this, measure elapsed time, which is read faster
HARMLESS = 0.01  # v0 need not satisfy the constraints exactly: projection may change v0 by this number of tolerances
REACHED_END = Status.REACHED_END  # a global name is read faster than a member of an Enum

STEPS = OutputRequest()  # request for output at the ends of all steps, without dense output and events


@dataclass(frozen=True)
class RepeatRequest:
    """Result of a run that may have missed short changes of forces: the caller must repeat the run."""

    max_gap: float  # longest time (s) allowed between two evaluations in the repeated run
    cpu_time: float  # CPU time of the run to be repeated (s)


class CachedIntegrator:
    """Integrator that is prepared once, and then used for many initial states, one after another.

    run : a run at its start, used by this integrator only. Its system is `system`, or a copy of `system` with the
        missing callbacks, derived from the others.
    code : machine code generated for the mechanism, which the steps of the run call; None if they call none.
    definite : whether M is positive definite.
    shared : setup for all systems that differ from `system` only in parameters; None: use this system only.
    """

    def __init__(
        self,
        run: Run,
        system: ConstrainedSystem,
        code: GeneratedCode | None,
        definite: bool,
        options: Options,
        shared: SharedSetup | None,
    ):
        self.parametric = None if shared is None else ParametricRun(shared, run)
        self.run, self.options, self.check_derivatives = run, options, (checks := options.check_derivatives)
        self.region = run.region = checked_region_of(run, checks) if shared is None else shared.region(checks)
        # the first call of compiled code attempts at most `n_attempts` steps; each attempt stores at most one state
        n_attempts = max(LANES, run.chunk * (N_FIRST_CHUNKS if run.plan.stable_to is None else 1))
        run.control[run.a.STORE_ALL], run.control[run.a.MAX_ATTEMPTS] = 1.0, n_attempts
        checked = system if self.parametric is None else self.parametric.system
        # skips: after an exception in a callback, this number of calls do not use this integrator
        self.evaluation, self.loops, self.code, self.skips = StartEvaluation(checked), cached_run(), code, 0
        self.arrays, self.callbacks = arrays_of(run, self.evaluation, code, definite, options, n_attempts), checked.kit
        self._start_and_advance = entry_point(self.loops.start_and_advance)
        # `arrays.block` contains a report (numbers about the run, times, steps) up to the index states_begin, and
        # states after it. A report on one state and no step begins at one_state_begin; longer ones begin earlier
        self.states_begin, self.width = self.arrays.report.size, len(run.state)
        self.one_state_begin = self.states_begin - self.loops.N_HEAD - 1
        self.loop_used = False  # True: `IntegrationLoop` may have changed attributes that `_return_to_start` restores
        self.attributes_at_start = {key: getattr(run, key) for key in ("plan", "memory", "chunk", "kit")}
        # form of linear algebra at the start; CPU time of the last run (s), infinite before the first run
        self.form, self.cpu_time = run.kit.flags[FORM], np.inf
        self.interpolation = OutputInterpolation(run)
        self.run_fields = run.rank, run.redundant, bool(run.plan.own)  # the last: whether steps call generated code
        self.independent_rows = self.arrays.start_rows.tobytes()  # indices of independent constraint rows, as bytes
        self.redundancy = {self.independent_rows: (run.redundant, run.rows_warning)}

    @staticmethod
    def can_provide(run: Run, output: OutputRequest, shared: SharedSetup | None) -> bool:
        """Return whether a cached integrator can provide the requested `output`; if not, a new run must be set up."""
        # refuse `result.sol` together with output times: states from two interpolators would not agree. Refuse it also
        # if systems share the run (`shared`): the next system would overwrite the parameters that `result.sol` uses
        if output.dense and (output.interpolated_times is not None or shared is not None):
            return False
        return output.interpolated_times is None or not (
            run.ends_at_outputs or run.kit.flags[FORM] == indices.AUGMENTED
        )

    def integrate(
        self,
        system: ConstrainedSystem,
        t0: float,
        t1: float,
        q0: Array,
        v0: Array,
        output: OutputRequest,
        time_limit: float | None,
        interrupts: Interrupts,
    ) -> dict[str, Any] | RepeatRequest | None:
        """Integrate a system from a start, if possible by one call of compiled code; return one of three results.

        A dict: fields of the result; its key "later" has a function that computes missing fields when they are read. A
        RepeatRequest: the run may have missed short changes of forces. None: the start needs more checks, or a callback
        has raised an exception; `set_up`, called next by the caller, checks the start and names the problem.
        """
        run, region, arrays, loops, parametric = self.run, self.region, self.arrays, self.loops, self.parametric
        is_due = region.is_comparison_due()
        if self.skips > 0:
            self.skips -= 1
            return None
        if parametric is not None:
            if parametric.use_parameters_of(system):
                self.evaluation.system, arrays.last_start[loops.N_EQUAL] = parametric.system, loops.NEVER
        elif self.check_derivatives and not system.checked:
            return None
        if self.loop_used:
            self._return_to_start()
        run.t0 = t0
        kit, work, sizes, bounds = run.kit.address, run.work.address, self.evaluation.sizes(), region.bounds
        start = kit, self.callbacks.address, work, arrays.address, t0, t1, q0, v0, sizes, bounds
        clock = time.perf_counter if self.cpu_time < SHORT_RUN else time.process_time
        began = clock()
        try:
            n = self._start_and_advance(*start, loops.NOTHING_CHECKED)
            if n == loops.IN_DOUBT and is_consistent(self.evaluation.system, t0, q0, v0):
                n = self._start_and_advance(*start, loops.STATE_CHECKED)
            if n == loops.UNCHOSEN and self._pivots_suit_start(t0, q0):
                n = self._start_and_advance(*start, loops.CHOICES_CHECKED)
        except Exception as error:  # a callback raised it: the caller sets up a new run, which reports the error
            if raised_by_handler(error):
                raise
            self.skips, arrays.last_start[loops.N_EQUAL] = N_SKIPPED_CALLS, loops.NEVER
            return None
        self.cpu_time = clock() - began
        fields: dict[str, Any] = {"status": REACHED_END}
        n_rows, timed_states = n, None  # n steps were taken, and n states stored; n < 0: a code such as REFUSED
        rows_differ = run.rows_warning != "" and (rows := arrays.start_rows.tobytes()) != self.independent_rows
        if rows_differ and n >= 0 and rows in self.redundancy:
            self._use_independent_rows(rows)
            rows_differ = False
        all_steps = output.times is None and not output.dense
        if n < 0 or rows_differ or is_due or not all_steps or parametric is not None:
            if n in (loops.IN_DOUBT, loops.REFUSED, loops.UNCHOSEN):
                return None
            interrupts.install_handlers()
            n_rows, n = arrays.filled.tolist()
            finished = self._finish_run(system, t1, q0, v0, output, time_limit, interrupts, is_due, fields)
            if not isinstance(finished, tuple):
                return finished
            (timed_states,) = finished
        begin, end = self.one_state_begin - n_rows - n * N_STEP_COLUMNS, self.states_begin
        data = arrays.block[begin : end if timed_states is not None else end + (1 + n_rows) * self.width].copy()
        fields["later"] = partial(
            _deferred_field, data, timed_states, self.run_fields, self.cpu_time, system, t1, self.options
        )
        region.count_run()  # count this run here; `IntegrationLoop` counts only the runs that it continues
        return fields

    def _pivots_suit_start(self, t0: float, q0: Array) -> bool:
        """Return whether the generated code is valid at (t0, q0); `self.arrays` must hold M, C_q and A there."""
        system, arrays = self.evaluation.system, self.arrays
        system.remember_at("mass and rows", (t0, q0.tobytes()), (arrays.mass.copy(), arrays.rows.copy()))
        return self.code is not None and self.code.is_valid_from(system, t0, q0)

    def _finish_run(
        self,
        system: ConstrainedSystem,
        t1: float,
        q0: Array,
        v0: Array,
        output: OutputRequest,
        time_limit: float | None,
        interrupts: Interrupts,
        is_due: bool,
        fields: dict[str, Any],
    ) -> dict[str, Any] | RepeatRequest | tuple[tuple[Array, Array] | None] | None:
        """Finish a run after its first chunk: continue by `IntegrationLoop` if necessary, check callbacks, interpolate.

        If the loop continued, or a check failed, return what `integrate` has to return: fields, a RepeatRequest, or
        None. Otherwise store `sol` in `fields` if it is requested, and return a tuple with one element: the pair
        (output times, states), or None if output is at the ends of all steps. `is_due`: whether to compare callbacks
        with their traces at all sampled states. If False, compare only at states far from those of earlier comparisons.
        """
        run, arrays, loops = self.run, self.arrays, self.loops
        n_rows, n_steps = arrays.filled.tolist()
        begin = self.one_state_begin - n_rows - n_steps * N_STEP_COLUMNS
        report = arrays.report[begin : begin + loops.N_REPORT].tolist()
        t, rows, steps = arrays.t[: 1 + n_rows], arrays.states[: 1 + n_rows], arrays.steps[:n_steps]
        if report[loops.IS_NEW]:
            run.compared_until[0] = -np.inf
            if not self._check_new_start(t1, q0, v0):
                arrays.last_start[loops.N_EQUAL] = loops.NEVER
                return None
        if report[loops.END_CODE] != run.a.ALL_OUTPUT_DONE or not report[loops.NOTHING_TO_CHECK]:
            self.loop_used = True
            options = {"time_limit": time_limit, "is_final_attempt": False, "start": rows[0], "system": system}
            loop = IntegrationLoop(run, t1, output, interrupts, **options)
            loop.add_first_chunk(int(report[loops.END_CODE]), t[1:], rows[1:], steps, self.cpu_time)
            record = loop.integrate_to_end(self.check_derivatives)
            if record.status >= 0 and may_have_missed_changes(run):
                return RepeatRequest(gap_for_repetition(run), record.stats.cpu_time)
            return fields_of(record, self.options, system, self.run_fields[-1], t1)
        timed_states = None
        kinds = interval_kinds(run, steps) if output.dense or output.interpolated_times is not None else NO_KINDS
        if output.interpolated_times is not None:
            began = time.process_time()
            self.interpolation.interpolate(output.interpolated_times, t, rows, kinds, self.evaluation.pattern)
            self.cpu_time += time.process_time() - began
        if not self._callbacks_are_correct(t, rows, t1, bool(report[loops.IN_CHECKED_REGION]), is_due):
            arrays.last_start[loops.N_EQUAL] = loops.NEVER
            return None
        if output.dense:
            table = StateTable(t.copy(), rows[:, : 3 * system.n_q].copy(), kinds)
            fields["sol"] = DenseSolution(interpolator_of(run, table.states[0]), table, t1)
        if output.times is not None:
            end_indices = [0 if time == run.t0 else -1 for time in output.times.tolist()]
            states = rows[end_indices] if output.ends_at_outputs else self.interpolation.complete_rows(output.times)
            if states is None:
                return None
            timed_states = output.times.copy(), states
        return (timed_states,)

    def _check_new_start(self, t1: float, q0: Array, v0: Array) -> bool:
        """Find redundant rows at a new start, and compare callbacks with traces; return False if `set_up` must run."""
        run = self.run
        if run.rows_warning:  # rounding may decide which of several dependent rows is the redundant one
            independent = self.arrays.start_rows.tobytes()
            if independent not in self.redundancy:
                new_run = run.copy_to_start(run.t0, q0, v0)
                if new_run is None:
                    return False
                self.redundancy[independent] = new_run.redundant, new_run.rows_warning
            self._use_independent_rows(independent)
        mass, derivatives = self.evaluation.mass, self.check_derivatives
        return self.parametric is None or self.parametric.callbacks_agree(run.t0, q0, v0, t1, mass, derivatives)

    def _use_independent_rows(self, rows: bytes) -> None:
        """Set the run's redundant rows and the warning about them; `rows`: indices of independent rows, as bytes."""
        run = self.run
        run.redundant, run.rows_warning = self.redundancy[rows]
        self.run_fields, self.independent_rows = (run.rank, run.redundant, self.run_fields[-1]), rows

    def _return_to_start(self) -> None:
        """Before the next run, restore attributes of `run` (other than arrays) that the last run may have changed."""
        run, self.loop_used = self.run, False
        if run.plan is self.attributes_at_start["plan"] and not run.substituted and run.kit.flags[FORM] == self.form:
            # keep the last run's kit: kits made before `IntegrationLoop` loaded a step cannot call this step
            self.attributes_at_start["kit"] = run.kit
        vars(run).update(self.attributes_at_start, crossings=[], jumps=[], sizes_to_try=[], substituted=False)

    def _callbacks_are_correct(self, t: Array, rows: Array, t1: float, is_inside: bool, is_due: bool) -> bool:
        """Return whether callbacks agree with traces at `rows` (states at times t), see `check_callbacks_along_run`."""
        n = 2 * self.run.system.n_q

        def states(all_states: bool) -> Array:
            sample = Sample(float(t[0]), rows[0], n)
            sample.add(t[1:], rows[1:], float(t[-1]), rows[-1])
            # include the states with extreme t, q or v: then the checked region contains the whole run
            return sample.states() if all_states else np.concatenate([extreme_states(t, rows[:, :n]), sample.states()])

        checks = t1, self.check_derivatives, REACHED_END, "", is_due, is_inside
        return check_callbacks_along_run(self.run, states, *checks)[0] == REACHED_END


def fields_of(
    record: Record, options: Options, system: ConstrainedSystem, compiled: bool, t_end: float
) -> dict[str, Any]:
    """Return the fields of the result of a run, from its record; `compiled`: whether steps called generated code."""
    fields = vars(record) | options.metadata | {"system": system, "atol": options.atol.copy(), "compiled": compiled}
    fields["t_end"] = t_end
    if (own := options.own_tolerance) is not None:  # Newmark's tolerance of positions in each step
        error = own ** (2.0 / 3.0)  # error of a whole run whose steps meet this tolerance
        fields |= {"rtol": error, "atol": np.full(system.n_q, error), "untested": np.ones(len(record.h), dtype=bool)}
    return fields


def _deferred_field(
    data: Array,  # copy of the report on a run: numbers, times, steps and states
    timed_states: tuple[Array, Array] | None,  # output times and states; None: output at the ends of all steps
    run_fields: tuple[int, NDArray[np.int64], bool],  # rank of G; redundant rows; whether steps called generated code
    cpu_time: float,
    system: ConstrainedSystem,
    t1: float,
    options: Options,
    name: str,
) -> dict[str, Any]:
    """When the field `name` of a result is first read, return a dict of this field and others from the same data."""
    if name == "message":
        return {name: describe_arrival(t1, options.step_size is not None)}
    loops, n_states, n_steps = cached_run(), int(data[0]), int(data[1])
    begin, end = (after_times := loops.N_HEAD + n_states), after_times + n_steps * N_STEP_COLUMNS
    if name in STEP_FIELDS:
        counts = data[loops.N_REPORT : loops.N_HEAD].astype(np.int64)
        by_step = step_fields(data[begin:end].reshape(n_steps, N_STEP_COLUMNS), INITIAL_COUNTS.copy())
        return by_step | {"stats": statistics(counts, cpu_time)} | options.metadata
    rank, redundant, own = run_fields
    defect = float(data[loops.DEFECT]) if data[loops.DEFECT_KNOWN] else None
    fields = {"rank": rank, "redundant": redundant.copy(), "defect": defect, "compiled": own}
    fields |= {"widest_gap": float(data[loops.LONGEST_GAP]), "system": system, "atol": options.atol.copy(), "t_end": t1}
    t, rows = (data[loops.N_HEAD : begin], data[end:].reshape(n_states, -1)) if timed_states is None else timed_states
    return NON_STEP_DEFAULTS | state_fields(system.n_q, t, rows) | fields | options.metadata


RECHECK_PIVOT = 0.1  # `set_up` checks starts with a pivot of C_q below this * (smallest pivot when the run was cached)


def arrays_of(
    run: Run, evaluation: StartEvaluation, code: GeneratedCode | None, definite: bool, options: Options, n_attempts: int
) -> SimpleNamespace:
    """Return new arrays for `start_and_advance` of kernels/cached_run.py, with space for `n_attempts` steps.

    `run` must be at its start; its arrays `clock`, `control` and `tolerances` become views of one array.
    `evaluation.system`: the system to integrate. For the other arguments see `CachedIntegrator`.
    """
    from twoloop.kernels.evaluation import checks as start_checks
    from twoloop.kernels.linalg import rank as pivots
    from twoloop.kernels.linalg.dependent_columns import choose_dependent_columns as find

    loops, system = cached_run(), evaluation.system
    mass_kind = 0 if system.constant_mass else start_checks.DEFINITE if definite else start_checks.INDEFINITE
    numbers, n_rows = np.concatenate([run.clock, run.control, run.tolerances]), system.n_c + system.n_a
    i, j = run.clock.size, run.clock.size + run.control.size
    run.clock, run.control, run.tolerances = numbers[:i], numbers[i:j], numbers[j:]
    memory, (lasting_floats, integers) = run.plan.memory, lasting_arrays(run.work)
    choice, none = None if code is None else code.shared.equations.choice, np.zeros(0, dtype=np.int64)
    expected, scale = _choice_as_array(choice)
    blocks = [] if choice is None else [(i[0], i[-1], j[0], j[-1]) for i, j in choice.blocks]
    dependents = DependentColumns(system, () if choice is None else choice.rows)
    search = dependents.arguments if dependents.choose else (none, none, 0, np.zeros(0), none, none)
    nonzero = np.flatnonzero(memory.view(np.int64))  # indices of nonzero numbers (also -0.0), which each run restores
    weak = 0.0 if system.constant_mass and system.derived.get("no weak mass", False) else SINGULAR_MASS
    start_constants: tuple[float, ...]
    start_constants = max(run.rtol, GAMMA_ACCURACY), run.reuse, 0.0 if run.plan.checks_within else 1.0
    start_constants += (
        np.array_equal(search[0] != 0, run.work.pattern.ravel() != 0.0),
        RANK_TOL,
        weak,
        scale,
        CONTRADICTION,
    )
    start_constants += mass_kind, RECHECK_PIVOT * run.work.notes[indices.PIVOT], run.kit.flags[FORM]
    step_limits = options.first_step or 0.0, run.least_atol, options.max_step, run.plan.evaluates_within
    columns, width = run.a.N_STEP_COLUMNS, len(run.state)
    block = np.empty(loops.N_HEAD + 1 + (1 + columns) * n_attempts + width * (1 + n_attempts))
    report_part, states = np.split(block, [len(block) - width * (1 + n_attempts)])
    arrays = SimpleNamespace(
        **evaluation.arrays,
        **{"numbers": numbers, "start_numbers": numbers.copy()},
        **{"memory": memory, "memory_places": nonzero, "start_memory": memory[nonzero]},
        **{"clock": run.clock, "control": run.control, "tolerances": run.tolerances, "options": run.plan.options},
        **{"state": run.state, "new_state": run.new_state, "lasting": lasting_floats, "lasting_integers": integers},
        **{"saved": np.empty(numbers.size + lasting_floats.size + run.state.size), "saved_integers": integers.copy()},
        **{"constants": np.array([*start_constants, *step_limits, run.near_threshold, JUMP_RATIO, REPEAT_BELOW])},
        lapack=np.array(lapack_addresses() if run.kit.flags[BANDWIDTH] >= 0 else [], dtype=np.int64),
        **{
            "bounds": START_LIMITS,
            "scratch": np.zeros(pivots.workspace_size(n_rows, system.n_q)),
            "expected": expected,
        },
        **{"chosen": np.zeros(2 + 3 * n_rows, dtype=np.int64), "blocks": np.array(blocks, dtype=np.int64).ravel()},
        **dict(zip(("kinds", "counted", "_", "search", "search_places", "found"), search, strict=True)),
        **{"last_start": np.zeros(loops.START + 2 + 2 * system.n_q), "start_rows": run.work.rows_v.copy()},
        **{"end": np.zeros(1), "t": np.empty(n_attempts + 1), "states": states.reshape(n_attempts + 1, width)},
        **{"steps": np.empty((n_attempts, columns)), "filled": np.zeros(2, dtype=np.int64)},
        **{"report": report_part, "block": block},
        **{"evaluate_start": start_checks.evaluate_start, "choose": pivots.choose_rows, "dependents": find},
        **{"start": run.kernels.start, "advance": run.kernels.advance},
    )
    arrays.table = loops.RUN_ARRAYS.table(arrays)
    arrays.address = arrays.table.ctypes.data
    return arrays


def _choice_as_array(choice: PivotChoice | None) -> tuple[NDArray[np.int64], float]:
    """Return `choice` as an array of integers for kernels, and the factor s of terms s g^T g added to M (g: row of G).

    The array is empty if `choice` is None. Terms are added if M is singular or pivots are small; without terms, s is 1.
    """
    if choice is None:
        return np.zeros(0, dtype=np.int64), 1.0
    # OF_PYTHON: if code refines its solutions, only Python, no kernel, can choose rows and pivots at a new start
    index = cached_run().OF_PYTHON if choice.is_refined else int(np.searchsorted(-MIN_PIVOTS, -choice.min_pivot))
    numbers = index, len(choice.rows), len(choice.added_rows), *choice.rows, *choice.added_rows
    return np.array(numbers, dtype=np.int64), (*choice.scales, 1.0)[0]


# limits of a system's cache. MAX_OPTIONS: largest number of sets of options. MAX_WORKSPACE: a run with more floats in
# its workspace is not cached. MAX_ENTRIES: largest number of entries for the same options, but different starts
MAX_OPTIONS, MAX_WORKSPACE, MAX_ENTRIES = 16, 150_000, 3


class CacheEntry(NamedTuple):
    """Run stored at its start, and integrators made from it that are free for the next call with equal options."""

    run: Run
    start: tuple[float, bytes, bytes]  # t0, and the bytes of q0 and v0
    t1: float  # end of the run (s)
    code: GeneratedCode | None
    definite: bool  # whether M was definite at the start
    for_other_starts: bool  # whether copies of the run may begin at other starts
    idle: list[CachedIntegrator] | None  # integrators not in use; None: each run needs `set_up`
    shared: SharedSetup | None = None  # setup for systems that differ only in parameters; None: not shared


# initial cache of a system's runs, a tuple: start (t0, q0, v0) of the last run, or None; cache entries by options;
# id() of the generated code of the last run, or None if that run reused a cache entry
EMPTY_CACHE: tuple[Any, dict[Any, tuple[CacheEntry, ...]], int | None] = (None, {}, None)


def cached_result(
    system: ConstrainedSystem,
    t0: float,
    t1: float,
    q0: Array,
    v0: Array,
    options: Options,
    output: OutputRequest,
    time_limit: float | None,
    interrupts: Interrupts,
) -> tuple[dict[str, Any], str] | RepeatRequest | Run | None:
    """Integrate with the cached integrator for a system and options; create the integrator at the first call.

    Return one of four: (fields of the result, warning about redundant rows or ""); a RepeatRequest; a `Run` at its
    start, which the caller integrates because no cached integrator can; None if the caller must call `set_up`.
    """
    entries = system.derived.get("runs", EMPTY_CACHE)[1].get(options.key, ())
    if not entries and (shared := system.shared.get("runs")):
        entry = shared.get((options.key, _trace_cache(system)))
        entries = (entry,) if isinstance(entry, CacheEntry) else ()
    run = None
    if not entries and not system.called_in_python:
        interrupts.install_handlers()
        q0, v0 = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
        run, entry = set_up(system, t0, t1, q0, v0, options)
        if entry is None or entry.idle is None or not CachedIntegrator.can_provide(run, output, None):
            return run
        entries = (entry,)
    for entry in entries:
        if entry.idle is None or not (output is STEPS or CachedIntegrator.can_provide(entry.run, output, entry.shared)):
            continue
        try:
            integrator = entry.idle.pop()
        except IndexError:
            interrupts.install_handlers()
            run = entry.run.copy() if run is None else run
            integrator = CachedIntegrator(run, system, entry.code, entry.definite, options, entry.shared)
        outcome = integrator.integrate(system, t0, t1, q0, v0, output, time_limit, interrupts)
        rows_warning = integrator.run.rows_warning
        if len(entry.idle) < MAX_IDLE:
            entry.idle.append(integrator)
        if outcome is not None:
            return outcome if isinstance(outcome, RepeatRequest) else (outcome, rows_warning)
    return None


def set_up(
    system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, options: Options
) -> tuple[Run, CacheEntry | None]:
    """Return a run at its start (new, or a copy of a cached run), and the cache entry that this call added, or None.

    A run is cached if twoloop provides the method, callbacks are compiled, and callbacks agree with their traces. Raise
    TypeError or ValueError if the start is refused, the method cannot run the system, or code cannot be generated.
    """
    if system.called_in_python:  # do not cache the run: Python functions may depend on variables that change
        return _new_run(system, t0, t1, q0, v0, options)[0], None
    start, key = (t0, q0.tobytes(), v0.tobytes()), options.key
    last_start, runs, last_code = system.derived.get("runs", EMPTY_CACHE)
    entries = runs.get(key, ())
    run, entry = None, next((each for each in entries if each.start == start), None)
    if entry is not None:
        run, code = entry.run.copy(), entry.code
        if entry.t1 != t1:
            options.set_step_sizes(run, t1)
    for each in entries:
        if run is None and each.for_other_starts:
            run, entry, code = _copy_for_start(each, system, t0, t1, q0, v0, options), each, each.code
    if run is None:
        (run, code), entry = _new_run(system, t0, t1, q0, v0, options), None
        if run.system is system:
            _share_setup(system, run, code, t1, options)
    new, added = not entries or last_code == id(code) if entry is None else last_start == start != entry.start, None
    if new and (added := _make_cache_entry(run, code, t1, options)) is not None:
        runs = {} if len(runs) == MAX_OPTIONS else dict(runs)  # a copy, because another thread may read the dict
        runs[key] = added, *[each for each in entries if each is not entry][: MAX_ENTRIES - 1]
    system.derived["runs"] = start, runs, id(code) if entry is None else None
    return run, added


def _make_cache_entry(run: Run, code: GeneratedCode | None, t1: float, options: Options) -> CacheEntry | None:
    """Return the cache entry of a run at its start, or None if the run cannot be cached."""
    system, n = run.system, run.system.n_q
    is_trusted = identity(options.method) is not None and all(traced.is_trusted for traced in run.traced)
    if not is_trusted or run.starts_singular or run.work.notes.base.size > MAX_WORKSPACE:
        return None
    t0, q0, v0 = run.t0, run.state[:n], run.state[n : 2 * n]
    is_final = code is not None or not may_have_code(
        system, options.method, options.step_size is not None, options.compiled
    )
    definite = has_definite_mass(system, t0, q0)
    for_other_starts = (
        run.fixed_order is None and is_final and (definite or not sparse_factors_pay(system, run.kit.flags))
    )
    start = t0, q0.tobytes(), v0.tobytes()
    can_start = for_other_starts and not run.start_warning and not system.called_in_python
    idle: list[CachedIntegrator] | None = [] if can_start else None  # None: each run needs `set_up`
    return CacheEntry(run.copy(), start, t1, code, definite, for_other_starts, idle)


def _trace_cache(system: ConstrainedSystem) -> TraceCache:
    cache: TraceCache = system.remembered(("trace cache", trace_cache_of), lambda: trace_cache_of(system))
    return cache


def _share_setup(system: ConstrainedSystem, run: Run, code: GeneratedCode | None, t1: float, options: Options) -> None:
    """If this system differs from an earlier one only in its parameters, cache a SharedSetup for all such systems."""
    key, functions, cached = (options.key, _trace_cache(system)), system.functions, system.shared.get("runs", {})
    if key not in cached:
        system.shared["runs"] = (cached if len(cached) < MAX_OPTIONS else {}) | {key: functions}
    elif type(cached[key]) is type(functions) and cached[key] is not functions:
        entry = _make_cache_entry(run, code, t1, options)
        if entry is not None and entry.idle is not None:
            has_fixed_step = options.step_size is not None
            with suppress(ValueError):
                shared = SharedSetup(entry.run, code, options.method, has_fixed_step, options.compiled)
                cached[key] = entry._replace(shared=shared)
                return
        cached[key] = None


def _copy_for_start(
    entry: CacheEntry, system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, options: Options
) -> Run | None:
    """Return a copy of a cached run for another start; None if its code or linear algebra is not valid there."""
    _check_start(system, t0, q0, v0, options)
    if entry.code is not None and not entry.code.is_valid_from(system, t0, q0):
        return None
    run = entry.run.copy_to_start(t0, q0, v0) if has_definite_mass(system, t0, q0) == entry.definite else None
    if run is not None:
        options.set_step_sizes(run, t1)
    return run


def _new_run(
    system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, options: Options
) -> tuple[Run, GeneratedCode | None]:
    """Set up a run: check its start, derive missing callbacks, generate code, choose a plan; return run and code."""
    has_fixed_step, original, new = options.step_size is not None, system, not system.checked
    if new:
        load_checked_bounds(system)
    first_value = first_force(system, t0, q0, v0)
    _check_start(system, t0, q0, v0, options)

    def check_traces(traced: CallbackTraces) -> None:
        traced.refuse_if_wrong(system, t0, t1, q0, v0)

    system, derived = derive_callbacks(system, check_traces)
    run, code = _create_run(system, t0, q0, v0, options, derived, check_traces)
    if run.fixed_order is None:
        branch = branch_at(system, t0, run.state, run.rank, options.atol + options.rtol * np.abs(v0).max())
        run.starts_singular = branch is not None
        if isinstance(branch, Branch) and not has_fixed_step:
            neighbour, neighbour_code = _create_run(system, t0, branch.q, branch.v, options, derived, check_traces)
            if neighbour.rank == branch.rank and neighbour.fixed_order is None:
                run, code = neighbour, neighbour_code
                run.move_to_singular_start(t0, q0, v0, branch.a, branch.first_size)
    if new:
        share_checked_bounds(original)
    if system.called_in_python and not has_fixed_step:
        difference = find_nondeterminism(system, states_near_start(t0, t1, q0, v0))
        if difference is not None:
            raise ValueError(difference)
    if first_value is not None and not any("force" in each.kinds for each in run.traced):
        system.derived.setdefault(FIRST_FORCE, [first_value])
    options.set_step_sizes(run, t1)
    if options.max_steps is not None:
        run.control[run.a.MAX_STEPS] = options.max_steps
    return run, code


def _create_run(
    system: ConstrainedSystem,
    t: float,
    q: Array,
    v: Array,
    options: Options,
    derived: Sequence[CallbackTraces],
    check_traces: Callable[[CallbackTraces], None],
) -> tuple[Run, GeneratedCode | None]:
    """Return a new run that begins at (t, q, v), and the generated code that its steps call; None: no such code."""
    fixed = options.step_size is not None
    code = code_for(system, options.method, fixed, options.compiled, t, q, check_traces)
    plan, interiors = plans_for(
        system, options.method, options.rtol, float(options.atol.min()), fixed, code, check_traces
    )
    if derived:
        plan = plan.changed(traced=(*plan.traced, *derived))
    return Run(system, plan, t, q, v, options.rtol, options.atol, options.step_size, interiors), code


def _check_start(system: ConstrainedSystem, t0: float, q0: Array, v0: Array, options: Options) -> None:
    """Check a start, unless the last checked start was the same; raise an exception if the start is refused."""
    derivatives, harmless = options.check_derivatives, HARMLESS * (options.atol + options.rtol * np.abs(v0))

    def check_values() -> None:
        exact = partial(has_exact_derivatives, system, t0, q0, v0)
        check_start(system, t0, q0, v0, derivatives=derivatives, exact=exact, harmless=harmless)

    system.remembered_at(("start", derivatives), (t0, q0.tobytes(), v0.tobytes(), harmless.tobytes()), check_values)

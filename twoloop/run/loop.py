"""Integrate chunk by chunk: call the compiled `advance`, handle the code that it returns, and record the run.

A chunk is the steps of one call of `advance`. Ctrl-C ends a run at any time, with the result so far. An exception
between two arbitrary instructions could leave arrays half written, and machine code can pass on exceptions only from
Python functions that it calls. So Ctrl-C raises `KeyboardInterrupt` only within functions of the user, which may take
long and whose callers expect exceptions. Elsewhere the signal is stored until the loop checks for it.
"""

# module `signal` tries to convert each handler to an enum member, which takes 8 microseconds; `_signal` does not
import _signal  # type: ignore[import-not-found]
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.traced_values import Sample
from twoloop.kernels.control.singular_positions import COLLAPSED_STEP
from twoloop.kernels.data import indices
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.indices import MAX_GAP_RATIO
from twoloop.kernels.steps.stages import load_step
from twoloop.problem.events import SAMPLES
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import interpolator_of
from twoloop.run.fallbacks import (
    FAR_BEFORE,
    apply_jump,
    cross_singularity,
    crossing_kit,
    distance_from_singular,
    handle_crossing,
    is_beside_start,
    renew_kit,
    requires_crossing,
    switch_method,
    tighten_tolerances,
    warn_of_missed_changes,
)
from twoloop.run.messages import (
    INTERRUPTED,
    MAX_STEPS_LEFT,
    OUT_OF_TIME,
    STAGNATED,
    StallDetector,
    StiffnessMonitor,
    describe_stiffness,
    message_of,
    reject_velocity_jumps,
    status_and_message,
    warn_of_inaccurate_crossing,
    warn_user,
)
from twoloop.run.record import (
    DEFAULTS,
    INITIAL_COUNTS,
    STEP_ARRAYS,
    MemoryStore,
    OutputRequest,
    Record,
    Recorder,
    Statistics,
    Status,
    failure_link,
    interval_kinds,
    record_of,
    state_fields,
    statistics,
    step_fields,
)
from twoloop.run.rerun import check_callbacks_along_run, checked_region_of
from twoloop.run.run import SMALL_SYSTEM, Buffers, Run
from twoloop.run.signals import CALLERS_OF_USER_CODE, SignalHandlers, is_within, raised_by_handler
from twoloop.run.singular_positions import TimedState, has_velocity_jump_at_end, state_beside_singularity

Array = NDArray[np.float64]

MAX_STORED_SIGNALS = 3  # number of Ctrl-C signals that are stored; one more raises KeyboardInterrupt, without a result


class Interrupts:
    """Handler of Ctrl-C during a run. It replaces Python's own handler, but never one that the user has installed.

    The handler is active from `install_handlers` to `restore_handlers`. Before that, Ctrl-C raises KeyboardInterrupt.
    """

    n_signals, _is_installed = 0, False  # n_signals: number of times that Ctrl-C was pressed
    handlers: SignalHandlers | None = None

    def install_handlers(self) -> "Interrupts":
        """Install `SignalHandlers`, and a handler that stores Ctrl-C if no function of the user runs; return self."""
        if self.handlers is None:
            self.handlers = SignalHandlers()
        if _signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            with suppress(ValueError):  # raised in threads other than the main one, which get no signals
                _signal.signal(signal.SIGINT, self._on_signal)
                self._is_installed = True
        return self

    def returns_result(self, error: BaseException) -> bool:
        """Return whether Ctrl-C caused the exception `error` that ended a run: then the run still returns a result.

        Return False if a user's handler raised `error`, or if Ctrl-C was pressed more than MAX_STORED_SIGNALS times.
        """
        if self.handlers is None and raised_by_handler(error):
            return False
        self.install_handlers()  # a signal that arrives during this call may raise an exception
        return self._is_installed and self.n_signals <= MAX_STORED_SIGNALS

    def restore_handlers(self) -> None:
        """Restore all handlers; if a user's handler raised an exception, raise it again."""
        if self._is_installed:
            _signal.signal(signal.SIGINT, signal.default_int_handler)
        if self.handlers is not None:
            self.handlers.restore()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.n_signals += 1
        if self.n_signals > MAX_STORED_SIGNALS or is_within(frame, CALLERS_OF_USER_CODE):
            raise KeyboardInterrupt


def describe_interrupt(t: float, table: Array) -> str:
    """Return the message of a run that Ctrl-C ended at t; `table`: the rows [q, v, a, lam] of the result."""
    n_missing = int(np.isnan(table[:, -1:]).sum())  # [a, lam] of a row is either complete or NaN
    nan_note = f" Accelerations and multipliers are NaN at {n_missing} of its times." if n_missing else ""
    return f"Interrupted from the keyboard at t = {t:.10g}. The result holds what was computed before.{nan_note}"


def interrupted_fields(system: ConstrainedSystem, t0: float, events: list[Any] | None, method: str) -> dict[str, Any]:
    """Return the fields of the result of a run that Ctrl-C ended before its first step; the result has no states."""
    table = np.zeros((0, 3 * system.n_q + system.n_c + system.n_a))
    fields = state_fields(system.n_q, np.zeros(0), table) | {"h": np.zeros(0), "stats": Statistics(n_accepted=0)}
    message = describe_interrupt(t0, table) + failure_link(Status.INTERRUPTED)
    fields |= {"status": Status.INTERRUPTED, "message": message, "system": system, "method": method}
    if events is not None:
        states = [np.zeros((0, system.n_q)) for _ in events]
        fields |= {"t_events": [np.zeros(0) for _ in events], "q_events": states, "v_events": states}
    return DEFAULTS | fields


BUFFER_ROWS = 1024  # largest number of states that one call of `advance` stores
BUFFER_STEPS = 4096  # largest number of steps whose data one call of `advance` stores
CHUNK_TO_EVENT = 16  # attempted steps in a chunk if an event may end the run, because steps beyond the event are wasted
# if a chunk takes less CPU time (s) than this, the next one has twice as many steps; Ctrl-C takes effect after a chunk
CHUNK_TIME = 0.05
# statuses whose message may say that stability limited the steps
STATUSES_WITH_STIFFNESS_NOTE = {Status.REACHED_END, Status.EVENT, Status.MAX_STEPS, Status.TIME_LIMIT, Status.STAGNATED}
# among the last N_LAST_STATES states, the polynomial across a singular position may begin at the last N_RECENT states
# and, before these, at the last N_RECENT ends of long steps (COLLAPSED_STEP times the longest recent step, or longer)
N_RECENT, N_LAST_STATES = 16, 256
MAX_COORDINATES = 100  # with more coordinates, recorded states are not moved onto the polynomial, to save time
CROSSING_OVERSHOOT = 100.0  # a crossing step may end beyond t1 by at most this multiple of the run's duration
# a run begins again with tighter tolerances if it meets its first singular position in the part EARLY of its time, or
# after at most FEW_STEPS steps: loose tolerances jump over the first positions unnoticed
EARLY, FEW_STEPS = 1.0 / 3.0, 32
NO_KINDS = np.zeros(0, dtype=np.int64)  # kinds of intervals if no states between steps are requested
# MAX_SPARE: largest number of sets of buffers (times, states, steps of a chunk) kept for later runs. MAX_SPARE_FLOATS:
# sets whose buffer of states has more floats than this are not kept
MAX_SPARE, MAX_SPARE_FLOATS = 16, 250_000
_spare_buffers: dict[tuple[int, int, int], Buffers] = {}  # sets of buffers for later runs, by their sizes


class IntegrationLoop:
    """Loop that integrates a run to its end, and records it.

    `start`: None if the run is at its start. If the caller has already taken the first chunk of steps, `start` is the
    row [q, v, a, lam] at the start, and the caller then calls `add_first_chunk`. `system`: system in the result,
    given if later runs will overwrite arrays of `run.system`. `report`: called after each chunk with the time reached.
    `is_final_attempt`: warn if the run may have missed short changes of forces (if False, the caller repeats the run).
    """

    def __init__(
        self,
        run: Run,
        t1: float,
        request: OutputRequest,
        interrupts: Interrupts,
        report: Callable[[float], object] = lambda t: None,
        time_limit: float | None = None,
        is_final_attempt: bool = True,
        start: Array | None = None,
        system: ConstrainedSystem | None = None,
    ):
        ends_at_outputs, store = request.ends_at_outputs or run.ends_at_outputs, request.store or MemoryStore()
        self.request = request = request._replace(ends_at_outputs=ends_at_outputs, store=store)
        self.run, self.t1, self.is_final_attempt = run, t1, is_final_attempt
        run.t1 = t1
        self.start = (run.state if start is None else start).copy()
        self.system = run.system if system is None else system
        self.report, self.interrupts = report, interrupts
        self.deadline = np.inf if time_limit is None else time.monotonic() + time_limit
        self.outputs = np.array([t1])
        if request.times is not None and request.ends_at_outputs:
            self.outputs = np.append(request.times[(request.times > run.t0) & (request.times < t1)], t1)
        run.control[run.a.STORE_ALL] = request.every_step
        self.largest_chunk = BUFFER_STEPS
        has_terminal_event = request.events is not None and any(event.terminal < np.inf for event in request.events)
        if has_terminal_event:
            self.largest_chunk = run.chunk = CHUNK_TO_EVENT
        # progress is checked every `check_interval` attempted steps; the next check is due after `next_check` attempts
        self.check_interval = self.next_check = run.chunk
        self.plan, self.control, self.kit = run.plan, run.control, run.kit  # replaced while steps cross a singularity
        self.n_filled = np.zeros(2, dtype=np.int64)
        self.may_end_before_t1 = has_terminal_event or time_limit is not None
        self._begin_records()
        # False in the middle of a sampled run, which cannot begin again
        self.is_whole = start is not None or run.work.counters[indices.N_ACCEPTED] == 0
        self.cpu_time = 0.0
        self.callback_error: Exception | None = None
        self.code = INTERRUPTED if interrupts.n_signals else run.a.PAUSED

    def _begin_records(self) -> None:
        """Begin the records of the steps from the start of the run."""
        run = self.run
        self.recorder = self._new_recorder()
        self.counts = INITIAL_COUNTS.copy()
        self.latest_chunks: list[tuple[Array, Array]] = []  # times and rows of the last chunks, see _last_states
        self.step_parts = [np.empty((0, run.a.N_STEP_COLUMNS))]  # an empty array, then the steps to be put in `store`
        if self.request.store.append_only:
            self._store_step_fields()
        # if the run may end before t1, a very large t1 is no sign of stalling
        self.stall_detector = StallDetector(run.t0, np.inf if self.may_end_before_t1 else MAX_STEPS_LEFT)
        self.stiffness_monitor = StiffnessMonitor(run.plan)
        self.sample = Sample(run.t0, self.start, 2 * run.system.n_q)

    def _begins_again(self) -> bool:
        """Begin the run again if it has tightened its tolerances early, as errors of its first steps would grow.

        Return False if the run goes on. `self.code` becomes PAUSED, or RANK_LOST if the run cannot begin again.
        """
        run, a, n, steps = self.run, self.run.a, self.run.system.n_q, np.concatenate(self.step_parts)
        is_early = run.clock[a.T] - run.t0 <= EARLY * (self.t1 - run.t0) or len(steps) <= FEW_STEPS
        # steps across singular positions that long steps jump over may violate redundant rows
        keeps_steps = run.starts_singular or len(run.redundant) > 0 or self.request.store.append_only
        if keeps_steps or not (is_early and self.is_whole and len(steps)):
            return False
        for t, state in self._last_states():
            distance_from_singular(run, t, state[:n])  # record the largest pivot, which generated code does not
        if distance_from_singular(run, run.t0, self.start[:n]) < FAR_BEFORE:
            # the run begins beside a singular position, and has passed it: a crossing would need states before it
            distance_from_singular(run, float(run.clock[a.T]), run.state[:n])  # return to the present partition
            return False
        run.work.counters[:] = 0
        code = run.restart(run.t0, self.start[:n], self.start[n : 2 * n])
        self.code = a.PAUSED if code == indices.DONE else a.RANK_LOST
        is_given = run.control[a.FIRST_GIVEN] == 1.0
        run.clock[a.H_NEXT] = steps[0, a.H] if is_given else run.choose_first_step(run.t0, self.t1, run.state)
        run.jumps = []
        run.work.notes[[indices.NEAR_NOW, indices.LARGEST_DEFECT, indices.UNCHECKED, indices.WIDEST_GAP]] = 0.0
        run.work.notes[indices.NEXT_JUMP] = self.t1
        self.request = self.request._replace(store=MemoryStore())
        self._begin_records()
        self.next_check = run.chunk
        return True

    def add_first_chunk(self, code: int, t: Array, rows: Array, steps: Array, cpu_time: float) -> None:
        """Record the first chunk, which the caller has taken, and handle the `code` that `advance` returned."""
        self.code, self.cpu_time = code, cpu_time
        self._store_chunk(t.copy(), rows.copy(), steps.copy(), self._interval_kinds(steps, False, False))
        self._handle_code(steps, False, cpu_time)

    def integrate_to_end(self, check_derivatives: bool) -> Record:
        """Integrate to the end, check callbacks at states of the run, and return the record of the run."""
        run, a, clock = self.run, self.run.a, self.run.clock
        if run.starts_singular and self.code == a.PAUSED:
            self.code = a.NEAR_SINGULAR if run.branch_known else a.ROWS_VIOLATED
            self._choose_method(False, 0)
        buffers, is_copied = self._next_buffers(), True
        while self.code == a.PAUSED:
            in_crossing, over_jump = self.plan is not run.plan, clock[a.APPLIES_JUMP] == 1.0
            began = time.process_time()
            self._take_chunk(buffers)
            n_rows, n_steps = self.n_filled.tolist()
            t, rows, steps = buffers[0][:n_rows], buffers[1][:n_rows], buffers[2][:n_steps]
            is_copied = 2 * n_rows < len(buffers[0])  # copy a buffer that is less than half full, to save memory
            if is_copied:
                t, rows, steps = t.copy(), rows.copy(), steps.copy()
            if in_crossing and n_steps and self.request.between_steps:
                self.recorder.store_crossing(self.plan.memory)
            self._store_chunk(t, rows, steps, self._interval_kinds(steps, in_crossing, over_jump))
            chunk_time = time.process_time() - began
            self.cpu_time += chunk_time
            if self.recorder.end_event is not None:
                break
            self._handle_code(steps, in_crossing, chunk_time)
            if not is_copied or len(buffers[0]) < min(run.chunk, BUFFER_ROWS):
                buffers = self._next_buffers()
        if is_copied and buffers[1].size <= MAX_SPARE_FLOATS:
            _spare_buffers[buffers[0].size, buffers[1].size, len(buffers[2])] = buffers
            for oldest in list(_spare_buffers)[:-MAX_SPARE]:
                _spare_buffers.pop(oldest, None)
        if self.request.between_steps:
            began = time.process_time()
            self.recorder.search_intervals()
            self.cpu_time += time.process_time() - began
        if self.callback_error is not None and self.recorder.end_event is None:
            raise self.callback_error
        return self._build_record(check_derivatives)

    def _handle_code(self, steps: Array, in_crossing: bool, chunk_time: float) -> None:
        """Act on the code in `self.code`, with which a chunk ended; if the run goes on, replace it by PAUSED.

        `in_crossing`: whether the chunk tried to cross a singular position. `chunk_time`: CPU time of the chunk (s).
        """
        if self.code == self.run.a.ALL_OUTPUT_DONE:
            if self.stiffness_monitor.samples:
                self.stiffness_monitor.add_steps(steps[:, self.run.a.H])
            self.report(self.t1)
            return
        self._check_progress(steps, in_crossing, chunk_time)
        self._choose_method(in_crossing, len(steps))
        self.report(self.run.clock[self.run.a.T])

    def _take_chunk(self, buffers: Buffers) -> None:
        """Take one chunk of steps by the compiled `advance`, which fills `buffers`; store its code in `self.code`."""
        run, a = self.run, self.run.a
        run.control[a.MAX_ATTEMPTS] = min(run.chunk, max(0, self.next_check - run.n_attempts()))
        outputs = self.outputs
        is_crossing = self.plan is not run.plan and not run.piece_ends and run.control[a.FIXED_STEP] == 0.0
        if is_crossing:  # a step across a singular position does not end at output times
            outputs = np.append(outputs[:-1], self.t1 + CROSSING_OVERSHOOT * (self.t1 - run.t0))
        self.n_filled[:] = 0  # Ctrl-C may arrive before `advance` sets these numbers
        try:
            with self._deadline_timer():
                self.code = run.advance(outputs, buffers, self.n_filled, (self.plan, self.control, self.kit))
        except KeyboardInterrupt:
            self.code = INTERRUPTED
        except Exception as error:
            # A callback raised the exception. If the callback was called to sample forces ahead of a step, perhaps at
            # a state that no motion reaches, continue without samples. Else end the run: the caller of the run gets the
            # exception, unless an event has ended the run before this step
            if run.clock[a.SAMPLES_MOTION] == 1.0 and not self.interrupts.n_signals:
                run.clock[a.SAMPLES_MOTION] = self.control[a.SAMPLE_MOTION] = 0.0
            elif is_crossing and not run.system.called_in_python and not self.interrupts.n_signals:
                run.clock[a.FAILURE_CODE] = indices.NOT_FINITE  # the attempt failed, perhaps at an unreachable state
            else:
                self.code, self.callback_error = INTERRUPTED, None if self.interrupts.n_signals else error
                if not run.system.called_in_python:
                    hint = ": it reads beyond the end of an array, such as a table" * isinstance(error, IndexError)
                    step = f"a step from t = {float(run.clock[a.T]):.10g}"
                    error.add_note(f"raised by a compiled callback of system {run.system.name!r} in {step}{hint}")
        if self.interrupts.handlers is not None:
            self.interrupts.handlers.call_delayed()

    @contextmanager
    def _deadline_timer(self) -> Iterator[None]:
        """While active, this context stops machine code at the deadline by a timer (not in small compiled systems)."""
        run, notes = self.run, self.run.work.notes
        if self.deadline == np.inf or (run.system.n_q <= SMALL_SYSTEM and not run.system.called_in_python):
            yield
            return
        left = min(self.deadline - time.monotonic(), threading.TIMEOUT_MAX)
        timer = threading.Timer(left, notes.__setitem__, (indices.TIME_IS_UP, 1.0))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            timer.cancel()
            timer.join()
            notes[indices.TIME_IS_UP] = 0.0

    def _store_chunk(self, t: Array, rows: Array, steps: Array, kinds: NDArray[np.int64]) -> None:
        """Record the states (times, rows) and steps of a chunk, and the kinds of the intervals that the steps cover."""
        run = self.run
        self.sample.add(t, rows, float(run.clock[run.a.T]), run.state)
        self.step_parts.append(steps)
        if self.request.store.append_only:
            self._store_step_fields()
        self.recorder.add(t, rows, kinds)
        if len(t):
            self.latest_chunks.append((t, rows))
            while sum(len(times) for times, _ in self.latest_chunks[1:]) >= N_LAST_STATES:
                self.latest_chunks.pop(0)

    def _store_step_fields(self) -> None:
        """Move data of steps from `self.step_parts` to `self.request.store`, one array for each name in STEP_ARRAYS."""
        steps, self.step_parts = np.concatenate(self.step_parts), self.step_parts[:1]
        for name, values in step_fields(steps, self.counts).items():
            self.request.store.add(name, values)

    def _check_progress(self, steps: Array, in_crossing: bool, chunk_time: float) -> None:
        """Choose the number of steps of the next chunk; set `self.code` if the run stalls, or must stop."""
        run, a = self.run, self.run.a
        h = steps[:, a.H]
        self.stiffness_monitor.add_steps(h)
        self.stall_detector.add_steps(h)
        if self.code == a.PAUSED and run.n_attempts() >= self.next_check:
            self.check_interval = min(2 * self.check_interval, self.largest_chunk)
            self.next_check = run.n_attempts() + self.check_interval
            if not in_crossing:
                self.stiffness_monitor.sample_state(float(run.clock[a.T]), run.state, run.system.n_q)
            if self.stall_detector.is_stalled(run.clock[a.T], self.t1) and run.control[a.MAX_STEPS] == np.inf:
                self.code = STAGNATED
        if chunk_time < CHUNK_TIME:
            run.chunk = min(2 * run.chunk, self.largest_chunk)
        singular = a.MET_SINGULAR, a.NEAR_SINGULAR
        may_continue = self.code in (a.PAUSED, a.NEEDS_COMPILATION, a.NEEDS_DENSE, a.SWITCH_METHOD, *singular)
        if may_continue and time.monotonic() > self.deadline:
            self.code = OUT_OF_TIME
        if self.code in (a.PAUSED, a.NEEDS_COMPILATION) and (self.interrupts.n_signals or self.recorder.interrupted):
            self.code = INTERRUPTED

    def _choose_method(self, in_crossing: bool, n_steps: int) -> None:
        """Change method, form or state, or compile, as `self.code` asks; if the run goes on, set it to PAUSED."""
        run, a = self.run, self.run.a
        if self.code == a.NEEDS_DENSE or run.may_succeed_in_other_form(self.code):
            run.change_form()
            self.plan, self.kit, self.code = run.plan, run.kit, a.PAUSED
        elif self._must_tighten() and tighten_tolerances(run) and self._begins_again():
            pass  # `self.code` says how the run goes on
        elif self.code == a.MET_SINGULAR:
            self.code = a.PAUSED
        elif requires_crossing(run, self.code):
            self.plan, self.control = cross_singularity(run, self._last_states())
            self.kit = crossing_kit(run.kit)
            self.code = a.PAUSED
        elif self.code == a.SWITCH_METHOD or self._needs_substitute(in_crossing):
            switch_method(run)
            if self.code == a.STEP_TOO_SMALL:
                run.clock[a.H_NEXT] = run.choose_first_step(float(run.clock[a.T]), self.t1, run.state)
            self.plan, self.control, self.kit, self.code = run.plan, run.control, run.kit, a.PAUSED
        elif self.code == a.NEEDS_COMPILATION:
            began = time.monotonic()
            load_step(run.plan.second)  # compile the second step of a pair of methods, or load it from disk
            renew_kit(run)
            self.deadline += time.monotonic() - began  # compilation does not count against time_limit
            self.kit, self.code = run.kit, a.PAUSED
        elif self.code == a.AT_DISCONTINUITY and not in_crossing and apply_jump(run, self.t1):
            self.code = a.PAUSED
        elif self.plan is not run.plan and self.code != a.ALL_OUTPUT_DONE:
            had_pieces = bool(run.piece_ends)
            self.plan, self.control, self.code = handle_crossing(run, self.plan, self.control, self.code, n_steps)
            if run.piece_ends and not had_pieces:
                self._correct_last_states()
            if self.plan is run.plan:
                self.kit = run.kit

    def _must_tighten(self) -> bool:
        """Return whether the run has come near a singular position beside which it did not begin.

        A run that began beside a position keeps its tolerances up to the next one: rounding errors exceed tighter ones
        there, and a crossing has no room for its polynomial before the position.
        """
        return self.code in (self.run.a.MET_SINGULAR, self.run.a.NEAR_SINGULAR) and not is_beside_start(self.run)

    def _last_states(self) -> list[TimedState]:
        """Return states at which the polynomial across a singular position may begin; [] if none are recorded."""
        if not self.request.every_step:
            return []
        states: list[TimedState] = [(self.run.t0, self.start)]
        for t, rows in self.latest_chunks:
            states += zip(t[-N_LAST_STATES:].tolist(), rows[-N_LAST_STATES:], strict=True)
        long = COLLAPSED_STEP * float(self.run.clock[self.run.a.H_LONG])
        ends = [state for before, state in pairwise(states[-N_LAST_STATES:-N_RECENT]) if state[0] - before[0] >= long]
        past = ends[-N_RECENT:] + states[-N_RECENT:]
        return states[:1] + past if is_beside_start(self.run) and past[0] is not states[0] else past

    def _correct_last_states(self) -> None:
        """Move the last recorded states, which rounding may have spoiled, onto a polynomial across a singular position.

        Only states after the beginning of the polynomial are moved. States in files are not: files are written once. In
        large systems, only [q, v, a] of the last state is moved.
        """
        from twoloop.kernels.steps import crossing_step as kernels

        run, (memory, options) = self.run, (self.plan.memory, self.plan.options)
        base, now, n = memory[-kernels.N_STORED :][kernels.BASE], float(run.clock[run.a.T]), run.system.n_q
        if now == run.clock[run.a.T_START]:
            return
        lam, rtol = run.crossings[-1][0][1][3 * n :], run.tolerances[indices.RTOL]
        run.state[: 3 * n] = kernels.state_at(memory, options, now)
        for times, rows in self.latest_chunks:
            for t, row in zip(times.tolist(), rows, strict=True):
                # base is NaN if the polynomial begins at the last state
                if not (base < t < now or t == now) or (t < now and n > MAX_COORDINATES):
                    continue
                if t == now:
                    row[: 3 * n] = run.state[: 3 * n]
                if n <= MAX_COORDINATES:
                    state = kernels.state_at(memory, options, t)
                    try:
                        row[:] = state_beside_singularity(run.system, t, state, row, lam, run.rank, rtol)
                    except (ArithmeticError, ValueError):  # a callback fails there
                        continue
                    except KeyboardInterrupt:
                        self.code = INTERRUPTED
                        return
                self.recorder.correct_state(t, row)
                if t == now:
                    run.state[:] = row

    def _needs_substitute(self, in_crossing: bool) -> bool:
        """Return whether another method must take over because of STEP_TOO_SMALL far from singular positions."""
        run, a = self.run, self.run.a
        is_too_small = self.code == a.STEP_TOO_SMALL and run.control[a.MAY_SWITCH] == 1.0
        return is_too_small and not in_crossing and run.work.notes[indices.NEARLY_SINGULAR] != 1.0

    def _build_record(self, check_derivatives: bool) -> Record:
        """Return the record of the finished run, without data after the interruption or event that ended the run."""
        run, recorder, code = self.run, self.recorder, self.code
        t, table = recorder.output()
        stats, store = statistics(run.work.counters, self.cpu_time), self.request.store
        self._store_step_fields()
        time_reached = float(run.clock[run.a.T])
        if recorder.end_event is not None or recorder.interrupted_at is not None:
            for name in STEP_ARRAYS:
                store.truncate(name, recorder.n_steps)
            stats = replace(stats, n_accepted=recorder.n_steps)
        if recorder.end_event is not None:
            event, end = recorder.end_event
            if recorder.n_steps > 0:
                store.truncate("h", recorder.n_steps - 1)
                store.add("h", np.array([recorder.last_step_size]))
            status, message = Status.EVENT, f"{event.name} ended the run at t = {end:.10g}."
        if recorder.interrupted_at is not None:
            time_reached = recorder.interrupted_at
        try:
            if recorder.end_event is None:
                status, message = status_and_message(run, code, self.t1, self.stall_detector)
            if status >= 0:
                end = time_reached if recorder.end_event is None else recorder.end_event[1]
                jumps = self._suspicious_last_step(t, table), self._suspicious_outputs(t, table)
                status, message = reject_velocity_jumps(run, *jumps, end, status, message)
            if code != INTERRUPTED:
                end = time_reached
                if recorder.end_state is not None:
                    self.sample.end_at(*recorder.end_state)
                    end = recorder.end_state[0]
                region = checked_region_of(run, check_derivatives)
                is_due = region.is_comparison_due() or run.system.called_in_python
                region.count_run()
                states = self.sample.states()
                status, message = check_callbacks_along_run(
                    run, lambda all_states: states, end, check_derivatives, status, message, is_due
                )
            if self.is_final_attempt and status >= 0:
                message += warn_of_missed_changes(run) + warn_of_inaccurate_crossing(run)
            if status >= 0 and run.start_warning:
                message += warn_user(run.start_warning)
            if status in STATUSES_WITH_STIFFNESS_NOTE:
                message += describe_stiffness(self.stiffness_monitor, run.kit, run.work)
        except KeyboardInterrupt:
            code = INTERRUPTED
        if self.interrupts.n_signals or recorder.interrupted or (code == INTERRUPTED and recorder.end_event is None):
            status, message = Status.INTERRUPTED, describe_interrupt(time_reached, table)
        t_events, q_events, v_events = recorder.events()
        fields: dict[str, Any] = state_fields(run.system.n_q, t, table) | {k: store.array(k) for k in STEP_ARRAYS}
        fields |= {"rank": run.rank, "redundant": run.redundant.copy()}  # a copy: several runs share this array
        fields |= {"defect": run.defect(), "widest_gap": float(run.work.notes[indices.WIDEST_GAP])}
        fields |= message_of(run, message + failure_link(status), self.system)
        fields |= {"status": status, "stats": stats, "sol": recorder.solution(), "system": self.system}
        fields |= {"t_events": t_events, "q_events": q_events, "v_events": v_events}
        return record_of(Record, DEFAULTS | fields)

    def _suspicious_last_step(self, t: Array, table: Array) -> list[TimedState]:
        """If velocities jumped in the last step, return a list with the state before this step, else an empty list."""
        run = self.run
        if self.request.times is not None or self.recorder.end_event is not None:
            return []
        if run.plan.checks_within and run.work.notes[indices.NEARLY_SINGULAR] != 1.0:
            return []
        return [(float(t[-2]), table[-2])] if has_velocity_jump_at_end(t, table, run.system.n_q) else []

    def _suspicious_outputs(self, t: Array, table: Array) -> list[TimedState]:
        """Return all output states if steps end at output times and passed near a singular position, else []."""
        run, request = self.run, self.request
        equal_steps = run.control[run.a.FIXED_STEP] > 0.0 and request.times is None
        if not run.passed_near_singular() or not (
            equal_steps or (request.times is not None and request.ends_at_outputs)
        ):
            return []
        return list(zip(t.tolist(), table, strict=True))

    def _next_buffers(self) -> Buffers:
        """Return buffers for times, states and steps of a chunk; an attempted step fills at most one row of each."""
        chunk, width = self.run.chunk, len(self.run.state)
        n_rows, n_steps = max(min(chunk, BUFFER_ROWS), LANES), max(min(chunk, BUFFER_STEPS), LANES)
        spare_buffers = _spare_buffers.pop((n_rows, n_rows * width, n_steps), None)
        if spare_buffers is not None:
            return spare_buffers
        return np.empty(n_rows), np.empty((n_rows, width)), np.empty((n_steps, self.run.a.N_STEP_COLUMNS))

    def _new_recorder(self) -> Recorder:
        """Return a new Recorder, with an Interpolator if states between steps are requested."""
        run, n = self.run, self.run.system.n_q
        interpolator = interpolator_of(run, self.start[: 3 * n]) if self.request.between_steps else None
        spacing = MAX_GAP_RATIO * (self.t1 - run.t0) / SAMPLES
        max_spacing = float(run.tolerances[indices.DEFECT_GAP]) if run.short_forces.by_state else spacing
        return Recorder(self.request, interpolator, n, run.t0, self.start, max_spacing)

    def _interval_kinds(self, steps: Array, in_crossing: bool, over_jump: bool) -> NDArray[np.int64]:
        """Return, for dense output, the kind of the interval of each accepted step (row of `steps`)."""
        run = self.run
        if not self.request.between_steps:
            return NO_KINDS
        if over_jump:
            return np.full(len(steps), indices.JUMP)
        if in_crossing:
            return np.full(len(steps), indices.ACROSS)
        return interval_kinds(run, steps)

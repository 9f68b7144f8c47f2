"""Integrate chunk by chunk: call the compiled `advance`, handle the code that it returns, and record the run.

Ctrl-C ends the run, which returns what it has, wherever the signal arrives. An exception between two arbitrary
instructions of Python could leave arrays half written, and machine code cannot pass it on between its calls of Python.
Therefore the signal raises `KeyboardInterrupt` only within functions of the user, which may take long and whose callers
expect exceptions. Elsewhere it is stored until the loop checks for it.
"""

import _signal  # type: ignore[import-not-found]  # `signal` makes enumerations of handlers, which takes 8 microseconds
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.traced_values import Sample
from twoloop.kernels.data import indices
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.indices import LONGEST_UNSEEN
from twoloop.problem.events import SAMPLES
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import interpolator_of
from twoloop.run.fallbacks import (
    after_crossing,
    apply_jump,
    cross_singularity,
    crossing_kit,
    load,
    may_cross,
    switch_method,
    warn_of_missed_changes,
)
from twoloop.run.messages import (
    INTERRUPTED,
    OUT_OF_REACH,
    OUT_OF_TIME,
    STAGNATED,
    StallDetector,
    StiffnessMonitor,
    describe_stiffness,
    message_of,
    outcome,
    reject_turned_velocities,
    warn_of_own_passages,
    warn_user,
)
from twoloop.run.record import (
    BEFORE,
    DEFAULTS,
    OF_STEPS,
    OutputRequest,
    Record,
    Recorder,
    Statistics,
    Status,
    explained,
    interval_kinds,
    of_run,
    record_of,
    statistics,
    step_fields,
)
from twoloop.run.rerun import compare_callbacks
from twoloop.run.run import Buffers, Run
from twoloop.run.signals import SignalHandlers, within_a_users_function
from twoloop.run.singular_positions import Place, turned_last

Array = NDArray[np.float64]

IMPATIENCE = 3  # signals after which the next one raises at once, even if the result is lost


class Interrupts:
    """Handler of Ctrl-C that replaces Python's own between `listen` and `leave`; a user's handler stays.

    Before `listen`, Ctrl-C raises as usual: this takes less time, and all that is half written then is thrown away.

    Attributes
    ----------
    asked : int
        Number of signals so far.
    """

    asked, _stands_in = 0, False
    handlers: SignalHandlers | None = None

    def listen(self) -> "Interrupts":
        """Store signals from here on, except those within functions of the user."""
        if self.handlers is None:
            self.handlers = SignalHandlers()
        if _signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            with suppress(ValueError):  # raised in threads other than the main one, which get no signals
                _signal.signal(signal.SIGINT, self._heard)
                self._stands_in = True
        return self

    def answers(self) -> bool:
        """Return whether a raised Ctrl-C ends in a result: not the fourth one, nor one that a user's handler raised."""
        self.listen()  # if the handler is Python's own
        return self._stands_in and self.asked <= IMPATIENCE

    def leave(self) -> None:
        """Restore all handlers, and raise what one of the user's raised."""
        if self._stands_in:
            _signal.signal(signal.SIGINT, signal.default_int_handler)
        if self.handlers is not None:
            self.handlers.leave()

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.asked += 1
        if self.asked > IMPATIENCE or within_a_users_function(frame):
            raise KeyboardInterrupt


def describe_interrupt(t: float, table: Array) -> str:
    """Describe a run that Ctrl-C ended at t; `table` has its rows [q, v, a, lam]."""
    gaps = int(np.isnan(table[:, -1:]).sum())  # if one entry of [a, lam] is missing, all are
    unknown = f" Accelerations and multipliers are NaN at {gaps} of its times." if gaps else ""
    return f"Interrupted from the keyboard at t = {t:.10g}. The result holds what was computed before.{unknown}"


def interrupted_record(system: ConstrainedSystem, t0: float, events: list[Any] | None, method: str) -> Record:
    """Return the record of a run that Ctrl-C ended before the accelerations at its start were known."""
    n_q, none = system.n_q, np.zeros(0)
    columns = np.zeros((n_q, 0))
    occurrences = None if events is None else [none for _ in events]
    states = None if events is None else [np.zeros((0, n_q)) for _ in events]
    return Record(
        t=none,
        q=columns,
        v=columns.copy(),
        a=columns.copy(),
        lam=np.zeros((system.n_c + system.n_a, 0)),
        h=none.copy(),
        status=Status.INTERRUPTED,
        message=describe_interrupt(t0, columns.T) + explained(Status.INTERRUPTED),
        stats=Statistics(n_accepted=0),
        t_events=occurrences,
        q_events=states,
        v_events=states,
        system=system,
        method=method,
    )


BUFFER_ROWS = 1024  # largest number of states in the buffers of a chunk ...
BUFFER_STEPS = 4096  # ... and of steps
CHUNK_TO_EVENT = 16  # attempts per chunk if an event may end the run: steps computed beyond it are in vain
CHUNK_TIME = 0.05  # s of CPU; chunks that take longer do not grow, so that Ctrl-C is heard
# statuses whose message may say that stability limited the steps
EXPLAINED_BY_STIFFNESS = {Status.REACHED_END, Status.EVENT, Status.MAX_STEPS, Status.TIME_LIMIT, Status.STAGNATED}
MOST_PAST = 16  # largest number of accepted steps that a step across a singular position may begin from
NO_KINDS = np.zeros(0, dtype=np.int64)  # kinds of intervals if no states between steps are requested
MOST_SPARE, LARGEST_SPARE = 16, 250_000  # largest number of buffers kept for later runs, and of numbers in each
_spare: dict[tuple[int, int, int], Buffers] = {}  # buffers for the next run, by their sizes


class IntegrationLoop:
    """Loop that integrates a run to its end, and records it.

    Parameters
    ----------
    run : Run
        A run at its start, or after a first chunk of steps, which is then given to `resume`.
    t1 : float
        End of the run, s.
    request : OutputRequest
    report : callable
        Takes the time reached, after each chunk.
    time_limit : float or None
        s.
    interrupts : Interrupts
    last : bool
        Whether the run is not repeated if it may have missed something.
    start : ndarray, optional
        The row [q, v, a, lam] at the start of a run that has left it.
    system : ConstrainedSystem, optional
        System of the result, if the arrays of the run's system will belong to another.
    """

    def __init__(
        self,
        run: Run,
        t1: float,
        request: OutputRequest,
        report: Callable[[float], object],
        time_limit: float | None,
        interrupts: Interrupts,
        last: bool = True,
        start: Array | None = None,
        system: ConstrainedSystem | None = None,
    ):
        self.run, self.t1, self.request, self.last = run, t1, request, last
        self.start, self.system = run.state if start is None else start, run.system if system is None else system
        self.report, self.interrupts = report, interrupts
        self.deadline = np.inf if time_limit is None else time.monotonic() + time_limit
        self.recorder = self._recorder()
        self.outputs = np.array([t1])
        if request.times is not None and request.lands:
            self.outputs = np.append(request.times[(request.times > run.t0) & (request.times < t1)], t1)
        run.control[run.a.STORE_ALL] = request.every_step
        self.largest_chunk = BUFFER_STEPS
        to_event = request.events is not None and any(event.terminal < np.inf for event in request.events)
        if to_event:
            self.largest_chunk = run.chunk = CHUNK_TO_EVENT
        # the run is checked after so many attempts, however long the chunks are that CHUNK_TIME allows
        self.between_looks = self.next_look = run.chunk
        self.plan, self.control, self.kit = run.plan, run.control, run.kit  # may differ from the run's own
        self.counts = BEFORE.copy()
        self.latest: list[tuple[Array, Array]] = []  # times and rows of the last two chunks
        self.step_parts = [np.empty((0, run.a.N_STEP_COLUMNS))]  # steps that were not stored yet, after an empty array
        if self.request.store.finished:
            self._tell()
        self.filled = np.zeros(2, dtype=np.int64)
        ends_before = to_event or time_limit is not None  # t1 may then be an arbitrary late time
        self.stall = StallDetector(run.t0, np.inf if ends_before else OUT_OF_REACH)
        self.stiffness = StiffnessMonitor(run.plan)
        self.sample = Sample(run.t0, self.start, 2 * run.system.n_q)
        self.cpu = 0.0
        self.raised: Exception | None = None
        self.code = INTERRUPTED if interrupts.asked else run.a.PAUSED

    def resume(self, code: int, t: Array, rows: Array, steps: Array, cpu_time: float) -> None:
        """Record a copy of the first chunk (times, rows and steps of `advance`), and handle the code that ended it."""
        self.code, self.cpu = code, cpu_time
        self._take(t.copy(), rows.copy(), steps.copy(), self._kinds(steps, False, False))
        self._handle(steps, False, cpu_time)

    def to_end(self, check_derivatives: bool) -> Record:
        """Integrate chunk by chunk to the end, compare derivatives once more there, and return the run's record."""
        run, recorder = self.run, self.recorder
        a, clock = run.a, run.clock
        buffers, copied = self._buffers(), True
        while self.code == a.PAUSED:
            across, leaps = self.plan is not run.plan, clock[a.APPLIES_JUMP] == 1.0
            began = time.process_time()
            self._advance(buffers)
            n_rows, n_steps = self.filled.tolist()
            t, rows, steps = buffers[0][:n_rows], buffers[1][:n_rows], buffers[2][:n_steps]
            copied = 2 * n_rows < len(buffers[0])  # copies take less memory then
            if copied:
                t, rows, steps = t.copy(), rows.copy(), steps.copy()
            if across and n_steps and self.request.between_steps:
                self.recorder.keep_crossing(self.plan.memory)
            self._take(t, rows, steps, self._kinds(steps, across, leaps))
            spent = time.process_time() - began
            self.cpu += spent
            if recorder.ended is not None:
                break
            self._handle(steps, across, spent)
            if not copied or len(buffers[0]) < min(run.chunk, BUFFER_ROWS):
                buffers = self._buffers()
        if copied and buffers[1].size <= LARGEST_SPARE:
            _spare[buffers[0].size, buffers[1].size, len(buffers[2])] = buffers
            for oldest in list(_spare)[:-MOST_SPARE]:
                _spare.pop(oldest, None)
        if self.request.between_steps:
            began = time.process_time()
            recorder.finish()
            self.cpu += time.process_time() - began
        if self.raised is not None and recorder.ended is None:
            raise self.raised
        return self._record(check_derivatives)

    def _handle(self, steps: Array, across: bool, spent: float) -> None:
        """Handle the code that `advance` returned; afterwards it is PAUSED if the loop continues, else why it stops."""
        if self.code == self.run.a.ALL_OUTPUT_DONE:
            if self.stiffness.samples:
                self.stiffness.add_steps(steps[:, self.run.a.H])
            self.report(self.t1)
            return
        self._look(steps, across, spent)
        self._go_on(across, len(steps))
        self.report(self.run.clock[self.run.a.T])

    def _advance(self, buffers: Buffers) -> None:
        """Advance by one chunk of steps in compiled code."""
        run, a = self.run, self.run.a
        run.control[a.MAX_ATTEMPTS] = min(run.chunk, max(0, self.next_look - run.attempts()))
        self.filled[:] = 0  # Ctrl-C may arrive before the chunk begins
        try:
            self.code = run.advance(self.outputs, buffers, self.filled, (self.plan, self.control, self.kit))
        except KeyboardInterrupt:
            self.code = INTERRUPTED
        except Exception as error:  # raised by a callback; beyond a terminal event it does not matter
            if (
                run.clock[a.SAMPLES_MOTION] == 1.0 and not self.interrupts.asked
            ):  # a sample of forces ahead may be at a state that the motion never reaches
                run.clock[a.SAMPLES_MOTION] = self.control[a.SAMPLE_MOTION] = 0.0
            else:
                self.code, self.raised = INTERRUPTED, None if self.interrupts.asked else error
                if not run.system.called_in_python:
                    error.add_note(_where(run.system.name, float(run.clock[a.T]), error))
        if self.interrupts.handlers is not None:
            self.interrupts.handlers.check()

    def _take(self, t: Array, rows: Array, steps: Array, kinds: NDArray[np.int64]) -> None:
        """Store the states and the steps of a chunk."""
        run = self.run
        self.sample.add(t, rows, float(run.clock[run.a.T]), run.state)
        self.step_parts.append(steps)
        if self.request.store.finished:
            self._tell()
        self.recorder.add(t, rows, kinds)
        if len(t):
            self.latest = [*self.latest[-1:], (t, rows)]

    def _tell(self) -> None:
        """Store the fields that have one row per step."""
        steps, self.step_parts = np.concatenate(self.step_parts), self.step_parts[:1]
        for name, values in step_fields(steps, self.counts).items():
            self.request.store.add(name, values)

    def _look(self, steps: Array, across: bool, spent: float) -> None:
        """Check whether the run makes progress, and choose the length of the next chunk."""
        run, a = self.run, self.run.a
        h = steps[:, a.H]
        self.stiffness.add_steps(h)
        self.stall.add_steps(h)
        if self.code == a.PAUSED and run.attempts() >= self.next_look:
            self.between_looks = min(2 * self.between_looks, self.largest_chunk)
            self.next_look = run.attempts() + self.between_looks
            if not across:
                self.stiffness.sample_state(float(run.clock[a.T]), run.state, run.system.n_q)
            if self.stall.stagnates(run.clock[a.T], self.t1) and run.control[a.MAX_STEPS] == np.inf:
                self.code = STAGNATED
        if spent < CHUNK_TIME:
            run.chunk = min(2 * run.chunk, self.largest_chunk)
        if self.code in (a.PAUSED, a.NEEDS_COMPILATION) and time.monotonic() > self.deadline:
            self.code = OUT_OF_TIME
        if self.code in (a.PAUSED, a.NEEDS_COMPILATION) and (self.interrupts.asked or self.recorder.interrupted):
            self.code = INTERRUPTED

    def _go_on(self, across: bool, n_steps: int) -> None:
        """Choose the method of the next steps, if it is not that of the last ones."""
        run, a = self.run, self.run.a
        if self.code == a.NEEDS_DENSE or run.is_lost_without_dense(self.code):
            run.change_form()
            self.plan, self.kit, self.code = run.plan, run.kit, a.PAUSED
        elif may_cross(run, self.code):
            self.plan, self.control = cross_singularity(run, self._past())
            self.kit = crossing_kit(run.kit)
            self.code = a.PAUSED
        elif self.code == a.SWITCH_METHOD or self._stalls(across):
            switch_method(run)
            if self.code == a.STEP_TOO_SMALL:
                run.clock[a.H_NEXT] = run.first_step(float(run.clock[a.T]), self.t1, run.state)
            self.plan, self.control, self.kit, self.code = run.plan, run.control, run.kit, a.PAUSED
        elif self.code == a.NEEDS_COMPILATION:
            began = time.monotonic()
            load(run)
            self.deadline += time.monotonic() - began  # compilation does not count against time_limit
            self.kit, self.code = run.kit, a.PAUSED
        elif self.code == a.AT_DISCONTINUITY and not across and apply_jump(run, self.t1):
            self.code = a.PAUSED
        elif self.plan is not run.plan and self.code != a.ALL_OUTPUT_DONE:
            found_before = bool(run.pieces)
            self.plan, self.control, self.code = after_crossing(run, self.plan, self.control, self.code, n_steps)
            if run.pieces and not found_before:
                self._correct_last()
            if self.plan is run.plan:
                self.kit = run.kit

    def _past(self) -> list[Place]:
        """Return the states of the last accepted steps, oldest first, as far as they are stored."""
        if not self.request.every_step:
            return []
        places = [(self.run.t0, self.start)] if len(self.latest) < 2 else []
        for t, rows in self.latest:
            places += zip(t[-MOST_PAST:].tolist(), rows[-MOST_PAST:], strict=True)
        return places[-MOST_PAST:]

    def _correct_last(self) -> None:
        """Replace the last stored state by that of the polynomial across a singular position: it has less rounding."""
        run = self.run
        t, row = float(run.clock[run.a.T]), run.state[: 3 * run.system.n_q]
        self.recorder.correct_last(t, row)
        if self.latest and len(self.latest[-1][0]) and self.latest[-1][0][-1] == t:
            self.latest[-1][1][-1, : len(row)] = row

    def _stalls(self, across: bool) -> bool:
        """Return whether a method that has a substitute makes no step, though no singular position is near."""
        run, a = self.run, self.run.a
        stalls = self.code == a.STEP_TOO_SMALL and run.control[a.MAY_SWITCH] == 1.0
        return stalls and not across and run.work.notes[indices.NEARLY_SINGULAR] != 1.0

    def _record(self, check_derivatives: bool) -> Record:
        run, recorder, code = self.run, self.recorder, self.code
        t, table = recorder.output()
        stats, store = statistics(run.work.counters, self.cpu), self.request.store
        self._tell()
        reached = float(run.clock[run.a.T])
        if recorder.ended is not None or recorder.broken_off is not None:
            for name in OF_STEPS:
                store.cut(name, recorder.n_steps)
            stats = replace(stats, n_accepted=recorder.n_steps)
        if recorder.ended is not None:
            event, end = recorder.ended
            if recorder.n_steps > 0:
                store.cut("h", recorder.n_steps - 1)
                store.add("h", np.array([recorder.last_step]))
            status, message = Status.EVENT, f"{event.name} ended the run at t = {end:.10g}."
        if recorder.broken_off is not None:
            reached = recorder.broken_off
        try:
            if recorder.ended is None:
                status, message = outcome(run, code, self.t1, self.stall)
            if status >= 0:
                end = reached if recorder.ended is None else recorder.ended[1]
                places = self._last_step(t, table), self._landed(t, table)
                status, message = reject_turned_velocities(run, *places, end, status, message)
            if code != INTERRUPTED:
                end = reached
                if recorder.last is not None:
                    self.sample.end(*recorder.last)
                    end = recorder.last[0]
                status, message = compare_callbacks(run, self.sample, end, check_derivatives, status, message)
            if self.last and status >= 0:
                message += warn_of_missed_changes(run) + warn_of_own_passages(run)
            if status >= 0 and run.start_warning:
                message += warn_user(run.start_warning)
            if status in EXPLAINED_BY_STIFFNESS:
                message += describe_stiffness(self.stiffness, run.kit, run.work)
        except KeyboardInterrupt:
            code = INTERRUPTED
        if self.interrupts.asked or recorder.interrupted or (code == INTERRUPTED and recorder.ended is None):
            status, message = Status.INTERRUPTED, describe_interrupt(reached, table)
        t_events, q_events, v_events = recorder.events()
        fields = of_run(run, t, table) | {name: store.array(name) for name in OF_STEPS}
        fields |= message_of(run, message + explained(status), self.system)
        fields |= {"status": status, "stats": stats, "sol": recorder.solution(), "system": self.system}
        fields |= {"t_events": t_events, "q_events": q_events, "v_events": v_events}
        return record_of(Record, DEFAULTS | fields)

    def _last_step(self, t: Array, table: Array) -> list[Place]:
        """Return the beginning of the last step if velocities turned in it, as they do near a singular position."""
        run = self.run
        if self.request.times is not None or self.recorder.ended is not None:
            return []
        if run.plan.watchful and run.work.notes[indices.NEARLY_SINGULAR] != 1.0:
            return []
        return [(float(t[-2]), table[-2])] if turned_last(t, table, run.system.n_q) else []

    def _landed(self, t: Array, table: Array) -> list[Place]:
        """Return the states on which steps had to end, if one of them is near a singular position."""
        run, request = self.run, self.request
        grid = run.control[run.a.FIXED_STEP] > 0.0 and request.times is None
        if not run.passed_near_singular() or not (grid or (request.times is not None and request.lands)):
            return []
        return list(zip(t.tolist(), table, strict=True))

    def _buffers(self) -> Buffers:
        """Return buffers for the states and steps of a chunk; each attempt fills at most one row."""
        chunk, width = self.run.chunk, len(self.run.state)
        n_rows, n_steps = max(min(chunk, BUFFER_ROWS), LANES), max(min(chunk, BUFFER_STEPS), LANES)
        spare = _spare.pop((n_rows, n_rows * width, n_steps), None)
        if spare is not None:
            return spare
        return np.empty(n_rows), np.empty((n_rows, width)), np.empty((n_steps, self.run.a.N_STEP_COLUMNS))

    def _recorder(self) -> Recorder:
        """Create the recorder, with an interpolator if states between steps are requested."""
        run, n = self.run, self.run.system.n_q
        interpolator = interpolator_of(run, self.start[: 3 * n]) if self.request.between_steps else None
        apart = LONGEST_UNSEEN * (self.t1 - run.t0) / SAMPLES
        every = float(run.tolerances[indices.LOOK]) if run.sudden.by_state else apart
        return Recorder(self.request, interpolator, n, run.t0, self.start, every)

    def _kinds(self, steps: Array, across: bool, leaps: bool) -> NDArray[np.int64]:
        """Return the kind of interval of each accepted step, for the dense solution."""
        run = self.run
        if not self.request.between_steps:
            return NO_KINDS
        if leaps:
            return np.full(len(steps), indices.JUMP)
        if across:
            return np.full(len(steps), indices.ACROSS)
        return interval_kinds(run, steps)


def silent(t: float) -> None:
    """Report no progress."""


def _where(name: str, t: float, error: Exception) -> str:
    """Describe what the error of a compiled callback does not contain: the system, and the time."""
    beyond = ": it asks an array for more than it has, as beyond the end of a table" * isinstance(error, IndexError)
    return f"raised by a compiled callback of system {name!r} in a step from t = {t:.10g}{beyond}"

"""Integrate chunk by chunk: call the compiled `advance`, handle the code that it returns, and record the run."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.traced_values import Sample
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import intervals, noted, tolerances
from twoloop.kernels.data.collocation import LANES
from twoloop.kernels.data.tolerances import LONGEST_UNSEEN
from twoloop.problem.events import SAMPLES
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.between import interpolator_of
from twoloop.run.comparison import compared
from twoloop.run.crossings import Place, turned_last
from twoloop.run.fields import BEFORE, kinds_of, of_run, of_steps, statistics
from twoloop.run.interrupts import Interrupts, said_of_interrupt
from twoloop.run.kept import OF_STEPS
from twoloop.run.messages import message_of, outcome, unless_turned, warned
from twoloop.run.pace import INTERRUPTED, OUT_OF_REACH, OUT_OF_TIME, STAGNATED, Pace
from twoloop.run.passage import beyond, bridge, bridging_kit, give_way, leap, load
from twoloop.run.record import DEFAULTS, Record, Status, explained, record_of
from twoloop.run.recorder import Recorder, Wanted
from twoloop.run.run import Run
from twoloop.run.short_changes import said_of_missed
from twoloop.run.stability import Looks, said_of_stiffness

Array = NDArray[np.float64]
Buffers = tuple[Array, Array, Array]  # for times, states and steps

BUFFER_ROWS = 1024
BUFFER_STEPS = 4096
CHUNK_TO_EVENT = 16  # attempts where an event may end the run: what is computed beyond it is in vain
CHUNK_TIME = 0.05  # s of CPU; chunks that take longer do not grow, so that Ctrl-C is heard
# ends of which it may be said that stability limited the steps
EXPLAINED_BY_STIFFNESS = {Status.REACHED_END, Status.EVENT, Status.MAX_STEPS, Status.TIME_LIMIT, Status.STAGNATED}
NO_KINDS = np.zeros(0, dtype=np.int64)  # of intervals within which nothing is wanted
MOST_SPARE, LARGEST_SPARE = 16, 250_000  # buffers that wait for their next run, and numbers of each of them
_spare: dict[tuple[int, int, int], Buffers] = {}  # buffers, by their sizes, for the next run


class IntegrationLoop:
    """Take a run to its end, and record it.

    Parameters
    ----------
    run : Run
        At its start, or behind a first chunk of steps, with which the loop has to `resume`.
    t1 : float
        Where it ends, s.
    wanted : Wanted
    report : callable
        Takes the time reached, after each chunk.
    time_limit : float or None
        s.
    interrupts : Interrupts
    last : bool
        Whether it is not made again, if it may have missed something.
    start : ndarray, optional
        The row [q, v, a, lam] at the start of a run that has left it.
    system : ConstrainedSystem, optional
        The one that the result is of, where the arrays of that of the run will belong to another.
    """

    def __init__(
        self,
        run: Run,
        t1: float,
        wanted: Wanted,
        report: Callable[[float], object],
        time_limit: float | None,
        interrupts: Interrupts,
        last: bool = True,
        start: Array | None = None,
        system: ConstrainedSystem | None = None,
    ):
        self.run, self.t1, self.wanted, self.last = run, t1, wanted, last
        self.start, self.system = run.state if start is None else start, run.system if system is None else system
        self.report, self.interrupts = report, interrupts
        self.deadline = np.inf if time_limit is None else time.monotonic() + time_limit
        self.recorder = self._recorder()
        self.outputs = np.array([t1])
        if wanted.times is not None and wanted.lands:
            self.outputs = np.append(wanted.times[(wanted.times > run.t0) & (wanted.times < t1)], t1)
        run.control[run.a.STORE_ALL] = wanted.every_step
        self.largest_chunk = BUFFER_STEPS
        to_event = wanted.events is not None and any(event.terminal < np.inf for event in wanted.events)
        if to_event:
            self.largest_chunk = run.chunk = CHUNK_TO_EVENT
        # the run is looked at after so many attempts, however long the chunks are that the clock allows
        self.between_looks = self.next_look = run.chunk
        self.plan, self.control, self.kit = run.plan, run.control, run.kit  # at the moment: not always the run's own
        self.counts = BEFORE.copy()
        self.step_parts = [np.empty((0, run.a.N_STEP_COLUMNS))]  # of which nothing is kept yet
        if self.wanted.kept.finished:
            self._tell()
        self.filled = np.zeros(2, dtype=np.int64)
        ends_before = to_event or time_limit is not None  # then t1 may only stand for any time
        self.pace = Pace(run.t0, np.inf if ends_before else OUT_OF_REACH)
        self.looks = Looks(run.plan)
        self.sample = Sample(run.t0, self.start, 2 * run.system.n_q)
        self.cpu = 0.0
        self.raised: Exception | None = None
        self.code = INTERRUPTED if interrupts.asked else run.a.PAUSED

    def resume(self, code: int, t: Array, rows: Array, steps: Array, cpu_time: float) -> None:
        """Copy the first chunk, times, rows and steps as of `advance`, and handle the code that it ended with."""
        self.code, self.cpu = code, cpu_time
        self._take(t.copy(), rows.copy(), steps.copy(), self._kinds(steps, False, False))
        self._handle(steps, False, cpu_time)

    def to_end(self, check_derivatives: bool) -> Record:
        """Go on chunk by chunk, compare derivatives once more at the end, and return the record of the run."""
        run, recorder = self.run, self.recorder
        a, clock = run.a, run.clock
        buffers, copied = self._buffers(), True
        while self.code == a.PAUSED:
            across, leaps = self.plan is not run.plan, clock[a.LEAPS] == 1.0
            began = time.process_time()
            self._advance(buffers)
            n_rows, n_steps = self.filled.tolist()
            t, rows, steps = buffers[0][:n_rows], buffers[1][:n_rows], buffers[2][:n_steps]
            copied = 2 * n_rows < len(buffers[0])  # then copies take less room
            if copied:
                t, rows, steps = t.copy(), rows.copy(), steps.copy()
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
        if self.wanted.between_steps:
            began = time.process_time()
            recorder.finish()
            self.cpu += time.process_time() - began
        if self.raised is not None and recorder.ended is None:
            raise self.raised
        return self._record(check_derivatives)

    def _handle(self, steps: Array, across: bool, spent: float) -> None:
        """Handle the code that `advance` came back with: at the end it stays, else it says why the loop stops."""
        if self.code == self.run.a.ALL_OUTPUT_DONE:
            if self.looks.kept:
                self.looks.pass_by(steps[:, self.run.a.H])
            self.report(self.t1)
            return
        self._look(steps, across, spent)
        self._go_on(across, len(steps))
        self.report(self.run.clock[self.run.a.T])

    def _advance(self, buffers: Buffers) -> None:
        """One chunk, compiled."""
        run, a = self.run, self.run.a
        run.control[a.MAX_ATTEMPTS] = min(run.chunk, max(0, self.next_look - run.attempts()))
        self.filled[:] = 0  # for Ctrl-C before the chunk begins
        try:
            self.code = direct(run.kernels.advance)(
                self.kit,
                run.work,
                self.plan.options,
                self.plan.memory,
                run.tolerances,
                self.control,
                run.clock,
                run.state,
                run.new_state,
                self.outputs,
                *buffers,
                self.filled,
            )
        except KeyboardInterrupt:
            self.code = INTERRUPTED
        except Exception as error:  # of a callback; beyond a terminal event it does not matter
            if run.clock[a.LOOKING] == 1.0 and not self.interrupts.asked:  # at a state to which the run may not come
                run.clock[a.LOOKING] = self.control[a.AHEAD] = 0.0
            else:
                self.code, self.raised = INTERRUPTED, None if self.interrupts.asked else error
                if not run.system.called_in_python:
                    error.add_note(_where(run.system.name, float(run.clock[a.T]), error))

    def _take(self, t: Array, rows: Array, steps: Array, kinds: NDArray[np.int64]) -> None:
        """Take over what a chunk has stored."""
        run = self.run
        self.sample.add(t, rows, float(run.clock[run.a.T]), run.state)
        self.step_parts.append(steps)
        if self.wanted.kept.finished:
            self._tell()
        self.recorder.add(t, rows, kinds)

    def _tell(self) -> None:
        """Keep what is told of each step."""
        steps, self.step_parts = np.concatenate(self.step_parts), self.step_parts[:1]
        for name, values in of_steps(steps, self.counts).items():
            self.wanted.kept.add(name, values)

    def _look(self, steps: Array, across: bool, spent: float) -> None:
        """See whether the run gets anywhere, and how long the next chunk may be."""
        run, a = self.run, self.run.a
        h = steps[:, a.H]
        self.looks.pass_by(h)
        self.pace.pass_by(h)
        if self.code == a.PAUSED and run.attempts() >= self.next_look:
            self.between_looks = min(2 * self.between_looks, self.largest_chunk)
            self.next_look = run.attempts() + self.between_looks
            if not across:
                self.looks.take(float(run.clock[a.T]), run.state, run.system.n_q)
            if self.pace.stagnates(run.clock[a.T], self.t1) and run.control[a.MAX_STEPS] == np.inf:
                self.code = STAGNATED
        if spent < CHUNK_TIME:
            run.chunk = min(2 * run.chunk, self.largest_chunk)
        if self.code in (a.PAUSED, a.HAS_TO_LOAD) and time.monotonic() > self.deadline:
            self.code = OUT_OF_TIME
        if self.code in (a.PAUSED, a.HAS_TO_LOAD) and (self.interrupts.asked or self.recorder.interrupted):
            self.code = INTERRUPTED

    def _go_on(self, across: bool, n_steps: int) -> None:
        """Choose what makes the next steps, where it is not what made the last ones."""
        run, a = self.run, self.run.a
        if self.code == a.HAS_TO_BE_DENSE or run.is_lost_without_dense(self.code):
            run.change_form()
            self.plan, self.kit, self.code = run.plan, run.kit, a.PAUSED
        elif self.code == a.HAS_TO_GIVE_WAY or self._stalls(across):
            give_way(run)
            if self.code == a.STEP_TOO_SMALL:
                run.clock[a.H_NEXT] = run.first_step(float(run.clock[a.T]), self.t1, run.state)
            self.plan, self.control, self.kit, self.code = run.plan, run.control, run.kit, a.PAUSED
        elif self.code == a.HAS_TO_LOAD:
            began = time.monotonic()
            load(run)
            self.deadline += time.monotonic() - began  # compilation does not count
            self.kit, self.code = run.kit, a.PAUSED
        elif self.code == a.AT_JUMP and not across and leap(run, self.t1):
            self.code = a.PAUSED
        elif self.code == a.NEAR_SINGULAR:
            self.plan, self.control = bridge(run)
            self.kit = bridging_kit(run.kit)
            self.code = a.PAUSED
        elif self.plan is not run.plan and self.code != a.ALL_OUTPUT_DONE:
            self.plan, self.control, self.code = beyond(run, self.plan, self.control, self.code, n_steps)
            if self.plan is run.plan:
                self.kit = run.kit

    def _stalls(self, across: bool) -> bool:
        """Whether a method that has a substitute takes no step, though no singular position is near."""
        run, a = self.run, self.run.a
        stalls = self.code == a.STEP_TOO_SMALL and run.control[a.GIVES_WAY] == 1.0
        return stalls and not across and run.work.notes[noted.NEARLY_SINGULAR] != 1.0

    def _record(self, check_derivatives: bool) -> Record:
        run, recorder, code = self.run, self.recorder, self.code
        t, table = recorder.output()
        stats, kept = statistics(run.work.counters, self.cpu), self.wanted.kept
        self._tell()
        reached = float(run.clock[run.a.T])
        if recorder.ended is not None or recorder.broken_off is not None:
            for name in OF_STEPS:
                kept.cut(name, recorder.n_steps)
            stats = replace(stats, n_accepted=recorder.n_steps)
        if recorder.ended is not None:
            event, end = recorder.ended
            if recorder.n_steps > 0:
                kept.cut("h", recorder.n_steps - 1)
                kept.add("h", np.array([recorder.last_step]))
            status, message = Status.EVENT, f"{event.name} ended the run at t = {end:.10g}."
        if recorder.broken_off is not None:
            reached = recorder.broken_off
        try:
            if recorder.ended is None:
                status, message = outcome(run, code, self.t1, self.pace)
            if status >= 0:
                end = reached if recorder.ended is None else recorder.ended[1]
                places = self._last_step(t, table), self._landed(t, table)
                status, message = unless_turned(run, *places, end, status, message)
            if code != INTERRUPTED:
                end = reached
                if recorder.last is not None:
                    self.sample.end(*recorder.last)
                    end = recorder.last[0]
                status, message = compared(run, self.sample, end, check_derivatives, status, message)
            if self.last and status >= 0:
                message += said_of_missed(run)
            if status >= 0 and run.said_of_start:
                message += warned(run.said_of_start)
            if status in EXPLAINED_BY_STIFFNESS:
                message += said_of_stiffness(self.looks, run.kit, run.work)
        except KeyboardInterrupt:
            code = INTERRUPTED
        if self.interrupts.asked or recorder.interrupted or (code == INTERRUPTED and recorder.ended is None):
            status, message = Status.INTERRUPTED, said_of_interrupt(reached, table)
        t_events, q_events, v_events = recorder.events()
        fields = of_run(run, t, table) | {name: kept.array(name) for name in OF_STEPS}
        fields |= message_of(run, message + explained(status), self.system)
        fields |= {"status": status, "stats": stats, "sol": recorder.solution(), "system": self.system}
        fields |= {"t_events": t_events, "q_events": q_events, "v_events": v_events}
        return record_of(Record, DEFAULTS | fields)

    def _last_step(self, t: Array, table: Array) -> list[Place]:
        """The beginning of the last step where velocities turned in it, as near a singular position: else nothing."""
        run = self.run
        if self.wanted.times is not None or self.recorder.ended is not None:
            return []
        if run.plan.watchful and run.work.notes[noted.NEARLY_SINGULAR] != 1.0:
            return []
        return [(float(t[-2]), table[-2])] if turned_last(t, table, run.system.n_q) else []

    def _landed(self, t: Array, table: Array) -> list[Place]:
        """The states on which steps had to end, where one of them is near a singular position: else nothing."""
        run, wanted = self.run, self.wanted
        grid = run.control[run.a.FIXED_STEP] > 0.0 and wanted.times is None
        if not run.came_near() or not (grid or (wanted.times is not None and wanted.lands)):
            return []
        return list(zip(t.tolist(), table, strict=True))

    def _buffers(self) -> Buffers:
        """Room for the states and steps of a chunk, each attempt of which fills one row at most."""
        chunk, width = self.run.chunk, len(self.run.state)
        n_rows, n_steps = max(min(chunk, BUFFER_ROWS), LANES), max(min(chunk, BUFFER_STEPS), LANES)
        spare = _spare.pop((n_rows, n_rows * width, n_steps), None)
        if spare is not None:
            return spare
        return np.empty(n_rows), np.empty((n_rows, width)), np.empty((n_steps, self.run.a.N_STEP_COLUMNS))

    def _recorder(self) -> Recorder:
        """What takes the states; where some are to lie between steps, with what finds them."""
        run, n = self.run, self.run.system.n_q
        interpolator = interpolator_of(run, self.start[: 3 * n]) if self.wanted.between_steps else None
        apart = LONGEST_UNSEEN * (self.t1 - run.t0) / SAMPLES
        every = float(run.tolerances[tolerances.LOOK]) if run.sudden.by_state else apart
        return Recorder(self.wanted, interpolator, n, run.t0, self.start, every)

    def _kinds(self, steps: Array, across: bool, leaps: bool) -> NDArray[np.int64]:
        """What kind of interval each of these accepted steps is, for the solution between them."""
        run = self.run
        if not self.wanted.between_steps:
            return NO_KINDS
        if leaps:
            return np.full(len(steps), intervals.JUMP)
        if across:
            return np.full(len(steps), intervals.ACROSS)
        return kinds_of(run, steps)


def silent(t: float) -> None:
    """Report nothing of how far a run is."""


def _where(name: str, t: float, error: Exception) -> str:
    """What of a compiled callback's error the error does not say."""
    beyond = ": it asks an array for more than it has, as beyond the end of a table" * isinstance(error, IndexError)
    return f"raised by a compiled callback of system {name!r} in a step from t = {t:.10g}{beyond}"

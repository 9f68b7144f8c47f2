"""One run: its arrays, the chunks that the compiled `advance` returns, and what to say of how it ended."""

import time
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import (
    dependent_rows,
    in_words,
    least_inertia,
    pattern_of,
)
from twoloop.generate.traced_values import Sample
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import common, intervals
from twoloop.kernels.layout import copy_of
from twoloop.methods.plan import Plan, least_tolerance
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.comparison import compared
from twoloop.run.dense import Interpolator
from twoloop.run.impulse import beyond_jump
from twoloop.run.interrupts import Interrupts, said_of_interrupt
from twoloop.run.messages import outcome, said_of_not_finite
from twoloop.run.pace import INTERRUPTED, OUT_OF_TIME, STAGNATED, Pace
from twoloop.run.record import Record, Statistics, Status, explained
from twoloop.run.recorder import Recorder, Wanted
from twoloop.run.stability import Looks, said_of_stiffness
from twoloop.run.workspace import kit_of, kit_with, workspace

Array = NDArray[np.float64]

BUFFER_ROWS = 1024
BUFFER_STEPS = 4096
FIRST_CHUNK = 1024  # attempts of a small compiled system before Python looks at the run: a look costs 0.2 ms
FIRST_CHUNK_IN_PYTHON = 64  # ... of one whose callbacks are plain Python functions, which may be slow
SMALL = 32  # coordinates; chunks of larger systems are shorter in proportion
CHUNK_TO_EVENT = 16  # attempts where an event may end the run: what is computed beyond it is in vain
CHUNK_TIME = 0.05  # s of CPU; chunks that take longer do not grow, so that Ctrl-C is heard
LONGEST_UNSEEN = 0.01  # of the run: within this time the equations are looked at once at least
PROVISIONAL = 10  # steps after which a method that pays for long steps only gives way if they are short
FIRST_STEP = 0.01  # of the shortest time scale that the initial state shows
SHORTEST_STEP = 1e-16  # of the first step
CONTRADICTS = 1e-6  # relative: what the accelerations of redundant rows may differ by
# of the longest of the last steps: lengths tried for a step across a singular position, on which no stage should fall
BRIDGES = tuple(0.85**k for k in range(28))
CLEAR = 0.3  # of the largest pivot that C_q had: where the run's own steps go on
# ends of which it may be said that stability limited the steps
EXPLAINED_BY_STIFFNESS = {Status.REACHED_END, Status.EVENT, Status.MAX_STEPS, Status.TIME_LIMIT, Status.STAGNATED}
NO_KINDS = np.zeros(0, dtype=np.int64)  # of intervals within which nothing is wanted
MOST_SPARE, LARGEST_SPARE = 16, 100_000  # buffers that wait for their next run, and numbers of each of them
_spare: dict[tuple[int, int, int], tuple[Array, Array, Array]] = {}  # buffers, by their sizes, for the next run


class Run:
    """The arrays of one run, and the loop over its chunks.

    Raises
    ------
    ValueError
        If the accelerations at the start cannot be found.
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

        self.a = advance
        self.system, self.plan, self.t0 = system, plan, t0
        self.memory = plan.memory.copy()
        self.rtol, self.reuse, self.interiors, self.traced = rtol, plan.reuse, interiors, plan.traced
        self.kit = kit_of(system, t0, q0, plan)
        self.functions = self.kit.functions
        n_rows = system.n_c + system.n_a
        self.state = np.concatenate([q0, v0, np.zeros(system.n_q + n_rows)])
        self.pattern = system.remembered_at("pattern", (t0, q0.tobytes()), lambda: pattern_of(system, t0, q0))
        self.work = self._workspace()
        self.new_state = np.zeros_like(self.state)
        self.tolerances = np.zeros(common.ATOL + system.n_q)
        self.tolerances[common.RTOL] = rtol
        self.tolerances[common.ESTIMATE] = step_size is None
        self.tolerances[common.LEAST] = least_tolerance(rtol, float(atol.min()))
        self.tolerances[common.ATOL :] = atol
        self.control = np.zeros(advance.N_CONTROL)
        self.control[advance.MAX_STEP] = np.inf
        self.control[advance.FIXED_STEP] = 0.0 if step_size is None else step_size
        self.control[advance.MAX_STEPS] = np.inf
        self.control[advance.BRIDGE] = 1.0
        rates = system.given.keys() & {"constraint_rate", "nonholonomic_rate", "kinematics"}
        self.control[advance.DRIVEN] = bool(rates)
        first_chunk = FIRST_CHUNK_IN_PYTHON if system.called_in_python else FIRST_CHUNK
        self.chunk = max(1, first_chunk // max(1, system.n_q // SMALL))  # attempts in one call of advance, at most
        self.clock = np.zeros(advance.N_CLOCK)
        self.clock[advance.T] = self.clock[advance.T_START] = t0
        self._control_by(plan)
        self.substituted = False  # whether another plan has taken over, for good
        self.clock[advance.JUMP_FROM] = self.clock[advance.JUMP_TO] = np.inf
        self.clock[advance.ROUGH_TO] = -np.inf
        self.crossings: list[list[tuple[float, Array]]] = []  # states before and behind steps across singular positions
        self.jumps: list[float] = []  # times at which velocities changed as by an impulse
        self.compared_to = [-np.inf]  # how far callbacks were compared along the motion, in this run or the same before
        self._begin()
        self.rank = len(self.work.rows_v)
        self.redundant, self.said_of_rows = self._redundant_rows()

    def again(self) -> "Run":
        """The same run from its start, of which this one may not have taken a step."""
        other = object.__new__(Run)
        vars(other).update(vars(self), plan=self.plan.fresh(), crossings=[], jumps=[])
        for name in ("state", "new_state", "tolerances", "control", "clock"):
            setattr(other, name, getattr(self, name).copy())
        if self.kit.flags[common.FORM] == common.AUGMENTED:  # which a run may change
            other.kit = kit_with(self.system, self.kit.flags, other.plan)
            other.functions = other.kit.functions
        other.work = copy_of(self.work)
        return other

    def _control_by(self, plan: Plan) -> None:
        """Step-size control as a plan wants it."""
        a, control = self.a, self.control
        control[: a.N_RULE] = plan.rule
        control[a.LIMIT_START], control[a.LIMIT_FACTOR] = plan.limit_start, plan.limit_factor
        control[a.LIMIT_MEMORY], control[a.SYMMETRIC] = plan.limit_memory, plan.symmetric
        control[a.ROUGH] = plan.rough
        control[a.GIVES_WAY] = plan.substitute is not None
        control[a.PROVISIONAL] = PROVISIONAL if plan.provisional else -1.0
        self.clock[a.H_LIMIT] = plan.limit_start

    def _workspace(self, rank: int | None = None, rank_v: int | None = None) -> Any:
        """Arrays for ranks of C_q and of all rows; without them for full ones."""
        q0 = self.state[: self.system.n_q]
        work = workspace(self.system, self.kit, self.pattern, q0, self.rtol, self.reuse, (rank, rank_v))
        work.notes[common.NEARLY_SINGULAR] = 0.0 if self.plan.watchful else 1.0
        return work

    def _begin(self) -> None:
        start = direct(self.a.start)
        code = start(self.kit, self.work, self.t0, self.state)
        if code == common.RANK_DIFFERS:
            ranks = [int(self.work.notes[place]) for place in (common.RANK, common.RANK_V)]
            self.work = self._workspace(*ranks)
            code = start(self.kit, self.work, self.t0, self.state)
        if code == common.GAMMA_INACCURATE:  # the first step says so, too, and that run has a result
            required = self.work.notes[common.GAMMA_REQUIRED]
            self.work.notes[common.GAMMA_REQUIRED] = np.inf
            code = start(self.kit, self.work, self.t0, self.state)
            self.work.notes[common.GAMMA_REQUIRED] = required
        if code == common.DONE:
            return
        n = self.system.n_q
        if code == common.MASS_NOT_DEFINITE:
            raise ValueError(
                f"mass of {self.system.name!r} must be positive definite on the velocities that the constraints allow; "
                f"at t = {self.t0!r} {least_inertia(self.system, self.t0, self.state[:n])[1]}"
            )
        if code == common.SINGULAR:
            raise ValueError(
                f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: the constraint "
                f"Jacobian has lost rank there ({dependent_rows(self.system, self.t0, self.state[:n])}). Start from "
                "another position"
            )
        raise ValueError(
            f"the accelerations of {self.system.name!r} cannot be found at t = {self.t0!r}: {said_of_not_finite(self)}"
        )

    def _redundant_rows(self) -> tuple[NDArray[np.int64], str]:
        """Which rows depend on others at the start, and what is said of them."""
        n_rows, n = self.system.n_c + self.system.n_a, self.system.n_q
        if self.rank == n_rows:
            return np.zeros(0, dtype=np.int64), ""
        redundant = np.setdiff1d(np.arange(n_rows), self.work.rows_v)
        rows, a = self.system.rows(self.t0, self.state[:n]), self.state[2 * n : 3 * n]
        off = np.abs(rows @ a - self.work.Gamma)
        allowed = CONTRADICTS * np.maximum(np.abs(rows) @ np.abs(a) + np.abs(self.work.Gamma), 1.0)
        wrong = np.flatnonzero(off > allowed).tolist()
        if wrong:
            raise ValueError(
                f"the constraints of {self.system.name!r} contradict one another at t = {self.t0:g}: "
                f"{in_words(rows, wrong)}, but not so their accelerations. Correct or leave out one of these rows"
            )
        return redundant, (
            f"the constraints of {self.system.name!r} have rank {self.rank} of {n_rows} at t = {self.t0:g}: "
            f"{in_words(rows, redundant.tolist())}. They are left out of the solution and checked at every "
            "step; multipliers are those of least norm. See docs/constraints.md#redundant-rows"
        )

    def set_sizes(self, first_step: float | None, max_step: float, t1: float) -> None:
        """Set the first and the largest step, s."""
        span = t1 - self.t0
        first = min(self._first_step(span, self.state) if first_step is None else first_step, span)
        self.clock[self.a.H_NEXT] = first
        self.control[self.a.SHORTEST] = SHORTEST_STEP * first
        self.max_step, self.gap = max_step, LONGEST_UNSEEN * span
        self.tolerances[common.GAP] = self.gap
        self._limit_steps()

    def _limit_steps(self) -> None:
        """Let no step that does not look at the equations between its ends pass over a hundredth of the run."""
        self.control[self.a.MAX_STEP] = self.max_step if self.plan.looks_within else min(self.max_step, self.gap)

    def _first_step(self, span: float, state: Array) -> float:
        """A share of the time in which velocities and accelerations of a state change the coordinates as a whole."""
        n = self.system.n_q
        q, v, a = np.abs(state[: 3 * n]).reshape(3, n).max(axis=1).tolist()
        q = max(q, float(self.tolerances[common.ATOL :].min()))  # all coordinates zero: there is no other length
        scales = [span]
        if v > 0.0:
            scales.append(q / v)
        if a > 0.0:
            scales.append(float(np.sqrt(q / a)))
        if v > 0.0 and a > 0.0 and v / a > FIRST_STEP * min(scales):  # not at what is next to rest
            scales.append(v / a)
        return FIRST_STEP * min(scales)

    def go(
        self,
        t1: float,
        wanted: Wanted,
        report: Any,
        time_limit: float | None,
        check_derivatives: bool,
        interrupts: Interrupts,
    ) -> Record:
        """Advance to t1, chunk by chunk, and assemble the result; look at derivatives once more at the end."""
        deadline = np.inf if time_limit is None else time.monotonic() + time_limit
        a, system = self.a, self.system
        recorder = self._recorder(wanted)
        outputs = np.array([t1])
        if wanted.times is not None and wanted.lands:
            outputs = np.append(wanted.times[(wanted.times > self.t0) & (wanted.times < t1)], t1)
        self.control[a.STORE_ALL] = wanted.every_step
        largest_chunk = BUFFER_STEPS
        if any(event.terminal < np.inf for event in wanted.events or []):
            largest_chunk = self.chunk = CHUNK_TO_EVENT
        # the run is looked at after so many attempts, however long the chunks are that the clock allows
        between_looks, next_look = self.chunk, self.chunk
        step_parts = [np.array([[0.0, 0.0, 0.0, 1.0, 0.0]])]  # the first partition of a run is not a renewal
        filled = np.zeros(2, dtype=np.int64)
        advance, pace, looks = direct(a.advance), Pace(self.t0), Looks(self.plan)
        cpu = 0.0
        sample = Sample(2 * system.n_q)
        sample.add(self.clock[a.T : a.T + 1], self.state[None, :])
        code = INTERRUPTED if interrupts.asked else a.PAUSED
        out_t, out_state, out_steps = buffers = self._buffers()
        plan, control, kit = self.plan, self.control, self.kit
        raised: Exception | None = None
        sparse = True  # whether what the buffers hold was copied
        while code == a.PAUSED:
            across, leaps = plan is not self.plan, self.clock[a.LEAPS] == 1.0
            self.control[a.MAX_ATTEMPTS] = min(self.chunk, max(0, next_look - self._attempts()))
            began = time.process_time()
            try:
                code = advance(
                    kit,
                    self.work,
                    plan.options,
                    plan.memory,
                    self.tolerances,
                    control,
                    self.clock,
                    self.state,
                    self.new_state,
                    outputs,
                    out_t,
                    out_state,
                    out_steps,
                    filled,
                )
            except KeyboardInterrupt:
                code = INTERRUPTED
            except Exception as error:  # of a callback; beyond a terminal event it does not matter
                code, raised = INTERRUPTED, None if interrupts.asked else error
            n_rows, n_steps = filled.tolist()
            t, rows, steps = out_t[:n_rows], out_state[:n_rows], out_steps[:n_steps]
            sample.add(t, rows)
            sample.add(self.clock[a.T : a.T + 1], self.state[None, :])
            sparse = 2 * n_rows < len(out_t)  # then copies take less room
            if sparse:
                t, rows, steps = t.copy(), rows.copy(), steps.copy()
            step_parts.append(steps)
            kinds = self._kinds(steps, across, leaps) if wanted.between_steps else NO_KINDS
            recorder.add(t, rows, kinds)
            spent = time.process_time() - began
            cpu += spent
            filled[:] = 0  # for Ctrl-C before the next chunk begins
            if recorder.ended is not None:
                break
            looks.pass_by(steps[:, a.H])
            pace.pass_by(steps[:, a.H])
            if code == a.PAUSED and self._attempts() >= next_look:
                between_looks = min(2 * between_looks, largest_chunk)
                next_look = self._attempts() + between_looks
                if not across:
                    looks.take(float(self.clock[a.T]), self.state, system.n_q)
                if pace.stagnates(self.clock[a.T], t1) and self.control[a.MAX_STEPS] == np.inf:
                    code = STAGNATED
            if spent < CHUNK_TIME:
                self.chunk = min(2 * self.chunk, largest_chunk)
            if not sparse or len(out_t) < min(self.chunk, BUFFER_ROWS):
                out_t, out_state, out_steps = buffers = self._buffers()
            if code == a.PAUSED and time.monotonic() > deadline:
                code = OUT_OF_TIME
            if code == a.PAUSED and (interrupts.asked or recorder.interrupted):
                code = INTERRUPTED
            if code == a.HAS_TO_GIVE_WAY:
                self._give_way()
                plan, control, kit, code = self.plan, self.control, self.kit, a.PAUSED
            elif code == a.AT_JUMP and not across and self.leap(t1):
                code = a.PAUSED
            elif code == a.NEAR_SINGULAR:
                plan, control = self._bridge()
                kit = common.Kit(self.functions, self.kit.general, plan.step)
                code = a.PAUSED
            elif plan is not self.plan and code != a.ALL_OUTPUT_DONE:
                plan, control, code = self._beyond(plan, control, code, n_steps)
                kit = self.kit if plan is self.plan else kit
            report(self.clock[a.T])
        if sparse and out_state.size <= LARGEST_SPARE and len(_spare) < MOST_SPARE:
            _spare[out_t.size, out_state.size, len(out_steps)] = buffers
        if wanted.between_steps:
            began = time.process_time()
            recorder.finish()
            cpu += time.process_time() - began
        if raised is not None and recorder.ended is None:
            raise raised
        t, table = recorder.output()
        steps, statistics = np.concatenate(step_parts), self._statistics(cpu)
        if recorder.ended is not None:
            event, end = recorder.ended
            steps = steps[: recorder.n_steps + 1]
            if recorder.n_steps > 0:
                steps[-1, a.H] = recorder.last_step
            status, message = Status.EVENT, f"{event.name} ended the run at t = {end:.10g}."
            statistics = replace(statistics, n_accepted=recorder.n_steps)
        reached = float(self.clock[a.T])
        if recorder.broken_off is not None:
            reached, steps = recorder.broken_off, steps[: recorder.n_steps + 1]
            statistics = replace(statistics, n_accepted=recorder.n_steps)
        n = system.n_q
        try:
            if recorder.ended is None:
                status, message = outcome(self, code, t1, pace)
            if code != INTERRUPTED:
                last = (float(self.clock[a.T]), self.state) if recorder.last is None else recorder.last
                status, message = compared(self, t, table, last, sample, check_derivatives, status, message)
            if status in EXPLAINED_BY_STIFFNESS:
                message += said_of_stiffness(looks, self.kit, self.work)
        except KeyboardInterrupt:
            code = INTERRUPTED
        if interrupts.asked or recorder.interrupted or (code == INTERRUPTED and recorder.ended is None):
            status, message = Status.INTERRUPTED, said_of_interrupt(reached, table)
        counts = steps[:, a.ERRORS : a.JACOBIANS].T.astype(np.int64)
        errors, failures, partitions = counts[:, 1:] - counts[:, :-1]
        t_events, q_events, v_events = recorder.events()
        return Record(
            t=t,
            q=table[:, :n].T,
            v=table[:, n : 2 * n].T,
            a=table[:, 2 * n : 3 * n].T,
            lam=table[:, 3 * n :].T,
            h=steps[1:, a.H],
            status=status,
            message=message + explained(status),
            stats=statistics,
            rank=self.rank,
            redundant=self.redundant,
            rejected_error=errors,
            rejected_convergence=failures,
            partitioned=partitions,
            untested=steps[1:, a.JACOBIANS] > 0.0,
            sol=recorder.solution(),
            t_events=t_events,
            q_events=q_events,
            v_events=v_events,
            defect=self._defect(),
            widest_gap=float(self.work.notes[common.WIDEST_GAP]),
            system=system,
        )

    def _defect(self) -> float | None:
        """The largest defect of the steps, if all looked for it."""
        checked = self.work.counters[common.N_ACCEPTED] > 0 and self.work.notes[common.UNCHECKED] == 0.0
        return float(self.work.notes[common.LARGEST_DEFECT]) if checked else None

    def _buffers(self) -> tuple[Array, Array, Array]:
        """Room for the states and steps of a chunk, each attempt of which fills one row at most."""
        n_rows, n_steps = min(self.chunk, BUFFER_ROWS), min(self.chunk, BUFFER_STEPS)
        spare = _spare.pop((n_rows, n_rows * len(self.state), n_steps), None)
        if spare is not None:
            return spare
        return np.empty(n_rows), np.empty((n_rows, len(self.state))), np.empty((n_steps, self.a.N_STEP_COLUMNS))

    def _recorder(self, wanted: Wanted) -> Recorder:
        """What takes the states; where some are to lie between steps, with what finds them."""
        n, interpolator = self.system.n_q, None
        if wanted.between_steps:
            ranks = (len(self.work.rows), len(self.work.rows_v))
            start, atol = self.state[: 3 * n], self.tolerances[common.ATOL :]
            interiors = {kind: plan.fresh() for kind, plan in self.interiors.items()}
            interpolator = Interpolator(self.system, self.t0, start, self.rtol, atol, ranks, interiors)
        return Recorder(wanted, interpolator, n, self.t0, self.state)

    def _kinds(self, steps: Array, across: bool, leaps: bool) -> NDArray[np.int64]:
        """What kind of interval each of these accepted steps is, for the solution between them."""
        if leaps:
            return np.full(len(steps), intervals.JUMP)
        if across:
            return np.full(len(steps), intervals.ACROSS)
        if self.plan.apart:
            return np.full(len(steps), intervals.APART)
        explicit = intervals.ACROSS if self.substituted else intervals.ACCELERATIONS
        return np.where(steps[:, self.a.JACOBIANS] > 0.0, intervals.VELOCITIES, explicit)

    def _give_way(self) -> None:
        """Go on with the plan that takes over where values of this one are not finite."""
        assert self.plan.substitute is not None
        self.plan = self.plan.substitute.fresh()
        self.kit = kit_with(self.system, self.functions.flags, self.plan)
        self.functions = self.kit.functions
        self.memory = self.plan.memory.copy()
        self.substituted = True
        self._control_by(self.plan)
        self._limit_steps()
        self.clock[self.a.FAILURE_CODE] = common.DONE
        self.clock[self.a.H_NEXT] = self.clock[self.a.H_FAILED]
        self.clock[: self.a.N_PAST] = 0.0

    def _bridge(self) -> tuple[Plan, Array]:
        """The plan and the controls for steps across a singular position, see kernels/steps/bridge.py."""
        from twoloop.kernels.steps import bridge
        from twoloop.methods.dop853 import DOP853

        a, clock = self.a, self.clock
        self.crossings.append([(float(clock[a.T]), self.state.copy())])
        plan = DOP853().plan(self.system.n_q, self.rtol, float(self.tolerances[common.ATOL :].min()), False)
        control = self.control.copy()
        control[: a.N_RULE] = replace(plan, least_error=0.0).rule
        control[a.SYMMETRIC], control[a.BRIDGE], control[a.MAX_ATTEMPTS] = 0.0, 0.0, 1.0
        control[a.GIVES_WAY] = 0.0
        if control[a.FIXED_STEP] == 0.0:
            control[a.MAX_STEP] = min(self.max_step, self.gap)
        clock[a.H_LIMIT], clock[a.LIMIT_AGE] = np.inf, 0.0
        self.lengths = [float(clock[a.H_LONG]) * part for part in BRIDGES]
        clock[a.H_NEXT] = self.lengths.pop(0)
        return replace(plan, step=bridge.BRIDGING), control

    def _beyond(self, plan: Plan, control: Array, code: int, accepted: int) -> tuple[Plan, Array, int]:
        """What goes on after an attempt at a step across: the same, or the run's own steps again."""
        a = self.a
        if code == a.PAUSED and accepted == 0 and self.lengths:
            self.clock[a.H_NEXT], self.clock[a.H_LIMIT] = self.lengths.pop(0), np.inf
            return plan, control, code
        if code == a.PAUSED and accepted > 0 and (self.work.notes[common.PIVOT] < CLEAR * self.clock[a.LARGEST_PIVOT]):
            self.lengths = [float(self.clock[a.H_LONG]) * part for part in BRIDGES]
            return plan, control, code
        if code not in (a.PAUSED, a.STEP_TOO_SMALL, a.FIXED_STEP_FAILED, a.RANK_LOST):
            return plan, control, code
        if accepted == 0:  # there is no way across: the run's own steps go on as far as they can
            self.control[a.BRIDGE] = 0.0
        self.crossings[-1].append((float(self.clock[a.T]), self.state.copy()))
        self.plan.memory[:] = self.memory
        self.clock[: a.N_PAST] = 0.0
        return self.plan, self.control, a.PAUSED

    def leap(self, t1: float) -> bool:
        """Make ready the step over a jump of C_t or b, after which the method begins anew; whether there is one."""
        a, clock, n = self.a, self.clock, self.system.n_q
        end = float(clock[a.JUMP_TO])
        beyond = beyond_jump(self.system, end, self.state[:n], self.state[n : 2 * n])
        if beyond is None:
            return False
        self.new_state[: 2 * n] = beyond
        self.work.notes[common.KINK_BEFORE], self.work.notes[common.KINK_AFTER] = end, np.inf
        if a.start(self.kit, self.work, end, self.new_state) != common.DONE:
            return False
        self.jumps.append(end)
        self.plan.memory[:] = self.memory
        clock[a.LEAPS] = 1.0
        clock[a.H_LIMIT], clock[a.LIMIT_AGE] = self.plan.limit_start, 0.0
        if end < t1:
            clock[a.H_NEXT] = min(clock[a.H_NEXT], self._first_step(t1 - end, self.new_state))
        return True

    def _attempts(self) -> int:
        """How many steps were tried so far."""
        c = self.work.counters
        return int(c[common.N_ACCEPTED] + c[common.N_REJECTED_ERROR] + c[common.N_REJECTED_CONVERGENCE])

    def _statistics(self, cpu: float) -> Statistics:
        c = self.work.counters.tolist()
        return Statistics(
            n_accepted=c[common.N_ACCEPTED],
            n_rejected_error=c[common.N_REJECTED_ERROR],
            n_rejected_convergence=c[common.N_REJECTED_CONVERGENCE],
            n_outer=c[common.N_OUTER],
            n_inner=c[common.N_INNER],
            n_evaluations=c[common.N_EVALUATIONS],
            n_partitions=c[common.N_PARTITIONS],
            n_factorizations=c[common.N_FACTORIZATIONS],
            n_jacobians=c[common.N_JACOBIANS],
            cpu_time=cpu,
        )

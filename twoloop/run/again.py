"""A run from another start by what an equal run before it left: its arrays, its checks, its plan.

It is the run that `Course` would make, without what is needed only where something happens on the way. Where something
does, or a start is not beyond doubt, nothing comes of it, and the call goes the long way from its beginning.
"""

import time
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.exact_derivatives import farthest
from twoloop.generate.straight_code import OwnCode
from twoloop.generate.traced_values import Sample
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import flags, intervals, noted
from twoloop.kernels.layout import short_loops
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.asked import Asked
from twoloop.run.beginning import Beginning
from twoloop.run.between import Between, interpolator_of
from twoloop.run.comparison import compared_at, territory_of
from twoloop.run.course import BUFFER_STEPS
from twoloop.run.crossings import TURNED, Place
from twoloop.run.dense import Table
from twoloop.run.dense_solution import DenseSolution
from twoloop.run.fields import kinds_of, of_states, told_later
from twoloop.run.messages import message_of, outcome, said_of_reached, unless_turned
from twoloop.run.movable import Kin, Movable
from twoloop.run.pace import INTERRUPTED, STAGNATED, Pace
from twoloop.run.passage import beyond, bridge, bridging_kit, give_way, load
from twoloop.run.record import DEFAULTS, Status
from twoloop.run.run import Run
from twoloop.run.short_changes import may_be_missed
from twoloop.run.stability import Looks, said_of_stiffness

Array = NDArray[np.float64]

MOST_WAITING, LARGEST = 4, 500_000  # those of a kind that wait for a call, one a thread; numbers of the states of each
IN_VAIN = 16  # runs that are not tried after one that did not come to its end ...
TOO_LONG = 1024  # ... and after one for which there was no room, or which took longer than that:
LONGEST = 0.1  # s of CPU time, in which Ctrl-C is not heard, nor is the time looked at
NEARER = 0.1  # of the smallest pivot at the start of the first run: below it, a start is looked at anew
NO_PACE = Pace(0.0)  # of a run that came to its end at once


class Output(NamedTuple):
    """What is wanted of a run: the states at times, which may be its ends alone, and whether there is to be `sol`."""

    times: Array | None
    at_ends: bool
    dense: bool

    @property
    def between(self) -> Array | None:
        """Times between its steps."""
        return None if self.at_ends else self.times


class Again:
    """The arrays of a run that starts again and again.

    Parameters
    ----------
    run : Run
        A copy at its start, which this one keeps.
    system : ConstrainedSystem
        The one of the call: the run's own may be another, that stands for it.
    code : OwnCode or None
        The machine code that its plan calls.
    definite : bool
        Whether M has an inverse at its start.
    check_derivatives : bool
        As it was asked for.
    kin : Kin or None
        What it shares with runs of systems of other parameters, which it may then be made for.
    """

    def __init__(
        self,
        run: Run,
        system: ConstrainedSystem,
        code: OwnCode | None,
        definite: bool,
        check_derivatives: bool,
        kin: Kin | None,
    ):
        self.movable = None if kin is None else Movable(kin, run)
        self.run, self.check_derivatives = run, check_derivatives
        self.least_pivot = NEARER * run.work.notes[noted.PIVOT]
        self.territory = territory_of(run, check_derivatives) if kin is None else kin.territory(check_derivatives)
        run.control[run.a.STORE_ALL], run.control[run.a.MAX_ATTEMPTS] = 1.0, run.chunk
        self.beginning = Beginning(run, system if self.movable is None else self.movable.system, code, definite)
        self.look, self.rest, self._advance = self.beginning.look, 0, direct(run.kernels.advance)
        self.plan, self.kit, self.flags, self.memory = run.plan, run.kit, run.kit.flags.copy(), run.memory
        room = LARGEST // len(run.state)
        self.t, self.rows = np.empty(room + 1), np.empty((room + 1, len(run.state)))
        self.steps = np.empty((room, run.a.N_STEP_COLUMNS))
        self.looks: Looks | None = None  # of a run of several chunks
        self.loading = 0.0  # CPU time of a step that a run came to, s
        self.kinds, self.between = np.empty(room, dtype=np.int64), Between(run)
        loops = short_loops()
        self._go, self._tell, self.going = direct(loops.go), direct(loops.tell), self._going(loops)
        self.dependent: dict[bytes, tuple[NDArray[np.int64], str]] = {}  # by the rows that count
        self.call: tuple[int, float, float, bytes, bytes] | None = None  # the last one
        # arrays with copies made at its start, where the one before was equal
        self.saved: list[tuple[NDArray[Any], NDArray[Any]]] = []

    def _going(self, loops: Any) -> SimpleNamespace:
        """The arrays that `go` of kernels/short_loops.py reads and writes."""
        run = self.run
        going = SimpleNamespace(
            **{"options": run.plan.options, "memory": run.plan.memory, "tolerances": run.tolerances},
            **{"control": run.control, "clock": run.clock, "state": run.state, "new_state": run.new_state},
            **{"end": np.zeros(1), "t": self.t, "told": np.zeros(loops.N_TOLD), "rows": self.rows, "steps": self.steps},
            **{"filled": np.zeros(2, dtype=np.int64), "advance": run.kernels.advance},
        )
        going.table = loops.GOING.table(going)
        going.address = going.table.ctypes.data
        return going

    @staticmethod
    def suits(run: Run) -> bool:
        """Whether a run may be made in this way: its first chunk at least, in the dense form."""
        fits = run.chunk * len(run.state) <= LARGEST
        return run.static is None and fits and not run.said_of_start and not run.system.called_in_python

    @staticmethod
    def interpolates(run: Run) -> bool:
        """Whether states between its steps may be had in this way: with arrays that serve from start to start."""
        lands = run.plan.lands or run.control[run.a.FIXED_STEP] > 0.0
        return not lands and run.kit.flags[flags.FORM] != flags.AUGMENTED

    def record(
        self,
        system: ConstrainedSystem,
        t0: float,
        t1: float,
        q0: Array,
        v0: Array,
        asked: Asked,
        output: Output,
    ) -> dict[str, Any] | None:
        """The fields of the record of a run of a system; None: make it the long way."""
        between = output.between
        run, movable, a, territory = self.run, self.movable, self.run.a, self.territory
        if self.rest > 0:
            self.rest -= 1
            return None
        if movable is None:
            if territory.is_due() or (self.check_derivatives and not system.checked):
                return None
        else:
            movable.take(system)
            self.look.system = movable.system
        if not self._is_ready(system, t0, t1, q0, v0, asked):
            return None
        began = time.process_time()
        code = self._steps_to(t1, between is not None or output.dense, began + LONGEST)
        n_states, n_steps, turned, within, nearly, pivot, checked, defect, gap = self.going.told.tolist()
        n_states, n_steps = int(n_states), int(n_steps)
        if between is not None and code == a.ALL_OUTPUT_DONE:
            parts = self.t[:n_states], self.rows[:n_states], self.kinds[:n_steps]
            self.between.find(between, *parts, self.look.pattern)
        spent = time.process_time() - began - self.loading
        t, rows = self.t[:n_states], self.rows[:n_states]
        turns = turned and output.times is None and (nearly == 1.0 or not run.plan.watchful)
        special = turns or run.crossings or pivot < run.near
        missed = may_be_missed(run)
        if code != a.ALL_OUTPUT_DONE or missed or (special and not self._is_to_be_trusted(t, rows, t1, output, turns)):
            self.rest = max(self.rest, IN_VAIN)
            return None
        if run.compared_to[0] < t1 or territory.is_due():
            if not (within and movable is None) and not self._compared(t, rows, bool(within)):
                return None
            run.compared_to[0] = t1
        told = told_later(self.steps[:n_steps], run.work.counters, spent)
        sol = None
        if output.dense:
            table = Table(t.copy(), rows[:, : 3 * system.n_q].copy(), self.kinds[:n_steps].copy())
            sol = DenseSolution(interpolator_of(run, table.states[0]), table, t1)
        if output.times is not None:
            if between is None:
                at_times: Array | None = rows[[0 if time == t0 else -1 for time in output.times.tolist()]]
            else:
                at_times = self.between.completed(between)
            if at_times is None:
                return None
            t, rows = output.times.copy(), at_times
        else:
            t, rows = t.copy(), rows.copy()
        # after all that may send it the long way: it may warn, and takes the workspace
        words = outcome(run, code, t1, NO_PACE)[1] if special else said_of_reached(run)
        if self.looks is not None:
            words += said_of_stiffness(self.looks, run.kit, run.work)
        message = message_of(run, words, run.system if movable is None else system)
        territory.count()  # a run that goes the long way is counted there
        return {
            **DEFAULTS,
            **of_states(system.n_q, t, rows),
            **told,
            "rank": run.rank,
            "redundant": run.redundant.copy(),
            "defect": defect if checked else None,
            "widest_gap": gap,
            "status": Status.REACHED_END,
            "message": message,
            "compiled": bool(self.plan.own),
            "sol": sol,
        }

    def _steps_to(self, t1: float, with_kinds: bool, until: float) -> int:
        """How the steps end; what is told of them stands in `going`."""
        run, going, a = self.run, self.going, self.run.a
        self.looks, self.loading = None, 0.0
        try:
            code: int = self._go(run.kit, run.work, going, t1, TURNED, self.territory.known)
            n_rows, n_steps = going.filled.tolist()
            if with_kinds:
                self.kinds[:n_steps] = kinds_of(run, self.steps[:n_steps])
            if code in (a.HAS_TO_GIVE_WAY, a.HAS_TO_LOAD, a.NEAR_SINGULAR, a.PAUSED):
                code, n_rows, n_steps = self._steps_beyond(code, n_rows, n_steps, t1, until)
                self._tell(run.work, going, n_rows, n_steps, TURNED, self.territory.known)
        except Exception:  # of a callback; the long way knows what to do
            return INTERRUPTED
        return code

    def _steps_beyond(self, code: int, n_rows: int, n_steps: int, t1: float, until: float) -> tuple[int, int, int]:
        """How they end, with how many states, beside the first, and steps, where the first chunk did not reach it."""
        run, going, a = self.run, self.going, self.run.a
        self.looks = looks = Looks(run.plan)
        plan, control, kit = run.plan, run.control, run.kit  # at the moment: not always the run's own
        pace, taken, across = Pace(run.t0), n_steps, False
        between_looks = next_look = run.chunk  # the states that are looked at are those of `Course`
        while True:
            h = self.steps[n_steps - taken : n_steps, a.H]
            looks.pass_by(h)
            pace.pass_by(h)
            if code == a.ALL_OUTPUT_DONE:
                return code, n_rows, n_steps
            if code == a.PAUSED and run.attempts() >= next_look:
                between_looks = min(2 * between_looks, BUFFER_STEPS)
                next_look = run.attempts() + between_looks
                if not across:
                    looks.take(float(run.clock[a.T]), run.state, run.system.n_q)
                if time.process_time() > until:
                    self.rest = TOO_LONG
                    return code, n_rows, n_steps
                if pace.stagnates(run.clock[a.T], t1):
                    return STAGNATED, n_rows, n_steps
            if code == a.HAS_TO_GIVE_WAY:
                give_way(run)
                plan, control, kit = run.plan, run.control, run.kit
            elif code == a.HAS_TO_LOAD:
                began = time.process_time()
                load(run)
                self.loading = time.process_time() - began
                until += self.loading
                kit = run.kit
                if run.substituted or kit.flags[flags.FORM] != self.flags[flags.FORM]:
                    run.substituted = True  # this kit is not for a start
                else:
                    self.kit = kit
            elif code == a.NEAR_SINGULAR:
                plan, control = bridge(run)
                kit = bridging_kit(run.kit)
            elif across:
                plan, control, code = beyond(run, plan, control, code, taken)
                kit = kit if plan is not run.plan else run.kit
                if code != a.PAUSED:
                    return code, n_rows, n_steps
            elif code != a.PAUSED:
                return code, n_rows, n_steps
            if n_steps == len(self.steps):
                self.rest = TOO_LONG
                return a.PAUSED, n_rows, n_steps
            run.control[a.MAX_ATTEMPTS] = max(0, next_look - run.attempts())
            arrays = plan.options, plan.memory, run.tolerances, control, run.clock, run.state, run.new_state
            room = self.t[n_rows + 1 :], self.rows[n_rows + 1 :], self.steps[n_steps:]
            code = self._advance(kit, run.work, *arrays, going.end, *room, going.filled)
            more, taken = going.filled.tolist()
            n_rows, n_steps, across = n_rows + more, n_steps + taken, plan is not run.plan
            made = slice(n_steps - taken, n_steps)
            self.kinds[made] = intervals.ACROSS if across else kinds_of(run, self.steps[made])

    def _is_ready(self, system: ConstrainedSystem, t0: float, t1: float, q0: Array, v0: Array, asked: Asked) -> bool:
        """Whether the run is at its start: one that is asked for again needs no second look."""
        run, call = self.run, (id(system), t0, t1, q0.tobytes(), v0.tobytes())  # of the last call the system is kept
        if run.substituted:
            run.plan, run.kit, run.functions, run.substituted = self.plan, self.kit, self.kit.functions, False
            run.memory = self.memory
        run.crossings = []
        if run.kit.flags[flags.FORM] != self.flags[flags.FORM]:
            run.kit.flags[:] = self.flags
        equal = call == self.call
        if equal and self.saved:
            for array, copy in self.saved:
                array[:] = copy
            return True
        self.call, self.saved = None, []
        if not self.beginning.at(t0, q0, v0) or run.work.notes[noted.PIVOT] < self.least_pivot:
            return False
        run.t0, run.compared_to[0] = t0, -np.inf
        if run.said_of_rows:  # rounding may decide which row is left out
            counted = run.work.rows_v.tobytes()
            if counted not in self.dependent:
                self.dependent[counted] = run.redundant_rows(self.look.rows)
            run.redundant, run.said_of_rows = self.dependent[counted]
        if self.movable is not None and not self.movable.agrees(t1, self.look.mass, self.check_derivatives):
            return False
        asked.set_sizes(run, t1)
        self.call = call
        if equal:
            self.saved = [(each, each.copy()) for each in (*self.beginning.lasting, run.state)]
        return True

    def _is_to_be_trusted(self, t: Array, rows: Array, t1: float, output: Output, turns: bool) -> bool:
        """Whether nothing speaks against a run that ended near singular positions or crossed some, as in `Course`."""
        run, landed = self.run, list[Place]()
        if (output.at_ends or run.control[run.a.FIXED_STEP] > 0.0) and run.came_near():
            landed = list(zip(t.tolist(), rows, strict=True))
        last = [(float(t[-2]), rows[-2])] if turns else []
        return unless_turned(run, last, landed, t1, Status.REACHED_END, "")[0] == Status.REACHED_END

    def _compared(self, t: Array, rows: Array, within: bool) -> bool:
        """Whether callbacks were right at states that lie where none was compared; `within`: these lie elsewhere."""
        n, territory, everywhere = 2 * self.run.system.n_q, self.territory, False
        if self.movable is not None:
            everywhere = territory.is_due() or not territory.knows(self.movable.parameters)
        if not everywhere and within:
            return True
        sample = Sample(float(t[0]), rows[0], n)
        sample.add(t[1:], rows[1:], float(t[-1]), rows[-1])
        states = sample.states()
        if not everywhere:  # a sample may lie in known places, and all runs that follow would be sampled in vain
            states = np.concatenate([farthest(t, rows[:, :n]), states])
        run, status = self.run, Status.REACHED_END
        right = compared_at(run, territory, states, self.check_derivatives, status, "", everywhere)[0] == status
        if right and self.movable is not None:
            territory.add_parameters(self.movable.parameters)
        return right

"""A run from another start by what an equal run before it left: its arrays, its checks, its plan.

It is the run that `Course` would make, without what is needed only where something happens on the way. Where something
does, or a start is not beyond doubt, nothing comes of it, and the call goes the long way from its beginning.
"""

import time
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.consistency import Look
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.derived_callbacks import farthest
from twoloop.generate.traced_values import Sample
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.control.clock import N_STEP_COLUMNS
from twoloop.kernels.data import flags, intervals, noted
from twoloop.kernels.layout import short_loops
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.asked import Asked
from twoloop.run.beginning import arrays_of
from twoloop.run.between import Between, interpolator_of
from twoloop.run.comparison import compared_at, territory_of
from twoloop.run.course import BUFFER_STEPS
from twoloop.run.crossings import Place
from twoloop.run.dense import Table
from twoloop.run.dense_solution import DenseSolution
from twoloop.run.fields import BEFORE, kinds_of, of_states, of_steps, statistics
from twoloop.run.interrupts import Interrupts
from twoloop.run.kept import OF_STEPS
from twoloop.run.messages import message_of, outcome, said_of_reached, unless_turned
from twoloop.run.movable import Kin, Movable
from twoloop.run.pace import STAGNATED, Pace
from twoloop.run.passage import beyond, bridge, bridging_kit, give_way, load
from twoloop.run.record import DEFAULTS, Status
from twoloop.run.run import Run
from twoloop.run.short_changes import may_be_missed
from twoloop.run.stability import Looks, said_of_stiffness

Array = NDArray[np.float64]

MOST_WAITING, LARGEST = 4, 500_000  # those of a kind that wait for a call, one a thread; numbers of the states of each
IN_VAIN = 16  # runs that are not tried after one that did not come to its end ...
TOO_LONG = 1024  # ... and after one for which there was no room, or which took longer than that:
LONGEST = 0.1  # s of CPU time, in which Ctrl-C is not answered, nor is the time looked at
LATER = (*OF_STEPS, "stats")  # fields that are put together apart from the others
OTHERS = {name: value for name, value in DEFAULTS.items() if name not in LATER}
SHORT = 1e-3  # s of CPU time of the last run: then it is the time that elapses, which takes less to look at
NO_PACE = Pace(0.0)  # of a run that came to its end at once
REACHED_END = Status.REACHED_END  # which an enumeration takes longer to find


class Output(NamedTuple):
    """What is wanted of a run: the states at times, which may be its ends alone, and whether there is to be `sol`."""

    times: Array | None
    at_ends: bool
    dense: bool

    @property
    def between(self) -> Array | None:
        """Times between its steps."""
        return None if self.at_ends else self.times


STEPS = Output(None, False, False)


class Again:
    """The arrays of a run that starts again and again.

    Parameters
    ----------
    run : Run
        A copy at its start, which this one keeps.
    system : ConstrainedSystem
        The one of the call: the run's own may be another, that stands for it.
    code : GeneratedCode or None
        The machine code that its plan calls.
    definite : bool
        Whether M has an inverse at its start.
    asked : Asked
        The options of the call.
    kin : Kin or None
        What it shares with runs of systems of other parameters, which it may then be made for.
    """

    def __init__(
        self,
        run: Run,
        system: ConstrainedSystem,
        code: GeneratedCode | None,
        definite: bool,
        asked: Asked,
        kin: Kin | None,
    ):
        self.movable = None if kin is None else Movable(kin, run)
        self.run, self.check_derivatives = run, (checks := asked.check_derivatives)
        self.territory = territory_of(run, checks) if kin is None else kin.territory(checks)
        run.control[run.a.STORE_ALL], run.control[run.a.MAX_ATTEMPTS] = 1.0, run.chunk
        looked, room = system if self.movable is None else self.movable.system, LARGEST // len(run.state)
        self.look, self.loops, self.rest = Look(looked), short_loops(), 0
        self.known, self.given = arrays_of(run, self.look, code, definite, asked, room), looked.kit
        self._go, self._tell, self._advance = map(direct, (self.loops.go, self.loops.tell, run.kernels.advance))
        # in the block of all that is kept: where states begin, and what is told of one that is the only one
        self.states_from, self.width = self.known.told.size, len(run.state)
        self.one_state_from = self.states_from - self.loops.FRONT - 1
        self.plan, self.kit, self.form, self.memory = run.plan, run.kit, run.kit.flags[flags.FORM], run.memory
        self.looks: Looks | None = None  # of a run of several chunks
        self.loading, self.spent = 0.0, np.inf  # CPU time of a step that a run came to, and of the last run, s
        self.kinds, self.between = np.empty(room, dtype=np.int64), Between(run)
        self.of_run = run.rank, run.redundant, bool(run.plan.own)
        self.counted = self.known.start_rows.tobytes()  # the rows that count, to which `of_run` belongs
        self.dependent = {self.counted: (run.redundant, run.said_of_rows)}

    @staticmethod
    def suits(run: Run) -> bool:
        """Whether a run may be made in this way: its first chunk at least, in the dense form."""
        fits = run.chunk * len(run.state) <= LARGEST
        return run.static is None and fits and not run.said_of_start and not run.system.called_in_python

    @staticmethod
    def gives(run: Run, output: Output, kin: Kin | None) -> bool:
        """Whether what is wanted may be had in this way: between steps, with arrays that serve from start to start."""
        if output.dense and (output.between is not None or kin is not None):
            return False  # both have the same states within steps; what belongs to kin takes other parameters
        lands = run.plan.lands or run.control[run.a.FIXED_STEP] > 0.0
        return output.between is None or not (lands or run.kit.flags[flags.FORM] == flags.AUGMENTED)

    def fields(
        self,
        system: ConstrainedSystem,
        t0: float,
        t1: float,
        q0: Array,
        v0: Array,
        asked: Asked,
        output: Output,
        interrupts: Interrupts,
    ) -> dict[str, Any] | None:
        """The fields of the result of a run of a system; None: make it the long way.

        But for the status they are put together when they are asked for, from a copy of the arrays.
        """
        run, territory, known, loops = self.run, self.territory, self.known, self.loops
        if self.rest > 0:
            self.rest -= 1
            return None
        if self.movable is not None:
            if self.movable.take(system):
                self.look.system, known.begun[loops.HOW_OFTEN] = self.movable.system, loops.NEVER
        elif territory.is_due() or (self.check_derivatives and not system.checked):
            return None
        if self.looks is not None:
            self._forget_chunks()
        run.t0, told, at_times, words = t0, None, None, ""
        kit, work, sizes, box = run.kit.address, run.work.address, self.look.sizes(), territory.known
        arrays = kit, self.given.address, work, known.address, t0, t1, q0, v0, sizes, box
        clock = time.perf_counter if self.spent < SHORT else time.process_time
        began = clock()
        try:
            n = self._go(*arrays, False)
            others = run.said_of_rows != "" and known.start_rows.tobytes() != self.counted
            if n < 0 or others or output is not STEPS or self.movable is not None:
                interrupts.listen()
                if n == loops.IN_DOUBT and self.look.is_surely(0, t0, q0, v0):
                    n = self._go(*arrays, True)
                if n in (loops.IN_DOUBT, loops.REFUSED):
                    return None
                told = self._go_on(t1, output)
        except Exception:  # of a callback; the long way knows what to do
            self.rest, known.begun[loops.HOW_OFTEN] = IN_VAIN, loops.NEVER
            return None
        self.spent = spent = clock() - began - self.loading
        fields: dict[str, Any] = {"status": REACHED_END}
        n_rows = n
        if told is not None:
            n_rows, n = known.filled.tolist()
            found = self._looked_at(told, t1, q0, v0, output, fields)
            if found is None:
                known.begun[loops.HOW_OFTEN] = loops.NEVER
                return None
            at_times, words = found
        begin, end = self.one_state_from - n_rows - n * N_STEP_COLUMNS, self.states_from
        data = known.block[begin : end if at_times is not None else end + (1 + n_rows) * self.width].copy()
        fields["later"] = later = partial(_field, data, at_times, self.of_run, spent, system, t1, asked)
        if words:
            fields |= message_of(run, words, run.system if self.movable is None else system, later)
        territory.count()  # a run that goes the long way is counted there
        return fields

    def _go_on(self, t1: float, output: Output) -> list[float]:
        """Take the steps beyond the first chunk, and find states between steps; what is told of the run."""
        run, known, loops, done = self.run, self.known, self.loops, self.run.a.ALL_OUTPUT_DONE
        told = self._told()
        if told[loops.IS_NEW]:
            run.compared_to[0] = -np.inf
        if told[loops.CODE] != done:
            self._steps_beyond(int(told[loops.CODE]), t1)
            told = [*self._told()[: loops.IS_NEW], told[loops.IS_NEW]]
        elif output is not STEPS:
            self.kinds[: known.filled[1]] = kinds_of(run, known.steps[: known.filled[1]])
        if output.between is not None and told[loops.CODE] == done:
            n_rows, n_steps = known.filled.tolist()
            t, rows = known.t[: 1 + n_rows], known.states[: 1 + n_rows]
            self.between.find(output.between, t, rows, self.kinds[:n_steps], self.look.pattern)
        return told

    def _told(self) -> list[float]:
        n_rows, n_steps = self.known.filled.tolist()
        begin = self.one_state_from - n_rows - n_steps * N_STEP_COLUMNS
        told: list[float] = self.known.told[begin : begin + self.loops.N_TOLD].tolist()
        return told

    def _looked_at(
        self, told: list[float], t1: float, q0: Array, v0: Array, output: Output, fields: dict[str, Any]
    ) -> tuple[tuple[Array, Array] | None, str] | None:
        """Output times and rows there, None: all steps, and the words of a message; None where it is not to be trusted.

        `fields` gets `sol`.
        """
        run, known, loops, movable = self.run, self.known, self.loops, self.movable
        n_rows, n_steps = known.filled.tolist()
        t, rows, code = known.t[: 1 + n_rows], known.states[: 1 + n_rows], int(told[loops.CODE])
        plain, inside = told[loops.PLAIN] and self.looks is None, bool(told[loops.INSIDE])
        trusted = plain or self._is_to_be_trusted(t, rows, t1, output, told[loops.TURNED])
        if code != run.a.ALL_OUTPUT_DONE or not trusted:
            self.rest = max(self.rest, IN_VAIN)
            return None
        if told[loops.IS_NEW] and not self._agrees(t1, q0, v0):
            return None
        if not inside or movable is not None:
            if (run.compared_to[0] < t1 or self.territory.is_due()) and not self._compared(t, rows, inside):
                return None
            run.compared_to[0] = t1
        if output.dense:
            table = Table(t.copy(), rows[:, : 3 * run.system.n_q].copy(), self.kinds[:n_steps].copy())
            fields["sol"] = DenseSolution(interpolator_of(run, table.states[0]), table, t1)
        at_times, words = None, ""
        if output.times is not None:
            ends = [0 if time == run.t0 else -1 for time in output.times.tolist()]
            found = rows[ends] if output.at_ends else self.between.completed(output.times)
            if found is None:
                return None
            at_times = output.times.copy(), found
        if not plain:  # after all that may send it the long way: it may warn, and takes the workspace
            words = outcome(run, code, t1, NO_PACE)[1]
            if self.looks is not None:
                words += said_of_stiffness(self.looks, run.kit, run.work)
        return at_times, words

    def _agrees(self, t1: float, q0: Array, v0: Array) -> bool:
        """Whether a system of other parameters is as it should be at a new start, where other rows may be redundant."""
        run = self.run
        if run.said_of_rows:  # rounding may decide which row is left out
            counted = self.known.start_rows.tobytes()
            if counted not in self.dependent:
                there = run.at(run.t0, q0, v0)
                if there is None:
                    return False
                self.dependent[counted] = there.redundant, there.said_of_rows
            redundant, run.said_of_rows = self.dependent[counted]
            self.of_run, self.counted = (run.rank, redundant, bool(self.plan.own)), counted
        return self.movable is None or self.movable.agrees(run.t0, q0, v0, t1, self.look.mass, self.check_derivatives)

    def _forget_chunks(self) -> None:
        """Put back what a run of several chunks may have changed, beside arrays."""
        run, self.looks, self.loading = self.run, None, 0.0
        run.crossings = []
        if run.substituted:
            run.plan, run.kit, run.functions, run.substituted = self.plan, self.kit, self.kit.functions, False
            run.memory = self.memory

    def _steps_beyond(self, code: int, t1: float) -> None:
        """Take the steps after the first chunk, which ended so, and tell of all."""
        run, known, a = self.run, self.known, self.run.a
        self.looks = looks = Looks(run.plan)
        plan, control, kit = run.plan, run.control, run.kit  # at the moment: not always the run's own
        n_rows, n_steps = known.filled.tolist()
        pace, taken, across, until = Pace(run.t0), n_steps, False, time.process_time() + LONGEST
        between_looks = next_look = run.chunk  # the states that are looked at are those of `Course`
        while True:
            made = slice(n_steps - taken, n_steps)
            self.kinds[made] = intervals.ACROSS if across else kinds_of(run, known.steps[made])
            looks.pass_by(known.steps[made, a.H])
            pace.pass_by(known.steps[made, a.H])
            if code == a.ALL_OUTPUT_DONE:
                break
            if code == a.PAUSED and run.attempts() >= next_look:
                between_looks = min(2 * between_looks, BUFFER_STEPS)
                next_look = run.attempts() + between_looks
                if not across:
                    looks.take(float(run.clock[a.T]), run.state, run.system.n_q)
                if time.process_time() > until:
                    self.rest = TOO_LONG
                    break
                if pace.stagnates(run.clock[a.T], t1):
                    code = STAGNATED
                    break
            if code == a.HAS_TO_GIVE_WAY:
                give_way(run)
                plan, control, kit = run.plan, run.control, run.kit
            elif code == a.HAS_TO_LOAD:
                began = time.process_time()
                load(run)
                self.loading = time.process_time() - began
                until += self.loading
                kit = run.kit
                if run.substituted or kit.flags[flags.FORM] != self.form:
                    run.substituted = True  # this kit is not for a start
                else:
                    self.kit = kit
            elif code == a.NEAR_SINGULAR:
                plan, control = bridge(run)
                kit = bridging_kit(run.kit)
            elif across:
                plan, control, code = beyond(run, plan, control, code, taken)
                kit = kit if plan is not run.plan else run.kit
            if code not in (a.HAS_TO_GIVE_WAY, a.HAS_TO_LOAD, a.NEAR_SINGULAR, a.PAUSED):
                break
            if n_steps == len(known.steps):
                self.rest, code = TOO_LONG, a.PAUSED
                break
            run.control[a.MAX_ATTEMPTS] = max(0, next_look - run.attempts())
            arrays = plan.options, plan.memory, run.tolerances, control, run.clock, run.state, run.new_state
            room = known.t[n_rows + 1 :], known.states[n_rows + 1 :], known.steps[n_steps:]
            code = self._advance(kit, run.work, *arrays, known.end, *room, known.filled)
            more, taken = known.filled.tolist()
            n_rows, n_steps, across = n_rows + more, n_steps + taken, plan is not run.plan
        self._tell(run.work, known, self.territory.known, n_rows, n_steps, code)

    def _is_to_be_trusted(self, t: Array, rows: Array, t1: float, output: Output, turned: float) -> bool:
        """Whether nothing speaks against a run that ended near singular positions or crossed some, as in `Course`."""
        run, landed = self.run, list[Place]()
        if may_be_missed(run):
            return False
        near = run.work.notes[noted.NEARLY_SINGULAR] == 1.0 or not run.plan.watchful
        last = [(float(t[-2]), rows[-2])] if turned and near and output.times is None else []
        if (output.at_ends or run.control[run.a.FIXED_STEP] > 0.0) and run.came_near():
            landed = list(zip(t.tolist(), rows, strict=True))
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


def _field(
    data: Array,
    at_times: tuple[Array, Array] | None,
    of_run: tuple[int, NDArray[np.int64], bool],
    spent: float,
    system: ConstrainedSystem,
    t1: float,
    asked: Asked,
    name: str,
) -> dict[str, Any]:
    """A field of a result, with those that are put together with it; `data` is what `go` tells."""
    if name == "message":
        return {name: said_of_reached(t1, asked.step_size is not None)}
    loops, n_states, n_steps = short_loops(), int(data[0]), int(data[1])
    begin, end = (places := loops.FRONT + n_states), places + n_steps * N_STEP_COLUMNS
    if name in LATER:
        counted = data[loops.N_TOLD : loops.FRONT].astype(np.int64)
        of_all = of_steps(data[begin:end].reshape(n_steps, N_STEP_COLUMNS), BEFORE.copy())
        return of_all | {"stats": statistics(counted, spent)} | asked.told
    rank, redundant, own = of_run
    defect = float(data[loops.DEFECT]) if data[loops.CHECKED] else None
    told = {"rank": rank, "redundant": redundant.copy(), "defect": defect, "compiled": own}
    told |= {"widest_gap": float(data[loops.WIDEST]), "system": system, "atol": asked.atol.copy()}
    t, rows = (data[loops.FRONT : begin], data[end:].reshape(n_states, -1)) if at_times is None else at_times
    return OTHERS | of_states(system.n_q, t, rows) | told | asked.told

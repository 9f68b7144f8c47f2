"""Code for many runs of one mechanism at once: every number is a vector, with one run in each of its lanes.

The operations are those of `series`, `elimination` and `compile_equations`. Coefficients are read, a vector each, so
that runs may have parameters of their own.
"""

import hashlib
import math
from typing import Any

from twoloop.generate.choices import Choice
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.compile_equations import write_accelerations
from twoloop.generate.elimination import Elimination, Solution
from twoloop.generate.graph import Untraceable, is_zero
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.lane_series import LaneSeries
from twoloop.generate.lane_stages import LaneStages, Tableau
from twoloop.generate.lane_steps import LaneSteps, Places, common, is_set, keep_fine, store_mask
from twoloop.generate.lane_turns import turned
from twoloop.generate.llvm_text import Value, integer
from twoloop.generate.lowering import lower
from twoloop.generate.program import Program
from twoloop.generate.series import series_program
from twoloop.generate.trace import Equations
from twoloop.kernels.lanes import lane_projection
from twoloop.kernels.lanes import lane_room as lanes
from twoloop.problem.system import ConstrainedSystem

GOLDEN = 0.6180339887498949
MOST_PARTS = 1000.0  # of a step, between places that are looked at
LARGEST = 1500  # operations of a series, which take some seconds to compile


class LaneCode(LaneSteps):
    """Writes the code of a mechanism, step control included, whose numbers depend on parameters as `record` has it.

    Parameters
    ----------
    system : ConstrainedSystem
    choice : Choice
    parameters : array of Parameter
    series : bool
        Whether there is to be code for its Taylor series, too.
    tableau : Tableau, optional
        Of an explicit method, whose stages there is to be code for.

    Raises
    ------
    Untraceable
        Saying why the equations, or their series, cannot be had.
    """

    def __init__(
        self, system: ConstrainedSystem, choice: Choice, parameters: Any, series: bool, tableau: Tableau | None = None
    ):
        if system.n_a > 0:
            raise Untraceable("it has nonholonomic rows")
        self.numbers = Coefficients(apart=True)
        self.equations = equations = Elimination(system, choice, Equations(system, parameters))
        self.solution = Solution(self.equations)
        super().__init__(system.n_q, system.n_c + system.n_a)
        self.recurrences: LaneSeries | None = None
        self.explicit = None if tableau is None else LaneStages(tableau, self.n)
        if series:
            program = series_program(system, Equations(system, parameters), {*choice.rows, *choice.added})
            if program.n_operations > LARGEST:
                raise Untraceable(f"its series takes more than {LARGEST} operations")
            self.recurrences = LaneSeries(program, self.solution, self.numbers, self.n, self.n_rows)
        rows = self.equations.rows
        self._entries = [(k, j) for k, row in enumerate(rows) for j in range(self.n) if not is_zero(row[j])]
        self._rows_at = Program(equations.graph, {"G": [rows[k, j] for k, j in self._entries]})
        self.structure = self._structure()
        self.n_numbers = self.numbers.n_varying
        parts = [*equations.accelerations, equations.closer, equations.nearest, equations.redundant]
        parts += [self.solution.kept] if series else []
        counts = [len(each.quantities()) for each in parts]
        counts += [len(self.solution.solved.quantities())] if series else []
        self.n_quantities = sum(counts)

    @property
    def tasks(self) -> tuple[str, ...]:
        """What there is code for."""
        if self.recurrences is not None:
            return *lanes.TASKS, *lanes.TASKS_OF_SERIES
        explicit = () if self.explicit is None else lanes.TASKS_OF_EXPLICIT
        return *lanes.TASKS, *lanes.TASKS_OF_STAGES, *explicit

    def series_size(self, order: int) -> int:
        """Length of the memory that a series of an order takes and works in, in vectors."""
        assert self.recurrences is not None
        return (order + 1) * self.n + self.recurrences.scratch_size(order)

    def _structure(self) -> str:
        equations, numbers = self.equations, self.numbers
        told: list[Any] = [] if self.explicit is None else [*self.explicit.structure]
        parts = [*equations.accelerations, equations.closer, equations.nearest, equations.redundant]
        if self.recurrences is not None:
            told += list(self.recurrences.structure)
            parts.append(self.solution.kept)
        else:
            parts.append(self._rows_at)  # whose numbers have to be known where the code comes from the disk
        for outputs in parts:
            told += [outputs.sizes, *numbers.structure(outputs)]
        if self.recurrences is not None:
            told += list(numbers.structure(self.solution.solved))
        return hashlib.sha256(repr(told).encode()).hexdigest()

    # what is emitted

    def series(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Coefficients of q up to an order, in units of time, about the state of each lane."""
        builder, n, at = emit.builder, self.n, self.places(emit, order, control, room)
        unit, out, scratch = self.unit(emit, control, room), at.series, at.scratch
        inputs = [emit.load(room, lanes.T), *(emit.load(at.state, i) for i in range(2 * n))]
        written, (kept,) = lower(emit, self.solution.kept, inputs, self.numbers)
        holds = written.holds(self.solution.kept, kept)
        for i, value in enumerate(kept):
            emit.store(value, scratch, i)
        for j in range(n):
            emit.store(inputs[1 + j], out, j)
            emit.store(emit.multiply(unit, inputs[1 + n + j]), out, n + j)
        assert self.recurrences is not None
        self.recurrences.begin(emit, inputs, scratch)
        with emit.loop(integer(1), order, []) as (k, _, _):
            self.recurrences.order(emit, k, unit, out, scratch)
        last, total = emit.pointer(out, builder.mul(order, integer(n))), emit.constant(0.0)
        for j in range(n):
            total = emit.add(total, emit.multiply(emit.constant(0.0), emit.load(last, j)))
        holds = builder.both(holds, builder.compare("fcmp oeq", total, emit.constant(0.0)))
        store_mask(emit, room, lanes.FINE, holds)

    def look(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """WORST, the largest defect at places within the step, none further than the gap from the next, or an end.

        AHEAD is the time of the place, and then of the end.
        SHIFT, multiples of the golden section less their integers, moves the places as far as the gap allows.
        """
        builder, at = emit.builder, self.places(emit, order, control, room)
        h, gap = emit.load(room, lanes.H), common(emit, control, lanes.GAP)
        zero, one, two = (emit.constant(x) for x in (0.0, 1.0, 2.0))
        parts = emit.function("ceil", emit.divide(h, gap))
        parts = emit.larger(emit.smaller(parts, emit.constant(MOST_PARTS)), one)
        part = emit.divide(h, parts)
        shift = emit.add(emit.load(room, lanes.SHIFT), emit.constant(GOLDEN))
        shift = emit.subtract(shift, builder.select(builder.compare("fcmp oge", shift, one), one, zero))
        emit.store(shift, room, lanes.SHIFT)
        moved = emit.multiply(
            emit.subtract(emit.multiply(two, shift), one), emit.larger(emit.subtract(gap, part), zero)
        )
        with emit.loop(integer(1), emit.largest_whole(parts), [zero]) as (place, (worst,), new):
            number = emit.number(place)
            looks = builder.compare("fcmp olt", number, parts)
            x = builder.select(looks, emit.add(emit.multiply(number, part), moved), zero)
            emit.store(emit.add(emit.load(room, lanes.T), x), room, lanes.AHEAD)
            self.positions(emit, at, emit.divide(x, emit.load(room, lanes.UNIT)))
            holds, a = self._there(emit, room, at)
            defect = builder.select(holds, self.defect_of(emit, control, at, a), emit.constant(math.inf))
            new.append(emit.largest_of(builder.select(looks, defect, zero), worst))
        emit.store(new[0], room, lanes.WORST)
        t, t1 = emit.load(room, lanes.T), common(emit, control, lanes.T1)
        last = builder.compare("fcmp oeq", h, emit.subtract(t1, t))
        emit.store(builder.select(last, t1, emit.add(t, h)), room, lanes.AHEAD)

    def closer(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Move positions of lanes that FINE names towards the constraints."""
        act, _ = self._project(emit, self.equations.closer, lanes.FINE, self.places(emit, order, control, room))
        for field in (lanes.FINE, lanes.LEFT_TO_MOVE):
            store_mask(emit, room, field, act)
        emit.store(emit.constant(math.inf), room, lanes.MOVED_BEFORE)

    def nearer(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The same and velocities, and accelerations and multipliers there, until a move is no more than rounding."""
        builder, at = emit.builder, self.places(emit, order, control, room)
        fine, left = (is_set(emit, room, field) for field in (lanes.FINE, lanes.LEFT_TO_MOVE))
        act, moved = self._project(emit, self.equations.nearest, lanes.LEFT_TO_MOVE, at)
        largest = emit.constant(0.0)
        for j in range(self.n):
            largest = emit.larger(emit.function("fabs", emit.load(at.new, j)), largest)
        least = emit.multiply(emit.constant(lane_projection.OF_POSITIONS), largest)
        least = emit.larger(least, emit.constant(lane_projection.LARGEST_MOVE))
        there = builder.both(act, builder.compare("fcmp ole", moved, least))
        before = emit.multiply(emit.constant(lane_projection.CONTRACTION), emit.load(room, lanes.MOVED_BEFORE))
        goes_on = builder.both(act, builder.compare("fcmp ole", moved, before))
        goes_on = builder.both(goes_on, builder.compare("fcmp ogt", moved, least))
        emit.store(emit.larger(moved, least), room, lanes.MOVED_BEFORE)
        store_mask(emit, room, lanes.LEFT_TO_MOVE, goes_on)
        waited = builder.operation("xor", fine, builder.both(fine, left))
        store_mask(emit, room, lanes.FINE, builder.operation("or", waited, there))

    def _project(self, emit: LaneEmitter, outputs: Program, which: int, at: Places) -> tuple[Value, Value]:
        """Which of some lanes could be moved, and how far they were."""
        select, room = emit.builder.select, at.room
        inputs = self._new(emit, room, at)
        written, arrays = lower(emit, outputs, inputs, self.numbers)
        made = dict(zip(outputs.arrays, arrays, strict=True))
        act = emit.builder.both(is_set(emit, room, which), written.holds(outputs, arrays[0]))
        largest = emit.constant(0.0)
        for value in made["moved"]:
            largest = emit.larger(emit.function("fabs", value), largest)
        for k, value in enumerate([*made["q"], *made.get("v", [])]):
            emit.store(select(act, value, inputs[1 + k]), at.new, k)
        for base, name in ((at.a, "a"), (at.lam, "lam")):
            for k, value in enumerate(made.get(name, [])):
                emit.store(select(act, value, emit.load(base, k)), base, k)
        return act, largest

    def there(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Accelerations at a state as it stands."""
        at = self.places(emit, order, control, room)
        holds, a = self._there(emit, room, at)
        for k, value in enumerate(a):
            emit.store(value, at.a, k)
        keep_fine(emit, room, holds)

    def _there(self, emit: LaneEmitter, room: Value, at: Places) -> tuple[Value, list[Value]]:
        a, holds = write_accelerations(emit, self.equations, self._new(emit, room, at), self.numbers)
        return holds, a

    def turned(self, emit: LaneEmitter, at: Places) -> Value | None:
        """Where det G1 G0^T is not positive, see lane_turns.py; series have their defects for that."""
        if self.recurrences is not None or len(self.equations.rows) == 0:
            return None
        return turned(emit, *(self._rows(emit, at, time, base) for time, base in self._ends(at)))

    def _ends(self, at: Places) -> list[tuple[int, Value]]:
        return [(lanes.T, at.state), (lanes.AHEAD, at.new)]

    def _rows(self, emit: LaneEmitter, at: Places, time: int, base: Value) -> list[dict[int, Value]]:
        """The entries of G that are not zero, row by row, at a state."""
        inputs = [emit.load(at.room, time), *(emit.load(base, i) for i in range(2 * self.n))]
        _, (entries,) = lower(emit, self._rows_at, inputs, self.numbers)
        rows: list[dict[int, Value]] = [{} for _ in self.equations.rows]
        for (k, j), value in zip(self._entries, entries, strict=True):
            rows[k][j] = value
        return rows

    def stages(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """NEW and ERROR by the stages of a step."""
        assert self.explicit is not None
        self.explicit.write(emit, (order, control, room), self.places(emit, order, control, room))

    def redundant(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Whether the rows that do not count hold, too."""
        at, outputs = self.places(emit, order, control, room), self.equations.redundant
        written, (none,) = lower(emit, outputs, self._new(emit, room, at), self.numbers)
        keep_fine(emit, room, written.holds(outputs, none))

    def _new(self, emit: LaneEmitter, room: Value, at: Places) -> list[Value]:
        return [emit.load(room, lanes.AHEAD), *(emit.load(at.new, i) for i in range(2 * self.n))]

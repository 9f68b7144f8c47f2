"""Code for many runs of one mechanism at once: every number is a vector, with one run in each of its lanes.

The operations are those of `series`, `straight_line` and `straight_code`. Coefficients are read, a vector each, so that
runs may have parameters of their own.
"""

import hashlib
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from twoloop.generate.choices import Choice
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.lane_series import LaneSeries
from twoloop.generate.llvm_text import Value, integer
from twoloop.generate.series import series_program
from twoloop.generate.straight_line import Outputs, Solution, StraightLine
from twoloop.generate.traced_equations import Equations
from twoloop.generate.tracing import Untraceable
from twoloop.generate.written import conditions_hold, results_of
from twoloop.kernels.control.defect import ROUNDING
from twoloop.kernels.control.predictor import FLOOR, LEAST, SHARE_OF_MOTION
from twoloop.kernels.lanes import lane_projection, lane_taylor
from twoloop.kernels.lanes import lane_room as lanes
from twoloop.problem.system import ConstrainedSystem

GOLDEN = 0.6180339887498949
MOST_PARTS = 1000.0  # of a step, between places that are looked at
AT_ONCE = 3  # coordinates whose Horner schemes run side by side: of each three numbers are carried, in 16 registers
LARGEST = 1500  # operations of a series, which take some seconds to compile


class LaneCode:
    """Writes the code of a mechanism, whose numbers depend on parameters as `record` has it.

    Parameters
    ----------
    system : ConstrainedSystem
    choice : Choice
    parameters : array of Known
    series : bool
        Whether there is to be code for its Taylor series, too.

    Raises
    ------
    Untraceable
        Saying why the equations, or their series, cannot be had.
    """

    def __init__(self, system: ConstrainedSystem, choice: Choice, parameters: Any, series: bool):
        self.numbers = Coefficients(apart=True)
        self.equations = equations = StraightLine(system, choice, Equations(system, parameters))
        self.solution = Solution(self.equations)
        self.n, self.n_rows = system.n_q, system.n_c + system.n_a
        self.recurrences: LaneSeries | None = None
        if series:
            program = series_program(system, Equations(system, parameters), {*choice.rows, *choice.added})
            if program.n_operations > LARGEST:
                raise Untraceable(f"its series takes more than {LARGEST} operations")
            self.recurrences = LaneSeries(program, self.solution, self.numbers, self.n, self.n_rows)
        self.structure = self._structure()
        self.n_numbers = self.numbers.n_varying
        parts = [equations.there, equations.closer, equations.nearest, equations.redundant]
        parts += [self.solution.kept] if series else []
        counts = [len(each.quantities(equations.graph)) for each in parts]
        counts += [len(self.solution.solved.quantities(self.solution.graph))] if series else []
        self.n_quantities = sum(counts)

    @property
    def tasks(self) -> tuple[str, ...]:
        """What there is code for."""
        return *lanes.TASKS, *(lanes.TASKS_OF_STAGES if self.recurrences is None else lanes.TASKS_OF_SERIES)

    def series_size(self, order: int) -> int:
        """Length of the memory that a series of an order takes and works in, in vectors."""
        assert self.recurrences is not None
        return (order + 1) * self.n + self.recurrences.scratch_size(order)

    def _structure(self) -> str:
        equations, numbers = self.equations, self.numbers
        told: list[Any] = []
        parts = [equations.there, equations.closer, equations.nearest, equations.redundant]
        if self.recurrences is not None:
            told += list(self.recurrences.structure)
            parts.append(self.solution.kept)
        for outputs in parts:
            told += [outputs.sizes, *numbers.structure(equations.graph, outputs.forms)]
        if self.recurrences is not None:
            told += list(numbers.structure(self.solution.graph, self.solution.solved.forms))
        return hashlib.sha256(repr(told).encode()).hexdigest()

    # what is emitted

    def series(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Coefficients of q up to an order, in units of time, about the state of each lane."""
        builder, n, at = emit.builder, self.n, self._at(emit, order, control, room)
        unit, out, scratch = self._unit(emit, control, room), at.series, at.scratch
        inputs = [emit.load(room, lanes.T), *(emit.load(at.state, i) for i in range(2 * n))]
        written, (kept,) = results_of(emit, self.equations.graph, self.solution.kept, inputs, self.numbers)
        holds = conditions_hold(emit, written, self.solution.kept, kept)
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
        _store_mask(emit, room, lanes.FINE, holds)

    def _unit(self, emit: LaneEmitter, control: Value, room: Value) -> Value:
        """UNIT of new runs, and that after accepted steps."""
        select, unit = emit.builder.select, emit.load(room, lanes.UNIT)
        fresh, accepted = (_is_set(emit, room, field) for field in (lanes.FRESH, lanes.ACCEPTED))
        span = emit.subtract(_common(emit, control, lanes.T1), _common(emit, control, lanes.T0))
        following = emit.smaller(
            emit.multiply(emit.load(room, lanes.LENGTH), unit),
            emit.multiply(emit.constant(lane_taylor.GROWTH), emit.load(room, lanes.H)),
        )
        first = emit.multiply(emit.constant(lane_taylor.FIRST_UNIT), span)
        unit = select(fresh, first, select(accepted, following, unit))
        emit.store(unit, room, lanes.UNIT)
        for field, value in ((lanes.LONGEST, math.inf), (lanes.SHIFT, 0.0)):
            emit.store(select(fresh, emit.constant(value), emit.load(room, field)), room, field)
        return unit

    def lengths(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Steps by the last two terms of positions and velocities over the tolerances."""
        builder, n, at = emit.builder, self.n, self._at(emit, order, control, room)
        unit, (rtol, atol) = emit.load(room, lanes.UNIT), self._tolerances(emit, control)
        one, found = emit.constant(1.0), []
        scales = []
        for j in range(n):
            q, v = (emit.function("fabs", emit.load(at.series, i)) for i in (j, n + j))
            of_q, of_v = (
                emit.add(atol[j], emit.multiply(rtol, q)),
                emit.add(emit.multiply(atol[j], unit), emit.multiply(rtol, v)),
            )
            scales.append(emit.divide(one, emit.smaller(of_q, emit.divide(of_v, emit.number(order)))))
        for back in (0, 1):
            power = builder.sub(order, integer(back))
            row, largest = emit.pointer(at.series, builder.mul(power, integer(n))), emit.constant(0.0)
            for j, scale in enumerate(scales):
                largest = emit.larger(emit.multiply(emit.function("fabs", emit.load(row, j)), scale), largest)
            found.append(largest)
        logarithms = [
            emit.divide(emit.logarithm(value), emit.number(power))
            for value, power in zip(found, (order, builder.sub(order, integer(1))), strict=True)
        ]
        length = emit.exponential(emit.negative(emit.larger(*logarithms)))
        emit.store(length, room, lanes.LENGTH)
        t, t1 = emit.load(room, lanes.T), _common(emit, control, lanes.T1)
        left, zero = emit.subtract(t1, t), emit.constant(0.0)
        h = emit.smallest_of(emit.multiply(length, unit), emit.load(room, lanes.LONGEST))
        h = builder.select(builder.compare("fcmp oge", h, left), left, h)
        largest = emit.larger(emit.function("fabs", t), emit.function("fabs", t1))
        goes = builder.compare("fcmp ogt", h, emit.multiply(emit.constant(lanes.SHORTEST), largest))
        for field in (lanes.RUNNING, lanes.FINE):
            goes = builder.both(goes, _is_set(emit, room, field))
        h = builder.select(goes, h, zero)
        emit.store(h, room, lanes.H)
        emit.store(emit.divide(h, unit), room, lanes.X)
        for field in (lanes.RUNNING, lanes.FINE):
            _store_mask(emit, room, field, goes)

    def evaluate(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The state and its accelerations by the series, X units of time on."""
        at = self._at(emit, order, control, room)
        for j, q in enumerate(self._evaluate(emit, at, emit.load(room, lanes.X))):
            emit.store(q, at.predicted, j)

    def _evaluate(self, emit: LaneEmitter, at: "_Places", x: Value) -> list[Value]:
        """The same by Horner's scheme; the positions."""
        positions: list[Value] = []
        builder, n, order = emit.builder, self.n, at.order
        unit, zero = emit.load(at.room, lanes.UNIT), emit.constant(0.0)
        per_unit = emit.divide(emit.constant(1.0), unit)
        twice = emit.multiply(emit.constant(2.0), emit.multiply(per_unit, per_unit))
        last = emit.pointer(at.series, builder.mul(order, integer(n)))
        for begin in range(0, n, AT_ONCE):
            some = range(begin, min(begin + AT_ONCE, n))
            initial = [each for j in some for each in (emit.load(last, j), zero, zero)]
            with emit.loop(integer(0), order, initial) as (m, carried, new):
                power = builder.sub(builder.sub(order, integer(1)), m)
                row = emit.pointer(at.series, builder.mul(power, integer(n)))
                for j, (q, v, a) in zip(some, _threes(carried), strict=True):
                    a = emit.add(emit.multiply(a, x), v)  # first, so that each takes the register of the one before
                    v = emit.add(emit.multiply(v, x), q)
                    new += [emit.add(emit.multiply(q, x), emit.load(row, j)), v, a]
            for j, (q, v, a) in zip(some, _threes(new), strict=True):
                positions.append(q)
                emit.store(q, at.new, j)
                emit.store(emit.multiply(v, per_unit), at.new, n + j)
                emit.store(emit.multiply(a, twice), at.found, j)
        return positions

    def look(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """WORST, the largest defect at places within the step, none further than the gap from the next, or an end.

        AHEAD is the time of the place, and then of the end.
        SHIFT, multiples of the golden section less their integers, moves the places as far as the gap allows.
        """
        builder, at = emit.builder, self._at(emit, order, control, room)
        h, gap = emit.load(room, lanes.H), _common(emit, control, lanes.GAP)
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
            self._evaluate(emit, at, emit.divide(x, emit.load(room, lanes.UNIT)))
            holds, a = self._there(emit, room, at)
            defect = builder.select(holds, self._defect(emit, control, at, a), emit.constant(math.inf))
            new.append(emit.largest_of(builder.select(looks, defect, zero), worst))
        emit.store(new[0], room, lanes.WORST)
        t, t1 = emit.load(room, lanes.T), _common(emit, control, lanes.T1)
        last = builder.compare("fcmp oeq", h, emit.subtract(t1, t))
        emit.store(builder.select(last, t1, emit.add(t, h)), room, lanes.AHEAD)

    def defect(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The defect of a step at its end."""
        at = self._at(emit, order, control, room)
        a = [emit.load(at.a, j) for j in range(self.n)]
        emit.store(self._defect(emit, control, at, a), room, lanes.DEFECT)

    def _defect(self, emit: LaneEmitter, control: Value, at: "_Places", a: list[Value]) -> Value:
        """How far accelerations by the series are from those at NEW, over the tolerances, see control/defect.py."""
        n, (rtol, atol) = self.n, self._tolerances(emit, control)
        steps, h = emit.number(at.order), emit.load(at.room, lanes.H)
        share, per_share = emit.divide(h, steps), emit.divide(steps, h)  # infinite where h is 0: of q nothing is asked
        largest = worst = emit.constant(0.0)
        for each in a:
            largest = emit.larger(emit.function("fabs", each), largest)
        floor = emit.multiply(emit.constant(ROUNDING), largest)
        for j, each in enumerate(a):
            defect = emit.function("fabs", emit.subtract(emit.load(at.found, j), each))
            of_q, of_v = (
                emit.add(atol[j], emit.multiply(rtol, emit.function("fabs", emit.load(at.new, place))))
                for place in (j, n + j)
            )
            allowed = emit.smallest_of(of_v, emit.multiply(of_q, per_share))
            worst = emit.largest_of(emit.divide(emit.subtract(defect, floor), allowed), worst)
        return emit.multiply(share, worst)

    def departure(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """How far the prediction of a step was off, see control/predictor.py."""
        n, at, (rtol, atol) = self.n, self._at(emit, order, control, room), self._tolerances(emit, control)
        h = emit.load(room, lanes.H)

        def size(base: Value, place: int) -> Value:
            return emit.function("fabs", emit.load(base, place))

        def apart(one: Value, other: Value, place: int) -> Value:
            return emit.function("fabs", emit.subtract(emit.load(one, place), emit.load(other, place)))

        motion = off = emit.constant(0.0)
        for j in range(n):
            way = emit.larger(emit.multiply(h, size(at.state, n + j)), apart(at.new, at.state, j))
            motion = emit.larger(way, motion)
        motion = emit.multiply(emit.constant(SHARE_OF_MOTION), motion)
        for j in range(n):
            scale = emit.add(atol[j], emit.multiply(rtol, emit.larger(size(at.new, j), size(at.state, j))))
            allowed = emit.add(motion, emit.multiply(emit.constant(FLOOR), scale))
            allowed = emit.larger(emit.smaller(scale, allowed), emit.constant(LEAST))
            off = emit.largest_of(emit.divide(apart(at.predicted, at.new, j), allowed), off)
        emit.store(off, room, lanes.OFF)

    def judge(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Accept steps, or shorten them by as much as they are off; runs of too many refusals end in lanes."""
        builder, one = emit.builder, emit.constant(1.0)
        select, per_order = builder.select, emit.divide(one, emit.number(order))
        off, *defects = (emit.load(room, field) for field in (lanes.OFF, lanes.WORST, lanes.DEFECT))
        fine = _is_set(emit, room, lanes.FINE)
        for value in (off, *defects):
            size = emit.function("fabs", value)
            fine = builder.both(fine, builder.compare("fcmp olt", size, emit.constant(math.inf)))
        defect, shortest = emit.larger(*defects), emit.constant(lane_taylor.MOST_SHORTENED)

        def root(x: Value) -> Value:
            return emit.exponential(emit.multiply(emit.logarithm(x), per_order))

        nearer = root(emit.divide(emit.constant(lane_taylor.ALLOWED), off))
        factor = select(builder.compare("fcmp ogt", off, one), nearer, one)
        truer = emit.multiply(emit.constant(lane_taylor.SHORTENED), root(emit.divide(one, defect)))
        truer = emit.smaller(factor, emit.larger(shortest, truer))
        factor = select(builder.compare("fcmp ogt", defect, one), truer, factor)
        factor = select(fine, factor, shortest)
        running, refused = _is_set(emit, room, lanes.RUNNING), builder.compare("fcmp olt", factor, one)
        accepted = builder.both(running, builder.compare("fcmp oge", factor, one))
        _store_mask(emit, room, lanes.ACCEPTED, accepted)
        times = emit.load(room, lanes.REFUSED)
        times = select(builder.both(running, refused), emit.add(times, one), times)
        emit.store(times, room, lanes.REFUSED)
        grown = emit.multiply(emit.load(room, lanes.H), select(refused, factor, emit.constant(lane_taylor.GROWTH)))
        emit.store(select(running, grown, emit.load(room, lanes.LONGEST)), room, lanes.LONGEST)
        few = builder.compare("fcmp ole", times, emit.constant(float(lane_taylor.MOST_REFUSED)))
        _store_mask(emit, room, lanes.RUNNING, builder.both(running, few))

    def take(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The end of an accepted step becomes the state."""
        at = self._at(emit, order, control, room)
        accepted = _is_set(emit, room, lanes.ACCEPTED)
        for k in range(2 * self.n):
            emit.store(emit.builder.select(accepted, emit.load(at.new, k), emit.load(at.state, k)), at.state, k)

    def _tolerances(self, emit: LaneEmitter, control: Value) -> tuple[Value, list[Value]]:
        return _common(emit, control, lanes.RTOL), [_common(emit, control, lanes.ATOL + j) for j in range(self.n)]

    def _at(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> "_Places":
        *fixed, series = lanes.places(self.n, self.n_rows, self.n_numbers)
        emit.numbers = emit.pointer(room, fixed.pop())
        emit.constants = emit.builder.gep(control, integer(lanes.ATOL + self.n))
        begin = emit.pointer(room, series)
        following = emit.builder.add(order, integer(1))
        scratch = emit.pointer(begin, emit.builder.mul(following, integer(self.n)))
        state, new, predicted, found, a, lam = (emit.pointer(room, place) for place in fixed)
        return _Places(order, room, state, new, predicted, found, a, lam, begin, scratch)

    def closer(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Move positions of lanes that FINE names towards the constraints."""
        act, _ = self._project(emit, self.equations.closer, lanes.FINE, self._at(emit, order, control, room))
        for field in (lanes.FINE, lanes.LEFT_TO_MOVE):
            _store_mask(emit, room, field, act)
        emit.store(emit.constant(math.inf), room, lanes.MOVED_BEFORE)

    def nearer(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The same and velocities, and accelerations and multipliers there, until a move is no more than rounding."""
        builder, at = emit.builder, self._at(emit, order, control, room)
        fine, left = (_is_set(emit, room, field) for field in (lanes.FINE, lanes.LEFT_TO_MOVE))
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
        _store_mask(emit, room, lanes.LEFT_TO_MOVE, goes_on)
        waited = builder.operation("xor", fine, builder.both(fine, left))
        _store_mask(emit, room, lanes.FINE, builder.operation("or", waited, there))

    def _project(self, emit: LaneEmitter, outputs: Outputs, which: int, at: "_Places") -> tuple[Value, Value]:
        """Which of some lanes could be moved, and how far they were."""
        select, room = emit.builder.select, at.room
        inputs = self._new(emit, room, at)
        written, arrays = results_of(emit, self.equations.graph, outputs, inputs, self.numbers)
        made = dict(zip(outputs.arrays, arrays, strict=True))
        act = emit.builder.both(_is_set(emit, room, which), conditions_hold(emit, written, outputs, arrays[0]))
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
        at = self._at(emit, order, control, room)
        holds, a = self._there(emit, room, at)
        for k, value in enumerate(a):
            emit.store(value, at.a, k)
        _keep_fine(emit, room, holds)

    def _there(self, emit: LaneEmitter, room: Value, at: "_Places") -> tuple[Value, list[Value]]:
        outputs = self.equations.there
        written, (a,) = results_of(emit, self.equations.graph, outputs, self._new(emit, room, at), self.numbers)
        return conditions_hold(emit, written, outputs, a), a

    def redundant(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Whether the rows that do not count hold, too."""
        at, outputs = self._at(emit, order, control, room), self.equations.redundant
        written, (none,) = results_of(emit, self.equations.graph, outputs, self._new(emit, room, at), self.numbers)
        _keep_fine(emit, room, conditions_hold(emit, written, outputs, none))

    def _new(self, emit: LaneEmitter, room: Value, at: "_Places") -> list[Value]:
        return [emit.load(room, lanes.AHEAD), *(emit.load(at.new, i) for i in range(2 * self.n))]


class _Places(NamedTuple):
    """The order, and pointers to `room` and to what stands there, see kernels/lanes/lane_room.py."""

    order: Value
    room: Value
    state: Value
    new: Value
    predicted: Value
    found: Value
    a: Value
    lam: Value
    series: Value
    scratch: Value


def _threes(values: list[Value]) -> Iterator[tuple[Value, Value, Value]]:
    return zip(values[::3], values[1::3], values[2::3], strict=True)


def _common(emit: LaneEmitter, control: Value, place: int) -> Value:
    """A number of `control`, for all lanes."""
    return emit.splat(emit.builder.load(emit.builder.gep(control, integer(place))))


def _is_set(emit: LaneEmitter, room: Value, field: int) -> Value:
    """In which lanes a field is not 0."""
    return emit.builder.compare("fcmp one", emit.load(room, field), emit.constant(0.0))


def _store_mask(emit: LaneEmitter, room: Value, field: int, mask: Value) -> None:
    emit.store(emit.builder.select(mask, emit.constant(1.0), emit.constant(0.0)), room, field)


def _keep_fine(emit: LaneEmitter, room: Value, holds: Value) -> None:
    _store_mask(emit, room, lanes.FINE, emit.builder.both(_is_set(emit, room, lanes.FINE), holds))

"""Step control of many runs at once, as code: what depends on the series and the states, and not on the equations.

Every number is a vector, with one run in each of its lanes; what they are is in kernels/lanes/lane_room.py.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_text import Value, integer
from twoloop.kernels.control.defect import ROUNDING
from twoloop.kernels.control.predictor import FLOOR, LEAST, SHARE_OF_MOTION, SHARE_THROUGH_ZERO
from twoloop.kernels.lanes import lane_room as lanes
from twoloop.kernels.lanes import lane_taylor

AT_ONCE = 3  # coordinates whose Horner schemes run side by side: of each three numbers are carried, in 16 registers


class Places(NamedTuple):
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


class LaneSteps:
    """Writes step control for a mechanism of n coordinates and n_rows multipliers."""

    n_numbers: int  # that depend on parameters

    def __init__(self, n: int, n_rows: int):
        self.n, self.n_rows = n, n_rows

    def unit(self, emit: LaneEmitter, control: Value, room: Value) -> Value:
        """UNIT of new runs, and that after accepted steps."""
        select, unit = emit.builder.select, emit.load(room, lanes.UNIT)
        fresh, accepted = (is_set(emit, room, field) for field in (lanes.FRESH, lanes.ACCEPTED))
        span = emit.subtract(common(emit, control, lanes.T1), common(emit, control, lanes.T0))
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
        builder, n, at = emit.builder, self.n, self.places(emit, order, control, room)
        unit, (rtol, atol) = emit.load(room, lanes.UNIT), self.tolerances(emit, control)
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
        t, t1 = emit.load(room, lanes.T), common(emit, control, lanes.T1)
        left, zero = emit.subtract(t1, t), emit.constant(0.0)
        h = emit.smallest_of(emit.multiply(length, unit), emit.load(room, lanes.LONGEST))
        h = builder.select(builder.compare("fcmp oge", h, left), left, h)
        largest = emit.larger(emit.function("fabs", t), emit.function("fabs", t1))
        goes = builder.compare("fcmp ogt", h, emit.multiply(emit.constant(lanes.SHORTEST), largest))
        for field in (lanes.RUNNING, lanes.FINE):
            goes = builder.both(goes, is_set(emit, room, field))
        h = builder.select(goes, h, zero)
        emit.store(h, room, lanes.H)
        emit.store(emit.divide(h, unit), room, lanes.X)
        for field in (lanes.RUNNING, lanes.FINE):
            store_mask(emit, room, field, goes)

    def evaluate(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The state and its accelerations by the series, X units of time on."""
        at = self.places(emit, order, control, room)
        for j, q in enumerate(self.positions(emit, at, emit.load(room, lanes.X))):
            emit.store(q, at.predicted, j)

    def positions(self, emit: LaneEmitter, at: Places, x: Value) -> list[Value]:
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

    def defect(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The defect of a step at its end."""
        at = self.places(emit, order, control, room)
        a = [emit.load(at.a, j) for j in range(self.n)]
        emit.store(self.defect_of(emit, control, at, a), room, lanes.DEFECT)

    def defect_of(self, emit: LaneEmitter, control: Value, at: Places, a: list[Value]) -> Value:
        """How far accelerations by the series are from those at NEW, over the tolerances, see control/defect.py."""
        n, (rtol, atol) = self.n, self.tolerances(emit, control)
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
        n, at, (rtol, atol) = self.n, self.places(emit, order, control, room), self.tolerances(emit, control)
        h = emit.load(room, lanes.H)

        def size(base: Value, place: int) -> Value:
            return emit.function("fabs", emit.load(base, place))

        def apart(one: Value, other: Value, place: int) -> Value:
            return emit.function("fabs", emit.subtract(emit.load(one, place), emit.load(other, place)))

        motion = off = emit.constant(0.0)
        for j in range(n):
            way = emit.larger(emit.multiply(h, size(at.state, n + j)), apart(at.new, at.state, j))
            motion = emit.larger(way, motion)
        turned, least = self.turned(emit, at), emit.multiply(emit.constant(SHARE_THROUGH_ZERO), motion)
        motion = emit.multiply(emit.constant(SHARE_OF_MOTION), motion)
        for j in range(n):
            scale = emit.add(atol[j], emit.multiply(rtol, emit.larger(size(at.new, j), size(at.state, j))))
            allowed = emit.add(motion, emit.multiply(emit.constant(FLOOR), scale))
            allowed = emit.smaller(scale, allowed)
            if turned is not None:
                allowed = emit.builder.select(turned, emit.smaller(scale, least), allowed)
            allowed = emit.larger(allowed, emit.constant(LEAST))
            off = emit.largest_of(emit.divide(apart(at.predicted, at.new, j), allowed), off)
        emit.store(off, room, lanes.OFF)

    def turned(self, emit: LaneEmitter, at: Places) -> Value | None:
        """Where a step from STATE to NEW may have passed a singular position; None: others look for that."""
        return None

    def judge(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Accept steps, or shorten them by as much as they are off; too many refusals, or no values, end a run here."""
        builder, one = emit.builder, emit.constant(1.0)
        select, per_order = builder.select, emit.divide(one, emit.number(order))
        off, *defects = (emit.load(room, field) for field in (lanes.OFF, lanes.WORST, lanes.DEFECT))
        fine = is_set(emit, room, lanes.FINE)
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
        running, refused = is_set(emit, room, lanes.RUNNING), builder.compare("fcmp olt", factor, one)
        accepted = builder.both(running, builder.compare("fcmp oge", factor, one))
        store_mask(emit, room, lanes.ACCEPTED, accepted)
        times = emit.load(room, lanes.REFUSED)
        times = select(builder.both(running, refused), emit.add(times, one), times)
        # shorter steps could pass over a place at which the equations have no values
        times = select(fine, times, emit.constant(math.inf))
        emit.store(times, room, lanes.REFUSED)
        grown = emit.multiply(emit.load(room, lanes.H), select(refused, factor, emit.constant(lane_taylor.GROWTH)))
        emit.store(select(running, grown, emit.load(room, lanes.LONGEST)), room, lanes.LONGEST)
        few = builder.compare("fcmp ole", times, emit.constant(float(lane_taylor.MOST_REFUSED)))
        store_mask(emit, room, lanes.RUNNING, builder.both(running, few))

    def take(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The end of an accepted step becomes the state."""
        at = self.places(emit, order, control, room)
        accepted = is_set(emit, room, lanes.ACCEPTED)
        for k in range(2 * self.n):
            emit.store(emit.builder.select(accepted, emit.load(at.new, k), emit.load(at.state, k)), at.state, k)

    def tolerances(self, emit: LaneEmitter, control: Value) -> tuple[Value, list[Value]]:
        """Rtol, and Atol of each coordinate."""
        return common(emit, control, lanes.RTOL), [common(emit, control, lanes.ATOL + j) for j in range(self.n)]

    def places(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> Places:
        """Where everything stands; numbers and constants are read from there, too."""
        *fixed, series = lanes.places(self.n, self.n_rows, self.n_numbers)
        emit.numbers = emit.pointer(room, fixed.pop())
        emit.constants = emit.builder.gep(control, integer(lanes.ATOL + self.n))
        begin = emit.pointer(room, series)
        following = emit.builder.add(order, integer(1))
        scratch = emit.pointer(begin, emit.builder.mul(following, integer(self.n)))
        state, new, predicted, found, a, lam = (emit.pointer(room, place) for place in fixed)
        return Places(order, room, state, new, predicted, found, a, lam, begin, scratch)


def _threes(values: list[Value]) -> Iterator[tuple[Value, Value, Value]]:
    return zip(values[::3], values[1::3], values[2::3], strict=True)


def common(emit: LaneEmitter, control: Value, place: int) -> Value:
    """A number of `control`, for all lanes."""
    return emit.splat(emit.builder.load(emit.builder.gep(control, integer(place))))


def is_set(emit: LaneEmitter, room: Value, field: int) -> Value:
    """In which lanes a field is not 0."""
    return emit.builder.compare("fcmp one", emit.load(room, field), emit.constant(0.0))


def store_mask(emit: LaneEmitter, room: Value, field: int, mask: Value) -> None:
    """Make a field 1 in the lanes of a mask, and 0 in others."""
    emit.store(emit.builder.select(mask, emit.constant(1.0), emit.constant(0.0)), room, field)


def keep_fine(emit: LaneEmitter, room: Value, holds: Value) -> None:
    """FINE stays only where something holds."""
    store_mask(emit, room, lanes.FINE, emit.builder.both(is_set(emit, room, lanes.FINE), holds))

"""Code for many runs of one mechanism at once: every number is a vector, with one run in each of its lanes.

The operations are those of `series`, `straight_line` and `straight_code`. Coefficients are read, a vector each, so that
runs may have parameters of their own. Factors of products stand in rows, one for each order; a factor that several
products share stands there once.
"""

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import llvm_trigonometry, straight_code
from twoloop.generate.coefficients import Coefficients, Terms
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_code import INTEGER, Quantities, Value
from twoloop.generate.series import SeriesProgram, Sums, Table, series_program
from twoloop.generate.straight_code import conditions_hold, results_of
from twoloop.generate.straight_line import Choice, Outputs, Solution, StraightLine
from twoloop.generate.tracing import Untraceable
from twoloop.kernels import lanes
from twoloop.kernels.control.defect import ROUNDING
from twoloop.kernels.control.predictor import FLOOR, LEAST, SHARE_OF_MOTION
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    EXPONENTIAL,
    LOGARITHM,
    PENDING,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
)
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

AT_ONCE = 8  # sums in one loop, in registers
LARGEST = 1500  # operations of a series, which take some seconds to compile


class Operation(NamedTuple):
    """One of a series' program; of sines and cosines both: two results."""

    kind: int
    results: tuple[int, ...]
    first: tuple[Terms, float]
    second: tuple[Terms, float]


class LaneCode:
    """Writes the code of a mechanism, whose numbers depend on parameters as `record` has it.

    `scratch` holds, lane vectors each: what the factors keep; r; the divisors of inverse functions; and rows of
    factors of order 0, 1 and so on, behind sums that are carried to the next order.
    """

    def __init__(self, system: ConstrainedSystem, choice: Choice, parameters: Any):
        self.numbers = Coefficients()
        self.equations = equations = StraightLine(system, choice, parameters)
        self.solution = Solution(self.equations)
        self.n, self.n_rows = system.n_q, system.n_c + system.n_a
        program = series_program(system, parameters)
        if program.n_operations > LARGEST:
            raise Untraceable(f"its series takes more than {LARGEST} operations")
        self.slots: dict[Any, int] = {}
        self._divisors: dict[int, int] = {}
        self.first = 1 + 3 * self.n + self.n_rows
        self.early = self._operations(program.early, self.first)
        self.late = self._operations(program.late, self.first + len(program.early.first.column))
        self.rows, self.balance = (
            self._rows(program.rows, program.row_places),
            self._rows(program.balance, program.balance_places),
        )
        self._carried: dict[int, tuple[int, int]] = {}  # see _shared_sums
        self._carried |= self._shared_sums()
        self.sums_ahead = sorted(set(self._carried.values()))
        for operation in (*self.early, *self.late):
            self._factors(operation)
            if operation.kind in (SQUARE_ROOT, LOGARITHM, ARCTANGENT):
                self._divisors[operation.results[0]] = len(self._divisors)
        self.r = self.solution.n_kept
        self.divisors = self.r + self.n
        self.carried = self.divisors + len(self._divisors)
        self.table = self.carried + len(self.sums_ahead)
        self.width = len(self.slots)
        self.structure = self._structure(program)
        self.n_numbers = self.numbers.n_varying
        parts = [equations.there, equations.closer, equations.nearer, equations.redundant, self.solution.kept]
        counts = [len(each.quantities(equations.graph)) for each in parts if each is not None]
        self.n_quantities = sum(counts) + len(self.solution.solved.quantities(self.solution.graph))

    def scratch_size(self, order: int) -> int:
        """Length of `scratch`, in vectors."""
        return self.table + self.width * (order + 1)

    def _structure(self, program: SeriesProgram) -> str:
        equations, numbers = self.equations, self.numbers
        told: list[Any] = [self.n, self.n_rows, self.early, self.late, self.rows, self.balance, self.slots]
        for outputs in (equations.there, equations.closer, equations.nearer, equations.redundant, self.solution.kept):
            if outputs is not None:
                told += [{name: len(forms) for name, forms in outputs.arrays.items()}, len(outputs.conditions)]
                told += list(numbers.structure(equations.graph, outputs.forms))
        told += list(numbers.structure(self.solution.graph, self.solution.solved.forms))
        return hashlib.sha256(repr(told).encode()).hexdigest()

    def _forms(self, sums: Sums, rows: Sequence[int]) -> list[tuple[Terms, float]]:
        more: dict[int, list[tuple[int, float]]] = {row: [] for row in rows}
        for row, i, c in zip(sums.row.tolist(), sums.more_column.tolist(), sums.more_coefficient.tolist(), strict=True):
            more[row].append((i, c))
        firsts = zip(rows, sums.column.tolist(), sums.coefficient.tolist(), sums.constant.tolist(), strict=True)
        return [
            self.numbers.of(tuple(term for term in ((i, c), *more[row]) if term[1] != 0.0), constant)
            for row, i, c, constant in firsts
        ]

    def _rows(self, sums: Sums, places: Any) -> list[tuple[int, tuple[Terms, float]]]:
        return list(zip(places.tolist(), self._forms(sums, places.tolist()), strict=True))

    def _operations(self, table: Table, quantity: int) -> list[Operation]:
        firsts, seconds = (self._forms(each, range(len(each.column))) for each in (table.first, table.second))
        made = []
        for kind, begin, end in table.groups[:, :3].tolist():
            half = (end - begin) // 2 if kind == SINE else end - begin
            for k in range(begin, begin + half):
                results = (quantity + k, quantity + k + half) if kind == SINE else (quantity + k,)
                made.append(Operation(kind, results, firsts[k], seconds[k]))
        return made

    def _slot(self, *key: Any) -> int:
        """The place in a row of a factor: a form, or ("scaled", form), which is multiplied by its order."""
        return self.slots.setdefault(key, len(self.slots))

    def _shared_sums(self) -> dict[int, tuple[int, int]]:
        """Pairs of factors of sines by the result of a product of a cosine, or a sine, and the rate of its angle.

        (cos x) x' is the derivative of sin x, so that what is known of the product's coefficient of one order is the
        sum for the sine of the next, over the unit of time.
        """
        pairs: dict[Any, tuple[int, int]] = {}
        for operation in self.early:
            terms, _ = operation.first
            if operation.kind == SINE and all(1 <= i <= self.n for i, _ in terms):
                rate = tuple((i + self.n, c) for i, c in terms)
                for result, pair in zip(reversed(operation.results), self._factors(operation), strict=True):
                    pairs[((result, 1.0),), rate] = pair
        products = [each for each in self.early if each.kind == PENDING and not each.first[1] and not each.second[1]]
        known = {each.results[0]: pairs.get((each.first[0], each.second[0])) for each in products}
        return {result: pair for result, pair in known.items() if pair is not None}

    def _factors(self, operation: Operation) -> list[tuple[int, int]]:
        """Places of the factors X and Y of the products that are summed up for each result."""
        kind, results, first, second = operation
        if results[0] in self._carried:
            return []
        own = [self._slot(((result, 1.0),), 0.0) for result in results]
        if kind in (PRODUCT, PENDING):
            return [(self._slot(*first), self._slot(*second))]
        if kind == RECIPROCAL:
            return [(self._slot(*first), own[0])]
        if kind == SQUARE_ROOT:
            return [(own[0], own[0])]
        if kind in (LOGARITHM, ARCTANGENT):
            return [(self._slot("scaled", ((results[0], 1.0),), 0.0), self._slot(*second))]
        x = self._slot("scaled", *first)
        return [(x, own[1]), (x, own[0])] if kind == SINE else [(x, own[0])]

    # what is emitted

    def series(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Coefficients of q up to an order, in units of time, about the state of each lane."""
        builder, n, at = emit.builder, self.n, self._at(emit, order, control, room)
        unit, out, scratch = emit.load(room, lanes.UNIT), at.series, at.scratch
        inputs = [emit.load(room, lanes.T), *(emit.load(at.state, i) for i in range(2 * n))]
        written, (kept,) = results_of(emit, self.equations.graph, self.solution.kept, inputs, self.numbers)
        holds = conditions_hold(emit, written, self.solution.kept, kept)
        for i, value in enumerate(kept):
            emit.store(value, scratch, i)
        for j in range(n):
            emit.store(inputs[1 + j], out, j)
            emit.store(emit.multiply(unit, inputs[1 + n + j]), out, n + j)
        for place in (*range(self.r, self.divisors), *range(self.carried, self.table)):
            emit.store(emit.constant(0.0), scratch, place)
        row = _Row(self, emit, emit.pointer(scratch, self.table))
        known = Quantities(emit, lambda i: inputs[i])
        self._begin(emit, known, self.early, row, scratch)
        self._begin(emit, known, self.late, row, scratch)
        for place, form in self.balance:
            emit.store(known.sum(*form), scratch, self.r + place)
        with emit.loop(INTEGER(1), order, []) as (k, _, _):
            self._order(emit, k, unit, out, scratch)
        last, total = emit.pointer(out, builder.mul(order, INTEGER(n))), emit.constant(0.0)
        for j in range(n):
            total = emit.add(total, emit.multiply(emit.constant(0.0), emit.load(last, j)))
        holds = builder.and_(holds, builder.fcmp_ordered("==", total, emit.constant(0.0)))
        _keep_fine(emit, room, holds)

    def lengths(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The last two terms of positions and velocities over the tolerances."""
        builder, n, at = emit.builder, self.n, self._at(emit, order, control, room)
        unit, (rtol, atol) = emit.load(room, lanes.UNIT), self._tolerances(emit, control)
        one, found = emit.constant(1.0), []
        scales = []
        for j in range(n):
            q, v = (emit.function("fabs", emit.load(at.series, i)) for i in (j, n + j))
            of_q = emit.divide(one, emit.add(atol[j], emit.multiply(rtol, q)))
            of_v = emit.divide(one, emit.add(emit.multiply(atol[j], unit), emit.multiply(rtol, v)))
            scales.append((of_q, of_v))
        for back in (0, 1):
            power = builder.sub(order, INTEGER(back))
            row, factor = emit.pointer(at.series, builder.mul(power, INTEGER(n))), emit.number(power)
            largest = emit.constant(0.0)
            for j, (of_q, of_v) in enumerate(scales):
                size = emit.function("fabs", emit.load(row, j))
                largest = emit.larger(emit.multiply(size, emit.larger(of_q, emit.multiply(factor, of_v))), largest)
            found.append(largest)
        logarithms = [
            emit.divide(emit.logarithm(value), emit.number(power))
            for value, power in zip(found, (order, builder.sub(order, INTEGER(1))), strict=True)
        ]
        emit.store(emit.exponential(emit.negative(emit.larger(*logarithms))), room, lanes.LENGTH)

    def evaluate(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The state and its accelerations by the series, X units of time on, by Horner's scheme."""
        builder, n, at = emit.builder, self.n, self._at(emit, order, control, room)
        x, unit, zero = emit.load(room, lanes.X), emit.load(room, lanes.UNIT), emit.constant(0.0)
        per_unit = emit.divide(emit.constant(1.0), unit)
        twice = emit.multiply(emit.constant(2.0), emit.multiply(per_unit, per_unit))
        last = emit.pointer(at.series, builder.mul(order, INTEGER(n)))
        for begin in range(0, n, AT_ONCE):
            some = range(begin, min(begin + AT_ONCE, n))
            initial = [value for j in some for value in (emit.load(last, j), zero, zero)]
            with emit.loop(INTEGER(0), order, initial) as (m, carried, new):
                power = builder.sub(builder.sub(order, INTEGER(1)), m)
                row = emit.pointer(at.series, builder.mul(power, INTEGER(n)))
                for place, j in enumerate(some):
                    q, v, a = carried[3 * place : 3 * place + 3]
                    new += [
                        emit.add(emit.multiply(q, x), emit.load(row, j)),
                        emit.add(emit.multiply(v, x), q),
                        emit.add(emit.multiply(a, x), v),
                    ]
            for place, j in enumerate(some):
                q, v, a = new[3 * place : 3 * place + 3]
                emit.store(q, at.new, j)
                emit.store(emit.multiply(v, per_unit), at.new, n + j)
                emit.store(emit.multiply(a, twice), at.found, j)

    def judge(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The defect of a step, see control/defect.py, and how far its prediction was off, see control/predictor.py."""
        n, at, (rtol, atol) = self.n, self._at(emit, order, control, room), self._tolerances(emit, control)
        h = emit.load(room, lanes.H)
        share = emit.divide(h, emit.number(order))

        def size(base: Value, place: int) -> Value:
            return emit.function("fabs", emit.load(base, place))

        def apart(one: Value, other: Value, place: int) -> Value:
            return emit.function("fabs", emit.subtract(emit.load(one, place), emit.load(other, place)))

        largest = motion = worst = off = emit.constant(0.0)
        for j in range(n):
            largest = emit.larger(size(at.a, j), largest)
            way = emit.larger(emit.multiply(h, size(at.state, n + j)), apart(at.new, at.state, j))
            motion = emit.larger(way, motion)
        floor = emit.multiply(emit.constant(ROUNDING), largest)
        motion = emit.multiply(emit.constant(SHARE_OF_MOTION), motion)
        for j in range(n):
            defect = apart(at.found, at.a, j)
            defect = emit.multiply(share, emit.subtract(defect, floor))
            of_q = emit.add(atol[j], emit.multiply(rtol, size(at.new, j)))
            of_v = emit.add(atol[j], emit.multiply(rtol, size(at.new, n + j)))
            worst = emit.largest_of(emit.divide(defect, of_v), worst)
            worst = emit.largest_of(emit.divide(emit.multiply(defect, share), of_q), worst)
            scale = emit.larger(of_q, emit.add(atol[j], emit.multiply(rtol, size(at.state, j))))
            allowed = emit.add(motion, emit.multiply(emit.constant(FLOOR), scale))
            allowed = emit.larger(emit.smaller(scale, allowed), emit.constant(LEAST))
            off = emit.largest_of(emit.divide(apart(at.predicted, at.new, j), allowed), off)
        emit.store(worst, room, lanes.DEFECT)
        emit.store(off, room, lanes.OFF)

    def take(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The end of an accepted step becomes the state."""
        at = self._at(emit, order, control, room)
        accepted = emit.builder.fcmp_ordered("!=", emit.load(room, lanes.ACCEPTED), emit.constant(0.0))
        for k in range(2 * self.n):
            emit.store(emit.builder.select(accepted, emit.load(at.new, k), emit.load(at.state, k)), at.state, k)

    def _tolerances(self, emit: LaneEmitter, control: Value) -> tuple[Value, list[Value]]:
        def at(place: int) -> Value:
            return emit.splat(emit.builder.load(emit.builder.gep(control, [INTEGER(place)], inbounds=True)))

        return at(lanes.RTOL), [at(lanes.ATOL + j) for j in range(self.n)]

    def _at(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> "_Places":
        *fixed, series, _ = lanes.places(self.n, self.n_rows, self.n_numbers, 0)
        emit.numbers = emit.pointer(room, fixed.pop())
        emit.constants = emit.builder.gep(control, [INTEGER(lanes.ATOL + self.n)], inbounds=True)
        begin = emit.pointer(room, series)
        following = emit.builder.add(order, INTEGER(1))
        scratch = emit.pointer(begin, emit.builder.mul(following, INTEGER(self.n)))
        state, new, predicted, found, a, lam = (emit.pointer(room, place) for place in fixed)
        return _Places(state, new, predicted, found, a, lam, begin, scratch)

    def _order(self, emit: LaneEmitter, k: Value, unit: Value, out: Value, scratch: Value) -> None:
        """From coefficients below an order to those of velocities of this order and of positions of the next."""
        builder, n = emit.builder, self.n
        following = builder.add(k, INTEGER(1))
        q = emit.pointer(out, builder.mul(k, INTEGER(n)))
        order, zero = emit.number(k), emit.constant(0.0)
        time = builder.select(builder.icmp_signed("==", k, INTEGER(1)), unit, zero)
        known = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time)
        row = _Row(self, emit, self._row(emit, scratch, k))
        inverse = emit.divide(emit.constant(1.0), order)
        self._operate(emit, known, self.early, row, scratch, k, order, inverse)
        ahead = self._sums(emit, self.sums_ahead, scratch, following)
        for place, pair in enumerate(self.sums_ahead):
            emit.store(ahead[pair], scratch, self.carried + place)
        per_unit = emit.divide(emit.constant(1.0), unit)
        for result, pair in self._carried.items():
            known.define(result, emit.multiply(per_unit, ahead[pair]))
        scale = emit.negative(emit.divide(order, unit))
        c = [zero] * self.n_rows
        for place, (terms, _) in self.rows:
            c[place] = emit.multiply(scale, known.sum(terms))
        r = [emit.load(scratch, self.r + i) for i in range(n)]
        kept = [emit.load(scratch, i) for i in range(self.solution.n_kept)]
        solution = self.solution
        _, (a, lam) = results_of(emit, solution.graph, solution.solved, [*r, *c, *kept], self.numbers)
        per_v, per_q = emit.multiply(unit, inverse), emit.divide(unit, emit.number(following))
        before = Quantities(emit, lambda i: zero)  # a and lam of the order before
        for j in range(n):
            v = emit.multiply(per_v, a[j])
            known.define(1 + n + j, v)
            emit.store(emit.multiply(per_q, v), emit.pointer(out, builder.mul(following, INTEGER(n))), j)
            before.define(1 + 2 * n + j, a[j])
        for i in range(self.n_rows):
            before.define(1 + 3 * n + i, lam[i])
        row_before = _Row(self, emit, self._row(emit, scratch, builder.sub(k, INTEGER(1))))
        for operations, values, into in ((self.early, known, row), (self.late, before, row_before)):
            for operation in operations:
                if operation.kind == PENDING and operation.results[0] not in self._carried:
                    into.store(operation.second, values.sum(operation.second[0]))
        self._operate(emit, known, self.late, row, scratch, k, order, inverse)
        for place, (terms, _) in self.balance:
            emit.store(known.sum(terms), scratch, self.r + place)

    def _row(self, emit: LaneEmitter, scratch: Value, order: Value) -> Value:
        return emit.pointer(scratch, self.table, emit.builder.mul(order, INTEGER(self.width)))

    def _begin(
        self, emit: LaneEmitter, known: Quantities, operations: list[Operation], row: "_Row", scratch: Value
    ) -> None:
        """Order 0: the functions themselves; late factors that wait are stored when they are known."""
        one, zero = emit.constant(1.0), emit.constant(0.0)
        for operation in operations:
            kind, results, first, second = operation
            x = known.sum(*first)
            row.store(first, x, "if used")
            divisor = None
            if kind == PENDING:
                if operations is self.early and results[0] not in self._carried:
                    row.store(second, known.sum(*second))
                values = [zero]
            elif kind == PRODUCT:
                z = known.sum(*second)
                row.store(second, z)
                values = [emit.multiply(x, z)]
            elif kind == SINE:
                values = list(llvm_trigonometry.sine_and_cosine(emit, x))
            elif kind == RECIPROCAL:
                values = [emit.divide(one, x)]
            else:
                values = [emit.function(straight_code.FUNCTIONS[kind], x)]
                if kind in (LOGARITHM, ARCTANGENT):
                    divisor = known.sum(*second)
                    row.store(second, divisor)
                elif kind == SQUARE_ROOT:
                    divisor = emit.add(values[0], values[0])
            if kind in (SINE, EXPONENTIAL, LOGARITHM, ARCTANGENT):
                scaled = (((results[0], 1.0),), 0.0) if kind in (LOGARITHM, ARCTANGENT) else first
                row.store(("scaled", *scaled), zero)
            if divisor is not None:
                emit.store(emit.divide(one, divisor), scratch, self.divisors + self._divisors[results[0]])
            for result, value in zip(results, values, strict=True):
                known.define(result, value)
                row.store((((result, 1.0),), 0.0), value, "if used")

    def _sums(
        self, emit: LaneEmitter, pairs: list[tuple[int, int]], scratch: Value, order: Value
    ) -> dict[tuple[int, int], Value]:
        """Of pairs of factors, the sum of X[j] Y[order - j] over 0 < j < order."""
        builder = emit.builder
        sums: dict[tuple[int, int], Value] = {}
        for begin in range(0, len(pairs), AT_ONCE):
            some = pairs[begin : begin + AT_ONCE]
            with emit.loop(INTEGER(1), order, [emit.constant(0.0)] * len(some)) as (j, totals, new):
                x, y = self._row(emit, scratch, j), self._row(emit, scratch, builder.sub(order, j))
                loaded: dict[tuple[Value, int], Value] = {}
                for (i, k), total in zip(some, totals, strict=True):
                    for base, place in ((x, i), (y, k)):
                        if (base, place) not in loaded:
                            loaded[base, place] = emit.load(base, place)
                    new.append(emit.add(total, emit.multiply(loaded[x, i], loaded[y, k])))
            sums |= dict(zip(some, new, strict=True))
        return sums

    def _operate(
        self,
        emit: LaneEmitter,
        known: Quantities,
        operations: list[Operation],
        row: "_Row",
        scratch: Value,
        k: Value,
        order: Value,
        inverse: Value,
    ) -> None:
        """An order that is not 0; of what waits, what is known before."""
        pairs = list(dict.fromkeys(pair for operation in operations for pair in self._factors(operation)))
        there = {pair: self.carried + place for place, pair in enumerate(self.sums_ahead) if pair in pairs}
        sums = self._sums(emit, [pair for pair in pairs if pair not in there], scratch, k)
        sums |= {pair: emit.load(scratch, place) for pair, place in there.items()}
        begin = emit.pointer(scratch, self.table)
        for operation in operations:
            kind, results, (first, _), (second, _) = operation
            if results[0] in self._carried:
                continue
            totals = [sums[pair] for pair in self._factors(operation)]
            at = [(emit.load(begin, x), emit.load(begin, y)) for x, y in self._factors(operation)]
            u = known.sum(first)
            row.store(operation.first, u, "if used")
            if kind == PENDING:
                values = [emit.add(totals[0], emit.multiply(u, at[0][1]))]
            elif kind == PRODUCT:
                z = known.sum(second)
                row.store(operation.second, z)
                values = [emit.add(emit.add(totals[0], emit.multiply(u, at[0][1])), emit.multiply(at[0][0], z))]
            elif kind == RECIPROCAL:
                total = emit.add(totals[0], emit.multiply(u, at[0][1]))
                values = [emit.negative(emit.multiply(total, at[0][1]))]
            elif kind == SQUARE_ROOT:
                divisor = emit.load(scratch, self.divisors + self._divisors[results[0]])
                values = [emit.multiply(emit.subtract(u, totals[0]), divisor)]
            elif kind in (LOGARITHM, ARCTANGENT):
                divisor = emit.load(scratch, self.divisors + self._divisors[results[0]])
                values = [emit.multiply(emit.subtract(u, emit.multiply(totals[0], inverse)), divisor)]
                row.store(("scaled", ((results[0], 1.0),), 0.0), emit.multiply(order, values[0]))
                row.store(operation.second, known.sum(second))
            else:
                x = emit.multiply(order, u)
                row.store(("scaled", *operation.first), x)
                values = [
                    emit.multiply(emit.add(total, emit.multiply(x, y)), inverse)
                    for total, (_, y) in zip(totals, at, strict=True)
                ]
                if kind == SINE:
                    values[1] = emit.negative(values[1])
            for result, value in zip(results, values, strict=True):
                known.define(result, value)
                row.store((((result, 1.0),), 0.0), value, "if used")

    def closer(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Move positions of lanes that FINE names towards the constraints."""
        self._project(emit, self.equations.closer, order, control, room)

    def nearer(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """The same and velocities, and accelerations and multipliers there."""
        self._project(emit, self.equations.nearer, order, control, room)

    def _project(self, emit: LaneEmitter, outputs: Outputs | None, order: Value, control: Value, room: Value) -> None:
        assert outputs is not None
        select, at = emit.builder.select, self._at(emit, order, control, room)
        inputs = self._new(emit, room, at)
        written, arrays = results_of(emit, self.equations.graph, outputs, inputs, self.numbers)
        made = dict(zip(outputs.arrays, arrays, strict=True))
        act = emit.builder.and_(_chosen(emit, room), conditions_hold(emit, written, outputs, arrays[0]))
        largest = emit.constant(0.0)
        for value in made["moved"]:
            largest = emit.larger(emit.function("fabs", value), largest)
        emit.store(select(act, largest, emit.constant(0.0)), room, lanes.MOVED)
        for k, value in enumerate([*made["q"], *made.get("v", [])]):
            emit.store(select(act, value, inputs[1 + k]), at.new, k)
        for base, name in ((at.a, "a"), (at.lam, "lam")):
            for k, value in enumerate(made.get(name, [])):
                emit.store(select(act, value, emit.load(base, k)), base, k)
        _store_mask(emit, room, act)

    def there(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Accelerations at a state as it stands."""
        at, outputs = self._at(emit, order, control, room), self.equations.there
        written, (a,) = results_of(emit, self.equations.graph, outputs, self._new(emit, room, at), self.numbers)
        for k, value in enumerate(a):
            emit.store(value, at.a, k)
        _keep_fine(emit, room, conditions_hold(emit, written, outputs, a))

    def redundant(self, emit: LaneEmitter, order: Value, control: Value, room: Value) -> None:
        """Whether the rows that do not count hold, too."""
        at, outputs = self._at(emit, order, control, room), self.equations.redundant
        written, (none,) = results_of(emit, self.equations.graph, outputs, self._new(emit, room, at), self.numbers)
        _keep_fine(emit, room, conditions_hold(emit, written, outputs, none))

    def _new(self, emit: LaneEmitter, room: Value, at: "_Places") -> list[Value]:
        return [emit.load(room, lanes.AHEAD), *(emit.load(at.new, i) for i in range(2 * self.n))]


class _Places(NamedTuple):
    """Pointers to what stands in `room`, see kernels/lanes.py."""

    state: Value
    new: Value
    predicted: Value
    found: Value
    a: Value
    lam: Value
    series: Value
    scratch: Value


class _Row:
    """Factors of one order, stored where they are used."""

    def __init__(self, code: LaneCode, emit: LaneEmitter, base: Value):
        self.code, self.emit, self.base = code, emit, base
        self.stored: set[int] = set()

    def store(self, key: Any, value: Value, when: str = "") -> None:
        """Put a factor in its place; "if used": it may have none."""
        place = self.code.slots.get(tuple(key)) if when else self.code.slots[tuple(key)]
        if place is not None and place not in self.stored:
            self.stored.add(place)
            self.emit.store(value, self.base, place)


def _chosen(emit: LaneEmitter, room: Value) -> Value:
    return emit.builder.fcmp_ordered("!=", emit.load(room, lanes.FINE), emit.constant(0.0))


def _store_mask(emit: LaneEmitter, room: Value, mask: Value) -> None:
    emit.store(emit.builder.select(mask, emit.constant(1.0), emit.constant(0.0)), room, lanes.FINE)


def _keep_fine(emit: LaneEmitter, room: Value, holds: Value) -> None:
    _store_mask(emit, room, emit.builder.and_(_chosen(emit, room), holds))

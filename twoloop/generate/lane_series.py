"""Recurrences of a Taylor series as code for lanes: they compute the coefficients of one order from the lower ones.

Factors of products are stored in rows, one row for each order; a factor that several products share is stored once.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from twoloop.generate.coefficients import Coefficients, Terms
from twoloop.generate.elimination import Solution
from twoloop.generate.lane_emitter import LaneEmitter
from twoloop.generate.llvm_code import Quantities, sine_and_cosine
from twoloop.generate.llvm_text import Value, integer
from twoloop.generate.lowering import FUNCTIONS, lower
from twoloop.generate.series import SeriesProgram, Sums, Table
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
from twoloop.kernels.lanes.layout import LANES

ZEROS = -1  # index of a row of zeros, before the row of order 0
# number of sums in one loop: of more, the running totals do not fit into 32 (or 16) registers
AT_ONCE = 12 if LANES == 8 else 6


class Operation(NamedTuple):
    """Operation of a series' program; sine and cosine are one operation with two results."""

    kind: int
    results: tuple[int, ...]
    first: tuple[Terms, float]
    second: tuple[Terms, float]


class LaneSeries:
    """Generator of the code for the recurrences of a program.

    `scratch` holds, as lane vectors: the kept factors of the linear equations; r; the reciprocal divisors of inverse
    functions; sums that are carried to the next order; a row of zeros; and one row of factors for each order from 0 on.
    """

    def __init__(self, program: SeriesProgram, solution: Solution, numbers: Coefficients, n: int, n_rows: int):
        self.solution, self.numbers, self.n, self.n_rows = solution, numbers, n, n_rows
        self.slots: dict[Any, int] = {}
        self._divisors: dict[int, int] = {}
        first = 1 + 3 * n + n_rows
        self.early = self._operations(program.early, first)
        self.late = self._operations(program.late, first + len(program.early.first.column))
        self.rows = self._rows(program.rows, program.row_places)
        self.balance = self._rows(program.balance, program.balance_places)
        self._carried: dict[int, tuple[int, int]] = {}  # see _shared_sums
        self._carried |= self._shared_sums()
        self.sums_ahead = sorted(set(self._carried.values()))
        for operation in (*self.early, *self.late):
            self._factors(operation)
            if operation.kind in (SQUARE_ROOT, LOGARITHM, ARCTANGENT):
                self._divisors[operation.results[0]] = len(self._divisors)
        self.r = solution.n_kept
        self.divisors = self.r + n
        self.carried = self.divisors + len(self._divisors)
        self.width = len(self.slots)
        self.zeros = self.carried + len(self.sums_ahead)
        self.table = self.zeros + self.width

    def scratch_size(self, order: int) -> int:
        """Return the length of `scratch`, in vectors."""
        return self.table + self.width * (order + 1)

    @property
    def structure(self) -> list[Any]:
        """Return the data on which the code depends."""
        return [self.n, self.n_rows, self.early, self.late, self.rows, self.balance, self.slots]

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
        operations = []
        for kind, begin, end in table.groups[:, :3].tolist():
            half = (end - begin) // 2 if kind == SINE else end - begin
            for k in range(begin, begin + half):
                results = (quantity + k, quantity + k + half) if kind == SINE else (quantity + k,)
                operations.append(Operation(kind, results, firsts[k], seconds[k]))
        return operations

    def _slot(self, *key: Any) -> int:
        """Return the index of a factor in a row: of a form, or of ("scaled", form), a form times its order."""
        return self.slots.setdefault(key, len(self.slots))

    def _shared_sums(self) -> dict[int, tuple[int, int]]:
        """Map results of products to pairs of factors of sines: products of a cosine, or sine, and its angle's rate.

        (cos x) x' is the derivative of sin x. So the part of the product's coefficient that is known before an order is
        solved is the sum for the sine of the next order, divided by the unit of time.
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
        """Return the indices of the factors X and Y of the product that is summed up for each result."""
        kind, results, first, second = operation
        if results[0] in self._carried:
            return []
        if kind in (PRODUCT, PENDING):
            return [(self._slot(*first), self._slot(*second))]
        if kind in (LOGARITHM, ARCTANGENT):
            return [(self._slot("scaled", ((results[0], 1.0),), 0.0), self._slot(*second))]
        own = [self._slot(((result, 1.0),), 0.0) for result in results]
        if kind == RECIPROCAL:
            return [(self._slot(*first), own[0])]
        if kind == SQUARE_ROOT:
            return [(own[0], own[0])]
        x = self._slot("scaled", *first)
        return [(x, own[1]), (x, own[0])] if kind == SINE else [(x, own[0])]

    def begin(self, emit: LaneEmitter, inputs: Sequence[Value], scratch: Value) -> None:
        """Write order 0 at t, q and v; the kept factors are in `scratch` already."""
        for place in (*range(self.r, self.divisors), *range(self.carried, self.table)):
            emit.store(emit.constant(0.0), scratch, place)
        row = _Row(self, emit, emit.pointer(scratch, self.table))
        known = Quantities(emit, lambda i: inputs[i])
        self._begin(emit, known, self.early, row, scratch)
        self._begin(emit, known, self.late, row, scratch)
        for place, form in self.balance:
            emit.store(known.sum(*form), scratch, self.r + place)

    def order(self, emit: LaneEmitter, k: Value, unit: Value, out: Value, scratch: Value) -> None:
        """Emit one order of the series: velocities of this order, positions of the next."""
        builder, n = emit.builder, self.n
        following = builder.add(k, integer(1))
        q = emit.pointer(out, builder.mul(k, integer(n)))
        order, zero = emit.number(k), emit.constant(0.0)
        none_below = builder.compare("icmp eq", k, integer(1))
        time = builder.select(none_below, unit, zero)
        known = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time)
        row = _Row(self, emit, self._row(emit, scratch, k))
        inverse = emit.divide(emit.constant(1.0), order)
        first = self._row(emit, scratch, builder.select(none_below, integer(ZEROS), integer(1)))
        row_before = _Row(self, emit, self._row(emit, scratch, builder.sub(k, integer(1))))
        sums = self._sums(emit, scratch, k)
        edges = _Edges(sums, first, self._row(emit, scratch, integer(1)), row_before)
        self._operate(emit, known, self.early, row, scratch, edges, order, inverse)
        ahead = {pair: edges.ahead(pair, row) for pair in self.sums_ahead}
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
        _, (a, lam) = lower(emit, solution.solved, [*r, *c, *kept], self.numbers)
        per_v, per_q = emit.multiply(unit, inverse), emit.divide(unit, emit.number(following))
        before = Quantities(emit, lambda i: zero)  # a and lam of the previous order
        for j in range(n):
            v = emit.multiply(per_v, a[j])
            known.define(1 + n + j, v)
            emit.store(emit.multiply(per_q, v), emit.pointer(out, builder.mul(following, integer(n))), j)
            before.define(1 + 2 * n + j, a[j])
        for i in range(self.n_rows):
            before.define(1 + 3 * n + i, lam[i])
        for operations, values, into in ((self.early, known, row), (self.late, before, row_before)):
            for operation in operations:
                if operation.kind == PENDING and operation.results[0] not in self._carried:
                    into.store(operation.second, values.sum(operation.second[0]))
        self._operate(emit, known, self.late, row, scratch, edges, order, inverse)
        for place, (terms, _) in self.balance:
            emit.store(known.sum(terms), scratch, self.r + place)

    def _row(self, emit: LaneEmitter, scratch: Value, order: Value) -> Value:
        return emit.pointer(scratch, self.table, emit.builder.mul(order, integer(self.width)))

    def _begin(
        self, emit: LaneEmitter, known: Quantities, operations: list[Operation], row: "_Row", scratch: Value
    ) -> None:
        """Write order 0, the values of the functions; factors of pending products are stored when they are known."""
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
                values = list(sine_and_cosine(emit, x))
            elif kind == RECIPROCAL:
                values = [emit.divide(one, x)]
            else:
                values = [emit.function(FUNCTIONS[kind], x)]
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

    def _sums(self, emit: LaneEmitter, scratch: Value, k: Value) -> dict[tuple[tuple[int, int], bool], Value]:
        """Sum X[j] Y[k - j] over 1 < j < k for pairs of factors; for the pairs in `sums_ahead`, sum X[j] Y[k + 1 - j].

        The terms at the edges are added when they are known (see `_Edges`). So one loop computes several sums, does not
        wait for the previous order, and loads each row once.
        """
        builder = emit.builder
        wanted = [(pair, True) for pair in self.sums_ahead]
        pairs = {pair for each in (*self.early, *self.late) for pair in self._factors(each)}
        wanted += [(pair, False) for pair in pairs - set(self.sums_ahead)]
        wanted.sort(key=lambda each: each[0][::-1] if each[1] else each[0])  # neighbours in this order share a row
        sums: dict[tuple[tuple[int, int], bool], Value] = {}
        following = builder.add(k, integer(1))
        for begin in range(0, len(wanted), AT_ONCE):
            some = wanted[begin : begin + AT_ONCE]
            with emit.loop(integer(2), k, [emit.constant(0.0)] * len(some)) as (j, totals, new):
                up, down = self._row(emit, scratch, j), self._row(emit, scratch, builder.sub(following, j))
                below = self._row(emit, scratch, builder.sub(j, integer(1)))
                loaded: dict[tuple[Value, int], Value] = {}
                for ((x, y), ahead), total in zip(some, totals, strict=True):
                    places = ((up, x), (down, y)) if ahead else ((down, x), (below, y))
                    for base, place in places:
                        if (base, place) not in loaded:
                            loaded[base, place] = emit.load(base, place)
                    new.append(emit.add(total, emit.multiply(*(loaded[each] for each in places))))
            sums |= dict(zip(some, new, strict=True))
        return sums

    def _operate(
        self,
        emit: LaneEmitter,
        known: Quantities,
        operations: list[Operation],
        row: "_Row",
        scratch: Value,
        edges: "_Edges",
        order: Value,
        inverse: Value,
    ) -> None:
        """Write the operations for an order above 0; for pending products, the part that is already known."""
        pairs = list(dict.fromkeys(pair for operation in operations for pair in self._factors(operation)))
        sums = {}
        for pair in pairs:
            if pair in self.sums_ahead:
                sums[pair] = emit.load(scratch, self.carried + self.sums_ahead.index(pair))
            else:
                sums[pair] = edges.now(pair)
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


class _Row:
    """Row of the factors of one order; a factor that was stored here is not loaded again."""

    def __init__(self, code: LaneSeries, emit: LaneEmitter, base: Value):
        self.code, self.emit, self.base = code, emit, base
        self._stored: dict[int, Value] = {}

    def store(self, key: Any, value: Value, when: str = "") -> None:
        """Store a factor at its index; "if used": only if it has one."""
        place = self.code.slots.get(tuple(key)) if when else self.code.slots[tuple(key)]
        if place is not None and place not in self._stored:
            self._stored[place] = value
            self.emit.store(value, self.base, place)

    def load(self, place: int) -> Value:
        """Return the factor at an index."""
        return self._stored[place] if place in self._stored else self.emit.load(self.base, place)


class _Edges(NamedTuple):
    """Terms that the sums of order k still lack; `first` is the row of order 1, or zeros if k is 1."""

    sums: dict[tuple[tuple[int, int], bool], Value]
    first: Value
    one: Value  # the row of order 1
    before: _Row  # the row of order k - 1

    def now(self, pair: tuple[int, int]) -> Value:
        """Return the sum of X[j] Y[k - j] over 0 < j < k."""
        emit, (x, y) = self.before.emit, pair
        return emit.add(self.sums[pair, False], emit.multiply(emit.load(self.first, x), self.before.load(y)))

    def ahead(self, pair: tuple[int, int], row: _Row) -> Value:
        """Return the sum of X[j] Y[k + 1 - j] over 0 < j <= k, from the row of order k."""
        emit, (x, y) = self.before.emit, pair
        total = emit.add(self.sums[pair, True], emit.multiply(row.load(x), emit.load(self.first, y)))
        return emit.add(total, emit.multiply(emit.load(self.one, x), row.load(y)))

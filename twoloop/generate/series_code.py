"""The series of one mechanism as code compiled for it: the same numbers as by the program, in a fraction of the time.

What the program looks up at every order, which quantity times which coefficient, stands in the code, which goes to LLVM
as a straight line of operations for one order.

The factors X and Y of all products stand in rows, one for each order, so that sums of products of known coefficients
are vector operations. What a processor has stored number by number it cannot read as a vector at once. So vectors are
put together in registers, and the newest coefficients come last in the sums.
"""

from typing import Any

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import ONE, SLACK, ZERO, Emitter, Quantities
from twoloop.generate.llvm_text import Value, integer
from twoloop.generate.series import SeriesProgram
from twoloop.generate.series_groups import WIDTH, Group, Groups, rounded
from twoloop.generate.written import FUNCTIONS
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    LOGARITHM,
    PENDING,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
)

AT_ONCE = 8  # vectors that are summed in one loop, in registers


class SeriesCode:
    """Writes the code of a program.

    `scratch` holds, from an aligned place on, the results of early operations that late ones use; velocities; for each
    operation that divides an inverse; a row of zeros; and the rows of orders 0, 1 and so on. A row is X and Y.
    """

    def __init__(self, program: SeriesProgram, numbers: Coefficients):
        self.n, self.n_rows, self.numbers = program.n_q, program.n_rows, numbers
        self.groups = groups = Groups(program, numbers)
        self.width, self.first, self.kept = groups.width, groups.first, groups.kept
        self.velocities = rounded(groups.n_early)
        self.inverses = self.velocities + rounded(self.n)
        self.zeros = self.inverses + self.width
        self.table = self.zeros + 2 * self.width

    def scratch_size(self, order: int) -> int:
        """Length of `scratch` for a series of this order."""
        return SLACK + self.table + 2 * self.width * (order + 1)

    def begin(
        self,
        emit: Emitter,
        scratch: Value,
        series: Value,
        r: Value,
        c: Value,
        lam: Value,
        t: Value,
        unit: Value,
        state: Value,
        numbers: Value,
    ) -> None:
        """What is known of the orders 0 and 1, and the early operations of order 0; r, c and lam are zero."""
        base, emit.numbers = emit.aligned(scratch), numbers
        zeros = emit.vector([ZERO] * WIDTH)
        for place in range(0, 2 * self.width, WIDTH):
            emit.store_vector(zeros, base, self.zeros + place)
        for size, out in ((self.n, r), (self.n_rows, c), (self.n_rows, lam)):
            for i in range(size):
                emit.store(ZERO, out, i)
        known = Quantities(emit, lambda i: emit.load(state, i - 1) if i else t)
        for j in range(self.n):
            q, v = known.value(1 + j), known.value(1 + self.n + j)
            emit.store(q, series, j)
            emit.store(emit.multiply(unit, v), series, self.n + j)
            emit.store(v, base, self.velocities + j)
        for group in self.groups.early:
            self._begin_group(emit, base, known, group)
            if group.pending:
                self._store_waiting(emit, known, group, emit.pointer(base, self.table))
        self._keep(emit, base, known)

    def find_order(
        self,
        emit: Emitter,
        scratch: Value,
        series: Value,
        r: Value,
        c: Value,
        t: Value,
        unit: Value,
        order: Value,
        numbers: Value,
    ) -> None:
        """Late operations of the order before and early ones of this order, as far as they are known; r and c."""
        base, before, emit.numbers = emit.aligned(scratch), emit.builder.sub(order, integer(1)), numbers
        q = emit.pointer(series, emit.builder.mul(order, integer(self.n)))
        sums = self._sums_of_products(emit, base, order)
        is_first = emit.builder.compare("icmp eq", order, integer(1))
        with emit.builder.if_else(is_first) as (then, otherwise):
            with then:
                known = self._quantities_before(emit, base, q, t)
                for group in self.groups.late:
                    self._begin_group(emit, base, known, group)
                for place, terms, constant in self.groups.balance:
                    emit.store(known.sum(terms, constant), r, place)
            with otherwise:
                known = self._quantities_before(emit, base, q, self._time(emit, unit, before))
                self._operate(emit, base, known, self.groups.late, sums, before)
                for place, terms, _ in self.groups.balance:
                    emit.store(known.sum(terms), r, place)
        time = self._time(emit, unit, order)
        known = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time)
        self._operate(emit, base, known, self.groups.early, sums, order)
        scale = emit.negative(emit.divide(emit.number(order), unit))
        for place, terms, _ in self.groups.rows:
            emit.store(emit.multiply(scale, known.sum(terms)), c, place)
        self._keep(emit, base, known)

    def take_order(
        self,
        emit: Emitter,
        scratch: Value,
        series: Value,
        a: Value,
        lam: Value,
        unit: Value,
        order: Value,
        numbers: Value,
    ) -> None:
        """Velocities of this order and positions of the next, from accelerations; the factors that waited for them."""
        emit.numbers = numbers
        n, base, following = self.n, emit.aligned(scratch), emit.builder.add(order, integer(1))
        next_q = emit.pointer(series, emit.builder.mul(following, integer(n)))
        per_v, per_q = (emit.divide(unit, emit.number(each)) for each in (order, following))

        def load(i: int) -> Value:
            return emit.load(a, i - 1 - 2 * n) if i <= 3 * n else emit.load(lam, i - 1 - 3 * n)

        known = Quantities(emit, load)
        for j in range(n):
            v = emit.multiply(per_v, known.value(1 + 2 * n + j))
            known.define(1 + n + j, v)
            if 1 + n + j in self.kept:
                emit.store(v, base, self.velocities + j)
            emit.store(emit.multiply(per_q, v), next_q, j)
        before = emit.builder.sub(order, integer(1))
        for groups, of in ((self.groups.early, order), (self.groups.late, before)):
            for group in groups:
                if group.pending:
                    self._store_waiting(emit, known, group, self._row(emit, base, of))

    def _row(self, emit: Emitter, base: Value, order: Value) -> Value:
        return emit.pointer(base, self.table, emit.builder.mul(order, integer(2 * self.width)))

    def _time(self, emit: Emitter, unit: Value, order: Value) -> Value:
        """The coefficient of the time, of an order that is not 0."""
        return emit.builder.select(emit.builder.compare("icmp eq", order, integer(1)), unit, ZERO)

    def _quantities_before(self, emit: Emitter, base: Value, q: Value, time: Value) -> Quantities:
        """Of the order before that of q, from where they are kept."""

        def load(i: int) -> Value:
            if i == 0:
                return time
            if i <= self.n:
                return emit.load(q, i - 1 - self.n)
            return emit.load(base, self.velocities + i - 1 - self.n if i < self.first else i - self.first)

        return Quantities(emit, load)

    def _keep(self, emit: Emitter, base: Value, known: Quantities) -> None:
        for i in range(self.first, self.first + self.groups.n_early):
            if i in self.kept:
                emit.store(known.value(i), base, i - self.first)

    def _store_waiting(self, emit: Emitter, known: Quantities, group: Group, row: Value) -> None:
        y = emit.vector([known.sum(each.terms) for each in group.second])
        emit.store_vector(y, row, self.width + group.place)

    def _sums_of_products(self, emit: Emitter, base: Value, order: Value) -> dict[int, Value]:
        """For groups, by place, the sum of X[j] Y[m - j] over 0 < j < m; m is the order, of late ones one less."""
        builder = emit.builder
        groups = [(group, 0) for group in self.groups.early] + [(group, 1) for group in self.groups.late]
        nothing = emit.pointer(base, self.zeros)
        one, two, before, before_it = integer(1), integer(2), *(builder.sub(order, integer(i)) for i in (1, 2))

        def rows(j: Value, m: Value, least: int) -> tuple[Value, Value]:
            """Rows of X[j] and Y[m - j], or zeros where m is less than `least`."""
            there = builder.compare("icmp sge", m, integer(least))
            x, y = self._row(emit, base, j), self._row(emit, base, builder.sub(m, j))
            return builder.select(there, x, nothing), builder.select(there, y, nothing)

        def with_product(total: Value, x: Value, y: Value, group: Group) -> Value:
            x, y = (
                emit.load_vector(x, group.place, group.width),
                emit.load_vector(y, self.width + group.place, group.width),
            )
            return emit.add(total, emit.multiply(x, y))

        sums: dict[int, Value] = {}
        for begin in range(0, len(groups), AT_ONCE):
            some = groups[begin : begin + AT_ONCE]
            zeros = [emit.vector([ZERO] * group.width) for group, _ in some]
            with emit.loop(two, before_it, zeros) as (j, totals, new):
                x, y = self._row(emit, base, j), self._row(emit, base, builder.sub(order, j))
                for (group, late), total in zip(some, totals, strict=True):
                    new.append(with_product(total, x, emit.pointer(y, -2 * self.width * late), group))
            sums |= {group.place: total for (group, _), total in zip(some, new, strict=True)}
        last = [
            [rows(before_it, order, 4), rows(before, order, 3), rows(one, order, 2)],
            [rows(before_it, before, 3), rows(one, before, 2)],
        ]
        for group, late in groups:
            for pair in last[late]:
                sums[group.place] = with_product(sums[group.place], *pair, group)
        return sums

    def _begin_group(self, emit: Emitter, base: Value, known: Quantities, group: Group) -> None:
        """Order 0: the functions themselves; what waits stays zero."""
        kind, table, half = group.kind, emit.pointer(base, self.table), group.width // 2
        first = [known.sum(*each) for each in group.first]
        second = [ZERO if group.pending else known.sum(*each) for each in group.second]
        x, y = emit.vector(first), emit.vector(second)
        ones, divisor = emit.vector([ONE] * group.width), None
        if kind == PENDING:
            results = second
        elif kind == PRODUCT:
            results = emit.elements(emit.multiply(x, y))
        elif kind == SINE:
            sines, cosines = ([emit.function(name, each) for each in first[:half]] for name in ("sin", "cos"))
            results, y = [*sines, *cosines], emit.vector([*cosines, *map(emit.negative, sines)])
        elif kind == RECIPROCAL:
            y = emit.divide(ones, x)
            results = emit.elements(y)
        else:
            results = [emit.function(FUNCTIONS[kind], each) for each in first]
            if kind in (LOGARITHM, ARCTANGENT):
                divisor = y
            else:
                y = emit.vector(results)
            if kind == SQUARE_ROOT:
                divisor = emit.add(y, y)
        if divisor is not None:
            emit.store_vector(emit.divide(ones, divisor), base, self.inverses + group.place)
        for quantity, result in zip(group.quantities, results, strict=True):
            known.define(quantity, result)
        emit.store_vector(x, table, group.place)
        if not group.pending:
            emit.store_vector(y, table, self.width + group.place)

    def _operate(
        self,
        emit: Emitter,
        base: Value,
        known: Quantities,
        groups: list[Group],
        sums: dict[int, Value],
        order: Value,
    ) -> None:
        """An order that is not 0; of what waits, what is known before."""
        row, number = self._row(emit, base, order), emit.number(order)
        inverse = emit.divide(ONE, number)
        for group in groups:
            known_factors = [emit.vector([known.sum(each.terms) for each in group.first])]
            if group.kind in (PRODUCT, LOGARITHM, ARCTANGENT):
                known_factors.append(emit.vector([known.sum(each.terms) for each in group.second]))
            scales = (emit.vector([each] * group.width) for each in (number, inverse))
            results, x, y = self._recurrence(emit, base, group, sums[group.place], *scales, *known_factors)
            for quantity, value in zip(group.quantities, emit.elements(results), strict=True):
                known.define(quantity, value)
            emit.store_vector(x, row, group.place)
            if not group.pending:
                emit.store_vector(y, row, self.width + group.place)

    def _recurrence(
        self,
        emit: Emitter,
        base: Value,
        group: Group,
        total: Value,
        number: Value,
        inverse: Value,
        u: Value,
        z: Any = None,
    ) -> tuple[Value, Value, Any]:
        """Results and factors X and Y of order `number`, from arguments u and z and the sum of products."""

        def at(place: int) -> Value:
            return emit.load_vector(base, place + group.place, group.width)

        def with_last(x: Value) -> Value:
            """The sum of products with that of X of this order."""
            return emit.add(total, emit.multiply(x, at(self.table + self.width)))

        kind = group.kind
        if kind == PENDING:
            return with_last(u), u, None
        if kind == PRODUCT:
            return emit.add(with_last(u), emit.multiply(at(self.table), z)), u, z
        if kind == RECIPROCAL:
            y = emit.negative(emit.multiply(with_last(u), at(self.table + self.width)))
            return y, u, y
        if kind == SQUARE_ROOT:
            x = emit.multiply(emit.subtract(u, total), at(self.inverses))
            return x, x, x
        if kind in (LOGARITHM, ARCTANGENT):
            result = emit.multiply(emit.subtract(u, emit.multiply(total, inverse)), at(self.inverses))
            return result, emit.multiply(number, result), z
        x = emit.multiply(number, u)
        result = y = emit.multiply(with_last(x), inverse)
        if kind == SINE:
            each, half = emit.elements(result), group.width // 2
            y = emit.vector([*each[half:], *map(emit.negative, each[:half])])
        return result, x, y

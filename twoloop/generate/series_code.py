"""The series of one mechanism as code compiled for it: the same numbers as by the program, in a fraction of the time.

What the program looks up at every order, which quantity times which coefficient, stands in the code, which goes to LLVM
as a straight line of operations for one order.

The factors X and Y of all products stand in rows, one for each order, so that sums of products of known coefficients
are vector operations. What a processor has stored number by number it cannot read as a vector at once. So vectors are
put together in registers, and the newest coefficients come last in the sums.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import ONE, SLACK, ZERO, Emitter, Quantities
from twoloop.generate.llvm_text import Module, Value, integer, width_of
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

    @property
    def structure(self) -> tuple[object, ...]:
        """All that the code depends on, the values of its numbers apart."""
        return self.n, self.n_rows, self.groups.structure

    def write_parts(self, module: Module) -> None:
        """Put functions into a module that the others call: there are none."""

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
                self._operate(emit, base, known, self.groups.late, order, late=True)
                for place, terms, _ in self.groups.balance:
                    emit.store(known.sum(terms), r, place)
        time = self._time(emit, unit, order)
        known = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time)
        self._operate(emit, base, known, self.groups.early, order)
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

    def _ends(self, emit: Emitter, base: Value, order: Value, late: bool) -> list[tuple[Value, Value]]:
        """Rows of X[j] and Y[m - j], zeros where there are none, for those j < m that come last in sums of products.

        m is the order, of late operations one less.
        """
        builder = emit.builder
        nothing = emit.pointer(base, self.zeros)
        one, before, before_it = integer(1), *(builder.sub(order, integer(i)) for i in (1, 2))
        m = before if late else order
        ends = [(before_it, 3), (one, 2)] if late else [(before_it, 4), (before, 3), (one, 2)]  # j, and the least m
        made = []
        for j, least in ends:
            there = builder.compare("icmp sge", m, integer(least))
            x, y = self._row(emit, base, j), self._row(emit, base, builder.sub(m, j))
            made.append((builder.select(there, x, nothing), builder.select(there, y, nothing)))
        return made

    def _sums_of_products(
        self, emit: Emitter, base: Value, order: Value, groups: list[Group], ends: list[tuple[Value, Value]], late: bool
    ) -> list[Value]:
        """For groups, the sum of X[j] Y[m - j] over 0 < j < m; m is the order, of late ones one less."""

        def with_products(totals: list[Value], x: Value, y: Value) -> list[Value]:
            made = []
            for group, total in zip(groups, totals, strict=True):
                factor = emit.load_vector(x, group.place, group.width)
                other = emit.load_vector(y, self.width + group.place, group.width)
                made.append(emit.add(total, emit.multiply(factor, other)))
            return made

        zeros = [emit.vector([ZERO] * group.width) for group in groups]
        before_it = emit.builder.sub(order, integer(2))
        with emit.loop(integer(2), before_it, zeros) as (j, totals, sums):
            x, y = self._row(emit, base, j), self._row(emit, base, emit.builder.sub(order, j))
            sums += with_products(totals, x, emit.pointer(y, -2 * self.width) if late else y)
        for pair in ends:
            sums = with_products(sums, *pair)
        return sums

    def _begin_group(self, emit: Emitter, base: Value, known: Quantities, group: Group) -> None:
        """Order 0: the functions themselves; what waits stays zero."""
        table = emit.pointer(base, self.table)
        first = [known.sum(*each) for each in group.first]
        second = [ZERO if group.pending else known.sum(*each) for each in group.second]
        results, x, y, inverse = begun(emit, group.kind, first, second)
        if inverse is not None:
            emit.store_vector(inverse, base, self.inverses + group.place)
        for quantity, result in zip(group.quantities, results, strict=True):
            known.define(quantity, result)
        emit.store_vector(x, table, group.place)
        if not group.pending:
            emit.store_vector(y, table, self.width + group.place)

    def _operate(
        self, emit: Emitter, base: Value, known: Quantities, groups: list[Group], last: Value, late: bool = False
    ) -> None:
        """The order `last`, of late operations one less, that is not 0; of what waits, what is known before."""
        order = emit.builder.sub(last, integer(1)) if late else last
        row, number = self._row(emit, base, order), emit.number(order)
        inverse, ends = emit.divide(ONE, number), self._ends(emit, base, last, late)
        for begin in range(0, len(groups), AT_ONCE):
            some = groups[begin : begin + AT_ONCE]
            sums = self._sums_of_products(emit, base, last, some, ends, late)
            for group, total in zip(some, sums, strict=True):
                self._operate_on(emit, base, known, group, total, row, number, inverse)

    def _operate_on(
        self,
        emit: Emitter,
        base: Value,
        known: Quantities,
        group: Group,
        total: Value,
        row: Value,
        number: Value,
        inverse: Value,
    ) -> None:
        """One group, with the sum of its products and the row of the order."""
        known_factors = [emit.vector([known.sum(each.terms) for each in group.first])]
        if group.kind in (PRODUCT, LOGARITHM, ARCTANGENT):
            known_factors.append(emit.vector([known.sum(each.terms) for each in group.second]))
        scales = (emit.vector([each] * group.width) for each in (number, inverse))

        def at(place: int) -> Value:
            return emit.load_vector(base, place + group.place, group.width)

        places = self.table, self.table + self.width, self.inverses
        results, x, y = recurrence(emit, group.kind, at, places, total, *scales, *known_factors)
        for quantity, value in zip(group.quantities, emit.elements(results), strict=True):
            known.define(quantity, value)
        emit.store_vector(x, row, group.place)
        if not group.pending:
            emit.store_vector(y, row, self.width + group.place)


class Begun(NamedTuple):
    """Operations of order 0."""

    results: list[Value]
    x: Value
    y: Value
    inverse: Value | None  # of what the recurrence divides by


def begun(emit: Emitter, kind: int, first: list[Value], second: list[Value]) -> Begun:
    """The functions themselves of their arguments, side by side; what waits stays zero."""
    x, y, half = emit.vector(first), emit.vector(second), len(first) // 2
    ones, divisor = emit.vector([ONE] * len(first)), None
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
    return Begun(results, x, y, None if divisor is None else emit.divide(ones, divisor))


def recurrence(
    emit: Emitter,
    kind: int,
    at: Callable[[int], Value],
    places: tuple[int, int, int],
    total: Value,
    number: Value,
    inverse: Value,
    u: Value,
    z: Any = None,
) -> tuple[Value, Value, Any]:
    """Results and factors X and Y of order `number`, from arguments u and z and the sum of products.

    `at` loads what stands at one of the places: X and Y of order 0, and the inverse of what is divided by.
    """
    x0, y0, inverses = places

    def with_last(x: Value) -> Value:
        """The sum of products with that of X of this order."""
        return emit.add(total, emit.multiply(x, at(y0)))

    if kind == PENDING:
        return with_last(u), u, None
    if kind == PRODUCT:
        return emit.add(with_last(u), emit.multiply(at(x0), z)), u, z
    if kind == RECIPROCAL:
        y = emit.negative(emit.multiply(with_last(u), at(y0)))
        return y, u, y
    if kind == SQUARE_ROOT:
        x = emit.multiply(emit.subtract(u, total), at(inverses))
        return x, x, x
    if kind in (LOGARITHM, ARCTANGENT):
        result = emit.multiply(emit.subtract(u, emit.multiply(total, inverse)), at(inverses))
        return result, emit.multiply(number, result), z
    x = emit.multiply(number, u)
    result = y = emit.multiply(with_last(x), inverse)
    if kind == SINE:
        each, half = emit.elements(result), width_of(result.type) // 2
        y = emit.vector([*each[half:], *map(emit.negative, each[:half])])
    return result, x, y

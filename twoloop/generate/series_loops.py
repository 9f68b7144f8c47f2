"""The series of a long mechanism as loops over tables: code whose length does not grow with the operations.

The operations of a run are done in a loop, four side by side, that reads from `loop_tables` which quantities times
which coefficients it takes. All quantities of an order stand in memory, where those of long equations are in any case.
The sums of products of known coefficients are a loop over all operations at once.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import ONE, SLACK, ZERO, Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, INTEGER, Module, Value, integer
from twoloop.generate.loop_tables import UNROLLED, Forms, LoopTables, Run, Scattered, Side
from twoloop.generate.series import SeriesProgram
from twoloop.generate.series_code import AT_ONCE, begun, recurrence
from twoloop.generate.series_groups import WIDTH
from twoloop.kernels.evaluation.operations import PENDING, PRODUCT, SUM

ARRAY, TRUE = f"{DOUBLE}*", Value(BIT, "true")
SIDE_BY_SIDE = 2  # groups of a run that are done in one turn of a loop, so that one need not wait for the other


class SeriesLoops:
    """Writes the code of a program; as `SeriesCode`.

    `scratch` holds, from an aligned place on, all quantities of an order; for each operation that divides an inverse;
    sums of products; a row of zeros; and the rows of orders 0, 1 and so on. A row is X and Y.
    """

    def __init__(self, program: SeriesProgram, numbers: Coefficients):
        self.n, self.n_rows, self.numbers = program.n_q, program.n_rows, numbers
        made = LoopTables(program, numbers)
        self.early, self.late, self.rows, self.balance = made.early, made.late, made.rows, made.balance
        self.width = self.late.end
        self.inverses = made.n_quantities
        self.totals = self.inverses + self.width
        self.zeros = self.totals + self.width
        self.table = self.zeros + self.width

    @property
    def structure(self) -> tuple[object, ...]:
        """All that the code depends on, the values of its numbers apart."""
        return self.n, self.n_rows, self.early, self.late, self.rows, self.balance

    def scratch_size(self, order: int) -> int:
        """Length of `scratch` for a series of this order."""
        return SLACK + self.table + 2 * self.width * (order + 1)

    # functions

    def write_parts(self, module: Module) -> None:
        """Put the functions into a module that the others call."""
        kind = BIT, [ARRAY, INTEGER, ARRAY]
        for name, side in (("early", self.early), ("late", self.late)):
            builder = module.function(name, *kind, internal=True)
            self._operate(Emitter(builder), side, *builder.arguments)
            builder.ret(TRUE)

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
        base, n, emit.numbers = emit.aligned(scratch), self.n, numbers
        for size, out in ((self.width, emit.pointer(base, self.zeros)), (n, r), (self.n_rows, c), (self.n_rows, lam)):
            with emit.loop(integer(0), integer(size), []) as (j, _, _):
                emit.store(ZERO, emit.pointer(out, j))
        emit.store(t, base)
        with emit.loop(integer(0), integer(n), []) as (j, _, _):
            here, out = emit.pointer(state, j), emit.pointer(series, j)
            q, v = emit.load(here), emit.load(here, n)
            for value, place, k in ((q, out, 0), (emit.multiply(unit, v), out, n)):
                emit.store(value, place, k)
            for value, k in ((q, 1), (v, 1 + n)):
                emit.store(value, emit.pointer(base, j), k)
        emit.builder.call("early", BIT, [base, integer(0), numbers])
        self._take_waiting(emit, base, self.early, integer(0))

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
        builder, base, before, emit.numbers = (
            emit.builder,
            emit.aligned(scratch),
            emit.builder.sub(order, integer(1)),
            numbers,
        )
        is_first = builder.compare("icmp eq", order, integer(1))
        builder.call("late", BIT, [base, before, numbers])
        self._scatter(emit, base, self.balance, r, ONE, builder.select(is_first, ONE, ZERO))
        emit.store(builder.select(is_first, unit, ZERO), base)
        q = emit.pointer(series, builder.mul(order, integer(self.n)))
        self._copy(emit, q, emit.pointer(base, 1), self.n)
        builder.call("early", BIT, [base, order, numbers])
        self._scatter(emit, base, self.rows, c, emit.negative(emit.divide(emit.number(order), unit)), None)

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
        builder, n, emit.numbers = emit.builder, self.n, numbers
        base, following = emit.aligned(scratch), builder.add(order, integer(1))
        next_q = emit.pointer(series, builder.mul(following, integer(n)))
        per_v, per_q = (emit.divide(unit, emit.number(each)) for each in (order, following))
        with emit.loop(integer(0), integer(n), []) as (j, _, _):
            found, here = emit.load(emit.pointer(a, j)), emit.pointer(base, j)
            v = emit.multiply(per_v, found)
            emit.store(found, here, 1 + 2 * n)
            emit.store(v, here, 1 + n)
            emit.store(emit.multiply(per_q, v), emit.pointer(next_q, j))
        self._copy(emit, lam, emit.pointer(base, 1 + 3 * n), self.n_rows)
        self._take_waiting(emit, base, self.early, order)
        self._take_waiting(emit, base, self.late, builder.sub(order, integer(1)))

    # their parts

    def _copy(self, emit: Emitter, source: Value, target: Value, size: int) -> None:
        with emit.loop(integer(0), integer(size), []) as (j, _, _):
            emit.store(emit.load(emit.pointer(source, j)), emit.pointer(target, j))

    def _row(self, emit: Emitter, base: Value, order: Value) -> Value:
        return emit.pointer(base, self.table, emit.builder.mul(order, integer(2 * self.width)))

    def _operate(self, emit: Emitter, side: Side, base: Value, order: Value, numbers: Value) -> None:
        """An order of all operations of one side."""
        emit.numbers, is_first = numbers, emit.builder.compare("icmp eq", order, integer(0))
        self._sum_products(emit, side, base, order)
        constant = emit.builder.select(is_first, ONE, ZERO)
        for run in side.runs:
            with _turns(emit, run.n_groups, SIDE_BY_SIDE) as (first, few):
                arguments = [self._gathered(emit, base, forms, first, few, constant) for forms in run.forms]
                self._turn(emit, run, base, first, arguments, order, is_first)

    def _sum_products(self, emit: Emitter, side: Side, base: Value, order: Value) -> None:
        """The sums of X[j] Y[order - j] over 0 < j < order."""
        with _turns(emit, (side.end - side.begin) // WIDTH, AT_ONCE) as (first, few):
            here = emit.pointer(base, side.begin, emit.builder.mul(first, integer(WIDTH)))
            zeros = [emit.vector([ZERO] * WIDTH)] * few
            with emit.loop(integer(1), order, zeros) as (j, totals, sums):
                x, y = self._row(emit, here, j), self._row(emit, here, emit.builder.sub(order, j))
                for k, total in enumerate(totals):
                    factor = emit.load_vector(x, WIDTH * k, WIDTH)
                    other = emit.load_vector(y, self.width + WIDTH * k, WIDTH)
                    sums.append(emit.add(total, emit.multiply(factor, other)))
            for k, total in enumerate(sums):
                emit.store_vector(total, here, self.totals + WIDTH * k)

    def _turn(
        self,
        emit: Emitter,
        run: Run,
        base: Value,
        first: Value,
        arguments: list[list[Value]],
        order: Value,
        is_first: Value,
    ) -> None:
        """Some groups of a run, from the first of these on, with their arguments."""
        builder, (u, z) = emit.builder, (arguments[0], arguments[-1])
        here = emit.pointer(base, builder.mul(first, integer(WIDTH)))
        row, out = self._row(emit, here, order), emit.pointer(here, run.quantity)
        at = [run.place + WIDTH * k for k in range(len(u))]
        if run.kind == SUM:
            for k, total in enumerate(u):
                self._store(emit, total, out, WIDTH * k)
            return
        if run.kind in (PRODUCT, PENDING):
            nothing = emit.pointer(here, self.zeros)
            if run.kind == PRODUCT:
                for k, place in enumerate(at):
                    emit.store_vector(z[k], row, self.width + place)  # which is Y[0] of order 0
                x0 = builder.select(is_first, nothing, emit.pointer(here, self.table))
                y0 = emit.pointer(here, self.table + self.width)
            else:
                y0 = builder.select(is_first, nothing, emit.pointer(here, self.table + self.width))
            made = []
            for k, place in enumerate(at):
                total = emit.load_vector(here, self.totals + place, WIDTH)
                total = emit.add(total, emit.multiply(u[k], emit.load_vector(y0, place, WIDTH)))
                if run.kind == PRODUCT:
                    total = emit.add(total, emit.multiply(emit.load_vector(x0, place, WIDTH), z[k]))
                made.append(total)
            for k, place in enumerate(at):
                emit.store_vector(u[k], row, place)
                self._store(emit, made[k], out, WIDTH * k)
            return
        with builder.if_else(is_first) as (then, otherwise):
            with then:
                for k, place in enumerate(at):
                    found = begun(emit, run.kind, emit.elements(u[k]), emit.elements(z[k]))
                    if found.inverse is not None:
                        emit.store_vector(found.inverse, here, self.inverses + place)
                    self._put(emit, run, base, out, first, k, found.results)
                    emit.store_vector(found.x, row, place)
                    emit.store_vector(found.y, row, self.width + place)
            with otherwise:
                order_of = emit.number(order)
                number, inverse = (emit.vector([each] * WIDTH) for each in (order_of, emit.divide(ONE, order_of)))
                for k, place in enumerate(at):

                    def there(begin: int, place: int = place) -> Value:
                        return emit.load_vector(here, begin + place, WIDTH)

                    places = self.table, self.table + self.width, self.inverses
                    total = there(self.totals)
                    results, x, y = recurrence(emit, run.kind, there, places, total, number, inverse, u[k], z[k])
                    self._put(emit, run, base, out, first, k, emit.elements(results))
                    emit.store_vector(x, row, place)
                    emit.store_vector(y, row, self.width + place)

    def _put(
        self, emit: Emitter, run: Run, base: Value, out: Value, first: Value, k: int, results: list[Value]
    ) -> None:
        """Results of a group into their places."""
        if run.results:
            self._store_at(emit, results, base, run.results, first, k)
        else:
            self._store(emit, emit.vector(results), out, WIDTH * k)

    def _store(self, emit: Emitter, vector: Value, base: Value, place: int) -> None:
        """Four numbers side by side, at any place."""
        pointer = emit.builder.convert("bitcast", emit.pointer(base, place), f"{vector.type}*")
        emit.builder.store(vector, pointer)

    def _store_at(
        self, emit: Emitter, values: Sequence[Value], base: Value, places: list[int], first: Value, k: int
    ) -> None:
        """Four numbers at places of their own."""
        table = emit.builder.gep(emit.builder.module.table(places), emit.builder.mul(first, integer(WIDTH)))
        for lane, value in enumerate(values):
            emit.store(value, self._by_table(emit, base, table, WIDTH * k + lane))

    def _by_table(self, emit: Emitter, base: Value, table: Value, place: int) -> Value:
        """A pointer as far from the base as a table says."""
        column = emit.builder.load(emit.builder.gep(table, integer(place)), 4, constant=True)
        return emit.pointer(base, emit.builder.convert("sext", column, INTEGER))

    def _gathered(
        self, emit: Emitter, base: Value, forms: Forms, first: Value, few: int, constant: Value | None
    ) -> list[Value]:
        """The forms of some groups, four side by side, with a multiple of their constants."""
        builder, n_terms, zeros = emit.builder, forms.n_terms, emit.vector([ZERO] * WIDTH)
        totals = [zeros] * few
        if n_terms:
            begin = builder.mul(first, integer(WIDTH * n_terms))
            table = builder.gep(builder.module.table(forms.columns), begin)
            numbers = emit.numbers if forms.factors else emit.pointer(emit.numbers, forms.coefficients, begin)
            if n_terms <= UNROLLED:
                for t in range(n_terms):
                    totals = self._with_term(emit, base, forms, table, numbers, totals, t)
            else:
                with emit.loop(integer(0), integer(n_terms), totals) as (term, before, sums):
                    place = builder.mul(term, integer(WIDTH))
                    there = builder.gep(table, place)
                    own = numbers if forms.factors else emit.pointer(numbers, place)
                    sums += self._with_term(emit, base, forms, there, own, before, 0)
                totals = sums
        if constant is not None and forms.constants is not None:
            scale = emit.vector([constant] * WIDTH)
            own = emit.pointer(emit.numbers, forms.constants, builder.mul(first, integer(WIDTH)))
            for k in range(few):
                totals[k] = emit.add(totals[k], emit.multiply(scale, self._load(emit, own, WIDTH * k)))
        return totals

    def _with_term(
        self, emit: Emitter, base: Value, forms: Forms, table: Value, numbers: Value, totals: Sequence[Value], t: int
    ) -> list[Value]:
        """Sums with one term more."""
        made = []
        for k, total in enumerate(totals):
            place = WIDTH * (k * forms.n_terms + t)
            x = emit.vector(
                [emit.builder.load(self._by_table(emit, base, table, place + lane)) for lane in range(WIDTH)]
            )
            if forms.factors is None:
                made.append(emit.add(total, emit.multiply(self._load(emit, numbers, place), x)))
            else:
                made.append((emit.add if forms.factors[t] == 1.0 else emit.subtract)(total, x))
        return made

    def _load(self, emit: Emitter, base: Value, place: int) -> Value:
        """Four numbers that never change, side by side, at any place."""
        kind = emit.vector([ZERO] * WIDTH).type
        return emit.builder.load(emit.builder.convert("bitcast", emit.pointer(base, place), f"{kind}*"), constant=True)

    def _scatter(
        self, emit: Emitter, base: Value, scattered: list[Scattered], out: Value, scale: Value, constant: Value | None
    ) -> None:
        """Multiples of forms to where they belong."""
        scales = emit.vector([scale] * WIDTH)
        for each in scattered:
            with _turns(emit, each.n_groups, SIDE_BY_SIDE) as (first, few):
                for k, total in enumerate(self._gathered(emit, base, each.forms, first, few, constant)):
                    self._store_at(emit, emit.elements(emit.multiply(scales, total)), out, each.places, first, k)

    def _take_waiting(self, emit: Emitter, base: Value, side: Side, order: Value) -> None:
        """The second factors that waited, into the row of an order."""
        for run in side.waiting:
            with _turns(emit, run.n_groups, SIDE_BY_SIDE) as (first, few):
                here = emit.pointer(base, emit.builder.mul(first, integer(WIDTH)))
                row = self._row(emit, here, order)
                for k, y in enumerate(self._gathered(emit, base, run.forms[0], first, few, None)):
                    if run.kind == SUM:
                        self._store(emit, y, here, run.quantity + WIDTH * k)
                    else:
                        emit.store_vector(y, row, self.width + run.place + WIDTH * k)


@contextmanager
def _turns(emit: Emitter, n_groups: int, most: int) -> Iterator[tuple[Value, int]]:
    """A loop over groups, some at a time: the first of them, and how many. The last ones may be done twice."""
    builder, few = emit.builder, min(most, n_groups)
    if n_groups == few:
        yield integer(0), few
        return
    with emit.loop(integer(0), integer(-(-n_groups // few)), []) as (turn, _, _):
        first, last = builder.mul(turn, integer(few)), integer(n_groups - few)
        yield builder.select(builder.compare("icmp slt", first, last), first, last), few

"""The series of one mechanism as code compiled for it: the same numbers as by the program, in a fraction of the time.

What the program looks up at every order, which quantity times which coefficient, stands in the code, which goes to LLVM
as a straight line of operations. Its machine code is kept on disk as that of the kernels.

The factors X and Y of all products are rows of a table, one for each order, so that the sums of products of known
coefficients are vector operations. Late operations are an order behind: their factors X stand one row below their
order, which makes these sums run over the same rows as those of the early ones.
"""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

from llvmlite import ir
from numba import types
from numba.core.dispatcher import Dispatcher

from twoloop import llvm_code
from twoloop.caches import compile_kept
from twoloop.callbacks import VECTOR, f8
from twoloop.llvm_code import DOUBLE, INTEGER, Emitter, Quantities, Terms, Value, emitted
from twoloop.series import SeriesProgram, Sums, Table
from twoloop.tracing import (
    ARCTANGENT,
    EXPONENTIAL,
    LOGARITHM,
    PENDING,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
)

LARGEST = 4000  # operations; more take longer than ten seconds to compile
WIDTH = 8  # doubles of a vector
AT_ONCE = 8  # vectors that are summed in one loop, in registers

i8 = types.int64
FUNCTIONS = {EXPONENTIAL: "exp", LOGARITHM: "log", ARCTANGENT: "atan", SQUARE_ROOT: "sqrt"}


class Operation(NamedTuple):
    """One operation; of sine and cosine of an angle together."""

    kind: int
    place: int  # in the rows of X and Y
    quantity: int  # that it makes
    first: Terms
    first_constant: float
    second: Terms
    second_constant: float
    apart: int  # of a sine: how far behind it the cosine of the same angle stands


class Row(NamedTuple):
    """An entry of a right-hand side."""

    place: int
    terms: Terms
    constant: float


def _terms(sums: Sums, rows: Any) -> list[Terms]:
    """Quantities and coefficients of each form."""
    more: dict[int, list[tuple[int, float]]] = {int(row): [] for row in rows}
    for row, column, coefficient in zip(sums.row, sums.more_column, sums.more_coefficient, strict=True):
        more[int(row)].append((int(column), float(coefficient)))
    firsts = zip(rows, sums.column, sums.coefficient, strict=True)
    each = [[(int(column), float(coefficient)), *more[int(row)]] for row, column, coefficient in firsts]
    return [tuple((i, c) for i, c in terms if c != 0.0) for terms in each]


def _operations(table: Table, place: int, quantity: int) -> list[Operation]:
    """Those of a table; the first has this place and makes this quantity."""
    numbers = range(len(table.first.column))
    first, second = _terms(table.first, numbers), _terms(table.second, numbers)
    operations = []
    for kind, begin, end in table.groups[:, :3].tolist():
        apart = (end - begin) // 2 if kind == SINE else 0
        for o in range(begin, end - apart):
            forms = first[o], float(table.first.constant[o]), second[o], float(table.second.constant[o])
            operations.append(Operation(kind, place + o, quantity + o, *forms, apart))
    return operations


def _rows(sums: Sums, places: Any) -> list[Row]:
    return [Row(*each) for each in zip(places.tolist(), _terms(sums, places), sums.constant.tolist(), strict=True)]


class SeriesCode:
    """Writes the code of a program.

    `scratch` holds, from an aligned place on, sums of products; the results of early operations that late ones use;
    velocities; an inverse for each operation that divides; and the rows, X and Y of order 0, of order 1 and so on.
    """

    def __init__(self, program: SeriesProgram):
        n, n_early = program.n_q, len(program.early.first.column)
        self.n, self.n_rows, self.n_early = n, program.n_rows, n_early
        self.first = 1 + 3 * n + program.n_rows  # quantity that is a result
        self.early = _operations(program.early, 0, self.first)
        self.late = _operations(program.late, n_early, self.first + n_early)
        self.rows = _rows(program.rows, program.row_places)
        self.balance = _rows(program.balance, program.balance_places)
        self.size = program.n_operations
        self.width = _rounded(self.size)
        self.results = self.width
        self.velocities = self.results + _rounded(n_early)
        self.inverses = self.velocities + _rounded(n)
        self.table = self.inverses + self.width
        forms = [form for o in self.late for form in (o.first, o.second)] + [row.terms for row in self.balance]
        self.kept = {i for form in forms for i, _ in form}  # quantities that are needed an order later

    def scratch_size(self, order: int) -> int:
        """Length of `scratch` for a series of this order."""
        return WIDTH + self.table + 2 * self.width * (order + 1)

    def begin(
        self, emit: Emitter, scratch: Value, series: Value, r: Value, c: Value, lam: Value, t: Value, unit: Value, state: Value
    ) -> None:
        """What is known of the orders 0 and 1, and the early operations of order 0; r, c and lam are zero."""
        base = emit.aligned(scratch)
        zero = DOUBLE(0.0)
        for size, out in ((self.n, r), (self.n_rows, c), (self.n_rows, lam)):
            for i in range(size):
                emit.store(zero, out, i)
        known = Quantities(emit, lambda i: emit.load(state, i - 1) if i else t)
        for j in range(self.n):
            q, v = known.value(1 + j), known.value(1 + self.n + j)
            emit.store(q, series, j)
            emit.store(emit.multiply(unit, v), series, self.n + j)
            emit.store(v, base, self.velocities + j)
        table = emit.pointer(base, self.table)
        for o in self.early:
            self._begin_operation(emit, base, known, o)
            if o.kind == PENDING:
                emit.store(known.sum(o.second), table, self.width + o.place)
        for place in range(self.n_early, self.size):
            emit.store(zero, table, 2 * self.width + place)
        self._keep(emit, base, known)

    def order(
        self, emit: Emitter, scratch: Value, series: Value, r: Value, c: Value, t: Value, unit: Value, order: Value
    ) -> None:
        """Late operations of the order before and early ones of this order, as far as they are known; r and c."""
        base = emit.aligned(scratch)
        stride = INTEGER(2 * self.width)
        row = emit.pointer(base, self.table, emit.builder.mul(order, stride))
        q = emit.pointer(series, emit.builder.mul(order, INTEGER(self.n)))
        inverse = emit.divide(DOUBLE(1.0), emit.number(order))
        self._sums_of_products(emit, base, order)

        def late(time: Value) -> Quantities:
            def load(i: int) -> Value:
                if i == 0:
                    return time
                if i <= self.n:
                    return emit.load(q, i - 1 - self.n)
                if i <= 2 * self.n:
                    return emit.load(base, self.velocities + i - 1 - self.n)
                return emit.load(base, self.results + i - self.first)

            return Quantities(emit, load)

        with emit.builder.if_else(emit.builder.icmp_signed("==", order, INTEGER(1))) as (then, otherwise):
            with then:
                known = late(t)
                for o in self.late:
                    self._begin_operation(emit, base, known, o)
                for place, terms, constant in self.balance:
                    emit.store(known.sum(terms, constant), r, place)
            with otherwise:
                known = late(self._time(emit, unit, order, 2))
                before = emit.builder.sub(order, INTEGER(1))
                per_order = emit.divide(DOUBLE(1.0), emit.number(before))
                for o in self.late:
                    y = emit.pointer(row, -self.width)
                    self._operation(emit, base, known, o, row, y, emit.number(before), per_order)
                for place, terms, _ in self.balance:
                    emit.store(known.sum(terms), r, place)
        time = self._time(emit, unit, order, 1)
        known = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time)
        for o in self.early:
            self._operation(emit, base, known, o, row, emit.pointer(row, self.width), emit.number(order), inverse)
        scale = emit.negative(emit.divide(emit.number(order), unit))
        for place, terms, _ in self.rows:
            emit.store(emit.multiply(scale, known.sum(terms)), c, place)
        self._keep(emit, base, known)

    def take(
        self, emit: Emitter, scratch: Value, series: Value, a: Value, lam: Value, unit: Value, order: Value
    ) -> None:
        """Velocities of this order and positions of the next, from accelerations; the factors that waited for them."""
        base = emit.aligned(scratch)
        row = emit.pointer(base, self.table, emit.builder.mul(order, INTEGER(2 * self.width)))
        following = emit.builder.add(order, INTEGER(1))
        next_q = emit.pointer(series, emit.builder.mul(following, INTEGER(self.n)))
        per_v, per_q = (emit.divide(unit, emit.number(each)) for each in (order, following))

        def load(i: int) -> Value:
            return emit.load(a, i - 1 - 2 * self.n) if i <= 3 * self.n else emit.load(lam, i - 1 - 3 * self.n)

        known = Quantities(emit, load)
        for j in range(self.n):
            v = emit.multiply(per_v, known.value(1 + 2 * self.n + j))
            known.define(1 + self.n + j, v)
            if 1 + self.n + j in self.kept:
                emit.store(v, base, self.velocities + j)
            emit.store(emit.multiply(per_q, v), next_q, j)
        for operations, y in ((self.early, self.width), (self.late, -self.width)):
            for o in operations:
                if o.kind == PENDING:
                    emit.store(known.sum(o.second), row, y + o.place)

    def finite(self, emit: Emitter, series: Value, order: Value) -> Value:
        """Whether the last coefficients are."""
        last = emit.pointer(series, emit.builder.mul(order, INTEGER(self.n)))
        total = DOUBLE(0.0)
        for j in range(self.n):
            total = emit.add(total, emit.multiply(DOUBLE(0.0), emit.load(last, j)))
        return emit.builder.fcmp_ordered("==", total, DOUBLE(0.0))

    def _time(self, emit: Emitter, unit: Value, order: Value, linear: int) -> Value:
        """The coefficient of the time, which is linear."""
        is_linear = emit.builder.icmp_signed("==", order, INTEGER(linear))
        return emit.builder.select(is_linear, unit, DOUBLE(0.0))

    def _keep(self, emit: Emitter, base: Value, known: Quantities) -> None:
        for o in self.early:
            for i in (o.quantity, o.quantity + o.apart):
                if i in self.kept:
                    emit.store(known.value(i), base, self.results + i - self.first)

    def _sums_of_products(self, emit: Emitter, base: Value, order: Value) -> None:
        """For every operation the sum of X[j] Y[order - j] over 0 < j < order."""
        builder, stride = emit.builder, INTEGER(2 * self.width)
        places = [(place, _vector(self.size - place)) for place in range(0, self.size, WIDTH)]
        for first in range(0, len(places), AT_ONCE):
            group = places[first : first + AT_ONCE]
            zeros = [ir.VectorType(DOUBLE, width)([0.0] * width) for _, width in group]
            with emit.loop(INTEGER(1), order, zeros) as (j, totals, new):
                x = emit.pointer(base, self.table, builder.mul(j, stride))
                y = emit.pointer(base, self.table + self.width, builder.mul(builder.sub(order, j), stride))
                for (place, width), total in zip(group, totals, strict=True):
                    product = emit.multiply(emit.load_vector(x, place, width), emit.load_vector(y, place, width))
                    new.append(emit.add(total, product))
            for (place, _), total in zip(group, new, strict=True):
                emit.store_vector(total, base, place)

    def _begin_operation(self, emit: Emitter, base: Value, known: Quantities, o: Operation) -> None:
        """Order 0: the function itself; what waits stays zero."""
        table = emit.pointer(base, self.table)
        u = known.sum(o.first, o.first_constant)
        x = y = result = u
        if o.kind == PENDING:
            result, y = DOUBLE(0.0), None
        elif o.kind == SINE:
            result, y = emit.function("sin", u), emit.function("cos", u)
            known.define(o.quantity + o.apart, y)
            emit.store(emit.negative(result), table, self.width + o.place + o.apart)
        elif o.kind == PRODUCT:
            y = known.sum(o.second, o.second_constant)
            result = emit.multiply(u, y)
        elif o.kind == RECIPROCAL:
            result = y = emit.divide(DOUBLE(1.0), u)
        else:
            result = emit.function(FUNCTIONS[o.kind], u)
            y = result
            divisor = None
            if o.kind == SQUARE_ROOT:
                divisor = emit.times(2.0, result)
            elif o.kind in (LOGARITHM, ARCTANGENT):
                divisor = known.sum(o.second, o.second_constant)
            if divisor is not None:
                emit.store(emit.divide(DOUBLE(1.0), divisor), base, self.inverses + o.place)
        known.define(o.quantity, result)
        emit.store(x, table, o.place)
        if y is not None:
            emit.store(y, table, self.width + o.place)

    def _operation(
        self,
        emit: Emitter,
        base: Value,
        known: Quantities,
        o: Operation,
        x_row: Value,
        y_row: Value,
        order: Value,
        inverse: Value,
    ) -> None:
        """An order that is not 0; of what waits, what is known before."""

        def with_last(place: int, x: Value) -> Value:
            """The sum of products with that of X of this order."""
            first = emit.load(base, self.table + self.width + place)
            return emit.add(emit.load(base, place), emit.multiply(x, first))

        u = known.sum(o.first)
        x, y = u, None
        if o.kind == PENDING:
            result = with_last(o.place, u)
        elif o.kind == SINE:
            x = emit.multiply(order, u)
            other = o.place + o.apart
            result, y = (emit.multiply(with_last(place, x), inverse) for place in (o.place, other))
            known.define(o.quantity + o.apart, y)
            emit.store(x, x_row, other)
            emit.store(emit.negative(result), y_row, other)
        elif o.kind == PRODUCT:
            y = known.sum(o.second)
            result = emit.add(with_last(o.place, u), emit.multiply(emit.load(base, self.table + o.place), y))
        elif o.kind == RECIPROCAL:
            first = emit.load(base, self.table + self.width + o.place)
            result = y = emit.negative(emit.multiply(with_last(o.place, u), first))
        elif o.kind == EXPONENTIAL:
            x = emit.multiply(order, u)
            result = y = emit.multiply(with_last(o.place, x), inverse)
        elif o.kind == SQUARE_ROOT:
            difference = emit.subtract(u, emit.load(base, o.place))
            result = x = y = emit.multiply(difference, emit.load(base, self.inverses + o.place))
        else:
            y = known.sum(o.second)
            difference = emit.subtract(u, emit.multiply(emit.load(base, o.place), inverse))
            result = emit.multiply(difference, emit.load(base, self.inverses + o.place))
            x = emit.multiply(order, result)
        known.define(o.quantity, result)
        emit.store(x, x_row, o.place)
        if y is not None:
            emit.store(y, y_row, o.place)


def _rounded(size: int) -> int:
    """So many doubles that vectors may begin behind them."""
    return -(-size // WIDTH) * WIDTH


def _vector(size: int) -> int:
    """Width of the vector that holds so many doubles, or the first of them."""
    return next((width for width in (2, 4) if size <= width), WIDTH)


def compiled_series(program: SeriesProgram) -> Dispatcher:
    """The code of a program, compiled as a step is; its machine code is kept on disk.

    Raises
    ------
    ValueError
        If it would be too long to compile.
    """
    size = program.n_operations
    if size > LARGEST:
        raise ValueError(
            f"compiled=True is for equations of at most {LARGEST} operations; these are {size}. Leave it out"
        )
    key = _digest(program)
    if key not in _COMPILED:
        _COMPILED[key] = _compiled(program, key)
    return _COMPILED[key]


_COMPILED: dict[str, Dispatcher] = {}


def _compiled(program: SeriesProgram, key: str) -> Dispatcher:
    from twoloop.kernels import common, taylor
    from twoloop.linking import KernelCompiler

    code = SeriesCode(program)
    n, n_rows = code.n, code.n_rows
    arrays = {"scratch": VECTOR, "series": VECTOR}
    begin = emitted(code.begin, types.none, **arrays, r=VECTOR, c=VECTOR, lam=VECTOR, t=f8, unit=f8, state=VECTOR)
    find_order = emitted(code.order, types.none, **arrays, r=VECTOR, c=VECTOR, t=f8, unit=f8, order=i8)
    take = emitted(code.take, types.none, **arrays, a=VECTOR, lam=VECTOR, unit=f8, order=i8)
    finite = emitted(code.finite, types.boolean, series=VECTOR, order=i8)
    HEAD, ORDER, TARGET = taylor.N_MEMORY_SCALARS, taylor.ORDER, taylor.TARGET
    N_EVALUATIONS, DONE, NOT_FINITE = common.N_EVALUATIONS, common.DONE, common.NOT_FINITE

    def expand(f, w, options, memory, t, unit, tolerances, state, new_state):  # type: ignore[no-untyped-def]
        order = int(options[ORDER])
        series = memory[HEAD + int(memory[TARGET]) * (order + 1) * n :]
        place = HEAD + 2 * (order + 1) * n
        r, a = memory[place : place + n], memory[place + n : place + 2 * n]
        place += 2 * n
        c, lam = memory[place : place + n_rows], memory[place + n_rows : place + 2 * n_rows]
        scratch = memory[place + 2 * n_rows :]
        begin(scratch, series, r, c, lam, t, unit, state)
        for k in range(1, order):
            find_order(scratch, series, r, c, t, unit, k)
            f.second(f, w, r, c, t, unit, tolerances, a, lam)
            take(scratch, series, a, lam, unit, k)
        w.counters[N_EVALUATIONS] += order - 1
        return DONE if finite(series, order) else NOT_FINITE, 0.0

    return compile_kept(expand, common.STEP, (_stamp(), key), pipeline_class=KernelCompiler, **common.OPTIONS)


def _digest(program: SeriesProgram) -> str:
    """Of all that the code depends on."""
    digest = hashlib.sha256(repr((program.n_q, program.n_rows)).encode())
    tables = [(table.groups, *table.first, *table.second) for table in (program.early, program.late)]
    rows = (*program.rows, program.row_places, *program.balance, program.balance_places)
    for array in (*tables[0], *tables[1], *rows):
        digest.update(f"{array.dtype} {array.shape} ".encode() + array.tobytes())
    return digest.hexdigest()


def _stamp() -> str:
    """Of what writes the code, and of what the code finds in memory."""
    from twoloop.kernels import common

    texts = [Path(str(path)).read_text(encoding="utf-8") for path in (__file__, llvm_code.__file__)]
    return hashlib.sha256("".join([common.stamp("taylor"), *texts]).encode()).hexdigest()

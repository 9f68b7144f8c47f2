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
ZERO, ONE = DOUBLE(0.0), DOUBLE(1.0)
FUNCTIONS = {EXPONENTIAL: "exp", LOGARITHM: "log", ARCTANGENT: "atan", SQUARE_ROOT: "sqrt"}


class Argument(NamedTuple):
    """A form."""

    terms: Terms
    constant: float


class Group(NamedTuple):
    """Operations of one kind that do not depend on one another, side by side in a vector; at its end, the last again."""

    kind: int
    place: int  # in the rows of X and Y
    width: int
    quantities: list[int]  # that they make
    first: list[Argument]
    second: list[Argument]

    @property
    def pending(self) -> bool:
        """Whether the second factors wait for the solution of an order."""
        return self.kind == PENDING


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


def _arguments(sums: Sums) -> list[Argument]:
    numbers = range(len(sums.column))
    return [Argument(*each) for each in zip(_terms(sums, numbers), sums.constant.tolist(), strict=True)]


def _groups(table: Table, quantity: int) -> list[Group]:
    """Those of a table, whose first operation makes this quantity; they have no places yet.

    Of sines, the cosines of the same angles are the second half.
    """
    first, second = _arguments(table.first), _arguments(table.second)
    groups = []
    for kind, begin, end in table.groups[:, :3].tolist():
        halves = 2 if kind == SINE else 1
        size, most = (end - begin) // halves, WIDTH // halves
        for part in range(0, size, most):
            few = min(most, size - part)
            width = 1 << (few - 1).bit_length()
            members = [begin + h * size + part + min(k, few - 1) for h in range(halves) for k in range(width)]
            quantities = [quantity + o for o in members]
            groups.append(
                Group(kind, 0, len(members), quantities, [first[o] for o in members], [second[o] for o in members])
            )
    return groups


def _rows(sums: Sums, places: Any) -> list[Row]:
    return [Row(*each) for each in zip(places.tolist(), _terms(sums, places), sums.constant.tolist(), strict=True)]


class SeriesCode:
    """Writes the code of a program.

    `scratch` holds, from an aligned place on, the results of early operations that late ones use; velocities; for each
    operation that divides an inverse; a row of zeros; and the rows of orders 0, 1 and so on. A row is X and Y.
    """

    def __init__(self, program: SeriesProgram):
        n, n_early = program.n_q, len(program.early.first.column)
        self.n, self.n_rows = n, program.n_rows
        self.first = 1 + 3 * n + program.n_rows  # quantity that is a result
        groups = {True: _groups(program.early, self.first), False: _groups(program.late, self.first + n_early)}
        self.width = 0
        for width in (8, 4, 2, 1):  # so that vectors are aligned
            for each in groups.values():
                for k, group in enumerate(each):
                    if group.width == width:
                        each[k] = group._replace(place=self.width)
                        self.width += width
        self.width = _rounded(self.width)
        self.early, self.late = groups[True], groups[False]
        self.rows = _rows(program.rows, program.row_places)
        self.balance = _rows(program.balance, program.balance_places)
        self.velocities = _rounded(n_early)
        self.inverses = self.velocities + _rounded(n)
        self.zeros = self.inverses + self.width
        self.table = self.zeros + 2 * self.width
        arguments = [each for group in self.late for each in (*group.first, *group.second)]
        terms = [each.terms for each in arguments] + [row.terms for row in self.balance]
        self.kept = {i for each in terms for i, _ in each}  # quantities that are needed an order later

    def scratch_size(self, order: int) -> int:
        """Length of `scratch` for a series of this order."""
        return WIDTH + self.table + 2 * self.width * (order + 1)

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
    ) -> None:
        """What is known of the orders 0 and 1, and the early operations of order 0; r, c and lam are zero."""
        base = emit.aligned(scratch)
        for size, out in ((self.n, r), (self.n_rows, c), (self.n_rows, lam)):
            for i in range(size):
                emit.store(ZERO, out, i)
        known = Quantities(emit, lambda i: emit.load(state, i - 1) if i else t)
        for j in range(self.n):
            q, v = known.value(1 + j), known.value(1 + self.n + j)
            emit.store(q, series, j)
            emit.store(emit.multiply(unit, v), series, self.n + j)
            emit.store(v, base, self.velocities + j)
        table = emit.pointer(base, self.table)
        for group in self.early:
            self._begin_group(emit, base, known, group)
            if group.pending:
                self._store_waiting(emit, known, group, table)
        self._keep(emit, base, known)

    def order(
        self,
        emit: Emitter,
        scratch: Value,
        series: Value,
        r: Value,
        c: Value,
        t: Value,
        unit: Value,
        order: Value,
    ) -> None:
        """Late operations of the order before and early ones of this order, as far as they are known; r and c."""
        builder, base = emit.builder, emit.aligned(scratch)
        q = emit.pointer(series, builder.mul(order, INTEGER(self.n)))
        before = builder.sub(order, INTEGER(1))
        sums = self._sums_of_products(emit, base, order)

        def quantities(time: Value) -> Quantities:
            def load(i: int) -> Value:
                if i == 0:
                    return time
                if i <= self.n:
                    return emit.load(q, i - 1 - self.n)
                place = self.velocities + i - 1 - self.n if i < self.first else i - self.first
                return emit.load(base, place)

            return Quantities(emit, load)

        with builder.if_else(builder.icmp_signed("==", order, INTEGER(1))) as (then, otherwise):
            with then:
                known = quantities(t)
                for group in self.late:
                    self._begin_group(emit, base, known, group)
                for place, terms, constant in self.balance:
                    emit.store(known.sum(terms, constant), r, place)
            with otherwise:
                known = quantities(self._time(emit, unit, before))
                self._groups_of_order(emit, base, known, self.late, sums, before)
                for place, terms, _ in self.balance:
                    emit.store(known.sum(terms), r, place)
        time = self._time(emit, unit, order)
        known = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time)
        self._groups_of_order(emit, base, known, self.early, sums, order)
        scale = emit.negative(emit.divide(emit.number(order), unit))
        for place, terms, _ in self.rows:
            emit.store(emit.multiply(scale, known.sum(terms)), c, place)
        self._keep(emit, base, known)

    def take(
        self, emit: Emitter, scratch: Value, series: Value, a: Value, lam: Value, unit: Value, order: Value
    ) -> None:
        """Velocities of this order and positions of the next, from accelerations; the factors that waited for them."""
        base = emit.aligned(scratch)
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
        before = emit.builder.sub(order, INTEGER(1))
        for groups, each in ((self.early, order), (self.late, before)):
            for group in groups:
                if group.pending:
                    self._store_waiting(emit, known, group, self._row(emit, base, each))

    def finite(self, emit: Emitter, series: Value, order: Value) -> Value:
        """Whether the last coefficients are."""
        last = emit.pointer(series, emit.builder.mul(order, INTEGER(self.n)))
        total = ZERO
        for j in range(self.n):
            total = emit.add(total, emit.multiply(ZERO, emit.load(last, j)))
        return emit.builder.fcmp_ordered("==", total, ZERO)

    def _row(self, emit: Emitter, base: Value, order: Value) -> Value:
        return emit.pointer(base, self.table, emit.builder.mul(order, INTEGER(2 * self.width)))

    def _time(self, emit: Emitter, unit: Value, order: Value) -> Value:
        """The coefficient of the time, of an order that is not 0."""
        return emit.builder.select(emit.builder.icmp_signed("==", order, INTEGER(1)), unit, ZERO)

    def _keep(self, emit: Emitter, base: Value, known: Quantities) -> None:
        made = {i for group in self.early for i in group.quantities}
        for i in sorted(self.kept & made):
            emit.store(known.value(i), base, i - self.first)

    def _store_waiting(self, emit: Emitter, known: Quantities, group: Group, row: Value) -> None:
        y = emit.vector([known.sum(each.terms) for each in group.second])
        emit.store_vector(y, row, self.width + group.place)

    def _sums_of_products(self, emit: Emitter, base: Value, order: Value) -> dict[int, Value]:
        """For every group, by its place, the sum of X[j] Y[m - j] over 0 < j < m; m is the order, or one less of late ones.

        Coefficients that are hardly there come last, so that little waits for them.
        """
        builder, stride = emit.builder, 2 * self.width
        groups = [(group, 0) for group in self.early] + [(group, 1) for group in self.late]
        sums: dict[int, Value] = {}

        def product(x: Value, y: Value, group: Group) -> Value:
            factors = (
                emit.load_vector(x, group.place, group.width),
                emit.load_vector(y, self.width + group.place, group.width),
            )
            return emit.multiply(*factors)

        for begin in range(0, len(groups), AT_ONCE):
            some = groups[begin : begin + AT_ONCE]
            zeros = [emit.same(ZERO, group.width) for group, _ in some]
            with emit.loop(INTEGER(2), builder.sub(order, INTEGER(2)), zeros) as (j, totals, new):
                x, y = self._row(emit, base, j), self._row(emit, base, builder.sub(order, j))
                for (group, late), total in zip(some, totals, strict=True):
                    new.append(emit.add(total, product(x, emit.pointer(y, -stride * late), group)))
            for (group, _), total in zip(some, new, strict=True):
                sums[group.place] = total
        nothing = emit.pointer(base, self.zeros)

        def rows(j: Value, m: Value, least: int) -> tuple[Value, Value]:
            """X[j] and Y[m - j], or zeros where m is less than `least`."""
            counts = builder.icmp_signed(">=", m, INTEGER(least))
            pair = self._row(emit, base, j), self._row(emit, base, builder.sub(m, j))
            return tuple(builder.select(counts, each, nothing) for each in pair)

        before = builder.sub(order, INTEGER(1))
        second = builder.sub(order, INTEGER(2))
        ends = {
            0: [rows(second, order, 4), rows(before, order, 3), rows(INTEGER(1), order, 2)],
            1: [rows(second, before, 3), rows(INTEGER(1), before, 2)],
        }
        for group, late in groups:
            for pair in ends[late]:
                sums[group.place] = emit.add(sums[group.place], product(*pair, group))
        return sums

    def _begin_group(self, emit: Emitter, base: Value, known: Quantities, group: Group) -> None:
        """Order 0: the functions themselves; what waits stays zero."""
        table, place, kind = emit.pointer(base, self.table), group.place, group.kind
        first = [known.sum(*each) for each in group.first]
        second = [ZERO if group.pending else known.sum(*each) for each in group.second]
        u, y = emit.vector(first), emit.vector(second)
        x, divisor = u, None
        if group.pending:
            results = second
        elif kind == SINE:
            half = group.width // 2
            sines, cosines = ([emit.function(name, each) for each in first[:half]] for name in ("sin", "cos"))
            results, y = [*sines, *cosines], emit.vector([*cosines, *map(emit.negative, sines)])
        elif kind == PRODUCT:
            results = emit.elements(emit.multiply(x, y))
        elif kind == RECIPROCAL:
            y = emit.divide(emit.same(ONE, group.width), u)
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
            inverse = emit.divide(emit.same(ONE, group.width), divisor)
            emit.store_vector(inverse, base, self.inverses + place)
        for quantity, result in zip(group.quantities, results, strict=True):
            known.define(quantity, result)
        emit.store_vector(x, table, place)
        if not group.pending:
            emit.store_vector(y, table, self.width + place)

    def _groups_of_order(
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
        per_order = emit.divide(ONE, number)
        for group in groups:
            kind, place, width, total = group.kind, group.place, group.width, sums[group.place]

            def at(begin: int, group: Group = group) -> Value:
                return emit.load_vector(base, begin + group.place, group.width)

            def with_last(x: Value, total: Value = total, at: Any = at) -> Value:
                """The sum of products with that of X of this order."""
                return emit.add(total, emit.multiply(x, at(self.table + self.width)))

            x = y = emit.vector([known.sum(each.terms) for each in group.first])
            if kind in (EXPONENTIAL, SINE):
                x = emit.multiply(emit.same(number, width), x)
                result = y = emit.multiply(with_last(x), emit.same(per_order, width))
                if kind == SINE:
                    results = emit.elements(result)
                    y = emit.vector([*results[width // 2 :], *map(emit.negative, results[: width // 2])])
            elif kind == PENDING:
                result = with_last(x)
            elif kind == PRODUCT:
                y = emit.vector([known.sum(each.terms) for each in group.second])
                result = emit.add(with_last(x), emit.multiply(at(self.table), y))
            elif kind == RECIPROCAL:
                result = y = emit.negative(emit.multiply(with_last(x), at(self.table + self.width)))
            elif kind == SQUARE_ROOT:
                result = x = y = emit.multiply(emit.subtract(x, total), at(self.inverses))
            else:
                y = emit.vector([known.sum(each.terms) for each in group.second])
                difference = emit.subtract(x, emit.multiply(total, emit.same(per_order, width)))
                result = emit.multiply(difference, at(self.inverses))
                x = emit.multiply(emit.same(number, width), result)
            for quantity, value in zip(group.quantities, emit.elements(result), strict=True):
                known.define(quantity, value)
            emit.store_vector(x, row, place)
            if not group.pending:
                emit.store_vector(y, row, self.width + place)


def _rounded(size: int) -> int:
    """So many doubles that vectors may begin behind them."""
    return -(-size // WIDTH) * WIDTH


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

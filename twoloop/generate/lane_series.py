"""Write code in which each value is a vector with one number for each SIMD lane, and code for Taylor series in lanes.

A Taylor series is computed order by order, by recurrences with sums: coefficient k of a product X Y of two series is
the sum of X[j] Y[k - j] over 0 <= j <= k. Here a "factor" is such a series X or Y; it is stored once, even if it occurs
in several sums. A "row" is a part of the memory: row k contains coefficient k of every factor. Usually each lane has
its own run. In collocation steps, each lane has one stage of the same run.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from twoloop.generate.elimination import FactorAndSolvePrograms
from twoloop.generate.llvm_code import FUNCTIONS, INTRINSICS, Emitter, Quantities, lower_program, sine_and_cosine
from twoloop.generate.llvm_text import DOUBLE, INTEGER, Builder, Value, integer, undefined, vector_of
from twoloop.generate.program import Coefficient, Coefficients, Terms
from twoloop.generate.series import OperationGroups, SeriesProgram, Sums
from twoloop.kernels.data.collocation import LANES as STAGES
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

# coefficients, lowest power first, of two polynomials: for log2 x on [1, 2], with an error of 2e-06, and for 2^x on
# [-1/2, 1/2], with an error of 1e-07; both were fitted by least squares. Step-size control needs no better accuracy
LOG2_COEFFICIENTS = (-3.03460285, 6.089895763, -5.301709109, 3.249466561, -1.247962495, 0.2700374574, -0.02512320329)
EXP2_COEFFICIENTS = (1.000000075, 0.6931472067, 0.2402210736, 0.05550327214, 0.009676037098, 0.001340043216)
# to avoid overflow, `exponential` clips x to +-MAX_EXPONENT, and `logarithm` replaces smaller x by MIN_ARGUMENT
MAX_EXPONENT, MIN_ARGUMENT = 1000.0, 1e-300


class LaneEmitter(Emitter):
    """Emitter that writes operations on vectors, with one number for each SIMD lane, to an LLVM function."""

    constants: Value  # pointer to the coefficients that have the same value in all lanes

    def __init__(self, builder: Builder, lanes: int = LANES):
        super().__init__(builder, lanes)

    def coefficient(self, number: float) -> Value:
        """Return `number` as a vector: equal in all lanes, unless it is a Coefficient that varies between lanes."""
        if not isinstance(number, Coefficient) or number.varies:
            return super().coefficient(number)
        pointer = self.builder.advance(self.constants, integer(number.index))
        return self.broadcast(self.builder.load(pointer, constant=True))

    def function(self, name: str, x: Value) -> Value:
        """Compute the function `name` of x: by an LLVM intrinsic if there is one, else by a libm call in each lane."""
        if name in INTRINSICS:
            return super().function(name, x)
        result, scalar = undefined(self.double_type), Emitter(self.builder)
        for lane in range(self.lanes):
            result = self.builder.insert(result, scalar.function(name, self.builder.extract(x, lane)), lane)
        return result

    def max_over_lanes(self, x: Value) -> Value:
        """Return the largest of the numbers in the lanes of x; LLVM's own reduction would compare them one by one."""
        width = self.lanes
        while width > 2:
            width //= 2
            x = self.maximum(*(self.builder.shuffle(x, x, range(k, k + width)) for k in (0, width)))
        return x if width == 1 else self.maximum(*(self.builder.extract(x, k) for k in (0, 1)))

    def logarithm(self, x: Value) -> Value:
        """Return log2 x for x >= 0 with an error below 1e-4; below MIN_ARGUMENT, return the value at MIN_ARGUMENT."""
        builder = self.builder
        bits = builder.convert("bitcast", self.maximum(x, self.constant(MIN_ARGUMENT)), self.integer_type)
        exponent = builder.operation("lshr", bits, self.integer_constant(52)) - 1023
        mantissa = bits & (1 << 52) - 1 | 1023 << 52
        whole, mantissa = (
            builder.convert("sitofp", exponent, self.double_type),
            builder.convert("bitcast", mantissa, self.double_type),
        )
        return whole + self.polynomial(LOG2_COEFFICIENTS, mantissa)

    def exponential(self, x: Value) -> Value:
        """Return 2^x with a relative error below 1e-4."""
        builder = self.builder
        x = self.maximum(self.minimum(x, self.constant(MAX_EXPONENT)), self.constant(-MAX_EXPONENT))
        whole = self.function("rint", x)
        exponent = builder.convert("fptosi", whole, self.integer_type) + 1023
        bits = builder.operation("shl", exponent, self.integer_constant(52))
        power = builder.convert("bitcast", bits, self.double_type)
        return power * self.polynomial(EXP2_COEFFICIENTS, x - whole)

    def minimum_or_nan(self, a: Value, b: Value) -> Value:
        """Return the smaller one of a and b, or a if one of them is NaN. So the result is NaN only if a is NaN."""
        return self.builder.select(self.builder.compare("fcmp ult", a, b), a, b)

    def maximum_or_nan(self, a: Value, b: Value) -> Value:
        """Return the larger one of a and b, or NaN if one of them is NaN."""
        larger = self.builder.select(self.builder.compare("fcmp ugt", a, b), a, b)
        return self.builder.select(self.builder.compare("fcmp uno", b, b), b, larger)


def load_lanes(emit: LaneEmitter, base: Value, index: int = 0) -> Value:
    """Return the vector base[index : index + STAGES]: one number for each stage of a collocation step.

    The address must be aligned to the vector's size. A load is slow just after the numbers were stored one by one.
    """
    start, kind = emit.builder.advance(base, integer(index)), vector_of(DOUBLE, STAGES)
    return emit.builder.load(emit.builder.convert("bitcast", start, f"{kind}*"), 8 * STAGES)


def store_lanes(emit: LaneEmitter, value: Value, base: Value, index: int = 0) -> None:
    """Store a vector in base[index : index + STAGES]: one number for each stage of a collocation step."""
    pointer = emit.builder.convert("bitcast", emit.builder.advance(base, integer(index)), f"{value.type}*")
    emit.builder.store(value, pointer, 8 * STAGES)


def two_sums(emit: LaneEmitter, a: Value, b: Value) -> list[Value]:
    """Return two numbers: the sum of all lanes of a, and the sum of all lanes of b."""
    builder, half = emit.builder, STAGES // 2
    lower_half, upper_half = ([*range(k, k + half), *range(STAGES + k, STAGES + k + half)] for k in (0, half))
    total = builder.shuffle(a, b, lower_half) + builder.shuffle(a, b, upper_half)
    for distance in (2, 1):
        total = total + builder.shuffle(total, total, [k ^ distance for k in range(STAGES)])
    return [builder.extract(total, k) for k in (0, half)]


def gather_lane(emit: LaneEmitter, vectors: Sequence[Value], lane: int) -> Value:
    """Return the numbers in lane `lane` of all `vectors`, as a vector; if there is only one vector, return a scalar."""
    builder, indices = emit.builder, [lane, STAGES + lane]
    if len(vectors) == 1:
        return builder.extract(vectors[0], lane)
    while len(vectors) > 1:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [builder.shuffle(*pair, indices) for pair in pairs]
        indices = list(range(2 * len(indices)))
    return vectors[0]


@contextmanager
def loop_over_coordinates(
    emit: LaneEmitter, coordinates: Sequence[int], carried: Sequence[Value] = ()
) -> Iterator[tuple[Value, Value, list[Any], list[Any]]]:
    """Return a context manager that writes a loop over k, as `Emitter.loop` does, but also yields coordinates[k]."""
    builder = emit.builder
    table = None if list(coordinates) == list(range(len(coordinates))) else builder.module.add_table(coordinates)
    with emit.loop(integer(0), integer(len(coordinates)), carried) as (k, values, new):
        i = k if table is None else builder.convert("sext", builder.load(builder.advance(table, k), 4), INTEGER)
        yield k, i, values, new


ZERO_ROW = -1  # index of a row of zeros in memory; rows 0, 1, ... contain the coefficients of order 0, 1, ...
# largest number of sums in one loop: each sum needs a register; processors have 32 registers of 8 doubles, or 16 of 4
MAX_SUMS_IN_LOOP = 12 if LANES == 8 else 6


class Operation(NamedTuple):
    """Operation on Taylor series; the sine and the cosine of an angle are one operation with two results."""

    kind: int  # kind of operation, such as PRODUCT, see kernels/evaluation/operations.py
    results: tuple[int, ...]  # indices of the results of this operation among all quantities
    first: tuple[Terms, float]  # terms and constant of the first argument
    second: tuple[Terms, float]  # terms and constant of the second argument


class LaneSeries:
    """Generator of code that computes the Taylor series of the motion, by the operations of a SeriesProgram.

    `scratch` is an array of vectors with these parts: the factored matrix of M a + G^T lam = r, G a = c (equations for
    accelerations a and multipliers lam); the vector r; reciprocals of the divisors in recurrences of roots, logarithms
    and arctangents; sums that were computed for the next order (see `_shared_sums`); a row of zeros; and, for each
    order, a row with the coefficients of all factors of products.
    """

    def __init__(
        self, program: SeriesProgram, solution: FactorAndSolvePrograms, numbers: Coefficients, n: int, n_rows: int
    ):
        self.solution, self.numbers, self.n, self.n_rows = solution, numbers, n, n_rows
        self.factor_indices: dict[Any, int] = {}
        self._divisor_indices: dict[int, int] = {}
        first_result = 1 + 3 * n + n_rows
        self.early = self._make_operations(program.early, first_result)
        self.late = self._make_operations(program.late, first_result + len(program.early.first.column))
        self.rows = self._row_expressions(program.rows, program.row_indices)
        self.balance = self._row_expressions(program.balance, program.balance_indices)
        # this dict is empty at first: `_shared_sums` returns its entries, but calls `_factors`, which reads the dict
        self._carried_sums: dict[int, tuple[int, int]] = {}
        self._carried_sums |= self._shared_sums()
        self.carried_pairs = sorted(set(self._carried_sums.values()))
        for operation in (*self.early, *self.late):
            self._factors(operation)
            if operation.kind in (SQUARE_ROOT, LOGARITHM, ARCTANGENT):
                self._divisor_indices[operation.results[0]] = len(self._divisor_indices)
        self.rhs_offset = solution.n_stored
        self.divisor_offset = self.rhs_offset + n
        self.carried_offset = self.divisor_offset + len(self._divisor_indices)
        self.row_length = len(self.factor_indices)
        self.zero_row_offset = self.carried_offset + len(self.carried_pairs)
        self.row_0_offset = self.zero_row_offset + self.row_length

    def scratch_size(self, order: int) -> int:
        """Return the length of `scratch`, in vectors, for a series up to `order`."""
        return self.row_0_offset + self.row_length * (order + 1)

    @property
    def structure(self) -> list[Any]:
        """Return the data that determine the code: their digest is the key of cached code."""
        return [self.n, self.n_rows, self.early, self.late, self.rows, self.balance, self.factor_indices]

    def _expressions(self, sums: Sums, rows: Sequence[int]) -> list[tuple[Terms, float]]:
        """Return (terms, constant) of each expression in `sums`. In sums.row, expression k has the index rows[k]."""
        more: dict[int, list[tuple[int, float]]] = {row: [] for row in rows}
        for row, i, c in zip(
            sums.row.tolist(), sums.further_column.tolist(), sums.further_coefficient.tolist(), strict=True
        ):
            more[row].append((i, c))
        first_terms = zip(rows, sums.column.tolist(), sums.coefficient.tolist(), sums.constant.tolist(), strict=True)
        return [
            self.numbers.indexed_terms(tuple(term for term in ((i, c), *more[row]) if term[1] != 0.0), constant)
            for row, i, c, constant in first_terms
        ]

    def _row_expressions(self, sums: Sums, indices: Any) -> list[tuple[int, tuple[Terms, float]]]:
        """Return (i, (terms, constant)) for each expression in `sums`; i: index of its equation, from `indices`."""
        return list(zip(indices.tolist(), self._expressions(sums, indices.tolist()), strict=True))

    def _make_operations(self, table: OperationGroups, quantity: int) -> list[Operation]:
        """Return the operations in `table`; `quantity`: index of the quantity that the first operation computes."""
        firsts, seconds = (self._expressions(each, range(len(each.column))) for each in (table.first, table.second))
        operations = []
        for kind, begin, end in table.groups[:, :3].tolist():
            count = (end - begin) // 2 if kind == SINE else end - begin
            for k in range(begin, begin + count):
                results = (quantity + k, quantity + k + count) if kind == SINE else (quantity + k,)
                operations.append(Operation(kind, results, firsts[k], seconds[k]))
        return operations

    def _factor_index(self, *key: Any) -> int:
        """Return the index of a series that is a factor of products: row k stores its coefficient k at this index.

        `key`: (terms, constant) of the series, or ("scaled", terms, constant) if row k stores k times coefficient k.
        """
        return self.factor_indices.setdefault(key, len(self.factor_indices))

    def _shared_sums(self) -> dict[int, tuple[int, int]]:
        """Find products (cos x) x' and (sin x) x', whose sums the recurrences of sin x and cos x already compute.

        (cos x) x' is the derivative of sin x. So its coefficient k, without the term that contains the yet unknown
        coefficient k of x', is the sum for coefficient k + 1 of sin x divided by the series' unit of time. Likewise,
        (sin x) x' follows from the sum for cos x. In the returned dict, a key is the index of the product among all
        quantities; the value (x, y) contains the indices of the two series in the sum, see `_factor_index`.
        """
        pairs: dict[Any, tuple[int, int]] = {}
        for operation in self.early:
            terms, _ = operation.first
            if operation.kind == SINE and all(1 <= i <= self.n for i, _ in terms):
                rate = tuple((i + self.n, c) for i, c in terms)
                for result, pair in zip(reversed(operation.results), self._factors(operation), strict=True):
                    pairs[((result, 1.0),), rate] = pair
        products = [each for each in self.early if each.kind == PENDING and not each.first[1] and not each.second[1]]
        pair_of = {each.results[0]: pairs.get((each.first[0], each.second[0])) for each in products}
        return {result: pair for result, pair in pair_of.items() if pair is not None}

    def _factors(self, operation: Operation) -> list[tuple[int, int]]:
        """Return (index of X, index of Y) for each result whose coefficient k needs a sum of X[j] Y[k - j]."""
        kind, results, first, second = operation
        if results[0] in self._carried_sums:
            return []
        if kind in (PRODUCT, PENDING):
            return [(self._factor_index(*first), self._factor_index(*second))]
        if kind in (LOGARITHM, ARCTANGENT):
            return [(self._factor_index("scaled", ((results[0], 1.0),), 0.0), self._factor_index(*second))]
        result_indices = [self._factor_index(((result, 1.0),), 0.0) for result in results]
        if kind == RECIPROCAL:
            return [(self._factor_index(*first), result_indices[0])]
        if kind == SQUARE_ROOT:
            return [(result_indices[0], result_indices[0])]
        x = self._factor_index("scaled", *first)
        return [(x, result_indices[1]), (x, result_indices[0])] if kind == SINE else [(x, result_indices[0])]

    def write_order_0(self, emit: LaneEmitter, inputs: Sequence[Value], scratch: Value) -> None:
        """Write code that begins a series: it stores coefficients of order 0 in `scratch`. `inputs`: t, q, v."""
        for index in (*range(self.rhs_offset, self.divisor_offset), *range(self.carried_offset, self.row_0_offset)):
            emit.store(emit.constant(0.0), scratch, index)
        row = _Row(self, emit, emit.pointer(scratch, self.row_0_offset))
        quantities = Quantities(emit, lambda i: inputs[i])
        self._write_order_0(emit, quantities, self.early, row, scratch)
        self._write_order_0(emit, quantities, self.late, row, scratch)
        for index, expr in self.balance:
            emit.store(quantities.sum(*expr), scratch, self.rhs_offset + index)

    def write_order(self, emit: LaneEmitter, k: Value, unit: Value, out: Value, scratch: Value) -> None:
        """Write code for k > 0: store coefficient k + 1 of q in `out`, coefficient k of products' factors in `scratch`.

        `unit`: unit of time of the series (s). The code first solves for coefficient k - 1 of the accelerations.
        """
        builder, n = emit.builder, self.n
        next_order = k + 1
        q = emit.pointer(out, k * n)
        order, zero = emit.to_double(k), emit.constant(0.0)
        is_first = builder.compare("icmp eq", k, integer(1))
        time_coefficient = builder.select(is_first, unit, zero)
        quantities = Quantities(emit, lambda i: emit.load(q, i - 1) if i else time_coefficient)
        row = _Row(self, emit, self._row_pointer(emit, scratch, k))
        per_order = 1.0 / order
        first_row = self._row_pointer(emit, scratch, builder.select(is_first, integer(ZERO_ROW), integer(1)))
        row_before = _Row(self, emit, self._row_pointer(emit, scratch, k - 1))
        sums = self._write_sums(emit, scratch, k)
        partial_sums = _PartialSums(sums, first_row, self._row_pointer(emit, scratch, 1), row_before)
        self._write_order(emit, quantities, self.early, row, scratch, partial_sums, order, per_order)
        next_sums = {pair: partial_sums.sum_of_next_order(pair, row) for pair in self.carried_pairs}
        for index, pair in enumerate(self.carried_pairs):
            emit.store(next_sums[pair], scratch, self.carried_offset + index)
        per_unit = 1.0 / unit
        for result, pair in self._carried_sums.items():
            quantities.define(result, per_unit * next_sums[pair])
        minus_rate = -(order / unit)
        c = [zero] * self.n_rows
        for index, (terms, _) in self.rows:
            c[index] = minus_rate * quantities.sum(terms)
        r = [emit.load(scratch, self.rhs_offset + i) for i in range(n)]
        stored = [emit.load(scratch, i) for i in range(self.solution.n_stored)]
        solution = self.solution
        _, (a, lam) = lower_program(emit, solution.solution_program, [*r, *c, *stored], self.numbers)
        per_v, per_q = unit * per_order, unit / emit.to_double(next_order)
        previous = Quantities(emit, lambda i: zero)  # Taylor coefficient k - 1 of a and lam; 0 for other quantities
        for j in range(n):
            v = per_v * a[j]
            quantities.define(1 + n + j, v)
            emit.store(per_q * v, emit.pointer(out, next_order * n), j)
            previous.define(1 + 2 * n + j, a[j])
        for i in range(self.n_rows):
            previous.define(1 + 3 * n + i, lam[i])
        for operations, values, target_row in ((self.early, quantities, row), (self.late, previous, row_before)):
            for operation in operations:
                if operation.kind == PENDING and operation.results[0] not in self._carried_sums:
                    target_row.store(operation.second, values.sum(operation.second[0]))
        self._write_order(emit, quantities, self.late, row, scratch, partial_sums, order, per_order)
        for index, (terms, _) in self.balance:
            emit.store(quantities.sum(terms), scratch, self.rhs_offset + index)

    def _row_pointer(self, emit: LaneEmitter, scratch: Value, order: Value | int) -> Value:
        return emit.pointer(scratch, self.row_0_offset, order * self.row_length)

    def _write_order_0(
        self, emit: LaneEmitter, quantities: Quantities, operations: list[Operation], row: "_Row", scratch: Value
    ) -> None:
        """Write code for coefficient 0 of the results of `operations`, and store coefficient 0 of factors in `row`."""
        one, zero = emit.constant(1.0), emit.constant(0.0)
        for operation in operations:
            kind, results, first, second = operation
            x = quantities.sum(*first)
            row.store(first, x, "if used")
            divisor = None
            if kind == PENDING:
                if operations is self.early and results[0] not in self._carried_sums:
                    row.store(second, quantities.sum(*second))
                values = [zero]
            elif kind == PRODUCT:
                z = quantities.sum(*second)
                row.store(second, z)
                values = [x * z]
            elif kind == SINE:
                values = list(sine_and_cosine(emit, x))
            elif kind == RECIPROCAL:
                values = [one / x]
            else:
                values = [emit.function(FUNCTIONS[kind], x)]
                if kind in (LOGARITHM, ARCTANGENT):
                    divisor = quantities.sum(*second)
                    row.store(second, divisor)
                elif kind == SQUARE_ROOT:
                    divisor = values[0] + values[0]
            if kind in (SINE, EXPONENTIAL, LOGARITHM, ARCTANGENT):
                scaled = (((results[0], 1.0),), 0.0) if kind in (LOGARITHM, ARCTANGENT) else first
                row.store(("scaled", *scaled), zero)
            if divisor is not None:
                emit.store(one / divisor, scratch, self.divisor_offset + self._divisor_indices[results[0]])
            for result, value in zip(results, values, strict=True):
                quantities.define(result, value)
                row.store((((result, 1.0),), 0.0), value, "if used")

    def _write_sums(self, emit: LaneEmitter, scratch: Value, k: Value) -> dict[tuple[tuple[int, int], bool], Value]:
        """Write loops for sums over 1 < j < k, and return the sums: of X[j] Y[k - j], and of X[j] Y[k + 1 - j].

        Keys of the returned dict: ((index of X, index of Y), True for Y[k + 1 - j] or False for Y[k - j]). For these
        indices of series X and Y see `_factor_index`. `_PartialSums` adds the terms j = 1 and j = k later: these may
        need coefficients that are computed after the loops. One loop computes several sums, to load factors once.
        """
        keys = [(pair, True) for pair in self.carried_pairs]
        pairs = {pair for each in (*self.early, *self.late) for pair in self._factors(each)}
        keys += [(pair, False) for pair in pairs - set(self.carried_pairs)]
        keys.sort(key=lambda each: each[0][::-1] if each[1] else each[0])  # consecutive sums then often share a factor
        sums: dict[tuple[tuple[int, int], bool], Value] = {}
        order = k + 1
        for begin in range(0, len(keys), MAX_SUMS_IN_LOOP):
            group = keys[begin : begin + MAX_SUMS_IN_LOOP]
            with emit.loop(integer(2), k, [emit.constant(0.0)] * len(group)) as (j, totals, new):
                up, down = self._row_pointer(emit, scratch, j), self._row_pointer(emit, scratch, order - j)
                row_before = self._row_pointer(emit, scratch, j - 1)
                loaded: dict[tuple[Value, int], Value] = {}
                for ((x, y), for_next_order), total in zip(group, totals, strict=True):
                    indices = ((up, x), (down, y)) if for_next_order else ((down, x), (row_before, y))
                    for base, index in indices:
                        if (base, index) not in loaded:
                            loaded[base, index] = emit.load(base, index)
                    first, second = (loaded[each] for each in indices)
                    new.append(total + first * second)
            sums |= dict(zip(group, new, strict=True))
        return sums

    def _write_order(
        self,
        emit: LaneEmitter,
        quantities: Quantities,
        operations: list[Operation],
        row: "_Row",
        scratch: Value,
        partial_sums: "_PartialSums",
        order: Value,
        inverse: Value,
    ) -> None:
        """Write code for Taylor coefficient k = `order` > 0 of the results of `operations`; `inverse`: 1 / k.

        The second factor of a PENDING product contains v, lam or a: its yet unknown coefficient k is left out.
        """
        pairs = list(dict.fromkeys(pair for operation in operations for pair in self._factors(operation)))
        sums = {}
        for pair in pairs:
            if pair in self.carried_pairs:
                sums[pair] = emit.load(scratch, self.carried_offset + self.carried_pairs.index(pair))
            else:
                sums[pair] = partial_sums.sum_of_order(pair)
        row_0 = emit.pointer(scratch, self.row_0_offset)
        for operation in operations:
            kind, results, (first, _), (second, _) = operation
            if results[0] in self._carried_sums:
                continue
            totals = [sums[pair] for pair in self._factors(operation)]
            start = [(emit.load(row_0, x), emit.load(row_0, y)) for x, y in self._factors(operation)]
            u = quantities.sum(first)
            row.store(operation.first, u, "if used")
            if kind == PENDING:
                values = [totals[0] + u * start[0][1]]
            elif kind == PRODUCT:
                z = quantities.sum(second)
                row.store(operation.second, z)
                values = [totals[0] + u * start[0][1] + start[0][0] * z]
            elif kind == RECIPROCAL:
                total = totals[0] + u * start[0][1]
                values = [-(total * start[0][1])]
            elif kind == SQUARE_ROOT:
                divisor = emit.load(scratch, self.divisor_offset + self._divisor_indices[results[0]])
                values = [(u - totals[0]) * divisor]
            elif kind in (LOGARITHM, ARCTANGENT):
                divisor = emit.load(scratch, self.divisor_offset + self._divisor_indices[results[0]])
                values = [(u - totals[0] * inverse) * divisor]
                row.store(("scaled", ((results[0], 1.0),), 0.0), order * values[0])
                row.store(operation.second, quantities.sum(second))
            else:
                x = order * u
                row.store(("scaled", *operation.first), x)
                values = [(total + x * y) * inverse for total, (_, y) in zip(totals, start, strict=True)]
                if kind == SINE:
                    values[1] = -values[1]
            for result, value in zip(results, values, strict=True):
                quantities.define(result, value)
                row.store((((result, 1.0),), 0.0), value, "if used")


class _Row:
    """Row k of `scratch`: coefficient k of all factors of products. `load` reuses values that `store` has written."""

    def __init__(self, code: LaneSeries, emit: LaneEmitter, base: Value):
        self.code, self.emit, self.base = code, emit, base
        self._stored: dict[int, Value] = {}

    def store(self, key: Any, value: Value, when: str = "") -> None:
        """Store the coefficient of the series `key`. If `when` is "if used", skip a series that no product contains."""
        index = self.code.factor_indices.get(tuple(key)) if when else self.code.factor_indices[tuple(key)]
        if index is not None and index not in self._stored:
            self._stored[index] = value
            self.emit.store(value, self.base, index)

    def load(self, index: int) -> Value:
        """Return the coefficient of a factor in this row; `index`: index of the factor."""
        return self._stored[index] if index in self._stored else self.emit.load(self.base, index)


class _PartialSums(NamedTuple):
    """Sums over 1 < j < k of X[j] Y[k - j] and X[j] Y[k + 1 - j]; the methods add the terms j = 1 and j = k."""

    sums: dict[tuple[tuple[int, int], bool], Value]  # sums over 1 < j < k, from `LaneSeries._write_sums`
    first_row: Value  # pointer to `row_1` if k > 1, to a row of zeros if k = 1: then a term of each sum does not exist
    row_1: Value  # pointer to coefficient 1 of all series
    row_before: _Row  # memory that contains coefficient k - 1 of all series

    def sum_of_order(self, pair: tuple[int, int]) -> Value:
        """Return the sum of X[j] Y[k - j] over 0 < j < k (k: order); `pair`: indices of series X and Y in a `_Row`."""
        emit, (x, y) = self.row_before.emit, pair
        return self.sums[pair, False] + emit.load(self.first_row, x) * self.row_before.load(y)

    def sum_of_next_order(self, pair: tuple[int, int], row: _Row) -> Value:
        """Return the sum of X[j] Y[k + 1 - j] over 0 < j <= k; `pair`: indices of X, Y in `row` (with X[k], Y[k])."""
        emit, (x, y) = self.row_before.emit, pair
        total = self.sums[pair, True] + row.load(x) * emit.load(self.first_row, y)
        return total + emit.load(self.row_1, x) * row.load(y)

"""Write LLVM code for programs (class `Lowering`), and for single operations (class `Emitter`).

Numba takes milliseconds to compile a line of source; LLVM takes well below a millisecond for an operation. So long
lists of operations are written as LLVM functions, which kernels call by their addresses. Sine and cosine are written
inline, so that the processor computes the sines and cosines of several angles in parallel.

The code reads coefficients from memory, so that all mechanisms with the same structure of the equations share it.
LLVM compiles short blocks of instructions faster: therefore, the blocks of long functions may be split into parts.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Self

from twoloop.generate.graph import Affine, Graph
from twoloop.generate.llvm_text import (
    BIT,
    DOUBLE,
    INTEGER,
    Builder,
    Module,
    Value,
    constant,
    integer,
    undefined,
    vector_of,
)
from twoloop.generate.program import Algebra, Coefficient, Coefficients, Program, Terms
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    LOGARITHM,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
)

MIN_TERMS_SPLIT = 4  # a sum of at least this many terms is computed as two halves in parallel
ZERO, ONE = constant(DOUBLE, 0.0), constant(DOUBLE, 1.0)
# keys: functions; values: LLVM intrinsics (functions built into LLVM). Other functions are called in the library libm
INTRINSICS = {name: f"llvm.{name}" for name in ("sin", "cos", "exp", "log", "sqrt", "rint", "ceil", "fabs")}


class Emitter:
    """Emitter that appends operations on doubles to an LLVM function, and returns the values of their results.

    If `lanes` is more than 1, each number becomes a vector with one number for each lane, and array indices count these
    vectors. `numbers` points to the coefficients that the code reads.
    """

    def __init__(self, builder: Builder, lanes: int = 1):
        self.builder, self.lanes = builder, lanes
        self.numbers: Any = None
        self.double_type, self.integer_type, self.bit_type = (vector_of(kind, lanes) for kind in (DOUBLE, INTEGER, BIT))
        # last part of the names of LLVM intrinsics: the type of their arguments
        self.suffix = f"v{lanes}f64" if lanes > 1 else "f64"

    def copy_for_builder(self, builder: Builder) -> Self:
        """Return an emitter of the same class and number of lanes, which writes to the function of `builder`."""
        return type(self)(builder, self.lanes)

    def broadcast(self, value: Value) -> Value:
        """Return a vector with the number `value` in all lanes; for a single lane, return the number."""
        if self.lanes == 1:
            return value
        return self.builder.broadcast_first(self.builder.insert(undefined(vector_of(value.type, self.lanes)), value, 0))

    def constant(self, value: float) -> Value:
        """Return a literal number, the same in all lanes."""
        return constant(self.double_type, value, self.builder)

    def load_constant(self, value: float) -> Value:
        """Return a number that is loaded from memory just before its use, see `Builder.load_constant`."""
        return self.broadcast(self.builder.load_constant(value))

    def integer_constant(self, value: int) -> Value:
        """Return a literal integer of 64 bits; in lanes, a vector of equal integers."""
        return constant(self.integer_type, value, self.builder)

    def coefficient(self, number: float) -> Value:
        """Return `number` as a literal; if it is a Coefficient, load it from the array `numbers`."""
        if not isinstance(number, Coefficient):
            return self.constant(number)
        return self.load(self.numbers, number.index, constant=True)

    def add_sums(self, a: Value, b: Value) -> Value:
        """Return a + b for two sums, which LLVM must compute separately: one chain of all terms would be slower."""
        return self.builder.operation("fadd", a, b)

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """Return a * b + c, rounded only once."""
        return self.builder.call(f"llvm.fma.{self.suffix}", a.type, [a, b, c])

    def polynomial(self, coefficients: Sequence[float], x: Value) -> Value:
        """Return the value at x of a polynomial, whose `coefficients` begin with the lowest power."""
        square, terms = self.builder.operation("fmul", x, x), [self.load_constant(each) for each in coefficients]
        pairs = [self.fma(second, x, first) for first, second in zip(terms[::2], terms[1::2], strict=False)]
        pairs += terms[2 * len(pairs) :]
        total = pairs.pop()
        while pairs:
            total = self.fma(total, square, pairs.pop())
        return total

    def maximum(self, a: Value, b: Value) -> Value:
        """Return the larger one of two numbers."""
        return self.builder.select(self.builder.compare("fcmp ogt", a, b), a, b)

    def minimum(self, a: Value, b: Value) -> Value:
        """Return the smaller one of two numbers."""
        return self.builder.select(self.builder.compare("fcmp olt", a, b), a, b)

    def scale(self, factor: float, a: Value) -> Value:
        """Return `factor` times a; `factor` is a literal, or a Coefficient loaded from memory."""
        if factor in (1.0, -1.0):
            return a if factor == 1.0 else -a
        return self.coefficient(factor) * a

    def to_double(self, whole: Value) -> Value:
        """Return the integer `whole` converted to a double, in all lanes."""
        return self.broadcast(self.builder.convert("sitofp", whole, DOUBLE))

    def function(self, name: str, x: Value) -> Value:
        """Return the value at x of the function `name`, computed by its LLVM intrinsic if it has one, else by libm."""
        intrinsic = INTRINSICS.get(name)
        return self.builder.call(f"{intrinsic}.{self.suffix}" if intrinsic else name, x.type, [x])

    def pointer(self, base: Value, *indices: Value | int) -> Value:
        """Return the pointer `base` advanced by the sum of `indices`."""
        for index in indices:
            if isinstance(index, int):
                index = integer(index * self.lanes)
            elif self.lanes > 1:
                index = index * self.lanes
            base = self.builder.advance(base, index)
        return base

    def _entry_pointer(self, base: Value, index: int) -> Value:
        pointer = self.pointer(base, index)
        return pointer if self.lanes == 1 else self.builder.convert("bitcast", pointer, f"{self.double_type}*")

    def load(self, base: Value, index: int = 0, constant: bool = False) -> Value:
        """Return base[index], loaded from memory; `constant`: this number does not change during a call."""
        return self.builder.load(self._entry_pointer(base, index), constant=constant)

    def store(self, value: Value, base: Value, index: int = 0) -> None:
        """Store a number in base[index]."""
        self.builder.store(value, self._entry_pointer(base, index))

    def vector(self, values: Sequence[Value]) -> Value:
        """Return the vector whose elements are `values`."""
        vector = undefined(vector_of(DOUBLE, len(values)))
        for index, value in enumerate(values):
            vector = self.builder.insert(vector, value, index)
        return vector

    @contextmanager
    def loop(self, first: Value, end: Value, initial: Sequence[Value]) -> Iterator[tuple[Value, list[Any], list[Any]]]:
        """Return a context manager that writes a loop over integers from `first` to `end` - 1.

        The context manager yields the integer, the values from the previous iteration (`initial` in the first one), and
        a list, to which the caller appends the new values. After the loop, this list has the final values.
        """
        builder = self.builder
        is_entered = builder.compare("icmp slt", first, end)
        before, body, after = builder.block, builder.append_block(), builder.append_block()
        builder.branch(is_entered, body, after)
        builder.position_at_end(body)
        index = builder.phi(INTEGER)
        index.add_incoming(first, before)
        carried = [builder.phi(value.type) for value in initial]
        new: list[Any] = []
        yield index, carried, new
        next_index = index + 1
        is_entered, last = builder.compare("icmp slt", next_index, end), builder.block
        index.add_incoming(next_index, last)
        builder.branch(is_entered, body, after)
        builder.position_at_end(after)
        for k, value in enumerate(initial):
            result = builder.phi(value.type)
            for phi in (carried[k], result):
                phi.add_incoming(value, before)
                phi.add_incoming(new[k], last)
            new[k] = result


class Quantities:
    """Values of quantities (inputs, results of operations) and linear combinations, each loaded or computed only once.

    If a function is split into parts, each part loads quantities again, because keeping them in registers or on the
    stack would take longer. So the memory from which quantities are loaded must not change.

    load : function that writes code to load a quantity; it is called if `define` has not set the value.
    """

    def __init__(self, emit: Emitter, load: Callable[[int], Value]):
        self._emit, self._load = emit, load
        self._values: dict[int, Value] = {}
        self._loaded: dict[int, Value] = {}  # by index: quantities that this part of a split function has loaded
        self._part = emit.builder.part
        self._sums: dict[tuple[Terms, float], Value] = {}

    def define(self, quantity: int, value: Value) -> None:
        """Set the value of the quantity (an input, or the result of an operation) with this index."""
        self._values[quantity] = value

    def value(self, quantity: int) -> Value:
        """Return the value set by `define` for a quantity, or else load it, once in each part of a split function."""
        if quantity in self._values:
            return self._values[quantity]
        loaded = self._loaded_in_part()
        if quantity not in loaded:
            loaded[quantity] = self._load(quantity)
        return loaded[quantity]

    def mark_stored(self, quantity: int) -> None:
        """Record that a quantity was stored: then later parts of a split function load it, and need fewer registers."""
        self._loaded_in_part()[quantity] = self._values.pop(quantity)

    def _loaded_in_part(self) -> dict[int, Value]:
        """Return a dict {quantity: value} of the values that this part of a split function has loaded so far."""
        if self._part != self._emit.builder.part:
            self._part, self._loaded = self._emit.builder.part, {}
        return self._loaded

    def sum(self, terms: Terms, constant: float = 0.0) -> Value:
        """Return `constant` plus the sum of coefficient * quantity over the terms."""
        key = terms, constant
        if self._emit.builder.module.splits_blocks and len(terms) == 1 and constant == 0.0:
            ((quantity, coefficient),) = terms  # products are not cached: loading one takes as long as multiplying
            return self._emit.scale(coefficient, self.value(quantity))
        if key not in self._sums:
            total: Any = None if constant == 0.0 and terms else self._emit.coefficient(constant)
            half = len(terms) // 2 if len(terms) >= MIN_TERMS_SPLIT else 0
            if half:  # split the sum: the processor computes the sums of both halves in parallel
                self._sums[key] = self._emit.add_sums(self.sum(terms[:half], constant), self.sum(terms[half:]))
                return self._sums[key]
            for quantity, coefficient in terms:
                value = self.value(quantity)
                if total is None:
                    total = self._emit.scale(coefficient, value)
                elif coefficient == -1.0:
                    total = total - value
                else:
                    total = total + self._emit.scale(coefficient, value)
            self._sums[key] = total
        return self._sums[key]


def write(
    module: Module,
    name: str,
    kind: tuple[str, list[str]],
    emit: Callable[..., Any],
    emitter: Callable[..., Emitter] = Emitter,
) -> None:
    """Add the LLVM function `name` to a module; `kind`: types of result and arguments; `emit` writes its body."""
    builder = module.function(name, *kind)
    builder.ret(emit(emitter(builder), *builder.arguments))


LARGEST_ANGLE = 1e6  # results with larger angles (rad) count as invalid: reducing such angles by HALF_PI is inaccurate
HALF_PI = (1.5707963267948966, 6.123233995736766e-17)  # two numbers, whose sum is pi/2 to about twice double precision
# coefficients of x^3, x^5, ... in sin x, and of x^4, x^6, ... in cos x, on [-pi/4, pi/4], from Moshier's Cephes, sin.c
SINES = (
    -1.66666666666666307295e-1,
    8.33333333332211858878e-3,
    -1.98412698295895385996e-4,
    2.75573136213857245213e-6,
    -2.50507477628578072866e-8,
    1.58962301576546568060e-10,
)
COSINES = (
    4.16666666666665929218e-2,
    -1.38888888888730564116e-3,
    2.48015872888517045348e-5,
    -2.75573141792967388112e-7,
    2.08757008419747316778e-9,
    -1.13585365213876817300e-11,
)


def sine_and_cosine(emit: Emitter, x: Value) -> tuple[Value, Value]:
    """Return sine and cosine of x, accurate to rounding errors for |x| up to LARGEST_ANGLE."""
    builder, whole = emit.builder, emit.integer_constant
    quarter_turns = emit.function("rint", builder.operation("fmul", x, emit.load_constant(1.0 / HALF_PI[0])))
    remainder = x
    for part in HALF_PI:
        remainder = emit.fma(quarter_turns, emit.load_constant(-part), remainder)
    square = builder.operation("fmul", remainder, remainder)
    fourth = builder.operation("fmul", square, square)
    sine = emit.fma(builder.operation("fmul", square, remainder), emit.polynomial(SINES, square), remainder)
    cosine = emit.fma(square, emit.load_constant(-0.5), emit.constant(1.0))
    cosine = emit.fma(fourth, emit.polynomial(COSINES, square), cosine)
    quarter = builder.convert("fptosi", quarter_turns, emit.integer_type)
    is_odd, next_quarter = builder.convert("trunc", quarter, emit.bit_type), quarter + 1
    results = []
    for if_odd, if_even, turn in ((cosine, sine, quarter), (sine, cosine, next_quarter)):
        sign = builder.operation("shl", turn & 2, whole(62))
        bits = builder.convert("bitcast", builder.select(is_odd, if_odd, if_even), emit.integer_type)
        results.append(builder.convert("bitcast", bits ^ sign, emit.double_type))
    return results[0], results[1]


# names of mathematical functions, by kinds of operations
FUNCTIONS = {SQUARE_ROOT: "sqrt", EXPONENTIAL: "exp", LOGARITHM: "log", ARCTANGENT: "atan"}

Location = tuple[Value, int]  # memory location: pointer to an array, and an index in this array
NO_LOCATIONS: Mapping[int, Location] = {}


class Lowering(Algebra[Value]):
    """Algebra that does not compute: it writes the operations of a program as instructions of an LLVM function.

    locations : memory locations of the quantities that are loaded instead of computed, by index of the quantity.
    """

    def __init__(self, emit: Emitter, numbers: Coefficients, locations: Mapping[int, Location] = NO_LOCATIONS):
        super().__init__()
        self.emit, self.numbers, self._locations = emit, numbers, dict(locations)
        self.angles: list[Value] = []  # arguments of sines and cosines; `is_valid` compares these with LARGEST_ANGLE
        self.functions = {kind: partial(emit.function, name) for kind, name in FUNCTIONS.items()}
        self.functions[RECIPROCAL] = lambda x: 1.0 / x
        self._quantities = Quantities(emit, lambda quantity: emit.load(*self._locations[quantity]))
        self._sines_and_cosines: dict[Any, tuple[Value, Value]] = {}  # sine and cosine of each angle; keys: Affine.key
        self._computed_quantities = set(locations)

    def define(self, quantity: int, value: Value) -> None:
        """Set the value of the quantity (an input, or the result of an operation) with this index."""
        self._quantities.define(quantity, value)

    def define_inputs(self, graph: Graph, arguments: Sequence[Value]) -> None:
        """Define the inputs of a graph; each of the `arguments` is an input, or a pointer to an array of inputs."""
        first = 0
        for argument, size in zip(arguments, graph.input_sizes, strict=True):
            if argument.type == self.emit.double_type:
                self.define(first, argument)
            else:
                self._locations |= {first + j: (argument, j) for j in range(size)}
                if not self.emit.builder.module.splits_blocks:
                    for quantity in range(first, first + size):
                        self.value(quantity)
            first += size

    def value(self, quantity: int) -> Value:
        """Return the value of the quantity with this index."""
        return self._quantities.value(quantity)

    def affine(self, expr: Affine) -> Value:
        """Return the value of an affine expression."""
        return self._quantities.sum(*self.numbers.indexed_expression(expr))

    def product(self, a: Value, b: Value) -> Value:
        """Return the product of a and b."""
        return a * b

    def operation(self, kind: int, first: Affine, second: Affine | None) -> Value:
        """Return the result of an operation; the sine and the cosine of an angle are computed together."""
        if kind not in (SINE, COSINE):
            return super().operation(kind, first, second)
        angle = self.affine(first)
        if first.key not in self._sines_and_cosines:
            self.angles.append(angle)
            self._sines_and_cosines[first.key] = sine_and_cosine(self.emit, angle)
        return self._sines_and_cosines[first.key][kind == COSINE]

    def run(self, graph: Graph, quantities: Iterable[int], locations: Mapping[int, Location] = NO_LOCATIONS) -> None:
        """Write code that computes `quantities` in this order, and stores quantity i at locations[i] if i is a key."""
        if not locations:
            return super().run(graph, quantities)
        for i in quantities:
            super().run(graph, [i])
            if i in locations:
                self.emit.store(self.value(i), *locations[i])
                self._locations[i] = locations[i]
                self._quantities.mark_stored(i)
        return None

    def run_program(self, program: Program) -> list[list[Value]]:
        """Write code for the arrays of a program and the quantities on which their validity depends; return the arrays.

        If the function is split into parts, each number is computed right before its use, so that few numbers have to
        be kept from one part to the next; LLVM reorders instructions only within a part.
        """
        graph = program.graph
        if not self.emit.builder.module.splits_blocks:
            self.run(graph, program.quantities(self._computed_quantities))
            return [[self.affine(expr) for expr in exprs] for exprs in program.arrays.values()]
        arrays = [[self.expressions(graph, [expr])[0] for expr in exprs] for exprs in program.arrays.values()]
        self.run(graph, graph.quantities_by_use(program.expressions, self._computed_quantities))
        return arrays

    def expressions(self, graph: Graph, exprs: Sequence[Affine]) -> list[Value]:
        """Write code for expressions, and for quantities in them that were not computed before; return the values."""
        quantities = graph.quantities_by_use(exprs, self._computed_quantities)
        self.run(graph, quantities)
        self._computed_quantities.update(quantities)
        return [self.affine(expr) for expr in exprs]

    def is_valid(self, program: Program, values: Sequence[Value]) -> Value:
        """Return 1 if all `conditions` of a program hold, `values` are finite, and |angles| < LARGEST_ANGLE, else 0."""
        emit, builder, zero = self.emit, self.emit.builder, self.emit.constant(0.0)
        total = zero
        for value in values:  # values that are not finite make the sum NaN
            total = total + value * zero
        is_valid = builder.compare("fcmp oeq", total, zero)
        pairs = [(self.affine(larger), self.affine(smaller)) for larger, smaller in program.conditions]
        pairs += [(emit.constant(LARGEST_ANGLE), abs(angle)) for angle in self.angles]
        for larger, smaller in pairs:
            is_valid = is_valid & (larger > smaller)
        return is_valid


def lower_program(
    emit: Emitter, program: Program, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[Lowering, list[list[Value]]]:
    """Write code that evaluates a program at `inputs`; return the Lowering, and the values of the program's arrays."""
    lowering = Lowering(emit, numbers)
    return lowering, program.run(lowering, inputs)

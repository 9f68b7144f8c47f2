"""Emitter of arithmetic on SIMD vectors as LLVM code: every number is a vector, with one run in each of its lanes.

Collocation steps have one stage in each lane instead; `load_lanes` and `store_lanes` count places in numbers.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from twoloop.generate.coefficients import Coefficient
from twoloop.generate.llvm_code import INTRINSICS, Emitter
from twoloop.generate.llvm_text import BIT, DOUBLE, INTEGER, Builder, Value, integer, undefined, vector_of
from twoloop.kernels.data.collocation import LANES as STAGES
from twoloop.kernels.lanes.layout import LANES

# log2 on [1, 2] and 2^x on [-1/2, 1/2], fitted by least squares at Chebyshev points: good to 2e-06 and 1e-07, for the
# lengths of steps
LOG2 = (-3.03460285, 6.089895763, -5.301709109, 3.249466561, -1.247962495, 0.2700374574, -0.02512320329)
EXP2 = (1.000000075, 0.6931472067, 0.2402210736, 0.05550327214, 0.009676037098, 0.001340043216)
LARGEST_POWER, SMALLEST = 1000.0, 1e-300


class LaneEmitter(Emitter):
    """Emitter of operations on vectors with one number for each lane; places in memory are counted in such vectors."""

    constants: Value  # pointer to the numbers that all lanes share

    def __init__(self, builder: Builder, lanes: int = LANES):
        super().__init__(builder)
        self.lanes, self.suffix = lanes, f"v{lanes}f64" if lanes > 1 else Emitter.suffix
        self.double, self.whole_number, self.bit = (vector_of(kind, lanes) for kind in (DOUBLE, INTEGER, BIT))

    def like(self, builder: Builder) -> "LaneEmitter":
        """Return an emitter with the same number of lanes for another function."""
        return LaneEmitter(builder, self.lanes)

    def splat(self, value: Value) -> Value:
        """Emit a vector with one number in all lanes."""
        if self.lanes == 1:
            return value
        vector = self.builder.insert(undefined(vector_of(value.type, self.lanes)), value, 0)
        return self.builder.first_everywhere(vector)

    def far(self, value: float) -> Value:
        """Emit a vector with one number in all lanes that is loaded where it is used."""
        return self.splat(super().far(value))

    def known(self, number: float) -> Value:
        """Return a literal, or load a coefficient: one for all lanes, or one for each."""
        if not isinstance(number, Coefficient) or number.varies:
            return super().known(number)
        place = self.builder.gep(self.constants, integer(number.place))
        return self.splat(self.builder.load(place, constant=True))

    def number(self, whole: Value) -> Value:
        """Convert an integer to a vector with that number in all lanes."""
        return self.splat(super().number(whole))

    def pointer(self, base: Value, *places: Value | int) -> Value:
        """Return a pointer advanced by a number of vectors."""
        for place in places:
            scaled = (
                integer(place * self.lanes) if isinstance(place, int) else self.builder.mul(place, integer(self.lanes))
            )
            base = self.builder.gep(base, scaled)
        return base

    def load(self, base: Value, place: int = 0, constant: bool = False) -> Value:
        """Load the vector at a place."""
        pointer = self.builder.convert("bitcast", self.pointer(base, place), f"{self.double}*")
        return self.builder.load(pointer, constant=constant)

    def store(self, value: Value, base: Value, place: int = 0) -> None:
        """Store a vector at a place."""
        self.builder.store(value, self.builder.convert("bitcast", self.pointer(base, place), f"{self.double}*"))

    def function(self, name: str, x: Value) -> Value:
        """Apply an LLVM intrinsic to all lanes at once, or a function of libm lane by lane."""
        if name in INTRINSICS:
            return super().function(name, x)
        made, one = undefined(self.double), Emitter(self.builder)
        for lane in range(self.lanes):
            made = self.builder.insert(made, one.function(name, self.builder.extract(x, lane)), lane)
        return made

    def largest_lane(self, x: Value) -> Value:
        """Return the largest number of all lanes; LLVM's own reduction is sequential because of NaN."""
        width = self.lanes
        while width > 2:
            width //= 2
            x = self.larger(*(self.builder.shuffle(x, x, range(k, k + width)) for k in (0, width)))
        return x if width == 1 else self.larger(*(self.builder.extract(x, k) for k in (0, 1)))

    def largest_whole(self, x: Value) -> Value:
        """Return the largest of whole numbers in all lanes, as an integer."""
        return self.builder.convert("fptosi", self.largest_lane(x), INTEGER)

    def logarithm(self, x: Value) -> Value:
        """Return log2 x to within 1e-4 for numbers that are not negative; below SMALLEST, the value at SMALLEST."""
        builder = self.builder
        bits = builder.convert("bitcast", self.larger(x, self.constant(SMALLEST)), self.whole_number)
        exponent = builder.sub(builder.operation("lshr", bits, self.whole(52)), self.whole(1023))
        rest = builder.operation("or", builder.both(bits, self.whole((1 << 52) - 1)), self.whole(1023 << 52))
        return self.add(
            builder.convert("sitofp", exponent, self.double),
            self.polynomial(LOG2, builder.convert("bitcast", rest, self.double)),
        )

    def exponential(self, x: Value) -> Value:
        """Return 2^x to a relative error of 1e-4."""
        builder = self.builder
        x = self.larger(self.smaller(x, self.constant(LARGEST_POWER)), self.constant(-LARGEST_POWER))
        whole = self.function("rint", x)
        bits = builder.operation(
            "shl", builder.add(builder.convert("fptosi", whole, self.whole_number), self.whole(1023)), self.whole(52)
        )
        return self.multiply(
            builder.convert("bitcast", bits, self.double), self.polynomial(EXP2, self.subtract(x, whole))
        )

    def smallest_of(self, a: Value, b: Value) -> Value:
        """Return the smaller of two numbers; the first if one of them is NaN, so that a NaN in the first is kept."""
        return self.builder.select(self.builder.compare("fcmp ult", a, b), a, b)

    def largest_of(self, a: Value, b: Value) -> Value:
        """Return the larger of two numbers; the first if one of them is NaN, so that a NaN in the first is kept."""
        return self.builder.select(self.builder.compare("fcmp ugt", a, b), a, b)


def place_of(emit: LaneEmitter, k: Value) -> Value:
    """Return the index of vector k in memory, in numbers."""
    return emit.builder.mul(k, integer(STAGES))


def load_lanes(emit: LaneEmitter, base: Value, place: int = 0) -> Value:
    """Load a vector at an index that counts numbers."""
    return Emitter(emit.builder).load_vector(base, place, STAGES)


def store_lanes(emit: LaneEmitter, value: Value, base: Value, place: int = 0) -> None:
    """Store a vector at an index that counts numbers."""
    Emitter(emit.builder).store_vector(value, base, place)


def two_sums(emit: LaneEmitter, a: Value, b: Value) -> list[Value]:
    """Return the sum of the lanes of each of two vectors, computed side by side."""
    builder, half = emit.builder, STAGES // 2
    lower, upper = ([*range(k, k + half), *range(STAGES + k, STAGES + k + half)] for k in (0, half))
    total = emit.add(builder.shuffle(a, b, lower), builder.shuffle(a, b, upper))
    for distance in (2, 1):
        total = emit.add(total, builder.shuffle(total, total, [k ^ distance for k in range(STAGES)]))
    return [builder.extract(total, k) for k in (0, half)]


def column(emit: LaneEmitter, vectors: Sequence[Value], lane: int) -> Value:
    """Return a vector of one lane of each of some vectors."""
    builder, places = emit.builder, [lane, STAGES + lane]
    if len(vectors) == 1:
        return builder.extract(vectors[0], lane)
    while len(vectors) > 1:
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [builder.shuffle(*pair, places) for pair in pairs]
        places = list(range(2 * len(places)))
    return vectors[0]


@contextmanager
def over(
    emit: LaneEmitter, coordinates: Sequence[int], carried: Sequence[Value] = ()
) -> Iterator[tuple[Value, Value, list[Any], list[Any]]]:
    """Loop over some coordinates: yield the count, the coordinate, and the carried values of `Emitter.loop`."""
    builder = emit.builder
    table = None if list(coordinates) == list(range(len(coordinates))) else builder.module.table(coordinates)
    with emit.loop(integer(0), integer(len(coordinates)), carried) as (k, values, new):
        i = k if table is None else builder.convert("sext", builder.load(builder.gep(table, k), 4), INTEGER)
        yield k, i, values, new

"""Arithmetic of many runs at once as LLVM code: every number is a vector, with one run in each of its lanes."""

from collections.abc import Sequence

from llvmlite import ir

from twoloop.generate.coefficients import Coefficient
from twoloop.generate.llvm_code import DOUBLE, INTEGER, INTRINSICS, WORD, Emitter, Value
from twoloop.kernels.lanes import LANES

# log2 on [1, 2] and 2^x on [-1/2, 1/2], fitted by least squares at Chebyshev points, highest power first: good to 2e-06
# and 1e-07, for the lengths of steps
LOG2 = (-0.02512320329, 0.2700374574, -1.247962495, 3.249466561, -5.301709109, 6.089895763, -3.03460285)
EXP2 = (0.001340043216, 0.009676037098, 0.05550327214, 0.2402210736, 0.6931472067, 1.000000075)
LARGEST_POWER, SMALLEST = 1000.0, 1e-300

LANE, MASK, WHOLE = (ir.VectorType(kind, LANES) for kind in (DOUBLE, ir.IntType(1), INTEGER))


class LaneEmitter(Emitter):
    """Appends operations on vectors of one number for each lane; places in memory are counted in such vectors."""

    double, integer, bit = LANE, WHOLE, MASK
    constants: Value  # where numbers stand that all lanes have in common

    def splat(self, value: Value) -> Value:
        """A number of all lanes."""
        vector = self.builder.insert_element(ir.VectorType(value.type, LANES)(ir.Undefined), value, WORD(0))
        zeros = ir.Constant(ir.VectorType(WORD, LANES), [0] * LANES)
        return self.builder.shuffle_vector(vector, vector, zeros)

    def known(self, number: float) -> Value:
        """A number that is known, or read: of all lanes, or one for each."""
        if not isinstance(number, Coefficient) or number.varies:
            return super().known(number)
        value = self.builder.load(self.builder.gep(self.constants, [INTEGER(number.place)], inbounds=True))
        value.set_metadata("invariant.load", self.builder.module.add_metadata([]))
        return self.splat(value)

    def constant(self, value: float) -> Value:
        """A number that stands in the code."""
        return ir.Constant(LANE, [float(value)] * LANES)

    def whole(self, value: int) -> Value:
        """An integer that stands in the code, of those that go with numbers."""
        return ir.Constant(WHOLE, [value] * LANES)

    def number(self, integer: Value) -> Value:
        """An integer as a number."""
        return self.splat(self.builder.sitofp(integer, DOUBLE))

    def pointer(self, base: Value, *places: Value | int) -> Value:
        """A pointer some vectors further on."""
        scaled = (
            INTEGER(place * LANES) if isinstance(place, int) else self.builder.mul(place, INTEGER(LANES))
            for place in places
        )
        for place in scaled:
            base = self.builder.gep(base, [place], inbounds=True)
        return base

    def load(self, base: Value, place: int = 0) -> Value:
        """The vector at a place."""
        return self.builder.load(self.builder.bitcast(self.pointer(base, place), LANE.as_pointer()), align=8)

    def store(self, value: Value, base: Value, place: int = 0) -> None:
        """Put a vector at a place."""
        self.builder.store(value, self.builder.bitcast(self.pointer(base, place), LANE.as_pointer()), align=8)

    def fused(self, a: Value, b: Value, c: Value) -> Value:
        """a b + c, rounded once."""
        return self.builder.call(self._intrinsic("llvm.fma", 3), [a, b, c])

    def function(self, name: str, x: Value) -> Value:
        """A function of LLVM, of all lanes, or of libm, lane by lane."""
        if name in INTRINSICS:
            return self.builder.call(self._intrinsic(INTRINSICS[name], 1), [x])
        made, one = LANE(ir.Undefined), Emitter(self.builder)
        for lane in range(LANES):
            value = one.function(name, self.builder.extract_element(x, WORD(lane)))
            made = self.builder.insert_element(made, value, WORD(lane))
        return made

    def larger(self, a: Value, b: Value) -> Value:
        """The larger of two numbers."""
        return self.builder.select(self.builder.fcmp_ordered(">", a, b), a, b)

    def smaller(self, a: Value, b: Value) -> Value:
        """The smaller of two numbers."""
        return self.builder.select(self.builder.fcmp_ordered("<", a, b), a, b)

    def logarithm(self, x: Value) -> Value:
        """log2 x to a hundredth of a per cent of 1, of what is not negative, as if none were below SMALLEST."""
        builder = self.builder
        bits = builder.bitcast(self.larger(x, self.constant(SMALLEST)), WHOLE)
        exponent = builder.sub(builder.lshr(bits, self.whole(52)), self.whole(1023))
        rest = builder.or_(builder.and_(bits, self.whole((1 << 52) - 1)), self.whole(1023 << 52))
        return self.add(builder.sitofp(exponent, LANE), self._polynomial(LOG2, builder.bitcast(rest, LANE)))

    def exponential(self, x: Value) -> Value:
        """2^x to a hundredth of a per cent."""
        builder = self.builder
        x = self.larger(self.smaller(x, self.constant(LARGEST_POWER)), self.constant(-LARGEST_POWER))
        whole = self.function("rint", x)
        bits = builder.shl(builder.add(builder.fptosi(whole, WHOLE), self.whole(1023)), self.whole(52))
        return self.multiply(builder.bitcast(bits, LANE), self._polynomial(EXP2, self.subtract(x, whole)))

    def _polynomial(self, coefficients: Sequence[float], x: Value) -> Value:
        total = self.constant(coefficients[0])
        for coefficient in coefficients[1:]:
            total = self.fused(total, x, self.constant(coefficient))
        return total

    def largest_of(self, a: Value, b: Value) -> Value:
        """The larger of two numbers; the first where it is NaN, which stays."""
        return self.builder.select(self.builder.fcmp_unordered(">", a, b), a, b)

    def _intrinsic(self, name: str, n: int) -> Value:
        module, full = self.builder.module, f"{name}.v{LANES}f64"
        return module.globals.get(full) or ir.Function(module, ir.FunctionType(LANE, [LANE] * n), full)

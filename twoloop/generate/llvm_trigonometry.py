"""Sine and cosine as LLVM code without a call, so that those of several angles are computed side by side."""

from twoloop.generate.llvm_code import Emitter
from twoloop.generate.llvm_text import Value

# sine and cosine on [-pi/4, pi/4]: coefficients of x^3, x^5, ... and of x^4, x^6, ... by S. Moshier's Cephes library,
# sin.c; an angle is reduced by multiples of pi/2, which is the sum of two numbers
LARGEST_ANGLE = 1e6  # beyond, the sum is not enough
HALF_PI = (1.5707963267948966, 6.123233995736766e-17)
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
    """Both, right to rounding for angles up to LARGEST_ANGLE."""
    builder, whole = emit.builder, emit.whole
    turns = emit.function("rint", builder.operation("fmul", x, emit.far(1.0 / HALF_PI[0])))
    rest = x
    for part in HALF_PI:
        rest = emit.fused(turns, emit.far(-part), rest)
    square = builder.operation("fmul", rest, rest)
    fourth = builder.operation("fmul", square, square)
    sine = emit.fused(builder.operation("fmul", square, rest), emit.polynomial(SINES, square), rest)
    cosine = emit.fused(square, emit.far(-0.5), emit.constant(1.0))
    cosine = emit.fused(fourth, emit.polynomial(COSINES, square), cosine)
    quarter = builder.convert("fptosi", turns, emit.whole_number)
    odd, following = builder.convert("trunc", quarter, emit.bit), builder.add(quarter, whole(1))
    made = []
    for one, other, number in ((cosine, sine, quarter), (sine, cosine, following)):
        sign = builder.operation("shl", builder.both(number, whole(2)), whole(62))
        bits = builder.convert("bitcast", builder.select(odd, one, other), emit.whole_number)
        made.append(builder.convert("bitcast", builder.operation("xor", bits, sign), emit.double))
    return made[0], made[1]

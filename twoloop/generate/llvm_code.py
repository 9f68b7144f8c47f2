"""Arithmetic on numbers in memory as LLVM code, for code made for one mechanism.

Numba takes milliseconds for a line of source, and LLVM well below a millisecond for an operation. So a long list of
operations goes to LLVM directly, by numba's `intrinsic`, and numba sees a single call.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from weakref import WeakMethod

from llvmlite import ir
from numba.extending import intrinsic

from twoloop.generate.coefficients import Coefficient, Terms
from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.private import make_array, signature
from twoloop.kernels.data.common import OPTIONS

Value = Any  # of LLVM: a double, a vector of doubles, an integer or a pointer to doubles

FLAGS = tuple(sorted(OPTIONS["fastmath"]))
DOUBLE, INTEGER, WORD = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
ZERO, ONE = DOUBLE(0.0), DOUBLE(1.0)
ALIGNMENT = 64  # bytes, of a line of the cache, in two of which no vector lies
SLACK = ALIGNMENT // 8  # doubles that are lost where vectors begin at the next such place
# functions of LLVM; others are those of libm
INTRINSICS = {name: f"llvm.{name}" for name in ("sin", "cos", "exp", "log", "sqrt", "rint", "fabs")}


class Emitter:
    """Appends operations to a function of LLVM.

    Operations are on doubles or on vectors of them. Places in memory are counted in doubles. `numbers` points to those
    that the code reads.
    """

    double: ir.Type = DOUBLE
    integer: ir.Type = INTEGER
    bit: ir.Type = ir.IntType(1)

    def __init__(self, builder: ir.IRBuilder, numbers: Value = None):
        self.builder, self.numbers = builder, numbers

    def constant(self, value: float) -> Value:
        """A number that stands in the code."""
        return self.double(value)

    def whole(self, value: int) -> Value:
        """An integer that stands in the code, of those that go with numbers."""
        return self.integer(value)

    def known(self, number: float) -> Value:
        """A number that is known, or read, which never changes."""
        if not isinstance(number, Coefficient):
            return self.constant(number)
        value = self.load(self.numbers, number.place)
        value.set_metadata("invariant.load", self.builder.module.add_metadata([]))
        return value

    def add(self, a: Value, b: Value) -> Value:
        """a + b."""
        return self.builder.fadd(a, b, flags=FLAGS)

    def subtract(self, a: Value, b: Value) -> Value:
        """a - b."""
        return self.builder.fsub(a, b, flags=FLAGS)

    def multiply(self, a: Value, b: Value) -> Value:
        """a b."""
        return self.builder.fmul(a, b, flags=FLAGS)

    def divide(self, a: Value, b: Value) -> Value:
        """a / b."""
        return self.builder.fdiv(a, b, flags=FLAGS)

    def fused(self, a: Value, b: Value, c: Value) -> Value:
        """a b + c, rounded once."""
        return self.builder.fma(a, b, c)

    def negative(self, a: Value) -> Value:
        """-a."""
        return self.builder.fneg(a, flags=FLAGS)

    def times(self, factor: float, a: Value) -> Value:
        """A multiple of a number by a known one."""
        if factor in (1.0, -1.0):
            return a if factor == 1.0 else self.negative(a)
        return self.multiply(self.known(factor), a)

    def number(self, integer: Value) -> Value:
        """An integer as a double."""
        return self.builder.sitofp(integer, DOUBLE)

    def function(self, name: str, x: Value) -> Value:
        """A function of libm, of a number."""
        known, module = INTRINSICS.get(name), self.builder.module
        if known:
            function = module.declare_intrinsic(known, [DOUBLE])
        else:
            function = module.globals.get(name) or ir.Function(module, ir.FunctionType(DOUBLE, [DOUBLE]), name)
        return self.builder.call(function, [x])

    def pointer(self, base: Value, *places: Value | int) -> Value:
        """A pointer some doubles further on."""
        for place in places:
            base = self.builder.gep(base, [INTEGER(place) if isinstance(place, int) else place], inbounds=True)
        return base

    def aligned(self, pointer: Value) -> Value:
        """The next pointer at which vectors may begin."""
        address = self.builder.add(self.builder.ptrtoint(pointer, INTEGER), INTEGER(ALIGNMENT - 1))
        return self.builder.inttoptr(self.builder.and_(address, INTEGER(-ALIGNMENT)), pointer.type)

    def load(self, base: Value, place: int = 0) -> Value:
        """The number at a place."""
        return self.builder.load(self.pointer(base, place))

    def store(self, value: Value, base: Value, place: int = 0) -> None:
        """Put a number at a place."""
        self.builder.store(value, self.pointer(base, place))

    def load_vector(self, base: Value, place: int, width: int) -> Value:
        """As many numbers side by side; base + place is aligned to them.

        Slow just after they were stored one by one, because the processor then waits until they are in its cache.
        """
        pointer = self.builder.bitcast(self.pointer(base, place), vector_type(width).as_pointer())
        return self.builder.load(pointer, align=8 * width)

    def store_vector(self, value: Value, base: Value, place: int) -> None:
        """Put numbers side by side; base + place is aligned to them."""
        pointer = self.builder.bitcast(self.pointer(base, place), value.type.as_pointer())
        self.builder.store(value, pointer, align=8 * getattr(value.type, "count", 1))

    def vector(self, values: Sequence[Value]) -> Value:
        """Coefficients side by side; one number as it is."""
        if len(values) == 1:
            return values[0]
        vector = vector_type(len(values))(ir.Undefined)
        for place, value in enumerate(values):
            vector = self.builder.insert_element(vector, value, WORD(place))
        return vector

    def elements(self, vector: Value) -> list[Value]:
        """The numbers of a vector."""
        if vector.type == DOUBLE:
            return [vector]
        return [self.builder.extract_element(vector, WORD(place)) for place in range(vector.type.count)]

    @contextmanager
    def loop(self, first: Value, end: Value, initial: Sequence[Value]) -> Iterator[tuple[Value, list[Any], list[Any]]]:
        """A loop over integers from `first` to below `end`.

        Yields the integer; what is carried from one turn to the next, `initial` in the first; and a list that takes
        its new values. After the loop that list has the last ones.
        """
        builder = self.builder
        before, body, after = builder.block, builder.append_basic_block(), builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("<", first, end), body, after)
        builder.position_at_end(body)
        index = builder.phi(INTEGER)
        index.add_incoming(first, before)
        carried = [builder.phi(value.type) for value in initial]
        new: list[Any] = []
        yield index, carried, new
        following, last = builder.add(index, INTEGER(1)), builder.block
        index.add_incoming(following, last)
        builder.cbranch(builder.icmp_signed("<", following, end), body, after)
        builder.position_at_end(after)
        for k, value in enumerate(initial):
            result = builder.phi(value.type)
            for phi in (carried[k], result):
                phi.add_incoming(value, before)
                phi.add_incoming(new[k], last)
            new[k] = result


class Quantities:
    """Values of numbered quantities, and sums of multiples of them; each is loaded, or summed, once.

    Parameters
    ----------
    emit : Emitter
    load : callable
        Emits the value of a quantity that was not defined.
    """

    def __init__(self, emit: Emitter, load: Callable[[int], Value]):
        self._emit, self._load = emit, load
        self._values: dict[int, Value] = {}
        self._sums: dict[tuple[Terms, float], Value] = {}

    def define(self, quantity: int, value: Value) -> None:
        """Give a quantity its value."""
        self._values[quantity] = value

    def value(self, quantity: int) -> Value:
        """What was defined, or loaded."""
        if quantity not in self._values:
            self._values[quantity] = self._load(quantity)
        return self._values[quantity]

    def sum(self, terms: Terms, constant: float = 0.0) -> Value:
        """constant + the sum of coefficient * quantity."""
        key = terms, constant
        if key not in self._sums:
            total = None if constant == 0.0 and terms else self._emit.known(constant)
            for quantity, coefficient in terms:
                value = self.value(quantity)
                if total is None:
                    total = self._emit.times(coefficient, value)
                elif coefficient == -1.0:
                    total = self._emit.subtract(total, value)
                else:
                    total = self._emit.add(total, self._emit.times(coefficient, value))
            self._sums[key] = total
        return self._sums[key]


def emitted(emit: Callable[..., Any], result: Any, emitter: Callable[..., Emitter] = Emitter, **arguments: Any) -> Any:
    """What numba takes for a function, whose code is written by emit(emitter, *arguments), `numbers` apart.

    Parameters
    ----------
    emit : method
        Gets vectors as pointers to their first elements; returns the result, None for `types.none`. Numba keeps what
        this returns permanently, so that it holds the method's object weakly: it must live until it is compiled.
    result : numba type
    emitter : callable
    **arguments : numba types
        Under their names.
    """
    written_by = WeakMethod(emit)

    def typing(typingctx, *given):  # type: ignore[no-untyped-def]
        def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
            plain = [
                make_array(VECTOR)(context, builder, value).data if kind == VECTOR else value
                for kind, value in zip(sig.args, values, strict=True)
            ]
            given = dict(zip(arguments, plain, strict=True))
            made = written_by()(emitter(builder, given.pop("numbers", None)), *given.values())  # type: ignore[misc]
            return context.get_dummy_value() if made is None else made

        return signature(result, *arguments.values()), generate

    names = ["typingctx", *arguments]
    parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
    typing.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # where numba looks for names
    return intrinsic(typing)


def vector_type(width: int) -> ir.Type:
    """Of so many doubles; one is a double."""
    return DOUBLE if width == 1 else ir.VectorType(DOUBLE, width)

"""Arithmetic on numbers in memory as LLVM code, for code made for one mechanism.

Numba takes milliseconds for a line of source, and LLVM microseconds for an operation. So what is nothing but a long
list of operations is handed to LLVM directly, by numba's `intrinsic`, and numba sees a single call.
"""

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from llvmlite import ir
from numba.core.typing import signature
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

from twoloop.callbacks import VECTOR
from twoloop.kernels.common import OPTIONS

Value = Any  # of LLVM
Terms = tuple[tuple[int, float], ...]  # quantities and their coefficients

FLAGS = tuple(sorted(OPTIONS["fastmath"]))
DOUBLE, INTEGER, WORD = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
ALIGNMENT = 64  # bytes: no vector lies in two lines of the cache
INTRINSICS = {name: f"llvm.{name}" for name in ("sin", "cos", "exp", "log", "sqrt")}  # other functions are libm's


class Emitter:
    """Appends operations to a function of LLVM; pointers are to doubles, places are counted in doubles."""

    def __init__(self, builder: ir.IRBuilder):
        self.builder = builder

    def add(self, a: Value, b: Value) -> Value:
        return self.builder.fadd(a, b, flags=FLAGS)

    def subtract(self, a: Value, b: Value) -> Value:
        return self.builder.fsub(a, b, flags=FLAGS)

    def multiply(self, a: Value, b: Value) -> Value:
        return self.builder.fmul(a, b, flags=FLAGS)

    def divide(self, a: Value, b: Value) -> Value:
        return self.builder.fdiv(a, b, flags=FLAGS)

    def negative(self, a: Value) -> Value:
        return self.builder.fneg(a, flags=FLAGS)

    def times(self, factor: float, a: Value) -> Value:
        """A multiple by a known number."""
        if abs(factor) == 1.0:
            return a if factor == 1.0 else self.negative(a)
        return self.multiply(DOUBLE(factor), a)

    def number(self, integer: Value) -> Value:
        """An integer as a double."""
        return self.builder.sitofp(integer, DOUBLE)

    def function(self, name: str, x: Value) -> Value:
        """A function of libm."""
        known = INTRINSICS.get(name)
        module = self.builder.module
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
        return self.builder.load(self.pointer(base, place))

    def store(self, value: Value, base: Value, place: int = 0) -> None:
        self.builder.store(value, self.pointer(base, place))

    def vector(self, values: Sequence[Value]) -> Value:
        """Numbers side by side, as many as a power of 2; one number as it is."""
        if len(values) == 1:
            return values[0]
        kind = ir.VectorType(DOUBLE, len(values))
        vector = kind(ir.Undefined)
        for place, value in enumerate(values):
            vector = self.builder.insert_element(vector, value, WORD(place))
        return vector

    def elements(self, vector: Value) -> list[Value]:
        """The numbers of a vector."""
        if vector.type == DOUBLE:
            return [vector]
        return [self.builder.extract_element(vector, WORD(place)) for place in range(vector.type.count)]

    def same(self, value: Value, width: int) -> Value:
        """A vector of equal numbers."""
        return self.vector([value] * width)

    def load_vector(self, base: Value, place: int, width: int) -> Value:
        """Numbers side by side, of an aligned pointer."""
        pointer = self.builder.bitcast(self.pointer(base, place), vector_type(width).as_pointer())
        return self.builder.load(pointer, align=8 * width)

    def store_vector(self, value: Value, base: Value, place: int) -> None:
        """The same into memory."""
        pointer = self.builder.bitcast(self.pointer(base, place), value.type.as_pointer())
        self.builder.store(value, pointer, align=8 * getattr(value.type, "count", 1))

    @contextmanager
    def loop(
        self, first: Value, end: Value, initial: Sequence[Value]
    ) -> Iterator[tuple[Value, list[Value], list[Value]]]:
        """A loop over integers from `first` to below `end`: the integer, what is carried from one turn to the next, and
        a list that takes its new values; after the loop it has the last ones."""
        builder = self.builder
        before, body, after = builder.block, builder.append_basic_block(), builder.append_basic_block()
        builder.cbranch(builder.icmp_signed("<", first, end), body, after)
        builder.position_at_end(body)
        index = builder.phi(INTEGER)
        index.add_incoming(first, before)
        carried = [builder.phi(value.type) for value in initial]
        new: list[Value] = []
        yield index, carried, new
        following, last = builder.add(index, INTEGER(1)), builder.block
        index.add_incoming(following, last)
        builder.cbranch(builder.icmp_signed("<", following, end), body, after)
        builder.position_at_end(after)
        for k, value in enumerate(initial):
            carried[k].add_incoming(value, before)
            carried[k].add_incoming(new[k], last)
            result = builder.phi(value.type)
            result.add_incoming(value, before)
            result.add_incoming(new[k], last)
            new[k] = result


def vector_type(width: int) -> ir.Type:
    """Of so many doubles side by side; one is a double."""
    return DOUBLE if width == 1 else ir.VectorType(DOUBLE, width)


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
        self._sums: dict[tuple[float, Terms], Value] = {}

    def define(self, quantity: int, value: Value) -> None:
        self._values[quantity] = value

    def value(self, quantity: int) -> Value:
        if quantity not in self._values:
            self._values[quantity] = self._load(quantity)
        return self._values[quantity]

    def sum(self, terms: Terms, constant: float = 0.0) -> Value:
        """constant + sum of coefficient * quantity."""
        key = constant, terms
        if key not in self._sums:
            self._sums[key] = self._sum(terms, constant)
        return self._sums[key]

    def _sum(self, terms: Terms, constant: float) -> Value:
        emit = self._emit
        total = None if constant == 0.0 and terms else DOUBLE(constant)
        for quantity, coefficient in terms:
            value = self.value(quantity)
            if total is None:
                total = emit.times(coefficient, value)
            elif coefficient == -1.0:
                total = emit.subtract(total, value)
            else:
                total = emit.add(total, emit.times(coefficient, value))
        return total


def emitted(emit: Callable[..., Value | None], result: Any, **arguments: Any) -> Any:
    """What numba takes for a function, whose code is written by emit(emitter, *arguments).

    Parameters
    ----------
    emit : callable
        Gets vectors as pointers to their first elements.
    result : numba type
    **arguments : numba types
    """

    def typing(typingctx, *given):  # type: ignore[no-untyped-def]
        def generate(context: Any, builder: Any, sig: Any, values: Any) -> Any:
            plain = [
                make_array(VECTOR)(context, builder, value).data if kind == VECTOR else value
                for kind, value in zip(sig.args, values, strict=True)
            ]
            made = emit(Emitter(builder), *plain)
            return context.get_dummy_value() if made is None else made

        return signature(result, *arguments.values()), generate

    names = ["typingctx", *arguments]  # numba looks for them here
    parameters = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in names]
    typing.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return intrinsic(typing)

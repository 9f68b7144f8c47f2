"""Lowering of programs to LLVM functions, with coefficients that are read from memory.

One code serves all mechanisms of the same structure: only the numbers that it reads differ.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.graph import Affine, Graph
from twoloop.generate.llvm_code import LARGEST_ANGLE, Emitter, Quantities, sine_and_cosine
from twoloop.generate.llvm_text import Value
from twoloop.generate.program import Algebra, Program
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    LOGARITHM,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
)

FUNCTIONS = {SQUARE_ROOT: "sqrt", EXPONENTIAL: "exp", LOGARITHM: "log", ARCTANGENT: "atan"}

Place = tuple[Value, int]  # an array, and an index in it
NOWHERE: Mapping[int, Place] = {}


class Lowering(Algebra[Value]):
    """Algebra of LLVM code: values are written into a function, as numbers or as SIMD lanes.

    Parameters
    ----------
    emit : Emitter
    numbers : Coefficients
    places : dict, optional
        Memory locations of quantities that were computed before.
    """

    def __init__(self, emit: Emitter, numbers: Coefficients, places: Mapping[int, Place] = NOWHERE):
        super().__init__()
        self.emit, self.numbers, self._places = emit, numbers, dict(places)
        self.angles: list[Value] = []  # arguments of sines and cosines, whose size is limited
        self.functions = {kind: partial(emit.function, name) for kind, name in FUNCTIONS.items()}
        self.functions[RECIPROCAL] = lambda x: emit.divide(emit.constant(1.0), x)
        self._quantities = Quantities(emit, lambda quantity: emit.load(*self._places[quantity]))
        self._pairs: dict[Any, tuple[Value, Value]] = {}  # sines and cosines, by the keys of their angles
        self._computed = set(places)

    def define(self, quantity: int, value: Value) -> None:
        """Define the value of a quantity."""
        self._quantities.define(quantity, value)

    def take(self, graph: Graph, given: Sequence[Value]) -> None:
        """Define the inputs of a graph, given as numbers or as arrays, which are loaded first."""
        first = 0
        for argument, size in zip(given, graph.sizes, strict=True):
            if argument.type == self.emit.double:
                self.define(first, argument)
            else:
                self._places |= {first + j: (argument, j) for j in range(size)}
                if not self.emit.builder.module.divided:
                    for quantity in range(first, first + size):
                        self.value(quantity)
            first += size

    def value(self, quantity: int) -> Value:
        """Return the value of a quantity."""
        return self._quantities.value(quantity)

    def affine(self, expression: Affine) -> Value:
        """Return the value of an affine expression."""
        return self._quantities.sum(*self.numbers.of_form(expression))

    def product(self, a: Value, b: Value) -> Value:
        """Return a b."""
        return self.emit.multiply(a, b)

    def operation(self, kind: int, first: Affine, second: Affine | None) -> Value:
        """Return the result of an operation; sine and cosine of an angle are computed together."""
        if kind not in (SINE, COSINE):
            return super().operation(kind, first, second)
        angle = self.affine(first)
        if first.key not in self._pairs:
            self.angles.append(angle)
            self._pairs[first.key] = sine_and_cosine(self.emit, angle)
        return self._pairs[first.key][kind == COSINE]

    def run(self, graph: Graph, quantities: Iterable[int], places: Mapping[int, Place] = NOWHERE) -> None:
        """Compute quantities in the given order; those in `places` are stored at once."""
        if not places:
            return super().run(graph, quantities)
        for i in quantities:
            super().run(graph, [i])
            if i in places:
                self.emit.store(self.value(i), *places[i])
                self._places[i] = places[i]
                self._quantities.stored(i)
        return None

    def outputs(self, program: Program) -> list[list[Value]]:
        """Compute the arrays of a program and the quantities of its conditions.

        In a divided function each number is computed just before it is used, as few numbers stay in registers from one
        part to the next, and LLVM reorders operations only within a part.
        """
        graph = program.graph
        if not self.emit.builder.module.divided:
            self.run(graph, program.quantities(self._computed))
            return [[self.affine(form) for form in forms] for forms in program.arrays.values()]
        arrays = [[self.forms(graph, [form])[0] for form in forms] for forms in program.arrays.values()]
        self.run(graph, graph.in_order_of_use(program.forms, self._computed))
        return arrays

    def forms(self, graph: Graph, forms: Sequence[Affine]) -> list[Value]:
        """Compute expressions; quantities that were computed before are not computed again."""
        quantities = graph.in_order_of_use(forms, self._computed)
        self.run(graph, quantities)
        self._computed.update(quantities)
        return [self.affine(form) for form in forms]

    def holds(self, program: Program, values: Sequence[Value]) -> Value:
        """Return whether the conditions hold, no angle is too large, and all values are finite."""
        emit, builder, zero = self.emit, self.emit.builder, self.emit.constant(0.0)
        total = zero
        for value in values:  # values that are not finite make the sum NaN
            total = emit.add(total, emit.multiply(value, zero))
        holds = builder.compare("fcmp oeq", total, zero)
        pairs = [(self.affine(larger), self.affine(smaller)) for larger, smaller in program.conditions]
        pairs += [(emit.constant(LARGEST_ANGLE), emit.function("fabs", angle)) for angle in self.angles]
        for larger, smaller in pairs:
            holds = builder.both(holds, builder.compare("fcmp ogt", larger, smaller))
        return holds


def lower(
    emit: Emitter, program: Program, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[Lowering, list[list[Value]]]:
    """Write a program; return its lowering and its arrays."""
    lowering = Lowering(emit, numbers)
    return lowering, program.run(lowering, inputs)

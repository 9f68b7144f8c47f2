"""Write operations of a graph into a function of LLVM, with coefficients that are read from memory.

One code serves all mechanisms of its structure: the numbers that it reads differ.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from twoloop.generate.coefficients import Coefficients
from twoloop.generate.elimination import Outputs
from twoloop.generate.graph import Affine, Graph
from twoloop.generate.llvm_code import LARGEST_ANGLE, Emitter, Quantities, sine_and_cosine
from twoloop.generate.llvm_text import BIT, Value
from twoloop.kernels.evaluation.operations import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    LOGARITHM,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
    SUM,
)

FUNCTIONS = {SQUARE_ROOT: "sqrt", EXPONENTIAL: "exp", LOGARITHM: "log", ARCTANGENT: "atan"}

TRUE = Value(BIT, "true")
Place = tuple[Value, int]
NOWHERE: Mapping[int, Place] = {}


class Lowering:
    """Values of the quantities of a graph, as they are written into a function.

    Parameters
    ----------
    emit : Emitter
    numbers : Coefficients
    places : dict, optional
        Arrays and places in them at which quantities stand that were found before.
    """

    def __init__(self, emit: Emitter, numbers: Coefficients, places: Mapping[int, Place] = NOWHERE):
        self.emit, self.numbers, self._places = emit, numbers, dict(places)
        self.angles: list[Value] = []  # of sines and cosines
        self._known = Quantities(emit, self._missing)
        self._pairs: dict[Any, tuple[Value, Value]] = {}
        self._made = set(places)

    def _missing(self, quantity: int) -> Value:
        return self.emit.load(*self._places[quantity])  # others are defined before they are used

    def define(self, quantity: int, value: Value) -> None:
        """Say what an input is."""
        self._known.define(quantity, value)

    def take(self, graph: Graph, given: Sequence[Value]) -> None:
        """Take the inputs of a graph, which are given as numbers or in memory, and loaded there first."""
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
        """The value of a quantity."""
        return self._known.value(quantity)

    def form(self, form: Affine) -> Value:
        """The value of a form."""
        return self._known.sum(*self.numbers.of_form(form))

    def operation(self, quantity: int, kind: int, first: Affine, second: Affine | None) -> None:
        """Compute a quantity."""
        emit, x = self.emit, self.form(first)
        if kind == PRODUCT:
            assert second is not None
            value = emit.multiply(x, self.form(second))
        elif kind == SUM:
            value = x
        elif kind == RECIPROCAL:
            value = emit.divide(emit.constant(1.0), x)
        elif kind in (SINE, COSINE):
            if first.key not in self._pairs:
                self.angles.append(x)
                self._pairs[first.key] = sine_and_cosine(emit, x)
            value = self._pairs[first.key][kind == COSINE]
        else:
            value = emit.function(FUNCTIONS[kind], x)
        self._known.define(quantity, value)

    def write(self, graph: Graph, quantities: Iterable[int], places: Mapping[int, Place] = NOWHERE) -> None:
        """Compute quantities, in their order; what has a place is stored there at once."""
        for i in quantities:
            operation = graph.operations[i]
            assert operation is not None
            self.operation(i, *operation)
            if i in places:
                self.emit.store(self._known.value(i), *places[i])
                self._places[i] = places[i]
                self._known.stored(i)

    def results(self, graph: Graph, outputs: Outputs) -> list[list[Value]]:
        """Compute arrays, and what conditions are made of.

        In a divided function each number is made just before it is used, as few numbers stay in registers from one part
        to the next; LLVM finds an order within a part only.
        """
        if not self.emit.builder.module.divided:
            self.write(graph, outputs.quantities(graph, self._made))
            return [[self.form(form) for form in forms] for forms in outputs.arrays.values()]
        results = [[self.forms(graph, [form])[0] for form in forms] for forms in outputs.arrays.values()]
        self.write(graph, graph.in_order_of_use(outputs.forms, self._made))
        return results

    def forms(self, graph: Graph, forms: Sequence[Affine]) -> list[Value]:
        """Compute forms; what was computed for others before is not computed again."""
        quantities = graph.in_order_of_use(forms, self._made)
        self.write(graph, quantities)
        self._made.update(quantities)
        return [self.form(form) for form in forms]


def results_of(
    emit: Emitter, graph: Graph, outputs: Outputs, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[Lowering, list[list[Value]]]:
    """Arrays that code computes from the inputs of a graph, in their order."""
    written = Lowering(emit, numbers)
    for quantity, value in enumerate(inputs):
        written.define(quantity, value)
    return written, written.results(graph, outputs)


def conditions_hold(emit: Emitter, written: Lowering, outputs: Outputs, values: Sequence[Value]) -> Value:
    """Whether what was written holds: its conditions, angles that are not too large, and values that are finite."""
    builder, zero = emit.builder, emit.constant(0.0)
    total = zero
    for value in values:  # what is not finite becomes NaN
        total = emit.add(total, emit.multiply(value, zero))
    holds = builder.compare("fcmp oeq", total, zero)
    pairs = [(written.form(one), written.form(other)) for one, other in outputs.conditions]
    pairs += [(emit.constant(LARGEST_ANGLE), emit.function("fabs", angle)) for angle in written.angles]
    for one, other in pairs:
        holds = builder.both(holds, builder.compare("fcmp ogt", one, other))
    return holds

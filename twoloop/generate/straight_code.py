"""Machine code for the equations of one mechanism: the tasks of the inner loop that explicit methods call.

The operations of `straight_line` become LLVM's instructions one by one, past numba, which would take seconds for some
hundred of them. The code is kept on disk as that of the kernels.
"""

import hashlib
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate import coefficients, llvm_code, llvm_text, llvm_trigonometry, straight_line
from twoloop.generate.choices import Choice
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.families import Evaluator, Family, of_family
from twoloop.generate.llvm_code import Emitter, Quantities
from twoloop.generate.llvm_text import DOUBLE, Module, Value
from twoloop.generate.llvm_trigonometry import LARGEST_ANGLE, sine_and_cosine
from twoloop.generate.straight_line import Outputs, StraightLine
from twoloop.generate.traced_values import Check, Traced, unchecked
from twoloop.generate.tracing import Form, Graph, Untraceable
from twoloop.kernels.compile.caches import digest_of
from twoloop.kernels.compile.own_functions import own_functions
from twoloop.kernels.compile.private import Dispatcher
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
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

FUNCTIONS = {SQUARE_ROOT: "sqrt", EXPONENTIAL: "exp", LOGARITHM: "log", ARCTANGENT: "atan"}


class Written:
    """Values of the quantities of a graph, as they are written into a function."""

    def __init__(self, emit: Emitter, numbers: Coefficients):
        self.emit, self.numbers = emit, numbers
        self.angles: list[Value] = []  # of sines and cosines
        self._known = Quantities(emit, self._missing)
        self._pairs: dict[Any, tuple[Value, Value]] = {}

    def _missing(self, quantity: int) -> Value:
        raise KeyError(quantity)  # every quantity is defined before it is used

    def define(self, quantity: int, value: Value) -> None:
        """Say what an input is."""
        self._known.define(quantity, value)

    def form(self, form: Form) -> Value:
        """The value of a form."""
        return self._known.sum(*self.numbers.of_form(form))

    def operation(self, quantity: int, kind: int, first: Form, second: Form | None) -> None:
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


def results_of(
    emit: Emitter, graph: Graph, outputs: Outputs, inputs: Sequence[Value], numbers: Coefficients
) -> tuple[Written, list[list[Value]]]:
    """Arrays that code computes from the inputs of a graph, in their order."""
    written = Written(emit, numbers)
    for quantity, value in enumerate(inputs):
        written.define(quantity, value)
    for i in outputs.quantities(graph):
        operation = graph.operations[i]
        assert operation is not None
        written.operation(i, *operation)
    return written, [[written.form(form) for form in forms] for forms in outputs.arrays.values()]


def conditions_hold(emit: Emitter, written: Written, outputs: Outputs, values: Sequence[Value]) -> Value:
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


def write_function(
    module: Module,
    name: str,
    kind: tuple[str, list[str]],
    graph: Graph,
    outputs: Outputs,
    numbers: Coefficients,
) -> None:
    """Write a function of inputs, of the values of `numbers`, and of arrays to fill.

    It returns whether the conditions hold and what it computes is finite, and fills the arrays only then.
    """

    def emit_all(emit: Emitter, *arguments: Value) -> Value:
        n_given = len(graph.sizes)
        given, emit.numbers, filled = arguments[:n_given], arguments[n_given], arguments[n_given + 1 :]
        inputs: list[Value] = []
        for argument, size in zip(given, graph.sizes, strict=True):
            inputs += [argument] if argument.type == DOUBLE else [emit.load(argument, j) for j in range(size)]
        written, results = results_of(emit, graph, outputs, inputs, numbers)
        holds = conditions_hold(emit, written, outputs, results[0])
        with emit.builder.if_then(holds):
            for place, array in zip(filled, results, strict=True):
                for j, value in enumerate(array):
                    emit.store(value, place, j)
        return holds

    llvm_code.write(module, name, kind, emit_all)


class SharedCode:
    """Functions made for the equations of a family of systems, compiled, or read from the disk.

    Parameters
    ----------
    equations : StraightLine
    family : Family

    Attributes
    ----------
    numbers : Coefficients
        Of the equations.
    digest : str
        Of all that the functions depend on, the values of these apart.
    functions : OwnFunctions
    projects : bool
        Whether they project, or give accelerations alone.
    """

    def __init__(self, equations: StraightLine, family: Family):
        self.equations, self.family, self.numbers = equations, family, Coefficients()
        structure = repr(list(_described(equations, self.numbers)))
        self.digest = hashlib.sha256((structure + _stamp()).encode()).hexdigest()
        self.projects = equations.closer is not None and equations.nearer is not None
        self.functions = own_functions("equations", _stamp(), self.digest, self._write)

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "OwnCode":
        """The code, and what it reads for one of the systems."""
        return OwnCode(self, evaluate(self.numbers.formulas), self.equations.traced.of(system, evaluate), evaluate)

    @property
    def inner(self) -> Dispatcher:
        """The inner loop that calls them."""
        from twoloop.kernels.evaluation import own_inner

        return own_inner.own_inner_loop if self.projects else own_inner.own_evaluations

    def _write(self) -> tuple[list[str], str]:
        module, equations = Module(), self.equations
        outputs: dict[str, Any] = {"own_there": equations.there}
        if self.projects:
            outputs |= {"own_closer": equations.closer, "own_nearer": equations.nearer}
            outputs |= {"own_redundant": equations.redundant}
        for name, each in outputs.items():
            write_own(module, name, equations.graph, each, self.numbers)
        return list(outputs), str(module)


class OwnCode(NamedTuple):
    """The code of a family, for one system."""

    shared: SharedCode
    numbers: Array  # that it reads
    traced: Traced
    evaluate: Evaluator  # of other formulas of the family

    @property
    def kinds(self) -> frozenset[str]:
        """Of callbacks that ran on symbols."""
        return self.traced.kinds

    def serves(self, system: ConstrainedSystem, t0: float, q0: Array) -> bool:
        """Whether a run of the same system from this position gets the same code."""
        try:
            return Choice.at(system, t0, q0) == self.shared.equations.choice
        except Untraceable:
            return False


def write_own(module: Module, name: str, graph: Graph, outputs: Outputs, numbers: Coefficients) -> None:
    """The same of one that kernels know by its name."""
    from twoloop.kernels.data.common import KIT

    write_function(module, name, KIT.own_type(name), graph, outputs, numbers)


def own_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = unchecked) -> OwnCode:
    """The code for a system, for a run that starts at a position; `check` raises where the callbacks are not in it.

    Raises
    ------
    ValueError
        If its equations cannot be had.
    """
    try:
        choice = system.remembered_at("choice", (t0, q0.tobytes()), lambda: Choice.at(system, t0, q0))

        def make(family: Family) -> SharedCode:
            return SharedCode(StraightLine(system, choice, family.parameters), family)

        made: OwnCode = of_family(system, ("code", choice), make, lambda code: check(code.traced))
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return made


def _described(equations: StraightLine, numbers: Coefficients) -> Iterable[Any]:
    yield equations.system.n_q, equations.choice.rows, equations.choice.added
    for outputs in (equations.there, equations.closer, equations.nearer, equations.redundant):
        if outputs is not None:
            yield {name: len(forms) for name, forms in outputs.arrays.items()}, len(outputs.conditions)
            yield list(numbers.structure(equations.graph, outputs.forms))


@cache
def _stamp() -> str:
    """A digest of what writes the functions, and of what they are called as."""
    from twoloop.kernels.data.common import KIT

    return digest_of(repr(KIT), __file__, straight_line, coefficients, llvm_code, llvm_text, llvm_trigonometry)

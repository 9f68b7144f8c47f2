"""Machine code for the equations of one mechanism: the tasks of the inner loop that explicit methods call.

The operations of `straight_line` become LLVM's instructions one by one, without numba's front end, which would
take seconds for some hundred of them. The code is kept on disk as that of the kernels.
"""

import hashlib
import weakref
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from twoloop.generate import coefficients, llvm_code, llvm_trigonometry, straight_line
from twoloop.generate.coefficients import Coefficients
from twoloop.generate.llvm_code import Emitter, Quantities, Value
from twoloop.generate.llvm_trigonometry import LARGEST_ANGLE, sine_and_cosine
from twoloop.generate.straight_line import Choice, Outputs, StraightLine
from twoloop.generate.traced_values import Check, unchecked
from twoloop.generate.tracing import Form, Graph, Untraceable
from twoloop.kernels.compile.caches import Newest, compile_kept, sources_folder
from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.private import Dispatcher, make_array
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
    holds = builder.fcmp_ordered("==", total, zero)
    pairs = [(written.form(one), written.form(other)) for one, other in outputs.conditions]
    pairs += [(emit.constant(LARGEST_ANGLE), emit.function("fabs", angle)) for angle in written.angles]
    for one, other in pairs:
        holds = builder.and_(holds, builder.fcmp_ordered(">", one, other))
    return holds


def function_of(graph: Graph, outputs: Outputs, numbers: Coefficients) -> Any:
    """A function for code that numba compiles: of inputs, of the values of `numbers`, and of vectors to fill.

    It returns whether the conditions hold and what it computes is finite, and fills the vectors only then. Numba keeps
    it permanently; what it is written from must live until it is compiled.
    """
    graph_there, outputs_there, numbers_there = weakref.ref(graph), weakref.ref(outputs), weakref.ref(numbers)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def pointer(vectors: Value, k: int) -> Value:
            return make_array(VECTOR)(context, builder, builder.extract_value(vectors, k)).data

        graph, outputs, numbers = graph_there(), outputs_there(), numbers_there()
        assert graph is not None and outputs is not None and numbers is not None
        given, values, filled = arguments
        emit, inputs = Emitter(builder, make_array(VECTOR)(context, builder, values).data), []
        for k, (kind, size) in enumerate(zip(signature.args[0], graph.sizes, strict=True)):
            for j in range(size):
                is_vector = kind == VECTOR
                inputs.append(emit.load(pointer(given, k), j) if is_vector else builder.extract_value(given, k))
        written, results = results_of(emit, graph, outputs, inputs, numbers)
        holds = conditions_hold(emit, written, outputs, results[0])
        with builder.if_then(holds):
            for k, array in enumerate(results):
                for j, value in enumerate(array):
                    emit.store(value, pointer(filled, k), j)
        return holds

    @intrinsic
    def function(typing: Any, given: Any, values: Any, filled: Any) -> Any:
        return types.boolean(given, values, filled), generate

    return function


_INNER = Newest()


class OwnCode:
    """The inner loop for a system, compiled for its equations, or read from the disk.

    Attributes
    ----------
    equations : StraightLine
    numbers : Coefficients
        What the code reads.
    digest : str
        Of all that the code depends on, the values of these apart.
    inner : Dispatcher
    """

    def __init__(self, equations: StraightLine):
        from twoloop.kernels.data import common

        self.equations, self.numbers = equations, Coefficients()
        digest = hashlib.sha256(repr(list(_described(equations, self.numbers))).encode())
        for module in (straight_line, coefficients, llvm_code, llvm_trigonometry):
            digest.update(Path(str(module.__file__)).read_bytes())
        digest.update(Path(__file__).read_bytes())
        self.digest = digest.hexdigest()
        inner = _INNER.get(self.digest)
        if inner is None:
            watched = common.stamp("evaluation.calls"), self.digest
            _INNER[self.digest] = inner = _inner(equations, self.numbers, watched)
        self.inner: Dispatcher = inner


def own_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = unchecked) -> OwnCode:
    """The code for a system, for a run that starts at a position; `check` raises where the callbacks are not in it.

    Raises
    ------
    ValueError
        If its equations cannot be had.
    """
    try:
        choice = system.remembered_at("choice", t0, (q0,), lambda: Choice.at(system, t0, q0))
        made: OwnCode = system.remembered(("code", choice), lambda: OwnCode(StraightLine(system, choice)))
        check(made.equations.traced)
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return made


def _described(equations: StraightLine, numbers: Coefficients) -> Iterable[Any]:
    yield equations.system.n_q, equations.choice.rows, equations.choice.added
    for outputs in (equations.there, equations.closer, equations.nearer, equations.redundant):
        if outputs is not None:
            yield {name: len(forms) for name, forms in outputs.arrays.items()}, len(outputs.conditions)
            yield list(numbers.structure(equations.graph, outputs.forms))


def _inner(equations: StraightLine, numbers: Coefficients, watched: tuple[str, str]) -> Dispatcher:
    from twoloop.kernels.compile.linking import KernelCompiler
    from twoloop.kernels.data.common import (
        BY_GENERAL,
        DONE,
        INNER,
        N_EVALUATIONS,
        N_FACTORIZATIONS,
        N_INNER,
        OPTIONS,
        ROUNDED,
    )
    from twoloop.kernels.evaluation import calls
    from twoloop.kernels.evaluation.inner import CONTRACTION, MAX_INNER
    from twoloop.kernels.evaluation.onto_constraints import ABOVE_ROUNDING

    options = {"folder": sources_folder(), "pipeline_class": KernelCompiler, **OPTIONS}
    there = function_of(equations.graph, equations.there, numbers)
    EVALUATE_THERE, PROJECT = calls.EVALUATE_THERE, calls.PROJECT
    if equations.closer is None or equations.nearer is None:

        def evaluating(f, w, task, t, q, v, theta, a, lam):  # type: ignore[no-untyped-def]
            if task == EVALUATE_THERE:
                w.counters[N_EVALUATIONS] += 1
                w.counters[N_FACTORIZATIONS] += 1
                if there((t, q, v), f.numbers, (a,)):
                    return DONE
            w.notes[BY_GENERAL] = 1.0
            return f.general(f, w, task, t, q, v, theta, a, lam)

        return compile_kept(evaluating, INNER, watched, **options)

    closer, nearer = (function_of(equations.graph, each, numbers) for each in (equations.closer, equations.nearer))
    redundant, MULTIPLIERS = function_of(equations.graph, equations.redundant, numbers), calls.MULTIPLIERS
    REDUNDANT, TANGENTS = calls.REDUNDANT, calls.TANGENTS

    def inner(f, w, task, t, q, v, theta, a, lam):  # type: ignore[no-untyped-def]
        if task == EVALUATE_THERE:
            w.counters[N_EVALUATIONS] += 1
            w.counters[N_FACTORIZATIONS] += 1
            if there((t, q, v), f.numbers, (a,)):
                return DONE
        elif task == PROJECT:
            least, before = max(theta, ABOVE_ROUNDING * w.notes[ROUNDED]), np.inf
            for k in range(MAX_INNER):
                w.counters[N_INNER] += 1
                w.counters[N_FACTORIZATIONS] += 1
                if k == 0:
                    fine = closer((t, q, v), f.numbers, (w.x, q))
                else:
                    fine = nearer((t, q, v), f.numbers, (a, w.x, q, v, lam))
                if not fine:
                    break
                moved = 0.0
                for j in range(q.size):
                    moved = max(moved, abs(w.x[j]))
                if moved <= least and k > 0:
                    w.counters[N_EVALUATIONS] += 1
                    w.notes[BY_GENERAL] = 0.0
                    return DONE
                if moved > CONTRACTION * before:
                    break
                before = max(moved, least)
            w.notes[BY_GENERAL] = 1.0
        elif task == REDUNDANT and w.notes[BY_GENERAL] == 0.0:
            if redundant((t, q, v), f.numbers, (a,)):
                return DONE
            f.general(f, w, TANGENTS, t, q, v, theta, a, lam)  # the rows there, which this code has not left in w
        elif task <= MULTIPLIERS:  # of methods that need a good partition at every step
            w.notes[BY_GENERAL] = 1.0
        return f.general(f, w, task, t, q, v, theta, a, lam)

    return compile_kept(inner, INNER, watched, **options)

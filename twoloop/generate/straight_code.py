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

from twoloop.generate import llvm_code, llvm_trigonometry, straight_line
from twoloop.generate.llvm_code import DOUBLE, ONE, ZERO, Emitter, Quantities, Value
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

    def __init__(self, emit: Emitter):
        self.emit = emit
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
        return self._known.sum(tuple(form.terms.items()), form.constant)

    def operation(self, quantity: int, kind: int, first: Form, second: Form | None) -> None:
        """Compute a quantity."""
        emit, x = self.emit, self.form(first)
        if kind == PRODUCT:
            assert second is not None
            value = emit.multiply(x, self.form(second))
        elif kind == SUM:
            value = x
        elif kind == RECIPROCAL:
            value = emit.divide(ONE, x)
        elif kind in (SINE, COSINE):
            if first.key not in self._pairs:
                self.angles.append(x)
                self._pairs[first.key] = sine_and_cosine(emit, x)
            value = self._pairs[first.key][kind == COSINE]
        else:
            value = emit.function(FUNCTIONS[kind], x)
        self._known.define(quantity, value)


def results_of(
    emit: Emitter, graph: Graph, outputs: Outputs, inputs: Sequence[Value]
) -> tuple[Written, list[list[Value]]]:
    """Arrays that code computes from the inputs of a graph, in their order."""
    written = Written(emit)
    for quantity, value in enumerate(inputs):
        written.define(quantity, value)
    for i in outputs.quantities(graph):
        operation = graph.operations[i]
        assert operation is not None
        written.operation(i, *operation)
    return written, [[written.form(form) for form in forms] for forms in outputs.arrays.values()]


def conditions_hold(emit: Emitter, written: Written, outputs: Outputs, values: Sequence[Value]) -> Value:
    """Whether what was written holds: its conditions, angles that are not too large, and values that are finite."""
    builder, total = emit.builder, ZERO
    for value in values:  # what is not finite becomes NaN
        total = emit.add(total, emit.multiply(value, ZERO))
    holds = builder.fcmp_ordered("==", total, ZERO)
    pairs = [(written.form(one), written.form(other)) for one, other in outputs.conditions]
    pairs += [(DOUBLE(LARGEST_ANGLE), emit.function("fabs", angle)) for angle in written.angles]
    for one, other in pairs:
        holds = builder.and_(holds, builder.fcmp_ordered(">", one, other))
    return holds


def function_of(graph: Graph, outputs: Outputs) -> Any:
    """A function of the inputs, a tuple of numbers and vectors, and of vectors to fill, for code that numba compiles.

    It returns whether the conditions hold and what it computes is finite, and fills the vectors only then. Numba keeps
    it for ever; what it is written from must live until it is compiled.
    """
    graph_there, outputs_there = weakref.ref(graph), weakref.ref(outputs)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def pointer(vectors: Value, k: int) -> Value:
            return make_array(VECTOR)(context, builder, builder.extract_value(vectors, k)).data

        graph, outputs = graph_there(), outputs_there()
        assert graph is not None and outputs is not None
        given, filled = arguments
        emit, inputs = Emitter(builder), []
        for k, (kind, size) in enumerate(zip(signature.args[0], graph.sizes, strict=True)):
            for j in range(size):
                is_vector = kind == VECTOR
                inputs.append(emit.load(pointer(given, k), j) if is_vector else builder.extract_value(given, k))
        written, results = results_of(emit, graph, outputs, inputs)
        holds = conditions_hold(emit, written, outputs, results[0])
        with builder.if_then(holds):
            for k, values in enumerate(results):
                for j, value in enumerate(values):
                    emit.store(value, pointer(filled, k), j)
        return holds

    @intrinsic
    def function(typing: Any, given: Any, filled: Any) -> Any:
        return types.boolean(given, filled), generate

    return function


_INNER = Newest()


class OwnCode:
    """The inner loop for a system, compiled for its equations, or read from the disk.

    Attributes
    ----------
    equations : StraightLine
    digest : str
        Of all that code made of these depends on.
    inner : Dispatcher
    """

    def __init__(self, equations: StraightLine):
        from twoloop.kernels.data import common

        self.equations = equations
        digest = hashlib.sha256(repr(list(_described(equations))).encode())
        for module in (__file__, straight_line.__file__, llvm_code.__file__, llvm_trigonometry.__file__):
            digest.update(Path(str(module)).read_bytes())
        self.digest = digest.hexdigest()
        inner = _INNER.get(self.digest)
        if inner is None:
            _INNER[self.digest] = inner = _inner(equations, (common.stamp("evaluation.calls"), self.digest))
        self.inner: Dispatcher = inner


def own_code(system: ConstrainedSystem, t0: float, q0: Array, check: Check = unchecked) -> OwnCode:
    """The code for a system, for a run that starts at a position; `check` raises where the callbacks are not in it.

    Raises
    ------
    ValueError
        If its equations cannot be had.
    """
    try:
        choice = Choice.at(system, t0, q0)
        made: OwnCode = system.remembered(("code", choice), lambda: OwnCode(StraightLine(system, choice)))
        check(made.equations.traced)
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return made


def _described(equations: StraightLine) -> Iterable[Any]:
    yield equations.system.n_q, equations.choice
    for outputs in (equations.there, equations.closer, equations.nearer, equations.redundant):
        if outputs is not None:
            yield {name: [form.key for form in forms] for name, forms in outputs.arrays.items()}
            yield [(one.key, other.key) for one, other in outputs.conditions]
    for operation in equations.graph.operations:
        yield None if operation is None else tuple(x.key if isinstance(x, Form) else x for x in operation)


def _inner(equations: StraightLine, watched: tuple[str, str]) -> Dispatcher:
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
    there = function_of(equations.graph, equations.there)
    EVALUATE_THERE, PROJECT = calls.EVALUATE_THERE, calls.PROJECT
    if equations.closer is None or equations.nearer is None:

        def evaluating(f, w, task, t, q, v, theta, a, lam):  # type: ignore[no-untyped-def]
            if task == EVALUATE_THERE:
                w.counters[N_EVALUATIONS] += 1
                w.counters[N_FACTORIZATIONS] += 1
                if there((t, q, v), (a,)):
                    return DONE
            w.notes[BY_GENERAL] = 1.0
            return f.general(f, w, task, t, q, v, theta, a, lam)

        return compile_kept(evaluating, INNER, watched, **options)

    closer, nearer = (function_of(equations.graph, each) for each in (equations.closer, equations.nearer))
    redundant, MULTIPLIERS = function_of(equations.graph, equations.redundant), calls.MULTIPLIERS
    REDUNDANT, TANGENTS = calls.REDUNDANT, calls.TANGENTS

    def inner(f, w, task, t, q, v, theta, a, lam):  # type: ignore[no-untyped-def]
        if task == EVALUATE_THERE:
            w.counters[N_EVALUATIONS] += 1
            w.counters[N_FACTORIZATIONS] += 1
            if there((t, q, v), (a,)):
                return DONE
        elif task == PROJECT:
            least, before = max(theta, ABOVE_ROUNDING * w.notes[ROUNDED]), np.inf
            for k in range(MAX_INNER):
                w.counters[N_INNER] += 1
                w.counters[N_FACTORIZATIONS] += 1
                fine = closer((t, q, v), (w.x, q)) if k == 0 else nearer((t, q, v), (a, w.x, q, v, lam))
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
            if redundant((t, q, v), (a,)):
                return DONE
            f.general(f, w, TANGENTS, t, q, v, theta, a, lam)  # the rows there, which this code has not left in w
        elif task <= MULTIPLIERS:  # of methods that need a good partition at every step
            w.notes[BY_GENERAL] = 1.0
        return f.general(f, w, task, t, q, v, theta, a, lam)

    return compile_kept(inner, INNER, watched, **options)

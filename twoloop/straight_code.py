"""Machine code for the equations of one mechanism: the tasks of the inner loop that explicit methods call.

The operations of `twoloop.straight_line` become LLVM's instructions one by one, without numba's front end, which would
take seconds for some hundred of them. The code is kept on disk as that of the kernels.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.dispatcher import Dispatcher
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from numpy.typing import NDArray

from twoloop import straight_line
from twoloop.caches import compile_kept
from twoloop.callbacks import VECTOR
from twoloop.straight_line import Choice, Outputs, StraightLine
from twoloop.system import ConstrainedSystem
from twoloop.tracing import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    LOGARITHM,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
    SUM,
    Form,
    Graph,
    Untraceable,
)

Array = NDArray[np.float64]

DOUBLE, INTEGER = ir.DoubleType(), ir.IntType(64)
FLAGS = ("contract", "reassoc", "nsz", "arcp")  # those of the kernels
FUNCTIONS = {SQUARE_ROOT: "sqrt", EXPONENTIAL: "exp", LOGARITHM: "log"}

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


class Emitter:
    """Instructions for quantities of a graph, each computed once."""

    def __init__(self, builder: Any):
        self.builder = builder
        self.angles: list[Any] = []  # absolute values
        self._values: dict[int, Any] = {}
        self._forms: dict[Any, Any] = {}
        self._pairs: dict[Any, tuple[Any, Any]] = {}

    def set_value(self, quantity: int, value: Any) -> None:
        """What a quantity is."""
        self._values[quantity] = value

    def form(self, form: Form) -> Any:
        """The value of a form."""
        key = form.key
        if key not in self._forms:
            self._forms[key] = self._sum(form)
        return self._forms[key]

    def _sum(self, form: Form) -> Any:
        b = self.builder
        total = None if form.constant == 0.0 else ir.Constant(DOUBLE, form.constant)
        for i, c in form.terms.items():
            x = self._values[i]
            if total is None:
                total = x if c == 1.0 else b.fmul(ir.Constant(DOUBLE, c), x, flags=FLAGS)
            elif c == 1.0:
                total = b.fadd(total, x, flags=FLAGS)
            elif c == -1.0:
                total = b.fsub(total, x, flags=FLAGS)
            else:
                total = b.fadd(total, b.fmul(ir.Constant(DOUBLE, c), x, flags=FLAGS), flags=FLAGS)
        return ir.Constant(DOUBLE, 0.0) if total is None else total

    def operation(self, quantity: int, kind: int, first: Form, second: Form | None) -> None:
        """Compute a quantity."""
        b, x = self.builder, self.form(first)
        if kind == PRODUCT:
            assert second is not None
            value = b.fmul(x, self.form(second), flags=FLAGS)
        elif kind == SUM:
            value = x
        elif kind == RECIPROCAL:
            value = b.fdiv(ir.Constant(DOUBLE, 1.0), x, flags=FLAGS)
        elif kind in (SINE, COSINE):
            if first.key not in self._pairs:
                self._pairs[first.key] = self._sine_and_cosine(x)
            value = self._pairs[first.key][kind == COSINE]
        elif kind == ARCTANGENT:
            kind_of_function = ir.FunctionType(DOUBLE, [DOUBLE])
            value = b.call(cgutils.get_or_insert_function(b.module, kind_of_function, "atan"), [x])
        else:
            value = b.call(b.module.declare_intrinsic(f"llvm.{FUNCTIONS[kind]}", [DOUBLE]), [x])
        self._values[quantity] = value

    def _sine_and_cosine(self, x: Any) -> tuple[Any, Any]:
        """Both for an angle up to LARGEST_ANGLE: without a call, so that those of several angles run side by side."""
        b = self.builder

        def function(name: str, y: Any) -> Any:
            return b.call(b.module.declare_intrinsic(f"llvm.{name}", [DOUBLE]), [y])

        def polynomial(square: Any, coefficients: tuple[float, ...]) -> Any:
            total: Any = DOUBLE(coefficients[-1])
            for coefficient in reversed(coefficients[:-1]):
                total = b.fma(total, square, DOUBLE(coefficient))
            return total

        self.angles.append(function("fabs", x))
        turns = function("rint", b.fmul(x, DOUBLE(1.0 / HALF_PI[0])))
        rest = x
        for part in HALF_PI:
            rest = b.fma(turns, DOUBLE(-part), rest)
        square = b.fmul(rest, rest)
        sine = b.fma(b.fmul(square, rest), polynomial(square, SINES), rest)
        cosine = b.fma(square, DOUBLE(-0.5), DOUBLE(1.0))
        cosine = b.fma(b.fmul(square, square), polynomial(square, COSINES), cosine)
        quarter = b.fptosi(turns, INTEGER)
        odd = b.trunc(quarter, ir.IntType(1))
        signs = [b.shl(b.and_(number, INTEGER(2)), INTEGER(62)) for number in (quarter, b.add(quarter, INTEGER(1)))]
        made = [
            b.bitcast(b.xor(b.bitcast(b.select(odd, one, other), INTEGER), sign), DOUBLE)
            for one, other, sign in ((cosine, sine, signs[0]), (sine, cosine, signs[1]))
        ]
        return made[0], made[1]


def _pointer(context: Any, builder: Any, value: Any) -> Any:
    return make_array(VECTOR)(context, builder, value).data


def _place(builder: Any, pointer: Any, i: int) -> Any:
    return builder.gep(pointer, [ir.Constant(ir.IntType(64), i)], inbounds=True)


def function_of(graph: Graph, outputs: Outputs) -> Any:
    """A function of the inputs, a tuple of numbers and vectors, and of vectors to fill, for code that numba compiles.

    It returns whether the conditions hold and what it computes is finite, and fills the vectors only then.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        given, filled = arguments
        emitter, first = Emitter(builder), 0
        for k, (kind, size) in enumerate(zip(signature.args[0], graph.sizes, strict=True)):
            value = builder.extract_value(given, k)
            for j in range(size):
                place = _place(builder, _pointer(context, builder, value), j) if kind == VECTOR else None
                emitter.set_value(first + j, value if place is None else builder.load(place))
            first += size
        for i in outputs.quantities(graph):
            operation = graph.operations[i]
            assert operation is not None
            emitter.operation(i, *operation)
        zero: Any = ir.Constant(DOUBLE, 0.0)
        total, holds = zero, ir.Constant(ir.IntType(1), 1)
        results = {name: [emitter.form(form) for form in forms] for name, forms in outputs.arrays.items()}
        for value in next(iter(results.values())):  # what is not finite becomes NaN
            total = builder.fadd(total, builder.fmul(value, zero, flags=FLAGS), flags=FLAGS)
        holds = builder.fcmp_ordered("==", total, zero)
        for one, other in outputs.conditions:
            holds = builder.and_(holds, builder.fcmp_ordered(">", emitter.form(one), emitter.form(other)))
        for angle in emitter.angles:
            holds = builder.and_(holds, builder.fcmp_ordered("<", angle, DOUBLE(LARGEST_ANGLE)))
        with builder.if_then(holds):
            for k, values in enumerate(results.values()):
                pointer = _pointer(context, builder, builder.extract_value(filled, k))
                for j, value in enumerate(values):
                    builder.store(value, _place(builder, pointer, j))
        return holds

    @intrinsic
    def function(typing: Any, given: Any, filled: Any) -> Any:
        return types.boolean(given, filled), emit

    return function


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
        from twoloop.kernels import common

        self.equations = equations
        digest = hashlib.sha256(repr(list(_described(equations))).encode())
        for module in (__file__, straight_line.__file__):
            digest.update(Path(module).read_bytes())
        self.digest = digest.hexdigest()
        self.inner = _inner(equations, (common.stamp("calls"), self.digest))


def own_code(system: ConstrainedSystem, t0: float, q0: Array) -> OwnCode:
    """The code for a system, for a run that starts at a position.

    Raises
    ------
    ValueError
        If its equations cannot be had.
    """
    try:
        choice = Choice.at(system, t0, q0)
        made: OwnCode = system.remembered(("code", choice), lambda: OwnCode(StraightLine(system, choice)))
    except Untraceable as error:
        raise ValueError(f"compiled=True needs equations that can be written down; {error}. Leave it out") from error
    return made


def _described(equations: StraightLine) -> Iterable[Any]:
    yield equations.system.n_q, equations.choice
    for outputs in (equations.there, equations.closer, equations.nearer):
        if outputs is not None:
            yield {name: [form.key for form in forms] for name, forms in outputs.arrays.items()}
            yield [(one.key, other.key) for one, other in outputs.conditions]
    for operation in equations.graph.operations:
        yield None if operation is None else tuple(x.key if isinstance(x, Form) else x for x in operation)


def _inner(equations: StraightLine, watched: tuple[str, str]) -> Dispatcher:
    from twoloop.kernels import calls
    from twoloop.kernels.common import (
        BY_GENERAL,
        DONE,
        INNER,
        N_EVALUATIONS,
        N_FACTORIZATIONS,
        N_INNER,
        OPTIONS,
        ROUNDED,
    )
    from twoloop.kernels.inner import CONTRACTION, MAX_INNER
    from twoloop.kernels.projection import ABOVE_ROUNDING
    from twoloop.linking import KernelCompiler

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

        return compile_kept(evaluating, INNER, watched, pipeline_class=KernelCompiler, **OPTIONS)

    closer, nearer = (function_of(equations.graph, each) for each in (equations.closer, equations.nearer))

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
        return f.general(f, w, task, t, q, v, theta, a, lam)

    return compile_kept(inner, INNER, watched, pipeline_class=KernelCompiler, **OPTIONS)

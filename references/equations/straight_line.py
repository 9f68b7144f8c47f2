"""Accelerations of one mechanism, and their Jacobian, as straight-line machine code, for compiled solvers.

The equations come from `equations.expressions`: loops are unrolled, structural zeros removed, common subexpressions
computed once. LLVM's instructions are written one by one, past numba's front end: numba takes a millisecond and more
for an operation, and more the longer the function; LLVM a tenth of one.
"""

import ctypes
from collections.abc import Callable, Iterable
from functools import lru_cache, partial, reduce
from itertools import count
from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from references.equations.accelerations import OPTIONS
from references.equations.expressions import FUNCTIONS, Expressions, Printed, expressions_at
from twoloop.generate.llvm_code import COSINES, HALF_PI, LARGEST_ANGLE, SINES
from twoloop.problem.system import ConstrainedSystem

DOUBLE, POINTER, PLACE = ir.DoubleType(), ir.DoubleType().as_pointer(), ir.IntType(64)
INSTRUCTIONS = {"+": ir.IRBuilder.fadd, "-": ir.IRBuilder.fsub, "*": ir.IRBuilder.fmul, "/": ir.IRBuilder.fdiv}
FLAGS = tuple(sorted(OPTIONS["fastmath"]))
COMMUTES = "+*"
OF_THE_LIBRARY = ("atan",)  # of mathematics: LLVM has no instruction for it
ANGLES = ("sin", "cos")
MOST_OPERATIONS = 3000  # of a Jacobian in straight-line code, which takes more of them than loops

_NUMBERS = count()


class Program:
    """A function (t, y, into) -> None of y = [q, v] that is being written, with every operation on doubles once.

    `inputs` are the values t, q and v; the results of their operations are written as these are made.
    """

    def __init__(self, n: int):
        self.name = f"straight_line_code_{next(_NUMBERS)}"
        self.module = ir.Module(self.name)
        signature = ir.FunctionType(ir.VoidType(), [DOUBLE, POINTER, POINTER])
        t, y, self.into = arguments = ir.Function(self.module, signature, self.name).args
        for array in arguments[1:]:
            array.add_attribute("noalias")
        self.build = ir.IRBuilder(t.parent.append_basic_block())
        self.known: dict[Any, Any] = {}
        entries = [self.build.load(self.build.gep(y, [PLACE(i)])) for i in range(2 * n)]
        self.inputs = [Value(self, number) for number in (t, *entries)]

    def operation(self, operator: str, left: Any, right: Any) -> "Value":
        """Return the result of an operator on two numbers of LLVM."""
        key = operator, frozenset((left, right)) if operator in COMMUTES else (left, right)
        if key not in self.known:
            self.known[key] = INSTRUCTIONS[operator](self.build, left, right, flags=FLAGS)
        return Value(self, self.known[key])

    def function(self, name: str, x: "Value") -> "Value":
        """Return an elementary function of a value; sine and cosine of an angle are computed together."""
        key, both = (name, x.number), ANGLES if name in ANGLES else (name,)
        if key not in self.known:
            results = _sine_and_cosine(self.build, x.number) if name in ANGLES else [_call(self.build, name, x.number)]
            self.known |= {(each, x.number): result for each, result in zip(both, results, strict=True)}
        return Value(self, self.known[key])

    def functions(self, names: Iterable[str]) -> dict[str, Callable[["Value"], "Value"]]:
        """Return the functions of these names, of values."""
        return {name: partial(self.function, name) for name in names}

    def compiled(self, results: Iterable[tuple[int, Any]]) -> Callable[..., Any]:
        """Return the function, which sets into[place] of a contiguous array to each result, a value or a float."""
        for place, result in results:
            self.build.store(_number(result), self.build.gep(self.into, [PLACE(place)]))
        self.build.ret_void()
        library = cpu_target.target_context.codegen().create_library(self.name)
        with global_compiler_lock:
            library.add_ir_module(self.module)
            library.finalize()
        prototype = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)
        call = prototype(library.get_pointer_to_function(self.name))
        call.library = library  # type: ignore[attr-defined]  # stays in memory with it

        @njit
        def derivative(t, y, into):  # type: ignore[no-untyped-def]
            call(t, y.ctypes, into.ctypes)

        return derivative  # type: ignore[no-any-return]


class Value:
    """A number of a program."""

    def __init__(self, program: Program, number: Any):
        self.program, self.number = program, number

    @staticmethod
    def _operator(operator: str, swapped: bool = False) -> Any:
        """Return the method of an operator; `swapped`: the value is the right operand."""

        def method(self: "Value", other: Any) -> "Value":
            left, right = (_number(other), self.number) if swapped else (self.number, _number(other))
            return self.program.operation(operator, left, right)

        return method

    __add__ = __radd__ = _operator("+")
    __mul__ = __rmul__ = _operator("*")
    __sub__, __rsub__ = _operator("-"), _operator("-", True)
    __truediv__, __rtruediv__ = _operator("/"), _operator("/", True)

    def __neg__(self) -> Any:
        return 0.0 - self


def _number(value: Any) -> Any:
    """Return LLVM's number of a value or a float."""
    return value.number if isinstance(value, Value) else DOUBLE(float(value))


def _call(build: Any, name: str, x: Any) -> Any:
    """Return the value of an elementary function of the library, or of one of LLVM's intrinsic functions."""
    kind, functions = ir.FunctionType(DOUBLE, [DOUBLE]), build.module.globals
    if name in OF_THE_LIBRARY:
        return build.call(functions.get(name) or ir.Function(build.module, kind, name), [x])
    return build.call(build.module.declare_intrinsic(f"llvm.{name}", [DOUBLE], kind), [x])


def _sine_and_cosine(build: Any, x: Any) -> list[Any]:
    """Return both of an angle, by polynomials where it is no larger than LARGEST_ANGLE, else by the library's calls.

    Calls would take as long as the rest of the equations of a planar linkage, and are no instructions side by side.
    """
    within = build.fcmp_ordered("<=", _call(build, "fabs", x), DOUBLE(LARGEST_ANGLE))
    with build.if_else(within, likely=True) as (near, far):
        with near:
            by_polynomials, end = _by_polynomials(build, x), build.block
        with far:
            called, other_end = [_call(build, name, x) for name in ANGLES], build.block
    results = [build.phi(DOUBLE) for _ in ANGLES]
    for phi, near_value, far_value in zip(results, by_polynomials, called, strict=True):
        phi.add_incoming(near_value, end)
        phi.add_incoming(far_value, other_end)
    return results


def _by_polynomials(build: Any, x: Any) -> list[Any]:
    """Return sine and cosine of an angle, reduced by multiples of pi / 2, a sum of two numbers."""
    turns = _call(build, "rint", build.fmul(x, DOUBLE(1.0 / HALF_PI[0])))
    rest = x
    for part in HALF_PI:
        rest = build.fma(turns, DOUBLE(-part), rest)
    square = build.fmul(rest, rest)
    polynomial = partial(reduce, lambda total, c: build.fma(total, square, c))
    cubic, quartic = (polynomial(map(DOUBLE, reversed(series))) for series in (SINES, COSINES))
    sine = build.fma(build.fmul(square, rest), cubic, rest)
    cosine = build.fma(square, DOUBLE(-0.5), DOUBLE(1.0))
    cosine = build.fma(build.fmul(square, square), quartic, cosine)
    quarter = build.fptosi(turns, PLACE)
    odd = build.trunc(quarter, ir.IntType(1))
    results = []
    for even, odd_value, number in ((sine, cosine, quarter), (cosine, sine, build.add(quarter, PLACE(1)))):
        value = build.select(odd, odd_value, even)
        below = build.trunc(build.lshr(number, PLACE(1)), ir.IntType(1))
        results.append(build.select(below, build.fneg(value), value))
    return results


def _translator(equations: Expressions) -> tuple[Program, Printed]:
    """Return a program of the values t, q and v, and the translator of forms to its values."""
    program = Program(equations.system.n_q)
    return program, Printed(equations.traced.graph, program.functions(FUNCTIONS.values()), program.inputs)


@lru_cache(maxsize=256)
def straight_line(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any]:
    """Return compiled (t, y, rate) -> None: y' of y = [q, v]; q0, v0: the bytes of the start."""
    n, equations = system.n_q, expressions_at(system, t0, q0, v0)
    program, written = _translator(equations)
    return program.compiled(enumerate([*program.inputs[1 + n :], *written.translate(equations.solution[:n])]))


@lru_cache(maxsize=256)
def exact_jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any]:
    """Return compiled (t, y, columns) -> None: the nonzeros of d y'[i]/d y[k] in columns[k, i]; q0, v0 as above.

    Straight-line code of up to `MOST_OPERATIONS`, otherwise with loops for the solution of the linear systems.
    """
    equations = expressions_at(system, t0, q0, v0)
    return _straight_line_jacobian(equations) or _jacobian_in_loops(equations)


def _straight_line_jacobian(equations: Expressions) -> Callable[..., Any] | None:
    """Return the function, or None if it takes too many operations."""
    n, (program, written) = equations.system.n_q, _translator(equations)
    results: list[tuple[int, Any]] = [(2 * n * (n + i) + i, 1.0) for i in range(n)]
    for k, column in enumerate(equations.derivatives()):
        results += [(2 * n * k + n + i, value) for i, value in _nonzero(written.translate(column))]
        if len(program.known) > MOST_OPERATIONS:
            return None
    return program.compiled(results)


def _jacobian_in_loops(equations: Expressions) -> Callable[..., Any]:
    """Return the function, with straight-line code for the factors of eq. (6) and the right-hand sides only."""
    n, factors, (program, written) = equations.system.n_q, equations.factors, _translator(equations)
    size = sum(len(block.places) for block in factors)
    pivots = np.array([i for block in factors for i in block.places])
    partners = np.array([i for block in factors for i in reversed(block.places)])  # a pivot without one is its own
    entries = [(j, row[k]) for block in factors for k in range(len(block.places)) for j, row in block.below]
    lengths = [len(block.below) for block in factors for _ in block.places]
    begins, rows = np.cumsum([0, *lengths]), np.array([j for j, _ in entries], dtype=np.int64)
    values = [block.inverse[k][k] for block in factors for k in range(len(block.places))]
    values += [block.inverse[k][1 - k] for block in factors for k in range(len(block.places)) if len(block.places) == 2]
    pairs = np.flatnonzero(pivots != partners)
    values += [entry for _, entry in entries]
    results = list(enumerate(written.translate(values)))
    for k, right_sides in enumerate(equations.right_hand_sides()):
        results += [(len(values) + 2 * n * i + k, value) for i, value in _nonzero(written.translate(right_sides))]
    fill = program.compiled(results)

    @njit(**OPTIONS)
    def derivatives(t, y, columns):  # type: ignore[no-untyped-def]
        numbers = np.zeros(size + pairs.size + rows.size + size * 2 * n)
        fill(t, y, numbers)
        inverse, beside, offset = numbers[:size], numbers[size : size + pairs.size], size + pairs.size
        multiple = numbers[offset : offset + rows.size]
        right_sides = numbers[offset + rows.size :].reshape(size, 2 * n)
        for k in range(size):
            for place in range(begins[k], begins[k + 1]):
                for c in range(2 * n):
                    right_sides[rows[place], c] -= multiple[place] * right_sides[pivots[k], c]
        scaled = right_sides.copy()
        for k in range(size):
            for c in range(2 * n):
                scaled[pivots[k], c] *= inverse[k]
        for k in range(pairs.size):
            i, j = pivots[pairs[k]], partners[pairs[k]]
            for c in range(2 * n):
                scaled[i, c] += beside[k] * right_sides[j, c]
        for k in range(size - 1, -1, -1):
            for place in range(begins[k], begins[k + 1]):
                for c in range(2 * n):
                    scaled[pivots[k], c] -= multiple[place] * scaled[rows[place], c]
        for i in range(n):
            columns[n + i, i] = 1.0
            for c in range(2 * n):
                columns[c, n + i] = scaled[i, c]

    return derivatives  # type: ignore[no-any-return]


def _nonzero(values: list[Any]) -> list[tuple[int, Any]]:
    """Return the indices and values of those that are not known to be zero."""
    return [(i, value) for i, value in enumerate(values) if isinstance(value, Value) or value != 0.0]

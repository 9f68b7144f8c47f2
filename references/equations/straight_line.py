"""Accelerations of one mechanism, and their Jacobian, as straight-line machine code, for compiled solvers.

The equations come from `equations.expressions`: loops are unrolled, structural zeros removed, common subexpressions
computed once. LLVM's instructions are written one by one, past numba's front end: numba takes a millisecond and more
for an operation, and more the longer the function; LLVM a tenth of one.
"""

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
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
OF_THE_LIBRARY = ("atan",)  # of mathematics: LLVM has no instruction for it
ANGLES = ("sin", "cos")

_NUMBERS = count()


def machine_code(
    n: int, names: Mapping[tuple[str, ...], str], results: Iterable[tuple[int, str]]
) -> Callable[..., Any]:
    """Return compiled (t, y, into) -> None, which sets into[place] of a contiguous array to each result, by its name.

    `names` are those of (left, operator, right) and of (function, argument) in the values t, q0, q1, ..., v0, v1, ...
    of y = [q, v], and in numbers.
    """
    name = f"straight_line_code_{next(_NUMBERS)}"
    module = ir.Module(name)
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [DOUBLE, POINTER, POINTER]), name)
    t, y, results_array = function.args
    for argument in (y, results_array):
        argument.add_attribute("noalias")
    _write(ir.IRBuilder(function.append_basic_block()), n, (t, y, results_array), names, results)
    library = cpu_target.target_context.codegen().create_library(name)
    with global_compiler_lock:
        library.add_ir_module(module)
        library.finalize()
    call = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)(
        library.get_pointer_to_function(name)
    )
    call.library = library  # type: ignore[attr-defined]  # stays in memory with it

    @njit
    def derivative(t, y, results_array):  # type: ignore[no-untyped-def]
        call(t, y.ctypes, results_array.ctypes)

    return derivative  # type: ignore[no-any-return]


def _write(
    build: Any, n: int, arguments: tuple[Any, ...], names: Mapping[tuple[str, ...], str], results: Iterable[Any]
) -> None:
    """Write the body of the function."""
    t, y, results_array = arguments
    element = lambda array, place: build.gep(array, [PLACE(place)])  # noqa: E731
    values = {"t": t} | {f"{'qv'[i // n]}{i % n}": build.load(element(y, i)) for i in range(2 * n)}

    angle_functions: dict[str, tuple[Any, Any]] = {}  # sines and cosines, by angle

    def value(name_: str) -> Any:
        return values[name_] if name_ in values else values.setdefault(name_, DOUBLE(float(name_)))

    for operation, name in names.items():
        if len(operation) == 3:
            values[name] = INSTRUCTIONS[operation[1]](build, value(operation[0]), value(operation[2]), flags=FLAGS)
        elif operation[0] in ANGLES:
            sine_and_cosine = angle_functions.get(operation[1]) or angle_functions.setdefault(
                operation[1], _sine_and_cosine(build, value(operation[1]))
            )
            values[name] = sine_and_cosine[ANGLES.index(operation[0])]
        else:
            values[name] = build.call(_declared(build.module, operation[0]), [value(operation[1])])
    for place, result in results:
        build.store(value(result), element(results_array, place))
    build.ret_void()


def _declared(module: Any, name: str) -> Any:
    """Return an elementary function, declared in a module once."""
    if name in OF_THE_LIBRARY:
        return module.globals.get(name) or ir.Function(module, ir.FunctionType(DOUBLE, [DOUBLE]), name)
    return module.declare_intrinsic(f"llvm.{name}", [DOUBLE])


def _sine_and_cosine(build: Any, x: Any) -> tuple[Any, Any]:
    """Return both of an angle, by polynomials where it is no larger than LARGEST_ANGLE, else by the library's calls.

    Calls would take as long as the rest of the equations of a planar linkage, and are no instructions side by side.
    """
    within = build.fcmp_ordered("<=", _call_intrinsic(build, "fabs", x), DOUBLE(LARGEST_ANGLE))
    with build.if_else(within, likely=True) as (near, far):
        with near:
            by_polynomials, end = _by_polynomials(build, x), build.block
        with far:
            called, other_end = tuple(_call_intrinsic(build, name, x) for name in ANGLES), build.block
    results = []
    for near_value, far_value in zip(by_polynomials, called, strict=True):
        phi = build.phi(DOUBLE)
        phi.add_incoming(near_value, end)
        phi.add_incoming(far_value, other_end)
        results.append(phi)
    return results[0], results[1]


def _by_polynomials(build: Any, x: Any) -> tuple[Any, Any]:
    """Return sine and cosine of an angle, reduced by multiples of pi / 2, a sum of two numbers."""
    turns = _call_intrinsic(build, "rint", build.fmul(x, DOUBLE(1.0 / HALF_PI[0])))
    rest = x
    for part in HALF_PI:
        rest = _call_intrinsic(build, "fma", turns, DOUBLE(-part), rest)
    square = build.fmul(rest, rest)
    cubic, quartic = _polynomial(build, square, SINES), _polynomial(build, square, COSINES)
    sine = _call_intrinsic(build, "fma", build.fmul(square, rest), cubic, rest)
    cosine = _call_intrinsic(build, "fma", square, DOUBLE(-0.5), DOUBLE(1.0))
    cosine = _call_intrinsic(build, "fma", build.fmul(square, square), quartic, cosine)
    quarter = build.fptosi(turns, PLACE)
    odd = build.trunc(quarter, ir.IntType(1))
    results = []
    for even, odd_value, number in ((sine, cosine, quarter), (cosine, sine, build.add(quarter, PLACE(1)))):
        value = build.select(odd, odd_value, even)
        below = build.trunc(build.lshr(number, PLACE(1)), ir.IntType(1))
        results.append(build.select(below, build.fneg(value), value))
    return results[0], results[1]


def _polynomial(build: Any, x: Any, coefficients: Sequence[float]) -> Any:
    total: Any = DOUBLE(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        total = _call_intrinsic(build, "fma", total, x, DOUBLE(coefficient))
    return total


def _call_intrinsic(build: Any, name: str, *arguments: Any) -> Any:
    """Return the value of one of LLVM's intrinsic functions."""
    kinds = ir.FunctionType(DOUBLE, [DOUBLE] * len(arguments))
    return build.call(build.module.declare_intrinsic(f"llvm.{name}", [DOUBLE], kinds), arguments)


COMMUTES = "+*"
MOST_OPERATIONS = 3000  # of a Jacobian in straight-line code, which takes more of them than loops


class Program:
    """A list of named binary operations and function calls without duplicates."""

    def __init__(self) -> None:
        self.names: dict[tuple[str, ...], str] = {}

    def value(self, *operation: str) -> "Value":
        """Return the value of (left, operator, right) or of (function, argument)."""
        return Value(self, self.names.setdefault(operation, f"x{len(self.names)}"))

    def functions(self, names: Iterable[str]) -> dict[str, Callable[["Value"], "Value"]]:
        """Return the functions of these names, of values."""
        return {name: lambda x, name=name: self.value(name, x.name) for name in names}  # type: ignore[misc]


class Value:
    """A named value of a program."""

    def __init__(self, program: Program, name: str):
        self.program, self.name = program, name

    @staticmethod
    def _operator(operator: str, swapped: bool = False) -> Any:
        """Return the method of an operator; `swapped`: the value is the right operand."""

        def method(self: "Value", other: Any) -> "Value":
            pair = (_name(other), self.name) if swapped else (self.name, _name(other))
            left, right = sorted(pair) if operator in COMMUTES else pair
            return self.program.value(left, operator, right)

        return method

    __add__ = __radd__ = _operator("+")
    __mul__ = __rmul__ = _operator("*")
    __sub__, __rsub__ = _operator("-"), _operator("-", True)
    __truediv__, __rtruediv__ = _operator("/"), _operator("/", True)

    def __neg__(self) -> Any:
        return 0.0 - self


def program_of(equations: Expressions) -> tuple[Program, list[str]]:
    """Return the program of the accelerations in the values t, q0, q1, ..., v0, v1, ..., and its results' names."""
    program = Program()
    values = _translator(equations, program).translate(equations.solution[: equations.system.n_q])
    return program, [_name(value) for value in values]


def _translator(equations: Expressions, program: Program) -> Printed:
    """Return the translator of forms to a program in the values t, q0, q1, ..., v0, v1, ..."""
    names = ["t", *(f"{letter}{i}" for letter in "qv" for i in range(equations.system.n_q))]
    functions = program.functions(FUNCTIONS.values())
    return Printed(equations.traced.graph, functions, [Value(program, name) for name in names])


@lru_cache(maxsize=256)
def straight_line(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any]:
    """Return compiled (t, y, rate) -> None: y' of y = [q, v]; q0, v0: the bytes of the start."""
    n = system.n_q
    program, names = program_of(expressions_at(system, t0, q0, v0))
    return machine_code(n, program.names, enumerate([*(f"v{i}" for i in range(n)), *names]))


@lru_cache(maxsize=256)
def exact_jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any]:
    """Return compiled (t, y, columns) -> None: the nonzeros of d y'[i]/d y[k] in columns[k, i]; q0, v0 as above.

    Straight-line code of up to `MOST_OPERATIONS`, otherwise with loops for the solution of the linear systems.
    """
    equations = expressions_at(system, t0, q0, v0)
    return _straight_line_jacobian(equations) or _jacobian_in_loops(equations)


def _straight_line_jacobian(equations: Expressions) -> Callable[..., Any] | None:
    """Return the function, or None if it takes too many operations."""
    n, program = equations.system.n_q, Program()
    written = _translator(equations, program)
    results = [(2 * n * (n + i) + i, "1.0") for i in range(n)]
    for k, column in enumerate(equations.derivatives()):
        results += [(2 * n * k + n + i, name) for i, name in _nonzero(written.translate(column))]
        if len(program.names) > MOST_OPERATIONS:
            return None
    return machine_code(n, program.names, results)


def _jacobian_in_loops(equations: Expressions) -> Callable[..., Any]:
    """Return the function, with straight-line code for the factors of eq. (6) and the right-hand sides only."""
    n, program, factors = equations.system.n_q, Program(), equations.factors
    written, size = _translator(equations, program), sum(len(block.places) for block in factors)
    pivots = np.array([i for block in factors for i in block.places])
    partners = np.array([i for block in factors for i in reversed(block.places)])  # a pivot without one is its own
    entries = [(j, row[k]) for block in factors for k in range(len(block.places)) for j, row in block.below]
    lengths = [len(block.below) for block in factors for _ in block.places]
    begins, rows = np.cumsum([0, *lengths]), np.array([j for j, _ in entries], dtype=np.int64)
    values = [block.inverse[k][k] for block in factors for k in range(len(block.places))]
    values += [block.inverse[k][1 - k] for block in factors for k in range(len(block.places)) if len(block.places) == 2]
    pairs = np.flatnonzero(pivots != partners)
    values += [entry for _, entry in entries]
    results = list(enumerate(map(_name, written.translate(values))))
    for k, right_sides in enumerate(equations.right_hand_sides()):
        results += [(len(values) + 2 * n * i + k, name) for i, name in _nonzero(written.translate(right_sides))]
    fill = machine_code(n, program.names, results)

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


def _nonzero(values: list[Any]) -> list[tuple[int, str]]:
    """Return the indices and names of values that are not known to be zero."""
    return [(i, _name(value)) for i, value in enumerate(values) if isinstance(value, Value) or value != 0.0]


def _name(value: Any) -> str:
    return value.name if isinstance(value, Value) else repr(float(value))

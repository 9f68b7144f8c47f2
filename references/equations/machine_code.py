"""Straight-line programs as machine code: LLVM's instructions one by one, past numba's front end.

numba takes a millisecond and more for an operation, and more the longer the function; LLVM a tenth of one.
"""

import ctypes
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import count
from typing import Any

from llvmlite import ir
from numba import njit
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from references.equations.linear import OPTIONS
from twoloop.generate.llvm_trigonometry import COSINES, HALF_PI, LARGEST_ANGLE, SINES

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
    t, y, into = function.args
    for each in (y, into):
        each.add_attribute("noalias")
    _write(ir.IRBuilder(function.append_basic_block()), n, (t, y, into), names, results)
    library = cpu_target.target_context.codegen().create_library(name)
    with global_compiler_lock:
        library.add_ir_module(module)
        library.finalize()
    call = ctypes.CFUNCTYPE(None, ctypes.c_double, ctypes.c_void_p, ctypes.c_void_p)(
        library.get_pointer_to_function(name)
    )
    call.library = library  # type: ignore[attr-defined]  # stays in memory with it

    @njit
    def derivative(t, y, into):  # type: ignore[no-untyped-def]
        call(t, y.ctypes, into.ctypes)

    return derivative  # type: ignore[no-any-return]


def _write(
    build: Any, n: int, arguments: tuple[Any, ...], names: Mapping[tuple[str, ...], str], results: Iterable[Any]
) -> None:
    """Write the body of the function."""
    t, y, into = arguments
    at = lambda array, place: build.gep(array, [PLACE(place)])  # noqa: E731
    values = {"t": t} | {f"{'qv'[i // n]}{i % n}": build.load(at(y, i)) for i in range(2 * n)}

    turned: dict[str, tuple[Any, Any]] = {}  # sines and cosines, by angle

    def value(of: str) -> Any:
        return values[of] if of in values else values.setdefault(of, DOUBLE(float(of)))

    for what, name in names.items():
        if len(what) == 3:
            values[name] = INSTRUCTIONS[what[1]](build, value(what[0]), value(what[2]), flags=FLAGS)
        elif what[0] in ANGLES:
            both = turned.get(what[1]) or turned.setdefault(what[1], _sine_and_cosine(build, value(what[1])))
            values[name] = both[ANGLES.index(what[0])]
        else:
            values[name] = build.call(_declared(build.module, what[0]), [value(what[1])])
    for place, result in results:
        build.store(value(result), at(into, place))
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
    within = build.fcmp_ordered("<=", _called(build, "fabs", x), DOUBLE(LARGEST_ANGLE))
    with build.if_else(within, likely=True) as (near, far):
        with near:
            by_polynomials, end = _by_polynomials(build, x), build.block
        with far:
            called, other_end = tuple(_called(build, name, x) for name in ANGLES), build.block
    found = []
    for one, other in zip(by_polynomials, called, strict=True):
        phi = build.phi(DOUBLE)
        phi.add_incoming(one, end)
        phi.add_incoming(other, other_end)
        found.append(phi)
    return found[0], found[1]


def _by_polynomials(build: Any, x: Any) -> tuple[Any, Any]:
    """Return sine and cosine of an angle, reduced by multiples of pi / 2, a sum of two numbers."""
    turns = _called(build, "rint", build.fmul(x, DOUBLE(1.0 / HALF_PI[0])))
    rest = x
    for part in HALF_PI:
        rest = _called(build, "fma", turns, DOUBLE(-part), rest)
    square = build.fmul(rest, rest)
    cubic, quartic = _polynomial(build, square, SINES), _polynomial(build, square, COSINES)
    sine = _called(build, "fma", build.fmul(square, rest), cubic, rest)
    cosine = _called(build, "fma", square, DOUBLE(-0.5), DOUBLE(1.0))
    cosine = _called(build, "fma", build.fmul(square, square), quartic, cosine)
    quarter = build.fptosi(turns, PLACE)
    odd = build.trunc(quarter, ir.IntType(1))
    found = []
    for one, other, number in ((sine, cosine, quarter), (cosine, sine, build.add(quarter, PLACE(1)))):
        value = build.select(odd, other, one)
        below = build.trunc(build.lshr(number, PLACE(1)), ir.IntType(1))
        found.append(build.select(below, build.fneg(value), value))
    return found[0], found[1]


def _polynomial(build: Any, x: Any, coefficients: Sequence[float]) -> Any:
    total: Any = DOUBLE(coefficients[-1])
    for each in reversed(coefficients[:-1]):
        total = _called(build, "fma", total, x, DOUBLE(each))
    return total


def _called(build: Any, name: str, *arguments: Any) -> Any:
    """Return the value of one of LLVM's intrinsic functions."""
    kinds = ir.FunctionType(DOUBLE, [DOUBLE] * len(arguments))
    return build.call(build.module.declare_intrinsic(f"llvm.{name}", [DOUBLE], kinds), arguments)

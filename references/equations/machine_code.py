"""Straight-line programs as machine code: LLVM's instructions one by one, past numba's front end.

numba takes a millisecond and more for an operation, and more the longer the function; LLVM a tenth of one.
"""

import ctypes
from collections.abc import Callable, Iterable, Mapping
from itertools import count
from typing import Any

from llvmlite import ir
from numba import njit
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from references.equations.linear import OPTIONS

DOUBLE, POINTER, PLACE = ir.DoubleType(), ir.DoubleType().as_pointer(), ir.IntType(64)
INSTRUCTIONS = {"+": ir.IRBuilder.fadd, "-": ir.IRBuilder.fsub, "*": ir.IRBuilder.fmul, "/": ir.IRBuilder.fdiv}
FLAGS = tuple(sorted(OPTIONS["fastmath"]))
OF_THE_LIBRARY = ("atan",)  # of mathematics: LLVM has no instruction for it

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

    def value(of: str) -> Any:
        return values[of] if of in values else values.setdefault(of, DOUBLE(float(of)))

    for what, name in names.items():
        if len(what) == 3:
            values[name] = INSTRUCTIONS[what[1]](build, value(what[0]), value(what[2]), flags=FLAGS)
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

"""Accelerations of one mechanism, and their Jacobian, as straight-line machine code, for solvers of compiled functions.

The equations come from `equations.expressions`: every loop unrolled, every zero left out, common terms computed once.
That is the fastest right-hand side that a foreign solver driven from compiled code can be given here.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from references.equations.expressions import FUNCTIONS, Expressions, functions_of
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "reassoc", "nsz", "arcp"}}
COMMUTES = "+*"
MOST_OPERATIONS = 3000  # of a Jacobian: numba takes two or three milliseconds for each


class Program:
    """Lines of a program, each an operation on two values or a function of one; the same one is written once."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.names: dict[tuple[str, ...], str] = {}
        self.operations = 0

    def value(self, *what: str) -> "Value":
        """The value of (left, operator, right) or of (function, argument)."""
        if what not in self.names:
            self.names[what] = name = f"x{len(self.lines)}"
            self.lines.append(f"{name} = {' '.join(what) if len(what) == 3 else '{}({})'.format(*what)}")
            self.operations += 1
        return Value(self, self.names[what])

    def functions(self) -> dict[str, Callable[["Value"], "Value"]]:
        """The functions that `Expressions` asks for."""
        return {name: lambda x, name=name: self.value(name, x.name) for name in FUNCTIONS}  # type: ignore[misc]


class Value:
    """A value of a program, by its name there."""

    def __init__(self, program: Program, name: str):
        self.program, self.name = program, name

    def _with(self, operator: str, other: Any, swapped: bool = False) -> Any:
        if not isinstance(other, Value):
            number = float(other)
            if number == 0.0 and operator == "*":
                return 0.0
            if (number == 0.0 and operator == "+") or (number == 1.0 and operator == "*"):
                return self
            if not swapped and ((number == 0.0 and operator == "-") or (number == 1.0 and operator == "/")):
                return self
            other = Value(self.program, f"({number!r})")
        pair = (other.name, self.name) if swapped else (self.name, other.name)
        left, right = sorted(pair) if operator in COMMUTES else pair
        return self.program.value(left, operator, right)

    def __add__(self, other: Any) -> Any:
        return self._with("+", other)

    def __radd__(self, other: Any) -> Any:
        return self._with("+", other, True)

    def __sub__(self, other: Any) -> Any:
        return self._with("-", other)

    def __rsub__(self, other: Any) -> Any:
        return self._with("-", other, True)

    def __mul__(self, other: Any) -> Any:
        return self._with("*", other)

    def __rmul__(self, other: Any) -> Any:
        return self._with("*", other, True)

    def __truediv__(self, other: Any) -> Any:
        return self._with("/", other)

    def __rtruediv__(self, other: Any) -> Any:
        return self._with("/", other, True)

    def __neg__(self) -> Any:
        return self._with("-", 0.0, True)

    def __pow__(self, exponent: int) -> Any:
        if exponent != int(exponent) or exponent < 1:
            raise TypeError(f"expressions of straight-line code have powers 1, 2, 3, ... alone; given {exponent!r}")
        half = self ** (int(exponent) // 2) if exponent > 1 else 1.0
        return half * half * self if exponent % 2 else half * half


def program_of(system: ConstrainedSystem, t0: float, q0: Array, v0: Array) -> tuple[Program, list[str]]:
    """The program of the accelerations, of the values t, q0, q1, ..., v0, v1, ..., and the names of its results."""
    program, t, q, v = _inputs(system)
    made = Expressions(system, t0, q0, v0).accelerations(program.functions(), t, q, v)
    return program, [_name(each) for each in made]


def straight_line(system: ConstrainedSystem, t0: float, q0: Array, v0: Array) -> Callable[..., Any]:
    """(t, y, rate) -> None: y' of y = [q, v] into `rate`, compiled; kept for the next call with the same start."""
    return _compiled(system, t0, q0.tobytes(), v0.tobytes())


def straight_line_jacobian(system: ConstrainedSystem, t0: float, q0: Array, v0: Array) -> Callable[..., Any] | None:
    """(t, y, columns) -> None: what is not zero of d y'[i]/d y[k] into columns[k, i], compiled; kept.

    None where that takes more than `MOST_OPERATIONS`, as on mechanisms of a dozen coordinates and more.
    """
    return _compiled_jacobian(system, t0, q0.tobytes(), v0.tobytes())


@lru_cache(maxsize=256)
def _compiled(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any]:
    n = system.n_q
    program, names = program_of(system, t0, np.frombuffer(q0).copy(), np.frombuffer(v0).copy())
    results = [f"rate[{i}] = v{i}" for i in range(n)] + [f"rate[{n + i}] = {name}" for i, name in enumerate(names)]
    return _machine_code(system, "rate", program, results)


@lru_cache(maxsize=256)
def _compiled_jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any] | None:
    n, (program, t, q, v) = system.n_q, _inputs(system)
    expressions = Expressions(system, t0, np.frombuffer(q0).copy(), np.frombuffer(v0).copy())
    made = expressions.derivatives(program.functions(), t, q, v)
    if program.operations > MOST_OPERATIONS:
        return None
    results = [f"columns[{n + i}, {i}] = 1.0" for i in range(n)]
    for k, column in enumerate(made):
        places = [(i, _name(each)) for i, each in enumerate(column) if isinstance(each, Value) or each != 0.0]
        results += [f"columns[{k}, {n + i}] = {name}" for i, name in places]
    return _machine_code(system, "columns", program, results)


def _inputs(system: ConstrainedSystem) -> tuple[Program, Value, list[Value], list[Value]]:
    """An empty program, and the values t, q0, q1, ..., v0, v1, ... that it is of."""
    program = Program()
    q, v = ([Value(program, f"{letter}{i}") for i in range(system.n_q)] for letter in "qv")
    return program, Value(program, "t"), q, v


def _name(made: Any) -> str:
    return made.name if isinstance(made, Value) else repr(float(made))


def _machine_code(system: ConstrainedSystem, into: str, program: Program, results: list[str]) -> Callable[..., Any]:
    """(t, y, into) -> None: the program at y = [q, v], and then what writes its results."""
    n = system.n_q
    lines = [f"q{i} = y[{i}]" for i in range(n)] + [f"v{i} = y[{n + i}]" for i in range(n)] + program.lines + results
    scope: dict[str, Any] = functions_of(math)
    text = "\n    ".join([f"def derivative(t, y, {into}):", *lines])
    exec(compile(text, f"<straight-line code of {system.name}>", "exec"), scope)
    return njit(**_OPTIONS)(scope["derivative"])  # type: ignore[no-any-return]

"""Accelerations of one mechanism, and their Jacobian, as straight-line machine code, for compiled solvers.

The equations come from `equations.expressions`: loops are unrolled, structural zeros removed, common subexpressions
computed once. This is the fastest right-hand side available here for a foreign solver driven from compiled code.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

from numba import njit

from references.equations.expressions import FUNCTIONS, Expressions, Printed, expressions_at, functions_of
from references.equations.linear import OPTIONS
from twoloop.problem.system import ConstrainedSystem

COMMUTES = "+*"
MOST_OPERATIONS = 3000  # limit for a Jacobian: numba takes two or three milliseconds per operation


class Program:
    """A list of named binary operations and function calls without duplicates."""

    def __init__(self) -> None:
        self.names: dict[tuple[str, ...], str] = {}

    def value(self, *what: str) -> "Value":
        """Return the value of (left, operator, right) or of (function, argument)."""
        return Value(self, self.names.setdefault(what, f"x{len(self.names)}"))

    @property
    def lines(self) -> list[str]:
        """Return the lines of its code."""
        texts = (" ".join(what) if len(what) == 3 else "{}({})".format(*what) for what in self.names)
        return [f"{name} = {text}" for name, text in zip(self.names.values(), texts, strict=True)]


class Value:
    """A named value of a program."""

    def __init__(self, program: Program, name: str):
        self.program, self.name = program, name

    def _with(self, operator: str, other: Any, swapped: bool = False) -> "Value":
        pair = (_name(other), self.name) if swapped else (self.name, _name(other))
        left, right = sorted(pair) if operator in COMMUTES else pair
        return self.program.value(left, operator, right)

    def __add__(self, other: Any) -> "Value":
        return self._with("+", other)

    def __sub__(self, other: Any) -> "Value":
        return self._with("-", other)

    def __rsub__(self, other: Any) -> "Value":
        return self._with("-", other, True)

    def __mul__(self, other: Any) -> "Value":
        return self._with("*", other)

    __radd__, __rmul__ = __add__, __mul__

    def __rtruediv__(self, other: Any) -> "Value":
        return self._with("/", other, True)

    def __neg__(self) -> "Value":
        return self._with("-", 0.0, True)


def program_of(equations: Expressions) -> tuple[Program, list[str]]:
    """Return the program of the accelerations in the values t, q0, q1, ..., v0, v1, ..., and its results' names."""
    program = Program()
    made = _printed(equations, program).each(equations.solution[: equations.system.n_q])
    return program, [_name(each) for each in made]


def _printed(equations: Expressions, program: Program) -> Printed:
    """Return the translator of forms to a program in the values t, q0, q1, ..., v0, v1, ..."""
    names = ["t", *(f"{letter}{i}" for letter in "qv" for i in range(equations.system.n_q))]
    functions = {name: lambda x, name=name: program.value(name, x.name) for name in FUNCTIONS.values()}  # type: ignore[misc]
    return Printed(equations.traced.graph, functions, [Value(program, name) for name in names])


@lru_cache(maxsize=256)
def straight_line(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any]:
    """Return compiled (t, y, rate) -> None: y' of y = [q, v]; q0, v0: the bytes of the start."""
    n = system.n_q
    program, names = program_of(expressions_at(system, t0, q0, v0))
    results = [f"rate[{i}] = v{i}" for i in range(n)] + [f"rate[{n + i}] = {name}" for i, name in enumerate(names)]
    return _machine_code(system, "rate", program, results)


@lru_cache(maxsize=256)
def straight_line_jacobian(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Callable[..., Any] | None:
    """Return compiled (t, y, columns) -> None: the nonzeros of d y'[i]/d y[k] in columns[k, i].

    None if it takes more than `MOST_OPERATIONS`, as for mechanisms with a dozen coordinates or more.
    """
    n, program = system.n_q, Program()
    equations = expressions_at(system, t0, q0, v0)
    written = _printed(equations, program)
    results = [f"columns[{n + i}, {i}] = 1.0" for i in range(n)]
    for k, column in enumerate(equations.derivatives()):
        made = written.each(column)
        if len(program.names) > MOST_OPERATIONS:
            return None
        places = [(i, _name(each)) for i, each in enumerate(made) if isinstance(each, Value) or each != 0.0]
        results += [f"columns[{k}, {n + i}] = {name}" for i, name in places]
    return _machine_code(system, "columns", program, results)


def _name(made: Any) -> str:
    return made.name if isinstance(made, Value) else repr(float(made))


def _machine_code(system: ConstrainedSystem, into: str, program: Program, results: list[str]) -> Callable[..., Any]:
    """Return compiled (t, y, into) -> None: the program at y = [q, v], and the assignment of its results."""
    n = system.n_q
    lines = [f"q{i} = y[{i}]" for i in range(n)] + [f"v{i} = y[{n + i}]" for i in range(n)] + program.lines + results
    scope: dict[str, Any] = functions_of(math)
    text = "\n    ".join([f"def derivative(t, y, {into}):", *lines])
    exec(compile(text, f"<straight-line code of {system.name}>", "exec"), scope)
    return njit(**OPTIONS)(scope["derivative"])  # type: ignore[no-any-return]

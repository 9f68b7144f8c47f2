"""Accelerations of one mechanism, and their Jacobian, as straight-line machine code, for compiled solvers.

The equations come from `equations.expressions`: loops are unrolled, structural zeros removed, common subexpressions
computed once.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import njit

from references.equations.expressions import FUNCTIONS, Expressions, Printed, expressions_at
from references.equations.linear import OPTIONS
from references.equations.machine_code import machine_code
from twoloop.problem.system import ConstrainedSystem

COMMUTES = "+*"
MOST_OPERATIONS = 3000  # of a Jacobian in straight-line code, which takes more of them than loops


class Program:
    """A list of named binary operations and function calls without duplicates."""

    def __init__(self) -> None:
        self.names: dict[tuple[str, ...], str] = {}

    def value(self, *what: str) -> "Value":
        """Return the value of (left, operator, right) or of (function, argument)."""
        return Value(self, self.names.setdefault(what, f"x{len(self.names)}"))

    def functions(self, names: Iterable[str]) -> dict[str, Callable[["Value"], "Value"]]:
        """Return the functions of these names, of values."""
        return {name: lambda x, name=name: self.value(name, x.name) for name in names}  # type: ignore[misc]


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

    def __truediv__(self, other: Any) -> "Value":
        return self._with("/", other)

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
    written = _printed(equations, program)
    results = [(2 * n * (n + i) + i, "1.0") for i in range(n)]
    for k, column in enumerate(equations.derivatives()):
        results += [(2 * n * k + n + i, name) for i, name in _nonzero(written.each(column))]
        if len(program.names) > MOST_OPERATIONS:
            return None
    return machine_code(n, program.names, results)


def _jacobian_in_loops(equations: Expressions) -> Callable[..., Any]:
    """Return the function, with straight-line code for the factors of eq. (6) and the right-hand sides only."""
    n, program, factors = equations.system.n_q, Program(), equations.factors
    written, size = _printed(equations, program), sum(len(block.places) for block in factors)
    pivots = np.array([i for block in factors for i in block.places])
    partners = np.array([i for block in factors for i in reversed(block.places)])  # a pivot without one is its own
    entries = [(j, each[k]) for block in factors for k in range(len(block.places)) for j, each in block.below]
    lengths = [len(block.below) for block in factors for _ in block.places]
    begins, rows = np.cumsum([0, *lengths]), np.array([j for j, _ in entries], dtype=np.int64)
    made = [block.inverse[k][k] for block in factors for k in range(len(block.places))]
    made += [block.inverse[k][1 - k] for block in factors for k in range(len(block.places)) if len(block.places) == 2]
    both = np.flatnonzero(pivots != partners)
    made += [entry for _, entry in entries]
    results = list(enumerate(map(_name, written.each(made))))
    for k, right in enumerate(equations.right_hand_sides()):
        results += [(len(made) + 2 * n * i + k, name) for i, name in _nonzero(written.each(right))]
    fill = machine_code(n, program.names, results)

    @njit(**OPTIONS)
    def derivatives(t, y, columns):  # type: ignore[no-untyped-def]
        values = np.zeros(size + both.size + rows.size + size * 2 * n)
        fill(t, y, values)
        inverse, beside, after = values[:size], values[size : size + both.size], size + both.size
        multiple = values[after : after + rows.size]
        right = values[after + rows.size :].reshape(size, 2 * n)
        for k in range(size):
            for place in range(begins[k], begins[k + 1]):
                for c in range(2 * n):
                    right[rows[place], c] -= multiple[place] * right[pivots[k], c]
        scaled = right.copy()
        for k in range(size):
            for c in range(2 * n):
                scaled[pivots[k], c] *= inverse[k]
        for k in range(both.size):
            i, j = pivots[both[k]], partners[both[k]]
            for c in range(2 * n):
                scaled[i, c] += beside[k] * right[j, c]
        for k in range(size - 1, -1, -1):
            for place in range(begins[k], begins[k + 1]):
                for c in range(2 * n):
                    scaled[pivots[k], c] -= multiple[place] * scaled[rows[place], c]
        for i in range(n):
            columns[n + i, i] = 1.0
            for c in range(2 * n):
                columns[c, n + i] = scaled[i, c]

    return derivatives  # type: ignore[no-any-return]


def _nonzero(made: list[Any]) -> list[tuple[int, str]]:
    """Return the indices and names of values that are not known to be zero."""
    return [(i, _name(each)) for i, each in enumerate(made) if isinstance(each, Value) or each != 0.0]


def _name(made: Any) -> str:
    return made.name if isinstance(made, Value) else repr(float(made))

"""Trace functions given by the user once: forces of t, q and v, motions of t, constraint rows of q and v."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array, check_finite, check_real, shown
from twoloop.generate.graph import Affine, Derivative, Graph, Untraceable, symbol_array
from twoloop.generate.program import OperationTable
from twoloop.generate.trace import convert_to_expressions, trace


@dataclass(frozen=True, eq=False)
class RowFunction:
    """Evaluate a row C(q) = 0 that depends on the coordinates of some bodies.

    Attributes
    ----------
    name : str
        Used in messages.
    function : callable
        function(q) -> number, made of operations that can be traced.
    columns : tuple of int
        Coordinates on which the row depends.
    """

    name: str
    function: Callable[..., Any]
    columns: tuple[int, ...]
    traced: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n, graph = 1 + max(self.columns), Graph()
        (t,) = graph.inputs(1, False)
        q, v = graph.inputs(n, False), graph.inputs(n, True)
        try:
            results = self.forms(graph, t, q, v)
        except Untraceable as error:
            raise ValueError(f"{self.name} must be made of numpy's functions, without branches: {error}") from None
        table = OperationTable.from_results(graph, 1 + 2 * n, dict(enumerate(results)))
        object.__setattr__(self, "traced", np.array(table.as_floats()))

    @property
    def n_results(self) -> int:
        """Return the number of results: C, C_t, gamma, and the derivative with respect to each coordinate."""
        return 3 + len(self.columns)

    def forms(self, graph: Graph, t: Affine, q: Sequence[Affine], v: Sequence[Affine]) -> list[Affine]:
        """Return the results as symbols."""
        value = np.array(trace(lambda _, coordinates: self.function(coordinates), t, symbol_array(q)), dtype=object)
        if value.shape not in ((), (1,)):
            raise Untraceable(f"on symbols it returns shape {value.shape}")
        row = convert_to_expressions(graph, value.reshape(1))[0]
        unit, inputs = Affine(graph, 1.0, {}), [next(iter(each.terms)) for each in q]
        along = dict(zip(inputs, v, strict=True))
        bend = Derivative(graph, along).differentiate(Derivative(graph, along).differentiate(row))
        gradient = [Derivative(graph, {inputs[j]: unit}).differentiate(row) for j in self.columns]
        return [row, Affine(graph, 0.0, {}), bend.times(-1.0), *gradient]

    def at(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the results."""
        from twoloop.bodies.read_tables import results  # compiled on import

        n = 1 + max(self.columns)
        return np.asarray(results(0, t, q[:n].copy(), v[:n].copy(), self.traced)[: self.n_results])


@dataclass(frozen=True, eq=False)
class RateFunction(RowFunction):
    """Evaluate a row A(q) v = 0 of the non-holonomic constraints: function(q, v) -> number, linear in v."""

    @property
    def n_results(self) -> int:
        """Return the number of results: the right-hand side of A a = Q_a, and A for each coordinate."""
        return 1 + len(self.columns)

    def forms(self, graph: Graph, t: Affine, q: Sequence[Affine], v: Sequence[Affine]) -> list[Affine]:
        """Return the results as symbols."""
        function: Callable[..., Any] = self.function
        value = trace(lambda _, coordinates, rates: function(coordinates, rates), t, symbol_array(q), symbol_array(v))
        row, unit = convert_to_expressions(graph, np.array(value, dtype=object).reshape(1))[0], Affine(graph, 1.0, {})
        along = {next(iter(each.terms)): rate for each, rate in zip(q, v, strict=True)}
        gradient = [Derivative(graph, {next(iter(v[j].terms)): unit}).differentiate(row) for j in self.columns]
        return [Derivative(graph, along).differentiate(row).times(-1.0), *gradient]


ARGUMENTS = {1: "(t)", 2: "(length, rate) or (angle, rate)", 3: "(t, q, v)"}


@dataclass(frozen=True, eq=False)
class Function:
    """Evaluate a force or torque given as a function, or a motion with its derivatives.

    Attributes
    ----------
    name : str
        Name of the argument and its owner, for messages.
    function : callable
    n_arguments : int
        1: t; 2: length and rate, see `SpringFunction`; 3: t, q and v.
    size : int
        Number of values returned.
    derivatives : tuple of callable
        First and second derivative of a motion, if given.
    traced : ndarray or None
        Program that evaluates a motion and its traced derivatives, if these are not given.
    """

    name: str
    function: Callable[..., Any]
    n_arguments: int
    size: int
    derivatives: tuple[Callable[..., Any], ...] = ()
    traced: Array | None = None

    @property
    def n_results(self) -> int:
        """Return the number of results of its program; three for a motion."""
        return 3 if self.derivatives or self.traced is not None else self.size

    def at(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the function and check the shape; for a motion, with its derivatives."""
        arguments = self._arguments(t, q.copy(), v.copy())
        try:
            values = [self._checked(each(*arguments)) for each in (self.function, *self.derivatives)]
        except Exception as error:
            error.add_note(f"raised by {self.name} at t = {t!r}")
            raise
        if self.traced is not None:
            from twoloop.bodies.read_tables import results  # compiled on import

            values.append(results(0, t, np.zeros(0), np.zeros(0), self.traced)[1:3])
        return np.concatenate(values)

    def _arguments(self, t: Any, q: Any, v: Any) -> tuple[Any, ...]:
        return (t, q, v)[: self.n_arguments]

    def _checked(self, value: Any) -> Array:
        array = check_real(f"what {self.name} returns", value)
        if array.shape != (self.size,) and not (self.size == 1 and array.shape == ()):
            expected = "a number" if self.size == 1 else f"shape ({self.size},)"
            raise ValueError(f"{self.name} must return {expected}; it returned {shown(value)}")
        return array.reshape(self.size)

    def forms(self, graph: Graph, t: Affine, q: Sequence[Affine], v: Sequence[Affine]) -> list[Affine]:
        """Return the results for symbolic arguments; raise Untraceable if that fails."""
        arguments = self._arguments(t, symbol_array(q), symbol_array(v))
        results: list[Affine] = []
        for each in (self.function, *self.derivatives):
            array = np.array(trace(each, *arguments), dtype=object)
            if array.shape != (self.size,) and not (self.size == 1 and array.shape == ()):
                raise Untraceable(f"on symbols it returns shape {array.shape}")
            results += convert_to_expressions(graph, array.reshape(self.size)).tolist()
        return results


class SpringFunction(Function):
    """Evaluate the force of a spring as a function of its length and rate, which take the place of q and v."""

    def _arguments(self, t: Any, q: Any, v: Any) -> tuple[Any, ...]:
        return q[0], v[0]


def spring_function(name: str, given: Any) -> SpringFunction:
    """Return the force of a spring as a function of its length, or angle, and rate."""
    if not callable(given):
        raise TypeError(
            f"{name} must be a function of (length, rate) or (angle, rate), such as lambda x, rate: 40.0 * x**3; "
            f"given {shown(given)}"
        )
    return SpringFunction(name, given, n_arguments(name, given, (2,)), 1)


def with_arguments(functions: Sequence[Any], n_q: int, q: Any, v: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield each function with its q and v; lengths and rates for SpringFunctions follow the first n_q, in order."""
    index = n_q
    for each in functions:
        if isinstance(each, SpringFunction):
            yield each, q[index : index + 1], v[index : index + 1]
            index += 1
        else:
            yield each, q[:n_q], v[:n_q]


def force_function(name: str, given: Any, size: int) -> Function | Array:
    """Return a function of t or of t, q and v, or constants."""
    if callable(given):
        return Function(name, given, n_arguments(name, given, (1, 3)), size)
    if size == 1:
        return np.array([check_finite(name, given)])
    array = check_real(name, given)
    if array.shape != (size,) or not np.isfinite(array).all():
        raise ValueError(
            f"{name} must be {size} finite numbers, or a function of t or of t, q, v that returns them; given "
            f"{shown(given)}"
        )
    return array


def motion_function(name: str, motion: Any, rate: Any, acceleration: Any) -> Function:
    """Return a motion with its derivatives, which are traced if they are not given."""
    if not callable(motion):
        raise TypeError(f"{name} must be a function of t, such as lambda t: 0.5 * np.sin(2.0 * t); given {motion!r}")
    if (rate is None) != (acceleration is None):
        raise TypeError(f"rate and acceleration of {name} go together: give both, or neither to have them derived")
    for each in (motion, rate, acceleration):
        if each is not None and not callable(each):
            raise TypeError(f"rate and acceleration of {name} must be functions of t; given {each!r}")
        if each is not None:
            n_arguments(name, each, (1,))
    function = Function(name, motion, 1, 1, () if rate is None else (rate, acceleration))
    if rate is None:
        try:
            return replace(function, traced=np.array(program_for([function], 0, True).as_floats()))
        except Untraceable as error:
            raise ValueError(
                f"{error}; so it cannot be differentiated exactly. Write it with numpy functions and without "
                "branches, or give rate= and acceleration=, its first and second derivative as functions of t"
            ) from None
    return function


def motion_forms(function: Function, graph: Graph, t: Affine) -> list[Affine]:
    """Return a motion and its first two derivatives as symbols."""
    results = function.forms(graph, t, [], [])
    if not function.derivatives:
        (place,) = t.terms
        for _ in range(2):
            results.append(Derivative(graph, {place: Affine(graph, 1.0, {})}).differentiate(results[-1]))
    return results


def program_for(functions: Sequence[Function | RowFunction], n_q: int, motions: bool) -> OperationTable:
    """Return one program for all functions, in order; raise Untraceable if one cannot be traced."""
    graph = Graph()
    (t,) = graph.inputs(1, False)
    n = n_q + sum(isinstance(each, SpringFunction) for each in functions)
    q, v = graph.inputs(n, False), graph.inputs(n, True)
    results: list[Affine] = []
    for each, q_part, v_part in with_arguments(functions, n_q, q, v):
        try:
            if motions and isinstance(each, Function):
                results += motion_forms(each, graph, t)
            else:
                results += each.forms(graph, t, q_part, v_part)
        except Untraceable as error:
            raise Untraceable(f"{each.name}: {error}") from None
    return OperationTable.from_results(graph, 1 + 2 * n, dict(enumerate(results)))


def is_constant(function: Function | RowFunction) -> bool:
    """Return True if a motion is known to be constant."""
    if isinstance(function, RowFunction):
        return True
    graph = Graph()
    try:
        return not function.forms(graph, graph.inputs(1, False)[0], [], [])[0].terms
    except Untraceable:
        return False


def n_arguments(name: str, function: Any, allowed: tuple[int, ...], called: str = "") -> int:
    """Return how many arguments a function takes: one of the `allowed` numbers; `called`: how it is called."""
    expected = called or " or ".join(ARGUMENTS[n] for n in allowed)
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # built-in functions have no signature
        return allowed[0]
    places = [each for each in parameters if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
    needed = sum(each.default is each.empty for each in places)
    if any(each.kind == each.KEYWORD_ONLY and each.default is each.empty for each in parameters):
        raise TypeError(f"{name} is called as {expected}; the function given needs arguments by name")
    if any(each.kind == each.VAR_POSITIONAL for each in parameters):
        return allowed[-1]
    for n in allowed:
        if needed <= n <= len(places) and needed > 0:
            return n
    raise TypeError(f"{name} is called as {expected}; the function given takes {len(places)} arguments")

"""Functions given by the user: forces of t, q and v, motions of t. They are traced once to programs where possible."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from twoloop.bodies.row_function import RowFunction
from twoloop.checks.arguments import Array, check_finite, check_real, shown
from twoloop.generate.graph import Affine, Derivative, Graph, Untraceable, symbols
from twoloop.generate.program import Program, numbers_of, program_of
from twoloop.generate.trace import as_forms, trace

ARGUMENTS = {1: "(t)", 2: "(length, rate) or (angle, rate)", 3: "(t, q, v)"}


@dataclass(frozen=True, eq=False)
class Function:
    """A force, torque or motor torque given as a function, or a motion with its derivatives.

    Attributes
    ----------
    name : str
        Names the argument and its owner in messages.
    function : callable
    n_arguments : int
        1: t; 2: length and rate, see `Law`; 3: t, q and v.
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
        """Number of results of its program; three for a motion."""
        return 3 if self.derivatives or self.traced is not None else self.size

    def at(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the function and check the shape; for a motion, with its derivatives."""
        arguments = self._arguments(t, q.copy(), v.copy())
        try:
            made = [self._checked(each(*arguments)) for each in (self.function, *self.derivatives)]
        except Exception as error:
            error.add_note(f"raised by {self.name} at t = {t!r}")
            raise
        if self.traced is not None:
            from twoloop.bodies.program_results import results  # compiled on import

            made.append(results(0, t, np.zeros(0), np.zeros(0), self.traced)[1:3])
        return np.concatenate(made)

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
        arguments = self._arguments(t, symbols(q), symbols(v))
        made: list[Affine] = []
        for each in (self.function, *self.derivatives):
            array = np.array(trace(each, *arguments), dtype=object)
            if array.shape != (self.size,) and not (self.size == 1 and array.shape == ()):
                raise Untraceable(f"on symbols it returns shape {array.shape}")
            made += as_forms(graph, array.reshape(self.size)).tolist()
        return made


class Law(Function):
    """The force of a spring as a function of its length and rate, which are all that it is given as q and v."""

    def _arguments(self, t: Any, q: Any, v: Any) -> tuple[Any, ...]:
        return q[0], v[0]


def law_function(name: str, given: Any) -> Law:
    """Return the force of a spring as a function of its length, or angle, and rate.

    Raises
    ------
    TypeError
        If the argument is not such a function.
    """
    if not callable(given):
        raise TypeError(
            f"{name} must be a function of (length, rate) or (angle, rate), such as lambda x, rate: 40.0 * x**3; "
            f"given {shown(given)}"
        )
    return Law(name, given, _n_arguments(name, given, (2,)), 1)


def with_arguments(functions: Sequence[Any], n_q: int, q: Any, v: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield functions with their parts of q and v, where lengths and rates of laws follow the first n_q, in order."""
    law = n_q
    for each in functions:
        if isinstance(each, Law):
            yield each, q[law : law + 1], v[law : law + 1]
            law += 1
        else:
            yield each, q[:n_q], v[:n_q]


def force_function(name: str, given: Any, size: int) -> Function | Array:
    """Return a function of t or of t, q and v, or constants.

    Raises
    ------
    TypeError, ValueError
        If the argument is neither.
    """
    if callable(given):
        return Function(name, given, _n_arguments(name, given, (1, 3)), size)
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
    """Return a motion with its derivatives, which are traced if they are not given.

    Raises
    ------
    TypeError, ValueError
        If an argument is not a function of t, or the derivatives are neither given nor can be traced.
    """
    if not callable(motion):
        raise TypeError(f"{name} must be a function of t, such as lambda t: 0.5 * np.sin(2.0 * t); given {motion!r}")
    if (rate is None) != (acceleration is None):
        raise TypeError(f"rate and acceleration of {name} go together: give both, or neither to have them derived")
    for each in (motion, rate, acceleration):
        if each is not None and not callable(each):
            raise TypeError(f"rate and acceleration of {name} must be functions of t; given {each!r}")
        if each is not None:
            _n_arguments(name, each, (1,))
    function = Function(name, motion, 1, 1, () if rate is None else (rate, acceleration))
    if rate is None:
        try:
            return replace(function, traced=np.array(numbers_of(program_for([function], 0, True))))
        except Untraceable as error:
            raise ValueError(
                f"{error}; so it cannot be differentiated exactly. Write it with numpy functions and without "
                "branches, or give rate= and acceleration=, its first and second derivative as functions of t"
            ) from None
    return function


def motion_forms(function: Function, graph: Graph, t: Affine) -> list[Affine]:
    """Return a motion and its first two derivatives as symbols."""
    made = function.forms(graph, t, [], [])
    if not function.derivatives:
        (place,) = t.terms
        for _ in range(2):
            made.append(Derivative(graph, {place: Affine(graph, 1.0, {})}).of(made[-1]))
    return made


def program_for(functions: Sequence[Function | RowFunction], n_q: int, motions: bool) -> Program:
    """Return one program for all functions, in order; raise Untraceable if one cannot be traced."""
    graph = Graph()
    (t,) = graph.inputs(1, False)
    n = n_q + sum(isinstance(each, Law) for each in functions)
    q, v = graph.inputs(n, False), graph.inputs(n, True)
    made: list[Affine] = []
    for each, one, other in with_arguments(functions, n_q, q, v):
        try:
            if motions and isinstance(each, Function):
                made += motion_forms(each, graph, t)
            else:
                made += each.forms(graph, t, one, other)
        except Untraceable as error:
            raise Untraceable(f"{each.name}: {error}") from None
    return program_of(graph, 1 + 2 * n, dict(enumerate(made)))


def is_constant(function: Function | RowFunction) -> bool:
    """Return True if a motion is known to be constant."""
    if isinstance(function, RowFunction):
        return True
    graph = Graph()
    try:
        return not function.forms(graph, graph.inputs(1, False)[0], [], [])[0].terms
    except Untraceable:
        return False


def _n_arguments(name: str, function: Any, allowed: tuple[int, ...]) -> int:
    expected = " or ".join(ARGUMENTS[n] for n in allowed)
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

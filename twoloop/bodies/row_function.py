"""Constraint rows given as functions of the coordinates, traced once together with their derivatives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.generate.graph import Affine, Derivative, Graph, Untraceable, symbols
from twoloop.generate.program import numbers_of, program_of
from twoloop.generate.trace import as_forms, trace


@dataclass(frozen=True, eq=False)
class RowFunction:
    """A row C(q) = 0 that depends on the coordinates of some bodies.

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
            made = self.forms(graph, t, q, v)
        except Untraceable as error:
            raise ValueError(f"{self.name} must be made of numpy's functions, without branches: {error}") from None
        object.__setattr__(self, "traced", np.array(numbers_of(program_of(graph, 1 + 2 * n, dict(enumerate(made))))))

    @property
    def n_results(self) -> int:
        """Number of results: C, C_t, gamma, and the derivative with respect to each coordinate."""
        return 3 + len(self.columns)

    def forms(self, graph: Graph, t: Affine, q: Sequence[Affine], v: Sequence[Affine]) -> list[Affine]:
        """Return the results as symbols."""
        value = np.array(trace(lambda _, coordinates: self.function(coordinates), t, symbols(q)), dtype=object)
        if value.shape not in ((), (1,)):
            raise Untraceable(f"on symbols it returns shape {value.shape}")
        row = as_forms(graph, value.reshape(1))[0]
        one, places = Affine(graph, 1.0, {}), [next(iter(each.terms)) for each in q]
        along = dict(zip(places, v, strict=True))
        bend = Derivative(graph, along).of(Derivative(graph, along).of(row))
        gradient = [Derivative(graph, {places[j]: one}).of(row) for j in self.columns]
        return [row, Affine(graph, 0.0, {}), bend.times(-1.0), *gradient]

    def at(self, t: float, q: Array, v: Array) -> Array:
        """Evaluate the results."""
        from twoloop.bodies.program_results import results  # compiled on import

        n = 1 + max(self.columns)
        return np.asarray(results(0, t, q[:n].copy(), v[:n].copy(), self.traced)[: self.n_results])


@dataclass(frozen=True, eq=False)
class RateFunction(RowFunction):
    """A row A(q) v = 0 of the non-holonomic constraints: function(q, v) -> number, linear in v."""

    @property
    def n_results(self) -> int:
        """Number of results: the right-hand side of A a = Q_a, and A for each coordinate."""
        return 1 + len(self.columns)

    def forms(self, graph: Graph, t: Affine, q: Sequence[Affine], v: Sequence[Affine]) -> list[Affine]:
        """Return the results as symbols."""
        function: Callable[..., Any] = self.function
        value = trace(lambda _, one, other: function(one, other), t, symbols(q), symbols(v))
        row, one = as_forms(graph, np.array(value, dtype=object).reshape(1))[0], Affine(graph, 1.0, {})
        along = {next(iter(each.terms)): rate for each, rate in zip(q, v, strict=True)}
        gradient = [Derivative(graph, {next(iter(v[j].terms)): one}).of(row) for j in self.columns]
        return [Derivative(graph, along).of(row).times(-1.0), *gradient]

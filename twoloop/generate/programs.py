"""Traced quantities as programs for kernels: rows of operations in an order in which they can be done."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from twoloop.generate.known_numbers import array_of
from twoloop.generate.tracing import Form, Graph
from twoloop.kernels.evaluation.operations import N_COLUMNS, RESULT

STATES = 5  # at which a program is compared with the function that it was traced from ...
BETWEEN = 0.37  # ... and s from one to the next: of no usual period
AGREES = 1e-10  # relative difference between the two


class Program(NamedTuple):
    """Operations, see kernels/evaluation/operations.py; `columns` and `coefficients` are those of all terms."""

    rows: Any
    columns: Any
    coefficients: Any
    constants: Any
    n_nodes: int


def program_of(graph: Graph, n_inputs: int, results: Mapping[int, Form]) -> Program:
    """What makes results, each with its place, of the first quantities of a graph."""
    needed = graph.needed_by(results.values())
    node = {i: i for i in range(n_inputs)} | {i: n_inputs + k for k, i in enumerate(needed)}
    nothing = Form(graph, 0.0, {})
    operations: list[Any] = [(*graph.operations[i], node[i]) for i in needed]  # type: ignore[misc]
    operations += [(RESULT, form, None, k) for k, form in results.items()]
    terms: list[tuple[int, float]] = []
    rows, constants = [], []
    for kind, one, other, made in operations:
        begin = len(terms)
        other = nothing if other is None else other
        terms += [(node[i], c) for i, c in one.terms.items()]
        rows.append((kind, made, begin, len(terms), len(terms) + len(other.terms)))
        terms += [(node[i], c) for i, c in other.terms.items()]
        constants.append((one.constant, other.constant))
    return Program(
        np.array(rows, dtype=np.int64).reshape(-1, N_COLUMNS),
        np.array([i for i, _ in terms], dtype=np.int64),
        array_of(c for _, c in terms),
        array_of(c for pair in constants for c in pair).reshape(-1, 2),
        len(node),
    )


def numbers_of(program: Program) -> list[float]:
    """A program as it stands in the parameters, see `bodies/program_results.py`."""
    n_results = int((program.rows[:, 0] == RESULT).sum())
    sizes = [n_results, program.n_nodes, len(program.rows), len(program.columns)]
    parts: list[Any] = [sizes, program.rows.ravel(), program.columns, program.coefficients, program.constants.ravel()]
    return [float(x) for part in parts for x in part]

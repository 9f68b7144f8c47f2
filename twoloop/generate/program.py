"""Programs: traced quantities as rows of operations, and their values by NumPy."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Affine, Graph
from twoloop.generate.parameter_expressions import ParameterTape, array_of
from twoloop.kernels.evaluation import operations as op
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


def program_of(graph: Graph, n_inputs: int, results: Mapping[int, Affine]) -> Program:
    """What makes results, each with its place, of the first quantities of a graph."""
    needed = graph.needed_by(results.values())
    node = {i: i for i in range(n_inputs)} | {i: n_inputs + k for k, i in enumerate(needed)}
    nothing = Affine(graph, 0.0, {})
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


Array = NDArray[np.float64]

FUNCTIONS: dict[int, Callable[[Any], Any]] = {
    op.RECIPROCAL: lambda x: 1.0 / x,
    op.SQUARE_ROOT: np.sqrt,
    op.EXPONENTIAL: np.exp,
    op.SINE: np.sin,
    op.COSINE: np.cos,
    op.LOGARITHM: np.log,
    op.ARCTANGENT: np.arctan,
}


class OnArrays:
    """Values of forms for runs, one after another along the first axis.

    Parameters
    ----------
    graph : Graph
    record : ParameterTape
        Of the numbers in its forms.
    parameters : ndarray (n_runs, n_p)
    """

    def __init__(self, graph: Graph, record: ParameterTape, parameters: Array):
        self.graph, self.parameters, self._number = graph, parameters, record.on(parameters)

    def evaluate(self, arrays: Iterable[Any], t: float | Array, *states: Array) -> list[Array]:
        """Arrays of forms as (n_runs, ...), at a time and states (n_runs, n) whose numbers are the graph's inputs.

        t : of shape (n_times, 1) for arrays of shape (n_times, n_runs, ...).
        """
        arrays = list(arrays)
        values: dict[int, Any] = {0: t}
        for state in states:
            values |= dict(zip(range(len(values), len(values) + state.shape[1]), state.T, strict=True))

        def value(form: Affine) -> Any:
            total = self._number(form.constant)
            for i, c in form.terms.items():
                total = total + self._number(c) * values[i]
            return total

        forms = [form for array in arrays for form in array.flat]
        with np.errstate(all="ignore"):
            for i in self.graph.needed_by(forms):
                kind, first, second = self.graph.operations[i]  # type: ignore[misc]
                x = value(first)
                if kind == op.PRODUCT:
                    assert second is not None
                    x = x * value(second)
                values[i] = FUNCTIONS[kind](x) if kind in FUNCTIONS else x
            made, shape = [], np.broadcast_shapes(np.shape(t), (len(self.parameters),))
            for array in arrays:
                out = np.empty((*shape, *array.shape))
                for place in np.ndindex(array.shape):
                    out[(..., *place)] = value(array[place])
                made.append(out)
        return made

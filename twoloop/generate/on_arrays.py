"""Traced equations in numbers for many states and parameters at once, by NumPy."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.known_numbers import Record
from twoloop.generate.tracing import Form, Graph
from twoloop.kernels.evaluation import operations as op

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
    record : Record
        Of the numbers in its forms.
    parameters : ndarray (n_runs, n_p)
    """

    def __init__(self, graph: Graph, record: Record, parameters: Array):
        self.graph, self.parameters, self._number = graph, parameters, record.on(parameters)

    def evaluate(self, arrays: Iterable[Any], t: float | Array, *states: Array) -> list[Array]:
        """Arrays of forms as (n_runs, ...), at a time and states (n_runs, n) whose numbers are the graph's inputs.

        t : of shape (n_times, 1) for arrays of shape (n_times, n_runs, ...).
        """
        arrays = list(arrays)
        values: dict[int, Any] = {0: t}
        for state in states:
            values |= dict(zip(range(len(values), len(values) + state.shape[1]), state.T, strict=True))

        def value(form: Form) -> Any:
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

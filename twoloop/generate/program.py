"""Programs: outputs of a graph, and one walk over their operations in any algebra.

- `Program.run` executes a program, or writes it. The algebra says what values are: arrays (`Arrays`), LLVM code
  (`lowering.Lowering`), degrees of growth (`time_dependence.Degrees`).
- `OperationTable` lists the operations for compiled kernels, which walk over its rows.
- Derivatives extend the graph (`graph.Derivative`). Expressions of parameters alone are coefficients
  (`parameter_expressions`), which are computed before a program runs.
"""

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Affine, Graph
from twoloop.generate.parameter_expressions import ParameterTape, array_of
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.operations import KIND, N_COLUMNS, NODE, RESULT

Array = NDArray[np.float64]
T = TypeVar("T")

# a program of a user's function is compared with the function
STATES = 5  # number of states at which they are compared ...
BETWEEN = 0.37  # ... time between them, s: no usual period
AGREES = 1e-10  # largest relative difference

# cost in multiplications; each further term of a sum counts 1, functions count 0
COSTS = {op.PRODUCT: 1, op.RECIPROCAL: 4}


class Algebra(Generic[T]):
    """Algebra: values of the quantities of a graph in one kind of arithmetic.

    Attributes
    ----------
    functions : mapping
        Operations of one argument, by their kinds.
    values : dict
        Values by quantity.
    """

    functions: Mapping[int, Callable[[T], T]]

    def __init__(self) -> None:
        self.values: dict[int, T] = {}

    def affine(self, expression: Affine) -> T:
        """Return the value of an affine expression."""
        raise NotImplementedError

    def product(self, a: T, b: T) -> T:
        """Return a b."""
        raise NotImplementedError

    def operation(self, kind: int, first: Affine, second: Affine | None) -> T:
        """Return the result of an operation; only products have second arguments that matter."""
        argument = self.affine(first)
        if kind == op.PRODUCT:
            assert second is not None
            return self.product(argument, self.affine(second))
        return argument if kind == op.SUM else self.functions[kind](argument)

    def define(self, quantity: int, value: T) -> None:
        """Define the value of a quantity."""
        self.values[quantity] = value

    def run(self, graph: Graph, quantities: Iterable[int]) -> None:
        """Compute quantities in the given order: the walk that all algebras share."""
        for i in quantities:
            operation = graph.operations[i]
            assert operation is not None
            self.define(i, self.operation(*operation))

    def outputs(self, program: "Program") -> list[list[T]]:
        """Compute the arrays of a program and the quantities of its conditions; inputs must be defined."""
        self.run(program.graph, program.quantities())
        return [[self.affine(form) for form in forms] for forms in program.arrays.values()]


@dataclass(frozen=True)
class Program:
    """Program: outputs to be computed from the inputs of a graph, arrays and conditions that must hold.

    Attributes
    ----------
    graph : Graph
    arrays : dict
        Affine expressions, for each array by its name.
    conditions : list of (Affine, Affine)
        The first must be larger than the second.
    """

    graph: Graph
    arrays: dict[str, list[Affine]]
    conditions: list[tuple[Affine, Affine]] = field(default_factory=list)

    def run(self, algebra: Algebra[T], inputs: Sequence[T] = ()) -> list[list[T]]:
        """Run the program on values of the inputs, in their order; return its arrays."""
        for quantity, value in enumerate(inputs):
            algebra.define(quantity, value)
        return algebra.outputs(self)

    def quantities(self, available: Container[int] = ()) -> list[int]:
        """Return the quantities that the outputs need, but inputs and available ones, in an order of computation."""
        return self.graph.needed_by(self.forms, available)

    def cost(self) -> int:
        """Estimate the cost of the program in multiplications and additions, without functions."""
        forms, total = self.forms, 0
        for i in self.quantities():
            kind, *_ = self.graph.operations[i]  # type: ignore[misc]
            total += COSTS.get(kind, 0)
            forms += self.graph.arguments(i)
        return total + sum(max(len(form.terms) - 1, 0) for form in forms)

    @property
    def sizes(self) -> tuple[dict[str, int], int]:
        """Return the sizes of the arrays, and the number of conditions."""
        return {name: len(forms) for name, forms in self.arrays.items()}, len(self.conditions)

    @property
    def forms(self) -> list[Affine]:
        """Return all expressions of arrays and conditions."""
        forms = [form for array in self.arrays.values() for form in array]
        return [*forms, *(form for condition in self.conditions for form in condition)]


class Arrays(Algebra[Any]):
    """Algebra of NumPy arrays, one number for each run.

    Parameters
    ----------
    tape : ParameterTape
        Record of the coefficients.
    parameters : ndarray (n_runs, n_p)
    """

    functions: Mapping[int, Callable[[Any], Any]] = MappingProxyType(
        {
            op.RECIPROCAL: lambda x: 1.0 / x,
            op.SQUARE_ROOT: np.sqrt,
            op.EXPONENTIAL: np.exp,
            op.SINE: np.sin,
            op.COSINE: np.cos,
            op.LOGARITHM: np.log,
            op.ARCTANGENT: np.arctan,
        }
    )

    def __init__(self, tape: ParameterTape, parameters: Array):
        super().__init__()
        self._coefficient = tape.on(parameters)

    def affine(self, expression: Affine) -> Any:
        """Return the values of an affine expression."""
        total = self._coefficient(expression.constant)
        for i, c in expression.terms.items():
            total = total + self._coefficient(c) * self.values[i]
        return total

    def product(self, a: Any, b: Any) -> Any:
        """Return a b."""
        return a * b

    def outputs(self, program: Program) -> list[list[Any]]:
        """Compute the arrays of a program; undefined values are NaN or infinite."""
        with np.errstate(all="ignore"):
            return super().outputs(program)


class OperationTable(NamedTuple):
    """Table of the operations of a program for compiled kernels, see kernels/evaluation/operations.py.

    `rows` has a row for each operation, `columns` and `coefficients` the terms of all affine expressions, and
    `constants` their constants, two for each row.
    """

    rows: Any
    columns: Any
    coefficients: Any
    constants: Any
    n_nodes: int

    @classmethod
    def of(cls, graph: Graph, n_inputs: int, results: Mapping[int, Affine]) -> "OperationTable":
        """List the operations that results, by their indices, need; the first quantities of the graph are inputs."""
        needed = graph.needed_by(results.values())
        node = {i: i for i in range(n_inputs)} | {i: n_inputs + k for k, i in enumerate(needed)}
        operations: list[Any] = [(*graph.operations[i], node[i]) for i in needed]  # type: ignore[misc]
        operations += [(RESULT, form, None, place) for place, form in results.items()]
        terms: list[tuple[int, float]] = []
        rows, constants = [], []
        for kind, first, second, place in operations:
            begin = len(terms)
            terms += [(node[i], c) for i, c in first.terms.items()]
            middle = len(terms)
            if second is not None:
                terms += [(node[i], c) for i, c in second.terms.items()]
            rows.append((kind, place, begin, middle, len(terms)))
            constants += [first.constant, 0.0 if second is None else second.constant]
        return cls(
            np.array(rows, dtype=np.int64).reshape(-1, N_COLUMNS),
            np.array([i for i, _ in terms], dtype=np.int64),
            array_of(c for _, c in terms),
            array_of(constants).reshape(-1, 2),
            len(node),
        )

    def flat(self) -> list[float]:
        """Return all numbers as the parameters of a model hold them: results are the first nodes."""
        rows = self.rows.copy()
        is_result = rows[:, KIND] == RESULT
        n_results = int(is_result.sum())
        rows[~is_result, NODE] += n_results
        sizes = [n_results, self.n_nodes, len(rows), len(self.columns)]
        parts: list[Any] = [sizes, rows.ravel(), self.columns + n_results, self.coefficients, self.constants.ravel()]
        return [float(x) for part in parts for x in part]

    def packed(self, places: Sequence[int]) -> tuple[Any, Any]:
        """Return the integers and the numbers of a program of a system; `places`: the entries of its results."""
        rows, n = self.rows.copy(), len(places)
        rows[rows[:, KIND] == RESULT, NODE] += self.n_nodes
        head = [self.n_nodes + n, len(rows), len(self.columns), n]
        integers = np.concatenate([head, rows.ravel(), self.columns, places])
        return integers.astype(np.int64), np.concatenate([self.constants.ravel(), self.coefficients])

    def with_numbers(self, numbers_for: Callable[[Any], Array]) -> "OperationTable":
        """Return the table with other numbers."""
        return self._replace(constants=numbers_for(self.constants), coefficients=numbers_for(self.coefficients))

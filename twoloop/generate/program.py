"""Programs: operations that tracing has recorded in a graph, and arrays of affine expressions of the results.

- `Program.run` executes a program in an algebra, which defines what a value is: an array of numbers (`ArrayAlgebra`), a
  value in generated code (`llvm_code.Lowering`), or a polynomial degree (`time_dependence.DegreeAlgebra`).
- `OperationTable` lists the operations as arrays, which compiled kernels interpret row by row.
- `Coefficients` assigns array indices to the coefficients of expressions. Coefficients may depend on parameters
  (`parameter_expressions`); they are computed before a program runs.
"""

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Affine, Graph, rounded
from twoloop.generate.parameter_expressions import Parameter, ParameterTape, Powers, number_array
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.operations import KIND, N_COLUMNS, NODE, RESULT

Array = NDArray[np.float64]
T = TypeVar("T")

N_COMPARED = 5  # number of states at which a user's traced function is compared with calls of the function
TIME_SPACING = 0.37  # time (s) between two states at which call and trace are compared; unlikely to be a force's period
MAX_TRACE_DIFFERENCE = 1e-10  # a trace is wrong if its relative error exceeds this: rounding errors are smaller

# cost of operations by kind, in multiplications; the cost of other operations is not counted
COSTS = {op.PRODUCT: 1, op.RECIPROCAL: 4}


class Algebra(Generic[T]):
    """Arithmetic in which a program runs; subclasses define the type T of values, and the operations on values.

    functions : functions that compute operations with one argument; keys: codes of the operations, such as SINE.
    values : values computed so far; keys: indices of quantities in the graph.
    """

    functions: Mapping[int, Callable[[T], T]]

    def __init__(self) -> None:
        self.values: dict[int, T] = {}

    def affine(self, expr: Affine) -> T:
        """Return the value of an affine expression."""
        raise NotImplementedError

    def product(self, a: T, b: T) -> T:
        """Return the product of a and b."""
        raise NotImplementedError

    def operation(self, kind: int, first: Affine, second: Affine | None) -> T:
        """Return the result of an operation; `kind`: its code, such as SINE; `second`: only for products."""
        argument = self.affine(first)
        if kind == op.PRODUCT:
            assert second is not None
            return self.product(argument, self.affine(second))
        return argument if kind == op.SUM else self.functions[kind](argument)

    def define(self, quantity: int, value: T) -> None:
        """Set the value of the quantity (an input, or the result of an operation) with this index."""
        self.values[quantity] = value

    def run(self, graph: Graph, quantities: Iterable[int]) -> None:
        """Compute the quantities with these indices, in this order, and store their values."""
        for i in quantities:
            operation = graph.operations[i]
            assert operation is not None
            self.define(i, self.operation(*operation))

    def run_program(self, program: "Program") -> list[list[T]]:
        """Compute the arrays and conditions of a program from inputs set with `define`; return the arrays."""
        self.run(program.graph, program.quantities())
        return [[self.affine(expr) for expr in exprs] for exprs in program.arrays.values()]


@dataclass(frozen=True)
class Program:
    """Arrays to be computed from the inputs of a graph, and conditions under which these arrays are valid.

    arrays : lists of affine expressions, the entries of the arrays; keys: names of the arrays.
    conditions : pairs of expressions. The arrays are valid if in each pair the first is larger than the second.
    """

    graph: Graph
    arrays: dict[str, list[Affine]]
    conditions: list[tuple[Affine, Affine]] = field(default_factory=list)

    def run(self, algebra: Algebra[T], inputs: Sequence[T] = ()) -> list[list[T]]:
        """Execute the program in an algebra; return the arrays. `inputs`: values of the first inputs of the graph."""
        for quantity, value in enumerate(inputs):
            algebra.define(quantity, value)
        return algebra.run_program(self)

    def quantities(self, available: Container[int] = ()) -> list[int]:
        """Return the indices of the quantities that the program must compute, except those in `available`."""
        return self.graph.quantities_for(self.expressions, available)

    def cost(self) -> int:
        """Return the cost of a program in multiplications and additions; see COSTS for the cost of other operations."""
        exprs, total = self.expressions, 0
        for i in self.quantities():
            kind, *_ = self.graph.operations[i]  # type: ignore[misc]
            total += COSTS.get(kind, 0)
            exprs += self.graph.arguments(i)
        return total + sum(max(len(expr.terms) - 1, 0) for expr in exprs)

    @property
    def sizes(self) -> tuple[dict[str, int], int]:
        """Return the number of expressions in each array of the program, by its name, and the number of conditions."""
        return {name: len(exprs) for name, exprs in self.arrays.items()}, len(self.conditions)

    @property
    def expressions(self) -> list[Affine]:
        """Return the list of all expressions in the program's arrays and conditions."""
        exprs = [expr for array in self.arrays.values() for expr in array]
        return [*exprs, *(expr for condition in self.conditions for expr in condition)]


class ArrayAlgebra(Algebra[Any]):
    """Algebra in which a value is an array (n_runs,), with one number for each run, or one number for all runs.

    tape : record of how coefficients depend on parameters. parameters : values of the parameters, (n_runs, n_p).
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
        self._coefficient = tape.number_evaluator(parameters)

    def affine(self, expr: Affine) -> Any:
        """Return the values of an affine expression."""
        total = self._coefficient(expr.constant)
        for i, c in expr.terms.items():
            total = total + self._coefficient(c) * self.values[i]
        return total

    def product(self, a: Any, b: Any) -> Any:
        """Return the product of a and b."""
        return a * b

    def run_program(self, program: Program) -> list[list[Any]]:
        """Execute a program, and return its arrays; outside the domain of a function, values are NaN or infinite."""
        with np.errstate(all="ignore"):
            return super().run_program(program)


class OperationTable(NamedTuple):
    """Operations of a program as arrays, which the kernels in kernels/evaluation/operations.py execute.

    Nodes are numbers that the program reads or computes: inputs first, then results of operations. Arguments of an
    operation are affine expressions of nodes.

    rows : columns KIND, NODE, FIRST, SECOND, END of kernels/evaluation/operations.py; an operation per row.
    columns, coefficients : for each term of all arguments, the index of its node, and its coefficient.
    constants : for each operation, the constants of its two arguments; 0 if there is no second argument.
    """

    rows: Any
    columns: Any
    coefficients: Any
    constants: Any
    n_nodes: int

    @classmethod
    def from_results(cls, graph: Graph, n_inputs: int, results: Mapping[int, Affine]) -> "OperationTable":
        """Return the table that computes the expressions `results` (keys: indices in the output) from the inputs."""
        needed = graph.quantities_for(results.values())
        node_of = {i: i for i in range(n_inputs)} | {i: n_inputs + k for k, i in enumerate(needed)}
        operations: list[Any] = [(*graph.operations[i], node_of[i]) for i in needed]  # type: ignore[misc]
        operations += [(RESULT, expr, None, index) for index, expr in results.items()]
        terms: list[tuple[int, float]] = []
        rows, constants = [], []
        for kind, first, second, index in operations:
            begin = len(terms)
            terms += [(node_of[i], c) for i, c in first.terms.items()]
            middle = len(terms)
            if second is not None:
                terms += [(node_of[i], c) for i, c in second.terms.items()]
            rows.append((kind, index, begin, middle, len(terms)))
            constants += [first.constant, 0.0 if second is None else second.constant]
        return cls(
            np.array(rows, dtype=np.int64).reshape(-1, N_COLUMNS),
            np.array([i for i, _ in terms], dtype=np.int64),
            number_array(c for _, c in terms),
            number_array(constants).reshape(-1, 2),
            len(node_of),
        )

    def as_floats(self) -> list[float]:
        """Return the table as floats for bodies/read_tables.py, with nodes renumbered so that results come first."""
        rows = self.rows.copy()
        is_result = rows[:, KIND] == RESULT
        n_results = int(is_result.sum())
        rows[~is_result, NODE] += n_results
        sizes = [n_results, self.n_nodes, len(rows), len(self.columns)]
        parts: list[Any] = [sizes, rows.ravel(), self.columns + n_results, self.coefficients, self.constants.ravel()]
        return [float(x) for part in parts for x in part]

    def as_arrays(self, result_indices: Sequence[int]) -> tuple[Any, Any]:
        """Return the table as integers and floats; `result_indices`: index of each result in a callback's output."""
        rows, n = self.rows.copy(), len(result_indices)
        rows[rows[:, KIND] == RESULT, NODE] += self.n_nodes
        header = [self.n_nodes + n, len(rows), len(self.columns), n]
        integers = np.concatenate([header, rows.ravel(), self.columns, result_indices])
        return integers.astype(np.int64), np.concatenate([self.constants.ravel(), self.coefficients])

    def replace_coefficients(self, convert: Callable[[Any], Array]) -> "OperationTable":
        """Return a copy of the table in which convert(array) replaces the arrays of coefficients and of constants."""
        return self._replace(constants=convert(self.constants), coefficients=convert(self.coefficients))


Terms = tuple[tuple[int, float], ...]  # pairs of a quantity and its coefficient

LITERALS = (0.0, 1.0, -1.0)  # numbers that generated code need not multiply by; it reads all other numbers from arrays
LITERAL_TOLERANCE = 8.0 * 2.0**-52  # largest difference between a coefficient and the literal 1 or -1 that replaces it


class Coefficient(float):
    """Coefficient that generated code reads from an array; two Coefficients with equal values are not equal.

    `index`: index in the array. `varies`: whether this array has the coefficients that vary with parameters.
    """

    __slots__ = ("index", "varies")
    index: int
    varies: bool

    def __new__(cls, value: float, index: int, varies: bool = False) -> "Coefficient":
        """Create a coefficient; `value`: its current value, `index`: its index in the array."""
        coefficient = super().__new__(cls, value)
        coefficient.index, coefficient.varies = index, varies
        return coefficient

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def __repr__(self) -> str:
        return f"{'varying' if self.varies else 'number'} {self.index}"


class Coefficients:
    """Numbering of the coefficients of expressions: their indices in arrays that generated code reads.

    Equal expressions share coefficients. If `separate_varying`, the coefficients that vary with parameters have a
    second array with indices of its own, because their values differ between SIMD lanes.
    """

    def __init__(self, separate_varying: bool = False) -> None:
        self._separates_varying = separate_varying
        self._values: list[float] = []
        self._formulas: Any = np.zeros(0)
        self._varying: dict[tuple[float, Powers], Parameter] = {}
        self._indexed_terms: dict[tuple[Terms, float], tuple[Terms, float]] = {}
        self._indexed_expressions: dict[Any, tuple[Terms, float]] = {}

    @property
    def values(self) -> NDArray[np.float64]:
        """Return the values of coefficients during the trace; if `separate_varying`, only of those that do not vary."""
        return np.array(self._values, dtype=np.float64)

    @property
    def formulas(self) -> Any:
        """Return an array of the coefficients (floats or Parameters): a new one only if coefficients were added."""
        if len(self._formulas) != len(self._values):
            self._formulas = number_array(self._values)
        return self._formulas

    def indexed_terms(self, terms: Terms, constant: float = 0.0) -> tuple[Terms, float]:
        """Return `terms` and `constant`; a Coefficient, which has an index, replaces each number except 0, 1 and -1."""
        key = tuple((i, rounded(c)) for i, c in terms), rounded(constant)
        numbers = self._indexed_terms.get(key)
        if numbers is None:
            numbers = self._indexed_terms[key] = (
                tuple((i, self._literal_or_coefficient(c)) for i, c in terms),
                self._literal_or_coefficient(constant),
            )
        return numbers

    def indexed_expression(self, expr: Affine) -> tuple[Terms, float]:
        """Return the terms and the constant of an affine expression, as `indexed_terms` does."""
        numbers = self._indexed_expressions.get(expr.key)
        if numbers is None:
            numbers = self._indexed_expressions[expr.key] = self.indexed_terms(tuple(expr.terms.items()), expr.constant)
        return numbers

    def structure(self, program: Program, stored: Mapping[int, int] = MappingProxyType({})) -> Iterable[Any]:
        """Yield all that the code for a program depends on, except values of coefficients: a key for cached code.

        `stored`: indices, in memory, of quantities that the code loads instead of computing them; keys: the quantities.
        """
        graph, exprs = program.graph, program.expressions
        needed = graph.quantities_for(exprs, stored)
        names: dict[int, Any] = {i: f"input {i}" for i, operation in enumerate(graph.operations) if operation is None}
        names |= {i: k for k, i in enumerate(needed)}
        names |= {i: f"kept {index}" for i, index in stored.items()}

        def describe(expr: Affine) -> Any:
            terms, constant = self.indexed_expression(expr)
            return [(names[i], c) for i, c in terms], constant

        yield [describe(expr) for expr in exprs]
        for i in needed:
            kind, *arguments = graph.operations[i]  # type: ignore[misc]
            yield kind, [describe(expr) for expr in arguments if isinstance(expr, Affine)]

    @property
    def n_varying(self) -> int:
        """Return the number of coefficients that vary with parameters."""
        return len(self._varying)

    def values_for(self, tape: ParameterTape, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the values (n_runs, n_varying) of the coefficients that vary, for parameters (n_runs, n_p)."""
        return tape.evaluate(list(self._varying.values()), parameters)

    def _literal_or_coefficient(self, value: float) -> float:
        if type(value) is Parameter:  # never a literal, even if its current value is 0 or 1
            if self._separates_varying:
                expr = value.scale, value.powers
                self._varying.setdefault(expr, value)
                return Coefficient(value, list(self._varying).index(expr), varies=True)
        elif (literal := nearest_literal(value)) is not None:
            return literal
        self._values.append(value)
        return Coefficient(value, len(self._values) - 1)


def nearest_literal(value: float) -> float | None:
    """Return 0, 1 or -1 if `value` is this number up to rounding errors; None for other numbers and for Parameters."""
    if type(value) is Parameter or not math.isfinite(value):
        return None
    nearest = float(round(value))
    return nearest if nearest in LITERALS and abs(value - nearest) <= LITERAL_TOLERANCE * abs(nearest) else None

"""Execute programs (selected outputs of a graph) in any algebra, and number the coefficients that they read.

- `Program.run` executes a program, or writes code for it. The algebra defines what values are: arrays (`Arrays`), LLVM
  code (`llvm_code.Lowering`), degrees of growth (`time_dependence.Degrees`).
- `OperationTable` lists the operations for compiled kernels, which interpret its rows.
- Derivatives extend the graph (`graph.Derivative`). Expressions of parameters alone are coefficients
  (`parameter_expressions`), which are computed before a program runs.
"""

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import Affine, Graph, rounded
from twoloop.generate.parameter_expressions import Parameter, ParameterTape, Powers, array_of
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.operations import KIND, N_COLUMNS, NODE, RESULT

Array = NDArray[np.float64]
T = TypeVar("T")

# comparison of a program that was traced from a user's function with calls of the function
N_COMPARED = 5  # number of states
TIME_SPACING = 0.37  # time between the states, s, which is no usual period of a force
MAX_TRACE_DIFFERENCE = 1e-10  # largest relative difference

# cost of operations, in multiplications; functions cost 0
COSTS = {op.PRODUCT: 1, op.RECIPROCAL: 4}


class Algebra(Generic[T]):
    """Arithmetic in which a program runs; subclasses define what values are, and the operations on values.

    Attributes
    ----------
    functions : mapping
        Functions that perform the operations of one argument, by the kinds of operations.
    values : dict
        Values of the quantities that were defined, by the indices of the quantities.
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
        """Return the result of an operation; operations other than products ignore their second argument."""
        argument = self.affine(first)
        if kind == op.PRODUCT:
            assert second is not None
            return self.product(argument, self.affine(second))
        return argument if kind == op.SUM else self.functions[kind](argument)

    def define(self, quantity: int, value: T) -> None:
        """Define the value of a quantity."""
        self.values[quantity] = value

    def run(self, graph: Graph, quantities: Iterable[int]) -> None:
        """Compute quantities in the given order."""
        for i in quantities:
            operation = graph.operations[i]
            assert operation is not None
            self.define(i, self.operation(*operation))

    def outputs(self, program: "Program") -> list[list[T]]:
        """Compute and return the arrays of a program, after its inputs were defined.

        The quantities of its conditions are computed, too.
        """
        self.run(program.graph, program.quantities())
        return [[self.affine(form) for form in forms] for forms in program.arrays.values()]


@dataclass(frozen=True)
class Program:
    """Arrays to be computed from the inputs of a graph, and conditions under which they are valid.

    Attributes
    ----------
    graph : Graph
    arrays : dict
        Names of the arrays, and their entries: affine expressions.
    conditions : list of (Affine, Affine)
        Pairs of which the first must be larger than the second.
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
        """List the quantities that the outputs need, see `Graph.needed_by`."""
        return self.graph.needed_by(self.forms, available)

    def cost(self) -> int:
        """Count the multiplications and additions of the program; a reciprocal counts as four, functions as none."""
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
    """Algebra of NumPy arrays, which hold one number for each run.

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
    """Operations of a program as arrays, for the kernels in kernels/evaluation/operations.py.

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
        """Create the table that computes `results`, expressions by index; the first quantities are the inputs."""
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
        """Return the table as a list of numbers, to be stored in the parameters of a model: results come first."""
        rows = self.rows.copy()
        is_result = rows[:, KIND] == RESULT
        n_results = int(is_result.sum())
        rows[~is_result, NODE] += n_results
        sizes = [n_results, self.n_nodes, len(rows), len(self.columns)]
        parts: list[Any] = [sizes, rows.ravel(), self.columns + n_results, self.coefficients, self.constants.ravel()]
        return [float(x) for part in parts for x in part]

    def packed(self, result_indices: Sequence[int]) -> tuple[Any, Any]:
        """Return the table as one array of integers and one of floats; results are stored at `result_indices`."""
        rows, n = self.rows.copy(), len(result_indices)
        rows[rows[:, KIND] == RESULT, NODE] += self.n_nodes
        header = [self.n_nodes + n, len(rows), len(self.columns), n]
        integers = np.concatenate([header, rows.ravel(), self.columns, result_indices])
        return integers.astype(np.int64), np.concatenate([self.constants.ravel(), self.coefficients])

    def with_numbers(self, numbers_for: Callable[[Any], Array]) -> "OperationTable":
        """Return a copy of the table in which `numbers_for` was applied to each array of coefficients."""
        return self._replace(constants=numbers_for(self.constants), coefficients=numbers_for(self.coefficients))


Terms = tuple[tuple[int, float], ...]  # quantities and their coefficients

LITERALS = (0.0, 1.0, -1.0)  # coefficients that are literals in the code, as they need no multiplication
ROUNDING = 8.0 * 2.0**-52  # relative difference from one of LITERALS up to which a coefficient is replaced by it


class Coefficient(float):
    """Coefficient that the code reads from an array; it equals only itself, even if values are equal.

    Coefficients that vary with parameters may be in an array of their own.
    """

    __slots__ = ("place", "varies")
    place: int
    varies: bool

    def __new__(cls, value: float, place: int, varies: bool = False) -> "Coefficient":
        """Create the coefficient that is stored at the index `place`."""
        coefficient = super().__new__(cls, value)
        coefficient.place, coefficient.varies = place, varies
        return coefficient

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)

    def __repr__(self) -> str:
        return f"{'varying' if self.varies else 'number'} {self.place}"


class Coefficients:
    """Assign array indices to the coefficients of expressions, in the order of their first use.

    Equal expressions share their indices. `apart`: coefficients that vary with parameters get an array of their own,
    because their values differ between SIMD lanes.
    """

    def __init__(self, apart: bool = False) -> None:
        self._apart = apart
        self._values: list[float] = []
        self._formulas: Any = np.zeros(0)
        self._varying: dict[tuple[float, Powers], Parameter] = {}
        self._numbered: dict[tuple[Terms, float], tuple[Terms, float]] = {}
        self._of_forms: dict[Any, tuple[Terms, float]] = {}

    @property
    def values(self) -> NDArray[np.float64]:
        """Return the values of the coefficients that the code reads."""
        return np.array(self._values, dtype=np.float64)

    @property
    def formulas(self) -> Any:
        """Return `values` as expressions in the parameters; the same array object until a coefficient is added."""
        if len(self._formulas) != len(self._values):
            self._formulas = array_of(self._values)
        return self._formulas

    def of(self, terms: Terms, constant: float = 0.0) -> tuple[Terms, float]:
        """Replace the numbers of terms and a constant by coefficients."""
        key = tuple((i, rounded(c)) for i, c in terms), rounded(constant)
        numbers = self._numbered.get(key)
        if numbers is None:
            numbers = self._numbered[key] = tuple((i, self._number(c)) for i, c in terms), self._number(constant)
        return numbers

    def of_form(self, form: Affine) -> tuple[Terms, float]:
        """Replace the numbers of an affine expression by coefficients."""
        numbers = self._of_forms.get(form.key)
        if numbers is None:
            numbers = self._of_forms[form.key] = self.of(tuple(form.terms.items()), form.constant)
        return numbers

    def structure(self, program: Program, given: Mapping[int, int] = MappingProxyType({})) -> Iterable[Any]:
        """Yield everything that the code for a program depends on, except the values of coefficients.

        `given` maps quantities that are read from memory to their indices.
        """
        graph, forms = program.graph, program.forms
        needed = graph.needed_by(forms, given)
        name: dict[int, Any] = {i: f"input {i}" for i, each in enumerate(graph.operations) if each is None}
        name |= {i: k for k, i in enumerate(needed)}
        name |= {i: f"kept {place}" for i, place in given.items()}

        def described_form(form: Affine) -> Any:
            terms, constant = self.of_form(form)
            return [(name[i], c) for i, c in terms], constant

        yield [described_form(form) for form in forms]
        for i in needed:
            kind, *arguments = graph.operations[i]  # type: ignore[misc]
            yield kind, [described_form(each) for each in arguments if isinstance(each, Affine)]

    @property
    def n_varying(self) -> int:
        """Return the number of coefficients that vary with parameters."""
        return len(self._varying)

    def for_parameters(self, record: ParameterTape, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate the coefficients that vary, for parameters (n_runs, n_p): one row for each run."""
        return record.evaluate(list(self._varying.values()), parameters)

    def _number(self, value: float) -> float:
        if type(value) is Parameter:  # no literal, even if its present value is 0 or 1
            if self._apart:
                expression = value.scale, value.powers
                self._varying.setdefault(expression, value)
                return Coefficient(value, list(self._varying).index(expression), varies=True)
        elif (exact := literal(value)) is not None:
            return exact
        self._values.append(value)
        return Coefficient(value, len(self._values) - 1)


def literal(value: float) -> float | None:
    """Return 0, 1 or -1 if a number equals it up to rounding; None if the number must be read as a coefficient."""
    if type(value) is Parameter or not math.isfinite(value):
        return None
    nearest = float(round(value))
    return nearest if nearest in LITERALS and abs(value - nearest) <= ROUNDING * abs(nearest) else None

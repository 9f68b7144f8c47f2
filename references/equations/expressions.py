"""The accelerations of a compiled mechanism as expressions of another package.

`twoloop.generate` traces the callbacks into a graph of operations and differentiates it. Here eq. (6) is factorised on
that graph, exploiting structural zeros, in an elimination order with little fill-in; then the graph is translated to
expressions of a package, operation by operation.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from references.equations.rows import independent_rows
from references.lines import CannotRun
from twoloop.generate.graph import Affine, Derivative, Graph, Untraceable, symbol_array
from twoloop.generate.trace import Equations, only_quantity
from twoloop.generate.traced_values import CallbackTraces
from twoloop.kernels.data.indices import GIVEN
from twoloop.kernels.evaluation import operations
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem, check_system

Functions = Mapping[str, Callable[[Any], Any]]  # elementary functions of the package, by name

FUNCTIONS = {operations.SINE: "sin", operations.COSINE: "cos", operations.SQUARE_ROOT: "sqrt"}
FUNCTIONS |= {operations.EXPONENTIAL: "exp", operations.LOGARITHM: "log", operations.ARCTANGENT: "atan"}

DIVISION = 10.0  # products that take as long, about


class Block(NamedTuple):
    """One or two unknowns that are eliminated together, by one division."""

    places: tuple[int, ...]
    inverse: list[list[Affine]]  # of their part of D
    below: list[tuple[int, list[Affine]]]  # rows of L


class NotSymbolic(CannotRun, ValueError):
    """Raised if the equations of a system cannot be expressed symbolically; the message contains the reason."""


class Expressions:
    """The equations of one system as functions of symbols.

    The callbacks must be compiled, and not branch on t, q or v. Redundant rows are determined at (t0, q0, v0). With
    `of_parameters` the parameters are symbols, otherwise the numbers of the system.

    Raises NotSymbolic if the callbacks are Python functions, Q_d is not given, they branch on t, q or v or give near
    the start what their operations do not give, or the mass stays singular with rows of C_q added.
    """

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array, v0: Array, of_parameters: bool = False):
        check_system(system)
        if system.called_in_python:
            raise NotSymbolic(f"the callbacks of {system.name!r} are Python functions, not compiled ones")
        if system.n_c and not system.functions.flags[GIVEN["gamma"]]:
            raise NotSymbolic(f"{system.name!r} does not give Q_d (gamma)")
        self.system, self.traced = system, Equations(system)
        jacobian = system.jacobian(t0, q0)
        self.rows = list(independent_rows(jacobian))
        self.added = _rows_for_mass(system.mass(t0, q0), jacobian[self.rows])
        try:
            self._forms(self.traced)
            CallbackTraces(system, self.traced.graph).refuse_if_wrong(system, t0, t0 + 1.0, q0, v0)
            if of_parameters:
                self.traced = Equations(system)
                self.traced.parameters = symbol_array(self.traced.graph.inputs(system.parameters.size, False))
            self.mass, self.jacobian, self.force, self.gamma = self._forms(self.traced)
        except Untraceable as error:
            raise NotSymbolic(str(error)) from error

    def _forms(self, traced: Equations) -> tuple[Any, ...]:
        """Return M, C_q, Q and Q_d of the rows that are kept, as arrays of forms."""
        mass, jacobian, force, gamma = (traced.expressions(kind) for kind in ("mass", "jacobian", "force", "gamma"))
        return mass, jacobian[self.rows], force, gamma[self.rows]

    @cached_property
    def factors(self) -> list[Block]:
        """Factors of the matrix of eq. (6)."""
        matrix, n = {(i, j): self.mass[i, j] for i, j in _nonzero(self.mass)}, self.system.n_q
        for k in self.added:  # M + C_q^T C_q gives the same accelerations
            places = [i for i, entry in enumerate(self.jacobian[k]) if _is_nonzero(entry)]
            for i in places:
                for j in places:
                    term = self.jacobian[k, i] * self.jacobian[k, j]
                    matrix[i, j] = matrix[i, j] + term if (i, j) in matrix else term
        for k, i in _nonzero(self.jacobian):
            matrix[n + k, i] = matrix[i, n + k] = self.jacobian[k, i]
        size = n + len(self.rows)
        orders = [_order(matrix, n, size, *options) for options in product((True, False), repeat=2)]
        return min((_factored(matrix, order) for order in orders), key=self._cost)

    def _cost(self, factors: Sequence[Block]) -> float:
        """Return about how many operations the accelerations take by these factors; a division counts for several."""
        graph = self.traced.graph
        accelerations = _substituted(factors, self._right_hand_side(self.force, self.gamma))[: self.system.n_q]
        kinds = [graph.operations[i] for i in graph.quantities_for(accelerations)]
        terms = sum(len(form.terms) for _, *forms in kinds for form in forms if form is not None)  # type: ignore[misc]
        return terms + DIVISION * sum(kind == operations.RECIPROCAL for kind, *_ in kinds)  # type: ignore[misc]

    def _right_hand_side(self, force: Any, gamma: Any) -> list[Affine]:
        """Return that of eq. (6), with the rows that were added to the mass."""
        result = [*force]
        for k in self.added:
            for i, entry in enumerate(self.jacobian[k]):
                result[i] = result[i] + entry * gamma[k]
        return [*result, *gamma]

    @cached_property
    def solution(self) -> list[Affine]:
        """Return accelerations and multipliers of eq. (6)."""
        return _substituted(self.factors, self._right_hand_side(self.force, self.gamma))

    def derivatives(self) -> Iterator[list[Affine]]:
        """Yield the derivatives of the accelerations with respect to each of [q, v], as 2 n_q lists (n_q,) of forms."""
        return (_substituted(self.factors, right_side)[: self.system.n_q] for right_side in self.right_hand_sides())

    def right_hand_sides(self) -> Iterator[list[Affine]]:
        """Yield the right-hand sides for these derivatives, whose matrix is that of eq. (6), factorised once.

        Its derivatives times the solution are in them.
        """
        n, graph = self.system.n_q, self.traced.graph
        masses, jacobians = _nonzero(self.mass), _nonzero(self.jacobian)
        for unknown in (*self.traced.q, *self.traced.v):
            by = Derivative(graph, {only_quantity(unknown): Affine(graph, 1.0, {})})
            Q, gamma = (list(map(by.differentiate, forms)) for forms in (self.force, self.gamma))
            for i, j in masses:
                Q[i] = Q[i] - by.differentiate(self.mass[i, j]) * self.solution[j]
            for k, j in jacobians:
                Cq = by.differentiate(self.jacobian[k, j])
                Q[j] = Q[j] - Cq * self.solution[n + k]
                gamma[k] = gamma[k] - Cq * self.solution[j]
            yield self._right_hand_side(Q, gamma)

    def accelerations(
        self, functions: Functions, t: Any, q: Sequence[Any], v: Sequence[Any], parameters: Sequence[Any] = ()
    ) -> list[Any]:
        """Return the accelerations (n_q,) of eq. (6) as expressions; `parameters`: symbols, if they are symbolic."""
        written = Printed(self.traced.graph, functions, [t, *q, *v, *parameters])
        return written.translate(self.solution[: self.system.n_q])


@lru_cache(maxsize=64)
def expressions_at(system: ConstrainedSystem, t0: float, q0: bytes, v0: bytes) -> Expressions:
    """Return the equations for a start, given as the bytes of its arrays; cached."""
    return Expressions(system, t0, np.frombuffer(q0).copy(), np.frombuffer(v0).copy())


class Printed:
    """Translates the quantities of a graph to expressions of a package, each once.

    `inputs` are the expressions of the inputs of the graph.
    """

    def __init__(self, graph: Graph, functions: Functions, inputs: Sequence[Any]):
        self.graph, self.functions = graph, functions
        self.known: dict[int, Any] = dict(enumerate(inputs))
        self.forms: dict[Any, Any] = {}

    def translate(self, forms: Iterable[Affine]) -> list[Any]:
        """Return the expressions of forms; a constant is a float."""
        forms = list(forms)
        for i in self.graph.quantities_for(forms):
            if i not in self.known:
                kind, first, second = self.graph.operations[i]  # type: ignore[misc]
                self.known[i] = self._operation(kind, first, second)
        return [self._sum(form) for form in forms]

    def _operation(self, kind: int, first: Affine, second: Affine | None) -> Any:
        x = self._sum(first)
        if kind == operations.PRODUCT:
            assert second is not None
            return x * self._sum(second)
        if kind == operations.SUM:
            return x
        if kind == operations.RECIPROCAL:
            return 1.0 / x
        try:
            return self.functions[FUNCTIONS[kind]](x)
        except Exception as error:  # packages raise different exceptions for unsupported functions
            raise NotSymbolic(f"{FUNCTIONS[kind]} cannot be had as an expression: {error!r}") from error

    def _sum(self, form: Affine) -> Any:
        """Return c + sum_i c_i x_i, with negative terms last."""
        if form.key not in self.forms:
            total: Any = float(form.constant)
            for i, c in sorted(form.terms.items(), key=lambda term: term[1] < 0.0):
                x = self.known[i] if abs(c) == 1.0 else abs(c) * self.known[i]
                if isinstance(total, float) and total == 0.0:
                    total = x if c > 0.0 else -x
                else:
                    total = total + x if c > 0.0 else total - x
            self.forms[form.key] = total
        return self.forms[form.key]


def functions_of(package: Any) -> dict[str, Callable[[Any], Any]]:
    """Return the functions of FUNCTIONS provided by a package under these names."""
    return {name: getattr(package, name) for name in FUNCTIONS.values() if hasattr(package, name)}


def _is_nonzero(form: Affine) -> bool:
    return bool(form.terms) or form.constant != 0.0


def _nonzero(forms: Any) -> list[tuple[int, ...]]:
    """Return the indices of structural nonzeros."""
    return [place for place in np.ndindex(forms.shape) if _is_nonzero(forms[place])]


def _rows_for_mass(mass: Array, jacobian: Array) -> list[int]:
    """Return rows k for which M + sum C_k^T C_k is positive definite; none if M is."""
    rows: list[int] = []
    rank = np.linalg.matrix_rank(mass)
    order = np.argsort([np.count_nonzero(row) for row in jacobian], kind="stable")
    for k in order.tolist():
        if rank == mass.shape[0]:
            break
        extended = mass + np.outer(jacobian[k], jacobian[k])
        if np.linalg.matrix_rank(extended) > rank:
            mass, rank = extended, rank + 1
            rows.append(k)
    if rank < mass.shape[0]:
        raise NotSymbolic("the mass matrix stays singular with the constraints added")
    return rows


def _order(
    matrix: Mapping[tuple[int, int], Affine], n: int, size: int, together: bool, early: bool
) -> list[tuple[int, ...]]:
    """Return an elimination order by minimum degree, with each row of C_q after all its coordinates.

    The pivots are then those of the definite matrices M and -C_q M^-1 C_q^T. `together`: unknowns with the same
    neighbours, such as the two rows of a joint, are eliminated at once. `early`: of equal degrees those come first that
    wait for the fewest divisions. A coordinate in one row of C_q alone, by a number, goes first, with this row.
    """
    neighbours: list[set[int]] = [set() for _ in range(size)]
    for i, j in matrix:
        neighbours[i] |= {j} - {i}
    waits = [{j for j in neighbours[i] if j < n} if i >= n else set() for i in range(size)]
    remaining, depth = set(range(size)), [0] * size
    order: list[tuple[int, ...]] = []
    given = _given_by_rows(matrix, neighbours, n)
    while remaining:
        if given:
            i, row = places = given.pop()
            neighbourhood = neighbours[i] | neighbours[row]
        else:
            i = min((j for j in remaining if not waits[j]), key=lambda j: (len(neighbours[j]), early * depth[j], j))
            neighbourhood = neighbours[i] | {i}
            near = (j for j in neighbourhood - {i} if not waits[j] and (j < n) == (i < n))
            equal = [j for j in near if neighbours[j] | {j} == neighbourhood]
            places = (i, *(sorted(equal)[:1] if together else ()))
        order.append(places)
        remaining -= set(places)
        neighbourhood -= set(places)
        for j in neighbourhood:
            neighbours[j] = (neighbours[j] | neighbourhood) - {*places, j}
            depth[j] = max(depth[j], depth[i] + 1)
        for j in remaining:
            waits[j] -= set(places)
    return order


def _given_by_rows(
    matrix: Mapping[tuple[int, int], Affine], neighbours: Sequence[set[int]], n: int
) -> list[tuple[int, ...]]:
    """Return coordinates that stand in one row of C_q alone, by a number, and whose mass is one; each with its row."""
    rows: dict[int, int] = {}
    for i in range(n):
        k = max(neighbours[i], default=0)
        if len(neighbours[i]) == 1 and k >= n and not any(matrix[i, j].terms for j in (i, k) if (i, j) in matrix):
            rows.setdefault(k, i)
    return [(i, k) for k, i in rows.items()]


def _factored(matrix: dict[tuple[int, int], Affine], order: list[tuple[int, ...]]) -> list[Block]:
    """Return the factors L D L^T, in this order, of a symmetric matrix; entries not in `matrix` are zero."""
    rows: dict[int, dict[int, Affine]] = {i: {} for places in order for i in places}
    for (i, j), entry in matrix.items():
        rows[i][j] = entry
    blocks: list[Block] = []
    for places in order:
        zero = Affine(next(iter(matrix.values())).graph, 0.0, {})
        inverse = _inverse([[rows[i].pop(j, zero).as_term() for j in places] for i in places])
        columns = dict.fromkeys(j for i in places for j in rows[i])
        entries = [(j, [rows[i].get(j, zero).as_term() for i in places]) for j in columns]
        below = [(j, [_dot(row, values).as_term() for row in inverse]) for j, values in entries]
        for j, multiples in below:
            for k, values in entries:
                change = _dot(multiples, values)
                rows[j][k] = rows[j][k] - change if k in rows[j] else -change
            for i in places:
                rows[j].pop(i, None)
        blocks.append(Block(places, inverse, below))
    return blocks


def _inverse(pivots: list[list[Affine]]) -> list[list[Affine]]:
    """Return the inverse of a symmetric matrix of one or two rows."""
    a = pivots[0][0]
    if len(pivots) == 1:
        return [[1.0 / a]]
    b, c = pivots[1]
    inverse = 1.0 / (a * c - b * b).as_term()
    return [[(c * inverse).as_term(), (-b * inverse).as_term()], [(-b * inverse).as_term(), (a * inverse).as_term()]]


def _dot(first: Sequence[Affine], second: Sequence[Affine]) -> Affine:
    total = first[0] * second[0]
    for x, y in zip(first[1:], second[1:], strict=True):
        total = total + x * y
    return total


def _substituted(factors: Sequence[Block], right_side: list[Affine]) -> list[Affine]:
    """Return the solution of the factorised system."""
    solution = list(right_side)
    owed: list[list[tuple[Affine, Affine]]] = [[] for _ in right_side]
    for places, _, below in factors:
        for i in places:
            solution[i] = (solution[i] - _sum_of_products(owed[i])).as_term()
        for j, multiples in below:
            owed[j] += zip(multiples, [solution[i] for i in places], strict=True)
    for places, inverse, below in reversed(factors):
        pivots = [solution[i] for i in places]
        for k, (i, row) in enumerate(zip(places, inverse, strict=True)):
            solution[i] = (
                _dot(row, pivots) - _sum_of_products([(multiples[k], solution[j]) for j, multiples in below])
            ).as_term()
    return solution


def _sum_of_products(products: Sequence[tuple[Affine, Affine]]) -> Any:
    """Return the sum of products, in which multiples of one factor are summed up before they are multiplied by it."""
    total: Any = 0.0
    by_factor: dict[Any, list[Any]] = {}
    for first, second in products:
        if not first.terms:
            total = total + first.constant * second
            continue
        scale, factor = first.normalized()
        by_factor.setdefault(factor.key, [factor, 0.0])[1] += scale * second
    for factor, second in by_factor.values():
        total = total + factor * second.as_term()
    return total

"""The accelerations of a compiled mechanism as expressions of another package.

`twoloop.generate` traces the callbacks into a graph of operations and differentiates it. Here eq. (6),
M a + C_q^T lam = Q and C_q a = Q_d, is factorised on that graph, exploiting structural zeros, in an elimination order
with little fill-in; then the graph is translated to expressions of a package, operation by operation.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from references.equations.rows import independent_rows
from references.lines import CannotRun
from twoloop.generate.derivative import Derivative
from twoloop.generate.traced_equations import Equations, only
from twoloop.generate.traced_values import Traced
from twoloop.generate.tracing import Form, Graph, Untraceable, symbols
from twoloop.kernels.data.flags import GAMMA_GIVEN
from twoloop.kernels.evaluation import operations
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem, check_system

Functions = Mapping[str, Callable[[Any], Any]]  # elementary functions of the package, by name
Factors = list[tuple[int, Form, list[tuple[int, Form]]]]

FUNCTIONS = {operations.SINE: "sin", operations.COSINE: "cos", operations.SQUARE_ROOT: "sqrt"}
FUNCTIONS |= {operations.EXPONENTIAL: "exp", operations.LOGARITHM: "log", operations.ARCTANGENT: "atan"}


class NotSymbolic(CannotRun, ValueError):
    """Raised if the equations of a system cannot be expressed symbolically; the message contains the reason."""


class Expressions:
    """The equations of one system as functions of symbols.

    Parameters
    ----------
    system : ConstrainedSystem
        A system with compiled callbacks that do not branch on q or v.
    t0 : float
    q0, v0 : ndarray (n_q,)
        A consistent state, at which redundant rows are determined.
    of_parameters : bool
        True: the parameters are symbols; False: the numbers of the system.

    Raises NotSymbolic if the callbacks are Python functions, Q_d is not given, they branch on t, q or v or give near
    the start what their operations do not give, or the mass stays singular with rows of C_q added.
    """

    def __init__(self, system: ConstrainedSystem, t0: float, q0: Array, v0: Array, of_parameters: bool = False):
        check_system(system)
        if system.called_in_python:
            raise NotSymbolic(f"the callbacks of {system.name!r} are Python functions, not compiled ones")
        if system.n_c and not system.functions.flags[GAMMA_GIVEN]:
            raise NotSymbolic(f"{system.name!r} does not give Q_d (gamma)")
        self.system, self.traced = system, Equations(system)
        jacobian = system.jacobian(t0, q0)
        self.rows = list(independent_rows(jacobian))
        self.added = _rows_for_mass(system.mass(t0, q0), jacobian[self.rows])
        try:
            self._forms(self.traced)
            Traced(system, self.traced.graph).refuse(system, t0, t0 + 1.0, q0, v0)
            if of_parameters:
                self.traced = Equations(system)
                self.traced.parameters = symbols(self.traced.graph.inputs(system.parameters.size, False))
            self.mass, self.jacobian, self.force, self.gamma = self._forms(self.traced)
        except Untraceable as error:
            raise NotSymbolic(str(error)) from error

    def _forms(self, traced: Equations) -> tuple[Any, ...]:
        """Return M, C_q, Q and Q_d of the rows that are kept, as arrays of forms."""
        mass, jacobian, force, gamma = (traced.of(kind) for kind in ("mass", "jacobian", "force", "gamma"))
        return mass, jacobian[self.rows], force, gamma[self.rows]

    @cached_property
    def factors(self) -> Factors:
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
        return _factored(matrix, _order(matrix, n, n + len(self.rows)))

    def _right_hand_side(self, force: Any, gamma: Any) -> list[Form]:
        """Return that of eq. (6), with the rows that were added to the mass."""
        right = [*force]
        for k in self.added:
            for i, entry in enumerate(self.jacobian[k]):
                right[i] = right[i] + entry * gamma[k]
        return [*right, *gamma]

    @cached_property
    def solution(self) -> list[Form]:
        """Return accelerations and multipliers of eq. (6)."""
        return _substituted(self.factors, self._right_hand_side(self.force, self.gamma))

    def derivatives(self) -> Iterator[list[Form]]:
        """Yield the derivatives of the accelerations with respect to each of [q, v], as 2 n_q lists (n_q,) of forms."""
        for right in self.right_hand_sides():
            yield _substituted(self.factors, right)[: self.system.n_q]

    def right_hand_sides(self) -> Iterator[list[Form]]:
        """Yield the right-hand sides for these derivatives, whose matrix is that of eq. (6), factorised once.

        Its derivatives times the solution are in them.
        """
        n, graph = self.system.n_q, self.traced.graph
        masses, jacobians = _nonzero(self.mass), _nonzero(self.jacobian)
        for unknown in (*self.traced.q, *self.traced.v):
            by = Derivative(graph, {only(unknown): Form(graph, 1.0, {})})
            Q, gamma = (list(map(by.of, of)) for of in (self.force, self.gamma))
            for i, j in masses:
                Q[i] = Q[i] - by.of(self.mass[i, j]) * self.solution[j]
            for k, j in jacobians:
                Cq = by.of(self.jacobian[k, j])
                Q[j] = Q[j] - Cq * self.solution[n + k]
                gamma[k] = gamma[k] - Cq * self.solution[j]
            yield self._right_hand_side(Q, gamma)

    def accelerations(
        self, functions: Functions, t: Any, q: Sequence[Any], v: Sequence[Any], parameters: Sequence[Any] = ()
    ) -> list[Any]:
        """Return the accelerations (n_q,) of eq. (6) as expressions; `parameters`: symbols, if they are symbolic."""
        written = Printed(self.traced.graph, functions, [t, *q, *v, *parameters])
        return written.each(self.solution[: self.system.n_q])


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

    def each(self, forms: Iterable[Form]) -> list[Any]:
        """Return the expressions of forms; a constant is a float."""
        forms = list(forms)
        for i in self.graph.needed_by(forms):
            if i not in self.known:
                kind, first, second = self.graph.operations[i]  # type: ignore[misc]
                self.known[i] = self._operation(kind, first, second)
        return [self._sum(form) for form in forms]

    def _operation(self, kind: int, first: Form, second: Form | None) -> Any:
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

    def _sum(self, form: Form) -> Any:
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


def _is_nonzero(form: Form) -> bool:
    return bool(form.terms) or form.constant != 0.0


def _nonzero(forms: Any) -> list[tuple[int, ...]]:
    """Return the indices of structural nonzeros."""
    return [place for place in np.ndindex(forms.shape) if _is_nonzero(forms[place])]


def _rows_for_mass(mass: Array, jacobian: Array) -> list[int]:
    """Return rows k for which M + sum C_k^T C_k is positive definite; none if M is."""
    chosen: list[int] = []
    rank = np.linalg.matrix_rank(mass)
    order = np.argsort([np.count_nonzero(row) for row in jacobian], kind="stable")
    for k in order.tolist():
        if rank == mass.shape[0]:
            break
        more = mass + np.outer(jacobian[k], jacobian[k])
        if np.linalg.matrix_rank(more) > rank:
            mass, rank = more, rank + 1
            chosen.append(k)
    if rank < mass.shape[0]:
        raise NotSymbolic("the mass matrix stays singular with the constraints added")
    return chosen


def _order(matrix: Iterable[tuple[int, int]], n: int, size: int) -> list[int]:
    """Return an elimination order by minimum degree, with each row of C_q after all its coordinates.

    The pivots are then those of the definite matrices M and -C_q M^-1 C_q^T.
    """
    neighbours: list[set[int]] = [set() for _ in range(size)]
    for i, j in matrix:
        neighbours[i] |= {j} - {i}
    waits = [sum(j < n for j in neighbours[i]) if i >= n else 0 for i in range(size)]
    own = [[k for k in neighbours[i] if k >= n] if i < n else [] for i in range(size)]
    left, order = set(range(size)), []
    while left:
        i = min((j for j in left if waits[j] == 0), key=lambda j: (len(neighbours[j]), j))
        left.remove(i)
        order.append(i)
        for k in own[i]:
            waits[k] -= 1
        for j in neighbours[i]:
            neighbours[j] |= neighbours[i]
            neighbours[j] -= {i, j}
    return order


def _factored(matrix: dict[tuple[int, int], Form], order: list[int]) -> Factors:
    """Return the LDL^T factors, in this order, of a symmetric matrix; entries not in `matrix` are zero."""
    rows: list[dict[int, Form]] = [{} for _ in order]
    for (i, j), entry in matrix.items():
        rows[i][j] = entry
    factors: Factors = []
    for i in order:
        inverse = 1.0 / rows[i].pop(i)
        row = [(j, entry.value()) for j, entry in rows[i].items()]
        column = [(j, (entry * inverse).value()) for j, entry in row]
        for j, multiple in column:
            for k, entry in row:
                rows[j][k] = rows[j][k] - multiple * entry if k in rows[j] else -(multiple * entry)
            del rows[j][i]
        factors.append((i, inverse, column))
    return factors


def _substituted(factors: Factors, right: list[Form]) -> list[Form]:
    """Return the solution of the factorised system."""
    solution = list(right)
    for i, _, column in factors:
        solution[i] = solution[i].value()
        for j, multiple in column:
            solution[j] = solution[j] - multiple * solution[i]
    for i, inverse, column in reversed(factors):
        total = solution[i] * inverse
        for j, multiple in column:
            total = total - multiple * solution[j]
        solution[i] = total.value()
    return solution

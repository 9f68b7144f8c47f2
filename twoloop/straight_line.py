"""The equations of one mechanism as straight-line code: what it would take to write them down, without loops.

The callbacks run once in Python on symbols (`twoloop.tracing`). The matrix of

    [M  G^T] [a  ]   [Q    ]
    [G  0  ] [lam] = [Gamma]

with G = C_q is eliminated symbolically, without what is zero by its structure, in an order found once: a row of G after
all its coordinates, so that the pivots are those of definite matrices, M and -G M^-1 G^T, and need no search. A row of G
is small against the rows before it where its pivot is small against the one it has without them: then the code says
that it is not to be used. The same factors give the nearest position and velocity on the constraints, in the metric of
M. Where M is singular, rows g of G are added, M + g^T g, which changes neither.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.common import GAMMA_GIVEN, GIVEN
from twoloop.series import on_symbols
from twoloop.system import ConstrainedSystem
from twoloop.tracing import (
    ARCTANGENT,
    COSINE,
    EXPONENTIAL,
    LOGARITHM,
    PRODUCT,
    RECIPROCAL,
    SINE,
    SQUARE_ROOT,
    SUM,
    Form,
    Graph,
    Untraceable,
)

Array = NDArray[np.float64]

SINGULAR_MASS = 1e-10  # smallest over largest eigenvalue, below which rows of G are added to M
RANK = 1e-8  # the same of the rows of G at the start
SMALLEST_PIVOT = 1e-7  # of a row of G, of what it is without the others: the square of the sine of its angle to them
MOST = 20_000  # operations


@dataclass(frozen=True)
class Outputs:
    """What code is to compute from t, q and v: arrays, and conditions that are to hold.

    Attributes
    ----------
    arrays : dict
        Forms, for each array by its name.
    conditions : list of (Form, Form)
        The first is to be larger than the second.
    """

    arrays: dict[str, list[Form]]
    conditions: list[tuple[Form, Form]]

    def quantities(self, graph: Graph) -> list[int]:
        """What all of this is made of, inputs apart, in an order in which it can be computed."""
        found: set[int] = set()
        forms = [*(form for array in self.arrays.values() for form in array), *(each for c in self.conditions for each in c)]
        ahead = [i for form in forms for i in form.terms]
        while ahead:
            i = ahead.pop()
            operation = graph.operations[i]
            if i not in found and operation is not None:
                found.add(i)
                ahead += [j for form in operation[1:] if isinstance(form, Form) for j in form.terms]
        return sorted(found)


class Factors:
    """L D L^T of a symmetric matrix of forms, by an order that a definite matrix of this pattern allows.

    Attributes
    ----------
    columns : list of (int, Form, list of (int, Form))
        In the order of elimination: the place, the reciprocal of its pivot, and the entries of L below it.
    pivots : list of (Form, Form)
        Of the last rows, from `n` on: the pivot, and what it is without those among them, both as positive numbers.
    """

    def __init__(self, matrix: dict[tuple[int, int], Form], size: int, n: int):
        rows: list[dict[int, Form]] = [{} for _ in range(size)]
        for (i, j), value in matrix.items():
            rows[i][j] = value
        self.columns: list[tuple[int, Form, list[tuple[int, Form]]]] = []
        self.pivots: list[tuple[Form, Form]] = []
        alone: dict[int, Any] = {}
        for i in _order(rows, n):
            pivot = rows[i].pop(i).value()
            if i >= n:
                self.pivots.append((-pivot, -alone[i].value()))
            inverse = pivot.reciprocal()
            entries = [(j, value.value()) for j, value in rows[i].items()]
            column = [(j, (value * inverse).value()) for j, value in entries]
            for j, multiple in column:
                for k, value in entries:
                    change = multiple * value
                    if i < n <= j == k:
                        alone[j] = alone.get(j, 0.0) - change
                    rows[j][k] = rows[j][k] - change if k in rows[j] else -change
                del rows[j][i]
            self.columns.append((i, inverse, column))

    def solve(self, right: Sequence[Form]) -> list[Form]:
        """The solution for a right-hand side."""
        solution = list(right)
        for i, _, column in self.columns:
            solution[i] = solution[i].value()
            for j, multiple in column:
                solution[j] = solution[j] - multiple * solution[i]
        for i, inverse, column in reversed(self.columns):
            total = solution[i] * inverse
            for j, multiple in column:
                total = total - multiple * solution[j]
            solution[i] = total.value()
        return solution


def _order(rows: list[dict[int, Form]], n: int) -> list[int]:
    """Least degree first; a row from n on only after all that it has below n."""
    neighbours = [set(row) - {i} for i, row in enumerate(rows)]
    waits = [{j for j in neighbours[i] if j < n} if i >= n else set() for i in range(len(rows))]
    left, order = set(range(len(rows))), []
    while left:
        i = min((j for j in left if not waits[j]), key=lambda j: (len(neighbours[j]), j))
        left.remove(i)
        order.append(i)
        for j in neighbours[i]:
            neighbours[j] = (neighbours[j] | neighbours[i]) - {i, j}
            waits[j].discard(i)
    return order


class StraightLine:
    """The equations of a system whose rows of C_q are independent.

    Parameters
    ----------
    system : ConstrainedSystem
    added, scale : sequence of int, float
        Rows of G that make M definite, and their factor, see `rows_for_mass`.

    Attributes
    ----------
    graph : Graph
    inputs : list of Form
        t, q and v.
    there : Outputs
        "a" (n_q,), the accelerations at (q, v) as they stand.
    nearer : Outputs
        "q", "v" (n_q,), moved by Newton's method towards the constraints, and "a" (n_q,), "lam" (n_c,) for the
        velocities after the move and the position before it; "moved" (n_q,), the move of the position.

    Raises
    ------
    Untraceable
        Saying why the equations cannot be had.
    """

    def __init__(self, system: ConstrainedSystem, added: Sequence[int], scale: float):
        if system.n_a:
            raise Untraceable(f"{system.name!r} has nonholonomic rows")
        if system.n_c and not system.functions.flags[GIVEN["jacobian"]]:
            raise Untraceable(f"{system.name!r} does not give jacobian, which is needed")
        self.system, self.graph = system, Graph()
        (self.t,) = self.graph.inputs(1, False)
        self.q, self.v = self.graph.inputs(system.n_q, False), self.graph.inputs(system.n_q, True)
        self.inputs = [self.t, *self.q, *self.v]
        n, m = system.n_q, system.n_c
        self.mass = self._made("mass", (n, n), self.q)
        self.rows = self._made("jacobian", (m, n), self.q)
        self.rates = self._made("constraint_rate", (m,), self.q)
        self.added, self.scale = added, scale
        self.factors = Factors(self._matrix(), n + m, n)
        self.there = Outputs({"a": self._accelerations(self.v)[:n]}, self.conditions())
        self.nearer = self._nearer()
        if len(self.graph.operations) > MOST:
            raise Untraceable(f"its equations are more than {MOST} operations")

    def conditions(self) -> list[tuple[Form, Form]]:
        """That no row is nearly a combination of others."""
        return [(pivot, alone.times(SMALLEST_PIVOT)) for pivot, alone in self.factors.pivots]

    def _made(self, kind: str, shape: tuple[int, ...], *state: Sequence[Form]) -> Any:
        made = on_symbols(self.system, self.graph, kind, shape, self.t, *state)
        for place in np.ndindex(shape):
            made[place] = made[place].value()
        return made

    def _matrix(self) -> dict[tuple[int, int], Form]:
        n, m = self.system.n_q, self.system.n_c
        matrix = {(i, j): self.mass[i, j] for i in range(n) for j in range(n) if not _is_zero(self.mass[i, j])}
        for k in self.added:
            places = [i for i in range(n) if not _is_zero(self.rows[k, i])]
            for i in places:
                for j in places:
                    term = (self.rows[k, i] * self.rows[k, j]).times(self.scale)
                    matrix[i, j] = matrix[i, j] + term if (i, j) in matrix else term
        for k in range(m):
            for i in range(n):
                if not _is_zero(self.rows[k, i]):
                    matrix[n + k, i] = matrix[i, n + k] = self.rows[k, i]
        return matrix

    def _accelerations(self, v: Sequence[Form]) -> list[Form]:
        """a and lam at velocities v."""
        n, m = self.system.n_q, self.system.n_c
        force = self._made("force", (n,), self.q, v)
        if self.system.functions.flags[GAMMA_GIVEN]:
            gamma = self._made("gamma", (m,), self.q, v)
        else:
            gamma = self._gamma(v)
        right = list(force)
        for k in self.added:
            for i in range(n):
                right[i] = right[i] + (self.rows[k, i] * gamma[k]).times(self.scale)
        return self.factors.solve([*right, *gamma])

    def _gamma(self, v: Sequence[Form]) -> list[Form]:
        """-(dG/dt v + dG_t/dt) along the motion, by the rules of differentiation."""
        derivative = Derivative(self.graph, {_only(self.t): 1.0, **{_only(q): u for q, u in zip(self.q, v, strict=True)}})
        gamma = []
        for row, rate in zip(self.rows, self.rates, strict=True):
            total = derivative.of(rate)
            for entry, u in zip(row, v, strict=True):
                total = total + derivative.of(entry) * u
            gamma.append((-total).value())
        return gamma

    def _nearer(self) -> Outputs:
        n, m = self.system.n_q, self.system.n_c
        nothing = Form(self.graph, 0.0, {})
        off = self._made("constraint", (m,), self.q)
        moved = self.factors.solve([*([nothing] * n), *(-each for each in off)])[:n]
        faster = []
        for row, rate in zip(self.rows, self.rates, strict=True):
            total = rate
            for entry, u in zip(row, self.v, strict=True):
                total = total + entry * u
            faster.append(-total)
        change = self.factors.solve([*([nothing] * n), *faster])[:n]
        v = [(one + other).value() for one, other in zip(self.v, change, strict=True)]
        solution = self._accelerations(v)
        q = [one + other for one, other in zip(self.q, moved, strict=True)]
        arrays = {"q": q, "v": v, "a": solution[:n], "lam": solution[n:], "moved": moved}
        return Outputs(arrays, self.conditions())


def _is_zero(form: Form) -> bool:
    return not form.terms and form.constant == 0.0


def _only(form: Form) -> int:
    (quantity,) = form.terms
    return quantity


def rows_for_mass(mass: Array, rows: Array, name: str) -> tuple[tuple[int, ...], float]:
    """Rows of G that make M definite when added, and by what factor: a power of two that brings them to its size.

    Raises
    ------
    Untraceable
        If there are none, or rows depend on one another.
    """
    if rows.size and np.linalg.svd(rows, compute_uv=False)[-1] < RANK * np.abs(rows).max():
        raise Untraceable(f"the constraints of {name!r} depend on one another")
    chosen: list[int] = []
    scale = 1.0
    if rows.size:
        scale = float(2.0 ** np.round(np.log2(np.abs(mass).max() / np.abs(rows).max() ** 2)))
    sizes = np.count_nonzero(rows, axis=1)
    while True:
        values, vectors = np.linalg.eigh(mass)
        if values[0] > SINGULAR_MASS * values[-1]:
            return tuple(chosen), scale
        weak = vectors[:, values < SINGULAR_MASS * values[-1]]
        helps = np.linalg.norm(rows @ weak, axis=1) > SINGULAR_MASS ** 0.5 * np.abs(rows).max(axis=1, initial=0.0)
        free = [k for k in np.argsort(sizes, kind="stable").tolist() if helps[k] and k not in chosen]
        if not free:
            raise Untraceable(f"the mass matrix of {name!r} stays singular with constraints added")
        chosen.append(free[0])
        mass = mass + scale * np.outer(rows[free[0]], rows[free[0]])


class Derivative:
    """Derivatives of quantities along a direction in which the inputs change, by the rules of differentiation."""

    def __init__(self, graph: Graph, direction: dict[int, Any]):
        self.graph = graph
        self._known: dict[int, Any] = dict(direction)

    def of(self, form: Form) -> Form:
        """The derivative of a form."""
        total = Form(self.graph, 0.0, {})
        for i, c in form.terms.items():
            total = total + self._of_quantity(i) * c
        return total

    def _of_quantity(self, i: int) -> Any:
        if i not in self._known:
            operation = self.graph.operations[i]
            self._known[i] = 0.0 if operation is None else self._of_operation(i, *operation).value()
        return self._known[i]

    def _of_operation(self, i: int, kind: int, first: Form, second: Form | None) -> Form:
        result, change = Form(self.graph, 0.0, {i: 1.0}), self.of(first)
        if kind == PRODUCT:
            assert second is not None
            return change * second + first * self.of(second)
        if kind == SUM:
            return change
        if kind == RECIPROCAL:
            return -(change * result * result)
        if kind == SQUARE_ROOT:
            return change * result.reciprocal() * 0.5
        if kind == EXPONENTIAL:
            return change * result
        if kind == SINE:
            return change * first.cosine()
        if kind == COSINE:
            return -(change * first.sine())
        assert kind in (LOGARITHM, ARCTANGENT) and second is not None
        return change * second.reciprocal()

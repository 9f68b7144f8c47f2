"""Eliminate the equations of one mechanism symbolically.

The matrix of

    [M  G^T] [a  ]   [Q    ]
    [G  0  ] [lam] = [Gamma]

with G = [C_q; A] is eliminated without what is zero by its structure, in an order that is chosen once: a row of G after
all its coordinates, so that the pivots are those of definite matrices, M and -G M^-1 G^T, and need no search.

- A row is nearly a combination of others where its pivot is small against the one that it has without them. There the
  code is not to be used.
- The same factors give the nearest position and velocity on the constraints, in the metric of M.
- Where M is singular, rows g of G are added, M + g^T g, which changes neither.
- Of redundant rows, a set of full rank is kept.
"""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from twoloop.generate.choices import Choice
from twoloop.generate.graph import Affine, Graph, Untraceable, is_zero
from twoloop.generate.null_space import DependentCoordinates, NotReduced, reduced_accelerations
from twoloop.generate.parameter_expressions import elementwise
from twoloop.generate.symbolic_factors import Block, Factors, solve
from twoloop.generate.trace import Equations, only
from twoloop.generate.traced_values import Traced
from twoloop.kernels.evaluation.operations import PRODUCT, RECIPROCAL
from twoloop.kernels.evaluation.partition import CONTRADICTS
from twoloop.problem.system import ConstrainedSystem

MOST_ELIMINATED = 60_000  # operations with their elimination: those of more than 40 bodies on hinges in space
# cost of `quick` over that of `there`, from which on it does not pay: where pivots are small both are needed, code of
# both takes longer to build, and with 0.68 (four-bar) a run gains 5 %
WORTH = 0.75
COSTS = {PRODUCT: 1, RECIPROCAL: 4}  # in multiplications; sums are counted by their terms, and functions are the same


@dataclass(frozen=True)
class Outputs:
    """What code is to compute from t, q and v: arrays, and conditions that are to hold.

    Attributes
    ----------
    arrays : dict
        Forms, for each array by its name.
    conditions : list of (Affine, Affine)
        The first is to be larger than the second.
    """

    arrays: dict[str, list[Affine]]
    conditions: list[tuple[Affine, Affine]]

    def quantities(self, graph: Graph, known: Container[int] = ()) -> list[int]:
        """What all of this is made of, inputs and what is known apart, in an order in which it can be computed."""
        return graph.needed_by(self.forms, known)

    def cost(self, graph: Graph) -> int:
        """About how long all of this takes to compute, functions apart, in multiplications and additions."""
        forms, total = self.forms, 0
        for i in self.quantities(graph):
            kind, *arguments = graph.operations[i]  # type: ignore[misc]
            total += COSTS.get(kind, 0)
            forms += [form for form in arguments if isinstance(form, Affine)]
        return total + sum(max(len(form.terms) - 1, 0) for form in forms)

    @property
    def sizes(self) -> tuple[dict[str, int], int]:
        """Of the arrays, and how many conditions there are."""
        return {name: len(forms) for name, forms in self.arrays.items()}, len(self.conditions)

    @property
    def forms(self) -> list[Affine]:
        """All of them."""
        forms = [form for array in self.arrays.values() for form in array]
        return [*forms, *(form for condition in self.conditions for form in condition)]


class Elimination:
    """The equations of a system, with rows G = [C_q; A].

    Parameters
    ----------
    system : ConstrainedSystem
    choice : Choice
        What numbers decide.
    equations : Equations, optional
        Of the system, which are continued.

    Attributes
    ----------
    graph : Graph
        Its first quantities are t, q and v.
    there : Outputs
        "a" (n_q,), the accelerations at (q, v) as they stand.
    quick : Outputs or None
        The same by dependent coordinates, where that takes fewer operations. `there` holds in more positions.
    right : Outputs
        "r" (n_q,) and "c" (n_c + n_a,), Q and the right-hand sides of the rows of G that are used; without conditions.
    closer : Outputs
        "q" (n_q,), moved by a step of Newton's method towards the constraints, in directions that A allows, and "moved"
        (n_q,), by how much.
    nearer : Outputs
        The same, "v" (n_q,) on the rows at the position before the move, and "a" (n_q,), "lam" (n_c + n_a,) for these.
    off, faster : Outputs
        "c" (n_c + n_a,) of the moves to positions and to velocities on the rows.
    redundant : Outputs
        No arrays; its conditions are that the rows of C_q that do not count hold, too.
    parts : SplitFunctions or None
        Writes the elimination of M in parts, where equations are long: see compile_equations.py, which sets it.
    n_operations : int
        Of callbacks and elimination, without solutions.
    traced : Traced
        What the callbacks gave.

    Raises
    ------
    Untraceable
        Saying why the equations cannot be had.
    """

    parts: Any = None

    def __init__(self, system: ConstrainedSystem, choice: Choice, equations: Equations | None = None):
        self.equations = Equations(system) if equations is None else equations
        self.system, self.choice, self.graph = system, choice, self.equations.graph
        self.nothing, self._beside = Affine(self.graph, 0.0, {}), 0  # operations of `quick`
        n, (self.q, self.v) = system.n_q, (self.equations.q, self.equations.v)
        self.mass = self._made("mass")
        rows = [self._made("jacobian"), self._made("nonholonomic")]
        rates = [self._made("constraint_rate"), self._made("nonholonomic_rate")]
        self.all_rows, counting = np.vstack(rows), list(choice.rows)
        self.rows, self.rates = self.all_rows[counting], np.concatenate(rates)[counting]
        self.factors = Factors(self._matrix(), n + len(self.rows), n)
        self.conditions = [(pivot, alone.times(choice.least)) for pivot, alone in self.factors.conditions]
        self.conditions += [(pivot, self.nothing) for pivot in self.factors.positive if pivot.terms]
        self.redundant = self._redundant(np.concatenate(rates))
        self._bound()
        for kind in ("gamma", "nonholonomic_gamma", "force"):
            self.equations.of(kind)
        self.n_operations = len(self.graph.operations)
        self.traced = Traced(system, self.graph)

    def _bound(self) -> None:
        if len(self.graph.operations) - self._beside > MOST_ELIMINATED:
            raise Untraceable(f"its equations are more than {MOST_ELIMINATED} operations")

    def _made(self, kind: str, v: Sequence[Affine] | None = None) -> Any:
        return elementwise(Affine.value, [self.equations.of(kind, v)])

    def _redundant(self, rates: Any) -> Outputs:
        left = [k for k in range(self.system.n_c) if k not in self.choice.rows]
        off = self._made("constraint")
        one, conditions = Affine(self.graph, 1.0, {}), []
        size, speed = (sum((x * x for x in state), one) for state in (self.q, self.v))
        for k in left:
            row, rate = self.all_rows[k], rates[k]
            faster = sum((entry * u for entry, u in zip(row, self.v, strict=True)), rate)
            allowed = sum((entry * entry for entry in row), self.nothing).times(CONTRADICTS**2)
            for what, scale in ((off[k], size), (faster, speed)):
                conditions.append((allowed * scale, what * what))
        return Outputs({"": []}, conditions)

    def _matrix(self) -> dict[tuple[int, int], Affine]:
        n = self.system.n_q
        matrix = {(i, j): self.mass[i, j] for i in range(n) for j in range(n) if not is_zero(self.mass[i, j])}
        for i, j in matrix:
            if (j, i) not in matrix:
                name = self.system.name
                raise Untraceable(
                    f"mass of {name!r} is not symmetric: its entry {(j, i)} is zero, and its entry {(i, j)} is not"
                )
        for k in self.choice.added:
            places = [i for i in range(n) if not is_zero(self.all_rows[k, i])]
            for i in places:
                for j in places:
                    term = (self.all_rows[k, i] * self.all_rows[k, j]).times(self.choice.scale)
                    matrix[i, j] = matrix[i, j] + term if (i, j) in matrix else term
        for k, row in enumerate(self.rows):
            for i in range(n):
                if not is_zero(row[i]):
                    matrix[n + k, i] = matrix[i, n + k] = row[i]
        return matrix

    def _given(self, v: Sequence[Affine]) -> tuple[list[Affine], list[Affine]]:
        """Q, and the right-hand sides of all rows of G, at velocities v."""
        return list(self._made("force", v)), [*self._made("gamma", v), *self._made("nonholonomic_gamma", v)]

    @cached_property
    def there(self) -> Outputs:
        """See the class."""
        solution = self._accelerations(self.v)
        self._bound()
        return Outputs({"a": solution[: self.system.n_q]}, self.conditions)

    @cached_property
    def quick(self) -> Outputs | None:
        """See the class."""
        blocks = self.choice.blocks
        if not blocks:
            return None
        most, before = int(WORTH * self.there.cost(self.graph)), len(self.graph.operations)
        force, gamma = self._given(self.v)
        try:
            of = DependentCoordinates(self.rows.tolist(), [gamma[k] for k in self.choice.rows], blocks, most)
            a, conditions = reduced_accelerations(self.mass, force, of)
            quick = Outputs({"a": a}, [*of.conditions, *conditions])
        except NotReduced:
            quick = None
        self._beside += len(self.graph.operations) - before
        return quick if quick is not None and quick.cost(self.graph) < most else None

    @property
    def accelerations(self) -> list[Outputs]:
        """What code for accelerations is made of, see `compile_equations.write_accelerations`."""
        return [self.there] if self.quick is None else [self.quick, self.there]

    @cached_property
    def right(self) -> Outputs:
        """See the class."""
        force, gamma = self._given(self.v)
        used = {*self.choice.rows, *self.choice.added}
        return Outputs({"r": force, "c": [each if k in used else self.nothing for k, each in enumerate(gamma)]}, [])

    def _accelerations(self, v: Sequence[Affine]) -> list[Affine]:
        """a and the multipliers of the rows that count, at velocities v."""
        right, gamma = self._given(v)
        for k in self.choice.added:
            for i, entry in enumerate(self.all_rows[k]):
                right[i] = right[i] + (entry * gamma[k]).times(self.choice.scale)
        return self.factors.solve([*right, *(gamma[k] for k in self.choice.rows)])

    def _spread(self, counting: Sequence[Affine]) -> list[Affine]:
        """Numbers for all rows from those for the rows that count, the others 0."""
        numbers = [self.nothing] * len(self.all_rows)
        for k, number in zip(self.choice.rows, counting, strict=True):
            numbers[k] = number
        return numbers

    @cached_property
    def off(self) -> Outputs:
        """See the class."""
        off = [*(-each for each in self._made("constraint")), *[self.nothing] * self.system.n_a]
        return Outputs({"c": self._spread([off[k] for k in self.choice.rows])}, [])

    @cached_property
    def faster(self) -> Outputs:
        """See the class."""
        faster = []
        for row, rate in zip(self.rows, self.rates, strict=True):
            total = rate
            for entry, u in zip(row, self.v, strict=True):
                total = total + entry * u
            faster.append(-total)
        return Outputs({"c": self._spread(faster)}, [])

    @cached_property
    def closer(self) -> Outputs:
        """See the class."""
        moved = self._correction(self.off)
        position = {"moved": moved, "q": [one + other for one, other in zip(self.q, moved, strict=True)]}
        return Outputs(position, self.conditions)

    @cached_property
    def nearer(self) -> Outputs:
        """See the class."""
        arrays = self.nearest.arrays
        known = [arrays["lam"][k] for k in self.choice.rows]
        lam = of_least_norm(self.graph, known, self.all_rows, self.choice.rows, self.factors.solve)
        self._bound()
        return Outputs({**arrays, "lam": lam}, self.conditions)

    @cached_property
    def nearest(self) -> Outputs:
        """The same, "lam" 0 for rows that do not count."""
        n, position = self.system.n_q, self.closer.arrays
        v = [(one + other).value() for one, other in zip(self.v, self._correction(self.faster), strict=True)]
        solution = self._accelerations(v)
        self._bound()
        return Outputs({"a": solution[:n], **position, "v": v, "lam": self._spread(solution[n:])}, self.conditions)

    def _correction(self, c: Outputs) -> list[Affine]:
        n = self.system.n_q
        return self.factors.solve([*([self.nothing] * n), *(c.arrays["c"][k] for k in self.choice.rows)])[:n]


def of_least_norm(
    graph: Graph,
    known: Sequence[Affine],
    all_rows: Any,
    rows: Sequence[int],
    solve: Callable[[Sequence[Affine]], list[Affine]],
) -> list[Affine]:
    """Multipliers of all rows from those of the rows that count.

    A row that does not is a combination of these, by the numbers Z; less its part in the null space of G^T, spanned
    by e_i - sum_k Z_ik e_k, lam has least norm.
    """
    nothing = Affine(graph, 0.0, {})
    lam = [nothing] * len(all_rows)
    for k, value in zip(rows, known, strict=True):
        lam[k] = value
    others = [k for k in range(len(lam)) if k not in rows]
    Z = [solve([*all_rows[k], *([nothing] * len(rows))])[len(all_rows[k]) :] for k in others]
    gram = {
        (i, j): sum((x * y for x, y in zip(one, other, strict=True)), Affine(graph, float(i == j), {}))
        for i, one in enumerate(Z)
        for j, other in enumerate(Z)
    }
    parts = [sum((-(x * y) for x, y in zip(one, known, strict=True)), nothing) for one in Z]
    for row, one, part in zip(others, Z, Factors(gram, len(Z), len(Z)).solve(parts), strict=True):
        lam[row] = lam[row] - part
        for k, x in zip(rows, one, strict=True):
            lam[k] = lam[k] + part * x
    return lam


class Solution:
    """M a + G^T lam = r with G a = c, by the factors of a position that are kept.

    Parameters
    ----------
    equations : Elimination
    more : sequence of Outputs
        Of the equations: what these share with the factors is kept, too.

    Attributes
    ----------
    known : dict
        Quantities of the equations, and at which place each is kept.
    kept : Outputs
        Of the equations: what is to be kept.
    graph : Graph
        Its inputs are r (n_q,), c (n_c + n_a,) and the factors, which are kept first.
    solved : Outputs
        "a" (n_q,) and "lam" (n_c + n_a,); 0 for rows that do not count.
    least : Outputs
        "lam" (n_c,) of least norm, where c is "lam" of `solved`.
    """

    def __init__(self, equations: Elimination, more: Sequence[Outputs] = ()):
        factors, self._choice, self._n = equations.factors, equations.choice, equations.system.n_q
        n_rows, rows = len(equations.all_rows), self._choice.rows
        others = [k for k in range(n_rows) if k not in rows] if more else []
        forms = [form for k in (*self._choice.added, *others) for form in equations.all_rows[k]]
        forms += [form for block in factors.blocks for row in block.inverse for form in row]
        forms += [form for block in factors.blocks for _, row in block.below for form in row]
        factors_kept = sorted({i for form in forms for i in form.terms})
        shared = _shared(equations.graph, factors_kept, more)
        self.known = {i: k for k, i in enumerate([*factors_kept, *shared])}
        kept = [equations.graph.quantity(i) for i in self.known]
        self.kept = Outputs({"kept": kept}, equations.conditions)
        self.graph = Graph()
        self._r, self._c = self.graph.inputs(self._n, False), self.graph.inputs(n_rows, False)
        places = [only(form) for form in self.graph.inputs(len(factors_kept), False)]

        def here(form: Affine) -> Affine:
            return Affine(self.graph, form.constant, {places[self.known[i]]: x for i, x in form.terms.items()})

        self._blocks = [
            Block(
                block.places,
                [[here(x) for x in row] for row in block.inverse],
                [(j, [here(x) for x in row]) for j, row in block.below],
            )
            for block in factors.blocks
        ]
        self._rows = {k: [here(x) for x in equations.all_rows[k]] for k in (*self._choice.added, *others)}
        self._nothing = Affine(self.graph, 0.0, {})
        self.solved = self._solved()

    @property
    def n_kept(self) -> int:
        """How many numbers are kept."""
        return len(self.known)

    def _solve(self, right: Sequence[Affine]) -> list[Affine]:
        return solve(self._blocks, right)

    def _counting(self) -> list[Affine]:
        return [self._c[k] for k in self._choice.rows]

    def _solved(self) -> Outputs:
        r, lam = self._r, [self._nothing] * len(self._c)
        for k in self._choice.added:
            r = [one + (x * self._c[k]).times(self._choice.scale) for one, x in zip(r, self._rows[k], strict=True)]
        solution = self._solve([*r, *self._counting()])
        for k, value in zip(self._choice.rows, solution[self._n :], strict=True):
            lam[k] = value
        return Outputs({"a": solution[: self._n], "lam": lam}, [])

    @cached_property
    def least(self) -> Outputs:
        """See the class."""
        rows = [self._rows.get(k, []) for k in range(len(self._c))]
        return Outputs({"lam": of_least_norm(self.graph, self._counting(), rows, self._choice.rows, self._solve)}, [])


def _shared(graph: Graph, kept: Sequence[int], more: Sequence[Outputs]) -> list[int]:
    """What more outputs take of the quantities that what is kept is made of."""
    made = set(graph.needed_by(map(graph.quantity, kept)))
    found = {i for outputs in more for form in outputs.forms for i in form.terms}
    for outputs in more:
        for j in outputs.quantities(graph, made):
            operation = graph.operations[j]
            assert operation is not None
            found |= {i for form in operation[1:] if isinstance(form, Affine) for i in form.terms}
    return sorted(found & made - set(kept))

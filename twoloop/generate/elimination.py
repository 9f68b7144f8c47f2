"""Eliminate the equations of one mechanism symbolically; the values of M and G at one position decide the order.

The matrix of

    [M  G^T] [a  ]   [Q    ]
    [G  0  ] [lam] = [gamma]

with G = [C_q; A] (A: non-holonomic rows) is eliminated in an order that is chosen once; entries that are always zero
are skipped. A row of G comes after the coordinates in which it has entries. So the pivots are those of the definite
matrices M and -G M^-1 G^T: none is zero.

- If a row of G has a much smaller pivot than it would have without the other rows, this row nearly depends on the other
  rows, and the generated code reports that its results are invalid.
- The factors of the matrix also yield the nearest position and velocity on the constraints, in the metric of M.
- If M is singular, terms s g^T g are added to it: g are rows of G, and s is the scale of a row. In short, "rows are
  added to M". This changes neither accelerations nor projections.
- If rows of G are redundant, the equations contain independent rows only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import mass_and_rows
from twoloop.generate.graph import Affine, Graph, Untraceable, is_zero
from twoloop.generate.null_space import (
    Block,
    DependentCoordinates,
    Factors,
    ReductionFailed,
    solve,
    solve_reduced_system,
    solve_refined,
)
from twoloop.generate.parameter_expressions import elementwise
from twoloop.generate.program import Program
from twoloop.generate.trace import Equations, only_quantity, shared_cache
from twoloop.generate.traced_values import CallbackTraces
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.evaluation.partition import MAX_VIOLATION
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

SINGULAR_MASS = 1e-10  # M is singular if its smallest eigenvalue is below this fraction of its largest eigenvalue
RANK_TOL = 1e-9  # a row g of G depends on others if the norm of its part orthogonal to them is below this * norm of g
# the relative pivot of a row of G is its pivot / the pivot that it would have if G had no other rows. Results are
# invalid if a relative pivot is below a limit: about this fraction of the smallest relative pivot at a run's start
PIVOT_FRACTION = 0.01
MIN_PIVOTS = 10.0 ** np.arange(-2, -9, -1)  # possible PivotChoice.min_pivot; below 1e-8, rounding errors dominate
# let p be the smallest relative pivot (see PIVOT_FRACTION) at a run's start. PivotChoice.min_pivot is MIN_PIVOTS[i]
# for the first i with START_LIMITS[i] <= p, or MIN_PIVOTS[-1] if there is no such i
START_LIMITS = MIN_PIVOTS[:-1] / PIVOT_FRACTION
# M + s G^T G (s: scales of rows) is tried in place of M if PivotChoice.min_pivot with M is at most MIN_PIVOTS[m].
# With at most N_FEW_COORDINATES coordinates, m is MIN_INDEX_FEW or, if M is singular (Euler parameters),
# MIN_INDEX_FEW_SINGULAR, because pivots are then smaller even in sound models. With more coordinates, M + s G^T G makes
# the code much longer: m is MIN_INDEX_MANY, and if M is singular, M + s G^T G is not tried
N_FEW_COORDINATES = 24
MIN_INDEX_FEW, MIN_INDEX_FEW_SINGULAR, MIN_INDEX_MANY = 4, 5, 6
ADDED_SIZE = 16.0  # scales s are chosen so that the largest entry of s G^T G is about this * the largest entry of M
MAX_PIVOT_RATIO = 1e5  # solutions are refined if a diagonal entry of M + s G^T G is above this * the pivot of its row
SCALE_STEP = 1024.0  # in M + s G^T G, ratios of scales s are powers of this: it is large, so that most runs share code
DISPLACEMENT = 0.2  # displacement of coordinates (m or rad) to a position where no entry of M and G is zero by chance
MIN_GAIN = 2  # M + s G^T G replaces M if PivotChoice.min_pivot rises by at least this many powers of ten
# dependent coordinates are eliminated (null_space.py) only if there are at least this many constraints per coordinate:
# with fewer, the linear system for the multipliers is smaller than the one for the independent accelerations
MIN_ROW_RATIO = 2.0 / 3.0

PivotBlocks = tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]


@dataclass(frozen=True)
class PivotChoice:
    """Rows and pivots of the elimination, chosen by the values of M and G at one position.

    rows : indices of the independent rows of G; the other rows are redundant.
    added_rows, scales : if M is singular or has little inertia about joints, M + sum_k scales[k] g^T g replaces M; g is
        row added_rows[k] of G. The sum is definite. Scales are powers of two; added terms are about as large as M.
    min_pivot : a power of ten. Results are valid if the pivot of each row of G, divided by the pivot that it would have
        without the other rows, is at least min_pivot.
    blocks : pivot blocks in the order of elimination. A block consists of one or two rows (indices in `rows`), and as
        many dependent coordinates, for which these rows are solved. Empty: no dependent coordinates are eliminated.
    is_refined : whether solutions are improved by one step of refinement, because small pivots may cost digits.
    """

    rows: tuple[int, ...]
    added_rows: tuple[int, ...]
    scales: tuple[float, ...]
    min_pivot: float
    blocks: PivotBlocks = ()
    is_refined: bool = False

    @classmethod
    def choose(cls, system: ConstrainedSystem, t: float, q: Array) -> "PivotChoice":
        """Return the PivotChoice for the values of M and G at time t and position q.

        Raise Untraceable if M is singular on velocities that the constraints allow.
        """
        mass, G = mass_and_rows(system, t, q)
        choice = PivotChooser(system).choose(mass, G, partial(_nearby, system, t, q))
        # refine solutions only if min_pivot is the smallest possible one, or if added terms s g^T g may cost digits.
        # In all other cases, random models had 8 correct digits without refinement
        is_uncertain = choice.min_pivot <= MIN_PIVOTS[-1] or _may_lose_digits(choice, mass, G)
        choice = replace(choice, is_refined=choice.is_refined or (bool(choice.rows) and is_uncertain))
        return replace(choice, blocks=DependentColumns(system, choice.rows).blocks(G))


class DependentColumns:
    """Chooser of the dependent coordinates, which the independent rows of G determine from the other coordinates.

    rows : indices of the independent rows of G.
    choose (field) : compiled function choose(G, *arguments), which stores pivot blocks and returns their number. It
        is None if `rows` are fewer than MIN_ROW_RATIO * n_q, or if it is unknown which entries of G are constant.
    """

    choose: Any = None

    def __init__(self, system: ConstrainedSystem, rows: tuple[int, ...]):
        kinds = _entry_kinds(system) if len(rows) >= MIN_ROW_RATIO * system.n_q > 0 else None
        if kinds is not None:
            from twoloop.kernels.linalg.dependent_columns import choose_dependent_columns, scratch_sizes

            numbers, integers = scratch_sizes(len(rows), system.n_q)
            blocks, scratch, work = np.zeros(4 * len(rows), np.int64), np.zeros(numbers), np.zeros(integers, np.int64)
            self.choose, self._blocks = entry_point(choose_dependent_columns), blocks
            self.arguments = kinds, np.array(rows, np.int64), len(rows), scratch, work, blocks

    def blocks(self, G: Array) -> PivotBlocks:
        """Return the pivot blocks (`PivotChoice.blocks`) for the values of G (n_c + n_a, n_q) at a position."""
        if self.choose is None:
            return ()
        n = self.choose(G, *self.arguments)
        pivots = self._blocks[: 4 * n].reshape(n, 4).tolist()
        return tuple(((i,), (j,)) if i == k else ((i, k), (j, l)) for i, k, j, l in pivots)


def _entry_kinds(system: ConstrainedSystem) -> Any:
    """Return the kinds of the entries of G (0: always zero, 1: constant, 2: varies), or None if they are unknown."""
    if system.called_in_python:  # Python functions may store their arguments: do not call them with symbols
        return None

    def find_kinds(equations: Callable[[], Equations]) -> Any:
        try:
            entries = [*equations().expressions("jacobian").flat, *equations().expressions("nonholonomic").flat]
        except (Untraceable, ArithmeticError, RecursionError):
            return None
        return np.array([2 if expr.terms else int(expr.constant != 0.0) for expr in entries], dtype=np.int64)

    cache = shared_cache(system)
    kinds = cache.remembered("kinds of entries", partial(find_kinds, partial(cache.equations, system)))
    if kinds is None:  # perhaps a callback branches on parameters: trace it with the parameter values of this system
        kinds = system.remembered("kinds of entries", partial(find_kinds, partial(Equations, system)))
    return kinds


class PivotChooser:
    """Compiled search for the rows and pivots of the elimination, given the values of M and G at a position."""

    def __init__(self, system: ConstrainedSystem):
        from twoloop.kernels.linalg.rank import choose_rows, workspace_size

        n_rows = system.n_c + system.n_a
        self.system, self._kernel = system, entry_point(choose_rows)
        self._scratch, self._row_indices = (
            np.zeros(workspace_size(n_rows, system.n_q)),
            np.zeros(2 + 3 * n_rows, np.int64),
        )
        self._last_key, self._last_choice = (0, b"", 0.0), PivotChoice((), (), (), 0.0)

    def choose(self, mass: Array, G: Array, nearby: Callable[[], tuple[Array, Array]]) -> PivotChoice:
        """Return the PivotChoice for the values of M and G at a position; its field `blocks` remains empty.

        `nearby` returns M and G at another position, where no entry is zero by chance. Raise Untraceable if M is
        singular on velocities that the constraints allow.
        """
        system, scratch, chosen = self.system, self._scratch, self._row_indices
        is_definite = system.constant_mass and system.derived.get("no weak mass", False)
        scratch[0] = 0.0
        index = self._kernel(mass, G, RANK_TOL, 0.0 if is_definite else SINGULAR_MASS, START_LIMITS, scratch, chosen)
        key = index, chosen.tobytes(), float(scratch[0])
        if key != self._last_key:
            self._last_choice, self._last_key = self._stored_choice(index), key
        choice, is_singular = self._last_choice, bool(self._last_choice.added_rows)
        factors = _scale_factors(choice.added_rows, *nearby()) if is_singular else np.ones(len(G))
        scales = tuple((choice.scales[0] * factors[list(choice.added_rows)]).tolist()) if is_singular else ()
        new_index = self._min_pivot_index(choice, scales, mass, G) if scales != choice.scales else -1
        if new_index >= 0:
            choice, index = replace(choice, scales=scales, min_pivot=float(MIN_PIVOTS[new_index])), new_index
        if index >= (
            (MIN_INDEX_FEW_SINGULAR if is_singular else MIN_INDEX_FEW)
            if len(mass) <= N_FEW_COORDINATES
            else MIN_INDEX_MANY + is_singular
        ):
            return self._try_added_rows(choice, factors, mass, G, index)
        return choice

    def _min_pivot_index(self, choice: PivotChoice, scales: Sequence[float], mass: Array, G: Array) -> int:
        """Return the index in MIN_PIVOTS of min_pivot if M + s g^T g (s: `scales`; g: `choice.added_rows`) replaces M.

        Return -1 if M + s g^T g is not positive definite, or if the independent rows differ from `choice.rows`.
        """
        scratch, chosen = np.zeros_like(self._scratch), np.zeros_like(self._row_indices)
        added = G[list(choice.added_rows)]
        stiffened = mass + added.T @ (np.array(scales)[:, None] * added)
        index = int(self._kernel(stiffened, G, RANK_TOL, 0.0, START_LIMITS, scratch, chosen))
        return index if index >= 0 and chosen[2 : 2 + chosen[0]].tolist() == list(choice.rows) else -1

    def _try_added_rows(self, choice: PivotChoice, factors: Array, mass: Array, G: Array, index: int) -> PivotChoice:
        """Return a choice with M + s G^T G (s: scales of rows) instead of M if pivots get much larger; else `choice`.

        A body may have little inertia about its joints, such as a rod with a mass in its middle. Then rows of G are
        nearly dependent in the metric of M, and a smallest pivot of 10^-k costs up to 2 k digits of accelerations. In
        the metric of M + s G^T G, the rows are independent. If s G^T G is 10^k times as large as M, k digits are lost,
        and refinement restores them. `factors` multiply the scales s; choice.min_pivot is MIN_PIVOTS[index].
        """
        rows = G[list(choice.rows)]
        scale = 2.0 ** np.round(np.log2(ADDED_SIZE * np.abs(mass).max() / np.abs(rows).max() ** 2))
        scales = tuple((scale * factors[list(choice.rows)]).tolist())
        stiffened = replace(choice, added_rows=choice.rows, scales=scales, is_refined=True)
        new_index = self._min_pivot_index(stiffened, scales, mass, G)
        if not 0 <= new_index <= index - MIN_GAIN:
            return choice
        return replace(stiffened, min_pivot=float(MIN_PIVOTS[new_index]))

    def _stored_choice(self, index: int) -> PivotChoice:
        """Return the PivotChoice from the compiled search; raise Untraceable if the search failed (`index` < 0)."""
        from twoloop.kernels.linalg.rank import STAYS_SINGULAR

        system, n_rows = self.system, self.system.n_c + self.system.n_a
        n_independent, n_added, *indices = self._row_indices.tolist()
        if n_independent == 0:
            return PivotChoice((), (), (), 0.0)
        if index < 0:
            defect = f"is nearly singular{' even with constraints added' * (index == STAYS_SINGULAR)}"
            raise Untraceable(f"the mass of {system.name!r} {defect}")
        if n_added == 0:
            system.derived["no weak mass"] = True
        added = tuple(indices[n_rows : n_rows + n_added])
        scales = (float(self._scratch[0]),) * n_added
        return PivotChoice(tuple(indices[:n_independent]), added, scales, float(MIN_PIVOTS[index]))


def _nearby(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array]:
    """Return M and G at a position displaced from q, or at q if callbacks are undefined at the displaced one."""
    try:
        return mass_and_rows(system, t, q + DISPLACEMENT * np.cos(np.arange(len(q))))
    except Exception:
        return mass_and_rows(system, t, q)


def _scale_factors(singular: Sequence[int], mass: Array, G: Array) -> Array:
    """Return for each row g of G a factor, by which the scale s is multiplied if s g^T g is added to M.

    Without the factor, s g^T g would be as large as the inertia of heavy bodies. If g is the constraint on the norm of
    the Euler parameters of a light body, rounding errors would then hide the inertia of this body. `singular`: rows
    added because M is singular. The factor is a negative power of SCALE_STEP if M is small in all columns in which g
    has nonzero entries, and rows `singular` have nonzero entries in all these columns, too. Otherwise, the factor is 1.
    """
    rows, covered = np.abs(G), np.any(G[list(singular)], axis=0)
    columns = [np.flatnonzero(row) for row in rows]
    own = np.array([np.abs(mass[np.ix_(each, each)]).max(initial=0.0) for each in columns])
    own /= np.maximum(rows.max(axis=1, initial=0.0), np.finfo(float).tiny) ** 2
    ratio = own / (np.abs(mass).max() / rows.max() ** 2)
    smaller = (ratio > 0.0) & ~rows[:, ~covered].any(axis=1)
    # with + 0.25, the factor is 1 if `ratio` (light / heavy inertia) > SCALE_STEP ** -1.25, which costs no digit
    steps = np.ceil(np.log(np.where(smaller, ratio, 1.0)) / np.log(SCALE_STEP) + 0.25)
    return np.asarray(SCALE_STEP ** np.minimum(steps, 0.0))


def _may_lose_digits(choice: PivotChoice, mass: Array, G: Array) -> bool:
    """Return True if M + sum s g^T g (see PivotChoice) may cost digits: its scales s differ, or a pivot is small."""
    if not choice.added_rows:
        return False
    added, scales = G[list(choice.added_rows)], np.array(choice.scales)
    stiffened = mass + added.T @ (scales[:, None] * added)
    ratio = float((stiffened.diagonal() * np.linalg.inv(stiffened).diagonal()).max())
    return len(set(choice.scales)) > 1 or ratio > MAX_PIVOT_RATIO


MAX_OPERATIONS = 60_000  # no code is generated if the elimination takes more operations; 40 bodies in space need fewer
# the elimination of dependent coordinates is compiled only if its cost is below this fraction of the cost of the
# elimination that begins with M, which is always compiled. A fraction of 0.68 (four-bar) saves 5 % of a run's time
MAX_COST_RATIO = 0.75


class Elimination:
    """Symbolic elimination of the equations of a system, with the rows G = [C_q; A] of all constraints.

    choice : rows and pivots, chosen by the values of M and G at one position.
    equations : traced equations of the system, to whose graph the elimination adds its operations.

    Fields:
    graph : graph of the operations; its first inputs are t, q and v.
    redundant_rows : program that only tests, by its conditions, whether a state satisfies the redundant constraints.
    split_functions : generator that splits long equations into several functions; compile_equations.py sets it.
    n_operations : number of operations of callbacks and factorization, but not of the solution with the factors.
    traced : traces of the callbacks.

    Raises Untraceable if no code can be generated for the equations; the message says why.
    """

    split_functions: Any = None

    def __init__(self, system: ConstrainedSystem, choice: PivotChoice, equations: Equations | None = None):
        self.equations = Equations(system) if equations is None else equations
        self.system, self.choice, self.graph = system, choice, self.equations.graph
        self.zero, self._n_reduced = Affine(self.graph, 0.0, {}), 0  # `reduced_program` adds _n_reduced operations
        n, (self.q, self.v) = system.n_q, (self.equations.q, self.equations.v)
        self.mass = self._callback_terms("mass")
        rows = [self._callback_terms("jacobian"), self._callback_terms("nonholonomic")]
        rates = [self._callback_terms("constraint_rate"), self._callback_terms("nonholonomic_rate")]
        self.all_rows, independent = np.vstack(rows), list(choice.rows)
        self.rows, self.rates = self.all_rows[independent], np.concatenate(rates)[independent]
        self.factors = Factors(self._matrix(), n + len(self.rows), n, self._check_length)
        self.conditions = [(pivot, alone.times(choice.min_pivot)) for pivot, alone in self.factors.conditions]
        self.conditions += [(pivot, self.zero) for pivot in self.factors.mass_pivots if pivot.terms]
        self.redundant_rows = self._redundant_rows(np.concatenate(rates))
        self._check_length()
        for kind in ("gamma", "nonholonomic_gamma", "force"):
            self.equations.expressions(kind)
        self.n_operations = len(self.graph.operations)
        self.traced = CallbackTraces(system, self.graph)

    def _check_length(self) -> None:
        if len(self.graph.operations) - self._n_reduced > MAX_OPERATIONS:
            raise Untraceable(f"its equations are more than {MAX_OPERATIONS} operations")

    def _callback_terms(self, kind: str, v: Sequence[Affine] | None = None) -> Any:
        return elementwise(Affine.as_term, [self.equations.expressions(kind, v)])

    def _redundant_rows(self, rates: Any) -> Program:
        """Return a program with conditions that test if a state satisfies redundant rows of C; `rates`: [C_t, b]."""
        redundant = [k for k in range(self.system.n_c) if k not in self.choice.rows]
        violations = self._callback_terms("constraint")
        unit, conditions = Affine(self.graph, 1.0, {}), []
        scale_q, scale_v = (sum((x * x for x in state), unit) for state in (self.q, self.v))
        for k in redundant:
            row, rate = self.all_rows[k], rates[k]
            velocity_residual = sum((entry * u for entry, u in zip(row, self.v, strict=True)), rate)
            allowed = sum((entry * entry for entry in row), self.zero).times(MAX_VIOLATION**2)
            for residual, scale in ((violations[k], scale_q), (velocity_residual, scale_v)):
                conditions.append((allowed * scale, residual * residual))
        return Program(self.graph, {"": []}, conditions)

    def _matrix(self) -> dict[tuple[int, int], Affine]:
        """Return the nonzero entries of [M G^T; G 0]; M includes the terms of added_rows, G only independent rows."""
        n = self.system.n_q
        matrix = {(i, j): self.mass[i, j] for i in range(n) for j in range(n) if not is_zero(self.mass[i, j])}
        for i, j in matrix:
            if (j, i) not in matrix:
                name = self.system.name
                raise Untraceable(
                    f"mass of {name!r} is not symmetric: its entry {(j, i)} is zero, and its entry {(i, j)} is not"
                )
        for k, scale in zip(self.choice.added_rows, self.choice.scales, strict=True):
            columns = [i for i in range(n) if not is_zero(self.all_rows[k, i])]
            for i in columns:
                for j in columns:
                    term = (self.all_rows[k, i] * self.all_rows[k, j]).times(scale)
                    matrix[i, j] = matrix[i, j] + term if (i, j) in matrix else term
        for k, row in enumerate(self.rows):
            for i in range(n):
                if not is_zero(row[i]):
                    matrix[n + k, i] = matrix[i, n + k] = row[i]
        return matrix

    def _solve(self, r: Sequence[Affine], c: Sequence[Affine]) -> tuple[list[Affine], list[tuple[Affine, Affine]]]:
        """Solve M a + G^T lam = r, G a = c; return [a, lam] (lam: of independent rows), and conditions, see Program."""
        return solve_refined(self.factors.solve, self.choice, self.mass, self.all_rows, r, c)

    def _right_sides(self, v: Sequence[Affine]) -> tuple[list[Affine], list[Affine]]:
        """Return the forces Q (n_q,), and the right-hand sides c (n_c + n_a,) of G a = c, at velocities v."""
        return list(self._callback_terms("force", v)), [
            *self._callback_terms("gamma", v),
            *self._callback_terms("nonholonomic_gamma", v),
        ]

    @cached_property
    def mass_first_program(self) -> Program:
        """Return the program for the accelerations "a" (n_q,) by an elimination that begins with M."""
        solution, conditions = self._accelerations(self.v)
        self._check_length()
        return Program(self.graph, {"a": solution[: self.system.n_q]}, [*self.conditions, *conditions])

    @cached_property
    def reduced_program(self) -> Program | None:
        """Return a program that eliminates dependent coordinates; None if `mass_first_program` costs little more."""
        blocks = self.choice.blocks
        if not blocks:
            return None
        max_cost, n_before = int(MAX_COST_RATIO * self.mass_first_program.cost()), len(self.graph.operations)
        force, gamma = self._right_sides(self.v)
        try:
            dependent = DependentCoordinates(self.rows.tolist(), [gamma[k] for k in self.choice.rows], blocks, max_cost)
            a, conditions = solve_reduced_system(self.mass, force, dependent)
            reduced = Program(self.graph, {"a": a}, [*dependent.conditions, *conditions])
        except ReductionFailed:
            reduced = None
        self._n_reduced += len(self.graph.operations) - n_before
        return reduced if reduced is not None and reduced.cost() < max_cost else None

    @property
    def accelerations(self) -> list[Program]:
        """Return the programs for accelerations: `reduced_program` (shorter) if it exists, and `mass_first_program`."""
        return (
            [self.mass_first_program]
            if self.reduced_program is None
            else [self.reduced_program, self.mass_first_program]
        )

    @cached_property
    def right_sides(self) -> Program:
        """Return the program for "r" (forces) and "c" in G a = c; in redundant rows not in choice.added_rows, c = 0."""
        force, gamma = self._right_sides(self.v)
        used = {*self.choice.rows, *self.choice.added_rows}
        return Program(self.graph, {"r": force, "c": [x if k in used else self.zero for k, x in enumerate(gamma)]})

    def _accelerations(self, v: Sequence[Affine]) -> tuple[list[Affine], list[tuple[Affine, Affine]]]:
        """Return [a, lam] at velocities v (lam: only of independent rows), and conditions of validity (see Program)."""
        return self._solve(*self._right_sides(v))

    def _expand_to_all_rows(self, independent: Sequence[Affine]) -> list[Affine]:
        """Return a list with one value for each row of G: the values `independent`, and 0 for redundant rows."""
        values = [self.zero] * len(self.all_rows)
        for k, value in zip(self.choice.rows, independent, strict=True):
            values[k] = value
        return values

    @cached_property
    def position_errors(self) -> Program:
        """Return the program for "c" in C_q (change of q) = c: -C, or 0 in redundant and non-holonomic rows."""
        errors = [*(-violation for violation in self._callback_terms("constraint")), *[self.zero] * self.system.n_a]
        return Program(self.graph, {"c": self._expand_to_all_rows([errors[k] for k in self.choice.rows])})

    @cached_property
    def velocity_errors(self) -> Program:
        """Return the program for "c" in G (change of v) = c: -(C_q v + C_t) and -(A v + b), or 0 in redundant rows."""
        errors = []
        for row, rate in zip(self.rows, self.rates, strict=True):
            total = rate
            for entry, u in zip(row, self.v, strict=True):
                total = total + entry * u
            errors.append(-total)
        return Program(self.graph, {"c": self._expand_to_all_rows(errors)})

    @cached_property
    def position_projection(self) -> Program:
        """Return the program for "q" (n_q,) after one Newton step towards C = 0, and for "moved", the change of q."""
        moved = self._correction(self.position_errors)
        position = {"moved": moved, "q": [x + change for x, change in zip(self.q, moved, strict=True)]}
        return Program(self.graph, position, self.conditions)

    @cached_property
    def projection(self) -> Program:
        """Return the program for the projected state "q", "v", the change "moved" of q, and "a", "lam" at projected v.

        M, G and forces are evaluated at the position before the projection. "lam" (n_c + n_a,) has the least norm.
        """
        arrays = self.basic_projection.arrays
        independent = [arrays["lam"][k] for k in self.choice.rows]
        lam = multipliers_of_least_norm(self.graph, independent, self.all_rows, self.choice.rows, self.factors.solve)
        self._check_length()
        return Program(self.graph, {**arrays, "lam": lam}, self.basic_projection.conditions)

    @cached_property
    def basic_projection(self) -> Program:
        """Return the same program as `projection`, except that "lam" is 0 for redundant rows, not of least norm."""
        n, position = self.system.n_q, self.position_projection.arrays
        v = [(u + change).as_term() for u, change in zip(self.v, self._correction(self.velocity_errors), strict=True)]
        solution, conditions = self._accelerations(v)
        self._check_length()
        return Program(
            self.graph,
            {"a": solution[:n], **position, "v": v, "lam": self._expand_to_all_rows(solution[n:])},
            [*self.conditions, *conditions],
        )

    def _correction(self, c: Program) -> list[Affine]:
        """Return the solution x (n_q) of G x = c of least norm in the metric of M; `c`: program with the array "c"."""
        n = self.system.n_q
        return self.factors.solve([*([self.zero] * n), *(c.arrays["c"][k] for k in self.choice.rows)])[:n]


def multipliers_of_least_norm(
    graph: Graph,
    independent: Sequence[Affine],
    all_rows: Any,
    rows: Sequence[int],
    solve: Callable[[Sequence[Affine]], list[Affine]],
) -> list[Affine]:
    """Return the multipliers lam (one per row) of least norm with the same G^T lam as the `independent` multipliers.

    `all_rows`: G. `rows`, `independent`: indices and multipliers of the independent rows. `solve`: solves with the
    factors of [M G^T; G 0]. A redundant row is g_i = sum_k Z_ik g_k, where g_k are independent rows. So the null space
    of G^T is spanned by e_i - sum_k Z_ik e_k (e_i: unit vectors). The component of lam in this space is subtracted.
    """
    zero = Affine(graph, 0.0, {})
    lam = [zero] * len(all_rows)
    for k, value in zip(rows, independent, strict=True):
        lam[k] = value
    dependent = [k for k in range(len(lam)) if k not in rows]
    Z = [solve([*all_rows[k], *([zero] * len(rows))])[len(all_rows[k]) :] for k in dependent]
    gram = {
        (i, j): sum((x * y for x, y in zip(z, w, strict=True)), Affine(graph, float(i == j), {}))
        for i, z in enumerate(Z)
        for j, w in enumerate(Z)
    }
    components = [sum((-(x * y) for x, y in zip(z, independent, strict=True)), zero) for z in Z]
    for row, z, component in zip(dependent, Z, Factors(gram, len(Z), len(Z)).solve(components), strict=True):
        lam[row] = lam[row] - component
        for k, x in zip(rows, z, strict=True):
            lam[k] = lam[k] + component * x
    return lam


class FactorAndSolvePrograms:
    """Programs that solve M a + G^T lam = r, G a = c in two steps: first the factors, then the solution with them.

    other_programs : programs that run after the first step, at the same state. The first step also stores quantities
        that it has computed and that these programs need.
    Fields:
    stored_indices : quantities that the first step stores. Keys: indices in the graph of `equations`; values: indices
        in the array of stored quantities, which begins with the factors.
    factor_program : program that computes the stored quantities.
    graph : graph of the solution; its inputs are r (n_q,), c (n_c + n_a,) and the stored factors.
    solution_program : program for "a" (n_q,) and "lam" (n_c + n_a,), which is 0 for redundant rows.
    least_norm_program : program for "lam" (n_c + n_a,) of least norm; its input c is the "lam" of `solution_program`.
    """

    def __init__(self, equations: Elimination, other_programs: Sequence[Program] = ()):
        factors, self._choice, self._n = equations.factors, equations.choice, equations.system.n_q
        n_rows, rows = len(equations.all_rows), self._choice.rows
        dependent = [k for k in range(n_rows) if k not in rows] if other_programs else []
        refined, mass = self._choice.is_refined, equations.mass
        used = {*self._choice.added_rows, *dependent, *(rows if refined else ())}
        exprs = [expr for k in used for expr in equations.all_rows[k]] + [*(mass.flat if refined else ())]
        exprs += [expr for block in factors.blocks for row in block.inverse for expr in row]
        exprs += [expr for block in factors.blocks for _, row in block.rows_below for expr in row]
        factor_quantities = sorted({i for expr in exprs for i in expr.terms})
        shared = _shared_quantities(equations.graph, factor_quantities, other_programs)
        self.stored_indices = {i: k for k, i in enumerate([*factor_quantities, *shared])}
        stored = [equations.graph.quantity(i) for i in self.stored_indices]
        self.factor_program = Program(equations.graph, {"kept": stored}, equations.conditions)
        self.graph = Graph()
        self._r, self._c = self.graph.inputs(self._n, False), self.graph.inputs(n_rows, False)
        inputs = [only_quantity(expr) for expr in self.graph.inputs(len(factor_quantities), False)]

        def to_new_graph(expr: Affine) -> Affine:
            return Affine(self.graph, expr.constant, {inputs[self.stored_indices[i]]: x for i, x in expr.terms.items()})

        self._blocks = [
            Block(
                block.row_indices,
                [[to_new_graph(x) for x in row] for row in block.inverse],
                [(j, [to_new_graph(x) for x in row]) for j, row in block.rows_below],
            )
            for block in factors.blocks
        ]
        self._rows = {k: [to_new_graph(x) for x in equations.all_rows[k]] for k in used}
        self._mass = [[to_new_graph(x) for x in row] for row in mass] if refined else []
        self._zero = Affine(self.graph, 0.0, {})
        self._solve = partial(solve, self._blocks)
        lam = [self._zero] * len(self._c)
        solution, conditions = solve_refined(self._solve, self._choice, self._mass, self._rows, self._r, self._c)
        for k, value in zip(rows, solution[self._n :], strict=True):
            lam[k] = value
        self.solution_program = Program(self.graph, {"a": solution[: self._n], "lam": lam}, conditions)

    @property
    def n_stored(self) -> int:
        """Return the number of quantities that `factor_program` stores."""
        return len(self.stored_indices)

    @cached_property
    def least_norm_program(self) -> Program:
        """Return the program for "lam", the multipliers of least norm."""
        rows = [self._rows.get(k, []) for k in range(len(self._c))]
        independent = [self._c[k] for k in self._choice.rows]
        lam = multipliers_of_least_norm(self.graph, independent, rows, self._choice.rows, self._solve)
        return Program(self.graph, {"lam": lam})


def _shared_quantities(graph: Graph, factors: Sequence[int], other_programs: Sequence[Program]) -> list[int]:
    """Return the quantities that are computed on the way to `factors`, and that `other_programs` need, too."""
    computed = set(graph.quantities_for(map(graph.quantity, factors)))
    used = {i for program in other_programs for expr in program.expressions for i in expr.terms}
    for program in other_programs:
        for j in program.quantities(computed):
            operation = graph.operations[j]
            assert operation is not None
            used |= {i for expr in operation[1:] if isinstance(expr, Affine) for i in expr.terms}
    return sorted(used & computed - set(factors))

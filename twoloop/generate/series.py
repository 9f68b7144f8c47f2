"""Make the program (list of operations) that taylor_step.py repeats to compute Taylor series of a mechanism's motion.

The motion satisfies G v + (C_t, b) = 0 and M a + G^T lam = Q. G = [C_q; A] are the rows of all constraints, C_t
and b the parts of the constraints' rates that do not depend on v, lam the multipliers, and Q the forces.

An operation is "early" if it depends on time and coordinates only, as in entries of G and M, and "late" if it depends
on velocities, too. In G v and G^T lam + M a, terms that share a factor become one product.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.graph import MAX_TRACED_OPERATIONS, Affine, Graph, Untraceable
from twoloop.generate.parameter_expressions import elementwise, number_array
from twoloop.generate.trace import Equations, Evaluator, TraceCache, derive_cached, only_quantity
from twoloop.generate.traced_values import CallbackTraces, Check, accept_traces
from twoloop.kernels.evaluation.operations import COSINE, PENDING, SINE, SUM
from twoloop.problem.system import ConstrainedSystem

Integers = NDArray[np.int64]
Array = NDArray[np.float64]

# if M, C_q and A have more entries than this, single runs use Taylor series only if the user chooses them
MAX_ENTRIES = 200_000

# callbacks that series are derived from: M, Q, C_q, A, C_t, b
USED_CALLBACKS = ("mass", "force", "jacobian", "nonholonomic", "constraint_rate", "nonholonomic_rate")


class Sums(NamedTuple):
    """List of affine expressions as arrays: constants, first terms "coefficient times quantity", and further terms."""

    column: Integers  # for each expression, the index of the quantity in its first term
    coefficient: Array  # for each expression, the coefficient of its first term
    constant: Array  # for each expression, its constant
    row: Integers  # for each term after an expression's first term, the index of the expression; see `_nonzero_sums`
    further_column: Integers  # for each term after an expression's first term, the index of the quantity in this term
    further_coefficient: Array  # coefficients of all terms after an expression's first term


@dataclass(frozen=True)
class OperationGroups:
    """Operations in groups, in the order of their computation; their results are consecutive quantities.

    groups : array; each row describes a group by its kind, and by (begin, end) of its operations, of the further terms
        of `first` (see Sums), and of those of `second`. The operations of a group are of one kind, such as SINE, and do
        not need the results of each other. Sines and cosines of the same angles form one group. The last group has the
        products with v, lam or a: their coefficients are known only after the linear system of an order is solved.
    first, second : first and second argument of each operation.
    """

    groups: Integers
    first: Sums
    second: Sums


@dataclass(frozen=True)
class SeriesProgram:
    """Program of a Taylor series; its quantities are t, q, v, a, lam, results of `early` and of `late`, in this order.

    early : operations that depend on t and q only; after them, the products in G v.
    late : operations that depend on v, too; after them, the products in G^T lam + M a.
    rows, row_indices : nonzero rows of G v + (C_t, b), and their indices. Terms "constant times v_i" are left out,
        because the linear system of each order has them on its left-hand side.
    balance, balance_indices : nonzero rows of Q - G^T lam - M a, without "constant times lam_i or a_i", and indices.
    traced : traces of the callbacks, for a comparison with calls; None: nothing is compared.
    """

    n_q: int
    n_rows: int
    early: OperationGroups
    late: OperationGroups
    rows: Sums
    row_indices: Integers
    balance: Sums
    balance_indices: Integers
    traced: CallbackTraces | None = None

    @property
    def n_operations(self) -> int:
        """Return the number of operations, including the products in G v and G^T lam + M a."""
        return len(self.early.first.column) + len(self.late.first.column)

    def specialize(self, system: ConstrainedSystem, evaluate: Evaluator) -> "SeriesProgram":
        """Return a copy of the program for one system; `evaluate` computes coefficients for the system's parameters."""

        def specialized(exprs: Sums) -> Sums:
            coefficient, constant = evaluate(exprs.coefficient), evaluate(exprs.constant)
            further_coefficient = evaluate(exprs.further_coefficient)
            return exprs._replace(coefficient=coefficient, constant=constant, further_coefficient=further_coefficient)

        early, late = (
            OperationGroups(table.groups, specialized(table.first), specialized(table.second))
            for table in (self.early, self.late)
        )
        rows, balance = specialized(self.rows), specialized(self.balance)
        assert self.traced is not None
        traced = self.traced.specialize(system, evaluate)
        return replace(self, early=early, late=late, rows=rows, balance=balance, traced=traced)

    @property
    def kinds(self) -> frozenset[str]:
        """Return the names of the callbacks that were traced."""
        return frozenset() if self.traced is None else self.traced.kinds

    @property
    def n_nodes(self) -> int:
        """Return the number of quantities: t, q, v, a, lam, and a result of each operation."""
        return 1 + 3 * self.n_q + self.n_rows + self.n_operations


def is_quick_to_trace(system: ConstrainedSystem) -> bool:
    """Return whether M, C_q and A are so small that tracing a series takes at most about a second."""
    return system.n_q * (system.n_q + system.n_c + system.n_a) <= MAX_ENTRIES


def series_for(system: ConstrainedSystem, check: Check = accept_traces) -> SeriesProgram:
    """Return the cached series program of a system; `check` compares traces of callbacks with calls.

    Raise Untraceable if `check` finds a difference, or if a callback cannot be traced.
    """

    def trace_series(cache: TraceCache) -> SeriesProgram:
        return series_program(system, cache.equations(system))

    program: SeriesProgram = derive_cached(system, "series", trace_series, lambda program: check(program.traced))
    return program


def series_program(
    system: ConstrainedSystem, equations: Equations | None = None, independent: Container[int] | None = None
) -> SeriesProgram:
    """Trace the callbacks of a system; return the program that computes the Taylor series of its motion.

    `equations`: earlier traces, whose graph is extended; None: trace the callbacks now. `independent`: indices of the
    independent constraints (rows of G), to which the program is limited; None: all rows.
    Raise Untraceable if a callback cannot be traced; the message names the callback and the reason.
    """
    equations = Equations(system) if equations is None else equations
    n, n_rows = system.n_q, system.n_c + system.n_a
    graph, v = equations.graph, equations.v
    a, lam = graph.inputs(n, True), graph.inputs(n_rows, True)
    mass, force, jacobian, nonholonomic, rate, nonholonomic_rate = map(equations.expressions, USED_CALLBACKS)
    sums = _find_sums(graph)
    arrays = np.vstack([jacobian, nonholonomic]), mass, np.append(rate, nonholonomic_rate), force
    G, mass, rates, force = (elementwise(partial(_expand_sums, sums), [array]) for array in arrays)
    row_products: dict[Any, Any] = {}
    zero = Affine(graph, 0.0, {})
    used_rows = [i for i in range(n_rows) if independent is None or i in independent]
    rows = [zero] * n_rows
    for i in used_rows:
        rows[i] = _sum_of_products(graph, G[i], v, rates[i], row_products, of_rates=True)
    reaction_products: dict[Any, Any] = {}
    balance = []
    for i in range(n):
        factors, multipliers = [-G[k, i] for k in used_rows], [lam[k] for k in used_rows]
        factors += [-entry for entry in mass[i]]
        total = _sum_of_products(graph, factors, [*multipliers, *a], force[i], reaction_products, of_rates=False)
        balance.append(total)
    inputs = [*range(1 + 2 * n), *map(only_quantity, a), *map(only_quantity, lam)]
    program = _assemble_program(graph, sums, inputs, n, n_rows, rows, balance, row_products, reaction_products)
    return replace(program, traced=CallbackTraces(system, graph))


def _find_sums(graph: Graph) -> dict[int, Affine]:
    """Return, for each quantity that is a sum, the affine expression that replaces it in other expressions."""
    sums: dict[int, Affine] = {}
    for i, operation in enumerate(graph.operations):
        if operation is not None and operation[0] == SUM:
            sums[i] = _expand_sums(sums, operation[1])
    return sums


def _expand_sums(sums: dict[int, Affine], expr: Affine) -> Affine:
    """Replace each quantity in `expr` that is a sum by the terms of this sum; return the new expression."""
    sum_quantities = [i for i in expr.terms if i in sums]
    if not sum_quantities:
        return expr
    total = _remove_terms(expr, sum_quantities)
    for i in sum_quantities:
        total = total + sums[i].times(expr.terms[i])
    return total


def _sum_of_products(
    graph: Graph,
    factors: Sequence[Affine],
    multipliers: Sequence[Affine],
    rest: Affine,
    products: dict[Any, Any],
    of_rates: bool,
) -> Affine:
    """Return rest + sum_i factors[i] multipliers[i]; store new products for this sum in the dict `products`.

    There are two ways: (1) terms with equal factors share a product; (2) each factor is split into its quantities, and
    terms with the same quantity share a product. The way that adds fewer products is taken. If both add equally many,
    way (2) is taken for G v + (C_t, b) (`of_rates`), because series of sin x need (cos x) x' anyway; otherwise way (1).
    """
    total = rest
    by_factor: dict[Any, tuple[Affine, Affine]] = {}
    by_quantity: dict[Any, tuple[Affine, Affine]] = {}
    for factor, multiplier in zip(factors, multipliers, strict=True):
        if factor.constant != 0.0:
            total = total + multiplier.times(factor.constant)
        if not factor.terms:
            continue
        varying = Affine(graph, 0.0, factor.terms)
        scale, expr = varying.normalized()
        _add_to_group(by_factor, expr, multiplier.times(scale))
        for i, c in factor.terms.items():
            _add_to_group(by_quantity, graph.quantity(i), multiplier.times(c))
    groups = (by_quantity, by_factor) if of_rates else (by_factor, by_quantity)
    candidates = [[_normalized_product(*pair) for pair in candidate.values() if pair[1].terms] for candidate in groups]
    for key, scale, factor, multiplier in min(
        candidates, key=lambda candidate: len({key for key, *_ in candidate} - products.keys())
    ):
        if key not in products:
            products[key] = (*graph.inputs(1, True), factor, multiplier)
        total = total + products[key][0].times(scale)
    return total


def _normalized_product(factor: Affine, multiplier: Affine) -> tuple[Any, float, Affine, Affine]:
    """Return (key, scale, first, second): factor * multiplier = scale * first * second; `key` is for first * second.

    Products that differ only by the number `scale` have equal keys, so that one operation computes them.
    """
    scale, multiplier = multiplier.normalized()
    return (factor.key, multiplier.key), scale, factor, multiplier


def _add_to_group(groups: dict[Any, tuple[Affine, Affine]], factor: Affine, multiplier: Affine) -> None:
    previous = groups.get(factor.key)
    groups[factor.key] = (factor, multiplier if previous is None else previous[1] + multiplier)


def _assemble_program(
    graph: Graph,
    sums: dict[int, Affine],
    inputs: list[int],
    n: int,
    n_rows: int,
    rows: list[Affine],
    balance: list[Affine],
    row_products: dict[Any, Any],
    reaction_products: dict[Any, Any],
) -> SeriesProgram:
    """Return the SeriesProgram of the equations G v + (C_t, b) = 0 (`rows`) and Q - G^T lam - M a = 0 (`balance`)."""
    early: list[Any] = []
    late: list[Any] = []
    factors = [expr for group in (row_products, reaction_products) for _, *exprs in group.values() for expr in exprs]
    for i, operation in _needed_operations(graph, [*rows, *balance, *factors]):
        if i not in sums:
            kind, first, second = operation
            arguments = (_expand_sums(sums, first), None if second is None else _expand_sums(sums, second))
            (late if graph.is_late[i] else early).append((i, kind, *arguments))
    if len(early) + len(late) + len(row_products) + len(reaction_products) > MAX_TRACED_OPERATIONS:
        raise Untraceable(f"its equations are more than {MAX_TRACED_OPERATIONS} operations")
    tables = [
        [
            *_grouped_operations(operations),
            (PENDING, sorted([(only_quantity(expr), *pair) for expr, *pair in products.values()], key=_term_counts)),
        ]
        for operations, products in ((early, row_products), (late, reaction_products))
    ]
    places = {i: k for k, i in enumerate(inputs)}
    for groups in tables:
        for _, members in groups:
            for quantity, *_ in members:
                places[quantity] = len(places)
    v_and_a, lam_and_a = set(inputs[1 + n : 1 + 3 * n]), set(inputs[1 + 2 * n :])
    return SeriesProgram(
        n,
        n_rows,
        _make_groups(tables[0], places),
        _make_groups(tables[1], places),
        *_nonzero_sums([_remove_terms(expr, v_and_a) for expr in rows], places),
        *_nonzero_sums([_remove_terms(expr, lam_and_a) for expr in balance], places),
    )


def _needed_operations(graph: Graph, exprs: list[Affine]) -> list[tuple[int, Any]]:
    """Return the operations that `exprs` need, as (quantity, operation); a sine comes with the cosine of its angle."""
    needed = set(graph.quantities_for(exprs))
    trig_kinds = (SINE, COSINE)
    angles = {each[1].key for i in needed if (each := graph.operations[i]) is not None and each[0] in trig_kinds}
    return [
        (i, operation)
        for i, operation in enumerate(graph.operations)
        if operation is not None and (i in needed or (operation[0] in trig_kinds and operation[1].key in angles))
    ]


def _nonzero_sums(exprs: list[Affine], places: dict[int, int]) -> tuple[Sums, Integers]:
    """Return the nonzero expressions as Sums, and their indices in `exprs`; Sums.row has indices in `exprs`, too."""
    indices = [k for k, expr in enumerate(exprs) if expr.terms or expr.constant]
    sums = _convert_to_sums([exprs[k] for k in indices], places)
    index_array = np.array(indices, dtype=np.int64)
    return sums._replace(row=index_array[sums.row]), index_array


def _remove_terms(expr: Affine, inputs: Container[int]) -> Affine:
    return Affine(expr.graph, expr.constant, {i: c for i, c in expr.terms.items() if i not in inputs})


def _grouped_operations(operations: list[Any]) -> list[tuple[int, list[Any]]]:
    """Return groups (kind, operations of this kind); the operations of a group depend on earlier groups only."""
    quantities = {quantity for quantity, *_ in operations}
    levels: dict[int, int] = {}
    groups: dict[tuple[int, int], list[Any]] = {}
    for quantity, kind, first, second in operations:  # an operation comes after those that compute its arguments
        arguments = [i for expr in (first, second) if expr is not None for i in expr.terms if i in quantities]
        levels[quantity] = 1 + max((levels[i] for i in arguments), default=0)
        if second is None:
            second = Affine(first.graph, 0.0, {})
        groups.setdefault((levels[quantity], kind), []).append((quantity, first, second))
    ordered = []
    for (depth, kind), members in sorted(groups.items()):
        if kind == COSINE:
            continue
        members.sort(key=_term_counts)  # operations with equal numbers of terms become neighbours
        if kind == SINE:
            cosines = {first.key: quantity for quantity, first, _ in groups[depth, COSINE]}
            members += [(cosines[first.key], first, second) for _, first, second in members]
        ordered.append((kind, members))
    return ordered


def _term_counts(operation: tuple[int, Affine, Affine]) -> tuple[int, int]:
    _, first, second = operation
    return len(first.terms), len(second.terms)


def _make_groups(groups: list[tuple[int, list[Any]]], places: dict[int, int]) -> OperationGroups:
    """Convert groups (kind, operations) to OperationGroups; `places`: {quantity of the graph: index in the program}."""
    members = [member for _, group in groups for member in group]
    sums = [_convert_to_sums([member[k] for member in members], places) for k in (1, 2)]
    rows, begin = [], 0
    for kind, group in groups:
        end = begin + len(group)
        further_terms = [bound for arguments in sums for bound in np.searchsorted(arguments.row, [begin, end])]
        rows.append([kind, begin, end, *further_terms])
        begin = end
    return OperationGroups(np.array(rows, dtype=np.int64), *sums)


def _convert_to_sums(exprs: list[Affine], places: dict[int, int]) -> Sums:
    """Convert a list of expressions to Sums; `places`: {quantity of the graph: index in the program}."""
    terms = [[(places[i], c) for i, c in expr.terms.items()] or [(0, 0.0)] for expr in exprs]
    further_terms = [(k, *term) for k, form_terms in enumerate(terms) for term in form_terms[1:]]
    return Sums(
        np.array([form_terms[0][0] for form_terms in terms], dtype=np.int64),
        number_array(form_terms[0][1] for form_terms in terms),
        number_array(expr.constant for expr in exprs),
        np.array([term[0] for term in further_terms], dtype=np.int64),
        np.array([term[1] for term in further_terms], dtype=np.int64),
        number_array(term[2] for term in further_terms),
    )

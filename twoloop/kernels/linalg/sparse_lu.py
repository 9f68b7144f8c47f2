"""Factor the unsymmetric matrix of Newton's method for a large system, in a fixed order of pivots.

    [M - z^2 K - z D  G^T]
    [G                 0 ]  = L U

M is the mass matrix, and G the constraint Jacobian. K and D are the derivatives of the forces by positions and by
velocities; z is proportional to the step size. symbolic_factorization.py chooses the order of elimination, by the
pattern alone; its argument `couplings` contains the entries of K and D. Pivots are single entries. The program lists
the entries of M, then of K and D. It ends with groups of columns of K and D: no two columns of a group have an entry in
the same row. So one displacement, of all coordinates of a group, yields all its columns by finite differences (Curtis,
Powell & Reid 1974, doi 10.1093/imamat/13.1.117).
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data.common import compiled, inlined
from twoloop.kernels.linalg.symbolic_factorization import (
    N_COORDINATES,
    N_OFF_DIAGONAL,
    N_PIVOTS,
    Entries,
    Integers,
    elimination_order,
    end_of_sections,
    factor_columns_of,
    jacobian_entries_of,
    mass_entries_of,
    pivot_order_of,
    program_in_order,
    stiffening_products_of,
    update_runs_of,
)

MIN_PIVOT = 1e-11  # a pivot is a sum of terms; `factor` fails if |pivot| is at most this fraction of the sum of |terms|


def newton_program(
    n_q: int,
    n_rows: int,
    mass: Entries,
    jacobian: Entries,
    tangents: Entries,
    body_groups: Iterable[Sequence[int]],
    stiff_rows: Sequence[int],
) -> NDArray[np.int32] | None:
    """Return the program that factors Newton's matrix; None if it has more updates than `program_in_order` allows.

    `tangents`: entries of K and D (derivatives of forces), in both triangles, as sorted by `grouped_entries`. For the
    other arguments see `factorization_program`.
    """
    groups = column_groups(tangents, n_q)[tangents[1]]
    group_begins = np.searchsorted(groups, np.arange(groups.max(initial=-1) + 2))
    order = elimination_order(n_q, n_rows, mass, jacobian, body_groups, stiff_rows, tangents)
    entries = np.concatenate([mass[0], tangents[0]]), np.concatenate([mass[1], tangents[1]])
    program = program_in_order(order, n_q, entries, jacobian, stiff_rows, unsymmetric=True)
    return None if program is None else np.concatenate([program, group_begins]).astype(np.int32)


def grouped_entries(tangents: Entries, n_q: int) -> Entries:
    """Return `tangents`, the entries of K and D (derivatives of forces), sorted by the groups of `column_groups`."""
    sequence = np.argsort(column_groups(tangents, n_q)[tangents[1]], kind="stable")
    return tangents[0][sequence], tangents[1][sequence]


def column_groups(entries: Entries, n_q: int) -> Integers:
    """Divide columns into groups in which no two columns have an entry in the same row; return each column's group."""
    rows_of: list[list[int]] = [[] for _ in range(n_q)]
    for i, j in zip(*(indices.tolist() for indices in entries), strict=True):
        rows_of[j].append(i)
    groups = np.zeros(n_q, dtype=np.int64)
    groups_by_row: defaultdict[int, set[int]] = defaultdict(set)  # for each row: groups of columns with entries in it
    for j, rows in enumerate(rows_of):
        groups_in_rows = set().union(*(groups_by_row[i] for i in rows))
        groups[j] = group = next(k for k in range(n_q) if k not in groups_in_rows)
        for i in rows:
            groups_by_row[i].add(group)
    return groups


@inlined
def tangent_entries_of(program):
    """Return rows and columns of the entries of K and D (force derivatives), and where groups of columns begin."""
    group_begins = program[end_of_sections(program) :]
    rows, columns, _ = mass_entries_of(program)
    n_mass = rows.size - group_begins[group_begins.size - 1]
    return rows[n_mass:], columns[n_mass:], group_begins


@compiled
def fill_newton_matrix(program, mass, jacobian, K, D, z, stiffness, values):
    """Store in `values` Newton's matrix [M - z^2 K - z D, G^T; G, 0]; z (real or complex): multiple of the step size.

    K, D: derivatives of forces. `stiffness`: for each row g of G, factor s of a term s g^T g added to a singular M.
    """
    for s in range(values.size):
        values[s] = 0.0
    n_off = program[N_OFF_DIAGONAL]
    _, _, slots = mass_entries_of(program)
    for k in range(mass.size):
        values[slots[k]] += mass[k]
    for k in range(K.size):
        values[slots[mass.size + k]] -= z * (z * K[k] + D[k])
    _, _, slots = jacobian_entries_of(program)
    for k in range(slots.size):
        values[slots[k]] += jacobian[k]
        values[slots[k] + n_off] += jacobian[k]
    product_rows, first, second, slots = stiffening_products_of(program)
    for u in range(product_rows.size):
        product = stiffness[product_rows[u]] * jacobian[first[u]] * jacobian[second[u]]
        values[slots[u]] += product
        if slots[u] >= program[N_PIVOTS]:
            values[slots[u] + n_off] += product


@compiled
def factor(program, is_independent, values, sizes):
    """Replace the matrix in `values` by factors L U (diagonal: 1/pivot); return False if a pivot is small (MIN_PIVOT).

    Redundant rows (0 in `is_independent`) have factors of 0, so that they do not affect solutions. `sizes` is scratch.
    """
    n_q, n, n_off = program[N_COORDINATES], program[N_PIVOTS], program[N_OFF_DIAGONAL]
    order, runs = pivot_order_of(program), update_runs_of(program)
    begin, row_of = factor_columns_of(program)
    for k in range(n):
        sizes[k] = abs(values[k])
    u = 0
    for k in range(n):
        first, last = n + begin[k], n + begin[k + 1]
        if order[k] >= n_q and is_independent[order[k] - n_q] == 0.0:
            values[k] = 0.0
            for s in range(first, last):
                values[s] = 0.0
                values[s + n_off] = 0.0
                slot = s + 1
                while slot < last:
                    slot += runs[u]
                    u += 2
            continue
        if not abs(values[k]) > MIN_PIVOT * sizes[k]:  # also true for NaN
            return False
        inverse = 1.0 / values[k]
        values[k] = inverse
        for s in range(first, last):
            lower, upper = values[s] * inverse, values[s + n_off] * inverse
            target = row_of[s - n]
            change = lower * values[s + n_off]
            values[target] -= change
            sizes[target] += abs(change)
            slot = s + 1
            while slot < last:
                size, target = runs[u], runs[u + 1]
                if upper != 0.0:
                    target_run, source_run = values[target : target + size], values[slot : slot + size]
                    for i in range(size):
                        target_run[i] -= source_run[i] * upper
                if lower != 0.0:
                    target_run, source_run = (
                        values[target + n_off : target + n_off + size],
                        values[slot + n_off : slot + n_off + size],
                    )
                    for i in range(size):
                        target_run[i] -= lower * source_run[i]
                slot += size
                u += 2
            values[s] = lower
    return True


@compiled
def solve(program, values, x, y):
    """Replace x, a right-hand side of Newton's equations, by the solution, using the factors `values`; y is scratch."""
    n, n_off, order = program[N_PIVOTS], program[N_OFF_DIAGONAL], pivot_order_of(program)
    begin, row_of = factor_columns_of(program)
    for k in range(n):
        y[k] = x[order[k]]
    for k in range(n):
        y_k = y[k]
        for s in range(begin[k], begin[k + 1]):
            y[row_of[s]] -= values[n + s] * y_k
    for k in range(n - 1, -1, -1):
        total = y[k]
        for s in range(begin[k], begin[k + 1]):
            total -= values[n + n_off + s] * y[row_of[s]]
        y[k] = total * values[k]
    for k in range(n):
        x[order[k]] = y[k]

"""M, G and the factors of a large system at a state, by its static program; and which rows count.

Nothing here has the size of n_c times n_q where callbacks give values of entries. Dense callbacks fill dense arrays,
from which the entries are taken.
"""

import numpy as np

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.algebra.static_factors import factor, load, refined
from twoloop.kernels.algebra.static_program import N_PIVOTS, jacobian_of, mass_of, order_of
from twoloop.kernels.data.codes import DONE, NEEDS_DENSE, RANK_DIFFERS, SINGULAR
from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.counters import N_FACTORIZATIONS, N_PARTITIONS
from twoloop.kernels.data.finite import JACOBIAN, MASS, finite_vector, not_finite
from twoloop.kernels.data.flags import CONSTANT_MASS, JACOBIAN_VALUES_GIVEN, MASS_VALUES_GIVEN
from twoloop.kernels.data.noted import GENERATION, PIVOT, RANK, RANK_V, SMALLEST
from twoloop.kernels.evaluation.program import jacobian_by_program

SUSPECT = 1e-6  # a pivot below this share of its size is looked at: that of a redundant row is rounding
LEAST = 1e-10  # ... and one below this share no factors with pivots of one row can do with
DEPENDENT = 1e-11  # sine of the angle to the other rows, found without cancellation, up to which a row is redundant
CAREFUL = 2.0  # of NEARLY_SINGULAR: stages are put on the constraints, as it matters how well they keep to these
ONCE, TWICE = 1e-3, 1e-7  # the smallest share, below which solutions are refined, and refined again


@compiled
def mass_values_there(f, w, t, q):
    """The entries of M into w.mass_values; of a constant dense M they stand there from the beginning."""
    if f.flags[MASS_VALUES_GIVEN] == 1:
        w.mass_values[:] = 0.0
        f.mass_values(t, q, f.p, w.mass_values)
    elif w.M.size > 0:
        rows, columns, _ = mass_of(f.static_program)
        for k in range(rows.size):
            w.M[rows[k], columns[k]] = 0.0
        f.mass(t, q, f.p, w.M)
        for k in range(rows.size):
            w.mass_values[k] = w.M[rows[k], columns[k]]


@compiled
def jacobian_values_there(f, w, t, q):
    """The entries of C_q into w.jacobian_values."""
    if f.flags[JACOBIAN_VALUES_GIVEN] == 1:
        w.jacobian_values[:] = 0.0
        f.jacobian_values(t, q, f.p, w.jacobian_values)
        return
    rows, columns, _ = jacobian_of(f.static_program)
    for k in range(rows.size):
        w.G[rows[k], columns[k]] = 0.0
    if not jacobian_by_program(f, w, t, q, w.G):
        f.jacobian(t, q, f.p, w.G[: w.C.size])
    for k in range(rows.size):
        w.jacobian_values[k] = w.G[rows[k], columns[k]]


@compiled
def _factor(f, w, least):
    """The factors for the values there are; the smallest pivot over its size, see static_factors.py."""
    w.counters[N_FACTORIZATIONS] += 1
    stiffness = w.solutions[3 * f.static_program[N_PIVOTS] :]
    load(f.static_program, w.mass_values, w.jacobian_values, w.counts, w.factors, stiffness, w.pivot_sizes)
    smallest = factor(f.static_program, w.counts, w.factors, w.pivot_sizes, least)
    w.notes[SMALLEST] = smallest
    w.notes[PIVOT] = np.sqrt(max(smallest, 0.0))
    return smallest


@compiled
def _fault(w, t, q):
    """Which values are not finite; where all are, whether M is singular, as dense forms may accept, or the rows are."""
    if not finite_vector(w.mass_values):
        return not_finite(w.notes, MASS, t, q)
    if not finite_vector(w.jacobian_values):
        return not_finite(w.notes, JACOBIAN, t, q)
    return NEEDS_DENSE if w.notes[SMALLEST] < 0.0 else SINGULAR


@compiled
def factors_there(f, w, t, q):
    """The factors at (t, q), of the rows that count."""
    if f.flags[CONSTANT_MASS] == 0:
        mass_values_there(f, w, t, q)
    jacobian_values_there(f, w, t, q)
    smallest = _factor(f, w, LEAST)
    if not smallest > 0.0:
        return _fault(w, t, q)
    return DONE if _number(w.counts) == w.rows_v.size else _choose_again(f, w, t, q)


@compiled
def _choose_again(f, w, t, q):
    """Rows that count have come to depend on one another: others may do in their place."""
    w.counters[N_PARTITIONS] += 1
    code = _choose(f, w, t, q)
    return _take(w) if code == DONE else code


@compiled
def solve_values(f, w, times):
    """Solve for the right-hand side in w.unknowns, in its place, refined so many times."""
    n = f.static_program[N_PIVOTS]
    scratch = w.solutions
    return refined(
        f.static_program,
        w.mass_values,
        w.jacobian_values,
        w.counts,
        w.factors,
        scratch[3 * n :],
        w.unknowns,
        times,
        scratch[:n],
        scratch[n : 2 * n],
        scratch[2 * n : 3 * n],
    )


@compiled
def refinements(w):
    """How often solutions with these factors are to be refined."""
    smallest = w.notes[SMALLEST]
    return 0 if smallest > ONCE else 1 if smallest > TWICE else 2


@compiled
def _row_as_force(f, w, row):
    """[g, 0] into w.unknowns for a row g of G."""
    w.unknowns[:] = 0.0
    rows, columns, _ = jacobian_of(f.static_program)
    for k in range(rows.size):
        if rows[k] == row:
            w.unknowns[columns[k]] += w.jacobian_values[k]


@compiled
def _squared_in_mass(f, w, x):
    """x^T M x."""
    rows, columns, _ = mass_of(f.static_program)
    total = 0.0
    for k in range(rows.size):
        total += x[rows[k]] * w.mass_values[k] * x[columns[k]]
    return total


@compiled
def _sine(f, w, row, size):
    """The sine of the angle of a row that does not count to those that do; `size` is g M^-1 g^T."""
    _row_as_force(f, w, row)
    solve_values(f, w, 2)
    part = _squared_in_mass(f, w, w.unknowns[: w.Q.size])
    return np.sqrt(part / size) if size > 0.0 else 0.0


@compiled
def _number(counts):
    number = 0
    for i in range(counts.size):
        number += int(counts[i])
    return number


@compiled
def _choose(f, w, t, q):
    """Which rows count, into w.counts, and the factors of these; DONE, or why that cannot be said.

    Rows with small pivots are left out at first, and taken one after another if they are independent of those that
    count by then.
    """
    w.counts[:] = 1.0
    if not _factor(f, w, SUSPECT) > 0.0:
        return _fault(w, t, q)
    order, n_q = order_of(f.static_program), w.Q.size
    copy(w.counts, w.z)  # 0 for rows to look at
    for k in range(order.size):
        row = order[k] - n_q
        if row < 0 or w.z[row] != 0.0:
            continue
        sine = _sine(f, w, row, w.pivot_sizes[k])
        if sine <= DEPENDENT:
            continue
        number = _number(w.counts)
        w.counts[row] = 1.0
        smallest = _factor(f, w, LEAST) if sine * sine > LEAST else 0.0
        if not smallest > 0.0 or _number(w.counts) != number + 1:
            return _fault(w, t, q)
    return DONE


@compiled
def _take(w):
    """Make the rows that count those of the workspace, which has room for so many."""
    if _number(w.counts) != w.rows_v.size:
        return SINGULAR
    place = 0
    for i in range(w.counts.size):
        if w.counts[i] != 0.0:
            w.rows_v[place] = i
            place += 1
    return DONE


@compiled
def choose_rows(f, w, t, q):
    """Choose the rows that count at (t, q); RANK_DIFFERS where the workspace is made for another number of them."""
    w.counters[N_PARTITIONS] += 1
    mass_values_there(f, w, t, q)
    jacobian_values_there(f, w, t, q)
    code = _choose(f, w, t, q)
    if code != DONE:
        return code
    number = _number(w.counts)
    if w.notes[GENERATION] == 0.0 and number != w.rows_v.size:
        w.notes[RANK] = w.notes[RANK_V] = number
        return RANK_DIFFERS
    w.notes[GENERATION] += 1.0
    return _take(w)

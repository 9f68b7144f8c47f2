"""Factor and solve the matrix [M G^T; G 0] of a large system by a program, see symbolic_factorization.py.

M is the mass matrix, and G the constraint Jacobian. An independent row of G has a negative pivot: minus the squared
norm of the part of the row that is orthogonal to previous rows, in the metric of M^-1. The squared norm of the row
itself is the sum of contributions of the bodies. The ratio of the two squared norms is the squared sine of the angle
between the row and the span of previous rows. For a redundant row, 0 replaces 1 / pivot: the row does not influence
the solution, and the program stays the same. If the smallest squared sine is 10^-k, solutions lose k digits, which
iterative refinement with M and G recovers.

The matrix M of a body may be singular, as it is with four Euler parameters. Then s g^T g is added to M for each row g
of G that involves this body only; s is a positive number. Accelerations stay the same, because the constraint
prescribes g a, but the multiplier of g decreases by s g a. So M need only be positive definite on the velocities that
these rows allow. A row g that is redundant, as in closed loops, may be added, too. Its constraint is not among the
equations that are solved; so s g^T (g a), with the prescribed value of g a, is added to the right-hand side.
"""

from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.linalg.symbolic_factorization import (
    N_COORDINATES,
    N_PIVOTS,
    factor_columns_of,
    jacobian_entries_of,
    mass_entries_of,
    pivot_order_of,
    stiffening_products_of,
    update_runs_of,
)

NOT_DEFINITE = -1.0  # result of `factor` if a pivot of M is not positive; a result of at least 0 means success


@compiled
def _fill_stiffness(program, mass, jacobian, stiffness, scratch):
    """For each row g of G that is added to a singular M as s g^T g, store the number s in `stiffness`.

    s is m / |g|^2, so that s g^T g is about as large as M; m: largest M_jj of the columns j in which g has entries.
    """
    n_q = program[N_COORDINATES]
    for k in range(program[N_PIVOTS]):
        scratch[k] = 0.0
    rows, columns, _ = mass_entries_of(program)
    for k in range(rows.size):
        if rows[k] == columns[k]:
            scratch[rows[k]] += mass[k]
    _, columns, _ = jacobian_entries_of(program)
    product_rows, first, second, _ = stiffening_products_of(program)
    for u in range(product_rows.size):
        stiffness[product_rows[u]] = 0.0
    for u in range(product_rows.size):
        if first[u] == second[u]:
            row, number = product_rows[u], jacobian[first[u]]
            stiffness[row] = max(stiffness[row], scratch[columns[first[u]]])
            scratch[n_q + row] += number * number
    for u in range(product_rows.size):
        row = product_rows[u]
        if scratch[n_q + row] > 0.0:
            stiffness[row] /= scratch[n_q + row]
            scratch[n_q + row] = 0.0


@merged
def fill_saddle_matrix(program, mass, jacobian, values, stiffness, scratch):
    """Store [M G^T; G 0] in `values`; if M is singular, add s g^T g for rows g of G, with s of `_fill_stiffness`."""
    for s in range(values.size):
        values[s] = 0.0
    _, _, slots = mass_entries_of(program)
    for k in range(slots.size):
        values[slots[k]] += mass[k]
    _, _, slots = jacobian_entries_of(program)
    for k in range(slots.size):
        values[slots[k]] += jacobian[k]
    product_rows, first, second, slots = stiffening_products_of(program)
    if product_rows.size > 0:
        _fill_stiffness(program, mass, jacobian, stiffness, scratch)
        for u in range(product_rows.size):
            values[slots[u]] += stiffness[product_rows[u]] * jacobian[first[u]] * jacobian[second[u]]


@compiled
def factor(program, is_independent, values, sizes, min_sine_square):
    """Replace the matrix in `values` by its factors; return the smallest squared sine of angles between rows of G.

    The angle is between a row and the span of previous rows. Its squared sine is -pivot / (squared norm of the row).
    The squared norms are stored in `sizes`, 1 / pivot in the diagonal of the factors. Rows with is_independent = 0 on
    entry are redundant. For rows with a squared sine of at most `min_sine_square`, is_independent becomes 0, too.
    Factors of redundant rows are 0. If the pivot of a coordinate is not positive (M not definite), return NOT_DEFINITE.
    """
    (n_q, n) = program[N_COORDINATES], program[N_PIVOTS]
    order, runs = pivot_order_of(program), update_runs_of(program)
    begin, row_of = factor_columns_of(program)
    for k in range(n):
        sizes[k] = 0.0
    smallest, u = 1.0, 0
    for k in range(n):
        first, last = n + begin[k], n + begin[k + 1]
        pivot, is_row = values[k], order[k] >= n_q
        if is_row:
            row = order[k] - n_q
            if is_independent[row] != 0.0 and not -pivot > min_sine_square * sizes[k]:  # also true for NaN
                is_independent[row] = 0.0
            if is_independent[row] == 0.0:
                values[k] = 0.0
                for s in range(first, last):
                    values[s] = 0.0
                    slot = s + 1
                    while slot < last:
                        slot += runs[u]
                        u += 2
                continue
            smallest = min(smallest, -pivot / sizes[k])
        elif not pivot > 0.0:
            return NOT_DEFINITE
        inverse = 1.0 / pivot
        values[k] = inverse
        for s in range(first, last):
            multiplier = values[s] * inverse
            if not is_row:
                sizes[row_of[s - n]] += multiplier * values[s]
            values[row_of[s - n]] -= multiplier * values[s]
            slot = s + 1
            while slot < last:
                size = runs[u]
                if multiplier != 0.0:  # two thirds of the entries of L are 0 if a planar mechanism is modelled in space
                    target_run, source_run = values[runs[u + 1] : runs[u + 1] + size], values[slot : slot + size]
                    for i in range(size):
                        target_run[i] -= multiplier * source_run[i]
                slot += size
                u += 2
            values[s] = multiplier
    return smallest


@compiled
def solve(program, values, stiffness, x, y):
    """Replace x = [r, c] by the solution [a, lam] of M a + G^T lam = r, G a = c, using the factors `values`.

    `stiffness`: the number s for each row g of G that was added to M as s g^T g. y is scratch.
    """
    n, order, n_q = program[N_PIVOTS], pivot_order_of(program), program[N_COORDINATES]
    # The factors belong to M + s g^T g, but x contains r instead of r + s c g^T. This does not change accelerations,
    # because g a = c; but the multiplier of row g becomes too small by s c, which the last loop adds
    begin, row_of = factor_columns_of(program)
    for k in range(n):
        y[k] = x[order[k]]
    for k in range(n):
        y_k = y[k]
        for s in range(begin[k], begin[k + 1]):
            y[row_of[s]] -= values[n + s] * y_k
    for k in range(n - 1, -1, -1):
        total = y[k] * values[k]
        for s in range(begin[k], begin[k + 1]):
            total -= values[n + s] * y[row_of[s]]
        y[k] = total
    for k in range(n):
        i = order[k]
        x[i] = y[k] + stiffness[i - n_q] * x[i] if i >= n_q else y[k]


@compiled
def add_terms_of_redundant_rows(program, jacobian, is_independent, stiffness, rhs, right):
    """For each redundant constraint g a = c whose row g was added to M as s g^T g, add s c g^T to the vector `right`.

    So the solution stays the same, although g a = c is not among the equations that are solved. `stiffness` contains
    the number s of each row; `rhs` contains n_q forces, then the number c of each row.
    """
    n_q = program[N_COORDINATES]
    _, columns, _ = jacobian_entries_of(program)
    product_rows, first, second, _ = stiffening_products_of(program)
    for u in range(product_rows.size):
        row, entry = product_rows[u], first[u]
        if entry == second[u] and is_independent[row] == 0.0:
            right[columns[entry]] += stiffness[row] * jacobian[entry] * rhs[n_q + row]


@compiled
def subtract_product(program, mass, jacobian, is_independent, x, b):
    """Subtract [M G^T; G 0] x from the vector b in place; then set the entries of redundant rows of G in b to zero."""
    n_q = program[N_COORDINATES]
    rows, columns, _ = mass_entries_of(program)
    for k in range(rows.size):
        b[rows[k]] -= mass[k] * x[columns[k]]
    rows, columns, _ = jacobian_entries_of(program)
    for k in range(rows.size):
        i, j = rows[k], columns[k]
        b[j] -= jacobian[k] * x[n_q + i]
        b[n_q + i] -= jacobian[k] * x[j]
    for i in range(is_independent.size):
        if is_independent[i] == 0.0:
            b[n_q + i] = 0.0


@compiled
def solve_refined(program, mass, jacobian, is_independent, values, stiffness, x, n_corrections, right, residual, y):
    """Replace x = [r, c] by the solution [a, lam] of M a + G^T lam = r, G a = c; refine it `n_corrections` times.

    Return max|last correction of a| / max|a|, or 0 without corrections. The last three arguments are scratch.
    """
    n_q, change = program[N_COORDINATES], 0.0
    for k in range(x.size):
        right[k] = x[k]
    add_terms_of_redundant_rows(program, jacobian, is_independent, stiffness, right, x)
    for i in range(is_independent.size):
        if is_independent[i] == 0.0:
            x[n_q + i] = right[n_q + i] = 0.0
    solve(program, values, stiffness, x, y)
    for _ in range(n_corrections):
        for k in range(x.size):
            residual[k] = right[k]
        subtract_product(program, mass, jacobian, is_independent, x, residual)
        solve(program, values, stiffness, residual, y)
        largest = change = 0.0
        for k in range(n_q):
            x[k] += residual[k]
            largest, change = max(largest, abs(x[k])), max(change, abs(residual[k]))
        for k in range(n_q, x.size):
            x[k] += residual[k]
        change = change / largest if largest > 0.0 else 0.0
    return change

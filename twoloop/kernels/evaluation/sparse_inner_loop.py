"""Do the tasks of the inner loop for large systems, by sparse factors in an order of elimination that is chosen once.

There is no partition: steps integrate all coordinates, and the stages need not satisfy the constraints. Where other
forms compute dependent coordinates, this form moves all coordinates to the nearest state on the constraints, in the
metric of M. If sparse factors do not show which rows are independent, a task returns NEEDS_DENSE, and the run continues
with the forms of linalg/saddle_point.py, which methods with a partition always use. Callbacks may return the nonzero
entries of C_q; then no array has n_c times n_q numbers. If they fill dense matrices, the entries are copied.

If rows of G = C_q are redundant, many multipliers lam have the same reactions p = G^T lam. The shortest lam is used. It
equals G y for some vector y; y and lam solve

    [0  G^T] [ y ]   [p]
    [G  -1 ] [lam] = [0]

This matrix is singular, because the constraints leave some motion free. If a small positive diagonal matrix W replaces
0, the matrix is quasi-definite, and can be factored in any order (Vanderbei 1995, doi 10.1137/0805005), so also by the
program for [M G^T; G 0]. Iterative refinement converges to the shortest lam, because p is a combination of rows of G:
let s be a singular value of G with its columns scaled to norm 1; then each refinement divides the error along the
singular vector by 1 + s^2 / REGULARIZATION.
"""

import numpy as np

from twoloop.kernels.data.common import (
    CONSTRAINT,
    FORCE,
    GAMMA,
    INNER,
    JACOBIAN,
    MASS,
    RATE,
    compiled,
    finite_vector,
    kernel,
    not_finite,
)
from twoloop.kernels.data.indices import (
    DONE,
    INNER_DIVERGED,
    NEEDS_DENSE,
    RANK_DIFFERS,
    ROWS_CONTRADICT,
    SINGULAR,
    STOPPED,
)
from twoloop.kernels.evaluation import tasks
from twoloop.kernels.evaluation.constraints import constraint_rates
from twoloop.kernels.evaluation.operations import gamma_by_program, jacobian_by_program
from twoloop.kernels.evaluation.partition import (
    AMPLIFICATION,
    CONTRACTION,
    MAX_ITERATIONS,
    MAX_VIOLATION,
    MIN_CORRECTION,
    ROUNDING_OF_CORRECTIONS,
    ROUNDING_OF_ROWS,
)
from twoloop.kernels.linalg.dense import copy, has_new_entries, largest_of
from twoloop.kernels.linalg.sparse_ldl import factor, fill_saddle_matrix, solve, solve_refined
from twoloop.kernels.linalg.symbolic_factorization import (
    N_OFF_DIAGONAL,
    N_PIVOTS,
    jacobian_entries_of,
    mass_entries_of,
    pivot_order_of,
)

# in the metric of M^-1, pivot / (squared norm of a row of C_q) is sin^2 of the row's angle to the span of previous rows
SUSPECT_PIVOT = 1e-6  # a pivot up to this * (squared norm of its row) may be a rounding error: the row is checked
MIN_PIVOT = 1e-10  # factors are accurate if pivot / (squared norm of the row) exceeds this for all independent rows
MAX_DEPENDENT_SINE = 1e-11  # a row is redundant if the sine of its angle to the independent rows' span is at most this
PROJECT_STAGES = 2.0  # value of w.nearly_singular with which stages are projected before they are evaluated
# solutions are refined iteratively, once if the smallest pivot / (squared norm of its row of C_q) is at most the first
# limit, and twice if this ratio is at most the second limit
REFINE_ONCE_BELOW, REFINE_TWICE_BELOW = 1e-3, 1e-7


@compiled
def fill_mass_values(f, w, t, q):
    """Store the entries of M(t, q) in w.mass_values; do nothing if M is a constant full matrix, stored once before."""
    if f.mass_values_given == 1:
        w.mass_values[:] = 0.0
        f.mass_values(t, q, f.p, w.mass_values)
    elif w.M.size > 0:
        rows, columns, _ = mass_entries_of(f.ldl_program)
        for k in range(rows.size):
            w.M[rows[k], columns[k]] = 0.0
        f.mass(t, q, f.p, w.M)
        for k in range(rows.size):
            w.mass_values[k] = w.M[rows[k], columns[k]]


@compiled
def fill_jacobian_values(f, w, t, q):
    """Store the nonzero entries of the constraint Jacobian C_q(t, q) in w.jacobian_values."""
    if f.jacobian_values_given == 1:
        w.jacobian_values[:] = 0.0
        f.jacobian_values(t, q, f.p, w.jacobian_values)
        return
    rows, columns, _ = jacobian_entries_of(f.ldl_program)
    for k in range(rows.size):
        w.G[rows[k], columns[k]] = 0.0
    if not jacobian_by_program(f, w, t, q, w.G):
        f.jacobian(t, q, f.p, w.G[: w.C.size])
    for k in range(rows.size):
        w.jacobian_values[k] = w.G[rows[k], columns[k]]


@compiled
def _factor_entries(f, w, min_sine_square):
    """Factor [M G^T; G 0], G = C_q; return the smallest sin^2 of a row's angle to the span of previous rows of G.

    If the sin^2 of a row is at most `min_sine_square`, mark the row as redundant: neither the factors nor the returned
    minimum contain it. If M is not positive definite, return -1.
    """
    w.n_factorizations += 1
    stiffness = w.solutions[3 * f.ldl_program[N_PIVOTS] :]
    fill_saddle_matrix(f.ldl_program, w.mass_values, w.jacobian_values, w.factors, stiffness, w.pivot_sizes)
    smallest = factor(f.ldl_program, w.is_independent, w.factors, w.pivot_sizes, min_sine_square)
    w.smallest = smallest
    w.pivot = np.sqrt(max(smallest, 0.0))
    return smallest


@compiled
def _failure_of_factorization(w, t, q):
    """Return why a factorization failed: NOT_FINITE, NEEDS_DENSE (M is not positive definite) or else SINGULAR."""
    if not finite_vector(w.mass_values):
        return not_finite(w, MASS, t, q)
    if not finite_vector(w.jacobian_values):
        return not_finite(w, JACOBIAN, t, q)
    return NEEDS_DENSE if w.smallest < 0.0 else SINGULAR


@compiled
def factor_equations_at(f, w, t, q):
    """Evaluate M and G = C_q at (t, q), and factor [M G^T; G 0] with the independent rows of G; return a code."""
    if f.constant_mass == 0:
        fill_mass_values(f, w, t, q)
    fill_jacobian_values(f, w, t, q)
    smallest = _factor_entries(f, w, MIN_PIVOT)
    if not smallest > 0.0:
        return _failure_of_factorization(w, t, q)
    if _count_independent(w.is_independent) == w.rows_v.size:
        return DONE
    w.n_partitions += 1
    code = _choose_rows(f, w, t, q)  # some independent rows have become dependent: find rows that replace them
    return _adopt_rows(w) if code == DONE else code


@compiled
def solve_unknowns(f, w, n_corrections):
    """Solve [M G^T; G 0] x = b, G = C_q: the solution x replaces b in w.unknowns. Refine x `n_corrections` times."""
    n = f.ldl_program[N_PIVOTS]
    scratch = w.solutions
    return solve_refined(
        f.ldl_program,
        w.mass_values,
        w.jacobian_values,
        w.is_independent,
        w.factors,
        scratch[3 * n :],
        w.unknowns,
        n_corrections,
        scratch[:n],
        scratch[n : 2 * n],
        scratch[2 * n : 3 * n],
    )


@compiled
def n_refinements(w):
    """Return the number of iterative refinements (0, 1 or 2) that solutions with the factors in w need."""
    smallest = w.smallest
    return 0 if smallest > REFINE_ONCE_BELOW else 1 if smallest > REFINE_TWICE_BELOW else 2


@compiled
def _sine_to_independent_rows(f, w, row, square):
    """Return the sine of the angle between a row g of G and the span of the independent rows, in the metric of M^-1.

    `row`: index of g in G; `square`: g M^-1 g^T, the squared norm of g.
    """
    x, part = w.unknowns, 0.0
    x[:] = 0.0
    rows, columns, _ = jacobian_entries_of(f.ldl_program)
    for k in range(rows.size):  # set the right-hand side x to [row of G, 0]
        if rows[k] == row:
            x[columns[k]] += w.jacobian_values[k]
    solve_unknowns(f, w, 2)
    rows, columns, _ = mass_entries_of(f.ldl_program)
    for k in range(rows.size):  # x^T M x: squared norm, by M^-1, of g without its component along independent rows
        part += x[rows[k]] * w.mass_values[k] * x[columns[k]]
    return np.sqrt(part / square) if square > 0.0 else 0.0


@compiled
def _count_independent(is_independent):
    n_independent = 0
    for i in range(is_independent.size):
        n_independent += int(is_independent[i])
    return n_independent


@compiled
def _choose_rows(f, w, t, q):
    """Set w.is_independent to 1 for independent rows of G = C_q, else to 0; factor [M G^T; G 0]; return a code.

    The factors contain the independent rows only. First, leave out all rows with pivots up to SUSPECT_PIVOT. Then add
    each row that was left out, unless it is a combination of the rows chosen so far.
    """
    w.is_independent[:] = 1.0
    if not _factor_entries(f, w, SUSPECT_PIVOT) > 0.0:
        return _failure_of_factorization(w, t, q)
    order, n_q = pivot_order_of(f.ldl_program), w.Q.size
    copy(w.is_independent, w.z)  # w.z (scratch) marks rows with small pivots by 0; the loop below checks these rows
    for k in range(order.size):
        row = order[k] - n_q
        if row < 0 or w.z[row] != 0.0:
            continue
        sine = _sine_to_independent_rows(f, w, row, w.pivot_sizes[k])
        if sine <= MAX_DEPENDENT_SINE:
            continue
        n_independent = _count_independent(w.is_independent)
        w.is_independent[row] = 1.0
        smallest = _factor_entries(f, w, MIN_PIVOT) if sine * sine > MIN_PIVOT else 0.0
        if not smallest > 0.0 or _count_independent(w.is_independent) != n_independent + 1:
            return _failure_of_factorization(w, t, q)
    return DONE


@compiled
def _adopt_rows(w):
    """Store the indices of the independent rows in w.rows_v; return DONE, or SINGULAR if w.rows_v has another size."""
    if _count_independent(w.is_independent) != w.rows_v.size:
        return SINGULAR
    position = 0
    for i in range(w.is_independent.size):
        if w.is_independent[i] != 0.0:
            w.rows_v[position] = i
            position += 1
    return DONE


@compiled
def choose_rows(f, w, t, q):
    """Choose the independent rows of C_q at (t, q); return a code. RANK_DIFFERS: w was allocated for a wrong rank."""
    w.n_partitions += 1
    fill_mass_values(f, w, t, q)
    fill_jacobian_values(f, w, t, q)
    code = _choose_rows(f, w, t, q)
    if code != DONE:
        return code
    n_independent = _count_independent(w.is_independent)
    if w.generation == 0.0 and n_independent != w.rows_v.size:
        w.rank = w.rank_v = n_independent
        return RANK_DIFFERS
    w.generation += 1.0
    return _adopt_rows(w)


# entry j of the diagonal matrix W, which makes the equations in the module docstring regular, is this fraction of the
# sum of squares of column j of C_q
REGULARIZATION = 1e-11
CONVERGED_RESIDUAL = 1e-14  # multipliers are refined until (error of reactions) / (largest reaction) is at most this
MAX_RESIDUAL = 1e-9  # multipliers are rejected if (error of reactions) / (largest reaction) stays above this
MAX_SOLUTIONS = 30  # most systems solved for multipliers of least norm: the first solution and its refinements


@compiled
def _fill_least_norm_matrix(program, jacobian, n_q, weights, values):
    """Store the matrix [W G^T; G -1] for multipliers of least norm in `values`; W: diagonal, see REGULARIZATION.

    G: constraint Jacobian with the entries `jacobian`. The `program` defines the order of `values`; `weights`: scratch.
    """
    rows, columns, slots = jacobian_entries_of(program)
    for j in range(n_q):
        weights[j] = 0.0
    largest = 0.0
    for k in range(rows.size):
        weights[columns[k]] += jacobian[k] * jacobian[k]
        largest = max(largest, weights[columns[k]])
    order, n = pivot_order_of(program), program[N_PIVOTS]
    for s in range(n + program[N_OFF_DIAGONAL]):
        values[s] = 0.0
    for k in range(n):
        values[k] = (
            REGULARIZATION * (weights[order[k]] if weights[order[k]] > 0.0 else largest) if order[k] < n_q else -1.0
        )
    for k in range(rows.size):
        values[slots[k]] += jacobian[k]


@compiled
def _fill_residual(program, jacobian, force, x, r):
    """Store in r the residual of the equations that yield the multipliers of least norm; return its relative size.

    See the module docstring: the residual is [p - G^T lam, lam - G y], its relative size max|p - G^T lam| / max|p|.
    x: approximate solution [y, lam]. p (`force`): reactions that lam must have. `jacobian`: entries of C_q = G.
    """
    n_q, largest, residual = force.size, 0.0, 0.0
    copy(force, r[:n_q])
    for i in range(n_q, x.size):
        r[i] = x[i]
    rows, columns, _ = jacobian_entries_of(program)
    for k in range(rows.size):
        i, j = n_q + rows[k], columns[k]
        r[j] -= jacobian[k] * x[i]
        r[i] -= jacobian[k] * x[j]
    for j in range(n_q):
        largest, residual = max(largest, abs(force[j])), max(residual, abs(r[j]))
    return residual / largest if largest > 0.0 else 0.0


@compiled
def least_norm(f, w, lam):
    """Replace lam by the multipliers of least norm with the same reactions G^T lam; return NEEDS_DENSE on failure."""
    program, n_q = f.ldl_program, w.Q.size
    n = program[N_PIVOTS]
    n_factors = n + program[N_OFF_DIAGONAL] + 1
    values, is_independent, no_stiffness = w.minimum[:n_factors], w.z, w.g
    force, x = w.minimum[n_factors : n_factors + n_q], w.minimum[n_factors + n_q :]
    change, y, weights = w.solutions[:n], w.solutions[n : 2 * n], w.solutions[2 * n : 3 * n]
    rows, columns, _ = jacobian_entries_of(program)
    for j in range(n_q):
        force[j] = 0.0
    for k in range(rows.size):
        force[columns[k]] += w.jacobian_values[k] * lam[rows[k]]
    _fill_least_norm_matrix(program, w.jacobian_values, n_q, weights, values)
    for i in range(lam.size):
        is_independent[i], no_stiffness[i] = 1.0, 0.0
    if not factor(program, is_independent, values, w.pivot_sizes, 0.0) > 0.0:
        return NEEDS_DENSE
    for i in range(n):
        x[i] = 0.0
    last_residual = _fill_residual(program, w.jacobian_values, force, x, change)
    for _ in range(MAX_SOLUTIONS):
        if last_residual <= CONVERGED_RESIDUAL:
            break
        solve(program, values, no_stiffness, change, y)
        for i in range(n):
            x[i] += change[i]
        residual = _fill_residual(program, w.jacobian_values, force, x, change)
        if not residual < last_residual:
            last_residual = residual
            break
        last_residual = residual
    if not last_residual <= MAX_RESIDUAL:
        return NEEDS_DENSE
    copy(x[n_q:], lam)
    return DONE


@compiled
def _add_jacobian_times(f, w, x, out):
    """Add G x to `out` in place, where G is the constraint Jacobian."""
    rows, columns, _ = jacobian_entries_of(f.ldl_program)
    for k in range(rows.size):
        out[rows[k]] += w.jacobian_values[k] * x[columns[k]]


@compiled
def _fill_gamma(f, w, t, q, v):
    """Store gamma in w.Gamma; return DONE, or NEEDS_DENSE if neither a callback nor a traced program computes it."""
    w.Gamma[:] = 0.0
    if f.gamma_given == 1:
        f.gamma(t, q, v, f.p, w.Gamma)
        return DONE
    return DONE if gamma_by_program(f, w, t, q, v) else NEEDS_DENSE


@compiled
def _failure_of_accelerations(w, t, q):
    """Record which callback returned the values that made an acceleration non-finite; return NOT_FINITE."""
    if not finite_vector(w.Gamma):
        return not_finite(w, GAMMA, t, q)
    if not finite_vector(w.Q):
        return not_finite(w, FORCE, t, q)
    return not_finite(w, MASS if not finite_vector(w.mass_values) else -1, t, q)


@compiled
def _solve_system(f, w, r, c, a, lam):
    """Solve M a + G^T lam = r and G a = c (G: constraint Jacobian) by the factors in w; store `a`, lam; return DONE."""
    n = r.size
    copy(r, w.unknowns[:n])
    copy(c, w.unknowns[n:])
    solve_unknowns(f, w, n_refinements(w))
    copy(w.unknowns[:n], a)
    copy(w.unknowns[n:], lam)
    return DONE


@compiled
def _compute_accelerations(f, w, t, q, v, a):
    """Store accelerations at (q, v) in `a` and multipliers in w.z, by the factors in w; return a code."""
    w.n_evaluations += 1
    code = _fill_gamma(f, w, t, q, v)
    if code != DONE:
        return code
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    _solve_system(f, w, w.Q, w.Gamma, a, w.z)
    return DONE if finite_vector(a) else _failure_of_accelerations(w, t, q)


@compiled
def _compute_multipliers(f, w, lam):
    """Copy the multipliers in w.z to lam; if rows are redundant, reduce lam to the least norm; return a code."""
    copy(w.z, lam)
    return least_norm(f, w, lam) if w.rows_v.size < lam.size else DONE


@compiled
def _find_least_correction(f, w):
    """Store in w.unknowns[:n_q] the solution x of C_q x = w.g with the least x^T M x; return max|x|, inf for a NaN."""
    n = w.unknowns.size - w.g.size
    w.unknowns[:n] = 0.0
    copy(w.g, w.unknowns[n:])
    solve_unknowns(f, w, 0)
    return largest_of(w.unknowns[:n]) if finite_vector(w.unknowns[:n]) else np.inf


@compiled
def _is_on_constraints(f, w, q):
    """Return True if all values C_i of constraints in w.C are rounding errors, see ROUNDING_OF_ROWS."""
    rows, columns, _ = jacobian_entries_of(f.ldl_program)
    largest_terms = w.solutions[: w.g.size]
    largest_terms[:] = 0.0
    for k in range(rows.size):
        largest_terms[rows[k]] = max(largest_terms[rows[k]], abs(w.jacobian_values[k] * q[columns[k]]))
    are_satisfied = True
    for i in range(largest_terms.size):
        are_satisfied = are_satisfied and abs(w.C[i]) <= ROUNDING_OF_ROWS * largest_terms[i]
    return are_satisfied


@compiled
def _project_state(f, w, t, q, v, tolerance):
    """Project (q, v) onto the constraints in place, until corrections are at most `tolerance`; return a code.

    On return, the factors in w are those at q before the last correction.
    """
    last_correction = np.inf
    tolerance = max(tolerance, MIN_CORRECTION * w.rounded)
    for _ in range(MAX_ITERATIONS):
        code = factor_equations_at(f, w, t, q)
        if code != DONE:
            return code
        w.n_inner += 1
        constraint_rates(f, w, t, q, w.Rate)
        copy(w.Rate, w.g)
        _add_jacobian_times(f, w, v, w.g)
        for i in range(w.g.size):
            w.g[i] = -w.g[i]
        correction_v = _find_least_correction(f, w)
        if not np.isfinite(correction_v):
            return not_finite(w, RATE, t, q)
        for j in range(v.size):
            v[j] += w.unknowns[j]
        w.C[:] = 0.0
        f.constraint(t, q, f.p, w.C)
        for i in range(w.g.size):
            w.g[i] = -w.C[i]
        correction_q = _find_least_correction(f, w)
        if not np.isfinite(correction_q):
            return not_finite(w, CONSTRAINT, t, q)
        is_last = correction_q <= tolerance and correction_v <= tolerance * max(1.0, largest_of(v))
        is_last = is_last or correction_q <= w.pivot * tolerance
        if not is_last and correction_q > CONTRACTION * last_correction:
            limit = ROUNDING_OF_CORRECTIONS * largest_of(q)
            # corrections do not become smaller. If this correction may be due to rounding, return DONE without applying
            # it, because rounding errors would move light bodies much more than heavy ones
            return (
                DONE
                if correction_q <= limit or (correction_q <= AMPLIFICATION * limit and _is_on_constraints(f, w, q))
                else INNER_DIVERGED
            )
        for j in range(q.size):
            q[j] += w.unknowns[j]
        if is_last:
            return DONE
        last_correction = max(correction_q, tolerance)
    return INNER_DIVERGED


@compiled
def _check_redundant_rows(f, w, t, q, v):
    """Return DONE if (q, v) satisfies all constraints, else ROWS_CONTRADICT; w must contain C_q and C_t at (t, q)."""
    w.C[:] = 0.0
    f.constraint(t, q, f.p, w.C)
    size, speed = max(1.0, largest_of(q)), max(1.0, largest_of(v))
    copy(w.Rate, w.g)
    _add_jacobian_times(f, w, v, w.g)
    rows, _, _ = jacobian_entries_of(f.ldl_program)
    row_maxima = w.solutions[: w.g.size]
    row_maxima[:] = 0.0
    for k in range(rows.size):
        row_maxima[rows[k]] = max(row_maxima[rows[k]], abs(w.jacobian_values[k]))
    for i in range(w.g.size):
        if abs(w.C[i]) > MAX_VIOLATION * size * row_maxima[i] or abs(w.g[i]) > MAX_VIOLATION * speed * row_maxima[i]:
            w.contradiction = i
            return ROWS_CONTRADICT
    return DONE


@compiled
def _do_task_between_evaluations(f, w, task, t, q, v, a, lam):
    """Do a task from FIND_NULL_SPACE to SOLVE (tasks.py); return a code, NEEDS_DENSE if the task needs a dense form."""
    if task == tasks.FIND_NULL_SPACE:
        return factor_equations_at(f, w, t, q)
    if task == tasks.RENEW_PARTITION:
        return choose_rows(f, w, t, q)
    if task == tasks.PREPARE_MASS:
        fill_mass_values(f, w, t, q)
        return DONE if finite_vector(w.mass_values) else not_finite(w, MASS, t, q)
    if task == tasks.CHECK_REDUNDANT:
        return _check_redundant_rows(f, w, t, q, v)
    if task == tasks.SOLVE:
        return _solve_system(f, w, q, v, a, lam)
    return NEEDS_DENSE


@kernel(INNER)
def sparse_inner_loop(f, w, task, t, q, v, tolerance, a, lam):
    """Do a `task` (see tasks.py) at the state (q, v) by sparse factors; return a code.

    The task SOLVE solves M a + G^T lam = r and G a = c (G: constraint Jacobian); its arguments q and v contain r and c.
    """
    if task in (tasks.EVALUATE, tasks.EVALUATE_WITHOUT_PROJECTION):
        code = STOPPED if w.time_is_up == 1.0 else DONE
        if code == DONE and task == tasks.EVALUATE and w.nearly_singular == PROJECT_STAGES:
            code = _project_state(f, w, t, q, v, tolerance)
        if code == DONE:
            code = factor_equations_at(f, w, t, q)
        return _compute_accelerations(f, w, t, q, v, a) if code == DONE else code
    if task == tasks.MULTIPLIERS:
        return _compute_multipliers(f, w, lam)
    if task >= tasks.FIND_NULL_SPACE:
        return _do_task_between_evaluations(f, w, task, t, q, v, a, lam)
    code = DONE
    if task != tasks.ACCELERATIONS:
        code = _project_state(f, w, t, q, v, tolerance if task == tasks.PROJECT else 0.0)
        if code != DONE or task == tasks.RESTORE:
            return code
    code = _compute_accelerations(f, w, t, q, v, a)
    if code != DONE:
        return code
    code = _compute_multipliers(f, w, lam)
    # accelerations are wrong if w.M has nonzero entries that the elimination program does not read
    return code if w.M.size == 0 or not has_new_entries(w.M, w.mass_pattern) else NEEDS_DENSE

"""Partition coordinates by LU: choose independent coordinates and rows, and compute the dependent coordinates.

Dependent positions follow from Newton's method, the inner loop of the paper; dependent velocities follow from linear
equations. The paper is Zhang & Zhang (2016), doi 10.1007/s11071-016-2682-8. `f` is the kit, `w` the workspace.
"""

import numpy as np

from twoloop.kernels.data.common import CONSTRAINT, JACOBIAN, compiled, finite, merged, not_finite
from twoloop.kernels.data.indices import (
    DONE,
    FIXED_ORDER,
    INNER_DIVERGED,
    NULL_SPACE,
    RANK_DIFFERS,
    ROWS_CONTRADICT,
    SINGULAR,
)
from twoloop.kernels.evaluation.constraints import (
    clear_rows,
    constraint_rates,
    constraint_rows,
    gather_independent_columns,
    kinematics,
    row_residual,
)
from twoloop.kernels.linalg.dense import contains, copy_matrix, largest_of, update_pattern
from twoloop.kernels.linalg.markowitz_lu import (
    SIZE,
    columns_of,
    determinant_sign,
    factor,
    make_program,
    rows_of,
    solve,
    solve_rows,
)

LARGE_COLUMN = 16.0  # columns of angles with larger entries are scaled when pivots are chosen
RANK_TOLERANCE = 1e-11  # a pivot, or the ratio of the smallest to the largest pivot, counts as zero up to this limit
PARTITION_CHANGED = -1  # return code: the task succeeded, as for DONE, and the partition has changed
MAX_ROWS_ELIMINATED = 200  # with more independent rows than this, `min_pivot_ratio` returns w.pivot to save time
# a partition is poor if the sensitivity of dependent to independent coordinates exceeds its first value by this factor
SENSITIVITY_GROWTH = 3.0


@compiled
def scale_rows(A):
    """Scale each row of A in place by a power of two, so that its largest entry is about 1."""
    for i in range(A.shape[0]):
        largest = largest_of(A[i])
        if largest > 0.0 and largest < np.inf:
            scale = 2.0 ** -np.round(np.log2(largest))
            for j in range(A.shape[1]):
                A[i, j] *= scale


@merged
def _has_entry_one(row):
    has_one = False
    for entry in row:
        has_one = has_one or abs(entry) == 1.0
    return has_one


@compiled
def scale_large_columns(A):
    """Scale columns of angles in A, which are large if lengths are in mm, by powers of two; largest entry: about 1.

    Otherwise they would yield pivots because of their unit only. In a column of an angle, an entry exceeds LARGE_COLUMN
    in a row that also has an entry of exactly 1 or -1, as in x - L cos(angle) = 0. Columns of small entries are not
    scaled, as entries become small near singular positions.
    """
    for j in range(A.shape[1]):
        largest, is_angle = 0.0, False
        for i in range(A.shape[0]):
            largest = max(largest, abs(A[i, j]))
            is_angle = is_angle or (abs(A[i, j]) > LARGE_COLUMN and _has_entry_one(A[i]))
        if is_angle and largest < np.inf:
            scale = 2.0 ** -np.round(np.log2(largest))
            for i in range(A.shape[0]):
                A[i, j] *= scale


@merged
def _max_abs_from_column(row, first):
    maximum = 0.0
    for j in range(first, row.size):
        if abs(row[j]) > maximum:  # false for a NaN, which is skipped
            maximum = abs(row[j])
    return maximum


@compiled
def full_pivoting(A, order, row_order, row_maxima, first, last, max_rank):
    """Continue the Gaussian elimination of a matrix A in place with full pivoting; return the rank.

    Earlier calls have eliminated the pivots before index `first`. Further pivots are chosen in the rows before index
    `last`, until there are `max_rank` pivots in all, or all entries left are at most RANK_TOLERANCE. The indices in
    `order` and `row_order` are permuted like the columns and rows of A; `row_maxima` is scratch.
    """
    n_q = A.shape[1]
    k = first
    for i in range(k, last):
        row_maxima[i] = _max_abs_from_column(A[i], k)
    while k < min(last, n_q) and k < max_rank:
        pivot_row = k
        for i in range(k + 1, last):
            if row_maxima[i] > row_maxima[pivot_row]:
                pivot_row = i
        if not row_maxima[pivot_row] > RANK_TOLERANCE:
            return k
        pivot_column = k
        while abs(A[pivot_row, pivot_column]) != row_maxima[pivot_row]:
            pivot_column += 1
        if pivot_row != k:
            row_order[k], row_order[pivot_row] = row_order[pivot_row], row_order[k]
            row_maxima[pivot_row] = row_maxima[k]
            for j in range(n_q):
                A[k, j], A[pivot_row, j] = A[pivot_row, j], A[k, j]
        if pivot_column != k:
            order[k], order[pivot_column] = order[pivot_column], order[k]
            for i in range(A.shape[0]):
                A[i, k], A[i, pivot_column] = A[i, pivot_column], A[i, k]
        for i in range(k + 1, A.shape[0]):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, n_q):
                    A[i, j] -= factor * A[k, j]
                if i < last:
                    row_maxima[i] = _max_abs_from_column(A[i], k + 1)
        k += 1
    return k


@compiled
def min_pivot_ratio(f, w, t, q):
    """Return the ratio of the smallest to the largest pivot of [C_q; A] at (t, q), to detect singular positions.

    A: rows of the non-holonomic constraints. The ratio is 0 if the rank is below that of the partition. Rows
    are not scaled: this would hide small norms of rows at a singular position. In the fixed-order form, or with more
    than MAX_ROWS_ELIMINATED rows, return the smallest pivot of the last factors or partition instead, to save time.
    """
    if f.form == FIXED_ORDER or w.rows_v.size > MAX_ROWS_ELIMINATED:
        return w.pivot
    if w.rows_v.size == 0:
        return 1.0
    G = w.Gx
    G[:, :] = 0.0
    constraint_rows(f, w, t, q, G)
    scale_large_columns(G)
    rank = _pivot_rows(w, w.Rate.size, w.rows_v.size)
    if rank < w.rows_v.size:
        return 0.0
    smallest, largest = np.inf, 0.0
    for k in range(rank):
        smallest, largest = min(smallest, abs(G[k, k])), max(largest, abs(G[k, k]))
    return smallest / largest


@compiled
def _pivot_rows(w, n_rows, max_rank):
    """Find pivots in w.Gx[:n_rows]; store orders of columns (w.order) and rows (w.row_order); return the rank."""
    for j in range(w.order.size):
        w.order[j] = j
    for i in range(w.row_order.size):
        w.row_order[i] = i
    return full_pivoting(w.Gx, w.order, w.row_order, w.g, 0, n_rows, max_rank)


@compiled
def _find_pivot_order(w, max_rank, max_rank_v):
    """Find pivots of w.Gx = [C_q; A], first in C_q, then in A, the rows of the non-holonomic constraints.

    Store the indices of the pivots' rows in w.row_order, and of the pivots' columns in w.order. Return the rank of C_q,
    at most `max_rank`, and the rank of [C_q; A], at most `max_rank_v`.
    """
    G, order, row_order = w.Gx, w.order, w.row_order
    n_c, n_rows = w.C.size, w.Rate.size
    scale_large_columns(G)
    scale_rows(G)
    rank = _pivot_rows(w, n_c, max_rank)
    w.pivot = abs(G[rank - 1, rank - 1]) if rank > 0 else 1.0
    if n_rows == n_c:
        return rank, rank
    last = rank  # pivots are chosen in rows before `last`: the loop puts rows of A after the independent rows of C_q
    for i in range(n_c, n_rows):
        row_order[last], row_order[i] = row_order[i], row_order[last]
        for j in range(G.shape[1]):
            G[last, j], G[i, j] = G[i, j], G[last, j]
        last += 1
    return rank, full_pivoting(G, order, row_order, w.g, rank, last, max_rank_v)


@compiled
def smallest_pivot(f, w, t, q):
    """Return the smallest pivot of C_q at (t, q), with rows scaled to maxima of 1; 0 if C_q has lost rank."""
    rank = w.rows.size
    if rank == 0:
        return 1.0
    w.Gx[:, :] = 0.0
    constraint_rows(f, w, t, q, w.Gx)
    scale_large_columns(w.Gx)
    scale_rows(w.Gx)
    return abs(w.Gx[rank - 1, rank - 1]) if _pivot_rows(w, w.C.size, rank) == rank else 0.0


@merged
def _copy_in_ascending_order(source, target):
    for k in range(source.size):
        i = k
        while i > 0 and target[i - 1] > source[k]:
            target[i] = target[i - 1]
            i -= 1
        target[i] = source[k]


@compiled
def _adopt_pivot_order(w):
    """Store the partition that `_find_pivot_order` has found, and write programs that factor its dependent columns.

    Rows of pivots become independent rows, and columns of pivots become dependent coordinates. Return False if the
    columns of the dependent coordinates in the Jacobian w.G are singular.
    """
    rank, rank_v = w.rows.size, w.rows_v.size
    # indices are stored in ascending order, so that equal sets of coordinates are equal partitions
    _copy_in_ascending_order(w.row_order[:rank], w.rows)
    _copy_in_ascending_order(w.order[:rank], w.dependent)
    _copy_in_ascending_order(w.order[rank:], w.independent)
    if w.Rate.size > w.C.size:
        _copy_in_ascending_order(w.row_order[:rank_v], w.rows_v)
        _copy_in_ascending_order(w.order[:rank_v], w.dependent_v)
        _copy_in_ascending_order(w.order[rank_v:], w.independent_v)
    w.sensitivity = 0.0
    w.max_coefficient = 0.0
    w.orientation = 0.0
    w.generation += 1.0
    if w.G_of_S.size > 0:
        w.G_of_S[0, 0] = np.nan
    if rank_v < w.Rate.size:
        w.index_a[SIZE] = 0  # 0: the augmented matrix, which contains the independent rows, needs a new program
    return write_programs(w)


@compiled
def write_programs(w):
    """Write programs that factor dependent columns of the Jacobian w.G; return False if these columns are singular."""
    _record_columns_of_entries(w)
    w.factored = 0.0
    is_regular = make_program(w.G, w.pattern, w.rows, w.dependent, w.index, w.values)
    if is_regular and w.Rate.size > w.C.size:
        is_regular = make_program(w.G, w.pattern, w.rows_v, w.dependent_v, w.index_v, w.values_v)
    return is_regular


@compiled
def _record_columns_of_entries(w):
    """List in w.row_entries, for each row i of w.pattern, the columns where it is 1, from index w.row_entries[i] on."""
    n_rows = w.Rate.size
    index = n_rows + 1
    for i in range(n_rows):
        w.row_entries[i] = index
        for j in range(w.pattern.shape[1]):
            if w.pattern[i, j] != 0.0:
                w.row_entries[index] = j
                index += 1
    w.row_entries[n_rows] = index


@compiled
def record_entries(w):
    """Set w.pattern to 1 where w.G is not zero; return True if w.pattern changes: eliminations need new programs."""
    if not update_pattern(w.G, w.pattern):
        return False
    w.index_a[SIZE] = 0
    return True


@compiled
def choose_partition(f, w, t, q):
    """Choose and store the dependent and independent coordinates and the independent rows at (t, q); return a code.

    Codes: DONE; SINGULAR if a rank is lower than in the previous partition; RANK_DIFFERS if this is the first partition
    and the workspace is allocated for other ranks: then w.rank becomes the rank of C_q, and w.rank_v that of all rows.
    """
    w.entries[:] = 0.0
    constraint_rows(f, w, t, q, w.G)
    record_entries(w)
    copy_matrix(w.G, w.Gx)
    w.n_factorizations += 1
    w.n_partitions += 1
    is_first = w.generation == 0.0
    max_rank, max_rank_v = (w.C.size, w.Rate.size) if is_first else (w.rows.size, w.rows_v.size)
    rank, rank_v = _find_pivot_order(w, max_rank, max_rank_v)
    if is_first and (rank != w.rows.size or rank_v != w.rows_v.size):
        w.rank, w.rank_v = rank, rank_v
        return RANK_DIFFERS
    if rank < w.rows.size or rank_v < w.rows_v.size:
        return SINGULAR
    return DONE if _adopt_pivot_order(w) else SINGULAR


@compiled
def adopt_partition_of_midpoint(f, w, t_mid, state, new_state):
    """Adopt the partition that full pivoting chooses at the middle of an attempted step; return a code.

    Codes: PARTITION_CHANGED (the caller repeats the step), DONE (the partition was the same) or SINGULAR. The purpose
    is symmetry in time: the same step taken backwards has the same middle, and thus the same partition. A partition
    that is used until it is poor would depend on the direction of time.

    The middle is the mean of the states at the beginning (`state`) and end (`new_state`) of the attempted step. The
    repeated step ends at a slightly different state (difference O(h^(p+1)) for order p), for which the choice is not
    made again. So symmetry is lost if two partitions are equally good up to this difference.
    """
    n = w.Q.size
    for j in range(n):
        w.x[j] = 0.5 * (state[j] + new_state[j])
    w.entries[:] = 0.0
    constraint_rows(f, w, t_mid, w.x, w.G)
    has_new_entry = record_entries(w)
    copy_matrix(w.G, w.Gx)
    rank, rank_v = w.rows.size, w.rows_v.size
    w.n_factorizations += 1
    new_rank, new_rank_v = _find_pivot_order(w, rank, rank_v)
    if new_rank < rank or new_rank_v < rank_v:
        return SINGULAR
    is_same = _is_same_set(w.independent, w.order[rank:])
    if is_same and not has_new_entry and _is_same_set(w.independent_v, w.order[rank_v:]):
        return DONE
    w.n_partitions += 1
    return PARTITION_CHANGED if _adopt_pivot_order(w) else SINGULAR


@merged
def _is_same_set(a, b):
    is_same = True
    for number in a:
        is_same = is_same and contains(b, number)
    return is_same


@compiled
def choose_oriented_partition(f, w, t, q):
    """Choose a partition; store sign(det C_qd) in w.orientation (C_qd: dependent columns of C_q); return a code."""
    code = choose_partition(f, w, t, q)
    w.orientation = 0.0
    if code != DONE:
        return code
    ratio = min(factor(w.entries, w.index, w.values), factor(w.entries, w.index_v, w.values_v))
    if not ratio > RANK_TOLERANCE:
        return SINGULAR
    w.orientation = determinant_sign(w.index, w.values)
    return DONE


@compiled
def _largest_coefficient(w):
    """Express redundant rows by independent rows, all scaled to maxima of 1; return the largest |coefficient|."""
    rows = rows_of(w.index_v)
    largest = 0.0
    begin = 0
    for row in range(w.Rate.size):
        if contains(w.rows_v, row):
            continue
        row_scale = _max_abs_from_column(w.G[row], 0)
        for k in range(rows.size):
            scaled_coefficient = abs(w.minimum[begin + k]) * _max_abs_from_column(w.G[rows[k]], 0)
            if scaled_coefficient > largest * row_scale:
                largest = scaled_coefficient / row_scale
        begin += rows.size
    return largest


@compiled
def partition_is_poor(w):
    """Return True if the dependent coordinates are so sensitive to the independent ones that a new partition is needed.

    The sensitivity is max|C_qd^-1 C_qi| (w.D); C_qd and C_qi are the columns of the dependent and the independent
    coordinates in C_q. It is near 1 after full pivoting, and grows without bound where the independent coordinates no
    longer determine the dependent ones. Also return True if the independent rows become dependent
    while the rank stays the same: redundant rows then have large coefficients as combinations of independent rows.
    """
    largest = 0.0
    for j in range(w.independent_v.size):
        largest = max(largest, largest_of(w.D[j]))
    if w.sensitivity == 0.0:  # 0: not known, because this is the first check of a new partition
        w.sensitivity = max(largest, 1.0)
    if not largest <= SENSITIVITY_GROWTH * w.sensitivity:
        return True
    # do not check coefficients if no row is redundant, nor in the fixed-order form (w.factors not empty), whose factors
    # show when independent rows have become dependent and must be replaced
    if w.rows_v.size == w.Rate.size or w.factors.size > 0:
        return False
    coefficient = _largest_coefficient(w)
    if w.max_coefficient == 0.0:
        w.max_coefficient = max(coefficient, 1.0)
    return not coefficient <= SENSITIVITY_GROWTH * w.max_coefficient


MAX_ITERATIONS = 25  # largest number of Newton iterations for positions; quadratic convergence needs 2 to 5
CONTRACTION = 0.5  # Newton's method counts as converging while each correction is at most this part of the previous one
ROUNDING_OF_CORRECTIONS = 1e-12  # corrections of positions up to this size, relative to max|q|, may be due to rounding
# if all constraints hold up to rounding, the limit ROUNDING_OF_CORRECTIONS is multiplied by this factor. Reason: a
# rounding error of a position of 1 m turns a rod of 1 mm by 1e-13 rad, and a chain of rods by more
AMPLIFICATION = 1e3
# constraint C_i = 0 holds up to rounding if |C_i| is at most this fraction of its largest term: the largest |G_ij q_j|
# over the coordinates q_j, with the Jacobian G = C_q
ROUNDING_OF_ROWS = 2e-15
ROUNDING_ERROR = 1e-15  # rounding error of a position, relative to max|q|; smaller corrections need no new C_q
MIN_CORRECTION = 10.0  # the tolerance of a projection is at least this multiple of the rounding error of positions
# let g be the largest |entry| of row i of the Jacobian C_q. Constraint i is violated if |C_i| exceeds this number times
# g max(1, max|q|), or if |(C_q v + C_t)_i| exceeds this number times g max(1, max|v|)
MAX_VIOLATION = 1e-7


@merged
def projection_tolerance(w, theta, size):
    """Return the largest correction at which a projection by generated code has converged; size: max|q|.

    Angles may grow by thousands of rad in a run. Projections by a partition keep the tolerance of the start, and so do
    all if a singular position was near: what a larger one leaves there may turn the motion to another branch.
    """
    size = 0.0 if w.nearly_singular == 1.0 else size
    return max(theta, MIN_CORRECTION * max(w.rounded, ROUNDING_ERROR * size))


@compiled
def _factor_in_new_order(w, t, q):
    """Factor the dependent columns of the Jacobian w.G in a new order; return DONE, SINGULAR or NOT_FINITE."""
    record_entries(w)
    if not finite(w.G):
        return not_finite(w, JACOBIAN, t, q)
    if not write_programs(w):
        return SINGULAR
    ratio = min(factor(w.entries, w.index, w.values), factor(w.entries, w.index_v, w.values_v))
    return DONE if ratio > RANK_TOLERANCE else SINGULAR


@merged
def factor_dependent_columns(w, t, q):
    """Factor the dependent columns of the Jacobian w.G by the programs in w; return DONE, SINGULAR or NOT_FINITE."""
    w.factored = 0.0
    ratio = factor(w.entries, w.index, w.values)
    w.n_factorizations += 1
    if w.Rate.size > w.C.size:
        ratio = min(ratio, factor(w.entries, w.index_v, w.values_v))
        w.n_factorizations += 1
    # if pivots differ too much, the cause may be a NaN or an unsuitable order of elimination, not a singular matrix
    return DONE if ratio > RANK_TOLERANCE else _factor_in_new_order(w, t, q)


@merged
def evaluate_and_factor_columns(f, w, t, q):
    """Store the Jacobian at (t, q) in w.G, and factor its dependent columns; return DONE, SINGULAR or NOT_FINITE."""
    w.has_gamma = 0.0
    clear_rows(f, w)
    constraint_rows(f, w, t, q, w.G)
    return factor_dependent_columns(w, t, q)


@compiled
def is_rounding_of_positions(w, q, correction):
    """Return True if `correction`, the largest change of a position, may be due to rounding (see AMPLIFICATION)."""
    limit = ROUNDING_OF_CORRECTIONS * largest_of(q)
    return correction <= limit or (correction <= AMPLIFICATION * limit and _is_on_constraints(w, q))


@compiled
def _is_on_constraints(w, q):
    """Return True if all values C_i of constraints in w.C are rounding errors, see ROUNDING_OF_ROWS."""
    for i in range(w.C.size):
        largest_term = 0.0
        for p in range(w.row_entries[i], w.row_entries[i + 1]):
            largest_term = max(largest_term, abs(w.G[i, w.row_entries[p]] * q[w.row_entries[p]]))
        if not abs(w.C[i]) <= ROUNDING_OF_ROWS * largest_term:
            return False
    return True


@merged
def restore_positions(f, w, t, q, v, tolerance, reuse_limit):
    """Solve C(t, q) = 0, eq. (15) of the paper, by Newton's method for the dependent positions in q; return a code.

    The iteration ends after a correction of at most `tolerance`. If this correction was larger than `reuse_limit`, the
    Jacobian is evaluated and factored again at the final q; otherwise w keeps the Jacobian from before this correction.
    The callback `kinematics`, if the user gave one, evaluates C, C_q and gamma (w.Gamma) together.
    """
    last_correction = np.inf
    has_converged = w.C.size == 0
    is_fused = f.kinematics_given == 1
    for _ in range(MAX_ITERATIONS):
        if is_fused:
            kinematics(f, w, t, q, v)
            code = factor_dependent_columns(w, t, q)
        else:
            code = evaluate_and_factor_columns(f, w, t, q)
        if code != DONE or has_converged:
            return code
        if not is_fused:
            w.C[:] = 0.0
            f.constraint(t, q, f.p, w.C)
        w.n_inner += 1
        rows, columns = rows_of(w.index), columns_of(w.index)
        for k in range(rows.size):
            w.z[k] = w.C[rows[k]]
        solve(w.index, w.values, w.z)
        correction = 0.0
        for k in range(rows.size):
            if not np.isfinite(w.z[k]):
                return not_finite(w, CONSTRAINT, t, q)
            q[columns[k]] -= w.z[k]
            correction = max(correction, abs(w.z[k]))
        if correction <= reuse_limit:
            return DONE
        has_converged = correction <= tolerance
        if not has_converged and correction > CONTRACTION * last_correction:
            # accept a correction that is due to rounding; otherwise report failure: Newton's method has left its region
            # of convergence, and could converge to another assembly of the mechanism
            has_converged = is_rounding_of_positions(w, q, correction)
            if not has_converged:
                return INNER_DIVERGED
        last_correction = correction
    return INNER_DIVERGED


@merged
def find_null_space(f, w, t, q):
    """Store in w.D how dependent velocities follow from independent ones, by the factors of the Jacobian w.G.

    Row j of w.D contains the dependent velocities, without drives, if independent velocity j is 1 and the others are 0.
    These rows span the null space of w.G. The last row contains dependent velocities due to drives alone.
    """
    if f.kinematics_given == 0 or w.has_gamma == 0.0:
        constraint_rates(f, w, t, q, w.Rate)
    gather_independent_columns(w.G, w.Rate, rows_of(w.index_v), w.independent_v, w.D)
    is_driven = f.constraint_rate_given == 1 or f.nonholonomic_rate_given == 1
    solve_rows(w.index_v, w.values_v, w.D, w.D.shape[0] if is_driven else w.D.shape[0] - 1)


@merged
def restore_velocities(f, w, t, q, v, reuse_limit):
    """Compute the dependent velocities v_d in v from the independent ones, v_i, by the factors in w.

    v_d solves G_d v_d = -(C_t, b) - G_i v_i, eq. (14) of the paper. G_d and G_i are the dependent and independent
    columns of [C_q; A]; A v + b = 0 are the non-holonomic constraints. If a velocity changes by more than
    `reuse_limit`, set w.has_gamma to 0: w.Gamma from the callback `kinematics` is no longer valid.
    """
    rows, columns = rows_of(w.index_v), columns_of(w.index_v)
    n_dof = w.independent_v.size
    w.has_gamma = float(f.kinematics_given)
    if f.form == NULL_SPACE:
        find_null_space(f, w, t, q)
        for k in range(rows.size):
            w.z[k] = w.D[n_dof, k]
        for j in range(n_dof):
            speed = v[w.independent_v[j]]
            for k in range(rows.size):
                w.z[k] += w.D[j, k] * speed
    else:
        if w.has_gamma == 0.0:
            constraint_rates(f, w, t, q, w.Rate)
        row_residual(w, v, rows)
        solve(w.index_v, w.values_v, w.z)
        for k in range(rows.size):
            w.z[k] = v[columns[k]] - w.z[k]
    change = 0.0
    for k in range(rows.size):
        change = max(change, abs(v[columns[k]] - w.z[k]))
        v[columns[k]] = w.z[k]
    if not change <= reuse_limit:
        w.has_gamma = 0.0


@compiled
def check_all_rows(f, w, t, q, v):
    """Return DONE if the accepted state (q, v) satisfies all constraints, also redundant ones, else ROWS_CONTRADICT.

    If a constraint is violated by more than MAX_VIOLATION, store its index in w.contradiction; return ROWS_CONTRADICT.
    On entry, w.G must contain the Jacobian of all constraints at this state, and w.Rate the rates (C_t, b).
    """
    w.C[:] = 0.0
    f.constraint(t, q, f.p, w.C)
    size, speed = max(1.0, largest_of(q)), max(1.0, largest_of(v))
    for i in range(w.Rate.size):
        largest, velocity_violation = largest_of(w.G[i]), w.Rate[i]
        for j in range(q.size):
            velocity_violation += w.G[i, j] * v[j]
        is_violated = abs(w.C[i]) > MAX_VIOLATION * size * largest if i < w.C.size else False
        if is_violated or abs(velocity_violation) > MAX_VIOLATION * speed * largest:
            w.contradiction = i
            return ROWS_CONTRADICT
    return DONE

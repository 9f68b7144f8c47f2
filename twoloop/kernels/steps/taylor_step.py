"""Step by the Taylor series of the motion, computed from the index-3 equations themselves.

Let A v + b = 0 be the non-holonomic constraints, and G = [C_q; A]. The motion satisfies G v + (C_t, b) = 0 and
M a + G^T lam = Q. The Taylor coefficients a_k and lam_k of order k follow from those of lower order by a linear system,

    M_0 a_k + G_0^T lam_k = r_k,    G_0 a_k = c_k,

whose matrix has already been factored for the accelerations at the beginning of the step. Each order requires one
solution, and no derivatives of the constraints beyond G (J. D. Pryce's structural analysis, BIT 41 (2001), 364-394,
finds these orders for any equations). The right-hand sides r_k and c_k are computed by a program, see
`twoloop.generate.series`, with recurrences for Taylor coefficients (R. E. Moore, Interval Analysis (1966), ch. 11).

The order of the series depends on the tolerance. The step size is such that the last terms of the series equal the
tolerance (A. Jorba and M. Zou, Experimental Mathematics 14 (2005), 99-117). The unit of time is about the step size,
so that coefficients neither underflow nor overflow. The end of the step is projected onto the constraints.

If there is no generated code, the program of the series is interpreted, order by order. `f`: kit, `w`: workspace.
"""

import numpy as np

from twoloop.kernels.control.step_size import defect_ratio, prediction_error, store_prediction
from twoloop.kernels.data.common import (
    ATTEMPT,
    COMMIT,
    GAP_SLACK,
    Attempt,
    Step,
    compiled,
    gap_ratio,
    inlined,
    kernel,
    merged,
)
from twoloop.kernels.data.indices import ATOL, DEFECT_GAP, DONE, ESTIMATE, FIXED_ORDER, NOT_FINITE, OUTER_DIVERGED, RTOL
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.inner_loop import evaluate_without_projection, project
from twoloop.kernels.evaluation.tasks import EVALUATE_WITHOUT_PROJECTION, SOLVE
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.linalg.saddle_point import solve_with_multipliers

# indices of the scalars in `options`. After the scalars, `options` contains the series program (list of operations that
# computes Taylor coefficients): the offsets of its arrays, then the arrays. Integers are stored as the bits of floats
(
    ORDER,  # order of the Taylor series of the positions q
    THETA,  # a projection has converged if its last correction is at most this, see `project`
    N_NODES,  # number of quantities of the series program: inputs, unknowns and results of operations
    EARLY_WIDTH,  # number of early operations (on t and q only), rounded up to a multiple of eight
    LATE_WIDTH,  # number of late operations (on t, q and v), rounded up to a multiple of eight
    KEEP,  # 1: all steps are parts of one long step, and use the series about its beginning; 0: each step has its own
    N_SCALARS,
) = range(7)
# 13 arrays describe a list of operations (OperationGroups in twoloop.generate.series). Array 0 contains the groups of
# operations of the same kind, arrays 1 to 6 the first argument of each operation, arrays 7 to 12 the second argument
GROUPS, FIRST, SECOND, N_TABLE = 0, 1, 7, 13
# six arrays describe a list of affine expressions (Sums in twoloop.generate.series), such as first arguments. Three
# have an entry per expression: CONSTANT, and quantity (COLUMN) and factor (COEFFICIENT) of the first term. Three have
# an entry per further term: its expression (ROW), quantity (MORE_COLUMN) and factor (MORE_COEFFICIENT)
COLUMN, COEFFICIENT, CONSTANT, ROW, MORE_COLUMN, MORE_COEFFICIENT, N_SUMS = range(7)
SUM_INDICES = N_SUMS  # seventh array, if the expressions belong to equations: index of each expression's equation
# the series program is a list of arrays; its four parts begin at these indices. EARLY: operations on t and q only.
# LATE: operations on t, q and v. ROWS, BALANCE: affine expressions for G v + (C_t, b) and Q - G^T lam - M a
EARLY, LATE, ROWS = 0, N_TABLE, 2 * N_TABLE
BALANCE, N_ARRAYS = ROWS + N_SUMS + 1, ROWS + 2 * (N_SUMS + 1)
# columns of the array GROUPS, which has a row for each group of operations. KIND: kind of operation. BEGIN, END: the
# range of the group's operations. MORE_FIRST and the next column: the range of entries in MORE_COLUMN that belong to
# first arguments. MORE_SECOND and the next column: the range of entries in MORE_COLUMN that belong to second arguments
KIND, BEGIN, END, MORE_FIRST, _, MORE_SECOND, _, N_GROUP = range(8)

# indices of the scalars in `memory`. Two Taylor series of q (ORDER + 1, n_q each) and arrays (`array_views`) follow.
# One series is about the beginning of the step, the other one about the end of the attempted step
(
    HAS_SERIES,  # 1: the series about the beginning of the step has been computed; 0: not yet
    CURRENT,  # index (0 or 1) of the stored series about the beginning of the step
    UNIT,  # unit of time (s) of the series about the beginning of the step
    NEXT_UNIT,  # unit of time (s) of the series about the end of the last attempt
    ALLOWED_SIZE,  # largest step size that the series about the beginning of the step allows, in units of UNIT
    NEXT_ALLOWED_SIZE,  # largest step size that the series about the end of the last attempt allows, in NEXT_UNIT
    TRIED,  # 1: the last attempt has computed the series about its end, where the next step may begin; 0: it has not
    PASSED,  # time (s) from the series' expansion point to the step's beginning; 0 unless steps share a series (KEEP 1)
    TARGET,  # index (0 or 1) of the stored series that `compute_coefficients` overwrites
    # steps are shortened by this factor (at most 1): longer ones would end too far from the constraints; 0: unknown
    DISTANCE_FACTOR,
    ATTEMPTS,  # number of attempts; it determines at which times within a step the defect is evaluated
    SUSPECTED,  # 1: memory[SUSPECT] contains a time that the run has not passed yet; 0: SUSPECT has no meaning
    SUSPECT,  # time (s) at which the defect of a rejected step was too large; the next attempts check it there again
    N_MEMORY_SCALARS,
) = range(14)


def memory_size(order: int, n_q: int, n_rows: int, n_nodes: int, early: int, late: int) -> int:
    """Return the length of `memory`; n_nodes, early, late: options N_NODES, EARLY_WIDTH, LATE_WIDTH."""
    n_orders = order + 2
    scratch = n_orders * (n_nodes + 2 * early + 2 * late) + early + late + n_q + n_rows
    return N_MEMORY_SCALARS + 2 * (order + 1) * n_q + scratch + n_q


@inlined
def series_accelerations(memory, n):
    """Return a view of the last n numbers of `memory`: the accelerations that `_evaluate_series` has computed."""
    return memory[memory.size - n :]


@inlined
def _integer_array(options, index):
    begin, end = int(options[N_SCALARS + index]), int(options[N_SCALARS + index + 1])
    return options[begin:end].view(np.int64)


@inlined
def _float_array(options, index):
    return options[int(options[N_SCALARS + index]) : int(options[N_SCALARS + index + 1])]


@inlined
def series_view(memory, order, n, index):
    """Return series `index` (0 or 1) of q as a vector (faster than a matrix): entry k n + j is coefficient k of q_j."""
    begin = N_MEMORY_SCALARS + int(index) * (order + 1) * n
    return memory[begin : begin + (order + 1) * n]


@merged
def sum_of_products(X, Y, K, total):
    """Sum up products of Taylor coefficients: total[m] = sum of X[j, m] * Y[K - j, m] over 0 < j < K, for all m."""
    for m in range(0, total.size, 8):
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = 0.0
        for j in range(1, K):
            i = K - j
            s0 += X[j, m] * Y[i, m]
            s1 += X[j, m + 1] * Y[i, m + 1]
            s2 += X[j, m + 2] * Y[i, m + 2]
            s3 += X[j, m + 3] * Y[i, m + 3]
            s4 += X[j, m + 4] * Y[i, m + 4]
            s5 += X[j, m + 5] * Y[i, m + 5]
            s6 += X[j, m + 6] * Y[i, m + 6]
            s7 += X[j, m + 7] * Y[i, m + 7]
        total[m] = s0
        total[m + 1] = s1
        total[m + 2] = s2
        total[m + 3] = s3
        total[m + 4] = s4
        total[m + 5] = s5
        total[m + 6] = s6
        total[m + 7] = s7


@merged
def _fill_arguments(options, sums, groups, g, more, values, out):
    """Compute the first or the second arguments of all operations of a group; store these arguments in `out`.

    Arguments are affine expressions in `values`, the Taylor coefficients of one order of all quantities; constants are
    left out, as they belong to order 0. `sums`: index of the first array (COLUMN) that describes these expressions.
    `g`: where the group's row begins in `groups`. `more`: MORE_FIRST for first arguments, MORE_SECOND for second ones.
    """
    column, coefficient = _integer_array(options, sums + COLUMN), _float_array(options, sums + COEFFICIENT)
    for o in range(groups[g + BEGIN], groups[g + END]):
        out[o] = coefficient[o] * values[column[o]]
    row, column = _integer_array(options, sums + ROW), _integer_array(options, sums + MORE_COLUMN)
    coefficient = _float_array(options, sums + MORE_COEFFICIENT)
    for e in range(groups[g + more], groups[g + more + 1]):
        out[row[e]] += coefficient[e] * values[column[e]]


@merged
def _store_sums(options, sums, scale, values, out):
    """Store in `out` scale * (known variable terms of G v + (C_t, b) for ROWS, of Q - G^T lam - M a for BALANCE)."""
    column, coefficient = _integer_array(options, sums + COLUMN), _float_array(options, sums + COEFFICIENT)
    indices = _integer_array(options, sums + SUM_INDICES)
    for o in range(column.size):
        out[indices[o]] = scale * coefficient[o] * values[column[o]]
    row, column = _integer_array(options, sums + ROW), _integer_array(options, sums + MORE_COLUMN)
    coefficient = _float_array(options, sums + MORE_COEFFICIENT)
    for e in range(row.size):
        out[row[e]] += scale * coefficient[e] * values[column[e]]


@compiled
def start_operations(options, table, values, z, x, y):
    """Begin the Taylor series of a list of operations: store the coefficients of order 0 of their results in z.

    `table`: EARLY (operations on t and q) or LATE (on t, q and v). Coefficients of higher orders follow from products
    of two series x and y, which are begun here, too; if the operation is a product, x and y are its arguments. PENDING
    products are set to zero: their second factor depends on accelerations that are not known yet.
    """
    groups = _integer_array(options, table + GROUPS)
    constant, constant_2 = (
        _float_array(options, table + FIRST + CONSTANT),
        _float_array(options, table + SECOND + CONSTANT),
    )
    for g in range(0, groups.size, N_GROUP):
        kind = groups[g]
        _fill_arguments(options, table + FIRST, groups, g, MORE_FIRST, values, x)
        _fill_arguments(options, table + SECOND, groups, g, MORE_SECOND, values, y)
        for o in range(groups[g + BEGIN], groups[g + END]):
            x[o] += constant[o]
            y[o] += constant_2[o]
            if kind == op.PRODUCT:
                z[o] = x[o] * y[o]
            elif kind == op.RECIPROCAL:
                z[o] = y[o] = 1.0 / x[o]
            elif kind == op.SQUARE_ROOT:
                z[o] = x[o] = y[o] = np.sqrt(x[o])
            elif kind == op.EXPONENTIAL:
                z[o] = y[o] = np.exp(x[o])
            elif kind == op.LOGARITHM:
                z[o] = np.log(x[o])
            elif kind == op.ARCTANGENT:
                z[o] = np.arctan(x[o])
            elif kind == op.PENDING:
                z[o] = 0.0
        if kind == op.SINE:
            n_sines = (groups[g + END] - groups[g + BEGIN]) // 2
            for o in range(groups[g + BEGIN], groups[g + BEGIN] + n_sines):
                z[o] = np.sin(x[o])
                z[o + n_sines] = np.cos(x[o])
                y[o], y[o + n_sines] = z[o + n_sines], -z[o]
                x[o] = x[o + n_sines] = 0.0


@merged
def _next_coefficients(options, table, K, values, z, x, y, x0, y0, total):
    """Store the Taylor coefficients of order K > 0 of operations' results z, and of their auxiliary series x and y.

    `table`, x, y: see `start_operations`. x0, y0: order 0 of x and y. `total`: result of `sum_of_products` for order K.
    In a PENDING product, the term with coefficient K of the second factor, which is not known yet, is left out.
    """
    groups = _integer_array(options, table + GROUPS)
    inverse = 1.0 / K
    for g in range(0, groups.size, N_GROUP):
        kind, first, last = groups[g], groups[g + BEGIN], groups[g + END]
        _fill_arguments(options, table + FIRST, groups, g, MORE_FIRST, values, x)
        if kind == op.PENDING:
            for o in range(first, last):
                z[o] = total[o] + x[o] * y0[o]
        elif kind == op.SINE:
            n_sines = (last - first) // 2
            for o in range(first, first + n_sines):
                p = o + n_sines
                u = K * x[o]
                x[o] = x[p] = u
                sine, cosine = (total[o] + u * y0[o]) * inverse, (total[p] + u * y0[p]) * inverse
                z[o], z[p] = sine, cosine
                y[o], y[p] = cosine, -sine
        elif kind == op.PRODUCT:
            _fill_arguments(options, table + SECOND, groups, g, MORE_SECOND, values, y)
            for o in range(first, last):
                z[o] = total[o] + x0[o] * y[o] + x[o] * y0[o]
        elif kind == op.RECIPROCAL:
            for o in range(first, last):
                z[o] = y[o] = -(total[o] + x[o] * y0[o]) * y0[o]
        elif kind == op.SQUARE_ROOT:
            for o in range(first, last):
                z[o] = x[o] = y[o] = 0.5 * (x[o] - total[o]) / x0[o]
        elif kind == op.EXPONENTIAL:
            for o in range(first, last):
                x[o] *= K
                z[o] = y[o] = (total[o] + x[o] * y0[o]) * inverse
        else:
            _fill_arguments(options, table + SECOND, groups, g, MORE_SECOND, values, y)
            for o in range(first, last):
                z[o] = (x[o] - total[o] * inverse) / y0[o]
                x[o] = K * z[o]


@merged
def _fill_second_factors(options, table, values, y):
    """Store in y the second factors of PENDING products, which depend on the accelerations just added to `values`."""
    groups = _integer_array(options, table + GROUPS)
    _fill_arguments(options, table + SECOND, groups, groups.size - N_GROUP, MORE_SECOND, values, y)


@inlined
def array_views(options, memory, n, n_rows):
    """Return views of the nine arrays in `memory` with which `compute_coefficients` computes a Taylor series.

    These are N, X1, Y1, X2, Y2, total1, total2, r and c. Row k of N has the Taylor coefficients of order k of all
    quantities. X1, Y1: series x and y of the operations EARLY, see `start_operations`. X2, Y2: those of LATE. total1,
    total2: sums of products of their coefficients. r (n), c (n_rows): right-hand sides of an order's linear system.
    """
    n_nodes, early, late = int(options[N_NODES]), int(options[EARLY_WIDTH]), int(options[LATE_WIDTH])
    order = int(options[ORDER])
    n_orders = order + 2
    begin = N_MEMORY_SCALARS + 2 * (order + 1) * n
    N = memory[begin : begin + n_orders * n_nodes].reshape((n_orders, n_nodes))
    begin += n_orders * n_nodes
    X1 = memory[begin : begin + n_orders * early].reshape((n_orders, early))
    begin += n_orders * early
    Y1 = memory[begin : begin + n_orders * early].reshape((n_orders, early))
    begin += n_orders * early
    X2 = memory[begin : begin + n_orders * late].reshape((n_orders, late))
    begin += n_orders * late
    Y2 = memory[begin : begin + n_orders * late].reshape((n_orders, late))
    begin += n_orders * late
    total1 = memory[begin : begin + early]
    begin += early
    total2 = memory[begin : begin + late]
    begin += late
    return N, X1, Y1, X2, Y2, total1, total2, memory[begin : begin + n], memory[begin + n : begin + n + n_rows]


@merged
def start_series(options, t, unit, state, N, series, begin_early, x, y, r, c):
    """Begin the series of a motion at t and `state`: store in the matrix N the coefficients that need no accelerations.

    These are orders 0 and 1 of t and q, and order 0 of v and of the operations EARLY. Results of EARLY begin at column
    `begin_early` of N. x, y: see `start_operations`. `unit`: unit of time (s). Set the right-hand sides r, c to zero.
    """
    n = r.size
    r[:], c[:] = 0.0, 0.0
    N[0, 0], N[1, 0] = t, unit
    for j in range(n):
        N[0, 1 + j] = series[j] = state[j]
        N[0, 1 + n + j] = state[n + j]
        N[1, 1 + j] = series[n + j] = unit * state[n + j]
    start_operations(options, EARLY, N[0], N[0, begin_early:], x, y)


@merged
def integrate_coefficients(K, unit, N, series, a):
    """Store the Taylor coefficients of order K of v and of order K + 1 of q, given order K - 1 of the accelerations."""
    n = a.size
    per_v, per_q = unit / K, unit / (K + 1)
    for j in range(n):
        v = per_v * a[j]
        N[K, 1 + n + j] = v
        N[K + 1, 1 + j] = series[(K + 1) * n + j] = per_q * v


@merged
def finish_series(w, order, series):
    """Count the solved linear systems; return DONE, or NOT_FINITE if a coefficient of the last order is not finite."""
    w.n_evaluations += order - 1
    n = series.size // (order + 1)
    for j in range(n):
        if not np.isfinite(series[order * n + j]):
            return NOT_FINITE
    return DONE


@compiled
def compute_coefficients(f, w, options, memory, t, state, unit):
    """Compute the Taylor series about `state` at t, with the unit of time `unit` (s); return DONE or NOT_FINITE.

    The result overwrites the stored series with the index memory[TARGET]. The linear system of each order is solved
    with the factors in w, which were computed for the accelerations at this state.
    """
    n, n_rows, order = w.Q.size, w.Rate.size, int(options[ORDER])
    N, X1, Y1, X2, Y2, total1, total2, r, c = array_views(options, memory, n, n_rows)
    series = series_view(memory, order, n, memory[TARGET])
    A, LAM = 1 + 2 * n, 1 + 3 * n
    begin_early = LAM + n_rows
    begin_late = begin_early + _integer_array(options, EARLY + FIRST + COLUMN).size
    indices, constant = _integer_array(options, BALANCE + SUM_INDICES), _float_array(options, BALANCE + CONSTANT)

    start_series(options, t, unit, state, N, series, begin_early, X1[0], Y1[0], r, c)
    for k in range(order - 1):
        K = k + 1
        if K > 1:
            N[K, 0] = 0.0
        sum_of_products(X1, Y1, K, total1)
        _next_coefficients(options, EARLY, K, N[K], N[K, begin_early:], X1[K], Y1[K], X1[0], Y1[0], total1)
        _store_sums(options, ROWS, -K / unit, N[K], c)
        if k == 0:
            start_operations(options, LATE, N[0], N[0, begin_late:], X2[0], Y2[0])
        else:
            sum_of_products(X2, Y2, k, total2)
            _next_coefficients(options, LATE, k, N[k], N[k, begin_late:], X2[k], Y2[k], X2[0], Y2[0], total2)
        _store_sums(options, BALANCE, 1.0, N[k], r)
        if k == 0:
            for o in range(indices.size):
                r[indices[o]] += constant[o]
        a, lam = N[k, A : A + n], N[k, LAM : LAM + n_rows]
        if w.rows_v.size < n_rows:
            lam[:] = 0.0
        if f.form == FIXED_ORDER:
            f.inner(f, w, SOLVE, t, r, c, 0.0, a, lam)
        else:
            solve_with_multipliers(f, w, r, c, a, lam)
        integrate_coefficients(K, unit, N, series, a)
        _fill_second_factors(options, EARLY, N[K], Y1[K])
        _fill_second_factors(options, LATE, N[k], Y2[k])
    return finish_series(w, order, series)


# aim of the step sizes: (distance of the end of a step from the constraints, before projection) / (allowed distance)
TARGET_PREDICTION_ERROR = 0.3
# the series is exact near the beginning of a step: defects at k * NEAR_BEGIN (k = 1, 2, 3) are due to rounding. A later
# defect is a rounding error if it is at most NOISE_RATIO * (largest of these) and at most MAX_NOISE * (allowed defect)
MAX_NOISE, NOISE_RATIO = 1e4, 10.0
NEAR_BEGIN = 1e-5  # time from the beginning of a step to a state where the series is exact, relative to the step size
# the defect is checked at equidistant times within a step. At each attempt, these times shift by this fraction of their
# spacing. Multiples of the golden section have evenly distributed fractional parts: many attempts cover a step evenly
GOLDEN_SECTION = 0.6180339887498949
MAX_DEFECT = 1e300  # replaces an infinite defect, which means that a callback had no finite value: the step is rejected
MIN_FACTOR = 0.1  # smallest ratio of the next step size to the size of a step rejected because of its defect
MAX_RISE = 4.0  # a step of fixed size fails if terms of its series rise by more than this factor, see `_diverges`
MAX_GROWTH = 5.0  # largest ratio of successive step sizes, because coefficients are scaled by the previous step size
MAX_FIRST_FACTOR = 1e6  # largest ratio of the first step size to its guess, so that powers of the ratio do not overflow
TOO_SHORT = 2.0  # error returned for a first step much shorter than its series allows; above 1, so that it is repeated


@merged
def _compute_series(f, w, options, memory, t, state, unit, index):
    """Compute the Taylor series about `state`, which was just projected, and store it as series `index` (0 or 1)."""
    n = w.Q.size
    memory[TARGET] = index
    if f.is_generated == 1 and w.used_general == 0.0:  # generated code has stored no factors in w: compute the factors
        q, v, a = state[:n], state[n : 2 * n], series_accelerations(memory, n)
        code = f.general(f, w, EVALUATE_WITHOUT_PROJECTION, t, q, v, 0.0, a, w.lam)
        if code != DONE:
            return code
    return compute_coefficients(f, w, options, memory, t, state, unit)


@merged
def _max_step(tolerances, series, unit, order, n):
    """Return the largest (step size) / `unit` (s) that keeps the last two terms of `series` within tolerances."""
    rtol, last, before = tolerances[RTOL], 0.0, 0.0
    row, row_before = order * n, (order - 1) * n
    for j in range(n):
        atol = tolerances[ATOL + j]
        weight_q = 1.0 / (atol + rtol * abs(series[j]))
        weight_v = 1.0 / (atol * unit + rtol * abs(series[n + j]))
        last = max(last, abs(series[row + j]) * max(weight_q, order * weight_v))
        before = max(before, abs(series[row_before + j]) * max(weight_q, (order - 1) * weight_v))
    log_inverse = -np.inf  # logarithm of 1 / (largest step size)
    if last > 0.0:
        log_inverse = np.log(last) / order
    if before > 0.0:
        log_inverse = max(log_inverse, np.log(before) / (order - 1))
    return np.exp(-log_inverse)


@compiled
def _diverges(tolerances, series, order, n, x):
    """Return True if a coordinate's series, evaluated after x units of time, grows again in its last two terms.

    Beside a singular position, rounding errors of C_q's solutions grow from each order to the next. A coordinate's term
    is compared in pairs of successive orders, as every other one may vanish. Its largest pair of terms and the pairs
    after it would decrease if the series converged. Growth below the tolerances is harmless.
    """
    for j in range(n):
        peak = least = last = before = 0.0
        power = 1.0
        for k in range(1, order + 1):
            term = k * power * abs(series[k * n + j])
            last, before = max(before, term), term
            power *= x
            if 1 < k < order:
                if last >= peak:
                    peak = least = last
                least = min(least, last)
        is_harmless = x * last <= tolerances[ATOL + j] + tolerances[RTOL] * abs(series[j])
        if 0.0 < MAX_RISE * least < last and not is_harmless:
            return True
    return False


@merged
def _evaluate_series(series, unit, order, x, q, v, a):
    """Evaluate a Taylor series of q and its two derivatives after x units of time, by Horner's scheme: set q, v and a.

    Four or two coordinates are evaluated at once, which is faster.
    """
    n, per_unit = q.size, 1.0 / unit
    a_factor = 2.0 * per_unit * per_unit
    for first in range(0, n if n > 3 else 0, 4):
        j = min(first, n - 4)
        m = order * n + j
        q0, q1, q2, q3 = series[m], series[m + 1], series[m + 2], series[m + 3]
        v0 = v1 = v2 = v3 = 0.0
        a0 = a1 = a2 = a3 = 0.0
        for m in range((order - 1) * n + j, -1, -n):
            a0, a1, a2, a3 = a0 * x + v0, a1 * x + v1, a2 * x + v2, a3 * x + v3
            v0, v1, v2, v3 = v0 * x + q0, v1 * x + q1, v2 * x + q2, v3 * x + q3
            q0, q1 = q0 * x + series[m], q1 * x + series[m + 1]
            q2, q3 = q2 * x + series[m + 2], q3 * x + series[m + 3]
        q[j], q[j + 1], q[j + 2], q[j + 3] = q0, q1, q2, q3
        v[j], v[j + 1], v[j + 2], v[j + 3] = v0 * per_unit, v1 * per_unit, v2 * per_unit, v3 * per_unit
        a[j], a[j + 1], a[j + 2], a[j + 3] = a0 * a_factor, a1 * a_factor, a2 * a_factor, a3 * a_factor
    for first in range(0, n if n < 4 else 0, 2):
        j = max(min(first, n - 2), 0)
        k = min(j + 1, n - 1)
        q0, q1 = series[order * n + j], series[order * n + k]
        v0 = v1 = a0 = a1 = 0.0
        for m in range((order - 1) * n, -1, -n):
            a0, a1 = a0 * x + v0, a1 * x + v1
            v0, v1 = v0 * x + q0, v1 * x + q1
            q0, q1 = q0 * x + series[m + j], q1 * x + series[m + k]
        q[j], q[k], v[j], v[k] = q0, q1, v0 * per_unit, v1 * per_unit
        a[j], a[k] = a0 * a_factor, a1 * a_factor


@compiled
def _defect_at(f, w, memory, t, h, s, tolerances, series, order, q, v, a):
    """Return defect / allowed defect of the series at the time t + s h, or infinity if callbacks fail there."""
    series_a = series_accelerations(memory, q.size)
    _evaluate_series(series, memory[UNIT], order, s * h / memory[UNIT], q, v, series_a)
    if evaluate_without_projection(f, w, t + s * h, q, v, a) != DONE:
        return np.inf
    return defect_ratio(tolerances, h, order, series_a, a, q, v)


@compiled
def _is_rounding_defect(f, w, memory, t, h, tolerances, series, order, q, v, a, defect):
    """Return True if `defect` (defect / allowed defect) is only a rounding error, see MAX_NOISE."""
    if defect > MAX_NOISE:
        return False
    noise = 0.0
    for k in range(1, 4):
        noise = max(noise, _defect_at(f, w, memory, t, h, k * NEAR_BEGIN, tolerances, series, order, q, v, a))
    return defect <= NOISE_RATIO * noise


@compiled
def _first_large_defect(f, w, memory, t, h, tolerances, series, order, q, v, a):
    """Check the defect within a step; return the first (defect / allowed defect) above 1, or 0 if there is none.

    The defect is evaluated at memory[SUSPECT], and at times that differ from attempt to attempt. Rounding errors do not
    count. memory[SUSPECT] becomes the earliest time of a large defect, and w.defect the largest of the small defects.
    """
    max_gap, shift = tolerances[DEFECT_GAP], memory[ATTEMPTS] * GOLDEN_SECTION % 1.0
    n_points = 0
    if h > max_gap:
        n_points = int(np.ceil(h / max_gap))
    for k in range(-1, n_points):
        s = (k + shift) / n_points if k >= 0 else (memory[SUSPECT] - t) / h
        if k < 0 and not (memory[SUSPECTED] == 1.0 and 0.0 < s < 1.0):
            continue
        defect = _defect_at(f, w, memory, t, h, s, tolerances, series, order, q, v, a)
        if defect > 1.0 and not _is_rounding_defect(f, w, memory, t, h, tolerances, series, order, q, v, a, defect):
            if memory[SUSPECTED] == 0.0 or t + s * h < memory[SUSPECT]:
                memory[SUSPECT] = t + s * h
            memory[SUSPECTED] = 1.0
            return defect
        w.defect = max(w.defect, defect)
    return 0.0


@merged
def _factor_after_large_defect(defect, order):
    """Return the ratio of the next step size to the size of a step rejected because of its defect."""
    return max(MIN_FACTOR, 0.9 * defect ** (-1.0 / order))


@kernel(COMMIT)
def commit_taylor(f, w, options, memory, tolerances, accepted):
    """If the step was accepted, make the series about its end the current series; if not, discard that series."""
    if accepted and memory[TRIED] == 1.0:
        memory[CURRENT] = 1.0 - memory[CURRENT]
        memory[UNIT], memory[ALLOWED_SIZE] = memory[NEXT_UNIT], memory[NEXT_ALLOWED_SIZE]
    memory[TRIED] = 0.0


@kernel(ATTEMPT)
def taylor_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt a step of size h by the Taylor series about its beginning; compute the series for the next step."""
    n, order, is_estimated = w.Q.size, int(options[ORDER]), tolerances[ESTIMATE] == 1.0
    q, v = state[:n], state[n : 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    w.n_outer += 1
    if memory[HAS_SERIES] == 0.0:
        copy(state, new_state)
        code = project(f, w, t, q1, v1, options[THETA], a1, lam1)
        if code == DONE:
            code = _compute_series(f, w, options, memory, t, new_state, h, memory[CURRENT])
        if code != DONE:
            return Attempt(code, np.inf, 0.0)
        memory[HAS_SERIES], memory[UNIT] = 1.0, h
        if is_estimated:
            memory[ALLOWED_SIZE] = _max_step(tolerances, series_view(memory, order, n, memory[CURRENT]), h, order, n)
            if memory[ALLOWED_SIZE] > MAX_GROWTH:
                return Attempt(DONE, TOO_SHORT, min(memory[ALLOWED_SIZE], MAX_FIRST_FACTOR))
    series, unit = series_view(memory, order, n, memory[CURRENT]), memory[UNIT]
    x = (memory[PASSED] + h) / unit
    error, checks_defect, series_a = 0.0, False, series_accelerations(memory, n)
    if is_estimated:
        error = x / memory[ALLOWED_SIZE]  # exceeds 1 if the error exceeds the tolerances
        if error > 1.0 + GAP_SLACK:
            return Attempt(DONE, error, 1.0 / error)
        error = min(error, 1.0)
        was_near_singular = w.nearly_singular != 0.0  # True if the run is, or has been, near a singular position
        # near a singular position, check no defect: small violations of constraints by the series spoil accelerations
        checks_defect = w.near_now == 0.0
        w.near_now = 0.0 if checks_defect else 2.0  # 2 requests an update of w.pivot after the step
        ratio_to_gap = gap_ratio(tolerances, h)
        if ratio_to_gap > 0.0 and was_near_singular:
            return Attempt(DONE, ratio_to_gap, 1.0 / ratio_to_gap)
        if checks_defect:
            memory[ATTEMPTS] += 1.0
            if memory[SUSPECTED] == 1.0 and memory[SUSPECT] <= t:
                memory[SUSPECTED] = 0.0
            w.defect = 0.0
            defect = _first_large_defect(f, w, memory, t, h, tolerances, series, order, q1, v1, a1)
            if defect > 0.0:
                return Attempt(DONE, min(defect, MAX_DEFECT), _factor_after_large_defect(defect, order))
    elif options[KEEP] == 0.0 and _diverges(tolerances, series, order, n, x):
        return Attempt(OUTER_DIVERGED, np.inf, 0.0)
    _evaluate_series(series, unit, order, x, q1, v1, series_a)
    store_prediction(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    if options[KEEP] == 1.0:
        memory[PASSED] += h
        return Attempt(DONE, 0.0, 0.0)
    distance = prediction_error(w, tolerances, h, q, v, q1)
    memory[DISTANCE_FACTOR], allowed_factor = 1.0, np.inf
    if distance > 0.0:
        # if the step is much shorter than the series allows, (step size) / (allowed size) counts as 1 / MAX_GROWTH
        allowed_factor = (TARGET_PREDICTION_ERROR / distance) ** (1.0 / order)
        memory[DISTANCE_FACTOR] = min(1.0, max(x / memory[ALLOWED_SIZE], 1.0 / MAX_GROWTH) * allowed_factor)
    if distance > 1.0:
        return Attempt(DONE, distance, allowed_factor)
    if checks_defect:
        defect = defect_ratio(tolerances, h, order, series_a, a1, q1, v1)
        if defect > 1.0:
            noise = _is_rounding_defect(f, w, memory, t, h, tolerances, series, order, q1, v1, a1, defect)
            if not noise:
                return Attempt(DONE, min(defect, MAX_DEFECT), _factor_after_large_defect(defect, order))
            _evaluate_series(series, unit, order, x, q1, v1, series_a)
            code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
            if code != DONE:
                return Attempt(code, np.inf, 0.0)
        w.defect = max(w.defect, defect)
    series = series_view(memory, order, n, 1.0 - memory[CURRENT])
    unit = min(memory[ALLOWED_SIZE] * unit, MAX_GROWTH * h) if is_estimated else h
    code = _compute_series(f, w, options, memory, t + h, new_state, unit, 1.0 - memory[CURRENT])
    if code != DONE:
        return Attempt(code, np.inf, 0.0)
    memory[TRIED], memory[NEXT_UNIT] = 1.0, unit
    factor = 0.0
    if is_estimated:
        memory[NEXT_ALLOWED_SIZE] = _max_step(tolerances, series, unit, order, n)
        distance_factor = memory[DISTANCE_FACTOR] if memory[DISTANCE_FACTOR] > 0.0 else 1.0
        factor = min(distance_factor * memory[NEXT_ALLOWED_SIZE] * unit / h, MAX_GROWTH)
    return Attempt(DONE, max(error, distance), factor)


TAYLOR = Step(taylor_step, commit_taylor)

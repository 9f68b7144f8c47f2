"""A step by the Taylor series of the motion, found from the index-3 equations themselves.

With G = [C_q; A] the motion obeys G v + G_t = 0 and M a + G^T lam = Q. Written for the coefficients of the series, of
order k in a and lam and of order k + 1 in v, all but the last coefficients of a, lam and v are known, and these solve

    M_0 a_k + G_0^T lam_k = r_k,    G_0 a_k = c_k,

with the matrix of the accelerations at the beginning of the step, whose factors are there: one solution with them an
order, and no derivative of the constraints beyond G (J. D. Pryce's structural analysis, BIT 41 (2001), 364-394, finds
these offsets for any equations). What r and c need of G, M and Q follows from a program of products and functions, see
`twoloop.series`, and the recurrences for their coefficients (R. E. Moore, Interval Analysis (1966), ch. 11).

The series has the order that the tolerance asks for, and the step the length at which its last terms are as large as
the tolerance (A. Jorba and M. Zou, Experimental Mathematics 14 (2005), 99-117). Time is counted in units of the step
before, so that no power of a short time underflows. The end of the step is moved to the constraints.
"""

import numpy as np

from twoloop.kernels.accelerations import solve_for_order
from twoloop.kernels.calls import project
from twoloop.kernels.common import (
    ATOL,
    DEPARTURE,
    DONE,
    ESTIMATE,
    N_EVALUATIONS,
    N_OUTER,
    NOT_FINITE,
    RTOL,
    STEP,
    STEP_FACTOR,
    compiled,
    inlined,
    kernel,
    merged,
)
from twoloop.kernels.linalg import copy
from twoloop.kernels.predictor import departure, keep_predicted

# kinds of operation, as twoloop.tracing has them; PENDING are products whose second factors wait for the solution
PRODUCT, RECIPROCAL, SQUARE_ROOT, EXPONENTIAL, SINE, COSINE, LOGARITHM, ARCTANGENT, PENDING = range(9)

# places in `options`: scalars, ORDER being that of the series of q; where each array of the program begins, and where
# the last ends; then the arrays, integers by their bits
# KEEP: steps follow one another by the same series, about the first state, as between the ends of a step
ORDER, THETA, N_NODES, EARLY_WIDTH, LATE_WIDTH, KEEP, N_SCALARS = range(7)
# arrays of a table; arrays of sums as twoloop.series.Sums has them
GROUPS, FIRST, SECOND, N_TABLE = 0, 1, 7, 13
COLUMN, COEFFICIENT, CONSTANT, ROW, MORE_COLUMN, MORE_COEFFICIENT, N_SUMS = range(7)
PLACES = N_SUMS  # behind the arrays of sums: which they are
EARLY, LATE, ROWS = 0, N_TABLE, 2 * N_TABLE
BALANCE, N_ARRAYS = ROWS + N_SUMS + 1, ROWS + 2 * (N_SUMS + 1)
KIND, BEGIN, END, MORE_FIRST, _, MORE_SECOND, _, N_GROUP = range(8)  # columns of GROUPS

# places in `memory`: scalars, two series of q (ORDER + 1, n_q), then scratch, see _scratch
(
    LAST_ACCEPTED,  # set by advance() after every attempt
    KNOWN,  # 1: there is a series about the state
    WHICH,  # of the two it is
    UNIT,  # of time, of the two series, s
    NEXT_UNIT,
    LENGTH,  # of the step that each allows, in that unit
    NEXT_LENGTH,
    TRIED,  # 1: the last attempt left a series that takes over if it was accepted
    PASSED,  # with KEEP: time since the state of the series, s
    TARGET,  # which of the two series is to be found
    SHORTER,  # of LENGTH, what the distance of its end from the constraints allowed of the step before; 0: not known
    N_MEMORY_SCALARS,
) = range(12)

ROUNDING = 1e-9  # relative, by which a step may be longer than the series allows
ALLOWED = 0.3  # of the tolerances: how far from the constraints the end of a step is to be before it is moved there
GROWTH = 5.0  # of the step from one to the next, at most: coefficients belong to the unit of the step before


def memory_size(order: int, n_q: int, n_rows: int, n_nodes: int, early: int, late: int) -> int:
    """Length of `memory`."""
    rows = order + 2
    scratch = rows * (n_nodes + 2 * early + 2 * late) + early + late + n_q + n_rows
    return N_MEMORY_SCALARS + 2 * (order + 1) * n_q + scratch


@inlined
def _integers(options, which):
    begin, end = int(options[N_SCALARS + which]), int(options[N_SCALARS + which + 1])
    return options[begin:end].view(np.int64)


@inlined
def _numbers(options, which):
    return options[int(options[N_SCALARS + which]) : int(options[N_SCALARS + which + 1])]


@inlined
def series_of(memory, order, n, which):
    """One of the two series of q; row by row, as numba calls a function for an array of two dimensions."""
    begin = N_MEMORY_SCALARS + int(which) * (order + 1) * n
    return memory[begin : begin + (order + 1) * n]


@merged
def interior(X, Y, K, total):
    """total[m] = sum over 0 < j < K of X[j, m] Y[K - j, m]."""
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
def _gather(options, sums, groups, g, more, values, out):
    """The sums of one group of operations, less their constants, into out."""
    column, coefficient = _integers(options, sums + COLUMN), _numbers(options, sums + COEFFICIENT)
    for o in range(groups[g + BEGIN], groups[g + END]):
        out[o] = coefficient[o] * values[column[o]]
    row, column = _integers(options, sums + ROW), _integers(options, sums + MORE_COLUMN)
    coefficient = _numbers(options, sums + MORE_COEFFICIENT)
    for e in range(groups[g + more], groups[g + more + 1]):
        out[row[e]] += coefficient[e] * values[column[e]]


@merged
def _sum(options, sums, scale, values, out):
    """All sums of a list, less their constants, times a factor; the rest of `out` stays."""
    column, coefficient = _integers(options, sums + COLUMN), _numbers(options, sums + COEFFICIENT)
    places = _integers(options, sums + PLACES)
    for o in range(column.size):
        out[places[o]] = scale * coefficient[o] * values[column[o]]
    row, column = _integers(options, sums + ROW), _integers(options, sums + MORE_COLUMN)
    coefficient = _numbers(options, sums + MORE_COEFFICIENT)
    for e in range(row.size):
        out[row[e]] += scale * coefficient[e] * values[column[e]]


@compiled
def begin_operations(options, table, values, z, x, y):
    """Order zero of all operations of a table: the functions themselves; those that wait stay zero."""
    groups = _integers(options, table + GROUPS)
    constant, constant_2 = _numbers(options, table + FIRST + CONSTANT), _numbers(options, table + SECOND + CONSTANT)
    for g in range(0, groups.size, N_GROUP):
        kind = groups[g]
        _gather(options, table + FIRST, groups, g, MORE_FIRST, values, x)
        _gather(options, table + SECOND, groups, g, MORE_SECOND, values, y)
        for o in range(groups[g + BEGIN], groups[g + END]):
            x[o] += constant[o]
            y[o] += constant_2[o]
            if kind == PRODUCT:
                z[o] = x[o] * y[o]
            elif kind == RECIPROCAL:
                z[o] = y[o] = 1.0 / x[o]
            elif kind == SQUARE_ROOT:
                z[o] = x[o] = y[o] = np.sqrt(x[o])
            elif kind == EXPONENTIAL:
                z[o] = y[o] = np.exp(x[o])
            elif kind == LOGARITHM:
                z[o] = np.log(x[o])
            elif kind == ARCTANGENT:
                z[o] = np.arctan(x[o])
            elif kind == PENDING:
                z[o] = 0.0
        if kind == SINE:
            half = (groups[g + END] - groups[g + BEGIN]) // 2
            for o in range(groups[g + BEGIN], groups[g + BEGIN] + half):
                z[o] = np.sin(x[o])
                z[o + half] = np.cos(x[o])
                y[o], y[o + half] = z[o + half], -z[o]
                x[o] = x[o + half] = 0.0


@merged
def _operate(options, table, K, values, z, x, y, x0, y0, total):
    """Order K > 0 of the operations of a table, into z, x and y; of those that wait, what is known before."""
    groups = _integers(options, table + GROUPS)
    inverse = 1.0 / K
    for g in range(0, groups.size, N_GROUP):
        kind, first, last = groups[g], groups[g + BEGIN], groups[g + END]
        _gather(options, table + FIRST, groups, g, MORE_FIRST, values, x)
        if kind == PENDING:
            for o in range(first, last):
                z[o] = total[o] + x[o] * y0[o]
        elif kind == SINE:
            half = (last - first) // 2
            for o in range(first, first + half):
                p = o + half
                u = K * x[o]
                x[o] = x[p] = u
                sine, cosine = (total[o] + u * y0[o]) * inverse, (total[p] + u * y0[p]) * inverse
                z[o], z[p] = sine, cosine
                y[o], y[p] = cosine, -sine
        elif kind == PRODUCT:
            _gather(options, table + SECOND, groups, g, MORE_SECOND, values, y)
            for o in range(first, last):
                z[o] = total[o] + x0[o] * y[o] + x[o] * y0[o]
        elif kind == RECIPROCAL:
            for o in range(first, last):
                z[o] = y[o] = -(total[o] + x[o] * y0[o]) * y0[o]
        elif kind == SQUARE_ROOT:
            for o in range(first, last):
                z[o] = x[o] = y[o] = 0.5 * (x[o] - total[o]) / x0[o]
        elif kind == EXPONENTIAL:
            for o in range(first, last):
                x[o] *= K
                z[o] = y[o] = (total[o] + x[o] * y0[o]) * inverse
        else:
            _gather(options, table + SECOND, groups, g, MORE_SECOND, values, y)
            for o in range(first, last):
                z[o] = (x[o] - total[o] * inverse) / y0[o]
                x[o] = K * z[o]


@merged
def _complete(options, table, values, y):
    """The second factors of the operations that waited."""
    groups = _integers(options, table + GROUPS)
    _gather(options, table + SECOND, groups, groups.size - N_GROUP, MORE_SECOND, values, y)


@inlined
def arrays_of(options, memory, n, n_rows):
    """Scratch: the coefficients of all quantities, of the arguments of operations, sums of products, r and c."""
    n_nodes, early, late = int(options[N_NODES]), int(options[EARLY_WIDTH]), int(options[LATE_WIDTH])
    order = int(options[ORDER])
    depth = order + 2
    begin = N_MEMORY_SCALARS + 2 * (order + 1) * n
    N = memory[begin : begin + depth * n_nodes].reshape((depth, n_nodes))
    begin += depth * n_nodes
    X1 = memory[begin : begin + depth * early].reshape((depth, early))
    begin += depth * early
    Y1 = memory[begin : begin + depth * early].reshape((depth, early))
    begin += depth * early
    X2 = memory[begin : begin + depth * late].reshape((depth, late))
    begin += depth * late
    Y2 = memory[begin : begin + depth * late].reshape((depth, late))
    begin += depth * late
    total1 = memory[begin : begin + early]
    begin += early
    total2 = memory[begin : begin + late]
    begin += late
    return N, X1, Y1, X2, Y2, total1, total2, memory[begin : begin + n], memory[begin + n : begin + n + n_rows]


@merged
def begin_series(options, t, unit, state, N, series, first, x, y, r, c):
    """What is known of the orders 0 and 1, and the early operations of order 0; r and c are zero."""
    n = r.size
    r[:], c[:] = 0.0, 0.0
    N[0, 0], N[1, 0] = t, unit
    for j in range(n):
        N[0, 1 + j] = series[j] = state[j]
        N[0, 1 + n + j] = state[n + j]
        N[1, 1 + j] = series[n + j] = unit * state[n + j]
    begin_operations(options, EARLY, N[0], N[0, first:], x, y)


@merged
def take_order(w, K, unit, N, series, a):
    """Velocities of order K and positions of order K + 1, from accelerations of order K - 1."""
    n = a.size
    per_v, per_q = unit / K, unit / (K + 1)
    for j in range(n):
        v = per_v * a[j]
        N[K, 1 + n + j] = v
        N[K + 1, 1 + j] = series[(K + 1) * n + j] = per_q * v


@merged
def end_series(w, order, series):
    """Count, and look whether all is finite."""
    w.counters[N_EVALUATIONS] += order - 1
    n = series.size // (order + 1)
    for j in range(n):
        if not np.isfinite(series[order * n + j]):
            return NOT_FINITE
    return DONE


@compiled
def _expand(f, w, options, memory, t, state, unit):
    """The series about a state whose factors are in w, in a unit of time; DONE, or why there is none."""
    n, n_rows, order = w.Q.size, w.Rate.size, int(options[ORDER])
    N, X1, Y1, X2, Y2, total1, total2, r, c = arrays_of(options, memory, n, n_rows)
    series = series_of(memory, order, n, memory[TARGET])
    A, LAM = 1 + 2 * n, 1 + 3 * n
    first = LAM + n_rows
    second = first + _integers(options, EARLY + FIRST + COLUMN).size
    places, constant = _integers(options, BALANCE + PLACES), _numbers(options, BALANCE + CONSTANT)

    begin_series(options, t, unit, state, N, series, first, X1[0], Y1[0], r, c)
    for k in range(order - 1):
        K = k + 1
        if K > 1:
            N[K, 0] = 0.0
        interior(X1, Y1, K, total1)
        _operate(options, EARLY, K, N[K], N[K, first:], X1[K], Y1[K], X1[0], Y1[0], total1)
        _sum(options, ROWS, -K / unit, N[K], c)
        if k == 0:
            begin_operations(options, LATE, N[0], N[0, second:], X2[0], Y2[0])
        else:
            interior(X2, Y2, k, total2)
            _operate(options, LATE, k, N[k], N[k, second:], X2[k], Y2[k], X2[0], Y2[0], total2)
        _sum(options, BALANCE, 1.0, N[k], r)
        if k == 0:
            for o in range(places.size):
                r[places[o]] += constant[o]
        a, lam = N[k, A : A + n], N[k, LAM : LAM + n_rows]
        if w.rows_v.size < n_rows:
            lam[:] = 0.0
        solve_for_order(f, w, r, c, a, lam)
        take_order(w, K, unit, N, series, a)
        _complete(options, EARLY, N[K], Y1[K])
        _complete(options, LATE, N[k], Y2[k])
    return end_series(w, order, series)


@merged
def _solve_order(f, w, r, c, a, lam):
    solve_for_order(f, w, r, c, a, lam)
    return DONE, 0.0


@kernel(STEP)
def solve_order(f, w, r, c, _t, _unit, _tolerances, a, lam):
    """The linear solution of one order, for code made for a mechanism; r and c were written just before, one by one."""
    return _solve_order(f, w, r, c, a, lam)


@kernel(STEP, vectorized=True)
def solve_long_order(f, w, r, c, _t, _unit, _tolerances, a, lam):
    """The same for many coordinates."""
    return _solve_order(f, w, r, c, a, lam)


@merged
def _find_series(f, w, options, memory, t, state, unit, which, by_code):
    """The series about a state, into one of the two places; by f.first, code made for the mechanism, if there is."""
    memory[TARGET] = which
    if by_code:
        code, _ = f.first(f, w, options, memory, t, unit, state, state, state)
        return code
    return _expand(f, w, options, memory, t, state, unit)


@merged
def _length(tolerances, series, unit, order, n):
    """The step, in units, at which the last two terms, of positions and velocities, are within the tolerances."""
    rtol, last, before = tolerances[RTOL], 0.0, 0.0
    row, row_before = order * n, (order - 1) * n
    for j in range(n):
        atol = tolerances[ATOL + j]
        of_q = 1.0 / (atol + rtol * abs(series[j]))
        of_v = 1.0 / (atol * unit + rtol * abs(series[n + j]))
        last = max(last, abs(series[row + j]) * max(of_q, order * of_v))
        before = max(before, abs(series[row_before + j]) * max(of_q, (order - 1) * of_v))
    least = -np.inf  # logarithm of 1 / length
    if last > 0.0:
        least = np.log(last) / order
    if before > 0.0:
        least = max(least, np.log(before) / (order - 1))
    return np.exp(-least)


@merged
def _evaluate(series, unit, order, x, q, v):
    """q and v at x units of time, by Horner's scheme; four coordinates at once, some of the last ones twice."""
    n, per_unit = q.size, 1.0 / unit
    for first in range(0, n if n > 3 else 0, 4):
        j = min(first, n - 4)
        m = order * n + j
        q0, q1, q2, q3 = series[m], series[m + 1], series[m + 2], series[m + 3]
        v0 = v1 = v2 = v3 = 0.0
        for m in range((order - 1) * n + j, -1, -n):
            v0, v1, v2, v3 = v0 * x + q0, v1 * x + q1, v2 * x + q2, v3 * x + q3
            q0, q1 = q0 * x + series[m], q1 * x + series[m + 1]
            q2, q3 = q2 * x + series[m + 2], q3 * x + series[m + 3]
        q[j], q[j + 1], q[j + 2], q[j + 3] = q0, q1, q2, q3
        v[j], v[j + 1], v[j + 2], v[j + 3] = v0 * per_unit, v1 * per_unit, v2 * per_unit, v3 * per_unit
    for j in range(n if n < 4 else 0):
        q0, v0 = series[order * n + j], 0.0
        for m in range((order - 1) * n + j, -1, -n):
            v0 = v0 * x + q0
            q0 = q0 * x + series[m]
        q[j], v[j] = q0, v0 * per_unit


@merged
def _step(f, w, options, memory, t, h, tolerances, state, new_state, by_code):
    """One attempt, by the series about its beginning; then the series about its end, which sets the next step."""
    n, order, estimated = w.Q.size, int(options[ORDER]), tolerances[ESTIMATE] == 1.0
    q, v = state[:n], state[n : 2 * n]
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    w.counters[N_OUTER] += 1
    if memory[TRIED] == 1.0 and memory[LAST_ACCEPTED] == 1.0:
        memory[WHICH] = 1.0 - memory[WHICH]
        memory[UNIT], memory[LENGTH] = memory[NEXT_UNIT], memory[NEXT_LENGTH]
    memory[TRIED] = 0.0
    if memory[KNOWN] == 0.0:
        copy(state, new_state)
        code = project(f, w, t, q1, v1, options[THETA], a1, lam1)
        if code == DONE:
            code = _find_series(f, w, options, memory, t, new_state, h, memory[WHICH], by_code)
        if code != DONE:
            return code, np.inf
        memory[KNOWN], memory[UNIT] = 1.0, h
        if estimated:
            memory[LENGTH] = _length(tolerances, series_of(memory, order, n, memory[WHICH]), h, order, n)
    series, unit = series_of(memory, order, n, memory[WHICH]), memory[UNIT]
    x = (memory[PASSED] + h) / unit
    error = 0.0
    if estimated:
        error = (x / memory[LENGTH]) ** order
        if x > memory[LENGTH] * (1.0 + ROUNDING):
            w.notes[STEP_FACTOR] = memory[LENGTH] / x
            return DONE, max(error, 1.0 + ROUNDING)
        error = min(error, 1.0)
    _evaluate(series, unit, order, x, q1, v1)
    keep_predicted(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code != DONE:
        return code, np.inf
    if options[KEEP] == 1.0:
        memory[PASSED] += h
        return DONE, 0.0
    w.notes[DEPARTURE] = departure(w, tolerances, h, q, v, q1)
    if w.notes[DEPARTURE] > 0.0:
        memory[SHORTER] = min(1.0, x / memory[LENGTH] * (ALLOWED / w.notes[DEPARTURE]) ** (1.0 / order))
    if w.notes[DEPARTURE] > 1.0:
        w.notes[STEP_FACTOR] = memory[SHORTER] * memory[LENGTH] / x
        return DONE, w.notes[DEPARTURE]
    series = series_of(memory, order, n, 1.0 - memory[WHICH])
    unit = min(memory[LENGTH] * unit, GROWTH * h) if estimated else h
    code = _find_series(f, w, options, memory, t + h, new_state, unit, 1.0 - memory[WHICH], by_code)
    if code != DONE:
        return code, np.inf
    memory[TRIED], memory[NEXT_UNIT] = 1.0, unit
    if estimated:
        memory[NEXT_LENGTH] = _length(tolerances, series, unit, order, n)
        shorter = memory[SHORTER] if memory[SHORTER] > 0.0 else 1.0
        w.notes[STEP_FACTOR] = min(shorter * memory[NEXT_LENGTH] * unit / h, GROWTH)
    return DONE, max(error, w.notes[DEPARTURE])


@kernel(STEP)
def taylor_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """The step with series found by their program."""
    return _step(f, w, options, memory, t, h, tolerances, state, new_state, False)


@kernel(STEP, vectorized=True)
def compiled_taylor_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """The step with series found by f.first, code made for the mechanism, which calls f.second for each solution."""
    return _step(f, w, options, memory, t, h, tolerances, state, new_state, True)

"""Interpret the program of a Taylor series (generate/series.py), order by order, if no code is generated.

See taylor_step.py for the equations.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.data.indices import DONE, FORM, N_EVALUATIONS, NOT_FINITE, STATIC
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.tasks import SOLVE
from twoloop.kernels.linalg.saddle_point import solve_both

# places in `options`: scalars (ORDER is that of the series of q); where each array of the program begins, and where the
# last ends; then the arrays, integers by their bits. KEEP: steps follow one another by the same series, about the first
# state, as between the ends of a step
ORDER, THETA, N_NODES, EARLY_WIDTH, LATE_WIDTH, KEEP, N_SCALARS = range(7)
# arrays of a table; arrays of sums as twoloop.generate.series.Sums has them
GROUPS, FIRST, SECOND, N_TABLE = 0, 1, 7, 13
COLUMN, COEFFICIENT, CONSTANT, ROW, MORE_COLUMN, MORE_COEFFICIENT, N_SUMS = range(7)
PLACES = N_SUMS  # behind the arrays of sums: the entries that they compute
EARLY, LATE, ROWS = 0, N_TABLE, 2 * N_TABLE
BALANCE, N_ARRAYS = ROWS + N_SUMS + 1, ROWS + 2 * (N_SUMS + 1)
KIND, BEGIN, END, MORE_FIRST, _, MORE_SECOND, _, N_GROUP = range(8)  # columns of GROUPS

# places in `memory`: scalars, two series of q (ORDER + 1, n_q), then scratch, see arrays_of
(
    KNOWN,  # 1: there is a series about the state
    WHICH,  # index of the series about the state
    UNIT,  # unit of time of each series, s
    NEXT_UNIT,
    LENGTH,  # length of the step that each series allows, in its unit
    NEXT_LENGTH,
    TRIED,  # 1: the last attempt left a series that takes over if it was accepted
    PASSED,  # with KEEP: time since the state of the series, s
    TARGET,  # index of the series that is computed
    # ratio of the step to LENGTH that the distance of its end from the constraints allowed before; 0: not known
    SHORTER,
    ATTEMPTS,  # number of attempts, so that each attempt checks other places
    SUSPECTED,  # 1: a step was rejected for the defect at the time SUSPECT, which no step has passed since
    SUSPECT,
    N_MEMORY_SCALARS,
) = range(14)


def memory_size(order: int, n_q: int, n_rows: int, n_nodes: int, early: int, late: int) -> int:
    """Return the length of `memory`."""
    rows = order + 2
    scratch = rows * (n_nodes + 2 * early + 2 * late) + early + late + n_q + n_rows
    return N_MEMORY_SCALARS + 2 * (order + 1) * n_q + scratch + n_q


@inlined
def accelerations_found(memory, n):
    """Return the last numbers of `memory`: the accelerations of the series at one time."""
    return memory[memory.size - n :]


@inlined
def _integers(options, which):
    begin, end = int(options[N_SCALARS + which]), int(options[N_SCALARS + which + 1])
    return options[begin:end].view(np.int64)


@inlined
def _numbers(options, which):
    return options[int(options[N_SCALARS + which]) : int(options[N_SCALARS + which + 1])]


@inlined
def series_of(memory, order, n, which):
    """Return one of the two series of q as a vector, row by row: numba calls a function for a two-dimensional array."""
    begin = N_MEMORY_SCALARS + int(which) * (order + 1) * n
    return memory[begin : begin + (order + 1) * n]


@merged
def interior(X, Y, K, total):
    """Compute total[m] = sum over 0 < j < K of X[j, m] Y[K - j, m]."""
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
    """Compute the arguments of a group of operations, without their constants."""
    column, coefficient = _integers(options, sums + COLUMN), _numbers(options, sums + COEFFICIENT)
    for o in range(groups[g + BEGIN], groups[g + END]):
        out[o] = coefficient[o] * values[column[o]]
    row, column = _integers(options, sums + ROW), _integers(options, sums + MORE_COLUMN)
    coefficient = _numbers(options, sums + MORE_COEFFICIENT)
    for e in range(groups[g + more], groups[g + more + 1]):
        out[row[e]] += coefficient[e] * values[column[e]]


@merged
def _sum(options, sums, scale, values, out):
    """Compute all sums of a list without their constants, times a factor; other entries of `out` stay."""
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
    """Compute order zero of the operations of a table; pending products stay zero."""
    groups = _integers(options, table + GROUPS)
    constant, constant_2 = _numbers(options, table + FIRST + CONSTANT), _numbers(options, table + SECOND + CONSTANT)
    for g in range(0, groups.size, N_GROUP):
        kind = groups[g]
        _gather(options, table + FIRST, groups, g, MORE_FIRST, values, x)
        _gather(options, table + SECOND, groups, g, MORE_SECOND, values, y)
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
            half = (groups[g + END] - groups[g + BEGIN]) // 2
            for o in range(groups[g + BEGIN], groups[g + BEGIN] + half):
                z[o] = np.sin(x[o])
                z[o + half] = np.cos(x[o])
                y[o], y[o + half] = z[o + half], -z[o]
                x[o] = x[o + half] = 0.0


@merged
def _operate(options, table, K, values, z, x, y, x0, y0, total):
    """Compute order K > 0 of the operations of a table; for pending products the part known before the solution."""
    groups = _integers(options, table + GROUPS)
    inverse = 1.0 / K
    for g in range(0, groups.size, N_GROUP):
        kind, first, last = groups[g], groups[g + BEGIN], groups[g + END]
        _gather(options, table + FIRST, groups, g, MORE_FIRST, values, x)
        if kind == op.PENDING:
            for o in range(first, last):
                z[o] = total[o] + x[o] * y0[o]
        elif kind == op.SINE:
            half = (last - first) // 2
            for o in range(first, first + half):
                p = o + half
                u = K * x[o]
                x[o] = x[p] = u
                sine, cosine = (total[o] + u * y0[o]) * inverse, (total[p] + u * y0[p]) * inverse
                z[o], z[p] = sine, cosine
                y[o], y[p] = cosine, -sine
        elif kind == op.PRODUCT:
            _gather(options, table + SECOND, groups, g, MORE_SECOND, values, y)
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
            _gather(options, table + SECOND, groups, g, MORE_SECOND, values, y)
            for o in range(first, last):
                z[o] = (x[o] - total[o] * inverse) / y0[o]
                x[o] = K * z[o]


@merged
def _complete(options, table, values, y):
    """Compute the second factors of pending products."""
    groups = _integers(options, table + GROUPS)
    _gather(options, table + SECOND, groups, groups.size - N_GROUP, MORE_SECOND, values, y)


@inlined
def arrays_of(options, memory, n, n_rows):
    """Return arrays for coefficients of quantities and of arguments of operations, sums of products, r and c."""
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
    """Set orders 0 and 1 of the state, and compute early operations of order 0; r and c become zero."""
    n = r.size
    r[:], c[:] = 0.0, 0.0
    N[0, 0], N[1, 0] = t, unit
    for j in range(n):
        N[0, 1 + j] = series[j] = state[j]
        N[0, 1 + n + j] = state[n + j]
        N[1, 1 + j] = series[n + j] = unit * state[n + j]
    begin_operations(options, EARLY, N[0], N[0, first:], x, y)


@merged
def take_order(K, unit, N, series, a):
    """Compute velocities of order K and positions of order K + 1 from accelerations of order K - 1."""
    n = a.size
    per_v, per_q = unit / K, unit / (K + 1)
    for j in range(n):
        v = per_v * a[j]
        N[K, 1 + n + j] = v
        N[K + 1, 1 + j] = series[(K + 1) * n + j] = per_q * v


@merged
def end_series(w, order, series):
    """Count evaluations, and check that the last order is finite."""
    w.counters[N_EVALUATIONS] += order - 1
    n = series.size // (order + 1)
    for j in range(n):
        if not np.isfinite(series[order * n + j]):
            return NOT_FINITE
    return DONE


@compiled
def expand(f, w, options, memory, t, state, unit):
    """Compute the series about a state whose factors are in w, in a unit of time; return DONE or a reason."""
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
        if f.flags[FORM] == STATIC:
            f.inner(f, w, SOLVE, t, r, c, 0.0, a, lam)
        else:
            solve_both(f, w, r, c, a, lam)
        take_order(K, unit, N, series, a)
        _complete(options, EARLY, N[K], Y1[K])
        _complete(options, LATE, N[k], Y2[k])
    return end_series(w, order, series)

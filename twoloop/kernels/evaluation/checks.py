"""Check the start of a run in compiled code: evaluate all callbacks, check their values, choose units of coordinates.

If `evaluate_start` finds nothing wrong, the slower checks in Python (twoloop/checks) are left out. C_q is the Jacobian
of constraints on positions; A contains the rows of non-holonomic constraints A v + b = 0. Units of coordinates and rows
are chosen so that the entries of C_q in these units have similar sizes. The linear range of a row of C_q is how far
coordinates can move before the row changes much (checks/scales.py). `f` is the kit, with the callbacks.

`compare_traces` compares callbacks with their traces, see generate/traced_values.py. For each number that a trace
yields, the kernel computes a bound of the rounding error, in units of EPS, the spacing of floating-point numbers at 1.
"""

import math

from numba import types

from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, exact, f8, finite, finite_vector, i8, kernel
from twoloop.kernels.evaluation import operations as op
from twoloop.kernels.evaluation.operations import result_of_operation
from twoloop.kernels.linalg.dense import largest_of, ldl_factor

NO_ENTRY = 1e-12  # an entry of C_q counts as zero if it is at most this fraction of the largest entry of its row
MAX_SWEEPS = 20  # largest number of iterations in `column_units`; each fits the units of rows, then of coordinates
NEGLIGIBLE = 1e-6  # `linear_ranges` ignores |q_j| up to this fraction of the largest |q_j| of the same row of C_q


@exact
def _sort(values):
    for k in range(1, values.size):
        value, i = values[k], k
        while i > 0 and values[i - 1] > value:
            values[i] = values[i - 1]
            i -= 1
        values[i] = value


@exact
def _fit_column_units(rows, columns, mask, logs):
    """Fit the units of coordinates to given units of rows, see `column_units`; return True if no unit changed.

    `columns`, `rows` and `logs` contain logarithms: of the units of coordinates and rows, and of |entries| of C_q.
    `mask`: 0 where an entry of C_q counts as zero, else 1.
    """
    is_unchanged = True
    for j in range(columns.size):
        total, n = 0.0, 0
        for i in range(rows.size):
            if mask[i, j] != 0.0:
                total += rows[i] - logs[i, j]
                n += 1
        mean = total / n if n > 0 else 0.0
        is_unchanged = is_unchanged and mean == columns[j]
        columns[j] = mean
    return is_unchanged


@exact
def _fit_row_units(columns, rows, mask, logs):
    """Fit the units of rows to given units of coordinates; for the arguments see `_fit_column_units`."""
    for i in range(rows.size):
        total, n = 0.0, 0
        for j in range(columns.size):
            if mask[i, j] != 0.0:
                total += logs[i, j] + columns[j]
                n += 1
        rows[i] = total / n if n > 0 else 0.0


@kernel(types.void(MATRIX, VECTOR, VECTOR, MATRIX, MATRIX, VECTOR, VECTOR))
def column_units(matrix, typical, columns, mask, logs, rows, scratch):
    """Store in `columns` (n_q) units of the coordinates in which the entries of C_q (`matrix`) have similar sizes.

    The units minimize the sum of log(|entry (i, j)| * unit of coordinate j / unit of row i)^2 over all nonzero entries.
    A common factor of all units stays free: choose it so that the median of unit / typical size is 1 (`typical`: n_q
    typical sizes of coordinates). Coordinates without nonzero entries get their typical size. Other arguments: scratch.
    """
    n_used, log_factor = 0, 0.0
    for i in range(rows.size):
        largest = largest_of(matrix[i])
        for j in range(columns.size):
            mask[i, j] = 1.0 if abs(matrix[i, j]) > NO_ENTRY * largest else 0.0
            logs[i, j] = math.log(abs(matrix[i, j])) if mask[i, j] != 0.0 else 0.0
    for j in range(columns.size):
        columns[j] = 0.0
    for _ in range(MAX_SWEEPS):
        _fit_row_units(columns, rows, mask, logs)
        if _fit_column_units(rows, columns, mask, logs):
            break
    for j in range(columns.size):
        has_entry = False
        for i in range(rows.size):
            has_entry = has_entry or mask[i, j] != 0.0
        if has_entry:
            scratch[n_used] = math.log(typical[j]) - columns[j]
            n_used += 1
        else:
            columns[j] = math.nan
    if n_used > 0:
        _sort(scratch[:n_used])
        log_factor = 0.5 * (scratch[(n_used - 1) // 2] + scratch[n_used // 2])
    for j in range(columns.size):
        columns[j] = typical[j] if math.isnan(columns[j]) else math.exp(columns[j] + log_factor)


@kernel(types.void(MATRIX, VECTOR, f8, VECTOR, VECTOR))
def linear_ranges(coordinates_in_units, radius, negligible, scratch, ranges):
    """Store in `ranges` how far coordinates can move, in their units, before each row of C_q changes much.

    Entry (i, j) of `coordinates_in_units` is |q_j| in its unit if row i of C_q has a nonzero entry j, else 0. `radius`:
    norm of each row / change of the row per unit displacement. Let x be the largest |q_j| of a row. If the radius is
    at most max(x, 1), it is the range. If the radius is larger, the range is 1 where x <= `negligible`, otherwise the
    lower median of the |q_j| that exceed NEGLIGIBLE * x.
    """
    for i in range(ranges.size):
        largest, n = 0.0, 0
        for j in range(coordinates_in_units.shape[1]):
            largest = max(largest, coordinates_in_units[i, j])
        ranges[i] = 1.0
        if radius[i] <= max(largest, 1.0):
            ranges[i] = radius[i]
        elif largest > negligible:
            for j in range(coordinates_in_units.shape[1]):
                if coordinates_in_units[i, j] > NEGLIGIBLE * largest:
                    scratch[n] = coordinates_in_units[i, j]
                    n += 1
            _sort(scratch[:n])
            ranges[i] = scratch[(n - 1) // 2]


# flags that `evaluate_start` returns. WELL_FORMED: all values are finite, M is symmetric, no row of C_q or A is zero.
# CONSISTENT: the state satisfies the constraints up to rounding. Only a varying M sets DEFINITE (all its eigenvalues
# exceed L * EIGENVALUE_MARGIN, L = roundings[2] max|M_ij|) or INDEFINITE (one is below L / EIGENVALUE_MARGIN)
WELL_FORMED, CONSISTENT, DEFINITE, INDEFINITE = 1, 2, 4, 8
MAX_RELATIVE_DISTANCE = 0.5  # recorded sizes of coordinates are used at q if all |q_j - recorded q_j| <= this * size_j
ROUNDING_OF_ZERO = 2.0**-52  # a coordinate up to this fraction of the largest one may be zero with a rounding error
EIGENVALUE_MARGIN = 2.0  # if the least eigenvalue of M is within this factor of its limit, a check in Python decides


def results_size(n: int, n_c: int, n_a: int) -> int:
    """Return the length of the argument `results` of evaluate_start."""
    return n + 2 * (n_c + n_a) + n_c * (n + 4) + n * max(n, n_c + n_a + 1)


@exact
def _set_to_zero(A):
    for i in range(len(A)):
        for j in range(A.shape[1]):
            A[i, j] = 0.0


@exact
def _has_empty_row(rows):
    has_empty_row = False
    for i in range(len(rows)):
        has_empty_row = has_empty_row or largest_of(rows[i]) == 0.0
    return has_empty_row


@exact
def _is_symmetric(mass, tolerance):
    """Return True if M is symmetric, up to differences of `tolerance` times max|M_ij|."""
    largest, asymmetry, is_exactly_symmetric = 0.0, 0.0, True
    for i in range(len(mass)):
        for j in range(i):
            is_exactly_symmetric = is_exactly_symmetric and mass[i, j] == mass[j, i]
    if is_exactly_symmetric:
        return True
    for i in range(len(mass)):
        for j in range(len(mass)):
            largest, asymmetry = max(largest, abs(mass[i, j])), max(asymmetry, abs(mass[i, j] - mass[j, i]))
    return asymmetry <= tolerance * largest


@exact
def _is_rounding_error(value, row, state, sizes, min_size, rate, tolerance):
    """Return True if `value`, the violation of a constraint, is at most `tolerance` times the sum of its |terms|.

    The |terms| are |rate| (C_t, b, or 0) and, for each j, |row[j]| * max(|state[j]|, sizes[j], min_size).
    """
    sum_of_terms = abs(rate)
    for j in range(state.size):
        if row[j] != 0.0:  # faster, because most entries are zero
            sum_of_terms += abs(row[j]) * max(abs(state[j]), sizes[j], min_size)
    return abs(value) <= tolerance * sum_of_terms


@exact
def _is_near(q, sizes, stored_q):
    """Return True if |q_j - stored_q[j]| is at most MAX_RELATIVE_DISTANCE times sizes[j] for each coordinate j."""
    is_near = True
    for j in range(q.size):
        is_near = is_near and abs(q[j] - stored_q[j]) <= MAX_RELATIVE_DISTANCE * sizes[j]
    return is_near


@exact
def _has_same_entries(rows, entries):
    """Return True if `rows` and `entries`, a matrix stored row by row, have nonzero entries at the same places."""
    is_same, n = True, rows.shape[1]
    for i in range(entries.size // n):
        largest = largest_of(rows[i])
        for j in range(n):
            is_same = is_same and (abs(rows[i, j]) > NO_ENTRY * largest) == (entries[i * n + j] != 0.0)
    return is_same


@exact
def _index_of_near_position(q, rows, n_c, records):
    """Return the index in `records` (see `evaluate_start`) of a position near q with nonzeros as in `rows`, or -1."""
    n = q.size
    stride = 2 * n + n_c * n
    for k in range(0, records.size, stride):
        if _is_near(q, records[k : k + n], records[k + n : k + 2 * n]) and _has_same_entries(
            rows, records[k + 2 * n : k + stride]
        ):
            return k
    return -1


@exact
def _is_consistent(C, rate, rows, q, v, records, tolerance):
    """Return True if (q, v) satisfies the constraints up to rounding errors; `rows`: [C_q; A], `rate`: C_t and b.

    A violation is compared with the sum of |terms| of the constraint. In a term, |q_j| counts as at least the size of
    q_j in `records` (see `evaluate_start`), and at least the rounding error of max|q|; |v_j| counts as max|v|. Else a
    coordinate normal to a plane of motion, zero except for rounding, would seem to violate a constraint.
    """
    fastest, rounding = largest_of(v), ROUNDING_OF_ZERO * largest_of(q)
    begin = _index_of_near_position(q, rows, C.size, records)
    stored_sizes = q if begin < 0 else records[begin : begin + q.size]
    for i in range(len(rows)):
        speed = 0.0
        for j in range(q.size):
            if rows[i, j] != 0.0:
                speed += rows[i, j] * v[j]
        if not _is_rounding_error(speed + rate[i], rows[i], v, v, fastest, rate[i], tolerance):
            return False
        if i < C.size and not _is_rounding_error(C[i], rows[i], q, stored_sizes, rounding, 0.0, tolerance):
            return False
    return True


@exact
def _record_entries(rows, pattern):
    for i in range(len(rows)):
        for j in range(rows.shape[1]):
            # all entries are stored, even unchanged ones: without a branch, LLVM vectorizes the loop
            pattern[i, j] = 1.0 if rows[i, j] != 0.0 else pattern[i, j]


@exact
def _is_definite(mass, min_eigenvalue, factors):
    """Return True if all eigenvalues of M exceed `min_eigenvalue` times max|M_ij|; `factors` is scratch."""
    n, largest = len(mass), 0.0
    for i in range(n):
        for j in range(n):
            factors[i, j] = mass[i, j]
            largest = max(largest, abs(mass[i, j]))
    for i in range(n):
        factors[i, i] -= min_eigenvalue * largest
    return ldl_factor(factors)


@kernel(i8(KIT, f8, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR), vectorized=True)
def evaluate_start(f, t, q, v, records, lam, results, mass, rows, shifts, pattern, roundings):
    """Evaluate all callbacks at the start (t, q, v), and store their results; return the sum of the flags that apply.

    The flags are WELL_FORMED, CONSISTENT, DEFINITE and INDEFINITE. If a value is not finite, return 0. Arguments:

    - roundings: relative limits of the violation of constraints, the asymmetry of M, and the eigenvalues of M
    - records: for each of several positions, n_q sizes of coordinates, the position (n_q), and 1 where C_q is nonzero,
      else 0 (n_c n_q), see `keep` of checks/scales.py. `_is_consistent` uses them
    - lam: multipliers for the callback `reaction_by_q`
    - shifts: displacements of q, relative to max|q|, at which nonzero entries of [C_q; A] are also recorded
    - mass, rows, pattern: zeros on entry; on return M, [C_q; A], and 1 where [C_q; A] is nonzero, else 0
    - results: zeros on entry (size: `results_size`); on return the force, C, rates C_t and b, other results, scratch
    """
    n, n_c, n_rows = q.size, lam.size, rows.shape[0]
    # `results` contains the force, C, the rates C_t and b, and Gamma, one after the other: indices at which these end
    force, C, rate, gamma = n, n + n_c, n + n_c + n_rows, n + n_c + 2 * n_rows
    f.mass(t, q, f.p, mass)
    f.force(t, q, v, f.p, results[:force])
    f.constraint(t, q, f.p, results[force:C])
    f.jacobian(t, q, f.p, rows[:n_c])
    f.nonholonomic(t, q, f.p, rows[n_c:])
    f.constraint_rate(t, q, f.p, results[C : C + n_c])
    f.nonholonomic_rate(t, q, f.p, results[C + n_c : rate])
    if f.gamma_given == 1:
        f.gamma(t, q, v, f.p, results[rate : rate + n_c])
    if f.nonholonomic_gamma_given == 1:
        f.nonholonomic_gamma(t, q, v, f.p, results[rate + n_c : gamma])
    if f.kinematics_given == 1:
        fused_results = results[gamma : gamma + n_c * (n + 3)]
        fused_Cq = fused_results[3 * n_c :].reshape((n_c, n))
        f.kinematics(
            t, q, v, f.p, fused_results[:n_c], fused_Cq, fused_results[n_c : 2 * n_c], fused_results[2 * n_c : 3 * n_c]
        )
    end = gamma + n_c * (n + 3)
    if not (finite(mass) and finite(rows) and finite_vector(results[:end])):
        return 0
    scratch = results[end : end + n * n].reshape((n, n))
    if f.force_by_q_given == 1:
        f.force_by_q(t, q, v, f.p, scratch)
        if not finite(scratch):
            return 0
    if f.force_by_v_given == 1:
        _set_to_zero(scratch)
        f.force_by_v(t, q, v, f.p, scratch)
        if not finite(scratch):
            return 0
    if f.reaction_by_q_given == 1:
        _set_to_zero(scratch)
        f.reaction_by_q(t, q, lam, f.p, scratch)
        if not finite(scratch):
            return 0
    result_flags = 0
    if _is_symmetric(mass, roundings[1]) and not _has_empty_row(rows):
        result_flags = WELL_FORMED
        if _is_consistent(results[force:C], results[C:rate], rows, q, v, records, roundings[0]):
            result_flags |= CONSISTENT
    if f.constant_mass == 0:  # if the least eigenvalue of M is close to its limit, set neither DEFINITE nor INDEFINITE
        if _is_definite(mass, EIGENVALUE_MARGIN * roundings[2], scratch):
            result_flags |= DEFINITE
        elif not _is_definite(mass, roundings[2] / EIGENVALUE_MARGIN, scratch):
            result_flags |= INDEFINITE
    _record_entries(rows, pattern)
    rows_nearby = results[end : end + n_rows * n].reshape((n_rows, n))
    position, largest = results[end + n_rows * n : end + n_rows * n + n], largest_of(q)
    for k in range(len(shifts)):
        for j in range(n):
            position[j] = q[j] + max(abs(q[j]), largest) * shifts[k, j]
        _set_to_zero(rows_nearby)
        f.jacobian(t, position, f.p, rows_nearby[:n_c])
        f.nonholonomic(t, position, f.p, rows_nearby[n_c:])
        _record_entries(rows_nearby, pattern)
    return result_flags


@kernel(types.void(KIT, f8, MATRIX, i8, MATRIX))
def rows_at_positions(f, t, positions, n_c, rows):
    """Store C_q (n_c rows) and A in `rows` (zero on entry): first those at positions[0], then at positions[1], ..."""
    n_rows = len(rows) // len(positions)
    for k in range(len(positions)):
        begin = k * n_rows
        f.jacobian(t, positions[k], f.p, rows[begin : begin + n_c])
        f.nonholonomic(t, positions[k], f.p, rows[begin + n_c : begin + n_rows])


@exact
def _is_close(fused, separate, tolerance, rounding_errors):
    """Return True if all entries (i, j) of two matrices agree up to tolerance * max|separate| + rounding_errors[i]."""
    largest = 0.0
    for i in range(separate.shape[0]):
        for j in range(separate.shape[1]):
            largest = max(largest, abs(separate[i, j]))
    for i in range(separate.shape[0]):
        for j in range(separate.shape[1]):
            if abs(fused[i, j] - separate[i, j]) > tolerance * largest + rounding_errors[i]:
                return False
    return True


@kernel(types.boolean(KIT, f8, VECTOR, VECTOR, MATRIX, MATRIX, VECTOR, f8, f8))
def kinematics_agree(f, t, q, v, fused, separate, roundings, tolerance, rounding):
    """Return True if the callback `kinematics` agrees with the separate callbacks for C, C_t, gamma and C_q.

    In each of these, differences may be up to `tolerance` times the largest value; for C_i, `rounding` times the sum of
    |C_q[i, j] q_j| over j is added. On entry, `fused`, `separate` (3 + n_q, n_c) and `roundings` (n_c, scratch) are 0.
    On return, `fused` contains C, C_t, gamma and C_q by `kinematics`, and `separate` those by the separate callbacks.
    """
    n, n_c = q.size, roundings.size
    fused_rows, separate_rows = fused[3:].reshape((n_c, n)), separate[3:].reshape((n_c, n))
    f.kinematics(t, q, v, f.p, fused[0], fused_rows, fused[1], fused[2])
    f.constraint(t, q, f.p, separate[0])
    f.jacobian(t, q, f.p, separate_rows)
    f.constraint_rate(t, q, f.p, separate[1])
    f.gamma(t, q, v, f.p, separate[2])
    is_close = _is_close(fused_rows, separate_rows, tolerance, roundings)
    for k in range(1, 3):
        is_close = is_close and _is_close(
            fused[k : k + 1].reshape((n_c, 1)), separate[k : k + 1].reshape((n_c, 1)), tolerance, roundings
        )
    for i in range(n_c):
        for j in range(n):
            roundings[i] += rounding * abs(separate_rows[i, j]) * abs(q[j])
    return is_close and _is_close(fused[:1].reshape((n_c, 1)), separate[:1].reshape((n_c, 1)), tolerance, roundings)


VALUE, BOUND = range(2)  # rows of the array `nodes`: results of a trace's operations; bounds of their rounding errors

EPS = 2.0**-52
# largest allowed difference of a callback and its trace, apart from rounding, relative to the callback's largest value
MAX_DIFFERENCE = 1e-9
ROUNDING_FACTOR = 200.0 * EPS  # allowed rounding error of a number from a trace, divided by its bound in `bounds`


@exact
def _sum_with_bound(columns, coefficients, constant, nodes, begin, end):
    """Return constant + sum of coefficients[k] * nodes[VALUE, columns[k]] for begin <= k < end, and its error bound."""
    total, bound = constant, abs(constant)
    for k in range(begin, end):
        term = coefficients[k] * nodes[VALUE, columns[k]]
        total += term
        bound += abs(term) + abs(coefficients[k]) * nodes[BOUND, columns[k]]
    return total, bound


@exact
def _operation_with_bound(kind, x, bound_x, y, bound_y):
    """Return the result of an operation (`kind`) on x and y, and an error bound, given the error bounds of x and y."""
    z = result_of_operation(kind, x, y)
    if kind == op.PRODUCT:
        bound = abs(x) * bound_y + abs(y) * bound_x
    elif kind == op.RECIPROCAL:
        bound = bound_x * z * z
    elif kind == op.SQUARE_ROOT:
        bound = min(0.5 * bound_x / z, math.sqrt(bound_x / EPS)) if bound_x > 0.0 else 0.0
    elif kind == op.EXPONENTIAL:
        bound = bound_x * z
    elif kind == op.LOGARITHM:
        bound = bound_x / abs(x)
    elif kind == op.ARCTANGENT:
        bound = bound_x / (1.0 + x * x)
    else:
        bound = bound_x
    bound += abs(z)
    return z, 0.0 if math.isnan(bound) else bound


@exact
def _run_trace(program, columns, coefficients, constants, nodes, values, bounds):
    """Run a trace: store its results in `values`, and bounds of their rounding errors, in units of EPS, in `bounds`.

    `program`, `columns`, `coefficients` and `constants` describe the operations. On entry, `nodes` begins with t, q and
    v; the results of all operations are stored after v.
    """
    for i in range(len(program)):
        first, second, end = program[i, op.FIRST], program[i, op.SECOND], program[i, op.END]
        x, bound_x = _sum_with_bound(columns, coefficients, constants[i, 0], nodes, first, second)
        if program[i, op.KIND] == op.RESULT:
            values[program[i, op.NODE]], bounds[program[i, op.NODE]] = x, bound_x
        else:
            y, bound_y = _sum_with_bound(columns, coefficients, constants[i, 1], nodes, second, end)
            z, bound = _operation_with_bound(program[i, op.KIND], x, bound_x, y, bound_y)
            nodes[VALUE, program[i, op.NODE]], nodes[BOUND, program[i, op.NODE]] = z, bound


@exact
def _count_differences(called, traced, bounds):
    """Return how many entries of `called` are not finite, or differ from `traced` by more than rounding allows."""
    count = 0
    for i in range(called.shape[1]):
        largest = 0.0
        for k in range(len(called)):
            if math.isfinite(called[k, i]):
                largest = max(largest, abs(called[k, i]))
        for k in range(len(called)):
            if not abs(called[k, i] - traced[k, i]) <= MAX_DIFFERENCE * largest + ROUNDING_FACTOR * bounds[k, i]:
                count += 1
    return count


@kernel(
    i8(KIT, INTEGERS, INTEGERS, MATRIX, types.int64[:, ::1], INTEGERS, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, MATRIX)
)
def compare_traces(
    f, sizes, is_compared, states, program, columns, coefficients, constants, nodes, called, traced, bounds
):
    """Compare callbacks with their traces at `states`, which has rows [t, q, v]; return how many numbers differ.

    Two numbers count as different if they differ by more than MAX_DIFFERENCE times the largest value of the callback's
    entry at these states, plus ROUNDING_FACTOR times the error bound of the traced number. `sizes`: n_q, n_c and n_a.
    `is_compared`: 1 for each of KINDS in traced_values.py that is compared, else 0. The trace is given by `program`,
    `columns`, `coefficients` and `constants`. On return, `called` (zero on entry) contains values by callbacks,
    `traced` values by the trace, and `bounds` the error bounds of `traced`. `nodes` is scratch.
    """
    n, n_c, n_a = sizes[0], sizes[1], sizes[2]
    for k in range(len(states)):
        t, q, v, out = states[k, 0], states[k, 1 : 1 + n], states[k, 1 + n :], called[k]
        for i in range(1 + 2 * n):
            nodes[VALUE, i], nodes[BOUND, i] = states[k, i], 0.0
        _run_trace(program, columns, coefficients, constants, nodes, traced[k], bounds[k])
        begin = 0
        if is_compared[0]:
            f.mass(t, q, f.p, out[: n * n].reshape((n, n)))
            begin += n * n
        if is_compared[1]:
            f.force(t, q, v, f.p, out[begin : begin + n])
            begin += n
        if is_compared[2]:
            f.constraint(t, q, f.p, out[begin : begin + n_c])
            begin += n_c
        if is_compared[3]:
            f.jacobian(t, q, f.p, out[begin : begin + n_c * n].reshape((n_c, n)))
            begin += n_c * n
        if is_compared[4]:
            f.constraint_rate(t, q, f.p, out[begin : begin + n_c])
            begin += n_c
        if is_compared[5]:
            f.gamma(t, q, v, f.p, out[begin : begin + n_c])
            begin += n_c
        if is_compared[6]:
            f.nonholonomic(t, q, f.p, out[begin : begin + n_a * n].reshape((n_a, n)))
            begin += n_a * n
        if is_compared[7]:
            f.nonholonomic_rate(t, q, f.p, out[begin : begin + n_a])
            begin += n_a
        if is_compared[8]:
            f.nonholonomic_gamma(t, q, v, f.p, out[begin : begin + n_a])
    return _count_differences(called, traced, bounds)

"""Layout of the memory `work` of runs in lanes, operations on `work`, generated functions, and codes of ended runs.

`work` consists of vectors with one number for each lane (k: index of a lane). Offsets in `work`, and distances between
vectors, are counted in vectors; arguments such as `target` or `x` are offsets. The operations treat all lanes at once:
for example, they factor one matrix in each lane. The imaginary part of a complex number is `imaginary` vectors after
the real part; if `imaginary` is 0, the number is real.
"""

from typing import Any

from numba import types
from numba.extending import typeof_impl

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, has_wide_vectors
from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.data.common import INTEGERS, compiled, inlined, merged

UNDECIDED, ENDED = 0, 1  # status of a run: UNDECIDED if it has not ended yet, ENDED if it has reached its end t1
# negative status: why a run has to be repeated outside the lanes
(
    NO_START,  # the generated code could not compute the accelerations at the start
    NO_STATE,  # a state at an output time could not be projected
    NO_VALUES,  # accelerations are not finite, or the generated code is not valid, at a state in a step
    MANY_REJECTIONS,  # more successive steps were rejected than allowed, or steps became too short (SHORTEST)
    MANY_STEPS,  # the run has not ended after MAX_STEPS steps (see control.py)
    CALLBACKS_DIFFER,  # the final state does not satisfy the equations as the user's callbacks evaluate them
) = range(-6, 0)

LANES = 8 if has_wide_vectors() else 4  # number of runs at once: the number of doubles in a SIMD register

# offsets in `work` of the fields, vectors with one number for each lane. The arrays of `array_offsets` follow, such as
# STATE, the state at the beginning of the step, and NEW, the state at its end or within it
(
    T,  # time (s) of STATE, the state at the beginning of the step
    T_NEW,  # time (s) of NEW, the state at the end of the step or within it
    UNIT,  # unit of time in which a Taylor series is computed (s)
    H,  # size of the step (s)
    X,  # time (s) from the beginning of the step to NEW; during tasks of a Taylor series, in units of UNIT
    ACTIVE,  # 1 in lanes where the next task has to run; a task that fails in a lane stores 0 for this lane
    DEFECT,  # defect at the end of the step, relative to the allowed defect
    PREDICTION_ERROR,  # (difference of predicted and projected positions) / (allowed difference), see step_size.py
    LENGTH,  # step size that the last terms of a Taylor series allow, in units of UNIT
    LONGEST,  # upper limit of the next step size (s), which Taylor methods compute after each step
    REQUESTED,  # 1 in lanes whose start, or whose state at an output time within the step, is being projected
    WORST_DEFECT,  # largest defect within the step, relative to the allowed defect
    N_REJECTED,  # number of successive rejected steps
    RUNNING,  # 1 in lanes with a run
    RUN,  # index of the run in this lane
    N_OUTPUTS,  # number of output times that the run has reached
    UNCONVERGED,  # 1 in lanes whose projection has not converged yet
    LAST_CORRECTION,  # largest change of a position by the last correction of a projection
    ACCEPTED,  # 1 in lanes whose step was accepted
    IS_NEW,  # 1 in lanes whose run has not taken a step yet
    ERROR,  # error estimate of the step, in units of the tolerances
    H_FULL,  # size (s) of the step before it was shortened to reach the end of the run
    H_NEXT,  # size of the next step (s)
    H_LIMIT,  # upper limit of step sizes (s), set by a failed step; infinity: no limit
    LIMIT_AGE,  # number of accepted steps since H_LIMIT was set
    JUMP_END,  # time (s) at the end of the last step that was rejected with an error above SUDDEN_ERROR
    SHIFT,  # from 0 to 1; times at which the defect within a step is evaluated are shifted in proportion to 2 SHIFT - 1
    EVALUATED,  # number of evaluations within the step, in addition to settings[N_EVALUATIONS]
    DISPLACED,  # typical size of q (or v): finite differences displace smaller components as if they had this size
    LARGEST,  # largest |component| of the vector, q or v, that finite differences displace
    PAST,  # size and error of the last accepted step, for step-size control: both of lane 0, then both of lane 1, ...
    _MORE_PAST,
    N_FIELDS,
) = range(33)
# names of functions that are generated for each mechanism; methods of the same names, such as `commit` in
# generate/lane_code.py, write the code. Arguments: order of the Taylor series, settings `control`, memory `work`
TASKS = ("correct_positions", "correct_state", "check_redundant_rows", "compute_prediction_error", "commit")
TASKS_OF_STARTS, TASKS_OF_STAGES, TASKS_OF_EXPLICIT = ("compute_rows",), ("compute_accelerations",), ("compute_stages",)
TASKS_OF_SERIES = (
    *("compute_series", "choose_sizes", "check_defect_within"),
    *("evaluate_series", "evaluate_defect", "accept_or_reject"),
)
CODE = Reference("LaneKit", {})  # type of objects of the class LaneKit in compiled code
ALL_TASKS = (*TASKS, *TASKS_OF_STARTS, *TASKS_OF_STAGES, *TASKS_OF_EXPLICIT, *TASKS_OF_SERIES)
CODE.add_llvm_functions(dict.fromkeys(ALL_TASKS, types.none(types.int64, VECTOR, VECTOR)))
# signature of a method's step (code, settings, control, options, work, status, n_steps, within). In lanes with a run,
# the function takes a step, sets ACCEPTED, and stores the final state in NEW, accelerations in A, multipliers in LAM.
# If `within`, it takes no step: NEW becomes the unprojected state X seconds after the last accepted step began
STEP = types.void(CODE, INTEGERS, *[VECTOR] * 3, *[INTEGERS] * 2, types.boolean)
CODE.add_function("step", STEP)

# offsets in the memory of an explicit method, in units of n vectors (n: number of coordinates). START: accelerations at
# the beginning of the next step; BEGIN, _BEGIN_V: q and v at the beginning of this step; PREDICTED_V: velocities at the
# end of this step before the projection; SLOPES: accelerations at the stages
START, BEGIN, _BEGIN_V, PREDICTED_V, SLOPES = range(5)

# indices in `settings`, whole numbers that describe the mechanism and the method
(
    N,  # number of coordinates
    N_ROWS,  # number of constraints
    ORDER,  # order of the Taylor series
    CHECKS_REDUNDANT,  # 1: redundant constraints are checked at the end of each step; 0: they are not
    N_NUMBERS,  # number of coefficients that the generated code reads
    N_EVALUATIONS,  # number of evaluations of accelerations within a step
) = range(6)
# indices in `control`: start T0 and end T1 (s), longest time GAP (s) between evaluations, RTOL, first of n values ATOL
T0, T1, GAP, RTOL, ATOL = range(5)

SHORTEST = 1e-13  # smallest step size / max(|t|, |t1|); a run with shorter steps is ended, and repeated outside lanes


class LaneKit:
    """Hold the functions generated for a mechanism, and the step of a method; kernels receive a reference to this."""

    def __init__(self, own: GeneratedFunctions, step: Any = None):
        self.__dict__.update(dict.fromkeys(ALL_TASKS, 0))
        self.__dict__.update(own.addresses)
        self.own, self.step = own, step
        self.table = CODE.table(self)
        self.address = self.table.ctypes.data


@typeof_impl.register(LaneKit)
def _type_of_kit(value: Any, context: Any) -> Any:
    return CODE


def array_offsets(n, n_rows, n_numbers):
    """Return the offsets in `work`, in vectors, of the arrays that are stored after the fields (T to PAST).

    The arrays are STATE and NEW (q, v); PREDICTED (q before a projection); SERIES_A (accelerations by a Taylor series);
    A (accelerations) and LAM (multipliers); n_numbers coefficients of generated code; the memory of the method.
    """
    state = N_FIELDS
    new = state + 2 * n
    predicted = new + 2 * n
    series_a = predicted + n
    a = series_a + n
    lam = a + n
    numbers = lam + n_rows
    return state, new, predicted, series_a, a, lam, numbers, numbers + n_numbers


offsets_in_work = merged(array_offsets)


@merged
def fill_field(work, field, value):
    """Set the vector with offset `field` to `value` in all lanes."""
    for k in range(LANES):
        work[field * LANES + k] = value


@merged
def remove_run(work, status, k, reason):
    """Remove the run from lane k, to be repeated outside lanes; store the `reason`, such as NO_VALUES, in `status`."""
    work[RUNNING * LANES + k] = 0.0
    status[int(work[RUN * LANES + k])] = reason


@inlined
def vector_range(work, begin, count):
    """Return a flat view of `count` adjacent vectors of `work`, beginning at the offset `begin`."""
    return work[begin * LANES : (begin + count) * LANES]


@inlined
def matrix_view(work, begin, rows, count):
    """Return a view (rows, count * LANES) of adjacent vectors of `work`, beginning at the offset `begin`."""
    return work[begin * LANES : (begin + rows * count) * LANES].reshape((rows, count * LANES))


@compiled
def copy_vectors(work, source, target, count):
    """Copy `count` adjacent vectors from the offset `source` to the offset `target`."""
    for i in range(count * LANES):
        work[target * LANES + i] = work[source * LANES + i]


@merged
def _add_product_in_four_lanes(work, t, p, q, sign):
    """In one lane and the next three, add sign * work[p] * work[q] to work[t]. For SIMD, reads precede all writes."""
    t0, t1 = work[t] + sign * work[p] * work[q], work[t + 1] + sign * work[p + 1] * work[q + 1]
    t2, t3 = work[t + 2] + sign * work[p + 2] * work[q + 2], work[t + 3] + sign * work[p + 3] * work[q + 3]
    work[t], work[t + 1], work[t + 2], work[t + 3] = t0, t1, t2, t3


@compiled
def add_product(work, target, x, y, sign):
    """In each lane, add sign * (number at offset x) * (number at offset y) to the number at offset `target`."""
    for k in range(0, LANES, 4):
        _add_product_in_four_lanes(work, target * LANES + k, x * LANES + k, y * LANES + k, sign)


@merged
def _raised_value(work, target, error, factor, before, after, atol, rtol):
    """Return the larger of work[target] and |work[error]| * work[factor] / (allowed error), see `raise_to_ratio`."""
    allowed_error = atol + rtol * max(abs(work[before]), abs(work[after]))
    return max(work[target], abs(work[error]) * work[factor] / allowed_error)


@compiled
def raise_to_ratio(work, target, error, factor, before, after, atol, rtol):
    """In each lane, store at `target` the ratio of an error to its tolerance, unless the number there is larger.

    The ratio is |error| * factor / (atol + rtol * max(|before|, |after|)); all names but atol and rtol are offsets.
    """
    for k in range(0, LANES, 4):
        m, e, f, x, y = target * LANES + k, error * LANES + k, factor * LANES + k, before * LANES + k, after * LANES + k
        m0 = _raised_value(work, m, e, f, x, y, atol, rtol)
        m1 = _raised_value(work, m + 1, e + 1, f + 1, x + 1, y + 1, atol, rtol)
        m2 = _raised_value(work, m + 2, e + 2, f + 2, x + 2, y + 2, atol, rtol)
        m3 = _raised_value(work, m + 3, e + 3, f + 3, x + 3, y + 3, atol, rtol)
        work[m], work[m + 1], work[m + 2], work[m + 3] = m0, m1, m2, m3


@merged
def _multiply_number(work, target, imaginary_target, x, imaginary):
    """In each lane, multiply the number at offset `target` by the number at offset x.

    If `imaginary` is 0, both are real. Otherwise the imaginary parts are at target + imaginary_target, x + imaginary.
    """
    for k in range(LANES):
        t, p = target * LANES + k, x * LANES + k
        if imaginary == 0:
            work[t] *= work[p]
        else:
            i, j = imaginary_target * LANES, imaginary * LANES
            re, im = work[t] * work[p] - work[t + i] * work[p + j], work[t] * work[p + j] + work[t + i] * work[p]
            work[t], work[t + i] = re, im


@merged
def _subtract_product(work, target, x, y, imaginary, imaginary_y):
    """In each lane, subtract the product of the numbers at offsets x and y from the number at offset `target`.

    If `imaginary` is 0, the numbers are real. Otherwise the imaginary part of x is `imaginary` vectors after the real
    part; the imaginary parts of y and `target` are `imaginary_y` vectors after the real parts.
    """
    add_product(work, target, x, y, -1.0)
    if imaginary > 0:
        add_product(work, target, x + imaginary, y + imaginary_y, 1.0)
        add_product(work, target + imaginary_y, x, y + imaginary_y, -1.0)
        add_product(work, target + imaginary_y, x + imaginary, y, -1.0)


@merged
def _exchange_entries(work, first, second, k):
    i, j = first * LANES + k, second * LANES + k
    work[i], work[j] = work[j], work[i]


@merged
def _pivot_magnitude(work, entry, imaginary, k):
    """Return |x| of the number x at offset `entry` in lane k or, if `imaginary` > 0 (complex), |re x| + |im x|."""
    magnitude = abs(work[entry * LANES + k])
    return magnitude if imaginary == 0 else magnitude + abs(work[(entry + imaginary) * LANES + k])


@compiled
def _choose_pivot(work, matrix, pivots, n, imaginary, c):
    """In each lane, find the pivot (largest entry of column c from row c on), exchange rows, and invert the pivot.

    Row c is exchanged with the pivot's row, whose index is stored in `pivots`. If the pivot is 0, set ACTIVE to 0.
    """
    for k in range(LANES):
        best, largest = c, _pivot_magnitude(work, matrix + c * n + c, imaginary, k)
        for i in range(c + 1, n):
            magnitude = _pivot_magnitude(work, matrix + i * n + c, imaginary, k)
            if magnitude > largest:
                best, largest = i, magnitude
        work[(pivots + c) * LANES + k] = best
        if best != c:
            for j in range(n):
                _exchange_entries(work, matrix + c * n + j, matrix + best * n + j, k)
                if imaginary > 0:
                    _exchange_entries(work, matrix + c * n + j + imaginary, matrix + best * n + j + imaginary, k)
        if not largest > 0.0:
            work[ACTIVE * LANES + k] = 0.0
        re = (matrix + c * n + c) * LANES + k
        if imaginary == 0:
            work[re] = 1.0 / work[re]
        else:
            im = re + imaginary * LANES
            squared_modulus = work[re] * work[re] + work[im] * work[im]
            work[re], work[im] = work[re] / squared_modulus, -work[im] / squared_modulus


@compiled
def factor_matrices(work, matrix, pivots, n, imaginary):
    """Replace a matrix (n, n) in each lane by its LU factors, with inverted pivots; store row exchanges in `pivots`.

    If `imaginary` > 0, entries are complex, with imaginary parts `imaginary` vectors after the real parts.
    """
    for c in range(n):
        _choose_pivot(work, matrix, pivots, n, imaginary, c)
        for i in range(c + 1, n):
            _multiply_number(work, matrix + i * n + c, imaginary, matrix + c * n + c, imaginary)
            for j in range(c + 1, n):
                row, column = matrix + i * n + c, matrix + c * n + j
                _subtract_product(work, matrix + i * n + j, row, column, imaginary, imaginary)


@compiled
def solve_systems(work, matrix, pivots, n, imaginary, x):
    """Replace a right-hand side x (n) in each lane by the solution, using the factors from `factor_matrices`.

    If `imaginary` > 0, entries are complex, see `factor_matrices`; imaginary parts of x are n vectors after real parts.
    """
    imaginary_x = n if imaginary > 0 else 0
    for c in range(n):
        for k in range(LANES):
            pivot_row = int(work[(pivots + c) * LANES + k])
            if pivot_row != c:
                _exchange_entries(work, x + c, x + pivot_row, k)
                if imaginary > 0:
                    _exchange_entries(work, x + n + c, x + n + pivot_row, k)
    for i in range(n):
        for j in range(i):
            _subtract_product(work, x + i, matrix + i * n + j, x + j, imaginary, imaginary_x)
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            _subtract_product(work, x + i, matrix + i * n + j, x + j, imaginary, imaginary_x)
        _multiply_number(work, x + i, imaginary_x, matrix + i * n + i, imaginary)


MAX_PASSES = 10  # largest number of times that a projection calls the generated function `correct_state`


@compiled
def project_lanes(code, order, control, work):
    """Project the state NEW onto the constraints in lanes with ACTIVE = 1; set ACTIVE to 0 where this fails."""
    code.correct_positions(order, control, work)
    for _ in range(MAX_PASSES):
        code.correct_state(order, control, work)
        n_left = 0.0
        for k in range(LANES):
            n_left += work[UNCONVERGED * LANES + k]
        if n_left == 0.0:
            break

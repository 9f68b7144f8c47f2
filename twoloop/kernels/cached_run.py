"""Start a run and take its first steps in one compiled call, for runs with the same options as an earlier one.

`start_and_advance` checks the start, takes steps with the setup of the earlier run, and stores all results in one
array. Python copies the array, and splits the copy when a field of the result is read. The parts of the array are

    unused | report: N_REPORT numbers, counters | times | steps | states | unused

`advance` writes the states, which begin at a fixed index. As the numbers of times and steps are known only afterwards,
the report, times and steps are then copied to the places before this index. Argument `b`: RUN_ARRAYS.
"""

import math

import numpy as np
from numba import types

from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.control import loop_state as at
from twoloop.kernels.control.discontinuities import N_SAMPLES
from twoloop.kernels.data import indices
from twoloop.kernels.data.common import (
    INTEGERS,
    KIT,
    MATRIX,
    VECTOR,
    WORK,
    exact,
    f8,
    finite_vector,
    i8,
    kernel,
    merged,
)
from twoloop.kernels.data.indices import DEFECT_GAP, GAP, MAX_GAP_RATIO, N_COUNTERS
from twoloop.kernels.evaluation.checks import CONSISTENT, DEFINITE, INDEFINITE, WELL_FORMED
from twoloop.kernels.evaluation.partition import ROUNDING_ERROR
from twoloop.kernels.linalg.dense import copy


@merged
def prepare_work(w, numbers, integers, pattern, q, accuracy, reuse):
    """Reset the workspace `w` in place before a run that starts at the position q (n_q).

    `numbers`, `integers`: arrays of `w` that keep data from step to step; set to zero here. `pattern`: 1 for entries of
    [C_q; A] that may be nonzero, else 0. `accuracy`: allowed relative error of gamma by finite differences. `reuse`:
    if a correction of positions is at most this, the inner loop does not evaluate C_q again.
    """
    for k in range(numbers.size):
        numbers[k] = 0.0
    for k in range(integers.size):
        integers[k] = 0
    for i in range(w.G_of_S.shape[0]):
        for j in range(w.G_of_S.shape[1]):
            w.G_of_S[i, j] = math.nan
    for i in range(pattern.shape[0]):
        for j in range(pattern.shape[1]):
            w.pattern[i, j] = pattern[i, j]
    rounding_error = 0.0
    for j in range(q.size):
        rounding_error = max(rounding_error, ROUNDING_ERROR * abs(q[j]))
    w.rounded, w.reuse = rounding_error, max(reuse, rounding_error)
    w.gamma_required, w.gamma_step_ratio = accuracy, 1.0
    w.last_jump, w.next_jump = -math.inf, math.inf


@kernel(types.void(WORK, VECTOR, INTEGERS, MATRIX, VECTOR, f8, f8))
def prepare_workspace(w, numbers, integers, pattern, q, accuracy, reuse):
    """Call `prepare_work`, which Python cannot call because it is compiled into its callers only."""
    prepare_work(w, numbers, integers, pattern, q, accuracy, reuse)


FIRST_STEP = 0.01  # first step size, relative to the shortest time scale of the initial motion, see _first_step_size
MIN_FIRST_STEP = 1e4  # smallest first step size, in spacings of floating-point numbers at the start time
MIN_GAP = 40.0  # the allowed time between evaluations is at least this number of spacings of floating-point times
SHORTEST_STEP = 1e-16  # a run fails if a step would be shorter than this fraction of the first step
# GAP is the longest allowed time (s) between evaluations; DEFECT_GAP replaces it in steps that check their defect. If
# forces may change suddenly with q or v, DEFECT_GAP is GAP / GAP_RATIO; if not, both times are equal
GAP_RATIO = 10


@exact
def _first_step_size(state, n, t, span, smallest):
    """Return the first step size (s): FIRST_STEP times the shortest time scale of the motion from `state` [q, v, a].

    The time scales are the run's duration `span` (s), x / max|v| and sqrt(x / max|a|) with x = max(max|q|, `smallest`),
    and max|v| / max|a|. The step is at least MIN_FIRST_STEP floating-point spacings at t.
    """
    distance, speed, acceleration = smallest, 0.0, 0.0
    for j in range(n):
        distance, speed = max(distance, abs(state[j])), max(speed, abs(state[n + j]))
        acceleration = max(acceleration, abs(state[2 * n + j]))
    time_scale = span
    if speed > 0.0:
        time_scale = min(time_scale, distance / speed)
    if acceleration > 0.0:
        time_scale = min(time_scale, math.sqrt(distance / acceleration))
    # the time in which v changes by max|v| does not count if it is very short: the mechanism starts almost at rest
    if speed > 0.0 and acceleration > 0.0 and speed / acceleration > FIRST_STEP * time_scale:
        time_scale = min(time_scale, speed / acceleration)
    return max(FIRST_STEP * time_scale, MIN_FIRST_STEP * np.spacing(abs(t)))


@exact
def _set_step_limits(control, tolerances, t, t1, longest, within):
    """Store three limits: of the step size, of the time between evaluations, and of the time between samples of forces.

    Evaluations (of the equations) are at most MAX_GAP_RATIO * (t1 - t) s apart, which also limits the step size. If the
    method adds evaluations within long steps (`within` is True), only `longest` (s) limits the step size.
    """
    max_gap = max(MAX_GAP_RATIO * (t1 - t), MIN_GAP * np.spacing(max(abs(t), abs(t1))))
    tolerances[GAP], tolerances[DEFECT_GAP] = max_gap, max_gap / (GAP_RATIO if control[at.BY_STATE] > 0.0 else 1.0)
    control[at.MAX_STEP] = longest if within else min(longest, max_gap / control[at.MAX_EVALUATION_GAP])
    control[at.TIME_SPACING] = max_gap / N_SAMPLES
    control[at.SPACING] = control[at.TIME_SPACING] if control[at.BY_TIME] + control[at.BY_STATE] > 0.0 else 0.0


@kernel(f8(VECTOR, VECTOR, VECTOR, i8, f8, f8, f8, f8, types.boolean))
def first_step_and_limits(control, tolerances, state, n, t, t1, smallest, longest, within):
    """Call `_set_step_limits` if `longest` (s) is above 0; return the result of `_first_step_size` (s)."""
    if longest > 0.0:
        _set_step_limits(control, tolerances, t, t1, longest, within)
    return _first_step_size(state, n, t, t1 - t, smallest)


@merged
def _is_within_bounds(t, rows, bounds):
    """Return True if, for all k, each number of [t[k], rows[k]] is between its limits in bounds[0] and bounds[1]."""
    for k in range(t.size):
        if not bounds[0, 0] <= t[k] <= bounds[1, 0]:
            return False
        for j in range(1, bounds.shape[1]):
            if not bounds[0, j] <= rows[k, j - 1] <= bounds[1, j]:
                return False
    return True


@kernel(types.void(MATRIX, INTEGERS, VECTOR, types.int64[:, ::1], types.boolean[::1]))
def split_steps(steps, counts, h, changes, used_newton):
    """Split `steps`, the records of steps (rows of out_steps, see loop_state.py), into arrays with one entry per step.

    `h` receives the step sizes (s), `used_newton` True for steps by Newton's method. The three rows of `changes` count
    events since the previous step: rejections by the error test, failed steps, and new partitions. `counts` contains
    the numbers of these events since the start of the run: on entry, before the first step; on return, after the last.
    """
    for k in range(h.size):
        h[k], used_newton[k] = steps[k, at.H], steps[k, at.JACOBIANS] > 0.0
        for i in range(counts.size):
            count = int(steps[k, at.ERRORS + i])
            changes[i, k], counts[i] = count - counts[i], count


REFUSED = -1  # returned code: no steps were taken; Python must set up the run anew, or report an error of the start
IN_DOUBT = -2  # returned code: no steps were taken; Python must check whether the start satisfies the constraints
UNUSUAL = -3  # returned code: steps were taken, but Python must read the report, and may have to continue the run
UNCHOSEN = -4  # returned code: no steps were taken; Python must check whether the generated code suits the start
# values of `checks`. STATE_CHECKED: Python has checked that the start satisfies the constraints. CHOICES_CHECKED:
# Python has also checked that the generated code suits the start
NOTHING_CHECKED, STATE_CHECKED, CHOICES_CHECKED = 0, 1, 2

# arrays of a run, which later runs with the same options reuse. Among them are
# - `numbers`: one array with the parts clock, control, tolerances; `start_numbers`: values of `numbers` before a run
# - `start_memory`: numbers that the method's `memory` contains before a run, at the indices `memory_places`
# - `last_start`: a count (N_EQUAL), then t, t1, q, v of the last start; `start_rows`: indices of its independent rows
# - `saved`, `saved_integers`: all data computed at a start; if more runs begin at this start, they restore these data
RUN_ARRAYS = Reference(
    "RunArrays",
    {
        **dict.fromkeys(
            ("start_values", "lam", "room", "roundings", "bounds", "scratch", "constants", "saved", "search"), VECTOR
        ),
        **dict.fromkeys(("start_numbers", "numbers", "start_memory", "memory", "lasting", "options"), VECTOR),
        **dict.fromkeys(
            ("tolerances", "control", "clock", "state", "new_state", "last_start", "end", "t", "report"), VECTOR
        ),
        **dict.fromkeys(("mass", "rows", "shifts", "pattern", "states", "steps"), MATRIX),
        **dict.fromkeys(("chosen", "expected", "lapack", "lasting_integers", "saved_integers"), INTEGERS),
        **dict.fromkeys(("memory_places", "filled", "kinds", "counted", "search_places", "blocks", "found"), INTEGERS),
        "start_rows": INTEGERS,
    },
)
RUN_ARRAYS.add_function("evaluate_start", i8(KIT, f8, *(VECTOR,) * 5, *(MATRIX,) * 4, VECTOR))
RUN_ARRAYS.add_function("choose", i8(MATRIX, MATRIX, f8, f8, VECTOR, VECTOR, INTEGERS))
RUN_ARRAYS.add_function("dependents", i8(MATRIX, INTEGERS, INTEGERS, i8, VECTOR, INTEGERS, INTEGERS))
RUN_ARRAYS.add_function("start", i8(KIT, WORK, f8, VECTOR))
RUN_ARRAYS.add_function("advance", i8(KIT, WORK, *(VECTOR,) * 9, MATRIX, MATRIX, INTEGERS))
# indices in `constants`, the settings of runs; G are the constraint rows [C_q; A]
(
    ACCURACY,  # initial w.gamma_required: allowed relative error of gamma, if finite differences yield it
    REUSE,  # initial w.reuse: after a correction of q of at most this, the inner loop does not evaluate C_q again
    NEARLY_SINGULAR,  # initial w.nearly_singular. 0: short steps trigger checks for singular positions; 1: they do not
    HAS_ALL_ENTRIES,  # 1: the array `kinds` shows all entries of G that may be nonzero; 0: search for them at the start
    RANK_LIMIT,  # a row of G is redundant if its part orthogonal to previous rows is at most this fraction of its norm
    WEAK_LIMIT,  # M counts as singular if the ratio of its smallest to its largest eigenvalue is below this
    ADDED_SCALE,  # factor s: for a singular M, generated code uses M + s g^T g instead, where g are some rows of G
    CONTRADICTS,  # a start is refused if a residual of G a = gamma exceeds this times max(1, sum of |terms| in the row)
    MASS_FLAG,  # a start is refused unless M has this flag there: DEFINITE or INDEFINITE; 0: no flag, as M is constant
    LEAST_PIVOT,  # a start is refused if the smallest pivot of C_q at the start is below this
    EQUATION_FORM,  # initial f.form, the algebra that solves for accelerations
    FIRST_SIZE,  # first step size (s) chosen by the user; 0: `_first_step_size` computes it
    LEAST_DISTANCE,  # argument `smallest` of _first_step_size, where max|q| counts as at least this
    LONGEST,  # longest step (s): argument `longest` of _set_step_limits
    EVALUATES_WITHIN,  # 1: the method adds evaluations within long steps; 0: it does not, which limits the step size
    NEAR_PIVOT,  # Python must check a run if, at an output time, (smallest / largest pivot of C_q) is below this
    MAX_CHANGE_RATIO,  # v jumps in a step if max|change of v| > this * (step size) * (smaller max|a| of the two ends)
    MIN_SAMPLES,  # Python must check a run if two sudden changes of a force, C_t or b are closer than this many samples
) = range(18)
# indices in `expected`, which lists the constraint rows that generated code uses (empty without generated code)
(
    BOUND,  # generated code needs pivots above MIN_PIVOTS[this] (elimination.py); OF_PYTHON: Python must choose rows
    N_ROWS,  # number of independent rows
    N_ADDED,  # number of rows g that are added to a singular M as s g^T g
    FIRST_ROW,  # from this index on, `expected` lists the independent rows, then the rows g added to M as s g^T g
) = range(4)
OF_PYTHON = 100


@merged
def _has_choices_of_code(b):
    """Choose independent rows and dependent coordinates anew; return True if the code was generated for this choice."""
    b.scratch[0] = 0.0
    limits = b.constants[RANK_LIMIT], b.constants[WEAK_LIMIT]
    first_bound = b.choose(b.mass, b.rows, *limits, b.bounds, b.scratch, b.chosen)
    n_rows, n_added = b.expected[N_ROWS], b.expected[N_ADDED]
    if b.chosen[0] != n_rows:
        return False
    if n_rows == 0:
        return True
    if first_bound != b.expected[BOUND] or b.chosen[1] != n_added or b.scratch[0] != b.constants[ADDED_SCALE]:
        return False
    is_same = True
    for k in range(n_rows):
        is_same = is_same and b.chosen[2 + k] == b.expected[FIRST_ROW + k]
    for k in range(n_added):
        is_same = is_same and b.chosen[2 + len(b.rows) + k] == b.expected[FIRST_ROW + n_rows + k]
    if is_same and b.kinds.size > 0:
        n = 4 * b.dependents(b.rows, b.kinds, b.counted, b.counted.size, b.search, b.search_places, b.found)
        is_same = n == b.blocks.size
        for k in range(b.blocks.size):
            is_same = is_same and b.found[k] == b.blocks[k]
    return is_same


@merged
def _has_consistent_rows(w, b, n):
    """Return True if the accelerations a in b.state satisfy all rows of G a = gamma, also the redundant ones."""
    if w.rows_v.size == len(b.rows):
        return True
    for i in range(len(b.rows)):
        residual, sum_of_terms = -w.Gamma[i], abs(w.Gamma[i])
        for j in range(n):
            residual += b.rows[i, j] * b.state[2 * n + j]
            sum_of_terms += abs(b.rows[i, j] * b.state[2 * n + j])
        if not abs(residual) <= b.constants[CONTRADICTS] * max(sum_of_terms, 1.0):
            return False
    return True


@merged
def _start_run(f, checked_kit, w, b, t, t1, q, v, records, checks):
    """Check and prepare the start of a run from t to t1; return 0 if the run may begin, else a code such as REFUSED.

    `checked_kit`: kit with the user's callbacks, which check the start (callbacks of `f` may be derived from them).
    `checks`: what Python has checked, such as STATE_CHECKED. `records`: earlier positions, see `evaluate_start`.
    """
    n = q.size
    if not (finite_vector(q) and finite_vector(v)):
        return REFUSED
    has_all_entries = b.constants[HAS_ALL_ENTRIES] > 0.0
    shifts = b.shifts[: 0 if has_all_entries else len(b.shifts)]
    for k in range(b.start_values.size):
        b.start_values[k] = 0.0
    flags = b.evaluate_start(
        checked_kit, t, q, v, records, b.lam, b.room, b.mass, b.rows, shifts, b.pattern, b.roundings
    )
    if has_all_entries:
        pattern = b.pattern.reshape(b.pattern.size)
        for k in range(b.kinds.size):  # b.kinds[k] is 0 if entry k of [C_q; A] is always zero
            pattern[k] = 1.0 if b.kinds[k] != 0 else pattern[k]
    if flags & WELL_FORMED == 0 or flags & (DEFINITE | INDEFINITE) != int(b.constants[MASS_FLAG]):
        return REFUSED
    if flags & CONSISTENT == 0 and checks < STATE_CHECKED:
        return IN_DOUBT
    if b.expected.size > 0 and checks < CHOICES_CHECKED:
        if b.expected[BOUND] == OF_PYTHON:
            return UNCHOSEN
        if not _has_choices_of_code(b):
            return REFUSED
    copy(b.start_numbers, b.numbers)
    for j in range(b.state.size):
        b.state[j] = q[j] if j < n else v[j - n] if j < 2 * n else 0.0
    b.clock[at.T] = b.clock[at.T_START] = t
    prepare_work(w, b.lasting, b.lasting_integers, b.pattern, q, b.constants[ACCURACY], b.constants[REUSE])
    copy(b.lapack, w.lapack[: b.lapack.size])
    w.nearly_singular = b.constants[NEARLY_SINGULAR]
    if b.start(f, w, t, b.state) != indices.DONE or not _has_consistent_rows(w, b, n):
        return REFUSED
    if w.pivot < b.constants[LEAST_PIVOT]:
        return REFUSED
    w.next_jump = t1
    if b.control[at.FIXED_STEP] == 0.0:
        span, h, within = t1 - t, b.constants[FIRST_SIZE], b.constants[EVALUATES_WITHIN] > 0.0
        _set_step_limits(b.control, b.tolerances, t, t1, b.constants[LONGEST], within)
        first_size = h if h > 0.0 else _first_step_size(b.state, n, t, span, b.constants[LEAST_DISTANCE])
        b.clock[at.H_NEXT] = min(first_size, span)
        b.control[at.SHORTEST] = SHORTEST_STEP * b.clock[at.H_NEXT]
    copy(w.rows_v, b.start_rows)
    return 0


@merged
def _save_start(b):
    i, j = b.numbers.size, b.numbers.size + b.lasting.size
    copy(b.numbers, b.saved[:i])
    copy(b.lasting, b.saved[i:j])
    copy(b.state, b.saved[j:])
    copy(b.lasting_integers, b.saved_integers)


@merged
def _restore_start(b):
    i, j = b.numbers.size, b.numbers.size + b.lasting.size
    copy(b.saved[:i], b.numbers)
    copy(b.saved[i:j], b.lasting)
    copy(b.saved[j:], b.state)
    copy(b.saved_integers, b.lasting_integers)


N_EQUAL = 0  # last_start[N_EQUAL]: number of successive runs from the last start, counted up to 2
START = 1  # last_start[START:]: the last start, [t, t1, q, v], where t1 is the end of the run
# values of last_start[N_EQUAL]. NEVER: the last start must not be reused. IS_SAVED: its data are stored in b.saved
NEVER, IS_SAVED = 0.0, 2.0


@exact
def _equals_last_start(last_start, t, t1, q, v):
    """Return True if the start (t, t1, q, v) equals the last start bit for bit; store it as the last start."""
    n, is_same = q.size, last_start[N_EQUAL] > NEVER
    for k in range(2 + 2 * n):
        x = t if k == 0 else t1 if k == 1 else q[k - 2] if k < 2 + n else v[k - 2 - n]
        last_value = last_start[START + k]
        is_same = is_same and x == last_value and math.copysign(1.0, x) == math.copysign(1.0, last_value)
        last_start[START + k] = x
    return is_same


# indices in the report of a run
(
    N_STATES,  # number of states, including the first
    N_STEPS,  # number of steps
    NOTHING_TO_CHECK,  # 1: no jump of velocities, no singular position near, no force too fast to be sampled; else 0
    JUMPED,  # 1: velocities jumped in the last step (see MAX_CHANGE_RATIO); else 0
    IN_CHECKED_REGION,  # 1: all states are in the region in which callbacks agreed with their traces; else 0
    DEFECT_KNOWN,  # 1: the defect (of accelerations) was evaluated in every step; else 0
    DEFECT,  # largest defect, divided by its tolerance
    LONGEST_GAP,  # longest time (s) between two evaluations of the equations
    END_CODE,  # code that `advance` returned
    IS_NEW,  # 1: the start differs from the start of the previous run; 0: both are equal
    N_REPORT,  # number of entries above; counters (of steps, rejections, evaluations, ...) begin at this index
) = range(11)
N_HEAD = N_REPORT + N_COUNTERS  # length of the report with counters, without times and steps


@merged
def _has_velocity_jump(b, k, n):
    """Return True if velocities jump between states k - 1 and k of n coordinates, see MAX_CHANGE_RATIO."""
    change, first, last = 0.0, 0.0, 0.0
    for j in range(n):
        change = max(change, abs(b.states[k, n + j] - b.states[k - 1, n + j]))
        first, last = max(first, abs(b.states[k - 1, 2 * n + j])), max(last, abs(b.states[k, 2 * n + j]))
    return change > b.constants[MAX_CHANGE_RATIO] * (b.t[k] - b.t[k - 1]) * min(first, last)


@merged
def _write_report(w, b, region, n_rows, n_steps, code, is_new):
    """Store the report, times and steps of a run in b.report; return n_steps, or UNUSUAL if Python must read b.report.

    `n_rows`: number of states after the first. `code`: end code of `advance`. `is_new`: value of IS_NEW. `region`: two
    rows, the least and the greatest [t, q, v] at which callbacks were checked.
    """
    has_jumped = n_rows > 0 and _has_velocity_jump(b, n_rows, w.Q.size)
    is_inside = region.shape[1] > 0 and _is_within_bounds(b.t[: 1 + n_rows], b.states, region)
    is_near_singular = b.clock[at.PIVOT_AT_OUTPUT] < b.constants[NEAR_PIVOT]
    is_undersampled = b.clock[at.SHORTEST_CHANGE] < b.constants[MIN_SAMPLES] * b.clock[at.WIDEST_SAMPLING]
    nothing_to_check, width = not (has_jumped or is_near_singular or is_undersampled), b.steps.shape[1]
    begin = b.report.size - N_HEAD - 1 - n_rows - width * n_steps
    report = b.report[begin:]
    report[N_STATES], report[N_STEPS], report[NOTHING_TO_CHECK] = 1 + n_rows, n_steps, nothing_to_check
    report[JUMPED], report[IN_CHECKED_REGION], report[END_CODE], report[IS_NEW] = has_jumped, is_inside, code, is_new
    report[DEFECT_KNOWN] = w.n_accepted > 0 and w.unchecked == 0.0
    report[DEFECT], report[LONGEST_GAP] = w.largest_defect, w.widest_gap
    for k in range(N_COUNTERS):
        report[N_REPORT + k] = w.counters[k]
    copy(b.t[: 1 + n_rows], report[N_HEAD : N_HEAD + 1 + n_rows])
    for k in range(n_steps):
        copy(b.steps[k], report[N_HEAD + 1 + n_rows + k * width : N_HEAD + 1 + n_rows + (k + 1) * width])
    is_usual = code == at.ALL_OUTPUT_DONE and nothing_to_check and is_inside and n_rows == n_steps
    b.filled[0], b.filled[1] = n_rows, n_steps
    return n_steps if is_usual else UNUSUAL


@kernel(i8(KIT, KIT, WORK, RUN_ARRAYS, f8, f8, VECTOR, VECTOR, VECTOR, MATRIX, i8), vectorized=True)
def start_and_advance(f, checked_kit, w, b, t, t1, q, v, records, region, checks):
    """Start a run from t to t1, and take the first steps; return the number of steps, or a code such as REFUSED.

    If several runs in succession begin at the same start, the second run saves all data computed at the start. Later
    runs restore these data, and do not check the start again. For the arguments see _start_run and _write_report.
    """
    f.form = int(b.constants[EQUATION_FORM])  # the previous run may have changed the form of the linear equations
    is_repeated, n_equal = _equals_last_start(b.last_start, t, t1, q, v), b.last_start[N_EQUAL]
    if is_repeated and n_equal == IS_SAVED:
        _restore_start(b)
    else:
        b.last_start[N_EQUAL] = NEVER
        checks = CHOICES_CHECKED if is_repeated else checks
        start_code = _start_run(f, checked_kit, w, b, t, t1, q, v, records, checks)
        if start_code != 0:
            return start_code
        if is_repeated:
            _save_start(b)
        b.last_start[N_EQUAL] = IS_SAVED if is_repeated else 1.0
    for k in range(b.memory.size):
        b.memory[k] = 0.0
    for k in range(b.memory_places.size):
        b.memory[b.memory_places[k]] = b.start_memory[k]
    b.end[0], b.t[0] = t1, t
    copy(b.state, b.states[0])
    arrays = b.tolerances, b.control, b.clock, b.state, b.new_state
    code = b.advance(f, w, b.options, b.memory, *arrays, b.end, b.t[1:], b.states[1:], b.steps, b.filled)
    return _write_report(w, b, region, b.filled[0], b.filled[1], code, not is_repeated)

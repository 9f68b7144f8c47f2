"""Start a run and take its first steps in one compiled call, which stores all results in one array.

`start_and_advance` checks the start, keeps the independent rows and dependent coordinates of the previous run, takes
steps, and fills one array (`f` is the kit, `w` the workspace; `b` has the other arrays, see RUN_ARRAYS):

    unused | report: N_REPORT numbers, counters | times | steps | states | unused
                                                                ^ a fixed index
`advance` writes the states, which begin at the fixed index. The other parts, whose length depends on the number of
steps, are copied to the places before it. Python copies the used part as one slice, and splits it when it is read.
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
from twoloop.kernels.linalg.dense import copy

ROUNDING = 1e-15  # rounding error of positions, relative to the largest coordinate: no smaller corrections are made


@merged
def prepare_work(w, numbers, integers, pattern, q, accuracy, reuse):
    """Reset the workspace `w` in place before a run that starts at the position q (n_q).

    `numbers`, `integers`: the parts of `w` that keep data from step to step; `pattern`: copied to w.pattern;
    `accuracy`: the new w.gamma_required; `reuse`: lower limit of the new w.reuse (see data/indices.py).
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
        rounding_error = max(rounding_error, ROUNDING * abs(q[j]))
    w.rounded, w.reuse = rounding_error, max(reuse, rounding_error)
    w.gamma_required, w.gamma_step_ratio = accuracy, 1.0
    w.last_jump, w.next_jump = -math.inf, math.inf


@kernel(types.void(WORK, VECTOR, INTEGERS, MATRIX, VECTOR, f8, f8))
def prepare_workspace(w, numbers, integers, pattern, q, accuracy, reuse):
    """Call `prepare_work`; Python can call this function, but not `prepare_work`, which is merged into its callers."""
    prepare_work(w, numbers, integers, pattern, q, accuracy, reuse)


FIRST_STEP = 0.01  # first step size, relative to the shortest time scale of the initial motion, see _first_step_size
MIN_FIRST_STEP = 1e4  # smallest first step size, in spacings of floating-point numbers at the start time
SHORTEST_STEP = 1e-16  # a run fails if a step would be shorter than this fraction of the first step
GAP_RATIO = 10  # GAP / DEFECT_GAP (see `tolerances`) if forces may change suddenly with position or velocity


@exact
def _first_step_size(state, n, t, span, smallest):
    """Return the first step size (s): FIRST_STEP times the time in which a coordinate changes by max|q|.

    `smallest`: lower bound of max|q|. The size is at most FIRST_STEP times the duration `span` (s) of the run,
    and at least MIN_FIRST_STEP spacings of floating-point numbers at t.
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
    # the time in which velocities change by max|v| is also a time scale, unless the start is almost at rest
    if speed > 0.0 and acceleration > 0.0 and speed / acceleration > FIRST_STEP * time_scale:
        time_scale = min(time_scale, speed / acceleration)
    return max(FIRST_STEP * time_scale, MIN_FIRST_STEP * np.spacing(abs(t)))


@exact
def _set_step_limits(control, tolerances, span, longest, within):
    """Store GAP and DEFECT_GAP in `tolerances`, and MAX_STEP, TIME_SPACING and SPACING in `control`.

    These limits keep the time between two evaluations of the equations below MAX_GAP_RATIO times the duration `span`
    (s) of the run. If a method evaluates the equations within steps (`within`), only `longest` (s) limits step sizes.
    """
    max_gap = MAX_GAP_RATIO * span
    tolerances[GAP], tolerances[DEFECT_GAP] = max_gap, max_gap / (GAP_RATIO if control[at.BY_STATE] > 0.0 else 1.0)
    control[at.MAX_STEP] = longest if within else min(longest, max_gap / control[at.MAX_EVALUATION_GAP])
    control[at.TIME_SPACING] = max_gap / N_SAMPLES
    control[at.SPACING] = control[at.TIME_SPACING] if control[at.BY_TIME] + control[at.BY_STATE] > 0.0 else 0.0


@kernel(f8(VECTOR, VECTOR, VECTOR, i8, f8, f8, f8, f8, types.boolean))
def first_step_and_limits(control, tolerances, state, n, t, t1, smallest, longest, within):
    """Return the first step size (s), see _first_step_size; if `longest` > 0, also call `_set_step_limits`."""
    if longest > 0.0:
        _set_step_limits(control, tolerances, t1 - t, longest, within)
    return _first_step_size(state, n, t, t1 - t, smallest)


@merged
def _is_within_bounds(t, rows, bounds):
    """Return whether all states [t[k], rows[k]] are between the states bounds[0] and bounds[1], number by number."""
    for k in range(t.size):
        if not bounds[0, 0] <= t[k] <= bounds[1, 0]:
            return False
        for j in range(1, bounds.shape[1]):
            if not bounds[0, j] <= rows[k, j - 1] <= bounds[1, j]:
                return False
    return True


@kernel(types.void(MATRIX, INTEGERS, VECTOR, types.int64[:, ::1], types.boolean[::1]))
def split_steps(steps, counts, h, changes, used_newton):
    """Store step sizes (s) in `h`, increases of `counts` in each step in `changes`, and whether a step used Newton.

    `steps`: rows of out_steps, see loop_state.py. `counts`: numbers of rejections by the error test, failures and
    partitions since the start of the run; on entry before the first of these steps, on return after the last.
    """
    for k in range(h.size):
        h[k], used_newton[k] = steps[k, at.H], steps[k, at.JACOBIANS] > 0.0
        for i in range(counts.size):
            count = int(steps[k, at.ERRORS + i])
            changes[i, k], counts[i] = count - counts[i], count


# codes that `start_and_advance` returns in place of a number of steps
# - REFUSED: the independent rows or dependent coordinates of the previous run do not suit this start
# - IN_DOUBT: the start may violate the constraints; Python must check it
# - UNUSUAL: steps were taken, but Python must read the report, and may have to continue the run
# - UNCHOSEN: Python must check whether code was generated for the rows that are chosen at this start
REFUSED, IN_DOUBT, UNUSUAL, UNCHOSEN = -1, -2, -3, -4
# what Python has checked of a start: nothing; that it satisfies the constraints; also that the code suits it
NOTHING_CHECKED, STATE_CHECKED, CHOICES_CHECKED = 0, 1, 2

# arrays for the checks of a start, the choice of rows, and the steps, which successive runs reuse. Among them are
# - `numbers`: memory of clock, control and tolerances; `start_numbers`: initial values of `numbers`
# - `start_memory`: initial values of the method's `memory` at the indices `memory_places`; other initial values are 0
# - `last_start`: the last start, see START; `start_rows`: indices of the independent rows at the last start
# - `saved`, `saved_integers`: data right after a start that was repeated; later runs from this start restore them
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
# indices in `constants`
# - ACCURACY, REUSE, NEARLY_SINGULAR, EQUATION_FORM: initial w.gamma_required, w.reuse, w.nearly_singular and f.form
# - HAS_ALL_ENTRIES: 1 if `kinds` shows all nonzero entries of the constraint rows
# - RANK_LIMIT, WEAK_LIMIT: arguments of `choose`: below these relative sizes, pivots and eigenvalues of M count as zero
# - ADDED_SCALE: factor s with which the code adds rows G to a singular M, as M + s G^T G
# - CONTRADICTS: a redundant row contradicts the others if its residual, relative to its terms, exceeds this
# - MASS_FLAG: DEFINITE or INDEFINITE, as M has to be at the start; 0: M is constant
# - LEAST_PIVOT: smallest pivot of a start that is accepted without checks in Python
# - NEAR_PIVOT: Python must check a run whose smallest pivot at an output time is below this
# - FIRST_SIZE: first step size (s) that the user has chosen, or 0; LEAST_DISTANCE: `smallest` of _first_step_size
# - LONGEST, EVALUATES_WITHIN: arguments of _set_step_limits
# - MAX_CHANGE_RATIO: velocities jumped if they change by more than this multiple of what accelerations explain
# - MIN_SAMPLES: Python must check a run with two sudden changes closer than this number of spacings of samples
ACCURACY, REUSE, NEARLY_SINGULAR, HAS_ALL_ENTRIES, RANK_LIMIT, WEAK_LIMIT, ADDED_SCALE, CONTRADICTS = range(8)
MASS_FLAG, LEAST_PIVOT, EQUATION_FORM, FIRST_SIZE, LEAST_DISTANCE, LONGEST, EVALUATES_WITHIN = range(8, 15)
NEAR_PIVOT, MAX_CHANGE_RATIO, MIN_SAMPLES = range(15, 18)
# indices in `expected`, the choice of rows for which code was generated (empty without generated code). BOUND: the
# result that `choose` has to return, or OF_PYTHON if only Python can make this choice. N_ROWS, N_ADDED: number of
# independent rows, and of rows added to M. FIRST_ROW: where the list of the independent rows, then of the added, begins
BOUND, N_ROWS, N_ADDED, FIRST_ROW = range(4)
OF_PYTHON = 100


@merged
def _has_choices_of_code(b):
    """Choose rows and dependent coordinates at a start; return whether the code was generated for these choices."""
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
    """Return whether the accelerations a in b.state satisfy all rows of G a = Gamma, also the redundant ones."""
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
def _evaluate_start(checked_kit, b, t, q, v, records, shifts):
    """Evaluate all callbacks at a start, store values in `b`; return flags such as CONSISTENT, see `evaluate_start`."""
    for k in range(b.start_values.size):
        b.start_values[k] = 0.0
    return b.evaluate_start(
        checked_kit, t, q, v, records, b.lam, b.room, b.mass, b.rows, shifts, b.pattern, b.roundings
    )


@merged
def _start_run(f, checked_kit, w, b, t, t1, q, v, records, checks):
    """Prepare a run from t to t1 with the rows and coordinates of the last run; return 0 or a code, such as REFUSED.

    `checked_kit`: kit with the callbacks for the check of the start; `checks`: which checks Python has already made.
    """
    n = q.size
    if not (finite_vector(q) and finite_vector(v)):
        return REFUSED
    has_all_entries = b.constants[HAS_ALL_ENTRIES] > 0.0
    flags = _evaluate_start(checked_kit, b, t, q, v, records, b.shifts[: 0 if has_all_entries else len(b.shifts)])
    if has_all_entries:
        pattern = b.pattern.reshape(b.pattern.size)
        for k in range(b.kinds.size):  # according to b.kinds, some entries are not always zero
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
        _set_step_limits(b.control, b.tolerances, span, b.constants[LONGEST], within)
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


# indices in `last_start`. N_EQUAL: number of successive runs from this start, at most 2. START: index of [t, t1, q, v]
N_EQUAL, START = 0, 1
NEVER, IS_SAVED = 0.0, 2.0  # values of N_EQUAL: no run has succeeded in starting; a second run has saved its data


@exact
def _equals_last_start(last_start, t, t1, q, v):
    """Return whether (t, t1, q, v) equals `last_start` bit for bit, and store this start in `last_start`."""
    n, is_same = q.size, last_start[N_EQUAL] > NEVER
    for k in range(2 + 2 * n):
        x = t if k == 0 else t1 if k == 1 else q[k - 2] if k < 2 + n else v[k - 2 - n]
        last_value = last_start[START + k]
        is_same = is_same and x == last_value and math.copysign(1.0, x) == math.copysign(1.0, last_value)
        last_start[START + k] = x
    return is_same


# indices in the report; N_REPORT: index of the first counter
# - N_STATES, N_STEPS: number of states, including the first, and of steps
# - NOTHING_TO_CHECK: 1 if Python need not check the run; IS_NEW: 1 if the start differs from the previous start
# - JUMPED: 1 if velocities changed suddenly in the last step; END_CODE: code that `advance` returned
# - IN_CHECKED_REGION: 1 if all states are in the region in which callbacks were compared with their traces
# - DEFECT_KNOWN: 1 if the defect was evaluated in every step; DEFECT: largest defect
# - LONGEST_GAP: longest time (s) between two evaluations
N_STATES, N_STEPS, NOTHING_TO_CHECK, JUMPED, IN_CHECKED_REGION, DEFECT_KNOWN = range(6)
DEFECT, LONGEST_GAP, END_CODE, IS_NEW, N_REPORT = range(6, 11)
N_HEAD = N_REPORT + N_COUNTERS  # length of the report without times and steps


@merged
def _has_velocity_jump(b, k, n):
    """Return whether velocities jump between states k - 1 and k, see MAX_CHANGE_RATIO; n: number of coordinates."""
    change, first, last = 0.0, 0.0, 0.0
    for j in range(n):
        change = max(change, abs(b.states[k, n + j] - b.states[k - 1, n + j]))
        first, last = max(first, abs(b.states[k - 1, 2 * n + j])), max(last, abs(b.states[k, 2 * n + j]))
    return change > b.constants[MAX_CHANGE_RATIO] * (b.t[k] - b.t[k - 1]) * min(first, last)


@merged
def _write_report(w, b, region, n_rows, n_steps, code, is_new):
    """Store the report, times and steps of a run in b.report; return n_steps, or UNUSUAL if Python must read b.report.

    The run has n_rows states after the first, and n_steps steps; `region` contains the bounds for IN_CHECKED_REGION.
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

    If a start is repeated bit for bit, the second run checks it again, and saves the data that a start computes. Later
    runs from it restore these data, without a check. For the arguments see _start_run and _write_report.
    """
    f.form = int(b.constants[EQUATION_FORM])  # the previous run may have changed the form
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

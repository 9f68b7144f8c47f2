"""Run from a start to the end of the first chunk in one compiled call, and report on it.

`start_and_advance` checks the start, makes the same choices as the run before it, takes steps, and fills one block:

    ... | report: N_REPORT numbers, counters | times | steps | states ...
                                                             ^ a fixed place

`advance` writes states as they come, from the fixed place on. The rest is as long as the run has steps, and is copied
when these are over, so that it ends where states begin. All that a result needs is then one piece without gaps, which
Python copies by one slice, and takes apart when a field of the result is used.
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
from twoloop.kernels.data.indices import FORM, GAP, LONGEST_UNSEEN, LOOK, N_ACCEPTED, N_COUNTERS
from twoloop.kernels.evaluation.checks import CONSISTENT, DEFINITE, IN_ORDER, INDEFINITE

ROUNDING = 1e-15  # relative to the largest coordinate: smaller corrections are rounding errors


@merged
def prepare_work(w, numbers, integers, pattern, q, accuracy, reuse):
    """Reset a workspace to its state before a run from q; `numbers` and `integers` are its lasting arrays."""
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
    rounded = 0.0
    for j in range(q.size):
        rounded = max(rounded, ROUNDING * abs(q[j]))
    w.notes[indices.ROUNDED], w.notes[indices.REUSE] = rounded, max(reuse, rounded)
    w.notes[indices.GAMMA_REQUIRED], w.notes[indices.GAMMA_SHARE] = accuracy, 1.0
    w.notes[indices.KINK_BEFORE], w.notes[indices.KINK_AFTER] = -math.inf, math.inf


@kernel(types.void(WORK, VECTOR, INTEGERS, MATRIX, VECTOR, f8, f8))
def prepare_workspace(w, numbers, integers, pattern, q, accuracy, reuse):
    """Call `prepare_work` from Python."""
    prepare_work(w, numbers, integers, pattern, q, accuracy, reuse)


FIRST_STEP = 0.01  # first step, relative to the shortest time scale of the state ...
RESOLVED = 1e4  # ... but at least this many spacings of floating-point numbers at the start
SHORTEST_STEP = 1e-16  # relative to the first step: shorter steps are too small
SHARPER = 10  # ratio of GAP to LOOK, if forces may change suddenly with place or speed


@exact
def _first_step(state, n, t, span, least):
    """Return the first step, s: a share of the time in which the state moves by the size of its coordinates.

    `least` is the size of coordinates that are all zero, which have no length of their own. For coordinates close to
    zero that time may be shorter than the spacing of floating-point numbers near t.
    """
    far, fast, sharp = least, 0.0, 0.0
    for j in range(n):
        far, fast = max(far, abs(state[j])), max(fast, abs(state[n + j]))
        sharp = max(sharp, abs(state[2 * n + j]))
    scale = span
    if fast > 0.0:
        scale = min(scale, far / fast)
    if sharp > 0.0:
        scale = min(scale, math.sqrt(far / sharp))
    if fast > 0.0 and sharp > 0.0 and fast / sharp > FIRST_STEP * scale:  # not if the motion is almost at rest
        scale = min(scale, fast / sharp)
    return max(FIRST_STEP * scale, RESOLVED * np.spacing(abs(t)))


@exact
def _limit_steps(control, tolerances, span, longest, within):
    """Limit gaps between evaluations to a hundredth of the run.

    With `within`, steps evaluate the equations within themselves, and only `longest` limits them.
    """
    gap = LONGEST_UNSEEN * span
    tolerances[GAP], tolerances[LOOK] = gap, gap / (SHARPER if control[at.BY_STATE] > 0.0 else 1.0)
    control[at.MAX_STEP] = longest if within else min(longest, gap / control[at.MAX_EVALUATION_GAP])
    control[at.APART] = gap / N_SAMPLES
    control[at.SPACING] = control[at.APART] if control[at.BY_TIME] + control[at.BY_STATE] > 0.0 else 0.0


@kernel(f8(VECTOR, VECTOR, VECTOR, i8, f8, f8, f8, f8, types.boolean))
def set_sizes(control, tolerances, state, n, t, t1, least, longest, within):
    """Return the first step from a state, s; if `longest` is given, also bound the gaps between evaluations."""
    if longest > 0.0:
        _limit_steps(control, tolerances, t1 - t, longest, within)
    return _first_step(state, n, t, t1 - t, least)


@merged
def _all_within(t, rows, box):
    """Return whether all times, and rows as far as the box has columns, lie between its rows [t, q, v]."""
    for k in range(t.size):
        if not box[0, 0] <= t[k] <= box[1, 0]:
            return False
        for j in range(1, box.shape[1]):
            if not box[0, j] <= rows[k, j - 1] <= box[1, j]:
                return False
    return True


@kernel(types.void(MATRIX, INTEGERS, VECTOR, types.int64[:, ::1], types.boolean[::1]))
def split_steps(steps, counts, h, changes, untested):
    """Split the rows of steps: size, what each added to `counts`, and whether it was implicit (used Newton's method).

    `counts` are the rejections and partitions before these steps, and afterwards those after them.
    """
    for k in range(h.size):
        h[k], untested[k] = steps[k, at.H], steps[k, at.JACOBIANS] > 0.0
        for i in range(counts.size):
            count = int(steps[k, at.ERRORS + i])
            changes[i, k], counts[i] = count - counts[i], count


# codes of `start_and_advance` other than a number of steps. REFUSED: the start needs other choices. IN_DOUBT: the start
# may be inconsistent and needs a closer check. UNUSUAL: Python has to read the report, or has to take more steps
REFUSED, IN_DOUBT, UNUSUAL = -1, -2, -3

# Arrays of a run that starts again and again: first for the checks of a start and for choices, then for the run.
# - `start_numbers`: clock, control and tolerances at a start, which are copied to `numbers`
# - `start_memory`: nonzero values of the method's `memory`, at `memory_places`; nearly all others are zero
# - `last_start`: the last start, see START; `saved` and `saved_integers`: the whole state of the run there, from the
#   second equal start on; `start_rows`: the independent rows there
RUN_ARRAYS = Reference(
    "RunArrays",
    {
        **dict.fromkeys(
            ("looked", "lam", "room", "least", "bounds", "scratch", "constants", "saved", "search"), VECTOR
        ),
        **dict.fromkeys(("start_numbers", "numbers", "start_memory", "memory", "lasting", "options"), VECTOR),
        **dict.fromkeys(
            ("tolerances", "control", "clock", "state", "new_state", "last_start", "end", "t", "report"), VECTOR
        ),
        **dict.fromkeys(("mass", "rows", "ways", "pattern", "states", "steps"), MATRIX),
        **dict.fromkeys(("chosen", "expected", "lapack", "lasting_integers", "saved_integers"), INTEGERS),
        **dict.fromkeys(("memory_places", "filled", "kinds", "counted", "search_places", "blocks", "found"), INTEGERS),
        "start_rows": INTEGERS,
    },
)
RUN_ARRAYS.add_function("look", i8(KIT, f8, *(VECTOR,) * 5, *(MATRIX,) * 4, VECTOR))
RUN_ARRAYS.add_function("choose", i8(MATRIX, MATRIX, f8, f8, VECTOR, VECTOR, INTEGERS))
RUN_ARRAYS.add_function("dependents", i8(MATRIX, INTEGERS, INTEGERS, i8, VECTOR, INTEGERS, INTEGERS))
RUN_ARRAYS.add_function("start", i8(KIT, WORK, f8, VECTOR))
RUN_ARRAYS.add_function("advance", i8(KIT, WORK, *(VECTOR,) * 9, MATRIX, MATRIX, INTEGERS))
# indices in `constants`. Starts: whether rows have entries wherever `kinds` says so, arguments of `choose`, the flag of
# an M that varies (else 0), the smallest pivot of an accepted start, and the form of the equations. Steps: a first
# step, or 0, and arguments of set_sizes. Ends: the pivot below which velocities are checked, the largest ratio of their
# change to that by the accelerations, and the least distance of two sudden changes, in samples
ACCURACY, REUSE, NEARLY_SINGULAR, IN_ALL_PLACES, RANK, WEAK, SCALE, CONTRADICTS = range(8)
OF_MASS, LEAST_PIVOT, IN_FORM, FIRST, LEAST, LONGEST, LOOKS_WITHIN, NEAR, MOST_TURNED, LOOKS = range(8, 18)
# in `expected`, which is empty without generated code; rows added for M follow the kept rows
PLACE, N_KEPT, N_ADDED, KEPT = range(4)


@merged
def _makes_same_choices(b):
    """Return whether the independent rows, the rows added for M and the dependent coordinates are those of the code."""
    b.scratch[0] = 0.0
    place = b.choose(b.mass, b.rows, b.constants[RANK], b.constants[WEAK], b.bounds, b.scratch, b.chosen)
    n_kept, n_added = b.expected[N_KEPT], b.expected[N_ADDED]
    if b.chosen[0] != n_kept:
        return False
    if n_kept == 0:
        return True
    if place != b.expected[PLACE] or b.chosen[1] != n_added or b.scratch[0] != b.constants[SCALE]:
        return False
    same = True
    for k in range(n_kept):
        same = same and b.chosen[2 + k] == b.expected[KEPT + k]
    for k in range(n_added):
        same = same and b.chosen[2 + len(b.rows) + k] == b.expected[KEPT + n_kept + k]
    if same and b.kinds.size > 0:
        n = 4 * b.dependents(b.rows, b.kinds, b.counted, b.counted.size, b.search, b.search_places, b.found)
        same = n == b.blocks.size
        for k in range(b.blocks.size):
            same = same and b.found[k] == b.blocks[k]
    return same


@merged
def _copy(one, other):
    for k in range(other.size):
        other[k] = one[k]


@merged
def _left_out_rows_hold(w, b, n):
    """Return whether the accelerations agree with all rows, also with redundant rows that were left out."""
    if w.rows_v.size == len(b.rows):
        return True
    for i in range(len(b.rows)):
        off, size = -w.Gamma[i], abs(w.Gamma[i])
        for j in range(n):
            off += b.rows[i, j] * b.state[2 * n + j]
            size += abs(b.rows[i, j] * b.state[2 * n + j])
        if not abs(off) <= b.constants[CONTRADICTS] * max(size, 1.0):
            return False
    return True


@merged
def _check_start(given, b, t, q, v, sizes, ways):
    for k in range(b.looked.size):
        b.looked[k] = 0.0
    return b.look(given, t, q, v, sizes, b.lam, b.room, b.mass, b.rows, ways, b.pattern, b.least)


@merged
def _has_all_entries(b):
    """Return whether all entries of the rows that may be nonzero are: then no position nearby has to be checked."""
    n, same = b.rows.shape[1], True
    for k in range(b.kinds.size):
        same = same and (b.kinds[k] != 0) == (b.rows[k // n, k % n] != 0.0)
    return same


@merged
def _start_run(f, given, w, b, t, t1, q, v, sizes, sure):
    """Begin a run to t1 at a state, with the choices of the run before it; return 0, or why that fails.

    `given`: the system that is checked, with `sizes` as `look` takes them. `sure`: the state is known to be consistent.
    """
    n = q.size
    if not (finite_vector(q) and finite_vector(v)):
        return REFUSED
    flags = _check_start(given, b, t, q, v, sizes, b.ways[: 0 if b.constants[IN_ALL_PLACES] > 0.0 else len(b.ways)])
    if b.constants[IN_ALL_PLACES] > 0.0 and not _has_all_entries(b):
        flags = _check_start(given, b, t, q, v, sizes, b.ways)
    if flags & IN_ORDER == 0 or flags & (DEFINITE | INDEFINITE) != int(b.constants[OF_MASS]):
        return REFUSED
    if flags & CONSISTENT == 0 and not sure:
        return IN_DOUBT
    if b.expected.size > 0 and not _makes_same_choices(b):
        return REFUSED
    _copy(b.start_numbers, b.numbers)
    for j in range(b.state.size):
        b.state[j] = q[j] if j < n else v[j - n] if j < 2 * n else 0.0
    b.clock[at.T] = b.clock[at.T_START] = t
    prepare_work(w, b.lasting, b.lasting_integers, b.pattern, q, b.constants[ACCURACY], b.constants[REUSE])
    _copy(b.lapack, w.lapack[: b.lapack.size])
    w.notes[indices.NEARLY_SINGULAR] = b.constants[NEARLY_SINGULAR]
    if b.start(f, w, t, b.state) != indices.DONE or not _left_out_rows_hold(w, b, n):
        return REFUSED
    if w.notes[indices.PIVOT] < b.constants[LEAST_PIVOT]:
        return REFUSED
    w.notes[indices.KINK_AFTER] = t1
    if b.control[at.FIXED_STEP] == 0.0:
        span, first, within = t1 - t, b.constants[FIRST], b.constants[LOOKS_WITHIN] > 0.0
        _limit_steps(b.control, b.tolerances, span, b.constants[LONGEST], within)
        b.clock[at.H_NEXT] = min(first if first > 0.0 else _first_step(b.state, n, t, span, b.constants[LEAST]), span)
        b.control[at.SHORTEST] = SHORTEST_STEP * b.clock[at.H_NEXT]
    _copy(w.rows_v, b.start_rows)
    return 0


@merged
def _save_start(b):
    i, j = b.numbers.size, b.numbers.size + b.lasting.size
    _copy(b.numbers, b.saved[:i])
    _copy(b.lasting, b.saved[i:j])
    _copy(b.state, b.saved[j:])
    _copy(b.lasting_integers, b.saved_integers)


@merged
def _restore_start(b):
    i, j = b.numbers.size, b.numbers.size + b.lasting.size
    _copy(b.saved[:i], b.numbers)
    _copy(b.saved[i:j], b.lasting)
    _copy(b.saved[j:], b.state)
    _copy(b.saved_integers, b.lasting_integers)


# in `last_start`, before t, t1, q and v: how often a run began there, at most IS_SAVED
N_EQUAL, START = 0, 1
NEVER, IS_SAVED = 0.0, 2.0


@exact
def _is_last_start(last_start, t, t1, q, v):
    """Return whether a start equals the last one to the bit, and store it as the last one."""
    n, same = q.size, last_start[N_EQUAL] > NEVER
    for k in range(2 + 2 * n):
        x = t if k == 0 else t1 if k == 1 else q[k - 2] if k < 2 + n else v[k - 2 - n]
        before = last_start[START + k]
        same = same and x == before and math.copysign(1.0, x) == math.copysign(1.0, before)
        last_start[START + k] = x
    return same


# entries of the report: number of states (with the first) and of steps; 1 or 0 for: nothing has to be checked,
# velocities turned in the last step, all states are in the region where callbacks were compared, every step evaluated
# its defect; then the largest defect, the widest gap without an evaluation, the code of `advance`, 1 if the start is
# new, and the counters
N_STATES, N_STEPS, PLAIN, TURNED, INSIDE, CHECKED, DEFECT, WIDEST, CODE, IS_NEW, N_REPORT = range(11)
N_HEAD = N_REPORT + N_COUNTERS


@merged
def _velocities_turned(b, k, n):
    """Return whether velocities change in the last step by more than the accelerations at its ends explain."""
    change, first, last = 0.0, 0.0, 0.0
    for j in range(n):
        change = max(change, abs(b.states[k, n + j] - b.states[k - 1, n + j]))
        first, last = max(first, abs(b.states[k - 1, 2 * n + j])), max(last, abs(b.states[k, 2 * n + j]))
    return change > b.constants[MOST_TURNED] * (b.t[k] - b.t[k - 1]) * min(first, last)


@merged
def _write_report(w, b, box, n_rows, n_steps, code, is_new):
    """Write the report of a run with n_rows states after the first, and n_steps steps.

    Returns the number of steps if nothing has to be checked, else UNUSUAL. `box` has rows [t, q, v], or is empty.
    """
    turned = n_rows > 0 and _velocities_turned(b, n_rows, w.Q.size)
    inside = box.shape[1] > 0 and _all_within(b.t[: 1 + n_rows], b.states, box)
    near = b.clock[at.PIVOT_AT_OUTPUT] < b.constants[NEAR]
    missed = b.clock[at.SHORTEST_CHANGE] < b.constants[LOOKS] * b.clock[at.WIDEST_SAMPLING]
    plain, width = not (turned or near or missed), b.steps.shape[1]
    begin = b.report.size - N_HEAD - 1 - n_rows - width * n_steps
    report = b.report[begin:]
    report[N_STATES], report[N_STEPS], report[PLAIN] = 1 + n_rows, n_steps, plain
    report[TURNED], report[INSIDE], report[CODE], report[IS_NEW] = turned, inside, code, is_new
    report[CHECKED] = w.counters[N_ACCEPTED] > 0 and w.notes[indices.UNCHECKED] == 0.0
    report[DEFECT], report[WIDEST] = w.notes[indices.LARGEST_DEFECT], w.notes[indices.WIDEST_GAP]
    for k in range(N_COUNTERS):
        report[N_REPORT + k] = w.counters[k]
    _copy(b.t[: 1 + n_rows], report[N_HEAD : N_HEAD + 1 + n_rows])
    for k in range(n_steps):
        _copy(b.steps[k], report[N_HEAD + 1 + n_rows + k * width : N_HEAD + 1 + n_rows + (k + 1) * width])
    well = code == at.ALL_OUTPUT_DONE and plain and inside and n_rows == n_steps
    b.filled[0], b.filled[1] = n_rows, n_steps
    return n_steps if well else UNUSUAL


@kernel(i8(KIT, KIT, WORK, RUN_ARRAYS, f8, f8, VECTOR, VECTOR, VECTOR, MATRIX, types.boolean), vectorized=True)
def start_and_advance(f, given, w, b, t, t1, q, v, sizes, box, sure):
    """Start a run to t1 and take the first chunk of steps; return how many if nothing has to be checked in Python.

    A start that equals the last one to the bit is checked once more, and then saved for those that follow.
    """
    f.flags[FORM] = int(b.constants[IN_FORM])  # a run may have changed it
    same, often = _is_last_start(b.last_start, t, t1, q, v), b.last_start[N_EQUAL]
    if same and often == IS_SAVED:
        _restore_start(b)
    else:
        b.last_start[N_EQUAL] = NEVER
        refused = _start_run(f, given, w, b, t, t1, q, v, sizes, sure or same)
        if refused != 0:
            return refused
        if same:
            _save_start(b)
        b.last_start[N_EQUAL] = IS_SAVED if same else 1.0
    for k in range(b.memory.size):
        b.memory[k] = 0.0
    for k in range(b.memory_places.size):
        b.memory[b.memory_places[k]] = b.start_memory[k]
    b.end[0], b.t[0] = t1, t
    _copy(b.state, b.states[0])
    arrays = b.tolerances, b.control, b.clock, b.state, b.new_state
    code = b.advance(f, w, b.options, b.memory, *arrays, b.end, b.t[1:], b.states[1:], b.steps, b.filled)
    return _write_report(w, b, box, b.filled[0], b.filled[1], code, not same)

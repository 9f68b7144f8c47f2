"""What is done before and after the steps of a run: each function spares Python several calls of NumPy or kernels."""

import math

import numpy as np
from numba import types

from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.control import clock as at
from twoloop.kernels.control.sudden import PLACES
from twoloop.kernels.data import codes, noted
from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, WORK, exact, f8, i8, kernel, merged
from twoloop.kernels.data.counters import N_ACCEPTED, N_COUNTERS
from twoloop.kernels.data.finite import finite_vector
from twoloop.kernels.data.flags import FORM
from twoloop.kernels.data.tolerances import GAP, LONGEST_UNSEEN, LOOK
from twoloop.kernels.evaluation.checks import CONSISTENT, DEFINITE, IN_ORDER, INDEFINITE

ROUNDING = 1e-15  # of the largest coordinate: corrections of this size are rounding


@merged
def put_ready(w, numbers, integers, pattern, q, accuracy, reuse):
    """Make a workspace as it is before a run from q; `numbers` and `integers` are what counts when a step begins."""
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
    w.notes[noted.ROUNDED], w.notes[noted.REUSE] = rounded, max(reuse, rounded)
    w.notes[noted.GAMMA_REQUIRED], w.notes[noted.GAMMA_SHARE] = accuracy, 1.0
    w.notes[noted.KINK_BEFORE], w.notes[noted.KINK_AFTER] = -math.inf, math.inf


@kernel(types.void(WORK, VECTOR, INTEGERS, MATRIX, VECTOR, f8, f8))
def make_ready(w, numbers, integers, pattern, q, accuracy, reuse):
    """The same, for Python."""
    put_ready(w, numbers, integers, pattern, q, accuracy, reuse)


FIRST_STEP = 0.01  # of the shortest time scale that a state shows: the first step ...
RESOLVED = 1e4  # ... but no fewer spacings of floating-point numbers at the start
SHORTEST_STEP = 1e-16  # of the first step
SHARPER = 10  # times as often steps that look within look at the equations, of what may be sharp in q or v


@exact
def _first_step(state, n, t, span, least):
    """A share of the time in which velocities and accelerations change the coordinates as a whole, s.

    `least` is what counts as the size of coordinates that are zero, of which there is no other length. Of those next to
    zero that time may be less than numbers near t can tell apart.
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
    if fast > 0.0 and sharp > 0.0 and fast / sharp > FIRST_STEP * scale:  # not at what is next to rest
        scale = min(scale, fast / sharp)
    return max(FIRST_STEP * scale, RESOLVED * np.spacing(abs(t)))


@exact
def _limit_steps(control, tolerances, span, longest, within):
    """Let no hundredth of a run pass unseen. `within`: its steps look within, and may be as long as that is."""
    gap = LONGEST_UNSEEN * span
    tolerances[GAP], tolerances[LOOK] = gap, gap / (SHARPER if control[at.BY_STATE] > 0.0 else 1.0)
    control[at.MAX_STEP] = longest if within else min(longest, gap / control[at.UNSEEN])
    control[at.APART] = gap / PLACES
    control[at.SPACING] = control[at.APART] if control[at.BY_TIME] + control[at.BY_STATE] > 0.0 else 0.0


@kernel(f8(VECTOR, VECTOR, VECTOR, i8, f8, f8, f8, f8, types.boolean))
def set_sizes(control, tolerances, state, n, t, t1, least, longest, within):
    """The first step from a state, s; and if a longest one is given, no hundredth of the run is to pass unseen."""
    if longest > 0.0:
        _limit_steps(control, tolerances, t1 - t, longest, within)
    return _first_step(state, n, t, t1 - t, least)


@merged
def _lie_within(t, rows, box):
    """Whether all times, and rows as far as the box has numbers, lie between its rows [t, q, v]."""
    for k in range(t.size):
        if not box[0, 0] <= t[k] <= box[1, 0]:
            return False
        for j in range(1, box.shape[1]):
            if not box[0, j] <= rows[k, j - 1] <= box[1, j]:
                return False
    return True


@kernel(types.void(MATRIX, INTEGERS, VECTOR, types.int64[:, ::1], types.boolean[::1]))
def tell_steps(steps, counts, h, changes, untested):
    """Put down of each step its length, what it added to `counts`, and whether it was one of Newton's method.

    `counts` are rejections and partitions before, and then after these steps.
    """
    for k in range(h.size):
        h[k], untested[k] = steps[k, at.H], steps[k, at.JACOBIANS] > 0.0
        for i in range(counts.size):
            count = int(steps[k, at.ERRORS + i])
            changes[i, k], counts[i] = count - counts[i], count


# how `go` ended, where it does not return how many steps it took: another way has to be gone; a closer look has to be
# taken at the start; something has to be looked at, or more steps have to be taken, as `told` says
REFUSED, IN_DOUBT, OTHERWISE = -1, -2, -3

# Arrays of a run that starts again and again, of looks at its starts and of choices; and room for its states and steps.
# `begin_numbers` is what `numbers` is full of before a start, `begin_memory` what stands in `memory` at `places`: of
# the rest, nearly all, to clear it takes less than to copy it. `begun`: the last start, see BEGUN. `saved` and
# `saved_integers`: all that counts there, once a second run began there; `start_rows`, the rows that count there.
# `told` is followed by counters, times and steps, and these by `states`: all ends where those begin
AGAIN = Reference(
    "Again",
    {
        **dict.fromkeys(
            ("looked", "lam", "room", "least", "bounds", "scratch", "constants", "saved", "search"), VECTOR
        ),
        **dict.fromkeys(("begin_numbers", "numbers", "begin_memory", "memory", "lasting", "options"), VECTOR),
        **dict.fromkeys(("tolerances", "control", "clock", "state", "new_state", "begun", "end", "t", "told"), VECTOR),
        **dict.fromkeys(("mass", "rows", "ways", "pattern", "states", "steps"), MATRIX),
        **dict.fromkeys(("chosen", "expected", "lapack", "lasting_integers", "saved_integers"), INTEGERS),
        **dict.fromkeys(("places", "filled", "kinds", "counted", "search_places", "blocks", "found"), INTEGERS),
        "start_rows": INTEGERS,
    },
)
AGAIN.add_function("look", i8(KIT, f8, *(VECTOR,) * 5, *(MATRIX,) * 4, VECTOR))
AGAIN.add_function("choose", i8(MATRIX, MATRIX, f8, f8, VECTOR, VECTOR, INTEGERS))
AGAIN.add_function("dependents", i8(MATRIX, INTEGERS, INTEGERS, i8, VECTOR, INTEGERS, INTEGERS))
AGAIN.add_function("start", i8(KIT, WORK, f8, VECTOR))
AGAIN.add_function("advance", i8(KIT, WORK, *(VECTOR,) * 9, MATRIX, MATRIX, INTEGERS))
# in `constants`: of starts, whether rows have entries wherever `kinds` says so, what `choose` takes, the flag of an M
# that varies, else 0, the smallest pivot with which one is taken and the form of the equations; of steps, a first one,
# or 0, and what set_sizes takes; of ends, the pivot below which speeds are looked at, how many times what accelerations
# give these may change by, and how many looks at sudden changes two of these must be apart
ACCURACY, REUSE, NEARLY_SINGULAR, IN_ALL_PLACES, RANK, WEAK, SCALE, CONTRADICTS = range(8)
OF_MASS, LEAST_PIVOT, IN_FORM, FIRST, LEAST, LONGEST, LOOKS_WITHIN, NEAR, MOST_TURNED, LOOKS = range(8, 18)
PLACE, N_KEPT, N_ADDED, KEPT = range(4)  # in `expected`, which is empty without code; those that help follow those kept


@merged
def _is_expected(b):
    """Whether the rows that count, those that help M, and the coordinates that follow are those of the code."""
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
def _agree(w, b, n):
    """Whether the accelerations agree with all rows where some, which depend on others, were left out."""
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
def _look(given, b, t, q, v, sizes, ways):
    for k in range(b.looked.size):
        b.looked[k] = 0.0
    return b.look(given, t, q, v, sizes, b.lam, b.room, b.mass, b.rows, ways, b.pattern, b.least)


@merged
def _has_all_entries(b):
    """Whether rows have an entry wherever they may have one: then they need not be looked at nearby."""
    n, same = b.rows.shape[1], True
    for k in range(b.kinds.size):
        same = same and (b.kinds[k] != 0) == (b.rows[k // n, k % n] != 0.0)
    return same


@merged
def _begin(f, given, w, b, t, t1, q, v, sizes, sure):
    """Begin a run to t1 at a state, with the same choices as the run before it; 0, or why it cannot.

    `given`: the system that is looked at, with `sizes` as of `look`. `sure`: the state is known to be consistent.
    """
    n = q.size
    if not (finite_vector(q) and finite_vector(v)):
        return REFUSED
    found = _look(given, b, t, q, v, sizes, b.ways[: 0 if b.constants[IN_ALL_PLACES] > 0.0 else len(b.ways)])
    if b.constants[IN_ALL_PLACES] > 0.0 and not _has_all_entries(b):
        found = _look(given, b, t, q, v, sizes, b.ways)
    if found & IN_ORDER == 0 or found & (DEFINITE | INDEFINITE) != int(b.constants[OF_MASS]):
        return REFUSED
    if found & CONSISTENT == 0 and not sure:
        return IN_DOUBT
    if b.expected.size > 0 and not _is_expected(b):
        return REFUSED
    _copy(b.begin_numbers, b.numbers)
    for j in range(b.state.size):
        b.state[j] = q[j] if j < n else v[j - n] if j < 2 * n else 0.0
    b.clock[at.T] = b.clock[at.T_START] = t
    put_ready(w, b.lasting, b.lasting_integers, b.pattern, q, b.constants[ACCURACY], b.constants[REUSE])
    _copy(b.lapack, w.lapack[: b.lapack.size])
    w.notes[noted.NEARLY_SINGULAR] = b.constants[NEARLY_SINGULAR]
    if b.start(f, w, t, b.state) != codes.DONE or not _agree(w, b, n):
        return REFUSED
    if w.notes[noted.PIVOT] < b.constants[LEAST_PIVOT]:
        return REFUSED
    w.notes[noted.KINK_AFTER] = t1
    if b.control[at.FIXED_STEP] == 0.0:
        span, first, within = t1 - t, b.constants[FIRST], b.constants[LOOKS_WITHIN] > 0.0
        _limit_steps(b.control, b.tolerances, span, b.constants[LONGEST], within)
        b.clock[at.H_NEXT] = min(first if first > 0.0 else _first_step(b.state, n, t, span, b.constants[LEAST]), span)
        b.control[at.SHORTEST] = SHORTEST_STEP * b.clock[at.H_NEXT]
    _copy(w.rows_v, b.start_rows)
    return 0


@merged
def _save(b):
    i, j = b.numbers.size, b.numbers.size + b.lasting.size
    _copy(b.numbers, b.saved[:i])
    _copy(b.lasting, b.saved[i:j])
    _copy(b.state, b.saved[j:])
    _copy(b.lasting_integers, b.saved_integers)


@merged
def _put_back(b):
    i, j = b.numbers.size, b.numbers.size + b.lasting.size
    _copy(b.saved[:i], b.numbers)
    _copy(b.saved[i:j], b.lasting)
    _copy(b.saved[j:], b.state)
    _copy(b.saved_integers, b.lasting_integers)


# in `begun`, before t, t1, q and v: how often a run began there, up to IS_SAVED
HOW_OFTEN, BEGUN = 0, 1
NEVER, IS_SAVED = 0.0, 2.0


@exact
def _begins_as_before(begun, t, t1, q, v):
    """Whether a start is the last one, to the bit; it becomes that."""
    n, same = q.size, begun[HOW_OFTEN] > NEVER
    for k in range(2 + 2 * n):
        x = t if k == 0 else t1 if k == 1 else q[k - 2] if k < 2 + n else v[k - 2 - n]
        before = begun[BEGUN + k]
        same = same and x == before and math.copysign(1.0, x) == math.copysign(1.0, before)
        begun[BEGUN + k] = x
    return same


# in `told`: numbers of states, the first included, and of steps; as numbers, whether nothing has to be looked at,
# velocities turned in the last step, and all states lie in a box; what stands in the workspace; the code of `advance`,
# and whether the start is new. Then counters
N_STATES, N_STEPS, PLAIN, TURNED, INSIDE, CHECKED, DEFECT, WIDEST, CODE, IS_NEW, N_TOLD = range(11)
FRONT = N_TOLD + N_COUNTERS


@merged
def _turned(b, k, n):
    """Whether the velocities of the last two states differ by more than one of their accelerations gives."""
    change, first, last = 0.0, 0.0, 0.0
    for j in range(n):
        change = max(change, abs(b.states[k, n + j] - b.states[k - 1, n + j]))
        first, last = max(first, abs(b.states[k - 1, 2 * n + j])), max(last, abs(b.states[k, 2 * n + j]))
    return change > b.constants[MOST_TURNED] * (b.t[k] - b.t[k - 1]) * min(first, last)


@merged
def _tell(w, b, box, n_rows, n_steps, code, is_new):
    """Put down what is told of a run with so many rows, behind the first, and steps; their number, if all is well.

    `box` has rows [t, q, v], or nothing.
    """
    turned = n_rows > 0 and _turned(b, n_rows, w.Q.size)
    inside = box.shape[1] > 0 and _lie_within(b.t[: 1 + n_rows], b.states, box)
    near = b.clock[at.PIVOT_AT_OUTPUT] < b.constants[NEAR]
    missed = b.clock[at.BRIEFEST] < b.constants[LOOKS] * b.clock[at.WIDEST_LOOK]
    plain, width = not (turned or near or missed), b.steps.shape[1]
    begin = b.told.size - FRONT - 1 - n_rows - width * n_steps
    told = b.told[begin:]
    told[N_STATES], told[N_STEPS], told[PLAIN] = 1 + n_rows, n_steps, plain
    told[TURNED], told[INSIDE], told[CODE], told[IS_NEW] = turned, inside, code, is_new
    told[CHECKED] = w.counters[N_ACCEPTED] > 0 and w.notes[noted.UNCHECKED] == 0.0
    told[DEFECT], told[WIDEST] = w.notes[noted.LARGEST_DEFECT], w.notes[noted.WIDEST_GAP]
    for k in range(N_COUNTERS):
        told[N_TOLD + k] = w.counters[k]
    _copy(b.t[: 1 + n_rows], told[FRONT : FRONT + 1 + n_rows])
    for k in range(n_steps):
        _copy(b.steps[k], told[FRONT + 1 + n_rows + k * width : FRONT + 1 + n_rows + (k + 1) * width])
    well = code == at.ALL_OUTPUT_DONE and plain and inside and n_rows == n_steps
    b.filled[0], b.filled[1] = n_rows, n_steps
    return n_steps if well else OTHERWISE


@kernel(i8(WORK, AGAIN, MATRIX, i8, i8, i8))
def tell(w, b, box, n_rows, n_steps, code):
    """The same, for Python, of steps beyond the first chunk."""
    return _tell(w, b, box, n_rows, n_steps, code, False)


@kernel(i8(KIT, KIT, WORK, AGAIN, f8, f8, VECTOR, VECTOR, VECTOR, MATRIX, types.boolean), vectorized=True)
def go(f, given, w, b, t, t1, q, v, sizes, box, sure):
    """Begin a run to t1 and make the first chunk of its steps: how many these are, if all is well with them.

    A start that is the last one to the bit is looked at once more, and then saved for those that follow.
    """
    f.flags[FORM] = int(b.constants[IN_FORM])  # which a run may have changed
    same, often = _begins_as_before(b.begun, t, t1, q, v), b.begun[HOW_OFTEN]
    if same and often == IS_SAVED:
        _put_back(b)
    else:
        b.begun[HOW_OFTEN] = NEVER
        refused = _begin(f, given, w, b, t, t1, q, v, sizes, sure or same)
        if refused != 0:
            return refused
        if same:
            _save(b)
        b.begun[HOW_OFTEN] = IS_SAVED if same else 1.0
    for k in range(b.memory.size):
        b.memory[k] = 0.0
    for k in range(b.places.size):
        b.memory[b.places[k]] = b.begin_memory[k]
    b.end[0], b.t[0] = t1, t
    _copy(b.state, b.states[0])
    arrays = b.tolerances, b.control, b.clock, b.state, b.new_state
    code = b.advance(f, w, b.options, b.memory, *arrays, b.end, b.t[1:], b.states[1:], b.steps, b.filled)
    return _tell(w, b, box, b.filled[0], b.filled[1], code, not same)

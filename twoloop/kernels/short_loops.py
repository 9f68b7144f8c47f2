"""What is done before and after the steps of a run: each function spares Python several calls of NumPy or kernels."""

import math

from numba import types

from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.control import clock as at
from twoloop.kernels.data import codes, noted
from twoloop.kernels.data.common import INTEGERS, KIT, MATRIX, VECTOR, WORK, f8, i8, kernel, merged
from twoloop.kernels.data.counters import N_ACCEPTED
from twoloop.kernels.evaluation.first_look import CONSISTENT, DEFINITE, IN_ORDER, INDEFINITE

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


@kernel(f8(VECTOR, i8, f8, f8, f8))
def first_step(state, n, least, span, share):
    """A share of the time in which velocities and accelerations change the coordinates as a whole, s.

    `least` is what counts as the size of coordinates that are zero, of which there is no other length.
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
    if fast > 0.0 and sharp > 0.0 and fast / sharp > share * scale:  # not at what is next to rest
        scale = min(scale, fast / sharp)
    return share * scale


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


REFUSED, IN_DOUBT, READY = range(3)  # another way has to be gone; a closer look has to be taken; at the start

# arrays of looks at starts, of choices and of a run; `begin_numbers` is what `numbers` is full of at a start, and
# `begin_memory` what stands in `memory` at `places`: of the rest, nearly all, to clear it takes less than to copy it
BEGINNING = Reference(
    "Beginning",
    {
        **dict.fromkeys(("looked", "lam", "room", "least", "bounds", "scratch", "constants"), VECTOR),
        **dict.fromkeys(("begin_numbers", "numbers", "begin_memory", "memory", "clock", "state", "lasting"), VECTOR),
        **dict.fromkeys(("mass", "rows", "ways", "pattern"), MATRIX),
        **dict.fromkeys(("chosen", "expected", "lapack", "lasting_integers", "places"), INTEGERS),
    },
)
BEGINNING.add_function("look", i8(KIT, f8, *(VECTOR,) * 5, *(MATRIX,) * 4, VECTOR))
BEGINNING.add_function("choose", i8(MATRIX, MATRIX, f8, f8, VECTOR, VECTOR, INTEGERS))
BEGINNING.add_function("start", i8(KIT, WORK, f8, VECTOR))
ACCURACY, REUSE, NEARLY_SINGULAR, RANK, SCALE, CONTRADICTS = range(6)  # in `constants`
PLACE, N_KEPT, N_ADDED, KEPT = range(4)  # in `expected`, which is empty without code; those that help follow those kept


@merged
def _is_expected(b, weak):
    """Whether the rows that count, and those that help M, are those of the code."""
    b.scratch[0] = 0.0
    place = b.choose(b.mass, b.rows, b.constants[RANK], weak, b.bounds, b.scratch, b.chosen)
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


@kernel(i8(KIT, KIT, WORK, BEGINNING, f8, VECTOR, VECTOR, VECTOR, f8, i8, types.boolean))
def begin(f, given, w, b, t, q, v, sizes, weak, definite, sure):
    """Whether a run begins at a state, with the same choices as the run before it; then it is at its start there.

    `given`: the system that is looked at, with `sizes` as of `look`; `weak` as of `choose`. `definite` is the flag of
    an M that varies, else 0. `sure`: the state is known to be consistent.
    """
    n = q.size
    for k in range(b.looked.size):
        b.looked[k] = 0.0
    found = b.look(given, t, q, v, sizes, b.lam, b.room, b.mass, b.rows, b.ways, b.pattern, b.least)
    if found & IN_ORDER == 0 or found & (DEFINITE | INDEFINITE) != definite:
        return REFUSED
    if found & CONSISTENT == 0 and not sure:
        return IN_DOUBT
    if b.expected.size > 0 and not _is_expected(b, weak):
        return REFUSED
    _copy(b.begin_numbers, b.numbers)
    for k in range(b.memory.size):
        b.memory[k] = 0.0
    for k in range(b.places.size):
        b.memory[b.places[k]] = b.begin_memory[k]
    for j in range(b.state.size):
        b.state[j] = q[j] if j < n else v[j - n] if j < 2 * n else 0.0
    b.clock[at.T] = b.clock[at.T_START] = t
    put_ready(w, b.lasting, b.lasting_integers, b.pattern, q, b.constants[ACCURACY], b.constants[REUSE])
    _copy(b.lapack, w.lapack[: b.lapack.size])
    w.notes[noted.NEARLY_SINGULAR] = b.constants[NEARLY_SINGULAR]
    return READY if b.start(f, w, t, b.state) == codes.DONE and _agree(w, b, n) else REFUSED


# of a run that is made again and again: what `advance` takes, room for its states and steps, and what is told of it
GOING = Reference(
    "Going",
    {
        **dict.fromkeys(("options", "memory", "tolerances", "control", "clock", "state", "new_state"), VECTOR),
        **dict.fromkeys(("end", "t", "told"), VECTOR),
        **dict.fromkeys(("rows", "steps"), MATRIX),
        "filled": INTEGERS,
    },
)
GOING.add_function("advance", i8(KIT, WORK, *(VECTOR,) * 9, MATRIX, MATRIX, INTEGERS))
# in `told`: numbers of states, the first included, and of steps; as numbers, whether velocities turned in the last step
# and all states lie in a box; and what stands in the workspace and the clock
N_STATES, N_STEPS, TURNED, WITHIN, NEARLY, PIVOT, CHECKED, DEFECT, GAP, N_TOLD = range(10)


@merged
def _turned(b, k, n, turned):
    """Whether the velocities of the last two states differ by more than one of their accelerations gives."""
    change, first, last = 0.0, 0.0, 0.0
    for j in range(n):
        change = max(change, abs(b.rows[k, n + j] - b.rows[k - 1, n + j]))
        first, last = max(first, abs(b.rows[k - 1, 2 * n + j])), max(last, abs(b.rows[k, 2 * n + j]))
    return change > turned * (b.t[k] - b.t[k - 1]) * min(first, last)


@merged
def _tell(w, b, n_rows, n_steps, turned, box):
    """Put down what `told` has, after so many rows behind the first, and steps."""
    b.told[N_STATES], b.told[N_STEPS] = 1 + n_rows, n_steps
    b.told[TURNED] = n_rows > 0 and _turned(b, n_rows, w.Q.size, turned)
    b.told[WITHIN] = box.shape[1] > 0 and _lie_within(b.t[: 1 + n_rows], b.rows, box)
    b.told[NEARLY], b.told[PIVOT] = w.notes[noted.NEARLY_SINGULAR], b.clock[at.PIVOT_AT_OUTPUT]
    b.told[CHECKED] = w.counters[N_ACCEPTED] > 0 and w.notes[noted.UNCHECKED] == 0.0
    b.told[DEFECT], b.told[GAP] = w.notes[noted.LARGEST_DEFECT], w.notes[noted.WIDEST_GAP]


@kernel(types.void(WORK, GOING, i8, i8, f8, MATRIX))
def tell(w, b, n_rows, n_steps, turned, box):
    """The same, for Python."""
    _tell(w, b, n_rows, n_steps, turned, box)


@kernel(i8(KIT, WORK, GOING, f8, f8, MATRIX))
def go(f, w, b, t1, turned, box):
    """The first chunk of the steps of a run from its start to t1; how `advance` ended, and `told`.

    `turned` is how many times what accelerations give is too much; `box` has rows [t, q, v], or nothing.
    """
    b.end[0], b.t[0] = t1, b.clock[at.T]
    _copy(b.state, b.rows[0])
    arrays = b.tolerances, b.control, b.clock, b.state, b.new_state
    code = b.advance(f, w, b.options, b.memory, *arrays, b.end, b.t[1:], b.rows[1:], b.steps, b.filled)
    _tell(w, b, b.filled[0], b.filled[1], turned, box)
    return code

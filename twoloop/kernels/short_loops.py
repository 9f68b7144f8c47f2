"""Short loops before and after the steps of a run: each spares Python several calls of NumPy."""

import math

from numba import types

from twoloop.kernels.control import clock as at
from twoloop.kernels.data import noted
from twoloop.kernels.data.common import INTEGERS, MATRIX, VECTOR, WORK, f8, i8, kernel

ROUNDING = 1e-15  # of the largest coordinate: corrections of this size are rounding


@kernel(types.void(WORK, VECTOR, INTEGERS, MATRIX, VECTOR, f8, f8))
def make_ready(w, numbers, integers, pattern, q, accuracy, reuse):
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


@kernel(types.boolean(VECTOR, MATRIX, MATRIX))
def lies_within(t, rows, box):
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

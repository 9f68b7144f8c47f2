"""Algebra on vectors with one number for each SIMD lane, and control of the steps of Runge-Kutta methods in lanes.

LU factors and projections are of one matrix per lane. Places are counted in vectors. The imaginary part of a complex
number is `imaginary` vectors behind the real part; 0: the number is real. Each lane has its own step size, controlled
by its own estimated errors.
"""

import numpy as np

from twoloop.kernels.control.loop_state import N_PAST, N_RULE
from twoloop.kernels.control.step_size import factor_of, record_accepted
from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.lanes.layout import (
    ACCEPTED,
    AHEAD,
    ATOL,
    CHECKS_REDUNDANT,
    ERROR,
    FINE,
    FRESH,
    GAP,
    H_LIMIT,
    H_NEXT,
    LANES,
    LEFT_TO_MOVE,
    LIMIT_AGE,
    MANY_STEPS,
    N_NUMBERS,
    N_ROWS,
    NO_VALUES,
    OFF,
    OFTEN_REFUSED,
    ORDER,
    PAST,
    REFUSED,
    ROUGH_TO,
    RTOL,
    RUN,
    RUNNING,
    SHORTEST,
    T0,
    T1,
    WANTED,
    H,
    N,
    T,
    X,
    leave_run,
    places_of,
)


@inlined
def vectors(work, begin, count):
    """Return a view of vectors, one after the other."""
    return work[begin * LANES : (begin + count) * LANES]


@inlined
def table(work, begin, rows, count):
    """Return a view of rows of vectors."""
    return work[begin * LANES : (begin + rows * count) * LANES].reshape((rows, count * LANES))


@compiled
def copy_vectors(work, source, target, count):
    """Copy vectors from source to target."""
    for i in range(count * LANES):
        work[target * LANES + i] = work[source * LANES + i]


@compiled
def sum_rows(weights, rows, total):
    """Compute the sum of weights[k] rows[k], four rows at once, so that LLVM vectorizes it."""
    first = weights.size % 4
    for m in range(total.size):
        total[m] = 0.0
    for k in range(first):
        weight, row = weights[k], rows[k]
        for m in range(total.size):
            total[m] += weight * row[m]
    for k in range(first, weights.size, 4):
        a, b, c, d = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
        for m in range(total.size):
            total[m] += (a * rows[k, m] + b * rows[k + 1, m]) + (c * rows[k + 2, m] + d * rows[k + 3, m])


@merged
def _add_four(work, t, p, q, sign):
    t0, t1 = work[t] + sign * work[p] * work[q], work[t + 1] + sign * work[p + 1] * work[q + 1]
    t2, t3 = work[t + 2] + sign * work[p + 2] * work[q + 2], work[t + 3] + sign * work[p + 3] * work[q + 3]
    work[t], work[t + 1], work[t + 2], work[t + 3] = t0, t1, t2, t3


@compiled
def add_product(work, target, x, y, sign):
    """Add sign x y to target in each lane; read four before writing, because LLVM cannot rule out that they overlap."""
    for k in range(0, LANES, 4):
        _add_four(work, target * LANES + k, x * LANES + k, y * LANES + k, sign)


@merged
def _larger(work, most, error, factor, one, other, atol, rtol):
    scale = atol + rtol * max(abs(work[one]), abs(work[other]))
    return max(work[most], abs(work[error]) * work[factor] / scale)


@compiled
def enlarge(work, most, error, factor, one, other, atol, rtol):
    """Raise `most` to |error| factor / (atol + rtol max(|one|, |other|)) in each lane."""
    for k in range(0, LANES, 4):
        m, e, f, x, y = most * LANES + k, error * LANES + k, factor * LANES + k, one * LANES + k, other * LANES + k
        m0 = _larger(work, m, e, f, x, y, atol, rtol)
        m1 = _larger(work, m + 1, e + 1, f + 1, x + 1, y + 1, atol, rtol)
        m2 = _larger(work, m + 2, e + 2, f + 2, x + 2, y + 2, atol, rtol)
        m3 = _larger(work, m + 3, e + 3, f + 3, x + 3, y + 3, atol, rtol)
        work[m], work[m + 1], work[m + 2], work[m + 3] = m0, m1, m2, m3


@merged
def _scale(work, target, apart, x, imaginary):
    """Multiply an entry of a matrix, target, by x."""
    for k in range(LANES):
        t, p = target * LANES + k, x * LANES + k
        if imaginary == 0:
            work[t] *= work[p]
        else:
            i, j = apart * LANES, imaginary * LANES
            re, im = work[t] * work[p] - work[t + i] * work[p + j], work[t] * work[p + j] + work[t + i] * work[p]
            work[t], work[t + i] = re, im


@merged
def _subtract(work, target, x, y, imaginary, imaginary_y):
    """Subtract x y from target; for vectors y and target, imaginary parts are elsewhere than for matrices."""
    add_product(work, target, x, y, -1.0)
    if imaginary > 0:
        add_product(work, target, x + imaginary, y + imaginary_y, 1.0)
        add_product(work, target + imaginary_y, x, y + imaginary_y, -1.0)
        add_product(work, target + imaginary_y, x + imaginary, y, -1.0)


@merged
def _exchange(work, one, other, k):
    i, j = one * LANES + k, other * LANES + k
    work[i], work[j] = work[j], work[i]


@merged
def _size(work, place, imaginary, k):
    size = abs(work[place * LANES + k])
    return size if imaginary == 0 else size + abs(work[(place + imaginary) * LANES + k])


@compiled
def _pivot(work, matrix, pivots, n, imaginary, c):
    """Exchange rows so that the largest entry of a column is the pivot, and invert it; clear FINE if all are zero."""
    for k in range(LANES):
        best, top = c, _size(work, matrix + c * n + c, imaginary, k)
        for i in range(c + 1, n):
            size = _size(work, matrix + i * n + c, imaginary, k)
            if size > top:
                best, top = i, size
        work[(pivots + c) * LANES + k] = best
        if best != c:
            for j in range(n):
                _exchange(work, matrix + c * n + j, matrix + best * n + j, k)
                if imaginary > 0:
                    _exchange(work, matrix + c * n + j + imaginary, matrix + best * n + j + imaginary, k)
        if not top > 0.0:
            work[FINE * LANES + k] = 0.0
        re = (matrix + c * n + c) * LANES + k
        if imaginary == 0:
            work[re] = 1.0 / work[re]
        else:
            im = re + imaginary * LANES
            square = work[re] * work[re] + work[im] * work[im]
            work[re], work[im] = work[re] / square, -work[im] / square


@compiled
def factor_lanes(work, matrix, pivots, n, imaginary):
    """Replace a matrix (n, n) by its LU factors; each lane exchanges its own rows."""
    for c in range(n):
        _pivot(work, matrix, pivots, n, imaginary, c)
        for i in range(c + 1, n):
            _scale(work, matrix + i * n + c, imaginary, matrix + c * n + c, imaginary)
            for j in range(c + 1, n):
                row, column = matrix + i * n + c, matrix + c * n + j
                _subtract(work, matrix + i * n + j, row, column, imaginary, imaginary)


@compiled
def solve_lanes(work, matrix, pivots, n, imaginary, x):
    """Replace a right-hand side x (n), followed by n imaginary parts, by the solution."""
    apart = n if imaginary > 0 else 0
    for c in range(n):
        for k in range(LANES):
            best = int(work[(pivots + c) * LANES + k])
            if best != c:
                _exchange(work, x + c, x + best, k)
                if imaginary > 0:
                    _exchange(work, x + n + c, x + n + best, k)
    for i in range(n):
        for j in range(i):
            _subtract(work, x + i, matrix + i * n + j, x + j, imaginary, apart)
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            _subtract(work, x + i, matrix + i * n + j, x + j, imaginary, apart)
        _scale(work, x + i, apart, matrix + i * n + i, imaginary)


MOST_PASSES = 10


@compiled
def project_lanes(code, order, control, work):
    """Project NEW of the lanes that are FINE onto the constraints; FINE stays 1 where it converged."""
    code.approach(order, control, work)
    for _ in range(MOST_PASSES):
        code.refine(order, control, work)
        left = 0.0
        for k in range(LANES):
            left += work[LEFT_TO_MOVE * LANES + k]
        if left == 0.0:
            break


# `options` begin with the rule of step-size control, then ROUGH: factor by which errors may exceed their estimates
# where a force jumps; FIRST: first step, relative to the shortest time scale of the start; LEAST: tolerance. Options of
# the single step follow
ROUGH, FIRST, LEAST, N_HEAD = range(N_RULE, N_RULE + 4)

# as UNFORESEEN, REFUSED and the rounding of the last step in kernels/advance.py and step_size.py
SUDDEN, SHORTENED, WHOLE = 10.0, 0.95, 1e-10
LIMIT_FACTOR, LIMIT_MEMORY = 0.7, 10.0  # as in the Plan of a run
RESOLVED = 20.0 * SHORTEST  # relative to the time at the start: lower bound of the first step
MOST_REFUSED = 30  # rejected steps in a row: estimates may say little about how much shorter a stiff step has to be
MOST_STEPS = 100_000  # largest number of steps of a run in lanes, which nothing can interrupt


@inlined
def _past(work, k):
    return work[PAST * LANES + N_PAST * k : PAST * LANES + N_PAST * (k + 1)]


@compiled
def _first_step(options, control, work, n, state, a, k):
    """Return the first step: a share of the time in which the state moves by the size of its coordinates."""
    far, fast, sharp, least = 0.0, 0.0, 0.0, np.inf
    for j in range(n):
        far = max(far, abs(work[(state + j) * LANES + k]))
        fast = max(fast, abs(work[(state + n + j) * LANES + k]))
        sharp = max(sharp, abs(work[(a + j) * LANES + k]))
        least = min(least, control[ATOL + j])
    far, scale = max(far, least), control[T1] - control[T0]
    if fast > 0.0:
        scale = min(scale, far / fast)
    if sharp > 0.0:
        scale = min(scale, np.sqrt(far / sharp))
    if fast > 0.0 and sharp > 0.0 and fast / sharp > options[FIRST] * scale:
        scale = min(scale, fast / sharp)
    return max(options[FIRST] * scale, RESOLVED * abs(control[T0]))


@compiled
def begin_control(options, control, work, n, state, a, start):
    """Choose first steps of new runs, and copy their accelerations A to `start`."""
    for k in range(LANES):
        if work[FRESH * LANES + k] == 1.0:
            for j in range(n):
                work[(start + j) * LANES + k] = work[(a + j) * LANES + k]
            work[H_NEXT * LANES + k] = _first_step(options, control, work, n, state, a, k)
            work[H_LIMIT * LANES + k], work[LIMIT_AGE * LANES + k] = np.inf, 0.0
            work[ROUGH_TO * LANES + k] = -np.inf
            for i in range(N_PAST):
                work[PAST * LANES + N_PAST * k + i] = 0.0


@compiled
def choose_steps(work, control, status, n_steps):
    """Choose H and X of each lane, at most the gap, 0 in lanes without a run; FINE marks lanes with a run."""
    t1 = control[T1]
    for k in range(LANES):
        work[H * LANES + k], t = 0.0, work[T * LANES + k]
        if work[RUNNING * LANES + k] == 1.0:
            wanted = min(work[H_NEXT * LANES + k], work[H_LIMIT * LANES + k], control[GAP])
            h, left = wanted, t1 - t
            if h >= left * (1.0 - WHOLE):
                h = left
            elif h > 0.5 * left:
                h = 0.5 * left  # two equal steps rather than a long and a tiny one
            if n_steps[int(work[RUN * LANES + k])] >= MOST_STEPS:
                leave_run(work, status, k, MANY_STEPS)
            elif h > SHORTEST * max(abs(t), abs(t1)):
                work[H * LANES + k], work[WANTED * LANES + k] = h, wanted
            else:
                failed = work[H_LIMIT * LANES + k] < np.inf and work[LIMIT_AGE * LANES + k] == 0.0
                leave_run(work, status, k, NO_VALUES if failed else OFTEN_REFUSED)
        work[X * LANES + k] = work[H * LANES + k]
        work[FINE * LANES + k] = work[RUNNING * LANES + k]


@compiled
def set_end(work, control):
    """Set AHEAD to the time X after the beginning of the step."""
    for k in range(LANES):
        t, x = work[T * LANES + k], work[X * LANES + k]
        work[AHEAD * LANES + k] = control[T1] if x == control[T1] - t else t + x


@compiled
def end_steps(code, settings, control, work, predicted_v):
    """Project NEW; ERROR is at least the distance of the prediction, in positions and velocities.

    Velocities that the constraints change by more than the tolerances show a drive that jumps or bends between the
    stages. `predicted_v`: scratch for velocities.
    """
    n, order = settings[N], settings[ORDER]
    state, new, predicted, _, _, _, _, _ = places_of(n, settings[N_ROWS], settings[N_NUMBERS])
    for i in range(n * LANES):
        work[predicted * LANES + i] = work[new * LANES + i]
        work[predicted_v * LANES + i] = work[(new + n) * LANES + i]
    project_lanes(code, order, control, work)
    if settings[CHECKS_REDUNDANT] == 1:
        code.redundant(order, control, work)
    code.departure(order, control, work)
    for i in range(n * LANES):
        work[predicted_v * LANES + i] -= work[(new + n) * LANES + i]
    for j in range(n):
        atol = control[ATOL + j]
        enlarge(work, ERROR, predicted_v + j, RUNNING, state + n + j, new + n + j, atol, control[RTOL])
    for k in range(LANES):
        work[ERROR * LANES + k] = max(work[ERROR * LANES + k], work[OFF * LANES + k])


@merged
def _accepted(options, work, k):
    """Return whether the step of a lane is accepted, and choose the size of the next one."""
    h, t, error = work[H * LANES + k], work[T * LANES + k], work[ERROR * LANES + k]
    if work[FINE * LANES + k] == 0.0 or not np.isfinite(error):
        work[H_NEXT * LANES + k], work[H_LIMIT * LANES + k] = 0.5 * h, LIMIT_FACTOR * h
        work[LIMIT_AGE * LANES + k] = 0.0
        return False
    # at a jump the embedded formula may agree by chance: until ROUGH_TO the estimated error has to be smaller
    strict = options[ROUGH] if t < work[ROUGH_TO * LANES + k] else 1.0
    accepted = error * strict <= 1.0
    if error > SUDDEN and not accepted:
        work[ROUGH_TO * LANES + k] = t + h
    error *= strict
    past = _past(work, k)
    proposal = min(h * factor_of(options, past, h, error), work[H_LIMIT * LANES + k])
    if not accepted:
        work[H_NEXT * LANES + k] = min(proposal, SHORTENED * h)
        return False
    record_accepted(options, past, h, error)
    work[H_NEXT * LANES + k] = max(proposal, work[WANTED * LANES + k]) if h < work[WANTED * LANES + k] else proposal
    work[LIMIT_AGE * LANES + k] += 1.0
    if work[LIMIT_AGE * LANES + k] > LIMIT_MEMORY:
        work[H_LIMIT * LANES + k] = np.inf
    return True


@compiled
def judge_steps(options, work, n, a, start, status):
    """Set ACCEPTED by ERROR and FINE; copy the accelerations A at the ends of these steps to `start`."""
    for k in range(LANES):
        work[ACCEPTED * LANES + k] = 0.0
        if work[RUNNING * LANES + k] == 0.0:
            continue
        if _accepted(options, work, k):
            work[ACCEPTED * LANES + k] = 1.0
            for j in range(n):
                work[(start + j) * LANES + k] = work[(a + j) * LANES + k]
        else:
            work[REFUSED * LANES + k] += 1.0
            if work[REFUSED * LANES + k] > MOST_REFUSED:
                leave_run(work, status, k, OFTEN_REFUSED if work[FINE * LANES + k] == 1.0 else NO_VALUES)

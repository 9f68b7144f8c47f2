"""Operations on vectors with one number for each lane: LU factors of one matrix per lane, and projections.

Places are counted in vectors. The imaginary part of a complex number is `imaginary` vectors behind the real part; 0:
the number is real.
"""

from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.lanes.layout import FINE, LANES, LEFT_TO_MOVE


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

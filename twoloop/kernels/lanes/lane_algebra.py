"""Linear algebra in lanes: LU factors of a matrix a lane, real or complex, and vectors of which each lane has its own.

Places are counted in vectors; of a complex number the imaginary part stands `imaginary` further on, 0: it is real.
"""

from twoloop.kernels.data.common import compiled, inlined, merged
from twoloop.kernels.lanes.lane_room import FINE, LANES


@inlined
def vectors(room, begin, count):
    """So many vectors, one after the other."""
    return room[begin * LANES : (begin + count) * LANES]


@inlined
def table(room, begin, rows, count):
    """Rows of so many vectors."""
    return room[begin * LANES : (begin + rows * count) * LANES].reshape((rows, count * LANES))


@compiled
def copy_vectors(room, source, target, count):
    """So many vectors to another place."""
    for i in range(count * LANES):
        room[target * LANES + i] = room[source * LANES + i]


@compiled
def sum_rows(weights, rows, total):
    """The sum of weights[k] rows[k], four rows at once, which LLVM makes vectors of."""
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
def _add_four(room, t, p, q, sign):
    t0, t1 = room[t] + sign * room[p] * room[q], room[t + 1] + sign * room[p + 1] * room[q + 1]
    t2, t3 = room[t + 2] + sign * room[p + 2] * room[q + 2], room[t + 3] + sign * room[p + 3] * room[q + 3]
    room[t], room[t + 1], room[t + 2], room[t + 3] = t0, t1, t2, t3


@compiled
def add_product(room, target, x, y, sign):
    """target += sign x y, in each lane; four are read before they are written, as LLVM knows of no places apart."""
    for k in range(0, LANES, 4):
        _add_four(room, target * LANES + k, x * LANES + k, y * LANES + k, sign)


@merged
def _larger(room, most, error, factor, one, other, atol, rtol):
    scale = atol + rtol * max(abs(room[one]), abs(room[other]))
    return max(room[most], abs(room[error]) * room[factor] / scale)


@compiled
def enlarge(room, most, error, factor, one, other, atol, rtol):
    """`most` is at least |error| factor / (atol + rtol max(|one|, |other|)), in each lane."""
    for k in range(0, LANES, 4):
        m, e, f, x, y = most * LANES + k, error * LANES + k, factor * LANES + k, one * LANES + k, other * LANES + k
        m0 = _larger(room, m, e, f, x, y, atol, rtol)
        m1 = _larger(room, m + 1, e + 1, f + 1, x + 1, y + 1, atol, rtol)
        m2 = _larger(room, m + 2, e + 2, f + 2, x + 2, y + 2, atol, rtol)
        m3 = _larger(room, m + 3, e + 3, f + 3, x + 3, y + 3, atol, rtol)
        room[m], room[m + 1], room[m + 2], room[m + 3] = m0, m1, m2, m3


@merged
def _scale(room, target, apart, x, imaginary):
    """target *= x, an entry of a matrix."""
    for k in range(LANES):
        t, p = target * LANES + k, x * LANES + k
        if imaginary == 0:
            room[t] *= room[p]
        else:
            i, j = apart * LANES, imaginary * LANES
            re, im = room[t] * room[p] - room[t + i] * room[p + j], room[t] * room[p + j] + room[t + i] * room[p]
            room[t], room[t + i] = re, im


@merged
def _subtract(room, target, x, y, imaginary, imaginary_y):
    """target -= x y; of a vector y, and its target, imaginary parts are elsewhere than those of a matrix."""
    add_product(room, target, x, y, -1.0)
    if imaginary > 0:
        add_product(room, target, x + imaginary, y + imaginary_y, 1.0)
        add_product(room, target + imaginary_y, x, y + imaginary_y, -1.0)
        add_product(room, target + imaginary_y, x + imaginary, y, -1.0)


@merged
def _exchange(room, one, other, k):
    i, j = one * LANES + k, other * LANES + k
    room[i], room[j] = room[j], room[i]


@merged
def _size(room, place, imaginary, k):
    size = abs(room[place * LANES + k])
    return size if imaginary == 0 else size + abs(room[(place + imaginary) * LANES + k])


@compiled
def _pivot(room, matrix, pivots, n, imaginary, c):
    """The largest of a column comes to the diagonal, and its inverse takes its place; FINE where there is one."""
    for k in range(LANES):
        best, top = c, _size(room, matrix + c * n + c, imaginary, k)
        for i in range(c + 1, n):
            size = _size(room, matrix + i * n + c, imaginary, k)
            if size > top:
                best, top = i, size
        room[(pivots + c) * LANES + k] = best
        if best != c:
            for j in range(n):
                _exchange(room, matrix + c * n + j, matrix + best * n + j, k)
                if imaginary > 0:
                    _exchange(room, matrix + c * n + j + imaginary, matrix + best * n + j + imaginary, k)
        if not top > 0.0:
            room[FINE * LANES + k] = 0.0
        re = (matrix + c * n + c) * LANES + k
        if imaginary == 0:
            room[re] = 1.0 / room[re]
        else:
            im = re + imaginary * LANES
            square = room[re] * room[re] + room[im] * room[im]
            room[re], room[im] = room[re] / square, -room[im] / square


@compiled
def factor_lanes(room, matrix, pivots, n, imaginary):
    """LU factors of a matrix (n, n) in place, rows exchanged in each lane as it needs."""
    for c in range(n):
        _pivot(room, matrix, pivots, n, imaginary, c)
        for i in range(c + 1, n):
            _scale(room, matrix + i * n + c, imaginary, matrix + c * n + c, imaginary)
            for j in range(c + 1, n):
                row, column = matrix + i * n + c, matrix + c * n + j
                _subtract(room, matrix + i * n + j, row, column, imaginary, imaginary)


@compiled
def solve_lanes(room, matrix, pivots, n, imaginary, x):
    """The solution for a right-hand side x (n), and then n imaginary parts, in its place."""
    apart = n if imaginary > 0 else 0
    for c in range(n):
        for k in range(LANES):
            best = int(room[(pivots + c) * LANES + k])
            if best != c:
                _exchange(room, x + c, x + best, k)
                if imaginary > 0:
                    _exchange(room, x + n + c, x + n + best, k)
    for i in range(n):
        for j in range(i):
            _subtract(room, x + i, matrix + i * n + j, x + j, imaginary, apart)
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            _subtract(room, x + i, matrix + i * n + j, x + j, imaginary, apart)
        _scale(room, x + i, apart, matrix + i * n + i, imaginary)

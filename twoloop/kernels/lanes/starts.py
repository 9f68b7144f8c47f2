"""Project initial states onto the constraints by the least change, in lanes, and check for a second assembly as near.

The least change follows from the Cholesky factors of G G^T, with the rows of G scaled to length 1. Redundant rows are
dependent on the constraints, but only nearly so beside them. Eigenvectors z of G G^T, combinations of rows that vanish
on the constraints, are therefore removed: the sum of z z^T is added to G G^T. Lanes are independent of one another.

`pattern` gives the columns of the entries of each row: first where they begin and end in `pattern`, then the columns.

Residuals of the constraints and of the equations of motion, which check runs in lanes, are computed by the callbacks.
"""

import numpy as np
from numba import types

from twoloop.kernels.compile.callbacks import VECTOR, f8
from twoloop.kernels.data.common import INTEGERS, KIT, compiled, kernel, merged
from twoloop.kernels.data.indices import GAMMA_GIVEN
from twoloop.kernels.lanes.layout import (
    AHEAD,
    CODE,
    FINE,
    LANES,
    LEFT_TO_MOVE,
    N_NUMBERS,
    N_ROWS,
    RUNNING,
    T0,
    N,
    copy_vectors,
    fill_field,
    places_of,
)

LEAST = 1e-15  # added to the diagonal of G G^T, so that it has an inverse ...
ITERATION_SHIFT = 1e-8  # ... and for inverse iteration, when some of its eigenvalues vanish
WEAK = 1e-4  # relative to the largest eigenvalue: redundant rows have a smaller one
# number of inverse iterations for eigenvectors of redundant rows, whose eigenvalues are far smaller
REDUNDANT_ITERATIONS = 5
GOLDEN = 0.6180339887498949


@merged
def _subtract_four(work, target, x, dx, y, dy, count):
    t0, t1, t2, t3 = work[target], work[target + 1], work[target + 2], work[target + 3]
    for _ in range(count):
        t0 -= work[x] * work[y]
        t1 -= work[x + 1] * work[y + 1]
        t2 -= work[x + 2] * work[y + 2]
        t3 -= work[x + 3] * work[y + 3]
        x += dx
        y += dy
    work[target], work[target + 1], work[target + 2], work[target + 3] = t0, t1, t2, t3


@compiled
def subtract_products(work, target, x, dx, y, dy, count):
    """Subtract from target the sum of products of vectors that are dx and dy apart, in each lane."""
    for k in range(0, LANES, 4):
        _subtract_four(work, target * LANES + k, x * LANES + k, dx * LANES, y * LANES + k, dy * LANES, count)


@merged
def subtract_row(work, target, entries, pattern, i, y):
    """Subtract row i of G times y from target; the entries of all rows follow one another."""
    for e in range(pattern[i], pattern[i + 1]):
        subtract_products(work, target, entries + e - pattern[0], 1, y + pattern[e], 1, 1)


@compiled
def _scale(work, target, factor):
    for k in range(LANES):
        work[target * LANES + k] *= work[factor * LANES + k]


@compiled
def _cholesky(work, pattern, n_rows, n_redundant, row, factors, shift):
    """Factor G G^T + shift + Z Z^T by Cholesky in each lane; the diagonal is stored inverted."""
    n_entries = pattern[n_rows] - pattern[0]
    gram = factors + n_entries + n_rows
    Z = gram + n_rows * n_rows
    for i in range(n_rows):
        for e in range(pattern[i], pattern[i + 1]):
            copy_vectors(work, factors + e - pattern[0], row + pattern[e], 1)
        for j in range(i + 1):
            entry = gram + i * n_rows + j
            fill_field(work, entry, -shift if i == j else 0.0)
            subtract_row(work, entry, factors, pattern, j, row)
            subtract_products(work, entry, Z + i, n_rows, Z + j, n_rows, n_redundant)
            for k in range(LANES):
                work[entry * LANES + k] *= -1.0
            subtract_products(work, entry, gram + i * n_rows, 1, gram + j * n_rows, 1, j)
            if i > j:
                _scale(work, entry, gram + j * n_rows + j)
        for k in range(LANES):
            pivot = work[(gram + i * n_rows + i) * LANES + k]
            work[(gram + i * n_rows + i) * LANES + k] = 1.0 / np.sqrt(pivot) if pivot > 0.0 else np.nan
        for e in range(pattern[i], pattern[i + 1]):
            fill_field(work, row + pattern[e], 0.0)


@compiled
def factor_gram(work, pattern, moves, n_rows, n_redundant, G, row, factors):
    """Scale the rows, without fixed coordinates, to length 1; compute 1 / lengths, the factors of G G^T, and Z."""
    n_entries = pattern[n_rows] - pattern[0]
    for i in range(n_rows):
        length = factors + n_entries + i
        fill_field(work, length, 0.0)
        for e in range(pattern[i], pattern[i + 1]):
            entry = e - pattern[0]
            if moves[pattern[e]] == 1:
                copy_vectors(work, G + entry, factors + entry, 1)
                subtract_products(work, length, G + entry, 1, G + entry, 1, 1)
            else:
                fill_field(work, factors + entry, 0.0)
        for k in range(LANES):
            square = -work[length * LANES + k]
            work[length * LANES + k] = 1.0 / np.sqrt(square) if square != 0.0 else 1.0
        for e in range(pattern[i], pattern[i + 1]):
            _scale(work, factors + e - pattern[0], length)
    if n_redundant > 0:
        _find_redundant(work, pattern, n_rows, n_redundant, row, factors)
    _cholesky(work, pattern, n_rows, n_redundant, row, factors, LEAST)


@compiled
def _find_redundant(work, pattern, n_rows, n_redundant, row, factors):
    """Compute Z, eigenvectors of the smallest eigenvalues of G G^T; NaN where these are not small."""
    gram = factors + pattern[n_rows] - pattern[0] + n_rows
    Z = gram + n_rows * n_rows
    spare = Z + n_redundant * n_rows
    _cholesky(work, pattern, n_rows, 0, row, factors, ITERATION_SHIFT)
    for w in range(n_redundant):
        z = Z + w * n_rows
        for i in range(n_rows):
            fill_field(work, z + i, 0.5 + (GOLDEN * (i + 1) * (w + 1)) % 1.0)
        for _ in range(REDUNDANT_ITERATIONS):
            normalise(work, z, n_rows, spare)
            _solve(work, n_rows, gram, z)
            _remove_redundant(work, n_rows, w, Z, z, spare)
        normalise(work, z, n_rows, spare)
        for k in range(LANES):
            if not work[spare * LANES + k] < WEAK:  # `spare` is the eigenvalue plus ITERATION_SHIFT
                work[z * LANES + k] = np.nan


@compiled
def normalise(work, x, n_rows, spare):
    """Scale x to length 1; `spare` becomes 1 over its length before."""
    fill_field(work, spare, 0.0)
    subtract_products(work, spare, x, 1, x, 1, n_rows)
    for k in range(LANES):
        work[spare * LANES + k] = 1.0 / np.sqrt(abs(work[spare * LANES + k]))
    for i in range(n_rows):
        _scale(work, x + i, spare)


@compiled
def _remove_redundant(work, n_rows, n_redundant, Z, x, spare):
    """Remove the components along Z from x."""
    for w in range(n_redundant):
        z = Z + w * n_rows
        fill_field(work, spare, 0.0)
        subtract_products(work, spare, z, 1, x, 1, n_rows)
        for k in range(LANES):
            work[spare * LANES + k] *= -1.0
        for i in range(n_rows):
            subtract_products(work, x + i, z + i, 1, spare, 1, 1)


@compiled
def _solve(work, n_rows, gram, x):
    """Replace x by the solution y of the factored matrix, G G^T y = x."""
    for i in range(n_rows):
        subtract_products(work, x + i, gram + i * n_rows, 1, x, 1, i)
        _scale(work, x + i, gram + i * n_rows + i)
    for i in range(n_rows - 1, -1, -1):
        subtract_products(work, x + i, gram + (i + 1) * n_rows + i, n_rows, x + i + 1, 1, n_rows - 1 - i)
        _scale(work, x + i, gram + i * n_rows + i)


@compiled
def along_rows(work, pattern, n, n_rows, n_redundant, factors, x, out):
    """Replace x by y with G G^T y = x, for rows of length 1 and without redundant components; out = -G^T y."""
    gram = factors + pattern[n_rows] - pattern[0] + n_rows
    Z = gram + n_rows * n_rows
    _remove_redundant(work, n_rows, n_redundant, Z, x, Z + n_redundant * n_rows)
    _solve(work, n_rows, gram, x)
    for j in range(n):
        fill_field(work, out + j, 0.0)
    for i in range(n_rows):
        for e in range(pattern[i], pattern[i + 1]):
            subtract_products(work, out + pattern[e], x + i, 1, factors + e - pattern[0], 1, 1)


@compiled
def least_change(work, pattern, n, n_rows, n_redundant, factors, x, change):
    """Compute the smallest change with G change = -x; not finite where rows are dependent. x is overwritten."""
    for i in range(n_rows):
        _scale(work, x + i, factors + pattern[n_rows] - pattern[0] + i)
    along_rows(work, pattern, n, n_rows, n_redundant, factors, x, change)


MOST_ITERATIONS = 12
AT_ROUNDING = 64.0  # largest residual of a constraint, in rounding errors of its terms
MAX_CURVATURE = 0.25  # relative to a displacement: largest distance of its projection from the prediction by C_q
SINGULAR = 1e-12  # smallest eigenvalue of G G^T, rows of length 1, of independent rows
# number of inverse iterations for the eigenvector of the smallest eigenvalue of independent rows
WEAKEST_ITERATIONS = 10
N_REDUNDANT = 5  # index in `settings`, after those of layout.py: number of redundant rows
# other guesses: factors of the way from the guess to the state found, and of the weakest direction, for their distances
OTHER_GUESSES = ((-2.0, 0.0), (0.0, 1.0), (0.0, -1.0))


def places_of_starts(n, n_rows, n_entries, n_redundant):
    """Return the offsets of the parts of `work`, from the memory of the method on, and its length.

    The parts are: C, C_t and the entries of G, as generated code writes them; numbers of rows; changes of positions or
    velocities; positions found; the way to them; the direction that the rows determine least; a displacement; a row;
    the results of `factor_gram` at the positions found, and at NEW.
    """
    G = 2 * n_rows
    x = G + n_entries
    change = x + n_rows
    found = change + n
    moved = found + n
    weakest = moved + n
    way = weakest + n
    row = way + n
    there = row + n
    size = n_entries + n_rows * (1 + n_rows + n_redundant) + 1
    return G, x, change, found, moved, weakest, way, row, there, there + size, there + 2 * size


_places = merged(places_of_starts)


@merged
def _largest(work, place, count, k):
    largest = 0.0
    for j in range(count):
        size = abs(work[(place + j) * LANES + k])
        largest = largest if size <= largest else size  # keeps NaN
    return largest


@merged
def _constraints_hold(work, pattern, n, n_rows, C, G, new, k):
    """Return whether each constraint holds up to the rounding of its terms."""
    allowed = AT_ROUNDING * np.finfo(np.float64).eps * _largest(work, new, n, k)
    for i in range(n_rows):
        off, terms = abs(work[(C + i) * LANES + k]), 0.0
        for e in range(pattern[i], pattern[i + 1]):
            terms += abs(work[(G + e - pattern[0]) * LANES + k])
        if off != 0.0 and not off <= allowed * terms:
            return False
    return True


@compiled
def _gauss_newton(code, settings, control, pattern, moves, work):
    """Move NEW onto the constraints by steps of least change; RUNNING remains 1 in lanes where that converges."""
    n, n_rows, n_redundant = settings[N], settings[N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    G, x, change, _, _, _, _, row, _, here, _ = _places(n, n_rows, pattern[n_rows] - pattern[0], n_redundant)
    G, x, change, row, factors = memory + G, memory + x, memory + change, memory + row, memory + here
    for k in range(LANES):
        work[LEFT_TO_MOVE * LANES + k] = work[RUNNING * LANES + k]
    for _ in range(MOST_ITERATIONS):
        fill_field(work, FINE, 1.0)
        code.rows(0, control, work)
        factor_gram(work, pattern, moves, n_rows, n_redundant, G, row, factors)
        copy_vectors(work, memory, x, n_rows)
        least_change(work, pattern, n, n_rows, n_redundant, factors, x, change)
        left = 0.0
        for k in range(LANES):
            if work[LEFT_TO_MOVE * LANES + k] == 0.0:
                continue
            if work[FINE * LANES + k] == 0.0 or not _largest(work, change, n, k) < np.inf:
                work[LEFT_TO_MOVE * LANES + k] = work[RUNNING * LANES + k] = 0.0
                continue
            for j in range(n):
                work[(new + j) * LANES + k] += work[(change + j) * LANES + k]
            # check after the change, so that it is applied to the last bit
            if _constraints_hold(work, pattern, n, n_rows, memory, G, new, k):
                work[LEFT_TO_MOVE * LANES + k] = 0.0
            else:
                left += 1.0
        if left == 0.0:
            return
    for k in range(LANES):
        if work[LEFT_TO_MOVE * LANES + k] == 1.0:
            work[RUNNING * LANES + k] = 0.0


@compiled
def _change_velocities(code, settings, control, pattern, moves, work):
    """Project velocities of NEW onto the rows at its positions; the factors of the rows are kept."""
    n, n_rows, n_redundant = settings[N], settings[N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    G, x, change, _, _, _, _, row, there, _, _ = _places(n, n_rows, pattern[n_rows] - pattern[0], n_redundant)
    G, x, change, row, factors = memory + G, memory + x, memory + change, memory + row, memory + there
    fill_field(work, FINE, 1.0)
    code.rows(0, control, work)
    factor_gram(work, pattern, moves, n_rows, n_redundant, G, row, factors)
    for _ in range(2):  # the second pass removes the rounding errors of a large change
        for i in range(n_rows):
            fill_field(work, x + i, 0.0)
            subtract_row(work, x + i, G, pattern, i, new + n)
            for k in range(LANES):
                work[(x + i) * LANES + k] = work[(memory + n_rows + i) * LANES + k] - work[(x + i) * LANES + k]
        least_change(work, pattern, n, n_rows, n_redundant, factors, x, change)
        for j in range(n * LANES):
            work[(new + n) * LANES + j] += work[change * LANES + j]
    for k in range(LANES):
        if work[FINE * LANES + k] == 0.0 or not _largest(work, new, 2 * n, k) < np.inf:
            work[RUNNING * LANES + k] = 0.0


@compiled
def _find_weakest_direction(work, pattern, n, n_rows, n_redundant, factors, x, moved, weakest):
    """Find the direction that rows determine least, as long as the way of the guess; clear RUNNING if rows depend."""
    spare = factors + pattern[n_rows] - pattern[0] + n_rows * (1 + n_rows + n_redundant)
    for i in range(n_rows):
        fill_field(work, x + i, 0.5 + (GOLDEN * (i + 1)) % 1.0)
    for _ in range(WEAKEST_ITERATIONS):
        normalise(work, x, n_rows, spare)
        along_rows(work, pattern, n, n_rows, n_redundant, factors, x, weakest)
    normalise(work, x, n_rows, spare)
    least = SINGULAR if n_redundant == 0 else WEAK * n_rows
    for k in range(LANES):
        if not work[spare * LANES + k] > least:  # `spare` is the smallest eigenvalue
            work[RUNNING * LANES + k] = 0.0
        share = _largest(work, moved, n, k) / max(_largest(work, weakest, n, k), LEAST)
        for j in range(n):
            work[(weakest + j) * LANES + k] *= share


@compiled
def _compare_with_other_starts(code, settings, control, pattern, moves, work):
    """Clear RUNNING where other guesses, about as far away, do not end where C_q at FOUND predicts."""
    n, n_rows, n_redundant = settings[N], settings[N_ROWS], settings[N_REDUNDANT]
    _, new, _, _, _, _, _, memory = places_of(n, n_rows, settings[N_NUMBERS])
    _, x, change, found, moved, weakest, way, _, there, _, _ = _places(
        n, n_rows, pattern[n_rows] - pattern[0], n_redundant
    )
    x, change, found, moved = memory + x, memory + change, memory + found, memory + moved
    weakest, way, factors = memory + weakest, memory + way, memory + there
    _find_weakest_direction(work, pattern, n, n_rows, n_redundant, factors, x, moved, weakest)
    for own, other in OTHER_GUESSES:
        for j in range(n * LANES):
            off = own * work[moved * LANES + j] + other * work[weakest * LANES + j]
            work[way * LANES + j], work[new * LANES + j] = off, work[found * LANES + j] + off
        _gauss_newton(code, settings, control, pattern, moves, work)
        for i in range(n_rows):
            fill_field(work, x + i, 0.0)
            subtract_row(work, x + i, factors, pattern, i, way)
        # the part of the way that is normal to the constraints
        along_rows(work, pattern, n, n_rows, n_redundant, factors, x, change)
        for k in range(LANES):
            apart, rounding = 0.0, AT_ROUNDING * np.finfo(np.float64).eps * _largest(work, found, n, k)
            for j in range(n):
                m = j * LANES + k
                expected = work[found * LANES + m] + work[way * LANES + m] - work[change * LANES + m]
                apart = max(apart, abs(work[new * LANES + m] - expected))
            if not apart <= MAX_CURVATURE * _largest(work, way, n, k) + rounding:
                work[RUNNING * LANES + k] = 0.0


_START = types.void(CODE, INTEGERS, VECTOR, *[INTEGERS] * 2, *[types.float64[:, ::1]] * 3, INTEGERS, VECTOR)


@kernel(_START, vectorized=True)
def start_lanes(code, settings, control, pattern, moves, numbers, q, v, fine, work):
    """Project states, one for each row of `numbers`, onto the constraints at t0, in place; `fine`: 1 on success.

    pattern : columns of the entries of G, see above. moves : (n,) 1 for coordinates that may move.
    """
    n, n_rows, n_redundant, n_runs = settings[N], settings[N_ROWS], settings[N_REDUNDANT], numbers.shape[0]
    _, new, _, _, _, _, own, memory = places_of(n, n_rows, numbers.shape[1])
    _, _, _, found, moved, _, _, row, _, _, _ = _places(n, n_rows, pattern[n_rows] - pattern[0], n_redundant)
    fill_field(work, AHEAD, control[T0])
    for j in range(n):
        fill_field(work, memory + row + j, 0.0)
    for first in range(0, n_runs, LANES):
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            work[RUNNING * LANES + k] = 1.0
            for j in range(n):
                work[(new + j) * LANES + k], work[(new + n + j) * LANES + k] = q[run, j], v[run, j]
            for i in range(numbers.shape[1]):
                work[(own + i) * LANES + k] = numbers[run, i]
        _gauss_newton(code, settings, control, pattern, moves, work)
        _change_velocities(code, settings, control, pattern, moves, work)
        copy_vectors(work, new, memory + found, n)
        for k in range(LANES):
            run = min(first + k, n_runs - 1)
            for j in range(n):
                work[(memory + moved + j) * LANES + k] = work[(new + j) * LANES + k] - q[run, j]
        _compare_with_other_starts(code, settings, control, pattern, moves, work)
        for k in range(min(LANES, n_runs - first)):
            fine[first + k] = int(work[RUNNING * LANES + k])
            for j in range(n):
                q[first + k, j] = work[(memory + found + j) * LANES + k]
                v[first + k, j] = work[(new + n + j) * LANES + k]


TABLE, STATES = types.float64[:, ::1], types.float64[:, :, ::1]


@compiled
def _relative_residual(value, allowed):
    """Return a residual relative to its allowed size."""
    if not np.isfinite(value):
        return np.inf
    if value == 0.0:
        return 0.0
    return abs(value) / allowed if allowed > 0.0 else np.inf


@kernel(types.void(KIT, INTEGERS, f8, f8, f8, INTEGERS, TABLE, STATES, STATES, TABLE, VECTOR, VECTOR))
def motion_residuals(f, sizes, t, share, atol, runs, parameters, states_q, states_v, ends, room, worst):
    """Compute each run's largest residual of C = 0, C_q v + C_t = 0, C_q a = gamma, M a + C_q^T lam = Q over `share`.

    `share` is relative to the terms of a row; positions and velocities may also be off by `atol`.
    runs : index of the run of each row, -1: the row is left out; parameters : of all runs, (., n_p), stored in p from
    index sizes[2] on; states_q, states_v : (n_rows, n, n_t), of which the last time counts; ends : (n_rows, n + n_c), a
    and lam; room : (n (n + 3) + n_c (n + 3),).
    """
    n, n_c, first = sizes[0], sizes[1], sizes[2]
    M, Q = room[: n * n].reshape((n, n)), room[n * n : n * n + n]
    place = n * n + n
    G = room[place : place + n_c * n].reshape((n_c, n))
    place += n_c * n
    C, rate, gamma = room[place : place + n_c], room[place + n_c : place + 2 * n_c], room[place + 2 * n_c :][:n_c]
    place += 3 * n_c
    q, v, last = room[place : place + n], room[place + n : place + 2 * n], states_q.shape[2] - 1
    gamma_given = f.flags[GAMMA_GIVEN] == 1
    for k in range(runs.size):
        if runs[k] < 0:
            continue
        room[:] = 0.0
        for j in range(parameters.shape[1]):
            f.p[first + j] = parameters[runs[k], j]
        far, fast, largest = 0.0, 0.0, 0.0
        for j in range(n):
            q[j], v[j] = states_q[k, j, last], states_v[k, j, last]
            far, fast = max(far, abs(q[j])), max(fast, abs(v[j]))
        a, lam = ends[k, :n], ends[k, n:]
        f.mass(t, q, f.p, M)
        f.force(t, q, v, f.p, Q)
        f.constraint(t, q, f.p, C)
        f.jacobian(t, q, f.p, G)
        f.constraint_rate(t, q, f.p, rate)
        if gamma_given:
            f.gamma(t, q, v, f.p, gamma)
        for i in range(n_c):
            row, faster, off, terms = 0.0, rate[i], -gamma[i], abs(gamma[i])
            for j in range(n):
                row += abs(G[i, j])
                faster += G[i, j] * v[j]
                off += G[i, j] * a[j]
                terms += abs(G[i, j] * a[j])
            largest = max(largest, _relative_residual(C[i], row * (share * far + atol)))
            largest = max(largest, _relative_residual(faster, row * (share * fast + atol) + share * abs(rate[i])))
            if gamma_given:
                largest = max(largest, _relative_residual(off, share * terms + row * atol))
        size, apart = 0.0, 0.0
        for j in range(n):
            total, largest_term = -Q[j], abs(Q[j])
            for m in range(n):
                term = M[j, m] * a[m]
                total, largest_term = total + term, max(largest_term, abs(term))
            for i in range(n_c):
                term = G[i, j] * lam[i]
                total, largest_term = total + term, max(largest_term, abs(term))
            size = max(size, largest_term)
            apart = max(apart, abs(total)) if np.isfinite(total) else np.inf
        largest = max(largest, _relative_residual(apart, share * size))
        worst[k] = largest


@kernel(types.void(KIT, INTEGERS, f8, f8, TABLE, TABLE, TABLE, VECTOR, VECTOR))
def constraint_residuals(f, sizes, t, slow, parameters, q, v, room, worst):
    """Compute each state's largest |C| and |C_q v + C_t|, relative to the row of |C_q| and the largest entry of q or v.

    slow : smallest speed by which velocities are divided, so that a state at rest has a scale; room : (n_c (n + 2),).
    """
    n, n_c, first = sizes[0], sizes[1], sizes[2]
    C, rate, G = room[:n_c], room[n_c : 2 * n_c], room[2 * n_c :].reshape((n_c, n))
    for k in range(q.shape[0]):
        room[:] = 0.0
        for j in range(parameters.shape[1]):
            f.p[first + j] = parameters[k, j]
        f.constraint(t, q[k], f.p, C)
        f.jacobian(t, q[k], f.p, G)
        f.constraint_rate(t, q[k], f.p, rate)
        far, fast, worst[k] = 0.0, slow, 0.0
        for j in range(n):
            far, fast = max(far, abs(q[k, j])), max(fast, abs(v[k, j]))
        for i in range(n_c):
            row, faster = 0.0, rate[i]
            for j in range(n):
                row += abs(G[i, j])
                faster += G[i, j] * v[k, j]
            worst[k] = max(
                worst[k], _relative_residual(C[i], row * far), _relative_residual(faster, row * fast + abs(rate[i]))
            )

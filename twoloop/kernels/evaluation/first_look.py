"""One look at a start by all callbacks: where nothing is wrong, nothing else needs to look. And rows about it."""

from numba import types

from twoloop.kernels.algebra.linalg import ldl_factor
from twoloop.kernels.algebra.scaling import NO_ENTRY
from twoloop.kernels.data.common import KIT, MATRIX, VECTOR, exact, f8, i8, kernel
from twoloop.kernels.data.finite import finite, finite_vector
from twoloop.kernels.data.flags import (
    CONSTANT_MASS,
    FORCE_BY_Q_GIVEN,
    FORCE_BY_V_GIVEN,
    GAMMA_GIVEN,
    KINEMATICS_GIVEN,
    NONHOLONOMIC_GAMMA_GIVEN,
    REACTION_BY_Q_GIVEN,
)

# flags of what is found: all is finite, M symmetric, no row empty; the state on the rows but for rounding; an M that
# varies definite, or not
IN_ORDER, CONSISTENT, DEFINITE, INDEFINITE = 1, 2, 4, 8
NEAR = 0.5  # of how far the coordinates move until they matter: where these are still of that size
LEFT = 2.0**-52  # of the largest coordinate: one as small is rounding of zero
SURELY = 2.0  # times what counts as no eigenvalue: what rounding does not reach


def room_size(n: int, n_c: int, n_a: int) -> int:
    """How many numbers callbacks fill, beside M and the rows, and scratch."""
    return n + 2 * (n_c + n_a) + n_c * (n + 4) + n * max(n, n_c + n_a + 1)


@exact
def _clear(A):
    for i in range(len(A)):
        for j in range(A.shape[1]):
            A[i, j] = 0.0


@exact
def _empty(rows):
    """Whether there is a row without entries."""
    for i in range(len(rows)):
        largest = 0.0
        for j in range(rows.shape[1]):
            largest = max(largest, abs(rows[i, j]))
        if largest == 0.0:
            return True
    return False


@exact
def _symmetric(mass, allowed):
    """Whether no entry differs from its counterpart by more than this share of the largest."""
    largest, off, same = 0.0, 0.0, True
    for i in range(len(mass)):
        for j in range(i):
            same = same and mass[i, j] == mass[j, i]
    if same:
        return True
    for i in range(len(mass)):
        for j in range(len(mass)):
            largest, off = max(largest, abs(mass[i, j])), max(off, abs(mass[i, j] - mass[j, i]))
    return off <= allowed * largest


@exact
def _largest(state):
    largest = 0.0
    for x in state:
        largest = max(largest, abs(x))
    return largest


@exact
def _rounding(value, row, state, sizes, least, rate, allowed):
    """Whether a value is no more than this share of the terms that it is the sum of, no state being below its size."""
    size = abs(rate)
    for j in range(state.size):
        size += abs(row[j]) * max(abs(state[j]), sizes[j], least)
    return abs(value) <= allowed * size


@exact
def _is_near(q, sizes, place):
    """Whether a position is near another, of which these are the sizes, so that they are its own, too."""
    near = True
    for j in range(q.size):
        near = near and abs(q[j] - place[j]) <= NEAR * sizes[j]
    return near


@exact
def _has(rows, entries):
    """Whether these entries of rows count, and no others: where one vanishes by its position, sizes say little."""
    same, n = True, rows.shape[1]
    for i in range(entries.size // n):
        largest = 0.0
        for j in range(n):
            largest = max(largest, abs(rows[i, j]))
        for j in range(n):
            same = same and (abs(rows[i, j]) > NO_ENTRY * largest) == (entries[i * n + j] != 0.0)
    return same


@exact
def _known(q, rows, n_c, sizes):
    """Where the sizes begin that are known of a position near this one; -1 where there are none."""
    n = q.size
    width = 2 * n + n_c * n
    for k in range(0, sizes.size, width):
        if _is_near(q, sizes[k : k + n], sizes[k + n : k + 2 * n]) and _has(rows, sizes[k + 2 * n : k + width]):
            return k
    return -1


@exact
def _consistent(C, rate, rows, q, v, sizes, allowed):
    """Whether positions and velocities are on the rows but for rounding, of velocities of the fastest coordinate.

    No coordinate counts as less than its size, where that is known, or than what rounding leaves of the largest: of
    coordinates that are zero but for rounding, as in a plane, a constraint is not zero to rounding of its terms.
    """
    fastest, nothing = _largest(v), LEFT * _largest(q)
    begin = _known(q, rows, C.size, sizes)
    known = q if begin < 0 else sizes[begin : begin + q.size]
    for i in range(len(rows)):
        speed = 0.0
        for j in range(q.size):
            speed += rows[i, j] * v[j]
        if not _rounding(speed + rate[i], rows[i], v, v, fastest, rate[i], allowed):
            return False
        if i < C.size and not _rounding(C[i], rows[i], q, known, nothing, 0.0, allowed):
            return False
    return True


@exact
def _note_entries(rows, pattern):
    for i in range(len(rows)):
        for j in range(rows.shape[1]):
            pattern[i, j] = 1.0 if rows[i, j] != 0.0 else pattern[i, j]  # written in any case: so it is vectorised


@exact
def _note_entries_near(f, t, q, ways, place, rows, n_c, pattern):
    """Put 1 where rows have entries at positions that lie so many times the size of q from it."""
    largest = 0.0
    for j in range(q.size):
        largest = max(largest, abs(q[j]))
    for k in range(len(ways)):
        for j in range(q.size):
            place[j] = q[j] + max(abs(q[j]), largest) * ways[k, j]
        _clear(rows)
        f.jacobian(t, place, f.p, rows[:n_c])
        f.nonholonomic(t, place, f.p, rows[n_c:])
        _note_entries(rows, pattern)


@exact
def _definite(mass, least, factors):
    """Whether no eigenvalue is below this share of the largest entry."""
    n, largest = len(mass), 0.0
    for i in range(n):
        for j in range(n):
            factors[i, j] = mass[i, j]
            largest = max(largest, abs(mass[i, j]))
    for i in range(n):
        factors[i, i] -= least * largest
    return ldl_factor(factors)


@kernel(i8(KIT, f8, VECTOR, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, MATRIX, MATRIX, VECTOR), vectorized=True)
def look(f, t, q, v, sizes, lam, room, mass, rows, ways, pattern, least):
    """Flags of what is found at (t, q, v); arrays are full of zeros, but for `lam`, and these.

    `least` are relative: what counts as rounding of a state, as the asymmetry of M, and as an eigenvalue of M. In what
    counts as rounding, no coordinate is less than its size near one of some positions (`keep` of checks/scales.py).
    `ways` say how far from q, over its size, rows are looked at, too. `mass` and `rows` become M, and C_q with A,
    `pattern` 1 where rows have entries; `room`, of `room_size` numbers, begins with the force, C, and C_t with b.
    """
    n, n_c, n_rows, flags = q.size, lam.size, rows.shape[0], f.flags
    force, C, rate, gamma = n, n + n_c, n + n_c + n_rows, n + n_c + 2 * n_rows  # where they end
    f.mass(t, q, f.p, mass)
    f.force(t, q, v, f.p, room[:force])
    f.constraint(t, q, f.p, room[force:C])
    f.jacobian(t, q, f.p, rows[:n_c])
    f.nonholonomic(t, q, f.p, rows[n_c:])
    f.constraint_rate(t, q, f.p, room[C : C + n_c])
    f.nonholonomic_rate(t, q, f.p, room[C + n_c : rate])
    if flags[GAMMA_GIVEN] == 1:
        f.gamma(t, q, v, f.p, room[rate : rate + n_c])
    if flags[NONHOLONOMIC_GAMMA_GIVEN] == 1:
        f.nonholonomic_gamma(t, q, v, f.p, room[rate + n_c : gamma])
    if flags[KINEMATICS_GIVEN] == 1:
        others = room[gamma : gamma + n_c * (n + 3)]
        matrix = others[3 * n_c :].reshape((n_c, n))
        f.kinematics(t, q, v, f.p, others[:n_c], matrix, others[n_c : 2 * n_c], others[2 * n_c : 3 * n_c])
    end = gamma + n_c * (n + 3)
    if not (finite(mass) and finite(rows) and finite_vector(room[:end])):
        return 0
    scratch = room[end : end + n * n].reshape((n, n))
    if flags[FORCE_BY_Q_GIVEN] == 1:
        f.force_by_q(t, q, v, f.p, scratch)
        if not finite(scratch):
            return 0
    if flags[FORCE_BY_V_GIVEN] == 1:
        _clear(scratch)
        f.force_by_v(t, q, v, f.p, scratch)
        if not finite(scratch):
            return 0
    if flags[REACTION_BY_Q_GIVEN] == 1:
        _clear(scratch)
        f.reaction_by_q(t, q, lam, f.p, scratch)
        if not finite(scratch):
            return 0
    found = 0
    if _symmetric(mass, least[1]) and not _empty(rows):
        found = IN_ORDER
        if _consistent(room[force:C], room[C:rate], rows, q, v, sizes, least[0]):
            found |= CONSISTENT
    if flags[CONSTANT_MASS] == 0:  # beyond doubt
        if _definite(mass, SURELY * least[2], scratch):
            found |= DEFINITE
        elif not _definite(mass, least[2] / SURELY, scratch):
            found |= INDEFINITE
    _note_entries(rows, pattern)
    near = room[end : end + n_rows * n].reshape((n_rows, n))
    _note_entries_near(f, t, q, ways, room[end + n_rows * n : end + n_rows * n + n], near, n_c, pattern)
    return found


@kernel(types.void(KIT, f8, MATRIX, i8, MATRIX))
def rows_at(f, t, places, n_c, rows):
    """C_q, of n_c rows, and A at each of these positions, one below the other; `rows` has zeros."""
    n_rows = len(rows) // len(places)
    for k in range(len(places)):
        begin = k * n_rows
        f.jacobian(t, places[k], f.p, rows[begin : begin + n_c])
        f.nonholonomic(t, places[k], f.p, rows[begin + n_c : begin + n_rows])


@exact
def _as_given(fused, given, allowed, more):
    """Whether no number differs by more than this share of the largest, and what a row may more."""
    largest = 0.0
    for i in range(given.shape[0]):
        for j in range(given.shape[1]):
            largest = max(largest, abs(given[i, j]))
    for i in range(given.shape[0]):
        for j in range(given.shape[1]):
            if abs(fused[i, j] - given[i, j]) > allowed * largest + more[i]:
                return False
    return True


@kernel(types.boolean(KIT, f8, VECTOR, VECTOR, MATRIX, MATRIX, VECTOR, f8, f8))
def kinematics_agree(f, t, q, v, fused, given, more, allowed, rounding):
    """Whether the fused callback gives what the separate ones give, but for a share of the largest number of each.

    Constraints may be off by rounding of their terms, too. Arrays are full of zeros: `fused` and `given` have the rows
    C, C_t and gamma, and C_q below, (3 + n_q, n_c); `more` has n_c numbers.
    """
    n, n_c = q.size, more.size
    by_one, by_others = fused[3:].reshape((n_c, n)), given[3:].reshape((n_c, n))
    f.kinematics(t, q, v, f.p, fused[0], by_one, fused[1], fused[2])
    f.constraint(t, q, f.p, given[0])
    f.jacobian(t, q, f.p, by_others)
    f.constraint_rate(t, q, f.p, given[1])
    f.gamma(t, q, v, f.p, given[2])
    agree = _as_given(by_one, by_others, allowed, more)
    for k in range(1, 3):
        agree = agree and _as_given(
            fused[k : k + 1].reshape((n_c, 1)), given[k : k + 1].reshape((n_c, 1)), allowed, more
        )
    for i in range(n_c):
        for j in range(n):
            more[i] += rounding * abs(by_others[i, j]) * abs(q[j])
    return agree and _as_given(fused[:1].reshape((n_c, 1)), given[:1].reshape((n_c, 1)), allowed, more)

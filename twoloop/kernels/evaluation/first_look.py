"""One look at a start by all callbacks: where nothing is wrong, nothing else needs to look. And rows about it."""

from numba import types

from twoloop.kernels.data.common import (
    FORCE_BY_Q_GIVEN,
    FORCE_BY_V_GIVEN,
    GAMMA_GIVEN,
    KINEMATICS_GIVEN,
    KIT,
    MATRIX,
    NONHOLONOMIC_GAMMA_GIVEN,
    REACTION_BY_Q_GIVEN,
    VECTOR,
    exact,
    f8,
    i8,
    kernel,
)
from twoloop.kernels.data.finite import finite, finite_vector

# what is found: nothing wrong; a state that is off by more than rounding; something else
IN_ORDER, INEXACT, ODD = range(3)


def room_size(n: int, n_c: int, n_a: int) -> int:
    """How many numbers callbacks fill, beside M and the rows."""
    return n + 2 * (n_c + n_a) + n_c * (n + 4) + 3 * n * n


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
    largest, off = 0.0, 0.0
    for i in range(len(mass)):
        for j in range(len(mass)):
            largest, off = max(largest, abs(mass[i, j])), max(off, abs(mass[i, j] - mass[j, i]))
    return off <= allowed * largest


@exact
def _rounding(value, row, state, rate, allowed):
    """Whether a value is no more than this share of the terms that it is the sum of."""
    size = abs(rate)
    for j in range(state.size):
        size += abs(row[j]) * abs(state[j])
    return abs(value) <= allowed * size


@exact
def _consistent(C, rate, rows, q, v, allowed):
    """Whether positions and velocities are on the rows but for rounding."""
    for i in range(len(rows)):
        speed = 0.0
        for j in range(q.size):
            speed += rows[i, j] * v[j]
        if not _rounding(speed + rate[i], rows[i], v, rate[i], allowed):
            return False
        if i < C.size and not _rounding(C[i], rows[i], q, 0.0, allowed):
            return False
    return True


@kernel(i8(KIT, f8, VECTOR, VECTOR, VECTOR, VECTOR, MATRIX, MATRIX, f8, f8))
def look(f, t, q, v, lam, room, mass, rows, rounding, unsymmetric):
    """IN_ORDER if all is finite at (t, q, v), M symmetric, and the state on the rows of C_q and A but for rounding.

    Arrays are full of zeros. `mass` and `rows` become M, and C_q with A; `room`, of `room_size` numbers, begins with
    the force, C, and C_t with b.
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
    tangents = room[gamma + n_c * (n + 3) :]
    if flags[FORCE_BY_Q_GIVEN] == 1:
        f.force_by_q(t, q, v, f.p, tangents[: n * n].reshape((n, n)))
    if flags[FORCE_BY_V_GIVEN] == 1:
        f.force_by_v(t, q, v, f.p, tangents[n * n : 2 * n * n].reshape((n, n)))
    if flags[REACTION_BY_Q_GIVEN] == 1:
        f.reaction_by_q(t, q, lam, f.p, tangents[2 * n * n : 3 * n * n].reshape((n, n)))
    if not (finite(mass) and finite(rows) and finite_vector(room)):
        return ODD
    if not _symmetric(mass, unsymmetric) or _empty(rows):
        return ODD
    return IN_ORDER if _consistent(room[force:C], room[C:rate], rows, q, v, rounding) else INEXACT


@kernel(types.void(KIT, f8, MATRIX, i8, MATRIX))
def rows_at(f, t, places, n_c, rows):
    """C_q, of n_c rows, and A at each of these positions, one below the other; `rows` has zeros."""
    n_rows = len(rows) // len(places)
    for k in range(len(places)):
        begin = k * n_rows
        f.jacobian(t, places[k], f.p, rows[begin : begin + n_c])
        f.nonholonomic(t, places[k], f.p, rows[begin + n_c : begin + n_rows])

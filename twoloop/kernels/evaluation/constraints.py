"""Rows of the constraints on velocities: C_q of C(t, q) = 0, then A of A(t, q) v + b(t, q) = 0."""

from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.flags import AUGMENTED, CONSTRAINT_RATE_GIVEN, FORM, NONHOLONOMIC_RATE_GIVEN
from twoloop.kernels.evaluation.program import jacobian_by_program


@merged
def constraint_rows(f, w, t, q, G):
    """C_q and A at (t, q) into G, which is w.G or w.Gx, full of zeros."""
    n_c, n_rows = w.C.size, w.Rate.size
    if n_c > 0 and not jacobian_by_program(f, w, t, q, G):
        f.jacobian(t, q, f.p, G[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, G[n_c:n_rows])


@compiled
def _clear_places(w):
    for i in range(w.Rate.size):
        for k in range(w.places[i], w.places[i + 1]):
            w.G[i, w.places[k]] = 0.0


@merged
def clear_rows(f, w):
    """Make w.G full of zeros.

    Where it is large, at the places of its entries alone. One at another place is found at the end of a step.
    """
    if f.flags[FORM] == AUGMENTED:
        _clear_places(w)
    else:
        w.entries[:] = 0.0


@merged
def row_residual(w, v, rows):
    """G v + (C_t, b) of these rows, into w.z."""
    for k in range(rows.size):
        row = rows[k]
        total = w.Rate[row]
        for p in range(w.places[row], w.places[row + 1]):
            total += w.G[row, w.places[p]] * v[w.places[p]]
        w.z[k] = total


@merged
def constraint_rates(f, w, t, q, rate):
    """C_t and b at (t, q)."""
    n_c, n_rows = w.C.size, w.Rate.size
    rate[:] = 0.0
    if f.flags[CONSTRAINT_RATE_GIVEN] == 1:
        f.constraint_rate(t, q, f.p, rate[:n_c])
    if n_rows > n_c and f.flags[NONHOLONOMIC_RATE_GIVEN] == 1:
        f.nonholonomic_rate(t, q, f.p, rate[n_c:])


@merged
def kinematics(f, w, t, q, v):
    """C, C_q and A, C_t and b, and Gamma of the rows of C at (t, q, v), by the fused callback."""
    n_c, n_rows = w.C.size, w.Rate.size
    clear_rows(f, w)
    w.C[:] = 0.0
    w.Rate[:] = 0.0
    w.Gamma[:] = 0.0
    f.kinematics(t, q, v, f.p, w.C, w.G[:n_c], w.Rate[:n_c], w.Gamma[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, w.G[n_c:n_rows])
        if f.flags[NONHOLONOMIC_RATE_GIVEN] == 1:
            f.nonholonomic_rate(t, q, f.p, w.Rate[n_c:])


@merged
def gather_independent_columns(G, rate, rows, independent, D):
    """Right-hand sides for the rows of w.D."""
    for j in range(independent.size):
        column = independent[j]
        for k in range(rows.size):
            D[j, k] = -G[rows[k], column]
    for k in range(rows.size):
        D[independent.size, k] = -rate[rows[k]]

"""Rows of the constraints on velocities: C_q of C(t, q) = 0, then A of A(t, q) v + b(t, q) = 0."""

from twoloop.kernels.common import CONSTRAINT_RATE_GIVEN, NONHOLONOMIC_RATE_GIVEN, compiled, merged


@merged
def constraint_rows(f, w, t, q, G):
    """C_q and A at (t, q) into G, which is w.G or w.Gx, full of zeros."""
    n_c, n_rows = w.C.size, w.Rate.size
    if n_c > 0:
        f.jacobian(t, q, f.p, G[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, G[n_c:n_rows])


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
    w.entries[:] = 0.0
    w.C[:] = 0.0
    w.Rate[:] = 0.0
    w.Gamma[:] = 0.0
    f.kinematics(t, q, v, f.p, w.C, w.G[:n_c], w.Rate[:n_c], w.Gamma[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, w.G[n_c:n_rows])
        if f.flags[NONHOLONOMIC_RATE_GIVEN] == 1:
            f.nonholonomic_rate(t, q, f.p, w.Rate[n_c:])


@compiled
def gather_independent_columns(G, rate, rows, independent, D):
    """Right-hand sides for the rows of w.D."""
    for j in range(independent.size):
        column = independent[j]
        for k in range(rows.size):
            D[j, k] = -G[rows[k], column]
    for k in range(rows.size):
        D[independent.size, k] = -rate[rows[k]]

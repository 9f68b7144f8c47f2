"""The inner loop: dependent positions by Newton, dependent velocities by a linear solve, then accelerations.

Equation numbers are those of Zhang & Zhang (2016), doi 10.1007/s11071-016-2682-8.
"""

import numpy as np

from twoloop.kernels.common import (
    CONSTANT_MASS,
    DIAGONAL_MASS,
    DONE,
    GAMMA_GIVEN,
    INNER_DIVERGED,
    MASS_NOT_DEFINITE,
    N_EVALUATIONS,
    N_FACTORIZATIONS,
    N_INNER,
    NOT_FINITE,
    SINGULAR,
    inlined,
)
from twoloop.kernels.linalg import back_substitute, cholesky, forward_substitute, lu_factor, lu_solve
from twoloop.kernels.partition import RANK_TOLERANCE

MAX_INNER = 25  # Newton iterations; quadratic convergence needs 2 to 5
DIFFERENCE = 2e-4  # displacement over which Q_d is differenced, see gamma_by_differences


@inlined
def factor_dependent(f, w, t, q):
    """C_q at (t, q), and the LU factors of its dependent columns."""
    w.Cq[:, :] = 0.0
    f.jacobian(t, q, f.p, w.Cq)
    n_c = w.C.size
    for i in range(n_c):
        for k in range(n_c):
            w.Cqd[i, k] = w.Cq[i, w.dependent[k]]
    w.quality[1] = lu_factor(w.Cqd, w.pivots)
    w.counters[N_FACTORIZATIONS] += 1
    if not w.quality[1] > RANK_TOLERANCE:
        for i in range(n_c):
            for j in range(w.Q.size):
                if not np.isfinite(w.Cq[i, j]):
                    return NOT_FINITE
        return SINGULAR
    return DONE


@inlined
def positions(f, w, t, q, tolerance):
    """Eq. (15): Newton on the dependent positions of q, update first, then test the correction."""
    for _ in range(MAX_INNER):
        code = factor_dependent(f, w, t, q)
        if code != DONE:
            return code
        w.C[:] = 0.0
        f.constraint(t, q, f.p, w.C)
        lu_solve(w.Cqd, w.pivots, w.C)
        w.counters[N_INNER] += 1
        correction = 0.0
        for k in range(w.C.size):
            q[w.dependent[k]] -= w.C[k]
            correction = max(correction, abs(w.C[k]))
            if not np.isfinite(w.C[k]):
                return NOT_FINITE
        if correction <= tolerance:
            return DONE
    return INNER_DIVERGED


@inlined
def velocities(f, w, t, q, v):
    """Eq. (14): the dependent velocities of v, C_qd v_d = -C_t - C_qi v_i; leaves C_q at q in w.Cq."""
    code = factor_dependent(f, w, t, q)
    if code != DONE:
        return code
    w.Ct[:] = 0.0
    f.constraint_rate(t, q, f.p, w.Ct)
    for i in range(w.Ct.size):
        total = -w.Ct[i]
        for k in range(w.independent.size):
            j = w.independent[k]
            total -= w.Cq[i, j] * v[j]
        w.g[i] = total
    lu_solve(w.Cqd, w.pivots, w.g)
    for k in range(w.g.size):
        v[w.dependent[k]] = w.g[k]
    return DONE


@inlined
def _velocity_constraint(f, w, t, q, v, g):
    """g = C_q(t, q) v + C_t(t, q) at a displaced point."""
    w.Cqx[:, :] = 0.0
    f.jacobian(t, q, f.p, w.Cqx)
    g[:] = 0.0
    f.constraint_rate(t, q, f.p, g)
    for i in range(g.size):
        total = g[i]
        for j in range(v.size):
            total += w.Cqx[i, j] * v[j]
        g[i] = total


@inlined
def gamma_by_differences(f, w, t, q, v):
    """Q_d = -d/de [C_q v + C_t](t + e, q + e v) at e = 0, central differences of order 4."""
    speed = 1.0
    for j in range(v.size):
        speed = max(speed, abs(v[j]))
    step = DIFFERENCE / speed
    w.Qd[:] = 0.0
    for k in range(4):
        shift = (-2.0, -1.0, 1.0, 2.0)[k] * step
        weight = (-1.0, 8.0, -8.0, 1.0)[k] / (12.0 * step)
        for j in range(q.size):
            w.x[j] = q[j] + shift * v[j]
        _velocity_constraint(f, w, t + shift, w.x, v, w.g)
        for i in range(w.g.size):
            w.Qd[i] += weight * w.g[i]


@inlined
def factor_mass(f, w, t, q):
    """M(t, q) and its Cholesky factor; for a constant diagonal M the inverse roots."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)
    n = w.Q.size
    w.L[:, :] = w.M
    if f.flags[DIAGONAL_MASS] == 1:
        for j in range(n):
            if not w.M[j, j] > 0.0:
                return MASS_NOT_DEFINITE
            w.L[j, j] = 1.0 / np.sqrt(w.M[j, j])
        return DONE
    return DONE if cholesky(w.L) else MASS_NOT_DEFINITE


@inlined
def accelerations(f, w, t, q, v, a, lam):
    """Eqs. (6)-(8) with M = L L^T, W = (L^-1 C_q^T)^T, S = W W^T; needs C_q(t, q) in w.Cq."""
    n_c, n_q = w.Cq.shape
    w.counters[N_EVALUATIONS] += 1
    if f.flags[CONSTANT_MASS] == 0:
        code = factor_mass(f, w, t, q)
        if code != DONE:
            return code
    if f.flags[GAMMA_GIVEN] == 1:
        w.Qd[:] = 0.0
        f.gamma(t, q, v, f.p, w.Qd)
    else:
        gamma_by_differences(f, w, t, q, v)
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    diagonal = f.flags[DIAGONAL_MASS] == 1
    for j in range(n_q):
        w.x[j] = w.Q[j]
    if diagonal:
        for j in range(n_q):
            w.x[j] *= w.L[j, j]
        for i in range(n_c):
            for j in range(n_q):
                w.W[i, j] = w.Cq[i, j] * w.L[j, j]
    else:
        forward_substitute(w.L, w.x)
        for i in range(n_c):
            for j in range(n_q):
                w.W[i, j] = w.Cq[i, j]
            forward_substitute(w.L, w.W[i])
    for i in range(n_c):
        total = -w.Qd[i]
        for j in range(n_q):
            total += w.W[i, j] * w.x[j]
        lam[i] = total
        for k in range(i + 1):
            total = 0.0
            for j in range(n_q):
                total += w.W[i, j] * w.W[k, j]
            w.S[i, k] = total
    w.counters[N_FACTORIZATIONS] += 1
    if not cholesky(w.S):
        for i in range(n_c):
            if not np.isfinite(w.S[i, i]):
                return NOT_FINITE
        return SINGULAR
    forward_substitute(w.S, lam)
    back_substitute(w.S, lam)
    for i in range(n_c):
        for j in range(n_q):
            w.x[j] -= w.W[i, j] * lam[i]
    if diagonal:
        for j in range(n_q):
            w.x[j] *= w.L[j, j]
    else:
        back_substitute(w.L, w.x)
    for j in range(n_q):
        a[j] = w.x[j]
        if not np.isfinite(a[j]):
            return NOT_FINITE
    return DONE


@inlined
def evaluate(f, w, t, q, v, tolerance, a, lam):
    """One evaluation of the right side: dependents of q and v from their independents, then a and lam."""
    code = positions(f, w, t, q, tolerance)
    if code == DONE:
        code = velocities(f, w, t, q, v)
    if code == DONE:
        code = accelerations(f, w, t, q, v, a, lam)
    return code

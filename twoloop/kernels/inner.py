"""The inner loop: dependent positions by Newton, dependent velocities by a linear solve, then accelerations.

Equation numbers are those of Zhang & Zhang (2016), doi 10.1007/s11071-016-2682-8.
"""

import numpy as np

from twoloop.kernels.banded import banded_mass, factor_banded_mass, inverse_mass_border, solve_banded_mass
from twoloop.kernels.common import (
    CONSTANT_MASS,
    DIAGONAL_MASS,
    DONE,
    FAULT_KIND,
    FAULT_TIME,
    GAMMA_GIVEN,
    GAMMA_SCALE,
    INNER_DIVERGED,
    MASS_NOT_DEFINITE,
    N_EVALUATIONS,
    N_FACTORIZATIONS,
    N_INNER,
    NOT_FINITE,
    SINGULAR,
    Functions,
    compiled,
    inlined,
)
from twoloop.kernels.differences import gamma_by_differences
from twoloop.kernels.linalg import copy, invert_definite, ldl_factor, ldl_solve, lu_factor, lu_solve
from twoloop.kernels.partition import RANK_TOLERANCE

MAX_INNER = 25  # Newton iterations; quadratic convergence needs 2 to 5
CONTRACTION = 0.5  # each correction must be at most this times the one before
ROUNDING = 1e-12  # relative to the largest value: changes of this size no longer shrink
ROUNDING_OF_Q = 2e-14  # a hundred roundings, see rounding_floor

_MASS, _FORCE, _CONSTRAINT, _JACOBIAN, _RATE, _GAMMA = (
    Functions._fields.index(kind) for kind in ("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma")
)


@compiled
def _finite(A):
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            if not np.isfinite(A[i, j]):
                return False
    return True


@inlined
def _equal(A, B):
    for i in range(A.shape[0]):
        for j in range(A.shape[1]):
            if A[i, j] != B[i, j]:  # also true for NaN
                return False
    return True


@compiled
def _not_finite(notes, kind, t, q):
    """Note which callback gave a value that is not finite, for the message; none where q itself is not finite."""
    notes[FAULT_KIND] = kind if _finite_vector(q) else -1.0
    notes[FAULT_TIME] = t
    return NOT_FINITE


@compiled
def _finite_vector(x):
    finite = True
    for j in range(x.size):
        finite = finite and np.isfinite(x[j])
    return finite


@compiled
def _which_acceleration(Ct, Qd, Q):
    """Place in Functions of the callback that gave a value that is not finite; -1: none of these three."""
    if not _finite_vector(Ct):
        return _RATE
    if not _finite_vector(Qd):
        return _GAMMA
    return _FORCE if not _finite_vector(Q) else -1


@inlined
def factor_dependent(f, w, t, q):
    """C_q at (t, q), and the LU factors of its dependent columns."""
    w.Cq[:, :] = 0.0
    f.jacobian(t, q, f.p, w.Cq)
    n_c = w.C.size
    for i in range(n_c):
        for k in range(n_c):
            w.Cqd[i, k] = w.Cq[i, w.dependent[k]]
    ratio = lu_factor(w.Cqd, w.pivots)
    w.counters[N_FACTORIZATIONS] += 1
    if not ratio > RANK_TOLERANCE:
        return SINGULAR if _finite(w.Cq) else _not_finite(w.notes, _JACOBIAN, t, q)
    return DONE


@inlined
def _positions(f, w, t, q, tolerance):
    """Eq. (15): Newton on the dependent positions of q, update first, then test the correction."""
    before = np.inf
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
            if not np.isfinite(w.C[k]):
                return _not_finite(w.notes, _CONSTRAINT, t, q)
            q[w.dependent[k]] -= w.C[k]
            correction = max(correction, abs(w.C[k]))
        if correction <= tolerance:
            return DONE
        if correction > CONTRACTION * before:
            # at large coordinates rounding may stand above the tolerance; else this is no longer Newton's region,
            # and to go on could end on another assembly of the mechanism
            largest = 0.0
            for j in range(q.size):
                largest = max(largest, abs(q[j]))
            return DONE if correction <= ROUNDING * largest else INNER_DIVERGED
        before = correction
    return INNER_DIVERGED


@inlined
def _velocities(f, w, t, q, v):
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
def rounding_floor(q):
    """Relative change below which a fixed-point iteration that stops shrinking has converged: q is rounded."""
    size = 0.0
    for j in range(q.size):
        size = max(size, abs(q[j]))
    return max(ROUNDING, ROUNDING_OF_Q * size)


@inlined
def acceleration_constraint(f, w, t, q, v):
    """The right-hand side Q_d of C_q a = Q_d, into w.Qd; DONE, or why it cannot be had."""
    code = DONE
    if f.flags[GAMMA_GIVEN] == 1:
        w.Qd[:] = 0.0
        f.gamma(t, q, v, f.p, w.Qd)
    else:
        code = gamma_by_differences(f, w, t, q, v)
    return code


@inlined
def factor_mass(f, w, t, q):
    """M(t, q), and of a constant M its inverse, which is quicker to apply; else its factors."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)
    if banded_mass(f):
        code = factor_banded_mass(f, w)
    else:
        for i in range(w.Q.size):
            copy(w.M[i], w.L[i])
        definite = invert_definite(w.L) if f.flags[CONSTANT_MASS] == 1 else ldl_factor(w.L)
        code = DONE if definite else MASS_NOT_DEFINITE
    if code == DONE:
        return DONE
    return MASS_NOT_DEFINITE if _finite(w.M) else _not_finite(w.notes, _MASS, t, q)


@inlined
def _times_inverse_mass(f, w, x, y):
    """y = M^-1 x; they may be one array unless M is constant, dense and not diagonal."""
    n = x.size
    if f.flags[DIAGONAL_MASS] == 1:
        for i in range(n):
            y[i] = x[i] * w.L[i, i]
    elif f.flags[CONSTANT_MASS] == 1 and not banded_mass(f):
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += w.L[i, j] * x[j]
            y[i] = total
    else:
        copy(x, y)
        if banded_mass(f):
            solve_banded_mass(f, w, y)
        else:
            ldl_solve(w.L, y)


@inlined
def _schur_complement(f, w):
    """Upper triangle of S = C_q M^-1 C_q^T into w.S."""
    n_c, n_q = w.Cq.shape
    w.S[:, :] = 0.0
    if f.flags[DIAGONAL_MASS] == 1:
        for j in range(n_q):
            for i in range(n_c):
                w.W[j, i] = w.Cq[i, j]
        for j in range(n_q):
            for i in range(n_c):
                if w.W[j, i] != 0.0:
                    factor = w.W[j, i] * w.L[j, j]
                    for k in range(i, n_c):
                        w.S[i, k] += factor * w.W[j, k]
        return
    solved = inverse_mass_border(w)
    for i in range(n_c):
        _times_inverse_mass(f, w, w.Cq[i], solved[i])
    for i in range(n_c):
        for k in range(i, n_c):
            total = 0.0
            for j in range(n_q):
                total += w.Cq[i, j] * solved[k, j]
            w.S[i, k] = total


@inlined
def _factor_schur_complement(f, w):
    """S and its factors; with a constant M only if C_q has changed, as that of linear constraints never does."""
    keep = f.flags[CONSTANT_MASS] == 1 and f.flags[DIAGONAL_MASS] == 0
    if keep:
        if _equal(w.Cq, w.Cq_of_S):
            return DONE
        w.Cq_of_S[0, 0] = np.nan
    _schur_complement(f, w)
    w.counters[N_FACTORIZATIONS] += 1
    if not ldl_factor(w.S):
        return SINGULAR if _finite(w.S) else NOT_FINITE
    if keep:
        for i in range(w.C.size):
            copy(w.Cq[i], w.Cq_of_S[i])
    return DONE


@inlined
def _accelerations(f, w, t, q, v, a, lam):
    """Eqs. (6)-(8); needs C_q(t, q) in w.Cq."""
    n_c, n_q = w.Cq.shape
    w.counters[N_EVALUATIONS] += 1
    if f.flags[CONSTANT_MASS] == 0:
        w.counters[N_FACTORIZATIONS] += 1
        code = factor_mass(f, w, t, q)
        if code != DONE:
            return code
    code = acceleration_constraint(f, w, t, q, v)
    if code != DONE:
        return code
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    code = _factor_schur_complement(f, w)
    if code != DONE:
        return code
    _times_inverse_mass(f, w, w.Q, w.x)
    for i in range(n_c):
        total = -w.Qd[i]
        for j in range(n_q):
            total += w.Cq[i, j] * w.x[j]
        lam[i] = total
    ldl_solve(w.S, lam)  # (7)
    if f.flags[DIAGONAL_MASS] == 0:
        # (8) with M^-1 Q and M^-1 Cq^T as they stand
        copy(w.x, a)
        solved = inverse_mass_border(w)
        for i in range(n_c):
            for j in range(n_q):
                a[j] -= solved[i, j] * lam[i]
    else:
        copy(w.Q, a)
        for i in range(n_c):
            for j in range(n_q):
                a[j] -= w.Cq[i, j] * lam[i]
        _times_inverse_mass(f, w, a, a)  # (8)
    for j in range(n_q):
        if not np.isfinite(a[j]):
            return _not_finite(w.notes, _which_acceleration(w.Ct, w.Qd, w.Q), t, q)
    if f.flags[GAMMA_GIVEN] == 0:
        for i in range(n_c):
            total = 0.0
            for j in range(n_q):
                total += abs(w.Cq[i, j] * a[j])
            w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], total)
    return DONE


@compiled
def evaluate(f, w, t, q, v, tolerance, a, lam):
    """One evaluation of the right-hand side: dependents of q and v from their independents, then a and lam."""
    code = _positions(f, w, t, q, tolerance)
    if code == DONE:
        code = _velocities(f, w, t, q, v)
    if code == DONE:
        code = _accelerations(f, w, t, q, v, a, lam)
    return code


@compiled
def dependent_positions(f, w, t, q, tolerance):
    """Dependents of q from its independents."""
    return _positions(f, w, t, q, tolerance)


@compiled
def restore(f, w, t, q, v, tolerance):
    """Dependents of q and v from their independents; leaves C_q at q for `accelerations`."""
    code = _positions(f, w, t, q, tolerance)
    if code == DONE:
        code = _velocities(f, w, t, q, v)
    return code


@compiled
def accelerations(f, w, t, q, v, a, lam):
    """Eqs. (6)-(8) at a state that was restored just before."""
    return _accelerations(f, w, t, q, v, a, lam)

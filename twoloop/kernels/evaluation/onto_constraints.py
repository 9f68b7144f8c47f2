"""One pass over a state of all coordinates: its accelerations, and the way back to the constraints.

Where a step integrates all coordinates, a state is off the constraints by the error of the formula. The pass finds the
accelerations there and moves positions and velocities to the nearest that the constraints allow, nearest in the metric
of M, which does not depend on the partition. Positions are then good to the square of their correction, velocities and
accelerations to the correction itself: one that is not near rounding is followed by another pass.
"""

import numpy as np

from twoloop.kernels.algebra.factors import columns_of, rows_of, solve
from twoloop.kernels.algebra.linalg import ldl_solve
from twoloop.kernels.data.common import (
    AUGMENTED,
    DIAGONAL_MASS,
    DONE,
    FORM,
    INNER_DIVERGED,
    KINEMATICS_GIVEN,
    KNOWN,
    N_INNER,
    NULL_SPACE,
    PIVOT,
    ROUNDED,
    merged,
)
from twoloop.kernels.evaluation.accelerations import accelerate, equilibrate, factor_for_projection
from twoloop.kernels.evaluation.augmented import correct_augmented
from twoloop.kernels.evaluation.constraints import constraint_rates, kinematics
from twoloop.kernels.evaluation.finite import CONSTRAINT, not_finite
from twoloop.kernels.evaluation.inner import CONTRACTION, MAX_INNER, ROUNDING, factor_dependent, factor_rows, tangents

ABOVE_ROUNDING = 10.0  # of positions: no correction is asked to be smaller


@merged
def _look(f, w, t, q, v):
    """Rows, factors and tangents at (q, v), which need not be on the constraints."""
    if f.flags[KINEMATICS_GIVEN] == 1:
        kinematics(f, w, t, q, v)
        w.notes[KNOWN] = 1.0
        code = factor_rows(w, t, q)
    else:
        code = factor_dependent(f, w, t, q)
    if code == DONE and f.flags[FORM] == NULL_SPACE:
        tangents(f, w, t, q)
    return code


@merged
def accelerate_there(f, w, t, q, v, a):
    """Accelerations at (q, v)."""
    code = _look(f, w, t, q, v)
    return accelerate(f, w, t, q, v, a) if code == DONE else code


@merged
def _nearest(f, w, columns):
    """x with (T^T M T) x = T^T M y, over the independents of y in the first places of w.x; w.z has y's dependents."""
    independent, x, y = w.independent_v, w.x, w.y
    n_dof = independent.size
    if f.flags[DIAGONAL_MASS] == 1:
        for k in range(columns.size):
            y[k] = w.M[columns[k], columns[k]] * w.z[k]
        for j in range(n_dof):
            total = w.M[independent[j], independent[j]] * x[j]
            for k in range(columns.size):
                total += w.D[j, k] * y[k]
            x[j] = total
    else:
        for i in range(y.size):
            total = 0.0
            for j in range(n_dof):
                total += w.M[i, independent[j]] * x[j]
            for k in range(columns.size):
                total += w.M[i, columns[k]] * w.z[k]
            y[i] = total
        for j in range(n_dof):
            total = y[independent[j]]
            for k in range(columns.size):
                total += w.D[j, k] * y[columns[k]]
            x[j] = total
    ldl_solve(w.A, x[:n_dof])


@merged
def _to_constraints(f, w, q, v):
    """Correct q and v by T and the factors of T^T M T; the largest correction of a position, and of a velocity."""
    rows, columns, independent = rows_of(w.index_v), columns_of(w.index_v), w.independent_v
    n_dof, x = independent.size, w.x
    for k in range(rows.size):
        w.z[k] = w.C[rows[k]]
    solve(w.index_v, w.values_v, w.z)
    for k in range(rows.size):
        if not np.isfinite(w.z[k]):
            return np.inf, np.inf
    for j in range(n_dof):
        x[j] = 0.0
    _nearest(f, w, columns)
    largest = 0.0
    for j in range(n_dof):
        q[independent[j]] += x[j]
        largest = max(largest, abs(x[j]))
    for k in range(rows.size):
        change = -w.z[k]
        for j in range(n_dof):
            change += w.D[j, k] * x[j]
        q[columns[k]] += change
        largest = max(largest, abs(change))
    for j in range(n_dof):
        x[j] = v[independent[j]]
    for k in range(rows.size):
        w.z[k] = v[columns[k]] - w.D[n_dof, k]
    _nearest(f, w, columns)
    faster = 0.0
    for j in range(n_dof):
        faster = max(faster, abs(v[independent[j]] - x[j]))
        v[independent[j]] = x[j]
    for k in range(rows.size):
        total = w.D[n_dof, k]
        for j in range(n_dof):
            total += w.D[j, k] * x[j]
        faster = max(faster, abs(v[columns[k]] - total))
        v[columns[k]] = total
    return largest, faster


@merged
def _by_multipliers(w, q, v):
    """The same by the factors of G M^-1 G^T."""
    rows, solved, g = w.rows_v, w.W, w.g[: w.rows_v.size]
    for i in range(rows.size):
        g[i] = w.C[rows[i]]
    ldl_solve(w.S, g)
    largest, faster = 0.0, 0.0
    for i in range(rows.size):
        if not np.isfinite(g[i]):
            return np.inf, np.inf
    for j in range(q.size):
        change = 0.0
        for i in range(rows.size):
            change += solved[i, j] * g[i]
        q[j] -= change
        largest = max(largest, abs(change))
    for i in range(rows.size):
        total = w.Rate[rows[i]]
        for j in range(v.size):
            total += w.G[rows[i], j] * v[j]
        g[i] = total
    ldl_solve(w.S, g)
    for j in range(v.size):
        change = 0.0
        for i in range(rows.size):
            change += solved[i, j] * g[i]
        v[j] -= change
        faster = max(faster, abs(change))
    return largest, faster


@merged
def _largest(x):
    largest = 0.0
    for j in range(x.size):
        largest = max(largest, abs(x[j]))
    return largest


@merged
def to_constraints(f, w, t, q, v, theta, a, lam):
    """(q, v) put on the constraints, then accelerations and multipliers there; without rows of A only.

    Positions are corrected until a correction is at most theta, velocities alike, relative to the largest. Where it is
    at most theta times the smallest pivot, by whose inverse tangents turn, velocities are right after the same pass.
    """
    before = np.inf
    theta = max(theta, ABOVE_ROUNDING * w.notes[ROUNDED])
    for _ in range(MAX_INNER):
        code = _look(f, w, t, q, v)
        if code == DONE:
            code = factor_for_projection(f, w, t, q)
        if code != DONE:
            return code
        if f.flags[KINEMATICS_GIVEN] == 0:
            w.C[:] = 0.0
            f.constraint(t, q, f.p, w.C)
        w.counters[N_INNER] += 1
        if f.flags[FORM] == NULL_SPACE:
            moved, faster = _to_constraints(f, w, q, v)
        else:
            if f.flags[KINEMATICS_GIVEN] == 0:
                constraint_rates(f, w, t, q, w.Rate)
            if f.flags[FORM] == AUGMENTED:
                moved, faster = correct_augmented(w, q, v)
            else:
                moved, faster = _by_multipliers(w, q, v)
        if not np.isfinite(moved):
            return not_finite(w.notes, CONSTRAINT, t, q)
        if moved <= theta and faster <= theta * max(1.0, _largest(v)):
            break
        if moved <= w.notes[PIVOT] * theta:
            w.notes[KNOWN] = 0.0  # the tangents are those of the end, but Gamma belongs to the velocities before
            break
        if moved > CONTRACTION * before:
            if not moved <= ROUNDING * _largest(q):
                return INNER_DIVERGED
            break
        before = max(moved, theta)
    code = accelerate(f, w, t, q, v, a)
    if code == DONE:
        equilibrate(f, w, a, lam)
    return code

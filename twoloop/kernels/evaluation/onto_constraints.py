"""One pass over a state of all coordinates: its accelerations, and the way back to the constraints.

Where a step integrates all coordinates, a state is off the constraints by the error of the formula. The pass finds the
accelerations there and moves positions and velocities to the nearest that the constraints allow, nearest in the metric
of M, which does not depend on the partition. Positions are then good to the square of their correction, velocities and
accelerations to the correction itself: one that is not near rounding is followed by another pass.
"""

import numpy as np

from twoloop.kernels.algebra.linalg import largest_of
from twoloop.kernels.algebra.saddle_point import solve
from twoloop.kernels.data.codes import DONE, INNER_DIVERGED
from twoloop.kernels.data.common import merged
from twoloop.kernels.data.counters import N_INNER
from twoloop.kernels.data.finite import CONSTRAINT, not_finite
from twoloop.kernels.data.flags import FORM, KINEMATICS_GIVEN, NULL_SPACE
from twoloop.kernels.data.noted import KNOWN, PIVOT, ROUNDED
from twoloop.kernels.evaluation.accelerations import accelerate, equilibrate, factor_there
from twoloop.kernels.evaluation.constraints import constraint_rates, kinematics, row_residual
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
def _move(f, w, x):
    """Move x by the least correction in the metric of M that takes -w.g away from G x; the largest entry of it."""
    w.Q[:] = 0.0
    solve(f, w, w.Q, w.g, w.y)
    largest = 0.0
    for j in range(x.size):
        if not np.isfinite(w.y[j]):
            return np.inf
        x[j] += w.y[j]
        largest = max(largest, abs(w.y[j]))
    return largest


@merged
def _move_both(f, w, q, v):
    """Correct q and v by the factors at q; the largest correction of a position, and of a velocity."""
    rows, n_c = w.rows_v, w.C.size
    for i in range(rows.size):
        w.g[rows[i]] = -w.C[rows[i]] if rows[i] < n_c else 0.0
    moved = _move(f, w, q)
    row_residual(w, v, rows)
    for i in range(rows.size):
        w.g[rows[i]] = -w.z[i]
    return moved, _move(f, w, v)


@merged
def to_constraints(f, w, t, q, v, theta, a, lam):
    """(q, v) put on the constraints, then accelerations and multipliers there.

    Rows of A hold for velocities alone; positions are moved in directions that they allow.

    Positions are corrected until a correction is at most theta, velocities alike, relative to the largest. Where it is
    at most theta times the smallest pivot, by whose inverse tangents turn, velocities are right after the same pass.
    """
    before = np.inf
    theta = max(theta, ABOVE_ROUNDING * w.notes[ROUNDED])
    for _ in range(MAX_INNER):
        code = _look(f, w, t, q, v)
        if code == DONE:
            code = factor_there(f, w, t, q)
        if code != DONE:
            return code
        if f.flags[KINEMATICS_GIVEN] == 0:
            w.C[:] = 0.0
            f.constraint(t, q, f.p, w.C)
        w.counters[N_INNER] += 1
        if f.flags[KINEMATICS_GIVEN] == 0 and f.flags[FORM] != NULL_SPACE:  # whose tangents needed them
            constraint_rates(f, w, t, q, w.Rate)
        moved, faster = _move_both(f, w, q, v)
        if not np.isfinite(moved):
            return not_finite(w.notes, CONSTRAINT, t, q)
        if moved <= theta and faster <= theta * max(1.0, largest_of(v)):
            break
        if moved <= w.notes[PIVOT] * theta:
            w.notes[KNOWN] = 0.0  # the tangents are those of the end, but Gamma belongs to the velocities before
            break
        if moved > CONTRACTION * before:
            if not moved <= ROUNDING * largest_of(q):
                return INNER_DIVERGED
            break
        before = max(moved, theta)
    code = accelerate(f, w, t, q, v, a)
    if code == DONE:
        equilibrate(f, w, a, lam)
    return code

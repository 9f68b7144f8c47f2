"""Accelerations and multipliers, eqs. (6)-(8) of the paper, and the projection of a state onto the constraints.

If a step integrates all coordinates, its states are off the constraints by the error of the formula. One pass computes
the accelerations there and moves positions and velocities to the nearest state on the constraints, in the metric of M,
which does not depend on the partition. Positions are then accurate to the square of their correction, velocities and
accelerations to the correction itself: a correction that is not near rounding is followed by another pass.
"""

import numpy as np

from twoloop.kernels.data.common import CONSTRAINT, MASS, compiled, finite, merged, not_finite, source_of_acceleration
from twoloop.kernels.data.indices import (
    CONSTANT_MASS,
    DONE,
    FACTORED,
    FORM,
    GAMMA_GIVEN,
    GAMMA_SCALE,
    INNER_DIVERGED,
    KINEMATICS_GIVEN,
    KNOWN,
    MULTIPLIERS,
    N_EVALUATIONS,
    N_INNER,
    NONHOLONOMIC_GAMMA_GIVEN,
    NULL_SPACE,
    PIVOT,
    ROUNDED,
)
from twoloop.kernels.evaluation.constraints import constraint_rates, gamma_by_differences, kinematics, row_residual
from twoloop.kernels.evaluation.partition import (
    CONTRACTION,
    MAX_ITERATIONS,
    ROUNDING_OF_CORRECTIONS,
    factor_dependent,
    factor_rows,
    find_null_space,
)
from twoloop.kernels.evaluation.program import gamma_by_program
from twoloop.kernels.linalg.band import banded_mass
from twoloop.kernels.linalg.dense import largest_of
from twoloop.kernels.linalg.saddle_point import factor, factor_mass, least_norm, multipliers, solve


@merged
def acceleration_constraint(f, w, t, q, v):
    """Compute the right-hand side Gamma of G a = Gamma into w.Gamma; return DONE, or why that failed."""
    n_c, n_rows = w.C.size, w.Rate.size
    if w.notes[KNOWN] == 1.0 and n_rows == n_c:
        return DONE
    given, given_a = f.flags[GAMMA_GIVEN] == 1, f.flags[NONHOLONOMIC_GAMMA_GIVEN] == 1
    first, last = 0, n_rows  # range of the rows that no callback gives
    w.Gamma[:] = 0.0
    if given:
        f.gamma(t, q, v, f.p, w.Gamma[:n_c])
        first = n_c
    if n_rows == n_c or given_a:
        last = n_c
    if (last > n_c or not given) and not gamma_by_program(f, w, t, q, v):
        code = gamma_by_differences(f, w, t, q, v, first, last)
        if code != DONE:
            return code
    if n_rows > n_c and given_a:
        f.nonholonomic_gamma(t, q, v, f.p, w.Gamma[n_c:])
    return DONE


@merged
def mass_matrix(f, w, t, q):
    """Evaluate M(t, q) into w.M."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)


@merged
def factor_mass_at(f, w, t, q):
    """Evaluate M(t, q), and factor it if the form needs its factors."""
    w.notes[FACTORED] = 0.0
    mass_matrix(f, w, t, q)
    code = factor_mass(f, w) if f.flags[FORM] == MULTIPLIERS or banded_mass(f) else DONE
    return code if finite(w.M) else not_finite(w.notes, MASS, t, q)


@merged
def factor_at(f, w, t, q):
    """Factor the linear problem at a state whose rows, factors and w.D stand in w."""
    if f.flags[CONSTANT_MASS] == 0:
        w.notes[FACTORED] = 0.0
        mass_matrix(f, w, t, q)
    code = factor(f, w)
    if code != DONE and not finite(w.M):
        return not_finite(w.notes, MASS, t, q)
    return code


@merged
def accelerate(f, w, t, q, v, a):
    """Compute the accelerations at a state whose rows, factors and w.D stand in w."""
    w.counters[N_EVALUATIONS] += 1
    code = factor_at(f, w, t, q)
    if code == DONE:
        code = acceleration_constraint(f, w, t, q, v)
    if code != DONE:
        return code
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    solve(f, w, w.Q, w.Gamma, a)
    for j in range(a.size):
        if not np.isfinite(a[j]):
            source = source_of_acceleration(w)
            return not_finite(w.notes, source if source >= 0 or finite(w.M) else MASS, t, q)
    if f.flags[GAMMA_GIVEN] == 0 or w.Rate.size > w.C.size:
        _record_gamma_scale(w, a)
    return DONE


@compiled
def _record_gamma_scale(w, a):
    """Record the largest sum of terms in G a, by which Gamma by differences is judged."""
    for i in range(w.Rate.size):
        total = 0.0
        for p in range(w.places[i], w.places[i + 1]):
            total += abs(w.G[i, w.places[p]] * a[w.places[p]])
        w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], total)


@merged
def equilibrate(f, w, a, lam):
    """Compute the multipliers of all rows, G^T lam = Q - M a, of least norm if rows are redundant."""
    lam[:] = 0.0
    multipliers(f, w, w.Q, a, lam)
    if w.rows_v.size < lam.size:
        least_norm(w, lam)


MIN_CORRECTION = 10.0  # in units of the rounding of positions: smaller corrections are never required


@merged
def _factor_rows_at(f, w, t, q, v):
    """Evaluate and factor the rows, and find the null space, at (q, v), which need not be on the constraints."""
    if f.flags[KINEMATICS_GIVEN] == 1:
        kinematics(f, w, t, q, v)
        w.notes[KNOWN] = 1.0
        code = factor_rows(w, t, q)
    else:
        code = factor_dependent(f, w, t, q)
    if code == DONE and f.flags[FORM] == NULL_SPACE:
        find_null_space(f, w, t, q)
    return code


@merged
def accelerate_at(f, w, t, q, v, a):
    """Compute the accelerations at (q, v), which need not be on the constraints."""
    code = _factor_rows_at(f, w, t, q, v)
    return accelerate(f, w, t, q, v, a) if code == DONE else code


@merged
def _correct(f, w, x):
    """Add to x the least correction in the metric of M that changes G x by w.g; return its largest entry."""
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
def _correct_both(f, w, q, v):
    """Correct q and v by the factors at q; return the largest correction of a position, and of a velocity."""
    rows, n_c = w.rows_v, w.C.size
    for i in range(rows.size):
        w.g[rows[i]] = -w.C[rows[i]] if rows[i] < n_c else 0.0
    moved = _correct(f, w, q)
    row_residual(w, v, rows)
    for i in range(rows.size):
        w.g[rows[i]] = -w.z[i]
    return moved, _correct(f, w, v)


@merged
def project_state(f, w, t, q, v, theta, a, lam):
    """Project (q, v) onto the constraints, then compute accelerations and multipliers there.

    Rows of A hold for velocities only; positions move in directions that these rows allow.

    Positions are corrected until a correction is at most theta, velocities likewise, relative to the largest. If the
    correction is at most theta times the smallest pivot, whose inverse bounds how tangents turn, velocities are right
    after the same pass.
    """
    before = np.inf
    theta = max(theta, MIN_CORRECTION * w.notes[ROUNDED])
    for _ in range(MAX_ITERATIONS):
        code = _factor_rows_at(f, w, t, q, v)
        if code == DONE:
            code = factor_at(f, w, t, q)
        if code != DONE:
            return code
        if f.flags[KINEMATICS_GIVEN] == 0:
            w.C[:] = 0.0
            f.constraint(t, q, f.p, w.C)
        w.counters[N_INNER] += 1
        # the tangents of NULL_SPACE have already evaluated the rates
        if f.flags[KINEMATICS_GIVEN] == 0 and f.flags[FORM] != NULL_SPACE:
            constraint_rates(f, w, t, q, w.Rate)
        moved, faster = _correct_both(f, w, q, v)
        if not np.isfinite(moved):
            return not_finite(w.notes, CONSTRAINT, t, q)
        if moved <= theta and faster <= theta * max(1.0, largest_of(v)):
            break
        if moved <= w.notes[PIVOT] * theta:
            w.notes[KNOWN] = 0.0  # Gamma was computed at the old velocities: compute it again
            break
        if moved > CONTRACTION * before:
            if not moved <= ROUNDING_OF_CORRECTIONS * largest_of(q):
                return INNER_DIVERGED
            break
        before = max(moved, theta)
    code = accelerate(f, w, t, q, v, a)
    if code == DONE:
        equilibrate(f, w, a, lam)
    return code

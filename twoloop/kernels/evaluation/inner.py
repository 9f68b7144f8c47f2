"""The inner loop: dependent positions by Newton, dependent velocities by a linear solve.

Equation numbers are those of Zhang & Zhang (2016), doi 10.1007/s11071-016-2682-8.
"""

import numpy as np

from twoloop.kernels.algebra.factors import columns_of, factor, rows_of, solve, solve_rows
from twoloop.kernels.data.codes import DONE, INNER_DIVERGED, ROWS_CONTRADICT, SINGULAR
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.counters import N_FACTORIZATIONS, N_INNER
from twoloop.kernels.data.finite import CONSTRAINT, JACOBIAN, finite, not_finite
from twoloop.kernels.data.flags import (
    CONSTRAINT_RATE_GIVEN,
    FORM,
    KINEMATICS_GIVEN,
    NONHOLONOMIC_RATE_GIVEN,
    NULL_SPACE,
)
from twoloop.kernels.data.noted import CONTRADICTION, FACTORED, KNOWN
from twoloop.kernels.evaluation.constraints import (
    clear_rows,
    constraint_rates,
    constraint_rows,
    gather_independent_columns,
    kinematics,
    row_residual,
)
from twoloop.kernels.evaluation.partition import RANK_TOLERANCE, note_entries, write_programs

MAX_INNER = 25  # Newton iterations; quadratic convergence needs 2 to 5
CONTRACTION = 0.5  # each correction must be at most this times the one before
ROUNDING = 1e-12  # relative to the largest value: changes of this size no longer shrink
CONTRADICTS = 1e-7  # relative to the mechanism's size: what a redundant row may be violated by


@compiled
def _factor_anew(w, t, q):
    """The factors by another order of elimination, or why there are none."""
    note_entries(w)
    if not finite(w.G):
        return not_finite(w.notes, JACOBIAN, t, q)
    if not write_programs(w):
        return SINGULAR
    ratio = min(factor(w.entries, w.index, w.values), factor(w.entries, w.index_v, w.values_v))
    return DONE if ratio > RANK_TOLERANCE else SINGULAR


@merged
def factor_rows(w, t, q):
    """The factors of the dependent columns of w.G."""
    w.notes[FACTORED] = 0.0
    ratio = factor(w.entries, w.index, w.values)
    w.counters[N_FACTORIZATIONS] += 1
    if w.Rate.size > w.C.size:
        ratio = min(ratio, factor(w.entries, w.index_v, w.values_v))
        w.counters[N_FACTORIZATIONS] += 1
    # else the order of elimination suits these numbers no longer, or there are none
    return DONE if ratio > RANK_TOLERANCE else _factor_anew(w, t, q)


@merged
def factor_dependent(f, w, t, q):
    """C_q and A at (t, q), and the factors of the dependent columns."""
    w.notes[KNOWN] = 0.0
    clear_rows(f, w)
    constraint_rows(f, w, t, q, w.G)
    return factor_rows(w, t, q)


@merged
def positions(f, w, t, q, v, tolerance, reuse):
    """Eq. (15): Newton on the dependent positions of q, update first, then test the correction.

    Leaves rows and factors at q in w, or those before a last correction of at most `reuse`; by the fused callback also
    w.Rate and w.Gamma at v, which is not restored yet.
    """
    before = np.inf
    converged = w.C.size == 0
    fused = f.flags[KINEMATICS_GIVEN] == 1
    for _ in range(MAX_INNER):
        if fused:
            kinematics(f, w, t, q, v)
            code = factor_rows(w, t, q)
        else:
            code = factor_dependent(f, w, t, q)
        if code != DONE or converged:
            return code
        if not fused:
            w.C[:] = 0.0
            f.constraint(t, q, f.p, w.C)
        w.counters[N_INNER] += 1
        rows, columns = rows_of(w.index), columns_of(w.index)
        for k in range(rows.size):
            w.z[k] = w.C[rows[k]]
        solve(w.index, w.values, w.z)
        correction = 0.0
        for k in range(rows.size):
            if not np.isfinite(w.z[k]):
                return not_finite(w.notes, CONSTRAINT, t, q)
            q[columns[k]] -= w.z[k]
            correction = max(correction, abs(w.z[k]))
        if correction <= reuse:
            return DONE
        converged = correction <= tolerance
        if not converged and correction > CONTRACTION * before:
            # at large coordinates rounding may stand above the tolerance; else this is no longer Newton's region,
            # and to go on could end on another assembly of the mechanism
            largest = 0.0
            for j in range(q.size):
                largest = max(largest, abs(q[j]))
            converged = correction <= ROUNDING * largest
            if not converged:
                return INNER_DIVERGED
        before = correction
    return INNER_DIVERGED


@merged
def tangents(f, w, t, q):
    """The velocities that the constraints allow into w.D, from the rows and factors in w."""
    if f.flags[KINEMATICS_GIVEN] == 0 or w.notes[KNOWN] == 0.0:
        constraint_rates(f, w, t, q, w.Rate)
    gather_independent_columns(w.G, w.Rate, rows_of(w.index_v), w.independent_v, w.D)
    driven = f.flags[CONSTRAINT_RATE_GIVEN] == 1 or f.flags[NONHOLONOMIC_RATE_GIVEN] == 1
    solve_rows(w.index_v, w.values_v, w.D, w.D.shape[0] if driven else w.D.shape[0] - 1)


@merged
def velocities(f, w, t, q, v, reuse):
    """Eq. (14): the dependent velocities of v, G_d v_d = -(C_t, b) - G_i v_i, from the rows and factors in w.

    After the fused callback w.Gamma is known where they change by at most `reuse`.
    """
    rows, columns = rows_of(w.index_v), columns_of(w.index_v)
    n_dof = w.independent_v.size
    w.notes[KNOWN] = float(f.flags[KINEMATICS_GIVEN])
    if f.flags[FORM] == NULL_SPACE:
        tangents(f, w, t, q)
        for k in range(rows.size):
            w.z[k] = w.D[n_dof, k]
        for j in range(n_dof):
            speed = v[w.independent_v[j]]
            for k in range(rows.size):
                w.z[k] += w.D[j, k] * speed
    else:
        if w.notes[KNOWN] == 0.0:
            constraint_rates(f, w, t, q, w.Rate)
        row_residual(w, v, rows)
        solve(w.index_v, w.values_v, w.z)
        for k in range(rows.size):
            w.z[k] = v[columns[k]] - w.z[k]
    change = 0.0
    for k in range(rows.size):
        change = max(change, abs(v[columns[k]] - w.z[k]))
        v[columns[k]] = w.z[k]
    if not change <= reuse:
        w.notes[KNOWN] = 0.0


@compiled
def redundant_rows_hold(f, w, t, q, v):
    """Whether the rows that were left out hold at an accepted state; needs C_q and A there in w.G."""
    w.C[:] = 0.0
    f.constraint(t, q, f.p, w.C)
    size, speed = 1.0, 1.0
    for j in range(q.size):
        size = max(size, abs(q[j]))
        speed = max(speed, abs(v[j]))
    for i in range(w.Rate.size):
        largest = 0.0
        total = w.Rate[i]
        for j in range(q.size):
            largest = max(largest, abs(w.G[i, j]))
            total += w.G[i, j] * v[j]
        off = abs(w.C[i]) > CONTRADICTS * size * largest if i < w.C.size else False
        if off or abs(total) > CONTRADICTS * speed * largest:
            w.notes[CONTRADICTION] = i
            return ROWS_CONTRADICT
    return DONE

"""Accelerations and multipliers, eqs. (6)-(8) of the paper, at a state on the constraints."""

import numpy as np

from twoloop.kernels.algebra.banded import banded_mass
from twoloop.kernels.algebra.saddle_point import factor, least_norm, multipliers, solve
from twoloop.kernels.algebra.schur import factor_mass
from twoloop.kernels.data.codes import DONE
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.counters import N_EVALUATIONS
from twoloop.kernels.data.finite import MASS, finite, not_finite, source_of_acceleration
from twoloop.kernels.data.flags import CONSTANT_MASS, FORM, GAMMA_GIVEN, MULTIPLIERS, NONHOLONOMIC_GAMMA_GIVEN
from twoloop.kernels.data.noted import FACTORED, GAMMA_SCALE, KNOWN
from twoloop.kernels.evaluation.gamma import gamma_by_differences
from twoloop.kernels.evaluation.program import gamma_by_program


@merged
def acceleration_constraint(f, w, t, q, v):
    """The right-hand side Gamma of G a = Gamma, into w.Gamma; DONE, or why it cannot be had."""
    n_c, n_rows = w.C.size, w.Rate.size
    if w.notes[KNOWN] == 1.0 and n_rows == n_c:
        return DONE
    given, given_a = f.flags[GAMMA_GIVEN] == 1, f.flags[NONHOLONOMIC_GAMMA_GIVEN] == 1
    first, last = 0, n_rows  # rows that no callback gives
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
    """M(t, q) into w.M."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)


@merged
def mass_there(f, w, t, q):
    """M(t, q), and what is needed of it."""
    w.notes[FACTORED] = 0.0
    mass_matrix(f, w, t, q)
    code = factor_mass(f, w) if f.flags[FORM] == MULTIPLIERS or banded_mass(f) else DONE
    return code if finite(w.M) else not_finite(w.notes, MASS, t, q)


@merged
def factor_there(f, w, t, q):
    """The factors of the linear problem at a state whose rows, factors and w.D stand in w."""
    if f.flags[CONSTANT_MASS] == 0:
        w.notes[FACTORED] = 0.0
        mass_matrix(f, w, t, q)
    code = factor(f, w)
    if code != DONE and not finite(w.M):
        return not_finite(w.notes, MASS, t, q)
    return code


@merged
def accelerate(f, w, t, q, v, a):
    """The accelerations at a state whose rows, factors and w.D stand in w."""
    w.counters[N_EVALUATIONS] += 1
    code = factor_there(f, w, t, q)
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
        _note_scale(w, a)
    return DONE


@compiled
def _note_scale(w, a):
    """The largest sum of terms in G a, by which Gamma by differences is judged."""
    for i in range(w.Rate.size):
        total = 0.0
        for p in range(w.places[i], w.places[i + 1]):
            total += abs(w.G[i, w.places[p]] * a[w.places[p]])
        w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], total)


@merged
def equilibrate(f, w, a, lam):
    """Multipliers of all rows: G^T lam = Q - M a, of least norm where rows are redundant."""
    lam[:] = 0.0
    multipliers(f, w, w.Q, a, lam)
    if w.rows_v.size < lam.size:
        least_norm(w, lam)

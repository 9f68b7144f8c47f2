"""The inner loop of large systems: what the steps ask for, by factors with a static program.

There is no partition: all coordinates are integrated, and evaluated as they stand. Wherever others restore dependent
coordinates, all are moved to the nearest state on the constraints, nearest in the metric of M. What these factors
cannot decide is NEEDS_DENSE: a run then goes on with the forms of saddle_point.py, as it does for methods that need a
partition.
"""

import numpy as np

from twoloop.kernels.algebra.linalg import copy, largest_of
from twoloop.kernels.algebra.patterns import has_new_entries
from twoloop.kernels.algebra.static_program import jacobian_of
from twoloop.kernels.data.codes import DONE, INNER_DIVERGED, NEEDS_DENSE, ROWS_CONTRADICT
from twoloop.kernels.data.common import INNER, compiled, kernel
from twoloop.kernels.data.counters import N_EVALUATIONS, N_INNER
from twoloop.kernels.data.finite import CONSTRAINT, FORCE, GAMMA, MASS, RATE, finite_vector, not_finite
from twoloop.kernels.data.flags import GAMMA_GIVEN
from twoloop.kernels.data.noted import CONTRADICTION, NEARLY_SINGULAR, PIVOT, ROUNDED
from twoloop.kernels.evaluation import tasks
from twoloop.kernels.evaluation.constraints import constraint_rates
from twoloop.kernels.evaluation.inner import CONTRACTION, CONTRADICTS, MAX_INNER, ROUNDING
from twoloop.kernels.evaluation.onto_constraints import ABOVE_ROUNDING
from twoloop.kernels.evaluation.program import gamma_by_program
from twoloop.kernels.evaluation.static_factors_at import (
    CAREFUL,
    choose_rows,
    factors_there,
    mass_values_there,
    refinements,
    solve_values,
)
from twoloop.kernels.evaluation.static_least_norm import least_norm


@compiled
def _rows_times(f, w, x, out):
    """Add G x to out."""
    rows, columns, _ = jacobian_of(f.static_program)
    for k in range(rows.size):
        out[rows[k]] += w.jacobian_values[k] * x[columns[k]]


@compiled
def _gamma(f, w, t, q, v):
    """The right-hand side of the acceleration constraints, into w.Gamma."""
    w.Gamma[:] = 0.0
    if f.flags[GAMMA_GIVEN] == 1:
        f.gamma(t, q, v, f.p, w.Gamma)
        return DONE
    return DONE if gamma_by_program(f, w, t, q, v) else NEEDS_DENSE


@compiled
def _fault(w, t, q):
    """Which callback gave an acceleration that is not finite."""
    if not finite_vector(w.Gamma):
        return not_finite(w.notes, GAMMA, t, q)
    if not finite_vector(w.Q):
        return not_finite(w.notes, FORCE, t, q)
    return not_finite(w.notes, MASS if not finite_vector(w.mass_values) else -1, t, q)


@compiled
def _accelerate(f, w, t, q, v, a):
    """The accelerations by the factors there are; multipliers go into w.z."""
    w.counters[N_EVALUATIONS] += 1
    code = _gamma(f, w, t, q, v)
    if code != DONE:
        return code
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    n = a.size
    copy(w.Q, w.unknowns[:n])
    copy(w.Gamma, w.unknowns[n:])
    solve_values(f, w, refinements(w))
    copy(w.unknowns[:n], a)
    copy(w.unknowns[n:], w.z)
    return DONE if finite_vector(a) else _fault(w, t, q)


@compiled
def _equilibrate(f, w, lam):
    """Multipliers of all rows, of least norm where rows are redundant."""
    copy(w.z, lam)
    return least_norm(f, w, lam) if w.rows_v.size < lam.size else DONE


@compiled
def _move(f, w, x):
    """Move x by the least correction in the metric of M that takes -w.g away from G x; the largest entry of it."""
    n = x.size
    w.unknowns[:n] = 0.0
    copy(w.g, w.unknowns[n:])
    solve_values(f, w, 0)
    largest = 0.0
    for j in range(n):
        if not np.isfinite(w.unknowns[j]):
            return np.inf
        x[j] += w.unknowns[j]
        largest = max(largest, abs(w.unknowns[j]))
    return largest


@compiled
def _to_constraints(f, w, t, q, v, theta):
    """(q, v) put on the constraints, as onto_constraints.py says; the factors are those before the last correction."""
    before = np.inf
    theta = max(theta, ABOVE_ROUNDING * w.notes[ROUNDED])
    for _ in range(MAX_INNER):
        code = factors_there(f, w, t, q)
        if code != DONE:
            return code
        w.C[:] = 0.0
        f.constraint(t, q, f.p, w.C)
        w.counters[N_INNER] += 1
        for i in range(w.g.size):
            w.g[i] = -w.C[i]
        moved = _move(f, w, q)
        if not np.isfinite(moved):
            return not_finite(w.notes, CONSTRAINT, t, q)
        constraint_rates(f, w, t, q, w.Rate)
        copy(w.Rate, w.g)
        _rows_times(f, w, v, w.g)
        for i in range(w.g.size):
            w.g[i] = -w.g[i]
        faster = _move(f, w, v)
        if not np.isfinite(faster):
            return not_finite(w.notes, RATE, t, q)
        if moved <= theta and faster <= theta * max(1.0, largest_of(v)):
            return DONE
        if moved <= w.notes[PIVOT] * theta:
            return DONE
        if moved > CONTRACTION * before:
            return DONE if moved <= ROUNDING * largest_of(q) else INNER_DIVERGED
        before = max(moved, theta)
    return INNER_DIVERGED


@compiled
def _is_as_planned(w):
    """Whether a dense mass matrix has its entries where the program expects them; the Jacobian's are seen to."""
    return w.M.size == 0 or not has_new_entries(w.M, w.mass_pattern)


@compiled
def _redundant_rows_hold(f, w, t, q, v):
    """Whether the rows that were left out hold at an accepted state, whose entries stand in w."""
    w.C[:] = 0.0
    f.constraint(t, q, f.p, w.C)
    size, speed = max(1.0, largest_of(q)), max(1.0, largest_of(v))
    copy(w.Rate, w.g)
    _rows_times(f, w, v, w.g)
    rows, _, _ = jacobian_of(f.static_program)
    largest = w.solutions[: w.g.size]
    largest[:] = 0.0
    for k in range(rows.size):
        largest[rows[k]] = max(largest[rows[k]], abs(w.jacobian_values[k]))
    for i in range(w.g.size):
        if abs(w.C[i]) > CONTRADICTS * size * largest[i] or abs(w.g[i]) > CONTRADICTS * speed * largest[i]:
            w.notes[CONTRADICTION] = i
            return ROWS_CONTRADICT
    return DONE


@compiled
def _solve(f, w, r, c, a, lam):
    """The solution for any right-hand side, by the factors there are."""
    n = r.size
    copy(r, w.unknowns[:n])
    copy(c, w.unknowns[n:])
    solve_values(f, w, refinements(w))
    copy(w.unknowns[:n], a)
    copy(w.unknowns[n:], lam)
    return DONE


@compiled
def _other_task(f, w, task, t, q, v, a, lam):
    if task == tasks.TANGENTS:
        return factors_there(f, w, t, q)
    if task == tasks.RENEW:
        return choose_rows(f, w, t, q)
    if task == tasks.MASS_TASK:
        mass_values_there(f, w, t, q)
        return DONE if finite_vector(w.mass_values) else not_finite(w.notes, MASS, t, q)
    if task == tasks.REDUNDANT:
        return _redundant_rows_hold(f, w, t, q, v)
    if task == tasks.SOLVE:
        return _solve(f, w, q, v, a, lam)
    return NEEDS_DENSE


@kernel(INNER)
def static_inner_loop(f, w, task, t, q, v, tolerance, a, lam):
    """What the names of the tasks say, at (t, q, v), see calls.py; of SOLVE, q and v are the right-hand side."""
    if task in (tasks.EVALUATE, tasks.EVALUATE_THERE):
        code = DONE
        if task == tasks.EVALUATE and w.notes[NEARLY_SINGULAR] == CAREFUL:
            code = _to_constraints(f, w, t, q, v, tolerance)
        if code == DONE:
            code = factors_there(f, w, t, q)
        return _accelerate(f, w, t, q, v, a) if code == DONE else code
    if task == tasks.MULTIPLIERS:
        return _equilibrate(f, w, lam)
    if task >= tasks.TANGENTS:
        return _other_task(f, w, task, t, q, v, a, lam)
    code = DONE
    if task != tasks.ACCELERATIONS:
        code = _to_constraints(f, w, t, q, v, tolerance if task == tasks.PROJECT else 0.0)
        if code != DONE or task == tasks.RESTORE:
            return code
    code = _accelerate(f, w, t, q, v, a)
    if code != DONE:
        return code
    code = _equilibrate(f, w, lam)
    return code if _is_as_planned(w) else NEEDS_DENSE

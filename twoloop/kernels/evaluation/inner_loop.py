"""Evaluate accelerations, and move states onto the constraints: the inner loop, which the steps of all methods call.

The inner loop is compiled once, as one function, which the kit `f` contains; steps call it through the functions at the
end of this file, one for each task. Accelerations a and multipliers lam follow from eqs. (6)-(8) of the paper:
M a + G^T lam = Q (Q: forces), G a = Gamma. G = [C_q; A] contains the Jacobian C_q of constraints on positions and the
rows A of non-holonomic constraints A v + b = 0; w.D contains the null space of G. `w` is the workspace.

If a step integrates all coordinates, its states violate the constraints by the error of the formula. Each iteration of
a projection moves q and v towards the nearest state on the constraints, in the metric of M. This state does not depend
on a partition. After an iteration, the error of q is about the square of the correction of q, but the errors of v and a
are about as large as this correction: iterations are repeated until the correction is near rounding.
"""

import numpy as np

from twoloop.kernels.data.common import (
    CONSTRAINT,
    INNER,
    MASS,
    compiled,
    faulty_callback,
    finite,
    kernel,
    merged,
    not_finite,
)
from twoloop.kernels.data.indices import DONE, INNER_DIVERGED, MULTIPLIERS, NULL_SPACE, SINGULAR, STOPPED
from twoloop.kernels.evaluation import tasks
from twoloop.kernels.evaluation.constraints import constraint_rates, gamma_by_differences, kinematics, row_residual
from twoloop.kernels.evaluation.operations import gamma_by_program
from twoloop.kernels.evaluation.partition import (
    CONTRACTION,
    MAX_ITERATIONS,
    MIN_CORRECTION,
    ROUNDING_OF_CORRECTIONS,
    adopt_partition_of_midpoint,
    check_all_rows,
    choose_oriented_partition,
    evaluate_and_factor_columns,
    factor_dependent_columns,
    find_null_space,
    is_rounding_of_positions,
    projection_tolerance,
    record_entries,
    restore_positions,
    restore_velocities,
    write_programs,
)
from twoloop.kernels.linalg import saddle_point
from twoloop.kernels.linalg.band import has_banded_mass
from twoloop.kernels.linalg.dense import has_new_entries, largest_of
from twoloop.kernels.linalg.saddle_point import factor, factor_mass, least_norm, solve


@merged
def compute_gamma(f, w, t, q, v):
    """Store Gamma, the right-hand side of G a = Gamma, in w.Gamma; return DONE or the code of a failure."""
    n_c, n_rows = w.C.size, w.Rate.size
    if w.has_gamma == 1.0 and n_rows == n_c:
        return DONE
    has_gamma, has_gamma_a = f.gamma_given == 1, f.nonholonomic_gamma_given == 1
    first, last = 0, n_rows  # the user gives no callback for rows `first` to `last` - 1 of Gamma
    w.Gamma[:] = 0.0
    if has_gamma:
        f.gamma(t, q, v, f.p, w.Gamma[:n_c])
        first = n_c
    if n_rows == n_c or has_gamma_a:
        last = n_c
    if last > first and not gamma_by_program(f, w, t, q, v):
        code = gamma_by_differences(f, w, t, q, v, first, last)
        if code != DONE:
            return code
    if n_rows > n_c and has_gamma_a:
        f.nonholonomic_gamma(t, q, v, f.p, w.Gamma[n_c:])
    return DONE


@merged
def mass_matrix(f, w, t, q):
    """Store the mass matrix M(t, q) in w.M."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)


@merged
def factor_mass_at(f, w, t, q):
    """Store the mass matrix in w.M and, if f.form needs them, its factors in w.L; return DONE or a failure code."""
    w.factored = 0.0
    mass_matrix(f, w, t, q)
    code = factor_mass(f, w) if f.form == MULTIPLIERS or has_banded_mass(f) else DONE
    return code if finite(w.M) else not_finite(w, MASS, t, q)


@merged
def factor_equations_at(f, w, t, q):
    """Factor M a + G^T lam = Q, G a = Gamma, given Jacobian G and null space in w; return DONE or a failure code."""
    if f.constant_mass == 0:
        w.factored = 0.0
        mass_matrix(f, w, t, q)
    code = factor(f, w)
    if code != DONE and not finite(w.M):
        return not_finite(w, MASS, t, q)
    return code


@merged
def compute_accelerations(f, w, t, q, v, a):
    """Store accelerations at (q, v) in `a`, given factors of the Jacobian in w; return DONE or a failure code."""
    w.n_evaluations += 1
    code = factor_equations_at(f, w, t, q)
    if code == DONE:
        code = compute_gamma(f, w, t, q, v)
    if code != DONE:
        return code
    w.Q[:] = 0.0
    f.force(t, q, v, f.p, w.Q)
    solve(f, w, w.Q, w.Gamma, a)
    for j in range(a.size):
        if not np.isfinite(a[j]):
            callback = faulty_callback(w)
            return not_finite(w, callback if callback >= 0 or finite(w.M) else MASS, t, q)
    if f.gamma_given == 0 or w.Rate.size > w.C.size:
        _record_gamma_scale(w, a)
    return DONE


@compiled
def _record_gamma_scale(w, a):
    """Raise w.gamma_scale, the size of Gamma, to at least the largest sum over j of |G_ij a_j| (G: Jacobian)."""
    for i in range(w.Rate.size):
        total = 0.0
        for p in range(w.row_entries[i], w.row_entries[i + 1]):
            total += abs(w.G[i, w.row_entries[p]] * a[w.row_entries[p]])
        w.gamma_scale = max(w.gamma_scale, total)


@merged
def compute_multipliers(f, w, a, lam):
    """Store in lam the solution of G^T lam = Q - M a (G: Jacobian, Q: forces): the shortest, if there are several."""
    lam[:] = 0.0
    saddle_point.multipliers(f, w, w.Q, a, lam)
    if w.rows_v.size < lam.size:
        least_norm(w, lam)


@merged
def _factor_rows_at(f, w, t, q, v):
    """Store the constraint Jacobian at q and factors of its dependent columns in w; return DONE or a failure code.

    In the form NULL_SPACE, also store the null space; with the callback `kinematics`, also Gamma at (q, v).
    """
    if f.kinematics_given == 1:
        kinematics(f, w, t, q, v)
        w.has_gamma = 1.0
        code = factor_dependent_columns(w, t, q)
    else:
        code = evaluate_and_factor_columns(f, w, t, q)
    if code == DONE and f.form == NULL_SPACE:
        find_null_space(f, w, t, q)
    return code


@merged
def compute_accelerations_at(f, w, t, q, v, a):
    """Store the accelerations at (q, v), which may violate the constraints, in `a`; return DONE or a failure code."""
    code = _factor_rows_at(f, w, t, q, v)
    return compute_accelerations(f, w, t, q, v, a) if code == DONE else code


@merged
def _find_least_correction(f, w):
    """Store in w.y the solution x of G x = w.g (G: Jacobian) with least x^T M x; return max|x|; inf if not finite."""
    w.Q[:] = 0.0
    solve(f, w, w.Q, w.g, w.y)
    largest = 0.0
    for j in range(w.y.size):
        if not np.isfinite(w.y[j]):
            return np.inf
        largest = max(largest, abs(w.y[j]))
    return largest


@merged
def _find_corrections(f, w, v):
    """Correct v in place, but not q: store the correction of q in w.y. Return max|correction| of q, and of v."""
    rows, n_c = w.rows_v, w.C.size
    row_residual(w, v, rows)
    for i in range(rows.size):
        w.g[rows[i]] = -w.z[i]
    correction_v = _find_least_correction(f, w)
    for j in range(v.size):
        v[j] += w.y[j]
    for i in range(rows.size):
        w.g[rows[i]] = -w.C[rows[i]] if rows[i] < n_c else 0.0
    return _find_least_correction(f, w), correction_v


@merged
def project_state(f, w, t, q, v, theta, a, lam):
    """Project (q, v) onto the constraints; store accelerations `a` and multipliers lam; return DONE or a failure code.

    q and v change in place. Corrections x of q satisfy A x = 0, where A are the rows of non-holonomic constraints.
    Iterations end when they correct q by at most theta, and v by at most theta max(1, max|v|). They also end when they
    correct q by at most theta * w.pivot (smallest pivot of C_q). Then v is accurate, too: over a displacement d, the
    directions that constraints allow turn by at most about d / w.pivot.
    """
    last_correction = np.inf
    theta = max(theta, MIN_CORRECTION * w.rounded)
    for _ in range(MAX_ITERATIONS):
        code = _factor_rows_at(f, w, t, q, v)
        if code == DONE:
            code = factor_equations_at(f, w, t, q)
        if code != DONE:
            return code
        if f.kinematics_given == 0:
            w.C[:] = 0.0
            f.constraint(t, q, f.p, w.C)
        w.n_inner += 1
        # in the form NULL_SPACE, find_null_space has already stored C_t and b in w.Rate
        if f.kinematics_given == 0 and f.form != NULL_SPACE:
            constraint_rates(f, w, t, q, w.Rate)
        correction_q, correction_v = _find_corrections(f, w, v)
        if not np.isfinite(correction_q):
            return not_finite(w, CONSTRAINT, t, q)
        has_converged = correction_q <= theta and correction_v <= theta * max(1.0, largest_of(v))
        is_last = has_converged or correction_q <= w.pivot * theta
        if not has_converged:
            w.has_gamma = 0.0  # Gamma in w belongs to the old velocities: compute it again
        if not is_last and correction_q > CONTRACTION * last_correction:
            if is_rounding_of_positions(w, q, correction_q):
                break  # leave out this correction: it is a rounding error, and may be large for light bodies
            return INNER_DIVERGED
        for j in range(q.size):
            q[j] += w.y[j]
        if is_last:
            break
        last_correction = max(correction_q, theta)
    code = compute_accelerations(f, w, t, q, v, a)
    if code == DONE:
        compute_multipliers(f, w, a, lam)
    return code


ROUNDING_OF_Q = 2e-14  # a change of q by at most this fraction of max|q| counts as a rounding error


@merged
def _verify_pattern(w):
    """If the constraint Jacobian w.G has nonzero entries where w.pattern is 0, write new programs of elimination.

    Return DONE if w.G has no such entry, INNER_DIVERGED (repeat the step) after new programs, or SINGULAR on failure.
    """
    if not record_entries(w):
        return DONE
    return INNER_DIVERGED if write_programs(w) else SINGULAR


@compiled
def _do_task_between_evaluations(f, w, task, t, q, v):
    """Do a task (see tasks.py) other than evaluating or projecting a state; return DONE or a failure code."""
    if task == tasks.FIND_NULL_SPACE:
        code = evaluate_and_factor_columns(f, w, t, q)
        if code == DONE:
            find_null_space(f, w, t, q)
        return code
    if task == tasks.PREPARE_MASS:
        return factor_mass_at(f, w, t, q)
    if task == tasks.RENEW_PARTITION:
        return choose_oriented_partition(f, w, t, q)
    if task == tasks.ADOPT_MIDPOINT:
        return adopt_partition_of_midpoint(f, w, t, q, v)
    if task == tasks.VERIFY_PATTERN:
        return _verify_pattern(w)
    return check_all_rows(f, w, t, q, v)


@kernel(INNER)
def inner_loop(f, w, task, t, q, v, tolerance, a, lam):
    """Do a task at (t, q, v); return DONE or a failure code. Each task has a function below, which explains it."""
    if task >= tasks.FIND_NULL_SPACE:
        return _do_task_between_evaluations(f, w, task, t, q, v)
    if task in (tasks.EVALUATE, tasks.EVALUATE_WITHOUT_PROJECTION) and w.time_is_up == 1.0:
        return STOPPED
    # the next two tasks are for methods that integrate all coordinates
    if task == tasks.EVALUATE_WITHOUT_PROJECTION:
        return compute_accelerations_at(f, w, t, q, v, a)
    if task == tasks.PROJECT:
        return project_state(f, w, t, q, v, tolerance, a, lam)
    code = DONE
    if task <= tasks.RESTORE:
        reuse_limit = w.reuse if task == tasks.EVALUATE else w.rounded
        code = restore_positions(f, w, t, q, v, tolerance, reuse_limit)
        if code == DONE and task != tasks.EVALUATE:
            code = _verify_pattern(w)
        if code != DONE:
            return code
        restore_velocities(f, w, t, q, v, reuse_limit)
    if task == tasks.RESTORE:
        return code
    if task != tasks.MULTIPLIERS:
        code = compute_accelerations(f, w, t, q, v, a)
    if code == DONE and task != tasks.EVALUATE:
        compute_multipliers(f, w, a, lam)
    return code


@merged
def evaluate(f, w, t, q, v, tolerance, a):
    """Compute dependent from independent entries of q and v, and the accelerations `a`; return DONE or a failure code.

    If the last correction of q, at most `tolerance`, exceeds w.reuse, the Jacobian is evaluated again at the end.
    """
    return f.inner(f, w, tasks.EVALUATE, t, q, v, tolerance, a, w.lam)


@merged
def evaluate_state(f, w, t, q, v, tolerance, a, lam):
    """At the end of a step, compute dependent entries of q and v up to rounding; store `a` and lam; return a code."""
    return f.inner(f, w, tasks.EVALUATE_STATE, t, q, v, tolerance, a, lam)


@merged
def evaluate_without_projection(f, w, t, q, v, a):
    """Store accelerations in `a` at a stage (q, v), which may violate the constraints; return a code."""
    return f.inner(f, w, tasks.EVALUATE_WITHOUT_PROJECTION, t, q, v, 0.0, a, w.lam)


@merged
def project(f, w, t, q, v, theta, a, lam):
    """Project (q, v) onto the constraints, in place, by `project_state`; store `a` and lam; return a code."""
    code = f.inner(f, w, tasks.PROJECT, t, q, v, theta, a, lam)
    if code == DONE and has_new_entries(w.G, w.pattern):
        code = f.inner(f, w, tasks.VERIFY_PATTERN, t, q, v, theta, a, lam)
    return code


@merged
def restore_constraints(f, w, t, q, v, tolerance):
    """Compute dependent entries of q (with a last correction of at most `tolerance`) and of v; return a code."""
    return f.inner(f, w, tasks.RESTORE, t, q, v, tolerance, w.x, w.lam)


@merged
def accelerations(f, w, t, q, v, a, lam):
    """Store accelerations `a` and multipliers lam at a state (q, v) from `restore_constraints`; return a code."""
    return f.inner(f, w, tasks.ACCELERATIONS, t, q, v, 0.0, a, lam)


@merged
def multipliers(f, w, t, q, v, a, lam):
    """Store the multipliers lam that belong to the accelerations `a` evaluated last; return DONE or a failure code."""
    return f.inner(f, w, tasks.MULTIPLIERS, t, q, v, 0.0, a, lam)


@merged
def find_tangents(f, w, t, q):
    """Store the constraint Jacobian at q, its factors and its null space (tangents) in w; return a code."""
    return f.inner(f, w, tasks.FIND_NULL_SPACE, t, q, q, 0.0, w.x, w.lam)


@merged
def prepare_mass(f, w, t, q):
    """At the start of a run, store the mass matrix in w and, if f.form needs them, its factors; return a code."""
    return f.inner(f, w, tasks.PREPARE_MASS, t, q, q, 0.0, w.x, w.lam)


@merged
def renew_partition(f, w, t, q):
    """At a consistent q, choose a partition, and store sign(det C_qd) (C_qd: dependent columns) in w; return a code."""
    return f.inner(f, w, tasks.RENEW_PARTITION, t, q, q, 0.0, w.x, w.lam)


@merged
def adopt_midpoint_partition(f, w, t_mid, state, new_state):
    """Do `adopt_partition_of_midpoint`, which chooses a partition at the middle of a step; return its code."""
    return f.inner(f, w, tasks.ADOPT_MIDPOINT, t_mid, state, new_state, 0.0, w.x, w.lam)


@merged
def check_redundant_rows(f, w, t, q, v):
    """Return DONE if the accepted state (q, v) also satisfies the redundant constraints, else ROWS_CONTRADICT."""
    return f.inner(f, w, tasks.CHECK_REDUNDANT, t, q, v, 0.0, w.x, w.lam)


@merged
def rounding_floor(q):
    """Return the largest change of q that may be a rounding error: after such a change, an iteration has converged."""
    return max(ROUNDING_OF_CORRECTIONS, ROUNDING_OF_Q * largest_of(q))


@kernel(INNER)
def generated_inner_loop(f, w, task, t, q, v, theta, a, lam):
    """Do a task by generated code, or by `f.general` if the code is missing or fails; return DONE or a failure code."""
    if task == tasks.EVALUATE_WITHOUT_PROJECTION:
        w.n_evaluations += 1
        w.n_factorizations += 1
        if f.own_accelerate(t, q, v, f.numbers, a):
            return DONE
    elif task == tasks.PROJECT:
        tolerance, last_correction = projection_tolerance(w, theta, largest_of(q)), np.inf
        for k in range(MAX_ITERATIONS):
            w.n_inner += 1
            w.n_factorizations += 1
            if k == 0:
                is_valid = f.own_correct_positions(t, q, v, f.numbers, w.x, q)
            else:
                is_valid = f.own_project(t, q, v, f.numbers, a, w.x, q, v, lam)
            if not is_valid:
                break
            correction = 0.0
            for j in range(q.size):
                correction = max(correction, abs(w.x[j]))
            if correction <= tolerance and k > 0:
                w.n_evaluations += 1
                w.used_general = 0.0
                return DONE
            if correction > CONTRACTION * last_correction:
                break
            last_correction = max(correction, tolerance)
        w.used_general = 1.0
    elif task == tasks.CHECK_REDUNDANT and w.used_general == 0.0:
        if f.own_redundant(t, q, v, f.numbers, a):
            return DONE
        f.general(f, w, tasks.FIND_NULL_SPACE, t, q, v, theta, a, lam)  # stores the Jacobian, for the check below, in w
    elif task <= tasks.MULTIPLIERS:  # generated code cannot do these tasks, because they use a partition
        w.used_general = 1.0
    return f.general(f, w, task, t, q, v, theta, a, lam)

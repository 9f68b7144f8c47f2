"""Evaluate accelerations, and move states onto the constraints: the inner loop, which the steps of all methods call.

The inner loop is compiled once, as one function, and passed to steps in a `Kit`; steps call it through the functions at
the end of this file, one for each task. Accelerations and multipliers follow from eqs. (6)-(8) of the paper.

If a step integrates all coordinates, its states are off the constraints by the error of the formula. One pass of a
projection moves positions and velocities to the nearest state on the constraints, in the metric of M, which does not
depend on the partition. After a pass, the error of positions is about the square of their correction. The errors of
velocities and accelerations are about as large as the correction: passes are repeated until it is near rounding.
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
    first, last = 0, n_rows  # range of the rows of Gamma that no callback computes
    w.Gamma[:] = 0.0
    if has_gamma:
        f.gamma(t, q, v, f.p, w.Gamma[:n_c])
        first = n_c
    if n_rows == n_c or has_gamma_a:
        last = n_c
    if (last > n_c or not has_gamma) and not gamma_by_program(f, w, t, q, v):
        code = gamma_by_differences(f, w, t, q, v, first, last)
        if code != DONE:
            return code
    if n_rows > n_c and has_gamma_a:
        f.nonholonomic_gamma(t, q, v, f.p, w.Gamma[n_c:])
    return DONE


@merged
def mass_matrix(f, w, t, q):
    """Store M(t, q) in w.M."""
    w.M[:, :] = 0.0
    f.mass(t, q, f.p, w.M)


@merged
def factor_mass_at(f, w, t, q):
    """Store M(t, q) in w.M, and the factors of M in w.L if the form of the equations uses them; return a code."""
    w.factored = 0.0
    mass_matrix(f, w, t, q)
    code = factor_mass(f, w) if f.form == MULTIPLIERS or has_banded_mass(f) else DONE
    return code if finite(w.M) else not_finite(w, MASS, t, q)


@merged
def factor_equations_at(f, w, t, q):
    """Factor the linear system for accelerations at (t, q), given the rows and (if NULL_SPACE) w.D; return a code."""
    if f.constant_mass == 0:
        w.factored = 0.0
        mass_matrix(f, w, t, q)
    code = factor(f, w)
    if code != DONE and not finite(w.M):
        return not_finite(w, MASS, t, q)
    return code


@merged
def compute_accelerations(f, w, t, q, v, a):
    """Compute the accelerations `a` at (q, v), given the rows, their factors and (if NULL_SPACE) w.D; return a code."""
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
    """Increase GAMMA_SCALE, the scale of errors of Gamma, to at least the largest sum over j of |G_ij a_j|."""
    for i in range(w.Rate.size):
        total = 0.0
        for p in range(w.row_entries[i], w.row_entries[i + 1]):
            total += abs(w.G[i, w.row_entries[p]] * a[w.row_entries[p]])
        w.gamma_scale = max(w.gamma_scale, total)


@merged
def compute_multipliers(f, w, a, lam):
    """Store in lam the multipliers of all rows: G^T lam = Q - M a. If rows are redundant, lam has the least norm."""
    lam[:] = 0.0
    saddle_point.multipliers(f, w, w.Q, a, lam)
    if w.rows_v.size < lam.size:
        least_norm(w, lam)


@merged
def _factor_rows_at(f, w, t, q, v):
    """Store in w the rows of G at q, their factors and, for NULL_SPACE, the null space w.D; return a code.

    The callback `kinematics` also computes Gamma, which depends on v. The state (q, v) may be off the constraints.
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
    """Store in `a` the accelerations at the state (q, v), which may be off the constraints; return a code."""
    code = _factor_rows_at(f, w, t, q, v)
    return compute_accelerations(f, w, t, q, v, a) if code == DONE else code


@merged
def _find_least_correction(f, w):
    """Store in w.y the least correction x, in the metric of M, with G x = w.g; return max|x|, or inf if not finite."""
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
    """Correct v in place by the factors at q, and store the correction of q in w.y; return max|corrections|."""
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
    """Project (q, v) onto the constraints in place, store accelerations in `a` and multipliers in lam; return a code.

    Rows of A constrain velocities only; positions are corrected in directions that these rows allow.

    The last pass corrects positions by at most theta, and velocities by at most theta max(1, max|v|). Passes also end
    after a correction of positions of at most theta times the smallest pivot: the inverse of this pivot bounds how fast
    tangents turn, so that velocities are accurate, too.
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
        # with NULL_SPACE, find_null_space has already evaluated the rates
        if f.kinematics_given == 0 and f.form != NULL_SPACE:
            constraint_rates(f, w, t, q, w.Rate)
        correction_q, correction_v = _find_corrections(f, w, v)
        if not np.isfinite(correction_q):
            return not_finite(w, CONSTRAINT, t, q)
        has_converged = correction_q <= theta and correction_v <= theta * max(1.0, largest_of(v))
        is_last = has_converged or correction_q <= w.pivot * theta
        if not has_converged:
            w.has_gamma = 0.0  # Gamma was computed at the old velocities: compute it again
        if not is_last and correction_q > CONTRACTION * last_correction:
            if is_rounding_of_positions(w, q, correction_q):
                break  # omit this correction, which is noise: it would move light bodies by much more than others
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


ROUNDING_OF_Q = 2e-14  # change of q that counts as rounding, relative to max|q|: about a hundred rounding errors


@merged
def _verify_pattern(w):
    """Return DONE if w.pattern contains all nonzero entries of w.G; else write new programs that use the new entries.

    The code is then INNER_DIVERGED, so that the step is repeated with them; or SINGULAR if no program can be written.
    """
    if not record_entries(w):
        return DONE
    return INNER_DIVERGED if write_programs(w) else SINGULAR


@compiled
def _do_task_between_evaluations(f, w, task, t, q, v):
    """Do one of the tasks that choose, check or factor something between evaluations; return a code."""
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
    """Do `task`, one of the numbers in tasks.py, at (t, q, v); return a code. Functions below explain the tasks."""
    if task >= tasks.FIND_NULL_SPACE:
        return _do_task_between_evaluations(f, w, task, t, q, v)
    if task in (tasks.EVALUATE, tasks.EVALUATE_WITHOUT_PROJECTION) and w.time_is_up == 1.0:
        return STOPPED
    # methods that integrate all coordinates call the tasks EVALUATE_WITHOUT_PROJECTION and PROJECT
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
    """Compute the dependent entries of q and v from the independent ones, and the accelerations `a`; return a code.

    Velocities and accelerations use the Jacobian that was factored last, at most w.reuse away from the final q.
    """
    return f.inner(f, w, tasks.EVALUATE, t, q, v, tolerance, a, w.lam)


@merged
def evaluate_state(f, w, t, q, v, tolerance, a, lam):
    """Compute the dependent entries of q and v, the accelerations `a` and the multipliers lam; return a code.

    Dependent entries are accurate up to rounding, as accepted states must be; for other states `evaluate` is faster.
    """
    return f.inner(f, w, tasks.EVALUATE_STATE, t, q, v, tolerance, a, lam)


@merged
def evaluate_without_projection(f, w, t, q, v, a):
    """Store in `a` the accelerations at (q, v), a state that may be off the constraints; return a code."""
    return f.inner(f, w, tasks.EVALUATE_WITHOUT_PROJECTION, t, q, v, 0.0, a, w.lam)


@merged
def project(f, w, t, q, v, theta, a, lam):
    """Project (q, v) onto the constraints in place, and store `a` and lam; return a code. See `project_state`."""
    code = f.inner(f, w, tasks.PROJECT, t, q, v, theta, a, lam)
    if code == DONE and has_new_entries(w.G, w.pattern):
        code = f.inner(f, w, tasks.VERIFY_PATTERN, t, q, v, theta, a, lam)
    return code


@merged
def restore_constraints(f, w, t, q, v, tolerance):
    """Compute the dependent entries of q and v from the independent ones, up to rounding; return a code."""
    return f.inner(f, w, tasks.RESTORE, t, q, v, tolerance, w.x, w.lam)


@merged
def accelerations(f, w, t, q, v, a, lam):
    """Store the accelerations `a` and multipliers lam at a state from `restore_constraints`; return a code."""
    return f.inner(f, w, tasks.ACCELERATIONS, t, q, v, 0.0, a, lam)


@merged
def multipliers(f, w, t, q, v, a, lam):
    """Store in lam the multipliers that belong to `a`, the accelerations of the last evaluation; return a code."""
    return f.inner(f, w, tasks.MULTIPLIERS, t, q, v, 0.0, a, lam)


@merged
def find_tangents(f, w, t, q):
    """Store the null space of G at q in w.D, and the rows and their factors in w; return a code."""
    return f.inner(f, w, tasks.FIND_NULL_SPACE, t, q, q, 0.0, w.x, w.lam)


@merged
def prepare_mass(f, w, t, q):
    """Store M(t, q) in w by the task for this, and the factors of M if the form uses them; return a code."""
    return f.inner(f, w, tasks.PREPARE_MASS, t, q, q, 0.0, w.x, w.lam)


@merged
def renew_partition(f, w, t, q):
    """Choose a new partition at the position q of an accepted state, and store the sign of det C_qd; return a code."""
    return f.inner(f, w, tasks.RENEW_PARTITION, t, q, q, 0.0, w.x, w.lam)


@merged
def adopt_midpoint_partition(f, w, t_mid, state, new_state):
    """Adopt the partition that pivoting chooses at the middle of a step, see partition.py; return a code."""
    return f.inner(f, w, tasks.ADOPT_MIDPOINT, t_mid, state, new_state, 0.0, w.x, w.lam)


@merged
def check_redundant_rows(f, w, t, q, v):
    """Return DONE if the accepted state (q, v) satisfies the redundant rows, else ROWS_CONTRADICT."""
    return f.inner(f, w, tasks.CHECK_REDUNDANT, t, q, v, 0.0, w.x, w.lam)


@merged
def rounding_floor(q):
    """Return the largest change by an iteration that rounding of q may cause; below it, the iteration has converged."""
    return max(ROUNDING_OF_CORRECTIONS, ROUNDING_OF_Q * largest_of(q))


@kernel(INNER)
def generated_inner_loop(f, w, task, t, q, v, theta, a, lam):
    """Do a task by the code generated for the mechanism or, if it fails, by the general inner loop; return a code."""
    if task == tasks.EVALUATE_WITHOUT_PROJECTION:
        w.n_evaluations += 1
        w.n_factorizations += 1
        if f.own_accelerate(t, q, v, f.numbers, a):
            return DONE
    elif task == tasks.PROJECT:
        tolerance, last_correction = max(theta, MIN_CORRECTION * w.rounded), np.inf
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
        f.general(f, w, tasks.FIND_NULL_SPACE, t, q, v, theta, a, lam)  # stores the rows at q in w
    elif task <= tasks.MULTIPLIERS:  # tasks with a partition, for which there is no generated code
        w.used_general = 1.0
    return f.general(f, w, task, t, q, v, theta, a, lam)

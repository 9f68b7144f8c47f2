"""Solve for the stages of implicit Runge-Kutta steps by one of two fixed-point iterations, the outer loops.

`iterate_accelerations` iterates on the stage accelerations: from these, the tableau yields velocities and, applied
twice, positions. `iterate_first_order` is the loop of the paper on y_i = [v_i, q_i], the independent velocities and
positions. Richardson's error estimate is the difference between a step and two half steps. Equation numbers refer to
the paper; `f` is the kit, `w` the workspace.
"""

import numpy as np

from twoloop.kernels.control.step_size import project_prediction
from twoloop.kernels.data.common import compiled, exact, inlined, merged, typical_size
from twoloop.kernels.data.indices import ATOL, DONE, ESTIMATE, OUTER_DIVERGED, RTOL
from twoloop.kernels.evaluation.inner_loop import evaluate, restore_constraints, rounding_floor
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.steps.stages import INNER_TOL, OUTER_TEST, OUTER_TOL, tableau_of

# number of vectors of rounding errors: of q and v after the last accepted step, and of q and v after this attempt. Sums
# in steps of fixed size are compensated for these errors, because otherwise the energy of symmetric methods drifts
N_ROUNDING = 4

# indices of scalars in `memory`. HAS_TRIAL: 1 if a step was attempted, else 0. H_TRIAL: size (s) of the attempted step.
# HAS_PREVIOUS: 1 if a step was accepted, else 0. H_PREVIOUS: size (s) of the last accepted step
HAS_TRIAL, H_TRIAL, HAS_PREVIOUS, H_PREVIOUS, N_MEMORY_SCALARS = range(5)
# indices of blocks (s, n_q) in `memory`, a row for each stage: accelerations in the last accepted step (A_PREVIOUS), in
# the attempted step (A_TRIAL) and in a half step (A_HALF); positions (Q_STAGE) and velocities (V_STAGE)
A_PREVIOUS, A_TRIAL, A_HALF, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
# indices of vectors (n_q) in `memory`: positions Q_, velocities V_ and accelerations A_ at the end of the whole step
# (_FULL), after the first half step (_MID), before an iteration (_OLD); rounding errors (ROUNDING: first of N_ROUNDING)
Q_FULL, V_FULL, Q_MID, V_MID, A_MID, Q_OLD, V_OLD, ROUNDING, N_VECTORS = (*range(8), 7 + N_ROUNDING)


def memory_size(s: int, n_q: int) -> int:
    """Return the length of `memory` for s stages and n_q coordinates."""
    return N_MEMORY_SCALARS + N_BLOCKS * s * n_q + N_VECTORS * n_q + s


@inlined
def memory_block(memory, s, n, index):
    """Return a view (s, n) of block `index`, such as A_PREVIOUS, of `memory`."""
    start = N_MEMORY_SCALARS + index * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def memory_vector(memory, s, n, index):
    """Return a view (n) of vector `index`, such as Q_FULL, of `memory`."""
    start = N_MEMORY_SCALARS + N_BLOCKS * s * n + index * n
    return memory[start : start + n]


@inlined
def step_views(memory, s, n):
    """Return views of `memory`: the blocks A_TRIAL, A_HALF, Q_STAGE and V_STAGE, the vectors Q_FULL to V_MID."""
    return (
        memory_block(memory, s, n, A_TRIAL),
        memory_block(memory, s, n, A_HALF),
        memory_block(memory, s, n, Q_STAGE),
        memory_block(memory, s, n, V_STAGE),
        memory_vector(memory, s, n, Q_FULL),
        memory_vector(memory, s, n, V_FULL),
        memory_vector(memory, s, n, Q_MID),
        memory_vector(memory, s, n, V_MID),
    )


@inlined
def rounding_errors_of(memory, s, n, tolerances):
    """Return a view (N_ROUNDING, n) of the rounding errors in `memory`; unless the step size is fixed, it is empty."""
    start, count = N_MEMORY_SCALARS + (N_BLOCKS * s + ROUNDING) * n, N_ROUNDING if tolerances[ESTIMATE] == 0.0 else 0
    return memory[start : start + count * n].reshape((count, n))


MAX_ITERATIONS = 60  # number of iterations after which `iterate_accelerations` has failed
MAX_ITERATIONS_PAPER = 200  # number of iterations after which `iterate_first_order` has failed; the paper has no limit
MAX_GROWTH = 1e3  # an iteration has diverged if the stages change by more than this times their first change
MIN_ITERATIONS = 8  # after this number of iterations, a change that is not below the previous one means divergence
UNDECIDED, CONVERGED, DIVERGED = range(3)  # codes of `_test_convergence`


@merged
def _test_convergence(change, last_change, first_change, rounded, iteration, tolerance, q):
    """Decide whether an iteration has converged: return UNDECIDED, CONVERGED or DIVERGED.

    It has converged if the stages change by at most `tolerance`, or if this change does not decrease, and may be due
    to rounding errors of q. `rounded`: change relative to max(1, |value|), to be compared with rounding errors.
    """
    if change <= tolerance:
        return CONVERGED
    if not change <= MAX_GROWTH * first_change:
        return DIVERGED
    if change >= last_change:
        if rounded <= rounding_floor(q):
            return CONVERGED
        if iteration >= MIN_ITERATIONS:
            return DIVERGED
    return UNDECIDED


@exact
def _compensated_sum(x, rounding, increment):
    """Return x + (rounding + increment), and the rounding error of this sum (W. Kahan, Commun. ACM 8 (1965), 40)."""
    increment += rounding
    total = x + increment
    return total, increment - (total - x)


@merged
def _clear_rounding_errors(coordinates, rounding):
    """Set to 0 this attempt's recorded rounding errors of dependent `coordinates`, which the inner loop changes."""
    for i in range(N_ROUNDING // 2, rounding.shape[0]):
        for m in coordinates:
            rounding[i, m] = 0.0


@compiled
def iterate_accelerations(f, w, options, tolerances, t, h, q, v, A_stage, Q_stage, V_stage, q1, v1, rounding):
    """Compute a step of size h from (q, v) by iterating on stage accelerations; return a code and a position error.

    A_stage (s, n): predicted accelerations, on return final ones. (q1, v1) becomes the projected end of the step.
    The stages Q_j = q + c_j h v + h^2 sum_k (A A)_jk a_k and V_j = v + h sum_k A_jk a_k (A, c: Butcher tableau) satisfy
    eq. (17) of the paper. If `rounding` has rows, rounding errors of sums are compensated. The position error is
    `prediction_error` of q1. For undamped systems, one iteration gains as much as two by `iterate_first_order`.
    """
    s, A, A2, b, bA, c = tableau_of(options)
    n = q.size
    tolerance = options[INNER_TOL]
    for j in range(s):
        for m in range(n):
            total = 0.0
            for k in range(s):
                total += A2[j, k] * A_stage[k, m]
            Q_stage[j, m] = q[m] + c[j] * h * v[m] + h * h * total
    size_q, size_v = typical_size(tolerances, q), typical_size(tolerances, v)
    first_change = 0.0
    last_change = np.inf
    convergence = UNDECIDED
    for iteration in range(MAX_ITERATIONS):
        w.n_outer += 1
        # compute all stages before evaluating any: updating one stage after another (Gauss-Seidel) needs a smaller h
        for j in range(s):
            for m in w.independent:
                sum_q = 0.0
                sum_v = 0.0
                for k in range(s):
                    sum_q += A2[j, k] * A_stage[k, m]
                    sum_v += A[j, k] * A_stage[k, m]
                Q_stage[j, m] = q[m] + c[j] * h * v[m] + h * h * sum_q
                V_stage[j, m] = v[m] + h * sum_v
        change, rounded = 0.0, 0.0
        for j in range(s):
            code = evaluate(f, w, t + c[j] * h, Q_stage[j], V_stage[j], tolerance, q1)
            if code != DONE:
                return code, 0.0
            for m in w.independent:
                difference = h * abs(q1[m] - A_stage[j, m])
                size_Q, size_V = abs(Q_stage[j, m]), abs(V_stage[j, m])
                change = max(change, difference / max(size_V, size_v), h * difference / max(size_Q, size_q))
                rounded = max(rounded, difference / max(size_V, 1.0), h * difference / max(size_Q, 1.0))
            copy(q1, A_stage[j])
        if iteration == 0:
            first_change = change
        convergence = _test_convergence(change, last_change, first_change, rounded, iteration, options[OUTER_TOL], q)
        if convergence != UNDECIDED:
            break
        last_change = change
    if convergence != CONVERGED:
        return OUTER_DIVERGED, 0.0
    for m in range(n):
        sum_q = 0.0
        sum_v = 0.0
        for k in range(s):
            sum_q += bA[k] * A_stage[k, m]
            sum_v += b[k] * A_stage[k, m]
        if rounding.shape[0] == 0:
            q1[m] = q[m] + h * v[m] + h * h * sum_q
            v1[m] = v[m] + h * sum_v
        else:
            q1[m], rounding[2, m] = _compensated_sum(q[m], rounding[0, m], h * v[m] + h * h * sum_q)
            v1[m], rounding[3, m] = _compensated_sum(v[m], rounding[1, m], h * sum_v)
    _clear_rounding_errors(w.dependent, rounding)
    return project_prediction(f, w, tolerances, t + h, h, q, v, q1, v1, tolerance)


@merged
def _largest_change(coordinates, q, v, q_old, v_old):
    """Return the largest |change| / max(1, |value|) of `coordinates` and their velocities in an iteration."""
    change = 0.0
    for m in coordinates:
        change = max(change, abs(q[m] - q_old[m]) / max(abs(q[m]), 1.0))
        change = max(change, abs(v[m] - v_old[m]) / max(abs(v[m]), 1.0))
    return change


@compiled
def iterate_first_order(f, w, options, t, h, q, v, a, A_stage, Q_stage, V_stage, q_old, v_old, q1, v1):
    """Compute a step of size h by the paper's outer loop on y_i = [v_i, q_i] (independent entries); return a code.

    The loop starts from an Euler step, and ends by the tests (32) and (33) of the paper. `a`: accelerations at (t, q,
    v). Row j of A_stage and row j of V_stage form K_j = [a_j; v_j]. An iteration updates one stage after another, each
    with the latest K (Gauss-Seidel). (q1, v1) becomes the end of the step, on the constraints; q_old, v_old: scratch.
    """
    s, A, _, b, _, c = tableau_of(options)
    n = q.size
    tolerance = options[INNER_TOL]
    for m in range(n):
        q1[m] = q[m] + h * v[m]
        v1[m] = v[m] + h * a[m]
    code = evaluate(f, w, t + h, q1, v1, tolerance, A_stage[0])
    if code != DONE:
        return code
    for j in range(s):
        copy(A_stage[0], A_stage[j])
        copy(v1, V_stage[j])
        copy(q1, Q_stage[j])
    norm_before = np.inf
    for _ in range(MAX_ITERATIONS_PAPER):
        w.n_outer += 1
        for j in range(s):
            for m in w.independent:
                sum_q = 0.0
                sum_v = 0.0
                for k in range(s):
                    sum_q += A[j, k] * V_stage[k, m]
                    sum_v += A[j, k] * A_stage[k, m]
                Q_stage[j, m] = q[m] + h * sum_q
                V_stage[j, m] = v[m] + h * sum_v
            code = evaluate(f, w, t + c[j] * h, Q_stage[j], V_stage[j], tolerance, A_stage[j])
            if code != DONE:
                return code
        copy(q1, q_old)
        copy(v1, v_old)
        for m in w.independent:
            sum_q = 0.0
            sum_v = 0.0
            for k in range(s):
                sum_q += b[k] * V_stage[k, m]
                sum_v += b[k] * A_stage[k, m]
            q1[m] = q[m] + h * sum_q
            v1[m] = v[m] + h * sum_v
        code = restore_constraints(f, w, t + h, q1, v1, tolerance)
        if code != DONE:
            return code
        change = _largest_change(w.independent, q1, v1, q_old, v_old)
        if options[OUTER_TEST] == 1.0:
            change = max(change, _largest_change(w.dependent, q1, v1, q_old, v_old))
        if change <= options[OUTER_TOL]:  # the iteration has converged: test (32) of the paper
            return DONE
        norm = 0.0
        for m in range(n):
            norm += (q1[m] - q_old[m]) ** 2 + (v1[m] - v_old[m]) ** 2
        norm = np.sqrt(norm)
        if not norm <= norm_before:  # the iteration diverges: test (33) of the paper
            return OUTER_DIVERGED
        norm_before = norm
    return OUTER_DIVERGED


@compiled
def _richardson_error(tolerances, largest, q, v, q_full, v_full, q1, v1):
    """Return the norm of the difference between a step and two half steps, in units of the tolerances (eq. 26).

    (q, v) is the beginning, (q_full, v_full) the end of the step, and (q1, v1) the end of the half steps. The norm is
    the largest |component| of positions and velocities if `largest` is True, else their root mean square (eq. 27).
    """
    rtol = tolerances[RTOL]
    total = 0.0
    largest_component = 0.0
    for m in range(q.size):
        atol = tolerances[ATOL + m]
        component_q = (q_full[m] - q1[m]) / (atol + rtol * max(abs(q[m]), abs(q_full[m])))
        component_v = (v_full[m] - v1[m]) / (atol + rtol * max(abs(v[m]), abs(v_full[m])))
        total += component_q * component_q + component_v * component_v
        largest_component = max(largest_component, abs(component_q), abs(component_v))
    return largest_component if largest else np.sqrt(total / (2 * q.size))


@compiled
def estimate_and_extrapolate(f, w, factor, inner_tol, t, tolerances, q, v, q_full, v_full, q1, v1):
    """Return a code and Richardson's error estimate in tolerances; extrapolate if the estimate is at most 1.

    (q1, v1) is the end of two half steps, (q_full, v_full) the end of a whole step. Extrapolation adds to (q1, v1)
    `factor` = 1 / (2^order - 1) times (q1 - q_full, v1 - v_full), then projects. If `factor` is 0, do not extrapolate.
    """
    error = _richardson_error(tolerances, factor > 0.0, q, v, q_full, v_full, q1, v1)
    if not (factor > 0.0 and error <= 1.0):
        return DONE, error
    for m in range(q.size):
        q1[m] += factor * (q1[m] - q_full[m])
        v1[m] += factor * (v1[m] - v_full[m])
    return restore_constraints(f, w, t, q1, v1, inner_tol), error

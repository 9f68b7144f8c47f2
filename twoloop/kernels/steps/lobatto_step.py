"""Take implicit Runge-Kutta steps of order 16 at nine Lobatto nodes, with the paper's outer loop, in SIMD lanes.

As in the paper, a fixed-point iteration without a Jacobian solves for the stages; here it treats all stages at once.
The generated code of generate/collocation_code.py does the arithmetic; this module chooses the step size. (M. Antonana,
J. Makazaga and A. Murua use such an iteration for ordinary differential equations at high precision, arXiv 2511.03655.)

A sweep multiplies the distance of the stages from the solution by the contraction rho, which increases with the step
size and with the derivatives of the accelerations. The step size is limited in two ways:

- convergence: a target number of sweeps has to suffice;
- accuracy: the last Legendre coefficients of the accelerations have to be as small as the tolerance requires.

If convergence limits the step size, as in fast rotation or with damping, each sweep evaluates the accelerations twice
at the same positions, the second time at the velocities that follow from the first evaluation. What depends on
positions alone is evaluated once. The contraction is then approximately squared, unless positions dominate it.

The integrator calls `lobatto_step` for a single step, or `lobatto_steps` for several steps in a row if nothing has to
be checked between them. The ends of steps in a row are projected onto the constraints together, one in each lane.
"""

import math

import numpy as np

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.control.singular_positions import COLLAPSED_STEP, SHORT_STEP, SINGULAR_PIVOT
from twoloop.kernels.control.step_size import count_step, prediction_error, size_off_grid, store_prediction
from twoloop.kernels.data import collocation as field
from twoloop.kernels.data.collocation import CONVERGED, GUESSED, LANES, NOT_COMPUTED, REJECTED, array_offsets
from twoloop.kernels.data.common import (
    ATTEMPT,
    COMMIT,
    GAP_SLACK,
    MANY,
    Attempt,
    Step,
    allowed_error,
    compiled,
    inlined,
    kernel,
    merged,
)
from twoloop.kernels.data.indices import DEFECT_GAP, DONE, ESTIMATE, LEAST, OUTER_DIVERGED, SINGULAR, UNSUITED
from twoloop.kernels.evaluation.inner_loop import check_redundant_rows, project, renew_partition
from twoloop.kernels.evaluation.partition import projection_tolerance
from twoloop.kernels.linalg.dense import copy, largest_of

# indices in `options`
(
    THETA,  # a projection has converged if its last correction is at most this, see `project`
    N_ITERATED,  # number of coordinates on which accelerations depend; only these change in the fixed-point iteration
    N_ROWS,  # number of constraints
    FREE,  # the defect is also evaluated between nodes if step size > FREE * (longest time between evaluations)
    MAY_REPEAT,  # 1: sweeps may evaluate accelerations twice; 0: only once, as the second time would cost as much
    N_OPTIONS,
) = range(6)

START_CONTRACTION = 0.12  # the first step size is guessed so that a sweep multiplies errors of the stages by this
MAX_GUESSES = 4  # largest number of guesses of the first step size
FACTOR_AFTER_DIVERGENCE = 0.6  # ratio of the next step size to the size of a step whose iteration did not converge
SAFETY = 0.75  # safety factor on the step size for which the estimated error would equal the tolerance
# at this count, another method takes over: a step limited by convergence adds 1, any other subtracts 1 (not below 0)
MAX_LIMITED = 24.0
# accelerations hardly vary in a step if the Legendre coefficients of degrees 5 and 6 are below this many tolerances
MIN_CURVATURE = 0.1
N_PIVOT_PARTS = 4  # pivots of C_q are checked at 1/4, 1/2 and 3/4 of a step, the ends of this number of equal parts
MIN_PIVOT_RATIO = 0.4  # another method takes over if a step multiplies the smallest pivot of C_q by less than this
# if the smallest tolerance is below this, another method takes over once a singular position was near. Without this
# rule, five more runs of the benchmark A02 (N-four-bar mechanism) end with wrong results
TIGHT_TOLERANCE = 1e-8
MAX_FAILURES = 12.0  # at this count, another method takes over: unconverged steps add 2, accepted steps subtract 1
CHECKED_GAP = 0.0908  # (longest time between evaluations) / (step size), if the defect is evaluated between nodes, too
# largest ratio of successive step sizes: GROWTH_EARLY in the first N_EARLY steps of a run, GROWTH in later steps
N_EARLY, GROWTH_EARLY, GROWTH = 6, 4.0, 1.3
GROWTH_ONE_SWEEP = 30.0  # largest ratio of step sizes early in a run, after a step that took only one sweep
MIN_FACTOR = 0.4  # smallest ratio of the next step size to the size of an accepted step
LEAST_TREND = 0.4  # lower limit of `trend`: (size that a step's error allows) / (size that the previous error allowed)
GAIN_BY_REPEATS = 1.5  # (step size that converges with two evaluations of accelerations per sweep) / (size with one)
# sweeps no longer evaluate accelerations twice (REPEATS = 0) if (step size that convergence allows) / (step size that
# the error estimate allows) exceeds this: second evaluations then save no time
MAX_REACH = 2.5
MAX_EXTRAPOLATION = 3.0  # upper limit of (step size that the error of a step allows) / (size of this step)
_array_offsets = merged(array_offsets)


def memory_size(n, n_iterated, n_rows):
    """Return the length of `memory`, including LANES numbers for its alignment; n: number of coordinates."""
    return array_offsets(n, n_iterated, n_rows)[-1] + LANES


@inlined
def _aligned_view(memory):
    """Return a view of `memory` that begins at its first address divisible by the size of LANES numbers."""
    return memory[(-(memory.ctypes.data >> 3)) & (LANES - 1) :]


@merged
def _reuse_rejected_polynomial(f, data, state):
    """After a rejected step, use the polynomial of its accelerations to predict the stages of the next attempt."""
    f.retry_nodes(data, state)
    if data[field.OLD_DEGREE] == 0.0:
        data[field.OLD_DEGREE] = max(data[field.DEGREE], 3.0)
    data[field.DEGREE], data[field.H_BEFORE], data[field.PREDICTS] = 8.0, data[field.H], 1.0


@compiled
def _solve_collocation(f, w, options, data, tolerances, t, h, state):
    """Solve for the stages of a step of size h; return a code, an error estimate, and the factor (next step size) / h.

    The stages are stored in `data`, the memory of the method. The estimate is relative to the tolerances. Codes:
    CONVERGED; REJECTED if the estimate or the defect is too large, or the iteration diverges; GUESSED if h, a guess of
    the first step size, is poor (the caller tries h * factor); NOT_COMPUTED if accelerations cannot be computed.
    """
    is_first, is_estimated = data[field.PREDICTS] == 0.0, tolerances[ESTIMATE] == 1.0
    h_max = tolerances[DEFECT_GAP] / CHECKED_GAP
    if is_estimated and h > h_max * (1.0 + GAP_SLACK):
        return REJECTED, h / h_max, h_max / h
    data[field.T], data[field.H], data[field.DEFECT] = t, h, -1.0
    data[field.MAY_GUESS] = 0.0
    if is_first:
        data[field.H_BEFORE], data[field.DEGREE], data[field.RHO] = h, 0.0, START_CONTRACTION
        data[field.MAY_GUESS] = 1.0 if is_estimated and data[field.N_GUESSES] < MAX_GUESSES else 0.0
    result = int(f.attempt_nodes(data, state, tolerances, f.own_numbers))
    n_sweeps = int(data[field.SWEEPS])
    w.n_outer += n_sweeps
    w.n_evaluations += LANES * n_sweeps * (1 + int(data[field.REPEATS]))
    w.n_factorizations += LANES * n_sweeps
    if result == GUESSED:
        data[field.N_GUESSES] += 1.0
        return result, 2.0, min(max(START_CONTRACTION / data[field.RHO], 0.05), 30.0)
    if result != CONVERGED:
        data[field.FAILURES] += 2.0
        return result, 2.0, FACTOR_AFTER_DIVERGENCE
    if not is_estimated:
        return CONVERGED, 0.0, 1.0
    error = data[field.ERROR]
    if not error <= 1.0:
        _reuse_rejected_polynomial(f, data, state)
        return REJECTED, error, min(max(0.9 * data[field.FACTOR_OF_ERROR], 0.3), 0.9)
    max_factor = GROWTH_EARLY if data[field.N_STEPS] < N_EARLY else GROWTH
    if max_factor > GROWTH and n_sweeps == 1:
        max_factor = GROWTH_ONE_SWEEP
    if h > options[FREE] * tolerances[DEFECT_GAP] * (1.0 + GAP_SLACK):
        w.n_evaluations += LANES
        defect = f.audit_nodes(data, state, f.own_numbers)
        if defect < 0.0:
            return NOT_COMPUTED, 2.0, FACTOR_AFTER_DIVERGENCE
        factor_by_defect = 0.9 * data[field.FACTOR_OF_DEFECT]
        if defect > 1.0:
            _reuse_rejected_polynomial(f, data, state)
            return REJECTED, defect, max(0.3, factor_by_defect)
        data[field.DEFECT] = defect
        max_factor = min(max_factor, factor_by_defect)
    max_factor = min(max_factor, h_max / h)
    extra_sweeps = data[field.SWEEPS] - data[field.N_TARGET]
    # the motion may be stiff if accelerations hardly vary, but the number of sweeps is at least its target value - 1
    is_limited = data[field.CURVATURE] < MIN_CURVATURE and extra_sweeps >= -1.0
    data[field.LIMITED] = max(0.0, data[field.LIMITED] + (1.0 if is_limited else -1.0))
    # `trend`: (size that this step's error allows) / (size that the previous step's error allowed). A trend below 1
    # probably continues, so the next step size is multiplied by the trend
    h_allowed = h * min(data[field.FACTOR_OF_ERROR], MAX_EXTRAPOLATION)
    if error > 1e-6 and data[field.CURVATURE] >= MIN_CURVATURE:
        trend = 1.0 if is_first else min(max(h_allowed / data[field.ALLOWED_H], LEAST_TREND), 1.0)
        max_factor = min(max_factor, max(SAFETY * trend * data[field.FACTOR_OF_ERROR], MIN_FACTOR))
    data[field.ALLOWED_H] = h_allowed
    if extra_sweeps > 1.0:
        max_factor = min(max_factor, 0.9)
    factor = max(data[field.FACTOR], MIN_FACTOR)
    if data[field.REPEATS] == 1.0:
        if is_limited or h * factor > MAX_REACH * h_allowed:
            # with one evaluation per sweep, the contraction RHO is about the square root of its value with two
            data[field.REPEATS], data[field.RHO] = 0.0, math.sqrt(data[field.RHO])
    elif options[MAY_REPEAT] == 1.0 and factor < max_factor and not is_limited:
        data[field.REPEATS] = 1.0
        factor *= GAIN_BY_REPEATS
    return CONVERGED, error, min(factor, max_factor)


@merged
def _accept_polynomial(data):
    """After an accepted step, use the polynomial of its accelerations to predict the stages of the next step."""
    if data[field.OLD_DEGREE] > 0.0:
        data[field.NEXT_DEGREE], data[field.OLD_DEGREE] = data[field.OLD_DEGREE], 0.0
    data[field.CURRENT] = 1.0 - data[field.CURRENT]
    data[field.DEGREE], data[field.H_BEFORE] = data[field.NEXT_DEGREE], data[field.H]
    data[field.PREDICTS], data[field.FAILURES] = 1.0, max(0.0, data[field.FAILURES] - 1.0)
    data[field.N_STEPS] += 1.0


@merged
def _must_change_method(w, data, tolerances):
    """Return True if another method must take over: if stiffness limits the steps, or a singular position is near."""
    is_stiff = data[field.LIMITED] >= MAX_LIMITED or data[field.FAILURES] >= MAX_FAILURES
    is_near = w.near_now == 1.0 or tolerances[LEAST] < TIGHT_TOLERANCE
    return is_stiff or (w.nearly_singular == 1.0 and is_near)


@compiled
def _passes_singular_position(f, w, t, h, state, new_state):
    """Return True if, in a step, the smallest pivot of C_q falls below MIN_PIVOT_RATIO times its value at the start.

    Another method then has to cross the singular position: near it, stages that violate the constraints have wrong
    accelerations. Positions within the step follow from the cubic through positions and velocities at both ends.
    """
    n, pivot = w.Q.size, w.pivot
    for k in range(1, N_PIVOT_PARTS):
        s = k / N_PIVOT_PARTS
        rest = 1.0 - s
        for m in range(n):
            q0, v0, q1, v1 = state[m], h * state[n + m], new_state[m], h * new_state[n + m]
            w.y[m] = q0 + s * s * (3.0 - 2.0 * s) * (q1 - q0) + s * rest * (rest * v0 - s * v1)
        if renew_partition(f, w, t + s * h, w.y) != DONE or w.pivot < MIN_PIVOT_RATIO * pivot:
            return True
    return False


@kernel(COMMIT)
def commit_lobatto(f, w, options, memory, tolerances, accepted):
    """After an accepted attempt, keep the polynomial of its accelerations to predict the next step; else discard it."""
    data = _aligned_view(memory)
    if accepted and data[field.TRIED] == 1.0:
        _accept_polynomial(data)
    data[field.TRIED] = 0.0


@kernel(ATTEMPT)
def lobatto_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """Attempt one step of size h, and project its end onto the constraints."""
    data, n = _aligned_view(memory), w.Q.size
    data[field.TRIED] = 0.0
    if tolerances[ESTIMATE] == 1.0 and _must_change_method(w, data, tolerances):
        return Attempt(UNSUITED, math.inf, 0.0)
    result, error, factor = _solve_collocation(f, w, options, data, tolerances, t, h, state)
    if result == NOT_COMPUTED or (result == REJECTED and tolerances[ESTIMATE] == 0.0):
        return Attempt(OUTER_DIVERGED, math.inf, 0.0)
    if result != CONVERGED:
        return Attempt(DONE, error, factor)
    w.defect = data[field.DEFECT]
    f.end_nodes(data, state, new_state)
    data[field.TRIED] = 1.0
    q1, v1, a1, lam1 = new_state[:n], new_state[n : 2 * n], new_state[2 * n : 3 * n], new_state[3 * n :]
    store_prediction(w, q1)
    code = project(f, w, t + h, q1, v1, options[THETA], a1, lam1)
    if code == DONE:
        error = max(error, prediction_error(w, tolerances, h, state[:n], state[n : 2 * n], q1))
    if code == DONE and error <= 1.0 and w.nearly_singular == 1.0 and tolerances[ESTIMATE] == 1.0:
        w.near_now = 2.0  # 2: after the step, `check_partition` renews the partition and checks its pivots
        if _passes_singular_position(f, w, t, h, state, new_state):
            code = SINGULAR
    return Attempt(code, error, factor if error <= 1.0 else 0.0)


@merged
def _project_ends(f, w, options, data, n, n_ends, out_t, out_state):
    """Project the ends of n_ends steps onto the constraints at once, each in one lane; `data` receives the results.

    The ends are the first rows of `out_state`, at the times `out_t`. Results of a lane: projected state, accelerations,
    multipliers, and at VALID 1 if the projection converged, else 0.
    """
    begin_ends = _array_offsets(n, int(options[N_ITERATED]), int(options[N_ROWS]))[5]
    for k in range(LANES):
        row = min(k, n_ends - 1)
        data[begin_ends + k] = out_t[row]
        for i in range(2 * n):
            data[begin_ends + LANES * (1 + i) + k] = out_state[row, i]
        data[field.VALID + k] = 1.0
    largest_q = 0.0
    for row in range(n_ends):
        largest_q = max(largest_q, largest_of(out_state[row, :n]))
    tolerance = projection_tolerance(w, options[THETA], largest_q)
    f.correct_ends(data, f.own_numbers)
    for _ in range(4):
        f.project_ends(data, f.own_numbers)
        w.n_inner += n_ends
        w.n_factorizations += n_ends
        largest_move = 0.0
        for k in range(n_ends):
            largest_move = max(largest_move, data[field.MOVED + k])
        if largest_move <= tolerance:
            break
    for k in range(n_ends):
        if not data[field.MOVED + k] <= tolerance:
            data[field.VALID + k] = 0.0


@merged
def _adopt_projection(f, w, options, data, tolerances, driven, n, k, t, row, state):
    """Copy the projected state in lane k of `data` to `row` and `state`; but if it is invalid, return False.

    The state is invalid if the projection has failed or changed the positions in `row` by more than the tolerances, or
    if redundant rows are violated. If constraints depend on time (`driven`), the tolerances also limit the change of
    velocities: a larger one would show a discontinuity of the drive between the nodes, see discontinuities.py.
    """
    _, _, _, _, _, ends, end_a, lam, _ = _array_offsets(n, int(options[N_ITERATED]), int(options[N_ROWS]))
    if data[field.VALID + k] == 0.0:
        return False
    for i in range(n):
        q = data[ends + LANES * (1 + i) + k]
        if not abs(q - row[i]) <= allowed_error(tolerances, i, q, q):
            return False
        v = data[ends + LANES * (1 + n + i) + k]
        if driven and not abs(v - row[n + i]) <= allowed_error(tolerances, i, v, v):
            return False
    for i in range(n):
        row[i], row[n + i] = data[ends + LANES * (1 + i) + k], data[ends + LANES * (1 + n + i) + k]
        row[2 * n + i] = data[end_a + LANES * i + k]
    for i in range(state.size - 3 * n):
        row[3 * n + i] = data[lam + LANES * i + k]
    if w.rows_v.size < w.Rate.size:
        w.used_general = 0.0
        if check_redundant_rows(f, w, t, row[:n], row[n : 2 * n]) != DONE:
            return False
    copy(row, state)
    return True


@merged
def _can_take_next_step(w, data, tolerances, control, clock, h):
    """Return False if the integrator must act before the next step: if h is too small, or the method must change."""
    h_long = clock[at.H_LONG]
    if h <= control[at.SHORTEST] or h < COLLAPSED_STEP * h_long or _must_change_method(w, data, tolerances):
        return False
    is_near = control[at.MAY_CROSS] == 1.0 and w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]
    return not (is_near and h < SHORT_STEP * h_long)


@merged
def _take_steps(f, w, options, data, tolerances, control, clock, goal, state, n_most, out_t, out_state, out_steps):
    """Take at most n_most steps up to the time `goal`, without projection; store their ends; return their number."""
    n, t, n_ends = w.Q.size, clock[at.T], 0
    while n_ends < n_most and t < goal:
        h_wanted = min(clock[at.H_NEXT], control[at.MAX_STEP])
        if not _can_take_next_step(w, data, tolerances, control, clock, h_wanted):
            break
        h, reaches_goal = size_off_grid(control, t, h_wanted, goal - t, False)
        if reaches_goal:
            h = goal - t
        elif h == 0.0:  # the size rounds to zero
            break
        result, _, factor = _solve_collocation(f, w, options, data, tolerances, t, h, state)
        if result == NOT_COMPUTED:
            break
        if result != CONVERGED:
            clock[at.H_NEXT] = h * factor if result == GUESSED else min(h * factor, h - np.spacing(abs(t + h)))
            w.n_rejected_error += 1 if result == REJECTED else 0
            continue
        f.end_nodes(data, state, state)
        _accept_polynomial(data)
        t = goal if reaches_goal else t + h
        out_t[n_ends], out_steps[n_ends, at.H] = t, h
        data[field.DEFECTS + n_ends] = data[field.DEFECT]
        copy(state[: 2 * n], out_state[n_ends, : 2 * n])
        # if this step was shortened to end at `goal`, the next step may have the intended size, `h_wanted`
        clock[at.H_NEXT] = max(h * factor, h_wanted) if h < h_wanted else h * factor
        n_ends += 1
    return n_ends


@kernel(MANY)
def lobatto_steps(
    f, w, options, memory, tolerances, control, clock, goal, state, new_state, out_t, out_state, out_steps
):
    """Take at most LANES successive steps, and project their ends together; return the number of accepted steps.

    The last step is the one that makes the run's number of accepted steps a multiple of LANES. So results do not depend
    on where the integrator pauses, for example to look for Ctrl-C: the same steps are always projected together.
    """
    data, n = _aligned_view(memory), w.Q.size
    if out_t.size < LANES or w.nearly_singular == 1.0:
        return 0
    if control[at.FIRST_GIVEN] == 1.0:
        data[field.N_GUESSES] = MAX_GUESSES
    n_most = LANES - w.n_accepted % LANES
    if n_most > control[at.MAX_STEPS] - w.n_accepted:
        n_most = int(control[at.MAX_STEPS]) - w.n_accepted
    copy(state, new_state)
    driven = control[at.MAY_JUMP] == 1.0
    n_ends = _take_steps(
        f, w, options, data, tolerances, control, clock, goal, state, n_most, out_t, out_state, out_steps
    )
    if n_ends == 0:
        return 0
    _project_ends(f, w, options, data, n, n_ends, out_t, out_state)
    for k in range(n_ends):
        h = out_steps[k, at.H]
        if not _adopt_projection(f, w, options, data, tolerances, driven, n, k, out_t[k], out_state[k], state):
            if k == 0:
                copy(new_state, state)
            clock[at.H_NEXT], data[field.PREDICTS] = FACTOR_AFTER_DIVERGENCE * h, 0.0
            return k
        clock[at.T] = out_t[k]
        w.defect, w.orientation_new = data[field.DEFECTS + k], 0.0
        count_step(w, tolerances, control, clock, h, out_steps[k])
    return n_ends


LOBATTO = Step(lobatto_step, commit_lobatto, lobatto_steps)

"""Check, between steps, whether the partition is poor and whether a singular position is near, by pivots of C_q."""

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.indices import AUGMENTED, DONE, FIXED_ORDER, LEAST, NULL_SPACE
from twoloop.kernels.evaluation.inner_loop import find_tangents, renew_partition
from twoloop.kernels.evaluation.partition import MAX_ROWS_ELIMINATED, min_pivot_ratio, partition_is_poor, smallest_pivot
from twoloop.kernels.evaluation.sparse_inner_loop import PROJECT_STAGES

SHORT_STEP = 0.5  # check for a singular position if a step is shorter than this fraction of the longest recent step
COLLAPSED_STEP = 0.2  # compute the pivots of C_q anew if a step is shorter than this fraction of the longest recent one
# a singular position counts as near if the smallest pivot of C_q is below this fraction of its maximum in the run
SINGULAR_PIVOT = 0.2
# value used instead of SINGULAR_PIVOT in the fixed-order form, whose pivots are sines of angles between rows of C_q
FIXED_ORDER_SINGULAR = 0.01
# fixed-order form: if the smallest pivot is below this fraction of its maximum in the run, a rejected or failed step is
# repeated with its stages projected onto the constraints
REPEAT_PIVOT = 0.05
SHRINKAGE = 0.8  # if a step with projected stages is rejected or fails, it is repeated with this fraction of its size
MIN_STEP_NEAR_SINGULAR = 0.001  # shortest useful step near a singular position, relative to the longest recent step
# if no crossing can be attempted, the run ends when the smallest pivot is below this fraction of its maximum in the run
UNDETERMINED_PIVOT = 1e-6
CHECK_INTERVAL = 16  # steps of generated code need no partition, so only one in this number of such steps checks it
# in the augmented form, with n degrees of freedom, the partition is checked every 1 + n // FREEDOMS_PER_CHECK steps,
# because each check computes the null space of [C_q; A], a dense matrix that steps in this form do not need
FREEDOMS_PER_CHECK = 32
N_CHECKED_PARTS = 8  # number of equal parts of a step between which `comes_near_singular` computes the smallest pivot
# pivots within a step are computed if the smallest pivot at one of its ends is below this part of clock[LARGEST_PIVOT]
MAX_UNCHECKED_PIVOT = 0.5
# `comes_near_singular` samples the smallest pivot in a step. The pivot may be zero between two samples if one sample is
# below this fraction of the largest difference of successive samples
PASSED_PIVOT_RATIO = 0.6
# `near_pivot_ratio` returns at least MIN_NEAR_RATIO and at most MAX_NEAR_RATIO. MAX_ROUNDING_ERROR: rounding error, in
# tolerances, that is allowed near a singular position. EPS: unit roundoff
MIN_NEAR_RATIO, MAX_NEAR_RATIO, MAX_ROUNDING_ERROR, EPS = 0.02, 0.1, 0.2, 2.0**-53
MIN_END_RATIO = 0.25  # `ends_near_singular` is True only if the smallest pivot is below this part of clock[PIVOT_HERE]


@merged
def is_near_singular(f, w, control, clock, t, q):
    """Return True if a singular position is near the accepted position q at time t, and control[MAY_CROSS] is 1.

    A singular position is near if the smallest pivot of C_q is small, or if no partition can be chosen. Compute this
    pivot for a new partition if its last value, w.pivot, is small or may be old: generated code took the last steps, or
    steps have a fixed size.
    """
    if control[at.MAY_CROSS] != 1.0:
        return False
    is_old = control[at.FIXED_STEP] > 0.0 or (f.is_generated == 1 and w.nearly_singular == 1.0)
    if not is_old and w.pivot >= SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
        return False
    return renew_partition(f, w, t, q) != DONE or w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]


@merged
def ends_near_singular(f, w, control, clock):
    """Return True if a step of the fixed-order form ends so near a singular position that no step should begin there.

    The caller then repeats the step with another size, because a singular position within a step does no harm. Return
    False for steps of fixed size, or if the smallest pivot has not become much smaller within the step.
    """
    if f.form != FIXED_ORDER or control[at.FIXED_STEP] > 0.0:
        return False
    return w.pivot < min(FIXED_ORDER_SINGULAR * clock[at.LARGEST_PIVOT], MIN_END_RATIO * clock[at.PIVOT_HERE])


@merged
def is_too_short_near_singular(f, clock, size):
    """Return True if a failed step of the fixed-order form is near a singular position and too short to be repeated."""
    is_near = clock[at.PIVOT_HERE] < FIXED_ORDER_SINGULAR * clock[at.LARGEST_PIVOT]
    return f.form == FIXED_ORDER and is_near and size < MIN_STEP_NEAR_SINGULAR * clock[at.H_LONG]


@merged
def prepare_projected_repetition(f, w, control, clock, size):
    """Return True and prepare a repetition if a step of the fixed-order form did not succeed near a singular position.

    Near this position, stages that violate the constraints have inaccurate accelerations: set w.nearly_singular so that
    stages are projected. Store the step size in clock[H_NEXT]. The first repetition is at least as long as the longest
    recent step, clock[H_LONG], because it may succeed if it ends well beyond the position; each further one is shorter.
    """
    is_near = clock[at.PIVOT_HERE] < REPEAT_PIVOT * clock[at.LARGEST_PIVOT]
    if f.form != FIXED_ORDER or control[at.FIXED_STEP] > 0.0 or w.nearly_singular == 1.0 or not is_near:
        return False
    clock[at.H_NEXT] = SHRINKAGE * size
    if w.nearly_singular == 0.0:
        w.nearly_singular = PROJECT_STAGES
        clock[at.H_NEXT] = max(size, clock[at.H_LONG])
    clock[at.H_LIMIT] = max(clock[at.H_LIMIT], clock[at.H_NEXT])
    return True


@merged
def near_pivot_ratio(tolerances):
    """Return the ratio pivot / clock[LARGEST_PIVOT] below which rounding errors may exceed MAX_ROUNDING_ERROR."""
    return min(max(MIN_NEAR_RATIO, (EPS / (MAX_ROUNDING_ERROR * tolerances[LEAST])) ** (1.0 / 3.0)), MAX_NEAR_RATIO)


@compiled
def _smallest_pivot_within_step(f, w, t, size, before, end, state, new_state):
    """Sample the smallest pivot of C_q within a step; return the least sample, and the largest change between samples.

    The step of size `size` (s) leads from `state`, at t, to `new_state`. `before` and `end` are the samples at these
    states. The other samples are at positions on the cubic curve through these states.
    """
    n, least, change = w.Q.size, min(before, end), 0.0
    for k in range(1, N_CHECKED_PARTS):
        s = k / N_CHECKED_PARTS
        rest = 1.0 - s
        for m in range(n):
            q0, v0, q1, v1 = state[m], size * state[n + m], new_state[m], size * new_state[n + m]
            w.y[m] = q0 + s * s * (3.0 - 2.0 * s) * (q1 - q0) + s * rest * (rest * v0 - s * v1)
        pivot = smallest_pivot(f, w, t + s * size, w.y)
        change = max(change, abs(pivot - before))
        least, before = min(least, pivot), pivot
    return least, max(change, abs(end - before))


@compiled
def comes_near_singular(f, w, control, clock, tolerances, t, size, state, new_state):
    """Return True if a step with a small error estimate comes so near a singular position that it must be discarded.

    Rounding errors of the stages may then exceed the tolerances. Only runs that have come near a singular position
    are checked. If control[MAY_CROSS] is SUSPENDED, return False, and record the smallest pivot in clock[PIVOT_PASSED].
    If the pivots at both ends of the step are large, set control[MAY_CROSS] to 1.
    """
    may_cross = control[at.MAY_CROSS]
    if may_cross == 0.0 or control[at.CHECKS_WITHIN] == 0.0 or w.nearly_singular != 1.0 or control[at.FIXED_STEP] > 0.0:
        return False
    if f.form == FIXED_ORDER or w.rows_v.size > MAX_ROWS_ELIMINATED:
        return False
    n, largest = w.Q.size, clock[at.LARGEST_PIVOT]
    before = smallest_pivot(f, w, t, state[:n])
    end = smallest_pivot(f, w, t + size, new_state[:n])
    w.pivot = end
    if min(before, end) > MAX_UNCHECKED_PIVOT * largest:
        control[at.MAY_CROSS] = 1.0
        return False
    least, change = _smallest_pivot_within_step(f, w, t, size, before, end, state, new_state)
    if may_cross == at.SUSPENDED:
        min_ratio = max(least / largest, EPS)
        clock[at.PIVOT_PASSED] = min_ratio if clock[at.PIVOT_PASSED] == 0.0 else min(clock[at.PIVOT_PASSED], min_ratio)
        return False
    if least < max(near_pivot_ratio(tolerances) * largest, min(PASSED_PIVOT_RATIO * change, SINGULAR_PIVOT * largest)):
        w.pivot = before
        return True
    return False


@merged
def record_pivot_at_output(f, w, clock, state):
    """Set clock[PIVOT_AT_OUTPUT] to the smaller of its value and the pivot ratio at `state`, see `min_pivot_ratio`."""
    pivot = min_pivot_ratio(f, w, clock[at.T], state[: w.Q.size])
    if f.form == FIXED_ORDER and pivot > 0.0:
        # pivots of the fixed-order form are sines of angles between rows, all small in large mechanisms. So a singular
        # position is near only if the smallest pivot is far below clock[LARGEST_PIVOT], its largest value so far
        pivot /= max(pivot, clock[at.LARGEST_PIVOT])
    clock[at.PIVOT_AT_OUTPUT] = min(clock[at.PIVOT_AT_OUTPUT], pivot)


@merged
def check_partition(f, w, control, clock, size, at_output, state):
    """After a step, choose a new partition if the present one is poor, and check the pivots; return a code.

    Codes: CONTINUE, RANK_LOST (no partition can be chosen), MET_SINGULAR, NEAR_SINGULAR. `size`: size (s) of the step.
    `at_output`: True if the step ended at an output time, and may be short for this reason alone.
    """
    met_before = w.nearly_singular != 0.0 or control[at.MAY_CROSS] == 0.0 or control[at.FIXED_STEP] > 0.0
    short = size < SHORT_STEP * clock[at.H_LONG] and control[at.FIXED_STEP] == 0.0 and not at_output
    if f.form == FIXED_ORDER:
        clock[at.PIVOT_HERE] = w.pivot
        clock[at.LARGEST_PIVOT] = max(clock[at.LARGEST_PIVOT], w.pivot)
        if w.nearly_singular == PROJECT_STAGES and w.pivot >= REPEAT_PIVOT * clock[at.LARGEST_PIVOT]:
            w.nearly_singular = 0.0
        return at.CONTINUE
    n = w.Q.size
    uses_generated_code = f.is_generated == 1 and w.used_general == 0.0
    interval = 1
    if f.form == AUGMENTED:
        interval += w.independent_v.size // FREEDOMS_PER_CHECK
    if uses_generated_code:
        interval = CHECK_INTERVAL
    is_checked = w.n_accepted % interval == 0
    if is_checked and (uses_generated_code or f.form != NULL_SPACE):
        find_tangents(f, w, clock[at.T], state[:n])
    if is_checked and partition_is_poor(w) and renew_partition(f, w, clock[at.T], state[:n]) != DONE:
        return at.RANK_LOST
    # w.near_now is 2 if a step of generated code, which does not update w.pivot, requests this pivot
    if f.is_generated == 1 and w.near_now == 2.0 and renew_partition(f, w, clock[at.T], state[:n]) != DONE:
        return at.RANK_LOST
    clock[at.LARGEST_PIVOT] = max(clock[at.LARGEST_PIVOT], w.pivot)
    w.near_now = 0.0
    if w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
        w.nearly_singular = w.near_now = 1.0
    if size < COLLAPSED_STEP * clock[at.H_LONG] and w.nearly_singular == 0.0 and control[at.MAY_CROSS] == 1.0:
        # w.pivot was computed when the partition was chosen: an old value may hide that a singular position is near
        if renew_partition(f, w, clock[at.T], state[:n]) != DONE:
            return at.RANK_LOST
        w.sensitivity = 1.0  # the least possible value, with which `partition_is_poor` returns True soonest
        if w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
            w.nearly_singular = w.near_now = 1.0
    if short and size < MIN_STEP_NEAR_SINGULAR * clock[at.H_LONG] and w.nearly_singular == 1.0:
        # renew the partition: if it was chosen at a distant state, steps of an implicit method may become too short
        if renew_partition(f, w, clock[at.T], state[:n]) != DONE:
            return at.RANK_LOST
        if control[at.MAY_CROSS] != 1.0 and w.pivot < UNDETERMINED_PIVOT * clock[at.LARGEST_PIVOT]:
            return at.RANK_LOST  # steps across the singular position would be determined by rounding errors
    if w.nearly_singular == 1.0 and not met_before:
        return at.MET_SINGULAR
    return at.NEAR_SINGULAR if short and is_near_singular(f, w, control, clock, clock[at.T], state[:n]) else at.CONTINUE

"""Check the partition and the distance from a singular position between the steps of a run."""

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.data.common import compiled, merged
from twoloop.kernels.data.indices import AUGMENTED, DONE, FIXED_ORDER, LEAST, NULL_SPACE
from twoloop.kernels.evaluation.inner_loop import find_tangents, renew_partition
from twoloop.kernels.evaluation.partition import MAX_ROWS_ELIMINATED, min_pivot_ratio, partition_is_poor, smallest_pivot
from twoloop.kernels.evaluation.sparse_inner_loop import PROJECT_STAGES

SHORT_STEP = 0.5  # a singular position is suspected if a step is below this fraction of the longest of the last steps
# pivots of C_q are computed anew if a step is below this fraction of the longest of the last steps
COLLAPSED_STEP = 0.2
# a singular position is near if the smallest pivot of C_q is below this fraction of its maximum so far
SINGULAR_PIVOT = 0.2
# replaces SINGULAR_PIVOT in the fixed-order form, whose pivots are sines of angles between rows
FIXED_ORDER_SINGULAR = 0.01
# the fixed-order form repeats rejected steps with projected stages if the pivot is below this fraction of the largest
REPEAT_PIVOT = 0.05
SHRINKAGE = 0.8  # size of a step repeated with projected stages, relative to the rejected step
MIN_STEP_NEAR_SINGULAR = 0.001  # smallest step size near a singular position, relative to the longest recent step
# the run ends if the smallest pivot is below this fraction of its maximum so far: rounding spoils accelerations
UNDETERMINED_PIVOT = 1e-6
CHECK_INTERVAL = 16  # number of accepted steps between two checks of a partition that generated code does not use
# the augmented form checks a partition every 1 + n // FREEDOMS_PER_CHECK steps for n degrees of freedom, because a
# check computes the full matrix T
FREEDOMS_PER_CHECK = 32
N_CHECKED_PARTS = 8  # number of equal parts of an accepted step, at whose ends the smallest pivot of C_q is computed
# a step is checked if the pivot at one of its ends is below this fraction of the largest so far
MAX_UNCHECKED_PIVOT = 0.5
# the smallest pivot counts as zero in a step if a sample is below this fraction of its largest change between samples
PASSED_PIVOT_RATIO = 0.6
# MIN_NEAR_RATIO, MAX_NEAR_RATIO: smallest and largest result of near_pivot_ratio; MAX_ROUNDING_ERROR: allowed rounding
# error, in tolerances; EPS: unit roundoff
MIN_NEAR_RATIO, MAX_NEAR_RATIO, MAX_ROUNDING_ERROR, EPS = 0.02, 0.1, 0.2, 2.0**-53
MIN_END_RATIO = 0.25  # fixed-order form: a step is halved if its last pivot is below this fraction of its first one


@merged
def is_near_singular(f, w, control, clock, t, q):
    """Return whether control[MAY_CROSS] is 1 and a singular position is near (t, q), where the partition is renewed.

    It is only renewed if a singular position was near when the partition was chosen, or if the partition may be old:
    steps of generated code do not use it.
    """
    if control[at.MAY_CROSS] != 1.0:
        return False
    is_old = f.is_generated == 1 and w.nearly_singular == 1.0
    if not is_old and w.pivot >= SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
        return False
    return renew_partition(f, w, t, q) != DONE or w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]


@merged
def ends_near_singular(f, w, control, clock):
    """Return whether a step of the fixed-order form ends so near a singular position that no step should begin there.

    A singular position within a step, far enough from both ends, does no harm.
    """
    if f.form != FIXED_ORDER or control[at.FIXED_STEP] > 0.0:
        return False
    return w.pivot < min(FIXED_ORDER_SINGULAR * clock[at.LARGEST_PIVOT], MIN_END_RATIO * clock[at.PIVOT_HERE])


@merged
def is_too_short_near_singular(f, clock, size):
    """Return whether a failed step of the fixed-order form, near a singular position, is too short to be repeated."""
    is_near = clock[at.PIVOT_HERE] < FIXED_ORDER_SINGULAR * clock[at.LARGEST_PIVOT]
    return f.form == FIXED_ORDER and is_near and size < MIN_STEP_NEAR_SINGULAR * clock[at.H_LONG]


@merged
def prepare_projected_repetition(f, w, control, clock, size):
    """Return whether to repeat a rejected step of the fixed-order form with projected stages; if so, set clock[H_NEXT].

    Near a singular position, accelerations of stages off the constraints have large errors. A long step that ends well
    beyond the position may succeed where shorter steps fail: the first repetition has at least the size H_LONG.
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
    """Return the pivot, relative to the largest, below which rounding errors exceed MAX_ROUNDING_ERROR tolerances."""
    return min(max(MIN_NEAR_RATIO, (EPS / (MAX_ROUNDING_ERROR * tolerances[LEAST])) ** (1.0 / 3.0)), MAX_NEAR_RATIO)


@compiled
def _smallest_pivot_within_step(f, w, t, size, before, end, state, new_state):
    """Return the smallest of the pivots of C_q sampled within a step, and their largest change from sample to sample.

    The samples are on the cubic through the states at both ends of the step, whose pivots are `before` and `end`.
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
    """Return whether an accepted step comes so near a singular position that a crossing step must replace the step.

    Near the position, rounding errors of the stages may exceed the tolerances although the error estimate is small.
    """
    bridge = control[at.MAY_CROSS]
    if bridge == 0.0 or control[at.CHECKS_WITHIN] == 0.0 or w.nearly_singular != 1.0 or control[at.FIXED_STEP] > 0.0:
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
    if bridge == at.SUSPENDED:
        min_ratio = max(least / largest, EPS)
        clock[at.PIVOT_PASSED] = min_ratio if clock[at.PIVOT_PASSED] == 0.0 else min(clock[at.PIVOT_PASSED], min_ratio)
        return False
    if least < max(near_pivot_ratio(tolerances) * largest, min(PASSED_PIVOT_RATIO * change, SINGULAR_PIVOT * largest)):
        w.pivot = before
        return True
    return False


@merged
def record_pivot_at_output(f, w, clock, state):
    """Update clock[PIVOT_AT_OUTPUT], the smallest pivot at output times and grid times, by the pivot at `state`."""
    pivot = min_pivot_ratio(f, w, clock[at.T], state[: w.Q.size])
    if f.form == FIXED_ORDER and pivot > 0.0:
        # pivots of the fixed-order form are sines of angles, all of them small in large mechanisms: only the ratio to
        # the largest pivot so far shows a singular position
        pivot /= max(pivot, clock[at.LARGEST_PIVOT])
    clock[at.PIVOT_AT_OUTPUT] = min(clock[at.PIVOT_AT_OUTPUT], pivot)


@merged
def check_partition(f, w, control, clock, size, at_output, state):
    """Renew a poor partition, and check how near a singular position is; return CONTINUE or an end code.

    `size` is the size (s) of the last step; `at_output` is true if this step ended at an output time. `state` contains
    all coordinates, so that it need not be converted for a new partition.
    """
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
    # steps of generated code do not use the partition: only a new one shows whether a singular position is still near
    if f.is_generated == 1 and w.near_now == 2.0 and renew_partition(f, w, clock[at.T], state[:n]) != DONE:
        return at.RANK_LOST
    clock[at.LARGEST_PIVOT] = max(clock[at.LARGEST_PIVOT], w.pivot)
    w.near_now = 0.0
    if w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
        w.nearly_singular = w.near_now = 1.0
    if size < COLLAPSED_STEP * clock[at.H_LONG] and w.nearly_singular == 0.0 and control[at.MAY_CROSS] == 1.0:
        # the pivots of an old partition may not show that the motion approaches a singular position
        if renew_partition(f, w, clock[at.T], state[:n]) != DONE:
            return at.RANK_LOST
        w.sensitivity = 1.0  # its value far from singular positions: the partition is renewed again soon
        if w.pivot < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
            w.nearly_singular = w.near_now = 1.0
    if short and size < MIN_STEP_NEAR_SINGULAR * clock[at.H_LONG] and w.nearly_singular == 1.0:
        # an implicit method may still continue with a new partition, if the old one was chosen at a distant state
        if renew_partition(f, w, clock[at.T], state[:n]) != DONE:
            return at.RANK_LOST
        if control[at.MAY_CROSS] != 1.0 and w.pivot < UNDETERMINED_PIVOT * clock[at.LARGEST_PIVOT]:
            return at.RANK_LOST  # no step can cross the singular position, where rounding would determine velocities
    return at.NEAR_SINGULAR if short and is_near_singular(f, w, control, clock, clock[at.T], state[:n]) else at.CONTINUE

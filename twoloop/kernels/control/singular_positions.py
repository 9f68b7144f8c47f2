"""Watch a run beside its steps: whether its partition has become poor, and whether a singular position is near."""

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.data.common import merged
from twoloop.kernels.data.indices import (
    AUGMENTED,
    BY_GENERAL,
    DONE,
    FORM,
    N_ACCEPTED,
    NEAR_NOW,
    NEARLY_SINGULAR,
    NULL_SPACE,
    PIVOT,
    SENSITIVITY,
    STATIC,
    STRAIGHT,
)
from twoloop.kernels.evaluation.inner_loop import find_tangents, renew_partition
from twoloop.kernels.evaluation.partition import least_pivot, partition_is_poor
from twoloop.kernels.evaluation.sparse_inner_loop import PROJECT_STAGES

SHORT = 0.5  # of the longest of the last steps: a step below it may be near a singular position ...
COLLAPSED = 0.2  # of it: steps for which the pivots of C_q are looked at anew
SINGULAR_PIVOT = 0.2  # ... and is where the smallest pivot of C_q is below this share of the largest it had
STATIC_SINGULAR = 0.01  # the same of the static form, whose pivots are sines of single rows ...
CARE = 0.05  # ... and where a refused step that begins below this share is tried again with care ...
LESS = 0.8  # ... and then by steps each of which is this times the one before
LOST = 0.001  # ... and which is given up there for steps below this share of the longest
UNDETERMINED = 1e-6  # share of the largest pivot below which rounding makes accelerations: short steps are not to go on
RARELY = 16  # accepted steps from one look at the partition to the next where steps do without it
FEW = 32  # degrees of freedom; where they are k times as many, a partition is looked at every k + 1 steps: T is full
NEARER = 0.25  # of the smallest sine at the start of a step: one that ends nearer to a singular position ends half-way


@merged
def near_singular(f, w, control, clock, t, q):
    """Return whether C_q was close to losing rank when the partition was chosen, and the caller wants to know.

    Where steps have no use for partitions, the last one may be old: with a run that has come near such a position once
    it is chosen anew.
    """
    if control[at.BRIDGE] == 0.0:
        return False
    old = f.flags[STRAIGHT] == 1 and w.notes[NEARLY_SINGULAR] == 1.0
    if old and renew_partition(f, w, t, q) != DONE:
        return True
    return w.notes[PIVOT] < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]


@merged
def ends_at_singular(f, w, control, clock):
    """Return whether a step of the sparse form ends so near a singular position that the next would begin there.

    Steps cross such a position unharmed where it lies well between their ends.
    """
    if f.flags[FORM] != STATIC or control[at.FIXED_STEP] > 0.0:
        return False
    return w.notes[PIVOT] < min(STATIC_SINGULAR * clock[at.LARGEST_PIVOT], NEARER * clock[at.PIVOT_HERE])


@merged
def fails_at_singular(f, clock, size):
    """Return whether a step of the static form that came to nothing is so short that others have to try, see steps/."""
    near = clock[at.PIVOT_HERE] < STATIC_SINGULAR * clock[at.LARGEST_PIVOT]
    return f.flags[FORM] == STATIC and near and size < LOST * clock[at.H_LONG]


@merged
def retry_with_care(f, w, control, clock, size):
    """Return whether a step of the static form that begins near a singular position is tried again with more care.

    Stages beside the constraints have accelerations there whose errors grow with the nearness. A step that ends well
    beyond may be made where shorter ones, which end nearer, are not: lengths from the longest of the last ones down.
    """
    near = clock[at.PIVOT_HERE] < CARE * clock[at.LARGEST_PIVOT]
    if f.flags[FORM] != STATIC or control[at.FIXED_STEP] > 0.0 or w.notes[NEARLY_SINGULAR] == 1.0 or not near:
        return False
    clock[at.H_NEXT] = LESS * size
    if w.notes[NEARLY_SINGULAR] == 0.0:
        w.notes[NEARLY_SINGULAR] = PROJECT_STAGES
        clock[at.H_NEXT] = max(size, clock[at.H_LONG])
    clock[at.H_LIMIT] = max(clock[at.H_LIMIT], clock[at.H_NEXT])
    return True


@merged
def record_pivot_at_output(f, w, clock, state):
    """Note how near a singular position is where a step ends on an output time, or wherever its size says."""
    pivot = least_pivot(f, w, clock[at.T], state[: w.Q.size])
    if f.flags[FORM] == STATIC and pivot > 0.0:
        pivot /= max(pivot, clock[at.LARGEST_PIVOT])  # sines, which are small in large mechanisms
    clock[at.PIVOT_AT_OUTPUT] = min(clock[at.PIVOT_AT_OUTPUT], pivot)


@merged
def check_partition(f, w, control, clock, size, lands, state):
    """Choose coordinates anew where they have become poor, and see how near a singular position is.

    The state is full (q, v, a, lam): a new choice of independent coordinates needs no conversion.
    """
    short = size < SHORT * clock[at.H_LONG] and control[at.FIXED_STEP] == 0.0 and not lands
    if f.flags[FORM] == STATIC:
        clock[at.PIVOT_HERE] = w.notes[PIVOT]
        clock[at.LARGEST_PIVOT] = max(clock[at.LARGEST_PIVOT], w.notes[PIVOT])
        if w.notes[NEARLY_SINGULAR] == PROJECT_STAGES and w.notes[PIVOT] >= CARE * clock[at.LARGEST_PIVOT]:
            w.notes[NEARLY_SINGULAR] = 0.0
        return at.CONTINUE
    n = w.Q.size
    straight = f.flags[STRAIGHT] == 1 and w.notes[BY_GENERAL] == 0.0
    every = 1
    if f.flags[FORM] == AUGMENTED:
        every += w.independent_v.size // FEW
    if straight:
        every = RARELY
    looked = w.counters[N_ACCEPTED] % every == 0
    if looked and (straight or f.flags[FORM] != NULL_SPACE):
        find_tangents(f, w, clock[at.T], state[:n])
    if looked and partition_is_poor(w) and renew_partition(f, w, clock[at.T], state[:n]) != DONE:
        return at.RANK_LOST
    # a new partition shows when the position is left behind; here steps have no use for it, and an old one may last
    if f.flags[STRAIGHT] == 1 and w.notes[NEAR_NOW] == 2.0 and renew_partition(f, w, clock[at.T], state[:n]) != DONE:
        return at.RANK_LOST
    clock[at.LARGEST_PIVOT] = max(clock[at.LARGEST_PIVOT], w.notes[PIVOT])
    w.notes[NEAR_NOW] = 0.0
    if w.notes[PIVOT] < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
        w.notes[NEARLY_SINGULAR] = w.notes[NEAR_NOW] = 1.0
    if size < COLLAPSED * clock[at.H_LONG] and w.notes[NEARLY_SINGULAR] == 0.0 and control[at.BRIDGE] == 1.0:
        # a motion may go straight towards a singular position, and its partition show nothing of it
        if renew_partition(f, w, clock[at.T], state[:n]) != DONE:
            return at.RANK_LOST
        w.notes[SENSITIVITY] = 1.0  # as of a partition far from there: this one is not to last
        if w.notes[PIVOT] < SINGULAR_PIVOT * clock[at.LARGEST_PIVOT]:
            w.notes[NEARLY_SINGULAR] = w.notes[NEAR_NOW] = 1.0
    if short and size < LOST * clock[at.H_LONG] and w.notes[NEARLY_SINGULAR] == 1.0:
        # the partition that serves implicit methods well up to there was chosen far from there
        if renew_partition(f, w, clock[at.T], state[:n]) != DONE:
            return at.RANK_LOST
        if control[at.BRIDGE] == 0.0 and w.notes[PIVOT] < UNDETERMINED * clock[at.LARGEST_PIVOT]:
            return at.RANK_LOST  # no step led across, and velocities would follow from rounding
    return at.NEAR_SINGULAR if short and near_singular(f, w, control, clock, clock[at.T], state[:n]) else at.CONTINUE

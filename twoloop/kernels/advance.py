"""Many steps with step-size control, until the last output time, a full buffer or a failure.

`advance` knows nothing of the method: the step is the kit's, with its options and its memory.
"""

import numpy as np

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.control.controller import (
    EXPONENT,
    FACTOR_MIN,
    N_PAST,
    N_RULE,
    SAFETY,
    factor_of,
    remember,
)
from twoloop.kernels.control.sudden import sudden_time
from twoloop.kernels.data.common import (
    AUGMENTED,
    BY_GENERAL,
    DEFECT,
    DONE,
    EXPLICIT_STEP,
    FAULT_KIND,
    FORM,
    GAMMA_GIVEN,
    GAP,
    INNER_DIVERGED,
    INTEGERS,
    KINK_AFTER,
    KIT,
    LARGEST_DEFECT,
    MATRIX,
    N_ACCEPTED,
    N_JACOBIANS,
    N_PARTITIONS,
    N_REJECTED_CONVERGENCE,
    N_REJECTED_ERROR,
    NEARLY_SINGULAR,
    NEEDS_DENSE,
    NOT_FINITE,
    NULL_SPACE,
    ORIENTATION,
    ORIENTATION_NEW,
    PIVOT,
    SENSITIVITY,
    SINGULAR,
    STATIC,
    STRAIGHT,
    UNCHECKED,
    VECTOR,
    WIDEST_GAP,
    WORK,
    compiled,
    f8,
    i8,
    kernel,
    merged,
)
from twoloop.kernels.evaluation.calls import (
    accelerations,
    check_redundant,
    find_tangents,
    prepare_mass,
    renew_partition,
    take_midpoint,
)
from twoloop.kernels.evaluation.gamma import representable
from twoloop.kernels.evaluation.kinks import JUMP, RAMP, SMOOTH, find_kink, unexplained
from twoloop.kernels.evaluation.partition import CHANGED, partition_is_poor
from twoloop.kernels.evaluation.static_factors_at import CAREFUL

# what advance() returns; PAUSED: a buffer is full, or MAX_ATTEMPTS were made
(
    ALL_OUTPUT_DONE,
    PAUSED,
    STEP_TOO_SMALL,
    FIXED_STEP_FAILED,
    RANK_LOST,
    MAX_STEPS_REACHED,
    ROWS_VIOLATED,
    NEAR_SINGULAR,
    HAS_TO_GIVE_WAY,
    AT_JUMP,  # of C_t or b; the caller is to put the state beyond it into new_state
    HAS_TO_BE_DENSE,  # the static form cannot decide what it was asked
) = range(11)
GO_ON = -1  # nothing of these yet

SHORT = 0.5  # of the longest of the last steps: a step below it may be near a singular position ...
COLLAPSED = 0.2  # of it: steps for which the pivots of C_q are looked at anew
SINGULAR_PIVOT = 0.2  # ... and is where the smallest pivot of C_q is below this share of the largest it had
STATIC_SINGULAR = 0.01  # the same of the static form, whose pivots are sines of single rows ...
CARE = 0.05  # ... and where a refused step that begins below this share is tried again with care ...
LESS = 0.8  # ... and then by steps each of which is this times the one before
LOST = 0.001  # ... and which is given up there for steps below this share of the longest
FADING = 0.98  # of the longest step, with each accepted one
RARELY = 16  # accepted steps from one look at the partition to the next where steps do without it
FEW = 32  # degrees of freedom; where they are k times as many, a partition is looked at every k + 1 steps: T is full
UNFORESEEN = 10.0  # an error that is so large was not foreseen: the force jumps, or bends, within the step
REFUSED = 0.95  # of a refused step is what the next one is at most
NEARER = 0.25  # of the smallest sine at the start of a step: one that ends nearer to a singular position ends half-way
NEARLY = 0.01  # of the spacing of times ahead: before a sudden change by that is at it
NEAR = 4.0  # times that differ by less than so many spacings of floating-point numbers are one

# places in `control`, constant during a run, after the rule of controller.py
(
    MAX_STEP,
    FIXED_STEP,  # 0: step-size control
    LIMIT_START,  # h_max at the beginning of a step
    LIMIT_FACTOR,  # h_max becomes this times the step that did not converge ...
    LIMIT_MEMORY,  # ... for this many accepted steps
    MAX_STEPS,  # accepted steps
    STORE_ALL,  # 1: every accepted step is stored; 0: output times only
    SYMMETRIC,  # 1: each step has the partition of its midpoint; 0: a partition stays until it is renewed
    MAX_ATTEMPTS,  # in one call, so that the caller can look at what goes on
    BRIDGE,  # 1: stop with NEAR_SINGULAR where steps become short near a singular position
    SHORTEST,  # s; a shorter step is too small, and so is one of a few spacings of t
    GIVES_WAY,  # 1: stop with HAS_TO_GIVE_WAY at a value that is not finite, as another method goes on ...
    PROVISIONAL,  # ... and after this number of steps, if the next is no longer than steps of others may be
    DRIVEN,  # 1: C_t or b may jump
    ROUGH,  # by how much an error may be larger than its estimate where a force jumps, see UNFORESEEN
    SPACING,  # s, of times at which to look ahead for sudden changes; 0: there are none
    N_CONTROL,
) = range(N_RULE, N_RULE + 17)

# places in a row of `out_steps`: the size of an accepted step, and the counters so far; JACOBIANS is 0 after an
# explicit step of a method that switches
H, ERRORS, FAILURES, PARTITIONS, JACOBIANS, N_STEP_COLUMNS = range(6)

# places in `clock`, carried from call to call, after the past of controller.py
(
    T,
    H_NEXT,
    H_LIMIT,
    LIMIT_AGE,
    NEXT_OUTPUT,
    T_START,
    N_FIXED,
    FAILURE_CODE,
    H_FAILED,
    H_LONG,  # the longest of the last steps, fading
    LARGEST_PIVOT,  # of the smallest pivots of C_q so far
    JUMP_FROM,  # the interval in which C_t or b jumps, where one lies ahead; else infinite
    JUMP_TO,
    LEAPS,  # 1: the next step is that over it, and new_state its end
    ROUGH_TO,  # where the last step ended that was refused for a sudden error
    PIVOT_HERE,  # the smallest pivot at the end of the last step, of the static form
    LOOKED_TO,  # up to where changes with time were looked for
    SUDDEN,  # where the next one is that is sudden
    N_CLOCK,
) = range(N_PAST, N_PAST + 19)


@kernel(i8(KIT, WORK, f8, VECTOR))
def start(f, w, t, state):
    """Factor the mass matrix, choose the partition, and complete the state (q, v given) by a and lam."""
    n = w.Q.size
    q, v = state[:n], state[n : 2 * n]
    code = prepare_mass(f, w, t, q)
    if code == DONE:
        code = renew_partition(f, w, t, q)
    if code == DONE:
        code = find_tangents(f, w, t, q)
    if code == DONE:
        code = accelerations(f, w, t, q, v, state[2 * n : 3 * n], state[3 * n :])
    if code == DONE and f.flags[GAMMA_GIVEN] == 0:  # now with the scale by which its differences are judged
        code = accelerations(f, w, t, q, v, state[2 * n : 3 * n], state[3 * n :])
    return code


@merged
def _near_singular(w, control, clock):
    """Whether C_q was close to losing rank when the partition was chosen, and the caller wants to know."""
    return control[BRIDGE] == 1.0 and w.notes[PIVOT] < SINGULAR_PIVOT * clock[LARGEST_PIVOT]


@merged
def _kink(f, w, t, size, tolerances, accepted, state, new_state):
    """What find_kink says of a step whose velocities change by more than its accelerations explain."""
    n = w.Q.size
    q, v = state[:n], state[n : 2 * n]
    if not accepted:
        return find_kink(f, w, t, t + size, q, v, v, tolerances)
    if not unexplained(tolerances, size, state, new_state, n) > 1.0:
        return SMOOTH, t, t
    for m in range(n):
        w.y[m] = (new_state[m] - state[m]) / size
    return find_kink(f, w, t, t + size, q, v, w.y, tolerances)


@merged
def _on_grid(clock, t, h, target, goal):
    """Size of a step of a fixed grid, how many of the grid it is, and whether it reaches the goal.

    Times are counted, not added up; an output time within a millionth of a step of the grid is on it.
    """
    rounding = NEAR * np.spacing(max(abs(t), abs(target)))
    near = max(1e-6 * h, rounding)
    in_grid = 1.0
    if target <= clock[T_START] + clock[N_FIXED] * h + near:
        in_grid = 0.0  # a second output time beside the same point of the grid
    end = clock[T_START] + (clock[N_FIXED] + in_grid) * h
    reaches = goal <= end + near
    size = h
    if abs(t + h - end) > rounding:
        size = end - t  # back to the grid after such an output time
    if reaches and goal < target and abs(goal - end) > rounding:
        in_grid = 0.0
    return size, in_grid, reaches


@merged
def _off_grid(control, t, h, left, leaps):
    """Size of a step with step-size control, and whether it reaches the goal, which is so far away."""
    reaches = leaps or h >= left * (1.0 - 1e-10)
    size = h
    if h > 0.5 * left and not reaches:
        size = 0.5 * left  # two equal steps rather than a long and a tiny one
    size = representable(t, size)
    if size > control[MAX_STEP]:
        size = representable(t, size - np.spacing(abs(t + size)))
    return size, reaches


@compiled
def _up_to_sudden(f, w, tolerances, clock, spacing, t, size, last, q, v):
    """The size of a step that does not pass over a sudden change with time."""
    while clock[SUDDEN] <= t + NEARLY * spacing or clock[SUDDEN] == np.inf:
        begin = max(t, clock[LOOKED_TO])
        if begin >= min(t + size, last):
            return size
        clock[SUDDEN], clock[LOOKED_TO] = sudden_time(f, w, tolerances, begin, spacing, last, q, v)
    return min(size, representable(t, clock[SUDDEN] - t))


@merged
def _attempt(f, w, options, memory, tolerances, control, clock, t, size, leaps, state, new_state):
    """A step: its code, its error and the factor by which the next may be longer."""
    w.notes[ORIENTATION_NEW] = 0.0
    if clock[FAILURE_CODE] == DONE:
        w.notes[FAULT_KIND] = -1.0
    if leaps:
        w.notes[DEFECT] = 0.0
        w.notes[ORIENTATION_NEW] = w.notes[ORIENTATION]
        return DONE, 0.0, 0.0
    w.notes[DEFECT] = -1.0
    code, error, factor = f.attempt(f, w, options, memory, t, size, tolerances, state, new_state)
    if code == DONE and np.isfinite(error) and control[SYMMETRIC] == 1.0:
        code = take_midpoint(f, w, t + 0.5 * size, state, new_state)
        if code == CHANGED:
            f.settle(f, w, options, memory, tolerances, False)
            code, error, factor = f.attempt(f, w, options, memory, t, size, tolerances, state, new_state)
    if code == DONE and not np.isfinite(error):
        code = NOT_FINITE
    return code, error, factor


@merged
def _before_kink(f, w, tolerances, control, clock, t, size, accepted, state, new_state):
    """Whether C_t or b jumps or bends within a step, which is then to end there."""
    kind, low, high = _kink(f, w, t, size, tolerances, accepted, state, new_state)
    if kind == JUMP:
        clock[JUMP_FROM] = t if low - t <= NEAR * np.spacing(abs(t)) else low
        clock[JUMP_TO] = high
        w.notes[KINK_AFTER] = clock[JUMP_FROM]
        return True
    if kind == RAMP and accepted and control[FIXED_STEP] == 0.0:
        clock[H_NEXT] = max(low - t, high - low)
        return True
    return False


@merged
def _ends_at_singular(f, w, control, clock):
    """Whether a step of the static form ends so near a singular position that the next would have to begin there.

    Steps cross such a position unharmed where it lies well between their ends.
    """
    if f.flags[FORM] != STATIC or control[FIXED_STEP] > 0.0:
        return False
    return w.notes[PIVOT] < min(STATIC_SINGULAR * clock[LARGEST_PIVOT], NEARER * clock[PIVOT_HERE])


@merged
def _lost_at_singular(f, clock, size):
    """Whether a step of the static form that came to nothing is so short that others have to try, see bridge.py."""
    near = clock[PIVOT_HERE] < STATIC_SINGULAR * clock[LARGEST_PIVOT]
    return f.flags[FORM] == STATIC and near and size < LOST * clock[H_LONG]


@merged
def _with_care(f, w, control, clock, size):
    """Whether a step of the static form that begins near a singular position is tried again with more care.

    Stages beside the constraints have accelerations there whose errors grow with the nearness. A step that ends well
    beyond may be made where shorter ones, which end nearer, are not: lengths from the longest of the last ones down.
    """
    near = clock[PIVOT_HERE] < CARE * clock[LARGEST_PIVOT]
    if f.flags[FORM] != STATIC or control[FIXED_STEP] > 0.0 or w.notes[NEARLY_SINGULAR] == 1.0 or not near:
        return False
    clock[H_NEXT] = LESS * size
    if w.notes[NEARLY_SINGULAR] == 0.0:
        w.notes[NEARLY_SINGULAR] = CAREFUL
        clock[H_NEXT] = max(size, clock[H_LONG])
    clock[H_LIMIT] = max(clock[H_LIMIT], clock[H_NEXT])
    return True


@merged
def _failed(f, w, control, clock, t, size, code, retried, state):
    """What becomes of a step that failed for such a reason: a shorter one, another partition, or the end.

    A step of fixed size keeps it, and only a partition that went bad within it may be the reason; `retried` is where
    that was tried.
    """
    n = w.Q.size
    poor = code in (SINGULAR, INNER_DIVERGED)
    if code == NEEDS_DENSE or _lost_at_singular(f, clock, size):
        return HAS_TO_BE_DENSE
    w.counters[N_REJECTED_CONVERGENCE] += 1
    if _with_care(f, w, control, clock, size):
        return GO_ON
    clock[FAILURE_CODE] = code
    clock[H_FAILED] = size
    if code == NOT_FINITE and control[GIVES_WAY] == 1.0:
        return HAS_TO_GIVE_WAY
    if control[FIXED_STEP] > 0.0:
        if not poor or t == retried:
            return NEAR_SINGULAR if _near_singular(w, control, clock) else FIXED_STEP_FAILED
    else:
        if size < SHORT * clock[H_LONG] and _near_singular(w, control, clock):
            return NEAR_SINGULAR
        clock[H_LIMIT] = control[LIMIT_FACTOR] * size
        clock[LIMIT_AGE] = 0.0
        clock[H_NEXT] = 0.5 * size
    if poor and renew_partition(f, w, t, state[:n]) != DONE:
        return HAS_TO_BE_DENSE if f.flags[FORM] == STATIC else RANK_LOST
    return GO_ON


@merged
def _refused(f, w, control, clock, t, size, proposal):
    """What becomes of a step whose error is too large: a shorter one, a tiny one by a spacing, or steps across."""
    w.counters[N_REJECTED_ERROR] += 1
    clock[FAILURE_CODE] = DONE
    if _with_care(f, w, control, clock, size):
        return GO_ON
    clock[H_NEXT] = min(proposal, REFUSED * size, size - np.spacing(abs(t + size)))
    if _lost_at_singular(f, clock, size):
        return HAS_TO_BE_DENSE
    if size < SHORT * clock[H_LONG] and _near_singular(w, control, clock):
        return NEAR_SINGULAR
    return GO_ON


@merged
def _count(w, tolerances, size, out_step):
    """Count an accepted step, and what it saw of the equations."""
    w.counters[N_ACCEPTED] += 1
    if w.notes[DEFECT] >= 0.0:
        w.notes[LARGEST_DEFECT] = max(w.notes[LARGEST_DEFECT], w.notes[DEFECT])
    else:
        w.notes[UNCHECKED] += 1.0
    gap = min(size, tolerances[GAP]) if w.notes[DEFECT] >= 0.0 else size
    w.notes[WIDEST_GAP] = max(w.notes[WIDEST_GAP], gap)
    w.notes[ORIENTATION] = w.notes[ORIENTATION_NEW]
    out_step[H] = size
    out_step[ERRORS] = w.counters[N_REJECTED_ERROR]
    out_step[FAILURES] = w.counters[N_REJECTED_CONVERGENCE]
    out_step[PARTITIONS] = w.counters[N_PARTITIONS]
    out_step[JACOBIANS] = 0.0 if w.notes[EXPLICIT_STEP] == 1.0 else w.counters[N_JACOBIANS]


@merged
def _look_at_partition(f, w, control, clock, size, lands, state):
    """Choose coordinates anew where they have become poor, and see how near a singular position is.

    The state is full (q, v, a, lam): a new choice of independent coordinates needs no conversion.
    """
    short = size < SHORT * clock[H_LONG] and control[FIXED_STEP] == 0.0 and not lands
    if f.flags[FORM] == STATIC:
        clock[PIVOT_HERE] = w.notes[PIVOT]
        clock[LARGEST_PIVOT] = max(clock[LARGEST_PIVOT], w.notes[PIVOT])
        if w.notes[NEARLY_SINGULAR] == CAREFUL and w.notes[PIVOT] >= CARE * clock[LARGEST_PIVOT]:
            w.notes[NEARLY_SINGULAR] = 0.0
        return GO_ON
    n = w.Q.size
    straight = f.flags[STRAIGHT] == 1 and w.notes[BY_GENERAL] == 0.0
    every = 1
    if f.flags[FORM] == AUGMENTED:
        every += w.independent_v.size // FEW
    if straight:
        every = RARELY
    looked = w.counters[N_ACCEPTED] % every == 0
    if looked and (straight or f.flags[FORM] != NULL_SPACE):
        find_tangents(f, w, clock[T], state[:n])
    if looked and partition_is_poor(w) and renew_partition(f, w, clock[T], state[:n]) != DONE:
        return RANK_LOST
    clock[LARGEST_PIVOT] = max(clock[LARGEST_PIVOT], w.notes[PIVOT])
    if w.notes[PIVOT] < SINGULAR_PIVOT * clock[LARGEST_PIVOT]:
        w.notes[NEARLY_SINGULAR] = 1.0
    if size < COLLAPSED * clock[H_LONG] and w.notes[NEARLY_SINGULAR] == 0.0 and control[BRIDGE] == 1.0:
        # a motion may go straight towards a singular position, and its partition show nothing of it
        if renew_partition(f, w, clock[T], state[:n]) != DONE:
            return RANK_LOST
        w.notes[SENSITIVITY] = 1.0  # as of a partition far from there: this one is not to last
        if w.notes[PIVOT] < SINGULAR_PIVOT * clock[LARGEST_PIVOT]:
            w.notes[NEARLY_SINGULAR] = 1.0
    return NEAR_SINGULAR if short and _near_singular(w, control, clock) else GO_ON


_ADVANCE = i8(
    KIT,
    WORK,
    *(VECTOR,) * 9,
    MATRIX,
    MATRIX,
    INTEGERS,
)


@kernel(_ADVANCE)
def advance(
    f,
    w,
    options,
    memory,
    tolerances,
    control,
    clock,
    state,
    new_state,
    outputs,
    out_t,
    out_state,
    out_steps,
    filled,
):
    """Step on from (clock, state) until every time in `outputs` is reached; steps are shortened to land on them.

    Times are floating-point numbers: a step is the difference of two of them, so that the sum of the steps is the time.

    Stores every accepted step, or with STORE_ALL = 0 the landings only. `filled` counts the rows of
    out_t / out_state and those of out_steps, every accepted step, that this call wrote.
    """
    fixed = control[FIXED_STEP] > 0.0
    n = w.Q.size
    retried = np.inf  # where a step of fixed size was tried again with a new partition
    filled[0] = 0
    filled[1] = 0
    attempts = 0.0
    while True:
        if filled[0] == out_t.size or filled[1] == out_steps.shape[0] or attempts == control[MAX_ATTEMPTS]:
            return PAUSED
        attempts += 1.0
        if w.counters[N_ACCEPTED] >= control[MAX_STEPS]:
            return MAX_STEPS_REACHED
        t = clock[T]
        leaps = clock[LEAPS] == 1.0
        if t == clock[JUMP_FROM] and not leaps:
            return AT_JUMP
        target = outputs[int(clock[NEXT_OUTPUT])]
        goal = min(target, clock[JUMP_TO] if leaps else clock[JUMP_FROM])
        h = control[FIXED_STEP] if fixed else min(clock[H_NEXT], clock[H_LIMIT], control[MAX_STEP])
        in_grid = 1.0  # steps of the grid that this one is
        if fixed:
            size, in_grid, reaches = _on_grid(clock, t, h, target, goal)
        else:
            size, reaches = _off_grid(control, t, h, goal - t, leaps)
        shortened = reaches or (h > 0.5 * (goal - t) and not fixed)
        lands = reaches and goal == target
        if reaches:
            size = goal - t
        if size > control[SPACING] > 0.0 or t < clock[SUDDEN] < t + size:
            whole, last = size, outputs[outputs.size - 1]
            size = _up_to_sudden(f, w, tolerances, clock, control[SPACING], t, whole, last, state[:n], state[n : 2 * n])
            if size < whole:
                reaches, lands, shortened = False, False, True
        if not reaches and size <= max(NEAR * np.spacing(abs(t)), control[SHORTEST]):
            return STEP_TOO_SMALL
        code, error, factor = _attempt(
            f, w, options, memory, tolerances, control, clock, t, size, leaps, state, new_state
        )
        # at a jump the embedded formula may agree by chance: until the place is passed, the estimate has to be smaller
        strict = control[ROUGH] if t < clock[ROUGH_TO] else 1.0
        accepted = code == DONE and error * strict <= 1.0
        if accepted and not reaches and _ends_at_singular(f, w, control, clock):
            f.settle(f, w, options, memory, tolerances, False)
            w.counters[N_REJECTED_ERROR] += 1
            if not _with_care(f, w, control, clock, size):
                clock[H_NEXT], clock[PIVOT_HERE] = 0.5 * size, w.notes[PIVOT]
            continue
        driven = control[DRIVEN] == 1.0 and not leaps
        if driven and _before_kink(f, w, tolerances, control, clock, t, size, accepted, state, new_state):
            f.settle(f, w, options, memory, tolerances, False)
            w.counters[N_REJECTED_ERROR] += 1
            clock[FAILURE_CODE] = DONE
            continue
        if not leaps:
            f.settle(f, w, options, memory, tolerances, accepted)
        if code != DONE:
            end = _failed(f, w, control, clock, t, size, code, retried, state)
            if end != GO_ON:
                return end
            if fixed:
                retried = t
            continue
        if error > UNFORESEEN and not accepted:
            clock[ROUGH_TO] = t + size
        error *= strict
        if factor == 0.0:
            factor = factor_of(control, clock, size, error)
        elif strict > 1.0 and error > 0.0:  # the step does not know of `strict`, and may want to grow
            factor = min(factor, max(control[FACTOR_MIN], control[SAFETY] * error ** -control[EXPONENT]))
        proposal = min(size * factor, clock[H_LIMIT])
        if not accepted:
            end = _refused(f, w, control, clock, t, size, proposal)
            if end != GO_ON:
                return end
            continue
        if w.rows_v.size < w.Rate.size and check_redundant(f, w, t + size, new_state[:n], new_state[n : 2 * n]) != DONE:
            clock[H_FAILED] = size
            return ROWS_VIOLATED
        _count(w, tolerances, size, out_steps[filled[1]])
        filled[1] += 1
        clock[H_LONG] = max(size, FADING * clock[H_LONG])
        remember(control, clock, size, error)
        clock[N_FIXED] += in_grid
        if reaches:
            clock[T] = goal
        else:
            clock[T] = clock[T_START] + clock[N_FIXED] * h if fixed else t + size
        if leaps:
            clock[JUMP_FROM], clock[LEAPS] = np.inf, 0.0
        copy(new_state, state)
        if lands or control[STORE_ALL] == 1.0:
            out_t[filled[0]] = clock[T]
            copy(state, out_state[filled[0]])
            filled[0] += 1
        # a step cut short by an output time says little about the next
        clock[H_NEXT] = max(proposal, h) if shortened else proposal
        clock[LIMIT_AGE] += 1.0
        if clock[LIMIT_AGE] > control[LIMIT_MEMORY]:
            clock[H_LIMIT] = control[LIMIT_START]
            clock[FAILURE_CODE] = DONE  # until then it is why steps are short
        if lands:
            clock[NEXT_OUTPUT] += 1.0
            if int(clock[NEXT_OUTPUT]) == outputs.size:
                return ALL_OUTPUT_DONE
        if w.counters[N_ACCEPTED] == control[PROVISIONAL] and clock[H_NEXT] <= tolerances[GAP]:
            clock[H_FAILED] = clock[H_NEXT]
            return HAS_TO_GIVE_WAY
        if leaps:
            return PAUSED
        if control[SYMMETRIC] == 0.0:
            end = _look_at_partition(f, w, control, clock, size, lands, state)
            if end != GO_ON:
                return end

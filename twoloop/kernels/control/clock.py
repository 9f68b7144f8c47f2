"""What `advance` returns, and the layout of the arrays that it reads and writes."""

from twoloop.kernels.control.controller import N_PAST, N_RULE

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
    HAS_TO_LOAD,  # the step that is due, which is then tried again
) = range(12)
GO_ON = -1  # nothing of these yet

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
    PROVISIONAL,  # ... and within this number of steps, if the next is no longer than steps of others may be
    DRIVEN,  # 1: C_t or b may jump
    ROUGH,  # by how much an error may be larger than its estimate where a force jumps, see UNFORESEEN
    SPACING,  # s, of times at which to look ahead for sudden changes; 0: there are none
    APART,  # s, the same of changes with time, which are also looked for ahead of shorter steps
    AHEAD,  # 1: these looks go along the way; 0: they stay at the state, as a callback raised on the way
    BY_TIME,  # 1: they stay there ahead of other steps, too, for what may change suddenly with time
    BY_STATE,  # 1: they go along the way of short steps, too, for what may be sharp by place or speed
    FIRST_GIVEN,  # 1: the first step is the user's, and not a guess that may become longer
    UNSEEN,  # of a step, the longest part within which nothing is evaluated
    IN_A_ROW,  # 1: the method makes many steps in a row, and nothing has to be looked at before each of them
    N_CONTROL,
) = range(N_RULE, N_RULE + 24)

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
    LOOKED_EVERY,  # s, of the times of the last such look
    WIDEST_LOOK,  # the widest of these
    SUDDEN,  # where the next one is that is sudden
    ALONG,  # the same along the way
    COMPARED,  # where it was last compared with what is before and behind
    FLANK,  # when a value changed suddenly
    BRIEFEST,  # s, the shortest time between two such changes
    ALONG_TO,  # up to where they were looked for along the way
    LOOKING,  # 1: while callbacks are called along the way, at states to which the motion may not come
    PIVOT_AT_OUTPUT,  # the smallest pivot where steps had to end: output times, a grid; see least_pivot in partition.py
    N_CLOCK,
) = range(N_PAST, N_PAST + 28)

"""Indices into the arrays of the integration loop, and the codes that `advance` returns.

`control` contains the settings of the loop; its first entries are the rule of step-size control. `clock` contains the
state of the loop, which `advance` continues in the next call; its first entries are the history of step-size control.
"""

import numpy as np
from numpy.typing import NDArray

# codes that advance() returns
(
    ALL_OUTPUT_DONE,
    PAUSED,  # a buffer is full, or the call has made MAX_ATTEMPTS attempts
    STEP_TOO_SMALL,
    FIXED_STEP_FAILED,
    RANK_LOST,
    MAX_STEPS_REACHED,
    ROWS_VIOLATED,
    NEAR_SINGULAR,
    SWITCH_METHOD,
    AT_DISCONTINUITY,  # C_t or b jumps here: the caller writes the state after the jump to new_state
    NEEDS_DENSE,  # the static form cannot decide whether rows are independent: the caller continues with a dense one
    NEEDS_COMPILATION,  # the step is not compiled: the caller compiles it and repeats the call
) = range(12)
SUSPENDED = 0.5  # value of BRIDGE after all special steps across a singular position have failed
CONTINUE = -1  # returned instead of an end code: the loop continues

# indices in the rule of step-size control: the ratio of the next step size to this one is SAFETY error**-EXPONENT, but
# at least FACTOR_MIN and at most FACTOR_MAX. LEAST_ERROR: smaller errors are replaced by this one where the change of
# the error from step to step (Hairer & Wanner II, IV.8) is also used; 0: this change is not used
SAFETY, EXPONENT, FACTOR_MIN, FACTOR_MAX, LEAST_ERROR, N_RULE = range(6)
# indices in the history of step-size control: size (s) and error (in tolerances) of the last accepted step
H_BEFORE, ERROR_BEFORE, N_PAST = range(3)

# indices in `control`, after those of the rule
(
    MAX_STEP,  # largest step, s
    FIXED_STEP,  # fixed step size, s; 0: step-size control
    LIMIT_START,  # value of H_LIMIT if no step has failed recently, s
    LIMIT_FACTOR,  # ratio of H_LIMIT to the size of a step that failed
    LIMIT_MEMORY,  # number of accepted steps after a failed step for which H_LIMIT applies
    MAX_STEPS,  # largest number of accepted steps
    STORE_ALL,  # 1: every accepted step is stored; 0: output times only
    SYMMETRIC,  # 1: each step uses the partition chosen at its midpoint; 0: a partition is used until it is poor
    MAX_ATTEMPTS,  # largest number of attempted steps in one call, after which the caller can check progress and time
    # 1: stop with NEAR_SINGULAR near a singular position; 0: do not; SUSPENDED: do not before the present singular
    # position is left behind, then 1 again
    BRIDGE,
    SHORTEST,  # smallest allowed step size, s; steps of at most EQUAL_SPACINGS spacings of t are too short as well
    MAY_SWITCH,  # 1: stop with SWITCH_METHOD at a value that is not finite, or if the method is unsuited
    TRIAL_STEPS,  # number of first steps: stop with SWITCH_METHOD if the next size is at most GAP after one of them
    DRIVEN,  # 1: C_t or b may jump
    ROUGH,  # factor by which errors may exceed their estimates near a jump of a force, see SUDDEN_ERROR in advance.py
    SPACING,  # spacing of samples of the forces ahead of a step, s, see discontinuities.py; 0: no samples
    APART,  # largest spacing of samples in time alone, which are taken ahead of short steps as well, s
    # 1: samples follow the motion; 0: samples stay at the state, because a callback raised an error along the motion
    SAMPLE_MOTION,
    BY_TIME,  # 1: forces may change suddenly with time
    BY_STATE,  # 1: forces may change suddenly with position or velocity: short steps are sampled along the motion, too
    FIRST_GIVEN,  # 1: the user has chosen the first step size; 0: the first step size is a guess, and may grow
    MAX_EVALUATION_GAP,  # longest part of a step without an evaluation of the equations, relative to the step size
    MAKES_MANY,  # 1: the method can take many steps in one call, without checks between them
    WATCHFUL,  # 1: once a run was near a singular position, check each (explicit) step for singular positions
    N_CONTROL,
) = range(N_RULE, N_RULE + 25)

# columns of `out_steps`, which has one row for each accepted step. H: step size, s; the other columns are counters
# since the start of the run: rejections by the error, failures, partitions, and Jacobians (0 after an explicit step)
H, ERRORS, FAILURES, PARTITIONS, JACOBIANS, N_STEP_COLUMNS = range(6)

# indices in `clock`, after those of the history
(
    T,  # present time
    H_NEXT,  # size of the next step, s
    H_LIMIT,  # largest step size after a failed step, s
    LIMIT_AGE,  # number of accepted steps since the last failed step
    NEXT_OUTPUT,  # index of the next output time
    T_START,  # start time of the run, at which the grid of steps of fixed size begins
    N_FIXED,  # number of grid steps so far
    FAILURE_CODE,  # code of the last failed attempt, which explains short steps; DONE: no attempt failed
    H_FAILED,  # size of the last failed step, for messages, s
    H_LONG,  # longest of the last steps, with a weight that decreases from step to step, s
    LARGEST_PIVOT,  # largest value so far of PIVOT in Work.notes, the smallest pivot of C_q
    JUMP_FROM,  # beginning of the next interval in which C_t or b jumps; infinite if none is known
    JUMP_TO,  # end of the next interval in which C_t or b jumps
    APPLIES_JUMP,  # 1: the next step goes from JUMP_FROM to JUMP_TO; new_state is the state after the jump
    ROUGH_TO,  # end of the last step that was rejected with an error above SUDDEN_ERROR
    PIVOT_HERE,  # static form: value of PIVOT in Work.notes at the end of the last step
    # samples in time alone (at a fixed state) and samples along the motion: see discontinuities.py
    SAMPLED_TO,  # time of the last sample in time alone
    SAMPLED_EVERY,  # spacing of the last samples in time alone, s
    WIDEST_SAMPLING,  # widest spacing of samples so far, s
    DISCONTINUITY,  # time of the next sudden change found by samples in time alone
    DISCONTINUITY_OF_MOTION,  # time of the next sudden change found by samples along the motion
    COMPARED,  # time at which values within a short step were last compared with values before and after this step
    LAST_CHANGE,  # time of the last sudden change of a value
    SHORTEST_CHANGE,  # shortest time between two sudden changes, s
    MOTION_SAMPLED_TO,  # time of the last sample along the motion
    SAMPLES_MOTION,  # 1 while callbacks are sampled along the motion, at states that the motion may not reach
    # smallest result of least_pivot (partition.py) at output times and grid points, where steps have to end
    PIVOT_AT_OUTPUT,
    PIVOT_PASSED,  # smallest pivot within steps since BRIDGE is SUSPENDED, relative to LARGEST_PIVOT; 0: none yet
    N_CLOCK,
) = range(N_PAST, N_PAST + 29)

# power iterations for the largest rate of a motion, in stiffness.py and in run/messages.py
DISPLACEMENT = 1e-6  # displacement of finite differences, relative to the largest coordinate or velocity
INNER_TOL = 1e-8  # tolerance of Newton's method for projected positions


def initial_direction(n_q: int) -> NDArray[np.float64]:
    """Return the first direction (n_q) of a power iteration; its components differ, as do those of a vibration."""
    return np.asarray(0.3 + 0.1 * (np.arange(n_q) % 7))

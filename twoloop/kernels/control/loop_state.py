"""Indices into the arrays of the integration loop, and the codes that `advance` returns.

`control` holds settings, constant during a run, and begins with the rule of step-size control. `clock` holds the state
of the loop, kept between calls, and begins with the history of step-size control.
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
    NEEDS_DENSE,  # the sparse form cannot decide whether rows are independent
    NEEDS_COMPILATION,  # the step is not compiled: the caller compiles it and repeats the call
) = range(12)
SUSPENDED = 0.5  # value of BRIDGE after a position across which no step led
CONTINUE = -1  # no end code: the loop continues

# rule of step-size control: the factor is SAFETY error**-EXPONENT within FACTOR_MIN and FACTOR_MAX. The trend (Hairer &
# Wanner II, IV.8) takes errors below LEAST_ERROR as LEAST_ERROR; LEAST_ERROR = 0: without the trend
SAFETY, EXPONENT, FACTOR_MIN, FACTOR_MAX, LEAST_ERROR, N_RULE = range(6)
# history of step-size control: size and error of the last accepted step
H_BEFORE, ERROR_BEFORE, N_PAST = range(3)

# `control`, after the rule
(
    MAX_STEP,  # largest step, s
    FIXED_STEP,  # s; 0: step-size control
    LIMIT_START,  # value of H_LIMIT without a recent failure
    LIMIT_FACTOR,  # after a step that did not converge, H_LIMIT is this times the step ...
    LIMIT_MEMORY,  # ... for this number of accepted steps
    MAX_STEPS,  # largest number of accepted steps
    STORE_ALL,  # 1: every accepted step is stored; 0: output times only
    SYMMETRIC,  # 1: each step has the partition of its midpoint; 0: a partition stays until it is renewed
    MAX_ATTEMPTS,  # largest number of attempts in one call, so that the caller can watch the run
    # 1: stop with NEAR_SINGULAR near a singular position; SUSPENDED: not before that position is left behind
    BRIDGE,
    SHORTEST,  # shortest step, s; a step of a few spacings of t is too short as well
    MAY_SWITCH,  # 1: stop with SWITCH_METHOD at a value that is not finite ...
    TRIAL_STEPS,  # ... and within this number of steps, if the next one is not longer than GAP
    DRIVEN,  # 1: C_t or b may jump
    ROUGH,  # factor by which errors may exceed their estimates where a force jumps, see SUDDEN_ERROR in advance.py
    SPACING,  # s, between samples of the forces ahead, see discontinuities.py; 0: no samples
    APART,  # s, between samples in time alone, which are taken ahead of short steps as well
    # 1: samples follow the motion; 0: they stay at the state, because a callback raised along the motion
    SAMPLE_MOTION,
    BY_TIME,  # 1: forces may change suddenly with time
    BY_STATE,  # 1: forces may change suddenly with place or speed: samples follow the motion of short steps, too
    FIRST_GIVEN,  # 1: the user has given the first step; 0: it is a guess, and may become longer
    MAX_EVALUATION_GAP,  # the longest part of a step within which nothing is evaluated, over the step
    MAKES_MANY,  # 1: the method can take many steps in one call, without checks between them
    WATCHFUL,  # 1: steps are explicit: once a run was near a singular position, they must not come near one again
    N_CONTROL,
) = range(N_RULE, N_RULE + 25)

# columns of `out_steps`: size of an accepted step, then counters up to it; JACOBIANS is 0 after an explicit step of a
# method that switches
H, ERRORS, FAILURES, PARTITIONS, JACOBIANS, N_STEP_COLUMNS = range(6)

# `clock`, after the past
(
    T,
    H_NEXT,
    H_LIMIT,
    LIMIT_AGE,
    NEXT_OUTPUT,
    T_START,
    N_FIXED,  # steps of the fixed grid so far
    FAILURE_CODE,
    H_FAILED,
    H_LONG,  # longest of the last steps; the weight of older steps fades
    LARGEST_PIVOT,  # largest so far of the smallest pivots of C_q
    JUMP_FROM,  # start of the interval ahead in which C_t or b jumps; infinite without one
    JUMP_TO,
    APPLIES_JUMP,  # 1: the next step crosses that interval, and new_state is its end
    ROUGH_TO,  # end of the last step that was rejected for a sudden error
    PIVOT_HERE,  # sparse form: the smallest pivot at the end of the last step
    SAMPLED_TO,  # end of the samples taken in time
    SAMPLED_EVERY,  # s, spacing of the last samples in time
    WIDEST_SAMPLING,  # s, the widest spacing of samples so far
    DISCONTINUITY,  # time of the next sudden change found by samples in time
    DISCONTINUITY_OF_MOTION,  # ... and of the next one found by samples along the motion
    COMPARED,  # time at which a short step was last compared with its neighbours
    LAST_CHANGE,  # time of the last sudden change of a value
    SHORTEST_CHANGE,  # s, the shortest time between two such changes
    MOTION_SAMPLED_TO,  # end of the samples along the motion
    SAMPLES_MOTION,  # 1 during samples along the motion, at states that the motion may not reach
    # smallest pivot at output times and grid points, which steps cannot avoid; see least_pivot in partition.py
    PIVOT_AT_OUTPUT,
    PIVOT_PASSED,  # smallest share of the largest pivot within steps while BRIDGE is SUSPENDED; 0: none
    N_CLOCK,
) = range(N_PAST, N_PAST + 29)

# power iterations for the largest rate, in stiffness.py and in run/messages.py
DISPLACEMENT = 1e-6  # relative to the largest coordinate or velocity: length of differences along a direction
INNER_TOL = 1e-8  # tolerance of the projected positions


def initial_direction(n_q: int) -> NDArray[np.float64]:
    """Return a direction in which neighbouring coordinates differ in size: no vibration is orthogonal to it."""
    return np.asarray(0.3 + 0.1 * (np.arange(n_q) % 7))

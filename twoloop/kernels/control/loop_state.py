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
    NEEDS_DENSE,  # the static form cannot decide whether rows are independent: the caller continues with a dense one
    NEEDS_COMPILATION,  # the step is not compiled: the caller compiles it and repeats the call
) = range(12)
SUSPENDED = 0.5  # value of BRIDGE after all special steps across a singular position have failed
CONTINUE = -1  # no end code: the loop continues

# rule of step-size control: the ratio of the next step size to this one is SAFETY error**-EXPONENT, between FACTOR_MIN
# and FACTOR_MAX. The trend (Hairer & Wanner II, IV.8) replaces errors below LEAST_ERROR by LEAST_ERROR; 0: no trend
SAFETY, EXPONENT, FACTOR_MIN, FACTOR_MAX, LEAST_ERROR, N_RULE = range(6)
# history of step-size control: size and error of the last accepted step
H_BEFORE, ERROR_BEFORE, N_PAST = range(3)

# `control`, after the rule
(
    MAX_STEP,  # largest step, s
    FIXED_STEP,  # fixed step size, s; 0: step-size control
    LIMIT_START,  # value of H_LIMIT without a recent failure
    LIMIT_FACTOR,  # after a step that did not converge: ratio of H_LIMIT to the size of that step
    LIMIT_MEMORY,  # number of accepted steps for which H_LIMIT then applies
    MAX_STEPS,  # largest number of accepted steps
    STORE_ALL,  # 1: every accepted step is stored; 0: output times only
    SYMMETRIC,  # 1: each step uses the partition chosen at its midpoint; 0: a partition is used until it is poor
    MAX_ATTEMPTS,  # largest number of attempts in one call, after which the caller can check progress and time
    # 1: stop with NEAR_SINGULAR near a singular position; SUSPENDED: only after the present one is left behind
    BRIDGE,
    SHORTEST,  # shortest step, s; steps of at most EQUAL_SPACINGS spacings of t are too short as well
    MAY_SWITCH,  # 1: stop with SWITCH_METHOD at a value that is not finite, or if the method is unsuited
    TRIAL_STEPS,  # number of accepted steps in which a next step of at most GAP also stops with SWITCH_METHOD
    DRIVEN,  # 1: C_t or b may jump
    ROUGH,  # factor by which errors may exceed their estimates near a jump of a force, see SUDDEN_ERROR in advance.py
    SPACING,  # spacing of samples of the forces ahead of a step, s, see discontinuities.py; 0: no samples
    APART,  # largest spacing of samples in time alone, s, which are taken ahead of short steps as well
    # 1: samples follow the motion; 0: they stay at the state, because a callback raised an error along the motion
    SAMPLE_MOTION,
    BY_TIME,  # 1: forces may change suddenly with time
    BY_STATE,  # 1: forces may change suddenly with position or velocity: short steps are sampled along the motion, too
    FIRST_GIVEN,  # 1: the user has chosen the first step size; 0: the first step size is a guess, and may grow
    MAX_EVALUATION_GAP,  # longest part of a step without an evaluation of the equations, over the step size
    MAKES_MANY,  # 1: the method can take many steps in one call, without checks between them
    WATCHFUL,  # 1: steps are explicit: after a run was near a singular position, every step is checked for another one
    N_CONTROL,
) = range(N_RULE, N_RULE + 25)

# columns of `out_steps`, a row of which describes an accepted step: its size, then counters since the start; JACOBIANS
# is 0 after an explicit step of a method that switches
H, ERRORS, FAILURES, PARTITIONS, JACOBIANS, N_STEP_COLUMNS = range(6)

# `clock`, after the history
(
    T,
    H_NEXT,
    H_LIMIT,  # largest step size after a step that did not converge, s
    LIMIT_AGE,  # number of accepted steps since that step
    NEXT_OUTPUT,  # index of the next output time
    T_START,
    N_FIXED,  # number of steps of the fixed grid so far
    FAILURE_CODE,  # why steps are short: code of the last failed attempt, or DONE
    H_FAILED,  # size of the step that failed, s, for messages
    H_LONG,  # s, longest of the last steps, where older steps count less and less
    LARGEST_PIVOT,  # largest value so far of PIVOT in Work.notes, the smallest pivot of C_q
    JUMP_FROM,  # beginning of the next interval in which C_t or b jumps; infinite if none is known
    JUMP_TO,  # end of that interval
    APPLIES_JUMP,  # 1: the next step crosses that interval; new_state is the state after the jump
    ROUGH_TO,  # end of the last step that was rejected with an error above SUDDEN_ERROR
    PIVOT_HERE,  # static form: value of PIVOT in Work.notes at the end of the last step
    SAMPLED_TO,  # time of the last sample in time alone
    SAMPLED_EVERY,  # s, spacing of the last samples in time
    WIDEST_SAMPLING,  # s, the widest spacing of samples so far
    DISCONTINUITY,  # time of the next sudden change found by samples in time
    DISCONTINUITY_OF_MOTION,  # time of the next sudden change found by samples along the motion
    COMPARED,  # time at which a short step was last compared with its neighbours
    LAST_CHANGE,  # time of the last sudden change of a value
    SHORTEST_CHANGE,  # s, shortest time between two sudden changes
    MOTION_SAMPLED_TO,  # time of the last sample along the motion
    SAMPLES_MOTION,  # 1 during samples along the motion, at states that the motion may not reach
    # smallest result of least_pivot (partition.py) at output times and grid points, where steps have to end
    PIVOT_AT_OUTPUT,
    PIVOT_PASSED,  # smallest pivot within steps over LARGEST_PIVOT, while BRIDGE is SUSPENDED; 0: none yet
    N_CLOCK,
) = range(N_PAST, N_PAST + 29)

# power iterations for the largest rate, in stiffness.py and in run/messages.py
DISPLACEMENT = 1e-6  # length of finite differences, relative to the largest coordinate or velocity
INNER_TOL = 1e-8  # tolerance of Newton's method for the projected positions


def initial_direction(n_q: int) -> NDArray[np.float64]:
    """Return a direction in which neighbouring coordinates differ in size: no vibration is orthogonal to it."""
    return np.asarray(0.3 + 0.1 * (np.arange(n_q) % 7))

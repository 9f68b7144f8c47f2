"""Indices into the arrays of the integration loop, and the codes that `advance` returns.

`control` contains the settings of the loop; its first entries are the rule of step-size control. `clock` contains the
state of the loop, which `advance` continues in the next call; its first entries are the history of step-size control.
"""

import numpy as np
from numpy.typing import NDArray

# end codes, which `advance` returns
(
    ALL_OUTPUT_DONE,  # the last output time is reached
    PAUSED,  # a buffer is full, or the call has made MAX_ATTEMPTS attempts
    STEP_TOO_SMALL,  # the next step would be shorter than SHORTEST
    FIXED_STEP_FAILED,  # a step of fixed size failed
    RANK_LOST,  # C_q has lost rank: no partition can be chosen
    MAX_STEPS_REACHED,
    ROWS_VIOLATED,  # constraints that counted as redundant are violated at the end of a step
    NEAR_SINGULAR,  # a singular position is near: the caller crosses it
    SWITCH_METHOD,  # the method is unsuited: the caller continues with another one
    AT_DISCONTINUITY,  # C_t or b jumps here: the caller writes the state after the jump to new_state
    NEEDS_DENSE,  # sparse factors in fixed order cannot decide which rows are independent: the caller takes dense ones
    NEEDS_COMPILATION,  # the step is not compiled: the caller compiles it and repeats the call
) = range(12)
SUSPENDED = 0.5  # value of MAY_CROSS after all attempts to cross a singular position have failed
CONTINUE = -1  # value that functions return in place of an end code if the loop goes on

# indices in the rule of step-size control: the ratio of the next step size to the present one is SAFETY
# error**-EXPONENT, but at least FACTOR_MIN and at most FACTOR_MAX. If LEAST_ERROR > 0, the ratio also depends on the
# error of the step before (Hairer & Wanner II, IV.8); there, errors below LEAST_ERROR are replaced by LEAST_ERROR
SAFETY, EXPONENT, FACTOR_MIN, FACTOR_MAX, LEAST_ERROR, N_RULE = range(6)
# indices in the history of step-size control: size (s) and error (in tolerances) of the last accepted step
H_BEFORE, ERROR_BEFORE, N_PAST = range(3)

# indices in `control`, after the rule
(
    MAX_STEP,  # largest step (s)
    FIXED_STEP,  # fixed step size (s); 0: step-size control
    LIMIT_START,  # upper limit (s) of step sizes, H_LIMIT in `clock`, if none of the last LIMIT_MEMORY steps failed
    LIMIT_FACTOR,  # upper limit of step sizes after a failed step, relative to the size of this step
    LIMIT_MEMORY,  # number of accepted steps during which a failed step limits the step size
    MAX_STEPS,  # largest number of accepted steps
    STORE_ALL,  # 1: every accepted step is stored; 0: output times only
    SYMMETRIC,  # 1: each step uses the partition chosen at its midpoint; 0: a partition is used until it is poor
    MAX_ATTEMPTS,  # number of attempted steps after which a call returns, so that the caller checks progress and time
    # 1: stop with NEAR_SINGULAR near a singular position; 0: do not stop; SUSPENDED: do not stop near the present
    # singular position; the value is 1 again after the run has left this position
    MAY_CROSS,
    SHORTEST,  # smallest allowed step size (s); steps of up to EQUAL_SPACINGS spacings of t are not allowed, either
    MAY_SWITCH,  # 1: stop with SWITCH_METHOD at a value that is not finite, or if the method is unsuited
    TRIAL_STEPS,  # stop with SWITCH_METHOD if a next size is at most tolerances[GAP] within the first TRIAL_STEPS steps
    MAY_JUMP,  # 1: C_t or b may jump
    JUMP_RATIO,  # largest ratio of true error to error estimate in a step in which a force jumps
    SPACING,  # spacing (s) of samples of the forces ahead of a step, see discontinuities.py; 0: no samples
    TIME_SPACING,  # largest spacing (s) of samples at a fixed state, which are taken even if steps are shorter
    # 1: samples ahead follow the motion; 0: samples use the present q and v, because a callback failed along the motion
    SAMPLE_MOTION,
    BY_TIME,  # 1: forces may change suddenly with time
    BY_STATE,  # 1: forces may change suddenly with position or velocity; then short steps sample the motion, too
    FIRST_GIVEN,  # 1: the user has chosen the first step size; 0: this size is a guess, and may grow before the step
    MAX_EVALUATION_GAP,  # longest part of a step without an evaluation of the equations, relative to the step size
    TAKES_MANY,  # 1: the method can take many steps in one call, without checks between them
    CHECKS_WITHIN,  # 1: once a run has come near a singular position, check within each step whether one is near
    N_CONTROL,
) = range(N_RULE, N_RULE + 25)

# columns of `out_steps`, which has one row for each accepted step. H: step size (s); the other columns count, since the
# start of the run: rejections by the error test, failures, partitions, and Jacobians (JACOBIANS: 0 in an explicit step)
H, ERRORS, FAILURES, PARTITIONS, JACOBIANS, N_STEP_COLUMNS = range(6)

# indices in `clock`, after the history
(
    T,  # present time (s)
    H_NEXT,  # size of the next step (s)
    H_LIMIT,  # present upper limit of the step size (s); a failed step lowers it for LIMIT_MEMORY accepted steps
    LIMIT_AGE,  # number of accepted steps since the last failed step
    NEXT_OUTPUT,  # index of the next output time
    T_START,  # start time of the run (s); the grid of steps of fixed size begins there
    N_FIXED,  # number of completed steps of this grid
    FAILURE_CODE,  # code of the last failed attempt, which explains short steps; DONE: no attempt failed recently
    H_FAILED,  # size (s) of the last failed step, for messages
    H_LONG,  # longest of the last steps (s); older steps count less, see H_LONG_DECAY in step_size.py
    LARGEST_PIVOT,  # largest value so far of PIVOT in Work.notes, the smallest pivot of C_q
    JUMP_FROM,  # time (s) at which the next interval with a jump of C_t or b begins; infinite: no jump is known
    JUMP_TO,  # time (s) at which this interval ends
    APPLIES_JUMP,  # 1: the next step goes from JUMP_FROM to JUMP_TO; new_state is the state after the jump
    JUMP_END,  # end (s) of the last step that was rejected with an error above SUDDEN_ERROR
    PIVOT_HERE,  # fixed-order form: value of PIVOT in Work.notes at the end of the last step
    # samples of forces, C_t and b ahead of a step, at a fixed state or along the motion: see discontinuities.py
    SAMPLED_TO,  # time of the last sample at a fixed state (s)
    SAMPLED_EVERY,  # spacing of the last samples at a fixed state (s)
    WIDEST_SAMPLING,  # widest spacing of samples so far (s)
    DISCONTINUITY,  # time (s) of the next sudden change that samples at a fixed state show
    DISCONTINUITY_OF_MOTION,  # time (s) of the next sudden change that samples along the motion show
    COMPARED,  # beginning (s) of the last short step in which samples were compared with samples before and after it
    LAST_CHANGE,  # time (s) of the last sudden change of a force, C_t or b
    SHORTEST_CHANGE,  # shortest time between two sudden changes (s)
    MOTION_SAMPLED_TO,  # time of the last sample along the motion (s)
    SAMPLES_MOTION,  # 1 while callbacks are sampled along the motion, at states that the motion may not reach
    # smallest result of min_pivot_ratio (partition.py) at output times and at grid times of fixed steps
    PIVOT_AT_OUTPUT,
    PIVOT_PASSED,  # smallest pivot within steps, over LARGEST_PIVOT, since MAY_CROSS became SUSPENDED; 0: none yet
    N_CLOCK,
) = range(N_PAST, N_PAST + 29)

# constants of the power iterations in stiffness.py and run/messages.py. These estimate rho (1/s), the largest rate of
# the motion, from the eigenvalues of dF/dq and dF/dv, where F are the accelerations
DISPLACEMENT = 1e-6  # displacement in finite differences, relative to the largest coordinate or velocity
INNER_TOL = 1e-8  # tolerance of Newton's method for the projection of positions onto the constraints


def initial_direction(n_q: int) -> NDArray[np.float64]:
    """Return the first direction (n_q) of a power iteration; its components differ, as in a vibration."""
    return np.asarray(0.3 + 0.1 * (np.arange(n_q) % 7))

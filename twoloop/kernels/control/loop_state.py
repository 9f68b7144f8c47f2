"""Indices into `control` and `clock`, the arrays of the integration loop, and the codes that `advance` returns.

`advance` (kernels/advance.py) is the loop over steps. `control` contains the settings; the first entries are the
parameters of step-size control. `clock` contains variables, such as the present time, from which the next call of
`advance` continues; the first entries are the history of step-size control.
"""

import numpy as np
from numpy.typing import NDArray

# end codes: reasons why `advance` returns
(
    ALL_OUTPUT_DONE,  # the last output time is reached
    PAUSED,  # an array of results is full, or the call has attempted MAX_ATTEMPTS steps: call `advance` again
    STEP_TOO_SMALL,  # the size of the next step would be at most the limit, control[SHORTEST]
    FIXED_STEP_FAILED,  # a step of fixed size failed
    RANK_LOST,  # C_q has lost rank: no partition can be chosen
    MAX_STEPS_REACHED,  # the number of accepted steps has reached control[MAX_STEPS]
    ROWS_VIOLATED,  # constraints that counted as redundant are violated at the end of a step
    NEAR_SINGULAR,  # a singular position is near: the caller crosses it by special steps
    SWITCH_METHOD,  # the method does not suit the motion: the caller continues with another method
    AT_DISCONTINUITY,  # a constraint rate jumps just after clock[T]: the caller computes the state after the jump
    NEEDS_DENSE,  # the fixed-order form cannot decide which rows are independent: the caller uses a dense form
    NEEDS_COMPILATION,  # the step has no machine code yet: the caller compiles it, then calls `advance` again
    MET_SINGULAR,  # a singular position is near for the first time in the run: the caller tightens the tolerances
) = range(13)
SUSPENDED = 0.5  # value of control[MAY_CROSS] after a singular position could not be crossed: ordinary steps go on
CONTINUE = -1  # value that functions return in place of an end code if the loop goes on

# indices of the N_RULE parameters of step-size control. The next step size is SAFETY * error**-EXPONENT times the size
# of this step (`error`: of this step, in tolerances), but FACTOR_MIN times this size at least and FACTOR_MAX times at
# most. If LEAST_ERROR > 0, the larger of LEAST_ERROR and the previous error also counts (Hairer & Wanner II, IV.8)
SAFETY, EXPONENT, FACTOR_MIN, FACTOR_MAX, LEAST_ERROR, N_RULE = range(6)
# indices of the N_PAST numbers in the history: size (s) and error (in tolerances) of the last accepted step
H_BEFORE, ERROR_BEFORE, N_PAST = range(3)

# indices in `control`, after the parameters of step-size control
(
    MAX_STEP,  # largest step size (s)
    FIXED_STEP,  # size (s) of steps of fixed size; 0: step-size control chooses the sizes
    LIMIT_START,  # value (s) of clock[H_LIMIT], the upper limit of step sizes, unless a step has failed recently
    LIMIT_FACTOR,  # after a step of size h has failed, clock[H_LIMIT] is LIMIT_FACTOR * h
    LIMIT_MEMORY,  # number of accepted steps after which clock[H_LIMIT] becomes LIMIT_START again
    MAX_STEPS,  # largest number of accepted steps
    STORE_ALL,  # 1: the states after all accepted steps are stored; 0: only states at output times
    SYMMETRIC,  # 1: each step chooses the partition at its midpoint; 0: a partition is kept as long as it is good
    MAX_ATTEMPTS,  # number of attempted steps after which `advance` returns; its caller then checks progress and time
    # 1: near a singular position, `advance` returns NEAR_SINGULAR, and the caller crosses the position. 0: `advance`
    # never returns this code. SUSPENDED: like 0 near the present singular position; far away from it, 1 is stored here
    MAY_CROSS,
    SHORTEST,  # steps must be longer than this (s), and longer than EQUAL_SPACINGS spacings of floating-point times
    MAY_SWITCH,  # 1: `advance` returns SWITCH_METHOD if a value is not finite, or a step returns UNSUITED; 0: never
    # number of steps for which a method is on trial; -1: no trial. If a step size proposed in these steps is at most
    # tolerances[GAP], the longest allowed time between evaluations, the trial fails: `advance` returns SWITCH_METHOD
    TRIAL_STEPS,
    MAY_JUMP,  # 1: a constraint rate, C_t or b (in A v + b = 0), may jump; 0: constraint rates are continuous
    JUMP_RATIO,  # largest ratio of a step's true error to its error estimate if a force jumps within the step
    SPACING,  # time (s) between samples of the forces ahead of a step, see discontinuities.py; 0: no samples
    TIME_SPACING,  # longest time (s) between samples of the forces at a fixed state, see discontinuities.py
    SAMPLE_MOTION,  # 1: forces may be sampled along predicted motion; 0: no more, since a callback raised an exception
    BY_TIME,  # 1: a force or a constraint rate (C_t, b) may change suddenly with time; 0: none does
    BY_STATE,  # 1: a force may change suddenly with q or v, and is sampled in steps longer than SPACING; 0: none does
    FIRST_GIVEN,  # 1: the user has chosen the first step size; 0: it is a guess, and may grow before a step is accepted
    MAX_EVALUATION_GAP,  # longest time in a step between two evaluations of the equations, relative to the step size
    TAKES_MANY,  # 1: the method has `attempt_many`, which takes steps without checks between them; 0: it does not
    CHECKS_WITHIN,  # 1: once a run has come near a singular position, check pivots of C_q within each step; 0: never
    N_CONTROL,
) = range(N_RULE, N_RULE + 25)

# columns of `out_steps`, which has one row for each accepted step. H: step size (s). The other columns count since the
# start of the run: steps rejected for their ERRORS; FAILURES of steps; chosen PARTITIONS; JACOBIANS evaluated by an
# implicit method (0 in the row of an explicit step)
H, ERRORS, FAILURES, PARTITIONS, JACOBIANS, N_STEP_COLUMNS = range(6)

# indices in `clock`, after the history of step-size control
(
    T,  # present time (s)
    H_NEXT,  # proposed size of the next step (s)
    H_LIMIT,  # present upper limit of the step size (s); a failed step lowers it for LIMIT_MEMORY accepted steps
    LIMIT_AGE,  # number of accepted steps since the last failed step
    NEXT_OUTPUT,  # index of the next output time in the array `outputs`
    T_START,  # start time of the run (s); steps of fixed size h end on the grid T_START + k h
    N_FIXED,  # index k of the last grid time T_START + k h that steps of fixed size h have reached
    FAILURE_CODE,  # code of the last failed step, for messages about short steps; DONE: no step failed recently
    H_FAILED,  # size (s) of the step that failed last, or that caused the code ROWS_VIOLATED or SWITCH_METHOD
    H_LONG,  # longest recent step (s): after a step, the larger of its size and H_LONG_DECAY times the old H_LONG
    LARGEST_PIVOT,  # largest value so far of w.pivot, the smallest pivot in the elimination of C_q
    JUMP_FROM,  # a constraint rate (C_t, b) jumps between this time (s) and JUMP_TO; infinite: no later jump is known
    JUMP_TO,  # end (s) of the short time span with the next known jump of a constraint rate (C_t, b)
    APPLIES_JUMP,  # 1: the next step ends at JUMP_TO, in the state that `new_state` already contains; 0: ordinary step
    JUMP_END,  # end (s) of the last step rejected with a very large error: a force may jump before this time
    # smallest pivot at the end of the last step accepted, or rejected by `ends_near_singular` (fixed-order form)
    PIVOT_HERE,
    # forces, C_t and b are sampled ahead of a step, at a fixed state (where the step starts) or along predicted motion
    SAMPLED_TO,  # time (s) of the last sample at a fixed state
    SAMPLED_EVERY,  # spacing (s) of the last samples of forces before SAMPLED_TO
    WIDEST_SAMPLING,  # longest time (s) so far from one sample of the forces to the next
    DISCONTINUITY,  # time (s) of the next sudden change of a force, C_t or b at a fixed state; infinite: none is known
    DISCONTINUITY_OF_MOTION,  # time (s) of the next sudden change of a force, C_t or b in the motion; infinite: unknown
    COMPARED,  # start time (s) of the last short step that was searched for pulses of a force
    LAST_CHANGE,  # time (s) of the last sudden change of a force, C_t or b; -inf: none
    SHORTEST_CHANGE,  # shortest time (s) from one sudden change of a force, C_t or b to the next; infinite: unknown
    MOTION_SAMPLED_TO,  # time (s) of the last sample along the motion
    SAMPLES_MOTION,  # 1 while callbacks are called at predicted states, where exceptions do not end a run; otherwise 0
    # minimum of (smallest / largest pivot of [C_q; A]) over the output times and the ends of steps of fixed size so far
    PIVOT_AT_OUTPUT,
    # smallest pivot of C_q within steps taken while MAY_CROSS was SUSPENDED, divided by LARGEST_PIVOT; 0: no such step
    PIVOT_PASSED,
    N_CLOCK,
) = range(N_PAST, N_PAST + 29)

# constants of the power iterations in stiffness.py and run/messages.py, which estimate the largest rate of the motion
# (1/s) from eigenvalues of dF/dq and dF/dv, where F(q, v) are the accelerations
DISPLACEMENT = 1e-6  # displacement of q (or of v) in finite differences, relative to max(1, its largest |entry|)
INNER_TOL = 1e-8  # Newton's method, which projects displaced positions, stops after a correction of at most this


def initial_direction(n_q: int) -> NDArray[np.float64]:
    """Return a vector (n_q) with which a power iteration begins; its components differ, as in a vibration mode."""
    return np.asarray(0.3 + 0.1 * (np.arange(n_q) % 7))

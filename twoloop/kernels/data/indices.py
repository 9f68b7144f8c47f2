"""Indices into the arrays that kernels share, and the codes that they return.

Kernels keep their state in arrays of numbers, because compiled code passes arrays by reference. Each group below names
the indices of one array; control/loop_state.py has the indices that only the loop over steps uses.
"""

from twoloop.kernels.compile.callbacks import OPTIONAL

# codes: DONE, or the reason why an evaluation or a step failed
(
    DONE,
    OUTER_DIVERGED,
    INNER_DIVERGED,
    SINGULAR,
    NOT_FINITE,
    MASS_NOT_DEFINITE,
    GAMMA_INACCURATE,
    RANK_DIFFERS,
    ROWS_CONTRADICT,
    NEEDS_DENSE,  # the static form cannot decide whether rows are independent: the caller continues with a dense one
    NOT_LOADED,  # the caller has to load the machine code of the step
    UNSUITED,  # the method does not suit the motion here: the caller continues with another one
    STOPPED,  # the time limit has passed, see TIME_IS_UP
) = range(13)

# Functions.flags: whole numbers that describe a system to kernels. BANDWIDTH is -1 if linear algebra is not banded.
# FORM is the form of the linear equations of accelerations, see linalg/saddle_point.py; DENSE_FORM replaces it if
# sparse factors have too many entries. STRAIGHT is 1 if the inner loop is code generated for the mechanism
CONSTANT_MASS, DIAGONAL_MASS, BANDWIDTH, FORM, DENSE_FORM, STRAIGHT, FIRST_GIVEN = range(7)
MULTIPLIERS, NULL_SPACE, AUGMENTED, STATIC = range(4)  # values of FORM; for STATIC see sparse_inner_loop.py
GIVEN = {name: index for index, name in enumerate(OPTIONAL, FIRST_GIVEN)}  # flags: 1 if an optional callback is given
N_FLAGS = FIRST_GIVEN + len(GIVEN)
CONSTRAINT_RATE_GIVEN, GAMMA_GIVEN, FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN, KINEMATICS_GIVEN = (
    GIVEN[name] for name in ("constraint_rate", "gamma", "force_by_q", "force_by_v", "reaction_by_q", "kinematics")
)
NONHOLONOMIC_RATE_GIVEN, NONHOLONOMIC_GAMMA_GIVEN = (
    GIVEN[name] for name in ("nonholonomic_rate", "nonholonomic_gamma")
)
MASS_VALUES_GIVEN, JACOBIAN_VALUES_GIVEN = (GIVEN[name] for name in ("mass_values", "jacobian_values"))

# Work.counters: counts of a run
(
    N_ACCEPTED,
    N_REJECTED_ERROR,
    N_REJECTED_CONVERGENCE,
    N_OUTER,
    N_INNER,
    N_EVALUATIONS,
    N_PARTITIONS,
    N_FACTORIZATIONS,
    N_JACOBIANS,
    N_COUNTERS,
) = range(10)

# Work.notes: values that one kernel stores for another
(
    SENSITIVITY,  # max|Cqd^-1 Cqi| after the first step under this partition; 0: not known yet
    ORIENTATION,  # sign of det C_qd at the last accepted state under this partition; 0: not known yet
    ORIENTATION_NEW,  # sign of det C_qd at the end of the attempted step; 0: not known yet
    FAULT_KIND,  # index in Functions of the callback that returned a value that is not finite; -1: none known
    FAULT_TIME,  # time of that evaluation
    GAMMA_REQUIRED,  # required relative accuracy of Gamma by differences, see evaluation/constraints.py
    GAMMA_SHARE,  # length of the differences over longest_difference
    GAMMA_ACCURACY,  # relative accuracy of Gamma when GAMMA_SHARE was chosen
    GAMMA_SCALE,  # largest entry of Gamma so far
    REUSE,  # largest last correction of a position after which the factors of C_qd are not computed again
    ROUNDED,  # value of REUSE at states that may be accepted: rounding of the positions
    GENERATION,  # number of partitions so far
    RANK,  # rank of C_q, if it differs from the rank for which the workspace is allocated
    RANK_V,  # rank of C_q and A together, if it differs from the rank for which the workspace is allocated
    CONTRADICTION,  # index of a row that was considered redundant but is violated
    PIVOT,  # smallest pivot of the last full pivoting, rows scaled to 1: small near a singular position
    NEARLY_SINGULAR,  # 1: the run has come near a singular position, or does not check for one
    NEAR_NOW,  # 1: a singular position was near at the last check; 2: near it, a step did not check its defect
    MASS_SCALE,  # factor on M in the augmented matrix, see linalg/saddle_point.py
    FACTORED,  # 1: the factors of the linear problem belong to w.M and w.G
    KNOWN,  # 1: w.Rate and w.Gamma[:n_c] belong to the state, computed by the fused callback
    BY_GENERAL,  # 1: the general inner loop computed the last state in place of the generated code
    EXPLICIT_STEP,  # 1: a method that switches took an explicit step
    DEFECT,  # largest defect of the attempted step over what the tolerances allow; -1: not evaluated
    LARGEST_DEFECT,  # largest defect of the accepted steps
    UNCHECKED,  # number of accepted steps for which no defect was evaluated
    WIDEST_GAP,  # s, the longest time between two evaluations within accepted steps
    KINK_BEFORE,  # time of the last known jump of C_t or b
    KINK_AFTER,  # time of the next known jump of C_t or b
    LEANING,  # largest coefficient of an independent row in a redundant one, when this partition was chosen
    SMALLEST,  # static form: smallest pivot of a row over its size, the squared sine of its angle to the other rows
    TIME_IS_UP,  # 1: evaluations of stages return STOPPED; another thread sets it while steps are computed
    N_NOTES,
) = range(33)

# tolerances of eq. (26) of the paper, as the array that steps read
(
    RTOL,
    ESTIMATE,  # 0 for a fixed step, else 1
    LEAST,  # the smallest tolerance
    GAP,  # s, the longest time between two evaluations of the equations
    LOOK,  # s, the longest time between two evaluations in steps that evaluate their defect between nodes
    ATOL,  # from this index on: the absolute tolerance of each coordinate and of its velocity
) = range(6)
LONGEST_UNSEEN = 0.01  # GAP over the duration of the run
UNTRUE = 30.0  # in tolerances: larger errors of velocities next to a singular position are reported

# kinds of intervals between accepted states, for dense output: which values of the states the polynomials interpolate
WINDOW = 4  # number of states that a polynomial goes through
(
    APART,  # q and v in one polynomial, v and a in another: errors of q and v are independent, and steps are small
    VELOCITIES,  # q and v in one polynomial and its derivative: a contains the noise of stiff modes
    ACCELERATIONS,  # q, v and a in one polynomial and its derivatives
    ACROSS,  # the same as ACCELERATIONS, for a step across a singular position
    JUMP,  # no polynomial: velocities jump within a few spacings of floating-point numbers
) = range(5)
# columns of the table of intervals, a row of which describes one interval with output times: FIRST_OWN and LAST_OWN are
# the states at its ends, and the output times with indices from FIRST_TIME to END_TIME - 1 are within it. No polynomial
# extends beyond the states LOW and HIGH, at which velocities jump
FIRST_OWN, LAST_OWN, KIND, FIRST_TIME, END_TIME, LOW, HIGH, N_COLUMNS = range(8)

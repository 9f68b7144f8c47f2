"""Indices into the arrays that kernels share, and the codes that kernels return.

Kernels (compiled functions) keep their state in arrays, because compiled code passes arrays by reference. Each group
below names the indices of one array; control/loop_state.py has the indices that only the loop over steps uses. Kernels
read elements of `Work.notes`, `Work.counters` and `Functions.flags` as attributes: w.pivot is w.notes[PIVOT].
"""

from twoloop.kernels.compile.callbacks import OPTIONAL_KINDS

# codes that kernels return: DONE, or the reason why an evaluation or a step failed
(
    DONE,  # the evaluation or step has succeeded
    OUTER_DIVERGED,  # the iteration for the stages of a step (outer loop) does not converge
    INNER_DIVERGED,  # Newton's method for positions that satisfy the constraints (inner loop) does not converge
    SINGULAR,  # the dependent columns of [C_q; A] or the equations for accelerations are singular
    NOT_FINITE,  # a callback returned NaN or infinity
    MASS_NOT_DEFINITE,  # the mass matrix is not positive definite
    GAMMA_INACCURATE,  # finite differences do not yield Gamma as accurately as w.gamma_required
    RANK_DIFFERS,  # the workspace was allocated for other ranks of C_q and [C_q; A] than w.rank and w.rank_v
    ROWS_CONTRADICT,  # redundant constraints are violated: they contradict the independent constraints
    NEEDS_DENSE,  # the fixed-order form cannot decide which rows are independent: the caller uses a dense form
    NOT_LOADED,  # the machine code of the step is missing: the caller loads it, then repeats the call
    UNSUITED,  # the method does not suit the motion: the caller continues with another method
    STOPPED,  # an evaluation was left out because the time limit of the run has passed, see TIME_IS_UP
) = range(13)

# indices in Functions.flags, integers that describe a system to kernels
(
    CONSTANT_MASS,  # 1: the mass matrix M is constant; 0: it varies
    DIAGONAL_MASS,  # 1: the mass matrix M is diagonal; 0: it may have other entries
    BANDWIDTH,  # bandwidth of the mass matrix if it is factored as a banded matrix; -1: no banded factors
    FORM,  # algebra that solves for accelerations and multipliers: MULTIPLIERS, NULL_SPACE, AUGMENTED or FIXED_ORDER
    DENSE_FORM,  # value that FORM gets instead of AUGMENTED if the sparse factors exceed the limits in markowitz_lu.py
    IS_GENERATED,  # 1: the inner loop is code generated for the mechanism; 0: it is general code for any mechanism
    FIRST_GIVEN,  # index of the first of the flags that say which optional callbacks the user gives, see GIVEN
) = range(7)
MULTIPLIERS, NULL_SPACE, AUGMENTED, FIXED_ORDER = range(4)  # values of FORM, see saddle_point.py, sparse_inner_loop.py
# for each optional callback: index, in Functions.flags, of a flag that is 1 if the user gives this callback, else 0
GIVEN = {name: index for index, name in enumerate(OPTIONAL_KINDS, FIRST_GIVEN)}
N_FLAGS = FIRST_GIVEN + len(GIVEN)
FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN, MASS_VALUES_GIVEN = (
    GIVEN[name] for name in ("force_by_q", "force_by_v", "reaction_by_q", "mass_values")
)

# indices in Work.counters: numbers of steps, iterations, evaluations etc. since the start of the run
(
    N_ACCEPTED,  # number of accepted steps
    N_REJECTED_ERROR,  # number of steps rejected for their error, or repeated at a jump or near a singular position
    N_REJECTED_CONVERGENCE,  # number of steps that failed, for example because an iteration did not converge
    N_OUTER,  # number of iterations of the outer loop, each of which evaluates all stages of a step
    N_INNER,  # number of iterations of the inner loop, which moves positions onto the constraints
    N_EVALUATIONS,  # number of solutions of the equations for accelerations
    N_PARTITIONS,  # how often dependent coordinates (fixed-order form: independent rows) have been chosen
    N_FACTORIZATIONS,  # number of factorizations of matrices
    N_JACOBIANS,  # number of evaluations of the derivatives of accelerations, for Newton's method in the outer loop
    N_COUNTERS,
) = range(10)

# indices in Work.notes: values that one kernel stores for another
(
    SENSITIVITY,  # largest |dq_dependent / dq_independent| at this partition's first check, at least 1; 0: not checked
    ORIENTATION,  # sign of det C_qd (dependent columns of C_q) at the last accepted state of this partition; 0: unknown
    ORIENTATION_NEW,  # sign of det C_qd (dependent columns of C_q) at the end of the attempted step; 0: not known
    FAULT_KIND,  # index in Functions of a callback that returned NaN or infinity; -1: none known
    FAULT_TIME,  # time (s) at which the callback FAULT_KIND returned NaN or infinity
    GAMMA_REQUIRED,  # allowed error of Gamma by finite differences (evaluation/constraints.py), relative to GAMMA_SCALE
    GAMMA_STEP_RATIO,  # time step of finite differences for Gamma, relative to the result of `largest_difference_step`
    GAMMA_ACCURACY,  # error of Gamma, relative to GAMMA_SCALE, when GAMMA_STEP_RATIO was chosen last
    GAMMA_SCALE,  # errors of Gamma are relative to this size: largest of all |Gamma_i| and sum_j |G_ij a_j| so far
    REUSE,  # at stages, the inner loop evaluates C_q again only if its last correction of positions exceeds this
    ROUNDED,  # rounding error of positions; it replaces the limit REUSE at the ends of steps
    GENERATION,  # number of partitions so far: a change of this number shows that the partition has changed
    RANK,  # rank of C_q, stored only if the workspace was allocated for another rank (code RANK_DIFFERS)
    RANK_V,  # rank of [C_q; A], stored together with RANK
    CONTRADICTION,  # with the code ROWS_CONTRADICT: index of a violated row of [C_q; A]
    PIVOT,  # smallest pivot of the last elimination of C_q (rows scaled to maximum 1); fixed-order form: sqrt(SMALLEST)
    # 0: very short steps trigger a check for a singular position. 1: they do not, because of the method, or because a
    # singular position has been near. 2 (only in the fixed-order form): one is near now, and stages are projected
    NEARLY_SINGULAR,
    NEAR_NOW,  # 1: a singular position was near at the last check; 2: a check with a new partition is needed; 0: else
    MASS_SCALE,  # factor by which M is multiplied in the augmented matrix, see linalg/saddle_point.py
    FACTORED,  # 1: the factors of the equations for accelerations belong to w.M and w.G; 0: M or G has changed since
    HAS_GAMMA,  # 1: the callback `kinematics` has computed w.Rate and w.Gamma[:n_c] at the present state; 0: it has not
    USED_GENERAL,  # 1: the general inner loop computed the last projected state; 0: generated code did
    EXPLICIT_STEP,  # 1: with a pair of methods (stiffness.py), the last attempted step was explicit; 0: else
    DEFECT,  # largest defect of accelerations in the attempted step, relative to the allowed defect; -1: not evaluated
    LARGEST_DEFECT,  # largest value of DEFECT in the accepted steps
    UNCHECKED,  # number of accepted steps, since the start of the run, whose defect has not been evaluated
    WIDEST_GAP,  # longest time (s) between two evaluations of the equations within accepted steps
    LAST_JUMP,  # time (s) of the last known jump of a constraint rate (C_t, b); -infinite: none
    NEXT_JUMP,  # time (s) of the next known jump of a constraint rate (C_t, b), or end of the run; infinite: unknown
    # largest |coefficient| that expresses redundant rows by independent ones, at this partition's first check; 0: none
    MAX_COEFFICIENT,
    SMALLEST,  # fixed-order form: least sin^2 of a row's angle to the span of earlier rows of C_q; -1: M not definite
    TIME_IS_UP,  # 1 (set by another thread): the time limit has passed, and evaluations return STOPPED; 0: not yet
    N_NOTES,
) = range(33)


def _group(first: str, end: str) -> dict[str, int]:
    """Return {name in lower case: value} for the constants above from `first` to the last one before `end`."""
    names = list(globals())
    return {name.lower(): globals()[name] for name in names[names.index(first) : names.index(end)]}


# for each attribute in kernels, such as w.pivot, w.n_evaluations and f.form: index of the array element that it reads
NOTES, COUNTERS = _group("SENSITIVITY", "N_NOTES"), _group("N_ACCEPTED", "N_COUNTERS")
FLAGS = _group("CONSTANT_MASS", "FIRST_GIVEN") | {f"{kind}_given": index for kind, index in GIVEN.items()}

# indices in `tolerances`, an array that steps read: relative and absolute tolerances (eq. (26) of the paper) and limits
(
    RTOL,  # relative tolerance
    ESTIMATE,  # 1: steps estimate their errors; 0: they do not, because the step size is fixed
    LEAST,  # the smaller one of the relative tolerance and the smallest absolute tolerance
    GAP,  # longest allowed time (s) between two evaluations of the equations
    DEFECT_GAP,  # longest allowed time (s) between two evaluations in steps that evaluate their defect between nodes
    ATOL,  # index of the first absolute tolerance; each coordinate has one, which applies to its velocity, too
) = range(6)
MAX_GAP_RATIO = 0.01  # tolerances[GAP] (longest allowed time between two evaluations) / duration of the run
REPORTED_ERROR = 30.0  # near a singular position, velocity errors above this number of tolerances are reported

WINDOW = 4  # number of accepted states that a polynomial of dense output interpolates
# kinds of intervals between accepted states, which tell what the polynomials of dense output interpolate
(
    SEPARATE,  # one polynomial interpolates q and v, and yields q; another interpolates v and a, and yields v
    VELOCITIES,  # one polynomial interpolates q and v, but not the accelerations a, which contain noise of stiff modes
    ACCELERATIONS,  # one polynomial interpolates q, v and a in the interval
    ACROSS,  # one polynomial interpolates q, v and a, across a singular position, or after another method took over
    JUMP,  # no polynomial: velocities jump in the interval, which is only a few spacings of floating-point times long
) = range(5)
# columns of the table of intervals, which has one row for each interval that contains output times
(
    FIRST_OWN,  # index of the accepted state at the beginning of the interval
    LAST_OWN,  # index of the accepted state at the end of the interval
    KIND,  # kind of the interval: SEPARATE, VELOCITIES, ACCELERATIONS, ACROSS or JUMP
    FIRST_TIME,  # index of the first output time in the interval
    END_TIME,  # 1 + index of the last output time in the interval
    LOW,  # index of the first state that the polynomial may interpolate: start of the run, or state after a jump of v
    HIGH,  # index of the last state that the polynomial may interpolate: end of the run, or state before a jump of v
    N_COLUMNS,
) = range(8)

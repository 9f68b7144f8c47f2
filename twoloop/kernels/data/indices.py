"""Indices into the arrays that kernels share, and the codes that they return.

Kernels keep their state in arrays of numbers, because compiled code passes arrays by reference. Each group below names
the indices of one array; control/loop_state.py has the indices that only the loop over steps uses. In kernels, elements
of `Work.notes`, `Work.counters` and `Functions.flags` are attributes, such as w.pivot for w.notes[PIVOT].
"""

from twoloop.kernels.compile.callbacks import OPTIONAL_KINDS

# codes that kernels return: DONE, or the reason why an evaluation or a step failed
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
    NEEDS_DENSE,  # the fixed-order form cannot decide which rows are independent: the caller takes a dense form
    NOT_LOADED,  # the caller has to load the machine code of the step
    UNSUITED,  # the method does not suit the motion: the caller continues with another method
    STOPPED,  # the time limit of the run has passed, see TIME_IS_UP
) = range(13)

# indices in Functions.flags, whole numbers that describe a system to kernels
(
    CONSTANT_MASS,  # 1: M is constant
    DIAGONAL_MASS,  # 1: M is diagonal
    BANDWIDTH,  # bandwidth of M for banded linear algebra; -1: linear algebra is not banded
    FORM,  # form of the linear equations for accelerations: one of the four below, see linalg/saddle_point.py
    DENSE_FORM,  # the value of FORM to use if sparse factors have too many entries
    IS_GENERATED,  # 1: the inner loop is code generated for the mechanism
    FIRST_GIVEN,  # first index of the flags in GIVEN
) = range(7)
MULTIPLIERS, NULL_SPACE, AUGMENTED, FIXED_ORDER = range(4)  # values of FORM; for FIXED_ORDER see sparse_inner_loop.py
# indices of the flags of optional callbacks: 1 if the callback is given
GIVEN = {name: index for index, name in enumerate(OPTIONAL_KINDS, FIRST_GIVEN)}
N_FLAGS = FIRST_GIVEN + len(GIVEN)
FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN, REACTION_BY_Q_GIVEN, MASS_VALUES_GIVEN = (
    GIVEN[name] for name in ("force_by_q", "force_by_v", "reaction_by_q", "mass_values")
)

# indices in Work.counters: numbers of steps, iterations, evaluations etc. since the start of the run
(
    N_ACCEPTED,
    N_REJECTED_ERROR,
    N_REJECTED_CONVERGENCE,
    N_OUTER,  # number of iterations of the outer loop, which computes the stages of steps
    N_INNER,  # number of iterations of the inner loop, which projects positions onto the constraints
    N_EVALUATIONS,
    N_PARTITIONS,
    N_FACTORIZATIONS,
    N_JACOBIANS,
    N_COUNTERS,
) = range(10)

# indices in Work.notes: values that one kernel stores for another
(
    SENSITIVITY,  # max|C_qd^-1 C_qi| after the first step with this partition; 0: not known yet
    ORIENTATION,  # sign of det C_qd at the last accepted state with this partition; 0: not known yet
    ORIENTATION_NEW,  # sign of det C_qd at the end of the attempted step; 0: not known yet
    FAULT_KIND,  # index in Functions of the callback that returned a value that is not finite; -1: none known
    FAULT_TIME,  # time (s) at which a callback returned a value that is not finite
    GAMMA_REQUIRED,  # required relative accuracy of Gamma by differences, see evaluation/constraints.py
    GAMMA_STEP_RATIO,  # time step of the differences for Gamma, relative to largest_difference_step
    GAMMA_ACCURACY,  # relative accuracy of Gamma when GAMMA_STEP_RATIO was chosen
    GAMMA_SCALE,  # largest entry of Gamma so far
    REUSE,  # the factors of C_qd are not renewed if the last correction of positions is at most this
    ROUNDED,  # rounding error of positions; replaces REUSE when a state that may be accepted is computed
    GENERATION,  # number of partitions that have been chosen in the run
    RANK,  # rank of C_q, stored if the workspace is allocated for another rank
    RANK_V,  # rank of C_q and A together, stored if the workspace is allocated for another rank
    CONTRADICTION,  # index of a row that is violated although it counted as redundant
    PIVOT,  # smallest pivot of the last full pivoting, for rows scaled to 1; small near a singular position
    NEARLY_SINGULAR,  # 1: the run has come near a singular position, or does not check for singular positions
    NEAR_NOW,  # 1: a singular position was near at the last check; 2: the next check must first renew the partition
    MASS_SCALE,  # factor on M in the augmented matrix, see linalg/saddle_point.py
    FACTORED,  # 1: the factors of the linear problem belong to w.M and w.G
    HAS_GAMMA,  # 1: the callback `kinematics` has computed w.Rate and w.Gamma[:n_c] for the current state
    USED_GENERAL,  # 1: the general inner loop, not the generated code, computed the last state
    EXPLICIT_STEP,  # 1: the last attempted step of a pair of methods was explicit
    DEFECT,  # largest defect of the attempted step, relative to the allowed defect; -1: not evaluated
    LARGEST_DEFECT,  # largest value of DEFECT in the accepted steps
    UNCHECKED,  # number of accepted steps whose defect was not evaluated
    WIDEST_GAP,  # longest time (s) between two evaluations within accepted steps
    LAST_JUMP,  # time (s) of the last known jump of C_t or b
    NEXT_JUMP,  # time (s) of the next known jump of C_t or b
    MAX_COEFFICIENT,  # largest coefficient of an independent row in a redundant row at the last partition; 0: unknown
    SMALLEST,  # fixed-order form: smallest squared sine of the angle from a row to previous rows, see sparse_ldl.py
    TIME_IS_UP,  # 1, set by another thread: the time limit of the run has passed, and evaluations of stages end
    N_NOTES,
) = range(33)


def _group(first: str, end: str) -> dict[str, int]:
    """Return the indices above, by names in lower case, from the name `first` to the name before `end`."""
    names = list(globals())
    return {name.lower(): globals()[name] for name in names[names.index(first) : names.index(end)]}


# names under which kernels read and write elements of these arrays, such as w.pivot, w.n_evaluations and f.form
NOTES, COUNTERS = _group("SENSITIVITY", "N_NOTES"), _group("N_ACCEPTED", "N_COUNTERS")
FLAGS = _group("CONSTANT_MASS", "FIRST_GIVEN") | {f"{kind}_given": index for kind, index in GIVEN.items()}

# indices in `tolerances`, the array that steps read; for the tolerances see eq. (26) of the paper
(
    RTOL,
    ESTIMATE,  # 1: errors of steps are estimated; 0: not, because the step size is fixed
    LEAST,  # smallest tolerance of a coordinate or a velocity
    GAP,  # longest time between two evaluations of the equations (s)
    DEFECT_GAP,  # longest time (s) between two evaluations in steps that evaluate their defect between nodes
    ATOL,  # first index of the absolute tolerances: one for each coordinate and its velocity
) = range(6)
MAX_GAP_RATIO = 0.01  # value of GAP, relative to the duration of the run
REPORTED_ERROR = 30.0  # velocity errors of more tolerances than this are reported near a singular position

WINDOW = 4  # number of states that a polynomial of dense output interpolates
# kinds of intervals between accepted states, for dense output: which data do the polynomials interpolate?
(
    SEPARATE,  # one polynomial for q (through q and v), another for v (through v and a): their errors are independent
    VELOCITIES,  # one polynomial through q and v, not a, because a contains the noise of stiff modes
    ACCELERATIONS,  # one polynomial through q, v and a
    ACROSS,  # same as ACCELERATIONS, for a step across a singular position
    JUMP,  # no polynomial: the interval is a few spacings of floating-point numbers long, and velocities jump in it
) = range(5)
# columns of the table of intervals, which has one row for each interval that contains output times
(
    FIRST_OWN,  # index of the state at the beginning of the interval
    LAST_OWN,  # index of the state at its end
    KIND,  # kind of the interval
    FIRST_TIME,  # index of the first output time in the interval
    END_TIME,  # 1 + index of the last output time in the interval
    LOW,  # index of the first state that the polynomial may interpolate; velocities jump before it
    HIGH,  # index of the last state that the polynomial may interpolate; velocities jump after it
    N_COLUMNS,
) = range(8)

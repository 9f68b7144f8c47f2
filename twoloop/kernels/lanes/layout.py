"""Layout of the memory that runs in lanes work in, what kernels call, and how a run in a lane may end.

What kernels call are functions made for a mechanism, and the step of a method.
"""

from typing import Any

from numba import types
from numba.extending import typeof_impl

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, has_wide_vectors
from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.data.common import INTEGERS, merged

# how a run ends: it reaches the end of the span, or is left to a run of its own for one of these reasons
UNDECIDED, ENDED = 0, 1
NO_START, NO_STATE, NO_VALUES, OFTEN_REFUSED, MANY_STEPS, UNLIKE = range(-6, 0)


LANES = 8 if has_wide_vectors() else 4  # runs side by side: of two vectors each number would take two registers

# vectors in `work`, one number for each lane; behind them STATE, NEW, PREDICTED, ... as `places` has it
(
    T,
    AHEAD,
    UNIT,
    H,
    X,
    FINE,  # 1: of the lanes that a task is for; what it leaves 1 could be done
    DEFECT,
    OFF,
    LENGTH,
    LONGEST,  # that the step may be, s
    REQUESTED,  # 1: the lanes that begin a run, or in which a state is wanted
    WORST,  # defect within the step
    REFUSED,  # steps, one after another
    RUNNING,
    RUN,  # run
    REACHED,  # of the times at which states are wanted
    LEFT_TO_MOVE,
    MOVED_BEFORE,
    ACCEPTED,
    FRESH,  # 1: lanes whose run has not taken a step yet
    ERROR,  # of a step, over the tolerances
    WANTED,  # step, before it is cut short by the end of the run
    H_NEXT,
    H_LIMIT,  # of steps, after one that failed ...
    LIMIT_AGE,  # ... so many steps ago
    ROUGH_TO,  # where the last step ended that was refused for a sudden error
    SHIFT,  # by which places within a step are moved
    EVALUATED,  # how often the equations were in the step, besides what `settings` tell
    PAST,  # of controller.py, of one lane after the other
    _MORE_PAST,
    N_FIELDS,
) = range(31)
# functions made for a mechanism, (order, control, work), on what lies in `work`
TASKS = (
    "approach",  # positions of NEW, at AHEAD, moved towards the constraints, of the lanes that are FINE
    "refine",  # the same of those that are LEFT_TO_MOVE, and velocities, and A and LAM there; FINE: there by now
    "redundant",  # whether rows that do not count hold at NEW
    "departure",  # OFF: of a step H from STATE by PREDICTED to NEW
    "commit",  # NEW becomes STATE where ACCEPTED
)
TASKS_OF_STARTS = (
    "rows",
)  # C, C_t, entries of C_q at NEW and AHEAD, in the memory of the method; FINE: where they have values
TASKS_OF_STAGES = ("accelerate",)  # A at NEW as it stands
# NEW, X after the BEGIN of the step, and ERROR, if that is the whole step; FINE stays where it could be done
TASKS_OF_EXPLICIT = ("stages",)
TASKS_OF_SERIES = (
    "series",  # coefficients about STATE at T, in units of time UNIT
    "lengths",  # LENGTH in units, H and X of the steps of the lanes that can go on, which are FINE
    "check_within",  # WORST: the largest defect within a step H; AHEAD: its end
    "evaluate",  # NEW, PREDICTED and FOUND: the state and its accelerations by the series, X units of time on
    "defect",  # DEFECT: of A at NEW, the end of a step H
    "judge",  # ACCEPTED: the steps that are, and how long the next one may be
)
CODE = Reference("LaneKit", {})
ALL_TASKS = (*TASKS, *TASKS_OF_STARTS, *TASKS_OF_STAGES, *TASKS_OF_EXPLICIT, *TASKS_OF_SERIES)
CODE.add_llvm_functions(dict.fromkeys(ALL_TASKS, types.none(types.int64, VECTOR, VECTOR)))
# of a method, (code, settings, control, options, work, status, n_steps, within): a step H of each lane that runs, and
# whether it is ACCEPTED, with its end in NEW, A and LAM; or, `within` the step that was just accepted, NEW, X seconds
# after its beginning, of the lanes that FINE names, off the constraints as yet
STEP = types.void(CODE, INTEGERS, *[VECTOR] * 3, *[INTEGERS] * 2, types.boolean)
CODE.add_function("step", STEP)

# of the memory of an explicit method, in n vectors: accelerations at STATE, the state at which the step begins (twice
# n), velocities before they are put on the constraints, and accelerations of the stages
START, BEGIN, _BEGIN_V, PREDICTED_V, SLOPES = range(5)

N, N_ROWS, ORDER, CHECKS_REDUNDANT, N_NUMBERS, N_EVALUATIONS = range(6)  # in `settings`
T0, T1, GAP, RTOL, ATOL = range(5)  # in `control`; from ATOL on a tolerance for each coordinate

SHORTEST = 1e-13  # step, of the time


class LaneKit:
    """Hold the functions made for a mechanism and the step of a method, as kernels get them."""

    def __init__(self, own: GeneratedFunctions, step: Any = None):
        self.__dict__.update(dict.fromkeys(ALL_TASKS, 0))
        self.__dict__.update(own.addresses)
        self.own, self.step = own, step
        self.table = CODE.table(self)
        self.address = self.table.ctypes.data


@typeof_impl.register(LaneKit)
def _type_of_kit(value: Any, context: Any) -> Any:
    return CODE


def places(n, n_rows, n_numbers):
    """Return where STATE, NEW, PREDICTED, FOUND, A, LAM, the numbers of the code and the memory of the method begin.

    Counted in vectors.
    """
    state = N_FIELDS
    new = state + 2 * n
    predicted = new + 2 * n
    found = predicted + n
    a = found + n
    lam = a + n
    numbers = lam + n_rows
    return state, new, predicted, found, a, lam, numbers, numbers + n_numbers


places_of = merged(places)


@merged
def fill_field(work, field, value):
    """Set a field to the same number in all lanes."""
    for k in range(LANES):
        work[field * LANES + k] = value


@merged
def leave_run(work, status, k, reason):
    """Leave the run of a lane to a run of its own."""
    work[RUNNING * LANES + k] = 0.0
    status[int(work[RUN * LANES + k])] = reason

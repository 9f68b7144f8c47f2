"""Layout of the memory of runs in lanes, the functions that kernels call, and codes for how a run ends.

What kernels call are functions made for a mechanism, and the step of a method.
"""

from typing import Any

from numba import types
from numba.extending import typeof_impl

from twoloop.kernels.compile.callbacks import VECTOR
from twoloop.kernels.compile.generated_functions import GeneratedFunctions, has_wide_vectors
from twoloop.kernels.compile.reference import Reference
from twoloop.kernels.data.common import INTEGERS, merged

# how a run ends: at the end of the span, or in a run of its own outside the lanes, for one of these reasons
UNDECIDED, ENDED = 0, 1
NO_START, NO_STATE, NO_VALUES, OFTEN_REFUSED, MANY_STEPS, UNLIKE = range(-6, 0)


LANES = 8 if has_wide_vectors() else 4  # runs side by side; with two vectors, each number would take two registers

# vectors in `work`, with one number for each lane; followed by STATE, NEW, PREDICTED, ..., see `places`
(
    T,
    AHEAD,
    UNIT,
    H,
    X,
    FINE,  # 1 in the lanes for which a task runs; it leaves 1 where it succeeded
    DEFECT,
    OFF,
    LENGTH,
    LONGEST,  # longest step allowed, s
    REQUESTED,  # 1 in lanes that begin a run, or for which a state within a step is requested
    WORST,  # defect within the step
    REFUSED,  # number of rejected steps in a row
    RUNNING,
    RUN,  # index of the run in this lane
    REACHED,  # number of output times reached
    LEFT_TO_MOVE,
    MOVED_BEFORE,
    ACCEPTED,
    FRESH,  # 1 in lanes whose run has not taken a step yet
    ERROR,  # error of a step, over the tolerances
    WANTED,  # size of the step before the end of the run shortens it
    H_NEXT,
    H_LIMIT,  # limit of the step size after a step that failed ...
    LIMIT_AGE,  # ... and number of accepted steps since then
    ROUGH_TO,  # end of the last step that was rejected for a sudden error
    SHIFT,  # shift of places within a step
    EVALUATED,  # number of evaluations within the step, besides those that `settings` give
    PAST,  # history of step-size control, lane by lane, see control/step_size.py
    _MORE_PAST,
    N_FIELDS,
) = range(31)
# functions generated for a mechanism, (order, control, work), which work on the vectors of `work`
TASKS = (
    "approach",  # move positions of NEW, at AHEAD, towards the constraints, in lanes that are FINE
    "refine",  # move positions that are LEFT_TO_MOVE, and velocities; compute A and LAM there; FINE: converged
    "redundant",  # check whether redundant rows hold at NEW
    "departure",  # OFF: departure of a step H from STATE by PREDICTED to NEW
    "commit",  # NEW becomes STATE where ACCEPTED
)
TASKS_OF_STARTS = (
    "rows",
)  # C, C_t, entries of C_q at NEW and AHEAD, in the memory of the method; FINE: all of them are finite
TASKS_OF_STAGES = ("accelerate",)  # compute the accelerations A at the state NEW, without a projection
# "stages": compute the state NEW at the time X after the beginning of the step, and ERROR if X is the whole step; FINE
# stays 1 in lanes where that succeeded
TASKS_OF_EXPLICIT = ("stages",)
TASKS_OF_SERIES = (
    "series",  # coefficients about STATE at T, in units of time UNIT
    "lengths",  # LENGTH in units, H and X of the steps of the lanes that can continue, which are FINE
    "check_within",  # WORST: the largest defect within a step H; AHEAD: its end
    "evaluate",  # NEW, PREDICTED and FOUND: the state and its accelerations by the series, after X units of time
    "defect",  # DEFECT: defect of A at NEW, the end of a step H
    "judge",  # ACCEPTED: 1 for accepted steps; chooses the size of the next one
)
CODE = Reference("LaneKit", {})
ALL_TASKS = (*TASKS, *TASKS_OF_STARTS, *TASKS_OF_STAGES, *TASKS_OF_EXPLICIT, *TASKS_OF_SERIES)
CODE.add_llvm_functions(dict.fromkeys(ALL_TASKS, types.none(types.int64, VECTOR, VECTOR)))
# step of a method, (code, settings, control, options, work, status, n_steps, within): a step H of each lane that runs,
# and whether it is ACCEPTED, with its end in NEW, A and LAM. With `within`, the state X seconds after the beginning of
# the step that was just accepted, in NEW, for lanes that are FINE, not yet projected
STEP = types.void(CODE, INTEGERS, *[VECTOR] * 3, *[INTEGERS] * 2, types.boolean)
CODE.add_function("step", STEP)

# offsets in the memory of an explicit method, in n vectors: accelerations at STATE, the state at the beginning of the
# step (twice n), velocities before the projection, and accelerations of the stages
START, BEGIN, _BEGIN_V, PREDICTED_V, SLOPES = range(5)

N, N_ROWS, ORDER, CHECKS_REDUNDANT, N_NUMBERS, N_EVALUATIONS = range(6)  # indices in `settings`
T0, T1, GAP, RTOL, ATOL = range(5)  # indices in `control`; from ATOL on a tolerance for each coordinate

SHORTEST = 1e-13  # shortest step, relative to the time


class LaneKit:
    """Functions generated for a mechanism and the step of a method, as kernels get them."""

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
    """Return where STATE, NEW, PREDICTED, FOUND, A, LAM, the numbers of the code and the method's memory begin.

    Offsets are counted in vectors.
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
    """Take a run out of its lane, to be repeated on its own outside the lanes."""
    work[RUNNING * LANES + k] = 0.0
    status[int(work[RUN * LANES + k])] = reason

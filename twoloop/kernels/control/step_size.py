"""Step-size control: the size of the next step, the times at which steps end, and additional error measures.

The size follows from the error of the last step. With the trend (Gustafsson, ACM TOMS 20 (1994), 496) the factor also
depends on how the error has changed since the last accepted step.

Errors that the embedded formula does not show are measured in two ways:

- `departure` compares the dependent positions that the formula predicts with those that satisfy the constraints. On the
  same assembly of the mechanism the difference is of the order of the step's error. On another assembly it is larger,
  however smooth the independent coordinates are. A mechanism without independent coordinates (each is prescribed) has
  no other estimate. Where two assemblies come close to one another, a large step may end on the wrong one with a small
  difference; det C_qd then changes sign, as it does along a motion only at a singular position. So after a change of
  sign the prediction must be nearly exact, as it is in short steps through a singular position.
- `defect_ratio` is the defect of a Taylor step: how far its accelerations are from those of the equations at the same
  states. A series contains the forces at its beginning, to all orders, and no later change of them. So the equations
  are evaluated where the step ends, and within it at most tolerances[LOOK] apart.
"""

import numpy as np

from twoloop.kernels.control import loop_state as at
from twoloop.kernels.control.loop_state import (
    ERROR_BEFORE,
    EXPONENT,
    FACTOR_MAX,
    FACTOR_MIN,
    H_BEFORE,
    INNER_TOL,
    LEAST_ERROR,
    SAFETY,
)
from twoloop.kernels.data.common import SETTLE, allowed, compiled, is_beyond_gap, kernel, merged
from twoloop.kernels.data.indices import (
    ATOL,
    DEFECT,
    DONE,
    ESTIMATE,
    EXPLICIT_STEP,
    FORM,
    LARGEST_DEFECT,
    LOOK,
    N_ACCEPTED,
    N_JACOBIANS,
    N_PARTITIONS,
    N_REJECTED_CONVERGENCE,
    N_REJECTED_ERROR,
    ORIENTATION,
    ORIENTATION_NEW,
    RTOL,
    STATIC,
    STRAIGHT,
    UNCHECKED,
    WIDEST_GAP,
)
from twoloop.kernels.evaluation.constraints import representable_step
from twoloop.kernels.evaluation.inner_loop import evaluate, restore
from twoloop.kernels.evaluation.tasks import PROJECT
from twoloop.kernels.linalg.markowitz_lu import sign_of

KEEP_BELOW = 1.2  # with the trend, a factor between 1 and this becomes 1: a new step size needs a new factorization


@compiled
def factor_of(rule, past, h, error):
    """Return the ratio of the next step size to h, after a step of size h whose error, in tolerances, is `error`."""
    if not error > 0.0:
        return rule[FACTOR_MAX]
    follows = error <= 1.0 and rule[LEAST_ERROR] > 0.0
    factor = rule[SAFETY] * (1.0 / error if rule[EXPONENT] == 1.0 else error ** -rule[EXPONENT])
    if follows and past[ERROR_BEFORE] > 0.0:
        trend = h / past[H_BEFORE] * (past[ERROR_BEFORE] / error) ** rule[EXPONENT]
        factor = min(factor, factor * trend)
    factor = min(rule[FACTOR_MAX], max(rule[FACTOR_MIN], factor))
    return 1.0 if follows and 1.0 <= factor <= KEEP_BELOW else factor


@merged
def record_accepted(rule, past, h, error):
    """Record size and error of an accepted step in the history `past`."""
    past[H_BEFORE], past[ERROR_BEFORE] = h, max(error, rule[LEAST_ERROR])


@compiled
def evaluate_near(f, w, t, Q, V, A):
    """Project a state (Q, V) near the constraints onto them, and evaluate its accelerations A; return the code."""
    # generated code projects to the nearest state at less cost, and the static form projects only by this task
    if (f.flags[STRAIGHT] == 1 and w.Rate.size == w.C.size) or f.flags[FORM] == STATIC:
        return f.inner(f, w, PROJECT, t, Q, V, INNER_TOL, A, w.lam)
    return evaluate(f, w, t, Q, V, INNER_TOL, A)


@kernel(SETTLE)
def commit_nothing(f, w, options, memory, tolerances, accepted):
    """Do nothing: the method of the step has no memory."""


EQUAL_SPACINGS = 4.0  # times closer than this many spacings of floating-point numbers count as equal


@merged
def on_grid(clock, t, h, target, goal):
    """Return the size of a step of a fixed grid, how many grid steps it covers, and whether it reaches `goal`.

    Grid times are multiples of h, not sums; an output time within a millionth of h from a grid point counts as equal.
    """
    rounding = EQUAL_SPACINGS * np.spacing(max(abs(t), abs(target)))
    margin = max(1e-6 * h, rounding)
    n_grid_steps = 1.0
    if target <= clock[at.T_START] + clock[at.N_FIXED] * h + margin:
        n_grid_steps = 0.0  # a second output time close to the grid point reached before
    end = clock[at.T_START] + (clock[at.N_FIXED] + n_grid_steps) * h
    reaches_goal = goal <= end + margin
    size = h
    if abs(t + h - end) > rounding:
        size = end - t  # back to the grid after an output time off the grid
    if reaches_goal and goal < target and abs(goal - end) > rounding:
        n_grid_steps = 0.0
    return size, n_grid_steps, reaches_goal


@merged
def off_grid(control, t, h, left, crosses_jump):
    """Return the size of a step under step-size control, and whether it reaches the goal, `left` seconds ahead."""
    reaches_goal = crosses_jump or h >= left * (1.0 - 1e-10)
    size = h
    if h > 0.5 * left and not reaches_goal:
        size = 0.5 * left  # two equal steps rather than a long and a tiny one
    size = representable_step(t, size)
    if size > control[at.MAX_STEP]:
        size = representable_step(t, size - np.spacing(abs(t + size)))
    return size, reaches_goal


FADING = 0.98  # factor on H_LONG, the longest recent step, at each accepted step


@merged
def count_step(w, tolerances, control, clock, size, out_step):
    """Count an accepted step, and record its defect and the widest gap between evaluations."""
    w.counters[N_ACCEPTED] += 1
    if w.notes[DEFECT] >= 0.0:
        w.notes[LARGEST_DEFECT] = max(w.notes[LARGEST_DEFECT], w.notes[DEFECT])
    else:
        w.notes[UNCHECKED] += 1.0
    gap = size
    if w.notes[DEFECT] >= 0.0:
        gap = min(size, tolerances[LOOK])
    elif is_beyond_gap(tolerances, size):  # only steps with closely spaced stages may be longer than GAP
        gap = control[at.MAX_EVALUATION_GAP] * size
    w.notes[WIDEST_GAP] = max(w.notes[WIDEST_GAP], gap)
    clock[at.H_LONG] = max(size, FADING * clock[at.H_LONG])
    w.notes[ORIENTATION] = w.notes[ORIENTATION_NEW]
    out_step[at.H] = size
    out_step[at.ERRORS] = w.counters[N_REJECTED_ERROR]
    out_step[at.FAILURES] = w.counters[N_REJECTED_CONVERGENCE]
    out_step[at.PARTITIONS] = w.counters[N_PARTITIONS]
    out_step[at.JACOBIANS] = 0.0 if w.notes[EXPLICIT_STEP] == 1.0 else w.counters[N_JACOBIANS]


# largest error of a prediction at any tolerance, relative to the largest motion of a coordinate in the step
SHARE_OF_MOTION = 0.1
SHARE_THROUGH_ZERO = 1e-6  # replaces SHARE_OF_MOTION if the sign of det C_qd changes in the step
LEAST = 1e-300  # lower bound of a scale, which avoids a division by zero
FLOOR = 0.01  # in tolerances: distance that is added to the limit SHARE_OF_MOTION, for steps with hardly any motion


@merged
def store_prediction(w, q1):
    """Store the dependent positions of q1 before the constraints change them."""
    for k in range(w.dependent.size):
        w.predicted[k] = q1[w.dependent[k]]


@merged
def departure(w, tolerances, h, q, v, q1):
    """Return the largest distance of the stored prediction from q1, over the allowed distance.

    Allowed are the tolerance, or a fraction of the motion in the step if this is smaller. Needs the factors of C_qd at
    q1, which the inner loop stores in `w`. With fixed steps the result is 0.
    """
    if tolerances[ESTIMATE] == 0.0:
        return 0.0
    w.notes[ORIENTATION_NEW] = sign_of(w.index, w.values)
    motion = 0.0
    for m in range(q.size):
        motion = max(motion, h * abs(v[m]), abs(q1[m] - q[m]))
    share, floor = SHARE_OF_MOTION, FLOOR
    if w.notes[ORIENTATION] * w.notes[ORIENTATION_NEW] < 0.0:
        share, floor = SHARE_THROUGH_ZERO, 0.0
    largest = 0.0
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed(tolerances, m, q[m], q1[m])
        largest = max(largest, abs(w.predicted[k] - q1[m]) / max(min(scale, share * motion + floor * scale), LEAST))
    return largest


@merged
def project_prediction(f, w, tolerances, t, h, q, v, q1, v1, inner_tol):
    """Project the prediction (q1, v1) of a step of h from (q, v) onto the constraints; return code and departure."""
    store_prediction(w, q1)
    code = restore(f, w, t, q1, v1, inner_tol)
    return code, departure(w, tolerances, h, q, v, q1) if code == DONE else 0.0


ROUNDING = 1e-13  # relative to the largest acceleration: a smaller defect is a rounding error


@compiled
def defect_ratio(tolerances, h, order, predicted, a, q, v):
    """Return the defect |predicted - a| at the end of a step h, over the largest that the tolerances of q and v allow.

    The result is infinite if a defect is not finite. The defect of a series of this order grows as the highest power of
    the time: its integral is h / order times its value at the end.
    """
    rtol, share, largest, worst = tolerances[RTOL], h / order, 0.0, 0.0
    for j in range(a.size):
        largest = max(largest, abs(a[j]))
    for j in range(a.size):
        defect = abs(predicted[j] - a[j])
        if not np.isfinite(defect):
            return np.inf
        defect = (defect - ROUNDING * largest) * share
        atol = tolerances[ATOL + j]
        worst = max(worst, defect / (atol + rtol * abs(v[j])), defect * share / (atol + rtol * abs(q[j])))
    return worst

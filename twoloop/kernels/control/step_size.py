"""Step-size control: the size of the next step, the times at which steps end, and additional error measures.

The next step size follows from the error of the last step. For methods with a trend (Gustafsson, ACM TOMS 20 (1994),
496) the next size also depends on how the error has changed since the last accepted step (`f`: kit, `w`: workspace).

Errors that the embedded formula does not show are measured in two ways:

- `prediction_error` compares the dependent positions that the formula predicts with positions that satisfy the
  constraints. In the same assembly of the mechanism, the difference is of the order of the step's error. If the step
  has ended in another assembly, the difference is larger, however smooth the independent coordinates are. If all
  coordinates are prescribed, this is the only error estimate. Where two assemblies come close to one another, a large
  step may end in the wrong assembly with a small difference. Then the sign of det C_qd changes, although a motion
  changes it only at a singular position. So if the sign changes in a step, the prediction must be nearly exact, as it
  is in short steps through a singular position.
- `defect_ratio` is the defect of a Taylor step: the difference between accelerations by the series and accelerations by
  the equations at the same states. A series contains the forces at the beginning of the step, but no later sudden
  change. So the equations are evaluated at the end of the step and, if it is longer than DEFECT_GAP, also within it.
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
from twoloop.kernels.data.common import COMMIT, allowed_error, compiled, is_beyond_gap, kernel, merged
from twoloop.kernels.data.indices import ATOL, DEFECT_GAP, DONE, ESTIMATE, FIXED_ORDER, RTOL
from twoloop.kernels.evaluation.constraints import representable_step
from twoloop.kernels.evaluation.inner_loop import evaluate, restore_constraints
from twoloop.kernels.evaluation.tasks import PROJECT
from twoloop.kernels.linalg.markowitz_lu import determinant_sign

KEEP_BELOW_RATIO = 1.2  # methods that use the trend keep h, and so their factors, if it could grow by at most this


@compiled
def step_size_ratio(rule, past, h, error):
    """Return the ratio of the next step size to h by the step-size `rule`, given this step's `error` in tolerances.

    `past` is the history of step-size control: size and error of the last accepted step.
    """
    if not error > 0.0:
        return rule[FACTOR_MAX]
    uses_trend = error <= 1.0 and rule[LEAST_ERROR] > 0.0
    factor = rule[SAFETY] * (1.0 / error if rule[EXPONENT] == 1.0 else error ** -rule[EXPONENT])
    if uses_trend and past[ERROR_BEFORE] > 0.0:
        trend = h / past[H_BEFORE] * (past[ERROR_BEFORE] / error) ** rule[EXPONENT]
        factor = min(factor, factor * trend)
    factor = min(rule[FACTOR_MAX], max(rule[FACTOR_MIN], factor))
    return 1.0 if uses_trend and 1.0 <= factor <= KEEP_BELOW_RATIO else factor


@merged
def record_accepted_step(rule, past, h, error):
    """Store size h (s) and `error` (in tolerances) of an accepted step in `past`, the history of step-size control."""
    past[H_BEFORE], past[ERROR_BEFORE] = h, max(error, rule[LEAST_ERROR])


@compiled
def project_and_evaluate(f, w, t, Q, V, A):
    """Project (Q, V), a state near the constraints, in place, and store its accelerations in A; return a code."""
    # PROJECT is the cheapest task in generated code; and in the fixed-order form, the task EVALUATE does not project
    if (f.is_generated == 1 and w.Rate.size == w.C.size) or f.form == FIXED_ORDER:
        return f.inner(f, w, PROJECT, t, Q, V, INNER_TOL, A, w.lam)
    return evaluate(f, w, t, Q, V, INNER_TOL, A)


@kernel(COMMIT)
def commit_nothing(f, w, options, memory, tolerances, accepted):
    """Do nothing: the method of the step has no memory."""


EQUAL_SPACINGS = 4.0  # largest difference of times that count as equal, in spacings of floating-point numbers


@merged
def size_on_grid(clock, t, h, target, goal):
    """Return the size (s) of a step from t, the number of grid steps that it completes, and whether it reaches `goal`.

    Grid times are T_START plus multiples of h. `target` is the next output time; a grid time that differs from `target`
    by at most h / 10^6 counts as equal. `goal` is `target`, or the time of a jump of C_t or b before `target`.
    """
    rounding = EQUAL_SPACINGS * np.spacing(max(abs(t), abs(target)))
    margin = max(1e-6 * h, rounding)
    n_grid_steps = 1.0
    if target <= clock[at.T_START] + clock[at.N_FIXED] * h + margin:
        n_grid_steps = 0.0  # earlier steps have counted all grid times up to `target`
    end = clock[at.T_START] + (clock[at.N_FIXED] + n_grid_steps) * h
    reaches_goal = goal <= end + margin
    size = h
    if abs(t + h - end) > rounding:
        size = end - t  # end at a grid time again, after an output time between grid times
    if reaches_goal and goal < target and abs(goal - end) > rounding:
        n_grid_steps = 0.0
    return size, n_grid_steps, reaches_goal


@merged
def size_off_grid(control, t, h, left, crosses_jump):
    """Return the size (s) of a step (about h at most), and whether it reaches the goal, a time `left` s ahead."""
    reaches_goal = crosses_jump or h >= left * (1.0 - 1e-10)
    size = h
    if h > 0.5 * left and not reaches_goal:
        size = 0.5 * left  # take two equal steps instead of a long step and a tiny one
    size = representable_step(t, size)
    if size > control[at.MAX_STEP]:
        size = representable_step(t, size - np.spacing(abs(t + size)))
    return size, reaches_goal


H_LONG_DECAY = 0.98  # each accepted step multiplies H_LONG, the longest of the last steps, by this factor


@merged
def count_step(w, tolerances, control, clock, size, out_step):
    """Count an accepted step; update largest defect and widest gap in w; fill `out_step`, a row of out_steps."""
    w.n_accepted += 1
    if w.defect >= 0.0:
        w.largest_defect = max(w.largest_defect, w.defect)
    else:
        w.unchecked += 1.0
    gap = size
    if w.defect >= 0.0:
        gap = min(size, tolerances[DEFECT_GAP])
    elif is_beyond_gap(tolerances, size):  # only methods with closely spaced stages take steps longer than GAP
        gap = control[at.MAX_EVALUATION_GAP] * size
    w.widest_gap = max(w.widest_gap, gap)
    clock[at.H_LONG] = max(size, H_LONG_DECAY * clock[at.H_LONG])
    w.orientation = w.orientation_new
    out_step[at.H] = size
    out_step[at.ERRORS] = w.n_rejected_error
    out_step[at.FAILURES] = w.n_rejected_convergence
    out_step[at.PARTITIONS] = w.n_partitions
    out_step[at.JACOBIANS] = 0.0 if w.explicit_step == 1.0 else w.n_jacobians


# allowed error of a predicted position, relative to the largest motion of a coordinate in the step
FRACTION_OF_MOTION = 0.1
FRACTION_AT_SIGN_CHANGE = 1e-6  # replaces FRACTION_OF_MOTION if the sign of det C_qd changes in the step
LEAST = 1e-300  # lower bound of the allowed error, which avoids a division by zero
# part of the allowed error of a predicted position, in tolerances, that does not depend on the motion in the step
FIXED_FRACTION = 0.01


@merged
def store_prediction(w, q1):
    """Store in w.predicted the dependent positions in q1 (n_q), which the formula of the method has predicted."""
    for k in range(w.dependent.size):
        w.predicted[k] = q1[w.dependent[k]]


@merged
def prediction_error(w, tolerances, h, q, v, q1):
    """Return the largest error of the dependent positions that the formula predicts, divided by the allowed error.

    The error is the difference of w.predicted from the positions in q1, which satisfy the constraints. The allowed
    error is the smaller one of the tolerance and about FRACTION_OF_MOTION times the motion in the step. The factors
    of C_qd in `w` must belong to q1. For steps of fixed size, return 0.
    """
    if tolerances[ESTIMATE] == 0.0:
        return 0.0
    w.orientation_new = determinant_sign(w.index, w.values)
    motion = 0.0
    for m in range(q.size):
        motion = max(motion, h * abs(v[m]), abs(q1[m] - q[m]))
    fraction, floor = FRACTION_OF_MOTION, FIXED_FRACTION
    if w.orientation * w.orientation_new < 0.0:
        fraction, floor = FRACTION_AT_SIGN_CHANGE, 0.0
    largest = 0.0
    for k in range(w.dependent.size):
        m = w.dependent[k]
        scale = allowed_error(tolerances, m, q[m], q1[m])
        largest = max(largest, abs(w.predicted[k] - q1[m]) / max(min(scale, fraction * motion + floor * scale), LEAST))
    return largest


@merged
def project_prediction(f, w, tolerances, t, h, q, v, q1, v1, inner_tol):
    """Project (q1, v1), predicted by a step of size h from (q, v); return a code, and the `prediction_error`."""
    store_prediction(w, q1)
    code = restore_constraints(f, w, t, q1, v1, inner_tol)
    return code, prediction_error(w, tolerances, h, q, v, q1) if code == DONE else 0.0


ROUNDING = 1e-13  # defect that counts as a rounding error, relative to the largest acceleration


@compiled
def defect_ratio(tolerances, h, order, predicted, a, q, v):
    """Return the defect |predicted - a| at the end of a step of size h, relative to the largest allowed defect.

    The error that the defect causes in q and v must be below the tolerances. The defect of a series of order `order`
    grows as the highest power of time; so its integral over the step is h / order times its value at the end. If an
    acceleration is not finite, the result is infinite.
    """
    rtol, duration, largest, ratio = tolerances[RTOL], h / order, 0.0, 0.0
    for j in range(a.size):
        largest = max(largest, abs(a[j]))
    for j in range(a.size):
        defect = abs(predicted[j] - a[j])
        if not np.isfinite(defect):
            return np.inf
        defect = (defect - ROUNDING * largest) * duration
        atol = tolerances[ATOL + j]
        ratio = max(ratio, defect / (atol + rtol * abs(v[j])), defect * duration / (atol + rtol * abs(q[j])))
    return ratio

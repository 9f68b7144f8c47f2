"""Step-size control: the size of the next step, the times at which steps end, and additional error measures.

The next step size follows from the error of the last step. Some methods also use the trend of the error, its change
since the last accepted step (Gustafsson, ACM TOMS 20 (1994), 496). In this module, `f` is the kit, `w` the workspace.

Two measures show errors that the error estimate of the integration formula misses:

- `prediction_error` compares the dependent positions that the formula predicts with positions that satisfy the
  constraints. In the same assembly of the mechanism, the difference is of the order of the step's error. If the step
  has ended in another assembly, the difference is larger, even if the independent coordinates are smooth. If all
  coordinates are prescribed, there is no other error estimate. Where two assemblies come close to one another, a large
  step may end in the wrong assembly with a small difference. Then the sign of det C_qd changes (C_qd: the dependent
  columns of C_q). In a true motion, this happens only at a singular position, and predictions of short steps there are
  nearly exact. So if the sign changes in a step, its prediction must be nearly exact.
- `defect_ratio` measures the defect of a Taylor step: the difference, at the same state, between accelerations by the
  series and by the equations. The series knows the forces at the beginning of the step only, not a later sudden
  change. So the equations are evaluated at the end of the step and, if the step exceeds DEFECT_GAP, also within it.
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

KEEP_BELOW_RATIO = 1.2  # methods that use the trend of errors keep a step size that would grow by at most this factor


@compiled
def step_size_ratio(rule, past, h, error):
    """Return the ratio of the next step size to the size h of this step, whose `error` is in tolerances.

    `rule`: parameters of step-size control; `past`: size and error of the last accepted step (see loop_state.py).
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
    """Store the size h (s) and the error (in tolerances, at least rule[LEAST_ERROR]) of an accepted step in `past`."""
    past[H_BEFORE], past[ERROR_BEFORE] = h, max(error, rule[LEAST_ERROR])


@compiled
def project_and_evaluate(f, w, t, Q, V, A):
    """Project the state (Q, V) onto the constraints; store its accelerations in A; return DONE or a failure code."""
    # the task EVALUATE is slower than PROJECT with generated code, and need not project in the fixed-order form
    if (f.is_generated == 1 and w.Rate.size == w.C.size) or f.form == FIXED_ORDER:
        return f.inner(f, w, PROJECT, t, Q, V, INNER_TOL, A, w.lam)
    return evaluate(f, w, t, Q, V, INNER_TOL, A)


@kernel(COMMIT)
def commit_nothing(f, w, options, memory, tolerances, accepted):
    """Do nothing after an attempted step, accepted or not: `commit` of a method that has no memory."""


EQUAL_SPACINGS = 4.0  # largest difference of times that count as equal, in spacings of floating-point numbers


@merged
def size_on_grid(clock, t, h, target, goal):
    """Choose the size of a step from t in a run with steps of fixed size h, which end at the grid times T_START + k h.

    Return the size (s), the number of grid times that the step reaches (0 or 1), and True if it reaches `goal`.
    `target`: next output time; a grid time within h / 10^6 of `target` counts as equal to it. `goal`: `target`, or the
    time of a jump of a constraint rate (C_t, b) before `target`.
    """
    rounding = EQUAL_SPACINGS * np.spacing(max(abs(t), abs(target)))
    margin = max(1e-6 * h, rounding)
    n_grid_steps = 1.0
    if target <= clock[at.T_START] + clock[at.N_FIXED] * h + margin:
        n_grid_steps = 0.0  # earlier steps have already counted all grid times up to `target`
    end = clock[at.T_START] + (clock[at.N_FIXED] + n_grid_steps) * h
    reaches_goal = goal <= end + margin
    size = h
    if abs(t + h - end) > rounding:
        size = end - t  # t is not a grid time, for example after a jump: end at the next grid time
    if reaches_goal and goal < target and abs(goal - end) > rounding:
        n_grid_steps = 0.0
    return size, n_grid_steps, reaches_goal


@merged
def size_off_grid(control, t, h, time_to_goal, crosses_jump):
    """Return a step size (s), about h or less, and True if the step must have the size `time_to_goal` (s) instead."""
    reaches_goal = crosses_jump or h >= time_to_goal * (1.0 - 1e-10)
    size = h
    if h > 0.5 * time_to_goal and not reaches_goal:
        size = 0.5 * time_to_goal  # take two equal steps instead of a long step and a tiny one
    size = representable_step(t, size)
    if size > control[at.MAX_STEP]:
        size = representable_step(t, size - np.spacing(abs(t + size)))
    return size, reaches_goal


H_LONG_DECAY = 0.98  # factor by which each accepted step reduces clock[H_LONG], the longest recent step size


@merged
def count_step(w, tolerances, control, clock, size, out_step):
    """Store an accepted step of `size` (s) in `out_step`, counts in `w`, and the longest recent size in `clock`."""
    w.n_accepted += 1
    if w.defect >= 0.0:
        w.largest_defect = max(w.largest_defect, w.defect)
    else:
        w.unchecked += 1.0
    gap = size
    if w.defect >= 0.0:
        gap = min(size, tolerances[DEFECT_GAP])
    elif is_beyond_gap(tolerances, size):  # a step longer than tolerances[GAP] also evaluates forces within the step
        gap = control[at.MAX_EVALUATION_GAP] * size
    w.widest_gap = max(w.widest_gap, gap)
    clock[at.H_LONG] = max(size, H_LONG_DECAY * clock[at.H_LONG])
    w.orientation = w.orientation_new
    out_step[at.H] = size
    out_step[at.ERRORS] = w.n_rejected_error
    out_step[at.FAILURES] = w.n_rejected_convergence
    out_step[at.PARTITIONS] = w.n_partitions
    out_step[at.JACOBIANS] = 0.0 if w.explicit_step == 1.0 else w.n_jacobians


# allowed error of a predicted dependent position, relative to the largest displacement of a coordinate in the step
FRACTION_OF_MOTION = 0.1
FRACTION_AT_SIGN_CHANGE = 1e-6  # replaces FRACTION_OF_MOTION if det C_qd (dependent columns of C_q) changes sign
LEAST = 1e-300  # lower bound of the allowed error of a predicted position, which avoids a division by zero
FIXED_FRACTION = 0.01  # allowed error of a prediction if coordinates hardly move, relative to the tolerance


@merged
def store_prediction(w, q1):
    """Copy the dependent entries of q1 (n_q), which the integration formula has predicted, to w.predicted."""
    for k in range(w.dependent.size):
        w.predicted[k] = q1[w.dependent[k]]


@merged
def prediction_error(w, tolerances, h, q, v, q1):
    """Return the largest |w.predicted - q1| (dependent positions) / (allowed error), for a step from (q, v) to q1.

    The formula predicted w.predicted; q1 satisfies C = 0. The allowed error is the tolerance or, if smaller, about a
    fraction of the largest displacement: FRACTION_OF_MOTION, or FRACTION_AT_SIGN_CHANGE if det C_qd changes sign.
    w.orientation_new becomes the sign of det C_qd, from its factors in `w`. If steps have a fixed size, only return 0.
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
    """Move the predicted (q1, v1) onto the constraints; return a code, and `prediction_error` (0 after a failure)."""
    store_prediction(w, q1)
    code = restore_constraints(f, w, t, q1, v1, inner_tol)
    return code, prediction_error(w, tolerances, h, q, v, q1) if code == DONE else 0.0


ROUNDING = 1e-13  # a defect up to this fraction of the largest acceleration counts as a rounding error


@compiled
def defect_ratio(tolerances, h, order, predicted, a, q, v):
    """Return the largest defect |predicted - a| of accelerations at the end (q, v) of a Taylor step of size h.

    `predicted`: accelerations by the series; `a`: by the equations. A defect is divided by the allowed defect, which
    causes an error of one tolerance in q or v. The defect of a series of order `order` grows as time^(order - 1), so
    that its integral over the step is h / order times its value at the end. Return inf if a value is not finite.
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

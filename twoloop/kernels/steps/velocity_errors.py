"""Estimate the position errors that velocity errors cause, if a method's steps are longer than vibration periods.

A velocity error e changes the positions until e changes its sign or decays. This takes about sqrt(|e| / |J J e|), the
duration of e. J is the Jacobian of the equations of motion (q, v)' = (v, F), where F are the accelerations. So an error
due to a force that jumps within a step lasts long and counts, and an error of fast vibrations hardly counts. There are
two exceptions:

- The duration is that of the fastest component of e. If a contact and a stiff damper act at the same time, the slow
  component lasts much longer. A filter with the time constant of several steps removes all other components.
- If J was computed by finite differences before a contact began or ended, the duration is wrong, although Newton's
  method still converges. `derivatives_agree` detects this. (`w`: workspace, `f`: kit)
"""

import numpy as np

from twoloop.kernels.data.common import allowed_error, compiled, typical_size
from twoloop.kernels.data.indices import DONE, GAP
from twoloop.kernels.evaluation.inner_loop import evaluate
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.steps import stages as at
from twoloop.kernels.steps.newton_systems import RELATIVE_DISPLACEMENT
from twoloop.kernels.steps.stages import INNER_TOL, block, vector

# a velocity error that changes as slowly as the motion is not due to a vibration. Such an error keeps its sign in later
# steps, so that position errors add up. To allow for this, the error's duration is multiplied by up to this factor
SLOW_FACTOR = 10.0
LONGEST_GAPS = 10.0  # largest result of `motion_time` / longest allowed time between evaluations of the equations
STEPS_TO_DECAY = 10.0  # number of steps after which fast components of a velocity error count as decayed
FAST_DURATION = 20.0  # the duration of a velocity error is short if below this * z (step size * method's coefficient)
OUTDATED_CHANGE = 0.3  # the Jacobian J of the equations of motion is outdated if its relative change exceeds this


@compiled
def filtered_velocity_error(w, memory, tolerances, z, unfiltered, filtered_once, filtered_twice, state, new_state, a1):
    """Estimate how long a velocity error lasts; return its largest effect in tolerances, see `velocity_error`.

    `unfiltered` (n_dof) is the velocity error. `filtered_once` and `filtered_twice` (n_dof) are this error multiplied
    once and twice by the filter (I - z J)^-1; z is the step size times a coefficient of the method, J the Jacobian.
    `a1` (n_q): accelerations at the end of the step, which show how fast the motion changes after a contact has begun
    within the step. The duration (s) of the error is stored in memory[ERROR_DURATION].
    """
    n = w.Q.size
    v, a = state[n : 2 * n], state[2 * n : 3 * n]
    n_dof = w.independent.size
    largest, curvature, largest_v, largest_a = 0.0, 0.0, 0.0, 0.0
    for i in range(n_dof):
        largest_v = max(largest_v, abs(v[w.independent[i]]))
        largest_a = max(largest_a, abs(a[w.independent[i]]), abs(a1[w.independent[i]]))
        largest = max(largest, abs(filtered_twice[i]))
        # as each filter multiplies by (I - z J)^-1, this difference is component i of (z J)^2 filtered_twice
        curvature = max(curvature, abs(filtered_twice[i] - 2.0 * filtered_once[i] + unfiltered[i]))
    if largest > 0.0:
        memory[at.ERROR_DURATION] = z * np.sqrt(largest / curvature)
    duration = memory[at.ERROR_DURATION]
    if duration * largest_a * SLOW_FACTOR > largest_v:
        duration *= min(SLOW_FACTOR, duration * largest_a * SLOW_FACTOR / largest_v) if largest_v > 0.0 else SLOW_FACTOR
    return velocity_error(w, tolerances, filtered_twice, duration, state, new_state)


@compiled
def velocity_error(w, tolerances, e_v, duration, state, new_state):
    """Return the largest effect on a coordinate, in tolerances, of a velocity error e_v (n_dof) lasting `duration` (s).

    The effect on a coordinate is the smaller one of two ratios: the velocity error to the velocity tolerance; and the
    position error, |e_v| times `duration`, to the position tolerance.
    """
    n = w.Q.size
    error = 0.0
    for i in range(w.independent.size):
        j = w.independent[i]
        scale_q = allowed_error(tolerances, j, state[j], new_state[j])
        scale_v = allowed_error(tolerances, j, state[n + j], new_state[n + j])
        error = max(error, abs(e_v[i]) * min(duration / scale_q, 1.0 / scale_v))
    return error


@compiled
def motion_time(w, tolerances, state, a):
    """Return the time (s) in which velocities change: max|v_i| / max|a_i|, at most LONGEST_GAPS * tolerances[GAP]."""
    n = w.Q.size
    largest_v = largest_a = 0.0
    for j in w.independent:
        largest_v = max(largest_v, abs(state[n + j]))
        largest_a = max(largest_a, abs(a[j]))
    max_duration = LONGEST_GAPS * tolerances[GAP]
    return largest_v / largest_a if largest_v < max_duration * largest_a else max_duration


@compiled
def _derivatives_may_matter(w, memory, tolerances, z, unfiltered, max_duration, state, new_state):
    """Return True if the error estimate might be wrong because the Jacobian J was computed at an earlier state.

    There are two cases. First, the effect of the velocity error `unfiltered` (n_dof) would exceed the tolerances if it
    lasted `max_duration` (s). Second, the duration computed with J is short, and Newton's method converges so slowly
    that J must have changed by more than OUTDATED_CHANGE.
    """
    duration = memory[at.ERROR_DURATION]
    if (
        duration < min(max_duration, FAST_DURATION * z)
        and memory[at.CONTRACTION] * duration * duration > OUTDATED_CHANGE * z * z
    ):
        return True
    return velocity_error(w, tolerances, unfiltered, max_duration, state, new_state) > 1.0


@compiled
def derivatives_agree(f, w, options, memory, s, t, z, tolerances, unfiltered, e_q, e_v, state, new_state, a_end):
    """Return True if the stored Jacobian J still holds at the end of a step, or if its errors are harmless.

    The test displaces the end along (e_q, e_v), and compares the change of the accelerations with that predicted by J.
    Here (e_q, e_v) = (I - z J)^-1 u is the filtered error estimate. The velocity part of the estimate u is `unfiltered`
    (n_dof), so that J predicts the change (e_v - unfiltered) / z. t, a_end: time and accelerations at the end of the
    step. z: step size times a coefficient of the method.
    """
    n = w.Q.size
    max_duration = max(motion_time(w, tolerances, state, state[2 * n :]), motion_time(w, tolerances, state, a_end))
    if not _derivatives_may_matter(w, memory, tolerances, z, unfiltered, max_duration, state, new_state):
        return True
    q1, v1 = new_state[:n], new_state[n : 2 * n]
    Q, V = vector(memory, s, n, at.Q_MOVED), vector(memory, s, n, at.V_MOVED)
    a_base, a_moved = block(memory, s, n, at.RESIDUAL)[0], block(memory, s, n, at.Q_STAGE)[0]
    copy(q1, Q)
    copy(v1, V)
    if evaluate(f, w, t, Q, V, options[INNER_TOL], a_base) != DONE:
        return False
    largest_error, speed = 0.0, typical_size(tolerances, V)
    for i in range(w.independent.size):
        largest_error = max(largest_error, abs(e_v[i]))
        speed = max(speed, abs(V[w.independent[i]]))
    if largest_error == 0.0:
        return True
    factor = max(1.0, RELATIVE_DISPLACEMENT * speed / largest_error)
    copy(q1, Q)
    copy(v1, V)
    for i in range(w.independent.size):
        Q[w.independent[i]] += factor * e_q[i]
        V[w.independent[i]] += factor * e_v[i]
    if evaluate(f, w, t, Q, V, options[INNER_TOL], a_moved) != DONE:
        return False
    largest_difference, largest_product, largest_v = 0.0, 0.0, 0.0
    for i in range(w.independent.size):
        j = w.independent[i]
        scale = allowed_error(tolerances, j, state[n + j], new_state[n + j])
        product, difference = (e_v[i] - unfiltered[i]) / z, (a_moved[j] - a_base[j]) / factor
        largest_difference = max(largest_difference, abs(product - difference) / scale)
        largest_product = max(largest_product, abs(product) / scale, abs(difference) / scale)
        largest_v = max(largest_v, abs(e_v[i]) / scale)
    return largest_difference <= OUTDATED_CHANGE * largest_product or largest_product * max_duration <= largest_v

"""Estimate the position errors that errors of the velocities cause, for methods that step over vibrations.

An error e of the velocities moves the positions until it changes its sign or decays. J J e, J being the Jacobian of
(v, F), shows the square of the rate at which it does. So the error due to a force that jumps within a step counts, and
the error of vibrations that do not matter does not.

- This is the rate of the fastest component of the error. If a stiff damper acts beside a contact, the component in slow
  directions lasts much longer: a filter for several steps at once leaves just this component.
- If J was differenced before a contact began or ended, it has another rate, though Newton's method still contracts.
"""

import numpy as np

from twoloop.kernels.data.common import allowed, compiled
from twoloop.kernels.data.indices import DONE, GAP
from twoloop.kernels.evaluation.inner_loop import evaluate
from twoloop.kernels.linalg.dense import copy
from twoloop.kernels.steps import stages as at
from twoloop.kernels.steps.newton_systems import DIFFERENCE
from twoloop.kernels.steps.stages import INNER_TOL, block, vector

# factor on the duration of an error that changes its sign as slowly as the motion: it is no vibration, and the errors
# of the next steps have the same sign
SLOW_FACTOR = 10.0
LONGEST_GAPS = 10.0  # times GAP: longest duration of an error
STEPS_TO_DECAY = 10.0  # number of steps after which a fast error has decayed
FAST = 20.0  # duration, in steps, below which an error of the velocities counts as fast
UNLIKE = 0.3  # relative difference of accelerations above which derivatives do not belong to a state


@compiled
def filtered_velocity_error(w, memory, tolerances, z, raw, once, twice, state, new_state, a_end):
    """Return the largest component of an error, filtered by (I - z J)^-1 `once` and `twice`, over the tolerances.

    A velocity error counts as the smaller of two ratios: its ratio to the tolerance of the velocity, and the ratio of
    the position error that it causes, until it changes its sign or decays, to that of the position. `a_end`: the
    accelerations at the end, where a contact that begins in the step shows how fast the motion changes.
    """
    n = w.Q.size
    v, a = state[n : 2 * n], state[2 * n : 3 * n]
    count = w.independent.size
    largest, turn, fastest, change = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        fastest = max(fastest, abs(v[w.independent[i]]))
        change = max(change, abs(a[w.independent[i]]), abs(a_end[w.independent[i]]))
        largest = max(largest, abs(twice[i]))
        turn = max(turn, abs(twice[i] - 2.0 * once[i] + raw[i]))  # (z J)^2 e
    if largest > 0.0:
        memory[at.DURATION] = z * np.sqrt(largest / turn)
    duration = memory[at.DURATION]
    if duration * change * SLOW_FACTOR > fastest:
        duration *= min(SLOW_FACTOR, duration * change * SLOW_FACTOR / fastest) if fastest > 0.0 else SLOW_FACTOR
    return velocity_error(w, tolerances, twice, duration, state, new_state)


@compiled
def velocity_error(w, tolerances, e_v, duration, state, new_state):
    """Return the largest component of a velocity error of the given duration, over the tolerances."""
    n = w.Q.size
    error = 0.0
    for i in range(w.independent.size):
        j = w.independent[i]
        scale_q = allowed(tolerances, j, state[j], new_state[j])
        scale_v = allowed(tolerances, j, state[n + j], new_state[n + j])
        error = max(error, abs(e_v[i]) * min(duration / scale_q, 1.0 / scale_v))
    return error


@compiled
def motion_time(w, tolerances, state, a):
    """Return the time in which accelerations a change the velocities of the motion, s."""
    n = w.Q.size
    fastest = change = 0.0
    for j in w.independent:
        fastest = max(fastest, abs(state[n + j]))
        change = max(change, abs(a[j]))
    longest = LONGEST_GAPS * tolerances[GAP]
    return fastest / change if fastest < longest * change else longest


@compiled
def _derivatives_matter(w, memory, tolerances, z, raw, longest, state, new_state):
    """Return whether an outdated J, not that of the end of the step, would change the estimate.

    It would if the velocity error `raw` mattered when it lasted longer than J shows, or if J has directions that are
    fast relative to the step while Newton's method, which uses J, contracts as if they were slow.
    """
    duration = memory[at.DURATION]
    if duration < min(longest, FAST * z) and memory[at.CONTRACTION] * duration * duration > UNLIKE * z * z:
        return True
    return velocity_error(w, tolerances, raw, longest, state, new_state) > 1.0


@compiled
def derivatives_agree(f, w, options, memory, s, t, z, tolerances, raw, e_q, e_v, state, new_state, a_end):
    """Return whether J is that of the end of the step, at time t, or does not matter.

    (e_q, e_v) is (I - z J)^-1 of the error, and `raw` its velocities; the product with J is compared with a difference
    of accelerations.
    """
    n = w.Q.size
    longest = max(motion_time(w, tolerances, state, state[2 * n :]), motion_time(w, tolerances, state, a_end))
    if not _derivatives_matter(w, memory, tolerances, z, raw, longest, state, new_state):
        return True
    q1, v1 = new_state[:n], new_state[n : 2 * n]
    Q, V = vector(memory, s, n, at.Q_MOVED), vector(memory, s, n, at.V_MOVED)
    there, moved = block(memory, s, n, at.RESIDUAL)[0], block(memory, s, n, at.Q_STAGE)[0]
    copy(q1, Q)
    copy(v1, V)
    if evaluate(f, w, t, Q, V, options[INNER_TOL], there) != DONE:
        return False
    largest, size = 0.0, 1.0
    for i in range(w.independent.size):
        largest = max(largest, abs(e_v[i]))
        size = max(size, abs(V[w.independent[i]]))
    if largest == 0.0:
        return True
    factor = max(1.0, DIFFERENCE * size / largest)
    copy(q1, Q)
    copy(v1, V)
    for i in range(w.independent.size):
        Q[w.independent[i]] += factor * e_q[i]
        V[w.independent[i]] += factor * e_v[i]
    if evaluate(f, w, t, Q, V, options[INNER_TOL], moved) != DONE:
        return False
    apart, widest, fastest = 0.0, 0.0, 0.0
    for i in range(w.independent.size):
        j = w.independent[i]
        scale = allowed(tolerances, j, state[n + j], new_state[n + j])
        by_j, found = (e_v[i] - raw[i]) / z, (moved[j] - there[j]) / factor
        apart = max(apart, abs(by_j - found) / scale)
        widest = max(widest, abs(by_j) / scale, abs(found) / scale)
        fastest = max(fastest, abs(e_v[i]) / scale)
    return apart <= UNLIKE * widest or widest * longest <= fastest

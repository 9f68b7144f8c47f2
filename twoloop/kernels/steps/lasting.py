"""What an error of the velocities makes of the positions, for estimates that pass over vibrations.

It moves the positions for as long as it lasts: J J e, J being the Jacobian of (v, F), shows the square of the rate at
which it turns back or decays. So what a force leaves that jumps within a step is found, and vibrations that do not
matter are passed over.

That is the rate of its fastest part. Where a stiff damper acts beside a contact, what the step leaves in the slow
directions lasts much longer: it is what the system solved for some steps at once leaves of the error.
"""

import numpy as np

from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.tolerances import GAP, allowed
from twoloop.kernels.steps import newton_memory as at

# An error that turns back as slowly as the motion itself does is none of a vibration, and those of the next steps go
# the same way: it counts as if it lasted so many times as long
TURNS = 10.0
OF_RUN = 10.0  # times GAP: longer than that nothing is taken to last
STEPS = 10.0  # after which nothing is left of an error that is fast beside the step


@compiled
def lasting_error(w, memory, tolerances, z, raw, once, twice, state, new_state, a_end):
    """Largest component of the error that was filtered by (I - z J)^-1 `once` and `twice`, over the tolerances.

    Over that of a position where it has turned back or decayed before it is off by more, else over that of a velocity.
    `a_end`: accelerations at the end, where a contact that begins in the step shows how fast the motion changes.
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
        memory[at.LASTING] = z * np.sqrt(largest / turn)
    lasting = memory[at.LASTING]
    if lasting * change * TURNS > fastest:
        lasting *= min(TURNS, lasting * change * TURNS / fastest) if fastest > 0.0 else TURNS
    return over_velocities(w, tolerances, twice, lasting, state, new_state)


@compiled
def over_velocities(w, tolerances, e_v, lasting, state, new_state):
    """Largest component of an error of the velocities that lasts so long, over the tolerances."""
    n = w.Q.size
    error = 0.0
    for i in range(w.independent.size):
        j = w.independent[i]
        scale_q = allowed(tolerances, j, state[j], new_state[j])
        scale_v = allowed(tolerances, j, state[n + j], new_state[n + j])
        error = max(error, abs(e_v[i]) * min(lasting / scale_q, 1.0 / scale_v))
    return error


@compiled
def own_time(w, tolerances, state):
    """The time in which the motion changes its velocities, s."""
    n = w.Q.size
    fastest = change = 0.0
    for j in w.independent:
        fastest = max(fastest, abs(state[n + j]))
        change = max(change, abs(state[2 * n + j]))
    longest = OF_RUN * tolerances[GAP]
    return fastest / change if fastest < longest * change else longest

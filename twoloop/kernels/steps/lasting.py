"""What an error of the velocities makes of the positions, for estimates that pass over vibrations.

It moves the positions for as long as it lasts: J J e, J being the Jacobian of (v, F), shows the square of the rate at
which it turns back or decays. So what a force leaves that jumps within a step is found, and vibrations that do not
matter are passed over.
"""

import numpy as np

from twoloop.kernels.data.common import compiled
from twoloop.kernels.data.tolerances import allowed
from twoloop.kernels.steps import newton_memory as at

# An error that turns back as slowly as the motion itself does is none of a vibration, and those of the next steps go
# the same way: it counts as if it lasted so many times as long
TURNS = 10.0


@compiled
def lasting_error(w, memory, tolerances, z, raw, once, twice, state, new_state):
    """Largest component of the error that was filtered by (I - z J)^-1 `once` and `twice`, over the tolerances.

    Over that of a position where it has turned back or decayed before it is off by more, else over that of a velocity.
    """
    n = w.Q.size
    q, v, a, q1, v1 = state[:n], state[n : 2 * n], state[2 * n : 3 * n], new_state[:n], new_state[n : 2 * n]
    count = w.independent.size
    largest, turn, fastest, change = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        fastest = max(fastest, abs(v[w.independent[i]]))
        change = max(change, abs(a[w.independent[i]]))
        largest = max(largest, abs(twice[i]))
        turn = max(turn, abs(twice[i] - 2.0 * once[i] + raw[i]))  # (z J)^2 e
    if largest > 0.0:
        memory[at.LASTING] = z * np.sqrt(largest / turn)
    lasting = memory[at.LASTING]
    if lasting * change * TURNS > fastest:
        lasting *= min(TURNS, lasting * change * TURNS / fastest) if fastest > 0.0 else TURNS
    error = 0.0
    for i in range(count):
        j = w.independent[i]
        scale_q = allowed(tolerances, j, q[j], q1[j])
        scale_v = allowed(tolerances, j, v[j], v1[j])
        error = max(error, abs(twice[i]) * min(lasting / scale_q, 1.0 / scale_v))
    return error

"""What stands for a step that is not loaded: a run that comes to it stops until its caller has loaded it."""

import numpy as np

from twoloop.kernels.control.controller import nothing_to_settle
from twoloop.kernels.data.codes import NOT_LOADED
from twoloop.kernels.data.common import ATTEMPT, Attempt, Step, kernel


@kernel(ATTEMPT)
def asking_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """No attempt."""
    return Attempt(NOT_LOADED, np.inf, 0.0)


ASKING = Step(asking_step, nothing_to_settle)

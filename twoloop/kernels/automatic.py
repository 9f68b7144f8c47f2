"""The outer loop by fixed point where that is enough, by Newton's method where stiffness would make its steps tiny.

The evaluations that a second of motion costs are measured over windows of accepted steps. A run starts with the
fixed-point iteration. When it converges slowly, Newton's method is tried for a window, and kept if it costs GAIN times
fewer evaluations; after many windows of it the fixed-point iteration is tried again. What is not kept is next tried
after twice as many windows.
"""

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels import newton, runge_kutta
from twoloop.kernels.common import DONE, ESTIMATE, N_EVALUATIONS, N_OUTER, OUTER_DIVERGED, STEP, compiled, kernel
from twoloop.kernels.newton import newton_step
from twoloop.kernels.runge_kutta import runge_kutta_step

SETTLE = 10.0  # accepted steps before a measurement begins
WINDOW = 20.0  # accepted steps that it takes
SLOW = 5.5  # iterations for one solution of the stages from which on Newton's method may be worth a trial
GAIN = 3.0  # Newton's steps have an estimate of lower order and no extrapolation: fewer evaluations alone prove nothing
PATIENCE = 10.0  # windows before the first trial of the fixed point, or of Newton's method once more
LOOPS = 3.0  # solutions of the stages in one attempt: a whole step, two half ones

FIXED_POINT, NEWTON_ON_TRIAL, NEWTON, FIXED_POINT_ON_TRIAL = range(4)  # phases

# places in `memory`: advance() sets LAST_ACCEPTED; behind the scalars stand the memories of the two steps
(
    LAST_ACCEPTED,
    PHASE,
    STEPS,  # accepted in this phase or window
    WINDOWS_TO_WAIT,
    WAIT,  # after the next trial that fails
    ATTEMPTS,
    T_BEGIN,
    EVALUATIONS_BEGIN,
    ITERATIONS_BEGIN,
    PRICE,  # evaluations a second, of the loop before a trial
    EXPONENT,
    NEWTON_EXPONENT,
    FIRST_MEMORY,  # length of the first of the two memories
    N_MEMORY_SCALARS,
) = range(14)


def automatic_memory(first_size: int, newton_size: int, exponent: float, newton_exponent: float) -> NDArray[np.float64]:
    """`memory` for steps whose own memories have these lengths and whose errors go with these exponents."""
    memory = np.zeros(N_MEMORY_SCALARS + first_size + newton_size)
    memory[WAIT] = PATIENCE
    memory[EXPONENT], memory[NEWTON_EXPONENT] = exponent, newton_exponent
    memory[FIRST_MEMORY] = first_size
    return memory


@compiled
def _go_over(memory, fixed_point, own, phase):
    """Begin another phase; the loop it uses knows nothing of the steps before."""
    memory[PHASE] = phase
    memory[STEPS] = 0.0
    fixed_point[runge_kutta.HAS_TRIAL] = 0.0
    fixed_point[runge_kutta.HAS_PREVIOUS] = 0.0
    own[newton.HAS_TRIAL] = 0.0
    own[newton.HAS_PREVIOUS] = 0.0
    own[newton.HAS_JACOBIAN] = 0.0
    own[newton.FRESH] = 0.0


@compiled
def _choose(w, memory, fixed_point, own, t):
    """After an accepted step: measure, and go over to the other loop where that is due."""
    memory[STEPS] += 1.0
    if memory[STEPS] < SETTLE:
        return
    if memory[STEPS] < SETTLE + WINDOW:
        if memory[STEPS] == SETTLE:
            memory[T_BEGIN] = t
            memory[EVALUATIONS_BEGIN] = w.counters[N_EVALUATIONS]
            memory[ITERATIONS_BEGIN] = w.counters[N_OUTER]
            memory[ATTEMPTS] = 0.0
        return
    price = (w.counters[N_EVALUATIONS] - memory[EVALUATIONS_BEGIN]) / (t - memory[T_BEGIN])
    slow = w.counters[N_OUTER] - memory[ITERATIONS_BEGIN] >= SLOW * LOOPS * memory[ATTEMPTS]
    phase = memory[PHASE]
    memory[STEPS] = SETTLE - 1.0  # the next window, unless the phase ends
    memory[WINDOWS_TO_WAIT] -= 1.0
    if phase == FIXED_POINT and slow and memory[WINDOWS_TO_WAIT] < 0.0:
        memory[PRICE] = price
        _go_over(memory, fixed_point, own, NEWTON_ON_TRIAL)
    elif phase == NEWTON and memory[WINDOWS_TO_WAIT] < 0.0:
        memory[PRICE] = price
        _go_over(memory, fixed_point, own, FIXED_POINT_ON_TRIAL)
    elif phase in (NEWTON_ON_TRIAL, FIXED_POINT_ON_TRIAL):
        by_newton = GAIN * price <= memory[PRICE] if phase == NEWTON_ON_TRIAL else price > GAIN * memory[PRICE]
        passed = by_newton == (phase == NEWTON_ON_TRIAL)
        memory[WAIT] = PATIENCE if passed else 2.0 * memory[WAIT]
        memory[WINDOWS_TO_WAIT] = memory[WAIT]
        if passed:
            memory[PHASE] = NEWTON if by_newton else FIXED_POINT
        else:
            _go_over(memory, fixed_point, own, NEWTON if by_newton else FIXED_POINT)


@kernel(STEP)
def automatic_step(f, w, options, memory, t, h, tolerances, state, new_state):
    """One attempt by one of the two loops; errors are raised to their exponents, so that advance() needs none."""
    split = N_MEMORY_SCALARS + int(memory[FIRST_MEMORY])
    fixed_point, own = memory[N_MEMORY_SCALARS:split], memory[split:]
    accepted = memory[LAST_ACCEPTED]
    fixed_point[runge_kutta.LAST_ACCEPTED] = accepted
    own[newton.LAST_ACCEPTED] = accepted
    if accepted == 1.0 and tolerances[ESTIMATE] == 1.0:
        _choose(w, memory, fixed_point, own, t)
    memory[ATTEMPTS] += 1.0
    if memory[PHASE] == FIXED_POINT or memory[PHASE] == FIXED_POINT_ON_TRIAL:
        code, error = runge_kutta_step(f, w, options, fixed_point, t, h, tolerances, state, new_state)
        if code != OUTER_DIVERGED or tolerances[ESTIMATE] == 1.0:
            return code, error ** memory[EXPONENT] if code == DONE else error
        _go_over(memory, fixed_point, own, NEWTON)  # a fixed step cannot become shorter
    code, error = newton_step(f, w, options, own, t, h, tolerances, state, new_state)
    return code, error ** memory[NEWTON_EXPONENT] if code == DONE else error

"""Step-size control: the length of the next step from the error of this one.

With the trend (Gustafsson, ACM TOMS 20 (1994), 496) the factor also follows how the error has changed since the last
accepted step.
"""

from twoloop.kernels.data.common import SETTLE, compiled, kernel, merged

KEPT = 1.2  # with the trend, a factor from 1 to this leaves the step as it is: new factors of Newton's matrix cost

# places in a rule: the factor is SAFETY error**-EXPONENT within FACTOR_MIN and FACTOR_MAX; LEAST_ERROR is what a
# smaller error counts as in the trend (Hairer & Wanner II, IV.8), 0: without the trend
SAFETY, EXPONENT, FACTOR_MIN, FACTOR_MAX, LEAST_ERROR, N_RULE = range(6)
# places in the past: size and error of the last accepted step
H_BEFORE, ERROR_BEFORE, N_PAST = range(3)


@compiled
def factor_of(rule, past, h, error):
    """The step factor after a step h with this error, accepted from 1 down."""
    if not error > 0.0:
        return rule[FACTOR_MAX]
    follows = error <= 1.0 and rule[LEAST_ERROR] > 0.0
    factor = rule[SAFETY] * (1.0 / error if rule[EXPONENT] == 1.0 else error ** -rule[EXPONENT])
    if follows and past[ERROR_BEFORE] > 0.0:
        trend = h / past[H_BEFORE] * (past[ERROR_BEFORE] / error) ** rule[EXPONENT]
        factor = min(factor, factor * trend)
    factor = min(rule[FACTOR_MAX], max(rule[FACTOR_MIN], factor))
    return 1.0 if follows and 1.0 <= factor <= KEPT else factor


@merged
def remember(rule, past, h, error):
    """Make an accepted step the last one."""
    past[H_BEFORE], past[ERROR_BEFORE] = h, max(error, rule[LEAST_ERROR])


@kernel(SETTLE)
def nothing_to_settle(f, w, options, memory, tolerances, accepted):
    """Of a step that keeps nothing from one to the next."""

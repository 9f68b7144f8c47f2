"""Compensated sums of fixed steps: what rounding takes from positions and velocities is added in the next step.

Without them the energy of a symmetric or symplectic method wanders with the number of steps.
"""

from twoloop.kernels.algebra.linalg import copy
from twoloop.kernels.data.common import exact, inlined, merged
from twoloop.kernels.data.tolerances import ESTIMATE

N_RESTS = 4  # rows of rests: what rounding took from q and from v, at the last accepted step and in this attempt


@inlined
def rests(memory, n, tolerances):
    """The rows of REST, with which `memory` begins; none with step-size control, whose errors exceed rounding."""
    count = N_RESTS if tolerances[ESTIMATE] == 0.0 else 0
    return memory[: count * n].reshape((count, n))


@exact
def compensated(x, rest, increment):
    """The sum of the three, and what rounding takes from it (W. Kahan, Commun. ACM 8 (1965), 40)."""
    increment += rest
    total = x + increment
    return total, increment - (total - x)


@merged
def forget(coordinates, rest):
    """Coordinates that the constraints give have no rest."""
    for i in range(N_RESTS // 2, rest.shape[0]):
        for m in coordinates:
            rest[i, m] = 0.0


@merged
def keep_rest(rest):
    """That of the last attempt, which was accepted, is what the next step begins with."""
    for i in range(rest.shape[0] // 2):
        copy(rest[rest.shape[0] // 2 + i], rest[i])

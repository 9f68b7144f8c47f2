"""Where the parts of the `memory` of fixed_point_step.py and paper_step.py are."""

from twoloop.kernels.data.common import inlined, merged
from twoloop.kernels.data.tolerances import ESTIMATE
from twoloop.kernels.linalg.dense import copy

# rows of REST, for the compensated sums of fixed steps: what rounding took from q and from v, at the last accepted step
# and in this attempt. Without them the energy of a symmetric method wanders with the number of steps
N_RESTS = 4

# scalars, then stage blocks (s, n_q) and vectors (n_q)
HAS_TRIAL, H_TRIAL, HAS_PREVIOUS, H_PREVIOUS, N_MEMORY_SCALARS = range(5)
PREVIOUS, TRIAL, HALF, Q_STAGE, V_STAGE, N_BLOCKS = range(6)
Q_FULL, V_FULL, Q_MID, V_MID, A_MID, Q_OLD, V_OLD, REST, N_VECTORS = (*range(8), 7 + N_RESTS)


def memory_size(s: int, n_q: int) -> int:
    """Length of `memory` for s stages and n_q coordinates."""
    return N_MEMORY_SCALARS + N_BLOCKS * s * n_q + N_VECTORS * n_q + s


@inlined
def block(memory, s, n, which):
    """A block of the stages."""
    start = N_MEMORY_SCALARS + which * s * n
    return memory[start : start + s * n].reshape((s, n))


@inlined
def vector(memory, s, n, which):
    """A vector of the coordinates."""
    start = N_MEMORY_SCALARS + N_BLOCKS * s * n + which * n
    return memory[start : start + n]


@inlined
def rests_of(memory, s, n, tolerances):
    """The rows of REST; none with step-size control, whose errors exceed rounding."""
    start, count = N_MEMORY_SCALARS + (N_BLOCKS * s + REST) * n, N_RESTS if tolerances[ESTIMATE] == 0.0 else 0
    return memory[start : start + count * n].reshape((count, n))


@merged
def keep_rest(rest):
    """Make the rests of an accepted attempt those that the next step begins with."""
    for i in range(rest.shape[0] // 2):
        copy(rest[rest.shape[0] // 2 + i], rest[i])

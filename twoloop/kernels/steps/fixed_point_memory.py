"""Where the parts of the `memory` of fixed_point_step.py and paper_step.py are."""

from twoloop.kernels.control.compensated_sums import N_RESTS, rests
from twoloop.kernels.data.common import inlined

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
    """What rounding took from the sums."""
    return rests(memory[N_MEMORY_SCALARS + (N_BLOCKS * s + REST) * n :], n, tolerances)

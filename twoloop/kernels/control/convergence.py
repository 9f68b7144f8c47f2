"""Whether a fixed-point iteration has converged, goes on, or diverges, by how much its stages change."""

from twoloop.kernels.data.common import merged
from twoloop.kernels.evaluation.calls import rounding_floor

UNDECIDED, CONVERGED, DIVERGED = range(3)
MAX_ITERATIONS = 60
GROWTH = 1e3  # the differences may first grow (the iteration is not normal), but not by more than this
PATIENCE = 8  # iterations after which a difference that grows again means divergence


@merged
def judged(change, earlier, first, iteration, tolerance, q):
    """Of the largest change of an iteration, that of an earlier one and the first; q: positions, for their rounding."""
    if change <= tolerance:
        return CONVERGED
    if not change <= GROWTH * first:
        return DIVERGED
    if change >= earlier:
        if change <= rounding_floor(q):
            return CONVERGED
        if iteration >= PATIENCE:
            return DIVERGED
    return UNDECIDED

"""What the tolerances allow, eq. (26) of the paper."""

from twoloop.kernels.data.common import ATOL, RTOL, merged


@merged
def allowed(tolerances, m, x, x1):
    """Of an error of coordinate m, or of its velocity, in a step from x to x1."""
    return tolerances[ATOL + m] + tolerances[RTOL] * max(abs(x), abs(x1))

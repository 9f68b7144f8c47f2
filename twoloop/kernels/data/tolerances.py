"""What the tolerances allow, eq. (26) of the paper."""

from twoloop.kernels.data.common import merged

# places in the array `tolerances` that a step gets; ESTIMATE is 0 for a fixed step, LEAST the smallest tolerance, GAP
# the time within which the equations are to be looked at once at least, LOOK the same of steps that look within; from
# ATOL on stands the absolute tolerance of each coordinate and its velocity
RTOL, ESTIMATE, LEAST, GAP, LOOK, ATOL = range(6)

LONGEST_UNSEEN = 0.01  # of the run: GAP
ROUNDING = 1e-9  # relative, by which a step may be longer than it should be
UNTRUE = 30.0  # times what the tolerances allow: errors of velocities beside a singular position that are told


@merged
def allowed(tolerances, m, x, x1):
    """Of an error of coordinate m, or of its velocity, in a step from x to x1."""
    return tolerances[ATOL + m] + tolerances[RTOL] * max(abs(x), abs(x1))


@merged
def is_beyond_gap(tolerances, h):
    """Whether a step is longer than GAP."""
    return h > tolerances[GAP] * (1.0 + ROUNDING)


@merged
def times_gap(tolerances, h):
    """How many times GAP a step is long whose length is chosen by its error; 0 where it is no longer than that."""
    if tolerances[ESTIMATE] == 1.0 and is_beyond_gap(tolerances, h):
        return h / tolerances[GAP]
    return 0.0

"""What the intervals between accepted steps are called: numbers that Python and the kernels share."""

WINDOW = 4  # states that a polynomial goes through

# kinds of interval: what of the states its polynomials take
(
    APART,  # q and v in one, v and a in another: errors of q and v are independent, and steps are small
    VELOCITIES,  # q and v, and its derivative: a holds the noise of stiff modes
    ACCELERATIONS,  # q, v and a, and its derivative
    ACROSS,  # the same, of a step that was not the method's own: one across a singular position
    JUMP,  # no polynomial goes through it: velocities jump within a few spacings of floating-point numbers
) = range(5)

# columns of `groups`: a row for all times in one interval
FIRST_OWN, LAST_OWN, KIND, FIRST_TIME, END_TIME, LOW, HIGH, N_COLUMNS = range(8)  # LOW, HIGH: rows between jumps

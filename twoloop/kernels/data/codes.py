"""What a kernel returns: DONE, or why it could not."""

(
    DONE,
    OUTER_DIVERGED,
    INNER_DIVERGED,
    SINGULAR,
    NOT_FINITE,
    MASS_NOT_DEFINITE,
    GAMMA_INACCURATE,
    RANK_DIFFERS,
    ROWS_CONTRADICT,
    NEEDS_DENSE,  # the static form cannot decide it
    NOT_LOADED,  # the machine code of the step: the caller is to load it
    UNSUITED,  # the method does not suit the motion here: another one is to go on
) = range(12)

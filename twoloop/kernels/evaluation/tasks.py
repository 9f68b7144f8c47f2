"""What the steps may ask an inner loop for; inner_loop.py has a function for each."""

(
    EVALUATE,
    EVALUATE_STATE,
    RESTORE,
    ACCELERATIONS,
    MULTIPLIERS,
    EVALUATE_THERE,
    PROJECT,
    TANGENTS,
    MASS_TASK,
    RENEW,
    MIDPOINT,
    PATTERN,
    REDUNDANT,
    SOLVE,  # of large systems alone, see sparse_inner_loop.py
) = range(14)

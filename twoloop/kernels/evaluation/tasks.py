"""What the steps may ask an inner loop for; calls.py has a function for each."""

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
    SOLVE,  # of large systems alone, see static_inner.py
) = range(14)

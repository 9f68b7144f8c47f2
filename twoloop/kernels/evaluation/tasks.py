"""What the steps may ask an inner loop for; calls.py has a function for each."""

(
    EVALUATE,
    EVALUATE_STATE,
    RESTORE,
    POSITIONS,
    ACCELERATIONS,
    MULTIPLIERS,
    EVALUATE_THERE,
    PROJECT,
    TANGENTS,
    GAMMA_TASK,
    MASS_TASK,
    RENEW,
    MIDPOINT,
    PATTERN,
    REDUNDANT,
    SOLVE,  # of large systems alone, see static_inner.py
) = range(16)

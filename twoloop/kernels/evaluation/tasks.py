"""What the steps may ask an inner loop for; inner_loop.py has a function for each."""

(
    EVALUATE,
    EVALUATE_STATE,
    RESTORE,
    ACCELERATIONS,
    MULTIPLIERS,
    EVALUATE_AS_GIVEN,
    PROJECT,
    FIND_NULL_SPACE,
    PREPARE_MASS,
    RENEW_PARTITION,
    ADOPT_MIDPOINT,
    VERIFY_PATTERN,
    CHECK_REDUNDANT,
    SOLVE,  # of large systems alone, see sparse_inner_loop.py
) = range(14)

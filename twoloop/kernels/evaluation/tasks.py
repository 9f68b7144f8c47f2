"""Tasks of an inner loop: for each of them inner_loop.py has a function of the same name."""

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
    SOLVE,  # large systems only, see sparse_inner_loop.py
) = range(14)

"""Number the tasks of an inner loop. In inner_loop.py, each task has a function, whose docstring explains the task."""

(
    EVALUATE,
    EVALUATE_STATE,
    RESTORE,
    ACCELERATIONS,
    MULTIPLIERS,
    EVALUATE_WITHOUT_PROJECTION,
    PROJECT,
    FIND_NULL_SPACE,
    PREPARE_MASS,
    RENEW_PARTITION,
    ADOPT_MIDPOINT,
    VERIFY_PATTERN,
    CHECK_REDUNDANT,
    SOLVE,  # solve M a + G^T lam = r, G a = c; only the inner loop for large systems has this task
) = range(14)

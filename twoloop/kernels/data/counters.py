"""What a run counts: places in Work.counters."""

(
    N_ACCEPTED,
    N_REJECTED_ERROR,
    N_REJECTED_CONVERGENCE,
    N_OUTER,
    N_INNER,
    N_EVALUATIONS,
    N_PARTITIONS,
    N_FACTORIZATIONS,
    N_JACOBIANS,
    N_COUNTERS,
) = range(10)

"""What kernels note for one another: places in Work.notes."""

(
    SENSITIVITY,  # max|Cqd^-1 Cqi| after the first step under this partition; 0: not known yet
    ORIENTATION,  # sign of det C_qd at the last accepted state under this partition; 0: not known
    ORIENTATION_NEW,  # ... and at the end of this attempt
    FAULT_KIND,  # place in Functions of the callback that gave a value that is not finite; -1: none known
    FAULT_TIME,  # ... and when
    GAMMA_REQUIRED,  # relative accuracy that Q_d by differences must have, see constraints.py
    GAMMA_SHARE,  # of the longest length over which to difference
    GAMMA_ACCURACY,  # reached when that share was chosen
    GAMMA_SCALE,  # largest entry of Q_d so far
    REUSE,  # correction of a position below which the Jacobian before it serves for velocities and accelerations
    ROUNDED,  # the same at a state that may be accepted: rounding of the positions
    GENERATION,  # how many partitions there were
    RANK,  # of C_q, and of C_q and A, where they are not what the workspace is made for
    RANK_V,
    CONTRADICTION,  # row that was taken for redundant and is violated
    PIVOT,  # smallest of the last full pivoting, rows scaled to 1: small near a singular position
    NEARLY_SINGULAR,  # 1: the run has come near a singular position, or is not to look for one
    NEAR_NOW,  # 1: a singular position was near at the last look; 2: a step that could look within did not for it
    MASS_SCALE,  # s of the augmented matrix, see linalg/saddle_point.py
    FACTORED,  # 1: the factors of the linear problem belong to w.M and w.G
    KNOWN,  # 1: w.Rate and w.Gamma[:n_c] belong to the state, from the fused callback
    BY_GENERAL,  # 1: code made for the mechanism left the last state to the general inner loop
    EXPLICIT_STEP,  # 1: a method that switches took an explicit step
    DEFECT,  # largest that this attempt found of itself, over what the tolerances allow; -1: it did not look
    LARGEST_DEFECT,  # of the accepted steps
    UNCHECKED,  # accepted steps that did not look
    WIDEST_GAP,  # between two places at which accepted steps looked at the equations, s
    KINK_BEFORE,  # times between which no jump of C_t or b is known
    KINK_AFTER,
    LEANING,  # largest share of a row that counts in a redundant one, as at the first look under this partition
    SMALLEST,  # of the static form: least pivot of a row over its size, the sine squared of its angle to others
    N_NOTES,
) = range(32)

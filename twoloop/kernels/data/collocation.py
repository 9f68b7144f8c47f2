"""Layout of the memory of collocation steps, an array that generated code fills and steps/lobatto_step.py reads.

An offset is an index in this array, which begins at an aligned address. Quantities at the nodes of a step are stored
as LANES numbers side by side, one for each node after the beginning. The ends of up to LANES successive steps are
projected onto the constraints together: their quantities are stored as LANES numbers, one for each step. A sweep is one
iteration for all stages. A coordinate is iterated if accelerations depend on it or its velocity.
"""

LANES = 8  # number of values, one in each SIMD lane, that are computed at once
ORDER = 12.0  # the error estimate is proportional to this power of the step size
MAX_ROUNDING = 1e-13  # a difference of two values up to this fraction of the values may be a rounding error
# results of the iteration for the stages. REJECTED: it did not converge, or the error is too large. GUESSED: the step
# size was only a guess, and another one must be tried. NOT_COMPUTED: accelerations at the nodes could not be computed
CONVERGED, REJECTED, GUESSED, NOT_COMPUTED = range(4)

# indices of single numbers in the memory of collocation steps
(
    T,  # time at the beginning of the step (s)
    H,  # step size (s)
    H_BEFORE,  # size (s) of the step whose polynomial predicts the accelerations in this step
    DEGREE,  # degree of the polynomial that predicts the accelerations in this step
    PREDICTS,  # 1: a polynomial predicts the accelerations in this step; 0: they are predicted to be constant
    CURRENT,  # index, 0 or 1, of the stored polynomial that belongs to the last accepted step
    TRIED,  # 1: the stored polynomial with the index 1 - CURRENT belongs to the attempted step; 0: it is not in use
    NEXT_DEGREE,  # degree of the polynomial that will predict the accelerations in the next step
    OLD_DEGREE,  # DEGREE before a step was rejected; the next accepted step restores it; 0: no rejected step
    MAY_GUESS,  # 1: the step size is a guess; if the contraction RHO is too small or large, try another; 0: final
    N_MASS_FIRST,  # number of next steps in which elimination begins with the mass matrix: another order has failed
    N_GUESSES,  # number of guesses of the first step size so far
    N_STEPS,  # number of accepted steps since the method began
    LIMITED,  # counter, at least 0: +1 for a step whose size was limited by the convergence, -1 for any other step
    FAILURES,  # counter, at least 0: +2 for a step that did not converge, -1 for an accepted step
    DEFECT,  # largest defect of the accelerations between nodes, relative to the allowed defect; -1: not evaluated
    RHO,  # contraction: ratio of the changes of velocities by the last sweep (iteration) and by the one before
    SWEEPS,  # number of sweeps (iterations for all stages) that the step took
    N_TARGET,  # number of sweeps (iterations) that a step should take: the next step size is chosen accordingly
    CHANGE,  # change of velocities by the last sweep (iteration), relative to the tolerances
    ERROR,  # error of the step, relative to the tolerances
    CURVATURE,  # largest Legendre coefficient (degree 5 or 6) of the accelerations in a step, relative to tolerances
    FACTOR,  # largest ratio of the next step size to this one that the convergence allows
    FACTOR_OF_ERROR,  # largest ratio of the next step size to this one that the error allows
    FACTOR_OF_DEFECT,  # largest ratio of the next step size to this one that the defect allows
    ALLOWED_H,  # largest size (s) with which the last step would have satisfied the error test
    SIZE,  # largest |v| + H |a| (H: step size) where the step begins, relative to tolerances: scale of rounding errors
    STRICTER,  # largest of all WEIGHTS / largest weight of a coordinate on which accelerations depend (or its velocity)
    REPEATS,  # 1: each sweep (iteration) evaluates accelerations at old, then again at new velocities; 0: only once
) = range(29)
# offsets of arrays that follow the single numbers
POWERS = 32  # offset of eight numbers: powers 1 to 8 of H / H_BEFORE (sizes of this step and of the one before)
SCALED = 40  # offset of eight numbers: coefficients of the polynomial that predicts an acceleration, times POWERS
MOVED = 48  # offset of eight numbers, one for each projected end of a step: max|correction of q| in the last iteration
VALID = 56  # offset of eight numbers, one for each end of a step: 1 if its projection converged, else 0
DEFECTS = 64  # offset of eight numbers: values of DEFECT in successive steps
WEIGHTS = 72  # offset of n_q numbers: weights, 1 / (allowed error of the velocity) for each coordinate


def array_offsets(n, n_iterated, n_rows):
    """Return the offsets of eight arrays whose sizes depend on the mechanism, and the length of the memory.

    Each entry of these arrays is a group of LANES numbers. Arrays of the stages: accelerations (n entries), positions,
    velocities, two polynomials (n_iterated each), Legendre coefficients of accelerations (n). Arrays of the ends of
    steps, for their projection: t, q and v together (1 + 2 n), accelerations (n), multipliers (n_rows).
    """
    a = WEIGHTS + LANES * (-(-n // LANES))
    q = a + LANES * n
    v = q + LANES * n_iterated
    polynomials = v + LANES * n_iterated
    spectra = polynomials + 2 * LANES * n_iterated
    ends = spectra + LANES * n
    end_a = ends + LANES * (1 + 2 * n)
    lam = end_a + LANES * n
    return a, q, v, polynomials, spectra, ends, end_a, lam, lam + LANES * n_rows

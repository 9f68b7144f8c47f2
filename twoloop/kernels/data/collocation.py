"""Layout of the memory of collocation steps, an array that generated code fills and steps/lobatto_step.py reads.

An offset is an index in this array, which begins at an aligned address. Quantities at the nodes of a step are stored
as LANES numbers side by side, one for each node after the beginning. The ends of up to LANES successive steps are
projected onto the constraints together: their quantities are stored as LANES numbers, one for each step. A sweep is one
iteration for all stages. Coordinates are iterated only if accelerations depend on them or their velocities.
"""

LANES = 8  # number of values, one in each SIMD lane, that are computed at once
ORDER = 12.0  # the error estimate of a step is proportional to this power of the step size
MAX_ROUNDING = 1e-13  # a difference of two numbers may be a rounding error if it is at most this * their magnitude
# results of the iteration for the stages. REJECTED: no convergence, or the error is too large. GUESSED: the step size
# was only a guess, and another one must be tried. NOT_COMPUTED: accelerations at the nodes could not be computed
CONVERGED, REJECTED, GUESSED, NOT_COMPUTED = range(4)

# indices of single numbers in the memory of collocation steps
(
    T,  # time at the beginning of the step (s)
    H,  # step size (s)
    H_BEFORE,  # size (s) of the step whose polynomial predicts the accelerations in this step
    DEGREE,  # degree of the polynomial that predicts the accelerations in this step
    PREDICTS,  # 1: a polynomial predicts the accelerations in this step; 0: they are predicted to be constant
    CURRENT,  # index, 0 or 1, of the stored polynomial that belongs to the last accepted step
    TRIED,  # 1: of the two stored polynomials, the one not at CURRENT belongs to the attempted step; 0: it does not
    NEXT_DEGREE,  # degree of the polynomial that will predict the accelerations in the next step
    OLD_DEGREE,  # value of DEGREE before a rejected step; the next accepted step restores it; 0: nothing to restore
    MAY_GUESS,  # 1: the step size is a guess, replaced if RHO is below FAST_START or above SLOW_START; 0: it is final
    N_MASS_FIRST,  # number of next steps that begin elimination with M, because the shorter elimination was inaccurate
    N_GUESSES,  # number of guesses of the first step size so far
    N_STEPS,  # number of accepted steps since the method began
    LIMITED,  # count that shows stiffness: steps limited in size by convergence add 1; others subtract 1, down to 0
    FAILURES,  # count that shows stiffness: steps that do not converge add 2; accepted steps subtract 1, down to 0
    DEFECT,  # largest defect of the accelerations between nodes, relative to the allowed defect; -1: not evaluated
    RHO,  # contraction: ratio of the changes of velocities by the last sweep (iteration) and by the one before
    SWEEPS,  # number of sweeps (iterations for all stages) that the step took
    N_TARGET,  # number of sweeps (iterations) that a step should take: the next step size is chosen accordingly
    CHANGE,  # largest change of a velocity by the last sweep (iteration), relative to the tolerances
    ERROR,  # estimated error of the step, relative to the tolerances
    CURVATURE,  # largest Legendre coefficient (degree 5 or 6) of the accelerations in a step, relative to tolerances
    FACTOR,  # (next step size) / (size of this step) for which a step should converge after N_TARGET sweeps
    FACTOR_OF_ERROR,  # (next step size) / (size of this step) for which the estimated error should equal the tolerance
    FACTOR_OF_DEFECT,  # (next step size) / (size of this step) for which the defect should equal the allowed defect
    ALLOWED_H,  # largest size (s) with which the last step would have satisfied the error test
    SIZE,  # largest |v| + H |a| (H: step size) where the step begins, relative to tolerances: scale of rounding errors
    STRICTER,  # factor on changes in a sweep: (largest of all WEIGHTS) / (largest of WEIGHTS of iterated coordinates)
    REPEATS,  # 1: a sweep (iteration) evaluates accelerations at old, then at new velocities; 0: only at old velocities
) = range(29)
POWERS = 32  # index of the first of eight numbers: powers 1 to 8 of (size of this step / size of the step before)
SCALED = 40  # index of the first of eight products: (coefficient of the predicting polynomial) * (number in POWERS)
MOVED = 48  # index of the first of eight numbers, one for each end of a step: max|change of q| in the last projection
VALID = 56  # index of the first of eight numbers, one for each end of a step: 1 if its projection converged, else 0
DEFECTS = 64  # index of the first of eight numbers: the values of DEFECT in up to eight successive steps
WEIGHTS = 72  # index of the first of n_q numbers, one for each coordinate: 1 / (allowed error of its velocity)


def array_offsets(n, n_iterated, n_rows):
    """Return where eight arrays, whose sizes depend on the mechanism, begin in the memory; and the memory's length.

    An entry of these arrays is a group of LANES numbers. Arrays of the stages: accelerations (n entries, one for each
    coordinate), positions, velocities, two polynomials (n_iterated each), Legendre coefficients of accelerations (n).
    Arrays of the projected ends of steps: t, q and v together (1 + 2 n), accelerations (n), multipliers (n_rows).
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

"""Layout of the memory of collocation steps, which generated code fills and steps/lobatto_step.py reads.

Offsets are counted in numbers, from an aligned address on. "lanes" are groups of eight numbers: one number for each
unknown node, or one for each of eight steps that are projected together.
"""

LANES = 8
ORDER = 12.0  # order of the estimated error
NOISE = 1e-13  # relative to the values: smaller differences may be rounding errors
# results of the iteration of the stages. REFUSED: the step is rejected. GUESSED: the step size was a guess, and another
# one has to be tried. NOT_COMPUTED: the accelerations could not be computed
CONVERGED, REFUSED, GUESSED, NOT_COMPUTED = range(4)

(
    T,  # beginning of the step
    H,
    H_BEFORE,  # size of the step whose polynomial predicts this one
    DEGREE,  # degree of the polynomial that predicts this step
    PREDICTS,  # 1: there is a polynomial; 0: accelerations are predicted to be constant
    WHICH,  # index of the polynomial of the last accepted step
    TRIED,  # 1: the polynomial with the other index belongs to the step just attempted
    NEXT_DEGREE,
    KEPT_DEGREE,  # degree of the prediction before a rejected step; 0: none was rejected
    MAY_GUESS,  # 1: the step size is a guess, and another is tried if the contraction is far from its target
    CAREFUL,  # number of steps that still use the elimination that begins with M
    STARTS,  # number of guesses of the first step size so far
    N_STEPS,  # number of steps since the beginning of the run
    LIMITED,  # number of steps that convergence limited, less those that accuracy limited
    FAILURES,  # twice the number of steps that did not converge, less those accepted
    DEFECT,  # largest defect between nodes over the allowed defect; -1: not evaluated
    RHO,  # contraction by a sweep: ratio of successive changes
    SWEEPS,  # number of sweeps of the step
    TARGETED,  # target of the number of sweeps
    CHANGE,  # change of velocities by the last sweep, over the tolerances
    ERROR,  # error of the step, over the tolerances
    CURVED,  # Legendre coefficients of degree 5 and 6 of the accelerations, over the tolerances
    FACTOR,  # ratio of the next step size to this one that convergence allows
    FACTOR_OF_ERROR,  # ratio of the next step size to this one that the error allows
    FACTOR_OF_DEFECT,  # ratio of the next step size to this one that the defect allows
    ALLOWED_H,  # step size that the error would have allowed, s
    SIZE,  # size of velocities and of their changes, over the tolerances
    STRICTER,  # ratio by which the tolerances of other coordinates are stricter than those of the iterated ones
) = range(28)
# offsets of the arrays behind the scalars
POWERS = 32  # lanes: powers 1 to 8 of the ratio of the step size to the previous step size
SCALED = 40  # lanes: coefficients of a polynomial times these powers
MOVED = 48  # lanes: largest change of a coordinate by the last projection
FINE = 56  # lanes: 1 where the projection succeeded
DEFECTS = 64  # lanes: defects of successive steps
WEIGHTS = 72  # (n): reciprocals of the allowed errors of velocities


def places(n, n_iterated, n_rows):
    """Return the offsets of the arrays whose sizes depend on the mechanism, and the length of the memory.

    For the stages: accelerations (n lanes), positions, velocities and two polynomials (n_iterated lanes each), and the
    Legendre coefficients of the accelerations (n lanes). For the projection: t, q and v (1 + 2 n lanes), a (n lanes)
    and lam (n_rows lanes).
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

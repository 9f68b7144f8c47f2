"""Layout of the memory of collocation steps, which generated code fills and steps/lobatto_step.py reads.

An offset is the index of a number in this memory, which begins at an aligned address. A group of "lanes" is eight
numbers: one number for each unknown node, or one for each of eight steps that are projected together.
"""

LANES = 8  # number of lanes, that is, of numbers that are computed at once
ORDER = 12.0  # the error estimate is proportional to this power of the step size
MAX_ROUNDING = 1e-13  # differences of at most this size, relative to the values, may be rounding errors
# how the iteration of the stages ended. REJECTED: the step is rejected. GUESSED: the step size was a guess, and another
# guess must be tried. NOT_COMPUTED: accelerations at the nodes could not be computed
CONVERGED, REJECTED, GUESSED, NOT_COMPUTED = range(4)

(
    T,  # time at the beginning of the step (s)
    H,  # step size (s)
    H_BEFORE,  # size (s) of the step whose polynomial predicts the accelerations in this step
    DEGREE,  # degree of the polynomial that predicts the accelerations in this step
    PREDICTS,  # 1: accelerations are predicted by a polynomial; 0: they are predicted to be constant
    CURRENT,  # 0 or 1: which of the two stored polynomials belongs to the last accepted step
    TRIED,  # 1: the other one of the stored polynomials belongs to the attempted step
    NEXT_DEGREE,  # degree of the polynomial that will predict the accelerations in the next step
    OLD_DEGREE,  # value of DEGREE before a rejection, which a later step restores; 0: no step was rejected
    MAY_GUESS,  # 1: the step size is a guess, and is replaced if the contraction is far from its target
    N_MASS_FIRST,  # number of coming steps that eliminate M first, because another order of elimination has failed
    N_GUESSES,  # number of guesses of the first step size so far
    N_STEPS,  # number of accepted steps since the method began
    LIMITED,  # a count, at least 0: +1 for each step whose size the convergence limited, -1 for each other step
    FAILURES,  # a count, at least 0: +2 for each step that did not converge, -1 for each accepted step
    DEFECT,  # largest defect between nodes, relative to the allowed defect; -1: not evaluated
    RHO,  # contraction by a sweep: ratio of successive changes of the velocities
    SWEEPS,  # number of sweeps in the step
    N_TARGET,  # number of sweeps that the next step should take: its size is chosen accordingly
    CHANGE,  # change of velocities by the last sweep, relative to the tolerances
    ERROR,  # error of the step, relative to the tolerances
    CURVATURE,  # largest Legendre coefficient of degree 5 or 6 of the accelerations, relative to the tolerances
    FACTOR,  # largest ratio of the next step size to this one that the convergence allows
    FACTOR_OF_ERROR,  # largest ratio of the next step size to this one that the error allows
    FACTOR_OF_DEFECT,  # largest ratio of the next step size to this one that the defect allows
    ALLOWED_H,  # largest size (s) that the error would have allowed for the last step
    SIZE,  # largest |v| + |change of v in the step|, relative to the tolerances: the scale of rounding errors
    STRICTER,  # largest of all WEIGHTS, divided by the largest of an iterated coordinate
    REPEATS,  # 1: each sweep evaluates accelerations twice, first at old and then at new velocities; 0: once
) = range(29)
# offsets of the arrays that follow the scalars
POWERS = 32  # offset of eight numbers: powers 1 to 8 of H / H_BEFORE
SCALED = 40  # offset of eight numbers: coefficients of a polynomial, multiplied by POWERS
MOVED = 48  # offset of eight numbers: largest change of a coordinate by the last projection, for each of eight steps
VALID = 56  # offset of eight numbers: 1 for steps whose projection succeeded
DEFECTS = 64  # offset of eight numbers: defects of successive steps
WEIGHTS = 72  # offset of n_q numbers: reciprocals of the allowed errors of velocities


def array_offsets(n, n_iterated, n_rows):
    """Return the offsets of the arrays whose sizes depend on the mechanism, and the length of the memory.

    Arrays of the stages, in groups of lanes: accelerations (n), positions, velocities and two polynomials (n_iterated
    each), Legendre coefficients of the accelerations (n). Of the projection: t, q, v (1 + 2 n), a (n), lam (n_rows).
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

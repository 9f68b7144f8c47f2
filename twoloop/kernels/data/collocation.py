"""What steps by collocation have in memory: generated code fills it, and steps/lobatto_step.py reads it.

Places are counted in numbers from an aligned place on. "Lanes" are eight numbers side by side, one for each unknown
node, or for each of eight steps that are put on the constraints together.
"""

LANES = 8
ORDER = 12.0  # of the estimate of the error
NOISE = 1e-13  # of values: what their differences may be for rounding's sake
MADE, REFUSED, GUESSED, LEFT = range(4)  # how the stages of a step ended

(
    T,  # beginning of the step
    H,
    H_BEFORE,  # of the step whose polynomial predicts this one
    DEGREE,  # of the polynomial that predicts
    PREDICTS,  # 1: there is one; 0: accelerations are taken for constant
    WHICH,  # of two such polynomials is that of the last accepted step
    TRIED,  # 1: the other one is that of the step just made
    NEXT_DEGREE,
    KEPT_DEGREE,  # that of the prediction before a step that was refused; 0: none was
    MAY_GUESS,  # 1: the length of the step is a guess, and another is tried where its sweeps contract too well or badly
    CAREFUL,  # steps that are still to be made by the elimination of M
    STARTS,  # guesses for the first step so far
    N_STEPS,  # since the beginning
    LIMITED,  # steps that convergence, not accuracy, kept short, less the others
    UNMADE,  # twice the steps that did not converge, less those accepted
    DEFECT,  # between nodes, over what is allowed; -1: it was not looked for
    RHO,  # contraction of a sweep
    SWEEPS,  # of the step
    TARGETED,  # how many these were to be
    CHANGE,  # by the last one, over the tolerances
    ERROR,  # of the step, over the tolerances
    CURVED,  # the coefficients of degree 5 and 6 of its accelerations, over the tolerances
    FACTOR,  # by which the next step may be longer as the sweeps converge; and for the sake of the error, a defect
    FACTOR_OF_ERROR,
    FACTOR_OF_DEFECT,
    ALLOWED_H,  # how long the step might have been for its error
    SIZE,  # of velocities and their changes, over the tolerances
    STRICTER,  # how many times less of the coordinates that are iterated the tolerances of others allow
) = range(28)
POWERS = 32  # lanes: of the length of the step over that before
SCALED = 40  # lanes: the coefficients of a polynomial times these
MOVED = 48  # lanes: how far positions were moved last, the largest coordinate
FINE = 56  # lanes: 1 where the projection could be made
DEFECTS = 64  # lanes: of steps in a row
WEIGHTS = 72  # (n): 1 / what an error of a velocity may be


def places(n, n_iterated, n_rows):
    """Where what has no fixed place begins, and the length of the whole.

    Accelerations at the nodes (n lanes), positions and velocities there and two polynomials (n_iterated lanes each),
    the spectrum of accelerations (n lanes); and for the projection t, q and v (1 + 2 n lanes), a (n lanes) and lam
    (n_rows lanes).
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

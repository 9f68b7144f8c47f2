"""What steps by collocation have in memory: generated code fills it, and steps/lobatto_step.py reads it.

Places are counted in numbers from an aligned place on. "Lanes" are eight numbers side by side, one for each unknown
node, or for each of eight steps that are put on the constraints together.
"""

LANES = 8

(
    T,  # beginning of the step
    H,
    H_BEFORE,  # of the step whose polynomial predicts this one
    DEGREE,  # of the polynomial that predicts
    PREDICTS,  # 1: there is one; 0: accelerations are taken for constant
    WHICH,  # of two such polynomials is that of the last accepted step
    TRIED,  # 1: the other one is that of the step just made
    NEXT_DEGREE,
    RHO,  # contraction of a sweep
    STARTS,  # guesses for the first step so far
    N_STEPS,  # since the beginning
    LIMITED,  # steps that convergence, not accuracy, kept short, less the others
    REFUSED,  # twice the steps that did not converge, less those accepted
    LARGEST,  # acceleration at the beginning, over the tolerances
    DEFECT,  # between nodes, over what is allowed; -1: it was not looked for
    ERROR,  # of the step, over the tolerances
    CURVED,  # the coefficients of degree 5 and 6 of its accelerations, over the tolerances
    SIZE,  # of velocities and their changes, over the tolerances
    STRICTER,  # how many times less of the coordinates that are iterated the tolerances of others allow
) = range(19)
POWERS = 24  # lanes: of the length of the step over that before
WORST = 32  # lanes: the error of predictions of degree 1 to 8 at the end of the step
MOVED = 40  # lanes: how far positions were moved last, the largest coordinate
FINE = 48  # lanes: 1 where the projection could be made
DEFECTS = 56  # lanes: of steps in a row
WEIGHTS = 64  # (n): 1 / what an error of a velocity may be


def places(n, n_iterated, n_rows):
    """Where what has no fixed place begins, and the length of the whole.

    Accelerations at the nodes (n lanes), positions and velocities there and two polynomials (n_iterated lanes each);
    and for the projection t, q and v (1 + 2 n lanes), a (n lanes) and lam (n_rows lanes).
    """
    a = WEIGHTS + LANES * (-(-n // LANES))
    q = a + LANES * n
    v = q + LANES * n_iterated
    polynomials = v + LANES * n_iterated
    ends = polynomials + 2 * LANES * n_iterated
    end_a = ends + LANES * (1 + 2 * n)
    lam = end_a + LANES * n
    return a, q, v, polynomials, ends, end_a, lam, lam + LANES * n_rows

"""Rows of the constraints on velocities, their rates, and Gamma (right-hand side of accelerations) by differences.

The first rows are C_q of C(t, q) = 0, the others A of A(t, q) v + b(t, q) = 0.

Gamma is computed by differences along the motion: two central differences, over times e and 2 e, give the derivative to
order 4. Their disagreement estimates its error, by which the length e is chosen.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, exact, merged
from twoloop.kernels.data.indices import (
    AUGMENTED,
    CONSTRAINT_RATE_GIVEN,
    DONE,
    FORM,
    GAMMA_ACCURACY,
    GAMMA_INACCURATE,
    GAMMA_REQUIRED,
    GAMMA_SCALE,
    GAMMA_SHARE,
    KINK_AFTER,
    KINK_BEFORE,
    NONHOLONOMIC_RATE_GIVEN,
)
from twoloop.kernels.evaluation.operations import jacobian_by_program
from twoloop.kernels.linalg.dense import copy, largest_of


@merged
def constraint_rows(f, w, t, q, G):
    """Evaluate C_q and A at (t, q) into G, which is w.G or w.Gx, full of zeros."""
    n_c, n_rows = w.C.size, w.Rate.size
    if n_c > 0 and not jacobian_by_program(f, w, t, q, G):
        f.jacobian(t, q, f.p, G[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, G[n_c:n_rows])


@compiled
def _clear_places(w):
    for i in range(w.Rate.size):
        for k in range(w.places[i], w.places[i + 1]):
            w.G[i, w.places[k]] = 0.0


@merged
def clear_rows(f, w):
    """Set w.G to zero.

    In large matrices only recorded entries are cleared; the task VERIFY_PATTERN detects new entries after a step.
    """
    if f.flags[FORM] == AUGMENTED:
        _clear_places(w)
    else:
        w.entries[:] = 0.0


@merged
def row_residual(w, v, rows):
    """Compute G v + (C_t, b) of the rows with indices `rows` into w.z."""
    for k in range(rows.size):
        row = rows[k]
        total = w.Rate[row]
        for p in range(w.places[row], w.places[row + 1]):
            total += w.G[row, w.places[p]] * v[w.places[p]]
        w.z[k] = total


@merged
def constraint_rates(f, w, t, q, rate):
    """Evaluate C_t and b at (t, q) into `rate`."""
    n_c, n_rows = w.C.size, w.Rate.size
    rate[:] = 0.0
    if f.flags[CONSTRAINT_RATE_GIVEN] == 1:
        f.constraint_rate(t, q, f.p, rate[:n_c])
    if n_rows > n_c and f.flags[NONHOLONOMIC_RATE_GIVEN] == 1:
        f.nonholonomic_rate(t, q, f.p, rate[n_c:])


@merged
def kinematics(f, w, t, q, v):
    """Evaluate C, C_q and A, C_t and b, and Gamma of the rows of C at (t, q, v), by the fused callback."""
    n_c, n_rows = w.C.size, w.Rate.size
    clear_rows(f, w)
    w.C[:] = 0.0
    w.Rate[:] = 0.0
    w.Gamma[:] = 0.0
    f.kinematics(t, q, v, f.p, w.C, w.G[:n_c], w.Rate[:n_c], w.Gamma[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, w.G[n_c:n_rows])
        if f.flags[NONHOLONOMIC_RATE_GIVEN] == 1:
            f.nonholonomic_rate(t, q, f.p, w.Rate[n_c:])


@merged
def gather_independent_columns(G, rate, rows, independent, D):
    """Write right-hand sides into the rows of D: minus the independent columns of G, and minus `rate`."""
    for j in range(independent.size):
        column = independent[j]
        for k in range(rows.size):
            D[j, k] = -G[rows[k], column]
    for k in range(rows.size):
        D[independent.size, k] = -rate[rows[k]]


# largest time of a difference, s, and largest relative change of q in it; smallest such time over the largest one
MAX_DIFFERENCE, MIN_SHARE = 2e-4, 1e-4
LEVELS = 12  # number of lengths that _choose_length tries, each a quarter of the length before
ROUNDING_DISAGREEMENT = 1e-9  # disagreement of both differences, relative to Gamma, that rounding alone may cause
# disagreement, relative to Gamma, below which the length is doubled: this loses no accuracy and reduces rounding
LENGTHENING_DISAGREEMENT = 1e-11
# weights of values at 0, e, 2 e and 4 e: first derivatives of order 2, over e and over 2 e
ONE_SIDED, ONE_SIDED_TWICE = (-1.5, 2.0, -0.5, 0.0), (-0.75, 0.0, 1.0, -0.25)
# length of one-sided differences relative to two-sided ones: their order is lower, so that a shorter length is better
ONE_SIDED_LENGTH = 1.0 / 16.0
# rounding error of Gamma if the terms of G v cancel, relative to the largest term over longest_difference
ROUNDING_OF_TERMS = 1e-14
CONVERGED_SHARE = 0.01  # relative to the required accuracy: a smaller change ends the search for a length


@exact
def representable_step(t, h):
    """Return (t + h) - t, the step that floating-point times can make: near 1e9 s their spacing is 2e-7 s."""
    return (t + h) - t


@merged
def longest_difference(q, v):
    """Return the largest time e of a difference, s: MAX_DIFFERENCE, or less if q moves fast.

    In this time q moves by at most MAX_DIFFERENCE times max|q|; the time is at least MIN_SHARE times MAX_DIFFERENCE.
    """
    size, speed = largest_of(q), largest_of(v)
    if speed <= size:
        return MAX_DIFFERENCE
    return MAX_DIFFERENCE * max(size / speed, MIN_SHARE)  # MIN_SHARE matters where all coordinates pass through zero


@merged
def _one_sided_direction(notes, t, e):
    """Return on which side of t (1 or -1) to take differences near a known jump of C_t or b; 0: on both sides."""
    before, after = t - notes[KINK_BEFORE], notes[KINK_AFTER] - t
    if min(before, after) >= 2.0 * e:
        return 0.0
    return 1.0 if after >= before else -1.0


@compiled
def _differences(f, w, t, q, v, e, first, last):
    """Compute Gamma by differences over e and 2 e; return its largest entry, disagreement, and term of G v."""
    Gamma_twice = w.Gamma_tried[0]
    side = _one_sided_direction(w.notes, t, e)
    shorter = representable_step(t, ONE_SIDED_LENGTH * e)
    if side != 0.0 and shorter > 0.0:
        e = shorter
    terms = 0.0
    for i in range(first, last):
        w.Gamma[i] = 0.0
        Gamma_twice[i] = 0.0
    for k in range(4):
        shift = (-2.0, -1.0, 1.0, 2.0)[k] * e if side == 0.0 else (0.0, 1.0, 2.0, 4.0)[k] * side * e
        for j in range(q.size):
            w.x[j] = q[j] + shift * v[j]
        w.Gx[:, :] = 0.0
        constraint_rows(f, w, t + shift, w.x, w.Gx)
        constraint_rates(f, w, t + shift, w.x, w.g)
        for i in range(first, last):
            for j in range(v.size):
                w.g[i] += w.Gx[i, j] * v[j]
                terms = max(terms, abs(w.Gx[i, j] * v[j]))
            if side != 0.0:
                w.Gamma[i] -= ONE_SIDED[k] * w.g[i] / (side * e)
                Gamma_twice[i] -= ONE_SIDED_TWICE[k] * w.g[i] / (side * e)
            elif k == 0 or k == 3:
                Gamma_twice[i] -= w.g[i] / (2.0 * shift)
            else:
                w.Gamma[i] -= w.g[i] / (2.0 * shift)
    largest = 0.0
    disagreement = 0.0
    for i in range(first, last):
        disagreement = max(disagreement, abs(w.Gamma[i] - Gamma_twice[i]))
        w.Gamma[i] = (4.0 * w.Gamma[i] - Gamma_twice[i]) / 3.0
        largest = max(largest, abs(w.Gamma[i]))
        if not np.isfinite(w.Gamma[i]):
            return np.nan, np.nan, terms
    return largest, disagreement, terms


@merged
def _max_disagreement(notes):
    """Return the largest accepted disagreement of both differences: their combination is far more accurate."""
    return max(notes[GAMMA_REQUIRED], ROUNDING_DISAGREEMENT) * notes[GAMMA_SCALE]


@compiled
def _choose_length(f, w, t, q, v, longest, first, last):
    """Compute Gamma over ever shorter lengths until it no longer changes, or use the length with the least change.

    Stores the length as GAMMA_SHARE. Returns GAMMA_INACCURATE if the change exceeds the required accuracy, else DONE.
    """
    least_change = np.inf
    share = 1.0
    for level in range(LEVELS):
        e = representable_step(t, share * longest)
        if e <= 0.0:
            break
        copy(w.Gamma, w.Gamma_tried[1])
        largest, disagreement, _ = _differences(f, w, t, q, v, e, first, last)
        if np.isnan(largest):
            return DONE
        w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], largest)
        change = 0.0
        for i in range(first, last):
            change = max(change, abs(w.Gamma[i] - w.Gamma_tried[1, i]))
        if level > 0 and change < least_change and disagreement <= _max_disagreement(w.notes):
            least_change = change
            w.notes[GAMMA_SHARE] = share
            if change <= CONVERGED_SHARE * w.notes[GAMMA_REQUIRED] * w.notes[GAMMA_SCALE]:
                break
        share *= 0.25
    w.notes[GAMMA_ACCURACY] = least_change / w.notes[GAMMA_SCALE]
    _differences(f, w, t, q, v, representable_step(t, w.notes[GAMMA_SHARE] * longest), first, last)
    return DONE if w.notes[GAMMA_ACCURACY] <= w.notes[GAMMA_REQUIRED] else GAMMA_INACCURATE


@compiled
def gamma_by_differences(f, w, t, q, v, first, last):
    """Compute Gamma[first:last] by differences; return GAMMA_INACCURATE if no length is accurate enough, else DONE.

    Gamma = -d/de [G v + (C_t, b)](t + e, q + e v) at e = 0.

    Errors are relative to the largest entry of Gamma so far in this run. The length is GAMMA_SHARE of
    longest_difference; if the two differences disagree, it is chosen anew: a drive of kilohertz needs a short length.
    """
    longest = longest_difference(q, v)
    e = representable_step(t, w.notes[GAMMA_SHARE] * longest)
    if e > 0.0:
        largest, disagreement, terms = _differences(f, w, t, q, v, e, first, last)
        if np.isnan(largest) or disagreement == 0.0 or w.notes[GAMMA_SCALE] == 0.0:
            return DONE  # the caller reports values that are not finite; without a scale, no error can be judged
        rounding = ROUNDING_OF_TERMS * terms / longest
        w.notes[GAMMA_SCALE] = max(w.notes[GAMMA_SCALE], largest, rounding / w.notes[GAMMA_REQUIRED])
        if disagreement < LENGTHENING_DISAGREEMENT * w.notes[GAMMA_SCALE]:
            w.notes[GAMMA_SHARE] = min(1.0, 2.0 * w.notes[GAMMA_SHARE])
        if disagreement <= _max_disagreement(w.notes):
            return DONE
    return _choose_length(f, w, t, q, v, longest, first, last)

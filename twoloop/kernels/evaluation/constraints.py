"""Evaluate the constraint Jacobian G = [C_q; A], the constraint rates C_t and b, and Gamma by finite differences.

C_q belongs to constraints C(t, q) = 0, A to constraints A v + b = 0, so that G v + (C_t, b) = 0. The derivative of this
equation along the motion is G a = Gamma for accelerations a. Two central differences, with the time steps e and 2 e,
yield Gamma to order 4. The deviation between them estimates the error, by which e is chosen. `f`: kit, `w`: workspace.
"""

import numpy as np

from twoloop.kernels.data.common import compiled, exact, merged
from twoloop.kernels.data.indices import AUGMENTED, DONE, GAMMA_INACCURATE
from twoloop.kernels.evaluation.operations import jacobian_by_program
from twoloop.kernels.linalg.dense import copy, largest_of


@merged
def constraint_rows(f, w, t, q, G):
    """Store the constraint Jacobian [C_q; A] at (t, q) in G, which is w.G or w.Gx and contains zeros on entry."""
    n_c, n_rows = w.C.size, w.Rate.size
    if n_c > 0 and not jacobian_by_program(f, w, t, q, G):
        f.jacobian(t, q, f.p, G[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, G[n_c:n_rows])


@merged
def clear_rows(f, w):
    """Set the constraint Jacobian w.G to zero; in the augmented form, only its nonzero entries, see w.row_entries."""
    if f.form == AUGMENTED:
        for i in range(w.Rate.size):  # entries not in w.row_entries are zero, as the task VERIFY_PATTERN checks
            for k in range(w.row_entries[i], w.row_entries[i + 1]):
                w.G[i, w.row_entries[k]] = 0.0
    else:
        w.entries[:] = 0.0


@merged
def row_residual(w, v, rows):
    """Store in w.z the residuals G v + (C_t, b) of these `rows`, with the Jacobian G and the rates (C_t, b) in w."""
    for k in range(rows.size):
        row = rows[k]
        total = w.Rate[row]
        for p in range(w.row_entries[row], w.row_entries[row + 1]):
            total += w.G[row, w.row_entries[p]] * v[w.row_entries[p]]
        w.z[k] = total


@merged
def constraint_rates(f, w, t, q, rate):
    """Store the constraint rates C_t (for C(t, q) = 0) and b (for A v + b = 0) at (t, q) in `rate`."""
    n_c, n_rows = w.C.size, w.Rate.size
    rate[:] = 0.0
    if f.constraint_rate_given == 1:
        f.constraint_rate(t, q, f.p, rate[:n_c])
    if n_rows > n_c and f.nonholonomic_rate_given == 1:
        f.nonholonomic_rate(t, q, f.p, rate[n_c:])


@merged
def kinematics(f, w, t, q, v):
    """Store C, C_q, C_t and Gamma for C(t, q) = 0 in w by the callback `kinematics`; A and b by other callbacks."""
    n_c, n_rows = w.C.size, w.Rate.size
    clear_rows(f, w)
    w.C[:] = 0.0
    w.Rate[:] = 0.0
    w.Gamma[:] = 0.0
    f.kinematics(t, q, v, f.p, w.C, w.G[:n_c], w.Rate[:n_c], w.Gamma[:n_c])
    if n_rows > n_c:
        f.nonholonomic(t, q, f.p, w.G[n_c:n_rows])
        if f.nonholonomic_rate_given == 1:
            f.nonholonomic_rate(t, q, f.p, w.Rate[n_c:])


@merged
def gather_independent_columns(G, rate, rows, independent, D):
    """Prepare `find_null_space`: store -G[rows, independent[j]] in row j of D, and -rate[rows] in its last row."""
    for j in range(independent.size):
        column = independent[j]
        for k in range(rows.size):
            D[j, k] = -G[rows[k], column]
    for k in range(rows.size):
        D[independent.size, k] = -rate[rows[k]]


# `largest_difference_step` returns at most MAX_DIFFERENCE_STEP (s), and at least MIN_STEP_RATIO * MAX_DIFFERENCE_STEP
MAX_DIFFERENCE_STEP, MIN_STEP_RATIO = 2e-4, 1e-4
N_DIFFERENCE_STEPS = 12  # number of time steps that `_choose_difference_step` tries, each a quarter of the previous one
# Gamma with the time step e may always differ from Gamma with 2 e by this part of its size: rounding may be the reason
ROUNDING_DISAGREEMENT = 1e-9
# if Gamma with the time step e differs from Gamma with 2 e by less than this part of its size, e is doubled
NEGLIGIBLE_DISAGREEMENT = 1e-11
# weights of values at the times 0, e, 2 e and 4 e in one-sided differences of order 2; COARSE: with the time step 2 e
ONE_SIDED_WEIGHTS, ONE_SIDED_WEIGHTS_COARSE = (-1.5, 2.0, -0.5, 0.0), (-0.75, 0.0, 1.0, -0.25)
ONE_SIDED_STEP_RATIO = 1.0 / 16.0  # ratio of the time step of one-sided differences to that of central differences
# assumed rounding error of Gamma, divided by (largest |term G_ij v_j| / largest time step); G: constraint Jacobian
ROUNDING_OF_TERMS = 1e-14
CONVERGED_CHANGE = 0.01  # time steps are divided until Gamma changes by at most this part of its allowed error


@exact
def representable_step(t, h):
    """Return the step closest to h that ends at a floating-point time (near 1e9 s, these are 1.2e-7 s apart)."""
    return (t + h) - t


@merged
def largest_difference_step(q, v):
    """Return the largest time step (s) of finite differences: MAX_DIFFERENCE_STEP, or less if coordinates move fast.

    If max|v| exceeds max|q| (in SI units), the step is multiplied by max|q| / max|v|, but at least by MIN_STEP_RATIO.
    """
    size, speed = largest_of(q), largest_of(v)
    if speed <= size:
        return MAX_DIFFERENCE_STEP
    return MAX_DIFFERENCE_STEP * max(size / speed, MIN_STEP_RATIO)  # (size is 0 if q is 0)


@merged
def _difference_side(w, t, e):
    """Return where to take differences: 0 (around t) or, if C_t or b jumps near t, 1 (after t) or -1 (before t)."""
    since_jump, until_jump = t - w.last_jump, w.next_jump - t
    if min(since_jump, until_jump) >= 2.0 * e:
        return 0.0
    return 1.0 if until_jump >= since_jump else -1.0


@compiled
def _fill_gamma(f, w, t, q, v, e, first, last):
    """Store Gamma[first:last] in w.Gamma, extrapolated from differences with the time steps e and 2 e.

    Return the largest |Gamma_i|, the largest |difference| between Gamma_i with e and with 2 e, and the largest
    |G_ij v_j| (G: constraint Jacobian). If Gamma is not finite, the first two results are NaN.
    """
    Gamma_coarse = w.Gamma_tried[0]
    side = _difference_side(w, t, e)
    one_sided_step = representable_step(t, ONE_SIDED_STEP_RATIO * e)
    if side != 0.0 and one_sided_step > 0.0:
        e = one_sided_step
    largest_term = 0.0
    for i in range(first, last):
        w.Gamma[i] = 0.0
        Gamma_coarse[i] = 0.0
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
                largest_term = max(largest_term, abs(w.Gx[i, j] * v[j]))
            if side != 0.0:
                w.Gamma[i] -= ONE_SIDED_WEIGHTS[k] * w.g[i] / (side * e)
                Gamma_coarse[i] -= ONE_SIDED_WEIGHTS_COARSE[k] * w.g[i] / (side * e)
            elif k == 0 or k == 3:
                Gamma_coarse[i] -= w.g[i] / (2.0 * shift)
            else:
                w.Gamma[i] -= w.g[i] / (2.0 * shift)
    largest = 0.0
    disagreement = 0.0
    for i in range(first, last):
        disagreement = max(disagreement, abs(w.Gamma[i] - Gamma_coarse[i]))
        w.Gamma[i] = (4.0 * w.Gamma[i] - Gamma_coarse[i]) / 3.0
        largest = max(largest, abs(w.Gamma[i]))
        if not np.isfinite(w.Gamma[i]):
            return np.nan, np.nan, largest_term
    return largest, disagreement, largest_term


@merged
def _max_disagreement(w):
    """Return the largest allowed |Gamma for the time step e - Gamma for 2 e|; the error of Gamma is smaller."""
    return max(w.gamma_required, ROUNDING_DISAGREEMENT) * w.gamma_scale


@compiled
def _choose_difference_step(f, w, t, q, v, largest_step, first, last):
    """Store Gamma[first:last] in w.Gamma, by differences with the best of several time steps e.

    Beginning with `largest_step`, divide e by 4 until the change of Gamma is small (CONVERGED_CHANGE). The best e is
    the one with the least change. Store its ratio to `largest_step` in w.gamma_step_ratio. Return GAMMA_INACCURATE if
    even the least change exceeds the allowed error, else DONE.
    """
    least_change = np.inf
    step_ratio = 1.0
    for level in range(N_DIFFERENCE_STEPS):
        e = representable_step(t, step_ratio * largest_step)
        if e <= 0.0:
            break
        copy(w.Gamma, w.Gamma_tried[1])
        largest, disagreement, _ = _fill_gamma(f, w, t, q, v, e, first, last)
        if np.isnan(largest):
            return DONE
        w.gamma_scale = max(w.gamma_scale, largest)
        change = 0.0
        for i in range(first, last):
            change = max(change, abs(w.Gamma[i] - w.Gamma_tried[1, i]))
        if level > 0 and change < least_change and disagreement <= _max_disagreement(w):
            least_change = change
            w.gamma_step_ratio = step_ratio
            if change <= CONVERGED_CHANGE * w.gamma_required * w.gamma_scale:
                break
        step_ratio *= 0.25
    w.gamma_accuracy = least_change / w.gamma_scale
    _fill_gamma(f, w, t, q, v, representable_step(t, w.gamma_step_ratio * largest_step), first, last)
    return DONE if w.gamma_accuracy <= w.gamma_required else GAMMA_INACCURATE


@compiled
def gamma_by_differences(f, w, t, q, v, first, last):
    """Store Gamma[first:last] in w.Gamma, by differences; return DONE, or GAMMA_INACCURATE if no time step is accurate.

    Gamma = -d/de [G v + (C_t, b)](t + e, q + e v) at e = 0, where v is constant. Errors are relative to w.gamma_scale,
    the largest size of Gamma so far. The time step e is w.gamma_step_ratio times `largest_difference_step`. If Gamma
    with e and Gamma with 2 e differ too much, as with kilohertz drives, a new ratio is chosen.
    """
    largest_step = largest_difference_step(q, v)
    e = representable_step(t, w.gamma_step_ratio * largest_step)
    if e > 0.0:
        largest, disagreement, terms = _fill_gamma(f, w, t, q, v, e, first, last)
        if np.isnan(largest) or disagreement == 0.0 or w.gamma_scale == 0.0:
            return DONE  # accept NaN (the caller reports it), a zero error, and any error before w.gamma_scale is known
        rounding = ROUNDING_OF_TERMS * terms / largest_step
        w.gamma_scale = max(w.gamma_scale, largest, rounding / w.gamma_required)
        if disagreement < NEGLIGIBLE_DISAGREEMENT * w.gamma_scale:
            w.gamma_step_ratio = min(1.0, 2.0 * w.gamma_step_ratio)
        if disagreement <= _max_disagreement(w):
            return DONE
    return _choose_difference_step(f, w, t, q, v, largest_step, first, last)

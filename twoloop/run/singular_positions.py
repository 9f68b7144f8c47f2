"""Describe singular positions: where steps crossed them, and how uncertain the motion is near them.

"Rows" are the rows of the constraint Jacobian: C_q, then A of the non-holonomic constraints A v + b = 0. Let s be the
smallest singular value of this matrix, and d its right singular vector. If constraints have rounding errors eps,
q along d has errors of about eps / s. These change the rows, so that velocities along d have errors of about eps / s^2.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.scales import signs
from twoloop.checks.structure import certainly_exceed
from twoloop.kernels.data.indices import REPORTED_ERROR
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]
TimedState = tuple[float, Array]  # time and state [q, v, ...]
# for each singular position that steps crossed: the state before and, if the crossing was completed, the state after it
Crossings = list[list[TimedState]]
Ratio = Callable[[ConstrainedSystem, float, Array, int], float]

# messages say that constraints lose rank if (smallest / largest singular value) of the Jacobian is below this
LOST_RANK_RATIO = 1e-2
N_POSITIONS = 33  # the least singular value between two states is searched for at this number of positions
MAX_SHOWN = 3  # largest number of singular positions in a message
# displacement of q in finite differences of constraint equations and their Jacobian, relative to the largest coordinate
DISPLACEMENT = 1e-6
# each row of the Jacobian is divided by its norm. But if a row is small only at this position, it is divided by
# MIN_ROW_NORM times the norm that the row has nearby (estimated from the row's derivative)
MIN_ROW_NORM = 0.1
# ERROR_OF_A: assumed error of q, v, a and M a beside a singular position, in rtol. Singular values below NO_ROW times
# the largest are rounding errors. MAX_ROUNDING is 10 eps: if (least / largest singular value) is s, rounding errors are
# about eps / s in q, eps / s^2 in v and eps / s^3 in a, relative to the largest
ERROR_OF_A, NO_ROW, MAX_ROUNDING = 10.0, 1e-10, 10.0 * float(np.finfo(np.float64).eps)
# Newton's method for q ends after a relative change of at most MAX_SQUARED, whose square is a rounding error
MAX_SQUARED, MAX_ITERATIONS = 1e-8, 10
# velocities jumped in a step if their change exceeds both JUMP_RATIO * step size * acceleration and MIN_JUMP tolerances
JUMP_RATIO, MIN_JUMP = 3.0, 10.0


def describe_crossings(system: ConstrainedSystem, crossings: Crossings, end_state: TimedState, rank: int) -> str:
    """Return sentences about the singular positions that steps crossed, for the message of a result.

    `crossings`: for each singular position, the states before and after it. If the run ended within the crossing, its
    last state, `end_state`, counts as the state after it. `rank`: rank of the Jacobian far from singular positions.
    """
    ratios = {
        ends[0][0]: _least_ratio_between(system, ends[0], [*ends, end_state][1], rank) for ends in crossings[:MAX_SHOWN]
    }
    singular = {t: ratio for t, ratio in ratios.items() if ratio < LOST_RANK_RATIO}
    regular = {t: ratio for t, ratio in ratios.items() if ratio >= LOST_RANK_RATIO}
    text = ""
    if singular:
        text += (
            f" Near t = {_format_times(singular)} steps went across positions where the constraints lose rank, or "
            f"nearly so ({_describe_ratio(singular)}): beyond these, errors may exceed the tolerances."
        )
    if regular:
        text += (
            f" Near t = {_format_times(regular)} steps by collocation took the place of shorter ones "
            f"({_describe_ratio(regular)})."
        )
    n_more = len(crossings) - len(ratios)
    return text + (f" There were {n_more} more such places." if n_more > 0 else "")


def singular_ratio(system: ConstrainedSystem, t: float, q: Array, rank: int) -> float:
    """Return (`rank`-th largest / largest singular value) of the constraint Jacobian; 1 if there are no constraints."""
    return _singular_value_ratio(system.rows(t, q), rank)


def unit_free_ratio(system: ConstrainedSystem, t: float, q: Array, rank: int) -> float:
    """Return `singular_ratio` of the scaled Jacobian (see `scaled_to_unit_masses`), which does not depend on units."""
    return _singular_value_ratio(scaled_to_unit_masses(system, t, q)[1], rank)


def _singular_value_ratio(rows: Array, rank: int) -> float:
    """Return (`rank`-th largest / largest singular value) of a matrix; 1 if the matrix has no rows."""
    values = np.linalg.svd(rows, compute_uv=False)[:rank]
    return float(values[-1] / values[0]) if len(values) and values[0] > 0.0 else float(len(values) == 0)


def _least_ratio_between(
    system: ConstrainedSystem, before: TimedState, after: TimedState, rank: int, ratio: Ratio = singular_ratio
) -> float:
    """Return the least `ratio` on the way from one state to another, at N_POSITIONS interpolated positions."""
    n, (t0, first), (t1, last) = system.n_q, before, after
    if t1 == t0:
        return ratio(system, t0, first[:n], rank)
    from scipy.interpolate import CubicHermiteSpline  # imported here: the import takes 0.1 s, and few runs need it

    path = CubicHermiteSpline([t0, t1], [first[:n], last[:n]], [first[n : 2 * n], last[n : 2 * n]])
    return min(ratio(system, float(t), path(t), rank) for t in np.linspace(t0, t1, N_POSITIONS))


def describe_velocity_jump(
    system: ConstrainedSystem, crossings: Crossings, end_state: TimedState, rank: int, rtol: float, atol: Array
) -> str:
    """Return a message about the first singular position where velocities jumped; "" if velocities did not jump.

    A jump is a change larger than accelerations explain. Near a singular position, the tolerances may not distinguish
    the branches of the motion, and steps may have switched to another branch.
    """
    n = system.n_q
    of_q, of_v = slice(n), slice(n, 2 * n)
    for (t0, first), (t1, last), across in _crossing_ends(crossings, end_state):
        largest_q, largest_v = (max(np.abs(first[p]).max(), np.abs(last[p]).max()) for p in (of_q, of_v))
        change = np.abs(last[of_v] - first[of_v])
        least_a = min(np.abs(state[2 * n : 3 * n]).max() for state in (first, last))
        if not (change > np.maximum(MIN_JUMP * (atol + rtol * largest_v), JUMP_RATIO * (t1 - t0) * least_a)).any():
            continue
        threshold = (
            min(LOST_RANK_RATIO, np.sqrt(rtol + float(atol.max()) / largest_q)) if largest_q > 0.0 else LOST_RANK_RATIO
        )
        # ordinary steps may have switched branches between the two states: do not interpolate, use the last state only
        here, there = (t0, first), (t1, last)
        ratio = _least_ratio_between(system, here if across else there, there, rank, unit_free_ratio)
        if ratio >= threshold:
            continue
        largest_a = max(
            _largest_acceleration(system, t, state[of_q], state[of_v], threshold) for t, state in (here, there)
        )
        change[change <= np.maximum(MIN_JUMP * (atol + rtol * largest_v), JUMP_RATIO * (t1 - t0) * largest_a)] = 0.0
        if change.any():
            return (
                f"Not to be trusted beyond t = {t0:.10g}: near it the constraints lose rank "
                f"({_describe_ratio({t0: ratio})}), and velocities changed there by up to {change.max():.1g} within "
                f"{t1 - t0:.1g} s, more than forces and constraints explain: within the tolerances lies another "
                "branch of the motion, onto which the steps may have come. Tighten rtol and atol, take another method, "
                "or end t_span before."
            )
    return ""


def has_velocity_jump_at_end(times: Array, rows: Array, n: int) -> bool:
    """Return True if v jumped in the last step, see JUMP_RATIO; `rows`: states [q, v, a] at `times`; n: size of q."""
    largest = np.maximum.reduce  # faster than array.max(): short runs call this function often
    if times.size < 2:
        return False
    change = largest(np.abs(rows[-1, n : 2 * n] - rows[-2, n : 2 * n]))
    least_a = np.minimum.reduce(largest(np.abs(rows[-2:, 2 * n : 3 * n]), axis=1))
    return bool(change > JUMP_RATIO * (times[-1] - times[-2]) * least_a)


def _crossing_ends(crossings: Crossings, end_state: TimedState) -> Iterator[tuple[TimedState, TimedState, bool]]:
    """Yield, for each singular position, the states before and after it, and whether the crossing was completed."""
    before: TimedState | None = None
    for first, *after in crossings:
        before = first if before is None else before
        if after and after[0][0] > first[0]:
            yield before, after[0], True
            before = None
    if before is not None and end_state[0] > before[0]:
        yield before, end_state, False


def _largest_acceleration(system: ConstrainedSystem, t: float, q: Array, v: Array, min_ratio: float) -> float:
    """Return max|acceleration|; singular values of the Jacobian below `min_ratio` times the largest count as zero."""
    mass, rows, norms, units = scaled_to_unit_masses(system, t, q)
    left, values, right = np.linalg.svd(rows, full_matrices=False)
    is_kept = values > min_ratio * values[0]
    dt = DISPLACEMENT * max(np.abs(q).max(), DISPLACEMENT) / max(np.abs(v).max(), DISPLACEMENT)
    rates = [system.velocity_constraint(t + step, q + step * v, v) / norms for step in (-dt, dt)]
    gamma = (left.T @ (rates[0] - rates[1]))[is_kept] / (2.0 * dt * values[is_kept])
    equations = np.block([[mass, right[is_kept].T], [right[is_kept], np.zeros((int(is_kept.sum()),) * 2)]])
    solution = np.linalg.lstsq(equations, np.append(units * system.force(t, q, v), gamma), rcond=None)[0]
    return float(np.abs(units * solution[: len(q)]).max())


def scaled_to_unit_masses(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array, Array, Array]:
    """Return the scaled M, the scaled constraint Jacobian, the divisors of its rows, and the units of coordinates.

    q_j is scaled as q_j / unit_j with unit_j = 1 / sqrt(M_jj), so that the diagonal entries of M become 1. After
    division by the divisors, rows of the Jacobian have the norm 1, unless they are small only at this position.
    """
    mass, rows = system.mass(t, q), system.rows(t, q)
    inertia = np.abs(np.diagonal(mass))
    units = 1.0 / np.sqrt(np.where(inertia > ROUNDING * inertia.max(), inertia, inertia.max()))
    norms = np.linalg.norm(rows * units, axis=1)
    displacement = DISPLACEMENT * max(np.abs(q).max(), DISPLACEMENT) * units / units.max() * signs(len(q))
    try:
        slopes = np.linalg.norm((system.rows(t, q + displacement) - system.rows(t, q - displacement)) * units, axis=1)
    except (ArithmeticError, ValueError):  # a square root, for example, fails beyond a dead centre
        slopes = np.zeros(len(rows))
    if slopes.max(initial=0.0) > 0.0:  # false if a slope is NaN
        norms = np.maximum(norms, MIN_ROW_NORM * norms.max() * slopes / slopes.max())
    norms[norms == 0.0] = 1.0
    return mass * units * units[:, None], rows * units / norms[:, None], norms, units


def _format_times(ratios: dict[float, float]) -> str:
    return ", ".join(f"{t:.4g}" for t in ratios)


def _describe_ratio(ratios: dict[float, float]) -> str:
    least_ratio = min(ratios.values())
    return f"the smallest singular value of the constraint Jacobian comes down to {least_ratio:.1g} of the largest"


ROUNDING = 0.5 * float(np.finfo(np.float64).eps)
# rounding errors matter only along directions in which the Jacobian's singular value is at most this * the largest one
WEAK_RATIO = 1e-2
# whatever rtol is, rounding errors of velocities are estimated if min / max pivot of the Jacobian is below SMALL_PIVOT.
# This ratio of pivots is typically PIVOT_FACTOR times (smallest / largest singular value)
SMALL_PIVOT, PIVOT_FACTOR = 1e-5, 30.0


def singular_threshold(rtol: float) -> float:
    """Return the limit of (min / max pivot of C_q) below which rounding changes v by more than REPORTED_ERROR * rtol.

    The limit is at least SMALL_PIVOT and at most WEAK_RATIO.
    """
    return min(
        WEAK_RATIO, max(SMALL_PIVOT, PIVOT_FACTOR * float(np.sqrt(ROUNDING / (REPORTED_ERROR * max(rtol, ROUNDING)))))
    )


def state_beside_singularity(
    system: ConstrainedSystem, t: float, state: Array, recorded: Array, lam: Array, rank: int, rtol: float
) -> Array:
    """Complete [q, v, a], from a polynomial across a singular position, to a row [q, v, a, lam] on the constraints.

    Return the row `recorded` of a step if rounding does not explain its difference: then the forces may have changed in
    a time that the polynomial passes over. Rounding errors are large along the singular vectors of the Jacobian with
    the least singular values. There, q and v remain as they are, and multipliers equal those of an earlier state,
    `lam`, unless forces on the constraints along these vectors exceed the errors of `a`.
    """
    q, v, a = state.copy().reshape(3, system.n_q)
    for _ in range(MAX_ITERATIONS):  # Newton's method
        mass, rows, norms, units = scaled_to_unit_masses(system, t, q)
        constraints = np.append(system.constraint(t, q), np.zeros(system.n_a)) / norms
        correction = units * np.linalg.lstsq(rows, constraints, rcond=LOST_RANK_RATIO)[0]
        q -= correction
        if not np.abs(correction).max() > MAX_SQUARED * np.abs(q).max():
            break
    left, values, right = np.linalg.svd(system.rows(t, q) * units / norms[:, None], full_matrices=False)
    is_large = values > LOST_RANK_RATIO * values[0]
    violation = left.T @ (system.velocity_constraint(t, q, v) / norms)
    v -= units * (violation[is_large] / values[is_large] @ right[is_large])
    lam = norms * np.nan_to_num(lam)  # NaN: unknown at a start in a singular position
    force, inertia_force = units * system.force(t, q, v), mass @ (a / units)
    components = right @ (force - inertia_force) - values * (left.T @ lam)
    noise = ERROR_OF_A * rtol * max(np.abs(force).max(), np.abs(inertia_force).max())
    is_known = is_large | ((values > NO_ROW * values[0]) & (np.abs(components) > noise))
    lam = (lam + left[:, is_known] @ (components[is_known] / values[is_known])) / norms
    row, ratio = np.concatenate([q, v, a, lam]), max(values[rank - 1] / values[0], NO_ROW)
    changes, sizes = (np.abs(x[: state.size]).reshape(3, -1) / units for x in (row - recorded, recorded))
    allowed = (ERROR_OF_A * rtol + MAX_ROUNDING / ratio ** np.arange(1, 4)) * sizes.max(axis=1)
    return row if (changes.max(axis=1) <= allowed).all() else recorded


def velocity_rounding_errors(system: ConstrainedSystem, t: float, q: Array, v: Array, rank: int) -> Array:
    """Estimate errors (n_q,) of v due to rounding of q: infinite if rank is lost at q, NaN if callbacks fail near q."""
    rows = system.rows(t, q)
    left, values, right = np.linalg.svd(rows, full_matrices=False)
    errors = np.zeros(len(q))
    for u, value, direction in zip(left.T[:rank], values[:rank], right[:rank], strict=True):
        if value > WEAK_RATIO * values[0]:
            continue
        if value == 0.0:
            return np.full(len(q), np.inf)
        step = DISPLACEMENT * max(np.abs(q).max(), DISPLACEMENT) / np.abs(direction).max()
        displaced = [q + side * step * direction for side in (1.0, -1.0)]
        try:
            slope = np.subtract(*(system.velocity_constraint(t, each, v) for each in displaced)) / (2.0 * step)
            row_slopes = np.abs(np.subtract(*(system.rows(t, each) for each in displaced)))
        except (ArithmeticError, ValueError):  # a square root, for example, fails beyond a dead centre
            return np.full(len(q), np.nan)
        # entries of the Jacobian at q may be small: estimate errors of C, due to rounding of q, with entries near q
        nearby_rows = np.abs(rows) + (row_slopes * (np.abs(rows).max() / row_slopes.max()) if row_slopes.any() else 0.0)
        rounding = ROUNDING * np.sqrt((nearby_rows * nearby_rows) @ (q * q))
        errors = np.maximum(
            errors, np.abs(direction * (u @ slope)) * np.sqrt((u * u) @ (rounding * rounding)) / value**2
        )
    return errors


def describe_singular_start(system: ConstrainedSystem, t: float, q: Array, rank: int, rtol: float, atol: Array) -> str:
    """Return a warning if a singular position may be within tolerances of q, else ""; `rank`: rank of [C_q; A]."""
    if rank == 0 or certainly_exceed(WEAK_RATIO, system.rows(t, q), rank):
        return ""
    ratio = singular_ratio(system, t, q, rank)
    if max(ratio, unit_free_ratio(system, t, q, rank)) > WEAK_RATIO:
        return ""
    allowed = atol + rtol * np.abs(q).max()
    if not (np.abs(_displacement_to_singular_position(system, t, q, rank)) <= allowed).all():
        return ""
    return (
        f"the run begins where the constraints nearly lose rank (the smallest singular value of the constraint "
        f"Jacobian is {ratio:.1g} of the largest), which rtol and atol do not distinguish from a position where they "
        "do: another branch of the motion may begin there, onto which the steps may have come. Tighten rtol and atol, "
        "or start elsewhere"
    )


def _displacement_to_singular_position(system: ConstrainedSystem, t: float, q: Array, rank: int) -> Array:
    """Estimate the displacement (n_q,) from q to the nearest singular position; return NaN or infinity if unknown.

    The result is a Newton step towards a zero of the smallest singular value of the Jacobian. The step's direction is
    the gradient of this value without components along other right singular vectors, which would violate constraints.
    """
    left, values, right = np.linalg.svd(system.rows(t, q))
    u, w, other_directions = left[:, rank - 1], right[rank - 1], right[: rank - 1]
    step, gradient = DISPLACEMENT * max(np.abs(q).max(), DISPLACEMENT), np.zeros(len(q))
    for j, displacement in enumerate(np.eye(len(q)) * step):
        try:
            gradient[j] = u @ (system.rows(t, q + displacement) - system.rows(t, q - displacement)) @ w / (2.0 * step)
        except (ArithmeticError, ValueError):  # a square root, for example, fails beyond a dead centre
            return np.full(len(q), np.nan)
    gradient -= other_directions.T @ (other_directions @ gradient)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-values[rank - 1] * gradient / (gradient @ gradient))

"""Sizes of a mechanism, coordinate by coordinate, and derivatives by differences with estimates of their errors.

Sizes decide which violations of constraints are small, in any unit and with any offset. The offset of a coordinate is
not a size, and millimetres and radians have no size in common. But the Jacobian shows which displacements of two
coordinates change a constraint equally, and how far they must move until the Jacobian changes (a rod's length, a
radian).

To differentiate a function, it is sampled at nine Chebyshev points around a point. If its Chebyshev coefficients decay,
the slope of the interpolant is the derivative, and the last coefficients estimate its error. They remain large in the
presence of rounding, a kink, a step, or an oscillation that the points do not resolve (Trefethen, Approximation Theory
and Approximation Practice, 2013). Several widths of the interval are tried, because scales are not known beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.checks.callbacks import check_callback
from twoloop.checks.sparse_rows import Rows, SparseRows, is_finite
from twoloop.kernels.compile.linking import entry_point

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem

# largest speed of a drive, in sizes of the mechanism per second; if it seems faster, C_q is nearly zero
FASTEST = 1e9
EPS = float(np.finfo(np.float64).eps)
DISPLACEMENTS = (1e-2, 1e-4, 1e-6)  # in units of the coordinates, for the curvature of the constraints
ROUNDS = 3  # number of iterations that find units: the first units may be off by 1e5
MOST_PLACES = 16  # largest number of positions whose sizes are kept
NONE = np.zeros(0)
# a row whose norm is small only at this position changes by much more than its norm over this distance, in units
TURNS = 0.1


@dataclass(frozen=True)
class Scales:
    """Units in which the entries of C_q are of similar size, and the mechanism's size in these units."""

    columns: Array  # (n_q,), units of the coordinates
    rows: Array  # (n_c,), norms of the rows of C_q in these units, or their norms nearby if larger; 1 for zero rows
    reach: Array  # (n_c,), distance in these units over which each constraint keeps its Jacobian

    def scaled(self, jacobian: Array) -> Array:
        """Return C_q in these units, with rows of norm 1; rows that vanish at this position have smaller norms."""
        return jacobian * self.columns / self.rows[:, None]

    def by_coordinate(self, per_row: Array, jacobian: Array) -> Array:
        """Return the smallest value `per_row` of each coordinate's constraints (all, if it has none), in its unit."""
        values = np.where(jacobian != 0.0, per_row[:, None], np.inf).min(axis=0, initial=np.inf)
        return self.columns * np.where(np.isfinite(values), values, per_row.min(initial=np.inf))

    def keep(self, system: ConstrainedSystem, q: Array, jacobian: Array) -> None:
        """Store the reach of the coordinates at a consistent position, with the position and the entries of C_q.

        Rounding is negligible relative to the reach. Later starts near the position, at which C_q has the same entries,
        are checked with this reach, without new scales. Elsewhere the mechanism may be much smaller. The last
        MOST_PLACES positions are stored.
        """
        from twoloop.kernels.evaluation.checks import MAX_RELATIVE_DISTANCE, NO_ENTRY

        n, size = len(q), np.abs(jacobian)
        entries = (size > NO_ENTRY * size.max(axis=1, initial=0.0)[:, None]).ravel()
        known = system.derived.get("sizes", NONE).reshape(-1, 2 * n + entries.size)
        away = (np.abs(known[:, n : 2 * n] - q) > MAX_RELATIVE_DISTANCE * known[:, :n]).any(axis=1)
        others = known[away | (known[:, 2 * n :] != entries).any(axis=1)][: MOST_PLACES - 1]
        system.derived["sizes"] = np.concatenate([self.by_coordinate(self.reach, jacobian), q, entries, others.ravel()])


def sizes(q: Array) -> Array:
    """Return a first guess of the relevant displacement of each coordinate."""
    size, n = np.abs(q), q.size
    ordered = size.copy()
    ordered.sort()
    first = n - np.count_nonzero(size)  # index of the first size that is not zero
    middle = 0.5 * float(ordered[(first + n - 1) // 2] + ordered[(first + n) // 2]) if first < n else 1.0
    return np.maximum(size, 1e-3 * middle)


def typical_sizes(q: Array) -> Array:
    """Return sizes of the coordinates (n_q,), at least the median of sizes that are not negligible; 1 if all are 0."""
    from twoloop.kernels.evaluation.checks import NEGLIGIBLE

    size = np.abs(q)
    return np.maximum(size, median(size[size > NEGLIGIBLE * size.max()]) if size.any() else 1.0)


@cache
def generic_factors(n_q: int) -> Array:
    """Return fixed random factors between 0.5 and 1.5, of either sign, (n_q,)."""
    generic = np.random.default_rng(1)
    return generic.uniform(0.5, 1.5, n_q) * generic.choice((-1.0, 1.0), n_q)


def median(values: Array) -> float:
    """Return the median of finite numbers, without NumPy's checks for other values."""
    ordered = np.sort(values)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def column_scales(jacobian: Rows, typical: Array) -> Array:
    """Return units of the coordinates in which entries of C_q are of similar size; `typical` units for zero columns."""
    from twoloop.kernels.evaluation.checks import column_units

    if isinstance(jacobian, SparseRows):
        return _sparse_column_scales(jacobian, typical)
    n_rows, n = jacobian.shape
    columns, room = np.zeros((2, n))
    entry_point(column_units)(
        np.ascontiguousarray(jacobian), typical, columns, *np.zeros((2, n_rows, n)), np.zeros(n_rows), room
    )
    return columns


def _sparse_column_scales(jacobian: SparseRows, typical: Array) -> Array:
    """Return the units of `column_scales` from the entries alone."""
    size, (m, n) = np.abs(jacobian.values), jacobian.shape
    counts = size > 1e-12 * jacobian.largest()[jacobian.rows]
    i, j, logs = jacobian.rows[counts], jacobian.columns[counts], np.log(size[counts])
    used = np.bincount(j, minlength=n) > 0
    if not used.any():
        return typical
    in_row, in_column = np.maximum(np.bincount(i, minlength=m), 1), np.maximum(np.bincount(j, minlength=n), 1)
    columns = np.zeros(n)
    for _ in range(20):
        rows = np.bincount(i, logs + columns[j], m) / in_row
        columns = np.bincount(j, rows[i] - logs, n) / in_column
    columns = np.exp(columns + median(np.log(typical[used]) - columns[used]))
    return np.where(used, columns, typical)


def scales_of(system: ConstrainedSystem, t: float, q: Array, jacobian: Array) -> Scales:
    """Return the scales at a position, from C_q (and A, if `jacobian` has both) at this position and nearby."""
    from twoloop.kernels.evaluation.checks import NEGLIGIBLE, linear_ranges

    size, columns = np.abs(q), units(system, t, q, jacobian, typical_sizes(q))
    in_units = np.abs(jacobian) * columns
    norms, curvature = np.sqrt((in_units * in_units).sum(axis=1)), _curvature(system, t, q, columns, len(jacobian))
    rows = np.maximum(norms, TURNS * curvature)
    rows[rows == 0.0] = 1.0
    lengths = np.where(norms > 0.0, norms, 1.0)
    radius = lengths / np.maximum(curvature, 1e-300 * np.maximum(lengths, 1.0))
    in_units = np.ascontiguousarray((jacobian != 0.0) * (size / columns))
    reach, negligible = np.ones(len(rows)), NEGLIGIBLE * float(in_units.max(initial=0.0))
    entry_point(linear_ranges)(in_units, radius, negligible, np.zeros(len(q)), reach)
    return Scales(columns, rows, reach)


def units(system: ConstrainedSystem, t: float, q: Array, jacobian: Rows, typical: Array) -> Array:
    """Return units of the coordinates in which entries of C_q (and A) are of similar size, at q or one unit away.

    An entry that is small only at q, for example because a bar is almost upright, does not determine units.
    """
    columns, shifts = column_scales(jacobian, typical), np.outer([1.0, -1.0], generic_factors(len(q)))
    for _ in range(ROUNDS):  # a fixed number, so that rounding does not change the number of rounds
        estimated = column_scales(_largest(system, t, q + columns * shifts, jacobian), typical)
        # an entry that grows with its coordinate has half the unit at twice the displacement
        columns = np.cbrt(columns * estimated * estimated)
    return columns


def _largest(system: ConstrainedSystem, t: float, places: Array, here: Rows) -> Rows:
    """Return the largest magnitude of each entry at one position (`here`) and at `places` within the domain."""
    if not isinstance(here, SparseRows):
        beside = rows_at(system, t, places)[0][:, : len(here)]
        return np.maximum(abs(here), abs(np.where(np.isfinite(beside), beside, 0.0)).max(axis=0))
    largest = abs(here.values)
    for place in places:
        try:
            rows = system.sparse_rows(t, place)
        except Exception:  # outside the domain of the callbacks
            continue
        if isinstance(rows, SparseRows) and is_finite(rows):
            largest = np.maximum(largest, abs(rows.values))
    return here.with_values(largest)


def rows_at(system: ConstrainedSystem, t: float, places: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return C_q and A at positions, (n, n_c + n_a, n_q), and a mask (n,) of positions at which no callback raised."""
    from twoloop.kernels.evaluation import checks as start_checks

    check_callback(system, "jacobian", t, [places[0]])
    n, kit, defined = len(places), system.kit, np.ones(len(places), dtype=bool)
    rows = np.zeros((n, system.n_c + system.n_a, system.n_q))
    evaluate = entry_point(start_checks.rows_at_positions)
    try:
        evaluate(kit, t, places, system.n_c, rows.reshape(-1, system.n_q))
    except Exception:  # a position failed: evaluate one by one
        rows[:] = 0.0
        for k in range(n):
            try:
                evaluate(kit, t, places[k : k + 1], system.n_c, rows[k])
            except Exception:  # outside the domain of the callbacks
                defined[k] = False
    return rows, defined


@cache
def signs(n_q: int) -> Array:
    """Return fixed random signs of the displacements of the coordinates, (n_q,)."""
    return np.random.default_rng(3).choice((-1.0, 1.0), n_q)


def _curvature(system: ConstrainedSystem, t: float, q: Array, columns: Array, n_rows: int) -> Array:
    """Return the rate of change of each row of C_q per unit of the coordinates; one correct digit is enough."""
    way = columns * signs(len(q))
    largest = np.zeros(n_rows)
    shifts = np.array([side * part for part in DISPLACEMENTS for side in (1.0, -1.0)])
    rows, defined = rows_at(system, t, q + shifts[:, None] * way)
    rows = rows[:, :n_rows]
    for k, part in enumerate(DISPLACEMENTS):
        first, second = rows[2 * k : 2 * k + 2]
        change = np.sqrt((((first - second) * columns) ** 2).sum(axis=1)) / (2.0 * part)
        noise = EPS * (np.abs(first) @ (columns + np.abs(q))) / part
        if defined[2 * k : 2 * k + 2].all() and np.isfinite(change).all():
            largest = np.maximum(largest, np.where(change > noise, change, 0.0))
    return largest


def generic_velocities(system: ConstrainedSystem, t: float, q: Array, jacobian: Rows, rate: Array) -> list[Array]:
    """Return velocities in which no coordinate is negligible; if C_t is not zero, the last are as fast as the drive."""
    size = sizes(q)
    v = units(system, t, q, jacobian, size) * generic_factors(len(q))
    v = v / median(np.abs(v) / size)
    driven, moved = rate != 0.0, abs(jacobian) @ np.abs(v)
    if not (driven & (moved > 0.0)).any():
        return [v]
    faster = float(np.median(np.abs(rate[driven & (moved > 0.0)]) / moved[driven & (moved > 0.0)]))
    return [v, min(faster, FASTEST) * v]


Function = Callable[[float], Array]

DEGREE = 8
TAIL = 5  # index of the first coefficient that must have decayed
NODES = np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
SLOPES: dict[int, Array] = {  # slopes of the polynomials at the point, by the side on which the interval lies
    side: np.asarray(chebyshev.chebval(-float(side), chebyshev.chebder(np.eye(DEGREE + 1)))) for side in (0, 1, -1)
}
FIRST = 2.0**-5  # first half-width, relative to the scale
RATIO = 16.0  # ratio of successive half-widths
N_SMALLER, N_LARGER = 11, 8  # numbers of smaller and larger half-widths that are tried
# intervals that must confirm that an entry is wrong: ratio of successive half-widths, numbers wider and narrower
CONFIRM_RATIO, N_WIDER, N_NARROWER = 4.0, 8, 24
BESIDE = (0.55, 1.8, 3.1)  # half-widths that confirm an estimate first, relative to its own
RIPPLES = 3  # number of narrower intervals after which a smooth function shows only rounding
LEAST_SPACINGS = 256.0  # smallest half-width, in spacings of floating-point numbers at the point
SETTLED = 2e-7  # no further half-width is tried if difference and estimated error are below this fraction of the entry
AGREEMENT = 3e-7  # an entry is not wrong if the difference is below this fraction of it
DECAYED = 0.01  # the points resolve a function if its last coefficients are at most this fraction of the first
# a function has a ripple if its last two coefficients exceed this multiple of the previous ones and rounding errors
RIPPLE = 0.2
CONSTANT = 100.0  # a function counts as constant if it varies by less than this number of rounding errors
SAFETY = 5.0  # ratio of the allowed difference to the estimated error of the difference
# largest ratio, in rounding errors of the result, by which terms within a function may exceed its result
FROZEN = 1e4
FLAT = 3  # number of intervals of different widths on which a function must be constant for the derivative 0
TINY = 1e-12  # an entry counts as zero if it is below this fraction of the largest entry


@dataclass(frozen=True)
class Estimate:
    """Estimates of the derivatives (m,) of the entries of a function by one number, and of their errors."""

    slope: Array
    error: Array
    width: Array  # half-width of the interval of each estimate; infinite: no interval gave one
    side: int  # side of the interval, see `differentiate`

    def disagrees(self, given: Array, rounding: Array) -> Array:
        """Return the ratio of |given - slope| to its limit, (m,); given values with a ratio above 1 are wrong."""
        allowed = SAFETY * self.error + AGREEMENT * np.abs(given) + SAFETY * rounding
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.abs(given - self.slope) / allowed
        return np.where(np.isfinite(self.error) & (given != self.slope), ratio, 0.0)


@dataclass(frozen=True)
class _Window:
    slope: Array
    error: Array
    flat: NDArray[np.bool_]
    nothing: NDArray[np.bool_]  # varies by no more than rounding
    ripple: Array  # largest of the last coefficients if they are too large for rounding, else 0


def _window(function: Function, place: float, width: float, side: int, noise: Array) -> _Window | None:
    """Compute slopes on an interval around a point (side 0), after it (1) or before it (-1); None: undefined."""
    shifts = width * (NODES + side) / (2.0 if side else 1.0)
    shifts = (place + shifts) - place  # shifts as rounded by floating-point addition to the place
    try:
        with np.errstate(all="ignore"):
            values = np.array([function(float(shift)) for shift in shifts])
    except Exception:  # outside the domain of the function, which does not raise at the place itself
        return None
    if not np.isfinite(values).all():
        return None
    half = width / 2.0 if side else width
    basis = chebyshev.chebvander(shifts / half - side, DEGREE)
    middle = values[DEGREE if side > 0 else 0 if side < 0 else DEGREE // 2]
    with np.errstate(over="ignore", invalid="ignore"):
        coefficients = np.linalg.solve(basis, values - middle)
        weights = SLOPES[side] / half
        slope = weights @ coefficients
        growth = 2.0 * np.abs(weights[TAIL:]).max() if side else 16.0 / half
        tail = np.abs(coefficients[TAIL:]).max(axis=0)
        head = np.abs(coefficients[1:TAIL]).max(axis=0)
        level = noise + EPS * np.abs(values).max(axis=0)
        error = growth * tail + (2.0 if side else 1.0) * growth * level
    if not np.isfinite(error).all():
        return None
    last = np.abs(coefficients[TAIL + 2 :]).max(axis=0)
    still = tail <= CONSTANT * level
    resolved = ((tail <= DECAYED * head) & (still | (last <= RIPPLE * tail))) | (still & (head <= CONSTANT * level))
    ripple = np.where(tail > FROZEN * level, tail, 0.0)
    nothing = np.maximum(head, tail) <= CONSTANT * level
    return _Window(slope, np.where(resolved, error, np.inf), np.ptp(values, axis=0) == 0.0, nothing, ripple)


def _widths(scale: float, spacing: float) -> Iterator[float]:
    """Yield the half-widths to try: first a fraction of the scale, then smaller and larger ones alternately."""
    least = LEAST_SPACINGS * spacing
    first = max(FIRST * scale, least)
    yield first
    for k in range(1, max(N_SMALLER, N_LARGER) + 1):
        if k <= N_SMALLER and first / RATIO**k >= least:
            yield first / RATIO**k
        if k <= N_LARGER:
            yield first * RATIO**k


def differentiate(
    function: Function,
    place: float,
    scale: float,
    noise: Array,
    given: Array,
    largest: Array,
    *,
    spacing: float = 0.0,
    sides: tuple[int, ...] = (0,),
    max_widths: int = N_SMALLER + N_LARGER + 1,
) -> Estimate:
    """Differentiate a function at a point until each entry is accurate enough to judge the given entry.

    Each entry gets the estimate of the half-width with the smallest estimated error; at most `max_widths` are tried.
    Where the function raises an exception, or its value is not finite, it counts as undefined.

    - `scale`: a first guess of the distance over which the function changes
    - `noise`: effect of rounding of the arguments on the function
    - `given`, `largest`: the given entries to check, and for each the largest of the entries to which it is compared
    - `spacing`: smallest displacement that rounding does not hide, if larger than the spacing of numbers at the point
    - `sides`: 0 around the point, 1 after it, -1 before it, in the order in which they are tried until one is defined
    """
    m = len(given)
    for side in sides:
        slope, error, width = np.zeros(m), np.full(m, np.inf), np.full(m, np.inf)
        flat_error, flat_width, moved = np.full(m, np.inf), np.full(m, np.inf), np.zeros(m, dtype=bool)
        tried = 0
        for number, h in enumerate(_widths(scale, max(spacing, float(np.spacing(abs(place)))))):
            if number >= max_widths:
                break
            estimate = _window(function, place, h, side, noise)
            if estimate is None:
                continue
            # on a narrow interval, terms of a function may be constant by rounding while the others look smooth
            with np.errstate(invalid="ignore"):
                agrees = ~(np.abs(estimate.slope - slope) > SAFETY * (estimate.error + error))
            too_wide = estimate.nothing & (h > RATIO * FIRST * scale)
            better = ~estimate.flat & (estimate.error < error) & agrees & ~too_wide
            slope[better], error[better], width[better] = estimate.slope[better], estimate.error[better], h
            better = estimate.flat & (FROZEN * estimate.error < flat_error)
            flat_error[better], flat_width[better] = FROZEN * estimate.error[better], h
            # a narrow interval without change, inside a wider one with change, shows only rounding or a dead zone
            moved |= ~estimate.flat
            best = Estimate(
                np.where(moved, slope, 0.0),
                np.where(moved, error, flat_error),
                np.where(moved, width, flat_width),
                side,
            )
            tried += 1
            still = ~moved & (given == 0.0) & (tried >= FLAT)
            difference = np.abs(given - best.slope)
            confirmed = difference + best.error <= SETTLED * np.maximum(np.abs(given), np.abs(best.slope))
            zero = (np.abs(given) <= TINY * largest) & (difference <= 4.0 * best.error)
            if (confirmed | (zero & (best.error <= SETTLED * largest)) | still).all():
                return best
        if tried:  # the function is defined on this side; intervals on another side would hide a kink at the place
            return best
    return Estimate(np.zeros(m), np.full(m, np.inf), np.full(m, np.inf), 0)


def confirms(
    function: Function, place: float, entry: int, best: Estimate, given: float, noise: Array, spacing: float = 0.0
) -> bool:
    """Return whether other intervals, wider and narrower, also show that the value `given` for an entry is wrong.

    One disagreement may be an accident, and a small fast part of a function (a fine ripple on a long slope) appears on
    narrow intervals only. If an interval gives another derivative, the entry counts as correct.
    """
    width = float(best.width[entry])
    for part in BESIDE:
        estimate = _window(function, place, part * width, best.side, noise)
        if estimate is not None and np.isfinite(estimate.error[entry]):
            break
    else:
        return False
    apart = abs(given - float(estimate.slope[entry]))
    if apart <= 0.6 * SAFETY * estimate.error[entry] or abs(estimate.slope[entry] - best.slope[entry]) >= 0.5 * apart:
        return False
    least = LEAST_SPACINGS * max(spacing, float(np.spacing(abs(place))))
    for k in (*range(-N_WIDER, 0), *range(1, N_NARROWER)):
        if width / CONFIRM_RATIO**k < least:
            break
        estimate = _window(function, place, width / CONFIRM_RATIO**k, best.side, noise)
        if estimate is None or estimate.flat[entry]:
            continue
        if abs(estimate.slope[entry] - best.slope[entry]) > SAFETY * (estimate.error[entry] + best.error[entry]):
            return False
        # `ripple` is not an effect of the ends of the interval: a ripple may hide a steep slope
        if k > RIPPLES and estimate.ripple[entry] > 0.0:
            return False
    return True


def defined(function: Callable[[], Array]) -> Array | None:
    """Return the value of a callback at a displaced state; None if it raises or is not finite, outside its domain."""
    try:
        value = function()
    except Exception:
        return None
    return value if np.isfinite(value).all() else None


def format_difference(first: float, second: float) -> tuple[str, str]:
    """Format two numbers up to the third digit of their difference; further digits are rounding, or irrelevant."""
    if not 0.0 < abs(first - second) < np.inf:
        return f"{first:.3g}", f"{second:.3g}"
    places = 2 - math.floor(math.log10(abs(first - second)))
    return f"{round(first, places) + 0.0:.16g}", f"{round(second, places) + 0.0:.16g}"

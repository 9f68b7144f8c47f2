"""Derivatives by differences, entry by entry, each with an estimate of its own error.

A function is sampled at nine Chebyshev points around a place. If its expansion in Chebyshev polynomials decays before
it ends, the slope of the interpolant is the derivative, and the last coefficients estimate its error: rounding, a kink,
a step, and an oscillation that the points do not resolve all leave them large (Trefethen, Approximation Theory and
Approximation Practice, 2013). Several widths of the interval are tried, because scales are not known beforehand.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from twoloop.checks.arguments import Array

Function = Callable[[float], Array]

EPS = float(np.finfo(np.float64).eps)
DEGREE = 8
TAIL = 5  # index of the first coefficient that must have decayed
NODES = np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
SLOPES: dict[int, Array] = {  # slopes of the polynomials at the place, by the side on which the interval lies
    side: np.asarray(chebyshev.chebval(-float(side), chebyshev.chebder(np.eye(DEGREE + 1)))) for side in (0, 1, -1)
}
FIRST = 2.0**-5  # first half-width, relative to the scale
RATIO = 16.0  # ratio of successive half-widths
SMALLER, LARGER = 11, 8  # numbers of smaller and larger half-widths that are tried
# ratio, and numbers of wider and narrower intervals that must confirm that an entry is wrong
FINER, WIDER, CLOSER = 4.0, 8, 24
BESIDE = (0.55, 1.8, 3.1)  # half-widths that confirm an estimate first, relative to its own
RIPPLES = 3  # number of narrower intervals after which a smooth function shows only rounding
LEAST_SPACINGS = 256.0  # smallest half-width, in spacings of floating-point numbers at the place
# relative to an entry: at this agreement, error of the difference included, no other half-width is tried
SETTLED = 2e-7
AGREEMENT = 3e-7  # relative to an entry: a smaller difference is no error
DECAYED = 0.01  # largest ratio of the last coefficients to the first, for a function that the points resolve
# largest ratio of the last two coefficients to those before, if these are not rounding: above, they are a ripple
DECAYING = 0.2
NOTHING = 100.0  # in rounding errors: a function that varies by less counts as constant
SAFETY = 5.0  # multiple of the estimated error of the difference that is allowed
# in rounding errors of the result: terms inside a function may be larger than its result, but hardly by more than this
FROZEN = 1e4
FLAT = 3  # number of intervals of different widths on which a constant function must be constant for the derivative 0
TINY = 1e-12  # relative to the largest entry: a smaller entry counts as zero


@dataclass(frozen=True)
class Estimate:
    """Estimates of the derivatives (m,) of the entries of a function by one number, and of their errors."""

    slope: Array
    error: Array
    width: Array  # half-width that gave each estimate; infinite: none did
    side: int  # side of the interval, see `differentiate`

    def disagrees(self, given: Array, rounding: Array) -> Array:
        """Return |given - slope| over its limit, (m,); above 1 the given value is wrong."""
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
    """Compute slopes on an interval around the place (side 0), after it (1) or before it (-1); None: undefined."""
    shifts = width * (NODES + side) / (2.0 if side else 1.0)
    shifts = (place + shifts) - place  # shifts as rounded by floating-point addition to the place
    try:
        with np.errstate(all="ignore"):
            values = np.array([function(float(shift)) for shift in shifts])
    except Exception:  # outside the domain of the function: at the place itself it has been called before
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
    still = tail <= NOTHING * level
    resolved = ((tail <= DECAYED * head) & (still | (last <= DECAYING * tail))) | (still & (head <= NOTHING * level))
    ripple = np.where(tail > FROZEN * level, tail, 0.0)
    nothing = np.maximum(head, tail) <= NOTHING * level
    return _Window(slope, np.where(resolved, error, np.inf), np.ptp(values, axis=0) == 0.0, nothing, ripple)


def _widths(scale: float, spacing: float) -> Iterator[float]:
    """Yield the half-widths to try: first a fraction of the scale, then smaller and larger ones in turn."""
    least = LEAST_SPACINGS * spacing
    first = max(FIRST * scale, least)
    yield first
    for k in range(1, max(SMALLER, LARGER) + 1):
        if k <= SMALLER and first / RATIO**k >= least:
            yield first / RATIO**k
        if k <= LARGER:
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
    max_widths: int = SMALLER + LARGER + 1,
) -> Estimate:
    """Differentiate at a place until each entry is known well enough to judge the given one.

    Parameters
    ----------
    function : callable
        function(shift) -> (m,), at place + shift; an exception or a value that is not finite means undefined there.
    place, scale : float
        The place, and a first guess of the distance over which the function changes.
    noise : ndarray (m,)
        Effect of rounding of the arguments on the function.
    given, largest : ndarray (m,)
        The given entries to check, and the largest entry beside each.
    spacing : float
        Smallest displacement that rounding does not hide, if larger than the spacing of numbers at the place.
    sides : tuple of int
        0: around the place; 1: after it; -1: before it. The next side is tried if the function is undefined on this
        one.
    max_widths : int
        Largest number of half-widths to try.

    Returns
    -------
    Estimate
        For each entry, the estimate of the half-width with the smallest estimated error.
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
            # on a narrow interval, terms of a function may be constant by rounding while the rest looks smooth
            with np.errstate(invalid="ignore"):
                agrees = ~(np.abs(estimate.slope - slope) > SAFETY * (estimate.error + error))
            too_wide = estimate.nothing & (h > RATIO * FIRST * scale)
            better = ~estimate.flat & (estimate.error < error) & agrees & ~too_wide
            slope[better], error[better], width[better] = estimate.slope[better], estimate.error[better], h
            better = estimate.flat & (FROZEN * estimate.error < flat_error)
            flat_error[better], flat_width[better] = FROZEN * estimate.error[better], h
            # if a wider interval changes an entry, a narrower one without change showed only rounding, or a dead zone
            moved |= ~estimate.flat
            best = Estimate(
                np.where(moved, slope, 0.0),
                np.where(moved, error, flat_error),
                np.where(moved, width, flat_width),
                side,
            )
            tried += 1
            still = ~moved & (given == 0.0) & (tried >= FLAT)
            if (_settled(best, given, largest) | still).all():
                return best
        if tried:  # a kink at the place would not show on other sides
            return best
    return Estimate(np.zeros(m), np.full(m, np.inf), np.full(m, np.inf), 0)


def _settled(best: Estimate, given: Array, largest: Array) -> NDArray[np.bool_]:
    apart = np.abs(given - best.slope)
    confirmed = apart + best.error <= SETTLED * np.maximum(np.abs(given), np.abs(best.slope))
    zero = (np.abs(given) <= TINY * largest) & (apart <= 4.0 * best.error) & (best.error <= SETTLED * largest)
    return confirmed | zero


def confirms(
    function: Function, place: float, entry: int, best: Estimate, given: float, noise: Array, spacing: float = 0.0
) -> bool:
    """Return whether other intervals, wider and narrower, also find that this entry differs from the given one.

    One disagreement may be an accident, and a function with a small fast part (a fine ripple on a long slope) shows it
    on narrow intervals only. If an interval finds another derivative, nothing is certain.
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
    for k in (*range(-WIDER, 0), *range(1, CLOSER)):
        if width / FINER**k < least:
            break
        estimate = _window(function, place, width / FINER**k, best.side, noise)
        if estimate is None or estimate.flat[entry]:
            continue
        if abs(estimate.slope[entry] - best.slope[entry]) > SAFETY * (estimate.error[entry] + best.error[entry]):
            return False
        # not caused by the ends of the interval: a ripple may hide a steep slope
        if k > RIPPLES and estimate.ripple[entry] > 0.0:
            return False
    return True


def defined(function: Callable[[], Array]) -> Array | None:
    """Return the value of a callback away from the state; None if it raises or is not finite: outside its domain."""
    try:
        value = function()
    except Exception:
        return None
    return value if np.isfinite(value).all() else None


def as_far_as_they_differ(one: float, other: float) -> tuple[str, str]:
    """Format two numbers to the third digit of their difference; further digits are rounding, or of no interest."""
    if not 0.0 < abs(one - other) < np.inf:
        return f"{one:.3g}", f"{other:.3g}"
    places = 2 - math.floor(math.log10(abs(one - other)))
    return f"{round(one, places) + 0.0:.16g}", f"{round(other, places) + 0.0:.16g}"

"""Derivatives by differences, entry by entry, each with an estimate of its own error.

A function is sampled at nine Chebyshev points around a place. Where its expansion in Chebyshev polynomials has decayed
before it ends, the slope of the interpolant is the derivative, and the last coefficients say how good it is: rounding,
a kink, a step and an oscillation that the points do not resolve all leave them large (Trefethen, Approximation Theory
and Approximation Practice, 2013). The width of the interval is looked for, because scales are not known beforehand.
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
TAIL = 5  # coefficients from this one on have to have decayed
NODES = np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
SLOPES: dict[int, Array] = {  # of the polynomials at the place, by the side that the interval lies on
    side: np.asarray(chebyshev.chebval(-float(side), chebyshev.chebder(np.eye(DEGREE + 1)))) for side in (0, 1, -1)
}
FIRST = 2.0**-5  # the first half-width, of the scale
RATIO = 16.0  # of one half-width to the next
SMALLER, LARGER = 11, 8  # half-widths that are tried on either side
FINER, WIDER, CLOSER = 4.0, 8, 24  # ratio and numbers of the intervals that have to confirm that an entry is wrong
BESIDE = (0.55, 1.8, 3.1)  # of the half-width of an estimate: those that may confirm it first
RIPPLES = 3  # narrower intervals after which a smooth function shows rounding only
LEAST_SPACINGS = 256.0  # half-width, in spacings of floating-point numbers at the place
SETTLED = 2e-7  # of an entry: agreement, with the error of the difference, at which no other half-width is tried
AGREEMENT = 3e-7  # of an entry: less is not an error
DECAYED = 0.01  # of the first coefficients: the last of a function that the points resolve are no more
DECAYING = 0.2  # the last two of them to those before, where these are not rounding: else they are a ripple
NOTHING = 100.0  # times rounding: a function that varies by no more does not vary
SAFETY = 5.0  # times the estimated error of the difference
FROZEN = 1e4  # times rounding of what is seen: a function may add larger numbers inside, but hardly so much larger
FLAT = 3  # intervals, of different widths, on which a function that does not vary has the derivative 0
TINY = 1e-12  # of the largest entry: such an entry counts as zero


@dataclass(frozen=True)
class Estimate:
    """Derivatives (m,) of the entries of a function by one number, and how far to trust them."""

    slope: Array
    error: Array
    width: Array  # half-width with which each was found; infinite: none was
    side: int  # as in `differentiate`

    def disagrees(self, given: Array, rounding: Array) -> Array:
        """How often |given - slope| holds what may be between them, (m,); above 1 the value given is wrong."""
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
    ripple: Array  # the last coefficients, where rounding cannot be the reason


def _window(function: Function, place: float, width: float, side: int, noise: Array) -> _Window | None:
    """Slopes by one interval around the place (side 0), after it (1) or before it (-1); None: not defined on it."""
    shifts = width * (NODES + side) / (2.0 if side else 1.0)
    shifts = (place + shifts) - place  # what floating-point numbers can do there
    try:
        with np.errstate(all="ignore"):
            values = np.array([function(float(shift)) for shift in shifts])
    except Exception:  # outside what the function is made for: at the place itself it has been called before
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
    """Half-widths to try, from a fraction of the scale, smaller and larger in turn."""
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
    most: int = SMALLER + LARGER + 1,
) -> Estimate:
    """Differentiate at a place until each entry is known well enough to judge the one given.

    Parameters
    ----------
    function : callable
        function(shift) -> (m,), at place + shift; an exception or a value that is not finite says: not defined there.
    place, scale : float
        Where, and a first guess at how far the function extends.
    noise : ndarray (m,)
        What rounding of the arguments does to the function.
    given, largest : ndarray (m,)
        The entries to judge, and the largest entry beside each.
    spacing : float
        Least displacement that rounding lets through, where that is not the spacing of numbers at the place.
    sides : tuple of int
        0: around the place; 1: after it; -1: before it. The next is tried where the function is not defined.
    most : int
        Half-widths that are tried at most.

    Returns
    -------
    Estimate
        Of the half-width with the least estimated error, entry by entry.
    """
    m = len(given)
    for side in sides:
        slope, error, width = np.zeros(m), np.full(m, np.inf), np.full(m, np.inf)
        flat_error, flat_width, moved = np.full(m, np.inf), np.full(m, np.inf), np.zeros(m, dtype=bool)
        tried = 0
        for number, h in enumerate(_widths(scale, max(spacing, float(np.spacing(abs(place)))))):
            if number >= most:
                break
            found = _window(function, place, h, side, noise)
            if found is None:
                continue
            # on a narrow interval parts of a function may stand still by rounding and the rest look smooth
            with np.errstate(invalid="ignore"):
                agrees = ~(np.abs(found.slope - slope) > SAFETY * (found.error + error))
            better = ~found.flat & (found.error < error) & agrees & ~(found.nothing & (h > RATIO * FIRST * scale))
            slope[better], error[better], width[better] = found.slope[better], found.error[better], h
            better = found.flat & (FROZEN * found.error < flat_error)
            flat_error[better], flat_width[better] = FROZEN * found.error[better], h
            # where a wider interval moves an entry, one on which it does not has only seen rounding, or a dead zone
            moved |= ~found.flat
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
        if tried:  # on other sides a kink at the place would not show
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
    """Whether other intervals, wider and narrower, also find that this entry is not the one given.

    One disagreement may be an accident, and what moves little and fast (a fine ripple on a long way) shows on narrow
    intervals only. Where one of them finds another derivative, nothing is certain.
    """
    width = float(best.width[entry])
    for part in BESIDE:
        found = _window(function, place, part * width, best.side, noise)
        if found is not None and np.isfinite(found.error[entry]):
            break
    else:
        return False
    apart = abs(given - float(found.slope[entry]))
    if apart <= 0.6 * SAFETY * found.error[entry] or abs(found.slope[entry] - best.slope[entry]) >= 0.5 * apart:
        return False
    least = LEAST_SPACINGS * max(spacing, float(np.spacing(abs(place))))
    for k in (*range(-WIDER, 0), *range(1, CLOSER)):
        if width / FINER**k < least:
            break
        found = _window(function, place, width / FINER**k, best.side, noise)
        if found is None or found.flat[entry]:
            continue
        if abs(found.slope[entry] - best.slope[entry]) > SAFETY * (found.error[entry] + best.error[entry]):
            return False
        if k > RIPPLES and found.ripple[entry] > 0.0:  # not from the ends of the interval: it may hide a steep slope
            return False
    return True


def defined(function: Callable[[], Array]) -> Array | None:
    """What a callback gives away from the state, or None: there it may be outside what it is made for."""
    try:
        value = function()
    except Exception:
        return None
    return value if np.isfinite(value).all() else None


def as_far_as_they_differ(one: float, other: float) -> tuple[str, str]:
    """Two numbers, to the third digit of their difference: those behind it are rounding, or of no interest."""
    if not 0.0 < abs(one - other) < np.inf:
        return f"{one:.3g}", f"{other:.3g}"
    places = 2 - math.floor(math.log10(abs(one - other)))
    return f"{round(one, places) + 0.0:.16g}", f"{round(other, places) + 0.0:.16g}"

"""Checks of what a user gives: each says which argument is wrong, what was given, what was expected, what to do."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

NEAR = 8.0  # times that differ by less than so many spacings of floating-point numbers cannot be told apart


def check_size(name: str, value: Any, least: int) -> int:
    """Return `value` as an int of at least `least`, or say what is wrong with it."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be an int; given {value!r} of type {type(value).__name__}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}; given {value}")
    return int(value)


def check_real(name: str, value: ArrayLike) -> Array:
    """Return `value` as a new float array, or say that it is not one."""
    try:
        if np.iscomplexobj(value):
            raise TypeError("complex numbers")
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of real numbers; given {value!r}") from error


def check_vector(name: str, value: ArrayLike, n: int) -> Array:
    """Return `value` as a new float vector of length n, or say what is wrong with it."""
    array = check_real(name, value)
    if array.shape != (n,):
        raise ValueError(f"{name} must have shape ({n},); given shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; entries {np.flatnonzero(~np.isfinite(array)).tolist()} are not")
    return array


def check_span(t_span: tuple[float, float]) -> tuple[float, float]:
    """Return start and end, or say what is wrong with them."""
    span = check_vector("t_span", t_span, 2)
    t0, t1 = float(span[0]), float(span[1])
    if not t1 - t0 > NEAR * np.spacing(max(abs(t0), abs(t1))):
        raise ValueError(f"t_span must be (start, end) with end > start; given ({t0!r}, {t1!r})")
    return t0, t1


def check_number(name: str, value: Any) -> float:
    """Return `value` as a float, or say that it is not a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number; given {value!r} of type {type(value).__name__}")
    return float(value)


def check_positive(name: str, value: Any, infinite: bool = False) -> None:
    """Raise unless `value` is a positive number, finite unless `infinite`."""
    check_number(name, value)
    if not value > 0.0 or (not infinite and value == np.inf):
        raise ValueError(f"{name} must be positive{'' if infinite else ' and finite'}; given {value!r}")


def check_times(t_eval: ArrayLike, t0: float, t1: float, step_size: float | None) -> Array:
    """Return the output times as an array, or say what is wrong with them."""
    times = check_real("t_eval", t_eval)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"t_eval must be a non-empty one-dimensional array; given shape {times.shape}")
    if not np.isfinite(times).all() or times.min() < t0 or times.max() > t1:
        raise ValueError(
            f"t_eval must lie within t_span = ({t0:g}, {t1:g}); given times from {times.min():g} to {times.max():g}"
        )
    spacing = NEAR * np.spacing(max(abs(t0), abs(t1)))
    close = np.diff(times) <= spacing
    if close.any():
        where = int(np.flatnonzero(close)[0])
        raise ValueError(
            f"t_eval must be strictly increasing; entry {where + 1} ({float(times[where + 1])!r}) follows "
            f"{float(times[where])!r}"
        )
    for end in (t0, t1):
        beside = (times != end) & (np.abs(times - end) <= spacing)
        if beside.any():
            raise ValueError(f"t_eval must not come within rounding of the end {end!r} of t_span; give that end itself")
    if step_size is not None:
        ratio = (times - t0) / step_size
        off = np.abs(ratio - np.round(ratio)) > max(1e-6, spacing / step_size)
        off &= times != t1
        if off.any():
            raise ValueError(
                f"t_eval must hold multiples of step_size = {step_size!r} from t = {t0:g} when the step is fixed; "
                f"{times[off][0]!r} is not one"
            )
    return times


def check_tolerance(name, value, n):
    check = np.array(value, dtype=float)
    if check.ndim == 0:
        check_positive(name, value)
    return np.broadcast_to(check, (n,)).copy()

"""Check arguments; each error message names the argument, the given value, the expected value, and a remedy."""

import inspect
import math
import os
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

FLOAT, ARRAY = np.dtype(np.float64), np.ndarray
NUMBERS = (float, int)  # bool is excluded
FAR = 1e300  # times of smaller magnitude, s, are certainly finite
SURELY_APART = 1e-14  # a span is certainly long enough if its duration, relative to its ends, exceeds this number
NEAR = 8.0  # difference, in spacings of floating-point numbers, below which two times cannot be distinguished
# contents of arrays, for messages, by NumPy's kind
HOLDS = {"U": "text", "S": "text", "M": "dates", "m": "time differences", "c": "complex numbers"}
SHOWN = 120  # largest number of characters of a given value in a message


def shown(value: Any) -> str:
    """Return the text that represents a value in messages: its repr, cut if it is long."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= 10**30:
        return f"an integer of {value.bit_length()} bits"  # more digits than Python writes
    try:
        text = repr(value)
    except Exception:  # the repr of an object may raise, too
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def shaped(array: NDArray[Any]) -> str:
    """Return the text that represents an array of unexpected shape in messages."""
    if array.ndim == 0:
        return f"the number {shown(array.tolist())}"
    return f"shape {array.shape}, {shown(array.tolist())}"


def check_size(name: str, value: Any, least: int) -> int:
    """Return `value` as an int of at least `least`, or raise."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be an int; given {shown(value)} of type {type(value).__name__}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}; given {shown(value)}")
    if value > np.iinfo(np.int64).max:
        raise ValueError(f"{name} must fit into 64 bits; given {shown(value)}")
    return int(value)


def check_flag(name: str, value: Any) -> bool:
    """Return `value` as a bool, or raise if it is not one."""
    if not isinstance(value, (bool, np.bool_)):
        raise TypeError(f"{name} must be True or False; given {shown(value)} of type {type(value).__name__}")
    return bool(value)


def check_text(name: str, value: Any) -> str:
    """Return `value`, or raise if it is not a string."""
    if not isinstance(value, str):
        raise TypeError(f"{name} must be a string; given {shown(value)} of type {type(value).__name__}")
    return value


def check_path(path: Any, name: str = "path") -> Path:
    """Return `path` as a Path; raise TypeError if it is not a path."""
    if not isinstance(path, (str, os.PathLike)) or "\0" in str(path):
        raise TypeError(f"{name} must be a file name or a path; given {shown(path)} of type {type(path).__name__}")
    return Path(path)


def check_call(name: str, call: str, function: Callable[..., Any], arguments: Sequence[str], remedy: str = "") -> None:
    """Raise TypeError if a function cannot be called with these positional arguments."""
    if callable(function) and _takes(function, len(arguments)):
        return
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # built-in functions have no signature
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        expected = f"{name} is called as {call}({', '.join(arguments)})"
        raise TypeError(f"{expected}; the function given takes {signature}{remedy}") from None


def _takes(function: Callable[..., Any], n: int) -> bool:
    """Return whether a plain function, or an object's __call__, takes exactly n positional arguments; a fast check."""
    if isinstance(function, partial):
        return not function.keywords and _takes(function.func, n + len(function.args))
    of_object = not isinstance(function, FunctionType)
    own = type(function).__call__ if of_object else function
    if not isinstance(own, FunctionType) or own.__code__.co_kwonlyargcount > 0:
        return False
    return own.__code__.co_argcount == n + of_object


def check_choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """Return `value`, or raise if it is not one of the choices."""
    if not isinstance(value, str) or value not in choices:
        known = f"{', '.join(repr(each) for each in choices[:-1])} or {choices[-1]!r}"
        raise (ValueError if isinstance(value, str) else TypeError)(f"{name} must be {known}; given {shown(value)}")
    return value


def check_real(name: str, value: ArrayLike) -> Array:
    """Return `value` as a new float array, or raise if it is not real."""
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value.copy()
    if type(value) is list and all(type(each) is float for each in value):
        return np.array(value, dtype=np.float64)
    expected = f"{name} must be an array of real numbers"
    if isinstance(value, np.ma.MaskedArray):
        raise TypeError(f"{expected}; given a masked array: fill its gaps first, with filled()")
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:  # lists of unequal lengths
        raise TypeError(f"{expected}; given {shown(value)}") from error
    if array.dtype.kind == "b" or _holds_bool(value):
        raise TypeError(f"{expected}; given {shown(value)}, in which True and False are no numbers")
    if array.dtype.kind not in "iufO":
        raise TypeError(f"{expected}; given {shown(value)}, which holds {HOLDS.get(array.dtype.kind, array.dtype)}")
    if array.dtype.kind == "O" and not all(isinstance(each, (int, float)) for each in array.flat):
        raise TypeError(f"{expected}; given {shown(value)}")
    try:
        with np.errstate(over="ignore"):  # callers that need finite numbers check for infinity
            return np.array(array, dtype=np.float64)
    except OverflowError as error:
        raise ValueError(f"{name} must hold numbers that fit into a float; given one beyond 1.8e308") from error


def _holds_bool(value: Any) -> bool:
    """Return whether nested lists contain a bool, which NumPy would convert to a number."""
    if isinstance(value, (list, tuple)):
        return any(_holds_bool(each) for each in value)
    return isinstance(value, (bool, np.bool_)) or (isinstance(value, np.ndarray) and value.dtype.kind == "b")


def wrong_entries(name: str, wanted: str, array: Array, wrong: NDArray[np.bool_]) -> ValueError:
    """Return the error that lists the wrong entries of an array and their values."""
    places = np.argwhere(wrong)
    listed = places.ravel() if array.ndim == 1 else places
    given = f"given {shown(array[wrong].tolist())}"
    return ValueError(f"{name} must be {wanted}; entries {shown(listed.tolist())} are not: {given}")


def check_vector(name: str, value: ArrayLike, n: int) -> Array:
    """Return `value` as a new float vector of length n, or raise."""
    array = check_real(name, value)
    if array.shape != (n,):
        raise ValueError(f"{name} must have shape ({n},); given {shaped(array)}")
    # test the sum first, which is faster; a sum of finite numbers may be infinite
    if not math.isfinite(sum(array.tolist())) and not np.isfinite(array).all():
        raise wrong_entries(name, "finite", array, ~np.isfinite(array))
    return array


def is_vector(value: Any, n: int) -> TypeGuard[Array]:
    """Return whether a value is already a float vector of length n; its numbers need not be finite."""
    return type(value) is ARRAY and value.dtype == FLOAT and value.shape == (n,)


def check_columns(name: str, value: Array, n: int) -> None:
    """Raise unless an array holds a state of n numbers, or one in each column."""
    if value.ndim not in (1, 2) or len(value) != n:
        raise ValueError(f"{name} must have shape ({n},) or ({n}, n_t); given {shaped(value)}")


def check_indices(name: str, value: Any, n: int) -> list[int]:
    """Return `value` as a sorted list of different indices below n, or raise."""
    if isinstance(value, (str, bytes)) or not isinstance(value, (Sequence, set, frozenset, range, np.ndarray)):
        raise TypeError(f"{name} must be a list of indices of coordinates, e.g. [0]; given {shown(value)}")
    indices = []
    for each in value:
        if isinstance(each, (bool, np.bool_)) or not isinstance(each, (int, np.integer)):
            raise TypeError(f"{name} must be a list of indices of coordinates, e.g. [0]; given {shown(value)}")
        if not 0 <= each < n:
            raise ValueError(f"{name} must hold indices from 0 to {n - 1}; given {shown(each)}")
        indices.append(int(each))
    if len(set(indices)) < len(indices):
        raise ValueError(f"{name} must name each coordinate once; given {shown(value)}")
    return sorted(indices)


def check_span(t_span: tuple[float, float]) -> tuple[float, float]:
    """Return the start and the end of `t_span`, or raise if they are wrong."""
    t0, t1 = t_span if type(t_span) is tuple and len(t_span) == 2 else (0.0, 0.0)
    if type(t0) in NUMBERS and type(t1) in NUMBERS and -FAR < t0 < t1 < FAR:
        if t1 - t0 > SURELY_APART * (abs(t0) + abs(t1)):  # faster than computing the spacing
            return float(t0), float(t1)
        t0, t1 = float(t0), float(t1)
    else:
        times = check_real("t_span", t_span)
        if times.shape != (2,):
            advice = "give both, as in (0.0, 10.0)" if times.ndim == 0 else "give both, and further times as t_eval"
            raise ValueError(f"t_span must have shape (2,), (start, end); given {shaped(times)}: {advice}")
        t0, t1 = check_vector("t_span", times, 2).tolist()
    if not t1 - t0 > NEAR * math.ulp(max(abs(t0), abs(t1))):
        wanted = "with end > start" if t1 <= t0 else "further apart than floating-point numbers resolve"
        raise ValueError(f"t_span must be (start, end) {wanted}; given ({t0!r}, {t1!r})")
    return t0, t1


def check_number(name: str, value: Any) -> float:
    """Return `value` as a float, or raise if it is not a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number; given {shown(value)} of type {type(value).__name__}")
    try:
        return float(value)
    except OverflowError as error:
        raise ValueError(f"{name} must fit into a float, below 1.8e308; given {shown(value)}") from error


def check_finite(name: str, value: Any) -> float:
    """Return `value` as a float, or raise if it is not a finite number."""
    number = check_number(name, value)
    if not np.isfinite(number):
        raise ValueError(f"{name} must be finite; given {value!r}")
    return number


def check_not_negative(name: str, value: Any) -> float:
    """Return `value` as a finite float that is not negative, or raise."""
    number = check_finite(name, value)
    if number < 0.0:
        raise ValueError(f"{name} must not be negative; given {value!r}")
    return number


def check_positive(name: str, value: Any, infinite: bool = False) -> None:
    """Raise unless `value` is a positive number, finite unless `infinite`."""
    number = check_number(name, value)
    if not number > 0.0 or (not infinite and number == np.inf):
        raise ValueError(f"{name} must be positive{'' if infinite else ' and finite'}; given {value!r}")


def check_tolerance(name: str, value: ArrayLike, n_q: int) -> Array:
    """Return a tolerance as an array (n_q,): a positive number for all coordinates, or one for each."""
    if type(value) is float or (not isinstance(value, (list, tuple, np.ndarray)) and np.ndim(value) == 0):
        check_positive(name, value)
        array = np.empty(n_q)
        array.fill(value)
        return array
    array = check_real(name, value)
    if array.shape != (n_q,):
        raise ValueError(
            f"{name} must be a number or have one for each coordinate, shape ({n_q},); given {shaped(array)}"
        )
    fine = (array > 0.0) & np.isfinite(array)
    if not fine.all():
        raise wrong_entries(name, "positive and finite", array, ~fine)
    return array


def check_times(t_eval: ArrayLike, t0: float, t1: float, step_size: float | None) -> Array:
    """Return the output times as an array, or raise if they are wrong."""
    times = check_real("t_eval", t_eval)
    if times.ndim != 1 or times.size == 0:
        advice = "leave it out for every step" if times.size == 0 else f"write {shown(times.ravel().tolist())}"
        raise ValueError(f"t_eval must be a non-empty one-dimensional array; given {shaped(times)}: {advice}")
    spacing = NEAR * math.ulp(max(abs(t0), abs(t1)))
    first, last = float(times[0]), float(times[-1])
    within = (first == t0 or first - t0 > spacing) and (last == t1 or t1 - last > spacing)
    with np.errstate(invalid="ignore"):  # infinite times
        are_apart = (times[1:] - times[:-1] > spacing).all()
    if not (within and are_apart):  # False for NaN, too
        _check_each(times, t0, t1, spacing)
    if step_size is not None:
        ratio = (times - t0) / step_size
        off = np.abs(ratio - np.round(ratio)) > max(1e-6, spacing / step_size)
        off &= times != t1
        if off.any():
            raise ValueError(
                f"t_eval must hold multiples of step_size = {step_size!r} from t = {t0!r} when the step is fixed; "
                f"{float(times[off][0])!r} is not one"
            )
    return times


def _check_each(times: Array, t0: float, t1: float, spacing: float) -> None:
    """Raise the error that describes the first wrong output time; the caller has found that one is wrong."""
    if not np.isfinite(times).all():
        raise wrong_entries("t_eval", "finite", times, ~np.isfinite(times))
    if times.min() < t0 or times.max() > t1:
        raise ValueError(
            f"t_eval must lie within t_span = ({t0!r}, {t1!r}); given times from {float(times.min())!r} to "
            f"{float(times.max())!r}"
        )
    close = np.diff(times) <= spacing
    if close.any():
        where = int(np.flatnonzero(close)[0])
        before, after = times[where : where + 2].tolist()
        wanted = f"hold times more than {spacing:.2g} s apart" if after > before else "be strictly increasing"
        raise ValueError(f"t_eval must {wanted}; entry {where + 1} ({after!r}) follows {before!r}")
    for end in (t0, t1):
        beside = (times != end) & (np.abs(times - end) <= spacing)
        if beside.any():
            raise ValueError(
                f"t_eval must not come within rounding of the end {end!r} of t_span; given "
                f"{float(times[beside][0])!r}: give that end itself"
            )


def needed(module: str, package: str, what: str) -> Any:
    """Import a module of an optional package; raise ImportError, saying what needs it, if it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"{what} needs the package {package}: pip install {package}") from error

"""Validation of the fields of a saved result, before anything, compiled code above all, relies on them."""

import math
import zlib
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array, shown
from twoloop.kernels.data import intervals
from twoloop.run.record import Statistics, Status

STATES = ("q", "v", "a", "lam")
COUNTS = ("rejected_error", "rejected_convergence", "partitioned")
NUMBERS = ("rtol", "defect", "widest_gap")  # each may be None
OF_EVENTS = ("t_events", "q_events", "v_events")
KINDS = (intervals.APART, intervals.VELOCITIES, intervals.ACCELERATIONS, intervals.ACROSS)
LARGEST = 2**63
ROWS = 1024  # rows of an array checked at a time
FEWEST = 2  # smallest number of states that serve an interval in the place of its neighbours: its two ends alone


def check_sum(array: NDArray[Any]) -> int:
    """Return a checksum of the values of an array, which detects interchanged arrays."""
    return zlib.crc32(np.ascontiguousarray(array).tobytes())


def _is_number(value: Any) -> bool:
    """Return True for a number of JSON, in which integers may have any number of digits."""
    return math.isfinite(value) if type(value) is float else type(value) is int and abs(value) < LARGEST


class Fields:
    """Arrays and other fields of a file, which are checked one by one.

    Raises
    ------
    ValueError
        If a field is invalid; the message names the field, the expected and the actual value.
    """

    def __init__(self, path: str, arrays: dict[str, NDArray[Any]], words: dict[str, Any]):
        self.path, self.arrays, self.words = path, arrays, words
        for name, expected in self._word("check_sums", dict, {}).items():  # absent in older files
            if name not in arrays or check_sum(arrays[name]) != expected:
                raise self._wrong(name, "what was saved under this name", "something else" if name in arrays else None)
        n_t = len(self._times("t"))
        n_q = len(self._array("q", (None, n_t)))
        for name in ("v", "a"):
            self._array(name, (n_q, n_t))
        n_rows = len(self._array("lam", (None, n_t)))
        self.sizes = n_q, n_rows
        h = self._array("h", (None,))
        self._check("h", bool((h >= 0.0).all()), "sizes of steps")
        for name in COUNTS:
            if name in arrays:
                self._check(name, bool((self._array(name, h.shape, np.int64) >= 0).all()), "counts")
        if "untested" in arrays:
            self._array("untested", h.shape, np.bool_)
        if "atol" in arrays:
            self._check("atol", bool((self._finite("atol", (n_q,)) > 0.0).all()), "positive")
        self.numbers = {name: self._number(name) for name in NUMBERS if words.get(name) is not None}
        for name, value in self.numbers.items():
            self._check_word(name, value >= 0.0, "a number that is not negative")
        self.rank = self._whole("rank", 0, min(n_q, n_rows), or_none=True)
        if "redundant" in arrays:
            rows = self._array("redundant", (None,), np.int64)
            fits = len(set(rows.tolist())) == len(rows) == n_rows - (self.rank or 0)
            self._check("redundant", fits and bool(((rows >= 0) & (rows < n_rows)).all()), "rows beside `rank` others")
        self.message = self._word("message", str)
        self.method = self._word("method", str, "")  # absent in older files  # new field
        self.changes = self._word("changes", str, "")
        self.compiled: bool | None = None if words.get("compiled") is None else self._word("compiled", bool)
        self.status = Status(self._choice("status", [int(each) for each in Status]))
        self.statistics = self._statistics()
        self.n_events = self._whole("n_events", 0, len(arrays), or_none=True)
        for k in range(self.n_events or 0):
            n = len(self._times(f"t_events_{k}"))
            self._array(f"q_events_{k}", (n, n_q))
            self._array(f"v_events_{k}", (n, n_q))
        if "sol_t" in arrays:
            self._check_solution()

    def _check_solution(self) -> None:
        """Check the table of the dense solution and its lookup data."""
        n_q, n_rows = self.sizes
        t = self._times("sol_t", least=1)
        self._check("sol_t", bool((np.diff(t) > 0.0).all()), "increasing times")
        self._finite("sol_states", (len(t), 3 * n_q))
        kinds = self._array("sol_kinds", (len(t) - 1,), np.int64)
        self._check("sol_kinds", bool(np.isin(kinds, KINDS).all()), f"numbers from {min(KINDS)} to {max(KINDS)}")
        end, rtol = self._number("sol_end"), self._number("sol_rtol")
        self._check_word("sol_end", float(t[0]) <= end <= float(t[-1]), f"a time from {t[0]} to {t[-1]}")
        self._check_word("sol_rtol", rtol > 0.0, "a positive number")
        ranks = self._word("sol_ranks", list)
        whole = len(ranks) == 2 and all(type(rank) is int for rank in ranks)
        known = whole and 0 <= ranks[0] <= ranks[1] <= min(n_q, n_rows) and self.rank in (None, ranks[1])
        self._check_word(
            "sol_ranks", known, f"two ranks, the second {min(n_q, n_rows) if self.rank is None else self.rank}"
        )
        if ("sol_interior_t" in self.arrays) != ("sol_interior_states" in self.arrays):
            raise self._wrong("sol_interior_t and sol_interior_states", "given together", None)
        if "sol_interior_t" in self.arrays:
            self._check_interior(t)

    def _check_interior(self, t: Array) -> None:
        """Check states within intervals: one row each, first and last at its ends, NaN after the last."""
        times = self._array("sol_interior_t", (None, None))
        states = self._array("sol_interior_states", (*times.shape, 3 * self.sizes[0]))
        there = np.isfinite(times)
        expected = f"rows of none or at least {FEWEST} increasing times, from one of sol_t to the next, then NaN"
        sizes = there.sum(axis=1)
        self._check("sol_interior_t", times.shape[1] >= FEWEST, f"of at least {FEWEST} columns")
        for row, own, here, n in zip(times, states, there, sizes.tolist(), strict=True):
            i = int(np.searchsorted(t, row[0])) if n else 0
            fits = n == 0 or (
                n >= FEWEST and here[:n].all() and i < len(t) - 1 and row[0] == t[i] and row[n - 1] == t[i + 1]
            )
            self._check("sol_interior_t", bool(fits and (np.diff(row[:n]) > 0.0).all()), expected)
            self._check("sol_interior_states", bool(np.isfinite(own[:n]).all()), "finite where there are times")

    def _statistics(self) -> Statistics:
        stats = self._word("stats", dict)
        names = {field.name for field in fields(Statistics)}
        for name, value in stats.items():
            count = value is None or (type(value) is int and 0 <= value < LARGEST)
            time = name == "cpu_time" and _is_number(value) and value >= 0.0
            if name not in names or not (time or (count and name != "cpu_time")):
                raise self._wrong(
                    f"stats[{shown(name)}]", f"a count or a time of {', '.join(sorted(names))}", shown(value)
                )
        return Statistics(**stats)

    def _array(self, name: str, shape: tuple[int | None, ...], dtype: type = np.float64) -> NDArray[Any]:
        """Return an array by name and check its shape, in which None stands for any length."""
        array = self.arrays.get(name)
        sizes = ", ".join("n" if size is None else str(size) for size in shape) + ("," if len(shape) == 1 else "")
        expected = f"an array of {np.dtype(dtype).name} of shape ({sizes})"
        if array is None:
            raise self._wrong(name, expected, None)
        fits = array.ndim == len(shape) and all(want in (None, n) for want, n in zip(shape, array.shape, strict=True))
        if array.dtype != dtype or not fits:
            raise self._wrong(name, expected, f"one of {array.dtype.name} of shape {array.shape}")
        return array

    def _finite(self, name: str, shape: tuple[int | None, ...]) -> Array:
        array = self._array(name, shape)
        blocks = np.split(array, range(ROWS, len(array), ROWS))  # an array in a folder may exceed the memory
        self._check(name, all(np.isfinite(block).all() for block in blocks), "finite")
        return array

    def _times(self, name: str, least: int = 0) -> Array:
        t = self._finite(name, (None,))
        self._check(name, len(t) >= least and bool((np.diff(t) >= 0.0).all()), f"at least {least} times in their order")
        return t

    def _check(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise self._wrong(name, expected, shown(self.arrays[name]))

    def _check_word(self, name: str, fits: bool, expected: str) -> None:
        if not fits:
            raise self._wrong(name, expected, shown(self.words[name]))

    def _word(self, name: str, kind: type, default: Any = None) -> Any:
        value = self.words.get(name, default)
        if type(value) is not kind:
            raise self._wrong(name, f"of type {kind.__name__}", shown(value) if name in self.words else None)
        return value

    def _number(self, name: str) -> float:
        value: Any = self.words.get(name)
        if not _is_number(value):
            raise self._wrong(name, "a finite number", shown(value))
        return float(value)

    def _whole(self, name: str, least: int, most: int, or_none: bool) -> int | None:
        value = self.words.get(name)
        if (value is None and or_none) or (type(value) is int and least <= value <= most):
            return value
        raise self._wrong(name, f"a whole number from {least} to {most}", shown(value))

    def _choice(self, name: str, choices: list[int]) -> int:
        value = self._word(name, int)
        self._check_word(name, value in choices, f"one of {choices}")
        return int(value)

    def _wrong(self, name: str, expected: str, found: str | None) -> ValueError:
        return ValueError(
            f"path leads to a damaged file: {name} in {self.path!r} must be {expected}; "
            f"{'it is missing' if found is None else f'found {found}'}. Take another copy of the file"
        )

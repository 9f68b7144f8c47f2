"""Save results in NumPy's npz format, without pickle, or in folders; read them and validate every field."""

import json
import math
import os
import zipfile
import zlib
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array, check_path, shown
from twoloop.kernels.data import indices
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import DenseSolution, Interpolator, StateTable, ranks_at
from twoloop.run.record import STEP_ARRAYS, FileStore, Record, Statistics, Status, read_arrays

FORMAT = "twoloop result 1"
STATES = ("q", "v", "a", "lam")
COUNTS = ("rejected_error", "rejected_convergence", "partitioned")  # arrays of counts, one per step
NUMBERS = ("rtol", "defect", "widest_gap", "t_end")  # fields that are a float or None
EVENT_FIELDS = ("t_events", "q_events", "v_events")
REQUIRED = ("t", *STATES, "h")  # arrays of every result
OPTIONAL = (*COUNTS, "redundant", "atol", "untested")  # arrays that a result may have
METADATA_FILE = "words.json"  # file of a folder with all fields that are not arrays
STREAMED = ("t", *STEP_ARRAYS, "sol_t", "sol_states", "sol_kinds")  # arrays that are written to a folder during the run
INTERRUPTED = (
    "The run was interrupted: its process died, or it raised an exception. The result contains what had been stored; "
    "information written at the end of a run, such as its cost and redundant rows, is missing."
)


def fields_of(result: Record, inside: bool = True) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays of a result, and all other fields, by name; `inside`: with states within steps, if any."""
    arrays: dict[str, Any] = {name: getattr(result, name) for name in REQUIRED}
    arrays |= {name: getattr(result, name) for name in OPTIONAL if getattr(result, name) is not None}
    n_events = None if result.t_events is None else len(result.t_events)
    for name in EVENT_FIELDS:
        arrays |= {f"{name}_{k}": array for k, array in enumerate(getattr(result, name) or [])}
    metadata: dict[str, Any] = {"format": FORMAT, "status": int(result.status), "message": result.message}
    metadata |= {"stats": asdict(result.stats), "rank": result.rank, "n_events": n_events, "method": result.method}
    metadata |= {"compiled": result.compiled, "changes": result.changes}
    metadata |= {name: getattr(result, name) for name in NUMBERS}
    if result.sol is not None and not result.arcs:  # the solution of a joined result consists of its arcs' solutions
        interpolator, table = result.sol.interpolator, result.sol.table
        arrays |= {"sol_t": table.t, "sol_states": table.states, "sol_kinds": table.kinds}
        metadata |= {"sol_end": result.sol.t_max, "sol_ranks": interpolator.ranks, "sol_rtol": interpolator.rtol}
        if inside:
            blocks = zip(*interpolator.interior_blocks(table), strict=True)
            arrays["sol_interior_t"], arrays["sol_interior_states"] = map(np.concatenate, blocks)
    return arrays, metadata


def save(result: Record, path: str | os.PathLike[str]) -> None:
    """Write the result to a file in NumPy's npz format, without pickle; `twoloop.load` reads it.

    The file takes 8 (1 + 3 n_q + n_c + n_a) bytes per time of `t`. A dense solution takes another 8 (2 + 3 n_q)
    bytes per step, and 8 (1 + 3 n_q) per state within steps for methods that need these (see `DenseSolution`).

    Parameters
    ----------
    path : str or path
        File to write; an existing file is replaced.
    """
    arrays, metadata = fields_of(result)
    metadata["check_sums"] = {name: checksum(array) for name, array in arrays.items()}
    with check_path(path).open("wb") as file:
        np.savez(file, words=np.array(json.dumps(metadata)), allow_pickle=False, **arrays)


def check_folder(store: Any) -> Path:
    """Return `store` as a path at which a folder can be created; raise an error if it cannot."""
    try:
        path = check_path(store)
    except TypeError as error:
        raise TypeError(f"store{str(error).removeprefix('path')}") from None
    if path.exists() or path.is_symlink():
        raise ValueError(
            f"store must be a folder that does not exist yet; given {str(path)!r}, which exists. Use another name, "
            "or remove it"
        )
    if not path.absolute().parent.is_dir():
        raise ValueError(
            f"store must be inside an existing folder; given {str(path)!r}. Create its parent folder first"
        )
    return path


def begin_folder(path: Path, n_q: int) -> FileStore:
    """Create the folder of a run, and return its store; until `end_folder`, it describes an interrupted run."""
    store = FileStore(path)
    metadata = {"format": FORMAT, "n_q": n_q, "status": int(Status.INTERRUPTED), "message": INTERRUPTED, "stats": {}}
    (path / METADATA_FILE).write_text(json.dumps(metadata), encoding="utf-8")
    return store


def end_folder(store: FileStore, result: Record) -> None:
    """Write those arrays and fields of a result to its folder that were not written during the run."""
    arrays, metadata = fields_of(result, inside=False)
    for name in arrays.keys() - {*STREAMED, *STATES}:
        store.add(name, arrays[name])
    for t, states in () if result.sol is None else result.sol.interpolator.interior_blocks(result.sol.table):
        store.add("sol_interior_t", t)
        store.add("sol_interior_states", states)
    metadata |= {"n_q": len(result.q), "untested": None if result.untested is None else bool(result.untested.all())}
    (store.folder / METADATA_FILE).write_text(json.dumps(metadata), encoding="utf-8")


def checksum(array: NDArray[Any]) -> int:
    """Return a checksum of the values of an array, which detects damaged or interchanged arrays."""
    return zlib.crc32(np.ascontiguousarray(array).tobytes())


KINDS = (indices.SEPARATE, indices.VELOCITIES, indices.ACCELERATIONS, indices.ACROSS)
INTEGER_LIMIT = 2**63  # counts must be below this, to fit an int64
BLOCK = 1024  # number of rows of an array that are checked at a time
MIN_INTERIOR = 2  # smallest number of stored states of a divided interval: its two ends


def read_fields(path: Path, system: ConstrainedSystem | None) -> dict[str, Any]:
    """Return the validated fields of a saved result by name; invalid fields could crash compiled code."""
    arrays, metadata = _read_folder(path) if path.is_dir() else _read_file(path)
    saved = SavedFields(str(path), arrays, metadata)
    if system is not None:
        expected, actual = saved.sizes, (system.n_q, system.n_c + system.n_a)
        if expected != actual:
            raise ValueError(
                f"system must be the one that was solved, with n_q = {expected[0]} and n_c + n_a = {expected[1]}; "
                f"{system.name!r} has {actual[0]} and {actual[1]}"
            )
    required: dict[str, Any] = {name: arrays[name] for name in REQUIRED}
    optional: dict[str, Any] = {name: arrays.get(name) for name in OPTIONAL} | saved.numbers
    if saved.n_events is not None:
        optional |= {name: [arrays[f"{name}_{k}"] for k in range(saved.n_events)] for name in EVENT_FIELDS}
    metadata_fields = ("status", "message", "rank", "method", "compiled", "changes")
    return {
        **required,
        **optional,
        **{name: getattr(saved, name) for name in metadata_fields},
        "stats": saved.statistics,
        "system": system,
        "sol": None if system is None or "sol_t" not in arrays else _solution(system, arrays, metadata),
    }


def _read_folder(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays and other fields of a folder; raise ValueError if it was not written by a run."""
    try:
        metadata = json.loads((path / METADATA_FILE).read_text(encoding="utf-8"))
        arrays, n = read_arrays(path), int(metadata["n_q"])
        states = arrays.pop("states").T
    except Exception as error:  # the folder may contain anything
        raise ValueError(
            f"path must lead to a file of Result.save, or a folder that solve_dae stored a run in; {str(path)!r} is "
            f"none ({type(error).__name__}: {error})"
        ) from error
    arrays |= {"q": states[:n], "v": states[n : 2 * n], "a": states[2 * n : 3 * n], "lam": states[3 * n :]}
    if metadata.get("untested") is None:
        arrays.pop("untested", None)
    elif metadata["untested"]:
        arrays["untested"] = np.ones(len(arrays["h"]), dtype=bool)
    if "sol_end" not in metadata:  # interrupted run
        arrays = {name: array for name, array in arrays.items() if not name.startswith("sol_")}
    return arrays, metadata


def _read_file(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the arrays and other fields of a file; raise ValueError if it was not written by `Result.save`."""
    requirement = f"path must lead to a file written by Result.save; {str(path)!r}"
    arrays: dict[str, NDArray[Any]] = {}
    note = ""
    with path.open("rb") as file:
        try:
            with zipfile.ZipFile(file) as archive:
                for name in archive.namelist():
                    note = f": {name.removesuffix('.npy')} cannot be read"
                    with archive.open(name) as member:
                        arrays[name.removesuffix(".npy")] = np.lib.format.read_array(member, allow_pickle=False)
                        if member.read(1):  # reading to the end verifies the checksum of the archive
                            raise ValueError("the array is followed by other data")
            note = ""
            metadata = json.loads(str(arrays["words"]))
        except Exception as error:  # a damaged archive may raise any exception
            raise ValueError(f"{requirement} is none{note} ({type(error).__name__}: {error})") from error
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise ValueError(f"{requirement} has other contents")
    return arrays, metadata


def _solution(system: ConstrainedSystem, arrays: dict[str, Any], metadata: dict[str, Any]) -> DenseSolution:
    t, states = (np.ascontiguousarray(arrays[name]) for name in ("sol_t", "sol_states"))
    table = StateTable(t, states, arrays["sol_kinds"])
    start, row, rtol = float(t[0]), states[0], metadata["sol_rtol"]
    ranks = ranks_at(system, start, row[: system.n_q], row[system.n_q : 2 * system.n_q], rtol)
    if metadata["sol_ranks"] != list(ranks):
        raise ValueError(
            f"system must be the one that was solved: ranks of its constraints are {list(ranks)} at the start of the "
            f"run; sol_ranks in the file are {metadata['sol_ranks']}"
        )
    atol = arrays.get("atol", np.full(system.n_q, rtol))  # absent in older files
    interpolator = Interpolator(system, start, row, rtol, atol, ranks)
    if "sol_interior_t" in arrays:
        interpolator.restore_interior_states(arrays["sol_interior_t"], arrays["sol_interior_states"])
    return DenseSolution(interpolator, table, metadata["sol_end"])


def _is_number(value: Any) -> bool:
    """Return whether a JSON value is a finite float, or an int whose magnitude is below INTEGER_LIMIT."""
    return math.isfinite(value) if type(value) is float else type(value) is int and abs(value) < INTEGER_LIMIT


class SavedFields:
    """Fields of a file; raise ValueError if one is invalid, with the expected and the actual value."""

    def __init__(self, path: str, arrays: dict[str, NDArray[Any]], metadata: dict[str, Any]):
        self.path, self.arrays, self.metadata = path, arrays, metadata
        for name, expected in self._value("check_sums", dict, {}).items():  # absent in older files
            if name not in arrays or checksum(arrays[name]) != expected:
                raise self._error(name, "what was saved under this name", "something else" if name in arrays else None)
        n_t = len(self._times("t"))
        n_q = len(self._array("q", (None, n_t)))
        for name in ("v", "a"):
            self._array(name, (n_q, n_t))
        n_rows = len(self._array("lam", (None, n_t)))
        self.sizes = n_q, n_rows  # taken from q and lam; every other array must agree with them
        h = self._array("h", (None,))
        self._check("h", bool((h >= 0.0).all()), "sizes of steps")
        for name in COUNTS:
            if name in arrays:
                self._check(name, bool((self._array(name, h.shape, np.int64) >= 0).all()), "counts")
        if "untested" in arrays:
            self._array("untested", h.shape, np.bool_)
        if "atol" in arrays:
            self._check("atol", bool((self._finite("atol", (n_q,)) > 0.0).all()), "positive")
        self.numbers = {name: self._number(name) for name in NUMBERS if metadata.get(name) is not None}
        for name, value in self.numbers.items():
            self._check(name, value >= 0.0 or name == "t_end", "a number that is not negative")
        self.rank = self._whole_or_none("rank", min(n_q, n_rows))
        if "redundant" in arrays:
            rows = self._array("redundant", (None,), np.int64)
            fits = len(set(rows.tolist())) == len(rows) == n_rows - (self.rank or 0)
            self._check("redundant", fits and bool(((rows >= 0) & (rows < n_rows)).all()), "rows beside `rank` others")
        self.message = self._value("message", str)
        self.method = self._value("method", str, "")  # absent in older files
        self.changes = self._value("changes", str, "")
        self.compiled: bool | None = None if metadata.get("compiled") is None else self._value("compiled", bool)
        statuses, value = [int(status) for status in Status], self._value("status", int)
        self._check("status", value in statuses, f"one of {statuses}")
        self.status = Status(value)
        self.statistics = self._statistics()
        self.n_events = self._whole_or_none("n_events", len(arrays))
        for k in range(self.n_events or 0):
            n = len(self._times(f"t_events_{k}"))
            self._array(f"q_events_{k}", (n, n_q))
            self._array(f"v_events_{k}", (n, n_q))
        if "sol_t" in arrays:
            self._check_solution()

    def _check_solution(self) -> None:
        """Check the states at steps that the dense solution interpolates, and its other fields."""
        n_q, n_rows = self.sizes
        t = self._times("sol_t", minimum=1)
        self._check("sol_t", bool((np.diff(t) > 0.0).all()), "increasing times")
        self._finite("sol_states", (len(t), 3 * n_q))
        kinds = self._array("sol_kinds", (len(t) - 1,), np.int64)
        self._check("sol_kinds", bool(np.isin(kinds, KINDS).all()), f"numbers from {min(KINDS)} to {max(KINDS)}")
        end, rtol = self._number("sol_end"), self._number("sol_rtol")
        self._check("sol_end", float(t[0]) <= end <= float(t[-1]), f"a time from {t[0]} to {t[-1]}")
        self._check("sol_rtol", rtol > 0.0, "a positive number")
        ranks = self._value("sol_ranks", list)
        whole = len(ranks) == 2 and all(type(rank) is int for rank in ranks)
        valid = whole and 0 <= ranks[0] <= ranks[1] <= min(n_q, n_rows) and self.rank in (None, ranks[1])
        self._check("sol_ranks", valid, f"two ranks, the second {min(n_q, n_rows) if self.rank is None else self.rank}")
        if ("sol_interior_t" in self.arrays) != ("sol_interior_states" in self.arrays):
            raise self._error("sol_interior_t and sol_interior_states", "given together", None)
        if "sol_interior_t" in self.arrays:
            self._check_interior(t)

    def _check_interior(self, t: Array) -> None:
        """Check states within intervals: each row begins and ends at the ends of an interval, and is filled by NaN."""
        times = self._array("sol_interior_t", (None, None))
        states = self._array("sol_interior_states", (*times.shape, 3 * self.sizes[0]))
        finite = np.isfinite(times)
        expected = f"rows of none or at least {MIN_INTERIOR} increasing times, from one of sol_t to the next, then NaN"
        sizes = finite.sum(axis=1)
        self._check("sol_interior_t", times.shape[1] >= MIN_INTERIOR, f"of at least {MIN_INTERIOR} columns")
        for row_times, row_states, present, n in zip(times, states, finite, sizes.tolist(), strict=True):
            i = int(np.searchsorted(t, row_times[0])) if n else 0
            fits = n == 0 or (
                n >= MIN_INTERIOR
                and present[:n].all()
                and i < len(t) - 1
                and row_times[0] == t[i]
                and row_times[n - 1] == t[i + 1]
            )
            self._check("sol_interior_t", bool(fits and (np.diff(row_times[:n]) > 0.0).all()), expected)
            self._check("sol_interior_states", bool(np.isfinite(row_states[:n]).all()), "finite where there are times")

    def _statistics(self) -> Statistics:
        stats = self._value("stats", dict)
        names = {field.name for field in fields(Statistics)}
        for name, value in stats.items():
            count = value is None or (type(value) is int and 0 <= value < INTEGER_LIMIT)
            time = name == "cpu_time" and _is_number(value) and value >= 0.0
            if name not in names or not (time or (count and name != "cpu_time")):
                raise self._error(
                    f"stats[{shown(name)}]", f"a count or a time of {', '.join(sorted(names))}", shown(value)
                )
        return Statistics(**stats)

    def _array(self, name: str, shape: tuple[int | None, ...], dtype: type = np.float64) -> NDArray[Any]:
        """Return the array `name`; raise ValueError if its type or shape differs; None in `shape`: any length."""
        array = self.arrays.get(name)
        sizes = ", ".join("n" if size is None else str(size) for size in shape) + ("," if len(shape) == 1 else "")
        expected = f"an array of {np.dtype(dtype).name} of shape ({sizes})"
        if array is None:
            raise self._error(name, expected, None)
        fits = array.ndim == len(shape) and all(
            expected_n in (None, n) for expected_n, n in zip(shape, array.shape, strict=True)
        )
        if array.dtype != dtype or not fits:
            raise self._error(name, expected, f"one of {array.dtype.name} of shape {array.shape}")
        return array

    def _finite(self, name: str, shape: tuple[int | None, ...]) -> Array:
        array = self._array(name, shape)
        blocks = np.split(array, range(BLOCK, len(array), BLOCK))  # an array in a folder may exceed the memory
        self._check(name, all(np.isfinite(block).all() for block in blocks), "finite")
        return array

    def _times(self, name: str, minimum: int = 0) -> Array:
        t = self._finite(name, (None,))
        self._check(
            name, len(t) >= minimum and bool((np.diff(t) >= 0.0).all()), f"at least {minimum} times in their order"
        )
        return t

    def _check(self, name: str, valid: bool, expected: str) -> None:
        if not valid:
            raise self._error(name, expected, shown((self.arrays | self.metadata)[name]))

    def _value(self, name: str, kind: type, default: Any = None) -> Any:
        value = self.metadata.get(name, default)
        if type(value) is not kind:
            raise self._error(name, f"of type {kind.__name__}", shown(value) if name in self.metadata else None)
        return value

    def _number(self, name: str) -> float:
        value: Any = self.metadata.get(name)
        if not _is_number(value):
            raise self._error(name, "a finite number", shown(value))
        return float(value)

    def _whole_or_none(self, name: str, maximum: int) -> int | None:
        value = self.metadata.get(name)
        if value is None or (type(value) is int and 0 <= value <= maximum):
            return value
        raise self._error(name, f"a whole number from 0 to {maximum}", shown(value))

    def _error(self, name: str, expected: str, actual: str | None) -> ValueError:
        return ValueError(
            f"path leads to a damaged file: {name} in {self.path!r} must be {expected}; "
            f"{'it is missing' if actual is None else f'found {actual}'}. Take another copy of the file"
        )

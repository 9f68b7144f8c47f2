"""Recorder of accepted steps: all states, or those at output times, and events; in memory or in files."""

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.data.indices import WINDOW
from twoloop.problem.events import Event, EventSearch
from twoloop.run.dense_solution import DenseSolution, Interpolator, Table

MAGIC, HEAD = b"\x93NUMPY\x01\x00", 128  # bytes before the numbers of a file, in NumPy's npy format
OF_STEPS = ("h", "rejected_error", "rejected_convergence", "partitioned", "untested")  # fields with one row per step


class MemoryStore:
    """Store of arrays by name in memory, each as a list of parts that follow one another.

    Attributes
    ----------
    finished : bool
        Whether added rows must be in their final form, as later changes would not reach all of them.
    """

    finished = False

    def __init__(self) -> None:
        self._parts: defaultdict[str, list[NDArray[Any]]] = defaultdict(list)

    def add(self, name: str, part: NDArray[Any]) -> None:
        """Append rows to an array; the part may be stored without a copy."""
        self._parts[name].append(part)

    def cut(self, name: str, n: int) -> None:
        """Keep the first n rows of an array."""
        self._parts[name] = [self.array(name)[:n]]

    def array(self, name: str) -> NDArray[Any]:
        """Return all rows."""
        first, *others = self._parts[name]
        return np.concatenate([first, *others]) if others else first


class FileStore:
    """Store of arrays in a new folder: a NumPy file for each array, complete after each part.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    OSError
        In `add`, if the disk is full.
    """

    finished = True

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        self._shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def add(self, name: str, part: NDArray[Any]) -> None:
        """Append rows to an array."""
        dtype, (n, *width) = self._shapes.get(name, (part.dtype, (0, *part.shape[1:])))
        with self._path(name).open("r+b" if name in self._shapes else "x+b") as file:
            file.seek(HEAD + n * self._row(dtype, width))
            file.write(np.ascontiguousarray(part).data)
            self._close(file, name, dtype, (n + len(part), *width))

    def cut(self, name: str, n: int) -> None:
        """Keep the first n rows of an array."""
        dtype, (before, *width) = self._shapes[name]
        with self._path(name).open("r+b") as file:
            file.truncate(HEAD + min(n, before) * self._row(dtype, width))
            self._close(file, name, dtype, (min(n, before), *width))

    def array(self, name: str) -> NDArray[Any]:
        """Return all rows, memory-mapped; what is written to them does not reach the file."""
        return mapped(self._path(name))

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npy"

    @staticmethod
    def _row(dtype: np.dtype[Any], width: list[int]) -> int:
        return int(dtype.itemsize * np.prod(width, dtype=np.int64))

    def _close(self, file: Any, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        """Write the header last: a process that dies before leaves the array as it was."""
        head = repr({"descr": dtype.str, "fortran_order": False, "shape": shape}).ljust(HEAD - len(MAGIC) - 3) + "\n"
        file.flush()
        file.seek(0)
        file.write(MAGIC + (len(head)).to_bytes(2, "little") + head.encode())
        self._shapes[name] = dtype, shape


Store = MemoryStore | FileStore


def mapped(path: Path) -> NDArray[Any]:
    """Map the array in a file into memory; what is written to it does not reach the file."""
    return np.load(path, mmap_mode="c", allow_pickle=False).view(np.ndarray)  # type: ignore[no-any-return]


def read(folder: Path) -> dict[str, NDArray[Any]]:
    """Read the arrays in a folder, cut to the rows that all arrays of a group have: a process may have died."""
    arrays = {path.stem: mapped(path) for path in sorted(folder.glob("*.npy"))}
    for group in (("t", "states"), OF_STEPS, ("sol_t", "sol_states")):
        there = [name for name in group if name in arrays]
        n = min((len(arrays[name]) for name in there), default=0)
        arrays |= {name: arrays[name][:n] for name in there}
    return arrays


Array = NDArray[np.float64]

PENDING = 1024  # number of states that wait for the search of the intervals between them, unless it is needed sooner


@dataclass(frozen=True)
class OutputRequest:
    """Requested output of a run.

    Attributes
    ----------
    times : ndarray or None
        Output times; None: every accepted step.
    lands : bool
        Whether steps end at all output times, so that nothing is interpolated.
    dense : bool
        Whether the dense solution is requested.
    events : list of Event or None
        None: no events were requested.
    store : MemoryStore or FileStore
        Where the output is stored.
    """

    times: Array | None
    lands: bool
    dense: bool
    events: list[Event] | None
    store: Store

    @property
    def every_step(self) -> bool:
        """Whether the states of all steps are needed, if only temporarily."""
        return self.times is None or self.between_steps

    @property
    def between_steps(self) -> bool:
        """Whether states between steps are requested."""
        return (self.times is not None and not self.lands) or self.dense or self.events is not None


class _Between(NamedTuple):
    """Interpolation of states between steps, for the search for events."""

    interpolator: Interpolator
    table: Table

    def at(self, times: Array) -> Array:
        return self.interpolator.states(self.table, times)

    def within(self, t: float) -> Callable[[float], Array]:
        return self.interpolator.within(self.table, t)


class Recorder:
    """Recorder of the states of accepted steps, chunk by chunk.

    An interval is searched when all states are known that its polynomials go through, so that the output does not
    depend on the chunks. As many states before it are kept as the polynomials need, and all if they are requested.
    Events are searched at least every `every` seconds.

    Attributes
    ----------
    search : EventSearch or None
        The events so far.
    n_steps, last_step : int, float
        After a terminal event: the number of steps up to it, and the part of the last one before it, s.
    interrupted : bool
        Whether Ctrl-C interrupted the search for events, or the interpolation between the steps.
    """

    def __init__(
        self, request: OutputRequest, interpolator: Interpolator | None, n_q: int, t0: float, state: Array, every: float
    ):
        self.request, self.interpolator, self._n_q, self._width = request, interpolator, n_q, len(state)
        self.n_steps, self.last_step = 0, 0.0
        self.interrupted = False
        self._t, self._rows = np.array([t0]), state[None, :].copy()  # the last states, and those not yet searched
        self._kinds = np.empty(0, dtype=np.int64)
        self._next = 0  # index of the first interval of these that was not searched
        self._n_outputs = 0
        ends = request.events is not None and any(event.terminal < np.inf for event in request.events)
        self._waits_for = 0 if ends or request.store.finished else PENDING
        self.search = None if request.events is None else EventSearch(request.events, t0, state[: 2 * n_q], every)
        self._add(self._t, self._rows, self._kinds)
        if request.times is not None and not request.lands:
            self._store(self._t[:0], self._rows[:0, : 2 * self._n_q])

    def add(self, t: Array, rows: Array, kinds: NDArray[np.int64]) -> None:
        """Record the states [q, v, a, lam] at which steps ended, and the kind of interval of each step.

        There is one kind per step if states between steps are requested, else none.
        """
        self._add(t, rows, kinds)
        if not self.request.between_steps:
            return
        self._t, self._rows = np.concatenate([self._t, t]), np.concatenate([self._rows, rows])
        self._kinds = np.concatenate([self._kinds, kinds])
        if len(self._t) > self._waits_for:
            self._look(len(self._t) - WINDOW)

    def correct_last(self, t: float, row: Array) -> None:
        """Replace [q, v, a] of the last state, if it is that at t, for states between steps."""
        if self.request.between_steps and len(self._t) and self._t[-1] == t:
            self._rows[-1, : len(row)] = row

    def _add(self, t: Array, rows: Array, kinds: NDArray[np.int64]) -> None:
        request, store = self.request, self.request.store
        if request.times is None:
            self._store(t, rows)
        elif request.lands:  # the ends of the run may not be among the times
            landed = np.append(request.times, np.inf)[np.searchsorted(request.times, t)] == t
            self._store(t[landed], rows[landed])
        if request.dense:
            store.add("sol_t", t)
            store.add("sol_states", rows[:, : 3 * self._n_q])
            store.add("sol_kinds", kinds)

    def _store(self, t: Array, rows: Array) -> None:
        """Store rows [q, v, a, lam], or [q, v] if the rest is computed at the end."""
        self.request.store.add("t", t)
        self.request.store.add("states", self._completed(t, rows) if self.request.store.finished else rows)

    def finish(self) -> None:
        """Search the remaining intervals: no more states follow."""
        self._look(len(self._t) - 1)

    @property
    def last(self) -> tuple[float, Array] | None:
        """Time and row [q, v] of the event that ended the run."""
        return None if self.search is None or self.ended is None else self.search.found[self.ended[0].number][-1]

    @property
    def broken_off(self) -> float | None:
        """Time at which the search for events was interrupted: the result ends there, as later events are not known."""
        behind = self.interrupted and self.search is not None and self.ended is None
        return self.search.reached if behind and self.search is not None else None

    @property
    def ended(self) -> tuple[Event, float] | None:
        """Event that ended the run, and its time."""
        return None if self.search is None else self.search.ended

    def _look(self, end: int) -> None:
        """Search and interpolate the intervals before `end`."""
        interpolator = self.interpolator
        if interpolator is None or self.ended is not None or self.interrupted:
            return
        if end < self._next or (end == self._next and len(self._t) > 1):
            return
        table = Table(self._t, np.ascontiguousarray(self._rows[:, : 3 * self._n_q]), self._kinds)
        ends = self._t[self._next : end + 1]
        if self.search is not None:
            try:
                self.search.search(_Between(interpolator, table), ends)
            except KeyboardInterrupt:
                self.interrupted = True
                self.search.break_off()
                ends = ends[ends <= self.search.reached]
            if self.ended is not None:
                before = int(np.searchsorted(ends, self.ended[1]))
                self.last_step = float(self.ended[1] - ends[max(before - 1, 0)])
                ends = np.append(ends[:before], self.ended[1])
        self.n_steps += len(ends) - 1
        if self.request.times is not None and not self.request.lands:
            times = self.request.times[self._n_outputs :]
            times = times[times <= ends[-1]]
            try:
                self._store(times, interpolator.states(table, times))
                self._n_outputs += len(times)
            except KeyboardInterrupt:
                self.interrupted = True
        drop = max(0, end - WINDOW)
        self._t, self._rows, self._kinds = self._t[drop:], self._rows[drop:], self._kinds[drop:]
        self._next = end - drop

    def output(self) -> tuple[Array, Array]:
        """Return times and rows [q, v, a, lam] of the result."""
        store, end = self.request.store, self.broken_off if self.ended is None else self.ended[1]
        if end is not None:
            n = int(np.searchsorted(store.array("t"), end, side="right"))
            store.cut("t", n)
            store.cut("states", n)
        t = store.array("t")
        if self.request.times is None and self.last is not None and t[-1] < self.last[0]:
            last = np.array([self.last[0]])
            self._store(last, self._completed(last, self.last[1][None, :]))
            t = store.array("t")
        return t, self._completed(t, store.array("states"))

    def _completed(self, times: Array, rows: Array) -> Array:
        """Complete rows [q, v] to rows [q, v, a, lam]."""
        if self.interpolator is None or rows.shape[1] == self._width:
            return rows
        added = np.full((len(times), self._width - rows.shape[1]), np.nan)
        try:
            self.interpolator.complete(times, rows, added)
        except KeyboardInterrupt:
            self.interrupted = True
            added[np.isnan(added).any(axis=1)] = np.nan  # also of a row that was half written
        return np.concatenate([rows, added], axis=1)

    def solution(self) -> DenseSolution | None:
        """Return the dense solution, if it is requested."""
        if not self.request.dense or self.interpolator is None:
            return None
        table = Table(*(self.request.store.array(f"sol_{name}") for name in ("t", "states", "kinds")))
        end = float(table.t[-1]) if self.broken_off is None else self.broken_off
        return DenseSolution(self.interpolator, table, end if self.ended is None else self.ended[1])

    def events(self) -> tuple[list[Array], list[Array], list[Array]] | tuple[None, None, None]:
        """Return times, coordinates and velocities of the events, one array for each event function."""
        if self.search is None:
            return None, None, None
        n = self._n_q
        times = [np.array([t for t, _ in found]) for found in self.search.found]
        rows = [np.array([row for _, row in found]).reshape(-1, 2 * n) for found in self.search.found]
        return times, [each[:, :n] for each in rows], [each[:, n:] for each in rows]

"""Record a run: its trajectory, status and cost (`Record`, to which `Result` adds views).

A `Recorder` collects events, and states at accepted steps or output times; a store keeps these in memory or in files.
"""

import pickle
from collections import defaultdict
from dataclasses import MISSING, dataclass, fields
from enum import IntEnum
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.data.indices import WINDOW
from twoloop.kernels.layout import cached_run
from twoloop.problem.description import Description
from twoloop.problem.events import Event, EventSearch
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import DenseSolution, Interpolator, StateTable

if TYPE_CHECKING:
    from twoloop.run.run import Run

MAGIC, HEADER_SIZE = b"\x93NUMPY\x01\x00", 128  # first bytes of NumPy's file format, and size of its header in bytes
STEP_ARRAYS = ("h", "rejected_error", "rejected_convergence", "partitioned", "untested")  # fields with one row per step


class MemoryStore:
    """Store of named arrays in memory; an array is a list of parts until it is read."""

    append_only = False  # True if stored rows can never be changed: then rows must be complete when they are added

    def __init__(self) -> None:
        self._parts: defaultdict[str, list[NDArray[Any]]] = defaultdict(list)

    def add(self, name: str, part: NDArray[Any]) -> None:
        """Append rows to an array, perhaps without a copy of `part`: the caller must not change `part` any more."""
        self._parts[name].append(part)

    def truncate(self, name: str, n: int) -> None:
        """Keep the first n rows of an array."""
        self._parts[name] = [self.array(name)[:n]]

    def array(self, name: str) -> NDArray[Any]:
        """Return all rows of an array."""
        first, *others = self._parts[name]
        return np.concatenate([first, *others]) if others else first


class FileStore:
    """Store of named arrays in a new folder: each array is a NumPy file, which is valid after each call of `add`."""

    append_only = True

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.folder = folder
        self._shapes: dict[str, tuple[np.dtype[Any], tuple[int, ...]]] = {}

    def add(self, name: str, part: NDArray[Any]) -> None:
        """Append rows to an array."""
        dtype, (n, *width) = self._shapes.get(name, (part.dtype, (0, *part.shape[1:])))
        with self._path(name).open("r+b" if name in self._shapes else "x+b") as file:
            file.seek(HEADER_SIZE + n * self._row_bytes(dtype, width))
            file.write(np.ascontiguousarray(part).data)
            self._write_header(file, name, dtype, (n + len(part), *width))

    def truncate(self, name: str, n: int) -> None:
        """Keep the first n rows of an array."""
        dtype, (n_before, *width) = self._shapes[name]
        with self._path(name).open("r+b") as file:
            file.truncate(HEADER_SIZE + min(n, n_before) * self._row_bytes(dtype, width))
            self._write_header(file, name, dtype, (min(n, n_before), *width))

    def array(self, name: str) -> NDArray[Any]:
        """Return all rows of an array as a memory map; changes to the array do not change the file."""
        return memory_map(self._path(name))

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.npy"

    @staticmethod
    def _row_bytes(dtype: np.dtype[Any], width: list[int]) -> int:
        return int(dtype.itemsize * np.prod(width, dtype=np.int64))

    def _write_header(self, file: Any, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> None:
        """Write the header of a file after its rows: until the header is written, the file contains the old array."""
        header = repr({"descr": dtype.str, "fortran_order": False, "shape": shape})
        header = header.ljust(HEADER_SIZE - len(MAGIC) - 3) + "\n"
        file.flush()
        file.seek(0)
        file.write(MAGIC + (len(header)).to_bytes(2, "little") + header.encode())
        self._shapes[name] = dtype, shape


def memory_map(path: Path) -> NDArray[Any]:
    """Return the array in a NumPy file as a copy-on-write memory map: changes to the array do not change the file."""
    return np.load(path, mmap_mode="c", allow_pickle=False).view(np.ndarray)  # type: ignore[no-any-return]


def read_arrays(folder: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays in a folder by name; arrays with one row per state or per step are cut to equal lengths."""
    arrays = {path.stem: memory_map(path) for path in sorted(folder.glob("*.npy"))}
    for group in (("t", "states"), STEP_ARRAYS, ("sol_t", "sol_states")):
        available = [name for name in group if name in arrays]
        n = min((len(arrays[name]) for name in available), default=0)
        arrays |= {name: arrays[name][:n] for name in available}
    return arrays


Array = NDArray[np.float64]

MAX_PENDING_STATES = 1024  # if more states than this are pending, the intervals before them are searched for events


class OutputRequest(NamedTuple):
    """Requested output of a run."""

    times: Array | None = None  # output times; None: the ends of all accepted steps
    ends_at_outputs: bool = False  # whether steps end at all output times; if not, states are interpolated
    dense: bool = False  # whether dense output, `result.sol`, is requested
    events: list[Event] | None = None  # events to be searched for; None: no events were requested
    store: Any = None  # `MemoryStore` or `FileStore` to which the output is added; None: a new MemoryStore

    @property
    def interpolated_times(self) -> Array | None:
        """Output times at which states must be interpolated; None if there are none, or if steps end at all of them."""
        return None if self.ends_at_outputs else self.times

    @property
    def every_step(self) -> bool:
        """Whether the states at the ends of all steps are needed, for output or for interpolation."""
        return self.times is None or self.between_steps

    @property
    def between_steps(self) -> bool:
        """Whether states within steps are needed: for output times, the dense solution, or events."""
        return self.interpolated_times is not None or self.dense or self.events is not None


class Recorder:
    """Recorder of the states of accepted steps, which it receives in chunks (steps of one call of compiled code).

    The polynomial of a step also passes through states after the step. The step is searched for events only when these
    are known, so that results do not depend on chunk sizes. Event functions are evaluated at least every `max_gap` s.
    """

    def __init__(
        self,
        request: OutputRequest,
        interpolator: Interpolator | None,
        n_q: int,
        t0: float,
        state: Array,
        max_gap: float,
    ):
        self.request, self.interpolator, self._n_q, self._width = request, interpolator, n_q, len(state)
        self.n_steps = 0  # number of steps searched for events so far; the last step may contain a terminal event
        self.last_step_size = 0.0  # time (s) from the beginning of the run's last step to the terminal event
        self.interrupted = False  # whether Ctrl-C interrupted the search for events, or the interpolation
        # pending states: ends of intervals not searched for events yet, and earlier states for their interpolation
        self._t, self._rows = np.array([t0]), state[None, :].copy()
        self._kinds = np.empty(0, dtype=np.int64)
        self._next_interval = 0  # index in `_kinds` of the first interval that is not searched for events yet
        self._n_outputs = 0
        may_end_run = request.events is not None and any(event.terminal < np.inf for event in request.events)
        self._max_pending = 0 if may_end_run or request.store.append_only else MAX_PENDING_STATES
        self.search = None if request.events is None else EventSearch(request.events, t0, state[: 2 * n_q], max_gap)
        self._store_output(self._t, self._rows, self._kinds)
        if request.times is not None and not request.ends_at_outputs:
            self._store_states(self._t[:0], self._rows[:0, : 2 * self._n_q])

    def add(self, t: Array, rows: Array, kinds: NDArray[np.int64]) -> None:
        """Record times and states [q, v, a, lam] at the ends of steps, and the kind of interval of each step.

        `kinds` (codes of kernels/data/indices.py) is empty unless states between steps are requested.
        """
        self._store_output(t, rows, kinds)
        if not self.request.between_steps:
            return
        self._t, self._rows = np.concatenate([self._t, t]), np.concatenate([self._rows, rows])
        self._kinds = np.concatenate([self._kinds, kinds])
        if len(self._t) > self._max_pending:
            self.search_intervals(len(self._t) - WINDOW)

    def correct_state(self, t: float, row: Array) -> None:
        """Replace the pending state at time t by `row`, so that later interpolations use `row`."""
        self._rows[self._t == t] = row

    def store_crossing(self, memory: Array) -> None:
        """If `memory` has the polynomial of a crossing that began at the last state, copy `memory` for dense output."""
        from twoloop.kernels.steps.crossing_step import END, N_STORED

        if self.interpolator is not None and memory[-N_STORED:][END] > -np.inf:
            self.interpolator.crossing_memories[float(self._t[-1])] = memory.copy()

    def _store_output(self, t: Array, rows: Array, kinds: NDArray[np.int64]) -> None:
        """Store the output states at the ends of steps, and the data of the dense solution if it is requested."""
        request, store = self.request, self.request.store
        if request.times is None:
            self._store_states(t, rows)
        elif request.ends_at_outputs:  # steps may also end between output times: leave these states out
            is_output = np.append(request.times, np.inf)[np.searchsorted(request.times, t)] == t
            self._store_states(t[is_output], rows[is_output])
        if request.dense:
            store.add("sol_t", t)
            store.add("sol_states", rows[:, : 3 * self._n_q])
            store.add("sol_kinds", kinds)

    def _store_states(self, t: Array, rows: Array) -> None:
        """Store times and rows [q, v, a, lam]; interpolated rows may be only [q, v], and are completed later."""
        self.request.store.add("t", t)
        self.request.store.add("states", self._complete_rows(t, rows) if self.request.store.append_only else rows)

    @property
    def end_state(self) -> tuple[float, Array] | None:
        """Time and row [q, v] of the event that ended the run; None if no event ended it."""
        return (
            None if self.search is None or self.end_event is None else self.search.found[self.end_event[0].number][-1]
        )

    @property
    def interrupted_at(self) -> float | None:
        """Time at which the result ends because Ctrl-C interrupted the search for events; None: no interruption."""
        ended_early = self.interrupted and self.search is not None and self.end_event is None
        return self.search.reached if ended_early and self.search is not None else None

    @property
    def end_event(self) -> tuple[Event, float] | None:
        """Event that ended the run, and its time; None if no event ended it."""
        return None if self.search is None else self.search.ended

    def search_intervals(self, end: int | None = None) -> None:
        """Search intervals before `end`, index of a pending state (None: the last), for events; store output states."""
        end = len(self._t) - 1 if end is None else end
        interpolator = self.interpolator
        if interpolator is None or self.end_event is not None or self.interrupted:
            return
        if end < self._next_interval or (end == self._next_interval and len(self._t) > 1):
            return
        table = StateTable(self._t, np.ascontiguousarray(self._rows[:, : 3 * self._n_q]), self._kinds)
        node_times = self._t[self._next_interval : end + 1]
        if self.search is not None:
            try:
                states, row_function = partial(interpolator.states, table), partial(interpolator.row_function, table)
                self.search.search(states, row_function, node_times)
            except KeyboardInterrupt:
                self.interrupted = True
                self.search.break_off()
                node_times = node_times[node_times <= self.search.reached]
            if self.end_event is not None:
                n_before = int(np.searchsorted(node_times, self.end_event[1]))
                self.last_step_size = float(self.end_event[1] - node_times[max(n_before - 1, 0)])
                node_times = np.append(node_times[:n_before], self.end_event[1])
        self.n_steps += len(node_times) - 1
        if self.request.times is not None and not self.request.ends_at_outputs:
            times = self.request.times[self._n_outputs :]
            times = times[times <= node_times[-1]]
            try:
                self._store_states(times, interpolator.states(table, times))
                self._n_outputs += len(times)
            except KeyboardInterrupt:
                self.interrupted = True
        n_dropped = max(0, end - WINDOW)
        self._t, self._rows, self._kinds = self._t[n_dropped:], self._rows[n_dropped:], self._kinds[n_dropped:]
        self._next_interval = end - n_dropped

    def output(self) -> tuple[Array, Array]:
        """Return times and rows [q, v, a, lam] of the result, up to the event or interruption that ended the run."""
        store, end = self.request.store, self.interrupted_at if self.end_event is None else self.end_event[1]
        if end is not None:
            n = int(np.searchsorted(store.array("t"), end, side="right"))
            store.truncate("t", n)
            store.truncate("states", n)
        t = store.array("t")
        if self.request.times is None and self.end_state is not None and t[-1] < self.end_state[0]:
            end_time = np.array([self.end_state[0]])
            self._store_states(end_time, self._complete_rows(end_time, self.end_state[1][None, :]))
            t = store.array("t")
        return t, self._complete_rows(t, store.array("states"))

    def _complete_rows(self, times: Array, rows: Array) -> Array:
        """Append [a, lam] to rows [q, v]; rows [q, v, a, lam] are returned unchanged."""
        if self.interpolator is None or rows.shape[1] == self._width:
            return rows
        a_and_lam = np.full((len(times), self._width - rows.shape[1]), np.nan)
        try:
            self.interpolator.fill_accelerations(times, rows, a_and_lam)
        except KeyboardInterrupt:
            self.interrupted = True
            a_and_lam[np.isnan(a_and_lam).any(axis=1)] = np.nan  # the row at which Ctrl-C arrived may be half filled
        return np.concatenate([rows, a_and_lam], axis=1)

    def solution(self) -> DenseSolution | None:
        """Return the dense solution, or None if it is not requested."""
        if not self.request.dense or self.interpolator is None:
            return None
        table = StateTable(*(self.request.store.array(f"sol_{name}") for name in ("t", "states", "kinds")))
        end = float(table.t[-1]) if self.interrupted_at is None else self.interrupted_at
        return DenseSolution(self.interpolator, table, end if self.end_event is None else self.end_event[1])

    def events(self) -> tuple[list[Array], list[Array], list[Array]] | tuple[None, None, None]:
        """Return times, q and v of events: lists of one array per event function; all None if no event is requested."""
        if self.search is None:
            return None, None, None
        n = self._n_q
        times = [np.array([t for t, _ in occurrences]) for occurrences in self.search.found]
        rows = [np.array([row for _, row in occurrences]).reshape(-1, 2 * n) for occurrences in self.search.found]
        return times, [states[:, :n] for states in rows], [states[:, n:] for states in rows]


AnyRecord = TypeVar("AnyRecord", bound="Record")


class Status(IntEnum):
    """Status with which a run ended: 0 reached the end, 1 an event, negative a failure. See docs/when_it_fails.md.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> from twoloop import Status
    >>> result.status is Status.REACHED_END
    True
    """

    REACHED_END = 0
    EVENT = 1
    STEP_TOO_SMALL = -1
    MAX_STEPS = -2
    NOT_CONVERGED = -3
    NOT_FINITE = -4
    RANK_LOST = -5
    SOLVER_FAILED = -6
    INTERRUPTED = -7
    STAGNATED = -8
    WRONG_DERIVATIVE = -9
    TIME_LIMIT = -10
    ROWS_CONTRADICT = -11
    RATE_JUMPS = -12
    WRONG_TRACE = -13


def failure_link(status: Status) -> str:
    """Return a sentence that refers to the section of docs/when_it_fails.md about a failure; "" after success."""
    return "" if status >= 0 else f" See docs/when_it_fails.md#{status.name.lower()}."


@dataclass(frozen=True)
class Statistics:
    """Counts and CPU time of a run; None for a count that an external solver does not report.

    Attributes
    ----------
    n_accepted, n_rejected_error, n_rejected_convergence : int or None
        Steps accepted, steps that failed the error test, steps whose outer or inner loop did not converge.
    n_outer : int or None
        Iterations of the outer loop (each evaluates every stage once).
    n_inner : int or None
        Newton iterations of the inner loop.
    n_evaluations : int or None
        Solutions of the linear equations (6) of the paper for accelerations and multipliers; also evaluations of the
        forces alone, for the derivatives of a banded system.
    n_partitions : int or None
        Coordinate partitionings, the first included.
    n_factorizations : int or None
        Matrix factorisations: of C_qd (the dependent columns of C_q), of C_q M^-1 C_q^T, of M where it is not constant,
        of the partitionings, and for Newton's method in the outer loop.
    n_jacobians : int or None
        Evaluations of the derivatives of the right-hand side for Newton's method in the outer loop.
    cpu_time : float
        Process time of the integration, s. It includes the steps, storing their results, events, and the interpolation
        of q and v at output times. Compilation, checks of the input, the workspace, the first accelerations, and a and
        lam at interpolated times are not included. If a run was repeated, the time includes all attempts, while the
        counts belong to the last attempt. For repeated calls of less than a millisecond, it is the elapsed time.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0)
    >>> result.stats.n_accepted == result.t.size - 1, result.stats.n_evaluations > 0
    (True, True)
    """

    n_accepted: int | None = None
    n_rejected_error: int | None = None
    n_rejected_convergence: int | None = None
    n_outer: int | None = None
    n_inner: int | None = None
    n_evaluations: int | None = None
    n_partitions: int | None = None
    n_factorizations: int | None = None
    n_jacobians: int | None = None
    cpu_time: float = 0.0


@dataclass(frozen=True)
class Record:
    """Trajectory, status and cost of a run; the docstring of `Result` explains the fields."""

    t: Array
    q: Array
    v: Array
    a: Array
    lam: Array
    h: Array
    status: Status
    message: str
    stats: Statistics
    rejected_error: NDArray[np.int64] | None = None
    rejected_convergence: NDArray[np.int64] | None = None
    partitioned: NDArray[np.int64] | None = None
    rank: int | None = None
    redundant: NDArray[np.int64] | None = None
    sol: DenseSolution | None = None
    t_events: list[Array] | None = None
    q_events: list[Array] | None = None
    v_events: list[Array] | None = None
    defect: float | None = None
    widest_gap: float | None = None
    t_end: float | None = None
    system: ConstrainedSystem | None = None
    method: str = ""
    compiled: bool | None = None
    rtol: float | None = None
    atol: Array | None = None
    untested: NDArray[np.bool_] | None = None
    changes: str = ""
    arcs: tuple[Any, ...] = ()
    impacts: tuple[Any, ...] = ()

    @property
    def success(self) -> bool:
        """Whether the run reached its end or an event."""
        return self.status >= 0

    @property
    def description(self) -> Description:
        """Names, energy and drawing, if the system belongs to a `Problem` that has them."""
        return Description() if self.system is None else self.system.description

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates with their units; q0, q1, ... if the problem has no names."""
        return self.description.coordinates or tuple(f"q{k}" for k in range(len(self.q)))

    @property
    def energy(self) -> Array:
        """Energy (J) at the times `t`, an array (n_t,).

        Raises
        ------
        ValueError
            If no energy is known: the system was solved without a `Problem`, or the result has no system.
        """
        return np.asarray(self._description_value("energy")(self.t, self.q, self.v))

    def _description_value(self, what: str) -> Any:
        """Return the attribute `what` of the description; if it is None, raise a ValueError that says how to set it."""
        value = getattr(self.description, what)
        if value is None:
            raise ValueError(
                f"this result knows no {what}: put the system into a problem, twoloop.mechanisms.Problem(..., "
                f"system=system, {what}=...), and solve problem.system. To a result in a file, or of another solver, "
                "give the system: twoloop.load(path, problem.system), dataclasses.replace(result, "
                "system=problem.system)"
            )
        return value

    def __getstate__(self) -> dict[str, Any]:
        state = {each.name: getattr(self, each.name) for each in fields(self)}
        try:
            pickle.dumps(self.system)
        except TypeError:  # lambdas and local functions cannot be pickled
            state["system"] = None
        if self.arcs:
            state |= {"arcs": (), "sol": None}
        return state

    def __repr__(self) -> str:
        by_name = {f.name: getattr(self.stats, f.name) for f in fields(self.stats)}
        counts = ", ".join(f"{name}={value}" for name, value in by_name.items() if value is not None)
        end = f"t[-1]={self.t[-1]:g}" if self.t.size else "no output"
        return f"Result({self.status.name}: {self.message} n_t={self.t.size}, {end}; {counts})"


def record_of(kind: type[AnyRecord], fields: dict[str, Any]) -> AnyRecord:
    """Return a record of the class `kind` with the attributes `fields`; the constructor of the class is slower."""
    instance = _new_object(kind)
    _set_fields(instance, fields)
    return instance


_new_object, _set_fields = object.__new__, vars(Record)["__dict__"].__set__


class _Deferred:
    """Descriptor of a record's field: the function `vars(record)["later"]` computes a missing value when first read."""

    def __init__(self, name: str):
        self.name = name

    def __get__(self, record: Any, owner: Any = None) -> Any:
        values = {} if record is None else vars(record)
        if "later" not in values:
            raise AttributeError(self.name)  # the field is read from the class, or the record has no function `later`
        values.update(values["later"](self.name) | values)
        return values[self.name]


DEFAULTS = {each.name: each.default for each in fields(Record) if each.default is not MISSING}
for _field in fields(Record):  # not within the class, where `dataclass` would take descriptors for default values
    setattr(Record, _field.name, _Deferred(_field.name))


Integers = NDArray[np.int64]

COUNT_NAMES = [each.name for each in fields(Statistics) if each.name != "cpu_time"]
GET_COUNTS = itemgetter(*(getattr(indices, name.upper()) for name in COUNT_NAMES))
# three counts before the first step: steps rejected by the error test; steps rejected because an iteration did not
# converge; partitions (one, chosen at the start)
INITIAL_COUNTS = np.array([0, 0, 1])


def step_fields(steps: Array, counts: Integers) -> dict[str, NDArray[Any]]:
    """Return the fields of a record with one row per step, such as h; `steps`: rows of `out_steps` (loop_state.py).

    `counts`: the three counts of INITIAL_COUNTS before these steps; on return, after these steps.
    """
    n = len(steps)
    h, changes, untested = np.empty(n), np.empty((3, n), dtype=np.int64), np.empty(n, dtype=np.bool_)
    entry_point(cached_run().split_steps)(steps, counts, h, changes, untested)
    return dict(zip(STEP_ARRAYS, (h, *changes, untested), strict=True))


def statistics(counters: Integers, cpu: float) -> Statistics:
    """Return the Statistics of a run, given the array of counters of its workspace, and its CPU time (s)."""
    return Statistics(**dict(zip(COUNT_NAMES, GET_COUNTS(counters.tolist()), strict=True)), cpu_time=cpu)


def state_fields(n: int, t: Array, table: Array) -> dict[str, Array]:
    """Return the fields t, q, v, a and lam of a record with n coordinates; `table`: rows [q, v, a, lam] at times t."""
    columns = table.T
    return {"t": t, "q": columns[:n], "v": columns[n : 2 * n], "a": columns[2 * n : 3 * n], "lam": columns[3 * n :]}


def interval_kinds(run: "Run", steps: Array) -> Integers:
    """Return the kind of interval (a code) of each step, for dense output; no step may be a crossing or a jump."""
    if run.plan.separate:
        return np.full(len(steps), indices.SEPARATE)
    explicit_kind = indices.ACROSS if run.substituted else indices.ACCELERATIONS
    return np.where(steps[:, run.a.JACOBIANS] > 0.0, indices.VELOCITIES, explicit_kind)

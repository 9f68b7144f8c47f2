"""Record of a run: its trajectory, how it ended and what it cost. `Result` adds views to it."""

import pickle
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from enum import IntEnum
from operator import itemgetter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import indices
from twoloop.kernels.layout import cached_run
from twoloop.problem.description import Description
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.dense_solution import DenseSolution
from twoloop.run.recorder import OF_STEPS

if TYPE_CHECKING:
    from twoloop.run.run import Run

Array = NDArray[np.float64]
AnyRecord = TypeVar("AnyRecord", bound="Record")
Later = Callable[[str], dict[str, Any]]  # takes the name of a field, and returns it with others by their names


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


MEANINGS: dict[Status, str] = {
    Status.REACHED_END: "the end of t_span was reached",
    Status.EVENT: "an event ended the run",
    Status.STEP_TOO_SMALL: "the step size fell below the spacing of floating-point numbers",
    Status.MAX_STEPS: "max_steps accepted steps were taken",
    Status.NOT_CONVERGED: "a step of fixed size did not converge, or gamma by differences misses the tolerance",
    Status.NOT_FINITE: "a callback returned a value that is not finite, or the state overflowed",
    Status.RANK_LOST: "the constraint Jacobian lost rank: no choice of independent coordinates exists",
    Status.SOLVER_FAILED: "a solver of another project failed, or reached the time limit of its adapter",
    Status.INTERRUPTED: "the run was interrupted from the keyboard",
    Status.STAGNATED: "the steps became so short that the end is out of reach",
    Status.WRONG_DERIVATIVE: "a derivative that the system gives is wrong, or M not symmetric, at a state of the run",
    Status.TIME_LIMIT: "the run reached its time_limit",
    Status.ROWS_CONTRADICT: "a constraint that depended on others at the start is violated",
    Status.RATE_JUMPS: "constraint_rate or nonholonomic_rate jumps, and no impulse gives velocities that are allowed",
    Status.WRONG_TRACE: "a callback gives other values than the operations that were recorded of it, or than before",
}


def explained(status: Status) -> str:
    """Return the sentence that names the page about a failure, for the end of its message; empty after success."""
    return "" if status >= 0 else f" See docs/when_it_fails.md#{status.name.lower()}."


@dataclass(frozen=True)
class Statistics:
    """Counts and CPU time of a run; None where a foreign solver does not tell.

    Attributes
    ----------
    n_accepted, n_rejected_error, n_rejected_convergence : int or None
        Steps accepted, steps that failed the error test, steps whose loops did not converge.
    n_outer : int or None
        Iterations of the outer loop (each evaluates every stage once).
    n_inner : int or None
        Newton iterations of the inner loop.
    n_evaluations : int or None
        Solutions of eq. (6) for accelerations and multipliers, and evaluations of the forces alone, with which the
        derivatives of a banded system are computed.
    n_partitions : int or None
        Coordinate partitionings, the first included.
    n_factorizations : int or None
        Matrix factorisations: of C_qd, of C_q M^-1 C_q^T, of M where it is not constant, of the partitionings,
        and for Newton's method in the outer loop.
    n_jacobians : int or None
        Evaluations of the derivatives of the right-hand side for Newton's method in the outer loop.
    cpu_time : float
        Process time of the integration, s: of the steps, of storing what they give, of events, and of q and v at output
        times between them. Compilation, checks of the input, the workspace, the first accelerations, and a and lam at
        output times between steps are not included. If a run was repeated, the time includes all attempts, while the
        counts are those of the last one. For repeated calls that take less than a millisecond, it is the elapsed time.

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
    """Trajectory, status and cost of a run: the fields of `Result`, which explains them."""

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
        """Names, energy and drawing, as far as the `Problem` of the system gave them."""
        return Description() if self.system is None else self.system.description

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the coordinates with their units; q0, q1, ... where the problem has none."""
        return self.description.coordinates or tuple(f"q{k}" for k in range(len(self.q)))

    @property
    def energy(self) -> Array:
        """Energy at the times `t`, J, (n_t,).

        Raises
        ------
        ValueError
            If no energy is known: the system was solved without a `Problem`, or the result has no system.
        """
        return np.asarray(self._known("energy")(self.t, self.q, self.v))

    def _known(self, what: str) -> Any:
        """Return the energy or the drawing; if there is none, raise an error that says how to get it."""
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
        except TypeError:  # functions without a name of their own cannot be pickled
            state["system"] = None
        if self.arcs:
            state |= {"arcs": (), "sol": None}
        return state

    def __repr__(self) -> str:
        known = {f.name: getattr(self.stats, f.name) for f in fields(self.stats)}
        counts = ", ".join(f"{name}={value}" for name, value in known.items() if value is not None)
        end = f"t[-1]={self.t[-1]:g}" if self.t.size else "no output"
        return f"Result({self.status.name}: {self.message} n_t={self.t.size}, {end}; {counts})"


def record_of(kind: type[AnyRecord], fields: dict[str, Any]) -> AnyRecord:
    """Create a record of these fields, which it takes over: the constructor of a large frozen dataclass is slow."""
    instance = _new(kind)
    _set_fields(instance, fields)
    return instance


_new, _set_fields = object.__new__, vars(Record)["__dict__"].__set__


class _Deferred:
    """Descriptor that defers a field until it is first read: if a record lacks it, its `later` computes it.

    `later` is kept beside the fields in `vars(record)`.
    """

    def __init__(self, name: str):
        self.name = name

    def __get__(self, record: Any, owner: Any = None) -> Any:
        known = {} if record is None else vars(record)
        if "later" not in known:
            raise AttributeError(self.name)  # also on the class: the default is in the dataclass field
        known.update(known["later"](self.name) | known)
        return known[self.name]


DEFAULTS = {each.name: each.default for each in fields(Record) if each.default is not MISSING}
for _field in fields(Record):  # after the decorator, which would take a descriptor for a default
    setattr(Record, _field.name, _Deferred(_field.name))


Integers = NDArray[np.int64]

COUNTED = [each.name for each in fields(Statistics) if each.name != "cpu_time"]
COUNTERS = itemgetter(*(getattr(indices, name.upper()) for name in COUNTED))
BEFORE = np.array([0, 0, 1])  # rejections and partitions before all steps: the first partition is not a renewal


def step_fields(steps: Array, counts: Integers) -> dict[str, NDArray[Any]]:
    """Return the fields of a record with one row per step; `counts`, those before the steps, become those after."""
    n = len(steps)
    h, changes, untested = np.empty(n), np.empty((3, n), dtype=np.int64), np.empty(n, dtype=np.bool_)
    entry_point(cached_run().split_steps)(steps, counts, h, changes, untested)
    return dict(zip(OF_STEPS, (h, *changes, untested), strict=True))


def statistics(counted: Integers, cpu: float) -> Statistics:
    """Return the statistics of a run, from the counts of its workspace and its CPU time, s."""
    return Statistics(**dict(zip(COUNTED, COUNTERS(counted.tolist()), strict=True)), cpu_time=cpu)


def of_run(run: "Run", t: Array, table: Array) -> dict[str, Any]:
    """Return the fields of the trajectory, from rows [q, v, a, lam], and those of the run as a whole."""
    return {
        **state_fields(run.system.n_q, t, table),
        "rank": run.rank,
        "redundant": run.redundant.copy(),  # runs from one start share this array
        "defect": run.defect(),
        "widest_gap": float(run.work.notes[indices.WIDEST_GAP]),
    }


def state_fields(n: int, t: Array, table: Array) -> dict[str, Array]:
    """Return the fields of a trajectory of n coordinates, from its rows."""
    columns = table.T
    return {
        "t": t,
        "q": columns[:n],
        "v": columns[n : 2 * n],
        "a": columns[2 * n : 3 * n],
        "lam": columns[3 * n :],
    }


def interval_kinds(run: "Run", steps: Array) -> Integers:
    """Return the kind of interval of each step that the plan of the run made, for the dense solution."""
    if run.plan.apart:
        return np.full(len(steps), indices.APART)
    explicit = indices.ACROSS if run.substituted else indices.ACCELERATIONS
    return np.where(steps[:, run.a.JACOBIANS] > 0.0, indices.VELOCITIES, explicit)

"""Compare traced callbacks in numbers with what they return when they are called.

A trace is wrong if the callback branches undetected, keeps something from call to call, or reads data that change and
are not its arguments (a global that numba froze when it compiled it). Before a run, both are compared at states near
the start and at times spread over the run; later at states of the run itself.
"""

import copy
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.scales import sizes
from twoloop.generate.graph import Graph, Untraceable
from twoloop.generate.program import OperationTable
from twoloop.generate.trace import Evaluator
from twoloop.kernels.compile.linking import entry_point
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

# kinds of callbacks that are traced, in the order in which the kernel calls them
KINDS = (
    *("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma"),
    *("nonholonomic", "nonholonomic_rate", "nonholonomic_gamma"),
)
AROUND = 8  # number of random states near the start at which traces are compared, beside the start
TIMES = np.linspace(0.0, 1.0, AROUND)  # their times, as shares of the run
AWAY = 0.3  # their distance from the start, as a share of the size of coordinates
EACH, MOST = 32, 64  # largest number of states of a chunk of a run, and of a whole run ...
FEW = 9  # ... and of a run whose callbacks are called in Python
ENTRIES = 20_000  # entries of callbacks compared in a run, about: large systems are compared at fewer states
LOST = 16.0 * np.finfo(float).eps  # relative to the largest term of a kind: a smaller difference is rounding
# relative to the largest term: a smaller difference counts only if it is the same at neighbouring states, ...
CLEAR = 1e-6
NEXT = 1e-7  # ... which differ by this relative change
NEIGHBOURS = 12
MARGIN = 0.01  # margin of a CheckedRegion, as a share of its sides; small beside the distance between states of a run
AT_REST = 1e-9  # margin relative to the longest side (time excluded): for coordinates at rest


class Traced:
    """Traced callbacks as an operation table, to be compared with calls of the callbacks.

    Parameters
    ----------
    system : ConstrainedSystem
    graph : Graph
        The graph of the trace, whose first inputs are t, q and v.
    forms : mapping or None
        Results of the callbacks as traced, by kind. None: the traces of the callbacks that the system has.
    """

    def __init__(self, system: ConstrainedSystem, graph: Graph, forms: Mapping[str, Any] | None = None):
        if forms is None:
            forms = {kind: results for kind, results in graph.traced.items() if kind in system.given}
        kinds = [kind for kind in KINDS if kind in forms and forms[kind].size]
        self.places = [(kind, place) for kind in kinds for place in np.ndindex(forms[kind].shape)]
        self.n_of = np.array([forms[kind].size for kind in kinds], dtype=np.int64)
        self.which = np.array([kind in kinds for kind in KINDS], dtype=np.int64)
        self.sizes = np.array([system.n_q, system.n_c, system.n_a], dtype=np.int64)
        self.name = system.name
        self.kinds = frozenset(graph.traced)  # kinds that were traced
        self.trusted = False
        entries = (forms[kind][place] for kind, place in self.places)
        # entries that are always zero need no comparison
        results = {k: form for k, form in enumerate(entries) if form.terms or form.constant}
        self.not_zero = frozenset(self.places[k][0] for k in results)  # kinds of callbacks that are not all zero
        self.program = OperationTable.of(graph, 1 + 2 * system.n_q, results)

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Traced":
        """Return the traces of another system of the same cache, with the numbers of its parameters."""
        traced = self.with_numbers(evaluate)
        traced.name = system.name
        return traced

    def with_numbers(self, numbers_for: Callable[[Any], Array]) -> "Traced":
        """Return a copy with other numbers in the operation table; it is not trusted yet."""
        traced = copy.copy(self)
        traced.program = self.program.with_numbers(numbers_for)
        traced.trusted = False
        return traced

    def refuse(self, system: ConstrainedSystem, t0: float, t1: float, q: Array, v: Array) -> None:
        """Compare calls and traces at states near the start of a run, see `refuse_wrong`."""
        refuse_wrong([self], system, t0, t1, q, v)

    def check_around(self, system: ConstrainedSystem, around: Array) -> None:
        """Compare calls and traces at states whose first row is the start; raise Untraceable if they differ."""
        wrong = None
        for states in (around, *around[:, None, :]):  # all at once; one by one if a call raises
            try:
                wrong = wrong or self.wrong(system, states, everywhere=False)
            except Exception:  # the state is outside the domain of the callbacks
                continue
            if states is around:
                break
        if wrong is not None:
            raise Untraceable(wrong)
        self.trusted = not system.called_in_python  # compiled callbacks never change

    def wrong(self, system: ConstrainedSystem, states: Array, everywhere: bool = True) -> str | None:
        """Describe the first difference between calls and traces at states [t, q, v]; None if there is none.

        `everywhere`: states at which a call is not finite count, too: the trace must not be finite there either.
        """
        from twoloop.kernels.evaluation import checks as kernels

        most = FEW if system.called_in_python else MOST
        states = states[:: 1 + max(len(states) // most, len(states) * len(self.places) // ENTRIES)]
        n_different, called, traced, bounds = self._evaluate(system, states)
        if n_different == 0:
            return None
        finite = np.isfinite(called)
        with np.errstate(all="ignore"):
            largest = np.abs(np.where(finite, called, 0.0)).max(axis=0)
            off = np.abs(called - traced)
            same = off <= kernels.SAME * largest + kernels.ROUNDED * bounds
        if everywhere:
            same |= ~finite & ~np.isfinite(traced)
        else:
            same |= ~finite
        largest = np.where(np.isfinite(bounds), bounds, 0.0).max(axis=0)
        # the largest term of the kind of each entry
        size = np.repeat(np.maximum.reduceat(largest, np.cumsum(self.n_of) - self.n_of), self.n_of)
        for k, entry in np.argwhere(~same & ~(off <= LOST * size)):
            if not off[k, entry] <= CLEAR * size[entry] or self._stays(system, states[k], int(entry)):
                return self._message(states[k], int(entry), called[k, entry], traced[k, entry])
        return None

    def _evaluate(self, system: ConstrainedSystem, states: Array) -> tuple[int, Array, Array, Array]:
        from twoloop.kernels.evaluation import checks as kernels

        called, traced, bounds = np.zeros((3, len(states), len(self.places)))
        n_different = entry_point(kernels.compare)(
            system.kit,
            self.sizes,
            self.which,
            np.ascontiguousarray(states),
            *self.program[:-1],
            np.zeros((2, self.program.n_nodes)),
            called,
            traced,
            bounds,
        )
        return n_different, called, traced, bounds

    def _stays(self, system: ConstrainedSystem, state: Array, entry: int) -> bool:
        """Return whether a difference is about the same at neighbouring states; rounding errors are not."""
        parts = np.random.default_rng(5).uniform(-1.0, 1.0, (NEIGHBOURS, len(state)))
        _, called, traced, _ = self._evaluate(system, state * (1.0 + NEXT * parts))
        off = (called - traced)[:, entry]
        return bool(np.abs(off).min() > 0.5 * np.abs(off).max() and np.abs(off.sum()) == np.abs(off).sum())

    def _message(self, state: Array, entry: int, called: float, traced: float) -> str:
        kind, place = self.places[entry]
        where = place[0] if len(place) == 1 else tuple(place)
        return (
            f"{kind} of {self.name!r} does not give what its operations give, which were recorded once: at t = "
            f"{state[0]:.10g} entry {where} is {called:.9g}, and by these {traced:.9g}. It depends on more than its "
            "arguments (a variable outside that changed after numba compiled it, random numbers, what it keeps from "
            "call to call), or branches unseen"
        )


class Sample:
    """A sample of the states [t, q, v] of a run, from its start to its present time."""

    def __init__(self, t: float, state: Array, n: int) -> None:
        self._n, self._parts = n, list[Array]()
        self.add(state[:0], state[None, :][:0], t, state)

    def add(self, t: Array, rows: Array, end: float, state: Array) -> None:
        """Add states of a chunk of the run, whose rows begin with [q, v], and its last state."""
        stride = 1 + len(t) // EACH
        some = t[::stride]
        part = np.empty((len(some) + 1, 1 + self._n))
        part[0, 0], part[0, 1:] = end, state[: self._n]
        part[:0:-1, 0], part[:0:-1, 1:] = some, rows[::stride, : self._n]
        self._parts.insert(0, part)
        if len(self._parts) > MOST:
            self._parts = self._parts[::2]

    def end(self, t: float, state: Array) -> None:
        """Drop states after a time, and add the state at that time."""
        states = self.states()
        self._parts = [states[states[:, 0] <= t]]
        self.add(states[:0, 0], states[:0], t, state)

    def states(self) -> Array:
        """Return all states, the latest first."""
        return np.concatenate(self._parts)


def refuse_wrong(traced: Sequence[Traced], system: ConstrainedSystem, t0: float, t1: float, q: Array, v: Array) -> None:
    """Compare traces that are not trusted yet with calls, at states near the start and at times spread over the run.

    Raises
    ------
    Untraceable
        If a trace is wrong; the message names the callback and the entry.
    """
    new = [each for each in traced if not each.trusted]
    if not new:
        return
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        around = states_around(t0, t1, q, v)
        for each in new:
            each.check_around(system, around)


Check = Callable[[Traced], None]


def unchecked(traced: Traced) -> None:
    """Accept traces without a comparison, as no run uses their results."""


def states_around(t0: float, t1: float, q: Array, v: Array) -> Array:
    """Return the start [t, q, v], and random states near it at times spread over the run."""
    size = sizes(q)
    speed = np.maximum(size, np.abs(v))
    n, parts = len(q), _parts(len(q))
    states = np.empty((1 + AROUND, 1 + 2 * n))
    states[0, 0], states[0, 1 : 1 + n], states[0, 1 + n :] = t0, q, v
    states[1:, 0] = t0 + (t1 - t0) * TIMES
    states[1:, 1 : 1 + n] = q + AWAY * size * parts[0]
    states[1:, 1 + n :] = speed * parts[1]
    return states


@cache
def _parts(n_q: int) -> Array:
    """Return fixed random numbers between -1 and 1, (2, AROUND, n_q)."""
    return np.random.default_rng(6).uniform(-1.0, 1.0, (2, AROUND, n_q))


def farthest(t: Array, rows: Array) -> Array:
    """Return the states [t, q, v] of a run at which a component is smallest or largest; `rows` are [q, v]."""
    states = np.column_stack([t, rows])
    return states[np.unique([states.argmin(axis=0), states.argmax(axis=0)])]


class CheckedRegion:
    """Region of [t, q, v] and of parameters in which callbacks agreed with their traces: two boxes.

    Attributes
    ----------
    known : ndarray (2, 1 + 2 n_q) or (2, 0)
        Least and largest components of the states that need no new comparison.
    """

    def __init__(self) -> None:
        self._runs = 0
        self._parameters: tuple[Array, Array] | None = None  # least and largest parameters of runs of many systems
        self._box = np.zeros((2, 0))  # least and largest value of each component
        self.known = self._box

    def is_due(self) -> bool:
        """Return whether the next run must compare at all its states; it is for the runs 1, 2, 4, 8, ..."""
        return (self._runs + 1) & self._runs == 0

    def count(self) -> None:
        """Count one more run."""
        self._runs += 1

    def without_known(self, states: Array) -> Array:
        """Return the states outside the region, with its margin."""
        if not self._box.size:
            return states
        least, largest = self.known
        new = (states < least) | (states > largest)
        return states[new.any(axis=1)] if new.any() else states[:0]

    def knows(self, parameters: Array) -> bool:
        """Return whether parameters lie in the region, with its margin."""
        if self._parameters is None:
            return False
        least, largest = self._parameters
        beside = MARGIN * (largest - least)
        return bool((least - beside <= parameters).all() and (parameters <= largest + beside).all())

    def add_parameters(self, parameters: Array) -> None:
        """Extend the region by the parameters of a run without differences."""
        least, largest = self._parameters or (parameters, parameters)
        self._parameters = np.minimum(least, parameters), np.maximum(largest, parameters)

    def add(self, states: Array) -> None:
        """Extend the region by states of a run without differences."""
        if len(states) == 0:
            return
        checked = np.concatenate([states, self._box]) if self._box.size else states
        least, largest = self._box = np.array([checked.min(axis=0), checked.max(axis=0)])
        beside = MARGIN * (largest - least) + AT_REST * float((largest - least)[1:].max())
        self.known = np.array([least - beside, largest + beside])

"""Compare the values of traces with the values that calls of the callbacks return.

A trace is wrong if tracing did not detect that the callback branches, if the callback stores data between calls, or if
it reads data other than its arguments (a compiled callback uses the value of a global variable at compilation). Before
a run, values are compared at states near the start, with times spread over the run; after a run, at states of the run.
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
from twoloop.kernels.data.common import Kit
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

# callbacks whose traces are compared with calls, in the order in which the kernel calls them
KINDS = (
    *("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma"),
    *("nonholonomic", "nonholonomic_rate", "nonholonomic_gamma"),
)
N_NEARBY = 8  # before a run, calls and traces are compared at the start, and at this number of random states nearby
RELATIVE_TIMES = np.linspace(0.0, 1.0, N_NEARBY)  # times of the random states, from 0 (start of the run) to 1 (its end)
NEARBY_DISTANCE = 0.3  # largest distance of a random position from the start, relative to the sizes of the coordinates
MAX_STATES_OF_CHUNK = 32  # a `Sample` takes at most about this number of states from one chunk of steps
MAX_STATES = 64  # largest number of states in a comparison, and of chunks of steps from which a `Sample` keeps states
MAX_STATES_IN_PYTHON = 9  # replaces MAX_STATES if the callbacks are called in Python
MAX_ENTRIES = 20_000  # so few states are compared that (states) * (results per state) does not much exceed this
# the scale of a callback's rounding errors: the largest bound on errors of its results, divided by EPS (see checks.py)
ROUNDING_DIFFERENCE = 16.0 * np.finfo(float).eps  # differences up to this * (scale of rounding errors) are harmless
CLEAR_DIFFERENCE = 1e-6  # a trace is wrong if a difference exceeds this * (scale of rounding errors), or is systematic
# `_is_systematic` compares call and trace at N_NEIGHBOURS states, at most PERTURBATION (relative) from a given state
PERTURBATION, N_NEIGHBOURS = 1e-7, 12
MARGIN = 0.01  # a CheckedRegion extends the range of each entry of checked states [t, q, v] by this * (max - min)
MARGIN_AT_REST = 1e-9  # each range also grows by this * (largest range of q and v), as coordinates at rest have range 0


class CallbackTraces:
    """Traces of callbacks as an operation table, to be compared with calls of the callbacks.

    graph : the graph of the trace, whose first inputs are t, q and v.
    exprs : traced results to compare, as arrays of expressions; keys: names of callbacks, such as "mass". None: all
        results in `graph.traced` for which the system has a callback.
    is_trusted (field) : True if calls and traces agreed near a start; later runs then skip this comparison.
    """

    def __init__(self, system: ConstrainedSystem, graph: Graph, exprs: Mapping[str, Any] | None = None):
        if exprs is None:
            exprs = {kind: results for kind, results in graph.traced.items() if kind in system.given}
        kinds = [kind for kind in KINDS if kind in exprs and exprs[kind].size]
        self.entry_indices = [(kind, index) for kind in kinds for index in np.ndindex(exprs[kind].shape)]
        self.n_entries = np.array([exprs[kind].size for kind in kinds], dtype=np.int64)
        self.is_compared = np.array([kind in kinds for kind in KINDS], dtype=np.int64)
        self.sizes = np.array([system.n_q, system.n_c, system.n_a], dtype=np.int64)
        self.name = system.name
        self.kinds = frozenset(graph.traced)  # names of all callbacks that were traced, even if not compared
        self.is_trusted = False
        entries = (exprs[kind][index] for kind, index in self.entry_indices)
        # entries that are always zero are left out of the table
        results = {k: expr for k, expr in enumerate(entries) if expr.terms or expr.constant}
        self.nonzero_kinds = frozenset(self.entry_indices[k][0] for k in results)
        self.program = OperationTable.from_results(graph, 1 + 2 * system.n_q, results)

    def specialize(self, system: ConstrainedSystem, evaluate: Evaluator) -> "CallbackTraces":
        """Return a copy for `system`; `evaluate`: function that computes coefficients for the system's parameters."""
        traced = self.replace_coefficients(evaluate)
        traced.name = system.name
        return traced

    def replace_coefficients(self, convert: Callable[[Any], Array]) -> "CallbackTraces":
        """Return a copy, with `is_trusted` = False, in which convert(array) replaces each array of coefficients."""
        traced = copy.copy(self)
        traced.program = self.program.replace_coefficients(convert)
        traced.is_trusted = False
        return traced

    def refuse_if_wrong(self, system: ConstrainedSystem, t0: float, t1: float, q: Array, v: Array) -> None:
        """Compare calls and traces at states near the start of a run; raise Untraceable if they differ."""
        refuse_wrong_traces([self], system, t0, t1, q, v)

    def check_near_start(self, system: ConstrainedSystem, nearby: Array) -> None:
        """Compare calls and traces at states near a start; if they differ, raise Untraceable, else set `is_trusted`."""
        difference = None
        for states in (nearby, *nearby[:, None, :]):  # take all states at once; if a call raises, one by one
            try:
                difference = difference or self.difference(system, states, everywhere=False)
            except Exception:  # a callback is not defined at one of these states
                continue
            if states is nearby:
                break
        if difference is not None:
            raise Untraceable(difference)
        self.is_trusted = not system.called_in_python  # compiled callbacks never change; others are compared again

    def difference(self, system: ConstrainedSystem, states: Array, everywhere: bool = True) -> str | None:
        """Return a message about the first difference of calls and traces at states [t, q, v], or None if they agree.

        If `everywhere`, the trace must not be finite where a call returns NaN or inf; if not `everywhere`, it may be.
        """
        from twoloop.kernels.evaluation import checks as kernels

        kit, max_states = system.kit, MAX_STATES_IN_PYTHON if system.called_in_python else MAX_STATES
        states = states[:: 1 + max(len(states) // max_states, len(states) * len(self.entry_indices) // MAX_ENTRIES)]
        n_different, called, traced, bounds = self._evaluate(kit, states)
        if n_different == 0:
            return None
        finite = np.isfinite(called)
        with np.errstate(all="ignore"):
            largest = np.abs(np.where(finite, called, 0.0)).max(axis=0)
            differences = np.abs(called - traced)
            is_agreeing = differences <= kernels.MAX_DIFFERENCE * largest + kernels.ROUNDING_FACTOR * bounds
        if everywhere:
            is_agreeing |= ~finite & ~np.isfinite(traced)
        else:
            is_agreeing |= ~finite
        largest = np.where(np.isfinite(bounds), bounds, 0.0).max(axis=0)
        # the scale of an entry is the largest bound on rounding errors among all entries of its callback
        scales = np.repeat(np.maximum.reduceat(largest, np.cumsum(self.n_entries) - self.n_entries), self.n_entries)
        for k, entry in np.argwhere(~is_agreeing & ~(differences <= ROUNDING_DIFFERENCE * scales)):
            if not differences[k, entry] <= CLEAR_DIFFERENCE * scales[entry] or self._is_systematic(
                system, states[k], int(entry)
            ):
                return self._message(states[k], int(entry), called[k, entry], traced[k, entry])
        return None

    def _evaluate(self, kit: Kit, states: Array) -> tuple[int, Array, Array, Array]:
        from twoloop.kernels.evaluation import checks as kernels

        called, traced, bounds = np.zeros((3, len(states), len(self.entry_indices)))
        n_different = entry_point(kernels.compare_traces)(
            kit,
            self.sizes,
            self.is_compared,
            np.ascontiguousarray(states),
            *self.program[:-1],
            np.zeros((2, self.program.n_nodes)),
            called,
            traced,
            bounds,
        )
        return n_different, called, traced, bounds

    def _is_systematic(self, system: ConstrainedSystem, state: Array, entry: int) -> bool:
        """Return True if errors of a traced `entry` have one sign and similar sizes near `state`, unlike rounding."""
        directions = np.random.default_rng(5).uniform(-1.0, 1.0, (N_NEIGHBOURS, len(state)))
        _, called, traced, _ = self._evaluate(system.kit, state * (1.0 + PERTURBATION * directions))
        errors = (called - traced)[:, entry]
        return bool(np.abs(errors).min() > 0.5 * np.abs(errors).max() and np.abs(errors.sum()) == np.abs(errors).sum())

    def _message(self, state: Array, entry: int, called: float, traced: float) -> str:
        kind, index = self.entry_indices[entry]
        position = index[0] if len(index) == 1 else tuple(index)
        return (
            f"{kind} of {self.name!r} does not give what its operations give, which were recorded once: at t = "
            f"{state[0]:.10g} entry {position} is {called:.9g}, and by these {traced:.9g}. It depends on more than its "
            "arguments (a variable outside that changed after numba compiled it, random numbers, what it keeps from "
            "call to call), or branches unseen"
        )


class Sample:
    """All or some states [t, q, v] of a run, to compare callbacks with their traces later; `n`: length of [q, v]."""

    def __init__(self, t: float, state: Array, n: int) -> None:
        self._n, self._chunks = n, list[Array]()
        self.add(state[:0], state[None, :][:0], t, state)

    def add(self, t: Array, rows: Array, end: float, state: Array) -> None:
        """Add states [q, v, ...]: `rows` at times `t` (only some of them if there are many), and `state` at `end`."""
        stride = 1 + len(t) // MAX_STATES_OF_CHUNK
        times = t[::stride]
        states = np.empty((len(times) + 1, 1 + self._n))
        states[0, 0], states[0, 1:] = end, state[: self._n]
        states[:0:-1, 0], states[:0:-1, 1:] = times, rows[::stride, : self._n]
        self._chunks.insert(0, states)
        if len(self._chunks) > MAX_STATES:
            self._chunks = self._chunks[::2]

    def end_at(self, t: float, state: Array) -> None:
        """Remove the states after t, the end of the run, and add the state at t."""
        states = self.states()
        self._chunks = [states[states[:, 0] <= t]]
        self.add(states[:0, 0], states[:0], t, state)

    def states(self) -> Array:
        """Return the states as rows [t, q, v], the latest first."""
        return np.concatenate(self._chunks)


def refuse_wrong_traces(
    traced: Sequence[CallbackTraces], system: ConstrainedSystem, t0: float, t1: float, q: Array, v: Array
) -> None:
    """Compare traces that are not `is_trusted` with calls near the start; raise Untraceable if a trace is wrong."""
    untrusted = [trace for trace in traced if not trace.is_trusted]
    if not untrusted:
        return
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        nearby = states_near_start(t0, t1, q, v)
        for trace in untrusted:
            trace.check_near_start(system, nearby)


Check = Callable[[CallbackTraces], None]  # function that compares traces with calls; raises Untraceable if they differ


def accept_traces(traced: CallbackTraces) -> None:
    """Accept traces without a comparison with calls, for traces that compute no motion or are compared later."""


def states_near_start(t0: float, t1: float, q: Array, v: Array) -> Array:
    """Return rows [t, q, v]: the start, and N_NEARBY random states near it, with times spread over the whole run."""
    scales = sizes(q)
    speed = np.maximum(scales, np.abs(v))
    n, directions = len(q), _random_directions(len(q))
    states = np.empty((1 + N_NEARBY, 1 + 2 * n))
    states[0, 0], states[0, 1 : 1 + n], states[0, 1 + n :] = t0, q, v
    states[1:, 0] = t0 + (t1 - t0) * RELATIVE_TIMES
    states[1:, 1 : 1 + n] = q + NEARBY_DISTANCE * scales * directions[0]
    states[1:, 1 + n :] = speed * directions[1]
    return states


@cache
def _random_directions(n_q: int) -> Array:
    """Return random numbers between -1 and 1, always the same: an array (2, N_NEARBY, n_q), [0] for q and [1] for v."""
    return np.random.default_rng(6).uniform(-1.0, 1.0, (2, N_NEARBY, n_q))


def extreme_states(t: Array, rows: Array) -> Array:
    """Return, as rows [t, q, v], the states at which t or an entry of `rows` [q, v] is smallest or largest."""
    states = np.column_stack([t, rows])
    return states[np.unique([states.argmin(axis=0), states.argmax(axis=0)])]


class CheckedRegion:
    """Ranges of states [t, q, v] and of parameters in which callbacks agreed with their traces in earlier runs.

    bounds : smallest and largest t, q and v of checked states, with a margin; states in between need no comparison.
    """

    def __init__(self) -> None:
        self._runs = 0
        self._parameters: tuple[Array, Array] | None = None  # smallest and largest value of each parameter
        self._ranges = np.zeros((2, 0))  # smallest and largest value of each component of the states
        self.bounds = self._ranges

    def is_comparison_due(self) -> bool:
        """Return whether the next run compares calls and traces at all sampled states: runs 1, 2, 4, 8, ... do so."""
        return (self._runs + 1) & self._runs == 0

    def count_run(self) -> None:
        """Increase the number of runs by one."""
        self._runs += 1

    def states_outside(self, states: Array) -> Array:
        """Return the rows [t, q, v] of `states` that are outside `bounds`; all rows if there are no bounds."""
        if not self._ranges.size:
            return states
        smallest, largest = self.bounds
        outside = (states < smallest) | (states > largest)
        return states[outside.any(axis=1)] if outside.any() else states[:0]

    def contains_parameters(self, parameters: Array) -> bool:
        """Return whether all parameters are within the ranges of earlier runs, extended by the fraction MARGIN."""
        if self._parameters is None:
            return False
        smallest, largest = self._parameters
        margin = MARGIN * (largest - smallest)
        return bool((smallest - margin <= parameters).all() and (parameters <= largest + margin).all())

    def add_parameters(self, parameters: Array) -> None:
        """Extend the ranges so that they include the `parameters` of a run in which calls and traces agreed."""
        smallest, largest = self._parameters or (parameters, parameters)
        self._parameters = np.minimum(smallest, parameters), np.maximum(largest, parameters)

    def add(self, states: Array) -> None:
        """Extend the ranges and `bounds` so that they include `states`, where calls and traces agreed."""
        if len(states) == 0:
            return
        checked = np.concatenate([states, self._ranges]) if self._ranges.size else states
        smallest, largest = self._ranges = np.array([checked.min(axis=0), checked.max(axis=0)])
        margin = MARGIN * (largest - smallest) + MARGIN_AT_REST * float((largest - smallest)[1:].max())
        self.bounds = np.array([smallest - margin, largest + margin])

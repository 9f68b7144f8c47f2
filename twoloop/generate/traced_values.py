"""What callbacks were traced to, compared in numbers with what they give when they are called.

A callback that branches where nothing shows it, keeps something from call to call, or reads what changes beside its
arguments (a global that numba froze when it compiled it) is not what it was traced to. At the start both are compared
at states spread over the time of the run and about its start, later at states of the run itself.
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
from twoloop.generate.program import program_of
from twoloop.generate.trace_cache import Evaluator
from twoloop.kernels.compile.linking import direct
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

# those that are traced, in the order in which the kernel calls them
KINDS = (
    *("mass", "force", "constraint", "jacobian", "constraint_rate", "gamma"),
    *("nonholonomic", "nonholonomic_rate", "nonholonomic_gamma"),
)
AROUND = 8  # states about the start, beside it
TIMES = np.linspace(0.0, 1.0, AROUND)  # of a run, over its length, at which these are
AWAY = 0.3  # of the size of coordinates: how far these are from it
EACH, MOST = 32, 64  # states of a part of a run, and of a run ...
FEW = 9  # ... if callbacks are called in Python
ENTRIES = 20_000  # of all callbacks at all states of a run, about: fewer states of large systems
LOST = 16.0 * np.finfo(float).eps  # of the largest term of all entries: rounding of what operations cancel exactly
CLEAR = 1e-6  # of the largest term: a smaller difference is no rounding of the callback's if it stays ...
NEXT = 1e-7  # ... where the state changes by so little
NEIGHBOURS = 12


class Traced:
    """The operations that callbacks were traced to, as a program for numbers.

    Parameters
    ----------
    system : ConstrainedSystem
    graph : Graph
        On whose first quantities, t, q and v, the callbacks ran.
    forms : mapping or None
        By kind of callback, what it should give. None: what those that are given were traced to.
    """

    def __init__(self, system: ConstrainedSystem, graph: Graph, forms: Mapping[str, Any] | None = None):
        if forms is None:
            forms = {kind: made for kind, made in graph.traced.items() if kind in system.given}
        known = [kind for kind in KINDS if kind in forms and forms[kind].size]
        self.places = [(kind, place) for kind in known for place in np.ndindex(forms[kind].shape)]
        self.n_of = np.array([forms[kind].size for kind in known], dtype=np.int64)
        self.which = np.array([kind in known for kind in KINDS], dtype=np.int64)
        self.sizes = np.array([system.n_q, system.n_c, system.n_a], dtype=np.int64)
        self.name = system.name
        self.kinds = frozenset(graph.traced)  # that ran on symbols
        self.trusted = False
        entries = (forms[kind][place] for kind, place in self.places)
        made = {k: form for k, form in enumerate(entries) if form.terms or form.constant}  # others stay zero
        self.not_zero = frozenset(self.places[k][0] for k in made)  # kinds of callbacks that have such entries
        self.program = program_of(graph, 1 + 2 * system.n_q, made)

    def of(self, system: ConstrainedSystem, evaluate: Evaluator) -> "Traced":
        """The same of another system of the family."""
        other = self.with_numbers(evaluate)
        other.name = system.name
        return other

    def with_numbers(self, numbers_for: Callable[[Any], Array]) -> "Traced":
        """The same with other arrays in the place of those of its numbers, which have to be compared first."""
        other = copy.copy(self)
        constants, coefficients = numbers_for(self.program.constants), numbers_for(self.program.coefficients)
        other.program = self.program._replace(constants=constants, coefficients=coefficients)
        other.trusted = False
        return other

    def refuse(self, system: ConstrainedSystem, t0: float, t1: float, q: Array, v: Array) -> None:
        """Compare at states about the start, spread over the time of a run: see `refuse_wrong`."""
        refuse_wrong([self], system, t0, t1, q, v)

    def looked_at(self, system: ConstrainedSystem, around: Array) -> None:
        """The same at such states, the first of which is the start."""
        wrong = None
        for states in (around, *around[:, None, :]):  # all at once, or one by one
            try:
                wrong = wrong or self.wrong(system, states, everywhere=False)
            except Exception:  # outside what the callbacks are made for
                continue
            if states is around:
                break
        if wrong is not None:
            raise Untraceable(wrong)
        self.trusted = not system.called_in_python  # whose compiled callbacks do not change any more

    def wrong(self, system: ConstrainedSystem, states: Array, everywhere: bool = True) -> str | None:
        """Say which callback does not give at states [t, q, v] what it was traced to, or None.

        `everywhere`: whether what is not finite counts.
        """
        from twoloop.kernels.evaluation import traced as kernels

        most = FEW if system.called_in_python else MOST
        states = states[:: 1 + max(len(states) // most, len(states) * len(self.places) // ENTRIES)]
        n_different, called, traced, bounds = self._both(system, states)
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
        size = np.repeat(np.maximum.reduceat(largest, np.cumsum(self.n_of) - self.n_of), self.n_of)  # by kind
        for k, entry in np.argwhere(~same & ~(off <= LOST * size)):
            if not off[k, entry] <= CLEAR * size[entry] or self._stays(system, states[k], int(entry)):
                return self._message(states[k], int(entry), called[k, entry], traced[k, entry])
        return None

    def _both(self, system: ConstrainedSystem, states: Array) -> tuple[int, Array, Array, Array]:
        from twoloop.kernels.evaluation import traced as kernels

        called, traced, bounds = np.zeros((3, len(states), len(self.places)))
        n_different = direct(kernels.compare)(
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
        """Whether a difference is the same at neighbouring states, as rounding is not."""
        parts = np.random.default_rng(5).uniform(-1.0, 1.0, (NEIGHBOURS, len(state)))
        _, called, traced, _ = self._both(system, state * (1.0 + NEXT * parts))
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
    """Some states [t, q, v] of a run, rows, from its start to where it has come to."""

    def __init__(self, t: float, state: Array, n: int) -> None:
        self._n, self._parts = n, list[Array]()
        self.add(state[:0], state[None, :][:0], t, state)

    def add(self, t: Array, rows: Array, end: float, state: Array) -> None:
        """Take some states of a part of the run, rows that begin with [q, v] of n numbers, and that at its end."""
        stride = 1 + len(t) // EACH
        some = t[::stride]
        part = np.empty((len(some) + 1, 1 + self._n))
        part[0, 0], part[0, 1:] = end, state[: self._n]
        part[:0:-1, 0], part[:0:-1, 1:] = some, rows[::stride, : self._n]
        self._parts.insert(0, part)
        if len(self._parts) > MOST:
            self._parts = self._parts[::2]

    def end(self, t: float, state: Array) -> None:
        """Leave out what is beyond a time, and take the state there."""
        states = self.states()
        self._parts = [states[states[:, 0] <= t]]
        self.add(states[:0, 0], states[:0], t, state)

    def states(self) -> Array:
        """All of them, the last first."""
        return np.concatenate(self._parts)


def refuse_wrong(traced: Sequence[Traced], system: ConstrainedSystem, t0: float, t1: float, q: Array, v: Array) -> None:
    """Compare what is not trusted yet at states about the start, spread over the time of a run.

    Raises
    ------
    Untraceable
        Naming a callback and an entry.
    """
    new = [each for each in traced if not each.trusted]
    if not new:
        return
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        around = states_around(t0, t1, q, v)
        for each in new:
            each.looked_at(system, around)


Check = Callable[[Traced], None]


def unchecked(traced: Traced) -> None:
    """No check: of what is not to be run."""


def states_around(t0: float, t1: float, q: Array, v: Array) -> Array:
    """States [t, q, v], a start first, others about it at times of a run, at the speed of its size a second or more."""
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
    """Between -1 and 1, (2, AROUND, n_q): always the same."""
    return np.random.default_rng(6).uniform(-1.0, 1.0, (2, AROUND, n_q))

"""Find events, zeros of functions event(t, q, v) along the dense solution, by SciPy's rules."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from types import FunctionType
from typing import Any
from weakref import WeakSet

import numpy as np

from twoloop.checks.arguments import Array, check_call, shown

SAMPLES = 4  # smallest number of equal parts of a step; signs of event functions are checked at the end of each part
WHOLE = 1.0 - 1e-9  # factor on the number of parts before rounding up, so that rounding errors do not add a part
PRECISION = 4.0 * float(np.finfo(float).eps)  # relative precision of the time of an event, as in SciPy
# largest number of iterations of Brent's method, which at zeros of high order may need 53 to halve the interval
MAX_ITERATIONS = 3000

_checked: WeakSet[FunctionType] = WeakSet()  # functions whose arguments were checked, which takes 9 µs


@dataclass(frozen=True)
class Event:
    """Event function with its checked attributes."""

    number: int
    function: Callable[..., Any]
    terminal: float  # number of occurrences after which the run ends; infinite: never
    direction: float  # only zeros where the slope has this sign count; 0: all zeros count

    @property
    def name(self) -> str:
        """Return the name of the function, for messages."""
        name = getattr(self.function, "__name__", "")
        return f"events[{self.number}]" + (f" ({name})" if name and name != "<lambda>" else "")

    def __call__(self, t: float, q: Array, v: Array) -> float:
        """Evaluate the function, which may write to q and v; raise if the value is not a finite number."""
        try:
            value = self.function(t, q, v)
        except Exception as error:
            error.add_note(f"raised by {self.name} at t = {t!r}")
            raise
        if isinstance(value, float) and isfinite(value):
            return float(value)
        array = np.asarray(value)
        if array.ndim > 0 or array.dtype.kind not in "iuf":
            raise TypeError(f"{self.name} must return a number; at t = {t!r} it returned {shown(value)}")
        if not np.isfinite(array):
            raise ValueError(f"{self.name} must return a finite number; at t = {t!r} it returned {shown(value)}")
        return float(array)


def check_events(events: Any) -> list[Event]:
    """Return the event functions with their attributes; raise if one is wrong."""
    if events is None:
        return []
    functions = [events] if callable(events) else events
    if not isinstance(functions, (list, tuple)):
        raise TypeError(
            f"events must be a function event(t, q, v) or a list of such; given {shown(events)} of type "
            f"{type(events).__name__}"
        )
    return [_event(number, function) for number, function in enumerate(functions)]


def _event(number: int, function: Any) -> Event:
    if not callable(function):
        raise TypeError(
            f"events[{number}] must be a function event(t, q, v); given {shown(function)} of type "
            f"{type(function).__name__}"
        )
    if type(function) is not FunctionType or function not in _checked:
        check_call(f"events[{number}]", "event", function, ("t", "q", "v"))
        if type(function) is FunctionType:
            _checked.add(function)
    terminal, direction = getattr(function, "terminal", None), getattr(function, "direction", 0)
    expected = f"events[{number}].terminal must be True, False or a positive number of occurrences"
    if terminal is not None and not isinstance(terminal, (bool, int, np.bool_, np.integer)):
        raise TypeError(f"{expected}; given {shown(terminal)} of type {type(terminal).__name__}")
    if terminal is not None and terminal < 0:
        raise ValueError(f"{expected}; given {shown(terminal)}")
    expected = f"events[{number}].direction must be -1, 0 or 1"
    if isinstance(direction, bool) or not isinstance(direction, (int, float, np.integer, np.floating)):
        raise TypeError(f"{expected}; given {shown(direction)} of type {type(direction).__name__}")
    if direction not in (-1, 0, 1):
        raise ValueError(f"{expected}; given {shown(direction)}")
    return Event(number, function, float(terminal) if terminal else np.inf, float(direction))


class EventSearch:
    """Search step by step for the events of a run that begins at t0 with `row`, the state [q, v].

    Two samples are at most `every` seconds apart, unless an event function has an attribute `every` of its own.
    """

    def __init__(self, events: list[Event], t0: float, row: Array, every: float):
        self.events, self.reached = events, t0  # end of the last step that was searched, s
        self.found: list[list[tuple[float, Array]]] = [[] for _ in events]  # times and rows [q, v] of each event
        self.ended: tuple[Event, float] | None = None  # terminal event that ended the run, and its time, s
        self._n_q = len(row) // 2
        self._every = min((getattr(event.function, "every", every) for event in events), default=every)
        self._rates = [rate for event in events if (rate := getattr(event.function, "gap_rate", None)) is not None]
        copies = zip(events, self._copies(row[None, :]), strict=True)
        self._values = [event(t0, q[0], v[0]) for event, (q, v) in copies]
        self._at_start = True

    def search(
        self, states: Callable[[Array], Array], row_function: Callable[[float], Callable[[float], Array]], ends: Array
    ) -> None:
        """Search the steps from ends[0] to ends[1], from ends[1] to ends[2], ...; stop at a terminal event.

        `states(times)` returns the rows [q, v] at sorted times. `row_function(t)` returns a function of time that
        returns the row at any time of the step that contains t.
        """
        self._states, self._row_function = states, row_function
        if len(ends) < 2 or self.ended is not None:
            return
        # evaluate all samples of many steps in one call of the dense solution, which is several times faster
        steps = np.diff(ends)
        counts = np.maximum(SAMPLES, np.ceil(WHOLE * steps / self._every)).astype(int)
        first = np.append(0, np.cumsum(counts))
        start_times, n_parts, durations, first_samples = (
            np.repeat(per_step, counts) for per_step in (ends[:-1], counts, steps, first[:-1])
        )
        times = np.append(start_times + (np.arange(first[-1]) - first_samples) / n_parts * durations, ends[-1])
        rows = states(times)
        if not self._rates:
            self._in_steps(times, rows, ends[1:].tolist())
            return
        for k, end in enumerate(ends[1:].tolist()):
            samples = slice(first[k], first[k + 1] + 1)
            self._in_steps(*self._with_turns(times[samples], rows[samples]), [end])
            if self.ended is not None:
                return

    def break_off(self) -> None:
        """Drop the events of a step whose search was interrupted by an exception."""
        if self.ended is None:
            self.found = [[(t, row) for t, row in events if t <= self.reached] for events in self.found]

    def _with_turns(self, times: Array, rows: Array) -> tuple[Array, Array]:
        """Return times and rows with samples added where a gap is smallest, as it may close only between samples."""
        states_at = zip(times.tolist(), *np.split(rows, 2, axis=1), strict=True)
        values = np.array([[rate(*state) for rate in self._rates] for state in states_at])
        turns = [
            self._root(self._rates[j], (float(times[k]), float(times[k + 1])), (values[k, j], values[k + 1, j]))[0]
            for k, j in np.argwhere((values[:-1] < 0.0) & (values[1:] > 0.0))
        ]
        if not turns:
            return times, rows
        turning_times = np.unique(turns)
        indices = np.searchsorted(times, turning_times)
        return np.insert(times, indices, turning_times), np.insert(rows, indices, self._states(turning_times), axis=0)

    def _copies(self, rows: Array) -> list[tuple[list[Array], list[Array]]]:
        """Return copies of coordinates and velocities for each event, which may write to them."""
        return [(list(rows[:, : self._n_q].copy()), list(rows[:, self._n_q :].copy())) for _ in self.events]

    def _in_steps(self, times: Array, rows: Array, ends: list[float]) -> None:
        """Search for events between samples (times and rows) of the steps that end at `ends`; record them."""
        t, copies, steps = times.tolist(), self._copies(rows), iter(ends)
        end = next(steps)
        for k in range(1, len(t)):
            values, active = [], []
            for event, (q, v), g in zip(self.events, copies, self._values, strict=True):
                values.append(g_new := event(t[k], q[k], v[k]))
                if g * g_new <= 0.0 and (g != 0.0 or self._at_start) and crosses(event.direction, g, g_new):
                    active.append((event, (g, g_new)))
            self._values, self._at_start = values, False
            if active:
                roots = [(*self._root(event, (t[k - 1], t[k]), signs), event) for event, signs in active]
                self._record(sorted(roots, key=lambda root: root[0]))
                if self.ended is not None:
                    return
            if t[k] == end:
                self.reached, end = end, next(steps, np.inf)

    def _record(self, roots: list[tuple[float, Array, Event]]) -> None:
        """Record the events up to the first terminal event, and other events at the time of the terminal event."""
        for t, row, event in roots:
            if self.ended is not None and t > self.ended[1]:
                return
            occurrences = self.found[event.number]
            occurrences.append((t, row))
            if len(occurrences) >= event.terminal and self.ended is None:
                self.ended = (event, t)

    def _root(
        self, event: Callable[..., float], ends: tuple[float, float], values: tuple[float, float]
    ) -> tuple[float, Array]:
        """Return the time and the row of an event between `ends`; `values`: the event function at `ends`."""
        from scipy.optimize import brentq  # takes a tenth of a second to import, and few runs need it

        values_at_ends = dict(zip(ends, values, strict=True))
        for t, end_value in values_at_ends.items():
            if end_value == 0.0:
                return t, self._states(np.array([t]))[0]
        row = self._row_function(ends[0])

        def value(t: float) -> float:
            if t in values_at_ends:
                return values_at_ends[t]
            q, v = np.split(row(t), 2)
            return event(t, q, v)

        xtol = PRECISION * max(abs(ends[0]), abs(ends[1]))
        t = float(brentq(value, *ends, xtol=xtol, rtol=PRECISION, maxiter=MAX_ITERATIONS))
        return t, row(t)


def crosses(direction: float, g: float, g_new: float) -> bool:
    """Return whether a function that goes from g to g_new has a zero that counts (`find_active_events` of SciPy)."""
    up, down = g <= 0.0 <= g_new, g_new <= 0.0 <= g
    return (up and direction >= 0.0) or (down and direction <= 0.0)

"""Gap functions of stops with their derivatives, traced once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from twoloop.checks.arguments import Array, shown
from twoloop.generate.calls_on_symbols import as_forms, trace
from twoloop.generate.derivative import Derivative
from twoloop.generate.programs import AGREES, BETWEEN, STATES, numbers_of, program_of
from twoloop.generate.tracing import Form, Graph, Untraceable, symbols
from twoloop.problem.description import Stop


class Gap(NamedTuple):
    """Values for k stops: gaps, their rates, the part of the second derivatives without v', and gradients (k, n_q)."""

    g: Array
    u: Array
    bend: Array
    W: Array


class Gaps:
    """Gap functions of stops, or the slides of those that rub.

    Parameters
    ----------
    what : "gap" or "slide"
    stops : sequence of Stop
    t0, q0 : float, ndarray (n_q,)
        State near which the traced programs are compared with the functions.

    Raises ValueError if a gap function cannot be traced, or disagrees with its trace.
    """

    def __init__(self, what: str, stops: Sequence[Stop], t0: float, q0: Array):
        self.n, self._n_q, self._what = len(stops), len(q0), what
        graph = Graph()
        (t,) = graph.inputs(1, False)
        q, v = graph.inputs(self._n_q, False), graph.inputs(self._n_q, True)
        made: list[Form] = []
        for stop in stops:
            try:
                gap = as_forms(graph, np.array(trace(getattr(stop, what), t, symbols(q)), dtype=object).reshape(1))[0]
            except (Untraceable, ValueError) as error:
                raise ValueError(
                    f"{what} of {stop.name!r} must be a number computed from t and q by numpy functions, without "
                    f"branches: {error}"
                ) from None
            made += _with_derivatives(graph, gap, t, q, v)
        program = program_of(graph, 1 + 2 * self._n_q, dict(enumerate(made)))
        self._p = np.array(numbers_of(program))
        self._last: tuple[Any, Gap] | None = None
        self._compare(stops, t0, q0)

    def at(self, t: float, q: Array, v: Array) -> Gap:
        """Evaluate the gaps at a state."""
        from twoloop.bodies.program_results import results  # compiled on import

        state = t, q.tobytes(), v.tobytes()
        if self._last is not None and self._last[0] == state:  # all stops are looked at one after another
            return self._last[1]
        made = results(0, t, q, v, self._p)[: self.n * (3 + self._n_q)].reshape(self.n, 3 + self._n_q)
        self._last = state, Gap(made[:, 0], made[:, 1], made[:, 2], made[:, 3:])
        return self._last[1]

    def _compare(self, stops: Sequence[Stop], t0: float, q0: Array) -> None:
        away = np.random.default_rng(4).uniform(-0.3, 0.3, (STATES, len(q0)))
        away[0] = 0.0
        for k, each in enumerate(away):
            t, q = t0 + BETWEEN * k, q0 + each
            found = self.at(t, q, np.zeros_like(q)).g
            for stop, own in zip(stops, found, strict=True):
                value: Any = getattr(stop, self._what)(t, q.copy())
                if k == 0 and not (np.ndim(value) == 0 and np.isfinite(value)):
                    raise ValueError(
                        f"{self._what} of {stop.name!r} must return a finite number; it returned {shown(value)}"
                    )
                if np.isfinite(value) and abs(value - own) > AGREES * (1.0 + abs(own)):
                    raise ValueError(
                        f"{self._what} of {stop.name!r} has another value at t = {t:g} than when it was traced: it "
                        "must depend on t and q alone, without branches"
                    )


def _with_derivatives(graph: Graph, gap: Form, t: Form, q: Sequence[Form], v: Sequence[Form]) -> list[Form]:
    """Return a gap, its rate, the part of its second derivative without v', and its gradient."""
    one = Form(graph, 1.0, {})
    (time,), places = t.terms, [next(iter(each.terms)) for each in q]
    along = {time: one, **dict(zip(places, v, strict=True))}
    rate = Derivative(graph, along).of(gap)
    bend = Derivative(graph, along).of(rate)
    return [gap, rate, bend, *(Derivative(graph, {place: one}).of(gap) for place in places)]

"""Join the arcs between impacts into one result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from twoloop.checks.arguments import Array, check_real
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.record import Statistics, Status, failure_link

CHANGES_NOTE = "velocities jumped in impacts, or stops were closed or joints stuck for a while"


class Impact(NamedTuple):
    """Impact: time, s; stops; velocities before and after (n_q,); impulses of the stops and of their friction.

    Impulses are in N s (N m s for an angle); those of friction act along `slide`, and are zero without friction.

    Examples
    --------
    >>> from twoloop import Stop, solve_with_stops
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> stop = Stop(lambda t, q: 1.0 - q[8], restitution=0.5, name="stop")  # the third bar turns to 1 rad at most
    >>> result = solve_with_stops(problem.system, (0.0, 0.6), problem.q0, problem.v0, stop)
    >>> impact = result.impacts[0]
    >>> impact.stops, bool(impact.impulses[0] > 0.0)
    (('stop',), True)
    >>> round(float(-impact.v_after[8] / impact.v_before[8]), 6)  # the coefficient of restitution
    0.5
    """

    t: float
    stops: tuple[str, ...]
    v_before: Array
    v_after: Array
    impulses: Array
    friction: Array


class ArcState(NamedTuple):
    """State at a time, or at times (n,): q, v, a (n_q,) or (n_q, n), lam (n_c + n_a,) or (n_c + n_a, n)."""

    t: Any
    q: Array
    v: Array
    a: Array
    lam: Array


class ArcSolution:
    """`result.sol` of a motion of several arcs; at an impact it returns the state after it.

    Attributes
    ----------
    arcs : tuple of Result
    t_min, t_max : float
        Time interval covered, s.

    Examples
    --------
    >>> from twoloop import Stop, solve_with_stops
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> stop = Stop(lambda t, q: 1.0 - q[8], restitution=0.5, name="stop")  # the third bar turns to 1 rad at most
    >>> result = solve_with_stops(problem.system, (0.0, 0.6), problem.q0, problem.v0, stop)
    >>> state = result.sol(0.5)
    >>> state.q.shape, len(result.sol.arcs) == len(result.impacts) + 1
    ((9,), True)
    """

    def __init__(self, arcs: Sequence[Result], n_c: int, n_a: int):
        self.arcs, self._n_c, self._n_rows = tuple(arcs), n_c, n_c + n_a
        self.t_min, self.t_max = float(arcs[0].t[0]), float(arcs[-1].t[-1])

    def __call__(self, t: ArrayLike) -> ArcState:
        """Return the state at a time, or at times (n,) in any order.

        Raises
        ------
        TypeError, ValueError
            If t is not a number or vector, or outside the run.
        """
        times = check_real("t", t)
        if times.ndim > 1 or not ((times >= self.t_min) & (times <= self.t_max)).all():
            raise ValueError(f"t must be a number or (n,), from {self.t_min!r} to {self.t_max!r}; given {times!r:.100}")
        flat = np.atleast_1d(times)
        first = self.arcs[0]
        parts = (first.q, first.v, first.a, self._multipliers(first.lam))
        outputs = [np.empty((len(part), len(flat))) for part in parts]
        arc_of_time = np.searchsorted([arc.t[0] for arc in self.arcs], flat, side="right") - 1
        for k in np.unique(arc_of_time):
            in_arc = np.flatnonzero(arc_of_time == k)
            assert self.arcs[k].sol is not None
            state = self.arcs[k].sol(flat[in_arc])
            for out, values in zip(outputs, (state.q, state.v, state.a, self._multipliers(state.lam)), strict=True):
                out[:, in_arc] = values
        if times.ndim == 0:
            return ArcState(float(times), *(out[:, 0] for out in outputs))
        return ArcState(times, *outputs)

    def _multipliers(self, lam: Array) -> Array:
        return system_multipliers(lam, self._n_c, self._n_rows)

    def __repr__(self) -> str:
        return f"ArcSolution(from t = {self.t_min:g} to {self.t_max:g} s, {len(self.arcs)} arcs)"


def system_multipliers(lam: Array, n_c: int, n_rows: int) -> Array:
    """Return `lam` without the multipliers of closed stops, which follow the n_c multipliers of C."""
    return np.vstack([lam[:n_c], lam[len(lam) - (n_rows - n_c) :]])


def join_arcs(
    system: ConstrainedSystem,
    arcs: Sequence[Result],
    impacts: Sequence[Impact],
    times: Array | None,
    stagnated: str,
    summary: str,
) -> Result:
    """Return one result of all arcs, at the ends of their steps or at output times; `summary` ends its message."""
    last, n_rows = arcs[-1], system.n_c + system.n_a
    table: list[Array]
    if times is None:
        parts = [(arc.t, arc.q, arc.v, arc.a, system_multipliers(arc.lam, system.n_c, n_rows)) for arc in arcs]
        table = [np.concatenate(columns, axis=-1) for columns in zip(*parts, strict=True)]
    else:
        table = list(ArcSolution(arcs, system.n_c, system.n_a)(times[times <= last.t[-1]]))
    status, message = (Status.STAGNATED, stagnated) if stagnated else (last.status, last.message)
    if not stagnated and (len(arcs) > 1 or impacts):
        message += f" {summary}"
    counts: dict[str, Any] = {
        name: _concatenated(arcs, name) for name in ("rejected_error", "rejected_convergence", "partitioned")
    }
    changes = CHANGES_NOTE if impacts or any(arc.system is not system for arc in arcs) else ""
    t, q, v, a, lam = table
    return Result(
        *(t, q, v, a, lam),
        h=np.concatenate([arc.h for arc in arcs]),
        status=status,
        message=message + (failure_link(status) if stagnated else ""),
        stats=Statistics(**{f.name: sum(getattr(arc.stats, f.name) or 0 for arc in arcs) for f in fields(Statistics)}),
        rank=arcs[0].rank,
        redundant=arcs[0].redundant,
        **counts,
        sol=ArcSolution(arcs, system.n_c, system.n_a),  # type: ignore[arg-type]  # same interface
        widest_gap=max(arc.widest_gap or 0.0 for arc in arcs),
        system=system,
        method=arcs[0].method,
        compiled=arcs[0].compiled,
        rtol=arcs[0].rtol,
        atol=arcs[0].atol,
        untested=_concatenated(arcs, "untested"),
        changes=changes,
        arcs=tuple(arcs),
        impacts=tuple(impacts),
    )


def _concatenated(arcs: Sequence[Result], name: str) -> Any:
    parts = [getattr(arc, name) for arc in arcs]
    return None if any(part is None for part in parts) else np.concatenate(parts)

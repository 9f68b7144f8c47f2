"""solve_with_stops: arcs of a motion from impact to impact, and at rest on stops."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import check_positive, check_span, check_times, check_tolerance, check_vector, shown
from twoloop.impacts.contact import Accelerations, Closed
from twoloop.impacts.gaps import Gap, Gaps
from twoloop.impacts.joined import Impact, joined
from twoloop.impacts.laws import NEGLIGIBLE, complementary, impulses, responses
from twoloop.methods.plan import Method
from twoloop.problem.stops import Stop
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.record import Status
from twoloop.solve import solve_dae

Array = NDArray[np.float64]

LOW = 0.01  # of the absolute tolerance: a rebound to less than this height ends in contact
ROUNDING = 1e-13  # of the largest coordinate, at least
LEAST_STEP = 1e-9  # s, or relative: the first of an arc
NOTHING = 1e-20  # m or rad: coordinates that rounding alone keeps from zero
STANDS = 1e-13  # relative: arcs that are shorter do not move on in time ...
CORRECTIONS = 3  # of positions, by Newton's method
MOST_STANDING = 30  # ... and so many of them in a row end the motion
OF_A_RUN = {"system", "t_span", "q0", "v0", "method", "rtol", "atol", "t_eval", "events", "dense_output", "step_size"}


def solve_with_stops(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    stops: Stop | Sequence[Stop],
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    **options: Any,
) -> Result:
    """Integrate a system that runs against stops: impacts with restitution, rest in contact, and release.

    An impact changes the velocities by impulses at the stops that are closed, along with those of all constraints:
    M (v+ - v-) + C_q^T p = W^T P, with C_q v+ + C_t = 0. Where several stops are closed, Moreau's law says which
    have an impulse. Rebounds become lower by the square of the restitution; one that would be lower than a hundredth of
    `atol` ends in contact: the gap is then a constraint as long as its force pushes. There is no friction.

    Parameters
    ----------
    system, t_span, q0, v0, method, rtol, atol
        As for `solve_dae`. The gaps must be open, or closed, at the start.
    stops : Stop or sequence of Stop
        Such as `Stop(lambda t, q: q[1], restitution=0.5)`; `problem.stops` of a model that has some.
    t_eval : array_like, optional
        Times at which to store the states. None: the ends of steps; at an impact there are two columns, before and
        after it.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit (of each arc), ...

    Returns
    -------
    Result
        `.impacts` has what happened when, `.arcs` the runs from one to the next, `.sol` the state at any time. `.lam`
        are multipliers of the system; an arc at rest on stops has theirs, too, behind those of its constraints C: the
        force of a stop is the negative.

    Raises
    ------
    TypeError, ValueError
        If an argument is wrong, a gap cannot be run on symbols, or is negative at the start.

    Notes
    -----
    Impacts are found as events are: a gap that closes and opens again within a quarter of a step is missed; `max_step`
    helps. The time of an impact is as good as the motion before it.
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    q, v = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
    stops = [stops] if isinstance(stops, Stop) else stops
    if not isinstance(stops, (list, tuple)) or not stops or not all(isinstance(each, Stop) for each in stops):
        raise TypeError(f"stops must be a Stop or a list of them; given {shown(stops)}")
    known = inspect.signature(solve_dae).parameters.keys() - OF_A_RUN
    wrong = [name for name in options if name not in known]
    if wrong:
        raise TypeError(f"solve_with_stops has no option {wrong[0]!r}; those of runs are {', '.join(sorted(known))}")
    check_positive("rtol", rtol)
    options |= {"method": method, "rtol": rtol, "atol": check_tolerance("atol", atol, system.n_q)}
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    return _Motion(system, list(stops), t0, q, v, options).to(t1, times)


class _Motion:
    """What is known of a motion: its state, and which stops are closed."""

    def __init__(
        self, system: ConstrainedSystem, stops: list[Stop], t: float, q: Array, v: Array, options: dict[str, Any]
    ):
        self.system, self.stops, self.options = system, stops, options
        self.t, self.q, self.v = t, q, v
        self.e = np.array([stop.restitution for stop in stops])
        self.gaps = Gaps(stops, t, q)
        self.low = max(LOW * float(options["atol"].min()), ROUNDING * max(1.0, float(np.abs(q).max())))
        wrong = np.flatnonzero(self.gaps.at(t, q, v).g < -100.0 * self.low)
        if wrong.size:
            gap = float(self.gaps.at(t, q, v).g[wrong[0]])
            raise ValueError(f"q0 must be on this side of all stops; the gap of {stops[wrong[0]].name!r} is {gap:.3g}")
        self.arcs: list[Result] = []
        self.impacts: list[Impact] = []
        self.let_go: list[int] = []  # stops whose force has just become zero
        self.closed: dict[tuple[int, ...], ConstrainedSystem] = {}
        self.accelerations: dict[tuple[int, ...], Accelerations] = {}

    def to(self, t1: float, times: Array | None) -> Result:
        """Go on to the end."""
        standing = 0
        while True:
            before, resting = self.t, self._meet()
            self._arc(resting, t1)
            last = self.arcs[-1]
            if last.status != Status.EVENT or self.t >= t1:
                return joined(self.system, self.arcs, self.impacts, times, "", self._tale)
            standing = standing + 1 if self.t - before <= STANDS * max(1.0, abs(self.t)) else 0
            if standing == MOST_STANDING:
                names = ", ".join(repr(name) for name in dict.fromkeys(n for i in self.impacts[-9:] for n in i.stops))
                said = (
                    f"Stopped at t = {self.t:.10g}: {standing} impacts or releases in a row at this time ({names}). "
                    "Look for stops that push against each other, or loosen atol"
                )
                return joined(self.system, self.arcs, self.impacts, times, said, self._tale)

    @property
    def _tale(self) -> str:
        return f"{len(self.impacts)} impacts."

    def _meet(self) -> tuple[int, ...]:
        """Velocities after what happens at this instant, and the stops that stay closed."""
        gap = self.gaps.at(self.t, self.q, self.v)
        near = np.flatnonzero(gap.g <= self.low)
        if not near.size:
            return ()
        X = responses(self.system, self.t, self.q, gap.W[near])
        D = gap.W[near] @ X
        before, u = self.v, gap.u[near]
        P = impulses(D, u, self.e[near])
        v = before + X @ P
        slow, c = self._slow(near, v)
        if (slow & (P > 0.0) & (self.e[near] > 0.0)).any():
            P = impulses(D, u, np.where(slow, 0.0, self.e[near]))
            v = before + X @ P
            slow, c = self._slow(near, v)
        hit = P > 0.0
        if hit.any():
            self.impacts.append(
                Impact(self.t, tuple(self.stops[k].name for k in near[hit]), before.copy(), v.copy(), P[hit])
            )
        self.v = v
        slow &= ~np.isin(near, self.let_go)  # whose force is zero but for rounding
        held = complementary(D[np.ix_(slow, slow)], c[slow])
        return tuple(near[slow][held > 0.0].tolist())

    def _slow(self, near: NDArray[np.int64], v: Array) -> tuple[NDArray[np.bool_], Array]:
        """Which of these stops would open by less than what counts, and how their gaps accelerate by themselves."""
        gap = self.gaps.at(self.t, self.q, v)
        c = (gap.W @ self._accelerations(()).at(self.t, self.q, v)[0] + gap.bend)[near]
        u = gap.u[near]
        return u * np.abs(u) <= 2.0 * self.low * np.maximum(-c, 0.0) + ROUNDING * np.abs(v).max() ** 2, c

    def _accelerations(self, resting: tuple[int, ...]) -> Accelerations:
        if resting not in self.accelerations:
            made = Accelerations(self._system(resting), self.t, self.q, self.v, self.options["atol"])
            self.accelerations[resting] = made
        return self.accelerations[resting]

    def _system(self, resting: tuple[int, ...]) -> ConstrainedSystem:
        if not resting:
            return self.system
        if resting not in self.closed:
            names = ", ".join(self.stops[k].name for k in resting)
            self.closed[resting] = Closed(self.system, self.gaps, list(resting)).made(names)
        return self.closed[resting]

    def _arc(self, resting: tuple[int, ...], t1: float) -> None:
        """A run until a gap closes, or a stop that is closed lets go."""
        system = self._system(resting)
        if resting:
            self._close(system, resting)
        start = self.gaps.at(self.t, self.q, self.v)
        events = [self._lets_go(resting, k) if k in resting else self._closes(k, start) for k in range(len(self.stops))]
        options = {**self.options, "check_derivatives": self.options.get("check_derivatives", True) and not self.arcs}
        if self.arcs and self.options.get("first_step") is None and self.arcs[-1].h.size:
            least = LEAST_STEP * max(1.0, abs(self.t))  # coordinates next to zero have no size to choose a step by
            options["first_step"] = min(max(0.1 * float(self.arcs[-1].h.max()), least), t1 - self.t)
        arc = solve_dae(system, (self.t, t1), self.q, self.v, events=events, dense_output=True, **options)
        self.arcs.append(arc)
        self.let_go = [k for k in resting if arc.t_events is not None and arc.t_events[k].size]
        if arc.t.size:
            self.t, self.q, self.v = float(arc.t[-1]), arc.q[:, -1].copy(), arc.v[:, -1].copy()

    def _close(self, system: ConstrainedSystem, resting: tuple[int, ...]) -> None:
        """Put the state on the constraints and the closed stops, from which it is off by less than the tolerances."""
        for _ in range(CORRECTIONS):
            rows, off = system.jacobian(self.t, self.q), system.constraint(self.t, self.q)
            self.q = self.q - np.linalg.lstsq(rows, off, rcond=NEGLIGIBLE)[0]
        self.q[np.abs(self.q) < NOTHING] = 0.0
        gap = self.gaps.at(self.t, self.q, self.v)
        W, u = gap.W[list(resting)], gap.u[list(resting)]
        X = responses(self.system, self.t, self.q, W)
        self.v = self.v - X @ np.linalg.lstsq(W @ X, u, rcond=NEGLIGIBLE)[0]
        rows, off = system.rows(self.t, self.q), system.velocity_constraint(self.t, self.q, self.v)
        self.v = self.v - np.linalg.lstsq(rows, off, rcond=NEGLIGIBLE)[0]

    def _closes(self, k: int, start: Gap) -> Any:
        """The event of a gap that is open, or about to open: zero where it is as closed as it was at the start."""
        g0, u0, t0, low = float(start.g[k]), float(start.u[k]), self.t, self.low
        opens = u0 > 0.0 and u0 * u0 > low * 1e-6

        def closes(t: float, q: Array, v: Array) -> float:
            g = float(self.gaps.at(t, q, v).g[k])
            if g0 > low:
                return g
            if opens:
                return (g - g0) / (t - t0) if t > t0 else u0
            return g - min(g0, 0.0) + low

        return terminal(closes)

    def _lets_go(self, resting: tuple[int, ...], k: int) -> Any:
        """The event of a force that would pull."""
        row, accelerations = self.system.n_c + resting.index(k), self._accelerations(resting)

        def lets_go(t: float, q: Array, v: Array) -> float:
            return -float(accelerations.at(t, q, v)[1][row])

        return terminal(lets_go)


def terminal(event: Any) -> Any:
    """An event that ends a run where it falls through zero."""
    event.terminal, event.direction = True, -1
    return event

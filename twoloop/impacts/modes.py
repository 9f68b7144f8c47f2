"""Piecewise integration of a motion: arcs between impacts, contact and release, sliding and sticking."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.impacts.contact import Accelerations, WithContacts
from twoloop.impacts.gaps import Gap, Gaps
from twoloop.impacts.grip import AT_REST, Grip, Mode
from twoloop.impacts.joined import Impact, joined
from twoloop.impacts.laws import NEGLIGIBLE, Undetermined, coulomb, held, impulses, responses
from twoloop.impacts.rubbing import IDLE, INDEPENDENT, STICKS, Modes, Signs
from twoloop.methods.presets import PRESETS
from twoloop.methods.taylor import Taylor
from twoloop.problem.description import Stop
from twoloop.problem.system import ConstrainedSystem
from twoloop.result.result import Result
from twoloop.run.impulse import corrected
from twoloop.run.record import Status
from twoloop.solve import check_method, solve_dae

LOW = 0.01  # relative to the absolute tolerance: a rebound below this height ends in contact
SAMPLES = 2000  # smallest number of evaluations of gaps, forces and rates of sliding over a motion
CLOSED = 1e3  # squares of rates, over this height and the accelerations, of stops that may press one another
ROUNDING = 1e-13  # relative to max(1, |q|)
LEAST_STEP = 1e-9  # first step of an arc, relative to max(1 s, t)
ZERO = 1e-20  # m or rad, or per s: smaller coordinates and rates are rounding errors
STALLED = 1e-13  # relative to max(1 s, t): shorter arcs count as stalled ...
MAX_STALLED = 30  # ... and this many stalled arcs in a row end the motion
RELEASED = 1e-7  # relative reduction of the static friction of a joint just released, which prevents chattering
AT_MOST = 1e-9  # relative: margin of a joint held by its full friction


class Motion:
    """State of a motion: coordinates, closed stops, and sticking joints.

    Parameters
    ----------
    stops : sequence of Stop
    modes : Modes
        Provides the system in each mode.
    t, q, v : float, ndarray (n_q,), ndarray (n_q,)
    options : dict
        Options of the runs.
    """

    def __init__(self, stops: Sequence[Stop], modes: Modes, t: float, q: Array, v: Array, options: dict[str, Any]):
        self.system, self.modes, self.stops, self.options = modes.system, modes, list(stops), options
        self.t, self.q, self.v = t, q, v
        self.e = np.array([stop.restitution for stop in stops])
        self.gaps, self.grip = Gaps("gap", stops, t, q), Grip(stops, t, q)
        self.low = max(LOW * float(options["atol"].min()), ROUNDING * max(1.0, float(np.abs(q).max())))
        wrong = np.flatnonzero(self.gaps.at(t, q, v).g < -100.0 * self.low)
        if wrong.size:
            gap = float(self.gaps.at(t, q, v).g[wrong[0]])
            raise ValueError(f"gaps must not be negative at q0; that of {stops[wrong[0]].name!r} is {gap:.3g}")
        self.arcs: list[Result] = []
        self.impacts: list[Impact] = []
        self.opened: list[int] = []  # stops whose force has just vanished
        self.speeds = np.abs(v)  # largest velocities of the last arc
        self.still: set[int] = set()  # joints that have stopped or stick
        self.released: set[int] = set()  # joints that stuck in the last arc
        self._known: dict[Any, tuple[ConstrainedSystem, ConstrainedSystem]] = {}
        self._forces: dict[int, tuple[ConstrainedSystem, Accelerations]] = {}

    def to(self, t1: float, times: Array | None) -> Result:
        """Integrate to the end."""
        stalled, self.every = 0, (t1 - self.t) / SAMPLES
        while True:
            before = self.t
            try:
                self._run_arc(self._resolve(), t1)
            except Undetermined as error:
                if not self.arcs:
                    raise
                return joined(
                    self.system,
                    self.arcs,
                    self.impacts,
                    times,
                    f"Stopped at t = {self.t:.10g}: {error}.",
                    self._summary,
                )
            last = self.arcs[-1]
            if last.status != Status.EVENT or self.t >= t1:
                return joined(self.system, self.arcs, self.impacts, times, "", self._summary)
            stalled = stalled + 1 if self._at_once(before) else 0
            if stalled == MAX_STALLED:
                names = dict.fromkeys(name for impact in self.impacts[-9:] for name in impact.stops)
                of = f" ({', '.join(map(repr, names))})" if names else ""
                said = (
                    f"Stopped at t = {self.t:.10g}: {stalled} impacts or other changes in a row at this time{of}. "
                    "Look for stops that push against each other, or loosen atol."
                )
                return joined(self.system, self.arcs, self.impacts, times, said, self._summary)

    def _at_once(self, before: float) -> bool:
        return self.t - before <= STALLED * max(1.0, abs(self.t))

    @property
    def _summary(self) -> str:
        changes = f"{len(self.arcs) - 1} changes between sliding and sticking."
        if self.stops and (self.modes.n or self.grip.place):
            return f"{len(self.impacts)} impacts, {len(self.arcs) - 1} changes of sliding, sticking or contact."
        return changes if self.modes.n else f"{len(self.impacts)} impacts."

    def _resolve(self) -> Mode:
        """Apply an impact; return which joints and stops slide or stick, and which stops stay closed."""
        gap = self.gaps.at(self.t, self.q, self.v)
        near = np.flatnonzero(gap.g <= self.low)
        slow = np.zeros(near.size, dtype=bool)
        if near.size:
            for _ in range(MAX_STALLED):
                slow = self._apply_impulses(gap, near)
                gap = self.gaps.at(self.t, self.q, self.v)
                # the law lets a stop close that opened before: it is hit next
                if not (gap.u[near] < -AT_REST * (np.abs(gap.W[near]) @ self.speeds)).any():
                    break
            slow &= ~np.isin(near, self.opened)  # an opened stop has no force
        closing = near[slow]
        signs, of = self._sliding(self.v)
        if not closing.size and not of:
            return Mode(signs)
        a, c_rubs = self._free(signs, of, self.v)
        gap = self.gaps.at(self.t, self.q, self.v)
        touch, slide, rubs = self.grip.rows(closing.tolist(), self.t, self.q, self.v, self.speeds)
        c = np.concatenate([gap.W[closing] @ a + gap.bend[closing], c_rubs, slide.W @ a + slide.bend])
        W = np.vstack([gap.W[closing], self.modes.along(self.q)[of], slide.W])
        D = W @ responses(self.system, self.t, self.q, W)
        n, last = len(closing), len(closing) + len(of)
        low = np.array([(1.0 - RELEASED) if k in self.grip.released else 1.0 for k in touch])
        force, slides = coulomb(D, c, self._most(of), rubs._replace(coefficient=rubs.coefficient * low))
        pushes = force[:n] > 0.0
        base = np.flatnonzero(pushes).tolist()
        left = (D @ force + c)[n:last]  # accelerations of the joints
        terms = (np.abs(D) @ np.abs(force) + np.abs(c))[n:last] + D.diagonal()[n:last] * self.modes.most[of]
        for k, sign, moves, at in zip(of, np.sign(left), np.abs(left) > AT_MOST * terms, range(n, last), strict=True):
            signs[k] = int(sign) if moves else self._sticks(k, force[at], D, at, base, pushes.sum())
        rubbing = [(k, last + i, int(slides[i])) for i, k in enumerate(touch) if pushes[rubs.normal[i]]]
        sticks = self.grip.groups(D, base, {k: at for k, at, sign in rubbing if not sign})
        slips = {k: sign for k, _, sign in rubbing if sign}
        return Mode(signs, tuple(closing[pushes].tolist()), slips, sticks)

    def _most(self, of: list[int]) -> Array:
        """Return the friction available to joints at rest; slightly reduced for those just released."""
        low = np.minimum(self.modes.kinetic, (1.0 - RELEASED) * self.modes.most)
        return np.array([(low if k in self.released else self.modes.most)[k] for k in of])

    def _sticks(self, k: int, force: float, D: Array, at: int, base: list[int], n_pushing: int) -> int | None:
        """Return STICKS, or IDLE if pushing stops and sticking joints already hold the joint.

        The friction of an idle joint stays constant until one of these releases it; it is zero if stops alone hold it.
        """
        known = np.linalg.lstsq(D[np.ix_(base, base)], D[base, at], rcond=NEGLIGIBLE)[0]
        if D[at, at] - D[at, base] @ known > INDEPENDENT * D[at, at]:
            base.append(at)
            return STICKS
        self.modes.frozen[k] = force if np.abs(known[n_pushing:]).max(initial=0.0) > INDEPENDENT else 0.0
        return IDLE

    def _apply_impulses(self, gap: Gap, near: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Apply the impulses at closed stops to the velocities; return which of these stops would hardly open."""
        touch, slide, rubs = self.grip.rows(near.tolist(), self.t, self.q, self.v, self.speeds)
        rubs = rubs._replace(sign=0 * rubs.sign)  # the direction after the impact counts
        W = np.vstack([gap.W[near], slide.W])
        X = responses(self.system, self.t, self.q, W)  # dry friction of joints causes no impulse
        D, n = W @ X, len(near)
        before, u = self.v, np.append(gap.u[near], slide.u)
        u[np.abs(u) <= ROUNDING * (np.abs(W) @ self.speeds)] = 0.0
        P = impulses(D, u, self.e[near], rubs)
        v = before + X @ P
        slow = self._hardly_open(near, v)
        if (slow & (P[:n] > 0.0) & (self.e[near] > 0.0)).any():
            P = impulses(D, u, np.where(slow, 0.0, self.e[near]), rubs)
            v = before + X @ P
            slow = self._hardly_open(near, v)
        hit = P[:n] > 0.0
        if hit.any():
            names = tuple(self.stops[k].name for k in near[hit])
            rubbed = {k: float(x) for k, x in zip(touch, P[n:], strict=True)}
            along = np.array([rubbed.get(k, 0.0) for k in near[hit].tolist()])
            self.impacts.append(Impact(self.t, names, before.copy(), v.copy(), P[:n][hit], along))
            self.still, self.released, self.grip.still, self.grip.released = set(), set(), set(), set()
        self.v = v
        return slow

    def _hardly_open(self, near: NDArray[np.int64], v: Array) -> NDArray[np.bool_]:
        """Return which stops would rebound by less than the relevant height, pressed together by the others."""
        signs, of = self._sliding(v)
        a, c_rubs = self._free(signs, of, v)
        gap = self.gaps.at(self.t, self.q, v)
        u, c = gap.u[near], gap.W[near] @ a + gap.bend[near]
        rounding = ROUNDING * np.abs(v).max() ** 2
        touch = u * np.abs(u) <= CLOSED * self.low * np.abs(c).max() + rounding
        W = np.vstack([gap.W[near[touch]], self.modes.along(self.q)[of]])
        D, n = W @ responses(self.system, self.t, self.q, W), int(touch.sum())
        force = held(D, np.append(c[touch], c_rubs), n, self._most(of))
        press = np.zeros(len(near))
        press[touch] = (D.diagonal() * force)[:n]
        return np.asarray(u * np.abs(u) <= 2.0 * self.low * press + rounding, dtype=bool)

    def _sliding(self, v: Array) -> tuple[Signs, list[int]]:
        """Return the sliding direction of each joint, and the joints at rest."""
        W = self.modes.along(self.q)
        u = W @ v
        moves = np.abs(u) > AT_REST * (np.abs(W) @ self.speeds)
        slow = [k for k in range(len(u)) if k in self.still or k in self.released or not moves[k]]
        return [0 if k in slow else int(np.sign(u[k])) for k in range(len(u))], slow

    def _free(self, signs: Signs, of: list[int], v: Array) -> tuple[Array, Array]:
        """Return accelerations of coordinates and of joints at rest, without contact forces and friction at rest."""
        a = self._accelerations(self.modes.free(signs, self.t, self.q)).at(self.t, self.q, v)[0]
        return a, self.modes.accelerations(signs, of, self.t, self.q, v, a)

    def _accelerations(self, system: ConstrainedSystem, kept: bool = True) -> Accelerations:
        if id(system) in self._forces:
            return self._forces[id(system)][1]
        made = Accelerations(system, self.t, self.q, self.v, self.options["atol"])
        if kept:
            self._forces[id(system)] = system, made
        return made

    def _with_contacts(self, system: ConstrainedSystem, mode: Mode, kept: bool) -> ConstrainedSystem:
        """Return a system with some stops closed."""
        resting, grip = mode.resting, self.grip
        if not resting:
            return system
        key = id(system), resting, tuple(mode.slips.items())
        if kept and key in self._known:
            return self._known[key][1]
        held = {k for group in mode.sticks.values() for k in group}
        names = ", ".join(f"{self.stops[k].name}{' (sticks)' if k in held else ''}" for k in resting)
        here = grip.slides.at(self.t, self.q, self.v).g
        sticks = {grip.place[k]: float(here[grip.place[k]]) for k in mode.sticks}
        slips = [(resting.index(k), grip.place[k], sign * grip.coefficient(k)) for k, sign in mode.slips.items()]
        made = WithContacts(system, self.gaps, grip.slides, list(resting), sticks, slips).made(names)
        if kept:
            self._known[key] = system, made
        return made

    def _run_arc(self, mode: Mode, t1: float) -> None:
        """Integrate until a gap closes or opens, or a joint or a stop that rubs comes to rest or is released."""
        signs, resting = mode.signs, mode.resting
        free, rows = self.modes.mode(signs, self.t, self.q)
        # the rows of what sticks depend on where it sticks
        lasting = not {STICKS, IDLE} & set(signs) and not mode.sticks
        system = self._with_contacts(free, mode, lasting)
        if system.n_c and (resting or self.modes.n):
            self._project(system, resting)
        start = self.gaps.at(self.t, self.q, self.v)
        holds = self._accelerations(system, lasting) if resting or STICKS in signs else None

        def multiplier(row: int, t: float, q: Array, v: Array) -> float:
            assert holds is not None
            return float(holds.at(t, q, v)[1][row])

        def friction(k: int, t: float, q: Array, v: Array) -> float:
            return -multiplier(rows[k], t, q, v) * self.modes.turned(k, system, rows[k], t, q)

        def pulls(k: int) -> Any:
            row = free.n_c + resting.index(k)
            return terminal(lambda t, q, v: -multiplier(row, t, q, v))

        def grips(row: int, group: list[int], t: float, q: Array, v: Array) -> tuple[float, float]:
            loads = [(free.n_c + resting.index(k), self.grip.coefficient(k)) for k in group]
            return multiplier(row, t, q, v), sum(-mu * multiplier(at, t, q, v) for at, mu in loads)

        events = [self._changes(k, sign, friction) for k, sign in enumerate(signs)]
        events += [pulls(k) if k in resting else self._closes(k, start) for k in range(len(self.stops))]
        n = len(events)
        events += [terminal(self._rests(k, sign)) for k, sign in mode.slips.items()]
        for row, group in enumerate(mode.sticks.values(), free.n_c + len(resting)):
            events.append(terminal(self._slips(partial(grips, row, group))))
        for event in events:
            event.every = self.every
        options = {**self.options, "check_derivatives": self.options.get("check_derivatives", True) and not self.arcs}
        if self.arcs and self.options.get("first_step") is None and self.arcs[-1].h.size:
            least = LEAST_STEP * max(1.0, abs(self.t))  # coordinates near zero have no scale for an initial step
            options["first_step"] = min(max(0.1 * float(self.arcs[-1].h.max()), least), t1 - self.t)
        if resting:
            options |= untraced(options)
        arc = solve_dae(system, (self.t, t1), self.q, self.v, events=events, dense_output=True, **options)
        self.arcs.append(arc)
        over = {k for k in range(len(events)) if arc.t_events is not None and arc.t_events[k].size}
        self.grip.change(mode, {k for i, k in enumerate([*mode.slips, *mode.sticks], n) if i in over})
        n = len(signs)
        if arc.t.size:
            self.speeds = np.abs(arc.v).max(axis=1)
            before, self.t = self.t, float(arc.t[-1])
            if not self._at_once(before):  # else parallel stops take over from one another, with forces of rounding
                self.opened = []
            self.q, self.v = arc.q[:, -1].copy(), arc.v[:, -1].copy()
            if any(n + k in over for k in range(len(self.stops)) if k not in resting):
                self.v = self._landing(arc)
        self.opened += [k for k in resting if n + k in over]
        self.released = {k for k in over if k < n and signs[k] == STICKS}
        self.still = {k for k in range(n) if (not signs[k]) != (k in over)}

    def _landing(self, arc: Result) -> Array:
        """Return the velocities at the end of an arc that ends in an impact.

        The slope of a polynomial over short steps multiplies rounding of q. Where that may be more than the tolerance,
        and explains how far the velocities are from those by Simpson's rule for the last step, the latter are taken.
        """
        v, h = arc.v[:, -1].copy(), float(arc.t[-1] - arc.t[-2]) if arc.t.size > 1 else 0.0
        noise, least = ROUNDING * max(1.0, float(np.abs(arc.q[:, -1]).max())), 0.1 * float(self.options["atol"].min())
        if not 0.0 < h * least <= noise:
            return v
        assert arc.sol is not None
        middle = arc.sol(float(arc.t[-2]) + 0.5 * h)
        summed = arc.v[:, -2] + h / 6.0 * (arc.a[:, -2] + 4.0 * middle.a + arc.a[:, -1])
        return summed if least < np.abs(summed - v).max() <= noise / h else v

    def _project(self, system: ConstrainedSystem, resting: tuple[int, ...]) -> None:
        """Project the state onto the constraints of a mode, from which it deviates by less than the tolerances."""
        self.q = corrected(system, self.t, self.q)
        if resting:
            self.q[np.abs(self.q) < ZERO] = 0.0
            gap = self.gaps.at(self.t, self.q, self.v)
            W, u = gap.W[list(resting)], gap.u[list(resting)]
            X = responses(self.system, self.t, self.q, W)
            self.v = self.v - X @ np.linalg.lstsq(W @ X, u, rcond=NEGLIGIBLE)[0]
        rows, off = system.rows(self.t, self.q), system.velocity_constraint(self.t, self.q, self.v)
        self.v = self.v - np.linalg.lstsq(rows, off, rcond=NEGLIGIBLE)[0]
        self.v[np.abs(self.v) < max(ZERO, 1e-16 * float(self.speeds.max()))] = 0.0

    def _closes(self, k: int, start: Gap) -> Any:
        """Return the event of a gap that is open or about to open; zero where it is as closed as at the start."""
        g0, u0, t0, low = float(start.g[k]), float(start.u[k]), self.t, self.low
        opens = u0 > 0.0 and u0 * u0 > low * 1e-6

        def closes(t: float, q: Array, v: Array) -> float:
            g = float(self.gaps.at(t, q, v).g[k])
            if g0 > low:
                return g
            if opens:
                return (g - g0) / (t - t0) if t > t0 else u0
            return g - min(g0, 0.0) + low

        event = terminal(closes)
        event.gap_rate = lambda t, q, v: float(self.gaps.at(t, q, v).u[k])
        return event

    def _changes(self, k: int, sign: int | None, friction: Any) -> Any:
        """Return the event that ends the mode of a joint."""
        if sign is IDLE:
            return terminal(lambda t, q, v: 1.0)
        if sign != STICKS:
            return terminal(self._stops(k, sign))
        return terminal(self._slips(lambda t, q, v: (friction(k, t, q, v), self.modes.most[k])))

    def _rests(self, k: int, sign: int) -> Any:
        """Return the event of a stop that ceases to slide; one that begins to slide is at rest initially."""
        place, slides = self.grip.place[k], self.grip.slides
        u0 = sign * float(slides.at(self.t, self.q, self.v).u[place])
        least = u0 - self.low if k in self.grip.still | self.grip.released else 0.0
        return lambda t, q, v: sign * float(slides.at(t, q, v).u[place]) - least

    def _stops(self, k: int, sign: int) -> Any:
        """Return the event of a joint that comes to rest; a joint that begins to slide is at rest initially."""
        u0 = sign * float(self.modes.along(self.q, k) @ self.v)
        least = u0 - self.low if k in self.still or k in self.released else 0.0
        return lambda t, q, v: sign * float(self.modes.along(q, k) @ v) - least

    def _slips(self, grips: Any) -> Any:
        """Return the event of friction that is exceeded, from what is needed and there; all of it may slip at once."""
        needed, most = grips(self.t, self.q, self.v)
        if abs(needed) > (1.0 + RELEASED) * most:
            raise Undetermined(f"friction of {abs(needed):.10g} is needed, but it has {most:.10g}")
        room = max(1.0, abs(needed) / most) * (1.0 + AT_MOST) if abs(needed) > (1.0 - AT_MOST) * most else 1.0

        def left(t: float, q: Array, v: Array) -> float:
            needed, most = grips(t, q, v)
            return float(room * most - abs(needed))

        return left


def untraced(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that change for arcs with closed stops, whose callbacks cannot be traced."""
    known = PRESETS["auto"] if isinstance(check_method(options["method"]), Taylor) else options["method"]
    return {"method": known, "compiled": False}


def terminal(event: Any) -> Any:
    """Make an event terminal, with direction from positive to negative."""
    event.terminal, event.direction = True, -1
    return event

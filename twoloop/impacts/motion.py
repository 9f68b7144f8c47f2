"""Integrate motions arc by arc, between impacts, contact and release, sliding and sticking."""

from __future__ import annotations

import inspect
import time
import warnings
from collections.abc import Sequence as Stops
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twoloop.checks.arguments import (
    NEAR,
    Array,
    check_positive,
    check_span,
    check_times,
    check_tolerance,
    check_vector,
    shown,
)
from twoloop.checks.consistency import is_consistent
from twoloop.impacts.contact import Accelerations, ContactSystem, Gap, Gaps, Undetermined
from twoloop.impacts.forces import (
    SLIDING_TOLERANCE,
    coulomb_forces,
    holding_forces,
    impulses,
    responses,
    without_rounding,
)
from twoloop.impacts.friction import (
    IDLE,
    MIN_COMPLIANCE,
    NEGLIGIBLE_RATIO,
    REST_RATE,
    STICKS,
    Mode,
    Modes,
    Signs,
    StopFriction,
)
from twoloop.impacts.joined import Impact, join_arcs
from twoloop.impacts.sequence import Impacts, ImpactWarning, Sequence
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.plan import Method
from twoloop.methods.presets import PRESETS
from twoloop.methods.taylor import Taylor
from twoloop.problem.description import Stop
from twoloop.problem.system import ConstrainedSystem, check_system
from twoloop.result.result import Result
from twoloop.run.fallbacks import corrected_positions
from twoloop.run.options import check_method
from twoloop.run.record import Status
from twoloop.run.signals import SignalHandlers
from twoloop.solve import solve_dae

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import ModelProblem

REBOUND_HEIGHT = 0.01  # height of a rebound, relative to atol, below which the stop stays closed
MIN_EVALUATIONS = 2000  # smallest number of evaluations of gaps, forces and rates of sliding in a motion
PRESSED_RATIO = 1e3  # largest squared rate of stops that may press together, over rebound height times acceleration
ROUNDING = 1e-13  # rounding errors of gaps and rates, relative to max(least_size, |q|)
FIRST_STEP_RATIO = 1e-9  # smallest first step size of an arc, relative to max(1 s, t)
MIN_TIME_LIMIT = 1e-6  # time limit, s, of an arc that begins after the time limit of the motion
# a position nearer to q = 0 than NEGLIGIBLE_POSITION (m or rad), and than MAX_MOVE times atol, is moved there
NEGLIGIBLE_POSITION, MAX_MOVE = 1e-16, 1e-3
NEGLIGIBLE_VALUE = 1e-20  # a coordinate (m or rad) or rate (m/s or rad/s) below this value is a rounding error
ROUNDED_TIMES = 4.0  # largest rounding error of the time of an event, in spacings of floating-point numbers
MAX_STALLED_TIME = 1e-13  # longest duration of a stalled arc, relative to max(1 s, t)
MAX_STALLED_ARCS = 30  # number of stalled arcs in a row that ends the motion
RELEASE_REDUCTION = 1e-7  # relative reduction of the static friction of a joint just released, to avoid chattering
STICKING_MARGIN = 1e-9  # relative tolerance in the comparison of the friction that holds a joint with its bound
EQUAL_GAPS = 4e-15  # largest rounding difference of gaps that close at the same time, relative to max(least_size, |q|)
TIED_GAPS = 0.01  # largest gap, in rebound heights, of stops whose order of closing the tolerances leave open
MAX_DISPLACEMENT = 10.0  # largest motion, in rebound heights, during a sequence of impacts without integration
MAX_GAP = 1e4  # largest gap, in rebound heights, of stops in a sequence of impacts
MIN_RATE_RATIO = 1e-13  # smallest rate, relative to the velocities, that is no rounding error in a sequence of impacts
MAX_DIFFERENCE = 1e-6  # largest difference, relative to velocities, at which two laws of impact count as equal
TOUCHING_EVENT = "an impact reaches stops that touch"
MAX_LISTED = 100  # largest number of impacts of a sequence that are listed one by one
LAWS = ("moreau", "poisson", "sequential")


class Motion:
    """Integrate a motion arc by arc; its state is coordinates, closed stops, and sticking joints.

    Parameters
    ----------
    stops : sequence of Stop
    modes : Modes
        Provides the system in each mode.
    t, q, v : float, ndarray (n_q,), ndarray (n_q,)
    options : dict
        Options of the runs.
    law : "moreau", "poisson", "sequential" or None
        Law of impacts at stops that touch; None: Moreau's, with a warning where impacts one by one give other
        velocities.
    """

    def __init__(
        self,
        stops: Stops[Stop],
        modes: Modes,
        t: float,
        q: Array,
        v: Array,
        options: dict[str, Any],
        law: str | None = None,
    ):
        self.system, self.modes, self.stops, self.options = modes.system, modes, list(stops), options
        self.t, self.q, self.v = t, q, v
        self.restitution = np.array([stop.restitution for stop in stops])
        self.gaps, self.friction = Gaps("gap", stops, t, q), StopFriction(stops, t, q)
        self.law, self.unfinished_sequences = law, []  # type: ignore[var-annotated]
        limit = options.get("time_limit")
        self.deadline = np.inf if limit is None else time.monotonic() + limit
        # impacts whose outcome depends on the law: time, stops, event
        self.law_dependent_impacts: list[tuple[float, list[str], str]] = []
        least_atol, rtol = float(options["atol"].min()), options["rtol"]
        self.least_size = min(1.0, least_atol / rtol) if rtol > 0.0 else 1.0
        size = max(self.least_size, float(np.abs(q).max()))
        self.noise, self.rebound_height = EQUAL_GAPS * size, max(REBOUND_HEIGHT * least_atol, ROUNDING * size)
        closed = np.flatnonzero(self.gaps.evaluate(t, q, v).g < -100.0 * self.rebound_height)
        if closed.size:
            gap = float(self.gaps.evaluate(t, q, v).g[closed[0]])
            raise ValueError(f"gaps must not be negative at q0; that of {stops[closed[0]].name!r} is {gap:.3g}")
        self.arcs: list[Result] = []
        self.impacts: list[Impact] = []
        self.opened_stops: list[int] = []  # stops whose force has just vanished
        self.speeds = np.abs(v)  # largest velocities of the last arc
        self.resting_joints: set[int] = set()  # joints that have stopped or stick
        self.released_joints: set[int] = set()  # joints that stuck in the last arc
        self._contact_systems: dict[Any, tuple[ConstrainedSystem, ConstrainedSystem]] = {}
        self._acceleration_cache: dict[int, tuple[ConstrainedSystem, Accelerations]] = {}

    def integrate(self, t1: float, times: Array | None) -> Result:
        """Integrate to t1 and return the result at the output times (None: at all steps)."""
        with SignalHandlers():
            return self._integrate(t1, times)

    def _integrate(self, t1: float, times: Array | None) -> Result:
        stalled, self.sample_interval = 0, (t1 - self.t) / MIN_EVALUATIONS
        while True:
            t_before = self.t
            try:
                self._run_arc(self._resolve_contacts(), t1)
            except Undetermined as error:
                if not self.arcs:
                    raise
                return self._result(times, f"Stopped at t = {self.t:.10g}: {error}.")
            arc = self.arcs[-1]
            if arc.status != Status.EVENT or self.t >= t1:
                return self._result(times)
            stalled = stalled + 1 if self._is_stalled(t_before) else 0
            if stalled == MAX_STALLED_ARCS:
                names = dict.fromkeys(name for impact in self.impacts[-9:] for name in impact.stops)
                stops = f" ({', '.join(map(repr, names))})" if names else ""
                reason = (
                    f"Stopped at t = {self.t:.10g}: {stalled} impacts or other changes in a row at this time{stops}. "
                    "Look for stops that push against each other, or loosen atol."
                )
                return self._result(times, reason)

    def _result(self, times: Array | None, stagnated: str = "") -> Result:
        if note := self._law_note():
            warnings.warn(note.strip(), ImpactWarning, stacklevel=5)
        return join_arcs(
            self.system, self.arcs, self.impacts, times, stagnated, f"{self._counts_text}{self._law_note()}"
        )

    def _is_stalled(self, before: float) -> bool:
        return self.t - before <= MAX_STALLED_TIME * max(1.0, abs(self.t))

    def _law_note(self) -> str:
        """Describe impacts whose outcome depends on the law, and sequences that were not followed to their end."""
        note = ""
        if self.law_dependent_impacts:
            t, stops, event = self.law_dependent_impacts[0]
            note = (
                f" At t = {t:.6g} {event} ({', '.join(map(repr, stops))}), and the outcome depends on the law: "
                "Moreau's law, used here, joins their impacts into one; impacts one after another, as in Newton's "
                "cradle, give other velocities. For these, leave a small gap between the bodies or set "
                'law="sequential"; law="moreau" confirms the choice.'
            )
        if self.unfinished_sequences:
            t, stops = self.unfinished_sequences[0]
            note += f" At t = {t:.6g} impacts at {', '.join(map(repr, stops))} were too many to follow: do not trust "
            note += "the motion after them."
        return note

    @property
    def _counts_text(self) -> str:
        changes = f"{len(self.arcs) - 1} changes between sliding and sticking."
        if self.stops and (self.modes.n_joints or self.friction.slide_index):
            return f"{len(self.impacts)} impacts, {len(self.arcs) - 1} changes of sliding, sticking or contact."
        return changes if self.modes.n_joints else f"{len(self.impacts)} impacts."

    def _resolve_contacts(self) -> Mode:
        """Apply an impact; return the mode after it: which joints and stops slide or stick, which stops are closed."""
        gap = self.gaps.evaluate(self.t, self.q, self.v)
        # the time of an event is rounded, and the gap closes meanwhile
        reach = self.rebound_height + ROUNDED_TIMES * np.spacing(abs(self.t)) * np.maximum(-gap.u, 0.0)
        near_stops = np.flatnonzero(gap.g <= reach)
        is_slow = np.zeros(near_stops.size, dtype=bool)
        if near_stops.size:
            n_unfinished = len(self.unfinished_sequences)
            if self._follow_impacts(gap, near_stops):
                gap = self.gaps.evaluate(self.t, self.q, self.v)
                # stops that a finished sequence leaves closing will be hit later, in impacts of their own: they are
                # open, even if rounding hides their gaps
                is_finished = len(self.unfinished_sequences) == n_unfinished
                is_closing = gap.u < -REST_RATE * (np.abs(gap.W) @ self.speeds)
                open_stops = is_closing & (is_finished | (gap.g > self.noise))
                near_stops = np.flatnonzero((gap.g <= reach) & ~open_stops)
            for _ in range(MAX_STALLED_ARCS if near_stops.size else 0):
                is_slow = self._apply_impulses(gap, near_stops)
                gap = self.gaps.evaluate(self.t, self.q, self.v)
                # by the law, a stop that had opened may be closing again: its impact is next
                if not (gap.u[near_stops] < -REST_RATE * (np.abs(gap.W[near_stops]) @ self.speeds)).any():
                    break
            # a stop that has just opened has no force
            is_slow = is_slow[: near_stops.size] & ~np.isin(near_stops, self.opened_stops)
        closing_stops = near_stops[is_slow]
        signs, resting_joints = self._sliding_directions(self.v)
        if not closing_stops.size and not resting_joints:
            return Mode(signs)
        a, c_joints = self._free_accelerations(signs, resting_joints, self.v)
        gap = self.gaps.evaluate(self.t, self.q, self.v)
        friction_stops, slide, tangents = self.friction.contact_rows(
            closing_stops.tolist(), self.t, self.q, self.v, self.speeds
        )
        c = np.concatenate(
            [
                without_rounding(gap.W @ a + gap.bias, gap.W, a, gap.bias)[closing_stops],
                c_joints,
                without_rounding(slide.W @ a + slide.bias, slide.W, a, slide.bias),
            ]
        )
        W = np.vstack([gap.W[closing_stops], self.modes.gradients(self.q)[resting_joints], slide.W])
        D = W @ responses(self.system, self.t, self.q, W)
        n, end = len(closing_stops), len(closing_stops) + len(resting_joints)
        reduction = np.array(
            [(1.0 - RELEASE_REDUCTION) if k in self.friction.released_stops else 1.0 for k in friction_stops]
        )
        tangents = tangents._replace(coefficient=tangents.coefficient * reduction)
        force, slides = coulomb_forces(D, c, self._available_friction(resting_joints), tangents)
        is_pushing = force[:n] > 0.0
        basis = np.flatnonzero(is_pushing).tolist()
        accelerations = (D @ force + c)[n:end]  # accelerations of the joints
        terms = (np.abs(D) @ np.abs(force) + np.abs(c))[n:end]
        terms += D.diagonal()[n:end] * self.modes.static_friction[resting_joints]
        for k, sign, is_moving, row in zip(
            resting_joints,
            np.sign(accelerations),
            np.abs(accelerations) > STICKING_MARGIN * terms,
            range(n, end),
            strict=True,
        ):
            signs[k] = int(sign) if is_moving else self._stick_or_idle(k, force[row], D, row, basis, is_pushing.sum())
        friction_contacts = [
            (k, end + i, int(slides[i])) for i, k in enumerate(friction_stops) if is_pushing[tangents.normal[i]]
        ]
        sticking_rows = {k: row for k, row, sign in friction_contacts if not sign}
        sticks = self.friction.sticking_groups(D, basis, sticking_rows, n, force)
        sliding_stops = {k: sign for k, _, sign in friction_contacts if sign}
        return Mode(signs, tuple(closing_stops[is_pushing].tolist()), sliding_stops, sticks)

    def _available_friction(self, joints: list[int]) -> Array:
        """Return the friction available to joints at rest; slightly reduced for joints that were just released."""
        reduced = np.minimum(self.modes.kinetic_friction, (1.0 - RELEASE_REDUCTION) * self.modes.static_friction)
        return np.array([(reduced if k in self.released_joints else self.modes.static_friction)[k] for k in joints])

    def _stick_or_idle(self, k: int, force: float, D: Array, row: int, basis: list[int], n_pushing: int) -> int | None:
        """Return STICKS, or IDLE if pushing stops and sticking joints already hold the joint.

        The friction of an idle joint is constant until a stop or joint releases it; it is zero if stops alone hold it.
        """
        weights = np.linalg.lstsq(D[np.ix_(basis, basis)], D[basis, row], rcond=NEGLIGIBLE_RATIO)[0]
        if D[row, row] - D[row, basis] @ weights > MIN_COMPLIANCE * D[row, row]:
            basis.append(row)
            return STICKS
        self.modes.idle_friction[k] = force if np.abs(weights[n_pushing:]).max(initial=0.0) > MIN_COMPLIANCE else 0.0
        return IDLE

    def _apply_impulses(self, gap: Gap, near: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Apply the impulses at closed stops to the velocities; return a mask of the stops with low rebounds."""
        friction_stops, slide, tangents = self.friction.contact_rows(near.tolist(), self.t, self.q, self.v, self.speeds)
        tangents = tangents._replace(sign=0 * tangents.sign)  # friction opposes the sliding after the impact
        W = np.vstack([gap.W[near], slide.W])
        X = responses(self.system, self.t, self.q, W)  # dry friction of joints causes no impulse
        D, n = W @ X, len(near)
        v_before, u = self.v, without_rounding(np.append(gap.u[near], slide.u), W, self.speeds)
        P = impulses(D, u, self.restitution[near], tangents, self.law)
        v = v_before + X @ P
        is_slow = self._has_low_rebound(near, v)
        if (is_slow & (P[:n] > 0.0) & (self.restitution[near] > 0.0)).any():
            P = impulses(D, u, np.where(is_slow, 0.0, self.restitution[near]), tangents, self.law)
            v = v_before + X @ P
            is_slow = self._has_low_rebound(near, v)
        self.v = v
        if (P[:n] > 0.0).any():
            self._record_impact(v_before, near, P, friction_stops)
        return is_slow

    def _record_impact(self, v_before: Array, stops: NDArray[np.int64], P: Array, friction_stops: list[int]) -> None:
        """Record an impact with velocities `self.v` after it; P: impulses of the stops, then of their friction."""
        n = len(stops)
        is_hit = P[:n] > 0.0
        friction_impulses = {k: float(x) for k, x in zip(friction_stops, P[n:], strict=True)}
        friction = np.array([friction_impulses.get(k, 0.0) for k in stops[is_hit].tolist()])
        names = tuple(self.stops[k].name for k in stops[is_hit])
        self.impacts.append(Impact(self.t, names, v_before.copy(), self.v.copy(), P[:n][is_hit], friction))
        self.resting_joints, self.released_joints = set(), set()
        self.friction.resting_stops, self.friction.released_stops = set(), set()

    def _follow_impacts(self, gap: Gap, near: NDArray[np.int64]) -> bool:
        """Follow impacts that succeed one another too fast for an integration between them; return whether any did.

        Stops that close at the same time share an impact by Moreau's law. All others are hit in the order of their
        closing, however soon, because another order or a shared impact would result in other velocities.
        """
        rounding = MIN_RATE_RATIO * np.abs(gap.W).sum(axis=1) * float(self.speeds.max())
        at_rest = REST_RATE * (np.abs(gap.W) @ self.speeds) + rounding
        reach = np.flatnonzero((gap.g <= MAX_GAP * self.rebound_height) | np.isin(np.arange(len(gap.g)), near))
        first = near[gap.u[near] < -at_rest[near]]
        if len(reach) < 2 or not first.size:
            return False
        friction_stops, slide, tangents = self.friction.contact_rows(
            reach.tolist(), self.t, self.q, self.v, self.speeds
        )
        W = np.vstack([gap.W[reach], slide.W])
        X = responses(self.system, self.t, self.q, W)
        slide_rates = without_rounding(slide.u, slide.W, self.speeds)
        u = np.append(np.where(np.abs(gap.u) <= at_rest, 0.0, gap.u)[reach], slide_rates)
        data = W @ X, self.restitution[reach], tangents, self.noise, rounding[reach], self.law
        impacts = Impacts(*data, self.deadline)
        a = self._free_accelerations(*self._sliding_directions(self.v), self.v)[0]
        largest_v, largest_a = float(np.abs(self.v).max()), float(np.abs(a).max())
        limit = min(
            MAX_DISPLACEMENT * self.rebound_height / max(largest_v, 1e-300),
            np.sqrt(2.0 * self.rebound_height / max(largest_a, 1e-300)),
        )
        g, together = gap.g[reach].copy(), self.law != "sequential"
        tied_stops = np.flatnonzero(np.isin(reach, first) & (g <= max(self.noise, TIED_GAPS * self.rebound_height)))

        def follow_order(gaps: Array, together: bool) -> Sequence | None:  # None: its impacts are not determined
            with suppress(Undetermined):
                return impacts.follow(gaps, u, limit, together)
            return None

        def differ(order_a: Sequence | None, order_b: Sequence | None) -> bool:
            if order_a is None or order_b is None:
                return True
            change = np.abs(X @ (order_a.impulses - order_b.impulses)).max()
            return bool(change > MAX_DIFFERENCE * np.abs(X @ order_a.impulses).max())

        is_ambiguous = False
        if together and len(tied_stops) > 1:
            orders = []
            for k in tied_stops:
                in_order = g.copy()
                in_order[tied_stops] = np.maximum(g[tied_stops], 2.0 * self.noise)
                in_order[k] = 0.0
                orders.append(follow_order(in_order, together))
            is_ambiguous = any(differ(order, orders[0]) for order in orders)
            if is_ambiguous:
                g[tied_stops] = 0.0
        sequence = impacts.follow(g, u, limit, together)
        P, v_before, n = sequence.impulses, self.v, len(reach)
        names = [self.stops[k].name for k in (reach[P[:n] > 0.0] if (P[:n] > 0.0).any() else first)]
        if not sequence.is_complete:
            self.unfinished_sequences.append((self.t, names))
        is_touching = (g <= self.noise) & (u[: len(g)] <= 0.0)
        if (
            self.law is None
            and sequence.has_shared_impacts
            and (is_ambiguous or differ(follow_order(g, False), sequence))
        ):
            event = "stops close at once, in an order within the tolerance" if is_ambiguous else TOUCHING_EVENT
            self.law_dependent_impacts.append(
                (self.t, [self.stops[k].name for k in reach[g <= self.noise]] or names, event)
            )
        at_once = {int(k) for k in reach[is_touching]}
        if len(sequence.impact_impulses) <= 1 and set(near.tolist()) <= at_once:
            return False  # a single impact, which all of these stops share
        self.q = self.q + v_before * sequence.duration + X @ sequence.drift
        for step in sequence.impact_impulses if len(sequence.impact_impulses) <= MAX_LISTED else [P]:
            self.v = self.v + X @ step
            self._record_impact(v_before, reach, step, friction_stops)
            v_before = self.v
        return True

    def _has_low_rebound(self, near: NDArray[np.int64], v: Array) -> NDArray[np.bool_]:
        """Return a mask of the stops that, pressed by forces or other stops, rebound by less than `rebound_height`."""
        signs, resting_joints = self._sliding_directions(v)
        a, c_joints = self._free_accelerations(signs, resting_joints, v)
        gap = self.gaps.evaluate(self.t, self.q, v)
        u, c = gap.u[near], gap.W[near] @ a + gap.bias[near]
        sizes = np.abs(gap.W[near])
        height = np.maximum(self.rebound_height, ROUNDING * (sizes @ np.abs(self.q)))
        rounding = (ROUNDING * (sizes @ self.speeds)) ** 2
        is_pressed = u * np.abs(u) <= PRESSED_RATIO * height * np.abs(c).max() + rounding
        W = np.vstack([gap.W[near[is_pressed]], self.modes.gradients(self.q)[resting_joints]])
        D, n = W @ responses(self.system, self.t, self.q, W), int(is_pressed.sum())
        c_all = np.append(c[is_pressed], c_joints)
        force = holding_forces(D, c_all, n, self._available_friction(resting_joints))
        acceleration, terms = (D @ force + c_all)[:n], (np.abs(D) @ np.abs(force) + np.abs(c_all))[:n]
        pressures = (D.diagonal() * force)[:n]
        # stops that share a load in any proportion are all pressed, even if the others carry it
        pressures[(force[:n] == 0.0) & (np.abs(acceleration) <= SLIDING_TOLERANCE * terms)] = pressures.max(initial=0.0)
        pressure = np.zeros(len(near))
        pressure[is_pressed] = pressures
        return np.asarray(u * np.abs(u) <= 2.0 * height * pressure + rounding, dtype=bool)

    def _sliding_directions(self, v: Array) -> tuple[Signs, list[int]]:
        """Return the sliding direction of each joint, and the joints at rest."""
        W = self.modes.gradients(self.q)
        u = W @ v
        is_moving = np.abs(u) > REST_RATE * (np.abs(W) @ self.speeds)
        slow = [k for k in range(len(u)) if k in self.resting_joints or k in self.released_joints or not is_moving[k]]
        return [0 if k in slow else int(np.sign(u[k])) for k in range(len(u))], slow

    def _free_accelerations(self, signs: Signs, resting_joints: list[int], v: Array) -> tuple[Array, Array]:
        """Return accelerations of coordinates and of joints at rest, without contact forces and friction at rest."""
        a = self._accelerations(self.modes.sliding_system(signs, self.t, self.q)).evaluate(self.t, self.q, v)[0]
        return a, self.modes.joint_accelerations(signs, resting_joints, self.t, self.q, v, a)

    def _accelerations(self, system: ConstrainedSystem, cached: bool = True) -> Accelerations:
        if id(system) in self._acceleration_cache:
            return self._acceleration_cache[id(system)][1]
        accelerations = Accelerations(system, self.t, self.q, self.v, self.options["atol"])
        if cached:
            self._acceleration_cache[id(system)] = system, accelerations
        return accelerations

    def _contact_system(self, system: ConstrainedSystem, mode: Mode, cached: bool) -> ConstrainedSystem:
        """Return the system with the closed stops of a mode as constraints."""
        resting, friction = mode.closed_stops, self.friction
        if not resting:
            return system
        key = id(system), resting, tuple(mode.sliding_stops.items())
        if cached and key in self._contact_systems:
            return self._contact_systems[key][1]
        sticking = {k for group in mode.sticking_groups.values() for k in group}
        names = ", ".join(f"{self.stops[k].name}{' (sticks)' if k in sticking else ''}" for k in resting)
        sticks = np.zeros((len(mode.sticking_groups), friction.slides.n))
        for row, shares in enumerate(mode.sticking_groups.values()):
            sticks[row, [friction.slide_index[k] for k in shares]] = list(shares.values())
        places = sticks @ friction.slides.evaluate(self.t, self.q, self.v).g
        sliding_stops = [
            (resting.index(k), friction.slide_index[k], sign * friction.coefficient(k))
            for k, sign in mode.sliding_stops.items()
        ]
        extended = ContactSystem(
            system, self.gaps, friction.slides, list(resting), sticks, places, sliding_stops
        ).build(names)
        if cached:
            self._contact_systems[key] = system, extended
        return extended

    def _run_arc(self, mode: Mode, t1: float) -> None:
        """Integrate until a gap closes or opens, or a joint or a stop with friction comes to rest or is released."""
        signs, resting = mode.signs, mode.closed_stops
        # rows of the extended system: C, the gaps of the resting stops, then the rows of sticking joints and stops
        free_system, rows = self.modes.mode_system(signs, self.t, self.q)
        # a system with sticking parts cannot be cached: its rows depend on where these stick
        cacheable = not {STICKS, IDLE} & set(signs) and not mode.sticking_groups
        system = self._contact_system(free_system, mode, cacheable)
        if system.n_c and (resting or self.modes.n_joints or self.arcs):
            self._project(system, resting)
        if self.arcs or resting:
            self.q[np.abs(self.q) < NEGLIGIBLE_VALUE] = 0.0
            if np.abs(self.q).max() < min(NEGLIGIBLE_POSITION, MAX_MOVE * self.options["atol"].min()):
                self.q[:] = 0.0  # if only some of these coordinates were zero, they might violate the constraints
            self.v[np.abs(self.v) < max(NEGLIGIBLE_VALUE, 1e-16 * float(self.speeds.max()))] = 0.0
        start = self.gaps.evaluate(self.t, self.q, self.v)
        accelerations = self._accelerations(system, cacheable) if resting or STICKS in signs else None

        def multiplier(row: int, t: float, q: Array, v: Array) -> float:
            assert accelerations is not None
            return float(accelerations.evaluate(t, q, v)[1][row])

        def friction(k: int, t: float, q: Array, v: Array) -> float:
            return -multiplier(rows[k], t, q, v) * self.modes.row_sign(k, system, rows[k], t, q)

        def contact_force(k: int) -> Any:
            row = free_system.n_c + resting.index(k)
            return make_terminal(lambda t, q, v: -multiplier(row, t, q, v))

        def friction_balance(row: int, group: dict[int, float], t: float, q: Array, v: Array) -> tuple[float, float]:
            loads = [(free_system.n_c + resting.index(k), self.friction.coefficient(k)) for k in group]
            return multiplier(row, t, q, v), sum(-mu * multiplier(normal, t, q, v) for normal, mu in loads)

        events = [self._joint_event(k, sign, friction) for k, sign in enumerate(signs)]
        events += [contact_force(k) if k in resting else self._gap_event(k, start) for k in range(len(self.stops))]
        n = len(events)
        events += [make_terminal(self._stop_rest_event(k, sign)) for k, sign in mode.sliding_stops.items()]
        for row, group in enumerate(mode.sticking_groups.values(), free_system.n_c + len(resting)):
            events.append(make_terminal(self._slip_event(partial(friction_balance, row, group))))
        for event in events:
            event.every = self.sample_interval
        options = {**self.options, "check_derivatives": self.options.get("check_derivatives", True) and not self.arcs}
        if self.arcs and self.options.get("first_step") is None and self.arcs[-1].h.size:
            least_step = FIRST_STEP_RATIO * max(1.0, abs(self.t))  # coordinates near zero give no scale for a step
            options["first_step"] = min(max(0.1 * float(self.arcs[-1].h.max()), least_step), t1 - self.t)
        if self.deadline < np.inf:
            options["time_limit"] = max(self.deadline - time.monotonic(), MIN_TIME_LIMIT)
        if resting:  # the callbacks of an extended system call other callbacks, and cannot be traced
            needs_traces = isinstance(check_method(options["method"]), Taylor | Lobatto16)
            options |= {"method": PRESETS["auto"] if needs_traces else options["method"], "compiled": False}
        try:
            arc = solve_dae(system, (self.t, t1), self.q, self.v, events=events, dense_output=True, **options)
        except ValueError as error:
            if self.arcs and not is_consistent(system, self.t, self.q, self.v):
                raise Undetermined(f"no motion can begin there; {error}") from error
            raise
        if arc.status == Status.EVENT and t1 - arc.t[-1] <= NEAR * np.spacing(abs(t1)):  # no time for another arc
            arc = solve_dae(system, (self.t, t1), self.q, self.v, dense_output=True, **options)
        self.arcs.append(arc)
        ended = {k for k in range(len(events)) if arc.t_events is not None and arc.t_events[k].size}
        self.friction.update(
            mode, {k for i, k in enumerate([*mode.sliding_stops, *mode.sticking_groups], n) if i in ended}
        )
        n = len(signs)
        if arc.t.size:
            self.speeds = np.abs(arc.v).max(axis=1)
            t_before, self.t = self.t, float(arc.t[-1])
            # if the arc stalled, keep the opened stops: otherwise parallel stops would alternate by rounding
            if not self._is_stalled(t_before):
                self.opened_stops = []
            self.q, self.v = arc.q[:, -1].copy(), arc.v[:, -1].copy()
            if any(n + k in ended for k in range(len(self.stops)) if k not in resting):
                self.v = self._impact_velocities(arc)
        self.opened_stops += [k for k in resting if n + k in ended]
        self.released_joints = {k for k in ended if k < n and signs[k] == STICKS}
        self.resting_joints = {k for k in range(n) if (not signs[k]) != (k in ended)}

    def _impact_velocities(self, arc: Result) -> Array:
        """Return the velocities at the end of an arc that ends in an impact.

        In short steps the slope of the interpolating polynomial magnifies rounding of q. If this error may exceed the
        tolerance, and explains the difference from velocities by Simpson's rule, velocities by this rule are returned.
        """
        v, h = arc.v[:, -1].copy(), float(arc.t[-1] - arc.t[-2]) if arc.t.size > 1 else 0.0
        noise = ROUNDING * max(self.least_size, float(np.abs(arc.q[:, -1]).max()))
        tolerance = 0.1 * float(self.options["atol"].min())
        if not 0.0 < h * tolerance <= noise:
            return v
        assert arc.sol is not None
        middle = arc.sol(float(arc.t[-2]) + 0.5 * h)
        v_by_simpson = arc.v[:, -2] + h / 6.0 * (arc.a[:, -2] + 4.0 * middle.a + arc.a[:, -1])
        return v_by_simpson if tolerance < np.abs(v_by_simpson - v).max() <= noise / h else v

    def _project(self, system: ConstrainedSystem, resting: tuple[int, ...]) -> None:
        """Project the state onto the constraints of a mode, from which it deviates by less than the tolerances."""
        self.q = corrected_positions(system, self.t, self.q)
        if resting:
            gap = self.gaps.evaluate(self.t, self.q, self.v)
            W, u = gap.W[list(resting)], gap.u[list(resting)]
            X = responses(self.system, self.t, self.q, W)
            self.v = self.v - X @ np.linalg.lstsq(W @ X, u, rcond=NEGLIGIBLE_RATIO)[0]
        rows, violation = system.rows(self.t, self.q), system.velocity_constraint(self.t, self.q, self.v)
        self.v = self.v - np.linalg.lstsq(rows, violation, rcond=NEGLIGIBLE_RATIO)[0]

    def _gap_event(self, k: int, start: Gap) -> Any:
        """Return the event of a gap that is open or about to open: its function is zero when the gap closes again."""
        g0, u0, t0, low = float(start.g[k]), float(start.u[k]), self.t, self.rebound_height
        opens = u0 > 0.0 and u0 * u0 > low * 1e-6
        noise, closing = self.noise, u0 < -REST_RATE * float(np.abs(start.W[k]) @ self.speeds)

        def gap_function(t: float, q: Array, v: Array) -> float:
            g = float(self.gaps.evaluate(t, q, v).g[k])
            if np.isnan(g):  # a step has gone beyond the limit of a hinge in space, to an angle that has no value
                return -1.0
            if g0 > low or (closing and g0 > noise):
                return g
            if opens:
                return (g - g0) / (t - t0) if u0 * (t - t0) > noise else u0  # at first, g changes by rounding alone
            return g - min(g0, 0.0) + low

        event = make_terminal(gap_function)
        event.gap_rate = lambda t, q, v: float(self.gaps.evaluate(t, q, v).u[k])
        return event

    def _joint_event(self, k: int, sign: int | None, friction: Any) -> Any:
        """Return the event that ends the state of a joint: sliding, sticking or idle."""
        if sign is IDLE:
            return make_terminal(lambda t, q, v: 1.0)
        if sign != STICKS:  # the event is the end of sliding; the rate is zero at first if sliding has just begun
            u0 = sign * float(self.modes.gradients(self.q, k) @ self.v)
            rests = k in self.resting_joints or k in self.released_joints
            offset = u0 - self._least_rate(self.modes.gradients(self.q, k)) if rests else 0.0
            return make_terminal(lambda t, q, v: sign * float(self.modes.gradients(q, k) @ v) - offset)
        return make_terminal(self._slip_event(lambda t, q, v: (friction(k, t, q, v), self.modes.static_friction[k])))

    def _stop_rest_event(self, k: int, sign: int) -> Any:
        """Return the event at which a stop ceases to slide; the rate is zero at first if sliding has just begun."""
        slide, slides = self.friction.slide_index[k], self.friction.slides
        start = slides.evaluate(self.t, self.q, self.v)
        u0 = sign * float(start.u[slide])
        rests = k in self.friction.resting_stops | self.friction.released_stops
        offset = u0 - self._least_rate(start.W[slide]) if rests else 0.0
        return lambda t, q, v: sign * float(slides.evaluate(t, q, v).u[slide]) - offset

    def _least_rate(self, row: Array) -> float:
        """Return the rate of sliding (m/s or rad/s) that is more than rounding: for slow motions, less than usually."""
        return min(self.rebound_height, max(REST_RATE * float(np.abs(row) @ self.speeds), NEGLIGIBLE_VALUE))

    def _slip_event(self, balance: Any) -> Any:
        """Return the event at which the friction needed exceeds that available; balance(t, q, v) returns both."""
        needed, available = balance(self.t, self.q, self.v)
        if abs(needed) > (1.0 + RELEASE_REDUCTION) * available + NEGLIGIBLE_VALUE:
            raise Undetermined(f"friction of {abs(needed):.10g} is needed, but it has {available:.10g}")
        fully_used = available > 0.0 and abs(needed) > (1.0 - STICKING_MARGIN) * available
        margin = max(1.0, abs(needed) / available) * (1.0 + STICKING_MARGIN) if fully_used else 1.0

        def reserve(t: float, q: Array, v: Array) -> float:
            needed, available = balance(t, q, v)
            return float(margin * available - abs(needed))

        return reserve


def make_terminal(event: Any) -> Any:
    """Make an event terminal, at zeros from positive to negative values."""
    event.terminal, event.direction = True, -1
    return event


RESERVED_OPTIONS = {"system", "t_span", "q0", "v0", "method", "rtol", "atol", "t_eval", "step_size"}
RESERVED_OPTIONS |= {"events", "dense_output", "store"}


def solve_with_stops(
    system: ConstrainedSystem,
    t_span: tuple[float, float],
    q0: ArrayLike,
    v0: ArrayLike,
    stops: Stop | Stops[Stop],
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    law: Literal["moreau", "poisson", "sequential"] | None = None,
    **options: Any,
) -> Result:
    """Integrate a system with stops: impacts with restitution, rest in contact, and release.

    An impact changes the velocities by impulses at the closed stops and the impulses of all constraints:
    M (v+ - v-) + C_q^T p = W^T P, with C_q v+ + C_t = 0. Stops that close one after another are hit one by one, however
    soon, and infinitely many impacts are followed to their limit. Where several stops are closed already, as between
    touching balls, the outcome depends on `law`. The rebound height decreases by the square of the restitution; a
    rebound below a hundredth of `atol` ends in contact: the gap is then a constraint as long as its force pushes.

    Stops with friction slide or stick while they are closed, by Coulomb's law. In an impact, the impulse of friction
    stops the sliding, if the coefficient times the impulse of the stop suffices; otherwise it has that value and
    opposes the sliding after the impact. A run ends where friction leaves the motion undetermined (a jam), or where the
    law would add energy, as is possible for a large restitution.

    Parameters
    ----------
    system, t_span, q0, v0, method, rtol, atol
        As for `solve_dae`. The gaps must not be negative at the start. While stops are closed, "auto" takes the place
        of "Taylor" and "Lobatto16", which need traces of their forces, and `compiled=True` has no effect.
    stops : Stop or sequence of Stop
        E.g. `Stop(lambda t, q: q[1], restitution=0.5)`, or `problem.stops` of a model.
    t_eval : array_like, optional
        Output times. None: the ends of steps, with two columns at an impact, before and after it.
    law : "moreau", "poisson" or "sequential", optional
        Law of an impact at stops that touch already or close at once. "moreau": they share one impact, by Moreau's law,
        which keeps the symmetry of a box that lands flat; restitution is the ratio of the rates at each stop.
        "poisson": they share one impact, by Poisson's law; restitution is the ratio of the impulses of expansion and
        compression, so that a stop at rest opens, too. Without friction only. "sequential": impacts follow one another,
        the fastest first, as in Newton's cradle and as with small gaps. None: Moreau's law, with an `ImpactWarning`
        where impacts one by one give other velocities.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit, ...

    Returns
    -------
    Result
        `.impacts` lists the impacts, `.arcs` the runs between them, `.sol` is the state at any time. `.lam` are the
        multipliers of the system; in an arc with closed stops, those of the stops follow those of C, and the force of
        a stop is the negative of its multiplier. Stops that stick have a row each, after those of all gaps.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, or a gap cannot be traced or is negative at the start.

    Notes
    -----
    Impacts and releases are located like events. The gaps, their rates and the forces of closed stops are evaluated
    four times per step, and at least at every two-thousandth of the motion. A gap that closes and opens again between
    two evaluations is found, unless its rate changes sign more than once between them; then reduce `max_step`. The time
    of an impact is as accurate as the motion before it.

    Examples
    --------
    >>> from twoloop import Stop, solve_with_stops
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> stop = Stop(lambda t, q: 1.0 - q[8], restitution=0.5, name="stop")  # the third bar turns to 1 rad at most
    >>> result = solve_with_stops(problem.system, (0.0, 0.6), problem.q0, problem.v0, stop)
    >>> bool(result.q[8].max() <= 1.0 + 1e-8), len(result.impacts)
    (True, 1)
    """
    check_system(system)
    t0, t1 = check_span(t_span)
    q, v = check_vector("q0", q0, system.n_q), check_vector("v0", v0, system.n_q)
    stops = [stops] if isinstance(stops, Stop) else stops
    if not isinstance(stops, (list, tuple)) or not stops or not all(isinstance(stop, Stop) for stop in stops):
        raise TypeError(f"stops must be a Stop or a list of them; given {shown(stops)}")
    options |= checked_options("solve_with_stops", options, method, rtol, atol, system.n_q)
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    return Motion(stops, Modes(system), t0, q, v, options, check_law(law, stops)).integrate(t1, times)


def check_law(law: str | None, stops: Stops[Stop]) -> str | None:
    """Return the name of a law of impacts; raise ValueError for an unknown one, or one that does not suit the stops."""
    if law is not None and law not in LAWS:
        raise ValueError(f"law must be one of {', '.join(map(repr, LAWS))}, or None; given {shown(law)}")
    rough = [stop.name for stop in stops if stop.friction > 0.0]
    if law == "poisson" and rough:
        raise ValueError(f"law='poisson' is for stops without friction; {rough[0]!r} has some. Choose another law")
    return law


def checked_options(
    caller: str, options: dict[str, Any], method: str | Method, rtol: float, atol: ArrayLike, n_q: int
) -> dict[str, Any]:
    """Return options of runs that include method and tolerances; raise TypeError for unknown options."""
    names = inspect.signature(solve_dae).parameters.keys() - RESERVED_OPTIONS
    unknown = [name for name in options if name not in names]
    if unknown:
        raise TypeError(f"{caller} has no option {unknown[0]!r}; those of runs are {', '.join(sorted(names))}")
    check_positive("rtol", rtol)
    if options.get("time_limit") is not None:
        check_positive("time_limit", options["time_limit"])
    return {"method": method, "rtol": rtol, "atol": check_tolerance("atol", atol, n_q)}


def solve_with_friction(
    problem: ModelProblem,
    t_span: tuple[float, float] | None = None,
    method: str | Method = "auto",
    rtol: float = 1e-8,
    atol: ArrayLike = 1e-8,
    *,
    t_eval: ArrayLike | None = None,
    law: Literal["moreau", "poisson", "sequential"] | None = None,
    **options: Any,
) -> Result:
    """Integrate a model with dry friction, and with its stops: joints slide, stop, stick, and are released.

    The friction of a sliding joint is a constant force; a sticking joint is a constraint, released when its force
    exceeds the static friction. When joints come to rest, their friction forces and the forces of closed stops are
    the bounded minimum of F^T D F / 2 + c^T F, with c the joint accelerations without friction; joints stick where the
    bound is not active. Impacts are those of `solve_with_stops`: load-independent friction causes no impulse, so an
    impact may release sticking joints.

    Parameters
    ----------
    problem : ModelProblem
        Problem of a model with `dry_friction`; the run starts at its q0 and v0.
    t_span : (float, float), optional
        None: the time span of the problem.
    method, rtol, atol
        As for `solve_with_stops`.
    t_eval : array_like, optional
        Output times. None: the ends of steps.
    law : "moreau", "poisson" or "sequential", optional
        As for `solve_with_stops`.
    **options
        Further keyword arguments of `solve_dae`: max_step, compiled, time_limit, ...

    Returns
    -------
    Result
        `.arcs` are the runs between changes of mode; the names of their systems contain the sticking joints and the
        closed stops. `.impacts` as for `solve_with_stops`.

    Raises
    ------
    TypeError, ValueError
        If an argument is invalid, the model has no dry friction, or a joint with friction cannot slide independently.

    Notes
    -----
    Mode changes are located like events, by checks four times per step and at least every two-thousandth of the motion:
    a joint that reverses twice between two of these is missed; reduce `max_step` if needed.

    Examples
    --------
    >>> from twoloop import solve_with_friction
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="block")
    >>> block = model.box("block", (0.2, 0.1), mass=1.0, position=(0.0, 0.0), velocity=(1.0, 0.0))
    >>> rail = model.prismatic("ground", block, at=(0.0, 0.0), axis=(1.0, 0.0))
    >>> friction = model.dry_friction(rail, 2.0)
    >>> result = solve_with_friction(model.problem((0.0, 1.0)))
    >>> round(float(result.q[0, -1]), 6)  # v**2 / (2 a), m
    0.25
    """
    from twoloop.bodies.model_problem import ModelProblem  # slow to import

    if not isinstance(problem, ModelProblem):
        raise TypeError(f"problem must be a model's problem, as returned by model.problem(); given {shown(problem)}")
    if problem.model is None:
        raise ValueError(f"{problem.name!r} came from another process without its model: make it again there")
    if not problem.model.dry:
        raise ValueError(
            f"{problem.name!r} has no dry friction: add some with model.dry_friction(...), or use solve_dae"
        )
    t0, t1 = problem.t_span if t_span is None else check_span(t_span)
    options |= checked_options("solve_with_friction", options, method, rtol, atol, problem.system.n_q)
    times = None if t_eval is None else check_times(t_eval, t0, t1, None)
    start = t0, problem.q0.copy(), problem.v0.copy()
    return Motion(
        problem.stops, Modes(problem.system, problem), *start, options, check_law(law, problem.stops)
    ).integrate(t1, times)

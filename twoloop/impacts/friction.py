"""Record which joints and stops slide or stick, and provide the system of each such mode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from twoloop.checks.arguments import Array
from twoloop.impacts.contact import Gap, Gaps, Undetermined
from twoloop.impacts.forces import COUPLING_TOLERANCE, Tangents, responses, without_rounding
from twoloop.problem.description import Stop
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import NEGLIGIBLE_RATIO

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import ModelProblem

Signs = list[int | None]  # for each joint: its sliding direction (1 or -1), STICKS or IDLE
STICKS, IDLE = 0, None  # states of a joint at rest: STICKS, held by its own friction; IDLE, held by other contacts
MIN_COMPLIANCE = 1e-9  # smallest ratio of compliances, other joints held / free, of a joint that can slide by itself
REST_RATE = 1e-10  # largest rate that counts as zero, relative to the largest velocities of the last arc


class Modes:
    """Provide the system of each mode of a motion: each joint with dry friction slides, with a sign, or sticks (0).

    Parameters
    ----------
    system : ConstrainedSystem
    problem : ModelProblem, optional
        Problem of the system, with dry friction in joints. None: there is none, and only one mode.

    Raises ValueError if a joint cannot slide independently of the other joints.
    """

    def __init__(self, system: ConstrainedSystem, problem: ModelProblem | None = None):
        self.system, self._problem = system, problem
        self._frictions = [] if problem is None or problem.model is None else problem.model.dry
        self._names = [friction.name for friction in self._frictions]
        self.n_joints = len(self._frictions)
        self.static_friction = np.array([friction.static for friction in self._frictions])
        self.kinetic_friction = np.array([friction.kinetic for friction in self._frictions])
        self.idle_friction: dict[int, float] = {}  # constant friction of IDLE joints
        self._sliding_systems: dict[tuple[int | None, ...], ConstrainedSystem] = {}
        if problem is not None and problem.model is not None:
            self._forces = [problem.model.pull(friction, problem.parameters) for friction in self._frictions]
            self._check_independent(problem.t_span[0], problem.q0)

    def gradients(self, q: Array, k: int | None = None) -> Array:
        """Return the gradients of the joint displacements, (n, n_q); or of one joint, (n_q,)."""
        if k is None:
            return np.array([self.gradients(q, joint) for joint in range(self.n_joints)]).reshape(-1, len(q))
        return self._forces[k].force(0.0, q, np.zeros_like(q))

    def row_sign(self, k: int, system: ConstrainedSystem, row: int, t: float, q: Array) -> float:
        """Return 1 if the row of a sticking joint has the sense of its sliding direction, -1 if it is opposite."""
        return float(np.sign(system.jacobian(t, q)[row] @ self.gradients(q, k)))

    def _check_independent(self, t: float, q: Array) -> None:
        """Raise unless each joint can slide while the others stick; otherwise their friction is not determined."""
        W = self.gradients(q)
        D = W @ responses(self.system, t, q, W)
        scale = (W**2).sum(axis=1) / float(np.abs(self.system.mass(t, q)).max())
        for k, friction in enumerate(self._frictions):
            D_before = D[:k, :k]
            compliance = D[k, k] - D[k, :k] @ np.linalg.lstsq(D_before, D[:k, k], rcond=NEGLIGIBLE_RATIO)[0]
            if not compliance > MIN_COMPLIANCE * scale[k]:
                others = ", ".join(map(repr, self._names[:k]))
                raise ValueError(
                    f"the joint of {friction.name!r} cannot slide by itself: drives or other joints hold it"
                    f"{f', or its motion depends on {others}' if k else ''}, so that its friction is not determined "
                    "while it sticks; remove it and assign all of the friction to another joint"
                )

    def sliding_system(self, signs: Signs, t: float, q: Array) -> ConstrainedSystem:
        """Return the system in which joints with a direction in `signs` slide, and the others have no friction."""
        if not signs:
            return self.system
        key = tuple(signs)
        if key not in self._sliding_systems:
            self._sliding_systems[key] = self._build("", signs, {}, t, q)[0]
        return self._sliding_systems[key]

    def joint_accelerations(self, signs: Signs, resting: list[int], t: float, q: Array, v: Array, a: Array) -> Array:
        """Return the accelerations of joints at rest for given accelerations a of the coordinates."""
        if not resting:
            return np.zeros(0)
        system, rows = self.mode_system(signs, t, q)
        R, gamma = system.jacobian(t, q), system.gamma(t, q, v)
        return np.array([self.row_sign(k, system, rows[k], t, q) * (R[rows[k]] @ a - gamma[rows[k]]) for k in resting])

    def mode_system(self, signs: Signs, t: float, q: Array) -> tuple[ConstrainedSystem, dict[int, int]]:
        """Return the system in which joints slide or are held in place, and the row of each joint that is held."""
        if not {STICKS, IDLE} & set(signs):
            return self.sliding_system(signs, t, q), {}
        names = [name for name, sign in zip(self._names, signs, strict=True) if sign == STICKS]
        # `gauge` has a row for each sticking joint, whose residual at t = 0 is the displacement of the joint
        gauge, rows = self._build(", gauge", signs, dict.fromkeys(names, np.nan), t, q)
        values, quarter = (gauge.constraint(t, q) for t in (0.0, 0.5 * np.pi)) if names else ((), ())
        positions = {}
        for friction in self._frictions:
            if friction.name not in names:
                continue
            (row,) = rows[friction.name]
            is_revolute = (
                len(friction.joint.a.position) == 3 and friction.joint.kind == "revolute"
            )  # row: A cos t + B sin t
            positions[friction.name] = float(np.arctan2(-values[row], quarter[row]) if is_revolute else values[row])
        suffix = f", {', '.join(names)} sticks" if names else ""
        system, rows = self._build(suffix, signs, positions, t, q)
        return system, {k: rows[name][0] for k, name in enumerate(self._names) if name in names}

    def _build(
        self, suffix: str, signs: Signs, positions: dict[str, float], t: float, q: Array
    ) -> tuple[ConstrainedSystem, dict[str, tuple[int, ...]]]:
        assert self._problem is not None and self._problem.model is not None
        forces = {name: -(signs[k] or 0) * self.kinetic_friction[k] for k, name in enumerate(self._names)}
        forces |= {self._names[k]: self.idle_friction[k] for k, sign in enumerate(signs) if sign is IDLE}
        name = self._problem.name + suffix
        return self._problem.model.mode(name, self._problem.parameters, forces, positions, t, q)


class Mode(NamedTuple):
    """State of the contacts between two changes: directions of joints, closed stops, and which stops slide or stick.

    Attributes
    ----------
    signs : list
    closed_stops : tuple of int
    sliding_stops : dict
        Direction of sliding (1 or -1) by stop.
    sticking_groups : dict
        Groups of stops with one displacement that stick together: the share of each stop; key: one stop of the group.
    """

    signs: Signs
    closed_stops: tuple[int, ...] = ()
    sliding_stops: dict[int, int] = {}  # noqa: RUF012
    sticking_groups: dict[int, dict[int, float]] = {}  # noqa: RUF012


class StopFriction:
    """Record of the stops that slide or stick in a motion.

    Parameters
    ----------
    stops : sequence of Stop
    t, q : float, ndarray (n_q,)
    """

    def __init__(self, stops: Sequence[Stop], t: float, q: Array):
        self._stops = stops
        with_friction = [k for k, stop in enumerate(stops) if stop.friction > 0.0]
        self.slide_index = {k: i for i, k in enumerate(with_friction)}
        self.slides = Gaps("slide", [stops[k] for k in with_friction], t, q)
        self.resting_stops: set[int] = set()  # stops that have come to rest or stick
        self.released_stops: set[int] = set()  # stops that stuck in the last arc

    def contact_rows(
        self, closed: Sequence[int], t: float, q: Array, v: Array, speeds: Array
    ) -> tuple[list[int], Gap, Tangents]:
        """Return the closed stops that have friction, the Gap of their displacements, and their Tangents."""
        stops = [k for k in closed if k in self.slide_index]
        slides = Gap(*(part[[self.slide_index[k] for k in stops]] for part in self.slides.evaluate(t, q, v)))
        at_rest = np.array([k in self.resting_stops or k in self.released_stops for k in stops], dtype=bool)
        rates = without_rounding(slides.u, slides.W, speeds)
        is_sliding = ~at_rest & (np.abs(rates) > REST_RATE * (np.abs(slides.W) @ speeds))
        signs = (np.sign(slides.u) * is_sliding).astype(int)
        normals = np.array([list(closed).index(k) for k in stops], dtype=int)
        return stops, slides, Tangents(normals, np.array([self.coefficient(k) for k in stops]), signs)

    def coefficient(self, k: int) -> float:
        """Return the coefficient of friction of a stop."""
        return self._stops[k].friction

    def sticking_groups(
        self, D: Array, basis: list[int], rows: dict[int, int], n_normals: int, forces: Array
    ) -> dict[int, dict[int, float]]:
        """Return stops that stick, in groups with one displacement, as shares of each stop in the force of its group.

        Parameters
        ----------
        D : ndarray
            Accelerations by unit forces: of stops, then of joints at rest, then of friction at stops.
        basis : list of int
            Independent rows of D; the rows of the groups are added.
        rows : dict
            Row of D of each stop that sticks.
        n_normals : int
            Number of the stops, whose gaps are constant if they are in `basis`.
        forces : ndarray
            Forces of all rows. If the displacements of a group also depend on gaps, its loads depend on the shares.
        """
        groups: dict[int, dict[int, float]] = {}
        senses: dict[int, dict[int, float]] = {}  # 1 or -1: sense of each displacement relative to the group's first
        first: dict[int, int] = {}  # first stop of a group by its row
        shared: set[int] = set()  # first stops of groups whose displacements depend on gaps
        for k, row in rows.items():
            weights = np.linalg.lstsq(D[np.ix_(basis, basis)], D[basis, row], rcond=NEGLIGIBLE_RATIO)[0]
            if D[row, row] - D[row, basis] @ weights > MIN_COMPLIANCE * D[row, row]:
                basis.append(row)
                groups[k], senses[k], first[row] = {k: 1.0}, {k: 1.0}, k
                continue
            used = {
                i: float(weight) for i, weight in zip(basis, weights, strict=True) if abs(weight) > COUPLING_TOLERANCE
            }
            others = [i for i in used if i >= n_normals]
            is_equal = len(others) == 1 and others[0] in first and abs(abs(used[others[0]]) - 1.0) <= COUPLING_TOLERANCE
            stop = first[others[0]] if is_equal else k
            if not is_equal or (len(used) > 1 and self.coefficient(k) != self.coefficient(stop)):
                raise Undetermined(
                    f"the friction of {self._stops[k].name!r} is not determined: other stops and joints hold it already"
                )
            groups[stop][k], senses[stop][k] = 0.0, np.sign(used[others[0]])
            if len(used) > 1:
                shared.add(stop)
        for stop in shared:
            along = {k: senses[stop][k] * forces[rows[k]] for k in groups[stop]}
            total, size = sum(along.values()), sum(abs(force) for force in along.values())
            for k, sense in senses[stop].items():
                share = along[k] / total if abs(total) > COUPLING_TOLERANCE * size else 1.0 / len(along)
                groups[stop][k] = sense * share
        return groups

    def update(self, mode: Mode, ended: set[int]) -> None:
        """Update which stops came to rest or were released; `ended`: stops whose events ended the arc."""
        self.released_stops = {k for stop, group in mode.sticking_groups.items() if stop in ended for k in group}
        self.resting_stops = {k for stop, group in mode.sticking_groups.items() if stop not in ended for k in group}
        self.resting_stops |= mode.sliding_stops.keys() & ended

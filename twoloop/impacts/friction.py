"""Compute contact forces and impulses, with Coulomb friction of stops or joints that slide or stick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, nnls

from twoloop.checks.arguments import Array
from twoloop.impacts.contact import Gap, Gaps, Undetermined
from twoloop.problem.description import Stop
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import NEGLIGIBLE_RATIO, independent_rows, velocity_changes

if TYPE_CHECKING:
    from twoloop.bodies.model_problem import ModelProblem

Signs = list[int | None]  # for each joint: its sliding direction (1 or -1), STICKS or IDLE
STICKS, IDLE = 0, None  # states of a joint at rest: STICKS, held by its own friction; IDLE, held by other contacts
MIN_COMPLIANCE = 1e-9  # smallest ratio of compliances, other joints held / free, of a joint that can slide by itself
REST_RATE = 1e-10  # largest rate that counts as zero, relative to the largest velocities of the last arc
COUPLING_TOLERANCE = 1e-6  # largest error with which a coefficient between two displacements counts as 0, 1 or -1
EVEN_WEIGHT = 1e-6  # relative weight of the regularisation that distributes a shared load evenly
SOLVER_SCALE = 1e3  # factor on the equations, so that their gradients exceed the tolerance of the solver
MAX_SOLVER_ITERATIONS = 1000
MAX_LOAD_ITERATIONS = 2000  # largest number of fixed-point iterations for the loads that bound the friction
MAX_GROWTH = 1e9  # the iteration diverges if a change of the forces exceeds this times the first change
LOAD_TOLERANCE = 1e-10  # change of the loads that ends the fixed-point iteration, relative to the largest load
UNIT_RATIO = 256.0  # units of forces are powers of this number, so that they are all 1 for similar bodies
MAX_OUTSIDE = 1e-9  # largest component of b outside the range of D that counts as rounding, relative to max|b|
CLOSING_TOLERANCE = 1e-6  # largest acceleration (or rate) with which a stop may still close, relative to max|c|
SLIDING_TOLERANCE = 1e-9  # largest acceleration that counts as rounding, relative to the sum of its terms


class Tangents(NamedTuple):
    """Stops with friction: the index of the row of each normal, the coefficient, the sliding direction (0: at rest)."""

    normal: NDArray[np.int64]
    coefficient: Array
    sign: NDArray[np.int64]


def responses(system: ConstrainedSystem, t: float, q: Array, W: Array) -> Array:
    """Return X (n_q, k), changes of velocities by unit impulses along rows W: M X + G^T Y = W^T, with G X = 0."""
    rows = system.rows(t, q)
    X = velocity_changes(system.mass(t, q), rows, W.T, np.zeros((len(rows), len(W))))
    rank = len(independent_rows(rows))
    for k, row in enumerate(W):
        if len(independent_rows(np.vstack([rows, row]))) == rank:  # joints and drives hold this row: no rounding errors
            X[:, k] = 0.0
    return X


def solve_complementarity(D: Array, b: Array) -> Array:
    """Solve the linear complementarity problem x >= 0, D x + b >= 0, x^T (D x + b) = 0; D symmetric semidefinite.

    x minimises x^T D x / 2 + b^T x: the non-negative least-squares problem |B x - y| with B^T B = D and B^T y = -b.
    """
    if not len(b):
        return np.zeros(0)
    x = nnls(*_least_squares_form(D, b))[0]
    # nnls finds the active set; the forces are then computed from D itself, because B, its root, has rounding errors
    is_active = x > 0.0
    x[is_active] = np.linalg.lstsq(D[np.ix_(is_active, is_active)], -b[is_active], rcond=NEGLIGIBLE_RATIO)[0]
    return np.maximum(x, 0.0)


def solve_bounded(D: Array, c: Array, n: int, limit: Array) -> Array:
    """Return forces that minimise x^T D x / 2 + c^T x subject to bounds: D x + c vanishes where no bound is active.

    The first n forces, at stops, are non-negative; the others, of friction, are bounded by `limit`. The sum of
    x^2 / limit is added with a small weight: a load that could be shared in any proportion is then shared evenly.
    """
    tiny = np.finfo(np.float64).tiny
    B, y = _least_squares_form(D, c)
    size = np.sqrt(D.diagonal().max())
    # scale of the forces, so that the unknowns are of order 1
    unit = max(float(np.linalg.norm(y)) / size, NEGLIGIBLE_RATIO * float(limit.max()), tiny)
    bound = np.maximum(limit / unit, tiny)
    regularisation = np.zeros((len(limit), len(c)))
    regularisation[:, n:] = np.diag(EVEN_WEIGHT * np.sqrt(bound.min() / bound))
    matrix, right_side = np.vstack([B / size, regularisation]), np.append(y / (size * unit), 0.0 * limit)
    limits = np.append(np.zeros(n), -bound), np.append(np.full(n, np.inf), bound)
    solution = lsq_linear(
        SOLVER_SCALE * matrix, SOLVER_SCALE * right_side, limits, "bvls", tol=1e-14, max_iter=MAX_SOLVER_ITERATIONS
    )
    x, free = solution.x, solution.active_mask == 0
    residual = (D @ x + c / unit)[free]  # due to the small weight
    x[free] -= np.linalg.lstsq(D[np.ix_(free, free)], residual, rcond=NEGLIGIBLE_RATIO)[0]
    return np.asarray(unit * np.clip(x, *limits))


def holding_forces(D: Array, c: Array, n: int, limit: Array) -> Array:
    """Return forces of n stops and of joints held by friction up to `limit`; c: accelerations without these forces."""
    return solve_bounded(D, c, n, limit) if len(limit) else solve_complementarity(D, c)


def coulomb_forces(D: Array, c: Array, limit: Array, tangents: Tangents) -> tuple[Array, NDArray[np.int64]]:
    """Return forces x (of stops, of joints at rest, of friction at stops), and the directions in which stops slide.

    The forces of stops are non-negative and complementary to the accelerations (or velocities) D x + c. Friction
    opposes sliding with its coefficient times the force of the stop; at rest, this product is a bound.
    """
    n_tangents, compliances = len(tangents.normal), D.diagonal()
    n = len(c) - len(limit) - n_tangents
    if (c[:n][compliances[:n] == 0.0] < -CLOSING_TOLERANCE * np.abs(c).max(initial=0.0)).any():
        raise Undetermined("joints or drives move a body into a stop, which no force of the stop can prevent")
    if not compliances.any():
        return np.zeros(len(c)), np.sign(c[len(c) - n_tangents :]).astype(int)
    # in these units, forces of light and heavy bodies are similar; a stop and its friction share one
    units = np.where(compliances > 0.0, compliances, 1.0) ** -0.5
    units[len(c) - n_tangents :] = units[tangents.normal]
    units = UNIT_RATIO ** np.round(np.log2(units) / np.log2(UNIT_RATIO))
    x, slides = _forces_in_units(D * units * units[:, None], units * c, limit / units[n : n + len(limit)], tangents)
    x *= units
    if (D @ x + c)[:n].min(initial=0.0) < -CLOSING_TOLERANCE * np.abs(c).max(initial=0.0):
        raise Undetermined("stops push against each other: no motion opens all of them or keeps them closed")
    return x, slides


def _forces_in_units(D: Array, c: Array, limit: Array, tangents: Tangents) -> tuple[Array, NDArray[np.int64]]:
    """Find bounds of friction by a fixed-point iteration; then contacts slide, stick or open: equations are linear."""
    n_tangents = len(tangents.normal)
    n = len(c) - len(limit) - n_tangents
    tangent_rows = np.arange(len(c) - n_tangents, len(c))
    is_sliding = tangents.sign != 0
    unknown_rows = np.setdiff1d(np.arange(len(c)), tangent_rows[is_sliding])
    x, tolerance = np.zeros(len(c)), NEGLIGIBLE_RATIO * np.abs(c).max(initial=0.0) / D.diagonal().max(initial=1e-300)
    first_change = 0.0
    for _ in range(MAX_LOAD_ITERATIONS):
        new_x, load = np.zeros(len(c)), tangents.coefficient * x[tangents.normal]
        new_x[tangent_rows] = -tangents.sign * load
        right_side, bounds = (c + D @ new_x)[unknown_rows], np.append(limit, load[~is_sliding])
        D_kept = D[np.ix_(unknown_rows, unknown_rows)]
        new_x[unknown_rows] = holding_forces(D_kept, right_side, n, bounds)
        change, x = np.abs(new_x - x).max(), new_x
        first_change = first_change or change
        has_converged = change <= LOAD_TOLERANCE * np.abs(x).max() + tolerance
        if has_converged or change > MAX_GROWTH * first_change:
            break
    if not has_converged:
        raise Undetermined("friction of stops is so large that their forces are not determined: they may jam")
    acceleration, terms = D @ x + c, np.abs(D) @ np.abs(x) + np.abs(c)
    if not n_tangents:
        return x, np.zeros(0, dtype=int)
    acceleration_signs = np.sign(acceleration) * (np.abs(acceleration) > SLIDING_TOLERANCE * terms)
    slides = np.where(is_sliding, tangents.sign, acceleration_signs[tangent_rows]).astype(int)
    return _solve_contacts(D, c, x, n, tangents._replace(sign=slides)), slides


def _solve_contacts(D: Array, c: Array, x: Array, n: int, tangents: Tangents) -> Array:
    """Solve the linear equations for the forces at stops whose states are known; forces of joints remain unchanged."""
    tangent_rows = np.arange(len(c) - len(tangents.normal), len(c))
    is_pushing = np.append(x[:n] > 0.0, np.zeros(len(c) - n, dtype=bool))
    loads = np.zeros((len(c), len(c)))  # x = loads @ y; y: forces of stops, and of friction at rest
    loads[is_pushing, is_pushing] = 1.0
    loads[tangent_rows, tangents.normal] = -tangents.sign * tangents.coefficient * is_pushing[tangents.normal]
    is_held = is_pushing.copy()
    is_held[tangent_rows] = (tangents.sign == 0) & is_pushing[tangents.normal]
    loads[is_held, is_held] = 1.0
    A = (D @ loads)[np.ix_(is_held, is_held)]
    if np.linalg.eigvals(A).real.min(initial=0.0) < -NEGLIGIBLE_RATIO * np.abs(A).max(initial=0.0):
        raise Undetermined("friction of stops is so large that their forces are not unique (P. Painlevé): they may jam")
    fixed_forces = np.where(is_pushing, 0.0, x)
    fixed_forces[tangent_rows] = 0.0
    y = np.zeros(len(c))
    y[is_held] = np.linalg.lstsq(A, -(c + D @ fixed_forces)[is_held], rcond=NEGLIGIBLE_RATIO)[0]
    return np.asarray(loads @ y + fixed_forces)


def _least_squares_form(D: Array, b: Array) -> tuple[Array, Array]:
    """Return B and y with B^T B = D and B^T y = -b.

    If the rows of stops are dependent, b may have a component outside the range of D, for example if parallel stops
    close at different rates. A small extra row of B represents this component.
    """
    values, vectors = np.linalg.eigh(0.5 * (D + D.T))
    components, threshold = vectors.T @ b, NEGLIGIBLE_RATIO * values.max(initial=0.0)
    is_significant = (values > threshold) | (np.abs(components) > MAX_OUTSIDE * np.abs(b).max(initial=0.0))
    roots = np.sqrt(np.maximum(values[is_significant], threshold))
    return roots[:, None] * vectors[:, is_significant].T, -components[is_significant] / roots


def impulses(D: Array, u: Array, restitution: Array, tangents: Tangents, law: str | None = None) -> Array:
    """Return the impulses at k stops, followed by the impulses of friction, for rates u before the impact.

    J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics, CISM 302 (1988): u+ + e u- >= 0, the
    impulse is non-negative, and their product is zero; the impulse of friction opposes the rate of sliding after the
    impact, and is at most the coefficient times the impulse. Without friction the energy does not increase if all e are
    equal; with friction it may if the rate of sliding is reversed (T. R. Kane, 1984), which raises Undetermined.

    If `law` is "poisson", bodies are compressed until no stop closes, and e times these impulses drive them apart, with
    further impulses where stops would close again (C. Glocker and F. Pfeiffer, Nonlinear Dynamics 7 (1995) 471).
    """
    none = np.zeros(0)
    if law == "poisson":  # without friction, see `check_law`
        P = (1.0 + restitution) * coulomb_forces(D, u, none, tangents)[0]
        P += coulomb_forces(D, u + D @ P, none, tangents)[0]
    else:
        shift = np.append(restitution * u[: len(restitution)], 0.0 * tangents.coefficient)
        P = coulomb_forces(D, u + shift, none, tangents)[0]
    adds_energy = P @ (u + 0.5 * (D @ P)) > NEGLIGIBLE_RATIO * (np.abs(P) @ np.abs(u))
    if adds_energy and (len(tangents.normal) or law == "poisson"):
        raise Undetermined("an impact would add energy by the law of impacts; use another restitution")
    return P


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
        Groups of stops with equal displacements that stick together; key: one stop of the group.
    """

    signs: Signs
    closed_stops: tuple[int, ...] = ()
    sliding_stops: dict[int, int] = {}  # noqa: RUF012
    sticking_groups: dict[int, list[int]] = {}  # noqa: RUF012


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
        is_sliding = ~at_rest & (np.abs(slides.u) > REST_RATE * (np.abs(slides.W) @ speeds))
        signs = (np.sign(slides.u) * is_sliding).astype(int)
        normals = np.array([list(closed).index(k) for k in stops], dtype=int)
        return stops, slides, Tangents(normals, np.array([self.coefficient(k) for k in stops]), signs)

    def coefficient(self, k: int) -> float:
        """Return the coefficient of friction of a stop."""
        return self._stops[k].friction

    def sticking_groups(self, D: Array, basis: list[int], rows: dict[int, int]) -> dict[int, list[int]]:
        """Return stops that stick, in groups with equal displacements; `rows`: row of D of each stop that sticks.

        `basis`: independent rows of D; the rows of the groups are added.
        """
        groups: dict[int, list[int]] = {}
        first: dict[int, int] = {}  # first stop of a group by its row
        for k, row in rows.items():
            weights = np.linalg.lstsq(D[np.ix_(basis, basis)], D[basis, row], rcond=NEGLIGIBLE_RATIO)[0]
            if D[row, row] - D[row, basis] @ weights > MIN_COMPLIANCE * D[row, row]:
                basis.append(row)
                groups[k], first[row] = [k], k
                continue
            others = [i for i, weight in zip(basis, weights, strict=True) if abs(weight) > COUPLING_TOLERANCE]
            equal = [i for i in others if abs(abs(weights[basis.index(i)]) - 1.0) <= COUPLING_TOLERANCE]
            if len(others) != 1 or others != equal or others[0] not in first:
                raise Undetermined(
                    f"the friction of {self._stops[k].name!r} is not determined: other stops and joints hold it already"
                )
            groups[first[others[0]]].append(k)
        return groups

    def update(self, mode: Mode, ended: set[int]) -> None:
        """Update which stops came to rest or were released; `ended`: stops whose events ended the arc."""
        self.released_stops = {k for stop, group in mode.sticking_groups.items() if stop in ended for k in group}
        self.resting_stops = {k for stop, group in mode.sticking_groups.items() if stop not in ended for k in group}
        self.resting_stops |= mode.sliding_stops.keys() & ended

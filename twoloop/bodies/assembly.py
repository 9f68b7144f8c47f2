"""Find consistent positions and velocities of a model, its degrees of freedom and redundant joints; remark on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack, null_space

from twoloop.bodies.collection import Collection
from twoloop.bodies.loads import CoordinateGap
from twoloop.bodies.tables import TENSOR, Tables
from twoloop.checks.arguments import Array
from twoloop.checks.scales import TURNS, generic_factors, scales_of, typical_sizes, units
from twoloop.checks.sparse_rows import SparseRows, norms
from twoloop.problem.description import name_and_unit
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import velocity_changes
from twoloop.run.projection import consistent_state, dependence, project_sparsely

SINGULAR = 1e-9  # singular values of the scaled Jacobian below this fraction of the largest count as zero
PERTURBATION = 0.02  # displacement, relative to max(1, |q|), at which the rank is determined a second time
REST = 1e-14  # given velocities up to this, in sizes of the mechanism per second, are rounding errors of rest
VELOCITY_CHANGE = 0.1  # largest change that the joints may require, relative to the largest given velocity
ROUNDING = 8.0 * np.finfo(np.float64).eps  # rounding error of a constraint, relative to the sum of its |terms|
FULL_RANK_RCOND = 1e-12  # C_q C_q^T has full rank if its reciprocal condition number exceeds this
DIFFERENCE_STEP = 1e-4  # step of the central difference of C_q, relative to the scales of the coordinates
DRIVE_STEP = 0.05  # continuation step, rad or m, towards the initial value of a drive
NEWTON_ITERATIONS = 5  # largest number of iterations in a continuation step
OPEN_TOLERANCE = 1e-7  # a joint does not close if its residual, relative to the size of the model, is larger


@dataclass(frozen=True)
class Freedom:
    """Degrees of freedom of a model.

    Attributes
    ----------
    degrees : int
        Number of independent velocities in the neighbourhood of the start.
    singular : int
        Number of additional degrees of freedom at the start itself, where C_q loses rank.
    redundant : tuple of tuple of str
        Groups of joints with linearly dependent rows.

    Examples
    --------
    >>> from twoloop.bodies import PlanarModel
    >>> model = PlanarModel(name="pendulum")
    >>> bob = model.body("bob", mass=2.0, inertia=0.1, position=(1.0, 0.0))
    >>> pin = model.revolute("ground", bob, at=(0.0, 0.0), name="pin")
    >>> freedom = model.problem((0.0, 1.0)).freedom
    >>> freedom.degrees, freedom.redundant
    (1, ())
    """

    degrees: int
    singular: int
    redundant: tuple[tuple[str, ...], ...]


def follow_drives(system: ConstrainedSystem, t: float, start: Array, keep: Sequence[int]) -> Array:
    """Move the bodies in small steps to the initial values of the drives, staying on the same assembly branch.

    Raises ValueError if the joints, or the bodies that must not move, prevent it.
    """
    free = np.setdiff1d(np.arange(system.n_q), keep)
    q, values = start.copy(), system.constraint(t, start)
    n = int(np.ceil(np.abs(values).max() / DRIVE_STEP))
    for k in range(1, n + 1):
        for _ in range(NEWTON_ITERATIONS):
            off = system.constraint(t, q) - (1.0 - k / n) * values
            q[free] -= np.linalg.lstsq(system.jacobian(t, q)[:, free], off, rcond=SINGULAR)[0]
        left = np.abs(system.constraint(t, q) - (1.0 - k / n) * values).max()
        if not left <= OPEN_TOLERANCE * max(1.0, float(np.abs(values).max())):
            raise ValueError(
                f"the drives of {system.name!r} require at t = {t:g} a position that the joints do not permit: the "
                f"bodies reach {(k - 1) / n:.0%} of the way. Give poses nearer to the start of the motion, "
                "another motion, or keep fewer bodies"
            )
    return q


def velocities(
    system: ConstrainedSystem, t: float, q: Array, given: Array, is_given: NDArray[np.bool_], coordinates: Sequence[str]
) -> Array:
    """Return velocities that satisfy the constraints, include the given ones, and have the least kinetic energy.

    Raises ValueError if the given velocities, or the velocities of the drives, violate the constraints.
    """
    if system.n_c + system.n_a == 0 or not (is_given.any() or system.rates(t, q).any()):
        return np.where(is_given, given, 0.0)
    rows = system.rows(t, q)
    scales = scales_of(system, t, q, rows)
    scaled = scales.scaled(rows)
    v = np.where(is_given, given, 0.0) / scales.columns
    for _ in range(2):  # the second pass removes rounding errors
        v = v - np.linalg.lstsq(scaled, scaled @ v + system.rates(t, q) / scales.rows, rcond=SINGULAR)[0]
    left = float(np.abs(scaled @ v + system.rates(t, q) / scales.rows).max(initial=0.0))
    speed = max(float(np.abs(v).max(initial=0.0)), float(np.abs(system.rates(t, q) / scales.rows).max(initial=0.0)))
    if left > SINGULAR * max(speed, 1e-3) * 100.0:
        raise ValueError(
            f"the drives of {system.name!r} require at t = {t:g} velocities that its joints do not allow: the "
            "motion is over-constrained. Remove a drive or a joint"
        )
    free = null_space(scaled, rcond=SINGULAR)
    target = np.where(is_given, given, 0.0) / scales.columns
    size = float(np.abs(target).max(initial=0.0))
    if free.shape[1] and is_given.any():
        block = free[is_given]
        v = v + free @ np.linalg.lstsq(block, (target - v)[is_given], rcond=SINGULAR)[0]
    mass, held = system.mass(t, q), np.vstack([rows, np.eye(system.n_q)[is_given]])
    impulses = -mass @ (v * scales.columns)
    v = v + velocity_changes(mass, held, impulses[:, None], np.zeros((len(held), 1)))[:, 0] / scales.columns
    off = np.where(is_given, np.abs(v - target), 0.0)
    if off.max(initial=0.0) > max(VELOCITY_CHANGE * size, SINGULAR * speed, REST):
        j = int(off.argmax())
        name, unit = name_and_unit(coordinates[j])
        nearest = v[j] * scales.columns[j] if abs(v[j]) > ROUNDING * size else 0.0
        raise ValueError(
            f"the joints and drives of {system.name!r} do not allow the velocities given: the rate of {name} is given "
            f"as {given[j]:.6g}, and the nearest admissible value is {nearest:.6g}"
            f"{f' ({unit}/s)' if unit else ''}. Give fewer velocities (the others are computed), or fewer joints"
        )
    v = v - np.linalg.lstsq(scaled, scaled @ v + system.rates(t, q) / scales.rows, rcond=SINGULAR)[0]
    near = np.where(is_given, target, 0.0)
    at_rest = np.where(np.abs(v - near) < ROUNDING * np.abs(v).max(), near, v)  # removes rounding errors
    rates = system.rates(t, q) / scales.rows
    terms = ROUNDING * (np.abs(scaled) @ np.abs(at_rest) + np.abs(rates))
    if (np.abs(scaled @ at_rest + rates) <= np.maximum(np.abs(scaled @ v + rates), terms)).all():
        v = at_rest
    return np.asarray(v * scales.columns)


def freedom(system: ConstrainedSystem, t: float, q: Array, rows: Mapping[str, tuple[int, ...]]) -> Freedom:
    """Return the degrees of freedom at the start and near it, and the joints with redundant rows."""
    if system.n_c + system.n_a == 0:
        return Freedom(system.n_q, 0, ())
    if _has_full_rank_sparse(system, t, q):
        return Freedom(system.n_q - system.n_c - system.n_a, 0, ())
    large = _freedom_of_large(system, t, q, rows)
    if large is not None:
        return large
    scaled = _scaled(system, t, q)
    if _has_full_rank(scaled):
        return Freedom(system.n_q - len(scaled), 0, ())
    at_start = _rank(system, t, q)
    beside = at_start
    free = null_space(scaled, rcond=SINGULAR)
    if free.shape[1]:
        direction = free @ np.random.default_rng(3).uniform(0.5, 1.0, free.shape[1])
        away = q + PERTURBATION * max(1.0, float(np.abs(q).max())) * direction / np.abs(direction).max()
        try:
            nearby = consistent_state(system, t, away, np.zeros(system.n_q), check_assembly=False)[0]
            beside = max(beside, _rank(system, t, nearby))
        except ValueError:  # no consistent state nearby: keep the rank at the start
            nearby = q
        q = nearby if beside > at_start else q
    degrees = system.n_q - beside
    return Freedom(degrees, beside - at_start, _redundant(system, t, q, rows))


def _freedom_of_large(
    system: ConstrainedSystem, t: float, q: Array, rows: Mapping[str, tuple[int, ...]]
) -> Freedom | None:
    """Return the freedom of a large sparse system, from sparse factors; None if the dense test is needed."""
    rows_here = dependence(system, t, q)
    if rows_here is None:
        return None
    singular = 0
    if rows_here.coefficients and np.abs(rows_here.allowed_move).max() > 0.0:
        away = q + PERTURBATION * rows_here.allowed_move
        moved = project_sparsely(system, t, away, np.zeros(system.n_q), check_assembly=False)
        nearby = rows_here.project_nearby(away) if moved is None else moved[0]
        beside = None if nearby is None else dependence(system, t, nearby)
        if beside is None:
            return None
        if beside.rank > rows_here.rank:
            singular, rows_here = beside.rank - rows_here.rank, beside
    of_row = {row: name for name, own in rows.items() for row in own}
    groups: list[set[str]] = []
    for row, share in rows_here.coefficients.items():
        involved = [row, *np.flatnonzero(np.abs(share) > 1e-6 * np.abs(share).max()).tolist()]
        joined = {of_row[k] for k in involved if k in of_row}  # rows e.e = 1 of Euler parameters belong to no joint
        joined = joined.union(*(group for group in groups if group & joined))
        groups = [group for group in groups if not group & joined] + [joined]
    redundant = tuple(tuple(name for name in rows if name in group) for group in groups)
    return Freedom(system.n_q - rows_here.rank, singular, redundant)


def _scaled(system: ConstrainedSystem, t: float, q: Array) -> Array:
    rows = system.rows(t, q)
    return scales_of(system, t, q, rows).scaled(rows)


def _has_full_rank_sparse(system: ConstrainedSystem, t: float, q: Array) -> bool:
    """Return True if a large sparse system certainly has full rank; False if the dense test is needed."""
    rows = system.sparse_rows(t, q)
    if not isinstance(rows, SparseRows) or len(rows) > rows.shape[1]:
        return False
    from scipy.sparse import csc_array  # slow to import
    from scipy.sparse.linalg import LinearOperator, onenormest, splu

    columns = units(system, t, q, rows, typical_sizes(q))
    way, unit = DIFFERENCE_STEP * columns * generic_factors(len(q)), columns[rows.columns]
    try:
        sides = [rows.added(system.jacobian_values(t, q + part)) for part in (way, -way)]
    except Exception:  # outside the domain of the callbacks
        return False
    turned = norms(rows.with_values((sides[0] - sides[1]) * unit)) / (2.0 * DIFFERENCE_STEP)
    lengths = np.maximum(norms(rows.with_values(rows.values * unit)), TURNS * turned)
    if not (lengths > 0.0).all():
        return False
    scaled = csc_array((rows.values * unit / lengths[rows.rows], (rows.rows, rows.columns)), shape=rows.shape)
    square = (scaled @ scaled.T).tocsc()
    try:
        factors = splu(square, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError:  # exactly singular
        return False
    inverse = LinearOperator(square.shape, matvec=factors.solve, rmatvec=factors.solve, dtype=float)
    return bool(abs(square).sum(axis=0).max() * onenormest(inverse) < 1.0 / FULL_RANK_RCOND)


def _has_full_rank(scaled: Array) -> bool:
    """Return True if the rows certainly have full rank; this test is much cheaper than the rank itself."""
    if len(scaled) > scaled.shape[1]:
        return False
    square = scaled @ scaled.T
    factor, info = lapack.dpotrf(square)
    return bool(info == 0 and lapack.dpocon(factor, np.abs(square).sum(axis=0).max())[0] > FULL_RANK_RCOND)


def _rank(system: ConstrainedSystem, t: float, q: Array) -> int:
    scaled = _scaled(system, t, q)
    values = np.linalg.svd(scaled, compute_uv=False)
    return int((values > SINGULAR * values.max(initial=0.0)).sum())


def _redundant(
    system: ConstrainedSystem, t: float, q: Array, rows: Mapping[str, tuple[int, ...]]
) -> tuple[tuple[str, ...], ...]:
    """Return disjoint groups of joints whose rows are linearly dependent."""
    idle = null_space(_scaled(system, t, q).T, rcond=SINGULAR)
    part = idle @ idle.T  # projector onto the null space of C_q^T
    groups: list[set[str]] = []
    involved = {name: list(own) for name, own in rows.items() if np.abs(part[list(own)]).max(initial=0.0) > 1e-6}
    for name, own in involved.items():
        linked = {other for other, theirs in involved.items() if np.abs(part[np.ix_(own, theirs)]).max() > 1e-6}
        joined = {name, *linked}.union(*(group for group in groups if group & {name, *linked}))
        groups = [group for group in groups if not group & joined] + [joined]
    return tuple(tuple(name for name in rows if name in group) for group in groups)


MOVED = 1e-6  # smallest displacement that is reported, relative to the largest coordinate
ROUNDED = 0.01  # relative tolerance of the triangle inequality, for moments of inertia rounded to a few digits
TURN = 2.0 * np.pi


def note_of(
    model: Collection,
    tables: Tables,
    freedom: Freedom,
    given: Array,
    closed: Array,
    start: Array,
    coordinates: Sequence[str],
) -> str:
    """Return remarks on degrees of freedom, redundant rows and possible mistakes.

    `given`, `closed`, `start`: given coordinates; with all joints closed; with drives at their initial values, too.
    """
    remarks = [*_freedom(freedom), *_moved(given, closed, coordinates), *_forgotten(model)]
    remarks += (*_inertias(model, tables), *_turns(model, tables, start))
    if tables.untraced:
        remarks.append(f"Its functions are called in Python, which is slower: {tables.untraced}.")
    return " ".join(remarks)


def _freedom(freedom: Freedom) -> Iterator[str]:
    yield f"{freedom.degrees} {'degree' if freedom.degrees == 1 else 'degrees'} of freedom."
    if freedom.singular:
        yield f"The start is singular: {freedom.singular} more degrees of freedom there."
    for group in freedom.redundant:
        yield f"The rows of {', '.join(map(repr, group))} are dependent."


def _moved(given: Array, closed: Array, coordinates: Sequence[str]) -> Iterator[str]:
    off = np.abs(closed - given)
    if off.max(initial=0.0) > MOVED * np.abs(closed).max():
        name, unit = name_and_unit(coordinates[int(off.argmax())])
        yield f"Bodies were moved to close the joints, {name} by {f'{off.max():.3g} {unit}'.rstrip()}."


def _forgotten(model: Collection) -> Iterator[str]:
    drives = {id(each.point_b): each.name for each in model.joints if each.kind == "drive"}
    joined = {id(body) for each in model.joints for body in (each.a, each.b)}
    joined |= {id(body) for each in model.forces for body in (each.first, each.second)}
    for body in model.bodies:
        if model.joints and id(body) not in joined:
            yield f"{body.name!r} has no joint, and no force acts on it."
    for force in model.forces:
        if force.joint is not None and id(force.joint.point_b) in drives:
            name = drives[id(force.joint.point_b)]
            yield f"{force.name!r} acts where {name!r} prescribes the motion: it only changes the drive reaction."
    if model.dry:
        yield "solve_with_friction handles its dry friction; solve_dae ignores it."
    if model.stops:
        yield "solve_with_stops handles its stops; solve_dae ignores them."


def _inertias(model: Collection, tables: Tables) -> Iterator[str]:
    """Yield bodies whose principal moments violate the triangle inequality; the equations are still well defined."""
    for body in model.bodies if model.dimension == 3 else ():
        first = tables.places[f"mass of {body.name} (kg)"] + 1
        low, middle, high = np.linalg.eigvalsh(tables.p[first : first + 6][TENSOR].reshape(3, 3))
        if high > (1.0 + ROUNDED) * (low + middle):
            yield (
                f"No body has the principal moments of inertia of {body.name!r}, {low:.6g}, {middle:.6g} and "
                f"{high:.6g}: the largest exceeds the sum of the others."
            )


def _turns(model: Collection, tables: Tables, start: Array) -> Iterator[str]:
    """Yield angles of more than one turn, which may be meant in degrees."""
    angles = {name: value for name, value in tables.values.items() if name.endswith("(rad)")}
    if model.dimension == 2:
        angles |= {f"angle of {body.name} (rad)": start[body.coordinates[2]] for body in model.bodies}
    limits = ((each.name, each.gap) for each in model.stops if isinstance(each.gap, CoordinateGap))
    angles |= {f"{name} (rad)": gap.limit for name, gap in limits if gap.coordinate.unit == "rad"}
    for name, value in angles.items():
        if abs(value) > TURN:
            yield f"{name[:-6]} is {value:.6g} rad, more than a turn: angles are in rad, not in degrees."

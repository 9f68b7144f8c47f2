"""Decide whether a run may use the static form, for large systems, and find where the entries of its matrices are."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import NEARBY, pattern_of
from twoloop.kernels.layout import Static
from twoloop.kernels.linalg.sparse_lu import column_groups, grouped_entries, newton_program
from twoloop.kernels.linalg.symbolic_factorization import (
    N_OFF,
    N_PIVOTS,
    N_UPDATES,
    Entries,
    bodies_of,
    factorization_program,
)
from twoloop.methods.plan import Plan
from twoloop.problem.callbacks import LARGE
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

DISPLACED = 1e-3  # relative to max(1, |value|): coordinates and velocities, to see what they change
NEWTON_SPARSE = 0.2  # of the multiplications of dense factors: a program with more of them is not worth its indices


def newton_form(
    system: ConstrainedSystem,
    t0: float,
    q0: Array,
    mass: Entries,
    jacobian: Entries,
    together: list[tuple[int, ...]],
    stiff: list[int],
) -> tuple[NDArray[np.int32], int] | None:
    """Make the program of Newton's matrix, see sparse_lu.py, and count the groups of columns that are differenced.

    None where it is not sparse, or cannot be found.
    """
    found: set[tuple[int, int]] = set()
    rng = np.random.default_rng(9)
    size, lam = max(1.0, float(np.abs(q0).max())), rng.uniform(0.5, 1.5, system.n_c)
    most = NEWTON_SPARSE * system.n_q**2
    for share in NEARBY[:2]:
        q = q0 + share * size * rng.uniform(-1.0, 1.0, system.n_q)
        try:
            found |= _entries(system, t0, q, rng.uniform(-1.0, 1.0, system.n_q), lam, most)
        except Exception:  # outside what the callbacks are made for; what is missed is found on the way
            continue
        if len(found) > most:
            return None
    places = np.array(sorted(found), dtype=np.int64).reshape(-1, 2)
    tangents = grouped_entries((places[:, 0], places[:, 1]), system.n_q)
    program = newton_program(system.n_q, system.n_c, mass, jacobian, tangents, together, stiff)
    if program is None or program[N_UPDATES] > NEWTON_SPARSE * system.n_q**3 / 3.0:
        return None
    return program, int(column_groups(tangents, system.n_q).max(initial=-1)) + 1


def _entries(system: ConstrainedSystem, t: float, q: Array, v: Array, lam: Array, most: float) -> set[tuple[int, int]]:
    """Find where Q - C_q^T lam changes with a coordinate, and Q with a velocity, and the same mirrored."""

    def reaction(q: Array) -> Array:
        if "jacobian" not in system.entries:
            return lam @ system.jacobian(t, q)
        rows, columns = system.entries["jacobian"]
        return np.bincount(columns, system.jacobian_values(t, q) * lam[rows], len(q)).astype(np.float64)

    force, of_rows = system.force(t, q, v), reaction(q)
    found: set[tuple[int, int]] = set()
    for j in range(len(q)):
        moved, faster = q.copy(), v.copy()
        moved[j] += DISPLACED * max(1.0, abs(q[j]))
        faster[j] += DISPLACED * max(1.0, abs(v[j]))
        changed = (system.force(t, moved, v) != force) | (reaction(moved) != of_rows)
        changed |= system.force(t, q, faster) != force
        for i in np.flatnonzero(changed).tolist():
            found |= {(i, j), (j, i)}
        if len(found) > most:
            break
    return found


SINGULAR = 1e-10  # smallest over largest eigenvalue of a body's M, below which it counts as singular
ALONG = 1e-3  # of a row: more of it has to lie along directions without mass if it is to stiffen these
NEWTON = 1.6  # times LARGE: coordinates from which on Newton's matrices are sparse
SPARSE = 0.05  # of the multiplications of dense factors: a program with more of them is not worth its indices


class StaticForm(NamedTuple):
    """Hold the program of a system, and what a workspace for it needs."""

    program: NDArray[np.int32]
    static: Static
    mass: Entries
    pattern: Array  # of a dense Jacobian, (n_c, n_q), 1 where it has entries; of no size beside jacobian_values
    mass_pattern: Array  # of a dense M that is not constant, likewise
    known: tuple[Any, ...]  # of what a program of Newton's matrix is made besides
    newton: NDArray[np.int32] | None = None  # that program, once it is asked for
    n_groups: int = 0  # of columns, for each of which Newton's matrix takes displaced forces

    def matrix_cost(self) -> float:
        """What Newton's matrix and its factors cost, in evaluations of accelerations, about."""
        assert self.newton is not None
        return self.n_groups + float(self.newton[N_UPDATES]) / max(1.0, float(self.program[N_UPDATES]))

    def n_matrices(self, matrices: int) -> int:
        """Numbers of Newton's matrices, of a plan with so many dense ones."""
        from twoloop.kernels.steps.newton_memory import SYSTEMS
        from twoloop.kernels.steps.newton_systems import matrices_size

        if self.newton is None or matrices == 0:
            return 0
        n_values = self.static.n_mass_values, self.static.n_jacobian_values
        return matrices_size(self.newton, *n_values, (matrices - SYSTEMS) // 2)


def static_form(system: ConstrainedSystem, t0: float, q0: Array, *plans: Plan) -> StaticForm | None:
    """Make the static form of a system for runs by these plans; None where it does not serve, or would not pay."""
    if system.n_q < LARGE or system.n_c == 0 or system.n_a > 0 or system.bandwidth is not None:
        return None
    known = "gamma" in system.given or system.functions.gamma_program.size > 0
    if not known or not all(plan.projects and plan.inner is None and not plan.own for plan in plans):
        return None
    form: StaticForm | None = system.remembered("static form", lambda: _made(system, t0, q0))
    if form is not None and any(plan.matrices and plan.first is None for plan in plans):
        return with_newton(system, t0, q0, form)
    return form


def with_newton(system: ConstrainedSystem, t0: float, q0: Array, form: StaticForm) -> StaticForm | None:
    """Add the program of Newton's matrix; None where there is none, or would not pay."""
    if system.n_q < NEWTON * LARGE:
        return None
    made = system.remembered("newton form", lambda: newton_form(system, t0, q0, *form.known))
    return None if made is None else form._replace(newton=made[0], n_groups=made[1])


def _made(system: ConstrainedSystem, t0: float, q0: Array) -> StaticForm | None:
    pattern, mass_pattern = np.zeros((0, system.n_q)), np.zeros((0, 0))
    dense_mass = False
    if "jacobian" in system.entries:
        jacobian = system.entries["jacobian"]
    else:
        pattern = pattern_of(system, t0, q0)
        jacobian = _places(pattern)
    if "mass" in system.entries:
        mass = system.entries["mass"]
    else:
        found = _mass_pattern(system, t0, q0)
        mass, dense_mass = _places(found), not system.constant_mass
        mass_pattern = found if dense_mass else mass_pattern
    if not _is_sparse(system.n_q, len(jacobian[0])) or not _is_sparse(system.n_q, len(mass[0])):
        return None
    together = _together(system, mass)
    stiff = _stiff_rows(system, t0, q0, mass, jacobian, together)
    program = factorization_program(system.n_q, system.n_c, mass, jacobian, together, stiff)
    if program is None or program[N_UPDATES] > SPARSE * _dense_work(system.n_q, system.n_c):
        return None
    n_factors = int(program[N_PIVOTS] + program[N_OFF] + 1)
    static = Static(n_factors, len(mass[0]), len(jacobian[0]), dense_mass, "jacobian" not in system.entries)
    return StaticForm(program, static, mass, pattern, mass_pattern, (mass, jacobian, together, stiff))


def _together(system: ConstrainedSystem, mass: Entries) -> list[tuple[int, ...]]:
    """Coordinates of one body each: those that joints act on, and all others that are laid out as these, in space.

    A joint names one of its bodies, so that the end of a chain may be in none.
    """
    named = [joint.translation + joint.rotation for joint in system.joints]
    layouts = {tuple(j - own[0] for j in own) for own in named}
    if layouts != {tuple(range(7))} or system.n_q % 7 > 0 or any(own[0] % 7 > 0 for own in named):
        return named
    body_of = bodies_of(system.n_q, mass, ())
    expected = [7 * k + (j if j < 3 else 3) for k in range(system.n_q // 7) for j in range(7)]
    return named if body_of != expected else [tuple(range(k, k + 7)) for k in range(0, system.n_q, 7)]


def _stiff_rows(
    system: ConstrainedSystem, t0: float, q0: Array, mass: Entries, jacobian: Entries, together: list[tuple[int, ...]]
) -> list[int]:
    """Find rows of single bodies that M is singular along, with no entry but where M has some: see sparse_ldl.py.

    No more than make it definite: others, as of a hinge on the ground, hold the body as joints do.
    """
    values = system.mass_values(t0, q0) if "mass" in system.entries else system.mass(t0, q0)[mass]
    body_of = np.array(bodies_of(system.n_q, mass, together))
    coordinates: dict[int, list[int]] = {}
    for j, body in enumerate(body_of.tolist()):
        coordinates.setdefault(body, []).append(j)
    blocks: dict[int, Array] = {body: np.zeros((len(own), len(own))) for body, own in coordinates.items()}
    place = {j: k for own in coordinates.values() for k, j in enumerate(own)}
    there = set()
    for i, j, value in zip(*(each.tolist() for each in (*mass, values)), strict=True):
        blocks[int(body_of[i])][place[i], place[j]] += value
        there.add((i, j))
    free = {body: ways for body, block in blocks.items() if (ways := _without_mass(block)).size > 0}
    if not free:
        return []
    columns: dict[int, list[tuple[int, float]]] = {}
    values = system.jacobian_values(t0, q0) if "jacobian" in system.entries else system.jacobian(t0, q0)[jacobian]
    for i, j, value in zip(*(each.tolist() for each in (*jacobian, values)), strict=True):
        columns.setdefault(i, []).append((j, value))
    found = []
    for i, own in columns.items():
        body = int(body_of[own[0][0]])
        if body in free and all((j, k) in there for j, _ in own for k, _ in own):
            row = np.zeros(len(coordinates[body]))
            for j, value in own:
                row[place[j]] += value
            along = free[body] @ row
            if np.linalg.norm(along) > ALONG * np.linalg.norm(row):
                found.append(i)
                free[body] = np.linalg.svd(along[None, :])[2][1:] @ free[body]
    return found


def _without_mass(block: Array) -> Array:
    """Directions along which a body's M is singular, one a row."""
    if not np.isfinite(block).all():
        return np.eye(len(block))
    values, ways = np.linalg.eigh(block)
    return np.asarray(ways.T[values <= SINGULAR * values[-1]])


def _is_sparse(n_q: int, n_entries: int) -> bool:
    """Return whether there are so few entries that it is worth while to look for an order."""
    return n_entries <= SPARSE * n_q * n_q + 24 * n_q


def _dense_work(n_q: int, n_c: int) -> float:
    """Multiplications of one evaluation by Schur's complement, about."""
    return 0.5 * n_c * n_c * (n_q + n_c / 3.0)


def _places(pattern: Array) -> Entries:
    rows, columns = np.nonzero(pattern)
    return rows.astype(np.int64), columns.astype(np.int64)


def _mass_pattern(system: ConstrainedSystem, t0: float, q0: Array) -> Array:
    """1 where M has an entry at a position or, if it is not constant, near it."""
    found = np.zeros((system.n_q, system.n_q))
    size = np.maximum(np.abs(q0), np.abs(q0).max())
    ways = np.random.default_rng(5).uniform(-1.0, 1.0, (len(NEARBY), system.n_q))
    for share, way in zip(NEARBY[:1] if system.constant_mass else NEARBY, ways, strict=False):
        try:
            mass = system.mass(t0, q0 + share * size * way)
        except Exception:  # outside what the callbacks are made for; what is missed is found on the way
            continue
        found[(mass != 0.0) | (mass.T != 0.0)] = 1.0
    return found

"""Make kits (callbacks, flags and steps), workspaces (arrays for all kernels), and sparse forms of large systems."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import NEARBY, has_definite_mass, least_inertia, pattern_of
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import common
from twoloop.kernels.data.common import Kit
from twoloop.kernels.data.indices import (
    AUGMENTED,
    BANDWIDTH,
    DENSE_FORM,
    DIAGONAL_MASS,
    FIXED_ORDER,
    FORM,
    IS_GENERATED,
    MULTIPLIERS,
    NULL_SPACE,
)
from twoloop.kernels.evaluation.operations import N_NODES
from twoloop.kernels.layout import FixedOrderSizes, cached_run, empty_workspace, lasting_arrays
from twoloop.kernels.linalg.band import banded_pays, lapack_addresses
from twoloop.kernels.linalg.saddle_point import sparse_pays
from twoloop.kernels.linalg.sparse_lu import column_groups, grouped_entries, newton_program
from twoloop.kernels.linalg.symbolic_factorization import (
    N_OFF_DIAGONAL,
    N_PIVOTS,
    N_UPDATES,
    Entries,
    bodies_of,
    factorization_program,
)
from twoloop.kernels.steps.stages import LOADED_STEPS, load_step, step_if_loaded
from twoloop.methods.plan import Plan
from twoloop.problem.callbacks import LARGE
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

# to find out if forces depend on a coordinate or velocity x, x is displaced by this number times max(1, |x|)
DISPLACEMENT = 1e-3
# implicit steps use sparse factors of Newton's matrix if at most this fraction of the derivatives of forces is nonzero,
# and if sparse factorization takes at most this fraction of the operations of dense factorization
MAX_NEWTON_SHARE = 0.2


def newton_form(
    system: ConstrainedSystem,
    t0: float,
    q0: Array,
    mass: Entries,
    jacobian: Entries,
    bodies: list[tuple[int, ...]],
    stiff: list[int],
) -> tuple[NDArray[np.int32], int] | None:
    """Return the program to factorize Newton's sparse matrix, and the number of groups of columns computed together.

    Columns of a group have no nonzero entries in the same row: so one finite difference of forces yields all of them.
    `mass`, `jacobian`: indices of nonzero entries of M and C_q. `bodies`: coordinates of each body. `stiff`: result of
    `_stiff_rows`. Return None if sparse factors would not be much faster than dense ones.
    """
    entries: set[tuple[int, int]] = set()
    rng = np.random.default_rng(9)
    magnitude, lam = max(1.0, float(np.abs(q0).max())), rng.uniform(0.5, 1.5, system.n_c)
    max_entries = MAX_NEWTON_SHARE * system.n_q**2
    for scale in NEARBY[:2]:
        q = q0 + scale * magnitude * rng.uniform(-1.0, 1.0, system.n_q)
        try:
            entries |= _derivative_entries(system, t0, q, rng.uniform(-1.0, 1.0, system.n_q), lam, max_entries)
        except Exception:  # skip a position where callbacks fail; a run later finds entries that are missed here
            continue
        if len(entries) > max_entries:
            return None
    indices = np.array(sorted(entries), dtype=np.int64).reshape(-1, 2)
    tangents = grouped_entries((indices[:, 0], indices[:, 1]), system.n_q)
    program = newton_program(system.n_q, system.n_c, mass, jacobian, tangents, bodies, stiff)
    if program is None or program[N_UPDATES] > MAX_NEWTON_SHARE * system.n_q**3 / 3.0:
        return None
    return program, int(column_groups(tangents, system.n_q).max(initial=-1)) + 1


def _derivative_entries(
    system: ConstrainedSystem, t: float, q: Array, v: Array, lam: Array, max_entries: float
) -> set[tuple[int, int]]:
    """Find the nonzero entries of d(Q - C_q^T lam)/dq and dQ/dv (Q: forces); return the set of their (i, j) and (j, i).

    Stop the search once the set has more than `max_entries` elements.
    """

    def reaction(q: Array) -> Array:
        if "jacobian" not in system.entries:
            return lam @ system.jacobian(t, q)
        rows, columns = system.entries["jacobian"]
        return np.bincount(columns, system.jacobian_values(t, q) * lam[rows], len(q)).astype(np.float64)

    force, undisplaced_reaction = system.force(t, q, v), reaction(q)
    entries: set[tuple[int, int]] = set()
    for j in range(len(q)):
        changed_q, changed_v = q.copy(), v.copy()
        changed_q[j] += DISPLACEMENT * max(1.0, abs(q[j]))
        changed_v[j] += DISPLACEMENT * max(1.0, abs(v[j]))
        is_changed = (system.force(t, changed_q, v) != force) | (reaction(changed_q) != undisplaced_reaction)
        is_changed |= system.force(t, q, changed_v) != force
        for i in np.flatnonzero(is_changed).tolist():
            entries |= {(i, j), (j, i)}
        if len(entries) > max_entries:
            break
    return entries


MASSLESS_RATIO = 1e-10  # eigenvectors of a body's block of M are massless if eigenvalue / (largest eigenvalue) <= this
# a singular M becomes invertible if g^T g is added for some rows g of C_q. A row g may be chosen if the component of g
# along massless directions is longer than this fraction of |g|
MIN_MASSLESS_FRACTION = 1e-3
MIN_SIZE_NEWTON = 1.6  # Newton's matrix gets dense factors if n_q < this * LARGE (smallest n_q of a large system)
MAX_SHARE = 0.05  # M and C_q get sparse factors if these take at most this fraction of the operations of dense ones


class FixedOrderForm(NamedTuple):
    """Fixed-order form: program for the sparse factors of a large system, and sizes and patterns of its matrices."""

    program: NDArray[np.int32]
    sizes: FixedOrderSizes  # sizes of the arrays in a workspace for this form
    mass: Entries  # row and column indices of the nonzero entries of M
    # (n_c, n_q), 1 where C_q may be nonzero, else 0; shape (0, n_q): the callback `jacobian_values` is used instead
    pattern: Array
    # (n_q, n_q), 1 where M may be nonzero, else 0; shape (0, 0): M is constant, or `mass_values` is used instead
    mass_pattern: Array
    newton_arguments: tuple[Any, ...]  # arguments `mass`, `jacobian`, `bodies`, `stiff` of `newton_form`
    newton_program: NDArray[np.int32] | None = None  # factorizes Newton's matrix; None until a plan needs it
    n_groups: int = 0  # number of column groups of Newton's matrix; each takes one finite difference of forces

    def matrix_cost(self) -> float:
        """Return the estimated cost of computing and factorizing Newton's matrix, in evaluations of accelerations."""
        assert self.newton_program is not None
        return self.n_groups + float(self.newton_program[N_UPDATES]) / max(1.0, float(self.program[N_UPDATES]))

    def newton_matrices_size(self, matrices: int) -> int:
        """Return the length of the array that contains a plan's sparse matrices instead of `matrices` dense ones."""
        from twoloop.kernels.steps.newton_systems import matrices_size
        from twoloop.kernels.steps.stages import SYSTEMS

        if self.newton_program is None or matrices == 0:
            return 0
        n_values = self.sizes.n_mass_values, self.sizes.n_jacobian_values
        return matrices_size(self.newton_program, *n_values, (matrices - SYSTEMS) // 2)


def fixed_order_form(system: ConstrainedSystem, t0: float, q0: Array, *plans: Plan) -> FixedOrderForm | None:
    """Return the fixed-order form of a system for `plans`; None if a plan cannot use it, or dense algebra is faster."""
    if system.n_q < LARGE or system.n_c == 0 or system.n_a > 0 or system.bandwidth is not None:
        return None
    has_gamma = "gamma" in system.given or system.functions.gamma_program.size > 0
    if not has_gamma or not all(plan.projects and plan.inner is None and not plan.own for plan in plans):
        return None
    form: FixedOrderForm | None = system.remembered(
        "fixed-order form", lambda: _create_fixed_order_form(system, t0, q0)
    )
    if form is not None and any(plan.matrices and plan.first is None for plan in plans):
        return add_newton_program(system, t0, q0, form)
    return form


def add_newton_program(system: ConstrainedSystem, t0: float, q0: Array, form: FixedOrderForm) -> FixedOrderForm | None:
    """Return `form` with the program for Newton's sparse matrix; None if dense factors of this matrix are faster."""
    if system.n_q < MIN_SIZE_NEWTON * LARGE:
        return None
    cached = system.remembered("newton form", lambda: newton_form(system, t0, q0, *form.newton_arguments))
    return None if cached is None else form._replace(newton_program=cached[0], n_groups=cached[1])


def _create_fixed_order_form(system: ConstrainedSystem, t0: float, q0: Array) -> FixedOrderForm | None:
    """Return the fixed-order form of a sparse system, or None if dense factorizations are expected to be faster."""
    pattern, mass_pattern = np.zeros((0, system.n_q)), np.zeros((0, 0))
    dense_mass = False
    if "jacobian" in system.entries:
        jacobian = system.entries["jacobian"]
    else:
        pattern = pattern_of(system, t0, q0)
        jacobian = _nonzero_entries(pattern)
    if "mass" in system.entries:
        mass = system.entries["mass"]
    else:
        entries = _mass_pattern(system, t0, q0)
        mass, dense_mass = _nonzero_entries(entries), not system.constant_mass
        mass_pattern = entries if dense_mass else mass_pattern
    if not _is_sparse(system.n_q, len(jacobian[0])) or not _is_sparse(system.n_q, len(mass[0])):
        return None
    bodies = _coordinates_of_bodies(system, mass)
    stiff_rows = _stiff_rows(system, t0, q0, mass, jacobian, bodies)
    program = factorization_program(system.n_q, system.n_c, mass, jacobian, bodies, stiff_rows)
    # approximate number of multiplications in one evaluation of accelerations with dense matrices
    dense_cost = 0.5 * system.n_c * system.n_c * (system.n_q + system.n_c / 3.0)
    if program is None or program[N_UPDATES] > MAX_SHARE * dense_cost:
        return None
    n_factors = int(program[N_PIVOTS] + program[N_OFF_DIAGONAL] + 1)
    sizes = FixedOrderSizes(n_factors, len(mass[0]), len(jacobian[0]), dense_mass, "jacobian" not in system.entries)
    return FixedOrderForm(program, sizes, mass, pattern, mass_pattern, (mass, jacobian, bodies, stiff_rows))


def _coordinates_of_bodies(system: ConstrainedSystem, mass: Entries) -> list[tuple[int, ...]]:
    """Return the indices of each body's coordinates; a body may be missing if no Joint names its coordinates.

    A Joint names the coordinates of one body only, so that the last body of a chain may be missing. If all bodies have
    seven coordinates (position and Euler parameters), no body is missing.
    """
    coordinates_by_joint = [joint.translation + joint.rotation for joint in system.joints]
    layouts = {tuple(j - body[0] for j in body) for body in coordinates_by_joint}
    if layouts != {tuple(range(7))} or system.n_q % 7 > 0 or any(body[0] % 7 > 0 for body in coordinates_by_joint):
        return coordinates_by_joint
    body_of = bodies_of(system.n_q, mass, ())
    expected = [7 * k + (j if j < 3 else 3) for k in range(system.n_q // 7) for j in range(7)]
    return coordinates_by_joint if body_of != expected else [tuple(range(k, k + 7)) for k in range(0, system.n_q, 7)]


def _stiff_rows(
    system: ConstrainedSystem, t0: float, q0: Array, mass: Entries, jacobian: Entries, bodies: list[tuple[int, ...]]
) -> list[int]:
    """Choose the rows g of C_q for which g^T g is added to a singular M to make it invertible; return their indices.

    See sparse_ldl.py. Each row contains coordinates of one body only, such as the row for the norm of Euler parameters,
    so that g^T g has no entries where M has none. Rows are chosen only until M is invertible.
    """
    values = system.mass_values(t0, q0) if "mass" in system.entries else system.mass(t0, q0)[mass]
    body_of = np.array(bodies_of(system.n_q, mass, bodies))
    coordinates: dict[int, list[int]] = {}
    for j, body in enumerate(body_of.tolist()):
        coordinates.setdefault(body, []).append(j)
    blocks: dict[int, Array] = {body: np.zeros((len(own), len(own))) for body, own in coordinates.items()}
    index_in_body = {j: k for own in coordinates.values() for k, j in enumerate(own)}
    mass_entries = set()
    for i, j, value in zip(*(each.tolist() for each in (*mass, values)), strict=True):
        blocks[int(body_of[i])][index_in_body[i], index_in_body[j]] += value
        mass_entries.add((i, j))
    massless = {body: vectors for body, block in blocks.items() if (vectors := _massless_directions(block)).size > 0}
    if not massless:
        return []
    columns: dict[int, list[tuple[int, float]]] = {}
    values = system.jacobian_values(t0, q0) if "jacobian" in system.entries else system.jacobian(t0, q0)[jacobian]
    for i, j, value in zip(*(each.tolist() for each in (*jacobian, values)), strict=True):
        columns.setdefault(i, []).append((j, value))
    stiff_rows = []
    for i, own in columns.items():
        body = int(body_of[own[0][0]])
        if body in massless and all((j, k) in mass_entries for j, _ in own for k, _ in own):
            row = np.zeros(len(coordinates[body]))
            for j, value in own:
                row[index_in_body[j]] += value
            component = massless[body] @ row
            if np.linalg.norm(component) > MIN_MASSLESS_FRACTION * np.linalg.norm(row):
                stiff_rows.append(i)
                massless[body] = np.linalg.svd(component[None, :])[2][1:] @ massless[body]
    return stiff_rows


def _massless_directions(block: Array) -> Array:
    """Return a body's massless directions, as rows, given its `block` of M; all directions if `block` is not finite."""
    if not np.isfinite(block).all():
        return np.eye(len(block))
    values, directions = np.linalg.eigh(block)
    return np.asarray(directions.T[values <= MASSLESS_RATIO * values[-1]])


def _is_sparse(n_q: int, n_entries: int) -> bool:
    """Return True if a matrix has so few nonzero entries that sparse factors may be faster than dense ones."""
    return n_entries <= MAX_SHARE * n_q * n_q + 24 * n_q


def _nonzero_entries(pattern: Array) -> Entries:
    rows, columns = np.nonzero(pattern)
    return rows.astype(np.int64), columns.astype(np.int64)


def _mass_pattern(system: ConstrainedSystem, t0: float, q0: Array) -> Array:
    """Return a matrix with 1 where M is nonzero at any of several positions near q0, else 0."""
    pattern = np.zeros((system.n_q, system.n_q))
    magnitudes = np.maximum(np.abs(q0), np.abs(q0).max())
    directions = np.random.default_rng(5).uniform(-1.0, 1.0, (len(NEARBY), system.n_q))
    for scale, direction in zip(NEARBY[:1] if system.constant_mass else NEARBY, directions, strict=False):
        try:
            mass = system.mass(t0, q0 + scale * magnitudes * direction)
        except Exception:  # skip a position where callbacks fail; a run later finds entries that are missed here
            continue
        pattern[(mass != 0.0) | (mass.T != 0.0)] = 1.0
    return pattern


GAMMA_ACCURACY = 1e-11  # relative error of gamma that is always allowed: finite differences are not more accurate
MAX_KITS = 16  # largest number of kits in a system's cache; the oldest kit is removed first


def make_kit(
    system: ConstrainedSystem, t0: float, q0: Array, plan: Plan | None = None, form: FixedOrderForm | None = None
) -> Kit:
    """Return a kit of a system: callbacks, flags that choose the linear algebra, and the step functions of `plan`."""
    if form is not None:
        return _make_fixed_order_kit(system, plan, form)
    return kit_for_plan(system, _flags_for_start(system, t0, q0), plan)


def _make_fixed_order_kit(system: ConstrainedSystem, plan: Plan | None, form: FixedOrderForm) -> Kit:
    """Return a new kit of a system for the fixed-order form."""
    from twoloop.kernels.evaluation.sparse_inner_loop import sparse_inner_loop

    flags = system.functions.flags.copy()
    flags[FORM] = FIXED_ORDER
    functions = system.functions._replace(flags=flags, ldl_program=form.program)
    if form.newton_program is not None:
        functions = functions._replace(newton_program=form.newton_program)
    if plan is None:
        return Kit(functions, sparse_inner_loop)
    return Kit(functions, sparse_inner_loop, *_steps_of_plan(plan), sparse_inner_loop)


def _flags_for_start(system: ConstrainedSystem, t0: float, q0: Array) -> Array:
    """Return the flags that choose the linear algebra for runs from q0; the caller must not change this array."""
    definite = has_definite_mass(system, t0, q0)
    key = ("flags", system.functions.flags.tobytes(), definite)
    flags, sparse = system.remembered(key, lambda: _dense_flags(system, t0, q0, definite))
    if not sparse:
        return flags  # type: ignore[no-any-return]
    position = (t0, q0.tobytes())
    if definite or system.remembered_at("inertia", position, lambda: least_inertia(system, t0, q0)[0]) > 0.0:
        flags = flags.copy()
        flags[FORM] = AUGMENTED
    return flags  # type: ignore[no-any-return]


def _dense_flags(system: ConstrainedSystem, t0: float, q0: Array, definite: bool) -> tuple[Array, bool]:
    """Return new flags that choose dense or banded linear algebra, and whether sparse factors would be faster."""
    flags: Array = system.functions.flags.copy()
    if system.constant_mass:
        flags[DIAGONAL_MASS] = is_diagonal(system.mass(t0, q0))
    uses_null_space = not definite or system.n_q <= 2 * (system.n_c + system.n_a)
    flags[FORM] = NULL_SPACE if uses_null_space else MULTIPLIERS
    bandwidth = system.bandwidth if definite and system.n_a == 0 else None
    if bandwidth is not None and banded_pays(system.n_q, system.n_c, bandwidth):
        flags[BANDWIDTH], flags[FORM] = bandwidth, MULTIPLIERS
    flags[DENSE_FORM] = flags[FORM]
    return flags, sparse_factors_pay(system, flags)


def sparse_factors_pay(system: ConstrainedSystem, flags: Array) -> bool:
    """Return True if sparse factors of the augmented form are faster than dense ones, judged by matrix sizes."""
    return sparse_pays(system.n_q, system.n_c + system.n_a, bool(flags[DIAGONAL_MASS]))


def is_diagonal(mass: Array) -> bool:
    """Return whether M has no entries outside its diagonal."""
    return np.count_nonzero(mass) == np.count_nonzero(mass.diagonal())


def kit_for_plan(system: ConstrainedSystem, flags: Array, plan: Plan | None) -> Kit:
    """Return the kit with these flags and the step functions of a plan: from the system's cache, or else a new one."""
    from twoloop.kernels.evaluation.inner_loop import inner_loop

    kits: dict[Any, tuple[Kit, Any]] = system.remembered("kits", dict)
    # `id` is a safe key here: cached kits refer to these objects, so that no other object can have the same id
    key: tuple[Any, ...] = id(system.functions), flags.tobytes()
    if plan is not None:
        key += (plan.inner, plan.step, plan.first, plan.second, len(LOADED_STEPS))
        key += tuple(map(id, (*plan.own, plan.numbers, plan.own_numbers)))
    entry = kits.get(key)
    if entry is None:
        flags = flags.copy()
        flags[IS_GENERATED] = plan is not None and plan.inner is not None
        functions, inner = system.functions._replace(flags=flags), inner_loop
        steps: tuple[Any, ...] = ()
        if plan is not None:
            inner = plan.inner or inner_loop
            steps = *_steps_of_plan(plan), inner_loop, plan.own, plan.numbers, plan.own_numbers
        if len(kits) == MAX_KITS:
            del kits[next(iter(kits))]
        entry = kits[key] = Kit(functions, inner, *steps), system.functions
    # a run in the augmented form may change the flags of its kit: return a copy, not the cached kit
    return _copy_with_flags(entry[0]) if flags[FORM] == AUGMENTED else entry[0]


def _steps_of_plan(plan: Plan) -> tuple[Any, Any, Any]:
    """Return a plan's Step and the Steps of its pair (None: no pair; PLACEHOLDER_STEP: second not imported yet)."""
    return load_step(plan.step), load_step(plan.first), step_if_loaded(plan.second)


def _copy_with_flags(kit: Kit) -> Kit:
    """Return a copy of a kit with its own flags, which a run may change; a new kit would take ten times as long."""
    new_kit, flags, table = object.__new__(Kit), kit.flags.copy(), kit.table.copy()
    table[common.KIT.offsets["flags"]] = flags.ctypes.data
    functions = kit.functions._replace(flags=flags)
    vars(new_kit).update(vars(kit), functions=functions, flags=flags, table=table, address=table.ctypes.data)
    return new_kit


def workspace(
    system: ConstrainedSystem,
    kit: Kit,
    pattern: Array,
    q0: Array,
    rtol: float,
    reuse: float,
    ranks: tuple[int | None, int | None] = (None, None),
    form: FixedOrderForm | None = None,
    matrices: int = 0,
) -> common.Work:
    """Return a new workspace for a run from q0.

    `pattern`: 1 where the constraint Jacobian (C_q, then A of non-holonomic constraints) may be nonzero, else 0.
    `ranks`: rank of C_q, and rank of the whole Jacobian; None: full rank. `matrices`: number of n_q x n_q matrices that
    the plan needs. `reuse`: see REUSE in data/indices.py.
    """
    flags = kit.flags
    uses_null_space, augmented = flags[DENSE_FORM] == NULL_SPACE, flags[FORM] == AUGMENTED
    programs = [each for each in (kit.jacobian_program, kit.gamma_program) if each.size]
    n_nodes = max((int(each[N_NODES]) for each in programs), default=0)
    n_q, n_c, n_a = system.n_q, system.n_c, system.n_a
    full_ranks = min(n_c, n_q), min(n_c + n_a, n_q)
    rank, rank_v = (rank if rank is not None else highest for rank, highest in zip(ranks, full_ranks, strict=True))
    sizes = n_q, n_c, n_a, rank, rank_v, bool(uses_null_space and n_q > rank_v), bool(augmented), n_nodes
    n_floats = matrices * n_q**2 if form is None else form.newton_matrices_size(matrices)
    work = empty_workspace((*sizes, None if form is None else form.sizes, n_floats))
    return prepare_workspace(work, system, flags, pattern, q0, rtol, reuse, form)


def prepare_workspace(
    work: common.Work,
    system: ConstrainedSystem,
    flags: Array,
    pattern: Array,
    q0: Array,
    rtol: float,
    reuse: float,
    form: FixedOrderForm | None = None,
) -> common.Work:
    """Reset the arrays of a workspace, new or used by an earlier run, for a run from q0; return the workspace."""
    arrays = map(np.ascontiguousarray, (pattern, q0))
    entry_point(cached_run().prepare_workspace)(work, *lasting_arrays(work), *arrays, max(rtol, GAMMA_ACCURACY), reuse)
    if form is not None:  # fixed-order form: set the pattern and partition here, since its kernels never change them
        work.pattern[:], work.mass_pattern[:] = form.pattern, form.mass_pattern
        work.dependent[:] = work.independent[:] = np.arange(system.n_q)
        work.is_independent[:] = 1.0
        if system.constant_mass and "mass" not in system.entries:
            work.mass_values[:] = system.mass(0.0, q0)[form.mass]
    elif flags[BANDWIDTH] >= 0:
        work.lapack[:] = lapack_addresses()
    return work

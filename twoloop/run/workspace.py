"""Kits and workspaces: the callbacks of a system with flags, and the arrays that all kernels need."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import has_definite_mass, least_inertia
from twoloop.kernels.compile.linking import entry_point
from twoloop.kernels.data import common
from twoloop.kernels.data.common import Kit
from twoloop.kernels.data.indices import (
    AUGMENTED,
    BANDWIDTH,
    DENSE_FORM,
    DIAGONAL_MASS,
    FORM,
    MULTIPLIERS,
    NULL_SPACE,
    STATIC,
    STRAIGHT,
)
from twoloop.kernels.evaluation.operations import N_NODES
from twoloop.kernels.layout import cached_run, lasting, make_work
from twoloop.kernels.linalg.band import banded_pays, lapack_addresses
from twoloop.kernels.linalg.saddle_point import sparse_pays
from twoloop.kernels.steps.lazy import LOADED, loaded, without_loading
from twoloop.methods.plan import Plan
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.static_form import StaticForm

Array = NDArray[np.float64]

GAMMA_ACCURACY = 1e-11  # relative error of gamma below which differences of C_q and C_t cannot come
MOST_KITS = 16  # largest number of kits that are cached with a system


def kit_of(
    system: ConstrainedSystem, t0: float, q0: Array, plan: Plan | None = None, static: StaticForm | None = None
) -> Kit:
    """Make the kit of a system: callbacks, flags that choose the linear algebra, and the steps of a plan."""
    from twoloop.kernels.evaluation.inner_loop import inner_loop

    if static is not None:
        return _static_kit(system, plan, static)
    flags = _flags_at(system, t0, q0)
    if plan is not None:
        return kit_with(system, flags, plan)

    def make() -> tuple[Kit, Any]:
        functions = system.functions
        return Kit(functions._replace(flags=flags.copy()), inner_loop), functions

    if flags[FORM] == AUGMENTED:  # a run may change these flags
        return make()[0]
    cached: tuple[Kit, Any] = system.remembered(("general kit", id(system.functions), flags.tobytes()), make)
    return cached[0]


def _static_kit(system: ConstrainedSystem, plan: Plan | None, form: StaticForm) -> Kit:
    """Make the kit of a system in the static form."""
    from twoloop.kernels.evaluation.sparse_inner_loop import sparse_inner_loop

    flags = system.functions.flags.copy()
    flags[FORM] = STATIC
    functions = system.functions._replace(flags=flags, static_program=form.program)
    if form.newton is not None:
        functions = functions._replace(newton_program=form.newton)
    if plan is None:
        return Kit(functions, sparse_inner_loop)
    return Kit(functions, sparse_inner_loop, *_steps_of(plan), sparse_inner_loop)


def _flags_at(system: ConstrainedSystem, t0: float, q0: Array) -> Array:
    """Return the flags at a position, which must not be written to."""
    definite = has_definite_mass(system, t0, q0)
    key = ("flags", system.functions.flags.tobytes(), definite)
    flags, sparse = system.remembered(key, lambda: _flags(system, t0, q0, definite))
    if not sparse:
        return flags  # type: ignore[no-any-return]
    place = (t0, q0.tobytes())
    if definite or system.remembered_at("inertia", place, lambda: least_inertia(system, t0, q0)[0]) > 0.0:
        flags = flags.copy()
        flags[FORM] = AUGMENTED
    return flags  # type: ignore[no-any-return]


def _flags(system: ConstrainedSystem, t0: float, q0: Array, definite: bool) -> tuple[Array, bool]:
    """Choose dense or banded algebra, and say whether sparse factors would pay."""
    flags: Array = system.functions.flags.copy()
    if system.constant_mass:
        flags[DIAGONAL_MASS] = is_diagonal(system.mass(t0, q0))
    reduced = not definite or system.n_q <= 2 * (system.n_c + system.n_a)
    flags[FORM] = NULL_SPACE if reduced else MULTIPLIERS
    bandwidth = system.bandwidth if definite and system.n_a == 0 else None
    if bandwidth is not None and banded_pays(system.n_q, system.n_c, bandwidth):
        flags[BANDWIDTH], flags[FORM] = bandwidth, MULTIPLIERS
    flags[DENSE_FORM] = flags[FORM]
    return flags, sparse_factors_pay(system, flags)


def sparse_factors_pay(system: ConstrainedSystem, flags: Array) -> bool:
    """Return whether sparse factors would pay; they need an M with an inverse, or inertia in all that moves."""
    return sparse_pays(system.n_q, system.n_c + system.n_a, bool(flags[DIAGONAL_MASS]))


def is_diagonal(mass: Array) -> bool:
    """Return whether M has no entries outside its diagonal."""
    return np.count_nonzero(mass) == np.count_nonzero(mass.diagonal())


def kit_with(system: ConstrainedSystem, flags: Array, plan: Plan) -> Kit:
    """Return the kit of these flags and of a plan, which the system caches for the next run."""
    from twoloop.kernels.evaluation.inner_loop import inner_loop

    read = (plan.numbers, plan.own_numbers)
    kept: dict[Any, tuple[Kit, Any]] = system.remembered("kits", dict)
    # the cached objects keep those alive whose ids are in the key
    called = (plan.inner, plan.step, plan.first, plan.second)
    key = (id(system.functions), flags.tobytes(), *called, len(LOADED), *map(id, (*plan.own, *read)))
    changes = flags[FORM] == AUGMENTED  # a run may change these flags
    if key in kept:
        return _with_own_flags(kept[key][0]) if changes else kept[key][0]
    flags = flags.copy()
    flags[STRAIGHT] = plan.inner is not None
    functions = system.functions._replace(flags=flags)
    kernels = Kit(functions, plan.inner or inner_loop, *_steps_of(plan), inner_loop, plan.own, *read)
    if len(kept) == MOST_KITS:
        del kept[next(iter(kept))]
    kept[key] = kernels, system.functions
    return _with_own_flags(kernels) if changes else kernels


def _steps_of(plan: Plan) -> tuple[Any, Any, Any]:
    """Return the step that is called, and the two between which it chooses; the second is loaded only when needed."""
    return loaded(plan.step), loaded(plan.first), without_loading(plan.second)


def _with_own_flags(kit: Kit) -> Kit:
    """Copy a kit for one run: this takes a tenth of the time of a new kit."""
    other, flags, table = object.__new__(Kit), kit.flags.copy(), kit.table.copy()
    table[common.KIT.places["flags"]] = flags.ctypes.data
    functions = kit.functions._replace(flags=flags)
    vars(other).update(vars(kit), functions=functions, flags=flags, table=table, address=table.ctypes.data)
    return other


def workspace(
    system: ConstrainedSystem,
    kit: Kit,
    pattern: Array,
    q0: Array,
    rtol: float,
    reuse: float,
    ranks: tuple[int | None, int | None] = (None, None),
    static: StaticForm | None = None,
    matrices: int = 0,
) -> common.Work:
    """Create a workspace for ranks of C_q and of all rows (None: full); `pattern` is that of all rows.

    `matrices`: number of dense matrices, as in a plan.
    """
    flags = kit.flags
    reduced, augmented = flags[DENSE_FORM] == NULL_SPACE, flags[FORM] == AUGMENTED
    programs = [each for each in (kit.jacobian_program, kit.gamma_program) if each.size]
    n_nodes = max((int(each[N_NODES]) for each in programs), default=0)
    sizes = (system.n_q, system.n_c, system.n_a, *ranks, bool(reduced), bool(augmented), n_nodes)
    n_matrices = matrices * system.n_q**2 if static is None else static.n_matrices(matrices)
    work = make_work(*sizes, None if static is None else static.static, n_matrices)
    return prepare_workspace(work, system, flags, pattern, q0, rtol, reuse, static)


def prepare_workspace(
    work: common.Work,
    system: ConstrainedSystem,
    flags: Array,
    pattern: Array,
    q0: Array,
    rtol: float,
    reuse: float,
    static: StaticForm | None = None,
) -> common.Work:
    """Prepare a workspace for a run, whatever the run before has left in it."""
    given = map(np.ascontiguousarray, (pattern, q0))
    entry_point(cached_run().prepare_workspace)(work, *lasting(work), *given, max(rtol, GAMMA_ACCURACY), reuse)
    if static is not None:
        _fill(work, system, static, q0)
        return work
    if flags[BANDWIDTH] >= 0:
        work.lapack[:] = lapack_addresses()
    return work


def _fill(work: common.Work, system: ConstrainedSystem, form: StaticForm, q0: Array) -> None:
    """Fill in the constant parts of a workspace of the static form."""
    work.pattern[:], work.mass_pattern[:] = form.pattern, form.mass_pattern
    work.dependent[:] = work.independent[:] = np.arange(system.n_q)
    work.counts[:] = 1.0
    if system.constant_mass and "mass" not in system.entries:
        work.mass_values[:] = system.mass(0.0, q0)[form.mass]

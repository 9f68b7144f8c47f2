"""A guess for a large system put on its constraints by sparse factors: consistent_state without its matrices.

What is not plain sailing is left to it: rows that depend on one another beside the constraints only nearly, places near
a dead centre, other guesses that may lead elsewhere.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.scales import typical_sizes, units
from twoloop.checks.sparse_rows import SparseRows
from twoloop.checks.violation import is_at_rounding
from twoloop.kernels.compile.linking import direct
from twoloop.kernels.data import codes, flags, noted
from twoloop.kernels.evaluation import tasks
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.static_form import static_form
from twoloop.run.workspace import kit_of, workspace

Array = NDArray[np.float64]

CLEAR = 1e-5  # sine of a row to others, below which a position may be near a dead centre
MOST_CORRECTIONS, ROUNDING = 25, 1e-14  # by Newton's method, and what of the largest coordinate is rounding
STRAIGHT = 0.5  # of a displacement: how far its projection may end from where C_q sends it, on the same assembly


class _Metric:
    """The static form with the unit matrix in the place of M: its corrections are the least of all coordinates."""

    def __init__(self, system: ConstrainedSystem, t: float, q: Array, form: Any, rank: int | None = None):
        self.system, self.t, self.rank = system, t, rank
        self.form = form._replace(static=form.static._replace(dense_mass=False), mass_pattern=np.zeros((0, 0)))
        self.kit = kit_of(system, t, q, None, self.form)
        self.kit.flags[flags.CONSTANT_MASS], self.kit.flags[flags.MASS_VALUES_GIVEN] = 1, 0
        self.work = workspace(system, self.kit, np.zeros((0, 0)), q, 1e-8, 0.0, (rank, rank), self.form)
        rows, columns = form.mass
        diagonal = np.where(rows == columns, 1.0, 0.0)
        self.work.mass_values[:] = diagonal / np.bincount(rows, diagonal, system.n_q)[rows]

    def ask(self, task: int, q: Array, v: Array, a: Array | None = None, lam: Array | None = None) -> int:
        """What the inner loop says to a task; q and v are changed."""
        a, lam = self.work.x if a is None else a, self.work.lam if lam is None else lam
        return int(direct(self.kit.inner)(self.kit, self.work, task, self.t, q, v, 0.0, a, lam))

    def nearest(self, way: Array) -> Array:
        """What the constraints, by the factors there are, leave of a displacement."""
        rows = self.system.sparse_rows(self.t, self.at)
        change = np.zeros(len(way))
        zero, residual = np.zeros(len(way)), np.ascontiguousarray(rows @ way)
        self.ask(tasks.SOLVE, zero, residual, change)
        return way - change

    def onto_constraints(self, q: Array) -> Array | None:
        """q on the constraints by the rows that count; None where that fails, or where others are violated then.

        Rows that depend on others on the constraints do so only nearly beside them, where a choice would fail.
        """
        zero, change = np.zeros(len(q)), np.zeros(len(q))
        for _ in range(MOST_CORRECTIONS):
            if self.ask(tasks.TANGENTS, q, zero) != codes.DONE:
                return None
            self.ask(tasks.SOLVE, zero, self.system.constraint(self.t, q), change)
            q = q - change
            if not np.abs(change).max() > ROUNDING * np.abs(q).max():  # also true for NaN
                break
        held = self.system.constraint(self.t, q)
        return q if is_at_rounding(held, self.system.sparse_rows(self.t, q), q) else None

    def project(self, q: Array, v: Array) -> tuple[Array, Array] | None:
        """q and v on the constraints."""
        q, on_the_way = q.copy(), v.copy()
        if self.ask(tasks.RENEW, q, v) != codes.DONE or self.ask(tasks.RESTORE, q, on_the_way) != codes.DONE:
            return None
        v = v.copy()  # the least change of the velocities is that where positions end
        for task in (tasks.RESTORE, tasks.RESTORE, tasks.TANGENTS):  # twice, to rounding
            if self.ask(task, q, v) != codes.DONE:
                return None
        self.at = q
        return q, v


class Dependence(NamedTuple):
    """The rank of C_q of a large system at a position, and rows that are made of others."""

    rank: int
    shares: dict[int, Array]  # of each row that does not count, (n_c,): what of the others it is made of
    allowed: Array  # a displacement that C_q allows, at most 1 in the units of the coordinates, (n_q,)
    onto_constraints: Callable[[Array], Array | None]  # a position near it moved to them, by the rows that count here


def dependence(system: ConstrainedSystem, t: float, q: Array) -> Dependence | None:
    """Which rows of a large sparse system depend on others; None where that is not to be left to sparse factors."""
    form, all_rows = static_form(system, t, q), system.sparse_rows(t, q)
    if form is None or not isinstance(all_rows, SparseRows):
        return None
    metric, still = _Metric(system, t, q, form), np.zeros_like(q)
    code = metric.ask(tasks.RENEW, q.copy(), still)
    if code == codes.RANK_DIFFERS:
        metric = _Metric(system, t, q, form, int(metric.work.notes[noted.RANK]))
        code = metric.ask(tasks.RENEW, q.copy(), still)
    if code != codes.DONE or metric.work.notes[noted.PIVOT] < CLEAR:
        return None
    counted, room = set(metric.work.rows_v.tolist()), np.zeros_like(q)
    shares: dict[int, Array] = {}
    for row in range(system.n_c):
        if row not in counted:
            shares[row] = np.zeros(system.n_c)
            metric.ask(tasks.SOLVE, all_rows.row(row), np.zeros(system.n_c), room, shares[row])
    metric.at = q
    columns = units(system, t, q, all_rows, typical_sizes(q))
    allowed = metric.nearest(columns * np.random.default_rng(3).uniform(0.5, 1.0, len(q)))
    most = float((np.abs(allowed) / columns).max())
    return Dependence(len(counted), shares, allowed / most if most > 0.0 else allowed, metric.onto_constraints)


def project_sparsely(
    system: ConstrainedSystem, t: float, q: Array, v: Array, check_assembly: bool
) -> tuple[Array, Array] | None:
    """(q, v) moved to the constraints by the least change; None where that is not to be left to sparse factors."""
    form = static_form(system, t, q)
    if form is None:
        return None
    with np.errstate(all="ignore"):
        metric = _Metric(system, t, q, form)
    code = metric.ask(tasks.RENEW, q.copy(), v.copy())
    if code == codes.RANK_DIFFERS:
        metric = _Metric(system, t, q, form, int(metric.work.notes[noted.RANK]))
    elif code != codes.DONE:
        return None
    found = metric.project(q, v)
    if found is None or metric.work.notes[noted.PIVOT] < CLEAR:
        return None
    there = _Metric(system, t, found[0], form, metric.rank)
    if there.ask(tasks.RENEW, found[0].copy(), v.copy()) != codes.DONE:  # other rows count on the constraints
        return None
    rows, rate = system.sparse_rows(t, found[0]), system.rates(t, found[0])
    if not is_at_rounding(system.constraint(t, found[0]), rows, found[0]):
        return None
    if not is_at_rounding(rows @ found[1] + rate, rows, found[1], rate):
        return None
    moved = found[0] - q
    if check_assembly and np.abs(moved).max() > 0.0 and not _same_from_elsewhere(metric, found[0], moved):
        return None
    return found


def _same_from_elsewhere(metric: _Metric, found: Array, moved: Array) -> bool:
    """Whether other guesses, as far off, end where C_q sends them."""
    far = float(np.abs(moved).max())
    generic = np.random.default_rng(8).uniform(-1.0, 1.0, (2, len(found)))
    rest = np.zeros(len(found))
    for way in (-2.0 * moved, far * generic[0], far * generic[1]):
        if metric.project(found, rest) is None:
            return False
        expected = found + metric.nearest(way)
        again = metric.project(found + way, rest)
        if again is None or np.abs(again[0] - expected).max() > STRAIGHT * np.abs(way).max():
            return False
    return True

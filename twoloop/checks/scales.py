"""Sizes of a mechanism, coordinate by coordinate: consistency is judged by them, in any unit and with any offset.

The offset of a coordinate is not a size, and millimetres and radians have none in common. The Jacobian has: it shows
which displacements of two coordinates change a constraint equally, and how far they must move until the Jacobian itself
is another one (a rod's length, a radian).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array
from twoloop.checks.callbacks import check_callback
from twoloop.checks.sparse_rows import Rows, SparseRows, is_finite
from twoloop.kernels.compile.linking import entry_point

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


# 1/s: largest speed of a drive, in sizes of the mechanism a second; a faster one means that C_q is nearly zero
FASTEST = 1e9
EPS = float(np.finfo(np.float64).eps)
DISPLACEMENTS = (1e-2, 1e-4, 1e-6)  # displacements in units of the coordinates, for the curvature of the constraints
ROUNDS = 3  # iterations that find units: the first ones may be off by 1e5
MOST_PLACES = 16  # largest number of positions whose sizes are kept
NONE = np.zeros(0)
# distance in units: a row that is much shorter than its change over it is short only at this position
TURNS = 0.1


@dataclass(frozen=True)
class Scales:
    """Scales: units in which the entries of C_q are of like size, and the mechanism's size in these units."""

    columns: Array  # (n_q,), units of the coordinates
    rows: Array  # (n_c,), norms of the rows of C_q in these units, or their norms nearby if larger; 1 for zero rows
    reach: Array  # (n_c,), distance in these units over which each constraint keeps its Jacobian

    def scaled(self, jacobian: Array) -> Array:
        """Return C_q in these units with rows of norm 1, or less where a row vanishes at this position."""
        return jacobian * self.columns / self.rows[:, None]

    def by_coordinate(self, per_row: Array, jacobian: Array) -> Array:
        """Return the least value of the constraints on each coordinate, in its unit; of all if it has none."""
        values = np.where(jacobian != 0.0, per_row[:, None], np.inf).min(axis=0, initial=np.inf)
        return self.columns * np.where(np.isfinite(values), values, per_row.min(initial=np.inf))

    def keep(self, system: ConstrainedSystem, q: Array, jacobian: Array) -> None:
        """Store the reach of the coordinates at a consistent position: relative to it, rounding is negligible.

        Later checks of starts nearby use it if C_q has the same entries, and need not find these scales again.
        Elsewhere the mechanism may be smaller by far. The latest positions are stored: the sizes, the position, and the
        nonzero entries.
        """
        from twoloop.kernels.evaluation.checks import NEAR_SHARE, NO_ENTRY

        n, size = len(q), np.abs(jacobian)
        entries = (size > NO_ENTRY * size.max(axis=1, initial=0.0)[:, None]).ravel()
        known = system.derived.get("sizes", NONE).reshape(-1, 2 * n + entries.size)
        away = (np.abs(known[:, n : 2 * n] - q) > NEAR_SHARE * known[:, :n]).any(axis=1)
        others = known[away | (known[:, 2 * n :] != entries).any(axis=1)][: MOST_PLACES - 1]
        system.derived["sizes"] = np.concatenate([self.by_coordinate(self.reach, jacobian), q, entries, others.ravel()])


def sizes(q: Array) -> Array:
    """Return a first guess of the displacement of each coordinate that matters."""
    size, n = np.abs(q), q.size
    ordered = size.copy()
    ordered.sort()
    first = n - np.count_nonzero(size)  # index of the first size that is not zero
    middle = 0.5 * float(ordered[(first + n - 1) // 2] + ordered[(first + n) // 2]) if first < n else 1.0
    return np.maximum(size, 1e-3 * middle)


def typical_sizes(q: Array) -> Array:
    """Return sizes of the coordinates, (n_q,): at least the median of those not negligible; 1 if all are zero."""
    from twoloop.kernels.evaluation.checks import NEGLIGIBLE

    size = np.abs(q)
    return np.maximum(size, median(size[size > NEGLIGIBLE * size.max()]) if size.any() else 1.0)


@cache
def generic_factors(n_q: int) -> Array:
    """Return fixed random factors between 0.5 and 1.5, of either sign, (n_q,)."""
    generic = np.random.default_rng(1)
    return generic.uniform(0.5, 1.5, n_q) * generic.choice((-1.0, 1.0), n_q)


def median(values: Array) -> float:
    """Return the median of finite numbers, without NumPy's checks for others."""
    return _middle(np.sort(values))


def _middle(ordered: Array) -> float:
    """Return the median of sorted numbers."""
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def column_scales(jacobian: Rows, typical: Array) -> Array:
    """Return units of the coordinates in which entries of C_q are of like size; the typical ones for zero columns."""
    from twoloop.kernels.evaluation.checks import column_units

    if isinstance(jacobian, SparseRows):
        return _sparse_column_scales(jacobian, typical)
    n_rows, n = jacobian.shape
    columns, room = np.zeros((2, n))
    entry_point(column_units)(
        np.ascontiguousarray(jacobian), typical, columns, *np.zeros((2, n_rows, n)), np.zeros(n_rows), room
    )
    return columns


def _sparse_column_scales(jacobian: SparseRows, typical: Array) -> Array:
    """Return the same units from the entries alone."""
    size, (m, n) = np.abs(jacobian.values), jacobian.shape
    counts = size > 1e-12 * jacobian.largest()[jacobian.rows]
    i, j, logs = jacobian.rows[counts], jacobian.columns[counts], np.log(size[counts])
    used = np.bincount(j, minlength=n) > 0
    if not used.any():
        return typical
    in_row, in_column = np.maximum(np.bincount(i, minlength=m), 1), np.maximum(np.bincount(j, minlength=n), 1)
    columns = np.zeros(n)
    for _ in range(20):
        rows = np.bincount(i, logs + columns[j], m) / in_row
        columns = np.bincount(j, rows[i] - logs, n) / in_column
    columns = np.exp(columns + median(np.log(typical[used]) - columns[used]))
    return np.where(used, columns, typical)


def scales_of(system: ConstrainedSystem, t: float, q: Array, jacobian: Array) -> Scales:
    """Return the scales at a position, from C_q there and nearby; from C_q and A, if `jacobian` has both."""
    from twoloop.kernels.evaluation.checks import NEGLIGIBLE, row_reaches

    size, columns = np.abs(q), units(system, t, q, jacobian, typical_sizes(q))
    in_units = np.abs(jacobian) * columns
    norms, curvature = np.sqrt((in_units * in_units).sum(axis=1)), _curvature(system, t, q, columns, len(jacobian))
    rows = np.maximum(norms, TURNS * curvature)
    rows[rows == 0.0] = 1.0
    lengths = np.where(norms > 0.0, norms, 1.0)
    radius = lengths / np.maximum(curvature, 1e-300 * np.maximum(lengths, 1.0))
    in_units = np.ascontiguousarray((jacobian != 0.0) * (size / columns))
    reach, negligible = np.ones(len(rows)), NEGLIGIBLE * float(in_units.max(initial=0.0))
    entry_point(row_reaches)(in_units, radius, negligible, np.zeros(len(q)), reach)
    return Scales(columns, rows, reach)


def units(system: ConstrainedSystem, t: float, q: Array, jacobian: Rows, typical: Array) -> Array:
    """Return units of the coordinates in which entries of C_q (and A) are of like size, here or a unit away.

    An entry that is small only at this position, as of a bar that is almost upright, says nothing about units.
    """
    columns, ways = column_scales(jacobian, typical), np.outer([1.0, -1.0], generic_factors(len(q)))
    for _ in range(ROUNDS):  # a fixed number, so that rounding does not decide it
        estimated = column_scales(_largest(system, t, q + columns * ways, jacobian), typical)
        # an entry that grows with its coordinate has half the unit at twice the displacement
        columns = np.cbrt(columns * estimated * estimated)
    return columns


def _largest(system: ConstrainedSystem, t: float, places: Array, here: Rows) -> Rows:
    """Return the largest magnitude of each entry, here and at other places, at which callbacks may be undefined."""
    if not isinstance(here, SparseRows):
        beside = rows_at(system, t, places)[0][:, : len(here)]
        return np.maximum(abs(here), abs(np.where(np.isfinite(beside), beside, 0.0)).max(axis=0))
    largest = abs(here.values)
    for place in places:
        try:
            rows = system.sparse_rows(t, place)
        except Exception:  # outside the domain of the callbacks
            continue
        if isinstance(rows, SparseRows) and is_finite(rows):
            largest = np.maximum(largest, abs(rows.values))
    return here.with_values(largest)


def rows_at(system: ConstrainedSystem, t: float, places: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return C_q and A at positions, (n, n_c + n_a, n_q), and at which of these no callback raised, (n,)."""
    from twoloop.kernels.evaluation import checks as first_look

    check_callback(system, "jacobian", t, [places[0]])
    n, kit, defined = len(places), system.kit, np.ones(len(places), dtype=bool)
    rows = np.zeros((n, system.n_c + system.n_a, system.n_q))
    evaluate = entry_point(first_look.rows_at)
    try:
        evaluate(kit, t, places, system.n_c, rows.reshape(-1, system.n_q))
    except Exception:  # a position failed: evaluate one by one
        rows[:] = 0.0
        for k in range(n):
            try:
                evaluate(kit, t, places[k : k + 1], system.n_c, rows[k])
            except Exception:  # outside the domain of the callbacks
                defined[k] = False
    return rows, defined


@cache
def signs(n_q: int) -> Array:
    """Return fixed random signs of the displacements of the coordinates, (n_q,)."""
    return np.random.default_rng(3).choice((-1.0, 1.0), n_q)


def _curvature(system: ConstrainedSystem, t: float, q: Array, columns: Array, n_rows: int) -> Array:
    """Return how fast each row of C_q changes per unit of the coordinates; one digit is enough."""
    way = columns * signs(len(q))
    largest = np.zeros(n_rows)
    shifts = np.array([side * part for part in DISPLACEMENTS for side in (1.0, -1.0)])
    rows, defined = rows_at(system, t, q + shifts[:, None] * way)
    rows = rows[:, :n_rows]
    for k, part in enumerate(DISPLACEMENTS):
        one, other = rows[2 * k : 2 * k + 2]
        change = np.sqrt((((one - other) * columns) ** 2).sum(axis=1)) / (2.0 * part)
        noise = EPS * (np.abs(one) @ (columns + np.abs(q))) / part
        if defined[2 * k : 2 * k + 2].all() and np.isfinite(change).all():
            largest = np.maximum(largest, np.where(change > noise, change, 0.0))
    return largest


def generic_velocities(system: ConstrainedSystem, t: float, q: Array, jacobian: Rows, rate: Array) -> list[Array]:
    """Return velocities in which each coordinate matters; if C_t is not zero, also some as fast as the drive (last)."""
    size = sizes(q)
    v = units(system, t, q, jacobian, size) * generic_factors(len(q))
    v = v / median(np.abs(v) / size)
    driven, moved = rate != 0.0, abs(jacobian) @ np.abs(v)
    if not (driven & (moved > 0.0)).any():
        return [v]
    faster = float(np.median(np.abs(rate[driven & (moved > 0.0)]) / moved[driven & (moved > 0.0)]))
    return [v, min(faster, FASTEST) * v]

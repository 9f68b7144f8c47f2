"""How large a mechanism is, coordinate by coordinate: what its consistency is judged by, at any unit and any offset.

An offset of coordinates is not a size, and millimetres beside radians have none in common. What has is the Jacobian: it
says how much of one coordinate does as much to a constraint as how much of another, and how far they must move until
it is another Jacobian (a rod's length, a radian).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.sparse_rows import Rows, SparseRows

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

EPS = float(np.finfo(np.float64).eps)
DISPLACEMENTS = (1e-2, 1e-4, 1e-6)  # of a coordinate, for the curvature of the constraints
TURNS = 0.1  # units: a row that is short beside what it becomes over this way is short by its position
NEGLIGIBLE = 1e-6  # of the largest coordinate: smaller ones are zero by chance and are no size


@dataclass(frozen=True)
class Scales:
    """Units in which the entries of C_q are of like size, and the mechanism's size in these units."""

    columns: Array  # (n_q,), units of the coordinates
    rows: Array  # (n_c,), norms of the rows of C_q in these units, or what they become a little away; 1 for zeros
    reach: Array  # (n_c,), in these units: how far each constraint stays what it is

    def scaled(self, jacobian: Array) -> Array:
        """C_q with coordinates in these units and rows of norm 1, less where a row vanishes by its position."""
        return jacobian * self.columns / self.rows[:, None]

    def by_coordinate(self, per_row: Array, jacobian: Array) -> Array:
        """The least of what the constraints on each coordinate say, in its own unit; of all, where there is none."""
        values = np.where(jacobian != 0.0, per_row[:, None], np.inf).min(axis=0, initial=np.inf)
        return self.columns * np.where(np.isfinite(values), values, per_row.min(initial=np.inf))


def sizes(q: Array) -> Array:
    """A first guess at how far each coordinate must move to matter."""
    size = np.abs(q)
    typical = _median(size[size > 0.0]) if size.any() else 1.0
    return np.maximum(size, 1e-3 * typical)


def _median(values: Array) -> float:
    """Of numbers that are finite, without what NumPy does about others."""
    ordered = np.sort(values)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def column_scales(jacobian: Rows, typical: Array) -> Array:
    """Units of the coordinates in which the entries of C_q are of like size; of zero columns, the typical ones."""
    if isinstance(jacobian, SparseRows):
        return _sparse_column_scales(jacobian, typical)
    size = np.abs(jacobian)
    counts = size > 1e-12 * size.max(axis=1, keepdims=True, initial=0.0)  # others are what rounding has left
    used = counts.any(axis=0)
    if not used.any():
        return typical
    logs = np.where(counts, np.log(np.where(counts, size, 1.0)), 0.0)
    in_row, in_column = np.maximum(counts.sum(axis=1), 1), np.maximum(counts.sum(axis=0), 1)
    of_row, of_column = logs.sum(axis=1), logs.sum(axis=0)
    counts_of = counts.astype(np.float64)
    columns = np.zeros(len(typical))
    for _ in range(20):  # least squares of log|C_q| + columns - rows, by turns
        rows = (of_row + counts_of.dot(columns)) / in_row
        before, columns = columns, (rows.dot(counts_of) - of_column) / in_column
        if (columns == before).all():
            break
    # the unit of the whole is free: that of the coordinates
    columns = np.exp(columns + _median(np.log(typical[used]) - columns[used]))
    return np.where(used, columns, typical)


def _sparse_column_scales(jacobian: SparseRows, typical: Array) -> Array:
    """The same from the entries alone."""
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
    columns = np.exp(columns + _median(np.log(typical[used]) - columns[used]))
    return np.where(used, columns, typical)


def scales_of(system: ConstrainedSystem, t: float, q: Array, jacobian: Array) -> Scales:
    """Scales at a position, from C_q there and nearby; or from C_q and A, if `jacobian` has the rows of both."""
    size = np.abs(q)
    typical = _median(size[size > NEGLIGIBLE * size.max()]) if size.any() else 1.0
    columns = column_scales(jacobian, np.maximum(size, typical))
    norms, curvature = np.linalg.norm(jacobian * columns, axis=1), _curvature(system, t, q, columns, len(jacobian))
    rows = np.maximum(norms, TURNS * curvature)
    rows = np.where(rows > 0.0, rows, 1.0)
    radius = np.where(norms > 0.0, norms, 1.0) / np.maximum(curvature, 1e-300)
    in_units = np.where(jacobian != 0.0, size / columns, 0.0)
    reach, negligible = np.ones(len(rows)), NEGLIGIBLE * float(in_units.max(initial=0.0))
    for i, row in enumerate(in_units):
        largest = float(row.max())
        if radius[i] <= max(largest, 1.0):
            reach[i] = radius[i]
        elif largest > negligible:  # straight: the smaller half of the coordinates, so that an offset does not count
            smaller = np.sort(row[row > NEGLIGIBLE * largest])
            reach[i] = float(smaller[(len(smaller) - 1) // 2])
    return Scales(columns, rows, reach)


@cache
def _signs(n_q: int) -> Array:
    """Of the displacements of the coordinates, (n_q,): always the same."""
    return np.random.default_rng(3).choice((-1.0, 1.0), n_q)


def _curvature(system: ConstrainedSystem, t: float, q: Array, columns: Array, n_rows: int) -> Array:
    """How fast each row of C_q turns, per unit of the coordinates: one digit is enough."""
    way = columns * _signs(len(q))
    rows = system.jacobian if n_rows == system.n_c else system.rows
    largest = np.zeros(n_rows)
    for part in DISPLACEMENTS:
        try:
            ends = [rows(t, q + side * part * way) for side in (1.0, -1.0)]
        except Exception:  # outside what the constraints are made for
            continue
        change = np.linalg.norm((ends[0] - ends[1]) * columns, axis=1) / (2.0 * part)
        noise = EPS * (np.abs(ends[0]) @ columns + np.abs(ends[0] * columns) @ (np.abs(q) / columns)) / part
        if np.isfinite(change).all():
            largest = np.maximum(largest, np.where(change > noise, change, 0.0))
    return largest

"""Sparse rows of constraints, stored by entries, for checks that must not allocate a full Jacobian."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import Array

Integers = NDArray[np.int64]


class SparseRows:
    """Sparse matrix (m, n) stored by entries, without duplicates, with the array operations that checks need."""

    def __init__(self, rows: Integers, columns: Integers, values: Array, shape: tuple[int, int]):
        keys, self.entry_indices = np.unique(rows * shape[1] + columns, return_inverse=True)
        self.rows, self.columns, self.shape = keys // shape[1], keys % shape[1], shape
        self.values = self.added(values)

    def added(self, values: Array) -> Array:
        """Return values, given in the constructor's order, in the order of entries; add up the values of an entry."""
        return np.bincount(self.entry_indices, values, len(self.rows)).astype(np.float64)

    @property
    def size(self) -> int:
        """Return the size of the full matrix."""
        return self.shape[0] * self.shape[1]

    def __len__(self) -> int:
        return self.shape[0]

    def __matmul__(self, x: Array) -> Array:
        return np.bincount(self.rows, self.values * x[self.columns], self.shape[0]).astype(np.float64)

    def __abs__(self) -> SparseRows:
        return self.with_values(np.abs(self.values))

    def pattern(self) -> SparseRows:
        """Return the same entries with the value 1."""
        return self.with_values(np.ones(len(self.values)))

    def with_values(self, values: Array) -> SparseRows:
        """Return a matrix with other values of the same entries."""
        other = object.__new__(SparseRows)
        vars(other).update(vars(self), values=values)
        return other

    def __getitem__(self, part: slice) -> SparseRows:
        """Return all rows (slices that select all rows are the only ones supported)."""
        assert part == slice(self.shape[0])
        return self

    def part(self, rows: tuple[int, ...], columns: tuple[int, ...]) -> Array:
        """Return some rows and columns as a full matrix."""
        matrix = np.zeros((len(rows), len(columns)))
        for k, row in enumerate(rows):
            first, last = np.searchsorted(self.rows, [row, row + 1])  # entries are sorted by rows
            for column, value in zip(self.columns[first:last].tolist(), self.values[first:last], strict=True):
                if column in columns:
                    matrix[k, columns.index(column)] = value
        return matrix

    def row(self, i: int) -> Array:
        """Return one row as a full vector."""
        row = np.zeros(self.shape[1])
        first, last = np.searchsorted(self.rows, [i, i + 1])
        row[self.columns[first:last]] = self.values[first:last]
        return row

    def matrix(self) -> Array:
        """Return the full matrix."""
        matrix = np.zeros(self.shape)
        matrix[self.rows, self.columns] = self.values
        return matrix

    def largest(self) -> Array:
        """Return the largest magnitude in each row, (m,)."""
        largest = np.zeros(self.shape[0])
        np.maximum.at(largest, self.rows, np.abs(self.values))
        return largest


Rows = Array | SparseRows


def is_finite(rows: Rows) -> bool:
    """Return whether all entries are finite."""
    return bool(np.isfinite(rows.values if isinstance(rows, SparseRows) else rows).all())


def norms(rows: Rows) -> Array:
    """Return the norm of each row."""
    if isinstance(rows, SparseRows):
        return np.sqrt(np.bincount(rows.rows, rows.values**2, rows.shape[0]))
    lengths: Array = np.linalg.norm(rows, axis=1)
    return lengths

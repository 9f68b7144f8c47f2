"""Matrices given by the values of their entries: where these are, and the dense matrices that stand beside them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import shown
from twoloop.kernels.compile.caches import watch
from twoloop.kernels.compile.callbacks import compile_callback
from twoloop.kernels.compile.private import Dispatcher

Integers = NDArray[np.int64]
Entries = tuple[Integers, Integers]  # rows and columns

LARGE = 64  # coordinates from which on entries serve better than dense matrices; on chains of bars from 36 on
VALUES_OF = {"mass": "mass_values", "jacobian": "jacobian_values"}  # of dense kinds, those that give values alone


def check_entries(name: str, given: Any, shape: tuple[int, int], symmetric: bool) -> Entries:
    """Return the rows and columns of the entries of a matrix as vectors, or say what is wrong with them."""
    try:
        rows, columns = (np.asarray(each) for each in given)
    except (TypeError, ValueError):
        raise TypeError(f"{name} must be two vectors of int, rows and columns; given {shown(given)}") from None
    for each in (rows, columns):
        if each.ndim != 1 or (each.size and not np.issubdtype(each.dtype, np.integer)):
            raise TypeError(f"{name} must be two vectors of int, rows and columns; given {shown(given)}")
    if len(rows) != len(columns):
        raise ValueError(f"{name} must be as many rows as columns; given {len(rows)} and {len(columns)}")
    made = rows.astype(np.int64), columns.astype(np.int64)
    for of, each, size in zip(("rows", "columns"), made, shape, strict=True):
        outside = np.flatnonzero((each < 0) | (each >= size))
        if outside.size:
            raise ValueError(
                f"{of} of {name} must be from 0 to {size - 1}, as the matrix has shape {shape}; given "
                f"{each[outside[0]]} at place {outside[0]}"
            )
    if symmetric:
        _check_both_triangles(name, *made)
    return made


def _check_both_triangles(name: str, rows: Integers, columns: Integers) -> None:
    there = set(zip(rows.tolist(), columns.tolist(), strict=True))
    alone = sorted((i, j) for i, j in there if (j, i) not in there)
    if alone:
        i, j = alone[0]
        raise ValueError(f"{name} must name both triangles of M: ({i}, {j}) is there, and ({j}, {i}) is not")


def dense_callback(kind: str, values: Dispatcher, entries: Entries) -> Dispatcher:
    """The dense callback "mass" or "jacobian" beside one that gives values at these entries."""
    rows, columns = entries
    n = len(rows)

    def dense(t, q, p, out):  # type: ignore[no-untyped-def]
        found = np.zeros(n)
        values(t, q, p, found)
        for k in range(n):
            out[rows[k], columns[k]] += found[k]

    return compile_callback(kind, dense, watch(dense))


@dataclass(frozen=True, eq=False)
class DenseFunction:
    """The dense matrix of a plain Python function that returns values; called in the same way."""

    values: Callable[..., Any]
    entries: Entries
    shape: tuple[int, int]

    def __call__(self, t: float, q: Any, *p: Any) -> Any:
        """The matrix; of symbols, if the function returns such."""
        values = np.asarray(self.values(t, q, *p))
        if values.shape != self.entries[0].shape:
            return values  # whose shape is refused where it is stored
        made = np.zeros(self.shape, dtype=values.dtype if values.dtype == object else np.float64)
        for i, j, value in zip(*(each.tolist() for each in self.entries), values, strict=True):
            made[i, j] = made[i, j] + value
        return made

"""The order of IDA's unknowns in which its matrix is banded, for systems with a declared bandwidth (beams)."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from references.sundials.residual import Implicit
from twoloop.problem.problem import Array

SHIFT = 1e-3  # of a state beside the start, where no entry is zero by chance


class Band(NamedTuple):
    """The order of the unknowns, and how many diagonals the matrix then has below and above the main one."""

    order: NDArray[np.int64]
    lower: int
    upper: int


def band_of(form: Implicit) -> Band:
    """Return positions and velocities by coordinate, each multiplier ahead of the first coordinate of its row."""
    entries = _entries(form)
    n, m = form.sizes
    rows_of = entries[n : 2 * n, 2 * n : 2 * n + m]  # C_q^T Lam in the rows of the forces
    first = [min(np.flatnonzero(column), default=n) for column in rows_of.T]
    place = np.concatenate([first, first, np.arange(n), np.arange(n)])
    order = np.roll(np.arange(place.size), 2 * m)[np.argsort(place, kind="stable")]
    row, column = np.nonzero(entries[np.ix_(order, order)])
    return Band(order, int((row - column).max()), int((column - row).max()))


def _entries(form: Implicit) -> Array:
    """Return where dF/dy + cj dF/dy' has entries, beside the start."""
    y, yp = form.start + SHIFT * np.random.default_rng(0).uniform(0.5, 1.0, form.start.shape)
    J = np.zeros((y.size, y.size))
    p, *space = (each.copy() for each in form.space)
    form.matrix(0.0, 1.0, y, yp, p, *space, J)
    return np.asarray(J.T != 0.0)

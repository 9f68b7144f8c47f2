"""What numbers decide at a position before equations are written down: which rows of C_q and A count, and how M helps.

The choice depends on the position alone, so that the same call gets the same code whatever ran before it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from twoloop.checks.consistency import mass_and_rows
from twoloop.checks.rank import eigenvalues, orthogonalised
from twoloop.generate.tracing import Untraceable
from twoloop.kernels.compile.linking import direct
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

SINGULAR_MASS = 1e-10  # smallest over largest eigenvalue, below which rows of G are added to M
RANK = 1e-9  # of a row of G, of which no more is left without its part in the rows before: it depends on them
NEAR = 0.01  # of the smallest pivot that a row of G may have at the start: where the constraints are near losing rank
LEAST = 10.0 ** np.arange(-2, -9, -1)  # from what pivots may be at most down to what is not nearly lost to rounding
BOUNDS = LEAST[:-1] / NEAR


@dataclass(frozen=True)
class Choice:
    """What is decided by numbers at a position.

    Attributes
    ----------
    rows : tuple of int
        Rows of G of full rank.
    added, scale : tuple of int, float
        Rows of G that make M definite when added, and by what factor: a power of two that brings them to its size.
    least : float
        What the pivot of a row must be, of what it is without the others, a power of ten.
    """

    rows: tuple[int, ...]
    added: tuple[int, ...]
    scale: float
    least: float

    @classmethod
    def at(cls, system: ConstrainedSystem, t: float, q: Array) -> "Choice":
        """The choice at a position.

        Raises
        ------
        Untraceable
            If M is singular on velocities that the constraints allow.
        """
        mass, G = mass_and_rows(system, t, q)
        rows = orthogonalised(G, RANK)[2]
        if not rows:
            return cls((), (), 1.0, 0.0)
        place = None if system.constant_mass else (t, q.tobytes())
        added: tuple[int, ...] = ()
        scale = 1.0
        if not system.remembered_at("no weak mass", place, lambda: not _weak(eigenvalues(mass)).any()):
            scale = float(2.0 ** np.round(np.log2(np.abs(mass).max() / np.abs(G).max() ** 2)))
            added = _rows_for_mass(mass, G, scale, system.name)
            mass = mass + scale * G[list(added)].T @ G[list(added)]
        if len(rows) < len(G):
            G = G[rows]
        return cls(tuple(rows), added, scale, _least_pivot(mass, G, system.name))


def _least_pivot(mass: Array, G: Array, name: str) -> float:
    """The largest power of ten that is not above NEAR of any pivot that a row may have, from those of LEAST."""
    from twoloop.kernels.algebra.pivots import first_bound_kept

    n_rows, n = G.shape
    room = np.empty((n, n)), np.empty((n, n_rows)), np.empty((2 * n_rows, n_rows)), np.empty(n_rows)
    place = direct(first_bound_kept)(mass, G, BOUNDS, *room)
    if place < 0:
        raise Untraceable(f"the mass of {name!r} is too nearly singular")
    return float(LEAST[place])


def _weak(values: NDArray[Any]) -> NDArray[Any]:
    """Which of the eigenvalues of M, in order, are none."""
    return values < SINGULAR_MASS * values[-1]


def _rows_for_mass(mass: Array, G: Array, scale: float, name: str) -> tuple[int, ...]:
    """Rows of G with which M is definite, those of few entries first."""
    added: list[int] = []
    while True:
        values, vectors, _ = lapack.dsyevd(mass)
        weak = _weak(values)
        if not weak.any():
            return tuple(added)
        helped = G @ vectors[:, weak]
        helps = (helped * helped).sum(axis=1) > SINGULAR_MASS * (G * G).sum(axis=1)
        free = [k for k in np.argsort(np.count_nonzero(G, axis=1), kind="stable") if helps[k] and k not in added]
        if not free:
            raise Untraceable(f"the mass of {name!r} stays singular with constraints added")
        added.append(int(free[0]))
        mass = mass + scale * np.outer(G[free[0]], G[free[0]])

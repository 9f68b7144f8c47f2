"""Choices of an elimination, made by numbers at a position.

These are: independent rows of C_q and A, rows to be added to a singular M, and the coordinates that the rows determine.
The choice depends on the position alone, so that the same call gets the same code whatever ran before.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.structure import mass_and_rows
from twoloop.generate.graph import Untraceable
from twoloop.generate.trace import Equations
from twoloop.generate.trace_cache import shared_cache
from twoloop.kernels.compile.linking import entry_point
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

SINGULAR_MASS = 1e-10  # smallest over largest eigenvalue of M; below, rows of G are added to M
RANK = 1e-9  # relative norm of a row of G after elimination of the rows before; below, the row depends on them
NEAR = 0.01  # smallest allowed pivot, relative to the smallest pivot of a row of G at the start
# possible values of the smallest allowed pivot, down to those nearly lost to rounding
LEAST = 10.0 ** np.arange(-2, -9, -1)
BOUNDS = LEAST[:-1] / NEAR
# places among the bounds of the smallest pivot from which on rows are added to M: for up to SMALL coordinates; if M is
# singular, as Euler parameters lose two digits in sound models; for more coordinates, as the code becomes much longer
POOR, POOR_SINGULAR, POOREST, SMALL = 4, 5, 6, 24
# size of the added rows relative to M, and the number of places by which the pivot has to become larger: else the rows
# are nearly dependent whatever M is
STIFFER, FEWER = 16.0, 2
# ratio of rows of G to coordinates above which it pays to express some coordinates by the others: below, the system of
# the rows is the smaller one
MOSTLY_ROWS = 2.0 / 3.0

Blocks = tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]


@dataclass(frozen=True)
class Choice:
    """Decisions that depend on numbers at a position.

    Attributes
    ----------
    rows : tuple of int
        Independent rows of G.
    added, scale : tuple of int, float
        Rows of G that make M definite when added to it, and their factor: a power of two that scales them to its size.
    least : float
        Smallest allowed pivot of a row, over its pivot without the other rows; a power of ten.
    blocks : tuple of (rows, columns)
        One or two of `rows`, by their indices in it, and as many coordinates that they determine, in the order of
        elimination; empty if it does not pay, or if no coordinates are suitable.
    """

    rows: tuple[int, ...]
    added: tuple[int, ...]
    scale: float
    least: float
    blocks: Blocks = ()

    @classmethod
    def at(cls, system: ConstrainedSystem, t: float, q: Array) -> "Choice":
        """Return the choice at a position.

        Raises
        ------
        Untraceable
            If M is singular on velocities that the constraints allow.
        """
        mass, G = mass_and_rows(system, t, q)
        choice = Chooser(system).choice(mass, G)
        return replace(choice, blocks=Dependents(system, choice.rows).blocks(G))


class Dependents:
    """Search for the coordinates that rows of G determine, at one position after another.

    Parameters
    ----------
    system : ConstrainedSystem
    rows : tuple of int

    Attributes
    ----------
    find : callable or None
        Function of G and `arguments` that returns the number of blocks, see kernels/linalg/dependent_columns.py. None:
        there are none at any position.
    """

    find: Any = None

    def __init__(self, system: ConstrainedSystem, rows: tuple[int, ...]):
        kinds = _kinds(system) if len(rows) >= MOSTLY_ROWS * system.n_q > 0 else None
        if kinds is not None:
            from twoloop.kernels.linalg.dependent_columns import choose_dependent_columns, room_size

            numbers, integers = room_size(len(rows), system.n_q)
            blocks, room, work = np.zeros(4 * len(rows), np.int64), np.zeros(numbers), np.zeros(integers, np.int64)
            self.find, self._blocks = entry_point(choose_dependent_columns), blocks
            self.arguments = kinds, np.array(rows, np.int64), len(rows), room, work, blocks

    def blocks(self, G: Array) -> Blocks:
        """Return the blocks of the choice for a G."""
        if self.find is None:
            return ()
        n = self.find(G, *self.arguments)
        pivots = self._blocks[: 4 * n].reshape(n, 4).tolist()
        return tuple(((i,), (j,)) if i == k else ((i, k), (j, l)) for i, k, j, l in pivots)


def _kinds(system: ConstrainedSystem) -> Any:
    """Return the kind of each entry of G: 0 for zero, 1 for a constant, 2 if it varies; None if unknown."""
    if system.called_in_python:  # a function may keep its arguments, so it is traced as late as possible
        return None

    def make(equations: Callable[[], Equations]) -> Any:
        try:
            rows = [*equations().of("jacobian").flat, *equations().of("nonholonomic").flat]
        except (Untraceable, ArithmeticError, RecursionError):
            return None
        return np.array([2 if form.terms else int(form.constant != 0.0) for form in rows], dtype=np.int64)

    cache = shared_cache(system)
    kinds = cache.remembered("kinds of entries", partial(make, partial(cache.equations, system)))
    if kinds is None:  # it may be traceable with the numbers of this system
        kinds = system.remembered("kinds of entries", partial(make, partial(Equations, system)))
    return kinds


class Chooser:
    """Search for the choice at one M and G of a system after another; it is mostly the last one."""

    def __init__(self, system: ConstrainedSystem):
        from twoloop.kernels.linalg.rank import choose_rows, room_size

        n_rows = system.n_c + system.n_a
        self.system, self._choose = system, entry_point(choose_rows)
        self._room, self._chosen = np.zeros(room_size(n_rows, system.n_q)), np.zeros(2 + 3 * n_rows, dtype=np.int64)
        self._key, self._last = (0, b"", 0.0), Choice((), (), 1.0, 0.0)

    def choice(self, mass: Array, G: Array) -> Choice:
        """Return the choice for an M and a G; raise like `Choice.at`."""
        system, room, chosen = self.system, self._room, self._chosen
        constant = system.constant_mass and system.derived.get("no weak mass", False)
        room[0] = 0.0
        place = self._choose(mass, G, RANK, 0.0 if constant else SINGULAR_MASS, BOUNDS, room, chosen)
        decided = place, chosen.tobytes(), float(room[0])
        if decided != self._key:
            self._last, self._key = self._decode(place), decided
        singular = bool(self._last.added)
        if place >= ((POOR_SINGULAR if singular else POOR) if len(mass) <= SMALL else POOREST + singular):
            return self._stiffened(mass, G, place)
        return self._last

    def _stiffened(self, mass: Array, G: Array, place: int) -> Choice:
        """Return the choice with all independent rows added to M, if that makes much larger pivots, else the last one.

        Where bodies have little inertia about their joints, as a rod with its mass in its middle, the rows are nearly
        dependent in the metric of M, and accelerations lose up to twice the digits of the smallest pivot. They are not
        in that of M + s G^T G. M and s G^T G may differ by a few powers of ten: that many digits are lost instead.
        """
        last = self._last
        rows = G[list(last.rows)]
        scale = 2.0 ** np.round(np.log2(STIFFER * np.abs(mass).max() / np.abs(rows).max() ** 2))
        room, chosen = np.zeros_like(self._room), np.zeros_like(self._chosen)
        new = self._choose(mass + scale * rows.T @ rows, G, RANK, 0.0, BOUNDS, room, chosen)
        if not 0 <= new <= place - FEWER or chosen[2 : 2 + chosen[0]].tolist() != list(last.rows):
            return last
        return replace(last, added=last.rows, scale=float(scale), least=float(LEAST[new]))

    def _decode(self, place: int) -> Choice:
        from twoloop.kernels.linalg.rank import STAYS_SINGULAR

        system, n_rows = self.system, self.system.n_c + self.system.n_a
        n_kept, n_added, *places = self._chosen.tolist()
        if n_kept == 0:
            return Choice((), (), 1.0, 0.0)
        if place < 0:
            stays = "stays singular with constraints added" if place == STAYS_SINGULAR else "is too nearly singular"
            raise Untraceable(f"the mass of {system.name!r} {stays}")
        if n_added == 0:
            system.derived["no weak mass"] = True
        added = tuple(places[n_rows : n_rows + n_added])
        return Choice(tuple(places[:n_kept]), added, float(self._room[0]), float(LEAST[place]))

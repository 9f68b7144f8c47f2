"""Planar assemblies of n bodies with pins, of any size: open and closed chains, ladders, trees, stars."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

BEND = 0.4  # rad: how far bars lean, so that no two are in line
LEVEL = 2.4  # rad: of the bars across a ladder, none of whose others come near this direction


class Assembly(NamedTuple):
    """A system, its position, and the bodies that it is made of."""

    system: ConstrainedSystem
    q: Array
    bodies: PlanarBodies


class Bars:
    """Uniform bars with pins at given places, each 1 / n m long and 1 / n kg heavy.

    Parameters
    ----------
    angles : array_like (n,)
        rad.
    """

    def __init__(self, angles: Array):
        self.angles, n = np.asarray(angles), len(angles)
        self.half = 0.5 / n
        self.bodies = PlanarBodies(
            [f"bar {k}" for k in range(n)], np.full(n, 1.0 / n), np.full(n, self.half**2 / n / 3.0)
        )
        self.centres = np.zeros((n, 2))

    def end(self, k: int, side: float) -> Array:
        """Where an end of bar k is; side is -1 or 1."""
        return self.centres[k] + side * self.half * np.array([np.cos(self.angles[k]), np.sin(self.angles[k])])

    def hang(self, k: int, at: Array, on: int, side: float) -> None:
        """Put the first end of bar k to a place, which is an end of bar `on`, or on the ground."""
        self.centres[k] = at - (self.end(k, -1.0) - self.centres[k])
        self.bodies.pin(k, (-self.half, 0.0), on, tuple(at) if on == GROUND else (side * self.half, 0.0))

    def assembly(self, name: str) -> Assembly:
        """The system, and its position."""
        q = np.column_stack([self.centres, self.angles]).ravel()
        return Assembly(self.bodies.system(name), q, self.bodies)


def _leaning(n: int) -> Array:
    return np.linspace(0.0, 1.2, n) + BEND * np.sin(1.7 * np.arange(n))


def open_chain(n: int) -> Assembly:
    """A chain that hangs on a pin."""
    bars = Bars(_leaning(n))
    for k in range(n):
        bars.hang(k, bars.end(k - 1, 1.0) if k else np.zeros(2), k - 1 if k else GROUND, 1.0)
    return bars.assembly(f"open chain of {n}")


def closed_chain(n: int) -> Assembly:
    """The same with a pin at its other end."""
    bars = Bars(_leaning(n))
    for k in range(n):
        bars.hang(k, bars.end(k - 1, 1.0) if k else np.zeros(2), k - 1 if k else GROUND, 1.0)
    bars.bodies.pin(n - 1, (bars.half, 0.0), GROUND, tuple(bars.end(n - 1, 1.0)))
    return bars.assembly(f"closed chain of {n}")


def ladder(n: int) -> Assembly:
    """Two chains of n // 3 bars, with a bar from joint to joint after each: as many loops, of parallelograms."""
    m = n // 3
    rails = np.repeat(_leaning(m), 2)
    bars = Bars(np.concatenate([rails, np.full(m, LEVEL)]))
    length = 2.0 * bars.half
    across = length * np.array([np.cos(LEVEL), np.sin(LEVEL)])
    for k in range(m):
        for side, start in ((0, np.zeros(2)), (1, across)):
            here = 2 * k + side
            bars.hang(here, bars.end(here - 2, 1.0) if k else start, here - 2 if k else GROUND, 1.0)
        rung = 2 * m + k
        bars.hang(rung, bars.end(2 * k, 1.0), 2 * k, 1.0)
        bars.bodies.pin(rung, (bars.half, 0.0), 2 * k + 1, (bars.half, 0.0))
    return bars.assembly(f"ladder of {3 * m}")


def tree(n: int) -> Assembly:
    """A binary tree."""
    bars = Bars(_leaning(n))
    for k in range(n):
        bars.hang(k, bars.end((k - 1) // 2, 1.0) if k else np.zeros(2), (k - 1) // 2 if k else GROUND, 1.0)
    return bars.assembly(f"tree of {n}")


def star(n: int) -> Assembly:
    """All bars on the end of one."""
    bars = Bars(_leaning(n))
    for k in range(n):
        bars.hang(k, bars.end(0, 1.0) if k else np.zeros(2), 0 if k else GROUND, 1.0)
    return bars.assembly(f"star of {n}")


ASSEMBLIES: tuple[Callable[[int], Assembly], ...] = (open_chain, closed_chain, ladder, tree, star)

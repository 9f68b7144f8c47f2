"""Build assemblies of any n bodies: chains, ladders, trees, stars and grids with pins; chains and trees of hinges."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from twoloop.bodies import SpatialModel
from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

BEND = 0.4  # rad: how far bars lean, so that no two are in line
TILT = 0.3  # of the axes of hinges, over the part of them across the plane
LEVEL = 2.4  # rad: of the bars across a ladder, none of whose others come near this direction


class Assembly(NamedTuple):
    """A system, its position, and the bodies that it is made of."""

    system: ConstrainedSystem
    q: Array
    bodies: Any  # PlanarBodies, or the problem of a model in space


class Bars:
    """Uniform bars with pins at given places, each 1 / n m long and 1 / n kg heavy. `angles`: rad."""

    def __init__(self, angles: Array):
        self.angles, n = np.asarray(angles), len(angles)
        self.half = 0.5 / n
        self.bodies = PlanarBodies(
            [f"bar {k}" for k in range(n)], np.full(n, 1.0 / n), np.full(n, self.half**2 / n / 3.0)
        )
        self.centres = np.zeros((n, 2))

    def end(self, k: int, side: float) -> Array:
        """Return the place of an end of bar k; side is -1 or 1."""
        return self.centres[k] + side * self.half * np.array([np.cos(self.angles[k]), np.sin(self.angles[k])])

    def hang(self, k: int, at: Array, on: int) -> None:
        """Put the first end of bar k to a place, the second end of bar `on`, or on the ground."""
        self.centres[k] = at - (self.end(k, -1.0) - self.centres[k])
        self.bodies.pin(k, (-self.half, 0.0), on, tuple(at) if on == GROUND else (self.half, 0.0))

    def assembly(self, name: str) -> Assembly:
        """Return the system and its position."""
        q = np.column_stack([self.centres, self.angles]).ravel()
        return Assembly(self.bodies.system(name), q, self.bodies)


def _leaning(n: int) -> Array:
    return np.linspace(0.0, 1.2, n) + BEND * np.sin(1.7 * np.arange(n))


def _hung(n: int, on: Callable[[int], int]) -> Bars:
    """Build bars of which the first hangs on a pin, and bar k on the end of bar on(k)."""
    bars = Bars(_leaning(n))
    for k in range(n):
        bars.hang(k, bars.end(on(k), 1.0) if k else np.zeros(2), on(k) if k else GROUND)
    return bars


def open_chain(n: int) -> Assembly:
    """Build a chain that hangs on a pin."""
    return _hung(n, lambda k: k - 1).assembly(f"open chain of {n}")


def closed_chain(n: int) -> Assembly:
    """Build the open chain with a pin at its other end."""
    bars = _hung(n, lambda k: k - 1)
    bars.bodies.pin(n - 1, (bars.half, 0.0), GROUND, tuple(bars.end(n - 1, 1.0)))
    return bars.assembly(f"closed chain of {n}")


def ladder(n: int) -> Assembly:
    """Build two chains of n // 3 bars, with a bar from joint to joint after each: as many loops, of parallelograms."""
    m = n // 3
    bars = Bars(np.concatenate([np.repeat(_leaning(m), 2), np.full(m, LEVEL)]))
    across = 2.0 * bars.half * np.array([np.cos(LEVEL), np.sin(LEVEL)])
    for k in range(m):
        for side, start in ((0, np.zeros(2)), (1, across)):
            here = 2 * k + side
            bars.hang(here, bars.end(here - 2, 1.0) if k else start, here - 2 if k else GROUND)
        rung = 2 * m + k
        bars.hang(rung, bars.end(2 * k, 1.0), 2 * k)
        bars.bodies.pin(rung, (bars.half, 0.0), 2 * k + 1, (bars.half, 0.0))
    return bars.assembly(f"ladder of {3 * m}")


def tree(n: int) -> Assembly:
    """Build a binary tree."""
    return _hung(n, lambda k: (k - 1) // 2).assembly(f"tree of {n}")


def star(n: int) -> Assembly:
    """Build bars that all hang on the end of one."""
    return _hung(n, lambda k: 0).assembly(f"star of {n}")


def grid(n: int) -> Assembly:
    """Build a net that hangs on a corner: beads with bars to the right and below; bars that are left are a chain."""
    side = max(k for k in range(1, n + 1) if 3 * k * k - 2 * k <= n)
    beads = side**2
    pairs = [(i, i + 1) for i in range(beads) if (i + 1) % side]
    n_across = len(pairs)
    pairs += [(i, i + side) for i in range(beads - side)]
    tail = range(beads + len(pairs), n)
    angles = np.full(n, BEND - 0.5 * np.pi)
    angles[:beads], angles[beads : beads + n_across], angles[tail.start :] = 0.0, BEND, _leaning(len(tail))
    bars = Bars(angles)
    right = 3.0 * bars.half * np.array([np.cos(BEND), np.sin(BEND)])
    below = np.array([right[1], -right[0]])
    for bead in range(beads):
        bars.centres[bead] = bead % side * right + bead // side * below
    bars.bodies.pin(0, (0.0, 0.0), GROUND, (0.0, 0.0))
    for bar, (one, other) in enumerate(pairs, start=beads):
        bars.centres[bar] = 0.5 * (bars.centres[one] + bars.centres[other])
        for sign, bead in ((-1.0, one), (1.0, other)):
            at = bars.end(bar, sign) - bars.centres[bead]
            bars.bodies.pin(bar, (sign * bars.half, 0.0), bead, (float(at[0]), float(at[1])))
    for k in tail:
        on = k - 1 if k > tail.start else beads - 1
        bars.hang(k, bars.end(on, 1.0), on)
    return bars.assembly(f"grid of {n}")


def in_space(made: Assembly, tilt: float) -> Assembly:
    """Turn a planar assembly into bodies in space, with hinges that lean to all sides by `tilt`."""
    planar = made.bodies
    model, places = SpatialModel((0.0, -planar.gravity, 0.0)), made.q.reshape(-1, 3)
    for k, (x, y, angle) in enumerate(places):
        c, s, J = np.cos(angle), np.sin(angle), planar.inertias[k]
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        model.body(
            f"bar {k}", mass=planar.masses[k], inertia=(0.6 * J, 0.6 * J, J), position=(x, y, 0.0), rotation=turned
        )
    for k, (i, (a, b), j, _) in enumerate(planar.pins):
        (x, y, angle), (c, s) = places[i], (np.cos(places[i, 2]), np.sin(places[i, 2]))
        axis = (tilt * np.cos(2.0 * k), tilt * np.sin(2.0 * k), 1.0)
        ends = model.bodies[i], model.ground if j == GROUND else model.bodies[j]
        model.revolute(*ends, at=(x + c * a - s * b, y + s * a + c * b, 0.0), axis=axis)
    problem = model.problem(name=f"{made.system.name}, in space")
    return Assembly(problem.system, problem.q0, problem)


def open_chain_of_hinges(n: int) -> Assembly:
    """Build the open chain with hinges whose axes differ."""
    return in_space(open_chain(n), TILT)


def closed_chain_of_hinges(n: int) -> Assembly:
    """Build the closed chain with parallel hinges, three rows of which are redundant."""
    return in_space(closed_chain(n), 0.0)


def tree_of_hinges(n: int) -> Assembly:
    """Build the tree with hinges whose axes differ."""
    return in_space(tree(n), TILT)


PLANAR: tuple[Callable[[int], Assembly], ...] = (open_chain, closed_chain, ladder, tree, star, grid)
SPATIAL = (open_chain_of_hinges, closed_chain_of_hinges, tree_of_hinges)

"""Random assemblies with loops and redundant rows, and their accelerations by NumPy's dense algebra alone."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import lstsq

from twoloop.bodies import SpatialModel
from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.problem.problem import Array
from twoloop.problem.system import ConstrainedSystem

FEWEST, MOST = 5, 300  # bodies
NEARLY = 1e-5  # smallest singular value that counts, below which errors may grow by as much


def _least(A: Array, b: Array) -> Array:
    """The least-norm solution of least squares, by orthogonal factors: a fifth of the time of singular values."""
    return np.asarray(lstsq(A, b, cond=1e-10, lapack_driver="gelsy")[0])


class RandomAssembly:
    """A tree of joints, joints that close loops, and joints between pairs of bodies that have one already."""

    q: Array
    places: Array
    rng: np.random.Generator
    pairs: list[tuple[int, int]]

    def connect(self, n: int, loops: int, doubles: int) -> list[tuple[int, int]]:
        """Make all joints; the pairs of bodies of those of the tree."""
        for k in range(n):
            self.join(k, int(self.rng.integers(max(0, k - 6), k)) if k else GROUND)
        tree = list(self.pairs)
        for _ in range(loops):
            i, j = int(self.rng.integers(n)), int(self.rng.integers(-1, n))
            self.close(i, GROUND if i == j else j)
        for _ in range(doubles):
            self.close(*self.pairs[int(self.rng.integers(len(self.pairs)))])
        return tree

    def join(self, i: int, j: int) -> None:
        """Connect two bodies."""
        raise NotImplementedError

    def close(self, i: int, j: int) -> None:
        """Connect two bodies that hang together already."""
        self.join(i, j)

    def system(self, name: str) -> ConstrainedSystem:
        """Its equations."""
        raise NotImplementedError

    def v(self, system: ConstrainedSystem) -> Array:
        """Random velocities that the constraints allow."""
        G, v = system.jacobian(0.0, self.q), self.rng.normal(size=system.n_q)
        return v - _least(G, G @ v)


class PlanarAssembly(RandomAssembly):
    """Bodies at random places in a plane, with pins.

    What two pins on one pair of bodies hold, and a pin that is there twice, makes redundant rows.
    """

    def __init__(self, seed: int, n: int, loops: int = 0, doubles: int = 0, heaviest: float = 2.0):
        rng = self.rng = np.random.default_rng(seed)
        self.places = np.column_stack([rng.normal(size=(n, 2)) * np.sqrt(n), rng.uniform(-3.0, 3.0, n)])
        masses = heaviest ** rng.uniform(-0.5, 0.5, n)
        self.bodies = PlanarBodies([f"body {k}" for k in range(n)], masses, masses * rng.uniform(0.2, 1.0, n))
        self.pairs, self.q = [], self.places.ravel()
        self.connect(n, loops, doubles)

    def join(self, i: int, j: int) -> None:
        """Pin two bodies at a random place near the first."""
        at = self.places[i, :2] + self.rng.normal(size=2)
        self.pairs.append((i, j))
        self.bodies.pin(i, self.on(i, at), j, tuple(at) if j == GROUND else self.on(j, at))

    def on(self, k: int, at: Array) -> tuple[float, float]:
        """A place in the axes of a body."""
        (x, y), angle = at - self.places[k, :2], self.places[k, 2]
        c, s = np.cos(angle), np.sin(angle)
        return float(c * x + s * y), float(c * y - s * x)

    def system(self, name: str) -> ConstrainedSystem:
        """Its equations."""
        return self.bodies.system(name)


class SpatialAssembly(RandomAssembly):
    """Bodies at random places in space: hinges, balls, crosses and slides, and balls that close loops.

    Two balls on one pair of bodies make one redundant row, three make three. `springs`: stiffness and damping of one
    along each joint of the tree.
    """

    def __init__(self, seed: int, n: int, loops: int = 0, doubles: int = 0, springs: tuple[float, ...] = ()):
        rng = self.rng = np.random.default_rng(seed)
        self.places, self.pairs, self.model = rng.normal(size=(n, 3)) * np.cbrt(n), [], SpatialModel()
        for k, place in enumerate(self.places):
            R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            mass = 2.0 ** rng.uniform(-0.5, 0.5)
            moments = tuple(mass * rng.uniform(0.15, 0.27, 3))
            self.model.body(f"body {k}", mass=mass, inertia=moments, position=place, rotation=R * np.linalg.det(R))
        tree = self.connect(n, loops, doubles)
        for i, j in tree if springs else ():
            one, other = self.near(i), rng.normal(size=3) if j == GROUND else self.near(j)
            given: dict[str, Any] = dict(zip(("stiffness", "damping"), springs, strict=True))
            given["length"] = 1.1 * float(np.linalg.norm(one - other))
            self.model.spring(self.body(i), one, self.body(j), other, **given)
        self.q = self.model.problem().q0

    def body(self, k: int) -> Any:
        """A body of the model, or its ground."""
        return self.model.ground if k == GROUND else self.model.bodies[k]

    def near(self, k: int) -> Array:
        """A random place near a body."""
        return self.places[k] + self.rng.normal(size=3)

    def join(self, i: int, j: int) -> None:
        """Connect two bodies, either of which may be named first, by some joint near the first."""
        self.pairs.append((i, j))
        at, a, b = self.near(i), *np.linalg.qr(self.rng.normal(size=(3, 2)))[0].T
        first, second = (i, j) if self.rng.integers(2) else (j, i)
        kind = self.rng.choice(["spherical", "revolute", "universal", "prismatic"])
        axes: Any = {"spherical": {}, "universal": {"axes": (a, b)}}.get(kind, {"axis": a})
        getattr(self.model, kind)(self.body(first), self.body(second), at=at, **axes)

    def close(self, i: int, j: int) -> None:
        """A ball that closes a loop, or is one more on two bodies."""
        self.pairs.append((i, j))
        self.model.spherical(self.body(i), self.body(j), at=self.near(i))

    def system(self, name: str) -> ConstrainedSystem:
        """Its equations."""
        return self.model.problem(name=name).system


class DenseSolution(NamedTuple):
    """Accelerations, multipliers of least norm, rank, and the smallest singular value that counts over the largest."""

    a: Array
    lam: Array
    rank: int
    nearest: float

    def error(self, a: Array, lam: Array) -> float:
        """Largest error over the largest value, of a or lam, less what nearly dependent rows take from both."""
        errors = [np.abs(given - own).max() / np.abs(own).max() for given, own in ((a, self.a), (lam, self.lam))]
        return float(max(errors) / max(1.0, NEARLY / self.nearest))


def dense_solution(system: ConstrainedSystem, q: Array, v: Array) -> DenseSolution:
    """The accelerations of a system by NumPy alone.

    By singular values of G L^-T, rows scaled to 1, where M = L L^T; with four Euler parameters M + G^T G does for M.
    """
    G, M = system.jacobian(0.0, q), system.mass(0.0, q)
    singular = np.linalg.eigvalsh(M)[0] < 1e-10
    root = np.linalg.cholesky(M + G.T @ G if singular else M)
    force, gamma = system.force(0.0, q, v), system.gamma(0.0, q, v)
    heavy = force + G.T @ gamma if singular else force
    rows = np.linalg.solve(root, G.T).T
    lengths = np.linalg.norm(rows, axis=1)
    left, values, right = np.linalg.svd(rows / lengths[:, None], full_matrices=False)
    rank = int((values > 1e-9 * values[0]).sum())
    inverse = (right[:rank].T / values[:rank]) @ left[:, :rank].T
    free = np.linalg.solve(root, heavy)
    a = np.linalg.solve(root.T, free + inverse @ ((gamma - rows @ free) / lengths))
    return DenseSolution(a, _least(G.T, force - M @ a), rank, float(values[rank - 1] / values[0]))


def drawn(kind: Callable[..., RandomAssembly], seed: int, most: int = MOST) -> RandomAssembly:
    """An assembly of FEWEST to `most` bodies, every second a tree; half of them have joints that are there twice."""
    rng = np.random.default_rng(seed)
    n = round(FEWEST * (most / FEWEST) ** rng.random())  # in a decade as many as in any other
    loops = 0 if seed % 2 else int(rng.integers(1, 2 + n // 5))
    return kind(seed, n, loops, int(rng.choice([0, 0, 1, 3])))

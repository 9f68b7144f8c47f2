"""Random assemblies with loops and redundant rows, and their accelerations by NumPy's dense algebra alone."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import lstsq

from twoloop.bodies import SpatialModel
from twoloop.mechanisms.planar import GROUND, PlanarBodies

FEWEST = 5  # bodies
NEARLY = 1e-5  # smallest singular value that counts, below which errors may grow by as much


def least(A, b):
    """The least-norm solution of least squares, by orthogonal factors: a fifth of the time of singular values."""
    return lstsq(A, b, cond=1e-10, lapack_driver="gelsy")[0]


class RandomAssembly:
    """A tree of joints, joints that close loops, and joints between pairs of bodies that have one already."""

    def connect(self, n, loops, doubles):
        self.pairs = []
        for k in range(n):
            self.join(k, int(self.rng.integers(max(0, k - 6), k)) if k else GROUND)
        for _ in range(loops):
            i, j = int(self.rng.integers(n)), int(self.rng.integers(-1, n))
            self.close(i, GROUND if i == j else j)
        for _ in range(doubles):
            self.close(*self.pairs[int(self.rng.integers(len(self.pairs)))])

    def v(self, system):
        """Random velocities that the constraints allow."""
        G, v = system.jacobian(0.0, self.q), self.rng.normal(size=system.n_q)
        return v - least(G, G @ v)


class PlanarAssembly(RandomAssembly):
    """Bodies at random places in a plane, with pins; two pins on one pair of bodies make redundant rows."""

    def __init__(self, seed, n, loops=0, doubles=0):
        rng = self.rng = np.random.default_rng(seed)
        self.places = np.column_stack([rng.normal(size=(n, 2)) * np.sqrt(n), rng.uniform(-3.0, 3.0, n)])
        masses = 2.0 ** rng.uniform(-0.5, 0.5, n)
        self.bodies = PlanarBodies([f"body {k}" for k in range(n)], masses, masses * rng.uniform(0.2, 1.0, n))
        self.q, self.system = self.places.ravel(), self.bodies.system
        self.connect(n, loops, doubles)

    def join(self, i, j):
        """Pin two bodies at a random place near the first."""
        at = self.places[i, :2] + self.rng.normal(size=2)
        self.pairs.append((i, j))
        self.bodies.pin(i, self.on(i, at), j, tuple(at) if j == GROUND else self.on(j, at))

    close = join

    def on(self, k, at):
        """A place in the axes of a body."""
        (x, y), angle = at - self.places[k, :2], self.places[k, 2]
        c, s = np.cos(angle), np.sin(angle)
        return float(c * x + s * y), float(c * y - s * x)


class SpatialAssembly(RandomAssembly):
    """Bodies at random places in space: hinges, balls, crosses and slides, and balls that close loops.

    Two balls on one pair of bodies make one redundant row, three make three.
    """

    def __init__(self, seed, n, loops=0, doubles=0):
        rng = self.rng = np.random.default_rng(seed)
        self.places, self.model = rng.normal(size=(n, 3)) * np.cbrt(n), SpatialModel()
        for k, place in enumerate(self.places):
            R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            mass = 2.0 ** rng.uniform(-0.5, 0.5)
            moments = tuple(mass * rng.uniform(0.15, 0.27, 3))
            self.model.body(f"body {k}", mass=mass, inertia=moments, position=place, rotation=R * np.linalg.det(R))
        self.connect(n, loops, doubles)
        self.q = self.model.problem().q0

    def body(self, k):
        return self.model.ground if k == GROUND else self.model.bodies[k]

    def near(self, k):
        """A random place near a body."""
        return self.places[k] + self.rng.normal(size=3)

    def join(self, i, j):
        """Connect two bodies, either of which may be named first, by some joint near the first."""
        self.pairs.append((i, j))
        at, a, b = self.near(i), *np.linalg.qr(self.rng.normal(size=(3, 2)))[0].T
        first, second = (i, j) if self.rng.integers(2) else (j, i)
        kind = self.rng.choice(["spherical", "revolute", "universal", "prismatic"])
        axes = {"spherical": {}, "universal": {"axes": (a, b)}}.get(kind, {"axis": a})
        getattr(self.model, kind)(self.body(first), self.body(second), at=at, **axes)

    def close(self, i, j):
        """A ball that closes a loop, or is one more on two bodies."""
        self.pairs.append((i, j))
        self.model.spherical(self.body(i), self.body(j), at=self.near(i))

    def system(self, name):
        return self.model.problem(name=name).system


class DenseSolution(NamedTuple):
    """Accelerations, multipliers of least norm, rank, and the smallest singular value that counts over the largest."""

    a: np.ndarray
    lam: np.ndarray
    rank: int
    nearest: float

    def error(self, a, lam):
        """Largest error over the largest value, of a or lam, less what nearly dependent rows take from both."""
        errors = [np.abs(given - own).max() / np.abs(own).max() for given, own in ((a, self.a), (lam, self.lam))]
        return max(errors) / max(1.0, NEARLY / self.nearest)


def dense_solution(system, q, v):
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
    return DenseSolution(a, least(G.T, force - M @ a), rank, values[rank - 1] / values[0])


def drawn(kind, seed, most):
    """An assembly of FEWEST to `most` bodies, every second a tree; half of them have joints that are there twice."""
    rng = np.random.default_rng(seed)
    n = round(FEWEST * (most / FEWEST) ** rng.random())  # in a decade as many as in any other
    loops = 0 if seed % 2 else int(rng.integers(1, 2 + n // 5))
    return kind(seed, n, loops, int(rng.choice([0, 0, 1, 3])))

"""Random planar assemblies with loops and redundant rows, and their accelerations by NumPy's dense algebra alone."""

import numpy as np

from twoloop.mechanisms.planar import GROUND, PlanarBodies
from twoloop.methods.dop853 import DOP853
from twoloop.run.run import Run


class Assembly:
    """Bodies at random places, a tree of pins, pins that close loops, and pins that repeat others.

    What two pins on one pair of bodies hold, and a pin that is there twice, makes redundant rows.
    """

    def __init__(self, seed, n, loops=0, doubles=0, heaviest=2.0):
        rng = self.rng = np.random.default_rng(seed)
        self.places = np.column_stack([rng.normal(size=(n, 2)) * np.sqrt(n), rng.uniform(-3.0, 3.0, n)])
        masses = heaviest ** rng.uniform(-0.5, 0.5, n)
        self.bodies = PlanarBodies([f"body {k}" for k in range(n)], masses, masses * rng.uniform(0.2, 1.0, n))
        self.pairs = []
        for k in range(n):
            self.pin(k, int(rng.integers(max(0, k - 6), k)) if k else GROUND)
        for _ in range(loops):
            i, j = int(rng.integers(n)), int(rng.integers(-1, n))
            self.pin(i, GROUND if i == j else j)
        for _ in range(doubles):
            self.pin(*self.pairs[int(rng.integers(len(self.pairs)))])

    def pin(self, i, j):
        """Pin two bodies at a random place near the first."""
        at = self.places[i, :2] + self.rng.normal(size=2)
        self.pairs.append((i, j))
        self.bodies.pin(i, self.on(i, at), j, tuple(at) if j == GROUND else self.on(j, at))

    def on(self, k, at):
        """A place in the axes of a body."""
        (x, y), angle = at - self.places[k, :2], self.places[k, 2]
        c, s = np.cos(angle), np.sin(angle)
        return float(c * x + s * y), float(c * y - s * x)

    @property
    def q(self):
        return self.places.ravel()

    def v(self, system):
        """Random velocities that the constraints allow."""
        G, v = system.jacobian(0.0, self.q), self.rng.normal(size=system.n_q)
        return v - np.linalg.pinv(G, rcond=1e-10) @ (G @ v)


def dense_solution(system, q, v):
    """Accelerations, multipliers of least norm, rank, and the smallest singular value that counts over the largest.

    By singular values of G M^(-1/2), rows scaled to 1.
    """
    G, root = system.jacobian(0.0, q), np.sqrt(np.diag(system.mass(0.0, q)))
    force, gamma = system.force(0.0, q, v), system.gamma(0.0, q, v)
    lengths = np.linalg.norm(G / root, axis=1)
    left, values, right = np.linalg.svd(G / root / lengths[:, None], full_matrices=False)
    rank = int((values > 1e-9 * values[0]).sum())
    inverse = (right[:rank].T / values[:rank]) @ left[:, :rank].T
    free = force / root - inverse @ ((G @ (force / root**2)) / lengths)
    a = (free + inverse @ (gamma / lengths)) / root
    lam = np.linalg.lstsq(G.T, force - root**2 * a, rcond=1e-9)[0]
    return a, lam, rank, float(values[rank - 1] / values[0])


def started_run(system, q):
    """A run of an explicit method from rest, at its start."""
    n = system.n_q
    return Run(system, DOP853().plan(n, 1e-8, 1e-8, False), 0.0, q, 0.0 * q, 1e-8, np.full(n, 1e-8), None)

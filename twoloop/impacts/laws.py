"""The laws of stops without friction: of impacts, and of the forces that keep a gap closed."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear, nnls

from twoloop.checks.arguments import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.impulse import NEGLIGIBLE, scaled_equations

EVEN = 1e-6  # relative: by how much forces that share a load seek to be alike
WEIGHT = 1e3  # of that problem, so that its gradients are large beside the tolerance of the solver
MOST_STEPS = 1000  # of it


def responses(system: ConstrainedSystem, t: float, q: Array, W: Array) -> Array:
    """How impulses at stops change the velocities, (n_q, k): M X + G^T Y = W^T with G X = 0, all constraints held."""
    matrix, lengths, _ = scaled_equations(system, t, q)
    right = np.vstack([W.T, np.zeros((len(lengths), len(W)))])
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=NEGLIGIBLE)[0][: system.n_q], dtype=float)


def complementary(D: Array, b: Array) -> Array:
    """Numbers x >= 0 with D x + b >= 0, and x 0 where this is positive; D symmetric and positive semidefinite.

    They minimise x^T D x / 2 + b^T x: a problem of least squares, |B x - y| with B^T B = D and B^T y = -b.
    """
    if not len(b):
        return np.zeros(0)
    x = nnls(*_squares(D, b))[0]
    held = x > 0.0
    x[held] = np.linalg.lstsq(D[np.ix_(held, held)], -b[held], rcond=NEGLIGIBLE)[0]
    return np.maximum(x, 0.0)


def bounded(D: Array, c: Array, n: int, most: Array) -> Array:
    """Forces that minimise x^T D x / 2 + c^T x: what has room leaves no acceleration D x + c.

    The first n, of stops, are not negative, the others, of friction, are within `most`. Where they share a load in any
    proportion, they do so evenly: the sum of x^2 / most is added with a small weight.
    """
    tiny = np.finfo(np.float64).tiny
    B, y = _squares(D, c)
    size = np.sqrt(D.diagonal().max())
    # of forces: the problem is solved in numbers of about 1
    unit = max(float(np.linalg.norm(y)) / size, NEGLIGIBLE * float(most.max()), tiny)
    bound = np.maximum(most / unit, tiny)
    even = np.zeros((len(most), len(c)))
    even[:, n:] = np.diag(EVEN * np.sqrt(bound.min() / bound))
    matrix, right = np.vstack([B / size, even]), np.append(y / (size * unit), 0.0 * most)
    limits = np.append(np.zeros(n), -bound), np.append(np.full(n, np.inf), bound)
    return np.asarray(
        unit * lsq_linear(WEIGHT * matrix, WEIGHT * right, limits, "bvls", tol=1e-14, max_iter=MOST_STEPS).x
    )


def _squares(D: Array, b: Array) -> tuple[Array, Array]:
    """B and y of |B x - y|, with B^T B = D and B^T y = -b."""
    values, vectors = np.linalg.eigh(0.5 * (D + D.T))
    kept = values > NEGLIGIBLE * values.max(initial=0.0)
    roots = np.sqrt(values[kept])
    return roots[:, None] * vectors[:, kept].T, -(vectors[:, kept].T @ b) / roots


def impulses(D: Array, u: Array, restitution: Array) -> Array:
    """Impulses at k stops of rates u, by Moreau's law: those that open with less than e times the old speed have one.

    J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics, CISM 302 (1988): u+ + e u- >= 0, the
    impulse is not negative, and one of both is zero. The energy does not grow where all e are the same.
    """
    return complementary(D, (1.0 + restitution) * u)

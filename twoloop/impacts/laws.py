"""Frictionless contact laws: impulses, and forces that keep gaps closed."""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear, nnls

from twoloop.checks.arguments import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.impulse import NEGLIGIBLE, scaled_equations

EVEN = 1e-6  # relative weight of the regularisation that distributes a shared load evenly
WEIGHT = 1e3  # scales the problem so that its gradients exceed the tolerance of the solver
MOST_STEPS = 1000  # iterations of the solver


def responses(system: ConstrainedSystem, t: float, q: Array, W: Array) -> Array:
    """Return the velocity changes (n_q, k) by unit impulses: M X + G^T Y = W^T with G X = 0, for all constraints."""
    matrix, lengths, _ = scaled_equations(system, t, q)
    right = np.vstack([W.T, np.zeros((len(lengths), len(W)))])
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=NEGLIGIBLE)[0][: system.n_q], dtype=float)


def complementary(D: Array, b: Array) -> Array:
    """Solve the linear complementarity problem x >= 0, D x + b >= 0, x^T (D x + b) = 0; D symmetric semidefinite.

    x minimises x^T D x / 2 + b^T x: the non-negative least-squares problem |B x - y| with B^T B = D and B^T y = -b.
    """
    if not len(b):
        return np.zeros(0)
    x = nnls(*_squares(D, b))[0]
    held = x > 0.0
    x[held] = np.linalg.lstsq(D[np.ix_(held, held)], -b[held], rcond=NEGLIGIBLE)[0]
    return np.maximum(x, 0.0)


def bounded(D: Array, c: Array, n: int, most: Array) -> Array:
    """Return forces that minimise x^T D x / 2 + c^T x subject to bounds: D x + c vanishes where no bound is active.

    The first n, of stops, are non-negative; the others, of friction, are bounded by `most`. The sum of x^2 / most is
    added with a small weight, so that a load that could be shared in any proportion is shared evenly.
    """
    tiny = np.finfo(np.float64).tiny
    B, y = _squares(D, c)
    size = np.sqrt(D.diagonal().max())
    # scale of the forces, so that the unknowns are of order 1
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
    """Return B and y with B^T B = D and B^T y = -b."""
    values, vectors = np.linalg.eigh(0.5 * (D + D.T))
    kept = values > NEGLIGIBLE * values.max(initial=0.0)
    roots = np.sqrt(values[kept])
    return roots[:, None] * vectors[:, kept].T, -(vectors[:, kept].T @ b) / roots


def impulses(D: Array, u: Array, restitution: Array) -> Array:
    """Return the impulses at k stops with rates u by Moreau's law.

    J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics, CISM 302 (1988): u+ + e u- >= 0, the
    impulse is non-negative, and their product is zero. The energy does not increase if all e are equal.
    """
    return complementary(D, (1.0 + restitution) * u)

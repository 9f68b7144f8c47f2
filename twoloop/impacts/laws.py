"""Contact laws: impulses, and forces that keep gaps closed, with Coulomb friction or without."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, nnls

from twoloop.checks.arguments import Array
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.impulse import NEGLIGIBLE, scaled_equations

EVEN = 1e-6  # relative weight of the regularisation that distributes a shared load evenly
WEIGHT = 1e3  # scales the problem so that its gradients exceed the tolerance of the solver
MOST_STEPS = 1000  # iterations of the solver
MOST_LOADS = 200  # fixed-point iterations of the loads that bound the friction ...
AGREES = 1e-10  # ... until they change by less, relative to the largest
OUTSIDE = 1e-9  # relative: smallest part of rates and accelerations outside the range of D; smaller ones are rounding
FITS = 1e-6  # relative: largest rate or acceleration at which a stop may still close
SLIDES = 1e-9  # relative to the terms of an acceleration: smaller ones are none


class Undetermined(ValueError):
    """No admissible distribution of the load among sticking joints and stops was found."""


class Rubs(NamedTuple):
    """Tangents of stops that rub: the places of their normals, coefficients, and directions of sliding, 0 at rest."""

    normal: NDArray[np.int64]
    coefficient: Array
    sign: NDArray[np.int64]


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
    active = x > 0.0
    x[active] = np.linalg.lstsq(D[np.ix_(active, active)], -b[active], rcond=NEGLIGIBLE)[0]
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
    found = lsq_linear(WEIGHT * matrix, WEIGHT * right, limits, "bvls", tol=1e-14, max_iter=MOST_STEPS)
    x, free = found.x, found.active_mask == 0
    left = (D @ x + c / unit)[free]  # by the small weight
    x[free] -= np.linalg.lstsq(D[np.ix_(free, free)], left, rcond=NEGLIGIBLE)[0]
    return np.asarray(unit * np.clip(x, *limits))


def held(D: Array, c: Array, n: int, most: Array) -> Array:
    """Return forces of n stops, and of joints that friction of at most `most` holds, for free accelerations c."""
    return bounded(D, c, n, most) if len(most) else complementary(D, c)


def coulomb(D: Array, c: Array, most: Array, rubs: Rubs) -> tuple[Array, NDArray[np.int64]]:
    """Return forces at stops, in joints at rest, and at stops that rub; and the directions in which the latter slide.

    The forces of stops are non-negative and complementary to the accelerations (or velocities) D x + c; friction
    opposes sliding with its coefficient times the force of the stop, or is less than that at rest. These bounds follow
    from the forces by fixed-point iteration; the state of each contact being known, the equations are then linear.
    """
    n_rubs = len(rubs.normal)
    n = len(c) - len(most) - n_rubs
    rub = np.arange(len(c) - n_rubs, len(c))
    moving = rubs.sign != 0
    kept = np.setdiff1d(np.arange(len(c)), rub[moving])
    x, least = np.zeros(len(c)), NEGLIGIBLE * np.abs(c).max(initial=0.0) / D.diagonal().max(initial=1e-300)
    for _ in range(MOST_LOADS):
        new, load = np.zeros(len(c)), rubs.coefficient * x[rubs.normal]
        new[rub] = -rubs.sign * load
        right, bounds = (c + D @ new)[kept], np.append(most, load[~moving])
        inner = D[np.ix_(kept, kept)]
        new[kept] = held(inner, right, n, bounds)
        change, x = np.abs(new - x).max(), new
        if change <= AGREES * np.abs(x).max() + least:
            break
    else:
        raise Undetermined("friction of stops is so large that their forces are not determined: they may jam")
    left, terms = D @ x + c, np.abs(D) @ np.abs(x) + np.abs(c)
    if left[:n].min(initial=0.0) < -FITS * np.abs(c).max(initial=0.0):
        raise Undetermined("stops push against each other: no motion opens all of them or keeps them closed")
    slides = np.where(moving, rubs.sign, np.sign(left[rub]) * (np.abs(left[rub]) > SLIDES * terms[rub])).astype(int)
    return (_solved(D, c, x, n, Rubs(rubs.normal, rubs.coefficient, slides)) if n_rubs else x), slides


def _solved(D: Array, c: Array, x: Array, n: int, rubs: Rubs) -> Array:
    """Solve the linear equations of contacts whose states are known; those of joints stay as they are."""
    rub = np.arange(len(c) - len(rubs.normal), len(c))
    pushes = np.append(x[:n] > 0.0, np.zeros(len(c) - n, dtype=bool))
    loads = np.zeros((len(c), len(c)))  # x = loads y, where y are forces of stops and friction at rest
    loads[pushes, pushes] = 1.0
    loads[rub, rubs.normal] = -rubs.sign * rubs.coefficient * pushes[rubs.normal]
    holds = pushes.copy()
    holds[rub] = (rubs.sign == 0) & pushes[rubs.normal]
    loads[holds, holds] = 1.0
    A = (D @ loads)[np.ix_(holds, holds)]
    if np.linalg.eigvals(A).real.min(initial=0.0) < -NEGLIGIBLE * np.abs(A).max(initial=0.0):
        raise Undetermined("friction of stops is so large that their forces are not unique (P. Painlevé): they may jam")
    fixed = np.where(pushes, 0.0, x)
    fixed[rub] = 0.0
    y = np.zeros(len(c))
    y[holds] = np.linalg.lstsq(A, -(c + D @ fixed)[holds], rcond=NEGLIGIBLE)[0]
    return np.asarray(loads @ y + fixed)


def _squares(D: Array, b: Array) -> tuple[Array, Array]:
    """Return B and y with B^T B = D and B^T y = -b.

    Where rows of stops depend on one another, b may have a part outside the range of D: of parallel stops, which close
    at different rates. B has a small row for it.
    """
    values, vectors = np.linalg.eigh(0.5 * (D + D.T))
    along, least = vectors.T @ b, NEGLIGIBLE * values.max(initial=0.0)
    kept = (values > least) | (np.abs(along) > OUTSIDE * np.abs(b).max(initial=0.0))
    roots = np.sqrt(np.maximum(values[kept], least))
    return roots[:, None] * vectors[:, kept].T, -along[kept] / roots


def impulses(D: Array, u: Array, restitution: Array, rubs: Rubs) -> Array:
    """Return the impulses at k stops, followed by those of friction, with rates u, by Moreau's law.

    J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics, CISM 302 (1988): u+ + e u- >= 0, the
    impulse is non-negative, and their product is zero; the impulse of friction opposes the rate of sliding after the
    impact, and is at most the coefficient times the impulse. The energy does not increase without friction if all e
    are equal; with friction it may where the rate of sliding is reversed (T. R. Kane, 1984), which is refused.
    """
    shift = np.append(restitution * u[: len(restitution)], 0.0 * rubs.coefficient)
    P = coulomb(D, u + shift, np.zeros(0), rubs)[0]
    if len(rubs.normal) and P @ (u + 0.5 * (D @ P)) > NEGLIGIBLE * (np.abs(P) @ np.abs(u)):
        raise Undetermined("an impact with friction would add energy by the law of impacts; use another restitution")
    return P

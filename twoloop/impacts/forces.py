"""Compute contact forces and impulses: complementarity, Coulomb friction of stops and of joints, laws of impact."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear, nnls
from scipy.sparse.csgraph import connected_components

from twoloop.checks.arguments import Array
from twoloop.impacts.contact import Undetermined
from twoloop.problem.system import ConstrainedSystem
from twoloop.run.fallbacks import NEGLIGIBLE_RATIO, independent_rows, velocity_changes

COUPLING_TOLERANCE = 1e-6  # largest error with which a coefficient between two displacements counts as 0, 1 or -1
EVEN_WEIGHT = 1e-6  # relative weight of the regularisation that distributes a shared load evenly
SOLVER_SCALE = 1e3  # factor on the equations, so that their gradients exceed the tolerance of the solver
MAX_SOLVER_ITERATIONS = 1000
MAX_PIVOTS_PER_ROW = 20  # largest number of pivots of Lemke's method, per row
PIVOT_TOLERANCE = 1e-11  # smallest pivot of Lemke's method, relative to its column
# largest differences of ratios that count as equal in Lemke's method: rounding may end it if too few or too many do
TIES = 1e-14, 1e-12, 1e-10
ROUNDING_ERROR = 1e-13  # largest rounding error of a rate or acceleration, relative to the terms of its sum
ROUNDED = 2e-14  # largest acceleration or rate that counts as rounding, relative to others that act on it
SOLVED = 1e-9  # largest violation of a solution, relative to its largest number
# Lemke's method is repeated along other paths; accelerations that differ by more than PATH_TOLERANCE are not unique
N_OTHER_PATHS, PATH_TOLERANCE = 2, 1e-6
UNIT_RATIO = 256.0  # units of forces are powers of this number, so that they are all 1 for similar bodies
MAX_OUTSIDE = 1e-9  # largest component of b outside the range of D that counts as rounding, relative to max|b|
CLOSING_TOLERANCE = 1e-6  # largest acceleration (or rate) with which a stop may still close, relative to max|c|
SLIDING_TOLERANCE = 1e-9  # largest acceleration that counts as rounding, relative to the sum of its terms


class Tangents(NamedTuple):
    """Stops with friction: the index of the row of each normal, the coefficient, the sliding direction (0: at rest)."""

    normal: NDArray[np.int64]
    coefficient: Array
    sign: NDArray[np.int64]


def without_rounding(values: Array, W: Array, speeds: Array, bias: Array | float = 0.0) -> Array:
    """Return rates, or accelerations, with those that are rounding errors of W v (or W a + bias) set to zero."""
    terms = np.abs(W).sum(axis=1) * np.abs(speeds).max(initial=0.0) + np.abs(bias)
    return np.where(np.abs(values) <= ROUNDING_ERROR * terms, 0.0, values)


def responses(system: ConstrainedSystem, t: float, q: Array, W: Array) -> Array:
    """Return X (n_q, k), changes of velocities by unit impulses along rows W: M X + G^T Y = W^T, with G X = 0."""
    rows = system.rows(t, q)
    X = velocity_changes(system.mass(t, q), rows, W.T, np.zeros((len(rows), len(W))))
    rank = len(independent_rows(rows))
    for k, row in enumerate(W):
        if len(independent_rows(np.vstack([rows, row]))) == rank:  # joints and drives hold this row: no rounding errors
            X[:, k] = 0.0
    return X


def solve_complementarity(D: Array, b: Array) -> Array:
    """Solve the linear complementarity problem x >= 0, D x + b >= 0, x^T (D x + b) = 0; D symmetric semidefinite.

    x minimises x^T D x / 2 + b^T x: the non-negative least-squares problem |B x - y| with B^T B = D and B^T y = -b.
    """
    if not len(b):
        return np.zeros(0)
    x = nnls(*_least_squares_form(D, b))[0]
    # nnls finds the active set; the forces are then computed from D itself, because B, its root, has rounding errors
    is_active = x > 0.0
    x[is_active] = np.linalg.lstsq(D[np.ix_(is_active, is_active)], -b[is_active], rcond=NEGLIGIBLE_RATIO)[0]
    return np.maximum(x, 0.0)


def solve_bounded(D: Array, c: Array, n: int, limit: Array) -> Array:
    """Return forces that minimise x^T D x / 2 + c^T x subject to bounds: D x + c vanishes where no bound is active.

    The first n forces, at stops, are non-negative; the others, of friction, are bounded by `limit`. The sum of
    x^2 / limit is added with a small weight: a load that could be shared in any proportion is then shared evenly.
    """
    tiny = np.finfo(np.float64).tiny
    B, y = _least_squares_form(D, c)
    size = np.sqrt(D.diagonal().max())
    # scale of the forces, so that the unknowns are of order 1
    unit = max(float(np.linalg.norm(y)) / size, NEGLIGIBLE_RATIO * float(limit.max()), tiny)
    bound = np.maximum(limit / unit, tiny)
    regularisation = np.zeros((len(limit), len(c)))
    regularisation[:, n:] = np.diag(EVEN_WEIGHT * np.sqrt(bound.min() / bound))
    matrix, right_side = np.vstack([B / size, regularisation]), np.append(y / (size * unit), 0.0 * limit)
    limits = np.append(np.zeros(n), -bound), np.append(np.full(n, np.inf), bound)
    solution = lsq_linear(
        SOLVER_SCALE * matrix, SOLVER_SCALE * right_side, limits, "bvls", tol=1e-14, max_iter=MAX_SOLVER_ITERATIONS
    )
    x, free = solution.x, solution.active_mask == 0
    residual = (D @ x + c / unit)[free]  # due to the small weight
    x[free] -= np.linalg.lstsq(D[np.ix_(free, free)], residual, rcond=NEGLIGIBLE_RATIO)[0]
    return np.asarray(unit * np.clip(x, *limits))


def holding_forces(D: Array, c: Array, n: int, limit: Array) -> Array:
    """Return forces of n stops and of joints held by friction up to `limit`; c: accelerations without these forces."""
    return solve_bounded(D, c, n, limit) if len(limit) else solve_complementarity(D, c)


def coulomb_forces(D: Array, c: Array, limit: Array, tangents: Tangents) -> tuple[Array, NDArray[np.int64]]:
    """Return forces x (of stops, of joints at rest, of friction at stops), and the directions in which stops slide.

    The forces of stops are non-negative and complementary to the accelerations (or velocities) D x + c. Friction
    opposes sliding with its coefficient times the force of the stop; at rest, this product is a bound.
    """
    n_tangents, compliances = len(tangents.normal), D.diagonal()
    n = len(c) - len(limit) - n_tangents
    if (c[:n][compliances[:n] == 0.0] < -CLOSING_TOLERANCE * np.abs(c).max(initial=0.0)).any():
        raise Undetermined("joints or drives move a body into a stop, which no force of the stop can prevent")
    if not compliances.any():
        return np.zeros(len(c)), np.sign(c[len(c) - n_tangents :]).astype(int)
    # in these units, forces of light and heavy bodies are similar; a stop and its friction share one
    units = np.where(compliances > 0.0, compliances, 1.0) ** -0.5
    units[len(c) - n_tangents :] = units[tangents.normal]
    units = UNIT_RATIO ** np.round(np.log2(units) / np.log2(UNIT_RATIO))
    x, slides = _forces_in_units(D * units * units[:, None], units * c, limit / units[n : n + len(limit)], tangents)
    x *= units
    if (D @ x + c)[:n].min(initial=0.0) < -CLOSING_TOLERANCE * np.abs(c).max(initial=0.0):
        raise Undetermined("stops push against each other: no motion opens all of them or keeps them closed")
    return x, slides


def _forces_in_units(D: Array, c: Array, limit: Array, tangents: Tangents) -> tuple[Array, NDArray[np.int64]]:
    """Find which contacts slide, stick or open, by Lemke's method; then the equations for the forces are linear."""
    n_tangents = len(tangents.normal)
    n = len(c) - len(limit) - n_tangents
    if not n_tangents:
        return holding_forces(D, c, n, limit), np.zeros(0, dtype=int)
    first_tangent = len(c) - n_tangents
    acts_on = np.abs(D) > COUPLING_TOLERANCE
    acts_on[np.arange(first_tangent, len(c)), tangents.normal] = True
    # contacts that do not act on one another have units and rounding errors of their own
    component = connected_components(acts_on)[1]

    def largest(values: Array) -> Array:
        return np.array([values[component == k].max() for k in component])

    sizes = largest(np.abs(c))
    c = np.where(np.abs(c) <= ROUNDED * sizes, 0.0, c)
    x = _lemke_forces(D, c, limit, tangents, sizes, np.ones(len(c)))
    if x is None:
        raise Undetermined("friction of stops is so large that no forces of the stops are possible: they may jam")
    x[np.abs(x) <= ROUNDED * sizes] = 0.0  # all compliances are about one
    acceleration, terms = D @ x + c, largest(np.abs(D) @ np.abs(x) + np.abs(c))
    for weights in np.random.default_rng(5).uniform(0.5, 2.0, (N_OTHER_PATHS if n > 1 else 0, len(c))):
        x_other = _lemke_forces(D, c, limit, tangents, sizes, weights)
        if x_other is not None and (np.abs(D @ x_other + c - acceleration) > PATH_TOLERANCE * terms).any():
            raise Undetermined(
                "stops share their loads in any proportion, and with their friction the motion depends on it"
            )
    acceleration_signs = np.sign(acceleration) * (np.abs(acceleration) > SLIDING_TOLERANCE * terms)
    slides = np.where(tangents.sign != 0, tangents.sign, acceleration_signs[first_tangent:]).astype(int)
    return _solve_contacts(D, c, x, n, tangents._replace(sign=slides)), slides


def _lemke_forces(D: Array, c: Array, limit: Array, tangents: Tangents, sizes: Array, weights: Array) -> Array | None:
    """Return forces x = B z by the complementarity problem of D. E. Stewart and J. C. Trinkle (1996); None: none exist.

    z holds the forces of stops, of friction at rest in either direction, and the sliding rates s that may begin:
    D x + c >= 0 for stops; s + D x + c >= 0 and s - (D x + c) >= 0 for friction, and s (load - friction) = 0.
    """
    n_tangents = len(tangents.normal)
    n, first_tangent = len(c) - len(limit) - n_tangents, len(c) - n_tangents
    is_bounded = np.append(np.ones(len(limit), dtype=bool), tangents.sign == 0)
    bounded = n + np.flatnonzero(is_bounded)
    m = len(bounded)
    B = np.zeros((len(c), n + 3 * m))
    B[np.arange(n), np.arange(n)] = 1.0
    B[first_tangent + np.arange(n_tangents), tangents.normal] = -tangents.sign * tangents.coefficient
    B[bounded, n + np.arange(m)], B[bounded, n + m + np.arange(m)] = 1.0, -1.0
    rows = np.zeros((n + 3 * m, len(c)))
    rows[np.arange(n), np.arange(n)] = 1.0
    rows[n + np.arange(m), bounded], rows[n + m + np.arange(m), bounded] = 1.0, -1.0
    A, b = rows @ D @ B, rows @ c
    s = n + 2 * m + np.arange(m)
    A[n + np.arange(m), s] = A[n + m + np.arange(m), s] = 1.0
    A[s, n + np.arange(m)] = A[s, n + m + np.arange(m)] = -1.0
    loads = np.zeros((len(limit) + n_tangents, n))
    loads[len(limit) + np.arange(n_tangents), tangents.normal] = tangents.coefficient
    A[n + 2 * m :, :n] = loads[is_bounded]
    b[n + 2 * m :] = np.append(limit, np.zeros(n_tangents))[is_bounded]
    units = np.concatenate([sizes[:n], np.tile(sizes[bounded], 3)])  # of the forces
    units[units == 0.0] = 1.0
    A, b, d = A * units / units[:, None], b / units, np.concatenate([weights[:n], np.tile(weights[bounded], 3)])
    for tie in TIES:
        z = lemke(A, b, d, tie)
        if z is not None and (A @ z + b).min(initial=0.0) >= -SOLVED * (1.0 + np.abs(z).max(initial=0.0)):
            return B @ (units * z)
    return None


def lemke(A: Array, b: Array, d: Array, tie: float) -> Array | None:
    """Return z >= 0 with w = A z + b >= 0 and w^T z = 0, by C. E. Lemke's pivoting; None if it ends in a ray.

    It follows A z + b + d z0 = w from a large z0 to z0 = 0; d > 0. Rows are compared lexicographically, so that it does
    not cycle. R. W. Cottle, J.-S. Pang, R. E. Stone, The Linear Complementarity Problem (1992), sections 4.4 and 4.9.
    """
    n = len(b)
    if (b >= 0.0).all():
        return np.zeros(n)
    # columns: w, z, z0, right side; `basis`: variable of each row
    table = np.hstack([np.eye(n), -A, -d[:, None], b[:, None]])
    basis = np.arange(n)

    def leaving_row(column: Array, candidates: NDArray[np.intp]) -> int:
        for k in (2 * n + 1, *range(n)):  # right side, then the inverse of the basis: no ties remain
            ratios = table[candidates, k] / column[candidates]
            candidates = candidates[ratios <= ratios.min() + tie]
            if len(candidates) == 1:
                break
        return int(candidates[0])

    def pivot(row: int, entering: int) -> int:
        left = int(basis[row])
        table[row] /= table[row, entering]
        others = np.arange(n) != row
        table[others] -= np.outer(table[others, entering], table[row])
        basis[row] = entering
        return left

    entering = 2 * n
    row = leaving_row(d, np.arange(n))
    for _ in range(MAX_PIVOTS_PER_ROW * n):
        left = pivot(row, entering)
        if left == 2 * n:
            z = np.zeros(2 * n)
            z[basis] = table[:, -1]
            return np.maximum(z[n:], 0.0)
        entering = left + n if left < n else left - n
        column = table[:, entering]
        candidates = np.flatnonzero(column > PIVOT_TOLERANCE * np.abs(column).max())
        if not len(candidates):
            return None
        ends = np.flatnonzero(basis == 2 * n)
        row = leaving_row(column, candidates)
        # z0 leaves as soon as it may
        if (
            column[ends[0]] > PIVOT_TOLERANCE
            and table[ends[0], -1] / column[ends[0]] <= table[row, -1] / column[row] + tie
        ):
            row = int(ends[0])
    return None


def _solve_contacts(D: Array, c: Array, x: Array, n: int, tangents: Tangents) -> Array:
    """Correct the forces x at stops whose states are known by the linear equations; forces of joints do not change.

    The least correction keeps loads that may be shared in any proportion as x shares them.
    """
    tangent_rows = np.arange(len(c) - len(tangents.normal), len(c))
    is_pushing = np.append(x[:n] > NEGLIGIBLE_RATIO * np.abs(x).max(), np.zeros(len(c) - n, dtype=bool))
    loads = np.zeros((len(c), len(c)))  # x = loads @ y; y: forces of stops, and of friction at rest
    loads[is_pushing, is_pushing] = 1.0
    loads[tangent_rows, tangents.normal] = -tangents.sign * tangents.coefficient * is_pushing[tangents.normal]
    is_held = is_pushing.copy()
    is_held[tangent_rows] = (tangents.sign == 0) & is_pushing[tangents.normal]
    loads[is_held, is_held] = 1.0
    A = (D @ loads)[np.ix_(is_held, is_held)]
    if np.linalg.eigvals(A).real.min(initial=0.0) < -NEGLIGIBLE_RATIO * np.abs(A).max(initial=0.0):
        raise Undetermined("friction of stops is so large that their forces are not unique (P. Painlevé): they may jam")
    fixed_forces = np.where(is_pushing, 0.0, x)
    fixed_forces[tangent_rows] = 0.0
    y = np.where(is_held, x, 0.0)
    left = (c + D @ (loads @ y + fixed_forces))[is_held]
    y[is_held] -= np.linalg.lstsq(A, left, rcond=NEGLIGIBLE_RATIO)[0]
    return np.asarray(loads @ y + fixed_forces)


def _least_squares_form(D: Array, b: Array) -> tuple[Array, Array]:
    """Return B and y with B^T B = D and B^T y = -b.

    If the rows of stops are dependent, b may have a component outside the range of D, for example if parallel stops
    close at different rates. A small extra row of B represents this component.
    """
    values, vectors = np.linalg.eigh(0.5 * (D + D.T))
    components, threshold = vectors.T @ b, NEGLIGIBLE_RATIO * values.max(initial=0.0)
    is_significant = (values > threshold) | (np.abs(components) > MAX_OUTSIDE * np.abs(b).max(initial=0.0))
    roots = np.sqrt(np.maximum(values[is_significant], threshold))
    return roots[:, None] * vectors[:, is_significant].T, -components[is_significant] / roots


def impulses(D: Array, u: Array, restitution: Array, tangents: Tangents, law: str | None = None) -> Array:
    """Return the impulses at k stops, followed by the impulses of friction, for rates u before the impact.

    J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics, CISM 302 (1988): u+ + e u- >= 0, the
    impulse is non-negative, and their product is zero; the impulse of friction opposes the rate of sliding after the
    impact, and is at most the coefficient times the impulse. Without friction the energy does not increase if all e are
    equal; with friction it may if the rate of sliding is reversed (T. R. Kane, 1984), which raises Undetermined.

    If `law` is "poisson", bodies are compressed until no stop closes, and e times these impulses drive them apart, with
    further impulses where stops would close again (C. Glocker and F. Pfeiffer, Nonlinear Dynamics 7 (1995) 471).
    """
    none = np.zeros(0)
    if law == "poisson":  # without friction, see `check_law`
        P = (1.0 + restitution) * coulomb_forces(D, u, none, tangents)[0]
        P += coulomb_forces(D, u + D @ P, none, tangents)[0]
    else:
        shift = np.append(restitution * u[: len(restitution)], 0.0 * tangents.coefficient)
        P = coulomb_forces(D, u + shift, none, tangents)[0]
    adds_energy = P @ (u + 0.5 * (D @ P)) > NEGLIGIBLE_RATIO * (np.abs(P) @ np.abs(u))
    if adds_energy and (len(tangents.normal) or law == "poisson"):
        raise Undetermined("an impact would add energy by the law of impacts; use another restitution")
    return P

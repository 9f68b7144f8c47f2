"""Friction proportional to the load of a joint, which requires the joint forces at every evaluation."""

from __future__ import annotations

from typing import Any

import numpy as np

from twoloop.bodies.parameter_layout import FORCE_WIDTH, FORCES, HEAD, N_FORCES
from twoloop.bodies.parts import Force
from twoloop.bodies.places import turned
from twoloop.bodies.tables import Tables
from twoloop.checks.arguments import Array

STEPS = 50  # limit of Newton's method, which needs three or four iterations
AGREES = 1e-14  # relative: change of the friction per iteration at convergence
DEPENDENT = 1e-12  # relative: smaller singular values of the constraint rows count as zero


class LoadedFriction:
    """Friction -c tanh(rate / speed) |F| in joints, where the joint forces F depend on the friction in turn.

    M a + G^T lam = Q + W^T f and G a = gamma give lam = lam_0 + L f. With f = -c |P lam|, where c are the coefficients
    times tanh, the solution is unique if the matrix of the c_k |P_k L_l| has a spectral radius below one, because
    f -> -c |P lam(f)| is then a contraction. Otherwise a joint may jam or several solutions may exist (P. Painlevé,
    Leçons sur le frottement, 1895), and the friction is NaN.

    Parameters
    ----------
    callbacks : module
        The callbacks of planar or of spatial models.
    tables : Tables
        Tables with `loaded` forces.
    redundant : bool
        True if constraint rows other than those of these joints may be dependent.
    """

    def __init__(self, callbacks: Any, tables: Tables, redundant: bool):
        self._fill_force, self._loaded, self._redundant = callbacks.fill_force, tables.loaded, redundant
        self._dimension = len(tables.gravity)
        self._numbers = [tables.place(force) + np.arange(_size(force)) for force in tables.loaded]
        self._rows = [self._carrying(force, tables) for force in tables.loaded]
        first = int(tables.p[tables.p.size - HEAD + FORCES]) + FORCE_WIDTH * len(tables.forces)
        # rows of the unit motors, after those of the forces
        self._units = [first + FORCE_WIDTH * k for k in range(len(self._loaded))]

    def _carrying(self, force: Force, tables: Tables) -> list[int]:
        """Return the rows that carry the load of a joint: those of its point, or those across its guide."""
        joint = force.joint
        assert joint is not None
        return list(tables.rows[joint.name][: self._dimension - (joint.kind == "prismatic")])

    def of(self, q: Array, v: Array, p: Array, Q: Array, M: Array, G: Array, gamma: Array) -> Array:
        """Return the contribution to Q, (n_q,)."""
        W = np.array([self._along(k, q, p) for k in range(len(self._loaded))])
        c = np.array([_slope(p[at], rate) for at, rate in zip(self._numbers, W @ v, strict=True)])
        if not c.any():
            return np.zeros(len(q))
        n, m = len(q), len(G)
        K = np.block([[M, G.T], [G, np.zeros((m, m))]])
        right = np.zeros((n + m, 1 + len(W)))
        right[:n, 0], right[n:, 0], right[:n, 1:] = Q, gamma, W.T
        found = np.linalg.lstsq(K, right, rcond=DEPENDENT)[0] if self._redundant else np.linalg.solve(K, right)
        loads = [
            self._across(force, q, found[n + np.array(rows)])
            for force, rows in zip(self._loaded, self._rows, strict=True)
        ]
        return W.T @ _friction(c, loads)

    def _along(self, k: int, q: Array, p: Array) -> Array:
        """Return the generalised force of a unit motor in a joint, i.e. the gradient of its displacement."""
        alone, out = p.copy(), np.zeros(len(q))
        alone[: self._dimension] = 0.0  # gravity
        alone[p.size - HEAD + FORCES], alone[p.size - HEAD + N_FORCES] = self._units[k], 1.0
        self._fill_force(q, np.zeros(len(q)), alone, np.zeros(0), out)
        return out

    def _across(self, force: Force, q: Array, lam: Array) -> Array:
        """Return the components of the force in a spatial hinge across its axis; the thrust causes no friction."""
        joint = force.joint
        assert joint is not None
        if self._dimension == 2 or joint.kind == "prismatic":
            return lam
        axis = np.array(turned(q, joint.a, joint.axes[0]))
        return np.asarray(lam - np.outer(axis, axis @ lam))


def _size(force: Force) -> int:
    assert force.more is not None
    return len(force.more.values)


def _slope(numbers: Array, rate: float) -> float:
    """Return coefficient times hinge radius times tanh; numbers begin with constant friction and speed."""
    return float(numbers[2:].prod() * np.tanh(rate / numbers[1]))


def _friction(c: Array, loads: list[Array]) -> Array:
    """Solve f_k + c_k |x_k + L_k f| = 0, where loads[k] has the columns x_k and L_k; NaN if f may not be unique."""
    n = len(c)
    coupled = np.array([np.abs(c[k]) * np.linalg.norm(loads[k][:, 1:], axis=0) for k in range(n)])
    f = np.zeros(n)
    if not np.isfinite(coupled).all() or np.abs(np.linalg.eigvals(coupled)).max() >= 1.0:
        return np.full(n, np.nan)
    for step in range(STEPS):
        x = [load[:, 0] + load[:, 1:] @ f for load in loads]
        sizes = np.array([np.linalg.norm(each) for each in x])
        new = -c * sizes
        if step < STEPS // 2:  # Newton's method, then fixed-point iteration, which is a contraction
            slopes = np.array(
                [each @ load[:, 1:] / max(size, 1e-300) for each, load, size in zip(x, loads, sizes, strict=True)]
            )
            new = f - np.linalg.solve(np.eye(n) + c[:, None] * slopes, f - new)
        if np.abs(new - f).max() <= AGREES * np.abs(new).max():
            return new
        f = new
    return f

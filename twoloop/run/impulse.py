"""The impulse of constraints whose C_t or b jumps: velocities right after it, from those right before."""

import numpy as np
from numpy.typing import NDArray

from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

CORRECTIONS = 3  # of positions, which are off by less than the tolerances
NEGLIGIBLE = 1e-12  # relative: singular values, and eigenvalues, that count as zero: redundant rows
HOLDS = 1e-8  # relative: what is left of them where there is a solution


def beyond_jump(system: ConstrainedSystem, t: float, q: Array, v: Array) -> Array | None:
    """The state [q, v] at t, right after a jump, from the one before; None: no velocities fit the constraints.

    M (v+ - v) + G^T p = 0 and G v+ + (C_t, b) = 0: of all velocities that the constraints allow the nearest in the
    metric of M.
    """
    q = corrected(system, t, q)
    equations, lengths, size = scaled_equations(system, t, q)
    right = np.concatenate([np.zeros(system.n_q), -system.velocity_constraint(t, q, v) / lengths * size])
    change = np.linalg.lstsq(equations, right, rcond=NEGLIGIBLE)[0]
    if not np.abs(equations @ change - right).max() <= HOLDS * np.abs(right).max():
        return None
    return np.concatenate([q, v + change[: system.n_q]])


def corrected(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """The nearest positions on the constraints, by Newton's method."""
    for _ in range(CORRECTIONS if system.n_c > 0 else 0):
        q = q - np.linalg.lstsq(system.jacobian(t, q), system.constraint(t, q), rcond=NEGLIGIBLE)[0]
    return q


def scaled_equations(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array, float]:
    """The matrix [M G^T; G 0], its rows G over their lengths and times the size of M; these lengths, and that size."""
    mass, rows = system.mass(t, q), system.rows(t, q)
    lengths, size = np.linalg.norm(rows, axis=1), float(np.abs(mass).max())
    lengths[lengths == 0.0] = 1.0
    scaled = rows / lengths[:, None] * size
    return np.block([[mass, scaled.T], [scaled, np.zeros((len(rows), len(rows)))]]), lengths, size

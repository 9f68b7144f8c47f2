"""What a system is at a position: its rows and their pattern, its mass matrix, and what is wrong with them."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.linalg import null_space

from twoloop.checks.arguments import Array
from twoloop.checks.rank import eigenvalues, in_words, redundant_rows
from twoloop.checks.scales import rows_at, scales_of
from twoloop.kernels.compile.callbacks import KINDS

if TYPE_CHECKING:
    from twoloop.problem.system import ConstrainedSystem


NEARBY = (0.0, 1e-3, 1e-2, 3e-2)  # of the coordinates: where the pattern of C_q is looked at
SINGULAR_MASS = 1e-12  # smallest eigenvalue over largest entry, below which M may have no inverse


def pattern_of(system: ConstrainedSystem, t: float, q: Array) -> Array:
    """1 where C_q or A has an entry at a position or near it, (n_c + n_a, n_q); not to be written to."""
    return system.remembered_at("pattern", (t, q.tobytes()), lambda: _pattern_of(system, t, q))


def _pattern_of(system: ConstrainedSystem, t: float, q: Array) -> Array:
    size = np.maximum(np.abs(q), np.abs(q).max())
    rows, defined = rows_at(system, t, q + size * ways(system.n_q))  # what is missed is found on the way
    return (rows[defined] != 0.0).any(axis=0).astype(float)


@cache
def ways(n_q: int) -> Array:
    """How far positions near one are from it, (len(NEARBY), n_q), over its size: always the same."""
    return np.array(NEARBY)[:, None] * np.random.default_rng(4).uniform(-1.0, 1.0, (len(NEARBY), n_q))


def mass_and_rows(system: ConstrainedSystem, t: float, q: Array) -> tuple[Array, Array]:
    """M, and C_q with A, at a position; not to be written to."""
    return system.remembered_at("mass and rows", (t, q.tobytes()), lambda: (system.mass(t, q), system.rows(t, q)))


def has_definite_mass(system: ConstrainedSystem, t: float, q: Array) -> bool:
    """Whether M has an inverse at a position, and not only on velocities that the constraints allow."""
    return system.remembered_at("definite mass", place_of_mass(system, t, q), lambda: is_definite(system.mass(t, q)))


def is_definite(mass: Array) -> bool:
    """Whether M has an inverse."""
    return bool(eigenvalues(mass)[0] > SINGULAR_MASS * np.abs(mass).max())


def place_of_mass(system: ConstrainedSystem, t: float, q: Array) -> Any:
    """What a mass matrix depends on."""
    return None if system.constant_mass else (t, q.tobytes())


def parts_of(value: Array | tuple[Array, ...]) -> tuple[Array, ...]:
    """The arrays that a callback fills, of which "kinematics" has several."""
    return value if isinstance(value, tuple) else (value,)


def not_finite(system: ConstrainedSystem, t: float, q: Array, v: Array) -> str | None:
    """Which callbacks give values that are not finite at (t, q, v); None: all are."""
    state = {"q": q, "v": v, "lam": np.ones(system.n_c)}
    looked = [kind for kind in system.given if kind not in system.entries]  # whose values are looked at
    values = {kind: system.evaluate(kind, t, *[state[name] for name in KINDS[kind].state]) for kind in looked}
    wrong = [kind for kind, value in values.items() if not all(np.isfinite(part).all() for part in parts_of(value))]
    return f"{' and '.join(wrong)} of {system.name!r} returned values that are not finite" if wrong else None


def dependent_rows(system: ConstrainedSystem, t: float, q: Array) -> str:
    """Which rows of C_q(t, q) depend on the others, in words."""
    jacobian = system.rows(t, q)
    rows = redundant_rows(scales_of(system, t, q, jacobian).scaled(jacobian))
    if rows:
        return in_words(jacobian, rows)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return (
        "or so nearly that Newton cannot tell: its smallest singular value at the last state is "
        f"{values[-1] / values[0]:.1g} of the largest"
    )


def least_inertia(system: ConstrainedSystem, t: float, q: Array) -> tuple[float, str]:
    """Smallest over largest eigenvalue of T^T M T, and which coordinates move in the motion that it belongs to."""
    mass, rows = system.mass(t, q), system.rows(t, q)
    free = null_space(rows) if len(rows) > 0 else np.eye(system.n_q)
    if free.shape[1] == 0:
        return 1.0, "the constraints allow no motion"
    energies, motions = np.linalg.eigh(free.T @ mass @ free)
    motion = np.abs(free @ motions[:, 0])
    coordinates = np.flatnonzero(motion > 0.1 * motion.max()).tolist()
    return float(energies[0] / max(energies[-1], np.finfo(np.float64).tiny)), (
        f"a motion of coordinate(s) {coordinates}, which the constraints allow, has next to no inertia, or a negative "
        f"one: the smallest eigenvalue of T^T M T is {energies[0]:.3g}, the largest {energies[-1]:.3g}"
    )

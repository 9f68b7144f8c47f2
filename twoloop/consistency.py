"""Consistent states: the check of a start, the projection of a guess, and what is wrong with a system at a point."""

from __future__ import annotations  # ArrayLike stays a word in help()

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

from twoloop.bounds import check_bounds
from twoloop.checks import check_number, check_vector
from twoloop.derivatives import check_derivatives
from twoloop.kernels.common import GAMMA_GIVEN
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

MAX_ITERATIONS = 50
RANK_TOLERANCE = 1e-11  # of the largest diagonal entry of R
CONSISTENT = 1e-8  # largest violation that an initial state may have, relative to max(1, |q|) or max(1, |v|)


def consistent_state(system: ConstrainedSystem, t: float, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
    """Project a guess onto the constraints: positions by Gauss-Newton, then velocities, each by the least change.

    Parameters
    ----------
    system : ConstrainedSystem
    t : float
        Time, s.
    q, v : array_like (n_q,)
        Guess. Its distance to the constraints should be small against the mechanism.

    Returns
    -------
    q, v : ndarray (n_q,)
        With C(t, q) = 0 and C_q v + C_t = 0 to rounding.

    Raises
    ------
    ValueError
        If a shape is wrong, a value is not finite, or no consistent position is found near the guess.
    """
    t = check_number("t", t)
    q = check_vector("q", q, system.n_q)
    v = check_vector("v", v, system.n_q)
    check_bounds(system, t, q, v)
    system.check_returned(t, q, v)
    blame = not_finite(system, t, q, v)
    if blame != _NOTHING_FOUND:
        raise ValueError(f"q and v cannot be projected: {blame} at t = {t:g}")
    correction = np.inf
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        matrix, violations = system.jacobian(t, q), system.constraint(t, q)
        if not (np.isfinite(matrix).all() and np.isfinite(violations).all()):
            break
        step = np.linalg.lstsq(matrix, -violations, rcond=1e-10)[0]
        q = q + step
        before, correction = correction, float(np.abs(step).max())
        if not np.isfinite(correction) or correction < 1e-15 * max(1.0, np.abs(q).max()):
            break
        if correction >= before and correction < 1e-12:
            break  # rounding level
    violation = float(np.abs(system.constraint(t, q)).max())
    if not violation < 1e-10 * max(1.0, float(np.abs(q).max())):
        raise ValueError(
            f"q cannot be projected onto the constraints of {system.name!r} at t = {t!r}: after {iterations} "
            f"iterations max|C| is {violation:.3g}. Give a guess that is nearer to an assembled position"
        )
    v = v - np.linalg.lstsq(system.jacobian(t, q), system.velocity_constraint(t, q, v), rcond=1e-10)[0]
    return q, v


def check_start(system: ConstrainedSystem, t0: float, q0: Array, v0: Array, derivatives: bool = True) -> None:
    """Call every callback once at the start and check shapes, finiteness, rank and consistency.

    Raises
    ------
    TypeError, ValueError
        Naming the callback or the argument, what was found and what to do.
    """
    check_bounds(system, t0, q0, v0)
    system.check_returned(t0, q0, v0)
    matrix = system.mass(t0, q0)
    jacobian = system.jacobian(t0, q0)
    blame = not_finite(system, t0, q0, v0)
    if blame != _NOTHING_FOUND:
        raise ValueError(f"at the start, t = {t0:g}, {blame}")
    if np.abs(matrix - matrix.T).max() > 1e-10 * np.abs(matrix).max():
        raise ValueError(
            f"mass of {system.name!r} must be symmetric; at t = {t0:g} max|M - M^T| is "
            f"{np.abs(matrix - matrix.T).max():.3g}"
        )
    _refuse_inconsistent(system, "q0", t0, system.constraint(t0, q0), np.abs(q0).max())
    if derivatives:
        check_derivatives(system, t0, q0)
    _refuse_inconsistent(system, "v0", t0, system.velocity_constraint(t0, q0, v0), np.abs(v0).max())
    redundant = redundant_rows(jacobian)
    if redundant:
        raise ValueError(
            f"the constraint Jacobian of {system.name!r} has rank {system.n_c - len(redundant)} < n_c = {system.n_c} "
            f"at t = {t0:g}: row(s) {redundant} depend on the others. Leave these constraints out (redundant "
            "constraints are not handled yet), or start from another position"
        )


def _refuse_inconsistent(system: ConstrainedSystem, name: str, t0: float, violation: Array, scale: float) -> None:
    row = int(np.abs(violation).argmax())
    if abs(violation[row]) > CONSISTENT * max(1.0, scale):
        equation = "C(t, q)" if name == "q0" else "C_q v + C_t"
        raise ValueError(
            f"{name} is not consistent with the constraints of {system.name!r}: max|{equation}| is "
            f"{abs(violation[row]):.3g} (row {row}) at t = {t0:g}, at most {CONSISTENT:g} is accepted. Project it "
            "with twoloop.consistent_state(system, t, q, v)"
        )


def redundant_rows(jacobian: Array) -> list[int]:
    """Rows of a Jacobian that depend on the others, by QR with pivoting."""
    R, order = qr(jacobian.T, mode="r", pivoting=True)
    diagonal = np.abs(np.diagonal(R))
    rank = int((diagonal > RANK_TOLERANCE * diagonal.max()).sum())
    return sorted(order[rank:].tolist())


def dependent_rows(system: ConstrainedSystem, t: float, q: Array) -> str:
    """Which rows of C_q(t, q) depend on the others, in words."""
    rows = redundant_rows(system.jacobian(t, q))
    return f"row(s) {rows} depend on the others" if rows else "or so nearly that Newton cannot tell"


_NOTHING_FOUND = "no callback was found at fault"


def not_finite(system: ConstrainedSystem, t: float, q: Array, v: Array) -> str:
    """Which callback gives values that are not finite at (t, q, v)."""
    values = {
        "mass": lambda: system.mass(t, q),
        "force": lambda: system.force(t, q, v),
        "constraint": lambda: system.constraint(t, q),
        "jacobian": lambda: system.jacobian(t, q),
        "constraint_rate": lambda: system.constraint_rate(t, q),
        # of tangents that are not given these are zeros
        "force_by_q": lambda: system.force_by_q(t, q, v),
        "force_by_v": lambda: system.force_by_v(t, q, v),
        "reaction_by_q": lambda: system.reaction_by_q(t, q, np.ones(system.n_c)),
    }
    if system.functions.flags[GAMMA_GIVEN] == 1:
        values["gamma"] = lambda: system.gamma(t, q, v)
    guilty = [kind for kind, value in values.items() if not np.isfinite(value()).all()]
    if not guilty:
        return _NOTHING_FOUND
    return f"{' and '.join(guilty)} of {system.name!r} returned values that are not finite"

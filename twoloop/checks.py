"""Checks of what a user gives: each says which argument is wrong, what was given, what was expected, what to do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr

if TYPE_CHECKING:
    from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

RANK_TOLERANCE = 1e-11  # of the largest diagonal entry of R
CONSISTENT = 1e-8  # largest violation that an initial state may have, relative to max(1, |q|) or max(1, |v|)


def check_size(name: str, value: Any, least: int) -> int:
    """Return `value` as an int of at least `least`, or say what is wrong with it."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise TypeError(f"{name} must be an int; given {value!r} of type {type(value).__name__}")
    if value < least:
        raise ValueError(f"{name} must be at least {least}; given {value}")
    return int(value)


def check_real(name: str, value: ArrayLike) -> Array:
    """Return `value` as a new float array, or say that it is not one."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of real numbers; given {value!r}") from error


def check_vector(name: str, value: ArrayLike, n: int) -> Array:
    """Return `value` as a new float vector of length n, or say what is wrong with it."""
    array = check_real(name, value)
    if array.shape != (n,):
        raise ValueError(f"{name} must have shape ({n},); given shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite; entries {np.flatnonzero(~np.isfinite(array)).tolist()} are not")
    return array


def check_span(t_span: tuple[float, float]) -> tuple[float, float]:
    """Return start and end, or say what is wrong with them."""
    span = check_vector("t_span", t_span, 2)
    t0, t1 = float(span[0]), float(span[1])
    if not t1 > t0:
        raise ValueError(f"t_span must be (start, end) with end > start; given ({t0!r}, {t1!r})")
    return t0, t1


def check_number(name: str, value: Any) -> float:
    """Return `value` as a float, or say that it is not a number."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
        raise TypeError(f"{name} must be a number; given {value!r} of type {type(value).__name__}")
    return float(value)


def check_positive(name: str, value: Any, infinite: bool = False) -> None:
    """Raise unless `value` is a positive number, finite unless `infinite`."""
    check_number(name, value)
    if not value > 0.0 or (not infinite and value == np.inf):
        raise ValueError(f"{name} must be positive{'' if infinite else ' and finite'}; given {value!r}")


def check_times(t_eval: ArrayLike, t0: float, t1: float, step_size: float | None) -> Array:
    """Return the output times as an array, or say what is wrong with them."""
    times = check_real("t_eval", t_eval)
    if times.ndim != 1 or times.size == 0:
        raise ValueError(f"t_eval must be a non-empty one-dimensional array; given shape {times.shape}")
    if not np.isfinite(times).all() or times.min() < t0 or times.max() > t1:
        raise ValueError(
            f"t_eval must lie within t_span = ({t0:g}, {t1:g}); given times from {times.min():g} to {times.max():g}"
        )
    if (np.diff(times) <= 0.0).any():
        where = int(np.flatnonzero(np.diff(times) <= 0.0)[0])
        raise ValueError(
            f"t_eval must be strictly increasing; entry {where + 1} ({times[where + 1]:g}) follows {times[where]:g}"
        )
    if step_size is not None:
        ratio = (times - t0) / step_size
        off = np.abs(ratio - np.round(ratio)) > 1e-6
        off &= times != t1
        if off.any():
            raise ValueError(
                f"t_eval must hold multiples of step_size = {step_size!r} from t = {t0:g} when the step is fixed; "
                f"{times[off][0]!r} is not one"
            )
    return times


def check_start(system: ConstrainedSystem, t0: float, q0: Array, v0: Array) -> None:
    """Call every callback once at the start and check shapes, finiteness, rank and consistency.

    Raises
    ------
    TypeError, ValueError
        Naming the callback or the argument, what was found and what to do.
    """
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
    redundant = redundant_rows(jacobian)
    if redundant:
        raise ValueError(
            f"the constraint Jacobian of {system.name!r} has rank {system.n_c - len(redundant)} < n_c = {system.n_c} "
            f"at t = {t0:g}: row(s) {redundant} depend on the others. Leave these constraints out (redundant "
            "constraints are not handled yet), or start from another position"
        )
    for name, violation, scale in (
        ("q0", system.constraint(t0, q0), np.abs(q0).max()),
        ("v0", system.velocity_constraint(t0, q0, v0), np.abs(v0).max()),
    ):
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
        "gamma": lambda: system.gamma(t, q, v),
    }
    guilty = [kind for kind, value in values.items() if not np.isfinite(value()).all()]
    if not guilty:
        return _NOTHING_FOUND
    return f"{' and '.join(guilty)} of {system.name!r} returned values that are not finite"

"""Options of both drivers of IDA: the highest order, what the error test sees, an exact tangent of the force.

They are for systems with fast vibrations that hardly matter. Velocities keep such vibrations in the error test however
loose it is, and the BDF of orders 3 to 5 are unstable for undamped ones that the step does not resolve. With orders up
to 2, and only positions tested, IDA may step over them: on the moderately stiff beam (`twoloop.mechanisms`, 2 s) that
brings the tip's height to 1e-3 m in 3,500 steps, where the defaults take 115,000 even at tolerances of 1e-3, and reach
6e-6 m. On the very flexible beam, whose large motion the vibrations do change, nothing is gained. The exact tangent
saves up to a quarter of the time where Jacobians are frequent, and nothing where they are not.
"""

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from twoloop.checks import check_size
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

ERROR_TESTS = {
    "all": "all unknowns but the algebraic ones",
    "positions": "coordinates only",
}
HIGHEST_ORDER = 5  # of IDA

NOT_TESTED = 1e12  # the absolute tolerance that takes an unknown out of IDA's error test, and out of Newton's

DIFFERENCE = 1e-6  # displacement by which a tangent is checked, relative to max(1, |q|)
AGREEMENT = 1e-5  # between a tangent and the difference of the force, relative


@njit
def no_tangent(t, q, v, p, K):  # type: ignore[no-untyped-def]
    """Stand in for a tangent that was not given; never called."""


@njit
def no_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    """Stand in for the force in what is differenced beside an exact tangent."""


def check_options(max_order: int, error_test: str) -> int:
    """Return the highest order as an int, or say what is wrong with these options."""
    max_order = check_size("max_order", max_order, 1)
    if max_order > HIGHEST_ORDER:
        raise ValueError(f"max_order must be at most {HIGHEST_ORDER}, the highest of IDA; given {max_order}")
    if error_test not in ERROR_TESTS:
        raise ValueError(f"error_test must be one of {', '.join(ERROR_TESTS)}; given {error_test!r}")
    return max_order


def tolerances(system: ConstrainedSystem, size: int, error_test: str, atol: float) -> Array:
    """Absolute tolerances (size,) of the unknowns q, v and whatever else there is."""
    each = np.full(size, atol)
    if error_test == "positions":
        each[system.n_q :] = NOT_TESTED
    return each


def check_tangent(system: ConstrainedSystem, tangent: Dispatcher | None, t: float, q: Array, v: Array) -> None:
    """Raise unless `tangent` is compiled and is dQ/dq at the start, of a force that does not depend on v there."""
    if tangent is None:
        return
    if not isinstance(tangent, Dispatcher):
        raise TypeError(
            "tangent must be compiled by numba.njit, take (t, q, v, p, K) as a callback does and add dQ/dq to K "
            f"(n_q, n_q); given {tangent!r}"
        )
    K = np.zeros((system.n_q, system.n_q))
    tangent(t, q, v, system.parameters, K)
    direction = np.sin(1.0 + np.arange(system.n_q))
    step = DIFFERENCE * max(1.0, float(np.abs(q).max()))
    ahead, behind = (system.force(t, q + sign * step * direction, v) for sign in (1.0, -1.0))
    expected, scale = (ahead - behind) / (2.0 * step), np.abs(K) @ np.abs(direction)
    off = float(np.abs(K @ direction - expected).max())
    if not off <= AGREEMENT * max(1.0, float(np.abs(expected).max()), float(scale.max())):
        raise ValueError(
            f"tangent must add dQ/dq of {system.name!r} to K; at the start it differs from the difference of the force "
            f"along a direction by {off:.3g}, where that is {float(np.abs(expected).max()):.3g} at most"
        )
    if not np.array_equal(system.force(t, q, v + direction), system.force(t, q, v)):
        raise ValueError(
            f"tangent is for a force that does not depend on velocities, whose derivative is then left out; that of "
            f"{system.name!r} does depend on them. Leave tangent out, and the Jacobian is differenced"
        )

"""Options of both drivers of IDA: the highest order, what the error test sees; and the system's own tangent.

They are for systems with fast vibrations that hardly matter. Velocities keep such vibrations in the error test however
loose it is, and the BDF of orders 3 to 5 are unstable for undamped ones that the step does not resolve. With orders up
to 2, and only positions tested, IDA may step over them: on the moderately stiff beam (`twoloop.mechanisms`, 2 s) that
brings the tip's height to 1e-3 m in 3,500 steps, where the defaults take 115,000 even at tolerances of 1e-3, and reach
6e-6 m. On the very flexible beam, whose large motion the vibrations do change, nothing is gained. The exact tangent
saves up to a quarter of the time where Jacobians are frequent, and nothing where they are not.
"""

from typing import Any

import numpy as np
from numba import njit
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from references.driver import check_choice
from twoloop.checks import check_size
from twoloop.kernels.common import FORCE_BY_Q_GIVEN, FORCE_BY_V_GIVEN
from twoloop.system import ConstrainedSystem

Array = NDArray[np.float64]

ERROR_TESTS = {
    "all": "all unknowns but the algebraic ones",
    "states": "coordinates and velocities, not the integrals of the multipliers",
    "positions": "coordinates only",
}
ALL = 10**9  # rows that are of C: there are none of A v + b = 0 below
HIGHEST_ORDER = 5  # of IDA

# keyword arguments of both drivers, by name: IDA as it comes, and as it is cheapest on stiff beams
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {"max_order": HIGHEST_ORDER, "error_test": "all"},
    "best": {"max_order": 2, "error_test": "positions"},
}

NOT_TESTED = 1e12  # the absolute tolerance that takes an unknown out of IDA's error test, and out of Newton's


@njit
def no_force(t, q, v, p, Q):  # type: ignore[no-untyped-def]
    """Stand in for the force in what is differenced beside an exact tangent."""


def check_options(max_order: int, error_test: str) -> int:
    """Return the highest order as an int, or say what is wrong with these options."""
    max_order = check_size("max_order", max_order, 1)
    if max_order > HIGHEST_ORDER:
        raise ValueError(f"max_order must be at most {HIGHEST_ORDER}, the highest of IDA; given {max_order}")
    check_choice("error_test", error_test, ERROR_TESTS)
    return max_order


def tolerances(system: ConstrainedSystem, size: int, error_test: str, atol: float) -> Array:
    """Absolute tolerances (size,) of the unknowns q, v and whatever else there is."""
    each = np.full(size, atol)
    if error_test != "all":
        each[system.n_q * (1 if error_test == "positions" else 2) :] = NOT_TESTED
    return each


def own_tangent(system: ConstrainedSystem) -> Dispatcher | None:
    """The system's dQ/dq, if it gives one and the force does not depend on v: nothing of it is then differenced."""
    flags = system.functions.flags
    exact = flags[FORCE_BY_Q_GIVEN] == 1 and flags[FORCE_BY_V_GIVEN] == 0
    return system.functions.force_by_q if exact else None

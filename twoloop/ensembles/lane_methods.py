"""Methods that go in lanes: their kernels, their parameters and their memory."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twoloop.generate.lane_code import LaneCode
from twoloop.methods.plan import Plan, least_tolerance
from twoloop.methods.presets import PRESETS
from twoloop.methods.taylor import order_in_lanes
from twoloop.run.run import FIRST_STEP

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TaylorInLanes:
    """Taylor series."""

    name = "Taylor"
    has_series = True

    def kernels(self) -> Any:
        """Its step; compiled, or read from the cache, when it is first asked for."""
        from twoloop.kernels.lanes.lane_taylor import TAYLOR_IN_LANES

        return TAYLOR_IN_LANES

    def order(self, rtol: float, atol: float) -> int:
        """What the functions made for a mechanism get as the order."""
        return order_in_lanes(rtol, atol) + 1

    def options(self, n: int, rtol: float, atol: float) -> Array:
        """What its step reads."""
        return np.zeros(0)

    def memory_size(self, code: LaneCode, order: int, options: Array) -> int:
        """Length of its memory, in vectors."""
        return code.series_size(order)


@dataclass(frozen=True)
class DOP853InLanes:
    """The explicit method DOP853."""

    name = "DOP853"
    has_series = False

    def kernels(self) -> Any:
        """Its step; compiled, or read from the cache, when it is first asked for."""
        from twoloop.kernels.lanes.lane_dop853 import DOP853_IN_LANES

        return DOP853_IN_LANES

    def order(self, rtol: float, atol: float) -> int:
        """What the functions made for a mechanism get as the order."""
        return 8

    def options(self, n: int, rtol: float, atol: float) -> Array:
        """What its step reads."""
        return _with_head(PRESETS["DOP853"].plan(n, rtol, atol, False), rtol, atol)

    def memory_size(self, code: LaneCode, order: int, options: Array) -> int:
        """Length of its memory, in vectors."""
        from twoloop.kernels.lanes.lane_control import N_HEAD
        from twoloop.kernels.lanes.lane_dop853 import memory_size

        return memory_size(int(options[N_HEAD]), code.n)


def _with_head(plan: Plan, rtol: float, atol: float) -> Array:
    """The parameters of a method with what lane_control.py reads."""
    return np.concatenate([plan.rule, [plan.rough, FIRST_STEP, least_tolerance(rtol, atol)], plan.options])

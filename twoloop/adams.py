"""Adams(): a multistep method on the accelerations of all coordinates."""

from dataclasses import dataclass

import numpy as np

from twoloop.plan import Plan, least_tolerance

LARGEST_MOVE = 3e-7  # of a position in the projection that ends a step; its square, 1e-13, is what C is then off by


@dataclass(frozen=True)
class Adams:
    """Adams methods of orders 1 to 12 in the second-order form, with two evaluations a step."""

    @property
    def name(self) -> str:
        """Shown in messages and tables."""
        return "Adams"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels import adams as kernels

        if fixed:
            raise ValueError("method 'Adams' varies its steps: leave step_size out, or take another method")
        theta = min(LARGEST_MOVE, max(least_tolerance(rtol, atol), 1e-13))
        return Plan(
            kernels.adams_step,
            np.array([theta]),
            np.zeros(kernels.memory_size(n_q)),
            exponent=1.0,  # the step returns the root of its error that belongs to its order
            safety=kernels.SAFETY,
            factor_min=0.1,
            factor_max=kernels.START_GROWTH,
        )

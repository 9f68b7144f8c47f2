"""Adams(): a multistep method on the accelerations of all coordinates."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from twoloop.methods.plan import LARGEST_MOVE, Plan

# stability limits for orders 1 to 12: h times the frequency of a vibration that grows by 1 % per step; and h times a
# rate of decay (above order 6: the limit of order 6, because the order falls when decay limits the steps)
STABLE_TO = tuple(
    zip(
        (2.01, 2.01, 0.92, 0.97, 1.09, 1.23, 1.28, 1.13, 1.00, 0.89, 0.79, 0.71),
        (2.01, 2.41, 1.96, 1.43, 1.06, 0.79, 0.79, 0.79, 0.79, 0.79, 0.79, 0.79),
        strict=True,
    )
)


@dataclass(frozen=True)
class Adams:
    """Adams methods of orders 1 to 12, predict-evaluate-correct-evaluate, for smooth motion that is not stiff.

    With two evaluations per step, it is cheap where evaluations cost much and the motion, not a stiff force,
    determines the steps. All coordinates are integrated alike from their accelerations: positions by the double
    integral of the polynomial through the last accelerations, velocities by the single integral. The end of every step
    is moved to the nearest state on the constraints, in the metric of M; with nonholonomic rows, to the state with the
    same independent coordinates. The method thus departs from the paper, whose outer loop has only independent
    coordinates, and a new partition does not interrupt the method.

    It starts by itself, with order 1 and a short step. After a run of many steps, a test at a few states shows whether
    stability rather than accuracy limited the steps. If so, `result.message` says so and names other methods.

    Notes
    -----
    Modified divided differences: F. T. Krogh, Changing stepsize in the integration of differential equations using
    modified divided differences, Lecture Notes in Mathematics 362 (1974), 22-71. The rules for the order are those of
    STEP: L. F. Shampine and M. K. Gordon, Computer Solution of Ordinary Differential Equations (1975). But the step
    size is not halved or doubled: it is multiplied by 0.8 e^(-1/(k+1)), where e is the estimated error divided by the
    tolerance, at most by 1.2 (2 while the order still rises with every step), and after a rejected step at least by
    0.5. The integrals of the polynomials are computed by Gauss quadrature with eight nodes, which is exact for them.

    Examples
    --------
    >>> from twoloop import solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method="Adams")
    >>> result.success
    True
    """

    name: ClassVar[str] = "Adams"
    takes_code: ClassVar[bool] = True

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates; the first steps need a variable size to reach their order."""
        from twoloop.kernels.steps import adams_step as kernels

        if fixed:
            raise ValueError(
                "method='Adams' begins with short steps of low order and cannot keep a constant one: leave step_size "
                "out, or take another method"
            )
        return Plan(
            kernels.ADAMS,
            np.array([LARGEST_MOVE]),
            np.zeros(kernels.memory_size(n_q)),
            checks_within=True,
            projects=True,
            exponent=1.0,  # not used: the order varies, and the step returns the ratio of step sizes for its order
            stable_to=lambda memory: STABLE_TO[int(memory[kernels.ORDER]) - 1],
        )

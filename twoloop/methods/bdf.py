"""BDF(...): backward differentiation formulas in the two-loop procedure."""

from dataclasses import dataclass

import numpy as np

from twoloop.checks.arguments import check_size
from twoloop.methods.plan import INNER_TOL, Plan, check_tolerances, outer_tolerance
from twoloop.methods.tableaux import gauss

BDF_HIGHEST = 5  # order; the formula of order 6 is next to unstable, those beyond are


@dataclass(frozen=True)
class BDF:
    """Two-loop procedure with backward differentiation formulas of variable step and order (the paper's outlook).

    Of y' = f(y), y = [q_i, v_i], each step solves y = p + c (f(y) - p'), where p extrapolates the last k + 1 points and
    c = h / (1 + 1/2 + ... + 1/k). The outer loop is a fixed-point iteration on the independent accelerations; every
    evaluation has the inner loop within it. Two to three evaluations make a step. At equal tolerance errors are larger
    than those of `RungeKutta`: compare at equal error. It is for few digits.

    With step-size control a run begins with order 1 and a small step. A step is accepted when the largest component of
    the estimated local error of q and v, dependents too, is within the tolerance. Fixed steps have the order
    max_order from the first on; 3-stage Gauss steps make the history that it needs.

    What to expect of undamped motion: small oscillations lose energy with orders 1, 2 and 5 and gain it with 3 and 4,
    at the rate of the truncation error; large ones may do either from order 3 on. The fixed point limits h to about
    the reciprocal of the largest frequency or rate of decay: stiff problems need small steps.

    The matrices are sparse where systems are large: then all coordinates are integrated, and the end of each step is
    put on the constraints.

    Parameters
    ----------
    max_order : int
        Highest order, 1 to 5.
    inner_tol : float, optional
        Newton on the positions stops when its largest correction, just made, is at most this (unit of q). None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when no independent velocity or position would change by more than this, relative to
        max(|value|, 1), but not before one correction. None: 0.01 min(rtol, atol); with fixed steps 1e-14.

    Raises
    ------
    TypeError, ValueError
        If max_order is not an int from 1 to 5, or a tolerance is not positive.

    Notes
    -----
    Sect. 5 of the paper proposes BDF as further work and leaves its form open; all of it is chosen here. Modified
    divided differences with fixed leading coefficient, and their error estimate: Brenan, Campbell and Petzold,
    Numerical Solution of Initial-Value Problems in DAEs (1996), on DASSL. Unlike the backward differences on an
    equidistant history of Shampine and Reichelt (1997) they need no interpolation when the step size changes. The order
    is that of the largest next step, as in VODE. Stability and error constants: Hairer, Norsett and Wanner, Solving
    ODEs I (1993), chapter III.

    Examples
    --------
    >>> from twoloop import BDF, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    >>> result = solve_dae(*run, method=BDF(max_order=4), rtol=1e-5, atol=1e-5)
    >>> result.success
    True
    """

    max_order: int = 5
    inner_tol: float | None = None
    outer_tol: float | None = None

    def __post_init__(self) -> None:
        check_size("max_order", self.max_order, 1)
        if self.max_order > BDF_HIGHEST:
            raise ValueError(f"max_order must be at most {BDF_HIGHEST}; given {self.max_order!r}")
        check_tolerances(self, "inner_tol", "outer_tol")

    @property
    def name(self) -> str:
        """Shown in messages and tables."""
        return f"BDF(max_order={self.max_order})"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels.steps import bdf_step as kernels

        inner_tol = INNER_TOL if self.inner_tol is None else self.inner_tol
        outer_tol = outer_tolerance(rtol, atol, fixed) if self.outer_tol is None else self.outer_tol
        return Plan(
            kernels.BDF,
            kernels.options_array(self.max_order, inner_tol, outer_tol, gauss(kernels.STARTER_STAGES)),
            np.zeros(kernels.memory_size(n_q)),
            exponent=1.0,  # not used: the order varies, and with it the factor, which the step returns
            projects=True,
            apart=True,
        )

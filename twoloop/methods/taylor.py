"""Taylor(): the Taylor series of the motion, derived from the equations of the callbacks."""

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import check_size
from twoloop.generate.compile_equations import GeneratedCode
from twoloop.generate.graph import Untraceable
from twoloop.generate.series import SeriesProgram, series_for
from twoloop.generate.traced_values import Check, accept_traces
from twoloop.methods.plan import LARGEST_MOVE, Plan, least_tolerance
from twoloop.problem.system import ConstrainedSystem

Array = NDArray[np.float64]

LOWEST_ORDER, HIGHEST_ORDER = 4, 40  # limits of the option `order`
# order of the series: LEAST_ORDER plus ORDER_PER_DIGIT for each digit of the tolerance; cheapest order in the benchmark
ORDER_PER_DIGIT, LEAST_ORDER = 1.15, 5.0
ORDER_PER_DIGIT_IN_LANES, LEAST_ORDER_IN_LANES = 1.25, 3.5  # ORDER_PER_DIGIT and LEAST_ORDER in SIMD lanes
FIXED_STEP_ORDER = 19  # order of fixed steps
# smallest and largest number of parts into which a step is divided for the solution within it; the states between parts
# are values of the step's series, projected onto the constraints
MIN_PARTS, MAX_PARTS = 3, 6
PADDING = 8  # a table is padded to a multiple of this number of operations


def order_in_lanes(rtol: float, atol: float) -> int:
    """Return the order of the series in SIMD lanes at these tolerances."""
    return _order(rtol, atol, LEAST_ORDER_IN_LANES, ORDER_PER_DIGIT_IN_LANES)


def _order(rtol: float, atol: float, least: float, per_digit: float) -> int:
    return math.ceil(least + per_digit * max(-math.log10(least_tolerance(rtol, atol)), 0.0))


@dataclass(frozen=True)
class Taylor:
    """Taylor series of the motion, with an order that the tolerance sets, for smooth motion that is not stiff.

    It suits tight tolerances without generated code. The callbacks run once in Python on symbols; this takes
    milliseconds and compiles nothing. The coefficients of q, v, a and lam follow from the recorded operations, order by
    order. Each order takes one linear solution with the matrix of the accelerations, and no derivative of the
    constraints beyond C_q. gamma and kinematics are not used. A step is as long as the series allows. Its end is moved
    to the nearest state on the constraints, in the metric of M. The method thus departs from the paper, whose outer
    loop has only independent coordinates.

    Callbacks must not branch on t, q or v, and must consist of + - * /, powers, sin, cos, tan, sqrt, hypot, exp, log,
    atan, sinh, cosh and tanh. Otherwise `solve_dae` raises ValueError and names the callback.

    Parameters
    ----------
    order : int, optional
        Order of the method, 4 to 40: velocities are a series of this order, positions a series of the next order. None:
        5 plus 1.15 for each digit of the smaller tolerance, or 19 with fixed steps.

    Raises
    ------
    TypeError, ValueError
        If order is not an int from 4 to 40.

    Notes
    -----
    Number of derivatives of each equation: J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001),
    364-394. The step size, with which each of the last two terms is within the tolerance: A. Jorba and M. Zou, A
    software package for the numerical integration of ODEs by means of high-order Taylor methods, Experimental
    Mathematics 14 (2005), 99-117. In the statistics, every order counts as an evaluation.

    Examples
    --------
    >>> from twoloop import Taylor, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method=Taylor(order=12))
    >>> result.success
    True
    """

    takes_code: ClassVar[bool] = True
    order: int | None = None
    program: SeriesProgram | None = None  # program of one system; solve_dae sets it

    def __post_init__(self) -> None:
        if self.order is not None and not LOWEST_ORDER <= check_size("order", self.order, 1) <= HIGHEST_ORDER:
            raise ValueError(f"order must be between {LOWEST_ORDER} and {HIGHEST_ORDER}; given {self.order}")

    @property
    def name(self) -> str:
        """Return the name of the method for messages and tables."""
        return "Taylor" if self.order is None else f"Taylor(order={self.order})"

    def for_system(
        self, system: ConstrainedSystem, code: GeneratedCode | None = None, check: Check = accept_traces
    ) -> "Taylor":
        """Return the method with the series program of a system; `code` is not used.

        Raises
        ------
        ValueError
            If callbacks do not run on symbols, or `check` finds that their traces differ from calls.
        """
        try:
            program = series_for(system, check)
        except Untraceable as error:
            raise ValueError(
                f"method='Taylor' needs callbacks whose operations it can see; {error}. Take 'Adams' or 'DOP853'"
            ) from error
        return replace(self, program=program)

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.steps import taylor_step as kernels

        program = self.program
        if program is None:
            raise ValueError("Taylor() knows no system yet: take for_system(system), as solve_dae does")
        order = self.order
        if order is None and fixed:
            order = FIXED_STEP_ORDER
        elif order is None:
            order = _order(rtol, atol, LEAST_ORDER, ORDER_PER_DIGIT)
        highest = order + 1
        widths = [-(-len(table.first.column) // PADDING) * PADDING for table in (program.early, program.late)]
        plan = Plan(
            kernels.TAYLOR,
            _options(program, highest, widths),
            np.zeros(kernels.memory_size(highest, n_q, program.n_rows, program.n_nodes, *widths)),
            exponent=1.0 / highest,
            safety=1.0,
            factor_max=kernels.MAX_GROWTH,
            checks_within=True,
            projects=True,
            evaluates_within=True,
            parts=min(max(highest // 3, MIN_PARTS), MAX_PARTS),
            traced=(program.traced,),
        )
        interior_options = plan.options.copy()
        interior_options[kernels.KEEP] = 1.0
        return plan.changed(interior=plan.changed(options=interior_options, memory=plan.memory.copy()))


def _options(program: SeriesProgram, highest: int, widths: list[int]) -> Array:
    """Return the options of a step as one array of floats, in which integers are stored by their bits."""
    from twoloop.kernels.steps import taylor_step as kernels

    tables = [[table.groups.ravel(), *table.first, *table.second] for table in (program.early, program.late)]
    arrays: list[Any] = [*tables[0], *tables[1], *program.rows, program.row_indices]
    arrays += [*program.balance, program.balance_indices]
    arrays = [each.view(np.float64) if each.dtype == np.int64 else each for each in arrays]
    scalars = np.zeros(kernels.N_SCALARS)
    scalars[kernels.ORDER], scalars[kernels.THETA], scalars[kernels.N_NODES] = highest, LARGEST_MOVE, program.n_nodes
    scalars[kernels.EARLY_WIDTH], scalars[kernels.LATE_WIDTH] = widths
    begin = kernels.N_SCALARS + kernels.N_ARRAYS + 1
    ends = begin + np.cumsum([0, *(len(each) for each in arrays)])
    return np.concatenate([scalars, ends.astype(float), *arrays])

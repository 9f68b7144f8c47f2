"""Methods of the paper: Newmark and BDF in the two-loop procedure, and its two procedures exactly as printed."""

from dataclasses import dataclass

import numpy as np

from twoloop.checks.arguments import check_number, check_positive, check_size
from twoloop.methods.plan import INNER_TOL, Plan, check_tolerances, outer_tolerance
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import gauss, sun_radau_iib

MIN_DISTANCE = 0.02  # Newmark's error estimate has the factor |beta - 1/6|, and can be used if this is not smaller
# ratio of the outer tolerance to err_out; the iterations converge so fast that a small ratio costs hardly anything
OUTER_TO_ERROR_TOL = 1e-3


@dataclass(frozen=True)
class Newmark:
    """Two-loop procedure with Newmark's method; the outer loop is a fixed-point iteration on independent accelerations.

    Parameters
    ----------
    beta, gamma : float
        Parameters of (12), in which beta = 1/4 is the average-acceleration method. Fixed steps are required if gamma is
        not 1/2, or if beta is near 1/6, where the error estimate vanishes.
    error_tol : float, optional
        err_out of the paper: a step is accepted when e = |beta - 1/6| h^2 ||a_{n+1} - a_n||_2 is at most this, and the
        error of a run is proportional to error_tol^(2/3); steps are shortened to end at output times. None: a step is
        accepted when the largest component of e / h, the error per unit time, is at most r atol + rtol |v|, so that the
        error of a run is proportional to the tolerance. 1 / r is the time in which the largest velocity, or
        acceleration, so far would change a coordinate by its largest value so far. r is not in the paper; it does not
        become zero, whatever the origin of the coordinates.
    inner_tol : float, optional
        Newton's method for the positions stops after a correction of at most inner_tol (unit of q). None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when no independent velocity or position would change by more than this, relative to
        max(|value|, 1). None: 1e-3 error_tol or 0.01 min(rtol, atol); with fixed steps 1e-14.

    Raises
    ------
    TypeError, ValueError
        If a parameter is out of range.

    Examples
    --------
    >>> from twoloop import Newmark, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    >>> result = solve_dae(*run, method=Newmark(beta=0.25), rtol=1e-4, atol=1e-4)
    >>> result.success
    True
    """

    beta: float = 0.25
    gamma: float = 0.5
    error_tol: float | None = None
    inner_tol: float | None = None
    outer_tol: float | None = None

    def __post_init__(self) -> None:
        for name in ("beta", "gamma"):
            value = check_number(name, getattr(self, name))
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be between 0 and 1; given {value!r}")
        check_tolerances(self, "error_tol", "inner_tol", "outer_tol")

    @property
    def name(self) -> str:
        """Return the name of the method for messages and tables."""
        return f"Newmark(beta={self.beta:g}, gamma={self.gamma:g})"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.paper import newmark_step as kernels

        if not fixed and (abs(self.beta - 1.0 / 6.0) < MIN_DISTANCE or self.gamma != 0.5):
            raise ValueError(
                f"Newmark with beta = {self.beta:g}, gamma = {self.gamma:g} has no error estimate: |beta - 1/6| h^2 "
                f"|da| needs gamma = 1/2 and |beta - 1/6| >= {MIN_DISTANCE:g}. Give step_size for fixed steps, or take "
                "beta = 1/4, gamma = 1/2"
            )
        if self.outer_tol is not None:
            outer_tol = self.outer_tol
        elif self.error_tol is not None and not fixed:
            outer_tol = OUTER_TO_ERROR_TOL * self.error_tol
        else:
            outer_tol = outer_tolerance(rtol, atol, fixed)
        options = np.zeros(kernels.N_OPTIONS)
        options[kernels.BETA] = self.beta
        options[kernels.GAMMA] = self.gamma
        options[kernels.INNER_TOL] = INNER_TOL if self.inner_tol is None else self.inner_tol
        options[kernels.OUTER_TOL] = outer_tol
        options[kernels.ERROR_TOL] = 0.0 if self.error_tol is None else self.error_tol
        return Plan(
            kernels.NEWMARK,
            options,
            np.zeros(kernels.N_MEMORY_SCALARS + n_q),
            exponent=1.0 / 2.0 if self.error_tol is None else 1.0 / 3.0,
            factor_min=0.5,
            limit_start=1.0 if self.error_tol is not None else np.inf,
            ends_at_outputs=self.error_tol is not None,
            separate=True,
        )


BDF_HIGHEST = 5  # highest order of BDF; the formula of order 6 is almost unstable, higher orders are unstable


@dataclass(frozen=True)
class BDF:
    """Two-loop procedure with backward differentiation formulas of variable step and order, as the paper proposes.

    For y' = f(y), y = [q_i, v_i], each step solves y = p + c (f(y) - p'). Here p extrapolates the last k + 1 points,
    and c = h / (1 + 1/2 + ... + 1/k). The outer loop is a fixed-point iteration on the independent accelerations; every
    evaluation contains the inner loop. A step takes two to three evaluations. At equal tolerance, errors are larger
    than with `RungeKutta`: compare at equal error. The method is meant for few digits.

    With step-size control a run begins with order 1 and a small step. A step is accepted when the largest component of
    the estimated local error of q and v, including dependent entries, is within the tolerance. Fixed steps have the
    order max_order from the beginning; 3-stage Gauss steps compute the past points that this order needs.

    In undamped motion, small oscillations lose energy with orders 1, 2 and 5 and gain energy with orders 3 and 4, at
    the rate of the truncation error; large ones may lose or gain energy with orders 3 to 5. The fixed-point iteration
    limits h to about the reciprocal of the largest frequency or rate of decay, so that stiff problems need small steps.

    For large systems with sparse matrices, all coordinates are integrated, and the end of each step is moved onto the
    constraints.

    Parameters
    ----------
    max_order : int
        Highest order, 1 to 5.
    inner_tol : float, optional
        Newton's method for the positions stops after a correction of at most inner_tol (unit of q). None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when no independent velocity or position would change by more than this, relative to
        max(|value|, 1), but not before one correction. None: 0.01 min(rtol, atol); with fixed steps 1e-14.

    Raises
    ------
    TypeError, ValueError
        If max_order is not an int from 1 to 5, or a tolerance is not positive.

    Notes
    -----
    Sect. 5 of the paper proposes BDF as further work and leaves its form open, so that the details are chosen here.
    Modified divided differences with fixed leading coefficient, and their error estimate: Brenan, Campbell and Petzold,
    Numerical Solution of Initial-Value Problems in DAEs (1996), on DASSL. They need no interpolation when the step size
    changes, unlike the backward differences on an equidistant history of Shampine and Reichelt (1997). The next order
    is the one that allows the largest step, as in VODE. Stability and error constants: Hairer, Norsett and Wanner,
    Solving ODEs I (1993), chapter III.

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
        """Return the name of the method for messages and tables."""
        return f"BDF(max_order={self.max_order})"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.paper import bdf_step as kernels

        inner_tol = INNER_TOL if self.inner_tol is None else self.inner_tol
        outer_tol = outer_tolerance(rtol, atol, fixed) if self.outer_tol is None else self.outer_tol
        return Plan(
            kernels.BDF,
            kernels.options_array(self.max_order, inner_tol, outer_tol, gauss(kernels.STARTER_STAGES)),
            np.zeros(kernels.memory_size(n_q)),
            exponent=1.0,  # not used: the order varies, and the step returns the ratio of step sizes for its order
            projects=True,
            separate=True,
        )


def paper_irk(inner_tol: float = 1e-9, outer_tol: float = 1e-9) -> RungeKutta:
    """Return the paper's procedure with Sun's 3-stage Radau IIB; run it with rtol = atol = 1e-5 to follow Sect. 4.1.

    As printed: coordinate partitioning by LU; eqs. (14), (15) for the dependent coordinates at every stage; explicit
    Euler prediction; the outer loop ends by (32) and is given up by (33); the error is (26), (27), the undivided
    difference between one step and two half steps; the next step size by (31), (34) with fac = 0.9, facmax = 5,
    facmin = 0.5 and h_max = 1 s at the beginning of each step; after (33) h_max = h and the step is halved.

    Where this differs from the printed text, and why:

    - (32): the printed denominator max(Delta(y_i), 1) compares a difference with itself; max(|y_i|, 1) is used. Sect.
      3.1 and 3.2 base the criterion on y_i and y_d, Sect. 3.3 on y_i only. The former is followed: counts then grow
      along the tolerance of (32) as the printed times do along err_in (reports/table3.md), and at 1e-3 the solution
      is still usable. `outer_test="independent"` is the other reading.
    - (26): "Rotol" is read as Rtol. (27): n is 2 n_q, because z holds positions and velocities.
    - (28)-(34): the undefined q is the order 5, so the exponent is 1/6.
    - Sect. 3.1 says that y_{n+1} is iterated; a Runge-Kutta method iterates the K_i, and so does this method. Step 2 of
      the paper predicts K_i = f(t_n + c_i h, y_{n+1}); here one K, at (t_{n+1}, y_{n+1}), predicts all K_i.
    - Left open by the text and chosen: the K_i are calculated one after another, each with the latest values of the
      others, as the loop is printed; the accepted state is the end of the two half steps; Newton starts from the last
      iterate of the same stage; err_in bounds the largest correction; there are at most 200 iterations; solve_dae
      chooses the first step size; c_3 = 1, b_3 = 1/9 and a_33 = 1/18, lost in print.
    - A step also ends as after (33) when the inner loop does not converge: after 25 iterations, a correction of more
      than half the previous one, or a singular C_qd.
    - "Once in a time step or several time steps": the partition is checked after every step. It is chosen anew when
      max|C_qd^-1 C_qi| has grown to three times its first value, or when a step failed in the inner loop.
    - Steps are shortened to end at output times and at the end of the run.
    - A step is also rejected if the force jumps between its start and the first stage: neither the step nor its halves
      evaluate the force before the jump, so that errors of 1e5 tolerances were not noticed.

    Parameters
    ----------
    inner_tol, outer_tol : float
        err_in (largest Newton correction of a position) and err_out (epsilon_tol of (32)).

    Examples
    --------
    >>> from twoloop import paper_irk, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    >>> result = solve_dae(*run, method=paper_irk(1e-9, 1e-7), rtol=1e-5, atol=1e-5)
    >>> result.success
    True
    """
    return RungeKutta(sun_radau_iib(3), "paper", "richardson-paper", inner_tol, outer_tol)


def paper_newmark(inner_tol: float = 1e-9, outer_tol: float = 1e-9, beta: float = 0.5) -> Newmark:
    """Return the two-loop procedure with Newmark's method, as the paper uses it for comparison; beta = 1/2 as printed.

    As printed: (12) with beta = gamma = 1/2; the outer loop by (11) and (12) with the inner loop between them.

    Where this differs from the printed text, and why:

    - In the form (12), the average-acceleration method has beta = 1/4, not 1/2, with which the leading error is four
      times larger. Both values can be chosen; the printed value is the default.
    - The paper refers to Hussein and Shabana for error control and convergence. err_out is taken as the tolerance
      of the local error |beta - 1/6| h^2 ||a_{n+1} - a_n||_2 (Zienkiewicz and Xie 1991), with the step factor
      0.9 (err_out / error)^(1/3) between 0.5 and 5 and h_max = 1 s: with other choices the cost does not grow as in
      Table 3. After a step that did not converge h is halved, and h_max is 0.7 h for ten steps.
    - The outer loop stops when y_i would change by less than err_out / 1000, relative to max(|y_i|, 1); it is given
      up when the differences grow.
    - Newton starts from the Taylor polynomial of the dependent coordinates, not from the last position.
    - As in `paper_irk`, the partition is renewed, and steps are shortened to end at output times.

    Parameters
    ----------
    inner_tol, outer_tol : float
        err_in (largest Newton correction of a position) and err_out (tolerance of the step error, unit of q).
    beta : float
        Parameter of (12).

    Examples
    --------
    >>> from twoloop import paper_newmark, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    >>> result = solve_dae(*run, method=paper_newmark(1e-9, 1e-5), rtol=1e-5, atol=1e-5)
    >>> result.success
    True
    """
    check_positive("outer_tol", outer_tol)
    return Newmark(beta=beta, gamma=0.5, error_tol=outer_tol, inner_tol=inner_tol)

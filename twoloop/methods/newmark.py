"""Newmark(...): Newmark's method in the two-loop procedure."""

from dataclasses import dataclass

import numpy as np

from twoloop.checks.arguments import check_number
from twoloop.methods.plan import INNER_TOL, Plan, check_tolerances, outer_tolerance

NO_ESTIMATE = 0.02  # of |beta - 1/6|, below which Newmark's estimate sees no error
NEWMARK_OUTER_SHARE = 1e-3  # of err_out; its fixed-point iterations converge so fast that this costs next to nothing


@dataclass(frozen=True)
class Newmark:
    """Two-loop procedure with Newmark's method, the outer loop by fixed point on the independent accelerations.

    Parameters
    ----------
    beta, gamma : float
        Parameters of (12), in which beta = 1/4 is the average-acceleration method. Other gamma than 1/2, and beta
        near 1/6, for which the error estimate vanishes, go with fixed steps only.
    error_tol : float, optional
        err_out of the paper: a step is accepted when e = |beta - 1/6| h^2 ||a_{n+1} - a_n||_2 is at most this, and the
        error of a run goes with error_tol^(2/3); steps are shortened to end at output times. None: when the largest
        component of e / h, the error per unit step, is at most r atol + rtol |v|, so that the error of a run is
        proportional to the tolerance. 1 / r is the time in which the largest velocity, or acceleration, so far would
        change a coordinate by the largest value so far. r is not in the paper; it does not become zero, whatever the
        origin of the coordinates.
    inner_tol : float, optional
        Newton on the positions stops when its largest correction, just made, is at most this. None: 1e-8.
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
        """Shown in messages and tables."""
        return f"Newmark(beta={self.beta:g}, gamma={self.gamma:g})"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels.steps import newmark_step as kernels

        if not fixed and (abs(self.beta - 1.0 / 6.0) < NO_ESTIMATE or self.gamma != 0.5):
            raise ValueError(
                f"Newmark with beta = {self.beta:g}, gamma = {self.gamma:g} has no error estimate: |beta - 1/6| h^2 "
                f"|da| needs gamma = 1/2 and |beta - 1/6| >= {NO_ESTIMATE:g}. Give step_size for fixed steps, or take "
                "beta = 1/4, gamma = 1/2"
            )
        if self.outer_tol is not None:
            outer_tol = self.outer_tol
        elif self.error_tol is not None and not fixed:
            outer_tol = NEWMARK_OUTER_SHARE * self.error_tol
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
            lands=self.error_tol is not None,
            apart=True,
        )

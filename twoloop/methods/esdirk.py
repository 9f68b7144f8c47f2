"""ESDIRK(...): diagonally implicit Runge-Kutta methods in the two-loop procedure, for stiff problems and few digits."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twoloop.methods.plan import INNER_TOL, LEAST_ERROR, Plan, check_choices, check_tolerances, least_tolerance

Array = NDArray[np.float64]

OUTER_SHARE = 3.0  # of the tolerance: the correction that is this small is still made, and convergence is quadratic
LOOSEST_OUTER = 3e-3  # relative: with larger corrections stiff problems are solved so badly that steps become short
FEW_STEPS = 1e-3  # tolerance below which the share is smaller by the number of steps over which corrections add up
OUTER_TOL_FIXED = 1e-12  # relative; stiff forces magnify rounding
SAFETY = 0.8  # with 0.9 one attempt in seven is refused where the motion is not smooth, as of the stiff beam


def _trbdf2() -> tuple[Array, Array]:
    """A and the embedded weights of TR-BDF2: Hosea and Shampine, Applied Numerical Mathematics 20 (1996), 21-37."""
    g, w = 1.0 - np.sqrt(0.5), np.sqrt(2.0) / 4.0
    return np.array([[0.0, 0.0, 0.0], [g, g, 0.0], [w, w, g]]), np.array([(1.0 - w) / 3.0, w + 1.0 / 3.0, g / 3.0])


def _esdirk4() -> tuple[Array, Array]:
    """A and the embedded weights of ESDIRK4(3)6L[2]SA: Kennedy and Carpenter, NASA/TM-2016-219173."""
    g = 0.25
    A = np.zeros((6, 6))
    A[1, :1] = g
    A[2, :2] = 8611 / 62500, -1743 / 31250
    A[3, :3] = 5012029 / 34652500, -654441 / 2922500, 174375 / 388108
    A[4, :4] = 15267082809 / 155376265600, -71443401 / 120774400, 730878875 / 902184768, 2285395 / 8070912
    A[5, :5] = 82889 / 524892, 0.0, 15625 / 83664, 69875 / 102672, -2260 / 8211
    A[range(1, 6), range(1, 6)] = g
    embedded = [4586570599 / 29645900160, 0.0, 178811875 / 945068544, 814220225 / 1159782912]
    return A, np.array([*embedded, -3700637 / 11593932, 61727 / 225920])


FORMULAS = {"TRBDF2": (_trbdf2, 2), "ESDIRK4": (_esdirk4, 4)}  # and their orders


def _jump_weights(c: Array) -> Array:
    """Weights of ESDIRK4's stages, exact for accelerations quadratic in time, to which no place of a jump is hidden.

    What they add up to over the stages behind a jump is about half of what the step is wrong by at most.
    """
    order = np.argsort(c)
    at = c[order]
    behind = np.array([0.1392, 0.0, -0.16, -0.16, 0.0])  # the second and the last follow from exactness
    moments = np.array([np.diff(at), np.diff(at**2)])
    behind[[1, 4]] = np.linalg.solve(moments[:, [1, 4]], -moments @ behind)
    weights = np.zeros(len(c))
    weights[order] = np.diff(-np.concatenate([[0.0], behind, [0.0]]))
    return weights


LOWER = {"TRBDF2": np.zeros(3), "ESDIRK4": _jump_weights(_esdirk4()[0].sum(axis=1))}
# `rough` of their plans: the weights of ESDIRK4 differ from the embedded ones by 0.04 at most, and if a force jumps in
# the first half of a step, the estimate is 1/300 of the error
ROUGH = {"TRBDF2": 1.0, "ESDIRK4": 300.0}


@dataclass(frozen=True)
class ESDIRK:
    """Two-loop procedure with diagonally implicit stages, each by Newton's method: few digits of stiff problems.

    The stages are solved one after another, each with derivatives at its own iterates where the system gives tangents.
    Without them they are differenced, and kept while Newton's method contracts fast and the error estimate finds them
    right. A matrix of an earlier state stops contracting once stiff directions have turned;
    `RungeKutta(..., outer="newton")`, whose stages share one matrix, is held to short steps by that at loose
    tolerances, and is the better one at tight tolerances.

    Both formulas are L-stable and end with their last stage. With step-size control "TRBDF2" goes on from its embedded
    formula, of order 3: the difference, filtered for stiff components three times, is L-stable, too. A step is accepted
    when the estimated error of the positions, from the embedded formula and filtered, is within the tolerance, and so
    is the error that the velocities will add to them before it turns back or decays (ten times that if it does so no
    faster than the motion changes), and what is left of it some steps later, over the time in which the motion changes.
    ESDIRK4 has a second embedded formula for forces that jump within a step, which the first hardly shows.
    Vibrations that the steps pass over are damped. Velocities themselves are tested with `tested="all"`.

    Parameters
    ----------
    formula : {"TRBDF2", "ESDIRK4"}
        Order 2 with two implicit stages, or order 4 with five.
    inner_tol : float, optional
        Newton on the dependent positions stops when its largest correction, just made, is at most this (unit of q).
        None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when the correction just made changes no independent position by more than this, relative
        to max(|value|, 1). None: 3 min(rtol, atol), at most 3e-3, and below tolerances of 1e-3 less by the number of
        steps over which such corrections add up; with fixed steps 1e-12.
    tested : {"all", "positions"}
        What the error estimate is taken over: positions and velocities, or positions and what velocities make of them.
        Stiff vibrations that do not matter show in the velocities; "positions" passes over them.

    Raises
    ------
    TypeError, ValueError
        If formula is not one of these, or a tolerance is not positive.

    Notes
    -----
    TR-BDF2 and the filter of its estimate: M. E. Hosea and L. F. Shampine, Applied Numerical Mathematics 20 (1996),
    21-37. ESDIRK4(3)6L[2]SA: C. A. Kennedy and M. H. Carpenter, NASA/TM-2016-219173. SDIRK methods for the state-space
    form of mechanisms: D. Negrut, E. J. Haug and H. C. German, Multibody System Dynamics 9 (2003), 121-142.

    Examples
    --------
    >>> from twoloop import ESDIRK, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> run = problem.system, (0.0, 1.0), problem.q0, problem.v0
    >>> result = solve_dae(*run, method=ESDIRK("TRBDF2"), rtol=1e-4, atol=1e-4)
    >>> result.success
    True
    """

    formula: Literal["TRBDF2", "ESDIRK4"] = "TRBDF2"
    inner_tol: float | None = None
    outer_tol: float | None = None
    tested: Literal["all", "positions"] = "positions"

    def __post_init__(self) -> None:
        check_choices(self)
        check_tolerances(self, "inner_tol", "outer_tol")

    @property
    def name(self) -> str:
        """Shown in messages and tables."""
        return self.formula if self.tested == "positions" else f"{self.formula}, velocities tested"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels.steps.diagonal_stage import diagonal_memory, diagonal_options
        from twoloop.kernels.steps.named_step import NamedStep
        from twoloop.kernels.steps.newton_memory import n_matrices

        make, order = FORMULAS[self.formula]
        A, embedded = make()
        exponent = 1.0 / (3.0 if order == 2 else 4.0)
        outer_tol = OUTER_TOL_FIXED if self.outer_tol is None else self.outer_tol
        if self.outer_tol is None and not fixed:
            tolerance = least_tolerance(rtol, atol)
            outer_tol = min(OUTER_SHARE * tolerance, LOOSEST_OUTER) * min(1.0, (tolerance / FEW_STEPS) ** exponent)
        inner_tol = INNER_TOL if self.inner_tol is None else self.inner_tol
        return Plan(
            NamedStep("diagonal_step", "DIAGONAL"),
            diagonal_options(
                A,
                A.sum(axis=1),
                A[-1] - embedded,
                LOWER[self.formula],
                inner_tol,
                outer_tol,
                self.tested == "all",
                order == 2,
            ),
            diagonal_memory(len(embedded), n_q),
            matrices=n_matrices(1),
            projects=True,
            exponent=exponent,
            safety=SAFETY,
            least_error=LEAST_ERROR,
            rough=ROUGH[self.formula],
        )

"""DOP853(...): an explicit method in the two-loop procedure."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twoloop.methods import dop853_tableau as tableau
from twoloop.methods.plan import INNER_TOL, LARGEST_MOVE, ROUGH, Plan, check_choices, check_tolerances, least_tolerance

COARSE_SHARE = 0.1  # of the estimate of order 3 beside that of order 5
REUSE = 1e-4  # of the tolerance: how far off a stage may be from the position of the Jacobian that its velocities use
LEAST_ERROR = 1e-6  # of the tolerance, in the trend: an error of order 8 falls a hundredfold with steps half as long
SEEN = tableau.C[(tableau.B != 0.0) | (tableau.E5 != 0.0) | (tableau.E3 != 0.0)]  # stages that count
UNSEEN = float(np.diff([*np.sort(SEEN), 1.0]).max())  # of a step, between two of them: 4/15
STABLE_TO = (5.96, 6.39)  # h times the frequency of a vibration, and times a rate of decay
SAFETY = 0.8  # with 0.9 twice as many steps are rejected, and at equal error it costs about a tenth more


@dataclass(frozen=True)
class DOP853:
    """An explicit Runge-Kutta method, Dormand and Prince's, of order 8, with 12 stages.

    It is for smooth motion that is not stiff. There is no outer loop. Every stage is one evaluation, so a step costs 12
    evaluations, and a rejected one 11. Accepted states are on the constraints.

    If the motion is slower than what could vibrate or decay, stability, not accuracy, limits the step h: h w_max to
    5.96 for undamped vibrations, and h times the largest rate of decay to 6.39. Vibrations that such steps hardly
    resolve are damped, by 0.15 % of the amplitude per step at h w_max = 3. If stability limited many steps,
    `result.message` says so and names other methods.

    A step is accepted when the largest component of the estimated local error of q and v, including the dependent
    ones, is within the tolerance. Fixed steps have no error estimate.

    Parameters
    ----------
    stages : {"free", "restored"}
        "free": all coordinates are integrated alike, stages are off the constraints by the error of the formula, and
        the end of the step is moved to the nearest state on them, in the metric of M. This departs from the paper.
        "restored": the paper's procedure with this tableau. The independent coordinates are integrated, and the inner
        loop restores the dependent ones at every stage. Rows of nonholonomic constraints are always treated so at the
        end of a step.
    inner_tol : float, optional
        With "restored", Newton on the positions stops when its largest correction, just made, is at most this (unit of
        q). None: 1e-8.

    Raises
    ------
    TypeError, ValueError
        If stages is not one of these, or inner_tol not a positive number.

    Notes
    -----
    Tableau and error estimate, e5^2 / sqrt(e5^2 + 0.01 e3^2) of embedded estimates of orders 5 and 3: Hairer, Norsett
    and Wanner, Solving ODEs I (1993), II.5 and II.10; e5 and e3 are largest components here, not root mean squares.
    From where a run has come near a singular position, the square root of e5 / sqrt(e5^2 + 0.01 e3^2) takes the place
    of this quotient, as terms of high order are not small there. The numbers are those of SciPy's `DOP853`. The
    stability limits are those of the method's polynomial R(z): |R| <= 1 on the imaginary axis up to 5.96 i, on the
    real one down to -6.39.

    Examples
    --------
    >>> from twoloop import DOP853, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> problem = four_bar()
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method=DOP853("restored"))
    >>> result.success
    True
    """

    stages: Literal["free", "restored"] = "free"
    inner_tol: float | None = None

    def __post_init__(self) -> None:
        check_choices(self)
        check_tolerances(self, "inner_tol")

    @property
    def name(self) -> str:
        """Shown in messages and tables."""
        return "DOP853" if self.stages == "free" else "DOP853(stages='restored')"

    def takes_code(self, fixed: bool) -> bool:
        """Whether its steps may be run with code made for the mechanism."""
        return self.stages == "free"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels.steps import explicit_step as kernels

        s, free = len(tableau.B), self.stages == "free"
        return Plan(
            kernels.EXPLICIT,
            kernels.options_array(
                tableau.A,
                tableau.B,
                tableau.C,
                tableau.E5,
                COARSE_SHARE * tableau.E3,
                INNER_TOL if self.inner_tol is None else self.inner_tol,
                free,
                LARGEST_MOVE,
            ),
            np.zeros(kernels.memory_size(s, n_q)),
            exponent=1.0 / 8.0,
            safety=SAFETY,
            watchful=free,
            projects=free,
            least_error=LEAST_ERROR if free else 0.0,
            rough=ROUGH,
            stable_to=lambda memory: STABLE_TO,
            reuse=0.0 if fixed else REUSE * least_tolerance(rtol, atol),
            unseen=UNSEEN if free else 1.0,
        )

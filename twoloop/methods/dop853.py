"""DOP853(...): the explicit method of order 8 of Dormand and Prince, in the two-loop procedure.

Tableau: Hairer, Nørsett and Wanner, Solving Ordinary Differential Equations I (1993), II.5. The numbers are copied from
`scipy.integrate.DOP853`, because importing SciPy's package takes a tenth of a second; a test compares them with SciPy.
Both error estimates are weighted sums of the slopes of the stages; the slope at the end has the weight zero.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twoloop.methods.plan import (
    INNER_TOL,
    JUMP_RATIO,
    LARGEST_MOVE,
    Plan,
    check_choices,
    check_tolerances,
    least_tolerance,
)

_LOWER_TRIANGLE = """
0.05260015195876773
0.0197250569845379 0.0591751709536137
0.02958758547680685 0 0.08876275643042054
0.2413651341592667 0 -0.8845494793282861 0.924834003261792
0.037037037037037035 0 0 0.17082860872947386 0.12546768756682242
0.037109375 0 0 0.17025221101954405 0.06021653898045596 -0.017578125
0.03709200011850479 0 0 0.17038392571223998 0.10726203044637328 -0.015319437748624402 0.008273789163814023
0.6241109587160757 0 0 -3.3608926294469414 -0.868219346841726 27.59209969944671 20.154067550477894
-43.48988418106996
0.47766253643826434 0 0 -2.4881146199716677 -0.590290826836843 21.230051448181193 15.279233632882423
-33.28821096898486 -0.020331201708508627
-0.9371424300859873 0 0 5.186372428844064 1.0914373489967295 -8.149787010746927 -18.52006565999696
22.739487099350505 2.4936055526796523 -3.0467644718982196
2.273310147516538 0 0 -10.53449546673725 -2.0008720582248625 -17.9589318631188 27.94888452941996 -2.8589982771350235
-8.87285693353063 12.360567175794303 0.6433927460157636
"""


def _numbers(text: str) -> NDArray[np.float64]:
    return np.array(text.split(), dtype=float)


A = np.zeros((12, 12))
A[np.tril_indices(12, -1)] = _numbers(_LOWER_TRIANGLE)
B = _numbers("""
0.054293734116568765 0 0 0 0 4.450312892752409 1.8915178993145003 -5.801203960010585 0.3111643669578199
-0.1521609496625161 0.20136540080403034 0.04471061572777259
""")
C = _numbers("""
0 0.05260015195876773 0.0789002279381516 0.1183503419072274 0.2816496580927726 0.3333333333333333 0.25
0.3076923076923077 0.6512820512820513 0.6 0.8571428571428571 1.0
""")
E3 = _numbers("""
-0.18980075407240762 0 0 0 0 4.450312892752409 1.8915178993145003 -5.801203960010585 -0.4226823213237919
-0.1521609496625161 0.20136540080403034 0.02265179219836082
""")
E5 = _numbers("""
0.01312004499419488 0 0 0 0 -1.2251564463762044 -0.4957589496572502 1.6643771824549864 -0.35032884874997366
0.3341791187130175 0.08192320648511571 -0.022355307863886294
""")


COARSE_SHARE = 0.1  # factor on the error estimate of order 3 in the combined estimate e5^2 / sqrt(e5^2 + 0.01 e3^2)
# the velocity of a stage uses an earlier Jacobian if no position has changed by more than this since, in tolerances
REUSE_TOLERANCE = 1e-4
# lower limit of errors, relative to the tolerance, in the trend that the step size follows (`Plan.least_error`); it is
# low, because halving the step divides the error by more than 100
LEAST_ERROR = 1e-6
EVALUATED_NODES = C[(B != 0.0) | (E5 != 0.0) | (E3 != 0.0)]  # nodes of the stages with nonzero weights
# longest part of a step between two of these nodes, relative to the step: 4/15
LONGEST_GAP = float(np.diff([*np.sort(EVALUATED_NODES), 1.0]).max())
STABLE_TO = (5.96, 6.39)  # limits of stability: h times the frequency of a vibration, and h times a rate of decay
SAFETY = 0.8  # safety factor of the step size; 0.9 doubles the rejected steps, and costs a tenth more at equal error


@dataclass(frozen=True)
class DOP853:
    """Explicit Runge-Kutta method of Dormand and Prince, order 8 with 12 stages, for smooth motion that is not stiff.

    There is no outer loop. Every stage is one evaluation, so a step costs 12 evaluations, and a rejected step 11.
    Accepted states are on the constraints.

    If parts of the system could vibrate or decay faster than the system moves, stability, not accuracy, limits the step
    size h: h w_max to 5.96 for undamped vibrations, and h times the largest rate of decay to 6.39. Vibrations that such
    steps hardly resolve are damped, by 0.15 % of the amplitude per step at h w_max = 3. If stability limited many
    steps, `result.message` says so and names other methods.

    A step is accepted when the largest component of the estimated local error of q and v, including the dependent
    ones, is within the tolerance. Fixed steps have no error estimate.

    Parameters
    ----------
    stages : {"free", "restored"}
        "free": all coordinates are integrated alike, stages are off the constraints by the error of the formula, and
        the end of the step is moved to the nearest state on the constraints, in the metric of M, unlike in the paper.
        "restored": the paper's procedure with this tableau. The independent coordinates are integrated, and the inner
        loop restores the dependent coordinates at every stage. With nonholonomic constraints, the state at the end of a
        step is always restored in this way.
    inner_tol : float, optional
        Tolerance of Newton's method for the positions, unit of q, with "restored": the iteration stops after a
        correction of at most inner_tol. None: 1e-8.

    Raises
    ------
    TypeError, ValueError
        If stages is not one of these, or inner_tol not a positive number.

    Notes
    -----
    Tableau and error estimate, e5^2 / sqrt(e5^2 + 0.01 e3^2) of embedded estimates of orders 5 and 3: Hairer, Norsett
    and Wanner, Solving ODEs I (1993), II.5 and II.10; e5 and e3 are largest components here, not root mean squares.
    Once a run has come near a singular position, the quotient e5 / sqrt(e5^2 + 0.01 e3^2) in this estimate is replaced
    by its square root, because terms of high order are not small there, and errors have to be within a tenth of the
    tolerances, if these are at least 1e-10. The numbers are those of SciPy's `DOP853`. The stability limits follow from
    the method's polynomial R(z): |R| <= 1 on the imaginary axis up to 5.96 i, and on the real axis down to -6.39.

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
        """Return the name of the method for messages and tables."""
        return "DOP853" if self.stages == "free" else "DOP853(stages='restored')"

    @property
    def takes_code(self) -> bool:
        """Return whether the steps of this method can run with generated code."""
        return self.stages == "free"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.steps import explicit_step as kernels

        s, free = len(B), self.stages == "free"
        return Plan(
            kernels.EXPLICIT,
            kernels.options_array(
                A,
                B,
                C,
                E5,
                COARSE_SHARE * E3,
                INNER_TOL if self.inner_tol is None else self.inner_tol,
                free,
                LARGEST_MOVE,
            ),
            np.zeros(kernels.memory_size(s, n_q)),
            exponent=1.0 / 8.0,
            safety=SAFETY,
            checks_within=free,
            projects=free,
            least_error=LEAST_ERROR if free else 0.0,
            jump_ratio=JUMP_RATIO,
            stable_to=lambda memory: STABLE_TO,
            reuse=0.0 if fixed else REUSE_TOLERANCE * least_tolerance(rtol, atol),
            max_gap=LONGEST_GAP if free else 1.0,
        )

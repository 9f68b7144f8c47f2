"""What a user chooses by name, and the paper's two procedures."""

from typing import Any

import numpy as np

from twoloop.checks.arguments import check_positive
from twoloop.methods.adams import Adams
from twoloop.methods.auto import Auto
from twoloop.methods.bdf import BDF
from twoloop.methods.dop853 import DOP853
from twoloop.methods.esdirk import ESDIRK
from twoloop.methods.lobatto import Lobatto16
from twoloop.methods.newmark import Newmark
from twoloop.methods.plan import Method
from twoloop.methods.runge_kutta import RungeKutta
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib
from twoloop.methods.taylor import Taylor


def paper_irk(inner_tol: float = 1e-9, outer_tol: float = 1e-9) -> RungeKutta:
    """The paper's procedure with Sun's 3-stage Radau IIB; run it with rtol = atol = 1e-5 to follow Sect. 4.1.

    As printed: coordinate partitioning by LU; eqs. (14), (15) for the dependents at every stage; explicit Euler
    prediction; the outer loop ends by (32), is given up by (33); the error is (26), (27), the difference of one step
    and two half steps undivided; the next step by (31), (34) with fac = 0.9, facmax = 5, facmin = 0.5 and h_max = 1 s
    at the beginning of each step; after (33) h_max = h and the step is halved.

    Where this differs from the printed text, and why:

    - (32): the printed denominator max(Delta(y_i), 1) compares a difference with itself; max(|y_i|, 1) is used. Sect.
      3.1 and 3.2 base the criterion on y_i and y_d, Sect. 3.3 on y_i only. The former is followed: counts then grow
      along the tolerance of (32) as the printed times do along err_in (reports/table3.md), and at 1e-3 the solution
      is still usable. `outer_test="independent"` is the other reading.
    - (26): "Rotol" is read as Rtol. (27): n is 2 n_q, because z holds positions and velocities.
    - (28)-(34): the undefined q is the order 5, so the exponent is 1/6.
    - Sect. 3.1 says that y_{n+1} is iterated; a Runge-Kutta method iterates the K_i, and so does this. Its step 2
      predicts K_i = f(t_n + c_i h, y_{n+1}); here one K, at (t_{n+1}, y_{n+1}), predicts all.
    - Left open by the text and chosen: the K_i are calculated one after another with the latest of the others, as the
      loop is printed; the accepted state is that of the two half steps; Newton starts from the last iterate of the
      same stage; err_in bounds the largest correction; 200 iterations at the most; the first step size, by solve_dae;
      c_3 = 1, b_3 = 1/9 and a_33 = 1/18, lost in print.
    - A step also ends as after (33) when the inner loop does not converge: 25 iterations, a correction of more than
      half the one before, or a singular C_qd.
    - "Once in a time step or several time steps": the partition is looked at after every step, and chosen anew when
      max|C_qd^-1 C_qi| has grown to three times what it was, or when a step failed in the inner loop.
    - Steps are shortened to end at output times and at the end of the run.
    - A step is refused as well where the force jumps between its start and the first stage: the step and its halves
      do not see that, and were off by 1e5 tolerances.

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
    """The two-loop procedure with Newmark's method that the paper compares with; beta = 1/2 as printed.

    As printed: (12) with beta = gamma = 1/2; the outer loop by (11) and (12) with the inner loop between them.

    Where this differs from the printed text, and why:

    - beta = 1/2 is not the average-acceleration method in the form (12), 1/4 is: the leading error is four times
      larger. Both can be chosen; the printed one is the default.
    - The paper refers to Hussein and Shabana for error control and convergence. err_out is taken as the tolerance
      of the local error |beta - 1/6| h^2 ||a_{n+1} - a_n||_2 (Zienkiewicz and Xie 1991), with the step factor
      0.9 (err_out / error)^(1/3) between 0.5 and 5 and h_max = 1 s: only so does the cost grow as in Table 3. After a
      step that did not converge h is halved, and h_max is 0.7 h for ten steps.
    - The outer loop stops when y_i would change by less than err_out / 1000, relative to max(|y_i|, 1); it is given
      up when the differences grow.
    - Newton starts from the Taylor polynomial of the dependents, not from the last position.
    - The partition is renewed as in `paper_irk`; steps are shortened to end at output times, too.

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


PRESETS: dict[str, Method] = {
    "auto": Auto(
        few=DOP853(),
        many=Adams(),
        series=Taylor(),
        loose=ESDIRK("TRBDF2"),
        tight=RungeKutta(radau_iia(3), outer="newton", tested="positions"),
        tightest=RungeKutta(radau_iia(5), outer="newton", tested="positions"),
        fixed=RungeKutta(sun_radau_iib(3), outer="auto"),
        lanes=Lobatto16(),
    ),
    "SunRadau5": RungeKutta(sun_radau_iib(3), outer="auto"),
    **{f"Gauss{2 * s}": RungeKutta(gauss(s)) for s in range(2, 9)},
    **{f"RadauIIA{2 * s - 1}": RungeKutta(radau_iia(s), outer="newton") for s in (3, 5, 7)},
    "TRBDF2": ESDIRK("TRBDF2"),
    "ESDIRK4": ESDIRK("ESDIRK4"),
    "Newmark": Newmark(),
    "BDF": BDF(),
    "Lobatto16": Lobatto16(),
    "DOP853": DOP853(),
    "Adams": Adams(),
    "Taylor": Taylor(),
    "PaperIRK": paper_irk(),
    "PaperNewmark": paper_newmark(),
}


OWN = (
    Adams,
    BDF,
    DOP853,
    ESDIRK,
    Lobatto16,
    Newmark,
    RungeKutta,
    Taylor,
)  # whose objects are the values of their options
PLAIN = (str, int, float, np.generic, type(None))  # such values, beside tableaux
_OF_PRESETS = frozenset(map(id, PRESETS.values()))


def is_preset(method: Any) -> bool:
    """Whether it is one of these objects, or the name of one, which do not change."""
    return isinstance(method, str) or id(method) in _OF_PRESETS


def identity(method: Method) -> Any:
    """What methods of the same options have in common now, by which runs are kept; None: it is not known."""
    if is_preset(method):
        return id(method)
    if type(method) not in OWN:
        return None
    values = [value.content if type(value) is Tableau else value for value in vars(method).values()]
    return (type(method), *values) if all(isinstance(value, (*PLAIN, tuple)) for value in values) else None

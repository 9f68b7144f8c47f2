"""What a user chooses: RungeKutta(...), Newmark(...), the paper's two, and presets. Frozen options, no state."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from twoloop.checks.arguments import check_choice, check_number, check_positive, shown
from twoloop.methods.adams import Adams
from twoloop.methods.auto import Auto, switching
from twoloop.methods.bdf import BDF
from twoloop.methods.dop853 import DOP853
from twoloop.methods.esdirk import ESDIRK
from twoloop.methods.plan import INNER_TOL, ROUGH, Method, Plan, check_tolerances, outer_tolerance
from twoloop.methods.tableaux import Tableau, gauss, radau_iia, sun_radau_iib
from twoloop.methods.taylor import Taylor

NEWTON_TOL_FIXED = 1e-12  # the same where stiff forces magnify rounding
LIMIT_OF_FIXED_POINT = 1.5  # h rho from which on the fixed-point iteration converges slowly: Newton's method is tried
ILL_CONDITIONED = (
    1e8  # eigenvectors of A, as in kernels/steps/newton_step.py; one over it: an eigenvalue that counts as zero
)
NO_ESTIMATE = 0.02  # of |beta - 1/6|, below which Newmark's estimate sees no error
# highest order for which a step is divided into so many parts: with fewer the error between steps is more than a few
# times that at the steps (four-bar linkage, tolerances of 1e-4 to 1e-12)
PARTS = {5: 1, 6: 2, 8: 3, 10: 4, np.inf: 6}
UNDIVIDED = 6  # the highest order for which this holds of steps by Newton's method, whose accelerations are of no use
NEWMARK_OUTER_SHARE = 1e-3  # of err_out; its fixed-point iterations converge so fast that this costs next to nothing


@dataclass(frozen=True)
class RungeKutta:
    """Two-loop procedure with an implicit Runge-Kutta method.

    Parameters
    ----------
    tableau : Tableau
        Any tableau of `twoloop.methods.tableaux`.
    outer : {"auto", "fixed-point", "newton", "paper"}
        "fixed-point": iteration on the stage accelerations, predicted from the step before, with a growth test.
        "newton": simplified Newton on the stage accelerations, its linear algebra in the eigenvectors of the tableau's
        A, with derivatives from the tangents that the system gives, else by differences of the two-loop right-hand
        side, kept while it converges fast. For stiff problems, where fixed-point iteration needs h w_max below a
        constant. Its error estimate is an embedded one of order s, filtered (Hairer & Wanner II, IV.8); `error` has no
        effect.
        "auto": "fixed-point" until steps have come near where that no longer converges, and Newton's method, on trial,
        costs less for a second of motion; and back again, see `Auto`.
        "paper": fixed-point iteration on [v_i, q_i] from an explicit Euler prediction, with the tests (32) and (33).
        The step size follows the error and, but with "paper", its trend (Gustafsson 1994).
    error : {"richardson", "richardson-paper"}
        Both take the difference of one step of h and two of h/2, undivided as in (26), for the local error.
        "richardson": its largest component counts, and the step continues from the extrapolated state, put back on
        the constraints, whose order is one higher. "richardson-paper": its root mean square (27) counts, and the step
        continues from the two half steps. Fixed steps estimate nothing and are the tableau's own, with sums from step
        to step that make up for rounding (Kahan's). Beside "richardson"
        the accelerations at both ends of the step are compared with the polynomial through those of the stages: so a
        jump of the force between an end and the stage next to it, which no stage sees, is found.
    inner_tol : float, optional
        Newton on the positions stops when its largest correction, just made, is at most this (unit of q). None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when no independent velocity or position changes by more than this, relative to
        max(|value|, 1). None: 0.01 min(rtol, atol); with fixed steps 1e-14.
    variables : {"velocities", "momenta"}
        What is integrated. "velocities": (q_i, v_i), as in the paper; these are not canonical, so that a symplectic
        tableau does not make a symplectic map. "momenta": (q_i, p_i = T^T M v), where v = T v_i + u are the velocities
        that the constraints allow; where the force comes from a potential, a symplectic tableau (Gauss, Sun, Lobatto
        IIIE) with a fixed step then is symplectic as long as the partition stays. A mass matrix M(t, q) is
        differenced along the motion. Costs about a tenth more.
    partition : {"lasting", "symmetric"}
        "lasting": a partition stays until its pivots have become too small. "symmetric": each step has the partition
        that full pivoting finds in the middle of the step, the same forwards and backwards, so that fixed steps with a
        symmetric tableau (Gauss, Lobatto IIIE) stay time-reversible where the partition changes. On conservative
        mechanisms that swing back the way they came, `RungeKutta(gauss(3), variables="momenta", partition="symmetric")`
        with fixed steps then shows no drift of the energy; where motion does not reverse, as of a turning crank, only
        momenta under one lasting partition do. Step-size control spoils both properties.
    tested : {"all", "positions"}
        What the error estimate of outer="newton" is taken over: positions and velocities, or positions and what
        velocities make of them before they turn back or decay. Stiff vibrations that do not matter show in the
        velocities; "positions" passes over them.
    outer_test : {"all", "independent"}
        What (32) of outer="paper" is taken over: all coordinates and velocities, after the dependent ones are restored,
        or the independent ones only. The text of the paper says both. Without effect on other outer loops.

    Raises
    ------
    TypeError, ValueError
        If an option is not one of those named, or a tolerance is not positive.
    """

    tableau: Tableau
    outer: Literal["auto", "fixed-point", "newton", "paper"] = "fixed-point"
    error: Literal["richardson", "richardson-paper"] = "richardson"
    inner_tol: float | None = None
    outer_tol: float | None = None
    variables: Literal["velocities", "momenta"] = "velocities"
    partition: Literal["lasting", "symmetric"] = "lasting"
    tested: Literal["all", "positions"] = "all"
    outer_test: Literal["all", "independent"] = "all"

    def __post_init__(self) -> None:
        if not isinstance(self.tableau, Tableau):
            raise TypeError(
                f"tableau must be a twoloop.methods.tableaux.Tableau, e.g. gauss(3); given {shown(self.tableau)}"
            )
        if np.diff(np.sort(self.tableau.c)).min(initial=1.0) < 1e-10:
            raise ValueError(f"tableau must have distinct nodes; those of {self.tableau.name} are {self.tableau.c}")
        check_choice("outer", self.outer, ("auto", "fixed-point", "newton", "paper"))
        check_choice("variables", self.variables, ("velocities", "momenta"))
        check_choice("partition", self.partition, ("lasting", "symmetric"))
        check_choice("error", self.error, ("richardson", "richardson-paper"))
        check_choice("tested", self.tested, ("all", "positions"))
        if self.tested == "positions" and self.outer not in ("auto", "newton"):
            raise ValueError(f"tested='positions' goes with outer='newton' or 'auto' only; given {self.outer!r}")
        check_choice("outer_test", self.outer_test, ("all", "independent"))
        if self.outer != "fixed-point" and self.variables != "velocities":
            raise ValueError(f"outer={self.outer!r} goes with variables='velocities' only; given {self.variables!r}")
        if self.outer == "paper" and self.partition != "lasting":
            raise ValueError(
                f"outer='paper' is the paper's procedure, which has partition='lasting'; given {self.partition!r}"
            )
        if self.outer in ("auto", "newton"):
            values, vectors = np.linalg.eig(self.tableau.A)
            if np.linalg.cond(vectors) > ILL_CONDITIONED or np.abs(values).min() < 1.0 / ILL_CONDITIONED:
                raise ValueError(
                    f"tableau must have an invertible A with a basis of eigenvectors for outer={self.outer!r}; that of "
                    f"{self.tableau.name} has not. Take outer='fixed-point'"
                )
        check_tolerances(self, "inner_tol", "outer_tol")

    @property
    def name(self) -> str:
        """Shown in messages and tables."""
        usual = {"variables": "velocities", "partition": "lasting", "tested": "all", "outer_test": "all"}
        changed = [getattr(self, option) for option, value in usual.items() if getattr(self, option) != value]
        return ", ".join([self.tableau.name, self.outer, self.error, *changed])

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels.steps import fixed_point_step as kernels
        from twoloop.kernels.steps.stages import options_array

        tableau = self.tableau
        outer_tol = self.outer_tol
        if outer_tol is None:
            own_rule = fixed and self.outer == "newton"
            outer_tol = NEWTON_TOL_FIXED if own_rule else outer_tolerance(rtol, atol, fixed)
        options = options_array(
            tableau.A,
            tableau.b,
            tableau.c,
            INNER_TOL if self.inner_tol is None else self.inner_tol,
            outer_tol,
            1.0 / (2.0**tableau.order - 1.0) if self.error == "richardson" else 0.0,
            float(self.outer_test == "all"),
            tableau.order - 1.0,
        )
        memory = np.zeros(kernels.memory_size(tableau.stages, n_q))
        plan = Plan(kernels.runge_kutta_step, options, memory, 1.0 / (tableau.order + 1), rough=ROUGH)
        if self.outer == "paper":
            step = kernels.paper_step
            return replace(
                plan,
                step=step,
                factor_min=0.5,
                limit_start=1.0,
                limit_factor=1.0,
                limit_memory=0,
                lands=True,
                rough=1.0,
            )
        plan = replace(plan, predictive=True, symmetric=self.partition == "symmetric", parts=self._parts())
        if self.variables == "momenta":
            from twoloop.kernels.steps import canonical_step as momenta

            return replace(plan, step=momenta.momenta_step, memory=np.zeros(momenta.memory_size(tableau.stages, n_q)))
        if self.outer == "fixed-point":
            return plan
        newton = self._newton_plan(plan, n_q)
        return newton if self.outer == "newton" else switching(plan, newton, LIMIT_OF_FIXED_POINT, n_q)

    def _newton_plan(self, plan: Plan, n_q: int) -> Plan:
        """The same with Newton's method as the outer loop."""
        from twoloop.kernels.steps import newton_memory
        from twoloop.kernels.steps import newton_step as newton

        tableau = self.tableau
        extra = newton.newton_options(tableau.A, tableau.b, tableau.c, self.tested == "all")
        n_eigen = int(extra[newton_memory.N_REAL] + extra[newton_memory.N_PAIRS])
        made = replace(
            plan,
            step=newton.newton_step,
            options=np.concatenate([plan.options, extra]),
            memory=np.zeros(newton_memory.memory_size(n_eigen, tableau.stages, n_q)),
            exponent=1.0 / (tableau.stages + 1),
        )
        if tableau.order <= UNDIVIDED:
            return made
        return replace(made, within_newton=replace(made, memory=made.memory.copy(), parts=tableau.stages - 1))

    def _parts(self) -> int:
        """Parts of a step whose states carry the solution between its ends to the accuracy of the method."""
        if self.outer in ("newton", "paper"):
            return 1
        return next(parts for order, parts in PARTS.items() if self.tableau.order <= order)


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
        proportional to the tolerance. 1 / r is the time in which the largest velocity, or acceleration, so far changes
        the largest coordinate so far: not in the paper, and for no origin of the coordinates does it become zero.
    inner_tol : float, optional
        Newton on the positions stops when its largest correction, just made, is at most this. None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when no independent velocity or position would change by more than this, relative to
        max(|value|, 1). None: 1e-3 error_tol or 0.01 min(rtol, atol); with fixed steps 1e-14.

    Raises
    ------
    TypeError, ValueError
        If a parameter is out of range.
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
            kernels.newmark_step,
            options,
            np.zeros(kernels.N_MEMORY_SCALARS + n_q),
            exponent=1.0 / 2.0 if self.error_tol is None else 1.0 / 3.0,
            factor_min=0.5,
            limit_start=1.0 if self.error_tol is not None else np.inf,
            lands=self.error_tol is not None,
            apart=True,
        )


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
    """
    check_positive("outer_tol", outer_tol)
    return Newmark(beta=beta, gamma=0.5, error_tol=outer_tol, inner_tol=inner_tol)


PRESETS: dict[str, Method] = {
    "auto": Auto(
        few=DOP853(),
        many=Adams(),
        series=Taylor(),
        loose=ESDIRK("TRBDF2"),
        tight=RungeKutta(radau_iia(5), outer="newton", tested="positions"),
        tightest=RungeKutta(radau_iia(7), outer="newton", tested="positions"),
        fixed=RungeKutta(sun_radau_iib(3), outer="auto"),
    ),
    "SunRadau5": RungeKutta(sun_radau_iib(3), outer="auto"),
    **{f"Gauss{2 * s}": RungeKutta(gauss(s)) for s in range(2, 9)},
    **{f"RadauIIA{2 * s - 1}": RungeKutta(radau_iia(s), outer="newton") for s in (3, 5, 7)},
    "TRBDF2": ESDIRK("TRBDF2"),
    "ESDIRK4": ESDIRK("ESDIRK4"),
    "Newmark": Newmark(),
    "BDF": BDF(),
    "DOP853": DOP853(),
    "Adams": Adams(),
    "Taylor": Taylor(),
    "PaperIRK": paper_irk(),
    "PaperNewmark": paper_newmark(),
}

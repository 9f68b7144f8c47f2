"""RungeKutta(...): implicit Runge-Kutta methods, their outer loop by fixed point or by Newton's method."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from twoloop.checks.arguments import shown
from twoloop.methods.auto import switching
from twoloop.methods.plan import INNER_TOL, LEAST_ERROR, ROUGH, Plan, check_choices, check_tolerances, outer_tolerance
from twoloop.methods.tableaux import Tableau

NEWTON_TOL_FIXED = 1e-12  # the outer tolerance of fixed steps where stiff forces magnify rounding
LIMIT_OF_FIXED_POINT = 1.5  # h rho from which on the fixed-point iteration converges slowly: Newton's method is tried
# eigenvectors of A, as in kernels/steps/newton_memory.py; one over it: an eigenvalue that counts as zero
ILL_CONDITIONED = 1e8
# highest order for which a step is divided into so many parts: with fewer the error between steps is more than a few
# times that at the steps (four-bar linkage, tolerances of 1e-4 to 1e-12)
PARTS = {5: 1, 6: 2, 8: 3, 10: 4, np.inf: 6}
UNDIVIDED = 6  # the highest order for which this holds of steps by Newton's method, whose accelerations are of no use


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
    partition : {"lasting", "symmetric"}
        "lasting": a partition stays until its pivots have become too small. "symmetric": each step has the partition
        that full pivoting finds in the middle of the step, the same forwards and backwards, so that fixed steps with a
        symmetric tableau (Gauss, Lobatto IIIE) stay time-reversible where the partition changes. On conservative
        mechanisms that swing back the way they came, `RungeKutta(gauss(3), partition="symmetric")` with fixed steps
        then shows no drift of the energy. Step-size control spoils this.
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

    Examples
    --------
    >>> from twoloop import RungeKutta, solve_dae
    >>> from twoloop.mechanisms import four_bar
    >>> from twoloop.methods.tableaux import gauss
    >>> problem = four_bar()
    >>> method = RungeKutta(gauss(3))
    >>> result = solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, method=method, step_size=0.01)
    >>> result.stats.n_accepted
    100
    """

    tableau: Tableau
    outer: Literal["auto", "fixed-point", "newton", "paper"] = "fixed-point"
    error: Literal["richardson", "richardson-paper"] = "richardson"
    inner_tol: float | None = None
    outer_tol: float | None = None
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
        check_choices(self)
        if self.tested == "positions" and self.outer not in ("auto", "newton"):
            raise ValueError(f"tested='positions' goes with outer='newton' or 'auto' only; given {self.outer!r}")
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
        usual = {"partition": "lasting", "tested": "all", "outer_test": "all"}
        changed = [getattr(self, option) for option, value in usual.items() if getattr(self, option) != value]
        return ", ".join([self.tableau.name, self.outer, self.error, *changed])

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Make the method ready for a run of n_q coordinates."""
        from twoloop.kernels.steps import fixed_point_memory
        from twoloop.kernels.steps.named_step import NamedStep
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
        memory = np.zeros(fixed_point_memory.memory_size(tableau.stages, n_q))
        step = NamedStep("fixed_point_step", "RUNGE_KUTTA")
        plan = Plan(step, options, memory, 1.0 / (tableau.order + 1), rough=ROUGH)
        if self.outer == "paper":
            return plan.changed(
                step=NamedStep("paper_step", "PAPER"),
                factor_min=0.5,
                limit_start=1.0,
                limit_factor=1.0,
                limit_memory=0,
                lands=True,
                rough=1.0,
            )
        plan = plan.changed(least_error=LEAST_ERROR, symmetric=self.partition == "symmetric", parts=self._parts())
        if self.outer == "fixed-point":
            return plan
        newton = self._newton_plan(plan, n_q)
        return newton if self.outer == "newton" else switching(plan, newton, LIMIT_OF_FIXED_POINT, n_q)

    def _newton_plan(self, plan: Plan, n_q: int) -> Plan:
        """The same with Newton's method as the outer loop."""
        from twoloop.kernels.steps import newton_memory
        from twoloop.kernels.steps.named_step import NamedStep

        tableau = self.tableau
        extra = newton_memory.newton_options(tableau.A, tableau.b, tableau.c, self.tested == "all")
        n_eigen = int(extra[newton_memory.N_REAL] + extra[newton_memory.N_PAIRS])
        made = plan.changed(
            step=NamedStep("newton_step", "NEWTON"),
            options=np.concatenate([plan.options, extra]),
            memory=np.zeros(newton_memory.memory_size(n_eigen, tableau.stages, n_q)),
            matrices=newton_memory.n_matrices(n_eigen),
            projects=True,
            exponent=1.0 / (tableau.stages + 1),
        )
        if tableau.order <= UNDIVIDED:
            return made
        return made.changed(within_newton=made.changed(memory=made.memory.copy(), parts=tableau.stages - 1))

    def _parts(self) -> int:
        """Parts of a step whose states carry the solution between its ends to the accuracy of the method."""
        if self.outer in ("newton", "paper"):
            return 1
        return next(parts for order, parts in PARTS.items() if self.tableau.order <= order)

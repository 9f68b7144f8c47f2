"""RungeKutta(...) and ESDIRK(...): implicit Runge-Kutta methods, by fixed point, Newton's method, or stage by stage."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from twoloop.checks.arguments import shown
from twoloop.methods.auto import switching
from twoloop.methods.plan import (
    INNER_TOL,
    JUMP_RATIO,
    LEAST_ERROR,
    Plan,
    check_choices,
    check_tolerances,
    least_tolerance,
    outer_tolerance,
)
from twoloop.methods.tableaux import Tableau

NEWTON_TOL_FIXED = 1e-12  # outer tolerance of fixed steps with Newton's method; stiff forces magnify rounding errors
# if h rho is at least this (rho: largest rate), fixed-point iteration is so slow that Newton's method is tried
LIMIT_OF_FIXED_POINT = 1.5
# largest condition number of the matrix of eigenvectors of A; 1 / MAX_CONDITION: smallest allowed |eigenvalue| of A
MAX_CONDITION = 1e8
# number of parts into which a step is divided for the solution within it (keys: highest order for which this number is
# enough). With fewer parts, errors are more than a few times those at the ends (four-bar, tolerances 1e-4 to 1e-12)
PARTS = {5: 1, 6: 2, 8: 3, 10: 4, np.inf: 6}
# up to this order, Newton steps are not divided for the solution within them; at higher orders, interpolation is not
# accurate enough, because it cannot use the accelerations of these steps
MAX_ORDER_UNDIVIDED = 6


@dataclass(frozen=True)
class RungeKutta:
    """Two-loop procedure with an implicit Runge-Kutta method.

    Parameters
    ----------
    tableau : Tableau
        Any tableau of `twoloop.methods.tableaux`.
    outer : {"auto", "fixed-point", "newton", "paper"}
        "fixed-point": iteration on the stage accelerations, predicted from the previous step; it is given up when its
        corrections grow.
        "newton": simplified Newton's method on the stage accelerations, in the eigenvectors of the tableau's A. The
        Jacobian comes from the tangents that the system gives, else from differences of the accelerations, and is kept
        while the iteration converges fast. For stiff problems, where fixed-point iteration needs h w_max below a
        constant. The error estimate is embedded, of order s, and filtered (Hairer & Wanner II, IV.8); `error` has no
        effect.
        "auto": "fixed-point", and Newton's method where steps come near the limit of convergence of "fixed-point" and a
        trial shows that a second of motion costs less with it; the run can switch back, see `Auto`.
        "paper": fixed-point iteration on [v_i, q_i] from an explicit Euler prediction, with the tests (32) and (33).
        The step size follows the error and, except with "paper", its trend (Gustafsson 1994).
    error : {"richardson", "richardson-paper"}
        Both take the difference between one step of h and two steps of h/2, undivided as in (26), for the local error.
        "richardson": the largest component of the difference counts, and the new state is the extrapolated state, whose
        order is one higher, projected onto the constraints. "richardson-paper": the root mean square (27) of the
        difference counts, and the new state is the end of the two half steps. Fixed steps have no error estimate and
        use the tableau as it is, with sums from step to step that compensate rounding (Kahan). With "richardson", the
        accelerations at both ends of the step are compared with the polynomial through the stage accelerations: so a
        jump of the force between an end and its nearest stage is found, too.
    inner_tol : float, optional
        Newton's method for the positions stops after a correction of at most inner_tol (unit of q). None: 1e-8.
    outer_tol : float, optional
        The outer loop stops when no independent velocity or position changes by more than this, relative to
        max(|value|, 1). None: 0.01 min(rtol, atol); with fixed steps 1e-14.
    partition : {"lasting", "symmetric"}
        "lasting": a partition is used until its pivots have become too small. "symmetric": each step uses the partition
        that full pivoting finds in the middle of the step, which is the same forwards and backwards, so that fixed
        steps with a symmetric tableau (Gauss, Lobatto IIIE) are time-reversible where the partition changes. Energy
        does not drift if a conservative mechanism that swings back the way it came is integrated by
        `RungeKutta(gauss(3), partition="symmetric")` with fixed steps; with step-size control it may.
    tested : {"all", "positions"}
        Quantities that the error estimate of outer="newton" counts: positions and velocities, or positions and the
        effect that velocities have on them before these turn back or decay. Stiff vibrations that do not matter show in
        the velocities; "positions" ignores them.
    outer_test : {"all", "independent"}
        Quantities that (32) of outer="paper" counts: all coordinates and velocities, after the dependent ones are
        restored, or only the independent ones. The text of the paper says both. No effect on other outer loops.

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
            if np.linalg.cond(vectors) > MAX_CONDITION or np.abs(values).min() < 1.0 / MAX_CONDITION:
                raise ValueError(
                    f"tableau must have an invertible A with a basis of eigenvectors for outer={self.outer!r}; that of "
                    f"{self.tableau.name} has not. Take outer='fixed-point'"
                )
        check_tolerances(self, "inner_tol", "outer_tol")

    @property
    def name(self) -> str:
        """Return the name of the method for messages and tables."""
        defaults = {"partition": "lasting", "tested": "all", "outer_test": "all"}
        changed = [getattr(self, option) for option, value in defaults.items() if getattr(self, option) != value]
        return ", ".join([self.tableau.name, self.outer, self.error, *changed])

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.paper import iterations
        from twoloop.kernels.steps.stages import LazyStep, options_array

        tableau = self.tableau
        outer_tol = self.outer_tol
        if outer_tol is None:
            is_newton_fixed = fixed and self.outer == "newton"
            outer_tol = NEWTON_TOL_FIXED if is_newton_fixed else outer_tolerance(rtol, atol, fixed)
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
        memory = np.zeros(iterations.memory_size(tableau.stages, n_q))
        step = LazyStep("paper.fixed_point_step", "RUNGE_KUTTA")
        plan = Plan(step, options, memory, 1.0 / (tableau.order + 1), jump_ratio=JUMP_RATIO)
        if self.outer == "paper":
            return plan.changed(
                step=LazyStep("paper.fixed_point_step", "PAPER"),
                factor_min=0.5,
                limit_start=1.0,
                limit_factor=1.0,
                limit_memory=0,
                ends_at_outputs=True,
                jump_ratio=1.0,
            )
        plan = plan.changed(least_error=LEAST_ERROR, symmetric=self.partition == "symmetric", parts=self._parts())
        if self.outer == "fixed-point":
            return plan
        newton = self._newton_plan(plan, n_q)
        return newton if self.outer == "newton" else switching(plan, newton, LIMIT_OF_FIXED_POINT, n_q)

    def _newton_plan(self, plan: Plan, n_q: int) -> Plan:
        """Return the plan with Newton's method as the outer loop."""
        from twoloop.kernels.steps import stages
        from twoloop.kernels.steps.stages import LazyStep

        tableau = self.tableau
        newton_options = stages.newton_options(tableau.A, tableau.b, tableau.c, self.tested == "all")
        n_systems = int(newton_options[stages.N_REAL] + newton_options[stages.N_PAIRS])
        newton = plan.changed(
            step=LazyStep("steps.newton_step", "NEWTON"),
            options=np.concatenate([plan.options, newton_options]),
            memory=np.zeros(stages.memory_size(n_systems, tableau.stages, n_q)),
            matrices=stages.n_matrices(n_systems),
            projects=True,
            exponent=1.0 / (tableau.stages + 1),
        )
        if tableau.order <= MAX_ORDER_UNDIVIDED:
            return newton
        return newton.changed(within_newton=newton.changed(memory=newton.memory.copy(), parts=tableau.stages - 1))

    def _parts(self) -> int:
        """Return the number of parts of a step with which the solution within it is as accurate as at its ends."""
        if self.outer in ("newton", "paper"):
            return 1
        return next(parts for order, parts in PARTS.items() if self.tableau.order <= order)


Array = NDArray[np.float64]

# the iteration of a stage ends after a correction of at most this, relative to the tolerance of the run; the error that
# remains is much smaller, because the correction is applied and convergence is quadratic
STAGE_TOL_RATIO = 3.0
# upper limit of the last correction of a stage, relative to max(|q|, 1): larger ones would make stiff problems so
# inaccurate that steps become short
LOOSEST_OUTER = 3e-3
FEW_STEPS = 1e-3  # below this tolerance of a run, last corrections are smaller, because they add up over more steps
STAGE_TOL_FIXED = 1e-12  # relative last correction of a stage in fixed steps; stiff forces magnify rounding errors
STAGE_SAFETY = 0.8  # safety factor of the step size; 0.9 would reject one attempt in seven for the stiff beam


def _trbdf2() -> tuple[Array, Array]:
    """Return A and the embedded weights of TR-BDF2: Hosea and Shampine, Appl. Numer. Math. 20 (1996), 21-37."""
    g, w = 1.0 - np.sqrt(0.5), np.sqrt(2.0) / 4.0
    return np.array([[0.0, 0.0, 0.0], [g, g, 0.0], [w, w, g]]), np.array([(1.0 - w) / 3.0, w + 1.0 / 3.0, g / 3.0])


def _esdirk4() -> tuple[Array, Array]:
    """Return A and the embedded weights of ESDIRK4(3)6L[2]SA: Kennedy and Carpenter, NASA/TM-2016-219173."""
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


FORMULAS = {"TRBDF2": (_trbdf2, 2), "ESDIRK4": (_esdirk4, 4)}  # function that returns the coefficients, and order


def _jump_weights(c: Array) -> Array:
    """Return weights (s,) of ESDIRK4's stage accelerations whose weighted sum shows a jump anywhere in a step.

    The sum is zero for quadratic accelerations. For a jump, it is the sum of the weights of all later stages, which is
    about half of the largest error of the step.
    """
    order = np.argsort(c)
    nodes = c[order]
    # sums of the weights of all stages after each gap between nodes; the second and the last sum are computed below
    sums_after = np.array([0.1392, 0.0, -0.16, -0.16, 0.0])
    moments = np.array([np.diff(nodes), np.diff(nodes**2)])
    sums_after[[1, 4]] = np.linalg.solve(moments[:, [1, 4]], -moments @ sums_after)
    weights = np.zeros(len(c))
    weights[order] = np.diff(-np.concatenate([[0.0], sums_after, [0.0]]))
    return weights


JUMP_WEIGHTS = {"TRBDF2": np.zeros(3), "ESDIRK4": _jump_weights(_esdirk4()[0].sum(axis=1))}
# `Plan.jump_ratio` of the formulas: the weights of ESDIRK4 differ from its embedded weights by at most 0.04, so that
# the first estimate is 1/300 of the error if a force jumps in the first half of a step
JUMP_RATIOS = {"TRBDF2": 1.0, "ESDIRK4": 300.0}


@dataclass(frozen=True)
class ESDIRK:
    """Two-loop procedure with diagonally implicit stages, for few digits of stiff problems.

    The stages are solved by Newton's method, one after another. If the system gives tangents, each iteration has its
    own Jacobian. Otherwise Jacobians are computed by differences, and kept while the iteration converges fast and the
    error estimate confirms them. Once stiff directions have turned, an earlier Jacobian no longer leads to convergence;
    therefore `RungeKutta(..., outer="newton")`, whose stages share one Jacobian, is limited to short steps at loose
    tolerances, but is the better method at tight tolerances.

    Both formulas are L-stable and end with their last stage. With step-size control, steps of "TRBDF2" end at the
    result of its embedded formula, of order 3: the difference, filtered for stiff components three times, is L-stable,
    too. A step is accepted when these errors are within the tolerance: the error of the positions, estimated by the
    embedded formula and filtered; the position error that the velocity error will cause before it turns back or decays
    (times ten if it does so no faster than the motion changes); and the part of it that remains some steps later, over
    the time in which the motion changes. ESDIRK4 has a second embedded formula for jumps of a force within a step,
    which the first hardly shows. Vibrations faster than the steps are damped. `tested="all"` also tests velocities.

    Parameters
    ----------
    formula : {"TRBDF2", "ESDIRK4"}
        Order 2 with two implicit stages, or order 4 with five.
    inner_tol : float, optional
        Newton's method for the dependent positions stops after a correction of at most inner_tol (unit of q). None:
        1e-8.
    outer_tol : float, optional
        The outer loop stops when the last correction changes no independent position by more than this, relative to
        max(|value|, 1). None: 3 min(rtol, atol), at most 3e-3; below tolerances of 1e-3 less, because such corrections
        add up over more steps; with fixed steps 1e-12.
    tested : {"all", "positions"}
        Quantities that the error estimate counts: positions and velocities, or positions and the effect of velocities
        on positions. Stiff vibrations that do not matter show in the velocities; "positions" ignores them.

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
        """Return the name of the method for messages and tables."""
        return self.formula if self.tested == "positions" else f"{self.formula}, velocities tested"

    def plan(self, n_q: int, rtol: float, atol: float, fixed: bool) -> Plan:
        """Return the Plan of a run of n_q coordinates: step, options, memory and step-size control."""
        from twoloop.kernels.steps.stages import LazyStep, diagonal_memory, diagonal_options, n_matrices

        coefficients, order = FORMULAS[self.formula]
        A, embedded = coefficients()
        exponent = 1.0 / (3.0 if order == 2 else 4.0)
        outer_tol = STAGE_TOL_FIXED if self.outer_tol is None else self.outer_tol
        if self.outer_tol is None and not fixed:
            tolerance = least_tolerance(rtol, atol)
            outer_tol = min(STAGE_TOL_RATIO * tolerance, LOOSEST_OUTER) * min(1.0, (tolerance / FEW_STEPS) ** exponent)
        inner_tol = INNER_TOL if self.inner_tol is None else self.inner_tol
        return Plan(
            LazyStep("steps.diagonal_step", "DIAGONAL"),
            diagonal_options(
                A,
                A.sum(axis=1),
                A[-1] - embedded,
                JUMP_WEIGHTS[self.formula],
                inner_tol,
                outer_tol,
                self.tested == "all",
                order == 2,
            ),
            diagonal_memory(len(embedded), n_q),
            matrices=n_matrices(1),
            projects=True,
            exponent=exponent,
            safety=STAGE_SAFETY,
            least_error=LEAST_ERROR,
            jump_ratio=JUMP_RATIOS[self.formula],
        )

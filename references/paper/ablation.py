"""The paper's idea alone: five ways to keep the constraints in one Runge-Kutta code, which share all that is not it.

Tableau, fixed-point loop over the stages, factorisations, convergence test and step-size control are the same for all.
What differs is what becomes of a stage's coordinates and of the end of a step: the branches on `variant` in
`references.paper.ablation_kernels`.
"""

import time
from typing import Any

import numpy as np

from references.driver import Task, TimeLimit, adapter
from references.paper import ablation_kernels as kernels
from twoloop.checks.arguments import check_choice
from twoloop.kernels.data.flags import GAMMA_GIVEN
from twoloop.kernels.data.kit import Kit
from twoloop.methods.tableaux import Tableau
from twoloop.result.result import Result

VARIANTS = {
    "positions in every stage": "the paper: dependent q and v from the constraints at every stage, in every iteration",
    "dependents frozen": "dependent q and v as at the beginning of the step, until its end",
    "projected once a step": "index 1: all coordinates integrated, put onto the constraints at the end (Eich 1993)",
    "stabilised index 2": "Gear, Gupta & Leimkuhler: M q' = M v - C_q^T mu, C = 0 and C_q v + C_t = 0 at the stages",
    "unprojected": "index 1: all coordinates integrated, constraints left to themselves",
}
FROZEN_ORDER = 1  # of a step with dependents frozen, whatever the tableau

LOOP_SHARE = 1e-4  # tolerance of the stage loop over that of the step, as 1e-9 over 1e-5 in the paper
LEAST_LOOP = 1e-11  # on the beam rounding leaves 1e-12
CHUNK = 100  # steps of a compiled call, after which the clock is read
FIRST = 1e-3  # of the time span, the first step under control
REASONS = {
    kernels.NOT_CONVERGED: "the stage loop does not converge",
    kernels.SINGULAR: "a matrix is singular, or the constraints cannot be solved",
    kernels.TOO_SMALL: "the step has become too small",
}


@adapter(velocity_rows=False)
def solve_variant(
    task: Task, variant: str, tableau: Tableau, *, step: float | None = None, tol: float | None = None
) -> tuple[Result, float]:
    """Integrate by a Runge-Kutta tableau with one of five ways to keep the constraints.

    Parameters
    ----------
    variant : str
        One of `VARIANTS`, which says what each does.
    tableau : Tableau
        With an invertible A, not an explicit one.
    step : float, optional
        A fixed step, s: the nearest that goes into t_span a whole number of times.
    tol : float, optional
        Instead of a fixed step: rtol = atol of eqs. (26), (27), (31), by a step and two halves, the latter kept. The
        loop over the stages ends at a change of 1e-4 tol, relative to max(1, |y|), at least 1e-11, as with fixed steps.
    others : see `references.driver`
        The system has `gamma`, and constraints on positions that do not depend on one another; no t_eval.

    Returns
    -------
    result : Result
        At the ends of the steps; `a` and `lam` of eq. (6) there. Of the statistics: n_evaluations, times that forces
        were evaluated and the equations of motion solved; n_factorizations, of C_qd, C_q M^-1 C_q^T, a varying M, and
        partitions; n_outer, sweeps over all stages; n_inner, Newton iterations for positions.
    mu : float
        Largest |mu| of the stabilised form, of its M q' = M v - C_q^T mu; 0 of the others.

    Notes
    -----
    All stages of a sweep are made from those of the one before, the first from the accelerations at the beginning of
    the step. The stabilised form has its multipliers from the residuals of the stages, by a Newton step with the
    matrices of each stage; where the last stage is not the end of the step, the end is put onto the constraints as with
    projection (U. Ascher and L. Petzold, SIAM J. Numer. Anal. 28 (1991) 1097-1120), else the method loses its order.
    """
    check_choice("variant", variant, tuple(VARIANTS))
    if (step is None) == (tol is None):
        raise ValueError(f"give either step, for fixed steps, or tol; given step={step!r}, tol={tol!r}")
    system, span, which = task.system, task.t1 - task.t0, list(VARIANTS).index(variant)
    if not system.functions.flags[GAMMA_GIVEN]:
        raise ValueError(f"system must have gamma; given {system.name!r} without it")
    if np.linalg.matrix_rank(tableau.A) < tableau.stages:
        raise ValueError(f"tableau must have an invertible A; that of {tableau.name} is singular")

    n, m, s = system.n_q, system.n_c, tableau.stages
    order = FROZEN_ORDER if which == kernels.FROZEN else tableau.order
    coefficients = [np.ascontiguousarray(x) for x in (tableau.A, tableau.b, tableau.c, np.linalg.inv(tableau.A))]
    counters, where = np.zeros(kernels.N_COUNTERS, dtype=np.int64), np.zeros(kernels.N_PLACES)
    n_steps, tol = 0 if step is None else max(1, round(span / step)), tol or 0.0
    where[kernels.T], where[kernels.H] = task.t0, span / n_steps if n_steps else FIRST * span
    where[kernels.LONGEST], loop_tol = span, max(LOOP_SHARE * tol, LEAST_LOOP)
    state, chunks = np.concatenate([task.y0, np.zeros(n + m)]), [np.empty((1, 1 + 3 * n + m))]
    given = n, m, s, which, order, *coefficients, task.t0, task.t1, n_steps, tol, loop_tol, state, where
    limit, began = TimeLimit(task.time_limit), time.process_time()
    code = kernels.run(Kit(system.functions), *given, chunks[0], counters)  # a and lam of the start
    while code == kernels.DONE and where[kernels.T] < task.t1 and not limit.passed():
        chunks.append(np.empty((CHUNK, 1 + 3 * n + m)))
        before = counters[kernels.STEPS]
        code = kernels.run(Kit(system.functions), *given, chunks[-1], counters)
        chunks[-1] = chunks[-1][: counters[kernels.STEPS] - before]
    counts: dict[str, Any] = dict(zip(kernels.COUNTERS, counters.tolist(), strict=True))
    counts["cpu_time"] = time.process_time() - began
    rows, name = np.concatenate(chunks).T, f"{tableau.name}, {variant}"
    t, failure = float(rows[0, -1]), ""
    if limit.exceeded:
        failure = limit.message(name, t, "take longer steps")
    elif code != kernels.DONE:
        failure = f"{name} failed after t = {t:.10g}: {REASONS[code]}. Take shorter steps."
    return task.result(name, rows[0], rows[1:], failure, h=np.diff(rows[0]), **counts), float(where[kernels.MU])

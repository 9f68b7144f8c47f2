"""Ablation of the paper's idea: five ways of treating the constraints in otherwise identical Runge-Kutta codes.

Tableau, fixed-point iteration over the stages, factorisations, convergence test and step-size control are the same. The
variants differ in the treatment of the stages' coordinates and of the end of a step: see the branches on `variant` in
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
FROZEN_ORDER = 1  # order with dependents frozen, for any tableau

LOOP_SHARE = 1e-4  # tolerance of the stage iteration relative to that of the step, as 1e-9 to 1e-5 in the paper
LEAST_LOOP = 1e-11  # rounding errors on the beam are about 1e-12
CHUNK = 100  # steps per compiled call, after which the clock is checked
FIRST = 1e-3  # first step with step-size control, relative to the time span
REASONS = {
    kernels.NOT_CONVERGED: "the stage iteration does not converge",
    kernels.SINGULAR: "a matrix is singular, or the constraints cannot be solved",
    kernels.TOO_SMALL: "the step has become too small",
}


@adapter(velocity_rows=False)
def solve_variant(
    task: Task, variant: str, tableau: Tableau, *, step: float | None = None, tol: float | None = None
) -> tuple[Result, float]:
    """Integrate by a Runge-Kutta tableau with one of five treatments of the constraints.

    Parameters
    ----------
    variant : str
        One of `VARIANTS`, which describes each.
    tableau : Tableau
        Implicit, with an invertible A.
    step : float, optional
        Fixed step size, s, rounded so that t_span is a multiple of it.
    tol : float, optional
        Instead of a fixed step: rtol = atol of eqs. (26), (27), (31), from one step and two half steps, keeping the
        latter. The stage iteration ends at a change of 1e-4 tol relative to max(1, |y|), but at least 1e-11, which is
        used for fixed steps.
    others : see `references.driver`
        The system must have `gamma` and independent position constraints; no t_eval.

    Returns
    -------
    result : Result
        States at the ends of steps, with `a` and `lam` from eq. (6). Statistics: n_evaluations of forces with solution
        of the equations of motion; n_factorizations, of C_qd, C_q M^-1 C_q^T, a varying M, and partitions; n_outer,
        sweeps over all stages; n_inner, Newton iterations for positions.
    mu : float
        Largest |mu| of the stabilised form, M q' = M v - C_q^T mu; 0 for the others.

    Notes ----- All stages of a sweep are computed from those of the previous sweep; the first uses the accelerations at
    the start of the step. The multipliers of the stabilised form follow from the residuals of the stages by a Newton
    step with the matrices of each stage. Unless the last stage is the end of the step, the end is projected onto the
    constraints (U. Ascher and L. Petzold, SIAM J. Numer. Anal. 28 (1991) 1097-1120); otherwise the method loses its
    order.
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
    code = kernels.run(Kit(system.functions), *given, chunks[0], counters)  # initial a and lam
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

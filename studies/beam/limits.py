"""Beside the runs: the step limit of fixed-point iteration, and how far the tip depends on the model.

All steps are whole steps h, times the largest frequency w_max of the straight beam.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import brentq

from studies.beam.runs import NEWTON
from studies.bench.cases.beam import SOFT, STIFF
from studies.bench.collector import Array, Case
from studies.bench.solvers import ERR_IN, PAPER_TOL
from twoloop import paper_irk, solve_dae
from twoloop.mechanisms import Problem, ancf_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent, tip_height
from twoloop.methods.plan import Method
from twoloop.methods.tableaux import Tableau, sun_radau_iib

Row = dict[str, Any]

GAUSS_SEIDEL = "Sun Radau IIB 3, latest stages (Gauss–Seidel, the paper's)"
JACOBI = "Sun Radau IIB 3, all old stages (Jacobi)"
TINY = 1e-3  # m/s, velocity of the base of the linearised beam: nothing else moves it
STOPPED_AT = (1e-1, 1e-2, 1e-8)  # of TINY: changes at which (32) ends the iteration
LINEARISED_STEPS = 10  # that must converge
TRIED = np.geomspace(0.01, 5.0, 80)  # h w_max of single steps
STATES, STATES_QUICK = 40, 2  # along the motion, from which these are tried


def frequencies(problem: Problem) -> Array:
    """Angular frequencies, rad/s, in increasing order, of the straight beam with its base at rest."""
    q, n = problem.q0, problem.q0.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, q, np.zeros(n), problem.system.functions.p, K)
    return np.sqrt(np.maximum(eigh(-K[2:, 2:], problem.system.mass(0.0, q)[2:, 2:], eigvals_only=True), 0.0))


def jacobi_limit(tableau: Tableau) -> float:
    """h w_max up to which an iteration on accelerations from all old stages converges: its rate is (x rho(A))^2."""
    return 1.0 / float(np.abs(np.linalg.eigvals(tableau.A)).max())


def gauss_seidel_limit(tableau: Tableau) -> float:
    """The same of the paper's iteration on [v, q], which uses the latest stages.

    With K_j = B (K_j's sum over A), B = x [[0, -1], [1, 0]] and L the part of A below its diagonal, one iteration is
    K_new = B (L K_new + (A - L) K_old).
    """
    lower = np.tril(tableau.A, -1)

    def rate(x: float) -> float:
        B = x * np.array([[0.0, -1.0], [1.0, 0.0]])
        iteration = np.linalg.solve(np.eye(2 * tableau.stages) - np.kron(lower, B), np.kron(tableau.A - lower, B))
        return float(np.abs(np.linalg.eigvals(iteration)).max())

    return float(brentq(lambda x: rate(x) - 1.0, 0.1, 20.0))


def limit_rows() -> Iterator[Row]:
    """Limits in theory, and up to which step (33) lets the linearised beam pass, by the tolerance of (32)."""
    problem = ancf_beam(youngs_modulus=2e6, amplitude=TINY, angular_frequency=1.0, gravity=0.0)
    w_max, sun = float(frequencies(problem)[-1]), sun_radau_iib(3)
    for name, theory in ((GAUSS_SEIDEL, gauss_seidel_limit(sun)), (JACOBI, jacobi_limit(sun))):
        yield {"group": "limit", "solver": name, "w_max": w_max, "theory": theory}
    for share in STOPPED_AT:
        method = paper_irk(ERR_IN, share * TINY)
        longest = _longest(problem, (0.0, problem.q0, problem.v0), w_max, method, LINEARISED_STEPS)
        yield {"group": "growth test", "solver": GAUSS_SEIDEL, "tol": share, "w_max": w_max, "measured": longest}


def along_rows(known: dict[str, Case], quick: bool) -> Iterator[Row]:
    """The paper's procedure from states along its own run: the longest step before the first that does not converge.

    A row a state, the first at the start of the motion.
    """
    for case in known.values():
        problem, method = case.problem, paper_irk()
        run = solve_dae(*case.start, method=method, rtol=PAPER_TOL, atol=PAPER_TOL)
        straight = float(frequencies(problem)[-1])
        for k in np.linspace(0, run.t.size - 2, STATES_QUICK if quick else STATES).astype(int):
            t, q, v = float(run.t[k]), run.q[:, k].copy(), run.v[:, k].copy()
            row: Row = {"group": "along", "case": case.name, "solver": GAUSS_SEIDEL, "t_end": t, "straight": straight}
            longest = _longest(problem, (t, q, v), straight, method, 1)
            yield row | {"measured": longest}


def _longest(problem: Problem, state: tuple[float, Array, Array], w_max: float, method: Method, n_steps: int) -> float:
    """h w_max of the longest step tried from a state below the shortest that does not converge; 0: none does."""
    t, q, v = state
    longest = 0.0
    for x in TRIED:
        end = t + n_steps * float(x) / w_max
        if not solve_dae(problem.system, (t, end), q, v, method=method, step_size=(end - t) / n_steps).success:
            return longest
        longest = float(x)
    return longest


TOL = {SOFT: 1e-4, STIFF: 1e-3}  # of RadauIIA5, whose error then is far below all differences
PARTING = 1.2  # s, until which the paper's very flexible results agree with those that it compares with
PARAMETERS, MESH, START = ("E + 0.1 %", "g + 0.1 %"), "8 elements", "start of the whole beam"
CHANGES = (*PARAMETERS, MESH, START)


def sensitivity_rows(known: dict[str, Case]) -> Iterator[Row]:
    """Largest change of the tip's height, until the paper's 1.2 s and over the run, of beams that differ a little."""
    for name, case in known.items():
        times = np.append(0.0, case.instants)
        given = dict(case.problem.parameters)
        changed: list[dict[str, Any]] = [{key: 1.001 * given[key]} for key in ("youngs_modulus", "gravity")]
        changed += [{"n_elements": 8}, {"start": "beam"}]  # in the order of CHANGES
        given_tip = _tip(given, TOL[name], times)
        for change, what in zip(CHANGES, changed, strict=True):
            off = np.abs(_tip({**given, **what}, TOL[name], times) - given_tip)
            row: Row = {"group": "sensitivity", "case": name, "solver": change, "t_end": case.t_end}
            yield row | {"before": float(off[times <= PARTING].max()), "largest": float(off.max())}


def _tip(parameters: dict[str, Any], tol: float, times: Array) -> Array:
    problem, span = ancf_beam(**parameters), (0.0, float(times[-1]))
    start = problem.q0, problem.v0
    result = solve_dae(problem.system, span, *start, method=NEWTON, rtol=tol, atol=tol, t_eval=times)
    if not result.success:
        raise RuntimeError(f"a changed beam, {parameters}: {result.message}")
    return np.asarray(tip_height(result.q))

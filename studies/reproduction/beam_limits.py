"""The step limit of fixed-point iteration on the beams, and how far the tip depends on the model."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import brentq

from studies.bench.cases.beam import SOFT, STIFF
from studies.bench.collector import Case
from studies.bench.store import Array, Row
from twoloop import solve_dae
from twoloop.mechanisms import Problem, ancf_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import elastic_tangent, tip_height
from twoloop.methods.tableaux import Tableau, sun_radau_iib

GAUSS_SEIDEL = "Sun Radau IIB 3, latest stages (Gauss–Seidel, the paper's)"
# RadauIIA5 at these tolerances is far more accurate than the changes are large
METHOD, TOL = "RadauIIA5", {SOFT: 1e-4, STIFF: 1e-3}
PARTING = 1.2  # s, until which the paper's very flexible results agree with those that it compares with
PARAMETERS, MESH = ("E + 0.1 %", "g + 0.1 %"), "8 elements"


def frequencies(problem: Problem) -> Array:
    """Return the angular frequencies, rad/s, in increasing order, of the straight beam with its base at rest."""
    q, n = problem.q0, problem.q0.size
    K = np.zeros((n, n))
    elastic_tangent(0.0, q, np.zeros(n), problem.system.functions.p, K)
    return np.sqrt(np.maximum(eigh(-K[2:, 2:], problem.system.mass(0.0, q)[2:, 2:], eigvals_only=True), 0.0))


def gauss_seidel_limit(tableau: Tableau) -> float:
    """Find the largest h w_max at which the paper's iteration on [v, q] converges, which uses the latest stages.

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
    """Make the row of the limit in theory, and of the largest frequency w_max of the very flexible beam."""
    w_max = float(frequencies(very_flexible_beam())[-1])
    yield {"group": "limit", "solver": GAUSS_SEIDEL, "w_max": w_max, "theory": gauss_seidel_limit(sun_radau_iib(3))}


def sensitivity_rows(known: Mapping[str, Case]) -> Iterator[Row]:
    """Find the largest change of the tip's height, until 1.2 s and over the run, of beams that differ a little."""
    for name, case in known.items():
        times, given = np.append(0.0, case.instants), dict(case.problem.parameters)
        changes: dict[str, dict[str, Any]] = {MESH: {"n_elements": 8}}
        for what, key in zip(PARAMETERS, ("youngs_modulus", "gravity"), strict=True):
            changes[what] = {key: 1.001 * given[key]}
        tip = _tip(given, TOL[name], times)
        for what, change in changes.items():
            off = np.abs(_tip({**given, **change}, TOL[name], times) - tip)
            row: Row = {"group": "sensitivity", "case": name, "solver": what, "t_end": case.t_end}
            yield row | {"before": float(off[times <= PARTING].max()), "largest": float(off.max())}


def _tip(parameters: dict[str, Any], tol: float, times: Array) -> Array:
    problem = ancf_beam(**parameters)
    start = problem.system, (0.0, float(times[-1])), problem.q0, problem.v0
    result = solve_dae(*start, method=METHOD, rtol=tol, atol=tol, t_eval=times)
    if not result.success:
        raise RuntimeError(f"a changed beam, {parameters}: {result.message}")
    return np.asarray(tip_height(result.q))

"""How the beam's motion and cost depend on the model: changed beams, more elements, stiffer ones."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from studies.beam.limits import Row, frequencies
from studies.beam.runs import NEWTON, PAPER, PAPER_TOL, Array, with_less_known
from studies.bench import Case
from studies.cases.beam import SOFT, STIFF
from twoloop import Result, RungeKutta, paper_irk, solve_dae
from twoloop.mechanisms import Problem, ancf_beam, very_flexible_beam
from twoloop.mechanisms.ancf_beam import tip_height
from twoloop.plan import Method
from twoloop.tableaux import radau_iia

ELEMENTS, ELEMENTS_QUICK = (4, 8, 16, 32, 64), (4, 8)
FIXED_STEP, FIXED_STEPS, FIXED_STEPS_QUICK = 2e-4, 50, 5  # s and number, of the runs with many elements
FIXED_REPEATS = 5  # of which the median counts
MODULI, MODULI_QUICK = (2e6, 2e7, 2e8, 2e9, 2e10), (2e8, 2e9)
SHORT = 0.02  # s; the paper's procedure is run for so long only
MODULUS_TOLS = (1e-1, 1e-2, 1e-3)
FINE_STAGES, FINE_TOL = 5, 1e-4  # of Radau IIA with Newton's method, the reference there
SENSITIVE_TOL = {SOFT: 1e-4, STIFF: 1e-3}  # of RadauIIA5, whose error then is far below all differences
LOOSER_TOL = 1e-2
PARTING = 1.2  # s, until which the paper's very flexible results agree with those that it compares with
PARAMETERS, MESH, START = ("E + 0.1 %", "g + 0.1 %"), "8 elements", "start of the whole beam"
TOLERANCE = "rtol = atol = 1e-2"
CHANGES = (*PARAMETERS, MESH, START, TOLERANCE)


def _run(problem: Problem, method: str | Method, tol: float, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    return solve_dae(problem.system, span, problem.q0, problem.v0, method=method, rtol=tol, atol=tol, t_eval=times)


def sensitivity_rows(known: dict[str, Case]) -> Iterator[Row]:
    """Largest change of the tip's height, until the paper's 1.2 s and over the run, of beams that differ a little."""
    for name, case in known.items():
        times = np.append(0.0, case.instants)
        given = dict(case.problem.parameters)
        changes: dict[str, dict[str, Any]] = {
            PARAMETERS[0]: {"youngs_modulus": 1.001 * given["youngs_modulus"]},
            PARAMETERS[1]: {"gravity": 1.001 * given["gravity"]},
            MESH: {"n_elements": 8},
            START: {"start": "beam"},
            TOLERANCE: {},
        }
        given_tip = _tip(given, SENSITIVE_TOL[name], times)
        for change, what in changes.items():
            tol = LOOSER_TOL if change == TOLERANCE else SENSITIVE_TOL[name]
            off = np.abs(_tip({**given, **what}, tol, times) - given_tip)
            row: Row = {"group": "sensitivity", "case": name, "solver": change, "t_end": case.t_end}
            yield row | {"before": float(off[times <= PARTING].max()), "largest": float(off.max())}


def _tip(parameters: dict[str, Any], tol: float, times: Array) -> Array:
    result = _run(ancf_beam(**parameters), NEWTON, tol, times)
    if not result.success:
        raise RuntimeError(f"a changed beam, {parameters}: {result.message}")
    return np.asarray(tip_height(result.q))


def element_rows(quick: bool) -> Iterator[Row]:
    """Cost of a step of fixed size with Newton's method, with the band of the matrices known and unknown."""
    steps = FIXED_STEPS_QUICK if quick else FIXED_STEPS
    end = steps * FIXED_STEP
    for n_elements in ELEMENTS_QUICK if quick else ELEMENTS:
        problem = very_flexible_beam(n_elements)
        for kind, system in (("dense", with_less_known(problem, tangent=True)), ("banded", problem.system)):
            method = RungeKutta(radau_iia(3), "newton")
            runs = [
                solve_dae(system, (0.0, end), problem.q0, problem.v0, method=method, step_size=FIXED_STEP)
                for _ in range(FIXED_REPEATS)
            ]
            row = _costs(runs[0]) | {"group": "elements", "solver": kind, "n_elements": n_elements, "t_end": end}
            yield row | {"cpu_s": float(np.median([run.stats.cpu_time for run in runs]))}


def modulus_rows(quick: bool) -> Iterator[Row]:
    """Cost of fixed-point iteration and Newton's method against E; the base moves as the moderately stiff beam's."""
    for modulus in MODULI_QUICK if quick else MODULI:
        problem = ancf_beam(youngs_modulus=modulus, amplitude=-0.01, angular_frequency=2.0 * np.pi)
        w_max = float(frequencies(problem)[-1])
        times = np.linspace(0.0, 0.1 if quick else 2.0, 21)
        fine = _run(problem, RungeKutta(radau_iia(FINE_STAGES), "newton"), FINE_TOL, times)
        short = np.array([0.0, SHORT / 10 if quick else SHORT])
        runs: list[tuple[str, Method, float, Array]] = [
            (NEWTON, RungeKutta(radau_iia(3), "newton"), tol, times) for tol in MODULUS_TOLS
        ]
        runs.append((PAPER, paper_irk(), PAPER_TOL, short))
        for solver, method, tol, at in runs:
            result = _run(problem, method, tol, at)
            known = result.success and fine.success and at is times
            error = float(np.abs(tip_height(result.q) - tip_height(fine.q)).max()) if known else np.nan
            row = _costs(result) | {"group": "modulus", "solver": solver, "modulus": modulus, "tol": tol}
            yield row | {"t_end": float(at[-1]), "w_max": w_max, "error_tip": error, "error_q": error, "floor": 0.0}


def _costs(result: Result) -> Row:
    stats = result.stats
    row: Row = {"status": result.status.name, "n_steps": stats.n_accepted, "cpu_s": stats.cpu_time}
    return row | {name: getattr(stats, name) for name in ("n_evaluations", "n_jacobians", "n_factorizations")}

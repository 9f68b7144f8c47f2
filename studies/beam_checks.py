"""The beam by other people: IDA on the same equations, digit by digit, and Exudyn's beams on equations of their own."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from references.beam_reduced import reduced_motion
from references.exudyn_beam import solve_exudyn_beam
from references.ida import solve_ida
from studies.beam_runs import CASES, SOFT, STIFF, TRUTH_TOL, instants
from studies.report import Array
from twoloop import Result, RungeKutta, solve_dae
from twoloop.mechanisms import Problem, ancf_beam, moderately_stiff_beam
from twoloop.mechanisms.ancf_beam import tip_height
from twoloop.tableaux import radau_iia

DIGITS_AT = {SOFT: 1.0, STIFF: 2.0}  # s; the very flexible beam's tip is too sensitive later
IDA_TOL = 1e-8
ELEMENTS = (4, 8, 16)
CABLE, CABLE_STEPS = 16, 2000  # elements and steps of Exudyn's cable, whose own error is then some 1e-5 m
TOL = 1e-4  # of Radau IIA with Newton's method: its error is far below the distances
LOCKED = 0.7 / (1.3 * 0.4)  # (lambda + 2 mu) / E at Poisson's ratio 0.3


def check_rows() -> Iterator[dict[str, Any]]:
    """Rows of both checks."""
    yield from _digits()
    yield from _distances()


def _digits() -> Iterator[dict[str, Any]]:
    for case, t in DIGITS_AT.items():
        problem = CASES[case]()
        times = instants(t)
        truth = tip_height(reduced_motion(problem, times, TRUTH_TOL)[0])[-1]
        tip = tip_height(_ida(problem, times).q)[-1]
        row = {"group": "check", "case": case, "solver": "IDA, scikit-sundae, exact tangent", "tol": IDA_TOL}
        yield row | {"t_end": t, "tip": float(tip), "error_tip": float(abs(tip - truth))}


def _ida(problem: Problem, times: Array) -> Result:
    span = (0.0, float(times[-1]))
    return solve_ida(
        problem.system,
        span,
        problem.q0,
        problem.v0,
        "stabilised",
        IDA_TOL,
        IDA_TOL,
        t_eval=times,
    )


def _distances() -> Iterator[dict[str, Any]]:
    for ratio, stiffness in ((0.0, 1.0), (0.3, LOCKED), (0.3, 1.0)):
        cable = _cable(stiffness)
        for n in ELEMENTS if ratio == 0.0 else ELEMENTS[-1:]:
            problem = _beam(n, 1.0) if ratio == 0.0 else moderately_stiff_beam(n, "beam")
            span, times = (0.0, 1.0), instants(1.0)
            method = RungeKutta(radau_iia(3), outer="newton")
            result = solve_dae(problem.system, span, problem.q0, problem.v0, method, TOL, TOL, t_eval=times)
            far = float(np.abs(tip_height(result.q) - cable).max()) if result.success else float("nan")
            row = {
                "group": "check",
                "case": "Exudyn's cable",
                "n_elements": n,
                "poisson": ratio,
                "stiffness": stiffness,
            }
            yield row | {"t_end": 1.0, "error_tip": far}


def _beam(n_elements: int, stiffness: float) -> Problem:
    """The moderately stiff beam at Poisson's ratio 0, all of it moving at the start."""
    return ancf_beam(
        n_elements,
        "beam",
        youngs_modulus=stiffness * 2e8,
        amplitude=-0.01,
        angular_frequency=2.0 * math.pi,
        poisson_ratio=0.0,
    )


def _cable(stiffness: float) -> Array:
    """Tip heights of Exudyn's cable, of CABLE elements."""
    result = solve_exudyn_beam(_beam(CABLE, stiffness), 1.0, CABLE_STEPS, "cable", store_every=CABLE_STEPS // 10)
    if not result.success:
        raise RuntimeError(result.message)
    return np.asarray(tip_height(result.q))

"""How often a method's error estimate deceives it: accepted steps whose true local error is above the tolerance.

As DETEST counts them (Hull, Enright, Fellen and Sedgwick, SIAM J. Numer. Anal. 9 (1972) 603-637): from the state at the
begin of an accepted step the exact motion is followed to its end. Exact is SciPy's DOP853 on index 1 at 1e-13, which
shares no code with our methods.
"""

from unittest.mock import patch

import numpy as np

from references.scipy.index1 import solve_index1
from studies.bench.collector import Case, Run, attempt
from studies.bench.store import Array, Row
from twoloop import Result
from twoloop.mechanisms import Problem

DECEIVED = "deceived steps"  # group of runs
SAMPLED = 26  # steps of a run, evenly spaced, the first of which is judged apart: it has no history to estimate from
EXACT = 1e-13
LIMIT = 2.0  # s: rounding may keep SciPy's solver from so small an error, and a step that takes so long is left out


def local_errors(problem: Problem, result: Result, tolerance: float, sampled: int = SAMPLED) -> Array:
    """True local errors over the tolerances, of positions and velocities, of some steps of a run that stores all."""
    places = np.unique(np.linspace(0, result.t.size - 2, sampled).astype(int))
    errors = []
    for k in places:
        span = (float(result.t[k]), float(result.t[k + 1]))
        with patch("references.driver.check_start"):  # SciPy's states drift off the constraints
            start = problem.system, span, result.q[:, k], result.v[:, k]
            exact = solve_index1(*start, "DOP853", EXACT, EXACT, time_limit=LIMIT)
        worst = 0.0
        for name in ("q", "v"):
            own, true = getattr(result, name)[:, k + 1], getattr(exact, name)[:, -1]
            scale = tolerance + tolerance * np.maximum(np.abs(getattr(result, name)[:, k]), np.abs(own))
            worst = max(worst, float(np.abs((own - true) / scale).max()))
        errors.append(worst if exact.success else np.nan)
    return np.array(errors)


def row_of(run: Run) -> Row:
    """A run and how many of its steps after the first were deceived; none where there is no run or no exact motion."""
    case: Case = run.case
    row: Row = {"group": DECEIVED, "case": case.name, "solver": run.solver.name, "family": run.solver.family}
    row |= {**run.settings, "t_end": case.t_end, "n_sampled": 0, "n_deceived": 0}
    row |= {"worst_step": None, "first_step": None}
    result, row["status"], row["message"], _ = attempt(run, 0)
    if result is None or result.t.size < 3:
        return row
    try:
        errors = local_errors(case.problem, result, run.value)
    except (ValueError, np.linalg.LinAlgError) as error:
        return row | {"message": f"no exact motion on index 1: {error}"}
    first, later = float(errors[0]), errors[1:][np.isfinite(errors[1:])]
    row |= {"n_sampled": later.size, "n_deceived": int((later > 1.0).sum()), "first_step": first}
    return row | {"worst_step": float(later.max(initial=0.0))}

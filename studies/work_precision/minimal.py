"""Run heyoka, CyRK and CVODE in minimal coordinates, beside the methods of twoloop with constraints.

On the mechanisms whose loops close in closed form (`minimal.equations`). The rows are a group of their own, which no
ranking of solvers of a DAE sees. A part of `studies.work_precision`.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from references.minimal.solvers import has_minimal
from studies.bench import adaptive, headline
from studies.bench.cli import Call
from studies.bench.collector import REPEATS, Run
from studies.bench.end_states import case_of
from studies.bench.solvers import CATALOGUE, HEYOKA, MINIMAL
from studies.bench.store import KeptRows
from studies.work_precision import mechanisms
from twoloop.mechanisms import Problem

GROUP = "minimal coordinates"
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
HEYOKAS_OWN = float(np.finfo(float).eps)  # the tolerance that heyoka takes where none is given
WRONG, ASKED = 0.1, 1e-4  # a run that ends with this error, though it was asked for a thousandth of it, is wrong
TIME_LIMIT = 10.0  # s of CPU; heyoka's loosest runs may be its slowest, and what passes it twice is not asked on
PENDULUMS = {"A01 pendulum", "projection pendulum", "double pendulum"}  # no loops; from rest in a horizontal position


def problems(quick: bool) -> dict[str, Problem]:
    """Make the mechanisms that have minimal coordinates."""
    return {name: problem for name, problem in mechanisms.problems(quick).items() if has_minimal(problem)}


def runs(quick: bool) -> list[Run]:
    """List the runs of all solvers."""
    found = []
    for name, problem in problems(quick).items():
        case = replace(case_of(problem), name=name, time_limit=TIME_LIMIT, timed=mechanisms.TIMED)
        values = mechanisms.QUICK_TOLERANCES if quick else TOLERANCES
        repeats = 1 if quick else REPEATS
        for solver in MINIMAL:
            own = (HEYOKAS_OWN,) if solver.startswith(HEYOKA) and not quick else ()
            found += [Run(case, CATALOGUE[solver], value, GROUP, repeats) for value in (*values, *own)]
    return found


def collect(kept: KeptRows, call: Call) -> pd.DataFrame:
    """Make the rows of the runs, the repetitions interleaved."""
    todo, errors = call.wanted(runs(call.quick)), () if call.quick else mechanisms.RESOLVED
    return adaptive.collect(todo, kept, mechanisms.row_at_end, lambda run: True, errors)


def findings_of(rows: pd.DataFrame, everywhere: pd.DataFrame) -> list[dict[str, Any]]:
    """Compare the ODE in minimal coordinates with the best of twoloop with constraints, by kind of mechanism.

    `rows` and `everywhere` (of `mechanisms`): medians.
    """
    if not len(rows):
        return []
    cases = rows["case"].astype(str)
    crossing, pendulums = cases.isin(mechanisms.singular()), cases.isin(PENDULUMS)
    kinds = {"loops": ~crossing & ~pendulums, "pendulums": pendulums, "singular positions": crossing}
    return [{"kind": kind, **_of_kind(rows[own], everywhere)} for kind, own in kinds.items() if own.any()]


def _of_kind(rows: pd.DataFrame, everywhere: pd.DataFrame) -> dict[str, Any]:
    at = []
    for case, own in rows.groupby("case", sort=False):
        ours = everywhere[(everywhere["case"] == case) & (everywhere["family"] == "two-loop")]
        at += [
            each[headline.BEST]
            for each in headline.of_errors(pd.concat([ours, own], ignore_index=True), mechanisms.RESOLVED)
        ]
    verdicts, ratios = [each["verdict"] for each in at], [each["ratio"] for each in at if each["ratio"] is not None]
    found: dict[str, Any] = {"mechanisms": rows["case"].nunique(), "ours_faster": verdicts.count("ahead")}
    found["slower"] = verdicts.count("behind") + verdicts.count("missed")  # with errors that only the ODE reaches
    found["n"] = len(ratios) + verdicts.count("missed")
    found["median"] = float(np.median(ratios)) if ratios else None
    done = rows[rows["error_q"].notna() & (rows["tol"] <= ASKED)]
    wrong = done[done["error_q"].astype(float) > WRONG]
    by, of = wrong["solver"].value_counts(sort=False), done["solver"].value_counts()
    found["wrong_by"] = {str(name): {"wrong": int(n), "n": int(of[name])} for name, n in by.items()}
    return found

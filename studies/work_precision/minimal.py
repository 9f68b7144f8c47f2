"""Should I use a DAE at all? heyoka, CyRK and CVODE in minimal coordinates, beside ours and rivals with constraints.

On the mechanisms whose loops close in closed form (`minimal.equations`). The rows are a group of their own, which no
ranking of solvers of a DAE sees. A part of `studies.work_precision`.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from references.minimal.equations import has_minimal
from studies.bench import adaptive, headline
from studies.bench.collector import REPEATS, Run
from studies.bench.end_states import case_of
from studies.bench.solvers import CATALOGUE, HEYOKA, MINIMAL
from studies.bench.store import KeptRows
from studies.work_precision import rivals
from twoloop.mechanisms import Problem

GROUP = "minimal coordinates"
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
ERRORS = tuple(error for errors in list(rivals.RANGES.values())[:2] for error in errors)  # not those of rounding
HEYOKAS_OWN = float(np.finfo(float).eps)  # the tolerance that heyoka takes where none is given
WRONG, ASKED = 0.1, 1e-4  # a run that ends with this error, though it was asked for a thousandth of it, is wrong
TIME_LIMIT = 10.0  # s of CPU; heyoka's loosest runs may be its slowest, and what passes it twice is not asked on
PENDULUMS = {"A01 pendulum", "projection pendulum", "double pendulum"}  # no loops; from rest in a horizontal position

SINGULAR = "A02"  # whose variants lose rank; the one angle knows no such positions


def problems(quick: bool) -> dict[str, Problem]:
    """Every mechanism that has minimal coordinates."""
    return {name: problem for name, problem in rivals.problems(quick).items() if has_minimal(problem)}


def runs(quick: bool, names: Sequence[str] = ()) -> list[Run]:
    """All solvers on the mechanisms of these names, or on all."""
    found, known = [], problems(quick)
    for name in names or known:
        case = replace(case_of(known[name]), name=name, time_limit=TIME_LIMIT, timed=rivals.TIMED)
        values = rivals.QUICK_TOLERANCES if quick else TOLERANCES
        repeats = 1 if quick else REPEATS
        for solver in MINIMAL:
            own = (HEYOKAS_OWN,) if solver.startswith(HEYOKA) and not quick else ()
            found += [Run(case, CATALOGUE[solver], value, GROUP, repeats) for value in (*values, *own)]
    return found


def collect(kept: KeptRows, quick: bool, names: Sequence[str] = ()) -> pd.DataFrame:
    """Rows of all runs, the repetitions interleaved."""
    return adaptive.collect(runs(quick, names), kept, rivals.row_at_end, lambda run: True, () if quick else ERRORS)


def at_errors(rows: pd.DataFrame, others: pd.DataFrame) -> list[dict[str, Any]]:
    """How the best of ours with constraints stands at each error beside the cheapest without (`rows`)."""
    both = pd.concat([others[others["family"] == "two-loop"], rows], ignore_index=True)
    found = headline.of_errors(both, ERRORS)
    return [at[headline.BEST] | {"error": error} for error, at in zip(ERRORS, found, strict=True)]


def findings_by_kind(rows: pd.DataFrame, everywhere: pd.DataFrame) -> list[dict[str, Any]]:
    """The findings of mechanisms with loops and of pendulums, as far as there are rows of them."""
    if not len(rows):
        return []
    of_pendulums, singular = rows["case"].isin(PENDULUMS), rows["case"].astype(str).str.startswith(SINGULAR)
    loops = rows[~of_pendulums & ~singular]
    kinds = (("loops", loops), ("pendulums", rows[of_pendulums]), ("singular", rows[singular]))
    return [{"kind": kind, **findings_of(own, everywhere)} for kind, own in kinds if len(own)]


def findings_of(rows: pd.DataFrame, everywhere: pd.DataFrame) -> dict[str, Any]:
    """By mechanism and error, minimal coordinates beside constraints; `rows` and `everywhere` (`rivals`): medians."""
    rows = rows if len(rows) else pd.DataFrame(columns=["case", "solver", "tol", "error_q"])
    made: list[dict[str, Any]] = [
        {"case": str(name), "at": at_errors(own, everywhere[everywhere["case"] == name])}
        for name, own in rows.groupby("case", sort=False)
        if (everywhere["case"] == name).any()
    ]
    every = [at for each in made for at in each["at"]]
    pairs = [at for at in every if at["ratio"] is not None or at["verdict"] == "missed"]
    verdicts, ratios = [at["verdict"] for at in pairs], [at["ratio"] for at in pairs if at["ratio"] is not None]
    found: dict[str, Any] = {"mechanisms": made, "n": len(pairs), "wrong_from": WRONG}
    asked = rows[rows["error_q"].notna() & (rows["tol"] <= ASKED)]
    wrong = asked[asked["error_q"].astype(float) > WRONG]
    found |= {"asked": len(asked), "asked_at": ASKED, "wrong": len(wrong)}
    released = set(wrong["case"][wrong["solver"].astype(str).str.startswith(HEYOKA)])
    found["level"] = sorted(released) if released <= PENDULUMS else []
    found["by_default"] = bool((wrong["tol"] == HEYOKAS_OWN).any())
    counts, of = wrong["solver"].value_counts(sort=False), asked["solver"].value_counts()
    found["wrong_by"] = [{"solver": str(name), "n": int(n), "asked": int(of[name])} for name, n in counts.items()]
    found |= {f"n_{verdict}": verdicts.count(verdict) for verdict in ("ahead", "behind", "undecided", "missed")}
    found["n_behind"] += found["n_missed"]  # as on the first screen: what only others reach
    sizes = (min(ratios), float(np.median(ratios)), max(ratios)) if ratios else (None, None, None)
    return found | dict(zip(("least", "median", "most"), sizes, strict=True))

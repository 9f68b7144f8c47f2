"""Should I use a DAE at all? heyoka and CVODE in minimal coordinates, beside ours and rivals with constraints.

On the mechanisms whose loops close in closed form (`minimal.equations`). The rows are a group of their own, which no
ranking of solvers of a DAE sees. A part of `studies.work_precision`.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from references.minimal.equations import MAKE
from studies.bench import adaptive, headline, tables
from studies.bench.collector import REPEATS, Run
from studies.bench.end_states import case_of
from studies.bench.solvers import CATALOGUE, MINIMAL
from studies.bench.store import KeptRows
from studies.work_precision import rivals

GROUP = "minimal coordinates"
RIVAL = "fastest rival"
ERRORS = (1e-3, 1e-6, 1e-9, 1e-12)
TOLERANCES = (1e-3, 1e-5, 1e-7, 1e-9, 1e-11, 1e-13)
WRONG, ASKED = 0.1, 1e-3  # a run that ends with this error, though it was asked for at least so much, is wrong
TIME_LIMIT = (
    10.0  # s of CPU; heyoka's loosest runs may be its slowest, and what passes the limit twice running is not asked on
)


def runs(quick: bool) -> list[Run]:
    """Both solvers on every mechanism that has minimal coordinates."""
    found = []
    for name, problem in rivals.problems(quick).items():
        if problem.system.name in MAKE:
            case = replace(case_of(problem), name=name, time_limit=TIME_LIMIT, timed=rivals.TIMED)
            values = rivals.QUICK_TOLERANCES if quick else TOLERANCES
            repeats = 1 if quick else REPEATS
            found += [Run(case, CATALOGUE[solver], value, GROUP, repeats) for solver in MINIMAL for value in values]
    return found


def collect(kept: KeptRows, quick: bool) -> pd.DataFrame:
    """Rows of all runs, the repetitions interleaved."""
    return adaptive.collect(runs(quick), kept, rivals.row_at_end, lambda run: True, () if quick else ERRORS)


def at_error(rows: pd.DataFrame, others: pd.DataFrame, error: float) -> dict[str, Any]:
    """The cheapest in minimal coordinates (`rows`) at one error on one mechanism, and how those with constraints stand.

    The ratio of each is the time in minimal coordinates over its own; `over_loop` is that over what our fastest spends
    in its own loop, without the rest of the call.
    """
    ours = others["family"] == "two-loop"
    found: dict[str, Any] = headline.of_error(pd.concat([others[ours], rows], ignore_index=True), error)
    cheapest = found[headline.BEST]["rival"]
    ranked = tables.costs_at(others[~ours], error)
    rival = min(ranked, key=lambda name: ranked[name][0], default=None)
    line = {"solver": rival, "call_s": None if rival is None else ranked[rival][0], "rival": cheapest}
    found[RIVAL] = line | tables.compared(ranked, tables.costs_at(rows, error, doubt=True))
    loops = [tables.time_for(own, error, "inside_s") for _, own in others[ours].groupby("solver")]
    loop = min((time for time in loops if not np.isnan(time)), default=None)
    beside = None if loop is None or cheapest["call_s"] is None else cheapest["call_s"] / loop
    return {"error": error, "minimal": cheapest, "standing": found, "over_loop": beside}


def findings_of(rows: pd.DataFrame, everywhere: pd.DataFrame) -> dict[str, Any]:
    """By mechanism and error, minimal coordinates beside constraints; `rows` and `everywhere` (`rivals`): medians."""
    made: list[dict[str, Any]] = []
    for name, own in rows.groupby("case", sort=False) if len(rows) else ():
        others = everywhere[everywhere["case"] == name]
        made.append({"case": str(name), "at": [at_error(own, others, error) for error in ERRORS]})
    best = [at["standing"][headline.BEST] for each in made for at in each["at"]]
    pairs = [each for each in best if each["ratio"] is not None]
    verdicts, ratios = [each["verdict"] for each in pairs], [each["ratio"] for each in pairs]
    found: dict[str, Any] = {"mechanisms": made, "n": len(pairs), "wrong_from": WRONG}
    asked = rows[rows["error_q"].notna() & (rows["tol"] <= ASKED)] if len(rows) else pd.DataFrame({"error_q": []})
    found |= {"asked": len(asked), "wrong": int((asked["error_q"].astype(float) > WRONG).sum())}
    wrong = asked[asked["error_q"].astype(float) > WRONG]
    found["wrong_by"] = [
        {"solver": str(name), "n": len(own), "cases": sorted(set(own["case"])), "tightest": float(own["tol"].min())}
        for name, own in (wrong.groupby("solver", sort=False) if len(wrong) else ())
    ]
    found |= {f"n_{verdict}": verdicts.count(verdict) for verdict in ("ahead", "behind", "undecided")}
    loops = [at["over_loop"] for each in made for at in each["at"] if at["over_loop"] is not None]
    found["over_loop"] = float(np.median(loops)) if loops else None
    sizes = (min(ratios), float(np.median(ratios)), max(ratios)) if ratios else (None, None, None)
    return found | dict(zip(("least", "median", "most"), sizes, strict=True))


def lines(found: dict[str, Any], error: float = rivals.IN_TABLE) -> Iterator[list[str]]:
    """Of the table: mechanism, and at an error the ratios of `auto`, compiled, our best and the fastest rival."""
    for each in found["mechanisms"]:
        standing = next(at["standing"] for at in each["at"] if at["error"] == error)
        yield [each["case"], *(_ratio(side) for side in standing.values())]


def _ratio(side: dict[str, Any]) -> str:
    """Bold: slower than in minimal coordinates; in brackets: undecided; a dash where one of the two is not there."""
    return "–" if side["ratio"] is None else rivals.cell(side)

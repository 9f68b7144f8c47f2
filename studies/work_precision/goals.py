"""What was aimed at beside the ratios of `studies.work_precision.rivals`, and what of it the rows reach.

A part of `studies.work_precision`.
"""

from collections.abc import Sequence
from itertools import product
from typing import Any

import pandas as pd

from studies.bench import tables
from studies.bench.collector import Case
from studies.bench.solvers import COMPILED, DEFAULT
from studies.work_precision import rivals

DEFAULT_OVER = 1.3  # times the time of the best of ours, that the default may take
LONG_CASE, LONG_END, LONG_ERROR, LONG_TIME = rivals.HEADLINE, 100.0, 1e-6, 0.010  # s
BEAM_ERRORS = (1e-2, 1e-3, 1e-4)  # m
FROM_C = "IDA from C"
VIOLATION = 1e-12  # of the constraints of the four-bars, at stored states


def findings_of(known: Sequence[Case], cases: pd.DataFrame, everywhere: pd.DataFrame) -> dict[str, Any]:
    """From the medians of the cases at length and of every mechanism."""
    return {
        "default": [of_default(everywhere, compiled) for compiled in (False, True)],
        "long": _long([case for case in known if case.name == LONG_CASE and case.t_end == LONG_END], cases),
        "stiff": [_stiff(case, cases) for case in known if "vibrations irrelevant" in case.tags],
        "violation": _violation(cases),
    }


def of_default(rows: pd.DataFrame, compiled: bool) -> dict[str, Any]:
    """The default's time over that of the best of ours, both with code made for the mechanism or both without.

    Over all mechanisms and decades that any of these reaches.
    """
    default = next(name for name in COMPILED if COMPILED[name] == DEFAULT) if compiled else DEFAULT
    own, over = rows[(rows["family"] == "two-loop") & (rows["solver"].isin(list(COMPILED)) == compiled)], []
    for (_, runs), error in product(own.groupby("case", sort=False), rivals.DECADES):
        ranked = tables.ranking(runs, error)
        if not ranked.empty:
            mine = ranked[ranked["solver"] == default]["call_s"]
            over.append(float(mine.iloc[0] / ranked["call_s"].iloc[0]) if len(mine) else None)
    reached = [each for each in over if each is not None]
    found = {"solver": default, "compiled": compiled, "limit": DEFAULT_OVER, "n": len(over)}
    found |= {"n_unreached": len(over) - len(reached), "worst": max(reached, default=None)}
    return found | {"n_within": sum(each <= DEFAULT_OVER for each in reached)}


def _long(known: Sequence[Case], rows: pd.DataFrame) -> dict[str, Any] | None:
    """The cheapest of ours on the long motion; None where it is not among the cases (a quick run)."""
    for case in known:
        best = tables.of_both(tables.ranking(rows[rows["case"] == case.name], LONG_ERROR))["ours"]
        found = {"case": case.name, "t_end": case.t_end, "error": LONG_ERROR, "limit": LONG_TIME}
        return found | {"solver": best and best["solver"], "call_s": best and best["call_s"]}
    return None


def _stiff(case: Case, rows: pd.DataFrame) -> dict[str, Any]:
    """The time of IDA driven from C, the better of its settings, over that of the best of ours; None: one has none.

    Ahead of it is ours where it gets to every error, and IDA takes longer or was asked to its end and does not.
    """
    found: dict[str, Any] = {"case": case.name, "errors": list(BEAM_ERRORS), "ratios": []}
    found |= {"ours_miss": [], "ida_misses": [], "ida_unasked": []}
    of_case = rows[rows["case"] == case.name]
    settings = [each for _, each in tables.put(of_case[of_case["solver"].str.startswith(FROM_C)]).groupby("solver")]
    for error in BEAM_ERRORS:
        ranked = tables.ranking(of_case, error)
        own, ida = ranked[ranked["family"] == "two-loop"], ranked[ranked["solver"].str.startswith(FROM_C)]
        told = len(own) > 0 and len(ida) > 0
        found["ratios"].append(float(ida["call_s"].iloc[0] / own["call_s"].iloc[0]) if told else None)
        found["ours_miss"] += [] if len(own) else [error]
        if not len(ida):
            missed = bool(settings) and all(tables.missed(each, error) for each in settings)
            found["ida_misses" if missed else "ida_unasked"].append(error)
    compared = [ratio for ratio in found["ratios"] if ratio is not None]
    lost = bool(found["ours_miss"]) or any(ratio <= tables.LEAST for ratio in compared)
    return found | {"lost": lost, "ahead": not lost and not found["ida_unasked"]}


def _violation(rows: pd.DataFrame) -> dict[str, Any] | None:
    """The largest violation of the positions by ours at any stored state of the four-bars."""
    own = rows[(rows["family"] == "two-loop") & rows["case"].isin(rivals.GEOMETRIES)]["violation_q"].dropna()
    return {"limit": VIOLATION, "largest": float(own.astype(float).max())} if len(own) else None

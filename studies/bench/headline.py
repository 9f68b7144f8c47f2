"""Compare twoloop with the fastest of the other solvers, on one mechanism at each error, by the time of the call.

Four settings represent twoloop: the default; the same with, and without, code generated for the mechanism; and the
fastest of its methods, which a user finds only by running all of them.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from studies.bench import tables
from studies.bench.solvers import COMPILED, DEFAULT, GIVEN, HEYOKA
from studies.bench.tables import SETTINGS, by_solver

OWN_CODE = next(name for name, method in COMPILED.items() if method == DEFAULT)
BEST = "best of ours"
WHOSE = (GIVEN, OWN_CODE, DEFAULT, BEST)
VERDICTS = ("ahead", "behind", "undecided", "alone", "missed", "none")
PRICED = (1e-4, 1e-6)  # errors at which single calls are shown
CHEAPER = 1.2  # by which a run that nearly gets there takes less time, where that is to be said
SEVERAL = {"CyRK": "CyRK", "CVODE from C": "SUNDIALS", "IDA from C": "SUNDIALS"}  # the best of whose settings counts
SCIPY = "SciPy's best"
COMPARED_BY = ("solver", "family", "status", "message", "error_q", "floor", "astray", "used", "times", "call_s")


def of_errors(rows: pd.DataFrame, errors: Iterable[float], given: str = DEFAULT) -> list[dict[str, dict[str, Any]]]:
    """Compare each of WHOSE with the fastest other solver on one case, at each of several errors.

    `rows`: medians of all solvers; `given`: the solver that is the default on this case. Returns for each error and
    name solver and call_s, those of the fastest other solver ("other"), and the result of `tables.compared`.
    """
    rows, found = rows[[name for name in (*COMPARED_BY, *SETTINGS) if name in rows]], []
    ours = rows["family"] == "two-loop"
    solvers = {name: given if name == GIVEN else name for name in WHOSE}
    parts = {name: rows[ours if name == BEST else rows["solver"] == solver] for name, solver in solvers.items()}
    sides = [by_solver(rows[which], "call_s") for which in (ours, ~ours)]
    for error in errors:
        own, others = tables.costs_at(sides[0], error), tables.costs_at(sides[1], error, doubt=True)
        near, at = tables.near_misses(rows[~ours], error), {}
        for name, solver in solvers.items():
            side = {each: cost for each, cost in own.items() if name == BEST or each == solver}
            verdict = compared(side, others, tables.near_misses(parts[name], error), near)
            at[name] = _cheapest(side) | {"other": _cheapest(others)} | verdict
        found.append(at)
    return found


def compared(own: tables.Costs, others: tables.Costs, *near: tables.Costs) -> dict[str, Any]:
    """Compare as `tables.compared` does; undecided where near misses of the slower side would not be slower."""
    found, (near_own, near_others) = tables.compared(own, others), near
    sides = {"ahead": (own, others | near_others), "behind": (own | near_own, others)}.get(found["verdict"])
    if sides and tables.compared(*sides)["verdict"] != found["verdict"]:
        found["verdict"] = "undecided"
    return found


def _cheapest(costs: tables.Costs) -> dict[str, Any]:
    solver = min(costs, key=lambda name: costs[name][0], default=None)
    return {"solver": solver, "call_s": None if solver is None else costs[solver][0]}


def counted(pairs: Iterable[Mapping[str, Mapping[str, Any]]], name: str) -> dict[str, Any]:
    """Count the verdicts on one of WHOSE over pairs of mechanism and error that any solver reaches.

    Reports show `faster`, and `slower`, which includes errors that only other solvers reach. The rest are not
    distinguishable, or reached only by twoloop.
    """
    reached = [each for each in pairs if any(it["verdict"] != "none" for it in each.values())]
    verdicts = [each[name]["verdict"] for each in reached]
    count = {verdict: verdicts.count(verdict) for verdict in VERDICTS}
    return {"n": len(reached), "faster": count["ahead"], "slower": count["behind"] + count["missed"], **count}


def calls(rows: pd.DataFrame, firsts: pd.DataFrame, case: str) -> dict[str, Any] | None:
    """Find what a call takes on one mechanism at PRICED, and the first call; None: the mechanism was not run.

    `rows`: medians, of all mechanisms and solvers. `firsts`: rows of `studies.work_precision.first_calls`.

    Returns case, t_end, errors, and lines: name, first_s or None, and at each error solver and call_s of the cheapest
    run that is good enough, or None; keeps (the constraints); near: error and call_s of a run that nearly gets there
    and takes much less time, or None.
    """
    rows = rows[rows["case"] == case]
    if rows.empty:
        return None
    first = firsts[(firsts["case"] == case) & firsts["first_call_s"].notna()] if "first_call_s" in firsts else firsts
    which = {name: rows["solver"] == name for name in (OWN_CODE, DEFAULT, HEYOKA)}
    which |= {name: (rows["family"] == of) & rows["solver"].str.startswith(name) for name, of in SEVERAL.items()}
    lines = []
    for name, chosen in (which | {SCIPY: rows["family"] == "SciPy"}).items():
        runs = rows[chosen]
        built = first[first["solver"].isin(runs["solver"])] if len(first) else first
        at = [_call(runs, error, doubt=name not in (DEFAULT, OWN_CODE)) for error in PRICED]
        first_s = float(built["first_call_s"].min()) if len(built) else None
        lines.append({"name": name, "first_s": first_s, "at": at})
    return {"case": case, "t_end": float(rows["t_end"].iloc[0]), "errors": list(PRICED), "lines": lines}


def _call(runs: pd.DataFrame, error: float, doubt: bool) -> dict[str, Any]:
    """Find the cheapest of some runs; `doubt`: by the rule of the verdicts, for solvers not run at about the error."""
    best = _cheapest(tables.costs_at(runs, error, doubt=doubt))
    if best["solver"] is None:
        return best | {"keeps": None, "near": None}
    keeps = bool(runs[runs["solver"] == best["solver"]].iloc[0]["keeps_constraints"])
    near = tables.nearly_there(runs, error)
    near = near[CHEAPER * near["call_s"] < best["call_s"]]
    if near.empty:
        return best | {"keeps": keeps, "near": None}
    run = near.loc[near["call_s"].astype(float).idxmin()]
    return best | {"keeps": keeps, "near": {"error": float(run["error_q"]), "call_s": float(run["call_s"])}}

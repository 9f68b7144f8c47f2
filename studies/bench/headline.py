"""The headline of the comparisons: the default, with code, without it, the best of ours afterwards, against all rivals.

In this order: a user who changes nothing gets the first, which is the second on small mechanisms and the third on
others, and the last by choosing among our methods when all have been run. Each is compared with the best of the same
rivals, on each mechanism at each error, by the time of the whole call.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from studies.bench import tables
from studies.bench.solvers import CATALOGUE, COMPILED, DEFAULT, GIVEN, HEYOKA
from studies.bench.tables import SETTINGS, by_solver

OWN_CODE = next(name for name, method in COMPILED.items() if method == DEFAULT)
BEST = "best of ours"
WHOSE = (GIVEN, OWN_CODE, DEFAULT, BEST)
STANDINGS = ("ahead", "behind", "undecided", "alone", "unasked")
PRICED = (1e-4, 1e-6)  # errors of the price on the first screen
CHEAPER = 1.2  # by which a run that nearly gets there takes less time, where that is to be said
SEVERAL = {"CyRK": "CyRK", "CVODE from C": "SUNDIALS", "IDA from C": "SUNDIALS"}  # the best of whose settings counts
SCIPY = "SciPy's best"
LOOKED_AT = (  # columns by which solvers are compared
    *("solver", "family", "status", "message", "error_q", "floor", "astray", "used", "times", "call_s"),
    *SETTINGS,
)


def of_errors(rows: pd.DataFrame, errors: Iterable[float], given: str = DEFAULT) -> list[dict[str, dict[str, Any]]]:
    """How each of WHOSE stands on one case at each of some errors, by the best of each.

    `rows`: medians, of all solvers; `given`: the solver that the default is on this case.
    """
    rows, found = rows[[name for name in LOOKED_AT if name in rows]], []
    ours = rows["family"] == "two-loop"
    solvers = {name: given if name == GIVEN else name for name in WHOSE}
    parts = {name: rows[ours if name == BEST else rows["solver"] == solver] for name, solver in solvers.items()}
    rivals, sides = rows[~ours], [by_solver(rows[which], "call_s") for which in (ours, ~ours)]
    for error in errors:
        own, others = tables.costs_at(sides[0], error), tables.costs_at(sides[1], error, doubt=True)
        near, at = tables.near_misses(rivals, error), {}
        for name, solver in solvers.items():
            side = {each: cost for each, cost in own.items() if name == BEST or each == solver}
            found_at = compared(side, others, tables.near_misses(parts[name], error), near)
            if found_at["verdict"] == "alone" and not asked(rivals, error):
                found_at["verdict"] = "unasked"
            at[name] = _told(side) | {"rival": _told(others)} | found_at
        found.append(at)
    return found


def compared(own: tables.Costs, others: tables.Costs, *near: tables.Costs) -> dict[str, Any]:
    """`tables.compared`, undecided where near misses of the slower side, of ours or of others, would not be slower."""
    found, (near_own, near_others) = tables.compared(own, others), near
    sides = {"ahead": (own, others | near_others), "behind": (own | near_own, others)}.get(found["verdict"])
    if sides and tables.compared(*sides)["verdict"] != found["verdict"]:
        found["verdict"] = "undecided"
    return found


def asked(rivals: pd.DataFrame, error: float) -> bool:
    """Whether rivals were put to a case (a refusal is our adapter's), and all of these to the end of what they can."""
    put = tables.put(rivals)
    return len(put) > 0 and all(tables.missed(own, error) for _, own in put.groupby("solver"))


def _told(costs: tables.Costs) -> dict[str, Any]:
    """The cheapest, and those of other projects that take as long within LEAST."""
    best = min(costs, key=lambda name: costs[name][0], default=None)
    if best is None:
        return {"solver": None, "call_s": None, "close": []}
    most = tables.LEAST * costs[best][0]
    close = [name for name, cost in costs.items() if cost[0] < most and _project(name) != _project(best)]
    return {"solver": best, "call_s": costs[best][0], "close": close}


def _project(solver: str) -> str:
    return CATALOGUE[solver].family if solver in CATALOGUE else solver


def counted(found: Iterable[Iterable[Mapping[str, Mapping[str, Any]]]]) -> list[dict[str, Any]]:
    """Of many pairs of mechanism and error, in how many each of WHOSE is ahead, behind, undecided, alone, missing.

    `found`: of each mechanism how they stand at each error. n are the pairs that any of ours or of others reaches;
    `lost` those of the missing that others reach; unbeaten the mechanisms, of n_mechanisms, for which `is_unbeaten`.
    """
    mechanisms = [list(own) for own in found]
    pairs = [each for own in mechanisms for each in own if any(it["verdict"] != "none" for it in each.values())]
    made = []
    for name in WHOSE:
        verdicts = [each[name]["verdict"] for each in pairs]
        line = {verdict: verdicts.count(verdict) for verdict in STANDINGS}
        line["lost"] = verdicts.count("missed")
        line["unbeaten"] = sum(is_unbeaten(own, name) for own in mechanisms)
        line["n_mechanisms"] = len(mechanisms)
        # "none" counts, too: the one in question does not get there, another of ours does
        made.append(
            {"name": name, "n": len(pairs), **line, "missed": len(pairs) - sum(line[verdict] for verdict in STANDINGS)}
        )
    return made


def is_unbeaten(found: Iterable[Mapping[str, Mapping[str, Any]]], name: str) -> bool:
    """Whether one of WHOSE is at no error behind on a mechanism, or missing where others get to."""
    verdicts = {each[name]["verdict"] for each in found}
    return not verdicts & {"behind", "missed"} and verdicts != {"none"}


def price(rows: pd.DataFrame, firsts: pd.DataFrame, case: str) -> dict[str, Any] | None:
    """What a call takes on one mechanism at PRICED, and the first call where code is built; None: it was not run.

    `rows`: medians, of all mechanisms and solvers. `firsts`: rows of `studies.work_precision.first_calls`.

    Returns case, processor ("": not kept), t_end, errors, first_at (tolerance of the first calls, None without them),
    and lines: name, first_s or None, and at each error solver, call_s, repeats of the cheapest run that is good enough
    (0: not kept), keeps (the constraints) and near (asked, error and call_s of a run that nearly gets there and takes
    much less, or None), or in their place why there is none: "not run", "not reached", "not asked".
    """
    rows = rows[rows["case"] == case]
    if rows.empty:
        return None
    first = firsts[(firsts["case"] == case) & firsts["first_call_s"].notna()] if "first_call_s" in firsts else firsts
    own = {name: rows["solver"] == name for name in (OWN_CODE, DEFAULT, HEYOKA)}
    best = {name: (rows["family"] == of) & rows["solver"].str.startswith(name) for name, of in SEVERAL.items()}
    lines = []
    for name, which in (own | best | {SCIPY: rows["family"] == "SciPy"}).items():
        runs, rival = rows[which], name not in (DEFAULT, OWN_CODE)
        built = first[first["solver"].isin(runs["solver"])] if len(first) else first
        first_s = float(built["first_call_s"].min()) if len(built) else None
        lines.append({"name": name, "first_s": first_s, "at": [_priced(runs, error, rival) for error in PRICED]})
    found = {"case": case, "t_end": float(rows["t_end"].iloc[0]), "errors": list(PRICED), "lines": lines}
    found["processor"] = str(rows["processor"].iloc[0]) if "processor" in rows else ""
    return found | {"first_at": float(first["tol"].iloc[0]) if len(first) else None}


def _priced(runs: pd.DataFrame, error: float, rival: bool) -> dict[str, Any]:
    """The cheapest of some solvers; rivals by the rule of the standings, where they were not run at about the error."""
    costs = tables.costs_at(runs, error, doubt=rival)
    solver = min(costs, key=lambda name: costs[name][0], default=None)
    if solver is not None:
        own, call_s = runs[runs["solver"] == solver], costs[solver][0]
        told: dict[str, Any] = {"keeps": bool(own.iloc[0]["keeps_constraints"]), "near": _near(runs, error, call_s)}
        told["repeats"] = int(tables.run_for(own, error).get("repeats", 0))
        return {"solver": solver, "call_s": float(call_s), "why": None} | told
    put = tables.put(runs)
    missed = all(tables.missed(own, error) for _, own in put.groupby("solver"))
    why = "not run" if put.empty else "not reached" if missed else "not asked"
    return {"solver": None, "call_s": None, "why": why, "keeps": True, "near": None}


def _near(runs: pd.DataFrame, error: float, call_s: float) -> dict[str, float] | None:
    """The cheapest run that misses an error by little and takes much less time than one that does not."""
    near = tables.nearly_there(runs, error)
    near = near[CHEAPER * near["call_s"] < call_s]
    if near.empty:
        return None
    run = near.loc[near["call_s"].astype(float).idxmin()]
    return {"asked": error, "error": float(run["error_q"]), "call_s": float(run["call_s"])}

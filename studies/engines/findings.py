"""What the rows of the engines say: what to set, what it costs, where errors end, and who is wrong without a word."""

from collections import Counter
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import tables
from studies.bench.changed_loops import DRIVEN, RATIOS, SERVO
from studies.bench.closed_loops import SPATIAL
from studies.bench.end_states import EXACT
from studies.bench.engine_runs import LIMIT
from studies.engines.configurations import AS_IT_COMES, CONFIGURATIONS, NAMES, OURS, Configuration
from twoloop.audit.step_audit import LOST, order_and_floor

GATE, RUN, MASS, TURN, MOTOR, ENERGY = "gate", "run", "mass", "turn", "motor", "energy"  # groups of rows
ERRORS = (1e-2, 1e-3, 1e-4, 1e-6)
SET_FOR = ERRORS[:3]  # for which a step is named
SPEEDS = (1, 100)  # times real time
PROBED = 5000  # steps, of the table of motors, masses, frames and forces
PROBES = {  # what is asked: mechanisms by the end of their names, groups, and measures, of which the median counts
    "as made; a body 1e2, 1e4 times lighter": (("", RUN, "error_q"), *((name, MASS, "error_q") for name in RATIOS)),
    "driven; with a PD motor": ((DRIVEN, MOTOR, "error_q"), (SERVO, MOTOR, "error_q")),
    "in space; turned": (("in space", RUN, "error_q"), ("", TURN, "error_q")),
    "force in a joint": (("", RUN, "error_f"),),
    "energy, 100 s": (("", ENERGY, "energy"),),
}
OWN = tuple(each.name for each in CONFIGURATIONS if each.engine == OURS)
IN_SPACE = tuple(build().name for build in SPATIAL)


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Versions, gates, what each configuration is off by, and what an accuracy costs."""
    runs, gates = rows[rows["group"] == RUN], rows[rows["group"] == GATE]
    cases = list(dict.fromkeys(runs["case"]))
    found: dict[str, Any] = {"cases": cases, "errors": list(ERRORS), "lost": LOST, "limit": LIMIT}
    found["absent"] = sorted(set(gates[gates["status"] == "NOT_AVAILABLE"]["family"]))
    found["versions"] = rows.dropna(subset="version").groupby("family")["version"].first().astype(str).to_dict()
    found["gates"] = gates[gates["status"] != "PASSED"][["case", "solver", "message"]].to_dict("records")
    found["n_gates"] = int((gates["status"] == "PASSED").sum())
    found["apart"] = float(runs["floor"].astype(float).max())
    found["configurations"] = [_configuration(each, runs[runs["solver"] == each.name]) for each in CONFIGURATIONS]
    cheapest = [_cheapest(runs[runs["case"] == case]) for case in cases]
    cheapest_of = [line["engines"] for line in cheapest]
    found["call_over_engines"] = {
        name: {case: line["ratios"].get(name) for case, line in zip(cases, cheapest, strict=True)} for name in OWN
    }
    wins = [Counter(sorted(each.split(", ")[0] for each in names if each)) for names in zip(*cheapest_of, strict=True)]
    found["wins_engines"] = [dict(each.most_common()) for each in wins]
    others = [runs[runs["family"] == name] for engine, name in NAMES.items() if engine != OURS]
    lines = [_engine(each, cases) for each in (*others, *(runs[runs["solver"] == name] for name in OWN))]
    found["engines"] = [line for line in lines if line is not None]
    found["set_for"], found["speeds"], found["own"] = list(SET_FOR), list(SPEEDS), list(OWN)
    found["probed"] = [AS_IT_COMES, *(line["solver"] for line in found["engines"] if line["solver"] not in OWN[1:])]
    found["probes"] = [
        {"label": label, "cells": [[_probe(rows, solver, *each) for each in asked] for solver in found["probed"]]}
        for label, asked in PROBES.items()
    ]
    found["exact"] = EXACT
    return found


def _configuration(each: Configuration, runs: pd.DataFrame) -> dict[str, Any]:
    ended = runs[runs["error_q"].notna()]
    orders, floors, lost = [], [], 0
    for _, own in ended.groupby("case", sort=False):
        lost += bool((own["error_q"].astype(float) > LOST).all())
        if own["h"].notna().all():
            order, floor = order_and_floor(own["h"], own["error_q"], float(own["floor"].max()))
            orders += [order] if order is not None else []
            floors += [floor] if floor is not None else []
    found: dict[str, Any] = {"name": each.name, "how": each.how, "runs": len(ended)}
    found |= {"silent": int((ended["error_q"].astype(float) > EXACT).sum())}
    found |= {"gross": int((ended["error_q"].astype(float) > LOST).sum())}
    found |= {"failed": int((runs["status"] == "FAILED").sum())}
    found |= {"order": [min(orders), float(np.median(orders)), max(orders)] if orders else None}
    found |= {"floor": [min(floors), max(floors)] if floors else None, "n_floors": len(floors), "lost": lost}
    return found | {"gap": float(ended["gap"].astype(float).median()) if len(ended) else None}


def _priced(runs: pd.DataFrame, error: float, what: str = "call_s") -> float | None:
    """What a configuration takes on a mechanism for an error: that of its cheapest run that is as good."""
    cost = tables.as_good(runs, error, what) if runs["error_q"].notna().any() else np.nan
    return cost if cost == cost else None


def _cheapest(runs: pd.DataFrame) -> dict[str, Any]:
    """At each error the cheapest configuration of the engines on a mechanism.

    `ratios`: our calls at the first error over theirs, where both reach it.
    """
    line: dict[str, Any] = {"engines": [], "ratios": {}}
    for error in ERRORS:
        costs = {str(solver): cost for solver, own in runs.groupby("solver") if (cost := _priced(own, error))}
        ours = {name: costs.pop(name) for name in OWN if name in costs}
        line["engines"].append(min(costs, key=costs.__getitem__, default=None))
        if error == ERRORS[0] and costs:
            line["ratios"] = {name: cost / min(costs.values()) for name, cost in ours.items()}
    return line


def _engine(runs: pd.DataFrame, cases: list[str]) -> dict[str, Any] | None:
    """The configuration of an engine that reaches most errors on most mechanisms, then the fastest; None: none ran."""
    ranked: list[tuple[int, float, str]] = []
    for solver, own in runs.groupby("solver", sort=False):
        costs = [cost for _, each in own.groupby("case") for error in ERRORS if (cost := _priced(each, error))]
        ranked += [(-len(costs), float(np.median(costs)), str(solver))] if costs else []
    if not ranked:
        return None
    solver = min(ranked)[2]
    by_case = {str(case): own for case, own in runs[runs["solver"] == solver].groupby("case")}
    name = solver if solver in OWN else solver.split(", ")[0]
    line: dict[str, Any] = {"name": name, "solver": solver, "at": [], "speeds": []}
    line["how"] = next(each.how for each in CONFIGURATIONS if each.name == solver)
    line["steps"] = {
        case: [_step_for(by_case[case], error) if case in by_case else None for error in SET_FOR] for case in cases
    }
    for error in ERRORS:
        reached = [own for own in by_case.values() if _priced(own, error)]
        line["at"].append({"reached": len(reached)})
        for what in ("call_s", "stepping_s") if reached else ():
            line["at"][-1][what] = float(np.median([_priced(own, error, what) or np.nan for own in reached]))
    for speed in SPEEDS:  # of the calls so many times faster than real time the least error; infinite: none
        runs_ = [own.astype({"call_s": float, "span": float, "error_q": float}) for own in by_case.values()]
        least = [own["error_q"][own["call_s"] <= own["span"] / speed].min() for own in runs_]
        middle = float(np.median(np.nan_to_num(least, nan=np.inf)))
        line["speeds"].append(middle if np.isfinite(middle) else None)
    return line


def _probe(rows: pd.DataFrame, solver: str, of: str, group: str, measure: str) -> float | None:
    """What a configuration is off by in the median, with `PROBED` steps, ours with a tolerance of 1e-8.

    A run that ends early is off by any amount. None: not run, or off by any amount in the median.
    """
    own = rows[(rows["group"] == group) & (rows["solver"] == solver) & rows["status"].isin(("REACHED_END", "FAILED"))]
    own = own[own["case"].isin(IN_SPACE) if of == "in space" else own["case"].str.endswith(of)]
    own = own[(own["n_steps"] == PROBED) | (own["tol"] == 1e-8) | (group == ENERGY)]
    if own.empty or measure not in own:
        return None
    ended = own["status"] == "REACHED_END"
    value = float(own[measure].astype(float).where(ended, np.inf).median())
    return value if np.isfinite(value) else None


def _step_for(runs: pd.DataFrame, error: float) -> float | None:
    """The longest step, or loosest tolerance, of which neither it nor any shorter one is off by more."""
    known = runs[runs["error_q"].notna()].assign(value=lambda each: each["h"].fillna(each["tol"]))
    wrong = known[known["error_q"].astype(float) > error]["value"].min()
    good = known[~(known["value"] >= wrong)]["value"] if wrong == wrong else known["value"]
    return float(good.max()) if len(good) else None

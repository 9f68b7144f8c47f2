"""The headline of the comparisons: the default, the compiled default, the best of ours afterwards, against all rivals.

In this order: a user gets the first, with one argument the second, and the third by choosing among our methods when all
have been run. Each is compared with the best of the same rivals, on each mechanism at each error, by the time of the
whole call.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import pandas as pd

from studies import tables
from studies.solvers import COMPILED, DEFAULT

OWN_CODE = next(name for name, method in COMPILED.items() if method == DEFAULT)
BEST = "best of ours"
STANDINGS = ("ahead", "behind", "undecided", "alone", "missed")


def of_error(rows: pd.DataFrame, error: float) -> dict[str, dict[str, Any]]:
    """How each of the three stands on one case at one error, by the best of each; `rows`: medians, of all solvers."""
    ours = rows["family"] == "two-loop"
    own, others = tables.costs_at(rows[ours], error), tables.costs_at(rows[~ours], error, doubt=True)
    sides = {DEFAULT: _only(own, DEFAULT), OWN_CODE: _only(own, OWN_CODE), BEST: own}
    return {
        name: _told(side) | {"rival": _told(others)} | tables.compared(side, others) for name, side in sides.items()
    }


def _told(costs: tables.Costs) -> dict[str, Any]:
    """The cheapest."""
    best = min(costs, key=lambda name: costs[name][0], default=None)
    return {"solver": best, "call_s": None if best is None else costs[best][0]}


def _only(costs: tables.Costs, name: str) -> tables.Costs:
    return {name: costs[name]} if name in costs else {}


def counted(found: Iterable[Mapping[str, Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Of many pairs of mechanism and error, in how many each of the three is ahead, behind, undecided, alone, missing.

    n are the pairs that any of ours or of others reaches.
    """
    pairs = [each for each in found if any(standing["verdict"] != "none" for standing in each.values())]
    made = []
    for name in (DEFAULT, OWN_CODE, BEST):
        verdicts = [each[name]["verdict"] for each in pairs]
        line = {verdict: verdicts.count(verdict) for verdict in STANDINGS}
        # where ours has others to be compared with, but the one in question does not get there and nobody else does
        made.append({"name": name, "n": len(pairs), **line, "missed": len(pairs) - sum(line[v] for v in STANDINGS[:4])})
    return made

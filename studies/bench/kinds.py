"""Which solver is the fastest on each kind of mechanism, at loose and at tight errors: in how many comparisons."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from studies.bench.names import label
from studies.bench.solvers import GIVEN

DECIDED = ("ahead", "behind", "alone", "missed")  # verdicts by which one solver is the fastest
OPEN = {"undecided": "undecided", "unasked": "reached by ours only (not all rivals run)"}  # others, in words
NAMED = 3  # solvers, the most often fastest
FOUR_BARS, PLANAR = "four-bar linkages, over 10 s", "other planar pendulums, chains and loops"
STIFF, CROSSED = "stiff springs and dampers", "motion through singular positions"
DRIVEN = "driven by a given motion, rolling, or a knife edge"
REDUNDANT, SPATIAL = "redundant constraints", "other spatial mechanisms"
KINDS = {  # tags of mechanisms, and what a user calls them; a mechanism of several counts for the first
    "stiff": STIFF,
    "singular": CROSSED,
    "driven": DRIVEN,
    "non-holonomic": DRIVEN,
    "redundant": REDUNDANT,
    "spatial": SPATIAL,
}
ORDER = (FOUR_BARS, PLANAR, DRIVEN, REDUNDANT, SPATIAL, STIFF, CROSSED)


def by_kind(made: Mapping[str, Any]) -> dict[str, Any]:
    """For each kind of mechanism the fastest solvers within each range of errors (`made`: of `work_precision`).

    errors: names of the ranges; rows: what, a cell for each range, and `brief` ones, of the most often fastest.
    Nothing is told without mechanisms.
    """
    rivals = made.get("rivals", {})
    ranges = [each for each in rivals.get("ranges", []) if each.get("errors")]
    kinds: dict[str, list[Mapping[str, Any]]] = {kind: [] for kind in ORDER}
    for each in rivals.get("mechanisms", []):
        kinds[_kind(each["tags"])].append(each)
    rows = []
    for kind, own in kinds.items():
        if own and ranges:
            cells, brief = ([_fastest(own, each["errors"], how) for each in ranges] for how in (False, True))
            rows.append({"what": f"{kind} ({_which(kind, own)})", "cells": cells, "brief": brief})
    return {"errors": [each["name"] for each in ranges], "rows": rows}


def _kind(tags: Sequence[str]) -> str:
    return next((kind for tag, kind in KINDS.items() if tag in tags), PLANAR) if tags else FOUR_BARS


def _which(kind: str, own: Sequence[Mapping[str, Any]]) -> str:
    """How many mechanisms a kind has; the name of a single one, and of the one whose variants those are."""
    names = list(dict.fromkeys(each["case"].partition(",")[0].partition(" (")[0] for each in own))
    if len(own) == 1:
        return str(own[0]["case"]).removeprefix("A05 ")  # its number among IFToMM's benchmarks
    return f"{len(own)} variants of one, {names[0]}" if len(names) == 1 and kind != FOUR_BARS else str(len(own))


def _fastest(own: Sequence[Mapping[str, Any]], errors: Sequence[float], brief: bool) -> str:
    """Who is the fastest in how many of the pairs of mechanism and error that any solver reaches.

    Where a rival of another project takes as long as the fastest rival, it is not decided. `brief`: only what is true
    of the most pairs.
    """
    won: Counter[str] = Counter()
    for line in (line for each in own for line in each["at"] if line["error"] in errors):
        runs = [run for run in (line["ours"], line["others"]) if run]
        if runs:
            best = min(runs, key=lambda run: float(run["call_s"]))
            open_to_rivals = best is line["others"] and line.get("close")
            verdict = "undecided" if open_to_rivals else line["verdict"]
            won.update([label(best["solver"], True) if verdict in DECIDED else verdict])
    if not won:
        return "not reached"
    named = [(who, n) for who, n in won.most_common() if who not in OPEN]
    most = named[0][1] if named else 0
    if brief:
        named = [(who, n) for who, n in named if n == most]
    told = [f"{who if who == GIVEN else f'`{who}`'} {n}" for who, n in named[:NAMED]]
    rest = sum(n for _, n in named[NAMED:])
    told += [f"other solvers {rest}"] * bool(rest)
    told += [f"{words} {won[verdict]}" for verdict, words in OPEN.items() if won[verdict] >= max(most * brief, 1)]
    return f"{', '.join(told)} of {won.total()}"

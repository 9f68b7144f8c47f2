"""Which solver is the fastest on each kind of mechanism, at loose and at tight errors: in how many comparisons."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from studies.bench.names import call
from studies.bench.render import number, power

DECIDED = ("ahead", "behind", "alone", "missed")  # verdicts by which one solver is the fastest
NAMED = 3  # solvers, the most often fastest
FOUR_BARS, PLANAR, SINGULAR = "four-bar linkages, over 10 s", "other planar pendulums, chains and loops", "singular"
KINDS = {  # tags of mechanisms, and what a user calls them; a mechanism of several counts for the first
    "stiff": "stiff springs and dampers",
    SINGULAR: "motion through singular positions",
    "driven": "driven by a given motion",
    "non-holonomic": "rolling or a knife edge",
    "redundant": "redundant constraints",
    "spatial": "other spatial mechanisms",
}
ORDER = (FOUR_BARS, PLANAR, "driven", "non-holonomic", "redundant", "spatial", "stiff", SINGULAR)


def by_kind(made: Mapping[str, Any]) -> dict[str, Any]:
    """For each kind of mechanism the fastest solvers within each range of errors (`made`: of `work_precision`).

    errors: names of the ranges; rows: what, and a cell for each range. Nothing is told without mechanisms.
    """
    rivals = made.get("rivals", {})
    ranges = [each for each in rivals.get("ranges", []) if each.get("errors")]
    with_code = set(rivals.get("with_code", []))
    kinds: dict[str, list[Mapping[str, Any]]] = {kind: [] for kind in ORDER}
    for each in rivals.get("mechanisms", []):
        kinds[_kind(each["tags"])].append(each)
    rows = []
    for kind, own in kinds.items():
        if own and ranges:
            cells = [_fastest(own, each["errors"], with_code) for each in ranges]
            rows.append({"what": f"{KINDS.get(kind, kind)} ({_which(kind, own)})", "cells": cells})
    rows += [row for each in made.get("minimal", []) for row in _in_angles(each, ranges)] if ranges else []
    return {"errors": [each["name"] for each in ranges], "rows": rows}


def coded(cases: Iterable[str], with_code: set[str]) -> bool | None:
    """Whether the default makes code for mechanisms; None: for some of them."""
    made = {case in with_code for case in cases}
    return made.pop() if len(made) == 1 else None


def _kind(tags: Sequence[str]) -> str:
    return next((kind for kind in KINDS if kind in tags), PLANAR) if tags else FOUR_BARS


def _which(kind: str, own: Sequence[Mapping[str, Any]]) -> str:
    """How many mechanisms a kind has; the name of a single one, and of the one whose variants those are."""
    names = list(dict.fromkeys(each["case"].partition(",")[0].partition(" (")[0] for each in own))
    if len(own) == 1:
        return str(own[0]["case"]).removeprefix("A05 ")  # its number among IFToMM's benchmarks
    return f"{len(own)} variants of one, {names[0]}" if len(names) == 1 and kind != FOUR_BARS else str(len(own))


def _fastest(own: Sequence[Mapping[str, Any]], errors: Sequence[float], with_code: set[str]) -> str:
    """Who is the fastest in how many of the pairs of mechanism and error that any solver reaches."""
    made = coded((each["case"] for each in own), with_code)
    won: Counter[str] = Counter()
    for line in (line for each in own for line in each["at"] if line["error"] in errors):
        runs = [run for run in (line["ours"], line["others"]) if run]
        if runs:
            best = min(runs, key=lambda run: float(run["call_s"]))
            won.update([call(best["solver"], made) if line["verdict"] in DECIDED else ""])
    named = [(who, n) for who, n in won.most_common() if who]
    told = [f"{who} {n}" for who, n in named[:NAMED]]
    rest = sum(n for _, n in named[NAMED:])
    told += [f"others {rest}"] * bool(rest) + [f"undecided {won['']}"] * bool(won[""])
    return f"{', '.join(told)} of {won.total()}" if won else "not reached"


def _in_angles(minimal: Mapping[str, Any], ranges: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The fastest ODE in minimal coordinates beside our best with constraints; loops apart from each other."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for each in minimal["mechanisms"]:
        name = each["case"].partition(",")[0] if minimal["kind"] == "loops" else minimal["kind"]
        groups.setdefault(name, []).append(each)
    wrong = "".join(_wrong(minimal, each) for each in minimal["wrong_by"])
    rows = []
    for name, own in groups.items():
        pairs = [[at for each in own for at in each["at"] if at["error"] in one["errors"]] for one in ranges]
        if all(pairs):
            rows.append({"what": f"{name}, as an ODE in angles{wrong}", "cells": [_beside(each) for each in pairs]})
    return rows


def _wrong(minimal: Mapping[str, Any], each: Mapping[str, Any]) -> str:
    """How often a solver is silently wrong in angles, and the others."""
    start = " from horizontal rest" if minimal.get("level") else ""  # where terms of heyoka's series vanish
    others = minimal["asked"] - sum(line["asked"] for line in minimal["wrong_by"])
    beside = f", others in 0 of {others}" if others else ""
    return (
        f" (`{each['solver'].partition(',')[0]}` is silently wrong by over {number(minimal['wrong_from'])} in "
        f"{each['n']} of {each['asked']} runs{start} at {power(minimal['asked_at'])} or tighter{beside})"
    )


def _beside(pairs: Sequence[Mapping[str, Any]]) -> str:
    """In how many pairs the cheapest ODE in minimal coordinates is faster, or slower, than our best."""
    verdicts = Counter(at["verdict"] for at in pairs)
    by = Counter(at["rival"]["solver"].partition(",")[0] for at in pairs if at["rival"] and at["rival"]["solver"])
    who = f"`{by.most_common(1)[0][0]}`" if by else "it"
    words = {"behind": "faster than our best", "ahead": "slower than our best", "undecided": "undecided"}
    told = [f"{word} {verdicts[name]}" for name, word in words.items() if verdicts[name]]
    return f"{who} {', '.join(told)} of {len(pairs)}"

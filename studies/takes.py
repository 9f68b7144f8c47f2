"""The table "your mechanism, take": what is the cheapest for a class of problem or a kind of mechanism, by its call."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from studies.render import listed
from twoloop.methods import PRESETS

SUFFIX = " (two-loop)"  # of our solvers, in the findings of honesty
KINDS = {  # tags of mechanisms, and what a user calls them
    "redundant": "redundant constraints",
    "spatial": "spatial",
    "driven": "driven by a given motion",
    "non-holonomic": "rolling, or sliding on an edge: non-holonomic",
}


def takes(found: Mapping[str, Any], groups: Sequence[Sequence[dict[str, Any]]]) -> list[dict[str, str]]:
    """For each class of problem (`groups`, those of `index.advice`) and kind of mechanism, what is the cheapest."""
    rows = []
    for group in groups:
        what = f"{group[0]['class']} ({'; '.join(entry['name'] for entry in group)})"
        picks = [f"{call(pick['solver'])} for errors of {listed(pick['accuracies'])}" for pick in group[0]["picks"]]
        rows.append({"what": what, "take": "; ".join(picks) or "no solver compared reaches these errors"})
    return rows + _of_kinds(found.get("work_precision", {}).get("rivals", {}).get("mechanisms", []))


def _of_kinds(mechanisms: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Of each kind who is the cheapest in most pairs of mechanism and error; kinds with none such are told together."""
    rows, undecided = [], []
    for kind, words in KINDS.items():
        these = [each for each in mechanisms if kind in each.get("tags", ())]
        cheapest: Counter[str] = Counter()
        for at in (at for each in these for at in each["at"]):
            runs = [(run["call_s"], run["solver"]) for run in (at["ours"], at["others"]) if run]
            cheapest.update(name for _, name in sorted(runs)[:1])
        solver, n = cheapest.most_common(1)[0] if cheapest else ("", 0)
        if 2 * n > cheapest.total():
            said = f"{call(solver)}, the cheapest in {n} of {cheapest.total()} pairs of mechanism and error"
            rows.append({"what": words, "take": said})
        elif cheapest:
            undecided.append(words)
    if undecided:
        said = "the default: no solver is the cheapest in most pairs of mechanism and error"
        rows.append({"what": "; ".join(undecided), "take": said})
    return rows


def call(solver: str) -> str:
    """How a user asks for a solver of the reports: the argument of `solve_dae` where there is one."""
    name, _, compiled = solver.removesuffix(SUFFIX).partition(", ")
    if name not in PRESETS or compiled not in ("", "compiled"):
        return f"`{solver}`"
    words = [] if name == "auto" else [f'method="{name}"']
    return f"`{', '.join([*words, *(['compiled=True'] if compiled else [])]) or 'auto'}`"

"""The page "Which method?" of the documentation, from the findings of the studies in a folder."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from studies import index
from studies.render import listed, render
from twoloop.methods import PRESETS

OURS = "two-loop"  # family of our solvers, in the findings of validation
SUFFIX = " (two-loop)"  # of our solvers, in those of honesty


def page(folder: Path) -> str:
    """The text of the page; what has not been run is said to be missing."""
    found = index.findings(folder)
    entries = index.classes(found)
    more = {"advice": index.advice(entries), "cases": index.cases_of(found), "reliable": reliability(found)}
    links = {"docs": "../", "reports": "reports"}
    return render("which_method", found, {}, default=_default(found), takes=takes(entries), **links, **more)


def table(folder: Path) -> str:
    """The table "your mechanism, take" alone, for a page in docs/ that includes it."""
    found = index.findings(folder)
    links = {"docs": "", "reports": "generated/reports"}
    return render("takes", found, {}, default=_default(found), takes=takes(index.classes(found)), **links)


def _default(found: dict[str, dict[str, Any]]) -> str:
    return str(found["work_precision"]["default"]) if "work_precision" in found else ""


def takes(entries: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """For each class of problem with its mechanisms: what is the cheapest, and for which errors."""
    rows = []
    for group in index.advice(entries):
        what = f"{group[0]['class']} ({'; '.join(entry['name'] for entry in group)})"
        picks = [f"{call(pick['solver'])} for errors of {listed(pick['accuracies'])}" for pick in group[0]["picks"]]
        rows.append({"what": what, "take": "; ".join(picks) or "no solver compared reaches these errors"})
    return rows


def call(solver: str) -> str:
    """How a user asks for a solver of the reports: the argument of `solve_dae` where there is one."""
    name, _, compiled = solver.removesuffix(SUFFIX).partition(", ")
    if name not in PRESETS or compiled not in ("", "compiled"):
        return f"`{solver}`"
    words = [] if name == "auto" else [f'method="{name}"']
    return f"`{', '.join([*words, *(['compiled=True'] if compiled else [])]) or 'auto'}`"


def reliability(found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """One entry a method of ours: runs right, wrong and ended with a message; error over tolerance; silent in traps."""
    entries = []
    for line in found["validation"]["solvers"] if "validation" in found else ():
        if line["family"] == OURS:
            name = line["solver"].removesuffix(SUFFIX)
            traps = found["honesty"]["counts"].get(name + SUFFIX) if "honesty" in found else None
            silent = None if traps is None else traps["WRONG AND SILENT"] + traps["HANG"]
            kept = {key: line[key] for key in ("right", "wrong", "ratio")}
            entries.append({"method": name, "said": line["said so"], "silent": silent, **kept})
    return entries

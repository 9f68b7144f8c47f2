"""The page "Which method?" of the documentation, from the findings of the studies in a folder."""

from pathlib import Path
from typing import Any

from studies import index
from studies.render import render

OURS = "two-loop"  # family of our solvers, in the findings of validation
SUFFIX = " (two-loop)"  # of our solvers, in those of honesty


def page(folder: Path) -> str:
    """The text of the page; what has not been run is said to be missing."""
    found = index.findings(folder)
    entries = index.classes(found)
    more = {"advice": index.advice(entries), "cases": index.cases_of(found), "reliable": reliability(found)}
    default = found["work_precision"]["default"] if "work_precision" in found else ""
    return render("which_method", found, {}, default=default, **more)


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

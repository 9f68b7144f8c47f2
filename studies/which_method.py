"""The page "Which method?" of the documentation, from the findings of the studies in a folder."""

from pathlib import Path
from typing import Any

from studies.bench import index
from studies.bench.render import render
from studies.bench.takes import SUFFIX, takes

OURS = "two-loop"  # family of our solvers, in the findings of validation


def page(folder: Path) -> str:
    """The text of the page; what has not been run is said to be missing."""
    found = index.findings(folder)
    advice = index.advice(index.classes(found))
    more = {"advice": advice, "cases": index.cases_of(found), "reliable": reliability(found)}
    links = {"docs": "../", "reports": "reports", "every": True}
    return render("which_method", found, {}, default=_default(found), takes=takes(found, advice), **links, **more)


def table(folder: Path) -> str:
    """The table "your mechanism, take" alone, for a page in docs/ that includes it."""
    found = index.findings(folder)
    links = {"docs": "", "reports": "generated/reports", "every": True}
    rows = takes(found, index.advice(index.classes(found)))
    return render("takes", found, {}, default=_default(found), takes=rows, **links)


def _default(found: dict[str, dict[str, Any]]) -> str:
    return str(found["work_precision"]["default"]) if "work_precision" in found else ""


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

"""The page "Which method?" of the documentation, from the findings of the studies in a folder."""

from pathlib import Path
from typing import Any

from studies.bench import index
from studies.bench.names import SUFFIX

OURS = "two-loop"  # family of our solvers, in the findings of validation


def page(folder: Path) -> str:
    """The text of the page; what has not been run is said to be missing."""
    found = index.findings(folder)
    links = {"docs": "../", "reports": "reports", "every": True}
    return index.rendered("which_method", found, reliable=reliability(found), **links)


def table(folder: Path) -> str:
    """The table "your mechanism, take" alone, for a page in docs/ that includes it."""
    links = {"docs": "", "reports": "generated/reports", "every": True}
    return index.rendered("takes", index.findings(folder), **links)


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

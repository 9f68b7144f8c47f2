"""Compare verdicts between processors: which solver is faster on a mechanism at an error.

`studies.work_precision` adds its own processor to processors.csv. Rows from another machine are added by `python -m
studies.work_precision.processors FOLDER`, the folder of that machine's reports.
"""

import re
import sys
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench import headline, tables
from studies.bench.cli import REPORTS, StudyError
from studies.bench.store import Output, read_rows
from studies.work_precision.mechanisms import DECADES, GROUP, Standings, standings_of

FILE = "processors.csv"
PLACE = ["case", "error", "who"]
COLUMNS = ["processor", "commit", *PLACE, "ratio", "verdict"]


def verdicts(rows: pd.DataFrame, stamp: str, known: Standings | None = None) -> pd.DataFrame:
    """Make the lines of the file from the rows of all runs; `known`: how solvers stand by them, if it is known."""
    commit = re.search(r"commit (\w+)", stamp)
    rows = rows[rows["group"] == GROUP]
    own = rows[rows["family"] == "two-loop"]  # which stand in every verdict; of others, some may be older
    new = own.reindex(columns=["case", "processor", "commit"]).groupby("case").first()
    lines = []
    for case, at in (standings_of(tables.medians(rows)) if known is None else known).items():
        at_commit = new.loc[case, "commit"]
        about = {"processor": new.loc[case, "processor"], "case": case}
        about["commit"] = at_commit if isinstance(at_commit, str) else commit[1] if commit else ""
        for error, standing in zip(DECADES, at, strict=True):
            for who, each in standing.items():
                if who != headline.GIVEN and each["verdict"] in ("ahead", "behind", "undecided"):
                    said = {"ratio": float(f"{each['ratio']:.3g}"), "verdict": each["verdict"]}
                    lines.append({**about, "error": error, "who": who, **said})
    return pd.DataFrame(lines, columns=COLUMNS)


def added(path: Path, new: pd.DataFrame) -> pd.DataFrame:
    """Put new lines in the place of those of the same processors and mechanisms in the file."""
    before = pd.read_csv(path) if path.is_file() else new[:0]
    place = ["processor", "case"]
    again = before.set_index(place).index.isin(new.set_index(place).index)
    return pd.concat([before[~again], new], ignore_index=True)[COLUMNS]


def kept(output: Output, rows: pd.DataFrame, stamp: str, known: Standings) -> list[dict[str, Any]]:
    """Keep the verdicts of these rows beside those of other processors, and compare theirs with each other one."""
    new = verdicts(rows, stamp, known)
    table = added(output.file(FILE), new)
    output.write(FILE, table.to_csv(index=False))
    own = set(new["processor"])
    return [pair for pair in findings_of(table) if any(line["name"] in own for line in pair["processors"])]


def findings_of(table: pd.DataFrame, who: str = headline.OWN_CODE) -> list[dict[str, Any]]:
    """Count for each two processors the pairs of mechanism and error in which twoloop is faster, and slower.

    `who`: the default with generated code. `turned`: pairs with opposite verdicts on the two processors.
    """
    found, own = [], table[table["who"] == who]
    for pair in combinations(dict.fromkeys(own["processor"]), 2):
        sides = [own[own["processor"] == name] for name in pair]
        both = sides[0].merge(sides[1], on=PLACE, suffixes=("_0", "_1"))
        if both.empty:
            continue
        turned = both[["verdict_0", "verdict_1"]].apply(lambda pair: set(pair) == {"ahead", "behind"}, axis=1)
        line: dict[str, Any] = {"n": len(both), "turned": int(turned.sum()), "processors": []}
        for k, name in enumerate(pair):
            faster, slower = (int((both[f"verdict_{k}"] == word).sum()) for word in ("ahead", "behind"))
            line["processors"].append({"name": name, "faster": faster, "slower": slower})
        found.append(line | {"same_code": bool((both["commit_0"] == both["commit_1"]).all())})
    return found


def main(words: Sequence[str] | None = None) -> None:
    (folder,) = sys.argv[1:] if words is None else words
    path, rows = REPORTS / FILE, Path(folder, "work_precision.csv")
    if not rows.is_file():
        raise StudyError(f"there is no {rows}; run python -m studies.work_precision on the other machine")
    added(path, verdicts(*read_rows(rows))).to_csv(path, index=False)
    print(f"added to {path}; python -m studies.work_precision --redraw puts it into the reports")


if __name__ == "__main__":
    main()

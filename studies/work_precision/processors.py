"""Where a conclusion differs between the processors that were seen: who is ahead on a mechanism at an error.

`studies.work_precision` adds the processor that it ran on to processors.csv; rows that it made on another machine are
added by `python -m studies.work_precision.processors FOLDER`, the folder of reports from there.
"""

import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from studies.bench import headline, tables
from studies.bench.cli import REPORTS, StudyError
from studies.bench.store import WHOLE_CALL, Output, read_rows
from studies.work_precision import rivals

FILE = "processors.csv"
TIMES = {WHOLE_CALL: "call_s", "inside": "inside_s"}  # the measure of record first
PLACE = ["case", "error", "who"]
WORDS = ("ahead", "behind")

# mechanism, error, and how each of ours stands
Standings = Sequence[tuple[str, float, Mapping[str, Mapping[str, Any]]]]


def standings(rows: pd.DataFrame, column: str) -> Standings:
    """Who is ahead at each error on each mechanism, by a column of times; `rows`: of all runs."""
    cases = tables.medians(rows.assign(call_s=rows[column])).groupby("case", sort=False)
    decades = rivals.DECADES
    return [
        (str(case), error, at)
        for case, own in cases
        for error, at in zip(decades, rivals.standings(own, decades), strict=True)
    ]


def verdicts(rows: pd.DataFrame, stamp: str, known: Standings = ()) -> pd.DataFrame:
    """Who is ahead by the time of the call and by that inside; `rows`: of all runs; `known`: the first, if it is."""
    commit = re.search(r"commit (\w+)", stamp)
    rows = rows[rows["group"] == rivals.GROUP]
    own = rows[rows["family"] == "two-loop"]  # which stand in every verdict; of others, some may be older
    made = own.reindex(columns=["case", "processor", "commit"]).groupby("case").first()
    lines = []
    for time, column in TIMES.items():
        if column not in rows:
            continue
        found = known if known and time == WHOLE_CALL else standings(rows, column)
        for case, error, standing in found:
            for who, at in standing.items():
                if who != headline.GIVEN and at["verdict"] in ("ahead", "behind", "undecided"):
                    line = {"processor": made.loc[case, "processor"], "time": time, "case": case, "error": error}
                    at_commit = made.loc[case, "commit"]
                    line["commit"] = at_commit if isinstance(at_commit, str) else commit[1] if commit else ""
                    lines.append({**line, "who": who, "ratio": float(f"{at['ratio']:.3g}"), "verdict": at["verdict"]})
    return pd.DataFrame(lines, columns=["processor", "commit", "time", *PLACE, "ratio", "verdict"])


def added(path: Path, made: pd.DataFrame) -> pd.DataFrame:
    """What stands in the file for mechanisms on other processors, and what was made on this one."""
    before = pd.read_csv(path) if path.is_file() else made[:0]
    place = ["processor", "case"]
    again = before.set_index(place).index.isin(made.set_index(place).index)
    return pd.concat([before[~again], made], ignore_index=True)


def kept(output: Output, rows: pd.DataFrame, stamp: str, found: Mapping[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Keep the verdicts of these rows beside those of other processors; the findings of all.

    `found`: of `rivals.findings_of`, in which those by the time of the call are.
    """
    known = [(each["case"], at["error"], at["standing"]) for each in found["mechanisms"] for at in each["at"]]
    made = verdicts(rows, stamp, known)
    table = added(output.file(FILE), made)
    output.write(FILE, table.to_csv(index=False))
    return {"processors": findings_of(table)}


def findings_of(table: pd.DataFrame) -> list[dict[str, Any]]:
    """For each two processors: how many pairs both have, by which time, and where ahead turns to behind."""
    found = []
    for one, other in combinations(dict.fromkeys(table["processor"]), 2):
        for time in TIMES:
            sides = [table[(table["processor"] == name) & (table["time"] == time)] for name in (one, other)]
            both = sides[0].merge(sides[1], on=PLACE, suffixes=("_one", "_other"))
            if both.empty:
                continue
            turned = both[both[["verdict_one", "verdict_other"]].apply(lambda x: set(x) == {"ahead", "behind"}, axis=1)]
            apart = np.exp(np.abs(np.log(both["ratio_one"] / both["ratio_other"])))
            ahead = np.where(turned["verdict_one"] == "ahead", one, other)
            line: dict[str, Any] = {"processors": [one, other], "time": time, "n": len(both)}
            line["ahead"] = [int((both[f"verdict_{side}"] == "ahead").sum()) for side in ("one", "other")]
            line["by"] = {str(who): _counts(own) for who, own in both.groupby("who", sort=False)}
            line["turned"] = turned[PLACE].assign(ahead_on=ahead).to_dict("records")
            favours = Counter(each["ahead_on"] for each in line["turned"]).most_common(1)
            line["in_favour"] = {"processor": favours[0][0], "n": favours[0][1]} if favours else None
            line["over"] = float((both["ratio_other"] / both["ratio_one"]).median())
            line["same_code"] = bool((both["commit_one"] == both["commit_other"]).all())
            found.append(line | {"apart": float(apart.median()), "most": float(apart.max())})
            break
    return found


def _counts(both: pd.DataFrame) -> dict[str, Any]:
    """How many pairs there are, and in how many of them ours is ahead and behind on each processor."""
    verdicts = {word: [int((both[f"verdict_{side}"] == word).sum()) for side in ("one", "other")] for word in WORDS}
    return {"n": len(both), **verdicts}


def rows_of(folder: Path) -> tuple[pd.DataFrame, str]:
    """The rows of `work_precision` in a folder of reports, and their stamp. Raises StudyError if there are none."""
    path = folder / "work_precision.csv"
    if not path.is_file():
        raise StudyError(f"there is no {path}; run python -m studies.work_precision on the other machine")
    return read_rows(path)


def main(words: Sequence[str] | None = None) -> None:
    (folder,) = sys.argv[1:] if words is None else words
    path = REPORTS / FILE
    added(path, verdicts(*rows_of(Path(folder)))).to_csv(path, index=False)
    print(f"added to {path}; python -m studies.work_precision --redraw puts it into the reports")


if __name__ == "__main__":
    main()

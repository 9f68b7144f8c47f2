"""The rows of work_precision.csv in the wheel: one a run, in the format of `twoloop.rows`.

`python -m studies.work_precision.archive` makes `twoloop/rows/archive.jsonl.gz` of reports/work_precision.csv.
"""

import gzip
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench import cli, tables
from studies.bench.cli import REPORTS
from studies.bench.mechanism_names import mechanism_of
from studies.bench.runs_by_error import SETTINGS
from studies.bench.store import read_rows
from studies.compare import GROUP as LENGTH
from studies.work_precision.rivals import GROUP
from twoloop import __version__
from twoloop.rows.leaderboard import ARCHIVE
from twoloop.rows.row_format import SCHEMA, Row, text_of

MEASURED = {GROUP: ("error_end", "floor_end"), LENGTH: ("error", "floor")}  # where rows of a group know their errors
PACKAGES = {"SUNDIALS": "scikit-sundae"}  # of families, that are called otherwise
DIGITS = 4  # significant, of numbers
QUALITY = ("violation_q", "violation_v", "error_lam", "energy")


def archived(rows: pd.DataFrame, versions: dict[str, str]) -> list[Row]:
    """Rows of the format, of the repetitions of all runs of the comparisons; `versions`: of the rivals' packages."""
    found = []
    for group, names in MEASURED.items():
        medians = tables.medians(rows[rows["group"] == group])
        found += [_row(run, *names, versions) for run in medians.to_dict("records")]
    return found


def _row(run: dict[str, Any], error: str, floor: str, versions: dict[str, str]) -> Row:
    family, done = run["family"], run["status"] == "REACHED_END"
    package = PACKAGES.get(family, family.lower().replace("_", "-"))
    setting = next(name for name in SETTINGS if not math.isnan(run[name]))
    row = {"schema": SCHEMA, "mechanism": mechanism_of(run["case"]), "t_end": run["t_end"], "solver": run["solver"]}
    row |= {"family": family, "called_from": run["called_from"], "keeps_constraints": run["keeps_constraints"]}
    row["version"] = f"{__version__}, {run['commit']}" if family == "two-loop" else versions.get(package, "unknown")
    row |= {"processor": run["processor"], "setting": setting, "value": run[setting], "status": run["status"]}
    row["message"] = None if done else " ".join(str(run["message"]).split())[:120]
    row |= {"times_s": [_rounded(time) for time in run["times"]] if done else [], "evaluations": run["n_evaluations"]}
    if done:
        row |= {error: run["error_q"], floor: run["floor"], "used": run["used"]}
        row |= {name: abs(run[name]) for name in QUALITY} | {
            "astray": True if run["astray"] in (True, "True") else None
        }
    return {name: _rounded(value) for name, value in row.items() if value not in (None, "") and value == value}


def _rounded(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    short = float(f"{value:.{DIGITS}g}")
    return int(short) if short.is_integer() and short < 1e15 else short


def made_of(folder: Path) -> str:
    """The archive of the rows in a folder of reports."""
    rows, _ = read_rows(folder / "work_precision.csv", "group", "case", "solver", "t_end")
    return text_of(archived(rows, json.loads((folder / "work_precision.json").read_text())["versions"]))


def main(words: Sequence[str] | None = None) -> None:
    """Write the archive."""
    text = made_of(REPORTS)
    ARCHIVE.write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    print(f"wrote {text.count(chr(10))} rows, {ARCHIVE.stat().st_size / 1e3:.0f} kB, to {ARCHIVE}")


if __name__ == "__main__":
    cli.main(main)

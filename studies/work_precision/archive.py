"""Write the rows of reports/work_precision.csv to twoloop/rows/archive.jsonl.gz, in the format of `twoloop.rows`."""

import gzip
import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from studies.bench import cli, tables
from studies.bench.cli import REPORTS
from studies.bench.row_files import in_format
from studies.bench.store import read_rows
from studies.work_precision.mechanisms import GROUP
from studies.work_precision.study import with_one_name
from twoloop.rows.leaderboard import ARCHIVE
from twoloop.rows.row_format import Row, format_rows

ERRORS = {"error_end": "error_q", "floor_end": "floor"}  # by their names in the format


def archived(rows: pd.DataFrame, versions: dict[str, str]) -> list[Row]:
    """Convert rows of all runs compared to the format; `versions`: of the other projects' packages."""
    medians = tables.medians(rows[rows["group"] == GROUP])
    return [in_format(run, ERRORS, versions) for run in medians.to_dict("records")]


def made_of(folder: Path) -> str:
    """Write the archive of the rows in a folder of reports, as text."""
    rows, _ = read_rows(folder / "work_precision.csv", "group", "case", "solver", "t_end")
    return format_rows(
        archived(with_one_name(rows), json.loads((folder / "work_precision.json").read_text())["versions"])
    )


def main(words: Sequence[str] | None = None) -> None:
    text = made_of(REPORTS)
    ARCHIVE.write_bytes(gzip.compress(text.encode(), 9, mtime=0))
    print(f"wrote {text.count(chr(10))} rows, {ARCHIVE.stat().st_size / 1e3:.0f} kB, to {ARCHIVE}")


if __name__ == "__main__":
    cli.main(main)

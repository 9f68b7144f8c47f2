"""Run groups of traps again: `python -m studies.honesty.again GROUP ...`, such as force and short.

The whole study takes over an hour. The new rows take the place of those of their groups in honesty.csv, whose first
line names their commit and processor; `python -m studies.honesty --redraw` then writes the report anew.
"""

import sys
from collections.abc import Sequence

import pandas as pd

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.store import Output
from studies.honesty.study import make
from studies.honesty.traps import FORCE, INPUT, LINKAGE, MISTAKE, SHORT, SINGULAR

GROUPS = (INPUT, MISTAKE, FORCE, SHORT, LINKAGE, SINGULAR)


def main(words: Sequence[str] | None = None) -> None:
    names = list(sys.argv[1:] if words is None else words)
    if not names or set(names) - set(GROUPS):
        raise StudyError(f"give groups of traps, of {', '.join(map(repr, GROUPS))}; given {names}")
    with Output(cli.parse("honesty", __doc__, [])) as output:
        rows, _ = output.load_rows()
        new = make(output, names).assign(processor=cli.processor(), commit=cli.commit())
        rows = pd.concat([rows[~rows["group"].isin(names)], new], ignore_index=True)
        output.save_rows(rows, told(cli.stamp("python -m studies.honesty"), rows, cli.commit()))


def told(stamp: str, rows: pd.DataFrame, commit: str) -> str:
    """A stamp that names the groups of rows of other commits beside its own."""
    apart: dict[str, list[str]] = {}
    for group, own in rows.groupby("group", sort=False):
        made = own.reindex(columns=["commit", "processor"]).astype(object).fillna("not kept").iloc[0]
        if made["commit"] != commit:
            apart.setdefault(f"commit {made['commit']}, {made['processor']}", []).append(str(group))
    others = "; ".join(f"{', '.join(groups)}: {which}" for which, groups in apart.items())
    return stamp.replace(f"commit {commit}", f"commit {commit} ({others})", 1) if others else stamp


if __name__ == "__main__":
    cli.main(main)

"""Run groups of traps again: `python -m studies.honesty.again GROUP ...`, such as 'held out' and short.

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
from studies.honesty.traps import FORCE, HELD_OUT, INPUT, MISTAKE, SHORT

GROUPS = (INPUT, MISTAKE, FORCE, HELD_OUT, SHORT)


def main(words: Sequence[str] | None = None) -> None:
    names = list(sys.argv[1:] if words is None else words)
    if not names or set(names) - set(GROUPS):
        raise StudyError(f"give groups of traps, of {', '.join(map(repr, GROUPS))}; given {names}")
    with Output(cli.parse("honesty", __doc__, [])) as output:
        rows, line = output.load_rows()
        new = make(output, names).assign(processor=cli.processor())
        said = f"{', '.join(names)}: commit {cli.commit()}, {cli.processor()}"
        output.save_rows(pd.concat([rows[~rows["group"].isin(names)], new], ignore_index=True), told(line, said))


def told(line: str, said: str) -> str:
    """A stamp with what is said of parts of the rows beside their commit."""
    parts = line.split("; ")
    place = next(k for k, part in enumerate(parts) if part.startswith("commit "))
    before, _, others = parts[place].partition(" (")
    parts[place] = f"{before} ({'; '.join([*filter(None, [others.removesuffix(')')]), said])})"
    return "; ".join(parts)


if __name__ == "__main__":
    cli.main(main)

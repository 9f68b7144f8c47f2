"""Measure single mechanisms, or other parts, again: `python -m studies.work_precision.again NAME ...`.

The whole study takes hours. Each part that this has measured takes the place of its rows in work_precision.csv at once,
with the commit and the processor that it was made on; `python -m studies.work_precision --redraw` then writes the
report anew. Without names: what there is.
"""

import sys
from collections.abc import Sequence

import pandas as pd

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.store import KeptRows, Output
from studies.work_precision import first_calls, minimal, rivals

FIRST_CALLS = "first calls"
WHOLE = {FIRST_CALLS: first_calls, minimal.GROUP: minimal}  # parts that are groups of rows


def parts() -> list[str]:
    """Names of what can be measured again."""
    return [*rivals.problems(False), *WHOLE]


def measured(name: str, kept: KeptRows) -> pd.DataFrame:
    """The rows of one part."""
    if name in WHOLE:
        return WHOLE[name].collect(kept, False)
    return rivals.collect([run for run in rivals.runs(False) if run.case.name == name], kept)


def replaced(rows: pd.DataFrame, name: str, new: pd.DataFrame) -> pd.DataFrame:
    """All rows with those of one part in the place of what stood there."""
    group = rows["group"] == WHOLE.get(name, rivals).GROUP
    old = group if name in WHOLE else group & (rows["case"] == name)
    columns = list(dict.fromkeys([*rows.columns, *new.columns]))
    return pd.concat([rows[~old], new], ignore_index=True).reindex(columns=columns)


def findings_of(rows: pd.DataFrame) -> list[dict[str, str | int]]:
    """On which processors, and at which commits where these are not the report's, how many mechanisms were measured."""
    own = rows[rows["group"] == rivals.GROUP].drop_duplicates("case").reindex(columns=["processor", "commit"])
    counts = own.fillna("").value_counts(sort=False)
    return [{"processor": str(p), "commit": str(c), "n": int(n)} for (p, c), n in counts.items()]


def main(words: Sequence[str] | None = None) -> None:
    """Measure parts again, one after another."""
    names = list(sys.argv[1:] if words is None else words)
    unknown = [name for name in names if name not in parts()]
    if unknown or not names:
        raise StudyError(f"{f'there is no {unknown[0]!r}; ' if unknown else ''}parts are {', '.join(parts())}")
    with Output(cli.parse("work_precision", __doc__, [])) as output:
        for name in names:
            with output.kept({"part": name}) as kept:
                new = measured(name, kept)
            rows, line = output.load_rows()
            new = new.assign(processor=cli.processor(), commit=cli.commit())
            output.save_rows(replaced(rows, name, new), line)
            print(f"{name}: {len(new)} rows", flush=True)


if __name__ == "__main__":
    cli.main(main)

"""A study from its command line to the index: rows, and series where it keeps them."""

from collections.abc import Callable, Sequence
from typing import Any

import pandas as pd

from studies import cli
from studies.index import write_index
from studies.store import Output


def run_rows(
    name: str,
    about: str | None,
    words: Sequence[str] | None,
    make: Callable[[Output], pd.DataFrame],
    report: Callable[[Output, pd.DataFrame, str], Any],
) -> None:
    """Make the rows of the study `name`, or with --redraw read those that were saved, and write its report.

    `make(output)` returns the rows; `report(output, rows, stamp)` writes text, findings and figures.
    """

    def work(words: Sequence[str] | None) -> None:
        call = cli.parse(name, about, words)
        with Output(call) as output:
            if call.redraw:
                rows, line = output.load_rows()
            else:
                rows, line = make(output), cli.stamp(call.command)
                output.save_rows(rows, line)
            report(output, rows, line)
            write_index(output)
        print(f"wrote {name}.md, .csv, .json and figures to {output.path}")

    cli.main(work, words)


def run(
    name: str,
    about: str | None,
    words: Sequence[str] | None,
    make: Callable[[Output], tuple[Any, Any]],
    report: Callable[[Output, Any, Any, str], Any],
) -> None:
    """The same for a study with series: `make` returns rows and series, `report` takes the series after the rows."""

    def made(output: Output) -> pd.DataFrame:
        rows, series = make(output)
        output.save_series(series)
        return rows

    def reported(output: Output, rows: pd.DataFrame, line: str) -> Any:
        return report(output, rows, output.load_series(), line)

    run_rows(name, about, words, made, reported)

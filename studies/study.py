"""A study that keeps rows and series, from its command line to the index."""

from collections.abc import Callable, Sequence
from typing import Any

from studies import cli
from studies.index import write_index
from studies.store import Output


def run(
    name: str,
    about: str | None,
    words: Sequence[str] | None,
    make: Callable[[Output], tuple[Any, Any]],
    report: Callable[[Output, Any, Any, str], Any],
) -> None:
    """Make rows and series, or with --redraw read those that were saved, and write the report of the study `name`.

    `make(output)` returns both; `report(output, rows, series, stamp)` writes text, findings and figures.
    """

    def work(words: Sequence[str] | None) -> None:
        call = cli.parse(name, about, words)
        with Output(call) as output:
            if call.redraw:
                rows, line = output.load_rows()
                series = output.load_series()
            else:
                (rows, series), line = make(output), cli.stamp(call.command)
                output.save_rows(rows, line)
                output.save_series(series)
            report(output, rows, series, line)
            write_index(output)
        print(f"wrote {name}.md, .csv, .json and figures to {output.path}")

    cli.main(work, words)

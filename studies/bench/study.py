"""A study, from its command line to the index: rows, then findings, figures, tables and the report."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from studies.bench import cli, figures, tables
from studies.bench.collector import Measure, Run, collect
from studies.bench.index import write_index
from studies.bench.progress import track
from studies.bench.render import render, table
from studies.bench.store import Output, Row

Make = Callable[[Output], pd.DataFrame]


def run(name: str, about: str | None, words: Sequence[str] | None, work: Callable[[Output], None]) -> None:
    """Call `work(output)` for the command line `words` of the study `name`, and write the index anew."""

    def inside(words: Sequence[str] | None) -> None:
        with Output(cli.parse(name, about, words)) as output:
            work(output)
            write_index(output)
        print(f"wrote the files of {name} to {output.path}")

    cli.main(inside, words)


def run_rows(
    name: str,
    about: str | None,
    words: Sequence[str] | None,
    make: Make,
    report: Callable[[Output, pd.DataFrame, str], Any],
    curves: bool = False,
) -> None:
    """Make rows, or with --redraw read those that were saved; `report(output, rows, stamp)` writes all else."""

    def work(output: Output) -> None:
        if not output.call.redraw:
            output.save_rows(make(output), cli.stamp(output.call.command))
        report(output, *output.load_rows(curves))  # the same from new rows and from saved ones

    run(name, about, words, work)


def rows_of(runs: Callable[[bool], Iterable[Run]], measure: Measure) -> Make:
    """What makes the rows of runs(quick), with the columns of measure(run, result) and its curves, "series"."""

    def make(output: Output) -> pd.DataFrame:
        with output.kept() as kept:
            return collect(runs(output.call.quick), kept, measure)

    return make


def kept_rows(*parts: Callable[[bool], Iterable[tuple[str, Callable[[], Any]]]]) -> Make:
    """What makes the rows of part(quick), of keys and of functions that return a row, or a list of rows."""

    def kept_row(run: Callable[[], Any]) -> Row:
        made = run()
        return dict(made) if isinstance(made, dict) else {"rows": made}

    def make(output: Output) -> pd.DataFrame:
        keyed = list(chain.from_iterable(part(output.call.quick) for part in parts))
        with output.kept() as kept:
            made = [kept.made(key, partial(kept_row, run)) for key, run in track(keyed, lambda each: each[0])]
        return pd.DataFrame([row for each in made for row in each.get("rows", [each])])

    return make


def _nothing(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class Study:
    """What a study is made of."""

    name: str  # of its files and its template
    about: str | None  # what --help says
    make: Make  # make(output) -> the rows
    # findings(rows) -> what the report and the first screen say, `f` in the template
    findings: Callable[[pd.DataFrame], dict[str, Any]]
    # figures(rows, found) -> figures by the name of their file
    figures: Callable[[pd.DataFrame, dict[str, Any]], dict[str, Figure]] = _nothing
    # tables(rows, found) -> ready markdown, `tables` in the template, which has `rows`, too
    tables: Callable[[pd.DataFrame, dict[str, Any]], dict[str, str]] = _nothing
    # whether these are given medians (`tables.medians`), and the template `tables.failed`: the rows are of `collect`
    medians: bool = False
    curves: bool = False  # whether the figures are drawn of curves, in the column "series": by name, those of each row

    def main(self, words: Sequence[str] | None = None) -> None:
        """Make the rows, or with --redraw read those that were saved, and write the report."""
        run_rows(self.name, self.about, words, self.make, self.report, self.curves)

    def report(self, output: Output, rows: pd.DataFrame, line: str) -> None:
        """Write findings, figures and report; `line`: the stamp of the rows."""
        ready = {}
        if self.medians:
            rows = tables.medians(rows).infer_objects()
            failed = [cells[:3] for cells in tables.failures(rows)]  # the messages stand in the rows
            ready["failed"] = table(["solver", "setting", "status"], failed) if failed else ""
        found = self.findings(rows)
        output.save_findings(found)
        for name, figure in self.figures(rows, found).items():
            figures.save(figure, output, name)
        ready |= self.tables(rows, found)
        text = render(self.name, found, ready, stamp=line, quick=output.call.quick, rows=rows)
        output.write(f"{self.name}.md", text)

"""A study, from its command line to the index: rows and series, then findings, tables, figures and the report."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from studies.bench import cli, figures, tables
from studies.bench.collector import Run, collect
from studies.bench.index import write_index
from studies.bench.render import render, table
from studies.bench.store import Output
from twoloop import Result

Series = dict[str, NDArray[Any]]  # curves of runs, each under the name that `key` gives it


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
    make: Callable[[Output], pd.DataFrame],
    report: Callable[[Output, pd.DataFrame, str], Any],
) -> None:
    """Run a study without series: `make(output)` returns the rows, `report(output, rows, stamp)` writes its files."""

    def work(output: Output) -> None:
        if output.call.redraw:
            rows, line = output.load_rows()
        else:
            rows, line = make(output), cli.stamp(output.call.command)
            output.save_rows(rows, line)
        report(output, rows, line)

    run(name, about, words, work)


def key(row: pd.Series, curve: str) -> str:
    """Name of a curve of this row in the series."""
    words = [row.get(name) for name in ("group", "case", "solver", "variables", "partition")]
    values = [f"{name}={row[name]:g}" for name in ("err_in", "err_out", "tol", "h") if pd.notna(row.get(name))]
    return " ".join([*(word for word in words if isinstance(word, str)), *values, curve])


@dataclass(frozen=True)
class Study:
    """What a study is made of.

    Attributes
    ----------
    name : str
        Of its files and its template.
    about : str or None
        What --help says.
    runs : callable
        runs(quick) -> the runs.
    measure : callable
        measure(run, result) -> further columns; in the entry "series" curves by name, for figures.
    findings : callable
        findings(rows) -> what the report and the first screen say. `rows`, here and below: medians.
    figures : callable
        figures(rows, series) -> figures by the name of their file.
    """

    name: str
    about: str | None
    runs: Callable[[bool], Iterable[Run]]
    measure: Callable[[Run, Result], dict[str, Any]]
    findings: Callable[[pd.DataFrame], dict[str, Any]]
    figures: Callable[[pd.DataFrame, Series], dict[str, Figure]]

    def main(self, words: Sequence[str] | None = None) -> None:
        """Make the rows, or with --redraw read those that were saved, and write the report."""
        run(self.name, self.about, words, self._work)

    def _work(self, output: Output) -> None:
        if output.call.redraw:
            (rows, line), series = output.load_rows(), output.load_series()
        else:
            with output.kept() as kept:
                rows = collect(self.runs(output.call.quick), kept, self.measure)
            line, series = cli.stamp(output.call.command), {}
            for _, row in rows.iterrows():
                curves = row.get("series")  # none of a run without a result
                for name, curve in curves.items() if isinstance(curves, dict) else ():
                    series[key(row, name)] = np.array(curve, dtype=float)
            rows = rows.drop(columns="series", errors="ignore")
            output.save_rows(rows, line)
            output.save_series(series)
        self.report(output, rows, series, line)

    def report(self, output: Output, rows: pd.DataFrame, series: Series, line: str) -> None:
        """Write findings, figures and report."""
        rows = tables.medians(rows).infer_objects()
        found = self.findings(rows)
        output.save_findings(found)
        for name, figure in self.figures(rows, series).items():
            figures.save(figure, output, name)
        failed = [cells[:3] for cells in tables.failures(rows)]  # the messages stand in the rows
        ready = {"failed": table(["solver", "setting", "status"], failed) if failed else ""}
        output.write(f"{self.name}.md", render(self.name, found, ready, stamp=line, quick=output.call.quick))

"""A study from its command line to the index, reports/README.md: rows, findings, figures, tables, report."""

import importlib
import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies.bench import cli, figures, tables
from studies.bench.cli import Call, StudyError
from studies.bench.collector import Measure, Run, collect
from studies.bench.render import listed, render, table
from studies.bench.store import PARTS, Output, command_of, read_rows

Make = Callable[[Output], pd.DataFrame]
MOST_NAMED = 2  # commits and processors of rows that a stamp names one by one
NAMED = ("group", "case", "family", "solver", "way")  # columns by whose names rows are measured again


def run_rows(
    name: str,
    about: str | None,
    words: Sequence[str] | None,
    make: Make,
    report: Callable[[Output, pd.DataFrame, str], Any],
    curves: bool = False,
    parts: bool = False,
) -> None:
    """Make rows, or with --redraw read saved ones; `report(output, rows, stamp)` writes everything else."""

    def work(words: Sequence[str] | None) -> None:
        with Output(cli.parse(name, about, words, parts)) as output:
            report(output, *saved(output, make, curves))
            write_index(output)
        print(f"wrote the files of {name} to {output.path}")

    cli.main(work, words)


def saved(output: Output, make: Make, curves: bool = False) -> tuple[pd.DataFrame, str]:
    """Make and save rows, all or parts of them again, unless they are to be read; return them as they are read."""
    call = output.call
    if call.only:
        output.save_rows(*renewed(*output.load_rows(curves), lambda: make(output), call))
    elif not call.redraw:
        output.save_rows(make(output), cli.stamp(call.command))
    return output.load_rows(curves)  # the same from new rows and from saved ones


def renewed(old: pd.DataFrame, line: str, make: Callable[[], pd.DataFrame], call: Call) -> tuple[pd.DataFrame, str]:
    """Replace the rows of some names by new ones; return them and the stamp; StudyError if a name has no new rows."""
    columns = [column for column in NAMED if column in old]
    replaced = old[columns].isin(call.only).any(axis=1)
    commit, (_, _, _, machine, *_) = re.search(r"commit (\w+)", line), line.split("; ")
    for column, value in (("commit", commit[1] if commit else "unknown"), ("processor", machine.split(",")[0])):
        old = old.assign(**{column: old[column].fillna(value) if column in old else value})
    new = make().assign(commit=cli.commit(), processor=cli.processor())
    if missing := set(call.only) - set(new.reindex(columns=columns).to_numpy().ravel()):
        known = "; ".join(f"{column}: {', '.join(map(str, old[column].dropna().unique()))}" for column in columns)
        raise StudyError(f"no rows of {', '.join(sorted(missing))} were made, nothing is changed; there are {known}")
    rows = pd.concat([old[~replaced], new], ignore_index=True)
    keys = [name for name in (*NAMED, "trap", "mechanism") if name in old]
    # a name that is missing is NaN in rows that were read, and may be None in new ones
    named, all_named = (
        list(map(tuple, each[keys].astype(object).fillna("").astype(str).to_numpy())) for each in (old, rows)
    )
    places = {key: k for k, key in reversed(list(enumerate(named)))}
    order = [places.get(key, len(old)) for key in all_named]
    rows = rows.iloc[np.argsort(order, kind="stable")].reset_index(drop=True)
    now, before = cli.stamp(command_of(call.study)), line.split("; ")[1][:10]
    if not replaced.all() and before not in now:
        now = now.replace("; ", f"; {before} to ", 1)
    return rows, stamp_of(rows, now, cli.commit())


def stamp_of(rows: pd.DataFrame, line: str, commit: str) -> str:
    """Name in a stamp the rows of other commits: their groups or solvers if these are few."""
    pure = (rows.groupby("group", dropna=False)["commit"].nunique() == 1).all()
    column = "group" if pure else "way" if "way" in rows else "solver"
    apart = []
    for (other, processor), own in rows[rows["commit"] != commit].groupby(["commit", "processor"], sort=False):
        names = list(dict.fromkeys(own[column].dropna()))
        apart.append(f"{', '.join(names) if 0 < len(names) < 5 else 'other rows'}: commit {other}, {processor}")
    if len(apart) > MOST_NAMED:  # whoever wants to know looks into the rows
        apart = [f"rows of {len(apart)} other commits or processors are named in their columns"]
    return line.replace(f"commit {commit}", f"commit {commit} ({'; '.join(apart)})", 1) if apart else line


def rows_of(runs: Callable[[bool], Iterable[Run]], measure: Measure) -> Make:
    """What makes the rows of runs(quick), with the columns of measure(run, result) and its curves, "series"."""

    def make(output: Output) -> pd.DataFrame:
        with output.kept() as kept:
            return collect(output.call.wanted(runs(output.call.quick)), kept, measure)

    return make


@dataclass(frozen=True)
class Study:
    """What a study is made of."""

    name: str  # of its files and its template
    about: str | None  # what --help says
    make: Make  # make(output) -> the rows
    # findings(rows) -> what the report and the first screen say, `f` in the template
    findings: Callable[[pd.DataFrame], dict[str, Any]]
    # figures(rows, found) -> figures by the name of their file
    figures: Callable[[pd.DataFrame, dict[str, Any]], dict[str, Figure]] = lambda rows, found: {}
    # tables(rows, found) -> ready markdown, `tables` in the template, which has `rows`, too
    tables: Callable[[pd.DataFrame, dict[str, Any]], dict[str, str]] = lambda rows, found: {}
    # whether these are given medians (`tables.medians`), and the template `tables.failed`: the rows are of `collect`
    medians: bool = False
    curves: bool = False  # whether the figures are drawn of curves, in the column "series": by name, those of each row

    def main(self, words: Sequence[str] | None = None) -> None:
        """Make the rows, or with --redraw read those that were saved, and write the report."""
        run_rows(self.name, self.about, words, self.make, self.report, self.curves, parts=True)

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


REPORTS = {  # and their questions, in the order of the index
    "engines": "On closed loops, is twoloop faster than physics engines?",
    "validation": "Are the methods right on published and textbook mechanisms?",
    "honesty": "How often is a solver wrong without saying so?",
    "table3": "Does the paper's Table 3 come out again?",
    "claims": "Which of the paper's claims hold?",
    "energy": "Which methods keep the energy over long times?",
    "ensembles": "What do thousands of runs cost in one call?",
    "models": "Which model files are read, and are the models right?",
    "scale": "How do costs grow with the number of bodies?",
    "work_precision": "What does an accuracy cost, beside all other solvers?",
    "reproduction": "Do the paper's figures come out again?",
}
# claims reads the rows of the others
STUDIES = (
    *("work_precision", "table3", "energy", "validation", "honesty", "planted_errors", "ensembles", "scale", "engines"),
    *("models", "reproduction", "claims"),
)


def module_of(name: str) -> ModuleType:
    """Import the module of a study, a file or `study` in a folder."""
    found = importlib.import_module(f"studies.{name}")
    return importlib.import_module(f"studies.{name}.study") if hasattr(found, "__path__") else found


def run_study(name: str, words: Sequence[str]) -> None:
    """Run a study for a command line: the `STUDY` of its module, or its `main`."""
    module = module_of(name)
    getattr(module, "STUDY", module).main(words)


def line_of(folder: Path, name: str) -> dict[str, Any] | None:
    """Return the entry of a report in the index, or None if it has no answer; raise StudyError if a file is damaged."""
    path = folder / f"{name}.json"
    if not (path.is_file() and (folder / f"{name}.md").is_file()):
        return None
    try:
        answer = json.loads(path.read_text()).get("answer")
    except ValueError as error:
        raise StudyError(f"{path} cannot be read ({error}); run python -m studies.{name} again") from None
    parts = PARTS if name == "reproduction" else (name,)
    files = [file for rows in parts if (file := folder / f"{rows}.csv").is_file()]
    if not answer or not files:
        return None
    made = [made_on(*read_rows(file)) for file in files]
    dates, processors = sorted({date for date, _ in made}), list(dict.fromkeys(each for _, own in made for each in own))
    told = {"name": name, "question": REPORTS[name], "answer": answer}
    return told | {"date": " to ".join(dict.fromkeys((dates[0], dates[-1]))), "processor": listed(processors)}


def made_on(rows: pd.DataFrame, stamp: str) -> tuple[str, list[str]]:
    """Tell the date of a stamp, and the processors on which the rows were measured: those of their column if any."""
    day, parts = re.search(r"\d{4}-\d{2}-\d{2}( to \d{4}-\d{2}-\d{2})?", stamp), stamp.split("; ")
    known = rows["processor"].dropna().unique().tolist() if "processor" in rows else []
    known = known or [part.split(",")[0] for part in parts if re.search(r", \d+ cores", part)]
    return day[0] if day else "unknown", list(dict.fromkeys(map(short, known)))


def short(processor: str) -> str:
    """Name a processor in a table: without family and model, and what makers add."""
    return re.sub(r"\(R\)| \(family [\w ]+\)| Processor", "", processor).strip()


def write_index(output: Output) -> None:
    """Write README.md of the folder anew."""
    lines = [line for name in REPORTS if (line := line_of(output.path, name))]
    more: dict[str, Any] = {"quick": output.call.quick, "lines": lines}
    more["there"] = {path.name for path in output.path.iterdir()}
    output.write("README.md", render("index", {}, {}, **more))

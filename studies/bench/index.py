"""The index of the reports, reports/README.md: one line a report, with its question, its answer, date and processor."""

import importlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pandas as pd

from studies.bench.cli import StudyError
from studies.bench.render import listed, render
from studies.bench.store import PARTS, Output, read_rows

REPORTS = {  # and their questions, in the order of the index
    "engines": "On closed loops, is twoloop faster than physics engines?",
    "validation": "Do the methods reproduce published mechanisms?",
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
    """Read what the index says of a report; None where it has not been written, or its findings give no answer.

    Raises StudyError if a file is damaged.
    """
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

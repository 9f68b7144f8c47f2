"""The paper's figures 2-7 and 9-14, and its errata: what came of each, in one report from the rows of five parts."""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from studies.bench import cli, figures, tables
from studies.bench.cli import Call, StudyError
from studies.bench.render import listed, number, render
from studies.bench.store import Output
from studies.bench.study import rows_of, short, write_index
from studies.reproduction import ablation, beam, motion, step_size, violation

NAME = "reproduction"
PARTS: dict[str, Any] = dict(motion=motion, step_size=step_size, violation=violation, beam=beam, ablation=ablation)
CURVES = ("motion", "step_size", "violation")  # parts whose figures are drawn of the curves of runs
ERRATA = tomllib.loads(Path(__file__).with_name("errata.toml").read_text())["errata"]


def read_rows(call: Call, name: str) -> tuple[pd.DataFrame, str]:
    """Read the rows of a part, a row a run, and their stamp."""
    output = Output(replace(call, study=name))
    if not (output.path / f"{name}.csv").is_file():
        raise StudyError(f"there is no {output.path / name}.csv; run python -m studies.{NAME} {name}")
    rows, stamp = output.load_rows(name in CURVES)
    return tables.medians(rows).infer_objects(), stamp


def findings_of(rows: dict[str, pd.DataFrame]) -> dict[str, Any]:
    """Collect the findings of each part, by its name, and the answer."""
    found = {name: PARTS[name].findings_of(own) for name, own in rows.items()}
    return found | {"answer": answer(*(found[name] for name in PARTS))}


def answer(moved: Any, stepped: Any, kept: Any, beams: Any, compared: Any) -> str:
    """Tell in one sentence what comes out as the text describes it, and whether the paper's idea pays."""
    right = {
        "motion": moved["agree"] and moved["reach"],
        "steps": stepped["holds"] and stepped["longer"],
        "constraints": not kept["irk_grows"] and max(kept["irk"]) <= kept["kept"],
    }
    text = f"The linkage's {listed(name for name in right if right[name])} come out as described"
    text += f", but not {listed(name for name in right if not right[name])}" * (not all(right.values()))
    near = [case["steps_as_printed"] for case in beams["cases"]]
    text += f", and the steps of {sum(near)} of {len(near)} beams"
    if projected := compared["against"][ablation.PROJECTED]["time"]:
        text += f"; projecting once a step takes {number(projected[1])} times the time of its method"
    return f"{text}."


def report(output: Output) -> None:
    """Write findings, figures and report from the rows of all parts."""
    read = {name: read_rows(output.call, name) for name in PARTS}
    rows = {name: own for name, (own, _) in read.items()}
    stamps = {name: stamp.split("; ") for name, (_, stamp) in read.items()}
    processors = dict.fromkeys(short(stamp[3].split(",")[0]) for stamp in stamps.values())
    found = findings_of(rows) | {"processor": listed(processors)}
    output.save_findings(found)
    for name, part in PARTS.items():
        figures.save(part.figure_of(rows[name], found[name]), output, name)
    dates = {name: stamp[1] for name, stamp in stamps.items()}
    output.write(f"{NAME}.md", render(NAME, found, {}, dates=dates, errata=ERRATA, quick=output.call.quick))


def _work(words: Sequence[str] | None) -> None:
    parser = cli.parser(NAME, __doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"make the rows of these only: {', '.join(PARTS)}")
    given = parser.parse_args(words)
    if unknown := [name for name in given.parts if name not in PARTS]:
        parser.error(f"{', '.join(unknown)}: not a part; the parts are {', '.join(PARTS)}")
    call = cli.call_of(NAME, given, words)
    for name in () if call.redraw else given.parts or PARTS:
        part = PARTS[name]
        make = part.make if hasattr(part, "make") else rows_of(part.runs, getattr(part, "measure", lambda *of_run: {}))
        with Output(replace(call, study=name)) as output:
            output.save_rows(make(output), cli.stamp(call.command))
    missing = [name for name in PARTS if not (call.out / f"{name}.csv").is_file()]
    if given.parts and missing:
        print(f"wrote the rows of {', '.join(given.parts)} to {call.out}; the report needs {', '.join(missing)}, too")
        return
    with Output(call) as output:
        report(output)
        write_index(output)
    print(f"wrote the files of {NAME} to {output.path}")


def main(words: Sequence[str] | None = None) -> None:
    cli.main(_work, words)

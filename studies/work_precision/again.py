"""Measure single mechanisms, or other parts, again: `python -m studies.work_precision.again NAME ...`.

The whole study takes hours. A part is a mechanism, or some solvers on all mechanisms: those of another project, or the
default beside CyRK, mostly the fastest of the others. Its rows take the place of those in work_precision.csv at once,
with the commit and the processor that they were made on; `python -m studies.work_precision --redraw` then writes the
report anew. Without names: what there is.
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import pandas as pd

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.headline import OWN_CODE
from studies.bench.row_files import versions
from studies.bench.store import KeptRows, Output
from studies.work_precision import first_calls, mechanisms, minimal, study

DEFAULT_BESIDE, BESIDE = "the default and CyRK", (OWN_CODE, "CyRK, DOP853", "CyRK, Vern8")
IN_ANGLES = ", in angles"  # after that of a mechanism: the runs of its equations in minimal coordinates


@dataclass(frozen=True)
class Part:
    """Rows that are measured together: all of a group, or those of one case, of one project or of some solvers."""

    group: str
    case: str | None
    make: Callable[[KeptRows], pd.DataFrame]
    family: str | None = None
    solvers: Sequence[str] = ()


def parts() -> dict[str, Part]:
    """List what can be measured again, by name."""
    runs = mechanisms.runs(False)
    found = {
        name: Part(mechanisms.GROUP, name, partial(mechanisms.collect, [run for run in runs if run.case.name == name]))
        for name in mechanisms.problems(False)
    }
    for family in dict.fromkeys(run.solver.family for run in runs if run.solver.family != "two-loop"):
        own = [run for run in runs if run.solver.family == family]
        found[family] = Part(mechanisms.GROUP, None, partial(mechanisms.collect, own), family)
    beside = [run for run in runs if run.solver.name in BESIDE]
    found[DEFAULT_BESIDE] = Part(mechanisms.GROUP, None, partial(mechanisms.collect, beside), solvers=BESIDE)
    found["first calls"] = Part(first_calls.GROUP, None, partial(first_calls.collect, quick=False))
    for name in minimal.problems(False):
        found[name + IN_ANGLES] = Part(minimal.GROUP, name, partial(minimal.collect, quick=False, names=[name]))
    return found


def part_of(name: str, known: Mapping[str, Part]) -> Part:
    """Look up a part.

    Raises StudyError if there is none.
    """
    if name not in known:
        raise StudyError(f"there is no {name!r}; parts are {'; '.join(known)}")
    return known[name]


def replaced(rows: pd.DataFrame, part: Part, new: pd.DataFrame) -> pd.DataFrame:
    """Put the new rows of one part in the place of the old ones."""
    old = rows["group"] == part.group
    if part.case is not None:
        old &= rows["case"] == part.case
    if part.family is not None:
        old &= rows["family"] == part.family
    if part.solvers:
        old &= rows["solver"].isin(part.solvers) & rows["case"].isin(new["case"])
    columns = list(dict.fromkeys([*rows.columns, *new.columns]))
    return pd.concat([rows[~old], new], ignore_index=True).reindex(columns=columns)


def main(words: Sequence[str] | None = None) -> None:
    names, known = list(sys.argv[1:] if words is None else words), parts()
    if not names:
        raise StudyError(f"parts are {'; '.join(known)}")
    chosen = {name: part_of(name, known) for name in names}
    with Output(cli.parse("work_precision", __doc__, [])) as output:
        for name, part in chosen.items():
            with output.kept({"part": name}) as kept:
                new = part.make(kept)
            rows, line = output.load_rows()
            new = study.calibrated(new).assign(processor=cli.processor(), commit=cli.commit())
            output.save_rows(replaced(rows, part, new), line)
            if output.file("work_precision.json").is_file():
                found = output.load_findings()
                output.save_findings(found | {"versions": found["versions"] | versions()})
            print(f"{name}: {len(new)} rows", flush=True)


if __name__ == "__main__":
    cli.main(main)

"""Every claim of the paper that can be tested: what was run, the number, and a verdict computed from rows."""

import importlib
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
from rich.progress import track

from studies import claims_algebra as algebra
from studies import (
    claims_beam,
    claims_conclusion,
    claims_four_bar,
    claims_introduction,
    claims_method,
    claims_table3,
    tables,
)
from studies import claims_steps as steps
from studies.claims_report import judged, report, summary
from studies.claims_verdicts import Claim
from studies.energy import GEOMETRIES
from studies.energy_drift import ONE
from studies.index import put_in_index
from studies.report import Call, load_rows, parse, save_rows, stamp
from studies.table3 import SECOND
from twoloop.mechanisms import four_bar

CLAIMS: tuple[Claim, ...] = (
    *claims_introduction.CLAIMS,
    *claims_method.CLAIMS,
    *claims_four_bar.CLAIMS,
    *claims_table3.CLAIMS,
    *claims_beam.CLAIMS,
    *claims_conclusion.CLAIMS,
)
SOURCES = ("table3", "motion", "step_size", "violation", "energy", "beam")  # studies whose rows are read
PHASES, PHASES_QUICK = 40, 8  # instants of a period from which single steps are taken


def own_rows(quick: bool) -> pd.DataFrame:
    """Make the rows of claims.csv."""
    first = four_bar()
    second = four_bar(**SECOND)  # type: ignore[arg-type]
    third, fourth = four_bar(**GEOMETRIES[ONE]), four_bar(branch=1)
    problems = {problem.name: problem for problem in (first, second, third)}
    phases = PHASES_QUICK if quick else PHASES

    def checks() -> Iterator[Iterator[algebra.Row]]:
        for problem in problems.values():
            yield algebra.closure(problem)
            yield algebra.equations(problem)
        yield algebra.partitions(first)
        for problem, name in ((first, ""), (second, ""), (third, ""), (fourth, ", joint 1-2 above")):
            yield algebra.heights(problem, problem.name + name)
        yield algebra.moving_base()
        yield algebra.tableau()
        yield algebra.explicit()
        yield algebra.newmark_map()
        yield algebra.iteration_map(first)
        yield algebra.stopping_test()
        yield steps.orders(first)
        yield steps.local_error(first, phases)
        yield steps.embedding(first)
        yield steps.needless(first, phases)
        yield steps.determinants(first)
        yield steps.values_alone(first)
        yield steps.stiff()
        yield claims_beam.elastic_force()

    return pd.DataFrame([row for rows in track(list(checks()), description="claims") for row in rows])


def gather(call: Call) -> tuple[dict[str, pd.DataFrame], dict[str, str]]:
    """Rows and stamps of the other studies, from the same folder; one that is missing is run, unless redrawing."""
    rows, lines = {}, {}
    for name in SOURCES:
        path: Path = call.out / f"{name}.csv"
        if not path.exists() and not call.redraw:
            words = [*(["--quick"] if call.quick else []), "--out", str(call.out)]
            importlib.import_module(f"studies.{name}").main(words)
        if path.exists():
            rows[name], lines[name] = load_rows(path)
            if "repeat" in rows[name]:  # a study on the bench: one row a repetition
                rows[name] = tables.medians(rows[name])
    return rows, lines


def headline(rows: dict[str, pd.DataFrame]) -> str:
    """One line for the index of reports."""
    return summary(judged(CLAIMS, rows))


def main(words: list[str] | None = None, command: str | None = None) -> None:
    """Run the study and write its report."""
    call = parse("claims", __doc__, words, command)
    path = call.out / "claims.csv"
    rows, lines = gather(call)
    if call.redraw:
        rows["claims"], line = load_rows(path)
    else:
        rows["claims"], line = own_rows(call.quick), stamp(call.command)
        save_rows(path, rows["claims"], line)
        rows["claims"], _ = load_rows(path)  # judged as a reader of the file would judge
    report(judged(CLAIMS, rows), lines, line, call)
    text = f"[Report](claims.md), [rows](claims.csv)\n\n{headline(rows)}"
    put_in_index(call, "claims", __doc__, text, line)
    print(headline(rows))
    print(f"wrote claims.md and claims.csv to {call.out}")


if __name__ == "__main__":
    main()

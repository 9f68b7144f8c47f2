"""Which solvers pass the check of `twoloop.testing`, that anyone can run on a simulator: ours, rivals, and how."""

import signal
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
import pandas as pd

from studies.bench.apart import apart
from studies.bench.render import table
from studies.bench.store import Output, Row
from studies.bench.study import Study
from studies.conformance.simulators import ADAPTERS, OURS, SHOWN, Simulator, simulators
from twoloop import ConstraintWarning
from twoloop.testing import problems
from twoloop.testing.conformance import check_problem, settings_of
from twoloop.testing.findings import Finding, shown
from twoloop.testing.known_problem import KnownProblem
from twoloop.testing.known_problems import MAKERS

TOLERANCES = (1e-4, 1e-6, 1e-8)
QUICK = ("DOP853", "Pr9, extensisq", "LagrangesMethod, SymPy")
QUICK_PROBLEMS = ("pendulum", "driven_crank")
LIMIT = 20  # s of CPU time for all runs of a simulator on a problem
NOT_CHECKED = "NoModel: "  # how a message begins that says so
HELD = ("constraints", "velocity constraints")
DRIFTS = "its equations are of accelerations; nothing keeps it on the constraints"
PASSED, FAILED, UNTOLD = "passed", "failed", "not checked"
LONGEST = 100  # characters of a cell; the CSV has all
COLUMNS = ("simulator", "problem", "property", "measured", "allowed", "reason")


def checked(simulator: Simulator, problem: KnownProblem, quick: bool) -> list[Row]:
    """The rows of one simulator on one problem: each property, and what was not measured."""
    tolerances = (simulator.tolerances or TOLERANCES)[: 2 if quick else None]
    settings = settings_of(tolerances, simulator.steps, None)
    try:
        findings, skipped = apart(lambda: check_problem(simulator.simulate, problem, settings), cpu=LIMIT)
    except EOFError as error:
        out_of_time = error.args == (-signal.SIGXCPU,)
        what = f"not back in {LIMIT} s of CPU time" if out_of_time else f"its process ended, {error}"
        findings, skipped = [Finding(problem.name, "runs", what, "the end of the motion", False)], []
    rows = [_row(simulator, each) for each in findings]
    untold = {"outcome": UNTOLD, "measured": "", "allowed": ""}
    if rows[0]["outcome"] != UNTOLD:
        rows += [untold | {"problem": problem.name, "property": name, "reason": why} for _, name, why in skipped]
    return rows


def _row(simulator: Simulator, finding: Finding) -> Row:
    measured, reason = shown(finding.measured), finding.hint
    outcome = PASSED if finding.passed else FAILED
    if measured.startswith(NOT_CHECKED):
        outcome, reason, measured = UNTOLD, measured.removeprefix(NOT_CHECKED).partition(" (at ")[0], ""
    elif not finding.passed and simulator.drifts and finding.property in HELD:
        reason = DRIFTS
    row = {"problem": finding.problem, "property": finding.property, "outcome": outcome, "measured": measured}
    return row | {"allowed": shown(finding.allowed), "reason": reason}


def make(output: Output) -> pd.DataFrame:
    """Check everything."""
    quick, rows = output.call.quick, list[Row]()
    chosen = [each for each in simulators() if not quick or each.name in QUICK]
    warnings.simplefilter("ignore", ConstraintWarning)
    for simulator in chosen:
        if simulator.group == OURS:  # kernels are read once, not by each process
            pendulum = MAKERS["pendulum"]()
            for seen in (pendulum, replace(pendulum, name="unknown")):
                with suppress(Exception):
                    simulator.simulate(seen, np.array([0.0, 0.01]), 1e-3)
    with output.kept() as kept:
        for simulator in chosen:
            told = {"simulator": simulator.name, "group": simulator.group, "package": simulator.package}
            told["version"] = _version(simulator.package)
            for problem in [MAKERS[name]() for name in QUICK_PROBLEMS] if quick else problems("smoke"):
                key = f"{simulator.name} | {problem.name}"
                found = kept.made(key, lambda s=simulator, p=problem: {"rows": checked(s, p, quick)})["rows"]  # type: ignore[misc]
                rows += [told | row for row in found]
    return pd.DataFrame(rows)


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Of each simulator how many problems it passes, was checked on, and what fails where."""
    found: dict[str, Any] = {"groups": {}, "n_problems": int(rows["problem"].nunique()), "limit": LIMIT}
    for group in (OURS, ADAPTERS, SHOWN):
        lines = [_line(str(name), own) for name, own in rows[rows["group"] == group].groupby("simulator", sort=False)]
        passed = [line["simulator"] for line in lines if line["checked"] and not line["failures"]]
        found["groups"][group] = {
            "lines": lines,
            "passed": passed,
            "n": len([line for line in lines if line["checked"]]),
        }
    outcomes = rows["outcome"].value_counts()
    return found | {"outcomes": {each: int(outcomes.get(each, 0)) for each in (PASSED, FAILED, UNTOLD)}}


def _line(name: str, rows: pd.DataFrame) -> dict[str, Any]:
    made = rows[rows["outcome"] != UNTOLD]
    failed = made[made["outcome"] == FAILED]
    what = {str(prop): list(own["problem"]) for prop, own in failed.groupby("property", sort=False)}
    package, of = rows.iloc[0][["package", "version"]]
    return {
        "simulator": name,
        "of": f"{package} {of}",
        "checked": made["problem"].nunique(),
        "passed": made["problem"].nunique() - failed["problem"].nunique(),
        "properties": len(made),
        "failures": what,
    }


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """A table of each group without those that pass everything, and one of failures, known drift apart."""
    header = ["simulator", "of", "problems passed", "properties", "what does not hold"]
    ready = {}
    for group, told in found["groups"].items():
        lines = []
        for line in (each for each in told["lines"] if each["simulator"] not in told["passed"]):
            what = "; ".join(f"{name}: {', '.join(where)}" for name, where in line["failures"].items())
            cells = [line["simulator"], line["of"], f"{line['passed']} of {line['checked']}", str(line["properties"])]
            lines.append([*cells, what if line["checked"] else "has no model of these problems"])
        ready[group] = table(header, lines) if lines else ""
    failed = rows[(rows["outcome"] == FAILED) & (rows["reason"] != DRIFTS)].fillna("")
    lines = [[" ".join(str(row[name]).split())[:LONGEST] for name in COLUMNS] for _, row in failed.iterrows()]
    return ready | {"failed": table(COLUMNS, lines) if lines else ""}


STUDY = Study("conformance", __doc__, make, findings_of, tables=tables_of)


def main(words: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    STUDY.main(words)


if __name__ == "__main__":
    main()

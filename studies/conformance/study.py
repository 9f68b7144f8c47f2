"""Which solvers pass the check of `twoloop.testing`: ours, rivals by our adapters, rivals as their authors show."""

import signal
import warnings
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from studies.bench.apart import apart
from studies.bench.cli import version_of
from studies.bench.names import label
from studies.bench.render import table
from studies.bench.store import Output, Row
from studies.bench.study import Study
from studies.conformance.simulators import ADAPTERS, OURS, SHOWN, Simulator, simulators
from twoloop import ConstraintWarning
from twoloop.testing import problems
from twoloop.testing.conformance import SAYS_SO, check_problem, settings_of
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
LONGEST = 90  # letters of a message in the report
SIGNS = {  # of properties, in the report
    **{"error of q": "q", "limit of q": "q", "error of v": "v", "limit of v": "v"},
    **{"constraints": "C", "velocity constraints": "C'", "energy": "E", "multipliers": "λ", SAYS_SO: "ends"},
}


def checked(simulator: Simulator, problem: KnownProblem, quick: bool) -> list[Row]:
    """The rows of one simulator on one problem: each property, and what was not measured."""
    settings = settings_of((simulator.tolerances or TOLERANCES)[: 2 if quick else None], simulator.steps, None, None)
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
            told["version"] = version_of(simulator.package)
            for problem in [MAKERS[name]() for name in QUICK_PROBLEMS] if quick else problems("smoke"):
                key = f"{simulator.name} | {problem.name}"
                found = kept.made(key, lambda s=simulator, p=problem: {"rows": checked(s, p, quick)})["rows"]  # type: ignore[misc]
                rows += [told | row for row in found]
    return pd.DataFrame(rows)


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Of each simulator how many problems it passes, was checked on, and what fails where."""
    found: dict[str, Any] = {"groups": {}, "n_problems": int(rows["problem"].nunique()), "limit": LIMIT}
    for group in (OURS, ADAPTERS, SHOWN):
        lines = [_line(str(name), own) for name, own in rows[rows["group"] == group].groupby("simulator", sort=False)]
        checked = [line for line in lines if line["checked"]]
        passed = [line["simulator"] for line in checked if not line["failures"]]
        found["groups"][group] = {"lines": lines, "passed": passed, "n": len(checked)}
    outcomes = rows["outcome"].value_counts()
    return found | {"outcomes": {each: int(outcomes.get(each, 0)) for each in (PASSED, FAILED, UNTOLD)}}


def _line(name: str, rows: pd.DataFrame) -> dict[str, Any]:
    made = rows[rows["outcome"] != UNTOLD]
    failed = made[made["outcome"] == FAILED]
    what = {str(prop): list(own["problem"]) for prop, own in failed.groupby("property", sort=False)}
    package, of = rows.iloc[0][["package", "version"]]
    found: dict[str, Any] = {"simulator": name, "of": f"{package} {of}", "checked": made["problem"].nunique()}
    found |= {"passed": made["problem"].nunique() - failed["problem"].nunique(), "properties": len(made)}
    return found | {"failures": what}


def tables_of(rows: pd.DataFrame, found: dict[str, Any]) -> dict[str, str]:
    """What fails where, a line for each simulator that does not pass everything; and runs that do not end."""
    names = list(rows["problem"].unique())
    lines = []
    for group, told in found["groups"].items():
        for line in (each for each in told["lines"] if each["simulator"] not in told["passed"]):
            own = rows[(rows["group"] == group) & (rows["simulator"] == line["simulator"])]
            cells = [_cell(own[own["problem"] == name]) for name in names]
            lines.append([label(line["simulator"], coded=False), line["of"], *cells])
    ended = rows[(rows["outcome"] == FAILED) & rows["property"].isin(("runs", SAYS_SO))]
    said = [
        [label(row["simulator"], coded=False), row["problem"], _short(str(row["measured"]))]
        for _, row in ended.iterrows()
    ]
    return {
        "failed": table(["simulator", "version", *names], lines) if lines else "",
        "ended": table(["simulator", "problem", "what happened"], said) if said else "",
    }


def _cell(rows: pd.DataFrame) -> str:
    """What fails of a simulator on a problem."""
    if not (rows["outcome"] != UNTOLD).any():
        return "–"
    return ", ".join(SIGNS.get(name, name) for name in rows[rows["outcome"] == FAILED]["property"]) or "+"


def _short(message: str) -> str:
    words = " ".join(message.split()).partition(". ")[0]
    return words if len(words) <= LONGEST else f"{words[:LONGEST].rstrip()} ..."


STUDY = Study("conformance", __doc__, make, findings_of, tables=tables_of)

"""Planted errors: which check catches each of some faults in models, solvers and reports, planted one at a time."""

import contextlib
import io
import json
import os
import time
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import pandas as pd
import pytest

from studies.bench import study
from studies.bench.apart import apart
from studies.bench.cli import REPORTS, ROOT, StudyError
from studies.bench.collector import Run, warm_up
from studies.bench.end_states import case_of
from studies.bench.end_states import row_of as row_of_run
from studies.bench.render import render
from studies.bench.solvers import CATALOGUE
from studies.bench.store import Output, Row
from studies.planted_errors.faults import SCIPY, TRACING, Fault, all_faults
from studies.validation import study as validation
from twoloop import mechanisms
from twoloop.__main__ import compile_all
from twoloop.mechanisms import Problem

TOLERANCE = 1e-10  # of the runs
LEAST = {"q": 9.0, "v": 7.0, "lam": 6.0}  # decimals of a sound run with it, where its reference holds them
BEHIND = 1.0  # decimals that BDF has less
DRIFT = 1e-7  # of the energy, over the largest kinetic energy
KEPT = 1e-8  # largest residual of a constraint that is kept, in position and velocity; of accelerations 1e-5
MOST_EVALUATIONS = {  # about 1.4 times what sound runs take: too many are a fault of the step-size control
    "A01 pendulum": {TRACING: 2500},
    "Andrews' squeezing mechanism": {"Gauss12": 7900, "RadauIIA9": 4700, "DOP853 (twoloop)": 3100},
    "double pendulum": {"Gauss12": 9300, "BDF": 7400, SCIPY: 2200},
    "driven crank": {"Gauss12": 3800},
    "projection pendulum": {"Gauss12": 96_000},
}
TIME_LIMIT = 20.0  # s of a check
QUICK = 5  # of so many faults one is planted by a quick run, and all wrong traces, which cost next to nothing
NONE = "none"
# who catches a fault, in the order of the report, and how what catches it begins; all else are tests
ITSELF, KNOWN, BOUNDS, TESTS = "solve_dae", "known motion", "bounds", "tests"
BEGINS = {
    ITSELF: ("start or run refused", "run stopped"),
    KNOWN: ("reference",),
    BOUNDS: ("energy", "violation", "count of evaluations", "time limit of the check", "the process of the check"),
}


def run_check(problem: Problem, solver: str) -> str:
    """Run the problem and say what speaks against the run, "" if nothing does."""
    row = row_of_run(Run(case_of(problem), CATALOGUE[solver], TOLERANCE, repeats=1))
    if row["error_q"] is None:
        if row["status"] == "NOT_APPLICABLE":
            return "start or run refused: cannot be traced"
        kind = str(row["message"]).split(":")[0].split(" at t")[0]
        return f"start or run refused: {kind}" if row["status"] == "RAISED" else f"run stopped: {row['status'].lower()}"
    known = problem.reference
    assert known is not None
    for level, least in LEAST.items():
        got = row[f"digits_{level}"]
        least -= BEHIND if solver == "BDF" else 0.0
        if got is not None and got < min(least, known.digits.get(level, 0.0) - 1.0):
            return f"reference: {level}"
    if row["energy"] is not None and row["energy"] > DRIFT:
        return "energy"
    for level, most in (("q", KEPT), ("v", KEPT), ("a", 1e3 * KEPT)):
        if row[f"violation_{level}"] > most:
            return f"violation: {level}"
    if row["n_evaluations"] > MOST_EVALUATIONS[problem.name][solver]:
        return "count of evaluations"
    return ""


class FirstFailure:
    """A plugin of pytest that keeps the name of the first test that fails."""

    def __init__(self) -> None:
        self.name = ""

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Called by pytest after each test."""
        if report.failed and not self.name:
            self.name = report.nodeid


def test_check(tests: Sequence[str]) -> str:
    """Run tests and name the first that fails, "" if none does."""
    seen = FirstFailure()
    options = ["-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *(str(ROOT / test) for test in tests)]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        code = pytest.main(options, plugins=[seen])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        return f"pytest ended with {code!s}"
    return seen.name


test_check.__test__ = False  # type: ignore[attr-defined]


def check(fault: Fault, planted: bool) -> str:
    """Plant a fault in this process, or not, and say what catches it."""
    os.chdir(ROOT)
    warnings.simplefilter("ignore")
    with fault.plant() if planted else contextlib.nullcontext():
        return test_check(fault.checks) if fault.problem is None else run_check(fault.problem, fault.solver)


def caught(fault: Fault, planted: bool) -> str:
    """Check a fault in a process of its own; a check that does not come back has caught it, too."""
    try:
        return str(apart(partial(check, fault, planted), TIME_LIMIT))
    except TimeoutError:
        return "time limit of the check"
    except EOFError:
        return "the process of the check ended"


def row_of(fault: Fault) -> Row:
    """Make the row of a fault, with what catches it."""
    began = time.monotonic()
    found = caught(fault, True)
    row: Row = {"fault": fault.name, "place": fault.place, "caught_by": found or NONE}
    row["check"] = fault.checks[0] if fault.checks else f"run by {fault.solver}"
    return row | {"seconds": time.monotonic() - began}


def check_sound(faults: Sequence[Fault]) -> int:
    """Run every check without a fault, and count the checks; raise StudyError if one fails."""
    foreign = Run(case_of(mechanisms.double_pendulum()), CATALOGUE[SCIPY], TOLERANCE, repeats=1)
    warm_up(foreign, 0, set())  # here, so that the processes of the checks need not compile
    seen = set()
    for fault in faults:
        # what is sound of a faulty problem is the problem of that name
        key = fault.checks or (fault.solver, fault.problem.name if fault.problem else "")
        if key in seen:
            continue
        seen.add(key)
        sound = fault
        if fault.problem is not None:
            made = {problem.name: problem for problem in (make() for make in validation.MAKE)}
            sound = Fault(fault.name, fault.place, problem=made[fault.problem.name], solver=fault.solver)
        if found := caught(sound, False):
            raise StudyError(f"the check {key} fails without a fault: {found}")
    return len(seen)


def make(output: Output) -> pd.DataFrame:
    faults = all_faults()
    if output.call.quick:
        faults = [fault for k, fault in enumerate(faults) if fault.place == "trace" or k % QUICK == 0]
    compile_all()  # what a child of a slow machine compiles may exceed TIME_LIMIT, and is lost with it
    check_sound(faults)
    with output.kept() as kept:
        return pd.DataFrame([kept.made(fault.name, partial(row_of, fault)) for fault in faults])


def findings_of(rows: pd.DataFrame) -> dict[str, Any]:
    """Count the faults by who catches them, in all and by their place."""
    checks = {name: [who for who, begins in BEGINS.items() if name.startswith(begins)] for name in rows["caught_by"]}
    who = rows["caught_by"].map(lambda name: NONE if name == NONE else (*checks[name], TESTS)[0])

    def counts(own: pd.DataFrame) -> dict[str, int]:
        return {each: int((who[own.index] == each).sum()) for each in (*BEGINS, TESTS, NONE)}

    places = [{"place": str(place), "n": len(own), **counts(own)} for place, own in rows.groupby("place", sort=False)]
    found = {"n": len(rows), "missed": rows["fault"][who == NONE].tolist(), "by": counts(rows), "places": places}
    answer = f"The checks catch {len(rows) - len(found['missed'])} of {len(rows)} planted faults; solve_dae itself "  # type: ignore[arg-type]
    return found | {"tolerance": TOLERANCE, "answer": f"{answer}refuses or stops {found['by'][ITSELF]} of them."}  # type: ignore[index]


def report(output: Output, rows: pd.DataFrame, line: str) -> None:
    """Write the findings, and the page of the documentation; a quick run writes the page beside its rows."""
    found = findings_of(rows)
    mutants = output.path / "mutants.json"
    found["mutants"] = json.loads(mutants.read_text()) if mutants.is_file() else None
    output.save_findings(found)
    text = render("planted_errors", found, {}, stamp=line, quick=output.call.quick)
    if output.path == REPORTS.resolve() and not output.call.quick:
        (ROOT / "docs" / "planted_errors.md").write_text(text)
    else:
        output.write("planted_errors.md", text)


def main(words: Sequence[str] | None = None) -> None:
    study.run_rows("planted_errors", __doc__, words, make, report)

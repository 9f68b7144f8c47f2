"""The study of which solvers pass the check: its rows, what is said of them, and processes that do not come back."""

import os

import pandas as pd
import pytest

from references import as_shown
from references.plain_equations import NoModel
from studies.bench.render import render
from studies.conformance import study
from studies.conformance.simulators import ADAPTERS, OURS, SHOWN, Simulator, simulators, twin_of
from twoloop.testing import problems
from twoloop.testing.changes import in_a_frame
from twoloop.testing.known_problems import MAKERS

PENDULUM = MAKERS["pendulum"]()


def known(problem, times, tolerance):
    return problem.reference.q, problem.reference.v


def asked(simulate, problem=PENDULUM, **more):
    return study.checked(Simulator("mine", SHOWN, "numpy", simulate, **more), problem, True)


def no_model(problem, times, tolerance):
    raise NoModel("points alone")


def hangs(problem, times, tolerance):
    while True:
        pass


def dies(problem, times, tolerance):
    os._exit(3)


def test_what_a_solver_does_is_a_row(monkeypatch):
    rows = {row["property"]: row for row in asked(known)}
    assert {rows[name]["outcome"] for name in ("runs", "error of q", "constraints", "energy")} == {study.PASSED}
    assert rows["frame"]["outcome"] == study.FAILED  # the motion of the other frame
    (row,) = asked(no_model)
    assert (row["outcome"], row["reason"], row["measured"]) == (study.UNTOLD, "points alone", "")
    monkeypatch.setattr(study, "LIMIT", 1)
    for simulate, says in ((hangs, "not back in 1 s of CPU time"), (dies, "its process ended, 3")):
        (row,) = asked(simulate)
        assert row["outcome"] == study.FAILED and row["measured"] == says and row["property"] == "runs"
    rows = asked(lambda problem, times, tolerance: (problem.reference.q * 1.01, problem.reference.v), drifts=True)
    reasons = {row["property"]: row["reason"] for row in rows if row["outcome"] == study.FAILED}
    assert reasons["constraints"] == study.DRIFTS != reasons["error of q"]
    assert {row["outcome"] for row in rows if row["property"] in ("frame", "units")} == {study.UNTOLD}


def test_a_twin_is_the_problem_as_it_stands():
    for problem in problems("smoke"):
        if problem.name not in ("out_of_reach", "shaken_spring"):
            assert twin_of(problem).system.n_q == problem.n_q
    for other in (MAKERS["out_of_reach"](), MAKERS["shaken_spring"](), in_a_frame(PENDULUM).problem):
        with pytest.raises(NoModel):
            twin_of(other)


def test_every_simulator_is_named_once_and_has_a_version():
    found = simulators()
    names = [each.name for each in found]
    assert len(set(names)) == len(names) > 25 and {each.group for each in found} == {OURS, ADAPTERS, SHOWN}
    assert set(study.QUICK) < set(names)


def test_a_solver_is_found_by_its_place(tmp_path, monkeypatch):
    text = "NAME, PACKAGE, DRIFTS = 'mine', 'numpy', False\ndef simulate(problem, times, tolerance):\n    return None\n"
    (tmp_path / "mine_alone.py").write_text(text)
    monkeypatch.setattr(as_shown, "__path__", [*as_shown.__path__, str(tmp_path)])
    found = {each.name: each for each in simulators() if each.group == SHOWN}
    assert found["mine"].package == "numpy" and not found["mine"].drifts and len(found) > 5


def test_the_report_says_who_passes_and_what_fails():
    row = {
        "problem": "pendulum",
        "measured": "2",
        "allowed": "1",
        "reason": "it drifts",
        "package": "p",
        "version": "1",
    }
    rows = [row | {"simulator": "good", "group": OURS, "property": "runs", "outcome": "passed"}]
    rows += [row | {"simulator": "bad", "group": SHOWN, "property": "constraints", "outcome": "failed"}]
    rows += [row | {"simulator": "none", "group": SHOWN, "property": "runs", "outcome": "not checked"}]
    found, text = said_with_tables(pd.DataFrame(rows))
    assert "Ours: 1 of 1 pass" in text and "As their authors show: 0 of 1 pass" in text
    assert "| bad | p 1 | C |" in text and "| none | p 1 | – |" in text and "do not come to the end" not in text
    rows.append(rows[1] | {"property": "runs", "measured": "stuck. Try another"})
    text = said_with_tables(pd.DataFrame(rows))[1]
    assert "| bad | p 1 | C, runs |" in text and "| bad | pendulum | stuck |" in text
    del rows[-1]
    rows[1]["outcome"] = "passed"
    found, text = said_with_tables(pd.DataFrame(rows))
    assert "As their authors show: 1 of 1 pass" in text and "| bad |" not in text
    assert found["outcomes"] == {"passed": 2, "failed": 0, "not checked": 1}


def said_with_tables(rows):
    found = study.findings_of(rows)
    return found, render("conformance", found, study.tables_of(rows, found), stamp="stamp", quick=False, rows=rows)


@pytest.mark.slow  # SymPy
def test_a_quick_run(tmp_path):
    study.STUDY.main(["--quick", "--out", str(tmp_path)])
    rows = pd.read_csv(tmp_path / "conformance.csv", comment="#")
    assert set(rows["simulator"]) == set(study.QUICK)
    done = rows[(rows["problem"] == "pendulum") & (rows["property"] == "error of q")]
    assert len(done) == 3 and (done["outcome"] == "passed").all()
    assert "Quick run" in (tmp_path / "conformance.md").read_text()

"""The planted errors: some of the faults are caught again, and what is not caught is said."""

from dataclasses import replace

import pandas as pd
import pytest

from studies.bench.render import render
from studies.planted_errors import study as planted_errors
from studies.planted_errors.faults import TRACING, Fault, all_faults, pendulum_in_python, python_copy
from twoloop import mechanisms

FAULTS = {fault.name: fault for fault in all_faults()}


def test_there_are_many_and_each_has_its_own_name():
    assert len(FAULTS) == len(all_faults()) >= 60
    assert {fault.place for fault in FAULTS.values()} == {
        "mechanism", "trace", "reference", "tableau", "options", "adapter", "report",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "caught_by"),
    [
        ("Q_d with the other sign", "start or run refused: ValueError"),
        ("one mass 0.1 % too large", "reference: q"),
        ("lam with the other sign", "reference: lam"),
        ("steps that never grow", "count of evaluations"),
        ("single precision (ours)", "reference: q"),
        ("accelerations of the other sign (ours)", "violation: a"),
    ],
)
def test_a_fault_is_caught(name, caught_by):
    assert planted_errors.row_of(FAULTS[name])["caught_by"] == caught_by


@pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if fault.place == "trace"])
def test_a_wrong_trace_is_refused_or_ends_the_run(name):
    late = name == "a callback that changes after 100 calls"
    expected = "run stopped: wrong_trace" if late else "start or run refused: cannot be traced"
    assert planted_errors.row_of(FAULTS[name])["caught_by"] == expected


def test_a_sound_run_is_not_caught():
    fault = Fault(
        "nothing", "trace", problem=replace(mechanisms.pendulum(), system=pendulum_in_python()), solver=TRACING
    )
    assert planted_errors.row_of(fault)["caught_by"] == planted_errors.NONE
    for sound in (mechanisms.andrews(), mechanisms.driven_crank()):
        for problem in (sound, replace(sound, system=python_copy(sound.system))):
            fault = Fault("nothing", "mechanism", problem=problem)
            assert planted_errors.row_of(fault)["caught_by"] == planted_errors.NONE


def test_sentences_turn_with_the_rows():
    rows = pd.DataFrame([{"fault": f"fault {k}", "place": "tableau", "caught_by": "a test"} for k in range(3)])

    def text(rows):
        found = planted_errors.findings_of(rows) | {"mutants": None}
        return render("planted_errors", found, {"faults": ""}, stamp="stamp", quick=False)

    assert "refuses or stops 0; 0 show only against a known motion; 3 are caught by our test suite.\n" in text(rows)
    rows.loc[1, "caught_by"] = planted_errors.NONE
    assert "2 are caught by our test suite; no check that we ran catches 1: fault 1." in text(rows)
    rows["caught_by"] = ["start or run refused: ValueError", "run stopped: wrong_trace", "reference: q"]
    assert "refuses or stops 2; 1 show only against a known motion; 0 are caught" in text(rows)
    rows["caught_by"] = ["count of evaluations", "violation: a", "tests/test_tableaux.py::test_order"]
    assert planted_errors.findings_of(rows)["by"] == {"solve_dae": 0, "known motion": 0, "bounds": 2, "tests": 1}


def test_every_run_with_a_fault_has_a_bound_of_its_evaluations():
    runs = [(fault.problem.name, fault.solver) for fault in all_faults() if fault.problem is not None]
    assert runs and [run for run in runs if run[1] not in planted_errors.MOST_EVALUATIONS.get(run[0], {})] == []

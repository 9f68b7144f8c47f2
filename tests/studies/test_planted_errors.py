"""The planted errors: some of the faults are caught again, and counted by who catches them."""

import json
from dataclasses import replace

import pandas as pd
import pytest

from studies.bench.cli import Call
from studies.bench.store import Output
from studies.planted_errors import study as planted_errors
from studies.planted_errors.faults import TRACING, Fault, all_faults, pendulum_in_python, python_copy
from studies.planted_errors.study import NONE
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
        ("single precision (twoloop)", "reference: q"),
        ("accelerations of the other sign (twoloop)", "violation: a"),
    ],
)
def test_a_fault_is_caught(name, caught_by):
    assert planted_errors.row_of(FAULTS[name])["caught_by"] == caught_by


@pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if fault.place == "trace"])
def test_a_wrong_trace_is_refused_or_ends_the_run(name):
    late = name == "a callback that changes after 100 calls"
    expected = "run stopped: wrong_trace" if late else "start or run refused: cannot be traced"
    assert planted_errors.row_of(FAULTS[name])["caught_by"] == expected


@pytest.mark.slow
def test_a_sound_run_is_not_caught():
    fault = Fault(
        "nothing", "trace", problem=replace(mechanisms.pendulum(), system=pendulum_in_python()), solver=TRACING
    )
    assert planted_errors.row_of(fault)["caught_by"] == NONE
    for sound in (mechanisms.andrews(), mechanisms.driven_crank()):
        fault = Fault("nothing", "mechanism", problem=replace(sound, system=python_copy(sound.system)))
        assert planted_errors.row_of(fault)["caught_by"] == NONE


def test_faults_are_counted_by_who_catches_them(tmp_path):
    caught = ["start or run refused: ValueError", "reference: q", "violation: a", "tests/test_x.py::test_it"]
    rows = pd.DataFrame([{"fault": each, "place": "tableau", "caught_by": each} for each in (*caught, NONE)])
    with Output(Call("planted_errors", False, tmp_path, True, "")) as output:
        planted_errors.report(output, rows, "stamp")
    found, text = (
        json.loads((tmp_path / "planted_errors.json").read_text()),
        (tmp_path / "planted_errors.md").read_text(),
    )
    assert found["by"] == {"solve_dae": 1, "known motion": 1, "bounds": 1, "tests": 1, NONE: 1}
    answer = "The checks catch 4 of 5 planted faults; solve_dae itself refuses or stops 1 of them."
    assert found["answer"] == answer and f"{answer} No check catches: none." in text
    assert "|tableau|5|1|1|1|1|" in text


def test_every_run_with_a_fault_has_a_bound_of_its_evaluations():
    runs = [(fault.problem.name, fault.solver) for fault in all_faults() if fault.problem is not None]
    assert runs and [run for run in runs if run[1] not in planted_errors.MOST_EVALUATIONS.get(run[0], {})] == []

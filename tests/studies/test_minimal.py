"""Minimal coordinates beside constraints, from rows made by hand; nothing else sees these rows."""

import pandas as pd
import pytest

from studies.bench.collector import Run
from studies.bench.end_states import case_of
from studies.bench.render import number
from studies.bench.solvers import CATALOGUE, MINIMAL, MINIMAL_FAMILY, OWN, RIVALS
from studies.work_precision import minimal, rivals
from studies.work_precision import study as work_precision
from tests.studies.test_rivals import stated
from tests.studies.test_tables import rows
from twoloop import mechanisms

ANGLES, *_, CVODE = MINIMAL


def repeated(*lines, family="two-loop"):
    """Medians of rows of (solver, error, seconds) whose repetitions take the same time."""
    made = rows(*lines).assign(case="four-bar", tol=0.1, family=family)
    return made.assign(inside_s=0.25 * made["call_s"], times=[(time,) * 5 for time in made["call_s"]])


def everywhere():
    own = repeated(("auto", 1e-3, 4.0), ("auto, compiled", 1e-3, 1.0), ("Taylor", 1e-3, 9.0))
    return pd.concat([own, repeated(("heyoka", 1e-3, 2.0), family="heyoka")], ignore_index=True)


def in_angles(time, error=1e-3):
    made = repeated((ANGLES, error, time), (CVODE, error, 2.0 * time), family=MINIMAL_FAMILY)
    return made.assign(group=minimal.GROUP)


@pytest.mark.parametrize(("time", "verdicts"), [(0.5, {"behind": 1, "ahead": 0}), (3.0, {"behind": 0, "ahead": 1})])
def test_our_best_is_compared_with_the_cheapest_in_minimal_coordinates(time, verdicts):
    found = minimal.findings_of(in_angles(time), everywhere())
    at = found["mechanisms"][0]["at"][0]
    assert at["error"] == 1e-3 and at["rival"] == {"solver": ANGLES, "call_s": time, "close": []}
    assert at["solver"] == "auto, compiled"
    assert found["n"] == 1 and {f"n_{name}": n for name, n in verdicts.items()}.items() <= found.items()
    assert found["least"] == found["median"] == found["most"] == pytest.approx(time)


def test_without_rows_nothing_is_said():
    found = minimal.findings_of(pd.DataFrame(), everywhere())
    assert found["mechanisms"] == [] and found["n"] == 0
    unmatched = minimal.findings_of(in_angles(1.0), everywhere().assign(case="other"))
    assert unmatched["n"] == 0 and unmatched["least"] is None


@pytest.mark.parametrize(("time", "faster", "slower"), [(0.5, 1, 0), (3.0, 0, 1)])
def test_the_report_says_what_the_rows_say(time, faster, slower):
    text = stated(1.0, minimal=minimal.findings_by_kind(in_angles(time), everywhere()))
    said = f"closed form | 1 | {faster} | {slower} | {number(time)} to {number(time)} ({number(time)}) | 0 of 0 |"
    assert "## Should I use a DAE at all?" in text and said in text
    assert "Should I use a DAE" not in stated(1.0)


def test_a_run_that_ends_with_a_wrong_state_is_told():
    wrong = pd.concat([in_angles(1.0), in_angles(0.1, error=0.7)], ignore_index=True).assign(tol=1e-9)
    found = minimal.findings_of(wrong, everywhere())
    assert (found["asked"], found["wrong"]) == (4, 2) and found["mechanisms"][0]["at"][0]["rival"]["call_s"] == 1.0
    said = "1 of 2 of `heyoka, minimal coordinates`, 1 of 2 of `CVODE from C, minimal coordinates` |"
    assert said in stated(1.0, minimal=minimal.findings_by_kind(wrong, everywhere()))
    assert minimal.findings_of(wrong.assign(tol=0.1), everywhere())["wrong"] == 0


def test_pendulums_and_singular_positions_are_counted_apart():
    others = ("double pendulum", "A02, N = 1")
    both = pd.concat([in_angles(3.0), *(in_angles(0.5).assign(case=name) for name in others)], ignore_index=True)
    made = pd.concat([everywhere(), *(everywhere().assign(case=name) for name in others)], ignore_index=True)
    found = minimal.findings_by_kind(both, made)
    assert [(each["kind"], each["n_behind"], each["n_ahead"]) for each in found] == [
        ("loops", 0, 1),
        ("pendulums", 1, 0),
        ("singular", 1, 0),
    ]


def test_no_ranking_of_solvers_with_constraints_sees_them():
    assert not {*MINIMAL} & {*OWN, *RIVALS}
    table = pd.concat([everywhere().assign(group=rivals.GROUP), in_angles(0.1)], ignore_index=True)
    assert not set(MINIMAL) & set(work_precision.part(table, rivals.GROUP)["solver"])
    assert work_precision.part(table).empty
    assert not {name for name, solver in CATALOGUE.items() if solver.family == MINIMAL_FAMILY} ^ {*MINIMAL}


def test_the_runs_are_those_of_the_mechanisms_with_minimal_coordinates():
    made = minimal.runs(True)
    assert {run.case.name for run in made} == {"four-bar"} and {run.solver.name for run in made} == {*MINIMAL}
    assert {run.group for run in made} == {minimal.GROUP}


def test_a_row_holds_the_error_and_a_mechanism_without_them_is_not_applicable():
    pytest.importorskip("sksundae")
    (run,) = [run for run in minimal.runs(True) if run.solver.name == CVODE and run.value == 1e-5]
    row = rivals.row_at_end(run, 0, set())
    assert row["status"] == "REACHED_END" and row["error_q"] < 1e-2 and row["violation_q"] < 1e-12
    assert row["family"] == MINIMAL_FAMILY and row["keeps_constraints"]
    for solver in MINIMAL:
        row = rivals.row_at_end(Run(case_of(mechanisms.andrews()), CATALOGUE[solver], 1e-5, repeats=1), 0, set())
        assert row["status"] == "NOT_APPLICABLE" and "Andrews" in row["message"]

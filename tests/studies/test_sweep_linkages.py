"""The study of random linkages: its measures against closed forms, its sentences against rows that are made up."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from studies.bench.cli import StudyError, processor
from studies.bench.render import render
from studies.bench.store import read_rows
from studies.sweep_linkages import as_a_table, in_one_call, study
from twoloop import sweep
from twoloop.mechanisms import four_bar

ASSEMBLE = "ValueError: the linkage cannot be assembled with theta3 = 1"


def test_two_processes_are_not_timed_on_one_core(monkeypatch):
    monkeypatch.setattr(study, "threads_of", lambda wanted: 1)
    with pytest.raises(StudyError, match="two processes are timed on two cores"):
        study.make(SimpleNamespace(call=SimpleNamespace(quick=False)))


def made_up(**changes):
    """Rows of three linkages and of the four ways to sweep."""
    linkages = pd.DataFrame(study.drawn(3)).assign(
        group="linkages",
        status=["REACHED_END", "REACHED_END", "ERROR"],
        message=["", "", ASSEMBLE],
        energy_error=[1e-9, 3e-9, np.nan],
        half=[1.0, 0.5, np.nan],
        period=[2.0, 1.001, np.nan],
    )
    walls = {"processes": (30.0, 15.0), "threads": (29.0, 20.0), **changes.pop("walls", {})}
    scaling = [
        {"group": "scaling", "parallel": way, "workers": k + 1, "wall": wall, "n_runs": 500}
        for way, times in walls.items()
        for k, wall in enumerate(times)
    ]
    one_call = [
        {
            "group": in_one_call.GROUP,
            "n_runs": n,
            "n_assembled": n - 1,
            "wall": 1.0,
            "n_failed": failed,
            "n_left": failed,
        }
        | {"energy_median": 1e-9, "energy_high": 2e-9, "energy_error": 1e-8, "n_hard": 40, "n_any": 100}
        | {"end_error_hard": 1e-7, "end_error_any": 1e-7, "n_unknown_hard": failed, "n_unknown_any": 0}
        | study.drawn(1)[0]
        for n, failed in ((100, 0), (10_000, changes.pop("n_failed", 0)))
    ]
    table = [
        {"group": "table", "way": way, "parallel": "processes", "workers": 2, "n_runs": 3, "wall": wall, "n_done": 2}
        | {"n_in_lanes": n, "energy_median": 1e-9, "energy_error": 1e-8}
        for way, wall, n in (("in lanes", changes.pop("wall_of_lanes", 1.0), 2), ("one by one", 4.0, 0))
    ]
    parts = [linkages.assign(**changes), *map(pd.DataFrame, (scaling, one_call, table))]
    return pd.concat(parts, ignore_index=True)


def said(rows):
    return render("sweep_linkages", study.findings_of(rows), {}, stamp="stamp", quick=False, rows=rows)


def test_the_default_linkage_has_the_period_of_its_reference():
    start = {"L1": 1.0, "L2": 2.0, "L3": 1.5, "ground": 3.0, "theta3": 0.0, "branch": -1}
    rows = sweep(
        study.linkage, [start], measure=study.measured, parallel="threads", t_span=study.SPAN, events=study.TURNING
    )
    assert rows.loc[0, "period"] == pytest.approx(four_bar().reference.period, rel=1e-7)
    assert rows.loc[0, "half"] == pytest.approx(0.5 * four_bar().reference.period, rel=1e-7)
    assert 1e-12 < rows.loc[0, "energy_error"] < 1e-7


def test_a_bar_that_turns_back_three_times_within_milliseconds_hides_no_rest():
    start = study.drawn(5453)[5452]
    rows = sweep(
        study.linkage, [start], measure=study.measured, parallel="threads", t_span=study.SPAN, events=study.TURNING
    )
    assert rows.loc[0, "period"] == pytest.approx(2.0 * rows.loc[0, "half"], rel=1e-6)


def test_draws_are_always_the_same_and_within_their_ranges():
    one, more = study.drawn(5), study.drawn(9)
    assert one == more[:5]
    assert all(low <= each[name] <= high for each in more for name, (low, high) in study.RANGES.items())
    assert {each["branch"] for each in more} == {-1, 1}


def test_linkages_by_the_hundred_are_assembled_as_one_is():
    given = in_one_call.drawn(60)
    assert (given[:20] == in_one_call.drawn(20)).all()
    linkages, made = in_one_call.assembled(given), []
    for each in given:
        try:
            made.append(study.linkage(*each[:5], int(each[5])))
        except ValueError:
            continue
    assert len(made) == len(linkages.q0) < 60
    assert max(np.abs(one.q0 - q0).max() for one, q0 in zip(made, linkages.q0, strict=True)) < 1e-14


@pytest.fixture
def few_compared(monkeypatch):
    monkeypatch.setattr(in_one_call, "N_WORST", 2)
    monkeypatch.setattr(in_one_call, "N_ANY", 3)


def test_energies_and_ends_of_many_are_those_of_one(few_compared):
    (linkages, runs), row = next(in_one_call.blocks(30, 1.0)), in_one_call.row_of(30, 1.0)
    lengths = linkages.given[:, :3]
    for k in (0, 11):
        problem = study.linkage(*linkages.given[k, :5], int(linkages.given[k, 5]))
        scale = 9.81 * (lengths[k] ** 2).sum()
        known = problem.energy(0.0, runs.q[k], runs.v[k]) / scale
        assert np.abs(in_one_call.energies(lengths, runs.q, runs.v)[k] - known).max() < 1e-14
    errors = in_one_call.energy_errors(linkages, runs)
    assert row["energy_error"] == errors.max() < 1e-7 and row["n_failed"] == row["n_left"] == 0
    assert 0.0 < row["end_error_any"] < 1e-6 and (row["n_hard"], row["n_any"], row["n_assembled"]) == (4, 3, len(runs))
    off = runs.q[0, :, -1] + 1e-3
    assert in_one_call.end_error(linkages.given[0], off, 1.0) == pytest.approx(1e-3, rel=1e-3)


def test_findings_are_of_the_rows():
    found = study.findings_of(made_up())
    assert (found["n"], found["n_done"], found["n_unassembled"], found["others"]) == (3, 2, 1, {})
    assert found["worst"]["L1"] == study.drawn(3)[1]["L1"] and found["return"]["worst"] == pytest.approx(0.001 / 1.001)
    assert found["ratios"] == {"processes": 2.0, "threads": 1.45} and found["scales"] is True
    assert [each["words"] for each in found["speeds"]][:2] == ["Two processes", "Two threads"]
    assert found["speeds"][0]["per_second"] == pytest.approx(500 / 15.0)
    with pytest.raises(StudyError, match="no linkage reached the end"):
        study.findings_of(made_up(status="RANK_LOST"))


def test_findings_follow_the_rows():
    said(made_up())
    walls = {"processes": (30.0, 20.0), "threads": (30.0, 16.0)}
    said(made_up(walls=walls))
    assert not study.findings_of(made_up(walls=walls))["scales"]
    other = made_up(status=["REACHED_END", "STAGNATED", "ERROR"])
    said(other)
    assert study.findings_of(other)["others"]["STAGNATED"] == 1
    assert "; 3 failed" in said(made_up(n_failed=3)) and ", and none failed" in said(made_up())
    none = made_up(period=np.nan, half=np.nan)
    said(none)
    assert study.findings_of(none)["n_periodic"] == 0


def test_the_quick_study(tmp_path, few_compared):
    study.STUDY.main(["--quick", "--out", str(tmp_path)])
    report = (tmp_path / "sweep_linkages.md").read_text()
    rows, _ = read_rows(tmp_path / "sweep_linkages.csv")
    assert (rows["processor"] == processor()).all()
    assert not list(tmp_path.glob("*.parquet"))  # of unfinished runs only
    assert "Quick run" in report and "Processes are compared in the full run only" in report
    study.STUDY.main(["--quick", "--redraw", "--out", str(tmp_path)])
    assert (tmp_path / "sweep_linkages.md").read_text().split("\n", 4)[4] == report.split("\n", 4)[4]


def test_a_table_says_whether_lanes_are_faster():
    assert "In lanes the table takes 0.25 times the time" in said(made_up())
    assert "Lanes are no faster here" in said(made_up(wall_of_lanes=5.0))


def test_a_table_has_the_same_runs_in_both_ways(monkeypatch):
    monkeypatch.setattr("twoloop.ensembles.in_turn.CALL", 1e9)  # code is worth its time
    monkeypatch.setattr("twoloop.sweeps.shared_runs.DEAR", 1e9)  # so are linkages that are made twice
    monkeypatch.setattr("twoloop.sweeps.shared_runs.LONGEST", 1e9)  # s, also where kernels have to be compiled
    lanes, singly = as_a_table.rows_of(study.linkage, study.drawn(12), (0.0, 1.0), "threads", 1)
    assert lanes["n_done"] == singly["n_done"] > 6 and singly["n_in_lanes"] == 0 < lanes["n_in_lanes"]
    assert 0.0 < lanes["energy_error"] < 1e-6 and 0.0 < singly["energy_error"] < 1e-6

"""What studies share: curves by keys, and rows that are measured again beside others."""

from datetime import date

import numpy as np
import pandas as pd
import pytest

from studies import energy
from studies.bench import study as shared
from studies.bench.cli import Call, StudyError, commit, processor
from studies.bench.row_files import versions
from studies.bench.store import Output, key
from studies.reproduction import motion, step_size, violation
from studies.work_precision import mechanisms
from studies.work_precision import study as work_precision


def rows_of(study, quick):
    told = [
        {"group": run.group, "case": run.case.name, "solver": run.solver.name, **run.settings}
        for run in study.runs(quick)
    ]
    return pd.DataFrame(told)


@pytest.mark.parametrize("study", [energy, motion, step_size, violation], ids=lambda study: study.__name__)
def test_every_run_has_curves_of_its_own(study):
    for quick in (True, False):
        rows = rows_of(study, quick)
        keys = [key(row) for _, row in rows.iterrows()]
        assert len(set(keys)) == len(keys) > 1


def test_a_key_survives_the_file_of_rows(tmp_path):
    rows = rows_of(energy, True)
    rows.to_csv(tmp_path / "rows.csv", index=False)
    read = pd.read_csv(tmp_path / "rows.csv")
    assert [key(row) for _, row in read.iterrows()] == [key(row) for _, row in rows.iterrows()]


STAMP = "`python -m studies.x`; 2026-11-26; commit abc; AMD EPYC, 2 cores; Linux"
OLD = pd.DataFrame(
    {"group": "run", "case": ["a", "a", "b", "b"], "solver": ["x", "y"] * 2, "call_s": [1.0, 2.0, 3.0, 4.0]}
)


def renewed(*only):
    new = OLD[OLD["solver"].isin(only) | OLD["group"].isin(only)].assign(call_s=9.0)[::-1]
    return shared.renewed(OLD, STAMP, lambda: new, Call("x", False, None, False, "", only))


def test_rows_measured_again_take_the_place_of_those_of_their_solver():
    rows, line = renewed("x")
    assert rows["call_s"].tolist() == [9.0, 2.0, 9.0, 4.0] and rows["solver"].tolist() == ["x", "y"] * 2
    assert (
        rows["commit"].tolist() == [commit(), "abc"] * 2 and rows["processor"].tolist() == [processor(), "AMD EPYC"] * 2
    )
    assert f"2026-11-26 to {date.today()}; commit {commit()} (y: commit abc, AMD EPYC); " in line
    rows, line = renewed("run")
    assert (rows["call_s"] == 9.0).all() and "abc" not in line and " to " not in line
    with pytest.raises(StudyError, match="there are group: run; case: a, b; solver: x, y"):
        renewed("z", "x")
    rows, _ = shared.renewed(OLD, STAMP, lambda: OLD[:1].assign(solver="z"), Call("x", False, None, False, "", ("z",)))
    assert rows["solver"].tolist() == ["x", "y", "x", "y", "z"]


def test_rows_without_a_group_stay_in_their_place():
    old = OLD.assign(group=np.nan)
    new = old[old["solver"] == "x"].assign(group=None)
    rows, _ = shared.renewed(old, STAMP, lambda: new, Call("x", False, None, False, "", ("x",)))
    assert rows["solver"].tolist() == ["x", "y"] * 2


def test_groups_of_other_commits_stand_beside_that_of_the_newest_rows():
    rows = pd.DataFrame({"group": ["input", "short"], "commit": ["abc", "def"], "processor": "Xeon (6)"})
    assert shared.stamp_of(rows[:1], STAMP, "abc") == STAMP
    assert shared.stamp_of(rows, STAMP, "abc") == STAMP.replace("abc", "abc (short: commit def, Xeon (6))")


def test_a_study_makes_the_runs_that_are_wanted(tmp_path):
    call = Call("energy", True, tmp_path, False, "", ("heyoka",))
    assert call.wants("heyoka") and call.wants("other", "heyoka") and not call.wants("other")
    for runs, only in (
        (mechanisms.runs, "four-bar"),
        (mechanisms.runs, "SUNDIALS"),
        (mechanisms.minimal_runs, mechanisms.MINIMAL_GROUP),
    ):
        todo, wanted = runs(True), Call("x", True, tmp_path, False, "", (only,)).wanted(runs(True))
        assert {only} <= {name for run in wanted for name in (run.group, run.case.name, run.solver.family)}
        assert (len(wanted) == len(todo)) == (only == mechanisms.MINIMAL_GROUP) and wanted
    assert Call("energy", True, tmp_path, False, "").wants("other")


def test_versions_of_kept_rows_are_as_told_then(tmp_path):
    (tmp_path / "work_precision.json").write_text('{"versions": {"heyoka": "1", "scipy": "1"}}')
    told = {}
    for name, redraw, only in (("read", True, ()), ("part", False, ("heyoka",)), ("all", False, ())):
        told[name] = work_precision.versions_of(Output(Call("work_precision", False, tmp_path, redraw, "", only)))
    assert told["read"] == {"heyoka": "1", "scipy": "1"} and told["part"] == {"heyoka": "1"} | versions()
    assert told["all"] == versions() and versions()["scipy"] != "1"

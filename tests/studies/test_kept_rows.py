"""Rows survive an exception, a kill and a torn line; rows of other sources or settings are not mixed in."""

import json
import math
import subprocess
import sys
import textwrap
import time

import pytest

from studies import kept_rows
from studies.kept_rows import KeptRows
from studies.report import ROOT

# json.loads stands for a run: a job is the text of its row, and a text that is no JSON fails
SETTINGS = {"quick": True}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "study.partial.jsonl"


def interrupt(path, *names):
    """Leave the rows of these names as an interrupted run would."""
    with pytest.raises(KeyboardInterrupt), KeptRows(path, SETTINGS) as kept:
        for name in names:
            kept.add(name, {"name": name})
        raise KeyboardInterrupt


def test_rows_come_in_the_order_of_the_jobs_and_the_file_goes(path):
    jobs = {name: json.dumps({"name": name}) for name in "abc"}
    with KeptRows(path, SETTINGS) as kept:
        assert kept.collect(jobs, json.loads, 2) == [{"name": name} for name in "abc"]
        assert path.exists()
    assert not path.exists()


def test_a_failing_run_leaves_the_rows_before_it(path):
    with pytest.raises(json.JSONDecodeError), KeptRows(path, SETTINGS) as kept:
        kept.collect({"a": '{"x": 1}', "b": "fails"}, json.loads, 1)
    with KeptRows(path, SETTINGS) as kept:
        assert kept.n_taken_over == 1
        # "a" would fail if it were run again
        assert kept.collect({"a": "fails", "b": '{"x": 2}'}, json.loads, 1) == [{"x": 1}, {"x": 2}]


def test_numbers_survive_as_they_are(path):
    row = {"x": 0.1 + 0.2, "tiny": 5e-324, "nothing": None, "nan": math.nan, "series": [1.0 / 3.0]}
    interrupt(path)
    with pytest.raises(KeyboardInterrupt), KeptRows(path, SETTINGS) as kept:
        kept.add("a", row)
        fresh = kept.rows("a")[0]
        raise KeyboardInterrupt
    with KeptRows(path, SETTINGS) as kept:
        taken = kept.rows("a")[0]
    assert math.isnan(taken.pop("nan")) and math.isnan(fresh.pop("nan")) and row.pop("nan")
    assert taken == fresh == row


def test_a_line_cut_off_is_dropped(path):
    interrupt(path, "a", "b")
    path.write_text(path.read_text()[:-5])
    with pytest.raises(KeyboardInterrupt), KeptRows(path, SETTINGS) as kept:
        assert "a" in kept and "b" not in kept
        kept.add("c", {"name": "c"})
        raise KeyboardInterrupt
    with KeptRows(path, SETTINGS) as kept:
        assert kept.rows("ac") == [{"name": "a"}, {"name": "c"}]


def test_rows_with_other_settings_are_thrown_away_aloud(path, capsys):
    interrupt(path, "a")
    with KeptRows(path, {"quick": False}) as kept:
        assert kept.n_taken_over == 0 and "a" not in kept
    assert f"1 rows in {path} thrown away: made by other sources or with other settings" in capsys.readouterr().out


def test_rows_of_other_sources_are_thrown_away(path, monkeypatch):
    interrupt(path, "a")
    monkeypatch.setattr(kept_rows, "sources", lambda: "changed")
    with KeptRows(path, SETTINGS) as kept:
        assert "a" not in kept


def test_sources_change_with_a_file(tmp_path, monkeypatch):
    (tmp_path / "twoloop").mkdir()
    file = tmp_path / "twoloop" / "a.py"
    file.write_text("x = 1\n")
    monkeypatch.setattr(kept_rows, "ROOT", tmp_path)
    before = kept_rows.sources()
    assert kept_rows.sources() == before
    file.write_text("x = 2\n")
    changed = kept_rows.sources()
    file.rename(tmp_path / "twoloop" / "b.py")
    assert len({before, changed, kept_rows.sources()}) == 3


def test_an_edited_file_is_not_guessed_at(path):
    interrupt(path, "a", "b")
    path.write_text(path.read_text().replace('{"key": "a"', '{"key" "a"'))
    with pytest.raises(ValueError, match="line 2 is not a row"), KeptRows(path, SETTINGS):
        pass


KILLED = """
    import sys, time
    from pathlib import Path
    from studies.energy import jobs, measure
    from studies.kept_rows import KeptRows

    def run(job):
        if job is None:
            time.sleep(1000.0)
        return measure(job)

    if __name__ == "__main__":
        keyed = {repr(job): job for job in list(jobs(quick=True))[-3:]}
        with KeptRows(Path(sys.argv[1]), {}) as kept:
            kept.collect({**keyed, "never": None}, run, 1)
"""


def test_a_killed_study_goes_on_and_ends_with_the_same_rows(tmp_path, path):
    from studies.energy import jobs, measure

    script = tmp_path / "killed.py"
    script.write_text(textwrap.dedent(KILLED))
    environment = {"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"}
    with subprocess.Popen([sys.executable, script, path], env=environment, stdout=subprocess.PIPE) as study:
        while not path.exists() or path.read_text().count("\n") < 3:  # the head and two rows
            assert study.poll() is None
            time.sleep(0.01)
        study.kill()
        study.communicate(timeout=120)  # ends when its worker has gone too
    chosen = {repr(job): job for job in list(jobs(quick=True))[-3:]}
    with KeptRows(path, {}) as kept:
        assert 2 <= kept.n_taken_over <= 3
        rows = kept.collect(chosen, measure, 1)
    for row, job in zip(rows, chosen.values(), strict=True):
        fresh = json.loads(json.dumps(measure(job)))
        assert row.keys() == fresh.keys()
        for name, value in fresh.items():  # two processes may round differently: each may have compiled for itself
            if isinstance(value, float | int | list):
                assert row[name] == pytest.approx(value, rel=0.01, abs=1e-9), name
            elif not isinstance(value, dict):
                assert row[name] == value, name

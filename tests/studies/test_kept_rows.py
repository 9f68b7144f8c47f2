"""Rows survive an exception and a torn line; rows of other sources or settings are not mixed in."""

import json
import math

import pytest

from studies import kept_rows
from studies.kept_rows import KeptRows

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

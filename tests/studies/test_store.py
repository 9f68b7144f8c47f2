"""The folder of a report under attack: two runs, damaged rows, links, full and quick, files cut off."""

import json
import os
import re

import numpy as np
import pandas as pd
import pytest

from studies.bench import store
from studies.bench.cli import ROOT, Call, StudyError, processor
from studies.bench.store import KeptRows, Output, plain

STAMP = "`python -m studies.x`; 2026-01-01"


def call(path, study="x", quick=False):
    return Call(study, quick, path, False, f"python -m studies.{study}")


def interrupt(path, *names):
    """Leave the rows of these names as an interrupted run would."""
    with pytest.raises(KeyboardInterrupt), KeptRows(path, {}) as kept:
        for name in names:
            kept.add(name, {"name": name, "x": 0.1 + 0.2})
        raise KeyboardInterrupt


def test_two_runs_in_one_folder_are_refused(tmp_path):
    with Output(call(tmp_path)), pytest.raises(StudyError, match="another run is writing"), Output(call(tmp_path)):
        pass
    with Output(call(tmp_path)):  # free again
        pass


def test_a_folder_that_cannot_be_written_is_refused_before_any_run(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StudyError, match=r"cannot write to .*--out"), Output(call(tmp_path / "file" / "below")):
        pass


def test_rows_findings_and_series_come_back(tmp_path):
    rows = pd.DataFrame({"solver": ["a, b", "c"], "x": [0.1, None], "lost": [True, False]})
    curves = [{"t": [0.0, 0.5, 1.0], "mean": np.zeros((2, 3))}, np.nan]  # none of a run without a result
    with Output(call(tmp_path)) as output:
        output.save_rows(rows.assign(series=curves), STAMP)
        again, line = output.load_rows()
        output.save_findings({"n": np.int64(3), "x": np.float64(np.nan), "ok": np.bool_(True), "two": [1.0, "b"]})
        first, second = output.load_rows(curves=True)[0]["series"]
        assert first["t"].tolist() == [0.0, 0.5, 1.0] and first["mean"].shape == (2, 3) and second == {}
    pd.testing.assert_frame_equal(again, rows)
    assert line == STAMP
    assert json.loads((tmp_path / "x.json").read_text()) == {"n": 3, "x": None, "ok": True, "two": [1.0, "b"]}


def test_rows_of_another_study_or_size_are_refused(tmp_path):
    with Output(call(tmp_path)) as output:
        output.save_rows(pd.DataFrame({"x": [1]}), STAMP)
    os.rename(tmp_path / "x.csv", tmp_path / "y.csv")
    with Output(call(tmp_path, "y")) as output, pytest.raises(StudyError, match="other rows than full y ones"):
        output.load_rows()
    os.rename(tmp_path / "y.csv", tmp_path / "x.csv")
    with Output(call(tmp_path, quick=True)) as output, pytest.raises(StudyError, match="other rows than quick x ones"):
        output.load_rows()
    (tmp_path / "x.csv").write_bytes(b"\xff\xfe\x00")
    with Output(call(tmp_path)) as output, pytest.raises(StudyError, match="damaged"):
        output.load_rows()
    (tmp_path / "x.csv").unlink()
    with Output(call(tmp_path)) as output, pytest.raises(StudyError, match="there is no"):
        output.load_rows()


def test_a_write_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    with Output(call(tmp_path)) as output:
        output.write("x.md", "old")

        def full(descriptor):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(store.os, "fsync", full)
        with pytest.raises(StudyError, match="No space left"):
            output.write("x.md", "new")
    assert (tmp_path / "x.md").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", "x.md"]


def test_links_out_of_the_folder_are_not_followed(tmp_path):
    outside, folder = tmp_path / "outside.csv", tmp_path / "reports"
    outside.write_text("precious")
    folder.mkdir()
    for name in ("x.csv", "x.partial.jsonl", "x.md"):
        (folder / name).symlink_to(outside)
    with Output(call(folder)) as output:
        for attempt in (output.load_rows, output.kept, lambda: output.write("x.md", "new")):
            with pytest.raises(StudyError, match="outside the folder"):
                attempt()
    assert outside.read_text() == "precious"


@pytest.mark.parametrize("torn", [False, True])
def test_finished_rows_are_kept_and_the_file_goes_when_all_is_done(tmp_path, torn):
    path = tmp_path / "x.partial.jsonl"
    interrupt(path, "a", "b")
    path.write_text(path.read_text()[: -5 if torn else None])
    with KeptRows(path, {}) as kept:
        assert "a" in kept and (kept.n_resumed == 1 if torn else kept["b"]["x"] == 0.1 + 0.2)
    assert not path.exists()


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text.replace('{"key": "a"', '{"kex": "a"'),
        lambda text: text.replace('{"key": "a"', "not json"),
        lambda text: text.replace('{"key": "a", "row"', '{"key": 3, "row"'),
        lambda text: text + "[1]\n",
        lambda text: "\x00\x00" + text,
        lambda text: text.replace('"settings": {}', '"settings": {"quick": true}'),
        lambda text: text.replace(
            f'"processor": {json.dumps(processor())}, "settings"', '"processor": "Z80", "settings"'
        ),
    ],
)
def test_damaged_or_foreign_rows_are_set_aside_whole(tmp_path, capsys, damage):
    path = tmp_path / "x.partial.jsonl"
    interrupt(path, "a", "b")
    damaged = damage(path.read_text())
    path.write_text(damaged)
    with KeptRows(path, {}) as kept:
        assert kept.n_resumed == 0 and "a" not in kept and "b" not in kept
    assert "set aside as x.partial.aside-1" in capsys.readouterr().out
    assert (tmp_path / "x.partial.aside-1").read_text() == damaged


def test_rows_of_changed_sources_are_not_used(tmp_path, monkeypatch):
    path = tmp_path / "x.partial.jsonl"
    interrupt(path, "a")
    monkeypatch.setattr(store, "sources", lambda: "others")
    with KeptRows(path, {}) as kept:
        assert "a" not in kept


def test_what_json_does_not_hold_is_refused():
    with pytest.raises(TypeError, match="given complex"):
        plain({"x": 1j})


def test_two_timed_studies_do_not_run_at_once_on_a_machine(tmp_path, monkeypatch):
    monkeypatch.setattr(store.tempfile, "gettempdir", lambda: str(tmp_path))

    def output(study, folder, quick=False, redraw=False):
        return Output(Call(study, quick, tmp_path / folder, redraw, ""))

    with output("table3", "a"):
        with pytest.raises(StudyError, match="another study is being timed"), output("energy", "b"):
            pass
        for other in (output("honesty", "c"), output("energy", "d", quick=True), output("energy", "e", redraw=True)):
            with other:  # compares no times, or makes none that count
                pass
    with output("energy", "b"):  # nothing is left locked, also of the one refused
        pass


def test_no_text_tells_where_the_project_lies(tmp_path):
    with Output(call(tmp_path)) as output:
        output.save_rows(pd.DataFrame({"message": [f"refused ({ROOT / 'studies' / 'traps.py'}, line 56)"]}), STAMP)
    assert "refused (studies/traps.py, line 56)" in (tmp_path / "x.csv").read_text()


def test_no_committed_report_tells_where_it_was_made():
    """Of those that `make table3` does not write, and without the rows of a run that was interrupted."""
    paths = [path for path in (ROOT / "reports").iterdir() if path.suffix in (".csv", ".json", ".md")]
    told = [path.stem for path in paths if re.search(r"(?<![\w.])/\w[^ ]*/(studies|twoloop)/", path.read_text())]
    assert set(told) <= {"table3"}


def test_a_message_with_a_number_sign_is_no_comment_to_other_readers(tmp_path):
    made = pd.DataFrame({"message": ["See page.md#time_limit.", None], "outcome": ["said so", "right"], "x": [1, 2]})
    with Output(Call("energy", False, tmp_path, False, "")) as output:
        output.save_rows(made, STAMP)
    assert pd.read_csv(tmp_path / "energy.csv", comment="#").equals(output.load_rows()[0])

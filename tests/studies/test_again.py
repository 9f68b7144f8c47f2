"""Parts of work_precision that are measured again take the place of their rows, with commit and processor."""

from dataclasses import replace

import pandas as pd
import pytest

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.row_files import versions
from studies.bench.store import Output
from studies.work_precision import again, first_calls, mechanisms, minimal, study


def rows(*lines):
    return pd.DataFrame([dict(zip(("group", "case", "call_s", "processor"), line, strict=True)) for line in lines])


KEPT = rows(
    (mechanisms.GROUP, "four-bar", 1.0, "old"),
    (mechanisms.GROUP, "double pendulum", 2.0, "old"),
    (first_calls.GROUP, "four-bar", 3.0, "old"),
    ("compare", "four-bar", 4.0, "old"),
)


def test_a_mechanism_measured_again_takes_the_place_of_its_rows():
    new = rows((mechanisms.GROUP, "four-bar", 9.0, "new")).assign(commit="abc")
    parts = again.parts()
    made = again.replaced(KEPT, parts["four-bar"], new)
    assert made["call_s"].tolist() == [2.0, 3.0, 4.0, 9.0]
    calls = again.replaced(KEPT, parts["first calls"], rows((first_calls.GROUP, "four-bar", 8.0, "new")))
    assert calls["call_s"].tolist() == [1.0, 2.0, 4.0, 8.0]
    angles = again.replaced(
        pd.concat([KEPT, rows((minimal.GROUP, "four-bar", 5.0, "old"), (minimal.GROUP, "A02, N = 1", 6.0, "old"))]),
        *(again.parts()["four-bar" + again.IN_ANGLES], rows((minimal.GROUP, "four-bar", 0.5, "new"))),
    )
    assert angles["call_s"].tolist() == [1.0, 2.0, 3.0, 4.0, 6.0, 0.5]


def test_a_project_measured_again_takes_the_place_of_its_solvers_on_all_mechanisms():
    kept = KEPT.assign(family=["heyoka", "two-loop", "heyoka", "heyoka"])
    new = rows((mechanisms.GROUP, "knife edge", 9.0, "new")).assign(family="heyoka")
    assert again.replaced(kept, again.parts()["heyoka"], new)["call_s"].tolist() == [2.0, 3.0, 4.0, 9.0]


def test_it_writes_each_part_at_once(tmp_path, monkeypatch):
    (tmp_path / "work_precision.csv").write_text(f"# full work_precision; stamp\n{KEPT.to_csv(index=False)}")
    (tmp_path / "work_precision.json").write_text('{"versions": {"heyoka": "1", "scipy": "1"}}')
    call = cli.parse("work_precision", None, ["--out", str(tmp_path)])
    monkeypatch.setattr(again.cli, "parse", lambda *_: call)
    monkeypatch.setattr(mechanisms, "collect", lambda todo, kept: rows((mechanisms.GROUP, todo[0].case.name, 9.0, "")))
    again.main(["double pendulum"])
    with Output(call) as output:
        made, line = output.load_rows()
        found = output.load_findings()["versions"]
    assert found == {"heyoka": "1"} | versions() and found["scipy"] != "1"
    with Output(replace(call, redraw=True)) as output:  # rows that are read again keep what was told of them
        assert study.versions_of(output) == found
    assert line == "stamp" and made["call_s"].tolist() == [1.0, 3.0, 4.0, 9.0]
    assert made["processor"].tolist()[-1] == cli.processor() and made["commit"].tolist()[-1] == cli.commit()
    assert made["calibration_s"].notna().tolist() == [False, False, False, True]  # of which the archive has the ratio


@pytest.mark.parametrize("words", [[], ["five-bar"], ["four-bar | heyoka"]])
def test_parts_are_named(words):
    with pytest.raises(StudyError, match=r"parts are four-bar; .*first calls; four-bar, in angles"):
        again.main(words)

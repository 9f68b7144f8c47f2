"""Parts of work_precision that are measured again take the place of their rows, with commit and processor."""

import pandas as pd
import pytest

from studies.bench import cli
from studies.bench.cli import StudyError
from studies.bench.store import Output
from studies.work_precision import again, first_calls, minimal, rivals, study


def rows(*lines):
    return pd.DataFrame([dict(zip(("group", "case", "call_s", "processor"), line, strict=True)) for line in lines])


KEPT = rows(
    (rivals.GROUP, "four-bar", 1.0, "old"),
    (rivals.GROUP, "double pendulum", 2.0, "old"),
    (first_calls.GROUP, "four-bar", 3.0, "old"),
    ("compare", "four-bar", 4.0, "old"),
)


def test_a_mechanism_measured_again_takes_the_place_of_its_rows():
    new = rows((rivals.GROUP, "four-bar", 9.0, "new")).assign(commit="abc")
    parts = again.parts()
    made = again.replaced(KEPT, parts["four-bar"], new)
    assert made["call_s"].tolist() == [2.0, 3.0, 4.0, 9.0]
    assert study.measured_on(made.fillna({"commit": "ab"})) == {
        **{"commits": 2, "processors": ["new", "old"]},
        **{"sessions": 1, "in_angles_apart": 0},
    }
    calls = again.replaced(KEPT, parts["first calls"], rows((first_calls.GROUP, "four-bar", 8.0, "new")))
    assert calls["call_s"].tolist() == [1.0, 2.0, 4.0, 8.0]
    length = again.replaced(KEPT, parts["four-bar" + again.AT_LENGTH], rows(("compare", "four-bar", 7.0, "new")))
    assert length["call_s"].tolist() == [1.0, 2.0, 3.0, 7.0]
    angles = again.replaced(
        pd.concat([KEPT, rows((minimal.GROUP, "four-bar", 5.0, "old"), (minimal.GROUP, "A02, N = 1", 6.0, "old"))]),
        *(again.parts()["four-bar" + again.IN_ANGLES], rows((minimal.GROUP, "four-bar", 0.5, "new"))),
    )
    assert angles["call_s"].tolist() == [1.0, 2.0, 3.0, 4.0, 6.0, 0.5]


def test_a_project_measured_again_takes_the_place_of_its_solvers_on_all_mechanisms():
    kept = KEPT.assign(family=["heyoka", "two-loop", "heyoka", "heyoka"])
    new = rows((rivals.GROUP, "knife edge", 9.0, "new")).assign(family="heyoka")
    assert again.replaced(kept, again.parts()["heyoka"], new)["call_s"].tolist() == [2.0, 3.0, 4.0, 9.0]


@pytest.mark.parametrize("length", ["", again.AT_LENGTH])
def test_single_solvers_of_a_mechanism_take_the_place_of_their_rows(monkeypatch, length):
    asked = []
    monkeypatch.setattr(rivals, "collect", lambda todo, kept: asked.extend(todo))
    monkeypatch.setattr(study.adaptive, "collect", lambda todo, *_: asked.extend(todo))
    part = again.part_of(f"four-bar{length} | heyoka | CVODE from C, BDF", again.parts())
    kept = pd.concat([KEPT.assign(solver="heyoka"), KEPT.assign(solver="Taylor")], ignore_index=True)
    new = rows((part.group, "four-bar", 9.0, "new")).assign(solver="heyoka")
    left = [2.0, 3.0, 1.0] if length else [2.0, 3.0, 4.0]
    made = again.replaced(kept, part, new)
    assert len(made) == len(kept) and made["call_s"].tolist()[:3] == sorted(left) and made["call_s"].iloc[-1] == 9.0
    part.make(None)
    assert {run.solver.name for run in asked} == {"heyoka", "CVODE from C, BDF"}
    assert {run.case.name for run in asked} == {"four-bar"}


def test_it_writes_each_part_at_once(tmp_path, monkeypatch):
    (tmp_path / "work_precision.csv").write_text(f"# full work_precision; stamp\n{KEPT.to_csv(index=False)}")
    call = cli.parse("work_precision", None, ["--out", str(tmp_path)])
    monkeypatch.setattr(again.cli, "parse", lambda *_: call)
    monkeypatch.setattr(rivals, "collect", lambda todo, kept: rows((rivals.GROUP, todo[0].case.name, 9.0, "")))
    again.main(["double pendulum"])
    with Output(call) as output:
        made, line = output.load_rows()
    assert line == "stamp" and made["call_s"].tolist() == [1.0, 3.0, 4.0, 9.0]
    assert made["processor"].tolist()[-1] == cli.processor() and made["commit"].tolist()[-1] == cli.commit()
    assert made["calibration_s"].notna().tolist() == [False, False, False, True]  # of which the archive has the ratio


@pytest.mark.parametrize(
    "words",
    [
        *([], ["five-bar"], ["five-bar | heyoka"], ["four-bar | hey"], ["first calls | heyoka"]),
        ["four-bar, in angles | heyoka"],
    ],
)
def test_parts_are_named(words):
    with pytest.raises(StudyError, match=r"parts are four-bar; .*first calls; builds; four-bar, in angles"):
        again.main(words)


def test_only_what_ran_on_one_processor_is_compared():
    own = rows(("m", "four-bar", 1.0, "old"), ("m", "double pendulum", 2.0, "new"))
    others = rows((rivals.GROUP, "four-bar", 1.0, "new"), (rivals.GROUP, "double pendulum", 2.0, "new"))
    assert study.on_the_same_processor(own, others)["call_s"].tolist() == [2.0]


def test_processors_have_one_name_where_older_rows_lack_the_family():
    named = ["AMD EPYC", "AMD EPYC (family 25)", "Xeon (family 6)"]
    made = study.with_one_name(pd.DataFrame({"processor": named}))["processor"].tolist()
    assert made == ["AMD EPYC", "AMD EPYC", "Xeon (family 6)"]
    assert study.with_one_name(pd.DataFrame({"processor": named[1:]}))["processor"].tolist() == named[1:]


def test_sessions_and_their_calibrations_are_told():
    head = {"group": rivals.GROUP, "processor": "one"}
    made = [
        head | {"case": case, "commit": commit, "calibration_s": calibration}
        for case, others in (("a", 4.0), ("b", 2.0), ("c", 1.0))
        for commit, calibration in (("1", others), ("2", 2.0))
    ]
    told = study.measured_on(pd.DataFrame(made))
    assert told["sessions"] == 2 and told["speeds"] == [2.0, 2.0] and told["commits"] == 2
    angles = [head | {"group": minimal.GROUP, "case": "a", "commit": commit, "family": "SciPy"} for commit in "13"]
    ours = [each | {"family": "two-loop"} for each in made]
    assert study.measured_on(pd.DataFrame([*ours, angles[0]]))["in_angles_apart"] == 0
    assert study.measured_on(pd.DataFrame([*ours, *angles]))["in_angles_apart"] == 1
    alone = study.measured_on(pd.DataFrame(made[::2]))
    assert alone["sessions"] == 1 and alone["speeds"] == [1.0, 1.0]

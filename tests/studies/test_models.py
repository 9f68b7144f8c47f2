"""Files of the study models: what agrees with MuJoCo, and the sentences that follow from rows."""

import pandas as pd
import pytest

from references.model_files.draft import Draft, bodies
from studies import models
from tests.studies.of_study import said


def test_a_skeleton_has_bodies_with_joints_and_children():
    assert bodies("h(s,hh(n)),f") == [("h", "s,hh(n)"), ("f", "")]
    assert bodies("s,hh(n)") == [("s", ""), ("hh", "n")] and bodies("n") == [("", "")]


@pytest.mark.parametrize("form", models.N_FILES)
def test_a_file_is_always_the_same(form):
    one, other = (Draft(form, "rover", 3) for _ in range(2))
    assert one.text == other.text and one.used == other.used and len(one.used) > 3
    assert Draft(form, "rover", 0).text != one.text


def test_answer_and_reasons_follow_the_rows():
    row = {"features": "frame, mesh", "ignored": "", "message": "", **dict.fromkeys(models.MEASURES, 1e-15)}
    rows = [{**row, "group": "MJCF", "case": f"arm {k}", "status": status} for k, status in enumerate(models.STATUSES)]
    rows[1]["ignored"], rows[2]["forces"], rows[3]["message"] = "muscle", 0.1, "the axis of 'x' must have a direction"
    found, text = said(models, pd.DataFrame(rows))
    assert found["answer"].startswith("Of 4 files that MuJoCo loads, 3 are read; 1 agree to 1e-9, 1 differ by what")
    assert found["silent"] == ["MJCF arm 2"] and "muscle (1)" in text and "must have a direction (1)" in text
    assert found["subjects"]["MJCF: includes, frames, replicates"]["files"] == 4


@pytest.mark.slow
@pytest.mark.parametrize("form", models.N_FILES)
def test_files_agree_with_mujoco(form):
    pytest.importorskip("mujoco")
    rows = [models.row_of(form, kind, number) for kind in ("arm", "crane") for number in range(2)]
    assert {row["status"] for row in rows} <= {"AGREES", "SAID"}, [row["message"] for row in rows]


@pytest.mark.slow
def test_the_quick_run(tmp_path):
    pytest.importorskip("mujoco")
    models.STUDY.main(["--quick", "--out", str(tmp_path)])
    assert "Quick run" in (tmp_path / "models.md").read_text()

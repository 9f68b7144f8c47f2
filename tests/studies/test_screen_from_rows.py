"""The first screen is made again from the committed rows, whatever findings stand beside them."""

import shutil
from dataclasses import replace

import pytest

from studies.beam import study as beam
from studies.bench import index, study
from studies.bench.cli import REPORTS, ROOT
from studies.energy import study as energy
from studies.ensembles import study as ensembles
from studies.honesty import study as honesty
from studies.robustness import study as robustness
from studies.table3 import study as table3
from studies.work_precision import processors
from studies.work_precision import study as work_precision
from tests.studies.test_first_screen import differing

WITHOUT_FIGURES = {
    each.STUDY.name: replace(each.STUDY, figures=lambda rows, found: {})
    for each in (table3, honesty, robustness, energy, ensembles, beam)
}
TOLD = {"work_precision": work_precision, **WITHOUT_FIGURES}  # which it quotes


@pytest.mark.slow  # reads all rows; test_first_screen.py holds the screen to the committed findings
def test_every_sentence_of_the_screen_follows_from_the_committed_rows(tmp_path, monkeypatch):
    if not set(TOLD) <= set(index.findings(REPORTS)):
        pytest.skip("reports/ has findings with times of before the whole call: python -m studies all")
    monkeypatch.setattr(work_precision, "draw", lambda *_: None)
    monkeypatch.setattr(study, "write_index", lambda output: None)
    whole = {processors.WHOLE_CALL: processors.TIMES[processors.WHOLE_CALL]}
    monkeypatch.setattr(processors, "TIMES", whole)  # the first screen quotes no other
    shutil.copy(REPORTS / processors.FILE, tmp_path)
    shutil.copy(REPORTS / "validation.csv", tmp_path)  # which rivals it has
    for name, told in TOLD.items():
        for path in (REPORTS / f"{name}.csv", REPORTS / f"{name}_series.npz"):
            if path.exists():
                shutil.copy(path, tmp_path)
        told.main(["--redraw", "--out", str(tmp_path)])
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert differing(readme, tmp_path) == [], "run the studies with --redraw, then `python -m studies readme`"

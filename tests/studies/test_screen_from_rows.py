"""The first screen is made again from the committed rows, whatever findings stand beside them."""

import importlib
import shutil

import matplotlib.pyplot as plt
import pytest

from studies.bench import figures, index
from studies.bench.cli import REPORTS, ROOT
from tests.studies.test_first_screen import differing

TOLD = (
    "work_precision",
    "table3",
    "honesty",
    "robustness",
    "energy",
    "ensembles",
)  # which it quotes


def test_every_sentence_of_the_screen_follows_from_the_committed_rows(tmp_path, monkeypatch):
    if not set(TOLD) <= set(index.findings(REPORTS)):
        pytest.skip("reports/ has findings with times of before the whole call: python -m studies all")
    monkeypatch.setattr(figures, "save", lambda figure, *_: plt.close(figure))
    for name in TOLD:
        for path in (REPORTS / f"{name}.csv", REPORTS / f"{name}_series.npz"):
            if path.exists():
                shutil.copy(path, tmp_path)
        importlib.import_module(f"studies.{name}").main(["--redraw", "--out", str(tmp_path)])
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert differing(readme, tmp_path) == [], "run the studies with --redraw, then `python -m studies readme`"

"""What tests of several studies share."""

from dataclasses import replace
from types import SimpleNamespace

import matplotlib as mpl
import pandas as pd
import pytest

from studies import energy
from studies.bench import collector, figures, store


@pytest.fixture(autouse=True)
def own_lock(monkeypatch, tmp_path_factory):
    """A lock of timed studies for each test: neither a study on this machine nor another test makes it fail."""
    monkeypatch.setattr(store, "LOCK", str(tmp_path_factory.mktemp("lock") / "timed.lock"))


@pytest.fixture(scope="module")
def out(request, tmp_path_factory):
    """The folder of a quick run of the study of a module of tests, its `STUDIED`."""
    study = request.module.STUDIED.STUDY
    folder = tmp_path_factory.mktemp(study.name)
    with mpl.rc_context({"savefig.bbox": "standard"}), pytest.MonkeyPatch.context() as patch:
        # the tight box draws each figure twice; times may hold a build, for the sake of which each run is made twice
        patch.setattr(collector, "_may_hold_a_build", lambda *told: False)
        study.main(["--quick", "--out", str(folder)])
    return folder


@pytest.fixture(scope="module")
def made(request, out):
    """The rows of this run."""
    return pd.read_csv(out / f"{request.module.STUDIED.STUDY.name}.csv", comment="#")


@pytest.fixture
def unsaved(monkeypatch):
    """Make and save no figures, which takes longer than all else of a report."""
    monkeypatch.setattr(figures, "save", lambda *arguments: None)
    monkeypatch.setattr(figures, "work_precision", lambda *arguments, **more: SimpleNamespace(axes=[]))
    for study in (energy,):
        monkeypatch.setattr(study, "STUDY", replace(study.STUDY, figures=lambda rows, found: {}))

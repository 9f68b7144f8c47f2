"""What tests of studies share: a report made of made-up rows, and what holds for each quick run."""

import json

import pytest

from studies.bench.cli import Call
from studies.bench.solvers import CATALOGUE
from studies.bench.store import Output

GOOD = {"status": "REACHED_END", "message": "", "repeat": 0}  # of a row, before medians


def told(name):
    """What a row says of its solver."""
    solver = CATALOGUE[name]
    of_solver = {"family": solver.family, "called_from": solver.called_from, "solver": name}
    return of_solver | {"keeps_constraints": solver.keeps_constraints}


def found_of(study, folder, rows, quick=False):
    """The findings of a module's study, with which the report was written."""
    name = study.STUDY.name
    with Output(Call(name, quick, folder, True, "")) as output:
        study.STUDY.report(output, rows, "stamp")
    return json.loads((folder / f"{name}.json").read_text())


class QuickRun:
    """The tests that subclasses inherit, of the quick run of the study of their module, its `STUDIED`."""

    pictures: tuple[str, ...]

    @pytest.mark.usefixtures("unsaved")
    def test_it_is_drawn_again_as_it_was(self, request, out):
        study = request.module.STUDIED.STUDY
        text = (out / f"{study.name}.md").read_text()
        study.main(["--quick", "--out", str(out), "--redraw"])
        assert (out / f"{study.name}.md").read_text() == text
        for name in self.pictures:
            assert all((out / f"{name}.{suffix}").stat().st_size > 10_000 for suffix in ("png", "svg"))
        assert all(series.stat().st_size < 300_000 for series in out.glob("*_series.npz"))
        assert not list(out.glob("*.partial.jsonl"))
